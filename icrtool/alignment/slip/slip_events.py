"""Where wheels and reference disagree beyond what motion model and noise of the sensors allow: slip events, and jumps.

Pentzer 2014, Sections 2 and 7: ICRs that grow without bound mean pure slip or a robot that is stuck. Here it is found
from the aligned measurements, before any filter, by a test over windows of half a second and more.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.alignment.sensors.sensor_noise import MOVES_MPS
from icrtool.alignment.slip.reference_jumps import decide_jumps, without_jumps
from icrtool.alignment.slip.slip_extent import Extent, find_extent
from icrtool.alignment.slip.slip_windows import ComparedWindows, Knots, Motion, compare, fit_motion, lay_knots, spans_of
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.records.measurements import RESPONSE_S, ReferenceJump, SensorData, SlipEvent

WINDOWS_S = (0.5, 1.0, 2.0)
LONGEST_WINDOW_S = 16.0
"""Windows are doubled to this where the fixes are too noisy for shorter ones."""

LEAST_DISTANCE2 = 36.0
"""Squared Mahalanobis distance of a window in which an event is seen."""

LEAST_SHARE = 0.3
"""... and the least share of the wheels' motion that the robot does not make, or makes sideways."""

LEAST_OF_SIDE = 0.12
"""... where the robot drives and one side keeps to its wheels. In a spin a side slips by its own share."""

STUCK_SHARE = 0.2
"""Robot that moves and turns less than this share of what its wheels do: immobilised."""

FEWEST_INTERVALS = 2
"""An event is seen in at least so many intervals between fixes: one alone may be a jump."""

LEAST_MODEL_ERROR = 0.03
FIRST_QUANTILE, LATER_QUANTILE = 0.7, 0.95
"""The model's error is what this share of the windows stays within: the first time events are still among them."""

NORMAL_QUANTILE = {FIRST_QUANTILE: 1.0364, LATER_QUANTILE: 1.9600}
"""Of the absolute value of a standard normal."""

KEEPING_SHARE = 1 / 3
"""A side that disagrees by less than this part of what the other does keeps to its wheels."""

STEADY_SHARE = 0.8
"""... and what the other lacks has the same sign, but for this."""

LONGEST_STAMP_ERROR_S = 1.0
"""For longer no reference lags by a wrong stamp."""

MOST_FALSE = 0.25
"""Most windows that show what slip cannot do, for each that shows slip as clearly."""

RETURN_S, RETURNED_SHARE, RETURN_SIGMAS = 5.0, 0.5, 5.0
"""A reference that comes back by this share within this time was wrong; what is missed must stand out of its noise."""

MOVING_SHARE = 0.2
"""Windows in which the wheels do less than this part of the usual show nothing of the model's error."""


class _Evidence(NamedTuple):
    """Windows of all durations that disagree with the model.

    Attributes
    ----------
    begin, end : (w,) rows of the knots
    distance2 : (w,) squared Mahalanobis distance
    false_rate : (w,) expected share of errors among windows as clear as this one; inf where slip cannot be the cause
    """

    begin: Ints
    end: Ints
    distance2: Floats
    false_rate: Floats


class Disagreements(NamedTuple):
    """Where the reference does not do what the wheels do: by the robot, or by an error of its own; in order of time."""

    events: tuple[SlipEvent, ...] = ()
    jumps: tuple[ReferenceJump, ...] = ()


def find_disagreements(sensors: SensorData, width_m: float) -> Disagreements:
    """Find the spans in which the robot did not do what its wheels did, and those in which the reference jumps.

    Parameters
    ----------
    sensors : aligned: sides, signs, scale, conventions and delays corrected
    width_m : distance b between the track centre lines, or what stands for it

    Returns
    -------
    Disagreements
        None where the motion model cannot be fitted.

    Notes
    -----
    Windows of 0.5 to 2 s (longer where the fixes are noisy): displacement ahead and aside and turn, reference minus
    model, over their standard deviations: noise of fixes and heading, wheel values held by the recorder, response time
    at changes of speed, and the model's own error, a share of the distance, which is estimated from the log. The
    squared Mahalanobis distance is chi-squared with 3 degrees of freedom.

    A reference that is worse than it states makes the robot do too much as often as too little. Windows in which a side
    does more than its wheels, which no slip can cause, are counted: where there are many, the others are not used
    (target-decoy estimate of the false discovery rate, Benjamini and Hochberg 1995, Elias and Gygi 2007).

    Steps from fix to fix that may be jumps (`icrtool.alignment.slip.reference_jumps`) are in no window.
    """
    try:
        return _found(sensors, width_m)
    except np.linalg.LinAlgError:
        # Exact data, or intervals of very different lengths: nothing separates the parameters of the motion.
        return Disagreements()


def _found(sensors: SensorData, width_m: float) -> Disagreements:
    knots = lay_knots(sensors)
    if knots is None:
        return Disagreements()
    knots, steps = without_jumps(knots, width_m)
    quiet = fitted = np.ones(len(knots.t), np.bool_)
    model = fit_motion(knots, width_m, quiet)
    found = Disagreements()
    for quantile in (FIRST_QUANTILE, LATER_QUANTILE):
        if not np.array_equal(quiet, fitted):
            model, fitted = fit_motion(knots, width_m, quiet), quiet
        if model is None:
            return Disagreements()
        evidence, error = _weigh(knots, model, quiet, quantile)
        quiet = np.ones(len(knots.t), np.bool_)
        events: list[SlipEvent] = []
        for extent, row in _separate(knots, model, evidence, error):
            quiet[max(extent.first - 1, 0) : extent.last + 2] = False
            events.append(_event(knots, extent, float(evidence.distance2[row]), float(evidence.false_rate[row])))
        events.sort(key=lambda event: event.begin_ns)
        found = Disagreements(tuple(events), decide_jumps(knots, model, steps))
    return found


def _weigh(knots: Knots, motion: Motion, quiet: Bools, quantile: float) -> tuple[_Evidence, Floats]:
    """Return the windows that disagree with the model, and the model's error (3,) over the shortest of them.

    Parameters
    ----------
    quiet : (m,) knots that the model's error is taken from
    """
    shown: list[tuple[ComparedWindows, Floats]] = []
    error = np.full(3, LEAST_MODEL_ERROR)
    for duration in reversed(_durations(knots)):
        first, last = spans_of(knots, duration)
        long = last - first >= FEWEST_INTERVALS
        windows = compare(knots, motion, first[long], last[long], RESPONSE_S)
        error = _model_error(windows, quiet, quantile)
        # while the robot parks, sensors without noise leave no variance to divide by
        windows = windows.rows(windows.path_m > MOVES_MPS * duration)
        square = (windows.residual**2 / (windows.sensor + (error * windows.path_m[:, None]) ** 2)).sum(axis=1)
        missed = np.hypot(np.hypot(windows.ahead, windows.turned), windows.aside)
        drives = np.abs(windows.model_ahead) > np.abs(windows.model_turned)
        least = np.where(_of_one_side(windows) & drives, LEAST_OF_SIDE, LEAST_SHARE)
        shows = (square > LEAST_DISTANCE2) & (missed > least * windows.path_m)
        shown.append((windows.rows(shows), square[shows]))
    windows = ComparedWindows._make(map(np.concatenate, zip(*(one for one, _ in shown), strict=True)))
    square, beyond = np.concatenate([one for _, one in shown]), _exceeds(windows)
    # what stands still is rarer than any slip, and so is its opposite: twice the motion of the wheels
    doubled = np.hypot(windows.ahead - windows.model_ahead, windows.aside)
    doubled = np.maximum(doubled, np.abs(windows.turned - windows.model_turned))
    still, twice = (far < STUCK_SHARE * windows.path_m for far in (windows.made, doubled))
    of_stuck = _false_rate(windows, square, still, twice)
    of_others = _false_rate(windows, square, ~beyond & ~still, beyond)
    return _Evidence(
        windows.begin, windows.end, square, np.where(still, of_stuck, np.where(beyond, np.inf, of_others))
    ), error


def _durations(knots: Knots) -> list[float]:
    """Return the durations of the windows: doubled until the usual distance stands out of the noise of the fixes."""
    path, dt = np.diff(knots.track.distance), np.diff(knots.t)
    moving = path > MOVES_MPS * dt
    if not moving.any():
        return list(WINDOWS_S)
    speed = float(np.median(path[moving] / dt[moving]))
    needed = math.sqrt(2 * LEAST_DISTANCE2 * float(np.median(knots.variance)))
    durations = list(WINDOWS_S)
    while speed * durations[-1] < needed and durations[-1] < LONGEST_WINDOW_S:
        durations.append(2 * durations[-1])
    return durations


def _model_error(windows: ComparedWindows, quiet: Bools, quantile: float) -> Floats:
    """Return the standard deviation of the model's error (3,), a share of the wheels' motion.

    Sensor noise s and model error k p leave a share q of the residuals r within n standard deviations where k is the
    q-quantile of sqrt(r^2 / n^2 - s^2) / p.
    """
    disturbed = np.concatenate([[0], np.cumsum(~quiet)])
    used = disturbed[windows.end + 1] == disturbed[windows.begin]
    used &= windows.path_m > MOVING_SHARE * (float(np.quantile(windows.path_m, 0.9)) if len(used) else 0.0)
    if not used.any():
        return np.full(3, LEAST_MODEL_ERROR)
    excess = (windows.residual[used] / NORMAL_QUANTILE[quantile]) ** 2 - windows.sensor[used]
    square = np.quantile(excess / windows.path_m[used, None] ** 2, quantile, axis=0)
    return np.asarray(np.sqrt(np.maximum(square, LEAST_MODEL_ERROR**2)))


def _exceeds(windows: ComparedWindows) -> Bools:
    """Return which windows show more motion than the wheels', of a side and of distance or turn, or the opposite.

    A side without grip turns the robot more than both sides would; a robot in a rut drags the slower side along.
    """
    least = LEAST_SHARE * windows.path_m

    def beyond(model: Floats, residual: Floats) -> Bools:
        missed = -np.sign(model) * residual
        return np.asarray((missed < -least) | (missed > np.abs(model) + least))

    of_side = beyond(windows.model_sides, windows.of_sides).any(axis=0)
    of_all = beyond(windows.model_ahead, windows.ahead) | beyond(windows.model_turned, windows.turned)
    return of_side & of_all & ~_of_one_side(windows)


def _of_one_side(windows: ComparedWindows) -> Bools:
    """Return in which windows one side keeps to its wheels: the other has no grip, and may be dragged along."""
    sides = np.abs(windows.of_sides)
    return np.asarray(sides.min(axis=0) < KEEPING_SHARE * sides.max(axis=0))


def _false_rate(windows: ComparedWindows, distance2: Floats, targets: Bools, decoys: Bools) -> Floats:
    """Return, for each window, the decoys over the targets among those as clear as it or clearer (w,).

    Windows that overlap are one run, as clear as the clearest of them.
    """
    beyond = []
    for kind in (decoys, targets):
        order = np.flatnonzero(kind)[np.argsort(windows.begin[kind], kind="stable")]
        apart = windows.begin[order][1:] >= np.maximum.accumulate(windows.end[order])[:-1]
        runs = np.flatnonzero(np.append(True, apart)[: len(order)])
        clearest = np.sort(np.maximum.reduceat(distance2[order], runs)) if len(order) else np.empty(0)
        beyond.append(len(clearest) - np.searchsorted(clearest, distance2))
    return np.asarray(beyond[0] / np.maximum(beyond[1], 1))


def _separate(knots: Knots, motion: Motion, evidence: _Evidence, error: Floats) -> list[tuple[Extent, int]]:
    """Return events and the window that shows each, the clearest first; events do not overlap."""
    row = np.arange(len(knots.t))
    steps = compare(knots, motion, row[:-1], row[1:], RESPONSE_S)
    free = knots.holes[1:] == knots.holes[:-1]
    whole, found = free.copy(), []
    for at in np.argsort(-evidence.distance2, kind="stable"):
        core = slice(int(evidence.begin[at]), int(evidence.end[at]))
        if evidence.false_rate[at] > MOST_FALSE or not free[core].all():
            continue
        extent = find_extent(knots.t, steps, error, whole & free, core)
        if extent is not None and _shows_slip(knots, steps, extent):
            free[extent.first : extent.last] = False
            found.append((extent, int(at)))
    return found


def _shows_slip(knots: Knots, steps: ComparedWindows, extent: Extent) -> bool:
    """Return whether an event is severe enough, and no error of the reference.

    Of a side without grip the severity counts as the root mean square over both sides.
    """
    if _keeps_one_side(steps, extent):
        return extent.severity >= LEAST_OF_SIDE * math.sqrt(0.5)
    return extent.severity >= LEAST_SHARE and not _returns(knots, steps, extent)


def _keeps_one_side(steps: ComparedWindows, extent: Extent) -> bool:
    """Return whether one side does what its wheels do, and the other lacks a steady part of it.

    No error of a position or of a heading does that, except that of a stamp while the robot turns about a side: it is
    short, or comes and goes.
    """
    steps = steps.rows(slice(extent.first, extent.last))
    sides, noise2 = steps.of_sides, steps.sensor[:, 0] + steps.sensor[:, 2]
    total, each = np.abs(sides.sum(axis=1)), np.sqrt(np.maximum(sides**2 - noise2, 0.0)).sum(axis=1)
    keeping, missing = np.argsort(total)
    steady = total[missing] > STEADY_SHARE * each[missing] and total[keeping] < KEEPING_SHARE * total[missing]
    return bool(steady) and extent.end_s - extent.begin_s > LONGEST_STAMP_ERROR_S


def _returns(knots: Knots, steps: ComparedWindows, extent: Extent) -> bool:
    """Return whether the reference makes up, shortly before or after, for the motion that is missing in the event.

    A reference that is wrong for a while comes back; distance and turn lost by slip do not.
    """
    middle = (knots.heading[1:] + knots.heading[:-1]) / 2
    low, high = np.searchsorted(knots.t, [extent.begin_s - RETURN_S, extent.end_s + RETURN_S])
    rows = np.arange(max(int(low), 0), min(int(high), len(steps.begin)))
    place = (steps.ahead[rows] + 1j * steps.aside[rows]) * np.exp(1j * middle[rows])
    step = np.column_stack([place.real, place.imag, steps.turned[rows]])
    missed = step[(rows >= extent.first) & (rows < extent.last)].sum(axis=0)
    square = float(missed @ missed)
    if square < RETURN_SIGMAS**2 * float(knots.variance[extent.first] + knots.variance[extent.last]):
        return False
    made_up = -(step @ missed) / square
    after, before = np.cumsum(made_up[rows >= extent.last]), np.cumsum(made_up[rows < extent.first][::-1])
    return float(max(after.max(initial=0.0), before.max(initial=0.0))) > RETURNED_SHARE


def _event(knots: Knots, extent: Extent, distance2: float, false_rate: float) -> SlipEvent:
    tests = max(1.0, float(knots.t[-1] - knots.t[0]) / WINDOWS_S[0])
    place = complex(knots.place[extent.first])
    stuck = extent.made_share < STUCK_SHARE
    return SlipEvent(
        kind="immobilised" if stuck else extent.kind,
        begin_ns=knots.epoch_ns + round(extent.begin_s * 1e9),
        end_ns=knots.epoch_ns + round(extent.end_s * 1e9),
        north_m=place.real,
        east_m=place.imag,
        distance_m=extent.distance_m,
        severity=extent.severity,
        confidence=(1.0 - false_rate) * max(0.0, 1.0 - tests * _tail(distance2)),
    )


def _tail(distance2: float) -> float:
    """Return the probability that chi-squared with 3 degrees of freedom exceeds a value."""
    return math.erfc(math.sqrt(distance2 / 2)) + math.sqrt(2 * distance2 / math.pi) * math.exp(-distance2 / 2)
