"""Correction of the streams of a log: conventions, wheel scale, heading offset and delays, from one estimate.

Errors that are significant and large enough to have an effect are corrected and reported with their standard
deviations. Other findings are only reported. Preset ``paper`` corrects nothing.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from icrtool.alignment.conventions import (
    AS_NAMED,
    Decision,
    apply_convention,
    convention_notes,
    decide_conventions,
    gyro_sense,
    senses_by_distance,
)
from icrtool.alignment.estimator import ESTIMATE_PRIOR_STD, POSITION_LAG, AlignmentFit, estimate_alignment
from icrtool.alignment.heading_alignment import (
    NOT_COMPARED,
    OTHER_CONVENTION,
    align_heading,
    compare_with_course,
    refuse_stuck,
    refuse_unexplained,
)
from icrtool.alignment.heading_choice import (
    DerivedHeading,
    as_turn_rate,
    derive_heading,
    fuse_heading,
    without_heading,
)
from icrtool.alignment.log_track import DriveWindows, check_streams, track_of_log, windows_of_log
from icrtool.alignment.sensor_noise import FixSteps, measure_steps
from icrtool.alignment.wheel_alignment import (
    align_wheels,
    configured_scales,
    dead_or_copied,
    with_scaled_wheels,
)
from icrtool.alignment.wheel_units import refuse_standing
from icrtool.config import Config
from icrtool.kernels.track import Track
from icrtool.records.measurements import LONGEST_RESPONSE_S, HeadingFacts, WheelFacts
from icrtool.records.notes import Note, note, notes_about
from icrtool.records.run import width_or_usual_m
from icrtool.records.tables import RobotLog

CORRECTION_SIGMAS = 2.5
"""Smallest size of a delay that is corrected, in its standard deviations."""

SMALLEST_LEAD_S, LARGEST_STD_S = 0.2, 0.1
"""Smallest lead that is corrected, and largest standard deviation of a corrected delay [s].

A robot follows its wheels with a delay of up to `LONGEST_RESPONSE_S`, which is no error of a clock; the standard
deviation of a delay includes it. A small lead more often comes from such a response than from a clock."""


class DelayEstimate(NamedTuple):
    """A delay with respect to the wheels and its standard deviation [s]; NaN where the drive does not show it."""

    value_s: float
    std_s: float

    @property
    def is_significant(self) -> bool:
        """Whether the delay is known well and differs significantly from zero."""
        return self.std_s < LARGEST_STD_S and abs(self.value_s) > CORRECTION_SIGMAS * self.std_s


UNKNOWN = DelayEstimate(math.nan, math.nan)
"""A delay that was not measured."""


class StreamDelays(NamedTuple):
    """Delays that were measured, and delays that are corrected because they are significant or configured.

    Attributes
    ----------
    heading, gnss : measured delays of headings and positions with respect to the wheels
    apart : measured delay of the positions with respect to the headings
    together : whether position and heading are fields of the same messages
    applied_heading_s, applied_gnss_s : delays that are corrected [s]
    """

    heading: DelayEstimate
    gnss: DelayEstimate
    apart: DelayEstimate
    together: bool
    applied_heading_s: float
    applied_gnss_s: float

    @property
    def clock_std_s(self) -> float:
        """Standard deviation of the time between position and heading after the correction [s].

        Prior: the clocks agree with probability 0.5. If no delay between them was corrected, the variance is the second
        moment of the delay of clocks that differ, times the probability that they differ (Bayes factor of Dickey 1971:
        ratio of the densities at zero after and before the drive).
        """
        value, std = self.apart
        if self.together:
            return 0.0
        if not math.isfinite(std):
            return float(ESTIMATE_PRIOR_STD[POSITION_LAG]) * math.sqrt(0.5)
        if self.applied_gnss_s != self.applied_heading_s:
            return std
        agree = ESTIMATE_PRIOR_STD[POSITION_LAG] / std * math.exp(-0.5 * (value / std) ** 2)
        return math.sqrt((std**2 + value**2) / (1.0 + agree))


def find_delays(log: RobotLog, config: Config, fit: AlignmentFit | None) -> tuple[StreamDelays, list[Note]]:
    """Return the measured and the corrected delays of headings and positions, and findings about corrections."""
    heading = position = apart = UNKNOWN
    if fit is not None:
        found = (DelayEstimate(*fit.estimate(name)) for name in ("heading_delay", "position_delay"))
        heading, position = (delay if delay.std_s < 2 * LARGEST_STD_S else UNKNOWN for delay in found)
        apart = DelayEstimate(*fit.estimate("position_after_heading"))
    together, notes, applied, lags = log.heading_is_of_position, list[Note](), (0.0, 0.0), [0.0, 0.0]
    if config.filter.rules.corrects:
        if fit is not None and not fit.slips:
            applied = _clear_delays(heading, position, apart, together=together)
        configured_s = config.frames.heading_delay_s, config.frames.reference_delay_s
        shown = [delay if delay.is_significant else apart for delay in (heading, position)]
        free = [delay == "auto" for delay in configured_s]
        notes = _delay_notes(applied, [delay.std_s for delay in shown], free, together=together)
        lags = [own if lag == "auto" else lag for own, lag in zip(applied, configured_s, strict=True)]
    return StreamDelays(heading, position, apart, together, 0.0 if together else lags[0], lags[1]), notes


def _clear_delays(
    heading: DelayEstimate, position: DelayEstimate, apart: DelayEstimate, *, together: bool
) -> tuple[float, float]:
    """Return the delays of heading and position to correct: the most likely combination.

    Twice the negative log-likelihood, with a penalty for each delay that is not zero (`CORRECTION_SIGMAS` squared).
    """
    if together:
        common = position.value_s if position.is_significant and _is_large(position.value_s) else 0.0
        return common, common
    if not heading.std_s < LARGEST_STD_S:
        return 0.0, 0.0
    lag, after = heading.value_s, apart.value_s
    # Five combinations: no delay; one delay of both; the heading alone; the position alone; a delay of each.
    free = {(0.0, 0.0): 0, (lag, lag): 1, (lag, 0.0): 1, (0.0, after): 1, (lag, lag + after): 2}
    costs = {
        (first, second): ((lag - first) / heading.std_s) ** 2
        + ((after - second + first) / apart.std_s) ** 2
        + CORRECTION_SIGMAS**2 * free[first, second]
        for first, second in free
        if all(value == 0.0 or _is_large(value) for value in (first, second))
    }
    return min(costs, key=lambda combination: costs[combination])


def _is_large(delay_s: float) -> bool:
    """Return whether a delay is longer than a robot's response to its wheels."""
    return delay_s > LONGEST_RESPONSE_S or delay_s < -SMALLEST_LEAD_S


def _delay_notes(applied: tuple[float, float], std_s: list[float], free: list[bool], *, together: bool) -> list[Note]:
    """Return a finding for each stream that is moved by a delay that was not configured.

    Parameters
    ----------
    applied, std_s, free : corrected delay [s], its standard deviation [s], and whether it is not configured, first of
        the heading, then of the position
    together : as in `StreamDelays`
    """
    subjects = [("the heading", "lags", "frames.heading_delay_s"), ("the position", "lags", "frames.reference_delay_s")]
    are_equal = not together and applied[0] == applied[1] and free[0]
    also = (
        "; the position is corrected by the same delay, because no difference of both delays is shown"
        if are_equal
        else ""
    )
    if together:
        subjects[1] = ("the position and its heading", "lag", "frames.reference_delay_s")
    notes = list[Note]()
    for row in [1] if together else [0] if are_equal else [0, 1]:
        (subject, lags, key), value = subjects[row], applied[row]
        if value != 0.0 and free[row]:
            fact = f"{subject} {lags} the wheels" if value > 0 else f"the wheels lag {subject}"
            text = f"{fact} by {abs(value):.2f} ± {std_s[row]:.2f} s: corrected; {key} sets it{also}"
            notes.append(note("delay_corrected", text))
    return notes


class AlignedStreams(NamedTuple):
    """A log with corrected streams, and the corrections.

    Attributes
    ----------
    log : log with all corrections but the offset of the heading, which is in `heading`
    wheels, heading : facts about wheels and heading
    scales : factors on the speeds of the left and of the right side, in addition to the configured scales
    correlation_s : correlation time of the noise of a stated heading whose noise was raised [s]; else 0
    delays : delays of headings and positions
    track : data of the estimate
    fit : the estimate; None where the drive is too short
    derived : the estimated heading; None for a stated heading
    notes : the findings
    """

    log: RobotLog
    wheels: WheelFacts
    scales: tuple[float, float]
    heading: HeadingFacts
    correlation_s: float
    delays: StreamDelays
    track: Track
    fit: AlignmentFit | None
    derived: DerivedHeading | None
    notes: tuple[Note, ...]

    def steps(self) -> tuple[FixSteps, FixSteps]:
        """Return the steps of position [m] and of heading [rad] between the fixes, minus the motion of the wheels.

        Without an estimate, the second result is empty.
        """
        track = self.track
        if self.fit is None:
            none = np.empty(0, np.complex128)
            return measure_steps(track.place_t, track.place, track.laid), measure_steps(np.empty(0), none, none)
        moved, turn = self.fit.model.until_fixes(self.fit.solution.x)
        turned = track.heading_at(track.place_t)
        return measure_steps(track.place_t, track.place, moved), measure_steps(track.place_t, turned, turn)


def align_streams(log: RobotLog, config: Config) -> AlignedStreams:
    """Return the streams of a log with their significant errors corrected, and the estimates of these errors.

    Raises
    ------
    DataError
        Streams that cannot be used together, an unexplained heading, wheels that turn while the robot stands.
    """
    corrects, width = config.filter.rules.corrects, width_or_usual_m(config.robot.track_width_m)
    as_sent = log
    log, derived, decision, windows, notes, sound = _name_streams(log, config, width)
    refuse_standing(log, windows)
    fit, convention = estimate_alignment(windows, width), decision.convention
    if derived is not None:
        heading, correlation_s, heading_notes = align_heading(log, config, None, NOT_COMPARED, convention, derived)
    else:
        course, free = compare_with_course(windows), config.frames.heading_offset_deg == "auto" and corrects
        may_derive = free and config.frames.heading == "auto"
        if free:
            refuse_stuck(log)
            if course.turns_about:
                why = "the heading turns about where the robot drives backwards"
                why = f"{why}: it is a course over ground, and left out"
                return align_streams(without_heading(as_sent, why), config)
            scatter = fit.heading_scatter_rad if fit is not None and may_derive else 0.0
            if (bare := as_turn_rate(as_sent, scatter, width)) is not None:
                return align_streams(bare, config)
            refuse_unexplained(log, fit, course)
        derived = fuse_heading(log, windows.track) if may_derive else None
        heading, correlation_s, heading_notes = align_heading(log, config, fit, course, convention, derived)
        if derived is not None:
            log = derived.apply(log)
            windows = _windows(log, width, derived)
            fit = estimate_alignment(windows, width)
    configured = configured_scales(config)
    if convention.swapped and corrects:
        configured = configured[::-1]
    wheels, scales, wheel_notes = align_wheels(log, config, fit, configured, sound=sound)
    delays, delay_notes = find_delays(log, config, fit)
    log = with_scaled_wheels(log, *scales)
    lags = {"gnss": delays.applied_gnss_s, "heading": delays.applied_heading_s}
    lags["heading"] = lags["gnss"] if delays.together else lags["heading"]
    moved: dict[str, Any] = {
        name: replace(stream, stamp_ns=stream.stamp_ns - round(lags[name] * 1e9))
        for name, stream in (("gnss", log.gnss), ("heading", log.heading))
        if lags[name] != 0.0
    }
    log = replace(log, **moved) if moved else log
    findings = notes_about(log.name, (*notes, *wheel_notes, *heading_notes, *delay_notes))
    return AlignedStreams(log, wheels, scales, heading, correlation_s, delays, windows.track, fit, derived, findings)


def _windows(log: RobotLog, width_m: float, derived: DerivedHeading | None) -> DriveWindows:
    """Return the windows of a log, with the smoothed heading where it was estimated."""
    if derived is None:
        return windows_of_log(log, width_m)
    return windows_of_log(log, width_m, derived.smoothed, derived.measured_t)


def _name_streams(
    log: RobotLog, config: Config, width_m: float
) -> tuple[RobotLog, DerivedHeading | None, Decision, DriveWindows, list[Note], bool]:
    """Return a log with a heading, and with the names of sides and senses that fit the motion.

    Returns
    -------
    log with the chosen convention, as sent in preset ``paper``; its heading where it was estimated; the convention;
    windows with this convention, in any preset; findings; whether no side is dead or a copy of the other side
    """
    corrects, derived, senses = config.filter.rules.corrects, None, AS_NAMED
    log = with_scaled_wheels(log, *configured_scales(config))
    if not len(log.heading.stamp_ns) and corrects:
        if min(len(log.wheels.stamp_ns), len(log.gnss.stamp_ns)) > 1:
            senses = senses_by_distance(track_of_log(log))
        log = apply_convention(log, senses)
        derived = derive_heading(log, width_m)
        log = derived.apply(log)
    check_streams(log)
    faults = dead_or_copied(log)
    windows = _windows(log, width_m, derived)
    free = config.frames.heading == "auto" and derived is None
    alone = derived is not None and log.gyro is None and not log.gyros
    decision = decide_conventions(
        windows, metric=log.datum is None and free, gyro_sense=gyro_sense(log, windows.track), mirror_allowed=free
    )
    named = apply_convention(log, decision.convention)
    if named is not log:
        if derived is not None:
            # The heading was estimated with exchanged or reversed sides, and is estimated again.
            derived = derive_heading(named, width_m)
            named = derived.apply(named)
        windows = _windows(named, width_m, derived)
    notes = [
        *faults,
        *convention_notes(Decision(senses, None), corrects=True, mirrored=alone),
        *convention_notes(decision, corrects=corrects, mirrored=alone),
    ]
    if derived is None and config.frames.heading != "auto":
        free_hand = decide_conventions(windows, metric=False)
        if free_hand.convention.heading < 0:
            notes.append(OTHER_CONVENTION)
    return named if corrects else log, derived, decision, windows, notes, not faults
