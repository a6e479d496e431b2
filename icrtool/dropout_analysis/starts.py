"""Which recorded states open-loop trials start from, and from which of them on the ICRs were learned."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from icrtool.estimation.observability import WEAK_SHARE
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.kernels.track import STANDING, Track, trial_ends
from icrtool.records.run import ICR_COLUMNS, Run

Starts = Literal["moving", "all"]
"""``moving``: each standstill gives one start, the state from which the robot drives on; ``all``: every state."""

STANDING_MPS = 0.01
"""The robot stands while both tracks are slower than this."""

LEARNED_SHARE = 0.9
"""Part of the fall of its standard deviation after which an ICR is learned."""

LEAST_FALL = 0.5
"""A standard deviation that loses less than this part of itself shows that the drive added nothing to the start."""


def standing_states(track: Track) -> Bools:
    """Return the states (n,) after which the robot stands; the last state, which has no interval, is none of them."""
    standing: Bools = (np.abs(track.v_left) < STANDING_MPS) & (np.abs(track.v_right) < STANDING_MPS)
    standing[-1:] = False
    return standing


def leave_out_standing(ends: NDArray[np.signedinteger], standing: Bools) -> None:
    """Mark the trials of standing starts as none, in the ends (n, h) of `trial_ends`."""
    ends[standing[:, None] & (ends >= 0)] = STANDING


def counted_ends(track: Track, horizon_m: float, starts: Starts) -> Ints:
    """Return `trial_ends` (n, 1) of one horizon, without the starts that do not count."""
    ends = trial_ends(track, np.array([horizon_m]))
    if starts == "moving":
        leave_out_standing(ends, standing_states(track))
    return ends


def first_learned(run: Run) -> int | None:
    """Return the first state at which all ICRs were learned; None where they never were.

    Notes
    -----
    The standard deviation of an ICR falls from s_0 at the first state to s_f, its median over the second half of the
    states. The ICR is learned at the first state with s <= s_f + 0.1 (s_0 - s_f): 90 % of the change, as Pentzer 2014
    (Section 5.2) counts it for the estimate itself. The standard deviation is taken because a trial that starts there
    does not know the final value yet. An ICR whose standard deviation does not fall by half was known from the start
    where it is at most `WEAK_SHARE` of y_right - y_left, the limit of "weakly shown", and is never learned otherwise. A
    warm start has learned the ICRs before the first state.
    """
    if run.began_with is not None:
        return 0
    learned = np.ones(len(run.table), np.bool_)
    separation = abs(float(run.table.y_icr_right_m[-1] - run.table.y_icr_left_m[-1]))
    for column in ICR_COLUMNS:
        std: Floats = getattr(run.table, f"std_{column}")
        first, final = float(std[0]), float(np.median(std[len(std) // 2 :]))
        if final > (1.0 - LEAST_FALL) * first:
            if first > WEAK_SHARE * separation:
                return None
            continue
        learned &= std <= final + (1.0 - LEARNED_SHARE) * (first - final)
    return int(np.argmax(learned)) if learned.any() else None
