"""Chords of a path: how far a robot went, without the noise of its positions."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.compiled import njit


def chord_rows(north: Floats, east: Floats, step_m: float) -> Ints:
    """Return the first row (c,) and each that is the first at least a step away from the one before it.

    Parameters
    ----------
    north, east : (n,) [m], at least one
    """
    rows = np.zeros(len(north), np.int64)
    return rows[: _fill(north, east, step_m, rows)]


@njit
def _fill(north: Floats, east: Floats, step_m: float, rows: Ints) -> int:
    count = 1
    for k in range(1, len(north)):
        a, b = north[k] - north[rows[count - 1]], east[k] - east[rows[count - 1]]
        if a * a + b * b >= step_m * step_m:
            rows[count] = k
            count += 1
    return count
