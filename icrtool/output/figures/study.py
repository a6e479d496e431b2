"""The picture of a study: dispatch, and the one most studies share (an ICR quantity over what was varied)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D

from icrtool.kernels.arrays import Floats
from icrtool.output.figures.study_runs import draw_convergence, draw_icr_change, icr_keys
from icrtool.output.figures.study_special import draw_consistency, draw_initial
from icrtool.output.figures.style import ICR_LOOKS, NO_SLIP, new_figure, styled
from icrtool.output.tables.study import capital, runs_text, study_title
from icrtool.simulation.studies import KINDS, StudyName, StudyResult
from icrtool.simulation.study_measures import ICR_NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OPEN_LOOP: dict[str, Any] = {"color": "#1b7837", "linestyle": "-", "marker": "D", "markersize": 3.5}

Rows = tuple[tuple[str, str, bool], ...]
"""Metric pattern, axis label, whether there is one for every ICR."""

ROWS: dict[StudyName, Rows] = {
    "turn-radius": (("settle_{icr}_s", "Within 10 % after [s]", True), ("inverted", "Ends inverted [%]", False)),
    "input-noise": (("error_{icr}_m", "ICR error [m]", True),),
    "input-bias": (("error_{icr}_m", "ICR error [m]", True),),
    "gnss": (("rms_{icr}_m", "ICR error, rms [m]", True), ("open_loop", "10 m without GNSS, p95 [m]", False)),
    "rate": (("error_{icr}_m", "ICR error [m]", True),),
}
LOGARITHMIC = frozenset({"gnss", "rate"})
PANEL_IN = 2.3
LEAST_RANGE_M = 0.02


@styled
def study_figure(result: StudyResult) -> Figure:
    """Return the picture of a study."""
    special: dict[StudyName, Callable[[StudyResult], Figure]] = {
        "convergence": draw_convergence,
        "icr-change": draw_icr_change,
        "initial": draw_initial,
        "consistency": draw_consistency,
        "input-source": draw_input_source,
    }
    return special.get(result.request.name, draw_sweep)(result)


def subtitle(result: StudyResult) -> str:
    """Return what was studied, on which path, and how often."""
    request = result.request
    path = request.plan.path
    what = f"{getattr(path, 'speed_mps', 0):g} m/s, {runs_text(request)}"
    if request.name != "turn-radius":
        what = f"{getattr(path, 'kind', '')} path, {what}"
    return f"{capital(KINDS[request.name].about)}; {what}"


def draw_sweep(result: StudyResult) -> Figure:
    """Draw metrics over what was varied: medians, bars from the 5th to the 95th percentile; one column a preset."""
    rows, presets = ROWS[result.request.name], result.request.presets
    figure = new_figure(
        study_title(result), subtitle(result), height_in=1.5 + PANEL_IN * len(rows), margins_in=(0.85, 0.2, 0.8, 0.95),
        wspace=0.12, hspace=0.18,
    )  # fmt: skip
    panels = figure.subplots(len(rows), len(presets), squeeze=False, sharex=True, sharey="row")
    for column, preset in enumerate(presets):
        levels = [level for level in result.levels if level["series"] == preset]
        for row, (metric, label, by_icr) in enumerate(rows):
            axes = panels[row][column]
            _draw_metric(axes, levels, metric, by_icr=by_icr)
            if column == 0:
                axes.set_ylabel(label)
            if metric.startswith("error"):
                axes.set_ylim(*_error_range(result))
        panels[0][column].set_title(f"preset {preset}", loc="left")
        axes = panels[-1][column]
        axes.set_xlabel(capital(KINDS[result.request.name].varies))
        if result.request.name in LOGARITHMIC:
            values = [level["value"] for level in levels]
            axes.set_xscale("log")
            axes.set_xticks(values, [f"{value:g}" for value in values], fontsize=7.5)
            axes.minorticks_off()
    if result.request.name == "gnss":
        for axes in panels.ravel():
            # On a drive without a turn nothing is missed, and zero has no logarithm.
            if all((np.asarray(line.get_ydata()) > 0).any() for line in axes.lines):
                axes.set_yscale("log")
    figure.legend(handles=_keys(result), ncols=5, columnspacing=1.6)
    return figure


def _error_range(result: StudyResult) -> tuple[float, float]:
    """Return a range [m] that shows all medians; bars of settings where a run diverged are cut at the frame."""
    medians = [level["metrics"][f"error_{icr}_m"]["p50"] for level in result.levels for icr in ICR_NAMES]
    finite = [value for value in medians if np.isfinite(value)]
    reach = max(LEAST_RANGE_M, float(np.ptp([*finite, 0.0])))
    return min([*finite, 0.0]) - 0.3 * reach, max([*finite, 0.0]) + 0.3 * reach


def _draw_metric(axes: Axes, levels: list[dict[str, Any]], metric: str, *, by_icr: bool) -> None:
    x = np.array([level["value"] for level in levels])
    if by_icr:
        if metric.startswith("error"):
            axes.axhline(0.0, color="0.6", linewidth=0.8)
        for icr, look in ICR_LOOKS.items():
            _bars(axes, x, [level["metrics"][metric.format(icr=icr)] for level in levels], look)
    elif metric == "open_loop":
        _bars(axes, x, [level["metrics"]["blind_icr_10m_p95_m"] for level in levels], OPEN_LOOP)
        no_slip = [level["metrics"]["blind_no_slip_10m_p95_m"]["p50"] for level in levels]
        axes.plot(x, no_slip, **NO_SLIP.keywords())
    else:
        axes.plot(
            x, [100 * level["metrics"][metric]["mean"] for level in levels], color="black", marker="o", markersize=3.5
        )
        axes.set_ylim(-4, 104)


def _bars(axes: Axes, x: Floats, found: list[dict[str, Any]], look: dict[str, Any]) -> None:
    middle, low, high = (np.array([one[name] for one in found]) for name in ("p50", "p5", "p95"))
    span = np.array([middle - low, high - middle])
    axes.errorbar(x, middle, span, linewidth=1.5, elinewidth=0.8, capsize=2.0, **look)


def _keys(result: StudyResult) -> list[Line2D]:
    keys = icr_keys()
    if result.request.name == "gnss":
        keys.append(Line2D([], [], label="open loop, final ICRs", **OPEN_LOOP))
        keys.append(Line2D([], [], label="open loop, no slip", **NO_SLIP.keywords()))
    return keys


def draw_input_source(result: StudyResult) -> Figure:
    """Draw the two inputs over time (Fig. 11), and the ICR errors with either."""
    figure = new_figure(
        study_title(result), subtitle(result), height_in=5.6, margins_in=(0.85, 0.2, 0.85, 0.8), hspace=0.42
    )  # fmt: skip
    top, bottom = figure.subplots(2, 1)
    curves = result.curves
    until = min(100.0, result.request.plan.duration_s)
    for name, color, width, order in (("encoder", "0.65", 0.6, 2), ("commanded", "#b2182b", 1.2, 3)):
        seen = curves[f"{name}_t"] <= until
        top.step(
            curves[f"{name}_t"][seen], curves[f"{name}_v"][seen], where="post", color=color, linewidth=width,
            label=name, zorder=order,
        )  # fmt: skip
    top.set(xlabel="Time [s]", ylabel="Left track speed [m/s]")
    top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.0)
    names = [f"{level['value']}\n{level['series']}" for level in result.levels]
    for shift, icr in zip((-0.15, 0.0, 0.15), ICR_NAMES, strict=True):
        x = np.arange(len(names), dtype=np.float64) + shift
        found = [level["metrics"][f"error_{icr}_m"] for level in result.levels]
        _bars(bottom, x, found, ICR_LOOKS[icr] | {"linestyle": "none"})
    bottom.axhline(0.0, color="0.6", linewidth=0.8)
    bottom.set_xticks(np.arange(len(names)), names)
    bottom.set_ylabel("ICR error [m]")
    figure.legend(handles=_keys(result), ncols=3)
    return figure
