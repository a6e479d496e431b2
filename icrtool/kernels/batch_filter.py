"""Many filter runs in one compiled call; and what only a study needs: other guards, a truth that obeys the model."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.compiled import njit
from icrtool.kernels.ekf import (
    REFERENCE_STEP_S,
    FilterOutput,
    FilterParameters,
    Measurements,
    filter_loop,
    take_fix,
    take_heading,
)
from icrtool.kernels.ekf_step import DIAGONAL
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M, body_velocity

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

TOOL, UNGUARDED, GUARDED, PRINTED = 0, 1, 2, 3
"""The filter as it is; and kernels for Section 5.1: Eqs. 8-10, Eqs. 32-34 with their true derivatives or as printed."""


class Batch(NamedTuple):
    """Runs that share their stamps and their noise.

    Attributes
    ----------
    wheel_t : (n,) [s], n >= 2; gnss_t : (m,); heading_t : (h,); change_t : (c,), as in `Measurements`
    gnss_r : (m, 2) [m^2]; heading_r : (h,) [rad^2]
    v_left, v_right : (runs, n) [m/s]; gnss_z : (runs, m, 2) [m]; heading_z : (runs, h) [rad]
    t0 : time of the start [s]; x0 : (runs, 6) states there; P0 : (21,) upper triangle of the covariance there
    stops : (s,) rows of wheel_t, increasing, the last one n - 1, after which the whole covariance is kept
    """

    wheel_t: Floats
    gnss_t: Floats
    heading_t: Floats
    change_t: Floats
    gnss_r: Floats
    heading_r: Floats
    v_left: Floats
    v_right: Floats
    gnss_z: Floats
    heading_z: Floats
    t0: float
    x0: Floats
    P0: Floats
    stops: Ints


class BatchOutput(NamedTuple):
    """What the runs leave behind.

    Attributes
    ----------
    x, variance : (runs, k, 6) states and the diagonal of P, from the first wheel sample at or after t0 on
    P : (runs, s, 21) upper triangle of the covariance at every stop
    gnss_nis : (runs, m); heading_nis : (runs, h), NaN where unseen
    """

    x: Floats
    variance: Floats
    P: Floats
    gnss_nis: Floats
    heading_nis: Floats


def run_batch(batch: Batch, parameters: FilterParameters, guard: int = TOOL) -> BatchOutput:
    """Run the filter over every run of a batch, in one compiled call that frees the GIL.

    Parameters
    ----------
    guard : TOOL is `icrtool.kernels.ekf`; the others are kernels of this module, see `free_predict`
    """
    runs, first = len(batch.x0), int(np.searchsorted(batch.wheel_t, batch.t0))
    rows = len(batch.wheel_t) - first
    out = BatchOutput(
        x=np.empty((runs, rows, 6)),
        variance=np.empty((runs, rows, 6)),
        P=np.empty((runs, len(batch.stops), 21)),
        gnss_nis=np.full((runs, len(batch.gnss_t)), np.nan),
        heading_nis=np.full((runs, len(batch.heading_t)), np.nan),
    )
    _filter_runs(batch, parameters, guard, first, out)
    return out


@njit
def _filter_runs(batch: Batch, parameters: FilterParameters, guard: int, first: int, out: BatchOutput) -> None:
    n_gnss, n_heading = len(batch.gnss_t), len(batch.heading_t)
    gnss_code, heading_code = np.zeros(n_gnss, np.uint8), np.zeros(n_heading, np.uint8)
    residual, innovation, distance = np.zeros((n_gnss, 2)), np.zeros(n_heading), np.zeros(len(batch.wheel_t))
    for run in range(len(batch.x0)):
        x, P = batch.x0[run].copy(), batch.P0.copy()
        t, begin = batch.t0, first
        for s in range(len(batch.stops)):
            end = batch.stops[s] + 1
            data = Measurements(
                batch.wheel_t[:end], batch.v_left[run, :end], batch.v_right[run, :end],
                batch.gnss_t, batch.gnss_z[run], batch.gnss_r,
                batch.heading_t, batch.heading_z[run], batch.heading_r, batch.change_t,
            )  # fmt: skip
            start = (
                int(np.searchsorted(batch.gnss_t, t, side="right")),
                int(np.searchsorted(batch.heading_t, t, side="right")),
                int(np.searchsorted(batch.change_t, t, side="right")),
            )
            piece = FilterOutput(
                out.x[run, begin - first : end - first], out.variance[run, begin - first : end - first], distance,
                out.gnss_nis[run], gnss_code, residual, out.heading_nis[run], heading_code, innovation, P,
            )  # fmt: skip
            if guard == TOOL:
                filter_loop(data, t, begin, start, x, P, parameters, piece)
            else:
                free_loop(data, t, begin, start, x, P, parameters, guard, piece)
            out.P[run, s] = P
            begin, t = end, batch.wheel_t[end - 1]


@njit
def free_predict(x: Floats, P: Floats, v_left: float, v_right: float, dt: float, guard: int) -> None:
    """Propagate state and covariance over dt [s] as `icrtool.kernels.ekf_step.predict` does, but with another guard.

    Notes
    -----
    Eqs. 14, 16, 17, in matrices. UNGUARDED divides by y_r - y_l as it is, PRINTED by its absolute value but takes the
    derivatives of y_r - y_l (Eq. 28 with the difference of Eqs. 32-34 put in), GUARDED those of the absolute value.
    """
    N, E, psi, y_r, y_l, x_v = x[0], x[1], x[2], x[3], x[4], x[5]
    W, sign = y_r - y_l, 1.0
    if guard == GUARDED and W < 0.0:
        sign = -1.0
    if guard != UNGUARDED:
        W = abs(W)
    if abs(W) < MIN_ICR_SEPARATION_M:
        W = -MIN_ICR_SEPARATION_M if W < 0.0 else MIN_ICR_SEPARATION_M
    omega = (v_left - v_right) / W
    v_x, v_y = (v_left * y_r - v_right * y_l) / W, -omega * x_v
    c, s = math.cos(psi), math.sin(psi)
    F = np.eye(6)
    F[0, 2], F[1, 2] = dt * (-v_x * s - v_y * c), dt * (v_x * c - v_y * s)
    F[2, 3], F[2, 4] = -dt * sign * omega / W, dt * sign * omega / W
    forward = ((v_left - sign * v_x) / W, (sign * v_x - v_right) / W, 0.0)
    rightward = (sign * omega * x_v / W, -sign * omega * x_v / W, -omega)
    for i in range(3):
        F[0, 3 + i] = dt * (forward[i] * c - rightward[i] * s)
        F[1, 3 + i] = dt * (forward[i] * s + rightward[i] * c)
    full, place = np.empty((6, 6)), 0
    for i in range(6):
        for k in range(i, 6):
            full[i, k] = full[k, i] = P[place]
            place += 1
    full, place = F @ full @ F.T, 0
    for i in range(6):
        for k in range(i, 6):
            P[place] = full[i, k]
            place += 1
    x[0], x[1], x[2] = N + dt * (v_x * c - v_y * s), E + dt * (v_x * s + v_y * c), psi + dt * omega


@njit
def free_loop(
    data: Measurements, t0: float, first: int, start: tuple[int, int, int], x: Floats, P: Floats,
    parameters: FilterParameters, guard: int, out: FilterOutput,
) -> None:  # fmt: skip
    """Do what `filter_loop` does with another guard; no gaps, no terrain changes."""
    j, h, _ = start
    gnss_run, heading_run, PH = np.zeros(4), np.zeros(4), np.zeros(6)
    t = t0
    for k in range(first, len(data.wheel_t)):
        held = max(k - 1, 0)
        t_wheel = data.wheel_t[k]
        while True:
            t_next = t_wheel
            if j < len(data.gnss_t):
                t_next = min(t_next, data.gnss_t[j])
            if h < len(data.heading_t):
                t_next = min(t_next, data.heading_t[h])
            if t_next > t:
                free_predict(x, P, data.v_left[held], data.v_right[held], t_next - t, guard)
                scale = REFERENCE_STEP_S * (t_next - t) if parameters.rate_invariant else (t_next - t) ** 2
                for i in range(6):
                    P[DIAGONAL[i]] += scale * parameters.process_variance[i]
                t = t_next
            while j < len(data.gnss_t) and data.gnss_t[j] <= t:
                out.gnss_code[j], out.gnss_nis[j] = take_fix(
                    t, data.gnss_z[j, 0], data.gnss_z[j, 1], data.gnss_r[j, 0], data.gnss_r[j, 1],
                    x, P, PH, gnss_run, parameters, out.gnss_residual[j],
                )  # fmt: skip
                j += 1
            while h < len(data.heading_t) and data.heading_t[h] <= t:
                out.heading_code[h], out.heading_nis[h], out.heading_innovation[h] = take_heading(
                    t, data.heading_z[h], data.heading_r[h], x, P, PH, heading_run, parameters
                )
                h += 1
            if t >= t_wheel:
                break
        for i in range(6):
            out.x[k - first, i] = x[i]
            out.variance[k - first, i] = P[DIAGONAL[i]]


@njit
def model_states(
    x0: Floats, wheel_t: Floats, v_left: Floats, v_right: Floats, std: Floats, rate_invariant: bool, noise: Floats
) -> Floats:
    """Return states (n, 6) that obey the filter's own model: Eq. 14 with its process noise.

    Parameters
    ----------
    x0 : (6,) at wheel_t[0]
    wheel_t : (n,) [s]; v_left, v_right : (n,) [m/s], held over [k, k+1)
    std : (6,) square roots of the diagonal of Q (Eq. 30)
    rate_invariant : as in `FilterParameters`
    noise : (n, 6) standard normal
    """
    states = np.empty((len(wheel_t), 6))
    states[0] = x0
    for k in range(len(wheel_t) - 1):
        psi, y_r, y_l, x_v = states[k, 2], states[k, 3], states[k, 4], states[k, 5]
        dt = wheel_t[k + 1] - wheel_t[k]
        v_x, v_y, omega = body_velocity(v_left[k], v_right[k], y_r, y_l, x_v)
        c, s = math.cos(psi), math.sin(psi)
        scale = math.sqrt(REFERENCE_STEP_S * dt) if rate_invariant else dt
        step = (dt * (v_x * c - v_y * s), dt * (v_x * s + v_y * c), dt * omega, 0.0, 0.0, 0.0)
        for i in range(6):
            states[k + 1, i] = states[k, i] + step[i] + scale * std[i] * noise[k, i]
    return states
