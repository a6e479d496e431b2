"""Headings that a robot still has when it goes blind: its gyro's, or its attitude sensor's, at the states of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from icrtool.records.tables import Floats, Ints

if TYPE_CHECKING:
    from icrtool.estimation.fit import FilterRun

LONGEST_HOLE_S = 1.0
"""A gyro silent for longer than this is not trusted."""


@dataclass(frozen=True, slots=True)
class MeasuredHeading:
    """Where the robot pointed by a sensor of its own, at the states of a run.

    Attributes
    ----------
    kind : ``heading``: an attitude, its direction is taken as told; ``gyro``: an integrated turn rate, which starts
        from the reference heading and is given scale and bias by the way outside the block
    angle_rad : (n,), clockwise, unwrapped
    """

    kind: Literal["heading", "gyro"]
    angle_rad: Floats


def measured_headings(run: FilterRun) -> tuple[MeasuredHeading, ...]:
    """Return the headings measured apart from the position reference, a gyro's before an attitude's.

    A heading read from the same topic as the position is the reference's own and is left out, like one that does not
    cover the run.
    """
    found, log = [], run.log
    stamps = run.table.stamp_ns
    if log.gyro is not None and _covers(log.gyro.stamp_ns, stamps):
        found.append(MeasuredHeading("gyro", _integrate(log.gyro.stamp_ns, log.gyro.rate_radps, stamps)))
    topics = {stream.role: stream.topic for stream in log.streams}
    of_reference = "heading" in topics and topics["heading"] == topics.get("gnss")
    if not of_reference and _covers(log.heading.stamp_ns, stamps):
        check = run.heading_check
        told = np.unwrap((-1.0 if check.applied_mirror else 1.0) * log.heading.heading_rad) - check.applied_offset_rad
        found.append(
            MeasuredHeading("heading", np.interp(_since(stamps, stamps), _since(log.heading.stamp_ns, stamps), told))
        )
    return tuple(found)


def _since(stamp_ns: Ints, epoch_ns: Ints) -> Floats:
    since: Floats = (stamp_ns - epoch_ns[0]) / 1e9
    return since


def _covers(measured_ns: Ints, states_ns: Ints) -> bool:
    """Say whether measurements reach from the first state to the last without a long hole."""
    hole = LONGEST_HOLE_S * 1e9
    within = measured_ns[(measured_ns > states_ns[0]) & (measured_ns < states_ns[-1])]
    return bool(np.max(np.diff(np.concatenate([states_ns[:1], within, states_ns[-1:]]))) < hole)


def _integrate(gyro_ns: Ints, rate: Floats, states_ns: Ints) -> Floats:
    """Return the turn [rad] up to each state: trapezoids, the first and last rate held beyond the samples."""
    t, at = _since(gyro_ns, states_ns), _since(states_ns, states_ns)
    turned = np.concatenate([[0.0], np.cumsum(np.diff(t) * (rate[:-1] + rate[1:]) / 2.0)])
    inside: Floats = np.interp(at, t, turned)
    whole: Floats = inside + np.minimum(at - t[0], 0.0) * rate[0] + np.maximum(at - t[-1], 0.0) * rate[-1]
    return whole
