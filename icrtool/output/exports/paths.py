"""The paths of a run for other programs: poses in ENU (REP-103), places on the globe, and text for evo and KITTI tools.

x is east, y is north, z is up; yaw is counter-clockwise from east; the body's x is forward and its y left. The origin
is the datum of the run, or that of its position reference where it was metric already.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from icrtool import __version__
from icrtool.errors import DataError
from icrtool.estimation.odometry import drive_wheels, odometry_icrs
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.track import FrozenIcrs
from icrtool.output.series import places
from icrtool.records.run import Run
from icrtool.records.tables import Icrs, States

PathName = Literal["filter", "smoothed", "icr", "no_slip"]

LABELS: dict[PathName, str] = {
    "filter": "filter",
    "smoothed": "smoother",
    "icr": "ICR odometry",
    "no_slip": "no-slip odometry",
}

ERROR_HORIZON_M = 10.0
"""Open-loop errors are exported after this distance."""

LINE_CELL_M = 0.05
"""A line has a point where it enters another cell of a grid of this side."""

METRIC_ONLY = "its position reference is metric, so its place on the globe is not known"


@dataclass(frozen=True, slots=True)
class ExportPath:
    """One path of a run, at every recorded state.

    Attributes
    ----------
    name : which one
    stamp_ns : int64 (n,), of the log's clock
    x_m, y_m : float64 (n,), east and north of the datum
    yaw_rad : float64 (n,), counter-clockwise from east, unwrapped
    icrs : the ICRs that turn wheel speeds into this path's velocities; those of the filter for filter and smoother
    end_error_m : distance to the filter's estimate at the last state
    """

    name: PathName
    stamp_ns: Ints
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    icrs: FrozenIcrs
    end_error_m: float

    @property
    def quaternion(self) -> tuple[Floats, Floats]:
        """The z and w components (n,) of the orientation; x and y are zero."""
        return np.sin(self.yaw_rad / 2), np.cos(self.yaw_rad / 2)


class Globe(NamedTuple):
    """Where the origin of the local plane is: latitude and longitude [deg], WGS 84, height above the ellipsoid [m]."""

    latitude_deg: float
    longitude_deg: float
    height_m: float

    def places(self, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        """Return latitude and longitude (n,) [deg] of points in the local plane."""
        from pymap3d import enu2geodetic

        latitude, longitude, _ = enu2geodetic(x_m, y_m, np.zeros_like(x_m), *self)
        return np.asarray(latitude, np.float64), np.asarray(longitude, np.float64)


def paths_of(run: Run) -> tuple[ExportPath, ...]:
    """Return the paths of a run: filter, smoother where it has one, ICR odometry, no slip where b is known."""
    table = run.table
    momentary = FrozenIcrs(table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m)
    paths = [_of_states("filter", table, momentary)]
    if run.smoothed is not None:
        paths.append(_of_states("smoothed", run.smoothed, momentary))
    return *paths, *(_of_odometry(name, run, icrs) for name, icrs in odometry_icrs(run).items())


def about_run(run: Run) -> dict[str, str | bool | None]:
    """Return what an export states of the run that it was made from."""
    return {
        "log": run.name,
        "robot": run.config.robot.name,
        "usable": run.usable,
        "unusable_because": run.document.unusable_because,
        "tool_version": __version__,
    }


def globe_of(run: Run) -> Globe | None:
    """Return the datum of a run; None where its positions were metric and none was configured."""
    if (datum := run.document.gnss.datum) is not None:
        return Globe(*datum)
    return Globe(*run.config.frames.datum, 0.0) if run.config.frames.datum is not None else None


def find_globe(run: Run) -> Globe:
    """Return the datum of a run.

    Raises
    ------
    DataError
        Its positions were metric, and none was configured.
    """
    if (globe := globe_of(run)) is None:
        advice = "fit it with --set frames.datum=[latitude,longitude] if its axes are north and east, or use --for evo"
        raise DataError(run.name, METRIC_ONLY, advice)
    return globe


def utc_text(stamp_ns: Ints) -> list[str]:
    """Return stamps (n,) as texts in ISO 8601, to the millisecond."""
    return [f"{text}Z" for text in np.datetime_as_string(stamp_ns.astype("datetime64[ns]"), unit="ms").tolist()]


def rows_apart(stamp_ns: Ints, interval_s: float) -> Ints:
    """Return rows (m,) of stamps, at most one in each interval; the last row is always one of them."""
    number = (stamp_ns - stamp_ns[0]) // round(interval_s * 1e9)
    return np.unique(np.concatenate([[0], np.flatnonzero(np.diff(number)) + 1, [len(stamp_ns) - 1]]))


def line_rows(x_m: Floats, y_m: Floats) -> Ints:
    """Return rows (m,) of points (n,) that draw a line, two at least: where it enters another cell of a fine grid."""
    rows = places(y_m, x_m, LINE_CELL_M)
    return rows if len(rows) > 1 else np.repeat(rows, 2)


def outage_rows(run: Run) -> Iterator[tuple[tuple[int, int], slice]]:
    """Yield begin and end [ns] of each outage, and the states of it."""
    stamps = run.table.stamp_ns
    for begin_ns, end_ns in run.outages_ns.tolist():
        first, last = np.searchsorted(stamps, [begin_ns, end_ns])
        yield (begin_ns, end_ns), slice(min(int(first), len(stamps) - 1), int(last) + 1)


def _of_states(name: PathName, table: States, icrs: FrozenIcrs) -> ExportPath:
    yaw = math.pi / 2 - table.heading_rad
    return ExportPath(name, table.stamp_ns, table.east_m, table.north_m, yaw, icrs, 0.0)


def _of_odometry(name: PathName, run: Run, icrs: Icrs) -> ExportPath:
    path = drive_wheels(run.table, run.in_gap, icrs)
    yaw, constant = math.pi / 2 - path.heading_rad, FrozenIcrs.constant(*icrs)
    return ExportPath(name, run.table.stamp_ns, path.east_m, path.north_m, yaw, constant, path.end_error_m)


TrajectoryFormat = Literal["evo", "kitti"]

SUFFIXES: dict[TrajectoryFormat, str] = {"evo": ".tum", "kitti": ".kitti"}

DIGITS = 9
"""Decimals of positions [m] and of entries of rotations."""


def format_trajectory(path: ExportPath, target: TrajectoryFormat) -> str:
    """Return a path as text, a line a state, with a line end.

    Notes
    -----
    TUM (``evo``): stamp [s], x, y, z, and the quaternion x, y, z, w. KITTI: the upper three rows of the pose matrix,
    row by row, without a stamp. World ENU, body x forward and y left (REP-103); KITTI's own camera frame is not used.
    """
    if target == "kitti":
        cos, sin, minus_sin = np.cos(path.yaw_rad), np.sin(path.yaw_rad), -np.sin(path.yaw_rad)
        matrix = zip(*(_numbers(column) for column in (cos, minus_sin, path.x_m, sin, path.y_m)), strict=True)
        return "".join(f"{c} {n} 0 {x} {s} {c} 0 {y} 0 0 1 0\n" for c, n, x, s, y in matrix)
    z, w = path.quaternion
    columns = (_numbers(column) for column in (path.x_m, path.y_m, z, w))
    seconds, rest = np.divmod(path.stamp_ns, 1_000_000_000)
    stamps = zip(seconds.tolist(), rest.tolist(), strict=True)
    rows = zip(stamps, *columns, strict=True)
    return "".join(f"{whole}.{part:09d} {x} {y} 0 0 0 {qz} {qw}\n" for (whole, part), x, y, qz, qw in rows)


def is_trajectory(first: bytes) -> bool:
    """Return whether a file holds lines of numbers only, by its first bytes."""
    return re.fullmatch(rb"[-+.0-9e \n]*", first) is not None


def _numbers(column: Floats) -> list[float]:
    """Return rounded numbers; adding zero takes the sign off a rounded -0.0."""
    rounded: list[float] = (np.round(column, DIGITS) + 0.0).tolist()
    return rounded
