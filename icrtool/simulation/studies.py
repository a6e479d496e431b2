"""Studies: the paper's simulations (Pentzer 2014, Section 5) over many seeds, on the paper's robot or on one's own."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast

import numpy as np

from icrtool.config import Config
from icrtool.errors import ConfigError
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.simulation.drives import DrivePlan, Sensors, check_drive
from icrtool.simulation.paths import PathKind, PathPlan
from icrtool.simulation.study_runs import Progress

StudyName = Literal[
    "convergence",
    "initial",
    "icr-change",
    "turn-radius",
    "input-noise",
    "input-bias",
    "input-source",
    "gnss",
    "rate",
    "consistency",
]

Preset = Literal["paper", "field"]
Column = Floats | Ints | Bools | list[str]

PAPER_TRACK_WIDTH_M = 0.51
"""Pentzer 2014, Section 5: the robot of the simulations."""

STUDY_STEP_S = 0.005
"""Track speeds of a path are held this long in a study: no longer than any wheel interval."""

MOST_RUNS = 100_000
"""Runs of a setting."""


@dataclass(frozen=True, slots=True)
class StudyNumber:
    """One number of a study, and the number in the paper.

    Attributes
    ----------
    what : the quantity
    ours : 5th percentile, median, 95th percentile; or one number; NaN where there is none
    unit : of `ours`
    paper : the paper's number as text; empty where it has none
    """

    what: str
    ours: tuple[float, ...]
    unit: str
    paper: str = ""


@dataclass(frozen=True, slots=True)
class StudyRequest:
    """The settings of a study.

    Attributes
    ----------
    plan, sensors : the drive and its sensors; a study varies one of their settings
    config : filter and robot
    presets : the filter presets to compare
    values : settings of what is varied; empty where nothing is
    paths : the kinds of path to compare, where a study compares them
    vary_path : every run of a ``curved`` path has another phase
    """

    name: StudyName
    plan: DrivePlan
    sensors: Sensors
    config: Config
    presets: tuple[Preset, ...]
    runs: int
    seed: int = 0
    values: tuple[float, ...] = ()
    paths: tuple[PathKind, ...] = ()
    vary_path: bool = True

    def settings(self) -> dict[str, Any]:
        """Return the settings for study.json: every parameter, as plain data."""
        from dataclasses import asdict

        plan = {**asdict(self.plan), "path": asdict(cast(PathPlan, self.plan.path))}
        return {
            "runs": self.runs,
            "seed": self.seed,
            "values": list(self.values),
            "presets": list(self.presets),
            "paths": list(self.paths),
            "vary_path": self.vary_path,
            "drive": plan,
            "sensors": asdict(self.sensors),
            "config": self.config.effective(),
        }


@dataclass(frozen=True, slots=True)
class StudyResult:
    """The results of a study.

    Attributes
    ----------
    columns : one row a run: the CSV
    levels : one record a setting, with the statistics over its runs
    findings : numbers to compare with the paper's
    curves : further arrays for the figure, by name
    """

    request: StudyRequest
    columns: dict[str, Column]
    levels: tuple[dict[str, Any], ...]
    findings: tuple[StudyNumber, ...]
    curves: dict[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StudyKind:
    """A kind of study: what it varies, and the function that carries it out.

    Attributes
    ----------
    figures : figures of the paper
    about : one line
    varies : what its values are, with unit; empty where it takes none
    home : module and function that carry it out
    """

    figures: str
    about: str
    varies: str
    home: tuple[str, str]


KINDS: dict[StudyName, StudyKind] = {
    "convergence": StudyKind(
        "4, 5", "convergence time of the ICRs, by kind of path", "", ("study_sweeps", "study_convergence")
    ),
    "initial": StudyKind(
        "6, 7", "which initial ICRs converge, without and with the sign guard", "initial y ICRs [m]",
        ("study_initial", "study_initial"),
    ),
    "icr-change": StudyKind(
        "8, 9", "time to follow a change of the ICRs, without and with covariance inflation", "",
        ("study_changes", "study_icr_change"),
    ),
    "turn-radius": StudyKind(
        "10", "convergence after a change, by radius of the turn", "turn radius [m]",
        ("study_changes", "study_turn_radius"),
    ),
    "input-noise": StudyKind(
        "12", "ICR error by noise of the track speeds", "input noise [m/s]", ("study_sweeps", "study_input_noise")
    ),
    "input-bias": StudyKind(
        "13", "ICR error by bias of the track speeds", "input bias [m/s]", ("study_sweeps", "study_input_bias")
    ),
    "input-source": StudyKind(
        "11", "encoders against commanded speeds", "", ("study_sweeps", "study_input_source")
    ),
    "gnss": StudyKind(
        "35-37", "ICR error and open-loop error by noise of the GNSS", "GNSS noise [m]", ("study_sweeps", "study_gnss")
    ),
    "rate": StudyKind(
        "", "whether logs of any rate give the same ICRs", "rate of wheels and heading [Hz]",
        ("study_sweeps", "study_rate"),
    ),
    "consistency": StudyKind(
        "", "whether the filter's covariance is right: NEES, NIS, coverage", "",
        ("study_consistency", "study_consistency"),
    ),
}  # fmt: skip


def default_request(name: StudyName, config: Config) -> StudyRequest:  # noqa: PLR0911 - one a study
    """Return a study with the paper's parameters, and the configuration's robot for the start of preset ``field``."""
    if config.robot.track_width_m is None:
        config = replace(config, robot=replace(config.robot, track_width_m=PAPER_TRACK_WIDTH_M))
    plan, sensors = DrivePlan(step_s=STUDY_STEP_S), Sensors(wheels="ideal", heading_resolution_rad=0.0)
    both: tuple[Preset, ...] = ("paper", "field")
    base = StudyRequest(name, plan, sensors, config, both, runs=40)
    winding = replace(plan, path=PathPlan("curved", radius_m=2.0), duration_s=200.0)
    noises = tuple(round(0.05 * step, 2) for step in range(11))
    match name:
        case "convergence":
            return replace(base, presets=("paper",), runs=200, paths=("circle", "curved", "lawnmower", "spins"))
        case "initial":
            grid = tuple(2.0 - 0.5 * step for step in range(9))
            return replace(base, presets=("paper",), runs=4, values=grid)
        case "icr-change":
            tight = PathPlan("figure-eight", speed_mps=0.5, radius_m=1.0)
            return replace(base, plan=replace(plan, path=tight, duration_s=525.0), runs=20)
        case "turn-radius":
            circle = replace(plan, path=PathPlan("circle"), duration_s=60.0)
            return replace(base, plan=circle, values=tuple(0.25 * step for step in range(9)))
        case "input-noise" | "input-bias":
            return replace(base, plan=winding, runs=20, values=noises)
        case "input-source":
            commanded = replace(winding, command_rate_hz=10.0, motor_lag_s=0.1)
            return replace(base, plan=commanded, sensors=replace(sensors, input_bias_mps=0.03))
        case "gnss":
            mower = replace(plan, path=PathPlan("lawnmower"), duration_s=300.0)
            return replace(base, plan=mower, runs=20, values=(0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0))
        case "rate":
            return replace(base, sensors=replace(sensors, wheels="encoder"), values=(10.0, 20.0, 50.0, 100.0, 200.0))
        case "consistency":
            return replace(base, runs=200)


def run_study(request: StudyRequest, progress: Progress | None = None) -> StudyResult:
    """Return the results of a study, computed on all cores.

    Parameters
    ----------
    progress : called with the share done, 0 to 1

    Raises
    ------
    ConfigError
        A request that cannot be driven.
    """
    if not 1 <= request.runs <= MOST_RUNS:
        raise ConfigError("runs", f"{request.runs} is not a number from 1 to {MOST_RUNS:,}")
    if not all(math.isfinite(value) for value in request.values):
        raise ConfigError("values", f"{request.values} holds a value that is not finite")
    check_drive(request.plan, request.sensors)
    module, function = KINDS[request.name].home
    study: Callable[[StudyRequest, Progress | None], StudyResult] = getattr(
        importlib.import_module(f"icrtool.simulation.{module}"), function
    )
    return study(request, progress)


def table_of(settings: Sequence[Mapping[str, float | str]], found: Sequence[Mapping[str, Floats]]) -> dict[str, Column]:
    """Return the columns of the CSV, a row a run: the settings of each level, and the numbers (runs,) found of it."""
    runs = len(next(iter(found[0].values())))
    columns: dict[str, Column] = {}
    for name in settings[0]:
        values = [one[name] for one in settings for _ in range(runs)]
        is_text = any(isinstance(value, str) for value in values)
        columns[name] = [str(value) for value in values] if is_text else np.array(values, np.float64)
    columns["run"] = np.tile(np.arange(runs), len(settings))
    numbers = [name for name, values in found[0].items() if values.ndim == 1]
    return columns | {name: np.concatenate([one[name] for one in found]) for name in numbers}


def statistics(values: Floats) -> dict[str, float]:
    """Return count, mean, std, median, 5th and 95th percentile of values (runs,); NaN are ignored."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return {"count": 0, "mean": math.nan, "std": math.nan, "p5": math.nan, "p50": math.nan, "p95": math.nan}
    low, middle, high = (float(value) for value in np.percentile(finite, [5, 50, 95]))
    return {
        "count": len(finite), "mean": float(finite.mean()), "std": float(finite.std()),
        "p5": low, "p50": middle, "p95": high,
    }  # fmt: skip
