"""What the alignment of one log shows of its sensors: verdict, reason and setting for each of its findings.

The numbers are those of the run (``alignment`` in run.json), so that `fit` and `calibrate` cannot disagree. Positions
show only antenna forward - x ICR and antenna right - middle of the ICRs: an antenna further ahead has the same effect
as ICRs further back. One of both has to be known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from icrtool.calibration.pooled import known_antenna_m
from icrtool.calibration.record import Calibration
from icrtool.errors import DataError
from icrtool.estimation.observability import TURNS_NEEDED_RAD, lacking_turns
from icrtool.records.calibration_document import (
    CALIBRATION_SCHEMA,
    CalibrationFile,
    SensorDocument,
    SensorDrive,
    SensorParameter,
    SensorVerdict,
)
from icrtool.records.measurements import RESPONSE_S
from icrtool.records.plain_data import known
from icrtool.records.run import Run


class _Kind(NamedTuple):
    """A parameter: its key in files, its name in run.json, words for it, and a useful standard deviation."""

    key: str
    finding: str
    label: str
    useful: float


AHEAD = _Kind("antenna_forward_minus_x_icr_m", "antenna_forward_minus_x_icr_m", "antenna forward − x ICR", 0.03)
ASIDE = _Kind(
    "antenna_right_minus_icr_middle_m", "antenna_right_minus_icr_middle_m", "antenna right − middle of the ICRs", 0.03
)
SEPARATION = _Kind("icr_separation_m", "icr_separation_m", "ICR separation y right − y left", 0.05)
KINDS = (
    AHEAD,
    ASIDE,
    _Kind("heading_offset_deg", "heading_offset_deg", "heading offset", 1.0),
    _Kind("gnss_delay_s", "position_delay_s", "position lags the wheels by", 0.05),
    _Kind("heading_delay_s", "heading_delay_s", "heading lags the wheels by", 0.05),
    _Kind("gnss_delay_against_heading_s", "position_delay_against_heading_s", "position lags the heading by", 0.03),
    _Kind("left_scale", "left_scale", "left wheel scale", 0.01),
    _Kind("right_scale", "right_scale", "right wheel scale", 0.01),
    SEPARATION,
)
WEAK = 3.0
"""A standard deviation up to so many times the useful one is weak; above it, the drive does not show the parameter."""

SHOWN_STRAIGHT = ("left_scale", "right_scale", "gnss_delay_s", "heading_offset_deg")
"""What driving straight on shows."""

DELAYS = ("gnss_delay_s", "heading_delay_s", "gnss_delay_against_heading_s")
RESPONSE_PART = "the robot's own response to its wheels is part of it"

STEADY = 0.15
"""A speed is steady where its standard deviation is less than this share of its mean."""

MOVING_MPS, TURNING_DEGPS = 0.05, 2.0

SETTING_SIGMAS = 3.0


LABELS = {kind.key: kind.label for kind in KINDS} | {
    "antenna_forward_m": "antenna forward", "antenna_right_m": "antenna right", "y_icr_right_m": "y ICR right",
    "y_icr_left_m": "y ICR left", "x_icr_m": "x ICR",
}  # fmt: skip
"""Words for each parameter, by its key in files."""


def calibrate_log(run: Run, *, x_icr_m: float | None = None) -> SensorDocument:
    """Return the findings of a run's alignment with their verdicts, and the settings to configure.

    Parameters
    ----------
    x_icr_m : known forward position of the ICRs; resolves the antenna's position

    Raises
    ------
    DataError
        The drive is too short for an estimate.
    """
    wheels, drive = run.document.wheels, run.document.drive
    if not {kind.finding for kind in KINDS} <= run.document.alignment.keys():
        why = f"{drive.distance_m:.0f} m of driven distance are too few windows, or an older version made the run"
        raise DataError(run.name, why, "drive longer, or fit the log again")
    driven = _drive(run)
    direct = {kind.key: _direct(run, kind, driven) for kind in KINDS}
    parameters = direct | _derive(run, direct, x_icr_m)
    return SensorDocument(
        schema=CALIBRATION_SCHEMA, log=run.name, inputs=run.document.inputs, windows=wheels.windows,
        independent_stretches=wheels.stretches, window_miss_m=wheels.residual_m, drive=driven,
        settings=_settings(parameters, run), alignment=parameters, parameters=parameters,
    )  # fmt: skip


def with_sensors(calibration: Calibration, sensors: SensorDocument) -> Calibration:
    """Return a calibration with what its only log shows of its sensors."""
    return replace(calibration, **{name: getattr(sensors, name) for name in CalibrationFile.__struct_fields__[1:]})


def _drive(run: Run) -> SensorDrive:
    table, excitation = run.table, run.document.excitation
    left, right = (
        speed / scale for speed, scale in zip((table.v_left_mps, table.v_right_mps), run.wheel_scales, strict=True)
    )
    moving = np.abs(left) + np.abs(right) > MOVING_MPS
    speed = (left + right)[moving] / 2
    rate = np.degrees(np.abs(left - right)[moving] / max(_finding(run, SEPARATION.finding)[0], 1e-3))
    turning = rate[rate > TURNING_DEGPS]
    return SensorDrive(
        run.document.drive.distance_m,
        excitation.turned_right_deg,
        excitation.turned_left_deg,
        float(np.percentile(turning, 95)) if len(turning) else 0.0,
        float(np.abs(speed).mean()) if len(speed) else 0.0,
        float(speed.std()) if len(speed) else 0.0,
    )


def _finding(run: Run, name: str) -> tuple[float, float]:
    """Return value and standard deviation of an estimate of the alignment, NaN where the drive does not show it."""
    found = run.document.alignment[name]
    value, std = found.value, found.std
    return math.nan if value is None else value, math.nan if std is None else std


def _direct(run: Run, kind: _Kind, driven: SensorDrive) -> SensorParameter:
    """Return one estimate with a verdict by its standard deviation, and the reason if it is not "shown"."""
    value, std = _finding(run, kind.finding)
    verdict: SensorVerdict = "not shown"
    if std <= kind.useful:
        verdict = "shown"
    elif std <= WEAK * kind.useful:
        verdict = "weak"
    note = "" if verdict == "shown" else _reason(kind, driven)
    if kind.key in DELAYS and verdict == "shown":
        note = RESPONSE_PART
    return _parameter(value, std, verdict, note)


def _parameter(value: float, std: float, verdict: SensorVerdict, note: str = "") -> SensorParameter:
    return SensorParameter(known(value), known(std), verdict, note)


def _reason(kind: _Kind, driven: SensorDrive) -> str:
    """Return why the drive does not determine a parameter well, and what to drive."""
    if kind.key.startswith("gnss_delay") and driven.speed_std_mps < STEADY * driven.speed_mean_mps:
        return (
            f"speed hardly changes ({driven.speed_mean_mps:.2f} ± {driven.speed_std_mps:.2f} m/s): add stops and starts"
        )
    right, left = math.radians(driven.turned_right_deg), math.radians(driven.turned_left_deg)
    lacks = lacking_turns(right, left)
    if lacks and (kind.key not in SHOWN_STRAIGHT or right + left >= TURNS_NEEDED_RAD):
        return lacks
    if kind.key in DELAYS:
        return RESPONSE_PART
    return f"too short a drive for this noise: {driven.distance_m:.0f} m"


def _derive(run: Run, direct: Mapping[str, SensorParameter], x_icr_m: float | None) -> dict[str, SensorParameter]:
    """Return antenna and ICRs, as far as one of them is known; else the middle of the ICRs is assumed at y = 0."""
    (ahead, ahead_std), (aside, aside_std), (separation, separation_std) = (
        _finding(run, kind.finding) for kind in (AHEAD, ASIDE, SEPARATION)
    )
    of_ahead, of_aside, of_separation = (direct[kind.key].verdict for kind in (AHEAD, ASIDE, SEPARATION))
    forward, right = known_antenna_m(run)
    if forward is not None:
        antenna_forward = _parameter(forward, 0.0, "given")
        x = _parameter(forward - ahead, ahead_std, of_ahead, "with the antenna as given")
    elif x_icr_m is not None:
        note = f"with x ICR at {x_icr_m:+.3f} m, as given"
        antenna_forward = _parameter(ahead + x_icr_m, ahead_std, of_ahead, note)
        x = _parameter(x_icr_m, 0.0, "given")
    else:
        fix = "position determines only antenna forward − x ICR: give frames.antenna_forward_m, or --x-icr"
        antenna_forward = x = _parameter(math.nan, math.nan, "not separable", fix)
    if right is not None:
        antenna_right = _parameter(right, 0.0, "given")
        middle, note = right - aside, "with the antenna as given"
        stds = [_finding(run, name)[1] for name in ("y_icr_right_m", "y_icr_left_m")]
        verdict = max((of_separation, of_aside), key=("given", "shown", "weak", "not shown").index)
    else:
        middle, note = 0.0, "if the ICRs lie symmetrically about the middle of the body"
        antenna_right = _parameter(aside, aside_std, of_aside, note)
        stds, verdict = [separation_std / 2] * 2, of_separation
    half = separation / 2
    return {
        "antenna_forward_m": antenna_forward,
        "antenna_right_m": antenna_right,
        "y_icr_right_m": _parameter(middle + half, stds[0], verdict, note),
        "y_icr_left_m": _parameter(middle - half, stds[1], verdict, note),
        "x_icr_m": x,
    }


def _settings(parameters: Mapping[str, SensorParameter], run: Run) -> dict[str, float]:
    """Return the settings of parameters that are known well enough, and are large enough, to be configured."""
    settings = {}

    def add(key: str, name: str, *, neutral: float, least: float, times: float = 1.0) -> None:
        one = parameters[name]
        if one.verdict != "shown" or one.value is None or one.std is None:
            return
        if abs(one.value - neutral) > max(SETTING_SIGMAS * one.std, least):
            settings[key] = round(times * one.value, 4)

    add("frames.heading_offset_deg", "heading_offset_deg", neutral=0.0, least=0.3)
    for key, name in (("frames.reference_delay_s", "gnss_delay_s"), ("frames.heading_delay_s", "heading_delay_s")):
        # a stream that seems to lead shows a robot that follows its wheels with a delay
        if (parameters[name].value or 0.0) > 0.0:
            add(key, name, neutral=0.0, least=RESPONSE_S)
    add("frames.antenna_forward_m", "antenna_forward_m", neutral=0.0, least=0.02)
    add("frames.antenna_right_m", "antenna_right_m", neutral=0.0, least=0.02)
    wheels = run.config.wheels
    for side, given in (("left", wheels.left_scale), ("right", wheels.right_scale)):
        times = 1.0 if given == "auto" else given
        add(f"wheels.{side}_scale", f"{side}_scale", neutral=1.0, least=0.005, times=times)
    return settings
