"""Error over distance without GNSS: summary over the horizons, histograms (Pentzer 2014, Figs. 28-32, 37)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.kernels.arrays import Floats
from icrtool.output.figures.style import ICR, MEAN, NO_SLIP, Pen, fill_bins, inches, new_figure
from icrtool.output.text_format import metres_text
from icrtool.records.dropout import ModelResult, Outage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN, SUMMARY_HEIGHT_IN, PANEL_HEIGHT_IN = 7.2, 4.7, 2.0

PENS = {"icr": ICR, "no_slip": NO_SLIP}
MARKERS = {"icr": "o", "no_slip": "s"}
BANDS = {"icr": "#a6c4e0", "no_slip": "#f6d3a8"}
CONSTANT_COLORS = ("#1b7837", "#762a83", "#8c510a", "#01665e", "#c51b7d")
"""Of the recommended model and of calibrations, in the order of the report."""

FINAL = Pen("0.35", width=0.9)
BUDGET = Pen("#b2182b", (0, (1.5, 2.0)), 1.0)
HISTOGRAM_LABELS = {"icr": "ICR", "no_slip": "no slip"}
P95 = Pen("black", width=1.2)
"""The 95 % mark is a solid line, the expected value a dashed one (`MEAN`), in every picture."""

LABEL_BOX: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8}
DASH = (0, (4.0, 2.0))
FLATTENING = 2.5
LEAST_HISTOGRAM_IN_P95, MOST_HISTOGRAM_IN_P95 = 1.3, 4.0
"""The histograms of a horizon share one scale: up to the largest p95 and a margin, but at most so many times that of
the ICRs. The share of trials beyond it is written at its end."""

MOSTLY_BEYOND_PCT = 90.0


def draw_summary(title: str, report: DropoutReport) -> Figure:
    """Draw 95 % and expected error over the horizon, with their intervals, and real outages where there were some.

    Where no slip is so far off that the ICR curves would lie on the axis, a second panel has them alone.
    """
    subtitle = (
        f"Open-loop error over distance without GNSS, up to {int(report.counts.trials.max()):,} trials a distance"
    )
    apart = _flattened(report)
    figure = new_figure(
        title,
        subtitle + ("; right: no slip left out" if apart else ""),
        width_in=WIDTH_IN,
        height_in=SUMMARY_HEIGHT_IN,
    )
    panels = figure.subplots(1, 2 if apart else 1, squeeze=False)[0]
    figure.subplots_adjust(**inches(figure, left=0.7, right=0.2, top=0.65, bottom=1.15), wspace=0.28)
    constant = _constant_models(report)
    for axes, shown in zip(panels, (("no_slip", "icr", *constant), ("icr", *constant)), strict=False):
        for budget in dict.fromkeys(one.budget_m for one in report.budgets):
            axes.axhline(budget, **BUDGET.keywords())
        if (final := report.result("icr_final")) is not None:
            for values, dash in ((final.summary.p95, "-"), (final.summary.expected, DASH)):
                axes.plot(report.horizons_m, values, color=FINAL.color, linewidth=FINAL.width, linestyle=dash)
        for name in shown:
            if (result := report.result(name)) is not None:
                _draw_model(axes, result, report.horizons_m, *_look(report, name))
        for one in _shown_outages(report):
            axes.plot([one.distance_m], [one.end_error_m], **_real_mark())
        axes.set_xlim(0, report.horizons_m[-1] * 1.02)
        axes.set_ylim(bottom=0)
        axes.locator_params(axis="x", nbins=10, steps=[1, 2, 5, 10])
        axes.set_xlabel("Distance without GNSS [m]")
        axes.set_ylabel("Error [m]")
    keys = _summary_keys(report, real=bool(_shown_outages(report)))
    figure.legend(handles=keys, loc="lower center", ncols=4, columnspacing=1.6, handlelength=2.4)
    return figure


def draw_histogram(title: str, report: DropoutReport, horizon_m: float) -> Figure:
    """Draw the share of trials by error at one horizon, a panel a model, with the expected value and 95 % marked."""
    h = int(np.flatnonzero(report.horizons_m == horizon_m)[0])
    shown = (*PENS, *_constant_models(report))
    found = [result for name in shown if (result := report.result(name)) is not None]
    # A model of constant parameters may have no trial of a length that others have.
    results = [result for result in found if len(result.histograms[h].left)]
    figure = new_figure(
        title,
        f"Open-loop error after {horizon_m:g} m, {int(report.counts.trials[h]):,} trials",
        width_in=WIDTH_IN,
        height_in=1.5 + PANEL_HEIGHT_IN * len(results),
    )
    panels = figure.subplots(len(results), 1, squeeze=False)[:, 0]
    margins = inches(figure, left=0.7, right=0.2, top=0.85, bottom=0.9)
    figure.subplots_adjust(**margins, hspace=0.45)
    end = _histogram_end([result.summary.p95[h] for result in results])
    for axes, result in zip(panels, results, strict=True):
        _draw_bins(axes, result, h, _look(report, result.name)[0], end)
    panels[-1].set_xlabel("Error [m]")
    keys = [Line2D([], [], label="95 % of the trials", **P95.keywords())]
    keys.append(Line2D([], [], label="expected value", **MEAN.keywords()))
    figure.legend(handles=keys, loc="lower center", ncols=2, columnspacing=3.0)
    return figure


def _constant_models(report: DropoutReport) -> tuple[str, ...]:
    """Return the recommended model and the calibrations that the report has rows of."""
    fixed = {*PENS, "icr_final"}
    return tuple(result.name for result in report.results if result.name not in fixed)


def _look(report: DropoutReport, name: str) -> tuple[str, str, str]:
    """Return colour, marker and colour of the band of a model."""
    if name in PENS:
        return PENS[name].color, MARKERS[name], BANDS[name]
    color = CONSTANT_COLORS[_constant_models(report).index(name) % len(CONSTANT_COLORS)]
    return color, "D" if name == "recommended" else "^", "0.8"


def _flattened(report: DropoutReport) -> bool:
    """Return whether no slip is so much worse that the ICR curves need a panel of their own."""
    icr, no_slip = report.result("icr"), report.result("no_slip")
    if icr is None or no_slip is None or not np.isfinite(no_slip.summary.p95).any():
        return False
    return bool(np.nanmax(no_slip.summary.p95) > FLATTENING * np.nanmax(icr.summary.p95))


def _shown_outages(report: DropoutReport) -> list[Outage]:
    return [one for one in report.outages if one.kind == "real" and one.distance_m <= report.horizons_m[-1]]


def _draw_model(axes: Axes, result: ModelResult, horizons: Floats, color: str, marker: str, band: str) -> None:
    """Draw 95 % (filled marks, solid) and expected error (open marks, dashed) of a model with their intervals."""
    summary, intervals = result.summary, result.intervals
    look: dict[str, Any] = {"color": color, "marker": marker, "markersize": 4.5, "linewidth": 1.3, "markevery": 1}
    for low, high in (
        (intervals.p95_low, intervals.p95_high),
        (intervals.expected_low, intervals.expected_high),
    ):
        axes.fill_between(horizons, low, high, color=band, alpha=0.6, linewidth=0)
    axes.plot(horizons, summary.p95, **look)
    axes.plot(horizons, summary.expected, linestyle=DASH, markerfacecolor="white", **look)


def _summary_keys(report: DropoutReport, *, real: bool) -> list[Line2D | Patch]:
    keys: list[Line2D | Patch] = []
    for name in ("icr", "no_slip", *_constant_models(report)):
        if (result := report.result(name)) is not None:
            label, (color, marker, _) = HISTOGRAM_LABELS.get(name, result.label), _look(report, name)
            look: dict[str, Any] = {"color": color, "marker": marker, "markersize": 4.5}
            keys.append(Line2D([], [], label=f"{label}, 95 %", **look))
            keys.append(Line2D([], [], label=f"{label}, expected", linestyle=DASH, markerfacecolor="white", **look))
    if report.result("icr_final") is not None:
        keys.append(Line2D([], [], label="final ICRs, 95 %", **FINAL.keywords()))
        keys.append(Line2D([], [], label="final ICRs, expected", color=FINAL.color, linewidth=0.9, linestyle=DASH))
    keys.append(Patch(color="0.8", linewidth=0, label="95 % interval"))
    if report.budgets:
        keys.append(Line2D([], [], label="budget", **BUDGET.keywords()))
    if real:
        keys.append(Line2D([], [], label="real outage", **_real_mark()))
    return keys


def _real_mark() -> dict[str, Any]:
    return {"linestyle": "none", "marker": "X", "color": "black", "markersize": 7, "zorder": 5, "clip_on": False}


def _histogram_end(p95: list[np.floating[Any]]) -> float:
    """Return the right end [m] of the scale that the panels share, by their p95, that of the ICRs first."""
    end = min(LEAST_HISTOGRAM_IN_P95 * float(np.nanmax(p95)), MOST_HISTOGRAM_IN_P95 * float(p95[0]))
    return end if end > 0 else 1.0


def _draw_bins(axes: Axes, result: ModelResult, h: int, color: str, end_m: float) -> None:
    """Draw the bins of one model at horizon number `h` up to `end_m`, and its expected value and 95 %."""
    summary, bins = result.summary, result.histograms[h]
    p95, expected, largest = float(summary.p95[h]), float(summary.expected[h]), float(summary.largest[h])
    width = float(bins.right[0] - bins.left[0])
    edges = np.append(bins.left, bins.right[-1])
    fill_bins(axes, edges, bins.percent, color=color, alpha=0.75)
    axes.axvline(p95, **P95.keywords())
    axes.axvline(expected, **MEAN.keywords())
    label = HISTOGRAM_LABELS.get(result.name, result.label)
    axes.set_title(label, loc="left", pad=4.0, fontweight="bold")
    facts = f"expected {metres_text(expected)},  95 % within {metres_text(p95)},  max {metres_text(largest)}"
    axes.set_title(facts, loc="right", pad=4.0)
    axes.set_xlim(0, end_m)
    beyond = float(bins.percent[bins.left >= end_m].sum())
    where: dict[str, Any] = {"transform": axes.transAxes, "bbox": LABEL_BOX}
    if beyond >= MOSTLY_BEYOND_PCT:
        # Hardly a bar to see: words in their place.
        text = f"{beyond:.0f} % of the trials lie beyond this scale →"
        axes.text(0.5, 0.5, text, ha="center", va="center", fontsize=9.0, **where)
    elif beyond > 0:
        text = f"{beyond:.{0 if beyond >= 1 else 2}f} % beyond →"
        axes.text(1.0, 0.9, text, ha="right", va="top", fontsize=8.0, **where)
    axes.set_ylabel(f"Trials [% per {_width_text(width)}]")
    axes.grid(visible=False, axis="x")


def _width_text(metres: float) -> str:
    return f"{metres:g} m" if metres >= 0.1 else f"{100 * metres:g} cm"
