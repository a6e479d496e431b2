"""Messages in Protobuf: the schema that a channel carries, and what reads the wanted fields of its messages.

Google's library reads both. The type with which it reads a message has only the wanted fields, along each path
separately. All other fields of a message are unknown to it, and it passes over them. With all fields of a schema, a
message of 1 MB with many empty messages in it could take gigabytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

from icrtool.errors import DefinitionError
from icrtool.logs.messages.definition_bounds import MOST_FIELDS, FieldNames
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
"""Largest size of a FileDescriptorSet [bytes]; the set of all schemas of Foxglove has 60,000."""

SCALAR_TYPES = {
    1: "float64", 2: "float32", 3: "int64", 4: "uint64", 5: "int32", 6: "uint64", 7: "uint32", 8: "bool", 9: "string",
    13: "uint32", 14: "int32", 15: "int32", 16: "int64", 17: "int32", 18: "int64",
}  # fmt: skip
"""Primitive types by their numbers in FieldDescriptorProto; 14 is an enumeration. Groups and bytes are not read."""

_MESSAGE_TYPE, _OPTIONAL, _REPEATED = 11, 1, 3
_READ_AS = {9: 12, 14: 5}
"""Types that are read as another type: texts as bytes, because they may be no UTF-8, enumerations as int32."""


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
"""Fields that can be read, by the full name of their message type."""


@lru_cache(maxsize=64)
def descriptors_of(text: str, message_type: str) -> Descriptors:
    """Return the message types of a channel.

    Parameters
    ----------
    text : the FileDescriptorSet, a character for each byte

    Raises
    ------
    DefinitionError
        It cannot be read, is too large, nests too many types, has too long a name or names, or lacks the type.
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
    parts, names = 0, FieldNames(message_type)
    for file in files[:MOST_FIELDS]:
        prefix = f"{_name(file.package)}." if file.package else ""
        for name, message in _types_in(file.message_type, prefix, 1, names):
            parts += 1 + len(message.field)
            if parts > MOST_FIELDS:
                raise DefinitionError(message_type, f"the schema in the log has more than {MOST_FIELDS} parts")
            for one in message.field:
                names.add(name, _name(one.name))
                names.add(_name(one.type_name))
            descriptors[name] = [
                ProtobufField(
                    name=_name(one.name),
                    number=one.number,
                    type=one.type,
                    refers=_name(one.type_name).removeprefix("."),
                    repeated=one.label == _REPEATED,
                    # `optional` makes a oneof, too
                    is_default=file.syntax == "proto3" and not one.HasField("oneof_index"),
                )
                for one in message.field
                if one.HasField("type") and (one.type in SCALAR_TYPES or one.type == _MESSAGE_TYPE)
            ]
    if message_type not in descriptors:
        raise DefinitionError(message_type, "the schema in the log lacks it")
    return descriptors


def _name(text: str | bytes) -> str:
    """Return a name of a descriptor; where it is no UTF-8, the library gives bytes."""
    return text.decode("utf-8", "replace") if isinstance(text, bytes) else text


def _types_in(
    messages: Iterable[DescriptorProto], prefix: str, depth: int, names: FieldNames
) -> Iterator[tuple[str, DescriptorProto]]:
    """Yield messages at a depth of `depth`, and the messages within them, with their full names."""
    for message in messages:
        name = f"{prefix}{_name(message.name)}"
        names.add(name)
        if depth > DEEPEST:
            raise DefinitionError(LogText(name), f"it lies within more than {DEEPEST - 1} messages", "it is not read")
        yield name, message
        yield from _types_in(message.nested_type, f"{name}.", depth + 1, names)


def definitions_in(descriptors: Descriptors) -> Definitions:
    """Return message types in the form of ROS types."""
    definitions: dict[str, tuple[Any, Any]] = {}
    for name, fields in descriptors.items():
        known: list[tuple[str, tuple[int, Any]]] = []
        for one in fields:
            kind = (NAME, one.refers) if one.type == _MESSAGE_TYPE else (BASE, (SCALAR_TYPES[one.type], 0))
            known.append((one.name, (SEQUENCE, (kind, 0)) if one.repeated else kind))
        definitions[name] = ([], known)
    return definitions


def protobuf_parser(
    descriptors: Descriptors, message_type: str, paths: Iterable[Sequence[Step]]
) -> Callable[[bytes], object]:
    """Return a function that reads a message's fields along each path; it returns None for an unreadable message.

    Raises
    ------
    DefinitionError
        Two of the fields have the same name or number, or one has none that is allowed.
    """
    from google.protobuf.descriptor_pb2 import FileDescriptorProto
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass

    file = FileDescriptorProto(name="wanted.proto", syntax="proto3")
    wanted, pool = _add_wanted(file, descriptors, message_type, paths), DescriptorPool()
    try:
        pool.AddSerializedFile(file.SerializeToString())
        kind = GetMessageClass(pool.FindMessageTypeByName(wanted))
    except TypeError as err:
        why = "the schema in the log has fields without a name or number of their own"
        raise DefinitionError(message_type, why) from err

    def parse(data: bytes) -> object:
        try:
            return kind.FromString(data)
        except (DecodeError, RecursionError):
            return None

    return parse


def _add_wanted(
    file: FileDescriptorProto, descriptors: Descriptors, message_type: str, paths: Iterable[Sequence[Step]]
) -> str:
    """Add a message type with the fields at the steps of each path, and return its name."""
    rests: dict[Step, list[Sequence[Step]]] = {}
    for path in paths:
        behind = path[1:] if len(path) < 2 or isinstance(path[1], str) else path[2:]
        rests.setdefault(path[0], []).append(behind)
    node = file.message_type.add(name=f"Wanted{len(file.message_type)}")
    for one in descriptors.get(message_type, ()):
        if one.name in rests:
            field = node.field.add(name=one.name, number=one.number, type=_READ_AS.get(one.type, one.type))
            field.label = _REPEATED if one.repeated else _OPTIONAL
            if one.type == _MESSAGE_TYPE:
                inner = [rest for rest in rests[one.name] if rest]
                field.type_name = _add_wanted(file, descriptors, one.refers, inner)
            elif not one.repeated and not one.is_default:
                field.proto3_optional, field.oneof_index = True, len(node.oneof_decl)
                node.oneof_decl.add(name=f"_{one.name}")
    return str(node.name)


def field_of(message: Any, name: str) -> object:  # noqa: ANN401 - its class was made by the library
    """Return what a message holds in a wanted field: a number, bytes, a message, or a list; None where it lacks it."""
    value = getattr(message, name)
    is_plain = isinstance(value, (float, int, bytes))
    if is_plain and value:
        return value
    if message.DESCRIPTOR.fields_by_name[name].has_presence:
        return value if message.HasField(name) else None
    return value if is_plain else value[:MOST_ELEMENTS]
