"""The run directory: what `icrtool fit` leaves behind, and what `icrtool dropout-report` takes up again."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from icrtool.errors import RunError
from icrtool.estimation.measured_heading import MeasuredHeading, measured_headings
from icrtool.output.atomic_directory import check_place, whole_directory
from icrtool.output.figures.drawing_process import Drawer, DrawingHere
from icrtool.output.headings_file import HEADINGS_FILE, read_headings, write_headings
from icrtool.output.states_file import StatesFileError, StatesFormat, file_b2sum, read_states, write_states
from icrtool.records.run import RUN_SCHEMA
from icrtool.records.tables import Bools, Ints, States

if TYPE_CHECKING:
    from icrtool.estimation.filter_setup import WarmStart
    from icrtool.estimation.fit import FilterRun

RUN_FILE = "run.json"
CHECKSUM_FILE = "B2SUMS"
"""Sums of run.json and the states, as ``b2sum -c`` reads them: an edited run is not taken for a measured one."""

STATES_FILES: dict[str, StatesFormat] = {"states.csv": "csv", "states.parquet": "parquet"}

SMOOTHED_FILES: dict[str, StatesFormat] = {"smoothed.csv": "csv", "smoothed.parquet": "parquet"}

PLOT_FORMATS = ("png", "svg", "pdf")

SCHEMA_FAMILY = "icrtool/run/"

LATER_NAMES = (RUN_FILE, CHECKSUM_FILE, *STATES_FILES, *SMOOTHED_FILES, HEADINGS_FILE, "events.csv", "report.html",
               "plots", "dropout")  # fmt: skip
"""What a run directory may hold that is icrtool's, though the list of its files does not name it."""


@dataclass(frozen=True, slots=True)
class StoredRun:
    """A run as its directory holds it.

    Attributes
    ----------
    name : name of the log
    in_gap : bool (n,), whether the interval after a state is a gap in the wheel data
    outages_ns : half-open spans without usable GNSS, (k, 2)
    summary : run.json
    track_width_m : b of the robot, None where it was not given
    directory : where it was read from
    """

    name: str
    table: States
    in_gap: Bools
    outages_ns: Ints
    summary: dict[str, Any]
    track_width_m: float | None
    directory: Path


def check_target(directory: Path) -> None:
    """Refuse a place where a run directory cannot be put, before any work is done for it.

    Raises
    ------
    OutputError
        A file or a directory that is not a run of ours is there.
    """
    check_place(directory, is_run_directory, kind="run directory")


def write_run(
    run: FilterRun,
    directory: Path,
    *,
    states: StatesFormat = "csv",
    plots: tuple[str, ...] = ("png",),
    smoothed: States | None = None,
    drawer: Drawer | None = None,
    note: Callable[[str], None] | None = None,
) -> None:
    """Write a run directory, whole or not at all.

    Parameters
    ----------
    run : what `fit` returned
    directory : where it shall appear; an old run there is replaced, with all that was made from it
    states : format of the states
    plots : formats of the figures, of ``png``, ``svg`` and ``pdf``; none: no figures
    smoothed : the smoother's states, written as ``smoothed`` in the same format
    drawer : what draws the figures, in its own formats; default: this process, in those of `plots`
    note : called with one line where an old run was replaced and files of it were removed or, not icrtool's, kept

    Raises
    ------
    OutputError
        A file or a foreign directory is in the way, or the disk does not take it.
    """
    if unknown := set(plots) - set(PLOT_FORMATS):
        raise ValueError(f"plots: {unknown} are not among {PLOT_FORMATS}")
    with (
        whole_directory(directory, is_run_directory, kind="run directory", names=LATER_NAMES, note=note) as partial,
        (drawer if drawer is not None else DrawingHere(plots)).into(partial / "plots") as draw,
        ThreadPoolExecutor(1) as pool,
    ):
        states_name = f"states.{states}"
        states_sum = pool.submit(write_states, run.table, partial / states_name, states)
        draw(_write_figures, run)
        sums: dict[str, str] = {}
        if smoothed is not None:
            sums[f"smoothed.{states}"] = write_states(smoothed, partial / f"smoothed.{states}", states)
        if headings := measured_headings(run):
            write_headings(headings, run.table.stamp_ns, partial / HEADINGS_FILE)
            sums[HEADINGS_FILE] = file_b2sum(partial / HEADINGS_FILE)
        (partial / RUN_FILE).write_bytes(json_bytes(run.summary))
        sums = {RUN_FILE: file_b2sum(partial / RUN_FILE), states_name: states_sum.result()} | sums
        (partial / CHECKSUM_FILE).write_bytes("".join(f"{sum_}  {name}\n" for name, sum_ in sums.items()).encode())


def read_run(directory: Path) -> StoredRun:
    """Read a run directory back.

    Raises
    ------
    RunError
        Not a run directory, one of another schema, or one that was edited or cut short since it was written.
    """
    document = _read_document(directory)
    sums = _read_sums(directory)
    name = next((name for name in STATES_FILES if name in sums), None)
    if name is None:
        raise RunError(directory, f"{CHECKSUM_FILE} names no states", "run icrtool fit again")
    _check_sum(directory, RUN_FILE, sums.get(RUN_FILE))
    try:
        with ThreadPoolExecutor(1) as pool:
            # Both read the file from end to end; hashing leaves the interpreter to the other.
            checked = pool.submit(_check_sum, directory, name, sums[name])
            try:
                table = read_states(directory / name, STATES_FILES[name])
            finally:
                checked.result()
        return StoredRun(
            name=str(document["log"]),
            table=table,
            in_gap=np.isin(table.stamp_ns, _spans(document["wheel_gaps_ns"])[:, 0]),
            outages_ns=_spans(document["outages_ns"]),
            summary=document,
            track_width_m=document["config"]["robot"]["track_width_m"],
            directory=directory,
        )
    except (OSError, StatesFileError, KeyError, TypeError, ValueError) as err:
        raise RunError(directory, f"cannot be read ({err})", "run icrtool fit again") from err


def read_smoothed(directory: Path, stamp_ns: Ints) -> States:
    """Read the smoother's states of a run, which must be at the stamps of its states.

    Raises
    ------
    RunError
        The run was made without them, or they were edited since.
    """
    sums = _read_sums(directory)
    name = next((name for name in SMOOTHED_FILES if name in sums), None)
    if name is None:
        raise RunError(directory, "it has no smoothed states", "run icrtool fit --smooth")
    _check_sum(directory, name, sums[name])
    try:
        smoothed = read_states(directory / name, SMOOTHED_FILES[name])
    except (OSError, StatesFileError) as err:
        raise RunError(directory, f"{name} cannot be read ({err})", "run icrtool fit --smooth again") from err
    if not np.array_equal(smoothed.stamp_ns, stamp_ns):
        raise RunError(directory, f"{name} is not of the same states", "run icrtool fit --smooth again")
    return smoothed


def read_measured_headings(run: StoredRun) -> tuple[MeasuredHeading, ...]:
    """Read the headings that were measured apart from the reference; empty where the run has none.

    Raises
    ------
    RunError
        The file was edited since the run, or cannot be read.
    """
    sums = _read_sums(run.directory)
    if HEADINGS_FILE not in sums:
        return ()
    _check_sum(run.directory, HEADINGS_FILE, sums[HEADINGS_FILE])
    try:
        return read_headings(run.directory / HEADINGS_FILE, run.table.stamp_ns)
    except (OSError, KeyError, ValueError) as err:
        raise RunError(run.directory, f"{HEADINGS_FILE} cannot be read ({err})", "run icrtool fit again") from err


def read_warm_start(directory: Path) -> WarmStart:
    """Return the ICRs and their covariance that a run ended with.

    Raises
    ------
    RunError
        As `read_run`, or a run that did not record them.
    """
    from icrtool.estimation.filter_setup import WarmStart

    run = read_run(directory)
    try:
        final = run.summary["icr"]["final"]
        icrs = np.array([final[column] for column in ("y_icr_right_m", "y_icr_left_m", "x_icr_m")], np.float64)
        covariance = np.array(run.summary["icr"]["final_covariance_m2"], np.float64).reshape(3, 3)
    except (KeyError, TypeError, ValueError) as err:
        raise RunError(
            directory, "does not say what ICRs and covariance it ended with", "run icrtool fit again"
        ) from err
    return WarmStart(icrs, covariance, run.track_width_m)


def log_of_run(directory: Path) -> str | None:
    """Return the path of the log that the run in a directory was made from; None where there is none that tells."""
    try:
        return str(json.loads((directory / RUN_FILE).read_bytes())["inputs"][0]["path"])
    except (OSError, ValueError, LookupError, TypeError):
        return None


def is_run_directory(directory: Path) -> bool:
    """Say whether a directory is a run of ours, of whatever version."""
    try:
        schema = json.loads((directory / RUN_FILE).read_bytes())["schema"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return isinstance(schema, str) and schema.startswith(SCHEMA_FAMILY)


def json_bytes(document: Mapping[str, Any]) -> bytes:
    """Return JSON text as every file of ours has it: indented, UTF-8, null for what is not a finite number."""
    text = json.dumps(_plain(document), indent=2, ensure_ascii=False, allow_nan=False)
    # A file name that is no text (lone surrogates) becomes the escapes that JSON has for it.
    return (text + "\n").encode("utf-8", errors="backslashreplace")


def load_figures() -> None:
    """Load what the figures of a run need, in the process that will draw them."""
    from icrtool.estimation.odometry import load_kernels
    from icrtool.output.figures import run_figures as figures  # noqa: F401 - for its own sake

    load_kernels()


def _write_figures(directory: Path, formats: tuple[str, ...], run: FilterRun) -> None:
    from icrtool.output.figures.run_figures import draw_figures

    draw_figures(run, directory, formats)


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _read_document(directory: Path) -> dict[str, Any]:
    try:
        raw = (directory / RUN_FILE).read_bytes()
    except OSError as err:
        why = "not a run directory" if directory.is_dir() else "no such run directory"
        raise RunError(directory, why, f"it holds no readable {RUN_FILE}; icrtool fit makes one") from err
    try:
        document = json.loads(raw)
    except ValueError as err:
        raise RunError(directory, f"{RUN_FILE} is not JSON", "run icrtool fit again") from err
    schema = document.get("schema") if isinstance(document, dict) else None
    if not (isinstance(schema, str) and schema.startswith(SCHEMA_FAMILY)):
        raise RunError(directory, "not a run directory", f"its {RUN_FILE} is not icrtool's")
    if schema != RUN_SCHEMA:
        raise RunError(directory, f"its schema is {schema}, this icrtool reads {RUN_SCHEMA}", "run icrtool fit again")
    return cast(dict[str, Any], document)


def _read_sums(directory: Path) -> dict[str, str]:
    try:
        lines = (directory / CHECKSUM_FILE).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise RunError(directory, f"no readable {CHECKSUM_FILE}", "run icrtool fit again") from err
    return {name: sum_ for sum_, _, name in (line.partition("  ") for line in lines)}


def _check_sum(directory: Path, name: str, expected: str | None) -> None:
    try:
        found = file_b2sum(directory / name)
    except OSError as err:
        raise RunError(directory, f"{name} is missing or unreadable", "run icrtool fit again") from err
    if found != expected:
        raise RunError(directory, f"{name} was edited or cut short since the run", "run icrtool fit again")


def _spans(pairs: object) -> Ints:
    return np.array(pairs, np.int64).reshape(-1, 2)
