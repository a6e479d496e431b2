"""The skid-steer ICR kinematics (Pentzer 2014, Eqs. 8-12, 14, 17, 27-29, 32-34): velocities, one step, its Jacobian.

The module also computes the true motion of a robot with known ICRs. While track speeds and ICRs are constant the body
moves on a circle (Section 2). So a true step is an arc, and not an Euler step: it does not depend on the filter's steps
(Eq. 14).
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.compiled import njit, njit_part
from icrtool.kernels.filter_records import GUARDED, PRINTED, REFERENCE_STEP_S

Number = TypeVar("Number", float, Floats)

MIN_ICR_SEPARATION_M = 1e-6
"""Floor of W = |y_l - y_r|: two coincident ICRs have no finite turn rate (Section 2 rules them out physically)."""


@njit_part
def body_velocity(
    v_left: Number, v_right: Number, y_icr_right: Number, y_icr_left: Number, x_icr: Number
) -> tuple[Number, Number, Number]:
    """Return the body velocity that track speeds give.

    Parameters
    ----------
    v_left, v_right : track speeds [m/s], forward positive
    y_icr_right, y_icr_left, x_icr : track ICRs [m], body frame (y right, x forward)

    Returns
    -------
    v_x, v_y, omega : forward and rightward velocity [m/s], turn rate [rad/s], clockwise positive

    Notes
    -----
    Eqs. 32-34. The no-slip model (Eqs. 38-39) is the case ``(b/2, -b/2, 0)``.
    """
    W = np.maximum(np.abs(y_icr_left - y_icr_right), MIN_ICR_SEPARATION_M)
    omega = (v_left - v_right) / W
    return (v_left * y_icr_right - v_right * y_icr_left) / W, -omega * x_icr, omega


@njit_part
def wheel_speed(v_left: Number, v_right: Number) -> Number:
    """Return the speed of the wheels (|V_l| + |V_r|) / 2 [m/s]: it is not zero in a spin on the spot."""
    return 0.5 * (abs(v_left) + abs(v_right))


@njit_part
def euler_step(
    north: float, east: float, heading: float, dt: float,
    v_left: float, v_right: float, y_icr_right: float, y_icr_left: float, x_icr: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return north, east [m] and heading [rad] after one Euler step of `dt` [s] (Eqs. 8-12; speeds [m/s], ICRs [m])."""
    v_x, v_y, omega = body_velocity(v_left, v_right, y_icr_right, y_icr_left, x_icr)
    cos_psi, sin_psi = math.cos(heading), math.sin(heading)
    north += dt * (v_x * cos_psi - v_y * sin_psi)
    east += dt * (v_x * sin_psi + v_y * cos_psi)
    return north, east, heading + dt * omega


@njit_part
def step_jacobian(
    x: Floats, v_left: float, v_right: float, dt: float, step_heading: float, guard: int, G: Floats
) -> tuple[float, float]:
    """Differentiate one step from the state x (6,) with the track speeds [m/s] held over dt [s].

    Parameters
    ----------
    step_heading : as in `FilterParameters`
    guard : `GUARDED`, `UNGUARDED` or `PRINTED`
    G : (3, 4) becomes F - I: derivatives of the step by psi, y_r, y_l, x_v; all others are zero

    Returns
    -------
    The turn [rad] and the length of the step [m]. The step itself is G[1, 0] to the north and -G[0, 0] to the east.

    Notes
    -----
    Eq. 14 (Euler where step_heading is 0) and Eqs. 17, 27-29.
    """
    psi, y_r, y_l, x_v = x[2], x[3], x[4], x[5]
    # W is that of the sign guard (Section 5.1); `sign` is the sign of its derivative by y_r.
    W, sign = max(abs(y_l - y_r), MIN_ICR_SEPARATION_M), 1.0
    if y_r < y_l and guard != PRINTED:
        sign = -1.0 if guard == GUARDED else 1.0
        W = W if guard == GUARDED else -W
    omega, v_x = (v_left - v_right) / W, (v_left * y_r - v_right * y_l) / W
    v_y = -omega * x_v
    ahead = step_heading * dt
    c, s = math.cos(psi + ahead * omega), math.sin(psi + ahead * omega)
    vx_r, vx_l = (v_left - v_x * sign) / W, (v_x * sign - v_right) / W
    w_r, w_l = -omega * sign / W, omega * sign / W
    n_psi, e_psi = dt * (-v_x * s - v_y * c), dt * (v_x * c - v_y * s)
    # The ICRs move the position through the body velocity, and through the heading that turns it into the world.
    G[0, 0], G[1, 0], G[2, 0], G[2, 3] = n_psi, e_psi, 0.0, 0.0
    G[0, 1] = dt * (vx_r * c + w_r * x_v * s) + n_psi * ahead * w_r
    G[0, 2] = dt * (vx_l * c + w_l * x_v * s) + n_psi * ahead * w_l
    G[0, 3], G[1, 3] = dt * omega * s, -dt * omega * c
    G[1, 1] = dt * (vx_r * s - w_r * x_v * c) + e_psi * ahead * w_r
    G[1, 2] = dt * (vx_l * s - w_l * x_v * c) + e_psi * ahead * w_l
    G[2, 1], G[2, 2] = dt * w_r, dt * w_l
    return dt * omega, dt * math.sqrt(v_x * v_x + v_y * v_y)


def _arcs(heading: Floats, v_left: Floats, v_right: Floats, icrs: Floats, dt: Floats) -> Floats:
    """Return the motion (n, 3) N, E [m], psi [rad] on arcs: the exact solution of Eqs. 11-12.

    Parameters
    ----------
    heading : (n,) at the start [rad]; v_left, v_right : (n,) held [m/s]; dt : (n,) duration [s]
    icrs : (n, 3) y_icr_right, y_icr_left, x_icr [m]
    """
    v_x, v_y, omega = body_velocity(v_left, v_right, *icrs.T)
    half = 0.5 * omega * dt
    chord = dt * np.sinc(half / np.pi) * (v_x + 1j * v_y) * np.exp(1j * (heading + half))
    return np.column_stack([chord.real, chord.imag, omega * dt])


def drive(t: Floats, v_left: Floats, v_right: Floats, icrs: Floats, icr_row: Ints, start: Floats) -> Floats:
    """Return the true pose of a robot with known ICRs at every time.

    Parameters
    ----------
    t : (n,) increasing [s]
    v_left, v_right : (n,) track speeds [m/s], held over [k, k+1)
    icrs : (c, 3) y_icr_right, y_icr_left, x_icr [m]; icr_row : (n,) row of `icrs` that holds over [k, k+1)
    start : (3,) N, E [m], psi [rad] at t[0]

    Returns
    -------
    (n, 3) N, E [m], psi [rad] (unwrapped)
    """
    held, held_icrs, dt = slice(len(t) - 1), icrs[icr_row[:-1]], np.diff(t)
    turned = dt * body_velocity(v_left[held], v_right[held], *held_icrs.T)[2]
    heading = np.cumsum(np.append(start[2], turned))
    moved = _arcs(heading[:-1], v_left[held], v_right[held], held_icrs, dt)
    return np.cumsum(np.vstack([start, moved]), axis=0)


def poses_at(
    times: Floats, t: Floats, v_left: Floats, v_right: Floats, icrs: Floats, icr_row: Ints, pose: Floats
) -> Floats:
    """Return the pose (m, 3) at any times (m,) between those of `drive`, on the arcs it drove."""
    k = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 1)
    return np.asarray(pose[k] + _arcs(pose[k, 2], v_left[k], v_right[k], icrs[icr_row[k]], times - t[k]))


def follow(command: Floats, t: Floats, lag_s: float) -> Floats:
    """Return the speed (n,) of a track that follows its command (n,) [m/s] with a first-order lag, from command[0] on.

    Parameters
    ----------
    t : (n,) [s]; the command is held over [k, k+1)
    lag_s : time constant, positive
    """
    speed = np.array(command, np.float64)
    lag(speed, np.exp(-np.diff(t) / lag_s))
    return speed


@njit
def lag(speed: Floats, kept: Floats) -> None:
    """Replace a command (n,) by the lagged speed; `kept` (n - 1,): share of the difference left after each step."""
    command = speed[0]
    for k in range(len(kept)):
        command, speed[k + 1] = speed[k + 1], command + (speed[k] - command) * kept[k]


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
    dt, left, right = np.diff(wheel_t), v_left[:-1], v_right[:-1]
    pose_scale = np.sqrt(REFERENCE_STEP_S * dt) if rate_invariant else dt
    icr_scale = pose_scale * (np.sqrt(wheel_speed(left, right)) if rate_invariant else 1.0)
    steps = np.column_stack([pose_scale] * 3 + [icr_scale] * 3) * std * noise[:-1]
    icrs = np.cumsum(np.vstack([x0[3:], steps[:, 3:]]), axis=0)
    v_x, v_y, omega = body_velocity(left, right, *icrs[:-1].T)
    psi = np.cumsum(np.append(x0[2], dt * omega + steps[:, 2]))
    moved = dt * (v_x + 1j * v_y) * np.exp(1j * psi[:-1])
    place = np.cumsum(np.vstack([x0[:2], np.column_stack([moved.real, moved.imag]) + steps[:, :2]]), axis=0)
    return np.column_stack([place, psi, icrs])


def chord_rows(north: Floats, east: Floats, step_m: float) -> Ints:
    """Return rows (c,) at least `step_m` apart: the first row, then each time the next row that is so far away.

    Parameters
    ----------
    north, east : (n,) [m], at least one
    """
    rows = np.zeros(len(north), np.int64)
    return rows[: _fill(north, east, step_m, rows)]


@njit
def _fill(north: Floats, east: Floats, step_m: float, rows: Ints) -> int:
    """Write the rows of `chord_rows` into `rows` (n,), whose first is row 0, and return their number."""
    count = 1
    for k in range(1, len(north)):
        a, b = north[k] - north[rows[count - 1]], east[k] - east[rows[count - 1]]
        if a * a + b * b >= step_m * step_m:
            rows[count] = k
            count += 1
    return count
