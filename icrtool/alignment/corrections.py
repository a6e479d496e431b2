"""Align the streams of a log: conventions, wheel scale, heading offset, delays, from one estimate.

What is significant and large enough to matter is corrected and reported with its standard deviation; the rest is
reported. Preset ``paper`` corrects nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.alignment.conventions import (
    AS_NAMED,
    Convention,
    Decision,
    apply_convention,
    convention_notes,
    decide_conventions,
    gyro_sense,
    senses_by_distance,
)
from icrtool.alignment.drive_windows import DriveWindows, alignment_window_m, cut_windows, track_of_log
from icrtool.alignment.estimator import AlignmentFit, Geometry, estimate_alignment
from icrtool.alignment.heading.heading_alignment import (
    FEWEST_WINDOWS,
    OPPOSITE_SENSE,
    HeadingAlignment,
    align_estimated_heading,
    align_heading,
    compare_with_course,
    refuse_stuck,
    refuse_unexplained,
)
from icrtool.alignment.heading.heading_choice import (
    DerivedHeading,
    as_turn_rate,
    derive_heading,
    fuse_heading,
    stated_source,
    without_heading,
)
from icrtool.alignment.position.gnss_steps import FixSteps, measure_steps
from icrtool.alignment.stream_checks import check_streams
from icrtool.alignment.stream_delays import StreamDelays, find_delays
from icrtool.alignment.wheels.wheel_alignment import (
    WheelAlignment,
    align_wheels,
    configured_scales,
    dead_or_copied,
    refuse_standing,
    scaled,
)
from icrtool.alignment.wheels.wheel_units import refuse_parked
from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.kernels.track import Track
from icrtool.records.run import width_or_usual_m
from icrtool.records.tables import RobotLog

FAR_IN_POSITION_STD, SHORT_DRIVE_M = 30.0, 0.3
"""A drive of so many standard deviations of the fixes, at least of this each, is no short one."""


class AlignedStreams(NamedTuple):
    """A log whose streams fit together, and what was done for that.

    Attributes
    ----------
    log : corrected; the heading's offset stands in `heading`, which the filter applies
    track : what the estimate was made of; fit : the estimate, None where the drive is too short
    derived : the heading where it was estimated, else None
    """

    log: RobotLog
    wheels: WheelAlignment
    heading: HeadingAlignment
    delays: StreamDelays
    track: Track
    fit: AlignmentFit | None
    derived: DerivedHeading | None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was found, in sentences."""
        return (*self.wheels.warnings, *self.heading.warnings, *self.delays.warnings)

    @property
    def geometry(self) -> Geometry | None:
        """ICRs with covariance, from the same estimate; None without one."""
        return None if self.fit is None else self.fit.geometry()

    @property
    def fix_steps(self) -> FixSteps:
        """Steps between the fixes beyond the motion of the wheels."""
        expected = self.track.laid if self.fit is None else self.fit.expected_motion()[0]
        return measure_steps(self.track.place_t, self.track.place, expected)

    @property
    def heading_steps(self) -> FixSteps:
        """Steps of the heading between the fixes [rad] beyond the turn of the wheels; none without an estimate."""
        track = self.track
        if self.fit is None or not len(track.heading_t):
            return measure_steps(np.empty(0), np.empty(0, np.complex128), np.empty(0, np.complex128))
        turned = track.heading_at(track.place_t)
        by_wheels = self.fit.expected_motion()[1]
        return measure_steps(track.place_t, turned.astype(np.complex128), by_wheels.astype(np.complex128))


def align_streams(log: RobotLog, config: Config) -> AlignedStreams:
    """Estimate what relates wheels, heading and positions, and correct what is significant.

    Raises
    ------
    DataError
        Streams that cannot be used together, an unexplained heading, wheels that turn while the robot stands.
    """
    corrects, width = config.filter.preset == "field", width_or_usual_m(config.robot.track_width_m)
    as_sent = log
    log, derived, decision, track, windows, notes, sound = _name_streams(log, config, width)
    refuse_standing(log, track, windows)
    course = compare_with_course(track, windows)
    free, convention = config.frames.heading_offset_deg == "auto" and corrects, decision.convention
    fit = estimate_alignment(track, windows, width)
    if derived is not None:
        heading = align_estimated_heading(log, derived, None)
    else:
        if free:
            refuse_stuck(log)
            if course.is_of_course:
                why = (
                    "the heading turns about where the robot drives backwards: it is a course over ground, and left out"
                )
                return align_streams(without_heading(as_sent, why), config)
            scatter = fit.heading_scatter if fit is not None and config.frames.heading == "auto" else 0.0
            if (bare := as_turn_rate(as_sent, scatter, width)) is not None:
                return align_streams(bare, config)
            refuse_unexplained(log, course)
        heading = align_heading(log, config, fit, course, stated_source(log), convention)
        if free and config.frames.heading == "auto":
            derived = fuse_heading(log, track)
        if derived is not None:
            log = derived.apply(log)
            track = track_of_log(log, derived.smoothed)
            fit = estimate_alignment(track, cut_windows(track, alignment_window_m(track, width)), width)
            heading = align_estimated_heading(log, derived, heading)
    configured = configured_scales(config)
    if convention.swapped and corrects:
        configured = configured[::-1]
    wheels = align_wheels(log, config, fit, configured, notes, sound=sound)
    delays = find_delays(log, config, fit)
    return AlignedStreams(delays.apply(scaled(log, *wheels.applied)), wheels, heading, delays, track, fit, derived)


def _name_streams(
    log: RobotLog, config: Config, width_m: float
) -> tuple[RobotLog, DerivedHeading | None, Decision, Track, DriveWindows, list[str], bool]:
    """Find the heading of a log without one, then which side is which, and in which sense streams turn.

    Returns
    -------
    log with the chosen convention, as sent in preset ``paper``; its heading where it was estimated; the convention;
    the drive with it in any preset, and windows of that; what to report; whether no side is dead or a copy of the other
    """
    corrects, derived, senses = config.filter.preset == "field", None, AS_NAMED
    log = scaled(log, *configured_scales(config))
    if not len(log.heading.stamp_ns) and corrects:
        senses = _senses_without_heading(log)
        log = apply_convention(log, senses)
        derived = _derived_heading(log, width_m)
        log = derived.apply(log)
    check_streams(log)
    faults = dead_or_copied(log)
    track = track_of_log(log, None if derived is None else derived.smoothed)
    windows = cut_windows(track, alignment_window_m(track, width_m))
    free = config.frames.heading == "auto" and derived is None
    decision = decide_conventions(
        track, windows, metric=log.datum is None and free, gyro_sense=gyro_sense(log, track), mirror_allowed=free
    )
    named = apply_convention(log, decision.convention)
    if named is not log:
        if derived is not None:
            # it was made with wheels whose sides are exchanged, or run backwards
            derived = _derived_heading(named, width_m)
            named = derived.apply(named)
        track = track_of_log(named, None if derived is None else derived.smoothed)
        windows = cut_windows(track, alignment_window_m(track, width_m))
    notes = [
        *faults,
        *convention_notes(Decision(senses, None), corrects=True),
        *convention_notes(decision, corrects=corrects),
    ]
    if derived is None and config.frames.heading != "auto":
        free_hand = decide_conventions(track, windows, metric=False)
        if free_hand.convention.heading < 0:
            notes.append(f"{OPPOSITE_SENSE}: set frames.heading to the other of enu and ned")
    return named if corrects else log, derived, decision, track, windows, notes, not faults


def _senses_without_heading(log: RobotLog) -> Convention:
    few = min(len(log.wheels.stamp_ns), len(log.gnss.stamp_ns)) < 2
    return AS_NAMED if few else senses_by_distance(track_of_log(log))


def _derived_heading(log: RobotLog, width_m: float) -> DerivedHeading:
    """Return the heading of a log without one; a robot that stands is refused as such."""
    try:
        return derive_heading(log, width_m)
    except DataError as error:
        refuse_parked(log)
        if min(len(log.wheels.stamp_ns), len(log.gnss.stamp_ns)) < FEWEST_WINDOWS:
            raise
        track = track_of_log(log)
        if track.travel[-1] < FAR_IN_POSITION_STD * max(track.place_std_m, SHORT_DRIVE_M):
            raise
        raise DataError(
            log.name,
            f"no heading in it, and a drive of {track.travel[-1]:.0f} m is too short to find one from positions of "
            f"±{track.place_std_m:.1f} m",
            "record an orientation (AHRS), use RTK, or drive several times as far",
        ) from error
