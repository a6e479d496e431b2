"""Every motion model on recordings, or blocks of one, that it was not fitted to; and which model to recommend.

Each fold, a recording or a block of distance, is left out in turn (Stone 1974). What is recommended for a fold is also
*chosen* without it, so the reported score of the recommended model is honest.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icrtool.errors import DataError
from icrtool.kernels.error_statistics import summarise
from icrtool.kernels.trials import Summary
from icrtool.motion.fit import Pool, PooledFit
from icrtool.motion.models import MODELS, MotionModel
from icrtool.motion.recording import Recording, Windows, cut_windows
from icrtool.motion.trials import cut_trials, trial_errors
from icrtool.records.dropout import CHOICE_HORIZON_M
from icrtool.records.tables import Bools, Floats

HORIZONS_M = (5.0, 10.0, 20.0)

SHORTEST_BLOCK_M, MOST_BLOCKS = 25.0, 5

FEWEST_RESIDUALS = 20

FEWEST_TO_CHOOSE = 3
"""With fewer folds, what is left beside the one left out cannot be cut once more to choose a model."""

BASELINE = "multiplier"
"""What is worse than this one is never recommended."""

MOST_GIVEN_UP = 0.05
"""A simpler model may cost this share of the best one's error, no more: few folds show their own noise badly."""

AT_ONCE = 2


class Fold(NamedTuple):
    """What is left out together: a recording, or a block of one between two path lengths [m]."""

    name: str
    recording: int
    begin_m: float
    end_m: float


@dataclass(frozen=True, slots=True)
class ModelScores:
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
        return _over(np.median, self.folds, column, h)

    def worst(self, column: str, h: int) -> float:
        """Return the largest over folds."""
        return _over(np.max, self.folds, column, h)


@dataclass(frozen=True, slots=True)
class HeldOut:
    """The leave-one-out table of one set of models.

    Attributes
    ----------
    scores : by model, in the order of the family, then what was recommended without each fold
    fits : of everything, by model name
    recommended : name of the model chosen with all folds
    chosen : by fold, the model chosen without it
    why : the reason, one sentence
    """

    horizons_m: tuple[float, ...]
    folds: tuple[Fold, ...]
    scores: tuple[ModelScores, ...]
    fits: dict[str, PooledFit]
    recommended: str
    chosen: tuple[str, ...]
    why: str

    def score(self, name: str) -> ModelScores:
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
    return tuple(Fold(f"block {i + 1}", 0, float(a), float(b)) for i, (a, b) in enumerate(zip(edges, edges[1:])))


def count_blocks(distance_m: float) -> int:
    """Return into how many blocks a drive of this length is cut."""
    return int(np.clip(distance_m // SHORTEST_BLOCK_M, 2, MOST_BLOCKS))


def hold_out(
    recordings: Sequence[Recording],
    models: Sequence[MotionModel] | None = None,
    horizons_m: Sequence[float] = HORIZONS_M,
) -> HeldOut:
    """Fit and test every model, each fold left out in turn.

    Parameters
    ----------
    recordings : at least one
    models : the candidates; default the family, wheels alone

    Raises
    ------
    DataError
        Too short a drive, or too little left beside a fold.
    """
    models = tuple(MODELS.values()) if models is None else tuple(models)
    folds = plan_folds(recordings)
    windows = [cut_windows(one) for one in recordings]
    clear, inside = _masks(windows, folds)
    for fold, kept in zip(folds, clear, strict=True):
        if np.count_nonzero(kept) < FEWEST_RESIDUALS:
            raise DataError(fold.name, "too few windows beside it", "too short to fit on one part and test on another")
    trials = [cut_trials(one, horizons_m) for one in recordings]

    def job(model: MotionModel) -> _Tested:
        pool = Pool(windows, [one.width_m for one in recordings], model)
        whole = pool.fit()
        errors, inner = [], np.full((len(folds), len(folds)), np.nan)
        for f, fold in enumerate(folds):
            fit = pool.fit(clear[f], pool.without(whole, ~clear[f]))
            one = recordings[fold.recording]
            mine = trials[fold.recording].within(one.drive.distance, fold.begin_m, fold.end_m)
            bias = _own_bias(pool, fit, fold.recording, clear[f])
            errors.append(trial_errors(one, mine, model, fit.parameters, bias))
            inner[f, f] = _window_error(fit.residuals[inside[f]])
            for g in range(len(folds)):
                if g != f and len(folds) >= FEWEST_TO_CHOOSE:
                    x = pool.without(fit, ~clear[g])
                    moved = fit.residuals[inside[g]] + fit.jacobian[inside[g]] @ (x - fit.solution.x)
                    inner[f, g] = _window_error(moved)
        return _Tested(model, whole, errors, inner)

    with ThreadPoolExecutor(AT_ONCE) as threads:
        tested = {one.model.name: one for one in threads.map(job, models)}
    baseline = next((name for name in tested if name.startswith(BASELINE)), next(iter(tested)))
    outer = {name: np.diag(one.inner) for name, one in tested.items()}
    recommended, why = choose(outer, baseline, tested)
    chosen = []
    for f in range(len(folds)):
        others = [g for g in range(len(folds)) if g != f]
        within = {name: one.inner[f, others] for name, one in tested.items()}
        chosen.append(choose(within, baseline, tested)[0] if len(folds) >= FEWEST_TO_CHOOSE else baseline)
    rows = [_scores(name, one.model.label, one.errors) for name, one in tested.items()]
    nested = [tested[name].errors[f] for f, name in enumerate(chosen)]
    rows.append(_scores("recommended", "recommended", nested))
    return HeldOut(
        tuple(horizons_m), folds, tuple(rows), {name: one.whole for name, one in tested.items()},
        recommended, tuple(chosen), why,
    )  # fmt: skip


class _Tested(NamedTuple):
    """A model's fit to everything, its trial errors by fold, and window errors (folds, folds).

    ``inner[f, g]``: expected error of fold g, fitted without f and g; ``inner[f, f]`` without f alone.
    """

    model: MotionModel
    whole: PooledFit
    errors: list[Floats]
    inner: Floats


def choose(errors: dict[str, Floats], baseline: str, models: dict[str, _Tested]) -> tuple[str, str]:
    """Return the model to recommend and why: the simplest whose held-out error is within noise of the best.

    Parameters
    ----------
    errors : by model, expected error of each fold (folds,) [m]
    baseline : what is worse than this one is not recommended

    Notes
    -----
    The rule of one standard error (Breiman et al. 1984), of differences over the same folds, since some folds are
    harder than others for every model.
    """
    means = {name: float(np.nanmean(np.log(values))) for name, values in errors.items() if np.isfinite(values).any()}
    means = {name: mean for name, mean in means.items() if mean <= means.get(baseline, np.inf)}
    best = min(means, key=lambda name: means[name])
    for name in sorted(means, key=lambda one: len(models[one].model.terms)):
        apart = np.log(errors[name]) - np.log(errors[best])
        apart = apart[np.isfinite(apart)]
        noise = float(apart.std(ddof=1)) / np.sqrt(len(apart)) if len(apart) > 1 else np.inf
        if float(apart.mean()) <= min(noise, MOST_GIVEN_UP):
            break
    return name, ""


def _masks(windows: Sequence[Windows], folds: Sequence[Fold]) -> tuple[list[Bools], list[Bools]]:
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


def _window_error(residuals: Floats) -> float:
    """Return the expected error [m] of windows of `CHOICE_HORIZON_M` from their residuals, forward then right."""
    half = len(residuals) // 2
    if not half:
        return float("nan")
    return float(np.hypot(residuals[:half], residuals[half:]).mean() * np.sqrt(CHOICE_HORIZON_M))


def _own_bias(pool: Pool, fit: PooledFit, recording: int, kept: Bools) -> float:
    """Return the gyro bias of a fold's recording: a constant of its own, from the recording where all is left out."""
    return float(fit.constants[recording, 2])


def _scores(name: str, label: str, errors: Sequence[Floats]) -> ModelScores:
    folds = tuple(summarise(one) for one in errors)
    return ModelScores(name, label, folds, summarise(np.concatenate(errors)))


def _over(function: np.ufunc, folds: Sequence[Summary], column: str, h: int) -> float:
    values = np.array([getattr(fold, column)[h] for fold in folds])
    values = values[np.isfinite(values)]
    return float(function(values)) if len(values) else float("nan")
