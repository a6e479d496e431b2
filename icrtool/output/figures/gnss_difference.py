"""How far the filter stays from the fixes (Pentzer 2014, Fig. 44; there over percent of the mission)."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from icrtool.kernels.arrays import Bools, Floats
from icrtool.output.decimate import extremes, percentiles
from icrtool.output.figures.style import (
    BAD_FIX_COLOR,
    BAND_COLOR,
    BAR_COLOR,
    FLOAT_COLOR,
    ICR,
    MEAN,
    add_legend,
    new_figure,
    shade_spans,
    styled,
    time_unit,
)
from icrtool.output.text_format import error_text, position_word, run_title
from icrtool.records.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TYPICAL_PERCENT = 99.5
HEADROOM = 1.6
"""The y range ends at this many times the 99.5 % difference: a few outliers do not flatten the rest."""
LEAST_RANGE_M = 0.001
BREAK_SHARE = 0.01
BREAK_IN_INTERVALS = 5.0
"""No line is drawn over a gap of this share of the time and this many times the usual interval."""
MOST_SINGLE = 1500
BINS = 300
"""More used fixes than `MOST_SINGLE` are drawn by their range and median in so many equal times."""
MARKS = 400
"""Rejected fixes drawn one by one; of more, the extremes."""


@styled
def gnss_difference(run: Run) -> Figure:
    """Return the distance between filter and fixes [m] over time, rejected fixes apart.

    Of many fixes, the range and the median in each of `BINS` equal times are drawn.
    """
    facts = run.document.gnss
    mean, most = facts.mean_difference_m, facts.max_difference_m
    of, word = facts.used + facts.rejected, position_word(run.document)
    apart = f"{error_text(mean)} from the {word} on average, " if mean is not None else ""
    figure = new_figure(
        f"Filter {apart}{100 * facts.rejected / max(of, 1):.0f} % rejected",
        f"{run_title(run.document)}: distance between filter and {word}, {of:,} of them", height_in=3.9,
    )  # fmt: skip
    axes = figure.subplots()
    unit, seconds = time_unit(float(run.table.t_s[-1]))
    t, difference = run.gnss.t_s / seconds, run.gnss.difference
    used, gated = run.gnss.used, run.gnss.rejected
    top = _top(difference[used])
    if mean is not None and most is not None:
        trusted = used & ~run.sensors.fixes.down_weighted
        _draw_used(axes, t[trusted], difference[trusted], f"used, max {error_text(most)}")
        axes.axhline(mean, label=f"mean {error_text(mean)}", **MEAN.keywords())
    _mark(axes, t, difference, gated, top, "rejected", "x", color=BAD_FIX_COLOR, markersize=4.5)
    weak = run.sensors.fixes.down_weighted & used
    _mark(axes, t, difference, weak, top, "down-weighted", ".", color=FLOAT_COLOR, markersize=4.0)
    lost = len(run.sensors.losses_ns) > 0
    shade_spans(
        axes,
        (run.outages_ns - run.table.stamp_ns[0]) / 1e9 / seconds,
        label="no usable GNSS, or RTK lost" if lost else "no usable GNSS",
    )
    axes.set(xlim=(0, max(float(run.table.t_s[-1]) / seconds, 1e-3)), ylim=(0, top))
    axes.set(xlabel=f"Time [{unit}]", ylabel="Difference [m]")
    # Five short entries stand side by side; with more, or longer ones, there are two rows.
    ncols = 3 if lost or run.sensors.fixes.down_weighted.any() else 5
    add_legend(figure, ncols=ncols, columnspacing=1.6, handlelength=2.0)
    return figure


def _draw_used(axes: Axes, t: Floats, difference: Floats, label: str) -> None:
    """Draw the fixes that the filter used: one by one, or by range and median where they are many."""
    if len(t) <= MOST_SINGLE:
        axes.plot(*_with_breaks(t, difference), color=BAR_COLOR, linewidth=0.7, label=label)
        return
    edges = np.linspace(t[0], t[-1], BINS + 1)
    bounds = np.searchsorted(t, edges)
    bounds[-1] = len(t)
    empty = np.full(3, np.nan)
    parts = [difference[a:b] for a, b in pairwise(bounds)]
    low, middle, high = np.array([np.percentile(part, (0, 50, 100)) if len(part) else empty for part in parts]).T
    centre = (edges[1:] + edges[:-1]) / 2
    axes.fill_between(centre, low, high, color=BAND_COLOR, linewidth=0, label=label)
    axes.plot(centre, middle, color=ICR.color, linewidth=1.0, label="median")


def _mark(
    axes: Axes, t: Floats, difference: Floats, rows: Bools, top: float, label: str, marker: str, **look: Any
) -> None:
    """Mark fixes where they are, the extremes of many; those above the picture at its upper edge."""
    beyond = difference > top
    for chosen, shape, where in ((rows & ~beyond, marker, ""), (rows & beyond, "^", ", above")):
        if chosen.any():
            shown = extremes(difference[chosen], points=MARKS)
            y, words = np.minimum(difference[chosen][shown], top), f"{np.count_nonzero(chosen):,} {label}{where}"
            axes.plot(t[chosen][shown], y, marker=shape, linestyle="none", clip_on=False, label=words, **look)


def _top(difference: Floats) -> float:
    """Return the upper end of the y axis [m]."""
    if not len(difference):
        return 1.0
    typical = HEADROOM * percentiles(difference, (TYPICAL_PERCENT,))[0]
    return max(min(typical, 1.1 * float(difference.max())), LEAST_RANGE_M)


def _with_breaks(t: Floats, difference: Floats) -> tuple[Floats, Floats]:
    """Return the points with a NaN in every stretch without fixes, so that no line crosses it."""
    if len(t) < 2:
        return t, difference
    interval = np.diff(t)
    long = interval > max(BREAK_SHARE * float(t[-1] - t[0]), BREAK_IN_INTERVALS * float(np.median(interval)))
    after = np.flatnonzero(long) + 1
    return np.insert(t, after, np.nan), np.insert(difference, after, np.nan)
