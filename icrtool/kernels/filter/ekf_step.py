"""One step of the ICR EKF in scalars: predict, correct (Pentzer 2014, Section 3, Eqs. 13-25).

State x = (N, E, psi, y_r, y_l, x_v), shape (6,). The covariance P is its upper triangle row by row, shape (21,):
``NN NE Np Nr Nl Nx  EE Ep Er El Ex  pp pr pl px  rr rl rx  ll lx  xx``. Both are changed in place.
The sums are written out: loops over a 6 x 6 array take three times as long.
The tests compare this filter with one in matrix form (tests/support/matrix_filter.py), the one to read first.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.compiled import njit
from icrtool.kernels.kinematics import step_jacobian

NORTH, EAST, HEADING = (cast(int, np.int64(axis)) for axis in range(3))
"""Which state is measured. Typed: numba compiles one more copy of a function for every plain number in a call."""

DIAGONAL = (0, 6, 11, 15, 18, 20)
"""Places of the variances in P."""

PLACES = np.empty((6, 6), np.int64)
PLACES[np.triu_indices(6)] = PLACES.T[np.triu_indices(6)] = np.arange(21)
"""Places of the entries of the whole matrix in P."""


@njit
def wrap(angle: float) -> float:
    """Wrap an angle [rad] to (-pi, pi]."""
    if -math.pi < angle <= math.pi:
        return angle
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


@njit
def row_times(G0: float, G1: float, G2: float, G3: float, p: float, r: float, l: float, x: float) -> float:  # noqa: E741 - the paper's l
    """Return a row of G times the rows psi, y_r, y_l, x_v of a column."""
    return G0 * p + G1 * r + G2 * l + G3 * x


@njit
def predict(x: Floats, P: Floats, v_left: float, v_right: float, dt: float, step_heading: float, guard: int) -> float:
    """Propagate state and covariance over dt [s] with the track speeds [m/s] held; return the path length [m].

    Parameters
    ----------
    step_heading, guard : see `icrtool.kernels.filter.ekf.FilterParameters`

    Notes
    -----
    Eq. 14 (Euler where step_heading is 0) and F P F^T of Eq. 16 with F = I + G (Eqs. 17, 27-29); only rows N, E, psi
    and columns psi, y_r, y_l, x_v of G differ from zero. `icrtool.kernels.filter.ekf.advance` adds the process noise.
    """
    NN, NE, Np, Nr, Nl, Nx = P[0], P[1], P[2], P[3], P[4], P[5]
    EE, Ep, Er, El, Ex = P[6], P[7], P[8], P[9], P[10]
    pp, pr, pl, px = P[11], P[12], P[13], P[14]
    rr, rl, rx, ll, lx, xx = P[15], P[16], P[17], P[18], P[19], P[20]
    n0, n1, n2, n3, e0, e1, e2, e3, p1, p2, turn, length = step_jacobian(x, v_left, v_right, dt, step_heading, guard)
    # M = (I + G) P, the parts of it that P' needs
    M_NN = NN + row_times(n0, n1, n2, n3, Np, Nr, Nl, Nx)
    M_NE = NE + row_times(n0, n1, n2, n3, Ep, Er, El, Ex)
    M_Np = Np + row_times(n0, n1, n2, n3, pp, pr, pl, px)
    M_Nr = Nr + row_times(n0, n1, n2, n3, pr, rr, rl, rx)
    M_Nl = Nl + row_times(n0, n1, n2, n3, pl, rl, ll, lx)
    M_Nx = Nx + row_times(n0, n1, n2, n3, px, rx, lx, xx)
    M_EE = EE + row_times(e0, e1, e2, e3, Ep, Er, El, Ex)
    M_Ep = Ep + row_times(e0, e1, e2, e3, pp, pr, pl, px)
    M_Er = Er + row_times(e0, e1, e2, e3, pr, rr, rl, rx)
    M_El = El + row_times(e0, e1, e2, e3, pl, rl, ll, lx)
    M_Ex = Ex + row_times(e0, e1, e2, e3, px, rx, lx, xx)
    M_pp = pp + p1 * pr + p2 * pl
    M_pr = pr + p1 * rr + p2 * rl
    M_pl = pl + p1 * rl + p2 * ll
    M_px = px + p1 * rx + p2 * lx
    P[0] = M_NN + row_times(n0, n1, n2, n3, M_Np, M_Nr, M_Nl, M_Nx)
    P[1] = M_NE + row_times(e0, e1, e2, e3, M_Np, M_Nr, M_Nl, M_Nx)
    P[2] = M_Np + p1 * M_Nr + p2 * M_Nl
    P[3], P[4], P[5] = M_Nr, M_Nl, M_Nx
    P[6] = M_EE + row_times(e0, e1, e2, e3, M_Ep, M_Er, M_El, M_Ex)
    P[7] = M_Ep + p1 * M_Er + p2 * M_El
    P[8], P[9], P[10] = M_Er, M_El, M_Ex
    P[11] = M_pp + p1 * M_pr + p2 * M_pl
    P[12], P[13], P[14] = M_pr, M_pl, M_px
    x[0] += e0
    x[1] -= n0
    x[2] += turn
    return length


@njit
def measured_column(P: Floats, axis: int, h_psi: float, PH: Floats) -> float:
    """Fill PH (6,) = P H^T and return H P H^T, for H = e_axis + h_psi e_psi; h_psi is 0 unless the axis is N or E."""
    for i in range(6):
        PH[i] = P[PLACES[axis, i]]
    if h_psi != 0.0:
        for i in range(6):
            PH[i] += h_psi * P[PLACES[HEADING, i]]
    return float(PH[axis] + h_psi * PH[2])


@njit
def correct(x: Floats, P: Floats, PH: Floats, S: float, nu: float) -> None:
    """Apply a scalar innovation nu of variance S, with PH = P H^T (Eqs. 21, 24, 25)."""
    place = 0
    for i in range(6):
        K = PH[i] / S
        x[i] += K * nu
        for k in range(i, 6):
            P[place] -= K * PH[k]
            place += 1


@njit
def keep_sides(x: Floats, P: Floats, PH: Floats, least: float) -> None:
    """Move the state to the nearest one, in the metric of P, with y_icr_right >= least and y_icr_left <= -least.

    The right track is to the right of the left one: the paper's guard (Section 5.1) applied to the states, too.
    Estimate projection (Simon and Chia 2002): the covariance stays as it is.
    """
    for _ in range(2):
        for place, bound in ((3, least), (4, -least)):
            beyond = bound - x[place]
            if (place == 3 and beyond > 0.0) or (place == 4 and beyond < 0.0):
                variance = measured_column(P, place, 0.0, PH)
                for i in range(6):
                    x[i] += PH[i] / variance * beyond
