"""The skid-steer ICR kinematics, one step of them and its Jacobian (Pentzer 2014, Eqs. 8-12, 14, 17, 27-29, 32-34)."""

from __future__ import annotations

import math

from icrtool.kernels.arrays import Floats
from icrtool.kernels.compiled import njit, njit_part

MIN_ICR_SEPARATION_M = 1e-6
"""Floor of W = |y_l - y_r|: two coincident ICRs have no finite turn rate (Section 2 rules them out physically)."""

GUARDED, UNGUARDED, PRINTED = 0, 1, 2
"""Sign guards (Section 5.1): Eqs. 32-34 with their derivatives; Eqs. 8-10; Eqs. 32-34 with derivatives as printed.

`PRINTED` divides by W, but differentiates y_r - y_l (Eq. 28 with the difference of Eqs. 32-34 put in).
"""


@njit
def body_velocity(
    v_left: float, v_right: float, y_icr_right: float, y_icr_left: float, x_icr: float
) -> tuple[float, float, float]:
    """Map track speeds to body velocity.

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
    W = max(abs(y_icr_left - y_icr_right), MIN_ICR_SEPARATION_M)
    omega = (v_left - v_right) / W
    return (v_left * y_icr_right - v_right * y_icr_left) / W, -omega * x_icr, omega


@njit_part
def wheel_speed(v_left: float, v_right: float) -> float:
    """Return the speed of the wheels (|V_l| + |V_r|) / 2 [m/s]: that of a spin on the spot is not zero."""
    return 0.5 * (abs(v_left) + abs(v_right))


@njit
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
    step_heading : the part of the step's turn after which its displacement is turned into the world
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
    # W of the sign guard (Section 5.1), and the sign of its derivative by y_r
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
