"""Open-loop trials on the ground: typical ones, the worst, and outages (Pentzer 2014, Figs. 27, 33, 34)."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import DataError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.output.figures import style
from icrtool.output.figures.labels import Label, write_labels
from icrtool.output.figures.sheet import new_sheet, styled
from icrtool.output.figures.trajectory import (
    JUMP_LOOK,
    draw_path,
    fitted_box_in,
    name_directions,
    show_from_above,
)
from icrtool.output.series import round_steps, rows_entering_cells
from icrtool.output.text_format import (
    direction_words,
    duration_text,
    error_text,
    fix_word,
    run_title,
    turn_text,
)
from icrtool.records.dropout_document import ExampleTrial, Outage, PathErrors, TrialDocument
from icrtool.records.rows import row_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WORST_COLUMNS, WORST_ROWS = 3, 2
"""Number of columns and rows of cells with the worst trials."""

WORST_CELL_IN = 2.15
"""Height of a cell [in]."""

WORST_LAYOUT: Any = {"margins_in": (0.15, 0.15, 0.98, 0.5), "wspace": 0.12, "hspace": 0.27}
"""Margins of the cells, as in `icrtool.output.figures.style.new_figure`."""

CELL_TITLE: style.Look = {"loc": "left", "pad": 4.0, "fontsize": 8.5}
"""Look of the title of a cell."""

OUTAGES = {
    "forced": style.line_look(style.BAD_FIX_COLOR, width=1.8),
    "real": style.line_look("black", (0, (2.0, 1.2)), 1.8),
}
"""Lines of the paths in outages, by kind of outage."""

PATH = style.line_look(style.FIX_COLOR, width=1.4)
"""Line of the path outside of outages."""

NO_BREAK = "\N{NO-BREAK SPACE}"
"""Character in place of a space at which no line breaks."""

EXAMPLE_CHARACTERS = 44
"""Characters in a line above a typical trial."""

MAP_MARGINS_IN = (0.75, 1.1, 0.65, 1.0)
"""Left, right, top and bottom of the axes of a picture with a colour bar [in]."""

BAR_SHARE = 0.4
"""Largest length of the bar of a scale, as a share of the width."""
FRAME_COLOR = "0.75"
"""Colour of the frame of a cell."""

LOST_LOOK: style.Look = {"color": "0.82", "linewidth": 6.0, "solid_capstyle": "butt", "zorder": 1}
"""Line beneath the paths where no fix corrected the reference."""

SLOWEST_SHOWN_MPS = 0.001
"""Smallest mean speed of a trial from which its duration is computed [m/s]."""


@styled
def dropout_examples(report: DropoutReport, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of a trial of about half a turn and of the straightest trial [m], side by side.

    `ax`: axes to draw into, which are returned; by default the picture is a new figure.

    Raises
    ------
    DataError
        The report holds none of them; make it with `icrtool.dropout_report`.
    """
    examples = _require(report, report.examples, "example trials")
    trials = [example.document for example in examples]
    errors = " and ".join(error_text(trial.errors_m[trial.model]) for trial in trials)
    kinds_text = "about half a turn (left), as straight as the drive has it (right)"
    title = f"Typical trials of {trials[0].horizon_m:g} m end {errors} off"
    subtitle = f"{run_title(report.run_document)}: {kinds_text}"
    sheet = new_sheet(title, subtitle, ax, height_in=4.9, margins_in=(0.75, 0.2, 1.2, 0.9), wspace=0.34)
    panels = sheet.subplots(1, len(examples))[0]
    across, up = direction_words(report.run_document)
    for axes, drive, trial in zip(panels, examples, trials, strict=True):
        _draw_drive(axes, report, drive)
        turn = turn_text(trial.heading_change_deg)
        facts = f"at {trial.t_s:.0f} s, turns {turn} at {trial.speed_mean_mps:.2f} m/s"
        errors = ", ".join(
            f"{name} {error_text(error)}".replace(" ", NO_BREAK) for name, error in trial.errors_m.items()
        )
        wrapped = textwrap.fill(f"end error: {errors}", EXAMPLE_CHARACTERS)
        axes.set_title(f"{facts}\n{wrapped}", loc="left", pad=5.0)
        axes.set_xlabel(f"{across} from start [m]")
        axes.set_ylabel(f"{up} from start [m]")
    sheet.legend()
    return sheet.finish()


@styled
def dropout_worst(report: DropoutReport, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of the worst trials [m], each in a cell with its own scale; the first cell has their starts.

    `ax`: axes to draw into, which are returned; by default the picture is a new figure.

    Raises
    ------
    DataError
        The report holds none of them; make it with `icrtool.dropout_report`.
    """
    worst = _require(report, report.worst, "worst trials")[: WORST_COLUMNS * WORST_ROWS - 1]
    first = worst[0].document
    rows, model = -(-(len(worst) + 1) // WORST_COLUMNS), first.model
    subtitle = f"{model}, the {len(worst)} worst trials, none overlapping"
    title = f"The worst trial of {first.horizon_m:g} m ends {error_text(first.errors_m[model])} off"
    subtitle, height_in = f"{run_title(report.run_document)}: {subtitle}", 1.0 + rows * (WORST_CELL_IN + 0.5)
    sheet = new_sheet(title, subtitle, ax, height_in=height_in, **WORST_LAYOUT)
    panels = sheet.subplots(rows, WORST_COLUMNS).ravel()
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(True)
        axes.spines[:].set_color(FRAME_COLOR)
    _draw_overview(panels[0], [trial.document for trial in worst], report.reference_north_m, report.reference_east_m)
    for rank, (axes, drive) in enumerate(zip(panels[1:], worst, strict=False), start=1):
        _draw_drive(axes, report, drive, ticks=0)
        _draw_scale(axes)
        trial = drive.document
        facts = f"at {duration_text(trial.t_s)}, {turn_text(trial.heading_change_deg)}, {trial.speed_mean_mps:.2f} m/s"
        axes.set_title(f"{rank}:  {error_text(trial.errors_m[model])}\n{facts}", **CELL_TITLE)
    for axes in panels[len(worst) + 1 :]:
        axes.set_axis_off()
    sheet.legend()
    return sheet.finish()


def _draw_overview(axes: Axes, worst: Sequence[TrialDocument], north_m: Floats, east_m: Floats) -> None:
    """Draw the whole path and the numbered starts of the trials."""
    cell = show_from_above(axes, north_m, east_m, margin=0.12, ticks=0)
    draw_path(axes, north_m, east_m, cell, PATH, zorder=2)
    starts = [(trial.east_m, trial.north_m) for trial in worst]
    axes.plot(*zip(*starts, strict=True), zorder=3, **style.spot_look("white", 4.0))
    labels = [Label(str(rank), *place) for rank, place in enumerate(starts, start=1)]
    write_labels(axes, labels, [(east_m, north_m)], crossing=True, fontweight="bold")
    _draw_scale(axes)
    axes.set_title("where they start\non the whole path", **CELL_TITLE)


def _draw_scale(axes: Axes) -> None:
    """Draw a bar of a round length, in place of ticks, in a corner that holds no lines."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    width, height = east - west, north - south
    longest = BAR_SHARE * width
    length = float(max(step for step in round_steps(longest) if step <= longest))
    drawn = np.concatenate([line.get_xydata() for line in axes.lines])

    def crossed(corner: tuple[float, float]) -> int:
        across, above = (drawn[:, 0] - corner[0]) / width, (drawn[:, 1] - corner[1]) / height
        inside = (across > -0.03) & (across < length / width + 0.03) & (above > -0.04) & (above < 0.13)
        return int(np.count_nonzero(inside))

    left, right = west + 0.05 * width, east - 0.05 * width - length
    low, high = south + 0.04 * height, south + 0.87 * height
    x, y = min([(right, low), (left, low), (right, high), (left, high)], key=crossed)
    axes.plot([x, x + length], [y, y], color="black", linewidth=1.6, zorder=7, solid_capstyle="butt")
    look: style.Look = {"ha": "center", "va": "bottom", "fontsize": 7.5, "zorder": 7}
    style.write_near(axes, f"{length:g} m", (x + length / 2, y), (0.0, 2.0), **look)


@styled
def dropout_outages(report: DropoutReport, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of the path [m] with its forced and real outages, and their end errors [m].

    `ax`: axes to draw into, which are returned; by default the picture is a new figure.

    Raises
    ------
    DataError
        The report holds none of them; make it with `icrtool.dropout_report`.
    """
    outages = _require(report, report.outages, "outages")
    norths, easts, shows_all = _view_of_outages(report, outages)
    width_in = style.WIDTH_IN - 0.95
    box_in = fitted_box_in(norths, easts, width_in)
    parts = []
    for kind in OUTAGES:
        # The labels of the legend have number and largest end error of each kind.
        if ours := [outage.document for outage in outages if outage.document.kind == kind]:
            worst = max(outage.end_error_m or 0.0 for outage in ours)
            lengths = sorted({round(outage.end_s - outage.begin_s, 1) for outage in ours})
            span = " to ".join(duration_text(length) for length in dict.fromkeys((lengths[0], lengths[-1])))
            parts.append(f"{len(ours)} {kind} of {span}, up to {error_text(worst)}")
    largest = max(outage.document.end_error_m or 0.0 for outage in outages)
    title = f"Without {fix_word(report.run_document)} the robot ends up to {error_text(largest)} off"
    part = "" if shows_all else "; a part of the path"
    subtitle = f"{run_title(report.run_document)}: {'; '.join(parts)}{part}"
    sheet = new_sheet(title, subtitle, ax, height_in=box_in + 1.65)
    axes = sheet.subplots()[0, 0]
    cell = show_from_above(axes, norths, easts, ticks=9)
    draw_path(axes, report.reference_north_m, report.reference_east_m, cell, PATH, zorder=2, label="filter")
    for outage in outages:
        kind = outage.document.kind
        draw_path(axes, outage.north_m, outage.east_m, cell, OUTAGES[kind], zorder=3, label=f"{kind} outage")
    for row, fill, label in ((0, "white", "its start"), (-1, "black", "its end")):
        ends = [(outage.east_m[row], outage.north_m[row]) for outage in outages]
        axes.plot(*zip(*ends, strict=True), zorder=4, label=label, **style.spot_look(fill))
    # Number and end error are written near the end of each outage if there is space; the tables hold all of them.
    labels = [
        Label(
            f"{number}: {error_text(outage.document.end_error_m)}", float(outage.east_m[-1]), float(outage.north_m[-1])
        )
        for number, outage in enumerate(outages, start=1)
    ]
    lines = [(outage.east_m, outage.north_m) for outage in outages]
    begins = [(float(outage.east_m[0]), float(outage.north_m[0])) for outage in outages]
    lines.append((report.reference_east_m, report.reference_north_m))
    write_labels(axes, labels, lines, crossing=True, marks=begins)
    name_directions(axes, report.run_document)
    sheet.legend()
    return sheet.finish()


LEAST_VIEW = 0.25
"""Smallest size of the view of outages, as a share of the path's size: a small outage would be a dot on it."""

MOST_VIEW = 0.7
"""Largest size of a view of a part of the path, as a share of the path's size; else the whole path is shown."""


def _view_of_outages(report: DropoutReport, outages: Sequence[Outage]) -> tuple[Floats, Floats, bool]:
    """Return north and east (n,) [m] of the points in the view of outages, and whether they are the whole path."""
    paths = report.reference_north_m, report.reference_east_m
    lost = [np.concatenate([getattr(outage, name) for outage in outages]) for name in ("north_m", "east_m")]
    span_m = max(float(np.ptp(path)) for path in paths)
    sizes_m = [max(1.6 * float(np.ptp(column)), LEAST_VIEW * span_m) for column in lost]
    if max(sizes_m) > MOST_VIEW * span_m:
        norths, easts = (np.concatenate(both) for both in zip(paths, lost, strict=True))
        return norths, easts, True
    middles = [(float(column.min()) + float(column.max())) / 2 for column in lost]
    norths, easts = (middle + size_m * np.array([-0.5, 0.5]) for middle, size_m in zip(middles, sizes_m, strict=True))
    return norths, easts, False


ERROR_MAP = "viridis_r"
"""Colours of errors: their lightness decreases evenly with the error, in colour and in grey."""
LIGHTEST = 0.08
"""Part of this map that is left out: it would not be seen on white paper."""

ERROR_STEPS = 7.0
"""Approximate number of steps of the colours. An error is read from a step, not from a gradient."""

UNSCORED = style.line_look("0.80", width=1.0)
"""Line of parts of the path at which no trial starts."""

ERROR_LINE_PT = 3.4
"""Width of the line that is coloured by the error [points]."""

MOST_OF_P95 = 1.5
"""Largest ratio of the end of the colours to the 95 % error. Larger errors have the last colour."""

CELLS_A_STEP = 3.0
"""Length of a coloured part of the path, in cells of the view."""

MARKED_WORST = 3
"""Number of worst trials whose starts are marked."""


def _errors_of_parts(rows: Ints, errors: PathErrors) -> Floats:
    """Return the largest error (n - 1,) [m] of the trials that start in each part of a path between rows (n,).

    A part without a start has the error of the last start before it, up to twice the usual distance between starts, and
    NaN further on.
    """
    nearest = np.maximum(np.searchsorted(errors.start, rows[:-1], side="right") - 1, 0)
    spacing = float(np.median(np.diff(errors.start))) if len(errors.start) > 1 else 1.0
    behind = rows[:-1] - errors.start[nearest]
    error_m = np.where((behind >= 0) & (behind <= 2.0 * spacing), errors.error_m[nearest], np.nan)
    inside = np.searchsorted(rows, errors.start, side="right") - 1
    largest = np.full(len(rows), np.nan)
    np.fmax.at(largest, inside, errors.error_m)
    return np.where(np.isfinite(largest[:-1]), largest[:-1], error_m)


@styled
def dropout_map(report: DropoutReport, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of the path [m], each place coloured by the error [m] of the trial that starts there.

    `ax`: axes to draw into, which are returned; by default the picture is a new figure.

    Raises
    ------
    DataError
        The report holds none of them; make it with `icrtool.dropout_report`.
    """
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection
    from matplotlib.colors import BoundaryNorm, ListedColormap

    (errors,) = _require(report, () if report.path_errors is None else (report.path_errors,), "errors along the path")
    north, east, after = report.reference_north_m, report.reference_east_m, f"{errors.horizon_m:g} m"
    p95, most = float(np.quantile(errors.error_m, 0.95)), float(errors.error_m.max())
    title = f"95 % of the trials end within {error_text(p95)} after {after}, the worst {error_text(most)}"
    subtitle = f"{run_title(report.run_document)}: {errors.model}, {len(errors.error_m):,} trials, each at its start"
    box_in = fitted_box_in(north, east, style.WIDTH_IN - sum(MAP_MARGINS_IN[:2]))
    sheet = new_sheet(
        title, subtitle, ax, height_in=box_in + sum(MAP_MARGINS_IN[2:]), margins_in=MAP_MARGINS_IN
    )  # fmt: skip
    axes = sheet.subplots()[0, 0]
    cell = show_from_above(axes, north, east, margin=0.06, ticks=9)
    draw_path(axes, north, east, cell, UNSCORED, zorder=2, label="no trial starts here")
    rows = rows_entering_cells(north, east, CELLS_A_STEP * cell)
    error_m = _errors_of_parts(rows, errors)
    # The largest errors lie on top.
    drawn = np.flatnonzero(np.isfinite(error_m))
    drawn = drawn[np.argsort(error_m[drawn], kind="stable")]
    points = np.column_stack([east[rows], north[rows]])
    end = min(most, MOST_OF_P95 * p95) or 1.0
    step = float(min(round_steps(end / ERROR_STEPS), key=lambda step: abs(step - end / ERROR_STEPS)))
    steps = step * np.arange(np.ceil(end / step) + 1)
    shades = ListedColormap(colormaps[ERROR_MAP](np.linspace(LIGHTEST, 1.0, len(steps) - 1)))
    lines = LineCollection(
        np.stack([points[drawn], points[drawn + 1]], axis=1).tolist(), cmap=shades, linewidths=ERROR_LINE_PT,
        norm=BoundaryNorm(steps, len(steps) - 1), capstyle="round", zorder=3,
    )  # fmt: skip
    lines.set_array(error_m[drawn])
    axes.add_collection(lines, autolim=False)
    beyond = "max" if most > steps[-1] else "neither"
    bar = axes.figure.colorbar(lines, cax=axes.inset_axes((1.03, 0.0, 0.03, 1.0)), extend=beyond)
    bar.set_label(f"Error after {after} from there [m]")
    bar.outline.set_visible(False)
    bar.ax.axhline(p95, color=style.BUDGET["color"], linewidth=1.6)
    label_look: style.Look = {"ha": "right", "va": "center", "fontsize": 8.0, "color": style.BUDGET["color"]}
    style.write_near(bar.ax, "95 %", (0.0, p95), (-3.0, 0.0), xycoords=bar.ax.get_yaxis_transform(), **label_look)
    worst = [(trial.document.east_m, trial.document.north_m) for trial in report.worst[:MARKED_WORST]]
    if worst:
        label = f"the worst {len(worst)} that do not overlap" if len(worst) > 1 else "the worst"
        axes.plot(*zip(*worst, strict=True), zorder=5, label=label, **style.spot_look("none", 9.0, color="black"))
        labels = [
            Label(f"{rank}: {error_text(trial.document.errors_m[trial.document.model])}", *at)
            for rank, (at, trial) in enumerate(zip(worst, report.worst, strict=False), start=1)
        ]
        write_labels(axes, labels, [(east, north)], crossing=True, fontweight="bold")
    name_directions(axes, report.run_document)
    sheet.legend()
    return sheet.finish()


Content = TypeVar("Content", ExampleTrial, Outage, PathErrors)


def _require(report: DropoutReport, content: tuple[Content, ...], content_word: str) -> tuple[Content, ...]:
    """Return the content of a report; raise an error for a report that holds none."""
    if not content:
        raise DataError(
            report.name, f"the report holds no {content_word}", "make the report with icrtool.dropout_report"
        )
    return content


def _draw_drive(axes: Axes, report: DropoutReport, drive: ExampleTrial, ticks: int = 5) -> None:
    """Draw one trial about its start."""
    trial, pens = drive.document, style.row_pens(drive.paths)
    lines = [(drive.reference_north_m, drive.reference_east_m, style.FILTER, "filter")]
    drawn = {name: path for name, path in drive.paths.items() if row_of(name).compared or name == trial.model}
    lines += [(path.north, path.east, pens[name], name) for name, path in drawn.items()]
    lines = [(north - trial.north_m, east - trial.east_m, pen, label) for north, east, pen, label in lines]
    norths, easts = (np.concatenate([line[column] for line in lines]) for column in (0, 1))
    cell = show_from_above(axes, norths, easts, ticks=ticks)
    axes.plot([0.0], [0.0], zorder=6, label="start", **style.spot_look("white"))
    for order, (north, east, pen, label) in enumerate(lines):
        draw_path(axes, north, east, cell, pen, zorder=2 + min(order, 1), label=label)
    for north, east, pen, _ in lines:
        look = style.spot_look(pen["color"], 4.5, "D", pen["color"])
        axes.plot(east[-1:], north[-1:], zorder=5, label="where each ends", **look)
    end_s = trial.t_s + trial.horizon_m / max(trial.speed_mean_mps, SLOWEST_SHOWN_MPS)
    for outage in report.outages:
        span = outage.document
        if span.kind == "real" and trial.t_s <= span.end_s and span.begin_s <= end_s:
            axes.plot(outage.east_m - trial.east_m, outage.north_m - trial.north_m, label="real outage", **LOST_LOOK)
    jumps = [jump for jump in report.run_document.reference_jumps if trial.t_s <= jump.end_s and jump.begin_s <= end_s]
    if jumps:
        place = [[jump.east_m - trial.east_m for jump in jumps], [jump.north_m - trial.north_m for jump in jumps]]
        axes.plot(*place, label="step of the reference", **JUMP_LOOK)
