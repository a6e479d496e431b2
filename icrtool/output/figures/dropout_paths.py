"""Open-loop trials on the ground: typical ones, the worst, and outages (Pentzer 2014, Figs. 27, 33, 34)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from matplotlib.transforms import Bbox

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import DataError
from icrtool.kernels.arrays import Floats
from icrtool.output.figures import style
from icrtool.output.figures.trajectory import (
    CELLS_A_VIEW,
    JUMP_LOOK,
    draw_path,
    fitted_box_in,
    look_down,
    name_directions,
)
from icrtool.output.series import places, round_steps
from icrtool.output.text_format import duration_text, error_text, run_title, turn_text
from icrtool.records.dropout_document import ExampleTrial, Outage, TrialDocument
from icrtool.records.rows import row_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WORST_COLUMNS, WORST_ROWS = 4, 2
WORST_CELL_IN = 2.15
WORST_LAYOUT: Any = {"width_in": 9.6, "margins_in": (0.15, 0.15, 0.98, 0.5), "wspace": 0.12, "hspace": 0.27}
CELL_TITLE: style.Look = {"loc": "left", "pad": 4.0, "fontsize": 8.0}

OUTAGES = {"forced": style.line(style.BAD_FIX_COLOR, width=1.8), "real": style.line("black", (0, (2.0, 1.2)), 1.8)}
PATH = style.line(style.FIX_COLOR, width=1.4)

MARK_PT, LINE_PT, CHARACTER_PT = 3.5, 11.0, 5.3
"""Half the size of a mark, height of a line of text, usual width of a character [points]."""
LABEL_OFFSETS_PT = tuple(
    (sign * dx, dy)
    for dx in (7.0, 16.0, 32.0, 56.0)
    for dy in (9.0, -9.0, 0.0, 18.0, -18.0, 32.0, -32.0, 48.0, -48.0)
    for sign in (1, -1)
)
LINE_FROM_PT = 20.0
"""Distance between a label and its point from which on a line joins them [points]."""

BAR_SHARE = 0.4
"""Largest length of the bar of a scale, as a share of the width."""
FRAME_COLOR = "0.75"
LOST_LOOK: style.Look = {"color": "0.82", "linewidth": 6.0, "solid_capstyle": "butt", "zorder": 1}
"""Line beneath the paths where no fix corrected the reference."""

SLOWEST_SHOWN_MPS = 0.001


@style.styled
def dropout_examples(report: DropoutReport) -> Figure:
    """Return a trial of about half a turn and the straightest one side by side [m]: reference, ICR, no slip.

    Raises
    ------
    DataError
        The report holds none; `icrtool.dropout_report` makes one that does.
    """
    examples = _needed(report, report.examples, "example trials")
    trials = [one.document for one in examples]
    errors = " and ".join(error_text(one.errors_m[one.model]) for one in trials)
    what = "about half a turn (left), as straight as the drive has it (right)"
    title = f"Typical trials of {trials[0].horizon_m:g} m end {errors} off"
    subtitle = f"{run_title(report.run_document)}: {what}"
    figure = style.new_figure(title, subtitle, height_in=4.7, margins_in=(0.75, 0.2, 1.0, 0.9), wspace=0.34)
    panels = figure.subplots(1, len(examples), squeeze=False)[0]
    for axes, drive, trial in zip(panels, examples, trials, strict=True):
        _draw_drive(axes, report, drive, shape=3.0 / 2.75)
        turn = turn_text(trial.heading_change_deg)
        facts = f"at {trial.t_s:.0f} s, turns {turn} at {trial.speed_mean_mps:.2f} m/s"
        errors = ",  ".join(f"{name} {error_text(error)}" for name, error in trial.errors_m.items())
        axes.set_title(f"{facts}\nend error: {errors}", loc="left", pad=5.0)
        axes.set_xlabel("East of start [m]")
        axes.set_ylabel("North of start [m]")
    style.add_legend(figure)
    return figure


@style.styled
def dropout_worst(report: DropoutReport) -> Figure:
    """Return the worst trials [m], each in a cell with its own scale; the first cell shows where they start.

    Raises
    ------
    DataError
        The report holds none; `icrtool.dropout_report` makes one that does.
    """
    worst = _needed(report, report.worst, "worst trials")[: WORST_COLUMNS * WORST_ROWS - 1]
    first = worst[0].document
    rows, model = -(-(len(worst) + 1) // WORST_COLUMNS), first.model
    which = f"{model}, the {len(worst)} worst trials, none overlapping"
    title = f"The worst trial of {first.horizon_m:g} m ends {error_text(first.errors_m[model])} off"
    subtitle, height_in = f"{run_title(report.run_document)}: {which}", 1.0 + rows * (WORST_CELL_IN + 0.5)
    figure = style.new_figure(title, subtitle, height_in=height_in, **WORST_LAYOUT)
    panels = figure.subplots(rows, WORST_COLUMNS, squeeze=False).ravel()
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(True)
        axes.spines[:].set_color(FRAME_COLOR)
    _draw_overview(panels[0], [one.document for one in worst], report.reference_north_m, report.reference_east_m)
    for rank, (axes, drive) in enumerate(zip(panels[1:], worst, strict=False), start=1):
        _draw_drive(axes, report, drive, shape=1.0, ticks=0)
        _draw_scale(axes)
        trial = drive.document
        facts = f"at {duration_text(trial.t_s)}, {turn_text(trial.heading_change_deg)}, {trial.speed_mean_mps:.2f} m/s"
        axes.set_title(f"{rank}:  {error_text(trial.errors_m[model])}\n{facts}", **CELL_TITLE)
    for axes in panels[len(worst) + 1 :]:
        axes.set_axis_off()
    style.add_legend(figure)
    return figure


def _draw_overview(axes: Axes, worst: Sequence[TrialDocument], north_m: Floats, east_m: Floats) -> None:
    """Draw the whole path and the numbered starts of the trials; numbers that would touch are written in a row."""
    cell = look_down(axes, north_m, east_m, 1.0, ticks=0)
    draw_path(axes, north_m, east_m, cell, PATH, zorder=2)
    number_pt, line_pt = 1.1 * CHARACTER_PT, 0.8 * LINE_PT
    point_m = cell * CELLS_A_VIEW / (72.0 * WORST_CELL_IN)
    together: list[tuple[float, float, list[int]]] = []
    for rank, trial in enumerate(worst, start=1):
        for north, east, ranks in together:
            half_pt = number_pt * (len(ranks) + 1) + 2.0
            if abs(trial.north_m - north) < line_pt * point_m and abs(trial.east_m - east) < half_pt * point_m:
                ranks.append(rank)
                break
        else:
            together.append((trial.north_m, trial.east_m, [rank]))
    for north, east, ranks in together:
        look: style.Look = {"fontsize": 8.0, "fontweight": "bold", "ha": "center", "va": "center", "zorder": 3}
        style.write_near(axes, " ".join(map(str, ranks)), (east, north), **look)
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


@style.styled
def dropout_outages(report: DropoutReport) -> Figure:
    """Return the path [m] with its forced and real outages, and their end errors [m].

    Raises
    ------
    DataError
        The report holds none; `icrtool.dropout_report` makes one that does.
    """
    outages = _needed(report, report.outages, "outages")
    norths = np.concatenate([report.reference_north_m, *(one.north_m for one in outages)])
    easts = np.concatenate([report.reference_east_m, *(one.east_m for one in outages)])
    width_in = style.WIDTH_IN - 0.95
    box_in = fitted_box_in(norths, easts, width_in)
    parts = []
    for kind in OUTAGES:
        # Number and largest end error of each kind.
        if ours := [one.document for one in outages if one.document.kind == kind]:
            worst = max(one.end_error_m or 0.0 for one in ours)
            lengths = sorted({round(one.end_s - one.begin_s, 1) for one in ours})
            span = " to ".join(duration_text(length) for length in dict.fromkeys((lengths[0], lengths[-1])))
            parts.append(f"{len(ours)} {kind} of {span}, end error up to {error_text(worst)}")
    title = f"Outages: {'; '.join(parts)}"
    figure = style.new_figure(title, run_title(report.run_document), height_in=box_in + 1.65)
    axes = figure.subplots()
    cell = look_down(axes, norths, easts, width_in / box_in, ticks=9)
    draw_path(axes, report.reference_north_m, report.reference_east_m, cell, PATH, zorder=2, label="filter")
    for one in outages:
        kind = one.document.kind
        draw_path(axes, one.north_m, one.east_m, cell, OUTAGES[kind], zorder=3, label=f"{kind} outage")
    for row, fill, label in ((0, "white", "its begin"), (-1, "black", "its end")):
        ends = [(one.east_m[row], one.north_m[row]) for one in outages]
        axes.plot(*zip(*ends, strict=True), zorder=4, label=label, **style.spot(fill))
    _write_errors(axes, outages)
    name_directions(axes)
    style.add_legend(figure)
    return figure


Content = TypeVar("Content", ExampleTrial, Outage)


def _needed(report: DropoutReport, content: tuple[Content, ...], what: str) -> tuple[Content, ...]:
    if not content:
        raise DataError(report.name, f"the report holds no {what}", "icrtool.dropout_report finds what there is")
    return content


def _draw_drive(axes: Axes, report: DropoutReport, drive: ExampleTrial, shape: float, ticks: int = 5) -> None:
    """Draw one trial about its start in axes `shape` times as wide as high."""
    trial, pens = drive.document, style.row_pens(drive.paths)
    lines = [(drive.reference_north_m, drive.reference_east_m, style.FILTER, "filter")]
    drawn = {name: path for name, path in drive.paths.items() if row_of(name).compared or name == trial.model}
    lines += [(path.north, path.east, pens[name], name) for name, path in drawn.items()]
    lines = [(north - trial.north_m, east - trial.east_m, pen, label) for north, east, pen, label in lines]
    norths, easts = (np.concatenate([line[column] for line in lines]) for column in (0, 1))
    cell = look_down(axes, norths, easts, shape, ticks=ticks)
    axes.plot([0.0], [0.0], zorder=6, label="start", **style.spot("white"))
    for order, (north, east, pen, label) in enumerate(lines):
        draw_path(axes, north, east, cell, pen, zorder=2 + min(order, 1), label=label)
    for north, east, pen, _ in lines:
        look = style.spot(pen["color"], 4.5, "D", pen["color"])
        axes.plot(east[-1:], north[-1:], zorder=5, label="where each ends", **look)
    end_s = trial.t_s + trial.horizon_m / max(trial.speed_mean_mps, SLOWEST_SHOWN_MPS)
    for one in report.outages:
        span = one.document
        if span.kind == "real" and trial.t_s <= span.end_s and span.begin_s <= end_s:
            axes.plot(one.east_m - trial.east_m, one.north_m - trial.north_m, label="real outage", **LOST_LOOK)
    jumps = [one for one in report.run_document.reference_jumps if trial.t_s <= one.end_s and one.begin_s <= end_s]
    if jumps:
        place = [[one.east_m - trial.east_m for one in jumps], [one.north_m - trial.north_m for one in jumps]]
        axes.plot(*place, label="step of the reference", **JUMP_LOOK)


def _write_errors(axes: Axes, outages: Sequence[Outage]) -> None:
    """Write number and end error near the end of each outage where there is space; the tables hold all of them."""
    axes.apply_aspect()
    point_px, frame = axes.figure.dpi / 72.0, axes.bbox

    def spots(path: Floats) -> list[Bbox]:
        return [Bbox([place, place]).padded(MARK_PT * point_px) for place in path]

    paths = [axes.transData.transform(np.column_stack([one.east_m, one.north_m])) for one in outages]
    taken, crossed = [], []
    for path in paths:
        taken += spots(path[[0, -1]])
        crossed += spots(path[places(path[:, 1], path[:, 0], LINE_PT * point_px)])
    height = point_px * LINE_PT
    for number, (one, path) in enumerate(zip(outages, paths, strict=True), start=1):
        text = f"{number}: {error_text(one.document.end_error_m)}"
        width = point_px * CHARACTER_PT * len(text)
        # Places of the label within the frame, nearest first. Crossing a path is better than crossing another label.
        boxes = {}
        for dx, dy in LABEL_OFFSETS_PT:
            x, y = path[-1] + point_px * np.array([dx, dy]) - (width if dx <= 0 else 0.0, height / 2)
            if frame.x0 < x and frame.y0 < y and x + width < frame.x1 and y + height < frame.y1:
                boxes[dx, dy] = Bbox.from_bounds(x, y, width, height)
        free = [offset for offset, box in boxes.items() if not box.count_overlaps(taken)]
        if not free:
            continue
        found = next((offset for offset in free if not boxes[offset].count_overlaps(crossed)), free[0])
        taken.append(boxes[found])
        line = {"arrowstyle": "-", "color": "0.5", "linewidth": 0.6} if math.hypot(*found) > LINE_FROM_PT else None
        side = "left" if found[0] > 0 else "right"
        look: style.Look = {"ha": side, "va": "center", "fontsize": 8.0, "zorder": 6, "arrowprops": line}
        style.write_near(axes, text, (float(one.east_m[-1]), float(one.north_m[-1])), found, **look)
