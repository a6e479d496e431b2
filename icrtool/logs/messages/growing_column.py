"""A column of a topic that grows while blocks of messages go by."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_MOST_EXPECTED = 1 << 22
"""Numbers of a column that memory is set aside for on the log's word alone."""

LARGEST = 1e30
"""No quantity of a robot is larger, in any unit: what is counts as infinite, so that no power of numbers overflows."""


class GrowingColumn:
    """A column that grows in place, so that all rows are never copied; a single row while all rows are the same.

    Parameters
    ----------
    lacking : what integers are where a row has fewer elements than others; floats are NaN there
    """

    def __init__(self, lacking: int) -> None:
        self._lacking = lacking
        self._rows = 0
        self._values: NDArray[Any] = np.empty(0, np.int64)

    def add(self, part: NDArray[Any], expected: int) -> None:
        """Add a copy of rows (m,) or (m, k), of which `expected` will come in all, as the log states."""
        before, held = self._rows, self._values
        self._rows += len(part)
        one = _single_row(part) if len(held) <= 1 else None
        if before == 0 and one is not None:
            self._values = one
        elif one is None or len(held) > 1 or one.shape != held.shape or one.tobytes() != held.tobytes():
            width = max(part.shape[1:], held.shape[1:])
            if before == 0 or len(held) < self._rows or width > held.shape[1:]:
                likely = min(expected, _MOST_EXPECTED // max(*width, 1, 1))
                self._values = np.empty((*width, max(2 * before, self._rows, likely)), part.dtype).T
                if before:
                    self._put(0, held[:before] if len(held) > 1 else np.broadcast_to(held, (before, *held.shape[1:])))
            self._put(before, part)

    def _put(self, begin: int, part: NDArray[Any]) -> None:
        rows = self._values[begin : begin + len(part)]
        if part.ndim == 2 and part.shape[1] < rows.shape[1]:
            rows[:, part.shape[1] :] = np.nan if rows.dtype.kind == "f" else self._lacking
            rows = rows[:, : part.shape[1]]
        _copy(part, rows)

    def taken(self) -> NDArray[Any]:
        """Return the rows (n,) or (n, k); they cannot be written to where all are the same."""
        values = self._values
        return values[: self._rows] if len(values) > 1 else np.broadcast_to(values, (self._rows, *values.shape[1:]))


def _single_row(rows: NDArray[Any]) -> NDArray[Any] | None:
    """Return the row (1,) or (1, k) that all rows equal bit by bit; None where they differ, or there is none."""
    bits = rows.view(np.int64)
    if len(rows) == 0 or (rows.strides[0] and ((bits[-1] != bits[0]).any() or (bits != bits[0]).any())):
        return None
    row = np.empty_like(rows[:1])
    _copy(rows[:1], row)
    return row


def _copy(source: NDArray[Any], target: NDArray[Any]) -> None:
    """Copy numbers, which any arithmetic may then use: a signalling NaN becomes a NaN, what is too large infinite."""
    if target.dtype.kind != "f":
        target[...] = source
        return
    with np.errstate(invalid="ignore"):
        np.multiply(source, 1.0, out=target)
    if target.size and not (target.min() >= -LARGEST and target.max() <= LARGEST):  # NaN compares false
        np.copyto(target, np.copysign(np.inf, target), where=np.abs(target) > LARGEST)
