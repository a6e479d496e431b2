"""The requests for a fit, for a dropout report and for a batch: one record for each question.

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
    """Request for a fit.

    Attributes
    ----------
    start, end : begin and end of the part of the log that is read, as in `icrtool.read_log`; None: begin and end of the
        log
    changes_s : times of terrain changes since the first recorded state [s]; the ICR covariance is inflated at these
        times (Fig. 9)
    smooth : also make the states of the RTS smoother
    """

    start: str | None = None
    end: str | None = None
    changes_s: tuple[float, ...] = ()
    smooth: bool = False


class ReportRequest(Record, frozen=True, kw_only=True):
    """Request for a dropout report.

    Attributes
    ----------
    horizons_m : distances without GNSS [m]; None: the configured ones. Horizons of `gates` are added
    budgets_m : budgets of the position error [m]. For each budget the report states the distance over which 95 % of
        the trials stay within the budget
    gates : acceptance limits, for example ``icr.p95@10m <= 3.8``
    strict_gates : limits relative to a baseline are compared by the number alone, without the confidence interval of
        the difference
    allow_unusable : the report on an unusable run has all rows and distances. False: the report has only the rows of
        the filter and of no slip, no distance, and every limit fails
    outage_s : lengths of outages to force on the filter [s]; None: the configured ones
    outage_at_s : begins of the forced outages since the first state [s]; empty: outages are spaced over the time in
        which the robot moves
    starts : ``moving`` counts each standstill once, ``all`` takes every recorded state, as the paper does
    reference : states that trials are compared with: of the filter or of the smoother
    without_events : trials that cross a slip event are left out
    with_jumps : trials that cross a jump of the reference are counted too, and models are fitted across it
    refit_sensors : heading offset, delays and gyro bias of the given calibrations are replaced by values that are
        fitted to this log
    ladder : all models are also tested on distance that they were not fitted to
    score : topics with poses in the log; each topic is compared with the reference, as the row ``topic:NAME``
    seed : seed of the random draws
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
        """The request for the fit of a run that this report can be made of."""
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
    """The files that a run and its report are written to.

    Attributes
    ----------
    overwrite : the run of another recording may be replaced
    plots, figures, states : formats, as in `icrtool.output.run_directory.new_run`
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
    """Request for a batch.

    Attributes
    ----------
    settings : sources of the configuration; the line of a manifest comes before the file and the robot in `settings`
    report, files : request and files of the report on every log
    redo : logs that are done are processed again
    timeout_s : longest time of the work on a log [s]; the process is ended after this time
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
    """Request of a batch for one log. It is sent as JSON to the process that works on the log.

    Paths are bytes, because names of files need not be text.

    Attributes
    ----------
    path : path of the log
    known : the row of the log, with the fields that are known before the fit
    folder : folder of the batch
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
        """Path of the file with the row, below the folder; a batch that continues this batch reads it."""
        name = self.known.run.removeprefix(f"{RUNS}/")
        return f"{ROWS}/{blake2b(os.fsencode(name), digest_size=16).hexdigest()}.json"

    def encode(self) -> bytes:
        """Return the request as one line of JSON."""
        return msgspec.json.encode(self)


_LOG_REQUEST = msgspec.json.Decoder(LogRequest)
"""Decoder of requests, made at import, because msgspec crashes if several threads use a type for the first time."""


def decode_request(line: bytes) -> LogRequest:
    """Return the request in a line that `LogRequest.encode` wrote."""
    return _LOG_REQUEST.decode(line)
