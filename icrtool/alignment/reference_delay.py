"""How far the clock of the position reference is from the wheels': found where the filter contradicts itself least."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from icrtool.records.tables import HeadingSamples, PositionFixes, RobotLog, WheelSamples

LONGEST_DELAY_S = 0.4
DELAY_STEP_S = 0.05
WORTHWHILE_SHARE = 0.88
"""A delay is believed when it brings the contradiction below this part of what it is without one."""

MOST_SAMPLES = 60_000
"""Wheel samples the search looks at: ten minutes at 100 Hz."""


def delayed(log: RobotLog, delay_s: float) -> RobotLog:
    """Return the log with the position reference taken `delay_s` earlier.

    The heading goes with it where both come from the same messages.
    """
    if delay_s == 0.0:
        return log
    shift = round(delay_s * 1e9)
    gnss: PositionFixes = replace(log.gnss, stamp_ns=log.gnss.stamp_ns - shift)
    topics = {stream.role: stream.topic for stream in log.streams}
    heading: HeadingSamples = log.heading
    if topics.get("gnss") == topics.get("heading", ""):
        heading = replace(heading, stamp_ns=heading.stamp_ns - shift)
    return replace(log, gnss=gnss, heading=heading)


def find_delay(contradiction: Callable[[float], float]) -> float:
    """Return the delay of the position reference against the wheels [s], positive when it lags; 0 without a find.

    Parameters
    ----------
    contradiction : by delay [s] taken from the reference, how badly a run then contradicts itself (mean NIS, each
        counted up to its gate)

    Notes
    -----
    On recorded robots the clocks of the streams matter as much as the model. A grid search, then the vertex of the
    parabola through the best three.
    """
    steps = round(LONGEST_DELAY_S / DELAY_STEP_S)
    delays = DELAY_STEP_S * np.arange(-steps, steps + 1)
    found = np.array([contradiction(float(delay)) for delay in delays])
    best = int(np.argmin(found))
    if best in (0, len(delays) - 1) or found[best] > WORTHWHILE_SHARE * found[steps]:
        return 0.0
    left, middle, right = found[best - 1 : best + 2]
    bend = left - 2 * middle + right
    vertex = 0.5 * (left - right) / bend if bend > 0 else 0.0
    return round(float(delays[best] + DELAY_STEP_S * vertex), 3)


def busiest_rows(wheels: WheelSamples) -> slice | None:
    """Return the `MOST_SAMPLES` rows in which the wheels travel most, None where there are no more than those."""
    if len(wheels.stamp_ns) <= MOST_SAMPLES:
        return None
    travel = np.concatenate([[0.0], np.cumsum(np.abs(wheels.v_left_mps) + np.abs(wheels.v_right_mps))])
    first = int(np.argmax(travel[MOST_SAMPLES:] - travel[:-MOST_SAMPLES]))
    return slice(first, first + MOST_SAMPLES)


def busiest_part(log: RobotLog) -> RobotLog:
    """Return the stretch of the log, at most `MOST_SAMPLES` long, in which the wheels travel most."""
    wheels = log.wheels
    rows = busiest_rows(wheels)
    if rows is None:
        return log
    begin, end = wheels.stamp_ns[rows][[0, -1]]
    fixes = slice(*np.searchsorted(log.gnss.stamp_ns, [begin, end]))
    samples = slice(*np.searchsorted(log.heading.stamp_ns, [begin, end]))
    return replace(
        log,
        wheels=replace(
            wheels,
            stamp_ns=wheels.stamp_ns[rows],
            v_left_mps=wheels.v_left_mps[rows],
            v_right_mps=wheels.v_right_mps[rows],
        ),
        gnss=log.gnss.cut(fixes),
        heading=HeadingSamples(*(getattr(log.heading, name)[samples] for name in HeadingSamples.__slots__)),
    )
