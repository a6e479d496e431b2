"""Open-loop trials on the ground: typical ones, the worst, and outages (Pentzer 2014, Figs. 27, 33, 34)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D

from icrtool.kernels.arrays import Floats
from icrtool.output.figures.decimate import places
from icrtool.output.figures.style import BAD_FIX_COLOR, FILTER, FIX_COLOR, ICR, NO_SLIP, Pen, inches, new_figure
from icrtool.output.text_format import duration_text, metres_text
from icrtool.records.dropout import ExampleTrial, Outage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN = 7.2
EXAMPLES_HEIGHT_IN = 4.7
WORST_COLUMNS = 4
WORST_CELL_IN = 1.95
OUTAGES_BOX_IN = (2.4, 5.4)

PENS: dict[str, Pen] = {"icr": ICR, "no_slip": NO_SLIP}
LABELS = {"icr": "ICR", "no_slip": "no slip"}
FORCED = Pen(BAD_FIX_COLOR, width=1.8)
REAL = Pen("black", (0, (2.0, 1.2)), 1.8)
PATH = Pen(FIX_COLOR, width=1.4)

Box = tuple[float, float, float, float]
"""Left, bottom, right, top [points]."""

MARK_PT, LINE_PT, CHARACTER_PT = 3.5, 11.0, 5.3
"""Half the size of a mark, height of a line of text, usual width of a character, in points."""
LABEL_OFFSETS_PT = tuple(
    (sign * dx, dy)
    for dx in (7.0, 16.0, 32.0, 56.0)
    for dy in (9.0, -9.0, 0.0, 18.0, -18.0, 32.0, -32.0, 48.0, -48.0)
    for sign in (1, -1)
)
LINE_FROM_PT = 20.0
"""A label further than this from its point has a line to it."""
NUMBERS_APART = 0.16
"""Trials that start closer together than this share of the overview's width have one place for their numbers."""

SMALLEST_VIEW_M = 0.5
CELLS = 1500.0


def draw_examples(title: str, examples: Sequence[ExampleTrial]) -> Figure:
    """Draw a trial of about half a turn and the straightest one side by side: reference, ICR, no slip."""
    horizon = examples[0].horizon_m
    figure = new_figure(
        title,
        f"Trials without GNSS over {horizon:g} m: about half a turn (left), as straight as the drive has it (right)",
        width_in=WIDTH_IN,
        height_in=EXAMPLES_HEIGHT_IN,
    )
    panels = figure.subplots(1, len(examples), squeeze=False)[0]
    figure.subplots_adjust(**inches(figure, left=0.7, right=0.2, top=1.0, bottom=0.9), wspace=0.34)
    for axes, drive in zip(panels, examples, strict=True):
        _draw_drive(axes, drive, box=(3.0, 2.75))
        facts = f"at {drive.t_s:.0f} s, turns {_turn_text(drive)} at {drive.speed_mean_mps:.2f} m/s"
        errors = ",  ".join(f"{LABELS[name]} {metres_text(error)}" for name, error in drive.errors_m.items())
        axes.set_title(f"{facts}\nend error: {errors}", loc="left", pad=5.0)
        axes.set_xlabel("East of start [m]")
        axes.set_ylabel("North of start [m]")
    _add_keys(figure, examples)
    return figure


def draw_worst(title: str, worst: Sequence[ExampleTrial], north_m: Floats, east_m: Floats) -> Figure:
    """Draw the worst trials, each in a cell with its own scale; the first cell shows where on the path they are.

    Parameters
    ----------
    north_m, east_m : (n,) the whole path of the reference
    """
    rows = -(-(len(worst) + 1) // WORST_COLUMNS)
    figure = new_figure(
        title,
        f"The {len(worst)} worst trials without GNSS over {worst[0].horizon_m:g} m, momentary ICRs, none overlapping",
        width_in=9.6,
        height_in=1.25 + rows * (WORST_CELL_IN + 0.75),
    )
    panels = figure.subplots(rows, WORST_COLUMNS, squeeze=False).ravel()
    figure.subplots_adjust(**inches(figure, left=0.65, right=0.15, top=1.07, bottom=0.9), wspace=0.3, hspace=0.5)
    figure.supxlabel("East of start [m]", fontsize=9.0, y=0.42 / figure.get_figheight())
    figure.supylabel("North of start [m]", fontsize=9.0, x=0.12 / figure.get_figwidth())
    _draw_overview(panels[0], worst, north_m, east_m)
    for rank, (axes, drive) in enumerate(zip(panels[1:], worst, strict=False), start=1):
        _draw_drive(axes, drive, box=(1.0, 1.0), ticks=5)
        axes.set_title(
            f"{rank}.  ICR error {metres_text(drive.errors_m['icr'])}\n"
            f"at {drive.t_s:.0f} s, turns {_turn_text(drive)}\nat {drive.speed_mean_mps:.2f} m/s",
            loc="left",
            pad=4.0,
            fontsize=8.0,
        )
        axes.tick_params(labelsize=7.5)
    for axes in panels[len(worst) + 1 :]:
        axes.set_axis_off()
    _add_keys(figure, worst)
    return figure


def _draw_overview(axes: Axes, worst: Sequence[ExampleTrial], north_m: Floats, east_m: Floats) -> None:
    """Draw the whole path and, numbered, where the trials start."""
    norths, easts = north_m - north_m[0], east_m - east_m[0]
    (south, north), (west, east) = _view(norths, easts, 1.0)
    shown = places(norths, easts, (east - west) / CELLS)
    axes.plot(easts[shown], norths[shown], zorder=2, **PATH.keywords())
    together: dict[tuple[float, float], list[int]] = {}
    for rank, drive in enumerate(worst, start=1):
        place = drive.east_m - float(east_m[0]), drive.north_m - float(north_m[0])
        near = (one for one in together if math.dist(one, place) < NUMBERS_APART * (east - west))
        together.setdefault(next(near, place), []).append(rank)
    for place, ranks in together.items():
        text = ",".join(map(str, ranks))
        axes.text(*place, text, fontsize=7.5, fontweight="bold", ha="center", va="center", zorder=3)
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    axes.set_aspect("equal")
    axes.locator_params(nbins=4, steps=[1, 2, 5, 10])
    axes.tick_params(labelsize=7.5)
    axes.set_title("where they start\non the whole path\n(from its first point)", loc="left", pad=4.0, fontsize=8.0)


def draw_outages(title: str, north_m: Floats, east_m: Floats, outages: Sequence[Outage]) -> Figure:
    """Draw the path with those of forced and real outages."""
    paths = [(one.north_m, one.east_m) for one in outages]
    norths = np.concatenate([north_m, *(north for north, _ in paths)])
    easts = np.concatenate([east_m, *(east for _, east in paths)])
    (south, north), (west, east), box_in = _fit_to_box(norths, easts)
    figure = new_figure(title, _outages_text(outages), width_in=WIDTH_IN, height_in=box_in + 1.65)
    axes = figure.subplots()
    figure.subplots_adjust(**inches(figure, left=0.75, right=0.2, top=0.65, bottom=1.0))
    cell = (east - west) / CELLS
    shown = places(north_m, east_m, cell)
    axes.plot(east_m[shown], north_m[shown], zorder=2, **PATH.keywords())
    for one in outages:
        pen = FORCED if one.kind == "forced" else REAL
        shown = places(one.north_m, one.east_m, cell)
        axes.plot(one.east_m[shown], one.north_m[shown], zorder=3, **pen.keywords())
        axes.plot(one.east_m[:1], one.north_m[:1], zorder=4, **_mark("white"))
        axes.plot(one.east_m[-1:], one.north_m[-1:], zorder=4, **_mark("black"))
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    axes.set_aspect("equal")
    _write_errors(axes, outages, (south, west), 72.0 * box_in / (north - south))
    axes.set_xlabel("East [m]")
    axes.set_ylabel("North [m]")
    keys = [Line2D([], [], label="filter", **PATH.keywords())]
    for kind, pen in (("forced", FORCED), ("real", REAL)):
        if any(one.kind == kind for one in outages):
            keys.append(Line2D([], [], label=f"{kind} outage", **pen.keywords()))
    keys += [Line2D([], [], label="its begin", **_mark("white")), Line2D([], [], label="its end", **_mark("black"))]
    figure.legend(handles=keys, loc="lower center", ncols=len(keys), columnspacing=1.8)
    return figure


def _draw_drive(axes: Axes, drive: ExampleTrial, box: tuple[float, float], ticks: int = 5) -> None:
    """Draw one trial about its start; the view has the shape of `box` (width, height), metres are square."""
    north0, east0 = drive.north_m, drive.east_m
    lines = [(drive.reference_north_m, drive.reference_east_m, FILTER, 2.0)]
    lines += [(path.north, path.east, PENS[name], 3.0) for name, path in drive.paths.items()]
    norths = np.concatenate([north - north0 for north, *_ in lines])
    easts = np.concatenate([east - east0 for _, east, *_ in lines])
    (south, north), (west, east) = _view(norths, easts, box[0] / box[1])
    cell = (east - west) / CELLS
    for line_north, line_east, pen, order in lines:
        shown = places(line_north, line_east, cell)
        axes.plot(line_east[shown] - east0, line_north[shown] - north0, zorder=order, **pen.keywords())
        axes.plot(line_east[-1:] - east0, line_north[-1:] - north0, zorder=order + 2, **_end(pen))
    axes.plot([0.0], [0.0], zorder=6, **_mark("white"))
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    axes.set_aspect("equal")
    axes.locator_params(nbins=ticks, steps=[1, 2, 5, 10])


def _add_keys(figure: Figure, drives: Sequence[ExampleTrial]) -> None:
    keys = [Line2D([], [], label="start", **_mark("white")), Line2D([], [], label="filter", **FILTER.keywords())]
    keys += [Line2D([], [], label=LABELS[name], **PENS[name].keywords()) for name in drives[0].paths]
    keys.append(Line2D([], [], label="where each ends", **_end(Pen("0.45"))))
    figure.legend(handles=keys, loc="lower center", ncols=len(keys), columnspacing=2.4)


def _turn_text(drive: ExampleTrial) -> str:
    return f"{abs(math.degrees(drive.heading_change_rad)):.0f}°"


def _mark(fill: str) -> dict[str, Any]:
    return {"linestyle": "none", "marker": "o", "color": "black", "markerfacecolor": fill, "markersize": 5.5}


def _end(pen: Pen) -> dict[str, Any]:
    return {"linestyle": "none", "marker": "D", "color": pen.color, "markersize": 4.5}


def _view(norths: Floats, easts: Floats, shape: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the range of north and of east [m] of a view `shape` times as wide as high, with a margin."""
    middle = [(float(column.min()) + float(column.max())) / 2 for column in (norths, easts)]
    spans = [float(np.ptp(column)) for column in (norths, easts)]
    height = 1.16 * max(spans[0], spans[1] / shape, SMALLEST_VIEW_M)
    half = (height / 2, height * shape / 2)
    return (middle[0] - half[0], middle[0] + half[0]), (middle[1] - half[1], middle[1] + half[1])


def _fit_to_box(norths: Floats, easts: Floats) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Return the view of a whole path, and the height [in] its axes take."""
    width_in = WIDTH_IN - 0.95
    north, east = max(float(np.ptp(norths)), SMALLEST_VIEW_M), max(float(np.ptp(easts)), SMALLEST_VIEW_M)
    box_in = float(np.clip(width_in * north / east, *OUTAGES_BOX_IN))
    return *_view(norths, easts, width_in / box_in), box_in


def _outages_text(outages: Sequence[Outage]) -> str:
    """Return how many outages of each kind there are, and the largest end error of each."""
    parts = []
    for kind in ("forced", "real"):
        ours = [one for one in outages if one.kind == kind]
        if ours:
            worst = max(one.end_error_m for one in ours)
            lengths = sorted({round(one.end_s - one.begin_s, 1) for one in ours})
            span = duration_text(lengths[0])
            span += f" to {duration_text(lengths[-1])}" if len(lengths) > 1 else ""
            parts.append(f"{len(ours)} {kind} of {span}, end error up to {metres_text(worst)}")
    return "Outages: " + "; ".join(parts)


def _write_errors(axes: Axes, outages: Sequence[Outage], lowest: tuple[float, float], points_per_metre: float) -> None:
    """Write each outage's number and end error beside its end where it fits; the tables have them all.

    Parameters
    ----------
    axes : with its limits set
    lowest : north and east [m] of the lower left corner
    points_per_metre : scale of the picture
    """

    def point(one: Outage, row: int) -> tuple[float, float]:
        east, north = float(one.east_m[row]), float(one.north_m[row])
        return (east - lowest[1]) * points_per_metre, (north - lowest[0]) * points_per_metre

    ends = [point(one, row) for one in outages for row in (0, -1)]
    crossings = [
        point(one, int(row)) for one in outages for row in places(one.north_m, one.east_m, LINE_PT / points_per_metre)
    ]
    taken = [_box_about(place) for place in ends]
    crossed = [_box_about(place) for place in crossings]
    upper = (axes.get_xlim()[1] - lowest[1]) * points_per_metre, (axes.get_ylim()[1] - lowest[0]) * points_per_metre
    for number, one in enumerate(outages, start=1):
        text = f"{number}: {metres_text(one.end_error_m)}"
        offset = _free_offset(point(one, -1), CHARACTER_PT * len(text), taken, crossed, upper)
        if offset is not None:
            taken.append(_label_box(point(one, -1), CHARACTER_PT * len(text), offset))
            _write(axes, text, (float(one.east_m[-1]), float(one.north_m[-1])), offset)


def _free_offset(
    place: tuple[float, float], width: float, taken: list[Box], crossed: list[Box], upper: tuple[float, float]
) -> tuple[float, float] | None:
    """Return where a label of this width can stand: off all that is taken, off the lines too where it can."""
    for obstacles in ([*taken, *crossed], taken):
        for offset in LABEL_OFFSETS_PT:
            box = _label_box(place, width, offset)
            inside = box[0] > 0 and box[1] > 0 and box[2] < upper[0] and box[3] < upper[1]
            if inside and not any(_overlap(box, other) for other in obstacles):
                return offset
    return None


def _box_about(place: tuple[float, float]) -> Box:
    return place[0] - MARK_PT, place[1] - MARK_PT, place[0] + MARK_PT, place[1] + MARK_PT


def _label_box(place: tuple[float, float], width: float, offset: tuple[float, float]) -> Box:
    left, bottom = place[0] + (offset[0] if offset[0] > 0 else offset[0] - width), place[1] + offset[1] - LINE_PT / 2
    return left, bottom, left + width, bottom + LINE_PT


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _write(axes: Axes, text: str, place: tuple[float, float], offset_pt: tuple[float, float]) -> None:
    axes.annotate(
        text,
        place,
        xytext=offset_pt,
        textcoords="offset points",
        ha="left" if offset_pt[0] > 0 else "right",
        va="center",
        fontsize=8.0,
        zorder=6,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8},
        arrowprops={"arrowstyle": "-", "color": "0.5", "linewidth": 0.6}
        if math.hypot(*offset_pt) > LINE_FROM_PT
        else None,
    )
