"""Views from above: metres are square, paths are thinned to the pixels, coordinates of a map grid keep short ticks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.output.decimate import places
from icrtool.output.figures.style import BAD_FIX_COLOR, Pen

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

BOX_HEIGHT_IN = (2.4, 5.4)
"""Least and greatest height of the axes of a whole drive."""

SMALLEST_VIEW_M = 0.5
FAR_M = 20_000.0
CELLS = 1500.0
"""Points closer than this fraction of the view are one point: about a pixel."""


JUMP_LOOK: dict[str, Any] = {
    "marker": "s", "markersize": 6.0, "markerfacecolor": "none", "markeredgewidth": 1.0, "color": BAD_FIX_COLOR,
    "linestyle": "none", "zorder": 4.4,
}  # fmt: skip
"""Where the position reference jumps."""


def fitted_box_in(norths: Floats, easts: Floats, width_in: float) -> float:
    """Return the height [in] of axes of a given width that suits points (n,) [m]."""
    north, east = (max(float(np.ptp(column)), SMALLEST_VIEW_M) for column in (norths, easts))
    return float(np.clip(width_in * north / east, *BOX_HEIGHT_IN))


def look_down(axes: Axes, norths: Floats, easts: Floats, shape: float, margin: float = 0.08, ticks: int = 5) -> float:
    """Show all points (n,) [m] in axes `shape` times as wide as high, with a margin; return the side of a cell [m].

    About so many `ticks` are on each axis; 0: none.
    """
    spans = float(np.ptp(norths)), float(np.ptp(easts))
    height = (1 + 2 * margin) * max(spans[0], spans[1] / shape, SMALLEST_VIEW_M)
    for set_range, column, half in ((axes.set_ylim, norths, height / 2), (axes.set_xlim, easts, height * shape / 2)):
        middle = (float(column.min()) + float(column.max())) / 2
        set_range(middle - half, middle + half)
    axes.set_aspect("equal")
    if ticks:
        axes.locator_params(nbins=ticks, steps=[1, 2, 5, 10])
    else:
        axes.set(xticks=[], yticks=[])
    return height * shape / CELLS


def name_directions(axes: Axes) -> None:
    """Name the axes; of coordinates far from zero (UTM) whole kilometres stand in the name, not at each tick."""
    axes.set_xlabel("East [m]" + _short_ticks(axes.xaxis, axes.get_xlim()[0]))
    axes.set_ylabel("North [m]" + _short_ticks(axes.yaxis, axes.get_ylim()[0]))


def draw_path(axes: Axes, north_m: Floats, east_m: Floats, cell_m: float, pen: Pen, **look: Any) -> None:
    """Draw a path (n,), a point for each cell it enters."""
    shown = places(north_m, east_m, cell_m)
    axes.plot(east_m[shown], north_m[shown], **pen.keywords(), **look)


def _short_ticks(axis: Axis, lowest_m: float) -> str:
    from matplotlib.ticker import ScalarFormatter

    if abs(lowest_m) < FAR_M:
        return ""
    formatter = ScalarFormatter()
    offset = float(np.floor(lowest_m / 1000) * 1000)
    formatter.set_useOffset(offset)
    axis.set_major_formatter(formatter)
    axis.get_offset_text().set_visible(False)
    return f"  {'+' if offset > 0 else '−'} {abs(offset):,.0f} m"
