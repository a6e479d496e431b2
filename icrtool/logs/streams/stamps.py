"""The clock of a topic's messages: header stamps where they can be used, else log times, and the order of rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from icrtool.errors import DataError
from icrtool.kernels.arrays import Bools, Ints
from icrtool.logs.messages.topic_table import NEAR_NS, NOT_SET_BACK, OUT_OF_ORDER_NS, STAMPS, SetBack, TopicTable
from icrtool.records.samples import Role

MOST_PIECES = 10.0
"""Of a stretch of messages: sorted in among others more often, it was recorded while their times came again."""

LARGEST_SHARE_BACKWARDS = 0.01
LARGEST_SHARE_ZERO = 0.01

FAR_NS = 100_000_000
"""Header stamps that log time follows by less are used together with log times of other streams."""

AROUND = 25
"""Messages before and after a step of a clock whose median delay to log time shows its size."""


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
    note : why the header's are not used, empty when they are
    delay_ns : median of log time minus header stamp, 0 without header stamps
    replaced : header stamps of another clock that log times stand for
    set_back : as `TopicTable.set_back`
    clock_set : of the headers; their stamps are those of a clock that was not set
    """

    header_ns: Ints | None
    log_ns: Ints
    note: str
    delay_ns: int
    replaced: int = 0
    set_back: SetBack = NOT_SET_BACK
    clock_set: ClockSet = NEVER_SET

    def on(self, clock: Literal["header", "log"]) -> Ints:
        """Return the stamps on a clock; the log's where the header's cannot be used."""
        return self.header_ns if clock == "header" and self.header_ns is not None else self.log_ns


def stamp_rows(table: TopicTable) -> StampedRows:
    """Return the stamps of a topic; header stamps only where they are non-zero, near log time and increasing."""
    log_ns = table.log_time_ns

    def unusable(note: str, clock_set: ClockSet = NEVER_SET) -> StampedRows:
        return StampedRows(None, log_ns, note, 0, set_back=table.set_back, clock_set=clock_set)

    seconds, nanoseconds = (table.integers(*paths) for paths in zip(*STAMPS, strict=True))
    if seconds is None or nanoseconds is None or not len(log_ns):
        return unusable("no header")
    header = seconds * 1_000_000_000 + nanoseconds
    zeros = np.count_nonzero(header == 0)
    if zeros > max(1.0, LARGEST_SHARE_ZERO * len(header)):
        return unusable(f"{100 * zeros / len(header):.0f} % of the header stamps are 0")
    header, clock_set = _without_clock_steps(header, log_ns)
    delay = int(np.median(log_ns - header))
    if abs(delay) > NEAR_NS:
        return unusable(f"header stamps are {delay / 1e9:+.1f} s from log time", clock_set)
    # A few stamps of another clock (a first message at 0) are replaced by their log times.
    other = np.abs(log_ns - header - delay) > NEAR_NS
    header[other] = log_ns[other] - delay
    backwards = np.count_nonzero(np.diff(header) < 0) / max(len(header) - 1, 1)
    if backwards > LARGEST_SHARE_BACKWARDS:
        return unusable(f"{100 * backwards:.0f} % of the header stamps go back", clock_set)
    return StampedRows(header, log_ns, "", delay, int(np.count_nonzero(other)), table.set_back, clock_set)


def _without_clock_steps(header: Ints, log_ns: Ints) -> tuple[Ints, ClockSet]:
    """Return header stamps (n,) of a clock that was set as if it had not been, and the largest step.

    Log time goes on, so the delay to it changes by the step and stays so; after a message out of place it does not.
    A step ahead counts where the whole stretch before it was later, too: a connection that was slow for a while and
    then lost messages is no clock.
    """
    jump = np.diff(header)
    steps = np.flatnonzero((jump < 0) | (jump - np.diff(log_ns) > OUT_OF_ORDER_NS))
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
    lasting &= (grown > 0) == (jump[steps] < 0)
    if not lasting.any():
        return header, NEVER_SET
    largest = int(np.argmax(np.where(lasting, np.abs(grown), 0)))
    moved = np.zeros(len(header), np.int64)
    moved[steps[lasting] + 1] = grown[lasting]
    found = ClockSet(abs(int(grown[largest])), back=bool(grown[largest] > 0), before_ns=int(header[steps[largest]]))
    return header + np.cumsum(moved), found


def clock_notes(streams: Sequence[tuple[Role, StampedRows]], name: str) -> Iterator[str]:
    """Yield sentences about clocks of streams that were set, one for all, and that cannot be used, one for each.

    Raises
    ------
    DataError
        The clock was set back, and times came again: nothing shows which of two samples came first.
    """
    yield from _set_back_note(streams, name)
    if found := [(rows.clock_set, role) for role, rows in streams if rows.clock_set.size_ns]:
        size_ns, is_back, before_ns = max(found)[0]
        sense = "back" if is_back else "ahead"
        yield (
            f"{name}: header stamps go {sense} by {size_ns / 1e9:.1f} s after {_time_of_day(before_ns)} "
            f"({', '.join(role for _, role in found)}): their clock was set {'back' if is_back else 'forward'} while "
            "recording; the later ones are moved by as much, which log time shows"
        )
    for role, rows in streams:
        if rows.note and rows.note != "no header":
            yield f"{name}: {role}: {rows.note}; log time is used"
        if rows.replaced > 1:
            counted = f"{rows.replaced} of {len(rows.log_ns)} header stamps are of another clock"
            yield f"{name}: {role}: {counted}; log time is used for them"


def _set_back_note(streams: Sequence[tuple[Role, StampedRows]], name: str) -> Iterator[str]:
    """Yield the sentence on the log's clock, with the largest step of the streams that show one."""
    back = [
        (rows.set_back, role)
        for role, rows in streams
        if rows.set_back.pieces > MOST_PIECES or rows.set_back.step_ns > NEAR_NS
    ]
    if not back:
        return
    # Of streams in which times come again, the largest step: they decide what can be done.
    largest = max(back, key=lambda one: (one[0].pieces > MOST_PIECES, one[0].step_ns))[0]
    moment = _time_of_day(largest.before_ns)
    why = f"log time goes back by {largest.step_ns / 1e9:.1f} s after {moment} ({', '.join(role for _, role in back)})"
    far = largest.step_ns > NEAR_NS
    if largest.pieces > MOST_PIECES and far:
        raise DataError(name, why, "times come again, and samples cannot be put in order; cut the recording there")
    if largest.pieces > MOST_PIECES:
        yield (
            f"{name}: {why}: the clock was set back while recording, and samples of that time are mixed, which makes "
            "errors there too large; fit each part alone (--from, --to)"
        )
    else:
        yield (
            f"{name}: {why}: the clock was set back, or messages are stored out of order; all are used, sorted by "
            "time; if it was set back, fit each part alone (--from, --to)"
        )


def _time_of_day(stamp_ns: int) -> str:
    return f"{np.datetime64(stamp_ns // 1_000_000_000, 's')}Z"


def common_clock(streams: Sequence[StampedRows]) -> Literal["header", "log"]:
    """Return the clock for streams that are used together: header stamps or log time.

    Where some stream has only log times and another's header is far from them, all go by log time.
    """
    delays = [rows.delay_ns for rows in streams if rows.header_ns is not None]
    return "log" if len(delays) < len(streams) and any(abs(delay) > FAR_NS for delay in delays) else "header"


def usable_rows(stamps: Ints, usable: Bools) -> Ints | slice:
    """Return the usable rows (n,) that make stamps strictly increasing; all rows as a slice, which copies nothing."""
    if usable.all():
        return increasing(stamps)[0]
    rows = np.flatnonzero(usable)
    return rows[increasing(stamps[rows])[0]]


def increasing(stamps: Ints) -> tuple[Ints | slice, int, int]:
    """Return the rows that make stamps strictly increasing, how many went back, and how many were equal.

    Rows are sorted by stamp; of rows with the same stamp the last one stays. All rows in their order are a slice.
    """
    steps = np.diff(stamps)
    if (steps > 0).all():
        return slice(None), 0, 0
    backwards = int(np.count_nonzero(steps < 0))
    order = np.argsort(stamps, kind="stable") if backwards else np.arange(len(stamps))
    ordered = stamps[order]
    keep = np.append(np.diff(ordered) > 0, True) if len(ordered) else np.empty(0, np.bool_)
    return order[keep], backwards, len(stamps) - int(np.count_nonzero(keep))
