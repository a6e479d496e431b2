"""Every motion model on recordings, or distance of one, that it was not fitted to; and which model to recommend.

Of many recordings each is left out in turn (Stone 1974). In a single one each trial is predicted without the windows
that share distance with it (Burman, Chow and Nolan 1994; on recorded drives 5 or 10 m more between them changed no
error). What is recommended for a fold, a recording or a block of distance, is also *chosen* without it, so the
reported score of the recommended model is honest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from icrtool.calibration.model_choice import FEWEST_TO_CHOOSE, Choice, nested_choice
from icrtool.errors import DataError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.open_loop.error_statistics import error_summary
from icrtool.kernels.open_loop.trials import Summary
from icrtool.motion.fit import FEWEST_RESIDUALS, Fold, Pool, PooledFit, Prediction
from icrtool.motion.models import (
    CONTROLLER,
    MODELS,
    MotionModel,
    TypicalDrive,
    controller_model,
    track_geometry,
    typical_drive,
)
from icrtool.motion.recording import Recording, Steps, cut_windows, totals_of
from icrtool.motion.trials import Trials, cut_trials, predicted_path, trial_errors
from icrtool.records.dropout import CHOICE_HORIZON_M

HORIZONS_M = (5.0, 10.0, 20.0)

SHORTEST_BLOCK_M, FEWEST_BLOCKS, MOST_BLOCKS = 25.0, 3, 5

STRIP_M, MOST_STRIPS = 5.0, 2
"""Trials from one strip of distance to another are predicted by one fit: strips at least so long, so many a block."""


@dataclass(frozen=True, slots=True)
class HeldOutRow:
    """One model on what it was not fitted to.

    Attributes
    ----------
    name : of the model, or ``recommended``
    folds : errors of each fold, by horizon; together : of all folds
    """

    name: str
    label: str
    folds: tuple[Summary, ...]
    together: Summary

    def median(self, column: str, h: int) -> float:
        """Return the median over folds of ``p95`` or ``expected`` at a horizon; NaN without trials."""
        return _over(np.nanmedian, self.folds, column, h)

    def worst(self, column: str, h: int) -> float:
        """Return the largest over folds."""
        return _over(np.nanmax, self.folds, column, h)


@dataclass(frozen=True, slots=True)
class HeldOut:
    """The leave-one-out table of one set of models.

    Attributes
    ----------
    folds : recordings or, of a single one, blocks: models are chosen, and errors are listed, by fold
    trials : by recording, those of the table
    scores : by model, in the order of the family, then what was recommended without each fold
    fits : of everything, by model name
    typical : curvature and speed at which ICRs and multiplier are stated
    recommended : name of the model chosen with all folds
    chosen : by fold, the model chosen without it
    why : the reason, one sentence
    """

    horizons_m: tuple[float, ...]
    folds: tuple[Fold, ...]
    trials: tuple[Trials, ...]
    scores: tuple[HeldOutRow, ...]
    fits: dict[str, PooledFit]
    typical: TypicalDrive
    recommended: str
    chosen: tuple[str, ...]
    why: str

    def score(self, name: str) -> HeldOutRow:
        """Return the row of a model."""
        return next(score for score in self.scores if score.name == name)

    def without(self, fold: Fold) -> Prediction | None:
        """Return what is recommended without a fold; None where too little is left."""
        return self.fits[self.chosen[fold.number]].without(fold)

    def expressed(self, fold: Fold) -> Prediction | None:
        """Return what a controller drives with the numbers fitted without a fold."""
        fit = self.fits[CONTROLLER]
        if (found := fit.without(fold)) is None:
            return None
        fitted, own = found
        return controller_model(track_geometry(fitted.model, fitted.parameters, fit.pool.widths_m[fold.recording])), own


def plan_folds(recordings: Sequence[Recording]) -> tuple[Fold, ...]:
    """Return what is left out in turn: each recording, or of a single one contiguous blocks of distance.

    Raises
    ------
    DataError
        A single drive is too short to hold anything out.
    """
    if len(recordings) > 1:
        return tuple(Fold(one.name, i, i, -np.inf, np.inf) for i, one in enumerate(recordings))
    total = float(recordings[0].drive.distance[-1])
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
    steps: Steps | None = None,
) -> Floats:  # fmt: skip
    """Return the errors (k, h) [m] of trials of recording i, each predicted without its fold; NaN where that is none.

    Parameters
    ----------
    without : gives the model for a fold, None where too little is left to fit it
    steps : the wheel samples joined; default single samples
    """
    distance = recording.drive.distance
    errors: Floats = np.full(trials.ends.T.shape, np.nan).T
    # a horizon after the other, as the ends lie in memory
    column, row = np.nonzero(trials.ends.T >= 0)
    start, end = trials.starts[row], trials.ends[row, column]
    t = recording.t_s
    for fold, some in left_out(folds, i, distance[start], distance[end]):
        if (found := without(fold)) is not None:
            s, e = start[some], end[some]
            near = (steps if steps is not None else recording).around(t[s.min()], t[e.max()])
            path = predicted_path(recording, *found, near)
            errors[row[some], column[some]] = trial_errors(recording, s, e, path)
    return errors


def hold_out(
    recordings: Sequence[Recording], models: Sequence[MotionModel] | None = None,
    horizons_m: Sequence[float] = HORIZONS_M,
) -> tuple[HeldOut, HeldOut | None]:  # fmt: skip
    """Fit every model, and test each on what it was not fitted to.

    Parameters
    ----------
    recordings : at least one
    models : the candidates; default the family

    Returns
    -------
    The tables of wheels alone, and of wheels and gyro where every recording has one.

    Raises
    ------
    DataError
        Too short a drive, or too little left beside a fold.
    """
    tester = _Tester(recordings, horizons_m)
    gyro = all(one.gyro_radps is not None for one in recordings)

    def job(model: MotionModel) -> list[_Tested]:
        alone = tester.pool.fit(model)
        found = [_Tested(alone, tester.errors(alone.without))]
        if gyro:
            both = tester.pool.fit(model.with_gyro(), alone)
            found.append(_Tested(both, tester.errors(both.without)))
        return found

    tested = [job(model) for model in (MODELS.values() if models is None else models)]
    choice = tester.choose([one[0].fit for one in tested])
    wheels = tester.table([one[0] for one in tested], choice)
    if not gyro:
        return wheels, None
    # the same models: a choice of its own for the gyro would only add noise
    names = Choice(f"{wheels.recommended}_gyro", wheels.why, tuple(f"{name}_gyro" for name in wheels.chosen))
    return wheels, tester.table([one[1] for one in tested], names)


class Recommendation(NamedTuple):
    """The model that `hold_out` recommends, fitted to everything, without the scores of a table.

    Attributes
    ----------
    controller : what a controller can express, fitted to the same
    why : the reason, one sentence
    typical : curvature and speed at which ICRs and multiplier are stated
    """

    fit: PooledFit
    controller: PooledFit
    why: str
    typical: TypicalDrive


def recommend(recordings: Sequence[Recording]) -> Recommendation:
    """Return the model that `hold_out` recommends for recordings, in a fraction of its time.

    Raises
    ------
    DataError
        Too short a drive, or too little left beside a fold.
    """
    tester = _Tester(recordings)
    fits = [tester.pool.fit(model) for model in MODELS.values()]
    choice = tester.choose(fits)
    by_name = {fit.model.name: fit for fit in fits}
    return Recommendation(by_name[choice.recommended], by_name[CONTROLLER], choice.why, tester.typical)


class _Tested(NamedTuple):
    """A model fitted to everything, and its errors (k, h) [m] in the trials of all recordings, held out."""

    fit: PooledFit
    errors: Floats


class _Tester:
    """What all models are fitted to and tested by."""

    def __init__(self, recordings: Sequence[Recording], horizons_m: Sequence[float] = ()) -> None:
        self._folds = plan_folds(recordings)
        self._recordings, self._horizons_m = recordings, tuple(horizons_m)
        pooled = totals_of(*recordings)
        windows = [cut_windows(one, pooled=pooled) for one in recordings]
        self.pool = Pool(windows, [one.width_m for one in recordings])
        choosing = self.pool.length_m == CHOICE_HORIZON_M
        # rows of the fold's recording
        self._tested = [
            np.flatnonzero((self.pool.within(fold) & choosing)[self.pool.rows(fold.recording)]) for fold in self._folds
        ]
        for fold in self._folds:
            if np.count_nonzero(self.pool.clear_of(fold)) < FEWEST_RESIDUALS:
                why = "too short to fit on one part and test on another"
                raise DataError(fold.name, "too few windows beside it", why)
        self._trials = [cut_trials(one, horizons_m, pooled) for one in recordings] if len(horizons_m) else []
        self.typical = typical_drive(motion for one in recordings for motion in one.motions())

    def errors(self, without: Callable[[Fold], Prediction | None]) -> Floats:
        """Return the errors (k, h) [m] of the trials of all recordings, one behind the other."""
        found = zip(self._recordings, self._trials, self.pool.windows, strict=True)
        return np.concatenate([
            errors_without(one, trials, self._folds, i, without, windows.steps)
            for i, (one, trials, windows) in enumerate(found)
        ])  # fmt: skip

    def choose(self, fits: Sequence[PooledFit]) -> Choice:
        """Choose a model by the windows of each fold, and without each fold."""
        # what a controller can express has no x ICR: it is exported, not recommended
        able = [fit for fit in fits if fit.model.name != CONTROLLER]
        inner = {fit.model.name: self._inner_errors(fit) for fit in able}
        return nested_choice(inner)

    def _inner_errors(self, fit: PooledFit) -> Floats:
        """Return the expected error [m] (folds, folds) of the windows of fold g, fitted without f and g."""
        folds, count = self._folds, len(self._folds)
        inner = np.full((count, count), np.nan)
        for g, rows in enumerate(self._tested):
            # with few folds, only what is fitted without g
            others = list(range(count)) if count >= FEWEST_TO_CHOOSE else [g]
            residuals = fit.residuals_without(folds[g], [folds[f] for f in others])[:, rows]
            moving = self.pool.windows[folds[g].recording].moving
            inner[others, g] = _window_errors(residuals, moving[rows[: len(rows) // 2]])
        return inner

    def table(self, tested: Sequence[_Tested], choice: Choice) -> HeldOut:
        """Return the table of models that were tested in the same trials."""
        by_name = {one.fit.model.name: one for one in tested}
        fold_of = np.concatenate([self._fold_of(i, trials.starts) for i, trials in enumerate(self._trials)])
        first = np.searchsorted(fold_of, np.arange(1, len(self._folds)))
        parts = {name: np.split(one.errors, first) for name, one in by_name.items()}
        chosen = np.concatenate([parts[name][f] for f, name in enumerate(choice.chosen)])
        rows = [(name, one.fit.model.label, one.errors) for name, one in by_name.items()]
        rows.append(("recommended", "recommended", chosen))
        fits = {name: one.fit for name, one in by_name.items()}
        found = HeldOut(
            self._horizons_m, self._folds, tuple(self._tried(chosen)), (), fits, self.typical, choice.recommended,
            choice.chosen, choice.why,
        )  # fmt: skip
        if CONTROLLER in fits:
            rows = [(n, label, self.errors(found.expressed) if n == CONTROLLER else one) for n, label, one in rows]
        scores = []
        for name, label, errors in rows:
            by_fold = tuple(error_summary(some) for some in np.split(errors, first))
            scores.append(HeldOutRow(name, label, by_fold, error_summary(errors)))
        return replace(found, scores=tuple(scores))

    def _fold_of(self, i: int, starts: Ints) -> Ints:
        """Return the number of the fold (k,) in which trials of recording i start."""
        mine = [fold for fold in self._folds if fold.recording == i]
        edges = [fold.end_m for fold in mine[:-1]]
        return mine[0].number + np.searchsorted(edges, self._recordings[i].drive.distance[starts], side="right")

    def _tried(self, errors: Floats) -> Iterator[Trials]:
        """Yield the trials of each recording that have errors (k, h)."""
        last = np.cumsum([len(trials.starts) for trials in self._trials])
        for trials, some in zip(self._trials, np.split(errors, last[:-1]), strict=True):
            yield Trials(trials.starts, np.where(np.isfinite(some), trials.ends, -1))


def _window_errors(residuals: Floats, moving: Ints) -> Floats:
    """Return the expected error (f,) [m] of windows of `CHOICE_HORIZON_M` by their residuals (f, 2 w); NaN for none.

    Parameters
    ----------
    moving : (w,) states in which the robot moved from a window's start to the next: trials start from these
    """
    half = len(moving)
    if not moving.any():
        return np.full(len(residuals), np.nan)
    errors = np.hypot(residuals[:, :half], residuals[:, half:]) @ moving / moving.sum()
    return np.asarray(errors * np.sqrt(CHOICE_HORIZON_M), np.float64)


def _over(function: Callable[[Floats], Any], folds: Sequence[Summary], column: str, h: int) -> float:
    values = np.array([getattr(fold, column)[h] for fold in folds])
    values = values[np.isfinite(values)]
    return float(function(values)) if len(values) else float("nan")
