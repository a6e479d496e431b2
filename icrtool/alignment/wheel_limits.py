"""Wheel data that contradict themselves: a clock of another rate than the headings', speeds with an upper limit."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.alignment.estimator import ESTIMATE_PRIOR_STD, POSITION_LAG, AlignmentFit, residuals_by_estimate
from icrtool.alignment.ground_change import CHANGE_SIGMAS, FEWEST_CHANGE_GROUPS
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.records.samples import WheelSamples

RATE_BLOCKS, FEWEST_RATE_BLOCKS, RATE_WINDOW_S = 10, 6, 2.0
"""Parts of the drive of which each shows a delay, smallest number of them with turns, and time over which turns are
compared [s]."""

FURTHEST_DELAY_S, RATE_DELAY_STEP_S = 3.0, 0.05
"""Largest difference of the delay of a part from the delay of the whole drive, and step between compared delays [s]."""


class ClockRate(NamedTuple):
    """Rate of the wheels' clock against the headings' clock, minus 1, and its standard deviation."""

    value: float
    std: float

    def sentence(self, duration_s: float) -> str:
        """Return the finding for the user, of a drive of some duration [s]."""
        rate = f"{100 * abs(self.value):.2f} ± {100 * self.std:.2f} % {'faster' if self.value > 0.0 else 'slower'}"
        apart = f"they part by {abs(self.value) * duration_s:.1f} s in this drive"
        return (
            f"the clock of the wheels goes {rate} than the clock of the headings: {apart}; "
            "topics.clock=log takes log times"
        )


def find_clock_rate(fit: AlignmentFit) -> ClockRate | None:
    """Return the rate of the wheels' clock if it is shown to differ from the headings' clock; else None.

    Notes
    -----
    In each part of the drive, the delay is the one with the smallest sum of squares of the heading's turn minus a share
    of the wheels' turn. The rate is the slope of a line through the delays. Its standard deviation follows from the
    scatter of the delays around the line, and is never smaller than the standard deviations of the delays imply.
    """
    track, middle_s = fit.windows.track, fit.estimate("heading_delay")[0]
    if track.measured_t is not None:
        return None
    turned = track.cumulate(2.0 * track.half_difference / fit.width_m)
    first = max(track.t[0] + middle_s, track.heading_t[0]) + FURTHEST_DELAY_S
    last = min(track.t[-1] + middle_s, track.heading_t[-1]) - FURTHEST_DELAY_S - RATE_WINDOW_S
    begin = np.arange(first, last, RATE_WINDOW_S / 2)
    if len(begin) < 4 * RATE_BLOCKS:
        return None
    delays = middle_s + np.arange(-FURTHEST_DELAY_S, FURTHEST_DELAY_S + RATE_DELAY_STEP_S / 2, RATE_DELAY_STEP_S)
    at, std = np.full(RATE_BLOCKS, np.nan), np.full(RATE_BLOCKS, np.nan)
    for block, of_block in enumerate(np.array_split(begin, RATE_BLOCKS)):
        y = track.heading_at(of_block + RATE_WINDOW_S) - track.heading_at(of_block)
        begins = of_block[None, :] - delays[:, None]
        x = np.interp(begins + RATE_WINDOW_S, track.t, turned) - np.interp(begins, track.t, turned)
        at[block], std[block] = _delay_of(x, y, delays)
    seen = np.isfinite(std)
    if np.count_nonzero(seen) < FEWEST_RATE_BLOCKS:
        return None
    times = np.array([part.mean() for part in np.array_split(begin, RATE_BLOCKS)])[seen]
    rate = _rate_of(times, at[seen], std[seen])
    # Delays of streams usually differ by that much.
    usual_s = float(ESTIMATE_PRIOR_STD[POSITION_LAG])
    return rate if rate is not None and abs(rate.value) * float(np.ptp(track.t)) > usual_s else None


def _delay_of(x: Floats, y: Floats, delays: Floats) -> tuple[float, float]:
    """Return the delay with the smallest sum of squares, and its standard deviation [s]; NaN where none is shown.

    Parameters
    ----------
    x : (d, n) turns of the wheels [rad], for each of the delays (d,) [s]
    y : (n,) turns of the heading [rad]
    """
    square = (x**2).sum(1)
    if not (square > 0.0).all():
        return math.nan, math.nan
    squares = y @ y - (x @ y) ** 2 / square
    best = int(np.argmin(squares))
    if not 0 < best < len(delays) - 1:
        return math.nan, math.nan
    curvature = squares[best - 1] - 2.0 * squares[best] + squares[best + 1]
    if not curvature > 0.0:
        return math.nan, math.nan
    offset = 0.5 * (squares[best - 1] - squares[best + 1]) / curvature
    # two windows overlap by half
    variance = 2.0 * squares[best] / max(len(y) - 2, 1) * 2.0 * RATE_DELAY_STEP_S**2 / curvature
    return float(delays[best] + offset * RATE_DELAY_STEP_S), math.sqrt(max(variance, 1e-12))


def _rate_of(times: Floats, delays: Floats, std: Floats) -> ClockRate | None:
    """Return the slope of a line through delays, if it is shown; the largest residual does not count."""
    for _ in range(2):
        weight = 1.0 / np.maximum(std, np.median(std)) ** 2
        centred = times - np.average(times, weights=weight)
        spread = float(weight @ centred**2)
        slope = float((weight * centred) @ delays) / spread
        residual = delays - np.average(delays, weights=weight) - slope * centred
        scatter = float(weight @ residual**2) / (len(times) - 2)
        rate = ClockRate(-slope, math.sqrt(max(scatter, 1.0) / spread))
        if abs(rate.value) > CHANGE_SIGMAS * rate.std:
            return rate
        kept = np.arange(len(times)) != int(np.argmax(weight * residual**2))
        times, delays, std = times[kept], delays[kept], std[kept]
    return None


class SpeedLimit(NamedTuple):
    """Largest speed that the wheels of a drive report while the robot goes faster.

    Attributes
    ----------
    speed_mps : the limit
    share : share of the samples of a moving robot in which a side has this speed
    sigmas : standard deviations by which the robot moves more at the limit than elsewhere, by one estimate for both
    """

    speed_mps: float
    share: float
    sigmas: float

    @property
    def text(self) -> str:
        """The finding for the user."""
        often = f"in {100 * self.share:.0f} % of the samples"
        return (
            f"the wheels report their largest speed {often} while the robot goes faster, by {self.sigmas:.0f} σ: "
            f"the ICRs are learned from speeds that were cut off"
        )


LEAST_LIMIT_SHARE, LEAST_LIMIT_RUN = 0.01, 5
"""Smallest share of the samples at a limit, and smallest number of equal samples in succession."""

LIMIT_CHANCE = 1e-6
"""Significance level of a limit. The longest run of the largest speed shows a limit if a run of this length is less
probable, given how often other speeds repeat."""

AT_LIMIT_SHARE = 0.2
"""Smallest share of the time of a window with which the window counts as at the limit. Where most windows have more,
the half with the larger shares counts."""


def find_limit(wheels: WheelSamples, fit: AlignmentFit) -> SpeedLimit | None:
    """Return the limit of the wheels' speeds; None if their data, or the robot's motion, show none."""
    limits = [limit for limit in map(_samples_at_limit, (wheels.v_left_mps, wheels.v_right_mps)) if limit is not None]
    if not limits:
        return None
    at_limit = np.logical_or.reduce(limits)
    moving = (wheels.v_left_mps != 0.0) | (wheels.v_right_mps != 0.0)
    track, windows = fit.windows.track, fit.windows
    seconds = (wheels.stamp_ns - wheels.stamp_ns[0]) / 1e9 + track.t[0]
    until = np.concatenate([[0.0], np.cumsum(at_limit[:-1] * np.diff(seconds))])

    def share(begin: Floats, end: Floats) -> Floats:
        within = np.interp(end, seconds, until) - np.interp(begin, seconds, until)
        return np.asarray(within / np.maximum(end - begin, 1e-9))

    residuals, laid = residuals_by_estimate(fit), windows.over(track.at_places(track.mean_speed))
    # Slip in turns makes a robot go less far than its wheels, not further.
    fix_share = share(track.place_t[windows.begin], track.place_t[windows.end])
    further = _difference(laid, laid - residuals.before[0], fix_share, windows.group)
    predicted = residuals.turn_after + residuals.turn_rad
    more = _difference(predicted, residuals.turn_rad, share(windows.turn_begin, windows.turn_end), windows.turn_group)
    sigmas = max(further, more)
    if sigmas < CHANGE_SIGMAS:
        return None
    top = max(float(np.abs(side).max()) for side in (wheels.v_left_mps, wheels.v_right_mps))
    return SpeedLimit(top, float(at_limit[moving].mean()), sigmas)


def _samples_at_limit(speed: Floats) -> Bools | None:
    """Return the samples (n,) with the largest speed of a side if this speed is a limit; else None.

    Measured speeds vary from sample to sample; at a limit they are equal.
    """
    size = np.abs(speed)
    top = float(size.max(initial=0.0))
    at_top = size == top
    count = np.count_nonzero(size)
    if not top > 0.0 or np.count_nonzero(at_top) < LEAST_LIMIT_SHARE * count:
        return None
    changes = np.flatnonzero(np.diff(at_top, prepend=False, append=False))
    longest = int((changes[1::2] - changes[::2]).max())
    elsewhere = ~at_top[1:] & ~at_top[:-1] & (size[1:] > 0.0)
    repeats = np.count_nonzero((np.diff(speed) == 0.0) & elsewhere)
    chance = (repeats + 1.0) / (np.count_nonzero(elsewhere) + 1.0)
    is_limit = longest >= LEAST_LIMIT_RUN and count * chance ** (longest - 1) < LIMIT_CHANCE
    return np.asarray(at_top) if is_limit else None


def _difference(predicted: Floats, seen: Floats, share: Floats, group: Ints) -> float:
    """Return by how many standard deviations the ratio of seen to predicted is larger at the limit than elsewhere.

    Parameters
    ----------
    predicted, seen : (n,) motion in windows
    share : (n,) of the time at the limit
    group : (n,) numbers of stretches that are independent of one another

    Returns
    -------
    float
        0 with too few stretches.
    """
    ratios, variance = list[float](), 0.0
    often = share >= max(AT_LIMIT_SHARE, float(np.median(share)))
    for part in (often, ~often):
        x, y = predicted[part], seen[part]
        groups, row = np.unique(group[part], return_inverse=True)
        square = float(x @ x)
        if len(groups) < FEWEST_CHANGE_GROUPS or square <= 0.0:
            return 0.0
        ratios.append(float(x @ y) / square)
        sums = np.bincount(row, x * (y - ratios[-1] * x))
        variance += float(sums @ sums) * len(groups) / (len(groups) - 1) / square**2
    return (ratios[0] - ratios[1]) / math.sqrt(max(variance, 1e-18))
