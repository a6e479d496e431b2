"""The run directory: what `icrtool fit` leaves behind. `icrtool.output.stored_run` reads it back."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec

from icrtool.errors import OutputError
from icrtool.logs.containers.split_files import file_sha256, files_of_log
from icrtool.output.files.atomic import atomic_directory
from icrtool.output.files.formats import (
    PLOT_FORMATS,
    csv_bytes,
    file_b2sum,
    json_bytes,
    read_document,
    schema_of,
    write_sums,
)
from icrtool.output.files.measurements_file import MEASUREMENTS_FILE, write_measurements
from icrtool.output.files.own_files import check_directory, own_files
from icrtool.output.files.remote_place import lies_there
from icrtool.output.files.states_file import StatesFormat, write_states
from icrtool.records.plain_data import Record
from icrtool.records.run import FigureSet, Run
from icrtool.records.run_document import EVENT_COLUMNS, EventDocument
from icrtool.records.samples import InputFile
from icrtool.records.urls import UrlPath

RUN_FILE = "run.json"
EVENTS_FILE = "events.csv"
PAGE_FILE = "report.html"

STATES_FILES: dict[str, StatesFormat] = {"states.csv": "csv", "states.parquet": "parquet"}

SMOOTHED_FILES: dict[str, StatesFormat] = {"smoothed.csv": "csv", "smoothed.parquet": "parquet"}

MOST_CSV_STATES = 1_000_000
"""With more states, states.csv would have over 300 MB, and take longer to read than the log."""

SCHEMA_FAMILY = "icrtool/run/"


def check_target(
    directory: Path, log: Path | None = None, *, overwrite: bool = False, inside: Path | None = None
) -> None:  # fmt: skip
    """Refuse a place where a run directory cannot be put, before any work is done for it.

    Parameters
    ----------
    log : the run will be made from it; a run of another recording is refused
    overwrite : a run of another recording may be replaced
    inside : as in `check_directory`

    Raises
    ------
    OutputError
        A file, a directory that is not a run of ours, or the run of another recording is there; or `log` is a run.
    """
    if log is not None and is_run_directory(log):
        path = next((one.path for one in _inputs_of(log)), "data frames")
        raise OutputError(log, "is a run, not a log", f"name its log ({path}), or: icrtool dropout-report {log}")
    check_directory(directory, is_run_directory, kind="run directory", inside=inside)
    if log is not None and not overwrite and is_run_directory(directory) and not _is_made_from(directory, log):
        other = next((one.path for one in _inputs_of(directory)), "data frames")
        advice = "name another place, or replace it with --overwrite"
        raise OutputError(directory, f"holds the run of another recording ({other})", advice)


def _is_made_from(directory: Path, log: Path) -> bool:
    """Return whether a run was made from a log: from a file in the same place, or from files of the same content."""
    files = [file for file in files_of_log(log) if file.is_file()]
    inputs, sources = _inputs_of(directory), own_files(directory).made_from
    if any(os.path.realpath(file) in sources for file in files):
        return True
    if isinstance(log, UrlPath):
        return [one.path for one in inputs] == [str(log)]
    return bool(inputs) and all(
        any(file.stat().st_size == one.bytes and file_sha256(file) == one.sha256 for file in files) for one in inputs
    )


def write_run(
    run: Run,
    directory: Path,
    *,
    states: StatesFormat | None = None,
    plots: tuple[str, ...] = ("png",),
    figures: FigureSet = "default",
    note: Callable[[str], None] | None = None,
    inside: Path | None = None,
    then: Callable[[Path], None] | None = None,
) -> None:
    """Write a run directory, whole or not at all.

    Parameters
    ----------
    run : its smoothed states, where it has them, are written as ``smoothed`` in the same format
    directory : where it shall appear; an old run there is replaced, with all that was made from it
    states : format of the states; default: ``csv``, of more than `MOST_CSV_STATES` ``parquet``
    plots : formats of the figures, of ``png``, ``svg`` and ``pdf``; none: no figures
    figures : ``all``: those of the paper too
    note : called with one line where an old run was replaced and files of it were removed or, not icrtool's, kept
    inside : as in `check_directory`
    then : called with the new directory before it is put in place: what it writes there belongs to the run, and where
        it fails the old run stays

    Raises
    ------
    OutputError
        A file or a foreign directory is there, or the disk does not take it.
    """
    if unknown := set(plots) - set(PLOT_FORMATS):
        raise ValueError(f"plots: {unknown} are not among {PLOT_FORMATS}")
    if states is None:
        states = "csv" if len(run.table) <= MOST_CSV_STATES else "parquet"
        if states != "csv" and note is not None:
            note(f"{directory}: {len(run.table):,} states: written as states.parquet, not states.csv (--states csv)")
    sources = [os.path.realpath(file.path) for file in run.document.inputs]
    with (
        atomic_directory(
            directory,
            is_run_directory,
            kind="run directory",
            inside=inside,
            names=(PAGE_FILE,),
            made_from=sources,
            note=note,
        ) as partial,
        ThreadPoolExecutor(1) as pool,
    ):
        states_name = f"states.{states}"
        states_sum = pool.submit(write_states, run.table, partial / states_name, states)
        if plots:
            from icrtool.output.figure_catalogue import draw_figures

            draw_figures("run", run, partial / "plots", plots, figures)
        sums: dict[str, str] = {}
        if run.smoothed is not None:
            sums[f"smoothed.{states}"] = write_states(run.smoothed, partial / f"smoothed.{states}", states)
        write_measurements(run, partial / MEASUREMENTS_FILE)
        (partial / RUN_FILE).write_bytes(json_bytes(run.document))
        (partial / EVENTS_FILE).write_bytes(events_csv(run.document.events))
        pictures = [f"plots/{file.name}" for file in sorted((partial / "plots").glob("*"))]
        sums |= {name: file_b2sum(partial / name) for name in (MEASUREMENTS_FILE, RUN_FILE, EVENTS_FILE, *pictures)}
        sums[states_name] = states_sum.result()
        write_sums(partial, sums)
        if then is not None:
            then(partial)


def replaced_log(directory: Path, run: Run) -> str | None:
    """Return the path of the log whose run a new run replaces; None where it has the same content, or none is there."""
    before, now = _inputs_of(directory), run.document.inputs
    same = [one.sha256 or one.path for one in before] == [one.sha256 or one.path for one in now]
    return str(before[0].path) if before and not same else None


class _Inputs(Record, frozen=True):
    inputs: tuple[InputFile, ...]


def _inputs_of(directory: Path) -> tuple[InputFile, ...]:
    """Return the inputs in a run.json that nobody checked yet."""
    try:
        return read_document(directory / RUN_FILE, _Inputs, directory, escape=False).inputs
    except (OSError, ValueError, RecursionError):
        return ()


def is_run_directory(directory: Path) -> bool:
    """Return whether a directory, or an address, is a run of ours, of whatever version."""
    if isinstance(directory, UrlPath):
        return lies_there(directory, RUN_FILE)
    return schema_of(directory / RUN_FILE, directory).startswith(SCHEMA_FAMILY)


def events_csv(events: Sequence[EventDocument]) -> bytes:
    """Return events.csv: a row an event."""
    return csv_bytes(EVENT_COLUMNS, map(msgspec.structs.astuple, events))
