"""A pooled calibration as text: parameters, what was not shown, and the leave-one-out table."""

from __future__ import annotations

import math
from textwrap import wrap

import numpy as np

from icrtool.calibration.held_out import HeldOut, HeldOutRow
from icrtool.calibration.pooled import CalibrationResult
from icrtool.calibration.record import Calibration
from icrtool.motion.models import TERMS, FittedModel
from icrtool.output.text_format import TABLE_WIDTH

GEOMETRY = (
    ("y_icr_right_m", "y ICR right", "m"),
    ("y_icr_left_m", "y ICR left", "m"),
    ("x_icr_m", "x ICR", "m"),
    ("multiplier", "multiplier, with the radius factors below", ""),
    ("radius_left", "left radius over configured", ""),
    ("radius_right", "right radius over configured", ""),
    ("multiplier_nominal", "multiplier, radii as configured", ""),
)


def format_result(result: CalibrationResult) -> str:
    """Return the tables of a pooled calibration, no line end."""
    calibration = result.calibration
    lines = [
        *wrap(
            f"Recommended: {calibration.recommended} ({calibration.fitted.model.label}): {calibration.why}", TABLE_WIDTH
        )
    ]
    lines += ["", *format_parameters(calibration), "", *format_held_out(result.wheels)]
    if result.gyro is not None:
        lines += ["", "wheels and gyro", *format_held_out(result.gyro)]
    return "\n".join([*lines, *result.notes])


def format_parameters(calibration: Calibration) -> list[str]:
    """Return the lines of the parameters with one standard deviation, and of what was not shown."""
    fitted = calibration.fitted
    lines = [f"{'parameter':<18}{'value ± std':<20}meaning", *_parameter_lines(fitted)]
    if calibration.gyro is not None:
        lines += [f"{'and with gyro':<18}", *_parameter_lines(calibration.gyro)]
    geometry, covariance = calibration.geometry()
    std_of = dict(zip(geometry._fields, np.sqrt(np.diag(covariance)), strict=True))
    for key, label, unit in GEOMETRY:
        lines.append(f"{label:<44}{getattr(geometry, key):+.4f} ± {std_of[key]:.4f} {unit}".rstrip())
    for name in fitted.not_shown:
        lines.append(f"not shown by this driving: {name} ({TERMS[name].meaning}); its value is the prior's")
    return lines


def _parameter_lines(fitted: FittedModel) -> list[str]:
    return [
        f"{name:<18}{f'{value:+.4f} ± {std:.4f}':<20}{TERMS[name].meaning}"
        for name, value, std in zip(fitted.model.terms, fitted.parameters, fitted.std, strict=True)
    ]


def format_held_out(table: HeldOut) -> list[str]:
    """Return the leave-one-out table: p95 / expected error by horizon, median over folds and worst fold."""
    what = "log" if table.folds[0].whole else "block"
    head = f"each {what} left out in turn ({len(table.folds)}): 95 % / expected error [m], median {what} (worst {what})"
    lines = [head, f"{'model':<25}" + "".join(f"{f'{horizon:g} m':>25}" for horizon in table.horizons_m)]
    for row in table.scores:
        cells = "".join(f"{_cell(row, h):>25}" for h in range(len(table.horizons_m)))
        lines.append(f"{row.label.removesuffix(' + gyro'):<25.25}{cells}")
    used = ", ".join(dict.fromkeys(table.chosen))
    lines += wrap(
        f"recommended: chosen without the {what} it is tested on ({used}); of all: {table.recommended}", TABLE_WIDTH
    )
    return lines


def _cell(row: HeldOutRow, h: int) -> str:
    if not math.isfinite(row.median("p95", h)):
        return "–"
    median, worst = ((over("p95", h), over("expected", h)) for over in (row.median, row.worst))
    return f"{median[0]:.2f}/{median[1]:.2f} ({worst[0]:.2f}/{worst[1]:.2f})"
