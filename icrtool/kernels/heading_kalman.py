"""Kalman filter and smoother of a heading with linear constants beside it, event by event.

State x = (heading, bias, scale error, further constants). Between events it grows by (1 + scale) turn - bias dt,
with turn the integrated rate. Every event measures one number: z = h x + noise, wrapped where it is an angle.
Filter: Kalman 1960. Smoother: Rauch, Tung, Striebel 1965.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.compiled import njit

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class HeadingEvents(NamedTuple):
    """What is measured, in order of time; (n, ...) each.

    Attributes
    ----------
    dt : seconds since the event before; turn : integrated turn rate over them [rad]
    z : measured; h : (n, k) its derivative by the state; r : variance; angle : whether z is one
    """

    dt: Floats
    turn: Floats
    z: Floats
    h: Floats
    r: Floats
    angle: Bools


class HeadingPasses(NamedTuple):
    """The forward pass: predicted and updated (n, k), (n, k, k), innovations (n,) and their variances (n,)."""

    x_predicted: Floats
    P_predicted: Floats
    x: Floats
    P: Floats
    innovation: Floats
    variance: Floats

    def log_likelihood(self) -> float:
        """Return the log likelihood of the innovations, each counted up to 3 standard deviations."""
        nis = np.minimum(self.innovation**2 / self.variance, 9.0)
        return float(-0.5 * (nis + np.log(self.variance)).sum())


def filter_headings(events: HeadingEvents, x0: Floats, P0: Floats, q: Floats) -> HeadingPasses:
    """Run the filter; `q` (k,) is the process variance per second of each state."""
    n, k = events.h.shape
    out = HeadingPasses(
        np.empty((n, k)), np.empty((n, k, k)), np.empty((n, k)), np.empty((n, k, k)), np.empty(n), np.empty(n)
    )
    _forward(events, np.array(x0, np.float64), np.array(P0, np.float64), q, out)
    return out


@njit
def _forward(events: HeadingEvents, x: Floats, P: Floats, q: Floats, out: HeadingPasses) -> None:
    n, k = events.h.shape
    T, Ph = np.empty((k, k)), np.empty(k)
    for i in range(n):
        dt, turn = events.dt[i], events.turn[i]
        x[0] += (1.0 + x[2]) * turn - x[1] * dt
        # F is the identity but for its first row (1, -dt, turn, 0, ...)
        for b in range(k):
            for a in range(k):
                T[a, b] = P[a, b]
            T[0, b] = P[0, b] - dt * P[1, b] + turn * P[2, b]
        for a in range(k):
            for b in range(k):
                P[a, b] = T[a, b]
            P[a, 0] = T[a, 0] - dt * T[a, 1] + turn * T[a, 2]
            P[a, a] += q[a] * dt
        out.x_predicted[i], out.P_predicted[i] = x, P
        S, y = events.r[i], events.z[i]
        for a in range(k):
            y -= events.h[i, a] * x[a]
            Ph[a] = 0.0
            for b in range(k):
                Ph[a] += P[a, b] * events.h[i, b]
        for a in range(k):
            S += events.h[i, a] * Ph[a]
        if events.angle[i]:
            y -= 2.0 * math.pi * round(y / (2.0 * math.pi))
        out.innovation[i], out.variance[i] = y, S
        for a in range(k):
            x[a] += Ph[a] / S * y
            for b in range(k):
                P[a, b] -= Ph[a] * Ph[b] / S
        out.x[i], out.P[i] = x, P


def smooth_headings(events: HeadingEvents, passes: HeadingPasses) -> tuple[Floats, Floats]:
    """Return smoothed states (n, k) and their covariances (n, k, k)."""
    k = events.h.shape[1]
    F = np.tile(np.eye(k), (len(events.z) - 1, 1, 1))
    F[:, 0, 1], F[:, 0, 2] = -events.dt[1:], events.turn[1:]
    solved = np.asarray(np.linalg.solve(passes.P_predicted[1:], F @ passes.P[:-1]), np.float64)
    gains = np.ascontiguousarray(solved.transpose(0, 2, 1))
    x, P = passes.x.copy(), passes.P.copy()
    _backward(gains, passes.x_predicted, passes.P_predicted, x, P)
    return x, P


@njit
def _backward(gains: Floats, x_predicted: Floats, P_predicted: Floats, x: Floats, P: Floats) -> None:
    n, k = x.shape
    T = np.empty((k, k))
    for i in range(n - 2, -1, -1):
        C = gains[i]
        for a in range(k):
            for b in range(k):
                x[i, a] += C[a, b] * (x[i + 1, b] - x_predicted[i + 1, b])
                T[a, b] = 0.0
                for c in range(k):
                    T[a, b] += C[a, c] * (P[i + 1, c, b] - P_predicted[i + 1, c, b])
        for a in range(k):
            for b in range(k):
                for c in range(k):
                    P[i, a, b] += T[a, c] * C[b, c]
