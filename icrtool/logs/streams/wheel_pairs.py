"""Wheels as one number of each side: two topics, two fields of messages of any type, or the elements of an array."""

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
from icrtool.logs.streams.sources import Sides, StampedRows, WheelSource, motion_of, of_topic, share_clock, stamp_rows
from icrtool.logs.streams.wheels import (
    COMMAND_NOTES,
    COMMANDED,
    COMMANDED_PENALTY,
    MOST_WHEELS,
    WHEEL_WORDS,
    column_and_places,
)
from icrtool.records.notes import note
from icrtool.records.samples import OWN_TWIST, WheelUnit
from icrtool.records.text import LogText

_NUMBERS = ("Float32", "Float64", "Int16", "Int32", "Int64", "UInt16", "UInt32", "UInt64")
BYTE_TYPES = {"std_msgs/Int8", "std_msgs/UInt8"}
"""Message types that may hold a counter of 8 bits or, for example, the state of a lamp: the topic's name decides."""

PAIR_TYPES = {f"std_msgs/{name}" for name in _NUMBERS} | BYTE_TYPES
"""Message types that hold one number of one side."""

ARRAY_TYPES = {f"std_msgs/{name}MultiArray" for name in _NUMBERS}
"""Message types that may hold the numbers of all wheels."""

_SPEED_WORDS = re.compile(r"vel|speed|rate|rpm|twist", re.IGNORECASE)
_PLACE_WORDS = re.compile(r"tick|count|enc|pos|angle|travel|dist|odo", re.IGNORECASE)
_OTHER_WORDS = re.compile(
    r"current|volt|temp|power|torque|effort|force|pwm|duty|status|error|fault|limit|gain|stamp|time|range",
    re.IGNORECASE,
)
"""Words in fields of a motor driver's messages that are no motion."""

_SIDE_WORDS = re.compile("left|right", re.IGNORECASE)
_ONLY_SIDE = re.compile(
    r"(?:(?:left|right|front|rear|wheels?|tracks?|motor|drive|side|value|data)_?|\d)+", re.IGNORECASE
)
"""A field whose name states only the side: the name of the topic or message states what it is."""

_OF_WHEELS = re.compile(
    rf"{WHEEL_WORDS.pattern}|tick|encoder|(?<![a-z])enc(?![a-z])|rpm|vesc|roboteq|roboclaw", re.IGNORECASE
)
"""Words of a message about wheels; the last ones are makes of motor controllers."""

MOST_LOOKED_AT = 1 << 21
"""Largest number of characters of definitions in a log that are searched for words of wheels."""

MOST_SEARCHED = 1 << 17
"""Largest number of characters of definitions with words of wheels, whose fields are searched for sides: some ten
types."""

MOST_PATHS = 1 << 20
"""Largest number of characters of the paths of the fields that are found."""

MOST_PAIRS = 256
"""Largest number of pairs of sides of a log that are tried."""

_HOLD_NS = 500_000_000
"""Longest time for which the last value of the side that ends first is held [ns]."""


@dataclass(frozen=True, slots=True)
class Side:
    """A number of one side in the messages of a topic.

    Attributes
    ----------
    path : its field, ``data``, ``left_ticks``, ``drivers[0].speed``; for several elements, ``data[0,2]``, their mean
    """

    table: TopicTable
    path: str = "data"

    @property
    def name(self) -> LogText:
        """The name as `topics.wheel_left` has it: the topic, and after a dot the field where it is not ``data``."""
        return LogText(_name(LogText(self.table.topic).raw, self.path))

    def columns(self) -> list[NDArray[Any]]:
        """Return its numbers (n,) as recorded, of each element that the path names.

        Raises
        ------
        DefinitionError
            The messages have no such field or element.
        """
        column, places = column_and_places(self.path)
        values = self.table.column(column)
        if not places:
            return [values]
        if values.ndim != 2 or max(places) >= values.shape[1]:
            raise DefinitionError(self.name, "its messages have no such element")
        return [values[:, place] for place in places]


class PairNumbers(NamedTuple):
    """The numbers of both sides (n,), counters continued, and the modulus at which they begin again, if found."""

    left: NDArray[Any]
    right: NDArray[Any]
    modulus: Modulus | None


def numbers_of(left: Side, right: Side, config: Config) -> PairNumbers:
    """Return the numbers of two sides; the mean where a side has several elements.

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
        wheels = [_unwrapped(column, modulus) for column in side]
        means.append(wheels[0] if len(wheels) == 1 else np.asarray(np.mean(wheels, axis=0)))
    return PairNumbers(means[0], means[1], modulus)


def _is_speed(side: Side, config: Config) -> bool:
    """Return whether the configuration, or the name of a field or topic, states that numbers are speeds."""
    if config.wheels.quantity != "auto":
        return config.wheels.quantity == "velocity"
    found = (
        words for name in (side.path, side.table.topic) for words in (_SPEED_WORDS, _PLACE_WORDS) if words.search(name)
    )
    return next(found, None) is _SPEED_WORDS


def topic_of_side(name: str) -> str:
    """Return the topic in a side's name; names of topics hold no dot."""
    return name.partition(".")[0]


def _name(topic: str, path: str) -> str:
    return topic if path == "data" else f"{topic}.{path}"


def side_fields(channels: Sequence[Channel], topics: TopicsConfig) -> dict[int, set[str]]:
    """Return, by channel id, the fields that may be one side, or that hold all wheels."""
    fields: dict[int, set[str]] = {channel.id: set() for channel in channels}
    if named := topics.fields_of_wheels:
        for topic, _, path in (name.partition(".") for name in named.values()):
            for channel in channels:
                if channel.topic == topic:
                    fields[channel.id].add(column_and_places(path or "data")[0])
        return fields
    names: dict[str, dict[str, list[tuple[int, str]]]] = {}
    search = _Search()
    for channel in channels:
        if topics.wheels in (None, channel.topic):
            alike = names.setdefault(channel.message_type, {})
            for path in _fields_of(channel, search):
                alike.setdefault(_name(channel.topic, path), []).append((channel.id, path))
    for alike in names.values():
        for left, places in alike.items():
            right = right_twin(left, alike)
            if right is not None or "[" in left:
                for number, path in [*places, *alike.get(right or "", [])]:
                    fields[number].add(path)
    return fields


@dataclass(slots=True)
class _Search:
    """Results of the search in the definitions of a log, each searched once, and the limits that are left.

    Attributes
    ----------
    looked_at, paths : characters that are left
    searched : limit of what is parsed
    of_wheels : by type and definition, whether words of wheels and of sides are in it
    fields : by type and definition, the paths of its numbers
    """

    looked_at: int = MOST_LOOKED_AT
    searched: DefinitionBudget = field(default_factory=lambda: DefinitionBudget(MOST_SEARCHED))
    paths: int = MOST_PATHS
    of_wheels: dict[tuple[str, str], tuple[bool, bool]] = field(default_factory=dict)
    fields: dict[tuple[str, str], list[str]] = field(default_factory=dict)

    def words_of(self, channel: Channel) -> tuple[bool, bool]:
        """Return whether the definition of a channel has a word of a side, and one of wheels."""
        one = (channel.message_type, channel.definition)
        if one not in self.of_wheels:
            self.looked_at -= len(channel.definition)
            text = channel.definition if self.looked_at >= 0 else ""
            self.of_wheels[one] = bool(_SIDE_WORDS.search(text)), bool(_OF_WHEELS.search(text))
        return self.of_wheels[one]

    def fields_of(self, channel: Channel) -> list[str]:
        """Return the paths of the numbers in the messages of a channel; none beyond the limits of the search."""
        one = (channel.message_type, channel.definition)
        if one not in self.fields:
            self.fields[one] = []
            with suppress(DefinitionError):
                self.searched.take(channel)
                self.fields[one] = number_fields(channel)
        fields = []
        for path in self.fields[one]:
            self.paths -= len(path) + len(channel.topic)
            if self.paths < 0:
                break
            fields.append(path)
        return fields


def _fields_of(channel: Channel, search: _Search) -> list[str]:
    """Return the fields of a channel's messages that may belong to wheels; for unknown types, by their names."""
    topic, message_type = channel.topic, channel.message_type
    if message_type in PAIR_TYPES:
        return ["data"] if _may_be_side(topic, message_type, "data") else []
    if message_type in ARRAY_TYPES:
        return ["data[*]"] if _OF_WHEELS.search(topic) and not _OTHER_WORDS.search(topic) else []
    if message_type in KNOWN_TYPES:
        return []
    name, (side, of_wheels) = f"{topic} {message_type}", search.words_of(channel)
    if not ((side or _SIDE_WORDS.search(name)) and (of_wheels or _OF_WHEELS.search(name))):
        return []
    return [path for path in search.fields_of(channel) if _may_be_side(topic, message_type, path)]


def _may_be_side(topic: str, message_type: str, path: str) -> bool:
    """Return whether a field may be a wheel's motion: a driver's messages hold currents and states, too."""
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
    """Return the wheels made of two sides: the configured ones, or all that the names of topics and fields show."""
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
        (left, alike[right])
        for alike in sides_of.values()
        for name, left in alike.items()
        if (right := right_twin(name, alike)) is not None
    )
    motions = [pair_motion(left, right, config) for left, right in islice(pairs, MOST_PAIRS)]
    arrays = (table for table in tables if table.message_type in ARRAY_TYPES and len(table))
    return motions + [_array_motion(table, config) for table in arrays]


def _array_motion(table: TopicTable, config: Config) -> WheelSource:
    """Return the motion of wheels in an array; the side of the first one is taken as left.

    A wheel's motion minus the mean of all wheels is its part of the turn, which has opposite signs on the two sides.
    """
    values = table.column("data[*]")
    modulus = find_modulus(list(values.T), config.robot.encoder_counts_per_rev)
    wheels = np.array([_unwrapped(column, modulus) for column in values.T])
    turning = wheels - wheels.mean(axis=0)
    turning -= turning.mean(axis=1, keepdims=True)
    alike = turning @ turning[0] > 0.0
    if len(wheels) > 2 * MOST_WHEELS or not 0 < 2 * np.count_nonzero(alike) == len(wheels):
        advice = f"name them in topics.wheel_left and wheel_right, as {_name(table.topic, 'data[0]')}"
        return WheelSource(**of_topic(table), problem=f"it does not show as many left as right wheels; {advice}")
    left, right = (f"data[{','.join(map(str, np.flatnonzero(side)))}]" for side in (alike, ~alike))
    return pair_motion(Side(table, left), Side(table, right), config)


def pair_motion(left: Side, right: Side, config: Config) -> WheelSource:
    """Return the wheel motion of two sides, at the left one's stamps.

    Positions are interpolated, speeds are held.
    """
    topic = LogText(f"{left.name.raw} + {right.name.raw}")
    kind = LogText(" + ".join(dict.fromkeys(LogText(side.table.message_type).raw for side in (left, right))))
    commanded = bool(COMMANDED.search(left.name))
    score, why = (
        80.0 - (COMMANDED_PENALTY if commanded else 0.0),
        "a number of each side" + (" (commanded)" if commanded else ""),
    )
    stamps, times, held = _common_stamps(left.table, right.table)
    try:
        if not (len(times) and len(held)):
            raise DefinitionError(topic, f"{(right if len(times) else left).table.topic} holds no message")
        lefts, rights, modulus = numbers_of(left, right, config)
        # Only while both were recorded: a side that is held for a long time would look like a turn.
        slack = max(_half_interval(times), _half_interval(held))
        both = (times >= held[0] - slack) & (times <= held[-1] + max(slack, _HOLD_NS))
        if not both.any():
            raise DefinitionError(topic, "the two sides were not recorded at the same time")
    except DefinitionError as err:
        return WheelSource(topic=topic, message_type=kind, stamps=stamps, score=score, problem=err.why)
    moments, first, integer = times[both], lefts[both].astype(np.float64), lefts.dtype.kind == "i"
    position: Sides = (None, None)
    speed: Sides = (None, None)
    unit: WheelUnit = "unknown"
    notes = COMMAND_NOTES if commanded else ()
    if modulus is not None or _is_position(left, lefts, config, integer=integer):
        unit = "counts" if integer or config.wheels.quantity == "counts" else "unknown"
        what = "ticks" if unit == "counts" else "angles or distances"
        position = first, np.interp(moments, held, rights)
        if modulus is not None:
            counted = f"its numbers begin again at {modulus.text}, as they show: counted on"
            notes = (note("counter_begins_again", counted), *notes)
            if modulus.value in TURN_MODULI and not integer:
                unit, what = "rad", "angles"
                radians = 2 * np.pi / modulus.value
                position = first * radians, np.interp(moments, held, rights) * radians
    else:
        place = np.clip(np.searchsorted(held, moments + _half_interval(times), side="right") - 1, 0, None)
        what, speed = "speeds", (first, rights[place].astype(np.float64))
    header = None if stamps.header_ns is None else stamps.header_ns[both]
    far = None if stamps.far_ns is None else stamps.far_ns[both]
    stamps = replace(stamps, header_ns=header, log_ns=stamps.log_ns[both], far_ns=far)
    why = f"{why}: {what}"
    return motion_of(
        topic=topic, message_type=kind, stamps=stamps, position=position, speed=speed, unit=unit, score=score, why=why,
        notes=notes,
    )  # fmt: skip


def twist_motion(speed: Side, turn: Side, config: Config) -> WheelSource:
    """Return the body twist of two fields, forward speed [m/s] and turn rate [rad/s], at the stamps of the speed."""
    motion = pair_motion(speed, turn, replace(config, wheels=replace(config.wheels, quantity="velocity")))
    if motion.speed is None:
        return motion
    kind = LogText(f"{LogText(motion.message_type).raw}{OWN_TWIST}")
    why = "speed and turn rate of the body in fields of its own"
    return replace(motion, message_type=kind, twist=np.column_stack(motion.speed), speed=None, why=why)


def _common_stamps(left: TopicTable, right: TopicTable) -> tuple[StampedRows, Ints, Ints]:
    """Return the stamps of the left side, and the times of both sides: of headers if both have them, else logged."""
    rows = stamp_rows(left), stamp_rows(right)
    headers = [one.header_ns for one in rows if one.header_ns is not None and (np.diff(one.header_ns) >= 0).all()]
    clock_set = max(one.clock_set for one in rows)
    stamps = replace(rows[0], backward_step=max(one.backward_step for one in rows), clock_set=clock_set)
    if len(headers) == 2:
        return stamps, spread_bursts(headers[0]).stamp_ns, spread_bursts(headers[1]).stamp_ns
    why = rows[0].note or rows[1].note or "the header stamps of a side go back"
    far = rows[0].far_ns if share_clock(rows) else None
    stamps = replace(stamps, header_ns=None, note=why, delay_ns=0, replaced=0, far_ns=far)
    return stamps, spread_bursts(rows[0].log_ns).stamp_ns, spread_bursts(rows[1].log_ns).stamp_ns


def _half_interval(times: Ints) -> int:
    """Return half the median interval [ns]: messages of one control cycle are logged closer together than this."""
    return int(np.median(np.diff(times))) // 2 if len(times) > 1 else 0


def _unwrapped(values: NDArray[Any], modulus: Modulus | None) -> NDArray[Any]:
    """Return a counter (n,) continued past its modulus; None: past the smaller of 16 and 32 bits that holds it."""
    if not len(values) or (modulus is None and values.dtype.kind == "f"):
        return values
    size = modulus.value if modulus is not None else register_size(values)
    return values if size is None else unwrap_counter(values, size)


def _is_position(side: Side, values: NDArray[Any], config: Config, *, integer: bool) -> bool:
    """Return whether a pair's numbers are positions (ticks, angles), not speeds."""
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
    # A position's steps add up to about its range; a speed varies around few values.
    return bool(np.abs(np.diff(finite)).sum() < 3.0 * np.ptp(finite) and np.ptp(finite) > 5.0)


_LONE_L = re.compile(r"(?<![^\W\d_])[lL]|(?<=[^\W\d_A-Z])L|[lL](?![^\W\d_])")
"""A letter that begins or ends a word: ``/lwheel``, ``enc_L``, ``/WL``, ``frontL``."""


def right_twin(left: str, names: Container[str]) -> str | None:
    """Return the name that is `left` with left replaced by right; None when there is none."""
    for old, new in (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT")):
        if old in left:
            twin = left.replace(old, new)
            return twin if twin in names else None
    for found in _LONE_L.finditer(left):
        twin = f"{left[: found.start()]}{'r' if found[0] == 'l' else 'R'}{left[found.end() :]}"
        if twin in names:
            return twin
    return None
