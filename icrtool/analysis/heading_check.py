"""Hold the heading against the GNSS course on straight stretches: offset, convention, scatter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from icrtool.config import Config
from icrtool.tables import Bools, Floats, Ints, RobotLog

SHORTEST_CHORD_M = 0.5
CHORD_IN_GNSS_STD = 30.0
"""A course is taken over a chord this long, so that the fixes' noise turns it by about 2 deg at most."""

STRAIGHT_RAD = math.radians(5.0)
"""The heading changes less than this over a straight stretch."""

FEWEST_CHORDS = 8
SIGNIFICANT_SIGMAS = 4.0
SMALLEST_OFFSET_RAD = math.radians(2.0)
"""An offset is believed when it is this many of its standard deviations, and at least this large."""

EXPLAINED = 0.8
"""Mean resultant length of heading minus course above which they are one direction seen twice."""


@dataclass(frozen=True, slots=True)
class HeadingCheck:
    """What the comparison found.

    Attributes
    ----------
    chords : straight stretches compared
    offset_rad, offset_std_rad : heading minus course, robust circular mean; NaN when there was nothing to compare
    scatter_rad : robust standard deviation of the differences
    agreement, mirrored_agreement : mean resultant length of heading minus course, as given and turned the other way
    applied_offset_rad : what `fit` subtracts
    applied_std_rad : the least noise `fit` gives the heading
    """

    chords: int
    offset_rad: float
    offset_std_rad: float
    scatter_rad: float
    agreement: float
    mirrored_agreement: float
    applied_offset_rad: float
    applied_std_rad: float
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
            "chords": self.chords,
            **numbers,
            "agreement": self.agreement if math.isfinite(self.agreement) else None,
            "mirrored_agreement": self.mirrored_agreement if math.isfinite(self.mirrored_agreement) else None,
        }


def check_heading(log: RobotLog, config: Config) -> HeadingCheck:
    """Compare the heading of a log with its GNSS course.

    The offset is applied where ``frames.heading_offset_deg`` is ``auto``, the preset is not ``paper`` and the offset is
    significant; a number there is applied as it is.
    """
    given = config.frames.heading_offset_deg
    paper = config.filter.preset == "paper"
    fixed = 0.0 if paper or given == "auto" else math.radians(given)
    heading, course = straight_courses(log)
    if len(heading) < FEWEST_CHORDS:
        return HeadingCheck(len(heading), math.nan, math.nan, math.nan, math.nan, math.nan, fixed, 0.0, ())
    difference = heading - course
    agreement = abs(np.exp(1j * difference).mean())
    mirrored = abs(np.exp(1j * (-heading - course)).mean())
    offset, scatter = robust_direction(difference)
    sigma = scatter / math.sqrt(len(difference))
    warnings: list[str] = []
    applied, raised = fixed, 0.0
    text = f"heading is {math.degrees(offset):+.1f}° ± {math.degrees(sigma):.1f}° off the GNSS course ({len(difference)} straight stretches)"
    if agreement < EXPLAINED and mirrored >= EXPLAINED:
        warnings.append(
            f"{log.name}: the heading turns the other way than the GNSS course; set frames.heading to the other of enu and ned"
        )
    elif agreement < EXPLAINED:
        warnings.append(
            f"{log.name}: the heading does not follow the GNSS course (agreement {agreement:.2f} of 1); the ICRs cannot be trusted"
        )
    elif abs(offset - fixed) > max(SMALLEST_OFFSET_RAD, SIGNIFICANT_SIGMAS * sigma):
        if given == "auto" and not paper:
            applied = offset
            warnings.append(f"{log.name}: {text}: applied; --set frames.heading_offset_deg=… fixes it")
        else:
            warnings.append(f"{log.name}: {text}, {math.degrees(fixed):+.1f}° is applied")
    stated = float(np.nanmedian(np.append(np.sqrt(log.heading.var_rad2), math.nan))) if len(log.heading.stamp_ns) else math.nan
    usual = max(stated if math.isfinite(stated) else 0.0, math.radians(config.filter.heading_std_deg))
    if not paper and agreement >= EXPLAINED and scatter > 3.0 * max(usual, SMALLEST_OFFSET_RAD):
        raised = scatter
        warnings.append(
            f"{log.name}: the heading scatters by {math.degrees(scatter):.0f}° about the GNSS course, "
            f"it claims {math.degrees(usual):.1f}°: its noise is raised to that"
        )
    return HeadingCheck(
        len(difference), offset, sigma, scatter, float(agreement), float(mirrored), applied, raised, tuple(warnings)
    )


def robust_direction(angles: Floats) -> tuple[float, float]:
    """Return the centre (mean, then median of what is left) and the robust standard deviation of angles [rad]."""
    centre = float(np.angle(np.exp(1j * angles).mean()))
    for _ in range(2):
        residual = np.angle(np.exp(1j * (angles - centre)))
        centre += float(np.median(residual))
    residual = np.angle(np.exp(1j * (angles - centre)))
    return math.remainder(centre, 2 * math.pi), 1.4826 * float(np.median(np.abs(residual)))


def straight_courses(log: RobotLog) -> tuple[Floats, Floats]:
    """Return heading and course [rad, clockwise from north] over straight stretches, reversing taken into account.

    A stretch is a chord between two fixes, walked through the log one after the other; the body's heading is the
    mean over it, and it counts when wheels and heading say it was straight.
    """
    gnss, heading, wheels = log.gnss, log.heading, log.wheels
    if min(len(gnss.stamp_ns), len(heading.stamp_ns), len(wheels.stamp_ns)) < 2:  # noqa: PLR2004 - an interval
        return np.empty(0), np.empty(0)
    variance = gnss.var_north_m2 + gnss.var_east_m2
    known = variance[np.isfinite(variance)]
    noise = math.sqrt(float(np.median(known)) / 2) if len(known) else 0.01
    begin, end = _chords(gnss.north_m, gnss.east_m, max(SHORTEST_CHORD_M, CHORD_IN_GNSS_STD * noise))
    if not len(begin):
        return np.empty(0), np.empty(0)
    t_begin, t_end = gnss.stamp_ns[begin], gnss.stamp_ns[end]
    north, east = gnss.north_m[end] - gnss.north_m[begin], gnss.east_m[end] - gnss.east_m[begin]
    unwrapped = np.unwrap(heading.heading_rad)
    mean, spread = _mean_and_spread(heading.stamp_ns, unwrapped, t_begin, t_end)
    travel_left = _integral_at(wheels.stamp_ns, wheels.v_left_mps, t_begin, t_end)
    travel_right = _integral_at(wheels.stamp_ns, wheels.v_right_mps, t_begin, t_end)
    travel = (travel_left + travel_right) / 2
    chord = np.hypot(north, east)
    straight = _is_straight(spread, travel, travel_left - travel_right, chord, t_end - t_begin)
    course = np.arctan2(east, north) + np.where(travel < 0, math.pi, 0.0)
    return mean[straight], course[straight]


def _is_straight(spread: Floats, travel: Floats, turn: Floats, chord: Floats, duration_ns: Ints) -> Bools:
    """Say which chords were driven straight: little turn by heading and wheels, wheels and chord about as long."""
    typical = float(np.median(np.abs(travel))) if len(travel) else 0.0
    moved = np.abs(travel) > 0.3 * typical
    quick = duration_ns < 20e9  # noqa: PLR2004 - a chord over an outage is no course
    calm = (spread < STRAIGHT_RAD) | (spread <= np.percentile(spread, 20))
    unturned = np.abs(turn) < 0.1 * np.maximum(np.abs(travel), 1e-9)
    return moved & quick & calm & unturned & (chord > 0)


def _chords(north: Floats, east: Floats, length: float) -> tuple[Ints, Ints]:
    """Return begin and end rows of successive chords of at least `length` [m]."""
    begin, end, last = [], [], 0
    step = np.hypot(np.diff(north), np.diff(east))
    if float(step.sum()) < length:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    for i in range(1, len(north)):
        if (north[i] - north[last]) ** 2 + (east[i] - east[last]) ** 2 >= length * length:
            begin.append(last)
            end.append(i)
            last = i
    return np.array(begin, np.int64), np.array(end, np.int64)


def _integral_at(stamps: Ints, speed: Floats, begin: Ints, end: Ints) -> Floats:
    """Return the integral of a held speed [m/s] between stamps [ns]."""
    travel = np.concatenate([[0.0], np.cumsum(speed[:-1] * np.diff(stamps) / 1e9)])
    return np.interp(end, stamps, travel) - np.interp(begin, stamps, travel)


def _mean_and_spread(stamps: Ints, values: Floats, begin: Ints, end: Ints) -> tuple[Floats, Floats]:
    """Return mean and standard deviation of samples between stamps [ns]; NaN where there is none."""
    first, last = np.searchsorted(stamps, begin), np.searchsorted(stamps, end, side="right")
    count = np.maximum(last - first, 1)
    # Sums are taken about the first sample of each stretch, so that a heading that wound up over hours loses nothing.
    centred = values - values[0]
    sums, squares = np.concatenate([[0.0], np.cumsum(centred)]), np.concatenate([[0.0], np.cumsum(centred**2)])
    mean = (sums[last] - sums[first]) / count
    variance = np.maximum((squares[last] - squares[first]) / count - mean**2, 0.0)
    empty = last <= first
    return np.where(empty, np.nan, mean + values[0]), np.where(empty, np.inf, np.sqrt(variance))
