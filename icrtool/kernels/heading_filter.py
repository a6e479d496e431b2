"""Kalman filter and smoother of a heading with linear constants and slowly varying errors beside it, event by event.

State x = (heading, bias, scale error, further ones). Between events the heading grows by (1 + scale) turn - bias dt,
with turn the integrated rate; further states stay, or decay to zero. Every event measures one number: z = h x + noise,
wrapped where it is an angle. An innovation beyond `HUBER_SIGMAS` counts as one of that size.
Filter: Kalman 1960; bounded influence: Masreliez and Martin 1977; states that are uncertain, but not estimated:
Schmidt 1966. Smoother: Rauch, Tung, Striebel 1965.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bools, Floats
from icrtool.kernels.compiled import njit
from icrtool.kernels.kalman import correct, propagate, smooth_passes, store

HUBER_SIGMAS = 2.5


class HeadingEvents(NamedTuple):
    """What is measured, in order of time; (n, ...) each.

    Attributes
    ----------
    dt : seconds since the event before; turn : integrated turn rate over them [rad]
    extra : further variance of that turn [rad^2]
    z : measured; h : (n, k) its derivative by the state; r : variance; angle : whether z is one
    """

    dt: Floats
    turn: Floats
    extra: Floats
    z: Floats
    h: Floats
    r: Floats
    angle: Bools

    def cut(self, count: int) -> HeadingEvents:
        """Return the first events."""
        return HeadingEvents._make(column[:count] for column in self)


class HeadingModel(NamedTuple):
    """Start and process of the states.

    Attributes
    ----------
    x : (k,), P : (k, k) at the first event
    q : (k,) process variance per second; decay : (k,) [1/s], 0 for a state that stays
    fixed : (k,) states whose values are kept: their uncertainty counts, they are not estimated
    """

    x: Floats
    P: Floats
    q: Floats
    decay: Floats
    fixed: Bools


class HeadingPasses(NamedTuple):
    """The forward pass: predicted and updated (n, k), (n, k, k), innovations (n,) and their variances (n,)."""

    x_predicted: Floats
    P_predicted: Floats
    x: Floats
    P: Floats
    innovation: Floats
    variance: Floats


def filter_headings(events: HeadingEvents, model: HeadingModel) -> HeadingPasses:
    """Run the filter."""
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
    """Run the filter, fill `out` where it has rows, and return the log likelihood."""
    k = len(model.x)
    start = model._replace(x=model.x.copy(), P=model.P.copy())
    return float(_forward(events, start, out, np.empty((1, 2)), np.empty(k), np.empty((1, k))))


@njit
def _forward(events: HeadingEvents, model: HeadingModel, out: HeadingPasses, G: Floats, Ph: Floats, T: Floats) -> float:
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
    """Return smoothed states (n, k) and their covariances (n, k, k)."""
    n, k = events.h.shape
    F = np.zeros((n - 1, k, k))
    F[:, np.arange(k), np.arange(k)] = np.exp(-model.decay * events.dt[1:, None])
    F[:, 0, 1], F[:, 0, 2] = -events.dt[1:], events.turn[1:]
    x, P = passes.x.copy(), passes.P.copy()
    smooth_passes(F, passes.x_predicted, passes.P_predicted, x, P)
    return x, P
