"""Readers of wheels with one number for each side: two topics, two fields of any message type, or an array."""

from __future__ import annotations

import re
from collections.abc import Container, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.config import Config, TopicsConfig
from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Ints
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.decoded_values import number_fields
from icrtool.logs.messages.definition_bounds import DefinitionBudget
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.bursts import spread_bursts
from icrtool.logs.streams.counters import TURN_MODULI, Modulus, find_modulus, register_size, unwrap_counter
from icrtool.logs.streams.message_types import KNOWN_TYPES
from icrtool.logs.streams.sources import (
    Sides,
    StampedRows,
    WheelSource,
    make_wheel_source,
    share_clock,
    stamp_rows,
    topic_fields,
)
from icrtool.logs.streams.wheels import (
    COMMAND_NOTES,
    COMMANDED,
    COMMANDED_PENALTY,
    MOST_WHEELS,
    WHEEL_WORDS,
    column_and_elements,
)
from icrtool.records.notes import note
from icrtool.records.samples import OWN_TWIST, WheelUnit
from icrtool.records.text import LogText

_NUMBERS = ("Float32", "Float64", "Int16", "Int32", "Int64", "UInt16", "UInt32", "UInt64")
BYTE_TYPES = {"std_msgs/Int8", "std_msgs/UInt8"}
"""Message types that may hold a counter of 8 bits, or something else, such as the state of a lamp. The name of the
topic decides."""

PAIR_TYPES = {f"std_msgs/{name}" for name in _NUMBERS} | BYTE_TYPES
"""Message types that may hold the number of one side."""

ARRAY_TYPES = {f"std_msgs/{name}MultiArray" for name in _NUMBERS}
"""Message types that may hold the numbers of all wheels."""

_SPEED_WORDS = re.compile(r"vel|speed|rate|rpm|twist", re.IGNORECASE)
_PLACE_WORDS = re.compile(r"tick|count|enc|pos|angle|travel|dist|odo", re.IGNORECASE)
_OTHER_WORDS = re.compile(
    r"current|volt|temp|power|torque|effort|force|pwm|duty|status|error|fault|limit|gain|stamp|time|range",
    re.IGNORECASE,
)
"""Words in names of fields of motor drivers that hold no motion."""

_SIDE_WORDS = re.compile("left|right", re.IGNORECASE)
_ONLY_SIDE = re.compile(
    r"(?:(?:left|right|front|rear|wheels?|tracks?|motor|drive|side|value|data)_?|\d)+", re.IGNORECASE
)
"""Pattern of the names of fields that state only the side; the name of the topic or message states the quantity."""

_OF_WHEELS = re.compile(
    rf"{WHEEL_WORDS.pattern}|tick|encoder|(?<![a-z])enc(?![a-z])|rpm|vesc|roboteq|roboclaw", re.IGNORECASE
)
"""Words in names of topics, types or fields about wheels; the last words are brands of motor controllers."""

MOST_SCANNED = 1 << 21
"""Largest number of characters of the definitions of a log that are searched for words about wheels."""

MOST_SEARCHED = 1 << 17
"""Largest number of characters of the definitions with words about wheels that are parsed, for about ten types."""

MOST_PATHS = 1 << 20
"""Largest number of characters of the paths of all fields that are found."""

MOST_PAIRS = 256
"""Largest number of pairs of sides of a log that are read."""

_LONGEST_HOLD_NS = 500_000_000
"""Longest time for which the last value of the side that ends first is held [ns]."""


@dataclass(frozen=True, slots=True)
class Side:
    """The number of one side in the messages of a topic.

    Attributes
    ----------
    table : messages of the topic
    path : field of the number, such as ``data``, ``left_ticks`` or ``drivers[0].speed``; ``data[0,2]`` is the mean of
        two elements
    """

    table: TopicTable
    path: str = "data"

    @property
    def name(self) -> LogText:
        """Name for `topics.wheel_left`: the topic, and after a dot the field if it is not ``data``."""
        return LogText(_name(LogText(self.table.topic).raw, self.path))

    def columns(self) -> list[NDArray[Any]]:
        """Return the recorded numbers (n,) of each element that the path names.

        Raises
        ------
        DefinitionError
            The messages have no such field or element.
        """
        column, elements = column_and_elements(self.path)
        values = self.table.column(column)
        if not elements:
            return [values]
        if values.ndim != 2 or max(elements) >= values.shape[1]:
            raise DefinitionError(self.name, "its messages have no such element")
        return [values[:, element] for element in elements]


class PairNumbers(NamedTuple):
    """The numbers of both sides (n,), continued beyond the modulus of a counter, and this modulus; None without one."""

    left: NDArray[Any]
    right: NDArray[Any]
    modulus: Modulus | None


def numbers_of(left: Side, right: Side, config: Config) -> PairNumbers:
    """Return the numbers of two sides; for a side with several elements their mean.

    Raises
    ------
    DefinitionError
        The messages of a side have no such field or element.
    """
    sides = [left.columns(), right.columns()]
    modulus = None
    if not _is_speed(left, config):
        modulus = find_modulus([column for side in sides for column in side], config.robot.encoder_counts_per_rev)
        if modulus is None and left.table.message_type in BYTE_TYPES:
            modulus = Modulus(256.0)
    means = []
    for side in sides:
        wheels = [_continue_counter(column, modulus) for column in side]
        means.append(wheels[0] if len(wheels) == 1 else np.asarray(np.mean(wheels, axis=0)))
    return PairNumbers(means[0], means[1], modulus)


def _is_speed(side: Side, config: Config) -> bool:
    """Return whether the configuration, or the name of the field or topic, states that the numbers are speeds."""
    if config.wheels.quantity != "auto":
        return config.wheels.quantity == "velocity"
    found = (
        words for name in (side.path, side.table.topic) for words in (_SPEED_WORDS, _PLACE_WORDS) if words.search(name)
    )
    return next(found, None) is _SPEED_WORDS


def topic_of_side(name: str) -> str:
    """Return the topic in the name of a side, up to the dot; names of topics contain no dot."""
    return name.partition(".")[0]


def _name(topic: str, path: str) -> str:
    """Return the name of a side for `topics.wheel_left`."""
    return topic if path == "data" else f"{topic}.{path}"


def side_fields(channels: Sequence[Channel], topics: TopicsConfig) -> dict[int, set[str]]:
    """Return the fields that may be one side, or hold all wheels, by channel id."""
    fields: dict[int, set[str]] = {channel.id: set() for channel in channels}
    if named := topics.fields_of_wheels:
        for topic, _, path in (name.partition(".") for name in named.values()):
            for channel in channels:
                if channel.topic == topic:
                    fields[channel.id].add(column_and_elements(path or "data")[0])
        return fields
    names: dict[str, dict[str, list[tuple[int, str]]]] = {}
    search = _Search()
    for channel in channels:
        if topics.wheels in (None, channel.topic):
            names_of_type = names.setdefault(channel.message_type, {})
            for path in _fields_of(channel, search):
                names_of_type.setdefault(_name(channel.topic, path), []).append((channel.id, path))
    for names_of_type in names.values():
        for left, fields_of_left in names_of_type.items():
            right = find_right_twin(left, names_of_type)
            if right is not None or "[" in left:
                for number, path in [*fields_of_left, *names_of_type.get(right or "", [])]:
                    fields[number].add(path)
    return fields


@dataclass(slots=True)
class _Search:
    """Search for wheels in the definitions of a log, with limits; each definition is searched once.

    Attributes
    ----------
    scan_left, paths_left : remaining characters of definitions and of paths
    budget : remaining cost of definitions that are parsed
    words : by type and definition, whether the definition has a word of a side, and a word about wheels
    fields : by type and definition, the paths of the numbers
    """

    scan_left: int = MOST_SCANNED
    budget: DefinitionBudget = field(default_factory=lambda: DefinitionBudget(MOST_SEARCHED))
    paths_left: int = MOST_PATHS
    words: dict[tuple[str, str], tuple[bool, bool]] = field(default_factory=dict)
    fields: dict[tuple[str, str], list[str]] = field(default_factory=dict)

    def words_of(self, channel: Channel) -> tuple[bool, bool]:
        """Return whether the definition of a channel has a word of a side, and a word about wheels."""
        key = (channel.message_type, channel.definition)
        if key not in self.words:
            self.scan_left -= len(channel.definition)
            text = channel.definition if self.scan_left >= 0 else ""
            self.words[key] = bool(_SIDE_WORDS.search(text)), bool(_OF_WHEELS.search(text))
        return self.words[key]

    def fields_of(self, channel: Channel) -> list[str]:
        """Return the paths of the numbers in the messages of a channel; none beyond the limits of the search."""
        key = (channel.message_type, channel.definition)
        if key not in self.fields:
            self.fields[key] = []
            with suppress(DefinitionError):
                self.budget.take(channel)
                self.fields[key] = number_fields(channel)
        fields = []
        for path in self.fields[key]:
            self.paths_left -= len(path) + len(channel.topic)
            if self.paths_left < 0:
                break
            fields.append(path)
        return fields


def _fields_of(channel: Channel, search: _Search) -> list[str]:
    """Return the fields of a channel's messages that may belong to wheels, by the names of topic, type and fields."""
    topic, message_type = channel.topic, channel.message_type
    if message_type in PAIR_TYPES:
        return ["data"] if _may_be_side(topic, message_type, "data") else []
    if message_type in ARRAY_TYPES:
        return ["data[*]"] if _OF_WHEELS.search(topic) and not _OTHER_WORDS.search(topic) else []
    if message_type in KNOWN_TYPES:
        return []
    name, (has_side, has_wheels) = f"{topic} {message_type}", search.words_of(channel)
    if not ((has_side or _SIDE_WORDS.search(name)) and (has_wheels or _OF_WHEELS.search(name))):
        return []
    return [path for path in search.fields_of(channel) if _may_be_side(topic, message_type, path)]


def _may_be_side(topic: str, message_type: str, path: str) -> bool:
    """Return whether a field may be the motion of a wheel, not a current or a state of a motor driver."""
    if message_type in BYTE_TYPES:
        return path == "data" and bool(_OF_WHEELS.search(topic)) and not _OTHER_WORDS.search(topic)
    if message_type in PAIR_TYPES:
        return path == "data"
    if not _OF_WHEELS.search(f"{topic} {message_type} {path}") or _OTHER_WORDS.search(path):
        return False
    field = path.rpartition(".")[2]
    only_side = bool(_ONLY_SIDE.fullmatch(field) and _SIDE_WORDS.search(field))
    return only_side or any(words.search(path) for words in (_SPEED_WORDS, _PLACE_WORDS))


def pair_candidates(tables: Sequence[TopicTable], config: Config) -> list[WheelSource]:
    """Return sources of two sides: the configured fields, or all pairs that the names of topics and fields show."""
    topics = config.topics
    if fields_named := topics.fields_of_wheels:
        by_topic: dict[str, TopicTable] = {table.topic: table for table in tables}
        named = (name.partition(".") for name in fields_named.values())
        sides = [Side(by_topic[topic], path or "data") for topic, _, path in named if topic in by_topic]
        motion = twist_motion if "twist_speed" in fields_named else pair_motion
        return [motion(sides[0], sides[1], config)] if len(sides) == 2 else []
    sides_of: dict[str, dict[str, Side]] = {}
    for table in tables:
        if table.message_type in KNOWN_TYPES or topics.wheels not in (None, table.topic):
            continue
        for path in table.columns:
            if _may_be_side(table.topic, table.message_type, path):
                side = Side(table, path)
                sides_of.setdefault(table.message_type, {})[side.name] = side
    pairs = (
        (left, sides_of_type[right])
        for sides_of_type in sides_of.values()
        for name, left in sides_of_type.items()
        if (right := find_right_twin(name, sides_of_type)) is not None
    )
    motions = [pair_motion(left, right, config) for left, right in islice(pairs, MOST_PAIRS)]
    arrays = (table for table in tables if table.message_type in ARRAY_TYPES and len(table))
    return motions + [_array_motion(table, config) for table in arrays]


def _array_motion(table: TopicTable, config: Config) -> WheelSource:
    """Return the motion of the wheels in an array; the side of its first element is taken as left.

    The motion of a wheel minus the mean of all wheels shows the turn, with opposite signs on the two sides.
    """
    values = table.column("data[*]")
    modulus = find_modulus(list(values.T), config.robot.encoder_counts_per_rev)
    wheels = np.array([_continue_counter(column, modulus) for column in values.T])
    turning = wheels - wheels.mean(axis=0)
    turning -= turning.mean(axis=1, keepdims=True)
    is_left = turning @ turning[0] > 0.0
    if len(wheels) > 2 * MOST_WHEELS or not 0 < 2 * np.count_nonzero(is_left) == len(wheels):
        advice = f"name them in topics.wheel_left and wheel_right, as {_name(table.topic, 'data[0]')}"
        return WheelSource(**topic_fields(table), problem=f"it does not show as many left as right wheels; {advice}")
    left, right = (f"data[{','.join(map(str, np.flatnonzero(side)))}]" for side in (is_left, ~is_left))
    return pair_motion(Side(table, left), Side(table, right), config)


def pair_motion(left: Side, right: Side, config: Config) -> WheelSource:
    """Return the wheel motion of two sides at the stamps of the left side.

    Positions of the right side are interpolated, speeds are held.
    """
    topic = LogText(f"{left.name.raw} + {right.name.raw}")
    message_type = LogText(" + ".join(dict.fromkeys(LogText(side.table.message_type).raw for side in (left, right))))
    commanded = bool(COMMANDED.search(left.name))
    score, why = (
        80.0 - (COMMANDED_PENALTY if commanded else 0.0),
        "a number of each side" + (" (commanded)" if commanded else ""),
    )
    stamps, times, right_times = _common_stamps(left.table, right.table)
    try:
        if not (len(times) and len(right_times)):
            raise DefinitionError(topic, f"{(right if len(times) else left).table.topic} holds no message")
        lefts, rights, modulus = numbers_of(left, right, config)
        # Only the time in which both sides were recorded is used: a side held for a long time would look like a turn.
        slack = max(_half_interval(times), _half_interval(right_times))
        both = (times >= right_times[0] - slack) & (times <= right_times[-1] + max(slack, _LONGEST_HOLD_NS))
        if not both.any():
            raise DefinitionError(topic, "the two sides were not recorded at the same time")
    except DefinitionError as err:
        return WheelSource(topic=topic, message_type=message_type, stamps=stamps, score=score, problem=err.why)
    moments, first, integer = times[both], lefts[both].astype(np.float64), lefts.dtype.kind == "i"
    position: Sides = (None, None)
    speed: Sides = (None, None)
    unit: WheelUnit = "unknown"
    notes = COMMAND_NOTES if commanded else ()
    if modulus is not None or _is_position(left, lefts, config, integer=integer):
        unit = "counts" if integer or config.wheels.quantity == "counts" else "unknown"
        quantity = "ticks" if unit == "counts" else "angles or distances"
        position = first, np.interp(moments, right_times, rights)
        if modulus is not None:
            finding = f"the numbers show that they begin again at {modulus.text}: they are continued"
            notes = (note("counter_begins_again", finding), *notes)
            if modulus.value in TURN_MODULI and not integer:
                unit, quantity = "rad", "angles"
                radians = 2 * np.pi / modulus.value
                position = first * radians, np.interp(moments, right_times, rights) * radians
    else:
        row = np.clip(np.searchsorted(right_times, moments + _half_interval(times), side="right") - 1, 0, None)
        quantity, speed = "speeds", (first, rights[row].astype(np.float64))
    header = None if stamps.header_ns is None else stamps.header_ns[both]
    far = None if stamps.far_ns is None else stamps.far_ns[both]
    stamps = replace(stamps, header_ns=header, log_ns=stamps.log_ns[both], far_ns=far)
    why = f"{why}: {quantity}"
    return make_wheel_source(
        topic=topic, message_type=message_type, stamps=stamps, position=position, speed=speed, unit=unit, score=score,
        why=why, notes=notes,
    )  # fmt: skip


def twist_motion(speed: Side, turn: Side, config: Config) -> WheelSource:
    """Return the body twist in two fields, forward speed [m/s] and turn rate [rad/s], at the stamps of the speed."""
    motion = pair_motion(speed, turn, replace(config, wheels=replace(config.wheels, quantity="velocity")))
    if motion.speed is None:
        return motion
    message_type = LogText(f"{LogText(motion.message_type).raw}{OWN_TWIST}")
    why = "speed and turn rate of the body in the configured fields"
    return replace(motion, message_type=message_type, twist=np.column_stack(motion.speed), speed=None, why=why)


def _common_stamps(left: TopicTable, right: TopicTable) -> tuple[StampedRows, Ints, Ints]:
    """Return the stamps of the left side, and the times of both sides (n,) [ns]: header stamps if both have them."""
    rows = stamp_rows(left), stamp_rows(right)
    headers = [side.header_ns for side in rows if side.header_ns is not None and (np.diff(side.header_ns) >= 0).all()]
    clock_set = max(side.clock_set for side in rows)
    stamps = replace(rows[0], backward_step=max(side.backward_step for side in rows), clock_set=clock_set)
    if len(headers) == 2:
        return stamps, spread_bursts(headers[0]).stamp_ns, spread_bursts(headers[1]).stamp_ns
    why = rows[0].note or rows[1].note or "the header stamps of a side go back"
    far = rows[0].far_ns if share_clock(rows) else None
    stamps = replace(stamps, header_ns=None, note=why, delay_ns=0, replaced=0, far_ns=far)
    return stamps, spread_bursts(rows[0].log_ns).stamp_ns, spread_bursts(rows[1].log_ns).stamp_ns


def _half_interval(times: Ints) -> int:
    """Return half the median interval [ns]. Messages of one control cycle are logged at a shorter distance."""
    return int(np.median(np.diff(times))) // 2 if len(times) > 1 else 0


def _continue_counter(values: NDArray[Any], modulus: Modulus | None) -> NDArray[Any]:
    """Return a counter (n,) continued beyond its modulus.

    Without a modulus, whole numbers are continued as a counter of 16 or 32 bits, and other numbers are returned.
    """
    if not len(values) or (modulus is None and values.dtype.kind == "f"):
        return values
    size = modulus.value if modulus is not None else register_size(values)
    return values if size is None else unwrap_counter(values, size)


def _is_position(side: Side, values: NDArray[Any], config: Config, *, integer: bool) -> bool:
    """Return whether the numbers of a side (n,) are positions (ticks, angles), not speeds."""
    if config.wheels.quantity != "auto":
        return config.wheels.quantity in ("position", "counts")
    for name in (side.path, side.table.topic):
        if _SPEED_WORDS.search(name):
            return False
        if _PLACE_WORDS.search(name):
            return True
    finite = values[np.isfinite(values)]
    if len(finite) < 3 or np.ptp(finite) == 0:
        return integer
    # The steps of a position add up to about its range. A speed varies around a few values.
    return bool(np.abs(np.diff(finite)).sum() < 3.0 * np.ptp(finite) and np.ptp(finite) > 5.0)


_LONE_L = re.compile(r"(?<![^\W\d_])[lL]|(?<=[^\W\d_A-Z])L|[lL](?![^\W\d_])")
"""Pattern of a letter L that begins or ends a word: ``/lwheel``, ``enc_L``, ``/WL``, ``frontL``."""


def find_right_twin(left: str, names: Container[str]) -> str | None:
    """Return the name in `names` that is `left` with left replaced by right; None without such a name."""
    for old, new in (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT")):
        if old in left:
            twin = left.replace(old, new)
            return twin if twin in names else None
    for found in _LONE_L.finditer(left):
        twin = f"{left[: found.start()]}{'r' if found[0] == 'l' else 'R'}{left[found.end() :]}"
        if twin in names:
            return twin
    return None
