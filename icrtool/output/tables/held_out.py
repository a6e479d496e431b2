"""A pooled calibration as text: parameters, what was not shown, and the leave-one-out table."""

from __future__ import annotations

import math

import numpy as np

from icrtool.calibration.controller_numbers import not_shown_sentences
from icrtool.calibration.held_out import HeldOut, HeldOutRow
from icrtool.calibration.pooled import CalibrationResult
from icrtool.calibration.record import Calibration
from icrtool.motion.models import TERMS, FittedModel, find_model
from icrtool.output.text_blocks import Block, Table, Text
from icrtool.output.text_format import fitted_model_text

GEOMETRY = (
    ("y_icr_right_m", "y ICR right", "m"),
    ("y_icr_left_m", "y ICR left", "m"),
    ("x_icr_m", "x ICR", "m"),
    ("multiplier", "multiplier, with the radius factors below", ""),
    ("radius_left", "left radius over configured", ""),
    ("radius_right", "right radius over configured", ""),
    ("multiplier_nominal", "multiplier, radii as configured", ""),
)


def format_result(result: CalibrationResult) -> Text:
    """Return the tables of a pooled calibration, no line end."""
    calibration, fitted = result.calibration, result.calibration.fitted
    blocks: list[Block] = [
        f"Recommended: {fitted_model_text(fitted)}: {calibration.why}",
        "",
        *_parameter_blocks(calibration),
        "",
        *held_out_blocks(result.wheels),
    ]
    if result.gyro is not None:
        blocks += ["", "wheels and gyro", *held_out_blocks(result.gyro)]
    return Text([*blocks, *result.notes])


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
    """Return the leave-one-out table: p95 / expected error by horizon, median over folds and worst fold."""
    what = "log" if table.folds[0].whole else "block"
    rows = [
        (row.label.removesuffix(" + gyro"), *(_cell(row, h) for h in range(len(table.horizons_m))))
        for row in table.scores
    ]
    used = "; ".join(dict.fromkeys(find_model(name).label for name in table.chosen))
    recommended = find_model(table.recommended).label
    tested = (
        f"each {what} left out in turn"
        if table.folds[0].whole
        else "each trial predicted by a fit to the rest of the drive"
    )
    return [
        f"{tested} ({len(table.folds)} {what}s): 95 % / expected error [m], median {what} (worst {what})",
        Table("lr", rows, ("model", *(f"{horizon:g} m" for horizon in table.horizons_m))),
        f"recommended: chosen without the {what} that it is tested on: {used}; for all: {recommended}",
    ]


def _cell(row: HeldOutRow, h: int) -> str:
    if not math.isfinite(row.median("p95", h)):
        return "–"
    median, worst = ((over("p95", h), over("expected", h)) for over in (row.median, row.worst))
    return f"{median[0]:.2f}/{median[1]:.2f} ({worst[0]:.2f}/{worst[1]:.2f})"
