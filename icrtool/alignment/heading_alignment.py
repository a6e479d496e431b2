"""The heading compared with the course over ground: its offset, the cause, the correction, and refused headings."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from icrtool.alignment.conventions import StreamSigns
from icrtool.alignment.estimator import EVIDENCE_SIGMAS, AlignmentFit
from icrtool.alignment.heading_choice import NOISY_SCATTER_RAD, DerivedHeading
from icrtool.alignment.log_track import FEWEST_ALIGNMENT_WINDOWS, STARTS_A_WINDOW, DriveWindows
from icrtool.alignment.sensor_noise import unbroken_intervals
from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.records.measurements import HeadingFacts
from icrtool.records.notes import Note, note
from icrtool.records.plain_data import finite_or_none
from icrtool.records.samples import Datum
from icrtool.records.tables import RobotLog

LIKE_RAD = math.radians(1.0)
"""Largest difference between an offset and its possible cause [rad]. Compasses in robots are no more accurate. An
offset with a larger standard deviation gets no cause."""

SMALLEST_CAUSE_RAD = math.radians(0.5)
"""Smallest declination or convergence that is stated as a cause [rad]."""

UTM_LATITUDES_DEG = (-80.0, 84.0)
"""Smallest and largest latitude of the UTM grid [deg]."""

TURN_WORDS = {
    0.0: "",
    90.0: "a quarter turn clockwise",
    -90.0: "a quarter turn counter-clockwise",
    180.0: "half a turn",
}
"""Mountings of a sensor that are a cause of an offset: the offset [deg], and its words."""


class OffsetCause(NamedTuple):
    """A possible cause of an offset, and the directions of north that were compared.

    Attributes
    ----------
    text : the cause in words for the user; empty where no cause fits
    declination_deg : magnetic declination at the log's place and date, east positive [deg]; None where not known
    convergence_deg : UTM grid convergence at the log's place [deg], positive where grid north is east of true north;
        None where not known
    """

    text: str
    declination_deg: float | None
    convergence_deg: float | None


NO_CAUSE = OffsetCause("", None, None)
"""Cause of an offset without a possible cause."""


def find_offset_cause(offset_rad: float, sigma_rad: float, datum: Datum | None, stamp_ns: int) -> OffsetCause:
    """Return the possible cause of the offset of a heading, clockwise from north.

    Parameters
    ----------
    offset_rad : heading minus course over ground [rad]; a heading from magnetic north is less by the declination
    sigma_rad : standard deviation of the offset [rad]
    datum : place of the log; None: a metric reference without a known north
    stamp_ns : time of the log, Unix time [ns]
    """
    if not sigma_rad <= LIKE_RAD:
        return NO_CAUSE
    declination = _declination_deg(datum, stamp_ns) if datum is not None else None
    convergence = utm_convergence_deg(datum) if datum is not None else None
    norths, causes = [("", 0.0)], []
    for name, angle_deg in (("magnetic declination", declination), ("UTM grid convergence", convergence)):
        if angle_deg is not None and abs(angle_deg) > math.degrees(SMALLEST_CAUSE_RAD):
            norths.append((f"{name} here is {angle_deg:+z.1f}°", math.radians(angle_deg)))
    for turn, turn_text in TURN_WORDS.items():
        for north_text, north in norths:
            away = abs(math.remainder(offset_rad - math.radians(turn) + north, 2 * math.pi))
            texts = [text for text in (turn_text, north_text) if text]
            if away <= max(LIKE_RAD, 2.0 * sigma_rad) and texts:
                # Fewer causes are more likely; among equally many causes the closest ones are.
                causes.append((len(texts), away, " and ".join(texts)))
    return OffsetCause(min(causes)[2] if causes else "", declination, convergence)


def utm_convergence_deg(datum: Datum) -> float | None:
    """Return the angle from true to grid north [deg], clockwise; None outside UTM.

    Notes
    -----
    tan(gamma) = tan(longitude - central meridian) sin(latitude) (Snyder 1987, Map Projections, Eq. 8-20, on the
    sphere: right to 0.01 deg within a zone).
    """
    latitude, longitude = datum.latitude_deg, math.remainder(datum.longitude_deg, 360.0)
    if not UTM_LATITUDES_DEG[0] <= latitude <= UTM_LATITUDES_DEG[1]:
        return None
    meridian = 6.0 * math.floor(longitude / 6.0) + 3.0
    away = math.radians(longitude - meridian)
    return math.degrees(math.atan(math.tan(away) * math.sin(math.radians(latitude))))


def _declination_deg(datum: Datum, stamp_ns: int) -> float | None:
    """Return the declination by the World Magnetic Model [deg], east positive; None where it does not cover the date.

    Notes
    -----
    Package pygeomag computes the model (NOAA and British Geological Survey, World Magnetic Model).
    """
    from pygeomag import GeoMag

    day = datetime.fromtimestamp(stamp_ns / 1e9, UTC)
    year = day.year + (day.timetuple().tm_yday - 1) / 365.25
    try:
        model = GeoMag(base_year=day)
        return float(model.calculate(datum.latitude_deg, datum.longitude_deg, datum.height_m / 1e3, year).d)
    except ValueError:
        # Stamps that count from the robot's start give 1970: no date, and no model covers it.
        return None


DUAL_ANTENNA_TYPES = ("NavRELPOSNED", "DualAntennaHeading", "DUALANTENNAHEADING", "Heading2", "HEADING2")
"""Parts of the names of message types that state a heading by two antennas."""

SMALLEST_OFFSET_RAD = math.radians(1.0)
"""Smallest offset of a heading that is significant [rad]."""

OPPOSITE_SENSE = "the heading turns in the opposite sense to the course over ground"
"""Words of findings about a heading of the other convention."""

OTHER_CONVENTION = note(
    "heading_convention_contradicts", f"{OPPOSITE_SENSE}: set frames.heading to the other of enu and ned"
)
"""Finding about a heading whose convention the preset does not correct."""

OF_THE_SENSE = {"heading_convention_contradicts", "heading_convention_corrected"}
"""Codes of findings about the sense of a heading. The offset is stated in the same finding."""

SHARED_DIRECTION = 0.8
"""Mean resultant length of angles above which they have one direction."""

TURNED_ABOUT_SHARE = 0.8
"""Share of the windows in reverse in which the heading is turned about, above which the heading is a course over
ground."""

UNEXPLAINED_RAD = math.radians(40.0)
"""Scatter about the motion of wheels and fixes above which a heading is refused [rad]. A heading with half of this
scatter is used."""

STUCK_S = 5.0
"""Shortest time for which a stuck heading is constant [s]."""

STUCK_TURN_M = 0.3
"""Difference of the sides' distances in this time above which the robot turns [m]."""

STUCK_SHARE = 0.1
"""Share of the distance with a constant heading in turns above which the heading is stuck."""

TURN_M, TURN_SHARE = 1.0, 0.1
"""Distance over which a turn is looked for [m], and smallest difference of the sides as a share of it. Wheels of
unequal size make a smaller difference on a straight path."""


class CourseComparison(NamedTuple):
    """Heading and course over ground in windows of distance.

    Attributes
    ----------
    windows : number of windows
    agreement : mean resultant length of heading minus course over ground: 1 where they agree, about 0 at random, NaN
        without windows
    mirrored_agreement : agreement of a heading of the other handedness
    turns_about : the heading turns about where the robot drives backwards: it is itself a course over ground
    duration_s : median duration of a window [s]
    """

    windows: int
    agreement: float
    mirrored_agreement: float
    turns_about: bool
    duration_s: float


NOT_COMPARED = CourseComparison(0, math.nan, math.nan, False, 0.0)
"""Comparison of a drive without windows."""


def compare_with_course(windows: DriveWindows) -> CourseComparison:
    """Return the comparison of heading and course over ground of a drive, in windows that hardly overlap."""
    track, apart = windows.track, slice(None, None, STARTS_A_WINDOW)
    seen, laid, third_m = windows.seen[apart], windows.laid[apart], windows.length_m[apart] / 3
    gone, lasted_s = windows.over(track.at_places(track.mean_speed))[apart], windows.over(track.place_t)[apart]
    moved = (np.abs(seen) > third_m) & (np.abs(laid) > third_m)
    if not moved.any():
        return NOT_COMPARED
    # With a heading of the other handedness the displacement is mirrored about north.
    angle, turned_over = (
        np.exp(1j * np.angle(distances * np.conj(seen)))[moved] for distances in (laid, np.conj(laid))
    )
    backwards = (gone < 0.0)[moved]
    ahead, back = angle[~backwards], angle[backwards]
    turns_about = False
    if min(len(ahead), len(back)) >= FEWEST_ALIGNMENT_WINDOWS:
        about = (back * np.conj(ahead.mean())).real < 0.0
        turns_about = abs(ahead.mean()) > SHARED_DIRECTION and float(about.mean()) > TURNED_ABOUT_SHARE
    agreement, mirrored_agreement = float(abs(angle.mean())), float(abs(turned_over.mean()))
    return CourseComparison(
        len(angle), agreement, mirrored_agreement, bool(turns_about), float(np.median(lasted_s[moved]))
    )


def align_heading(
    log: RobotLog, config: Config, fit: AlignmentFit | None, comparison: CourseComparison, convention: StreamSigns,
    derived: DerivedHeading | None,
) -> tuple[HeadingFacts, float, list[Note]]:  # fmt: skip
    """Return the facts about the heading: its offset, its noise and its correction.

    Parameters
    ----------
    log, config : the log and the configuration
    fit : alignment with a sensor's heading; None without such a heading, or where the drive is too short
    comparison : comparison of this heading with the course over ground
    convention : the chosen convention of the streams
    derived : the heading where it was estimated, with every correction

    Returns
    -------
    facts for run.json; correlation time of a stated heading's noise where it was raised [s]; findings
    """
    corrects, mirrored = config.filter.rules.corrects, convention.heading < 0
    offset, std, scatter, applied, correlation_s = math.nan, math.nan, math.nan, 0.0, 0.0
    attitude = None if derived is None or derived.attitude is None else derived.estimate.offset
    cause, notes = NO_CAUSE, list[Note]()
    if corrects and config.frames.heading_offset_deg != "auto" and (derived is None or attitude is not None):
        applied = -math.radians(config.frames.heading_offset_deg)
    if fit is not None:
        turn, std = fit.estimate("offset")
        offset, scatter = math.remainder(-turn, 2 * math.pi), fit.angle_scatter_rad
        applied, cause, notes = _correction(log, config, fit, convention, (offset, std), applied)
    noisy = derived is None and corrects and scatter > NOISY_SCATTER_RAD
    if noisy:
        correlation_s = comparison.duration_s
        spread = f"by {math.degrees(scatter):.0f}° about the course over ground"
        notes.append(note("heading_scatters", f"the heading scatters {spread}: its noise is raised to that"))
    if attitude is not None:
        offset, std = attitude
        applied = offset
        text, cause = _offset_in_words(log, offset, std, mirrored=mirrored)
        notes = [finding for finding in notes if finding.code in OF_THE_SENSE]
        if not notes and _significant(offset, std):
            notes = [_offset_note(text, offset)]
    elif derived is not None:
        notes = [note("heading_estimated", f"the heading is estimated: {derived.why}")]
    stated_type = next((stream.message_type for stream in log.streams if stream.role == "heading"), "")
    by_antennas = any(name in stated_type for name in DUAL_ANTENNA_TYPES)
    source = "dual_antenna_message" if by_antennas else "orientation"
    facts = HeadingFacts(
        source=source if derived is None else derived.source,
        parts=None if derived is None else derived.why,
        windows=comparison.windows,
        applied_mirror=mirrored and corrects,
        offset_deg=finite_or_none(math.degrees(offset)),
        offset_std_deg=finite_or_none(math.degrees(std)),
        scatter_deg=finite_or_none(math.degrees(scatter)),
        applied_offset_deg=math.degrees(applied),
        applied_std_deg=math.degrees(scatter) if noisy else 0.0,
        std_deg=None if derived is None else finite_or_none(math.degrees(derived.estimate.median_causal_std)),
        offset_name=cause.text or None,
        magnetic_declination_deg=cause.declination_deg,
        utm_convergence_deg=cause.convergence_deg,
        agreement=finite_or_none(comparison.agreement),
        mirrored_agreement=finite_or_none(comparison.mirrored_agreement),
    )
    return facts, correlation_s, notes


def _correction(
    log: RobotLog,
    config: Config,
    fit: AlignmentFit,
    convention: StreamSigns,
    estimate: tuple[float, float],
    configured: float,
) -> tuple[float, OffsetCause, list[Note]]:
    """Return the angle to subtract from a stated heading [rad], the cause of its offset, and findings.

    Parameters
    ----------
    estimate : offset and its standard deviation [rad]
    configured : configured angle to subtract [rad]
    """
    offset, std = estimate
    mirrored, corrects = convention.heading < 0, config.filter.rules.corrects
    pose_mirrored = mirrored and convention.position < 0 and fit.windows.track.same_clock
    offset_text, cause = _offset_in_words(log, offset, std, mirrored=mirrored and not pose_mirrored)
    significant = _significant(offset - configured, std)
    applies = config.frames.heading_offset_deg == "auto" and corrects
    applied = offset if applies and (mirrored or significant) else configured
    notes = list[Note]()
    if mirrored and not corrects:
        notes.append(OTHER_CONVENTION)
    elif pose_mirrored:
        text = "the heading of the same poses is mirrored likewise: corrected; frames.heading sets it"
        notes.append(note("heading_mirrored", text))
    elif mirrored:
        yaw = f"its yaw is of the other convention (ENU/NED), offset {offset_text}"
        text = f"{OPPOSITE_SENSE}: {yaw}: applied; frames.heading sets it"
        notes.append(note("heading_convention_corrected", text))
    elif significant and applies:
        notes.append(_offset_note(offset_text, applied))
    elif significant:
        text = f"heading is {offset_text} off the course over ground; {-math.degrees(configured):+z.1f}° is applied"
        notes.append(note("heading_offset_differs", text))
    return applied, cause, notes


def _offset_in_words(log: RobotLog, offset: float, std: float, *, mirrored: bool) -> tuple[str, OffsetCause]:
    """Return an offset with its deviation in words, and its possible cause.

    Parameters
    ----------
    mirrored : the offset is the offset of a yaw of the other convention
    """
    rest = offset + math.pi / 2 if mirrored else offset
    cause = (
        find_offset_cause(rest, std, log.datum, int(log.wheels.stamp_ns[0])) if _significant(rest, std) else NO_CAUSE
    )
    words = f" ({cause.text})" if cause.text else ""
    return f"{math.degrees(math.remainder(rest, 2 * math.pi)):+z.1f}° ± {math.degrees(std):.1f}°{words}", cause


def _offset_note(text: str, applied: float) -> Note:
    """Return the finding about an offset, in words, that is corrected by `applied` [rad]."""
    done = f"{-math.degrees(applied):+z.1f}° is applied; frames.heading_offset_deg sets it"
    return note("heading_offset_corrected", f"heading is {text} off the course over ground: {done}")


def _significant(offset: float, std: float) -> bool:
    """Return whether an offset [rad] is larger than `SMALLEST_OFFSET_RAD` and than its uncertainty."""
    return abs(math.remainder(offset, 2 * math.pi)) > max(SMALLEST_OFFSET_RAD, EVIDENCE_SIGMAS * std)


def refuse_unexplained(log: RobotLog, fit: AlignmentFit | None, comparison: CourseComparison) -> None:
    """Raise where no convention and no offset make the heading follow the motion of wheels and fixes.

    A heading of the other convention that the configuration keeps also scatters. It is used, with a warning.

    Raises
    ------
    DataError
        The heading scatters by more than `UNEXPLAINED_RAD` about the motion, in either sense.
    """
    if (
        fit is not None
        and fit.heading_scatter_rad > UNEXPLAINED_RAD
        and not comparison.mirrored_agreement > SHARED_DIRECTION
    ):
        spread = min(math.degrees(fit.heading_scatter_rad), 180.0)
        tried = f"with ENU, NED and any offset it scatters by {spread:.0f}° ({len(fit.windows.begin)} windows)"
        raise _no_heading(log, "does not follow the course over ground", tried)


def refuse_stuck(log: RobotLog) -> None:
    """Raise where the heading stays constant over much of the distance while the wheels turn the robot.

    Raises
    ------
    DataError
        The heading is constant in turns for more than `STUCK_SHARE` of the distance.
    """
    stamps, heading, wheels = log.heading.stamp_ns, log.heading.heading_rad, log.wheels
    if len(stamps) < 2 or len(wheels.stamp_ns) < 2:
        return
    edges = np.concatenate([[0], np.flatnonzero(np.diff(heading) != 0) + 1, [len(stamps)]])
    begin, end = stamps[edges[:-1]], stamps[edges[1:] - 1]
    long = end - begin > STUCK_S * 1e9
    if not long.any():
        return
    interval = unbroken_intervals(np.diff(wheels.stamp_ns) / 1e9)
    left, right = wheels.v_left_mps[:-1] * interval, wheels.v_right_mps[:-1] * interval
    gone = np.concatenate([[0.0], np.cumsum(np.abs(left) + np.abs(right)) / 2])
    ahead = np.concatenate([[0.0], np.cumsum(left - right)])
    # A difference of the sides that is a small share of the distance does not count as a turn.
    later = np.minimum(np.searchsorted(gone, gone + TURN_M), len(gone) - 1)
    turns = np.abs(ahead[later] - ahead) >= TURN_SHARE * (gone[later] - gone)
    ahead = np.concatenate([[0.0], np.cumsum(np.where(turns[:-1], np.diff(ahead), 0.0))])
    rows = np.searchsorted(wheels.stamp_ns, np.column_stack([begin, end])[long])
    turning = [last > first and float(np.ptp(ahead[first:last])) > STUCK_TURN_M for first, last in rows.tolist()]
    constant = np.diff(gone[np.minimum(rows[turning], len(gone) - 1)]).sum()
    share = float(constant) / max(float(gone[-1]), 1e-9)
    if share > STUCK_SHARE:
        seconds = float((end - begin)[long][turning].sum()) / 1e9
        raise _no_heading(log, "stays the same while the wheels turn the robot", f"for {seconds:.0f} s in all")


def _no_heading(log: RobotLog, why: str, found: str) -> DataError:
    """Return the error about an unusable heading: the reason, what was found, and what the user can do."""
    advice = "choose another with topics.heading, or use this one with --set frames.heading_offset_deg=0"
    return DataError(log.name, " ".join(filter(None, ("the heading", log.topic("heading"), why))), f"{found}; {advice}")
