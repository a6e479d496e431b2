"""The run directory: write and read the files of `icrtool fit`; find the newest run, and the log of a run."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, get_args

import msgspec
import numpy as np

from icrtool import __version__
from icrtool.config import Config, parse_config
from icrtool.errors import ConfigError, OutputError, RunError
from icrtool.logs.containers.recording_files import file_sha256, files_of_log, numbered_file, split_path
from icrtool.output import figure_catalogue
from icrtool.output.figure_catalogue import FIGURES
from icrtool.output.files import formats, run_columns
from icrtool.output.files.atomic import DirectoryKind, atomic_directory, check_directory, names_in
from icrtool.output.files.remote_place import folder_on_disk, has_file
from icrtool.output.files.run_columns import MEASUREMENTS_FILE
from icrtool.records.choices import FigureSet, StatesFormat
from icrtool.records.places import (
    NOT_REGULAR,
    SAVE_IT,
    Below,
    Place,
    UrlPath,
    is_regular,
    is_special,
    path_of,
    place_of,
    read_regular,
)
from icrtool.records.plain_data import Record, plain_value
from icrtool.records.requests import FitRequest
from icrtool.records.run import Run
from icrtool.records.run_document import EVENT_COLUMNS, RUN_SCHEMA, EventDocument, RunDocument
from icrtool.records.samples import InputFile
from icrtool.records.stages import Watch, unwatched
from icrtool.records.tables import States
from icrtool.records.text import LONGEST_NAME, escaped, escaped_texts, listed, shortened

RUN_FILE = "run.json"
EVENTS_FILE = "events.csv"
PAGE_FILE = "report.html"
"""Names of the files of a run with its summary, its slip events, and its page."""

STATES_FORMATS: tuple[StatesFormat, ...] = get_args(StatesFormat)
"""Formats of states; the first that is found is read."""

MOST_CSV_STATES = 1_000_000
"""Largest number of states that are written as CSV by default. With more states, states.csv is larger than 300 MB and
takes longer to read than the log."""

RUN_FAMILY = "icrtool/run/"
"""First part of the schema of a run, without its version."""

_FIGURES = "|".join(f"{name}[0-9]+m" if name.endswith("_") else name for name in FIGURES)
PICTURE_FILES = rf"plots/(({_FIGURES})\.(png|svg|pdf))?"
"""Pattern of the names of pictures."""

REPORT_FILES = rf"report\.json|(summary|histogram|worst|ladder)\.csv|trials\.parquet|{PICTURE_FILES}"
"""Pattern of the names of files in a dropout report."""

RUN_FILES = (
    r"run\.json|events\.csv|measurements\.npz|(states|smoothed)\.(csv|parquet)|B2SUMS"
    rf"|report\.html|{PICTURE_FILES}|dropout/({REPORT_FILES})?"
)
"""Pattern of the names of files in a run directory. A directory with a file of another name is not replaced."""


def check_target(place: Place, log: Path | None = None, *, overwrite: bool = False) -> None:
    """Refuse a place where a run directory cannot be put, before any work is done for it.

    Parameters
    ----------
    log : log that the run will be made from; a run of another recording is refused
    overwrite : a run of another recording may be replaced

    Raises
    ------
    OutputError
        The place has a file, a directory that is not a run, or the run of another recording; or `log` is a run.
    """
    if log is not None and is_run_directory(log):
        path = next((file.path for file in _inputs_of(log)), "data frames")
        raise OutputError(log, "is a run, not a log", f"name its log ({path}), or: icrtool dropout-report {log}")
    check_directory(place, RUN)
    directory = path_of(place)
    if log is not None and not overwrite and RUN.recognises(directory) and not _is_made_from(directory, log):
        unknown = "data frames" if is_run_directory(directory) else "its run.json is damaged"
        other = next((file.path for file in _inputs_of(directory)), unknown)
        advice = "name another place, or replace it with --overwrite"
        raise OutputError(directory, f"holds the run of another recording ({other})", advice)


def _is_made_from(directory: Path, log: Path) -> bool:
    """Return whether a run was made from a log: from files at the same path, or with the same content."""
    files = [file for file in files_of_log(log) if file.is_file()]
    inputs = _inputs_of(directory)
    try:
        sources = formats.read_document(Below(directory, formats.SOURCES_FILE), _Sources, escape=False).made_from
    except (OSError, ValueError, RecursionError):
        sources = ()
    if any(os.path.realpath(file) in sources for file in files):
        return True
    if isinstance(log, UrlPath):
        return [file.path for file in inputs] == [str(log)]
    return bool(inputs) and all(
        any(file.stat().st_size == stored.bytes and file_sha256(file) == stored.sha256 for file in files)
        for stored in inputs
    )


def check_settings(directory: Path, config: Config, request: FitRequest) -> None:
    """Refuse to replace a run that was made with other settings, before any work is done.

    Raises
    ------
    OutputError
        The run in the directory was made with another configuration or of another part of the log.
    """
    if changed := changed_settings(directory, config, request):
        advice = "give them again, name another place (-o, --into), or replace it with --overwrite"
        why = f"holds a run of this recording with other settings ({listed(changed, 3)})"
        raise OutputError(directory, why, advice)


def holds_run_of(directory: Path, log: Path, config: Config, request: FitRequest) -> bool:
    """Return whether the run in a directory was made from a log with the same settings by this version."""
    if isinstance(directory, UrlPath) or not is_run_directory(directory) or not _is_made_from(directory, log):
        return False
    settings = _stored_settings(directory)
    return (
        settings is not None
        and settings.tool_version == __version__
        and not changed_settings(directory, config, request)
    )


def changed_settings(directory: Path, config: Config, request: FitRequest) -> list[str]:
    """Return the settings in which a fit differs from the run in a directory, as ``robot.name was 'a', now 'b'``.

    Section ``dropout`` does not change a fit, so it is not compared. A run that cannot be read has no settings.
    """
    settings = _stored_settings(directory)
    if settings is None:
        return []
    now: dict[str, Any] = config.effective() | {"request": msgspec.to_builtins(request)}
    before: dict[str, Any] = {**settings.config, "request": settings.request}
    options = {"request.start": "--from", "request.end": "--to", "request.changes_s": "--terrain-change"}
    left_out = {"request.smooth"}
    changes = []
    for section, values in now.items():
        stored = before.get(section)
        if section == "dropout" or not isinstance(stored, dict):
            continue
        for key, value in values.items():
            name = f"{section}.{key}"
            if name not in left_out and key in stored and not _is_same(stored[key], value):
                changes.append(
                    f"{options.get(name, name)} was {_setting_text(stored[key])}, now {_setting_text(value)}"
                )
    return changes


def _is_same(stored: object, requested: object) -> bool:
    """Return whether two settings are equal as plain data, in any order of their keys."""
    return json.dumps(plain_value(stored), sort_keys=True) == json.dumps(plain_value(requested), sort_keys=True)


def _setting_text(value: object) -> str:
    """Return a setting as a short text, ``not given`` for a setting without a value."""
    return "not given" if value is None or value == [] else shortened(escaped(str(value)), LONGEST_NAME)


class _StoredSettings(Record, frozen=True):
    """The settings in a run.json."""

    config: dict[str, Any]
    request: dict[str, Any] = msgspec.field(default_factory=dict)
    tool_version: str = ""


def _stored_settings(directory: Path) -> _StoredSettings | None:
    """Return the settings of a run without a check of its checksums; None if the run cannot be read."""
    if isinstance(directory, UrlPath) or not is_run_directory(directory):
        return None
    try:
        return formats.read_document(Below(directory, RUN_FILE), _StoredSettings, escape=False)
    except (OSError, ValueError, RecursionError):
        return None


def write_run(run: Run, directory: Path, **options: Any) -> None:
    """Write a run directory, whole or not at all; parameters and errors as in `new_run`."""
    with new_run(run, directory, **options):
        pass


@contextmanager
def new_run(
    run: Run,
    directory: Place,
    *,
    states: StatesFormat | None = None,
    plots: tuple[str, ...] = ("png",),
    figures: FigureSet = "default",
    note: Callable[[str], None] | None = None,
    watch: Watch = unwatched,
) -> Iterator[Path]:
    """Write a run to a hidden directory and yield this directory; it is renamed to `directory` at the end of the block.

    Files that the block writes into the yielded directory belong to the run. If the block fails, the old run stays.

    Parameters
    ----------
    run : the run. Smoothed states are written as ``smoothed`` in the same format
    directory : place of the run; an old run there is replaced, with all files that were made from it
    states : format of the states; default: ``csv``, for more than `MOST_CSV_STATES` states ``parquet``
    plots : formats of the figures, of ``png``, ``svg`` and ``pdf``; none: no figures
    figures : ``all``: the paper's figures too
    note : called with one line if an old run was replaced and files that the new run does not have were removed
    watch : called with the name of each picture before it is drawn

    Raises
    ------
    OutputError
        The place has a file, another directory, or a run with files that icrtool did not write; or writing fails.
    """
    if unknown := set(plots) - set(formats.PLOT_FORMATS):
        raise ValueError(f"plots: {unknown} are not among {formats.PLOT_FORMATS}")
    if states is None:
        states = "csv" if len(run.table) <= MOST_CSV_STATES else "parquet"
        if states != "csv" and note is not None:
            written = f"{len(run.table):,} states: written as states.parquet, not states.csv (--states csv)"
            note(f"{path_of(directory)}: {written}")
    with atomic_directory(directory, RUN) as partial, ThreadPoolExecutor(1) as pool:
        # The real path is needed, because "." would still name the old run after its rename.
        place = Path(os.path.realpath(path_of(directory)))
        before = set(names_in(place))
        states_written = pool.submit(run_columns.write_states, run.table, partial / f"states.{states}", states)
        if plots:
            figure_catalogue.draw_figures("run", run, partial / "plots", plots, figures, watch)
        if run.smoothed is not None:
            run_columns.write_states(run.smoothed, partial / f"smoothed.{states}", states)
        run_columns.write_measurements(run, partial / MEASUREMENTS_FILE)
        (partial / RUN_FILE).write_bytes(formats.json_bytes(run.document))
        sources = _Sources(tuple(os.path.realpath(file.path) for file in run.document.inputs))
        (partial / formats.SOURCES_FILE).write_bytes(formats.json_bytes(sources))
        (partial / EVENTS_FILE).write_bytes(events_csv(run.document.events))
        states_written.result()
        files = sorted(name for name in names_in(partial) if not name.endswith("/"))
        formats.write_sums(partial, {name: formats.file_b2sum(partial / name) for name in files})
        yield partial
    if note is not None and (gone := before.difference(names_in(place))):
        # The list has the name of a folder in place of the names of its files.
        tops = [
            name for name in sorted(gone) if gone.isdisjoint(f"{parent}/" for parent in PurePosixPath(name).parents)
        ]
        note(f"{path_of(directory)}: replaced: removed {listed(tops, 5)}")


def replaced_log(directory: Path, run: Run) -> str | None:
    """Return the path of the log whose run a new run replaces; None without a run, or for a log of equal content."""
    before, now = _inputs_of(directory), run.document.inputs
    same = [file.identity for file in before] == [file.identity for file in now]
    return str(before[0].path) if before and not same else None


class _Inputs(Record, frozen=True):
    """The inputs in a run.json."""

    inputs: tuple[InputFile, ...]


class _Sources(Record, frozen=True):
    """The paths from which the run was made, in the file of its sources."""

    made_from: tuple[str, ...] = ()


def _inputs_of(directory: Path) -> tuple[InputFile, ...]:
    """Return the inputs in a run.json without a check of its checksum."""
    try:
        return formats.read_document(Below(directory, RUN_FILE), _Inputs, escape=False).inputs
    except (OSError, ValueError, RecursionError):
        return ()


def is_run_directory(directory: Path) -> bool:
    """Return whether a directory or an address is a run that icrtool wrote."""
    if isinstance(directory, UrlPath):
        return has_file(directory, RUN_FILE)
    return formats.schema_of(Below(directory, RUN_FILE)).startswith(RUN_FAMILY)


RUN = DirectoryKind(
    "run directory",
    # A run with a damaged run.json may be replaced.
    lambda place: is_run_directory(place) or is_regular(Below(place, formats.SOURCES_FILE)),
    re.compile(RUN_FILES),
)
"""The directory of a run."""


def is_page(first: bytes) -> bool:
    """Return whether icrtool wrote a page, by the first bytes of the file."""
    return b"icrtool</title>" in first


def events_csv(events: Sequence[EventDocument]) -> bytes:
    """Return the content of events.csv, with a row for each slip event."""
    return formats.csv_bytes(EVENT_COLUMNS, map(msgspec.structs.astuple, events))


FIT_AGAIN = "fit the log again"
"""Advice in errors about a run that cannot be read."""

NAMES_IN_THE_LOG = ("topic", "message_type")
"""Keys of run.json whose texts are stored as in the log, without escapes."""


def open_run(path: str | Path, *, whole: bool = True) -> Run:
    """Return the run in a run directory, equal to the run that was written.

    Parameters
    ----------
    path : a directory that `icrtool fit` or `Run.write` made, or its address
    whole : hold all columns; otherwise standard deviations of states in Parquet are read where they are used. This
        needs a third less memory, but the file must not change

    Raises
    ------
    RunError
        The directory is no run, is from another version, or was edited or cut off after it was written.
    OutputError
        The address cannot be read.
    """
    place = place_of(path)
    with folder_on_disk(place, lambda name: "/" not in name, writes=False) as directory:
        return _run_in(directory, place, whole=whole or directory is not place)


def _run_in(directory: Path, place: Path, *, whole: bool) -> Run:
    """Return the run in a directory on disk; errors name `place`."""
    stored = _read_document(directory)
    sums = formats.read_sums(directory)
    check_sum(directory, RUN_FILE, sums)
    if MEASUREMENTS_FILE not in sums:
        raise RunError(directory, f"{formats.CHECKSUM_FILE} names no {MEASUREMENTS_FILE}", FIT_AGAIN)
    try:
        config = parse_config(msgspec.convert(stored.get("config"), dict[str, Any]))
        document = msgspec.convert(stored | {"config": config}, RunDocument)
        table = _read_states(directory, "states", sums, whole=whole)
        if table is None:
            raise RunError(directory, f"{formats.CHECKSUM_FILE} names no states", FIT_AGAIN)
        if table.fault:
            raise ValueError(table.fault)
        check_sum(directory, MEASUREMENTS_FILE, sums)
        table, sensors, gnss, heading = run_columns.read_measurements(directory, table, document)
        smoothed = _read_states(directory, "smoothed", sums, whole=whole)
        if smoothed is not None and not np.array_equal(smoothed.stamp_ns, table.stamp_ns):
            raise RunError(directory, "its smoothed states are not at the stamps of its states", FIT_AGAIN)
        run = Run(
            document=document,
            table=table,
            in_gap=np.isin(table.stamp_ns, run_columns.spans_of(document.wheel_gaps_ns)[:, 0]),
            outages_ns=run_columns.spans_of(document.outages_ns),
            sensors=sensors,
            gnss=gnss,
            heading=heading,
            smoothed=smoothed,
            directory=place,
        )
    except ConfigError as err:
        raise RunError(directory, f"its configuration is not of this version ({err.what})", FIT_AGAIN) from err
    except (OSError, ValueError, OverflowError) as err:
        raise RunError(directory, f"cannot be read ({err})", FIT_AGAIN) from err
    return run


def log_of(run: Run) -> Path:
    """Return the log that a run was made from: its file, or the bag directory with its files.

    Raises
    ------
    RunError
        The log is no longer at the path from which the run was made.
    """
    files = [place_of(file.path) for file in run.document.inputs]
    if len(files) == 1 and isinstance(files[0], UrlPath):
        return files[0]
    missing = [file for file in files if not file.is_file()]
    if missing or not files:
        gone = missing[0] if missing else "a list of inputs"
        why = f"the log it was made from is gone ({gone})"
        raise RunError(run.directory or run.name, why, "put it back, or name it")
    folder = files[0].parent
    series = [numbered_file(file) for file in files]
    if len(files) > 1 and len({split.series for split in series if split is not None}) == 1 and None not in series:
        same_suffix = {file for file in folder.iterdir() if file.suffix == files[0].suffix}
        if files[0].suffix == ".bag" or (same_suffix != set(files) and not (folder / "metadata.yaml").is_file()):
            return split_path(files)
    return folder if len(files) > 1 or (folder / "metadata.yaml").is_file() else files[0]


def newest_run(runs: Path) -> Path:
    """Return the newest run directory below a folder, by the time of its run.json.

    Raises
    ------
    RunError
        The folder has no run.
    """
    run_files = [file for file in runs.glob(f"*/{RUN_FILE}") if is_run_directory(file.parent)]
    if not run_files:
        raise RunError(runs, "holds no run", "name a run directory or a log, or make a run with icrtool fit")
    return max(run_files, key=lambda file: (file.stat().st_mtime_ns, str(file))).parent


def _read_document(directory: Path) -> dict[str, Any]:
    """Return the content of a run.json of this version, with its texts from the log escaped."""
    try:
        raw = read_regular(Below(directory, RUN_FILE))
    except (OSError, ValueError) as err:
        if is_special(directory):
            raise RunError(directory, NOT_REGULAR, SAVE_IT) from err
        if not directory.is_dir():
            raise RunError(directory, "no such run directory", "icrtool fit makes one") from err
        why = f"it holds no readable {RUN_FILE}; icrtool fit makes one"
        raise RunError(directory, "not a run directory", why) from err
    try:
        document = formats.parse_json(raw)
    except (ValueError, RecursionError) as err:
        raise RunError(directory, f"{RUN_FILE} is not JSON", FIT_AGAIN) from err
    schema = document.get("schema") if isinstance(document, dict) else None
    if not (isinstance(schema, str) and schema.startswith(RUN_FAMILY)):
        raise RunError(directory, "not a run directory", f"its {RUN_FILE} is not icrtool's")
    if schema != RUN_SCHEMA:
        why = f"its schema is {shortened(schema, LONGEST_NAME)}, this icrtool reads {RUN_SCHEMA}"
        raise RunError(directory, why, FIT_AGAIN)
    # From here on, texts from a log in run.json are safe to print.
    return {
        key: value if key == "inputs" else escaped_texts(value, NAMES_IN_THE_LOG) for key, value in document.items()
    }


def _read_states(directory: Path, stem: str, sums: Mapping[str, str], *, whole: bool) -> States | None:
    """Return the states in the file of this name, CSV or Parquet; None for a run without this file."""
    for states in STATES_FORMATS:
        if (name := f"{stem}.{states}") in sums:
            with ThreadPoolExecutor(1) as pool:
                # Both threads read all of the file. Hashing releases the GIL, so they work at the same time.
                checked = pool.submit(check_sum, directory, name, sums)
                try:
                    return run_columns.read_states(Below(directory, name), states, whole=whole)
                finally:
                    checked.result()
    return None


def check_sum(directory: Path, name: str, sums: Mapping[str, str]) -> None:
    """Refuse a file of a run whose checksum differs from the checksum in the list.

    Raises
    ------
    RunError
        The checksums differ, or the file cannot be read.
    """
    try:
        digest = formats.file_b2sum(Below(directory, name))
    except OSError as err:
        raise RunError(directory, f"{name} is missing or unreadable ({err.strerror})", FIT_AGAIN) from err
    if digest != sums.get(name):
        raise RunError(directory, f"{name} was edited or cut short since the run", FIT_AGAIN)
