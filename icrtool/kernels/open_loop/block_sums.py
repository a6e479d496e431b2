"""Sums of trials over blocks of path: what the confidence interval of a difference between two reports needs.

No compiled kernel is here: a process that only reads or draws these records need not load numba.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bools, Floats, Ints

SHARES = {"p50": 0.5, "p95": 0.95}

MOST_BLOCKS = 16
"""More would narrow an interval by less than 2 %: the factor of Student's distribution is 2.13, without limit 1.96."""

LEVEL = 0.95
"""An interval holds the truth with this probability, as far as blocks of the horizon's length are independent."""

BLOCK_PARTS = 4
"""Blocks begin at every quarter of their length."""


class Blocks(NamedTuple):
    """The path of one horizon's trials, cut for resampling; the same for every model.

    Attributes
    ----------
    rows : where the trials stand among all starts
    first : (s,) first trial of each segment
    kept : (k,) trials that p95 is resampled from; segments : (k,) where they lie
    per_segment : (s, 2) trials, and kept ones
    """

    rows: slice | Bools
    first: Ints
    kept: Ints
    segments: Ints
    per_segment: Floats


class BlockSums(NamedTuple):
    """The trials of one model and horizon, summed over `k` blocks of path of at least the horizon's length.

    Attributes
    ----------
    trials : (k,) trials that start in a block
    errors_m : (k,) [m] sum of their errors
    above_p50, above_p95 : (k,) trials whose error is above the percentile of all
    p50_slope_m, p95_slope_m : [m] growth of the percentile with the share of trials
    """

    trials: Ints
    errors_m: Floats
    above_p50: Ints
    above_p95: Ints
    p50_slope_m: float
    p95_slope_m: float

    def influence(self, metric: str) -> Floats:
        """Return how much each block moved a number (``expected``, ``p50``, ``p95``): (k,) [m], with a sum near 0.

        Notes
        -----
        The linear part of the estimate's error: of a mean (ratio of two sums) and of a sample quantile (Bahadur 1966).
        """
        count = max(int(self.trials.sum()), 1)
        if metric == "expected":
            return np.asarray((self.errors_m - self.errors_m.sum() / count * self.trials) / count)
        above, slope = {
            "p50": (self.above_p50, self.p50_slope_m), "p95": (self.above_p95, self.p95_slope_m),
        }[metric]  # fmt: skip
        return np.asarray((above - (1.0 - SHARES[metric]) * self.trials) * (slope / count))


def variance_of_sum(influence: Floats) -> float:
    """Return the variance of the sum of (k,) influences of neighbouring blocks.

    Notes
    -----
    Newey and West (1987) with one lag: a trial is at most as long as a block, so only neighbours share path. The sum of
    squares alone is the lower bound.
    """
    k = len(influence)
    squares = float(influence @ influence)
    return max(squares, squares + float(influence[1:] @ influence[:-1])) * k / (k - 1)


def block_sums(
    errors_m: Floats, blocks: Blocks | None, ordered: Floats, p50_m: float, p95_m: float
) -> BlockSums | None:
    """Sum the trials of one horizon over blocks of path.

    Parameters
    ----------
    errors_m : (n,) [m], NaN where there was no trial
    blocks : of `icrtool.kernels.open_loop.error_statistics.cut_blocks`
    ordered : errors of the trials in ascending order
    p50_m, p95_m : percentiles of all

    Returns
    -------
    None without blocks.
    """
    if blocks is None:
        return None
    errors = errors_m[blocks.rows]
    segments = len(blocks.first)
    k = min(MOST_BLOCKS, segments // BLOCK_PARTS)
    first = blocks.first[-(-np.arange(k) * segments // k)]
    trials = np.diff(first, append=len(errors))
    sums = np.add.reduceat(errors, first)
    above = [np.add.reduceat(errors > limit, first, dtype=np.int64) for limit in (p50_m, p95_m)]
    growth = [
        _slope(ordered, share, np.asarray((count - (1.0 - share) * trials) / len(errors)))
        for share, count in zip(SHARES.values(), above, strict=True)
    ]
    return BlockSums(trials, sums, above[0], above[1], *growth)


def _slope(ordered: Floats, share: float, influence: Floats) -> float:
    """Return the growth of a percentile [m] with its share, over the uncertainty of the share (Woodruff 1952)."""
    std = variance_of_sum(influence) ** 0.5
    low, high = np.clip([share - std, share + std], 0.0, 1.0)
    if not high > low:
        return 0.0
    return (quantile(ordered, float(high)) - quantile(ordered, float(low))) / float(high - low)


def quantile(ordered: Floats, share: float) -> float:
    """Return numpy's 'linear' quantile of sorted values."""
    rank = share * (len(ordered) - 1)
    below = math.floor(rank)
    low, high = ordered[below], ordered[min(below + 1, len(ordered) - 1)]
    return float(low + (high - low) * (rank - below))
