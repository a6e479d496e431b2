"""What is asked of a fit, of a dropout report and of a batch: one record for each question.

The command line makes a request from its options, a public function makes it from its keyword arguments. The code that
acts on a request gets it unchanged, and run.json or report.json holds it as ``request``. A request holds words and
numbers. Calibrations, a baseline or a warm start are read from files and passed as further arguments. `ResultFiles`
states which files are written: it changes no number, and no document holds it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path

import msgspec

from icrtool.config import Config, ConfigSources
from icrtool.records.acceptance import DEFAULT_SEED
from icrtool.records.choices import FigureSet, Reference, Starts, StatesFormat
from icrtool.records.fleet_document import ROWS, RUNS, FleetLog
from icrtool.records.plain_data import Record


class FitRequest(Record, frozen=True, kw_only=True):
    """What is asked of a fit.

    Attributes
    ----------
    start, end : from when to when the log is read, as in `icrtool.read_log`; None: from its begin, to its end
    changes_s : terrain changes, seconds since the first recorded state: the ICR covariance is inflated there (Fig. 9)
    smooth : also make the states of the RTS smoother
    """

    start: str | None = None
    end: str | None = None
    changes_s: tuple[float, ...] = ()
    smooth: bool = False


class ReportRequest(Record, frozen=True, kw_only=True):
    """What is asked of a dropout report.

    Attributes
    ----------
    horizons_m : distances without GNSS [m]; None: the configured ones. Horizons of `gates` are added
    budgets_m : for each, the distance over which 95 % of the trials stay within it [m]
    gates : acceptance limits, for example ``icr.p95@10m <= 3.8``
    strict_gates : limits relative to a baseline are compared by the number alone, without the confidence interval of
        the difference
    allow_unusable : a run that is not usable is reported on like any other. Else its report has the rows of the filter
        and of no slip alone and no distance, and every limit fails
    outage_s : lengths of outages to force on the filter [s]; None: the configured ones
    outage_at_s : their begins, seconds since the first state; empty: spaced over the time in which the robot moves
    starts : ``moving`` counts each standstill once, ``all`` takes every recorded state, as the paper does
    reference : what trials are compared with: the states of the filter or of the smoother
    without_events : trials that cross a slip event are left out
    with_jumps : trials that cross a jump of the reference are counted too, and models are fitted across it
    refit_sensors : heading offset, delays and gyro bias of calibrations that are given are refitted in this log, in
        place of those that the calibrations hold
    ladder : all models are also tested on distance that they were not fitted to
    score : topics of poses in the log, each compared with the reference as a row ``topic:NAME``
    seed : of the random draws
    """

    horizons_m: tuple[float, ...] | None = None
    budgets_m: tuple[float, ...] = (0.5,)
    gates: tuple[str, ...] = ()
    strict_gates: bool = False
    allow_unusable: bool = False
    outage_s: tuple[float, ...] | None = None
    outage_at_s: tuple[float, ...] = ()
    starts: Starts = "moving"
    reference: Reference = "filter"
    without_events: bool = False
    with_jumps: bool = False
    refit_sensors: bool = False
    ladder: bool = True
    score: tuple[str, ...] = ()
    seed: int = DEFAULT_SEED

    @property
    def fit(self) -> FitRequest:
        """What is asked of a fit whose run shall have such a report."""
        return FitRequest(smooth=self.reference == "smoothed")

    def configured(self, config: Config) -> ReportRequest:
        """Return the request with the horizons and outages of a configuration, where the request states none."""
        dropout, keys_set = config.dropout, config.given
        return msgspec.structs.replace(
            self,
            horizons_m=self.horizons_m or (dropout.horizons_m if "dropout.horizons_m" in keys_set else None),
            outage_s=self.outage_s or (dropout.forced_outage_s if "dropout.forced_outage_s" in keys_set else None),
        )


class ResultFiles(Record, frozen=True, kw_only=True):
    """In which files a run and its report are written.

    Attributes
    ----------
    overwrite : the run of another recording may be replaced
    plots, figures, states : as in `icrtool.output.run_directory.new_run`
    trials : every single trial is written to trials.parquet
    page : report.html is written
    """

    overwrite: bool = False
    plots: tuple[str, ...] = ("png",)
    figures: FigureSet = "default"
    states: StatesFormat | None = None
    trials: bool = False
    page: bool = True


@dataclass(frozen=True, slots=True)
class BatchRequest:
    """What is asked of a batch.

    Attributes
    ----------
    settings : a manifest's line comes before its file and robot
    report, files : of every log
    redo : logs that are done are processed again
    timeout_s : longest time of a log [s]; a longer process is ended
    calibrations : files of calibrations, each of which becomes a row of every report
    baseline : earlier report, run or batch to compare with
    """

    settings: ConfigSources = field(default_factory=ConfigSources)
    report: ReportRequest = field(default_factory=ReportRequest)
    files: ResultFiles = field(default_factory=ResultFiles)
    redo: bool = False
    timeout_s: float = 1800.0
    calibrations: tuple[Path, ...] = ()
    baseline: Path | None = None


class CalibrationInput(Record, frozen=True):
    """A calibration file of a batch: its path, and the SHA-256 of its content when the batch began."""

    path: bytes
    sha256: str


class LogRequest(Record, frozen=True, kw_only=True):
    """What a batch asks of one log; travels to the process that does it as JSON. Paths are bytes: of any name.

    Attributes
    ----------
    path : of the log
    known : the fields of its row that are known before the fit
    folder : of the batch
    calibrations : each becomes a row of the report
    baseline : place of an earlier report or batch to compare with; empty: none
    """

    path: bytes
    known: FleetLog
    folder: bytes
    config: Config
    report: ReportRequest
    files: ResultFiles
    calibrations: tuple[CalibrationInput, ...] = ()
    baseline: bytes = b""

    @property
    def row_file(self) -> str:
        """Where the row is written, below the folder, for a batch that continues this one."""
        name = self.known.run.removeprefix(f"{RUNS}/")
        return f"{ROWS}/{blake2b(os.fsencode(name), digest_size=16).hexdigest()}.json"

    def encode(self) -> bytes:
        """Return it as one line of JSON."""
        return msgspec.json.encode(self)


_LOG_REQUEST = msgspec.json.Decoder(LogRequest)
"""Made at import: msgspec crashes where several threads are the first to use a type."""


def decode_request(line: bytes) -> LogRequest:
    """Return what `LogRequest.encode` wrote."""
    return _LOG_REQUEST.decode(line)
