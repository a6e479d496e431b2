"""Hold the wheels against the way that position and heading tell: sides, signs, scale, dead and held encoders."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from icrtool.alignment.course_over_ground import (
    EXPLAINED,
    FEWEST_WINDOWS,
    Course,
    measure_course,
    offset_at_no_curvature,
)
from icrtool.config import Config
from icrtool.records.tables import Floats, RobotLog, WheelSamples

SMALLEST_SCALE_ERROR = 0.02
SIGNIFICANT_SIGMAS = 5.0
FEWEST_SCALE_WINDOWS = 20
LARGEST_SCALE_CORRECTION = 0.15
LARGEST_SCALE_SCATTER = 0.04
"""A scale error is taken out when it is this large, this certain, not larger than tyres and soil explain, and the same
all along the way: one that comes and goes is slip, or held samples, and no radius."""

FACTOR_TWO_TOLERANCE = 0.04
"""A factor two (diameter for radius, counts on both edges) is as certain as a small error when it is this exact."""

CLEAR_CORRELATION, WHOLE_CORRELATION = 0.5, 0.9
CONVENTION_TOLD = 20.0
"""One convention of the heading is clearly the better one from this ratio on: about twice that of log likelihoods."""

SMALLEST_TURN_RAD = math.radians(20.0)
MOSTLY_BACKWARDS = 0.8
LONGEST_DRIVE_NS = 30 * 86_400 * 1_000_000_000
"""A month: stamps further apart are damaged, and seconds between them would fill the memory."""

NEVER_MOVES_SHARE = 0.02
HELD_SHARE = 0.65
"""Share of wheel samples that repeat the one before, while moving, from which on the values count as held."""


@dataclass(frozen=True, slots=True)
class WheelCheck:
    """What the comparison found, and the log with what was certain put right.

    Attributes
    ----------
    scale, scale_std : way by the position reference per way by the wheels; NaN when it could not be told
    applied_scale : what both sides were multiplied with
    held_share : share of samples, while moving, that repeat the one before
    """

    log: RobotLog
    scale: float
    scale_std: float
    applied_scale: float
    held_share: float
    warnings: tuple[str, ...]
    course: Course | None

    def summary(self) -> dict[str, Any]:
        """Return the numbers for run.json."""
        known = math.isfinite(self.scale)
        return {
            "scale": self.scale if known else None,
            "scale_std": self.scale_std if known else None,
            "applied_scale": self.applied_scale,
            "held_share": self.held_share,
        }


def check_wheels(log: RobotLog, config: Config) -> WheelCheck:
    """Look for what wheel data get wrong; put right what is certain, in preset ``field`` only.

    Sides that are swapped, a side or both that count backwards, and a common scale error (``wheels.left_scale`` and
    ``wheels.right_scale`` left on ``auto``) are corrected and said; the rest is said.
    """
    corrects = config.filter.preset == "field"
    notes = [f"{log.name}: {note}" for note in dead_or_copied(log)]
    sound = not notes
    course = measure_course(log)
    found = _reversed_or_swapped(log, course)
    if found is not None:
        wheels, note = found
        notes.append(f"{log.name}: {note}{': put right' if corrects else ''}")
        if corrects:
            log = replace(log, wheels=wheels)
            course = measure_course(log)
    scale, sigma, scatter = _scale(course)
    applied = 1.0
    error = abs(scale - 1.0)
    # A heading that scatters makes the way along it shorter by half its variance.
    significant = error > max(SMALLEST_SCALE_ERROR, SIGNIFICANT_SIGMAS * sigma, _angle_scatter(course) ** 2)
    if significant and len(course.ratio) >= FEWEST_SCALE_WINDOWS:
        text = f"the robot goes {100 * scale:.1f} ± {100 * sigma:.1f} % of the way the wheels tell"
        given = config.wheels.left_scale != "auto" or config.wheels.right_scale != "auto"
        plausible = error <= LARGEST_SCALE_CORRECTION or _near_factor_two(scale)
        if corrects and sound and not given and plausible and scatter <= LARGEST_SCALE_SCATTER:
            applied = scale
            wheels = log.wheels
            log = replace(
                log,
                wheels=WheelSamples(wheels.stamp_ns, scale * wheels.v_left_mps, scale * wheels.v_right_mps),
            )
            notes.append(f"{log.name}: {text}{_likely(scale)}: taken out; wheels.left_scale and right_scale set it")
        else:
            notes.append(f"{log.name}: {text}: check wheel radius, encoder resolution and units{_likely(scale)}")
    held = held_share(log.wheels)
    notes += [f"{log.name}: {note}" for note in held_note(log.wheels, held)]
    return WheelCheck(log, scale, sigma, applied, held, tuple(notes), course if applied == 1.0 else None)


def _scale(course: Course) -> tuple[float, float, float]:
    """Return way by reference over way by wheels at no curvature, its standard deviation and its scatter, or NaN."""
    if len(course.ratio) < FEWEST_WINDOWS or course.agreement < EXPLAINED:
        return math.nan, math.nan, math.nan
    # log ratios are small: the angle fit's arithmetic (robust line over curvature) serves them unchanged
    offset, sigma, scatter = offset_at_no_curvature(np.log(course.ratio), course.curvature)
    return math.exp(offset), sigma * math.exp(offset), scatter


def _angle_scatter(course: Course) -> float:
    """Return the robust scatter of heading against course [rad], about its middle."""
    if not len(course.angle):
        return 0.0
    away = np.angle(np.exp(1j * course.angle) * np.conj(np.exp(1j * course.angle).mean()))
    return 1.4826 * float(np.median(np.abs(away)))


def _near_factor_two(scale: float) -> bool:
    return any(abs(scale / value - 1.0) < FACTOR_TWO_TOLERANCE for value in (0.5, 2.0))


def _likely(scale: float) -> str:
    for value, cause in ((0.5, "twice"), (2.0, "half")):
        if abs(scale / value - 1.0) < LARGEST_SCALE_CORRECTION:
            return f" (the wheels tell {cause} the way)"
    return ""


def dead_or_copied(log: RobotLog) -> list[str]:
    """Say when a side never moves while the other does, or is a copy of the other while the robot turns."""
    left, right = log.wheels.v_left_mps, log.wheels.v_right_mps
    way_left, way_right = float(np.abs(left).sum()), float(np.abs(right).sum())
    most = max(way_left, way_right)
    if most == 0.0:
        return []
    if min(way_left, way_right) < NEVER_MOVES_SHARE * most:
        side = "left" if way_left < way_right else "right"
        meaning = "the ICRs mean nothing then; topics.wheels chooses others"
        return [f"the {side} wheels hardly ever move: is their encoder dead? {meaning}"]
    if np.array_equal(left, right) and float(np.ptp(np.unwrap(log.heading.heading_rad))) > SMALLEST_TURN_RAD:
        return ["left and right wheels tell the same all the time while the robot turns: one is a copy of the other"]
    return []


def _reversed_or_swapped(log: RobotLog, course: Course) -> tuple[WheelSamples, str] | None:
    """Return the wheels put right, and what was wrong with them; None when nothing clearly is."""
    wheels = log.wheels
    left, right = wheels.v_left_mps, wheels.v_right_mps
    if not course.is_explained:
        return _one_side_reversed(log)
    sum_way = float((left + right)[left + right > 0].sum()), -float((left + right)[left + right < 0].sum())
    backwards = sum_way[1] / max(sum(sum_way), 1e-12)
    away = abs(float(np.angle(np.exp(1j * course.angle).mean())))
    if course.agreement >= EXPLAINED and away > math.radians(150) and backwards > MOSTLY_BACKWARDS:
        return WheelSamples(wheels.stamp_ns, -left, -right), "both wheels count backwards"
    correlation = _turn_correlation(log, mirrored=_mirrored(course))
    if correlation is not None and correlation < -CLEAR_CORRELATION and _tells_convention(course):
        return WheelSamples(wheels.stamp_ns, right, left), "left and right wheels are swapped"
    return None


def _turn_correlation(log: RobotLog, *, mirrored: bool) -> float | None:
    """Return how heading turns and left going ahead of right correlate; None where there are too few turns."""
    turned, told = _turns(log)
    tells = len(turned) >= FEWEST_WINDOWS and float(np.ptp(told)) > 0 and float(np.ptp(turned)) > 0
    if not tells or float(np.abs(turned).sum()) <= SMALLEST_TURN_RAD:
        return None
    return float(np.corrcoef(-turned if mirrored else turned, told)[0, 1])


def _mirrored(course: Course) -> bool:
    """Say whether the heading follows the course only when it is turned the other way."""
    return course.mirrored_agreement > course.agreement


def _tells_convention(course: Course) -> bool:
    """Say whether the windows tell at all which way the heading turns: a nearly straight drive does not."""
    agreement, mirrored = course.agreement, course.mirrored_agreement
    return len(course.angle) * abs(agreement - mirrored) > CONVENTION_TOLD * (1.0 - max(agreement, mirrored))


def _one_side_reversed(log: RobotLog) -> tuple[WheelSamples, str] | None:
    """Look for a side that counts backwards: then the sides cancel, and their difference makes the way.

    Spins on the spot have no way either, but there the difference makes the turn.
    """
    wheels = log.wheels
    left, right = wheels.v_left_mps, wheels.v_right_mps
    correlation = _turn_correlation(log, mirrored=False)
    if correlation is not None and abs(correlation) > WHOLE_CORRELATION:
        return None
    for name, one in (
        ("left", WheelSamples(wheels.stamp_ns, -left, right)),
        ("right", WheelSamples(wheels.stamp_ns, left, -right)),
    ):
        changed = replace(log, wheels=one)
        course = measure_course(changed)
        if not course.is_explained:
            continue
        # Either side turned over makes a way; the wrong one is driven backwards, and turns the other way.
        correlation = _turn_correlation(changed, mirrored=_mirrored(course))
        forwards = abs(float(np.angle(np.exp(1j * course.angle).mean()))) < math.radians(90)
        if forwards if correlation is None else correlation > CLEAR_CORRELATION:
            return one, f"the {name} wheels count backwards"
    return None


def _turns(log: RobotLog) -> tuple[Floats, Floats]:
    """Return, over seconds, how far the heading turned [rad] and how far left went ahead of right [m]."""
    wheels, heading = log.wheels, log.heading
    begin, end = max(wheels.stamp_ns[0], heading.stamp_ns[0]), min(wheels.stamp_ns[-1], heading.stamp_ns[-1])
    if end - begin > LONGEST_DRIVE_NS:
        return np.empty(0), np.empty(0)
    edges = np.arange(begin, end, 1_000_000_000)
    interval = np.diff(wheels.stamp_ns) / 1e9
    ahead = np.concatenate([[0.0], np.cumsum((wheels.v_left_mps - wheels.v_right_mps)[:-1] * interval)])
    turned = np.diff(np.interp(edges, heading.stamp_ns, np.unwrap(heading.heading_rad)))
    told = np.diff(np.interp(edges, wheels.stamp_ns, ahead))
    moved = (told != 0) | (turned != 0)
    return turned[moved], told[moved]


def held_share(wheels: WheelSamples) -> float:
    """Return the share of samples, while moving, that repeat the one before on both sides."""
    left, right = wheels.v_left_mps, wheels.v_right_mps
    moving = (np.abs(left) + np.abs(right))[1:] > 0
    if np.count_nonzero(moving) < FEWEST_WINDOWS:
        return 0.0
    same = (np.diff(left) == 0) & (np.diff(right) == 0)
    return float(np.count_nonzero(same & moving) / np.count_nonzero(moving))


def held_note(wheels: WheelSamples, share: float) -> list[str]:
    """Say how often held wheel values change."""
    if share <= HELD_SHARE:
        return []
    rate = (1.0 - share) * 1e9 / float(np.median(np.diff(wheels.stamp_ns)))
    return [f"wheel values are held: they change {rate:.1f} times a second while moving"]
