"""A pooled calibration as text: parameters, what was not shown, and the leave-one-out table."""

from __future__ import annotations

import numpy as np

from icrtool.calibration.controller_numbers import not_shown_sentences
from icrtool.calibration.held_out import HeldOut, HeldOutRow
from icrtool.calibration.one_log import LogCalibration
from icrtool.calibration.pooled import CalibrationResult
from icrtool.calibration.record import Calibration
from icrtool.motion.models import ICRS, TERMS, FittedModel
from icrtool.output.tables.calibration import sensor_blocks
from icrtool.output.tables.dropout import REACH_LABELS, REACH_NOTES, REACH_ROWS
from icrtool.output.tables.run import numbers_of
from icrtool.output.text_blocks import VERBOSE, Block, Facts, Section, Table, Title
from icrtool.output.text_format import distance_text, fitted_model_text
from icrtool.records.text import counted

BUDGET_M = 0.5
"""Error within which a distance counts."""

GEOMETRY = (
    ("y_icr_right_m", "y ICR right", "m"),
    ("y_icr_left_m", "y ICR left", "m"),
    ("x_icr_m", "x ICR", "m"),
    ("multiplier", "multiplier (y right - y left) / b", ""),
    ("radius_left", "left radius over configured", ""),
    ("radius_right", "right radius over configured", ""),
)


def calibration_blocks(result: CalibrationResult | None, sensors: LogCalibration | None) -> list[Block]:
    """Return what `icrtool calibrate` prints: numbers, how far on what they were not fitted to, settings of one log."""
    blocks = _result_blocks(result) if result is not None else []
    return [*blocks, *sensor_blocks(sensors)] if sensors is not None else blocks


def _result_blocks(result: CalibrationResult) -> list[Block]:
    calibration, table = result.calibration, result.table
    geometry, covariance = calibration.geometry()
    icrs = list(zip(geometry[:ICRS], np.sqrt(np.diag(covariance)).tolist(), strict=False))
    driven = distance_text(sum(log.distance_m for log in calibration.logs))
    what = "log" if table.folds[0].whole else "block of distance"
    rows = [
        (REACH_LABELS.get(row.name, row.label), reached.short_text, REACH_NOTES.get(row.name, ""))
        for row in sorted(table.scores, key=lambda row: (*REACH_ROWS, row.name).index(row.name))
        if row.name in REACH_ROWS and (reached := row.within(table.horizons_m, BUDGET_M)) is not None
    ]
    unknown = "; ".join(TERMS[name].meaning for name in calibration.fitted.not_shown)
    return [
        Title(calibration.robot.name or "robot", f"{counted(len(calibration.logs), 'log')}, {driven}"),
        *numbers_of(calibration.controller_numbers(), calibration.width_m, icrs),
        Table("lrl", rows, caption=f"How far within {BUDGET_M:g} m (95 %), each {what} left out in turn?"),
        Facts([("not found", f"too small, or not driven; taken as usual: {unknown}")] if unknown else []),
        Section(
            f"Motion model: {fitted_model_text(calibration.fitted)}",
            [*_parameter_blocks(calibration), *held_out_blocks(table), *result.notes], VERBOSE,
        ),
    ]  # fmt: skip


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
