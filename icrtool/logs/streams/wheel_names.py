"""Find left and right by name: joints of one message, and pairs of topics."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import lru_cache

WHEEL_WORDS = re.compile(r"wheel|track(?!er|ing)|sprocket|drive|motor|tire|tyre", re.IGNORECASE)
_OTHER_JOINTS = re.compile(
    r"(arm|pan|tilt|lift)\d*|(gripper|flipper|finger|steer|elbow|shoulder|wrist|caster|camera|rocker|bogie|suspension).*"
)
"""Words in the name of a joint that is not a wheel. Only complete words count: "panther" is not "pan"."""

_TOKENS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_LEFT_TOKENS = {"l", "left", "fl", "rl", "bl", "ml", "lf", "lb", "lr", "lm", "lh", "lwheel", "wl"}
_RIGHT_TOKENS = {"r", "right", "fr", "rr", "br", "mr", "rf", "rb", "rm", "rh", "rwheel", "wr"}


def side_of(name: str) -> str:
    """Return ``left``, ``right`` or an empty string for a joint's name."""
    lowered = name.lower()
    if ("left" in lowered) != ("right" in lowered):
        return "left" if "left" in lowered else "right"
    tokens = set(_words(name))
    left, right = bool(tokens & _LEFT_TOKENS), bool(tokens & _RIGHT_TOKENS)
    if left == right:
        return ""
    return "left" if left else "right"


def _words(name: str) -> list[str]:
    """Return the words of a name, lower case: ``wheel_FL_joint``, ``frontLeftWheel``, ``panther/rl_wheel_joint``."""
    return [word.lower() for word in _TOKENS.findall(name.replace("_", " "))]


def wheel_joints(names: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the positions of the left and of the right wheel joints among the names of a message."""
    sides = [(i, *_side_of_wheel(name)) for i, name in enumerate(names)]
    any_named = any(named for _, side, named in sides if side)
    left, right = ([i for i, side, named in sides if side == one and named >= any_named] for one in ("left", "right"))
    return left, right


@lru_cache(4096)
def _side_of_wheel(name: str) -> tuple[str, bool]:
    """Return the side of a joint that may be a wheel, empty for others, and whether its name is that of a wheel."""
    elsewhere = any(_OTHER_JOINTS.fullmatch(word) for word in _words(name))
    return "" if elsewhere else side_of(name), bool(WHEEL_WORDS.search(name))


def right_twin(left_topic: str, topics: Iterable[str]) -> str | None:
    """Return the topic whose name is `left_topic` with left replaced by right; None when there is none."""
    existing = topics if isinstance(topics, AbstractSet | Mapping) else set(topics)
    for old, new in (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT")):
        if old in left_topic:
            twin = left_topic.replace(old, new)
            return twin if twin in existing else None
    for place, letter in enumerate(left_topic):
        if letter not in "lL" or not _stands_alone(left_topic, place):
            continue
        twin = left_topic[:place] + ("r" if letter == "l" else "R") + left_topic[place + 1 :]
        if twin in existing:
            return twin
    return None


def _stands_alone(name: str, place: int) -> bool:
    """Return whether a letter begins or ends a word: ``/lwheel``, ``enc_L``, ``/WL``, ``frontL``."""
    before = name[place - 1] if place else "/"
    after = name[place + 1] if place + 1 < len(name) else "/"
    begins = not before.isalpha() or (before.islower() and name[place].isupper())
    ends = not after.isalpha()
    return begins or ends
