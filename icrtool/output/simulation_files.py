"""Files of simulations: a log with its truth in the same folder, given track speeds, and the directory of a study.

A study is written whole or not at all: every run as CSV, parameters and statistics as JSON, the picture.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

import numpy as np

from icrtool import __version__
from icrtool.errors import DataError, OutputError
from icrtool.output.files.atomic import (
    DirectoryKind,
    atomic_directory,
    check_directory,
    partial_at,
    place_errors,
    put_in_place,
    sync_tree,
)
from icrtool.output.files.formats import csv_bytes, json_bytes, read_numbers, schema_of
from icrtool.records.choices import StudyName
from icrtool.records.places import Below
from icrtool.records.process_resources import remove_path
from icrtool.simulation.drives import TrackSpeeds, TruthTable
from icrtool.simulation.study_records import StudyResult

SPEED_COLUMNS = ("t_s", "v_left_mps", "v_right_mps")
"""Columns of a file with given track speeds."""


def truth_path(log: Path) -> Path:
    """Return the path of a log's truth: ``LOG.truth.csv`` in the log's folder."""
    return log.with_name(f"{log.name}.truth.csv")


@contextmanager
def log_and_truth(log: Path, *, force: bool) -> Iterator[tuple[Path, Path]]:
    """Yield hidden paths for a log and its truth; both are renamed to their places when the block ends without error.

    Parameters
    ----------
    log : place of the log; the place of its truth is `truth_path`
    force : replace an existing log (a file, or a bag directory)

    Raises
    ------
    OutputError
        The place is taken, or it cannot be written. The place is then unchanged.
    """
    if not log.name:
        raise OutputError(log, "has no name for a log", "name an .mcap or .bag file, or a directory in it")
    truth = truth_path(log)
    if not log.is_file():
        check_directory(log, BAG)
    with place_errors(log):
        for place in (log, truth):
            if place.exists() and not force:
                raise OutputError(place, "exists already", "--force replaces it")
        if truth.is_dir():
            raise OutputError(truth, "is a directory", "it is left alone; choose another name")
        with partial_at(log.absolute(), Path.mkdir) as fresh:
            try:
                yield fresh / log.name, fresh / truth.name
            except OutputError as err:
                # The bag's metadata names the hidden directory.
                raise OutputError(log, err.why, err.advice) from err
            sync_tree(fresh)
            # If the process is killed from here on, the log has no truth, but never the truth of another log.
            remove_path(truth)
            put_in_place(fresh / log.name, log.absolute())
            put_in_place(fresh / truth.name, truth.absolute())


BAG = DirectoryKind(
    "bag directory",
    lambda place: (place / "metadata.yaml").is_file(),
    re.compile(r"metadata\.yaml|[^/]+\.(db3|mcap)(\.zstd)?"),
)
"""A ROS 2 bag directory."""


def write_truth(table: TruthTable, path: Path) -> None:
    """Write the truth; each number has the fewest digits that are exact."""
    import pyarrow as pa
    import pyarrow.csv as pc

    header = ",".join(table) + "\n"
    with path.open("xb") as file:
        file.write(header.encode())
        rows = pa.table({name: np.ascontiguousarray(values) for name, values in table.items()})
        pc.write_csv(rows, file, pc.WriteOptions(include_header=False, quoting_style="none"))


def read_speeds(path: Path) -> TrackSpeeds:
    """Return the track speeds in the columns ``t_s, v_left_mps, v_right_mps`` of a CSV; other columns are ignored.

    Raises
    ------
    DataError
        The file cannot be read or has no usable columns, or the times do not increase.
    """
    t, left, right = read_numbers(path, SPEED_COLUMNS).values()
    if not np.isfinite([t, left, right]).all():
        row = int(np.argmin(np.isfinite([t, left, right]).all(axis=0)))
        raise DataError(path, f"row {row + 1} holds a value that is not a finite number")
    if not (np.diff(t) > 0).all():
        row = int(np.argmax(np.diff(t) <= 0)) + 1
        raise DataError(path, f"the times do not increase at row {row + 1}", f"t_s = {t[row]:g} after {t[row - 1]:g}")
    return TrackSpeeds(t - t[0], left, right)


STUDY_SCHEMA = "icrtool/study/1"
"""Schema of study.json."""

STUDY_FILE = "study.json"
"""Name of the file with parameters and statistics of a study."""

STUDY_FAMILY = "icrtool/study/"
"""First part of the schema of a study, without its version."""


def check_study_target(directory: Path) -> None:
    """Refuse a place where a study cannot be put, before any work is done for it.

    Raises
    ------
    OutputError
        The place has a file, a directory that is not a study, or a study with files that icrtool did not write.
    """
    check_directory(directory, STUDY)


def write_study(result: StudyResult, directory: Path, *, plots: tuple[str, ...] = ("png",)) -> None:
    """Write ``study.json``, ``NAME.csv`` and ``NAME.png``.

    Parameters
    ----------
    directory : folder of the study; an old study there is replaced
    plots : formats of the picture, of ``png``, ``svg`` and ``pdf``

    Raises
    ------
    OutputError
        `check_study_target` refuses the place, or the files cannot be written.
    """
    name = result.request.name
    document = {
        "schema": STUDY_SCHEMA,
        "tool_version": __version__,
        "study": name,
        "about": result.study.about,
        "paper_figures": result.study.figures,
        "settings": result.request.settings(),
        "findings": [number._asdict() for number in result.findings],
        "levels": result.records(),
    }
    with atomic_directory(directory, STUDY) as partial:
        (partial / STUDY_FILE).write_bytes(json_bytes(document))
        columns = (column if isinstance(column, list) else column.tolist() for column in result.columns.values())
        rows = zip(*columns, strict=True)
        (partial / f"{name}.csv").write_bytes(csv_bytes(result.columns, rows))
        if plots:
            from icrtool.output.figures.study import study_figure
            from icrtool.output.figures.style import save_figure

            save_figure(study_figure(result), partial / name, plots)


STUDY = DirectoryKind(
    "study directory",
    lambda place: schema_of(Below(place, STUDY_FILE)).startswith(STUDY_FAMILY),
    re.compile(rf"study\.json|({'|'.join(get_args(StudyName))})\.(csv|png|svg|pdf)"),
)
"""The directory of a study."""
