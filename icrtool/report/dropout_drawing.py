"""The pictures of a dropout report, drawn by a second process while this one computes.

Matplotlib takes longer to load and to draw than all trials take to compute, and holds the interpreter while it does.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import sys
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from icrtool.analysis.dropout import DropoutReport
    from icrtool.report.dropout_content import DropoutContent
    from icrtool.tables import States

HISTOGRAM_HORIZONS_M = (5.0, 10.0, 20.0)


class DrawingProcess:
    """A process that draws figures; it lives as long as its ``with`` block.

    Enter the block before numpy is loaded: on Linux the process is forked, and a fork wants no other threads.

    Parameters
    ----------
    formats : of ``png``, ``svg`` and ``pdf``; with none nothing is started and nothing drawn
    """

    def __init__(self, formats: tuple[str, ...]) -> None:
        self._formats = formats
        self._pool: ProcessPoolExecutor | None = None
        self._pending: list[Future[None]] = []

    def __enter__(self) -> DrawingProcess:
        if self._formats:
            method = "fork" if sys.platform == "linux" else None
            self._pool = ProcessPoolExecutor(1, multiprocessing.get_context(method), initializer=_begin)
            self._pool.submit(_load_matplotlib)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def draw(self, name: str, directory: Path, *content: Any) -> None:
        """Have the figure ``draw_NAME`` of `FIGURES` drawn from `content` into ``directory/NAME``."""
        if self._pool is not None:
            self._pending.append(self._pool.submit(_draw, name, directory, self._formats, content))

    def finish(self) -> None:
        """Wait for all figures; the error of one that failed is raised here."""
        pending, self._pending = self._pending, []
        for drawn in pending:
            drawn.result()


def draw_paths(drawer: DrawingProcess, content: DropoutContent, table: States, directory: Path) -> None:
    """Have the pictures of single drives drawn."""
    if content.examples:
        drawer.draw(f"examples_{content.examples[0].horizon_m:02.0f}m", directory, content.title, content.examples)
    if content.worst:
        drawer.draw("worst", directory, content.title, content.worst)
    if content.outages:
        drawer.draw("outages", directory, content.title, table.north_m, table.east_m, content.outages)


def draw_statistics(drawer: DrawingProcess, content: DropoutContent, directory: Path) -> None:
    """Have the summary and the histograms drawn, where there are trials."""
    report: DropoutReport = content.report
    trials = dict(zip(report.horizons_m.tolist(), report.counts.trials.tolist(), strict=True))
    if any(trials.values()):
        drawer.draw("summary", directory, content.title, report, content.outages)
    for horizon in HISTOGRAM_HORIZONS_M:
        if trials.get(horizon):
            drawer.draw(f"histogram_{horizon:02.0f}m", directory, content.title, report, horizon)


def _begin() -> None:
    """Leave an interrupt to the parent, and what matplotlib says of an unwritable home directory unsaid."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


def _load_matplotlib() -> None:
    """Load what drawing needs, and fill the font cache, while there is nothing to draw yet."""
    from io import BytesIO

    from icrtool.report import figure_dropout, figure_dropout_paths
    from icrtool.report.figure_style import new_figure, style

    assert figure_dropout is not None and figure_dropout_paths is not None
    with style():
        figure = new_figure("A", "b", width_in=1, height_in=1)
        figure.subplots().plot([0.0, 1.0], label="c")
        figure.legend()
        figure.savefig(BytesIO(), format="png")


def _draw(name: str, directory: Path, formats: tuple[str, ...], content: tuple[Any, ...]) -> None:
    from icrtool.report import figure_dropout, figure_dropout_paths
    from icrtool.report.figure_style import save, style

    draw = {
        "summary": figure_dropout.draw_summary,
        "histogram": figure_dropout.draw_histogram,
        "examples": figure_dropout_paths.draw_examples,
        "worst": figure_dropout_paths.draw_worst,
        "outages": figure_dropout_paths.draw_outages,
    }[name.partition("_")[0]]
    with style():
        save(draw(*content), directory / name, formats)
