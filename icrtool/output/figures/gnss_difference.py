"""How far the filter stays from the fixes (Pentzer 2014, Fig. 44)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from icrtool.kernels.filter_records import GATED, UNSEEN
from icrtool.output.figures.decimate import extremes, percentiles
from icrtool.output.figures.style import BAD_FIX_COLOR, BAR_COLOR, FLOAT_COLOR, MEAN, inches, new_figure, shade_spans
from icrtool.output.text_format import length_text, position_word, run_title
from icrtool.records.run import Run
from icrtool.records.tables import Bools, Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN, HEIGHT_IN = 7.2, 3.9

TYPICAL_PERCENT = 99.5
HEADROOM = 1.6
"""The y range ends at this many times the 99.5 % difference: a few outliers do not flatten the rest."""
LEAST_RANGE_M = 0.001
BREAK_PERCENT = 1.0
BREAK_IN_INTERVALS = 5.0
"""No line is drawn over a stretch without used fixes that is this long, and this many times the usual interval."""
MARKS = 400
"""Rejected fixes drawn one by one; of more, the extremes."""


def draw_gnss_difference(run: Run) -> Figure:
    """Draw the distance between filter and fixes over percent of the mission, rejected fixes apart."""
    facts = run.summary["gnss"]
    subtitle = f"Distance between filter and {position_word(run.summary)}"
    figure = new_figure(run_title(run.summary), subtitle, width_in=WIDTH_IN, height_in=HEIGHT_IN)
    axes = figure.subplots()
    figure.subplots_adjust(**inches(figure, left=0.75, right=0.2, top=0.65, bottom=1.0))
    duration = float(run.table.t_s[-1]) or 1.0
    percent, difference, code = 100 * run.gnss.t_s / duration, run.gnss.difference, run.gnss.code
    used, gated = (code > UNSEEN) & (code != GATED), code == GATED
    top = _top(difference[used])
    if used.any():
        trusted = used & ~run.sensors.fixes.down_weighted
        x, y = _with_breaks(percent[trusted], difference[trusted])
        shown = extremes(y)
        mean, most = (length_text(facts[name]) for name in ("mean_difference_m", "max_difference_m"))
        axes.plot(x[shown], y[shown], color=BAR_COLOR, linewidth=0.7, label=f"used, max {most}")
        axes.axhline(facts["mean_difference_m"], label=f"mean {mean}", **MEAN.keywords())
    if gated.any():
        _draw_rejected(axes, percent[gated], difference[gated], top)
    _mark_down_weighted(axes, percent, difference, run.sensors.fixes.down_weighted & used, top)
    lost = len(run.sensors.losses_ns) > 0
    shade_spans(
        axes,
        100 * (run.outages_ns - run.table.stamp_ns[0]) / 1e9 / duration,
        label="no usable GNSS, or RTK lost" if lost else "no usable GNSS",
    )
    axes.set_xlim(0, 100)
    axes.set_ylim(0, top)
    axes.set_xlabel("Mission time [%]")
    axes.set_ylabel("Difference [m]")
    # Five short entries stand side by side; with more, or longer ones, there are two rows.
    ncols = 3 if lost or run.sensors.fixes.down_weighted.any() else 5
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="lower center", ncols=ncols, columnspacing=1.6, handlelength=2.0)
    return figure


def _draw_rejected(axes: Axes, percent: Floats, difference: Floats, top: float) -> None:
    """Mark rejected fixes where they are, and those above the picture at its upper edge."""
    look: dict[str, Any] = {"linestyle": "none", "color": BAD_FIX_COLOR, "markersize": 4.5, "clip_on": False}
    beyond = difference > top
    for rows, marker, where in ((~beyond, "x", ""), (beyond, "^", ", above")):
        x, y = percent[rows], np.minimum(difference[rows], top)
        if len(x):
            shown = extremes(difference[rows], points=MARKS)
            axes.plot(x[shown], y[shown], marker=marker, label=f"{len(x)} rejected{where}", **look)


def _mark_down_weighted(axes: Axes, percent: Floats, difference: Floats, rows: Bools, top: float) -> None:
    """Mark the fixes that were used with the noise of float or other ones."""
    if not rows.any():
        return
    shown = extremes(difference[rows], points=MARKS)
    x, y = percent[rows][shown], np.minimum(difference[rows][shown], top)
    look: dict[str, Any] = {"linestyle": "none", "marker": ".", "color": FLOAT_COLOR, "markersize": 4.0}
    axes.plot(x, y, label=f"{np.count_nonzero(rows):,} down-weighted", **look)


def _top(difference: Floats) -> float:
    """Return the upper end of the y axis [m]."""
    if not len(difference):
        return 1.0
    typical = HEADROOM * percentiles(difference, (TYPICAL_PERCENT,))[0]
    return max(min(typical, 1.1 * float(difference.max())), LEAST_RANGE_M)


def _with_breaks(percent: Floats, difference: Floats) -> tuple[Floats, Floats]:
    """Return the points with a NaN in every stretch without fixes, so that no line crosses it."""
    if len(percent) < 2:
        return percent, difference
    interval = np.diff(percent)
    long = interval > max(BREAK_PERCENT, BREAK_IN_INTERVALS * float(np.median(interval)))
    after = np.flatnonzero(long) + 1
    return np.insert(percent, after, np.nan), np.insert(difference, after, np.nan)
