"""Estimate antenna, heading offset, delays, wheel scales and ICR separation from one log, with standard deviations.

What can be observed
    The body moves with v_x = (V_l' + V_r') / 2 + s omega, v_y = -x omega, omega = (V_l' - V_r') / W (Eqs. 8-12 with
    W = y_r - y_l, s = (y_r + y_l) / 2, V' = scale V). An antenna at (f, r) in the body frame moves, in that frame, with

        v_forward = (V_l' + V_r') / 2 + (s - r) omega,      v_right = (f - x) omega.

    So position determines f - x and r - s, but not f, x, r and s separately: an antenna further ahead has the same
    effect as ICRs further back. W and both scales are separable: heading determines scale_l / W and scale_r / W, and
    position scale_l and scale_r. At constant speed, f - x is not separable from a delay of the fixes (v_right then
    differs by speed times delay times omega). On a circle it is not separable from the heading offset, nor r - s from
    the scales.
Method
    Windows of driven distance between fixes, of two lengths. In each window the displacement of the fixes is compared
    with the wheel travel along the measured heading, and the change of heading with the travel difference over W. The
    model is linear in all parameters except the offset and the delays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icrtool.calibration.evidence import (
    LONG_WINDOW,
    STARTS_A_WINDOW,
    DriveFacts,
    Evidence,
    gather,
    summarise_drive,
)
from icrtool.config import Config
from icrtool.kernels.robust import mad_std
from icrtool.records.run import half_width_m
from icrtool.records.tables import Complexes, Floats, RobotLog

HUBER_SIGMAS = 2.0
ITERATIONS = 30
FEWEST_STRETCHES = 5
STEP_S = 0.02
"""Delays are differentiated over this step."""

NAMES = (
    "ahead", "aside", "offset", "gnss_delay", "heading_delay", "gnss_after_heading", "left_scale", "right_scale",
    "separation",
)  # fmt: skip
"""f - x [m], r - s [m], heading offset [rad], delays of fixes and of headings against the wheels and of fixes against
headings [s], scales, W [m]: the order of every vector here."""

PRIOR_STD = np.array([1.0, 1.0, math.pi, 0.5, 0.5, 0.05, 0.2, 0.2, 1.0])
"""Wide, except for the delay of fixes relative to headings: receiver and AHRS of one robot usually agree to a tenth of
a second. At constant speed only this prior separates that delay from the antenna's position."""

SAME_CLOCK_S = 1e-3
"""Prior of that delay where both are fields of the same messages."""


class WindowResiduals(NamedTuple):
    """Residuals of all windows before the calibration (only W estimated) and after it.

    Attributes
    ----------
    before, after : (3, w) along and across [m], heading change [rad]; prediction minus measurement
    turn_rad : (w,) heading change measured
    """

    before: Floats
    after: Floats
    turn_rad: Floats


@dataclass(frozen=True, slots=True)
class Estimate:
    """All parameters, in the order of `NAMES`, and their covariance.

    Attributes
    ----------
    values : (9,); covariance : (9, 9)
    windows, stretches : number of windows, and of stretches of distance that count as independent
    residuals : of all windows, before and after
    miss_m, miss_rad : robust standard deviation of short windows' displacements and heading changes
    """

    values: Floats
    covariance: Floats
    windows: int
    stretches: int
    miss_m: float
    miss_rad: float
    facts: DriveFacts
    residuals: WindowResiduals

    @property
    def std(self) -> Floats:
        """One standard deviation of each value (9,)."""
        deviations: Floats = np.sqrt(np.diag(self.covariance))
        return deviations

    @property
    def correlation(self) -> Floats:
        """Correlation matrix (9, 9)."""
        matrix: Floats = self.covariance / np.outer(self.std, self.std)
        return matrix


def estimate(log: RobotLog, config: Config | None = None) -> Estimate:
    """Return antenna, heading offset, delays, wheel scales and W estimated from one log, with their covariance.

    Raises
    ------
    DataError
        Fewer than twenty windows.

    Notes
    -----
    Gauss-Newton with Huber's weights (Huber 1964). Residuals along, across and of heading have a robust scale each, for
    short and for long windows. For the covariance a stretch of twice the long window is one independent sample
    (sandwich, White 1982); it is never less than the inverse of the information matrix.
    """
    config = config if config is not None else Config()
    evidence = gather(log, config)
    width = 2.0 * half_width_m(config.robot.track_width_m)
    values = np.array([0.0, 0.0, _first_offset(evidence), 0.0, 0.0, 0.0, 1.0, 1.0, 1.4 * width])
    spread = PRIOR_STD.copy()
    topics = {stream.role: stream.topic for stream in log.streams}
    if topics.get("gnss") == topics.get("heading", ""):
        spread[5] = SAME_CLOCK_S
    mean, prior = values.copy(), 1.0 / spread
    damping = 1e-3
    weights, scale = np.empty(0), np.ones(1)
    information = np.eye(len(NAMES))
    for iteration in range(ITERATIONS):
        residual, jacobian = compare(evidence, values)
        if iteration < ITERATIONS // 2 or not len(weights):
            scale = _scales(evidence, residual)
        weights = 1.0 / (scale * np.sqrt(np.maximum(1.0, np.abs(residual / scale) / HUBER_SIGMAS)))
        weighted = jacobian * weights[:, None]
        share = 1.0 / _overlap()
        information = share * weighted.T @ weighted + np.diag(prior**2)
        gradient = share * weighted.T @ (residual * weights) + prior**2 * (values - mean)
        step = np.linalg.solve(information + damping * np.diag(np.diag(information)), -gradient)
        values = values + np.clip(step, -0.5 * spread, 0.5 * spread)
        values[8] = max(values[8], 0.2 * width)
        if np.all(np.abs(step) * np.sqrt(np.diag(information)) < 1e-3):
            break
    residual, jacobian = compare(evidence, values)
    covariance, stretches = _covariance(evidence, residual * weights, jacobian * weights[:, None], information)
    short = np.flatnonzero(evidence.long == 0)
    untouched = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, values[8]])
    count = len(evidence.begin)
    return Estimate(
        values=values,
        covariance=covariance,
        windows=count,
        stretches=stretches,
        miss_m=float(np.hypot(scale[short[0]], scale[count + short[0]])),
        miss_rad=float(scale[2 * count + short[0]]),
        facts=summarise_drive(evidence),
        residuals=WindowResiduals(
            compare(evidence, untouched)[0].reshape(3, -1), residual.reshape(3, -1), _predict(evidence, values).turned
        ),
    )


def compare(evidence: Evidence, values: Floats) -> tuple[Floats, Floats]:
    """Return the residuals of all windows (3 w,) and their Jacobian (3 w, 9).

    Residuals: along and across the heading at the window's start [m], then heading change [rad]; prediction minus
    measurement.
    """
    now = _predict(evidence, values)
    turn, seen = np.exp(-1j * values[2]), evidence.fix[evidence.end]
    moved = _moved(now, values)
    jacobian = np.zeros((3, len(evidence.begin), len(NAMES)))
    changes = {0: turn * now.swing, 1: 1j * turn * now.swing, 2: -1j * moved, 6: turn * now.left, 7: turn * now.right}
    for column in (3, 4, 5):
        ahead, behind = (_predict(evidence, _shifted(values, column, step)) for step in (STEP_S / 2, -STEP_S / 2))
        changes[column] = (_moved(ahead, values) - _moved(behind, values)) / STEP_S
        jacobian[2, :, column] = (_turned(ahead, values) - _turned(behind, values)) / STEP_S
    for column, change in changes.items():
        aligned = change * now.aligned
        jacobian[0, :, column], jacobian[1, :, column] = aligned.real, aligned.imag
    expected = _turned(now, values)
    jacobian[2, :, 6], jacobian[2, :, 7] = now.travel_left / values[8], -now.travel_right / values[8]
    jacobian[2, :, 8] = -expected / values[8]
    left = (moved - (seen - evidence.fix[evidence.begin])) * now.aligned
    residual = np.concatenate([left.real, left.imag, expected - now.turned])
    return residual, jacobian.reshape(-1, len(NAMES))


def _moved(predicted: _Prediction, values: Floats) -> Complexes:
    """Return the antenna's displacements, north + j east [m]."""
    arm = values[0] + 1j * values[1]
    place: Complexes = np.exp(-1j * values[2]) * (
        values[6] * predicted.left + values[7] * predicted.right + arm * predicted.swing
    )
    return place


def _turned(predicted: _Prediction, values: Floats) -> Floats:
    """Return the changes of heading by the wheels [rad]."""
    change: Floats = (values[6] * predicted.travel_left - values[7] * predicted.travel_right) / values[8]
    return change


def _shifted(values: Floats, column: int, step: float) -> Floats:
    shifted = values.copy()
    shifted[column] += step
    return shifted


class _Prediction(NamedTuple):
    """Motion in each window by wheels and heading.

    Attributes
    ----------
    left, right : complex (w,), half the travel of each side, along the measured heading [m]
    swing : complex (w,), displacement of a point one metre ahead while the robot turns
    travel_left, travel_right : (w,) [m], over the time of `turned`
    turned : (w,) measured change of heading [rad]
    aligned : complex (w,), factor from north + j east to along + j across, at the window's start
    """

    left: Complexes
    right: Complexes
    swing: Complexes
    travel_left: Floats
    travel_right: Floats
    turned: Floats
    aligned: Complexes


def _predict(evidence: Evidence, values: Floats) -> _Prediction:
    """Return the motion in each window by wheels and heading, for given delays.

    A fix stamped t is the position reached by the wheels at t - gnss_delay, and belongs to the heading stamped
    t - gnss_after_heading. A heading stamped t is the one reached by the wheels at t - heading_delay. The three delays
    are independent: a robot's own response to its wheels, in speed and in turning, looks like a delay, too.
    """
    t, begin, end = evidence.wheel_t, evidence.begin, evidence.end
    gnss_delay, heading_delay, apart = values[3:6]
    along = np.exp(
        1j * np.interp(t + evidence.wheel_dt / 2 + (gnss_delay - apart), evidence.heading_t, evidence.heading)
    )
    psi = np.interp(evidence.fix_t - apart, evidence.heading_t, evidence.heading)
    stamped = np.interp(evidence.fix_t, evidence.heading_t, evidence.heading)

    def between(step: Floats, delay: float) -> Floats:
        at: Floats = np.interp(evidence.fix_t - delay, t, np.concatenate([[0.0], np.cumsum(step)[:-1]]))
        return np.asarray(at[end] - at[begin], np.float64)

    laid, travels = [], []
    for speed in (evidence.v_left, evidence.v_right):
        step = evidence.wheel_dt * speed
        half = step / 2 * along
        laid.append(between(half.real, gnss_delay) + 1j * between(half.imag, gnss_delay))
        travels.append(between(step, heading_delay))
    return _Prediction(
        left=laid[0],
        right=laid[1],
        swing=np.exp(1j * psi[end]) - np.exp(1j * psi[begin]),
        travel_left=travels[0],
        travel_right=travels[1],
        turned=stamped[end] - stamped[begin],
        aligned=np.exp(-1j * (psi[begin] - values[2])),
    )


def _first_offset(evidence: Evidence) -> float:
    """Return a first estimate of the heading offset [rad] by the displacements, without antenna and delays."""
    now = _predict(evidence, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]))
    laid = now.left + now.right
    seen = evidence.fix[evidence.end] - evidence.fix[evidence.begin]
    size = np.abs(laid) * np.abs(seen)
    unit = np.divide(laid * np.conj(seen), np.maximum(size, 1e-9))
    return float(np.angle((unit * np.minimum(np.abs(seen), 1.0)).sum()))


def _scales(evidence: Evidence, residual: Floats) -> Floats:
    """Return the robust standard deviation of each residual's kind: along, across, heading; short and long windows."""
    count = len(evidence.begin)
    scale = np.ones(3 * count)
    for kind in range(3):
        for long in (0, 1):
            rows = kind * count + np.flatnonzero(evidence.long == long)
            if len(rows):
                scale[rows] = max(mad_std(residual[rows], 0.0), 1e-5)
    return scale


def _overlap() -> float:
    """Return how many overlapping windows, of both lengths, count as one independent window."""
    return 2.0 * STARTS_A_WINDOW


def _covariance(evidence: Evidence, residual: Floats, jacobian: Floats, information: Floats) -> tuple[Floats, int]:
    """Return the sandwich covariance, nowhere less than the inverse of `information`, and the number of stretches."""
    length = (
        float(np.median(evidence.distance_m[1:] - evidence.distance_m[:-1])) if len(evidence.distance_m) > 1 else 1.0
    )
    stretch_m = max(2.0 * LONG_WINDOW * STARTS_A_WINDOW * length, 1e-3)
    stretch = np.unique((np.tile(evidence.distance_m, 3) / stretch_m).astype(np.int64), return_inverse=True)[1]
    count = int(stretch.max()) + 1
    gradients = np.zeros((count, jacobian.shape[1]))
    np.add.at(gradients, stretch, jacobian * residual[:, None] / _overlap())
    meat = gradients.T @ gradients * (count / max(count - 1, 1))
    inverse = np.linalg.solve(information, np.eye(len(information)))
    sandwich: Floats = inverse @ meat @ inverse
    grown = np.sqrt(np.maximum(1.0, np.diag(inverse) / np.maximum(np.diag(sandwich), 1e-300)))
    if count < FEWEST_STRETCHES:
        wide = inverse * max(1.0, float(np.max(np.diag(sandwich) / np.diag(inverse))))
        return np.asarray(wide, np.float64), count
    covariance: Floats = np.asarray(sandwich * np.outer(grown, grown), np.float64)
    return covariance, count
