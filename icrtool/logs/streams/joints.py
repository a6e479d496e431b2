"""Reader of messages that list wheels as joints by name: all wheels in one message, or one wheel or side in each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from icrtool.config import Config
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.sources import WheelSource, stamp_rows, topic_fields
from icrtool.logs.streams.wheels import MOST_WHEELS, Quantity, average_wheels, unwind_turns, wheel_joints
from icrtool.records.notes import Note, note
from icrtool.records.text import listed


@dataclass(frozen=True, slots=True)
class Joints:
    """A message type that lists joints by name in any order, wheels and other joints.

    Attributes
    ----------
    label : name of the data, for the reason of a choice
    worth : score of the type; the source with the highest score is chosen
    names, position, speed : fields with the lists of the names, positions [rad] and speeds [rad/s]
    """

    label: str
    worth: float
    names: str
    position: str
    speed: str

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read."""
        return self.names, self.position, self.speed

    def read(self, table: TopicTable, config: Config) -> WheelSource:
        """Return the motion of the joints that are wheels; raise `DefinitionError` where the type lacks their names."""
        codes, texts = table.words(self.names)
        configured_names = config.wheels.left_joints, config.wheels.right_joints
        left, right = (
            [i for i, name in enumerate(texts) if name in configured] if configured else named
            for configured, named in zip(configured_names, wheel_joints(texts), strict=True)
        )
        lefts, names, problem = len(left), [texts[i] for i in left + right], ""
        if not (left and right):
            named = f"no left and right wheel among its joints {listed(texts)}"
            problem = f"{named}; name them in wheels.left_joints and right_joints" if texts else "lists no joints"
        elif max(lefts, len(right)) > MOST_WHEELS:
            problem = f"lists {lefts} left and {len(right)} right wheels; at most {MOST_WHEELS} of a side are read"
        if problem:
            return WheelSource(**topic_fields(table), joints=tuple(texts), problem=problem)
        # If all messages list the same joints in the same order, one row of `codes` stands for all of them.
        elements, usable = _elements_of(left, right, codes[:1] if codes.strides[0] == 0 else codes, len(texts))
        why = f"{self.label}: left {listed(names[:lefts])}, right {listed(names[lefts:])}"
        paths: dict[Quantity, str] = {"position": self.position, "speed": self.speed}
        wheels = (
            _by_message(table, paths, elements, usable) if usable.any() else _by_own_messages(table, paths, elements)
        )
        if wheels is None:
            problem = "the joints of the left and of the right were not recorded at the same time"
            return WheelSource(**topic_fields(table), joints=tuple(texts), problem=problem)
        columns, source, notes = wheels
        motion = average_wheels(
            lambda quantity: columns[quantity], lefts, names, "rad", **source, joints=tuple(texts), score=self.worth,
            why=why,
        )  # fmt: skip
        return replace(motion, notes=(*notes, *motion.notes))


WheelColumns = dict[Quantity, list[NDArray[Any]]]
"""Positions and speeds (n,) of each wheel; an empty list for a quantity that is not recorded."""

FEWEST_REPEATED = 5
"""Smallest number of repeated messages between other messages with which a second publisher is found."""

LITTLE_CHANGE = 0.5
"""Largest difference between the messages before and after a repeated message, as a share of their difference from the
repeated message, with which this message comes from a second publisher."""

USUAL_STEPS = 0.98
"""Quantile of the changes from message to message. A repeated state that is not zero must differ by more than this
quantile to come from a second publisher."""


def _by_message(
    table: TopicTable, paths: Mapping[Quantity, str], elements: Ints, usable: Bools
) -> tuple[WheelColumns, dict[str, Any], tuple[Note, ...]]:
    """Return the columns of messages that list both sides, the fields of a source for its topic, and findings."""
    if not usable.all():
        table, elements = table.rows(usable), elements[usable]
    columns: WheelColumns = {quantity: _by_wheel(table.find(path), elements) for quantity, path in paths.items()}
    foreign = _of_second_publisher(columns["position"], columns["speed"])
    if foreign is None:
        return columns, topic_fields(table), ()
    kept = {quantity: [column[~foreign] for column in wheels] for quantity, wheels in columns.items()}
    is_zero = not np.any([np.nan_to_num(column[foreign]).any() for wheels in columns.values() for column in wheels])
    state = "0 for every wheel" if is_zero else "the same motion"
    counted = f"{np.count_nonzero(foreign)} of {len(foreign)} messages state {state} between other motions"
    left_out = note("second_publisher", f"{counted}: they come from a second publisher and are left out")
    return kept, topic_fields(table.rows(~foreign)), (left_out,)


def _of_second_publisher(positions: Sequence[NDArray[Any]], speeds: Sequence[NDArray[Any]]) -> Bools | None:
    """Return a mask of the messages (n,) of a second publisher, which repeat one state; None where there are none.

    A second publisher sends zeros, or a state that it does not update, between messages with another motion. A robot
    that stops does not return to its motion at once. The numbers of an encoder with few counts also repeat, but they
    change by as little in other messages.
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
        used = [column for column in positions if np.nan_to_num(column[~repeated]).any()] or list(speeds)
        if _alternates(used, repeated):
            return repeated
    return None


def _most_repeated(sums: NDArray[np.float64]) -> Bools:
    """Return a mask of the messages (n,) with the sum that most stretches of equal sums have."""
    begins = np.append(True, sums[1:] != sums[:-1])
    values, count = np.unique(sums[begins], return_counts=True)
    return np.asarray(sums == values[int(np.argmax(count))])


@np.errstate(over="ignore", invalid="ignore")
def _alternates(columns: Sequence[NDArray[Any]], repeated: Bools) -> bool:
    """Return whether repeated messages (n,) lie between messages that differ little from each other.

    The difference is compared with the difference from the repeated state. Differences of values near the largest
    number overflow; such messages do not alternate.
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
    table: TopicTable, paths: Mapping[Quantity, str], elements: Ints
) -> tuple[WheelColumns, dict[str, Any], tuple[Note, ...]] | None:
    """Return the columns of wheels with a message for each wheel, at the stamps of the first wheel; as `_by_message`.

    Positions are interpolated, speeds are held. None is returned if the wheels were not recorded at the same time.
    """
    rows = [np.flatnonzero(element >= 0) for element in elements.T]
    stamps = [stamp_rows(table.rows(rows_of_wheel)) for rows_of_wheel in rows]
    all_have_headers = all(wheel_stamps.header_ns is not None for wheel_stamps in stamps)
    times = [wheel_stamps.on("header") if all_have_headers else wheel_stamps.log_ns for wheel_stamps in stamps]
    orders = [np.argsort(wheel_times, kind="stable") for wheel_times in times]
    times = [wheel_times[order] for wheel_times, order in zip(times, orders, strict=True)]
    half = max(int(np.median(np.diff(wheel_times))) // 2 if len(wheel_times) > 1 else 0 for wheel_times in times)
    positions = table.find(paths["position"])
    # Positions are not extrapolated, speeds by half an interval.
    slack = half if positions is None or not positions.shape[1] else 0
    first, last = (
        max(wheel_times[0] for wheel_times in times) - slack,
        min(wheel_times[-1] for wheel_times in times) + slack,
    )
    both = (times[0] >= first) & (times[0] <= last)
    if not both.any():
        return None
    moments = times[0][both]
    columns: WheelColumns = {"position": [], "speed": []}
    for quantity, path in paths.items():
        values = table.find(path)
        for wheel, (rows_of_wheel, order) in enumerate(zip(rows, orders, strict=True)):
            element = elements[rows_of_wheel, wheel]
            if values is None or element.max() >= values.shape[1]:
                columns[quantity] = []
                break
            stated = values[rows_of_wheel, element].astype(np.float64)[order]
            if quantity == "position":
                stated, finite = unwind_turns(stated), np.isfinite(stated)
                known = finite if finite.any() else ~finite
                columns[quantity].append(np.interp(moments, times[wheel][known], stated[known]))
            else:
                held = np.searchsorted(times[wheel], moments + half, side="right") - 1
                columns[quantity].append(stated[np.clip(held, 0, None)])
    source = topic_fields(table.rows(rows[0][orders[0]][both]))
    if not all_have_headers:
        source["stamps"] = replace(source["stamps"], header_ns=None, note="no header of every wheel", delay_ns=0)
    joined = note("wheels_joined", "each of its wheels has its own messages: they are joined by time")
    return columns, source, (joined,)


def _elements_of(left: Sequence[int], right: Sequence[int], codes: Ints, joints: int) -> tuple[Ints, Bools]:
    """Return the index of each wheel in the list of each message (n, k), and a mask of the messages (n,) to use.

    The index is -1 for a wheel that a message does not list. Only messages with the most frequent set of wheels of both
    sides are used, because a mean over changing wheels would jump.
    """
    wheels = [*left, *right]
    wheel = np.full(joints + 1, -1)
    wheel[wheels] = np.arange(len(wheels))
    rows, at = np.nonzero(wheel[codes] >= 0)
    elements = np.full((len(wheels), len(codes)), -1).T
    elements[rows, wheel[codes[rows, at]]] = at
    present = elements >= 0
    both: Bools = np.logical_and(present[:, : len(left)].any(axis=1), present[:, len(left) :].any(axis=1))
    sets = present[both]
    if len(sets) and np.any(sets != sets[0]):
        _, which, count = np.unique(sets, axis=0, return_inverse=True, return_counts=True)
        both[both] = which.reshape(-1) == int(np.argmax(count))
    return elements, both


def _by_wheel(values: NDArray[Any] | None, elements: Ints) -> list[Floats]:
    """Return the values (n,) of each wheel, NaN where it is not listed; an empty list if there are no values."""
    if values is None:
        return []
    columns = []
    for element in elements.T:
        rows = (element >= 0) & (element < values.shape[1])
        if rows[0] and (element == element[0]).all():
            columns.append(values[:, element[0]])
        else:
            column = np.full(len(values), np.nan)
            # If one row of `elements` stands for all messages, no message has a value of this wheel.
            if len(element) == len(column):
                column[rows] = values[rows, element[rows]]
            columns.append(column)
    return columns
