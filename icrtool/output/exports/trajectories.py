"""Trajectories as text files that evo and other evaluation tools read: TUM and KITTI."""

from __future__ import annotations

import re
from typing import Literal

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.output.exports.paths import ExportPath

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
