"""How far the filter stays from the fixes (Pentzer 2014, Fig. 44)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from icrtool.analysis.fit import FilterRun
from icrtool.core.ekf import GATED, UNSEEN
from icrtool.report.decimate import extremes
from icrtool.report.figure_style import BAD_FIX_COLOR, MEAN, inches, new_figure, shade_spans
from icrtool.report.words import position_word, run_title
from icrtool.tables import Bools, Floats

WIDTH_IN, HEIGHT_IN = 7.2, 3.9

LINE_COLOR = "#5b8db8"
TYPICAL_PERCENT = 99.5
HEADROOM = 1.6
"""The y range ends at this many times the 99.5 % difference: a few outliers do not flatten the rest."""
LEAST_RANGE_M = 0.01
MARKS = 400
"""Rejected fixes drawn one by one; of more, the extremes."""


def draw_gnss_difference(run: FilterRun) -> Figure:
    """Draw the distance between filter and fixes over percent of the mission, rejected fixes apart."""
    word = position_word(run)
    facts = run.summary["gnss"]
    figure = new_figure(
        run_title(run), f"Distance between filter and {word} fixes", width_in=WIDTH_IN, height_in=HEIGHT_IN
    )
    axes = figure.subplots()
    figure.subplots_adjust(**inches(figure, left=0.75, right=0.2, top=0.55, bottom=0.85))
    duration = float(run.table.t_s[-1])
    percent, difference, code = 100 * run.gnss.t_s / duration, run.gnss.difference, run.gnss.code
    used, gated = (code > UNSEEN) & (code != GATED), code == GATED
    top = _top(difference[used])
    shade_spans(axes, 100 * (run.outages_ns - run.table.stamp_ns[0]) / 1e9 / duration, label="no usable GNSS")
    if used.any():
        x, y = _with_breaks(run, percent, difference, used)
        shown = extremes(y)
        axes.plot(x[shown], y[shown], color=LINE_COLOR, linewidth=0.7, label="used fixes")
        axes.axhline(facts["mean_difference_m"], label=f"mean {_length(facts['mean_difference_m'])}", **MEAN.keywords())
    if gated.any():
        x, y = percent[gated], difference[gated]
        shown = extremes(y, points=MARKS)
        axes.plot(
            x[shown], np.minimum(y[shown], 0.985 * top), linestyle="none", marker="x", markersize=4.5, color=BAD_FIX_COLOR,
            label=f"rejected fixes ({int(gated.sum())}; at the top: beyond)", clip_on=False,
        )  # fmt: skip
    axes.set_xlim(0, 100)
    axes.set_ylim(0, top)
    axes.set_xlabel("Mission time [%]")
    axes.set_ylabel("Difference [m]")
    figure.legend(loc="lower center", ncols=4, columnspacing=2.0)
    return figure


def _top(difference: Floats) -> float:
    """Return the upper end of the y axis [m]."""
    if not len(difference):
        return 1.0
    typical = HEADROOM * float(np.percentile(difference, TYPICAL_PERCENT))
    return max(min(typical, 1.05 * float(difference.max())), LEAST_RANGE_M)


def _with_breaks(run: FilterRun, percent: Floats, difference: Floats, used: Bools) -> tuple[Floats, Floats]:
    """Return the used fixes with a NaN at the begin of every outage, so that no line crosses it."""
    x, y = percent[used], difference[used]
    begins = np.searchsorted(run.gnss.stamp_ns[used], run.outages_ns[:, 0], side="right")
    return np.insert(x, begins, np.nan), np.insert(y, begins, np.nan)


def _length(metres: float) -> str:
    return f"{100 * metres:.1f} cm" if metres < 1 else f"{metres:.2f} m"
