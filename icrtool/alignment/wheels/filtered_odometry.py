"""Find wheels that are another filter's output: low-passed, or with a heading from elsewhere.

Wheels that slip lose or gain turn for good: how far their turn is from the heading's grows like a random walk. What a
filter smooths, delays or pulls back to an absolute heading stays near it, however long it drives.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.alignment.estimator import TURNS_SLIPPING, AlignmentFit
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.robust import huber_weights, mad_std
from icrtool.kernels.track import Track

NOISE_S, SHORT_S, MIDDLE_S, LONGEST_S = 0.3, 1.0, 5.0, 40.0
"""Turns are compared over these times; in the first there is hardly more than noise."""

SHORTEST_LONG_S, LONG_WINDOWS, FEWEST_WINDOWS = 15.0, 8.0, 6
"""The long windows last at least so long, a drive has so many of them, and so many are whole."""

STARTS_A_WINDOW, ROUNDS = 4, 5
SIGMAS, SMALLEST_CHANGE = 3.0, 0.1
"""The ratio of turn to wheels' turn changes from short to long windows where it differs by more than both."""

AS_THE_ROBOT = 0.1
"""A ratio over long windows this near to 1 is that of something that knows the heading: wheels in turns slip more."""

LARGE_SHARE, LARGE_RAD = 0.25, math.radians(3.0)
"""Wheels are off the heading's turn by a filter's doing where by more than this part of the turn in a second, and by
more than attitude sensors err."""

BOUNDED = 1.5
"""What a random walk adds grows by 2 from 5 to 20 s and by 2.8 to 40 s."""


class Turns(NamedTuple):
    """Turns of the heading and of the wheels over windows of one length.

    Attributes
    ----------
    ratio, ratio_std : turn of the heading per turn of the wheels
    left_rad : robust scatter of the heading's turn beyond that; turn_rad : rms turn of the heading
    """

    ratio: float
    ratio_std: float
    left_rad: float
    turn_rad: float


def compare_turns(track: Track, width_m: float, delay_s: float, window_s: float) -> Turns | None:
    """Compare the turns of heading and wheels over windows of some length; None where there are too few.

    Parameters
    ----------
    width_m : the track width b
    delay_s : by which the heading lags the wheels
    """
    t = track.t
    turned = track.cumulate(2.0 * track.half_difference / width_m)
    first = max(t[0] + delay_s, track.heading_t[0])
    last = min(t[-1] + delay_s, track.heading_t[-1]) - window_s
    begin = np.arange(first, last, window_s / STARTS_A_WINDOW)
    by_wheels, by_heading = (
        np.interp(begin + window_s - shift, times, angle) - np.interp(begin - shift, times, angle)
        for shift, times, angle in ((delay_s, t, turned), (0.0, track.heading_t, track.heading))
    )
    whole = track.clear(begin - delay_s, begin + window_s - delay_s)
    moved = np.interp(begin + window_s - delay_s, t, track.travel) > np.interp(begin - delay_s, t, track.travel)
    kept = whole & moved
    if np.count_nonzero(kept) < STARTS_A_WINDOW * FEWEST_WINDOWS:
        return None
    return _regress(by_wheels[kept], by_heading[kept], np.arange(len(begin))[kept] // STARTS_A_WINDOW)


def _regress(wheels: Floats, heading: Floats, group: Ints) -> Turns | None:
    """Return the ratio of two turns (w,) by robust regression, its deviation from groups of windows."""
    weight, information = np.ones(len(wheels)), float(wheels @ wheels)
    if information <= 0.0:
        return None
    ratio = float(wheels @ heading) / information
    for _ in range(ROUNDS):
        left = heading - ratio * wheels
        weight = huber_weights(left / max(mad_std(left, 0.0), 1e-6))
        information = float(weight @ wheels**2)
        ratio = float(weight @ (wheels * heading)) / information
    left = heading - ratio * wheels
    pull = np.bincount(group - group.min(), weight * wheels * left)
    turn = math.sqrt(float(np.mean(heading**2)))
    return Turns(ratio, math.sqrt(float(pull @ pull)) / information, mad_std(left, 0.0), turn)


def find_filtering(fit: AlignmentFit) -> str:
    """Return how the wheels of a drive show that they are filtered or fused; empty where they do not."""
    track, delay = fit.track, fit.estimate("heading_delay")[0]
    long_s = min(LONGEST_S, float(track.t[-1]) / LONG_WINDOWS)
    if long_s < SHORTEST_LONG_S:
        return ""
    found = [compare_turns(track, fit.width_m, delay, one) for one in (NOISE_S, SHORT_S, MIDDLE_S, long_s)]
    noise, short, middle, long = found
    if noise is None or short is None or middle is None or long is None:
        return ""
    change, std = long.ratio - short.ratio, math.hypot(short.ratio_std, long.ratio_std)
    if abs(long.ratio - 1.0) < AS_THE_ROBOT and change > max(SIGMAS * std, SMALLEST_CHANGE * long.ratio):
        ratios = f"{short.ratio:.2f} ± {short.ratio_std:.2f} over {SHORT_S:g} s and {long.ratio:.2f} ± "
        return f"the robot turns by {ratios}{long.ratio_std:.2f} over {long_s:.0f} s of what they show"
    at_middle, at_end = (_beyond(one, noise) for one in (middle, long))
    least = max(LARGE_SHARE * short.turn_rad, LARGE_RAD)
    if fit.turn_slip > TURNS_SLIPPING and at_middle > least and at_end < BOUNDED * at_middle:
        angles = f"{math.degrees(at_middle):.0f}° over {MIDDLE_S:g} s and by no more than {math.degrees(at_end):.0f}°"
        return f"their turn differs from the robot's by {angles} over {long_s:.0f} s, which slip would add up"
    return ""


def _beyond(turns: Turns, noise: Turns) -> float:
    return math.sqrt(max(turns.left_rad**2 - noise.left_rad**2, 0.0))
