"""What the Kalman filters and smoothers share: one propagate, one correct, one step back, for any number of states.

The covariance P is (k, k), symmetric, and changed in place, as is the state x (k,). Kalman 1960; Rauch, Tung, Striebel
1965. Sizes are arguments: a plain number in a call is a constant to the compiler, which then unrolls the loops.
"""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import ROWS_AT_ONCE, Bools, Floats
from icrtool.kernels.compiled import njit, njit_part


@njit_part
def propagate(G: Floats, P: Floats, T: Floats, m: int, first: int, c: int, k: int) -> None:
    """Replace P by F P F^T (Eq. 16): F is the identity, and G (m, c) more in its first rows, from column `first` on.

    T (m, k) is space.
    """
    for i in range(m):
        for j in range(k):
            total = P[i, j]
            for n in range(c):
                total += G[i, n] * P[first + n, j]
            T[i, j] = total
    for i in range(m):
        for j in range(i, m):
            total = T[i, j]
            for n in range(c):
                total += T[i, first + n] * G[j, n]
            P[i, j] = P[j, i] = total
        for j in range(m, k):
            P[i, j] = P[j, i] = T[i, j]


@njit_part
def correct(x: Floats, P: Floats, Ph: Floats, S: float, nu: float, fixed: Bools | None, k: int) -> None:
    """Apply a scalar innovation nu of variance S, with Ph = P h^T (Eqs. 21, 24, 25).

    States that are `fixed` (k,) keep their value and variance: uncertain, but not estimated (Schmidt 1966).
    """
    for i in range(k):
        K = Ph[i] / S
        if fixed is None or not fixed[i]:
            x[i] += K * nu
            for j in range(k):
                P[i, j] -= K * Ph[j]
        else:
            for j in range(k):
                P[i, j] -= 0.0 if fixed[j] else K * Ph[j]


@njit_part
def store(x: Floats, P: Floats, states: Floats, covariances: Floats, i: int) -> None:
    """Keep a state and its covariance in row i of states (n, k) and covariances (n, k, k)."""
    # Element by element: numba takes seconds to compile the assignment of an array to a row of a larger one.
    for a in range(len(x)):
        states[i, a] = x[a]
        for b in range(len(x)):
            covariances[i, a, b] = P[a, b]


def smooth_passes(F: Floats, x_predicted: Floats, P_predicted: Floats, x: Floats, P: Floats) -> None:
    """Smooth states x (n, k) and covariances P (n, k, k) in place, from the last one back.

    Parameters
    ----------
    F : (n - 1, k, k), from each event to the next
    x_predicted, P_predicted : (n, k), (n, k, k)

    Notes
    -----
    C = P F^T (P-)^-1, with P- predicted at the next event; x + C (x_next - x-), P + C (P_next - P-) C^T.
    """
    for lo in reversed(range(0, len(F), ROWS_AT_ONCE)):
        hi = min(lo + ROWS_AT_ONCE, len(F))
        following, both = slice(lo + 1, hi + 1), slice(lo, hi + 1)
        certain = np.diagonal(P_predicted[following], axis1=1, axis2=2) == 0.0
        # a state that is known for certain (no process noise) has nothing to smooth: any variance solves for that
        solved = np.linalg.solve(P_predicted[following] + certain[:, :, None] * np.eye(x.shape[1]), F[lo:hi] @ P[lo:hi])
        step_back(solved, x_predicted[both], P_predicted[both], x[both], P[both], np.empty(P.shape[1:]))


@njit
def step_back(gains: Floats, x_predicted: Floats, P_predicted: Floats, x: Floats, P: Floats, T: Floats) -> None:
    """Do the steps of `smooth_passes`; gains (n - 1, k, k) are the C^T, T (k, k) is space."""
    n, k = x.shape
    for i in range(n - 2, -1, -1):
        for a in range(k):
            for b in range(k):
                x[i, a] += gains[i, b, a] * (x[i + 1, b] - x_predicted[i + 1, b])
                T[a, b] = 0.0
                for c in range(k):
                    T[a, b] += gains[i, c, a] * (P[i + 1, c, b] - P_predicted[i + 1, c, b])
        for a in range(k):
            for b in range(k):
                for c in range(k):
                    P[i, a, b] += T[a, c] * gains[i, c, b]
