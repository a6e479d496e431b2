"""Error over distance without GNSS: summary over the horizons, histograms (Pentzer 2014, Figs. 28-32, 37)."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.kernels.arrays import Floats
from icrtool.output.figures import style
from icrtool.output.figures.labels import Label, write_labels
from icrtool.output.figures.sheet import new_sheet, styled
from icrtool.output.text_format import error_text, fix_word, run_title
from icrtool.records.acceptance import BudgetDistance
from icrtool.records.dropout_document import ModelResult, column_of
from icrtool.records.rows import row_of, rows_of, shown_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANEL_HEIGHT_IN, LOW_PANEL_IN = 2.0, 1.45
"""Heights of the panel of one model, and of the panel of one horizon [in]."""

P95 = style.line_look("black", width=1.2)
"""Line of the 95 % mark: solid in every picture; the expected value is dashed (`MEAN`)."""

THIN = 0.9
"""Width of the lines of rows for comparison [points]."""

BANDS = (("", 0.32, "its 95 % interval", 1.4), ("next_", 0.13, "next drive, 9 of 10", 1.3))
"""Bands of the first row: part of the names of their ends, opacity, label, order."""

BAND_TOPS = ("p95_high_m", "p95_next_high_m")
"""Fields with the upper ends of the bands."""

MOST_BAND = 3.0
"""Largest ratio of the end of the scale to the largest line. A wider band is cut off."""

BAR_HORIZONS_M = (5.0, 10.0, 15.0, 20.0)
"""Distances at which rows other than the first have a bar for their interval [m]."""

BAR_LOOK: style.Look = {"linestyle": "none", "elinewidth": 1.1, "capsize": 2.0, "zorder": 2.3}
BAR_STEP = 0.009
"""Distance of these bars from one row to the next, as a share of the axis."""

TITLE_CHARACTERS = int(style.TITLE_CHARACTERS_PER_INCH * style.WIDTH_IN)
"""Number of characters that fit into a title."""

END_LINE = style.line_look("0.45", (0, (1.0, 2.0)), 1.0)
"""Line at the distance at which lines or bands end."""

UNIT_SPACE = re.compile(r"(\d) m\b")
"""Pattern of a number of metres and its unit."""

END_CHARACTERS = 30
"""Characters in a line of the text where lines and bands end."""

LEAST_SHOWN = 0.7
"""Ratio of the lower end of the scale to the smallest drawn error, and of the largest drawn error to the upper end."""

MOST_DECADES = 4.0
"""Largest range of the scale of errors, in decades."""

LEAST_HISTOGRAM_IN_P95 = 1.3
"""Ratio of the end of the histograms' common scale to the largest p95 of the models."""

MOST_HISTOGRAM_IN_P95 = 4.0
"""Largest ratio of the end of the scale to the first model's p95. The share of trials beyond the end is written
there."""

SUMMARY_KEY_COLUMNS = 3
"""Number of columns in the legend of the summary."""

MOSTLY_BEYOND_PCT = 90.0
"""Share of trials beyond the scale of a histogram above which a sentence replaces its bars [%]."""


@styled
def dropout_summary(report: DropoutReport, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the figure of 95 % and expected error [m] over distance without fixes [m], with the budget.

    It has the rows that are shown and pictured; rows for comparison are thin lines. The first row has bands: its
    interval on this drive, and the range of its error on the next drive. The other rows have bars at some distances,
    so that no two bands overlap. `ax`: axes to draw into, which are returned; by default the picture is a new figure.
    """
    models = [*_models(report), *(result for result in _pictured(report) if row_of(result.name).compared)]
    first, horizons_m = models[0], report.horizons_m
    budgets_m = list(dict.fromkeys(reach.budget_m for reach in report.document.budgets))
    reached = [reach for reach in report.document.budgets if reach.model in {model.name for model in models}]
    pens, rows = _pens(report), [row for row in first.document.by_horizon if row.p95_m is not None]
    ends = [rows[row] for row in ((0, -1) if len(rows) > 1 else (0,) if rows else ())]
    trials = ", ".join(f"{row.trials:,} trials of {row.horizon_m:g} m" for row in ends)
    # The legend has both errors and bands of the first model, the other models and their bars, budget and outages.
    keys_in = style.KEY_ROW_IN * max(-(-(len(models) + 6) // SUMMARY_KEY_COLUMNS) - 2, 0)
    sheet = new_sheet(
        _summary_title(report, first), f"{run_title(report.run_document)}: {first.name}, {trials or 'no trials'}", ax,
        height_in=4.7 + keys_in, margins_in=(0.75, 0.25, 0.65, 1.05 + keys_in),
    )  # fmt: skip
    axes = sheet.subplots()[0, 0]
    curves: list[tuple[Floats, Floats]] = []
    bars = [model for model in models[1:] if not row_of(model.name).compared]
    for model in models:
        crossings = [
            (reach.distance_m, reach.budget_m) for reach in reached if reach.model == model.name and not reach.beyond
        ]
        # A line begins where trials do, or where its model has used up the budget.
        if row_of(model.name).compared:
            crossings = [crossing for crossing in crossings if crossing[0] >= horizons_m[0]]
        curves.append(_draw_model(axes, model, horizons_m, crossings, pens[model.name], first=model is first))
        if model in bars:
            shift_m = BAR_STEP * float(horizons_m[-1]) * (bars.index(model) + 1) * (-1) ** bars.index(model)
            curves += _draw_bars(axes, model, horizons_m, shift_m, pens[model.name])
    outages = [
        outage for outage in report.document.outages if outage.kind == "real" and outage.distance_m <= horizons_m[-1]
    ]
    if bars:
        axes.errorbar([], [], [], label="other 95 % intervals", **BAR_LOOK | {"color": "0.35"})
    if outages:
        look = style.spot_look("black", 7.0, "X") | {"zorder": 5, "label": "real outage"}
        axes.plot(column_of(outages, "distance_m"), column_of(outages, "end_error_m"), **look)
    # The scale holds all errors from the first horizon on, over at most `MOST_DECADES`, and the band where it is near.
    drawn = [*(model.column("p95_m") for model in models), first.column("expected_error_m")]
    errors = np.concatenate([*drawn, budgets_m, column_of(outages, "end_error_m")])
    errors = errors[np.isfinite(errors) & (errors > 0)]
    low, high = 0.01, 1.0
    if len(errors):
        highest = [float(errors.max()), *(float(np.nanmax(first.column(name), initial=0.0)) for name in BAND_TOPS)]
        high = min(max(highest), MOST_BAND * highest[0]) / LEAST_SHOWN
        low = max(LEAST_SHOWN * float(errors.min()), high / 10**MOST_DECADES)
    word = fix_word(report.run_document)
    axes.set(xlim=(0, horizons_m[-1] * 1.02), ylim=(low, high), xlabel=f"Distance without {word} [m]")
    axes.locator_params(axis="x", nbins=10, steps=[1, 2, 5, 10])
    style.logarithmic_errors(axes, "y")
    label = f"budget {' and '.join(f'{budget_m:g}' for budget_m in budgets_m)} m"
    marked = []
    for budget in budgets_m:
        axes.axhline(budget, label=label, **style.BUDGET)
        marked += [
            reach
            for reach in reached
            if reach.budget_m == budget and not (reach.beyond or row_of(reach.model).compared)
        ]
    _write_end(axes, report, first)
    _mark_reaches(axes, marked, pens, low, curves)
    sheet.legend(ncols=SUMMARY_KEY_COLUMNS)
    return sheet.finish()


def _summary_title(report: DropoutReport, first: ModelResult) -> str:
    """Return how far the first row stays within its budget, on this drive and on the next; else its last error."""
    best = next((reach for reach in report.document.budgets if reach.model == first.name), None)
    if best is not None:
        # The distance on the next drive is left out where it is the same.
        after = f"; next drive {best.next_text}" if best.next_text and best.next_text != best.short_text else ""
        answer = f"within {best.budget_m:g} m (95 %) for {best.short_text}{after}"
        headline = f"{first.name}: {answer}"
        # The subtitle names the row, too.
        return headline if len(headline) <= TITLE_CHARACTERS else f"W{answer[1:]}"
    rows = [row for row in first.document.by_horizon if row.p95_m is not None]
    if not rows:
        return "Error over distance: no trial was long enough"
    # For a run that is not usable no distance is stated.
    refused = "" if report.usable else "Do not use: "
    return f"{refused}{error_text(rows[-1].p95_m)} off (95 %) after {rows[-1].horizon_m:g} m"


def _write_end(axes: Axes, report: DropoutReport, first: ModelResult) -> None:
    """Write why lines and bands end before the last horizon, where they do."""
    finite = [np.flatnonzero(np.isfinite(first.column(name))) for name in ("p95_m", "p95_high_m")]
    last, last_band = (int(rows[-1]) if len(rows) else -1 for rows in finite)
    horizons_m, texts = report.horizons_m, []
    if 0 <= last_band < last:
        texts.append(
            (last_band, f"bands end at {horizons_m[last_band]:g} m: too little path behind it for an interval")
        )
    if 0 <= last < len(horizons_m) - 1:
        why = report.document.trials[last + 1].why_none or "none of this row"
        texts.append((last, f"no trials beyond {horizons_m[last]:g} m: {why.partition(' (')[0]}"))
    for row, text in texts:
        horizon_m, label_left = float(horizons_m[row]), float(horizons_m[row]) > 0.5 * float(horizons_m[-1])
        axes.axvline(horizon_m, **END_LINE)
        wrapped = textwrap.fill(UNIT_SPACE.sub("\\1\N{NO-BREAK SPACE}m", text), END_CHARACTERS)
        look: style.Look = {"ha": "right" if label_left else "left", "va": "bottom", "fontsize": 8.0, "color": "0.25"}
        axes.annotate(
            wrapped, (horizon_m, 0.0), (-4.0 if label_left else 4.0, 5.0), textcoords="offset points", zorder=6,
            xycoords=axes.get_xaxis_transform(), **look,
        )  # fmt: skip


@styled
def dropout_histograms(report: DropoutReport, *horizons_m: float, ax: Axes | None = None) -> Figure | Axes:
    """Return histograms of the errors [m] of the first row in percent of the trials: one panel for each horizon.

    `ax`: axes to draw into, which are returned; by default the picture is a new figure.
    """
    horizon_indices = [_horizon_index(report, horizon_m) for horizon_m in horizons_m]
    drawable = (
        (result, [h for h in horizon_indices if len(result.histograms[h].left)])
        for result in (*_models(report), *report.results)
    )
    model, shown_horizons = next(drawn for drawn in drawable if drawn[1])
    budgets_m = dict.fromkeys(reach.budget_m for reach in report.document.budgets)
    errors = ", ".join(error_text(model.document.by_horizon[h].p95_m).removesuffix(" m") for h in shown_horizons)
    distances = ", ".join(f"{report.horizons_m[h]:g}" for h in shown_horizons)
    title = f"95 % of the trials end within {errors} m after {distances} m"
    subtitle = f"{run_title(report.run_document)}: open-loop error of {model.name} ({model.document.words})"
    height_in, margins_in = 1.55 + LOW_PANEL_IN * len(shown_horizons), (0.75, 0.25, 0.85, 0.9)
    sheet = new_sheet(title, subtitle, ax, height_in=height_in, margins_in=margins_in, hspace=0.38)
    panels = sheet.subplots(len(shown_horizons), 1, sharex=True)[:, 0]
    p95 = model.column("p95_m")[shown_horizons]
    end = LEAST_HISTOGRAM_IN_P95 * max(
        [np.nanmax(p95), *(budget_m for budget_m in budgets_m if budget_m < 2 * np.nanmax(p95))]
    )
    for axes, h in zip(panels, shown_horizons, strict=True):
        heading = f"after {report.horizons_m[h]:g} m, {model.document.by_horizon[h].trials:,} trials"
        _draw_bins(axes, model, h, _pens(report)[model.name]["color"], end, heading)
        for budget in budgets_m:
            axes.axvline(budget, label=f"budget {budget:g} m", **style.BUDGET)
    panels[-1].set_xlabel("Error [m]")
    sheet.legend(columnspacing=3.0)
    return sheet.finish()


@styled
def dropout_histogram(report: DropoutReport, horizon_m: float, *, ax: Axes | None = None) -> Figure | Axes:
    """Return histograms of the errors [m] at one of the report's horizons [m]: one panel for each model.

    `ax`: axes to draw into, which are returned; by default the picture is a new figure.

    Raises
    ------
    ValueError
        The report has no such horizon.
    """
    h = _horizon_index(report, horizon_m)
    # A model of constant parameters may have no trial of a length for which other models have one.
    results = [result for result in _pictured(report) if len(result.histograms[h].left)]
    p95 = [float(result.column("p95_m")[h]) for result in results]
    least, most = map(error_text, (min(p95), max(p95)))
    title = f"After {horizon_m:g} m 95 % of the trials end within {least.removesuffix(' m')} to {most}, by model"
    subtitle = f"{run_title(report.run_document)}: open-loop error of {report.document.trials[h].trials:,} trials"
    height_in, margins_in = 1.5 + PANEL_HEIGHT_IN * len(results), (0.75, 0.2, 0.85, 0.9)
    sheet = new_sheet(title, subtitle, ax, height_in=height_in, margins_in=margins_in, hspace=0.45)
    panels = sheet.subplots(len(results), 1)[:, 0]
    end = min(LEAST_HISTOGRAM_IN_P95 * max(p95), MOST_HISTOGRAM_IN_P95 * p95[0])
    for axes, result in zip(panels, results, strict=True):
        _draw_bins(axes, result, h, _pens(report)[result.name]["color"], end, result.name)
    panels[-1].set_xlabel("Error [m]")
    sheet.legend(columnspacing=3.0)
    return sheet.finish()


def _pictured(report: DropoutReport) -> list[ModelResult]:
    """Return the rows that pictures show, in order."""
    by_name = {result.name: result for result in report.results}
    return [by_name[name] for name, row in rows_of(by_name).items() if row.pictured] or list(report.results[:1])


def _models(report: DropoutReport) -> list[ModelResult]:
    """Return the rows that pictures of distance show, the best row first, without the rows for comparison."""
    shown_names = shown_rows([result.name for result in report.results])
    pictured = [
        result for result in _pictured(report) if result.name in shown_names and not row_of(result.name).compared
    ]
    best = report.document.best.model if report.document.best is not None else ""
    return sorted(pictured, key=lambda result: result.name != best) or list(report.results[:1])


def _pens(report: DropoutReport) -> dict[str, style.Look]:
    """Return the looks of the rows of a report by name."""
    return style.row_pens(result.name for result in report.results)


def _horizon_index(report: DropoutReport, horizon_m: float) -> int:
    """Return the index of a horizon [m] of a report."""
    if horizon_m not in report.horizons_m:
        raise ValueError(f"horizon_m: {horizon_m:g} m is not among the report's horizons")
    return int(np.flatnonzero(report.horizons_m == horizon_m)[0])


def _draw_model(
    axes: Axes, result: ModelResult, horizons_m: Floats, crossings: Sequence[tuple[float, float]], pen: style.Look, *,
    first: bool,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Draw the 95 % error of a model, of the `first` one also bands and the expected error; return the line (x, y).

    Lines are straight between horizons, and pass the places (distance, budget) where the model reaches a budget.
    """
    p95 = result.column("p95_m")
    drawn = np.isfinite(p95)
    x = np.append(horizons_m[drawn], [distance_m for distance_m, _ in crossings])
    y = np.append(p95[drawn], [budget_m for _, budget_m in crossings])
    order = np.argsort(x, kind="stable")
    look = pen | {"zorder": 2.6 if first else 2.4}
    axes.plot(x[order], y[order], label=f"{result.name}, 95 %", **look)
    if first:
        axes.plot(
            horizons_m, result.column("expected_error_m"), label=f"{result.name}, mean", **look | {"linewidth": THIN}
        )
        for name, alpha, label, order_z in BANDS:
            low, high = (result.column(f"p95_{name}{end}_m") for end in ("low", "high"))
            if np.isfinite(low + high).any():
                band: style.Look = {"color": pen["color"], "alpha": alpha, "linewidth": 0, "zorder": order_z}
                axes.fill_between(horizons_m, low, high, label=label, **band)
    return x[order], y[order]


def _draw_bars(
    axes: Axes, result: ModelResult, horizons_m: Floats, shift_m: float, pen: style.Look
) -> list[tuple[Floats, Floats]]:  # fmt: skip
    """Draw the interval of a model's 95 % error as bars near the distances of `BAR_HORIZONS_M`; return them (x, y)."""
    rows = np.flatnonzero(np.isin(horizons_m, BAR_HORIZONS_M))
    p95, low, high = (result.column(name)[rows] for name in ("p95_m", "p95_low_m", "p95_high_m"))
    drawn = np.isfinite(p95 + low + high)
    x, reach = horizons_m[rows][drawn] + shift_m, np.array([p95 - low, high - p95])[:, drawn]
    axes.errorbar(x, p95[drawn], reach, **BAR_LOOK | {"color": pen["color"]})
    return [(np.full(2, at), np.array(ends)) for at, *ends in zip(x, low[drawn], high[drawn], strict=True)]


def _mark_reaches(
    axes: Axes, reached: Sequence[BudgetDistance], pens: Mapping[str, style.Look], lowest_m: float,
    curves: Sequence[tuple[Floats, Floats]],
) -> None:  # fmt: skip
    """Mark where models reach a budget, and write the distance where it covers no line."""
    lines = list(curves)
    for reach in reached:
        pen = pens[reach.model]
        axes.plot([reach.distance_m] * 2, [lowest_m, reach.budget_m], color=pen["color"], linewidth=0.7, zorder=1.5)
        axes.plot([reach.distance_m], [reach.budget_m], zorder=5, **style.spot_look("white", color=pen["color"]))
        lines.append((np.full(2, reach.distance_m), np.array([lowest_m, reach.budget_m])))
        lines.append((np.array(axes.get_xlim()), np.full(2, reach.budget_m)))
    labels = [
        Label(f"{reach.distance_m:.1f} m", reach.distance_m, reach.budget_m, pens[reach.model]["color"])
        for reach in sorted(reached, key=lambda reach: reach.distance_m)
    ]
    write_labels(axes, labels, lines, crossing=True, size_pt=9.0, fontweight="bold")


def _draw_bins(axes: Axes, result: ModelResult, h: int, color: str, end_m: float, heading: str) -> None:
    """Draw the bins of one model at horizon number `h` up to `end_m`, and its expected value and 95 %."""
    row, bins, end_m = result.document.by_horizon[h], result.histograms[h], end_m or 1.0
    style.fill_bins(axes, np.append(bins.left, bins.right[-1]), bins.percent, color=color, alpha=0.75)
    axes.axvline(result.column("p95_m")[h], label="95 % of the trials", **P95)
    axes.axvline(result.column("expected_error_m")[h], label="expected value", **style.MEAN)
    axes.set_title(heading, loc="left", pad=4.0, fontweight="bold")
    expected, p95, largest = map(error_text, (row.expected_error_m, row.p95_m, row.max_m))
    axes.set_title(f"expected {expected},  95 % within {p95},  max {largest}", loc="right", pad=4.0)
    axes.set_xlim(0, end_m)
    axes.locator_params(axis="y", nbins=4)
    beyond = float(bins.percent[bins.left >= end_m].sum())
    where: dict[str, Any] = {"transform": axes.transAxes}
    if beyond >= MOSTLY_BEYOND_PCT:
        # Most trials are beyond the scale: a sentence replaces the bars.
        text = f"{beyond:.0f} % of the trials lie beyond this scale →"
        axes.text(0.5, 0.5, text, ha="center", va="center", fontsize=9.0, **where)
    elif beyond > 0:
        text = f"{beyond:.{0 if beyond >= 1 else 2}f} % beyond →"
        axes.text(1.0, 0.9, text, ha="right", va="top", fontsize=8.0, **where)
    width_m = float(bins.right[0] - bins.left[0])
    axes.set_ylabel(f"Trials [% per {f'{width_m:g} m' if width_m >= 0.1 else f'{100 * width_m:g} cm'}]")
    axes.grid(visible=False, axis="x")
