"""Detection of the unit of turn rates. REP-103 requires rad/s, but some drivers send deg/s."""

from __future__ import annotations

import math

import numpy as np

from icrtool.kernels.arrays import Floats, Ints, trapezoids
from icrtool.records.samples import HeadingSamples, PositionFixes

DEGREE = math.radians(1.0)
"""One degree [rad]."""

FASTEST_RADPS = math.radians(1000.0)
"""Largest turn rate of a robot [rad/s]."""

LARGEST_BAD_SHARE = 0.01
"""Largest share of turn rates of a used topic that are not finite, or faster than a robot turns."""

SPAN_S = 1.0
"""Time over which turns are compared [s]."""

SHORTEST_CHORD_M = 0.3
"""Smallest displacement between positions whose direction is used [m]."""

MOST_SPANS = 20.0
"""Longest time of a displacement of a slow robot, as a multiple of `SPAN_S`."""

FEWEST_TURNS_OF_GYRO = 10
"""Smallest number of turns that are compared. With fewer turns, the unit of the message type is used."""

LEAST_TURN_AGREEMENT = 0.6
"""Smallest agreement of the turns by deg/s with the reference's turns. The agreement is the length of the mean of the
unit vectors of the differences: 1 for equal turns, about 0 for unrelated turns."""

LEAST_SCATTER = 0.05
"""Smallest scatter (1 minus the agreement) with rad/s for which both scatters are compared."""

LARGEST_SCATTER_RATIO = 0.25
"""Largest ratio of the scatter with deg/s to the scatter with rad/s with which deg/s is decided. Small turns agree with
both units."""


def is_in_degrees(t_ns: Ints, rates: Floats, heading: HeadingSamples, fixes: PositionFixes) -> bool:
    """Return whether turn rates (n, 3) are in deg/s, by the turns of headings or fixes, else by the size of the rates.

    With the right unit, the integrated rate about the vertical axis agrees with the turn of the reference.
    """
    fast = is_too_fast(rates)
    for begin, end, turn, half_turns in (_heading_turns(heading), _course_turns(fixes)):
        inside = (begin >= t_ns[0]) & (end <= t_ns[-1])
        if np.count_nonzero(inside) >= FEWEST_TURNS_OF_GYRO:
            agreements = [
                _agreement(t_ns, rates * unit, begin[inside], end[inside], turn[inside], half_turns)
                for unit in (DEGREE, 1.0)
            ]
            in_degrees, in_radians = (1.0 - agreement for agreement in agreements)
            clearer = in_radians > LEAST_SCATTER and in_degrees < LARGEST_SCATTER_RATIO * in_radians
            return in_degrees < 1.0 - LEAST_TURN_AGREEMENT and (fast or clearer)
    return fast


def is_too_fast(rates: Floats) -> bool:
    """Return whether more than `LARGEST_BAD_SHARE` of turn rates (n, 3) [rad/s] are impossible for a robot."""
    return bool(np.count_nonzero(np.abs(rates).max(axis=1) > FASTEST_RADPS) > LARGEST_BAD_SHARE * len(rates))


def _agreement(t_ns: Ints, rates: Floats, begin: Ints, end: Ints, turn: Floats, half_turns: bool) -> float:
    """Return the agreement of turns (m,) [rad] with the rate about the axis that turns most, in the better sense.

    It is 1 for equal turns, and about 0 for unrelated turns.
    """
    t = (t_ns - t_ns[0]) / 1e9
    first, last = (begin - t_ns[0]) / 1e9, (end - t_ns[0]) / 1e9
    factor = 2.0 if half_turns else 1.0
    rate = rates[:, int(np.argmax(rates.std(axis=0)))]
    angle = trapezoids(t, rate - float(np.median(rate)))
    by_gyro = np.interp(last, t, angle) - np.interp(first, t, angle)
    differences = (turn - sense * by_gyro for sense in (1.0, -1.0))
    return max(abs(complex(np.mean(np.exp(1j * factor * difference)))) for difference in differences)


def _heading_turns(heading: HeadingSamples) -> tuple[Ints, Ints, Floats, bool]:
    """Return begin and end [ns] and angle [rad] of the turns of headings (m,), and False: half turns are distinct."""
    stamps = heading.stamp_ns
    rows = _spaced(stamps)
    turn = np.diff(heading.heading_rad[rows])
    return stamps[rows][:-1], stamps[rows][1:], turn, False


def _course_turns(fixes: PositionFixes) -> tuple[Ints, Ints, Floats, bool]:
    """Return begin and end [ns] and angle [rad] of the turns of the course over ground (m,), and True.

    True states that half turns are not distinct, because the robot may drive backwards. Begin and end are the middles
    of successive displacements.
    """
    stamps, position = fixes.stamp_ns, fixes.north_m + 1j * fixes.east_m
    moved = np.abs(np.diff(position[_spaced(stamps)]))
    usual = float(np.median(moved)) if len(moved) else 0.0
    rows = _spaced(stamps, SPAN_S * min(max(2.0 * SHORTEST_CHORD_M / max(usual, 1e-9), 1.0), MOST_SPANS))
    step = np.diff(position[rows])
    middle = stamps[rows][:-1] + np.diff(stamps[rows]) // 2
    clear = np.abs(step) > SHORTEST_CHORD_M
    both = clear[:-1] & clear[1:] if len(clear) else clear
    turn = np.angle(step[1:][both] * np.conj(step[:-1][both])) if len(step) > 1 else np.empty(0)
    return middle[:-1][both], middle[1:][both], turn, True


def _spaced(stamps: Ints, span_s: float = SPAN_S) -> Ints:
    """Return rows of samples that are about a span [s] apart."""
    if not len(stamps):
        return np.empty(0, np.int64)
    _, rows = np.unique((stamps - stamps[0]) // int(span_s * 1e9), return_index=True)
    return rows
