"""Rauch-Tung-Striebel smoother of the ICR EKF: the same events once more, then backwards.

The filter's own steps (`icrtool.kernels.filter.ekf`) are run again and every event is kept as a node: what was
predicted there, what was left after its updates. Backwards, with F of Eqs. 17, 27-29 between node i and the next,

    C = P_i F^T (P-_{i+1})^-1,   xs_i = x_i + C (xs_{i+1} - x-_{i+1}),   Ps_i = P_i + C (Ps_{i+1} - P-_{i+1}) C^T

(Rauch, Tung, Striebel 1965). A long log is taken in chunks from checkpoints of the forward pass: memory does not grow
with it; the filter runs twice.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.compiled import njit
from icrtool.kernels.filter.ekf import empty_nodes, empty_output, filter_rows, start_state
from icrtool.kernels.filter.filter_records import FilterInputs, FilterParameters, Nodes
from icrtool.kernels.kinematics import step_jacobian

CHUNK_ROWS = 8192
"""Wheel samples whose nodes are kept at once: some 15 MB."""


class Smoothed(NamedTuple):
    """Smoothed states: x (k, 6), variance (k, 6), the diagonal of P."""

    x: Floats
    variance: Floats


@njit
def square(upper: Floats, full: Floats) -> None:
    """Fill `full` (6, 6) from an upper triangle (21,)."""
    place = 0
    for i in range(6):
        for k in range(i, 6):
            full[i, k] = full[k, i] = upper[place]
            place += 1


@njit
def transition(x: Floats, step: Floats, step_heading: float, guard: int, F: Floats) -> None:
    """Fill F (6, 6) of Eqs. 17, 27-29 at state x for a step of `Nodes`; the identity through a gap."""
    for i in range(6):
        for k in range(6):
            F[i, k] = 1.0 if i == k else 0.0
    dt = step[0]
    if dt == 0.0 or step[3] != 0.0:
        return
    F[0, 2], F[0, 3], F[0, 4], F[0, 5], F[1, 2], F[1, 3], F[1, 4], F[1, 5], F[2, 3], F[2, 4], _, _ = step_jacobian(
        x, step[1], step[2], dt, step_heading, guard
    )


@njit
def solve_positive(A: Floats, B: Floats) -> None:
    """Solve A X = B for symmetric positive definite A (6, 6); X replaces B (6, 6), A is destroyed (Cholesky)."""
    for i in range(6):
        for k in range(i + 1):
            total = A[i, k]
            for n in range(k):
                total -= A[i, n] * A[k, n]
            # a state that is known for certain (no process noise) has a zero here, and nothing to smooth
            if i == k:
                A[i, i] = math.sqrt(total) if total > 0.0 else 0.0
            else:
                A[i, k] = total / A[k, k] if A[k, k] > 0.0 else 0.0
    for column in range(6):
        for i in range(6):
            total = B[i, column]
            for n in range(i):
                total -= A[i, n] * B[n, column]
            B[i, column] = total / A[i, i] if A[i, i] > 0.0 else 0.0
        for i in range(5, -1, -1):
            total = B[i, column]
            for n in range(i + 1, 6):
                total -= A[n, i] * B[n, column]
            B[i, column] = total / A[i, i] if A[i, i] > 0.0 else 0.0


@njit
def multiply(A: Floats, B: Floats, out: Floats) -> None:
    """Fill out (6, 6) with A B."""
    for i in range(6):
        for k in range(6):
            total = 0.0
            for n in range(6):
                total += A[i, n] * B[n, k]
            out[i, k] = total


@njit
def smooth_chunk(
    nodes: Nodes, count: int, step_heading: float, guard: int, following: Floats, xs: Floats, Ps: Floats, out: Smoothed
) -> None:
    """Smooth the first `count` nodes of a chunk backwards, filling `out` at their rows.

    Parameters
    ----------
    step_heading, guard : as in `FilterParameters`
    following : (31,) first node of the next chunk: x_predicted, P_predicted, step; step NaN where there is none
    xs, Ps : (6,), (6, 6) smoothed there; they end as the smoothed first node of this chunk. `following` likewise
    """
    F, P, P_predicted, X, D, T = (
        np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    )  # fmt: skip
    for m in range(count - 1, -1, -1):
        square(nodes.P[m], P)
        if math.isnan(following[27]):
            xs[:], Ps[:] = nodes.x[m], P
        else:
            transition(nodes.x[m], following[27:31], step_heading, guard, F)
            square(following[6:27], P_predicted)
            multiply(F, P, X)
            D[:] = Ps - P_predicted
            solve_positive(P_predicted, X)
            # X is C^T
            for i in range(6):
                total = nodes.x[m, i]
                for n in range(6):
                    total += X[n, i] * (xs[n] - following[n])
                T[0, i] = total
            xs[:] = T[0]
            multiply(D, X, T)
            for i in range(6):
                for k in range(i, 6):
                    total = P[i, k]
                    for n in range(6):
                        total += X[n, i] * T[n, k]
                    Ps[i, k] = Ps[k, i] = total
        following[:6], following[6:27], following[27:31] = nodes.x_predicted[m], nodes.P_predicted[m], nodes.step[m]
        if nodes.row[m] >= 0:
            for i in range(6):
                out.x[nodes.row[m], i] = xs[i]
                out.variance[nodes.row[m], i] = Ps[i, i]


def run_smoother(
    data: FilterInputs, t0: float, x0: Floats, P0: Floats, parameters: FilterParameters, chunk_rows: int = CHUNK_ROWS
) -> Smoothed:
    """Smooth the run that `icrtool.kernels.filter.ekf.run_ekf` makes of the same arguments.

    Returns
    -------
    Smoothed
        One state per recorded state of the filter; the last one equals the filter's.
    """
    first, last = int(np.searchsorted(data.wheel_t, t0)), len(data.wheel_t)
    borders = [*range(first, last, chunk_rows), last]
    state, forward = start_state(data, t0, x0, P0), empty_output(data, min(chunk_rows, last - first))
    saved = []
    for begin, end in pairwise(borders):
        saved.append(state.copy())
        if end < last:
            filter_rows(data, begin, end, state, parameters, forward, None)
    out = Smoothed(np.empty((last - first, 6)), np.empty((last - first, 6)))
    following, xs, Ps = np.full(31, np.nan), np.zeros(6), np.zeros((6, 6))
    for (begin, end), state in zip(reversed(list(pairwise(borders))), reversed(saved), strict=True):
        nodes = empty_nodes(most_events(data, state.place, begin, end))
        count = filter_rows(data, begin, end, state, parameters, forward, nodes)
        rows = Smoothed(out.x[begin - first : end - first], out.variance[begin - first : end - first])
        smooth_chunk(nodes, count, parameters.step_heading, parameters.guard, following, xs, Ps, rows)
    return out


def most_events(data: FilterInputs, place: Ints, begin: int, end: int) -> int:
    """Return the largest number of events from `place` (3,) on in the wheel samples [begin, end)."""
    stamps = (data.gnss_t, data.heading_t, data.change_t)
    stop = [int(np.searchsorted(times, data.wheel_t[end - 1], side="right")) for times in stamps]
    return end - begin + sum(max(one - int(at), 0) for one, at in zip(stop, place, strict=True))
