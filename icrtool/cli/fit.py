"""``icrtool fit``."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from icrtool.cli import options
from icrtool.cli.inputs import logs_of, run_directories
from icrtool.cli.printing import Inputs, Stages, print_json, show, warn_of
from icrtool.records.text import LogText, escaped

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.records.run import FigureSet, Run, WarmStart


@click.command("fit")
@options.LOGS
@options.place
@click.option("--states", type=click.Choice(["csv", "parquet"]),
              help="Format of the states; default: csv, parquet for over a million states.")  # fmt: skip
@options.plots
@options.figures
@click.option("--warm-start", metavar="RUN|CAL.json", type=options.PLACE,
              help="Start from another run's final ICRs and covariance, or from those of a calibration.")  # fmt: skip
@click.option("--terrain-change", "changes", metavar="T", type=float, multiple=True,
              help="The ground changes after T seconds: inflate the ICR covariance there; repeatable.")  # fmt: skip
@click.option("--smooth", is_flag=True, help="Also write the RTS smoother's states (smoothed.csv).")
@options.as_json
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
    config = options.load(config_file, robot, sets)
    check_times(changes)
    logs = logs_of(logs, quiet=quiet)
    inputs = Inputs("log")
    for log, (directory, inside) in zip(logs, run_directories(logs, output, into), strict=True):
        with inputs.each(log) as document:
            run = fit_log(
                log, directory, config, inside=inside, quiet=quiet, verbose=verbose, overwrite=overwrite, plots=plots,
                figures=figures, states=states, span=(start, end), warm_start=warm_start, changes_s=changes,
                smooth=smooth,
            )  # fmt: skip
            place = escaped(str(directory))
            document |= {"directory": place, "run": run.summary}
            if not (quiet or as_json):
                given = options.given(config_file, robot, sets, start, end)
                _print(run, place, shlex.join(["icrtool", "info", escaped(str(log)), "-v", *given]), verbose=verbose)
    if as_json:
        print_json("fit", {"logs": inputs.documents})
    inputs.leave("logs")


def _print(run: Run, place: str, examine: str, *, verbose: bool) -> None:
    """Print the answer, with -v all that was found; `examine`: command that names what is wrong in the log."""
    from icrtool.output.tables.run import next_blocks, run_blocks
    from icrtool.output.text_blocks import printed

    show(printed([*run_blocks(run.document), *next_blocks(run.document, place, examine)], verbose=verbose))


def check_times(times: tuple[float, ...]) -> None:
    """Refuse times [s] of ``--terrain-change`` that are not finite."""
    if not all(math.isfinite(time) for time in times):
        raise click.BadParameter("give finite seconds", param_hint="--terrain-change")


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
    from icrtool.output.run_directory import open_run

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
    warn_of(run, *_other_robot(warm_start, start, config), *notes, quiet=quiet, verbose=verbose)
    if verbose:
        from icrtool.output.text_format import jump_lines

        for line in jump_lines(run.document.reference_jumps):
            click.echo(line, err=True)
    return run
