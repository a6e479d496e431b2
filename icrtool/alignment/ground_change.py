"""Changes of ground during a drive: the turn of the robot per turn of its wheels differs between stretches."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icrtool.alignment.estimator import AlignmentFit
from icrtool.alignment.sparse_reference import spans_of_measured
from icrtool.kernels.arrays import Floats, Ints
from icrtool.records.measurements import GroundStretch

CHANGE_WINDOW_S, CHANGE_GROUP_S = 2.0, 10.0
"""Time over which turns are compared, and time within which windows count as one observation [s]."""

FEWEST_CHANGE_GROUPS, CHANGE_CANDIDATES = 4, 60
"""Smallest number of groups with a turn in a stretch, and number of times of a change that are compared."""

MOST_CHANGES = 3
"""Largest number of changes of ground in a drive."""

CHANGE_SIGMAS, CHANGE_SHARE = 5.0, 0.1
"""Least difference of the ratios of two successive stretches: in standard deviations, and as a share of the larger
ratio; both must be exceeded. The best of many candidates differs by more than 3 sigma by chance, and a standard
deviation from few groups is itself uncertain."""

LEAST_MULTIPLIER = 0.8
"""Smallest multiplier of a stretch. If the robot turns more than its wheels, the cause is not the ground but sides,
units or another robot's wheels."""

CHANGE_GAIN = 25.0
"""Least gain of twice the log-likelihood by one more change: five sigma. Two windows count as one observation, because
they overlap."""


class GroundChanges(NamedTuple):
    """The most likely changes of ground of a drive.

    Attributes
    ----------
    stretches : two or more stretches of the drive in order of time, each on one ground
    """

    stretches: tuple[GroundStretch, ...]

    @property
    def times_s(self) -> tuple[float, ...]:
        """Times of the changes, since the first wheel sample [s]."""
        return tuple(stretch.begin_s for stretch in self.stretches[1:])

    @property
    def text(self) -> str:
        """The finding for the user: times and multipliers of the changes, and the options to set."""
        values = _joined(
            [f"{stretch.multiplier:.3f} ± {max(stretch.multiplier_std, 0.001):.3f}" for stretch in self.stretches]
        )
        times = _joined([f"{t:.0f} s" for t in self.times_s])
        options = " ".join(f"--terrain-change {t:.0f}" for t in self.times_s)
        where, fitted_stretches, states = ("before and after", "neither", "states it")
        if len(self.times_s) > 1:
            where, fitted_stretches, states = ("in the stretches", "none", "state them")
        return (
            f"the ground changes at about {times}: multiplier {values} {where}; one number "
            f"fits {fitted_stretches}: {options} {states} to the filter, --from and --to fit each stretch"
        )


def _joined(texts: list[str]) -> str:
    """Return texts with commas, and the last one after "and"."""
    return " and ".join([", ".join(texts[:-1]), texts[-1]] if len(texts) > 1 else texts)


class _Turns(NamedTuple):
    """Turns of wheels and heading in windows of time.

    Attributes
    ----------
    begin : (n,) begin of each window [s]
    x : (n,) turn of the wheels [rad]
    y : (n,) turn of the heading [rad]
    group : (n,) number of the span of `CHANGE_GROUP_S` in which the window begins
    """

    begin: Floats
    x: Floats
    y: Floats
    group: Ints

    def rows(self, first: int, stop: int) -> _Turns:
        """Return the windows from row `first` to the row before `stop`."""
        return _Turns._make(column[first:stop] for column in self)


def find_changes(fit: AlignmentFit) -> GroundChanges | None:
    """Return the changes of ground of a drive; None where the drive shows none.

    Notes
    -----
    Least squares of the heading's turn by the wheels' turn in each stretch, with the best times for each number of
    changes (dynamic programming: Bellman and Roth 1969); each change must gain `CHANGE_GAIN`. The standard deviations
    come from groups of time (White 1980; Liang and Zeger 1986). Each stretch must show its ratio, and differ from the
    next one.
    """
    turns = _turns(fit)
    if turns is None:
        return None
    weight = np.cumsum(turns.x**2)
    if not len(turns.x) or weight[-1] <= 0.0:
        return None
    candidates = np.unique(np.searchsorted(weight, np.linspace(0.0, 1.0, CHANGE_CANDIDATES + 2) * weight[-1]))
    candidates = np.unique(
        np.concatenate([[0], candidates[(candidates > 0) & (candidates < len(turns.x))], [len(turns.x)]])
    )
    ways, costs = _best_partitions(turns, candidates)
    likelihood = [len(turns.x) / 2 * math.log(max(cost, 1e-12)) for cost in costs]
    # The most likely number of changes comes first, then less likely ones, until all stretches show their ratio.
    ranked = sorted(range(len(ways)), key=lambda count: likelihood[count] + CHANGE_GAIN * count)
    for count in ranked:
        if count == 0:
            return None
        stretches = _stretches(turns, _refined(turns, ways[count], candidates))
        if stretches is not None:
            return GroundChanges(stretches)
    return None


def find_exchange(fit: AlignmentFit) -> float | None:
    """Return the time from which on the sides of the wheels are exchanged, or no longer exchanged [s]; None if never.

    Before and after this time the wheels turn with the robot and against it, each by `CHANGE_SIGMAS`.
    """
    turns = _turns(fit)
    if turns is None or not np.any(turns.x):
        return None
    candidates = np.unique(np.linspace(0, len(turns.x), CHANGE_CANDIDATES + 2).astype(np.int64))
    ways, _ = _best_partitions(turns, candidates)
    if len(ways) < 2:
        return None
    rows = _refined(turns, ways[1], candidates)
    before, after = (_ratio(turns.rows(first, stop)) for first, stop in pairwise(rows))
    if before is None or after is None or before[0] * after[0] >= 0.0:
        return None
    are_shown = all(abs(ratio) > CHANGE_SIGMAS * std for ratio, std in (before, after))
    return float(turns.begin[rows[1]]) if are_shown else None


def _turns(fit: AlignmentFit) -> _Turns | None:
    """Return turns of wheels and heading; None with too few windows."""
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
    usable = track.clear(begin - delay, end - delay)
    begin, x, y = begin[usable], x[usable], y[usable]
    return _Turns(begin, x, y, np.floor(begin / CHANGE_GROUP_S).astype(np.int64))


def _best_partitions(turns: _Turns, candidates: Ints) -> tuple[list[list[int]], list[float]]:
    """Return the rows that divide the windows, both ends included, and the sum of squares, by number of changes.

    Parameters
    ----------
    candidates : (p,) rows at which a stretch may begin or end, ascending
    """
    sums = [np.append(0.0, np.cumsum(products))[candidates] for products in (turns.x**2, turns.x * turns.y, turns.y**2)]
    groups = np.searchsorted(np.unique(turns.group), turns.group)
    enough = np.append(groups, groups[-1] + 1)[candidates]

    def remaining(first: Ints, stop: int) -> Floats:
        xx, xy, yy = (total[stop] - total[first] for total in sums)
        short = (enough[stop] - enough[first] < FEWEST_CHANGE_GROUPS) | (xx <= 0.0)
        return np.where(short, np.inf, np.maximum(yy - xy**2 / np.where(xx > 0.0, xx, 1.0), 0.0))

    count = len(candidates)
    best = np.array([np.inf, *(float(remaining(np.array([0]), stop)[0]) for stop in range(1, count))])
    best_before, ways, costs = list[Ints](), list[list[int]](), list[float]()
    for changes in range(MOST_CHANGES + 1):
        if changes:
            by_first = [best[:stop] + remaining(np.arange(stop), stop) for stop in range(1, count)]
            best_before.append(np.array([0, *(int(np.argmin(costs)) for costs in by_first)]))
            best = np.array([np.inf, *(float(costs.min()) for costs in by_first)])
        if not math.isfinite(best[-1]):
            break
        at, rows = count - 1, [count - 1]
        for best_first in reversed(best_before):
            at = int(best_first[at])
            rows.append(at)
        ways.append([0, *(int(candidates[row]) for row in reversed(rows))])
        costs.append(float(best[-1]))
    return ways, costs


def _refined(turns: _Turns, rows: list[int], candidates: Ints) -> list[int]:
    """Return rows that divide the windows, each moved to the smallest sum of squares between its neighbours."""
    xx, xy, yy = (np.append(0.0, np.cumsum(products)) for products in (turns.x**2, turns.x * turns.y, turns.y**2))

    def remaining(first: Ints | int, stop: Ints | int) -> Floats:
        square = np.maximum(xx[stop] - xx[first], 1e-12)
        return np.asarray(yy[stop] - yy[first] - (xy[stop] - xy[first]) ** 2 / square)

    refined = list(rows)
    for i in range(1, len(rows) - 1):
        at = int(np.searchsorted(candidates, rows[i]))
        tried = np.arange(max(int(candidates[at - 1]), refined[i - 1]) + 1, min(int(candidates[at + 1]), rows[i + 1]))
        refined[i] = int(tried[np.argmin(remaining(refined[i - 1], tried) + remaining(tried, rows[i + 1]))])
    return refined


def _stretches(turns: _Turns, rows: list[int]) -> tuple[GroundStretch, ...] | None:
    """Return the stretches between rows; None where a stretch shows no multiplier, or two neighbours show the same."""
    stretches, ratios = list[GroundStretch](), list[tuple[float, float]]()
    for first, stop in pairwise(rows):
        part = turns.rows(first, stop)
        shown = _ratio(part)
        if shown is None or not 0.0 < shown[0] < 1.0 / LEAST_MULTIPLIER:
            return None
        ratio, std = shown
        ratios.append(shown)
        end = turns.begin[stop] if stop < len(turns.begin) else turns.begin[-1] + CHANGE_WINDOW_S
        begin = 0.0 if not stretches else float(turns.begin[first])
        numbers = {"multiplier": 1.0 / ratio, "multiplier_std": std / ratio**2}
        stretches.append(GroundStretch(begin_s=begin, end_s=float(end), **numbers))
    for (before, before_std), (after, after_std) in pairwise(ratios):
        least = max(CHANGE_SIGMAS * math.hypot(before_std, after_std), CHANGE_SHARE * max(before, after))
        if abs(before - after) < least:
            return None
    return tuple(stretches)


def _ratio(turns: _Turns) -> tuple[float, float] | None:
    """Return the heading's turn per turn of the wheels, and its standard deviation; None with too few groups."""
    x, y = turns.x, turns.y
    turning = np.unique(turns.group[np.abs(x) > math.radians(5.0)])
    square = float(x @ x)
    if len(turning) < FEWEST_CHANGE_GROUPS or square <= 0.0:
        return None
    ratio = float(x @ y) / square
    _, row = np.unique(turns.group, return_inverse=True)
    sums = np.bincount(row, x * (y - ratio * x))
    return ratio, math.sqrt(float(sums @ sums) * len(turning) / (len(turning) - 1)) / square
