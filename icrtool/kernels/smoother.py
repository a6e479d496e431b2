"""Rauch-Tung-Striebel smoother of the ICR EKF: the same events once more, then backwards.

The filter's own steps (`icrtool.kernels.ekf`) are run again and every event is kept as a node: what was predicted
there, what was left after its updates. Backwards, with F of Eqs. 17, 27-29 between node i and the next,

    C = P_i F^T (P-_{i+1})^-1,   xs_i = x_i + C (xs_{i+1} - x-_{i+1}),   Ps_i = P_i + C (Ps_{i+1} - P-_{i+1}) C^T

(Rauch, Tung, Striebel 1965). A long log is taken in chunks from checkpoints of the forward pass: memory does not grow
with it, at the price of running the filter twice.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.compiled import njit
from icrtool.kernels.ekf import RECOVERED, FilterParameters, Measurements, advance, antenna, take_fix, take_heading
from icrtool.kernels.ekf_step import DIAGONAL, Floats, wrap
from icrtool.kernels.kinematics import body_velocity, icr_separation

Ints = NDArray[np.int64]

CHUNK_ROWS = 8192
"""Wheel samples whose nodes are kept at once: some 15 MB."""


class Nodes(NamedTuple):
    """Events of a chunk, in order; (m, ...) each.

    Attributes
    ----------
    x_predicted, x : (m, 6) before and after the updates; P_predicted, P : (m, 21) likewise, upper triangles
    step : (m, 4) seconds since the node before, track speeds held over them [m/s], 1 in a gap of the wheel data
    row : int64 (m,), row of the state recorded here, -1 where none is
    """

    x_predicted: Floats
    P_predicted: Floats
    x: Floats
    P: Floats
    step: Floats
    row: Ints


class Smoothed(NamedTuple):
    """Smoothed states: x (k, 6), variance (k, 6), the diagonal of P."""

    x: Floats
    variance: Floats


@njit
def record_chunk(  # noqa: C901, PLR0912 - the order of events is the filter's
    data: Measurements, first: int, begin: int, end: int, clock: Floats, place: Ints, runs: Floats,
    x: Floats, P: Floats, parameters: FilterParameters, nodes: Nodes,
) -> int:  # fmt: skip
    """Run the filter over wheel samples [begin, end), keeping every event; return their number.

    Parameters
    ----------
    first : wheel sample of the first recorded state
    clock : (1,) time reached; place : (3,) next fix, heading, terrain change; runs : (2, 4) rejected runs;
        x (6,), P (21,) : all as the chunk before left them, and changed to what this one leaves
    """
    n_gnss, n_heading, n_change = len(data.gnss_t), len(data.heading_t), len(data.change_t)
    PH, residual, count = np.zeros(6), np.zeros(2), 0
    for k in range(begin, end):
        held = max(k - 1, 0)
        t_wheel = data.wheel_t[k]
        in_gap = t_wheel - data.wheel_t[held] > parameters.wheel_gap_s
        while True:
            t_next = t_wheel
            if place[0] < n_gnss:
                t_next = min(t_next, data.gnss_t[place[0]])
            if place[1] < n_heading:
                t_next = min(t_next, data.heading_t[place[1]])
            if place[2] < n_change:
                t_next = min(t_next, data.change_t[place[2]])
            dt = max(t_next - clock[0], 0.0)
            if dt > 0.0:
                advance(dt, in_gap, data.v_left[held], data.v_right[held], x, P, parameters)
                clock[0] = t_next
            t = clock[0]
            while place[2] < n_change and data.change_t[place[2]] <= t:
                for i in range(3, 6):
                    P[DIAGONAL[i]] = max(P[DIAGONAL[i]], parameters.icr_inflation_m2)
                place[2] += 1
            nodes.step[count] = dt, data.v_left[held], data.v_right[held], 1.0 if in_gap else 0.0
            nodes.x_predicted[count], nodes.P_predicted[count] = x, P
            while place[0] < n_gnss and data.gnss_t[place[0]] <= t:
                z_n, z_e = data.gnss_z[place[0]]
                r_n, r_e = data.gnss_r[place[0]]
                a_n, a_e = antenna(x, parameters.antenna_forward, parameters.antenna_right)
                nu_n, nu_e = z_n - x[0] - a_n, z_e - x[1] - a_e
                code, _ = take_fix(t, z_n, z_e, r_n, r_e, x, P, PH, runs[0], parameters, residual)
                if code == RECOVERED:
                    nodes.P_predicted[count, 0] += nu_n * nu_n
                    nodes.P_predicted[count, 6] += nu_e * nu_e
                place[0] += 1
            while place[1] < n_heading and data.heading_t[place[1]] <= t:
                nu = wrap(data.heading_z[place[1]] - x[2])
                code, _, _ = take_heading(
                    t, data.heading_z[place[1]], data.heading_r[place[1]], x, P, PH, runs[1], parameters
                )
                if code == RECOVERED:
                    nodes.P_predicted[count, 11] += nu * nu
                place[1] += 1
            nodes.x[count], nodes.P[count] = x, P
            nodes.row[count] = k - first if t >= t_wheel else -1
            count += 1
            if t >= t_wheel:
                break
    return count


@njit
def square(upper: Floats, full: Floats) -> None:
    """Fill `full` (6, 6) from an upper triangle (21,)."""
    place = 0
    for i in range(6):
        for k in range(i, 6):
            full[i, k] = full[k, i] = upper[place]
            place += 1


@njit
def transition(x: Floats, step: Floats, step_heading: float, F: Floats) -> None:
    """Fill F (6, 6) of Eqs. 17, 27-29 at state x for a step of `Nodes`; the identity through a gap."""
    for i in range(6):
        for k in range(6):
            F[i, k] = 1.0 if i == k else 0.0
    dt = step[0]
    if dt == 0.0 or step[3] != 0.0:
        return
    v_x, v_y, omega = body_velocity(step[1], step[2], x[3], x[4], x[5])
    W = icr_separation(x[3], x[4])
    sign = 1.0 if x[3] >= x[4] else -1.0
    ahead = step_heading * dt
    c, s = math.cos(x[2] + ahead * omega), math.sin(x[2] + ahead * omega)
    F[0, 2], F[1, 2] = dt * (-v_x * s - v_y * c), dt * (v_x * c - v_y * s)
    for column, vx_by, w_by in (
        (3, (step[1] - v_x * sign) / W, -omega * sign / W), (4, (v_x * sign - step[2]) / W, omega * sign / W)
    ):  # fmt: skip
        F[0, column] = dt * (vx_by * c + w_by * x[5] * s) + F[0, 2] * ahead * w_by
        F[1, column] = dt * (vx_by * s - w_by * x[5] * c) + F[1, 2] * ahead * w_by
        F[2, column] = dt * w_by
    F[0, 5], F[1, 5] = dt * omega * s, -dt * omega * c


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
    nodes: Nodes, count: int, step_heading: float, later: Floats, xs: Floats, Ps: Floats, out: Smoothed
) -> None:
    """Smooth the first `count` nodes of a chunk backwards, filling `out` at their rows.

    Parameters
    ----------
    step_heading : as in `FilterParameters`
    later : (31,) the first node of the chunk that follows: x_predicted, P_predicted, step; step NaN where none follows
    xs, Ps : (6,), (6, 6) smoothed there; they end as the smoothed first node of this chunk. `later` likewise
    """
    F, P, P_predicted, X, D, T = (
        np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    )  # fmt: skip
    for m in range(count - 1, -1, -1):
        square(nodes.P[m], P)
        if math.isnan(later[27]):
            xs[:], Ps[:] = nodes.x[m], P
        else:
            transition(nodes.x[m], later[27:31], step_heading, F)
            square(later[6:27], P_predicted)
            multiply(F, P, X)
            D[:] = Ps - P_predicted
            solve_positive(P_predicted, X)
            # X is C^T
            for i in range(6):
                total = nodes.x[m, i]
                for n in range(6):
                    total += X[n, i] * (xs[n] - later[n])
                T[0, i] = total
            xs[:] = T[0]
            multiply(D, X, T)
            for i in range(6):
                for k in range(i, 6):
                    total = P[i, k]
                    for n in range(6):
                        total += X[n, i] * T[n, k]
                    Ps[i, k] = Ps[k, i] = total
        later[:6], later[6:27], later[27:31] = nodes.x_predicted[m], nodes.P_predicted[m], nodes.step[m]
        if nodes.row[m] >= 0:
            for i in range(6):
                out.x[nodes.row[m], i] = xs[i]
                out.variance[nodes.row[m], i] = Ps[i, i]


def run_smoother(
    data: Measurements, t0: float, x0: Floats, P0: Floats, parameters: FilterParameters, chunk_rows: int = CHUNK_ROWS
) -> Smoothed:
    """Smooth the run that `icrtool.kernels.ekf.run_filter` makes of the same arguments.

    Returns
    -------
    Smoothed
        One state per recorded state of the filter; the last one equals the filter's.
    """
    first = int(np.searchsorted(data.wheel_t, t0))
    place = np.array(
        [np.searchsorted(times, t0, side="right") for times in (data.gnss_t, data.heading_t, data.change_t)], np.int64
    )
    clock, runs = np.array([t0]), np.zeros((2, 4))
    x, P = x0.astype(np.float64), P0[np.triu_indices(6)].astype(np.float64)
    borders = [*range(first, len(data.wheel_t), chunk_rows), len(data.wheel_t)]
    saved = []
    for begin, end in pairwise(borders):
        saved.append((clock.copy(), place.copy(), runs.copy(), x.copy(), P.copy()))
        if end < len(data.wheel_t):
            nodes = _room(data, place, begin, end)
            record_chunk(data, first, begin, end, clock, place, runs, x, P, parameters, nodes)
    rows = len(data.wheel_t) - first
    out = Smoothed(np.empty((rows, 6)), np.empty((rows, 6)))
    later, xs, Ps = np.full(31, np.nan), np.zeros(6), np.zeros((6, 6))
    for chunk in range(len(saved) - 1, -1, -1):
        clock, place, runs, x, P = saved[chunk]
        begin, end = borders[chunk], borders[chunk + 1]
        nodes = _room(data, place, begin, end)
        count = record_chunk(data, first, begin, end, clock, place, runs, x, P, parameters, nodes)
        smooth_chunk(nodes, count, parameters.step_heading, later, xs, Ps, out)
    return out


def _room(data: Measurements, place: Ints, begin: int, end: int) -> Nodes:
    """Return nodes for all events from `place` and wheel samples [begin, end), at least."""
    last = data.wheel_t[end - 1]
    events = sum(
        max(int(np.searchsorted(times, last, side="right")) - int(at), 0)
        for times, at in zip((data.gnss_t, data.heading_t, data.change_t), place, strict=True)
    )
    m = events + end - begin
    return Nodes(
        np.empty((m, 6)),
        np.empty((m, 21)),
        np.empty((m, 6)),
        np.empty((m, 21)),
        np.empty((m, 4)),
        np.empty(m, np.int64),
    )
