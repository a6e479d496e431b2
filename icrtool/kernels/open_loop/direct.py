"""Open-loop propagation from every recorded state: where trials end, one path, and the direct integration.

The dropout analysis of Pentzer 2014, Section 6.4: freeze the ICRs estimated at a state, drive on with wheel speeds
alone, and compare with the reference when the path has grown by a horizon. ``open_loop_errors_direct`` integrates every
trajectory and is the oracle; ``icrtool.kernels.open_loop.prefix_sums`` gives the same numbers far sooner.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.compiled import njit
from icrtool.kernels.equal_steps import ROWS_AT_ONCE
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M, euler_step
from icrtool.kernels.open_loop.trials import FrozenIcrs, OpenLoopPath, TrialCounts
from icrtool.kernels.track import GAP, JUMP, OUTAGE, SHORT, STANDING, Track, ends_from

Columns = tuple[Floats, Floats, Floats, Floats, Floats, Floats]
"""Of a track that is made of states: held, v_left, v_right, north, east, heading."""


@njit
def integrate_trials(
    columns: Columns, icrs: FrozenIcrs, ends: Ints, lo: int, row_lo: int, row_hi: int, errors: Floats
) -> None:
    """Fill rows [row_lo, row_hi) of `errors` (n_horizons, n_starts): each path is integrated once for all horizons.

    Notes
    -----
    The path is integrated from the origin with heading zero and turned into place at its end: the same path, but its
    rounding does not depend on where the datum is or how often the robot has turned.
    """
    held, v_left, v_right, north, east, heading = columns
    each = 0 if len(icrs.x_icr) == 1 else 1
    for row in range(row_lo, row_hi):
        start = lo + row
        y_icr_right, y_icr_left = icrs.y_icr_right[start * each], icrs.y_icr_left[start * each]
        x_icr = icrs.x_icr[start * each]
        cos_psi, sin_psi = math.cos(heading[start]), math.sin(heading[start])
        ahead, aside, turned = 0.0, 0.0, 0.0
        state, reached = start, start - 1
        while True:
            end = -1
            for h in range(ends.shape[0]):
                if ends[h, row] > reached and (end < 0 or ends[h, row] < end):
                    end = ends[h, row]
            if end < 0:
                break
            for i in range(state, end):
                ahead, aside, turned = euler_step(
                    ahead,
                    aside,
                    turned,
                    held[i],
                    v_left[i],
                    v_right[i],
                    y_icr_right,
                    y_icr_left,
                    x_icr,
                )
            state, reached = end, end
            miss_north = ahead * cos_psi - aside * sin_psi - (north[end] - north[start])
            miss_east = ahead * sin_psi + aside * cos_psi - (east[end] - east[start])
            for h in range(ends.shape[0]):
                if ends[h, row] == end:
                    errors[h, row] = math.sqrt(miss_north * miss_north + miss_east * miss_east)


def compiled_columns(track: Track) -> Columns:
    """Return the columns of a track in the one form the kernels are compiled for; copies only what is not in it.

    Notes
    -----
    A read-only column (pandas hands those out) would be another type to numba, and cost a second compilation.
    """
    columns = (track.held, track.v_left, track.v_right, track.north, track.east, track.heading)
    held, left, right, north, east, heading = (np.require(one, np.float64, ["C", "A", "W"]) for one in columns)
    return held, left, right, north, east, heading


def compiled_icrs(icrs: FrozenIcrs) -> FrozenIcrs:
    """Return `icrs` in the one form the kernels are compiled for (see `compiled_columns`)."""
    return FrozenIcrs(*[np.require(column, np.float64, ["C", "A", "W"]) for column in icrs])


def trial_ends(track: Track, horizons_m: Floats, lo: int = 0, hi: int | None = None) -> Ints:
    """Return `icrtool.kernels.track.ends_from` of all starts in [lo, hi), by default of all states."""
    return ends_from(track, horizons_m, np.arange(lo, len(track.distance) if hi is None else hi))


def count_trials(ends: Ints) -> TrialCounts:
    """Count trials and the kinds of no trial per horizon in `ends` (n_starts, n_horizons)."""
    kinds = [(ends == kind).sum(axis=0, dtype=np.int64) for kind in (SHORT, GAP, OUTAGE, STANDING, JUMP)]
    return TrialCounts(len(ends) - np.sum(kinds, axis=0), *kinds)


def open_loop_errors_direct(track: Track, icrs: FrozenIcrs, ends: Ints, lo: int = 0) -> Floats:
    """Integrate every trajectory step by step: O(starts x steps), the oracle.

    Parameters
    ----------
    track : of recorded states (n,)
    icrs : what each start drives with
    ends : int64 (n_starts, n_horizons) of `trial_ends`, for the starts from `lo` on

    Returns
    -------
    float64 (n_starts, n_horizons) [m], one horizon contiguous: horizontal distance between the open-loop position and
    the reference at the trial's end; NaN where there is no trial.

    Notes
    -----
    Section 6.4 with the kinematics of Eqs. 8-12 and the guard of Eqs. 32-34.
    """
    by_horizon = np.ascontiguousarray(ends.T)
    errors = np.full(by_horizon.shape, np.nan)
    integrate_trials(compiled_columns(track), compiled_icrs(icrs), by_horizon, lo, 0, len(ends), errors)
    return errors.T


def open_loop_path(
    track: Track, y_icr_right: float, y_icr_left: float, x_icr: float, start: int, end: int
) -> OpenLoopPath:
    """Drive open loop from state `start` to state `end` with constant ICRs [m].

    Returns
    -------
    The path at every state from `start` to `end`, both included, beginning at the reference pose of `start`.
    """
    path = OpenLoopPath(*np.empty((3, end - start + 1)))
    path.north[0], path.east[0], path.heading[0] = track.north[start], track.east[start], track.heading[start]
    for reached, some in open_loop_pieces(track, y_icr_right, y_icr_left, x_icr, start, end):
        for column, values in zip(path, some, strict=True):
            column[reached.start - start : reached.stop - start] = values
    return path


def open_loop_pieces(
    track: Track, y_icr_right: float, y_icr_left: float, x_icr: float, start: int, end: int
) -> Iterator[tuple[slice, OpenLoopPath]]:
    """Yield the states after `start` piece by piece, and the path of `open_loop_path` at them."""
    separation, turned, place = max(abs(y_icr_left - y_icr_right), MIN_ICR_SEPARATION_M), 0.0, 0j
    ahead = cmath.exp(1j * track.heading[start])
    for lo in range(start, end, ROWS_AT_ONCE):  # paths of whole drives are as long as a column of the run
        some = slice(lo, min(lo + ROWS_AT_ONCE, end))
        over = track.held[some] / separation
        left, right = track.v_left[some] * over, track.v_right[some] * over
        turn = left - right
        heading = turned + np.cumsum(np.append(0.0, turn))
        moved = (left * y_icr_right - right * y_icr_left - 1j * x_icr * turn) * np.exp(1j * heading[:-1])
        places = place + np.cumsum(moved)
        turned, place = heading[-1], places[-1]
        places *= ahead
        yield (
            slice(some.start + 1, some.stop + 1),
            OpenLoopPath(
                track.north[start] + places.real, track.east[start] + places.imag, track.heading[start] + heading[1:]
            ),
        )
