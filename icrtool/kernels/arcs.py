"""True motion of a robot of known ICRs: Eqs. 8-12 of Pentzer 2014 (guard of Eqs. 32-34), integrated without error.

While track speeds and ICRs are constant the body moves on a circle (Section 2), so a step is an arc, not an Euler step:
the truth does not depend on the filter's own discretisation (Eq. 14).
"""

from __future__ import annotations

import math

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.compiled import njit
from icrtool.kernels.filter.ekf import REFERENCE_STEP_S
from icrtool.kernels.kinematics import body_velocity, euler_step, wheel_speed

SMALLEST_TURN_RAD = 1e-4
"""Below this sin(a)/a is taken from its series, which is then exact to the last bit."""


@njit
def arc_step(pose: Floats, v_left: float, v_right: float, icrs: Floats, dt: float, out: Floats) -> None:
    """Fill `out` with the pose after dt [s] at held track speeds [m/s]: the exact solution of Eqs. 11-12.

    Parameters
    ----------
    pose, out : (3,) N, E [m], psi [rad] before and after; they may be the same array
    icrs : (3,) y_icr_right, y_icr_left, x_icr [m]
    """
    v_x, v_y, omega = body_velocity(v_left, v_right, icrs[0], icrs[1], icrs[2])
    half = 0.5 * omega * dt
    chord = dt * (math.sin(half) / half if abs(half) > SMALLEST_TURN_RAD else 1.0 - half * half / 6.0)
    c, s = math.cos(pose[2] + half), math.sin(pose[2] + half)
    out[0] = pose[0] + chord * (v_x * c - v_y * s)
    out[1] = pose[1] + chord * (v_x * s + v_y * c)
    out[2] = pose[2] + omega * dt


@njit
def drive(t: Floats, v_left: Floats, v_right: Floats, icrs: Floats, which: Ints, start: Floats) -> Floats:
    """Return the pose at every time.

    Parameters
    ----------
    t : (n,) increasing [s]
    v_left, v_right : (n,) track speeds [m/s], held over [k, k+1)
    icrs : (c, 3) y_icr_right, y_icr_left, x_icr [m]; which : (n,) row of `icrs` that holds over [k, k+1)
    start : (3,) N, E [m], psi [rad] at t[0]

    Returns
    -------
    (n, 3) N, E [m], psi [rad] (unwrapped)
    """
    pose = np.empty((len(t), 3))
    pose[0] = start
    for k in range(len(t) - 1):
        arc_step(pose[k], v_left[k], v_right[k], icrs[which[k]], t[k + 1] - t[k], pose[k + 1])
    return pose


@njit
def poses_at(
    times: Floats, t: Floats, v_left: Floats, v_right: Floats, icrs: Floats, which: Ints, pose: Floats
) -> Floats:
    """Return the pose (m, 3) at any times (m,) between those of `drive`, on the arcs it drove."""
    found = np.empty((len(times), 3))
    row = np.searchsorted(t, times, side="right") - 1
    for i in range(len(times)):
        k = min(max(row[i], 0), len(t) - 1)
        arc_step(pose[k], v_left[k], v_right[k], icrs[which[k]], times[i] - t[k], found[i])
    return found


@njit
def follow(command: Floats, t: Floats, lag_s: float) -> Floats:
    """Return the speed (n,) of a track that follows its command (n,) [m/s] as a first-order lag, from rest with it.

    Parameters
    ----------
    t : (n,) [s]; the command is held over [k, k+1)
    lag_s : time constant, positive
    """
    speed = np.empty(len(command))
    speed[0] = command[0]
    for k in range(len(command) - 1):
        speed[k + 1] = command[k] + (speed[k] - command[k]) * math.exp(-(t[k + 1] - t[k]) / lag_s)
    return speed


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
        N, E, psi, y_r, y_l, x_v = states[k]
        dt = wheel_t[k + 1] - wheel_t[k]
        N, E, psi = euler_step(N, E, psi, dt, v_left[k], v_right[k], y_r, y_l, x_v)
        of_pose = math.sqrt(REFERENCE_STEP_S * dt) if rate_invariant else dt
        of_icrs = of_pose * (math.sqrt(wheel_speed(v_left[k], v_right[k])) if rate_invariant else 1.0)
        moved = (N, E, psi, y_r, y_l, x_v)
        for i in range(6):
            states[k + 1, i] = moved[i] + (of_pose if i < 3 else of_icrs) * std[i] * noise[k, i]
    return states
