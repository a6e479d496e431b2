"""Estimates of the filter: its ICRs over time, their histograms, its distance to the fixes (Pentzer 2014)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from icrtool.estimation.convergence import icr_std_m
from icrtool.kernels.arrays import Bools, Floats
from icrtool.output.figures import style
from icrtool.output.figures.sheet import new_sheet, styled
from icrtool.output.series import (
    LEAST_HALF_RANGE_M,
    ORANGE,
    RANGE_PERCENT,
    breaks_after,
    extremes,
    percentiles,
    round_steps,
    scale_end_m,
    scale_of,
)
from icrtool.output.text_format import error_text, fix_word, position_word, run_title, signed_text
from icrtool.records.run import ICR_COLUMNS, ICR_WORDS, Run
from icrtool.records.run_document import IcrColumn

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


SEGMENT = style.line_look(ORANGE, width=1.6)
"""Line of the mean ICR between two terrain changes."""

SIDES = {"y_icr_right_m": 1.0, "y_icr_left_m": -1.0, "x_icr_m": 0.0}
"""Places of the ICRs without slip, in half track widths."""

NO_SLIP_PLACE = {"label": "no slip (±b/2, 0)", **style.HALF_WIDTH}
"""Line of an ICR without slip."""

BAND_RANGE_PERCENT = (2.0, 98.0)
CLUSTER_RANGE_PERCENT = (0.5, 99.5)
"""Percentiles, as `RANGE_PERCENT`, for the edges of a band and of a histogram."""

DRIVE_BEHIND = 0.02
"""Distance between the end of the time and the ICR of the whole drive, as a share of the axis."""

DRIVE_LOOK: style.Look = {
    "marker": "s", "markersize": 4.0, "color": style.ICR["color"], "linestyle": "none", "elinewidth": 1.4,
    "capsize": 2.0,
}  # fmt: skip
"""Marker of the ICR of the whole drive."""

LONG_RUN = 2.5
"""Ratio of the run to its learning time from which on the learning has its own panel."""
LEARNING_MARGIN = 0.6
"""Time after the convergence that the panel of the learning shows, as a share of the learning time."""

LEAST_MARGIN_S = 10.0
"""Smallest time after the convergence that this panel shows [s]."""

ICR_BINS = 30
"""Approximate number of bins of a histogram of an ICR."""


def _time_axis(span_s: float) -> tuple[str, float]:
    """Return the name of a time axis in the unit that suits a span [s], and its seconds."""
    unit, seconds = ("s", 1.0) if span_s <= 600 else ("min", 60.0) if span_s <= 4 * 3600 else ("h", 3600.0)
    return f"Time [{unit}]", seconds


@styled
def icr_estimates(run: Run, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of the three ICR estimates over time, with ±1σ, convergence, half track width and outages.

    A long run has two columns, each with its own scale: the learning, and what follows. Behind the end stand the ICRs
    of the whole drive, which the title states. `ax`: axes to draw into, which are returned; by default the picture
    is a new figure.
    """
    finals, stds = run.document.icr.final, run.document.icr.final_std
    ends = ", ".join(
        f"{ICR_WORDS[column]} {signed_text(final_m)} m"
        for column in ICR_COLUMNS
        if (final_m := finals[column]) is not None
    )
    unknown = ", ".join(ICR_WORDS[column] for column in ICR_COLUMNS if finals[column] is None)
    title = f"The ICRs end at {ends}{f'; not shown: {unknown}' if unknown else ''}"
    spans = [(0.0, float(run.table.t_s[-1]))]
    if begins := [converging[0] for converging in run.convergence_s.values() if converging is not None]:
        first, last = min(begins), run.settled_s
        margin = max(LEARNING_MARGIN * (last - first), LEAST_MARGIN_S)
        begin, end = max(first - margin, 0.0), last + margin
        if spans[0][1] - begin > LONG_RUN * (end - begin):
            spans = [(begin, end), (end, spans[0][1])]
    learning = "; left: learning, right: after it" if len(spans) > 1 else ""
    sheet = new_sheet(
        title if ends else f"This drive does not show its ICRs: {unknown}",
        f"{run_title(run.document)}: estimates of the filter{learning}", ax,
        height_in=6.0, margins_in=(0.75, 0.2, 0.8, 1.05), wspace=0.22, hspace=0.3,
    )  # fmt: skip
    panels = sheet.subplots(3, len(spans), sharex="col", width_ratios=(2, 3)[: len(spans)])
    for row, column in zip(panels, ICR_COLUMNS, strict=True):
        for axes, span in zip(row, spans, strict=True):
            _draw_estimate(axes, run, column, span, first=axes is row[0], last=axes is row[-1])
        row[0].set_ylabel(f"ICR {ICR_WORDS[column]} [m]")
        settling, final = run.convergence_s[column], finals[column]
        without = "known from the start" if run.began_with is not None else "does not converge"
        numbers = f"10–90 % in {settling[1] - settling[0]:.1f} s" if settling else without
        row[0].set_title(numbers, loc="left", pad=4.0)
        numbers = (
            f"final {signed_text(final)} ± {stds[column]:.3f} m" if final is not None else "not shown by this drive"
        )
        if final is not None and (of_drive := run.document.icr_of_drive(column)) is not None:
            numbers += f", drive {signed_text(of_drive[0])} ± {of_drive[1]:.3f} m"
        row[-1].set_title(numbers, loc="right", pad=4.0)
    for axes, (begin, end) in zip(panels[-1], spans, strict=True):
        axes.set_xlabel(_time_axis(end - begin)[0])
    sheet.legend(ncols=4, columnspacing=1.4, handlelength=2.0)
    return sheet.finish()


@styled
def icr_clusters(run: Run, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure with histograms of the three ICR estimates [m] after convergence, in percent of the time.

    `ax`: axes to draw into, which are returned; by default the picture is a new figure.
    """
    settled = run.settled_s
    after = run.table.t_s >= settled
    mean, std = run.document.icr.mean, run.document.icr.std
    spread = [f"{ICR_WORDS[column]} ±{std[column]:.3f} m" for column in ICR_COLUMNS if mean[column] is not None]
    title = f"The ICRs scatter by {', '.join(spread)}" if spread else "No ICR is shown"
    subtitle = f"{run_title(run.document)}: estimates from {settled:.1f} s on"
    sheet = new_sheet(title, subtitle, ax, height_in=3.9, margins_in=(0.75, 0.2, 1.0, 0.95))
    panels = sheet.subplots(1, 3, sharey=True)[0]
    weight = np.append(np.diff(run.table.t_s), 0.0)[after]
    columns: tuple[IcrColumn, ...] = ("y_icr_left_m", "x_icr_m", "y_icr_right_m")
    values: list[Floats] = [getattr(run.table, column)[after] for column in columns]
    spans = [float(np.ptp(percentiles(value, CLUSTER_RANGE_PERCENT))) for value in values]
    span = max(*spans, 2 * LEAST_HALF_RANGE_M)
    for axes, column, value in zip(panels, columns, values, strict=True):
        _draw_histogram(axes, run, column, value, weight, span)
    panels[0].set_ylabel("Time [%]")
    sheet.legend(columnspacing=3.0)
    return sheet.finish()


def _draw_estimate(
    axes: Axes, run: Run, column: IcrColumn, span_s: tuple[float, float], *, first: bool, last: bool
) -> None:  # fmt: skip
    """Draw one estimate over a span.

    The `first` panel also has b/2 and the start and end of the convergence, the `last` one the ICR of the whole drive.
    """
    table, unit = run.table, _time_axis(span_s[1] - span_s[0])[1]
    rows = slice(*np.searchsorted(table.t_s, [span_s[0], np.nextafter(span_s[1], np.inf)]))
    t, value, std = table.t_s[rows], getattr(table, column)[rows], icr_std_m(run, column)[rows]
    drawn_rows = extremes(value)
    axes.plot(t[drawn_rows] / unit, value[drawn_rows], color="black", linewidth=1.0, label="estimate")
    low, high = value - std, value + std
    drawn_rows = extremes(low, high)
    axes.fill_between(
        t[drawn_rows] / unit, low[drawn_rows], high[drawn_rows], color=style.BAND_COLOR, linewidth=0, label="its ±1σ"
    )
    spread = [*percentiles(value, RANGE_PERCENT), value[0], value[-1], low[-1], high[-1]]
    if first:
        # At the start the band is as wide as the spread of robots: it is shown to one standard deviation.
        spread += [low[0], high[0]]
        marks = ("white", "10 %"), ("black", "90 %: converged")
        for second, (fill, label) in zip(run.convergence_s[column] or (), marks, strict=False):
            spread.append(float(getattr(table, column)[np.searchsorted(table.t_s, second)]))
            axes.plot([second / unit], spread[-1:], zorder=4, clip_on=False, label=label, **style.spot_look(fill))
        if run.track_width_m is not None:
            spread.append(SIDES[column] * run.track_width_m / 2)
            axes.axhline(spread[-1], **NO_SLIP_PLACE)
    else:
        spread += [*percentiles(low, BAND_RANGE_PERCENT[:1]), *percentiles(high, BAND_RANGE_PERCENT[1:])]
    begin, end = span_s[0] / unit, max(span_s[1] / unit, span_s[0] / unit + 1e-3)
    axes.set_xlim(begin, end)
    if last and (of_drive := run.document.icr_of_drive(column)) is not None:
        drive_m, drive_std_m = of_drive
        spread += [drive_m - drive_std_m, drive_m + drive_std_m]
        axes.errorbar(
            [end + DRIVE_BEHIND * (end - begin)],
            [drive_m],
            [drive_std_m],
            clip_on=False,
            label="whole drive ±1σ",
            **DRIVE_LOOK,
        )
    axes.set_ylim(*scale_of(spread))
    axes.locator_params(axis="y", nbins=5)
    for change in run.changes_s:
        axes.axvline(change / unit, zorder=2.6, label="terrain change", **style.CHANGE_LINE)
    for segment in run.document.segments:
        if (mean := segment.mean[column]) is not None:
            stretch = segment.begin_s / unit, segment.end_s / unit
            axes.plot(stretch, (mean, mean), zorder=2.5, label="mean between", **SEGMENT)
    _shade_outages(axes, run, unit, f"no usable {fix_word(run.document)}")
    # If the panel cuts off an extreme of the estimate, its value is written at the edge.
    low_end, high_end = axes.get_ylim()
    for row, edge, arrow in ((int(value.argmin()), low_end, "↓"), (int(value.argmax()), high_end, "↑")):
        if not low_end <= value[row] <= high_end:
            text, va = f" {arrow} {signed_text(value[row])}", "top" if edge == high_end else "bottom"
            style.write_near(axes, text, (t[row] / unit, edge), va=va, fontsize=7.5, color=style.BAD_FIX_COLOR)


def _shade_outages(axes: Axes, run: Run, unit_s: float, label: str) -> None:
    """Shade the outages over the whole height, with one artist for any number of outages."""
    spans = (run.outages_ns - run.table.stamp_ns[0]) / 1e9 / unit_s
    if len(spans):
        bars = [(float(begin), float(end - begin)) for begin, end in spans]
        where = axes.get_xaxis_transform()
        axes.broken_barh(bars, (0, 1), transform=where, facecolor=style.OUTAGE_COLOR, zorder=0.5, label=label)


def _draw_histogram(axes: Axes, run: Run, column: IcrColumn, value: Floats, weight: Floats, span_m: float) -> None:
    """Draw percent of time over value, and show `span_m` of it."""
    middle = float(np.mean(percentiles(value, CLUSTER_RANGE_PERCENT)))
    low, high = middle - 0.6 * span_m, middle + 0.6 * span_m
    # The width of the bins is round, and gives about `ICR_BINS` bins.
    target = span_m / ICR_BINS
    width = float(min(round_steps(target), key=lambda step: abs(step - target)))
    first, last = int(np.floor(low / width)), int(np.ceil(high / width))
    share, edges = np.histogram(value, bins=last - first, range=(first * width, last * width), weights=weight)
    percent, label = 100 * share / max(weight.sum(), 1e-9), f"estimates, bins of {width:g} m"
    style.fill_bins(axes, edges, percent, color=style.BAR_COLOR, label=label)
    axes.set_xlim(low, high)
    mean, std = run.document.icr.mean[column], run.document.icr.std[column]
    title = "not shown"
    if mean is not None:
        axes.axvline(mean, label="mean", **style.MEAN)
        title = f"{signed_text(mean)} ± {std:.3f} m"
    if (track := run.track_width_m) is not None:
        no_slip_m = SIDES[column] * track / 2
        if low <= no_slip_m <= high:
            axes.axvline(no_slip_m, **NO_SLIP_PLACE)
        title += f"\nno slip: {signed_text(no_slip_m)} m"
    axes.set_title(title, pad=4.0)
    axes.set_xlabel(f"ICR {ICR_WORDS[column]} [m]")
    axes.locator_params(axis="x", nbins=3, min_n_ticks=2)
    axes.grid(visible=False, axis="x")


MOST_SINGLE = 1500
"""Largest number of used fixes that are drawn one by one."""

TIME_BINS = 300
"""Number of equal times in which more than `MOST_SINGLE` used fixes are drawn, by their range and median."""

MOST_CROSSES = 400
"""Largest number of rejected fixes that are drawn one by one. Of more, the extremes are drawn."""


@styled
def gnss_difference(run: Run, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of the distance between filter and fixes [m] over time, with marks for rejected fixes.

    If there are many fixes, the range and the median in each of `TIME_BINS` equal times are drawn. `ax`: axes to draw
    into, which are returned; by default the picture is a new figure.
    """
    facts, duration_s, fixes = run.document.gnss, float(run.table.t_s[-1]), run.sensors.fixes
    mean, most = facts.mean_difference_m, facts.max_difference_m
    count, word = facts.used + facts.rejected, position_word(run.document)
    apart = f"{error_text(mean)} from the {word} on average, " if mean is not None else ""
    title = f"Filter {apart}{100 * facts.rejected / max(count, 1):.0f} % rejected"
    subtitle = f"{run_title(run.document)}: distance between filter and {word}, {count:,} of them"
    sheet = new_sheet(title, subtitle, ax, height_in=3.9)
    axes = sheet.subplots()[0, 0]
    name, unit = _time_axis(duration_s)
    t, difference = run.gnss.t_s / unit, run.gnss.difference
    used, weak = run.gnss.used, run.gnss.used & fixes.down_weighted
    top = scale_end_m(difference[used])
    if mean is not None and most is not None:
        label = f"used, max {error_text(most)}"
        _draw_used(axes, t[used & ~weak], difference[used & ~weak], label)
        axes.axhline(mean, label=f"mean {error_text(mean)}", **style.MEAN)
    _mark(axes, t, difference, run.gnss.rejected, top, "rejected", "x", color=style.BAD_FIX_COLOR, markersize=4.5)
    _mark(axes, t, difference, weak, top, "down-weighted", ".", color=style.FLOAT_COLOR, markersize=4.0)
    lost = len(run.sensors.losses_ns) > 0
    _shade_outages(axes, run, unit, f"no usable {fix_word(run.document)}{', or RTK lost' if lost else ''}")
    axes.set(xlim=(0, max(duration_s / unit, 1e-3)), ylim=(0, top), xlabel=name, ylabel="Difference [m]")
    sheet.legend(ncols=3, columnspacing=1.6, handlelength=2.0)
    return sheet.finish()


def _draw_used(axes: Axes, t: Floats, difference: Floats, label: str) -> None:
    """Draw the fixes that the filter used: one by one, or by range and median where they are many."""
    if len(t) <= MOST_SINGLE:
        broken = (np.insert(column, breaks_after(t) + 1, np.nan) for column in (t, difference))
        axes.plot(*broken, color=style.BAR_COLOR, linewidth=0.7, label=label)
        return
    edges = np.linspace(t[0], t[-1], TIME_BINS + 1)
    parts = np.split(difference, np.searchsorted(t, edges[1:-1]))
    empty = np.full(3, np.nan)
    low, middle, high = np.array([np.percentile(part, (0, 50, 100)) if len(part) else empty for part in parts]).T
    centre = (edges[1:] + edges[:-1]) / 2
    axes.fill_between(centre, low, high, color=style.BAND_COLOR, linewidth=0, label=label)
    axes.plot(centre, middle, color=style.ICR["color"], linewidth=1.0, label="median")


def _mark(
    axes: Axes, t: Floats, difference: Floats, rows: Bools, top: float, label: str, marker: str, **look: Any
) -> None:
    """Mark fixes at their difference, of many fixes the extremes; fixes above the picture at its upper edge."""
    beyond = difference > top
    for chosen, shape, where in ((rows & ~beyond, marker, ""), (rows & beyond, "^", ", above")):
        if chosen.any():
            shown = extremes(difference[chosen], points=MOST_CROSSES)
            y, words = np.minimum(difference[chosen][shown], top), f"{np.count_nonzero(chosen):,} {label}{where}"
            axes.plot(t[chosen][shown], y, marker=shape, linestyle="none", clip_on=False, label=words, **look)
