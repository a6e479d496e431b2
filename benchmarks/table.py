"""The table of `benchmarks/run.py`: rows with a ratio to a peer that is measured beside them, as text and as JSON."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

SCHEMA = "icrtool/bench/1"
HEAD = "| what | ours: median (min-max) | peer | peer / ours | goal |\n|---|---|---|---|---|"


class Row(NamedTuple):
    """A measurement, several times, and what it is compared with on the same machine at the same time.

    Attributes
    ----------
    what : name; unique in a table
    values : one for each repeat, in `unit`
    peer : median of the peer, in `unit`; of_peer : what that is
    goal : wanted, in words, for a log of 1 h
    """

    what: str
    values: tuple[float, ...]
    unit: str
    peer: float
    of_peer: str
    goal: str

    @property
    def median(self) -> float:
        """Median of the repeats."""
        return statistics.median(self.values)

    @property
    def ratio(self) -> float:
        """Peer over ours: how many times less we need; for a rate, how many times more the peer does."""
        return self.peer / self.median


class Table:
    """Rows in their order, each printed when it is added."""

    def __init__(self, log_s: float) -> None:
        self.log_s = log_s
        self.rows: list[Row] = []

    def add(
        self, what: str, values: Sequence[float], peer: float, of_peer: str, *, unit: str = "s", goal: str = ""
    ) -> None:
        """Print a row of the table and keep it."""
        row = Row(what, tuple(values), unit, peer, of_peer, goal)
        self.rows.append(row)
        span = f" ({min(values):.3g}-{max(values):.3g}, n={len(values)})" if len(values) > 1 else ""
        ours, other = f"{row.median:.3g} {unit}{span}", f"{peer:.3g} {unit} {of_peer}"
        print(f"| {what} | {ours} | {other} | {row.ratio:.3g} | {goal} |", flush=True)

    def write(self, path: Path) -> None:
        """Write the rows as JSON."""
        rows = [{**row._asdict(), "median": row.median, "ratio": row.ratio} for row in self.rows]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"schema": SCHEMA, "log_s": self.log_s, "rows": rows}, indent=1) + "\n")


def seconds_of(
    call: Callable[[], object], repeats: int, *, warm_up: bool = True, clock: Callable[[], float] = time.perf_counter
) -> list[float]:
    """Return the wall seconds of some calls, or those of another clock, after one to warm up."""
    if warm_up:
        call()
    seconds = []
    for _ in range(repeats):
        begin = clock()
        call()
        seconds.append(clock() - begin)
    return seconds


cpu_seconds_of = partial(seconds_of, clock=time.process_time)
"""CPU seconds of some calls: for kernels of one thread, which another process on the machine does not lengthen."""
