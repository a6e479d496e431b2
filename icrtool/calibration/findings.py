"""Verdicts on estimated parameters: which ones the drive determines, why not the others, and what to configure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from icrtool.alignment.corrections import align_streams
from icrtool.alignment.wheel_units import with_wheel_speeds
from icrtool.calibration.calibrate import NAMES, PRIOR_STD, Estimate, WindowResiduals, estimate
from icrtool.calibration.evidence import DriveFacts
from icrtool.config import Config
from icrtool.records.tables import RobotLog

CALIBRATION_SCHEMA = "icrtool/calibration/1"

Verdict = Literal["shown", "weak", "not shown", "not separable", "given"]

USEFUL = {
    "ahead": 0.03, "aside": 0.03, "offset": math.radians(0.5), "gnss_delay": 0.05, "heading_delay": 0.05,
    "gnss_after_heading": 0.05, "left_scale": 0.01, "right_scale": 0.01, "separation": 0.05,
}  # fmt: skip
"""A standard deviation up to this is worth configuring [m, rad, s, 1]; up to three times this, weak."""

PRIOR_SHARE = 0.7
"""With a standard deviation above this share of the prior's, the drive does not determine the parameter."""

SCALES = ("left_scale", "right_scale")

LABELS = {
    "ahead": "antenna forward − x ICR",
    "aside": "antenna right − middle of the ICRs",
    "offset": "heading offset",
    "gnss_delay": "position lags the wheels by",
    "heading_delay": "heading lags the wheels by",
    "gnss_after_heading": "position lags the heading by",
    "left_scale": "left wheel scale",
    "right_scale": "right wheel scale",
    "separation": "ICR separation y right − y left",
}
KEYS = {
    "ahead": "antenna_forward_minus_x_icr_m",
    "aside": "antenna_right_minus_icr_middle_m",
    "offset": "heading_offset_deg",
    "gnss_delay": "gnss_delay_s",
    "heading_delay": "heading_delay_s",
    "gnss_after_heading": "gnss_delay_against_heading_s",
    "left_scale": "left_scale",
    "right_scale": "right_scale",
    "separation": "icr_separation_m",
}

TURNS_NEEDED_RAD = math.pi
ONE_SIDED = 0.15
"""Turns are one-sided where those in the other direction sum to less than this share."""

STEADY = 0.15
"""A speed is steady where its standard deviation is less than this share of its mean."""

RESPONSE_S = 0.1
"""The robot's own response to its wheels looks like a delay of up to this [s], by simulations with equal clocks."""


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
    verdict: Verdict
    note: str


@dataclass(frozen=True, slots=True)
class Setting:
    """A line for a configuration: ``--set key=value``."""

    key: str
    value: float
    why: str


@dataclass(frozen=True, slots=True)
class Calibration:
    """The calibration of one log.

    Attributes
    ----------
    findings : the estimated parameters, then those derived from them
    settings : configuration lines that are worth setting, in order
    """

    name: str
    findings: tuple[Parameter, ...]
    settings: tuple[Setting, ...]
    windows: int
    stretches: int
    miss_m: float
    facts: DriveFacts
    inputs: tuple[dict[str, Any], ...]
    residuals: WindowResiduals

    def finding(self, key: str) -> Parameter:
        """Return a parameter by its key."""
        return next(finding for finding in self.findings if finding.key == key)

    def summary(self) -> dict[str, Any]:
        """Return plain data for calibration.json."""
        return {
            "schema": CALIBRATION_SCHEMA,
            "log": self.name,
            "inputs": list(self.inputs),
            "windows": self.windows,
            "independent_stretches": self.stretches,
            "window_miss_m": self.miss_m,
            "drive": {
                "way_m": self.facts.distance_m,
                "turned_right_deg": math.degrees(self.facts.turned_right_rad),
                "turned_left_deg": math.degrees(self.facts.turned_left_rad),
                "turn_rate_p95_degps": math.degrees(self.facts.fastest_turn_radps),
                "speed_mean_mps": self.facts.speed_mps,
                "speed_std_mps": self.facts.speed_std_mps,
            },
            "parameters": {
                finding.key: {
                    "value": finding.value,
                    "std": finding.std,
                    "verdict": finding.verdict,
                    "note": finding.note,
                }
                for finding in self.findings
            },
            "settings": {setting.key: setting.value for setting in self.settings},
        }


def calibrate(log: RobotLog, config: Config | None = None, *, x_icr_m: float | None = None) -> Calibration:
    """Return the parameters of one log with their verdicts, and the settings to configure.

    Parameters
    ----------
    log : as `icrtool.read_log` returns it
    config : default: all defaults; an antenna place given there, or by the log's transforms, resolves the ICRs
    x_icr_m : known forward position of the ICRs; resolves the antenna's position

    Raises
    ------
    DataError
        Too short a drive, or streams that cannot be used together.
    """
    config = config if config is not None else Config()
    log = with_wheel_speeds(log, config)
    aligned = align_streams(log, config)
    checked = aligned.wheels
    found = estimate(aligned.as_named, config)
    factors = np.ones(len(NAMES))
    factors[[NAMES.index(name) for name in SCALES]] = checked.applied
    factors[NAMES.index("offset")] = -1.0
    found = replace(found, values=found.values * factors)
    direct = tuple(_verdict(found, name) for name in NAMES)
    derived = _derive(found, direct, _known_antenna(log, config), x_icr_m)
    return Calibration(
        name=log.name,
        findings=(*direct, *derived),
        settings=_settings((*direct, *derived), config),
        windows=found.windows,
        stretches=found.stretches,
        miss_m=found.miss_m,
        facts=found.facts,
        inputs=tuple({"path": one.path, "bytes": one.bytes, "sha256": one.sha256} for one in log.inputs),
        residuals=found.residuals,
    )


def _verdict(found: Estimate, name: str) -> Parameter:
    """Return one estimated parameter with a verdict by its standard deviation, and the reason if it is not "shown"."""
    i = NAMES.index(name)
    value, std = float(found.values[i]), float(found.std[i])
    verdict: Verdict = "shown"
    if std > min(3.0 * USEFUL[name], PRIOR_SHARE * float(PRIOR_STD[i])):
        verdict = "not shown"
    elif std > USEFUL[name]:
        verdict = "weak"
    note = "" if verdict == "shown" else _reason(found, name)
    if name in {"gnss_delay", "heading_delay"} and verdict == "shown":
        note = f"the robot's own response is in it: up to ± {RESPONSE_S:g} s where the clocks agree"
    unit = math.degrees(1.0) if name == "offset" else 1.0
    return Parameter(KEYS[name], LABELS[name], unit * value, unit * std, verdict, note)


def _reason(found: Estimate, name: str) -> str:
    """Return the reason why the drive does not determine a parameter well, as text."""
    facts = found.facts
    right, left = facts.turned_right_rad, facts.turned_left_rad
    total = right + left
    if name not in {"left_scale", "right_scale", "gnss_delay", "offset"} and total < TURNS_NEEDED_RAD:
        return (
            f"hardly any turns ({math.degrees(total):.0f}° in all, {math.degrees(facts.fastest_turn_radps):.0f} deg/s):"
            " add two spins or tight circles in each direction"
        )
    if name in {"gnss_delay", "gnss_after_heading"} and facts.speed_std_mps < STEADY * facts.speed_mps:
        return f"speed hardly changes ({facts.speed_mps:.2f} ± {facts.speed_std_mps:.2f} m/s): add stops and starts"
    if total >= TURNS_NEEDED_RAD and min(right, left) < ONE_SIDED * max(right, left):
        side = "left" if right > left else "right"
        return f"turns in one direction only: add as many turns to the {side}"
    correlation = found.correlation[NAMES.index(name)].copy()
    correlation[NAMES.index(name)] = 0.0
    partner = int(np.argmax(np.abs(correlation)))
    if abs(correlation[partner]) > 0.9:
        return f"hardly separable from: {LABELS[NAMES[partner]]} (correlation {correlation[partner]:.2f})"
    return f"too short a drive for this noise: {facts.distance_m:.0f} m"


def _known_antenna(log: RobotLog, config: Config) -> tuple[float | None, float | None]:
    """Return the antenna's position where it is configured, or in the log's transforms, forward and right [m]."""
    in_log = log.antenna_m if log.antenna_m is not None else (None, None)
    given = (config.frames.antenna_forward_m, config.frames.antenna_right_m)
    forward, right = (logged if value == "auto" else value for value, logged in zip(given, in_log, strict=True))
    return forward, right


def _derive(
    found: Estimate, direct: tuple[Parameter, ...], antenna: tuple[float | None, float | None], x_icr_m: float | None
) -> tuple[Parameter, ...]:
    """Return antenna and ICRs, as far as one of them is known; else the middle of the ICRs is assumed at y = 0."""
    ahead, aside, separation = (direct[NAMES.index(name)] for name in ("ahead", "aside", "separation"))
    forward, right = antenna
    either = "position determines only antenna forward − x ICR"
    fix = f"{either}: give frames.antenna_forward_m, or --x-icr"
    findings = []
    if forward is not None:
        findings.append(_given("antenna_forward_m", "antenna forward", forward))
        x = Parameter("x_icr_m", "x ICR", forward - ahead.value, ahead.std, ahead.verdict, "with the antenna as given")
    elif x_icr_m is not None:
        note = f"with x ICR at {x_icr_m:+.3f} m, as given"
        findings.append(
            Parameter("antenna_forward_m", "antenna forward", ahead.value + x_icr_m, ahead.std, ahead.verdict, note)
        )
        x = _given("x_icr_m", "x ICR", x_icr_m)
    else:
        findings.append(Parameter("antenna_forward_m", "antenna forward", math.nan, math.nan, "not separable", fix))
        x = Parameter("x_icr_m", "x ICR", math.nan, math.nan, "not separable", fix)
    middle = 0.0
    if right is not None:
        findings.append(_given("antenna_right_m", "antenna right", right))
        middle, note, spread = right - aside.value, "with the antenna as given", aside.std
    else:
        note, spread = "if the ICRs lie evenly about the body's middle", 0.0
        findings.append(Parameter("antenna_right_m", "antenna right", aside.value, aside.std, aside.verdict, note))
    worst = max((separation.verdict, aside.verdict), key=("given", "shown", "weak", "not shown").index)
    verdict = worst if right is not None else separation.verdict
    # of y = middle ± W / 2 with middle = right - aside, or 0
    rows = np.zeros((2, len(NAMES)))
    rows[:, NAMES.index("separation")] = 0.5, -0.5
    rows[:, NAMES.index("aside")] = -1.0 if spread else 0.0
    stds = np.sqrt(np.diag(rows @ found.covariance @ rows.T))
    return (
        *findings,
        Parameter("y_icr_right_m", "y ICR right", middle + separation.value / 2, float(stds[0]), verdict, note),
        Parameter("y_icr_left_m", "y ICR left", middle - separation.value / 2, float(stds[1]), verdict, note),
        x,
    )


def _given(key: str, label: str, value: float) -> Parameter:
    return Parameter(key, label, value, 0.0, "given", "")


def _settings(findings: tuple[Parameter, ...], config: Config) -> tuple[Setting, ...]:
    """Return the settings of parameters that are known well enough, and are large enough, to be configured."""
    by_key = {finding.key: finding for finding in findings}
    settings = []

    def add(key: str, finding: Parameter, *, neutral: float, least: float, times: float = 1.0, why: str = "") -> None:
        if finding.verdict == "shown" and abs(finding.value - neutral) > max(3.0 * finding.std, least):
            settings.append(Setting(key, round(times * finding.value, 4), why or finding.note))

    add("frames.heading_offset_deg", by_key["heading_offset_deg"], neutral=0.0, least=0.3)
    for key, stream in (("frames.reference_delay_s", "gnss_delay"), ("frames.heading_delay_s", "heading_delay")):
        # Receivers and AHRS lag; one that seems to lead shows a robot that responds to its wheels with a delay.
        if by_key[KEYS[stream]].value > 0.0:
            add(key, by_key[KEYS[stream]], neutral=0.0, least=RESPONSE_S, why=LABELS[stream])
    add("frames.antenna_forward_m", by_key["antenna_forward_m"], neutral=0.0, least=0.02)
    add("frames.antenna_right_m", by_key["antenna_right_m"], neutral=0.0, least=0.02)
    for side in ("left", "right"):
        given = config.wheels.left_scale if side == "left" else config.wheels.right_scale
        times = 1.0 if given == "auto" else given
        add(f"wheels.{side}_scale", by_key[f"{side}_scale"], neutral=1.0, least=0.005, times=times)
    return tuple(settings)
