"""One log of a batch: its run and its report, and its row in the tables."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from icrtool import __version__
from icrtool.errors import IcrToolError, LogChangedError, OutputError
from icrtool.fleet.recordings import as_text
from icrtool.logs.containers.recording_files import file_sha256, files_of_log, log_name
from icrtool.output.files.remote_place import write_below
from icrtool.pipeline import fit_into, report_into
from icrtool.records.acceptance import CHOICE_HORIZON_M
from icrtool.records.fleet_document import FleetFile, FleetLog, fleet_verdict, next_low_name
from icrtool.records.places import Below, UrlPath, place_of
from icrtool.records.plain_data import plain_value
from icrtool.records.requests import CalibrationInput, LogRequest
from icrtool.records.run import ICR_COLUMNS
from icrtool.records.samples import InputFile
from icrtool.records.stages import Watch
from icrtool.records.text import escaped

if TYPE_CHECKING:
    from icrtool.calibration.record import Calibration
    from icrtool.records.dropout_document import ModelDocument

FLEET_HORIZONS_M = (1.0, 5.0, 10.0, 20.0)
"""Distances of the errors in the tables of a batch [m]."""


def path_from_bytes(name: bytes) -> Path:
    """Return the path that a request holds as bytes."""
    return place_of(os.fsdecode(name))


def process_log(request: LogRequest, watch: Watch) -> FleetLog:
    """Fit a log, analyse the run, write both, and return its row; the row of an unusable log states the reason.

    Parameters
    ----------
    watch : called with the name of each stage
    """
    begun = time.monotonic()
    path, folder = path_from_bytes(request.path), path_from_bytes(request.folder)
    try:
        row = _results(request, watch)
    except IcrToolError as err:
        # A second attempt may find space on the disk, or a complete log. An error in the content would come again.
        reason = err.text_without(str(path), str(folder / request.known.run), log_name(path))
        row = row_of_failure(request, reason, repeatable=not isinstance(err, OutputError | LogChangedError))
    except OSError as err:
        # The log was removed during the work, or its disk fails.
        place = escaped(str(err.filename or path))
        row = row_of_failure(request, f"{place}: {err.strerror or err}", repeatable=False)
    row = replace(row, took_s=round(time.monotonic() - begun, 3), tool_version=__version__)
    try:
        write_below(folder, request.row_file, msgspec.json.encode(row))
    except OutputError as err:
        row = row_of_failure(request, str(err), repeatable=False)
    return row


def row_of_failure(request: LogRequest, reason: str, *, details: str = "", repeatable: bool) -> FleetLog:
    """Return the row of a log that could not be processed."""
    inputs: tuple[FleetFile, ...] = ()
    with suppress(OSError):  # the log was removed, or is a device
        inputs = files_of(path_from_bytes(request.path)) if repeatable else ()
    return replace(
        request.known, reason=reason, usable=False, details=details, repeatable=repeatable, inputs=inputs,
        tool_version=__version__,
    )  # fmt: skip


def files_of(path: Path, inputs: Sequence[InputFile] = ()) -> tuple[FleetFile, ...]:
    """Return the files of a log with their sha256; files in `inputs` are not read again.

    For a log at an address only the files in `inputs` are known.
    """
    if isinstance(path, UrlPath):
        return tuple(
            FleetFile(one.path, one.bytes, 0, one.sha256, one.version or one.etag or "", one.address or "")
            for one in inputs
        )
    hashes = {file.path: file.sha256 for file in inputs}
    files = []
    for file in files_of_log(path):
        digest = hashes.get(str(file))
        if digest is None:
            digest = file_sha256(file)
        status = file.stat()
        files.append(FleetFile(as_text(file), status.st_size, status.st_mtime_ns, digest))
    return tuple(files)


def _results(request: LogRequest, watch: Watch) -> FleetLog:
    """Fit and analyse a log, write run and report, and return the row of the log."""
    from icrtool.output.dropout_directory import open_baseline

    path, folder = path_from_bytes(request.path), path_from_bytes(request.folder)
    asked, files = request.report, request.files
    calibrations = [_calibration_of(one) for one in request.calibrations]
    with fit_into(Below(folder, request.known.run), path, request.config, asked.fit, files, watch) as run_and_directory:
        run, partial = run_and_directory
        baseline = None
        if request.baseline:
            row = request.known
            baseline = open_baseline(path_from_bytes(request.baseline)).find(
                row.log, run.document.content, row.robot, row.group
            )
        report = report_into(partial, run, asked, files, watch, calibrations=calibrations, baseline=baseline)
    summary = run.document
    icrs = {name: summary.icr_of_drive(name) or (None, None) for name in ICR_COLUMNS}
    controller = summary.controller
    if controller is None and report.calibration is not None:
        controller = report.calibration.controller
    document = report.document
    unusable = f"not usable: {document.unusable_because}" if not document.usable else ""
    cut = next((one.sentence for one in summary.notes if one.code == "log_cut_off"), "")
    within = [(f"{one.model}_within_{one.budget_m:g}m_m", one) for one in report.document.budgets]
    earlier = report.baseline.document.models if report.baseline is not None else ()
    return replace(
        request.known,
        status="done",
        reason="; ".join(filter(None, [unusable, f"truncated: {cut}" if cut else ""])),
        usable=document.usable,
        start_utc=datetime.fromtimestamp(int(run.table.stamp_ns[0]) // 10**9, UTC).isoformat().replace("+00:00", "Z"),
        duration_s=summary.drive.duration_s,
        distance_m=summary.drive.distance_m,
        icr={name: value for name, (value, _) in icrs.items()}
        | {f"std_{name}": std for name, (_, std) in icrs.items()},
        multiplier=None if controller is None else controller.multiplier,
        multiplier_std=None if controller is None else controller.multiplier_std,
        errors=_errors(report.document.models)
        | {name: plain_value(one.distance_m) for name, one in within}
        | {next_low_name(one.model, one.budget_m): one.to_plan_with_m for _, one in within},
        bounds=tuple(name for name, one in within if one.beyond),
        events=len(summary.events),
        outages=len(report.outages),
        warnings=len(summary.warnings),
        # The row is sent to another process as JSON, and msgspec does not encode a `LogText`.
        notes=tuple(
            replace(one, subject=str.__str__(one.subject), text=str.__str__(one.text)) for one in summary.notes
        ),
        verdicts=tuple(fleet_verdict(one, request.known.log) for one in report.document.gates),
        baseline=_errors(one for one in earlier if report.result(one.name) is not None),
        changes=report.baseline.changes(summary) if report.baseline is not None else (),
        inputs=files_of(path, summary.inputs),
    )


def _calibration_of(input_file: CalibrationInput) -> Calibration:
    """Return the calibration in a file of a batch.

    Raises
    ------
    OSError
        The file was removed.
    LogChangedError
        The file changed since the batch began; the key of the row holds the SHA-256 of the former content.
    """
    from icrtool.output.files.formats import open_calibration

    file = path_from_bytes(input_file.path)
    if file_sha256(file) != input_file.sha256:
        raise LogChangedError(file, "changed since the batch began", "run the batch again")
    return open_calibration(file)


def _errors(models: Iterable[ModelDocument]) -> dict[str, float | None]:
    """Return p95, its interval, and the expected error of each model of a report [m], by names of columns."""
    return {
        f"{one.name}_{metric}_{row.horizon_m:g}m_m": number
        for one in models
        for row in one.by_horizon
        if row.horizon_m in FLEET_HORIZONS_M
        for metric, number in (
            ("p95", row.p95_m), ("expected", row.expected_error_m),
            *((("p95_low", row.p95_low_m), ("p95_high", row.p95_high_m)) if row.horizon_m == CHOICE_HORIZON_M else ()),
        )
    }  # fmt: skip
