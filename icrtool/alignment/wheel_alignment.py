"""What is known of the wheels: scale, dead, copied and held encoders."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from icrtool.alignment.course_over_ground import (
    FEWEST_WINDOWS,
    Course,
)
from icrtool.records.tables import RobotLog, WheelSamples

SMALLEST_TURN_RAD = math.radians(20.0)

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
