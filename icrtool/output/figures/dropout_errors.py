"""Error over distance without GNSS: summary over the horizons, histograms (Pentzer 2014, Figs. 28-32, 37)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.kernels.arrays import Floats
from icrtool.output.figures import style
from icrtool.output.text_format import error_text, run_title
from icrtool.records.acceptance import BudgetDistance
from icrtool.records.dropout_document import ModelResult, column_of
from icrtool.records.rows import LONGEST_ROW_NAME, row_of, rows_of, shown_rows
from icrtool.records.text import shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANEL_HEIGHT_IN, LOW_PANEL_IN = 2.0, 1.45

P95 = style.line("black", width=1.2)
"""Line of the 95 % mark: solid in every picture; the expected value is dashed (`MEAN`)."""

THIN = 0.9
BAND_ALPHA = 0.18
CURVE_POINTS = 200

LEAST_SHOWN = 0.7
"""Ratio of the lower end of the scale to the smallest drawn error, and of the largest drawn error to the upper end."""

MOST_DECADES = 4.0
LABEL_PT, LABEL_LINE_PT = 5.0, 13.0
SPACE_OF_LABEL = 0.09
"""Width of a distance's label, as a share of the axis. The label is left of its mark where it fits there."""

LEAST_HISTOGRAM_IN_P95 = 1.3
"""Ratio of the end of the histograms' common scale to the largest p95 of the models."""

MOST_HISTOGRAM_IN_P95 = 4.0
"""Largest ratio of the end of the scale to the first model's p95. The share of trials beyond the end is written
there."""

SUMMARY_KEY_COLUMNS = 3
"""Number of columns in the legend of the summary."""

MOSTLY_BEYOND_PCT = 90.0


@style.styled
def dropout_summary(report: DropoutReport) -> Figure:
    """Return 95 % and expected error [m] over distance without GNSS [m]: how far each model stays within the budget.

    It shows the rows that are shown and pictured; rows for comparison are thin lines.
    """
    models = [*_models(report), *(one for one in _pictured(report) if row_of(one.name).compared)]
    budgets_m = list(dict.fromkeys(one.budget_m for one in report.document.budgets))
    reached = [one for one in report.document.budgets if one.model in {model.name for model in models}]
    best = next((one for one in reached if one.model == models[0].name), None)
    pens = _pens(report)
    title = "Error over distance: no trial was long enough"
    if best is not None:
        title = f"{shortened(best.model, LONGEST_ROW_NAME)}: within {best.budget_m:g} m (95 %) for {best.short_text}"
    elif known := [row for row in models[0].document.by_horizon if row.p95_m is not None]:
        # For a run that is not usable no distance is stated.
        refused = "" if report.usable else "Do not use: "
        title = f"{refused}{error_text(known[-1].p95_m)} off (95 %) after {known[-1].horizon_m:g} m"
    # Entries in addition to the models: the mean of the first model, budget, outages.
    most = max(row.trials for row in report.document.trials)
    keys_in = style.KEY_ROW_IN * max(-(-(len(models) + 3) // SUMMARY_KEY_COLUMNS) - 2, 0)
    subtitle = f"{run_title(report.run_document)}: up to {most:,} trials a distance; bands: 95 % intervals"
    margins_in = (0.75, 0.25, 0.65, 0.95 + keys_in)
    figure = style.new_figure(title, subtitle, height_in=4.6 + keys_in, margins_in=margins_in)
    axes = figure.subplots()
    # A line begins where trials do, or where its model has used up the budget.
    first_m = min([report.horizons_m[0], *(one.distance_m for one in reached if not row_of(one.model).compared)])
    for one in models:
        _draw_model(axes, one, report.horizons_m, first_m, pens[one.name], first=one is models[0])
    outages = [one for one in report.document.outages if one.kind == "real" and one.distance_m <= report.horizons_m[-1]]
    if outages:
        look = style.spot("black", 7.0, "X") | {"zorder": 5, "label": "real outage"}
        axes.plot(column_of(outages, "distance_m"), column_of(outages, "end_error_m"), **look)
    # The scale holds all errors from the first horizon on, over at most `MOST_DECADES`.
    drawn = [*(one.column("p95_m") for one in models), models[0].column("expected_error_m")]
    errors = np.concatenate([*drawn, budgets_m, column_of(outages, "end_error_m")])
    errors = errors[np.isfinite(errors) & (errors > 0)]
    low, high = 0.01, 1.0
    if len(errors):
        high = float(errors.max()) / LEAST_SHOWN
        low = max(LEAST_SHOWN * float(errors.min()), high / 10**MOST_DECADES)
    axes.set(xlim=(0, report.horizons_m[-1] * 1.02), ylim=(low, high), xlabel="Distance without GNSS [m]")
    axes.locator_params(axis="x", nbins=10, steps=[1, 2, 5, 10])
    style.logarithmic_errors(axes, "y")
    label = f"budget {' and '.join(f'{one:g}' for one in budgets_m)} m"
    for budget in budgets_m:
        axes.axhline(budget, label=label, **style.BUDGET)
        marked = [one for one in reached if one.budget_m == budget and not (one.beyond or row_of(one.model).compared)]
        _mark_reaches(axes, marked, pens, low)
    style.add_legend(figure, ncols=SUMMARY_KEY_COLUMNS)
    return figure


@style.styled
def dropout_histograms(report: DropoutReport, *horizons_m: float) -> Figure:
    """Return the percent of the trials by error [m] of the first row, a panel a horizon, and the budget."""
    asked = [_place(report, metres) for metres in horizons_m]
    of_models = (
        (one, [h for h in asked if len(one.histograms[h].left)]) for one in (*_models(report), *report.results)
    )
    model, places = next(found for found in of_models if found[1])
    budgets_m = dict.fromkeys(one.budget_m for one in report.document.budgets)
    errors = ", ".join(error_text(model.document.by_horizon[h].p95_m).removesuffix(" m") for h in places)
    distances = ", ".join(f"{report.horizons_m[h]:g}" for h in places)
    title = f"95 % of the trials end within {errors} m after {distances} m"
    subtitle = f"{run_title(report.run_document)}: open-loop error of {model.name} ({model.document.words})"
    height_in, margins_in = 1.55 + LOW_PANEL_IN * len(places), (0.75, 0.25, 0.85, 0.9)
    figure = style.new_figure(title, subtitle, height_in=height_in, margins_in=margins_in, hspace=0.38)
    panels = figure.subplots(len(places), 1, squeeze=False, sharex=True)[:, 0]
    p95 = model.column("p95_m")[places]
    end = LEAST_HISTOGRAM_IN_P95 * max([np.nanmax(p95), *(one for one in budgets_m if one < 2 * np.nanmax(p95))])
    for axes, h in zip(panels, places, strict=True):
        heading = f"after {report.horizons_m[h]:g} m, {model.document.by_horizon[h].trials:,} trials"
        _draw_bins(axes, model, h, _pens(report)[model.name]["color"], end, heading)
        for budget in budgets_m:
            axes.axvline(budget, label=f"budget {budget:g} m", **style.BUDGET)
    panels[-1].set_xlabel("Error [m]")
    style.add_legend(figure, columnspacing=3.0)
    return figure


@style.styled
def dropout_histogram(report: DropoutReport, horizon_m: float) -> Figure:
    """Return the percent of the trials by error [m] at one of the report's horizons [m], a panel a model.

    Raises
    ------
    ValueError
        The report has no such horizon.
    """
    h = _place(report, horizon_m)
    # A model of constant parameters may have no trial of a length for which other models have one.
    results = [result for result in _pictured(report) if len(result.histograms[h].left)]
    p95 = [float(result.column("p95_m")[h]) for result in results]
    least, most = map(error_text, (min(p95), max(p95)))
    title = f"After {horizon_m:g} m 95 % of the trials end within {least.removesuffix(' m')} to {most}, by model"
    subtitle = f"{run_title(report.run_document)}: open-loop error of {report.document.trials[h].trials:,} trials"
    height_in, margins_in = 1.5 + PANEL_HEIGHT_IN * len(results), (0.75, 0.2, 0.85, 0.9)
    figure = style.new_figure(title, subtitle, height_in=height_in, margins_in=margins_in, hspace=0.45)
    panels = figure.subplots(len(results), 1, squeeze=False)[:, 0]
    end = min(LEAST_HISTOGRAM_IN_P95 * max(p95), MOST_HISTOGRAM_IN_P95 * p95[0])
    for axes, result in zip(panels, results, strict=True):
        _draw_bins(axes, result, h, _pens(report)[result.name]["color"], end, result.name)
    panels[-1].set_xlabel("Error [m]")
    style.add_legend(figure, columnspacing=3.0)
    return figure


def _pictured(report: DropoutReport) -> list[ModelResult]:
    """Return the rows that pictures show, in order."""
    by_name = {one.name: one for one in report.results}
    return [by_name[name] for name, row in rows_of(by_name).items() if row.pictured] or list(report.results[:1])


def _models(report: DropoutReport) -> list[ModelResult]:
    """Return the rows that pictures of distance show, the best row first, without the rows for comparison."""
    shown = shown_rows([one.name for one in report.results])
    found = [one for one in _pictured(report) if one.name in shown and not row_of(one.name).compared]
    best = report.document.best.model if report.document.best is not None else ""
    return sorted(found, key=lambda one: one.name != best) or list(report.results[:1])


def _pens(report: DropoutReport) -> dict[str, style.Look]:
    return style.row_pens(one.name for one in report.results)


def _place(report: DropoutReport, horizon_m: float) -> int:
    if horizon_m not in report.horizons_m:
        raise ValueError(f"horizon_m: {horizon_m:g} m is not among the report's horizons")
    return int(np.flatnonzero(report.horizons_m == horizon_m)[0])


def _draw_model(
    axes: Axes, result: ModelResult, horizons_m: Floats, first_m: float, pen: style.Look, *, first: bool
) -> None:  # fmt: skip
    """Draw the 95 % error of a model with its interval; for the `first` model also the expected error.

    A row for comparison has no interval. Lines interpolate between horizons like `budget_distances`, from error 0 at
    distance 0.
    """
    x = np.linspace(first_m, horizons_m[-1], CURVE_POINTS)
    known = np.isfinite(result.column("p95_m"))
    at = np.append(0.0, horizons_m[known])
    p95, low, high, mean = (
        np.where(x <= at[-1], np.interp(x, at, np.append(0.0, result.column(name)[known])), np.nan)
        for name in ("p95_m", "p95_low_m", "p95_high_m", "expected_error_m")
    )
    look = pen | {"zorder": 2.6 if first else 2.4}
    axes.plot(x, p95, label=f"{result.name}, 95 %", **look)
    if not row_of(result.name).compared:
        axes.fill_between(x, low, high, color=pen["color"], alpha=BAND_ALPHA, linewidth=0)
    if first:
        axes.plot(x, mean, label=f"{result.name}, mean", **look | {"linewidth": THIN})


def _mark_reaches(
    axes: Axes, reached: list[BudgetDistance], pens: Mapping[str, style.Look], lowest_m: float
) -> None:  # fmt: skip
    """Mark where models reach a budget: the nearest is written left of its curve, the others below, to the right."""
    below_pt = LABEL_PT
    for number, one in enumerate(sorted(reached, key=lambda one: one.distance_m)):
        pen = pens[one.model]
        axes.plot([one.distance_m] * 2, [lowest_m, one.budget_m], color=pen["color"], linewidth=0.7, zorder=1.5)
        axes.plot([one.distance_m], [one.budget_m], zorder=5, **style.spot("white", color=pen["color"]))
        left = number == 0 and one.distance_m > SPACE_OF_LABEL * axes.get_xlim()[1]
        offset_pt, ha, va = ((-5.0, 5.0), "right", "bottom") if left else ((5.0, -below_pt), "left", "top")
        if not left and one.distance_m > (1.0 - SPACE_OF_LABEL) * axes.get_xlim()[1]:
            offset_pt, ha = (-5.0, -below_pt), "right"
        look: style.Look = {"ha": ha, "va": va, "color": pen["color"], "fontweight": "bold", "zorder": 6}
        style.write_near(axes, f"{one.distance_m:.1f} m", (one.distance_m, one.budget_m), offset_pt, **look)
        below_pt += 0.0 if left else LABEL_LINE_PT


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
    where: dict[str, Any] = {"transform": axes.transAxes, "bbox": style.LABEL_BOX}
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
