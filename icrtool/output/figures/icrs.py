"""The ICR estimates: over time (Pentzer 2014, Fig. 15) and how they cluster (Fig. 24)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.output.decimate import extremes, percentiles
from icrtool.output.figures.style import (
    BAD_FIX_COLOR,
    BAND_COLOR,
    BAR_COLOR,
    CHANGE,
    HALF_WIDTH,
    LABEL_BOX,
    MEAN,
    Pen,
    add_legend,
    fill_bins,
    new_figure,
    shade_spans,
    spot,
    styled,
    time_unit,
)
from icrtool.output.text_format import run_title, signed
from icrtool.records.run import ICR_COLUMNS, ICR_WORDS, Run
from icrtool.records.run_document import IcrColumn

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SEGMENT = Pen("#e08214", width=1.6)
# Plain text: mathtext costs more than the rest of a figure.
NAMES = {
    "y_icr_right_m": "ICR y right [m]",
    "y_icr_left_m": "ICR y left [m]",
    "x_icr_m": "ICR x [m]",
}
SIDES = {"y_icr_right_m": 1.0, "y_icr_left_m": -1.0, "x_icr_m": 0.0}
"""Where no slip puts an ICR, in half track widths."""

NO_SLIP_PLACE = {"label": "no slip (±b/2, 0)", **HALF_WIDTH.keywords()}

RANGE_PERCENT = (0.2, 99.8)
BAND_RANGE_PERCENT = (2.0, 98.0)
CLUSTER_RANGE_PERCENT = (0.5, 99.5)
"""A range passes over the extremes of so little of the time: one spike does not flatten the rest."""
LEAST_HALF_RANGE_M = 0.02

LONG_RUN = 2.5
"""A run this many times longer than its learning gets a panel of its own for the learning."""
LEARNING_MARGIN = 0.6
LEAST_MARGIN_S = 10.0

BINS = 30


def _answer(run: Run) -> str:
    """Return where the estimates ended, and which of them the drive does not show."""
    finals = {ICR_WORDS[column]: run.document.icr.final[column] for column in ICR_COLUMNS}
    ends = ", ".join(f"{word} {signed(value)} m" for word, value in finals.items() if value is not None)
    unknown = ", ".join(word for word, value in finals.items() if value is None)
    if not ends:
        return f"This drive does not show its ICRs: {unknown}"
    return f"The ICRs end at {ends}{f'; not shown: {unknown}' if unknown else ''}"


@styled
def icr_estimates(run: Run) -> Figure:
    """Return the three ICR estimates over time with ±2σ, their 10-90 % convergence, b/2 where known, and GNSS outages.

    A long run has two columns, each with its own scale: the learning, and what follows.
    """
    spans = _spans_s(run)
    learning = "; left: learning, right: after it" if len(spans) > 1 else ""
    figure = new_figure(
        _answer(run), f"{run_title(run.document)}: estimates of the filter{learning}",
        height_in=5.8, margins_in=(0.75, 0.2, 0.8, 0.9), wspace=0.22, hspace=0.3,
    )  # fmt: skip
    panels = figure.subplots(
        3, len(spans), squeeze=False, sharex="col", gridspec_kw={"width_ratios": (2, 3)[: len(spans)]}
    )
    for row, column in zip(panels, ICR_COLUMNS, strict=True):
        for axes, span in zip(row, spans, strict=True):
            _draw_estimate(axes, run, column, span, first=axes is row[0])
        row[0].set_ylabel(NAMES[column])
        row[0].set_title(_convergence_text(run, column), loc="left", pad=4.0)
        row[-1].set_title(_final_text(run, column), loc="right", pad=4.0)
    for axes, (begin, end) in zip(panels[-1], spans, strict=True):
        axes.set_xlabel(f"Time [{time_unit(end - begin)[0]}]")
    add_legend(figure, columnspacing=1.4, handlelength=2.0)
    return figure


@styled
def icr_clusters(run: Run) -> Figure:
    """Return histograms of the three ICR estimates [m] after convergence, in percent of the time."""
    settled = run.settled_s
    after = run.table.t_s >= settled
    mean, std = run.document.icr.mean, run.document.icr.std
    spread = (f"{ICR_WORDS[column]} ±{std[column]:.3f} m" for column in ICR_COLUMNS if mean[column] is not None)
    known = any(mean[column] is not None for column in ICR_COLUMNS)
    figure = new_figure(
        f"The ICRs scatter by {', '.join(spread)}" if known else "No ICR is shown",
        f"{run_title(run.document)}: estimates from {settled:.1f} s on",
        height_in=3.9, margins_in=(0.75, 0.2, 1.0, 0.9),
    )  # fmt: skip
    panels = figure.subplots(1, 3, sharey=True)
    weight = np.append(np.diff(run.table.t_s), 0.0)[after]
    columns: tuple[IcrColumn, ...] = ("y_icr_left_m", "x_icr_m", "y_icr_right_m")
    values: list[Floats] = [getattr(run.table, column)[after] for column in columns]
    spans = [float(np.ptp(percentiles(value, CLUSTER_RANGE_PERCENT))) for value in values]
    span = max(*spans, 2 * LEAST_HALF_RANGE_M)
    for axes, column, value in zip(panels, columns, values, strict=True):
        _draw_histogram(axes, run, column, value, weight, span)
    panels[0].set_ylabel("Time [%]")
    add_legend(figure, columnspacing=3.0)
    return figure


def _spans_s(run: Run) -> list[tuple[float, float]]:
    """Return begin and end [s] of the panels: all three estimates converging and what follows, or all in one."""
    duration = float(run.table.t_s[-1])
    begins = [span[0] for span in run.convergence_s.values() if span is not None]
    if not begins:
        return [(0.0, duration)]
    first, last = min(begins), run.settled_s
    margin = max(LEARNING_MARGIN * (last - first), LEAST_MARGIN_S)
    begin, end = max(first - margin, 0.0), last + margin
    return [(begin, end), (end, duration)] if duration - begin > LONG_RUN * (end - begin) else [(0.0, duration)]


def _draw_estimate(axes: Axes, run: Run, column: IcrColumn, span_s: tuple[float, float], *, first: bool) -> None:
    """Draw one estimate over a span; the `first` panel also has b/2 and the convergence."""
    table, unit = run.table, time_unit(span_s[1] - span_s[0])[1]
    rows = slice(*np.searchsorted(table.t_s, [span_s[0], np.nextafter(span_s[1], np.inf)]))
    t, value = table.t_s[rows] / unit, getattr(table, column)[rows]
    band = 2 * getattr(table, f"std_{column}")[rows]
    low, high = value - band, value + band
    shown = extremes(value)
    axes.plot(t[shown], value[shown], color="black", linewidth=1.0, label="estimate")
    shown = extremes(low, high)
    axes.fill_between(t[shown], low[shown], high[shown], color=BAND_COLOR, linewidth=0, label="±2σ")
    spread = [*percentiles(value, RANGE_PERCENT), value[0], value[-1], low[-1], high[-1]]
    if first:
        # Here the band is as wide as the prior: it is shown as far as the estimates go.
        spread += _draw_convergence(axes, run, column, unit)
    else:
        spread += [*percentiles(low, BAND_RANGE_PERCENT[:1]), *percentiles(high, BAND_RANGE_PERCENT[1:])]
    middle, half = (min(spread) + max(spread)) / 2, max(np.ptp(spread) / 2, LEAST_HALF_RANGE_M)
    axes.set_xlim(span_s[0] / unit, max(span_s[1] / unit, span_s[0] / unit + 1e-3))
    axes.set_ylim(middle - 1.12 * half, middle + 1.12 * half)
    axes.locator_params(axis="y", nbins=5)
    for change in run.changes_s:
        axes.axvline(change / unit, zorder=2.6, label="terrain change", **CHANGE.keywords())
    for segment in run.document.segments:
        if (mean := segment.mean[column]) is not None:
            stretch = segment.begin_s / unit, segment.end_s / unit
            axes.plot(stretch, (mean, mean), zorder=2.5, label="mean between", **SEGMENT.keywords())
    shade_spans(axes, (run.outages_ns - table.stamp_ns[0]) / 1e9 / unit, label="no usable GNSS")
    _mark_clipped(axes, t, value)


def _mark_clipped(axes: Axes, t: Floats, value: Floats) -> None:
    """Write the extreme of an estimate at the edge of the panel that cuts it off."""
    low, high = axes.get_ylim()
    for row, edge, arrow in ((int(value.argmin()), low, "↓"), (int(value.argmax()), high, "↑")):
        if not low <= value[row] <= high:
            axes.annotate(
                f"{arrow} {signed(value[row])}", (t[row], edge), ha="left", va="top" if edge == high else "bottom",
                fontsize=7.5, color=BAD_FIX_COLOR, bbox=LABEL_BOX,
            )  # fmt: skip


def _draw_convergence(axes: Axes, run: Run, column: IcrColumn, unit_s: float) -> list[float]:
    """Draw b/2 and the begin and end of the convergence; return where they are [m]."""
    heights: list[float] = []
    marks = ("white", "10 %"), ("black", "90 % of the change")
    for second, (fill, label) in zip(run.convergence_s[column] or (), marks, strict=False):
        heights.append(float(getattr(run.table, column)[np.searchsorted(run.table.t_s, second)]))
        axes.plot([second / unit_s], heights[-1:], zorder=4, clip_on=False, label=label, **spot(fill))
    if (width := run.track_width_m) is not None:
        heights.append(SIDES[column] * width / 2)
        axes.axhline(heights[-1], **NO_SLIP_PLACE)
    return heights


def _convergence_text(run: Run, column: IcrColumn) -> str:
    span = run.convergence_s[column]
    return f"10–90 % in {span[1] - span[0]:.1f} s" if span is not None else "starts near its final value"


def _final_text(run: Run, column: IcrColumn) -> str:
    final, std = run.document.icr.final[column], run.document.icr.final_std[column]
    return f"final {signed(final)} ± {std:.3f} m" if final is not None else "not shown by this drive"


def _draw_histogram(axes: Axes, run: Run, column: IcrColumn, value: Floats, weight: Floats, span_m: float) -> None:
    """Draw percent of time over value, and show `span_m` of it."""
    middle = float(np.mean(percentiles(value, CLUSTER_RANGE_PERCENT)))
    low, high = middle - 0.6 * span_m, middle + 0.6 * span_m
    width = _bin_width(span_m)
    first, last = int(np.floor(low / width)), int(np.ceil(high / width))
    share, edges = np.histogram(value, bins=last - first, range=(first * width, last * width), weights=weight)
    fill_bins(
        axes, edges, 100 * share / max(weight.sum(), 1e-9), color=BAR_COLOR, label=f"estimates, bins of {width:g} m"
    )
    axes.set_xlim(low, high)
    mean, std = run.document.icr.mean[column], run.document.icr.std[column]
    title = "not shown"
    if mean is not None:
        axes.axvline(mean, label="mean", **MEAN.keywords())
        title = f"{signed(mean)} ± {std:.3f} m"
    if (track := run.track_width_m) is not None:
        place = SIDES[column] * track / 2
        if low <= place <= high:
            axes.axvline(place, **NO_SLIP_PLACE)
        title += f"\nno slip: {signed(place)} m"
    axes.set_title(title, pad=4.0)
    axes.set_xlabel(NAMES[column])
    axes.locator_params(axis="x", nbins=3, min_n_ticks=2)
    axes.grid(visible=False, axis="x")


def _bin_width(span_m: float) -> float:
    """Return the round width of about `BINS` bins over a span [m]."""
    target = span_m / BINS
    decade = 10.0 ** np.floor(np.log10(target))
    return float(min((step * decade for step in (1.0, 2.0, 5.0, 10.0)), key=lambda step: abs(step - target)))
