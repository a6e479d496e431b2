"""Topics that may feed a role: what was read of each, and the fields of messages that it is read from."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bools, Bytes, Floats
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.stamps import StampedRows, stamp_rows

NEVER_MOVES = 60.0
"""Subtracted from the score of what never moves: another topic that moves is preferred."""

NO_ROWS: Bools = np.zeros(0, np.bool_)


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A topic, or a pair of topics, that may feed a role; of one that cannot be read the subclass holds no values.

    Attributes
    ----------
    score : how suitable the type is; why : the reason as text
    problem : why it cannot be used, empty when it can
    note : what a user must know of it
    usable : (n,) rows to use, of positions and headings
    """

    topic: str
    message_type: str
    stamps: StampedRows
    score: float = 0.0
    why: str = ""
    problem: str = ""
    note: str = ""
    usable: Bools = field(default_factory=lambda: NO_ROWS)

    @property
    def is_empty(self) -> bool:
        """Whether no row can be used, even where the topic is configured."""
        return not self.usable.any()


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionSource(Source):
    """Positions of one topic.

    Attributes
    ----------
    geodetic : (n, 3) latitude, longitude [deg], ellipsoidal height [m]; None where metric
    metric : (n, 2) north, east [m] in the topic's own frame; None where geodetic
    variance : (n, 3) north, east, covariance of both [m^2]; NaN where not stated
    rejected : how many rows are not used, by reason
    stated_class : uint8 (n,) how the position was solved, None where no message states it
    """

    geodetic: Floats | None = None
    metric: Floats | None = None
    variance: Floats = field(default_factory=lambda: np.empty((0, 3)))
    rejected: dict[str, int] = field(default_factory=dict)
    stated_class: Bytes | None = None


Convention = Literal["enu", "ned"]


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadingSource(Source):
    """Headings of one topic.

    Attributes
    ----------
    yaw_rad : (n,) as recorded: counter-clockwise from east where `convention` is ``enu``, else clockwise from north
    variance : (n,) [rad^2], NaN where not stated
    convention_why : how the convention is known
    """

    yaw_rad: Floats = field(default_factory=lambda: np.empty(0))
    variance: Floats = field(default_factory=lambda: np.empty(0))
    convention: Convention = "enu"
    convention_why: str = ""

    def heading_rad(self, convention: Convention) -> Floats:
        """Return headings clockwise from north in (-pi, pi]."""
        heading = self.yaw_rad if convention == "ned" else math.pi / 2 - self.yaw_rad
        return np.pi - np.mod(np.pi - heading, 2 * np.pi)


Unit = Literal["rad", "m", "counts", "unknown"]

Pair = tuple[Floats, Floats]
"""Of the left and of the right side, (n,) each."""

Sides = tuple[Floats | None, Floats | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelMotion(Source):
    """The motion of the wheels in a topic, or in a pair of topics.

    Attributes
    ----------
    position : travelled since some start, in `unit`; None where not recorded
    speed : in `unit` per second; None where not recorded
    twist : (n, 2) forward speed [m/s] and turn rate [rad/s, counter-clockwise], where only that of the body is recorded
    joints : the joints that its messages list by name, where they do
    """

    position: Pair | None = None
    speed: Pair | None = None
    unit: Unit = "rad"
    twist: Floats | None = None
    joints: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether nothing of both sides is recorded."""
        return self.twist is None and self.position is None and self.speed is None


def motion_of(motion: WheelMotion, position: Sides = (None, None), speed: Sides = (None, None)) -> WheelMotion:
    """Return a motion with what left and right recorded; without what one side lacks, or has no finite value of."""
    motion = replace(motion, position=_of_both(position), speed=_of_both(speed))
    if motion.is_empty:
        return replace(motion, problem=motion.problem or "has neither position nor speed of both sides")
    changes = any(float(np.ptp(side[np.isfinite(side)])) > 0.0 for side in motion.position or ())
    if changes or any(nonzero(values) for values in (*(motion.speed or ()), motion.twist) if values is not None):
        return motion
    return replace(motion, score=motion.score - NEVER_MOVES, why=f"{motion.why}, never moves")


def _of_both(sides: Sides) -> Pair | None:
    left, right = sides
    if left is None or right is None or not (np.isfinite(left).any() and np.isfinite(right).any()):
        return None
    return left, right


def nonzero(values: Floats) -> bool:
    """Return whether any finite value is not 0."""
    return bool(np.any(values[np.isfinite(values)] != 0.0))


def of_topic(table: TopicTable) -> dict[str, Any]:
    """Return what a source has of its topic."""
    return {"topic": table.topic, "message_type": table.message_type, "stamps": stamp_rows(table)}


_NUMBER = re.compile(r"(\S+?)(?: < (\S+))?((?: \* \S+)*)(?: \+ (.+))?")
_CHECK = re.compile(r"(\S+?)(?: & (\d+))? (==|!=|>=) (\S+)(?: unless (\S+))?")
UNITS = {"deg": math.radians(1.0), "rad": math.degrees(1.0)}
"""Of a bearing that is recorded in degrees, and of a latitude that is recorded in radians."""


class Number(NamedTuple):
    """A number in the messages of a type.

    Attributes
    ----------
    names : its field, in each spelling that drivers use
    largest : recorded numbers as large, of either sign, stand for "not known"
    unit : what 1 means: in m, radians, degrees of latitude or longitude
    fine : added where it is known: further digits, or the height of the geoid
    """

    names: list[str]
    largest: float
    unit: float
    fine: Number | None

    @property
    def fields(self) -> list[str]:
        """The fields that it is read from."""
        return [*self.names, *(self.fine.fields if self.fine is not None else ())]

    def of(self, table: TopicTable, *, needed: bool = False) -> Floats:
        """Return its values (n,); NaN where unknown, or where the type lacks it.

        Raises
        ------
        DefinitionError
            It is needed, and the type, as the log defines it, lacks it.
        """
        values = table.column(*self.names).astype(np.float64) if needed else table.floats(*self.names)
        if math.isfinite(self.largest):
            values = np.where(np.abs(values) < self.largest, values, np.nan)
        values = values if self.unit == 1.0 else values * self.unit
        if self.fine is not None:
            fine = self.fine.of(table)
            values = values + np.where(np.isfinite(fine), fine, 0.0)
        return values


@cache
def number(text: str) -> Number:
    """Return the number that a text describes: ``h_accuracy < 65535 * 0.01``, ``lat * 1e-7 + latHp|lat_hp * 1e-9``."""
    if (found := _NUMBER.fullmatch(text)) is None:
        raise ValueError(f"{text!r} describes no number")
    names, largest, units, fine = found.groups()
    unit = math.prod(UNITS[one] if one in UNITS else float(one) for one in units.split(" * ") if one)
    return Number(names.split("|"), float(largest or "inf"), unit, number(fine) if fine else None)


class Check(NamedTuple):
    """A field by which messages are valid; all are where the type lacks it.

    Attributes
    ----------
    names : the field, in each spelling that drivers use
    mask : the bits of a whole number that count
    relation, values : ``==`` one of these numbers or words, ``!=`` none of them, ``>=`` the number
    unset : the number that drivers leave in it which never set it: where all messages have it, all are valid
    """

    names: list[str]
    mask: int | None
    relation: str
    values: list[int | str]
    unset: float

    def of(self, table: TopicTable) -> Bools:
        """Return which messages (n,) are valid."""
        if (path := self.names[0]) in table.texts:
            codes, texts = table.words(path)
            return np.array([*(text in self.values for text in texts), False])[codes]
        values = table.find(*self.names) if self.mask is None else table.integers(*self.names)
        if values is None or np.all(values == self.unset):
            return np.ones(len(table), np.bool_)
        values = values if self.mask is None else values & self.mask
        numbers = [one for one in self.values if isinstance(one, int)]
        if self.relation == ">=":
            return ~np.asarray(values < numbers[0])
        return np.isin(values, numbers, invert=self.relation == "!=")


@cache
def check(text: str) -> Check:
    """Return the check that a text describes: ``flags & 1 == 1``, ``ins_status == INS_SOLUTION_GOOD|3``."""
    if (found := _CHECK.fullmatch(text)) is None:
        raise ValueError(f"{text!r} describes no check")
    names, mask, relation, values, unset = found.groups()
    of_any = [int(one) if one.lstrip("-").isdecimal() else one for one in values.split("|")]
    return Check(names.split("|"), int(mask) if mask else None, relation, of_any, float(unset or "nan"))


def all_valid(table: TopicTable, checks: tuple[str, ...]) -> Bools:
    """Return which messages (n,) pass all checks."""
    valid = np.ones(len(table), np.bool_)
    for one in checks:
        valid &= check(one).of(table)
    return valid


def fields_in(numbers: tuple[str, ...], checks: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return the fields that numbers and checks are read from; an empty text is no number."""
    fields = [name for one in numbers if one for name in number(one).fields]
    return (*fields, *(name for one in checks for name in check(one).names))
