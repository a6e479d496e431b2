"""Poses of one topic of a log, as the robot's own localisation computed them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icrtool.kernels.arrays import Bools, Complexes, Floats, Ints


@dataclass(frozen=True, slots=True)
class TopicPoses:
    """Poses of one topic, in the topic's own frame, at least two.

    Attributes
    ----------
    topic, message_type : as in the log
    header_ns : int64 (n,) header stamps, increasing; None where they cannot be used
    log_ns : int64 (n,) log times, increasing
    place : complex (n,) position [m]; the imaginary axis is 90 deg clockwise of the real axis, seen from above
    heading : (n,) heading of the body's forward axis, clockwise from the real axis, unwrapped [rad]
    gap : bool (n - 1,), whether an interval between messages is far longer than the others
    """

    topic: str
    message_type: str
    header_ns: Ints | None
    log_ns: Ints
    place: Complexes
    heading: Floats
    gap: Bools

    def stamps(self, *, by_log_time: bool) -> Ints:
        """Return the stamps (n,): header stamps; log times if there are no header stamps or `by_log_time` is set."""
        return self.log_ns if by_log_time or self.header_ns is None else self.header_ns

    def at(self, t: Floats, at: Floats) -> tuple[Complexes, Floats]:
        """Return place and heading at some times (m,), linear between poses at times `t` (n,) [s]."""
        return np.interp(at, t, self.place), np.interp(at, t, self.heading)

    def covered(self, t: Floats, begin: Floats, end: Floats) -> Bools:
        """Return whether poses at `t` (n,) [s] cover each span of time (m,): poses before and after it, and no gap."""
        gaps = np.append(0, np.cumsum(self.gap))
        first = np.searchsorted(t, begin, side="right") - 1
        last = np.searchsorted(t, end, side="left")
        inside = (first >= 0) & (last < len(t))
        return np.asarray(inside & (gaps[np.minimum(last, len(t) - 1)] == gaps[np.maximum(first, 0)]))
