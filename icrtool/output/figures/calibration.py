"""What a calibration takes away: misses of the windows of way before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D

from icrtool.calibration.findings import Calibration
from icrtool.output.figures.style import ICR, inches, new_figure
from icrtool.records.tables import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN, HEIGHT_IN = 7.2, 4.2
SHOWN_PERCENT = 97.0
"""The axes reach as far as this share of the misses; a few strays would leave the rest a dot."""

BEFORE: dict[str, Any] = {
    "marker": "s",
    "color": "0.62",
    "markersize": 3.2,
    "linestyle": "none",
    "markeredgewidth": 0.0,
}
AFTER: dict[str, Any] = {
    "marker": "o",
    "color": ICR.color,
    "markersize": 2.8,
    "linestyle": "none",
    "markeredgewidth": 0.0,
}


def draw_calibration(calibration: Calibration) -> Figure:
    """Draw where windows of way miss the fixes, and how much their turns miss the heading, before and after."""
    misses = calibration.residuals
    figure = new_figure(
        calibration.name,
        f"{calibration.windows} windows of way, predicted by wheels and heading: what is left",
        width_in=WIDTH_IN,
        height_in=HEIGHT_IN,
    )
    place, turn = figure.subplots(1, 2)
    figure.subplots_adjust(**inches(figure, left=0.75, right=0.2, top=0.7, bottom=1.0), wspace=0.32)
    for part, look in ((misses.before, BEFORE), (misses.after, AFTER)):
        place.plot(part[1], part[0], **look)
        turn.plot(np.degrees(misses.turn_rad), np.degrees(part[2]), **look)
    reach = _reach(np.hypot(*np.concatenate([misses.before[:2], misses.after[:2]], axis=1)))
    place.set_xlim(-reach, reach)
    place.set_ylim(-reach, reach)
    place.set_xlabel("Miss to the right [m]")
    place.set_ylabel("Miss ahead [m]")
    turned = np.degrees(np.concatenate([misses.before[2], misses.after[2]]))
    turn.set_ylim(-_reach(turned), _reach(turned))
    turn.set_xlabel("Turn measured, clockwise [°]")
    turn.set_ylabel("Miss of the turn [°]")
    _say(place, misses.before[:2], misses.after[:2], 1.0, "m")
    _say(turn, misses.before[2:], misses.after[2:], float(np.degrees(1.0)), "°")
    keys = [
        Line2D([], [], label="as configured, with the W found", **BEFORE | {"markersize": 6}),
        Line2D([], [], label="calibrated", **AFTER | {"markersize": 6}),
    ]
    figure.legend(handles=keys, loc="lower center", ncols=2, columnspacing=3.0)
    return figure


def _reach(misses: Floats) -> float:
    return 1.2 * max(float(np.percentile(np.abs(misses), SHOWN_PERCENT)), 1e-3)


def _say(axes: Axes, before: Floats, after: Floats, factor: float, unit: str) -> None:
    """Say the median length of the misses above a panel."""
    first, last = (
        factor * float(np.median(np.hypot(*part) if len(part) > 1 else np.abs(part))) for part in (before, after)
    )
    axes.set_title(f"median {first:.3f} {unit} before, {last:.3f} {unit} after", loc="left", pad=5.0)
