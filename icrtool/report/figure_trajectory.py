"""The way: fixes, filter, and where the wheels alone would have led (Pentzer 2014, Fig. 14)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from icrtool.analysis.fit import FilterRun
from icrtool.analysis.odometry import OdometryPath, icr_odometry, no_slip_odometry
from icrtool.core.ekf import GATED, UNSEEN
from icrtool.report.decimate import places
from icrtool.report.figure_style import BAD_FIX_COLOR, FILTER, FIX_COLOR, ICR, NO_SLIP, Pen, inches, new_figure
from icrtool.report.words import duration_text, position_word, run_title
from icrtool.tables import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH_IN, HEIGHT_IN = 7.2, 6.2

LARGEST_DETOUR = 0.75
"""Odometry is shown this far outside the filter's path, in sizes of that path; what leads further leaves the picture."""

SMALLEST_VIEW_M = 2.0
CELLS = 1500.0
"""Points closer than this fraction of the view are one point: about a pixel."""


def draw_trajectory(run: FilterRun) -> Figure:
    """Draw fixes, filter, ICR odometry with the final ICRs and no-slip odometry over east and north."""
    table = run.table
    icr, no_slip = icr_odometry(run), no_slip_odometry(run)
    drive = run.summary["drive"]
    facts = f"{drive['distance_m']:.1f} m in {duration_text(drive['duration_s'])}"
    figure = new_figure(run_title(run), f"Trajectory, {facts}", width_in=WIDTH_IN, height_in=HEIGHT_IN)
    axes = figure.subplots()
    figure.subplots_adjust(**inches(figure, left=0.75, right=0.2, top=0.55, bottom=1.25))
    lowest, highest = _view(run, icr, no_slip)
    cell = float((highest - lowest).max()) / CELLS

    _draw_fixes(axes, run, cell, lowest, highest)
    for path, pen, name in ((no_slip, NO_SLIP, "no-slip odometry"), (icr, ICR, "ICR odometry, final ICRs")):
        if path is not None:
            label = f"{name}: {path.end_error_m:.1f} m off at the end"
            _draw_path(axes, path.north_m, path.east_m, cell, pen, label)
    _draw_path(axes, table.north_m, table.east_m, cell, FILTER, "filter")
    ends = {"marker": "o", "color": "black", "linestyle": "none", "zorder": 5}
    axes.plot(table.east_m[:1], table.north_m[:1], markerfacecolor="white", markersize=8, label="start", **ends)
    axes.plot(table.east_m[-1:], table.north_m[-1:], markerfacecolor="black", markersize=6, label="end", **ends)

    axes.set_xlim(lowest[1], highest[1])
    axes.set_ylim(lowest[0], highest[0])
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("East [m]")
    axes.set_ylabel("North [m]")
    figure.legend(loc="lower center", ncols=2, columnspacing=3.0)
    return figure


def _view(run: FilterRun, *odometry: OdometryPath | None) -> tuple[Floats, Floats]:
    """Return the least and the greatest (north, east) to show [m], margin included."""
    table = run.table
    lowest = np.array([table.north_m.min(), table.east_m.min()])
    highest = np.array([table.north_m.max(), table.east_m.max()])
    size = max(float((highest - lowest).max()), SMALLEST_VIEW_M)
    low, high = lowest.copy(), highest.copy()
    for path in odometry:
        if path is not None:
            low = np.minimum(low, [path.north_m.min(), path.east_m.min()])
            high = np.maximum(high, [path.north_m.max(), path.east_m.max()])
    low, high = np.maximum(low, lowest - LARGEST_DETOUR * size), np.minimum(high, highest + LARGEST_DETOUR * size)
    margin = 0.04 * max(float((high - low).max()), SMALLEST_VIEW_M)
    return low - margin, high + margin


def _draw_fixes(axes: Axes, run: FilterRun, cell_m: float, lowest: Floats, highest: Floats) -> None:
    fixes, code = run.log.gnss, run.gnss.code
    word = position_word(run)
    for rows, look in (
        (
            np.flatnonzero((code > UNSEEN) & (code != GATED)),
            {"marker": "o", "markersize": 4.5, "markeredgewidth": 0, "color": FIX_COLOR, "label": word},
        ),
        (
            np.flatnonzero(code == GATED),
            {"marker": "x", "markersize": 5, "markeredgewidth": 1.1, "color": BAD_FIX_COLOR, "label": f"{word}, rejected"},
        ),
    ):
        north, east = fixes.north_m[rows], fixes.east_m[rows]
        seen = (north >= lowest[0]) & (north <= highest[0]) & (east >= lowest[1]) & (east <= highest[1])
        shown = np.flatnonzero(seen)[places(north[seen], east[seen], cell_m)]
        if len(rows):
            axes.plot(east[shown], north[shown], linestyle="none", **look)


def _draw_path(axes: Axes, north_m: Floats, east_m: Floats, cell_m: float, pen: Pen, label: str) -> None:
    shown = places(north_m, east_m, cell_m)
    axes.plot(east_m[shown], north_m[shown], label=label, **pen.keywords())
