"""``icrtool fit``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import click

from icrtool.cli import options
from icrtool.records.text import LogText, escaped

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.output.figures.drawing_process import DrawingProcess
    from icrtool.records.run import WarmStart

RUNS = Path("icrtool-runs")


class FitRequest(NamedTuple):
    """What the options ask for, the same for every log."""

    config: Config
    states: Literal["csv", "parquet"]
    formats: tuple[str, ...]
    warm_start: Path | None
    changes_s: tuple[float, ...]
    smooths: bool
    quiet: bool
    verbose: bool
    start: str | None = None
    end: str | None = None


@click.command("fit")
@options.LOGS
@click.option(
    "-o", "--output", metavar="DIR", type=click.Path(path_type=Path), help="Run directory (several logs: its parent)."
)
@click.option(
    "--states", type=click.Choice(["csv", "parquet"]), default="csv", show_default=True, help="Format of the states."
)
@click.option("--plots", default="png", show_default=True, metavar="png,svg,pdf|none", help="Formats of the pictures.")
@click.option(
    "--warm-start",
    metavar="RUN|CAL.json",
    type=click.Path(path_type=Path),
    help="Start from another run's final ICRs and covariance, or from those of a calibration.",
)
@click.option(
    "--terrain-change",
    "changes",
    metavar="T",
    type=float,
    multiple=True,
    help="Inflate the ICR covariance T seconds after the start. Repeatable.",
)
@click.option("--smooth", "smooths", is_flag=True, help="Also write the RTS smoother's states (smoothed.csv).")
@options.cut
@options.configuration
@options.verbosity
def command(
    logs: tuple[Path, ...], output: Path | None, states: str, plots: str,
    warm_start: Path | None, changes: tuple[float, ...], smooths: bool, start: str | None, end: str | None,
    config_file: Path | None, robot: str | None, sets: tuple[str, ...], quiet: bool, verbose: bool,
) -> None:  # fmt: skip
    """Learn the track ICRs of a robot from its logs, and write a run directory per log.

    Without options the topics are found by type and content. --robot or --set robot.track_width_m=… and
    robot.wheel_radius_m=… give what the messages do not.

    \b
    Example:
      icrtool fit field.mcap --robot husky-a200
      icrtool fit log.bag --set topics.gnss=/rtk/fix -o runs/today
    """  # noqa: D301 - click reads the escape
    from icrtool.errors import IcrToolError

    config = options.load(config_file, robot, sets)
    request = FitRequest(
        config, "parquet" if states == "parquet" else "csv", plot_formats(plots), warm_start,
        check_times(changes), smooths, quiet, verbose, start, end,
    )  # fmt: skip
    directories = run_directories(logs, output)
    failed: list[IcrToolError] = []
    with options.drawing_process(request.formats) as drawer:
        for log, directory in zip(logs, directories, strict=True):
            try:
                _fit_one(log, directory, request, drawer)
            except IcrToolError as err:
                if len(logs) == 1:
                    raise
                failed.append(err)
                click.echo(f"Error: {err}", err=True)
    if failed:
        raise options.not_all_used(len(failed), len(logs), "logs")


def check_times(times: tuple[float, ...]) -> tuple[float, ...]:
    """Return the times [s] of ``--terrain-change``, all finite."""
    if not all(math.isfinite(time) for time in times):
        raise click.BadParameter("give finite seconds", param_hint="--terrain-change")
    return times


def plot_formats(text: str) -> tuple[str, ...]:
    """Return the picture formats of ``--plots``."""
    formats = tuple(part.strip().lower() for part in text.split(",") if part.strip())
    if formats == ("none",):
        return ()
    unknown = [part for part in formats if part not in ("png", "svg", "pdf")]
    if unknown or not formats:
        raise click.BadParameter(
            f"{', '.join(unknown) or text!r} is not one of png, svg, pdf, none", param_hint="--plots"
        )
    return formats


def run_directories(logs: tuple[Path, ...], output: Path | None) -> list[Path]:
    """Return where each log's run goes: ``icrtool-runs/NAME``, DIR, or ``DIR/NAME`` for several."""
    from icrtool.errors import OutputError
    from icrtool.logs.read_log import log_name
    from icrtool.output.run_directory import RUN_FILE

    names = [log_name(log) for log in logs]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise OutputError(
            twice,
            "two logs have this name, their runs would be one directory",
            "fit them one at a time, each with its -o",
        )
    if output is not None and len(logs) == 1:
        return [output]
    if output is not None and (output / RUN_FILE).is_file():
        raise OutputError(output, "is a run itself", "runs in it would go when it is fitted again: name another place")
    return [(output or RUNS) / name for name in names]


def _other_robot(request: FitRequest, start: WarmStart | None) -> tuple[str, ...]:
    """Warn where the run to start from was made with another track width."""
    theirs, ours = start.track_width_m if start is not None else None, request.config.robot.track_width_m
    if theirs is None or ours is None or math.isclose(theirs, ours, rel_tol=0.01):
        return ()
    return (
        f"{request.warm_start}: made with a track width of {theirs:g} m, not {ours:g} m: are its ICRs this robot's?",
    )


def _beside(request: FitRequest) -> str:
    """Return a text about further options that had an effect."""
    done = [f"started from {request.warm_start}"] if request.warm_start is not None else []
    done += ["with the smoother's states"] if request.smooths else []
    return f" ({', '.join(done)})" if done else ""


def _warm_start(source: Path) -> WarmStart:
    """Return the ICRs that a run ended with, or those of a calibration file."""
    if source.is_file():
        from icrtool.output.calibration_file import open_calibration

        return open_calibration(source).warm_start()
    from icrtool.output.stored_run import open_run

    return open_run(source).ended_with


def _fit_one(log: Path, directory: Path, request: FitRequest, drawer: DrawingProcess) -> None:
    from icrtool.output.run_directory import check_target, log_of_run, write_run

    check_target(directory)
    before = log_of_run(directory)
    start = _warm_start(request.warm_start) if request.warm_start is not None else None
    with options.progress_bar(f"reading {LogText(log.name)}", quiet=request.quiet) as progress:
        from icrtool.logs import read_log

        options.load_ahead("pymap3d", "icrtool.calibration.fit")
        measured = read_log(log, request.config, progress, start=request.start, end=request.end)
    from icrtool.calibration.fit import fit

    run = fit(
        measured,
        request.config,
        warm_start=start,
        changes_s=request.changes_s,
        smooth=request.smooths,
    )
    notes: list[str] = []
    write_run(run, directory, states=request.states, drawer=drawer, note=notes.append)
    replaced = before is not None and before != run.summary["inputs"][0]["path"]
    note = (f"{directory}: the run of another log was there, {before}: replaced, with its report",) if replaced else ()
    options.warn((*run.warnings, *_other_robot(request, start), *note, *notes), quiet=request.quiet)
    if not request.quiet:
        from icrtool.output.tables.run import format_run

        click.echo(format_run(run))
        click.echo(f"\nwritten to {escaped(str(directory))}{_beside(request)}")
    for stream in measured.streams:
        if request.verbose or ("chosen over" in stream.why and not request.quiet):
            click.echo(f"{stream.role}: {stream.topic}: {stream.why}", err=True)
