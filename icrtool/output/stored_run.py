"""Runs on disk: open one, find the newest one, find the log that one was made from."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from icrtool.config import parse_config
from icrtool.errors import ConfigError, RunError
from icrtool.logs.containers.split_files import numbered_file, split_path
from icrtool.output.files.formats import CHECKSUM_FILE, file_b2sum, parse_json, read_sums
from icrtool.output.files.measurements_file import MEASUREMENTS_FILE, read_measurements, spans_of
from icrtool.output.files.remote_place import fetched
from icrtool.output.files.states_file import StatesFileError, StatesFormat, read_states
from icrtool.output.run_directory import (
    RUN_FILE,
    SCHEMA_FAMILY,
    SMOOTHED_FILES,
    STATES_FILES,
    is_run_directory,
)
from icrtool.records.process_resources import give_back_freed
from icrtool.records.regular_file import NOT_REGULAR, SAVE_IT, is_special, read_regular
from icrtool.records.run import Run
from icrtool.records.run_document import RUN_SCHEMA, RunDocument
from icrtool.records.tables import States
from icrtool.records.text import LONGEST_NAME, escaped_texts, shortened
from icrtool.records.urls import UrlPath, place_of

FIT_AGAIN = "fit the log again"

NAMES = ("topic", "message_type")
"""Keys of run.json whose texts stand there as in the log."""


def open_run(path: str | Path) -> Run:
    """Read a run directory back, equal to the run that was written.

    Parameters
    ----------
    path : a directory that `icrtool fit` or `Run.write` made, or its address

    Raises
    ------
    RunError
        Not a run directory, one of another version, or one that was edited or cut short since it was written.
    OutputError
        The address cannot be read.
    """
    place = place_of(path) if isinstance(path, str) else path
    with fetched(place, lambda name: "/" not in name) as directory:
        return _run_in(directory, place)


def _run_in(directory: Path, place: Path) -> Run:
    """Return the run in a directory on disk; `place`: that it stands for."""
    stored = _read_document(directory)
    sums = read_sums(directory)
    check_sum(directory, RUN_FILE, sums)
    if MEASUREMENTS_FILE not in sums:
        raise RunError(directory, "made by an older version of icrtool", FIT_AGAIN)
    try:
        config = parse_config(msgspec.convert(stored.get("config"), dict[str, Any]))
        document = msgspec.convert(stored | {"config": config}, RunDocument)
        table = _read_states(directory, STATES_FILES, sums)
        if table is None:
            raise RunError(directory, f"{CHECKSUM_FILE} names no states", FIT_AGAIN)
        if table.fault:
            raise ValueError(table.fault)
        check_sum(directory, MEASUREMENTS_FILE, sums)
        table, sensors, gnss, heading = read_measurements(directory, table, document)
        smoothed = _read_states(directory, SMOOTHED_FILES, sums)
        if smoothed is not None and not np.array_equal(smoothed.stamp_ns, table.stamp_ns):
            raise RunError(directory, "its smoothed states are not at the stamps of its states", FIT_AGAIN)
        run = Run(
            document=document,
            table=table,
            in_gap=np.isin(table.stamp_ns, spans_of(document.wheel_gaps_ns)[:, 0]),
            outages_ns=spans_of(document.outages_ns),
            sensors=sensors,
            gnss=gnss,
            heading=heading,
            smoothed=smoothed,
            directory=place,
        )
    except ConfigError as err:
        raise RunError(directory, f"its configuration is not of this version ({err.what})", FIT_AGAIN) from err
    except (OSError, StatesFileError, ValueError, OverflowError) as err:
        raise RunError(directory, f"cannot be read ({err})", FIT_AGAIN) from err
    give_back_freed()
    return run


def log_of(run: Run) -> Path:
    """Return the log a run was made from: its file, or the bag directory its files lie in.

    Raises
    ------
    RunError
        It is not where it was when the run was made.
    """
    files = [place_of(file.path) for file in run.document.inputs]
    if len(files) == 1 and isinstance(files[0], UrlPath):
        return files[0]
    gone = [file for file in files if not file.is_file()]
    if gone or not files:
        what = gone[0] if gone else "a list of inputs"
        raise RunError(
            run.directory or run.name, f"the log it was made from is gone ({what})", "put it back, or name it"
        )
    folder = files[0].parent
    series = [numbered_file(file) for file in files]
    if len(files) > 1 and len({one.series for one in series if one is not None}) == 1 and None not in series:
        beside = {file for file in folder.iterdir() if file.suffix == files[0].suffix}
        if files[0].suffix == ".bag" or (beside != set(files) and not (folder / "metadata.yaml").is_file()):
            return split_path(files)
    return folder if len(files) > 1 or (folder / "metadata.yaml").is_file() else files[0]


def newest_run(runs: Path) -> Path:
    """Return the newest run directory below a folder, by the time of its run.json.

    Raises
    ------
    RunError
        There is none.
    """
    found = [file for file in runs.glob(f"*/{RUN_FILE}") if is_run_directory(file.parent)]
    if not found:
        raise RunError(runs, "no run in it", "name a run directory or a log, or make a run with icrtool fit")
    return max(found, key=lambda file: (file.stat().st_mtime_ns, str(file))).parent


def _read_document(directory: Path) -> dict[str, Any]:
    try:
        raw = read_regular(directory / RUN_FILE, directory)
    except (OSError, ValueError) as err:
        if is_special(directory):
            raise RunError(directory, NOT_REGULAR, SAVE_IT) from err
        why = "not a run directory" if directory.is_dir() else "no such run directory"
        raise RunError(directory, why, f"it holds no readable {RUN_FILE}; icrtool fit makes one") from err
    try:
        document = parse_json(raw)
    except (ValueError, RecursionError) as err:
        raise RunError(directory, f"{RUN_FILE} is not JSON", FIT_AGAIN) from err
    schema = document.get("schema") if isinstance(document, dict) else None
    if not (isinstance(schema, str) and schema.startswith(SCHEMA_FAMILY)):
        raise RunError(directory, "not a run directory", f"its {RUN_FILE} is not icrtool's")
    if schema != RUN_SCHEMA:
        raise RunError(
            directory, f"its schema is {shortened(schema, LONGEST_NAME)}, this icrtool reads {RUN_SCHEMA}", FIT_AGAIN
        )
    # What a log wrote there is printed from here on.
    return {key: value if key == "inputs" else escaped_texts(value, NAMES) for key, value in document.items()}


def _read_states(directory: Path, names: Mapping[str, StatesFormat], sums: Mapping[str, str]) -> States | None:
    """Read the first of the named files that the run has; None where it has none of them."""
    name = next((name for name in names if name in sums), None)
    if name is None:
        return None
    with ThreadPoolExecutor(1) as pool:
        # Both read the file from end to end; hashing leaves the interpreter to the other.
        checked = pool.submit(check_sum, directory, name, sums)
        try:
            return read_states(directory / name, names[name], directory)
        finally:
            checked.result()


def check_sum(directory: Path, name: str, sums: Mapping[str, str]) -> None:
    """Refuse a file of a run whose sum is not that of the list.

    Raises
    ------
    RunError
        It is not, or the file cannot be read.
    """
    try:
        found = file_b2sum(directory / name, directory)
    except OSError as err:
        raise RunError(directory, f"{name} is missing or unreadable ({err.strerror})", FIT_AGAIN) from err
    if found != sums.get(name):
        raise RunError(directory, f"{name} was edited or cut short since the run", FIT_AGAIN)
