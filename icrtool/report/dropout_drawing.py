"""The pictures of a dropout report, in the order in which their numbers are there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from icrtool.report.drawing_process import Draw

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from icrtool.analysis.blind_paths import BlindDrive
    from icrtool.analysis.dropout import DropoutReport
    from icrtool.analysis.ladder import Ladder
    from icrtool.analysis.outages import Outage
    from icrtool.tables import States

HISTOGRAM_MODELS = ("icr", "no_slip")
HISTOGRAM_HORIZONS_M = (5.0, 10.0, 20.0)


def draw_paths(
    draw: Draw,
    title: str,
    table: States,
    drives: tuple[Sequence[BlindDrive], Sequence[BlindDrive]],
    outages: Sequence[Outage],
) -> None:
    """Have the pictures of single drives drawn: `drives` are the examples and the worst."""
    examples, worst = drives
    if examples:
        draw(write_figure, f"examples_{examples[0].horizon_m:02.0f}m", title, examples)
    if worst:
        draw(write_figure, "worst", title, worst)
    if outages:
        draw(write_figure, "outages", title, table.north_m, table.east_m, outages)


def draw_histograms(draw: Draw, title: str, report: DropoutReport) -> None:
    """Have the histograms drawn, where there are trials; `report` needs the models of `HISTOGRAM_MODELS` only."""
    trials = dict(zip(report.horizons_m.tolist(), report.counts.trials.tolist(), strict=True))
    for horizon in HISTOGRAM_HORIZONS_M:
        if trials.get(horizon):
            draw(write_figure, f"histogram_{horizon:02.0f}m", title, report, horizon)


def draw_summary(draw: Draw, title: str, report: DropoutReport, outages: Sequence[Outage]) -> None:
    """Have the summary over all horizons drawn, where there are trials."""
    if report.counts.trials.any():
        draw(write_figure, "summary", title, report, outages)


def draw_ladder(draw: Draw, title: str, ladder: Ladder) -> None:
    """Have the ladder of models drawn."""
    draw(write_figure, "ladder", title, ladder)


def write_figure(directory: Path, formats: tuple[str, ...], name: str, *content: object) -> None:
    """Draw one figure into a directory.

    Raises
    ------
    OSError
        A file cannot be written.
    """
    from icrtool.report.figure_style import save, style

    with style():
        save(_figures()[name.partition("_")[0]](*content), directory / name, formats)


def _figures() -> dict[str, Callable[..., Figure]]:
    """Return the figures by the first word of their file's name."""
    from icrtool.report import figure_dropout, figure_dropout_paths, figure_ladder

    return {
        "summary": figure_dropout.draw_summary,
        "histogram": figure_dropout.draw_histogram,
        "ladder": figure_ladder.draw_ladder,
        "examples": figure_dropout_paths.draw_examples,
        "worst": figure_dropout_paths.draw_worst,
        "outages": figure_dropout_paths.draw_outages,
    }
