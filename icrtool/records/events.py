"""Slip events: time spans in which the robot does not move as its wheels do."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bools, Ints

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


def intervals_in(stamps_ns: Ints, spans_ns: Iterable[tuple[int, int]]) -> Bools:
    """Return which intervals [k, k + 1) between stamps (n,) share time with a span; the last is none."""
    inside, ends = np.zeros(len(stamps_ns), np.bool_), np.append(stamps_ns[1:], stamps_ns[-1:])
    for begin, end in spans_ns:
        inside[np.searchsorted(ends, begin, side="right") : np.searchsorted(stamps_ns, end)] = True
    inside[-1:] = False
    return inside
