"""The work on one log: from its file to a run directory and a dropout report, and to its row in a batch.

`fitted` and `report_and_write` serve `fit`, `dropout-report` and `batch`; `process` is the work of a batch.
"""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from icrtool import __version__
from icrtool.calibration.record import Calibration
from icrtool.config import Config
from icrtool.errors import IcrToolError, LogChangedError, OutputError
from icrtool.fleet.recordings import as_text
from icrtool.logs.containers.container import truncation
from icrtool.logs.containers.recording_files import file_sha256, files_of_log, log_name
from icrtool.output.files.formats import open_calibration
from icrtool.output.files.remote_place import on_disk, write_below
from icrtool.output.run_directory import PAGE_FILE, check_target, new_run, open_run, replaced_log
from icrtool.records.acceptance import DEFAULT_SEED
from icrtool.records.choices import FigureSet, Reference, Starts, StatesFormat
from icrtool.records.fleet_document import ROWS, RUNS, FleetFile, FleetLog, fleet_verdict
from icrtool.records.places import UrlPath, place_of
from icrtool.records.plain_data import plain
from icrtool.records.run import ICR_COLUMNS
from icrtool.records.samples import InputFile
from icrtool.records.text import escaped

if TYPE_CHECKING:
    from icrtool.dropout_analysis.report import BaselineReport, DropoutReport
    from icrtool.dropout_analysis.trials import ErrorSink
    from icrtool.records.dropout_document import EarlierModel, ModelDocument
    from icrtool.records.run import Run, WarmStart

HORIZONS_M = (1.0, 5.0, 10.0, 20.0)
"""Distances whose errors a batch collects."""

Stage = Callable[[str], None]
"""Called with what is done next."""


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """What is asked of a dropout report.

    Attributes
    ----------
    plots : formats of the pictures
    figures : ``all``: those of the paper too
    ladder : compare all models on distance that they were not fitted to
    page : write report.html
    trials : write every single trial to trials.parquet
    """

    plots: tuple[str, ...] = ("png",)
    gates: tuple[str, ...] = ()
    budgets_m: tuple[float, ...] = (0.5,)
    ladder: bool = True
    strict: bool = False
    page: bool = True
    allow_unusable: bool = False
    figures: FigureSet = "default"
    trials: bool = False
    horizons_m: tuple[float, ...] | None = None
    outage_s: tuple[float, ...] | None = None
    outage_at_s: tuple[float, ...] = ()
    calibrations: tuple[Calibration, ...] = ()
    starts: Starts = "moving"
    reference: Reference = "filter"
    without_events: bool = False
    with_jumps: bool = False
    seed: int = DEFAULT_SEED

    def configured(self, config: Config, calibrations: Iterable[Calibration]) -> ReportOptions:
        """Return it with calibrations, and the configuration's horizons and outages if set and no others asked for."""
        dropout, given = config.dropout, config.given
        horizons_m = dropout.horizons_m if "dropout.horizons_m" in given else None
        outage_s = dropout.forced_outage_s if "dropout.forced_outage_s" in given else None
        return dataclasses.replace(
            self,
            horizons_m=self.horizons_m or horizons_m,
            outage_s=self.outage_s or outage_s,
            calibrations=tuple(calibrations),
        )


@dataclass(frozen=True, slots=True)
class FitOptions:
    """What is asked of a fit and its run directory.

    Attributes
    ----------
    overwrite : the run of another recording may be replaced
    plots, figures, states : as in `icrtool.output.run_directory.new_run`
    span : from when to when the log is read, as in `icrtool.read_log`
    warm_start : run or calibration file to start from
    changes_s, smooth : as in `icrtool.fit`
    """

    overwrite: bool = False
    plots: tuple[str, ...] = ("png",)
    figures: FigureSet = "default"
    states: StatesFormat | None = None
    span: tuple[str | None, str | None] = (None, None)
    warm_start: Path | None = None
    changes_s: tuple[float, ...] = ()
    smooth: bool = False


@contextmanager
def fitted(
    log: Path,
    directory: Path,
    config: Config,
    asked: FitOptions,
    begin: Stage,
    *,
    share: Callable[[float], None] | None = None,
    note: Callable[[str], None] | None = None,
    inside: Path | None = None,
) -> Iterator[tuple[Run, Path]]:
    """Fit a log, write its run, and give the run and its new directory, which is put in place at the end of the block.

    Parameters
    ----------
    directory : may be at an address, as `icrtool.output.files.remote_place.on_disk` takes it
    share : called with the share of the log that was read
    note, inside : as in `icrtool.output.run_directory.new_run`
    """
    start = _warm_start(asked.warm_start, config, note)
    with on_disk(directory, begin=begin) as place:
        inside = inside if place is directory else None
        check_target(place, log, overwrite=asked.overwrite, inside=inside)
        begin("reading")
        from icrtool.logs.read_log import read_log

        logs = [read_log(log, config, share, start=asked.span[0], end=asked.span[1])]
        from icrtool.calibration.run_models import fit

        # The callee alone holds the log, and frees its columns where they are needed no longer.
        run = fit(logs.pop(), config, warm_start=start, changes_s=asked.changes_s, smooth=asked.smooth, watch=begin)
        if note is not None and (before := replaced_log(place, run)) is not None:
            note(f"{directory}: replaced the run of another recording ({before})")
        begin("writing, pictures" if asked.plots else "writing")
        with new_run(
            run, place, states=asked.states, plots=asked.plots, figures=asked.figures, note=note, inside=inside
        ) as partial:
            yield run, partial


def _warm_start(source: Path | None, config: Config, note: Callable[[str], None] | None) -> WarmStart | None:
    """Return the ICRs that a run ended with, or those of a calibration file; note where its track width is another."""
    if source is None:
        return None
    start = open_calibration(source).warm_start() if source.is_file() else open_run(source).ended_with
    theirs, ours = start.track_width_m, config.robot.track_width_m
    if note is not None and theirs is not None and ours is not None and not math.isclose(theirs, ours, rel_tol=0.01):
        note(f"{source}: made with a track width of {theirs:g} m, not {ours:g} m: are its ICRs this robot's?")
    return start


def report_and_write(
    run: Run,
    directory: Path,
    options: ReportOptions,
    begin: Stage,
    *,
    baseline: BaselineReport | None,
) -> DropoutReport:
    """Analyse a run and write its dropout report, and its page, into its directory; `baseline`: of the same log."""
    from icrtool.dropout_analysis.dropout_report import dropout_report
    from icrtool.output.dropout_directory import DROPOUT_DIRECTORY, write_report

    def analysed(sink: ErrorSink | None) -> DropoutReport:
        begin("dropout analysis")
        report = dropout_report(
            run, horizons_m=options.horizons_m, budgets_m=options.budgets_m, gates=options.gates,
            outage_s=options.outage_s, outage_at_s=options.outage_at_s, starts=options.starts,
            without_events=options.without_events, with_jumps=options.with_jumps, calibrations=options.calibrations,
            comparison=options.ladder, reference=options.reference, baseline=baseline, strict=options.strict,
            allow_unusable=options.allow_unusable, seed=options.seed, sink=sink,
        )  # fmt: skip
        begin("dropout report, pictures" if options.plots else "dropout report")
        return report

    stamps = run.table.stamp_ns if options.trials else None
    report = write_report(
        analysed, directory / DROPOUT_DIRECTORY, plots=options.plots, figures=options.figures, stamp_ns=stamps,
        inside=directory,
    )  # fmt: skip
    if options.page:
        from icrtool.output.page.pages import write_page

        begin("page")
        write_page(run, report, directory / PAGE_FILE, plots=directory, inside=directory)
    return report


@dataclass(frozen=True, slots=True)
class Request:
    """All that processing a log needs; travels to the process that does it as JSON. Paths are bytes: of any name.

    Attributes
    ----------
    path : of the log
    known : its row as far as it is known before
    folder : of the batch
    baseline : place of an earlier report or batch to compare with; empty: none
    """

    path: bytes
    known: FleetLog
    folder: bytes
    config: Config
    report: ReportOptions
    overwrite: bool = False
    baseline: bytes = b""

    @property
    def row_file(self) -> str:
        """Where the row is written, below the folder, for a batch that continues this one."""
        name = self.known.run.removeprefix(f"{RUNS}/")
        return f"{ROWS}/{blake2b(os.fsencode(name), digest_size=16).hexdigest()}.json"

    def encode(self) -> bytes:
        """Return it as one line of JSON."""
        return msgspec.json.encode(self)


def path_of(name: bytes) -> Path:
    """Return a path of a request."""
    return place_of(os.fsdecode(name))


_REQUEST = msgspec.json.Decoder(Request)
"""Made at import, as in `icrtool.fleet.processes`."""


def decode_request(line: bytes) -> Request:
    """Return what `Request.encode` wrote."""
    return _REQUEST.decode(line)


def process(request: Request, stage: Stage) -> FleetLog:
    """Fit a log, analyse the run, write both, and return its row; one that cannot be used gives a row with the reason.

    Parameters
    ----------
    stage : called with what is done next
    """
    begun = time.monotonic()
    path, folder = path_of(request.path), path_of(request.folder)
    try:
        row = _results(request, stage)
    except IcrToolError as err:
        # A full disk may not be full the next time, nor a log be written to; the log's own errors come again.
        reason = err.beside(str(path), str(folder / request.known.run), log_name(path))
        row = failed(request, reason, repeatable=not isinstance(err, OutputError | LogChangedError))
    except OSError as err:
        # The log was removed meanwhile, or its disk fails.
        place = escaped(str(err.filename or path))
        row = failed(request, f"{place}: {err.strerror or err}", repeatable=False)
    row = replace(row, took_s=round(time.monotonic() - begun, 3), tool_version=__version__)
    try:
        write_below(folder, request.row_file, msgspec.json.encode(row))
    except OutputError as err:
        row = failed(request, str(err), repeatable=False)
    return row


def failed(request: Request, reason: str, *, details: str = "", repeatable: bool) -> FleetLog:
    """Return the row of a log that could not be processed."""
    inputs: tuple[FleetFile, ...] = ()
    with suppress(OSError):  # a log that was removed meanwhile, or is a device
        inputs = files_of(path_of(request.path)) if repeatable else ()
    return replace(
        request.known, reason=reason, usable=False, details=details, repeatable=repeatable, inputs=inputs,
        tool_version=__version__,
    )  # fmt: skip


def files_of(path: Path, inputs: Sequence[InputFile] = ()) -> tuple[FleetFile, ...]:
    """Return the files of a log with their sha256; those in `inputs` are not read again.

    Of an address, `inputs` is all that is known.
    """
    if isinstance(path, UrlPath):
        return tuple(FleetFile(one.path, one.bytes, 0, one.sha256, one.version or one.etag or "") for one in inputs)
    hashes = {file.path: file.sha256 for file in inputs}
    found = []
    for file in files_of_log(path):
        digest = hashes.get(str(file))
        if digest is None:
            digest = file_sha256(file)
        status = file.stat()
        found.append(FleetFile(as_text(file), status.st_size, status.st_mtime_ns, digest))
    return tuple(found)


def _results(request: Request, stage: Stage) -> FleetLog:
    """Fit and analyse a log, write run and report, and return its row."""
    from icrtool.output.dropout_directory import open_baseline

    path, folder = path_of(request.path), path_of(request.folder)
    asked = FitOptions(request.overwrite, request.report.plots, request.report.figures)
    with fitted(path, folder / request.known.run, request.config, asked, stage, inside=folder) as (run, partial):
        before = None
        if request.baseline:
            before = open_baseline(path_of(request.baseline)).find(request.known.log, run.document.content)
        report = report_and_write(run, partial, request.report, stage, baseline=before)
    summary = run.document
    icrs = {name: summary.icr_of_drive(name) or (None, None) for name in ICR_COLUMNS}
    controller = summary.controller
    if controller is None and report.calibration is not None:
        controller = report.calibration.controller
    unusable = f"not usable: {summary.unusable_because}" if not summary.usable else ""
    cut = truncation(summary.warnings)
    within = [(f"{one.model}_within_{one.budget_m:g}m_m", one) for one in report.document.budgets]
    earlier = report.baseline.document.models if report.baseline is not None else ()
    return replace(
        request.known,
        status="done",
        reason="; ".join(filter(None, [unusable, f"truncated: {cut}" if cut else ""])),
        usable=summary.usable,
        start_utc=datetime.fromtimestamp(int(run.table.stamp_ns[0]) // 10**9, UTC).isoformat().replace("+00:00", "Z"),
        duration_s=summary.drive.duration_s,
        distance_m=summary.drive.distance_m,
        icr={name: value for name, (value, _) in icrs.items()}
        | {f"std_{name}": std for name, (_, std) in icrs.items()},
        multiplier=None if controller is None else controller.multiplier,
        multiplier_std=None if controller is None else controller.multiplier_std,
        errors=_errors(report.document.models) | {name: plain(one.distance_m) for name, one in within},
        bounds=tuple(name for name, one in within if one.beyond),
        events=len(summary.events),
        outages=len(report.outages),
        warnings=len(summary.warnings),
        verdicts=tuple(fleet_verdict(one, request.known.log) for one in report.document.gates),
        baseline=_errors(one for one in earlier if report.result(one.name) is not None),
        changes=report.baseline.changes(summary) if report.baseline is not None else (),
        inputs=files_of(path, summary.inputs),
    )


def _errors(models: Iterable[ModelDocument | EarlierModel]) -> dict[str, float | None]:
    """Return p95 and expected errors of the models of a report, by the names of columns."""
    return {
        f"{one.name}_{metric}_{row.horizon_m:g}m_m": number
        for one in models
        for row in one.by_horizon
        if row.horizon_m in HORIZONS_M
        for metric, number in (("p95", row.p95_m), ("expected", row.expected_error_m))
    }
