"""Straight and turning trials apart: on a straight path there is no turn for a model to be wrong about."""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from icrtool.dropout_analysis.starts import Starts, counted_ends
from icrtool.dropout_analysis.trials import Model, models_of
from icrtool.kernels.arrays import Floats
from icrtool.kernels.equal_steps import rows_of_cells
from icrtool.kernels.open_loop.prefix_sums import open_loop_errors
from icrtool.kernels.track import Track
from icrtool.records.dropout import TurningSplit
from icrtool.records.run import Run, track_of

SPLIT_HORIZON_M = 5.0
STRAIGHT_RAD = math.radians(10.0)
CELLS = 20
"""Cells of path a horizon is cut into, to find the range of the heading."""

SPLIT_MODELS = ("icr", "no_slip")


def split_by_turning(run: Run, starts: Starts) -> tuple[TurningSplit, ...]:
    """Return the errors of straight and turning trials of `SPLIT_HORIZON_M` (Pentzer 2014, Section 6.4, Figs. 33-34).

    What counts is the range of the heading over the path, so that an S is a turn. A part without trials is left out.
    """
    track = track_of(run)
    ends = counted_ends(track, SPLIT_HORIZON_M, starts)
    tried = np.flatnonzero(ends[:, 0] >= 0)
    straight = heading_range(track, SPLIT_HORIZON_M)[tried] < STRAIGHT_RAD
    parts = {kind: part for kind, part in ((True, straight), (False, ~straight)) if part.any()}

    def mean_errors(model: Model) -> dict[bool, float]:
        errors = open_loop_errors(track, model.icrs, ends)[tried, 0]
        return {kind: float(errors[part].mean()) for kind, part in parts.items()}

    of_model = {model.name: mean_errors(model) for model in models_of(run) if model.name in SPLIT_MODELS}
    return tuple(
        TurningSplit(
            kind, SPLIT_HORIZON_M, int(np.count_nonzero(part)), {name: means[kind] for name, means in of_model.items()}
        )
        for kind, part in parts.items()
    )


def heading_range(track: Track, horizon_m: float) -> Floats:
    """Return how far apart the headings [rad] are from each state (n,) to the one a horizon on, to a cell of path."""
    size = horizon_m / CELLS
    # A step longer than a horizon counts as a little more than one: a damaged speed fills no memory.
    distance = track.distance

    def cells_of(part: Floats) -> Floats:
        return np.asarray(np.floor((part - distance[0]) / size))

    first = rows_of_cells(distance, cells_of)
    steps = np.diff(cells_of(distance[first]), prepend=0.0)
    cell = np.cumsum(np.minimum(steps, CELLS + 1.0)).astype(np.int64)
    cells = np.arange(cell[-1] + CELLS + 1)
    # In a cell without a state the heading lies between those around it.
    highest, lowest = (
        sliding_window_view(np.interp(cells, cell, extreme.reduceat(track.heading, first)), CELLS + 1)
        for extreme in (np.maximum, np.minimum)
    )
    return np.repeat((highest.max(axis=1) - lowest.min(axis=1))[cell], np.diff(first, append=len(distance)))
