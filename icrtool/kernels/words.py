"""Numbers in the bytes of a log; a caller has checked that they are inside."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Bytes
from icrtool.kernels.compiled import njit


@njit
def four_bytes(data: Bytes, at: np.uint64) -> np.uint64:
    """Return four bytes as a little-endian unsigned number.

    Notes
    -----
    The compiler makes one load of it: unsigned indices do not count from the end, and there is no loop.
    """
    return (
        np.uint64(data[at])
        | np.uint64(data[at + np.uint64(1)]) << np.uint64(8)
        | np.uint64(data[at + np.uint64(2)]) << np.uint64(16)
        | np.uint64(data[at + np.uint64(3)]) << np.uint64(24)
    )


@njit
def eight_bytes(data: Bytes, at: np.uint64) -> np.uint64:
    """Return eight bytes as a little-endian unsigned number."""
    return four_bytes(data, at) | four_bytes(data, at + np.uint64(4)) << np.uint64(32)


@njit
def read_word(data: Bytes, at: int, size: int, big: int) -> np.uint64:
    """Return `size` bytes as an unsigned number; `big` is 1 where the first of them is the most significant."""
    place, value = np.uint64(at), np.uint64(0)
    if size == 8 and not big:
        return eight_bytes(data, place)
    if size == 4 and not big:
        return four_bytes(data, place)
    for i in range(size):
        byte = np.uint64(data[place + np.uint64(i)])
        value = value << np.uint64(8) | byte if big else value | byte << np.uint64(8 * i)
    return value
