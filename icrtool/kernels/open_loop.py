"""Open-loop propagation from recorded states: one path, all trials step by step, and the same errors by a fast method.

The dropout analysis of Pentzer 2014, Section 6.4: the ICRs that are estimated at a state are frozen, wheel speeds alone
predict the path, and its end is compared with the reference when the path has grown by a horizon.
`open_loop_errors_direct` integrates every trajectory and is the oracle; `open_loop_errors` gives the same errors at the
cost of a few passes over the log.

Write the plane as complex numbers, z = north + j east, with a = 1/W and D_i the sum of dt (v_l - v_r) up to state i.
The Euler steps from state k with frozen ICRs (Eqs. 8-12, Section 6.4) turn by a (D_i - D_k), hence

    z_j - z_k = a e^{j(psi_k - a D_k)} [ (y_r - j x) sum_i dt v_l e^{j a D_i} - (y_l - j x) sum_i dt v_r e^{j a D_i} ].

For one a the two sums are differences of prefix sums, whatever the start. The a of neighbouring starts differ little:
around the centre a_c of a block of starts, with half width w and a = a_c + w q, |q| <= 1,

    e^{j a D} = e^{j a_c D} sum_m (j w D)^m / m! q^m,

so that a few prefix sums (the moments m = 0, 1, ...) give the errors of every start of the block by a polynomial in q.
Their number follows from w max|D|. All moments of a state need one sine and one cosine. Interpolation between Chebyshev
nodes in a needs the same number of sums, but a sine and a cosine for each, and was 1.7 times slower.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import ROWS_AT_ONCE, Floats, Rows
from icrtool.kernels.compiled import njit
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M, euler_step
from icrtool.kernels.track import FrozenIcrs, OpenLoopPath, Track

TrackColumns = tuple[Floats, Floats, Floats, Floats, Floats, Floats]
"""Columns of a track of states: held, v_left, v_right, north, east, heading."""


@njit
def integrate_trials(
    columns: TrackColumns, icrs: FrozenIcrs, ends: Rows, lo: int, row_lo: int, row_hi: int, errors: Floats
) -> None:
    """Fill rows [row_lo, row_hi) of `errors` (n_horizons, n_starts): each path is integrated once for all horizons.

    Notes
    -----
    The path is integrated from the origin with heading zero, and turned into place at its end. Its rounding then does
    not depend on the distance of the datum or on the number of turns of the robot.
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


def compiled_columns(track: Track) -> TrackColumns:
    """Return the columns of a track in the form that kernels are compiled for; only other forms are copied.

    Notes
    -----
    Kernels refuse a read-only column, and pandas returns read-only columns.
    """
    columns = (track.held, track.v_left, track.v_right, track.north, track.east, track.heading)
    held, left, right, north, east, heading = (np.require(column, np.float64, ["C", "A", "W"]) for column in columns)
    return held, left, right, north, east, heading


def compiled_icrs(icrs: FrozenIcrs) -> FrozenIcrs:
    """Return ICRs in the form that kernels are compiled for (see `compiled_columns`)."""
    return FrozenIcrs(*[np.require(column, np.float64, ["C", "A", "W"]) for column in icrs])


def open_loop_errors_direct(track: Track, icrs: FrozenIcrs, ends: Rows, lo: int = 0) -> Floats:
    """Return the errors of trials by integration step by step, in O(starts x steps): the oracle of `open_loop_errors`.

    Parameters
    ----------
    track : track of recorded states (n,)
    icrs : ICRs that predict the trial from each start
    ends : (n_starts, n_horizons) result of `trial_ends` for the starts from `lo` on

    Returns
    -------
    float64 (n_starts, n_horizons)
        Horizontal distance [m] between the open-loop position and the reference at the end of each trial, each horizon
        contiguous; NaN for a start without a trial.

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
    """Return the open-loop path from state `start` to state `end` with constant ICRs [m].

    Returns
    -------
    OpenLoopPath
        The path at every state from `start` to `end`, both included. It begins at the reference pose of `start`.
    """
    path = OpenLoopPath(*np.empty((3, end - start + 1)))
    path.north[0], path.east[0], path.heading[0] = track.north[start], track.east[start], track.heading[start]
    for reached, piece in open_loop_pieces(track, FrozenIcrs.constant(y_icr_right, y_icr_left, x_icr), start, end):
        for column, values in zip(path, piece, strict=True):
            column[reached.start - start : reached.stop - start] = values
    return path


def open_loop_pieces(track: Track, icrs: FrozenIcrs, start: int, end: int) -> Iterator[tuple[slice, OpenLoopPath]]:
    """Yield the states after `start` in pieces, and the open-loop path at them.

    `icrs` has one triple for the whole path, or one for each state of the track, which then holds until the next state.
    """
    turned, place = 0.0, 0j
    ahead = cmath.exp(1j * track.heading[start])
    for lo in range(start, end, ROWS_AT_ONCE):
        # The path is computed in pieces, because a whole path is as large as a column of the run.
        chunk = slice(lo, min(lo + ROWS_AT_ONCE, end))
        y_icr_right, y_icr_left, x_icr = (column if len(column) == 1 else column[chunk] for column in icrs)
        over = track.held[chunk] / np.maximum(np.abs(y_icr_left - y_icr_right), MIN_ICR_SEPARATION_M)
        left, right = track.v_left[chunk] * over, track.v_right[chunk] * over
        turn = left - right
        heading = turned + np.cumsum(np.append(0.0, turn))
        moved = (left * y_icr_right - right * y_icr_left - 1j * x_icr * turn) * np.exp(1j * heading[:-1])
        places = place + np.cumsum(moved)
        turned, place = heading[-1], places[-1]
        places *= ahead
        yield (
            slice(chunk.start + 1, chunk.stop + 1),
            OpenLoopPath(
                track.north[start] + places.real, track.east[start] + places.imag, track.heading[start] + heading[1:]
            ),
        )


TOLERANCE_M = 1e-11
"""Largest error of an end position by the moments that are left out [m]. With rounding, the error is well below 1e-9
m."""
ROUNDING_LIMIT_M = 2e-10
"""Bound of the rounding error of an end position above which the path is integrated directly [m]."""
MAX_MOMENTS = 16
"""Largest number of moments of a block. A block that needs more moments is split, because two halves cost less than
twice the moments."""
MIN_BLOCK = 8
"""Number of starts of a block that is integrated directly and not split, because splitting would not be faster."""
BLOCK = 4096
"""Usual number of starts of a block. A block has at least one start for each state of its first trial, so that the
states of its trials are about twice its starts."""
CONSTANT_BLOCK = 8192
"""Number of starts of a block if every start has the same ICRs. One moment is then enough, and a longer block shares
more sums."""
MAX_BLOCK = 32768
"""Largest number of starts of a block, and number of states whose moments are kept at a time. It bounds the memory to a
few MB."""
_EPS = 2.220446049250313e-16
"""Distance from 1 to the next double."""


class BlockPlan(NamedTuple):
    """Plan for the errors of a block of starts.

    Attributes
    ----------
    moments : number of moments; 0 if no number of moments is within the tolerance
    a_centre, half_width : a_c and w [1/m]
    first_turn : D of the first state of the block, from the middle of the range of D [m]
    """

    moments: int
    a_centre: float
    half_width: float
    first_turn: float


class WheelSteps(NamedTuple):
    """Steps of the wheels from state `first` on.

    Attributes
    ----------
    left, right : (n,) travel of the sides in each step [m]; 0 over gaps, which no trial crosses
    turn : (n + 1,) D at the states before, between and after the steps [m]
    """

    first: int
    left: Floats
    right: Floats
    turn: Floats


def wheel_steps(columns: TrackColumns, first: int, last: int, turn: float) -> Iterator[WheelSteps]:
    """Yield the steps from state `first`, where D is `turn` [m], to state `last`, in chunks."""
    held, v_left, v_right, *_ = columns
    for lo in range(first, last, MAX_BLOCK):
        chunk = slice(lo, min(lo + MAX_BLOCK, last))
        left, right = held[chunk] * v_left[chunk], held[chunk] * v_right[chunk]
        turns = turn + np.cumsum(np.append(0.0, left - right))
        yield WheelSteps(lo, left, right, turns)
        turn = turns[-1]


def plan_block(columns: TrackColumns, icrs: FrozenIcrs, last: int, starts: slice) -> BlockPlan:
    """Return the plan for some starts and their `icrs`, whose trials end at state `last` or before.

    Notes
    -----
    The error after M moments is below s (w r)^M / M! / (1 - w r / (M + 1)), where r is half of the range of D, and s
    the length of a path on which nothing cancels.
    """
    turn_min, turn_max, travel_left, travel_right = 0.0, 0.0, 0.0, 0.0
    for steps in wheel_steps(columns, starts.start, last, 0.0):
        turn_min, turn_max = min(turn_min, steps.turn.min()), max(turn_max, steps.turn.max())
        travel_left, travel_right = travel_left + np.abs(steps.left).sum(), travel_right + np.abs(steps.right).sum()
    a, forward = _turn_gain(icrs), np.abs(icrs.x_icr)
    a_min, a_max = float(a.min()), float(a.max())
    half_width, half_range = 0.5 * (a_max - a_min), 0.5 * (turn_max - turn_min)
    arms = (float((np.abs(y_icr) + forward).max()) for y_icr in icrs[:2])
    scale = a_max * sum(arm * travel for arm, travel in zip(arms, (travel_left, travel_right), strict=True))
    moments, left_out = 1, scale * half_width * half_range
    while 2.0 * left_out > TOLERANCE_M and moments <= MAX_MOMENTS:
        moments += 1
        left_out *= half_width * half_range / moments
    if moments > MAX_MOMENTS or _EPS * (1.0 + a_max * half_range) * scale > ROUNDING_LIMIT_M:
        moments = 0
    return BlockPlan(moments, 0.5 * (a_min + a_max), half_width, -0.5 * (turn_min + turn_max))


def _turn_gain(icrs: FrozenIcrs) -> Floats:
    """Return a = 1/W [1/m]."""
    gain: Floats = 1.0 / np.maximum(np.abs(icrs.y_icr_left - icrs.y_icr_right), MIN_ICR_SEPARATION_M)
    return gain


@njit
def sum_moments(
    left: Floats, right: Floats, turn: Floats, a_centre: float, half_width: float, moments: int, sums: Floats
) -> None:
    """Continue the prefix sums of `WheelSteps` from row 0.

    `sums` is (n + 1, moments, 4), highest first: real and imaginary part of the left sum, then of the right one.
    """
    for i in range(len(left)):
        real, imag = 0.0, 0.0
        if left[i] != 0.0 or right[i] != 0.0:
            # A standstill adds nothing to the sums, so no sine is computed for a parked robot.
            real, imag = math.cos(a_centre * turn[i]), math.sin(a_centre * turn[i])
        for m in range(moments):
            c = moments - 1 - m
            sums[i + 1, c, 0] = sums[i, c, 0] + left[i] * real
            sums[i + 1, c, 1] = sums[i, c, 1] + left[i] * imag
            sums[i + 1, c, 2] = sums[i, c, 2] + right[i] * real
            sums[i + 1, c, 3] = sums[i, c, 3] + right[i] * imag
            factor = half_width * turn[i] / (m + 1)
            real, imag = -imag * factor, real * factor


def freeze_starts(plan: BlockPlan, icrs: FrozenIcrs, heading: Floats, turn: Floats) -> Floats:
    """Return the constants of each start (k, 7): q, the factors of the left and of the right sum, and 0 for its place.

    The factors are a e^{j(psi - a D)} (y_r - j x) and a e^{j(psi - a D)} (y_l - j x).
    """
    a, frozen = _turn_gain(icrs), np.zeros((len(heading), 7))
    # The two angles are not subtracted, because psi may be thousands of radians and a D is small.
    common = a * np.exp(1j * heading) * np.exp(-1j * a * turn)
    frozen[:, 0] = (a - plan.a_centre) / plan.half_width if plan.half_width > 0.0 else 0.0
    for column, y_icr in ((1, icrs.y_icr_right), (3, icrs.y_icr_left)):
        factor = common * (y_icr - 1j * icrs.x_icr)
        frozen[:, column], frozen[:, column + 1] = factor.real, factor.imag
    return frozen


@njit
def fill_errors(
    ends: Rows, row_lo: int, first: int, sums: Floats, frozen: Floats, start: int, north: Floats, east: Floats,
    errors: Floats,
) -> None:  # fmt: skip
    """Fill `errors` of the trials that end at the states of `sums`, which begin at `first`.

    Parameters
    ----------
    ends, errors : (horizons, starts); row_lo : row of the block's first start, which is state `start`
    frozen : result of `freeze_starts`; the place of each start is filled in if its state is a state of `sums`

    Notes
    -----
    The displacement of a trial is the polynomial in q with the moments at its end as coefficients (Horner), minus the
    polynomial at its start.
    """
    for h in range(-1, len(ends)):
        for s in range(len(frozen)):
            e = (start + s if h < 0 else ends[h, row_lo + s]) - first
            # The state at a border is the last state of one chunk and the first state of the next.
            if e < 0 or e >= len(sums):
                continue
            q, left_re, left_im, right_re, right_im = (
                frozen[s, 0],
                frozen[s, 1],
                frozen[s, 2],
                frozen[s, 3],
                frozen[s, 4],
            )
            l_re, l_im, r_re, r_im = 0.0, 0.0, 0.0, 0.0
            for m in range(sums.shape[1]):
                l_re = l_re * q + sums[e, m, 0]
                l_im = l_im * q + sums[e, m, 1]
                r_re = r_re * q + sums[e, m, 2]
                r_im = r_im * q + sums[e, m, 3]
            n = left_re * l_re - left_im * l_im - right_re * r_re + right_im * r_im
            o = left_re * l_im + left_im * l_re - right_re * r_im - right_im * r_re
            if h < 0:
                frozen[s, 5], frozen[s, 6] = n, o
            else:
                n -= frozen[s, 5] + (north[first + e] - north[start + s])
                o -= frozen[s, 6] + (east[first + e] - east[start + s])
                errors[h, row_lo + s] = math.sqrt(n * n + o * o)


def solve_block(
    columns: TrackColumns,
    icrs: FrozenIcrs,
    plan: BlockPlan,
    ends: Rows,
    row_lo: int,
    starts: slice,
    last: int,
    errors: Floats,
) -> None:
    """Fill `errors` of some starts, rows of `ends` from `row_lo` on; all parameters as in `plan_block`."""
    north, east, heading = columns[3:]
    rows, frozen = np.zeros((min(max(last - starts.start, 0), MAX_BLOCK) + 1, plan.moments, 4)), np.zeros((0, 7))
    for steps in wheel_steps(columns, starts.start, last, plan.first_turn):
        # All starts are among the first states.
        if steps.first == starts.start:
            turn = steps.turn[: starts.stop - starts.start]
            block_icrs = FrozenIcrs(*(column[: len(turn)] for column in icrs))
            frozen = freeze_starts(plan, block_icrs, heading[starts][: len(turn)], turn)
        else:
            rows[0] = rows[-1]
        sums = rows[: len(steps.turn)]
        sum_moments(steps.left, steps.right, steps.turn, plan.a_centre, plan.half_width, plan.moments, sums)
        fill_errors(ends, row_lo, steps.first, sums, frozen, starts.start, north, east, errors)


def open_loop_errors(track: Track, icrs: FrozenIcrs, ends: Rows, lo: int = 0) -> Floats:
    """Return the errors of `open_loop_errors_direct`, equal to 1e-9 m, in far less time."""
    by_horizon = np.ascontiguousarray(ends.T)
    errors = np.empty(by_horizon.shape)
    fill_open_loop_errors(track, icrs, by_horizon, errors, 0, len(ends), lo)
    return errors.T


def fill_open_loop_errors(
    track: Track, icrs: FrozenIcrs, ends: Rows, errors: Floats, row_lo: int, starts: int, lo: int = 0
) -> None:
    """Fill the `errors` of `open_loop_errors` of the starts [row_lo, starts); (n_horizons, n_starts) as `ends`.

    Notes
    -----
    Memory is a few MB whatever the log. Blocks whose ICRs vary too much over their turns, or whose ICRs nearly
    coincide, are halved; the smallest blocks are integrated directly.
    """
    errors[:, row_lo:starts] = np.nan
    columns, icrs = compiled_columns(track), compiled_icrs(icrs)
    constant, size = len(icrs.x_icr) == 1, MAX_BLOCK
    while row_lo < starts:
        # A robot that hardly moves has windows of many states, which the starts of a longer block share.
        first_window = int(ends[:, row_lo].max(initial=-1)) - lo - row_lo
        row_hi = min(row_lo + min(max(CONSTANT_BLOCK if constant else BLOCK, first_window), size), starts)
        while True:
            block, last = slice(lo + row_lo, lo + row_hi), int(ends[:, row_lo:row_hi].max(initial=-1))
            block_icrs = icrs if constant else FrozenIcrs(*(column[block] for column in icrs))
            plan = plan_block(columns, block_icrs, last, block)
            if plan.moments or row_hi - row_lo <= MIN_BLOCK:
                break
            row_hi = row_lo + (row_hi - row_lo) // 2
        if plan.moments:
            solve_block(columns, block_icrs, plan, ends, row_lo, block, last, errors)
        else:
            integrate_trials(columns, icrs, ends, lo, row_lo, row_hi, errors)
        row_lo, size = row_hi, min(2 * (row_hi - row_lo), MAX_BLOCK)
