"""Slip events and jumps: wheels and reference disagree by more than the motion model and the sensors' noise explain.

Pentzer 2014, Sections 2 and 7: ICRs that grow without bound mean pure slip or a robot that is stuck. Here slip is found
from the aligned measurements, before any filter, by a test over windows of half a second and more.

A single step between two fixes is not significant, but a sum of steps is. The log likelihood ratio of "this share of
each side's motion is missing" to "none is missing" grows in an event and falls outside it (Page 1954). This gives begin
and end.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from icrtool.alignment.reference_motion import (
    FIRST_QUANTILE,
    LATER_QUANTILE,
    LEAST_DISTANCE2,
    LEAST_MODEL_ERROR,
    WINDOWS_S,
    ComparedWindows,
    Knots,
    Motion,
    compare_by_duration,
    compare_with_wheels,
    decide_jumps,
    fit_motion,
    lay_knots,
    model_error,
    without_jumps,
)
from icrtool.alignment.sensor_noise import MOVES_MPS
from icrtool.kernels.arrays import Bools, Floats
from icrtool.records.measurements import CAUTIOUS_RESPONSE_STD_S, ReferenceJump, SensorData, SlipEvent, SlipKind

LEAST_SHARE = 0.3
"""Smallest severity of a slip event: the share of the wheels' motion that the robot does not make, or makes
sideways."""

LEAST_OF_SIDE = 0.12
"""Smallest severity where the robot drives and only one side disagrees with its wheels. It is smaller than
`LEAST_SHARE`, because an error of the reference rarely looks like this. In a spin both sides slip."""

IMMOBILISED_SHARE = 0.2
"""Ratio of the robot's motion to the motion of its wheels below which the robot is immobilised."""

KEEPING_SHARE = 1 / 3
"""Ratio of the disagreements of the two sides below which one side follows its wheels."""

STEADY_SHARE = 0.8
"""Smallest ratio of the other side's total disagreement to the sum of its sizes step by step. A steady disagreement
with one sign has a ratio near 1."""

LONGEST_STAMP_ERROR_S = 1.0
"""Longest time for which a wrong stamp makes a reference lag [s]."""

MOST_FALSE = 0.25
"""Largest ratio of windows that slip cannot explain to windows that show slip equally clearly."""

RETURN_S, RETURNED_SHARE = 5.0, 0.5
"""Time [s], and share of the missing motion. A reference that recovers this share within this time was wrong."""

RETURN_SIGMAS = 5.0
"""Ratio of the missing motion to its noise from which on such a return is looked for."""

SHORTEST_EVENT_S = 0.5
"""Shortest duration of an event [s]."""

FEWEST_EVENT_STEPS = 2
"""Smallest number of steps from fix to fix in an event."""

MOST_EVIDENCE = 4.0
"""Largest evidence of one step for or against an event. A jump is therefore not an event."""

LOST_EVIDENCE = 8.0
"""Decrease of the summed evidence after which an event has ended."""

CLEAR_STEP = 2.0
"""Missing motion of a step, in standard deviations, from which on it shows where in the step an event begins."""

CHUNK_STEPS = 64
"""Number of steps that are evaluated together while an event grows."""


class Disagreements(NamedTuple):
    """Disagreements of reference and wheels, in order of time: slip of the robot, or errors of the reference."""

    events: tuple[SlipEvent, ...] = ()
    jumps: tuple[ReferenceJump, ...] = ()


def find_disagreements(sensors: SensorData, width_m: float) -> Disagreements:
    """Return the spans in which the robot did not follow its wheels, and the spans in which the reference jumps.

    Parameters
    ----------
    sensors : aligned sensors: sides, signs, scale, conventions and delays are corrected
    width_m : distance b between the track centre lines [m], or a value used in place of it

    Returns
    -------
    Disagreements
        Events and jumps in order of time; both are empty where the motion model cannot be fitted.

    Notes
    -----
    Windows last 0.5 to 2 s, longer where the fixes are noisy. In each window, displacement ahead, displacement aside
    and turn, reference minus model, are divided by their standard deviations. These contain the noise of fixes and
    heading, wheel values held by the recorder, the response time at changes of speed, and the model's own error. The
    model's error is a share of the distance and is estimated from the log. The squared Mahalanobis distance is
    chi-squared with 3 degrees of freedom.

    A reference with more noise than stated shows too much motion in half of the windows, and too little in the other
    half. Slip cannot make a side move further than its wheels. Windows in which a side does are counted; if there are
    many, the other windows are not used (target-decoy estimate of the false discovery rate, Benjamini and Hochberg
    1995, Elias and Gygi 2007).

    Steps from fix to fix that may be jumps (`icrtool.alignment.reference_motion`) are in no window.
    """
    # Exact data, or intervals of very different lengths, may not separate the parameters of the motion.
    with suppress(np.linalg.LinAlgError):
        knots = lay_knots(sensors)
        if knots is None:
            return Disagreements()
        knots, steps = without_jumps(knots, width_m)
        quiet = np.ones(len(knots.t), np.bool_)
        motion = fit_motion(knots, width_m, quiet)
        if motion is None:
            return Disagreements()
        compared = compare_by_duration(knots, motion)
        _, quiet = _find_events(knots, motion, compared, quiet, FIRST_QUANTILE)
        if not quiet.all():
            motion = fit_motion(knots, width_m, quiet)
            if motion is None:
                return Disagreements()
            compared = compare_by_duration(knots, motion)
        events, _ = _find_events(knots, motion, compared, quiet, LATER_QUANTILE)
        return Disagreements(tuple(events), decide_jumps(knots, motion, steps))
    return Disagreements()


def _find_events(
    knots: Knots, motion: Motion, compared: list[tuple[float, ComparedWindows]], quiet: Bools, quantile: float
) -> tuple[list[SlipEvent], Bools]:
    """Return the events, which do not overlap, and the knots (m,) outside of them.

    Parameters
    ----------
    compared : result of `compare_by_duration`
    quiet : (m,) knots from which the model's error is estimated
    quantile : quantile of the residuals from which the model's error is computed
    """
    windows, distance2, false_rate, error = _weigh(compared, quiet, quantile)
    row, outside = np.arange(len(knots.t)), np.ones(len(knots.t), np.bool_)
    if not len(windows.begin):
        return [], outside
    steps = compare_with_wheels(knots, motion, row[:-1], row[1:], CAUTIOUS_RESPONSE_STD_S)
    whole = knots.holes[1:] == knots.holes[:-1]
    free, events = whole.copy(), list[SlipEvent]()
    tests = max(1.0, float(knots.t[-1] - knots.t[0]) / WINDOWS_S[0])
    # The window with the largest distance comes first.
    for at in np.argsort(-distance2, kind="stable"):
        core = slice(int(windows.begin[at]), int(windows.end[at]))
        if false_rate[at] > MOST_FALSE or not free[core].all():
            continue
        extent = _find_extent(knots.t, steps, error, whole & free, core)
        if extent is None or not _is_slip(knots, steps, extent):
            continue
        free[extent.first : extent.last] = False
        outside[max(extent.first - 1, 0) : extent.last + 2] = False
        largest2 = float(distance2[at])
        # Probability of a larger value of chi-squared with 3 degrees of freedom.
        tail = math.erfc(math.sqrt(largest2 / 2)) + math.sqrt(2 * largest2 / math.pi) * math.exp(-largest2 / 2)
        events.append(
            SlipEvent(
                kind=extent.kind,
                begin_ns=knots.epoch_ns + round(extent.begin_s * 1e9),
                end_ns=knots.epoch_ns + round(extent.end_s * 1e9),
                north_m=float(knots.track.north[extent.first]),
                east_m=float(knots.track.east[extent.first]),
                distance_m=extent.distance_m,
                severity=extent.severity,
                confidence=(1.0 - float(false_rate[at])) * max(0.0, 1.0 - tests * tail),
            )
        )
    return sorted(events, key=lambda event: event.begin_ns), outside


def _weigh(
    compared: list[tuple[float, ComparedWindows]], quiet: Bools, quantile: float
) -> tuple[ComparedWindows, Floats, Floats, Floats]:
    """Return the windows (w,) of all durations that disagree with the model, with their significance.

    Returns
    -------
    the windows; their squared Mahalanobis distance (w,); the expected share of false windows (w,) among windows with at
    least this distance, inf where slip cannot be the cause; the model's error (3,) over the shortest of all windows
    """
    shown: list[tuple[ComparedWindows, Floats]] = []
    error = np.full(3, LEAST_MODEL_ERROR)
    for duration, windows in compared:
        error = model_error(windows, quiet, quantile)
        # While the robot parks, sensors without noise leave no variance to divide by.
        moving = windows.rows(windows.path_m > MOVES_MPS * duration)
        missed2 = moving.residual**2
        square = (missed2 / (moving.sensor + (error * moving.path_m[:, None]) ** 2)).sum(axis=1)
        drives = np.abs(moving.model_ahead) > np.abs(moving.model_turned)
        least = np.where(_is_one_sided(moving) & drives, LEAST_OF_SIDE, LEAST_SHARE)
        shows = (square > LEAST_DISTANCE2) & (np.sqrt(missed2.sum(axis=1)) > least * moving.path_m)
        shown.append((moving.rows(shows), square[shows]))
    windows = ComparedWindows._make(map(np.concatenate, zip(*(compared for compared, _ in shown), strict=True)))
    square, beyond = np.concatenate([square_of_part for _, square_of_part in shown]), _exceeds(windows)
    # A robot that stands still is rarer than slip, and so is its opposite: twice the motion of the wheels.
    doubled = np.hypot(windows.ahead - windows.model_ahead, windows.aside)
    doubled = np.maximum(doubled, np.abs(windows.turned - windows.model_turned))
    still, twice = (length < IMMOBILISED_SHARE * windows.path_m for length in (windows.made, doubled))
    still_rate = _false_rate(windows, square, still, twice)
    other_rate = _false_rate(windows, square, ~beyond & ~still, beyond)
    return windows, square, np.where(still, still_rate, np.where(beyond, np.inf, other_rate)), error


def _exceeds(windows: ComparedWindows) -> Bools:
    """Return a mask of the windows (w,) that slip cannot explain.

    In these windows one side, and also the distance or the turn, moves further than the wheels, or backwards. A single
    side is not enough: a side without grip makes the robot turn more than both sides would, and a robot in a rut drags
    the slower side along.
    """
    least = LEAST_SHARE * windows.path_m

    def beyond(model: Floats, residual: Floats) -> Bools:
        missed = -np.sign(model) * residual
        return np.asarray((missed < -least) | (missed > np.abs(model) + least))

    side_exceeds = beyond(windows.model_sides, windows.side_residual).any(axis=0)
    robot_exceeds = beyond(windows.model_ahead, windows.ahead) | beyond(windows.model_turned, windows.turned)
    return side_exceeds & robot_exceeds & ~_is_one_sided(windows)


def _is_one_sided(windows: ComparedWindows) -> Bools:
    """Return in which windows (w,) one side follows its wheels. The other side has no grip and may be dragged along."""
    sides = np.abs(windows.side_residual)
    return np.asarray(sides.min(axis=0) < KEEPING_SHARE * sides.max(axis=0))


def _false_rate(windows: ComparedWindows, distance2: Floats, targets: Bools, decoys: Bools) -> Floats:
    """Return for each window the ratio of decoys to targets among windows with at least its distance (w,).

    Windows that overlap count as one, with the largest of their distances.
    """
    beyond = []
    for rows in (decoys, targets):
        order = np.flatnonzero(rows)[np.argsort(windows.begin[rows], kind="stable")]
        apart = windows.begin[order][1:] >= np.maximum.accumulate(windows.end[order])[:-1]
        runs = np.flatnonzero(np.append(True, apart)[: len(order)])
        clearest = np.sort(np.maximum.reduceat(distance2[order], runs)) if len(order) else np.empty(0)
        beyond.append(len(clearest) - np.searchsorted(clearest, distance2))
    return np.asarray(beyond[0] / np.maximum(beyond[1], 1))


def _is_slip(knots: Knots, steps: ComparedWindows, extent: Extent) -> bool:
    """Return whether an event is severe enough, and not an error of the reference.

    An error of a position or of a heading rarely agrees with the wheels of one side while the other side lacks a steady
    part. Only a wrong stamp has this effect, while the robot turns about one side; it is short, or comes and goes. If
    only one side has no grip, the severity is the root mean square over both sides.
    """
    inside = steps.rows(slice(extent.first, extent.last))
    sides, noise2 = inside.side_residual, inside.sensor[:, 0] + inside.sensor[:, 2]
    total, each = np.abs(sides.sum(axis=1)), np.sqrt(np.maximum(sides**2 - noise2, 0.0)).sum(axis=1)
    keeping, missing = np.argsort(total)
    steady = total[missing] > STEADY_SHARE * each[missing] and total[keeping] < KEEPING_SHARE * total[missing]
    if steady and extent.end_s - extent.begin_s > LONGEST_STAMP_ERROR_S:
        return extent.severity >= LEAST_OF_SIDE * math.sqrt(0.5)
    return extent.severity >= LEAST_SHARE and not _returns(knots, steps, extent)


def _returns(knots: Knots, steps: ComparedWindows, extent: Extent) -> bool:
    """Return whether the reference recovers the motion that is missing in the event, shortly before or after it.

    A reference that is wrong for some time comes back. Distance and turn that are lost by slip do not.
    """
    middle = (knots.heading[1:] + knots.heading[:-1]) / 2
    low, high = np.searchsorted(knots.t, [extent.begin_s - RETURN_S, extent.end_s + RETURN_S])
    rows = np.arange(max(int(low), 0), min(int(high), len(steps.begin)))
    displacement = (steps.ahead[rows] + 1j * steps.aside[rows]) * np.exp(1j * middle[rows])
    step = np.column_stack([displacement.real, displacement.imag, steps.turned[rows]])
    missed = step[(rows >= extent.first) & (rows < extent.last)].sum(axis=0)
    square = float(missed @ missed)
    if square < RETURN_SIGMAS**2 * float(knots.variance[extent.first] + knots.variance[extent.last]):
        return False
    made_up = -(step @ missed) / square
    after, before = np.cumsum(made_up[rows >= extent.last]), np.cumsum(made_up[rows < extent.first][::-1])
    return float(max(after.max(initial=0.0), before.max(initial=0.0))) > RETURNED_SHARE


class Extent(NamedTuple):
    """Begin, end and size of an event.

    Attributes
    ----------
    first, last : rows of the knots before and after the event
    begin_s, end_s : begin and end of the event [s], within one step of these knots
    kind : immobilised; else slip, skid or spin, by the largest part of the missing motion
    severity : share of the motion of both sides that is missed, or made sideways if that is more; at most 1
    distance_m : length of the robot's path through the event [m]
    """

    first: int
    last: int
    begin_s: float
    end_s: float
    kind: SlipKind
    severity: float
    distance_m: float


def _find_extent(t: Floats, steps: ComparedWindows, error: Floats, usable: Bools, core: slice) -> Extent | None:
    """Return the event around a window that shows one; None where other events have taken all its steps.

    The event begins as the part of the window with the largest sum of evidence. It is extended in both directions as
    long as the evidence grows.

    Parameters
    ----------
    t : (m,) times of the knots [s]
    steps : (m - 1,) windows between neighbouring knots
    error : (3,) error of the motion model, a share of the wheels' motion
    usable : (m - 1,) steps outside of holes and of other events
    core : rows of the steps of the window
    """
    span = core
    shares = _missed_shares(steps.rows(core))
    for _ in range(2):
        evidence = np.where(usable[core], _evidence(steps.rows(core), error, shares), -MOST_EVIDENCE)
        sums = np.concatenate([[0.0], np.cumsum(evidence)])
        grown = sums[1:] - np.minimum.accumulate(sums[:-1])
        last = int(np.argmax(grown)) + 1
        if grown[last - 1] <= 0.0:
            return None
        # The shortest of all parts with this sum is taken.
        first = core.start + last - 1 - int(np.argmin(sums[:last][::-1]))
        last += core.start
        last += _growth(steps, error, shares, usable, range(last, len(usable)))
        first -= _growth(steps, error, shares, usable, range(first - 1, -1, -1))
        span = slice(first, last)
        shares = _missed_shares(steps.rows(span))

    def time_in(row: int, default: float) -> float:
        """Return the part of a step that lies in the event [s]; a default where the fixes are too noisy to show it."""
        if not 0 <= row < len(usable) or not usable[row]:
            return 0.0
        step = steps.rows(slice(row, row + 1))
        deviation = np.sqrt(np.maximum(step.sensor + (error * step.path_m) ** 2, NO_VARIANCE))[0]
        expected, seen = _expected(step, shares)[0] / deviation, step.residual[0] / deviation
        size2 = float(expected @ expected)
        part = float(np.clip(expected @ seen / size2, 0.0, 1.0)) if size2 > CLEAR_STEP**2 else default
        return part * float(t[row + 1] - t[row])

    begin_s = float(t[span.start + 1]) - time_in(span.start, 1.0) - time_in(span.start - 1, 0.0)
    end_s = float(t[span.stop - 1]) + time_in(span.stop - 1, 1.0) + time_in(span.stop, 0.0)
    if end_s - begin_s < SHORTEST_EVENT_S or span.stop - span.start < FEWEST_EVENT_STEPS:
        return None
    # Where the wheels stand, no motion can be missing; rounding must not count as evidence.
    if not steps.path_m[span].any():
        return None
    return _measure_extent(steps.rows(span), span, shares, begin_s, end_s)


NO_VARIANCE = float(np.finfo(np.float64).tiny)
"""Smallest variance to divide by [m^2]. While the robot parks, sensors without noise have variance 0."""


def _missed_shares(steps: ComparedWindows) -> Floats:
    """Return the shares of their motion that the left and the right side miss, and the share that is sideways (3,).

    The shares come from sums, not from least squares over steps: in sums only the noise of the first and of the last
    fix remains.
    """
    moved = np.concatenate([steps.model_sides, [steps.path_m]])
    missed = -np.concatenate([steps.side_residual, [steps.aside]])
    size, noise = np.abs(moved).sum(axis=1), steps.sensor.sum(axis=1).mean()
    shares: Floats = (np.sign(moved) * missed).sum(axis=1) * size / np.maximum(size**2 + noise, NO_VARIANCE)
    return shares


def _measure_extent(steps: ComparedWindows, span: slice, shares: Floats, begin_s: float, end_s: float) -> Extent:
    """Return the event in a span of steps whose sides miss some shares of their motion: its kind and severity."""
    sides, path = steps.model_sides, float(steps.path_m.sum())
    missed = shares[:2, None] * sides
    aside = abs(float(shares[2])) * path
    kinds: dict[SlipKind, float] = {
        "slip": float(np.abs(missed.sum(axis=0)).sum()) / 2,
        "spin": float(np.abs(missed[0] - missed[1]).sum()) / 2,
        "skid": aside,
    }
    made = float(np.abs(sides - missed).sum()) / 2
    stuck = max(made, aside) / path < IMMOBILISED_SHARE
    return Extent(
        span.start,
        span.stop,
        begin_s,
        end_s,
        kind="immobilised" if stuck else max(kinds, key=lambda kind: kinds[kind]),
        severity=min(1.0, max(float(np.abs(missed).sum()) / 2, aside) / path),
        distance_m=math.hypot(float(np.abs((sides - missed).sum(axis=0)).sum()) / 2, aside),
    )


def _expected(steps: ComparedWindows, shares: Floats) -> Floats:
    """Return the residual of steps that miss these shares (k, 3) [m]."""
    left, right = shares[:2, None] * steps.model_sides
    return -np.column_stack([(left + right) / 2, shares[2] * steps.path_m, (left - right) / 2])


def _evidence(steps: ComparedWindows, error: Floats, shares: Floats) -> Floats:
    """Return the log likelihood ratio of steps (k,): missing these shares over missing none; bounded."""
    seen = steps.residual
    variance = np.maximum(steps.sensor + (error * steps.path_m[:, None]) ** 2, NO_VARIANCE)
    ratio = ((seen**2 - (seen - _expected(steps, shares)) ** 2) / (2 * variance)).sum(axis=1)
    return np.asarray(np.clip(ratio, -MOST_EVIDENCE, MOST_EVIDENCE))


def _growth(steps: ComparedWindows, error: Floats, shares: Floats, usable: Bools, rows: range) -> int:
    """Return the number of rows that belong to the event: up to the largest sum of evidence before it decreases."""
    total, best, count, done = 0.0, 0.0, 0, 0
    while done < len(rows):
        chunk = rows[done : done + CHUNK_STEPS]
        low, high = min(chunk), max(chunk) + 1
        values = _evidence(steps.rows(slice(low, high)), error, shares)[:: rows.step]
        for value, fine in zip(values, usable[low:high][:: rows.step], strict=True):
            total, done = total + float(value), done + 1
            if not fine or total < best - LOST_EVIDENCE:
                return count
            if total > best:
                best, count = total, done
    return count
