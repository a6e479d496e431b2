"""The measurements of a log after alignment: streams as the filter uses them, slip events, jumps, and the estimates."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from icrtool.kernels.arrays import ROWS_AT_ONCE, Bools, Bytes, Floats, Ints, in_spans, runs_of
from icrtool.records.notes import Note
from icrtool.records.plain_data import Record
from icrtool.records.samples import GyroSamples, HeadingSamples, HeadingSensor, Samples, StreamChoice, WheelSamples

LONGEST_RESPONSE_S = 0.1
"""Longest lag of the body's motion behind the wheel speeds [s]. Source: rigid-body simulations."""

CAUTIOUS_RESPONSE_STD_S = LONGEST_RESPONSE_S
"""Standard deviation of the lag in tests of slip and in the noise of the heading [s]. It equals the longest lag, so a
lag alone shows no slip. Where the lag itself is estimated, `icrtool.alignment.estimator.RESPONSE_STD_S` applies."""

MOVING_S, TURNING_MPS = 60.0, 0.01
"""A robot counts as moving for `MOVING_S` [s] before and after its wheels turn faster than `TURNING_MPS` [m/s]."""

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class AlignmentEstimate:
    """One estimate of the alignment, and the correction that was made with it.

    Attributes
    ----------
    value, std : the estimate and its standard deviation; None where the drive does not show them. The name of the
        estimate ends with the unit
    applied : the correction that was made to the measurements, in the same unit
    why : why the correction was made, or why not
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
    stamp_ns : int64 (m,) stamps of the wheel clock, non-decreasing [ns]
    north_m, east_m : float64 (m,) position in the local plane [m]
    var_north_m2, var_east_m2 : float64 (m,) variances, finite [m^2]
    fix_class : uint8 (m,) classes, keys of `icrtool.alignment.gnss_quality.CLASSES`
    misreported : bool (m,) mask of the fixes that are reported as RTK-fixed, but are no fixed solutions
    down_weighted : bool (m,) mask of the fixes with a larger variance because of their class
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
    """Initial ICRs of the filter (3,), right, left, x, and their standard deviations (3,) [m]."""

    icrs_m: Triple
    std_m: Triple


class LogFacts(Record, frozen=True, kw_only=True):
    """Facts of a log in addition to its streams; ``facts`` of run.json.

    Attributes
    ----------
    heading_from_position : heading and position are fields of the same messages: they have the same delay
    heading_correlation_s : correlation time of the errors of headings [s]
    heading_is_estimated : the headings are estimated with the positions, and do not exist without positions
    heading_is_measured : the variance of the headings is the measured variance of a reference's poses
    turn_wander_rad : rms difference between the turns of heading and wheels over 1 s [rad], noise included; None: not
        known
    antenna_m : position of the antenna from the body origin, forward and right [m]
    antenna_is_known : the position of the antenna was configured, or is in the log
    clock_std_s : standard deviation of the time between position and heading, after the correction of delays [s]
    heading_common_std_rad : standard deviation of the error that all estimated headings share [rad]; 0: not estimated
    heading_sensor : topic of the log that states a heading, even where it is fused with others; None without one
    """

    heading_from_position: bool
    heading_correlation_s: float
    heading_is_estimated: bool = False
    heading_is_measured: bool = False
    turn_wander_rad: float | None = None
    antenna_m: tuple[float, float]
    antenna_is_known: bool = False
    clock_std_s: float = 0.0
    heading_common_std_rad: float = 0.0
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
    name : name of the log
    wheels : speeds of the sides [m/s]
    fixes : positions of the antenna
    headings : headings clockwise from north with corrected offset; every variance is finite
    gyro : turn rates, not used by the filter; None without a gyro
    facts : facts of the log that are no column and no span of time
    losses_ns : (k, 2) half-open spans in which RTK was lost [ns]
    events : slip events, in order of time
    jumps : jumps of the reference, in order of time
    attitude : heading of an attitude sensor after correction of its offset, where `headings` are estimated with this
        sensor; else None
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
        """Return at which fixes (m,) and headings (h,) the wheels turn within `MOVING_S`; all True if they never turn.

        Measurements of a standing robot show neither delays nor contradictions, so they are left out.
        """
        stamps = self.wheels.stamp_ns
        turning = np.empty(len(stamps), np.bool_)
        for lo in range(0, len(stamps), ROWS_AT_ONCE):
            left, right = (
                speeds[lo : lo + ROWS_AT_ONCE] for speeds in (self.wheels.v_left_mps, self.wheels.v_right_mps)
            )
            turning[lo : lo + len(left)] = np.abs(left) + np.abs(right) > 2.0 * TURNING_MPS
        near = 0
        if len(stamps) > 1:
            near = max(round(MOVING_S * 1e9), 2 * int(np.median(np.diff(stamps), overwrite_input=True)))
        begin, behind = runs_of(turning)
        # A wheel speed holds until the next sample.
        spans = stamps[begin] - near, stamps[np.minimum(behind, len(stamps) - 1)] + near

        def is_moving(stamp_ns: Ints) -> Bools:
            moving = in_spans(stamp_ns, *spans)
            return moving if moving.any() else np.ones(len(stamp_ns), np.bool_)

        return is_moving(self.fixes.stamp_ns), is_moving(self.headings.stamp_ns)

    def part(self, rows: slice) -> SensorData:
        """Return the sensor data of some wheel samples, with the fixes and headings of the same time."""
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
    std_m : median standard deviation, stated or measured, by class name [m]; NaN where it is not known
    step_std_m : standard deviation of the white noise from step to step, by class name [m]; NaN with too few steps
    """

    std_m: dict[str, float]
    step_std_m: dict[str, float]


class GroundStretch(Record, frozen=True, kw_only=True):
    """A stretch of a drive on one ground.

    Attributes
    ----------
    begin_s, end_s : start and end of the stretch since the first wheel sample [s]
    multiplier, multiplier_std : turn of the wheels per turn of the robot, and its standard deviation
    """

    begin_s: float
    end_s: float
    multiplier: float
    multiplier_std: float


class WheelFacts(Record, frozen=True, kw_only=True):
    """Facts of the wheels, and the corrections that were made; ``wheels`` of run.json.

    Attributes
    ----------
    scale, scale_std : distance by the position reference over distance by the wheels, and its standard deviation; None
        where the drive does not show it
    applied_scale : mean of the factors that were applied to both sides
    applied_left_scale, applied_right_scale : factor that was applied to each side, configured scales included
    held_share : share of the samples of a moving robot that repeat the sample before
    filtered : in words, what shows that the wheel speeds are the output of a filter; None where nothing shows it
    windows, stretches : number of windows in which wheels and positions were compared, and number of independent ones
    residual_m : robust standard deviation of the residual displacements of the windows [m]; None without windows
    turn_unexplained, turn_unexplained_std : share of the variance of the robot's turns over a second that the wheels do
        not explain, 1 - R^2, and its standard deviation; None without windows
    ground_change_s : time of the first change of ground since the first wheel sample [s]; None without a change
    ground_stretches : the stretches between changes of ground; empty without a change
    exchanged_s : time since the first wheel sample from which on, or until which, the sides are exchanged [s]; None if
        they never are
    clock_rate, clock_rate_std : rate of the wheels' clock against that of the headings, minus 1, and its standard
        deviation; None where they do not differ
    limit_mps : largest speed of the wheels, which they hold although the robot goes faster, with corrected scales
        [m/s]; None without such a limit
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
    exchanged_s: float | None = None
    clock_rate: float | None = None
    clock_rate_std: float | None = None
    limit_mps: float | None = None


class HeadingFacts(Record, frozen=True, kw_only=True):
    """Facts of the heading, and the corrections that were made; in ``heading`` of run.json.

    Attributes
    ----------
    source : orientation, dual_antenna_message, antenna_pair, gyro_course, wheels_course or fused
    parts : the sensors of an estimated heading, in words; None for a stated heading
    windows : number of stretches of distance in which the heading was compared with the course over ground
    applied_mirror : the sense of the heading was reversed
    offset_deg, offset_std_deg : heading minus course over ground, and its standard deviation [deg]; None where no
        window could be compared
    scatter_deg : robust standard deviation of the differences [deg]
    applied_offset_deg : offset that was subtracted from the heading [deg]
    applied_std_deg : smallest standard deviation of the heading that the filter uses [deg]
    std_deg : median standard deviation of an estimated heading, as the filter uses it [deg]; None for a stated heading
    offset_name : possible cause of a significant offset
    magnetic_declination_deg : magnetic declination at the log's place and date, east positive [deg]; None if unknown
    utm_convergence_deg : UTM grid convergence at the log's place, clockwise [deg]; None if unknown
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
    """The aligned sensors of one log, with the estimates and findings of the alignment.

    Attributes
    ----------
    sensors : the aligned sensors
    estimates : estimates by name with unit; run.json has them as ``alignment``
    streams : the log's chosen topics; ``why`` also names the unit of the wheels
    wheels, heading : facts of wheels and heading, for run.json
    fix_statistics : statistics of the position fixes
    notes : findings, in the order they were made
    """

    sensors: SensorData
    estimates: dict[str, AlignmentEstimate]
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
    kind : ``heading``: the heading of an attitude sensor, used as measured. ``gyro``: an integrated turn rate, which
        starts from the reference heading; its scale and bias are estimated outside the tested block
    angle_rad : (n,) heading, clockwise, unwrapped [rad]
    """

    kind: Literal["heading", "gyro"]
    angle_rad: Floats


SlipKind = Literal["immobilised", "slip", "skid", "spin"]
"""Kinds of slip events. ``immobilised``: the wheels turn and the robot stands; ``slip``: the robot moves less than its
wheels; ``skid``: it moves sideways; ``spin``: it turns less than expected."""


class SlipEvent(Record, frozen=True):
    """One span of time in which the motion of the robot differs from the motion of its wheels.

    Attributes
    ----------
    kind : kind of the event, see `SlipKind`
    begin_ns, end_ns : stamps of the wheel clock [ns]
    north_m, east_m : position at the start, in the local plane [m]
    distance_m : length of the robot's path through the event, by the position reference [m]
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
"""Kinds of jumps. ``position``: the position jumps, alone or with the heading; ``heading``: the heading jumps alone."""


class ReferenceJump(Record, frozen=True):
    """One discontinuity of the reference: a motion that no robot can make, or that the reference's messages explain.

    Attributes
    ----------
    kind : kind of the jump, see `JumpKind`
    begin_ns, end_ns : stamps of the wheel clock [ns]: of the last pose that the filter followed before the jump, and of
        the first pose that it followed after the jump
    north_m, east_m : position before the jump, in the local plane [m]
    size_m : largest step of the position during the jump, beyond the motion of the wheels [m]
    turn_deg : largest step of the heading beyond the turn of the wheels, clockwise [deg]; 0 where the heading is not
        stated with the position
    moved_north_m, moved_east_m : sum of the steps of the position [m]
    why : what shows the jump
    undecided : the jump may be motion of the robot, so trials that cross the jump count
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
    """Return whether each interval [k, k + 1) between stamps shares time with a span (n,); the last value is False."""
    inside, ends = np.zeros(len(stamps_ns), np.bool_), np.append(stamps_ns[1:], stamps_ns[-1:])
    for begin, end in spans_ns:
        inside[np.searchsorted(ends, begin, side="right") : np.searchsorted(stamps_ns, end)] = True
    inside[-1:] = False
    return inside
