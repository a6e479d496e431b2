"""How late heading and fixes are against the wheels, each by itself: from turns, and from changes of speed.

Heading increments over half a second against what left went ahead of right, and way between fixes, seen along the
heading, against the way of the wheels: a delay shows as a part proportional to the change of turn rate and of speed.
Both tell only how late a stream is against the *wheels*: a robot that answers its wheels late, or slips as it speeds
up, looks the same (up to 0.1 s on rigid-body simulated robots). What is smaller than that is told, not applied.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from icrtool.alignment.gnss_steps import unbroken
from icrtool.alignment.heading_alignment import HeadingCheck
from icrtool.alignment.reference_delay import busiest_part, delayed
from icrtool.config import Config
from icrtool.records.tables import Bools, Complexes, Floats, HeadingSamples, RobotLog

HEADING_WINDOW_S = 0.5
WAY_WINDOW_S = 1.0
STEP_S = 0.02
"""Ways are differentiated over this much time."""

BLOCK = 16
"""Windows taken for one independent sample."""

FEWEST_WINDOWS = 60
HUBER_SIGMAS = 2.0
GAP_S, GAP_IN_INTERVALS, NEAR_GAP_S = 0.25, 5.0, 0.5
ROUNDS, REWEIGHTS, SETTLED_S = 8, 5, 1e-3
"""Rounds enough for the largest delay in the largest steps. A search that does not settle, to its doubt, found none."""

SMALLEST_CHANGE_MPS = 0.015
"""Changes of speed beyond what the other columns explain, root mean square: with less, as on a circle, slip decides."""

LEAST_EXPLAINED = 0.5
"""Share of the changes seen that the wheels explain; with less, as on a circle, a delay fits noise to noise."""

LARGEST_STEP_S, LARGEST_DELAY_S = 0.2, 1.0

SIGNIFICANT_SIGMAS = 5.0
SMALLEST_APPLIED_S = 0.08
"""A stream is taken to be late by what is this large and this certain. Receivers and AHRS are late, never early."""


LARGEST_STD_S = 0.03
"""A delay less certain than this is not taken out: with noisy wheels and few turns, noise is matched with noise."""


class Delay(NamedTuple):
    """A delay against the wheels and its standard deviation [s], NaN where the drive does not tell."""

    value_s: float
    std_s: float

    @property
    def is_clear(self) -> bool:
        """Whether it is worth taking out."""
        certain = self.std_s < LARGEST_STD_S
        return certain and self.value_s > max(SMALLEST_APPLIED_S, SIGNIFICANT_SIGMAS * self.std_s)


UNKNOWN = Delay(math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class StreamDelays:
    """What was found, and the log with what was clear, or configured, taken out.

    Attributes
    ----------
    heading, gnss : as measured
    applied_heading_s, applied_gnss_s : taken out
    """

    log: RobotLog
    heading: Delay
    gnss: Delay
    applied_heading_s: float
    applied_gnss_s: float
    warnings: tuple[str, ...]

    def heading_summary(self) -> dict[str, Any]:
        """Return the heading's numbers for run.json."""
        known = math.isfinite(self.heading.value_s)
        return {
            "delay_s": self.heading.value_s if known else None,
            "delay_std_s": self.heading.std_s if known else None,
            "applied_delay_s": self.applied_heading_s,
        }

    def gnss_summary(self) -> dict[str, Any]:
        """Return the fixes' numbers for run.json; what was applied stands with the filter, as reference_delay_s."""
        known = math.isfinite(self.gnss.value_s)
        return {
            "delay_s": self.gnss.value_s if known else None,
            "delay_std_s": self.gnss.std_s if known else None,
        }


def measure_delays(log: RobotLog, config: Config, check: HeadingCheck) -> StreamDelays:
    """Find how late heading and fixes are, and take out what is clear (preset ``field``).

    Where both come from the same messages they are late together: `reference_delay` looks for that.
    """
    given_heading, given_gnss = config.frames.heading_delay_s, config.frames.reference_delay_s
    topics = {stream.role: stream.topic for stream in log.streams}
    together = topics.get("gnss") == topics.get("heading", "")
    field = config.filter.preset == "field"
    part = busiest_part(log)
    heading, gnss = heading_delay(part), UNKNOWN if together else gnss_delay(part, check)
    free = field and not together
    late = heading.value_s if free and given_heading == "auto" and heading.is_clear else 0.0
    late_gnss = gnss.value_s if free and given_gnss == "auto" and gnss.is_clear else 0.0
    if field and given_heading != "auto":
        late = given_heading
    if field and given_gnss != "auto":
        late_gnss = given_gnss
    notes = [
        f"{log.name}: {what} {delay.value_s:.2f} ± {delay.std_s:.2f} s late against the wheels: "
        f"taken out; {key} sets it"
        for what, delay, applied, key in (
            ("the heading is", heading, given_heading == "auto" and late, "frames.heading_delay_s"),
            ("the fixes are", gnss, given_gnss == "auto" and late_gnss, "frames.reference_delay_s"),
        )
        if applied
    ]
    shifted = delayed(log, late_gnss) if late_gnss else log
    if late:
        shift = round(late * 1e9)
        moved: HeadingSamples = replace(shifted.heading, stamp_ns=shifted.heading.stamp_ns - shift)
        shifted = replace(shifted, heading=moved)
    return StreamDelays(shifted, heading, gnss, late, late_gnss, tuple(notes))


def heading_delay(log: RobotLog) -> Delay:
    """Return how late the heading is against the wheels, by its turns; of either sense, and with a drift."""
    wheels, heading = log.wheels, log.heading
    if min(len(wheels.stamp_ns), len(heading.stamp_ns)) < FEWEST_WINDOWS:
        return UNKNOWN
    t, stamped = _seconds(log)
    begin, end = max(t[0], stamped[0]) + LARGEST_DELAY_S, min(t[-1], stamped[-1]) - LARGEST_DELAY_S
    first, last = _windows(t, begin, end)
    kept = _without_gap(t, first, last) & _without_gap(stamped, first, last)
    first, last = first[kept], last[kept]
    if len(first) < FEWEST_WINDOWS:
        return UNKNOWN
    ahead, psi = _sum(wheels.v_left_mps - wheels.v_right_mps, t), np.unwrap(heading.heading_rad)
    turned = np.interp(last, stamped, psi) - np.interp(first, stamped, psi)
    ones = np.full(len(turned), HEADING_WINDOW_S)

    def explain(delay: float) -> tuple[Floats, Floats, Callable[[Floats], float]]:
        now, after, before = (
            np.interp(last - delay + s, t, ahead) - np.interp(first - delay + s, t, ahead)
            for s in (0.0, STEP_S, -STEP_S)
        )
        return np.column_stack([now, (before - after) / (2 * STEP_S), ones]), turned, lambda p: float(p[0])

    return _search(explain)


def gnss_delay(log: RobotLog, check: HeadingCheck) -> Delay:
    """Return how late the fixes are against the wheels, by the changes of speed along the heading.

    Both sides have their own scale, and the antenna an arm to the side; what happens across the heading is left aside,
    where a delay looks like an antenna further back.
    """
    wheels, gnss = log.wheels, log.gnss
    if min(len(wheels.stamp_ns), len(gnss.stamp_ns), len(log.heading.stamp_ns)) < FEWEST_WINDOWS:
        return UNKNOWN
    t, stamped = _seconds(log)
    fixed = (gnss.stamp_ns - wheels.stamp_ns[0]) / 1e9
    psi = np.unwrap(log.heading.heading_rad) * (-1.0 if check.applied_mirror else 1.0) - check.applied_offset_rad
    interval = float(np.median(np.diff(fixed)))
    if not interval > 0:
        return UNKNOWN
    span = max(1, round(WAY_WINDOW_S / interval))
    first = np.arange(0, len(fixed) - span, max(1, span // 4))
    inside = (fixed[first + span] - fixed[first] < 1.5 * max(WAY_WINDOW_S, interval)) & (
        (fixed[first] > t[0] + LARGEST_DELAY_S) & (fixed[first + span] < t[-1] - LARGEST_DELAY_S)
    )
    first = first[inside & _without_gap(t, fixed[first], fixed[first + span])]
    last = first + span
    if len(first) < FEWEST_WINDOWS:
        return UNKNOWN
    middle = np.interp(t[:-1] + np.diff(t) / 2, stamped, psi)
    nose = np.append(np.exp(1j * middle), 0.0)
    laid_left, laid_right = (_sum(speed * nose, t) for speed in (wheels.v_left_mps, wheels.v_right_mps))
    begin_psi, end_psi = (np.interp(fixed[rows], stamped, psi) for rows in (first, last))
    level = np.exp(-0.5j * (begin_psi + end_psi))
    place = gnss.north_m + 1j * gnss.east_m
    along = ((place[last] - place[first]) * level).real
    aside = (1j * (np.exp(1j * end_psi) - np.exp(1j * begin_psi)) * level).real

    def explain(delay: float) -> tuple[Floats, Floats, Callable[[Floats], float]]:
        def way(laid: Complexes, shift: float) -> Floats:
            ends = (np.interp(fixed[rows] - delay + shift, t, laid) for rows in (last, first))
            return np.asarray(((next(ends) - next(ends)) * level).real, np.float64)

        left, right = way(laid_left, 0.0), way(laid_right, 0.0)
        both = laid_left + laid_right
        change = (way(both, -STEP_S) - way(both, STEP_S)) / (4 * STEP_S)
        return np.column_stack([left, change, right, aside]), along, lambda p: float(p[0] + p[2])

    return _search(explain)


def _seconds(log: RobotLog) -> tuple[Floats, Floats]:
    origin = log.wheels.stamp_ns[0]
    return (log.wheels.stamp_ns - origin) / 1e9, (log.heading.stamp_ns - origin) / 1e9


def _windows(t: Floats, begin: float, end: float) -> tuple[Floats, Floats]:
    """Return begins and ends of `HEADING_WINDOW_S` (w,), side by side, in which or beside which there are samples t.

    Made from the samples, not from the time between first and last: a stray stamp may be decades away.
    """
    at = np.floor((t - begin) / HEADING_WINDOW_S).astype(np.int64)
    places = np.unique((at[:, None] + np.array([-1, 0, 1])).ravel())
    last = math.floor((end - begin) / HEADING_WINDOW_S) - 1
    places = places[(places >= 0) & (places < last)]
    return begin + HEADING_WINDOW_S * places, begin + HEADING_WINDOW_S * (places + 1)


def _without_gap(t: Floats, begin: Floats, end: Floats) -> Bools:
    """Return which windows (w,) keep clear of gaps between samples at t (n,), some delay to either side included."""
    interval = np.diff(t)
    gaps = np.flatnonzero(interval > max(GAP_S, GAP_IN_INTERVALS * float(np.median(interval))))
    # In order, none overlaps another: those that end after the window begins, and begin before it ends.
    ended = np.searchsorted(t[gaps + 1], begin - NEAR_GAP_S)
    begun = np.searchsorted(t[gaps], end + NEAR_GAP_S, side="right")
    return np.asarray(begun <= ended)


def _sum(speed: Floats | Complexes, t: Floats) -> Complexes:
    """Return the way since the first sample (n,) of speeds that hold until the next; none through a gap."""
    return np.concatenate([[0.0], np.cumsum(speed[:-1] * unbroken(np.diff(t)))])


def _unexplained(design: Floats) -> float:
    """Return the root mean square of column 1 without what the other columns explain of it."""
    others = np.delete(design, 1, axis=1)
    left = design[:, 1] - others @ np.linalg.lstsq(others, design[:, 1], rcond=None)[0]
    return float(np.sqrt((left**2).mean()))


def _search(explain: Callable[[float], tuple[Floats, Floats, Callable[[Floats], float]]]) -> Delay:
    """Solve for the delay: linear in its change, which is column 1 of what `explain` returns, robustly.

    Notes
    -----
    Huber's weights (Huber 1964); the covariance takes `BLOCK` windows for one sample (sandwich, White 1982).
    """
    delay, std, step = 0.0, math.nan, math.inf
    weight: Floats
    left: Floats
    seen: Floats
    for first in (True, *(False,) * (ROUNDS - 1)):
        design, seen, scale_of = explain(delay)
        weight = np.ones(len(seen))
        ridge = 1e-9 * np.diag((design**2).sum(axis=0) + 1e-12)
        solution: Floats = np.zeros(design.shape[1])
        left = seen
        inverse: Floats = ridge
        for _ in range(REWEIGHTS):
            weighted = design * weight[:, None]
            inverse = np.asarray(np.linalg.pinv(design.T @ weighted + ridge), np.float64)
            solution = np.asarray(inverse @ (weighted.T @ seen), np.float64)
            left = np.asarray(seen - design @ solution, np.float64)
            bound = HUBER_SIGMAS * max(1.4826 * float(np.median(np.abs(left))), 1e-9)
            weight = np.minimum(1.0, bound / np.maximum(np.abs(left), 1e-12))
        gradients = np.add.reduceat(design * (weight * left)[:, None], np.arange(0, len(seen), BLOCK), axis=0)
        variance = float((inverse @ (gradients.T @ gradients) @ inverse)[1, 1])
        scale = abs(scale_of(solution))
        if not scale > 1e-6 or (first and _unexplained(design) < SMALLEST_CHANGE_MPS):
            return UNKNOWN
        std = math.sqrt(max(variance, 0.0)) / scale
        step = float(np.clip(solution[1] / scale_of(solution), -LARGEST_STEP_S, LARGEST_STEP_S))
        delay += step
        if abs(delay) > LARGEST_DELAY_S:
            return UNKNOWN
        if abs(step) < SETTLED_S:
            break
    moved = seen - seen.mean()
    explains = float((weight * left**2).sum()) <= (1.0 - LEAST_EXPLAINED) * float((weight * moved**2).sum())
    if not explains or abs(step) > max(SETTLED_S, std):
        return UNKNOWN
    return Delay(delay, std)
