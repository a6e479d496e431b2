"""Messages that list the wheels as joints by name: all in one message, or each side or wheel in its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from icrtool.config import Config
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.sources import WheelSource, of_topic, stamp_rows
from icrtool.logs.streams.wheels import MOST_WHEELS, Quantity, of_wheels, unwound_turns, wheel_joints
from icrtool.records.notes import Note, note
from icrtool.records.text import listed


@dataclass(frozen=True, slots=True)
class Joints:
    """A message type that lists joints by name, in any order; other joints may be listed in between.

    Attributes
    ----------
    what, worth : what it is called where it is chosen, and how suitable it is
    names, position, speed : fields of the lists
    """

    what: str
    worth: float
    names: str
    position: str
    speed: str

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read."""
        return self.names, self.position, self.speed

    def read(self, table: TopicTable, config: Config) -> WheelSource:
        """Return the motion of the joints that are wheels."""
        codes, texts = table.words(self.names)
        configured_names = config.wheels.left_joints, config.wheels.right_joints
        left, right = (
            [i for i, name in enumerate(texts) if name in configured] if configured else named
            for configured, named in zip(configured_names, wheel_joints(texts), strict=True)
        )
        lefts, names, problem = len(left), [texts[i] for i in left + right], ""
        if not (left and right):
            named = f"no left and right wheel among its joints {listed(texts)}"
            problem = f"{named}; name them in wheels.{{left,right}}_joints" if texts else "lists no joints"
        elif max(lefts, len(right)) > MOST_WHEELS:
            problem = f"lists {lefts} left and {len(right)} right wheels; at most {MOST_WHEELS} of a side are read"
        if problem:
            return WheelSource(**of_topic(table), joints=tuple(texts), problem=problem)
        # All messages list the same joints in the same order: one row stands for them.
        places, alike = _places_of(left, right, codes[:1] if codes.strides[0] == 0 else codes, len(texts))
        why = f"{self.what}: left {listed(names[:lefts])}, right {listed(names[lefts:])}"
        paths: dict[Quantity, str] = {"position": self.position, "speed": self.speed}
        wheels = _by_message(table, paths, places, alike) if alike.any() else _by_own_messages(table, paths, places)
        if wheels is None:
            problem = "the joints of the left and of the right were not recorded at the same time"
            return WheelSource(**of_topic(table), joints=tuple(texts), problem=problem)
        columns, source, notes = wheels
        motion = of_wheels(
            lambda quantity: columns[quantity], lefts, names, "rad", **source, joints=tuple(texts), score=self.worth,
            why=why,
        )  # fmt: skip
        return replace(motion, notes=(*notes, *motion.notes))


Columns = dict[Quantity, list[NDArray[Any]]]
"""Positions and speeds (n,) of each wheel; no column for a quantity that is not recorded."""

FEWEST_REPEATED = 5
"""Least number of repeated messages between others from which a second publisher is found."""

LITTLE_CHANGE = 0.5
"""Largest difference of the messages before and after such a message, as a share of their difference from it."""

USUAL_STEPS = 0.98
"""Quantile of the changes from message to message that a state other than zero must exceed to be another one's."""


def _by_message(
    table: TopicTable, paths: Mapping[Quantity, str], places: Ints, alike: Bools
) -> tuple[Columns, dict[str, Any], tuple[Note, ...]]:
    """Return the columns of messages that list both sides, what a source has of its topic, and findings."""
    if not alike.all():
        table, places = table.rows(alike), places[alike]
    columns: Columns = {quantity: _by_wheel(table.find(path), places) for quantity, path in paths.items()}
    foreign = _of_second_publisher(columns["position"], columns["speed"])
    if foreign is None:
        return columns, of_topic(table), ()
    kept = {quantity: [column[~foreign] for column in wheels] for quantity, wheels in columns.items()}
    nothing = not np.any([np.nan_to_num(column[foreign]).any() for wheels in columns.values() for column in wheels])
    state = "0 for every wheel" if nothing else "one and the same motion"
    counted = f"{np.count_nonzero(foreign)} of {len(foreign)} messages state {state}, between others that do not"
    left_out = note("second_publisher", f"{counted}: sent by a second publisher, left out")
    return kept, of_topic(table.rows(~foreign)), (left_out,)


def _of_second_publisher(positions: Sequence[NDArray[Any]], speeds: Sequence[NDArray[Any]]) -> Bools | None:
    """Return which messages (n,) repeat one state between messages that state another motion; None: none.

    A second publisher sends zeros, or a state that it does not update. A robot that stands does not return to its
    motion at once, and an encoder of few counts changes as little elsewhere.
    """
    columns = [*positions, *speeds]
    if not columns or len(columns[0]) < FEWEST_REPEATED:
        return None
    sums, zero, known = (
        np.zeros(len(columns[0])),
        np.ones(len(columns[0]), np.bool_),
        np.zeros(len(columns[0]), np.bool_),
    )
    for column, weight in zip(columns, np.sqrt(np.arange(2.0, len(columns) + 2.0)), strict=True):
        finite = np.isfinite(column)
        if finite.all():
            sums += weight * column
            zero &= column == 0.0
            known[:] = True
            continue
        sums += weight * np.where(finite, column, 0.0)
        zero &= (column == 0.0) | ~finite
        known |= finite
    for repeated in (_most_repeated(sums), zero & known):
        some = [column for column in positions if np.nan_to_num(column[~repeated]).any()] or list(speeds)
        if _alternates(some, repeated):
            return repeated
    return None


def _most_repeated(sums: NDArray[np.float64]) -> Bools:
    """Return which messages (n,) have the weighted sum that the largest number of stretches of equal sums has."""
    begins = np.append(True, sums[1:] != sums[:-1])
    values, count = np.unique(sums[begins], return_counts=True)
    return np.asarray(sums == values[int(np.argmax(count))])


@np.errstate(over="ignore", invalid="ignore")
def _alternates(columns: Sequence[NDArray[Any]], repeated: Bools) -> bool:
    """Return whether repeated messages (n,) lie between others that hardly differ, compared with the repeated state.

    Differences of values near the largest number overflow; such messages do not alternate.
    """
    others = np.flatnonzero(~repeated)
    around = np.flatnonzero(np.diff(others) > 1)
    if len(around) < FEWEST_REPEATED or not columns:
        return False
    first, size, change = int(np.argmax(repeated)), np.zeros(len(around)), np.zeros(len(around))
    steps, moves = np.zeros(len(others) - 1), False
    for column in columns:
        values = np.nan_to_num(column[others], nan=0.0, posinf=0.0, neginf=0.0)
        state = float(np.nan_to_num(column[first]))
        before, after = values[around], values[around + 1]
        size = np.maximum(size, np.maximum(np.abs(before - state), np.abs(after - state)))
        change = np.maximum(change, np.abs(after - before))
        steps, moves = np.maximum(steps, np.abs(np.diff(values))), moves or state != 0.0
    between = change < LITTLE_CHANGE * size
    count = int(np.count_nonzero(between))
    if not (count >= FEWEST_REPEATED and 2 * count > len(around)):
        return False
    return not moves or float(np.median(size[between])) > float(np.quantile(steps, USUAL_STEPS))


def _by_own_messages(
    table: TopicTable, paths: Mapping[Quantity, str], places: Ints
) -> tuple[Columns, dict[str, Any], tuple[Note, ...]] | None:
    """Return the columns of wheels that come in messages of their own, at the stamps of the first wheel.

    Positions are interpolated, speeds held; None where the wheels were not recorded at the same time.
    """
    rows = [np.flatnonzero(place >= 0) for place in places.T]
    stamps = [stamp_rows(table.rows(some)) for some in rows]
    by_header = all(one.header_ns is not None for one in stamps)
    times = [one.on("header") if by_header else one.log_ns for one in stamps]
    orders = [np.argsort(one, kind="stable") for one in times]
    times = [one[order] for one, order in zip(times, orders, strict=True)]
    half = max(int(np.median(np.diff(one))) // 2 if len(one) > 1 else 0 for one in times)
    positions = table.find(paths["position"])
    slack = half if positions is None or not positions.shape[1] else 0  # positions are not extrapolated
    first, last = max(one[0] for one in times) - slack, min(one[-1] for one in times) + slack
    both = (times[0] >= first) & (times[0] <= last)
    if not both.any():
        return None
    moments = times[0][both]
    columns: Columns = {"position": [], "speed": []}
    for quantity, path in paths.items():
        values = table.find(path)
        for wheel, (some, order) in enumerate(zip(rows, orders, strict=True)):
            place = places[some, wheel]
            if values is None or place.max() >= values.shape[1]:
                columns[quantity] = []
                break
            stated = values[some, place].astype(np.float64)[order]
            if quantity == "position":
                stated, finite = unwound_turns(stated), np.isfinite(stated)
                known = finite if finite.any() else ~finite
                columns[quantity].append(np.interp(moments, times[wheel][known], stated[known]))
            else:
                held = np.searchsorted(times[wheel], moments + half, side="right") - 1
                columns[quantity].append(stated[np.clip(held, 0, None)])
    source = of_topic(table.rows(rows[0][orders[0]][both]))
    if not by_header:
        source["stamps"] = replace(source["stamps"], header_ns=None, note="no header of every wheel", delay_ns=0)
    joined = note("wheels_joined", "its wheels come in messages of their own: joined by time")
    return columns, source, (joined,)


def _places_of(left: Sequence[int], right: Sequence[int], codes: Ints, joints: int) -> tuple[Ints, Bools]:
    """Return the place of each wheel in the list of each message (n, k), and which messages (n,) are used.

    A wheel that a message does not list is at -1. Messages are used if they list the most frequent set of wheels that
    has both sides: a mean over changing wheels would jump.
    """
    wheels = [*left, *right]
    wheel = np.full(joints + 1, -1)
    wheel[wheels] = np.arange(len(wheels))
    rows, at = np.nonzero(wheel[codes] >= 0)
    places = np.full((len(wheels), len(codes)), -1).T
    places[rows, wheel[codes[rows, at]]] = at
    present = places >= 0
    both: Bools = np.logical_and(present[:, : len(left)].any(axis=1), present[:, len(left) :].any(axis=1))
    sets = present[both]
    if len(sets) and np.any(sets != sets[0]):
        _, which, count = np.unique(sets, axis=0, return_inverse=True, return_counts=True)
        both[both] = which.reshape(-1) == int(np.argmax(count))
    return places, both


def _by_wheel(values: NDArray[Any] | None, places: Ints) -> list[Floats]:
    """Return the values (n,) of each wheel, NaN where it is not listed; none where nothing is recorded."""
    if values is None:
        return []
    columns = []
    for place in places.T:
        rows = (place >= 0) & (place < values.shape[1])
        if rows[0] and (place == place[0]).all():
            columns.append(values[:, place[0]])
        else:
            column = np.full(len(values), np.nan)
            # Where one row stands for all messages, none of them has a value of this wheel.
            if len(place) == len(column):
                column[rows] = values[rows, place[rows]]
            columns.append(column)
    return columns
