"""Messages in JSON: the schema that a channel carries, and the values in each message."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any

import orjson

from icrtool.errors import DefinitionError
from icrtool.logs.messages.schema import BASE, DEEPEST, MOST_FIELDS, NAME, SEQUENCE, Definitions

LONGEST_SCHEMA = 1 << 20
"""Characters of a JSON schema."""

_KINDS = {"integer": "int64", "number": "float64", "boolean": "bool", "string": "string"}


def parse_json(data: bytes) -> dict[str, Any] | None:
    """Return a message, None where it cannot be read. NaN and Infinity, which Python writes, are numbers."""
    try:
        value = orjson.loads(data)
    except ValueError:
        if b"NaN" not in data and b"Infinity" not in data:
            return None
        try:
            value = json.loads(data)
        except (ValueError, RecursionError):
            return None
    return value if isinstance(value, dict) else None


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
