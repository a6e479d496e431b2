"""The row of a log in the tables of a fleet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from icrtool.records.dropout import Verdict
from icrtool.records.run import ICR_COLUMNS

RUNS, ROWS = "runs", ".rows"
"""Folders of a batch: of the runs, and of the rows of the logs, written as they come."""

HORIZONS_M = (1.0, 5.0, 10.0, 20.0)

SHOWN_ERROR, SHOWN_WITHOUT = "recommended_p95_10m_m", "icr_p95_10m_m"
"""The error of each log that is printed, drawn, and compared with the baseline; without a held-out one the second."""

BEFORE_ICRS = ("log", "status", "this_time", "reason", "robot", "group", "start_utc", "duration_s", "distance_m")
AFTER_ERRORS = ("events", "outages", "warnings", "tool_version", "run")
"""Columns of fleet.csv that a row holds as they are."""

Status = Literal["done", "failed"]
ThisTime = Literal["processed", "skipped"]


@dataclass(frozen=True, slots=True)
class File:
    """A file of a log as it was when it was read.

    Attributes
    ----------
    mtime_ns : with `bytes` spares hashing it again; 0 of one that is not on a disk
    sha256 : None where not all of it was read
    version : what its store states about the content, of one that is not on a disk
    """

    path: str
    bytes: int
    mtime_ns: int
    sha256: str | None
    version: str = ""


@dataclass(frozen=True, slots=True)
class Row:
    """What a batch knows of a log.

    Attributes
    ----------
    log : path below the common parent
    run : directory of the run below that of the batch
    status : of the result
    this_time : ``skipped``: the result is that of an earlier batch from the same input, configuration and version
    reason : why it failed, its ICRs are not usable, or that the log is truncated; `usable` : whether they are
    details : last lines of the process that failed
    repeatable : whether the same input, configuration and version give this result again
    icr : final ICRs [m] and, as ``std_…``, their standard deviations
    multiplier : (y_r - y_l)/b, wheel separation multiplier of a differential-drive controller, with `multiplier_std`
    errors : ``<model>_p95_<h>m_m``, ``<model>_expected_<h>m_m`` and ``<model>_within_<budget>m_m``
    outages, warnings : how many
    baseline : of the same names as `errors`, numbers of the log's report in the baseline
    changes : how log, configuration and version differ from those of the baseline
    key : hash of configuration, request and version
    """

    log: str
    run: str
    status: Status
    reason: str = ""
    usable: bool = True
    details: str = ""
    repeatable: bool = True
    robot: str = ""
    group: str = ""
    tags: tuple[str, ...] = ()
    start_utc: str = ""
    duration_s: float | None = None
    distance_m: float | None = None
    icr: dict[str, float | None] = field(default_factory=dict)
    multiplier: float | None = None
    multiplier_std: float | None = None
    errors: dict[str, float | None] = field(default_factory=dict)
    events: int | None = None
    outages: int | None = None
    warnings: int | None = None
    verdicts: tuple[Verdict, ...] = ()
    baseline: dict[str, float | None] = field(default_factory=dict)
    changes: tuple[str, ...] = ()
    inputs: tuple[File, ...] = ()
    key: str = ""
    tool_version: str = ""
    took_s: float = 0.0
    this_time: ThisTime = "processed"

    def shown_error(self, *, baseline: bool = False) -> float | None:
        """Return the error [m] that stands for the log, or for its baseline."""
        errors = self.baseline if baseline else self.errors
        return errors.get(SHOWN_ERROR if SHOWN_ERROR in self.errors else SHOWN_WITHOUT)

    @property
    def gates_failed(self) -> int:
        """How many acceptance limits were missed."""
        return sum(not verdict.passed for verdict in self.verdicts)

    def columns(self) -> dict[str, Any]:
        """Return the row of fleet.csv."""
        icrs = (*ICR_COLUMNS, *(f"std_{name}" for name in ICR_COLUMNS))
        return {
            **{name: getattr(self, name) for name in BEFORE_ICRS},
            **{name: self.icr.get(name) for name in icrs},
            "multiplier": self.multiplier,
            "multiplier_std": self.multiplier_std,
            **self.errors,
            **{name: getattr(self, name) for name in AFTER_ERRORS},
            "tags": ";".join(self.tags),
            "gates_failed": self.gates_failed if self.status != "failed" else None,
            "took_s": self.took_s,
        }


def counts_text(rows: Sequence[Row]) -> str:
    """Return how many logs were done and failed, and how many of them by an earlier batch."""
    counts = Counter(row.status for row in rows)
    text = ", ".join(f"{counts[status]} {status}" for status in ("done", "failed") if counts[status])
    skipped = sum(row.this_time == "skipped" for row in rows)
    return f"{text} ({skipped} of them before, skipped this time)" if skipped else text


def as_text(path: object) -> str:
    """Return a path as text that every file takes: bytes of its name that are no UTF-8 as escapes."""
    return str(path).encode("utf-8", errors="backslashreplace").decode()


def columns_of(rows: Sequence[Row]) -> list[str]:
    """Return the columns of all rows, those of the errors in the order of models and horizons."""
    names: dict[str, None] = {}
    fixed = list(Row("", "", "done").columns())
    place = fixed.index("multiplier_std") + 1
    for row in rows:
        names |= dict.fromkeys(row.errors)
    return [*fixed[:place], *names, *fixed[place:]]
