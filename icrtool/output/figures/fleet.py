"""Figures of a batch: ICRs by robot and date, error by group, failures by reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from icrtool.output.figures.style import add_legend, drawable, logarithmic_errors, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROW_IN = 0.32
LEAST_DAYS = 1.0
"""Shown of the calendar: matplotlib gives a single date four years."""
LONGEST_ROBOT, LONGEST_GROUP, LONGEST_REASON = 24, 24, 40
"""Characters of a label that there is space for."""

COLORS = ("#1b6ca8", "#d95f02", "#1b9e77", "#7570b3", "#a6761d", "#666666")
MARKERS = ("o", "s", "^", "D", "v", "P")


class FleetNumbers(NamedTuple):
    """What the figures of a batch show.

    Attributes
    ----------
    points : the logs with a date and both lateral ICRs, as fleet.json has them
    errors_m : 95 % error after 10 m of each log, by group
    reasons : how many logs failed, by reason
    """

    title: str
    points: Sequence[Mapping[str, Any]]
    errors_m: Mapping[str, Sequence[float]]
    reasons: Mapping[str, int]


@styled
def fleet_icrs(fleet: FleetNumbers) -> Figure:
    """Return both lateral ICRs of every log over its date, ±σ, a colour and marker per robot."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num

    figure = new_figure(
        fleet.title, "final ICRs of every log, ±σ", height_in=5.0, margins_in=(0.85, 0.2, 0.85, 0.95), hspace=0.12
    )  # fmt: skip
    panels = figure.subplots(2, 1, sharex=True)
    for axes, side in zip(panels, ("right", "left"), strict=True):
        for number, robot in enumerate(dict.fromkeys(point["robot"] for point in fleet.points)):
            mine = [point for point in fleet.points if point["robot"] == robot]
            key = f" {drawable(robot or 'robot not named', LONGEST_ROBOT)}"  # matplotlib leaves out "_label"
            when = date2num([np.datetime64(point["start_utc"].rstrip("Z")) for point in mine])  # type: ignore[no-untyped-call]
            axes.errorbar(
                when, [point["icr"][f"y_icr_{side}_m"] for point in mine],
                [point["icr"][f"std_y_icr_{side}_m"] or 0.0 for point in mine],
                linestyle="none", marker=MARKERS[number % len(MARKERS)], color=COLORS[number % len(COLORS)],
                markersize=4.5, capsize=2.0, linewidth=1.0, label=key,
            )  # fmt: skip
        axes.set_ylabel(f"ICR y {side} [m]")
    first, last = panels[-1].get_xlim()
    if last - first < LEAST_DAYS or len({point["start_utc"] for point in fleet.points}) == 1:
        middle = (first + last) / 2
        panels[-1].set_xlim(middle - LEAST_DAYS / 2, middle + LEAST_DAYS / 2)
    locator = AutoDateLocator(minticks=2, maxticks=6)  # type: ignore[no-untyped-call]
    panels[-1].xaxis.set_major_locator(locator)
    panels[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator, show_offset=False))  # type: ignore[no-untyped-call]
    years = sorted({point["start_utc"][:4] for point in fleet.points})
    panels[-1].set_xlabel(f"Date (UTC), {'-'.join(dict.fromkeys((years[0], years[-1])))} [-]")
    add_legend(figure, ncols=4)
    return figure


@styled
def fleet_errors(fleet: FleetNumbers) -> Figure:
    """Return the 95 % error of the ICRs after 10 m of every log by group, the median marked."""
    what = "95 % error after 10 m without GNSS, momentary ICRs; bar: median of the logs"
    labels = [f"{drawable(name, LONGEST_GROUP)} ({len(values)})" for name, values in fleet.errors_m.items()]
    figure, axes = _rows(fleet.title, what, labels, left_in=2.4)
    for row, values in enumerate(fleet.errors_m.values()):
        axes.plot(values, [row] * len(values), linestyle="none", marker="o", markersize=4.5, color=COLORS[0], alpha=0.6)
        axes.plot([float(np.median(values))] * 2, [row - 0.3, row + 0.3], color="black", linewidth=2.0)
    logarithmic_errors(axes)
    return figure


@styled
def fleet_failures(fleet: FleetNumbers) -> Figure:
    """Return how many logs could not be used, by reason."""
    labels = [drawable(reason, LONGEST_REASON) for reason in fleet.reasons]
    figure, axes = _rows(fleet.title, "logs that could not be used, by reason", labels, left_in=3.3)
    axes.barh(range(len(labels)), list(fleet.reasons.values()), height=0.6, color=COLORS[1])
    axes.set_xlabel("Logs [-]")
    axes.locator_params(axis="x", integer=True)
    return figure


def _rows(title: str, what: str, labels: Sequence[str], *, left_in: float) -> tuple[Figure, Axes]:
    """Return a figure with a row for each label, the first one at the top."""
    height_in = 1.7 + ROW_IN * max(len(labels), 2)
    figure = new_figure(title, what, height_in=height_in, margins_in=(left_in, 0.3, 0.85, 0.6))
    axes = figure.subplots()
    axes.set_yticks(range(len(labels)), labels, parse_math=False)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    return figure, axes
