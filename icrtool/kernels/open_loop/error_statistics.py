"""Statistics of open-loop errors: percentiles and mean per horizon, their confidence intervals, and histograms.

Errors are float64 (n_starts, n_horizons) [m] with NaN where there was no trial, as
`icrtool.kernels.open_loop.prefix_sums` makes them. Trials from neighbouring starts share most of their path and are not
independent: intervals come from resampling stretches of path, not trials.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce

import numpy as np

from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.kernels.compiled import njit
from icrtool.kernels.equal_steps import rows_of_cells
from icrtool.kernels.open_loop.block_sums import BLOCK_PARTS, LEVEL, Blocks, quantile
from icrtool.kernels.open_loop.trials import Histogram, Intervals, Summary

TAIL = 0.05
"""Share of trials above the 95th percentile."""
MIN_BLOCKS = 3
"""With fewer blocks of path in all there is no confidence interval (NaN): resampling them is meaningless."""
TRIALS_PER_BLOCK = 8
"""Trials kept of a block when p95 is resampled: an error changes little while a start moves by this part of it."""
RESAMPLES, RESAMPLES_AT_ONCE = 300, 10
"""For an interval; those drawn at once are few, since a long log has thousands of blocks."""
BINS = 50
"""Of a histogram, up to its largest error or less."""
MIN_KEPT_TRIALS = 20_000
"""Trials kept when p95 is resampled, at least; all of them where there are fewer than twice as many."""


def error_summary(errors_m: Floats) -> Summary:
    """Summarise the trials of every horizon; `errors_m` is (n_starts, n_horizons).

    Notes
    -----
    Section 6.4. The paper's expected error weighs a histogram, which is the mean once bins are narrow. Percentiles
    interpolate linearly between order statistics, as ``numpy.percentile`` does.
    """
    # One at a time: a column of a long log is large.
    columns = [summary_of_sorted([sort_trials(column)]) for column in errors_m.T]
    return Summary(*(np.concatenate(numbers) for numbers in zip(*columns, strict=True)))


def sort_trials(errors_m: Floats) -> Floats:
    """Return the errors of one horizon's trials in ascending order, without the NaN of those that were none."""
    ordered = np.sort(errors_m)  # NaN last
    return ordered[: np.searchsorted(ordered, np.inf, side="right")]


def summary_of_sorted(ordered: Sequence[Floats]) -> Summary:
    """Summarise trials as `error_summary` does; `ordered` has the result of `sort_trials` for each horizon."""
    table = np.full((4, len(ordered)), np.nan)
    for h, errors in enumerate(ordered):
        if len(errors):
            table[:, h] = errors.mean(), quantile(errors, 0.5), quantile(errors, 1.0 - TAIL), errors[-1]
    return Summary(np.array([len(errors) for errors in ordered], np.int64), *table)


@njit
def resample_blocks(blocks: Floats, starts: Ints, segments: Ints, ordered: Floats, out: Floats) -> None:
    """Fill `out` (resamples, 2) with the mean and p95 of every resample.

    Parameters
    ----------
    blocks : (n_starts, 3), sum of errors, trials and kept trials of the block beginning at each segment
    starts : int64 (resamples, n_drawn), first segment of every block drawn
    segments, ordered : (n_kept,), segment and error of the kept trials, largest error first

    Notes
    -----
    p95 of a resample is a weighted quantile, the weight of a trial being how often its segment was drawn: the trials
    are sorted once; each resample sums weights from the largest error down, until 5 % of the weight is reached.
    """
    before = BLOCK_PARTS - 1
    drawn = np.zeros(before + len(blocks) + before, dtype=np.int64)
    for b in range(starts.shape[0]):
        for s in range(len(drawn)):
            drawn[s] = 0
        total, count, kept = 0.0, 0.0, 0.0
        for i in range(starts.shape[1]):
            s = starts[b, i]
            drawn[before + s] += 1
            total += blocks[s, 0]
            count += blocks[s, 1]
            kept += blocks[s, 2]
        above, i = 0.0, -1
        while above <= TAIL * kept and i + 1 < len(ordered):
            i += 1
            for part in range(BLOCK_PARTS):
                above += drawn[segments[i] + part]
        out[b, 0] = total / count
        out[b, 1] = ordered[i]


def cut_blocks(tried: Bools, path_m: Floats, block_m: float) -> Blocks | None:
    """Cut the path of one horizon's trials into segments of a quarter block.

    Parameters
    ----------
    tried : (n,) whether there is a trial from a start
    path_m : (n,) [m], path length at each start, non-decreasing
    block_m : path [m] of a block, usually the horizon

    Returns
    -------
    None where there are fewer than `MIN_BLOCKS` blocks.
    """
    if not (count := int(np.count_nonzero(tried))):
        return None
    begin, end = int(np.argmax(tried)), len(tried) - int(np.argmax(tried[::-1]))
    # the usual case is one stretch, and a slice copies nothing
    rows = slice(begin, end) if end - begin == count else tried
    path = path_m[rows]
    first = rows_of_cells(path, lambda part: np.floor((part - path[0]) * (BLOCK_PARTS / block_m)))
    if len(first) < MIN_BLOCKS * BLOCK_PARTS:
        return None
    wanted = max(MIN_KEPT_TRIALS, TRIALS_PER_BLOCK * (len(first) // BLOCK_PARTS))
    kept = np.arange(0, count, max(count // wanted, 1))
    segments = np.searchsorted(first, kept, side="right") - 1
    in_segment = np.diff(first, append=count), np.bincount(segments, minlength=len(first))
    return Blocks(rows, first, kept, segments, np.stack(in_segment, axis=1).astype(np.float64))


def bootstrap_interval(
    errors_m: Floats, blocks: Blocks | None, rng: np.random.Generator, resamples: int = RESAMPLES
) -> tuple[float, float, float, float]:
    """Compute confidence intervals of one horizon's expected error and p95 by the moving-block bootstrap.

    Parameters
    ----------
    errors_m : (n,) [m], NaN where there was no trial
    blocks : of `cut_blocks`
    rng : random numbers; the same state gives the same blocks, so models can be compared on the same resamples

    Returns
    -------
    expected_low, expected_high, p95_low, p95_high [m]; NaN without blocks

    Notes
    -----
    Kuensch (1989), percentile intervals. The path is cut into segments of a quarter block, those without a trial are
    left out, and a resample is made of as many blocks of four consecutive segments as the log has. Approximations:
    blocks begin at segments, not at every state; p95 is resampled from evenly spaced trials, `TRIALS_PER_BLOCK` of a
    block, and without interpolation. Both are small against the interval. Trials a block apart still overlap, so the
    interval is too narrow rather than too wide: on moving sums as long as the block, 95 % intervals of p95 covered the
    truth in 90 % of paths of 400 blocks, 84 % of 50 and 68 % of 10 (the mean: 90, 88, 84 %).
    """
    if blocks is None:
        return (math.nan,) * 4
    errors = errors_m[blocks.rows]
    kept = errors[blocks.kept]
    order = np.argsort(kept)[::-1]
    per_segment = np.column_stack([np.add.reduceat(errors, blocks.first), blocks.per_segment])
    n_starts = len(per_segment) - BLOCK_PARTS + 1
    sums = reduce(np.add, (per_segment[part : part + n_starts] for part in range(BLOCK_PARTS)))
    replicates, segments, ordered = np.empty((resamples, 2)), blocks.segments[order], kept[order]
    for some in np.split(replicates, range(RESAMPLES_AT_ONCE, resamples, RESAMPLES_AT_ONCE)):
        starts = rng.integers(0, n_starts, size=(len(some), len(per_segment) // BLOCK_PARTS))
        resample_blocks(sums, starts, segments, ordered, some)
    low, high = np.quantile(replicates, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL], axis=0)
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def bootstrap_intervals(errors_m: Floats, blocks: Sequence[Blocks | None], seed: int) -> Intervals:
    """Compute `bootstrap_interval` for every horizon.

    Parameters
    ----------
    errors_m : (n_starts, n_horizons) [m]
    blocks : of `cut_blocks`, one a horizon
    seed : every horizon starts from it, so that an interval does not depend on which others are asked for
    """
    rows = [
        bootstrap_interval(column, cut, np.random.default_rng(seed))
        for column, cut in zip(errors_m.T, blocks, strict=True)
    ]
    return Intervals(*np.array(rows, dtype=np.float64).reshape(-1, 4).T)


def round_bin_width(largest_m: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten [m] with which `BINS` bins reach `largest_m`."""
    if not largest_m > 0.0:
        return 0.01
    least = largest_m / BINS
    power = 10.0 ** math.floor(math.log10(least))
    return next((factor * power for factor in (1.0, 2.0, 5.0) if factor * power >= least), 10.0 * power)


def histogram_sorted(ordered: Floats, bin_width_m: float) -> Histogram:
    """Count the trials of one horizon in bins of `bin_width_m` from zero to the largest error (Figs. 28-30).

    Parameters
    ----------
    ordered : of `sort_trials` [m]
    bin_width_m : [m], see `round_bin_width`
    """
    if not len(ordered):
        return Histogram(*np.empty((3, 0)))
    edges = bin_width_m * np.arange(int(ordered[-1] / bin_width_m) + 3, dtype=np.float64)
    edges = edges[: np.searchsorted(edges, ordered[-1], side="right") + 1]
    counts = np.diff(np.searchsorted(ordered, edges))
    return Histogram(edges[:-1], edges[1:], 100.0 * counts / len(ordered))
