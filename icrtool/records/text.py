"""Text that comes from a log or a path: names, topics, frames, message types; and numbers with their spread."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any, Self

LONGEST_NAME = 80
"""Largest length of a printed name [characters]; of a longer name the beginning and the end are printed."""

LONGEST_TEXT = 512
"""Largest length of a text from a log [characters]; the rest is dropped. A topic of ROS has up to 255 characters."""

LONGEST_STORED = 1000
"""Largest length of a text from a file of icrtool [characters]. A warning has a few hundred characters."""

LONGEST_MESSAGE = 4000
"""Largest length of a printed error or warning [characters]."""


LEAST_LIKENESS, LEAST_LETTERS = 0.6, 3
"""Smallest similarity (`difflib`) of a proposed word, and smallest length of a typed text [characters] for which words
that contain the text are proposed."""


class LogText(str):
    r"""A text from a log that prints only escaped and shortened.

    The string itself is the escaped text, so texts made by joining, splitting or slicing are safe to print, too. `str`
    and `format` shorten the text as well. Comparisons and dictionaries use the whole escaped text, so two long
    names that differ in the middle stay different.

    Attributes
    ----------
    raw : the text as it is in the log, its first `LONGEST_TEXT` characters; for JSON, which has its own
        escapes, and for file names

    Examples
    --------
    >>> print(LogText("wheel\x1b[2J"))
    wheel\x1b[2J
    """

    raw: str

    def __new__(cls, raw: str) -> Self:
        """Return `raw` as a LogText; a LogText is returned unchanged."""
        if isinstance(raw, cls):
            return raw
        raw = raw[:LONGEST_TEXT]
        self = super().__new__(cls, escaped(raw))
        self.raw = raw
        return self

    def __str__(self) -> str:
        return shortened(str.__str__(self), LONGEST_NAME)

    def __format__(self, spec: str) -> str:
        return format(str(self), spec)

    def __repr__(self) -> str:
        return f"'{self}'"

    def __reduce__(self) -> tuple[type[LogText], tuple[str]]:
        return LogText, (self.raw,)


def escaped(text: str) -> str:
    """Return a text with every character that a terminal may act on, or hide, as a Python escape.

    These are the control and format characters (bidirectional overrides, zero-width characters), line separators,
    lone surrogates, and code points without a character.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def escaped_texts(value: Any, names: Collection[str] = ()) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return the content of a JSON file with all texts escaped and shortened to `LONGEST_STORED` characters.

    Parameters
    ----------
    names : keys of texts that are stored without escapes, as in the log; these texts become `LogText`
    """
    if isinstance(value, dict):
        return {
            escaped(key): LogText(item) if key in names and isinstance(item, str) else escaped_texts(item, names)
            for key, item in value.items()
        }
    if isinstance(value, list):
        return [escaped_texts(item, names) for item in value]
    return shortened(escaped(value), LONGEST_STORED) if isinstance(value, str) else value


def table_cell(text: str) -> str:
    """Return a text as a cell of a CSV table: escaped, and never a formula of a spreadsheet.

    A text that begins with ``=``, ``+``, ``-`` or ``@`` gets an apostrophe before it (OWASP, CSV injection).
    """
    shown = escaped(text)
    return f"'{shown}" if shown.startswith(("=", "+", "-", "@")) else shown


def counted(number: int, what: str) -> str:
    """Return ``1 log`` or ``3 logs``."""
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


def shortened(text: str, longest: int) -> str:
    """Return a text of at most `longest` characters: where it is longer, an ellipsis replaces its middle."""
    if len(text) <= longest:
        return text
    head = (longest - 1) // 2
    return f"{text[:head]}…{text[head + 1 - longest :]}"


MOST_NAMED = 12
"""Largest number of names that one message to the user lists."""


def listed(names: Sequence[str], most: int = MOST_NAMED) -> str:
    """Return at most `most` names, escaped and shortened, with commas, and the number of names left out."""
    shown = ", ".join(str(LogText(name)) for name in names[:most])
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")


MOST_DIGITS = 5
"""Largest number of decimals that are printed."""


def digits_of(std: float, least: int = 2) -> int:
    """Return the number of decimals of a value, by its standard deviation: two digits of a `std` that begins with 1."""
    if not 0.0 < std < math.inf:
        return least
    exponent = math.floor(math.log10(std))
    return min(max(least, -exponent + (std < 2 * 10.0**exponent)), MOST_DIGITS)


def with_std(value: float, std: float, least: int = 2) -> str:
    """Return a difference with its standard deviation, as ``+0.004 ± 0.007``, with `least` decimals or more."""
    digits = digits_of(std, least)
    return f"{value:+z.{digits}f} ± {std:.{digits}f}"


def with_interval(metres: float, low: float | None, high: float | None) -> str:
    """Return a difference [m] with its 95 % interval, as ``+0.01 m (-0.05 to +0.07)``."""
    if low is None or high is None:
        return f"{metres:+z.2f} m (too short for an interval)"
    value, low_text, high_text = (f"{number:+z.{digits_of((high - low) / 4)}f}" for number in (metres, low, high))
    return f"{value} m ({low_text} to {high_text})"


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """Return ``did you mean X? `` with the known word most similar to `word`; empty without a similar word."""
    from difflib import get_close_matches

    choices = {str(choice).lower(): str(choice) for choice in words}
    lowered = word.lower()
    near = get_close_matches(lowered, choices, n=1, cutoff=LEAST_LIKENESS)
    near = near or [choice for choice in choices if len(lowered) >= LEAST_LETTERS and lowered in choice][:1]
    return f"did you mean {choices[near[0]]}? " if near else ""


def distance_text(metres: float) -> str:
    """Return a distance as ``398.5 m`` or ``36.00 km``."""
    return f"{metres:.1f} m" if metres < 10_000 else f"{metres / 1000:.2f} km"
