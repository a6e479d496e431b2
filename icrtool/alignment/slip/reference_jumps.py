"""Jumps of the reference: steps between fixes that neither the wheels nor a robot that slides can make.

A step beyond the motion of the wheels is the robot's slip or an error of the reference. A gyro separates them where the
heading steps: it turns with the robot, so a heading that leaves wheels and gyro behind jumps, with the position of the
same pose. Otherwise only what no robot can do, and what receivers state of their solution, is a jump. What neither
shows stays undecided, and is the robot's.
"""

from __future__ import annotations

import math

import numpy as np

from icrtool.alignment.sensors.sensor_noise import OUTLIER_SIGMAS
from icrtool.alignment.slip.slip_windows import ComparedWindows, Knots, Motion, compare
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.records.measurements import ReferenceJump

JUMP_SPEED_SHARE, JUMP_MPS = 2.0, 0.3
"""A step beyond the noise, and beyond what wheels and a slow slide can do, may be a jump."""

SLIDE_MPS = 2.0
"""A robot slides by up to this much faster than its wheels ever are: it needs 1 s of free slide at 0.2 g, and a robot
that brakes on ice keeps its speed."""

STAMP_STD_S = 0.1
"""Stamps of poses jitter: by 0.1 s rms, and three times as much now and then, on recorded lidar poses."""


def without_jumps(knots: Knots, width_m: float) -> tuple[Knots, Ints]:
    """Return the knots without single outliers, and the rows before steps that may be jumps, which no window spans."""
    row = np.arange(len(knots.t))
    step, over = _beyond(knots, row[:-1], row[1:], width_m), _beyond(knots, row[:-2], row[2:], width_m)
    kept = np.ones(len(row), np.bool_)
    kept[1:-1] = ~(step[:-1] & step[1:] & ~over)
    knots = knots.rows(kept)
    row = row[: len(knots.t)]
    first = np.flatnonzero(_beyond(knots, row[:-1], row[1:], width_m))
    holes = np.searchsorted(first, row - 1, side="right")
    return knots._replace(holes=knots.holes + holes), first


def _beyond(knots: Knots, first: Ints, last: Ints, width_m: float) -> Bools:
    """Return which windows (w,) move or turn further than noise, wheels and a slow slide explain."""
    path, duration = knots.track.distance[last] - knots.track.distance[first], knots.t[last] - knots.t[first]
    by_robot = JUMP_SPEED_SHARE * path + JUMP_MPS * duration
    noise = np.sqrt(knots.variance[first] + knots.variance[last])
    moved = np.abs(knots.place[last] - knots.place[first]) > OUTLIER_SIGMAS * noise + by_robot
    if knots.turn_follows_place:
        return np.asarray(moved)
    turned = width_m * np.abs(knots.heading[last] - knots.heading[first])
    turn_noise = width_m * math.sqrt(2 * knots.turn_variance)
    return np.asarray(moved | (turned > OUTLIER_SIGMAS * turn_noise + by_robot))


def decide_jumps(knots: Knots, motion: Motion, first: Ints) -> tuple[ReferenceJump, ...]:
    """Return the jumps of the reference among the steps that may be one.

    Parameters
    ----------
    knots, first : of `without_jumps`
    motion : that the wheels make
    """
    last = first + 1
    windows = compare(knots, motion, first, last, 0.0)
    duration = knots.t[last] - knots.t[first]
    speed = np.diff(knots.track.distance) / np.diff(knots.t)
    # how fast the wheels drive the robot at most, but for single samples
    slide = (SLIDE_MPS + motion.scale * float(np.quantile(speed, 0.99))) * duration
    along, turns = motion.scale * knots.track.distance, motion.lever_m * motion.turn
    jitter, spin = (_by_jitter(knots, one, first) for one in (along, turns))
    noise = OUTLIER_SIGMAS * np.sqrt(windows.sensor)
    ahead = np.maximum(np.abs(windows.ahead) - jitter, 0.0)
    moved = np.hypot(ahead, windows.aside) - noise[:, :2].max(axis=1)
    turned = np.maximum(np.abs(windows.turned) - spin, 0.0) - noise[:, 2]
    turned = np.where(knots.turn_follows_place, 0.0, turned)
    restated = knots.fix_class[first] != knots.fix_class[last]
    shown = (moved > JUMP_MPS * duration) | (turned > JUMP_MPS * duration)
    alone = (turned > JUMP_MPS * duration) & _turn_with_wheels(knots, motion, windows, duration)
    return tuple(
        _jump(
            knots, motion, windows, row,
            _cause(
                far=bool(moved[row] > slide[row]), turn=bool(turned[row] > slide[row]), stated=bool(restated[row]),
                alone=bool(alone[row]),
            ),
        )
        for row in np.flatnonzero(shown).tolist()
    )  # fmt: skip


def _turn_with_wheels(knots: Knots, motion: Motion, windows: ComparedWindows, duration: Floats) -> Bools:
    """Return whether a gyro turns as the wheels do (s,), nearer to them than to the reference."""
    if knots.gyro is None:
        return np.zeros(len(duration), np.bool_)
    by_gyro = motion.lever_m * (knots.gyro[windows.end] - knots.gyro[windows.begin])
    slipped = np.abs(by_gyro - windows.model_turned)
    return np.asarray(slipped < np.minimum(JUMP_MPS * duration, np.abs(windows.turned) / 2))


def _by_jitter(knots: Knots, along: Floats, first: Ints) -> Floats:
    """Return the motion of the wheels (s,) in the time by which stamps are wrong, before and after each step.

    Parameters
    ----------
    along : (m,) the wheels' motion until each knot
    """
    off, last = 3 * STAMP_STD_S, first + 1
    reach = np.interp(knots.t[last] + off, knots.t, along) - np.interp(knots.t[first] - off, knots.t, along)
    return np.abs(np.asarray(reach - (along[last] - along[first])))


def _cause(*, far: bool, turn: bool, stated: bool, alone: bool) -> str:
    """Return why a step is no motion of the robot; empty where it may be."""
    if stated:
        return "the receiver changes its solution there"
    if alone:
        return "gyro and wheels do not turn with it"
    return "faster than any slide" if far else "turns faster than any robot" if turn else ""


def _jump(knots: Knots, motion: Motion, windows: ComparedWindows, row: int, why: str) -> ReferenceJump:
    first, last = int(windows.begin[row]), int(windows.end[row])
    level = np.exp(0.5j * (knots.heading[first] + knots.heading[last]))
    moved = complex((windows.ahead[row] + 1j * windows.aside[row]) * level)
    turned = 0.0 if knots.turn_follows_place else float(windows.turned[row]) / motion.lever_m
    place = complex(knots.place[first])
    return ReferenceJump(
        kind="heading" if abs(turned) * motion.lever_m > abs(moved) else "position",
        begin_ns=knots.epoch_ns + round(float(knots.t[first]) * 1e9),
        end_ns=knots.epoch_ns + round(float(knots.t[last]) * 1e9),
        north_m=place.real,
        east_m=place.imag,
        size_m=abs(moved),
        turn_deg=math.degrees(turned),
        moved_north_m=moved.real,
        moved_east_m=moved.imag,
        why=why or "may be slip: cause undecided",
        undecided=not why,
    )
