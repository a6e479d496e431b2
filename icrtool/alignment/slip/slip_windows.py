"""Motion of the reference compared with that of the wheels, in windows of time: what `slip_events` tests.

The motion of the wheels is that of the alignment's estimate. Place and turn are compared apart from each other: wheel
speeds are integrated along the measured heading for the place, and by themselves for the turn.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from icrtool.alignment.estimator import estimate_alignment
from icrtool.alignment.log_track import cut_windows, track_of_streams, window_length
from icrtool.alignment.sensors.sensor_noise import FEWEST_FIXES, USUAL_POSITION_STD_M, is_hole
from icrtool.kernels.arrays import Bools, Bytes, Complexes, Floats, Ints, trapezoids
from icrtool.kernels.robust import mad_std
from icrtool.kernels.track import Track
from icrtool.motion.turns import fit_gyro_line
from icrtool.records.measurements import SensorData

KNOT_S = 0.1
"""Fixes closer together than this are thinned: they show little more, and their noise much."""

SPEED_S = 0.1
"""The speed at a knot is the mean of this much time about it."""

LONGEST_HOLE_S = 0.6
"""Longer without a sample: a hole, which no window spans."""

LONGEST_HELD_IN_USUAL = 2.0
"""A value held for longer than this many times the usual was constant."""

WINDOW_M = 1.0
"""The motion is estimated over shorter windows than the alignment: events disturb fewer of them."""

LEAST_TURN_GAIN = 1e-3


class Knots(NamedTuple):
    """Fixes about `KNOT_S` apart, and the motion at them, as integrals since the first.

    Attributes
    ----------
    track : with these fixes alone, since `epoch_ns`; its distance is that of the wheels
    variance : (m,) of a place, one axis [m^2]
    heading : (m,) [rad], unwrapped; turn_variance : of one value of it [rad^2]
    velocity : complex (m,), the mean of the sides along the heading [m/s]; apart : (m,) left minus right [m/s]
    held_m2 : (m,) variance that values held from sample to sample add to a side's distance
    holes : (m,) number of holes in any stream so far
    fix_class : (m,) classes of the fixes
    turn_follows_place : the headings are estimated from the positions, and jump with them
    gyro : (m,) turn of the gyro [rad], in sense and scale of the headings; None without one that turns with them
    """

    epoch_ns: int
    track: Track
    variance: Floats
    heading: Floats
    turn_variance: float
    velocity: Complexes
    apart: Floats
    held_m2: Floats
    holes: Ints
    fix_class: Bytes
    turn_follows_place: bool
    gyro: Floats | None

    @property
    def t(self) -> Floats:
        """Times of the fixes (m,) [s] since `epoch_ns`."""
        return self.track.place_t

    @property
    def place(self) -> Complexes:
        """Fixes (m,), north + j east [m]."""
        return self.track.place

    def rows(self, kept: Bools) -> Knots:
        """Return the knots marked in `kept` (m,)."""
        columns: dict[str, Any] = {
            name: value[kept] for name, value in self._asdict().items() if isinstance(value, np.ndarray)
        }
        return self._replace(track=self.track.places(kept), **columns)


class Motion(NamedTuple):
    """Motion that an estimate expects at the knots.

    Attributes
    ----------
    place : complex (m,) [m], turn : (m,) [rad], of the wheels, as integrals
    scale : of the wheels; lever_m : half the ICR separation, which makes a turn a distance
    """

    place: Complexes
    turn: Floats
    scale: float
    lever_m: float


class ComparedWindows(NamedTuple):
    """What the reference did beyond the model, in windows between two knots.

    Attributes
    ----------
    begin, end : (w,) rows of the knots
    ahead, aside, turned : (w,) reference minus model [m]; a turn is metres at half the ICR separation
    model_ahead, model_turned : (w,) by the wheels, likewise
    made : (w,) motion of the reference itself, the larger of displacement and turn [m]
    path_m : (w,) motion of the wheels [m], scale included
    sensor : (w, 3) variance that noise, held values and change of speed give ahead, aside, turned [m^2]
    """

    begin: Ints
    end: Ints
    ahead: Floats
    aside: Floats
    turned: Floats
    model_ahead: Floats
    model_turned: Floats
    made: Floats
    path_m: Floats
    sensor: Floats

    @property
    def residual(self) -> Floats:
        """Reference minus model (w, 3): ahead, aside, turned [m]."""
        return np.column_stack([self.ahead, self.aside, self.turned])

    @property
    def of_sides(self) -> Floats:
        """Reference minus model of the left and of the right side (2, w) [m]."""
        return np.stack([self.ahead + self.turned, self.ahead - self.turned])

    @property
    def model_sides(self) -> Floats:
        """Motion of the left and of the right side by the model (2, w) [m]."""
        return np.stack([self.model_ahead + self.model_turned, self.model_ahead - self.model_turned])

    def rows(self, kept: Bools | slice) -> ComparedWindows:
        """Return some of the windows."""
        return ComparedWindows._make(column[kept] for column in self)


def lay_knots(sensors: SensorData) -> Knots | None:
    """Integrate the wheels to the times of the fixes; None where the streams share too little time."""
    wheels, fixes, headings = sensors.wheels, sensors.fixes, sensors.headings
    if min(len(wheels.stamp_ns), len(fixes.stamp_ns), len(headings.stamp_ns)) < FEWEST_FIXES:
        return None
    track = track_of_streams(wheels, fixes, headings, same_clock=sensors.heading_from_position)
    left, right = track.v_left, track.v_right
    begin, end = (pick(track.t[at], track.heading_t[at]) for pick, at in ((max, 0), (min, -1)))
    rows = _thinned(track.place_t, begin, end)
    if len(rows) < FEWEST_FIXES:
        return None
    track = track.places(rows)
    t = track.place_t
    ahead, behind = (track._replace(place_t=t + shift_s) for shift_s in (SPEED_S / 2, -SPEED_S / 2))
    speeds = [(ahead.at_places(speed) - behind.at_places(speed)) / SPEED_S for speed in (left, right)]
    heading = track.heading_at(t)
    return Knots(
        epoch_ns=int(wheels.stamp_ns[0]), track=track,
        variance=np.maximum((fixes.var_north_m2 + fixes.var_east_m2)[rows] / 2, USUAL_POSITION_STD_M**2),
        heading=heading, turn_variance=_white_variance(heading),
        velocity=(speeds[0] + speeds[1]) / 2 * np.exp(1j * heading), apart=speeds[0] - speeds[1],
        held_m2=np.interp(t, track.t, _held_variance(track.t, left, right)),
        holes=sum((_holes(t, sampled) for sampled in (track.t, track.heading_t, t)), np.zeros(len(t), np.int64)),
        fix_class=fixes.fix_class[rows], turn_follows_place=sensors.heading_is_estimated,
        gyro=_turn_by_gyro(sensors, t, heading),
    )  # fmt: skip


def _turn_by_gyro(sensors: SensorData, t: Floats, heading: Floats) -> Floats | None:
    """Return the turn of the gyro at times (m,) [rad], in sense and scale of the headings (m,), without its bias."""
    gyro = sensors.gyro
    if gyro is None or len(gyro.stamp_ns) < FEWEST_FIXES:
        return None
    at = (gyro.stamp_ns - sensors.wheels.stamp_ns[0]) / 1e9
    turned = trapezoids(at, gyro.rate_radps)
    line = fit_gyro_line(at, gyro.rate_radps, turned, t, heading)
    return line.scale * np.interp(t + line.lead_s, at, turned) + line.bias_radps * t if line.is_yaw else None


def spans_of(knots: Knots, duration_s: float) -> tuple[Ints, Ints]:
    """Return first and last rows of the windows (w,) of that duration, or one fix more, which span no hole."""
    first = np.arange(len(knots.t))
    last = np.searchsorted(knots.t, knots.t + duration_s - KNOT_S / 2)
    inside = last < len(knots.t)
    first, last = first[inside], last[inside]
    whole = (last > first) & (knots.holes[first] == knots.holes[last])
    return first[whole], last[whole]


def fit_motion(knots: Knots, width_m: float, quiet: Bools) -> Motion | None:
    """Return the motion that the alignment's estimate expects of the wheels; None where there is too little distance.

    Parameters
    ----------
    quiet : (m,) knots that may be inside a window
    """
    windows = cut_windows(knots.track, window_length(knots.track, WINDOW_M))
    disturbed = np.concatenate([[0], np.cumsum(~quiet)])

    def clear(begin: Ints, end: Ints) -> Bools:
        return np.asarray((disturbed[end + 1] == disturbed[begin]) & (knots.holes[end] == knots.holes[begin]))

    kept = clear(windows.begin, windows.end)
    turns = [
        np.searchsorted(knots.t, edge).clip(0, len(knots.t) - 1) for edge in (windows.turn_begin, windows.turn_end)
    ]
    fit = estimate_alignment(windows.rows(kept, clear(turns[0], turns[1])), width_m)
    if fit is None:
        return None
    place, turn = fit.expected_motion()
    gain = max(abs(fit.estimate("turn")[0]), LEAST_TURN_GAIN)
    return Motion(place, turn, abs(fit.estimate("scale")[0]), width_m / 2 / gain)


def compare(knots: Knots, motion: Motion, first: Ints, last: Ints, response_s: float) -> ComparedWindows:
    """Compare reference and wheels between rows of the knots (w,).

    Parameters
    ----------
    response_s : standard deviation of the time by which the robot follows its wheels
    """
    level = np.exp(-0.5j * (knots.heading[first] + knots.heading[last]))
    place, model, change = (
        level * (column[last] - column[first]) for column in (knots.place, motion.place, knots.velocity)
    )
    turn, model_turn, spin = (column[last] - column[first] for column in (knots.heading, motion.turn, knots.apart))
    missed, path_m, lever = place - model, knots.track.distance[last] - knots.track.distance[first], motion.lever_m
    scale2 = motion.scale**2
    noise = knots.variance[first] + knots.variance[last]
    held = scale2 * (knots.held_m2[last] - knots.held_m2[first]) / 2
    ahead, spun = (scale2 * response_s**2 * square for square in (np.abs(change) ** 2, spin**2 / 4))
    turn_noise = lever**2 * 2 * knots.turn_variance
    return ComparedWindows(
        first, last, missed.real, missed.imag, lever * (turn - model_turn), model.real, lever * model_turn,
        np.maximum(np.abs(place), lever * np.abs(turn)), motion.scale * path_m,
        np.column_stack([noise + held + ahead, noise + held / 4 + ahead / 4, turn_noise + held + spun]),
    )  # fmt: skip


def _thinned(t: Floats, begin: float, end: float) -> Ints:
    """Return rows of fixes between two times, about `KNOT_S` apart or more."""
    rows = np.flatnonzero((t >= begin) & (t <= end))
    if len(rows) < 2:
        return rows
    usual = float(np.median(np.diff(t[rows])))
    rows = rows[:: max(1, round(KNOT_S / usual))] if usual > 0 else rows
    later = np.concatenate([[True], np.diff(t[rows]) > KNOT_S / 10])
    return np.asarray(rows[later])


def _holes(t: Floats, sampled: Floats) -> Ints:
    """Return the number of holes of a stream before each time (m,)."""
    return np.searchsorted(sampled[:-1][is_hole(np.diff(sampled), LONGEST_HOLE_S)], t)


def _white_variance(values: Floats) -> float:
    """Return the variance of values (m,) from their second differences: at most this is noise."""
    return mad_std(np.diff(values, 2), 0.0) ** 2 / 6 if len(values) > 2 else 0.0


def _held_variance(t: Floats, v_left: Floats, v_right: Floats) -> Floats:
    """Return the summed variance (n,) of a side's distance by held values.

    A value that changes by d after it was held for h may have changed at any time in between: (d h)^2 / 12.
    """
    change = np.hypot(np.diff(v_left), np.diff(v_right))
    changed = np.flatnonzero(change > 0) + 1
    held = np.diff(t[np.concatenate([[0], changed])])
    # a robot that stood still held nothing
    held = np.minimum(held, LONGEST_HELD_IN_USUAL * float(np.median(held)) if len(held) else 0.0)
    variance = np.zeros(len(t))
    variance[changed] = (change[changed - 1] * held) ** 2 / 12
    return np.cumsum(variance)
