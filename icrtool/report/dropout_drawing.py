"""The pictures of a dropout report, drawn by a second process while this one computes.

Matplotlib takes longer to load and to draw than all trials take to compute, and holds the interpreter while it does.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from icrtool.analysis.blind_paths import BlindDrive
    from icrtool.analysis.dropout import DropoutReport
    from icrtool.analysis.outages import Outage
    from icrtool.tables import States

Draw = Callable[..., None]

HISTOGRAM_MODELS = ("icr", "no_slip")
HISTOGRAM_HORIZONS_M = (5.0, 10.0, 20.0)


class DrawingProcess:
    """A process that draws figures; it lives as long as its ``with`` block.

    On Linux it is forked: what was loaded before is there at once, but a process with threads should not be forked.

    Parameters
    ----------
    formats : of ``png``, ``svg`` and ``pdf``; with none nothing is started and nothing drawn
    """

    def __init__(self, formats: tuple[str, ...]) -> None:
        self._formats = formats
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
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

    @contextmanager
    def into(self, directory: Path) -> Iterator[Draw]:
        """Give ``draw(name, *content)``, which has figure ``name`` drawn into a new directory; wait for all at the end.

        Raises
        ------
        OSError
            A file cannot be written.
        """
        pending: list[Future[None]] = []

        def draw(name: str, *content: Any) -> None:
            if self._pool is not None:
                directory.mkdir(exist_ok=True)
                pending.append(self._pool.submit(_draw, name, directory, self._formats, content))

        try:
            yield draw
            for drawn in pending:
                drawn.result()
        finally:
            for drawn in pending:
                drawn.cancel()
            wait(pending)


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
        draw(f"examples_{examples[0].horizon_m:02.0f}m", title, examples)
    if worst:
        draw("worst", title, worst)
    if outages:
        draw("outages", title, table.north_m, table.east_m, outages)


def draw_histograms(draw: Draw, title: str, report: DropoutReport) -> None:
    """Have the histograms drawn, where there are trials; `report` needs the models of `HISTOGRAM_MODELS` only."""
    trials = dict(zip(report.horizons_m.tolist(), report.counts.trials.tolist(), strict=True))
    for horizon in HISTOGRAM_HORIZONS_M:
        if trials.get(horizon):
            draw(f"histogram_{horizon:02.0f}m", title, report, horizon)


def draw_summary(draw: Draw, title: str, report: DropoutReport, outages: Sequence[Outage]) -> None:
    """Have the summary over all horizons drawn, where there are trials."""
    if report.counts.trials.any():
        draw("summary", title, report, outages)


def _begin() -> None:
    """Leave an interrupt to the parent, and what matplotlib says of an unwritable home directory unsaid."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


def _load_matplotlib() -> None:
    """Load what drawing needs, and fill the font cache, while there is nothing to draw yet."""
    from io import BytesIO

    from icrtool.report.figure_style import new_figure, style

    _figures()
    with style():
        figure = new_figure("A", "b", width_in=1, height_in=1)
        figure.subplots().plot([0.0, 1.0], label="c")
        figure.legend()
        figure.savefig(BytesIO(), format="png")


def _draw(name: str, directory: Path, formats: tuple[str, ...], content: tuple[Any, ...]) -> None:
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
