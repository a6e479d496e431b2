"""Sources for a role: the values of a topic and their stamps, and the language in which rows describe fields.

The stamps of a topic are its header stamps where they can be used, else log times.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np

from icrtool.kernels.arrays import ROWS_AT_ONCE, Bools, Bytes, Floats, Ints
from icrtool.logs.messages.topic_table import (
    DISORDER_NS,
    NO_BACKWARD_STEP,
    OUT_OF_ORDER_NS,
    STAMPS,
    BackwardStep,
    TopicTable,
)
from icrtool.records.notes import Note
from icrtool.records.samples import WheelUnit

LARGEST_SHARE_BACKWARDS = 0.01
"""Largest share of header stamps that go back with which header stamps are used."""

LARGEST_SHARE_ZERO = 0.01
"""Largest share of header stamps of 0 with which header stamps are used."""

Clock = Literal["header", "log"]

FEWEST_STAMPS = 2
"""Smallest number of stamps with which two clocks are compared."""

LEAST_CHANGE_OF_SPEED = 0.01
"""Smallest difference of the speed of a replay from 1 that is reported. Clocks of computers differ by 0.0001."""

MESSAGES_AROUND_STEP = 25
"""Number of messages before and after a step of a clock whose median delay to log time shows the size of the step."""


class ClockSet(NamedTuple):
    """The largest step by which the clock of header stamps was set.

    Attributes
    ----------
    size_ns : size of the step [ns]; 0 without a step
    back : whether the clock was set back
    before_ns : the last stamp before the step [ns]
    """

    size_ns: int
    back: bool
    before_ns: int


NEVER_SET = ClockSet(0, back=False, before_ns=0)
"""A clock that was not set during the log."""


@dataclass(frozen=True, slots=True)
class StampedRows:
    """The stamps of a topic's messages.

    Attributes
    ----------
    header_ns : (n,) header stamps [ns], None where they are absent or cannot be used
    log_ns : (n,) log times [ns]
    note : reason why header stamps are not used; empty where they are
    delay_ns : median of log time minus header stamp [ns], 0 without header stamps
    replaced : number of header stamps of another clock, which log times replace
    backward_step : largest step back of log time in the file
    clock_set : step of the clock of the header stamps; `header_ns` are corrected for it
    far_ns : (n,) header stamps of a clock that is far from log time, such as simulated time [ns]; None without them
    """

    header_ns: Ints | None
    log_ns: Ints
    note: str
    delay_ns: int
    replaced: int = 0
    backward_step: BackwardStep = NO_BACKWARD_STEP
    clock_set: ClockSet = NEVER_SET
    far_ns: Ints | None = None

    def on(self, clock: Clock) -> Ints:
        """Return the stamps by a clock [ns]; log times if header stamps cannot be used."""
        return self.header_ns if clock == "header" and self.header_ns is not None else self.log_ns


def stamp_rows(table: TopicTable) -> StampedRows:
    """Return the stamps of a topic; header stamps only if they are not 0, near log time, and not decreasing."""
    log_ns = table.log_time_ns

    def unusable(note: str, clock_set: ClockSet = NEVER_SET, far_ns: Ints | None = None) -> StampedRows:
        return StampedRows(None, log_ns, note, 0, backward_step=table.backward_step, clock_set=clock_set, far_ns=far_ns)

    seconds, nanoseconds = (table.integers(*paths) for paths in zip(*STAMPS, strict=True))
    if seconds is None or nanoseconds is None or not len(log_ns):
        return unusable(NO_HEADER)
    header = seconds * 1_000_000_000 + nanoseconds
    zeros = np.count_nonzero(header == 0)
    if zeros > max(1.0, LARGEST_SHARE_ZERO * len(header)):
        return unusable(f"{100 * zeros / len(header):.0f} % of the header stamps are 0")
    header, clock_set = _without_clock_steps(header, log_ns)
    delay = int(np.median(log_ns - header, overwrite_input=True))
    if abs(delay) > DISORDER_NS:
        is_set, why = header != 0, f"header stamps are {delay / 1e9:+z.1f} s from log time"
        header = (
            header
            if is_set.all() or not is_set.any()
            else np.interp(log_ns, log_ns[is_set], header[is_set] - header[is_set][0]).astype(np.int64)
            + header[is_set][0]
        )
        back = np.count_nonzero(np.diff(header) < 0) > LARGEST_SHARE_BACKWARDS * len(header)
        return unusable(why, clock_set, None if back else header)
    # Log times replace a few stamps of another clock, such as a first stamp of 0.
    off = log_ns - header
    off -= delay
    other = np.abs(off, out=off) > DISORDER_NS
    header[other] = log_ns[other] - delay
    backwards = np.count_nonzero(np.diff(header) < 0) / max(len(header) - 1, 1)
    if backwards > LARGEST_SHARE_BACKWARDS:
        return unusable(f"{100 * backwards:.0f} % of the header stamps go back", clock_set)
    return StampedRows(header, log_ns, "", delay, int(np.count_nonzero(other)), table.backward_step, clock_set)


NO_HEADER = "no header"
"""Reason for log times: the messages have no header stamps."""

BY_LOG = "topics.clock is log"
"""Reason for log times: they are configured."""


def share_clock(streams: Sequence[StampedRows]) -> bool:
    """Return whether the header stamps of all streams are far from log time and come from one clock, of any speed."""
    if not streams or any(rows.far_ns is None or len(rows.log_ns) < FEWEST_STAMPS for rows in streams):
        return False
    first, *others = ((rows.log_ns, np.asarray(rows.far_ns) - rows.log_ns) for rows in streams)
    for log_ns, ahead in others:
        inside = (log_ns >= first[0][0]) & (log_ns <= first[0][-1])
        apart = ahead[inside] - np.interp(log_ns[inside], first[0], first[1])
        if not len(apart) or abs(float(np.median(apart))) > DISORDER_NS:
            return False
    return True


def replay_speed(rows: StampedRows) -> float:
    """Return the speed of header stamps far from log time, relative to log time: the speed of a replay.

    It is 1 where it is not known, and where it differs from 1 by less than `LEAST_CHANGE_OF_SPEED`.
    """
    if rows.far_ns is None or len(rows.log_ns) < FEWEST_STAMPS or not (logged := rows.log_ns[-1] - rows.log_ns[0]):
        return 1.0
    speed = float((rows.far_ns[-1] - rows.far_ns[0]) / logged)
    return speed if abs(speed - 1.0) > LEAST_CHANGE_OF_SPEED and speed > 0.0 else 1.0


def put_on_replay_clock(rows: StampedRows, like: StampedRows) -> StampedRows:
    """Return stamps with header stamps; a stream without them gets its log times on the header clock of `like`."""
    if rows.note != NO_HEADER:
        return use_header_stamps(rows)
    log_ns, known = like.log_ns, np.asarray(like.far_ns)
    inside = np.clip(rows.log_ns, log_ns[0], log_ns[-1])
    beyond = (replay_speed(like) * (rows.log_ns - inside)).astype(np.int64)
    return replace(
        rows, header_ns=known[0] + np.interp(inside, log_ns, known - known[0]).astype(np.int64) + beyond, note=""
    )


def use_header_stamps(rows: StampedRows) -> StampedRows:
    """Return stamps with header stamps even if these are far from log time; unchanged without header stamps."""
    return rows if rows.far_ns is None else replace(rows, header_ns=rows.far_ns, note="", far_ns=None)


def use_log_times(rows: StampedRows) -> StampedRows:
    """Return stamps without header stamps."""
    return replace(rows, header_ns=None, note=BY_LOG, delay_ns=0, replaced=0, far_ns=None)


def _without_clock_steps(header: Ints, log_ns: Ints) -> tuple[Ints, ClockSet]:
    """Return header stamps (n,) [ns] corrected for the steps by which their clock was set, and the largest step.

    Log time has no such steps. At a step of the clock, the delay of log time after the header stamps changes by the
    step and stays changed; at a message out of order it changes only for this message. A step forward counts only if
    the delay was larger in the whole stretch before it, because a connection may be slow for a while and then lose
    messages.
    """
    steps_found = []
    for lo in range(0, len(header), ROWS_AT_ONCE):
        part = slice(lo, lo + ROWS_AT_ONCE + 1)
        jump = np.diff(header[part])
        steps_found.append(lo + np.flatnonzero((jump < 0) | (jump - np.diff(log_ns[part]) > OUT_OF_ORDER_NS)))
    steps = np.concatenate(steps_found)
    if not len(steps) or len(steps) > LARGEST_SHARE_BACKWARDS * len(header) + 1:
        return header, NEVER_SET
    delay = log_ns - header
    rows = np.arange(MESSAGES_AROUND_STEP)
    before = np.median(delay[np.maximum(steps[:, None] - rows, 0)], axis=1)
    after = np.median(delay[np.minimum(steps[:, None] + 1 + rows, len(delay) - 1)], axis=1)
    grown = (after - before).astype(np.int64)
    grown_by_stretch = np.diff([np.median(part) for part in np.split(delay, steps + 1)])
    # A few stamps of another clock, such as a first stamp of 0, are no stretch: log times replace them later.
    many = np.diff(steps, prepend=-1) > max(1.0, LARGEST_SHARE_ZERO * len(header))
    lasting = (grown > OUT_OF_ORDER_NS) | ((grown < -OUT_OF_ORDER_NS) & (grown_by_stretch < grown / 2) & many)
    lasting &= (grown > 0) == (header[steps + 1] - header[steps] < 0)
    if not lasting.any():
        return header, NEVER_SET
    largest = int(np.argmax(np.where(lasting, np.abs(grown), 0)))
    moved = np.zeros(len(header), np.int64)
    moved[steps[lasting] + 1] = grown[lasting]
    clock_set = ClockSet(abs(int(grown[largest])), back=bool(grown[largest] > 0), before_ns=int(header[steps[largest]]))
    return header + np.cumsum(moved), clock_set


def increasing_rows(stamps: Ints, usable: Bools | None = None) -> tuple[Ints | slice, int, int]:
    """Return the rows whose stamps increase strictly, the number of stamps that go back, and the number of equal ones.

    Rows are sorted by stamp; of rows with the same stamp the last one is kept. If all rows are kept in their order, a
    slice is returned, which copies nothing.

    Parameters
    ----------
    stamps : (n,) [ns]
    usable : (n,) mask of the rows that may be kept; None: all
    """
    if usable is not None and not usable.all():
        rows = np.flatnonzero(usable)
        rows_kept, backwards, equal = increasing_rows(stamps[rows])
        return rows[rows_kept], backwards, equal
    steps = np.diff(stamps)
    if (steps > 0).all():
        return slice(None), 0, 0
    backwards = int(np.count_nonzero(steps < 0))
    order = np.argsort(stamps, kind="stable") if backwards else np.arange(len(stamps))
    keep = np.append(np.diff(stamps[order]) > 0, True)
    return order[keep], backwards, int(np.count_nonzero(~keep))


NEVER_MOVES_PENALTY = 60.0
"""Number that is subtracted from the score of a topic that never moves, so that a topic that moves is preferred."""

NO_ROWS: Bools = np.zeros(0, np.bool_)
"""Mask of a table without rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A topic, or a pair of topics, that may feed a role.

    Attributes
    ----------
    topic : name of the topic, or of both topics with ``+`` between them
    message_type : type of the messages
    stamps : stamps of the rows
    score : suitability for the role; the usable source with the highest score is chosen
    why : text about the data and its score
    problem : reason why the source cannot be used; empty for a usable one. Fields with values may then be empty
    notes : findings about the topic
    usable : (n,) mask of the rows to use; only of positions and headings
    """

    topic: str
    message_type: str
    stamps: StampedRows
    score: float = 0.0
    why: str = ""
    problem: str = ""
    notes: tuple[Note, ...] = ()
    usable: Bools = field(default_factory=lambda: NO_ROWS)

    @property
    def is_empty(self) -> bool:
        """Whether no row can be used, even if the topic is configured."""
        return not self.usable.any()


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionSource(Source):
    """Positions of one topic.

    Attributes
    ----------
    geodetic : (n, 3) latitude, longitude [deg], height above the ellipsoid [m]; None for metric positions
    metric : (n, 2) north, east [m] in the frame of the topic; None for geodetic positions
    variance : (n, 3) variance to the north, to the east, and covariance of both [m^2]; NaN where not stated
    rejected : number of rows that are not used, by reason
    stated_class : (n,) uint8, class of each fix by its solution; None where no message states it
    """

    geodetic: Floats | None = None
    metric: Floats | None = None
    variance: Floats = field(default_factory=lambda: np.empty((0, 3)))
    rejected: dict[str, int] = field(default_factory=dict)
    stated_class: Bytes | None = None


YawConvention = Literal["enu", "ned"]
"""Convention of a yaw angle: counter-clockwise from east, or clockwise from north."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadingSource(Source):
    """Headings of one topic.

    Attributes
    ----------
    yaw_rad : (n,) recorded angles [rad], by `convention`
    variance : (n,) variances [rad^2], NaN where not stated
    convention : ``enu``: counter-clockwise from east; ``ned``: clockwise from north
    convention_why : text about how the convention is known
    """

    yaw_rad: Floats = field(default_factory=lambda: np.empty(0))
    variance: Floats = field(default_factory=lambda: np.empty(0))
    convention: YawConvention = "enu"
    convention_why: str = ""

    def heading_rad(self, convention: YawConvention) -> Floats:
        """Return headings clockwise from north in (-pi, pi] (n,) [rad], if the angles have this convention."""
        heading = self.yaw_rad if convention == "ned" else math.pi / 2 - self.yaw_rad
        return np.pi - np.mod(np.pi - heading, 2 * np.pi)


Pair = tuple[Floats, Floats]
"""Numbers of the left and of the right side, (n,) each."""

Sides = tuple[Floats | None, Floats | None]
"""Numbers of the left and of the right side, (n,) each; None for a side without numbers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelSource(Source):
    """The motion of the wheels in a topic, or in a pair of topics.

    Attributes
    ----------
    position : positions of both sides, in `unit`; None where not recorded
    speed : speeds of both sides, in `unit` per second; None where not recorded
    unit : unit of positions, and of speeds per second
    twist : (n, 2) forward speed [m/s] and turn rate [rad/s, counter-clockwise] of the body; None if both sides are
        recorded
    travelled : (n, 2) distance forward [m] and turn [rad, counter-clockwise] of a pose whose twist stays 0; else None
    joints : joints that the messages list by name; empty for messages without names
    """

    position: Pair | None = None
    speed: Pair | None = None
    unit: WheelUnit = "rad"
    twist: Floats | None = None
    travelled: Floats | None = None
    joints: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether neither the motion of both sides nor the motion of the body is recorded."""
        return self.twist is None and self.position is None and self.speed is None


def make_wheel_source(
    *,
    position: Sides = (None, None),
    speed: Sides = (None, None),
    twist: Floats | None = None,
    score: float = 0.0,
    why: str = "",
    problem: str = "",
    **others: Any,
) -> WheelSource:
    """Return a source with the motion of both sides or of the body, with its score reduced if it never moves.

    A quantity without finite values on a side is left out. Without any quantity, the source has a `problem`.

    Parameters
    ----------
    position, speed, twist : as in `WheelSource`
    others : further fields of `WheelSource`
    """
    pairs: list[Pair | None] = [None, None]
    for row, (left, right) in enumerate((position, speed)):
        if left is not None and right is not None and np.isfinite(left).any() and np.isfinite(right).any():
            pairs[row] = left, right
    positions, speeds = pairs
    changes = any(float(np.ptp(side[np.isfinite(side)])) > 0.0 for side in positions or ())
    if positions is None and speeds is None and twist is None:
        problem = problem or "has neither position nor speed of both sides"
    elif not changes and not any(wheels_move(values) for values in (*(speeds or ()), twist) if values is not None):
        score, why = score - NEVER_MOVES_PENALTY, f"{why}, never moves"
    return WheelSource(position=positions, speed=speeds, twist=twist, score=score, why=why, problem=problem, **others)


def wheels_move(speeds: Floats) -> bool:
    """Return whether a finite speed is not 0."""
    return bool(np.any(speeds[np.isfinite(speeds)] != 0.0))


def topic_fields(table: TopicTable) -> dict[str, Any]:
    """Return the fields of a `Source` that come from its topic: name, message type and stamps."""
    return {"topic": table.topic, "message_type": table.message_type, "stamps": stamp_rows(table)}


_TERM = re.compile(r"(\S+?)(?: < (\S+))?((?: \* \S+)*)")
_CHECK = re.compile(r"(\S+?)(?: & (\d+))? (==|!=|>=) (\S+)(?: unless (\S+))?")
UNITS = {"deg": math.radians(1.0), "rad": math.degrees(1.0)}
"""Factor of each unit: ``deg`` converts a bearing in degrees to radians, ``rad`` a latitude in radians to degrees."""


@cache
def terms_of(text: str) -> list[tuple[list[str], float, float]]:
    """Return the terms of a number that a text describes.

    Parameters
    ----------
    text : such as ``h_accuracy < 65535 * 0.01`` or ``lat * 1e-7 + latHp|lat_hp * 1e-9``

    Returns
    -------
    For each term: the names of its field, because drivers spell it differently; the absolute value from which on the
    number stands for "not known"; and the factor that converts it to m, rad, or degrees of latitude or longitude.
    """
    terms = []
    for term in text.split(" + "):
        if (match := _TERM.fullmatch(term)) is None:
            raise ValueError(f"{text!r} describes no number")
        names, largest, units = match.groups()
        unit = math.prod(UNITS[factor] if factor in UNITS else float(factor) for factor in units.split(" * ") if factor)
        terms.append((names.split("|"), float(largest or "inf"), unit))
    return terms


def number_of(table: TopicTable, text: str, *, needed: bool = False) -> Floats:
    """Return the values (n,) of a number; NaN where they are not known, or where the type lacks the field.

    A second term (further digits, or the height of the geoid) is added where it is known.

    Parameters
    ----------
    table : messages of the topic
    text : description of the number for `terms_of`
    needed : whether the first field must exist

    Raises
    ------
    DefinitionError
        The number is needed, and the type, as the log defines it, lacks its first field.
    """
    total: Floats | None = None
    for names, largest, unit in terms_of(text):
        values = table.column(*names).astype(np.float64) if needed and total is None else table.floats(*names)
        values = np.where(np.abs(values) < largest, values, np.nan) if math.isfinite(largest) else values
        values = values if unit == 1.0 else values * unit
        total = values if total is None else total + np.where(np.isfinite(values), values, 0.0)
    return np.asarray(total)


@cache
def check_of(text: str) -> tuple[list[str], int | None, str, list[int | str], float]:
    """Return the check that a text describes.

    Parameters
    ----------
    text : such as ``flags & 1 == 1``, ``quality == 4|5`` or ``status.status >= 0 unless -2``

    Returns
    -------
    The names of the field, because drivers spell it differently; the bits of a whole number that are compared, or None;
    the relation: ``==`` to one of the values, ``!=`` to all values, ``>=`` to the value; the values; and the number of
    drivers that never set the field: if all messages have this number, all are valid.
    """
    if (match := _CHECK.fullmatch(text)) is None:
        raise ValueError(f"{text!r} describes no check")
    names, mask, relation, values, unset = match.groups()
    wanted = [int(value) if value.lstrip("-").isdecimal() else value for value in values.split("|")]
    return names.split("|"), int(mask) if mask else None, relation, wanted, float(unset or "nan")


def all_valid(table: TopicTable, checks: Sequence[str]) -> Bools:
    """Return a mask of the messages (n,) that pass all checks; a check of a field that the type lacks is passed."""
    valid = np.ones(len(table), np.bool_)
    for names, mask, relation, wanted, unset in map(check_of, checks):
        if (path := names[0]) in table.texts:
            codes, texts = table.words(path)
            valid &= np.array([*((text in wanted) != (relation == "!=") for text in texts), False])[codes]
            continue
        values = table.find(*names) if mask is None else table.integers(*names)
        if values is None or np.all(values == unset):
            continue
        values = values if mask is None else values & mask
        numbers = [value for value in wanted if isinstance(value, int)]
        if relation == ">=":
            valid &= ~np.asarray(values < numbers[0])
        else:
            valid &= np.isin(values, numbers, invert=relation == "!=")
    return valid


def fields_in(numbers: Sequence[str], checks: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of the fields in descriptions of numbers and checks; an empty text describes no number."""
    fields = [name for number in numbers if number for names, _, _ in terms_of(number) for name in names]
    return (*fields, *(name for check in checks for name in check_of(check)[0]))
