"""Time spans in which robot or reference do not move as the wheels do: slip events, jumps of the reference."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bools, Ints
from icrtool.records.plain_data import Record

SlipKind = Literal["immobilised", "slip", "skid", "spin"]
"""Wheels turn and the robot stands; it moves less than its wheels; it moves sideways; it turns less than expected."""


class SlipEvent(NamedTuple):
    """One span in which the robot did not do what its wheels did.

    Attributes
    ----------
    begin_ns, end_ns : stamps of the wheel clock
    north_m, east_m : position at the begin, in the local plane
    distance_m : length of the robot's path through the event, by the position reference
    severity : share of the wheels' motion that the robot did not make, 0 to 1
    confidence : probability that model error and sensor noise alone would not have made any such event in the log
    """

    kind: SlipKind
    begin_ns: int
    end_ns: int
    north_m: float
    east_m: float
    distance_m: float
    severity: float
    confidence: float


JumpKind = Literal["position", "heading"]
"""What jumps: the position, alone or with the heading, or the heading alone."""


class ReferenceJump(Record, frozen=True):
    """One discontinuity of the reference: it moves as no robot can, or as its own messages explain.

    Attributes
    ----------
    begin_ns, end_ns : stamps of the wheel clock, from the last pose before to the first after that the filter followed
    north_m, east_m : position before it, in the local plane
    size_m : largest step of the position within it, beyond the motion of the wheels
    turn_deg : likewise of the heading, clockwise; 0 where the heading is not stated with the position
    moved_north_m, moved_east_m : sum of its steps
    why : what shows it
    undecided : it may as well be the robot: its trials count
    """

    kind: JumpKind
    begin_ns: int
    end_ns: int
    north_m: float
    east_m: float
    size_m: float
    turn_deg: float
    moved_north_m: float
    moved_east_m: float
    why: str
    undecided: bool


def intervals_in(stamps_ns: Ints, spans_ns: Iterable[tuple[int, int]]) -> Bools:
    """Return which intervals [k, k + 1) between stamps (n,) share time with a span; the last is none."""
    inside, ends = np.zeros(len(stamps_ns), np.bool_), np.append(stamps_ns[1:], stamps_ns[-1:])
    for begin, end in spans_ns:
        inside[np.searchsorted(ends, begin, side="right") : np.searchsorted(stamps_ns, end)] = True
    inside[-1:] = False
    return inside
