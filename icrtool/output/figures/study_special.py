"""Pictures of the studies with a shape of their own: initial ICRs (Figs. 6, 7) and consistency."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import Patch

from icrtool.kernels.arrays import Floats
from icrtool.output.figures.style import new_figure
from icrtool.output.tables.study import runs_text, study_title
from icrtool.simulation.studies import StudyResult
from icrtool.simulation.study_initial import GUARDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FATES = {"converged": (0.57, 0.77, 0.93), "elsewhere": (0.90, 0.90, 0.90), "inverted": (0.50, 0.0, 0.10)}
"""Colours, red green blue, mixed by the share of the runs."""

CASE_COLORS = {"model": "#1b7837", "paper": "#2166ac", "field": "#e08214"}
CASE_HATCHES = {"model": "", "paper": "///", "field": "..."}
CASE_DASHES = {"model": "-", "paper": (0, (6, 2)), "field": (0, (6, 1.5, 1.2, 1.5))}


def draw_initial(result: StudyResult) -> Figure:
    """Draw, by guard, the outcome of every start, and y_icr_right over time from starts along one column."""
    curves, starts = result.curves, result.curves["starts"]
    request = result.request
    figure = new_figure(
        study_title(result),
        f"Initial y ICRs {starts.min():g} to {starts.max():g} m, preset {request.presets[0]}; {runs_text(request)} "
        "from every start",
        height_in=5.6, margins_in=(0.7, 0.2, 0.85, 0.95), wspace=0.12, hspace=0.42,
    )  # fmt: skip
    panels = figure.subplots(2, len(GUARDS), sharey="row")
    near = float(curves["left_of_curves"][0])
    order = np.argsort(starts)
    for column, name in enumerate(GUARDS):
        picture = sum(curves[f"{fate} {name}"][..., None] * np.array(color) for fate, color in FATES.items())
        axes = panels[0][column]
        half = abs(float(starts[1] - starts[0])) / 2 if len(starts) > 1 else 0.5
        span = (starts.min() - half, starts.max() + half)
        axes.imshow(np.asarray(picture)[np.ix_(order, order)], origin="lower", extent=(*span, *span), aspect="auto")
        axes.plot(span, span, color="black", linewidth=0.9, linestyle=(0, (4, 2)))
        axes.grid(visible=False)
        axes.set_title(name, loc="left")
        axes.set_xlabel("Initial y left [m]")
        _draw_curves(panels[1][column], curves[f"trace {name}"], request.plan.icrs_m[0])
    panels[0][0].set_ylabel("Initial y right [m]")
    panels[1][0].set_ylabel(f"y right [m] (y left {near:g})")
    keys = [Patch(color=color, label=fate) for fate, color in FATES.items()]
    figure.legend(handles=keys, ncols=3, title="share of the runs; above the dashed line the start is proper")
    return figure


def _draw_curves(axes: Axes, traces: Floats, target: float) -> None:
    for one in traces:
        axes.plot(one[:, 0], np.clip(one[:, 1], -50, 50), color="0.35", linewidth=0.8)
    axes.axhline(target, color="#2166ac", linewidth=1.1, linestyle=(0, (4, 2)))
    axes.set(ylim=(-3.2, 3.2), xlabel="Time [s]")


def draw_consistency(result: StudyResult) -> Figure:
    """Draw NEES over time with its 95 % band, and how much of the time 2 sigma hold the truth, by state and case."""
    curves, cases = result.curves, [level["series"] for level in result.levels]
    request = result.request
    figure = new_figure(
        study_title(result),
        f"{runs_text(request)}; model: truth drawn from Q and R, paper and field: exact kinematics, preset's start",
        height_in=5.6, margins_in=(0.75, 0.2, 0.75, 0.85), hspace=0.4,
    )  # fmt: skip
    top, bottom = figure.subplots(2, 1)
    t = curves["stops_s"]
    low, high = curves["nees_band"]
    top.axhspan(low, high, color="#d9ead3", zorder=0.5, label="95 % band")
    for name in cases:
        top.plot(t, curves[f"nees {name}"], color=CASE_COLORS[name], linestyle=CASE_DASHES[name], label=name)
    top.set(yscale="log", xlabel="Time [s]", ylabel="NEES, mean (6 expected)")
    states = result.levels[0]["states"]
    width = 0.8 / len(cases)
    for place, name in enumerate(cases):
        x = np.arange(len(states)) + (place - (len(cases) - 1) / 2) * width
        look = {"color": CASE_COLORS[name], "edgecolor": "white", "linewidth": 0.0, "hatch": CASE_HATCHES[name]}
        bottom.bar(x, curves[f"coverage {name}"], width, label=name, **look)
    bottom.axhspan(90, 99, color="#d9ead3", zorder=0.5)
    bottom.axhline(95.4, color="black", linewidth=0.9, linestyle=(0, (4, 2)))
    bottom.set_ylim(min(80.0, *(float(curves[f"coverage {name}"].min()) - 2 for name in cases)), 101)
    bottom.set_xticks(np.arange(len(states)), [state.replace("_", " ") for state in states])
    bottom.set_ylabel("Within 2 sigma [%]")
    bottom.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(cases), borderaxespad=0.0)
    figure.legend(*top.get_legend_handles_labels(), ncols=4)
    return figure
