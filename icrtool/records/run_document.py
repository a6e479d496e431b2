"""The keys of run.json, which the summary of a run has too: their types, checked when a run is opened.

Keys that nothing reads may be added in the same version.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired, TypedDict

import msgspec

from icrtool.records.events import JumpKind, SlipKind
from icrtool.records.samples import Role

Excited = Literal["shown", "weak", "not shown"]
IcrColumn = Literal["y_icr_right_m", "y_icr_left_m", "x_icr_m"]
Spans = list[tuple[int, int]]
Triple = Annotated[list[float], msgspec.Meta(min_length=3, max_length=3)]
Matrix = Annotated[list[Triple], msgspec.Meta(min_length=3, max_length=3)]


class MaybeByIcr(TypedDict):
    """A number of each ICR, null where there is none."""

    y_icr_right_m: float | None
    y_icr_left_m: float | None
    x_icr_m: float | None


class SpansByIcr(TypedDict):
    """Begin and end of each ICR's convergence [s], null where it did not converge."""

    y_icr_right_m: tuple[float, float] | None
    y_icr_left_m: tuple[float, float] | None
    x_icr_m: tuple[float, float] | None


class InputDocument(TypedDict):
    """A file that was read."""

    path: str
    bytes: int
    sha256: str


class StreamDocument(TypedDict):
    """A chosen topic."""

    role: Role
    topic: str
    message_type: str
    count: int
    rate_hz: float | None
    clock: str
    why: str


class DriveDocument(TypedDict):
    """Duration, distance and speed."""

    duration_s: float
    distance_m: float
    speed_mean_mps: float
    speed_std_mps: float


class IcrDocument(TypedDict):
    """The ICRs and how they converged."""

    final: MaybeByIcr
    final_std: MaybeByIcr
    mean: MaybeByIcr
    std: MaybeByIcr
    convergence_s: MaybeByIcr
    convergence_span_s: SpansByIcr
    separation_multiplier: float | None
    separation_multiplier_std: float | None
    final_covariance_m2: Matrix
    x_clock_std_m: NotRequired[float]


class EndErrorDocument(TypedDict):
    """How far from the filter's last position an odometry ends."""

    end_error_m: float


class OdometryDocument(TypedDict):
    """Wheels-only paths."""

    icr: EndErrorDocument
    no_slip: EndErrorDocument | None


class ChangeDocument(TypedDict):
    """A terrain change."""

    t_s: float


class TerrainDocument(TypedDict):
    """Terrain changes at which the ICR covariance was inflated."""

    changes: list[ChangeDocument]


class SegmentDocument(TypedDict):
    """The ICRs between two changes."""

    begin_s: float
    end_s: float
    mean: MaybeByIcr
    std: MaybeByIcr


class EventDocument(TypedDict):
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


EVENT_COLUMNS = tuple(EventDocument.__annotations__)
"""The columns of events.csv; seconds count from the first recorded state."""


class ClassDocument(TypedDict):
    """The fixes of one class."""

    fixes: int
    rejected: int
    down_weighted: int
    sold_as_fixed: int


class ReferenceJumpDocument(TypedDict):
    """A discontinuity of the reference, as `icrtool.records.events.ReferenceJump`."""

    kind: JumpKind
    begin_s: float
    end_s: float
    begin_ns: int
    end_ns: int
    north_m: float
    east_m: float
    size_m: float
    turn_deg: float
    moved_north_m: float
    moved_east_m: float
    why: str
    undecided: bool


class GnssDocument(TypedDict):
    """The position fixes."""

    used: int
    rejected: int
    rejected_by_gate: int
    rejected_by_reason: dict[str, int]
    recoveries: int
    mean_difference_m: float | None
    max_difference_m: float | None
    datum: list[float] | None
    delay_s: float | None
    delay_std_s: float | None
    classes: dict[str, ClassDocument]


class HeadingDocument(TypedDict):
    """The heading.

    `source`: orientation, dual_antenna_message, antenna_pair, gyro_course, wheels_course or fused; `parts`: of an
    estimated one; `std_deg`: its median standard deviation as the filter is given it (null for a stated one).
    """

    source: str
    parts: str | None
    std_deg: float | None
    offset_deg: float | None
    offset_std_deg: float | None
    offset_name: str | None
    applied_offset_deg: float
    delay_s: float | None
    delay_std_s: float | None
    applied_delay_s: float
    used: int
    rejected: int


class WarmStartDocument(TypedDict):
    """What a run began with."""

    icrs_m: Triple
    covariance_m2: Matrix


class IcrStartDocument(TypedDict):
    """ICRs that the filter started from, and their standard deviations."""

    icrs_m: Triple
    std_m: Triple


class FilterDocument(TypedDict):
    """What the filter was run with."""

    process_position_mps: float
    process_heading_degps: float
    reference_delay_s: float
    heading_correlation_s: float
    heading_from_position: bool
    heading_is_estimated: bool
    heading_is_measured: NotRequired[bool]
    turn_wander_rad: NotRequired[float | None]
    antenna_m: tuple[float, float]
    warm_start: WarmStartDocument | None
    icr_start: IcrStartDocument | None
    nis_gnss_mean: float | None
    nis_heading_mean: float | None
    antenna_is_known: NotRequired[bool]


class VerdictsByIcr(TypedDict):
    """Whether each ICR was shown."""

    y_icr_right_m: Excited
    y_icr_left_m: Excited
    x_icr_m: Excited


class ExcitationDocument(TypedDict):
    """What the drive could show of the ICRs."""

    verdict: VerdictsByIcr
    turned_right_deg: float
    turned_left_deg: float
    spun_right_deg: float
    spun_left_deg: float
    sentences: list[str]


class FindingDocument(TypedDict):
    """An estimate of the alignment."""

    value: float | None
    std: float | None
    applied: float
    why: str


class ParameterDocument(TypedDict):
    """A parameter of a motion model."""

    value: float
    std: float


class ControllerDocument(TypedDict):
    """What a controller is given: its multiplier and the wheels' radii as factors of the configured one."""

    multiplier: float
    multiplier_std: float
    left_radius: float
    right_radius: float
    left_radius_std: NotRequired[float]
    right_radius_std: NotRequired[float]


class GeometryDocument(TypedDict):
    """The ICRs that `controller` belongs to, with one standard deviation each; null where not shown."""

    y_icr_right_m: float | None
    y_icr_right_m_std: float | None
    y_icr_left_m: float | None
    y_icr_left_m_std: float | None
    x_icr_m: float | None
    x_icr_m_std: float | None
    covariance_m2: Matrix


class RecommendedDocument(TypedDict):
    """The motion model."""

    label: str
    model: str
    parameters: dict[str, ParameterDocument]
    controller: ControllerDocument


class MotionDocument(TypedDict):
    """What a run holds of the robot's motion, beside its filter."""

    recommended: RecommendedDocument | None
    geometry: GeometryDocument | None
    controller: ControllerDocument | None


class RunDocument(TypedDict):
    """run.json; `recommended`, `geometry`, `controller`: of a run that `icrtool.fit` made."""

    schema: Literal["icrtool/run/1"]
    log: str
    tool_version: str
    inputs: list[InputDocument]
    config: dict[str, Any]
    streams: list[StreamDocument]
    warnings: list[str]
    alignment: dict[str, FindingDocument]
    usable: bool
    unusable_because: str | None
    drive: DriveDocument
    icr: IcrDocument
    odometry: OdometryDocument
    terrain: TerrainDocument
    segments: list[SegmentDocument]
    gnss: GnssDocument
    heading: HeadingDocument
    wheels: dict[str, Any]
    events: list[EventDocument]
    reference_jumps: list[ReferenceJumpDocument]
    outages_ns: Spans
    rtk_losses_ns: Spans
    wheel_gaps_ns: Spans
    filter: FilterDocument
    excitation: ExcitationDocument
    recommended: NotRequired[RecommendedDocument | None]
    geometry: NotRequired[GeometryDocument | None]
    controller: NotRequired[ControllerDocument | None]
