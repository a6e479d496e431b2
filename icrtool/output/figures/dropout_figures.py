"""The pictures of a dropout report, in the order in which their numbers are there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from icrtool.output.figures.drawing_process import Draw

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from icrtool.calibration.model_comparison import Ladder
    from icrtool.records.dropout import BlindDrive, DropoutReport, Outage
    from icrtool.records.tables import States

HISTOGRAM_MODELS = ("icr", "no_slip")
HISTOGRAM_HORIZONS_M = (5.0, 10.0, 20.0)


def draw_examples(draw: Draw, title: str, examples: Sequence[BlindDrive]) -> None:
    """Have the typical drives drawn, where there are some."""
    if examples:
        draw(write_figure, f"examples_{examples[0].horizon_m:02.0f}m", title, examples)


def draw_worst(draw: Draw, title: str, worst: Sequence[BlindDrive]) -> None:
    """Have the worst drives drawn, where there are some."""
    if worst:
        draw(write_figure, "worst", title, worst)


def draw_outages(draw: Draw, title: str, table: States, outages: Sequence[Outage]) -> None:
    """Have the outages drawn, where there were some."""
    if outages:
        draw(write_figure, "outages", title, table.north_m, table.east_m, outages)


def draw_histograms(draw: Draw, title: str, report: DropoutReport) -> None:
    """Have the histograms drawn, where there are trials; `report` needs the models of `HISTOGRAM_MODELS` only."""
    trials = dict(zip(report.horizons_m.tolist(), report.counts.trials.tolist(), strict=True))
    for horizon in HISTOGRAM_HORIZONS_M:
        if trials.get(horizon):
            draw(write_figure, f"histogram_{horizon:02.0f}m", title, report, horizon)


def watch_for_histograms(draw: Draw, title: str, models: Sequence[str]) -> Callable[[DropoutReport], None]:
    """Return what has the histograms drawn when it is told that a report of these models holds those they show."""
    last = [name for name in models if name in HISTOGRAM_MODELS][-1]

    def told(report: DropoutReport) -> None:
        if report.results[-1].name == last:
            draw_histograms(draw, title, report)

    return told


def draw_summary(draw: Draw, title: str, report: DropoutReport, outages: Sequence[Outage]) -> None:
    """Have the summary over all horizons drawn, where there are trials."""
    if report.counts.trials.any():
        draw(write_figure, "summary", title, report, outages)


def draw_ladder(draw: Draw, title: str, ladder: Ladder) -> None:
    """Have the ladder of models drawn."""
    draw(write_figure, "ladder", title, ladder.rungs, ladder.horizons_m, ladder.blocks)


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
    from icrtool.output.figures import model_comparison as figure_ladder

    return {
        "summary": figure_dropout.draw_summary,
        "histogram": figure_dropout.draw_histogram,
        "ladder": figure_ladder.draw_ladder,
        "examples": figure_dropout_paths.draw_examples,
        "worst": figure_dropout_paths.draw_worst,
        "outages": figure_dropout_paths.draw_outages,
    }
