"""Processing of one log of a batch: its run, its report, and its row in the tables."""

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
    """Fit a log, analyse the run, write both, and return the row of the log.

    No error about the log is raised: the row of a failed log states the reason.

    Parameters
    ----------
    request : the log and its settings
    watch : called with the name of each stage when it begins
    """
    begun = time.monotonic()
    path, folder = path_from_bytes(request.path), path_from_bytes(request.folder)
    try:
        row = _fit_and_report(request, watch)
    except IcrToolError as err:
        # A second attempt may find free space or a complete log. An error in the content would occur again.
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
    """Return the row of a log that could not be processed.

    Parameters
    ----------
    request : the log and its settings
    reason : reason of the failure
    details : last lines of the output of its process
    repeatable : whether the same input would fail again
    """
    inputs: tuple[FleetFile, ...] = ()
    # The log may have been removed, or be a device.
    with suppress(OSError):
        inputs = hashed_files(path_from_bytes(request.path)) if repeatable else ()
    return replace(
        request.known, reason=reason, usable=False, details=details, repeatable=repeatable, inputs=inputs,
        tool_version=__version__,
    )  # fmt: skip


def hashed_files(path: Path, inputs: Sequence[InputFile] = ()) -> tuple[FleetFile, ...]:
    """Return the files of a log with their SHA-256; files in `inputs` are not hashed again.

    For a log at an address, the files in `inputs` are returned.
    """
    if isinstance(path, UrlPath):
        return tuple(
            FleetFile(file.path, file.bytes, 0, file.sha256, file.version or file.etag or "", file.address or "")
            for file in inputs
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


def _fit_and_report(request: LogRequest, watch: Watch) -> FleetLog:
    """Fit and analyse a log, write run and report, and return the row of the log; raise errors about the log."""
    from icrtool.output.dropout_directory import open_baseline

    path, folder = path_from_bytes(request.path), path_from_bytes(request.folder)
    options, files = request.report, request.files
    calibrations = [_calibration_of(file) for file in request.calibrations]
    with fit_into(
        Below(folder, request.known.run), path, request.config, options.fit, files, watch
    ) as run_and_directory:
        run, partial = run_and_directory
        baseline = None
        if request.baseline:
            row = request.known
            baseline = open_baseline(path_from_bytes(request.baseline)).find(
                row.log, run.document.content, row.robot, row.group
            )
        report = report_into(partial, run, options, files, watch, calibrations=calibrations, baseline=baseline)
    summary = run.document
    icrs = {name: summary.icr_of_drive(name) or (None, None) for name in ICR_COLUMNS}
    controller = summary.controller
    if controller is None and report.calibration is not None:
        controller = report.calibration.controller
    document = report.document
    unusable = f"not usable: {document.unusable_because}" if not document.usable else ""
    cut = next((finding.sentence for finding in summary.notes if finding.code == "log_cut_off"), "")
    within = [(f"{budget.model}_within_{budget.budget_m:g}m_m", budget) for budget in report.document.budgets]
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
        errors=_error_columns(report.document.models)
        | {name: plain_value(budget.distance_m) for name, budget in within}
        | {next_low_name(budget.model, budget.budget_m): budget.to_plan_with_m for _, budget in within},
        bounds=tuple(name for name, budget in within if budget.beyond),
        events=len(summary.events),
        outages=len(report.outages),
        warnings=len(summary.warnings),
        # The row is sent to another process as JSON, and msgspec does not encode a `LogText`.
        notes=tuple(
            replace(finding, subject=str.__str__(finding.subject), text=str.__str__(finding.text))
            for finding in summary.notes
        ),
        verdicts=tuple(fleet_verdict(verdict, request.known.log) for verdict in report.document.gates),
        baseline=_error_columns(model for model in earlier if report.result(model.name) is not None),
        changes=report.baseline.changes(summary) if report.baseline is not None else (),
        inputs=hashed_files(path, summary.inputs),
    )


def _calibration_of(input_file: CalibrationInput) -> Calibration:
    """Return the calibration in a file that the batch was started with.

    Raises
    ------
    OSError
        The file was removed.
    LogChangedError
        The file changed after the batch began; the key of the row holds the SHA-256 of the former content.
    """
    from icrtool.output.files.formats import open_calibration

    file = path_from_bytes(input_file.path)
    if file_sha256(file) != input_file.sha256:
        raise LogChangedError(file, "changed since the batch began", "run the batch again")
    return open_calibration(file)


def _error_columns(models: Iterable[ModelDocument]) -> dict[str, float | None]:
    """Return p95, its interval and the expected error of each model of a report [m], by the names of columns."""
    return {
        f"{model.name}_{metric}_{row.horizon_m:g}m_m": number
        for model in models
        for row in model.by_horizon
        if row.horizon_m in FLEET_HORIZONS_M
        for metric, number in (
            ("p95", row.p95_m), ("expected", row.expected_error_m),
            *((("p95_low", row.p95_low_m), ("p95_high", row.p95_high_m)) if row.horizon_m == CHOICE_HORIZON_M else ()),
        )
    }  # fmt: skip
