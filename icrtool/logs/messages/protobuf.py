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
from icrtool.logs.messages.schema import BASE, DEEPEST, MOST_ELEMENTS, MOST_FIELDS, NAME, SEQUENCE, Definitions, Step

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

_MESSAGE, _STRING, _REPEATED = 11, 9, 3
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
    """Bytes are no message: a field does not end, or is of an unknown wire type."""


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


class _DescriptorReader:
    """Reads the message types of a FileDescriptorSet."""

    def __init__(self) -> None:
        self.found: dict[str, list[ProtobufField]] = {}
        self._left = MOST_FIELDS

    def files(self, data: bytes) -> None:
        for number, wire, begin, end in _wire_fields(data, 0, len(data)):
            if (number, wire) == (1, _BYTES):
                self._file(data[begin:end])

    def _parts(self, data: bytes) -> dict[int, list[Any]]:
        """Return the values of a descriptor's fields by number: bytes, or numbers."""
        parts: dict[int, list[Any]] = {}
        for number, wire, begin, end in _wire_fields(data, 0, len(data)):
            self._left -= 1
            if self._left < 0:
                raise _UnreadableError
            parts.setdefault(number, []).append(begin if wire == _VARINT else data[begin:end])
        return parts

    def _file(self, data: bytes) -> None:
        parts = self._parts(data)
        package = _last_text(parts, 2)
        for message in parts.get(4, ()):
            self._message(message, f"{package}." if package else "", 0, implicit=_last_text(parts, 12) == "proto3")

    def _message(self, data: bytes, prefix: str, depth: int, *, implicit: bool) -> None:
        if depth > DEEPEST:
            raise _UnreadableError
        parts = self._parts(data)
        name = f"{prefix}{_last_text(parts, 1)}"
        self.found[name] = [self._field(one, implicit=implicit) for one in parts.get(2, ())]
        for nested in parts.get(3, ()):
            self._message(nested, f"{name}.", depth + 1, implicit=implicit)

    def _field(self, data: bytes, *, implicit: bool) -> ProtobufField:
        parts = self._parts(data)
        number, label, kind = (one[-1] if (one := parts.get(part)) else 0 for part in (3, 4, 5))
        if not all(isinstance(one, int) for one in (number, label, kind)):
            raise _UnreadableError
        in_group = bool(parts.get(9))  # of a oneof, which `optional` makes too
        refers = _last_text(parts, 6).removeprefix(".")
        return ProtobufField(_last_text(parts, 1), number, kind, refers, label == _REPEATED, implicit and not in_group)


def _last_text(parts: Mapping[int, list[Any]], number: int) -> str:
    found = parts.get(number)
    if found is None:
        return ""
    if not isinstance(found[-1], bytes):
        raise _UnreadableError
    return found[-1].decode("utf-8", "replace")


@lru_cache(maxsize=64)
def descriptors_of(text: str, message_type: str) -> Descriptors:
    """Return the message types of a channel.

    Parameters
    ----------
    text : the FileDescriptorSet, a character for each byte

    Raises
    ------
    DefinitionError
        It cannot be read, is too large, or lacks the type.
    """
    if len(text) > LONGEST_DESCRIPTORS:
        raise DefinitionError(message_type, f"the schema in the log has more than {LONGEST_DESCRIPTORS} bytes")
    reader = _DescriptorReader()
    try:
        reader.files(text.encode("latin-1"))
    except (_UnreadableError, IndexError) as err:
        why = f"the schema in the log is no FileDescriptorSet, or has more than {MOST_FIELDS} parts"
        raise DefinitionError(message_type, why) from err
    if message_type not in reader.found:
        raise DefinitionError(message_type, "the schema in the log lacks it")
    return reader.found


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


@dataclass(slots=True)
class _Node:
    """The wanted fields of a message: by number, each with those of the message in it; and values of lacking ones."""

    fields: dict[int, tuple[ProtobufField, _Node | None]] = field(default_factory=dict)
    default: dict[str, Any] = field(default_factory=dict)


class ProtobufParser:
    """Takes the wanted fields of messages of one type.

    Parameters
    ----------
    paths : steps to each wanted field
    """

    def __init__(self, descriptors: Descriptors, message_type: str, paths: Sequence[Sequence[Step]]) -> None:
        self._descriptors = descriptors
        self._root = self._node(message_type, paths)
        self._left = 0

    def _node(self, name: str, paths: Sequence[Sequence[Step]]) -> _Node:
        rests: dict[Step, list[Sequence[Step]]] = {}
        for path in paths:
            behind = path[1:] if len(path) < 2 or isinstance(path[1], str) else path[2:]
            rests.setdefault(path[0], []).append(behind)
        node = _Node()
        for one in self._descriptors.get(name, ()):
            if one.name in rests and (one.type in KINDS or one.type == _MESSAGE):
                inner = self._node(one.refers, [rest for rest in rests[one.name] if rest])
                node.fields[one.number] = (one, inner if one.type == _MESSAGE else None)
                if one.is_default and not one.repeated and one.type != _MESSAGE:
                    node.default[one.name] = "" if one.type == _STRING else 0
        return node

    def parse(self, data: bytes) -> dict[str, Any] | None:
        """Return the wanted values of a message, None where it cannot be read."""
        self._left = MOST_WIRE_FIELDS
        try:
            return self._message(data, 0, len(data), self._root, dict(self._root.default))
        except (_UnreadableError, IndexError):
            return None

    def _message(self, data: bytes, at: int, stop: int, node: _Node, into: dict[str, Any]) -> dict[str, Any]:
        for number, wire, begin, end in _wire_fields(data, at, stop):
            self._left -= 1
            if self._left < 0:
                raise _UnreadableError
            if number not in node.fields:
                continue
            one, inner = node.fields[number]
            if inner is not None:
                if wire != _BYTES:
                    raise _UnreadableError
                before = None if one.repeated else into.get(one.name)
                found = self._message(data, begin, end, inner, dict(inner.default) if before is None else before)
                values = [found]
            else:
                values = _values(data, one, wire, begin, end)
            if not one.repeated:
                into[one.name] = values[-1]
            elif len(kept := into.setdefault(one.name, [])) < MOST_ELEMENTS:
                kept += values
        return into


def _values(data: bytes, one: ProtobufField, wire: int, begin: int, end: int) -> list[Any]:
    """Return the values of a field that holds no messages: one, or several that are packed."""
    if one.type == _STRING:
        if wire != _BYTES:
            raise _UnreadableError
        return [data[begin:end].decode("utf-8", "replace")]
    if one.type in _FIXED:
        fixed, single = _FIXED[one.type]
        if wire == single:
            return [*fixed.unpack_from(data, begin)]
        if wire != _BYTES or not one.repeated:
            raise _UnreadableError
        end = min(end - (end - begin) % fixed.size, begin + MOST_ELEMENTS * fixed.size)
        return [value for (value,) in fixed.iter_unpack(data[begin:end])]
    if wire == _VARINT:
        return [_of_varint(begin, one.type)]
    if wire != _BYTES or not one.repeated:
        raise _UnreadableError
    found: list[Any] = []
    while begin < end and len(found) < MOST_ELEMENTS:
        value, begin = _varint(data, begin)
        found.append(_of_varint(value, one.type))
    return found


def _of_varint(value: int, kind: int) -> int:
    if kind in _ZIGZAG:
        return value >> 1 ^ -(value & 1)
    return value - (1 << 64) if kind in _SIGNED and value >> 63 else value
