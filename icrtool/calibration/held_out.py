"""Every motion model on recordings, or blocks of one, that it was not fitted to; and which model to recommend.

Each fold, a recording or a block of distance, is left out in turn (Stone 1974). What is recommended for a fold is also
*chosen* without it, so the reported score of the recommended model is honest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from icrtool.calibration.model_choice import FEWEST_TO_CHOOSE, Choice, nested_choice
from icrtool.errors import DataError
from icrtool.kernels.arrays import Bools, Floats
from icrtool.kernels.error_statistics import summarise
from icrtool.kernels.trials import Summary
from icrtool.motion.fit import Pool, PooledFit
from icrtool.motion.models import (
    CONTROLLER,
    MODELS,
    FittedModel,
    MotionModel,
    TypicalDrive,
    controller_model,
    track_geometry,
    typical_drive,
    wheel_motion,
)
from icrtool.motion.recording import LogConstants, Recording, Windows, cut_windows
from icrtool.motion.trials import Trials, cut_trials, predicted_path, trial_errors
from icrtool.records.dropout import CHOICE_HORIZON_M

HORIZONS_M = (5.0, 10.0, 20.0)

SHORTEST_BLOCK_M, MOST_BLOCKS = 25.0, 5

FEWEST_RESIDUALS = 20

AT_ONCE = 2


class Fold(NamedTuple):
    """What is left out together: a recording, or a block of one between two path lengths [m]."""

    name: str
    recording: int
    begin_m: float
    end_m: float

    @property
    def whole(self) -> bool:
        """Whether all of the recording is left out."""
        return bool(np.isinf(self.begin_m) and np.isinf(self.end_m))


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
    scores : by model, in the order of the family, then what was recommended without each fold and, for wheels alone,
        what a controller makes of that
    fits : of everything, by model name
    without : by fold, the model chosen without it and fitted without it; own : constants of its recording for that
    typical : curvature and speed at which ICRs and multiplier are stated
    recommended : name of the model chosen with all folds
    chosen : by fold, the model chosen without it
    why : the reason, one sentence
    """

    horizons_m: tuple[float, ...]
    folds: tuple[Fold, ...]
    scores: tuple[HeldOutRow, ...]
    fits: dict[str, PooledFit]
    without: tuple[PooledFit, ...]
    own: tuple[LogConstants, ...]
    typical: TypicalDrive
    recommended: str
    chosen: tuple[str, ...]
    why: str

    def score(self, name: str) -> HeldOutRow:
        """Return the row of a model."""
        return next(score for score in self.scores if score.name == name)


def plan_folds(recordings: Sequence[Recording]) -> tuple[Fold, ...]:
    """Return what is left out in turn: each recording, or of a single one contiguous blocks of distance.

    Raises
    ------
    DataError
        A single drive is too short to hold anything out.
    """
    if len(recordings) > 1:
        return tuple(Fold(one.name, i, -np.inf, np.inf) for i, one in enumerate(recordings))
    total = float(recordings[0].drive.distance[-1])
    if total < 2.0 * CHOICE_HORIZON_M:
        why = f"{total:.1f} m of driven distance"
        raise DataError(recordings[0].name, why, "too short to fit on one part and test on another")
    edges = np.linspace(0.0, total, count_blocks(total) + 1)
    edges[0], edges[-1] = -np.inf, np.inf
    return tuple(Fold(f"block {i + 1}", 0, float(a), float(b)) for i, (a, b) in enumerate(pairwise(edges)))


def count_blocks(distance_m: float) -> int:
    """Return into how many blocks a drive of this length is cut."""
    return int(np.clip(distance_m // SHORTEST_BLOCK_M, 2, MOST_BLOCKS))


def hold_out(
    recordings: Sequence[Recording], models: Sequence[MotionModel] | None = None,
    horizons_m: Sequence[float] = HORIZONS_M,
) -> tuple[HeldOut, HeldOut | None]:  # fmt: skip
    """Fit and test every model, each fold left out in turn.

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
    tester = _Tester(recordings)
    tester.cut_trials(horizons_m)
    gyro = all(one.gyro_radps is not None for one in recordings)

    def job(fitted: _Fitted) -> list[_Tested]:
        alone = tester.test(fitted)
        return (
            [alone, tester.test(tester.fit(fitted.model.with_gyro(), fitted.whole.fitted), alone)] if gyro else [alone]
        )

    with ThreadPoolExecutor(AT_ONCE) as threads:
        fitted = list(threads.map(tester.fit, tuple(MODELS.values()) if models is None else models))
        tested = list(threads.map(job, fitted))
    alone, choice = [one[0] for one in tested], _choose(fitted, tester.folds)
    wheels = _table(tester, horizons_m, alone, choice)
    if not gyro:
        return wheels, None
    # the same models: a choice of its own for the gyro would only add noise
    names = Choice(f"{wheels.recommended}_gyro", wheels.why, tuple(f"{name}_gyro" for name in wheels.chosen))
    return wheels, _table(tester, horizons_m, [one[1] for one in tested], names)


class Recommendation(NamedTuple):
    """The model that `hold_out` recommends, fitted to everything, without the scores of a table.

    Attributes
    ----------
    why : the reason, one sentence
    typical : curvature and speed at which ICRs and multiplier are stated
    """

    fit: PooledFit
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
    with ThreadPoolExecutor(AT_ONCE) as threads:
        fitted = list(threads.map(tester.fit, MODELS.values()))
    choice = _choose(fitted, tester.folds)
    best = next(one for one in fitted if one.model.name == choice.recommended)
    return Recommendation(best.whole, choice.why, tester.typical)


class _Fitted(NamedTuple):
    """A model fitted to everything, and what it is chosen by.

    ``inner[f, g]`` (folds, folds): expected error [m] of the windows of fold g, fitted without f and g, to first order.
    """

    model: MotionModel
    pool: Pool
    whole: PooledFit
    inner: Floats


class _Tested(NamedTuple):
    """A model's fits, whole and without each fold; by fold trial errors and constants of the recording."""

    model: MotionModel
    whole: PooledFit
    fits: list[PooledFit]
    errors: list[Floats]
    own: list[LogConstants]


class _Tester:
    """What all models are fitted to and tested by."""

    def __init__(self, recordings: Sequence[Recording]) -> None:
        self.folds = folds = plan_folds(recordings)
        self._recordings = recordings
        self._windows = [cut_windows(one, pooled=recordings) for one in recordings]
        self._widths = [one.width_m for one in recordings]
        self._clear, self._inside = mask_windows(self._windows, folds)
        for fold, kept in zip(folds, self._clear, strict=True):
            if np.count_nonzero(kept) < FEWEST_RESIDUALS:
                why = "too short to fit on one part and test on another"
                raise DataError(fold.name, "too few windows beside it", why)
        self._trials: list[Trials] = []
        self.typical = typical_drive(
            [(wheel_motion(one.drive.v_left, one.drive.v_right, one.width_m), one.held_s) for one in recordings]
        )

    def cut_trials(self, horizons_m: Sequence[float]) -> None:
        """Cut the trials of every fold."""
        trials = [cut_trials(one, horizons_m) for one in self._recordings]
        self._trials = [
            trials[fold.recording].within(
                self._recordings[fold.recording].drive.distance, fold.begin_m, fold.end_m
            )
            for fold in self.folds
        ]  # fmt: skip

    def fit(self, model: MotionModel, wheels: FittedModel | None = None) -> _Fitted:
        """Fit a model to everything; one with a gyro weighs the turn rate of a fit for wheels alone."""
        pool = Pool(self._windows, self._widths, model, wheels)
        whole, count = pool.fit(), len(self.folds)
        inner = np.full((count, count), np.nan)
        for f in range(count):
            for g in range(f, count):
                if f == g or count >= FEWEST_TO_CHOOSE:
                    x = pool.without(whole, ~(self._clear[f] & self._clear[g]))
                    inner[f, g] = self._window_error(whole, g, x)
                    inner[g, f] = self._window_error(whole, f, x)
        return _Fitted(model, pool, whole, inner)

    def test(self, fitted: _Fitted, wheels: _Tested | None = None) -> _Tested:
        """Test a model; one with a gyro weighs the turn rates of the fits for wheels alone without the same folds."""
        model, pool, fits, errors, constants = fitted.model, fitted.pool, [], [], []
        for f, fold in enumerate(self.folds):
            if wheels is not None:
                pool = Pool(self._windows, self._widths, model, wheels.fits[f].fitted)
            fit = pool.fit(self._clear[f], fitted.pool.without(fitted.whole, ~self._clear[f]))
            # from what is left of a recording, or, where all of it is left out, from itself with the others' parameters
            i = fold.recording
            own = pool.own_constants(i, fit.parameters) if fold.whole else fit.constants[i]
            fits.append(fit)
            errors.append(self.trial_errors(fit, f, own))
            constants.append(own)
        return _Tested(model, fitted.whole, fits, errors, constants)

    def _window_error(self, fit: PooledFit, f: int, x: Floats) -> float:
        """Return the expected error [m] of a fold's windows of `CHOICE_HORIZON_M`, for all parameters x near a fit."""
        rows = self._inside[f]
        residuals = fit.residuals[rows] + fit.jacobian[rows] @ (x - fit.solution.x)
        half = len(residuals) // 2
        if not half:
            return float("nan")
        return float(np.hypot(residuals[:half], residuals[half:]).mean() * np.sqrt(CHOICE_HORIZON_M))

    def trial_errors(self, fitted: FittedModel, f: int, own: LogConstants) -> Floats:
        """Return the errors of a fold's trials."""
        i = self.folds[f].recording
        path = predicted_path(self._recordings[i], fitted, own, self._windows[i].steps)
        return trial_errors(self._recordings[i], self._trials[f], path)

    def controller_errors(self, fit: PooledFit, f: int, own: LogConstants) -> Floats:
        """Return the errors of a fold's trials with what a controller can express of a fit without the fold."""
        width_m = self._recordings[self.folds[f].recording].width_m
        return self.trial_errors(
            controller_model(track_geometry(fit.model, fit.parameters, width_m, self.typical)), f, own
        )


def block_trials(recording: Recording, folds: Sequence[Fold], horizons_m: Sequence[float]) -> Trials:
    """Return the trials of a recording that lie within one of its blocks."""
    trials = cut_trials(recording, horizons_m)
    parts = [trials.within(recording.drive.distance, fold.begin_m, fold.end_m) for fold in folds]
    return Trials(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _choose(fitted: Sequence[_Fitted], folds: Sequence[Fold]) -> Choice:
    inner = {one.model.name: one.inner for one in fitted}
    sizes = {one.model.name: len(one.model.terms) for one in fitted}
    return nested_choice(inner, sizes, one_recording=folds[0].recording == folds[-1].recording)


def _table(
    tester: _Tester, horizons_m: Sequence[float], tested: Sequence[_Tested], choice: Choice
) -> HeldOut:  # fmt: skip
    """Return the table of models that were tested on the same folds."""
    by_name = {one.model.name: one for one in tested}
    rows = [_scores(name, one.model.label, one.errors) for name, one in by_name.items()]
    rows.append(
        _scores("recommended", "recommended", [by_name[name].errors[f] for f, name in enumerate(choice.chosen)])
    )
    fits = {name: one.whole for name, one in by_name.items()}
    without = tuple(by_name[name].fits[f] for f, name in enumerate(choice.chosen))
    own = tuple(by_name[name].own[f] for f, name in enumerate(choice.chosen))
    if not any(fit.model.uses_gyro for fit in without):
        errors = [tester.controller_errors(fit, f, own[f]) for f, fit in enumerate(without)]
        rows.append(_scores(CONTROLLER.name, CONTROLLER.label, errors))
    return HeldOut(
        tuple(horizons_m), tester.folds, tuple(rows), fits, without, own, tester.typical, choice.recommended,
        choice.chosen, choice.why,
    )  # fmt: skip


def mask_windows(windows: Sequence[Windows], folds: Sequence[Fold]) -> tuple[list[Bools], list[Bools]]:
    """Return, by fold, the residuals that share no distance with it, and those of 10 m that lie within it."""
    clear, inside = [], []
    for fold in folds:
        apart, within = [], []
        for i, w in enumerate(windows):
            mine = np.full(len(w.start), i == fold.recording)
            here = mine & (w.start_m >= fold.begin_m) & (w.end_m <= fold.end_m) & (w.length_m == CHOICE_HORIZON_M)
            apart.append(np.tile(~mine | (w.end_m <= fold.begin_m) | (w.start_m >= fold.end_m), 2))
            within.append(np.tile(here, 2))
        clear.append(np.concatenate(apart))
        inside.append(np.concatenate(within))
    return clear, inside


def _scores(name: str, label: str, errors: Sequence[Floats]) -> HeldOutRow:
    folds = tuple(summarise(one) for one in errors)
    return HeldOutRow(name, label, folds, summarise(np.concatenate(errors)))


def _over(function: Callable[[Floats], Any], folds: Sequence[Summary], column: str, h: int) -> float:
    values = np.array([getattr(fold, column)[h] for fold in folds])
    values = values[np.isfinite(values)]
    return float(function(values)) if len(values) else float("nan")
