"""Decoder of CDR and ROS 1 messages by their shapes.

Messages have the same shape if their sequences and texts have the same lengths; most messages of a topic do. A layout's
program runs, as plain Python, over one message of each shape. Then the numbers of all messages of that shape are
gathered at once. A message with a shape of its own is decoded alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from struct import Struct
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Bools, Bytes, Ints
from icrtool.logs.containers.chunk import values_at_each_byte
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.definitions import (
    COUNTED,
    MOST_ELEMENTS,
    MOST_TAKEN,
    NUMBERS,
    SIZES,
    TEXT,
    Layout,
    Operation,
    compile_layout,
    ros_definitions,
)
from icrtool.records.text import LONGEST_TEXT, LogText

_SHAPES_AT_ONCE = 1 << 10
"""Largest number of shapes of messages that are decoded at once."""

_COMPARED_SHAPES = 1 << 8
"""Largest number of known shapes with which a message is compared."""

_TRIED_SHAPES = 1 << 4
"""Number of known shapes with which a message is compared, even where few messages have the same shape."""

_MOST_LENGTHS = 512
"""Largest number of lengths in a message that are compared; a message with more lengths has a shape of its own."""

_STEPS_PER_BYTE = 4
"""Number of steps of the program that one message may take for each of its bytes. Without this limit a loop over
elements of size zero would not end."""

_LEAST_STEPS = 256
"""Number of steps of the program that a message of size zero may take."""

_MOST_STEPS = 1 << 22
"""Largest number of steps of the program that one message of any size may take. They take about a second."""

_CDR_LITTLE, _CDR_BIG = 1, 0


MOST_TEXTS = 4096
"""Largest number of different texts of a field, such as the names of joints. A different text in each message would
take ten times the time and memory."""

FURTHER = "…".encode()
"""Text that replaces all texts of a field beyond `MOST_TEXTS`."""


class _UnreadableError(Exception):
    """A message is shorter than its layout, or takes too many steps."""


class Shape(NamedTuple):
    """Properties that all messages of one shape have; offsets count from the first byte of the message.

    Attributes
    ----------
    readable : whether the messages fit their layout
    size : smallest size of a message of this shape [bytes]; unreadable messages have exactly this size
    deciding_bytes : offset and content of the bytes that decide the shape; None where they are too many to compare
    is_big_endian : whether numbers are big-endian
    offsets : for each slot the offset of each number, or the offset and length of each text
    """

    readable: bool
    size: int
    deciding_bytes: tuple[tuple[int, bytes], ...] | None
    is_big_endian: bool
    offsets: list[list[Any]]

    def fits(self, message: bytes) -> bool:
        """Return whether a message has this shape."""
        size, deciding = len(message), self.deciding_bytes
        if deciding is None or not (size >= self.size if self.readable else size == self.size):
            return False
        return all(message.startswith(content, at) for at, content in deciding)


class _ShapeReader:
    """Interpreter of a layout's program: it runs over one message and finds the shape of the message."""

    def __init__(self, layout: Layout, message: bytes) -> None:
        self._message, self._stop, self._cdr = message, len(message), layout.cdr
        self._base = self._at = 4 if layout.cdr else 0
        self._steps_left = min(_STEPS_PER_BYTE * len(message) + _LEAST_STEPS + 2 * len(layout.program), _MOST_STEPS)
        # Encapsulation and lengths decide the shape; adjacent ranges of these bytes are joined.
        self._deciding, self._lengths = [[0, self._base]], 0
        self._offsets: list[list[Any]] = [[] for _ in range(layout.slot_count)]
        self._is_big_endian, readable = False, True
        try:
            if layout.cdr:
                if len(message) < 4 or message[0] != 0 or message[1] > _CDR_LITTLE:
                    raise _UnreadableError
                self._is_big_endian = message[1] == _CDR_BIG
            self._unpack = Struct(">I" if self._is_big_endian else "<I").unpack_from
            self._run_program(layout.program, wanted=True)
        except _UnreadableError:
            readable = False
        deciding = tuple((begin, message[begin:end]) for begin, end in self._deciding if message[begin:end])
        self.shape = Shape(
            readable=readable,
            size=self._at if readable else len(message),
            deciding_bytes=deciding if self._lengths <= _MOST_LENGTHS else None,
            is_big_endian=self._is_big_endian,
            offsets=self._offsets,
        )

    def _run_program(self, program: Sequence[Operation], *, wanted: bool) -> None:
        """Pass over the fields of a program, and store the offsets of its wanted fields if `wanted`.

        Raises
        ------
        _UnreadableError
            The message ends before its fields, or the program takes too many steps.
        """
        for kind, size, stated_count, slot, counter, body, is_constant in program:
            self._steps_left -= 1
            if self._steps_left < 0:
                raise _UnreadableError
            element_count = self._read_length() if stated_count == COUNTED else stated_count
            if counter >= 0 and wanted:
                self._offsets[counter].append(self._at - 4)
            if kind == TEXT:
                if wanted and slot >= 0 and len(self._offsets[slot]) < MOST_TAKEN:
                    length = element_count - 1 if self._cdr and element_count else element_count
                    self._offsets[slot].append((self._at, min(length, LONGEST_TEXT)))
                self._at += element_count
            elif kind == NUMBERS:
                if self._cdr and (element_count or stated_count != COUNTED):
                    self._at += (self._base - self._at) & (size - 1)
                end = self._at + size * element_count
                if end > self._stop:
                    raise _UnreadableError
                if wanted and slot >= 0:
                    stored, before = element_count, len(self._offsets[slot])
                    if before or stated_count == COUNTED:
                        stored = min(element_count, MOST_ELEMENTS, MOST_TAKEN - before)
                    self._offsets[slot] += range(self._at, self._at + size * stored, size)
                self._at = end
            else:
                self._run_loop(body, element_count, is_constant=is_constant, wanted=wanted)

    def _run_loop(self, body: Sequence[Operation], element_count: int, *, is_constant: bool, wanted: bool) -> None:
        """Pass over `element_count` elements, each with the fields of `body`; raise as `_run_program`."""
        # Each element counts as one byte or more, so that a loop over elements without fields ends.
        if element_count > self._stop - self._at:
            raise _UnreadableError
        before = self._at, self._steps_left
        for i in range(min(element_count, 2) if is_constant else element_count):
            before = self._at, self._steps_left
            self._run_program(body, wanted=wanted and i < MOST_ELEMENTS)
        if is_constant and element_count > 2:
            self._at += (element_count - 2) * (self._at - before[0])
            self._steps_left += (element_count - 2) * (self._steps_left - before[1])
            if self._at > self._stop or self._steps_left < 0:
                raise _UnreadableError

    def _read_length(self) -> int:
        """Return the length of a text or a sequence; the message must have at least this number of bytes left."""
        if self._cdr:
            self._at += (self._base - self._at) & 3
        if self._at + 4 > self._stop:
            raise _UnreadableError
        self._lengths += 1
        if self._deciding[-1][1] == self._at:
            self._deciding[-1][1] += 4
        elif self._lengths <= _MOST_LENGTHS:
            self._deciding.append([self._at, self._at + 4])
        length: int = self._unpack(self._message, self._at)[0]
        self._at += 4
        if length > self._stop - self._at:
            raise _UnreadableError
        return length


@dataclass(slots=True)
class Decoder:
    """Decoder of the messages of one topic; it keeps the shapes of earlier messages.

    Attributes
    ----------
    layout : wanted fields of the messages, and the program that finds them
    types : primitive type of each column that the messages have
    decoded_class : class of the decoded messages
    """

    layout: Layout
    types: Mapping[str, str] = field(default_factory=dict)
    decoded_class: type[Decoded] = field(default_factory=lambda: Decoded)
    _known: list[Shape] = field(default_factory=list)

    def decode(self, data: Bytes, start: Ints, end: Ints) -> Decoded:
        """Return the decoded messages [start, end) (n,) of `data`; only the first ones if they have too many shapes."""
        size, undecoded = end - start, np.arange(len(start))
        shapes: list[Shape] = []
        shape_of = np.empty(len(start), np.int64)
        while len(undecoded) and len(shapes) < _SHAPES_AT_ONCE:
            first = undecoded[0]
            message = data[start[first] : end[first]].tobytes()
            # Where few messages have the same shape, a comparison takes longer than decoding.
            compare = len(shapes) < min(_COMPARED_SHAPES, _TRIED_SHAPES + (len(start) - len(undecoded)) // 2)
            shape = next((known for known in self._known if known.fits(message)), None) if compare else None
            if shape is None:
                shape = _ShapeReader(self.layout, message).shape
                if len(self._known) < _COMPARED_SHAPES and shape.deciding_bytes is not None:
                    self._known.append(shape)
            fits = np.zeros(len(undecoded), np.bool_)
            fits[0] = True
            if compare and shape.deciding_bytes is not None:
                fits = size[undecoded] >= shape.size if shape.readable else size[undecoded] == shape.size
                together = values_at_each_byte(data, np.dtype((np.void, shape.size)))[start[undecoded[fits]]]
                matches = np.ones(len(together), np.bool_)
                for at, content in shape.deciding_bytes:
                    matches &= equals_first(together, at, len(content))
                fits[fits] = matches
                if not shapes and shape.readable and shape.size and fits.all():
                    return self.decoded_class(
                        self.layout,
                        together.view(np.uint8),
                        np.arange(0, len(start) * shape.size, shape.size),
                        [shape],
                        np.zeros(len(start), np.int64),
                        fits,
                    )
            shape_of[undecoded[fits]] = len(shapes)
            shapes.append(shape)
            undecoded = undecoded[~fits]
        done = int(undecoded[0]) if len(undecoded) else len(start)
        readable = np.array([shape.readable for shape in shapes], np.bool_)[shape_of[:done]]
        return self.decoded_class(
            self.layout, data, start[:done][readable], shapes, shape_of[:done][readable], readable
        )


def equals_first(records: NDArray[np.void], at: int, length: int) -> Bools:
    """Return for each record (n,) whether its `length` bytes from `at` on equal the bytes of the first record.

    Notes
    -----
    The bytes are compared as numbers of up to 8 bytes, which is four times as fast as single bytes.
    """
    equal, end = np.ones(len(records), np.bool_), at + length
    while at < end:
        size = 1 << min((end - at).bit_length() - 1, 3)
        number = records.getfield(f"u{size}", at)
        equal &= number == number[0]
        at += size
    return equal


@dataclass(frozen=True, slots=True)
class Decoded:
    """Messages of one topic with the offsets of the wanted fields in them.

    Attributes
    ----------
    layout : wanted fields of the messages
    data : bytes of the messages
    start : (n,) offset at which each readable message begins in `data`
    shapes : the shapes of the messages
    shape_of : (n,) row in `shapes` of each readable message
    readable : (m,) whether each message could be decoded
    """

    layout: Layout
    data: Bytes
    start: Ints
    shapes: list[Shape]
    shape_of: Ints
    readable: Bools

    def numbers(self, path: str) -> NDArray[Any]:
        """Return a field of numbers as float64 or int64: (n,), or (n, longest) for an array.

        Values that a message lacks are NaN or 0.
        """
        name, slot = self.layout.slots[path]
        letter = name[0] if name.startswith(("int", "float")) else "u"
        dtype: np.dtype[Any] = np.dtype(f"<{letter}{SIZES[name]}")
        result: np.dtype[Any] = np.dtype(np.float64 if letter == "f" else np.int64)
        offsets: list[list[int]] = [shape.offsets[slot] if shape.readable else [] for shape in self.shapes]
        width = max(map(len, offsets), default=0) if len(self.start) else 0
        if width == 0:
            return np.empty((len(self.start), 0) if "[*]" in path else 0, result)
        first = offsets[0]
        step = first[1] - first[0] if len(first) > 1 else 0
        if len(offsets) == 1 and (width == 1 or first == [*range(first[0], first[-1] + step, step)]):
            values = self._fields(first[0], dtype, width, step)
        else:
            table = np.zeros((len(offsets), width), np.int64)
            for row, row_offsets in zip(table, offsets, strict=True):
                row[: len(row_offsets)] = row_offsets
            # A message that lacks the number may end too near to the end of the data to be read there.
            begins = np.minimum(self.start[:, None] + table[self.shape_of], len(self.data) - dtype.itemsize)
            values = values_at_each_byte(self.data, dtype)[begins]
        if any(shape.is_big_endian for shape in self.shapes):
            is_big_endian = np.array([shape.is_big_endian for shape in self.shapes])
            values = np.where(is_big_endian[self.shape_of, None], values.byteswap(), values)
        if dtype.char == "f":
            with np.errstate(invalid="ignore"):  # A signalling NaN becomes a quiet NaN.
                values = values.astype(result, copy=False)
        else:
            values = values.astype(result, copy=False)
        if len(offsets) > 1:
            lacking = np.arange(width) >= np.array([*map(len, offsets)])[self.shape_of, None]
            values = np.where(lacking, result.type(np.nan if result.kind == "f" else 0), values)
        return values if "[*]" in path else values[:, 0]

    def _fields(self, offset: int, dtype: np.dtype[Any], width: int = 1, step: int = 0) -> NDArray[Any]:
        """Return a view of a field of messages of one shape (n, width): values `step` bytes apart from `offset` on."""
        strides = (self.shapes[0].size, step)
        return np.ndarray((len(self.start), width), dtype, self.data, int(self.start[0]) + offset, strides)

    def text_codes(self, path: str, known: dict[bytes, int]) -> Ints:
        """Return the code of each text of a text field (n,) or (n, longest), -1 where a message lacks the text.

        Parameters
        ----------
        path : path of the field
        known : code of each text, from 0; texts that are not in it are added
        """
        slot = self.layout.slots[path].slot_index
        if not len(self.start):
            return np.empty((0, 0) if "[*]" in path else 0, np.int64)
        width = max((len(shape.offsets[slot]) for shape in self.shapes if shape.readable), default=0)
        codes: Ints = np.empty((0, width), np.int64)
        for shape, rows in self.by_shape():
            column_codes = []
            for at, length in shape.offsets[slot]:
                dtype = np.dtype((np.void, length))
                texts = (
                    self._fields(at, dtype)[:, 0]
                    if len(self.shapes) == 1
                    else values_at_each_byte(self.data, dtype)[self.start[rows] + at]
                )
                are_equal = bool(equals_first(texts, 0, length).all())
                column_codes.append(text_codes(texts[: 1 if are_equal else None].tolist(), known))
            if len(self.shapes) == 1 and all(len(field_codes) == 1 for field_codes in column_codes):
                codes = np.broadcast_to(np.array(column_codes, np.int64).reshape(1, width), (len(self.start), width))
                break
            if not len(codes):
                codes = np.full((len(self.start), width), -1, np.int64)
            for column, field_codes in enumerate(column_codes):
                codes[rows, column] = field_codes
        return codes if "[*]" in path else codes[:, 0]

    def texts(self, path: str) -> list[bytes]:
        """Return the text of a text field in each message (n,)."""
        slot, found = self.layout.slots[path].slot_index, np.full(len(self.start), b"", object)
        for shape, rows in self.by_shape():
            at, length = shape.offsets[slot][0]
            if length:
                found[rows] = values_at_each_byte(self.data, np.dtype((np.void, length)))[
                    self.start[rows] + at
                ].tolist()
        return list(found)

    def by_shape(self) -> Iterator[tuple[Shape, Ints | slice]]:
        """Yield each shape with the rows of its messages."""
        if len(self.shapes) == 1:
            yield self.shapes[0], slice(None)
            return
        order = np.argsort(self.shape_of, kind="stable")
        ends = np.cumsum(np.bincount(self.shape_of, minlength=len(self.shapes)))
        for shape, rows in zip(self.shapes, np.split(order, ends[:-1]), strict=True):
            if len(rows):
                yield shape, rows


def text_codes(texts: list[bytes], known: dict[bytes, int]) -> list[int]:
    """Return the code of each text, an integer from 0.

    Parameters
    ----------
    texts : the texts
    known : code of each text; texts that are not in it are added, beyond `MOST_TEXTS` all under the code of `FURTHER`
    """
    if len(known) + len(texts) <= MOST_TEXTS:
        return [known.setdefault(text, len(known)) for text in texts]
    codes = []
    for text in texts:
        kept = text if text in known or len(known) < MOST_TEXTS else FURTHER
        codes.append(known.setdefault(kept, len(known)))
    return codes


@lru_cache(maxsize=64)
def _layout(channel: Channel, wanted: tuple[str, ...]) -> Layout:
    """Return the layout of all channels with one definition, computed once: thousands of topics may have one type."""
    encoding: Literal["cdr", "ros1"] = "cdr" if channel.encoding == "cdr" else "ros1"
    return compile_layout(ros_definitions(channel), channel.message_type, wanted, encoding)


def ros_decoder(channel: Channel, wanted: Sequence[str]) -> Decoder:
    """Return the decoder of a channel of ROS messages.

    Parameters
    ----------
    channel : the channel
    wanted : paths of the wanted fields, as for `compile_layout`

    Raises
    ------
    DefinitionError
        The definition of the channel's type is missing, or cannot be read.
    """
    layout = _layout(replace(channel, id=0, topic=LogText(""), count=None), tuple(wanted))
    return Decoder(layout, {path: primitive for path, (primitive, _) in layout.slots.items()})
