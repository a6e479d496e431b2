"""Small drawings in a page that need no script: a drive, the ICRs of a robot, the errors of groups."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from icrtool.calibration.record import Calibration
from icrtool.kernels.arrays import ROWS_AT_ONCE
from icrtool.output.series import round_steps
from icrtool.records.acceptance import CHOICE_HORIZON_M
from icrtool.records.calibration_document import GroupComparison
from icrtool.records.dropout_document import DropoutDocument
from icrtool.records.run import ICR_COLUMNS, Run

WIDTH, HEIGHT, MARGIN = 360.0, 240.0, 16.0
"""Width, height and free edge of a sketch [units of the drawing]. A unit is at most a pixel."""

LONGEST_BAR = 0.3
"""Largest length of the scale bar, as a share of the width of the sketch."""

NEAR = 1.5
"""Distance of two points below which the second one is not drawn [units of the drawing]."""


class Sketch(NamedTuple):
    """A drive from above, north up.

    Attributes
    ----------
    path : the drive, as an SVG path
    worst : the trial with the largest error, as an SVG path; empty if there is none
    start, end : first and last place (x, y) [units of the drawing]
    bar, bar_m : length of the scale bar [units of the drawing], and the distance that it stands for [m]
    width, height : size of the drawing [units of the drawing]
    """

    path: str
    worst: str
    start: tuple[float, float]
    end: tuple[float, float]
    bar: float
    bar_m: float
    width: float = WIDTH
    height: float = HEIGHT


def drive_sketch(run: Run, report: DropoutDocument) -> Sketch:
    """Return the drive of a run from above, with the trial of the largest error."""
    north, east = run.table.north_m, run.table.east_m
    low, high = np.array([east.min(), north.min()]), np.array([east.max(), north.max()])
    drawable = np.array([WIDTH, HEIGHT]) - 2.0 * MARGIN
    # The view is at least one metre wide, because the drive of a robot that stands has no extent.
    scale = float(np.min(drawable / np.maximum(high - low, 1.0)))
    middle = (low + high) / 2.0

    def points(begin: int, end: int) -> Iterator[tuple[float, float]]:
        """Yield the places of some states in the drawing, without lists of all states."""
        for lo in range(begin, end, ROWS_AT_ONCE):
            some = slice(lo, min(lo + ROWS_AT_ONCE, end))
            x, y = WIDTH / 2.0 + scale * (east[some] - middle[0]), HEIGHT / 2.0 - scale * (north[some] - middle[1])
            yield from zip(x.tolist(), y.tolist(), strict=True)

    worst, states = "", len(run.table)
    if report.worst:
        first, last = _rows_of_trial(run, report.worst[0].t_s, report.worst[0].horizon_m)
        worst = _svg_path(points(first, last + 1))
    bar_m = _round_length(LONGEST_BAR * WIDTH / scale)
    start, end = ((round(x, 1), round(y, 1)) for row in (0, states - 1) for x, y in points(row, row + 1))
    return Sketch(_svg_path(points(0, states)), worst, start, end, round(bar_m * scale, 1), bar_m)


def _rows_of_trial(run: Run, begin_s: float, horizon_m: float) -> tuple[int, int]:
    """Return the first and the last row of a trial that begins at a time and is `horizon_m` long."""
    last = len(run.table) - 1
    begin = min(int(np.searchsorted(run.table.t_s, begin_s)), last)
    end = int(np.searchsorted(run.table.distance_m, run.table.distance_m[begin] + horizon_m))
    return begin, min(end, last)


def _svg_path(points: Iterable[tuple[float, float]]) -> str:
    """Return an SVG path through points; a point that is closer than `NEAR` to the point before is left out."""
    parts: list[str] = []
    before = (math.inf, math.inf)
    for point in points:
        if math.dist(before, point) >= NEAR:
            parts.append(f"{point[0]:.1f} {point[1]:.1f}")
            before = point
    return f"M{'L'.join(parts)}"


def _round_length(most_m: float) -> float:
    """Return the largest of the lengths 1, 2, 5, 10, 20 … [m] that is not above a length."""
    return float(max(step for step in round_steps(most_m) if step <= most_m))


class Geometry(NamedTuple):
    """A robot and its ICRs from above. Forward is up, and the origin of the body is in the middle.

    Attributes
    ----------
    icrs : x and y of the left and the right ICR, and their σ along x and y [units of the drawing]
    tracks : x of the left and the right track [units of the drawing]
    labels : text of the left and the right ICR
    bar, bar_m : length of the scale bar [units of the drawing], and the distance that it stands for [m]
    width, height : size of the drawing [units of the drawing]
    """

    icrs: tuple[tuple[float, float, float, float], ...]
    tracks: tuple[float, float]
    labels: tuple[str, str]
    bar: float
    bar_m: float
    width: float = WIDTH
    height: float = HEIGHT


def geometry_sketch(calibration: Calibration) -> Geometry:
    """Return the drawing of the ICRs of a calibration and the tracks of its robot."""
    y_right, y_left, x_icr = (calibration.geometry[name] for name in ICR_COLUMNS)
    std_right, std_left, std_x = (calibration.geometry_std[name] for name in ICR_COLUMNS)
    half = calibration.width_m / 2.0
    reach = max(abs(y_right) + std_right, abs(y_left) + std_left, half, 1e-3)
    up = max(abs(x_icr) + std_x, 1e-3)
    scale = min((WIDTH / 2.0 - 2.0 * MARGIN) / reach, (HEIGHT / 2.0 - 2.0 * MARGIN) / up)
    icrs = tuple(
        (WIDTH / 2.0 + scale * y, HEIGHT / 2.0 - scale * x_icr, scale * std, scale * std_x)
        for y, std in ((y_left, std_left), (y_right, std_right))
    )
    bar_m = _round_length(LONGEST_BAR * WIDTH / scale)
    return Geometry(
        icrs, (WIDTH / 2.0 - scale * half, WIDTH / 2.0 + scale * half), (f"{y_left:+z.3f} m", f"{y_right:+z.3f} m"),
        bar_m * scale, bar_m,
    )  # fmt: skip


class GroupError(NamedTuple):
    """The error of a group on a scale [units of the drawing].

    Attributes
    ----------
    name : name of the group
    x, low, high : x of the error and of the ends of its interval; None without an interval
    y : height of its row
    """

    name: str
    x: float
    low: float | None
    high: float | None
    y: float


class GroupErrors(NamedTuple):
    """The errors of groups in rows, over one scale from zero.

    Attributes
    ----------
    rows : the errors
    ticks : x of each tick [units of the drawing], and its number [m]
    width, height : size of the drawing [units of the drawing]
    """

    rows: tuple[GroupError, ...]
    ticks: tuple[tuple[float, str], ...]
    width: float
    height: float


ROW_HEIGHT, TICKS = 44.0, 4.0
"""Height of the row of a group [units of the drawing], and approximate number of ticks of the scale."""


def group_sketch(comparison: GroupComparison) -> GroupErrors:
    """Return the drawing of the 95 % errors of groups at `CHOICE_HORIZON_M`, each by its own calibration."""
    own_errors = [
        cell
        for cell in comparison.transfer
        if cell.horizon_m == CHOICE_HORIZON_M and cell.calibrated_on == cell.tested_on and cell.p95_m is not None
    ]
    end_m = max((cell.p95_high_m or cell.p95_m or 0.0 for cell in own_errors), default=0.0) or 1.0
    step_m = float(min(round_steps(end_m / TICKS), key=lambda step: abs(step - end_m / TICKS)))
    scale = (WIDTH - 3.0 * MARGIN) / end_m
    rows = []
    for number, cell in enumerate(own_errors):
        low, x, high = (
            None if error is None else round(MARGIN + scale * error, 1)
            for error in (cell.p95_low_m, cell.p95_m, cell.p95_high_m)
        )
        rows.append(GroupError(cell.tested_on, x or MARGIN, low, high, ROW_HEIGHT * (number + 0.75)))
    counts = range(math.floor(end_m / step_m) + 1)
    ticks = tuple((round(MARGIN + scale * step_m * count, 1), f"{step_m * count:g}") for count in counts)
    return GroupErrors(tuple(rows), ticks, WIDTH, ROW_HEIGHT * len(rows) + 3.0 * MARGIN)
