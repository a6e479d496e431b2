"""The GNSS outages that a log had itself."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Ints
from icrtool.kernels.open_loop.direct import open_loop_path
from icrtool.kernels.open_loop.trials import OpenLoopPath
from icrtool.records.dropout import Outage
from icrtool.records.run import Run, track_of

COMPARED_S = 1.0
"""Fixes of this time after an outage are compared with the open-loop path, which is driven on for as long."""


def real_outages(run: Run) -> tuple[Outage, ...]:
    """Return the log's own GNSS outages: open loop with wheels and the ICRs of the last fix before.

    The end error is the distance to the fixes that ended the outage, not to the filter: a filter that drove on with its
    wheels is as wrong as the open-loop path. An outage that never ends, and one with a gap in the wheel data, has no
    end error and is left out; so is one that the drive begins with: neither position nor ICRs were known before it.
    """
    track, table = track_of(run), run.table
    origin = int(table.stamp_ns[0])
    outages = []
    for begin, end in run.outages_ns:
        first, last = (int(row) for row in np.searchsorted(table.stamp_ns, [begin, end]))
        if first == 0 or last >= len(table) or last <= first or run.in_gap[first:last].any():
            continue
        after = int(np.searchsorted(table.stamp_ns, end + round(COMPARED_S * 1e9)))
        gaps = np.flatnonzero(run.in_gap[last:after])
        after = last + int(gaps[0]) if len(gaps) else min(after, len(table) - 1)
        path = open_loop_path(track, *table.icrs_at(first), first, after)
        error = _end_error_m(run, path, table.stamp_ns[first : after + 1], int(end))
        inside = slice(last - first + 1)
        outages.append(
            Outage(
                kind="real",
                begin_s=(int(begin) - origin) / 1e9,
                end_s=(int(end) - origin) / 1e9,
                distance_m=float(table.distance_m[last] - table.distance_m[first]),
                end_error_m=error,
                max_error_m=error,
                north_m=path.north[inside],
                east_m=path.east[inside],
            )
        )
    return tuple(outages)


def _end_error_m(run: Run, path: OpenLoopPath, stamp_ns: Ints, end_ns: int) -> float:
    """Return how far the antenna on a path, with its stamps (m,), is from the used fixes since the outage's end."""
    fixes = run.sensors.fixes
    after = (fixes.stamp_ns >= end_ns) & (fixes.stamp_ns <= max(end_ns, int(stamp_ns[-1])))
    rows = np.flatnonzero(run.gnss.used & after)
    forward, right = run.sensors.antenna_m
    cos, sin = np.cos(path.heading), np.sin(path.heading)
    at, of = (fixes.stamp_ns[rows] - stamp_ns[0]) / 1e9, (stamp_ns - stamp_ns[0]) / 1e9
    north = np.interp(at, of, path.north + forward * cos - right * sin) - fixes.north_m[rows]
    east = np.interp(at, of, path.east + forward * sin + right * cos) - fixes.east_m[rows]
    return float(np.hypot(north.mean(), east.mean()))
