"""Where the wanted fields of a message type are: its definition compiled to a small program.

A serialized message has no index: the offset of a field depends on the strings and sequences before it. The program
lists what to pass over and what to take; `icrtool.logs.messages.decoder` runs it over one message of each shape.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

from icrtool.errors import DefinitionError

NUMBERS, TEXT, LOOP = range(3)
"""Kinds of operations."""

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
LONGEST_UNROLLED = 4096
"""Longest fixed array of which elements are taken: a covariance has 36."""

DEEPEST, MOST_FIELDS, LONGEST_FIXED, MOST_NUMBERS = 32, 20_000, 1 << 31, 1 << 16
"""Bounds of a definition: messages within one another, fields in all, elements of a fixed array, numbers taken.

Real definitions reach a depth of 6 and some hundred fields; a definition that refers to itself has no end.
"""
MOST_ELEMENTS, MOST_TAKEN = 256, 1024
"""Taken of a sequence, and of sequences in the elements of a sequence together."""

Step = str | int | None
"""A field's name, an element's place, or None for all elements of a sequence."""

_STEP = re.compile(r"([^.\[\]]+)|\[(\d+|\*)\]")

COUNTED = -1
"""In place of a number of elements: the message states it before them."""


class Operation(NamedTuple):
    """A step of a program.

    Attributes
    ----------
    kind : `NUMBERS`, `TEXT` or `LOOP`
    size, number : bytes of a number; how many numbers or elements, or `COUNTED`
    slot : number of the slot that takes it, -1 where it is passed over
    counter : number of the slot that takes a counted number of elements, -1 where it is passed over
    body : what each element of a loop is made of
    is_constant : nothing in the loop is counted or taken: from the second element on, all have the same size
    """

    kind: int
    size: int
    number: int
    slot: int
    counter: int = -1
    body: tuple[Operation, ...] = ()
    is_constant: bool = False

    @property
    def takes(self) -> bool:
        """Whether anything in it is taken."""
        return self.slot >= 0 or self.counter >= 0 or any(operation.takes for operation in self.body)


class Slot(NamedTuple):
    """A wanted field: its primitive type (or ``string``), and its number."""

    kind: str
    number: int


@dataclass(frozen=True, slots=True)
class Layout:
    """A compiled message layout.

    Attributes
    ----------
    slots : by path
    taken : how many slots the program knows; of a field that a definition has twice, the last one counts
    """

    program: tuple[Operation, ...]
    slots: dict[str, Slot]
    taken: int
    cdr: bool


def steps_of(path: str) -> tuple[Step, ...]:
    """Return the steps of a path such as ``joints[*].name`` or ``position_covariance[4]``."""
    found = (match.groups() for match in _STEP.finditer(path))
    return tuple(name or (None if place == "*" else int(place)) for name, place in found)


class _Compiler:
    """Reads a definition once and writes the program."""

    def __init__(self, definitions: Definitions, wanted: Sequence[str], *, cdr: bool) -> None:
        self._definitions = definitions
        self._wanted = frozenset(wanted)
        self._cdr = cdr
        self.program: list[Operation] = []
        self.slots: dict[str, Slot] = {}
        self._fields = self._depth = self._loops = self._taken = self._numbers_taken = 0

    def message(self, name: str, prefix: str) -> None:
        """Write the fields of message type `name`."""
        if name not in self._definitions:
            raise DefinitionError(name, "its definition is not in the log and not bundled")
        if self._depth >= DEEPEST:
            raise DefinitionError(name, f"its definition nests more than {DEEPEST} messages", "this type is not read")
        self._depth += 1
        for field, (node, detail) in self._definitions[name][1]:
            self._fields += 1
            if self._fields > MOST_FIELDS:
                raise DefinitionError(name, f"its definition has more than {MOST_FIELDS} fields", "it is not read")
            self._field(f"{prefix}{field}", int(node), detail)
        self._depth -= 1

    def _field(self, path: str, node: int, detail: FieldDetail) -> None:
        if node == NAME:
            self.message(detail, f"{path}.")
        elif node == BASE:
            self._base(path, detail[0])
        else:
            (element, inner), count = detail
            count = count if node == ARRAY else COUNTED
            if count > LONGEST_FIXED:
                raise DefinitionError(path, "its definition has an array longer than a message can be")
            if int(element) == BASE and inner[0] in SIZES:
                self._array(path, inner[0], count)
            else:
                self._loop(f"{path}[*]", int(element), inner, count)

    def _base(self, path: str, kind: str) -> None:
        if kind == "string":
            self.program.append(Operation(TEXT, 0, COUNTED, self._slot(path, kind) if path in self._wanted else -1))
        elif kind not in SIZES:
            raise DefinitionError(path, f"field type {kind} is not read", "only its message type is affected")
        elif path in self._wanted:
            self.program.append(Operation(NUMBERS, SIZES[kind], 1, self._slot(path, kind)))
        else:
            self._skip(SIZES[kind], 1)

    def _slot(self, path: str, kind: str, count: int = 1) -> int:
        """Return the number of a new slot for a field of up to `count` numbers or texts."""
        if path.count("[*]") > 2:
            raise DefinitionError(path, "a sequence in each element of a sequence of sequences is not read")
        nested = path.count("[*]") > 1
        self._numbers_taken += MOST_TAKEN if nested else count * (MOST_ELEMENTS if self._loops else 1)
        if self._numbers_taken > MOST_NUMBERS:
            raise DefinitionError("message", f"more than {MOST_NUMBERS} numbers of each message would be taken")
        self.slots[path] = Slot(kind, self._taken)
        self._taken += 1
        return self._taken - 1

    def _array(self, path: str, kind: str, count: int) -> None:
        """Write an array (of fixed length) or sequence of numbers."""
        size, all_of_it = SIZES[kind], f"{path}[*]"
        is_wanted = any(name.startswith(f"{path}[") for name in self._wanted)
        if count > LONGEST_UNROLLED and is_wanted:
            raise DefinitionError(path, f"an array of {count} numbers is not read")
        if all_of_it in self._wanted:
            slot = self._slot(all_of_it, kind, MOST_ELEMENTS if count == COUNTED else count)
            self.program.append(Operation(NUMBERS, size, count, slot, self._counter(path)))
        elif count == COUNTED:
            self.program.append(Operation(NUMBERS, size, COUNTED, -1))
        elif is_wanted:
            for i in range(count):
                self._base(f"{path}[{i}]", kind)
        else:
            self._skip(size, count)

    def _counter(self, path: str) -> int:
        """Return the slot that takes the number of elements of a sequence, -1 where it is not wanted."""
        return self._slot(f"{path}[#]", "uint32") if f"{path}[#]" in self._wanted else -1

    def _loop(self, path: str, element: int, inner: FieldDetail, count: int) -> None:
        """Write a loop over the elements of an array or sequence of strings or messages."""
        before, self.program, counter = self.program, [], self._counter(path.removesuffix("[*]"))
        self._loops += 1
        if element == BASE:
            self._base(path, inner[0])
        else:
            self.message(inner, f"{path}.")
        self._loops -= 1
        body, self.program = tuple(self.program), before
        is_constant = all(step.number != COUNTED and step.slot < 0 for step in body)
        is_constant = is_constant and all(step.is_constant for step in body if step.kind == LOOP)
        self.program.append(Operation(LOOP, 0, count, -1, counter, body, is_constant))

    def _skip(self, size: int, count: int) -> None:
        if not self._cdr:
            size, count = 1, size * count
        last = self.program[-1] if self.program else None
        if last is not None and last[:2] == (NUMBERS, size) and last.number != COUNTED and last.slot < 0:
            self.program[-1] = last._replace(number=last.number + count)
        else:
            self.program.append(Operation(NUMBERS, size, count, -1))

    def layout(self) -> Layout:
        """Return what was written, without the steps after the last taken field."""
        while self.program and not self.program[-1].takes:
            self.program.pop()
        return Layout(tuple(self.program), self.slots, self._taken, self._cdr)


def compile_layout(
    definitions: Definitions,
    message_type: str,
    wanted: Sequence[str],
    encoding: Literal["cdr", "ros1"],
) -> Layout:
    """Compile the layout of a message type.

    Parameters
    ----------
    definitions : of the type and all types it contains
    message_type : ``package/Name``
    wanted : paths such as ``header.stamp.sec``, ``orientation_covariance[0]``, ``position[*]``,
        ``drivers[*].measured_travel``; those the type does not have are left out of the layout's slots. Of a sequence
        in each element of a sequence (``a[*].b[*]``) all elements come in a row; ``a[*].b[#]`` are their numbers

    Raises
    ------
    DefinitionError
        The definition of a type in it is missing, or a field has a type that cannot be skipped.
    """
    package, _, name = message_type.partition("/")
    compiler = _Compiler(definitions, wanted, cdr=encoding == "cdr")
    compiler.message(f"{package}/msg/{name}", "")
    return compiler.layout()
