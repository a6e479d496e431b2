"""Topics that may feed a role: the values of each, their clock, and the fields of messages that they are read from.

The clock of a topic is the clock of its header stamps where they can be used, else log time.
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
LARGEST_SHARE_ZERO = 0.01

Clock = Literal["header", "log"]

FEWEST_STAMPS = 2
"""Least number of stamps that show a clock."""

LEAST_CHANGE_OF_SPEED = 0.01
"""Least difference of the speed of a replay from 1 that is reported. Clocks of computers differ by 0.0001."""

AROUND = 25
"""Number of messages before, and after, a step of a clock: their median delay to log time shows its size."""


class ClockSet(NamedTuple):
    """The largest step by which the clock of header stamps was set: its size, its sense, the last stamp before."""

    size_ns: int
    back: bool
    before_ns: int


NEVER_SET = ClockSet(0, back=False, before_ns=0)


@dataclass(frozen=True, slots=True)
class StampedRows:
    """The stamps of a topic's messages.

    Attributes
    ----------
    header_ns : (n,) header stamps, None where they are absent or cannot be used
    log_ns : (n,) log times
    note : why header stamps are not used, empty where they are
    delay_ns : median of log time minus header stamp, 0 without header stamps
    replaced : number of header stamps of another clock that log times replace
    backward_step : as `TopicTable.backward_step`
    clock_set : step of the headers' clock; `header_ns` are corrected for it
    far_ns : (n,) header stamps of a clock far from log time, as simulated time is; None where there are none
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
        """Return the stamps on a clock; log times where header stamps cannot be used."""
        return self.header_ns if clock == "header" and self.header_ns is not None else self.log_ns


def stamp_rows(table: TopicTable) -> StampedRows:
    """Return the stamps of a topic; header stamps only where they are non-zero, near log time and increasing."""
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
    # A few stamps of another clock (a first message at 0) are replaced by their log times.
    off = log_ns - header
    off -= delay
    other = np.abs(off, out=off) > DISORDER_NS
    header[other] = log_ns[other] - delay
    backwards = np.count_nonzero(np.diff(header) < 0) / max(len(header) - 1, 1)
    if backwards > LARGEST_SHARE_BACKWARDS:
        return unusable(f"{100 * backwards:.0f} % of the header stamps go back", clock_set)
    return StampedRows(header, log_ns, "", delay, int(np.count_nonzero(other)), table.backward_step, clock_set)


NO_HEADER = "no header"
"""Why header stamps are not used where messages have none."""

BY_LOG = "topics.clock is log"
"""Why header stamps are not used where that is configured."""


def share_clock(streams: Sequence[StampedRows]) -> bool:
    """Return whether all streams have header stamps far from log time, of one clock, however fast it goes."""
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
    """Return how fast header stamps far from log time go, relative to log time: the speed of a replay; 1 where unknown.

    Below `LEAST_CHANGE_OF_SPEED` of difference it is 1.
    """
    if rows.far_ns is None or len(rows.log_ns) < FEWEST_STAMPS or not (logged := rows.log_ns[-1] - rows.log_ns[0]):
        return 1.0
    speed = float((rows.far_ns[-1] - rows.far_ns[0]) / logged)
    return speed if abs(speed - 1.0) > LEAST_CHANGE_OF_SPEED and speed > 0.0 else 1.0


def as_replayed(rows: StampedRows, like: StampedRows) -> StampedRows:
    """Return stamps by the header; of a stream without header stamps, log times on the clock of those of another."""
    if rows.note != NO_HEADER:
        return by_header(rows)
    log_ns, known = like.log_ns, np.asarray(like.far_ns)
    inside = np.clip(rows.log_ns, log_ns[0], log_ns[-1])
    beyond = (replay_speed(like) * (rows.log_ns - inside)).astype(np.int64)
    return replace(
        rows, header_ns=known[0] + np.interp(inside, log_ns, known - known[0]).astype(np.int64) + beyond, note=""
    )


def by_header(rows: StampedRows) -> StampedRows:
    """Return stamps by the header, however far from log time; unchanged where there are no header stamps."""
    return rows if rows.far_ns is None else replace(rows, header_ns=rows.far_ns, note="", far_ns=None)


def by_log(rows: StampedRows) -> StampedRows:
    """Return stamps by log time."""
    return replace(rows, header_ns=None, note=BY_LOG, delay_ns=0, replaced=0, far_ns=None)


def _without_clock_steps(header: Ints, log_ns: Ints) -> tuple[Ints, ClockSet]:
    """Return header stamps (n,) of a clock that was set as if it had not been, and the largest step.

    Log time goes on, so the delay to it changes by the step and stays changed; after a message out of place it returns.
    A step forward counts only if the delay was larger in the whole stretch before it: a connection that was slow for a
    while and then lost messages is no step of a clock.
    """
    steps_found = []
    for lo in range(0, len(header), ROWS_AT_ONCE):
        some = slice(lo, lo + ROWS_AT_ONCE + 1)
        jump = np.diff(header[some])
        steps_found.append(lo + np.flatnonzero((jump < 0) | (jump - np.diff(log_ns[some]) > OUT_OF_ORDER_NS)))
    steps = np.concatenate(steps_found)
    if not len(steps) or len(steps) > LARGEST_SHARE_BACKWARDS * len(header) + 1:
        return header, NEVER_SET
    delay = log_ns - header
    rows = np.arange(AROUND)
    before = np.median(delay[np.maximum(steps[:, None] - rows, 0)], axis=1)
    after = np.median(delay[np.minimum(steps[:, None] + 1 + rows, len(delay) - 1)], axis=1)
    grown = (after - before).astype(np.int64)
    of_stretch = np.diff([np.median(part) for part in np.split(delay, steps + 1)])
    # a few stamps of another clock, as a first one at 0, are replaced by their log times
    many = np.diff(steps, prepend=-1) > max(1.0, LARGEST_SHARE_ZERO * len(header))
    lasting = (grown > OUT_OF_ORDER_NS) | ((grown < -OUT_OF_ORDER_NS) & (of_stretch < grown / 2) & many)
    lasting &= (grown > 0) == (header[steps + 1] - header[steps] < 0)
    if not lasting.any():
        return header, NEVER_SET
    largest = int(np.argmax(np.where(lasting, np.abs(grown), 0)))
    moved = np.zeros(len(header), np.int64)
    moved[steps[lasting] + 1] = grown[lasting]
    clock_set = ClockSet(abs(int(grown[largest])), back=bool(grown[largest] > 0), before_ns=int(header[steps[largest]]))
    return header + np.cumsum(moved), clock_set


def increasing_rows(stamps: Ints, usable: Bools | None = None) -> tuple[Ints | slice, int, int]:
    """Return the usable rows that make stamps strictly increasing, how many went back, and how many were equal.

    Rows are sorted by stamp; of rows with the same stamp the last one stays. All rows in their order are a slice, which
    copies nothing.
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


NEVER_MOVES = 60.0
"""Subtracted from the score of a topic that never moves: a topic that moves is preferred."""

NO_ROWS: Bools = np.zeros(0, np.bool_)


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A topic, or a pair of topics, that may feed a role; an unreadable topic has no values in the subclass.

    Attributes
    ----------
    score : how suitable the type is; why : the reason as text
    problem : why it cannot be used, empty when it can
    notes : what a user must know of it
    usable : (n,) rows to use, of positions and headings
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


Pair = tuple[Floats, Floats]
"""Of the left and of the right side, (n,) each."""

Sides = tuple[Floats | None, Floats | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelSource(Source):
    """The motion of the wheels in a topic, or in a pair of topics.

    Attributes
    ----------
    position : travelled since some start, in `unit`; None where not recorded
    speed : in `unit` per second; None where not recorded
    twist : (n, 2) forward speed [m/s] and turn rate [rad/s, counter-clockwise], where only the body's motion is
        recorded
    travelled : (n, 2) distance forward [m] and turn [rad, counter-clockwise] since some start, where the twist stays 0
    joints : the joints that its messages list by name, where they do
    """

    position: Pair | None = None
    speed: Pair | None = None
    unit: WheelUnit = "rad"
    twist: Floats | None = None
    travelled: Floats | None = None
    joints: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether nothing of both sides is recorded."""
        return self.twist is None and self.position is None and self.speed is None


def motion_of(
    *,
    position: Sides = (None, None),
    speed: Sides = (None, None),
    twist: Floats | None = None,
    score: float = 0.0,
    why: str = "",
    problem: str = "",
    **others: Any,
) -> WheelSource:
    """Return the motion by records of left and right; a quantity without finite values on a side is left out."""
    both: list[Pair | None] = [None, None]
    for place, (left, right) in enumerate((position, speed)):
        if left is not None and right is not None and np.isfinite(left).any() and np.isfinite(right).any():
            both[place] = left, right
    travelled, speeds = both
    changes = any(float(np.ptp(side[np.isfinite(side)])) > 0.0 for side in travelled or ())
    if travelled is None and speeds is None and twist is None:
        problem = problem or "has neither position nor speed of both sides"
    elif not changes and not any(wheels_move(values) for values in (*(speeds or ()), twist) if values is not None):
        score, why = score - NEVER_MOVES, f"{why}, never moves"
    return WheelSource(position=travelled, speed=speeds, twist=twist, score=score, why=why, problem=problem, **others)


def wheels_move(speeds: Floats) -> bool:
    """Return whether any finite speed is not 0."""
    return bool(np.any(speeds[np.isfinite(speeds)] != 0.0))


def of_topic(table: TopicTable) -> dict[str, Any]:
    """Return the fields of a source that come from its topic."""
    return {"topic": table.topic, "message_type": table.message_type, "stamps": stamp_rows(table)}


_TERM = re.compile(r"(\S+?)(?: < (\S+))?((?: \* \S+)*)")
_CHECK = re.compile(r"(\S+?)(?: & (\d+))? (==|!=|>=) (\S+)(?: unless (\S+))?")
UNITS = {"deg": math.radians(1.0), "rad": math.degrees(1.0)}
"""Factors of units: ``deg`` for a bearing in degrees, ``rad`` for a latitude in radians."""


@cache
def terms_of(text: str) -> list[tuple[list[str], float, float]]:
    """Return the sum that a text describes: ``h_accuracy < 65535 * 0.01``, ``lat * 1e-7 + latHp|lat_hp * 1e-9``.

    Returns
    -------
    For each field: its names, in each spelling that drivers use; the size from which recorded numbers, of either sign,
    mean "not known"; and the value of 1 in m, radians, or degrees of latitude or longitude.
    """
    terms = []
    for one in text.split(" + "):
        if (match := _TERM.fullmatch(one)) is None:
            raise ValueError(f"{text!r} describes no number")
        names, largest, units = match.groups()
        unit = math.prod(UNITS[one] if one in UNITS else float(one) for one in units.split(" * ") if one)
        terms.append((names.split("|"), float(largest or "inf"), unit))
    return terms


def number_of(table: TopicTable, text: str, *, needed: bool = False) -> Floats:
    """Return the values (n,) of a number as a text describes it; NaN where unknown, or where the type lacks it.

    The term after a plus is added where it is known: further digits, or the height of the geoid.

    Raises
    ------
    DefinitionError
        It is needed, and the type, as the log defines it, lacks it.
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
    """Return the check that a text describes: ``flags & 1 == 1``, ``status.status >= 0 unless -2``.

    Returns
    -------
    The names of the field, in each spelling that drivers use; the bits of a whole number that count; ``==`` one of the
    numbers or words that follow, ``!=`` none of them, ``>=`` the number; and the number in messages of drivers that
    never set the field: where all messages have this number, all are valid.
    """
    if (match := _CHECK.fullmatch(text)) is None:
        raise ValueError(f"{text!r} describes no check")
    names, mask, relation, values, unset = match.groups()
    of_any = [int(one) if one.lstrip("-").isdecimal() else one for one in values.split("|")]
    return names.split("|"), int(mask) if mask else None, relation, of_any, float(unset or "nan")


def all_valid(table: TopicTable, checks: Sequence[str]) -> Bools:
    """Return which messages (n,) pass all checks; a check of a field that the type lacks is passed."""
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
        numbers = [one for one in wanted if isinstance(one, int)]
        if relation == ">=":
            valid &= ~np.asarray(values < numbers[0])
        else:
            valid &= np.isin(values, numbers, invert=relation == "!=")
    return valid


def fields_in(numbers: Sequence[str], checks: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the fields that numbers and checks are read from; an empty text is no number."""
    fields = [name for one in numbers if one for names, _, _ in terms_of(one) for name in names]
    return (*fields, *(name for one in checks for name in check_of(one)[0]))
