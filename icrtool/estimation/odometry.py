"""Wheels-only paths through a whole run: with the final ICRs, and without slip (Pentzer 2014, Section 6.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from icrtool.kernels.open_loop import open_loop_path
from icrtool.records.run import drive_through, toy_drive
from icrtool.records.tables import Bools, Floats, States

if TYPE_CHECKING:
    from icrtool.estimation.fit import FilterRun


@dataclass(frozen=True, slots=True)
class OdometryPath:
    """Where wheel speeds alone lead from the first recorded state.

    Attributes
    ----------
    north_m, east_m : float64 (n,), at every recorded state
    end_error_m : distance to the filter's estimate at the last state
    """

    north_m: Floats
    east_m: Floats
    end_error_m: float


def icr_odometry(run: FilterRun) -> OdometryPath:
    """Return the path with the ICRs the run ended with."""
    table = run.table
    return _path(
        table,
        run.in_gap,
        float(table.y_icr_right_m[-1]),
        float(table.y_icr_left_m[-1]),
        float(table.x_icr_m[-1]),
    )


def no_slip_odometry(run: FilterRun) -> OdometryPath | None:
    """Return the path of the no-slip model (Eqs. 38-39); None where the track width is not known."""
    width = run.config.robot.track_width_m
    return _path(run.table, run.in_gap, width / 2, -width / 2, 0.0) if width is not None else None


def load_kernels() -> None:
    """Have the compiled kernel ready, before there is a run."""
    open_loop_path(toy_drive(), 1.0, -1.0, 0.0, 0, 1)


def _path(table: States, in_gap: Bools, y_icr_right: float, y_icr_left: float, x_icr: float) -> OdometryPath:
    """Drive from the first state to the last; through a gap in the wheel data move as the filter did.

    Notes
    -----
    Nobody knows what the wheels did in a gap. The filter's displacement stands in for it, turned by the heading error
    that the odometry has gathered so far, so that a gap neither adds an error nor forgives one.
    """
    drive = drive_through(table, in_gap, np.zeros(len(table), np.bool_))
    north, east = np.empty(len(table)), np.empty(len(table))
    edges = np.flatnonzero(in_gap[:-1])
    miss_north, miss_east, turned = 0.0, 0.0, 0.0
    for first, last in zip([0, *(edges + 1)], [*edges, len(table) - 1], strict=True):
        piece = open_loop_path(drive, y_icr_right, y_icr_left, x_icr, int(first), int(last))
        ahead_north, ahead_east = piece.north - table.north_m[first], piece.east - table.east_m[first]
        if first:
            # The error at the gap's begin is carried over it: the displacement turned by `turned`, less itself.
            step_north = table.north_m[first] - table.north_m[first - 1]
            step_east = table.east_m[first] - table.east_m[first - 1]
            miss_north += step_north * np.cos(turned) - step_east * np.sin(turned) - step_north
            miss_east += step_north * np.sin(turned) + step_east * np.cos(turned) - step_east
        stretch = slice(first, last + 1)
        north[stretch] = table.north_m[first] + miss_north + ahead_north * np.cos(turned) - ahead_east * np.sin(turned)
        east[stretch] = table.east_m[first] + miss_east + ahead_north * np.sin(turned) + ahead_east * np.cos(turned)
        miss_north, miss_east = north[last] - table.north_m[last], east[last] - table.east_m[last]
        turned += float(piece.heading[-1] - table.heading_rad[last])
    return OdometryPath(north, east, float(np.hypot(miss_north, miss_east)))
