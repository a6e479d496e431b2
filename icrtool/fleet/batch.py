"""Running of a batch: finished logs are skipped, the others processed by an executor, and failed processes repeated."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ThreadPoolExecutor, wait
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from icrtool import __version__
from icrtool.config import builtin_robots
from icrtool.dropout_analysis.report import parse_gate
from icrtool.errors import ConfigError, LogError, OutputError
from icrtool.fleet.fleet_files import check_tables
from icrtool.fleet.one_log import hashed_files, path_from_bytes, row_of_failure
from icrtool.fleet.processes import LossReason, close_all, process_apart
from icrtool.fleet.recordings import (
    FoundRecording,
    ManifestEntry,
    about_recording,
    as_text,
    find_recordings,
    is_manifest,
    logs_among,
    read_manifest,
)
from icrtool.logs.containers.recording_files import file_sha256, files_of_log
from icrtool.logs.containers.source import RemoteFile
from icrtool.output.files.formats import CHECKSUM_FILE
from icrtool.output.run_directory import PAGE_FILE, RUN_FILE
from icrtool.records.fleet_document import RUNS, FleetFile, FleetLog
from icrtool.records.places import Below, UrlPath, read_regular
from icrtool.records.requests import BatchRequest, CalibrationInput, LogRequest

if TYPE_CHECKING:
    from icrtool.output.dropout_directory import Baseline

POLL_S = 1.0
"""Time between two checks of a cluster [s]."""

WatchLog = Callable[[str, str], None]
"""Function that is called with the name of a log and its stage."""


def plan_requests(
    places: Sequence[Path], output: Path, batch: BatchRequest, folder: Path | None = None
) -> list[LogRequest]:
    """Return a request for each recording among logs, folders and manifests.

    Parameters
    ----------
    places : logs, folders with logs, and manifests
    output : folder or address of the results
    batch : request for all logs
    folder : folder of the results on disk if `output` is an address

    Raises
    ------
    LogError
        A place does not exist, or no recording is found.
    ConfigError
        A manifest or a configuration cannot be used, or a gate cannot be read.
    OutputError
        `output` is a run, is not a directory, or holds a file of the user with the name of a result.
    """
    gates = [parse_gate(gate) for gate in batch.report.gates]
    _check_output(output, folder or output, batch)
    # A pattern of the shell may also match tables of simulated truth next to their logs, which are no manifests.
    other_files = logs_among([place for place in places if place.is_file()])[1]
    places = [place for place in places if place not in other_files]
    entries = [entry for place in places if is_manifest(place) for entry in read_manifest(place)]
    searched = [place for place in places if not is_manifest(place)]
    searched += [place for entry in entries for place in entry.places]
    baseline = _open_baseline(batch, output)
    calibrations = tuple(
        CalibrationInput(os.fsencode(file.absolute()), file_sha256(file)) for file in batch.calibrations
    )
    requests = [
        _request_for(recording, entries, output, batch, calibrations, "" if baseline is None else baseline.digest)
        for recording in find_recordings(searched)
    ]
    if baseline is not None and any(gate.relative for gate in gates):
        baseline.check_compares(
            (
                request.known.log,
                _content_of(path_from_bytes(request.path), baseline),
                request.known.robot,
                request.known.group,
            )
            for request in requests
        )
    return requests


def _check_output(output: Path, folder: Path, batch: BatchRequest) -> None:
    """Refuse a folder of results in which a batch would replace other files; raise `OutputError`."""
    if (folder / RUN_FILE).is_file():
        raise OutputError(output, "is the directory of a run", "name another folder for the batch")
    if folder.exists() and not folder.is_dir():
        raise OutputError(output, "is a file", "name another folder for the batch")
    check_tables(folder, page=batch.files.page)


def _open_baseline(batch: BatchRequest, output: Path) -> Baseline | None:
    """Return the reports of the baseline of a batch; None for a batch without a baseline."""
    if batch.baseline is None:
        return None
    from icrtool.output.dropout_directory import open_baseline

    if batch.baseline.resolve() == output.resolve():
        why = "is the folder to which the batch writes"
        raise ConfigError(f"--baseline {output}", why, "copy the baseline, or name another folder with -o")
    return open_baseline(batch.baseline)


def _request_for(
    recording: FoundRecording, entries: Sequence[ManifestEntry], output: Path, batch: BatchRequest,
    calibrations: tuple[CalibrationInput, ...], baseline: str,
) -> LogRequest:  # fmt: skip
    """Return the request for one recording.

    Parameters
    ----------
    entries : lines of the manifests
    output : folder of the results
    baseline : digest of the baseline; empty without a baseline
    """
    about, settings = about_recording(recording.path, entries), batch.settings
    builtin = about.robot in builtin_robots()
    # A robot that is not built in needs a configuration file.
    if about.robot and not builtin and about.config is None and settings.file is None:
        advice = f"one of {', '.join(builtin_robots())}, or give its configuration in the column config"
        raise ConfigError(f"{recording.log}: robot {about.robot!r}", "not a built-in robot", advice)
    robot = about.robot if builtin else settings.robot if not about.robot else None
    config = settings._replace(file=about.config or settings.file, robot=robot).load()
    # The key does not depend on the page, because `find_finished_row` checks whether the file report.html exists.
    files = replace(batch.files, page=True, overwrite=False)
    # The name of the row in the report contains the stem of the file.
    named_calibrations = [
        (as_text(file.stem), calibration.sha256)
        for file, calibration in zip(batch.calibrations, calibrations, strict=True)
    ]
    keyed = [config.effective(), __version__, batch.report, files, about.robot, baseline, *named_calibrations]
    row = FleetLog(
        recording.log, f"{RUNS}/{recording.name}", "failed", robot=about.robot or config.robot.name or "",
        group=about.group, tags=about.tags, key=sha256(msgspec.json.encode(keyed, order="sorted")).hexdigest(),
    )  # fmt: skip
    # Paths are absolute, because workers of a cluster may have another working directory.
    return LogRequest(
        path=os.fsencode(recording.path.absolute()), known=row, folder=os.fsencode(output.absolute()),
        config=config, report=batch.report, files=batch.files, calibrations=calibrations,
        baseline=os.fsencode(batch.baseline.absolute()) if batch.baseline is not None else b"",
    )  # fmt: skip


def _content_of(path: Path, baseline: Baseline) -> tuple[str, ...]:
    """Return the SHA-256 of each file of a log; empty if no log of the baseline can have the same content."""
    if isinstance(path, UrlPath) or not any(baseline.sha256.values()):
        return ()
    return tuple(file_sha256(file) for file in files_of_log(path))


def find_finished_row(request: LogRequest, folder: Path) -> FleetLog | None:
    """Return the row of a log that an earlier batch processed with the same input, configuration and version.

    None is returned for any other log. A log that failed because of its content counts as processed, because it would
    fail again.

    Parameters
    ----------
    request : the log and its settings
    folder : folder of the results, on disk
    """
    try:
        row = msgspec.json.decode(read_regular(Below(folder, request.row_file)), type=FleetLog)
    except (OSError, ValueError):
        return None
    if row.key != request.known.key or not row.repeatable or not _same_files(row.inputs, path_from_bytes(request.path)):
        return None
    if row.status != "failed":
        needed = ["run.json", "dropout", CHECKSUM_FILE, *([PAGE_FILE] if request.files.page else [])]
        if not all((folder / request.known.run / name).exists() for name in needed):
            return None
    return replace(row, this_time="skipped", log=request.known.log, group=request.known.group, tags=request.known.tags)


def run_batch(
    requests: Sequence[LogRequest], executor: Executor, batch: BatchRequest, watch: WatchLog | None = None,
    lost: LossReason = str, folder: Path | None = None,
) -> Generator[FleetLog, None, None]:  # fmt: skip
    """Yield the row of each log when it is done; logs whose process died or hung are tried once more at the end.

    Parameters
    ----------
    requests : results of `plan_requests`
    executor : executor that calls `process_apart`, in threads on this machine or in workers of a cluster
    batch : request of the whole batch
    watch : called with log and stage when a stage begins, if the executor is on this machine
    lost : returns the reason why the executor can process no more logs; empty while it can
    folder : folder of the results on disk if they go to an address
    """
    todo: list[LogRequest] = []
    for request in requests:
        done = find_finished_row(request, folder or path_from_bytes(request.folder)) if not batch.redo else None
        if done is not None:
            yield done
        else:
            todo.append(request)
    again: list[LogRequest] = []
    for request, row in _process_requests(todo, executor, batch, watch, lost):
        if row.status == "failed" and not row.repeatable:
            again.append(request)
            if watch is not None:
                watch(row.log, "waits for a second attempt")
        else:
            yield row
    for request in again:
        # The logs are processed one at a time. A log that lacked memory beside other logs may have enough alone.
        for _, row in _process_requests([request], executor, batch, watch, lost):
            yield replace(row, reason=f"{row.reason} (tried twice)") if row.status == "failed" else row


def _process_requests(
    requests: Sequence[LogRequest], executor: Executor, batch: BatchRequest, watch: WatchLog | None, lost: LossReason
) -> Generator[tuple[LogRequest, FleetLog], None, None]:
    """Yield each request with the row of its log when it is done; arguments as `run_batch`."""
    pending: dict[Future[FleetLog], LogRequest] = {}
    try:
        for request in requests:
            if why := lost():
                yield request, row_of_failure(request, why, repeatable=False)
                continue
            extra = (partial(watch, request.known.log),) if watch and isinstance(executor, ThreadPoolExecutor) else ()
            pending[executor.submit(process_apart, request.encode(), batch.timeout_s, *extra)] = request
        waiting = set(pending)
        while waiting:
            done, waiting = wait(waiting, POLL_S, FIRST_COMPLETED)
            for future in done:
                try:
                    row = future.result()
                except (CancelledError, OSError) as err:
                    reason = f"lost by the cluster ({str(err) or type(err).__name__})"
                    row = row_of_failure(pending[future], reason, repeatable=False)
                yield pending[future], row
            if waiting and (why := lost()):
                for future in waiting:
                    future.cancel()
                    yield pending[future], row_of_failure(pending[future], why, repeatable=False)
                return
    except BaseException:
        for future in pending:
            future.cancel()
        close_all()
        raise


def _same_files(stored: Sequence[FleetFile], path: Path) -> bool:
    """Return whether the files of a log are unchanged since an earlier batch; content decides if their times differ."""
    if isinstance(path, UrlPath):
        return bool(stored) and _is_unchanged(stored[0], path)
    try:
        files = files_of_log(path)
        if [as_text(file.name) for file in files] != [Path(file.path).name for file in stored]:
            return False
        for file, before in zip(files, stored, strict=True):
            status = file.stat()
            same_time = status.st_mtime_ns == before.mtime_ns
            if status.st_size != before.bytes or not (same_time or hashed_files(file)[0].sha256 == before.sha256):
                return False
    except OSError:
        return False
    return True


def _is_unchanged(stored: FleetFile, path: UrlPath) -> bool:
    """Return whether the file at an address still has the size and version of the earlier batch."""
    try:
        now = RemoteFile(path)
    except LogError:
        return False
    version = next(iter(now.version.values()), "")
    state = now.size, version, stored.address and path.digest
    return bool(version) and state == (stored.bytes, stored.version, stored.address)
