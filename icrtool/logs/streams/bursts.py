"""Samples that arrive several at a time: a serial adapter or a radio link holds them back and passes on packets."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Complexes, Ints

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
    shared : the samples of a packet have one stamp, as a clock of whole seconds gives: it is the time of the first one
    """

    stamp_ns: Ints
    samples: int
    apart_ns: int
    shared: bool = False

    def as_shared(self) -> Bursts:
        """Return them with the stamps of a packet as the time of its first sample, not of its last one."""
        later = self.apart_ns - self.apart_ns // max(self.samples, 1)
        return self._replace(stamp_ns=self.stamp_ns + later, shared=True)

    def sentence(self, of: str) -> str:
        """Return what was found of samples and done, as a sentence; empty without bursts."""
        if not self.samples:
            return ""
        if self.shared:
            finding = f"{of} share their stamps, {self.samples} at a time, {self.apart_ns / 1e6:.0f} ms apart"
            return f"{finding}: the stamps are spread over the time until the next ones"
        finding = f"{of} arrive in bursts of {self.samples}, {self.apart_ns / 1e6:.0f} ms apart"
        return f"{finding}: the stamps of each burst are spread over the time since the one before"


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


EVEN_STEP = 0.5
"""Mean step of the position within a packet, as a share of the step from packet to packet, above which the positions of
a packet were measured one after another: it is 1 for an even rate, and 0 for repeated or truly close ones."""

LARGEST_STEPS = 0.95
"""Quantile of the steps of the position, to which larger ones are limited: jumps, and steps over gaps."""


def spread_positions(stamp_ns: Ints, place: Complexes, *, measured: bool) -> Bursts:
    """Return stamps (n,) of positions in any order, spread where the positions move on within the packets.

    Parameters
    ----------
    place : (n,) positions in one plane [m]
    measured : the stamps are of the measurements, not of their arrival: those that are equal were rounded down
    """
    bursts = spread_bursts(stamp_ns)
    if not bursts.samples:
        return bursts
    order = np.argsort(bursts.stamp_ns, kind="stable")
    step = np.abs(np.diff(place[order]))
    step = np.minimum(step, np.quantile(step, LARGEST_STEPS))
    within = np.diff(bursts.stamp_ns[order]) > np.diff(np.sort(stamp_ns))
    if not (within.any() and (~within).any() and step[within].mean() > EVEN_STEP * step[~within].mean()):
        return Bursts(stamp_ns, 0, 0)
    if measured and float((np.diff(np.sort(stamp_ns))[within] == 0).mean()) > EVEN_STEP:
        return bursts.as_shared()
    return bursts
