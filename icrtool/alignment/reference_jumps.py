"""Jumps of the reference: steps between fixes that neither the wheels nor a robot that slides can make.

A step beyond the motion of the wheels is the robot's slip or an error of the reference. A gyro separates them where the
heading steps: it turns with the robot, so a heading that leaves wheels and gyro behind jumps, with the position of the
same pose. Otherwise only what no robot can do, and what receivers state of their solution, is a jump. What neither
shows stays undecided, and is the robot's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from icrtool.alignment.sensor_noise import OUTLIER_SIGMAS
from icrtool.alignment.slip_windows import Knots, Motion, compare
from icrtool.kernels.arrays import Bools, Ints
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
    columns: dict[str, Any] = {
        name: value[kept] for name, value in knots._asdict().items() if isinstance(value, np.ndarray)
    }
    knots = knots._replace(track=knots.track.places(kept), **columns)
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
    # what the wheels do in the time by which stamps are wrong, before and after each step
    reach = (knots.t[last] + 3 * STAMP_STD_S, knots.t[first] - 3 * STAMP_STD_S)
    jitter, spin = (
        np.abs(np.interp(reach[0], knots.t, along) - np.interp(reach[1], knots.t, along) - (along[last] - along[first]))
        for along in (motion.scale * knots.track.distance, motion.lever_m * motion.turn)
    )
    noise = OUTLIER_SIGMAS * np.sqrt(windows.sensor)
    ahead = np.maximum(np.abs(windows.ahead) - jitter, 0.0)
    moved = np.hypot(ahead, windows.aside) - noise[:, :2].max(axis=1)
    turned = np.maximum(np.abs(windows.turned) - spin, 0.0) - noise[:, 2]
    turned = np.where(knots.turn_follows_place, 0.0, turned)
    alone = turned > JUMP_MPS * duration
    shown = (moved > JUMP_MPS * duration) | alone
    if knots.gyro is None:
        alone[:] = False
    else:
        # a gyro turns as the wheels do, nearer to them than to the reference
        by_gyro = motion.lever_m * (knots.gyro[last] - knots.gyro[first])
        slipped = np.abs(by_gyro - windows.model_turned)
        alone &= slipped < np.minimum(JUMP_MPS * duration, np.abs(windows.turned) / 2)
    restated = knots.fix_class[first] != knots.fix_class[last]
    causes = {
        "the receiver changes its solution there": restated,
        "gyro and wheels do not turn with it": alone,
        "faster than any slide": moved > slide,
        "turns faster than any robot": turned > slide,
    }
    why = np.select(list(causes.values()), list(causes), "")
    level = np.exp(0.5j * (knots.heading[first] + knots.heading[last]))
    by = (windows.ahead + 1j * windows.aside) * level
    turn = np.zeros(len(first)) if knots.turn_follows_place else windows.turned / motion.lever_m
    stamps, place = knots.epoch_ns + np.rint(knots.t * 1e9).astype(np.int64), knots.place
    return tuple(
        ReferenceJump(
            kind="heading" if abs(turn[row]) * motion.lever_m > abs(by[row]) else "position",
            begin_ns=int(stamps[first[row]]),
            end_ns=int(stamps[last[row]]),
            north_m=float(place[first[row]].real),
            east_m=float(place[first[row]].imag),
            size_m=float(abs(by[row])),
            turn_deg=math.degrees(turn[row]),
            moved_north_m=float(by[row].real),
            moved_east_m=float(by[row].imag),
            why=str(why[row]) or "may be slip: cause undecided",
            undecided=not why[row],
        )
        for row in np.flatnonzero(shown)
    )
