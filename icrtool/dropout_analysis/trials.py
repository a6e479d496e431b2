"""Errors of open-loop trials from recorded states over every horizon (Pentzer 2014, Section 6.4)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np

from icrtool.calibration.run_models import ComparedRow, Model, models_of
from icrtool.dropout_analysis.report import OpenLoopErrors
from icrtool.dropout_analysis.starts import (
    DrawnTrials,
    counted_ends,
    drawn_trials,
    first_learned,
    reference_error,
    standing_states,
)
from icrtool.errors import ConfigError, DataError
from icrtool.kernels import error_statistics as statistics
from icrtool.kernels.arrays import Bools, Floats, Ints, Rows
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M
from icrtool.kernels.open_loop import fill_open_loop_errors, open_loop_errors
from icrtool.kernels.track import (
    FrozenIcrs,
    Track,
    TrialCounts,
    count_trials,
    trial_ends,
)
from icrtool.motion.recording import MOST_TRIALS, TrialErrors, Trials
from icrtool.records import dropout_document as documents
from icrtool.records.choices import Starts
from icrtool.records.plain_data import finite_or_none, plain_value
from icrtool.records.rows import row_of
from icrtool.records.run import Run, track_of
from icrtool.records.stages import Watch, unwatched
from icrtool.records.text import counted

LARGEST_TABLE_BYTES = 96 << 20
"""Largest memory of the errors and ends of trials that are held at the same time [bytes]. Horizons are computed in
groups that need less memory; a group has at least one horizon."""

BYTES_A_TRIAL = 12
"""Memory of one trial [bytes]: its error and the state at which it ends."""

BULK_IN_P95 = 3.0
"""Range of the first 50 bins of a histogram, as a multiple of p95."""

MOST_BULKS = 10.0
"""Largest ratio of the largest error to the range of the first 50 bins. It limits a histogram to about 500 bins."""

SHORTEST_HORIZON_M = 1e-3
"""Shortest horizon [m]. It is shorter than the accuracy of a state."""

STARTS_AT_ONCE = 1 << 14
"""Number of starts that a thread computes at a time."""

TRIAL_THREADS = 2
"""Number of threads that compute trials. More threads need more memory and save little time."""


ErrorSink = Callable[[str, Floats, Floats], None]
"""Function that receives the name of a model, horizons (h,) [m] and errors (n, h) [m], NaN for a start without a
trial."""


def measure_errors(
    run: Run,
    horizons_m: Iterable[float],
    *,
    starts: Starts,
    seed: int,
    models: Sequence[Model] | None = None,
    further: Sequence[ComparedRow] = (),
    starts_of_further: Ints | None = None,
    sink: ErrorSink | None = None,
    track: Track | None = None,
    watch: Watch = unwatched,
) -> OpenLoopErrors:
    """Return the errors of all models; `icrtool.dropout` describes the other parameters and the exceptions.

    Parameters
    ----------
    further : further rows, whose numbers do not come from the filter
    starts_of_further : starts of the trials of `further` and of all heading errors; default: some of all starts,
        because closer starts give nearly equal trials
    track : result of `icrtool.records.run.track_of` for the run, which is large for a long log; default: it is computed
    watch : called with the name of each row before it is computed
    """
    if len(run.table) < 2:
        raise DataError(run.name, f"the run has {counted(len(run.table), 'state')}", "at least two are needed")
    horizons = check_horizons(horizons_m)
    track = track if track is not None else track_of(run)
    predictors = _predictors(models if models is not None else models_of(run), further)
    standing, learned = standing_states(track), first_learned(run)
    sparse = starts_of_further if starts_of_further is not None else _sparse_starts(standing)
    sparse_errors = _sparse_errors(track, predictors, Trials(sparse, counted_ends(track, horizons, starts, sparse)))
    by_model: list[list[_AtHorizon]] = [[] for _ in predictors]
    counts, drawn = list[TrialCounts](), list[list[DrawnTrials]]()
    before, after = list[documents.ErrorRow](), list[documents.ErrorRow]()
    at_once = max(1, LARGEST_TABLE_BYTES // (BYTES_A_TRIAL * len(run.table)))
    with ThreadPoolExecutor(TRIAL_THREADS) as pool:
        # For a long log, horizons are computed one after the other, because all columns together would fill the memory.
        map_horizons = pool.map if at_once > TRIAL_THREADS else map
        for columns in [slice(begin, begin + at_once) for begin in range(0, len(horizons), at_once)]:
            group, ends = horizons[columns], counted_ends(track, horizons[columns], starts).T
            trials = _StartedTrials.from_all_states(run, track, group, ends)
            for number, (model, row_sparse_errors, rows) in enumerate(
                zip(predictors, sparse_errors, by_model, strict=True), start=1
            ):
                watch(f"errors, row {number} of {len(predictors)}")
                if is_compared := isinstance(model, ComparedRow):
                    errors = row_sparse_errors.position[:, columns]
                    tried = trials.from_starts(sparse, group, errors)
                else:
                    errors, tried = _errors(track, model, ends, pool), trials
                rows.extend(_statistics(model, group, errors, row_sparse_errors, columns, tried, map_horizons))
                if model.name == "icr":
                    before += map_horizons(_row, group.tolist(), errors[:learned].T)
                    after += map_horizons(_row, group.tolist(), errors[len(errors) if learned is None else learned :].T)
                if sink is not None:
                    sink(model.name, group, _at_all_starts(errors, sparse, len(run.table)) if is_compared else errors)
                del errors, tried  # The memory is freed before the next model.
            counts.append(count_trials(ends.T))
            drawn.append(drawn_trials(group, ends))
    return OpenLoopErrors(
        run_document=run.document,
        horizons_m=horizons,
        results=tuple(map(_result, predictors, by_model)),
        counts=TrialCounts(*(np.concatenate(column) for column in zip(*counts, strict=True))),
        states=len(run.table),
        standing=int(np.count_nonzero(standing)),
        reference=reference_error(run, drawn, seed),
        by_learning=_by_learning(run, learned, before, after),
    )


def _predictors(models: Sequence[Model], further: Sequence[ComparedRow]) -> list[Model | ComparedRow]:
    """Return all models of a report; two of one name are refused."""
    predictors: list[Model | ComparedRow] = [*models, *further]
    if len({model.name for model in predictors}) < len(predictors):
        raise ValueError("two models have the same name")
    return predictors


def _sparse_starts(standing: Bools) -> Ints:
    """Return about `MOST_TRIALS` evenly spaced states, or fewer, in which the robot drives."""
    driving = np.flatnonzero(~standing)
    return driving[:: max(len(driving) // MOST_TRIALS, 1)].copy()


def _at_all_starts(errors: Floats, starts: Ints, states: int) -> Floats:
    """Return the errors (k, h) of starts (k,) as an array (n, h) of all states; NaN in the other rows."""
    all_errors = np.full((states, errors.shape[1]), np.nan)
    all_errors[starts] = errors
    return all_errors


def _by_learning(
    run: Run, learned: int | None, before: list[documents.ErrorRow], after: list[documents.ErrorRow]
) -> documents.LearnedDocument | None:
    """Return the errors of trials before and after the state at which the ICRs were learned; None without row icr."""
    if not before:
        return None
    at_s, driven_m = (
        None if learned is None else float(column[learned]) for column in (run.table.t_s, run.table.distance_m)
    )
    return documents.LearnedDocument("icr", at_s, driven_m, before, after)


class _StartedTrials(NamedTuple):
    """The trials of some horizons (h,), by the states (n,) at which they start.

    Attributes
    ----------
    path_m : (n,) distance driven until each state [m]
    blocks : blocks of path of each horizon; None for a horizon without trials
    slipping : for each horizon, whether the trial from each state touches a slip event (n,); None in a drive without
        slip events
    """

    path_m: Floats
    blocks: list[statistics.Blocks | None]
    slipping: list[Bools | None]

    @classmethod
    def from_all_states(cls, run: Run, track: Track, horizons_m: Floats, ends: Rows) -> _StartedTrials:
        """Return the trials from all states; `ends` (h, n) has the states at which they end."""
        blocks = _blocks(track.distance, horizons_m, (column >= 0 for column in ends))
        return cls(track.distance, blocks, _slipping_trials(run, ends))

    def from_starts(self, starts: Ints, horizons_m: Floats, errors: Floats) -> _StartedTrials:
        """Return the trials from starts (k,), which have errors (k, h)."""
        path_m = self.path_m[starts]
        slipping = [None if touches is None else touches[starts] for touches in self.slipping]
        return _StartedTrials(path_m, _blocks(path_m, horizons_m, np.isfinite(errors.T)), slipping)


def _statistics(
    model: Model | ComparedRow, horizons_m: Floats, errors: Floats, sparse_errors: TrialErrors, columns: slice,
    trials: _StartedTrials, map_horizons: Callable[..., Iterable[_AtHorizon]],
) -> Iterable[_AtHorizon]:  # fmt: skip
    """Return the statistics of a model's errors (n, h) at each horizon.

    Parameters
    ----------
    sparse_errors : errors of the turns, and errors with aligned start headings, in fewer trials at all horizons
    columns : columns of `sparse_errors` with the horizons of `errors`
    trials : the trials
    map_horizons : applies a function to each horizon, as `map` does
    """
    turn_errors, aligned = sparse_errors.heading.T[columns], sparse_errors.aligned.T[columns]
    statistics_of_horizon = partial(_at_horizon, row_of(model.name).spread)
    return map_horizons(
        statistics_of_horizon, horizons_m.tolist(), errors.T, turn_errors, aligned, trials.blocks, trials.slipping
    )


def _sparse_errors(track: Track, predictors: Sequence[Model | ComparedRow], trials: Trials) -> list[TrialErrors]:
    """Return the errors (k, h) of each model in some trials; the filter's models have only heading errors.

    All horizons are computed at once, so that a model drives the log only once. The errors are computed before the
    tables of all starts need memory.
    """
    none = np.empty((0, trials.ends.shape[1]))
    return [
        model.errors_of(trials)
        if isinstance(model, ComparedRow)
        else TrialErrors(none, _turn_errors(track, model.icrs, trials), none)
        for model in predictors
    ]


class _AtHorizon(NamedTuple):
    """Statistics of the errors of one model at one horizon; `without_events`: of trials without slip event."""

    row: documents.SummaryRow
    bins: statistics.Histogram
    sums: statistics.BlockSums | None
    without_events: documents.ErrorRow | None
    aligned: documents.AlignedErrors | None


def _slipping_trials(run: Run, ends: Rows) -> list[Bools | None]:
    """Return which trials (n,) of each horizon touch a slip event, by their ends (h, n); None without slip events."""
    if not run.sensors.events:
        return [None] * len(ends)
    before: Ints = np.cumsum(run.slipping) - run.slipping
    return list(before[np.maximum(ends, 0)] > before)


def _turn_errors(track: Track, icrs: FrozenIcrs, trials: Trials) -> Floats:
    """Return the errors (k, h) [rad] of the turns that ICRs give; NaN for a start without a trial."""
    turn = np.zeros(len(track.held) + 1)
    np.subtract(track.v_left, track.v_right, out=turn[1:])
    turn[1:] *= track.held
    np.cumsum(turn, out=turn)
    icr_rows = trials.starts if len(icrs.y_icr_right) > 1 else np.zeros(1, np.int64)
    width = np.maximum(np.abs(icrs.y_icr_right[icr_rows] - icrs.y_icr_left[icr_rows]), MIN_ICR_SEPARATION_M)
    turn_by_icrs, turn_of_reference = (
        column[trials.ends] - column[trials.starts][:, None] for column in (turn, track.heading)
    )
    errors: Floats = np.abs(turn_by_icrs / width[:, None] - turn_of_reference)
    errors[trials.ends < 0] = np.nan
    return errors


def errors_from_states(run: Run, horizon_m: float) -> dict[str, Floats]:
    """Return the open-loop error of each of the filter's models from every recorded state.

    Parameters
    ----------
    run : result of `icrtool.fit` or `icrtool.open_run`
    horizon_m : distance without GNSS

    Returns
    -------
    dict
        Errors, float64 (n,) [m], by the name of the model; NaN for a start without a trial (`dropout` lists the
        reasons).
    """
    track = track_of(run)
    ends = trial_ends(track, np.array([horizon_m]))
    return {model.name: open_loop_errors(track, model.icrs, ends)[:, 0] for model in models_of(run)}


def check_horizons(horizons_m: Iterable[float]) -> Floats:
    """Return horizons [m] in ascending order, each once.

    Raises
    ------
    ConfigError
        A horizon is not a positive number, or none is given.
    """
    horizons = np.unique(np.fromiter(horizons_m, np.float64))
    if not len(horizons):
        raise ConfigError("horizons", "no distance is given", "name at least one in metres")
    for horizon in horizons:
        if not (math.isfinite(horizon) and horizon >= SHORTEST_HORIZON_M):
            raise ConfigError("horizons", f"{horizon:g} m is no distance", f"give {SHORTEST_HORIZON_M:g} m or more")
    return horizons


def _row(horizon_m: float, errors: Floats) -> documents.ErrorRow:
    """Return the statistics of errors (n,) [m] at one horizon [m]."""
    trials, *numbers = statistics.RankedTrials.from_errors(errors).summary()
    return documents.ErrorRow(horizon_m, trials, *map(finite_or_none, numbers))


def _blocks(path_m: Floats, horizons: Floats, has_trials: Iterable[Bools]) -> list[statistics.Blocks | None]:
    """Return the blocks of path of each horizon; `has_trials` has for each horizon the starts (n,) with a trial."""
    return [
        statistics.cut_blocks(has_trial, path_m, horizon_m)
        for has_trial, horizon_m in zip(has_trials, horizons.tolist(), strict=True)
    ]


def _errors(track: Track, model: Model, ends: Rows, pool: Executor) -> Floats:
    """Return the errors (n, h) [m] of a model from all starts, each horizon contiguous; NaN without a trial."""
    states, errors = ends.shape[1], np.empty(ends.shape)

    def fill(lo: int) -> None:
        fill_open_loop_errors(track, model.icrs, ends, errors, lo, min(lo + STARTS_AT_ONCE, states))

    list(pool.map(fill, range(0, states, STARTS_AT_ONCE)))
    return errors.T


def _at_horizon(
    spread: statistics.Spread, horizon_m: float, errors: Floats, turn_errors: Floats, aligned: Floats,
    blocks: statistics.Blocks | None, slipping: Bools | None,
) -> _AtHorizon:  # fmt: skip
    """Return the statistics of one model at one horizon.

    Parameters
    ----------
    spread : spread of the errors between drives, from other drives
    horizon_m : the horizon [m]
    errors : (n,) [m]; turn_errors : (k,) errors of the turns [rad]
    aligned : (n,) errors with aligned start headings [m]; empty for the filter's models
    blocks : blocks of path of the trials
    slipping : (n,) whether a trial touches a slip event
    """
    ranked = statistics.RankedTrials.from_errors(errors)
    trials, expected, p50, p95, largest = ranked.summary()
    # The width of the bins shows most trials in detail in spite of outliers, with at most some hundred bins.
    shown_m = 0.0 if math.isnan(largest) else max(min(largest, BULK_IN_P95 * p95), largest / MOST_BULKS)
    bins = ranked.histogram(statistics.round_bin_width(shown_m))
    sums = statistics.block_sums(errors, blocks, ranked, p50, p95)
    del ranked  # A column of the log is freed before the intervals need a column of the same size.
    intervals = statistics.error_intervals(errors, blocks, sums, p50, p95, spread)
    _, turn_mean, _, turn_p95, _ = statistics.RankedTrials.from_errors(np.degrees(turn_errors)).summary()
    shares = 100.0 * expected / horizon_m, 100.0 * p95 / horizon_m
    numbers = (expected, p50, p95, largest, *shares, *intervals, turn_mean, turn_p95)
    row = documents.SummaryRow(horizon_m, trials, *(finite_or_none(float(number)) for number in numbers))
    without_events = None if slipping is None else _row(horizon_m, errors[~slipping])
    return _AtHorizon(row, bins, sums, without_events, _aligned(aligned, blocks))


def _aligned(errors: Floats, blocks: statistics.Blocks | None) -> documents.AlignedErrors | None:
    """Return the statistics of errors (n,) [m] with aligned start headings; None without such errors."""
    if not np.isfinite(errors).any():
        return None
    ranked = statistics.RankedTrials.from_errors(errors)
    _, expected, p50, p95, _ = ranked.summary()
    return documents.AlignedErrors(expected, p95, statistics.block_sums(errors, blocks, ranked, p50, p95))


def _result(model: Model | ComparedRow, by_horizon: Iterable[_AtHorizon]) -> documents.ModelResult:
    """Return the result of a model from its statistics at each horizon."""
    rows, bins, sums, without_events, aligned = zip(*by_horizon, strict=True)
    blocks = []
    for row, sums_of_row in zip(rows, sums, strict=True):
        if sums_of_row is not None:
            errors_m = [float(f"{error:.6g}") for error in sums_of_row.errors_m]
            blocks.append(
                documents.BlocksDocument(row.horizon_m, **plain_value(sums_of_row._asdict() | {"errors_m": errors_m}))
            )
    report_row = row_of(model.name)
    document = documents.ModelDocument(
        model.name, report_row.words, model.knows or report_row.knows, list(rows), blocks
    )
    return documents.ModelResult(document, bins, sums, tuple(row for row in without_events if row is not None), aligned)
