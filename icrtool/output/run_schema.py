"""What run.json must hold to be a run: checked when a run is opened, so that nothing later meets a missing key.

Keys of the same version that only inform (in ``gnss``, ``wheels``, ``filter`` …) may be missing or added.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypedDict

import msgspec

Spans = list[tuple[int, int]]
Triple = Annotated[list[float], msgspec.Meta(min_length=3, max_length=3)]
Matrix = Annotated[list[Triple], msgspec.Meta(min_length=3, max_length=3)]


class ByIcr(TypedDict):
    """A number of each ICR [m]."""

    y_icr_right_m: float
    y_icr_left_m: float
    x_icr_m: float


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

    role: str
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

    final: ByIcr
    final_std: ByIcr
    mean: ByIcr
    std: ByIcr
    convergence_s: MaybeByIcr
    convergence_span_s: SpansByIcr
    separation_multiplier: float | None
    final_covariance_m2: Matrix


class EndErrorDocument(TypedDict):
    """How far from the filter's last position an odometry ends."""

    end_error_m: float


class OdometryDocument(TypedDict):
    """Wheels-only paths."""

    icr: EndErrorDocument
    no_slip: EndErrorDocument | None


class ChangeDocument(TypedDict):
    """A change of the ICRs."""

    t_s: float
    source: str
    statistic: float | None


class TerrainDocument(TypedDict):
    """Changes of the ICRs, given and found."""

    searched: bool
    threshold: float | None
    driven_h: float
    changes: list[ChangeDocument]


class SegmentDocument(TypedDict):
    """The ICRs between two changes."""

    begin_s: float
    mean: MaybeByIcr
    std: MaybeByIcr


class EventDocument(TypedDict):
    """A slip event."""

    kind: Literal["immobilised", "slip", "skid", "spin"]
    begin_s: float
    end_s: float
    begin_ns: int
    end_ns: int
    north_m: float
    east_m: float
    distance_m: float
    severity: float
    confidence: float


class ClassDocument(TypedDict):
    """The fixes of one class."""

    fixes: int
    rejected: int
    down_weighted: int
    sold_as_fixed: int


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
    jumps: int


class HeadingDocument(TypedDict):
    """The heading."""

    offset_deg: float | None
    offset_std_deg: float | None
    offset_name: str | None
    applied_offset_deg: float
    delay_s: float | None
    delay_std_s: float | None
    applied_delay_s: float


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
    reference_delay_s: float
    heading_correlation_s: float
    heading_from_position: bool
    antenna_m: tuple[float, float]
    warm_start: WarmStartDocument | None
    icr_start: IcrStartDocument | None


class VerdictsByIcr(TypedDict):
    """Whether each ICR was shown."""

    y_icr_right_m: Literal["shown", "weak", "not shown"]
    y_icr_left_m: Literal["shown", "weak", "not shown"]
    x_icr_m: Literal["shown", "weak", "not shown"]


class ExcitationDocument(TypedDict):
    """What the drive could show of the ICRs."""

    verdict: VerdictsByIcr
    turned_right_deg: float
    turned_left_deg: float
    spun_right_deg: float
    spun_left_deg: float


class RunDocument(TypedDict):
    """run.json."""

    log: str
    tool_version: str
    inputs: list[InputDocument]
    config: dict[str, Any]
    streams: list[StreamDocument]
    warnings: list[str]
    drive: DriveDocument
    icr: IcrDocument
    odometry: OdometryDocument
    terrain: TerrainDocument
    segments: list[SegmentDocument]
    gnss: GnssDocument
    heading: HeadingDocument
    events: list[EventDocument]
    outages_ns: Spans
    rtk_losses_ns: Spans
    wheel_gaps_ns: Spans
    filter: FilterDocument
    excitation: ExcitationDocument


TOGETHER = (
    ("gnss", "mean_difference_m", "max_difference_m"),
    ("gnss", "delay_s", "delay_std_s"),
    ("heading", "delay_s", "delay_std_s"),
    ("heading", "offset_deg", "offset_std_deg"),
)
"""Section, and two keys of it that are both known or both null."""


def check_run_document(document: dict[str, Any]) -> None:
    """Refuse plain data that is no run.

    Raises
    ------
    ValueError
        A key is missing, of another type, or null without its companion; its path is named.
    """
    try:
        msgspec.convert(document, RunDocument)
    except msgspec.ValidationError as err:
        raise ValueError(str(err)) from err
    for section, one, other in TOGETHER:
        if (document[section][one] is None) != (document[section][other] is None):
            raise ValueError(f"only one of {one} and {other} is known - at `$.{section}`")
