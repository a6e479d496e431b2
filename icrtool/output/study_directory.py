"""The directory of a study, whole or not at all: every run as CSV, parameters and statistics as JSON, the picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from icrtool import __version__
from icrtool.output.files.atomic import atomic_directory
from icrtool.output.files.formats import csv_bytes, json_bytes, schema_of
from icrtool.output.files.own_files import check_directory
from icrtool.simulation.study_records import Column, StudyResult

STUDY_SCHEMA = "icrtool/study/1"
STUDY_FILE = "study.json"
SCHEMA_FAMILY = "icrtool/study/"
KIND = "study directory"


def check_study_target(directory: Path) -> None:
    """Refuse a place where a study cannot be put, before any work is done for it.

    Raises
    ------
    OutputError
        A file or a directory that is not a study of ours is there.
    """
    check_directory(directory, is_study_directory, kind=KIND)


def write_study(result: StudyResult, directory: Path, *, plots: tuple[str, ...] = ("png",)) -> None:
    """Write ``study.json``, ``NAME.csv`` and ``NAME.png``.

    Parameters
    ----------
    directory : where they shall appear; an old study there is replaced
    plots : formats of the picture, of ``png``, ``svg`` and ``pdf``

    Raises
    ------
    OutputError
        A file or a foreign directory is there, or the disk does not take it.
    """
    name = result.request.name
    with atomic_directory(directory, is_study_directory, kind=KIND) as partial:
        (partial / STUDY_FILE).write_bytes(json_bytes(study_document(result)))
        rows = zip(*map(_cells, result.columns.values()), strict=True)
        (partial / f"{name}.csv").write_bytes(csv_bytes(result.columns, rows))
        if plots:
            from icrtool.output.figures.study import study_figure
            from icrtool.output.figures.style import save

            save(study_figure(result), partial / name, plots)


def is_study_directory(directory: Path) -> bool:
    """Return whether a directory is a study of ours, of whatever version."""
    return schema_of(directory / STUDY_FILE, directory).startswith(SCHEMA_FAMILY)


def study_document(result: StudyResult) -> dict[str, Any]:
    """Return what study.json holds."""
    return {
        "schema": STUDY_SCHEMA,
        "tool_version": __version__,
        "study": result.request.name,
        "about": result.study.about,
        "paper_figures": result.study.figures,
        "settings": result.request.settings(),
        "findings": [one._asdict() for one in result.findings],
        "levels": result.records(),
    }


def _cells(values: Column) -> list[Any]:
    return values if isinstance(values, list) else values.tolist()
