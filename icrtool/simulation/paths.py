"""Paths: speed and turn rate of the body over time, and the track speeds that a robot of known ICRs needs for them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from icrtool.kernels.arrays import Floats

PathKind = Literal["circle", "curved", "lawnmower", "figure-eight", "spins", "straight"]

CURVED_SWINGS = ((0.8, 1.4), (0.2, 3.0))
"""Share of the curvature, and length in radii per radian, of the two oscillations of path ``curved``: the heading
varies by up to 1.7 rad, without a short period."""


@dataclass(frozen=True, slots=True)
class PathPlan:
    """A path of the body.

    Attributes
    ----------
    kind : ``circle`` (clockwise), ``curved`` (left and right), ``lawnmower`` (legs joined by half circles, right and
        left in turn), ``figure-eight`` (whole circles, right and left in turn), ``spins`` (whole turns on the spot,
        right and left in turn) or ``straight``
    speed_mps : speed of the body; of the faster track where the body stands (``spins``, ``circle`` of radius 0)
    radius_m : of circles and of the tightest bend; a lawnmower's legs are two radii apart
    leg_m : length of a lawnmower's legs
    phase_rad : phase of the oscillations of ``curved`` at the start
    """

    kind: PathKind = "curved"
    speed_mps: float = 0.4
    radius_m: float = 1.0
    leg_m: float = 20.0
    phase_rad: float = 0.0


def plan_body(path: PathPlan, t: Floats, icrs_m: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return forward velocity [m/s] and turn rate [rad/s], clockwise positive, at times t (n,) [s]; (n,) each."""
    speed = np.full(len(t), path.speed_mps)
    distance = path.speed_mps * t
    if path.kind == "spins" or (path.kind == "circle" and path.radius_m == 0):
        turn = np.full(len(t), path.speed_mps / max(abs(icrs_m[0]), abs(icrs_m[1])))
        whole_turns = np.floor(turn * t / (2 * math.pi))
        return np.zeros(len(t)), turn if path.kind == "circle" else np.where(whole_turns % 2 == 0, turn, -turn)
    if path.kind == "straight":
        return speed, np.zeros(len(t))
    if path.kind == "circle":
        return speed, speed / path.radius_m
    if path.kind == "figure-eight":
        lap = np.floor(distance / (2 * math.pi * path.radius_m))
        return speed, np.where(lap % 2 == 0, 1.0, -1.0) * speed / path.radius_m
    if path.kind == "lawnmower":
        lap, within = np.divmod(distance, path.leg_m + math.pi * path.radius_m)
        bend = np.where(lap % 2 == 0, 1.0, -1.0) * speed / path.radius_m
        return speed, np.where(within < path.leg_m, 0.0, bend)
    swing = sum(
        share * np.cos(distance / (length * path.radius_m) + path.phase_rad * (number + 1))
        for number, (share, length) in enumerate(CURVED_SWINGS)
    )
    return speed, swing * speed / path.radius_m


def track_speeds(forward: Floats, turn: Floats, icrs_m: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return left and right track speeds [m/s] that give a forward velocity and a turn rate: Eqs. 8 and 10 solved.

    Parameters
    ----------
    forward, turn : (n,) [m/s], [rad/s] clockwise
    icrs_m : y_icr_right, y_icr_left, x_icr
    """
    right, left, _ = icrs_m
    return forward - left * turn, forward - right * turn
