"""Headings that a robot still has without GNSS: its gyro's, or its attitude sensor's, at the states of a run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.records.dropout import MeasuredHeading
from icrtool.records.run import Run

LONGEST_HOLE_S = 1.0
"""A gyro silent for longer than this is not trusted."""


def measured_headings(run: Run) -> Iterator[MeasuredHeading]:
    """Yield the headings measured apart from the position reference, a gyro's before an attitude sensor's.

    A heading that needs positions is left out (estimated, or a field of the position's messages), like one that does
    not cover the run.
    """
    sensors = run.sensors
    stamps = run.table.stamp_ns
    if sensors.gyro is not None and _covers(sensors.gyro.stamp_ns, stamps):
        yield MeasuredHeading("gyro", _integrate(sensors.gyro.stamp_ns, sensors.gyro.rate_radps, stamps))
    needs_positions = sensors.heading_from_position or sensors.heading_is_estimated
    attitude = None if needs_positions else sensors.headings
    attitude = sensors.attitude if sensors.attitude is not None else attitude
    if attitude is not None and _covers(attitude.stamp_ns, stamps):
        turned = np.unwrap(attitude.heading_rad)
        angle = np.interp(_since(stamps, stamps), _since(attitude.stamp_ns, stamps), turned)
        yield MeasuredHeading("heading", angle)


def _since(stamp_ns: Ints, epoch_ns: Ints) -> Floats:
    since: Floats = (stamp_ns - epoch_ns[0]) / 1e9
    return since


def _covers(measured_ns: Ints, states_ns: Ints) -> bool:
    """Return whether measurements reach from the first state to the last without a long hole."""
    hole = LONGEST_HOLE_S * 1e9
    within = measured_ns[(measured_ns > states_ns[0]) & (measured_ns < states_ns[-1])]
    return bool(np.max(np.diff(np.concatenate([states_ns[:1], within, states_ns[-1:]]))) < hole)


def _integrate(gyro_ns: Ints, rate: Floats, states_ns: Ints) -> Floats:
    """Return the turn [rad] up to each state: trapezoids, the first and last rate held beyond the samples."""
    t, at = _since(gyro_ns, states_ns), _since(states_ns, states_ns)
    turned = np.zeros(len(t))
    np.cumsum(np.diff(t) * (rate[:-1] + rate[1:]) / 2.0, out=turned[1:])
    whole: Floats = np.interp(at, t, turned)
    del turned
    whole += np.minimum(at - t[0], 0.0) * rate[0]
    whole += np.maximum(at - t[-1], 0.0) * rate[-1]
    return whole
