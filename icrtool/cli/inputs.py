"""Inputs and outputs of a command: logs and runs among its arguments, and the directories of results."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from icrtool.cli import lazy_imports
from icrtool.cli.printing import Printer
from icrtool.records.places import Below, Place, UrlPath, place_of
from icrtool.records.text import LogText, escaped

with lazy_imports():
    from icrtool import errors
    from icrtool.calibration import pooled
    from icrtool.estimation import fit
    from icrtool.fleet import fleet_files, recordings
    from icrtool.logs import read_log
    from icrtool.logs.containers import recording_files
    from icrtool.output import run_directory
    from icrtool.output.files import formats
    from icrtool.records import requests

if TYPE_CHECKING:
    from icrtool.calibration.record import Calibration
    from icrtool.config import Config
    from icrtool.records.run import Run

RUNS_FOLDER = Path("icrtool-runs")
"""Folder of the run directories, relative to the current folder."""


def logs_of(places: tuple[Path, ...], printer: Printer) -> tuple[Path, ...]:
    """Return the logs among the arguments of a command and in folders among them; warn of files that are no logs."""
    logs, others = recordings.logs_among(places)
    printer.warn(f"{escaped(str(file))}: is not a log; it is left out" for file in others)
    return tuple(logs)


def runs_or_logs(place: Path) -> list[Path]:
    """Return the runs in a folder, or its logs if it has no runs; for a run or a log, return the place itself."""
    if not isinstance(place, UrlPath):
        if run_directory.is_run_directory(place) or not place.is_dir():
            return [place]
        if fleet_files.is_fleet(place):
            return [run for runs in fleet_files.runs_of_fleet(place).values() for run in runs]
        runs = sorted(file.parent for file in place.rglob(run_directory.RUN_FILE))
        if of_icrtool := [run for run in runs if run_directory.is_run_directory(run)]:
            return of_icrtool
    return [recording.path for recording in recordings.find_recordings([place])]


def runs_named(paths: Sequence[Path], config: Config, printer: Printer) -> list[Run]:
    """Return the runs of run directories and of logs. A log is fitted without a motion model; no file is written."""
    runs = []
    with printer.progress("reading") as progress:
        for path in paths:
            printer.detail(str(path))
            if run_directory.is_run_directory(path):
                runs.append(run_directory.open_run(path))
            else:
                runs.append(fit.fit_filter(read_log.read_log(path, config), config, requests.FitRequest()))
            progress(len(runs) / len(paths))
    return runs


def check_run_config(config: Config, *, free: str = "") -> None:
    """Refuse configured settings for a finished run, except settings of the section `free`."""
    if sections := sorted({key.partition(".")[0] for key in config.given} - {free}):
        advice = "fit the log again with these settings, or name the log in place of its run"
        raise errors.ConfigError(f"[{sections[0]}]", "a finished run keeps its own configuration", advice)


def is_log(source: Path) -> bool:
    """Return whether an argument is read as a log: a file but JSON, a bag directory, or an address without a run."""
    if isinstance(source, UrlPath):
        return not run_directory.is_run_directory(source)
    if source.is_file():
        with source.open("rb") as file:
            return source.suffix != ".json" and file.read(1) != b"{"
    return recording_files.is_bag_directory(source) or bool(recording_files.split_files(source))


class ResultPlace(NamedTuple):
    """Values of -o and --into: the run directory of one log, and the folder of run directories."""

    output: Path | None = None
    into: Path | None = None


def run_directories(logs: tuple[Path, ...], place: ResultPlace) -> list[Place]:
    """Return the run directory of each log.

    It is ``icrtool-runs/NAME`` by default, `output` for one log, ``OUTPUT/NAME`` for several logs, and ``INTO/NAME``
    for any number of logs. Logs of equal names get names from the differing parts of their paths.

    Raises
    ------
    OutputError
        The folder of the run directories is a run itself.
    """
    output, into = place
    if output is not None and into is not None:
        raise click.UsageError("-o and --into exclude each other: give one of them")
    if output is not None and len(logs) == 1:
        return [output]
    parent = output or into
    if parent is not None and (parent / run_directory.RUN_FILE).is_file():
        advice = "fitting that run again would remove the runs in it: name another place"
        raise errors.OutputError(parent, "is a run itself", advice)
    folder = parent or RUNS_FOLDER
    return [Below(folder, name) for name in recordings.distinct_names(logs)]


def read_calibration(source: Path | None, *, force: bool = False, advice: str = "") -> tuple[str, Calibration]:
    """Return the name of a calibration file or run, and its calibration (see `read_calibration_and_run`)."""
    return read_calibration_and_run(source, force=force, advice=advice)[:2]


def read_calibration_and_run(
    source: Path | None, *, force: bool = False, advice: str = ""
) -> tuple[str, Calibration, Run | None]:
    """Return the name of a calibration file or run, its calibration, and the run; None for a calibration file.

    Parameters
    ----------
    source : place of the file or run; None: the newest run
    force : also calibrate a run that is not usable
    advice : text at the end of the error about such a run

    Raises
    ------
    DataError
        The run is not usable, or too short.
    RunError
        There is no such file or run, or it is a log.
    """
    if source is not None and source.suffix == ".json" and not source.exists() and not isinstance(source, UrlPath):
        raise errors.RunError(source, "no such file", "icrtool calibrate -o makes a calibration file")
    if source is not None and is_log(source):
        advice = f"icrtool fit {escaped(str(source))} makes its run, icrtool calibrate -o a calibration file"
        raise errors.RunError(source, "is a log, not a run or a calibration", advice)
    if source is not None and source.is_file():
        return source.name, formats.open_calibration(source), None
    run = run_directory.open_run(source or run_directory.newest_run(RUNS_FOLDER))
    if not (run.usable or force):
        why = f"its ICRs are not usable: {run.document.unusable_because}"
        raise errors.DataError(run.name, why, f"drive again, with turns to both sides{advice}")
    return run.name, pooled.calibrate(run, allow_unusable=force), run


def groups_of(sources: tuple[str, ...]) -> dict[LogText, list[Path]]:
    """Return the places of each group by name; the folder of a batch, as the only argument, has its own groups.

    Raises
    ------
    ConfigError
        There is only one group.
    RunError
        The table of the batch cannot be read.
    """
    places: dict[LogText, list[Path]] = {}
    for source in sources:
        name, path = named_place(source)
        if len(sources) == 1 and fleet_files.is_fleet(path):
            places = {LogText(group): runs for group, runs in fleet_files.runs_of_fleet(path).items()}
        else:
            places.setdefault(name, []).extend(_expanded(path))
    if len(places) < 2:
        raise errors.ConfigError("compare", "only one group is given", "name two or more: old=season1/ new=season2/")
    return places


def _expanded(place: Path) -> list[Path]:
    """Return the files that a pattern after ``NAME=`` matches, because no shell expands it; else the place itself."""
    if isinstance(place, UrlPath) or place.exists() or not glob.has_magic(str(place)):
        return [place]
    files = sorted(glob.glob(str(place)))  # noqa: PTH207 - a pattern may be absolute
    return [Path(file) for file in files] or [place]


def named_place(source: str) -> tuple[LogText, Path]:
    """Return the name of the group and the place in an argument ``NAME=PLACE`` or ``PLACE``."""
    whole_place = place_of(source)
    name, sign, place = source.partition("=")
    # An address may have an equals sign in its query.
    if sign and name and place and not isinstance(place_of(name), UrlPath) and not whole_place.exists():
        return LogText(name), place_of(place)
    return LogText(whole_place.name or str(whole_place)), whole_place


def grounds_of(sources: tuple[str, ...]) -> tuple[list[Path], list[str]]:
    """Return the runs and logs of ``calibrate``, and the ground of each; no grounds if the user names none.

    If the folder of a batch is the only argument, its groups are the grounds.

    Raises
    ------
    ConfigError
        Only some of the arguments name a ground.
    RunError
        The table of the batch cannot be read.
    """
    places = [named_place(source) for source in sources]
    have_ground = [place_of(source) != path for source, (_, path) in zip(sources, places, strict=True)]
    if len(places) == 1 and not have_ground[0] and fleet_files.is_fleet(places[0][1]):
        ground_runs = [(name, run) for name, runs in fleet_files.runs_of_fleet(places[0][1]).items() for run in runs]
        return [run for _, run in ground_runs], [str(name) for name, _ in ground_runs]
    if any(have_ground) and not all(have_ground):
        groundless = escaped(str(places[have_ground.index(False)][1]))
        raise errors.ConfigError(groundless, "names no ground", "write GROUND= before each argument, or before none")
    ground_runs = [
        (str(name), run_or_log)
        for name, place in places
        for path in _expanded(place)
        for run_or_log in runs_or_logs(path)
    ]
    return [run_or_log for _, run_or_log in ground_runs], [name for name, _ in ground_runs] if all(have_ground) else []
