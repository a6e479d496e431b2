"""Open-loop errors of all starts at the cost of a few passes over the log, equal to the direct integration.

Write the plane as complex numbers, z = north + j east, with a = 1/W and D_i the sum of dt (v_l - v_r) up to state i.
The Euler steps from state k with frozen ICRs (Eqs. 8-12, Section 6.4) turn by a (D_i - D_k), hence

    z_j - z_k = a e^{j(psi_k - a D_k)} [ (y_r - j x) sum_i dt v_l e^{j a D_i} - (y_l - j x) sum_i dt v_r e^{j a D_i} ].

For one a the two sums are differences of prefix sums, whatever the start. The a of neighbouring starts differ little:
around the centre a_c of a block of starts, with half width w and a = a_c + w q, |q| <= 1,

    e^{j a D} = e^{j a_c D} sum_m (j w D)^m / m! q^m,

so a few prefix sums (the moments m = 0, 1, ...) serve every start of the block by a polynomial in q. Their number
follows from w max|D|. One sine and cosine a state do for all moments; interpolation between Chebyshev nodes in a takes
as many sums but a sine and cosine for each of them, and was 1.7 times slower.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.compiled import njit
from icrtool.kernels.kinematics import icr_separation
from icrtool.kernels.open_loop.direct import compiled_drive, compiled_icrs, integrate_trials
from icrtool.kernels.open_loop.trials import Drive, FrozenIcrs

TOLERANCE_M = 1e-11
"""Largest error [m] of an end position by the moments left out. With rounding the total stays well below 1e-9 m."""
ROUNDING_LIMIT_M = 2e-10
"""Where rounding alone could move an end position by this much [m], the path is integrated directly."""
MAX_MOMENTS = 16
"""A block that needs more moments is split: halving the block is cheaper than doubling its moments."""
MIN_BLOCK = 8
"""Blocks of this size are integrated directly instead of split: that is not slower."""
BLOCK = 2048
"""Starts a block (at least as many as the states of its first trial: then the window is about twice the block)."""
CONSTANT_BLOCK = 8192
"""The same where every start has the same ICRs: one moment is enough for any block, and longer blocks share more."""
MAX_BLOCK = 32768
"""Bounds the memory of a block to a few MB."""
TILE = 128
"""States whose moments are kept at once: they stay in the first-level cache while their trials are evaluated."""
_EPS = 2.220446049250313e-16


@njit
def last_end(ends: Ints, row_lo: int, row_hi: int) -> int:
    """Return the last state at which a trial of these starts ends; -1 if none has one."""
    last = -1
    for h in range(ends.shape[0]):
        for row in range(row_hi - 1, row_lo - 1, -1):
            if ends[h, row] >= 0:
                last = max(last, ends[h, row])
                break
    return last


class BlockPlan(NamedTuple):
    """How a block of starts is served.

    Attributes
    ----------
    moments : how many moments; 0: none keep the tolerance
    a_centre, half_width : a_c and w [1/m]
    first_turn : D [m] of the block's first state, against the middle of its range
    """

    moments: int
    a_centre: float
    half_width: float
    first_turn: float


@njit
def plan_block(drive: Drive, icrs: FrozenIcrs, start_lo: int, start_hi: int, last: int) -> BlockPlan:
    """Choose the moments for the starts [start_lo, start_hi) whose trials end at state `last` at the latest.

    Notes
    -----
    What is left out after M moments is below scale (w r)^M / M! / (1 - w r / (M + 1)), with r the half range of D and
    scale the length of a path on which nothing cancels.
    """
    turn, turn_min, turn_max, travel_left, travel_right = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(start_lo, last):
        if not drive.gap[i]:
            turn += drive.dt_s[i] * (drive.v_left[i] - drive.v_right[i])
            turn_min, turn_max = min(turn_min, turn), max(turn_max, turn)
            travel_left += abs(drive.dt_s[i] * drive.v_left[i])
            travel_right += abs(drive.dt_s[i] * drive.v_right[i])
    each = 0 if len(icrs.x_icr) == 1 else 1
    a_min, a_max, arm_left, arm_right = math.inf, 0.0, 0.0, 0.0
    for k in range(start_lo, start_hi):
        y_icr_right, y_icr_left = icrs.y_icr_right[k * each], icrs.y_icr_left[k * each]
        a = 1.0 / icr_separation(y_icr_right, y_icr_left)
        a_min, a_max = min(a_min, a), max(a_max, a)
        arm_left = max(arm_left, abs(y_icr_right) + abs(icrs.x_icr[k * each]))
        arm_right = max(arm_right, abs(y_icr_left) + abs(icrs.x_icr[k * each]))
    half_width, half_range = 0.5 * (a_max - a_min), 0.5 * (turn_max - turn_min)
    scale = a_max * (arm_left * travel_left + arm_right * travel_right)
    moments, left_out = 1, scale * half_width * half_range
    while 2.0 * left_out > TOLERANCE_M and moments <= MAX_MOMENTS:
        moments += 1
        left_out *= half_width * half_range / moments
    if moments > MAX_MOMENTS or _EPS * (1.0 + a_max * half_range) * scale > ROUNDING_LIMIT_M:
        moments = 0
    return BlockPlan(moments, 0.5 * (a_min + a_max), half_width, -0.5 * (turn_min + turn_max))


@njit
def sum_moments(drive: Drive, plan: BlockPlan, state_lo: int, rows: int, turns: Floats, sums: Floats) -> None:
    """Continue D [m] in `turns` (rows + 1,) and the prefix sums from row 0, which is `state_lo`, to row `rows`.

    `sums` is (rows + 1, moments, 4): real and imaginary part of the left sum, then of the right one.
    """
    for row in range(rows):
        i = state_lo + row
        turn, dt = turns[row], 0.0 if drive.gap[i] else drive.dt_s[i]
        step_left, step_right = dt * drive.v_left[i], dt * drive.v_right[i]
        real, imag = 0.0, 0.0
        if step_left != 0.0 or step_right != 0.0:
            # no trial spans a gap, and standstill adds nothing: a parked robot costs no sine
            real, imag = math.cos(plan.a_centre * turn), math.sin(plan.a_centre * turn)
        turns[row + 1] = turn + dt * (drive.v_left[i] - drive.v_right[i])
        for m in range(sums.shape[1]):
            sums[row + 1, m, 0] = sums[row, m, 0] + step_left * real
            sums[row + 1, m, 1] = sums[row, m, 1] + step_left * imag
            sums[row + 1, m, 2] = sums[row, m, 2] + step_right * real
            sums[row + 1, m, 3] = sums[row, m, 3] + step_right * imag
            factor = plan.half_width * turn / (m + 1)
            real, imag = -imag * factor, real * factor


@njit
def weigh_moments(sums: Floats, row: int, q: float) -> tuple[float, float, float, float]:
    """Evaluate the polynomials in q whose coefficients are the moments at `row` (Horner)."""
    left_re, left_im, right_re, right_im = 0.0, 0.0, 0.0, 0.0
    for m in range(sums.shape[1] - 1, -1, -1):
        left_re = left_re * q + sums[row, m, 0]
        left_im = left_im * q + sums[row, m, 1]
        right_re = right_re * q + sums[row, m, 2]
        right_im = right_im * q + sums[row, m, 3]
    return left_re, left_im, right_re, right_im


@njit
def freeze_start(
    heading: float, y_icr_right: float, y_icr_left: float, x_icr: float, turn: float
) -> tuple[float, float, float, float, float]:
    """Return a = 1/W and the factors of the left and the right sum: a e^{j(psi - a D)} (y_r - j x), ... (y_l - j x)."""
    a = 1.0 / icr_separation(y_icr_right, y_icr_left)
    # two angles, not their difference: psi may be thousands of radians, a D is small
    cos_psi, sin_psi = math.cos(heading), math.sin(heading)
    cos_turn, sin_turn = math.cos(a * turn), math.sin(a * turn)
    real = a * (cos_psi * cos_turn + sin_psi * sin_turn)
    imag = a * (sin_psi * cos_turn - cos_psi * sin_turn)
    return (
        a,
        real * y_icr_right + imag * x_icr,
        imag * y_icr_right - real * x_icr,
        real * y_icr_left + imag * x_icr,
        imag * y_icr_left - real * x_icr,
    )


@njit
def solve_block(
    drive: Drive,
    icrs: FrozenIcrs,
    plan: BlockPlan,
    ends: Ints,
    lo: int,
    row_lo: int,
    row_hi: int,
    last: int,
    sums: Floats,
    turns: Floats,
    frozen: Floats,
    next_row: Ints,
    errors: Floats,
) -> None:
    """Fill `errors` for the rows [row_lo, row_hi): march over the window once, a tile of states at a time.

    Notes
    -----
    For one horizon the ends grow with the starts, so `next_row` (n_horizons,) points to the next start to reach its
    end, and moments are needed only for the current tile: memory is that of the block's starts, for any window.
    `frozen` (row_hi - row_lo, 9) keeps q, both factors and both sums of each start. `sums` and `turns` come with their
    row 0 filled. The caller allocates: in here that would double the time to compile. The trial stands in the loop: a
    function which takes the arrays would not be inlined, and be half as fast.
    """
    each = 0 if len(icrs.x_icr) == 1 else 1
    for tile_lo in range(lo + row_lo, last + 1, TILE):
        tile_hi = min(tile_lo + TILE, last + 1)
        sum_moments(drive, plan, tile_lo, min(TILE, last - tile_lo), turns, sums)
        for k in range(tile_lo, min(tile_hi, lo + row_hi)):
            s = k - lo - row_lo
            tried = False
            for h in range(ends.shape[0]):
                if ends[h, k - lo] >= 0:
                    tried = True
                    break
            if not tried:
                continue
            a, frozen[s, 1], frozen[s, 2], frozen[s, 3], frozen[s, 4] = freeze_start(
                drive.heading[k],
                icrs.y_icr_right[k * each],
                icrs.y_icr_left[k * each],
                icrs.x_icr[k * each],
                turns[k - tile_lo],
            )
            frozen[s, 0] = (a - plan.a_centre) / plan.half_width if plan.half_width > 0.0 else 0.0
            frozen[s, 5], frozen[s, 6], frozen[s, 7], frozen[s, 8] = weigh_moments(sums, k - tile_lo, frozen[s, 0])
        for h in range(ends.shape[0]):
            row = next_row[h]
            while row < row_hi and ends[h, row] < tile_hi:
                end = ends[h, row]
                if end >= 0:
                    s = row - row_lo
                    left_re, left_im, right_re, right_im = weigh_moments(sums, end - tile_lo, frozen[s, 0])
                    left_re -= frozen[s, 5]
                    left_im -= frozen[s, 6]
                    right_re -= frozen[s, 7]
                    right_im -= frozen[s, 8]
                    moved_north = frozen[s, 1] * left_re - frozen[s, 2] * left_im
                    moved_north -= frozen[s, 3] * right_re - frozen[s, 4] * right_im
                    moved_east = frozen[s, 1] * left_im + frozen[s, 2] * left_re
                    moved_east -= frozen[s, 3] * right_im + frozen[s, 4] * right_re
                    miss_north = moved_north - (drive.north[end] - drive.north[lo + row])
                    miss_east = moved_east - (drive.east[end] - drive.east[lo + row])
                    errors[h, row] = math.sqrt(miss_north * miss_north + miss_east * miss_east)
                row += 1
            next_row[h] = row
        turns[0] = turns[TILE]
        for m in range(sums.shape[1]):
            for c in range(4):
                sums[0, m, c] = sums[TILE, m, c]


def open_loop_errors(drive: Drive, icrs: FrozenIcrs, ends: Ints, lo: int = 0) -> Floats:
    """Return what `open_loop_errors_direct` returns, equal to 1e-9 m, far sooner.

    Notes
    -----
    Beyond the result and `ends`, memory is a few MB whatever the log; call it for ranges
    of starts to bound those as well. Blocks whose ICRs vary too much over their turns, or whose ICRs nearly coincide,
    are halved; the smallest blocks are integrated directly.
    """
    by_horizon = np.ascontiguousarray(ends.T)
    errors = np.full(by_horizon.shape, np.nan)
    drive, icrs = compiled_drive(drive), compiled_icrs(icrs)
    block = CONSTANT_BLOCK if len(icrs.x_icr) == 1 else BLOCK
    row_lo, size, starts = 0, MAX_BLOCK, len(ends)
    while row_lo < starts:
        # a robot that hardly moves has long windows: longer blocks share them
        first_window = last_end(by_horizon, row_lo, row_lo + 1) - lo - row_lo
        row_hi = min(row_lo + min(max(block, first_window), size), starts)
        while True:
            last = last_end(by_horizon, row_lo, row_hi)
            plan = plan_block(drive, icrs, lo + row_lo, lo + row_hi, last)
            if plan.moments or row_hi - row_lo <= MIN_BLOCK:
                break
            row_hi = row_lo + (row_hi - row_lo) // 2
        if plan.moments:
            sums, turns = np.zeros((TILE + 1, plan.moments, 4)), np.full(TILE + 1, plan.first_turn)
            frozen, next_row = np.empty((row_hi - row_lo, 9)), np.full(len(by_horizon), row_lo)
            solve_block(drive, icrs, plan, by_horizon, lo, row_lo, row_hi, last, sums, turns, frozen, next_row, errors)
        else:
            integrate_trials(drive, icrs, by_horizon, lo, row_lo, row_hi, errors)
        row_lo, size = row_hi, min(2 * (row_hi - row_lo), MAX_BLOCK)
    return errors.T
