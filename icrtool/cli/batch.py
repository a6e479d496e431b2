"""``icrtool batch``, which fits and reports on many logs."""

from __future__ import annotations

import shutil
import textwrap
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, NamedTuple

import click
from msgspec.structs import replace

from icrtool.cli import lazy_imports, options
from icrtool.cli.options import LOG, PLACE, POSITIVE, Exports, flag, option
from icrtool.cli.printing import LiveLine, Printer, print_error
from icrtool.records.text import LogText, counted, escaped, shortened

with lazy_imports():
    from icrtool.fleet import batch as batches
    from icrtool.fleet import fleet_files, one_log
    from icrtool.output import text_blocks
    from icrtool.output.exports import acceptance
    from icrtool.output.files import remote_place
    from icrtool.records import notes

if TYPE_CHECKING:
    from icrtool.records.fleet_document import FleetLog
    from icrtool.records.requests import BatchRequest, LogRequest

LONGEST_STAGE, LEAST_NAME = 28, 12
"""Longest stage of a log with its separators, and shortest name of a log, in the live line [characters]."""


class Workers(NamedTuple):
    """The executor of a batch: arguments of `icrtool.fleet.processes.executor_of`."""

    jobs: int | None = None
    scheduler: str | None = None
    worker_timeout_s: float = 60.0


WORKERS = options.options_as_record(
    "workers",
    Workers,
    option("-j --jobs", "N", click.IntRange(min=1), "Number of logs at the same time; default: one per core, fewer if "
           "memory is short."),
    option("--scheduler", "ADDRESS", None, "Process on a Dask cluster, for example tcp://host:8786."),
    option("--worker-timeout worker_timeout_s", "SECONDS", POSITIVE, "Give up a cluster that has had no scheduler "
           "or no worker for this time.", default=60.0),
)  # fmt: skip
"""Options of the executor of a batch, as `workers`."""


BATCH = options.options_as_record(
    "batch",
    f"{options.REQUESTS_MODULE}:BatchRequest",
    option("--timeout timeout_s", "SECONDS", POSITIVE, "Stop a log that takes longer.", default=1800.0),
    flag("--redo", "Process logs again that are done."),
    options.report_options(flag("--overwrite", "Also replace runs of other recordings.")),
    options.CONFIGURATION,
    options.INPUT_LIMITS,
)
"""Options of a batch, as `batch` and `exports`."""


@options.command("batch")
@click.argument("places", metavar="LOG|FOLDER|MANIFEST...", nargs=-1, required=True, type=LOG)
@option("-o --output", "DIR", PLACE, "Folder for the tables, or its address; the run directories go to runs/ in it.",
        required=True)  # fmt: skip
@WORKERS
@BATCH
@options.printer_options(options.AS_JSON, options.QUIET, options.VERBOSE_OPTION)
def batch_command(
    places: tuple[Path, ...], output: Path, workers: Workers, batch: BatchRequest, exports: Exports, printer: Printer
) -> None:
    """Fit and report on many logs, in several processes, and write a table with a row per log.

    A FOLDER is searched recursively. A MANIFEST (CSV or TOML) lists logs or patterns with their robot, configuration,
    group and tags. A log that fails, hangs or ends its process does not affect the others. The same command continues
    an interrupted batch; logs that are done are skipped while input, configuration and version stay the same.

    Exit status: 3 if an acceptance limit was not met, else 1 if a log could not be used.

    \b
    Example:
      icrtool batch season/ -o results --robot husky-a200
      icrtool batch season/ -o results --robot husky-a200 --calibration last-season.json
      icrtool batch logs.csv -o results -j 4 --gate "recommended.p95@10m <= 1.5"
    """  # noqa: D301 - click reads the escape
    report_request = batch.report
    compared = options.baseline_of(batch.baseline, report_request.gates)
    options.calibrations_of(batch.calibrations, report_request)
    with remote_place.folder_on_disk(output, parts=fleet_files.FOLDERS) as folder:
        requests = batches.plan_requests(places, output, batch, folder)
        folder.mkdir(parents=True, exist_ok=True)
        view = View(len(requests), printer)
        rows = run_all(requests, workers, batch, view, folder)
    missing = compared.missing(row.log for row in rows) if compared is not None else []
    # The folder is fetched again, because an address now has the runs that the worker processes uploaded.
    with remote_place.folder_on_disk(output, parts=fleet_files.FOLDERS) as folder:
        calibrations = []
        if report_request.ladder:
            pooled = fleet_files.pooled_calibrations(rows, folder, output, allow_unusable=report_request.allow_unusable)
            calibrations = list(pooled)
        new = any((row.status, row.this_time) == ("done", "processed") for row in rows)
        plots = batch.files.plots if new or not (folder / fleet_files.PLOTS).is_dir() else ()
        document = fleet_files.write_fleet(rows, folder, calibrations, plots, page=batch.files.page)
        results = ("fleet.csv", "failures.csv", "calibrations", "plots", "report.html", "runs")
        existing = [name for name in results if (folder / name).exists()]
        written = ", ".join(f"{name}/" if (folder / name).is_dir() else name for name in existing)
    if compared is not None:
        printer.warn(map(escaped, fleet_files.changes_of(rows, missing)))
    exports.write(
        "batch",
        lambda: [acceptance.Suite(row.log, row.verdicts, row.reason if row.status == "failed" else "") for row in rows],
        lambda: text_blocks.format_markdown(fleet_files.fleet_blocks(rows, missing)),
    )
    printer.json("batch", replace(document, output=escaped(str(output))))
    printer.text(summary_of(rows, output, written))
    if calibrations:
        printer.text(f"\n{fleet_files.calibrations_text(calibrations)}".rstrip())
    options.check_compared(verdict for row in rows for verdict in row.verdicts)
    limit_not_met = any(row.gates_failed for row in rows)
    if limit_not_met or any(row.status == "failed" for row in rows):
        raise SystemExit(3 if limit_not_met else 1)


def run_all(
    requests: Sequence[LogRequest], workers: Workers, batch: BatchRequest, view: View, folder: Path
) -> list[FleetLog]:
    """Process all logs; return the row of each log, in the order of the requests.

    Parameters
    ----------
    view : shows the stages and the rows while the batch runs
    folder : folder on disk with the results, which are uploaded if the place of the results is an address
    """
    # This import is not lazy, because no module can be loaded when a signal ends the process.
    from icrtool.fleet.processes import executor_of

    rows: list[FleetLog] = []
    with (
        executor_of([one_log.path_from_bytes(request.path) for request in requests], *workers) as (executor, lost),
        view,
        closing(batches.run_batch(requests, executor, batch, view.stage, lost, folder)) as coming,
    ):
        for row in coming:
            rows.append(row)
            view.row(row)
    order = {request.known.log: number for number, request in enumerate(requests)}
    return sorted(rows, key=lambda row: order[row.log])


class View(LiveLine):
    """Output of a running batch: a line for each finished log, and on a terminal a line about the running logs."""

    def __init__(self, logs: int, printer: Printer) -> None:
        super().__init__(quiet=printer.quiet)
        self._logs = logs
        self._printer = printer
        self._begun = time.monotonic()
        self._counts: Counter[str] = Counter()
        self._processed = 0
        self._stages: dict[str, str] = {}
        # The threads of the logs report stages. No thread may write between the removal of the line and a result.
        self._lock = RLock()

    def stage(self, log: str, stage: str) -> None:
        """Show that a log has begun a stage."""
        with self._lock:
            self._stages[log] = stage
            self._show()

    def row(self, row: FleetLog) -> None:
        """Print the result of a log."""
        with self._lock:
            self._stages.pop(row.log, None)
            self._counts[row.status] += 1
            self._processed += row.this_time == "processed"
            self.rewrite("")
            if row.status != "failed":
                self._printer.text(line_of(row))
            elif not self._printer.quiet:
                print_error(f"{escaped(row.log)}: {escaped(row.reason)}")
                if row.details:
                    self._printer.detail("\n".join(map(escaped, row.details.splitlines())))
            for verdict in row.verdicts:
                if not verdict.passed:
                    click.echo(escaped(verdict.line), err=True)
                elif row.status != "failed":
                    self._printer.text(escaped(verdict.line))
            self._show()

    def _show(self) -> None:
        """Show on a terminal how many logs are done, rate and remaining time, and the stages of the running logs."""
        if not self.on_terminal:
            return
        done, worked = self._counts.total(), self._processed
        parts = [f"{done}/{self._logs} done"]
        if self._counts["failed"]:
            parts.append(f"{self._counts['failed']} failed")
        elapsed = time.monotonic() - self._begun
        if worked:
            rate = worked / elapsed
            remaining_s = (self._logs - done) / rate
            parts += [
                f"{60 * rate:.3g} logs/min",
                f"{remaining_s / 60:.0f} min left" if remaining_s > 90 else f"{remaining_s:.0f} s left",
            ]
        width = shutil.get_terminal_size().columns - 1
        stages = list(self._stages.items())
        space = (width - len("  ".join(parts))) // max(len(stages), 1) - LONGEST_STAGE
        parts += [f"{shortened(escaped(log), max(space, LEAST_NAME))}: {stage}" for log, stage in stages]
        self.rewrite("  ".join(parts)[:width])


def line_of(row: FleetLog) -> str:
    """Return the line that is printed of a log that could be used."""
    is_cut = row.usable and "log_cut_off" in row.codes
    word = "skipped" if row.this_time == "skipped" else "cut off" if is_cut else row.status
    parts = [f"{word:7}", str(LogText(row.log))]
    if row.distance_m is not None:
        parts.append(f"{row.distance_m:.0f} m")
    if not row.usable:
        # The line has the first cause without its numbers; fleet.csv has the whole text.
        cause = next((finding.finding for finding in row.notes if notes.is_grave(finding)), "")
        return "  ".join([*parts, f"do not use: {escaped(cause)}"])
    if row.multiplier is not None:
        parts.append(f"multiplier {row.multiplier:.3f} ± {row.multiplier_std or 0.0:.3f}")
    if (p95 := row.shown_error()) is not None:
        parts.append(f"95 %: {p95:.3g} m after 10 m")
    return "  ".join(parts)


def summary_of(rows: Sequence[FleetLog], output: Path, written: str) -> str:
    """Return the last line of a batch: numbers of logs that were done and failed, and the place of the tables."""
    parts = [fleet_files.counts_text(rows)]
    failed_gates = sum(row.gates_failed for row in rows)
    parts += [f"acceptance limits not met: {failed_gates}"] if failed_gates else []
    written_text = f"written to {LogText(str(output))}: {written}"
    lines = textwrap.wrap(written_text, 80, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    return "\n".join(["", f"{counted(len(rows), 'log')}: {', '.join(parts)}", *lines])
