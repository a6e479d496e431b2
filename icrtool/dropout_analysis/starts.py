"""Which recorded states open-loop trials start from, and what they are compared with.

From which state on the ICRs were learned; which trials turn; the filter's estimate or the smoother's as the reference,
and the error that it has itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import repeat
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from icrtool.calibration.run_models import models_of
from icrtool.errors import RunError
from icrtool.estimation.convergence import fallen_at
from icrtool.estimation.observability import WEAK_SHARE
from icrtool.kernels.arrays import Bools, Floats, Ints, Rows, rows_of_cells
from icrtool.kernels.open_loop import open_loop_errors
from icrtool.kernels.track import STANDING, Track, ends_from
from icrtool.records.choices import Starts
from icrtool.records.dropout_document import ReferenceRow, TurningSplit
from icrtool.records.plain_data import known
from icrtool.records.run import ICR_COLUMNS, Run, track_of

STANDING_MPS = 0.01
"""The robot stands while both tracks are slower than this."""


def standing_states(track: Track) -> Bools:
    """Return the states (n,) after which the robot stands; the last state, which has no interval, is none of them."""
    standing: Bools = (np.abs(track.v_left) < STANDING_MPS) & (np.abs(track.v_right) < STANDING_MPS)
    standing[-1:] = False
    return standing


def counted_ends(track: Track, horizons_m: Floats, counted: Starts, starts: Ints | None = None) -> Rows:
    """Return `ends_from` some starts, default all states, those marked that do not count."""
    starts = starts if starts is not None else np.arange(len(track.distance))
    ends = ends_from(track, horizons_m, starts)
    if counted == "moving":
        standing = standing_states(track)[starts]
        for column in ends.T:
            column[standing & (column >= 0)] = STANDING
    return ends


def first_learned(run: Run) -> int | None:
    """Return the first state at which all ICRs were learned; None where they never were.

    Notes
    -----
    An ICR is learned when its standard deviation has made 90 % of its fall (`icrtool.estimation.convergence`), as
    Pentzer 2014 (Section 5.2) counts it for the estimate itself. The standard deviation is taken because a trial that
    starts there does not know the final value yet. An ICR whose standard deviation does not fall by half was known
    from the start where it is at most `WEAK_SHARE` of y_right - y_left, the limit of "weakly shown", and is never
    learned otherwise. A warm start has learned the ICRs before the first state.
    """
    if run.began_with is not None:
        return 0
    last = 0
    separation = abs(float(run.table.y_icr_right_m[-1] - run.table.y_icr_left_m[-1]))
    for column in ICR_COLUMNS:
        std: Floats = getattr(run.table, f"std_{column}")
        if (learned := fallen_at(std)) is not None:
            last = max(last, learned)
        elif float(std[0]) > WEAK_SHARE * separation:
            return None
    return last


DRAWS = 20_000
"""Errors drawn a horizon: p95 is then known to 1 %."""

POSE = ("north_m", "east_m", "heading_rad")

GNSS_NIS, HEADING_NIS = 2.0, 1.0
"""Mean normalised innovation squared where the noise is right: the number of measured components."""


class DrawnTrials(NamedTuple):
    """Some trials of one horizon [m], and the states at which they start and end; empty where it has none."""

    horizon_m: float
    start: Ints
    end: Rows


def drawn_trials(horizons_m: Floats, ends: Rows) -> list[DrawnTrials]:
    """Return `DRAWS` trials of each horizon (h,), or none, by the states (h, n) at which those of all starts end."""
    drawn = []
    for horizon_m, column in zip(horizons_m.tolist(), ends, strict=True):
        start = np.flatnonzero(column >= 0)
        if len(start):
            start = start[np.linspace(0, len(start) - 1, DRAWS).astype(np.int64)]
        drawn.append(DrawnTrials(horizon_m, start, column[start]))
    return drawn


def reference_error(run: Run, trials: Sequence[Sequence[DrawnTrials]], seed: int) -> tuple[ReferenceRow, ...]:
    """Return the error that the reference puts into the trials of each horizon.

    Parameters
    ----------
    run : its states are the reference
    trials : of each horizon, in groups
    seed : of the draws, which begin anew with each group

    Notes
    -----
    A trial starts at the reference pose (p_s, psi_s), adds the open-loop displacement and is compared with p_e. With
    errors dp and dpsi of the reference, and D the displacement from start to end, a perfect model shows

        e = dp_s - dp_e + dpsi_s J D,    J the turn by 90 degrees,

    to first order, with the mean square var(p_s) + var(p_e) + var(psi_s) |D|^2. The variances are those of the filter
    (or of the smoother, where it is the reference). They follow from the noise of the fixes that the alignment stated
    or measured; where fixes or headings spread more than that, mean NIS / components > 1, the variances grow by that
    factor (Birge 1932). Mean and 95th percentile are those of drawn normal errors. Errors of start and end count as
    independent: what both share, an offset of all fixes, is in no trial, and what they share in part makes the result
    an upper bound. A heading offset common to the whole log is not in the variances.
    """
    table, noise = run.table, run.document.filter
    # Fixes and headings spread by these factors more than the filter assumes, in variance; at least 1.
    position = max((noise.nis_gnss_mean or 0.0) / GNSS_NIS, 1.0)
    heading = max((noise.nis_heading_mean or 0.0) / HEADING_NIS, 1.0)
    every = [one for group in trials for one in group]

    def at_ends(column: Floats) -> list[tuple[Floats, Floats]]:
        return [(column[one.start], column[one.end]) for one in every]

    # one column after the other: a run that was read back may hold none of them
    stds = at_ends(table.std_north_m), at_ends(table.std_east_m), at_ends(table.std_heading_rad)
    generators = (rng for group in trials for rng in repeat(np.random.default_rng(seed), len(group)))
    rows = []
    for one, rng, of_north, of_east, (of_heading, _) in zip(every, generators, *stds, strict=True):
        start, end = one.start, one.end
        if not len(start):
            rows.append(ReferenceRow(one.horizon_m, None, None, None))
            continue
        north, east = table.north_m[end] - table.north_m[start], table.east_m[end] - table.east_m[start]
        north_std, east_std = ([np.sqrt(position) * std for std in of_both] for of_both in (of_north, of_east))
        std_heading = np.sqrt(heading) * of_heading
        drawn = rng.standard_normal((5, DRAWS))
        turned = std_heading * drawn[0]
        off_north = north_std[0] * drawn[1] - north_std[1] * drawn[2] - turned * east
        off_east = east_std[0] * drawn[3] - east_std[1] * drawn[4] + turned * north
        error = np.hypot(off_north, off_east)
        square = sum(std**2 for std in (*north_std, *east_std))
        square = square + std_heading**2 * (north**2 + east**2)
        of_error = np.sqrt(np.mean(square)), error.mean(), np.percentile(error, 95)
        rows.append(ReferenceRow(one.horizon_m, *(known(float(number)) for number in of_error)))
    return tuple(rows)


def with_smoothed_reference(run: Run) -> Run:
    """Return a run whose positions and headings are the smoother's.

    Raises
    ------
    RunError
        The run has no smoothed states.

    Notes
    -----
    Starts, their ICRs, the wheel speeds and the path length stay the filter's: only where a trial begins, where it
    points, and what its end is compared with change.
    """
    if run.smoothed is None:
        raise RunError(run.directory or run.name, "it has no smoothed states", "run icrtool fit --smooth")
    smoothed = {name: getattr(run.smoothed, name) for pose in POSE for name in (pose, f"std_{pose}")}
    return replace(run, table=run.table.changed(**smoothed))


SPLIT_HORIZON_M = 5.0
STRAIGHT_RAD = math.radians(10.0)
CELLS_A_HORIZON = 20
"""Cells of path a horizon is cut into, to find the range of the heading."""

SPLIT_MODELS = ("icr", "no_slip")


def split_by_turning(run: Run, starts: Starts) -> tuple[TurningSplit, ...]:
    """Return the errors of straight and turning trials of `SPLIT_HORIZON_M` (Pentzer 2014, Section 6.4, Figs. 33-34).

    What counts is the range of the heading over the path, so that an S is a turn. A part without trials is left out.
    """
    track = track_of(run)
    ends = counted_ends(track, np.array([SPLIT_HORIZON_M]), starts)
    tried = np.flatnonzero(ends[:, 0] >= 0)
    straight = heading_range(track, SPLIT_HORIZON_M)[tried] < STRAIGHT_RAD
    models = [model for model in models_of(run) if model.name in SPLIT_MODELS]
    errors = {model.name: open_loop_errors(track, model.icrs, ends)[tried, 0] for model in models}
    splits = []
    for is_straight, part in ((True, straight), (False, ~straight)):
        if part.any():
            means = {name: float(column[part].mean()) for name, column in errors.items()}
            splits.append(TurningSplit(is_straight, SPLIT_HORIZON_M, int(np.count_nonzero(part)), means))
    return tuple(splits)


def heading_range(track: Track, horizon_m: float) -> Floats:
    """Return how far apart the headings [rad] are from each state (n,) to the one a horizon on, to a cell of path."""
    size = horizon_m / CELLS_A_HORIZON
    # A step longer than a horizon counts as a little more than one: a damaged speed fills no memory.
    distance = track.distance

    def cells_of(part: Floats) -> Floats:
        return np.asarray(np.floor((part - distance[0]) / size))

    first = rows_of_cells(distance, cells_of)
    steps = np.diff(cells_of(distance[first]), prepend=0.0)
    cell = np.cumsum(np.minimum(steps, CELLS_A_HORIZON + 1.0)).astype(np.int64)
    cells = np.arange(cell[-1] + CELLS_A_HORIZON + 1)
    # In a cell without a state the heading lies between those around it.
    highest, lowest = (
        sliding_window_view(np.interp(cells, cell, extreme.reduceat(track.heading, first)), CELLS_A_HORIZON + 1)
        for extreme in (np.maximum, np.minimum)
    )
    return np.repeat((highest.max(axis=1) - lowest.min(axis=1))[cell], np.diff(first, append=len(distance)))
