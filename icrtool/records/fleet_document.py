"""Records of fleet.json: the result of a batch for each log, and the calibration of each robot and group."""

from __future__ import annotations

from typing import Literal

from msgspec import UNSET, UnsetType, field

from icrtool.records.acceptance import BudgetDistance, Verdict
from icrtool.records.notes import Note
from icrtool.records.plain_data import Record
from icrtool.records.rows import FALLBACK_ROW, MAIN_ROW

FLEET_SCHEMA: Literal["icrtool/fleet/1"] = "icrtool/fleet/1"
"""Version of the content of fleet.json."""

FLEET_FILE = "fleet.json"
"""Name of the file with the result of a batch, in its folder."""

FLEET_FAMILY = "icrtool/fleet/"
"""First characters of the schema of a fleet.json, of any version."""

RUNS, ROWS = "runs", ".rows"
"""Names of folders of a batch: of the runs, and of the rows. The row of a log is written when the log is done."""

BUDGET_M = 0.5
"""Position error that defines the distance stated for a calibration [m]."""

SHOWN_ERROR, SHOWN_FALLBACK = f"{MAIN_ROW}_p95_10m_m", f"{FALLBACK_ROW}_p95_10m_m"
"""Names of the error of each log that is printed, drawn and compared with the baseline. The second name is used where
a log has no held-out error."""


def next_low_name(model: str, budget_m: float) -> str:
    """Return the name in `FleetLog.errors` of the distance over which 9 of 10 next drives stay within a budget."""
    return f"{model}_next_low_{budget_m:g}m_m"


Status = Literal["done", "failed"]
ThisTime = Literal["processed", "skipped"]


class FleetVerdict(Record, frozen=True, kw_only=True):
    """Verdict on an acceptance limit, as `icrtool.records.acceptance.Verdict`. `gate` is the text of the limit."""

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
    """Return a verdict under the keys of fleet.json. Its `line` names the log."""
    return FleetVerdict(
        gate=verdict.text, value_m=verdict.value_m, margin_m=verdict.margin_m, passed=verdict.passed,
        line=verdict.line(log), relative=verdict.relative, bound_m=verdict.value_bound_m, baseline_m=verdict.baseline_m,
        margin_low_m=verdict.margin_low_m, margin_high_m=verdict.margin_high_m, not_checked=verdict.not_checked or "",
    )  # fmt: skip


class FleetFile(Record, frozen=True):
    """A file of a log, in the state in which it was read.

    Attributes
    ----------
    mtime_ns : time of modification; 0 for a file that is not on a disk. Where `mtime_ns` and `bytes` are unchanged, the
        file is not hashed again
    sha256 : None where not all of it was read
    version : version of the content by the object store or web server, for a file that is not on a disk
    address : SHA-256 of the whole address, for a file that is not on a disk
    """

    path: str
    bytes: int
    mtime_ns: int
    sha256: str | None
    version: str = ""
    address: str = ""


class FleetLog(Record, frozen=True):
    """The row of a log in a batch.

    Attributes
    ----------
    log : path below the common parent
    run : directory of the run, below the directory of the batch
    status : whether the log was done or failed
    this_time : ``skipped``: the result is from an earlier batch with the same input, configuration and version
    reason : why the log failed, why its ICRs are not usable, or that the log is truncated
    usable : whether the ICRs of the log are usable
    details : last lines of the process that failed
    repeatable : whether the same input, configuration and version give this result again
    icr : final ICRs [m] and, as ``std_…``, their standard deviations
    multiplier : (y_r - y_l)/b, wheel separation multiplier of a differential-drive controller, with `multiplier_std`
    errors : ``<model>_p95_<h>m_m``, ``<model>_expected_<h>m_m`` and ``<model>_within_<budget>m_m``; the 95 % interval
        ``<model>_p95_low_10m_m`` to ``<model>_p95_high_10m_m``; ``<model>_next_low_<budget>m_m``, the distance over
        which 9 of 10 next drives stay within the budget
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
        """The codes of the log's findings, each once."""
        return tuple(dict.fromkeys(finding.code for finding in self.notes))

    def shown_error(self, *, baseline: bool = False) -> float | None:
        """Return the error [m] that stands for the log, or for its baseline."""
        errors = self.baseline if baseline else self.errors
        return errors.get(SHOWN_ERROR if SHOWN_ERROR in self.errors else SHOWN_FALLBACK)

    @property
    def gates_failed(self) -> int:
        """Number of acceptance limits that the log does not meet."""
        return sum(not verdict.passed for verdict in self.verdicts)


class FleetCalibration(Record, frozen=True):
    """The calibration of all logs of one robot in one group.

    Attributes
    ----------
    logs : the logs that it is fitted to
    left_out : logs that are not usable, copies, parts of another, or beyond the time that is calibrated together
    file : calibration file below the folder of the batch; empty where there is no calibration, `reason` states why
    recommended, multiplier, multiplier_std : recommended model and multiplier of the calibration
    icrs_m : right, left and x ICR of the calibration [m]
    within_m : distance over which 95 % of the held-out errors stay within `BUDGET_M` [m]
    within_beyond : whether `within_m` is a lower bound
    within_between_m : the two horizons between which `within_m` was interpolated [m]; None in files of older versions
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
        """Distance over which 95 % of the held-out errors stay within `BUDGET_M`; None where it is not known."""
        if self.within_m is None:
            return None
        between_m = self.within_between_m or (self.within_m, self.within_m)
        return BudgetDistance(MAIN_ROW, BUDGET_M, self.within_m, self.within_beyond, between_m)

    @property
    def within_text(self) -> str:
        """`within` as ``, within 0.5 m (95 %) for about 15 m with recommended``; empty where it is not known."""
        if self.within is None:
            return ""
        return f", within {BUDGET_M:g} m (95 %) for {self.within.short_text} with {MAIN_ROW}"


class FleetCounts(Record, frozen=True):
    """Numbers of logs that were done and that failed, and number of these that an earlier batch processed."""

    done: int
    failed: int
    skipped: int


class FleetDocument(Record, frozen=True, kw_only=True):
    """Content of fleet.json. `output` is the folder of the batch; only the output of ``--json`` has it."""

    schema: Literal["icrtool/fleet/1"]
    tool_version: str
    counts: FleetCounts
    gates_failed: int
    calibrations: tuple[FleetCalibration, ...] = ()
    logs: tuple[FleetLog, ...]
    output: str | UnsetType = UNSET
