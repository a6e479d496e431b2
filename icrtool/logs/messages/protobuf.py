"""Protobuf messages: their schema in the log, and a parser of the wanted fields.

Google's library parses both. It gets a message type that has only the wanted fields, along each path separately, so
that it passes over all other fields. With all fields of a schema, a message of 1 MB that contains many empty messages
could take gigabytes of memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

from icrtool.errors import DefinitionError
from icrtool.logs.messages.definition_bounds import MOST_FIELDS, NameBudget
from icrtool.logs.messages.definitions import (
    BASE,
    DEEPEST,
    MOST_ELEMENTS,
    NAME,
    SEQUENCE,
    Definitions,
    Step,
)
from icrtool.records.text import LogText

if TYPE_CHECKING:
    from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorProto

LONGEST_DESCRIPTORS = 1 << 20
"""Largest size of a FileDescriptorSet [bytes]. The set of all schemas of Foxglove has 60,000."""

SCALAR_TYPES = {
    1: "float64", 2: "float32", 3: "int64", 4: "uint64", 5: "int32", 6: "uint64", 7: "uint32", 8: "bool", 9: "string",
    13: "uint32", 14: "int32", 15: "int32", 16: "int64", 17: "int32", 18: "int64",
}  # fmt: skip
"""Primitive type of each type number of FieldDescriptorProto; 14 is an enumeration. Groups and bytes are not read."""

_MESSAGE_TYPE, _OPTIONAL, _REPEATED = 11, 1, 3
_READ_AS = {9: 12, 14: 5}
"""Type numbers that are read as another type: texts as bytes, because they may be no UTF-8; enumerations as int32."""


class ProtobufField(NamedTuple):
    """A field of a message type.

    Attributes
    ----------
    number, type : field number and type number of FieldDescriptorProto
    refers : full name of the message type of the field; empty for a primitive type
    repeated : whether the field is a list
    is_default : whether a message without the field states 0 or an empty text
    """

    name: str
    number: int
    type: int
    refers: str
    repeated: bool
    is_default: bool


Descriptors = Mapping[str, Sequence[ProtobufField]]
"""Readable fields of message types, by the full name of the message type."""


@lru_cache(maxsize=64)
def descriptors_of(text: str, message_type: str) -> Descriptors:
    """Return the message types in the schema of a channel.

    Parameters
    ----------
    text : the FileDescriptorSet, one character for each byte
    message_type : full name of the channel's message type

    Raises
    ------
    DefinitionError
        The schema cannot be read, is too large, nests too many types, has too long names, or lacks the message type.
    """
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.message import DecodeError

    if len(text) > LONGEST_DESCRIPTORS:
        raise DefinitionError(message_type, f"the schema in the log has more than {LONGEST_DESCRIPTORS} bytes")
    try:
        files = FileDescriptorSet.FromString(text.encode("latin-1")).file
    except (DecodeError, UnicodeDecodeError, RecursionError) as err:
        raise DefinitionError(message_type, "the schema in the log is no FileDescriptorSet") from err
    descriptors: dict[str, list[ProtobufField]] = {}
    parts, names = 0, NameBudget(message_type)
    for file in files[:MOST_FIELDS]:
        prefix = f"{_name(file.package)}." if file.package else ""
        for name, message in _types_in(file.message_type, prefix, 1, names):
            parts += 1 + len(message.field)
            if parts > MOST_FIELDS:
                raise DefinitionError(message_type, f"the schema in the log has more than {MOST_FIELDS} parts")
            for field in message.field:
                names.add(name, _name(field.name))
                names.add(_name(field.type_name))
            descriptors[name] = [
                ProtobufField(
                    name=_name(field.name),
                    number=field.number,
                    type=field.type,
                    refers=_name(field.type_name).removeprefix("."),
                    repeated=field.label == _REPEATED,
                    # A field that is `optional` is in a oneof, too.
                    is_default=file.syntax == "proto3" and not field.HasField("oneof_index"),
                )
                for field in message.field
                if field.HasField("type") and (field.type in SCALAR_TYPES or field.type == _MESSAGE_TYPE)
            ]
    if message_type not in descriptors:
        raise DefinitionError(message_type, "the schema in the log does not contain this type")
    return descriptors


def _name(text: str | bytes) -> str:
    """Return a name in a descriptor as text; the library returns bytes for a name that is no UTF-8."""
    return text.decode("utf-8", "replace") if isinstance(text, bytes) else text


def _types_in(
    messages: Iterable[DescriptorProto], prefix: str, depth: int, names: NameBudget
) -> Iterator[tuple[str, DescriptorProto]]:
    """Yield the message types at a depth, and the message types in them, with their full names.

    Raises
    ------
    DefinitionError
        A message type lies in more than `DEEPEST` others, or its name is too long.
    """
    for message in messages:
        name = f"{prefix}{_name(message.name)}"
        names.add(name)
        if depth > DEEPEST:
            raise DefinitionError(LogText(name), f"it lies within more than {DEEPEST - 1} messages", "it is not read")
        yield name, message
        yield from _types_in(message.nested_type, f"{name}.", depth + 1, names)


def definitions_in(descriptors: Descriptors) -> Definitions:
    """Return Protobuf message types in the form of ROS definitions."""
    definitions: dict[str, tuple[Any, Any]] = {}
    for name, fields in descriptors.items():
        known: list[tuple[str, tuple[int, Any]]] = []
        for field in fields:
            field_type = (NAME, field.refers) if field.type == _MESSAGE_TYPE else (BASE, (SCALAR_TYPES[field.type], 0))
            known.append((field.name, (SEQUENCE, (field_type, 0)) if field.repeated else field_type))
        definitions[name] = ([], known)
    return definitions


def protobuf_parser(
    descriptors: Descriptors, message_type: str, paths: Iterable[Sequence[Step]]
) -> Callable[[bytes], object]:
    """Return a function that parses the fields of a message along each path; it returns None for an unreadable message.

    Raises
    ------
    DefinitionError
        Two of the fields have the same name or number, or a name or number is not allowed.
    """
    from google.protobuf.descriptor_pb2 import FileDescriptorProto
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass

    file = FileDescriptorProto(name="wanted.proto", syntax="proto3")
    wanted, pool = _add_wanted(file, descriptors, message_type, paths), DescriptorPool()
    try:
        pool.AddSerializedFile(file.SerializeToString())
        message_class = GetMessageClass(pool.FindMessageTypeByName(wanted))
    except TypeError as err:
        why = "the schema in the log has fields without a name or number of their own"
        raise DefinitionError(message_type, why) from err

    def parse(data: bytes) -> object:
        try:
            return message_class.FromString(data)
        except (DecodeError, RecursionError):
            return None

    return parse


def _add_wanted(
    file: FileDescriptorProto, descriptors: Descriptors, message_type: str, paths: Iterable[Sequence[Step]]
) -> str:
    """Add to a file a message type with the fields at the steps of each path, and return its name."""
    rests: dict[Step, list[Sequence[Step]]] = {}
    for path in paths:
        behind = path[1:] if len(path) < 2 or isinstance(path[1], str) else path[2:]
        rests.setdefault(path[0], []).append(behind)
    node = file.message_type.add(name=f"Wanted{len(file.message_type)}")
    for field in descriptors.get(message_type, ()):
        if field.name in rests:
            wanted_field = node.field.add(
                name=field.name, number=field.number, type=_READ_AS.get(field.type, field.type)
            )
            wanted_field.label = _REPEATED if field.repeated else _OPTIONAL
            if field.type == _MESSAGE_TYPE:
                inner = [rest for rest in rests[field.name] if rest]
                wanted_field.type_name = _add_wanted(file, descriptors, field.refers, inner)
            elif not field.repeated and not field.is_default:
                wanted_field.proto3_optional, wanted_field.oneof_index = True, len(node.oneof_decl)
                node.oneof_decl.add(name=f"_{field.name}")
    return str(node.name)


def field_of(message: Any, name: str) -> object:  # noqa: ANN401 - its class was made by the library
    """Return the value of a wanted field: a number, bytes, a message, or a list; None where the message lacks it."""
    value = getattr(message, name)
    is_plain = isinstance(value, (float, int, bytes))
    if is_plain and value:
        return value
    if message.DESCRIPTOR.fields_by_name[name].has_presence:
        return value if message.HasField(name) else None
    return value if is_plain else value[:MOST_ELEMENTS]
