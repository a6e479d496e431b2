"""Error over distance without GNSS: summary over the horizons, histograms (Pentzer 2014, Figs. 28-32, 37)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.patches import Patch

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.output.figures.style import (
    ICR,
    LABEL_BOX,
    MEAN,
    NO_SLIP,
    Pen,
    add_legend,
    fill_bins,
    new_figure,
    styled,
)
from icrtool.output.text_format import MODEL_WORDS, error_text, run_title
from icrtool.records.dropout import ModelResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANEL_HEIGHT_IN = 2.0

LOOKS = {"icr": (ICR.color, "o", "#a6c4e0"), "no_slip": (NO_SLIP.color, "s", "#f6d3a8")}
"""Colour, marker and colour of the band."""
CONSTANT_COLORS = ("#1b7837", "#762a83", "#8c510a", "#01665e", "#c51b7d")
"""Of the recommended model and of calibrations, in the order of the report."""

BUDGET = Pen("#b2182b", (0, (1.5, 2.0)), 1.0)
P95 = Pen("black", width=1.2)
"""The 95 % mark is a solid line, the expected value a dashed one (`MEAN`), in every picture."""

DASH = (0, (4.0, 2.0))
FLATTENING = 2.5
LEAST_HISTOGRAM_IN_P95, MOST_HISTOGRAM_IN_P95 = 1.3, 4.0
"""The histograms of a horizon share one scale: up to the largest p95 and a margin, but at most so many times that of
the ICRs. The share of trials beyond it is written at its end."""

MOSTLY_BEYOND_PCT = 90.0

SHORT_NAMES, KEY_IN = 4, 0.19
"""So many models have short names in the legend; height of a row of it."""


@styled
def dropout_summary(report: DropoutReport) -> Figure:
    """Return 95 % and expected error [m] over distance without GNSS [m], by model, and real outages.

    Where no slip is so far off that the ICR curves would lie on the axis, a second panel has them alone.
    """
    subtitle = (
        f"Open-loop error over distance without GNSS, up to {int(report.counts.trials.max()):,} trials a distance"
    )
    apart = _flattened(report)
    models = ("icr", "no_slip", *_constant_models(report), "icr_final")
    # names of calibrations are long
    columns = 4 if len(models) <= SHORT_NAMES else 3
    more_in = KEY_IN * max(2 * len(models) // columns - 2, 0)
    figure = new_figure(
        run_title(report.run_summary), subtitle + ("; right: no slip left out" if apart else ""),
        height_in=4.7 + more_in, margins_in=(0.7, 0.2, 0.65, 1.15 + more_in), wspace=0.28,
    )  # fmt: skip
    panels = figure.subplots(1, 2 if apart else 1, squeeze=False)[0]
    outages = [one for one in report.outages if one.kind == "real" and one.distance_m <= report.horizons_m[-1]]
    for axes, without in zip(panels, ("", "no_slip"), strict=False):
        for name in models:
            if name != without and (result := report.result(name)) is not None:
                _draw_model(axes, result, report)
        for number, budget in enumerate(dict.fromkeys(one.budget_m for one in report.budgets)):
            axes.axhline(budget, label="_" if number else "budget", **BUDGET.keywords())
        if outages:
            axes.plot(
                [one.distance_m for one in outages], [one.end_error_m for one in outages], linestyle="none", marker="X",
                color="black", markersize=7, zorder=5, clip_on=False, label="real outage",
            )  # fmt: skip
        axes.set(xlim=(0, report.horizons_m[-1] * 1.02), ylim=(0, None))
        axes.locator_params(axis="x", nbins=10, steps=[1, 2, 5, 10])
        axes.set(xlabel="Distance without GNSS [m]", ylabel="Error [m]")
    keys = [*panels[0].get_legend_handles_labels()[0], Patch(color="0.8", linewidth=0, label="95 % interval")]
    figure.legend(handles=keys, ncols=columns, columnspacing=1.6)
    return figure


@styled
def dropout_histogram(report: DropoutReport, horizon_m: float) -> Figure:
    """Return the percent of the trials by error [m] at one of the report's horizons [m], a panel a model.

    Raises
    ------
    ValueError
        The report has no such horizon.
    """
    if horizon_m not in report.horizons_m:
        raise ValueError(f"horizon_m: {horizon_m:g} m is not among the report's horizons")
    h = int(np.flatnonzero(report.horizons_m == horizon_m)[0])
    found = [result for name in (*LOOKS, *_constant_models(report)) if (result := report.result(name)) is not None]
    # A model of constant parameters may have no trial of a length that others have.
    results = [result for result in found if len(result.histograms[h].left)]
    what = f"Open-loop error after {horizon_m:g} m, {int(report.counts.trials[h]):,} trials"
    figure = new_figure(
        run_title(report.run_summary), what,
        height_in=1.5 + PANEL_HEIGHT_IN * len(results), margins_in=(0.7, 0.2, 0.85, 0.9), hspace=0.45,
    )  # fmt: skip
    panels = figure.subplots(len(results), 1, squeeze=False)[:, 0]
    end = _histogram_end([result.summary.p95[h] for result in results])
    for axes, result in zip(panels, results, strict=True):
        _draw_bins(axes, result, h, _look(report, result.name)[0], end)
    panels[-1].set_xlabel("Error [m]")
    add_legend(figure, columnspacing=3.0)
    return figure


def _constant_models(report: DropoutReport) -> tuple[str, ...]:
    """Return the recommended model and the calibrations that the report has rows of."""
    given = {one.name for one in report.calibrations}
    return tuple(result.name for result in report.results if result.name in {"recommended", "controller"} | given)


def _look(report: DropoutReport, name: str) -> tuple[str, str, str]:
    """Return colour, marker and colour of the band of a model."""
    if name in LOOKS:
        return LOOKS[name]
    color = CONSTANT_COLORS[_constant_models(report).index(name) % len(CONSTANT_COLORS)]
    return color, "D" if name == "recommended" else "^", "0.8"


def _flattened(report: DropoutReport) -> bool:
    """Return whether no slip is so much worse that the ICR curves need a panel of their own."""
    icr, no_slip = report.result("icr"), report.result("no_slip")
    if icr is None or no_slip is None or not np.isfinite(no_slip.summary.p95).any():
        return False
    return bool(np.nanmax(no_slip.summary.p95) > FLATTENING * np.nanmax(icr.summary.p95))


def _draw_model(axes: Axes, result: ModelResult, report: DropoutReport) -> None:
    """Draw 95 % (filled marks, solid) and expected error (open marks, dashed) of a model with their intervals.

    The final ICRs, which are fitted to what they are tested on, are thin lines without marks.
    """
    summary, intervals, x = result.summary, result.intervals, report.horizons_m
    label = MODEL_WORDS.get(result.name, result.label)
    look: dict[str, Any] = {"color": "0.35", "linewidth": 0.9}
    if result.name == "icr_final":
        label = "final ICRs"
    else:
        color, marker, band = _look(report, result.name)
        look = {"color": color, "marker": marker, "markersize": 4.5}
        for low, high in (
            (intervals.p95_low, intervals.p95_high),
            (intervals.expected_low, intervals.expected_high),
        ):
            axes.fill_between(x, low, high, color=band, alpha=0.6, linewidth=0)
    axes.plot(x, summary.p95, label=f"{label}, 95 %", **look)
    axes.plot(x, summary.expected, label=f"{label}, expected", linestyle=DASH, markerfacecolor="white", **look)


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
    axes.axvline(p95, label="95 % of the trials", **P95.keywords())
    axes.axvline(expected, label="expected value", **MEAN.keywords())
    label = MODEL_WORDS.get(result.name, result.label)
    axes.set_title(label, loc="left", pad=4.0, fontweight="bold")
    facts = f"expected {error_text(expected)},  95 % within {error_text(p95)},  max {error_text(largest)}"
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
