"""Types of arrays, the integral of one, and rows at equal steps of a quantity that never decreases."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Complexes = NDArray[np.complex128]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]


def trapezoids(t: Floats, rate: Floats) -> Floats:
    """Return the integral of a rate (n,) from the first of its times (n,) until each, by trapezoids."""
    return np.concatenate([[0.0], np.cumsum(np.diff(t) * (rate[:-1] + rate[1:]) / 2)])


ROWS_AT_ONCE = 1 << 16
"""Bounds memory."""


def rows_at_steps(progress: Floats, step: float) -> Ints:
    """Return the first row at or after each of 0, `step`, 2 `step` … below the last value, each row once.

    Parameters
    ----------
    progress : (n,) never decreasing, from 0 or more
    step : positive, in the unit of `progress`

    Notes
    -----
    Time and memory grow with n, not with the values: a damaged speed over a long interval makes a distance of 1e12 m.
    """
    rows = rows_of_cells(progress, lambda part: np.floor(part / step))
    before = np.where(rows > 0, np.floor(progress[rows - 1] / step), -1.0)
    return rows[(before + 1.0) * step < progress[-1:]]


def rows_of_cells(progress: Floats, cells_of: Callable[[Floats], Floats]) -> Ints:
    """Return the first row of each cell (from 0 on) of what never decreases; `cells_of` is called for parts of it."""
    found, last = [np.empty(0, np.int64)], -1.0
    for lo in range(0, len(progress), ROWS_AT_ONCE):
        cell = cells_of(progress[lo : lo + ROWS_AT_ONCE])
        found.append(lo + np.flatnonzero(cell > np.append(last, cell[:-1])))
        last = cell[-1]
    return np.concatenate(found)
