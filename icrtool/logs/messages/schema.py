"""Where the wanted fields of a message type are: its definition compiled to a small program for `decode`.

A serialized message has no index: the offset of a field depends on the strings and sequences before it. The program
lists what to skip and what to copy. One compiled loop (`icrtool.logs.messages.decoder`) then reads a topic without a
Python object per message, also where the lengths of strings change from message to message.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Ints

SKIP, TAKE, SKIP_STRING, TAKE_STRING, SKIP_SEQUENCE, TAKE_SEQUENCE, BEGIN_LOOP, END_LOOP = range(8)
"""Operations. A row of the program is (operation, element size, count, column, capacity, stride, jump)."""

Definitions = Mapping[str, tuple[Any, Any]]
"""``package/msg/Name`` to (constants, fields), as rosbags parses it."""

FieldDetail: TypeAlias = Any
"""Name and length of a field's type; rosbags nests them by the kind of type."""

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of field types, the numbers of rosbags' Nodetype."""
SIZES = {
    "bool": 1, "byte": 1, "char": 1, "octet": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2,
    "int32": 4, "uint32": 4, "int64": 8, "uint64": 8, "float32": 4, "float64": 8,
}  # fmt: skip
_STRING_COLUMNS = 3
_STRIDE_LATER = -1
"""Of a slot in a loop whose end, and with it the columns of an element, is not reached yet."""
LONGEST_UNROLLED = 4096
"""Longest fixed array of which elements are copied: a covariance has 36."""

DEEPEST, MOST_FIELDS, LONGEST_FIXED, MOST_COLUMNS = 32, 20_000, 1 << 31, 1 << 16
"""Bounds of a definition: messages within one another, fields in all, elements of a fixed array, columns taken.

Real definitions reach a depth of 6 and some hundred fields; a definition that refers to itself has no end.
"""


@dataclass(frozen=True, slots=True)
class Slot:
    """Where a wanted field is in the table that `decode` fills.

    Attributes
    ----------
    kind : primitive type name, or ``string`` (columns: offset, length, hash)
    column : first column; one more before it holds the count when `counted`
    repeat : elements taken per message (1 for a plain field)
    stride : columns from one element to the next
    count_column : column with the number of elements in the message, -1 where it is fixed
    """

    kind: str
    column: int
    repeat: int
    stride: int
    count_column: int


@dataclass(frozen=True, slots=True)
class Layout:
    """A compiled message layout: `program` int64 (operations, 7), number of columns, slots by path."""

    program: Ints
    columns: int
    slots: dict[str, Slot]
    cdr: bool

    def counts(self, shapes: NDArray[np.uint64], path: str) -> Ints:
        """Return how many elements of an array messages of some shapes (columns, k) hold (k,)."""
        slot = self.slots[path]
        if slot.count_column < 0:
            return np.full(shapes.shape[1], slot.repeat, np.int64)
        counts: Ints = shapes[slot.count_column].astype(np.int64)
        return counts


class _Compiler:
    """Reads a definition once and writes the program."""

    def __init__(self, definitions: Definitions, wanted: Sequence[str], *, cdr: bool, capacity: int) -> None:
        self._definitions = definitions
        self._wanted = frozenset(wanted)
        self._cdr = cdr
        self._capacity = capacity
        self.rows: list[list[int]] = []
        self.fields = 0
        self._depth = 0
        self.columns = 0
        self.slots: dict[str, Slot] = {}
        self._last_take = 0

    def message(self, name: str, prefix: str, loop: tuple[int, int, int]) -> None:
        """Write the fields of message type `name`; `loop` is (repeat, stride, count column) of the loop around it."""
        if name not in self._definitions:
            raise DefinitionError(name, "its definition is not in the log and not bundled")
        if self._depth >= DEEPEST:
            raise DefinitionError(name, f"its definition nests more than {DEEPEST} messages", "this type is not read")
        self._depth += 1
        for field, (node, detail) in self._definitions[name][1]:
            self.fields += 1
            if self.fields > MOST_FIELDS:
                raise DefinitionError(name, f"its definition has more than {MOST_FIELDS} fields", "it is not read")
            self.field(f"{prefix}{field}", int(node), detail, loop)
        self._depth -= 1

    def field(self, path: str, node: int, detail: FieldDetail, loop: tuple[int, int, int]) -> None:
        """Write one field."""
        if node == NAME:
            self.message(detail, f"{path}.", loop)
        elif node == BASE:
            self._base(path, detail[0], loop)
        else:
            (element, inner), count = detail
            fixed = count if node == ARRAY else None
            if fixed is not None and fixed > LONGEST_FIXED:
                raise DefinitionError(path, "its definition has an array longer than a message can be")
            if int(element) == BASE and inner[0] in SIZES:
                self._numbers(path, inner[0], fixed, loop)
            else:
                self._loop(f"{path}[*]", int(element), inner, fixed, loop)

    def _base(self, path: str, kind: str, loop: tuple[int, int, int]) -> None:
        if kind == "string":
            if path in self._wanted:
                self._place(path, kind, loop, _STRING_COLUMNS, TAKE_STRING)
            else:
                self._emit(SKIP_STRING)
        elif kind in SIZES:
            if path in self._wanted:
                self._place(path, kind, loop, 1, TAKE, size=SIZES[kind])
            else:
                self._skip(SIZES[kind], 1)
        else:
            raise DefinitionError(path, f"field type {kind} is not read", "only its message type is affected")

    def _place(
        self, path: str, kind: str, loop: tuple[int, int, int], width: int, operation: int, size: int = 0
    ) -> None:
        repeat, stride, count_column = loop
        column = self._reserve(width)
        self._emit(operation, size, 1, column)
        self.slots[path] = Slot(kind, column, repeat, stride or 1, count_column)
        self._last_take = len(self.rows)

    def _numbers(self, path: str, kind: str, fixed: int | None, loop: tuple[int, int, int]) -> None:
        """Write an array (fixed length) or sequence of numbers."""
        size, starred = SIZES[kind], f"{path}[*]"
        elements = any(name.startswith(f"{path}[") for name in self._wanted)
        if fixed is not None and not elements:
            self._skip(size, fixed)
        elif fixed is not None and fixed > LONGEST_UNROLLED:
            raise DefinitionError(path, f"an array of {fixed} numbers is not read")
        elif fixed is not None and starred not in self._wanted:
            for i in range(fixed):
                element = f"{path}[{i}]"
                if element in self._wanted:
                    self._place(element, kind, loop, 1, TAKE, size=size)
                else:
                    self._skip(size, 1)
        elif fixed is not None:
            column = self._reserve(fixed)
            self._emit(TAKE, size, fixed, column)
            self.slots[starred] = Slot(kind, column, fixed, 1, -1)
            self._last_take = len(self.rows)
        elif starred in self._wanted:
            if loop[1]:
                raise DefinitionError(path, "a sequence in each element of a sequence is not read")
            count_column = self._reserve(1)
            column = self._reserve(self._capacity)
            self._emit(TAKE_SEQUENCE, size, 0, count_column, self._capacity)
            self.slots[starred] = Slot(kind, column, self._capacity, 1, count_column)
            self._last_take = len(self.rows)
        else:
            self._emit(SKIP_SEQUENCE, size)

    def _loop(
        self, path: str, element: int, inner: FieldDetail, fixed: int | None, outer: tuple[int, int, int]
    ) -> None:
        """Write a loop over the elements of an array or sequence of strings or messages."""
        takes = not outer[1] and any(name == path or name.startswith(f"{path}.") for name in self._wanted)
        repeat = min(fixed, self._capacity) if fixed is not None else self._capacity
        count_column = self._reserve(1) if takes and fixed is None else -1
        begin = len(self.rows)
        self._emit(BEGIN_LOOP, 0, -1 if fixed is None else fixed, count_column, repeat if takes else 0)
        first, loop = self.columns, (repeat, _STRIDE_LATER if takes else 0, count_column)
        if element == BASE:
            self._base(path, inner[0], loop)
        else:
            self.message(inner, f"{path}.", loop)
        self._emit(END_LOOP)
        self.rows[begin][6] = len(self.rows)
        if takes:
            stride = self.rows[begin][5] = max(self.columns - first, 1)
            self.slots |= {
                name: replace(slot, stride=stride) for name, slot in self.slots.items() if slot.stride == _STRIDE_LATER
            }
            self.columns = first + stride * repeat
            self._check_columns()
            self._last_take = len(self.rows)

    def _reserve(self, columns: int) -> int:
        first = self.columns
        self.columns += columns
        self._check_columns()
        return first

    def _check_columns(self) -> None:
        if self.columns > MOST_COLUMNS:
            raise DefinitionError("message", f"more than {MOST_COLUMNS} numbers of each message would be taken")

    def _skip(self, size: int, count: int) -> None:
        if not self._cdr:
            size, count = 1, size * count
        last = self.rows[-1] if self.rows else None
        if last is not None and last[0] == SKIP and last[1] == size:
            last[2] += count
        else:
            self._emit(SKIP, size, count)

    def _emit(self, operation: int, size: int = 0, count: int = 0, column: int = -1, capacity: int = 0) -> None:
        self.rows.append([operation, size, count, column, capacity, 0, 0])

    def layout(self) -> Layout:
        """Return what was written, without the steps after the last taken field."""
        program = np.array(self.rows[: self._last_take] or np.empty((0, 7)), np.int64).reshape(-1, 7)
        return Layout(program, self.columns, self.slots, self._cdr)


def compile_layout(
    definitions: Definitions,
    message_type: str,
    wanted: Sequence[str],
    encoding: Literal["cdr", "ros1"],
    capacity: int = 8,
) -> Layout:
    """Compile the layout of a message type.

    Parameters
    ----------
    definitions : of the type and all types it contains
    message_type : ``package/Name``
    wanted : paths such as ``header.stamp.sec``, ``orientation_covariance[0]``, ``position[*]``,
        ``drivers[*].measured_travel``; those the type does not have are left out of the layout's slots
    capacity : elements copied of a sequence; `Layout.counts` shows where a message holds more

    Raises
    ------
    DefinitionError
        The definition of a type in it is missing, or a field has a type that cannot be skipped.
    """
    package, _, name = message_type.partition("/")
    compiler = _Compiler(definitions, wanted, cdr=encoding == "cdr", capacity=capacity)
    compiler.message(f"{package}/msg/{name}", "", (1, 0, -1))
    return compiler.layout()
