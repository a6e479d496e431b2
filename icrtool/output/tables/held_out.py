"""A pooled calibration as text: parameters, what was not shown, and the leave-one-out table."""

from __future__ import annotations

import numpy as np

from icrtool.calibration.controller_numbers import not_shown_sentences
from icrtool.calibration.held_out import HeldOut, HeldOutRow
from icrtool.calibration.pooled import CalibrationResult
from icrtool.calibration.record import Calibration
from icrtool.motion.models import TERMS, FittedModel
from icrtool.output.text_blocks import Block, Table, Text
from icrtool.output.text_format import fitted_model_text

GEOMETRY = (
    ("y_icr_right_m", "y ICR right", "m"),
    ("y_icr_left_m", "y ICR left", "m"),
    ("x_icr_m", "x ICR", "m"),
    ("multiplier", "multiplier (y right - y left) / b", ""),
    ("radius_left", "left radius over configured", ""),
    ("radius_right", "right radius over configured", ""),
)


def format_result(result: CalibrationResult) -> Text:
    """Return the tables of a pooled calibration, no line end."""
    calibration, fitted = result.calibration, result.calibration.fitted
    return Text([
        f"Motion model: {fitted_model_text(fitted)}",
        "",
        *_parameter_blocks(calibration),
        "",
        *held_out_blocks(result.table),
        *result.notes,
    ])  # fmt: skip


def _parameter_blocks(calibration: Calibration) -> list[Block]:
    """Return the parameters with one standard deviation, and what was not shown."""
    rows = _parameter_rows(calibration.fitted)
    if calibration.gyro is not None:
        rows += [("and with gyro", "", ""), *_parameter_rows(calibration.gyro)]
    geometry, covariance = calibration.geometry()
    std_of = dict(zip(geometry._fields, np.sqrt(np.diag(covariance)), strict=True))
    numbers = [
        (label, f"{getattr(geometry, key):+.4f} ± {std_of[key]:.4f} {unit}".rstrip()) for key, label, unit in GEOMETRY
    ]
    return [
        Table("l", rows, ("parameter", "value ± std", "meaning")),
        Table("l", numbers),
        *not_shown_sentences(calibration.fitted),
    ]


def _parameter_rows(fitted: FittedModel) -> list[tuple[str, str, str]]:
    return [
        (name, f"{value:+.4f} ± {std:.4f}", TERMS[name].meaning)
        for name, value, std in zip(fitted.model.terms, fitted.parameters, fitted.std, strict=True)
    ]


def held_out_blocks(table: HeldOut) -> list[Block]:
    """Return the leave-one-out table: p95 / expected error by horizon, of all trials together and of the worst fold."""
    what = "log" if table.folds[0].whole else "block"
    rows = [(row.label, *(_cell(row, h) for h in range(len(table.horizons_m)))) for row in table.scores]
    tested = (
        f"each {what} left out in turn"
        if table.folds[0].whole
        else "each trial predicted by a fit to the rest of the drive"
    )
    return [
        f"{tested} ({len(table.folds)} {what}s): 95 % / expected error [m] of all trials (of the worst {what})",
        Table("lr", rows, ("model", *(f"{horizon:g} m" for horizon in table.horizons_m))),
    ]


def _cell(row: HeldOutRow, h: int) -> str:
    if not row.together.trials[h]:
        return "–"
    all_trials = row.together.p95[h], row.together.expected[h]
    worst = (row.worst(column, h) for column in ("p95", "expected"))
    (p95, expected), (worst_p95, worst_expected) = all_trials, worst
    return f"{p95:.2f}/{expected:.2f} ({worst_p95:.2f}/{worst_expected:.2f})"
