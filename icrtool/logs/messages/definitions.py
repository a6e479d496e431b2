"""Message definitions, and their compilation into programs that find the wanted fields of a message.

A definition comes from the log (text, IDL, schema), else from the bundled vendor types, else from ROS 2 Humble. A
message has no index: the offset of a field depends on the strings and sequences before it. The program lists the bytes
to pass over and the fields to read; `icrtool.logs.messages.decoder` runs it over one message of each shape.
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
from icrtool.logs.messages.definition_bounds import MOST_FIELDS, NameBudget
from icrtool.logs.messages.definition_text import LONGEST_DEFINITION, full_name, parse_definition, plain_definition

NUMBERS, TEXT, LOOP = range(3)
"""Kinds of operations."""

Definitions = Mapping[str, tuple[Any, Any]]
"""Constants and fields of message types by ``package/msg/Name``, as rosbags parses them."""

FieldDetail: TypeAlias = Any
"""Type of a field as rosbags writes it: a primitive type with its length, a name, or the nested type of an array."""

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of field types, as the numbers of rosbags' ``Nodetype``."""

SIZES = {
    "bool": 1, "byte": 1, "char": 1, "octet": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2,
    "int32": 4, "uint32": 4, "int64": 8, "uint64": 8, "float32": 4, "float64": 8,
}  # fmt: skip
"""Sizes of the primitive types [bytes]."""

LONGEST_UNROLLED = 4096
"""Largest number of elements of a fixed array that is read. A covariance has 36."""

DEEPEST = 32
"""Largest depth of messages within one another. Real definitions have 6; a definition that refers to itself has no
end."""

LONGEST_FIXED = 1 << 31
"""Largest number of elements of a fixed array."""

MOST_NUMBERS = 1 << 16
"""Largest number of numbers that are read from a message."""

MOST_ELEMENTS = 256
"""Largest number of elements that are read from a sequence."""

MOST_TAKEN = 1024
"""Largest number of elements that are read from all inner sequences of a sequence of sequences together."""

Step = str | int | None
"""A step of a path: the name of a field, the index of an element, or None for all elements of a sequence."""

_STEP = re.compile(r"([^.\[\]]+)|\[(\d+|\*)\]")

COUNTED = -1
"""Stands for a number of elements that the message states before the elements."""


def ros_definitions(channel: Channel) -> Definitions:
    """Return the definitions of the type of a channel of ROS messages, and of all types in it.

    Raises
    ------
    DefinitionError
        The definition is neither in the log nor bundled, or the text in the log cannot be parsed.
    """
    return _known_definitions(channel.message_type, channel.definition, channel.definition_format, channel.encoding)[0]


def definition_note(channel: Channel) -> str:
    """Return the reason why the definition in the log of a channel's type is not used.

    The reason is empty where the definition is used, and where the log has none.
    """
    described = channel.message_type, channel.definition, channel.definition_format, channel.encoding
    return _known_definitions(*described)[1] if channel.encoding in ("cdr", "ros1") else ""


@lru_cache(maxsize=256)
def _known_definitions(
    message_type: str, text: str, written: Literal["msg", "idl"], encoding: str
) -> tuple[Definitions, str]:
    """Return the results of `ros_definitions` and of `definition_note` for a type; raise as `ros_definitions`."""
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
        if last in standard_definitions() and _is_truncated(types[last][1], known[last][1]):
            return {**known, **types, last: known[last]}, f"the definition in the log ends within {last}"
        if not problem:
            return {**known, **types}, ""
    if name not in known:
        raise DefinitionError(message_type, problem)
    return known, problem


def _without_last_line(text: str, written: Literal["msg", "idl"], message_type: str) -> Definitions:
    """Return the types of a definition text without its last line, which may be cut off; empty where unreadable."""
    before = plain_definition(text[: LONGEST_DEFINITION + 1], message_type).rstrip("\n").rpartition("\n")[0]
    try:
        return parse_definition(before, written, message_type) if written == "msg" and before else {}
    except DefinitionError:
        return {}


def _missing(definitions: Definitions, name: str) -> str:
    """Return the name of a type that is needed and not defined; empty where all needed types are defined."""
    pending, seen = [name], {name}
    while pending:
        name = pending.pop()
        if name not in definitions:
            return name
        for _, (node, detail) in definitions[name][1]:
            inner = detail[0] if int(node) > NAME else (node, detail)
            if int(inner[0]) == NAME and inner[1] not in seen:
                seen.add(inner[1])
                pending.append(inner[1])
    return ""


def _is_truncated(fields: Sequence[Any], whole: Sequence[Any]) -> bool:
    """Return whether fields are the first fields of a type with more fields; the last name may be incomplete."""
    if not fields:
        return bool(whole)
    *complete, (last, last_type) = fields
    if complete != list(whole[: len(complete)]) or len(complete) == len(whole):
        # A last name in capitals is a constant whose value is missing.
        return last.isupper() and complete == list(whole)
    name, name_type = whole[len(complete)]
    return last.isupper() or (name_type == last_type and name.startswith(last) and list(fields) != list(whole))


def primitive_type_at(definitions: Definitions, name: str, steps: Sequence[Step]) -> str | None:
    """Return the primitive type of the field at the end of some steps; None where a type has no such field.

    Parameters
    ----------
    name : ``package/msg/Name`` of the type at which the steps begin
    """
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
    """Return the definitions of vendor types that icrtool bundles (sources: ``definitions/SOURCES.md``)."""
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
    """Return the definitions of the types that ROS 2 Humble contains."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE).fielddefs


@cache
def bundled_for(encoding: str) -> Definitions:
    """Return all definitions that a log need not contain, with the fields of ROS 1 Noetic or of ROS 2 Humble."""
    from rosbags.typesys import Stores, get_typestore

    definitions = {**standard_definitions(), **bundled_definitions()}
    if encoding == "ros1":
        definitions |= get_typestore(Stores.ROS1_NOETIC).fielddefs
        definitions["tf/msg/tfMessage"] = definitions["tf2_msgs/msg/TFMessage"]
    return definitions


class Operation(NamedTuple):
    """An operation of a program: it reads or passes over numbers, a text, or the elements of a loop.

    Attributes
    ----------
    kind : `NUMBERS`, `TEXT` or `LOOP`
    size : size of one number [bytes]
    element_count : number of numbers or of elements, or `COUNTED`
    slot : index of the slot for the values, -1 where they are passed over
    counter : index of the slot for a counted number of elements, -1 where it is passed over
    body : operations for each element of a loop
    is_constant : the body counts nothing and has no slot, so that all elements but the first have the same size
    """

    kind: int
    size: int
    element_count: int
    slot: int
    counter: int = -1
    body: tuple[Operation, ...] = ()
    is_constant: bool = False

    @property
    def takes(self) -> bool:
        """Whether the operation reads any field into a slot."""
        return self.slot >= 0 or self.counter >= 0 or any(operation.takes for operation in self.body)


class Slot(NamedTuple):
    """A wanted field: its primitive type (or ``string``), and the index of its slot."""

    kind: str
    slot_index: int


@dataclass(frozen=True, slots=True)
class Layout:
    """A program that finds the wanted fields in the messages of one type.

    Attributes
    ----------
    program : operations in the order of the fields
    slots : wanted fields by path; if a definition has a field twice, the second one
    slot_count : number of slots of the program
    cdr : whether the messages are CDR, in which numbers are aligned; otherwise ROS 1
    fields : number of fields of the type, with the types in it
    """

    program: tuple[Operation, ...]
    slots: dict[str, Slot]
    slot_count: int
    cdr: bool
    fields: int = 0


def decoding_steps(path: str) -> tuple[Step, ...]:
    """Return the steps of a path such as ``joints[*].name`` or ``position_covariance[4]``."""
    found = (match.groups() for match in _STEP.finditer(path))
    return tuple(name or (None if element == "*" else int(element)) for name, element in found)


class _Compiler:
    """Compiler of one message type: it reads the definition once and writes the program."""

    def __init__(self, definitions: Definitions, names: NameBudget, wanted: Sequence[str], *, cdr: bool) -> None:
        self._definitions, self._names = definitions, names
        self._wanted = frozenset(wanted)
        self.cdr = cdr
        self.program: list[Operation] = []
        self.slots: dict[str, Slot] = {}
        self.fields = self._depth = self._loops = self.slot_count = self._wanted_numbers = 0

    def add_message(self, name: str, prefix: str) -> None:
        """Write operations for the fields of message type `name`, whose paths begin with `prefix`."""
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
                self.add_message(detail, f"{path}.")
            elif node == BASE:
                self._add_field(path, detail[0])
            else:
                (element, inner), length = detail
                count = length if node == ARRAY else COUNTED
                if count > LONGEST_FIXED:
                    raise DefinitionError(path, "its definition has an array longer than a message can be")
                if element == BASE and inner[0] in SIZES:
                    self._add_array(path, inner[0], count)
                else:
                    self._add_loop(f"{path}[*]", element, inner, count)
        self._depth -= 1

    def _add_field(self, path: str, primitive: str) -> None:
        """Write an operation for a single number or text."""
        if primitive == "string":
            self.program.append(
                Operation(TEXT, 0, COUNTED, self._new_slot(path, primitive) if path in self._wanted else -1)
            )
        elif primitive not in SIZES:
            raise DefinitionError(path, f"field type {primitive} is not read", "only its message type is affected")
        elif path in self._wanted:
            self.program.append(Operation(NUMBERS, SIZES[primitive], 1, self._new_slot(path, primitive)))
        else:
            self._add_skip(SIZES[primitive], 1)

    def _new_slot(self, path: str, primitive: str, count: int = 1) -> int:
        """Return the index of a new slot for a field of up to `count` numbers or texts."""
        if path.count("[*]") > 2:
            raise DefinitionError(path, "a sequence in each element of a sequence of sequences is not read")
        nested = path.count("[*]") > 1
        self._wanted_numbers += MOST_TAKEN if nested else count * (MOST_ELEMENTS if self._loops else 1)
        if self._wanted_numbers > MOST_NUMBERS:
            raise DefinitionError("message", f"more than {MOST_NUMBERS} numbers of each message would be read")
        self.slots[path] = Slot(primitive, self.slot_count)
        self.slot_count += 1
        return self.slot_count - 1

    def _add_array(self, path: str, primitive: str, count: int) -> None:
        """Write operations for an array (of fixed length) or a sequence of numbers."""
        size, every_element = SIZES[primitive], f"{path}[*]"
        is_wanted = any(name.startswith(f"{path}[") for name in self._wanted)
        if count > LONGEST_UNROLLED and is_wanted:
            raise DefinitionError(path, f"an array of {count} numbers is not read")
        if every_element in self._wanted:
            slot = self._new_slot(every_element, primitive, MOST_ELEMENTS if count == COUNTED else count)
            self.program.append(Operation(NUMBERS, size, count, slot, self._new_counter(path)))
        elif count == COUNTED:
            self.program.append(Operation(NUMBERS, size, COUNTED, -1))
        elif is_wanted:
            for i in range(count):
                self._add_field(f"{path}[{i}]", primitive)
        else:
            self._add_skip(size, count)

    def _new_counter(self, path: str) -> int:
        """Return the index of a new slot for the number of elements of a sequence, -1 where it is not wanted."""
        return self._new_slot(f"{path}[#]", "uint32") if f"{path}[#]" in self._wanted else -1

    def _add_loop(self, path: str, element: int, inner: FieldDetail, count: int) -> None:
        """Write a loop over the elements of an array or sequence of strings or messages."""
        outer, self.program, counter = self.program, [], self._new_counter(path.removesuffix("[*]"))
        self._loops += 1
        if element == BASE:
            self._add_field(path, inner[0])
        else:
            self.add_message(inner, f"{path}.")
        self._loops -= 1
        body, self.program = tuple(self.program), outer
        is_constant = all(operation.element_count != COUNTED and operation.slot < 0 for operation in body)
        is_constant = is_constant and all(operation.is_constant for operation in body if operation.kind == LOOP)
        self.program.append(Operation(LOOP, 0, count, -1, counter, body, is_constant))

    def _add_skip(self, size: int, count: int) -> None:
        """Write an operation that passes over numbers, or extend the last operation by them."""
        if not self.cdr:
            size, count = 1, size * count
        last = self.program[-1] if self.program else None
        if last is not None and last[:2] == (NUMBERS, size) and last.element_count != COUNTED and last.slot < 0:
            self.program[-1] = last._replace(element_count=last.element_count + count)
        else:
            self.program.append(Operation(NUMBERS, size, count, -1))


def compile_layout(
    definitions: Definitions,
    message_type: str,
    wanted: Sequence[str],
    encoding: Literal["cdr", "ros1"],
) -> Layout:
    """Return the layout of the messages of a type.

    Parameters
    ----------
    definitions : definitions of the type and of all types in it
    message_type : ``package/Name``
    wanted : paths of fields, such as ``header.stamp.sec``, ``orientation_covariance[0]``, ``position[*]`` (all
        elements) and ``drivers[*].measured_travel``; a path that the type does not have gets no slot. For a sequence in
        each element of a sequence, ``a[*].b[*]`` are the elements of all inner sequences in one row, and ``a[*].b[#]``
        the lengths of the inner sequences
    encoding : serialization of the messages

    Raises
    ------
    DefinitionError
        The definition of a type is missing, a field has a type that cannot be passed over, or a limit is exceeded.
    """
    package, _, name = message_type.partition("/")
    compiler = _Compiler(definitions, NameBudget(message_type), wanted, cdr=encoding == "cdr")
    compiler.add_message(f"{package}/msg/{name}", "")
    program = compiler.program
    while program and not program[-1].takes:
        program.pop()
    return Layout(tuple(program), compiler.slots, compiler.slot_count, compiler.cdr, compiler.fields)
