"""Message definitions, and where the wanted fields of a type are: its definition compiled to a small program.

A definition is taken from the log (text, IDL, schema), else from the bundled vendor types, else from ROS 2 Humble. A
message has no index: the offset of a field depends on the strings and sequences before it. The program lists which
bytes to pass over and which fields to take; `icrtool.logs.messages.decoder` runs it over one message of each shape.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from typing import Any, Literal, NamedTuple, TypeAlias

from icrtool.errors import DefinitionError
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.definition_bounds import MOST_FIELDS, FieldNames
from icrtool.logs.messages.definition_text import LONGEST_DEFINITION, full_name, parse_definition, plain_definition

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
"""Longest fixed array whose elements are taken: a covariance has 36."""

DEEPEST = 32
"""Largest depth of messages within one another. Real definitions reach 6; a definition that refers to itself has no
end."""

LONGEST_FIXED = 1 << 31
"""Largest number of elements of a fixed array."""

MOST_NUMBERS = 1 << 16
"""Largest number of numbers that are taken from a message."""
MOST_ELEMENTS = 256
"""Largest number of elements taken from a sequence."""

MOST_TAKEN = 1024
"""Largest number of elements taken from all sequences in the elements of a sequence together."""

Step = str | int | None
"""A field's name, an element's place, or None for all elements of a sequence."""

_STEP = re.compile(r"([^.\[\]]+)|\[(\d+|\*)\]")

COUNTED = -1
"""Used in place of a number of elements that the message states before the elements."""


def ros_definitions(channel: Channel) -> Definitions:
    """Return the definitions that the type of a channel of ROS messages needs.

    Raises
    ------
    DefinitionError
        Neither the log nor the bundle knows the type, or the log's text cannot be parsed.
    """
    return _known_definitions(channel.message_type, channel.definition, channel.definition_format, channel.encoding)[0]


def definition_note(channel: Channel) -> str:
    """Return in words why the log's own definition of a channel's type is not used; empty where it is, or none is."""
    described = channel.message_type, channel.definition, channel.definition_format, channel.encoding
    return _known_definitions(*described)[1] if channel.encoding in ("cdr", "ros1") else ""


@lru_cache(maxsize=256)
def _known_definitions(
    message_type: str, text: str, written: Literal["msg", "idl"], encoding: str
) -> tuple[Definitions, str]:
    """Return the definitions that a type needs, and why the log's own definitions are not used; empty where they are.

    Raises
    ------
    DefinitionError
        As `ros_definitions`.
    """
    name, known = full_name(message_type), bundled_for(encoding)
    has_text = bool(text.strip("\0\ufeff \t\r\n"))
    if not has_text:
        if name not in known:
            why = "its connection carries no definition" if encoding == "ros1" else "its definition is not in the log"
            raise DefinitionError(message_type, f"{why} and not bundled")
        return known, ""
    types: Definitions
    try:
        types, problem = parse_definition(text, written, message_type), ""
    except DefinitionError as err:
        types, problem = _without_last_line(text, written, message_type), err.reason
    if types and (missing := _missing({**known, **types}, name)):
        types = {}
        problem = f"the definition in the log contains {missing}, which is not defined there and not bundled"
    if types:
        *_, last = types
        is_begun = last in standard_definitions() and _is_begun(types[last][1], known[last][1])
        if is_begun:
            return {**known, **types, last: known[last]}, f"the definition in the log ends within {last}"
        if not problem:
            return {**known, **types}, ""
    if name not in known:
        raise DefinitionError(message_type, problem)
    return known, problem


def _without_last_line(text: str, written: Literal["msg", "idl"], message_type: str) -> Definitions:
    """Return the types of a definition text before its last line, where the log may end it; empty where unreadable."""
    before = plain_definition(text[: LONGEST_DEFINITION + 1], message_type).rstrip("\n").rpartition("\n")[0]
    try:
        return parse_definition(before, written, message_type) if written == "msg" and before else {}
    except DefinitionError:
        return {}


def _missing(definitions: Definitions, name: str) -> str:
    """Return a type that another one contains and that is not defined; empty where all are."""
    to_look_at, looked_at = [name], {name}
    while to_look_at:
        name = to_look_at.pop()
        if name not in definitions:
            return name
        for _, (node, detail) in definitions[name][1]:
            inner = detail[0] if int(node) > NAME else (node, detail)
            if int(inner[0]) == NAME and inner[1] not in looked_at:
                looked_at.add(inner[1])
                to_look_at.append(inner[1])
    return ""


def _is_begun(fields: Sequence[Any], whole: Sequence[Any]) -> bool:
    """Return whether fields are the first ones of a type that has more; the name of the last one may be incomplete."""
    if not fields:
        return bool(whole)
    *before, (last, kind) = fields
    if before != list(whole[: len(before)]) or len(before) == len(whole):
        return last.isupper() and before == list(whole)  # a constant of which the value is missing
    known, known_kind = whole[len(before)]
    return last.isupper() or (known_kind == kind and known.startswith(last) and list(fields) != list(whole))


def kind_at(definitions: Definitions, name: str, steps: Sequence[Step]) -> str | None:
    """Return the primitive type of the field at some steps, None where a message of this type has none there."""
    node: int = NAME
    detail: FieldDetail = name
    for step in steps:
        if isinstance(step, str):
            fields = dict(definitions[detail][1]) if node == NAME and detail in definitions else {}
            if step not in fields:
                return None
            node, detail = fields[step]
        elif node in (ARRAY, SEQUENCE):
            (node, detail), _ = detail
        else:
            return None
    return str(detail[0]) if node == BASE else None


@cache
def bundled_definitions() -> Definitions:
    """Return the vendor types that come with icrtool (see ``definitions/SOURCES.md``)."""
    from rosbags.typesys import get_types_from_msg

    types: dict[str, Any] = {}
    for package in resources.files("icrtool.logs.messages").joinpath("definitions").iterdir():
        if package.is_dir():
            for file in package.iterdir():
                name = f"{package.name}/msg/{file.name.removesuffix('.msg')}"
                types.update(get_types_from_msg(file.read_text(encoding="utf-8"), name))
    return types


@cache
def standard_definitions() -> Definitions:
    """Return the types that come with ROS 2 Humble."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE).fielddefs


@cache
def bundled_for(encoding: str) -> Definitions:
    """Return all types that do not need a definition in the log, with the fields of ROS 1 Noetic or ROS 2 Humble."""
    from rosbags.typesys import Stores, get_typestore

    definitions = {**standard_definitions(), **bundled_definitions()}
    if encoding == "ros1":
        definitions |= get_typestore(Stores.ROS1_NOETIC).fielddefs
        definitions["tf/msg/tfMessage"] = definitions["tf2_msgs/msg/TFMessage"]
    return definitions


class Operation(NamedTuple):
    """A step of a program.

    Attributes
    ----------
    kind : `NUMBERS`, `TEXT` or `LOOP`
    size, number : bytes of one number; count of numbers or elements, or `COUNTED`
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
        """Whether the operation takes any field."""
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
    fields : number of fields of the type, with the types in it
    taken : number of slots; if a definition has a field twice, the last one counts
    """

    program: tuple[Operation, ...]
    slots: dict[str, Slot]
    taken: int
    cdr: bool
    fields: int = 0


def decoding_steps(path: str) -> tuple[Step, ...]:
    """Return the steps of a path such as ``joints[*].name`` or ``position_covariance[4]``."""
    found = (match.groups() for match in _STEP.finditer(path))
    return tuple(name or (None if place == "*" else int(place)) for name, place in found)


class _Compiler:
    """Reads a definition once and writes the program."""

    def __init__(self, definitions: Definitions, names: FieldNames, wanted: Sequence[str], *, cdr: bool) -> None:
        self._definitions, self._names = definitions, names
        self._wanted = frozenset(wanted)
        self.cdr = cdr
        self.program: list[Operation] = []
        self.slots: dict[str, Slot] = {}
        self.fields = self._depth = self._loops = self.taken = self._numbers_taken = 0

    def message(self, name: str, prefix: str) -> None:
        """Write the fields of message type `name`."""
        if name not in self._definitions:
            raise DefinitionError(name, "its definition is not in the log and not bundled")
        if self._depth >= DEEPEST:
            raise DefinitionError(name, f"its definition nests more than {DEEPEST} messages", "this type is not read")
        self._depth += 1
        for named, (node, detail) in self._definitions[name][1]:
            self.fields += 1
            if self.fields > MOST_FIELDS:
                raise DefinitionError(name, f"its definition has more than {MOST_FIELDS} fields", "it is not read")
            path = f"{prefix}{named}"
            self._names.add(path)
            if node == NAME:
                self.message(detail, f"{path}.")
            elif node == BASE:
                self._base(path, detail[0])
            else:
                (element, inner), length = detail
                count = length if node == ARRAY else COUNTED
                if count > LONGEST_FIXED:
                    raise DefinitionError(path, "its definition has an array longer than a message can be")
                if element == BASE and inner[0] in SIZES:
                    self._array(path, inner[0], count)
                else:
                    self._loop(f"{path}[*]", element, inner, count)
        self._depth -= 1

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
        self.slots[path] = Slot(kind, self.taken)
        self.taken += 1
        return self.taken - 1

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
        if not self.cdr:
            size, count = 1, size * count
        last = self.program[-1] if self.program else None
        if last is not None and last[:2] == (NUMBERS, size) and last.number != COUNTED and last.slot < 0:
            self.program[-1] = last._replace(number=last.number + count)
        else:
            self.program.append(Operation(NUMBERS, size, count, -1))


def compile_layout(
    definitions: Definitions,
    message_type: str,
    wanted: Sequence[str],
    encoding: Literal["cdr", "ros1"],
) -> Layout:
    """Compile the layout of a message type.

    Parameters
    ----------
    definitions : definitions of the type and of all types in it
    message_type : ``package/Name``
    wanted : paths such as ``header.stamp.sec``, ``orientation_covariance[0]``, ``position[*]``,
        ``drivers[*].measured_travel``; paths that the type does not have get no slot. For a sequence in each element of
        a sequence (``a[*].b[*]``) all elements come in a row; ``a[*].b[#]`` are the lengths of the inner sequences

    Raises
    ------
    DefinitionError
        The definition of a type in it is missing, or a field has a type that cannot be skipped.
    """
    package, _, name = message_type.partition("/")
    compiler = _Compiler(definitions, FieldNames(message_type), wanted, cdr=encoding == "cdr")
    compiler.message(f"{package}/msg/{name}", "")
    program = compiler.program
    while program and not program[-1].takes:
        program.pop()
    return Layout(tuple(program), compiler.slots, compiler.taken, compiler.cdr, compiler.fields)
