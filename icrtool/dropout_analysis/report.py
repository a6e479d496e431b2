"""The dropout report: the record that `icrtool.dropout` and `icrtool.dropout_report` return.

It stands here and not among the records because it holds a model comparison, which is made of fits. No code that makes
it is here, and no kernel: a process that only draws it need not load numba.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from icrtool import __version__
from icrtool.errors import ConfigError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.error_statistics import BlockSums
from icrtool.kernels.track import TrialCounts
from icrtool.records.dropout import (
    METRICS,
    BudgetDistance,
    EventCost,
    ExampleTrial,
    Gate,
    LearnedSplit,
    ModelResult,
    Outage,
    ReferenceErrors,
    TurningSplit,
    UsedCalibration,
    Verdict,
    error_columns,
)
from icrtool.records.dropout_document import BlocksDocument, EarlierReport
from icrtool.records.run import FigureSet, call_output
from icrtool.records.run_document import RunDocument
from icrtool.records.text import escaped, listed

if TYPE_CHECKING:
    import pandas as pd

    from icrtool.calibration.model_comparison import ModelComparison
    from icrtool.calibration.record import Calibration


@dataclass(frozen=True, slots=True, repr=False, eq=False)
class DropoutReport:
    """Open-loop errors by model and horizon, and what else was asked for.

    `icrtool.dropout` gives the errors alone, `icrtool.dropout_report` all of it.

    Attributes
    ----------
    horizons_m : (h,) ascending
    results : one per model
    counts : trials, and starts without a trial, by horizon; the same for every model
    states : recorded states
    standing : states in which the robot stood: their trials are nearly copies of one another
    seed : of what the reference's own error is drawn from
    run_document : of the run, equal to its run.json
    run_directory : where the run was read from, None for one just made
    starts : ``moving``: each standstill is one start; ``all``: every state is one
    reference_error : what a perfect model would show
    by_learning : trials of the momentary ICRs before and after the ICRs were first learned; None without that model
    reference_north_m, reference_east_m : (n,) what trials are compared with, at every state
    with_jumps : trials across jumps of the reference count, where the run has any
    smoothed : the reference is the smoother's trajectory, not the filter's
    budgets : by budget and model
    verdicts : of the acceptance limits
    worst : trials with the largest error first
    examples : a trial of about half a turn and a straight one; empty where no trial is that long
    outages : forced ones, then real ones
    by_turning : straight and turning trials apart
    comparison : the models on distance they were not fitted to; None where left out, `no_comparison` holds the reason
    usable : distances and numbers may be used, or were asked for all the same
    calibrations : those with a row of their own
    baseline : an earlier report that this one is compared with
    event_cost : how much slip events change the errors, where trials that cross one are left out; None where they count
    """

    name: str
    horizons_m: Floats
    results: tuple[ModelResult, ...]
    counts: TrialCounts
    states: int
    standing: int
    seed: int
    run_document: RunDocument
    run_directory: Path | None
    reference_north_m: Floats
    reference_east_m: Floats
    starts: Literal["moving", "all"] = "moving"
    reference_error: ReferenceErrors | None = None
    by_learning: LearnedSplit | None = None
    smoothed: bool = False
    with_jumps: bool = False
    budgets: tuple[BudgetDistance, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    worst: tuple[ExampleTrial, ...] = ()
    examples: tuple[ExampleTrial, ...] = ()
    outages: tuple[Outage, ...] = ()
    by_turning: tuple[TurningSplit, ...] = ()
    comparison: ModelComparison | None = None
    no_comparison: str = ""
    usable: bool = True
    calibrations: tuple[UsedCalibration, ...] = ()
    baseline: BaselineReport | None = None
    event_cost: EventCost | None = None

    @property
    def calibration(self) -> Calibration | None:
        """The calibration of this run alone, which `recommended` stands for; None where it was left out."""
        return self.comparison.calibration if self.comparison is not None else None

    @property
    def passed(self) -> bool:
        """Whether every acceptance limit is met."""
        return all(verdict.passed for verdict in self.verdicts)

    def result(self, model: str) -> ModelResult | None:
        """Return the result of a model, None when it was not computed."""
        return next((result for result in self.results if result.name == model), None)

    @property
    def best(self) -> str:
        """Name of the model that the report is about: `recommended`, else the filter's momentary ICRs."""
        return "recommended" if self.result("recommended") is not None else "icr"

    @property
    def summary(self) -> pd.DataFrame:
        """The rows of summary.csv as a DataFrame."""
        import pandas as pd

        return pd.DataFrame(self.summary_columns())

    def summary_columns(self) -> dict[str, list[str] | Floats | Ints]:
        """Return the columns of summary.csv: a row per model and horizon."""
        h = self.horizons_m
        parts = [
            error_columns(one.summary)
            | {"expected_pct": 100.0 * one.summary.expected / h, "p95_pct": 100.0 * one.summary.p95 / h}
            | {f"{name}_m": values for name, values in one.intervals._asdict().items()}
            | {f"heading_{name}": values for name, values in one.heading._asdict().items()}
            for one in self.results
        ]
        return {
            "model": [one.name for one in self.results for _ in h],
            "horizon_m": np.tile(h, len(parts)),
            **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
        }

    def write(
        self, path: str | Path | None = None, *, plots: tuple[str, ...] = ("png",), figures: FigureSet = "default"
    ) -> None:
        """Write summary.csv, histogram.csv, report.json, the other tables and the figures, whole or not at all.

        Parameters
        ----------
        path : directory of the report; default: ``dropout`` in the directory the run was read from
        plots : formats of the figures, of ``png``, ``svg`` and ``pdf``; none: no figures
        figures : ``all``: those of the paper too

        Raises
        ------
        OutputError
            Something that is not a dropout report is there, or the disk does not take it.
        """
        if path is None:
            if self.run_directory is None:
                raise ValueError("path: this run was not read from a directory; name one for its report")
            path = self.run_directory / "dropout"
        call_output("dropout_directory", "write_report", lambda _: self, Path(path), plots=plots, figures=figures)

    def __repr__(self) -> str:
        icr, last = self.result("icr"), len(self.horizons_m) - 1
        error = f", ICR 95 % {icr.summary.p95[last]:.3g} m after {self.horizons_m[last]:g} m" if icr is not None else ""
        limits = f", acceptance limits {'met' if self.passed else 'NOT MET'}" if self.verdicts else ""
        return f"<DropoutReport {self.name!r}: {len(self.results)} models from {self.states:,} states{error}{limits}>"

    def _repr_html_(self) -> str:
        return f"<pre>{escape(call_output('tables.dropout', 'format_dropout', self))}</pre>"


class BaselineRow(NamedTuple):
    """The numbers of one model and horizon by metric [m], and their block sums; None where the report has none."""

    values_m: Mapping[str, float]
    sums: BlockSums | None


@dataclass(frozen=True, slots=True)
class BaselineReport:
    """An earlier report.

    Attributes
    ----------
    log : name of its log; path : of the report
    document : what it holds
    rows : its numbers by model and horizon [m]
    """

    log: str
    path: str
    document: EarlierReport
    rows: Mapping[tuple[str, float], BaselineRow]

    @property
    def sha256(self) -> tuple[str, ...]:
        """SHA-256 of each file of its log; none where one is not known."""
        return known_content(one.sha256 for one in self.document.run.inputs)

    @property
    def tool_version(self) -> str:
        """Version that made it."""
        return escaped(self.document.tool_version)

    def row(self, gate: Gate) -> BaselineRow:
        """Return the row that a gate names.

        Raises
        ------
        ConfigError
            The report has no such model or horizon.
        """
        for (model, horizon_m), row in self.rows.items():
            if model == gate.model and math.isclose(horizon_m, gate.horizon_m or math.nan, rel_tol=1e-6):
                return row
        what = f"no {gate.model} over {gate.horizon_m:g} m"
        raise ConfigError(f"gate {gate.text!r}", f"{what} in the baseline {self.path}", "make the baseline again")

    def p95_of(self, gate: Gate) -> tuple[Floats, Floats]:
        """Return distances (h,) and p95 (h,) [m] of the model that a gate names.

        Raises
        ------
        ConfigError
            The report has no such model.
        """
        found = sorted((at, row.values_m["p95"]) for (model, at), row in self.rows.items() if model == gate.model)
        if not found:
            raise ConfigError(f"gate {gate.text!r}", f"no {gate.model} in the baseline {self.path}", "make it again")
        horizons_m, p95_m = np.array(found).T
        return horizons_m, p95_m

    def changes(self, run_document: RunDocument) -> tuple[str, ...]:
        """Return what differs beside the numbers: log, configuration, version; a sentence each."""
        found = []
        if not self.is_of(run_document):
            found.append(f"another recording than in the baseline ({self.log}): the difference has a wider interval")
        keys = sorted(_different_keys(self.document.run.config, run_document.config.effective()))
        if keys:
            found.append(f"another configuration than in the baseline: {listed(keys)}")
        if self.tool_version != __version__:
            found.append(f"icrtool {__version__}; the baseline was made with {self.tool_version}")
        return tuple(found)

    def is_of(self, run_document: RunDocument) -> bool:
        """Return whether the report was made of the same recording as a run."""
        return bool(self.sha256) and self.sha256 == run_document.content


def baseline_report(document: EarlierReport, path: str, log: str) -> BaselineReport:
    """Return an earlier report; parameters as the fields."""
    rows = {}
    for model in document.models:
        sums = {one.horizon_m: _sums(one) for one in model.blocks}
        for row in model.by_horizon:
            values = {metric: _number(getattr(row, column)) for metric, (_, column) in METRICS.items()}
            rows[model.name, row.horizon_m] = BaselineRow(values, sums.get(row.horizon_m))
    return BaselineReport(log, path, document, rows)


def _sums(one: BlocksDocument) -> BlockSums:
    trials, p50, p95 = (np.array(column, np.int64) for column in (one.trials, one.above_p50, one.above_p95))
    errors = np.array([_number(error) for error in one.errors_m])
    return BlockSums(trials, errors, p50, p95, _number(one.p50_slope_m), _number(one.p95_slope_m))


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def known_content(content: Iterable[str | None]) -> tuple[str, ...]:
    """Return the SHA-256 of the files of a log; none where one is not known."""
    found = tuple(content)
    return () if None in found else tuple(map(str, found))


def _different_keys(before: Mapping[str, object], now: Mapping[str, object], prefix: str = "") -> Iterator[str]:
    for key in {*before, *now}:
        old, new = before.get(key), now.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from _different_keys(old, new, f"{prefix}{key}.")
        elif old != new:
            yield f"{prefix}{key}"
