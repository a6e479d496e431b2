"""The skid-steer ICR kinematics, one step of them and its Jacobian (Pentzer 2014, Eqs. 8-12, 14, 17, 27-29, 32-34)."""

from __future__ import annotations

import math

from icrtool.kernels.arrays import Floats
from icrtool.kernels.compiled import njit

MIN_ICR_SEPARATION_M = 1e-6
"""Floor of W = |y_l - y_r|: two coincident ICRs have no finite turn rate (Section 2 rules them out physically)."""

GUARDED, UNGUARDED, PRINTED = 0, 1, 2
"""Sign guards (Section 5.1): Eqs. 32-34 with their derivatives; Eqs. 8-10; Eqs. 32-34 with derivatives as printed.

`PRINTED` divides by W, but differentiates y_r - y_l (Eq. 28 with the difference of Eqs. 32-34 put in).
"""


@njit
def icr_separation(y_icr_right: float, y_icr_left: float) -> float:
    """Return W = |y_l - y_r| [m], never zero (Section 5.1)."""
    return max(abs(y_icr_left - y_icr_right), MIN_ICR_SEPARATION_M)


@njit
def guarded_separation(y_icr_right: float, y_icr_left: float, guard: int) -> tuple[float, float]:
    """Return W [m] under a sign guard, and the sign of its derivative by y_r; without a guard W may be negative."""
    W, sign = icr_separation(y_icr_right, y_icr_left), 1.0
    if y_icr_right < y_icr_left:
        if guard == GUARDED:
            sign = -1.0
        elif guard == UNGUARDED:
            W = -W
    return W, sign


@njit
def velocity_over(
    separation: float, v_left: float, v_right: float, y_icr_right: float, y_icr_left: float, x_icr: float
) -> tuple[float, float, float]:
    """Return v_x, v_y [m/s] and omega [rad/s] as `body_velocity` does, for a given W [m]."""
    omega = (v_left - v_right) / separation
    v_x = (v_left * y_icr_right - v_right * y_icr_left) / separation
    return v_x, -omega * x_icr, omega


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
    separation = icr_separation(y_icr_right, y_icr_left)
    return velocity_over(separation, v_left, v_right, y_icr_right, y_icr_left, x_icr)


@njit
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


StepJacobian = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""What `step_jacobian` returns."""


@njit
def step_jacobian(
    x: Floats, v_left: float, v_right: float, dt: float, step_heading: float, guard: int
) -> StepJacobian:  # fmt: skip
    """Differentiate one step from the state x (6,) with the track speeds [m/s] held over dt [s].

    Parameters
    ----------
    step_heading : the part of the step's turn after which its displacement is turned into the world
    guard : `GUARDED`, `UNGUARDED` or `PRINTED`

    Returns
    -------
    The entries of G = F - I that are not zero, and the step itself: derivatives of the northward step by psi [m/rad],
    y_r, y_l and x_v; the same four of the eastward step; those of the turn by y_r and y_l [rad/m]; the turn [rad] and
    the length of the step [m]. The step is the fifth to the north and minus the first to the east.

    Notes
    -----
    Eq. 14 (Euler where step_heading is 0) and Eqs. 17, 27-29.
    """
    psi, y_r, y_l, x_v = x[2], x[3], x[4], x[5]
    W, sign = guarded_separation(y_r, y_l, guard)
    v_x, v_y, omega = velocity_over(W, v_left, v_right, y_r, y_l, x_v)
    ahead = step_heading * dt
    c, s = math.cos(psi + ahead * omega), math.sin(psi + ahead * omega)
    vx_r, vx_l = (v_left - v_x * sign) / W, (v_x * sign - v_right) / W
    w_r, w_l = -omega * sign / W, omega * sign / W
    n_psi, e_psi = dt * (-v_x * s - v_y * c), dt * (v_x * c - v_y * s)
    # The ICRs move the position through the body velocity, and through the heading that turns it into the world.
    a_r, a_l = ahead * w_r, ahead * w_l
    return (
        n_psi, dt * (vx_r * c + w_r * x_v * s) + n_psi * a_r, dt * (vx_l * c + w_l * x_v * s) + n_psi * a_l,
        dt * omega * s,
        e_psi, dt * (vx_r * s - w_r * x_v * c) + e_psi * a_r, dt * (vx_l * s - w_l * x_v * c) + e_psi * a_l,
        -dt * omega * c,
        dt * w_r, dt * w_l, dt * omega, dt * math.sqrt(v_x * v_x + v_y * v_y),
    )  # fmt: skip
