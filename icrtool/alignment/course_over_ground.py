"""The way that position tells, held against wheels laid along the heading, window by window."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.alignment.gnss_steps import bend_std_m, unbroken
from icrtool.records.tables import Floats, Ints, PositionFixes, RobotLog, WheelSamples

SHORTEST_WINDOW_M = 1.0
WINDOW_IN_GNSS_STD = 12.0
"""A course is taken over this much way, so that the noise of the fixes turns it by no more than some 7 deg."""

LONGEST_WINDOW_S = 30.0
"""A window that takes longer holds an outage or a stop, and no course."""

SPIN_RATIO = 3.0
"""A window is a spin where the sides part by so many times its way."""

FEWEST_WINDOWS = 8
UNSTATED_STD_M, NOISIER = 0.01, 1.5
"""Noise of fixes that state none; and what their second differences must exceed it by to be believed instead."""

EXPLAINED = 0.8
"""Mean resultant length of course minus heading above which they are one direction seen twice."""


class Course(NamedTuple):
    """Windows of way: what position tells against what wheels and heading tell.

    Attributes
    ----------
    angle : (w,) heading minus course [rad], in (-pi, pi]
    mirrored : (w,) the same for a heading that turns the other way
    curvature : (w,) heading change over way [rad/m]
    ratio : (w,) displacement by the fixes over displacement by wheels and heading
    scattered : windows in which fixes and wheels went on, but the way laid along the heading led nowhere
    noise_rad : what the fixes' noise alone turns a course by; white_rad : what their white noise does
    duration_s : median duration of a window
    """

    angle: Floats
    mirrored: Floats
    curvature: Floats
    ratio: Floats
    scattered: int
    noise_rad: float
    white_rad: float
    duration_s: float

    @property
    def agreement(self) -> float:
        """Mean resultant length of `angle`: 1 where heading and course are one direction, about 0 at random."""
        return _resultant_length(self.angle)

    @property
    def mirrored_agreement(self) -> float:
        """The same of `mirrored`."""
        return _resultant_length(self.mirrored)

    @property
    def is_explained(self) -> bool:
        """Whether there are windows enough, and the heading follows the course in one of the conventions."""
        enough = len(self.angle) >= FEWEST_WINDOWS
        return enough and max(self.agreement, self.mirrored_agreement) >= EXPLAINED


def measure_course(log: RobotLog) -> Course:
    """Cut the way into windows and compare, in each, displacement by fixes with wheels laid along the heading."""
    gnss, wheels = log.gnss, log.wheels
    none = Course(np.empty(0), np.empty(0), np.empty(0), np.empty(0), 0, 0.0, 0.0, 0.0)
    if min(len(gnss.stamp_ns), len(log.heading.stamp_ns), len(wheels.stamp_ns)) < 2:
        return none
    noise, white = _fix_noise_m(gnss)
    length = max(SHORTEST_WINDOW_M, WINDOW_IN_GNSS_STD * noise)
    interval = known_intervals(wheels)
    step = (wheels.v_left_mps + wheels.v_right_mps)[:-1] / 2 * interval
    psi_at = np.interp(
        wheels.stamp_ns[:-1] + np.diff(wheels.stamp_ns) // 2, log.heading.stamp_ns, np.unwrap(log.heading.heading_rad)
    )
    travelled = np.concatenate([[0.0], np.cumsum(np.abs(step))])
    north, east = (np.concatenate([[0.0], np.cumsum(step * part(psi_at))]) for part in (np.cos, np.sin))
    begin, end = _windows(np.interp(gnss.stamp_ns, wheels.stamp_ns, travelled), gnss.stamp_ns, length)
    if not len(begin):
        return none

    def between(values: Floats) -> Floats:
        first, last = (np.interp(gnss.stamp_ns[fix], wheels.stamp_ns, values) for fix in (begin, end))
        return last - first

    seen = (gnss.north_m[end] - gnss.north_m[begin]) + 1j * (gnss.east_m[end] - gnss.east_m[begin])
    real, imaginary, way = between(north), between(east), between(travelled)
    turned = between(np.append(psi_at, psi_at[-1]))
    went, led = np.abs(seen) > length / 3, np.hypot(real, imaginary) > length / 3
    moved = went & led
    # spins on the spot wind the way up whatever the heading; of a drive the sides go ahead of each other but little
    apart = np.abs(wheels.v_left_mps - wheels.v_right_mps)[:-1] * interval
    spun = between(np.concatenate([[0.0], np.cumsum(apart)])) > SPIN_RATIO * way
    told, mirror = real + 1j * imaginary, real - 1j * imaginary
    return Course(
        np.angle(told * np.conj(seen))[moved],
        np.angle(mirror * np.conj(seen))[moved],
        (turned / way)[moved],
        (np.abs(seen) / np.where(moved, np.hypot(real, imaginary), 1.0))[moved],
        int(np.count_nonzero(went & ~led & ~spun)),
        noise * math.sqrt(2.0) / length,
        white * math.sqrt(2.0) / length,
        float(np.median((gnss.stamp_ns[end] - gnss.stamp_ns[begin])[moved])) / 1e9 if moved.any() else 0.0,
    )


def _fix_noise_m(gnss: PositionFixes) -> tuple[float, float]:
    """Return the noise of the fixes, an axis [m], and how much of it is seen to be white.

    The noise is what they state, or what they show by themselves where that is clearly more.
    """
    variance = (gnss.var_north_m2 + gnss.var_east_m2) / 2
    known = variance[np.isfinite(variance)]
    stated = math.sqrt(float(np.median(known))) if len(known) else UNSTATED_STD_M
    seen = bend_std_m(gnss)
    if math.isnan(seen):
        return stated, 0.0
    return (seen, seen) if seen > NOISIER * stated else (stated, min(seen, stated))


def _windows(travelled: Floats, stamps: Ints, length: float) -> tuple[Ints, Ints]:
    """Return first and last fix of successive windows of at least `length` [m], without those that took too long."""
    targets = np.arange(travelled[0], travelled[-1], length)
    edges = np.unique(np.searchsorted(travelled, targets))
    begin, end = edges[:-1], edges[1:]
    quick = stamps[end] - stamps[begin] < LONGEST_WINDOW_S * 1e9
    return begin[quick], end[quick]


def known_intervals(wheels: WheelSamples) -> Floats:
    """Return the seconds between wheel samples (n - 1,), none through a gap."""
    return unbroken(np.diff(wheels.stamp_ns) / 1e9)


def _resultant_length(angle: Floats) -> float:
    return float(abs(np.exp(1j * angle).mean()))
