"""GPS-dropout analysis: open loop from recorded states, over every horizon (Pentzer 2014, Section 6.4)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.calibration.run_models import ComparedRow, Model, models_of
from icrtool.dropout_analysis.report import OpenLoopErrors
from icrtool.dropout_analysis.starts import Starts, first_learned, reference_error, standing_states
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.kernels.error_statistics import (
    Blocks,
    BlockSums,
    Histogram,
    block_sums,
    cut_blocks,
    error_intervals,
    error_summary,
    histogram_sorted,
    round_bin_width,
    sort_trials,
    summary_of_sorted,
)
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M
from icrtool.kernels.open_loop import open_loop_errors
from icrtool.kernels.track import STANDING, FrozenIcrs, Track, TrialCounts, count_trials, ends_finder, trial_ends
from icrtool.motion.recording import MOST_TRIALS, Trials
from icrtool.records.dropout_document import (
    BlocksDocument,
    ErrorRow,
    LearnedDocument,
    ModelDocument,
    ModelResult,
    ReferenceRow,
    SummaryRow,
)
from icrtool.records.plain_data import known, plain
from icrtool.records.process_resources import give_back_freed
from icrtool.records.run import Run, track_of

LARGEST_TABLE_BYTES = 96 << 20
"""Errors held at a time, with where their trials end: horizons are taken in groups below it, however long the log."""

BYTES_A_TRIAL = 12
"""An error, and where its trial ends."""

BULK_IN_P95 = 3.0
MOST_BULKS = 10.0
"""A histogram has some 50 bins up to three times p95, and no more than ten times as many up to the largest error."""

SHORTEST_HORIZON_M = 1e-3
"""Less than what a state is known to."""

STARTS_AT_ONCE = 1 << 14
"""Starts tried by a thread at a time."""

THREADS = 2
"""The kernels run beside each other; more threads would need more memory and find little more to do."""


ErrorSink = Callable[[str, Floats, Floats], None]
"""Called with a model's name, horizons (h,) [m] and errors (n, h) [m], NaN where there is no trial."""


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
) -> OpenLoopErrors:
    """Return the errors of all models; parameters and errors are those of `icrtool.dropout`, and more.

    Parameters
    ----------
    further : models that are not the filter's, in addition
    starts_of_further : states from which theirs, and all heading errors, are measured: nearer ones are copies
    track : `icrtool.records.run.track_of` the run, where it is at hand: of a long log it is large
    """
    if len(run.table) < 2:
        raise DataError(run.name, f"the run has {len(run.table)} states", "at least two are needed")
    horizons = check_horizons(horizons_m)
    track = track if track is not None else track_of(run)
    predictors: list[Model | ComparedRow] = [*(models if models is not None else models_of(run)), *further]
    if len({model.name for model in predictors}) < len(predictors):
        raise ValueError("two models have the same name")
    standing, learned = standing_states(track), first_learned(run)
    left_out = standing if starts == "moving" else np.zeros_like(standing)
    sparse = starts_of_further
    if sparse is None:
        moving = np.flatnonzero(~standing)
        sparse = moving[:: max(len(moving) // MOST_TRIALS, 1)]
    counts: list[TrialCounts] = []
    reference: list[ReferenceRow] = []
    found: list[list[_AtHorizon]] = [[] for _ in predictors]
    before: list[ErrorRow] = []
    after: list[ErrorRow] = []
    together = max(1, LARGEST_TABLE_BYTES // (BYTES_A_TRIAL * len(run.table)))
    with ThreadPoolExecutor(THREADS) as pool:
        for begin in range(0, len(horizons), together):
            group = horizons[begin : begin + together]
            ends, of_group = _ends(track, group, left_out, pool)
            counts.append(of_group)
            trials = Trials(sparse, ends[:, sparse].T.astype(np.int64))
            blocks, slipping = _blocks(track.distance, group, ends, pool), _slipping_trials(run, ends)
            for model, rows in zip(predictors, found, strict=True):
                give_back_freed()
                if isinstance(model, ComparedRow):
                    errors, turned = model.errors_of(trials)
                    tested = _blocks(track.distance[sparse], group, np.isfinite(errors.T) - 1, pool)
                    touching = None if slipping is None else slipping[sparse]
                else:
                    errors, turned = _errors(track, model, ends, pool), _turn_errors(track, model.icrs, trials)
                    tested, touching = blocks, slipping
                rows.extend(_at_horizons(group, errors, turned, tested, touching, pool))
                if model.name == "icr":
                    first = len(errors) if learned is None else learned
                    before += _rows(group, errors[:first])
                    after += _rows(group, errors[first:])
                if sink is not None:
                    if isinstance(model, ComparedRow):
                        of_some, errors = errors, np.full((len(track.distance), len(group)), np.nan)
                        errors[sparse] = of_some
                    sink(model.name, group, errors)
                del errors  # before those of the next model are made
            reference += reference_error(run, track, group, ends, seed)
    by_learning = None
    if before:
        at, driven = (None if learned is None else float(one[learned]) for one in (run.table.t_s, run.table.distance_m))
        by_learning = LearnedDocument("icr", at, driven, before, after)
    return OpenLoopErrors(
        run_document=run.document,
        horizons_m=horizons,
        results=tuple(map(_result, predictors, found)),
        counts=TrialCounts(*(np.concatenate(column) for column in zip(*counts, strict=True))),
        states=len(run.table),
        standing=int(np.count_nonzero(standing)),
        reference=tuple(reference),
        by_learning=by_learning,
    )


class _AtHorizon(NamedTuple):
    """The errors of one model at one horizon; `free`: of the trials that touch no slip event."""

    row: SummaryRow
    bins: Histogram
    sums: BlockSums | None
    free: ErrorRow | None


def _slipping_trials(run: Run, ends: NDArray[np.int32]) -> Bools | None:
    """Return which trials (n, h) touch a slip event, by their ends (h, n); None where the run has no event."""
    if not run.sensors.events:
        return None
    before: Ints = np.cumsum(run.slipping) - run.slipping
    return np.asarray((before[np.maximum(ends, 0)] > before).T)


def _turn_errors(track: Track, icrs: FrozenIcrs, trials: Trials) -> Floats:
    """Return the errors (k, h) [rad] of the turns that ICRs make, NaN where there is no trial."""
    turn = np.concatenate([[0.0], np.cumsum(track.held * (track.v_left - track.v_right))])
    at = trials.starts if len(icrs.y_icr_right) > 1 else np.zeros(1, np.int64)
    width = np.maximum(np.abs(icrs.y_icr_right[at] - icrs.y_icr_left[at]), MIN_ICR_SEPARATION_M)
    made, driven = (column[trials.ends] - column[trials.starts][:, None] for column in (turn, track.heading))
    errors: Floats = np.abs(made / width[:, None] - driven)
    errors[trials.ends < 0] = np.nan
    return errors


def errors_from_states(run: Run, horizon_m: float) -> dict[str, Floats]:
    """Return the open-loop error of each of the filter's models, from every recorded state.

    Parameters
    ----------
    run : of `icrtool.fit` or `icrtool.open_run`
    horizon_m : distance without GNSS

    Returns
    -------
    dict
        By model name, float64 (n,) [m]; NaN where there is no trial (`dropout` lists the reasons).
    """
    track = track_of(run)
    ends = trial_ends(track, np.array([horizon_m]))
    return {model.name: open_loop_errors(track, model.icrs, ends)[:, 0] for model in models_of(run)}


def check_horizons(horizons_m: Iterable[float]) -> Floats:
    """Return horizons [m] in ascending order, each once.

    Raises
    ------
    ConfigError
        One is not a positive number, or there is none.
    """
    horizons = np.unique(np.fromiter(horizons_m, np.float64))
    if not len(horizons):
        raise ConfigError("horizons", "none is given", "name at least one distance in metres")
    for horizon in horizons:
        if not (math.isfinite(horizon) and horizon >= SHORTEST_HORIZON_M):
            raise ConfigError("horizons", f"{horizon:g} m is no distance", f"give {SHORTEST_HORIZON_M:g} m or more")
    return horizons


def _ends(track: Track, horizons: Floats, left_out: Bools, pool: Executor) -> tuple[NDArray[np.int32], TrialCounts]:
    """Return where the trials of all starts end (h, n), as `trial_ends` has it in half the memory; and their counts."""
    states, find = len(track.distance), ends_finder(track)
    ends = np.empty((len(horizons), states), np.int32)

    def fill(lo: int) -> TrialCounts:
        hi = min(lo + STARTS_AT_ONCE, states)
        found = find(horizons, np.arange(lo, hi))
        found[left_out[lo:hi, None] & (found >= 0)] = STANDING
        ends[:, lo:hi] = found.T
        return count_trials(found)

    counts = pool.map(fill, range(0, states, STARTS_AT_ONCE))
    return ends, TrialCounts(*(np.sum(column, axis=0) for column in zip(*counts, strict=True)))


def _rows(horizons: Floats, errors: Floats) -> list[ErrorRow]:
    """Return errors (n, h) [m] in numbers, a row a horizon."""
    found = error_summary(errors)
    return list(map(ErrorRow, *plain([horizons, found.trials, found.expected, found.p50, found.p95, found.largest])))


def _blocks(path_m: Floats, horizons: Floats, ends: NDArray[np.signedinteger], pool: Executor) -> list[Blocks | None]:
    """Return the blocks of path of each horizon; `ends` (h, n) are negative where there is no trial."""

    def cut(h: int) -> Blocks | None:
        return cut_blocks(ends[h] >= 0, path_m, float(horizons[h]))

    return list(pool.map(cut, range(len(horizons))))


def _errors(track: Track, model: Model, ends: NDArray[np.int32], pool: Executor) -> Floats:
    """Return the errors (n, h) [m] of all starts, one horizon contiguous, NaN where there is no trial."""
    states, errors = ends.shape[1], np.empty(ends.shape)

    def fill(lo: int) -> None:
        hi = min(lo + STARTS_AT_ONCE, states)
        errors[:, lo:hi] = open_loop_errors(track, model.icrs, ends[:, lo:hi].T.astype(np.int64), lo).T

    list(pool.map(fill, range(0, states, STARTS_AT_ONCE)))
    return errors.T


def _at_horizons(
    horizons: Floats, errors: Floats, turned: Floats, blocks: Sequence[Blocks | None], slipping: Bools | None,
    pool: Executor,
) -> list[_AtHorizon]:  # fmt: skip
    """Return the errors of one model in numbers, horizon by horizon; `turned` are those of its turns [rad].

    `slipping` (n, h) marks the trials that touch a slip event.
    """

    def at_horizon(h: int) -> _AtHorizon:
        column, metres = errors[:, h : h + 1], float(horizons[h])
        ordered = sort_trials(column[:, 0])
        trials, *found = (one[0] for one in summary_of_sorted([ordered]))
        expected, p50, p95, largest = map(float, found)
        # Bins that show the bulk of the trials, few outliers apart, in at most some hundred bins.
        shown_m = 0.0 if math.isnan(largest) else max(min(largest, BULK_IN_P95 * p95), largest / MOST_BULKS)
        bins = histogram_sorted(ordered, round_bin_width(shown_m))
        sums = block_sums(column[:, 0], blocks[h], ordered, p50, p95)
        intervals = error_intervals(column[:, 0], blocks[h], sums, p95)
        of_turns = error_summary(np.degrees(turned[:, h : h + 1]))
        shares = 100.0 * expected / metres, 100.0 * p95 / metres
        turns = float(of_turns.expected[0]), float(of_turns.p95[0])
        row = SummaryRow(metres, int(trials), *map(known, (expected, p50, p95, largest, *shares, *intervals, *turns)))
        free = None if slipping is None else _rows(horizons[h : h + 1], column[~slipping[:, h]])[0]
        return _AtHorizon(row, bins, sums, free)

    return list(pool.map(at_horizon, range(len(blocks))))


def _result(model: Model | ComparedRow, found: Iterable[_AtHorizon]) -> ModelResult:
    """Return the errors of one model from those at each horizon."""
    rows, bins, sums, free = zip(*found, strict=True)
    blocks = [
        BlocksDocument(row.horizon_m, **plain(one._asdict() | {"errors_m": [float(f"{e:.6g}") for e in one.errors_m]}))
        for row, one in zip(rows, sums, strict=True) if one is not None
    ]  # fmt: skip
    document = ModelDocument(model.name, model.label, model.knows, list(rows), blocks)
    return ModelResult(document, bins, sums, tuple(row for row in free if row is not None))
