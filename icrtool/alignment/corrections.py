"""Align the streams of a log: conventions, wheel scale, heading offset, delays, from one estimate.

What is significant and large enough to matter is corrected and reported with its standard deviation; the rest is
reported. Preset ``paper`` corrects nothing.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from icrtool.alignment.conventions import (
    AS_NAMED,
    Convention,
    Decision,
    apply_to_drive,
    convention_notes,
    decide_conventions,
    gyro_sense,
    senses_by_distance,
)
from icrtool.alignment.drive_windows import DriveArrays, DriveWindows, cut_windows, drive_arrays
from icrtool.alignment.estimator import AlignmentFit, Geometry, estimate_alignment
from icrtool.alignment.gnss_steps import FixSteps, measure_steps
from icrtool.alignment.heading_alignment import (
    FEWEST_WINDOWS,
    OPPOSITE_SENSE,
    HeadingAlignment,
    align_estimated_heading,
    align_heading,
    compare_with_course,
    refuse_stuck,
    refuse_unexplained,
)
from icrtool.alignment.heading_choice import DerivedHeading, as_turn_rate, derive_heading, fuse_heading, stated_source
from icrtool.alignment.stream_checks import check_streams
from icrtool.alignment.stream_delays import StreamDelays, find_delays
from icrtool.alignment.wheel_alignment import (
    WheelAlignment,
    configured_scales,
    dead_or_copied,
    find_scales,
    fused_note,
    held_note,
    held_share,
    refuse_standing,
    scaled,
)
from icrtool.alignment.wheel_units import refuse_parked
from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.records.run import half_width_m
from icrtool.records.tables import RobotLog

FAR_IN_POSITION_STD, SHORT_DRIVE_M = 30.0, 0.3
"""A drive of so many standard deviations of the fixes, at least of this each, is no short one."""


class AlignedStreams(NamedTuple):
    """A log whose streams fit together, and what was done for that.

    Attributes
    ----------
    log : corrected; the heading's offset and handedness stand in `heading`, which the filter applies
    drive : what the estimate was made of; fit : the estimate, None where the drive is too short
    derived : the heading where it was estimated, else None
    """

    log: RobotLog
    wheels: WheelAlignment
    heading: HeadingAlignment
    delays: StreamDelays
    drive: DriveArrays
    fit: AlignmentFit | None
    derived: DerivedHeading | None
    warnings: tuple[str, ...]

    @property
    def geometry(self) -> Geometry | None:
        """ICRs with covariance, from the same estimate; None without one."""
        return None if self.fit is None else self.fit.geometry()

    @property
    def fix_steps(self) -> FixSteps:
        """Steps between the fixes beyond the motion of the wheels."""
        expected = self.drive.laid_until_fixes() if self.fit is None else self.fit.expected_motion()[0]
        return measure_steps(self.drive.fix_t, self.drive.fix, expected)

    @property
    def as_named(self) -> RobotLog:
        """The log with sides, handedness and scale corrected, offset and delays not."""
        return _turned_over(self.wheels.log) if self.heading.applied_mirror else self.wheels.log


def align_streams(log: RobotLog, config: Config) -> AlignedStreams:  # noqa: PLR0915 - the order of the steps, in one place
    """Estimate what relates wheels, heading and positions, and correct what is significant.

    Raises
    ------
    DataError
        Streams that cannot be used together, a heading that nothing explains, wheels that turn while the robot stands.
    """
    corrects, width = config.filter.preset == "field", 2.0 * half_width_m(config.robot.track_width_m)
    as_sent, derived, senses = log, None, AS_NAMED
    configured = configured_scales(config)
    log = scaled(log, *configured)
    if not len(log.heading.stamp_ns) and corrects:
        senses = _senses_without_heading(log)
        derived = _derived_heading(_apply(log, senses), width)
        log = derived.apply(_apply(log, senses))
    check_streams(log)
    notes = list(dead_or_copied(log))
    sound = not notes
    notes += convention_notes(Decision(senses, 0.0, None), corrects=True)
    drive = drive_arrays(log, None if derived is None else derived.smoothed)
    windows = cut_windows(drive)
    decision = _decide(log, config, drive, windows, derived)
    if corrects:
        log = _apply(log, decision.convention)
    drive = apply_to_drive(drive, decision.convention)
    notes += convention_notes(decision, corrects=corrects)
    mirrored = decision.convention.heading < 0
    pose_mirrored = mirrored and decision.convention.position < 0 and drive.same_clock
    if derived is None and config.frames.heading != "auto":
        free_hand = decide_conventions(drive, windows, metric=False)
        if free_hand.convention.heading < 0:
            notes.append(f"{OPPOSITE_SENSE}: set frames.heading to the other of enu and ned")
    refuse_standing(log, drive, windows)
    course = compare_with_course(drive, windows)
    free = config.frames.heading_offset_deg == "auto" and corrects
    fit = estimate_alignment(drive, windows, width)
    if free and derived is None:
        refuse_stuck(log)
        scatter = fit.heading_scatter if fit is not None and config.frames.heading == "auto" else 0.0
        if (bare := as_turn_rate(as_sent, scatter, width)) is not None:
            return align_streams(bare, config)
        refuse_unexplained(log, course)
    if derived is None:
        heading = align_heading(
            log, config, fit, course, stated_source(log), mirrored=mirrored, pose_mirrored=pose_mirrored
        )
        if free and config.frames.heading == "auto":
            derived = fuse_heading(log, drive, mirrored=mirrored)
        if derived is not None:
            log = derived.apply(log)
            drive = drive_arrays(log, derived.smoothed)
            fit = estimate_alignment(drive, cut_windows(drive), width)
            heading = align_estimated_heading(log, derived, heading)
    else:
        heading = align_estimated_heading(log, derived, None)
    applied, scale_notes = find_scales(fit, config, sound=sound, corrects=corrects)
    notes += scale_notes
    log = scaled(log, *applied)
    share = held_share(log.wheels)
    notes += held_note(log.wheels, share) + fused_note(log)
    a, a_std = (math.nan, math.nan) if fit is None else fit.estimate("scale")
    if decision.convention.swapped and corrects:
        configured = configured[::-1]
    wheels = WheelAlignment(
        log, a, a_std, applied, (abs(configured[0]), abs(configured[1])), share,
        tuple(f"{log.name}: {note}" for note in notes),
    )  # fmt: skip
    delays = find_delays(log, config, fit)
    return AlignedStreams(
        delays.log, wheels, heading, delays, drive, fit, derived,
        (*wheels.warnings, *heading.warnings, *delays.warnings),
    )  # fmt: skip


def _senses_without_heading(log: RobotLog) -> Convention:
    few = min(len(log.wheels.stamp_ns), len(log.gnss.stamp_ns)) < 2
    return AS_NAMED if few else senses_by_distance(drive_arrays(log))


def _derived_heading(log: RobotLog, width_m: float) -> DerivedHeading:
    """Return the heading of a log without one; a robot that stands is refused as such."""
    try:
        return derive_heading(log, width_m)
    except DataError as error:
        refuse_parked(log)
        if min(len(log.wheels.stamp_ns), len(log.gnss.stamp_ns)) < FEWEST_WINDOWS:
            raise
        drive = drive_arrays(log)
        if drive.travel[-1] < FAR_IN_POSITION_STD * max(drive.fix_std_m, SHORT_DRIVE_M):
            raise
        raise DataError(
            log.name,
            f"no heading in it, and positions of ±{drive.fix_std_m:.1f} m show none over so short a drive "
            f"({drive.travel[-1]:.0f} m)",
            "record an orientation (AHRS), use RTK, or drive several times as far",
        ) from error


def _decide(
    log: RobotLog, config: Config, drive: DriveArrays, windows: DriveWindows, derived: DerivedHeading | None
) -> Decision:
    free = config.frames.heading == "auto" and derived is None
    return decide_conventions(
        drive, windows, metric=log.datum is None and free, gyro_sense=gyro_sense(log, drive),
        mirror_allowed=free,
    )  # fmt: skip


def _apply(log: RobotLog, convention: Convention) -> RobotLog:
    """Return the log with sides and position of a convention; the heading's handedness is left to the filter."""
    if convention == AS_NAMED:
        return log
    wheels, gnss = log.wheels, log.gnss
    left, right = convention.sign_left * wheels.v_left_mps, convention.sign_right * wheels.v_right_mps
    if convention.swapped:
        left, right = right, left
    if convention.position < 0:
        cov = -gnss.cov_north_east_m2
        gnss = replace(gnss, east_m=-gnss.east_m, cov_north_east_m2=cov)
    return replace(log, wheels=replace(wheels, left=left, right=right), gnss=gnss)


def _turned_over(log: RobotLog) -> RobotLog:
    return replace(log, heading=replace(log.heading, heading_rad=-log.heading.heading_rad))
