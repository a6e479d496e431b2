"""The dropout report: the record that `icrtool.dropout` and `icrtool.dropout_report` return.

It stands here and not among the records because it holds a model comparison, which is made of fits. No code that makes
it is here, and no kernel: a process that only draws it need not load numba.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.open_loop.trials import TrialCounts
from icrtool.records.dropout import (
    BudgetDistance,
    EventCost,
    ExampleTrial,
    LearnedSplit,
    ModelResult,
    Outage,
    ReferenceErrors,
    TurningSplit,
    UsedCalibration,
    Verdict,
    error_columns,
)
from icrtool.records.late_output import FigureSet, call_output

if TYPE_CHECKING:
    import pandas as pd

    from icrtool.calibration.model_comparison import ModelComparison
    from icrtool.calibration.record import Calibration
    from icrtool.dropout_analysis.baseline import BaselineReport
    from icrtool.records.run_document import RunDocument


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
