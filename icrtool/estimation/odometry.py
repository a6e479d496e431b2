"""Wheels-only paths through a whole run: with the final ICRs, and without slip (Pentzer 2014, Section 6.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icrtool.kernels.arrays import Bools, Floats
from icrtool.kernels.open_loop.direct import open_loop_path
from icrtool.records.run import track_of_states
from icrtool.records.tables import Icrs, States


@dataclass(frozen=True, slots=True)
class OdometryPath:
    """Where wheel speeds alone lead from the first recorded state.

    Attributes
    ----------
    north_m, east_m : float64 (n,), at every recorded state
    heading_rad : float64 (n,), clockwise from north, unwrapped
    end_error_m : distance to the filter's estimate at the last state
    """

    north_m: Floats
    east_m: Floats
    heading_rad: Floats
    end_error_m: float


def drive_wheels(table: States, in_gap: Bools, icrs: Icrs) -> OdometryPath:
    """Drive from the first state to the last; through a gap in the wheel data move as the filter did.

    Parameters
    ----------
    table : the recorded states
    in_gap : bool (n,), whether the interval after a state is a gap in the wheel data
    icrs : the run's final ones, or `no_slip_icrs`

    Notes
    -----
    Nobody knows what the wheels did in a gap. The filter's displacement stands in for it, turned by the heading error
    that the odometry has gathered so far, so that a gap neither adds an error nor forgives one.
    """
    track = track_of_states(table, in_gap, np.empty((0, 2), np.int64))
    north, east, heading = (np.empty(len(table)) for _ in range(3))
    edges = np.flatnonzero(in_gap[:-1])
    miss_north, miss_east, turned = 0.0, 0.0, 0.0
    for first, last in zip([0, *(edges + 1)], [*edges, len(table) - 1], strict=True):
        piece = open_loop_path(track, *icrs, int(first), int(last))
        stretch = slice(first, last + 1)
        if first:
            # The error at the gap's begin is carried over it: the displacement turned by `turned`, less itself.
            step_north = table.north_m[first] - table.north_m[first - 1]
            step_east = table.east_m[first] - table.east_m[first - 1]
            cos, sin = np.cos(turned), np.sin(turned)
            miss_north += step_north * cos - step_east * sin - step_north
            miss_east += step_north * sin + step_east * cos - step_east
            ahead_north, ahead_east = piece.north - table.north_m[first], piece.east - table.east_m[first]
            north[stretch] = table.north_m[first] + miss_north + ahead_north * cos - ahead_east * sin
            east[stretch] = table.east_m[first] + miss_east + ahead_north * sin + ahead_east * cos
            heading[stretch] = piece.heading + turned
        elif last == len(table) - 1:
            north, east, heading = piece
        else:
            north[stretch], east[stretch], heading[stretch] = piece
        miss_north, miss_east = north[last] - table.north_m[last], east[last] - table.east_m[last]
        turned += float(piece.heading[-1] - table.heading_rad[last])
    return OdometryPath(north, east, heading, float(np.hypot(miss_north, miss_east)))
