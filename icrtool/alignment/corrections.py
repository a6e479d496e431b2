"""Align the streams of a log: conventions, wheel scale, heading offset, delays, from one estimate.

What is significant and large enough to matter is corrected and reported with its standard deviation; the rest is
reported. Preset ``paper`` corrects nothing.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icrtool.alignment.conventions import AS_NAMED, Convention, Decision, convention_notes, decide_conventions
from icrtool.alignment.course_over_ground import FEWEST_WINDOWS, Course, measure_course
from icrtool.alignment.drive_windows import DriveArrays, DriveWindows, cut_windows, drive_arrays
from icrtool.alignment.estimator import AlignmentFit, Geometry, estimate_alignment
from icrtool.alignment.heading_alignment import (
    NOISY_SCATTER_RAD,
    HeadingCheck,
    refuse_stuck,
    refuse_unexplained,
)
from icrtool.alignment.heading_choice import CORRELATION_S, DerivedHeading, as_turn_rate, derive_heading
from icrtool.alignment.heading_offset_cause import NO_NAME, name_offset
from icrtool.alignment.reference_delay import delayed
from icrtool.alignment.stream_checks import check_streams
from icrtool.alignment.stream_delays import LARGEST_STD_S, UNKNOWN, Delay, StreamDelays
from icrtool.alignment.wheel_alignment import WheelCheck, dead_or_copied, held_note, held_share
from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.records.measurements import Finding, IcrStart
from icrtool.records.run import half_width_m
from icrtool.records.tables import HeadingSamples, RobotLog, WheelSamples

SIGNIFICANT_SIGMAS = 4.0
SMALLEST_SCALE_ERROR, SCALE_SIGMAS, USUAL_SCALE_STD = 0.01, 2.0, 0.04
"""A scale is corrected by what remains of it beside a prior: wheels roll at their nominal radius to 4 %."""

LARGEST_SCALE_CORRECTION = 0.15
FACTOR_TWO_TOLERANCE = 0.04
"""A scale is corrected up to what tyres and soil explain, or where it is a factor two (diameter for radius)."""

SAME_CLOCK_SIGMAS = 2.0
"""Heading and position whose delays differ by less lag or lead together: it is the wheels' clock then."""

SMALLEST_OFFSET_RAD = math.radians(1.0)
STANDS_SHARE, STILL = 0.8, 0.2
"""The robot does not move where in this share of the windows its displacement is below this part of the wheels'."""

LEAST_START_STD, INFLATION = 0.15, 3.0
"""The filter starts from the alignment's ICRs with three times their standard deviation, at least this part of b."""

LARGEST_WIDTH_STD, WIDTHS = 0.2, (0.7, 6.0)
"""The ICRs are shown where W is known to this share, and lies between so many b."""

USUAL_WIDTH = 1.5
"""Most skid-steer robots turn as if they were this much wider than they are."""

FUSED_CORRELATION = 0.9995
"""A turn rate of the wheels that follows the gyro this closely was made of it."""


class AlignedStreams(NamedTuple):
    """A log whose streams fit together, and what was done for that.

    Attributes
    ----------
    log : corrected; the heading's offset and handedness stand in `heading`, which the filter applies
    fit : the estimate; None where the drive is too short
    derived : the heading where it was estimated, else None
    """

    log: RobotLog
    wheels: WheelCheck
    heading: HeadingCheck
    delays: StreamDelays
    fit: AlignmentFit | None
    derived: DerivedHeading | None
    warnings: tuple[str, ...]

    @property
    def geometry(self) -> Geometry | None:
        """ICRs with covariance, from the same estimate; None without one."""
        return None if self.fit is None else self.fit.geometry()

    @property
    def as_named(self) -> RobotLog:
        """The log with sides, handedness and scale corrected, offset and delays not."""
        return _turned_over(self.wheels.log) if self.heading.applied_mirror else self.wheels.log

    @property
    def source(self) -> str:
        """What the heading was made of."""
        return "orientation" if self.derived is None else self.derived.source

    def robot_findings(self) -> dict[str, Finding]:
        """Return side scales and ICRs, as the alignment estimates them."""
        found = self.geometry
        if found is None:
            return {}
        std = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
        scale = self.wheels.applied_scale
        rows = {
            "left_scale": (3, scale, "both sides are scaled alike"),
            "right_scale": (4, scale, "both sides are scaled alike"),
            "y_icr_right_m": (0, 0.0, "start of the filter"),
            "y_icr_left_m": (1, 0.0, "start of the filter"),
            "x_icr_m": (2, 0.0, "start of the filter"),
        }
        return {
            name: Finding(float(found.values[row]), float(std[row]), applied, why)
            for name, (row, applied, why) in rows.items()
        }


def align_streams(log: RobotLog, config: Config) -> AlignedStreams:
    """Estimate what relates wheels, heading and positions, and correct what is significant.

    Raises
    ------
    DataError
        Streams that cannot be used together, a heading that nothing explains, wheels that turn while the robot stands.
    """
    corrects, width = config.filter.preset == "field", 2.0 * half_width_m(config.robot.track_width_m)
    as_sent, derived = log, None
    if not len(log.heading.stamp_ns) and corrects:
        derived = derive_heading(log, width)
        log = derived.apply(log)
    check_streams(log)
    notes = list(dead_or_copied(log))
    sound = not notes
    drive = drive_arrays(log, None if derived is None else derived.smoothed)
    windows = cut_windows(drive)
    decision = _decide(log, config, drive, windows, derived)
    if corrects:
        log = _apply(log, decision.convention)
    drive = _apply_to_drive(drive, decision.convention)
    notes += convention_notes(decision, corrects=corrects)
    mirrored = decision.convention.heading < 0
    if derived is None and config.frames.heading != "auto":
        free_hand = decide_conventions(drive, windows, metric=False)
        if free_hand.convention.heading < 0:
            notes.append("the heading turns the other way than the course: set frames.heading to the other of enu, ned")
    _refuse_standing(log, drive, windows)
    course = measure_course(_turned_over(log) if mirrored else log)
    free = config.frames.heading_offset_deg == "auto" and corrects
    fit = estimate_alignment(drive, windows, width)
    if free and derived is None:
        refuse_stuck(log)
        scatter = fit.heading_scatter if fit is not None and config.frames.heading == "auto" else 0.0
        if (bare := as_turn_rate(as_sent, scatter, width)) is not None:
            return align_streams(bare, config)
        refuse_unexplained(log, course)
    scale, scale_note = _scale(fit, config, sound=sound, corrects=corrects)
    notes += scale_note
    if scale != 1.0:
        left, right = (scale * speed for speed in (log.wheels.v_left_mps, log.wheels.v_right_mps))
        log = replace(log, wheels=WheelSamples(log.wheels.stamp_ns, left, right))
    share = held_share(log.wheels)
    notes += held_note(log.wheels, share) + _fused_note(log)
    a, a_std = (math.nan, math.nan) if fit is None else fit.estimate("scale")
    wheels = WheelCheck(log, a, a_std, scale, share, tuple(f"{log.name}: {note}" for note in notes), course)
    heading = _heading_check(log, config, fit, course, derived, mirrored=mirrored)
    delays = _delays(log, config, fit)
    log = delays.log
    return AlignedStreams(
        log, wheels, heading, delays, fit, derived,
        (*wheels.warnings, *heading.warnings, *delays.warnings),
    )  # fmt: skip


def _decide(
    log: RobotLog, config: Config, drive: DriveArrays, windows: DriveWindows, derived: DerivedHeading | None
) -> Decision:
    free = config.frames.heading == "auto" and derived is None
    return decide_conventions(
        drive, windows, metric=log.datum is None and free, gyro_sense=_gyro_sense(log, drive),
        mirror_allowed=free,
    )  # fmt: skip


def _gyro_sense(log: RobotLog, drive: DriveArrays) -> int:
    """Return +1 where the gyro turns as the heading is named, -1 where the other way, 0 without one or in doubt."""
    if log.gyro is None or len(drive.heading_t) < 3:
        return 0
    t = (log.gyro.stamp_ns - log.wheels.stamp_ns[0]) / 1e9
    turned = np.concatenate([[0.0], np.cumsum(np.diff(t) * log.gyro.rate_radps[:-1])])
    edges = t[0] + np.unique(np.floor(t - t[0]))
    by_gyro, by_heading = (
        np.diff(np.interp(edges, t, turned)),
        np.diff(np.interp(edges, drive.heading_t, drive.heading)),
    )
    if len(by_gyro) < FEWEST_WINDOWS or not (np.ptp(by_gyro) > 0 and np.ptp(by_heading) > 0):
        return 0
    correlation = float(np.corrcoef(by_gyro, by_heading)[0, 1])
    return int(np.sign(correlation)) if abs(correlation) > 0.5 else 0


def _apply(log: RobotLog, convention: Convention) -> RobotLog:
    """Return the log with sides and position as the convention says; the heading's handedness is left to the filter."""
    if convention == AS_NAMED:
        return log
    wheels, gnss = log.wheels, log.gnss
    left, right = convention.sign_left * wheels.v_left_mps, convention.sign_right * wheels.v_right_mps
    if convention.swapped:
        left, right = right, left
    if convention.position < 0:
        cov = -gnss.cov_north_east_m2
        gnss = replace(gnss, east_m=-gnss.east_m, cov_north_east_m2=cov)
    return replace(log, wheels=WheelSamples(wheels.stamp_ns, left, right), gnss=gnss)


def _apply_to_drive(drive: DriveArrays, convention: Convention) -> DriveArrays:
    left, right = convention.sign_left * drive.v_left, convention.sign_right * drive.v_right
    return drive._replace(
        v_left=right if convention.swapped else left,
        v_right=left if convention.swapped else right,
        heading=convention.heading * drive.heading,
        fix=drive.fix if convention.position > 0 else np.conj(drive.fix),
    )


def _turned_over(log: RobotLog) -> RobotLog:
    return replace(log, heading=replace(log.heading, heading_rad=-log.heading.heading_rad))


def _refuse_standing(log: RobotLog, drive: DriveArrays, windows: DriveWindows) -> None:
    """Raise where the wheels turn and the position does not: a robot on a stand, or held."""
    begin, end = windows.begin, windows.end
    if len(begin) < FEWEST_WINDOWS:
        return
    turned = np.abs(np.interp(drive.fix_t[end], drive.heading_t, drive.heading)
                    - np.interp(drive.fix_t[begin], drive.heading_t, drive.heading))  # fmt: skip
    v, w = drive.v_left + drive.v_right, drive.v_left - drive.v_right
    nose = np.exp(1j * np.interp(drive.wheel_t, drive.heading_t, drive.heading))
    laid, apart = (np.concatenate([[0.0], np.cumsum((rate / 2 * drive.wheel_dt)[:-1])]) for rate in (v * nose, w))
    laid, apart = (
        np.abs(np.interp(drive.fix_t[end], drive.wheel_t, one) - np.interp(drive.fix_t[begin], drive.wheel_t, one))
        for one in (laid, apart)
    )
    went = np.abs(drive.fix[end] - drive.fix[begin])
    moved = (went > STILL * np.maximum(laid, apart / 4)) | (turned > math.radians(10.0))
    clear = np.maximum(laid, apart) > windows.length_m / 4
    if np.count_nonzero(clear) >= FEWEST_WINDOWS and float((~moved)[clear].mean()) > STANDS_SHARE:
        place = drive.fix - (np.median(drive.fix.real) + 1j * np.median(drive.fix.imag))
        raise DataError(
            log.name,
            f"the wheels turn ({drive.travel[-1]:.0f} m) and the robot does not move",
            f"95 % of the positions lie within {float(np.percentile(np.abs(place), 95)):.2f} m: is it on a stand?",
        )


def _scale(fit: AlignmentFit | None, config: Config, *, sound: bool, corrects: bool) -> tuple[float, list[str]]:
    """Return the factor to apply to the wheels' speeds, and what to say."""
    if fit is None:
        return 1.0, []
    scale, std = fit.estimate("scale")
    error = abs(scale - 1.0)
    # a heading that scatters makes the path along it shorter by half its variance
    if error <= max(SMALLEST_SCALE_ERROR, SCALE_SIGMAS * std, fit.heading_scatter**2):
        return 1.0, []
    if error <= LARGEST_SCALE_CORRECTION:
        scale = 1.0 + (scale - 1.0) * USUAL_SCALE_STD**2 / (USUAL_SCALE_STD**2 + std**2)
    text = f"the robot goes {100 * scale:.1f} ± {100 * std:.1f} % of the distance that the wheels report"
    given = config.wheels.left_scale != "auto" or config.wheels.right_scale != "auto"
    twice = any(abs(scale / value - 1.0) < FACTOR_TWO_TOLERANCE for value in (0.5, 2.0))
    if corrects and sound and not given and (error <= LARGEST_SCALE_CORRECTION or twice):
        return scale, [f"{text}: corrected; wheels.left_scale and right_scale set it"]
    return 1.0, [f"{text}: check wheel radius, encoder resolution and units"]


def _fused_note(log: RobotLog) -> list[str]:
    """Warn of wheels that are another filter's output: their turn rate is the gyro's."""
    stream = next((one for one in log.streams if one.role == "wheels"), None)
    fused_type = stream is not None and any(word in stream.message_type for word in ("Odometry", "Twist"))
    if stream is None or not fused_type or log.gyro is None:
        return []
    t = (log.wheels.stamp_ns - log.gyro.stamp_ns[0]) / 1e9
    rate = np.interp(t, (log.gyro.stamp_ns - log.gyro.stamp_ns[0]) / 1e9, log.gyro.rate_radps)
    apart = log.wheels.v_left_mps - log.wheels.v_right_mps
    if not (np.ptp(rate) > 0.1 and np.ptp(apart) > 0 and float(np.corrcoef(rate, apart)[0, 1]) > FUSED_CORRELATION):
        return []
    fact = f"{stream.topic} turns exactly as the gyro does: it is fused, not measured by wheels, and shows no slip"
    return [f"{fact}; name the wheels' own topic with topics.wheels"]


def _heading_check(
    log: RobotLog, config: Config, fit: AlignmentFit | None, course: Course, derived: DerivedHeading | None,
    *, mirrored: bool,
) -> HeadingCheck:  # fmt: skip
    """Return the heading's offset and noise, and what is applied."""
    given, corrects = config.frames.heading_offset_deg, config.filter.preset == "field"
    fixed = math.radians(given) if given != "auto" and corrects else 0.0
    nothing = (math.nan,) * 5
    if derived is not None:
        return HeadingCheck(
            len(course.angle), 0.0, float(np.median(np.sqrt(derived.smoothed.var_rad2))), *nothing[:3],
            applied_mirror=False, applied_offset_rad=0.0, applied_std_rad=0.0, applied_correlation_s=CORRELATION_S,
            name=NO_NAME, warnings=(f"{log.name}: the heading is estimated: {derived.why}",),
        )  # fmt: skip
    if fit is None:
        return HeadingCheck(
            len(course.angle), *nothing, applied_mirror=mirrored and corrects, applied_offset_rad=fixed,
            applied_std_rad=0.0,
            applied_correlation_s=0.0, name=NO_NAME, warnings=(),
        )  # fmt: skip
    turn, std = fit.estimate("offset")
    offset = math.remainder(-turn, 2 * math.pi)
    scatter = math.sqrt(max(fit.across_std**2 - course.noise_rad**2, 0.0))
    rest = offset + math.pi / 2 if mirrored else offset
    significant = _significant(offset - fixed, std)
    begin = int(log.wheels.stamp_ns[0])
    name = name_offset(rest, std, log.datum, begin) if _significant(rest, std) else NO_NAME
    cause = f" ({name.text})" if name.text else ""
    text = f"{math.degrees(math.remainder(rest, 2 * math.pi)):+.1f}° ± {math.degrees(std):.1f}°"
    applied, notes = fixed, []
    if mirrored and not corrects:
        notes.append("the heading turns the other way than the course: set frames.heading to the other of enu and ned")
    elif mirrored:
        applied = offset if given == "auto" else fixed
        notes.append(
            "the heading turns the other way than the course: its yaw is of the other convention (ENU/NED), "
            f"offset {text}{cause}: applied; frames.heading sets it"
        )
    elif significant and given == "auto" and corrects:
        applied = offset
        notes.append(f"heading is {text} off the course{cause}: applied; frames.heading_offset_deg sets it")
    elif significant:
        notes.append(f"heading is {text} off the course{cause}, {math.degrees(fixed):+.1f}° is applied")
    noisy = corrects and scatter > NOISY_SCATTER_RAD and course.is_explained
    if noisy:
        notes.append(
            f"the heading scatters by {math.degrees(scatter):.0f}° about the course, over whole windows: "
            "its noise is raised accordingly"
        )
    return HeadingCheck(
        windows=len(course.angle), offset_rad=offset, offset_std_rad=std, scatter_rad=scatter,
        agreement=course.agreement if len(course.angle) else math.nan,
        mirrored_agreement=course.mirrored_agreement if len(course.angle) else math.nan,
        applied_mirror=mirrored and corrects,
        applied_offset_rad=applied, applied_std_rad=scatter if noisy else 0.0,
        applied_correlation_s=course.duration_s if noisy else 0.0, name=name,
        warnings=tuple(f"{log.name}: {note}" for note in notes),
    )  # fmt: skip


def _significant(offset: float, std: float) -> bool:
    return abs(math.remainder(offset, 2 * math.pi)) > max(SMALLEST_OFFSET_RAD, SIGNIFICANT_SIGMAS * std)


def _delays(log: RobotLog, config: Config, fit: AlignmentFit | None) -> StreamDelays:
    """Return the delays of heading and positions against the wheels, with what is clear, or configured, corrected."""
    field = config.filter.preset == "field"
    found = {"heading": UNKNOWN, "position": UNKNOWN}
    if fit is not None:
        for what in found:
            value, std = fit.estimate(f"{what}_delay")
            found[what] = Delay(value, std) if std < 2 * LARGEST_STD_S else UNKNOWN
    topics = {stream.role: stream.topic for stream in log.streams}
    together = "gnss" in topics and topics["gnss"] == topics.get("heading")
    given = {"heading": config.frames.heading_delay_s, "position": config.frames.reference_delay_s}
    applied, notes = {}, []
    for what, key in (("heading", "frames.heading_delay_s"), ("position", "frames.reference_delay_s")):
        setting, delay = given[what], found[what]
        applied[what] = 0.0
        if field and setting != "auto":
            applied[what] = setting
        elif field and what == "position" and applied["heading"] and _on_one_clock(fit, delay):
            applied[what] = applied["heading"]
            notes.append(f"{log.name}: the position is corrected alike: nothing shows that its delay differs")
        elif field and delay.is_clear:
            applied[what] = delay.value_s
            lags = ("lag" if together else "lags") if delay.value_s > 0 else ("lead" if together else "leads")
            subject = "the position and its heading" if together else f"the {what}"
            if not (together and what == "heading"):
                notes.append(
                    f"{log.name}: {subject} {lags} the wheels by {abs(delay.value_s):.2f} ± {delay.std_s:.2f} s: "
                    f"corrected; {key} sets it"
                )
    if together:
        applied["heading"] = 0.0
    shifted = delayed(log, applied["position"])
    if applied["heading"] and not together:
        shift = round(applied["heading"] * 1e9)
        moved: HeadingSamples = replace(shifted.heading, stamp_ns=shifted.heading.stamp_ns - shift)
        shifted = replace(shifted, heading=moved)
    return StreamDelays(
        shifted, found["heading"], found["position"], applied["heading"], applied["position"], tuple(notes)
    )


def _on_one_clock(fit: AlignmentFit | None, position: Delay) -> bool:
    """Return whether a delay of the heading is one of the wheels: the position shows none of its own."""
    if fit is None or position.is_clear:
        return False
    apart, std = fit.estimate("position_after_heading")
    return abs(apart) < SAME_CLOCK_SIGMAS * std


def start_icrs(found: Geometry | None, antenna_m: tuple[float, float], config: Config) -> IcrStart | None:
    """Return the ICRs to start the filter from; None in preset ``paper``.

    They are those of the alignment with an inflated standard deviation, where the drive shows them; else those of
    most skid-steer robots, as uncertain as those differ.
    """
    if config.filter.preset == "paper":
        return None
    b = 2.0 * half_width_m(config.robot.track_width_m)
    least = LEAST_START_STD * b
    if found is not None:
        right, left, x = found.values[:3].tolist()
        std, width = np.sqrt(np.maximum(np.diag(found.covariance), 0.0)), float(found.values[5])
        shown = std[5] < LARGEST_WIDTH_STD * width and WIDTHS[0] * b < width < WIDTHS[1] * b
        icrs = (right + antenna_m[1], left + antenna_m[1], x + antenna_m[0])
        if shown and icrs[0] > least > -least > icrs[1] and float(std[:3].max()) < b:
            inflated = [max(INFLATION * float(one), least) for one in std[:3]]
            return IcrStart(icrs, (inflated[0], inflated[1], inflated[2]))
    return IcrStart((USUAL_WIDTH * b / 2, -USUAL_WIDTH * b / 2, 0.0), (b / 2, b / 2, b / 2))
