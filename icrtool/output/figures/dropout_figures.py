"""The figures of a dropout report, and where each goes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from icrtool.output.figures.dropout_errors import draw_histogram, draw_summary
from icrtool.output.figures.dropout_paths import draw_examples, draw_outages, draw_worst
from icrtool.output.figures.model_comparison import draw_comparison
from icrtool.output.figures.style import save, style
from icrtool.output.text_format import run_title

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from icrtool.dropout_analysis.report import DropoutReport

HISTOGRAM_HORIZONS_M = (5.0, 10.0, 20.0)


def draw_figures(report: DropoutReport, directory: Path, formats: tuple[str, ...]) -> None:
    """Write every figure of a report into a directory.

    Parameters
    ----------
    directory : an existing directory
    formats : of ``png``, ``svg`` and ``pdf``

    Raises
    ------
    OSError
        A file cannot be written.
    """
    with style():
        for name, figure in _figures(report):
            save(figure, directory / name, formats)


def _figures(report: DropoutReport) -> Iterator[tuple[str, Figure]]:
    """Draw each figure for which the report holds numbers; yield it with the name of its file."""
    title, path = run_title(report.run_summary), (report.reference_north_m, report.reference_east_m)
    if report.examples:
        yield f"examples_{report.examples[0].horizon_m:02.0f}m", draw_examples(title, report.examples)
    if report.worst:
        yield "worst", draw_worst(title, report.worst, *path)
    if report.outages:
        yield "outages", draw_outages(title, *path, report.outages)
    trials = dict(zip(report.horizons_m.tolist(), report.counts.trials.tolist(), strict=True))
    for horizon in HISTOGRAM_HORIZONS_M:
        if trials.get(horizon):
            yield f"histogram_{horizon:02.0f}m", draw_histogram(title, report, horizon)
    if any(trials.values()):
        yield "summary", draw_summary(title, report)
    if (table := report.comparison) is not None:
        yield "ladder", draw_comparison(title, table.scores, table.horizons_m)
