"""What a command reads and where it writes: logs and runs among its arguments, and the directories of results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from icrtool.cli.printing import Printer
from icrtool.records.text import escaped
from icrtool.records.urls import UrlPath

if TYPE_CHECKING:
    from icrtool.calibration.record import Calibration
    from icrtool.config import Config
    from icrtool.records.run import Run

RUNS = Path("icrtool-runs")


def logs_of(places: tuple[Path, ...], printer: Printer) -> tuple[Path, ...]:
    """Return the logs among the arguments of a command, those in folders too, and warn of files that are none."""
    from icrtool.fleet.recordings import logs_among

    logs, beside = logs_among(places)
    printer.warn(f"{escaped(str(file))}: not a log: left out" for file in beside)
    return tuple(logs)


def runs_or_logs(place: Path) -> list[Path]:
    """Return the runs in a folder, or else its logs; a run or log is itself."""
    from icrtool.fleet.recordings import find_recordings
    from icrtool.fleet.roll_up import is_fleet, runs_of_fleet
    from icrtool.output.run_directory import RUN_FILE, is_run_directory

    if isinstance(place, UrlPath):
        return [one.path for one in find_recordings([place])]
    if is_run_directory(place) or not place.is_dir():
        return [place]
    if is_fleet(place):
        return [run for runs in runs_of_fleet(place).values() for run in runs]
    runs = sorted(file.parent for file in place.rglob(RUN_FILE) if is_run_directory(file.parent))
    return runs or [one.path for one in find_recordings([place])]


def runs_of(paths: Sequence[Path], config: Config, printer: Printer) -> list[Run]:
    """Read runs, and fit logs without a recommendation; nothing is written."""
    found = []
    with printer.progress("reading") as progress:
        for path in paths:
            printer.detail(str(path))
            found.append(_run_of(path, config))
            if progress is not None:
                progress(len(found) / len(paths))
    return found


def _run_of(path: Path, config: Config) -> Run:
    from icrtool.output.run_directory import is_run_directory

    if is_run_directory(path):
        from icrtool.output.run_directory import open_run

        return open_run(path)
    from icrtool.estimation.fit import fit
    from icrtool.logs.read_log import read_log

    return fit(read_log(path, config), config)


def check_run_config(config: Config, *, free: str = "") -> None:
    """Refuse settings for a finished run, but those of the section that a report on it is free to change."""
    from icrtool.errors import ConfigError

    if given := sorted(config.given_sections - {free}):
        advice = "fit the log again with it, or name the log in place of its run"
        raise ConfigError(f"[{given[0]}]", "a finished run keeps the configuration it was made with", advice)


class ResultPlace(NamedTuple):
    """Where the runs of a command go, by -o and --into."""

    output: Path | None = None
    into: Path | None = None


class RunPlace(NamedTuple):
    """Where the run of a log goes; `inside` is the folder of the runs, below which no link is followed."""

    directory: Path
    inside: Path | None


def run_directories(logs: tuple[Path, ...], place: ResultPlace) -> list[RunPlace]:
    """Return where each log's run goes: ``icrtool-runs/NAME``, DIR of `output`, or ``DIR/NAME`` for several or `into`.

    Logs of one name are distinguished by what their paths differ in.
    """
    from icrtool.errors import OutputError
    from icrtool.fleet.recordings import distinct_names
    from icrtool.output.run_directory import RUN_FILE

    output, into = place
    if output is not None and into is not None:
        raise click.UsageError("-o and --into both state where the runs go: give one of them")
    if output is not None and len(logs) == 1:
        return [RunPlace(output, None)]
    parent = output or into
    if parent is not None and (parent / RUN_FILE).is_file():
        raise OutputError(
            parent, "is a run itself", "fitting that run again would remove the runs in it: name another place"
        )
    folder = parent or RUNS
    return [RunPlace(folder / name, folder) for name in distinct_names(logs)]


def read_calibration(source: Path | None, *, force: bool = False, advice: str = "") -> tuple[str, Calibration]:
    """Return a calibration and its name: of a calibration file, or of a run, which is calibrated."""
    from icrtool.output.run_directory import newest_run, open_run

    if source is not None and source.is_file():
        from icrtool.output.files.formats import open_calibration

        return source.name, open_calibration(source)
    from icrtool.calibration.pooled import calibrate
    from icrtool.errors import DataError

    run = open_run(source or newest_run(RUNS))
    if not (run.usable or force):
        why = f"its ICRs are not usable: {run.document.unusable_because}"
        raise DataError(run.name, why, f"drive again, with turns to both sides{advice}")
    return run.name, calibrate(run, allow_unusable=force)
