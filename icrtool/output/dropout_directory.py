"""``RUN/dropout/``: what `icrtool dropout-report` leaves behind, whole or not at all, and what report.json holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import msgspec

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.dropout_analysis.trials import ErrorSink
from icrtool.kernels.arrays import Ints
from icrtool.output.files.atomic import atomic_directory, files_in
from icrtool.output.files.formats import csv_bytes, json_bytes, list_anew, schema_of
from icrtool.output.files.states_file import trials_file
from icrtool.output.run_directory import is_run_directory
from icrtool.records.dropout_document import DropoutDocument, SummaryRow, TrialDocument
from icrtool.records.run import FigureSet

REPORT_FILE = "report.json"
TRIALS_FILE = "trials.parquet"
DROPOUT_DIRECTORY = "dropout"
"""Where a report stands in its run directory."""
SCHEMA_FAMILY = "icrtool/dropout/"

ERROR_COLUMNS = ("icr", "no_slip", "recommended", "controller")


def write_report(
    analyse: Callable[[ErrorSink | None], DropoutReport],
    directory: Path,
    *,
    plots: tuple[str, ...] = ("png",),
    figures: FigureSet = "default",
    stamp_ns: Ints | None = None,
    inside: Path | None = None,
) -> DropoutReport:
    """Write a report, whole or not at all; an old one in its place is replaced. The list of its run names its files.

    Parameters
    ----------
    analyse : gives the report; it is called with what takes every single trial, None where they are not written
    plots : formats of the figures, of ``png``, ``svg`` and ``pdf``; none: no figures
    figures : ``all``: those of the paper too
    stamp_ns : (n,) of the starts, to write every single trial to trials.parquet; None: they are not written
    inside : as in `icrtool.output.files.atomic.check_directory`

    Raises
    ------
    OutputError
        Something that is not a dropout report stands in its place, or the disk does not take it.
    """
    with atomic_directory(directory, is_dropout_directory, kind="dropout report", inside=inside) as partial:
        with trials_file(partial / TRIALS_FILE, stamp_ns) if stamp_ns is not None else nullcontext() as sink:
            report = analyse(sink)
        if plots:
            from icrtool.output.figure_catalogue import draw_figures

            draw_figures("report", report, partial / "plots", plots, figures)
        write_tables(report, partial)
        names = [name.as_posix() for name in files_in(partial)]
        if in_run := is_run_directory(directory.parent):
            list_anew(directory.parent, directory.name)
    if in_run:
        list_anew(directory.parent, directory.name, names)
    return report


def is_dropout_directory(directory: Path) -> bool:
    """Return whether a directory is a dropout report of ours, of whatever version."""
    return schema_of(directory / REPORT_FILE, directory).startswith(SCHEMA_FAMILY)


def write_tables(report: DropoutReport, directory: Path) -> None:
    """Write summary.csv, histogram.csv, worst.csv and report.json into a directory, and ladder.csv where there is one.

    Raises
    ------
    OSError
        A file cannot be written.
    """
    document = report.document
    summary = ((one.name, *msgspec.structs.astuple(row)) for one in document.models for row in one.by_horizon)
    (directory / "summary.csv").write_bytes(csv_bytes(("model", *SummaryRow.__struct_fields__), summary))
    (directory / "histogram.csv").write_bytes(csv_bytes(HISTOGRAM_COLUMNS, _histogram_rows(report)))
    (directory / "worst.csv").write_bytes(csv_bytes(WORST_COLUMNS, _worst_rows(document.worst)))
    if document.ladder.models:
        (directory / "ladder.csv").write_bytes(csv_bytes(COMPARISON_COLUMNS, comparison_rows(document)))
    (directory / REPORT_FILE).write_bytes(json_bytes(document))


HISTOGRAM_COLUMNS = ("model", "horizon_m", "bin_left_m", "bin_right_m", "percent")

WORST_COLUMNS = (
    "rank", "model", "stamp_ns", "t_s", "north_m", "east_m", "horizon_m", "heading_change_deg", "speed_mean_mps",
    *(f"{model}_error_m" for model in ERROR_COLUMNS),
)  # fmt: skip


COMPARISON_COLUMNS = (
    "model", "fitted", "heading", "horizon_m", "trials", "expected_error_m", "p50_m", "p95_m", "max_m",
    "expected_pct", "p95_pct",
)  # fmt: skip


def comparison_rows(report: DropoutDocument) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of ladder.csv, a model and horizon each; see `COMPARISON_COLUMNS`."""
    rows = {one.name: one.by_horizon for one in report.models}
    for score in report.ladder.models or ():
        for row in rows[score.name]:
            numbers = (getattr(row, name) for name in COMPARISON_COLUMNS[3:])
            yield score.name, score.fitted, score.heading, *numbers


def _histogram_rows(report: DropoutReport) -> Iterator[tuple[Any, ...]]:
    for result in report.results:
        for horizon, bins in zip(report.horizons_m, result.histograms, strict=True):
            for row in zip(*bins, strict=True):
                yield result.name, horizon, *row


def _worst_rows(worst: Sequence[TrialDocument]) -> Iterator[tuple[Any, ...]]:
    for rank, trial in enumerate(worst, start=1):
        *columns, errors = msgspec.structs.astuple(trial)
        yield rank, *columns, *(errors.get(model) for model in ERROR_COLUMNS)
