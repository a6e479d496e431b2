"""Samples that arrive several at a time: a serial adapter or a radio link holds them back and passes on packets."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Ints

SHORT_INTERVAL = 0.2
"""Part of the mean interval. Samples that arrive closer together than this are of one packet: no sensor that samples
at a steady rate has such an interval, and random arrivals have one in six of them."""

LEAST_BURST_SHARE = 0.02
"""Share of the intervals that are short, from which on stamps are spread. Damage makes single ones."""

PAUSE_IN_LONGEST = 3.0
"""Intervals longer than this many times the 98th percentile are gaps, and no part of the mean interval."""

LONGEST_STEP = 1.5
"""Usual intervals that samples of a packet are spread apart at most: after a gap, a packet holds its end alone."""


class Bursts(NamedTuple):
    """Stamps of samples that arrive in packets, spread as they were measured.

    Attributes
    ----------
    stamp_ns : (n,) as they were given where `samples` is 0
    samples : median number of samples of a packet, of those with more than one; 0 where there are none
    apart_ns : median interval between these packets
    """

    stamp_ns: Ints
    samples: int
    apart_ns: int

    @property
    def note(self) -> str:
        """What was found and done, as a sentence; empty without bursts."""
        if not self.samples:
            return ""
        found = f"wheel samples arrive in bursts of {self.samples}, {self.apart_ns / 1e6:.0f} ms apart"
        return f"{found}: the stamps of each burst are spread over the time since the one before"


def spread_bursts(stamp_ns: Ints) -> Bursts:
    """Return stamps (n,) of samples in any order; samples of a packet are spread over the time since the last packet.

    Notes
    -----
    A packet that arrives at T with N samples, after one at T', holds what was measured from T' to T: sample j of N is
    of T' + (T - T') j / N. The last one keeps its stamp, so that distances and delays stay as they are.
    """
    none = Bursts(stamp_ns, 0, 0)
    if len(stamp_ns) < 3:
        return none
    order = np.argsort(stamp_ns, kind="stable")
    stamps = stamp_ns[order]
    interval = np.diff(stamps)
    usual = interval[interval <= PAUSE_IN_LONGEST * float(np.quantile(interval, 0.98))]
    mean_ns = float(usual.mean()) if len(usual) else 0.0
    short = interval < SHORT_INTERVAL * mean_ns
    if not short.mean() >= LEAST_BURST_SHARE:
        return none
    ends = np.append(np.flatnonzero(~short), len(stamps) - 1)
    count = np.diff(ends, prepend=-1)
    since = np.diff(stamps[ends], prepend=stamps[0])
    usual_ns = float(np.median(since[1:] / count[1:])) if len(ends) > 1 else mean_ns
    since[0] = round(usual_ns) * count[0]
    step = np.minimum(since / count, LONGEST_STEP * usual_ns)
    packet = np.repeat(np.arange(len(ends)), count)
    before = ends[packet] - np.arange(len(stamps))
    spread = np.empty_like(stamps)
    spread[order] = stamps[ends][packet] - np.rint(before * step[packet]).astype(np.int64)
    many = count > 1
    return Bursts(spread, int(np.median(count[many])), int(np.median(since[many])))
