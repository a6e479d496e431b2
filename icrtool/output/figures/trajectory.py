"""The trajectory: fixes, filter, and the paths by wheel speeds alone (Pentzer 2014, Fig. 14)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from icrtool.alignment.gnss_quality import CLASSES, REFERENCE
from icrtool.estimation.odometry import OdometryName, OdometryPath, drive_wheels, odometry_icrs
from icrtool.kernels.arrays import Floats
from icrtool.output.figures import style
from icrtool.output.figures.labels import Label, write_labels
from icrtool.output.figures.sheet import new_sheet, styled
from icrtool.output.series import rows_entering_cells
from icrtool.output.text_format import PATH_WORDS, direction_words, driven_text, error_text, position_word, run_title
from icrtool.records.run import Run
from icrtool.records.run_document import RunDocument
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, OTHER_FIX
from icrtool.records.tables import States
from icrtool.records.text import distance_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PATH_MARGINS_IN = (0.75, 0.2, 0.65, 1.45)
"""Left, right, top and bottom of the axes [in]."""

LARGEST_DETOUR = 0.75
"""Distance outside the filter's path to which odometry is shown, in sizes of this path. Further parts are cut off."""

SMALLEST_DRIVE_M = 2.0
"""Smallest size of the filter's path for the limit of shown odometry [m]."""

TIME_STEPS_S = (5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0, 7200.0, 14400.0)
"""Intervals between the times that are written at the path [s]; the first that gives few enough is used."""

MOST_TIMES = 12
"""Largest number of times that are written at the path."""

MOST_MARKED_JUMPS = 5
"""Largest number of marked jumps of the reference."""

REJECTED_CELLS = 40.0
"""Number of cells across the view in which rejected fixes share one cross."""

MOST_REJECTED = 60
"""Largest number of crosses of rejected fixes. More crosses would hide the path."""

TIME_CLEARANCE = 0.06
"""Smallest distance between two times that are written at the path, as a share of the view."""

TIME_PT = 7.5
"""Size of these times [points]."""
TIME_NEAR_PT = 22.0
"""Largest distance between a time and its place [points]."""

Corners = tuple[Floats, Floats]
"""Least and greatest (north, east) [m]."""

_DOT: style.Look = {"marker": "o", "markersize": 3.6, "markeredgewidth": 0, "color": style.FIX_COLOR}
FIX_LOOKS: dict[int, style.Look] = {
    REFERENCE: _DOT,
    FIXED_FIX: _DOT,
    FLOAT_FIX: {"marker": "^", "markersize": 3.4, "markeredgewidth": 0, "color": style.FLOAT_COLOR},
    OTHER_FIX: {"marker": "+", "markersize": 4.0, "color": "0.45"},
}
"""Markers of used fixes, by class."""

SLIP_LOOK: style.Look = style.spot_look("none", 6.5, "D", style.FLOAT_COLOR) | {"markeredgewidth": 1.6, "zorder": 4.6}
"""Marker of the start of a slip event."""

REJECTED_LOOK: style.Look = {"marker": "x", "markersize": 3.6, "markeredgewidth": 0.7, "color": style.BAD_FIX_COLOR}
"""Marker of rejected fixes. Shape and luminance distinguish the markers of all classes."""

ODOMETRIES: dict[OdometryName, tuple[str, str, int]] = {
    "icr": ("icr_final", "final ICRs", 3),
    "icr_momentary": ("icr", "momentary", 2),
    "no_slip": ("no_slip", "no slip", 1),
}
"""Row whose pen draws the path that is computed from wheel speeds alone, words for its ICRs, and its order."""

MOST_STATES = 500_000
"""Largest number of states of a drawn path of wheels alone: every state of 1 h at 100 Hz, one in 0.1 s of 10 h."""


@styled
def trajectory(run: Run, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of fixes, filter, and odometry with final ICRs, momentary ICRs and without slip [m].

    `ax`: axes to draw into, which are returned; by default the picture is a new figure.
    """
    table = run.table
    every = -(-len(table) // MOST_STATES)
    odometries = odometry_icrs(table, run.track_width_m)
    paths = {name: drive_wheels(table, run.in_gap, icrs, every) for name, icrs in odometries.items()}
    low, high = _corners(table)
    detour = LARGEST_DETOUR * max(float((high - low).max()), SMALLEST_DRIVE_M)
    lows, highs = zip((low, high), *map(_corners, paths.values()), strict=True)
    norths, easts = np.column_stack(
        [np.maximum(np.min(lows, axis=0), low - detour), np.minimum(np.max(highs, axis=0), high + detour)]
    )
    width_in = style.WIDTH_IN - PATH_MARGINS_IN[0] - PATH_MARGINS_IN[1]
    box_in = fitted_box_in(norths, easts, width_in)
    end_errors = [f"{ODOMETRIES[name][1]} {distance_text(path.end_error_m)}" for name, path in paths.items()]
    title = f"Wheels end off: {', '.join(end_errors)}"
    subtitle = f"{run_title(run.document)}: {driven_text(run.document.drive)}"
    height_in = box_in + PATH_MARGINS_IN[2] + PATH_MARGINS_IN[3]
    sheet = new_sheet(title, subtitle, ax, height_in=height_in, margins_in=PATH_MARGINS_IN)
    axes = sheet.subplots()[0, 0]
    cell = show_from_above(axes, norths, easts, margin=0.04, ticks=9)
    lowest, highest = np.column_stack([axes.get_ylim(), axes.get_xlim()])
    _draw_fixes(axes, run, cell, lowest, highest)
    draw_path(axes, table.north_m, table.east_m, cell, style.FILTER, label="filter", zorder=4)
    drawn = [(table.east_m, table.north_m)]
    pens = style.row_pens(row for row, *_ in ODOMETRIES.values())
    for name, path in paths.items():
        drawn.append((path.east_m, path.north_m))
        (low, high), (row, _, order) = _corners(path), ODOMETRIES[name]
        pen = pens[row]
        leaves = " (out of view)" if (low < lowest).any() or (high > highest).any() else ""
        label = f"{PATH_WORDS[name]}, ends {distance_text(path.end_error_m)} off{leaves}"
        draw_path(axes, path.north_m, path.east_m, cell, pen, label=label, zorder=order)
        # Copies are kept, because views would keep the whole path in memory.
        ends_m = path.east_m[-1:].copy(), path.north_m[-1:].copy()
        axes.plot(*ends_m, marker="D", color=pen["color"], markersize=5.0, zorder=4.8)
    _draw_jumps(axes, run)
    # A slip event is drawn as the filter's path through it, with a mark at its start.
    for event in run.sensors.events:
        rows = (table.stamp_ns >= event.begin_ns) & (table.stamp_ns <= event.end_ns)
        if rows.any():
            east, north = table.east_m[rows], table.north_m[rows]
            axes.plot(east, north, color=style.FLOAT_COLOR, linewidth=3.0, zorder=4.5)
            axes.plot(east[:1], north[:1], label="slip event", **SLIP_LOOK)
    axes.plot(table.east_m[:1], table.north_m[:1], zorder=5, label="start", **style.spot_look("white", 8.0))
    axes.plot(table.east_m[-1:], table.north_m[-1:], zorder=5, label="end", **style.spot_look("black", 6.0))
    _write_times(axes, run, cell, drawn)
    name_directions(axes, run.document)
    sheet.legend(ncols=2, columnspacing=3.0)
    return sheet.finish()


def _corners(path: States | OdometryPath) -> Corners:
    """Return the least and the greatest (north, east) of a path [m]."""
    north, east = path.north_m, path.east_m
    return np.array([north.min(), east.min()]), np.array([north.max(), east.max()])


def _draw_fixes(axes: Axes, run: Run, cell_m: float, lowest: Floats, highest: Floats) -> None:
    """Draw the fixes in view: used fixes by class, and rejected fixes."""
    fixes, word, gnss = run.sensors.fixes, position_word(run.document), run.gnss
    several = len(np.unique(fixes.fix_class)) > 1
    groups = [
        (gnss.used & (fixes.fix_class == value), look, f"{word}, {CLASSES[value]}" if several else word)
        for value, look in FIX_LOOKS.items()
    ]
    place = np.column_stack([fixes.north_m, fixes.east_m])
    in_view = ((place >= lowest) & (place <= highest)).all(axis=1)
    rejected = gnss.rejected, REJECTED_LOOK, f"{word}, {np.count_nonzero(gnss.rejected):,} rejected"
    for chosen, look, label in (*groups, rejected):
        if chosen.any():
            north, east = place[chosen & in_view].T
            drawn_rows = rows_entering_cells(
                north, east, cell_m if look is not REJECTED_LOOK else cell_m * CELLS_A_VIEW / REJECTED_CELLS
            )
            if look is REJECTED_LOOK:
                drawn_rows = drawn_rows[:: 1 + len(drawn_rows) // MOST_REJECTED]
            axes.plot(east[drawn_rows], north[drawn_rows], linestyle="none", zorder=1.5, label=label, **look)


def _draw_jumps(axes: Axes, run: Run) -> None:
    """Mark the largest jumps of the reference, each at the position before the jump."""
    jumps = [jump for jump in run.sensors.jumps if not jump.undecided]
    largest = sorted(jumps, key=lambda jump: -jump.size_m)[:MOST_MARKED_JUMPS]
    if largest:
        marked = f", the {MOST_MARKED_JUMPS} largest of {len(jumps)} marked" if len(jumps) > MOST_MARKED_JUMPS else ""
        east, north = [jump.east_m for jump in largest], [jump.north_m for jump in largest]
        axes.plot(east, north, label=f"jump, up to {error_text(largest[0].size_m)}{marked}", **JUMP_LOOK)


def _write_times(axes: Axes, run: Run, cell_m: float, drawn: Sequence[tuple[Floats, Floats]]) -> None:
    """Mark the filter's path at round intervals, and write the time where it covers no drawn path (east, north)."""
    table = run.table
    span = float(table.t_s[-1])
    every = next((step for step in TIME_STEPS_S if span / step <= MOST_TIMES), TIME_STEPS_S[-1])
    clear = TIME_CLEARANCE * cell_m * CELLS_A_VIEW
    ends = [(float(table.east_m[row]), float(table.north_m[row])) for row in (0, -1)]
    written, labels = list(ends), []
    for time in np.arange(every, span, every):
        row = int(np.searchsorted(table.t_s, time))
        position = float(table.east_m[row]), float(table.north_m[row])
        if min(math.dist(position, other) for other in written) > clear:
            written.append(position)
            text = f"{time:.0f} s" if every < 60 else f"{time / 60:.0f} min" if every < 3600 else f"{time / 3600:.0f} h"
            labels.append(Label(text, *position))
    look: style.Look = {"marks": ends, "size_pt": TIME_PT, "farthest_pt": TIME_NEAR_PT, "color": "0.25"}
    for _, *shown, _ in write_labels(axes, labels, drawn, **look):
        axes.plot(*shown, marker="|", color="black", markersize=7.0, zorder=4.7)


BOX_HEIGHT_IN = (2.4, 5.4)
"""Smallest and largest height of the axes of a whole drive [in]."""

SMALLEST_VIEW_M = 0.5
"""Smallest size of a view [m]."""

FAR_M = 20_000.0
"""Coordinate from which on whole kilometres stand in the name of the axis [m]."""

CELLS_A_VIEW = 1500.0
"""Number of cells across the view. Points in one cell, about a pixel, are drawn as one point."""


JUMP_LOOK: style.Look = style.spot_look("none", 6.0, "s", style.BAD_FIX_COLOR) | {"zorder": 4.4}
"""Marker of a jump of the position reference."""


def fitted_box_in(norths: Floats, easts: Floats, width_in: float) -> float:
    """Return the height [in] of axes of a given width that suits points (n,) [m]."""
    north, east = (max(float(np.ptp(column)), SMALLEST_VIEW_M) for column in (norths, easts))
    return float(np.clip(width_in * north / east, *BOX_HEIGHT_IN))


def show_from_above(axes: Axes, norths: Floats, easts: Floats, margin: float = 0.08, ticks: int = 5) -> float:
    """Show all points (n,) [m] with a margin and one scale for both directions; return the side of a cell [m].

    `ticks` is the approximate number of ticks on each axis; 0: none.
    """
    spans = float(np.ptp(norths)), float(np.ptp(easts))
    shape = axes.bbox.width / axes.bbox.height
    height = (1 + 2 * margin) * max(spans[0], spans[1] / shape, SMALLEST_VIEW_M)
    for set_range, column, half in ((axes.set_ylim, norths, height / 2), (axes.set_xlim, easts, height * shape / 2)):
        middle = (float(column.min()) + float(column.max())) / 2
        set_range(middle - half, middle + half)
    axes.set_aspect("equal")
    if ticks:
        axes.locator_params(nbins=ticks, steps=[1, 2, 5, 10])
    else:
        axes.set(xticks=[], yticks=[])
    return height * shape / CELLS_A_VIEW


def name_directions(axes: Axes, document: RunDocument | None = None) -> None:
    """Name the axes; for coordinates far from zero (UTM) the whole kilometres are in the name, not at each tick.

    Parameters
    ----------
    document : of the run whose frame it is; a frame without datum has axes x and y and no known north. None: of a path
        with east and north
    """
    from matplotlib.ticker import ScalarFormatter

    across, up = direction_words(document)
    for name, axis, (lowest_m, _) in ((across, axes.xaxis, axes.get_xlim()), (up, axes.yaxis, axes.get_ylim())):
        offset, counted_from = float(np.floor(lowest_m / 1000) * 1000), ""
        if abs(lowest_m) >= FAR_M:
            formatter = ScalarFormatter()
            formatter.set_useOffset(offset)
            axis.set_major_formatter(formatter)
            axis.get_offset_text().set_visible(False)
            counted_from = f"  {'+' if offset > 0 else '−'} {abs(offset):,.0f} m"
        axis.set_label_text(f"{name} [m]{counted_from}")


def draw_path(axes: Axes, north_m: Floats, east_m: Floats, cell_m: float, pen: style.Look, **look: Any) -> None:
    """Draw a path (n,), with a point for each cell that it enters."""
    rows = rows_entering_cells(north_m, east_m, cell_m)
    axes.plot(east_m[rows], north_m[rows], **pen, **look)
