"""The run directory: what `icrtool fit` leaves behind. `icrtool.output.stored_run` reads it back."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from icrtool.output.atomic_directory import atomic_directory, check_place
from icrtool.output.figures.drawing_process import Drawer, DrawingHere
from icrtool.output.measurements_file import MEASUREMENTS_FILE, write_measurements
from icrtool.output.states_file import StatesFormat, file_b2sum, write_states
from icrtool.records.events import EVENT_COLUMNS
from icrtool.records.plain_data import plain
from icrtool.records.run import Run

RUN_FILE = "run.json"
EVENTS_FILE = "events.csv"
CHECKSUM_FILE = "B2SUMS"
"""Sums of all files but the pictures, as ``b2sum -c`` reads them: an edited run is not taken for a measured one."""

STATES_FILES: dict[str, StatesFormat] = {"states.csv": "csv", "states.parquet": "parquet"}

SMOOTHED_FILES: dict[str, StatesFormat] = {"smoothed.csv": "csv", "smoothed.parquet": "parquet"}

PLOT_FORMATS = ("png", "svg", "pdf")

SCHEMA_FAMILY = "icrtool/run/"

LATER_NAMES = (RUN_FILE, CHECKSUM_FILE, *STATES_FILES, *SMOOTHED_FILES, MEASUREMENTS_FILE, "events.csv", "report.html",
               "plots", "dropout")  # fmt: skip
"""What a run directory may hold that is icrtool's, though the list of its files does not name it."""


def check_target(directory: Path) -> None:
    """Refuse a place where a run directory cannot be put, before any work is done for it.

    Raises
    ------
    OutputError
        A file or a directory that is not a run of ours is there.
    """
    check_place(directory, is_run_directory, kind="run directory")


def write_run(
    run: Run,
    directory: Path,
    *,
    states: StatesFormat = "csv",
    plots: tuple[str, ...] = ("png",),
    drawer: Drawer | None = None,
    note: Callable[[str], None] | None = None,
) -> None:
    """Write a run directory, whole or not at all.

    Parameters
    ----------
    run : its smoothed states, where it has them, are written as ``smoothed`` in the same format
    directory : where it shall appear; an old run there is replaced, with all that was made from it
    states : format of the states
    plots : formats of the figures, of ``png``, ``svg`` and ``pdf``; none: no figures
    drawer : what draws the figures, in its own formats; default: this process, in those of `plots`
    note : called with one line where an old run was replaced and files of it were removed or, not icrtool's, kept

    Raises
    ------
    OutputError
        A file or a foreign directory is there, or the disk does not take it.
    """
    if unknown := set(plots) - set(PLOT_FORMATS):
        raise ValueError(f"plots: {unknown} are not among {PLOT_FORMATS}")
    with (
        atomic_directory(directory, is_run_directory, kind="run directory", names=LATER_NAMES, note=note) as partial,
        (drawer if drawer is not None else DrawingHere(plots)).into(partial / "plots") as draw,
        ThreadPoolExecutor(1) as pool,
    ):
        states_name = f"states.{states}"
        states_sum = pool.submit(write_states, run.table, partial / states_name, states)
        draw(_write_figures, run)
        sums: dict[str, str] = {}
        if run.smoothed is not None:
            sums[f"smoothed.{states}"] = write_states(run.smoothed, partial / f"smoothed.{states}", states)
        write_measurements(run, partial / MEASUREMENTS_FILE)
        (partial / RUN_FILE).write_bytes(json_bytes(run.summary))
        (partial / EVENTS_FILE).write_text(events_csv(run.summary["events"]), encoding="utf-8")
        sums |= {name: file_b2sum(partial / name) for name in (MEASUREMENTS_FILE, RUN_FILE, EVENTS_FILE)}
        sums[states_name] = states_sum.result()
        (partial / CHECKSUM_FILE).write_bytes("".join(f"{sum_}  {name}\n" for name, sum_ in sums.items()).encode())


def log_of_run(directory: Path) -> str | None:
    """Return the path of the log that the run in a directory was made from; None without one."""
    try:
        return str(json.loads((directory / RUN_FILE).read_bytes())["inputs"][0]["path"])
    except (OSError, ValueError, LookupError, TypeError):
        return None


def is_run_directory(directory: Path) -> bool:
    """Return whether a directory is a run of ours, of whatever version."""
    try:
        schema = json.loads((directory / RUN_FILE).read_bytes())["schema"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return isinstance(schema, str) and schema.startswith(SCHEMA_FAMILY)


def events_csv(events: list[dict[str, Any]]) -> str:
    """Return the text of events.csv: a row an event, numbers in full precision."""
    rows = [EVENT_COLUMNS, *(tuple(str(event[column]) for column in EVENT_COLUMNS) for event in events)]
    return "".join(f"{','.join(row)}\n" for row in rows)


def json_bytes(document: Mapping[str, Any]) -> bytes:
    """Return JSON text as every file of ours has it: indented, UTF-8, null for what is not a finite number."""
    text = json.dumps(plain(document), indent=2, ensure_ascii=False, allow_nan=False)
    # A file name that is no text (lone surrogates) becomes the escapes that JSON has for it.
    return (text + "\n").encode("utf-8", errors="backslashreplace")


def load_figures() -> None:
    """Load what the figures of a run need, in the process that will draw them."""
    from icrtool.estimation.odometry import load_kernels
    from icrtool.output.figures import run_figures  # noqa: F401 - for its own sake

    load_kernels()


def _write_figures(directory: Path, formats: tuple[str, ...], run: Run) -> None:
    from icrtool.output.figures.run_figures import draw_figures

    draw_figures(run, directory, formats)
