"""Rauch-Tung-Striebel smoother of the ICR EKF: the same events once more, then backwards.

The filter's own steps (`icrtool.kernels.ekf`) are run again and every event is kept as a node: what was
predicted there, what was left after its updates. Backwards, with F of Eqs. 17, 27-29 between node i and the next,

    C = P_i F^T (P-_{i+1})^-1,   xs_i = x_i + C (xs_{i+1} - x-_{i+1}),   Ps_i = P_i + C (Ps_{i+1} - P-_{i+1}) C^T

(Rauch, Tung, Striebel 1965). A long log is taken in chunks from checkpoints of the forward pass: memory does not grow
with it; the filter runs twice.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.ekf import FilterState, Nodes, compiled_inputs, filter_rows
from icrtool.kernels.filter_records import FilterInputs, FilterOutput, FilterParameters
from icrtool.kernels.kalman import smooth_passes

CHUNK_ROWS = 8192
"""Wheel samples whose nodes are kept at once: some 30 MB."""


class Smoothed(NamedTuple):
    """Smoothed states: x (k, 6), variance (k, 6), the diagonal of P."""

    x: Floats
    variance: Floats


def run_smoother(
    data: FilterInputs, t0: float, x0: Floats, P0: Floats, parameters: FilterParameters, chunk_rows: int = CHUNK_ROWS
) -> Smoothed:
    """Smooth the run that `icrtool.kernels.ekf.run_ekf` makes of the same arguments.

    Returns
    -------
    Smoothed
        One state per recorded state of the filter; the last one equals the filter's.
    """
    first, last = int(np.searchsorted(data.wheel_t, t0)), len(data.wheel_t)
    chunks, saved = list(pairwise([*range(first, last, chunk_rows), last])), [FilterState.start(t0, x0, P0)]
    data, forward = compiled_inputs(data), FilterOutput.empty(data, min(chunk_rows, last - first))
    for begin, end in chunks[:-1]:
        saved.append(saved[-1].copy())
        filter_rows(data, begin, end, saved[-1], parameters, forward, begin)
    out, following = Smoothed(np.empty((last - first, 6)), np.empty((last - first, 6))), Nodes.empty(0)
    for (begin, end), state in zip(reversed(chunks), reversed(saved), strict=True):
        nodes = filter_rows(data, begin, end, state, parameters, forward, begin, keep=True)
        count = len(nodes.row)
        # the last node is smoothed: the first of the chunk that follows, or that of the end
        nodes = Nodes._make(np.concatenate(columns) for columns in zip(nodes, following, strict=True))
        F = np.tile(np.eye(6), (len(nodes.row) - 1, 1, 1))
        F[:, :3, 2:] += nodes.G[1:]
        smooth_passes(F, nodes.x_predicted, nodes.P_predicted, nodes.x, nodes.P)
        recorded = np.flatnonzero(nodes.row[:count] >= 0)
        out.x[begin - first : end - first] = nodes.x[recorded]
        out.variance[begin - first : end - first] = np.diagonal(nodes.P, axis1=1, axis2=2)[recorded]
        following = Nodes._make(column[:1].copy() for column in nodes)
    return out
