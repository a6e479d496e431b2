"""The GNSS outages that a log had itself."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.open_loop import open_loop_path
from icrtool.records.dropout import Outage
from icrtool.records.run import Run, drive_of


def real_outages(run: Run) -> tuple[Outage, ...]:
    """Return the log's own GNSS outages: open loop with wheels and the ICRs of the last fix, missed at the next one.

    One that never ends, and one with a gap in the wheel data, has no miss and is left out; so has one that the drive
    begins with: neither place nor ICRs were known before it.
    """
    drive, table = drive_of(run), run.table
    origin = int(table.stamp_ns[0])
    outages = []
    for begin, end in run.outages_ns:
        first, last = (int(row) for row in np.searchsorted(table.stamp_ns, [begin, end]))
        if first == 0 or last >= len(table) or last <= first or run.in_gap[first:last].any():
            continue
        right, left, x = (float(column[first]) for column in (table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m))
        path = open_loop_path(drive, right, left, x, first, last)
        miss = float(np.hypot(path.north[-1] - table.north_m[last], path.east[-1] - table.east_m[last]))
        outages.append(
            Outage(
                kind="real",
                begin_s=(int(begin) - origin) / 1e9,
                end_s=(int(end) - origin) / 1e9,
                distance_m=float(table.distance_m[last] - table.distance_m[first]),
                end_error_m=miss,
                max_error_m=miss,
                north_m=path.north,
                east_m=path.east,
            )
        )
    return tuple(outages)
