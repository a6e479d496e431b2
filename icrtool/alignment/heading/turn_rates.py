"""The turn rate about the vertical: a gyro's, however it is mounted, or the wheels'."""

from __future__ import annotations

import math

import numpy as np

from icrtool.alignment.heading.courses import TurnRate, course_changes
from icrtool.kernels.arrays import Floats, trapezoids
from icrtool.kernels.robust import huber_weights, mad_std
from icrtool.kernels.track import Track
from icrtool.records.measurements import RESPONSE_S
from icrtool.records.samples import GyroAxes

WHEEL_TURN, WHEEL_SCALE_STD = 0.6, 0.5
"""Skid-steer robots turn about this much of what their wheels would without slip."""

ALONG_AN_AXIS = 0.95
"""A sensor whose axis is this near to the vertical (cosine) is mounted along it."""

BETTER = 0.9
"""Another axis than z up is used where turns of the course over ground scatter about it by no more than this share."""

LARGEST_CHANGE_RAD = 2.5
HOLE_IN_INTERVALS, SHORTEST_HOLE_S = 5.0, 0.1
"""A turn rate has a hole where its interval is so many times the usual one, and at least so long."""

LEAST_AXIS = 0.3
"""A gyro that shows less than this share of the changes of the course over ground shows no axis."""


def wheel_rate(track: Track, width_m: float) -> TurnRate:
    """Return the turn rate of the wheels, with a wide prior of its scale."""
    rate = WHEEL_TURN * (track.v_left - track.v_right) / width_m
    gaps = np.flatnonzero(track.held[:-1] == 0.0)
    holes = np.column_stack([track.t[gaps], track.t[gaps + 1]])
    return TurnRate(track.t, rate, holes, scale_std=WHEEL_SCALE_STD, bias_std=math.radians(0.5), delay_std_s=RESPONSE_S)


def gyro_rate(track: Track, gyro: GyroAxes, epoch_ns: int) -> tuple[TurnRate, str] | None:
    """Return the turn rate of a gyro about the vertical, and how it is mounted; None where it does not cover courses.

    Changes of the course over ground are regressed on the turns about all three axes of the sensor.
    """
    t = (gyro.stamp_ns - epoch_ns) / 1e9
    begin, end, change = course_changes(track)
    inside = (begin >= t[0]) & (end <= t[-1])
    begin, end, change = begin[inside], end[inside], change[inside]
    if len(change) < 3:
        return None
    turned = np.column_stack([_turn_between(t, gyro.rates_radps[:, axis], begin, end) for axis in range(3)])
    axis, name = _vertical_axis(turned, end - begin, change)
    return _bridged(t, gyro.rates_radps @ axis, track), name


def _turn_between(t: Floats, rate: Floats, begin: Floats, end: Floats) -> Floats:
    turned = trapezoids(t, rate)
    return np.asarray(np.interp(end, t, turned) - np.interp(begin, t, turned), np.float64)


def _vertical_axis(turned: Floats, seconds: Floats, change: Floats) -> tuple[Floats, str]:
    """Return the direction of the downward vertical in the sensor (3,), and its name.

    Parameters
    ----------
    turned : (m, 3) turn about each axis; seconds : (m,) over which; change : (m,) of the course over ground [rad]
    """
    up = np.array([0.0, 0.0, -1.0])
    small = np.abs(turned).max(axis=1) < LARGEST_CHANGE_RAD
    columns, y = np.column_stack([turned, seconds])[small], change[small]
    if len(y) < 6:
        return up, "z up"
    noise = max(mad_std(_wrapped(y - columns[:, :3] @ up)), math.radians(0.1))
    prior = noise**2 * np.diag([1.0, 1.0, 1.0, 1.0 / math.radians(1.0) ** 2])
    found, weights = np.zeros(4), np.ones(len(y))
    for _ in range(5):
        weighted = columns * weights[:, None]
        found = np.linalg.solve(columns.T @ weighted + prior, weighted.T @ y)
        left = _wrapped(y - columns @ found)
        weights = huber_weights(left / max(mad_std(left, 0.0), 1e-6))
    bias = found[3] * columns[:, 3]
    size = float(np.linalg.norm(found[:3]))
    if size <= LEAST_AXIS:
        return up, "z up"
    axis = found[:3] / size
    main = int(np.argmax(np.abs(axis)))
    name = "tilted"
    if abs(axis[main]) > ALONG_AN_AXIS:
        axis = np.sign(axis[main]) * np.eye(3)[main]
        name = f"{'xyz'[main]} {'down' if axis[main] > 0 else 'up'}"
    scatter = [float(np.abs(_wrapped(y - bias - columns[:, :3] @ one)).mean()) for one in (axis, up)]
    return (axis, name) if scatter[0] < BETTER * scatter[1] else (up, "z up")


def _wrapped(angle: Floats) -> Floats:
    return np.asarray(np.angle(np.exp(1j * angle)), np.float64)


def _bridged(t: Floats, rate: Floats, track: Track) -> TurnRate:
    """Return a gyro's rate with its holes bridged by the wheels' turn, scaled as the gyro shows it elsewhere."""
    usual = float(np.median(np.diff(t)))
    long = np.flatnonzero(np.diff(t) > max(HOLE_IN_INTERVALS * usual, SHORTEST_HOLE_S))
    holes = np.column_stack([t[long], t[long + 1]])
    if not len(holes):
        return TurnRate(t, rate, holes)
    apart = track.v_left - track.v_right
    there = np.interp(track.t, t, rate)
    hole = np.searchsorted(holes[:, 0], track.t) > np.searchsorted(holes[:, 1], track.t, side="right")
    known = ~hole & (track.t >= t[0]) & (track.t <= t[-1])
    factor = float(apart[known] @ there[known]) / max(float(apart[known] @ apart[known]), 1e-12)
    left = there[known] - factor * apart[known]
    wheels = hole & (track.held > 0.0)
    order = np.argsort(np.concatenate([t, track.t[wheels]]), kind="stable")
    return TurnRate(
        np.concatenate([t, track.t[wheels]])[order],
        np.concatenate([rate, factor * apart[wheels] + float(np.median(left))])[order],
        holes, hole_std=float(np.sqrt(np.mean(left**2))) if len(left) else math.radians(10.0),
    )  # fmt: skip
