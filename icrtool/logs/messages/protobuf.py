"""Messages in Protobuf: the schema that a channel carries, and the values at the wanted fields of each message.

The wire format is read here, by https://protobuf.dev/programming-guides/encoding, and not by Google's library: what is
needed of it are four kinds of fields, the limits stay this package's, and nothing of a log becomes a class or is looked
up in a registry. Only wanted fields are followed, so that a message nests no deeper than a path is long.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from struct import Struct
from typing import Any, NamedTuple

from icrtool.errors import DefinitionError
from icrtool.logs.messages.definitions import (
    BASE,
    DEEPEST,
    MOST_ELEMENTS,
    MOST_FIELDS,
    NAME,
    SEQUENCE,
    Definitions,
    Step,
)
from icrtool.records.text import LONGEST_TEXT, LogText

LONGEST_DESCRIPTORS = 1 << 20
"""Bytes of a FileDescriptorSet; that of all schemas of Foxglove has 60,000."""

MOST_WIRE_FIELDS = 1 << 14
"""Fields in a message, those that are passed over too: real ones have some tens."""

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
"""Wire types; 3 and 4 are groups, which nothing has used since 2008 and which are not read."""

KINDS = {
    1: "float64", 2: "float32", 3: "int64", 4: "uint64", 5: "int32", 6: "uint64", 7: "uint32", 8: "bool", 9: "string",
    13: "uint32", 14: "int32", 15: "int32", 16: "int64", 17: "int32", 18: "int64",
}  # fmt: skip
"""By the number of a type in FieldDescriptorProto; 14 is an enumeration. Groups and bytes are not read."""

_MESSAGE, _STRING, _INT32, _REPEATED = 11, 9, 5, 3
_FIXED = {
    1: (Struct("<d"), _FIXED64), 2: (Struct("<f"), _FIXED32), 6: (Struct("<Q"), _FIXED64),
    7: (Struct("<I"), _FIXED32), 15: (Struct("<i"), _FIXED32), 16: (Struct("<q"), _FIXED64),
}  # fmt: skip
"""By the number of a type: how a number of it is packed, and its wire type."""

_SIGNED, _ZIGZAG = (3, 5, 14), (17, 18)


class ProtobufField(NamedTuple):
    """A field of a message type.

    Attributes
    ----------
    number, type : as FieldDescriptorProto has them
    refers : the message type of a field that holds one
    is_default : whether a message that lacks it means 0 or an empty text
    """

    name: str
    number: int
    type: int
    refers: str
    repeated: bool
    is_default: bool


Descriptors = Mapping[str, Sequence[ProtobufField]]
"""Fields by the full name of their message type."""


class _UnreadableError(Exception):
    """Bytes are no message: a field does not end, or its wire type is none that is read."""


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number of one to ten bytes, and the offset behind it."""
    value = shift = 0
    while shift < 70:
        byte = data[at]
        value, at, shift = value | (byte & 0x7F) << shift, at + 1, shift + 7
        if byte < 0x80:
            return value & (1 << 64) - 1, at
    raise _UnreadableError


def _wire_fields(data: bytes, at: int, stop: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield number, wire type, and the range of each field: of a varint, its value and the offset behind it."""
    while at < stop:
        tag, at = (data[at], at + 1) if data[at] < 0x80 else _varint(data, at)
        number, wire = tag >> 3, tag & 7
        begin = at
        if wire == _VARINT:
            begin, at = _varint(data, at)
        elif wire == _BYTES:
            length, begin = (data[at], at + 1) if data[at] < 0x80 else _varint(data, at)
            at = begin + length
        elif wire in (_FIXED64, _FIXED32):
            at += 8 if wire == _FIXED64 else 4
        else:
            raise _UnreadableError
        if at > stop:
            raise _UnreadableError
        yield number, wire, begin, at


@dataclass(slots=True)
class WantedFields:
    """The wanted fields of a message.

    Attributes
    ----------
    fields : by number, each with those of the message in it
    default : values of lacking ones
    """

    fields: dict[int, tuple[ProtobufField, WantedFields | None]] = field(default_factory=dict)
    default: dict[str, Any] = field(default_factory=dict)

    def add(self, name: str, number: int, kind: int, inner: WantedFields | None = None) -> None:
        """Add a field of a descriptor; those that hold messages are repeated."""
        self.fields[number] = ProtobufField(name, number, kind, "", inner is not None, is_default=False), inner


def _descriptor_set() -> WantedFields:
    """Return the wanted fields of a FileDescriptorSet, as google/protobuf/descriptor.proto has them.

    Of types within one another there is one more level than is read: it shows that there are too many.
    """
    files, file, described = WantedFields(), WantedFields(), WantedFields()
    for name, number in {"name": 1, "type_name": 6}.items():
        described.add(name, number, _STRING)
    for name, number in {"number": 3, "label": 4, "type": 5, "oneof_index": 9}.items():
        described.add(name, number, _INT32)
    message = WantedFields()
    message.add("name", 1, _STRING)
    for _ in range(DEEPEST):
        nested, message = message, WantedFields()
        message.add("name", 1, _STRING)
        message.add("field", 2, _MESSAGE, described)
        message.add("nested_type", 3, _MESSAGE, nested)
    file.add("package", 2, _STRING)
    file.add("message_type", 4, _MESSAGE, message)
    file.add("syntax", 12, _STRING)
    files.add("file", 1, _MESSAGE, file)
    return files


@lru_cache(maxsize=64)
def descriptors_of(text: str, message_type: str) -> Descriptors:
    """Return the message types of a channel.

    Parameters
    ----------
    text : the FileDescriptorSet, a character for each byte

    Raises
    ------
    DefinitionError
        It cannot be read, is too large, nests too many types, has too long a name, or lacks the type.
    """
    if len(text) > LONGEST_DESCRIPTORS:
        raise DefinitionError(message_type, f"the schema in the log has more than {LONGEST_DESCRIPTORS} bytes")
    found: dict[str, list[ProtobufField]] = {}
    described = ProtobufParser(_descriptor_set(), MOST_FIELDS, MOST_FIELDS).parse(text.encode("latin-1"))
    if described is None:
        why = f"the schema in the log is no FileDescriptorSet, or has more than {MOST_FIELDS} parts"
        raise DefinitionError(message_type, why)
    for file in described.get("file", ()):
        package = file.get("package", "")
        is_implicit = file.get("syntax") == "proto3"
        _add_types(found, file.get("message_type", ()), f"{package}." if package else "", 1, is_implicit=is_implicit)
    if message_type not in found:
        raise DefinitionError(message_type, "the schema in the log lacks it")
    return found


def _add_types(
    found: dict[str, list[ProtobufField]],
    messages: Sequence[dict[str, Any]],
    prefix: str,
    depth: int,
    *,
    is_implicit: bool,
) -> None:
    """Add descriptors of messages, which lie in `depth` - 1 others, and of those within them."""
    for message in messages:
        name = f"{prefix}{message.get('name', '')}"
        # a name of megabytes before each of thousands of types would fill the memory
        if len(name) > LONGEST_TEXT:
            raise DefinitionError(LogText(name), f"its name has more than {LONGEST_TEXT} characters", "it is not read")
        if depth > DEEPEST:
            raise DefinitionError(LogText(name), f"it lies within more than {DEEPEST - 1} messages", "it is not read")
        found[name] = [
            ProtobufField(
                name=one.get("name", ""),
                number=one.get("number", 0),
                type=one.get("type", 0),
                refers=one.get("type_name", "").removeprefix("."),
                repeated=one.get("label") == _REPEATED,
                # `optional` makes a oneof, too
                is_default=is_implicit and "oneof_index" not in one,
            )
            for one in message.get("field", ())
        ]
        _add_types(found, message.get("nested_type", ()), f"{name}.", depth + 1, is_implicit=is_implicit)


def definitions_in(descriptors: Descriptors) -> Definitions:
    """Return message types as those of ROS are given; without fields of bytes or groups."""
    definitions: dict[str, tuple[Any, Any]] = {}
    for name, fields in descriptors.items():
        known: list[tuple[str, tuple[int, Any]]] = []
        for one in fields:
            if one.type in KINDS or one.type == _MESSAGE:
                kind = (NAME, one.refers) if one.type == _MESSAGE else (BASE, (KINDS[one.type], 0))
                known.append((one.name, (SEQUENCE, (kind, 0)) if one.repeated else kind))
        definitions[name] = ([], known)
    return definitions


def wanted_fields(descriptors: Descriptors, name: str, paths: Sequence[Sequence[Step]]) -> WantedFields:
    """Return the fields of a message type at the steps of each path."""
    rests: dict[Step, list[Sequence[Step]]] = {}
    for path in paths:
        behind = path[1:] if len(path) < 2 or isinstance(path[1], str) else path[2:]
        rests.setdefault(path[0], []).append(behind)
    node = WantedFields()
    for one in descriptors.get(name, ()):
        if one.name in rests and (one.type in KINDS or one.type == _MESSAGE):
            inner = wanted_fields(descriptors, one.refers, [rest for rest in rests[one.name] if rest])
            node.fields[one.number] = (one, inner if one.type == _MESSAGE else None)
            if one.is_default and not one.repeated and one.type != _MESSAGE:
                node.default[one.name] = "" if one.type == _STRING else 0
    return node


@dataclass(slots=True)
class ProtobufParser:
    """Takes the wanted fields of messages.

    Attributes
    ----------
    most_fields, most_elements : of a message, and of one field; with more fields it is unreadable
    """

    wanted: WantedFields
    most_fields: int = MOST_WIRE_FIELDS
    most_elements: int = MOST_ELEMENTS
    _left: int = 0

    def parse(self, data: bytes) -> dict[str, Any] | None:
        """Return the wanted values of a message, None where it cannot be read."""
        self._left = self.most_fields
        try:
            return self._message(data, 0, len(data), self.wanted, dict(self.wanted.default))
        except (_UnreadableError, IndexError):
            return None

    def _message(self, data: bytes, at: int, stop: int, node: WantedFields, into: dict[str, Any]) -> dict[str, Any]:
        for number, wire, begin, end in _wire_fields(data, at, stop):
            self._left -= 1
            if self._left < 0:
                raise _UnreadableError
            if number not in node.fields:
                continue
            one, inner = node.fields[number]
            if inner is None:
                values = _values(data, one, wire, begin, end)
            elif wire == _BYTES:
                before = None if one.repeated else into.get(one.name)
                values = [self._message(data, begin, end, inner, dict(inner.default) if before is None else before)]
            else:
                values = []
            if not values:
                # a field of another wire type than its own is passed over, as an unknown one is
                continue
            if not one.repeated:
                into[one.name] = values[-1]
            elif len(kept := into.setdefault(one.name, [])) < self.most_elements:
                kept += values
        return into


def _values(data: bytes, one: ProtobufField, wire: int, begin: int, end: int) -> list[Any]:
    """Return the values of a field that holds no messages: one, several that are packed, none of another wire type."""
    if one.type == _STRING:
        return [data[begin:end].decode("utf-8", "replace")] if wire == _BYTES else []
    is_packed = wire == _BYTES and one.repeated
    if one.type in _FIXED:
        fixed, single = _FIXED[one.type]
        if wire == single:
            return [*fixed.unpack_from(data, begin)]
        end = min(end - (end - begin) % fixed.size, begin + MOST_ELEMENTS * fixed.size)
        return [value for (value,) in fixed.iter_unpack(data[begin:end])] if is_packed else []
    found: list[int] = [begin] if wire == _VARINT else []
    if is_packed:
        while begin < end and len(found) < MOST_ELEMENTS:
            value, begin = _varint(data, begin)
            found.append(value)
    if one.type in _ZIGZAG:
        return [value >> 1 ^ -(value & 1) for value in found]
    return [value - (1 << 64) if one.type in _SIGNED and value >> 63 else value for value in found]
