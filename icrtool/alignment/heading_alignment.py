"""What is known of a heading beside the course over ground; headings that nothing explains are refused."""

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
)
from icrtool.alignment.heading_offset_cause import OffsetName
from icrtool.errors import DataError
from icrtool.records.tables import Floats, RobotLog

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
