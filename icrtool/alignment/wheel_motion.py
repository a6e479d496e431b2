"""Motion by the wheels and by the reference, window by window: what `icrtool.alignment.slip_events` compares.

Place and turn are compared apart from each other: wheel speeds are integrated along the measured heading for the place,
and by themselves for the turn. Everything is then linear in the parameters of the motion model.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from icrtool.kernels.robust import RobustFit, mad_std, robust_least_squares
from icrtool.records.measurements import SensorData
from icrtool.records.tables import Bools, Complexes, Floats, GyroSamples, Ints

KNOT_S = 0.1
"""Fixes closer together than this are thinned: they show little more, and their noise much."""

SPEED_S = 0.1
"""The speed at a knot is the mean of this much time about it."""

LONGEST_HOLE_S, HOLE_IN_INTERVALS = 0.6, 5.0
"""Longer without a sample, and so many usual intervals: a hole, which no window spans."""

FIT_WINDOW_S = 1.0
FEWEST_WINDOWS = 30
MOVING_SHARE = 0.2
"""Windows in which the wheels do less than this part of the usual show nothing of the motion model."""

LONGEST_HELD_IN_USUAL = 2.0
"""A value held for longer than this many times the usual was constant."""

SAME_TURN = 0.1
"""A gyro whose turns differ from those of the heading by more than this part is not about the vertical axis."""

FIT_MODEL_ERROR = 0.05
"""Residuals of the fit are weighted by sensor noise and this part of the wheels' motion."""

LEAST_STD_M = 0.01
SIDE_GAIN, SIDE_GAIN_STD, SIDEWAYS_STD, CENTRIPETAL_STD_S, DELAY_STD_S = 0.5, 0.2, 0.4, 0.1, 0.2
SEPARATION, TURN_GAIN_STD, VEER_STD = 1.6, 0.25, 0.03
HEADING_BIAS_STD_RADPS, GYRO_BIAS_STD_RADPS = 1e-4, 0.02
"""Prior: a half of each side's speed forward, no side slip, a separation of 1.6 b, straight ahead for equal speeds."""


class Knots(NamedTuple):
    """Motion at the fixes, as integrals since the first: a window is a difference of two rows.

    Attributes
    ----------
    t : (m,) [s] since `epoch_ns`
    place : complex (m,) north + j east [m]; variance : (m,) of it, one axis [m^2]
    heading : (m,) [rad], unwrapped
    turn : (m,) [rad] by heading or gyro; turn_variance : of one value of it [rad^2]; turn_bias_std : [rad/s]
    left, right : complex (m,) distance of each side laid along the measured heading [m]
    left_m, right_m : (m,) distance of each side
    bent : complex (m,) integral of j v (V_l - V_r), laid along the heading [m^2/s]
    path_m : (m,) mean distance of the sides, forward or not
    held_m2 : (m,) variance that values held from sample to sample add to a side's distance
    v_left, v_right : (m,) [m/s]
    holes : (m,) number of holes in any stream so far
    width_m : b, or what stands for it
    """

    epoch_ns: int
    t: Floats
    place: Complexes
    variance: Floats
    heading: Floats
    turn: Floats
    turn_variance: float
    turn_bias_std: float
    left: Complexes
    right: Complexes
    left_m: Floats
    right_m: Floats
    bent: Complexes
    path_m: Floats
    held_m2: Floats
    v_left: Floats
    v_right: Floats
    holes: Ints
    width_m: float

    def rows(self, kept: Bools) -> Knots:
        """Return the knots marked in `kept` (m,)."""
        columns: dict[str, Any] = {
            name: value[kept] for name, value in self._asdict().items() if isinstance(value, np.ndarray)
        }
        return self._replace(**columns)


class Motion(NamedTuple):
    """Motion model, linear in the speeds of the sides.

    Attributes
    ----------
    left, right : complex; body displacement, forward + j right, for each metre of a side
    centripetal_s : sideways slip for v (V_l - V_r) [s/m]
    place_delay_s, turn_delay_s : by how much place and turn follow the wheels
    turn_gain : turn for each metre that left goes ahead of right [rad/m]: 1 / W
    veer : turn for each metre straight ahead [rad/m]
    turn_bias : [rad/s], of a gyro

    Notes
    -----
    Eqs. 8-10 with a scale a: left = a (y_r - j x) / W, right = a (-y_l + j x) / W, turn_gain = a / W.
    """

    left: complex
    right: complex
    centripetal_s: float
    place_delay_s: float
    turn_gain: float
    veer: float
    turn_delay_s: float
    turn_bias: float


class Windows(NamedTuple):
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
        return self.residual_of(slice(None))

    def rows(self, kept: Bools) -> Windows:
        """Return the windows marked in `kept` (w,)."""
        columns: dict[str, Any] = {name: column[kept] for name, column in self._asdict().items()}
        return self._replace(**columns)

    def residual_of(self, rows: slice) -> Floats:
        """Return the residual of some windows (k, 3) [m]."""
        return np.column_stack([self.ahead[rows], self.aside[rows], self.turned[rows]])


def lay_knots(sensors: SensorData, width_m: float) -> Knots | None:
    """Integrate the wheels to the times of the fixes; None where the streams share too little time."""
    wheels, fixes, heading = sensors.wheels, sensors.fixes, sensors.headings
    if min(len(wheels.stamp_ns), len(fixes.stamp_ns), len(heading.stamp_ns)) < FEWEST_WINDOWS:
        return None
    epoch = int(wheels.stamp_ns[0])
    t_wheel, t_fix, t_heading = ((s.stamp_ns - epoch) / 1e9 for s in (wheels, fixes, heading))
    rows = _thinned(t_fix, max(t_wheel[0], t_heading[0]), min(t_wheel[-1], t_heading[-1]))
    if len(rows) < FEWEST_WINDOWS:
        return None
    t = t_fix[rows]
    psi = np.unwrap(heading.heading_rad)
    dt = np.diff(t_wheel)
    v_left, v_right = wheels.v_left_mps[:-1], wheels.v_right_mps[:-1]
    nose = np.exp(1j * np.interp(t_wheel[:-1] + dt / 2, t_heading, psi))

    def at(speed: Floats | Complexes, shift_s: float = 0.0) -> Complexes:
        return np.asarray(np.interp(t + shift_s, t_wheel, np.concatenate([[0.0], np.cumsum(speed * dt)])))

    def speed_at(speed: Floats) -> Floats:
        return np.asarray((at(speed, SPEED_S / 2) - at(speed, -SPEED_S / 2)).real / SPEED_S, np.float64)

    heading_at = np.interp(t, t_heading, psi)
    variance = np.maximum((fixes.var_north_m2 + fixes.var_east_m2) / 2, LEAST_STD_M**2)
    holes = _holes(t, t_wheel) + _holes(t, t_heading)
    fix_gap = np.diff(t) > max(LONGEST_HOLE_S, HOLE_IN_INTERVALS * float(np.median(np.diff(t))))
    holes = holes + np.concatenate([[0], np.cumsum(fix_gap)])
    knots = Knots(
        epoch_ns=epoch, t=t, place=(fixes.north_m + 1j * fixes.east_m)[rows], variance=variance[rows],
        heading=heading_at, turn=heading_at, turn_variance=_white_variance(heading_at),
        turn_bias_std=HEADING_BIAS_STD_RADPS,
        left=at(v_left * nose), right=at(v_right * nose), left_m=at(v_left).real, right_m=at(v_right).real,
        bent=at(1j * (v_left + v_right) / 2 * (v_left - v_right) * nose),
        path_m=at((np.abs(v_left) + np.abs(v_right)) / 2).real,
        held_m2=np.interp(t, t_wheel[:-1], _held_variance(t_wheel[:-1], v_left, v_right)),
        v_left=speed_at(v_left), v_right=speed_at(v_right), holes=holes, width_m=width_m,
    )  # fmt: skip
    return knots if sensors.gyro is None else _with_better_turn(knots, sensors.gyro)


def cut(knots: Knots, duration_s: float) -> tuple[Ints, Ints]:
    """Return first and last rows of the windows (w,) of that duration, or one fix more, which span no hole."""
    first = np.arange(len(knots.t))
    last = np.searchsorted(knots.t, knots.t + duration_s - KNOT_S / 2)
    inside = last < len(knots.t)
    first, last = first[inside], last[inside]
    whole = (last > first) & (knots.holes[first] == knots.holes[last])
    return first[whole], last[whole]


def fit_motion(knots: Knots, used: Bools | None = None) -> Motion | None:
    """Fit the motion model to windows of a second; None where there are too few.

    Parameters
    ----------
    used : (m,) knots that may be inside a window; default all
    """
    first, last = cut(knots, FIT_WINDOW_S)
    path = knots.path_m[last] - knots.path_m[first]
    moving = path > MOVING_SHARE * (float(np.quantile(path, 0.9)) if len(path) else 0.0)
    if used is not None:
        unused = np.concatenate([[0], np.cumsum(~used)])
        moving &= unused[last + 1] == unused[first]
    first, last = first[moving], last[moving]
    if len(first) < FEWEST_WINDOWS:
        return None
    place, turn = _fit_place(knots, first, last), _fit_turn(knots, first, last)
    return Motion(
        complex(place.x[0], place.x[1]), complex(place.x[2], place.x[3]), float(place.x[4]), float(place.x[5]),
        float(turn.x[0]), float(turn.x[1]), float(turn.x[2] / max(abs(turn.x[0]), 1e-9)), float(turn.x[3]),
    )  # fmt: skip


def compare(knots: Knots, motion: Motion, first: Ints, last: Ints, response_s: float) -> Windows:
    """Compare reference and wheels between rows of the knots (w,).

    Parameters
    ----------
    response_s : standard deviation of the time by which the robot follows its wheels
    """
    level = np.exp(-0.5j * (knots.heading[first] + knots.heading[last]))
    left, right, bent, change, place = (
        level * (column[last] - column[first])
        for column in (knots.left, knots.right, knots.bent, _velocity(knots), knots.place)
    )
    model = motion.left * left + motion.right * right + motion.centripetal_s * bent - motion.place_delay_s * change
    lever = 0.5 / max(abs(motion.turn_gain), 1e-3)
    apart, along, spin, dt = _turn_columns(knots, first, last)
    model_turn = motion.turn_gain * (apart - motion.turn_delay_s * spin) + motion.veer * along
    turn = knots.turn[last] - knots.turn[first] - motion.turn_bias * dt
    miss = place - model
    scale = abs(motion.left + motion.right)
    noise = knots.variance[first] + knots.variance[last]
    held = scale**2 * (knots.held_m2[last] - knots.held_m2[first]) / 2
    answer = scale**2 * response_s**2
    ahead = answer * np.abs(change) ** 2
    spun = answer * spin**2 / 4
    turn_noise = lever**2 * 2 * knots.turn_variance
    return Windows(
        first, last, miss.real, miss.imag, lever * (turn - model_turn), model.real, lever * model_turn,
        np.maximum(np.abs(place), lever * np.abs(turn)), scale * (knots.path_m[last] - knots.path_m[first]),
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
    interval = np.diff(sampled)
    holes = sampled[:-1][interval > max(LONGEST_HOLE_S, HOLE_IN_INTERVALS * float(np.median(interval)))]
    return np.asarray(np.searchsorted(holes, t, side="left"))


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


def _velocity(knots: Knots) -> Complexes:
    return np.asarray((knots.v_left + knots.v_right) / 2 * np.exp(1j * knots.heading))


def _turn_columns(knots: Knots, first: Ints, last: Ints) -> tuple[Floats, Floats, Floats, Floats]:
    left, right = (column[last] - column[first] for column in (knots.left_m, knots.right_m))
    apart = knots.v_left - knots.v_right
    return left - right, (left + right) / 2, apart[last] - apart[first], knots.t[last] - knots.t[first]


def _fit_place(knots: Knots, first: Ints, last: Ints) -> RobustFit:
    level = np.exp(-0.5j * (knots.heading[first] + knots.heading[last]))
    left, right, bent, change, place = (
        level * (column[last] - column[first])
        for column in (knots.left, knots.right, knots.bent, _velocity(knots), knots.place)
    )
    path = knots.path_m[last] - knots.path_m[first]
    weight = 1.0 / np.sqrt(knots.variance[first] + knots.variance[last] + (FIT_MODEL_ERROR * path) ** 2)
    columns = np.column_stack([left, 1j * left, right, 1j * right, bent, -change]) * weight[:, None]
    design, seen = np.concatenate([columns.real, columns.imag]), place * weight
    values = np.concatenate([seen.real, seen.imag])
    mean = np.array([SIDE_GAIN, 0.0, SIDE_GAIN, 0.0, 0.0, 0.0])
    std = np.array([SIDE_GAIN_STD, SIDEWAYS_STD, SIDE_GAIN_STD, SIDEWAYS_STD, CENTRIPETAL_STD_S, DELAY_STD_S])
    return _fit(design, values, mean, std, knots)


def _fit_turn(knots: Knots, first: Ints, last: Ints) -> RobustFit:
    apart, along, spin, dt = _turn_columns(knots, first, last)
    gain = 1.0 / (SEPARATION * knots.width_m)
    path = knots.path_m[last] - knots.path_m[first]
    weight = 1.0 / np.sqrt(2 * knots.turn_variance + (FIT_MODEL_ERROR * gain * 2 * path) ** 2 + 1e-12)
    design = np.column_stack([apart, along, -spin, dt]) * weight[:, None]
    mean = np.array([gain, 0.0, 0.0, 0.0])
    std = np.array([TURN_GAIN_STD / knots.width_m, VEER_STD, gain * DELAY_STD_S, knots.turn_bias_std])
    return _fit(design, (knots.turn[last] - knots.turn[first]) * weight, mean, std, knots)


def _fit(design: Floats, values: Floats, mean: Floats, std: Floats, knots: Knots) -> RobustFit:
    overlap = max(1.0, FIT_WINDOW_S / float(np.median(np.diff(knots.t))))
    return robust_least_squares(lambda x: (design @ x - values, design), mean, mean, std, overlap=overlap)


def _with_better_turn(knots: Knots, gyro: GyroSamples) -> Knots:
    """Return the knots with the gyro's turn, where it agrees with the heading's and the wheels explain it better."""
    t_gyro = (gyro.stamp_ns - knots.epoch_ns) / 1e9
    if len(t_gyro) < FEWEST_WINDOWS or knots.t[0] < t_gyro[0] or knots.t[-1] > t_gyro[-1]:
        return knots
    angle = np.concatenate([[0.0], np.cumsum(gyro.rate_radps[:-1] * np.diff(t_gyro))])
    turn = np.interp(knots.t, t_gyro, angle)
    other = knots._replace(
        turn=turn, turn_variance=_white_variance(turn), turn_bias_std=GYRO_BIAS_STD_RADPS,
        holes=knots.holes + _holes(knots.t, t_gyro),
    )  # fmt: skip
    first, last = cut(other, FIT_WINDOW_S)
    if len(first) < FEWEST_WINDOWS:
        return knots
    (gain, spread), (other_gain, other_spread) = (_turn_by_wheels(one, first, last) for one in (knots, other))
    agrees = abs(other_gain - gain) < SAME_TURN * abs(gain)
    return other if agrees and other_spread < spread else knots


def _turn_by_wheels(knots: Knots, first: Ints, last: Ints) -> tuple[float, float]:
    """Return the turn gain of the wheels [rad/m], and the robust spread of the turns about it [rad]."""
    x = _fit_turn(knots, first, last).x
    apart, along, spin, dt = _turn_columns(knots, first, last)
    turn = knots.turn[last] - knots.turn[first]
    return float(x[0]), mad_std(turn - np.column_stack([apart, along, -spin, dt]) @ x, 0.0)
