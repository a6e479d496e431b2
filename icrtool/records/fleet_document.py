"""fleet.json: what a batch found of each log, and the calibration of each robot and group."""

from __future__ import annotations

from typing import Literal

from msgspec import UNSET, UnsetType, field

from icrtool.records.acceptance import BudgetDistance, Verdict
from icrtool.records.notes import Note
from icrtool.records.plain_data import Record
from icrtool.records.rows import FALLBACK_ROW, MAIN_ROW

FLEET_SCHEMA: Literal["icrtool/fleet/1"] = "icrtool/fleet/1"
"""Version of what fleet.json holds."""

FLEET_FILE = "fleet.json"
"""Name of the file with the result of a batch, in its folder."""

FLEET_FAMILY = "icrtool/fleet/"
"""First characters of the schema of a fleet.json, of any version."""

RUNS, ROWS = "runs", ".rows"
"""Folders of a batch: the runs, and the rows of the logs, each written when its log is done."""

BUDGET_M = 0.5
"""Position error that defines the distance stated for a calibration [m]."""

SHOWN_ERROR, SHOWN_FALLBACK = f"{MAIN_ROW}_p95_10m_m", f"{FALLBACK_ROW}_p95_10m_m"
"""The error of each log that is printed, drawn and compared with the baseline; the second where no held-out error
exists."""


def next_low_name(model: str, budget_m: float) -> str:
    """Return the name in `FleetLog.errors` of the distance that the next drive keeps within a budget, 9 of 10."""
    return f"{model}_next_low_{budget_m:g}m_m"


Status = Literal["done", "failed"]
ThisTime = Literal["processed", "skipped"]


class FleetVerdict(Record, frozen=True, kw_only=True):
    """An acceptance limit of a log, as `icrtool.records.acceptance.Verdict`; `gate` is its text."""

    gate: str
    value_m: float | None
    margin_m: float | None
    passed: bool
    line: str
    relative: bool
    bound_m: float | None
    baseline_m: float | None
    margin_low_m: float | None
    margin_high_m: float | None
    not_checked: str


def fleet_verdict(verdict: Verdict, log: str) -> FleetVerdict:
    """Return an acceptance limit under the keys of fleet.json, with the line about it, which names the log."""
    return FleetVerdict(
        gate=verdict.text, value_m=verdict.value_m, margin_m=verdict.margin_m, passed=verdict.passed,
        line=verdict.line(log), relative=verdict.relative, bound_m=verdict.value_bound_m, baseline_m=verdict.baseline_m,
        margin_low_m=verdict.margin_low_m, margin_high_m=verdict.margin_high_m, not_checked=verdict.not_checked or "",
    )  # fmt: skip


class FleetFile(Record, frozen=True):
    """A file of a log, when it was read.

    Attributes
    ----------
    mtime_ns : time of modification: where it and `bytes` are the same, the file is not hashed again; 0 for a file that
        is not on a disk
    sha256 : None where not all of it was read
    version : what its store states about the content, for a file that is not on a disk
    address : SHA-256 of the whole address, for a file that is not on a disk
    """

    path: str
    bytes: int
    mtime_ns: int
    sha256: str | None
    version: str = ""
    address: str = ""


class FleetLog(Record, frozen=True):
    """What a batch knows of a log.

    Attributes
    ----------
    log : path below the common parent
    run : directory of the run, below the directory of the batch
    status : of the result
    this_time : ``skipped``: the result is from an earlier batch with the same input, configuration and version
    reason : why it failed, why its ICRs are not usable, or that the log is truncated
    usable : whether its ICRs are usable
    details : last lines of the process that failed
    repeatable : whether the same input, configuration and version give this result again
    icr : final ICRs [m] and, as ``std_…``, their standard deviations
    multiplier : (y_r - y_l)/b, wheel separation multiplier of a differential-drive controller, with `multiplier_std`
    errors : ``<model>_p95_<h>m_m``, ``<model>_expected_<h>m_m`` and ``<model>_within_<budget>m_m``; the 95 % interval
        ``<model>_p95_low_10m_m`` to ``<model>_p95_high_10m_m``; ``<model>_next_low_<budget>m_m``, the distance within
        the budget that the next drive keeps in 9 of 10 cases
    bounds : the names in `errors` whose distance is a lower bound
    outages, warnings : number of each
    notes : findings of the run, the grave ones among them
    baseline : numbers of the log's report in the baseline, by the names of `errors`
    changes : how log, configuration and version differ from the baseline
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
    bounds: tuple[str, ...] = ()
    events: int | None = None
    outages: int | None = None
    warnings: int | None = None
    notes: tuple[Note, ...] = ()
    verdicts: tuple[FleetVerdict, ...] = ()
    baseline: dict[str, float | None] = field(default_factory=dict)
    changes: tuple[str, ...] = ()
    inputs: tuple[FleetFile, ...] = ()
    key: str = ""
    tool_version: str = ""
    took_s: float = 0.0
    this_time: ThisTime = "processed"

    @property
    def codes(self) -> tuple[str, ...]:
        """The codes of its findings, each once."""
        return tuple(dict.fromkeys(one.code for one in self.notes))

    def shown_error(self, *, baseline: bool = False) -> float | None:
        """Return the error [m] that stands for the log, or for its baseline."""
        errors = self.baseline if baseline else self.errors
        return errors.get(SHOWN_ERROR if SHOWN_ERROR in self.errors else SHOWN_FALLBACK)

    @property
    def gates_failed(self) -> int:
        """How many acceptance limits were missed."""
        return sum(not verdict.passed for verdict in self.verdicts)


class FleetCalibration(Record, frozen=True):
    """The calibration of all logs of one robot in one group.

    Attributes
    ----------
    logs : the logs that it is fitted to
    left_out : logs that are not usable, copies, parts of another, or beyond the time that is calibrated together
    file : calibration file below the folder of the batch; empty where there is no calibration, `reason` states why
    recommended, multiplier, multiplier_std : recommended model and multiplier of the calibration
    icrs_m : right, left, x of the calibration
    within_m : distance over which 95 % of the held-out errors stay within `BUDGET_M`; within_beyond : it is a lower
        bound; within_between_m : the two horizons between which it was interpolated, None in older files
    table : leave-one-log-out table as text
    key : hash of the logs and their content
    """

    robot: str
    group: str
    logs: tuple[str, ...]
    left_out: tuple[str, ...] = ()
    file: str = ""
    reason: str = ""
    recommended: str = ""
    multiplier: float | None = None
    multiplier_std: float | None = None
    icrs_m: tuple[float, ...] = ()
    within_m: float | None = None
    within_beyond: bool = False
    within_between_m: tuple[float, float] | None = None
    table: str = ""
    key: str = ""

    @property
    def within(self) -> BudgetDistance | None:
        """How far the held-out errors stay within `BUDGET_M`; None where that is not known."""
        if self.within_m is None:
            return None
        between_m = self.within_between_m or (self.within_m, self.within_m)
        return BudgetDistance(MAIN_ROW, BUDGET_M, self.within_m, self.within_beyond, between_m)

    @property
    def within_text(self) -> str:
        """How far, as ``, within 0.5 m (95 %) for about 15 m with recommended``; empty where that is not known."""
        if self.within is None:
            return ""
        return f", within {BUDGET_M:g} m (95 %) for {self.within.short_text} with {MAIN_ROW}"


class FleetCounts(Record, frozen=True):
    """How many logs were done and failed, and how many of them by an earlier batch."""

    done: int
    failed: int
    skipped: int


class FleetDocument(Record, frozen=True, kw_only=True):
    """fleet.json; `output`: the folder of the batch, in what ``--json`` prints."""

    schema: Literal["icrtool/fleet/1"]
    tool_version: str
    counts: FleetCounts
    gates_failed: int
    calibrations: tuple[FleetCalibration, ...] = ()
    logs: tuple[FleetLog, ...]
    output: str | UnsetType = UNSET
