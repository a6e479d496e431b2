"""Wheels-only motion and its derivatives in one pass: used to fit constant ICRs over windows of distance.

Write the plane as complex numbers, z = forward + j right. With constant parameters p every window of a log shares two
prefix sums, heading theta and place S, whatever its start s and end e (Euler steps as in `icrtool.kernels.open_loop`):

    theta_i = sum dt omega,    S_i = sum dt (v_x + j v_y) e^{j theta},    d(s, e) = e^{-j theta_s} (S_e - S_s)

where d is the displacement in the body frame of the start. The same holds for the derivatives:

    d' = e^{-j theta_s} (S'_e - S'_s - j theta'_s (S_e - S_s)),

so all windows, all horizons and all derivatives cost one march over the wheel samples.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.compiled import njit
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Ints = NDArray[np.int64]

PARAMETERS = ("y_icr_right", "y_icr_left", "x_icr", "scale_left", "scale_right", "bend", "speed")
"""What drives the model, in the order of every vector here.

``y_icr_right, y_icr_left, x_icr`` [m]: Eqs. 8-12. ``scale_left, scale_right``: multiply the speed of a side (a wheel
radius that is not the configured one, longitudinal slip). ``bend``: relative growth of W from straight driving to a
turn on the spot; ``speed`` [s/m]: relative growth of W with the mean track speed.
"""

NEUTRAL = (0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0)
"""Parameters that change nothing; the ICRs have no neutral value."""


class Motion(NamedTuple):
    """Prefix sums at the times asked for.

    Attributes
    ----------
    theta : (m,) heading since the first wheel sample [rad]; place : complex (m,) S [m]
    theta_by, place_by : (m, 7), complex (m, 7), their derivatives by `PARAMETERS`
    theta_rate, place_rate : (m,), complex (m,), their derivatives by time
    """

    theta: Floats
    place: Complexes
    theta_by: Floats
    place_by: Complexes
    theta_rate: Floats
    place_rate: Complexes


@njit
def rates(v_left: float, v_right: float, p: Floats, by: Floats) -> tuple[float, float, float]:
    """Return v_x, v_y [m/s], omega [rad/s]; fill `by` (3, 7) with their derivatives by `PARAMETERS`.

    Notes
    -----
    Eqs. 8-12 with W = (y_r - y_l) f, f = 1 + bend |V_l - V_r| / (|V_l| + |V_r|) + speed (|V_l| + |V_r|) / 2. Both
    y-ICRs grow by f, which cancels in v_x.
    """
    left, right = p[3] * v_left, p[4] * v_right
    both = abs(v_left) + abs(v_right)
    turning = abs(v_left - v_right) / both if both > 0.0 else 0.0
    f = 1.0 + p[5] * turning + p[6] * 0.5 * both
    w = max(abs(p[0] - p[1]), MIN_ICR_SEPARATION_M)
    side = 1.0 if p[0] >= p[1] else -1.0
    a, c = 1.0 / w, 1.0 / f
    omega = (left - right) * a * c
    v_x = (left * p[0] - right * p[1]) * a
    by[0, 0], by[0, 1], by[0, 2] = (left - side * v_x) * a, (side * v_x - right) * a, 0.0
    by[0, 3], by[0, 4], by[0, 5], by[0, 6] = v_left * p[0] * a, -v_right * p[1] * a, 0.0, 0.0
    by[2, 0], by[2, 1], by[2, 2] = -side * omega * a, side * omega * a, 0.0
    by[2, 3], by[2, 4] = v_left * a * c, -v_right * a * c
    by[2, 5], by[2, 6] = -omega * turning * c, -omega * 0.5 * both * c
    for i in range(7):
        by[1, i] = -p[2] * by[2, i]
    by[1, 2] = -omega
    return v_x, -p[2] * omega, omega


@njit
def march(
    t: Floats, dt: Floats, lag: Floats, v_left: Floats, v_right: Floats, p: Floats, times: Floats,
    theta: Floats, place: Complexes, theta_by: Floats, place_by: Complexes, theta_rate: Floats, place_rate: Complexes,
) -> None:  # fmt: skip
    """Fill the prefix sums at `times` (m,), ascending [s]; see `integrate` for the rest."""
    by, psi, s = np.zeros((3, 7)), 0.0, 0.0 + 0.0j
    psi_by, s_re, s_im = np.zeros(7), np.zeros(7), np.zeros(7)
    row = 0
    for i in range(len(t)):
        last = i == len(t) - 1
        until = np.inf if last else t[i + 1]
        v_x, v_y, omega = rates(v_left[i], v_right[i], p, by)
        angle = psi + lag[i] * omega
        cos_psi, sin_psi = math.cos(angle), math.sin(angle)
        v_re, v_im = v_x * cos_psi - v_y * sin_psi, v_x * sin_psi + v_y * cos_psi
        held = dt[i] > 0.0 or last
        while row < len(times) and times[row] < until:
            # before the first sample and through a gap nothing moves
            tau = times[row] - t[i] if held and times[row] > t[i] else 0.0
            theta[row], place[row] = psi + tau * omega, s + tau * complex(v_re, v_im)
            theta_rate[row], place_rate[row] = omega, complex(v_re, v_im)
            for k in range(7):
                bent = psi_by[k] + lag[i] * by[2, k]
                theta_by[row, k] = psi_by[k] + tau * by[2, k]
                place_by[row, k] = complex(
                    s_re[k] + tau * (by[0, k] * cos_psi - by[1, k] * sin_psi - bent * v_im),
                    s_im[k] + tau * (by[0, k] * sin_psi + by[1, k] * cos_psi + bent * v_re),
                )
            row += 1
        if row == len(times):
            break
        for k in range(7):
            # in reals: complex numbers here take twice the time
            bent = psi_by[k] + lag[i] * by[2, k]
            s_re[k] += dt[i] * (by[0, k] * cos_psi - by[1, k] * sin_psi - bent * v_im)
            s_im[k] += dt[i] * (by[0, k] * sin_psi + by[1, k] * cos_psi + bent * v_re)
            psi_by[k] += dt[i] * by[2, k]
        s += dt[i] * complex(v_re, v_im)
        psi += dt[i] * omega


def integrate(
    t: Floats, dt: Floats, v_left: Floats, v_right: Floats, p: Floats, times: Floats, lag: Floats | None = None
) -> Motion:
    """Return where wheels alone lead at any times, with derivatives.

    Parameters
    ----------
    t : (n,) stamps of the wheel samples [s], ascending
    dt : (n,) how long each sample holds [s]; 0 over a gap, and for the last one
    v_left, v_right : (n,) [m/s]
    p : (7,), see `PARAMETERS`
    times : (m,) [s], ascending, in the clock of the wheels
    lag : (n,) [s] how long into a step its heading is taken, for steps that stand for several; 0 by default, as Euler
    """
    m = len(times)
    lag = np.zeros(len(t)) if lag is None else lag
    out = Motion(
        np.empty(m), np.empty(m, np.complex128), np.empty((m, 7)), np.empty((m, 7), np.complex128),
        np.empty(m), np.empty(m, np.complex128),
    )  # fmt: skip
    stamps, held, into, left, right, parameters, wanted = (
        np.require(column, np.float64, ["C", "A", "W"]) for column in (t, dt, lag, v_left, v_right, p, times)
    )
    march(stamps, held, into, left, right, parameters, wanted, *out)
    return out


def displace(motion: Motion, start: Ints, end: Ints) -> tuple[Complexes, Complexes, Complexes]:
    """Return the open-loop displacement of windows in the body frame of their start, and its derivatives.

    Parameters
    ----------
    start, end : (w,) rows of `motion`

    Returns
    -------
    d : complex (w,) [m], forward + j right
    d_by : complex (w, 7), by `PARAMETERS`
    d_shift : complex (w,), by a common shift of both times [m/s]
    """
    back = np.exp(-1j * motion.theta[start])
    moved = motion.place[end] - motion.place[start]
    moved_by = motion.place_by[end] - motion.place_by[start]
    d_by = back[:, None] * (moved_by - 1j * motion.theta_by[start] * moved[:, None])
    d_shift = back * (motion.place_rate[end] - motion.place_rate[start] - 1j * motion.theta_rate[start] * moved)
    return back * moved, d_by, d_shift
