"""CDR decoder: the compiled loop that runs the program of a layout over raw messages."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Bools, Bytes, Ints
from icrtool.kernels.compiled import njit
from icrtool.kernels.words import eight_bytes, read_word
from icrtool.logs.containers.channel import Block
from icrtool.logs.messages.schema import (
    BEGIN_LOOP,
    END_LOOP,
    SIZES,
    SKIP,
    SKIP_STRING,
    TAKE,
    TAKE_SEQUENCE,
    TAKE_STRING,
    Layout,
)

_MAX_NESTING = 8
_MOST_REMEMBERED = 512
"""Words and columns remembered of a message's shape; messages with more are all decoded step by step."""

_STEPS_PER_BYTE, _LEAST_STEPS, MOST_STEPS = 4, 256, 1 << 24
"""Steps of the program that one message may take: per byte, and at most. Loops over elements of size zero would never
end. The second limit keeps the time of one message below about 0.1 s."""

_MOST_BYTES_AT_ONCE = 1 << 24
"""Of the messages of one compiled call, which cannot be interrupted."""

ANY_LENGTH = 1 << 62
"""Of sequences: more elements than a message can hold."""

_ZERO, _ONE, _FOUR, _EIGHT = (cast(int, np.int64(value)) for value in (0, 1, 4, 8))
"""Typed: numba compiles another copy of a function for every plain number that it is called with."""

_CDR_LITTLE, _CDR_BIG = 1, 0
_FNV_OFFSET, _FNV_PRIME = np.uint64(0xCBF29CE484222325), np.uint64(0x100000001B3)

_FILLED, _SHAPES, _UNREADABLE, _LONGEST, _WORDS, _COLUMNS, _LENGTH, _BIG = range(8)
"""What `Decoded.state` counts: rows in use, shapes in use, unreadable messages, elements of the sequence that needs
more columns; and of the last shape: words and columns remembered, bytes that its messages have at least, byte order."""


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
def remember_same(data: Bytes, begin: int, same: Ints, used: int, first: int, stop: int) -> int:
    """Add the bytes [first, stop) of a message to the words of its shape; return how many words are used now."""
    while first < stop and used <= len(same):
        size = min(stop - first, _EIGHT)
        if used < len(same):
            same[used, 0], same[used, 1] = first, size
            same[used, 2] = np.int64(read_word(data, begin + first, size, _ZERO))
        used += 1
        first += size
    return used


@njit
def has_shape(data: Bytes, begin: int, same: Ints, words: int) -> bool:
    """Return whether the message at `begin` has the words of a shape."""
    for k in range(words):  # noqa: SIM110 - compiled without a generator
        if read_word(data, begin + same[k, 0], same[k, 1], _ZERO) != np.uint64(same[k, 2]):
            return False
    return True


@njit
def take_numbers(
    data: Bytes, at: int, size: int, count: int, big: int, table: NDArray[np.uint64], column: int, row: int,
    begin: int, taken: Ints, columns: int,
) -> int:  # fmt: skip
    """Copy `count` numbers to a row, and remember their offsets; return how many columns are used now."""
    for i in range(count):
        table[column + i, row] = read_word(data, at + i * size, size, big)
        if columns < len(taken):
            taken[columns, 0], taken[columns, 1], taken[columns, 2] = at + i * size - begin, size, column + i
        columns += 1
    return columns


@njit
def run_program(  # noqa: C901, PLR0912, PLR0915 - one interpreter loop, compiled as a whole
    data: Bytes, begin: int, base: int, stop: int, program: Ints, cdr: bool, big: int, table: NDArray[np.uint64],
    row: int, shapes: NDArray[np.uint64], shape: int, same: Ints, words: int, taken: Ints, loops: Ints,
) -> tuple[bool, int, int, int, int]:  # fmt: skip
    """Run the program over one message.

    Parameters
    ----------
    begin, base, stop : where the message begins, where its fields do, and where it ends in `data`
    table, shapes : of `Decoded`; column `row` of the one and column `shape` of the other are filled
    same, words, taken : filled with the words that make the message's shape, and where its numbers are
    loops : (4, `_MAX_NESTING`) space for the loops around a field: first operation, elements left, column, element

    Returns
    -------
    Whether the message fits the program; how many words and columns of it are remembered; where its last field ends;
    the elements of the longest sequence that is taken.
    """
    returns, left, column_base, iteration = loops
    at, depth, shift, taking, step, columns, longest = base, 0, 0, True, 0, _ZERO, _ZERO
    steps_left = min(_STEPS_PER_BYTE * (stop - at) + _LEAST_STEPS + 2 * len(program), MOST_STEPS)
    while step < len(program):
        steps_left -= 1
        if steps_left < 0:
            return False, words, columns, at, longest
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
                return False, words, columns, at, longest
            count = np.int64(read_word(data, at, _FOUR, big))
            words = remember_same(data, begin, same, words, at - begin, at - begin + 4)
            at += 4
            if count > stop - at:
                return False, words, columns, at, longest
            if operation in (TAKE_SEQUENCE, BEGIN_LOOP) and column >= 0 and taking:
                shapes[column + shift, shape] = np.uint64(count)
                longest = max(longest, int(count))
        if operation == BEGIN_LOOP:
            # Count at least one byte for an element: a loop over elements without fields must end, too.
            if count > 0 and (depth >= _MAX_NESTING or count > stop - at):
                return False, words, columns, at, longest
            if count > 0:
                returns[depth], left[depth], column_base[depth], iteration[depth] = step - 1, count, shift, 0
                depth += 1
            else:
                step = behind
        elif operation in (SKIP_STRING, TAKE_STRING):
            if operation == TAKE_STRING and taking:
                length = count - 1 if cdr and count > 0 else count
                place = column + shift
                shapes[place, shape], shapes[place + 1, shape] = np.uint64(at), np.uint64(length)
                shapes[place + 2, shape] = hash_text(data, at, length)
                words = remember_same(data, begin, same, words, at - begin, at - begin + length)
            at += count
        else:
            if cdr and (count > 0 or operation in (SKIP, TAKE)):
                at += (base - at) & (size - 1)
            if count > stop - at or at + size * count > stop:  # the product of a forged count may overflow
                return False, words, columns, at, longest
            if operation == TAKE and taking:
                columns = take_numbers(data, at, size, count, big, table, column + shift, row, begin, taken, columns)
            elif operation == TAKE_SEQUENCE and taking:
                count_taken = min(count, capacity)
                columns = take_numbers(
                    data, at, size, count_taken, big, table, column + shift + 1, row, begin, taken, columns
                )
            at += size * count
    return True, words, columns, at, longest


@njit
def decode_block(
    data: Bytes, channel: Ints, log_time_ns: Ints, start: Ints, end: Ints, number: int, first: int, program: Ints,
    cdr: bool, most_elements: int, table: NDArray[np.uint64], times: Ints, shape_of: Ints, shapes: NDArray[np.uint64],
    state: Ints, same: Ints, taken: Ints, loops: Ints,
) -> int:  # fmt: skip
    """Decode the messages of one channel among those of a block, from message `first` on; arrays of `Decoded`.

    Nothing is read outside [start, end); a message that is shorter than its layout, or of an encapsulation that is
    not plain CDR, is unreadable. The messages of a topic are alike: most have the same strings, and sequences of the
    same lengths, as the message before. The words that hold them are remembered while the program runs over a
    message. Where the next message has the same words there, its numbers are at the same offsets, and are copied.

    Returns
    -------
    The first message that is left: where the table is full, a sequence has more than `most_elements` (in the state
    then), or the call has to end.
    """
    bytes_left, m = _MOST_BYTES_AT_ONCE, first
    filled, shape = state[_FILLED], state[_SHAPES] - 1
    words, columns, reach, big = state[_WORDS], state[_COLUMNS], state[_LENGTH], state[_BIG]
    while m < len(channel):
        if channel[m] != number:
            m += 1
            continue
        begin, stop = start[m], end[m]
        if filled == len(times) or bytes_left < 0:
            break
        bytes_left -= stop - begin
        if columns >= 0 and stop - begin >= reach and has_shape(data, begin, same, words):
            for k in range(columns):
                table[taken[k, 2], filled] = read_word(data, begin + taken[k, 0], taken[k, 1], big)
        else:
            words, columns, big, base, readable = _ZERO, -_ONE, _ZERO, begin, True
            if cdr:
                readable = stop - begin >= 4 and data[begin] == 0 and data[begin + 1] <= _CDR_LITTLE
                if readable:
                    big = _ZERO + (data[begin + 1] == _CDR_BIG)
                    words = remember_same(data, begin, same, words, _ZERO, _FOUR)
                    base += 4
            longest = _ZERO
            if readable:
                readable, words, columns, reach, longest = run_program(
                    data,
                    begin,
                    base,
                    stop,
                    program,
                    cdr,
                    big,
                    table,
                    filled,
                    shapes,
                    shape + 1,
                    same,
                    words,
                    taken,
                    loops,
                )
                reach -= begin
                if not readable or longest > most_elements or words > len(same) or columns > len(taken):
                    columns = -_ONE
            if not readable:
                state[_UNREADABLE] += 1
                m += 1
                continue
            if longest > most_elements:
                state[_LONGEST] = longest
                break
            shape += 1
        times[filled], shape_of[filled] = log_time_ns[m], shape
        filled += 1
        m += 1
    state[_FILLED], state[_SHAPES] = filled, shape + 1
    state[_WORDS], state[_COLUMNS], state[_LENGTH], state[_BIG] = words, columns, reach, big
    return m


@dataclass(slots=True)
class Decoded:
    """Decoded messages of one topic as raw 64-bit words, up to so many rows.

    Attributes
    ----------
    table : (columns, rows) the numbers of each message; other columns of the layout are not used
    times_ns, shape_of : (rows,) log time, and the place of the message's shape among `shapes`; both in file order
    shapes : (columns, rows + 1) what messages of one shape share: counts, and of texts offset, length and hash
    state, same, taken, loops : see `decode_block`
    """

    layout: Layout
    rows: int
    table: NDArray[np.uint64] = field(init=False)
    times_ns: Ints = field(init=False)
    shape_of: Ints = field(init=False)
    shapes: NDArray[np.uint64] = field(init=False)
    state: Ints = field(init=False)
    same: Ints = field(init=False)
    taken: Ints = field(init=False)
    loops: Ints = field(init=False)

    def __post_init__(self) -> None:
        # Memory of columns that are not used is not touched.
        self.table = np.empty((self.layout.columns, self.rows), np.uint64)
        self.shapes = np.empty((self.layout.columns, self.rows + 1), np.uint64)
        self.times_ns, self.shape_of = np.empty((2, self.rows), np.int64)
        self.state = np.array([0, 0, 0, 0, 0, -1, 0, 0])
        self.same, self.taken = np.empty((2, min(_MOST_REMEMBERED, 32 * self.rows), 3), np.int64)
        self.loops = np.zeros((4, _MAX_NESTING), np.int64)

    @property
    def filled(self) -> int:
        """The rows in use."""
        return int(self.state[_FILLED])

    @property
    def known_shapes(self) -> int:
        """The shapes seen so far."""
        return int(self.state[_SHAPES])

    @property
    def longest(self) -> int:
        """The elements of the sequence for which decoding ended, 0 for none."""
        return int(self.state[_LONGEST])

    def decode(self, block: Block, number: int, first: int, most_elements: int) -> int:
        """Decode messages of a channel as `decode_block` does, and return the first message that is left."""
        return decode_block(
            *block, number, first, self.layout.program, self.layout.cdr, most_elements, self.table, self.times_ns,
            self.shape_of, self.shapes, self.state, self.same, self.taken, self.loops,
        )  # fmt: skip

    def clear(self) -> int:
        """Free the rows, keep the last shape, and return how many messages were unreadable."""
        self.shapes[:, 0] = self.shapes[:, max(self.known_shapes - 1, 0)]
        unreadable = int(self.state[_UNREADABLE])
        self.state[[_FILLED, _UNREADABLE]], self.state[_SHAPES] = 0, min(self.known_shapes, 1)
        return unreadable

    def used_shapes(self) -> tuple[NDArray[np.uint64], Ints]:
        """Return the shapes of the rows (columns, k), and the place of each row's shape among them (n,)."""
        shape_of = self.shape_of[: self.filled]
        first, last = (shape_of[0], shape_of[-1]) if len(shape_of) else (0, -1)
        return self.shapes[:, first : last + 1], shape_of - first

    def numbers(self, path: str) -> NDArray[Any]:
        """Return a numeric field, valid until the next call: (n,) or, for an array, (n, longest).

        What a message lacks is NaN or 0.
        """
        slot = self.layout.slots[path]
        if "[*]" not in path:
            return _typed(self.table[slot.column, : self.filled], slot.kind)
        shapes, shape_of = self.used_shapes()
        counts = self.layout.counts(shapes, path)
        repeat = min(slot.repeat, int(counts.max(initial=0)))
        columns = slice(slot.column, slot.column + repeat * slot.stride, slot.stride)
        values = _typed(self.table[columns, : self.filled].T, slot.kind)
        if counts.min(initial=repeat) < repeat:
            lacking = np.arange(repeat) >= counts[shape_of, None]
            values = np.where(lacking, values.dtype.type(np.nan if values.dtype.kind == "f" else 0), values)
        return values


def _typed(raw: NDArray[np.uint64], kind: str) -> NDArray[Any]:
    """Return raw 64-bit words as float64 or int64."""
    if kind == "float64":
        return raw.view(np.float64)
    if kind == "float32":
        with np.errstate(invalid="ignore"):  # a signalling NaN becomes a NaN
            return raw.astype(np.uint32).view(np.float32).astype(np.float64)
    if kind.startswith("int"):
        width = SIZES[kind]
        return raw.astype(f"u{width}").view(f"i{width}").astype(np.int64)
    return raw.astype(np.int64)


def decode_messages(layout: Layout, data: Bytes, start: Ints, end: Ints) -> tuple[Decoded, Bools]:
    """Return the readable ones among some messages, and which they are (n,)."""
    count, first = len(start), 0
    decoded, readable = Decoded(layout, count), np.zeros(count, np.bool_)
    block = Block(data, np.zeros(count, np.int64), np.arange(count), start, end)
    while first < count:
        first = decoded.decode(block, 0, first, ANY_LENGTH)
    readable[decoded.times_ns[: decoded.filled]] = True
    return decoded, readable
