"""Parser of the texts of message definitions, which recorders write in different forms."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any, Literal

from icrtool.errors import DefinitionError
from icrtool.logs.messages.definition_bounds import COMMENT_OR_STRING, NameBudget
from icrtool.records.text import LONGEST_NAME, shortened

SEPARATOR = "=" * 80
"""The line between the types of a definition."""

_FEWEST_SIGNS = 20
"""Smallest number of ``=`` at the end of a line that are read as a separator."""

_SECTION_HEAD = re.compile(r"\s*(MSG|IDL)\s*:\s*([\w/]*)\s*")
_NAMED = re.compile(r"\s*Definition of\b\s*([\w/]*).*", re.IGNORECASE)
"""Pattern of a line such as ``Definition of sensor_msgs/JointState:``, which some recorders write before a type."""

_SEPARATOR = f"{SEPARATOR}\n"
LONGEST_DEFINITION = 1 << 18
"""Largest number of characters of a message type with all types in it. The longest bundled definition has 6,000."""

MOST_TYPES = 256
"""Largest number of types in a message type. The largest bundled definition has 12."""

LONGEST_IDL = 1 << 16
"""Largest number of characters of a definition in IDL."""

MOST_IDL_NUMBERS = 256
"""Largest number of numbers (lengths, bounds, constants) of a definition in IDL. The parser takes 5 ms for each."""

_ANNOTATION = re.compile(r"@\s*[\w:]+(?:\s*\([^()]*\))?")
_VALUE = re.compile(r"=(?!\s*\w+\s*;)[^;=]*")
_EXPRESSION = re.compile(r"[()+\-*/%|^&~]|<[^<>]*<[^<>]*<")


def full_name(message_type: str) -> str:
    """Return ``package/msg/Name`` for ``package/Name``; a name without a package, as in Protobuf, unchanged."""
    package, _, name = message_type.partition("/")
    return f"{package}/msg/{name}" if name else message_type


def plain_definition(text: str, own_name: str) -> str:
    """Return a definition in the form that rosbags reads.

    Lines end with LF, there is no byte order mark, and each separator and each name of a type has its own line.

    Parameters
    ----------
    own_name : ``package/Name`` of the type that is defined first; a heading with this name is left out
    """
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\0", "").replace("\xa0", " ")
    own = own_name.replace("/msg/", "/")
    lines: list[str] = []
    has_content = False
    for line in text.removeprefix("\ufeff").removeprefix("\xef\xbb\xbf").split("\n"):
        head, named = _SECTION_HEAD.fullmatch(line), _NAMED.fullmatch(line)
        if head is None and named is None:
            lines.append(line.rstrip())
            has_content = has_content or line.lstrip("= \t")[:1] not in ("", "#")
            continue
        kind, name = head.groups() if head is not None else ("MSG", named[1] if named is not None else "")
        _end_type(lines)
        if kind == "MSG" and name.replace("/msg/", "/") == own and not has_content:
            lines.clear()
        elif name.count("/") and f"{kind}: {name}" not in lines[-1:]:
            lines += [SEPARATOR, f"{kind}: {name}"]
            has_content = True
    _end_type(lines)
    return "\n".join([*lines, ""])


def _end_type(lines: list[str]) -> None:
    """Remove the empty lines and the separator at the end of the lines of a type."""
    while lines and not lines[-1].strip("= \t"):
        lines.pop()
    if lines and len(lines[-1]) - len(without := lines[-1].rstrip("=")) >= _FEWEST_SIGNS:
        lines[-1] = without.rstrip()


@lru_cache(maxsize=64)
def parse_definition(text: str, written: Literal["msg", "idl"], message_type: str) -> dict[str, tuple[Any, Any]]:
    """Return the types in a definition text, in their order: (constants, fields) by ``package/msg/Name``.

    Parameters
    ----------
    written : language of the text
    message_type : ``package/Name`` of the type that the text defines

    Raises
    ------
    DefinitionError
        The text is too long, or cannot be parsed.
    """
    from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

    too_long = f"the definition in the log has more than {LONGEST_DEFINITION} characters or {MOST_TYPES} types"
    if len(text) > LONGEST_DEFINITION:
        raise DefinitionError(message_type, too_long, "this type is not read")
    text = plain_definition(text, message_type)
    if text.count(_SEPARATOR) > MOST_TYPES:
        raise DefinitionError(message_type, too_long, "this type is not read")
    names = NameBudget(message_type)
    names.check_words(text)
    try:
        if written == "msg":
            return _with_counted_names(get_types_from_msg(text, full_name(message_type)), names)
        parts = text.split(_SEPARATOR)[1:] if text.startswith(f"{_SEPARATOR}IDL: ") else [f"\n{text}"]
        plain = [_plain_idl(part.split("\n", 1)[1]) for part in parts]
        numbers = sum(part.count(sign) for part in plain for sign in "[<=")
        if numbers > MOST_IDL_NUMBERS or sum(map(len, plain)) > LONGEST_IDL or any(map(_EXPRESSION.search, plain)):
            why = f"expressions, more than {MOST_IDL_NUMBERS} numbers, or more than {LONGEST_IDL} characters"
            raise DefinitionError(message_type, f"its definition has {why}", "this type is not read")
        for part in plain:
            names.add_modules(part)
        types: dict[str, Any] = {}
        for part in plain:
            types.update(get_types_from_idl(part))
    except (TypesysError, ValueError, IndexError, KeyError, RecursionError) as err:
        reason = shortened(_parse_problem(str(err)), LONGEST_NAME)
        raise DefinitionError(message_type, f"the definition in the log cannot be parsed: {reason}") from err
    return _with_counted_names(types, names)


def _with_counted_names(types: dict[str, tuple[Any, Any]], names: NameBudget) -> dict[str, tuple[Any, Any]]:
    """Return parsed types after the full names of their fields were counted; raise as `NameBudget.add`."""
    for name, (_, fields) in types.items():
        for named, _ in fields:
            names.add(name, named)
    return types


def _parse_problem(reason: str) -> str:
    """Return the line that rosbags could not parse; the first line of its message where it names no line."""
    first, *others = reason.split("\n")
    if not first.startswith("Could not parse") or len(others) < 2:
        return first
    offset = others[1]
    line = next((line.strip() for line in others[2:] if line.strip()), "")
    return f"at {line!r}" if line else f"at character {offset}"


def _plain_idl(text: str) -> str:
    """Return an IDL text without comments and annotations, with 0 for each value that is neither a number nor a name.

    The parser of rosbags reads each number 128 times, and 128 times again for each pair of parentheses around it: with
    three pairs it takes hours. It reads a sequence in a sequence twice.
    """
    text = COMMENT_OR_STRING.sub(lambda found: '""' if found[0].startswith('"') else " ", text)
    return _VALUE.sub("= 0", _ANNOTATION.sub(" ", text))
