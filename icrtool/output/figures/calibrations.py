"""Figures of calibrations (residuals, a forecast, errors on other groups) and of the logs of a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import compress, cycle
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.patches import Circle

from icrtool.kernels.error_statistics import within_budget
from icrtool.output.figures import style
from icrtool.output.figures.trajectory import name_directions
from icrtool.output.text_format import error_text, signed
from icrtool.records.acceptance import CHOICE_HORIZON_M
from icrtool.records.calibration_document import GroupComparison
from icrtool.records.text import counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from icrtool.alignment.estimator import ResidualsByEstimate
    from icrtool.calibration.error_growth import Forecast
    from icrtool.records.fleet_document import FleetLog

CIRCLES = 20

FORECAST_KEY_COLUMNS = 4
"""Number of columns in the legend of a forecast."""


@style.styled
def forecast_figure(
    forecast: Forecast, title: str, budgets_m: tuple[float, ...], measured_m: float, gyro: Forecast | None = None
) -> Figure:
    """Return the figure of a forecast, with a line for each budget and a line where measured errors end."""
    reached = within_budget(forecast.distance_m, forecast.p95_m, budgets_m[0]) if budgets_m else None
    answer = f"{error_text(forecast.p95_m[-1])} off (95 %) at the end of {forecast.distance_m[-1]:.0f} m"
    if reached is not None:
        answer = f"Within {budgets_m[0]:g} m (95 %) for {reached[0]:.1f} m, {answer}"
    by = "wheels alone" if gyro is None else "wheels alone, and with gyro"
    subtitle = f"{title}: forecast error without GNSS from the start: {by}, by the calibration"
    # Of both errors of each forecast, budgets, and up to three more.
    entries = 2 * (1 if gyro is None else 2) + len(budgets_m) + 3
    keys_in = style.KEY_ROW_IN * max(-(-entries // FORECAST_KEY_COLUMNS) - 2, 0)
    height_in, margins_in = 4.2 + keys_in, (0.7, 0.25, 0.75, 0.95 + keys_in)
    figure = style.new_figure(answer, subtitle, width_in=9.0, height_in=height_in, margins_in=margins_in, wspace=0.28)
    grown, path = figure.subplots(1, 2)
    for one, words, dash in ((forecast, "", {}), (gyro, ", with gyro", {"linestyle": ":"})):
        if one is not None:
            grown.plot(one.distance_m, one.p95_m, label=f"95 %{words}", **style.ICR | dash)
            grown.plot(one.distance_m, one.expected_m, label=f"expected{words}", **style.FILTER | dash)
    for budget in budgets_m:
        grown.axhline(budget, label=f"budget {budget:g} m", **style.BUDGET)
    if forecast.distance_m[-1] > measured_m:
        grown.axvline(measured_m, label="measured up to here", **style.MEAN)
    grown.set(xlabel="Distance without GNSS [m]", ylabel="Error [m]", xlim=(0.0, None), ylim=(0.0, None))
    path.plot(forecast.east_m, forecast.north_m, label="path", **style.HALF_WIDTH | {"linestyle": "-"})
    # Circles of extrapolated errors would hide the path.
    measured = np.flatnonzero(forecast.distance_m <= measured_m)
    rows = measured[:: max(len(measured) // CIRCLES, 1)]
    for east, north, radius in zip(forecast.east_m[rows], forecast.north_m[rows], forecast.p95_m[rows], strict=True):
        path.add_patch(
            Circle((float(east), float(north)), float(radius), fill=False, edgecolor=style.ICR["color"], linewidth=0.8)
        )
    path.plot([], [], label=f"95 % of the errors, up to {measured_m:g} m", color=style.ICR["color"], linewidth=0.8)
    path.autoscale_view()
    path.set_aspect("equal", adjustable="datalim")
    name_directions(path)
    style.add_legend(figure, ncols=FORECAST_KEY_COLUMNS)
    return figure


SHOWN_PERCENT = 97.0
"""Percentile of the residuals at which the axes end. Without it a few outliers would shrink the other points to a
dot."""

BEFORE_LOOK: style.Look = style.spot("0.62", 3.2, "s", "0.62") | {
    "markeredgewidth": 0.0,
    "label": "before: as configured, ICR separation estimated",
}
AFTER_LOOK: style.Look = style.spot(style.ICR["color"], 2.8, "o", style.ICR["color"]) | {
    "markeredgewidth": 0.0,
    "label": "after: calibrated",
}


@style.styled
def residuals_figure(name: str, residuals: ResidualsByEstimate) -> Figure:
    """Return residuals of displacements and of heading changes over windows, before and after."""
    places, turns = (residuals.before, residuals.after), (residuals.turn_before, residuals.turn_after)
    off_m = [np.hypot(*part) for part in places]
    off_deg = [np.degrees(np.abs(part)) for part in turns]
    first, last = map(np.median, off_m)
    answer = f"Windows of the drive are off by {last:.3f} m calibrated, {first:.3f} m before"
    windows = f"{residuals.before.shape[1]} windows of driven distance, predicted by wheels and heading: residuals"
    margins_in = (0.75, 0.2, 0.7, 1.0)
    figure = style.new_figure(answer, f"{name}: {windows}", height_in=4.2, margins_in=margins_in, wspace=0.32)
    place, turn = figure.subplots(1, 2)
    for part, turned, look in zip(places, turns, (BEFORE_LOOK, AFTER_LOOK), strict=True):
        place.plot(part[1], part[0], **look)
        turn.plot(np.degrees(residuals.turn_rad), np.degrees(turned), **look)
    for axes, sizes, unit in ((place, off_m, "m"), (turn, off_deg, "°")):
        first, last = map(np.median, sizes)
        axes.set_title(f"median {first:.3f} {unit} before, {last:.3f} {unit} after", loc="left", pad=5.0)
        reach = 1.2 * max(float(np.percentile(np.concatenate(sizes), SHOWN_PERCENT)), 1e-3)
        axes.set_ylim(-reach, reach)
    place.set(xlim=place.get_ylim(), xlabel="Residual to the right [m]", ylabel="Residual ahead [m]")
    turn.set(xlabel="Heading change measured, clockwise [°]", ylabel="Residual of the heading change [°]")
    style.add_legend(figure, markerscale=2.0)
    return figure


LONGEST_CELL_NAME = 14


@style.styled
def transfer(found: GroupComparison) -> Figure:
    """Return the figure: p95 after 10 m, calibrated on row and tested on column; costs with 95 % intervals."""
    names, rows = list(found.groups), [one for one in found.costs if one.p95_m is not None]
    errors = np.full((len(names), len(names)), np.nan)
    for cell in found.transfer:
        if cell.horizon_m == CHOICE_HORIZON_M and cell.p95_m is not None:
            errors[names.index(cell.calibrated_on), names.index(cell.tested_on)] = cell.p95_m
    with_own = np.eye(len(names), dtype=bool)
    # The errors with a calibration of another group, and with its own.
    parts = [part[np.isfinite(part)] for part in (errors[~with_own], errors[with_own])]
    answer = f"No group has a trial of {CHOICE_HORIZON_M:g} m"
    if all(map(len, parts)):
        ends = [(error_text(min(part)).removesuffix(" m"), error_text(max(part)).removesuffix(" m")) for part in parts]
        other, own = (" to ".join(dict.fromkeys(both)) for both in ends)
        answer = f"{other} m off after {CHOICE_HORIZON_M:g} m (95 %) with another's calibration, {own} m with its own"
    subtitle = f"{' · '.join(names)}: on the diagonal each trial is predicted by a fit that does not contain it"
    height_in, margins_in = 2.95 + 0.45 * len(names) + 0.12 * len(rows), (1.3, 0.2, 1.35, 0.75)
    figure = style.new_figure(answer, subtitle, width_in=9.6, height_in=height_in, margins_in=margins_in, wspace=1.15)
    matrix, costs = figure.subplots(1, 2, width_ratios=(1.0, 1.2))
    most = float(np.nanmax(errors)) if np.isfinite(errors).any() else 1.0
    matrix.imshow(errors, cmap="Blues", vmin=0.0, vmax=1.6 * most)
    for (row, column), error in np.ndenumerate(errors):
        text = f"{error:.2f} m" if np.isfinite(error) else "–"
        matrix.text(column, row, text, ha="center", va="center", fontsize=8.5)
    short = [style.drawable(name, LONGEST_CELL_NAME) for name in names]
    matrix.xaxis.tick_top()
    matrix.set_xticks(range(len(names)), short, fontsize=8, parse_math=False, rotation=30, ha="left")
    matrix.set_yticks(range(len(names)), short, fontsize=8, parse_math=False)
    matrix.set_xlabel(f"95 % error after {CHOICE_HORIZON_M:g} m:\ncalibrated on the row, tested on the column")
    matrix.grid(visible=False)
    labels = []
    for y, one in enumerate(rows):
        calibrated, tested = (style.drawable(name, LONGEST_CELL_NAME) for name in (one.calibrated_on, one.tested_on))
        labels.append(f"{calibrated} on {tested}, {one.horizon_m:g} m")
        if one.p95_low_m is not None and one.p95_high_m is not None:
            costs.plot([one.p95_low_m, one.p95_high_m], [y, y], **style.ICR | {"linestyle": "-"})
        costs.plot([one.p95_m], [y], "o", color=style.ICR["color"], markersize=4)
    costs.axvline(0.0, **style.HALF_WIDTH)
    costs.set_yticks(range(len(rows)), labels, fontsize=7.5, parse_math=False)
    costs.invert_yaxis()
    costs.set_xlabel("95 % error more than with its own calibration [m]")
    return figure


ROW_IN = 0.22
MOST_CALENDAR_ROWS = 40
LEAST_DAYS = 1.0
"""Shortest span of a date axis [days]. matplotlib would show four years for a single date."""

LONGEST_ROBOT, LONGEST_GROUP, LONGEST_LOG = 24, 24, 34
"""Largest number of characters in the label of a robot, a group and a log."""

GROUP_LOOKS: tuple[style.Look, ...] = tuple(
    {"linestyle": "none", "marker": marker, "color": color}
    for marker, color in zip("os^DvP", ("#1b6ca8", "#d95f02", "#1b9e77", "#7570b3", "#a6761d", "#666666"), strict=True)
)
"""Colours and markers of robots or groups, in turn."""


class FleetNumbers(NamedTuple):
    """Numbers in the figures of a batch.

    Attributes
    ----------
    points : the logs with a date and both lateral ICRs
    errors_m : 95 % error after 10 m of each log, by group and name
    model : the model of these errors
    """

    title: str
    points: Sequence[FleetLog]
    errors_m: Mapping[str, Mapping[str, float]]
    model: str


@style.styled
def fleet_icrs(fleet: FleetNumbers) -> Figure:
    """Return both lateral ICRs of every log over its date, ±σ, a colour and marker per robot."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num

    points, robots = fleet.points, dict.fromkeys(point.robot for point in fleet.points)
    icrs = {side: [point.icr[f"y_icr_{side}_m"] or 0.0 for point in points] for side in ("right", "left")}
    spans = (f"y {side} {signed(min(found), 2)} to {signed(max(found), 2)} m" for side, found in icrs.items())
    title, subtitle = f"ICRs: {', '.join(spans)}", f"{fleet.title}: of each log, ±σ"
    figure = style.new_figure(title, subtitle, height_in=5.0, margins_in=(0.85, 0.2, 0.85, 0.95), hspace=0.12)
    panels = figure.subplots(2, 1, sharex=True)
    days = date2num([np.datetime64(point.start_utc.rstrip("Z")) for point in points])  # type: ignore[no-untyped-call]
    for axes, (side, found) in zip(panels, icrs.items(), strict=True):
        stds = [point.icr.get(f"std_y_icr_{side}_m") or 0.0 for point in points]
        for robot, look in zip(robots, cycle(GROUP_LOOKS), strict=False):
            key = f" {style.drawable(robot or 'robot not named', LONGEST_ROBOT)}"  # matplotlib leaves out "_label"
            mine = [point.robot == robot for point in points]
            columns = (list(compress(column, mine)) for column in (days, found, stds))
            axes.errorbar(*columns, markersize=4.5, capsize=2.0, linewidth=1.0, label=key, **look)
        axes.set_ylabel(f"ICR y {side} [m]")
    first, last = panels[-1].get_xlim()
    if last - first < LEAST_DAYS or len(set(days)) == 1:
        middle = (first + last) / 2
        panels[-1].set_xlim(middle - LEAST_DAYS / 2, middle + LEAST_DAYS / 2)
    locator = AutoDateLocator(minticks=2, maxticks=6)  # type: ignore[no-untyped-call]
    panels[-1].xaxis.set_major_locator(locator)
    panels[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator, show_offset=False))  # type: ignore[no-untyped-call]
    years = sorted({point.start_utc[:4] for point in points})
    panels[-1].set_xlabel(f"Date, UTC, {' to '.join(dict.fromkeys((years[0], years[-1])))}")
    style.add_legend(figure, ncols=4)
    return figure


@style.styled
def fleet_errors(fleet: FleetNumbers) -> Figure:
    """Return the 95 % error after 10 m [m] of every log, a row a log, by group; of many logs the largest errors."""
    errors = [
        (group, log, error)
        for group, logs in fleet.errors_m.items()
        for log, error in sorted(logs.items(), key=lambda one: -one[1])
    ]
    largest = sorted(errors, key=lambda one: -one[2])[:MOST_CALENDAR_ROWS]
    shown = [one for one in errors if one in largest]
    cut = f", the {MOST_CALENDAR_ROWS} largest" if len(errors) > MOST_CALENDAR_ROWS else ""
    median = error_text(float(np.median([error for *_, error in errors])))
    labels = [style.drawable(log, LONGEST_LOG) for _, log, _ in shown]
    title = f"After 10 m 95 % stay within {median} in the median of {counted(len(errors), 'log')}"
    subtitle = f"{fleet.title}: 95 % error after 10 m without GNSS, {fleet.model}{cut}"
    height_in = 1.9 + ROW_IN * len(shown)
    figure = style.new_figure(title, subtitle, height_in=height_in, margins_in=(2.9, 0.7, 0.65, 1.05))
    axes = figure.subplots()
    axes.set_yticks(range(len(labels)), labels, parse_math=False)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    for (group, logs), look in zip(fleet.errors_m.items(), cycle(GROUP_LOOKS), strict=False):
        rows = [row for row, one in enumerate(shown) if one[0] == group]
        middle = error_text(float(np.median(list(logs.values()))))
        label = f" {style.drawable(group, LONGEST_GROUP)}: {counted(len(logs), 'log')}, median {middle}"
        axes.plot([shown[row][2] for row in rows], rows, markersize=5.5, label=label, **look)
    centred: style.Look = {"va": "center", "fontsize": 8.0, "annotation_clip": False, "bbox": None}
    for row, (*_, error) in enumerate(shown):
        style.write_near(axes, error_text(error), (error, row), (6.0, 0.0), **centred)
    style.logarithmic_errors(axes)
    style.add_legend(figure, ncols=2)
    return figure
