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
"""Recommended where a drive is too short to compare models."""


class Choice(NamedTuple):
    """The model recommended and why, and the one chosen without each fold."""

    recommended: str
    why: str
    chosen: tuple[str, ...]


def nested_choice(inner: Mapping[str, Floats]) -> Choice:
    """Choose with all folds, and without each of them.

    Parameters
    ----------
    inner : by model (folds, folds): error [m] of the windows of fold g, fitted without f and g
    """
    count = len(next(iter(inner.values())))
    baseline = BASELINE if BASELINE in inner else next(iter(inner))
    recommended, why = choose({name: np.diag(one) for name, one in inner.items()}, baseline)
    chosen = [UNCHOSEN if UNCHOSEN in inner else baseline] * count
    if count >= FEWEST_TO_CHOOSE:
        for f in range(count):
            others = [g for g in range(count) if g != f]
            chosen[f], _ = choose({name: one[f, others] for name, one in inner.items()}, baseline)
    return Choice(recommended, why, tuple(chosen))


def choose(errors: Mapping[str, Floats], baseline: str) -> tuple[str, str]:
    """Return the model to recommend and why: the one with the least held-out error.

    Parameters
    ----------
    errors : by model, expected error of each fold (folds,) [m], NaN where it has no window
    baseline : what is recommended where no fold has a window

    Notes
    -----
    The mean is that of the logarithms, as some folds are harder than others for every model. Every term has a prior:
    one that the drive does not show costs little, so that a simpler model is not preferred for its own sake.
    """
    means = {
        name: np.log(np.maximum(values[np.isfinite(values)], 1e-9)).mean()
        for name, values in errors.items()
        if np.isfinite(values).any()
    }
    if not means:
        return baseline, "the drive is too short to compare models"
    best = min(means, key=lambda name: float(means[name]))
    return best, f"least expected error after {CHOICE_HORIZON_M:g} m on what it was not fitted to"
