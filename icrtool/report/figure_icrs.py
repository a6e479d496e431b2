"""The ICR estimates: over time (Pentzer 2014, Fig. 15) and how they cluster (Fig. 24)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from icrtool.analysis.fit import FilterRun
from icrtool.analysis.summary import ICR_COLUMNS
from icrtool.report.decimate import LINE_POINTS, extremes
from icrtool.report.figure_style import HALF_WIDTH, MEAN, OUTAGE_COLOR, TimeAxis, inches, new_figure, shade_spans
from icrtool.report.words import run_title
from icrtool.tables import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH_IN = 7.2

LINE_COLOR, BAND_COLOR = "black", "#a6c4e0"
BAR_COLOR = "#5b8db8"
SIDES = {"y_icr_right_m": 1.0, "y_icr_left_m": -1.0, "x_icr_m": 0.0}
"""Where no slip puts an ICR, in half track widths."""
NAMES = {"y_icr_right_m": "$y_{ICR,r}$", "y_icr_left_m": "$y_{ICR,l}$", "x_icr_m": "$x_{ICR}$"}

LEAST_HALF_RANGE_M = 0.05
CALM_PERCENT = 98.0
"""The y range holds the band of all but the widest 2 % of the states: the first seconds do not flatten the rest."""

LONG_RUN = 4.0
"""A run this many times longer than its learning gets a panel of its own for the learning."""
LEARNING_MARGIN = 1.6
LEAST_LEARNING_S = 20.0


def draw_icr_estimates(run: FilterRun) -> Figure:
    """Draw the three ICR estimates over time with ±2σ, their 10-90 % rise, b/2 where known, and GNSS outages."""
    figure = new_figure(run_title(run), "ICR estimates", width_in=WIDTH_IN, height_in=5.6)
    learning = _learning_s(run)
    duration = float(run.table.t_s[-1])
    two = duration > LONG_RUN * learning
    panels = figure.subplots(3, 2 if two else 1, squeeze=False, sharex="col", gridspec_kw={"width_ratios": [1, 2] if two else [1]})
    margins = inches(figure, left=0.75, right=0.2, top=0.55, bottom=0.95)
    figure.subplots_adjust(**margins, wspace=0.06, hspace=0.28)
    spans = [(0.0, learning), (0.0, duration)] if two else [(0.0, duration)]
    for row, column in zip(panels, ICR_COLUMNS, strict=True):
        low, high = _y_range(run, column)
        for axes, (begin, end) in zip(row, spans, strict=True):
            _draw_estimate(axes, run, column, begin, end)
            axes.set_ylim(low, high)
        row[0].set_ylabel(f"{NAMES[column]} [m]")
        row[0].set_title(_rise_text(run, column), loc="left", pad=3.0)
        for axes in row[1:]:
            axes.tick_params(labelleft=False)
    for axes, (_, end) in zip(panels[-1], spans, strict=True):
        axes.set_xlabel(f"Time [{TimeAxis.for_span(end).unit}]")
    figure.legend(handles=_estimate_keys(run), loc="lower center", ncols=5, columnspacing=1.8)
    return figure


def draw_icr_clusters(run: FilterRun) -> Figure:
    """Draw how much of the time each ICR estimate had which value, after convergence."""
    settled = max((rise[1] for rise in run.convergence.values() if rise is not None), default=0.0)
    after = run.table.t_s >= settled
    figure = new_figure(
        run_title(run), f"Clustering of the ICR estimates from {settled:.1f} s on", width_in=WIDTH_IN, height_in=3.6
    )
    panels = figure.subplots(1, 3, sharey=True)
    figure.subplots_adjust(**inches(figure, left=0.65, right=0.2, top=0.75, bottom=0.85), wspace=0.12)
    weight = np.append(np.diff(run.table.t_s), 0.0)[after]
    for axes, column in zip(panels, ("y_icr_left_m", "x_icr_m", "y_icr_right_m"), strict=True):
        _draw_histogram(axes, run, column, getattr(run.table, column)[after], weight)
    panels[0].set_ylabel("Time [%]")
    keys = [Line2D([], [], label="mean", **MEAN.keywords())]
    if run.config.robot.track_width_m is not None:
        keys.append(Line2D([], [], label="no slip (±b/2, 0)", **HALF_WIDTH.keywords()))
    figure.legend(handles=keys, loc="lower center", ncols=2, columnspacing=3.0)
    return figure


def _learning_s(run: FilterRun) -> float:
    """Return how much of the begin shows the rise of all three estimates [s]."""
    last = max((rise[1] for rise in run.convergence.values() if rise is not None), default=0.0)
    return max(LEARNING_MARGIN * last, LEAST_LEARNING_S)


def _draw_estimate(axes: Axes, run: FilterRun, column: str, begin_s: float, end_s: float) -> None:
    table, time = run.table, TimeAxis.for_span(end_s - begin_s)
    rows = slice(int(np.searchsorted(table.t_s, begin_s)), int(np.searchsorted(table.t_s, end_s, side="right")))
    t, value = table.t_s[rows] / time.seconds, getattr(table, column)[rows]
    band = 2 * getattr(table, f"std_{column}")[rows]
    shade_spans(axes, (run.outages_ns - table.stamp_ns[0]) / 1e9 / time.seconds)
    low, high = value - band, value + band
    shown = extremes(low, high, points=LINE_POINTS)
    axes.fill_between(t[shown], low[shown], high[shown], color=BAND_COLOR, linewidth=0)
    shown = extremes(value)
    axes.plot(t[shown], value[shown], color=LINE_COLOR, linewidth=1.0)
    if (width := run.config.robot.track_width_m) is not None:
        axes.axhline(SIDES[column] * width / 2, **HALF_WIDTH.keywords())
    if (rise := run.convergence[column]) is not None:
        at = [int(np.searchsorted(table.t_s, second)) for second in rise]
        marks = {"linestyle": "none", "color": "black", "markersize": 5.5, "zorder": 4}
        axes.plot(table.t_s[at[:1]] / time.seconds, getattr(table, column)[at[:1]], marker="o", markerfacecolor="white", **marks)
        axes.plot(table.t_s[at[1:]] / time.seconds, getattr(table, column)[at[1:]], marker="o", **marks)
    axes.set_xlim(begin_s / time.seconds, end_s / time.seconds)


def _y_range(run: FilterRun, column: str) -> tuple[float, float]:
    """Return the y limits [m]: every estimate, the band where it is not at its widest, and b/2."""
    value: Floats = getattr(run.table, column)
    band: Floats = 2 * getattr(run.table, f"std_{column}")
    calm = band <= np.percentile(band, CALM_PERCENT)
    low, high = min(value.min(), (value - band)[calm].min()), max(value.max(), (value + band)[calm].max())
    if (width := run.config.robot.track_width_m) is not None:
        low, high = min(low, SIDES[column] * width / 2), max(high, SIDES[column] * width / 2)
    middle, half = (low + high) / 2, max((high - low) / 2, LEAST_HALF_RANGE_M)
    return float(middle - 1.08 * half), float(middle + 1.08 * half)


def _rise_text(run: FilterRun, column: str) -> str:
    icr, rise = run.summary["icr"], run.convergence[column]
    final = f"final {icr['final'][column]:+.3f} ± {icr['final_std'][column]:.3f} m"
    return f"{final},  10–90 % in {rise[1] - rise[0]:.1f} s" if rise is not None else f"{final},  hardly moved from its start"


def _estimate_keys(run: FilterRun) -> list[Line2D | Patch]:
    mark = {"linestyle": "none", "marker": "o", "color": "black", "markersize": 5.5}
    keys: list[Line2D | Patch] = [
        Line2D([], [], color=LINE_COLOR, linewidth=1.0, label="estimate"),
        Patch(color=BAND_COLOR, linewidth=0, label="±2σ"),
    ]
    if any(rise is not None for rise in run.convergence.values()):
        keys.append(Line2D([], [], markerfacecolor="white", label="10 % of the way", **mark))
        keys.append(Line2D([], [], label="90 %", **mark))
    if run.config.robot.track_width_m is not None:
        keys.append(Line2D([], [], label="no slip (±b/2, 0)", **HALF_WIDTH.keywords()))
    if len(run.outages_ns):
        keys.append(Patch(color=OUTAGE_COLOR, linewidth=0, label="no usable GNSS"))
    return keys


def _draw_histogram(axes: Axes, run: FilterRun, column: str, value: Floats, weight: Floats) -> None:
    mean, std = run.summary["icr"]["mean"][column], run.summary["icr"]["std"][column]
    width = _bin_width(std)
    first = np.floor(value.min() / width) * width
    edges = first + width * np.arange(int((value.max() - first) / width) + 2)
    axes.hist(value, bins=edges.tolist(), weights=100 * weight / weight.sum(), color=BAR_COLOR, edgecolor="white", linewidth=0.4)
    axes.axvline(mean, **MEAN.keywords())
    if (track := run.config.robot.track_width_m) is not None:
        axes.axvline(SIDES[column] * track / 2, **HALF_WIDTH.keywords())
    axes.set_title(f"{mean:+.3f} ± {std:.3f} m", pad=3.0)
    axes.set_xlabel(f"{NAMES[column]} [m]")
    axes.grid(visible=False, axis="x")


def _bin_width(std: float) -> float:
    """Return a round bin width [m], a third to a half of the standard deviation."""
    target = max(std / 2.5, 1e-3)
    decade = 10.0 ** np.floor(np.log10(target))
    return float(decade * max(step for step in (1.0, 2.0, 5.0) if step * decade <= target * (1 + 1e-9)))
