"""The model comparison as text, as rows of ladder.csv and as plain data."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from icrtool.calibration.model_comparison import ROWS, ModelComparison
from icrtool.motion.models import FittedModel, TypicalDrive
from icrtool.output.text_blocks import Block, Table
from icrtool.output.text_format import FITTED
from icrtool.records.dropout import ModelScore, error_columns
from icrtool.records.plain_data import rows_of

COMPARISON_COLUMNS = (
    "model", "fitted", "heading", "horizon_m", "trials", "expected_error_m", "p50_m", "p95_m", "max_m",
    "expected_pct", "p95_pct",
)  # fmt: skip


def comparison_blocks(comparison: ModelComparison) -> list[Block]:
    """Return the table as text: p95 / expected error [m] by horizon, all models in the same trials."""
    rows = [
        (score.label, FITTED[score.fitted], *map(_pair, score.summary.p95.tolist(), score.summary.expected.tolist()))
        for score in comparison.scores
    ]
    return [
        "models on distance they were not fitted to: 95 % / expected error [m]",
        Table("llr", rows, ("model", "fitted", *(f"{horizon:g} m" for horizon in comparison.horizons_m))),
        extended_line(comparison),
        *comparison.notes,
    ]


def extended_line(comparison: ModelComparison) -> str:
    """Return which models were chosen for the blocks, and which one for the whole drive."""
    names = {name: fit.model.label for name, fit in comparison.fits.items()}
    whole = f"for all: {names[comparison.best]}"
    used = dict.fromkeys(names[name] for name in comparison.chosen)
    return f"extended: chosen without the block that it is tested on: {'; '.join(used)}; {whole}"


def comparison_rows(comparison: ModelComparison) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of ladder.csv, a model and horizon each; see `COMPARISON_COLUMNS`."""
    for score in comparison.scores:
        fitted, heading = FITTED[score.fitted] or "not fitted", _heading(score, comparison)
        for row in rows_of({"horizon_m": comparison.horizons_m, **error_columns(score.summary)}):
            shares = (100.0 * row[name] / row["horizon_m"] for name in ("expected_error_m", "p95_m"))
            yield score.name, fitted, heading, *row.values(), *shares


def comparison_document(comparison: ModelComparison) -> dict[str, Any]:
    """Return what report.json holds, with numbers of numpy."""
    return {
        "horizons_m": list(comparison.horizons_m),
        "blocks": comparison.blocks,
        "starts": comparison.starts,
        "heading": comparison.heading or None,
        "notes": list(comparison.notes),
        "extended_by_block": list(comparison.chosen),
        "best": comparison.best,
        "models": [
            {
                "name": score.name,
                "label": score.label,
                "fitted": FITTED[score.fitted] or "not fitted",
                "heading": _heading(score, comparison),
                **error_columns(score.summary),
            }
            for score in comparison.scores
        ],
        "fits": {_fit_name(name, comparison): _fit(fit, comparison.width_m) for name, fit in comparison.fits.items()},
    }


def _fit_name(name: str, comparison: ModelComparison) -> str:
    """Return the name of a fit: that of its row; ``icr`` is the filter's row."""
    base = name.removesuffix("_gyro")
    row = ROWS.get(base, base)
    return row if base == name else f"{row}_{comparison.heading}"


def _fit(fit: FittedModel, width_m: float) -> dict[str, Any]:
    """Return parameters of a fit, and the track ICRs of one by wheels alone, with one standard deviation."""
    value = dict(zip(fit.model.terms, fit.parameters, strict=True))
    std = dict(zip(fit.model.terms, fit.std, strict=True))
    if not fit.model.uses_gyro:
        geometry, covariance = fit.geometry(width_m, TypicalDrive())
        value |= geometry._asdict()
        std |= dict(zip(geometry._fields, np.sqrt(np.diag(covariance)), strict=True))
    return {"value": value, "std": std}


def _heading(score: ModelScore, comparison: ModelComparison) -> str:
    return comparison.heading if score.measured_heading else "wheels"


def _pair(p95: float, expected: float) -> str:
    return f"{p95:.2f} / {expected:.2f}" if math.isfinite(p95) else "–"
