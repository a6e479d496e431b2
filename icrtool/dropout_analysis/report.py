"""The dropout report, and its comparison with budgets, acceptance limits for CI and an earlier report.

`icrtool.dropout` and `icrtool.dropout_report` return a `DropoutReport`. The record is not in `icrtool.records`, because
it holds a calibration, which depends on fits. Other modules compute a report.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from msgspec import UNSET, UnsetType
from msgspec.structs import asdict, astuple, replace

from icrtool import __version__
from icrtool.errors import ConfigError
from icrtool.kernels.arrays import Floats
from icrtool.kernels.error_statistics import (
    BlockSums,
    difference_half_width,
    pooled_variance,
    student_factor,
    variance_of_sum,
    within_budget,
)
from icrtool.kernels.track import TrialCounts
from icrtool.records import dropout_document as documents
from icrtool.records.acceptance import CHOICE_HORIZON_M, DISTANCES, METRICS, BudgetDistance, Gate, Verdict
from icrtool.records.choices import FigureSet
from icrtool.records.plain_data import plain_value
from icrtool.records.rows import TOPIC_ROW, kind_of, row_of, turned_by
from icrtool.records.run_document import RunDocument, known_content
from icrtool.records.text import escaped, listed

if TYPE_CHECKING:
    import pandas as pd

    from icrtool.calibration.record import Calibration

_NUMBER_FORM = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
"""Pattern of a number without a sign."""

_FORM = re.compile(
    r"^\s*(?P<model>\w+(?::\S(?:.*\S)?)?)\.(?P<metric>p50|p95|expected|max|p95_next|within|within_next)@(?P<at>\d+(?:\.\d+)?)\s*m?\s*"
    rf"(?P<relation><=|>=|<|>)\s*(?:(?P<bound>[+-]?{_NUMBER_FORM})\s*m?|"
    rf"(?:(?P<factor>{_NUMBER_FORM})\s*\*\s*)?(?P<baseline>baseline)(?:\s*(?P<offset>[+-]\s*{_NUMBER_FORM})\s*m?)?)\s*$"
)
"""Pattern of an acceptance limit."""

_RELATIONS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt,
}  # fmt: skip
"""Functions of the relations of a limit."""


@dataclass(frozen=True, slots=True, eq=False)
class OpenLoopErrors:
    """Errors of open-loop trials by model and horizon.

    Attributes
    ----------
    run_document : content of the run's run.json
    horizons_m : (h,) ascending
    results : result of each model
    counts : number of trials, and of starts without a trial, by horizon; they are the same for every model
    states : number of recorded states
    standing : number of states in which the robot stood; the trials of one standstill are nearly equal
    reference : errors that a perfect model would show, by horizon
    by_learning : errors of the momentary ICRs before and after the ICRs were first learned; None without this model
    """

    run_document: RunDocument
    horizons_m: Floats
    results: tuple[documents.ModelResult, ...]
    counts: TrialCounts
    states: int
    standing: int
    reference: tuple[documents.ReferenceRow, ...]
    by_learning: documents.LearnedDocument | None

    def result(self, model: str) -> documents.ModelResult | None:
        """Return the result of a model; None if it was not computed."""
        return next((result for result in self.results if result.name == model), None)


@dataclass(frozen=True, slots=True, repr=False, eq=False)
class DropoutReport(OpenLoopErrors):
    """Open-loop errors by model and horizon, and the other requested results.

    `icrtool.dropout` gives the errors alone, `icrtool.dropout_report` the complete report.

    Attributes
    ----------
    document : content of report.json
    run_directory : directory that the run was read from; None for a new run
    reference_north_m, reference_east_m : (n,) positions that trials are compared with, at every state
    usable : whether distances and numbers may be used, because the run is usable or the request accepts any run
    worst, examples, outages : the same as in `document`, with their paths
    path_errors : errors of all trials of the row in `worst`, by start; None if no trial is long enough
    calibration : the calibration from this run alone; None if it was left out
    baseline : an earlier report that this report is compared with; None without one
    """

    document: documents.DropoutDocument
    run_directory: Path | None
    reference_north_m: Floats
    reference_east_m: Floats
    usable: bool = True
    worst: tuple[documents.ExampleTrial, ...] = ()
    examples: tuple[documents.ExampleTrial, ...] = ()
    outages: tuple[documents.Outage, ...] = ()
    path_errors: documents.PathErrors | None = None
    calibration: Calibration | None = None
    baseline: BaselineReport | None = None

    @property
    def name(self) -> str:
        """Name of the log."""
        return self.document.run.log

    @property
    def passed(self) -> bool:
        """Whether every acceptance limit is met."""
        return self.document.passed

    @property
    def summary(self) -> pd.DataFrame:
        """The rows of summary.csv as a DataFrame."""
        import pandas as pd

        rows = [{"model": model.name} | asdict(row) for model in self.document.models for row in model.by_horizon]
        types = dict.fromkeys(documents.SummaryRow.__struct_fields__, "float64") | {"trials": "int64"}
        return pd.DataFrame(rows, columns=["model", *types]).astype(types)

    def write(
        self, path: str | Path | None = None, *, plots: tuple[str, ...] = ("png",), figures: FigureSet = "default"
    ) -> None:
        """Write summary.csv, histogram.csv, report.json, the other tables and the figures, whole or not at all.

        Parameters
        ----------
        path : directory of the report; default: ``dropout`` in the directory that the run was read from
        plots : formats of the figures, of ``png``, ``svg`` and ``pdf``; none: no figures
        figures : ``all``: the paper's figures too

        Raises
        ------
        OutputError
            A file or directory that is not a dropout report is there, or a file cannot be written.
        """
        from icrtool.output.dropout_directory import write_report

        if path is None:
            if self.run_directory is None:
                raise ValueError("path: the run was not read from a directory; name a directory for its report")
            path = self.run_directory / "dropout"
        write_report(lambda _: self, Path(path), plots=plots, figures=figures)

    def __repr__(self) -> str:
        icr, h = self.result("icr"), self.horizons_m
        error = f", ICR 95 % {icr.column('p95_m')[-1]:.3g} m after {h[-1]:g} m" if icr is not None else ""
        limits = f", acceptance limits {'met' if self.passed else 'NOT MET'}" if self.document.gates else ""
        states = self.document.starts
        return f"<DropoutReport {self.name!r}: {len(self.results)} models from {states:,} states{error}{limits}>"

    def _repr_html_(self) -> str:
        from icrtool.output.tables.dropout import format_dropout

        return f"<pre>{escape(format_dropout(self))}</pre>"


@dataclass(frozen=True, slots=True)
class BaselineReport:
    """An earlier report that a report is compared with.

    Attributes
    ----------
    log : name of the log; path : path of the report
    document : content of the report
    drives : the reports whose mean is `document`, from `pooled_baseline`; empty for a single report
    """

    log: str
    path: str
    document: documents.DropoutDocument
    drives: tuple[documents.DropoutDocument, ...] = ()

    @property
    def sha256(self) -> tuple[str, ...]:
        """SHA-256 of each file of the log; empty if the SHA-256 of a file is not known."""
        return known_content(file.sha256 for file in self.document.run.inputs)

    @property
    def tool_version(self) -> str:
        """Version of icrtool that made the report."""
        return escaped(self.document.tool_version)

    def at(self, model: str, horizon_m: float) -> tuple[documents.ErrorRow | None, BlockSums | None]:
        """Return the numbers of a model at a horizon, and their block sums; None if the report does not have them."""
        for result in self.document.models:
            for row in result.by_horizon:
                if result.name == model and math.isclose(row.horizon_m, horizon_m, rel_tol=1e-6):
                    sums_there = next((sums for sums in result.blocks if sums.horizon_m == row.horizon_m), None)
                    if sums_there is None:
                        return row, None
                    counts = (
                        np.array(column, np.int64)
                        for column in (sums_there.trials, sums_there.above_p50, sums_there.above_p95)
                    )
                    trials, above_p50, above_p95 = counts
                    growth = (
                        float(documents.column_of([sums_there], name)[0]) for name in ("p50_slope_m", "p95_slope_m")
                    )
                    return row, BlockSums(
                        trials, np.array(sums_there.errors_m, np.float64), above_p50, above_p95, *growth
                    )
        return None, None

    def number_for(self, gate: Gate) -> tuple[float, BlockSums | None]:
        """Return the number [m] that a limit bounds, NaN if the report has none, and its block sums.

        Raises
        ------
        ConfigError
            The report has no such model or horizon.
        """
        if gate.budget_m is None:
            row, sums = self.at(gate.model, gate.horizon_m or math.nan)
            if row is None:
                why = f"no {gate.model} over {gate.horizon_m:g} m in the baseline {self.path}"
                raise ConfigError(f"gate {gate.text!r}", why, "make the baseline again")
            return float(documents.column_of([row], METRICS[gate.metric])[0]), sums
        rows = [row for result in self.document.models if result.name == gate.model for row in result.by_horizon]
        if not rows:
            raise ConfigError(f"gate {gate.text!r}", f"no {gate.model} in the baseline {self.path}", "make it again")
        rows.sort(key=lambda row: row.horizon_m)
        reached = within_budget(
            documents.column_of(rows, "horizon_m"), documents.column_of(rows, DISTANCES[gate.metric]), gate.budget_m
        )
        return (math.nan if reached is None else reached[0]), None

    def changes(self, run_document: RunDocument) -> tuple[str, ...]:
        """Return the differences in log, configuration and version, one sentence each."""
        differences = []
        if not self.is_of(run_document):
            differences.append(
                f"the recording differs from the baseline ({self.log}), so the difference has a wider interval"
            )
        keys = sorted(_different_keys(self.document.run.config.effective(), run_document.config.effective()))
        if keys:
            differences.append(f"the configuration differs from the baseline: {listed(keys, 5)}")
        if self.tool_version != __version__:
            differences.append(f"icrtool is {__version__}, and the baseline was made with {self.tool_version}")
        return tuple(differences)

    def is_of(self, run_document: RunDocument) -> bool:
        """Return whether the report is of the same recording as a run."""
        return not self.drives and bool(self.sha256) and self.sha256 == run_document.content

    def half_width(
        self, model: str, horizon_m: float, metric: str, now: BlockSums | None, factor: float, *, same: bool
    ) -> float:
        """Return half the 95 % interval [m] of ``number - factor * baseline``; NaN if there is no interval.

        Parameters
        ----------
        model, horizon_m, metric : row, distance and name of the number
        now : block sums of the number
        factor : factor of the baseline
        same : number and baseline are of the same recording

        Notes
        -----
        For pooled drives, the squares of two half widths are added. The first comes from the variance between drives,
        which counts for the new drive and for the mean of the others. It is pooled from the given drives and other
        robots (`icrtool.kernels.error_statistics.pooled_variance`). The second comes from the blocks of the new drive.
        """
        if not self.drives:
            return difference_half_width(now, self.at(model, horizon_m)[1], metric, factor, paired=same)
        if now is None or metric not in {"expected", "p50", "p95"}:
            return math.nan
        logarithms = np.log(_positive(_numbers_of(self.drives, model, horizon_m, METRICS[metric])))
        if not len(logarithms):
            return math.nan
        count = len(logarithms)
        measured = float(logarithms.var(ddof=1)) if count > 1 else 0.0
        drive_variance, freedom = pooled_variance(measured, count - 1.0, row_of(model).spread.between ** 2)
        before = factor * math.exp(float(logarithms.mean()))
        between = student_factor(freedom) * math.sqrt(drive_variance * (1.0 + 1.0 / count)) * before
        path_half = student_factor(len(now.trials) - 1.0) * math.sqrt(variance_of_sum(now.influence(metric)))
        return math.hypot(between, path_half)


def pooled_baseline(drives: Sequence[documents.DropoutDocument], log: str, path: str) -> BaselineReport:
    """Return the reports of several drives as one baseline.

    Parameters
    ----------
    drives : reports of at least one drive of the same robot, without the drive that is compared
    log : name of the baseline; path : place of the reports

    Notes
    -----
    Each number of the baseline is the geometric mean over the drives, because errors of drives differ by a factor.
    """
    first, models = drives[0], []
    for model in first.models:
        rows = []
        for row in model.by_horizon:
            numbers = {name: _numbers_of(drives, model.name, row.horizon_m, name) for name in _ERROR_COLUMNS}
            means = {name: float(np.exp(np.log(_positive(values)).mean())) for name, values in numbers.items()
                     if len(_positive(values))}  # fmt: skip
            rows.append(replace(row, **{name: means.get(name) for name in _ERROR_COLUMNS}))
        models.append(replace(model, by_horizon=rows, blocks=[]))
    return BaselineReport(log, path, replace(first, models=models), tuple(drives))


_ERROR_COLUMNS = tuple(name for name in documents.SummaryRow.__struct_fields__ if name not in ("horizon_m", "trials"))
"""Fields of a row of errors that are numbers."""


def _numbers_of(drives: Sequence[documents.DropoutDocument], model: str, horizon_m: float, name: str) -> Floats:
    """Return a number of a row at a horizon in each drive that has it (d,)."""
    rows = [
        row
        for drive in drives
        for result in drive.models
        for row in result.by_horizon
        if result.name == model and math.isclose(row.horizon_m, horizon_m, rel_tol=1e-6)
    ]
    column = documents.column_of(rows, name)
    return np.asarray(column[np.isfinite(column)])


def _positive(numbers: Floats) -> Floats:
    """Return the numbers above zero."""
    return np.asarray(numbers[numbers > 0.0])


def _different_keys(before: Mapping[str, object], now: Mapping[str, object], prefix: str = "") -> Iterator[str]:
    """Yield the keys at which two configurations differ."""
    for key in {*before, *now}:
        old, new = before.get(key), now.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from _different_keys(old, new, f"{prefix}{key}.")
        elif old != new:
            yield f"{prefix}{key}"


def budget_distances(report: OpenLoopErrors, budget_m: float) -> tuple[BudgetDistance, ...]:
    """Return the distance up to which p95 of each model stays within a budget [m]; models without trials are left out.

    Raises
    ------
    ConfigError
        The budget is not a positive number.
    """
    if not (math.isfinite(budget_m) and budget_m > 0):
        raise ConfigError("budget", f"{budget_m:g} m is no length", "give positive metres")
    distances = []
    for result in report.results:
        reached = within_budget(report.horizons_m, result.column("p95_m"), budget_m)
        if reached is not None:
            ends = (
                within_budget(report.horizons_m, result.column(name), budget_m)
                for name in ("p95_high_m", "p95_low_m", "p95_next_high_m", "p95_next_low_m")
            )
            # A bound that stays within the budget at every horizon with an interval has no distance.
            low, high, next_low, next_high = (None if end is None or end[1] else end[0] for end in ends)
            without_events_p95_m = documents.column_of(result.without_events, "p95_m")
            without_events_reach = None
            if len(without_events_p95_m):
                without_events_reach = within_budget(report.horizons_m, without_events_p95_m, budget_m)
            without_events = (None, False) if without_events_reach is None else without_events_reach[:2]
            ends_m = low, high, next_low, next_high
            distances.append(BudgetDistance(result.name, budget_m, *reached, *ends_m, *without_events))
    return tuple(distances)


def best_row(
    errors: OpenLoopErrors, calibrations: Sequence[documents.UsedCalibration] = ()
) -> documents.BestRow | None:
    """Return the best row for driving by wheels alone; None if no row that a robot can drive with has trials.

    Parameters
    ----------
    calibrations : calibrations of the report; a calibration that was fitted to this log is not compared

    Notes
    -----
    The best row has the smallest expected error near 10 m, because a mean has less random variation than a percentile.
    A row for comparison is as good if its expected error is smaller, or if it is larger by less than the interval of
    the difference and the intervals of both expected errors overlap. The difference alone is not enough: if all turns
    of a drive lie in one block of path, its interval is wider than any error.
    """
    not_compared = {used.name for used in calibrations if used.fitted_to_this}
    # A scored topic is not compared, because the localisation on the robot uses further sensors.
    not_compared |= {result.name for result in errors.results if kind_of(result.name) == TOPIC_ROW}
    rows = {
        result.name: row_of(result.name)
        for result in errors.results
        if not turned_by(result.name) and result.name not in not_compared
    }
    results = {result.name: result for result in errors.results if result.name in rows and rows[result.name].on_robot}
    means = {name: result.column("expected_error_m") for name, result in results.items()}
    driven = {name: mean for name, mean in means.items() if not rows[name].compared and np.isfinite(mean).any()}
    if not driven:
        return None
    tested = np.all([np.isfinite(mean) for mean in driven.values()], axis=0)
    if not tested.any():
        return None
    h = int(np.argmin(np.where(tested, np.abs(errors.horizons_m - CHOICE_HORIZON_M), np.inf)))
    best = min(driven, key=lambda name: float(driven[name][h]))
    least, as_good = float(driven[best][h]), []
    for name in (name for name in means if rows[name].compared and math.isfinite(means[name][h])):
        sums = results[best].block_sums[h], results[name].block_sums[h]
        half = difference_half_width(*sums, "expected", 1.0, paired=True)
        apart = results[name].column("expected_low_m")[h] > results[best].column("expected_high_m")[h]
        if (worse := float(means[name][h]) - least) <= 0.0 or (worse <= half and not apart):
            as_good.append(name)
    heading = start_heading(results[best], h, errors.run_document.heading.source)
    return documents.BestRow(best, float(errors.horizons_m[h]), least, tuple(as_good), heading)


ROOT_HALF = math.sqrt(0.5)
"""Ratio of two errors below which the square of the first is less than half of the square of the second.

Squares are compared because the squares of independent parts of an error add up."""

ESTIMATED_HEADINGS = ("gyro_course", "wheels_course")
"""Sources of headings that no sensor measures."""


def start_heading(result: documents.ModelResult, h: int, source: str) -> documents.StartHeading | UnsetType:
    """Return how much of the error comes from the headings at the starts; UNSET if it is not known or small.

    Parameters
    ----------
    result : result of a row
    h : number of the horizon
    source : source of the heading, as in run.json
    """
    aligned = result.aligned[h] if result.aligned else None
    if aligned is None:
        return UNSET
    expected, p95 = (float(result.column(name)[h]) for name in ("expected_error_m", "p95_m"))
    half = difference_half_width(aligned.sums, result.block_sums[h], "p95", ROOT_HALF, paired=True)
    dominates = aligned.p95_m - ROOT_HALF * p95 + half < 0.0
    mend = "check the heading sensor's mounting and calibration"
    if source in ESTIMATED_HEADINGS:
        mend = "mount an AHRS or a second antenna"
    mend = f"{mend}, or drive straight for some metres before GNSS is lost"
    return documents.StartHeading(expected, p95, aligned.expected_m, aligned.p95_m, dominates, mend)


def parse_gate(text: str) -> Gate:
    """Return the acceptance limit that a text states.

    Raises
    ------
    ConfigError
        The text is neither of the form ``model.metric@HORIZONm <= bound`` nor ``… <= FACTOR * baseline + OFFSET m``.
    """
    match = _FORM.match(text)
    if match is None:
        form = (
            "model.p50|p95|expected|max|p95_next@HORIZONm <= metres, model.within|within_next@ERRORm >= metres, "
            "or [FACTOR *] baseline"
        )
        example = 'for example "recommended.p95@10m <= 1.2" or "recommended.within@0.5m >= 10"'
        raise ConfigError(f"gate {text!r}", f"not of the form {form}", example)
    at_m, within = float(match["at"]), match["metric"] in DISTANCES
    if not at_m > 0:
        raise ConfigError(
            f"gate {text!r}", "its distance or error is 0 m", "give a number above zero, for example @10m"
        )
    factor = float(match["factor"] or 1.0) if match["baseline"] else 0.0
    bound_m = float((match["bound"] or match["offset"] or "0").replace(" ", ""))
    if not all(map(math.isfinite, (at_m, factor, bound_m))):
        raise ConfigError(f"gate {text!r}", "a number is too large", "give metres, for example 1.2")
    return Gate(
        " ".join(text.split()), match["model"], match["metric"], None if within else at_m, match["relation"], bound_m,
        factor, at_m if within else None,
    )  # fmt: skip


def check_gate(
    gate: Gate, report: OpenLoopErrors, baseline: BaselineReport | None = None, *, strict: bool = False
) -> Verdict:
    """Return the verdict of an acceptance limit on a report.

    Parameters
    ----------
    gate, report : the limit, and the report
    baseline : earlier report, for limits relative to it; without it such a limit is not checked
    strict : a relative limit fails if the number is beyond it; otherwise only if the interval of the margin is, too

    Raises
    ------
    ConfigError
        The report or the baseline has no such model or horizon.
    """
    if (result := report.result(gate.model)) is None:
        choices = ", ".join(result.name for result in report.results)
        advice = f"this run has {choices}; no_slip needs robot.track_width_m"
        raise ConfigError(f"gate {gate.text!r}", f"no model {gate.model}", advice)
    sums = None
    if gate.budget_m is not None:
        reached = within_budget(report.horizons_m, result.column(DISTANCES[gate.metric]), gate.budget_m)
        value = math.nan if reached is None else reached[0]
    else:
        places = np.flatnonzero(np.isclose(report.horizons_m, gate.horizon_m or math.nan))
        if not len(places):
            choices = ", ".join(f"{horizon:g}" for horizon in report.horizons_m)
            raise ConfigError(f"gate {gate.text!r}", f"no horizon of {gate.horizon_m:g} m", f"use {choices}")
        h = int(places[0])
        value, sums = float(result.column(METRICS[gate.metric])[h]), result.block_sums[h]
    half_width, before = math.nan, math.nan
    if gate.baseline_factor:
        if baseline is None:
            why = "this log is not in the baseline"
            return verdict_on(gate, report.run_document.log, value_m=value, passed=True, not_checked=why)
        before, _ = baseline.number_for(gate)
        if gate.horizon_m is not None:
            same = baseline.is_of(report.run_document)
            half_width = baseline.half_width(
                gate.model, gate.horizon_m, gate.metric, sums, gate.baseline_factor, same=same
            )
    bound = gate.bound_m + (gate.baseline_factor * before if gate.baseline_factor else 0.0)
    margin = bound - value if gate.relation.startswith("<") else value - bound
    passed = _RELATIONS[gate.relation](value, bound) or (not strict and margin + half_width >= 0.0)
    return verdict_on(
        gate, report.run_document.log, passed=passed, value_m=value, value_bound_m=bound, baseline_m=before,
        margin_m=margin, margin_low_m=margin - half_width, margin_high_m=margin + half_width,
    )  # fmt: skip


def verdict_on(gate: Gate, log: str, *, passed: bool, **found: float | str | None) -> Verdict:
    """Return the verdict on an acceptance limit, with a line that names the log.

    Parameters
    ----------
    gate, log, passed : the limit, the name of the log, and whether the limit is met
    found : further fields of `Verdict`; a number that is not finite becomes None
    """
    fields = {"value_m": None} | {name: plain_value(value) for name, value in found.items()}
    checked = Verdict(*astuple(gate), passed=passed, verdict="", **fields)
    return replace(checked, verdict=checked.line(log))
