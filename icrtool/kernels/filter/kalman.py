"""What the Kalman filters and smoothers share: one propagate, one correct, one step back, for any number of states.

The covariance P is (k, k), symmetric, and changed in place, as is the state x (k,). Kalman 1960; Rauch, Tung, Striebel
1965.
"""

from __future__ import annotations

import math

from icrtool.kernels.arrays import Bools, Floats
from icrtool.kernels.compiled import njit, njit_part


@njit_part
def lead_rows(G: Floats, P: Floats, T: Floats) -> None:
    """Fill the first rows of T (k, k) with those of F P: F is the identity, and G (m, c) more in its last columns."""
    m, c = G.shape
    first = len(P) - c
    for i in range(m):
        for j in range(len(P)):
            total = P[i, j]
            for n in range(c):
                total += G[i, n] * P[first + n, j]
            T[i, j] = total


@njit_part
def propagate(G: Floats, P: Floats, T: Floats) -> None:
    """Replace P (k, k) by F P F^T (Eq. 16), F and G (m, c) as in `lead_rows`; T (k, k) is space."""
    m, c = G.shape
    first = len(P) - c
    lead_rows(G, P, T)
    for i in range(m):
        for j in range(i, m):
            total = T[i, j]
            for n in range(c):
                total += T[i, first + n] * G[j, n]
            P[i, j] = P[j, i] = total
        for j in range(m, len(P)):
            P[i, j] = P[j, i] = T[i, j]


@njit_part
def correct(x: Floats, P: Floats, Ph: Floats, S: float, nu: float, fixed: Bools) -> None:
    """Apply a scalar innovation nu of variance S, with Ph = P h^T (Eqs. 21, 24, 25).

    States that are `fixed` (k,) keep their value and variance: uncertain, but not estimated (Schmidt 1966).
    """
    for i in range(len(x)):
        K = Ph[i] / S
        if fixed[i]:
            for j in range(len(x)):
                P[i, j] -= 0.0 if fixed[j] else K * Ph[j]
        else:
            x[i] += K * nu
            for j in range(len(x)):
                P[i, j] -= K * Ph[j]


@njit_part
def store(x: Floats, P: Floats, states: Floats, covariances: Floats, i: int) -> None:
    """Keep a state and its covariance in row i of states (n, k) and covariances (n, k, k)."""
    # Element by element: numba takes seconds to compile the assignment of an array to a row of a larger one.
    for a in range(len(x)):
        states[i, a] = x[a]
        for b in range(len(x)):
            covariances[i, a, b] = P[a, b]


@njit_part
def solve_positive(A: Floats, B: Floats) -> None:
    """Solve A X = B for symmetric positive definite A (k, k); X replaces B (k, c), A is destroyed (Cholesky)."""
    k = len(A)
    for i in range(k):
        for j in range(i + 1):
            total = A[i, j]
            for n in range(j):
                total -= A[i, n] * A[j, n]
            # a state that is known for certain (no process noise) has a zero here, and nothing to smooth
            if i == j:
                A[i, i] = math.sqrt(total) if total > 0.0 else 0.0
            else:
                A[i, j] = total / A[j, j] if A[j, j] > 0.0 else 0.0
    for column in range(B.shape[1]):
        for i in range(k):
            total = B[i, column]
            for n in range(i):
                total -= A[i, n] * B[n, column]
            B[i, column] = total / A[i, i] if A[i, i] > 0.0 else 0.0
        for i in range(k - 1, -1, -1):
            total = B[i, column]
            for n in range(i + 1, k):
                total -= A[n, i] * B[n, column]
            B[i, column] = total / A[i, i] if A[i, i] > 0.0 else 0.0


@njit
def smooth_back(gains: Floats, x_predicted: Floats, P_predicted: Floats, x: Floats, P: Floats, T: Floats) -> None:
    """Smooth states x (n, k) and covariances P (n, k, k) in place, from the last one back; T (k, k) is space.

    Parameters
    ----------
    gains : (n - 1, k, k), P F^T of each event times the inverse of what is predicted at the next
    x_predicted, P_predicted : (n, k), (n, k, k)
    """
    n, k = x.shape
    for i in range(n - 2, -1, -1):
        for a in range(k):
            for b in range(k):
                x[i, a] += gains[i, a, b] * (x[i + 1, b] - x_predicted[i + 1, b])
                T[a, b] = 0.0
                for c in range(k):
                    T[a, b] += gains[i, a, c] * (P[i + 1, c, b] - P_predicted[i + 1, c, b])
        for a in range(k):
            for b in range(k):
                for c in range(k):
                    P[i, a, b] += T[a, c] * gains[i, b, c]
