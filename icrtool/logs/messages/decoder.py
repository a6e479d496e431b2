"""CDR decoder: the compiled loop that runs the program of a layout over raw messages."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Bools, Bytes, Ints
from icrtool.kernels.compiled import njit
from icrtool.logs.messages.schema import (
    BEGIN_LOOP,
    END_LOOP,
    SKIP,
    SKIP_STRING,
    TAKE,
    TAKE_SEQUENCE,
    TAKE_STRING,
    Layout,
)

_MAX_NESTING = 8
_MOST_REMEMBERED = 512
"""Ranges and columns remembered of a message's shape; messages with more are all decoded step by step."""

_STEPS_PER_BYTE, _LEAST_STEPS, MOST_STEPS = 4, 256, 1 << 24
"""Steps of the program that one message may take: per byte, and at most. Loops over elements of size zero would never
end. The second limit keeps the time of one message below about 0.1 s."""

_ZERO, _FOUR, _AS_BEFORE = (cast(int, np.int64(value)) for value in (0, 4, -1))
"""Typed: numba compiles another copy of a function for every plain number that it is called with."""

_ITS_PLACE = _ZERO
"""Special values of a size: `_AS_BEFORE` for a value that is the same in all messages of a shape, this one for the
offset of a text."""

_CDR_LITTLE, _CDR_BIG = 1, 0
_FNV_OFFSET, _FNV_PRIME = np.uint64(0xCBF29CE484222325), np.uint64(0x100000001B3)


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


@njit
def hash_text(data: Bytes, at: int, length: int) -> np.uint64:
    """Return a 64-bit hash of `length` bytes, eight at a time (FNV-1a over words, folded so that no bit is lost)."""
    code = _FNV_OFFSET ^ np.uint64(length)
    place, words_end = at, at + (length & ~7)
    while place < words_end:
        code = (code ^ eight_bytes(data, np.uint64(place))) * _FNV_PRIME
        code ^= code >> np.uint64(29)
        place += 8
    if place < at + length:
        code = (code ^ read_word(data, place, at + length - place, _ZERO)) * _FNV_PRIME
        code ^= code >> np.uint64(29)
    return code


@njit
def remember_same(same: Ints, used: int, first: int, stop: int) -> int:
    """Add the bytes [first, stop) to those that make the shape of a message; return how many ranges are used now."""
    if 0 < used <= len(same) and same[used - 1, 1] == first:
        same[used - 1, 1] = stop
        return used
    if used < len(same):
        same[used, 0], same[used, 1] = first, stop
    return used + 1


@njit
def remember_column(taken: Ints, used: int, place: int, size: int, column: int) -> int:
    """Add a column to those that a message of this shape fills; return how many are used now."""
    if used < len(taken):
        taken[used, 0], taken[used, 1], taken[used, 2] = place, size, column
    return used + 1


@njit
def has_shape(data: Bytes, begin: int, model: int, same: Ints, ranges: int) -> bool:
    """Return whether the message at `begin` equals the one at `model` in the ranges of bytes that make its shape."""
    for k in range(ranges):
        place, stop = same[k, 0], same[k, 1]
        while place + 8 <= stop:
            if eight_bytes(data, np.uint64(begin + place)) != eight_bytes(data, np.uint64(model + place)):
                return False
            place += 8
        while place < stop:
            if data[begin + place] != data[model + place]:
                return False
            place += 1
    return True


@njit
def fill_row(
    data: Bytes, begin: int, big: int, taken: Ints, columns: int, model: int, m: int, table: NDArray[np.uint64]
) -> None:
    """Fill row m of `table` from the message at `begin`, whose shape is that of the message of row `model`."""
    for k in range(columns):
        place, size, column = taken[k, 0], taken[k, 1], taken[k, 2]
        if size == _AS_BEFORE:
            table[m, column] = table[model, column]
        elif size == _ITS_PLACE:
            table[m, column] = np.uint64(begin + place)
        else:
            table[m, column] = read_word(data, begin + place, size, big)


@njit
def take_numbers(
    data: Bytes, at: int, size: int, count: int, big: int, table: NDArray[np.uint64], m: int, column: int,
    begin: int, taken: Ints, columns: int,
) -> int:  # fmt: skip
    """Copy `count` numbers to row m, and remember their offsets; return how many columns are used now."""
    for i in range(count):
        table[m, column + i] = read_word(data, at + i * size, size, big)
        columns = remember_column(taken, columns, at + i * size - begin, size, column + i)
    return columns


@njit
def take_text(
    data: Bytes, at: int, length: int, table: NDArray[np.uint64], m: int, column: int, begin: int, taken: Ints,
    columns: int,
) -> int:  # fmt: skip
    """Put offset, length and hash of a text into row m, and remember them; return how many columns are used now."""
    table[m, column], table[m, column + 1] = np.uint64(at), np.uint64(length)
    table[m, column + 2] = hash_text(data, at, length)
    columns = remember_column(taken, columns, at - begin, _ITS_PLACE, column)
    columns = remember_column(taken, columns, _ZERO, _AS_BEFORE, column + 1)
    return remember_column(taken, columns, _ZERO, _AS_BEFORE, column + 2)


@njit
def run_program(  # noqa: C901, PLR0912, PLR0915 - one interpreter loop, compiled as a whole
    data: Bytes, begin: int, base: int, stop: int, program: Ints, cdr: bool, big: int,
    table: NDArray[np.uint64], m: int, same: Ints, ranges: int, taken: Ints, loops: Ints,
) -> tuple[bool, int, int]:  # fmt: skip
    """Run the program over one message.

    Parameters
    ----------
    begin, base, stop : where the message begins, where its fields do, and where it ends in `data`
    table : of `decode_new_shapes`; row m is filled
    same, ranges, taken : filled with the ranges of bytes that make the message's shape, and where its numbers are
    loops : (4, `_MAX_NESTING`) space for the loops around a field: first operation, elements left, column, element

    Returns
    -------
    Whether the message fits the program; how many ranges and columns it uses.
    """
    returns, left, column_base, iteration = loops
    at, depth, shift, taking, step, columns = base, 0, 0, True, 0, _ZERO
    steps_left = min(_STEPS_PER_BYTE * (stop - at) + _LEAST_STEPS + 2 * len(program), MOST_STEPS)
    while step < len(program):
        steps_left -= 1
        if steps_left < 0:
            return False, ranges, columns
        operation, size, count, column = program[step, 0], program[step, 1], program[step, 2], program[step, 3]
        capacity, behind = program[step, 4], program[step, 6]
        step += 1
        if operation == END_LOOP:
            loop = returns[depth - 1]
            left[depth - 1] -= 1
            iteration[depth - 1] += 1
            if left[depth - 1] > 0:
                step = loop + 1
                if program[loop, 4] > 0:
                    shift = column_base[depth - 1] + iteration[depth - 1] * program[loop, 5]
                    taking = iteration[depth - 1] < program[loop, 4]
            else:
                depth -= 1
                shift = column_base[depth]
                taking = depth == 0 or iteration[depth - 1] < max(program[returns[depth - 1], 4], 1)
            continue
        if operation >= SKIP_STRING and (operation != BEGIN_LOOP or count < 0):
            at += (base - at) & 3 if cdr else 0
            if at + 4 > stop:
                return False, ranges, columns
            count = np.int64(read_word(data, at, _FOUR, big))
            ranges = remember_same(same, ranges, at - begin, at - begin + 4)
            at += 4
            if count > stop - at:
                return False, ranges, columns
            if operation in (TAKE_SEQUENCE, BEGIN_LOOP) and column >= 0 and taking:
                table[m, column + shift] = np.uint64(count)
                columns = remember_column(taken, columns, _ZERO, _AS_BEFORE, column + shift)
        if operation == BEGIN_LOOP:
            # Count at least one byte for an element: a loop over elements without fields must end, too.
            if count > 0 and (depth >= _MAX_NESTING or count > stop - at):
                return False, ranges, columns
            if count > 0:
                returns[depth], left[depth], column_base[depth], iteration[depth] = step - 1, count, shift, 0
                depth += 1
            else:
                step = behind
        elif operation in (SKIP_STRING, TAKE_STRING):
            if operation == TAKE_STRING and taking:
                length = count - 1 if cdr and count > 0 else count
                columns = take_text(data, at, length, table, m, column + shift, begin, taken, columns)
                ranges = remember_same(same, ranges, at - begin, at - begin + length)
            at += count
        else:
            if cdr and (count > 0 or operation in (SKIP, TAKE)):
                at += (base - at) & (size - 1)
            if at + size * count > stop:
                return False, ranges, columns
            if operation == TAKE and taking:
                columns = take_numbers(data, at, size, count, big, table, m, column + shift, begin, taken, columns)
            elif operation == TAKE_SEQUENCE and taking:
                count_taken = min(count, capacity)
                columns = take_numbers(
                    data, at, size, count_taken, big, table, m, column + shift + 1, begin, taken, columns
                )
            at += size * count
    return True, ranges, columns


@njit
def decode_new_shapes(
    data: Bytes, start: Ints, end: Ints, program: Ints, cdr: bool, table: NDArray[np.uint64], readable: Bools,
    new_shape: Bools,
) -> None:  # fmt: skip
    """Fill a row of `table` (n, columns) per message, and `readable` (n,): whether the message fits the program.

    Nothing is read outside [start, end); a message that is shorter than its layout, or of an encapsulation that is
    not plain CDR, is not readable. `new_shape` (n,) is set for the messages that the program was run over.

    The messages of a topic are alike: most have the same strings, and sequences of the same lengths, as the message
    before. The bytes that hold them are remembered while the program runs over a message. Where the next message has
    the same bytes there, its numbers are at the same offsets, and are copied from there.
    """
    loops = np.zeros((4, _MAX_NESTING), np.int64)
    same, taken = np.empty((_MOST_REMEMBERED, 2), np.int64), np.empty((_MOST_REMEMBERED, 3), np.int64)
    ranges, columns, model, big = _ZERO, _ZERO, _AS_BEFORE, _ZERO
    for m in range(len(start)):
        begin, base, stop = start[m], start[m], end[m]
        readable[m] = True
        new_shape[m] = not (
            model >= 0
            and stop - begin >= end[model] - start[model]
            and has_shape(data, begin, start[model], same, ranges)
        )
        if not new_shape[m]:
            fill_row(data, begin, big, taken, columns, model, m, table)
            continue
        ranges, columns, model, big = _ZERO, _ZERO, m, _ZERO
        if cdr:
            if stop - begin < 4 or data[begin] != 0 or data[begin + 1] > _CDR_LITTLE:
                readable[m], model = False, -1
                continue
            big = _ZERO + (data[begin + 1] == _CDR_BIG)
            ranges = remember_same(same, ranges, _ZERO, _FOUR)
            base += 4
        readable[m], ranges, columns = run_program(
            data, begin, base, stop, program, cdr, big, table, m, same, ranges, taken, loops
        )
        if not readable[m] or ranges > _MOST_REMEMBERED or columns > _MOST_REMEMBERED:
            model = -1


def decode_messages(layout: Layout, data: Bytes, start: Ints, end: Ints) -> tuple[NDArray[np.uint64], Bools]:
    """Return the table (n, columns) of a layout's fields for messages in `data`, and which of them were readable."""
    table = empty_table(layout, len(start))
    readable, new_shape = np.empty((2, len(start)), np.bool_)
    decode_into(layout, data, start, end, table, readable, new_shape)
    return table, readable


def empty_table(layout: Layout, rows: int) -> NDArray[np.uint64]:
    """Return a table (rows, columns) for a layout, one column after the other in memory."""
    return np.zeros((layout.columns, rows), np.uint64).T


def decode_into(
    layout: Layout, data: Bytes, start: Ints, end: Ints, table: NDArray[np.uint64], readable: Bools, new_shape: Bools
) -> None:
    """Fill `table` (n, columns) from messages in `data`, and mark which were readable and which had a new shape.

    Parameters
    ----------
    readable : bool (n,), set where a message had the layout's shape
    new_shape : bool (n,), not set where a message has the lengths and the texts of the one before
    """
    if layout.program[:, 2].max(initial=0) > len(data):
        # A fixed array longer than all messages together: the definition is of another type. Its length times the size
        # of an element may overflow an integer.
        readable[:] = False
        new_shape[:] = True
    else:
        decode_new_shapes(data, start, end, layout.program, layout.cdr, table, readable, new_shape)
