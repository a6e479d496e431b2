"""Steps of Kalman filters and smoothers for any number of states, and the filter of a heading that uses them.

The module has one function that propagates, one that corrects, and one that steps back. They change the state x (k,)
and the symmetric covariance P (k, k) in place. Kalman 1960; Rauch, Tung, Striebel 1965. Sizes are arguments, because a
plain number in a call is a constant for the compiler, which then unrolls the loops.

The filter of a heading goes event by event. Its state is x = (heading, bias, scale error, …): the heading, constants
and slowly varying errors. Between events the heading grows by (1 + scale) turn - bias dt, where turn is the integrated
rate; the other states stay, or decay to zero. Every event measures one number z = h x + noise, whose innovation is
wrapped if it is an angle. An innovation beyond `HUBER_SIGMAS` counts as an innovation of `HUBER_SIGMAS` (bounded
influence: Masreliez and Martin 1977). Some states are uncertain but not estimated (Schmidt 1966).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import ROWS_AT_ONCE, Bools, Floats
from icrtool.kernels.compiled import njit, njit_part


@njit_part
def propagate(G: Floats, P: Floats, T: Floats, m: int, first: int, c: int, k: int) -> None:
    """Replace P by F P F^T (Eq. 16): F is the identity plus G (m, c) in its first rows, from column `first` on.

    T (m, k) is space for intermediate results.
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

    States that are `fixed` (k,) keep their value and variance: they are uncertain, but not estimated (Schmidt 1966).
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
    """Store a state and its covariance in row i of states (n, k) and covariances (n, k, k)."""
    # Elements are assigned one by one, because numba takes seconds to compile the assignment of an array to a row.
    for a in range(len(x)):
        states[i, a] = x[a]
        for b in range(len(x)):
            covariances[i, a, b] = P[a, b]


def smooth_passes(F: Floats, x_predicted: Floats, P_predicted: Floats, x: Floats, P: Floats) -> None:
    """Smooth states x (n, k) and covariances P (n, k, k) in place, backwards from the last event.

    Parameters
    ----------
    F : (n - 1, k, k) transition from each event to the next one
    x_predicted, P_predicted : (n, k), (n, k, k) state and covariance that were predicted at each event
    x : (n, k) states
    P : (n, k, k) covariances

    Notes
    -----
    Rauch, Tung, Striebel 1965: C = P F^T (P-)^-1, with P- predicted at the next event; the smoothed state is
    x + C (x_next - x-), its covariance P + C (P_next - P-) C^T.
    """
    for lo in reversed(range(0, len(F), ROWS_AT_ONCE)):
        hi = min(lo + ROWS_AT_ONCE, len(F))
        following, both = slice(lo + 1, hi + 1), slice(lo, hi + 1)
        certain = np.diagonal(P_predicted[following], axis1=1, axis2=2) == 0.0
        # A state with variance 0 does not change. A variance of 1 in its place keeps the matrix invertible.
        solved = np.linalg.solve(P_predicted[following] + certain[:, :, None] * np.eye(x.shape[1]), F[lo:hi] @ P[lo:hi])
        step_back(solved, x_predicted[both], P_predicted[both], x[both], P[both], np.empty(P.shape[1:]))


@njit
def step_back(gains: Floats, x_predicted: Floats, P_predicted: Floats, x: Floats, P: Floats, T: Floats) -> None:
    """Do the steps of `smooth_passes`; gains (n - 1, k, k) are the matrices C^T, and T (k, k) is space."""
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


HUBER_SIGMAS = 2.5
"""Size of an innovation, in standard deviations, to which larger innovations are limited."""


class HeadingEvents(NamedTuple):
    """Events of the heading filter, in order of time; (n, ...) each.

    Attributes
    ----------
    dt : time since the event before [s]; turn : integrated turn rate over this time [rad]
    extra : further variance of this turn [rad^2]
    z : measured value; h : (n, k) derivative of z by the state; r : variance of z; angle : whether z is an angle
    """

    dt: Floats
    turn: Floats
    extra: Floats
    z: Floats
    h: Floats
    r: Floats
    angle: Bools

    def cut(self, count: int | None) -> HeadingEvents:
        """Return the first `count` events; None: all events."""
        return HeadingEvents._make(column[:count] for column in self)


class HeadingModel(NamedTuple):
    """Initial state and process noise of the heading filter.

    Attributes
    ----------
    x, P : (k,), (k, k) state and covariance at the first event
    q : (k,) process variance per second; decay : (k,) rate of the decay to zero [1/s], 0 for a state that stays
    fixed : (k,) states that keep their values: their uncertainty counts, but they are not estimated
    """

    x: Floats
    P: Floats
    q: Floats
    decay: Floats
    fixed: Bools


class HeadingPasses(NamedTuple):
    """The forward pass: predicted and updated states (n, k) and covariances (n, k, k), innovations, variances (n,)."""

    x_predicted: Floats
    P_predicted: Floats
    x: Floats
    P: Floats
    innovation: Floats
    variance: Floats


def filter_headings(events: HeadingEvents, model: HeadingModel) -> HeadingPasses:
    """Return the forward pass of the heading filter over events."""
    n, k = events.h.shape
    out = HeadingPasses(
        np.empty((n, k)), np.empty((n, k, k)), np.empty((n, k)), np.empty((n, k, k)), np.empty(n), np.empty(n)
    )
    _run(events, model, out)
    return out


def heading_log_likelihood(events: HeadingEvents, model: HeadingModel) -> float:
    """Return the log likelihood of the innovations under Huber's density."""
    none = HeadingPasses(*(np.empty(shape) for shape in ((0, 0), (0, 0, 0), (0, 0), (0, 0, 0), 0, 0)))
    return _run(events, model, none)


def _run(events: HeadingEvents, model: HeadingModel, out: HeadingPasses) -> float:
    """Run the filter, fill `out` if it has rows, and return the log likelihood."""
    k = len(model.x)
    start = model._replace(x=model.x.copy(), P=model.P.copy())
    return float(_forward(events, start, out, np.empty((1, 2)), np.empty(k), np.empty((1, k))))


@njit
def _forward(events: HeadingEvents, model: HeadingModel, out: HeadingPasses, G: Floats, Ph: Floats, T: Floats) -> float:
    """Do the work of `_run` from `model`, which is changed; G (1, 2), Ph (k,) and T (1, k) are space."""
    n, k = events.h.shape
    x, P = model.x, model.P
    stored, likelihood = len(out.innovation) > 0, 0.0
    for i in range(n):
        dt, turn = events.dt[i], events.turn[i]
        x[0] += (1.0 + x[2]) * turn - x[1] * dt
        G[0, 0], G[0, 1] = -dt, turn
        propagate(G, P, T, 1, 1, 2, k)
        for a in range(k):
            if model.decay[a] > 0.0:
                phi = math.exp(-model.decay[a] * dt)
                x[a] *= phi
                for b in range(k):
                    P[a, b] *= phi
                    P[b, a] *= phi
                P[a, a] += model.q[a] * (1.0 - phi * phi) / (2.0 * model.decay[a])
            else:
                P[a, a] += model.q[a] * dt
        P[0, 0] += events.extra[i]
        if stored:
            store(x, P, out.x_predicted, out.P_predicted, i)
        S, y = events.r[i], events.z[i]
        for a in range(k):
            Ph[a] = 0.0
            for b in range(k):
                Ph[a] += P[a, b] * events.h[i, b]
            S += events.h[i, a] * Ph[a]
            y -= events.h[i, a] * x[a]
        if events.angle[i]:
            y -= 2.0 * math.pi * round(y / (2.0 * math.pi))
        size = abs(y) / math.sqrt(S)
        likelihood -= 0.5 * (
            math.log(S) + (size**2 if size < HUBER_SIGMAS else HUBER_SIGMAS * (2.0 * size - HUBER_SIGMAS))
        )
        if stored:
            out.innovation[i], out.variance[i] = y, S
        correct(x, P, Ph, S if size < HUBER_SIGMAS else S * size / HUBER_SIGMAS, y, model.fixed, k)
        if stored:
            store(x, P, out.x, out.P, i)
    return likelihood


def smooth_headings(events: HeadingEvents, model: HeadingModel, passes: HeadingPasses) -> tuple[Floats, Floats]:
    """Return the smoothed states (n, k) and their covariances (n, k, k)."""
    n, k = events.h.shape
    F = np.zeros((n - 1, k, k))
    F[:, np.arange(k), np.arange(k)] = np.exp(-model.decay * events.dt[1:, None])
    F[:, 0, 1], F[:, 0, 2] = -events.dt[1:], events.turn[1:]
    x, P = passes.x.copy(), passes.P.copy()
    smooth_passes(F, passes.x_predicted, passes.P_predicted, x, P)
    return x, P
