"""GPS-dropout analysis: open loop from every recorded state, over every horizon (Pentzer 2014, Section 6.4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from icrtool.core.open_loop import Drive, FrozenIcrs, TrialCounts, count_trials, trial_ends
from icrtool.core.open_loop_fast import open_loop_errors
from icrtool.core.statistics import Histogram, Intervals, Summary, bootstrap_intervals, histogram, round_bin_width, summarise
from icrtool.errors import DataError
from icrtool.tables import Bools, Floats, Ints, States

if TYPE_CHECKING:
    import pandas as pd

DEFAULT_HORIZONS_M = tuple(float(metres) for metres in range(1, 21))
DEFAULT_SEED = 20140311
"""Seed of the bootstrap: any number, but the same for every run and every model."""

LARGEST_TABLE_BYTES = 1 << 27
"""Errors held at a time: horizons are taken in groups that keep below it, whatever the length of the log."""


class DrivenRun(Protocol):
    """A filter run, just made or read back: what the analysis needs of it."""

    @property
    def name(self) -> str:
        """Name of the log."""
        ...

    @property
    def table(self) -> States:
        """The recorded states."""
        ...

    @property
    def in_gap(self) -> Bools:
        """Whether the interval after a state is a gap in the wheel data (n,)."""
        ...

    @property
    def outages_ns(self) -> Ints:
        """Half-open spans without usable GNSS (k, 2)."""
        ...

    @property
    def track_width_m(self) -> float | None:
        """Distance b between the track centre lines, None where not given."""
        ...


class Model(NamedTuple):
    """A way to predict motion from wheel speeds: ICRs per start, or one triple."""

    name: str
    label: str
    icrs: FrozenIcrs


class ModelResult(NamedTuple):
    """What one model's trials say, by horizon."""

    name: str
    label: str
    summary: Summary
    intervals: Intervals
    histograms: tuple[Histogram, ...]


ErrorSink = Callable[[str, Floats, Floats], None]
"""Called with a model's name, horizons (h,) [m] and errors (n, h) [m], NaN where there is no trial."""


@dataclass(frozen=True, slots=True)
class DropoutReport:
    """Open-loop errors by model and horizon.

    Attributes
    ----------
    horizons_m : (h,) ascending
    results : one per model
    counts : trials, and starts that were none, by horizon; the same for every model
    """

    name: str
    horizons_m: Floats
    results: tuple[ModelResult, ...]
    counts: TrialCounts
    states: int
    seed: int

    def result(self, model: str) -> ModelResult | None:
        """Return the result of a model, None when it was not computed."""
        return next((result for result in self.results if result.name == model), None)

    @property
    def summary(self) -> pd.DataFrame:
        """The rows of summary.csv as a DataFrame."""
        import pandas as pd

        return pd.DataFrame(self.summary_columns())

    def summary_columns(self) -> dict[str, list[str] | Floats | Ints]:
        """Return the columns of summary.csv: a row per model and horizon."""
        h = self.horizons_m
        names = [result.name for result in self.results for _ in h]
        horizon = np.tile(h, len(self.results))

        def stacked(values: Sequence[Floats]) -> Floats:
            return np.concatenate(values) if values else np.empty(0)

        summaries = [result.summary for result in self.results]
        intervals = [result.intervals for result in self.results]
        expected, p95 = stacked([s.expected for s in summaries]), stacked([s.p95 for s in summaries])
        return {
            "model": names,
            "horizon_m": horizon,
            "trials": np.concatenate([s.trials for s in summaries]) if summaries else np.empty(0, np.int64),
            "expected_error_m": expected,
            "p50_m": stacked([s.p50 for s in summaries]),
            "p95_m": p95,
            "max_m": stacked([s.largest for s in summaries]),
            "expected_pct": 100.0 * expected / horizon,
            "p95_pct": 100.0 * p95 / horizon,
            "expected_low_m": stacked([i.expected_low for i in intervals]),
            "expected_high_m": stacked([i.expected_high for i in intervals]),
            "p95_low_m": stacked([i.p95_low for i in intervals]),
            "p95_high_m": stacked([i.p95_high for i in intervals]),
        }


def dropout(
    run: DrivenRun, horizons_m: Sequence[float] | None = None, *, seed: int = DEFAULT_SEED, sink: ErrorSink | None = None
) -> DropoutReport:
    """Say how far off the robot is after driving blind, from every recorded state.

    Parameters
    ----------
    run : a `FilterRun`, or a run read back from its directory
    horizons_m : distances driven blind; default 1, 2, … 20 m
    seed : of the bootstrap
    sink : receives every single error (for ``--trials``)

    Returns
    -------
    DropoutReport

    Raises
    ------
    DataError
        The run has fewer than two states.

    Notes
    -----
    ICRs are frozen at the start, wheel speeds alone drive on, the error is the horizontal distance to the filter's
    estimate where the path has grown by the horizon. A start with less path left, a way across a gap in the wheel data
    and an end inside a real GNSS outage are no trials; they are counted. Overlapping trials are not independent: the
    intervals come from a moving-block bootstrap with blocks of the horizon's length.
    """
    if len(run.table) < 2:  # noqa: PLR2004 - an interval needs two ends
        raise DataError(run.name, f"the run has {len(run.table)} states", "at least two are needed")
    horizons = np.array(sorted(horizons_m if horizons_m is not None else DEFAULT_HORIZONS_M), np.float64)
    drive = drive_of(run)
    groups = _groups(len(horizons), len(run.table))
    counts: list[TrialCounts] = []
    parts: dict[str, list[ModelResult]] = {}
    models = models_of(run)
    for group in groups:
        ends = trial_ends(drive, horizons[group])
        counts.append(count_trials(ends))
        for model in models:
            errors = open_loop_errors(drive, model.icrs, ends)
            parts.setdefault(model.name, []).append(_judge(model, errors, drive, horizons[group], seed))
            if sink is not None:
                sink(model.name, horizons[group], errors)
    return DropoutReport(
        name=run.name,
        horizons_m=horizons,
        results=tuple(_joined(part) for part in parts.values()),
        counts=TrialCounts(*(np.concatenate(column) for column in zip(*counts, strict=True))),
        states=len(run.table),
        seed=seed,
    )


def models_of(run: DrivenRun) -> tuple[Model, ...]:
    """Return the models to judge: momentary ICRs, no slip where b is known, the run's final ICRs."""
    table = run.table
    models = [Model("icr", "ICR, momentary", FrozenIcrs(table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m))]
    width = run.track_width_m
    if width is not None:
        models.append(Model("no_slip", "no slip", FrozenIcrs.constant(width / 2, -width / 2, 0.0)))
    final = (float(column[-1]) for column in (table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m))
    models.append(Model("icr_final", "ICR, final", FrozenIcrs.constant(*final)))
    return tuple(models)


def drive_of(run: DrivenRun) -> Drive:
    """Return the run's states as the kernels want them."""
    table = run.table
    in_outage = np.zeros(len(table), np.bool_)
    for begin, end in run.outages_ns:
        # The last fix is still good at `begin`, and the first one again at `end`.
        in_outage |= (table.stamp_ns > begin) & (table.stamp_ns < end)
    return Drive(
        dt_s=np.append(np.diff(table.stamp_ns) / 1e9, 0.0),
        v_left=table.v_left_mps,
        v_right=table.v_right_mps,
        north=table.north_m,
        east=table.east_m,
        heading=table.heading_rad,
        distance=table.distance_m,
        gap=run.in_gap,
        in_outage=in_outage,
    )


def budget_distance(report: DropoutReport, model: str, budget_m: float) -> tuple[float, bool] | None:
    """Return how far a model's 95th percentile stays within a budget [m].

    Returns
    -------
    distance, beyond : interpolated between horizons, from 0 m at 0 m; `beyond` is True when the budget still held at
        the last horizon with trials. None without the model or without trials.
    """
    result = report.result(model)
    if result is None:
        return None
    told = np.isfinite(result.summary.p95)
    if not told.any():
        return None
    distance = np.concatenate([[0.0], report.horizons_m[told]])
    p95 = np.concatenate([[0.0], result.summary.p95[told]])
    over = np.flatnonzero(p95 > budget_m)
    if not len(over):
        return float(distance[-1]), True
    i = int(over[0])
    share = (budget_m - p95[i - 1]) / (p95[i] - p95[i - 1])
    return float(distance[i - 1] + share * (distance[i] - distance[i - 1])), False


def _groups(horizons: int, states: int) -> list[slice]:
    size = max(1, LARGEST_TABLE_BYTES // (8 * max(states, 1)))
    return [slice(begin, min(begin + size, horizons)) for begin in range(0, horizons, size)]


def _judge(model: Model, errors: Floats, drive: Drive, horizons: Floats, seed: int) -> ModelResult:
    summary = summarise(errors)
    intervals = bootstrap_intervals(errors, drive.distance, horizons, seed)
    histograms = tuple(
        histogram(errors[:, h], round_bin_width(float(np.nan_to_num(summary.largest[h])))) for h in range(len(horizons))
    )
    return ModelResult(model.name, model.label, summary, intervals, histograms)


def _joined(parts: list[ModelResult]) -> ModelResult:
    """Join what the groups of horizons gave for one model."""
    return ModelResult(
        parts[0].name,
        parts[0].label,
        Summary(*(np.concatenate(column) for column in zip(*(part.summary for part in parts), strict=True))),
        Intervals(*(np.concatenate(column) for column in zip(*(part.intervals for part in parts), strict=True))),
        tuple(one for part in parts for one in part.histograms),
    )
