"""Plain data that somebody edited: one place removed, or replaced by what does not belong there."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

WRONG: list[Any] = [None, -1, 1e300, float("nan"), 10**30, "\x1b[2J", [], {"a": 1}, [[None]]]


def places(value: Any, here: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in plain data; of a list its first element."""
    if here:
        yield here
    items = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    for key, item in items:
        yield from places(item, (*here, key))


def edited(document: dict[str, Any], every: int = 1) -> Iterator[tuple[str, dict[str, Any]]]:
    """The document with one place removed or replaced; which of both, and by what, differs from place to place."""
    for number, place in list(enumerate(places(document)))[::every]:
        for wrong in (WRONG[number % len(WRONG)], ("removed", WRONG[(7 * number + 3) % len(WRONG)])[number % 2]):
            changed = copy.deepcopy(document)
            outer: Any = changed
            for key in place[:-1]:
                outer = outer[key]
            if wrong == "removed":
                del outer[place[-1]]
            else:
                outer[place[-1]] = copy.deepcopy(wrong)
            yield f"{place}: {wrong!r}", changed
