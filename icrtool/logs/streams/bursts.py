"""Spreading of stamps over time for samples that arrive in packets, as over a serial adapter or a radio link."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Complexes, Ints

SHORT_INTERVAL = 0.2
"""Interval, as a share of the mean interval, below which two samples belong to one packet. A sensor with a steady rate
has no such interval; of random arrivals one interval in six is as short."""

LEAST_BURST_SHARE = 0.02
"""Smallest share of short intervals with which stamps are spread. Damaged messages cause single short intervals."""

PAUSE_IN_LONGEST = 3.0
"""Interval, as a multiple of the 98th percentile of the intervals, above which it is a gap. Gaps are left out of the
mean interval."""

LONGEST_STEP = 1.5
"""Largest interval between the spread samples of a packet, as a multiple of the usual interval. The first packet after
a gap holds only the last samples of the gap."""


class Bursts(NamedTuple):
    """Stamps of samples that arrive in packets, spread over the times at which they were measured.

    Attributes
    ----------
    stamp_ns : (n,) the spread stamps [ns]; the given stamps if `samples` is 0
    samples : median number of samples in a packet of two or more; 0 without such packets
    apart_ns : median interval between these packets [ns]
    shared : whether all samples of a packet have the stamp of the first sample, as with a clock of whole seconds
    """

    stamp_ns: Ints
    samples: int
    apart_ns: int
    shared: bool = False

    def as_shared(self) -> Bursts:
        """Return the bursts for stamps of the first sample of each packet, in place of the last one."""
        later = self.apart_ns - self.apart_ns // max(self.samples, 1)
        return self._replace(stamp_ns=self.stamp_ns + later, shared=True)

    def sentence(self, subject: str) -> str:
        """Return a sentence about the packets of `subject` and the correction; empty without packets."""
        if not self.samples:
            return ""
        if self.shared:
            finding = f"{subject} have the same stamp in groups of {self.samples}, {self.apart_ns / 1e6:.0f} ms apart"
            return f"{finding}: the stamps are spread over the time until the next group"
        finding = f"{subject} arrive in bursts of {self.samples}, {self.apart_ns / 1e6:.0f} ms apart"
        return f"{finding}: the stamps of each burst are spread over the time since the burst before"


def spread_bursts(stamp_ns: Ints) -> Bursts:
    """Return stamps (n,) [ns] in the given order; samples of a packet are spread over the time since the last packet.

    Notes
    -----
    A packet of N samples that arrives at time T, after a packet at T', was measured between T' and T: sample j of N
    gets the stamp T' + (T - T') j / N. The last sample keeps its stamp, so that distances and delays do not change.
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
"""Mean step of the position within a packet, as a share of the mean step from packet to packet, above which the
positions of a packet were measured one after another. The share is 1 for a steady rate, and 0 for repeated
positions."""

LARGEST_STEPS = 0.95
"""Quantile of the steps of the position to which larger steps (jumps, steps over gaps) are reduced."""


def spread_positions(stamp_ns: Ints, position: Complexes, *, measured: bool) -> Bursts:
    """Return stamps (n,) [ns] of positions in the given order, spread if the position changes within the packets.

    Parameters
    ----------
    stamp_ns : (n,) stamps [ns]
    position : (n,) positions in a plane as complex numbers [m]
    measured : whether the stamps are times of measurements, which are equal if the clock rounds them down; otherwise
        they are times of arrival
    """
    bursts = spread_bursts(stamp_ns)
    if not bursts.samples:
        return bursts
    order = np.argsort(bursts.stamp_ns, kind="stable")
    step = np.abs(np.diff(position[order]))
    step = np.minimum(step, np.quantile(step, LARGEST_STEPS))
    within = np.diff(bursts.stamp_ns[order]) > np.diff(np.sort(stamp_ns))
    if not (within.any() and (~within).any() and step[within].mean() > EVEN_STEP * step[~within].mean()):
        return Bursts(stamp_ns, 0, 0)
    if measured and float((np.diff(np.sort(stamp_ns))[within] == 0).mean()) > EVEN_STEP:
        return bursts.as_shared()
    return bursts
