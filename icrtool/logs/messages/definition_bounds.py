"""Limits on the size of each message definition in a log, and on the total size of all definitions of a log."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from icrtool.errors import DefinitionError
from icrtool.logs.containers.container import Channel
from icrtool.records.text import LONGEST_TEXT

MOST_FIELDS = 20_000
"""Largest number of fields of a message type, with the types in it. Real definitions have a few hundred."""

MOST_NAME_CHARACTERS = 1 << 20
"""Largest number of characters of the full names of all fields of a message type, with the types in it. All schemas of
Foxglove together have 40,000."""

MOST_PARSED = 1 << 19
"""Largest number of characters of the definitions that are parsed for one log. Parsing them takes 1 s of CPU time. The
definitions of 30 topics have 100,000 characters."""

_LEAST_COST = 1000
"""Smallest cost of a definition. The unit of costs is the parsing time of one character of a ROS definition."""

_IDL_WEIGHT = 3
"""Cost of a character of IDL."""

_IDL_NUMBER_WEIGHT = 2000
"""Cost of a number in IDL."""

_SCHEMA_SHARE = 8
"""Number of characters of JSON, or of bytes of Protobuf, with a cost of 1."""

_EQUAL_SIGNS = re.compile(r"=+")
_LONG_WORD = re.compile(rf"[\w/]{{{LONGEST_TEXT + 1}}}")
_MODULE = re.compile(r"\bmodule\s+(\w+)\s*\{|[{}]")
COMMENT_OR_STRING = re.compile(r'(?://|#)[^\n]*|/\*.*?(?:\*/|\Z)|"(?:\\.|[^"\\])*(?:"|\Z)', re.DOTALL)
"""Pattern of a comment or a string in a definition. A comment or string without an end reaches to the end of the
text."""


@dataclass(slots=True)
class NameBudget:
    """Counter of the characters of all full names of fields of a message type, used before any name is made.

    Many fields, each with a long name, would fill the memory although each number is within its own limit.

    Attributes
    ----------
    message_type : name of the type in errors
    left : number of characters that further names may have together
    """

    message_type: str
    left: int = MOST_NAME_CHARACTERS

    def add(self, *parts: str) -> None:
        """Count the characters of one full name, which is its parts joined by dots.

        Raises
        ------
        DefinitionError
            The name has more than `LONGEST_TEXT` characters, or all names together more than `MOST_NAME_CHARACTERS`.
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

    def check_words(self, text: str) -> None:
        """Refuse a definition with a word that is too long for a name, outside comments and strings.

        Raises
        ------
        DefinitionError
            A word is longer than `LONGEST_TEXT`.
        """
        if (word := _LONG_WORD.search(COMMENT_OR_STRING.sub(" ", text))) is not None:
            self.add(word[0])

    def add_modules(self, idl: str) -> None:
        """Count the full name of each module of IDL, which the parser puts before the name of each type in the module.

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
    """Limit on the total cost of the definitions of one log, because each topic may have another definition.

    Attributes
    ----------
    left : remaining cost
    refused : error of each definition that cannot be read, by type and text of the definition
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
            The definition cannot be read, or the remaining cost is too small for it; it is then not parsed.
        """
        key = channel.message_type, channel.definition
        if (error := self.refused.get(key)) is not None:
            raise error
        if key in self._parsed:
            return
        if (cost := self._costs.get(key)) is None:
            cost = self._costs[key] = self._cost_of(channel)
        if cost > self.left:
            why = f"the definitions of its types are longer than {MOST_PARSED} characters together"
            raise DefinitionError(channel.topic, why, "name the topics that are needed in [topics]")
        self.left -= cost
        self._parsed.add(key)

    def _cost_of(self, channel: Channel) -> int:
        """Return the cost of parsing a definition, or a part of the cost if this part is above the remaining cost."""
        text = channel.definition
        if channel.encoding in ("json", "protobuf"):
            return len(text) // _SCHEMA_SHARE + _LEAST_COST
        if channel.definition_format != "idl":
            return len(text) + _LEAST_COST
        cost = _IDL_WEIGHT * len(text) + _LEAST_COST
        if cost > self.left:
            return cost
        # A number of IDL follows a bracket or a single equals sign. Separators are rows of equals signs.
        numbers = text.count("[") + text.count("<") + sum(len(signs) == 1 for signs in _EQUAL_SIGNS.findall(text))
        return cost + _IDL_NUMBER_WEIGHT * numbers

    def spend(self, channel: Channel, fields: int | DefinitionError) -> None:
        """Count the fields of a channel's layout, or `MOST_FIELDS` for a definition that was refused with an error."""
        if isinstance(fields, DefinitionError):
            self.refused[channel.message_type, channel.definition] = fields
            self.left -= MOST_FIELDS if channel.definition else 0
        else:
            self.left -= fields
