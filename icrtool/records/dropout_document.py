"""Records of report.json, in which an unknown number is null; and the paths that pictures of a report show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import UNSET, Meta, UnsetType

from icrtool.config import Config
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.error_statistics import BlockSums, Histogram
from icrtool.kernels.track import OpenLoopPath
from icrtool.records.acceptance import BudgetDistance, Verdict
from icrtool.records.calibration_document import CalibrationDocument, HeldSensors
from icrtool.records.notes import Note
from icrtool.records.plain_data import Record
from icrtool.records.requests import ReportRequest
from icrtool.records.run_document import DriveDocument, IcrDocument
from icrtool.records.samples import InputFile

DROPOUT_SCHEMA: Literal["icrtool/dropout/1"] = "icrtool/dropout/1"
"""Version of what report.json holds."""

LARGEST_M = 1e12
"""Largest number in a report. A larger number shows that the file is damaged, and its square overflows."""

Number = Annotated[float, Meta(ge=-LARGEST_M, le=LARGEST_M)] | None
Numbers = list[Number]
Count = Annotated[int, Meta(ge=0, le=10**12)]


def column_of(rows: Sequence[Record], name: str) -> Floats:
    """Return a column (n,): one number for each row, NaN where a row has no number."""
    return np.array([math.nan if (value := getattr(row, name)) is None else value for row in rows], np.float64)


class RunOfReport(Record, frozen=True):
    """The fields of its run that a report holds."""

    schema: Literal["icrtool/run/1"]
    tool_version: str
    log: str
    inputs: tuple[InputFile, ...]
    config: Config
    drive: DriveDocument
    icr: IcrDocument


class ErrorRow(Record, frozen=True):
    """Errors of a model's trials at one horizon."""

    horizon_m: float
    trials: int
    expected_error_m: Number
    p50_m: Number
    p95_m: Number
    max_m: Number


class SummaryRow(ErrorRow, frozen=True):
    """A row of summary.csv: errors in metres and in percent of the distance, their intervals, errors of the heading.

    The intervals of this drive contain the true value with 95 %. `p95_next_low_m` to `p95_next_high_m` is where p95 of
    the next drive of this robot on this kind of ground lies in 9 of 10 cases.
    """

    expected_pct: Number
    p95_pct: Number
    expected_low_m: Number
    expected_high_m: Number
    p95_low_m: Number
    p95_high_m: Number
    p95_next_low_m: Number
    p95_next_high_m: Number
    heading_expected_deg: Number
    heading_p95_deg: Number


class BlocksDocument(Record, frozen=True):
    """Sums over blocks of path, as `icrtool.kernels.error_statistics.BlockSums`, for later comparisons."""

    horizon_m: float
    trials: list[Count]
    errors_m: Numbers
    above_p50: list[Count]
    above_p95: list[Count]
    p50_slope_m: Number
    p95_slope_m: Number

    def __post_init__(self) -> None:
        lengths = {len(column) for column in (self.trials, self.errors_m, self.above_p50, self.above_p95)}
        if len(lengths) > 1 or min(lengths) < 2:
            raise ValueError("blocks of unequal number, or fewer than two")


class ModelDocument(Record, frozen=True):
    """A model's errors. `words`: what predicts the motion; `knows`: the data that the parameters come from."""

    name: str
    words: str
    knows: str
    by_horizon: list[SummaryRow]
    blocks: list[BlocksDocument]

    def column(self, name: str) -> Floats:
        """Return a number at each horizon (h,), NaN where there is none."""
        return column_of(self.by_horizon, name)


class CountDocument(Record, frozen=True):
    """Number of starts that give a trial at a horizon, and numbers of the other starts by reason."""

    horizon_m: float
    trials: int
    no_trial: dict[str, int]
    why_none: str | None


class ReferenceRow(Record, frozen=True):
    """Error of the reference at a horizon: the error that a perfect model would show."""

    horizon_m: float
    std_m: Number
    expected_m: Number
    p95_m: Number


class LearnedDocument(Record, frozen=True):
    """The trials of a model that start before and after the ICRs were first learned.

    Attributes
    ----------
    learned_s, learned_at_distance_m : time [s] and distance [m] since the first recorded state at which the ICRs were
        learned; None where they were never learned: all trials then start before
    """

    model: str
    learned_s: Number
    learned_at_distance_m: Number
    before: list[ErrorRow]
    after: list[ErrorRow]


class EventCostDocument(Record, frozen=True):
    """Errors without the trials that cross a slip event: the difference is the cost of slip events.

    Attributes
    ----------
    events : number of slip events
    with_events : errors of all trials, by name of the filter's model
    """

    events: int
    with_events: dict[str, list[ErrorRow]]


class ScoreDocument(Record, frozen=True):
    """A model of the comparison: the data that it was fitted to, and its errors by horizon."""

    name: str
    fitted: str
    heading: str
    trials: list[int]
    expected_error_m: Numbers
    p50_m: Numbers
    p95_m: Numbers
    max_m: Numbers


class FitDocument(Record, frozen=True):
    """Parameters of a model fitted to the whole drive, by term."""

    value: dict[str, float]
    std: dict[str, Number]


class LadderDocument(Record, frozen=True):
    """The comparison of models. `left_out` is the reason why there is none; all other fields are then empty."""

    left_out: str | UnsetType = UNSET
    horizons_m: list[float] | UnsetType = UNSET
    blocks: int | UnsetType = UNSET
    starts: int | UnsetType = UNSET
    heading: str | UnsetType | None = UNSET
    notes: list[Note] | UnsetType = UNSET
    models: list[ScoreDocument] | UnsetType = UNSET
    width_m: float | UnsetType = UNSET
    fits: dict[str, FitDocument] | UnsetType = UNSET


class UsedCalibration(Record, frozen=True):
    """A calibration that a report has a row of.

    Attributes
    ----------
    name : name of its row
    model : model of the calibration
    logs : number of logs that the calibration was fitted to
    fitted_to_this : whether this log is among them
    created : date and time, UTC
    with_gyro : its row uses the gyro of the log
    calibration : content of its file, without the models that were not recommended, the scores and the findings on
        sensors
    fitted : whether this log was among the logs that it was fitted to, in words
    sensors : constants of the sensors that its row holds, and those of this log; None in a report of an earlier version
    """

    name: str
    model: str
    logs: int
    fitted_to_this: bool
    created: str
    with_gyro: bool = False
    calibration: CalibrationDocument | None = None
    fitted: str = ""
    sensors: HeldSensors | None = None


class StartHeading(Record, frozen=True):
    """Errors of a row as they are and with aligned start headings: the difference is the cost of the start heading.

    Attributes
    ----------
    expected_m, p95_m : errors of the row [m]
    aligned_expected_m, aligned_p95_m : errors of the paths that begin in the direction of the reference's first metres
    dominates : more than half of the square of p95 is due to the heading at the start, beyond the interval of the
        difference
    mend : what the user can do to get better start headings
    """

    expected_m: float
    p95_m: float
    aligned_expected_m: float
    aligned_p95_m: float
    dominates: bool
    mend: str


class BestRow(Record, frozen=True):
    """The row to drive with: the row of smallest expected error among the rows by wheels alone for a robot.

    Attributes
    ----------
    model : name of the row
    horizon_m : distance at which errors are compared: 10 m, or the nearest distance with trials
    as_good : rows for comparison (no_slip, vendor) whose expected error is not shown to be larger
    start_heading : cost of the start headings of this row; missing where it is not known
    """

    model: str
    horizon_m: float
    expected_error_m: float
    as_good: tuple[str, ...] = ()
    start_heading: StartHeading | UnsetType = UNSET


class TurningSplit(Record, frozen=True):
    """Expected error [m] by model over the trials that are straight, or over those that turn."""

    straight: bool
    horizon_m: float
    trials: int
    expected_m: dict[str, float]


class BaselineDocument(Record, frozen=True):
    """The earlier report that a report was compared with, and the differences that are not numbers."""

    path: str
    log: str
    tool_version: str
    same_recording: bool
    changes: tuple[str, ...]


class OutageDocument(Record, frozen=True):
    """An outage.

    Attributes
    ----------
    begin_s, end_s : seconds since the first recorded state
    distance_m : distance driven during the outage [m]
    end_error_m, max_error_m : error at the end, and largest error [m]. The error of a forced outage is the difference
        from the undisturbed estimate; the error of a real outage is the difference from the first fixes after it, and
        both numbers are equal
    """

    kind: Literal["forced", "real"]
    begin_s: float
    end_s: float
    distance_m: float
    end_error_m: Number
    max_error_m: Number


class TrialDocument(Record, frozen=True):
    """A trial. `model` names the model whose error the trial was chosen by."""

    model: str
    stamp_ns: int
    t_s: float
    north_m: float
    east_m: float
    horizon_m: float
    heading_change_deg: float
    speed_mean_mps: float
    errors_m: dict[str, Number]


class AlignedErrors(NamedTuple):
    """Errors of trials with aligned start headings [m], and their sums over blocks of path."""

    expected_m: float
    p95_m: float
    sums: BlockSums | None


class ModelResult(NamedTuple):
    """The errors of one model's trials.

    Attributes
    ----------
    document : the errors as report.json holds them
    histograms : histograms of the errors by horizon
    block_sums : sums over blocks of path by horizon, to all digits; None where the path is too short
    without_events : errors by horizon of the trials that touch no slip event; empty where the run has no slip event
    aligned : errors by horizon with aligned start headings; None where these headings are not known
    """

    document: ModelDocument
    histograms: tuple[Histogram, ...]
    block_sums: tuple[BlockSums | None, ...]
    without_events: tuple[ErrorRow, ...] = ()
    aligned: tuple[AlignedErrors | None, ...] = ()

    @property
    def name(self) -> str:
        """Name of the model."""
        return self.document.name

    def column(self, name: str) -> Floats:
        """Return a number at each horizon (h,), NaN where there is none."""
        return self.document.column(name)


@dataclass(frozen=True, slots=True)
class Outage:
    """An outage with the path without GNSS, for a picture.

    Attributes
    ----------
    north_m, east_m : (m,)
    """

    document: OutageDocument
    north_m: Floats
    east_m: Floats


@dataclass(frozen=True, slots=True)
class ExampleTrial:
    """A trial with the paths by the reference and by each model, for a picture.

    Attributes
    ----------
    document : numbers of the trial
    start, end : row of the first and of the last state of the trial
    reference_north_m, reference_east_m : (m,) path by the reference [m]
    paths : paths by the models, by name of the model
    """

    document: TrialDocument
    start: int
    end: int
    reference_north_m: Floats
    reference_east_m: Floats
    paths: dict[str, OpenLoopPath]


@dataclass(frozen=True, slots=True)
class PathErrors:
    """Errors of one model's trials by the place where each trial starts, for a picture.

    Attributes
    ----------
    model : name of the model
    horizon_m : length of the trials
    start : (k,) rows of the states at which the trials start, increasing
    error_m : (k,) error at the end of each trial [m]
    """

    model: str
    horizon_m: float
    start: Ints
    error_m: Floats


class IntervalsDocument(Record, frozen=True):
    """Probabilities of the intervals in a report.

    Attributes
    ----------
    level : probability that the interval of a number of this drive contains the true value
    next_level : probability that the interval of the next drive contains its number; missing in reports of earlier
        versions
    """

    method: str
    block: str
    level: float
    seed: int
    next_level: float | UnsetType = UNSET


class DropoutDocument(Record, frozen=True, kw_only=True):
    """report.json.

    Attributes
    ----------
    notes : the findings of the run and of the comparison of models; `warnings` : the sentences of the findings that are
        not grave
    """

    schema: Literal["icrtool/dropout/1"]
    tool_version: str
    run: RunOfReport
    usable: bool
    unusable_because: str | None
    notes: tuple[Note, ...]
    warnings: tuple[str, ...]
    request: ReportRequest
    starts: int
    starts_standing: int
    without_events: EventCostDocument | None
    tolerance_m: float
    intervals: IntervalsDocument
    models: tuple[ModelDocument, ...]
    trials: tuple[CountDocument, ...]
    reference_error: tuple[ReferenceRow, ...]
    by_learning: LearnedDocument | None
    calibrations: tuple[UsedCalibration, ...]
    recommended: CalibrationDocument | None
    budgets: tuple[BudgetDistance, ...]
    best: BestRow | None
    by_turning: tuple[TurningSplit, ...]
    ladder: LadderDocument
    gates: tuple[Verdict, ...]
    passed: bool
    baseline: BaselineDocument | None
    outages: tuple[OutageDocument, ...]
    worst: tuple[TrialDocument, ...]
    examples: tuple[TrialDocument, ...]
