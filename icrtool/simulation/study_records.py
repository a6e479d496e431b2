"""Records of a study: its definition, request and result; the numbers that are reported for its levels."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from icrtool.config import Config
from icrtool.kernels.arrays import Floats, Ints
from icrtool.records.choices import PathKind, PresetName
from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors
from icrtool.simulation.study_runs import ICR_NAMES, STUDY_STATES, Measure, Scenario

PLAN = DrivePlan(step_s=0.005)
"""Default drive of a study. Its track speeds are held for 0.005 s, which is not longer than any wheel interval."""

IDEAL = Sensors(wheels="ideal", heading_resolution_rad=0.0)
"""Sensors whose wheel speeds have no error."""

Column = Floats | Ints | list[float | str]
"""A column of the CSV of a study, or of its settings."""


@dataclass(frozen=True, slots=True)
class StudyRequest:
    """The settings of a study.

    Attributes
    ----------
    plan, sensors : the drive and its sensors; a study varies one of their settings
    config : filter and robot
    presets : the filter presets to compare
    values : values of the varied setting; empty where none is varied
    paths : the kinds of path to compare, where a study compares them
    """

    name: str
    plan: DrivePlan
    sensors: Sensors
    config: Config
    presets: tuple[PresetName, ...]
    runs: int
    values: tuple[float, ...]
    paths: tuple[PathKind, ...]
    seed: int = 0

    @property
    def path(self) -> PathPlan:
        """The path; no study drives given track speeds."""
        return cast(PathPlan, self.plan.path)

    def settings(self) -> dict[str, Any]:
        """Return the settings for study.json: every parameter, as plain data."""
        plain = asdict(self)
        return {
            **{name: plain[name] for name in ("runs", "seed", "values", "presets", "paths", "sensors")},
            "drive": plain["plan"],
            "config": self.config.effective(),
        }


class Setting(NamedTuple):
    """One setting of a study.

    Attributes
    ----------
    series : the preset, guard or case
    value : the value that varies within a series; empty where none varies
    scenario : drive, sensors and filter of its runs
    names : the columns of the CSV that name the setting, in addition to ``series``
    """

    series: str
    value: float | str
    scenario: Scenario
    names: Mapping[str, float | str]


class Level(NamedTuple):
    """A setting, and the results of its runs (runs, ...) by name; those with one number for a run are CSV columns."""

    setting: Setting
    found: Mapping[str, Floats]

    @property
    def names(self) -> dict[str, float | str]:
        """The columns of the CSV that name the setting."""
        return {"series": self.setting.series, **self.setting.names}

    def numbers(self) -> dict[str, Floats]:
        """Return the numbers with one value for each run (runs,), by name."""
        return {name: values for name, values in self.found.items() if values.ndim == 1}

    def metrics(self) -> dict[str, dict[str, float]]:
        """Return the statistics of each number over the runs."""
        return {name: statistics(values) for name, values in self.numbers().items()}


def chi2_band(degrees: int, runs: int) -> tuple[float, float]:
    """Return the 95 % band of the mean of `runs` chi-squared values that together have `degrees` degrees of freedom.

    Notes
    -----
    The cube root of a chi-squared variable is nearly normal (Wilson and Hilferty 1931). The band of one run with 6
    degrees of freedom is accurate to 3 %, the band of 10 runs and more to 0.1 %.
    """
    variance = 2.0 / (9.0 * degrees)
    low, high = (
        degrees * (1.0 - variance + math.sqrt(variance) * NormalDist().inv_cdf(level)) ** 3 for level in (0.025, 0.975)
    )
    return low / runs, high / runs


def consistency_of(found: Mapping[str, Floats]) -> dict[str, Any]:
    """Return the numbers of `measure_consistency`: means with their 95 % bands, coverage and rms by state."""
    nees, ratio, runs = found["settled nees"], found["ratio"], len(found["nees"])
    low, high = chi2_band(6 * runs, runs)
    by_stop = nees.mean(axis=0)
    in_band = 100 * float(((by_stop >= low) & (by_stop <= high)).mean())
    case: dict[str, Any] = {
        "nees": {"mean": float(nees.mean()), "expected": 6.0, "band": (low, high), "stops_in_band_pct": in_band}
    }
    for quantity, degrees in (("nis_gnss", 2), ("nis_heading", 1)):
        finite = found[f"all {quantity}"][np.isfinite(found[f"all {quantity}"])]
        band = chi2_band(degrees * len(finite), len(finite))
        case[quantity] = {"mean": float(finite.mean()), "expected": float(degrees), "band": band}
    return case | {
        "states": list(STUDY_STATES),
        "by_run": {quantity: statistics(found[quantity]) for quantity in case},
        "coverage_pct": (100 * (np.abs(ratio) <= 2).mean(axis=(0, 1))).tolist(),
        "rms_error_over_std": np.sqrt((ratio**2).mean(axis=(0, 1))).tolist(),
    }


def statistics(values: Floats) -> dict[str, float]:
    """Return count, mean, std, median, 5th and 95th percentile of values (runs,); NaN are ignored."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return {"count": 0, "mean": math.nan, "std": math.nan, "p5": math.nan, "p50": math.nan, "p95": math.nan}
    low, middle, high = np.percentile(finite, [5, 50, 95]).tolist()
    mean, std = float(finite.mean()), float(finite.std())
    return {"count": len(finite), "mean": mean, "std": std, "p5": low, "p50": middle, "p95": high}


Statistic = Literal[
    "spread", "median", "mean", "percent", "percent found", "range of means", "extreme medians", "first"
]
"""Name of a computation of numbers from levels."""

STATISTICS: dict[Statistic, Callable[[Sequence[Floats]], tuple[float, ...]]] = {
    "spread": lambda levels: _percentiles(np.concatenate(levels)),
    "median": lambda levels: (_middle(np.concatenate(levels)),),
    "mean": lambda levels: (statistics(np.concatenate(levels))["mean"],),
    "percent": lambda levels: (100 * float(np.concatenate(levels).mean()),),
    "percent found": lambda levels: (100 * float(np.isfinite(np.concatenate(levels)).mean()),),
    "range of means": lambda levels: (float(np.ptp([column.mean() for column in levels])),),
    "extreme medians": lambda levels: (float(min(map(np.median, levels))), float(max(map(np.median, levels)))),
    "first": lambda levels: _percentiles(levels[0]),
}
"""Functions that compute numbers from the columns (runs,) of levels, by name.

Over all levels: 5th percentile, median and 95th percentile (``spread``), median, mean or share. Over the first level:
the same three percentiles (``first``). Between levels: range of the means, least and greatest median."""


def _percentiles(values: Floats) -> tuple[float, ...]:
    numbers = statistics(values)
    return numbers["p5"], numbers["p50"], numbers["p95"]


def _middle(values: Floats) -> float:
    """Return the median; a run without a number counts as infinite; NaN where the median is infinite."""
    middle = float(np.median(np.nan_to_num(values, nan=np.inf)))
    return middle if math.isfinite(middle) else math.nan


class Number(NamedTuple):
    """A number that a study reports of its levels.

    Attributes
    ----------
    label : its name, with {series}, {value} and {icr}; levels with the same name are joined
    columns : pattern of the columns that it is computed from, with {icr}
    statistic : name of its computation, a key of `STATISTICS`
    unit : of the number
    paper : the paper's number as text, or a mapping from value or series to text, with an empty key for all others
    at : the values for which it is reported, or a function that chooses them
    series : the only series for which it is reported; empty: all
    """

    label: str
    columns: str
    statistic: Statistic
    unit: str = ""
    paper: str | Mapping[Any, str] = ""
    at: Sequence[Any] | Callable[[Sequence[Any]], Sequence[Any]] = tuple
    series: str = ""

    def values_among(self, levels: Iterable[Level]) -> Sequence[Any]:
        """Return the values of `at`."""
        return self.at([level.setting.value for level in levels]) if callable(self.at) else self.at


class StudyNumber(NamedTuple):
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
class Study:
    """The definition of a study: what varies, what is measured, and which numbers are reported.

    Attributes
    ----------
    about : what the study shows, in one line
    vary : the settings of a request
    measures : functions that measure each run
    numbers : the numbers that are reported for the levels
    title, answer : title of the picture, with {answer} and {value}, and the number of each series that it states
    figures : figures of the paper
    varies : name of the varied setting, with unit; empty where none is varied
    varied : option of the command for this setting
    changes_s : default times at which the ICRs change
    plan, sensors, presets, runs, values, paths : of the default request
    summary : content of study.json for a level, in addition to the statistics of its numbers
    """

    about: str
    vary: Callable[[StudyRequest], Iterable[Setting]]
    measures: tuple[Measure, ...]
    numbers: tuple[Number, ...] | Callable[[Sequence[Level]], list[StudyNumber]]
    title: str
    answer: Number
    figures: str = ""
    varies: str = ""
    varied: str = ""
    changes_s: tuple[float, ...] = ()
    plan: DrivePlan = PLAN
    sensors: Sensors = IDEAL
    presets: tuple[PresetName, ...] = ("paper", "field")
    runs: int = 40
    values: tuple[float, ...] = ()
    paths: tuple[PathKind, ...] = ()
    summary: Callable[[Mapping[str, Floats]], dict[str, Any]] = lambda _: {}


@dataclass(frozen=True, slots=True)
class StudyResult:
    """The results of a study: a level for each setting."""

    request: StudyRequest
    study: Study
    levels: tuple[Level, ...]

    @property
    def columns(self) -> dict[str, Column]:
        """The columns of the CSV, which has one row for each run."""
        runs, levels = self.request.runs, self.levels
        columns: dict[str, Column] = {
            name: [level.names[name] for level in levels for _ in range(runs)] for name in levels[0].names
        }
        columns["run"] = np.tile(np.arange(runs), len(levels))
        return columns | {name: np.concatenate([level.found[name] for level in levels]) for name in levels[0].numbers()}

    @property
    def findings(self) -> list[StudyNumber]:
        """The reported numbers, each with the paper's number."""
        numbers = self.study.numbers
        return numbers(self.levels) if callable(numbers) else reported_numbers(numbers, self.levels)

    @property
    def answer(self) -> list[StudyNumber]:
        """The number that answers the study's question, by series."""
        return reported_numbers([self.study.answer], self.levels)

    def records(self) -> list[dict[str, Any]]:
        """Return the content of study.json for the levels."""
        return [{**level.names, **self.study.summary(level.found), "metrics": level.metrics()} for level in self.levels]


def reported_numbers(numbers: Sequence[Number], levels: Sequence[Level]) -> list[StudyNumber]:
    """Return numbers of levels, in the order of the levels, the ICRs and `numbers`."""
    pooled: dict[str, tuple[Number, Level, dict[int, Floats]]] = {}
    at = [number.values_among(levels) for number in numbers]
    for place, level in enumerate(levels):
        series, value, *_ = level.setting
        for icr in ICR_NAMES:
            for number, values in zip(numbers, at, strict=True):
                if value in values and number.series in ("", series):
                    label = number.label.format(series=series, value=value, icr=icr)
                    names = fnmatch.filter(level.numbers(), number.columns.format(icr=icr))
                    columns = np.concatenate([level.found[name] for name in names])
                    pooled.setdefault(label, (number, level, {}))[2][place] = columns
    numbers_found = []
    for label, (number, level, by_level) in pooled.items():
        paper = number.paper
        if not isinstance(paper, str):
            keys = (level.setting.value, level.setting.series, "")
            paper = next((paper[key] for key in keys if key in paper), "")
        numbers_found.append(
            StudyNumber(label, STATISTICS[number.statistic](list(by_level.values())), number.unit, paper)
        )
    return numbers_found
