"""Records of run.json, the content of a run in addition to its columns. `icrtool.fit` makes them.

A key that a later version adds has a default, so that older runs can still be read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Generic, Literal, TypeVar

import msgspec
from msgspec import UNSET, UnsetType

from icrtool.config import Config
from icrtool.records.measurements import (
    AlignmentEstimate,
    HeadingFacts,
    IcrStart,
    LogFacts,
    ReferenceJump,
    SlipKind,
    Triple,
    WheelFacts,
)
from icrtool.records.notes import Note
from icrtool.records.plain_data import Record
from icrtool.records.requests import FitRequest
from icrtool.records.samples import InputFile, StreamChoice

RUN_SCHEMA: Literal["icrtool/run/1"] = "icrtool/run/1"
"""Version of the content of run.json."""

Excited = Literal["shown", "weak", "not shown"]
IcrColumn = Literal["y_icr_right_m", "y_icr_left_m", "x_icr_m"]
Value = TypeVar("Value")
Spans = tuple[tuple[int, int], ...]
Three = msgspec.Meta(min_length=3, max_length=3)
Matrix = Annotated[list[Annotated[list[float], Three]], Three]


def check_together(record: object, *names: str) -> None:
    """Refuse a record in which some of the named numbers are None and others are not.

    Raises
    ------
    ValueError
        Only some of the numbers are known.
    """
    if len({getattr(record, name) is None for name in names}) > 1:
        raise ValueError(f"only some of {', '.join(names)} are known")


def known_content(content: Iterable[str | None]) -> tuple[str, ...]:
    """Return the SHA-256 of the files of a log; empty if the SHA-256 of any file is not known."""
    digests = tuple(content)
    return () if None in digests else tuple(map(str, digests))


class ByIcr(Record, Generic[Value], frozen=True):
    """A value of each ICR."""

    y_icr_right_m: Value
    y_icr_left_m: Value
    x_icr_m: Value

    def __getitem__(self, column: IcrColumn) -> Value:
        value: Value = getattr(self, column)
        return value


class NumberByIcr(ByIcr[float | None], frozen=True):
    """A number of each ICR, null where the ICR has no number."""


class SpanByIcr(ByIcr[tuple[float, float] | None], frozen=True):
    """Begin and end of each ICR's convergence [s], null where it did not converge."""


class VerdictByIcr(ByIcr[Excited], frozen=True):
    """Whether each ICR was shown."""

    @property
    def all_shown(self) -> bool:
        """Whether all three ICRs are shown."""
        return self == VerdictByIcr("shown", "shown", "shown")

    @property
    def not_shown(self) -> tuple[str, ...]:
        """The ICRs that are not shown."""
        return tuple(name for name in self.__struct_fields__ if getattr(self, name) == "not shown")

    @property
    def shows_sides(self) -> bool:
        """Whether both y ICRs are shown, at least weakly."""
        return "not shown" not in (self.y_icr_right_m, self.y_icr_left_m)


class DriveDocument(Record, frozen=True):
    """Duration, distance and speed."""

    duration_s: float
    distance_m: float
    speed_mean_mps: float
    speed_std_mps: float


class IcrDocument(Record, frozen=True, kw_only=True):
    """The ICRs and how they converged; null where not shown.

    `mean` and `std` are taken over the states after convergence. `x_clock_std_m` is the part of the standard deviation
    of x that comes from the clocks [m].
    """

    final: NumberByIcr
    final_std: NumberByIcr
    mean: NumberByIcr
    std: NumberByIcr
    convergence_s: NumberByIcr
    convergence_span_s: SpanByIcr
    separation_multiplier: float | None
    separation_multiplier_std: float | None
    final_covariance_m2: Matrix
    x_clock_std_m: float = 0.0

    def __post_init__(self) -> None:
        check_together(self, "separation_multiplier", "separation_multiplier_std")
        for name in NumberByIcr.__struct_fields__:
            if (
                len({getattr(numbers, name) is None for numbers in (self.final, self.final_std, self.mean, self.std)})
                > 1
            ):
                raise ValueError(f"only some of final, final_std, mean and std are known of {name}")


class PathErrorDocument(Record, frozen=True):
    """Errors of an odometry of the whole drive: distances from the position by the filter.

    Attributes
    ----------
    end_error_m : error at the last state [m]
    mean_error_m, max_error_m : mean and largest error over all states [m]; missing in runs of earlier versions
    """

    end_error_m: float
    mean_error_m: float | UnsetType = UNSET
    max_error_m: float | UnsetType = UNSET


class OdometryDocument(Record, frozen=True):
    """Paths by wheel speeds alone, from the first state to the last (Pentzer 2014, Section 6.1).

    Attributes
    ----------
    icr : errors with the final ICRs
    icr_momentary : errors with the ICRs that the filter had estimated at each state; missing in runs of earlier
        versions
    no_slip : errors without slip; None where the track width is not known
    """

    icr: PathErrorDocument
    no_slip: PathErrorDocument | None
    icr_momentary: PathErrorDocument | UnsetType = UNSET


class ChangeDocument(Record, frozen=True):
    """A terrain change."""

    t_s: float


class TerrainDocument(Record, frozen=True):
    """Terrain changes at which the ICR covariance was inflated."""

    changes: tuple[ChangeDocument, ...]


class SegmentDocument(Record, frozen=True):
    """The ICRs between two changes."""

    begin_s: float
    end_s: float
    mean: NumberByIcr
    std: NumberByIcr


class EventDocument(Record, frozen=True):
    """A slip event."""

    kind: SlipKind
    begin_s: float
    end_s: float
    begin_ns: int
    end_ns: int
    north_m: float
    east_m: float
    distance_m: float
    severity: float
    confidence: float


EVENT_COLUMNS = EventDocument.__struct_fields__
"""The columns of events.csv; seconds count from the first recorded state."""


class ReferenceJumpDocument(ReferenceJump, frozen=True):
    """A discontinuity of the reference; seconds count from the first recorded state."""

    begin_s: float
    end_s: float


class ClassDocument(Record, frozen=True, kw_only=True):
    """The fixes of one class. `std_m`: median of the stated values; `step_std_m`: white noise from step to step [m]."""

    fixes: int
    used: int
    rejected: int
    down_weighted: int
    sold_as_fixed: int
    std_m: float | None
    step_std_m: float | None


class GnssDocument(Record, frozen=True):
    """The position fixes."""

    used: int
    rejected: int
    rejected_by_gate: int
    rejected_by_reason: dict[str, int]
    recoveries: int
    mean_difference_m: float | None
    max_difference_m: float | None
    datum: Triple | None
    delay_s: float | None
    delay_std_s: float | None
    classes: dict[str, ClassDocument]

    def __post_init__(self) -> None:
        check_together(self, "mean_difference_m", "max_difference_m")
        check_together(self, "delay_s", "delay_std_s")


class HeadingDocument(HeadingFacts, frozen=True, kw_only=True):
    """The heading: findings of the alignment, and its use by the filter."""

    delay_s: float | None
    delay_std_s: float | None
    applied_delay_s: float
    used: int
    rejected: int

    def __post_init__(self) -> None:
        check_together(self, "delay_s", "delay_std_s")
        check_together(self, "offset_deg", "offset_std_deg")


class WarmStartDocument(Record, frozen=True):
    """The warm start of a run. `source` is the name of the run or file it comes from, empty where it is not known."""

    icrs_m: Annotated[list[float], Three]
    covariance_m2: Matrix
    source: str = ""


class FilterDocument(Record, frozen=True, kw_only=True):
    """Settings of the filter and statistics of its innovations; see `icrtool.records.measurements`."""

    preset: str
    process_position_mps: float
    process_heading_degps: float
    reference_delay_s: float
    states: int
    warm_start: WarmStartDocument | None
    icr_start: IcrStart | None
    nis_gnss_mean: float | None
    gnss_rejected: int
    nis_heading_mean: float | None
    heading_rejected: int


class ExcitationDocument(Record, frozen=True):
    """The information of a drive about the ICRs.

    Attributes
    ----------
    std_m : smallest possible standard deviations of the ICRs (Cramer-Rao bound, constant ICRs, some slip) [m]
    turned_right_deg, turned_left_deg : sums of the heading changes to each side; spun_*: the part on the spot
    notes : the verdict in words, and what to drive next; empty where all ICRs are shown
    """

    std_m: NumberByIcr
    verdict: VerdictByIcr
    turned_right_deg: float
    turned_left_deg: float
    spun_right_deg: float
    spun_left_deg: float
    notes: tuple[Note, ...]


class ParameterDocument(Record, frozen=True):
    """A parameter of a motion model."""

    value: float
    std: float
    verdict: Literal["shown", "not shown"] = "shown"


class ControllerNumbers(Record, frozen=True):
    """Numbers for a differential-drive controller, each with one standard deviation.

    Attributes
    ----------
    multiplier : (y_r - y_l) / b, used together with the radius factors
    left_radius, right_radius : ratio of wheel radius to configured radius, configured scales included
    multiplier_between_std, radius_between_std : standard deviation between drives of one robot on one kind of ground,
        in addition to the uncertainty of one drive
    """

    multiplier: float
    multiplier_std: float
    left_radius: float
    left_radius_std: float
    right_radius: float
    right_radius_std: float
    multiplier_between_std: float = 0.0
    radius_between_std: float = 0.0

    @property
    def multiplier_next_std(self) -> float:
        """Standard deviation of the multiplier on the next drive."""
        return math.hypot(self.multiplier_std, self.multiplier_between_std)

    @property
    def left_radius_next_std(self) -> float:
        """Standard deviation of the left radius factor on the next drive."""
        return math.hypot(self.left_radius_std, self.radius_between_std)

    @property
    def right_radius_next_std(self) -> float:
        """Standard deviation of the right radius factor on the next drive."""
        return math.hypot(self.right_radius_std, self.radius_between_std)


class GeometryDocument(Record, frozen=True, kw_only=True):
    """The ICRs that `controller` belongs to, with one standard deviation each; null where not shown."""

    y_icr_right_m: float | None = None
    y_icr_right_m_std: float | None = None
    y_icr_left_m: float | None = None
    y_icr_left_m_std: float | None = None
    x_icr_m: float | None = None
    x_icr_m_std: float | None = None
    covariance_m2: Matrix


class RecommendedDocument(Record, frozen=True):
    """The motion model fitted for one robot: parameters with covariance, ICRs, and numbers for a controller."""

    label: str
    model: str
    terms: tuple[str, ...]
    parameters: dict[str, ParameterDocument]
    covariance: list[list[float]]
    not_shown: tuple[str, ...]
    geometry: dict[str, float]
    geometry_std: dict[str, float]
    controller: ControllerNumbers


class RunDocument(Record, frozen=True, kw_only=True):
    """run.json.

    Attributes
    ----------
    notes : all findings; the grave ones make `unusable_because`, the others are the sentences of `warnings`
    recommended, geometry, controller : motion model of the robot; only a run that `icrtool.fit` made has them
    partly_because : the numbers of a usable run that are not shown; None where all are shown, and in an unusable run
    """

    schema: Literal["icrtool/run/1"]
    tool_version: str
    log: str
    inputs: tuple[InputFile, ...]
    config: Config
    request: FitRequest
    streams: tuple[StreamChoice, ...]
    notes: tuple[Note, ...]
    warnings: tuple[str, ...]
    alignment: dict[str, AlignmentEstimate]
    drive: DriveDocument
    usable: bool
    unusable_because: str | None
    icr: IcrDocument
    odometry: OdometryDocument
    terrain: TerrainDocument
    segments: tuple[SegmentDocument, ...]
    gnss: GnssDocument
    heading: HeadingDocument
    wheels: WheelFacts
    events: tuple[EventDocument, ...]
    reference_jumps: tuple[ReferenceJumpDocument, ...] = ()
    outages_ns: Spans
    rtk_losses_ns: Spans
    wheel_gaps_ns: Spans
    facts: LogFacts
    filter: FilterDocument
    excitation: ExcitationDocument
    recommended: RecommendedDocument | None = None
    geometry: GeometryDocument | None = None
    controller: ControllerNumbers | None = None
    partly_because: str | None = None

    def __post_init__(self) -> None:
        if self.usable != (self.unusable_because is None):
            raise ValueError("usable and unusable_because contradict each other")

    @property
    def content(self) -> tuple[str, ...]:
        """SHA-256 of each file of the log. Empty if any is not known: copies of the log are then not recognised."""
        return known_content(file.sha256 for file in self.inputs)

    def icr_of_drive(self, column: IcrColumn) -> tuple[float, float] | None:
        """Return an ICR of `geometry` and its standard deviation, None where it is not shown."""
        value, std = (getattr(self.geometry, name, None) for name in (column, f"{column}_std"))
        return None if value is None or std is None else (value, std)
