"""A recording of a replay that began again: messages of the first pass are kept, as the later passes repeat them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bools, Ints
from icrtool.logs.messages.topic_table import DISORDER_NS, STAMPS, TopicTable

FEWEST_OF_PASS = 10
"""Least number of messages of a pass, and of messages that repeat it."""

REPEATED_SHARE = 0.95
"""Least share of the messages after the first pass that repeat one of it, stamp and values; the recorder of a replay
loses single messages."""

MOST_SPEED, SHORTEST_PASS_NS = 20.0, 5_000_000_000
"""Largest ratio of log time to header stamps over the first pass, and of header stamps to log time: the speed of a
replay; shortest pass [ns]. Static transforms of several publishers are sent again and again too, with their old stamps,
which do not go on with log time."""


class Repeats(NamedTuple):
    """The later passes of a log.

    Attributes
    ----------
    begin_ns : log time of the first message of the second pass
    back_ns : by how much header stamps go back there
    passes : messages of all passes over those of the first
    """

    begin_ns: int
    back_ns: int
    passes: float

    @property
    def text(self) -> str:
        """What is reported of it."""
        moment, back = np.datetime64(self.begin_ns // 10**9, "s"), self.back_ns / 1e9
        finding = f"from {moment}Z of log time on, header stamps go back by {back:.1f} s and all messages come again"
        return f"{finding}, {self.passes:.2g} times in all: a replay in a loop; the first pass is used"


def find_repeats(tables: Sequence[TopicTable]) -> Repeats | None:
    """Return the later passes of a log in which the same messages come again; None where there are none."""
    stamped = [(table, header) for table in tables if (header := _header(table)) is not None]
    repeats = [(len(table), one) for table, header in stamped if (one := _repeats_of(table, header)) is not None]
    if not repeats:
        return None
    _, largest = max(repeats, key=lambda one: one[0])
    agree = [(count, one) for count, one in repeats if abs(one.begin_ns - largest.begin_ns) <= DISORDER_NS]
    if sum(count for count, _ in agree) < 0.5 * sum(len(table) for table, _ in stamped):
        return None
    return largest._replace(begin_ns=min(one.begin_ns for _, one in agree))


def first_pass(table: TopicTable, repeats: Repeats) -> TopicTable:
    """Return a table without the messages of later passes."""
    header = _header(table)
    own = _repeats_of(table, header) if header is not None else None
    begin_ns = own.begin_ns if own is not None else repeats.begin_ns
    kept: Bools = table.log_time_ns < begin_ns
    return table if kept.all() else table.rows(kept)


def _header(table: TopicTable) -> Ints | None:
    """Return the header stamps (n,) of a table [ns]; None where it has none, or too few messages."""
    if len(table) < 2 * FEWEST_OF_PASS:
        return None
    seconds, nanoseconds = (table.integers(*paths) for paths in zip(*STAMPS, strict=True))
    return None if seconds is None or nanoseconds is None else seconds * 1_000_000_000 + nanoseconds


def _repeats_of(table: TopicTable, header: Ints) -> Repeats | None:
    """Return the later passes of one topic, by its header stamps (n,) [ns]; None where it has none."""
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
    went_on, logged = int(header[row - 1] - header[0]), int(table.log_time_ns[row - 1] - table.log_time_ns[0])
    if steps[row - 1] >= 0 or min(went_on, logged) < SHORTEST_PASS_NS / MOST_SPEED:
        return None
    if max(went_on, logged) < SHORTEST_PASS_NS or not went_on <= MOST_SPEED * logged <= MOST_SPEED**2 * went_on:
        return None
    rows = np.flatnonzero(again)
    same = np.ones(len(rows), np.bool_)
    for values in table.columns.values():
        one, other = values[rows], values[before[rows]]
        equal = (one == other) | ((one != one) & (other != other))  # noqa: PLR0124 - a NaN is not equal to itself
        same &= equal if equal.ndim == 1 else equal.all(axis=1)
    if np.count_nonzero(same) < REPEATED_SHARE * len(rows):
        return None
    return Repeats(int(table.log_time_ns[row]), int(-steps[row - 1]), len(header) / row)
