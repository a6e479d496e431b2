"""Statistics of open-loop errors: percentiles and mean per horizon, their confidence intervals, histograms, budgets.

Errors are float64 (n_starts, n_horizons) [m] with NaN where there was no trial, as `icrtool.kernels.open_loop` makes
them. Trials from neighbouring starts share most of their path and are not independent: intervals come from blocks of
path, not from trials. This module has no compiled kernel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import ROWS_AT_ONCE, Bools, Floats, Ints, rows_of_cells


class Summary(NamedTuple):
    """Errors of one model at each horizon; (n_horizons,) each, NaN for a horizon without trials.

    Attributes
    ----------
    trials : int64, number of trials
    expected, p50, p95, largest : float64 [m]; the expected error is the mean
    """

    trials: Ints
    expected: Floats
    p50: Floats
    p95: Floats
    largest: Floats


class Histogram(NamedTuple):
    """Percent of the trials by error; float64 (n_bins,) each, bins ``[left, right)`` [m] from zero."""

    left: Floats
    right: Floats
    percent: Floats


SHARES = {"p50": 0.5, "p95": 0.95}
"""Shares of the trials below each percentile."""

FEWEST_PATH_BLOCKS = 3
"""Smallest number of blocks of path for an interval. A path of less than twelve horizons has no interval."""

MOST_PATH_BLOCKS = 8
"""Largest number of blocks of path. More blocks would make an interval narrower by at most a sixth (Student's factor is
2.36 for eight blocks, 1.96 for any number), and would be less independent."""

HORIZONS_A_BLOCK = 4
"""Smallest length of a block, in horizons. Errors change slowly over some horizons, so shorter blocks would not be
independent."""

PRIOR_FREEDOM = 6.0
"""Degrees of freedom of a variance that is known from other drives. It has the weight of seven blocks of path."""

LEVEL, NORMAL_FACTOR = 0.95, 1.959964
"""Probability that the interval of a number of this drive contains the true value, and the normal quantile of that
probability (two-sided) in standard deviations."""

NEXT_LEVEL, NEXT_NORMAL_FACTOR = 0.90, 1.644854
"""Probability that the interval of the next drive contains its number, and the normal quantile of that probability
(two-sided)."""


class Spread(NamedTuple):
    """Differences of the logarithm of p95 between drives of one robot on one kind of ground.

    Attributes
    ----------
    shift : mean difference, next drive minus this drive. Numbers that were fitted to a drive have smaller errors in it
    between : standard deviation between long drives
    horizon_std : standard deviation in a drive of one horizon; the variance decreases with the length of the drive
    grounds : standard deviation between kinds of ground, for numbers that were fitted to other grounds

    Notes
    -----
    ``benchmarks/next_drive.py`` measures these numbers, and `icrtool.records.rows` states them for each row.
    """

    shift: float
    between: float
    horizon_std: float
    grounds: float


class Intervals(NamedTuple):
    """Intervals at one horizon [m]: of this drive with probability `LEVEL`, of the next drive with `NEXT_LEVEL`."""

    expected_low: float
    expected_high: float
    p95_low: float
    p95_high: float
    p95_next_low: float
    p95_next_high: float


class Blocks(NamedTuple):
    """The path of the trials of one horizon, cut into k blocks, which are the same for every model.

    Attributes
    ----------
    rows : rows of the trials among all starts
    first : (k,) first trial of each block; empty if the path is too short for `FEWEST_PATH_BLOCKS`
    horizons : length of the path, in horizons
    """

    rows: slice | Bools
    first: Ints
    horizons: float


class BlockSums(NamedTuple):
    """Sums of the trials of one model and horizon over k blocks of path.

    Attributes
    ----------
    trials : (k,) number of trials that start in each block
    errors_m : (k,) sum of their errors [m]
    above_p50, above_p95 : (k,) number of trials with an error above p50, or p95, of all trials
    p50_slope_m, p95_slope_m : growth of the percentile with the share of trials [m]
    """

    trials: Ints
    errors_m: Floats
    above_p50: Ints
    above_p95: Ints
    p50_slope_m: float
    p95_slope_m: float

    def influence(self, metric: str) -> Floats:
        """Return the influence (k,) [m] of each block on a number (``expected``, ``p50``, ``p95``); the sum is near 0.

        Notes
        -----
        The influence is the linear part of the error of a mean (ratio of two sums) or of a sample quantile (Bahadur
        1966).
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
    Newey and West (1987) with one lag, because a trial is at most as long as a block, so that only neighbours share
    path. The sum of the squares is a lower bound.
    """
    k = len(influence)
    squares = float(influence @ influence)
    return max(squares, squares + float(influence[1:] @ influence[:-1])) * k / (k - 1)


def student_factor(freedom: float, z: float = NORMAL_FACTOR) -> float:
    """Return half the length of an interval, in standard deviations that are estimated from data.

    Parameters
    ----------
    freedom : degrees of freedom of the estimated standard deviation
    z : half the length for a known standard deviation

    Notes
    -----
    Student's t, expanded about the normal quantile z (Abramowitz and Stegun 1964, 26.7.5). The error is below 1 % from
    two degrees of freedom on, and below 0.1 % from four.
    """
    inverse = 1.0 / freedom
    terms = (
        z,
        (z**3 + z) / 4.0,
        (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0,
        (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0,
        (79.0 * z**9 + 776.0 * z**7 + 1482.0 * z**5 - 1920.0 * z**3 - 945.0 * z) / 92160.0,
    )
    return sum(term * inverse**power for power, term in enumerate(terms))


def pooled_variance(measured: float, freedom: float, known: float) -> tuple[float, float]:
    """Return the mean of a measured variance and of a variance known from other drives, and its degrees of freedom.

    Notes
    -----
    The mean of both, weighted by their degrees of freedom (`PRIOR_FREEDOM` for the known variance): the posterior scale
    of a normal variance under its conjugate prior.
    """
    together = PRIOR_FREEDOM + freedom
    return (PRIOR_FREEDOM * known + freedom * measured) / together, together


def between_variance(values: Floats, variances: Floats) -> float:
    """Return the variance between values (k,) beyond their own variances (k,); zero if their own variances explain all.

    Notes
    -----
    DerSimonian and Laird 1986, Eq. 8: moments of the weighted squares about the weighted mean.
    """
    weights = 1.0 / variances
    mean = float(weights @ values / weights.sum())
    squares = float(weights @ (values - mean) ** 2)
    scale = float(weights.sum() - weights @ weights / weights.sum())
    return max((squares - (len(values) - 1.0)) / scale, 0.0)


def ground_interval(p95_m: Floats, known_std: float) -> tuple[float, float]:
    """Return the interval of p95 on a further ground [m], with `NEXT_LEVEL`, from p95 on k >= 2 grounds (k,) [m].

    Parameters
    ----------
    known_std : standard deviation of the logarithm between grounds, from other robots

    Notes
    -----
    Prediction interval of a normal logarithm (Student's t). The variance between the grounds is pooled with the
    variance of other robots (`pooled_variance`).
    """
    logarithms = np.log(p95_m)
    measured = float(logarithms.var(ddof=1))
    variance, freedom = pooled_variance(measured, len(p95_m) - 1.0, known_std**2)
    half = student_factor(freedom, NEXT_NORMAL_FACTOR) * math.sqrt(variance * (1.0 + 1.0 / len(p95_m)))
    middle = float(logarithms.mean())
    return math.exp(middle - half), math.exp(middle + half)


def error_intervals(
    errors_m: Floats, blocks: Blocks | None, sums: BlockSums | None, p50_m: float, p95_m: float, spread: Spread
) -> Intervals:
    """Return intervals of one horizon's expected error and p95, on this drive and on the next one.

    Parameters
    ----------
    errors_m, blocks : arguments of `block_sums`
    sums : result of `block_sums`
    p50_m, p95_m : percentiles of all trials
    spread : spread between drives, known from other drives

    Returns
    -------
    Intervals
        NaN without trials.

    Notes
    -----
    The logarithms of the errors are normal, and the intervals follow from Student's t (1908). The variance of a drive
    is the variance that its blocks show, pooled with the variance of drives of its length (`pooled_variance`), because
    few blocks alone would give intervals of any width. p95 is proportional to the root mean square, and blocks show the
    root mean square better than the few trials above p95 show p95. On a short path the logarithm of p95 is smaller than
    on a long path, by about its variance, so the upper end is raised by this variance. The interval of p95 of this
    drive does not go below the median, nor above the interval of the next drive.

    The variance of the next drive, of the same length, is larger by the variance of its own finite path and the
    variance between drives.
    """
    if blocks is None or not math.isfinite(p95_m):
        return Intervals(*(math.nan,) * 6)
    expected_m = float(errors_m[blocks.rows].mean()) if sums is None else float(sums.errors_m.sum() / sums.trials.sum())
    if not (expected_m > 0.0 and p95_m > 0.0):
        return Intervals(expected_m, expected_m, p95_m, p95_m, p95_m, p95_m)
    length_variance = spread.horizon_std**2 / blocks.horizons
    measured = (
        (length_variance, length_variance) if sums is None else _block_variances(errors_m, blocks, sums, expected_m)
    )
    freedom = 0.0 if sums is None else len(sums.trials) - 1.0
    (mean_variance, _), (p95_variance, together) = (
        pooled_variance(variance, freedom, length_variance) for variance in measured
    )
    next_variance = 2.0 * p95_variance + spread.between**2
    factor, next_factor = student_factor(together), student_factor(together, NEXT_NORMAL_FACTOR)
    grown = math.exp(factor * math.sqrt(mean_variance)), math.exp(factor * math.sqrt(p95_variance))
    longer = math.exp(p95_variance)
    middle, next_grown = p95_m * math.exp(spread.shift), math.exp(next_factor * math.sqrt(next_variance))
    next_low, next_high = middle / next_grown, middle * next_grown
    p95_low, p95_high = max(p95_m / grown[1], min(p50_m, p95_m)), min(p95_m * grown[1] * longer, max(next_high, p95_m))
    return Intervals(expected_m / grown[0], expected_m * grown[0], p95_low, p95_high, next_low, next_high)


def _block_variances(errors_m: Floats, blocks: Blocks, sums: BlockSums, expected_m: float) -> tuple[float, float]:
    """Return the variances of the logarithms of mean and root mean square that the blocks show."""
    squares, trials = np.add.reduceat(errors_m[blocks.rows] ** 2, blocks.first), sums.trials
    rms_variance = variance_of_sum(np.asarray(squares / squares.sum() - trials / trials.sum()) / 2.0)
    return variance_of_sum(sums.influence("expected") / expected_m), rms_variance


def difference_half_width(
    now: BlockSums | None, before: BlockSums | None, metric: str, factor: float, *, paired: bool
) -> float:
    """Return half the confidence interval [m] of ``number - factor * baseline``; NaN without an interval.

    Parameters
    ----------
    now, before : block sums of the number, and of the baseline
    metric, factor : name of the number, and factor of the baseline
    paired : both have the same blocks of path, whose errors are then compared in pairs

    Notes
    -----
    The interval follows from Student's distribution. If `paired`, its variance comes from the differences of the
    blocks' influences. Otherwise both variances add up, with the degrees of freedom of Welch (1947).
    """
    if now is None or before is None or metric not in {"expected", *SHARES}:
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
    errors_m: Floats, blocks: Blocks | None, ranked: RankedTrials, p50_m: float, p95_m: float
) -> BlockSums | None:
    """Return the sums of the trials of one horizon over blocks of path.

    Parameters
    ----------
    errors_m : (n,) errors of all starts [m]; NaN for a start without a trial
    blocks : result of `cut_blocks`
    ranked : the trials in `errors_m`
    p50_m, p95_m : percentiles of all trials

    Returns
    -------
    BlockSums or None
        None without blocks.
    """
    if blocks is None or not len(blocks.first):
        return None
    errors, first = errors_m[blocks.rows], blocks.first
    trials = np.diff(first, append=len(errors))
    sums = np.add.reduceat(errors, first)
    blocks_m = np.split(errors, first[1:])
    above = [np.array([np.count_nonzero(block_m > limit) for block_m in blocks_m]) for limit in (p50_m, p95_m)]
    growth = []
    for share, count in zip(SHARES.values(), above, strict=True):
        # The growth of a percentile with its share is taken over the uncertainty of the share (Woodruff 1952).
        std = math.sqrt(variance_of_sum(np.asarray((count - (1.0 - share) * trials) / len(errors))))
        low, high = max(share - std, 0.0), min(share + std, 1.0)
        growth.append((ranked.quantile(high) - ranked.quantile(low)) / (high - low) if high > low else 0.0)
    return BlockSums(trials, sums, above[0], above[1], *growth)


PERCENTILE_CELLS = 1024
"""Number of cells into which errors are sorted to find a percentile. A cell holds few errors."""


def count_cells(errors_m: Floats, width_m: float) -> tuple[NDArray[np.int16], Ints]:
    """Return the cell of each error (m,) [m], for cells of this width from zero, and the number in each cell."""
    cell = np.empty(len(errors_m), np.int16)
    counts = np.zeros(int(errors_m.max() / width_m) + 1 if len(errors_m) else 0, np.int64)
    for lo in range(0, len(errors_m), ROWS_AT_ONCE):
        chunk = slice(lo, lo + ROWS_AT_ONCE)
        cell[chunk] = errors_m[chunk] / width_m
        counts += np.bincount(cell[chunk], minlength=len(counts))
    return cell, counts


class RankedTrials(NamedTuple):
    """The trials of one horizon, in cells of equal width, in which any rank is found without sorting.

    Attributes
    ----------
    errors_m : (m,) errors in the order of their starts [m]
    cell : int16 (m,) cell of each error
    before : (cells + 1,) number of trials in all cells before each cell
    """

    errors_m: Floats
    cell: NDArray[np.int16]
    before: Ints

    @classmethod
    def from_errors(cls, errors_m: Floats) -> RankedTrials:
        """Return the ranked trials of errors (n,) [m], which are NaN for a start without a trial."""
        trials = errors_m[~np.isnan(errors_m)]
        cell, counts = count_cells(trials, trials.max(initial=0.0) / PERCENTILE_CELLS or 1.0)
        return cls(trials, cell, np.append(0, np.cumsum(counts)))

    def quantile(self, share: float) -> float:
        """Return the quantile of at least one error [m], with the method 'linear' of ``numpy.quantile``."""
        last = len(self.errors_m) - 1
        rank = share * last
        ranks = np.array([math.floor(rank), min(math.floor(rank) + 1, last)])
        # Python numbers are used, because a comparison with numpy's numbers would widen the type of the cells.
        begin, end = (np.searchsorted(self.before, ranks, side="right") - 1).tolist()
        near = self.errors_m[(self.cell >= begin) & (self.cell <= end)]
        ranks -= self.before[begin]
        low, high = np.partition(near, ranks)[ranks].tolist()
        return float(low + (high - low) * (rank % 1.0))

    def summary(self) -> tuple[int, float, float, float, float]:
        """Return the number of trials, and mean, p50, p95 and largest error [m]; NaN without trials."""
        if not len(self.errors_m):
            return 0, math.nan, math.nan, math.nan, math.nan
        p50, p95 = map(self.quantile, SHARES.values())
        return len(self.errors_m), float(self.errors_m.mean()), p50, p95, float(self.errors_m.max())

    def histogram(self, bin_width_m: float) -> Histogram:
        """Return the histogram of the trials from zero to the largest error (Pentzer 2014, Figs. 28-30)."""
        _, counts = count_cells(self.errors_m, bin_width_m)
        edges = bin_width_m * np.arange(len(counts) + 1, dtype=np.float64)
        return Histogram(edges[:-1], edges[1:], 100.0 * counts / max(len(self.errors_m), 1))


BLOCK_PARTS = 4
"""Number of parts of a horizon. Blocks begin at every quarter of a horizon."""
HISTOGRAM_BINS = 50
"""Largest number of bins of a histogram from zero to the largest error."""


def error_summary(errors_m: Floats) -> Summary:
    """Return the summary of the trials of every horizon; `errors_m` is (n_starts, n_horizons).

    Notes
    -----
    Pentzer 2014, Section 6.4. The paper computes the expected error from a histogram, which gives the mean if bins are
    narrow. Percentiles interpolate linearly between order statistics, as ``numpy.percentile`` does.
    """
    columns = [RankedTrials.from_errors(column).summary() for column in errors_m.T]
    trials, *numbers = np.array(columns).reshape(-1, len(Summary._fields)).T
    return Summary(trials.astype(np.int64), *numbers)


def cut_blocks(tried: Bools, path_m: Floats, horizon_m: float) -> Blocks | None:
    """Return the path of one horizon's trials in blocks of equal length, at least `HORIZONS_A_BLOCK` horizons.

    Parameters
    ----------
    tried : (n,) whether there is a trial from each start
    path_m : (n,) path length at each start [m], non-decreasing
    horizon_m : the horizon [m]

    Returns
    -------
    Blocks or None
        Path without trials is left out; None without trials.
    """
    if not (count := int(np.count_nonzero(tried))):
        return None
    begin, end = int(np.argmax(tried)), len(tried) - int(np.argmax(tried[::-1]))
    # Usually the trials form one stretch, whose slice copies nothing.
    rows = slice(begin, end) if end - begin == count else tried
    path = path_m[rows]
    first = rows_of_cells(path, lambda part: np.floor((part - path[0]) * (BLOCK_PARTS / horizon_m)))
    # The last trials end a horizon after they start.
    horizons = len(first) / BLOCK_PARTS + 1.0
    if len(first) < FEWEST_PATH_BLOCKS * HORIZONS_A_BLOCK * BLOCK_PARTS:
        return Blocks(rows, first[:0], horizons)
    count = min(MOST_PATH_BLOCKS, len(first) // (BLOCK_PARTS * HORIZONS_A_BLOCK))
    return Blocks(rows, first[-(-np.arange(count) * len(first) // count)], horizons)


def round_bin_width(largest_m: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten [m] with which `HISTOGRAM_BINS` bins reach `largest_m`."""
    if not largest_m > 0.0:
        return 0.01
    least = largest_m / HISTOGRAM_BINS
    power = 10.0 ** math.floor(math.log10(least))
    return next((factor * power for factor in (1.0, 2.0, 5.0) if factor * power >= least), 10.0 * power)


def within_budget(horizons_m: Floats, p95_m: Floats, budget_m: float) -> tuple[float, bool, tuple[float, float]] | None:
    """Return the distance up to which errors (h,) [m] at horizons (h,) [m] stay within a budget; the error at 0 m is 0.

    Returns
    -------
    distance_m : the interpolated distance
    beyond : whether the error is within the budget at the last horizon, too
    between_m : the two horizons between which the distance was interpolated

    The result is None without errors.

    Notes
    -----
    With few trials the errors may decrease with the distance. They are replaced by the nearest values that never
    decrease (isotonic regression, Barlow et al. 1972: the largest over beginnings of the smallest mean over ends).
    """
    is_known = np.isfinite(p95_m)
    if not is_known.any():
        return None
    distance = np.concatenate([[0.0], horizons_m[is_known]])
    p95 = np.concatenate([[0.0], never_falling(p95_m[is_known])])
    over = np.flatnonzero(p95 > budget_m)
    if not len(over):
        return float(distance[-1]), True, (float(distance[-1]), float(distance[-1]))
    i = int(over[0])
    share = (budget_m - p95[i - 1]) / (p95[i] - p95[i - 1])
    low, high = float(distance[i - 1]), float(distance[i])
    return low + float(share) * (high - low), False, (low, high)


def never_falling(values: Floats) -> Floats:
    """Return the values (n,) that never decrease and are nearest to the given values (n,) by least squares."""
    sums, n = np.concatenate([[0.0], np.cumsum(values)]), len(values)
    first, last = np.arange(n)[:, None], np.arange(n)
    length = last - first + 1
    means = np.where(length > 0, (sums[1:] - sums[:-1, None]) / np.maximum(length, 1), np.inf)
    # For each first and last value: the smallest mean of a stretch from the first value to the last or beyond.
    least = np.minimum.accumulate(means[:, ::-1], axis=1)[:, ::-1]
    least[length <= 0] = -np.inf
    highest: Floats = least.max(axis=0)
    return highest
