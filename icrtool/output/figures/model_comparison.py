"""The model comparison as a picture: 95 % and expected error at one horizon, a line a model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from icrtool.output.figures.style import ICR, inches, new_figure
from icrtool.output.text_format import FITTED
from icrtool.records.dropout import CHOICE_HORIZON_M, ModelScore

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN, ROW_IN = 7.2, 0.27


def draw_comparison(title: str, scores: Sequence[ModelScore], horizons_m: Sequence[float]) -> Figure:
    """Draw 95 % (filled) and expected error (open) of each model; held-out ones as circles, others as squares.

    Parameters
    ----------
    scores, horizons_m : of a `icrtool.calibration.model_comparison.ModelComparison`
    """
    h = int(np.argmin(np.abs(np.array(horizons_m) - CHOICE_HORIZON_M)))
    scores = [score for score in scores if score.summary.trials[h]]
    groups = sum(1 for score in scores if score.measured_heading) > 0
    figure = new_figure(
        title,
        f"Open-loop error after {horizons_m[h]:g} m, 95 % / expected, on distance they were not fitted to",
        width_in=WIDTH_IN,
        height_in=1.65 + ROW_IN * (len(scores) + 0.6 * groups),
    )
    axes = figure.subplots()
    figure.subplots_adjust(**inches(figure, left=2.75, right=1.05, top=0.62, bottom=0.9))
    _draw_rows(axes, scores, h)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("Error [m], logarithmic")
    axes.grid(visible=False, axis="y")
    keys = [
        Line2D([], [], label="95 %", linestyle="none", marker="D", color="0.25", markersize=5),
        Line2D([], [], label="expected", linestyle="none", marker="D", color="0.25", mfc="white", markersize=5),
        Line2D([], [], label="held out", linestyle="none", marker="o", color=ICR.color, markersize=6),
        Line2D([], [], label="not held out", linestyle="none", marker="s", color="0.6", markersize=6),
    ]  # fmt: skip
    figure.legend(handles=keys, loc="lower center", ncols=4, columnspacing=1.8)
    return figure


def _draw_rows(axes: Axes, scores: list[ModelScore], h: int) -> None:
    """Draw a row a model, best-known at the bottom; models with a measured heading stand apart."""
    places, labels, y = [], [], 0.0
    for before, score in zip([None, *scores], scores, strict=False):
        y -= 1.6 if before is not None and score.measured_heading and not before.measured_heading else 1.0
        held_out = score.fitted == "others"
        color, marker = (ICR.color, "o") if held_out else ("0.6", "s")
        p95, expected = float(score.summary.p95[h]), float(score.summary.expected[h])
        axes.plot([expected, p95], [y, y], color=color, linewidth=1.2)
        axes.plot([p95], [y], marker=marker, color=color, markersize=6.5, linestyle="none")
        axes.plot(
            [expected], [y], marker=marker, color=color, markerfacecolor="white", markersize=6.5, linestyle="none"
        )
        axes.annotate(
            f"{p95:.2f} / {expected:.2f} m", (p95, y), xytext=(7, 0), textcoords="offset points", va="center",
            fontsize=8, color="0.2", annotation_clip=False,
        )  # fmt: skip
        places.append(y)
        note = FITTED[score.fitted]
        labels.append(f"{score.label} ({note})" if note else score.label)
    axes.set_yticks(places, labels)
    axes.set_ylim(y - 0.7, -0.3)
    axes.tick_params(axis="y", length=0)
