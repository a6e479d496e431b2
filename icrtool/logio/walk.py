"""The compiled loop that runs a layout's program over raw messages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from icrtool.core.compiled import njit
from icrtool.logio.channel import Bytes
from icrtool.logio.layout import (
    BEGIN_LOOP,
    END_LOOP,
    SKIP,
    SKIP_SEQUENCE,
    SKIP_STRING,
    TAKE,
    TAKE_SEQUENCE,
    TAKE_STRING,
    Layout,
)
from icrtool.tables import Bools, Ints

_MAX_NESTING = 8
_CDR_LITTLE, _CDR_BIG = 1, 0
_FNV_OFFSET, _FNV_PRIME = np.uint64(0xCBF29CE484222325), np.uint64(0x100000001B3)


@njit
def read_word(data: Bytes, at: int, size: int, big: bool) -> np.uint64:
    """Return `size` bytes as an unsigned number."""
    value = np.uint64(0)
    if big:
        for i in range(size):
            value = (value << np.uint64(8)) | np.uint64(data[at + i])
    elif size == 8:
        for i in range(8):
            value |= np.uint64(data[at + i]) << np.uint64(8 * i)
    elif size == 4:
        for i in range(4):
            value |= np.uint64(data[at + i]) << np.uint64(8 * i)
    else:
        for i in range(size):
            value |= np.uint64(data[at + i]) << np.uint64(8 * i)
    return value


@njit
def hash_text(data: Bytes, at: int, length: int) -> np.uint64:
    """Return a 64-bit hash of `length` bytes, eight at a time (FNV-1a over words, folded so that no bit is lost)."""
    code = _FNV_OFFSET ^ np.uint64(length)
    place, words_end = at, at + (length & ~7)
    while place < words_end:
        code = (code ^ read_word(data, place, 8, False)) * _FNV_PRIME
        code ^= code >> np.uint64(29)
        place += 8
    if place < at + length:
        code = (code ^ read_word(data, place, at + length - place, False)) * _FNV_PRIME
        code ^= code >> np.uint64(29)
    return code


@njit
def walk(  # noqa: C901, PLR0912, PLR0915 - one interpreter loop, compiled as a whole
    data: Bytes, start: Ints, end: Ints, program: Ints, cdr: bool, table: NDArray[np.uint64], readable: Bools
) -> None:
    """Fill a row of `table` (n, columns) per message; `readable` (n,) says which messages had the program's shape.

    Nothing is read outside [start, end); a message that is shorter than its layout, or of an encapsulation that is
    not plain CDR, is not readable.
    """
    returns, left, column_base, iteration = (
        np.zeros(_MAX_NESTING, np.int64), np.zeros(_MAX_NESTING, np.int64),
        np.zeros(_MAX_NESTING, np.int64), np.zeros(_MAX_NESTING, np.int64),
    )  # fmt: skip
    for m in range(len(start)):
        at, stop, base, big = start[m], end[m], start[m], False
        readable[m] = True
        if cdr:
            if stop - at < 4 or data[at] != 0 or data[at + 1] > _CDR_LITTLE:
                readable[m] = False
                continue
            big = data[at + 1] == _CDR_BIG
            at += 4
            base = at
        depth, shift, taking, step = 0, 0, True, 0
        while step < len(program):
            operation, size, count, column = program[step, 0], program[step, 1], program[step, 2], program[step, 3]
            capacity = program[step, 4]
            if operation in (SKIP, TAKE):
                if cdr:
                    at += (base - at) & (size - 1)
                if at + size * count > stop:
                    readable[m] = False
                    break
                if operation == TAKE and taking:
                    for i in range(count):
                        table[m, column + shift + i] = read_word(data, at + i * size, size, big)
                at += size * count
                step += 1
                continue
            if operation == END_LOOP:
                left[depth - 1] -= 1
                if left[depth - 1] > 0:
                    loop = returns[depth - 1]
                    iteration[depth - 1] += 1
                    if program[loop, 4] > 0:
                        shift = column_base[depth - 1] + iteration[depth - 1] * program[loop, 5]
                        taking = iteration[depth - 1] < program[loop, 4]
                    step = loop + 1
                    continue
                depth -= 1
                shift = column_base[depth]
                taking = depth == 0 or iteration[depth - 1] < max(program[returns[depth - 1], 4], 1)
                step += 1
                continue
            if operation in (SKIP_STRING, TAKE_STRING, SKIP_SEQUENCE, TAKE_SEQUENCE) or (
                operation == BEGIN_LOOP and count < 0
            ):
                if cdr:
                    at += (base - at) & 3
                if at + 4 > stop:
                    readable[m] = False
                    break
                count = np.int64(read_word(data, at, 4, big))
                at += 4
                if count > stop - at:
                    readable[m] = False
                    break
                if operation in (TAKE_SEQUENCE, BEGIN_LOOP) and column >= 0 and taking:
                    table[m, column + shift] = np.uint64(count)
            if operation == BEGIN_LOOP:
                if count == 0:
                    step = program[step, 6]
                    continue
                # An element takes a byte at least: elements of no fields would loop for free.
                if depth >= _MAX_NESTING or count > stop - at:
                    readable[m] = False
                    break
                returns[depth], left[depth], column_base[depth], iteration[depth] = step, count, shift, 0
                depth += 1
                step += 1
                continue
            if operation in (SKIP_STRING, TAKE_STRING):
                if operation == TAKE_STRING and taking:
                    length = count - 1 if cdr and count > 0 else count
                    code = hash_text(data, at, length)
                    table[m, column + shift] = np.uint64(at)
                    table[m, column + shift + 1] = np.uint64(length)
                    table[m, column + shift + 2] = code
                at += count
                step += 1
                continue
            if count > 0 and cdr:
                at += (base - at) & (size - 1)
            if at + size * count > stop:
                readable[m] = False
                break
            if operation == TAKE_SEQUENCE and taking:
                for i in range(min(count, capacity)):
                    table[m, column + shift + 1 + i] = read_word(data, at + i * size, size, big)
            at += size * count
            step += 1


def walk_messages(layout: Layout, data: Bytes, start: Ints, end: Ints) -> tuple[NDArray[np.uint64], Bools]:
    """Return the table (n, columns) of a layout's fields for messages in `data`, and which of them were readable."""
    table = np.zeros((len(start), layout.columns), np.uint64)
    readable = np.empty(len(start), np.bool_)
    if layout.program[:, 2].max(initial=0) > len(data):
        # A fixed array that is longer than all messages together: a definition that is not theirs. Its length times
        # the size of an element may be more than an integer holds.
        readable[:] = False
    else:
        walk(data, start, end, layout.program, layout.cdr, table, readable)
    return table, readable
