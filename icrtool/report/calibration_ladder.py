"""The model ladder as text and as plain data."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from icrtool.analysis.ladder import Ladder

FITTED = {"never": "", "before": "up to the start", "all": "in sample", "others": "held out"}
TERM_KEYS = (
    "y_icr_right_m", "y_icr_left_m", "x_icr_m", "left_scale", "right_scale", "bend", "speed_spm", "wheels_read_later_s"
)  # fmt: skip


def format_ladder(ladder: Ladder) -> str:
    """Return the table of a ladder, no line end: p95 / expected error [m] by horizon, all models on the same trials."""
    horizons = "".join(f"{f'{horizon:g} m':>16}" for horizon in ladder.horizons_m)
    lines = [
        f"open-loop error, p95 / expected [m], {ladder.blocks} blocks held out in turn",
        f"{'model':<28}{'fitted':<16}{horizons}",
    ]
    for rung in ladder.rungs:
        cells = "".join(
            f"{_pair(float(p95), float(expected)):>16}"
            for p95, expected in zip(rung.summary.p95, rung.summary.expected, strict=True)
        )
        lines.append(f"{rung.label:<28}{FITTED[rung.fitted]:<16}{cells}")
    lines.append(f"extended: {', '.join(ladder.chosen)} by block; for this robot: {ladder.best}")
    if ladder.heading_is_reference and any(rung.measured_heading for rung in ladder.rungs):
        lines.append("heading comes from the position reference itself: rows with heading are as good as that")
    return "\n".join(lines)


def ladder_document(ladder: Ladder) -> dict[str, Any]:
    """Return plain data for report.json."""
    return {
        "horizons_m": list(ladder.horizons_m),
        "blocks": ladder.blocks,
        "chosen_by_block": list(ladder.chosen),
        "best": ladder.best,
        "heading_is_reference": ladder.heading_is_reference,
        "models": [
            {
                "name": rung.name,
                "label": rung.label,
                "fitted": rung.fitted,
                "measured_heading": rung.measured_heading,
                "trials": rung.summary.trials.tolist(),
                "expected_error_m": rung.summary.expected.tolist(),
                "p95_m": rung.summary.p95.tolist(),
            }
            for rung in ladder.rungs
        ],
        "fits": {
            name: {
                "value": dict(zip(TERM_KEYS, fit.parameters.tolist(), strict=True)),
                "std": dict(zip(TERM_KEYS, np.sqrt(np.diag(fit.parameter_covariance)).tolist(), strict=True)),
                "windows": fit.windows,
            }
            for name, fit in ladder.fits.items()
        },
    }


def _pair(p95: float, expected: float) -> str:
    return f"{p95:.2f} / {expected:.2f}" if math.isfinite(p95) else "–"
