"""``icrtool fit``."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import click

from icrtool.cli import options
from icrtool.cli.json_output import json_option, print_json
from icrtool.cli.stages import Stages
from icrtool.cli.terminal import show
from icrtool.records.text import LogText, escaped
from icrtool.records.urls import UrlPath

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.records.run import FigureSet, Run, WarmStart

RUNS = Path("icrtool-runs")


@click.command("fit")
@options.LOGS
@options.place
@click.option("--states", type=click.Choice(["csv", "parquet"]),
              help="Format of the states; default: csv, parquet for over a million states.")  # fmt: skip
@options.plots
@options.figures
@click.option("--warm-start", metavar="RUN|CAL.json", type=options.FILE,
              help="Start from another run's final ICRs and covariance, or from those of a calibration.")  # fmt: skip
@click.option("--terrain-change", "changes", metavar="T", type=float, multiple=True,
              help="The ground changes after T seconds: inflate the ICR covariance there; repeatable.")  # fmt: skip
@click.option("--smooth", is_flag=True, help="Also write the RTS smoother's states (smoothed.csv).")
@json_option
@options.cut
@options.configuration
@options.verbosity
def command(
    logs: tuple[Path, ...], output: Path | None, into: Path | None, overwrite: bool,
    states: Literal["csv", "parquet"] | None, plots: tuple[str, ...], figures: FigureSet,
    warm_start: Path | None, changes: tuple[float, ...], smooth: bool, as_json: bool,
    start: str | None, end: str | None,
    config_file: Path | None, robot: str | None, sets: tuple[str, ...], quiet: bool, verbose: bool,
) -> None:  # fmt: skip
    """Learn the track ICRs of a robot from its logs, and write a run directory per log.

    Without options the topics are found by type and content. --robot or --set robot.track_width_m=… and
    robot.wheel_radius_m=… give what the messages do not hold.

    \b
    Example:
      icrtool fit field.mcap --robot husky-a200
      icrtool fit log.bag --set topics.gnss=/rtk/fix -o runs/today
    """  # noqa: D301 - click reads the escape
    from icrtool.errors import IcrToolError

    config = options.load(config_file, robot, sets)
    check_times(changes)
    logs = logs_of(logs, quiet=quiet)
    directories = run_directories(logs, output, into)
    documents: list[dict[str, Any]] = []
    failed: list[Path] = []
    for log, (directory, inside) in zip(logs, directories, strict=True):
        try:
            run = fit_log(
                log, directory, config, inside=inside, quiet=quiet, verbose=verbose, overwrite=overwrite, plots=plots,
                figures=figures, states=states, span=(start, end), warm_start=warm_start, changes_s=changes,
                smooth=smooth,
            )  # fmt: skip
        except IcrToolError as err:
            failed.append(log)
            options.report_error(err, log)
            documents.append({"log": escaped(str(log)), "status": "failed", "reason": str(err)})
            continue
        place = escaped(str(directory))
        documents.append({"log": escaped(str(log)), "status": "done", "directory": place, "run": run.summary})
        if not (quiet or as_json):
            again = ["icrtool", "info", escaped(str(log)), "-v", *options.given(config_file, robot, sets, start, end)]
            _print(run, place, shlex.join(again), verbose=verbose)
    if as_json:
        print_json("fit", {"logs": documents})
    options.leave(failed, len(logs), "logs")


def _print(run: Run, place: str, examine: str, *, verbose: bool) -> None:
    """Print the answer, with -v all that was found; `examine`: command that names what is wrong in the log."""
    from icrtool.output.tables.run import next_blocks, run_blocks
    from icrtool.output.text_blocks import printed

    show(printed([*run_blocks(run.document), *next_blocks(run.document, place, examine)], verbose=verbose))


def check_times(times: tuple[float, ...]) -> None:
    """Refuse times [s] of ``--terrain-change`` that are not finite."""
    if not all(math.isfinite(time) for time in times):
        raise click.BadParameter("give finite seconds", param_hint="--terrain-change")


def logs_of(places: tuple[Path, ...], *, quiet: bool) -> tuple[Path, ...]:
    """Return the logs among the arguments of a command, those in folders too, and warn of files that are none."""
    from icrtool.fleet.recordings import logs_among

    logs, beside = logs_among(places)
    options.warn([f"{escaped(str(file))}: not a log: left out" for file in beside], quiet=quiet)
    return tuple(logs)


def check_run_config(config: Config, *, free: str = "") -> None:
    """Refuse settings for a finished run, but those of the section that a report on it is free to change."""
    from icrtool.errors import ConfigError

    if given := sorted(config.given_sections - {free}):
        advice = "fit the log again with it, or name the log in place of its run"
        raise ConfigError(f"[{given[0]}]", "a finished run keeps the configuration it was made with", advice)


class RunPlace(NamedTuple):
    """Where the run of a log goes; `inside` is the folder of the runs, below which no link is followed."""

    directory: Path
    inside: Path | None


def run_directories(logs: tuple[Path, ...], output: Path | None, into: Path | None) -> list[RunPlace]:
    """Return where each log's run goes: ``icrtool-runs/NAME``, DIR of `output`, or ``DIR/NAME`` for several or `into`.

    Logs of one name are distinguished by what their paths differ in.
    """
    from icrtool.errors import OutputError
    from icrtool.fleet.recordings import distinct_names
    from icrtool.output.run_directory import RUN_FILE

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


def _other_robot(source: Path | None, start: WarmStart | None, config: Config) -> tuple[str, ...]:
    """Warn where the run to start from was made with another track width."""
    theirs, ours = start.track_width_m if start is not None else None, config.robot.track_width_m
    if theirs is None or ours is None or math.isclose(theirs, ours, rel_tol=0.01):
        return ()
    return (f"{source}: made with a track width of {theirs:g} m, not {ours:g} m: are its ICRs this robot's?",)


def _warm_start(source: Path) -> WarmStart:
    """Return the ICRs that a run ended with, or those of a calibration file."""
    if source.is_file():
        from icrtool.output.files.documents import open_calibration

        return open_calibration(source).warm_start()
    from icrtool.output.stored_run import open_run

    return open_run(source).ended_with


def fit_log(
    log: Path, directory: Path, config: Config, *, quiet: bool, verbose: bool, warm_start: Path | None = None,
    **options_of_fit: Any,
) -> Run:  # fmt: skip
    """Fit a log, write its run directory, and print warnings and chosen streams on stderr.

    Parameters
    ----------
    warm_start : run or calibration to start from
    options_of_fit : of `icrtool.fleet.one_log.fit_and_write`
    """
    from icrtool.fleet.one_log import fit_and_write

    start = _warm_start(warm_start) if warm_start is not None else None
    notes: list[str] = []
    with Stages(LogText(log.name), quiet=quiet, verbose=verbose) as stages:
        run = fit_and_write(
            log, directory, config, stages.begin, warm_start=start, share=stages.share, note=notes.append,
            **options_of_fit,
        )  # fmt: skip
    # On a terminal the answer names the gravest one.
    everything = verbose or not sys.stderr.isatty()
    options.warn((*(run.warnings if everything else ()), *_other_robot(warm_start, start, config), *notes), quiet=quiet)
    if verbose:
        from icrtool.output.text_format import jump_lines, topics_text
        from icrtool.records.samples import ROLE_WORDS

        for stream in run.document.streams:
            click.echo(f"{ROLE_WORDS[stream.role]}: {topics_text(stream.topic)}: {stream.why}", err=True)
        for line in jump_lines(run.document.reference_jumps):
            click.echo(line, err=True)
    return run


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


def runs_of(paths: Sequence[Path], config: Config, *, quiet: bool, verbose: bool = False) -> list[Run]:
    """Read runs, and fit logs without a recommendation; nothing is written."""
    found = []
    with options.progress_bar("reading", quiet=quiet) as progress:
        for path in paths:
            if verbose:
                click.echo(str(path), err=True)
            found.append(_run_of(path, config))
            if progress is not None:
                progress(len(found) / len(paths))
    return found


def _run_of(path: Path, config: Config) -> Run:
    from icrtool.output.run_directory import is_run_directory

    if is_run_directory(path):
        from icrtool.output.stored_run import open_run

        return open_run(path)
    from icrtool.estimation.fit import fit
    from icrtool.logs.read_log import read_log

    return fit(read_log(path, config), config)
