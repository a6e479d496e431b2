"""One estimate of what relates wheels, heading and positions: scales, ICRs, heading offset, delays.

With the heading measured along the path, all of it is linear but for the heading offset and the delays. Windows of
driven distance from fix i to fix j, and windows of time of the heading itself:

    p_j - p_i = e^{j d} [a ∫v e^{j psi} + m ∫u e^{j psi} + c ∫j u e^{j psi} + l ∫j v w e^{j psi}],   u = (V_l - V_r)/2
    psi(t + T) - psi(t) = k ∫w + q ∫v/b + g T,                                                       w = (V_l - V_r)/b

with psi taken tau_h later than stamped, and p tau_p earlier. Then a is the wheel scale, W = a b/k, and in general
y_r = (∂v_x/∂V_l)/(∂ω/∂V_l), y_l = (∂v_x/∂V_r)/(∂ω/∂V_r), x = -c/(2 k/b) (Pentzer 2014, Eqs. 8-12).

Not separable: a sideways crab from the offset; the antenna's place from the ICRs (forward from x_icr, right from the
middle of y); sideways slip l from tau_p at constant speed. Priors decide.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.alignment.drive_windows import TURN_WINDOW_S, DriveArrays, DriveWindows
from icrtool.kernels.robust import RobustFit, robust_least_squares
from icrtool.records.tables import Complexes, Floats

NAMES = ("scale", "middle", "x", "slip", "turn", "asymmetry", "drift", "offset", "position_delay", "heading_delay")
A, M, C, L, K, Q, G, D, TP, TH = range(10)

PRIOR_MEAN = np.array([1.0, 0.0, 0.0, 0.0, 0.6, 0.0, 0.0, 0.0, 0.0, 0.0])
PRIOR_STD = np.array([0.5, 0.5, 0.6, 0.1, 0.6, 0.05, 0.01, math.inf, 0.5, 0.5])
"""Wide: they keep apart what a drive does not, and say nothing where it does."""

SAME_CLOCK_STD_S = 0.05
"""Delays of position and heading of one robot usually agree to this; fields of the same messages agree exactly."""

STEP_S = 0.02
"""Delays are differentiated over this step."""

OVERLAP = 8.0
FEWEST_WINDOWS = 16
LARGEST_DELAY_S = 1.0


class Geometry(NamedTuple):
    """What the estimate says of the robot, with covariance.

    Attributes
    ----------
    values : (6,) y_icr_right, y_icr_left, x_icr [m], left scale, right scale, W [m]
    covariance : (6, 6)
    """

    values: Floats
    covariance: Floats


class AlignmentFit(NamedTuple):
    """The parameters in the order of `NAMES`, with covariance.

    Attributes
    ----------
    fit : the robust fit; width_m : b that w was formed with
    windows : DriveWindows it was made of
    """

    fit: RobustFit
    width_m: float
    windows: DriveWindows

    def value(self, name: str) -> float:
        """Return a parameter."""
        return float(self.fit.x[NAMES.index(name)])

    def std(self, name: str) -> float:
        """Return a parameter's standard deviation."""
        return float(self.fit.std[NAMES.index(name)])

    def geometry(self) -> Geometry:
        """Return ICRs and side scales, and their covariance by complex-step differentiation of first order."""
        x, b = self.fit.x, self.width_m
        columns = []
        for i in range(len(x)):
            moved = x.astype(np.complex128)
            moved[i] += 1e-20j
            columns.append(_geometry(moved, b).imag / 1e-20)
        jacobian = np.column_stack(columns)
        return Geometry(_geometry(x.astype(np.complex128), b).real, jacobian @ self.fit.covariance @ jacobian.T)


def _geometry(x: Complexes, b: float) -> Complexes:
    left, right = (x[K] + x[Q] / 2) / b, (x[K] - x[Q] / 2) / b
    y_right, y_left = (x[A] + x[M]) / 2 / left, -(x[A] - x[M]) / 2 / right
    width = y_right - y_left
    return np.array([y_right, y_left, -x[C] * b / (2 * x[K]), left * width, right * width, width])


def estimate_alignment(drive: DriveArrays, windows: DriveWindows, width_m: float) -> AlignmentFit | None:
    """Estimate all parameters jointly; None with too few windows.

    Parameters
    ----------
    drive : with a heading; windows : of the same drive
    width_m : the track width b

    Notes
    -----
    Soft-L1 weights, each residual kind (along, across, turn) with its own robust scale; covariance from groups of
    distance (`icrtool.kernels.robust`).
    """
    if len(windows.begin) < FEWEST_WINDOWS or len(windows.turn_begin) < FEWEST_WINDOWS:
        return None
    model = _Model(drive, windows, width_m)
    start = PRIOR_MEAN.copy()
    start[D] = model.first_offset()
    w, u = len(windows.begin), len(windows.turn_begin)
    kind = np.concatenate([np.zeros(w, np.int64), np.ones(w, np.int64), np.full(u, 2)])
    group = np.concatenate([windows.group, windows.group, windows.turn_group])
    prior_std = PRIOR_STD
    fit = robust_least_squares(
        model.evaluate, model.reduced(start), model.reduced(PRIOR_MEAN), model.reduced(prior_std),
        kind=np.append(kind, 3) if model.has_clock_row else kind,
        group=np.append(group, -1) if model.has_clock_row else group,
        overlap=OVERLAP, most_steps=20,
    )  # fmt: skip
    return AlignmentFit(fit, width_m, windows)


class _Model:
    """Residuals of the windows and their Jacobian."""

    def __init__(self, drive: DriveArrays, windows: DriveWindows, width_m: float) -> None:
        self.drive, self.windows, self.b = drive, windows, width_m
        self.v = (drive.v_left + drive.v_right) / 2
        self.u = (drive.v_left - drive.v_right) / 2
        self.middle_t = drive.wheel_t + drive.wheel_dt / 2
        self.seen = drive.fix[windows.end] - drive.fix[windows.begin]
        self.turn_v, self.turn_w = self._cumulate(self.v).real, self._cumulate(2 * self.u / width_m).real
        self.has_clock_row = False
        h = drive
        # lightly smoothed: single headings are noisy, and their mean over a fifth of a second is not
        self.turned = np.interp(windows.turn_end, h.heading_t, h.heading) - np.interp(
            windows.turn_begin, h.heading_t, h.heading
        )

    def reduced(self, x: Floats) -> Floats:
        return x

    def _cumulate(self, rate: Floats | Complexes) -> Complexes:
        return np.concatenate([[0.0], np.cumsum((rate * self.drive.wheel_dt)[:-1])])

    def first_offset(self) -> float:
        """Return the direction of the displacements from wheels laid along the heading [rad]."""
        nose = np.exp(1j * np.interp(self.middle_t, self.drive.heading_t, self.drive.heading))
        at = np.interp(self.drive.fix_t, self.drive.wheel_t, self._cumulate(self.v * nose))
        laid = at[self.windows.end] - at[self.windows.begin]
        unit = self.seen * np.conj(laid)
        return float(np.angle(np.sum(unit / np.maximum(np.abs(unit), 1e-12))))

    def evaluate(self, x: Floats) -> tuple[Floats, Floats]:
        drive, windows = self.drive, self.windows
        a, m, c, slip, k, q, g, offset, late_p, late_h = x

        def heading_at(t: Floats) -> Floats:
            return np.interp(t + late_h, drive.heading_t, drive.heading)

        psi = heading_at(self.middle_t)
        rate = (heading_at(self.middle_t + STEP_S) - heading_at(self.middle_t - STEP_S)) / (2 * STEP_S)
        nose = np.exp(1j * psi)
        body = a * self.v + m * self.u + 1j * (c * self.u + slip * self.v * 2 * self.u / self.b)
        fields = [self.v * nose, self.u * nose, 1j * self.u * nose, 1j * self.v * 2 * self.u / self.b * nose, body * nose, 1j * rate * body * nose]
        turn = np.exp(1j * offset)
        cumulated = [self._cumulate(field) for field in fields]
        begin, end = windows.begin, windows.end
        t = drive.fix_t - late_p
        spans = []
        for one in cumulated:
            at = np.interp(t, drive.wheel_t, one)
            spans.append(turn * (at[end] - at[begin]))
        ahead, back = (np.interp(t + s, drive.wheel_t, cumulated[4]) for s in (-STEP_S, STEP_S))
        slope = (ahead - back) / (2 * STEP_S)
        predicted = spans[4]
        level = np.exp(-1j * (offset + 0.5 * (np.interp(t[begin], drive.heading_t, drive.heading) + np.interp(t[end], drive.heading_t, drive.heading))))
        left = (predicted - self.seen) * level
        columns = np.zeros((len(begin), len(x)), np.complex128)
        columns[:, A], columns[:, M], columns[:, C], columns[:, L] = spans[:4]
        columns[:, D] = 1j * predicted
        columns[:, TP] = turn * (slope[end] - slope[begin])
        columns[:, TH] = spans[5]
        columns *= level[:, None]
        # heading changes
        tb, te = windows.turn_begin - late_h, windows.turn_end - late_h

        def over(values: Floats, shift: float = 0.0) -> Floats:
            return np.interp(te + shift, drive.wheel_t, values) - np.interp(tb + shift, drive.wheel_t, values)

        w, v = over(self.turn_w), over(self.turn_v) / self.b
        turn_columns = np.zeros((len(tb), len(x)))
        turn_columns[:, K], turn_columns[:, Q], turn_columns[:, G] = w, v, TURN_WINDOW_S
        turn_columns[:, TH] = k * (over(self.turn_w, -STEP_S) - over(self.turn_w, STEP_S)) / (2 * STEP_S)
        turn_left = k * w + q * v + g * TURN_WINDOW_S - self.turned
        residuals = np.concatenate([left.real, left.imag, turn_left])
        jacobian = np.concatenate([columns.real, columns.imag, turn_columns])
        return residuals, jacobian
