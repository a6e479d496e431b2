"""Calibrations as blocks: a motion model from one log or many, and what one log shows of its sensors."""

from __future__ import annotations

import textwrap

from icrtool.calibration.held_out import HeldOut, HeldOutRow
from icrtool.calibration.one_log import LABELS
from icrtool.calibration.pooled import CalibrationResult
from icrtool.motion.models import TERMS
from icrtool.output.tables.dropout import REACH_ROWS, parameter_table, reach_row
from icrtool.output.tables.run import numbers_of
from icrtool.output.text_blocks import VERBOSE, Block, Facts, Line, Section, Table, Title
from icrtool.output.text_format import distance_text, model_text
from icrtool.records.calibration_document import SensorDocument, SensorParameter
from icrtool.records.run import ICR_COLUMNS
from icrtool.records.text import counted

BUDGET_M = 0.5
"""Error within which a distance counts."""


def calibration_blocks(result: CalibrationResult | None, sensors: SensorDocument | None) -> list[Block]:
    """Return what `icrtool calibrate` prints: numbers, how far on what they were not fitted to, settings of one log."""
    blocks = _result_blocks(result) if result is not None else []
    return [*blocks, *sensor_blocks(sensors)] if sensors is not None else blocks


def _result_blocks(result: CalibrationResult) -> list[Block]:
    calibration, table = result.calibration, result.table
    icrs = [(calibration.geometry[name], calibration.geometry_std[name]) for name in ICR_COLUMNS]
    driven = distance_text(sum(log.distance_m for log in calibration.logs))
    what = "log" if table.folds[0].whole else "block of distance"
    rows = [
        reach_row(reached)
        for row in sorted(table.scores, key=lambda row: (*REACH_ROWS, row.name).index(row.name))
        if row.name in REACH_ROWS and (reached := row.within(table.horizons_m, BUDGET_M)) is not None
    ]
    unknown = "; ".join(TERMS[name].meaning for name in calibration.fitted.not_shown)
    parameters = parameter_table(calibration.fitted, calibration.fitted_with_gyro)
    return [
        Title(calibration.robot.name or "robot", f"{counted(len(calibration.logs), 'log')}, {driven}"),
        *numbers_of(calibration.controller, calibration.width_m, icrs),
        Table("lrl", rows, caption=f"How far within {BUDGET_M:g} m (95 %), each {what} left out in turn?"),
        Facts([("not found", f"too small, or not driven; taken as usual: {unknown}")] if unknown else []),
        Section(
            f"Motion model: {model_text(calibration.fitted)}",
            [parameters, *held_out_blocks(table), *result.notes], VERBOSE,
        ),
    ]  # fmt: skip


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


MEANINGS = "shown: found well enough to set; weak: found roughly; not shown, not separable: this drive cannot find it"

OPTIONS_WIDTH = 76
"""Characters of options in a line of a terminal of 80 columns, beside indent and backslash."""

DIGITS = {"_deg": (2, "°"), "_m": (3, "m"), "_s": (3, "s"), "scale": (4, "")}


def sensor_blocks(calibration: SensorDocument) -> list[Block]:
    """Return the settings that one log proposes, and the estimates that they come from."""
    facts = calibration.drive
    right, left = facts.turned_right_deg, facts.turned_left_deg
    speed = f"{facts.speed_mean_mps:.2f} ± {facts.speed_std_mps:.2f} m/s"
    stretches = f"{calibration.independent_stretches} independent stretches"
    compared = f"{calibration.windows} windows of driven distance, {stretches}"
    head = [
        ("drive", f"{facts.distance_m:.0f} m at {speed}, turned {right:.0f}° right and {left:.0f}° left"),
        ("compared", compared),
    ]
    rows = [
        (LABELS[key], value_text(key, one), one.verdict + (f": {one.note}" if one.note else ""))
        for key, one in calibration.parameters.items()
    ]
    table = Table("l", rows, ("parameter", "value ± std", "verdict"))
    return [Section(calibration.log, [Facts(head), table, MEANINGS, ""], VERBOSE), *setting_blocks(calibration)]


def value_text(key: str, one: SensorParameter) -> str:
    """Return value and standard deviation of a parameter with their unit; a dash where there is none."""
    if one.value is None:
        return "–"
    digits, unit = next(form for ending, form in DIGITS.items() if key.endswith(ending))
    number = f"{one.value:+.{digits}f}" if not key.endswith("scale") else f"{one.value:.{digits}f}"
    spread = f" ± {one.std:.{digits}f}" if one.verdict != "given" else ""
    return f"{number}{spread} {unit}".rstrip()


def setting_blocks(calibration: SensorDocument) -> list[Block]:
    """Return the settings that one log proposes."""
    if not calibration.settings:
        shown = any(one.verdict == "shown" for one in calibration.parameters.values())
        why = "the drive confirms the configuration" if shown else "the drive showed nothing well enough"
        return [f"nothing to configure: {why}"]
    # an option and its value stay together
    options = " ".join(f"--set\u00a0{key}={value:g}" for key, value in calibration.settings.items())
    lines = textwrap.wrap(options, OPTIONS_WIDTH, break_long_words=False, break_on_hyphens=False)
    # a shell joins the lines again
    joined = " \\\n  ".join(lines).replace("\u00a0", " ")
    return [Line(f"to configure:\n  {joined}", "as is")]
