"""Rauch-Tung-Striebel smoother of the ICR EKF: the same events once more, then backwards.

The filter's own steps (`icrtool.kernels.filter.ekf`) are run again and every event is kept as a node: what was
predicted there, what was left after its updates. Backwards, with F of Eqs. 17, 27-29 between node i and the next,

    C = P_i F^T (P-_{i+1})^-1,   xs_i = x_i + C (xs_{i+1} - x-_{i+1}),   Ps_i = P_i + C (Ps_{i+1} - P-_{i+1}) C^T

(Rauch, Tung, Striebel 1965). A long log is taken in chunks from checkpoints of the forward pass: memory does not grow
with it; the filter runs twice.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.compiled import njit
from icrtool.kernels.filter.ekf import empty_output, filter_rows, start_state
from icrtool.kernels.filter.filter_records import FilterInputs, FilterParameters, Nodes, Space
from icrtool.kernels.filter.kalman import lead_rows, smooth_back, solve_positive
from icrtool.kernels.kinematics import step_jacobian

CHUNK_ROWS = 8192
"""Wheel samples whose nodes are kept at once: some 30 MB."""


class Smoothed(NamedTuple):
    """Smoothed states: x (k, 6), variance (k, 6), the diagonal of P."""

    x: Floats
    variance: Floats


@njit
def fill_gains(nodes: Nodes, step_heading: float, guard: int, gains: Floats, space: Space) -> None:
    """Fill the gains (m - 1, 6, 6) of `smooth_back` between nodes (m,).

    Parameters
    ----------
    step_heading, guard : as in `FilterParameters`
    """
    G, X, P_predicted = space.G, space.X, space.T
    for m in range(len(gains)):
        step = nodes.step[m + 1]
        # X = F P: through a gap F is the identity
        for i in range(6):
            for k in range(6):
                X[i, k] = nodes.P[m, i, k]
                P_predicted[i, k] = nodes.P_predicted[m + 1, i, k]
        if step[0] > 0.0 and step[3] == 0.0:
            step_jacobian(nodes.x[m], step[1], step[2], step[0], step_heading, guard, G)
            lead_rows(G, nodes.P[m], X)
        solve_positive(P_predicted, X)
        for i in range(6):
            for k in range(6):
                gains[m, i, k] = X[k, i]


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
    out, space = Smoothed(np.empty((last - first, 6)), np.empty((last - first, 6))), Space.empty()
    following = Nodes.empty(0)
    for (begin, end), state in zip(reversed(list(pairwise(borders))), reversed(saved), strict=True):
        nodes = Nodes.empty(most_events(data, state.place, begin, end))
        count = filter_rows(data, begin, end, state, parameters, forward, nodes)
        # the last node is smoothed: the first of the chunk that follows, or that of the end
        nodes = Nodes._make(
            np.concatenate([column[:count], more]) for column, more in zip(nodes, following, strict=True)
        )
        gains = np.empty((len(nodes.row) - 1, 6, 6))
        fill_gains(nodes, parameters.step_heading, parameters.guard, gains, space)
        smooth_back(gains, nodes.x_predicted, nodes.P_predicted, nodes.x, nodes.P, space.T)
        recorded = np.flatnonzero(nodes.row[:count] >= 0)
        out.x[begin - first : end - first] = nodes.x[recorded]
        out.variance[begin - first : end - first] = np.diagonal(nodes.P, axis1=1, axis2=2)[recorded]
        following = Nodes._make(column[:1].copy() for column in nodes)
    return out


def most_events(data: FilterInputs, place: Ints, begin: int, end: int) -> int:
    """Return the largest number of events from `place` (3,) on in the wheel samples [begin, end)."""
    stamps = (data.change_t, data.gnss_t, data.heading_t)
    stop = [int(np.searchsorted(times, data.wheel_t[end - 1], side="right")) for times in stamps]
    return end - begin + sum(max(one - int(at), 0) for one, at in zip(stop, place, strict=True))
