"""Figures of calibrations: residuals of an alignment, a forecast, and what one costs in the runs of another."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import Circle

from icrtool.kernels.arrays import Floats
from icrtool.kernels.error_statistics import within_budget
from icrtool.output.figures import style
from icrtool.records.calibration_document import GroupComparison
from icrtool.records.dropout import CHOICE_HORIZON_M

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from icrtool.alignment.estimator import ResidualsByEstimate
    from icrtool.calibration.error_growth import Forecast

CIRCLES = 20


@style.styled
def forecast_figure(
    forecast: Forecast, title: str, budgets_m: tuple[float, ...], measured_m: float, gyro: Forecast | None = None
) -> Figure:
    """Return the figure of a forecast; a dashed line for each budget, and where the calibration's errors end."""
    reached = within_budget(forecast.distance_m, forecast.p95_m, budgets_m[0]) if budgets_m else None
    answer = f"{forecast.p95_m[-1]:.2f} m off (95 %) at the end of {forecast.distance_m[-1]:.0f} m"
    if reached is not None:
        answer = f"Within {budgets_m[0]:g} m (95 %) for {reached[0]:.1f} m, {answer}"
    by = "wheels alone" if gyro is None else "wheels alone, and with gyro"
    subtitle = f"{title}: forecast error without GNSS from the start: {by}, by the calibration"
    margins_in = (0.7, 0.25, 0.75, 0.95)
    figure = style.new_figure(answer, subtitle, width_in=9.0, height_in=4.2, margins_in=margins_in, wspace=0.28)
    grown, path = figure.subplots(1, 2)
    for one, words, dash in ((forecast, "", {}), (gyro, ", with gyro", {"linestyle": ":"})):
        if one is not None:
            grown.plot(one.distance_m, one.p95_m, label=f"95 %{words}", **style.ICR | dash)
            grown.plot(one.distance_m, one.expected_m, label=f"expected{words}", **style.FILTER | dash)
    for budget in budgets_m:
        grown.axhline(budget, label=f"budget {budget:g} m", **style.CHANGE)
    if forecast.distance_m[-1] > measured_m:
        grown.axvline(measured_m, label="measured up to here", **style.MEAN)
    grown.set(xlabel="Distance without GNSS [m]", ylabel="Error [m]", xlim=(0.0, None), ylim=(0.0, None))
    path.plot(forecast.east_m, forecast.north_m, label="path", **style.HALF_WIDTH | {"linestyle": "-"})
    # Where the forecast is extrapolated its circles would bury the path.
    measured = np.flatnonzero(forecast.distance_m <= measured_m)
    rows = measured[:: max(len(measured) // CIRCLES, 1)]
    for east, north, radius in zip(forecast.east_m[rows], forecast.north_m[rows], forecast.p95_m[rows], strict=True):
        path.add_patch(
            Circle((float(east), float(north)), float(radius), fill=False, edgecolor=style.ICR["color"], linewidth=0.8)
        )
    path.plot([], [], label=f"95 % of the errors, up to {measured_m:g} m", color=style.ICR["color"], linewidth=0.8)
    path.autoscale_view()
    path.set_aspect("equal", adjustable="datalim")
    path.set(xlabel="East [m]", ylabel="North [m]")
    figure.legend(ncols=4)
    return figure


SHOWN_PERCENT = 97.0
"""The axes reach as far as this share of the residuals; a few outliers would leave the rest a dot."""

BEFORE: style.Look = {
    "label": "before: as configured, ICR separation estimated",
    "marker": "s",
    "color": "0.62",
    "markersize": 3.2,
    "linestyle": "none",
    "markeredgewidth": 0.0,
}
AFTER: style.Look = BEFORE | {
    "label": "after: calibrated",
    "marker": "o",
    "color": style.ICR["color"],
    "markersize": 2.8,
}


@style.styled
def residuals_figure(name: str, residuals: ResidualsByEstimate) -> Figure:
    """Return residuals of displacements and of heading changes over windows, before and after."""
    first, last = (float(np.median(np.hypot(*part))) for part in (residuals.before, residuals.after))
    answer = f"Windows of the drive are off by {last:.3f} m calibrated, {first:.3f} m before"
    windows = f"{residuals.before.shape[1]} windows of driven distance, predicted by wheels and heading: residuals"
    figure = style.new_figure(
        answer, f"{name}: {windows}", height_in=4.2, margins_in=(0.75, 0.2, 0.7, 1.0), wspace=0.32
    )
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
    style.add_legend(figure, markerscale=2.0)
    return figure


def _reach(residuals: Floats) -> float:
    return 1.2 * max(float(np.percentile(np.abs(residuals), SHOWN_PERCENT)), 1e-3)


def _label(axes: Axes, before: Floats, after: Floats, factor: float, unit: str) -> None:
    """Write the median size of the residuals above a panel."""
    first, last = (
        factor * float(np.median(np.hypot(*part) if len(part) > 1 else np.abs(part))) for part in (before, after)
    )
    axes.set_title(f"median {first:.3f} {unit} before, {last:.3f} {unit} after", loc="left", pad=5.0)


LONGEST_NAME = 14


@style.styled
def transfer(found: GroupComparison) -> Figure:
    """Return the figure: p95 after 10 m, calibrated on row and tested on column; costs with 95 % intervals."""
    names, rows = list(found.groups), [one for one in found.costs if one.p95_m is not None]
    subtitle = f"{' · '.join(names)}: on the diagonal each trial is predicted by a fit that does not contain it"
    height_in, margins_in = 2.95 + 0.45 * len(names) + 0.12 * len(rows), (1.3, 0.2, 1.35, 0.75)
    figure = style.new_figure(
        _answer(found), subtitle, width_in=9.6, height_in=height_in, margins_in=margins_in, wspace=1.15
    )
    matrix, costs = figure.subplots(1, 2, width_ratios=(1.0, 1.2))
    _draw_matrix(matrix, found, names)
    labels = []
    for y, one in enumerate(rows):
        calibrated, tested = (style.drawable(name, LONGEST_NAME) for name in (one.calibrated_on, one.tested_on))
        labels.append(f"{calibrated} on {tested}, {one.horizon_m:g} m")
        if one.p95_low_m is not None and one.p95_high_m is not None:
            costs.plot([one.p95_low_m, one.p95_high_m], [y, y], **style.ICR | {"linestyle": "-"})
        costs.plot([one.p95_m], [y], "o", color=style.ICR["color"], markersize=4)
    costs.axvline(0.0, **style.HALF_WIDTH)
    costs.set_yticks(range(len(rows)), labels, fontsize=7.5, parse_math=False)
    costs.invert_yaxis()
    costs.set_xlabel("95 % error more than with its own calibration [m]")
    return figure


def _answer(found: GroupComparison) -> str:
    """Return the errors with a calibration of another group, and with its own."""
    cells = [one for one in found.transfer if one.horizon_m == CHOICE_HORIZON_M]
    own = [one.p95_m for one in cells if one.p95_m is not None and one.calibrated_on == one.tested_on]
    other = [one.p95_m for one in cells if one.p95_m is not None and one.calibrated_on != one.tested_on]
    if not (own and other):
        return f"No group has a trial of {CHOICE_HORIZON_M:g} m"
    spans = [" to ".join(dict.fromkeys((f"{min(errors):.2f}", f"{max(errors):.2f}"))) for errors in (other, own)]
    return f"{spans[0]} m off after {CHOICE_HORIZON_M:g} m (95 %) with another's calibration, {spans[1]} m with its own"


def _draw_matrix(axes: Axes, found: GroupComparison, names: list[str]) -> None:
    values = np.full((len(names), len(names)), np.nan)
    for cell in found.transfer:
        if cell.horizon_m == CHOICE_HORIZON_M and cell.p95_m is not None:
            values[names.index(cell.calibrated_on), names.index(cell.tested_on)] = cell.p95_m
    most = float(np.nanmax(values)) if np.isfinite(values).any() else 1.0
    axes.imshow(values, cmap="Blues", vmin=0.0, vmax=1.6 * most)
    for row, column in np.ndindex(values.shape):
        text = f"{values[row, column]:.2f} m" if np.isfinite(values[row, column]) else "–"
        axes.text(column, row, text, ha="center", va="center", fontsize=8.5)
    short = [style.drawable(name, LONGEST_NAME) for name in names]
    axes.xaxis.tick_top()
    axes.set_xticks(range(len(names)), short, fontsize=8, parse_math=False, rotation=30, ha="left")
    axes.set_yticks(range(len(names)), short, fontsize=8, parse_math=False)
    axes.set_xlabel(f"95 % error after {CHOICE_HORIZON_M:g} m:\ncalibrated on the row, tested on the column")
    axes.grid(visible=False)
