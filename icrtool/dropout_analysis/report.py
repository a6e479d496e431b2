"""The dropout report: the record that `icrtool.dropout` and `icrtool.dropout_report` return.

It stands here and not among the records because it holds a model comparison, which is made of fits. No code that makes
it is here, and no kernel: a process that only draws it need not load numba.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from icrtool import __version__
from icrtool.errors import ConfigError
from icrtool.kernels.arrays import Floats
from icrtool.kernels.error_statistics import BlockSums
from icrtool.kernels.track import TrialCounts
from icrtool.records.dropout import Gate
from icrtool.records.dropout_document import (
    BaselineDocument,
    BlocksDocument,
    DropoutDocument,
    EarlierReport,
    ErrorRow,
    ExampleTrial,
    LearnedDocument,
    ModelResult,
    Outage,
    ReferenceRow,
    SummaryRow,
    column_of,
)
from icrtool.records.run import FigureSet, call_output
from icrtool.records.run_document import RunDocument, known_content
from icrtool.records.text import escaped, listed

if TYPE_CHECKING:
    import pandas as pd

    from icrtool.calibration.record import Calibration


@dataclass(frozen=True, slots=True, eq=False)
class OpenLoopErrors:
    """Errors of open-loop trials by model and horizon.

    Attributes
    ----------
    run : document of the run
    horizons_m : (h,) ascending
    results : one per model
    counts : trials, and starts without a trial, by horizon; the same for every model
    states : recorded states
    standing : states in which the robot stood: their trials are nearly copies of one another
    reference : what a perfect model would show, by horizon
    by_learning : trials of the momentary ICRs before and after the ICRs were first learned; None without that model
    """

    run: RunDocument
    horizons_m: Floats
    results: tuple[ModelResult, ...]
    counts: TrialCounts
    states: int
    standing: int
    reference: tuple[ReferenceRow, ...]
    by_learning: LearnedDocument | None

    def result(self, model: str) -> ModelResult | None:
        """Return the result of a model, None when it was not computed."""
        return next((result for result in self.results if result.name == model), None)


@dataclass(frozen=True, slots=True, repr=False, eq=False)
class DropoutReport:
    """Open-loop errors by model and horizon, and what else was asked for.

    `icrtool.dropout` gives the errors alone, `icrtool.dropout_report` all of it.

    Attributes
    ----------
    document : what report.json holds
    errors : the errors with their histograms
    run_directory : where the run was read from, None for one just made
    reference_north_m, reference_east_m : (n,) what trials are compared with, at every state
    usable : distances and numbers may be used, or were asked for all the same
    worst, examples, outages : those of `document`, with their paths
    calibration : of this run alone, which `recommended` stands for; None where it was left out
    baseline : an earlier report that this one is compared with
    """

    document: DropoutDocument
    errors: OpenLoopErrors
    run_directory: Path | None
    reference_north_m: Floats
    reference_east_m: Floats
    usable: bool = True
    worst: tuple[ExampleTrial, ...] = ()
    examples: tuple[ExampleTrial, ...] = ()
    outages: tuple[Outage, ...] = ()
    calibration: Calibration | None = None
    baseline: BaselineReport | None = None

    @property
    def name(self) -> str:
        """Name of the log."""
        return self.document.run.log

    @property
    def run_document(self) -> RunDocument:
        """What run.json of the run holds."""
        return self.errors.run

    @property
    def horizons_m(self) -> Floats:
        """Distances without GNSS (h,), ascending."""
        return self.errors.horizons_m

    @property
    def results(self) -> tuple[ModelResult, ...]:
        """The errors of each model."""
        return self.errors.results

    @property
    def passed(self) -> bool:
        """Whether every acceptance limit is met."""
        return self.document.passed

    def result(self, model: str) -> ModelResult | None:
        """Return the result of a model, None when it was not computed."""
        return self.errors.result(model)

    @property
    def summary(self) -> pd.DataFrame:
        """The rows of summary.csv as a DataFrame."""
        import pandas as pd

        h, models = len(self.horizons_m), self.document.models
        rows = [row for one in models for row in one.by_horizon]
        columns = {name: column_of(rows, name) for name in SummaryRow.__struct_fields__}
        columns["trials"] = columns["trials"].astype(np.int64)
        return pd.DataFrame({"model": [one.name for one in models for _ in range(h)], **columns})

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
        icr, h = self.result("icr"), self.horizons_m
        error = f", ICR 95 % {icr.column('p95_m')[-1]:.3g} m after {h[-1]:g} m" if icr is not None else ""
        limits = f", acceptance limits {'met' if self.passed else 'NOT MET'}" if self.document.gates else ""
        states = self.document.starts
        return f"<DropoutReport {self.name!r}: {len(self.results)} models from {states:,} states{error}{limits}>"

    def _repr_html_(self) -> str:
        return f"<pre>{escape(call_output('tables.dropout', 'format_dropout', self))}</pre>"


@dataclass(frozen=True, slots=True)
class BaselineReport:
    """An earlier report.

    Attributes
    ----------
    log : name of its log; path : of the report
    document : what it holds
    """

    log: str
    path: str
    document: EarlierReport

    @property
    def sha256(self) -> tuple[str, ...]:
        """SHA-256 of each file of its log; none where one is not known."""
        return known_content(one.sha256 for one in self.document.run.inputs)

    @property
    def tool_version(self) -> str:
        """Version that made it."""
        return escaped(self.document.tool_version)

    def at(self, model: str, horizon_m: float) -> tuple[ErrorRow | None, BlockSums | None]:
        """Return the numbers of a model at a horizon, and their block sums; None for what the report does not have."""
        for one in self.document.models:
            for row in one.by_horizon:
                if one.name == model and math.isclose(row.horizon_m, horizon_m, rel_tol=1e-6):
                    return row, next((_sums(sums) for sums in one.blocks if sums.horizon_m == row.horizon_m), None)
        return None, None

    def row(self, gate: Gate) -> tuple[ErrorRow, BlockSums | None]:
        """Return what `at` does for the model and horizon that a gate names.

        Raises
        ------
        ConfigError
            The report has no such model or horizon.
        """
        row, sums = self.at(gate.model, gate.horizon_m or math.nan)
        if row is None:
            what = f"no {gate.model} over {gate.horizon_m:g} m"
            raise ConfigError(f"gate {gate.text!r}", f"{what} in the baseline {self.path}", "make the baseline again")
        return row, sums

    def p95_of(self, gate: Gate) -> tuple[Floats, Floats]:
        """Return distances (h,) and p95 (h,) [m] of the model that a gate names.

        Raises
        ------
        ConfigError
            The report has no such model.
        """
        rows = [row for one in self.document.models if one.name == gate.model for row in one.by_horizon]
        if not rows:
            raise ConfigError(f"gate {gate.text!r}", f"no {gate.model} in the baseline {self.path}", "make it again")
        rows.sort(key=lambda row: row.horizon_m)
        return column_of(rows, "horizon_m"), column_of(rows, "p95_m")

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

    def compared_with(self, run_document: RunDocument) -> BaselineDocument:
        """Return what a report of a run holds of this one."""
        same, changes = self.is_of(run_document), self.changes(run_document)
        return BaselineDocument(self.path, self.log, self.tool_version, same, changes)

    def is_of(self, run_document: RunDocument) -> bool:
        """Return whether the report was made of the same recording as a run."""
        return bool(self.sha256) and self.sha256 == run_document.content


def _sums(one: BlocksDocument) -> BlockSums:
    trials, p50, p95 = (np.array(column, np.int64) for column in (one.trials, one.above_p50, one.above_p95))
    growth = (float(column_of([one], name)[0]) for name in ("p50_slope_m", "p95_slope_m"))
    return BlockSums(trials, np.array(one.errors_m, np.float64), p50, p95, *growth)


def _different_keys(before: Mapping[str, object], now: Mapping[str, object], prefix: str = "") -> Iterator[str]:
    for key in {*before, *now}:
        old, new = before.get(key), now.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from _different_keys(old, new, f"{prefix}{key}.")
        elif old != new:
            yield f"{prefix}{key}"
