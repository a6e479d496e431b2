"""Figures of calibrations (residuals, a forecast, errors on other groups) and of the logs of a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import compress, cycle
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.patches import Circle

from icrtool.kernels.error_statistics import within_budget
from icrtool.output.figures import style
from icrtool.output.figures.labels import Label, write_labels
from icrtool.output.figures.sheet import Sheet, new_sheet, styled
from icrtool.output.figures.trajectory import name_directions
from icrtool.output.series import round_steps
from icrtool.output.text_format import error_text, signed_text
from icrtool.records.acceptance import CHOICE_HORIZON_M
from icrtool.records.calibration_document import ErrorsAt, GroupComparison
from icrtool.records.text import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from icrtool.alignment.estimator import ResidualsByEstimate
    from icrtool.calibration.error_growth import Forecast
    from icrtool.records.fleet_document import FleetLog
    from icrtool.records.run_document import RunDocument

CIRCLES = 5.0
"""Approximate number of circles of errors along the path of a forecast."""

FORECAST_KEY_COLUMNS = 4
"""Number of columns in the legend of a forecast."""

BEYOND_LOOK: style.Look = {"color": style.OUTAGE_COLOR, "linewidth": 0, "zorder": 0.5}
"""Look of the area of distances at which no error was measured."""


@styled
def forecast_figure(
    forecast: Forecast, title: str, budgets_m: tuple[float, ...], measured_m: float, gyro: Forecast | None = None, *,
    document: RunDocument | None = None, ax: Axes | None = None,
) -> Figure | Axes:  # fmt: skip
    """Return the figure of a forecast: errors over distance with the budgets, and the path with circles of errors.

    `document` is the document of the run whose path it is: a run without datum has axes x and y. With None the axes are
    east and north.
    """
    reached = within_budget(forecast.distance_m, forecast.p95_m, budgets_m[0]) if budgets_m else None
    total_m = float(forecast.distance_m[-1])
    answer = f"{error_text(forecast.p95_m[-1])} off (95 %) at the end of {total_m:.0f} m"
    if reached is not None:
        answer = f"Within {budgets_m[0]:g} m (95 %) for {reached[0]:.1f} m, {answer}"
    models_text = "wheels alone" if gyro is None else "wheels alone, and with gyro"
    # The legend has both errors of each forecast, the budgets, and up to four more entries.
    entries = 2 * (1 if gyro is None else 2) + len(budgets_m) + 4
    keys_in = style.KEY_ROW_IN * max(-(-entries // FORECAST_KEY_COLUMNS) - 2, 0)
    height_in, margins_in = 4.5 + keys_in, (0.8, 0.25, 0.75, 1.05 + keys_in)
    layout = {"width_in": 8.2, "height_in": height_in, "wspace": 0.28}
    sheet = new_sheet(
        answer, f"{title}: forecast from the start without GNSS, {models_text}", ax, margins_in=margins_in, **layout
    )
    error_axes, path_axes = sheet.subplots(1, 2)[0]
    for drawn, words, dash in ((forecast, "", {}), (gyro, ", with gyro", {"linestyle": ":"})):
        if drawn is not None:
            error_axes.plot(
                drawn.distance_m, drawn.p95_m, label=f"95 %{words}", **style.ICR | {"linestyle": "-"} | dash
            )
            error_axes.plot(drawn.distance_m, drawn.expected_m, label=f"expected{words}", **style.FILTER | dash)
    for budget in budgets_m:
        error_axes.axhline(budget, label=f"budget {budget:g} m", **style.BUDGET)
    if total_m > measured_m:
        error_axes.axvspan(measured_m, total_m, label=f"beyond {measured_m:g} m: not measured", **BEYOND_LOOK)
    error_axes.set(xlabel="Distance without GNSS [m]", ylabel="Error [m]", xlim=(0.0, total_m), ylim=(0.0, None))
    if reached is not None and not reached[1]:
        error_axes.plot([reached[0]], [budgets_m[0]], zorder=5, **style.spot_look("black", 4.5))
        look: style.Look = {"ha": "right", "va": "bottom", "fontsize": 8.5}
        style.write_near(error_axes, f"{reached[0]:.1f} m", (reached[0], budgets_m[0]), (-3.0, 4.0), **look)
    path_axes.plot(forecast.east_m, forecast.north_m, label="path", **style.HALF_WIDTH | {"linestyle": "-"})
    _draw_error_circles(path_axes, forecast, min(measured_m, total_m))
    path_axes.autoscale_view()
    path_axes.set_aspect("equal", adjustable="datalim")
    name_directions(path_axes, document)
    sheet.legend(ncols=FORECAST_KEY_COLUMNS)
    return sheet.finish()


def _draw_error_circles(axes: Axes, forecast: Forecast, last_m: float) -> None:
    """Draw the circle that holds 95 % of the errors at round distances up to `last_m`, and write the distances."""
    step_m = max(float(min(round_steps(last_m / CIRCLES), key=lambda step: abs(step - last_m / CIRCLES))), 1.0)
    rows = np.flatnonzero(forecast.distance_m <= last_m)
    rows = rows[np.isclose(np.round(forecast.distance_m[rows] / step_m) * step_m, forecast.distance_m[rows])]
    blue = style.ICR["color"]
    positions = [(float(forecast.east_m[row]), float(forecast.north_m[row])) for row in rows]
    # The largest circle is drawn first, below the others.
    for position, row in sorted(zip(positions, rows, strict=True), key=lambda circle: -forecast.p95_m[circle[1]]):
        radius = float(forecast.p95_m[row])
        axes.add_patch(Circle(position, radius, facecolor=blue, alpha=0.13, linewidth=0, zorder=1.5))
        axes.add_patch(Circle(position, radius, fill=False, edgecolor=blue, linewidth=1.0, zorder=2.5))
    axes.plot([], [], label="95 % of the errors by wheels", color=blue, linewidth=1.0)
    start_look: style.Look = style.spot_look("white") | {"label": "start", "zorder": 4}
    axes.plot([forecast.east_m[0]], [forecast.north_m[0]], **start_look)
    if positions:
        axes.plot(*zip(*positions, strict=True), zorder=4, **style.spot_look("black", 3.0))
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    labels = [
        Label(f"{forecast.distance_m[row]:g} m: {error_text(float(forecast.p95_m[row]))}", *position)
        for position, row in zip(positions, rows, strict=True)
    ]
    write_labels(axes, labels, [(forecast.east_m, forecast.north_m)], crossing=True, marks=positions)


SHARES_PCT = (50.0, 95.0)
"""Shares of the windows whose residuals are written [%]."""

REST_SHOWN = 1.3
"""Ratio of the end of the axis of residuals to their 95 % mark."""

LEAST_TURNS = 5
"""Smallest number of windows in a group of heading changes whose median is drawn."""
TURN_GROUPS = 8
"""Number of groups of heading changes, of equal numbers of windows."""

BEFORE_LOOK: style.Look = {"color": "0.45", "linestyle": (0, (6, 2)), "linewidth": 1.5,
                           "label": "before: as configured, ICR separation estimated"}  # fmt: skip
AFTER_LOOK: style.Look = {"color": style.ICR["color"], "linestyle": "-", "linewidth": 1.8, "label": "after: calibrated"}
"""Looks of the residuals before and after a calibration: luminance and dash distinguish them on a grey print."""


@styled
def residuals_figure(name: str, residuals: ResidualsByEstimate, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of residuals of places [m] and headings [deg]: the share of windows below each size.

    Each is drawn before and after the calibration. The third panel has the median residual of the heading change by the
    heading change: a slope is a wrong multiplier.
    """
    off_m = [np.hypot(*part) for part in (residuals.before, residuals.after)]
    turns = [np.degrees(part) for part in (residuals.turn_before, residuals.turn_after)]
    first, last = map(np.median, off_m)
    answer = f"Windows of the drive are off by {last:.3f} m calibrated, {first:.3f} m before"
    windows = f"{residuals.before.shape[1]} windows of driven distance, predicted by wheels and heading"
    layout: style.Look = {"width_in": 8.2, "height_in": 4.0, "margins_in": (0.75, 0.2, 1.0, 0.95), "wspace": 0.4}
    sheet = new_sheet(answer, f"{name}: {windows}", ax, **layout)
    position_axes, heading_axes, turn_axes = sheet.subplots(1, 3)[0]
    looks = BEFORE_LOOK, AFTER_LOOK
    for axes, sizes, unit, measured in (
        (position_axes, off_m, " m", "the place"),
        (heading_axes, [np.abs(part) for part in turns], "°", "the heading change"),
    ):
        for size, look in zip(sizes, looks, strict=True):
            ordered = np.sort(size)
            axes.plot(ordered, 100.0 * np.arange(1, len(ordered) + 1) / max(len(ordered), 1), **look)
        marks = [np.percentile(size, SHARES_PCT) for size in sizes]
        texts = (f"{share:.0f} %: {before:.2f} → {after:.2f}{unit}"
                 for share, before, after in zip(SHARES_PCT, *marks, strict=True))  # fmt: skip
        axes.set_title("\n".join(texts), loc="left", pad=5.0, fontsize=8.5)
        end = max(REST_SHOWN * max(float(mark[-1]) for mark in marks), 1e-3)
        axes.set(xlim=(0.0, end), ylim=(0.0, 100.0), xlabel=f"Residual of {measured} [{unit.strip()}]")
    position_axes.set_ylabel("Windows below [%]")
    heading_axes.tick_params(labelleft=False)
    turned_deg = np.degrees(residuals.turn_rad)
    groups = [windows for windows in np.array_split(np.argsort(turned_deg), TURN_GROUPS) if len(windows) >= LEAST_TURNS]
    for residual, look in zip(turns, looks, strict=True):
        middle = [[float(np.median(column[windows])) for windows in groups] for column in (turned_deg, residual)]
        turn_axes.plot(*middle, marker="o", markersize=3.5, **look)
    turn_axes.axhline(0.0, **style.HALF_WIDTH)
    turn_axes.set(xlabel="Heading change, clockwise [°]", ylabel="Median residual [°]")
    turn_axes.set_title("residual by heading change\n(a slope: wrong multiplier)", loc="left", pad=5.0, fontsize=8.5)
    sheet.legend()
    return sheet.finish()


LONGEST_GROUP_NAME = 12
"""Largest number of characters in the name of a group."""

MOST_DIFFERENCES = 24
"""Largest number of differences that are drawn at all distances. Of more, those after `CHOICE_HORIZON_M` are drawn."""

FOREST_ROW_IN, FOREST_GAP_IN = 0.25, 1.0
"""Height of a row of a forest plot, and of the space between two plots [in]."""

LEAST_LABELS_IN, CHARACTER_IN = 2.0, 0.076
"""Smallest width of the labels left of a forest plot, and usual width of one of their characters [in]."""

SURE_LOOK: style.Look = {"marker": "o", "markersize": 5.0, "color": style.ICR["color"], "linestyle": "none",
                         "elinewidth": 1.8, "capsize": 2.5}  # fmt: skip
CHANCE_LOOK: style.Look = SURE_LOOK | {"markerfacecolor": "white", "color": "0.35", "elinewidth": 1.2}
ALONE_LOOK: style.Look = style.spot_look("white", 6.0, "X", "0.35")
"""Looks of a difference that is shown, of one that may be chance, and of one without an interval."""


class Difference(NamedTuple):
    """A row of a forest plot: words, a number [m], and its 95 % interval [m], which may be None."""

    words: str
    value_m: float
    low_m: float | None
    high_m: float | None


@styled
def transfer(comparison: GroupComparison, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of the 95 % errors of each group by calibration, and of the differences between groups.

    `ax`: axes to draw into, which are returned; by default the picture is a new figure.
    """
    errors, rows = _errors_of_groups(comparison), _differences(comparison)
    names = " · ".join(comparison.groups)
    longest = max((len(difference.words) for difference in (*errors, *rows)), default=0)
    left_in = max(LEAST_LABELS_IN, 0.3 + CHARACTER_IN * longest)
    heights = [max(len(part), 2) for part in (errors, rows)]
    panels_in = FOREST_ROW_IN * sum(heights)
    height_in, hspace = panels_in + FOREST_GAP_IN + 1.85, FOREST_GAP_IN / (panels_in / 2)
    layout: style.Look = {"height_in": height_in, "margins_in": (left_in, 0.25, 0.85, 1.0), "hspace": hspace}
    sheet = new_sheet(
        _comparison_title(comparison), f"{names}: 95 % errors by wheels alone, with 95 % intervals", ax, **layout
    )
    errors_axes, difference_axes = sheet.subplots(2, 1, height_ratios=heights)[:, 0]
    _draw_forest(errors_axes, errors)
    errors_axes.set(xlabel="Error [m]", xlim=(0.0, None))
    errors_axes.set_title(f"95 % error after {CHOICE_HORIZON_M:g} m", loc="left", pad=5.0)
    _draw_forest(difference_axes, rows, about_zero=True)
    difference_axes.set_xlabel("Difference of the 95 % error [m]")
    difference_axes.set_title("Differences: right of 0 is a larger error", loc="left", pad=5.0)
    sheet.legend(columnspacing=2.4)
    return sheet.finish()


def _group(name: str) -> str:
    return style.drawable_text(name, LONGEST_GROUP_NAME)


def _comparison_title(comparison: GroupComparison) -> str:
    """Return the largest difference of two groups after `CHOICE_HORIZON_M`, and whether it may be chance."""
    with_error = [
        (pair, error.p95_m, error)
        for pair in comparison.pairs
        for error in pair.errors
        if error.horizon_m == CHOICE_HORIZON_M and error.p95_m is not None
    ]
    if not with_error:
        return f"No two groups have trials of {CHOICE_HORIZON_M:g} m to compare"
    pair, value_m, error = max(with_error, key=lambda pair_error: abs(pair_error[1]))
    at_m = f"at {CHOICE_HORIZON_M:g} m"
    if error.p95_low_m is None or error.p95_high_m is None:
        return f"{_group(pair.second)}: {signed_text(value_m, 2)} m against {_group(pair.first)} {at_m}, no interval"
    interval = f"({signed_text(error.p95_low_m, 2)} to {signed_text(error.p95_high_m, 2)})"
    if error.p95_low_m <= 0.0 <= error.p95_high_m:
        return f"No difference shown {at_m}: {signed_text(value_m, 2)} m {interval}"
    return f"{_group(pair.second)}: {signed_text(value_m, 2)} m against {_group(pair.first)} {at_m} {interval}"


def _errors_of_groups(comparison: GroupComparison) -> list[Difference]:
    """Return the errors after `CHOICE_HORIZON_M`, by group; its own calibration, which is held out, first."""
    cells = [cell for cell in comparison.transfer if cell.horizon_m == CHOICE_HORIZON_M and cell.p95_m is not None]
    cells.sort(key=lambda cell: (list(comparison.groups).index(cell.tested_on), cell.calibrated_on != cell.tested_on))
    rows = []
    for cell in cells:
        owner = "own" if cell.calibrated_on == cell.tested_on else f"by {_group(cell.calibrated_on)}'s"
        rows.append(
            Difference(
                f"{_group(cell.tested_on)}, {owner} calibration", cell.p95_m or 0.0, cell.p95_low_m, cell.p95_high_m
            )
        )
    return rows


def _differences(comparison: GroupComparison) -> list[Difference]:
    """Return differences between groups with their own calibrations, then the costs of foreign calibrations."""
    rows: list[tuple[ErrorsAt, str]] = [
        (error, f"{_group(pair.second)} − {_group(pair.first)}, {error.horizon_m:g} m")
        for pair in comparison.pairs for error in pair.errors
    ]  # fmt: skip
    rows += [
        (cost, f"{_group(cost.tested_on)}, by {_group(cost.calibrated_on)}'s − own, {cost.horizon_m:g} m")
        for cost in comparison.costs
    ]
    if len(rows) > MOST_DIFFERENCES:
        rows = [(error, words) for error, words in rows if error.horizon_m == CHOICE_HORIZON_M]
    return [
        Difference(words, error.p95_m, error.p95_low_m, error.p95_high_m)
        for error, words in rows
        if error.p95_m is not None
    ]


def _draw_forest(axes: Axes, rows: Sequence[Difference], *, about_zero: bool = False) -> None:
    """Draw numbers with their intervals, in rows; `about_zero`: an interval that holds zero may be chance."""
    for y, row in enumerate(rows):
        if row.low_m is None or row.high_m is None:
            axes.plot([row.value_m], [y], label="no interval: too little path", **ALONE_LOOK)
            continue
        chance = about_zero and row.low_m <= 0.0 <= row.high_m
        look, label = (CHANCE_LOOK, "may be chance: holds 0") if chance else (SURE_LOOK, "with 95 % interval")
        reach = [[max(row.value_m - row.low_m, 0.0)], [max(row.high_m - row.value_m, 0.0)]]
        axes.errorbar([row.value_m], [y], xerr=reach, label=label, **look)
    if about_zero:
        axes.axvline(0.0, **style.HALF_WIDTH)
    axes.set_yticks(range(len(rows)), [row.words for row in rows], parse_math=False)
    axes.set_ylim(max(len(rows), 1) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")


ROW_IN = 0.22
"""Height of the row of a log [in]."""

MOST_CALENDAR_ROWS = 40
"""Largest number of logs that have a row each. More logs are drawn over their dates."""

LEAST_DAYS = 1.0
"""Shortest span of a date axis [days]. matplotlib would show four years for a single date."""

LONGEST_ROBOT, LONGEST_GROUP, LONGEST_LOG = 24, 24, 26
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
    starts_utc : start of each log by its name, where it is known
    intervals_m : 95 % interval of the error of each log by its name, where it is known
    """

    title: str
    points: Sequence[FleetLog]
    errors_m: Mapping[str, Mapping[str, float]]
    model: str
    starts_utc: Mapping[str, str] = MappingProxyType({})
    intervals_m: Mapping[str, tuple[float, float]] = MappingProxyType({})


def _dated(log: str, start_utc: str) -> str:
    """Return the label of a log: its name, and its date where it is known."""
    return f"{style.drawable_text(log, LONGEST_LOG)}   {start_utc[:10]}".rstrip()


@styled
def fleet_icrs(fleet: FleetNumbers, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of both lateral ICRs of every log, ±σ, with a colour and a marker for each robot.

    Up to `MOST_CALENDAR_ROWS` logs have a row each with name and date, in the order of the dates; more are drawn over
    their dates. `ax`: axes to draw into, which are returned; by default the picture is a new figure.
    """
    points = fleet.points
    spans = []
    for side in ("right", "left"):
        icrs_m = [point.icr[f"y_icr_{side}_m"] or 0.0 for point in points]
        spans.append(f"y {side} {signed_text(min(icrs_m), 2)} to {signed_text(max(icrs_m), 2)} m")
    title, subtitle = f"ICRs: {', '.join(spans)}", f"{fleet.title}: of each log, ±1σ"
    if len(points) > MOST_CALENDAR_ROWS:
        sheet = new_sheet(title, subtitle, ax, height_in=5.0, margins_in=(0.85, 0.2, 0.85, 0.95), hspace=0.12)
        _draw_over_dates(sheet, points)
    else:
        height_in = 1.85 + ROW_IN * len(points)
        sheet = new_sheet(title, subtitle, ax, height_in=height_in, margins_in=(3.1, 0.25, 0.65, 1.0), wspace=0.12)
        left, right = panels = sheet.subplots(1, 2, sharey=True)[0]
        ordered = sorted(points, key=lambda point: (point.robot, point.start_utc))
        for axes, side in zip(panels, ("left", "right"), strict=True):
            for robot, look in zip(dict.fromkeys(point.robot for point in ordered), cycle(GROUP_LOOKS), strict=False):
                rows = [row for row, point in enumerate(ordered) if point.robot == robot]
                icrs, stds = (
                    [ordered[row].icr.get(f"{part}y_icr_{side}_m") or 0.0 for row in rows] for part in ("", "std_")
                )
                axes.errorbar(icrs, rows, xerr=stds, markersize=5.0, capsize=2.0, label=_key_of(robot), **look)
            axes.set_xlabel(f"ICR y {side} [m]")
            axes.locator_params(axis="x", nbins=4)
        left.set_yticks(
            range(len(ordered)), [_dated(point.log, point.start_utc) for point in ordered], parse_math=False
        )
        right.tick_params(labelleft=False)
        left.set_ylim(len(ordered) - 0.4, -0.6)
    sheet.legend(ncols=4)
    return sheet.finish()


def _key_of(robot: str) -> str:
    """Return the name of a robot in a legend; matplotlib leaves out a name that begins with an underscore."""
    return f" {style.drawable_text(robot or 'robot not named', LONGEST_ROBOT)}"


def _draw_over_dates(sheet: Sheet, points: Sequence[FleetLog]) -> None:
    """Draw both lateral ICRs of many logs over their dates."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num

    robots = dict.fromkeys(point.robot for point in points)
    icrs = {side: [point.icr[f"y_icr_{side}_m"] or 0.0 for point in points] for side in ("right", "left")}
    panels = sheet.subplots(2, 1, sharex=True)[:, 0]
    days = date2num([np.datetime64(point.start_utc.rstrip("Z")) for point in points])  # type: ignore[no-untyped-call]
    for axes, (side, icrs_of_side) in zip(panels, icrs.items(), strict=True):
        stds = [point.icr.get(f"std_y_icr_{side}_m") or 0.0 for point in points]
        for robot, look in zip(robots, cycle(GROUP_LOOKS), strict=False):
            is_robot = [point.robot == robot for point in points]
            columns = (list(compress(column, is_robot)) for column in (days, icrs_of_side, stds))
            axes.errorbar(*columns, markersize=4.5, capsize=2.0, linewidth=1.0, label=_key_of(robot), **look)
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


class LogError(NamedTuple):
    """The 95 % error of a log of a group after 10 m [m]."""

    group: str
    log: str
    p95_m: float


@styled
def fleet_errors(fleet: FleetNumbers, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of the 95 % error after 10 m [m] of every log by group; of many logs the largest errors.

    `ax`: axes to draw into, which are returned; by default the picture is a new figure.
    """
    errors = [
        LogError(group, log, error)
        for group, logs in fleet.errors_m.items()
        for log, error in sorted(logs.items(), key=lambda named_error: -named_error[1])
    ]
    largest = sorted(errors, key=lambda log_error: -log_error.p95_m)[:MOST_CALENDAR_ROWS]
    shown_errors = [log_error for log_error in errors if log_error in largest]
    cut = f", the {MOST_CALENDAR_ROWS} largest" if len(errors) > MOST_CALENDAR_ROWS else ""
    median = error_text(float(np.median([error for _, _, error in errors])))
    labels = [_dated(log, fleet.starts_utc.get(log, "")) for _, log, _ in shown_errors]
    title = f"After 10 m 95 % stay within {median} in the median of {counted(len(errors), 'log')}"
    known = ", with its 95 % interval" if fleet.intervals_m else ""
    subtitle = f"{fleet.title}: 95 % error after 10 m without GNSS{known}, {fleet.model}{cut}"
    height_in = 1.85 + ROW_IN * len(shown_errors)
    sheet = new_sheet(title, subtitle, ax, height_in=height_in, margins_in=(3.1, 0.7, 0.65, 1.0))
    axes = sheet.subplots()[0, 0]
    axes.set_yticks(range(len(labels)), labels, parse_math=False)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    for (group, logs), look in zip(fleet.errors_m.items(), cycle(GROUP_LOOKS), strict=False):
        rows = [row for row, log_error in enumerate(shown_errors) if log_error.group == group]
        middle = error_text(float(np.median(list(logs.values()))))
        label = f" {style.drawable_text(group, LONGEST_GROUP)}: {counted(len(logs), 'log')}, median {middle}"
        axes.plot([shown_errors[row].p95_m for row in rows], rows, markersize=5.5, label=label, zorder=3, **look)
        for row in rows:
            if (ends := fleet.intervals_m.get(shown_errors[row].log)) is not None:
                axes.plot(ends, [row, row], color=look["color"], linewidth=1.4, marker="|", markersize=6.0)
    centred: style.Look = {"va": "center", "fontsize": 8.0, "annotation_clip": False}
    for row, (_, log, error) in enumerate(shown_errors):
        last = fleet.intervals_m.get(log, (error, error))[1]
        style.write_near(axes, error_text(error), (last, row), (6.0, 0.0), **centred)
    style.logarithmic_errors(axes)
    sheet.legend(ncols=2)
    return sheet.finish()
