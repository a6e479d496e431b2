"""The figures of a dropout report, and when each can be drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from icrtool.output.figures.drawing_process import Draw
from icrtool.output.text_format import run_title

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from icrtool.dropout_analysis.report import DropoutReport

HISTOGRAM_MODELS = ("icr", "no_slip")
HISTOGRAM_HORIZONS_M = (5.0, 10.0, 20.0)


class ReportFigures:
    """Has the figures of one report drawn, each as soon as the growing report holds its numbers.

    Parameters
    ----------
    draw : of a `icrtool.output.figures.drawing_process.Drawer`
    """

    def __init__(self, draw: Draw) -> None:
        self._draw = draw
        self._single_drawn = False
        self._histograms_drawn = False

    def draw_ready(self, report: DropoutReport) -> None:
        """Have single trials and outages drawn at the first call, histograms once all models they show are there."""
        title = run_title(report.run_summary)
        if not self._single_drawn:
            self._single_drawn = True
            if report.examples:
                name = f"examples_{report.examples[0].horizon_m:02.0f}m"
                self._draw(write_figure, name, title, report.examples)
            if report.worst:
                path = report.reference_north_m, report.reference_east_m
                self._draw(write_figure, "worst", title, report.worst, *path)
            if report.outages:
                path = report.reference_north_m, report.reference_east_m
                self._draw(write_figure, "outages", title, *path, report.outages)
        width_known = report.run_summary["config"]["robot"]["track_width_m"] is not None
        wanted = [*(HISTOGRAM_MODELS if width_known else HISTOGRAM_MODELS[:1]), *report.expected]
        if not self._histograms_drawn and all(report.result(model) is not None for model in wanted):
            self._histograms_drawn = True
            trials = dict(zip(report.horizons_m.tolist(), report.counts.trials.tolist(), strict=True))
            for horizon in HISTOGRAM_HORIZONS_M:
                if trials.get(horizon):
                    self._draw(write_figure, f"histogram_{horizon:02.0f}m", title, numbers_of(report), horizon)

    def draw_rest(self, report: DropoutReport) -> None:
        """Have the summary over all horizons and the model comparison drawn, where there are trials."""
        title = run_title(report.run_summary)
        if report.counts.trials.any():
            self._draw(write_figure, "summary", title, numbers_of(report))
        if (table := report.comparison) is not None:
            self._draw(write_figure, "ladder", title, table.scores, table.horizons_m, table.blocks)


def numbers_of(report: DropoutReport) -> DropoutReport:
    """Return a report without the columns of the run, for another process to draw."""
    none = np.empty(0)
    return replace(
        report, reference_north_m=none, reference_east_m=none, worst=(), examples=(), by_turning=(), comparison=None,
        run_summary={},
    )  # fmt: skip


def write_figure(directory: Path, formats: tuple[str, ...], name: str, *content: object) -> None:
    """Draw one figure into a directory.

    Raises
    ------
    OSError
        A file cannot be written.
    """
    from icrtool.output.figures.style import save, style

    with style():
        save(_figures()[name.partition("_")[0]](*content), directory / name, formats)


def load_figures() -> None:
    """Load what these pictures need, in the process that will draw them."""
    _figures()


def _figures() -> dict[str, Callable[..., Figure]]:
    """Return the figures by the first word of their file's name."""
    from icrtool.output.figures import dropout_errors as figure_dropout
    from icrtool.output.figures import dropout_paths as figure_dropout_paths
    from icrtool.output.figures import model_comparison as comparison_figure

    return {
        "summary": figure_dropout.draw_summary,
        "histogram": figure_dropout.draw_histogram,
        "ladder": comparison_figure.draw_comparison,
        "examples": figure_dropout_paths.draw_examples,
        "worst": figure_dropout_paths.draw_worst,
        "outages": figure_dropout_paths.draw_outages,
    }
