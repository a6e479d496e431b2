"""Bounds of the content of each definition in a log, and of the definitions that are parsed together."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from icrtool.errors import DefinitionError
from icrtool.logs.containers.container import Channel
from icrtool.records.text import LONGEST_TEXT

MOST_FIELDS = 20_000
"""Largest number of fields of a message type, with the types in it. Real definitions have some hundred."""

MOST_NAME_CHARACTERS = 1 << 20
"""Largest sum of the characters of all full names of fields of a message type, with the types in it. All schemas of
Foxglove together have 40,000."""

MOST_PARSED = 1 << 19
"""Largest number of characters of the definitions that are parsed for one log: 1 s of CPU time. The definitions of 30
topics have 100,000."""

_LEAST_COST = 1000
"""Least cost of any definition, in characters of ROS definitions of the same parsing time."""

_IDL_WEIGHT = 3
"""Cost of a character of IDL, in characters of ROS definitions."""

_IDL_NUMBER_WEIGHT = 2000
"""Cost of a number in IDL, in characters of ROS definitions."""

_SCHEMA_SHARE = 8
"""Characters of JSON, or bytes of Protobuf, whose cost is one character of ROS definitions."""

_EQUAL_SIGNS = re.compile(r"=+")
_LONG_WORD = re.compile(rf"[\w/]{{{LONGEST_TEXT + 1}}}")
_MODULE = re.compile(r"\bmodule\s+(\w+)\s*\{|[{}]")
COMMENT_OR_STRING = re.compile(r'(?://|#)[^\n]*|/\*.*?(?:\*/|\Z)|"(?:\\.|[^"\\])*(?:"|\Z)', re.DOTALL)
"""A comment or a string in the text of a definition; one that does not end reaches to the end of the text."""


@dataclass(slots=True)
class FieldNames:
    """Counts the full names of the fields of a message type, before anything is made of them.

    A long name of a type with many fields would fill the memory, though each is within its own bound.

    Attributes
    ----------
    message_type : in errors
    left : characters that further names may have together
    """

    message_type: str
    left: int = MOST_NAME_CHARACTERS

    def add(self, *parts: str) -> None:
        """Count one full name: its parts, joined by dots.

        Raises
        ------
        DefinitionError
            The name is longer than `LONGEST_TEXT`, or all are longer than `MOST_NAME_CHARACTERS`.
        """
        length = sum(map(len, parts)) + len(parts) - 1
        self.left -= length
        if length > LONGEST_TEXT:
            why = f"a field has a full name of {length} characters; at most {LONGEST_TEXT} are read"
        elif self.left < 0:
            why = f"the full names of its fields have more than {MOST_NAME_CHARACTERS} characters"
        else:
            return
        raise DefinitionError(self.message_type, why, "this type is not read")

    def add_text(self, text: str) -> None:
        """Refuse a definition with a word that is too long for a name, outside comments and strings.

        Raises
        ------
        DefinitionError
            There is such a word.
        """
        if (word := _LONG_WORD.search(COMMENT_OR_STRING.sub(" ", text))) is not None:
            self.add(word[0])

    def add_modules(self, idl: str) -> None:
        """Count the full name of each module of IDL: the parser puts it before the name of each type in the module.

        Raises
        ------
        DefinitionError
            As `add`.
        """
        within: list[str] = []
        for module in _MODULE.finditer(idl):
            if module[0] == "}":
                within = within[:-1]
            else:
                within.append(module[1] or "")
                self.add(*within)


@dataclass(slots=True)
class DefinitionBudget:
    """The limit of the definitions that are parsed for one log: each topic may have another definition.

    Attributes
    ----------
    left : characters of ROS definitions, or the equivalent of other definitions
    refused : by type and definition, why they cannot be read, found once
    """

    left: int = MOST_PARSED
    refused: dict[tuple[str, str], DefinitionError] = field(default_factory=dict)
    _parsed: set[tuple[str, str]] = field(default_factory=set)
    _costs: dict[tuple[str, str], int] = field(default_factory=dict)

    def take(self, channel: Channel) -> None:
        """Count the definition of a channel when it comes for the first time.

        Raises
        ------
        DefinitionError
            The definitions before it used up the limit, and this definition is not parsed.
        """
        one = channel.message_type, channel.definition
        if (before := self.refused.get(one)) is not None:
            raise before
        if one in self._parsed:
            return
        if (cost := self._costs.get(one)) is None:
            cost = self._costs[one] = self._cost_of(channel)
        if cost > self.left:
            why = f"the definitions of its types are longer than {MOST_PARSED} characters together"
            raise DefinitionError(channel.topic, why, "name the topics that are needed in [topics]")
        self.left -= cost
        self._parsed.add(one)

    def _cost_of(self, channel: Channel) -> int:
        """Return the cost of parsing a definition; where a part of the cost exceeds what is left, this part."""
        text = channel.definition
        if channel.encoding in ("json", "protobuf"):
            return len(text) // _SCHEMA_SHARE + _LEAST_COST
        if channel.definition_format != "idl":
            return len(text) + _LEAST_COST
        cost = _IDL_WEIGHT * len(text) + _LEAST_COST
        if cost > self.left:
            return cost
        # the numbers of IDL stand behind a bracket or a single equals sign; separators are rows of these signs
        numbers = text.count("[") + text.count("<") + sum(len(one) == 1 for one in _EQUAL_SIGNS.findall(text))
        return cost + _IDL_NUMBER_WEIGHT * numbers

    def spend(self, channel: Channel, fields: int | DefinitionError) -> None:
        """Count the fields of a channel's layout, which may be many; a refused layout counts as `MOST_FIELDS`."""
        if isinstance(fields, DefinitionError):
            self.refused[channel.message_type, channel.definition] = fields
            self.left -= MOST_FIELDS if channel.definition else 0
        else:
            self.left -= fields
