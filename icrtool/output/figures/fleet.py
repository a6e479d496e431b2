"""Figures of a batch: ICRs by robot and date, error by group, failures by reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from icrtool.output.atomic_file import atomic_file
from icrtool.output.figures.style import drawable, inches, new_figure, save, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH_IN = 7.2
ROW_IN = 0.32
LONGEST_LABEL = 48
COLORS = ("#1b6ca8", "#d95f02", "#1b9e77", "#7570b3", "#a6761d", "#666666")
MARKERS = ("o", "s", "^", "D", "v", "P")


class IcrPoint(NamedTuple):
    """Final ICRs of a log [m] with their standard deviations; `date` is ISO 8601 in UTC."""

    robot: str
    date: str
    right_m: float
    left_m: float
    right_std_m: float
    left_std_m: float


def draw_fleet(
    directory: Path, formats: tuple[str, ...], title: str, points: Sequence[IcrPoint],
    errors_m: Mapping[str, Sequence[float]], reasons: Mapping[str, int],
) -> None:  # fmt: skip
    """Write the figures that have anything to show into a directory; older ones are removed."""
    directory.mkdir(exist_ok=True)
    with style():
        figures = {
            "icrs": draw_fleet_icrs(title, points) if points else None,
            "errors": draw_fleet_errors(title, errors_m) if errors_m else None,
            "failures": draw_fleet_failures(title, reasons) if reasons else None,
        }
        for stem, figure in figures.items():
            wanted = {directory / f"{stem}.{form}" for form in formats if figure is not None}
            for file in wanted:
                with atomic_file(file) as partial:
                    save(cast("Figure", figure), partial.with_suffix(""), (file.suffix[1:],))
            for old in set(directory.glob(f"{stem}.*")) - wanted:
                old.unlink()


def draw_fleet_icrs(title: str, points: Sequence[IcrPoint]) -> Figure:
    """Draw both lateral ICRs of every log over its date, ±σ, a colour and marker per robot."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num

    figure = new_figure(title, "final ICRs of every log, ±σ", width_in=WIDTH_IN, height_in=5.0)
    panels = figure.subplots(2, 1, sharex=True)
    figure.subplots_adjust(**inches(figure, left=0.85, right=0.2, top=0.85, bottom=0.95), hspace=0.12)
    robots = list(dict.fromkeys(point.robot for point in points))
    for axes, side, label in zip(panels, (0, 1), ("ICR y right [m]", "ICR y left [m]"), strict=True):
        for number, robot in enumerate(robots):
            mine = [point for point in points if point.robot == robot]
            when = date2num([np.datetime64(point.date.rstrip("Z")) for point in mine])  # type: ignore[no-untyped-call]
            axes.errorbar(
                when, [point[2 + side] for point in mine], [point[4 + side] for point in mine],
                linestyle="none", marker=MARKERS[number % len(MARKERS)], color=COLORS[number % len(COLORS)],
                markersize=4.5, capsize=2.0, linewidth=1.0, label=drawable(robot or "robot"),
            )  # fmt: skip
        axes.set_ylabel(label)
    locator = AutoDateLocator(minticks=2, maxticks=6)  # type: ignore[no-untyped-call]
    panels[-1].xaxis.set_major_locator(locator)
    panels[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator, show_offset=False))  # type: ignore[no-untyped-call]
    panels[-1].set_xlabel("Date (UTC) [-]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=4)
    return figure


def draw_fleet_errors(title: str, errors_m: Mapping[str, Sequence[float]]) -> Figure:
    """Draw the 95 % error of the ICRs after 10 m of every log by group, the median marked."""
    figure = new_figure(
        title, "95 % error after 10 m without GNSS, momentary ICRs; bar: median of the logs", width_in=WIDTH_IN,
        height_in=1.7 + ROW_IN * max(len(errors_m), 2),
    )  # fmt: skip
    axes = figure.subplots()
    figure.subplots_adjust(**inches(figure, left=2.4, right=0.3, top=0.85, bottom=0.6))
    for row, values in enumerate(errors_m.values()):
        axes.plot(values, [row] * len(values), linestyle="none", marker="o", markersize=4.5, color=COLORS[0], alpha=0.6)
        median = float(np.median(values))
        axes.plot([median, median], [row - 0.3, row + 0.3], color="black", linewidth=2.0)
    axes.set_yticks(range(len(errors_m)), [_label(name, len(values)) for name, values in errors_m.items()])
    axes.set_ylim(len(errors_m) - 0.4, -0.6)
    axes.set_xlim(left=0)
    axes.set_xlabel("Error [m]")
    return figure


def draw_fleet_failures(title: str, reasons: Mapping[str, int]) -> Figure:
    """Draw how many logs could not be used, by reason."""
    figure = new_figure(
        title, "logs that could not be used, by reason", width_in=WIDTH_IN,
        height_in=1.7 + ROW_IN * max(len(reasons), 2),
    )  # fmt: skip
    axes = figure.subplots()
    figure.subplots_adjust(**inches(figure, left=3.3, right=0.3, top=0.85, bottom=0.6))
    axes.barh(range(len(reasons)), list(reasons.values()), height=0.6, color=COLORS[1])
    axes.set_yticks(range(len(reasons)), [_label(reason) for reason in reasons])
    axes.set_ylim(len(reasons) - 0.4, -0.6)
    axes.set_xlabel("Logs [-]")
    axes.locator_params(axis="x", integer=True)
    return figure


def _label(text: str, count: int | None = None) -> str:
    short = text if len(text) <= LONGEST_LABEL else f"{text[: LONGEST_LABEL - 1]}…"
    return drawable(short) if count is None else f"{drawable(short)} ({count})"
