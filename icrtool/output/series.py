"""Long columns for pictures and pages: fewer points, breaks of lines, ends of scales; and colours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from icrtool.kernels.arrays import ROWS_AT_ONCE, Floats, Ints

BLUE, ORANGE, GREEN, RED, PURPLE = "#2166ac", "#e08214", "#1b7837", "#b2182b", "#762a83"
"""Colours of pictures and exports. `page.css` has them too, with further colours for a dark screen."""

LINE_POINTS = 2400
"""Approximate number of points of a drawn line: about three for each pixel column of a figure."""

SAMPLED_ROWS = 40_000
"""Approximate number of rows from which the range of a column is found for drawing."""

TYPICAL_PERCENT, HEADROOM = 99.5, 1.6
"""Percentile of differences, and ratio of the end of their scale to it. Outliers have no effect on the scale."""

LEAST_END_M = 0.001
"""Smallest end of a scale of differences [m]."""

RANGE_PERCENT = (0.2, 99.8)
"""Percentiles of a column that limit its shown range, so that a single spike has no effect on the scale."""
SCALE_MARGIN, LEAST_HALF_RANGE_M = 1.12, 0.02
"""Ratio of a scale to the range that it shows, and half of its smallest range [m]."""

BREAK_SHARE, BREAK_IN_INTERVALS = 0.01, 5.0
"""Shortest gap over which no line is drawn: the share of the whole time, and the number of usual intervals."""


def evenly_spaced_rows(rows: int, most: float) -> tuple[Ints, int]:
    """Return about `most` of `rows` rows at an equal step and the last row, and the step."""
    every = max(math.ceil(rows / most), 1)
    return np.unique(np.append(np.arange(0, rows, every), rows - 1)), every


def round_steps(length: float) -> Floats:
    """Return the round lengths (4,) about a length: 1, 2, 5 and 10 times the power of ten below it."""
    return np.multiply([1.0, 2.0, 5.0, 10.0], 10.0 ** math.floor(math.log10(length)))


def extremes(*columns: Floats, points: int = LINE_POINTS) -> Ints:
    """Return rows such that a line through them shows every extreme of every column.

    Parameters
    ----------
    columns : float64 (n,) each; NaN breaks the line
    points : approximate number of rows to choose

    Returns
    -------
    int64 (m,), increasing: first and last row; the rows of the smallest and the largest value of each column in equal
    groups of rows; the first row of every break. All rows if there are no more than `points`.
    """
    rows = len(columns[0])
    if rows <= points:
        return np.arange(rows)
    bins = max(points // (2 * len(columns)), 1)
    width = -(-rows // bins)
    begin = np.arange(0, rows, width)
    chosen, padded = [np.array([0, rows - 1])], np.full(len(begin) * width, np.inf)
    for column in columns:
        missing = np.isnan(column)
        chosen.append(np.flatnonzero(missing & ~np.concatenate([[False], missing[:-1]])))
        for sign in (1.0, -1.0):
            np.multiply(column, sign, out=padded[:rows])
            padded[:rows][missing] = np.inf
            chosen.append(begin + padded.reshape(-1, width).argmin(axis=1))
    chosen_rows = np.unique(np.concatenate(chosen))
    return chosen_rows[chosen_rows < rows]


def percentiles(column: Floats, shares: tuple[float, ...]) -> list[float]:
    """Return approximate percentiles of a column (n,), from rows at an equal step where it is long."""
    return [float(value) for value in np.percentile(column[:: 1 + len(column) // SAMPLED_ROWS], shares)]


def rows_entering_cells(north: Floats, east: Floats, cell_m: float) -> Ints:
    """Return the rows at which a path enters another cell of a square grid.

    Parameters
    ----------
    north, east : float64 (n,) [m]
    cell_m : side of a cell [m], about a pixel

    Returns
    -------
    int64 (m,), increasing, with first and last row.
    """
    if len(north) == 0:
        return np.empty(0, np.int64)
    parts = [np.array([0, len(north) - 1])]
    for lo in range(0, len(north), ROWS_AT_ONCE):
        chunk = slice(lo, lo + ROWS_AT_ONCE + 1)
        moved = (np.diff(np.floor(north[chunk] / cell_m)) != 0) | (np.diff(np.floor(east[chunk] / cell_m)) != 0)
        parts.append(lo + 1 + np.flatnonzero(moved))
    return np.unique(np.concatenate(parts))


def scale_of(shown: Sequence[float]) -> tuple[float, float]:
    """Return the ends of a scale [m] on which numbers [m] lie with a margin."""
    middle, half = (min(shown) + max(shown)) / 2, max((max(shown) - min(shown)) / 2, LEAST_HALF_RANGE_M)
    return middle - SCALE_MARGIN * half, middle + SCALE_MARGIN * half


def scale_end_m(differences: Floats) -> float:
    """Return the upper end of a scale [m] of differences (n,) [m]."""
    if not len(differences):
        return 1.0
    typical = HEADROOM * percentiles(differences, (TYPICAL_PERCENT,))[0]
    return max(min(typical, 1.1 * float(differences.max())), LEAST_END_M)


def breaks_after(t: Floats) -> Ints:
    """Return the rows (k,) of times (n,) after which a line breaks, because a long gap follows."""
    interval = np.diff(t)
    if not len(interval):
        return np.empty(0, np.int64)
    longest = max(BREAK_SHARE * float(t[-1] - t[0]), BREAK_IN_INTERVALS * float(np.median(interval)))
    return np.flatnonzero(interval > longest)
