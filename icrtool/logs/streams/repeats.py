"""Recordings of a replay in a loop: the messages of the first pass are kept, because later passes repeat them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bools, Ints
from icrtool.logs.messages.topic_table import DISORDER_NS, STAMPS, TopicTable

FEWEST_OF_PASS = 10
"""Smallest number of messages of the first pass, and of messages that repeat it."""

REPEATED_SHARE = 0.95
"""Smallest share of the messages after the first pass that repeat stamp and values of a message of the first pass. A
recorder may lose single messages."""

MOST_SPEED, SHORTEST_PASS_NS = 20.0, 5_000_000_000
"""Largest ratio of log time to header stamps, and of header stamps to log time, over the first pass; and shortest first
pass [ns]. Publishers of static transforms also repeat messages with old stamps, but these stamps do not advance with
log time."""


class Repeats(NamedTuple):
    """The later passes of a log.

    Attributes
    ----------
    begin_ns : log time of the first message of the second pass [ns]
    back_ns : step back of the header stamps at this message [ns]
    passes : number of messages of all passes, divided by the number of messages of the first pass
    """

    begin_ns: int
    back_ns: int
    passes: float

    @property
    def text(self) -> str:
        """The finding as a sentence."""
        moment, back = np.datetime64(self.begin_ns // 10**9, "s"), self.back_ns / 1e9
        finding = f"from log time {moment}Z on, header stamps go back by {back:.1f} s and all messages are repeated"
        return f"{finding}, {self.passes:.2g} passes in all: a replay in a loop was recorded; the first pass is used"


def find_repeats(tables: Sequence[TopicTable]) -> Repeats | None:
    """Return the later passes of a log, in which the same messages are repeated; None without such passes."""
    stamped = [(table, header) for table in tables if (header := _header(table)) is not None]
    repeats = [(len(table), repeat) for table, header in stamped if (repeat := _repeats_of(table, header)) is not None]
    if not repeats:
        return None
    _, largest = max(repeats, key=lambda counted: counted[0])
    agree = [(count, repeat) for count, repeat in repeats if abs(repeat.begin_ns - largest.begin_ns) <= DISORDER_NS]
    if sum(count for count, _ in agree) < 0.5 * sum(len(table) for table, _ in stamped):
        return None
    return largest._replace(begin_ns=min(repeat.begin_ns for _, repeat in agree))


def first_pass(table: TopicTable, repeats: Repeats) -> TopicTable:
    """Return a table without the messages of later passes."""
    header = _header(table)
    own = _repeats_of(table, header) if header is not None else None
    begin_ns = own.begin_ns if own is not None else repeats.begin_ns
    kept: Bools = table.log_time_ns < begin_ns
    return table if kept.all() else table.rows(kept)


def _header(table: TopicTable) -> Ints | None:
    """Return the header stamps of a table (n,) [ns]; None without header stamps, or with too few messages."""
    if len(table) < 2 * FEWEST_OF_PASS:
        return None
    seconds, nanoseconds = (table.integers(*paths) for paths in zip(*STAMPS, strict=True))
    return None if seconds is None or nanoseconds is None else seconds * 1_000_000_000 + nanoseconds


def _repeats_of(table: TopicTable, header: Ints) -> Repeats | None:
    """Return the later passes of one topic by its header stamps (n,) [ns]; None without later passes."""
    steps = np.diff(header)
    if (steps >= 0).all():
        return None
    _, first, inverse = np.unique(header, return_index=True, return_inverse=True)
    before = first[inverse]
    again = before < np.arange(len(header))
    row = int(np.argmax(again))
    count = np.count_nonzero(again)
    if row < FEWEST_OF_PASS or count < max(FEWEST_OF_PASS, REPEATED_SHARE * (len(header) - row)):
        return None
    stamped, logged = int(header[row - 1] - header[0]), int(table.log_time_ns[row - 1] - table.log_time_ns[0])
    if steps[row - 1] >= 0 or min(stamped, logged) < SHORTEST_PASS_NS / MOST_SPEED:
        return None
    if max(stamped, logged) < SHORTEST_PASS_NS or not stamped <= MOST_SPEED * logged <= MOST_SPEED**2 * stamped:
        return None
    rows = np.flatnonzero(again)
    same = np.ones(len(rows), np.bool_)
    for values in table.columns.values():
        later, first_values = values[rows], values[before[rows]]
        equal = (later == first_values) | ((later != later) & (first_values != first_values))  # noqa: PLR0124 - a NaN is not equal to itself
        same &= equal if equal.ndim == 1 else equal.all(axis=1)
    if np.count_nonzero(same) < REPEATED_SHARE * len(rows):
        return None
    return Repeats(int(table.log_time_ns[row]), int(-steps[row - 1]), len(header) / row)
