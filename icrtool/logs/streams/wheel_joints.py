"""Left and right by name: which joints of a message are wheels, their motion, and which topics are a pair."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.logs.containers.channel import some_of
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.sources import Sides, WheelEntry, WheelMotion, motion_of, of_topic

ONE_TURN_RAD, LEAST_WRAP_RAD, FEWEST_WRAPS = 2 * np.pi + 1e-3, 1.5 * np.pi, 2
"""Positions that stay within one turn, and jump by nearly one turn this often, are recorded modulo a turn."""

MOST_WHEELS = 32
"""Of a side. A message that lists more is not of wheels, or was made to take time."""

_Paths = tuple[str, str, str]
"""Of the joints' names, positions and speeds."""


def _side_means(values: NDArray[Any], left: list[int], right: list[int]) -> tuple[Sides, list[int]]:
    """Return the mean over the joints of each side that have finite values, None where none has; and the dead joints.

    A joint that never changes while another one of its side does has a dead encoder, and is left out.
    """
    means: list[Floats | None] = []
    dead = _dead_joints(values, left, right)
    for places in (left, right):
        finite = [place for place in places if place not in dead and np.isfinite(values[:, place]).any()]
        if len(finite) == 1:
            means.append(values[:, finite[0]].astype(np.float64, copy=False))
        elif finite:
            of_side = values.T[finite].astype(np.float64, copy=False)
            of_side[np.isinf(of_side)] = np.nan  # infinity less infinity would warn
            means.append(of_side.mean(axis=0))
        else:
            means.append(None)
    return (means[0], means[1]), dead


def _dead_joints(values: NDArray[Any], left: list[int], right: list[int]) -> list[int]:
    """Return the places of the joints that never change while another one of their side does."""
    with np.errstate(invalid="ignore"):  # infinite ones are left out later
        changes = np.fmax.reduce(values, axis=0) > np.fmin.reduce(values, axis=0)
    return [place for side in (left, right) for place in side if not changes[place] and changes[side].any()]


def _dead_note(names: Sequence[str]) -> str:
    return f"{some_of(names)} never turns while the other wheels of its side do: left out" if names else ""


def _unwound(positions: Floats) -> Floats:
    """Return joint positions [rad] (n, k); those recorded modulo one turn are unwrapped.

    This is done before a side is averaged: a front and a rear wheel do not begin a turn at the same time.
    """
    unwound = positions
    with np.errstate(invalid="ignore"):  # infinite ones are left out later
        spread = np.fmax.reduce(positions, axis=0, initial=-np.inf) - np.fmin.reduce(positions, axis=0, initial=np.inf)
    for place in np.flatnonzero(spread <= ONE_TURN_RAD).tolist():
        column = positions[:, place]
        finite = np.flatnonzero(np.isfinite(column))
        steps = np.abs(np.diff(column[finite]))
        wraps = steps > np.pi
        if np.count_nonzero(wraps) >= FEWEST_WRAPS and float(steps[wraps].min()) > LEAST_WRAP_RAD:
            unwound = unwound.copy("K") if unwound is positions else unwound
            unwound[finite, place] = np.unwrap(column[finite])
    return unwound


def _joints(table: TopicTable, config: Config, paths: _Paths, score: float, what: str) -> WheelMotion:
    """Return the motion of messages that list joints by name, in any order; other joints may be listed in between."""
    codes, texts = table.words(paths[0])
    left, right = _wheels_among(texts, config)
    if not (left and right):
        advice = "name them in wheels.{left,right}_joints"
        named = f"no left and right wheel among its joints {some_of(texts)}; {advice}"
        return WheelMotion(**of_topic(table), problem=named if texts else "lists no joints")
    lefts, rights = len(left), len(right)
    if max(lefts, rights) > MOST_WHEELS:
        problem = f"lists {lefts} left and {rights} right wheels; at most {MOST_WHEELS} of a side are read"
        return WheelMotion(**of_topic(table), problem=problem)
    # Joints by their place among the wheels, left ones first; -1 for all others.
    wheel = np.full(len(texts) + 1, -1)
    wheel[left + right] = np.arange(lefts + rights)
    # All messages list the same joints in the same order: one row stands for them.
    same = codes.strides[0] == 0
    wheels = np.broadcast_to(wheel[codes[:1]], codes.shape) if same else wheel[codes]
    alike = _rows_alike(wheels[:1] if same else wheels, lefts, rights)
    if not alike.any():
        return WheelMotion(**of_topic(table), problem="left and right wheels come in different messages")
    if not alike.all():
        table, wheels = table.rows(alike), wheels[alike]
    sides = [*range(lefts)], [*range(lefts, lefts + rights)]
    # One after the other: the columns of all wheels of a long log are large.
    position, stuck = _side_means(_unwound(_by_wheel(table.find(paths[1]), wheels, lefts + rights)), *sides)
    speed, still = _side_means(_by_wheel(table.find(paths[2]), wheels, lefts + rights), *sides)
    why = f"{what}: left {some_of([texts[i] for i in left])}, right {some_of([texts[i] for i in right])}"
    note = _dead_note([texts[(left + right)[place]] for place in sorted({*stuck, *still})])
    return motion_of(WheelMotion(**of_topic(table), score=score, why=why, note=note), position, speed)


def _wheels_among(texts: Sequence[str], config: Config) -> tuple[list[int], list[int]]:
    left, right = wheel_joints(texts)
    given = config.wheels
    if given.left_joints:
        left = [i for i, name in enumerate(texts) if name in given.left_joints]
    if given.right_joints:
        right = [i for i, name in enumerate(texts) if name in given.right_joints]
    return left, right


def _rows_alike(wheels: Ints, lefts: int, rights: int) -> Bools:
    """Return the rows (n,) that list the set of wheels most rows list, of those sets with both sides.

    A mean over wheels that changes its members would jump.
    """
    listed = np.zeros((lefts + rights, len(wheels)), np.bool_).T
    for rows, wheel, _ in _listed_wheels(wheels):
        listed[rows, wheel] = True
    both: Bools = np.logical_and(listed[:, :lefts].any(axis=1), listed[:, lefts:].any(axis=1))
    sets = listed[both]
    if len(sets) and np.any(sets != sets[0]):
        _, which, count = np.unique(sets, axis=0, return_inverse=True, return_counts=True)
        both[both] = which.reshape(-1) == int(np.argmax(count))
    return both


def _by_wheel(values: NDArray[Any] | None, wheels: Ints, count: int) -> Floats:
    """Return the value of each wheel in each message (n, count), NaN where it is not listed."""
    by_wheel = np.full((count, len(wheels)), np.nan).T
    if values is not None:
        for rows, wheel, place in _listed_wheels(wheels[:, : values.shape[1]]):
            by_wheel[rows, wheel] = values[rows, place]
    return by_wheel


def _listed_wheels(wheels: Ints) -> Iterator[tuple[slice | Ints, int | Ints, int]]:
    """Yield rows, the wheel that they list (one, or one per row), and its position in the list."""
    for place, listed in enumerate(wheels.T):
        if len(listed) and (listed.strides[0] == 0 or (listed == listed[0]).all()):
            if listed[0] >= 0:
                yield slice(None), int(listed[0]), place
        else:
            rows = np.flatnonzero(listed >= 0)
            yield rows, listed[rows], place


def by_name(paths: _Paths, score: float, what: str) -> WheelEntry:
    """Return the entry of messages that list joints by their names."""

    def read(table: TopicTable, config: Config) -> WheelMotion:
        return replace(_joints(table, config, paths, score, what), joints=tuple(table.words(paths[0])[1]))

    return (*HEADER, *paths), read


def by_place(
    paths: tuple[str, str], left: list[int], right: list[int], why: str, stamp: str = "header.stamp"
) -> WheelEntry:
    """Return the entry of messages whose lists of positions and of speeds have each side at fixed positions."""
    length = max(left + right) + 1

    def read(table: TopicTable, _: Config) -> WheelMotion:
        position, speed = (table.column(path) for path in paths)
        if min(position.shape[1], speed.shape[1]) < length:
            raise DefinitionError(table.topic, f"{paths[0]} holds fewer than {length} elements")
        travelled, stuck = _side_means(_unwound(position.astype(np.float64)), left, right)
        turning, still = _side_means(speed, left, right)
        note = _dead_note([f"wheel {place}" for place in sorted({*stuck, *still})])
        return motion_of(WheelMotion(**of_topic(table, stamp), score=90.0, why=why, note=note), travelled, turning)

    return (f"{stamp}.sec", f"{stamp}.nanosec", *paths), read


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
