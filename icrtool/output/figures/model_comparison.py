"""The model comparison as a picture: 95 % and expected error at one horizon, a line a model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.lines import Line2D

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import DataError
from icrtool.output.figures.style import ICR, logarithmic_errors, new_figure, styled
from icrtool.output.text_format import FITTED, run_title
from icrtool.records.dropout import CHOICE_HORIZON_M, ModelScore

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
ROW_IN = 0.27


@styled
def model_comparison(report: DropoutReport) -> Figure:
    """Return 95 % (filled) and expected error (open) [m] of each model; held-out ones are circles, others squares.

    Raises
    ------
    DataError
        The report holds no model comparison.
    """
    table = report.comparison
    if table is None:
        raise DataError(report.name, "the report holds no model comparison", report.no_comparison)
    h = int(np.argmin(np.abs(np.array(table.horizons_m) - CHOICE_HORIZON_M)))
    scores = [score for score in table.scores if score.summary.trials[h]]
    groups = any(score.measured_heading for score in scores)
    what = "95 % / expected, on distance they were not fitted to"
    figure = new_figure(
        run_title(report.run_summary), f"Open-loop error after {table.horizons_m[h]:g} m, {what}",
        height_in=1.65 + ROW_IN * (len(scores) + 0.6 * groups), margins_in=(2.75, 1.05, 0.62, 0.9),
    )  # fmt: skip
    axes = figure.subplots()
    _draw_rows(axes, scores, h)
    logarithmic_errors(axes)
    axes.grid(visible=False, axis="y")
    keys = [
        Line2D([], [], label="95 %", linestyle="none", marker="D", color="0.25", markersize=5),
        Line2D([], [], label="expected", linestyle="none", marker="D", color="0.25", mfc="white", markersize=5),
        Line2D([], [], label="held out", linestyle="none", marker="o", color=ICR.color, markersize=6),
        Line2D([], [], label="not held out", linestyle="none", marker="s", color="0.6", markersize=6),
    ]  # fmt: skip
    figure.legend(handles=keys, ncols=4)
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
        for place, fill in ((p95, color), (expected, "white")):
            axes.plot([place], [y], marker, color=color, markerfacecolor=fill, markersize=6.5)
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
