"""Absolute headings with an unknown offset: an attitude sensor's, and the bearing from one antenna to another."""

from __future__ import annotations

import math

import numpy as np

from icrtool.alignment.drive_windows import fix_std_m
from icrtool.alignment.heading.courses import TurnRate
from icrtool.alignment.heading.gyro_heading import AbsoluteHeading
from icrtool.kernels.arrays import Floats
from icrtool.kernels.robust import mad_std
from icrtool.kernels.track import Track
from icrtool.records.samples import PositionFixes
from icrtool.records.tables import RobotLog

ATTITUDE_CELL_S, PAIR_CELL_S = 1.0, 0.5
"""Headings are averaged over this time, the turn in it corrected for."""

SHORTEST_BASELINE_M = 0.2
LEAST_ATTITUDE_STD_RAD = math.radians(0.01)


def attitude_heading(track: Track, turn: TurnRate) -> AbsoluteHeading:
    """Return the heading of a drive, with the white noise that it shows beside the turn rate."""
    found = _averaged(track.heading_t, track.heading, turn, ATTITUDE_CELL_S)
    step = np.diff(found.heading - np.interp(found.t, turn.t, turn.integrated()))
    noise = mad_std(np.angle(np.exp(1j * (step - np.median(step))))) / math.sqrt(2.0) if len(step) else 0.0
    return found._replace(std=np.full(len(found.t), max(noise, LEAST_ATTITUDE_STD_RAD)))


def antenna_heading(log: RobotLog, other: PositionFixes, turn: TurnRate) -> tuple[AbsoluteHeading, float] | None:
    """Return the bearing from the chosen antenna to another one, and the length of the baseline [m]; None if short."""
    mine = log.gnss
    if min(len(mine.stamp_ns), len(other.stamp_ns)) < 2:
        return None
    epoch = int(log.wheels.stamp_ns[0])
    t, s = (mine.stamp_ns - epoch) / 1e9, (other.stamp_ns - epoch) / 1e9
    after = np.clip(np.searchsorted(s, t), 1, len(s) - 1)
    near = (t >= s[0]) & (t <= s[-1]) & (s[after] - s[after - 1] < 3.0 * float(np.median(np.diff(s))))
    there = np.interp(t, s, other.north_m) + 1j * np.interp(t, s, other.east_m)
    line = (there - (mine.north_m + 1j * mine.east_m))[near]
    if len(line) < 2:
        return None
    length = float(np.median(np.abs(line)))
    noise = math.hypot(fix_std_m(mine), fix_std_m(other))
    if length < max(SHORTEST_BASELINE_M, 4.0 * noise):
        return None
    good = np.abs(np.abs(line) - length) < max(5.0 * noise, 0.05 * length)
    if np.count_nonzero(good) < len(good) / 2:
        return None
    found = _averaged(t[near][good], np.angle(line[good]), turn, PAIR_CELL_S)
    return found._replace(std=noise / length * found.std), length


def _averaged(t: Floats, angle: Floats, turn: TurnRate, cell_s: float) -> AbsoluteHeading:
    """Return means over cells of time, at each cell's last sample; `std` is that of a sample of unit noise.

    The turn rate carries the samples of a cell to its end: the mean uses nothing later.
    """
    inside = (t >= turn.t[0]) & (t <= turn.t[-1])
    t, angle = t[inside], angle[inside]
    if not len(t):
        return AbsoluteHeading(t, angle, angle, angle)
    turned = np.interp(t, turn.t, turn.integrated())
    first = np.flatnonzero(np.diff(np.floor(t / cell_s), prepend=-1.0) > 0)
    count = np.diff(first, append=len(t))
    last = first + count - 1
    mean = np.add.reduceat(np.exp(1j * (angle - turned)), first)
    rate = np.add.reduceat(np.interp(t, turn.t, turn.rate), first) / count
    return AbsoluteHeading(t[last], np.angle(mean * np.exp(1j * turned[last])), 1.0 / np.sqrt(count), rate)
