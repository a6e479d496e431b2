"""Findings of the alignment of one log about its sensors: verdict, reason and proposed setting of each.

The numbers are taken from the run (``alignment`` in run.json), so that `fit` and `calibrate` cannot disagree. Positions
show only the differences antenna forward - x ICR and antenna right - middle of the ICRs, because an antenna further
ahead has the same effect as ICRs further back. If the position of the antenna or of the ICRs is known, the other
follows.
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
from icrtool.records import calibration_document as documents
from icrtool.records.measurements import LONGEST_RESPONSE_S, AlignmentEstimate
from icrtool.records.plain_data import finite_or_none
from icrtool.records.run import Run


class _Kind(NamedTuple):
    """A parameter of a sensor.

    Attributes
    ----------
    label : words for the parameter
    useful : largest standard deviation with which the estimate is useful, in its unit
    finding : name of the parameter in run.json; empty if it is the key
    """

    label: str
    useful: float
    finding: str = ""


ANTENNA_AHEAD, ANTENNA_ASIDE, SEPARATION = (
    "antenna_forward_minus_x_icr_m",
    "antenna_right_minus_icr_middle_m",
    "icr_separation_m",
)
"""Keys of the estimates that the positions of antenna and ICRs are derived from."""

FINDING_KINDS = {
    ANTENNA_AHEAD: _Kind("antenna forward − x ICR", 0.03),
    ANTENNA_ASIDE: _Kind("antenna right − middle of the ICRs", 0.03),
    "heading_offset_deg": _Kind("heading offset", 1.0),
    "gnss_delay_s": _Kind("position lags the wheels by", 0.05, "position_delay_s"),
    "heading_delay_s": _Kind("heading lags the wheels by", 0.05),
    "gnss_delay_against_heading_s": _Kind("position lags the heading by", 0.03, "position_delay_against_heading_s"),
    "left_scale": _Kind("left wheel scale", 0.01),
    "right_scale": _Kind("right wheel scale", 0.01),
    SEPARATION: _Kind("ICR separation y right − y left", 0.05),
}
"""Every parameter by its key in calibration files."""

WEAK = 3.0
"""Ratio of a standard deviation to the useful one above which a parameter is not shown. From 1 on it is weak."""

SHOWN_STRAIGHT = ("left_scale", "right_scale", "gnss_delay_s", "heading_offset_deg")
"""Keys of the parameters that a straight drive shows."""

DELAYS = ("gnss_delay_s", "heading_delay_s", "gnss_delay_against_heading_s")
"""Keys of the delays."""

RESPONSE_PART = "the robot's own response to its wheels is part of it"
"""Note on a delay that is known well."""

STEADY = 0.15
"""Ratio of a speed's standard deviation to its mean below which the speed counts as steady."""

MOVING_MPS, TURNING_DEGPS = 0.05, 2.0
"""Speed of both sides above which a robot moves [m/s], and turn rate above which it turns [deg/s]."""

SETTING_SIGMAS = 3.0
"""Smallest difference of a proposed setting from its neutral value, in standard deviations."""


LABELS = {key: finding_kind.label for key, finding_kind in FINDING_KINDS.items()} | {
    "antenna_forward_m": "antenna forward", "antenna_right_m": "antenna right", "y_icr_right_m": "y ICR right",
    "y_icr_left_m": "y ICR left", "x_icr_m": "x ICR",
}  # fmt: skip
"""Words for each parameter by its key in calibration files."""


def calibrate_log(run: Run, *, x_icr_m: float | None = None) -> documents.SensorDocument:
    """Return the findings of a run's alignment with their verdicts, and the proposed settings.

    Parameters
    ----------
    x_icr_m : forward position of the ICRs [m], if it is known; the position of the antenna follows from it

    Raises
    ------
    DataError
        The drive is too short for an estimate.
    """
    wheels, findings = run.document.wheels, run.document.alignment
    if not {finding_kind.finding or key for key, finding_kind in FINDING_KINDS.items()} <= findings.keys():
        distance_m = run.document.drive.distance_m
        why = f"{distance_m:.0f} m of driven distance give too few windows"
        raise DataError(run.name, why, "drive longer")
    driven, parameters = _drive(run), {}
    for key, finding_kind in FINDING_KINDS.items():
        value, std = _numbers(findings[finding_kind.finding or key])
        verdict: documents.SensorVerdict = "not shown"
        if std <= WEAK * finding_kind.useful:
            verdict = "shown" if std <= finding_kind.useful else "weak"
        note = RESPONSE_PART if key in DELAYS else ""
        if verdict != "shown":
            note = _reason(key, driven)
        parameters[key] = _parameter(value, std, verdict, note)
    parameters |= _derive(run, parameters, x_icr_m)
    return documents.SensorDocument(
        schema=documents.CALIBRATION_SCHEMA, log=run.name, inputs=run.document.inputs, windows=wheels.windows,
        independent_stretches=wheels.stretches, window_miss_m=wheels.residual_m, drive=driven,
        settings=_settings(parameters, run), alignment=parameters, parameters=parameters,
    )  # fmt: skip


def with_sensors(calibration: Calibration, sensors: documents.SensorDocument) -> Calibration:
    """Return a calibration with the sensor findings of its only log."""
    return replace(
        calibration, **{name: getattr(sensors, name) for name in documents.CalibrationFile.__struct_fields__[1:]}
    )


def _drive(run: Run) -> documents.SensorDrive:
    """Return distance, turns, usual turn rate and speed of a drive."""
    table, excitation = run.table, run.document.excitation
    left, right = (
        speed / scale for speed, scale in zip((table.v_left_mps, table.v_right_mps), run.wheel_scales, strict=True)
    )
    moving = np.abs(left) + np.abs(right) > MOVING_MPS
    speed = (left + right)[moving] / 2
    rate = np.degrees(np.abs(left - right)[moving] / max(_numbers(run.document.alignment[SEPARATION])[0], 1e-3))
    turning = rate[rate > TURNING_DEGPS]
    return documents.SensorDrive(
        run.document.drive.distance_m,
        excitation.turned_right_deg,
        excitation.turned_left_deg,
        float(np.percentile(turning, 95)) if len(turning) else 0.0,
        float(np.abs(speed).mean()) if len(speed) else 0.0,
        float(speed.std()) if len(speed) else 0.0,
    )


def _numbers(estimate: AlignmentEstimate | documents.SensorParameter) -> tuple[float, float]:
    """Return an estimate and its standard deviation; NaN if the drive does not show them."""
    return math.nan if estimate.value is None else estimate.value, math.nan if estimate.std is None else estimate.std


def _parameter(value: float, std: float, verdict: documents.SensorVerdict, note: str = "") -> documents.SensorParameter:
    """Return a parameter; a number that is not finite becomes None."""
    return documents.SensorParameter(finite_or_none(value), finite_or_none(std), verdict, note)


def _reason(key: str, driven: documents.SensorDrive) -> str:
    """Return why the drive does not show a parameter well, and what to drive."""
    mean, std = driven.speed_mean_mps, driven.speed_std_mps
    if key.startswith("gnss_delay") and std < STEADY * mean:
        return f"the speed hardly changes ({mean:.2f} ± {std:.2f} m/s): add stops and starts"
    right, left = math.radians(driven.turned_right_deg), math.radians(driven.turned_left_deg)
    lacks = lacking_turns(right, left)
    if lacks and (key not in SHOWN_STRAIGHT or right + left >= TURNS_NEEDED_RAD):
        return lacks
    if key in DELAYS:
        return RESPONSE_PART
    return f"the drive of {driven.distance_m:.0f} m is too short for this noise"


def _derive(
    run: Run, direct: Mapping[str, documents.SensorParameter], x_icr_m: float | None
) -> dict[str, documents.SensorParameter]:
    """Return the positions of antenna and ICRs; the ICRs' middle is y = 0 unless the antenna's position is known.

    Parameters
    ----------
    direct : the parameters that positions show directly
    x_icr_m : known forward position of the ICRs [m]; None: not known
    """
    measured = [direct[key] for key in (ANTENNA_AHEAD, ANTENNA_ASIDE, SEPARATION)]
    (ahead, ahead_std), (aside, aside_std), (separation, separation_std) = map(_numbers, measured)
    ahead_verdict, aside_verdict, separation_verdict = (parameter.verdict for parameter in measured)
    forward, right = known_antenna_m(run)
    if forward is not None:
        antenna_forward = _parameter(forward, 0.0, "given")
        x = _parameter(forward - ahead, ahead_std, ahead_verdict, "with the antenna as given")
    elif x_icr_m is not None:
        note = f"with x ICR at {x_icr_m:+z.3f} m, as given"
        antenna_forward = _parameter(ahead + x_icr_m, ahead_std, ahead_verdict, note)
        x = _parameter(x_icr_m, 0.0, "given")
    else:
        fix = "positions show only antenna forward − x ICR: give frames.antenna_forward_m, or --x-icr"
        antenna_forward = x = _parameter(math.nan, math.nan, "not separable", fix)
    if right is not None:
        antenna_right = _parameter(right, 0.0, "given")
        middle, note = right - aside, "with the antenna as given"
        stds = [_numbers(run.document.alignment[name])[1] for name in ("y_icr_right_m", "y_icr_left_m")]
        verdict = max((separation_verdict, aside_verdict), key=("given", "shown", "weak", "not shown").index)
    else:
        middle, note = 0.0, "if the ICRs are symmetric about the middle of the body"
        antenna_right = _parameter(aside, aside_std, aside_verdict, note)
        stds, verdict = [separation_std / 2] * 2, separation_verdict
    half = separation / 2
    return {
        "antenna_forward_m": antenna_forward,
        "antenna_right_m": antenna_right,
        "y_icr_right_m": _parameter(middle + half, stds[0], verdict, note),
        "y_icr_left_m": _parameter(middle - half, stds[1], verdict, note),
        "x_icr_m": x,
    }


def _settings(parameters: Mapping[str, documents.SensorParameter], run: Run) -> dict[str, float]:
    """Return the proposed settings: of parameters that are shown, and that differ from their neutral value."""
    wheels = run.config.wheels
    left, right = (1.0 if given == "auto" else given for given in (wheels.left_scale, wheels.right_scale))
    # The columns are: setting, parameter, neutral value, smallest difference from it, and the present value, which the
    # estimate multiplies.
    rows = (
        ("frames.heading_offset_deg", "heading_offset_deg", 0.0, 0.3, 1.0),
        ("frames.reference_delay_s", "gnss_delay_s", 0.0, LONGEST_RESPONSE_S, 1.0),
        ("frames.heading_delay_s", "heading_delay_s", 0.0, LONGEST_RESPONSE_S, 1.0),
        ("frames.antenna_forward_m", "antenna_forward_m", 0.0, 0.02, 1.0),
        ("frames.antenna_right_m", "antenna_right_m", 0.0, 0.02, 1.0),
        ("wheels.left_scale", "left_scale", 1.0, 0.005, left),
        ("wheels.right_scale", "right_scale", 1.0, 0.005, right),
    )
    settings = {}
    for key, name, neutral, least, times in rows:
        value, std = _numbers(parameters[name])
        large = abs(value - neutral) > max(SETTING_SIGMAS * std, least)
        # If a stream seems to lead, the robot's motion lags its wheels, and no setting is proposed.
        leads = name in DELAYS and value <= 0.0
        if parameters[name].verdict == "shown" and large and not leads:
            settings[key] = round(times * value, 4)
    return settings
