"""The measurements of a log after alignment: streams as the filter uses them, slip events, jumps, and the findings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from icrtool.kernels.arrays import ROWS_AT_ONCE, Bools, Bytes, Floats, Ints, in_spans, runs_of
from icrtool.records.notes import Note
from icrtool.records.plain_data import Record
from icrtool.records.samples import GyroSamples, HeadingSamples, HeadingSensor, Samples, StreamChoice, WheelSamples

RESPONSE_S = 0.1
"""Longest lag of the body's motion behind the wheel speeds [s]. Source: rigid-body simulations."""

MOVING_S, TURNING_MPS = 60.0, 0.01
"""A robot counts as moving for `MOVING_S` [s] before and after its wheels turn faster than `TURNING_MPS` [m/s]."""

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Finding:
    """One estimate of the alignment, and what was done with it.

    Attributes
    ----------
    value, std : the estimate and its standard deviation, None where the drive does not show it; unit in its name
    applied : the correction that the measurements hold
    why : why it was applied or not
    """

    value: float | None
    std: float | None
    applied: float
    why: str


@dataclass(frozen=True, slots=True)
class Fixes(Samples):
    """Positions of the antenna as the filter uses them.

    Attributes
    ----------
    stamp_ns : int64 (m,), non-decreasing, of the wheels' clock
    north_m, east_m : float64 (m,)
    var_north_m2, var_east_m2 : float64 (m,), finite
    fix_class : uint8 (m,), keys of `icrtool.alignment.gnss_quality.CLASSES`
    misreported : bool (m,), reported as RTK-fixed, but not a fixed solution
    down_weighted : bool (m,), given a larger variance for their class
    """

    stamp_ns: Ints
    north_m: Floats
    east_m: Floats
    var_north_m2: Floats
    var_east_m2: Floats
    fix_class: Bytes
    misreported: Bools
    down_weighted: Bools


class IcrStart(Record, frozen=True):
    """ICRs to start the filter from, right, left, x, and their standard deviations (3,) [m]."""

    icrs_m: Triple
    std_m: Triple


class LogFacts(Record, frozen=True, kw_only=True):
    """What is known of a log in addition to its streams; ``facts`` of run.json.

    Attributes
    ----------
    heading_from_position : heading and position are fields of the same messages: they have the same delay
    heading_correlation_s : the errors of headings closer together than this are correlated
    heading_is_estimated : the headings are estimated with the positions, and do not exist without positions
    heading_is_measured : the variance of the headings is the measured variance of a reference's poses
    turn_wander_rad : how far the heading wanders from the turn of the wheels in a second (rms), noise included; None:
        not known
    antenna_m : the antenna from the body origin, forward and right
    antenna_is_known : its place was configured, or in the log
    clock_std_s : standard deviation of the time between position and heading, after the correction of delays
    heading_sensor : topic of the log that states a heading, also where it is fused with others; None without one
    """

    heading_from_position: bool
    heading_correlation_s: float
    heading_is_estimated: bool = False
    heading_is_measured: bool = False
    turn_wander_rad: float | None = None
    antenna_m: tuple[float, float]
    antenna_is_known: bool = False
    clock_std_s: float = 0.0
    heading_sensor: HeadingSensor | None = None

    @property
    def headings_are_precise(self) -> bool:
        """Whether the variance of a heading is its own noise, and not the variance of a lasting error."""
        return self.heading_is_estimated or self.heading_is_measured


@dataclass(frozen=True, slots=True)
class SensorData:
    """The streams of one log as the filter uses them: everything that the filter needs of the log.

    Attributes
    ----------
    name : of the log
    headings : clockwise from north, offset corrected; every variance finite
    gyro : turn rates, not used by the filter; None without a gyro
    facts : everything that is no column and no span of time
    losses_ns : half-open spans in which RTK was lost, (k, 2)
    events : slip events, in order of time
    jumps : of the reference, likewise
    attitude : an attitude sensor's heading, its offset corrected, where `headings` are estimated with it; else None
    """

    name: str
    wheels: WheelSamples
    fixes: Fixes
    headings: HeadingSamples
    gyro: GyroSamples | None
    facts: LogFacts
    losses_ns: Ints
    events: tuple[SlipEvent, ...] = ()
    jumps: tuple[ReferenceJump, ...] = ()
    attitude: HeadingSamples | None = None

    def moving(self) -> tuple[Bools, Bools]:
        """Return at which fixes (m,) and headings (h,) the wheels turn within `MOVING_S`; all where they never turn.

        Measurements of a standing robot show neither delays nor contradictions, however long it stands.
        """
        stamps = self.wheels.stamp_ns
        turning = np.empty(len(stamps), np.bool_)
        for lo in range(0, len(stamps), ROWS_AT_ONCE):
            left, right = (one[lo : lo + ROWS_AT_ONCE] for one in (self.wheels.v_left_mps, self.wheels.v_right_mps))
            turning[lo : lo + len(left)] = np.abs(left) + np.abs(right) > 2.0 * TURNING_MPS
        near = 0
        if len(stamps) > 1:
            near = max(round(MOVING_S * 1e9), 2 * int(np.median(np.diff(stamps), overwrite_input=True)))
        begin, behind = runs_of(turning)
        # the last value holds until the next one
        spans = stamps[begin] - near, stamps[np.minimum(behind, len(stamps) - 1)] + near

        def of(stamp_ns: Ints) -> Bools:
            moving = in_spans(stamp_ns, *spans)
            return moving if moving.any() else np.ones(len(stamp_ns), np.bool_)

        return of(self.fixes.stamp_ns), of(self.headings.stamp_ns)

    def part(self, rows: slice) -> SensorData:
        """Return the part of some wheel samples, with the fixes and headings of that time."""
        wheels = self.wheels.cut(rows)
        span = wheels.stamp_ns[[0, -1]]
        fixes = slice(*np.searchsorted(self.fixes.stamp_ns, span))
        samples = slice(*np.searchsorted(self.headings.stamp_ns, span))
        return replace(self, wheels=wheels, fixes=self.fixes.cut(fixes), headings=self.headings.cut(samples))


@dataclass(frozen=True, slots=True)
class FixStatistics:
    """Statistics of the position fixes of a log.

    Attributes
    ----------
    std_m : by class name, median standard deviation stated or measured [m], NaN where none is known
    step_std_m : by class name, white noise from step to step [m]; NaN where too few steps show it
    """

    std_m: dict[str, float]
    step_std_m: dict[str, float]


class GroundStretch(Record, frozen=True, kw_only=True):
    """A stretch of a drive on one ground.

    Attributes
    ----------
    begin_s, end_s : since the first wheel sample [s]
    multiplier, multiplier_std : turn of the wheels per turn of the robot, and its standard deviation
    """

    begin_s: float
    end_s: float
    multiplier: float
    multiplier_std: float


class WheelFacts(Record, frozen=True, kw_only=True):
    """What is known of the wheels, and what was done with it; as ``wheels`` in run.json.

    Attributes
    ----------
    scale, scale_std : distance by the position reference per distance by the wheels; None where not shown
    applied_scale : mean of what both sides were multiplied with
    applied_left_scale, applied_right_scale : what each was multiplied with, configured scales included
    held_share : share of samples, while moving, that repeat the one before
    filtered : in words, how the wheels show that a filter made them; None where they do not
    windows, stretches : windows in which wheels and positions were compared, and how many count as independent
    residual_m : robust standard deviation of their displacements; None without windows
    turn_unexplained, turn_unexplained_std : share of the variance of the robot's turns over a second that the wheels do
        not explain, 1 - R^2, and its standard deviation; None without windows
    ground_change_s : when the ground first changes, since the first wheel sample; None where it does not
    ground_stretches : the stretches between changes of ground; none where it does not change
    """

    scale: float | None
    scale_std: float | None
    applied_scale: float
    applied_left_scale: float
    applied_right_scale: float
    held_share: float | None
    filtered: str | None
    windows: int
    stretches: int
    residual_m: float | None
    turn_unexplained: float | None = None
    turn_unexplained_std: float | None = None
    ground_change_s: float | None = None
    ground_stretches: tuple[GroundStretch, ...] = ()


class HeadingFacts(Record, frozen=True, kw_only=True):
    """What is known of the heading, and what is done with it; in ``heading`` of run.json.

    Attributes
    ----------
    source : orientation, dual_antenna_message, antenna_pair, gyro_course, wheels_course or fused
    parts : the sensors of an estimated heading, in words; None for a stated heading
    windows : stretches of distance compared
    applied_mirror : the sense of the heading is reversed
    offset_deg, offset_std_deg : heading minus course over ground; None when there was nothing to compare
    scatter_deg : robust standard deviation of the differences
    applied_offset_deg : what is subtracted; applied_std_deg : the least noise that the filter uses
    std_deg : median standard deviation of an estimated heading, as the filter uses it; None for a stated heading
    offset_name : what a significant offset may come from
    agreement, mirrored_agreement : mean resultant length of heading minus course over ground, in either sense
    """

    source: str
    parts: str | None
    windows: int
    applied_mirror: bool
    offset_deg: float | None
    offset_std_deg: float | None
    scatter_deg: float | None
    applied_offset_deg: float
    applied_std_deg: float
    std_deg: float | None
    offset_name: str | None
    magnetic_declination_deg: float | None
    utm_convergence_deg: float | None
    agreement: float | None
    mirrored_agreement: float | None


@dataclass(frozen=True, slots=True)
class Measurements:
    """The aligned sensors of one log, and what the alignment found.

    Attributes
    ----------
    findings : estimates by name with unit; run.json has them as ``alignment``
    streams : the log's chosen topics; ``why`` also names the unit of the wheels
    wheels, heading : what is known of them, for run.json
    notes : findings, in the order they were made
    """

    sensors: SensorData
    findings: dict[str, Finding]
    wheels: WheelFacts
    heading: HeadingFacts
    streams: tuple[StreamChoice, ...]
    fix_statistics: FixStatistics
    notes: tuple[Note, ...]


@dataclass(frozen=True, slots=True)
class MeasuredHeading:
    """Heading by a sensor of the robot, at the states of a run.

    Attributes
    ----------
    kind : ``heading``: an attitude, its direction is taken as measured; ``gyro``: an integrated turn rate, which starts
        from the reference heading and is given scale and bias by the distance outside the block
    angle_rad : (n,), clockwise, unwrapped
    """

    kind: Literal["heading", "gyro"]
    angle_rad: Floats


SlipKind = Literal["immobilised", "slip", "skid", "spin"]
"""Wheels turn and the robot stands; it moves less than its wheels; it moves sideways; it turns less than expected."""


class SlipEvent(Record, frozen=True):
    """One span in which the robot did not do what its wheels did.

    Attributes
    ----------
    begin_ns, end_ns : stamps of the wheel clock
    north_m, east_m : position at the begin, in the local plane
    distance_m : length of the robot's path through the event, by the position reference
    severity : share of the wheels' motion that the robot did not make, 0 to 1
    confidence : probability that model error and sensor noise alone make no such event in the log
    """

    kind: SlipKind
    begin_ns: int
    end_ns: int
    north_m: float
    east_m: float
    distance_m: float
    severity: float
    confidence: float


JumpKind = Literal["position", "heading"]
"""What jumps: the position, alone or with the heading, or the heading alone."""


class ReferenceJump(Record, frozen=True):
    """One discontinuity of the reference: it moves as no robot can, or as its own messages explain.

    Attributes
    ----------
    begin_ns, end_ns : stamps of the wheel clock, from the last pose before to the first after that the filter followed
    north_m, east_m : position before it, in the local plane
    size_m : largest step of the position within it, beyond the motion of the wheels
    turn_deg : likewise of the heading, clockwise; 0 where the heading is not stated with the position
    moved_north_m, moved_east_m : sum of its steps [m]
    why : what shows it
    undecided : it may be the robot's own motion: its trials count
    """

    kind: JumpKind
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


def intervals_in(stamps_ns: Ints, spans_ns: Iterable[tuple[int, int]]) -> Bools:
    """Return which intervals [k, k + 1) between stamps (n,) share time with a span; the last is none."""
    inside, ends = np.zeros(len(stamps_ns), np.bool_), np.append(stamps_ns[1:], stamps_ns[-1:])
    for begin, end in spans_ns:
        inside[np.searchsorted(ends, begin, side="right") : np.searchsorted(stamps_ns, end)] = True
    inside[-1:] = False
    return inside
