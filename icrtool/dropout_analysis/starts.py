"""Start states of open-loop trials, and the reference that trials are compared with.

The module finds the state at which the ICRs were learned, and the trials that turn. The reference is the estimate of
the filter or of the smoother; the module also computes the error of the reference itself.
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
from icrtool.records.plain_data import finite_or_none
from icrtool.records.run import ICR_COLUMNS, Run, track_of

STANDING_MPS = 0.01
"""Speed of both sides below which the robot stands [m/s]."""


def standing_states(track: Track) -> Bools:
    """Return which states (n,) begin an interval in which the robot stands; False for the last state."""
    standing = np.ones(len(track.v_left), np.bool_)
    for speed in (track.v_left, track.v_right):
        standing &= (speed > -STANDING_MPS) & (speed < STANDING_MPS)
    standing[-1:] = False
    return standing


def counted_ends(track: Track, horizons_m: Floats, counted: Starts, starts: Ints | None = None) -> Rows:
    """Return the ends (k, h) of trials, as `ends_from` does; a start that does not count ends at `STANDING`.

    Parameters
    ----------
    counted : ``moving``: each standstill counts once; ``all``: every state counts
    starts : (k,) states that trials start from; default: all states
    """
    ends = ends_from(track, horizons_m, starts if starts is not None else np.arange(len(track.distance)))
    if counted == "moving":
        standing = standing_states(track) if starts is None else standing_states(track)[starts]
        for column in ends.T:
            column[standing & (column >= 0)] = STANDING
    return ends


def first_learned(run: Run) -> int | None:
    """Return the first state at which all ICRs were learned; None if they never were.

    Notes
    -----
    An ICR is learned when its standard deviation has made 90 % of its decrease (`icrtool.estimation.convergence`).
    Pentzer 2014 (Section 5.2) applies this criterion to the estimate. The standard deviation is used here, because the
    final estimate is not known at the start of a trial. An ICR whose standard deviation does not decrease by half was
    known from the start if its standard deviation is at most `WEAK_SHARE` of y_right - y_left, the limit of "weakly
    shown"; otherwise it is never learned. With a warm start, the ICRs are known from the first state on.
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
"""Number of errors that are drawn for each horizon. With this number, p95 is known to 1 %."""

POSE = ("north_m", "east_m", "heading_rad")
"""Columns of the states that the reference consists of."""

GNSS_NIS, HEADING_NIS = 2.0, 1.0
"""Expected mean NIS of fixes and of headings, if the noise is right: the number of measured components."""


class DrawnTrials(NamedTuple):
    """Drawn trials of one horizon [m]: the states at which they start and end; empty if the horizon has no trial."""

    horizon_m: float
    start: Ints
    end: Rows


def drawn_trials(horizons_m: Floats, ends: Rows) -> list[DrawnTrials]:
    """Return `DRAWS` trials of each horizon (h,) [m], none for a horizon without trials.

    `ends` (h, n) has the state at which the trial from each state ends.
    """
    drawn = []
    for horizon_m, column in zip(horizons_m.tolist(), ends, strict=True):
        start = np.flatnonzero(column >= 0)
        if len(start):
            start = start[np.linspace(0, len(start) - 1, DRAWS).astype(np.int64)]
        drawn.append(DrawnTrials(horizon_m, start, column[start]))
    return drawn


def reference_error(run: Run, trials: Sequence[Sequence[DrawnTrials]], seed: int) -> tuple[ReferenceRow, ...]:
    """Return the errors that a perfect model would have in trials, because the reference has errors.

    Parameters
    ----------
    run : run whose states are the reference
    trials : trials of each horizon, in groups
    seed : seed of the draws; each group begins with this seed

    Notes
    -----
    A trial starts at the reference pose (p_s, psi_s), adds the open-loop displacement and is compared with p_e. With
    errors dp and dpsi of the reference, and D the displacement from start to end, a perfect model shows

        e = dp_s - dp_e + dpsi_s J D,    J the turn by 90 degrees,

    to first order, with the mean square var(p_s) + var(p_e) + var(psi_s) |D|^2. The variances are taken from the filter
    (or from the smoother, where it is the reference). They follow from the stated or measured noise of the fixes. If
    fixes or headings spread more, mean NIS / components > 1, the variances are multiplied by this ratio (Birge 1932).
    Mean and 95th percentile are computed from drawn normal errors. Errors of start and end are treated as independent.
    An offset of all fixes cancels in every trial; partly correlated errors make the result an upper bound. A heading
    offset common to the whole log is not in the variances.
    """
    table, noise = run.table, run.document.filter
    # The variances are multiplied by the ratios of measured to assumed variance, if these are above 1.
    position = max((noise.nis_gnss_mean or 0.0) / GNSS_NIS, 1.0)
    heading = max((noise.nis_heading_mean or 0.0) / HEADING_NIS, 1.0)
    every = [trial for group in trials for trial in group]

    def at_ends(column: Floats) -> list[tuple[Floats, Floats]]:
        return [(column[trial.start], column[trial.end]) for trial in every]

    # The columns are read one after the other, because a run from a file may not hold them in memory.
    stds = at_ends(table.std_north_m), at_ends(table.std_east_m), at_ends(table.std_heading_rad)
    generators = (rng for group in trials for rng in repeat(np.random.default_rng(seed), len(group)))
    rows = []
    for trial, rng, north_stds, east_stds, (start_std, _) in zip(every, generators, *stds, strict=True):
        start, end = trial.start, trial.end
        if not len(start):
            rows.append(ReferenceRow(trial.horizon_m, None, None, None))
            continue
        north, east = table.north_m[end] - table.north_m[start], table.east_m[end] - table.east_m[start]
        north_std, east_std = ([np.sqrt(position) * std for std in end_stds] for end_stds in (north_stds, east_stds))
        std_heading = np.sqrt(heading) * start_std
        drawn = rng.standard_normal((5, DRAWS))
        heading_error = std_heading * drawn[0]
        error_north = north_std[0] * drawn[1] - north_std[1] * drawn[2] - heading_error * east
        error_east = east_std[0] * drawn[3] - east_std[1] * drawn[4] + heading_error * north
        error = np.hypot(error_north, error_east)
        square = sum(std**2 for std in (*north_std, *east_std))
        square = square + std_heading**2 * (north**2 + east**2)
        numbers = np.sqrt(np.mean(square)), error.mean(), np.percentile(error, 95)
        rows.append(ReferenceRow(trial.horizon_m, *(finite_or_none(float(number)) for number in numbers)))
    return tuple(rows)


def with_smoothed_reference(run: Run) -> Run:
    """Return a run with the positions and headings of the smoother.

    Raises
    ------
    RunError
        The run has no smoothed states.

    Notes
    -----
    Only the pose at the start of a trial and the position that its end is compared with change. Starts, ICRs, wheel
    speeds and path length stay as in the filter.
    """
    if run.smoothed is None:
        raise RunError(run.directory or run.name, "has no smoothed states", "run icrtool fit --smooth")
    smoothed = {name: getattr(run.smoothed, name) for pose in POSE for name in (pose, f"std_{pose}")}
    return replace(run, table=run.table.changed(**smoothed))


SPLIT_HORIZON_M = 5.0
"""Distance of the straight and turning trials [m]."""

STRAIGHT_RAD = math.radians(10.0)
"""Largest range of the headings of a straight trial [rad]."""

CELLS_A_HORIZON = 20
"""Number of cells of path in a horizon, in which the range of the heading is found."""

SPLIT_MODELS = ("icr", "no_slip")
"""Rows whose straight and turning trials are compared."""


def split_by_turning(run: Run, starts: Starts) -> tuple[TurningSplit, ...]:
    """Return the errors of straight and turning trials of `SPLIT_HORIZON_M` (Pentzer 2014, Section 6.4, Figs. 33-34).

    A trial turns if the range of the heading over its path is large, so an S-curve is a turn. A group without trials is
    left out.
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
    """Return the range of the headings [rad] from each state (n,) over one horizon, accurate to a cell of path."""
    size = horizon_m / CELLS_A_HORIZON
    # A step that is longer than a horizon counts as slightly longer than one horizon, because a damaged speed would
    # need too much memory.
    distance = track.distance

    def cells_of(part: Floats) -> Floats:
        return np.asarray(np.floor((part - distance[0]) / size))

    first = rows_of_cells(distance, cells_of)
    steps = np.diff(cells_of(distance[first]), prepend=0.0)
    cell = np.cumsum(np.minimum(steps, CELLS_A_HORIZON + 1.0)).astype(np.int64)
    cells = np.arange(cell[-1] + CELLS_A_HORIZON + 1)
    # The heading of a cell without a state is interpolated.
    highest, lowest = (
        sliding_window_view(np.interp(cells, cell, extreme.reduceat(track.heading, first)), CELLS_A_HORIZON + 1)
        for extreme in (np.maximum, np.minimum)
    )
    return np.repeat((highest.max(axis=1) - lowest.min(axis=1))[cell], np.diff(first, append=len(distance)))
