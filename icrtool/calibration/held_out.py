"""The motion models on recordings, or distance of one, that they were not fitted to.

Of many recordings each is left out in turn (Stone 1974). In a single one each trial is predicted without the windows
that share distance with it (Burman, Chow and Nolan 1994; on recorded drives 5 or 10 m more between them changed no
error).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from icrtool.errors import DataError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.error_statistics import Summary, error_summary, within_budget
from icrtool.kernels.track import OpenLoopPath, Track
from icrtool.motion.models import CONTROLLER, FIVE, MODELS, NO_SLIP, RECOMMENDED, controller_model
from icrtool.motion.recording import (
    NO_CONSTANTS,
    Recording,
    TrialErrors,
    Trials,
    cut_trials,
    cut_windows,
    predicted_path,
    totals_of,
    trial_errors,
)
from icrtool.motion.window_fit import FEWEST_RESIDUALS, Fold, Pool, PooledFit, Prediction
from icrtool.records.dropout import CHOICE_HORIZON_M, BudgetDistance

HORIZONS_M = (5.0, 10.0, 20.0)

SHORTEST_BLOCK_M, FEWEST_BLOCKS, MOST_BLOCKS = 25.0, 3, 5

STRIP_M, MOST_STRIPS = 5.0, 2
"""Trials from one strip of distance to another are predicted by one fit: strips at least so long, so many a block."""

ROWS = {NO_SLIP: "no slip", CONTROLLER: "controller numbers", RECOMMENDED: MODELS[RECOMMENDED].label}
"""The rows of a held-out table and their labels; each may come again with a gyro, ``_gyro`` behind its name."""

GYRO = "_gyro"


@dataclass(frozen=True, slots=True)
class HeldOutRow:
    """One model on what it was not fitted to.

    Attributes
    ----------
    folds : errors of each fold, by horizon; together : of all trials
    """

    name: str
    label: str
    folds: tuple[Summary, ...]
    together: Summary

    def within(self, horizons_m: Sequence[float], budget_m: float) -> BudgetDistance | None:
        """Return how far p95 of all trials stays within a budget [m]; None without trials."""
        reached = within_budget(np.array(horizons_m), self.together.p95, budget_m)
        return None if reached is None else BudgetDistance(self.name, self.label, budget_m, *reached)

    def worst(self, column: str, h: int) -> float:
        """Return the largest ``p95`` or ``expected`` over folds at a horizon; NaN without trials."""
        values = np.array([getattr(fold, column)[h] for fold in self.folds])
        values = values[np.isfinite(values)]
        return float(values.max()) if len(values) else float("nan")


@dataclass(frozen=True)
class HeldOut:
    """Fits of the motion models to recordings, and what each predicts without a fold.

    Attributes
    ----------
    folds : recordings or, of a single one, blocks of distance
    trials : by recording
    fits : of everything, by model name
    """

    recordings: tuple[Recording, ...]
    horizons_m: tuple[float, ...]
    folds: tuple[Fold, ...]
    trials: tuple[Trials, ...]
    fits: dict[str, PooledFit]
    steps: tuple[Track, ...]

    @cached_property
    def scores(self) -> tuple[HeldOutRow, ...]:
        """Errors in the trials of all recordings, a row a model."""
        of_recordings = enumerate(zip(self.trials, self.recordings, strict=True))
        fold_of = np.concatenate([_fold_of(self.folds, i, *one) for i, one in of_recordings])
        first = np.searchsorted(fold_of, np.arange(1, len(self.folds)))
        scores = []
        for name, label in self.rows.items():
            errors = np.concatenate([self.errors(name, i, one).position for i, one in enumerate(self.trials)])
            by_fold = tuple(error_summary(some) for some in np.split(errors, first))
            scores.append(HeldOutRow(name, label, by_fold, error_summary(errors)))
        return tuple(scores)

    @property
    def has_gyro(self) -> bool:
        """Whether there are rows with a gyro: every recording has one."""
        return f"{RECOMMENDED}{GYRO}" in self.fits

    @property
    def rows(self) -> dict[str, str]:
        """The rows of the table and their labels."""
        turned = {f"{name}{GYRO}": f"{label} + gyro" for name, label in ROWS.items()} if self.has_gyro else {}
        return ROWS | turned

    def score(self, name: str) -> HeldOutRow:
        """Return a row."""
        return next(score for score in self.scores if score.name == name)

    def without(self, name: str, fold: Fold) -> Prediction | None:
        """Return what a row predicts without a fold; None where too little is left to fit it."""
        if name == NO_SLIP:
            return self.fits[NO_SLIP].fitted, NO_CONSTANTS
        base = name.removesuffix(GYRO)
        if base != CONTROLLER:
            return self.fits[name].without(fold)
        if (found := self.fits[name.replace(CONTROLLER, FIVE)].without(fold)) is None:
            return None
        recording = self.recordings[fold.recording]
        return controller_model(found[0], recording.lever, recording.width_m), found[1]

    def errors(self, name: str, i: int, trials: Trials) -> TrialErrors:
        """Return the errors of a row in trials of recording i, each predicted without what it touches."""
        return errors_without(self.recordings[i], trials, self.folds, i, lambda fold: self.without(name, fold),
                              self.steps[i])  # fmt: skip

    def path(self, name: str, i: int, start: int, end: int) -> OpenLoopPath | None:
        """Return the path of a row from one state of recording i to another, predicted without what it touches."""
        recording, rows = self.recordings[i], np.arange(start, end + 1)
        track, t = recording.track, recording.track.t
        ends = (np.array([track.distance[row]]) for row in (start, end))
        ((fold, _),) = left_out(self.folds, i, *ends)
        if (found := self.without(name, fold)) is None:
            return None
        turned, place = predicted_path(recording, *found, self.steps[i].around(t[start], t[end]))(t[rows])
        turn = track.heading[start] - turned[0]
        moved = np.exp(1j * turn) * (place - place[0])
        return OpenLoopPath(track.north[start] + moved.real, track.east[start] + moved.imag, turned + turn)


def plan_folds(recordings: Sequence[Recording]) -> tuple[Fold, ...]:
    """Return what is left out in turn: each recording, or of a single one contiguous blocks of distance.

    Raises
    ------
    DataError
        A single drive is too short to hold anything out.
    """
    if len(recordings) > 1:
        return tuple(Fold(one.name, i, i, -np.inf, np.inf) for i, one in enumerate(recordings))
    total = float(recordings[0].track.distance[-1])
    if total < 2.0 * CHOICE_HORIZON_M:
        why = f"{total:.1f} m of driven distance"
        raise DataError(recordings[0].name, why, "too short to fit on one part and test on another")
    count = int(np.clip(total // SHORTEST_BLOCK_M, FEWEST_BLOCKS, MOST_BLOCKS))
    edges = np.linspace(0.0, total, count + 1).tolist()
    return tuple(Fold(f"block {i + 1}", i, 0, edges[i], edges[i + 1]) for i in range(count))


def left_out(folds: Sequence[Fold], recording: int, start_m: Floats, end_m: Floats) -> Iterator[tuple[Fold, Ints]]:
    """Yield what is left out to predict trials of a recording, and the rows of the trials that it is left out for.

    Parameters
    ----------
    folds : of `plan_folds`
    start_m, end_m : path lengths (k,) at the trials' starts and ends
    """
    if not len(start_m):
        return
    mine = [fold for fold in folds if fold.recording == recording]
    if mine[0].whole:
        yield mine[0], np.arange(len(start_m))
        return
    block_m = mine[0].end_m
    in_block = int(np.clip(block_m // STRIP_M, 1, MOST_STRIPS))
    strip_m, last = block_m / in_block, in_block * len(mine) - 1
    of_start, of_end = (np.minimum((at / strip_m).astype(np.int64), last) for at in (start_m, end_m))
    pair = of_start * (last + 1) + of_end
    order = np.argsort(pair, kind="stable")
    pairs, first = np.unique(pair[order], return_index=True)
    for one, rows in zip(pairs.tolist(), np.split(order, first[1:]), strict=True):
        a, b = divmod(one, last + 1)
        block = mine[a // in_block]
        yield block._replace(begin_m=a * strip_m, end_m=(b + 1) * strip_m), rows


def errors_without(
    recording: Recording, trials: Trials, folds: Sequence[Fold], i: int, without: Callable[[Fold], Prediction | None],
    steps: Track | None = None,
) -> TrialErrors:  # fmt: skip
    """Return the errors of trials of recording i, each predicted without its fold; NaN where that is none.

    Parameters
    ----------
    without : gives the model for a fold, None where too little is left to fit it
    steps : the wheel samples joined; default single samples
    """
    distance = recording.track.distance
    errors = TrialErrors.none(trials.ends.shape)
    # a horizon after the other, as the ends lie in memory
    column, row = np.nonzero(trials.ends.T >= 0)
    start, end = trials.starts[row], trials.ends[row, column]
    t = recording.track.t
    for fold, some in left_out(folds, i, distance[start], distance[end]):
        if (found := without(fold)) is not None:
            s, e = start[some], end[some]
            near = (steps if steps is not None else recording.track).around(t[s.min()], t[e.max()])
            missed = trial_errors(recording, s, e, predicted_path(recording, *found, near))
            for all_errors, of_fold in zip(errors, missed, strict=True):
                all_errors[row[some], column[some]] = of_fold
    return errors


class Fits(NamedTuple):
    """The motion models fitted to recordings; `steps` are the wheel samples joined, by recording."""

    fits: dict[str, PooledFit]
    steps: tuple[Track, ...]
    pool: Pool


def fit_models(recordings: Sequence[Recording], names: Sequence[str] = tuple(MODELS)) -> Fits:
    """Fit motion models to recordings, with a gyro too where every recording has one.

    Raises
    ------
    DataError
        Too short a drive.
    """
    pooled = totals_of(*recordings)
    windows = [cut_windows(one, pooled=pooled) for one in recordings]
    pool = Pool(windows, [one.width_m for one in recordings])
    fits = {name: pool.fit(MODELS[name]) for name in names}
    if FIVE in fits:
        # the clocks are those of one robot: many logs show them no better than one
        off = float(np.sqrt(np.mean([one.x_clock_std_m**2 for one in recordings])))
        fits[FIVE] = fits[FIVE].with_clock_error(off)
    if all(one.track.gyro is not None for one in recordings):
        fits |= {f"{name}{GYRO}": pool.fit(MODELS[name].with_gyro(), fits[name]) for name in names}
    return Fits(fits, tuple(one.steps for one in windows), pool)


def hold_out(recordings: Sequence[Recording], horizons_m: Sequence[float] = HORIZONS_M) -> HeldOut:
    """Fit the motion models, and test each on what it was not fitted to.

    Parameters
    ----------
    recordings : at least one

    Raises
    ------
    DataError
        Too short a drive, or too little left beside a fold.
    """
    folds = plan_folds(recordings)
    fits, steps, pool = fit_models(recordings)
    for fold in folds:
        if np.count_nonzero(pool.clear_of(fold)) < FEWEST_RESIDUALS:
            why = "too short to fit on one part and test on another"
            raise DataError(fold.name, "too few windows beside it", why)
    pooled = totals_of(*recordings)
    trials = tuple(cut_trials(one, horizons_m, pooled) for one in recordings)
    return HeldOut(tuple(recordings), tuple(horizons_m), folds, trials, fits, steps)


def _fold_of(folds: Sequence[Fold], i: int, trials: Trials, recording: Recording) -> Ints:
    """Return the number of the fold (k,) in which trials of recording i start."""
    mine = [fold for fold in folds if fold.recording == i]
    edges = [fold.end_m for fold in mine[:-1]]
    return mine[0].number + np.searchsorted(edges, recording.track.distance[trials.starts], side="right")
