"""Trials chosen by how they turn: single ones worth a picture (Figs. 33-34); straight and turning ones apart."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from icrtool.calibration.model_comparison import ComparedModels, ComparedRow, Model, models_of
from icrtool.dropout_analysis.starts import Starts, counted_ends, standing_states
from icrtool.kernels.arrays import Floats, Ints, rows_of_cells
from icrtool.kernels.open_loop import open_loop_errors, open_loop_path
from icrtool.kernels.track import OpenLoopPath, Track, trial_ends
from icrtool.motion.models import RECOMMENDED
from icrtool.motion.recording import Trials
from icrtool.records.dropout import TurningSplit
from icrtool.records.dropout_document import ExampleTrial, TrialDocument
from icrtool.records.plain_data import known
from icrtool.records.run import Run, track_of

WORST_COUNT = 10
WORST_HORIZON_M = 10.0
EXAMPLE_HORIZON_M = 15.0
ALIKE_RAD = np.radians(10.0)
STRAIGHT_SHARE, LONGEST_CHORD = 0.05, 1.1
TYPICAL_OF = 30
"""Trials enough to find the median error."""
PICTURED = ("icr", "no_slip", "recommended", "controller")


def worst_trials(
    run: Run, compared: ComparedModels | None = None, horizon_m: float = WORST_HORIZON_M, count: int = WORST_COUNT, *,
    starts: Starts = "moving",
) -> tuple[ExampleTrial, ...]:  # fmt: skip
    """Return the trials with the largest error that do not overlap, worst first.

    Parameters
    ----------
    compared : held-out models, of which ``recommended`` is evaluated; without them the momentary ICRs
    """
    track, models = track_of(run), models_of(run)
    ends, rows = counted_ends(track, horizon_m, starts), compared.rows if compared is not None else ()
    held_out = next((row for row in rows if row.name == RECOMMENDED), None)
    if compared is not None and held_out is not None:
        some = compared.trials.starts
        errors = np.full(len(ends), np.nan)
        errors[some] = held_out.errors_of(Trials(some, ends[some])).position[:, 0]
    else:
        errors = open_loop_errors(track, models[0].icrs, ends)[:, 0]
    ends, left = ends[:, 0], np.nan_to_num(errors, copy=False, nan=-1.0)
    chosen: list[int] = []
    while len(chosen) < count and left[worst := int(np.argmax(left))] >= 0.0:
        chosen.append(worst)
        before_its_end = slice(ends[worst] + 1)
        left[before_its_end][ends[before_its_end] >= worst] = -1.0
    name = held_out.name if held_out is not None else models[0].name
    return tuple(_example(run, track, models, rows, name, start, int(ends[start]), horizon_m) for start in chosen)


def example_trials(run: Run, horizon_m: float = EXAMPLE_HORIZON_M) -> tuple[ExampleTrial, ...]:
    """Return a typical cornering trial and a typical straight one, none when no trial is that long.

    Notes
    -----
    Cornering: the heading changes by about half a turn, or as nearly so as the drive has it. Straight: of the
    twentieth part of the trials that end furthest from their start. Typical: of those, the one with the median error
    of the momentary ICRs.
    """
    track, models = track_of(run), models_of(run)
    ends = trial_ends(track, np.array([horizon_m]))[:, 0]
    # A parked start repeats the same path many times: the last state of each stop stands for it.
    moving = np.flatnonzero((ends >= 0) & ~standing_states(track))
    if not len(moving):
        return ()
    last = ends[moving]
    chord = np.hypot(*(_change(column, moving, last) for column in (track.north, track.east)))
    # Further than its wheels rolled: the reference jumped.
    chord[chord > LONGEST_CHORD * horizon_m] = 0.0
    off = np.abs(_change(track.heading, moving, last))
    off -= np.pi
    np.abs(off, out=off)
    groups = (moving[off <= off.min() + ALIKE_RAD], moving[chord >= np.quantile(chord, 1 - STRAIGHT_SHARE)])
    chosen = (_typical(track, models[0], ends, group) for group in groups)
    return tuple(
        _example(run, track, models, (), models[0].name, start, int(ends[start]), horizon_m) for start in chosen
    )


def _change(column: Floats, starts: Ints, ends: Ints) -> Floats:
    """Return by how much a column grew from the start of each trial to its end."""
    change: Floats = column[ends]
    change -= column[starts]
    return change


def _typical(track: Track, model: Model, ends: Ints, group: Ints) -> int:
    """Return the start with the median error of a group, or of evenly spaced ones where it is large."""
    sample = group[:: -(-len(group) // TYPICAL_OF)]
    errors = [open_loop_errors(track, model.icrs, ends[one : one + 1, None], one)[0, 0] for one in sample]
    return int(sample[np.argsort(errors, kind="stable")[len(sample) // 2]])


def _example(
    run: Run, track: Track, models: tuple[Model, ...], rows: Sequence[ComparedRow], by: str, start: int, end: int,
    horizon_m: float,
) -> ExampleTrial:  # fmt: skip
    paths: dict[str, OpenLoopPath] = {}
    errors: dict[str, float | None] = {}
    for model in models:
        if model.name in PICTURED:
            right, left, x = (float(column[start if len(column) > 1 else 0]) for column in model.icrs)
            paths[model.name] = open_loop_path(track, right, left, x, start, end)
    for row in rows:
        if row.name in PICTURED and row.path is not None and (path := row.path(start, end)) is not None:
            paths[row.name] = path
    for name, path in paths.items():
        errors[name] = known(float(np.hypot(path.north[-1] - track.north[end], path.east[-1] - track.east[end])))
    table = run.table
    duration = float(table.t_s[end] - table.t_s[start])
    turned = float(table.heading_rad[end] - table.heading_rad[start])
    driven = float(table.distance_m[end] - table.distance_m[start])
    document = TrialDocument(
        model=by, stamp_ns=int(table.stamp_ns[start]), t_s=float(table.t_s[start]),
        north_m=float(table.north_m[start]), east_m=float(table.east_m[start]), horizon_m=horizon_m,
        heading_change_deg=float(np.degrees(turned)), speed_mean_mps=driven / duration if duration > 0 else 0.0,
        errors_m=errors,
    )  # fmt: skip
    shown = slice(start, end + 1)
    return ExampleTrial(document, start, end, table.north_m[shown], table.east_m[shown], paths)


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
