"""Studies: the paper's simulations (Pentzer 2014, Section 5) over many seeds, on the paper's robot or another.

A study is a row of `STUDIES`. It states what varies, what is measured in each run, which numbers are reported, and
which number is the answer. `run_study` runs a study; `icrtool.output.figures.study` draws it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, cast

from icrtool.config import Config
from icrtool.errors import ConfigError
from icrtool.kernels.filter_records import GUARDED, PRINTED, UNGUARDED
from icrtool.records.choices import PathKind
from icrtool.records.tables import Icrs
from icrtool.simulation import study_runs as measured
from icrtool.simulation.drives import PathPlan, check_drive
from icrtool.simulation.friction import FrictionRobot
from icrtool.simulation.study_records import (
    IDEAL,
    PLAN,
    Level,
    Number,
    Setting,
    Study,
    StudyNumber,
    StudyRequest,
    StudyResult,
    consistency_of,
)
from icrtool.simulation.study_runs import FATES, Progress, Scenario, run_scenarios, trace

PAPER_TRACK_WIDTH_M = 0.51
"""Track width of the simulated robot in Pentzer 2014, Section 5 [m]."""

MOST_RUNS = 100_000
"""Largest number of runs of each setting."""

SHOWN_S = 20.0
"""Time from the start of a run that the picture of convergence shows [s]."""

GUARDS = {"no guard": UNGUARDED, "guard, printed derivatives": PRINTED, "guard, true derivatives": GUARDED}
"""Eqs. 8-10; Eqs. 32-34 with Eqs. 28-29 as printed; Eqs. 32-34 with their true derivatives, as icrtool uses them."""

MODEL_ICR_STD_M = 0.1
"""Initial standard deviation of the ICRs in case ``model``: small enough for an EKF to be nearly linear."""

CONSISTENCY_WORDS = {"nees": "NEES", "nis_gnss": "NIS of fixes", "nis_heading": "NIS of headings"}
"""Words for the numbers of study consistency."""


# The settings that studies vary follow.


def with_preset(request: StudyRequest, preset: str) -> Scenario:
    """Return the scenario of a request with a preset, before a setting is varied."""
    return Scenario(request.plan, request.sensors, request.config.with_filter(preset=preset))


def settings_by_preset(
    change: Callable[[Scenario, Any], Scenario], choices: Sequence[str] = ()
) -> Callable[[StudyRequest], Iterator[Setting]]:
    """Return a function that yields a setting for each preset and each choice, or each value of a request.

    Parameters
    ----------
    change : returns the scenario for a preset's scenario and a value
    """

    def vary(request: StudyRequest) -> Iterator[Setting]:
        for preset in request.presets:
            for value in choices or request.paths or request.values:
                yield Setting(preset, value, change(with_preset(request, preset), value), {"value": value})

    return vary


def with_other_sensors(base: Scenario, **sensors: Any) -> Scenario:
    """Return a scenario with other sensors."""
    return replace(base, sensors=replace(base.sensors, **sensors))


def with_path(base: Scenario, **path: Any) -> Scenario:
    """Return a scenario with another path."""
    return replace(base, plan=replace(base.plan, path=replace(cast(PathPlan, base.plan.path), **path)))


def with_rate(base: Scenario, rate: float) -> Scenario:
    """Return a scenario with another rate of wheels and heading; a higher rate of the fixes is reduced to it."""
    gnss_rate = min(rate, base.sensors.gnss_rate_hz)
    return with_other_sensors(base, wheel_rate_hz=rate, heading_rate_hz=rate, gnss_rate_hz=gnss_rate)


def with_speed_source(base: Scenario, name: str) -> Scenario:
    """Return a scenario with encoders, or with motor commands at a low rate that the motors follow with a lag.

    The bias is the difference of command and track speed. The drives of both scenarios are the same.
    """
    if name == "encoder":
        return with_other_sensors(base, wheels="encoder", input_bias_mps=0.0)
    return with_other_sensors(base, wheels="commanded", wheel_rate_hz=base.plan.command_rate_hz)


def with_circle(base: Scenario, radius: float) -> Scenario:
    """Return a scenario on a circle, with inflation.

    The speed of the faster track is the same for all radii. At radius 0 the robot spins; on a wider circle it turns
    slower.
    """
    outer, path = abs(base.plan.icrs_m[1]), cast(PathPlan, base.plan.path)
    speed = path.speed_mps * (radius / (radius + outer) if radius else 1.0)
    return replace(with_path(base, kind="circle", radius_m=radius, speed_mps=speed), inflate=True)


def settings_by_start(request: StudyRequest) -> Iterator[Setting]:
    """Yield a setting for each guard and, on a grid, for each pair of initial y ICRs."""
    base, initial_x_m = with_preset(request, request.presets[0]), request.config.filter.initial_x_icr_m
    of_preset = base.config.filter.rules.initial_icrs_m or (0.0, 0.0, 0.0)
    x = initial_x_m if initial_x_m is not None else of_preset[2]
    for (name, guard), right, left in product(GUARDS.items(), request.values, request.values):
        order = "proper start" if right > left else "inverted start" if right < left else ""
        start = {"start_y_icr_right_m": right, "start_y_icr_left_m": left}
        config = with_initial_icrs(base.config, (right, left, x))
        yield Setting(name, order, replace(base, guard=guard, config=config), start)


def settings_by_case(request: StudyRequest) -> Iterator[Setting]:
    """Yield a setting with a truth drawn from the filter's own model, and one with exact kinematics for each preset.

    Notes
    -----
    Case ``model``: the truth obeys Eq. 14 with process noise drawn from Q (Eq. 30) and measurements drawn from R
    (Eq. 31), and the filter starts from the prior of the truth. Then NEES and NIS are chi-squared (Bar-Shalom, Li,
    Kirubarajan 2001, Section 5.4). Cases ``paper`` and ``field``: constant ICRs, preset's start.
    """
    base = with_preset(request, "paper")
    start = with_initial_icrs(base.config, request.plan.icrs_m, initial_icr_std_m=MODEL_ICR_STD_M)
    yield Setting("model", "", replace(base, config=start, model_icr_std_m=MODEL_ICR_STD_M), {})
    for preset in request.presets:
        yield Setting(preset, "", with_preset(request, preset), {})


def with_initial_icrs(config: Config, icrs_m: Icrs, **settings: float) -> Config:
    """Return the configuration with other initial ICRs, and other settings of the filter."""
    names = ("initial_y_icr_right_m", "initial_y_icr_left_m", "initial_x_icr_m")
    return config.with_filter(**dict(zip(names, icrs_m, strict=True)), **settings)


def changed_icrs(icrs_m: Icrs, number: int) -> Icrs:
    """Return the ICRs after change 1, 2, …: alternately wider and narrower. The paper does not state its values."""
    right, left, x = icrs_m
    width = right - left
    if number % 2:
        return 1.5 * right, 0.7 * left, x + 0.2 * width
    return 0.8 * right, 1.2 * left, x - 0.1 * width


# The numbers that studies report follow.


def largest(values: Sequence[Any]) -> tuple[Any, ...]:
    """Return the largest of the values that a study varies."""
    return (max(values),)


def extreme(values: Sequence[Any]) -> tuple[Any, ...]:
    """Return the smallest and the largest of the values that a study varies."""
    return min(values), max(values)


def shown_path(paths: Sequence[Any]) -> tuple[Any, ...]:
    """Return the kind of path whose runs the picture of convergence shows."""
    return ("curved" if "curved" in paths else paths[0],)


def consistency_numbers(levels: Sequence[Level]) -> list[StudyNumber]:
    """Return NEES, NIS and coverage of each case, with their expected values."""
    numbers = []
    for level in levels:
        name, case, by_run = level.setting.series, consistency_of(level.found), level.metrics()
        for quantity, words in CONSISTENCY_WORDS.items():
            low, high = case[quantity]["band"]
            expected = f"{case[quantity]['expected']:g}, {low:.3f}-{high:.3f} in 95 %"
            numbers.append(StudyNumber(f"{name}: {words}, mean", (case[quantity]["mean"],), "", expected))
            numbers.append(StudyNumber(f"{name}: {words}, median run", (by_run[quantity]["p50"],), ""))
        for states, part in (("pose", case["coverage_pct"][:3]), ("ICRs", case["coverage_pct"][3:])):
            label = f"{name}: {states} within 2 sigma, least and most"
            numbers.append(StudyNumber(label, (min(part), max(part)), "%", "95.4 %"))
    return numbers


WINDING = replace(PLAN, path=PathPlan("curved", radius_m=2.0), duration_s=200.0)
"""Drive on a path with many bends."""

STUDY_NOISES = tuple(round(0.05 * step, 2) for step in range(11))
"""Sizes of the noise and of the bias of the track speeds [m/s]."""

ERROR_COLUMN = "error_{icr}_m"
"""Pattern of the names of columns with ICR errors."""


def study_of_speed_error(word: str, sensors_field: str, figures: str, paper: str) -> Study:
    """Return the study of an error of the track speeds, on a winding path."""
    return Study(
        about=f"ICR error by {word} of the track speeds",
        figures=figures,
        varies=f"input {word} [m/s]",
        varied=sensors_field,
        runs=20,
        values=STUDY_NOISES,
        plan=WINDING,
        vary=settings_by_preset(lambda base, value: with_other_sensors(base, **{sensors_field: value})),
        measures=(measured.measure_estimates,),
        numbers=(Number("{series}: error of {icr} at {value:g} m/s", ERROR_COLUMN, "spread", "m", paper, largest),),
        title=f"{{value:g}} m/s of {word} moves y right by {{answer}}",
        answer=Number("{series}", "error_y_icr_right_m", "median", "m", at=largest),
    )


PATHS: tuple[PathKind, ...] = ("circle", "curved", "lawnmower", "spins")
"""Kinds of paths of study convergence."""

PATH_TIMES = {"circle": "2.9-12.8 s, driven (Figs. 15, 17)", "": "5-15 s, driven"}
"""The paper's convergence times by kind of path; the empty key is for all others."""

STARTS = ("proper start", "inverted start")
"""Names of the kinds of starts of study initial."""

START_FATES = {"no guard": "starts with y_icr_right > 0 (Fig. 6)", "": "all (Fig. 7)"}
"""The paper's results by sign guard."""

CHANGE_TIMES = {"inflated": "0.03-0.17 s (Fig. 9)", "": "100-140 s (Fig. 8)"}
"""The paper's convergence times after a change."""

RADIUS_TIMES = {0.0: "0.1 s (Fig. 10)", 2.0: "1.8 s (Fig. 10)"}
"""The paper's convergence times by radius of the turn [m]."""

TABLE_III = {
    "y_icr_right": {0.4: "0.65 ± 0.01 (Table III)", 1.6: "0.49 ± 0.02", 4.0: "0.49 ± 0.01"},
    "y_icr_left": {0.4: "-0.64 ± 0.01 (Table III)", 1.6: "-0.56 ± 0.02", 4.0: "-0.61 ± 0.04"},
    "x_icr": {0.4: "-0.04 ± 0.01 (Table III)", 1.6: "0.02 ± 0.13", 4.0: "0.21 ± 0.14"},
}
"""Mean and standard deviation of each ICR [m], by speed [m/s]."""

RTK_ERROR = {0.01: "within 3.8 m for 95 % (RTK, tracked, Fig. 29)"}
"""The paper's open-loop error by noise of the fixes [m]."""

STUDIES: dict[str, Study] = {
    "convergence": Study(
        about="convergence time of the ICRs, by kind of path",
        figures="4, 5",
        presets=("paper",),
        runs=200,
        paths=PATHS,
        vary=settings_by_preset(lambda base, kind: with_path(base, kind=kind)),
        measures=(measured.measure_times, measured.measure_estimates, trace(end_s=SHOWN_S)),
        numbers=(Number("{value} ({series}): all three ICRs converged after", "settle_s", "spread", "s", PATH_TIMES),),
        title="Time to settle on a path of kind {value}: {answer}",
        answer=Number("{series}", "settle_s", "median", "s", at=shown_path),
    ),
    "initial": Study(
        about="which initial ICRs converge, without and with the sign guard",
        figures="6, 7",
        varies="initial y ICRs [m]",
        presets=("paper",),
        runs=4,
        values=tuple(2.0 - 0.5 * step for step in range(9)),
        vary=settings_by_start,
        measures=(measured.measure_fate, trace()),
        numbers=(
            Number("{series}, {value}: converged", "converged", "percent", "%", START_FATES, STARTS),
            Number("{series}, {value}: ends inverted", "inverted", "percent", "%", at=STARTS),
        ),
        title="Guarded: {answer} converge",
        answer=Number("{value}", "converged", "percent", "%", at=STARTS, series="guard, printed derivatives"),
        summary=lambda found: {fate: float(found[fate].mean()) for fate in FATES},
    ),
    "icr-change": Study(
        about="time to follow a change of the ICRs, without and with covariance inflation",
        figures="8, 9",
        runs=20,
        plan=replace(PLAN, path=PathPlan("figure-eight", speed_mps=0.5, radius_m=1.0), duration_s=525.0),
        changes_s=(175.0, 350.0),
        vary=settings_by_preset(
            lambda base, name: replace(base, inflate=name == "inflated"), ("not inflated", "inflated")
        ),
        measures=(measured.measure_changes, trace(), measured.trace_change),
        numbers=(
            Number("{series}, {value}: convergence time (10-90 %)", "change*_rise_*_s", "spread", "s", CHANGE_TIMES),
            Number("{series}, {value}: all three stay within 10 % after", "change*_settle_s", "spread", "s"),
            Number("{series}, {value}: share of the changes with such a time", "change*_settle_s", "percent found",
            "%"), Number("{series}, {value}: ends inverted", "inverted", "percent", "%"),
        ),
        title="Time to follow a change, inflated: {answer}",
        answer=Number("{series}", "change*_settle_s", "median", "s", at=("inflated",)),
    ),
    "turn-radius": Study(
        about="convergence after a change, by radius of the turn",
        figures="10",
        varies="turn radius [m]",
        varied="radius_m",
        values=tuple(0.25 * step for step in range(9)),
        plan=replace(PLAN, path=PathPlan("circle"), duration_s=60.0),
        changes_s=(20.0,),
        vary=settings_by_preset(with_circle),
        measures=(measured.measure_one_change,),
        numbers=(
            Number("{series}: radius {value:g} m: an ICR stays within 10 % after, mean", "settle_*_s", "mean", "s",
                   RADIUS_TIMES, extreme),
            Number("{series}: radius {value:g} m: all three do", "settle_s", "spread", "s", at=extreme),
            Number("{series}: radius {value:g} m: ends inverted", "inverted", "percent", "%", at=extreme),
        ),
        title="Time to settle at radius {value:g} m: {answer}",
        answer=Number("{series}", "settle_s", "median", "s", at=largest),
    ),
    "input-noise": study_of_speed_error("noise", "input_noise_mps", "12", "Fig. 12's axis: -1 to 1 m"),
    "input-bias": study_of_speed_error("bias", "input_bias_mps", "13", "Fig. 13's axis: -0.1 to 0.02 m"),
    "input-source": Study(
        about="encoders against commanded speeds",
        figures="11",
        plan=replace(WINDING, command_rate_hz=10.0, motor_lag_s=0.1),
        sensors=replace(IDEAL, input_bias_mps=0.03),
        vary=settings_by_preset(with_speed_source, ("encoder", "commanded")),
        measures=(measured.measure_estimates, trace()),
        numbers=(Number("{series}: error of {icr}, {value} speeds", ERROR_COLUMN, "spread", "m"),),
        title="Commanded speeds move y right by {answer}",
        answer=Number("{series}", "error_y_icr_right_m", "median", "m", at=("commanded",)),
    ),
    "gnss": Study(
        about="ICR error and open-loop error by noise of the GNSS",
        figures="35-37",
        varies="GNSS noise [m]",
        varied="gnss_std_m",
        runs=20,
        values=(0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0),
        plan=replace(PLAN, path=PathPlan("lawnmower"), duration_s=300.0),
        vary=settings_by_preset(lambda base, value: with_other_sensors(base, gnss_std_m=value)),
        measures=(measured.measure_estimates, measured.measure_times, measured.measure_open_loop),
        numbers=(
            Number("no slip: open loop after 10 m, p95", "blind_no_slip_10m_p95_m", "first", "m"),
            Number("{series}: GNSS {value:g} m: open loop after 10 m, p95", "blind_icr_10m_p95_m", "spread", "m",
                   RTK_ERROR, lambda noises: (min(noises), 0.3)),
            Number("{series}: GNSS {value:g} m: rms error of y_icr_right", "rms_y_icr_right_m", "spread", "m",
                   at=lambda noises: (min(noises), 0.3)),
        ),
        title="GNSS of {value:g} m: 10 m without it cost {answer}",
        answer=Number("{series}", "blind_icr_10m_p95_m", "median", "m", at=largest),
    ),
    "speed": Study(
        about="ICRs of a robot on sliding contacts, by its speed",
        figures="38-44",
        varies="speed [m/s]",
        varied="speed_mps",
        runs=20,
        values=(0.4, 1.6, 4.0),
        plan=replace(
            PLAN, icrs_m=(0.6, -0.6, 0.0), path=PathPlan(radius_m=5.0), motor_lag_s=0.1, robot=FrictionRobot()
        ),
        sensors=replace(IDEAL, wheels="encoder"),
        vary=settings_by_preset(lambda base, value: with_path(base, speed_mps=value)),
        measures=(measured.measure_means,),
        numbers=(
            *(
                Number(f"{{series}}: mean {icr} at {{value:g}} m/s", f"mean_{icr}_m", "spread", "m", paper)
                for icr, paper in TABLE_III.items()
            ),
            Number("{series}: std of {icr} at {value:g} m/s", "scatter_{icr}_m", "spread", "m"),
            Number("{series}: mean position error at {value:g} m/s", "position_error_m", "spread", "m"),
        ),
        title="At {value:g} m/s the mean x is {answer}",
        answer=Number("{series}", "mean_x_icr_m", "median", "m", at=largest),
    ),
    "rate": Study(
        about="whether logs of any rate give the same ICRs",
        varies="rate of wheels and heading [Hz]",
        varied="rate",
        values=(10.0, 20.0, 50.0, 100.0, 200.0),
        sensors=replace(IDEAL, wheels="encoder"),
        vary=settings_by_preset(with_rate),
        measures=(measured.measure_estimates,),
        numbers=(
            Number("{series}: {icr} differs between rates by at most", ERROR_COLUMN, "range of means", "m"),
            Number("{series}: stated std of {icr}, least and greatest", "std_{icr}_m", "extreme medians", "m"),
        ),
        title="Between rates, x_icr differs by {answer}",
        answer=Number("{series}", "error_x_icr_m", "range of means", "m"),
    ),
    "consistency": Study(
        about="whether the filter's covariance is right: NEES, NIS, coverage",
        runs=200,
        vary=settings_by_case,
        measures=(measured.measure_consistency,),
        numbers=consistency_numbers,
        title="Mean NEES, 6 expected: {answer}",
        answer=Number("{series}", "nees", "mean"),
        summary=consistency_of,
    ),
}  # fmt: skip
"""Every study by name."""


def default_request(name: str, config: Config) -> StudyRequest:
    """Return the request of a study: the paper's parameters, and the robot of `config` for the start of ``field``."""
    if config.robot.track_width_m is None:
        config = replace(config, robot=replace(config.robot, track_width_m=PAPER_TRACK_WIDTH_M))
    study = STUDIES[name]
    return StudyRequest(name, study.plan, study.sensors, config, study.presets, study.runs, study.values, study.paths)


def run_study(request: StudyRequest, progress: Progress | None = None) -> StudyResult:
    """Return the results of a study, computed on all cores.

    Parameters
    ----------
    progress : called with the share done, 0 to 1

    Raises
    ------
    ConfigError
        The request cannot be driven.
    """
    if not 1 <= request.runs <= MOST_RUNS:
        raise ConfigError("runs", f"{request.runs} is not a number from 1 to {MOST_RUNS:,}")
    if not all(math.isfinite(value) for value in request.values):
        raise ConfigError("values", f"{request.values} holds a value that is not finite")
    check_drive(request.plan, request.sensors)
    study = STUDIES[request.name]
    plan, times_s = request.plan, study.changes_s
    if plan.robot is not None and times_s:
        why = f"study {request.name} changes known ICRs; the ICRs of a robot on sliding contacts follow from forces"
        raise ConfigError("dynamics", why, "leave --dynamics out")
    if times_s and not plan.changes:
        # The ICRs change at the usual times that lie within the drive.
        if plan.duration_s <= times_s[0]:
            why = f"{plan.duration_s:g} s end before the first change, at {times_s[0]:g} s"
            raise ConfigError("duration", why, "drive longer, or give earlier times with --change")
        changes = ((time, changed_icrs(plan.icrs_m, number)) for number, time in enumerate(times_s, start=1))
        plan = replace(plan, changes=tuple(change for change in changes if change[0] < plan.duration_s))
        request = replace(request, plan=plan)
    settings = list(study.vary(request))
    measured = run_scenarios(
        [setting.scenario for setting in settings], request.runs, request.seed, study.measures, progress
    )
    return StudyResult(request, study, tuple(map(Level, settings, measured)))
