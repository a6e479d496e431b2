"""What the alignment of one log shows of its sensors: verdict, reason and setting for each of its findings.

The numbers are those of the run (``alignment`` in run.json), so that `fit` and `calibrate` cannot disagree. Positions
show only antenna forward - x ICR and antenna right - middle of the ICRs: an antenna further ahead has the same effect
as ICRs further back. One of both has to be known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icrtool.calibration.run_recording import known_antenna_m
from icrtool.errors import DataError
from icrtool.estimation.observability import TURNS_NEEDED_RAD, lacking_turns
from icrtool.records.calibration_document import (
    CALIBRATION_SCHEMA,
    SensorDocument,
    SensorDrive,
    SensorParameter,
    SensorVerdict,
)
from icrtool.records.measurements import RESPONSE_S
from icrtool.records.plain_data import known
from icrtool.records.run import Run
from icrtool.records.samples import InputFile


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


@dataclass(frozen=True, slots=True)
class Parameter:
    """One estimated parameter and its verdict.

    Attributes
    ----------
    key : name with unit, as in calibration.json
    value, std : in the unit of the key; NaN where not determined
    verdict : ``shown``, ``weak``, ``not shown`` by this drive, ``not separable`` by any, ``given`` by the user
    note : why, or under which assumption
    """

    key: str
    label: str
    value: float
    std: float
    verdict: SensorVerdict
    note: str


@dataclass(frozen=True, slots=True)
class Setting:
    """A line for a configuration: ``--set key=value``."""

    key: str
    value: float
    why: str


class DriveFacts(NamedTuple):
    """Turns, speeds and distance of a drive; speeds are those while moving."""

    distance_m: float
    turned_right_deg: float
    turned_left_deg: float
    turn_rate_p95_degps: float
    speed_mean_mps: float
    speed_std_mps: float


@dataclass(frozen=True, slots=True)
class LogCalibration:
    """The calibration of one log's sensors.

    Attributes
    ----------
    parameters : the estimates, then those derived from them
    settings : configuration lines that are worth setting, in order
    windows, stretches : windows of driven distance, and how many count as independent
    residual_m : robust standard deviation of their displacements
    """

    name: str
    parameters: tuple[Parameter, ...]
    settings: tuple[Setting, ...]
    windows: int
    stretches: int
    residual_m: float
    facts: DriveFacts
    inputs: tuple[InputFile, ...]

    def parameter(self, key: str) -> Parameter:
        """Return a parameter by its key."""
        return next(one for one in self.parameters if one.key == key)

    def document(self) -> SensorDocument:
        """Return what calibration.json holds of the log."""
        shown = {
            one.key: SensorParameter(known(one.value), known(one.std), one.verdict, one.note) for one in self.parameters
        }
        return SensorDocument(
            schema=CALIBRATION_SCHEMA,
            log=self.name,
            inputs=self.inputs,
            windows=self.windows,
            independent_stretches=self.stretches,
            window_miss_m=known(self.residual_m),
            drive=SensorDrive(*map(known, self.facts)),
            settings={setting.key: setting.value for setting in self.settings},
            alignment=shown,
            parameters=shown,
        )


def calibrate_log(run: Run, *, x_icr_m: float | None = None) -> LogCalibration:
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
    facts = _drive_facts(run)
    direct = tuple(_parameter(run, kind, facts) for kind in KINDS)
    parameters = (*direct, *_derive(run, direct, x_icr_m))
    return LogCalibration(
        name=run.name, parameters=parameters, settings=_settings(parameters, run), windows=wheels.windows,
        stretches=wheels.stretches, residual_m=wheels.residual_m if wheels.residual_m is not None else math.nan,
        facts=facts,
        inputs=run.document.inputs,
    )  # fmt: skip


def _drive_facts(run: Run) -> DriveFacts:
    table, excitation = run.table, run.document.excitation
    left, right = (
        speed / scale for speed, scale in zip((table.v_left_mps, table.v_right_mps), run.wheel_scales, strict=True)
    )
    moving = np.abs(left) + np.abs(right) > MOVING_MPS
    speed = (left + right)[moving] / 2
    rate = np.degrees(np.abs(left - right)[moving] / max(_finding(run, SEPARATION.finding)[0], 1e-3))
    turning = rate[rate > TURNING_DEGPS]
    return DriveFacts(
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


def _parameter(run: Run, kind: _Kind, facts: DriveFacts) -> Parameter:
    """Return one estimate with a verdict by its standard deviation, and the reason if it is not "shown"."""
    value, std = _finding(run, kind.finding)
    verdict: SensorVerdict = "not shown"
    if std <= kind.useful:
        verdict = "shown"
    elif std <= WEAK * kind.useful:
        verdict = "weak"
    note = "" if verdict == "shown" else _reason(kind, facts)
    if kind.key in DELAYS and verdict == "shown":
        note = RESPONSE_PART
    return Parameter(kind.key, kind.label, value, std, verdict, note)


def _reason(kind: _Kind, facts: DriveFacts) -> str:
    """Return why the drive does not determine a parameter well, and what to drive."""
    if kind.key.startswith("gnss_delay") and facts.speed_std_mps < STEADY * facts.speed_mean_mps:
        return (
            f"speed hardly changes ({facts.speed_mean_mps:.2f} ± {facts.speed_std_mps:.2f} m/s): add stops and starts"
        )
    right, left = math.radians(facts.turned_right_deg), math.radians(facts.turned_left_deg)
    lacks = lacking_turns(right, left)
    if lacks and (kind.key not in SHOWN_STRAIGHT or right + left >= TURNS_NEEDED_RAD):
        return lacks
    if kind.key in DELAYS:
        return RESPONSE_PART
    return f"too short a drive for this noise: {facts.distance_m:.0f} m"


def _derive(run: Run, direct: tuple[Parameter, ...], x_icr_m: float | None) -> tuple[Parameter, ...]:
    """Return antenna and ICRs, as far as one of them is known; else the middle of the ICRs is assumed at y = 0."""
    by_key = {one.key: one for one in direct}
    ahead, aside, separation = (by_key[kind.key] for kind in (AHEAD, ASIDE, SEPARATION))
    forward, right = known_antenna_m(run)
    fix = "position determines only antenna forward − x ICR: give frames.antenna_forward_m, or --x-icr"
    found = []
    if forward is not None:
        found.append(Parameter("antenna_forward_m", "antenna forward", forward, 0.0, "given", ""))
        x = Parameter("x_icr_m", "x ICR", forward - ahead.value, ahead.std, ahead.verdict, "with the antenna as given")
    elif x_icr_m is not None:
        note = f"with x ICR at {x_icr_m:+.3f} m, as given"
        place = ahead.value + x_icr_m
        found.append(Parameter("antenna_forward_m", "antenna forward", place, ahead.std, ahead.verdict, note))
        x = Parameter("x_icr_m", "x ICR", x_icr_m, 0.0, "given", "")
    else:
        found.append(Parameter("antenna_forward_m", "antenna forward", math.nan, math.nan, "not separable", fix))
        x = Parameter("x_icr_m", "x ICR", math.nan, math.nan, "not separable", fix)
    if right is not None:
        found.append(Parameter("antenna_right_m", "antenna right", right, 0.0, "given", ""))
        middle, note = right - aside.value, "with the antenna as given"
        stds = [_finding(run, name)[1] for name in ("y_icr_right_m", "y_icr_left_m")]
        verdict = max((separation.verdict, aside.verdict), key=("given", "shown", "weak", "not shown").index)
    else:
        middle, note = 0.0, "if the ICRs lie symmetrically about the middle of the body"
        found.append(Parameter("antenna_right_m", "antenna right", aside.value, aside.std, aside.verdict, note))
        stds, verdict = [separation.std / 2] * 2, separation.verdict
    half = separation.value / 2
    return (
        *found,
        Parameter("y_icr_right_m", "y ICR right", middle + half, stds[0], verdict, note),
        Parameter("y_icr_left_m", "y ICR left", middle - half, stds[1], verdict, note),
        x,
    )


def _settings(parameters: tuple[Parameter, ...], run: Run) -> tuple[Setting, ...]:
    """Return the settings of parameters that are known well enough, and are large enough, to be configured."""
    by_key = {one.key: one for one in parameters}
    settings = []

    def add(key: str, one: Parameter, *, neutral: float, least: float, times: float = 1.0, why: str = "") -> None:
        if one.verdict == "shown" and abs(one.value - neutral) > max(SETTING_SIGMAS * one.std, least):
            settings.append(Setting(key, round(times * one.value, 4), why or one.note))

    add("frames.heading_offset_deg", by_key["heading_offset_deg"], neutral=0.0, least=0.3)
    for key, name in (("frames.reference_delay_s", "gnss_delay_s"), ("frames.heading_delay_s", "heading_delay_s")):
        # a stream that seems to lead shows a robot that follows its wheels with a delay
        if by_key[name].value > 0.0:
            add(key, by_key[name], neutral=0.0, least=RESPONSE_S, why=by_key[name].label)
    add("frames.antenna_forward_m", by_key["antenna_forward_m"], neutral=0.0, least=0.02)
    add("frames.antenna_right_m", by_key["antenna_right_m"], neutral=0.0, least=0.02)
    wheels = run.config.wheels
    for side, given in (("left", wheels.left_scale), ("right", wheels.right_scale)):
        times = 1.0 if given == "auto" else given
        add(f"wheels.{side}_scale", by_key[f"{side}_scale"], neutral=1.0, least=0.005, times=times)
    return tuple(settings)
