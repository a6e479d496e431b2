"""Statistics of open-loop errors: percentiles and mean per horizon, their confidence intervals, and histograms.

Errors are float64 (n_starts, n_horizons) [m] with NaN where there was no trial, as
`icrtool.kernels.open_loop.prefix_sums` makes them. Trials from neighbouring starts share most of their path and are not
independent: intervals come from blocks of path, not from trials (`icrtool.kernels.open_loop.block_sums`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from icrtool.kernels.arrays import Bools, Floats
from icrtool.kernels.equal_steps import rows_of_cells
from icrtool.kernels.open_loop.block_sums import FEWEST_BLOCKS, HORIZONS_A_BLOCK, MOST_BLOCKS, Blocks, quantile
from icrtool.kernels.open_loop.trials import Histogram, Summary

TAIL = 0.05
"""Share of trials above the 95th percentile."""
BLOCK_PARTS = 4
"""Blocks begin at every quarter of a horizon."""
BINS = 50
"""Of a histogram, up to its largest error or less."""


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


def cut_blocks(tried: Bools, path_m: Floats, horizon_m: float) -> Blocks | None:
    """Cut the path of one horizon's trials into blocks of equal length, so many horizons at least.

    Parameters
    ----------
    tried : (n,) whether there is a trial from a start
    path_m : (n,) [m], path length at each start, non-decreasing

    Returns
    -------
    None where there are fewer than `FEWEST_BLOCKS`. Path without trials is left out.
    """
    if not (count := int(np.count_nonzero(tried))):
        return None
    begin, end = int(np.argmax(tried)), len(tried) - int(np.argmax(tried[::-1]))
    # the usual case is one stretch, and a slice copies nothing
    rows = slice(begin, end) if end - begin == count else tried
    path = path_m[rows]
    first = rows_of_cells(path, lambda part: np.floor((part - path[0]) * (BLOCK_PARTS / horizon_m)))
    if len(first) < FEWEST_BLOCKS * HORIZONS_A_BLOCK * BLOCK_PARTS:
        return None
    count = min(MOST_BLOCKS, len(first) // (BLOCK_PARTS * HORIZONS_A_BLOCK))
    return Blocks(rows, first[-(-np.arange(count) * len(first) // count)])


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
