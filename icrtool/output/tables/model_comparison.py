"""The model ladder as text, as rows of ladder.csv and as plain data."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from textwrap import wrap
from typing import Any

import numpy as np

from icrtool.calibration.held_out import FEWEST_TO_CHOOSE
from icrtool.calibration.model_comparison import Ladder
from icrtool.calibration.record import FittedModel
from icrtool.motion.models import TypicalDrive
from icrtool.output.text_format import FITTED, TABLE_WIDTH
from icrtool.records.dropout import Rung

LADDER_COLUMNS = (
    "model", "fitted", "heading", "horizon_m", "trials", "expected_error_m", "p50_m", "p95_m", "max_m",
    "expected_pct", "p95_pct",
)  # fmt: skip


def format_ladder(ladder: Ladder) -> str:
    """Return the table of a ladder, no line end: p95 / expected error [m] by horizon, all models on the same trials."""
    horizons = "".join(f"{f'{horizon:g} m':>16}" for horizon in ladder.horizons_m)
    lines = [
        f"models on way they were not fitted to, {ladder.blocks} blocks held out in turn: 95 % / expected error [m]",
        f"{'model':<26}{'fitted':<16}{horizons}",
    ]
    for rung in ladder.rungs:
        cells = "".join(
            f"{_pair(float(p95), float(expected)):>16}"
            for p95, expected in zip(rung.summary.p95, rung.summary.expected, strict=True)
        )
        lines.append(f"{rung.label:<26}{FITTED[rung.fitted]:<16}{cells}")
    lines += wrap(extended_line(ladder), TABLE_WIDTH, subsequent_indent="  ")
    lines += ladder.notes
    return "\n".join(line.rstrip() for line in lines)


def extended_line(ladder: Ladder) -> str:
    """Return which models were chosen for the blocks, and which one for the whole drive."""
    names = {name: fit.model.label for name, fit in ladder.fits.items()}
    whole = f"for the whole drive: {names[ladder.best]}"
    if ladder.blocks < FEWEST_TO_CHOOSE:
        return f"extended: {ladder.blocks} blocks are too few to choose, it is {names[ladder.chosen[0]]}; {whole}"
    used = dict.fromkeys(names[name] for name in ladder.chosen)
    return f"extended, chosen without the block it is tested on: {'; '.join(used)}; {whole}"


def ladder_rows(ladder: Ladder) -> Iterator[Sequence[str | int | float]]:
    """Yield the rows of ladder.csv, a model and horizon each; see `LADDER_COLUMNS`."""
    for rung in ladder.rungs:
        for h, horizon in enumerate(ladder.horizons_m):
            s = rung.summary
            numbers = (float(column[h]) for column in (s.expected, s.p50, s.p95, s.largest))
            expected, p50, p95, largest = numbers
            yield (
                rung.name, FITTED[rung.fitted] or "not fitted", _heading(rung, ladder), horizon, int(s.trials[h]),
                expected, p50, p95, largest, 100.0 * expected / horizon, 100.0 * p95 / horizon,
            )  # fmt: skip


def ladder_document(ladder: Ladder) -> dict[str, Any]:
    """Return plain data for report.json."""
    return {
        "horizons_m": list(ladder.horizons_m),
        "blocks": ladder.blocks,
        "starts": ladder.starts,
        "heading": ladder.heading or None,
        "notes": list(ladder.notes),
        "extended_by_block": list(ladder.chosen),
        "best": ladder.best,
        "models": [
            {
                "name": rung.name,
                "label": rung.label,
                "fitted": FITTED[rung.fitted] or "not fitted",
                "heading": _heading(rung, ladder),
                "trials": rung.summary.trials.tolist(),
                "expected_error_m": rung.summary.expected.tolist(),
                "p50_m": rung.summary.p50.tolist(),
                "p95_m": rung.summary.p95.tolist(),
                "max_m": rung.summary.largest.tolist(),
            }
            for rung in ladder.rungs
        ],
        "fits": {FITS.get(name, name): _fit(fit, ladder.width_m) for name, fit in ladder.fits.items()},
    }


FITS = {"icr": "window"}
"""Names of fits that differ from those in the family: ``icr`` is the filter's row."""


def _fit(fit: FittedModel, width_m: float) -> dict[str, Any]:
    """Return parameters and track ICRs of a fit, with one standard deviation."""
    geometry, covariance = fit.geometry(width_m, TypicalDrive())
    terms = fit.model.terms
    return {
        "value": dict(zip(terms, fit.parameters.tolist(), strict=True)) | geometry._asdict(),
        "std": dict(zip(terms, fit.std.tolist(), strict=True))
        | dict(zip(geometry._fields, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
    }


def _heading(rung: Rung, ladder: Ladder) -> str:
    return ladder.heading if rung.measured_heading else "wheels"


def _pair(p95: float, expected: float) -> str:
    return f"{p95:.2f} / {expected:.2f}" if math.isfinite(p95) else "–"
