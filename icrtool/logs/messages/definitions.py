"""Message definitions: the log's own (text, IDL, schema), else the bundled vendor ones, else those of ROS 2 Humble."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import cache, lru_cache
from importlib import resources
from itertools import islice
from typing import Any, Literal

import orjson

from icrtool.errors import DefinitionError
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.protobuf import definitions_in, descriptors_of
from icrtool.logs.messages.schema import (
    ARRAY,
    BASE,
    DEEPEST,
    MOST_FIELDS,
    NAME,
    SEQUENCE,
    SIZES,
    Definitions,
    FieldDetail,
    Step,
)
from icrtool.records.text import LONGEST_NAME, shortened

LONGEST_SCHEMA = 1 << 20
"""Characters of a JSON schema."""

_KINDS = {"integer": "int64", "number": "float64", "boolean": "bool", "string": "string"}


@lru_cache(maxsize=64)
def definitions_in_schema(text: str, message_type: str) -> Definitions:
    """Return the message types of a channel's JSON schema, as those of ROS are given; none where it lists no fields.

    Raises
    ------
    DefinitionError
        The schema cannot be read, or is too large.
    """
    if len(text) > LONGEST_SCHEMA:
        raise DefinitionError(message_type, f"the schema in the log has more than {LONGEST_SCHEMA} characters")
    try:
        schema = orjson.loads(text) if text.strip() else {}
    except ValueError as err:
        raise DefinitionError(message_type, "the schema in the log is no JSON") from err
    definitions: dict[str, tuple[Any, Any]] = {}
    _add(definitions, message_type, schema, 0)
    if sum(len(fields) for _, fields in definitions.values()) > MOST_FIELDS:
        raise DefinitionError(message_type, f"its schema has more than {MOST_FIELDS} fields", "it is not read")
    return definitions


def _add(definitions: dict[str, tuple[Any, Any]], name: str, schema: object, depth: int) -> None:
    """Add the fields of an object, and the types of those that are objects."""
    properties = schema.get("properties") if isinstance(schema, dict) else None
    if not isinstance(properties, dict) or depth > DEEPEST:
        return
    fields: list[tuple[str, tuple[int, Any]]] = []
    definitions[name] = ([], fields)
    for field, described in properties.items():
        inner = f"{name}.{field}"
        kind = _kind(described)
        if kind == "array":
            described = described.get("items")  # noqa: PLW2901 - the elements are described as a field is
            kind = _kind(described)
            element = (NAME, inner) if kind == "object" else (BASE, (_KINDS.get(kind, "float64"), 0))
            fields.append((field, (SEQUENCE, (element, 0))))
        else:
            fields.append((field, (NAME, inner) if kind == "object" else (BASE, (_KINDS.get(kind, "float64"), 0))))
        if kind == "object":
            _add(definitions, inner, described, depth + 1)


def _kind(described: object) -> str:
    """Return the type that a schema states; empty where it states none, as of an enumeration, which is a number."""
    if not isinstance(described, dict):
        return ""
    kind = described.get("type", "object" if "properties" in described else None)
    kinds = [one for one in (kind if isinstance(kind, list) else [kind]) if one != "null"]
    return kinds[0] if kinds and isinstance(kinds[0], str) else ""


_SEPARATOR = "=" * 80 + "\n"
LONGEST_DEFINITION, MOST_TYPES = 1 << 18, 256
"""Limits for a message type with all types in it: characters and types. The longest bundled one has 6,000 and 12."""
LONGEST_IDL, MOST_NUMBERS = 1 << 16, 512
"""Characters and lengths, bounds and constants of a definition in IDL; the parser takes 5 ms for each number."""

MOST_NESTED = 3
"""Messages within one another in which a field of an unknown type is looked for."""

_COMMENT_OR_STRING = re.compile(r'(?://|#)[^\n]*|/\*.*?(?:\*/|\Z)|"(?:\\.|[^"\\])*(?:"|\Z)', re.DOTALL)
_ANNOTATION = re.compile(r"@\s*[\w:]+(?:\s*\([^()]*\))?")
_VALUE = re.compile(r"=(?!\s*\w+\s*;)[^;=]*")
_EXPRESSION = re.compile(r"[()+\-*/%|^&~]|<[^<>]*<[^<>]*<")

_TIME: Definitions = {
    f"builtin_interfaces/msg/{name}": ([], [("sec", (BASE, ("int32", 0))), ("nanosec", (BASE, ("uint32", 0)))])
    for name in ("Time", "Duration")
}
"""Time and duration: ROS 1 has no definitions of them; in ROS 2 a definition text may leave them out."""


def definitions_of(channel: Channel) -> Definitions:
    """Return the definitions that a channel's type needs.

    Raises
    ------
    DefinitionError
        Neither the log nor the bundle knows the type, or the log's text cannot be parsed.
    """
    if channel.encoding == "protobuf":
        return definitions_in(descriptors_of(channel.definition, channel.message_type))
    if channel.encoding == "json":
        return definitions_in_schema(channel.definition, channel.message_type)
    if channel.definition:
        types = {**_TIME, **_parse(channel.definition, channel.definition_format, channel.message_type)}
        return types if _is_complete(types) else {**standard_definitions(), **types}
    name = full_name(channel.message_type)
    if channel.encoding == "ros1":
        raise DefinitionError(channel.message_type, "its connection carries no definition")
    known = bundled_definitions()
    if name in known:
        return {**standard_definitions(), **known}
    if name in standard_definitions():
        return standard_definitions()
    raise DefinitionError(channel.message_type, "its definition is not in the log and not bundled")


def number_fields(channel: Channel) -> list[str]:
    """Return the paths of the plain numbers in a channel's messages; empty where its type is not known."""
    try:
        definitions = definitions_of(channel)
    except DefinitionError:
        return []
    return list(islice(_numbers_in(definitions, full_name(channel.message_type), "", 0), MOST_NUMBERS))


def _numbers_in(definitions: Definitions, name: str, prefix: str, depth: int) -> Iterator[str]:
    for field, (node, detail) in definitions[name][1] if name in definitions else ():
        if int(node) == BASE and detail[0] in SIZES:
            yield f"{prefix}{field}"
        elif int(node) == NAME and depth < MOST_NESTED:
            yield from _numbers_in(definitions, detail, f"{prefix}{field}.", depth + 1)


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


def _is_complete(types: Definitions) -> bool:
    """Return whether every type that a field refers to is among the types."""
    for _, fields in types.values():
        for _, (node, detail) in fields:
            inner = detail[0] if int(node) > NAME else (node, detail)
            if int(inner[0]) == NAME and inner[1] not in types:
                return False
    return True


def full_name(message_type: str) -> str:
    """Return ``package/msg/Name`` for ``package/Name``; a name without a package, as Protobuf's, as it is."""
    package, _, name = message_type.partition("/")
    return f"{package}/msg/{name}" if name else message_type


@lru_cache(maxsize=64)
def _parse(text: str, written: Literal["msg", "idl"], message_type: str) -> Definitions:
    """Parse a definition text; the topics of a log share few."""
    from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

    if len(text) > LONGEST_DEFINITION or text.count(_SEPARATOR) > MOST_TYPES:
        why = f"the definition in the log is longer than {LONGEST_DEFINITION} characters or {MOST_TYPES} types"
        raise DefinitionError(message_type, why, "this type is not read")
    try:
        if written == "msg":
            return get_types_from_msg(text, full_name(message_type))
        parts = text.split(_SEPARATOR)[1:] if text.startswith(f"{_SEPARATOR}IDL: ") else [f"\n{text}"]
        plain = [_plain_idl(part.split("\n", 1)[1]) for part in parts]
        numbers = sum(part.count(sign) for part in plain for sign in "[<=")
        if numbers > MOST_NUMBERS or sum(map(len, plain)) > LONGEST_IDL or any(map(_EXPRESSION.search, plain)):
            why = (
                f"its definition has expressions, {MOST_NUMBERS} numbers, or {LONGEST_IDL} characters without comments"
            )
            raise DefinitionError(message_type, why, "this type is not read")
        types: dict[str, Any] = {}
        for part in plain:
            types.update(get_types_from_idl(part))
    except (TypesysError, ValueError, IndexError, KeyError, RecursionError) as err:
        first = shortened(str(err).partition("\n")[0], LONGEST_NAME)
        raise DefinitionError(message_type, "the definition in the log cannot be parsed", first) from err
    return types


def _plain_idl(text: str) -> str:
    """Return an IDL text without comments, annotations, and constants that are no number or name.

    The parser of rosbags reads each number 128 times, and again for each pair of parentheses: three take hours. It
    reads the inner one of two sequences twice.
    """
    text = _COMMENT_OR_STRING.sub(lambda found: '""' if found[0].startswith('"') else " ", text)
    return _VALUE.sub("= 0", _ANNOTATION.sub(" ", text))


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
