"""The ICR EKF in matrices, as the paper writes it: an independent oracle of `icrtool.kernels.ekf`.

Pentzer 2014, Section 3. F is assembled from Eqs. 17 and 27-29, updates are joint (north, east) with
K = P H^T (H P H^T + R)^-1. Slow; shares no equation with the compiled filter.
"""

from __future__ import annotations

import math

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.filter_records import (
    GATED,
    PRINTED,
    RECOVERED,
    REFERENCE_STEP_S,
    USED,
    FilterInputs,
    FilterOutput,
    FilterParameters,
)
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M


def wrap(angle: float) -> float:
    """Wrap an angle [rad] to (-pi, pi]."""
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


def step_state(x: Floats, v_left: float, v_right: float, dt: float, step_heading: float = 0.0) -> Floats:
    """Return f(x, u, 0) of Eq. 14 with the guard of Eqs. 32-34; x may be complex, for complex-step derivatives."""
    N, E, psi, y_r, y_l, x_v = x
    W = y_r - y_l if np.real(y_r - y_l) >= 0 else y_l - y_r
    if abs(W) < MIN_ICR_SEPARATION_M:
        W = MIN_ICR_SEPARATION_M
    v_x = (v_left * y_r - v_right * y_l) / W
    omega = (v_left - v_right) / W
    v_y = -omega * x_v
    c, s = np.cos(psi + step_heading * dt * omega), np.sin(psi + step_heading * dt * omega)
    return np.array([N + dt * (v_x * c - v_y * s), E + dt * (v_x * s + v_y * c), psi + dt * omega, y_r, y_l, x_v])


def drive_states(
    start: Floats, v_left: Floats, v_right: Floats, dt: Floats | float, step_heading: float = 0.0
) -> Floats:
    """Return the states (n, 6) of a drive: `step_state` from sample to sample (`dt` is one step, or n - 1 of them).

    The ICRs are constant, therefore speeds and turn rates of all steps are known beforehand.
    """
    _, _, _, y_r, y_l, x_v = start
    dt = np.broadcast_to(dt, len(v_left) - 1)
    W = max(abs(y_r - y_l), MIN_ICR_SEPARATION_M)
    v_x, omega = (v_left * y_r - v_right * y_l)[:-1] / W, (v_left - v_right)[:-1] / W
    v_y = -omega * x_v
    x = np.tile(np.asarray(start, np.float64), (len(v_left), 1))
    x[1:, 2] = dt * omega
    x[:, 2] = np.cumsum(x[:, 2])
    heading = x[:-1, 2] + step_heading * dt * omega
    c, s = np.cos(heading), np.sin(heading)
    x[1:, 0], x[1:, 1] = dt * (v_x * c - v_y * s), dt * (v_x * s + v_y * c)
    x[:, :2] = np.cumsum(x[:, :2], axis=0)
    return x


def state_jacobian(
    x: Floats, v_left: float, v_right: float, dt: float, step_heading: float = 0.0, *, printed: bool = False
) -> Floats:
    """Return F (6, 6), the derivative of `step_state` (Eq. 17); `printed`: as Eqs. 28-29 have it."""
    _, _, psi, y_r, y_l, x_v = x
    W = max(abs(y_l - y_r), MIN_ICR_SEPARATION_M)
    sign = 1.0 if y_r >= y_l or printed else -1.0
    difference = v_left - v_right
    v_x, v_y, omega = (v_left * y_r - v_right * y_l) / W, -difference * x_v / W, difference / W
    c, s = math.cos(psi + step_heading * dt * omega), math.sin(psi + step_heading * dt * omega)
    to_body = np.array(
        [
            [(v_left - sign * v_x) / W, (sign * v_x - v_right) / W, 0.0],
            [-sign * v_y / W, sign * v_y / W, -omega],
            [-sign * omega / W, sign * omega / W, 0.0],
        ]
    )
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    F = np.eye(6)
    F[0, 2] = dt * (-v_x * s - v_y * c)
    F[1, 2] = dt * (v_x * c - v_y * s)
    F[:3, 3:] = dt * turn @ to_body
    F[:2, 3:] += step_heading * np.outer(F[:2, 2], F[2, 3:])
    return F


def run_ekf_plain(data: FilterInputs, t0: float, x0: Floats, P0: Floats, parameters: FilterParameters) -> FilterOutput:
    """Do what `icrtool.kernels.ekf.run_ekf` does, with matrices; the same arguments and result."""
    first = int(np.searchsorted(data.wheel_t, t0))
    out = FilterOutput.empty(data, len(data.wheel_t) - first)
    x, P, t, travelled = x0.astype(float), P0.astype(float), t0, 0.0
    events = sorted(
        [(time, 0, i) for i, time in enumerate(data.change_t) if time > t0]
        + [(time, 1, j) for j, time in enumerate(data.gnss_t) if time > t0]
        + [(time, 2, h) for h, time in enumerate(data.heading_t) if time > t0]
        + [(time, 3, k) for k, time in enumerate(data.wheel_t) if k >= first]
    )
    held = max(first - 1, 0)
    runs = {1: [0.0, 0.0, np.zeros(2)], 2: [0.0, 0.0, np.zeros(1)]}
    for time, kind, i in events:
        if time > data.wheel_t[-1]:
            break
        dt = time - t
        in_gap = held + 1 < len(data.wheel_t) and data.wheel_t[held + 1] - data.wheel_t[held] > parameters.wheel_gap_s
        slips = held < len(data.slipping) and data.slipping[held]
        if dt > 0:
            Q = np.diag(parameters.process_variance) * (REFERENCE_STEP_S * dt if parameters.rate_invariant else dt**2)
            if parameters.rate_invariant:
                Q[3:] *= (abs(data.v_left[held]) + abs(data.v_right[held])) / 2.0
            Q[2, 2] += dt * data.turn_variance[held] if held < len(data.turn_variance) else 0.0
            if in_gap or slips:
                if slips and not in_gap:
                    speeds = (data.v_left[held], data.v_right[held])
                    travelled += math.hypot(*(step_state(x, *speeds, dt, parameters.step_heading)[:2] - x[:2]))
                speed, turn = parameters.gap_speed_variance, parameters.gap_turn_variance
                P = P + dt * np.diag([speed, speed, turn, 0.0, 0.0, 0.0]) + Q
            else:
                speeds = (data.v_left[held], data.v_right[held])
                F = state_jacobian(x, *speeds, dt, parameters.step_heading, printed=parameters.guard == PRINTED)
                stepped = step_state(x, *speeds, dt, parameters.step_heading)
                travelled += math.hypot(*(stepped[:2] - x[:2]))
                x, P = stepped, F @ P @ F.T + Q
            t = time
        if kind == 0:
            for place in (3, 4, 5):
                P[place, place] = max(P[place, place], parameters.icr_inflation_m2)
        elif kind == 3:
            held = i
            out.x[i - first], out.variance[i - first] = x, np.diag(P)
            out.distance[i - first] = travelled
        else:
            x, P = _measure(kind, i, t, x, P, data, parameters, runs[kind], out)
    out.P[:] = P
    return out


def _antenna(psi: float, parameters: FilterParameters) -> Floats:
    c, s = math.cos(psi), math.sin(psi)
    forward, right = parameters.antenna_forward, parameters.antenna_right
    return np.array([c * forward - s * right, s * forward + c * right])


def _keep_sides(x: Floats, P: Floats, least: float) -> Floats:
    for _ in range(2):
        for place, sign in ((3, 1.0), (4, -1.0)):
            if sign * x[place] < least:
                x = x + P[:, place] / P[place, place] * (sign * least - x[place])
    return x


def _measure(
    kind: int, i: int, t: float, x: Floats, P: Floats, data: FilterInputs, parameters: FilterParameters,
    run: list, out: FilterOutput,  # type: ignore[type-arg]  # count, time, innovation
) -> tuple[Floats, Floats]:  # fmt: skip
    """Gate and apply fix i (kind 1) or heading i (kind 2)."""
    H = np.zeros((2, 6)) if kind == 1 else np.eye(6)[2:3]
    if kind == 1:
        a = _antenna(x[2], parameters)
        H[:, :2] = np.eye(2)
        H[:, 2] = [-a[1], a[0]]
        nu, R, gate = data.gnss_z[i] - x[:2] - a, np.diag(data.gnss_r[i]), parameters.gnss_gate
    else:
        nu, R, gate = (
            np.array([wrap(data.heading_z[i] - x[2])]),
            data.heading_r[i : i + 1, None],
            parameters.heading_gate,
        )
    S = H @ P @ H.T + R
    nis, code = float(nu @ np.linalg.solve(S, nu)), USED
    innovation_det = float(np.linalg.det(S))
    if nis > gate:
        alike = run[0] > 0 and float(((nu - run[2]) ** 2).sum()) <= gate * 2.0 * float(np.trace(R))
        run[0], run[1] = (run[0] + 1, run[1]) if alike else (1, t)
        run[2] = nu
        code = RECOVERED if run[0] >= parameters.recovery_count and t - run[1] >= parameters.recovery_s else GATED
        if code == RECOVERED:
            P = P + np.diag([*nu**2, 0.0, 0.0, 0.0, 0.0] if kind == 1 else [0.0, 0.0, nu[0] ** 2, 0.0, 0.0, 0.0])
    if code != GATED:
        run[0] = 0
        S = H @ P @ H.T + R * (1.0 if kind == 1 else parameters.heading_correlation)
        K = np.linalg.solve(S, H @ P).T
        x = x + K @ nu
        P = (np.eye(6) - K @ H) @ P
        P = (P + P.T) / 2
        x = _keep_sides(x, P, parameters.least_icr)
    if kind == 1:
        out.gnss_code[i], out.gnss_nis[i], out.gnss_det[i] = code, nis, innovation_det
        out.gnss_residual[i] = data.gnss_z[i] - x[:2] - _antenna(x[2], parameters)
    else:
        out.heading_code[i], out.heading_nis[i], out.heading_innovation[i] = code, nis, nu[0]
    return x, P
