"""Which motion model to recommend, from its errors on folds that it was not fitted to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.records.dropout import CHOICE_HORIZON_M

FEWEST_TO_CHOOSE = 3
"""With fewer folds, what is left beside the one left out cannot be cut once more to choose a model."""

UNCHOSEN = "icr"
"""With two recordings, the paper's model stands for what is recommended without one of them."""

BASELINE = "multiplier"
"""What is worse than this one is never recommended."""

MOST_GIVEN_UP = 0.05
"""A simpler model may cost this share of the best one's error, no more: few folds show their own noise badly."""


class Choice(NamedTuple):
    """The model recommended and why, and the one chosen without each fold."""

    recommended: str
    why: str
    chosen: tuple[str, ...]


def nested_choice(inner: Mapping[str, Floats], sizes: Mapping[str, int]) -> Choice:
    """Choose with all folds, and without each of them.

    Parameters
    ----------
    inner : by model (folds, folds): error [m] of the windows of fold g, fitted without f and g
    sizes : by model, how many parameters it has
    """
    count = len(next(iter(inner.values())))
    baseline = BASELINE if BASELINE in inner else next(iter(inner))
    recommended, why = choose({name: np.diag(one) for name, one in inner.items()}, sizes, baseline)
    chosen = [UNCHOSEN if UNCHOSEN in inner else baseline] * count
    if count >= FEWEST_TO_CHOOSE:
        for f in range(count):
            others = [g for g in range(count) if g != f]
            chosen[f], _ = choose({name: one[f, others] for name, one in inner.items()}, sizes, baseline)
    return Choice(recommended, why, tuple(chosen))


def choose(errors: Mapping[str, Floats], sizes: Mapping[str, int], baseline: str) -> tuple[str, str]:
    """Return the model to recommend and why: the simplest whose held-out error is within noise of the best.

    Parameters
    ----------
    errors : by model, expected error of each fold (folds,) [m], NaN where it has no window
    sizes : by model, how many parameters it has
    baseline : what is worse than this one is not recommended

    Notes
    -----
    The rule of one standard error (Breiman et al. 1984), of the logarithms' differences over the same folds, since some
    folds are harder than others for every model.
    """
    logs = {name: np.log(np.maximum(values[np.isfinite(values)], 1e-9)) for name, values in errors.items()}
    logs = {name: values for name, values in logs.items() if len(values) and values.mean() <= logs[baseline].mean()}
    if not logs:
        return baseline, "the drive is too short to compare models"
    best = min(logs, key=lambda name: float(logs[name].mean()))
    for name in sorted(logs, key=lambda one: sizes[one]):
        apart = logs[name] - logs[best]
        noise = float(apart.std(ddof=1)) / np.sqrt(len(apart)) if len(apart) > 1 else np.inf
        if name == best or float(apart.mean()) <= min(noise, MOST_GIVEN_UP):
            break
    if name == best:
        return name, f"least expected error after {CHOICE_HORIZON_M:g} m on what it was not fitted to"
    share = 100.0 * float(np.expm1((logs[name] - logs[best]).mean()))
    return name, f"simplest within noise of the best: {share:.0f} % more expected error than model {best}"
