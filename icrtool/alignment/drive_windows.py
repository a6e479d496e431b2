"""A log as arrays, cut into windows of driven distance: what the alignment estimator compares."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.alignment.position.gnss_steps import bend_std_m, unbroken
from icrtool.kernels.arrays import Bools, Complexes, Floats, Ints
from icrtool.records.measurements import TURNING_MPS, Fixes
from icrtool.records.samples import HeadingSamples, PositionFixes, WheelSamples
from icrtool.records.tables import RobotLog

WINDOW_M, LONGEST_WINDOW_M = 2.0, 10.0
WINDOW_IN_WIDTHS = 4.0
"""Windows of small robots are so many track widths long: slip is a share of the distance, and hides them over 2 m."""

WINDOW_IN_POSITION_STD = 12.0
"""A window is so long that noise of the fixes turns its displacement by no more than 7 deg."""

WINDOW_IN_VALUES = 12.0
"""A value that is held while the robot accelerates moves the end of a window by a part of its own distance."""

STARTS_A_WINDOW = 8
LONGEST_WINDOW_S = 30.0
"""A window that takes longer holds an outage or a stop."""

TURN_WINDOW_S, TURN_WINDOW_IN_INTERVALS, TURN_STEP_S = 1.0, 2.0, 0.5
"""Heading changes are compared over this time, and at least so many intervals; windows start at every step."""

UNSTATED_STD_M, NOISIER = 0.01, 1.5
"""Noise of fixes that state none; and what their second differences must exceed it by to be used instead."""


CHORD_S, LEAST_CHORD_M = 2.0, 0.3
"""Without a heading, distances are compared over this time, and where the chord is so long [m]."""

STANDS_S = 5.0
"""A heading further than this from a turn of the wheels is one of a robot that stands."""

MOST_WHEEL_SAMPLES = 100_000
"""The samples of a longer drive are joined to about so many: 1 h at 28 Hz, where windows last seconds."""


class DriveArrays(NamedTuple):
    """A log in seconds since its first wheel sample.

    Attributes
    ----------
    wheel_t, wheel_dt : (n,) `wheel_dt` is 0 where the next sample is too far away
    v_left, v_right : (n,) [m/s]
    heading_t, heading : (h,) unwrapped [rad], clockwise from north
    fix_t : (m,); fix : complex (m,), north + j east [m]
    travel : (n,) mean of the distances of both sides [m], without their signs
    fix_std_m : noise of the fixes, an axis
    same_clock : position and heading are fields of the same messages
    """

    wheel_t: Floats
    wheel_dt: Floats
    v_left: Floats
    v_right: Floats
    heading_t: Floats
    heading: Floats
    fix_t: Floats
    fix: Complexes
    travel: Floats
    fix_std_m: float
    same_clock: bool

    @property
    def mean_speed(self) -> Floats:
        """Mean of the sides' speeds (n,) [m/s]."""
        return (self.v_left + self.v_right) / 2

    @property
    def half_difference(self) -> Floats:
        """Half of what left is faster than right (n,) [m/s]."""
        return (self.v_left - self.v_right) / 2

    @property
    def nose(self) -> Complexes:
        """Heading as a unit vector in the middle of each wheel interval (n,)."""
        return np.asarray(np.exp(1j * np.interp(self.wheel_t + self.wheel_dt / 2, self.heading_t, self.heading)))

    def cumulate(self, rate: Floats | Complexes) -> Complexes:
        """Return the integral of a rate (n,) until each wheel sample (n,)."""
        return np.concatenate([[0.0], np.cumsum((rate * self.wheel_dt)[:-1])])

    def until_fixes(self, rate: Floats | Complexes) -> Complexes:
        """Return the integral of a rate (n,) until each fix (m,)."""
        return np.asarray(np.interp(self.fix_t, self.wheel_t, self.cumulate(rate)))

    def laid_until_fixes(self) -> Complexes:
        """Return the mean of the sides laid along the heading, until each fix (m,) [m]."""
        return self.until_fixes(self.mean_speed * self.nose)


class Chords(NamedTuple):
    """Displacements of the fixes over spans of time, and the distance of each side in them.

    Attributes
    ----------
    duration : (w,) [s]; step : complex (w,) north + j east [m]; left, right : (w,) with their signs [m]
    """

    duration: Floats
    step: Complexes
    left: Floats
    right: Floats


class DriveWindows(NamedTuple):
    """Windows of a drive.

    Attributes
    ----------
    begin, end : (w,) rows of the fixes, first and last of a window
    length_m : wheel distance of a window
    turn_begin, turn_end : (u,) [s] windows of heading changes
    group, turn_group : (w,), (u,) stretches of distance that are independent of one another
    """

    begin: Ints
    end: Ints
    length_m: float
    turn_begin: Floats
    turn_end: Floats
    group: Ints
    turn_group: Ints

    def rows(self, kept: Bools, turn_kept: Bools) -> DriveWindows:
        """Return the windows of distance (w,) and of time (u,) that are marked."""
        return self._replace(
            begin=self.begin[kept], end=self.end[kept], group=self.group[kept],
            turn_begin=self.turn_begin[turn_kept], turn_end=self.turn_end[turn_kept],
            turn_group=self.turn_group[turn_kept],
        )  # fmt: skip


def drive_arrays(log: RobotLog, heading: HeadingSamples | None = None) -> DriveArrays:
    """Return a log as arrays; `heading` in place of its own."""
    stated = log.heading if heading is None else heading
    return join_streams(
        log.wheels, log.gnss, stated, same_clock=log.heading_is_of_position, slipping_ns=log.slipping_ns
    )


def join_streams(
    wheels: WheelSamples, gnss: PositionFixes | Fixes, heading: HeadingSamples, *, same_clock: bool,
    slipping_ns: tuple[tuple[int, int], ...] = (),
) -> DriveArrays:  # fmt: skip
    """Return streams as arrays; `same_clock` as in `DriveArrays`; `slipping_ns`, of `RobotLog`, are gaps."""
    epoch = int(wheels.stamp_ns[0])
    wheel_t, fix_t, heading_t = (
        (stamps - epoch) / 1e9 for stamps in (wheels.stamp_ns, gnss.stamp_ns, heading.stamp_ns)
    )
    dt = np.append(unbroken(np.diff(wheel_t)), 0.0)
    for span in slipping_ns:
        dt[slice(*np.searchsorted(wheels.stamp_ns, span))] = 0.0
    left, right = wheels.v_left_mps, wheels.v_right_mps
    turns = np.abs(left) + np.abs(right) > 2.0 * TURNING_MPS
    so_far = np.concatenate([[0], np.cumsum(turns)])
    near = [np.searchsorted(wheel_t, heading_t + shift) for shift in (-STANDS_S, STANDS_S)]
    heading_t, angle = _averaged(heading_t, np.unwrap(heading.heading_rad), so_far[near[1]] > so_far[near[0]])
    wheel_t, dt, left, right = _joined(wheel_t, dt, left, right, turns)
    step = dt * (np.abs(left) + np.abs(right)) / 2
    return DriveArrays(
        wheel_t, dt, left, right, heading_t, angle,
        fix_t, gnss.north_m + 1j * gnss.east_m, np.concatenate([[0.0], np.cumsum(step[:-1])]),
        fix_std_m(gnss), same_clock,
    )  # fmt: skip


def _joined(t: Floats, dt: Floats, left: Floats, right: Floats, turns: Bools) -> tuple[Floats, Floats, Floats, Floats]:
    """Return times, intervals and speeds with neighbouring samples of a long drive joined; distances are the same.

    Gaps (`dt` 0) stay samples of their own; `turns` (n,) marks where the wheels do.
    """
    if len(t) <= MOST_WHEEL_SAMPLES:
        return t, dt, left, right
    gap = dt == 0.0
    begins = gap | np.append(True, gap[:-1])
    begins[_thinned(turns)] = begins[-1] = True
    first = np.flatnonzero(begins)
    joined = np.add.reduceat(dt, first)
    speeds = []
    for speed in (left, right):
        distance = np.add.reduceat(dt * speed, first)
        speeds.append(np.divide(distance, joined, out=speed[first].copy(), where=joined > 0.0))
    return t[first], joined, speeds[0], speeds[1]


def _thinned(busy: Bools) -> Ints:
    """Return rows at which to join the samples of a long drive (n,): evenly, or only where it stands if that is enough.

    A robot that is parked for days leaves the samples of its drives as they are.
    """
    every = -(-len(busy) // MOST_WHEEL_SAMPLES)
    moving = np.flatnonzero(busy | np.append(False, busy[:-1]))
    even = np.arange(0, len(busy), every)
    return np.union1d(moving, even) if len(moving) <= MOST_WHEEL_SAMPLES else even


def _averaged(t: Floats, angle: Floats, moves: Bools) -> tuple[Floats, Floats]:
    """Return times and unwrapped headings of a long drive, neighbours averaged: a delay then moves no single noise."""
    if len(t) <= MOST_WHEEL_SAMPLES:
        return t, angle
    first = _thinned(moves)
    count = np.diff(first, append=len(t))
    return np.add.reduceat(t, first) / count, np.add.reduceat(angle, first) / count


def fix_std_m(gnss: PositionFixes | Fixes) -> float:
    """Return the noise of the fixes, an axis [m]: what they state, or what they show where that is clearly more."""
    variance = (gnss.var_north_m2 + gnss.var_east_m2) / 2
    known = variance[np.isfinite(variance) & (variance > 0)]
    stated = math.sqrt(float(np.median(known))) if len(known) else UNSTATED_STD_M
    seen = bend_std_m(gnss)
    return seen if seen > NOISIER * stated else stated


def window_length(drive: DriveArrays, least_m: float) -> float:
    """Return how long windows are [m]: at least so, and as the noise of the fixes and held wheel values ask for."""
    noise = WINDOW_IN_POSITION_STD * min(drive.fix_std_m, 10.0)
    return max(least_m, noise, min(WINDOW_IN_VALUES * _value_length(drive), LONGEST_WINDOW_M))


def alignment_window_m(drive: DriveArrays, width_m: float) -> float:
    """Return how long the windows of the alignment are [m], for a robot of track width b [m]."""
    return window_length(drive, min(WINDOW_M, WINDOW_IN_WIDTHS * width_m))


def cut_windows(drive: DriveArrays, length_m: float | None = None) -> DriveWindows:
    """Cut a drive into overlapping windows of wheel distance between fixes, and of time between headings.

    All arrays are as long as the samples allow, whatever the speeds: a damaged speed fills no memory.

    Parameters
    ----------
    length_m : of a window; default that of the alignment of a robot of usual size
    """
    length = window_length(drive, WINDOW_M) if length_m is None else length_m
    at_fix = np.interp(drive.fix_t, drive.wheel_t, drive.travel)
    cell = np.floor(at_fix / (length / STARTS_A_WINDOW))
    begin = np.flatnonzero(np.diff(cell, prepend=cell[:1] - 1) > 0) if len(cell) else np.empty(0, np.int64)
    end = np.searchsorted(at_fix, at_fix[begin] + length)
    begin, end = begin[end < len(at_fix)], end[end < len(at_fix)]
    first, last = _common_span(drive)
    whole = (drive.fix_t[begin] >= first) & (drive.fix_t[end] <= last)
    whole &= drive.fix_t[end] - drive.fix_t[begin] < LONGEST_WINDOW_S
    whole &= (at_fix[end] - at_fix[begin] < 2.0 * length) & _clear(drive, drive.fix_t[begin], drive.fix_t[end])
    begin, end = begin[whole], end[whole]
    turn_begin, turn_end = _turn_windows(drive, first, last)
    size = _group_length(float(drive.travel[-1]), length)
    turn_travel = np.interp(turn_begin, drive.wheel_t, drive.travel)
    return DriveWindows(
        begin, end, length, turn_begin, turn_end,
        np.floor(at_fix[begin] / size).astype(np.int64), np.floor(turn_travel / size).astype(np.int64),
    )  # fmt: skip


def cut_chords(drive: DriveArrays) -> Chords:
    """Cut a drive into spans of `CHORD_S` from fix to fix, without a heading."""
    rows = np.unique(np.floor(drive.fix_t / CHORD_S), return_index=True)[1]
    left, right = (np.diff(drive.until_fixes(speed)[rows]).real for speed in (drive.v_left, drive.v_right))
    return Chords(np.diff(drive.fix_t[rows]), np.diff(drive.fix[rows]), left, right)


def _value_length(drive: DriveArrays) -> float:
    """Return the distance [m] on which a wheel value lasts while the robot moves, however often it is repeated."""
    moving = np.diff(drive.travel) > 0
    changes = [np.count_nonzero((np.diff(speed) != 0) & moving) for speed in (drive.v_left, drive.v_right)]
    return float(drive.travel[-1]) / max(sum(changes) / 2, 1.0)


def _group_length(total: float, length: float) -> float:
    """Return the distance that counts as one independent observation: 10 windows, where there are 40 of them."""
    return min(max(total / 40.0, 2.0 * length), 10.0 * length)


def _common_span(drive: DriveArrays) -> tuple[float, float]:
    """Return begin and end of what wheels and heading both cover [s]."""
    starts, ends = [drive.wheel_t[0]], [drive.wheel_t[-1]]
    if len(drive.heading_t):
        starts.append(drive.heading_t[0])
        ends.append(drive.heading_t[-1])
    return float(max(starts)), float(min(ends))


def _clear(drive: DriveArrays, begin: Floats, end: Floats) -> Bools:
    """Return which spans (w,) hold no gap in the wheel data."""
    gap = drive.wheel_t[:-1][drive.wheel_dt[:-1] == 0.0]
    return np.asarray(np.searchsorted(gap, begin) == np.searchsorted(gap, end))


def _turn_windows(drive: DriveArrays, first: float, last: float) -> tuple[Floats, Floats]:
    """Return begin and end of windows [s] in which wheels and heading were sampled and the wheels turned."""
    t = drive.heading_t
    if not len(t):
        return np.empty(0), np.empty(0)
    begin = t[0] + TURN_STEP_S * np.unique(np.floor((t - t[0]) / TURN_STEP_S))
    length = (
        max(TURN_WINDOW_S, TURN_WINDOW_IN_INTERVALS * float(np.median(np.diff(t)))) if len(t) > 1 else TURN_WINDOW_S
    )
    begin = begin[(begin >= first) & (begin + length <= last)]
    end = begin + length
    sampled = np.searchsorted(t, end) > np.searchsorted(t, begin) + 1
    moved = np.interp(end, drive.wheel_t, drive.travel) > np.interp(begin, drive.wheel_t, drive.travel)
    kept = sampled & moved & _clear(drive, begin, end)
    return begin[kept], end[kept]
