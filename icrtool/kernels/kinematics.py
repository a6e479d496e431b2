"""The skid-steer ICR kinematics (Pentzer 2014, Eqs. 8-12 with the sign guard of Eqs. 32-34)."""

from __future__ import annotations

from icrtool.kernels.compiled import njit

MIN_ICR_SEPARATION_M = 1e-6
"""Floor of W = |y_l - y_r|: two coincident ICRs have no finite turn rate (Section 2 rules them out physically)."""


@njit
def icr_separation(y_icr_right: float, y_icr_left: float) -> float:
    """Return W = |y_l - y_r| [m], never zero (Section 5.1)."""
    return max(abs(y_icr_left - y_icr_right), MIN_ICR_SEPARATION_M)


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
    omega = (v_left - v_right) / separation
    v_x = (v_left * y_icr_right - v_right * y_icr_left) / separation
    return v_x, -omega * x_icr, omega
