"""Figures of a batch: ICRs by robot and date, error by log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from icrtool.output.figures import style
from icrtool.output.text_format import error_text
from icrtool.records.text import counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from icrtool.records.fleet_document import FleetLog

ROW_IN = 0.22
MOST_ROWS = 40
LEAST_DAYS = 1.0
"""Shown of the calendar: matplotlib gives a single date four years."""
LONGEST_ROBOT, LONGEST_GROUP, LONGEST_LOG = 24, 24, 34
"""Characters of a label that there is space for."""

COLORS = ("#1b6ca8", "#d95f02", "#1b9e77", "#7570b3", "#a6761d", "#666666")
MARKERS = ("o", "s", "^", "D", "v", "P")


class FleetNumbers(NamedTuple):
    """What the figures of a batch show.

    Attributes
    ----------
    points : the logs with a date and both lateral ICRs
    errors_m : 95 % error after 10 m of each log, by group and name
    model : whose errors they are
    """

    title: str
    points: Sequence[FleetLog]
    errors_m: Mapping[str, Mapping[str, float]]
    model: str


@style.styled
def fleet_icrs(fleet: FleetNumbers) -> Figure:
    """Return both lateral ICRs of every log over its date, ±σ, a colour and marker per robot."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num

    ranges = {
        side: [f"{edge([_icr(point, side) for point in fleet.points]):+.2f}" for edge in (min, max)]
        for side in ("right", "left")
    }
    answer = ", ".join(f"y {side} {' to '.join(ends)} m" for side, ends in ranges.items()).replace("-", "−")
    title, subtitle = f"ICRs: {answer}", f"{fleet.title}: of each log, ±σ"
    figure = style.new_figure(title, subtitle, height_in=5.0, margins_in=(0.85, 0.2, 0.85, 0.95), hspace=0.12)
    panels = figure.subplots(2, 1, sharex=True)
    for axes, side in zip(panels, ("right", "left"), strict=True):
        for number, robot in enumerate(dict.fromkeys(point.robot for point in fleet.points)):
            mine = [point for point in fleet.points if point.robot == robot]
            key = f" {style.drawable(robot or 'robot not named', LONGEST_ROBOT)}"  # matplotlib leaves out "_label"
            when = date2num([np.datetime64(point.start_utc.rstrip("Z")) for point in mine])  # type: ignore[no-untyped-call]
            axes.errorbar(
                when, [_icr(point, side) for point in mine],
                [point.icr.get(f"std_y_icr_{side}_m") or 0.0 for point in mine],
                markersize=4.5, capsize=2.0, linewidth=1.0, label=key, **_look(number),
            )  # fmt: skip
        axes.set_ylabel(f"ICR y {side} [m]")
    first, last = panels[-1].get_xlim()
    if last - first < LEAST_DAYS or len({point.start_utc for point in fleet.points}) == 1:
        middle = (first + last) / 2
        panels[-1].set_xlim(middle - LEAST_DAYS / 2, middle + LEAST_DAYS / 2)
    locator = AutoDateLocator(minticks=2, maxticks=6)  # type: ignore[no-untyped-call]
    panels[-1].xaxis.set_major_locator(locator)
    panels[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator, show_offset=False))  # type: ignore[no-untyped-call]
    years = sorted({point.start_utc[:4] for point in fleet.points})
    panels[-1].set_xlabel(f"Date, UTC, {' to '.join(dict.fromkeys((years[0], years[-1])))}")
    style.add_legend(figure, ncols=4)
    return figure


def _look(number: int) -> style.Look:
    """Return how the robot or group of a number is drawn."""
    color, marker = COLORS[number % len(COLORS)], MARKERS[number % len(MARKERS)]
    return {"linestyle": "none", "marker": marker, "color": color}


def _icr(point: FleetLog, side: str) -> float:
    value = point.icr[f"y_icr_{side}_m"]
    return np.nan if value is None else value


@style.styled
def fleet_errors(fleet: FleetNumbers) -> Figure:
    """Return the 95 % error after 10 m [m] of every log, a row a log, by group; of many logs those of the largest."""
    errors = [
        (group, log, error)
        for group, logs in fleet.errors_m.items()
        for log, error in sorted(logs.items(), key=lambda one: -one[1])
    ]
    largest = sorted(errors, key=lambda one: -one[2])[:MOST_ROWS]
    shown = [one for one in errors if one in largest]
    cut = f", the {MOST_ROWS} largest" if len(errors) > MOST_ROWS else ""
    median = error_text(float(np.median([error for *_, error in errors])))
    labels = [style.drawable(log, LONGEST_LOG) for _, log, _ in shown]
    title = f"After 10 m 95 % stay within {median} in the median of {counted(len(errors), 'log')}"
    subtitle = f"{fleet.title}: 95 % error after 10 m without GNSS, {fleet.model}{cut}"
    height_in = 1.9 + ROW_IN * len(shown)
    figure = style.new_figure(title, subtitle, height_in=height_in, margins_in=(2.9, 0.7, 0.65, 1.05))
    axes = figure.subplots()
    axes.set_yticks(range(len(labels)), labels, parse_math=False)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    for number, (group, logs) in enumerate(fleet.errors_m.items()):
        rows = [row for row, one in enumerate(shown) if one[0] == group]
        middle = error_text(float(np.median(list(logs.values()))))
        label = f" {style.drawable(group, LONGEST_GROUP)}: {counted(len(logs), 'log')}, median {middle}"
        axes.plot([shown[row][2] for row in rows], rows, markersize=5.5, label=label, **_look(number))
    for row, (*_, error) in enumerate(shown):
        look: style.Look = {"va": "center", "fontsize": 8.0, "annotation_clip": False, "bbox": None}
        style.write_beside(axes, error_text(error), (error, row), (6.0, 0.0), **look)
    style.logarithmic_errors(axes)
    style.add_legend(figure, ncols=2)
    return figure
