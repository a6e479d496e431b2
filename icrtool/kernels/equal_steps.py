"""Rows at equal steps of a quantity that never decreases: distance, turned angle, time."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Floats, Ints


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
    cell = np.floor(progress / step)
    before = np.concatenate([[-1.0], cell[:-1]])[: len(cell)]
    return np.flatnonzero((cell > before) & ((before + 1.0) * step < progress[-1:]))
