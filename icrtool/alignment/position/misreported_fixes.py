"""Find fixes that are reported as fixed and are not: by their noise beside a jump, or between a jump and its return."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from icrtool.alignment.position.gnss_steps import FEWEST_STEPS, FixSteps
from icrtool.kernels.arrays import Bools, Floats, Ints

USUAL_M2 = 2 * 0.005**2
"""Stretches are not compared below this variance, both axes."""

STRETCH_VARIANCE = 9.0
"""A stretch whose white noise has this many times the usual variance is float by itself, unless its messages state
that it is fixed. Usual is what the fixes show while the robot moves: jitter of the stamps is noise then, and none where
it parks.
"""

BESIDE_JUMP = 5
SIDES_VARIANCE = 1.7
"""Beside a jump, the side whose noise over this many stretches has this many times the other's variance is float."""

LONGEST_EXCURSION_S = 60.0
TAKEN_BACK = 0.25
"""A jump that another takes back, up to this part, within this time: the fixes between were off."""

MOST_JUMPS = 500
"""With more of them the position reference is something else than RTK that is lost now and then."""


def find_misreported(stamps: Ints, steps: FixSteps, claimed: Bools, flagged: Bools) -> Bools:
    """Return the fixes (m,) among the `claimed` ones that move like RTK float.

    Parameters
    ----------
    claimed : bool (m,), reported as fixed; flagged : bool (m,), by a flag of the message itself and not by its variance

    A jump alone does not show which of its sides is wrong: noise does, or a return. Else the class stays.
    """
    misreported = np.zeros(len(stamps), np.bool_)
    level, moves = steps.stretch_levels(claimed), steps.stretch_moves()
    known, moving = level[np.isfinite(level)], level[np.isfinite(level) & moves]
    if len(known) < 2:
        return misreported
    usual = max(float(np.median(moving if len(moving) >= 2 else known)), USUAL_M2)
    with np.errstate(invalid="ignore"):
        noisy = level > STRETCH_VARIANCE * usual
    noisy &= ~flagged[1 : 1 + len(level) * FEWEST_STEPS].reshape(-1, FEWEST_STEPS).any(axis=1)
    jumps = np.flatnonzero(claimed[steps.jump_row] & claimed[np.maximum(steps.jump_row - 1, 0)])
    undecided, beside, nearby = [], _moving_mean(level, BESIDE_JUMP), _moving_mean(level, 3)
    for jump in jumps.tolist() if len(jumps) <= MOST_JUMPS else ():
        decided, stretches = _noisy_side(beside, nearby, moves, (int(steps.jump_row[jump]) - 1) // FEWEST_STEPS)
        noisy[stretches] = True
        if not decided:
            undecided.append(jump)
    misreported[1 : 1 + len(level) * FEWEST_STEPS] = np.repeat(noisy, FEWEST_STEPS)
    for jump, back in pairwise(undecided):
        first, last = steps.jump_row[jump], steps.jump_row[back]
        away, home = steps.jump[jump], steps.jump[back]
        short = back == jump + 1 and stamps[last] - stamps[first] < LONGEST_EXCURSION_S * 1e9
        if short and abs(away + home) < TAKEN_BACK * min(abs(away), abs(home)):
            misreported[first:last] = True
    return misreported & claimed


def _moving_mean(level: Floats, width: int) -> Floats:
    """Return the mean of `level` (n,) over a window of `width` about each entry, NaN where it holds no number."""
    kernel, known = np.ones(width), np.isfinite(level)
    total = np.convolve(np.where(known, level, 0.0), kernel, "same")[: len(level)]
    count = np.convolve(known.astype(np.float64), kernel, "same")[: len(level)]
    mean = np.full(len(level), np.nan)
    np.divide(total, count, out=mean, where=count > 0.5)
    return mean


def _noisy_side(beside: Floats, nearby: Floats, moves: Bools, at: int) -> tuple[bool, slice]:
    """Return whether noise distinguishes the sides of a jump in stretch `at`, and the stretches that are float then."""
    before, after = at - 1 - BESIDE_JUMP // 2, at + 1 + BESIDE_JUMP // 2
    if before < 0 or after >= len(beside) or not np.isfinite(beside[[before, after]]).all():
        return False, slice(0, 0)
    half = BESIDE_JUMP // 2
    if moves[before - half : before + half + 1].any() != moves[after - half : after + half + 1].any():
        return False, slice(0, 0)  # where the robot parks the fixes are quieter, whatever they are
    left, right = max(float(beside[before]), USUAL_M2), max(float(beside[after]), USUAL_M2)
    if max(left, right) < SIDES_VARIANCE * min(left, right):
        return False, slice(0, 0)
    bound = (left * right) ** 0.5
    with np.errstate(invalid="ignore"):
        quiet = np.flatnonzero(~(nearby >= bound))
    if left > right:
        ends = quiet[quiet < at - 1]
        return True, slice(int(ends[-1]) + 1 if len(ends) else 0, at + 1)
    ends = quiet[quiet > at + 1]
    return True, slice(at, int(ends[0]) if len(ends) else len(nearby))
