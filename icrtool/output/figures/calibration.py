"""What a calibration corrects: residuals of the windows of driven distance, before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from icrtool.alignment.estimator import ResidualsByEstimate
from icrtool.kernels.arrays import Floats
from icrtool.output.figures.style import ICR, add_legend, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN_PERCENT = 97.0
"""The axes reach as far as this share of the residuals; a few outliers would leave the rest a dot."""

BEFORE: dict[str, Any] = {
    "label": "before: as configured, ICR separation estimated",
    "marker": "s",
    "color": "0.62",
    "markersize": 3.2,
    "linestyle": "none",
    "markeredgewidth": 0.0,
}
AFTER: dict[str, Any] = BEFORE | {"label": "after: calibrated", "marker": "o", "color": ICR.color, "markersize": 2.8}


@styled
def residuals_figure(name: str, residuals: ResidualsByEstimate) -> Figure:
    """Return residuals of displacements and of heading changes over windows, before and after."""
    first, last = (float(np.median(np.hypot(*part))) for part in (residuals.before, residuals.after))
    windows = f"{residuals.before.shape[1]} windows of driven distance, predicted by wheels and heading: residuals"
    figure = new_figure(
        f"Windows of the drive are off by {last:.3f} m calibrated, {first:.3f} m before", f"{name}: {windows}",
        height_in=4.2, margins_in=(0.75, 0.2, 0.7, 1.0), wspace=0.32,
    )  # fmt: skip
    place, turn = figure.subplots(1, 2)
    turns = (residuals.turn_before, residuals.turn_after)
    for part, turned, look in zip((residuals.before, residuals.after), turns, (BEFORE, AFTER), strict=True):
        place.plot(part[1], part[0], **look)
        turn.plot(np.degrees(residuals.turn_rad), np.degrees(turned), **look)
    reach = _reach(np.hypot(*np.concatenate([residuals.before, residuals.after], axis=1)))
    place.set(xlim=(-reach, reach), ylim=(-reach, reach))
    place.set(xlabel="Residual to the right [m]", ylabel="Residual ahead [m]")
    turned = np.degrees(np.concatenate(turns))
    turn.set(xlabel="Heading change measured, clockwise [°]", ylabel="Residual of the heading change [°]")
    turn.set_ylim(-_reach(turned), _reach(turned))
    _label(place, residuals.before, residuals.after, 1.0, "m")
    _label(turn, residuals.turn_before[None], residuals.turn_after[None], float(np.degrees(1.0)), "°")
    add_legend(figure, markerscale=2.0)
    return figure


def _reach(residuals: Floats) -> float:
    return 1.2 * max(float(np.percentile(np.abs(residuals), SHOWN_PERCENT)), 1e-3)


def _label(axes: Axes, before: Floats, after: Floats, factor: float, unit: str) -> None:
    """Write the median size of the residuals above a panel."""
    first, last = (
        factor * float(np.median(np.hypot(*part) if len(part) > 1 else np.abs(part))) for part in (before, after)
    )
    axes.set_title(f"median {first:.3f} {unit} before, {last:.3f} {unit} after", loc="left", pad=5.0)
