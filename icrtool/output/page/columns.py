"""Columns of numbers as text in a page: base64 of little-endian values, which a browser turns into typed arrays."""

from __future__ import annotations

from base64 import b64encode
from typing import Any, Literal

import numpy as np

from icrtool.kernels.arrays import Bools, Bytes, Floats, Ints

_TYPES = {"f32": "<f4", "f64": "<f8", "i32": "<i4", "u8": "u1"}

LARGEST_STEP = 32_000
"""Units of the largest step: what 16 bits hold, with a margin for rounding."""

SMALLEST_UNIT = 1e-7
"""Metres or radians: finer steps mean nothing."""


def packed(column: Floats | Ints | Bytes | Bools, kind: Literal["f32", "f64", "i32", "u8"]) -> dict[str, Any]:
    """Return a column (n,) for a page.

    Notes
    -----
    ``f32`` has seven digits: enough for metres within some kilometres of the origin, and for seconds of a day (8 ms).
    """
    return {"type": kind, "data": b64encode(np.asarray(column).astype(_TYPES[kind]).tobytes()).decode("ascii")}


def packed_sums(column: Floats) -> dict[str, Any]:
    """Return a running sum (n,) for a page, as steps of 16 bits each; the page gets it from zero on.

    Notes
    -----
    The sum is rounded and not the steps, so that its error stays within half a unit everywhere: about 2 micrometres
    where a step is 0.1 m at most.
    """
    sums = column - column[0]
    unit = max(float(np.abs(np.diff(sums)).max(initial=0.0)) / LARGEST_STEP, SMALLEST_UNIT)
    steps = np.diff(np.rint(sums / unit)).astype("<i2")
    return {"type": "sums", "unit": unit, "data": b64encode(steps.tobytes()).decode("ascii")}
