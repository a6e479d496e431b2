"""Types of arrays, and functions of arrays: integrals, rows at steps, runs and spans, angles, quaternions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Rows = NDArray[np.int32]
Complexes = NDArray[np.complex128]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
"""Types of arrays."""


def trapezoids(t: Floats, rate: Floats) -> Floats:
    """Return the integral of a rate (n,) from the first time until each time (n,), by trapezoids."""
    sums = np.zeros(len(t))
    steps = sums[1:]
    np.add(rate[:-1], rate[1:], out=steps)
    steps *= np.diff(t)
    steps /= 2
    np.cumsum(steps, out=steps)
    return sums


def wrapped(angle: Floats) -> Floats:
    """Return angles [rad] plus whole turns, so that each is within half a turn of 0."""
    return np.asarray(angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi)))


def unwrapped(angle: Floats) -> Floats:
    """Return angles (n,) [rad] plus whole turns, so that each is within half a turn of the angle before."""
    turns = np.rint(np.diff(angle, prepend=angle[:1]) / (2.0 * np.pi))
    return np.asarray(angle - 2.0 * np.pi * np.cumsum(turns))


ROWS_AT_ONCE = 1 << 16
"""Number of rows that are processed at a time, to bound the memory."""


def rows_at_steps(progress: Floats, step: float) -> Ints:
    """Return the first row at or after each of the values 0, `step`, 2 `step` … below the last value, each row once.

    Parameters
    ----------
    progress : (n,) never decreasing, from 0 or more
    step : positive, in the unit of `progress`

    Notes
    -----
    Time and memory grow with n, and not with the values, because a damaged speed over a long interval gives a distance
    of 1e12 m.
    """
    rows = rows_of_cells(progress, lambda part: np.floor(part / step))
    before = np.where(rows > 0, np.floor(progress[rows - 1] / step), -1.0)
    return rows[(before + 1.0) * step < progress[-1:]]


def rows_of_cells(progress: Floats, cells_of: Callable[[Floats], Floats]) -> Ints:
    """Return the first row of each cell of values (n,) that never decrease.

    `cells_of` returns the number of the cell, from 0, of each value of a part.
    """
    parts, last = [np.empty(0, np.int64)], -1.0
    for lo in range(0, len(progress), ROWS_AT_ONCE):
        cell = cells_of(progress[lo : lo + ROWS_AT_ONCE])
        parts.append(lo + np.flatnonzero(cell > np.append(last, cell[:-1])))
        last = cell[-1]
    return np.concatenate(parts)


def runs_of(marked: Bools) -> tuple[Ints, Ints]:
    """Return the first row of each run of marked rows (n,), and the first row after the run."""
    edges = np.flatnonzero(np.diff(marked, prepend=False, append=False))
    return edges[::2], edges[1::2]


def in_spans(at: Floats | Ints, begins: Floats | Ints, ends: Floats | Ints) -> Bools:
    """Return which of ascending times (m,) lie in a span, with its end; the begins and the ends ascend, too."""
    begun = np.bincount(np.searchsorted(at, begins), minlength=len(at) + 1)
    begun -= np.bincount(np.searchsorted(at, ends, side="right"), minlength=len(at) + 1)
    return np.asarray(np.cumsum(begun)[:-1] > 0)


def quaternion_product(a: Floats, b: Floats) -> Floats:
    """Return the products (n, 4) of quaternions (n, 4) x, y, z, w: the turn b, and then the turn a."""
    vector = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
    return np.column_stack([vector, a[:, 3] * b[:, 3] - np.sum(a[:, :3] * b[:, :3], axis=1)])


def turned_axis(axis: int, x: Floats, y: Floats, z: Floats, w: Floats) -> tuple[Floats, Floats, Floats]:
    """Return x, y, z (n,) in the fixed frame of an axis (0, 1, 2) of frames that unit quaternions turn."""
    if axis == 0:
        return 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
    if axis == 1:
        return 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)
    return 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
