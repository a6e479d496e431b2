"""A change of ground during a drive: the turn of the robot per turn of its wheels differs between two stretches."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.alignment.estimator import AlignmentFit
from icrtool.alignment.sparse_reference import spans_of_measured
from icrtool.kernels.arrays import Floats, Ints

CHANGE_WINDOW_S, CHANGE_GROUP_S = 2.0, 10.0
"""Time over which turns are compared, and time within which windows count as one observation [s]."""

FEWEST_CHANGE_GROUPS, CHANGE_CANDIDATES = 4, 60
"""Smallest number of groups with a turn in a stretch, and number of times of the change that are compared."""

CHANGE_SIGMAS, CHANGE_SHARE = 5.0, 0.1
"""Stretches differ where by more than both: the best of many candidates differs by
more than 3 sigma by chance, and few groups show a deviation that is itself uncertain."""

LEAST_MULTIPLIER = 0.8
"""Smallest multiplier of a stretch. If the robot turns more than its wheels, the cause is not the ground but sides,
units or another robot's wheels."""

CHANGE_GAIN = 25.0
"""Twice the log-likelihood that a change gains, with an observation for two windows, which overlap: five sigma."""


class GroundChange(NamedTuple):
    """The most likely change.

    Attributes
    ----------
    t_s : since the first wheel sample [s]
    before, after : multiplier of the track width, and its standard deviation
    """

    t_s: float
    before: tuple[float, float]
    after: tuple[float, float]

    @property
    def text(self) -> str:
        """What was found, and what to do."""
        stretches = " and ".join(f"{value:.3f} ± {max(std, 0.001):.3f}" for value, std in (self.before, self.after))
        return (
            f"the ground changes at about {self.t_s:.0f} s: multiplier {stretches} before and after; one number "
            f"fits neither: --terrain-change {self.t_s:.0f} states it to the filter, --from and --to fit each stretch"
        )


def find_change(fit: AlignmentFit) -> GroundChange | None:
    """Return the change of ground of a drive; None where the drive shows no change.

    Notes
    -----
    Least squares of the heading's turn by the wheels' turn, before and after each of some times; deviations by groups
    of time (White 1980; Liang and Zeger 1986).
    """
    track, delay = fit.windows.track, fit.estimate("heading_delay")[0]
    turned = track.cumulate(2.0 * track.half_difference / fit.width_m)
    first, last = max(track.t[0] + delay, track.heading_t[0]), min(track.t[-1] + delay, track.heading_t[-1])
    begin = np.arange(first, last - CHANGE_WINDOW_S, CHANGE_WINDOW_S / 2)
    end = begin + CHANGE_WINDOW_S
    if track.measured_t is not None:
        begin, end = spans_of_measured(track.measured_t, CHANGE_WINDOW_S, 2)
        inside = (begin >= first) & (end <= last) & (end - begin < CHANGE_GROUP_S)
        begin, end = begin[inside], end[inside]
    if len(begin) < 4 * FEWEST_CHANGE_GROUPS:
        return None
    x = np.interp(end - delay, track.t, turned) - np.interp(begin - delay, track.t, turned)
    y = track.heading_at(end) - track.heading_at(begin)
    kept = track.clear(begin - delay, end - delay)
    begin, x, y = begin[kept], x[kept], y[kept]
    group = np.floor(begin / CHANGE_GROUP_S).astype(np.int64)
    weight = np.cumsum(x**2)
    if not len(x) or weight[-1] <= 0.0:
        return None
    places = np.unique(np.searchsorted(weight, np.linspace(0.1, 0.9, CHANGE_CANDIDATES) * weight[-1]))
    whole = float(np.sum((y - x * float(x @ y) / weight[-1]) ** 2))
    best, found = math.inf, None
    for place in places.tolist():
        parts = [_ratio(x[rows], y[rows], group[rows]) for rows in (slice(0, place), slice(place, None))]
        if None in parts:
            continue
        (first, first_std, left), (second, second_std, right) = (one for one in parts if one is not None)
        if left + right < best:
            best, found = left + right, (place, (first, first_std), (second, second_std))
    if found is None or len(x) / 2 * math.log(max(whole, 1e-12) / max(best, 1e-12)) < CHANGE_GAIN:
        return None
    place, before, after = found
    apart = abs(before[0] - after[0])
    if apart < max(CHANGE_SIGMAS * math.hypot(before[1], after[1]), CHANGE_SHARE * max(before[0], after[0])):
        return None
    if not 0.0 < min(before[0], after[0]) <= max(before[0], after[0]) < 1.0 / LEAST_MULTIPLIER:
        return None
    stated = [(1.0 / ratio, std / ratio**2) for ratio, std in (before, after)]
    return GroundChange(float(begin[place]), stated[0], stated[1])


def _ratio(x: Floats, y: Floats, group: Ints) -> tuple[float, float, float] | None:
    """Return turn per turn of the wheels, its deviation, and the sum of squares left; None with too few groups."""
    turns = np.unique(group[np.abs(x) > math.radians(5.0)])
    square = float(x @ x)
    if len(turns) < FEWEST_CHANGE_GROUPS or square <= 0.0:
        return None
    ratio = float(x @ y) / square
    left = y - ratio * x
    _, row = np.unique(group, return_inverse=True)
    sums = np.bincount(row, x * left)
    return ratio, math.sqrt(float(sums @ sums) * len(turns) / (len(turns) - 1)) / square, float(left @ left)
