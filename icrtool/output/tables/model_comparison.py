"""The rows of ladder.csv, and what report.json holds of how models were tested."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from icrtool.calibration.model_comparison import FITTED_TO, ModelComparison
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.motion.models import FittedModel
from icrtool.output.text_format import FITTED
from icrtool.records.dropout import ModelResult, error_columns
from icrtool.records.dropout_document import FitDocument, LadderDocument, ScoreDocument
from icrtool.records.plain_data import plain, rows_of

COMPARISON_COLUMNS = (
    "model", "fitted", "heading", "horizon_m", "trials", "expected_error_m", "p50_m", "p95_m", "max_m",
    "expected_pct", "p95_pct",
)  # fmt: skip


def compared_results(report: DropoutReport) -> list[ModelResult]:
    """Return the rows of the comparison: all of the report but those of calibrations."""
    given = {one.name for one in report.calibrations}
    return [one for one in report.results if one.name not in given]


def fitted_text(name: str, heading: str) -> str:
    """Return what the numbers of a row were fitted to; `heading` is what rows with a measured one go by."""
    return FITTED[FITTED_TO.get(name.removesuffix(f"_{heading}") if heading else name, "others")]


def comparison_rows(report: DropoutReport, comparison: ModelComparison) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of ladder.csv, a model and horizon each; see `COMPARISON_COLUMNS`."""
    for one in compared_results(report):
        fitted, heading = fitted_text(one.name, comparison.heading), _heading(one.name, comparison)
        for row in rows_of({"horizon_m": report.horizons_m, **error_columns(one.summary)}):
            shares = (100.0 * row[name] / row["horizon_m"] for name in ("expected_error_m", "p95_m"))
            yield one.name, fitted, heading, *row.values(), *shares


def comparison_document(report: DropoutReport) -> LadderDocument:
    """Return what report.json holds; why there is none where it was left out."""
    comparison = report.comparison
    if comparison is None:
        return LadderDocument(left_out=report.no_comparison)
    heading = comparison.heading
    return LadderDocument(
        horizons_m=report.horizons_m.tolist(),
        blocks=comparison.blocks,
        starts=comparison.starts,
        heading=heading or None,
        notes=list(comparison.notes),
        models=[
            ScoreDocument(
                one.name, one.label, fitted_text(one.name, heading), _heading(one.name, comparison),
                *plain(list(error_columns(one.summary).values())),
            )
            for one in compared_results(report)
        ],
        width_m=comparison.width_m,
        fits={name: _fit(fit) for name, fit in comparison.fits.items()},
    )  # fmt: skip


def _fit(fit: FittedModel) -> FitDocument:
    """Return the parameters of a fit with one standard deviation."""
    columns = (fit.parameters, np.sqrt(np.diag(fit.covariance)))
    return FitDocument(*(plain(dict(zip(fit.model.terms, column, strict=True))) for column in columns))


def _heading(name: str, comparison: ModelComparison) -> str:
    turned = comparison.heading and name.endswith(f"_{comparison.heading}")
    return comparison.heading if turned else "wheels"
