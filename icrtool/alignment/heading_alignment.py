"""Hold the heading against the way that position tells: offset, convention, scatter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from icrtool.alignment.course_over_ground import (
    EXPLAINED,
    FEWEST_WINDOWS,
    Course,
    known_intervals,
    measure_course,
    offset_at_no_curvature,
)
from icrtool.alignment.heading_offset_cause import NO_NAME, OffsetName, name_offset
from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.records.tables import Floats, RobotLog

SIGNIFICANT_SIGMAS = 4.0
SMALLEST_OFFSET_RAD = math.radians(2.0)
"""An offset is believed when it is this many of its standard deviations, and at least this large."""

CLEARLY_BETTER, CLEARLY_AWAY = 3.0, 0.02
"""By 1 - mean resultant length: on rows to and fro the other convention looks like an offset but for the turns."""

NEAR_RAD, NEAR_SHARE = math.radians(45.0), 0.6
"""A heading without agreement is none at all when no offset brings this share of the windows this near to the course:
outliers among the fixes spoil some windows, not most."""

STUCK_S, STUCK_TURN_M, STUCK_SHARE = 5.0, 0.3, 0.1
"""A heading that stays the very same for so long, while one side goes so far ahead of the other, over so much of the
way, is stuck."""

STUCK_WAY_M, WHEELS_OFF = 1.0, 0.1
"""A side that goes ahead by less than this part of the way, over so much of it, does not show a turn: wheels of unequal
size do so on a straight row."""


NOISY_SCATTER_RAD = math.radians(6.0)
"""Scatter about the course, beyond what the fixes explain, above which the heading's noise is raised to it."""


@dataclass(frozen=True, slots=True)
class HeadingCheck:
    """What the comparison found.

    Attributes
    ----------
    windows : stretches of way compared
    offset_rad, offset_std_rad : heading minus course at no curvature; NaN when there was nothing to compare
    scatter_rad : robust standard deviation of the differences
    agreement, mirrored_agreement : mean resultant length of heading minus course, as given and turned the other way
    applied_mirror : `fit` takes the heading turned the other way
    applied_offset_rad : what `fit` subtracts, after that
    name : what a significant offset may come from
    applied_std_rad, applied_correlation_s : the least noise, and how long it errs alike, that `fit` gives the heading
    """

    windows: int
    offset_rad: float
    offset_std_rad: float
    scatter_rad: float
    agreement: float
    mirrored_agreement: float
    applied_mirror: bool
    applied_offset_rad: float
    applied_std_rad: float
    applied_correlation_s: float
    name: OffsetName
    warnings: tuple[str, ...]

    def summary(self) -> dict[str, Any]:
        """Return the numbers for run.json, angles in degrees, None for what is not known."""
        degrees = {
            "offset_deg": self.offset_rad,
            "offset_std_deg": self.offset_std_rad,
            "scatter_deg": self.scatter_rad,
            "applied_offset_deg": self.applied_offset_rad,
            "applied_std_deg": self.applied_std_rad,
        }
        numbers = {name: math.degrees(value) if math.isfinite(value) else None for name, value in degrees.items()}
        return {
            "windows": self.windows,
            "applied_mirror": self.applied_mirror,
            **numbers,
            **self.name.summary(),
            "agreement": self.agreement if math.isfinite(self.agreement) else None,
            "mirrored_agreement": self.mirrored_agreement if math.isfinite(self.mirrored_agreement) else None,
        }


def check_heading(log: RobotLog, config: Config, course: Course | None = None) -> HeadingCheck:
    """Compare the heading of a log with the way its fixes tell.

    The offset is applied where ``frames.heading_offset_deg`` is ``auto``, the preset is not ``paper`` and the offset is
    significant; a number there is applied as it is.

    Parameters
    ----------
    course : `measure_course` of the log, where it is at hand

    Raises
    ------
    DataError
        A heading that has nothing to do with the course, whatever its convention and offset (``auto`` only).

    Notes
    -----
    Over each window the wheels' speed is laid along the measured heading and summed; the angle from there to the
    displacement of the fixes is the heading's offset, plus a part proportional to the curvature (the antenna's lever
    arm and x_icr make the antenna crab in turns). A robust line through angle over curvature separates the two.
    """
    given = config.frames.heading_offset_deg
    paper = config.filter.preset == "paper"
    fixed = 0.0 if paper or given == "auto" else math.radians(given)
    course = course if course is not None else measure_course(log)
    free = given == "auto" and not paper
    if free:
        refuse_stuck(log)
        refuse_unexplained(log, course)
    if len(course.angle) < FEWEST_WINDOWS:
        return HeadingCheck(len(course.angle), *(math.nan,) * 5, False, fixed, 0.0, 0.0, NO_NAME, ())
    agreement, mirrored = course.agreement, course.mirrored_agreement
    turned_over = _turns_other_way(agreement, mirrored) and config.frames.heading == "auto" and not paper
    angle, curvature = (course.mirrored, -course.curvature) if turned_over else (course.angle, course.curvature)
    offset, sigma, scatter = offset_at_no_curvature(angle, curvature)
    # A handful of windows may agree by chance, better than their fixes allow.
    sigma *= max(1.0, course.white_rad / max(scatter, 1e-9))
    own_scatter = math.sqrt(max(scatter**2 - course.noise_rad**2, 0.0))
    rest = offset + math.pi / 2 if turned_over else offset
    begin = int(log.wheels.stamp_ns[0])
    name = name_offset(rest, sigma, log.datum, begin) if _is_significant(rest, sigma) else NO_NAME
    cause = f" ({name.text})" if name.text else ""
    text = f"{math.degrees(math.remainder(rest, 2 * math.pi)):+.1f}° ± {math.degrees(sigma):.1f}°"
    applied, warnings = fixed, _disagreement(agreement, mirrored)
    if turned_over:
        applied = offset if given == "auto" else fixed
        warnings = [_name_turned_over(text + cause, len(angle))]
    elif not warnings:
        applied, warnings = _choose_offset(text, offset, sigma, fixed, cause, free=free)
    noisy = (agreement >= EXPLAINED or turned_over) and own_scatter > NOISY_SCATTER_RAD and not paper
    if noisy:
        warnings.append(_name_scatter(own_scatter))
    return HeadingCheck(
        windows=len(angle),
        offset_rad=offset,
        offset_std_rad=sigma,
        scatter_rad=own_scatter,
        agreement=agreement,
        mirrored_agreement=mirrored,
        applied_mirror=turned_over,
        applied_offset_rad=applied,
        # The scatter is that of window means: the heading errs alike for as long as a window lasts.
        applied_std_rad=own_scatter if noisy else 0.0,
        applied_correlation_s=course.duration_s if noisy else 0.0,
        name=name,
        warnings=tuple(f"{log.name}: {warning}" for warning in warnings),
    )


def _turns_other_way(agreement: float, mirrored: float) -> bool:
    """Say whether a heading clearly follows the course only when it is turned the other way."""
    better = 1.0 - agreement > max(CLEARLY_AWAY, CLEARLY_BETTER * (1.0 - mirrored))
    return mirrored >= EXPLAINED and (agreement < EXPLAINED or better)


def _disagreement(agreement: float, mirrored: float) -> list[str]:
    """Say that a heading does not follow the course as it is given, where it does not."""
    if _turns_other_way(agreement, mirrored):
        return ["the heading turns the other way than the course: set frames.heading to the other of enu and ned"]
    text = f"the heading does not follow the course (agreement {agreement:.2f} of 1): do not trust the ICRs"
    return [] if agreement >= EXPLAINED else [text]


def refuse_unexplained(log: RobotLog, course: Course) -> None:
    """Raise where the heading points nowhere, or no convention and no offset makes it follow the course."""
    windows = len(course.angle)
    if course.scattered >= FEWEST_WINDOWS and course.scattered > windows:
        raise _no_heading(
            log, "scatters so much that it points nowhere", f"in {course.scattered} of the windows it was averaged over"
        )
    if windows < FEWEST_WINDOWS or max(_near_share(course.angle), _near_share(course.mirrored)) >= NEAR_SHARE:
        return
    best = max(course.agreement, course.mirrored_agreement)
    if best < EXPLAINED:
        spread = math.degrees(math.sqrt(-2.0 * math.log(max(best, 1e-3))))
        tried = f"ENU, NED and every offset tried in {windows} windows, scatter {spread:.0f}° at best"
        raise _no_heading(log, "has nothing to do with the course", tried)


def refuse_stuck(log: RobotLog) -> None:
    """Raise where the heading stays the very same over much of the way while the wheels turn the robot."""
    stamps, heading, wheels = log.heading.stamp_ns, log.heading.heading_rad, log.wheels
    if len(stamps) < 2 or len(wheels.stamp_ns) < 2:
        return
    edges = np.concatenate([[0], np.flatnonzero(np.diff(heading) != 0) + 1, [len(stamps)]])
    begin, end = stamps[edges[:-1]], stamps[edges[1:] - 1]
    long = end - begin > STUCK_S * 1e9
    if not long.any():
        return
    interval = known_intervals(wheels)
    left, right = wheels.v_left_mps[:-1] * interval, wheels.v_right_mps[:-1] * interval
    way = np.concatenate([[0.0], np.cumsum(np.abs(left) + np.abs(right)) / 2])
    ahead = _clearly_ahead(np.concatenate([[0.0], np.cumsum(left - right)]), way)
    rows = np.searchsorted(wheels.stamp_ns, np.column_stack([begin, end])[long])
    turning = [last > first and float(np.ptp(ahead[first:last])) > STUCK_TURN_M for first, last in rows.tolist()]
    gone = np.diff(way[np.minimum(rows[turning], len(way) - 1)]).sum()
    share = float(gone) / max(float(way[-1]), 1e-9)
    if share > STUCK_SHARE:
        seconds = float((end - begin)[long][turning].sum()) / 1e9
        raise _no_heading(log, "stays the same while the wheels turn the robot", f"for {seconds:.0f} s in all")


def _clearly_ahead(ahead: Floats, way: Floats) -> Floats:
    """Return `ahead` (n,) [m] without what it gains where it gains too little of `way` (n,) [m] to be a turn."""
    later = np.minimum(np.searchsorted(way, way + STUCK_WAY_M), len(way) - 1)
    turning = np.abs(ahead[later] - ahead) >= WHEELS_OFF * (way[later] - way)
    return np.concatenate([[0.0], np.cumsum(np.where(turning[:-1], np.diff(ahead), 0.0))])


def _no_heading(log: RobotLog, why: str, found: str) -> DataError:
    topic = next((f" {stream.topic}" for stream in log.streams if stream.role == "heading"), "")
    advice = "choose another with topics.heading, or go on with --set frames.heading_offset_deg=0"
    return DataError(log.name, f"the heading{topic} {why}", f"{found}; {advice}")


def _near_share(angle: Floats) -> float:
    """Return the largest share of angles within `NEAR_RAD` of one of 16 directions."""
    directions = np.arange(16) * math.pi / 8
    away = np.abs(np.angle(np.exp(1j * (angle[:, None] - directions))))
    return float((away < NEAR_RAD).mean(axis=0).max())


def _is_significant(offset: float, sigma: float) -> bool:
    return abs(math.remainder(offset, 2 * math.pi)) > max(SMALLEST_OFFSET_RAD, SIGNIFICANT_SIGMAS * sigma)


def _choose_offset(
    text: str, offset: float, sigma: float, fixed: float, cause: str, *, free: bool
) -> tuple[float, list[str]]:
    """Return the offset to apply, and what to say about it."""
    if not _is_significant(offset - fixed, sigma):
        return fixed, []
    if free:
        return offset, [f"heading is {text} off the course{cause}: applied; frames.heading_offset_deg sets it"]
    return fixed, [f"heading is {text} off the course{cause}, {math.degrees(fixed):+.1f}° is applied"]


def _name_turned_over(rest: str, windows: int) -> str:
    """Say what a heading that turns the other way most likely is: yaw read in the other of ENU and NED."""
    return (
        f"the heading turns the other way than the course ({windows} windows): "
        f"its yaw is of the other convention (ENU/NED), offset {rest}: applied; frames.heading sets it"
    )


def _name_scatter(scatter: float) -> str:
    return (
        f"the heading scatters by {math.degrees(scatter):.0f}° about the course, over whole windows: "
        "its noise is raised accordingly"
    )
