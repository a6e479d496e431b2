"""How far an error stays within a budget."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Floats


def within_budget(horizons_m: Floats, p95_m: Floats, budget_m: float) -> tuple[float, bool, tuple[float, float]] | None:
    """Return how far an error (h,) [m] stays within a budget, over the distance (h,) [m] and from 0 m at 0 m on.

    Returns
    -------
    The interpolated distance, whether the error is within the budget at the last one, and the distances interpolated
    between; None without errors.

    Notes
    -----
    Errors at few trials may fall with the distance; here they are those that never fall and are nearest to the given
    ones (isotonic regression, Barlow et al. 1972: the largest over beginnings of the smallest mean over ends).
    """
    known = np.isfinite(p95_m)
    if not known.any():
        return None
    distance = np.concatenate([[0.0], horizons_m[known]])
    p95 = np.concatenate([[0.0], never_falling(p95_m[known])])
    over = np.flatnonzero(p95 > budget_m)
    if not len(over):
        return float(distance[-1]), True, (float(distance[-1]), float(distance[-1]))
    i = int(over[0])
    share = (budget_m - p95[i - 1]) / (p95[i] - p95[i - 1])
    low, high = float(distance[i - 1]), float(distance[i])
    return low + float(share) * (high - low), False, (low, high)


def never_falling(values: Floats) -> Floats:
    """Return the values (n,) that never fall and are nearest to given ones by least squares."""
    sums, n = np.concatenate([[0.0], np.cumsum(values)]), len(values)
    first, last = np.arange(n)[:, None], np.arange(n)
    length = last - first + 1
    means = np.where(length > 0, (sums[1:] - sums[:-1, None]) / np.maximum(length, 1), np.inf)
    # the smallest mean of a stretch from each first value to each last one or further
    least = np.minimum.accumulate(means[:, ::-1], axis=1)[:, ::-1]
    least[length <= 0] = -np.inf
    found: Floats = least.max(axis=0)
    return found
