"""Types of arrays, and the integral of one."""

from __future__ import annotations

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
