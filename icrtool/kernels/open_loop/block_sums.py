"""Sums of trials over blocks of path, and the confidence intervals that follow from them.

No compiled kernel is here: a process that only reads or draws these records need not load numba.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bools, Floats, Ints

SHARES = {"p50": 0.5, "p95": 0.95}

FEWEST_BLOCKS, MOST_BLOCKS, HORIZONS_A_BLOCK = 3, 8, 4
"""Blocks of at least so many horizons: what wanders over some horizons makes shorter ones alike. A path of less than
twelve horizons is too short for an interval. More than eight blocks would be narrower by a sixth at most (Student's
factor is 2.36, without limit 1.96), and less independent."""

LARGEST_GROWTH = 10.0
"""Logarithm of the widest interval: one block with all of the error shows nothing."""

LEVEL, NORMAL_FACTOR = 0.95, 1.959964
"""An interval holds the truth with this probability, as far as blocks are independent: so many standard deviations of a
normal value."""


class Blocks(NamedTuple):
    """The path of one horizon's trials, cut into `k` blocks; the same for every model.

    Attributes
    ----------
    rows : where the trials stand among all starts
    first : (k,) first trial of each block
    """

    rows: slice | Bools
    first: Ints


class BlockSums(NamedTuple):
    """The trials of one model and horizon, summed over `k` blocks of path.

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


def student_factor(freedom: float) -> float:
    """Return how many standard deviations half an interval is, estimated with so many degrees of freedom.

    Notes
    -----
    Student's t expanded about the normal quantile z (Abramowitz and Stegun 1964, 26.7.5): within 1 % from two degrees
    on, 0.1 % from four.
    """
    z, inverse = NORMAL_FACTOR, 1.0 / freedom
    terms = (
        z,
        (z**3 + z) / 4.0,
        (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0,
        (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0,
        (79.0 * z**9 + 776.0 * z**7 + 1482.0 * z**5 - 1920.0 * z**3 - 945.0 * z) / 92160.0,
    )
    return sum(term * inverse**power for power, term in enumerate(terms))


def error_intervals(
    errors_m: Floats, blocks: Blocks | None, sums: BlockSums | None, p95_m: float
) -> tuple[float, float, float, float]:
    """Return confidence intervals of one horizon's expected error and p95.

    Parameters
    ----------
    errors_m, blocks : as of `block_sums`, which gave `sums`
    p95_m : of all trials

    Returns
    -------
    expected_low, expected_high, p95_low, p95_high [m]; NaN without blocks

    Notes
    -----
    Student's t (1908) of what each block moves the logarithm of the number. p95 moves as the root mean square does,
    which blocks show better than the few trials above p95; the variance is the larger of both. 600 simulated paths of
    12 to 200 horizons: intervals hold the truth in 0.93-0.96 (p95 0.94-0.96) where what drives the errors changes
    within a horizon, and in 0.88-0.95 (p95 0.82-0.95) where it wanders over four. What changes over tens of horizons no
    short path shows.
    """
    if blocks is None or sums is None:
        return (math.nan,) * 4
    squares, trials = np.add.reduceat(errors_m[blocks.rows] ** 2, blocks.first), sums.trials
    total, count = float(squares.sum()), int(trials.sum())
    expected_m = float(sums.errors_m.sum()) / count
    if not (total > 0.0 and expected_m > 0.0 and p95_m > 0.0):
        return expected_m, expected_m, p95_m, p95_m
    of_rms = variance_of_sum(np.asarray(squares / total - trials / count) / 2.0)
    variances = variance_of_sum(sums.influence("expected") / expected_m), max(
        of_rms, variance_of_sum(sums.influence("p95") / p95_m)
    )  # fmt: skip
    factor = student_factor(len(trials) - 1.0)
    grown = [math.exp(min(factor * math.sqrt(variance), LARGEST_GROWTH)) for variance in variances]
    return expected_m / grown[0], expected_m * grown[0], p95_m / grown[1], p95_m * grown[1]


def difference_half_width(
    now: BlockSums | None, before: BlockSums | None, metric: str, factor: float, *, paired: bool
) -> float:
    """Return half the confidence interval [m] of ``number - factor * baseline``; NaN where there is none.

    Parameters
    ----------
    paired : both have the same blocks of path, whose errors are then compared one by one

    Notes
    -----
    Student's distribution. Paired: of the differences of the blocks' influences. Otherwise both variances
    add up, degrees of freedom of Welch (1947).
    """
    if now is None or before is None or metric in {"max", "within"}:
        return math.nan
    new, old = now.influence(metric), factor * before.influence(metric)
    if paired and len(new) == len(old):
        variance, freedom = variance_of_sum(new - old), float(len(new) - 1)
    else:
        parts = [(variance_of_sum(part), len(part) - 1) for part in (new, old)]
        variance = sum(part for part, _ in parts)
        weight = sum(part**2 / degrees for part, degrees in parts)
        freedom = variance**2 / weight if weight > 0 else 1.0
    return student_factor(freedom) * math.sqrt(variance)


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
    errors, first = errors_m[blocks.rows], blocks.first
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
