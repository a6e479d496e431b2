"""``icrtool info``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import options

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.records.run import Run
    from icrtool.records.tables import RobotLog


@click.command("info")
@options.LOGS
@options.configuration
@options.verbosity
def command(
    logs: tuple[Path, ...],
    config_file: Path | None,
    robot: str | None,
    sets: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> None:
    """Say what each log holds, which topic would feed wheels, position and heading, and why; and what is wrong with it.

    The filter is run as well, nothing is written: which ICRs the drive could show is said, and what to drive next.

    Exit status 1 when `icrtool fit` could not run on a log.
    """
    from icrtool.errors import IcrToolError

    config = options.load(config_file, robot, sets)
    failed = 0
    for log in logs:
        try:
            usable = _describe(log, config, quiet=quiet, verbose=verbose)
        except IcrToolError as err:
            click.echo(f"Error: {err}", err=True)
            usable = False
        failed += not usable
    if failed:
        raise SystemExit(1)


def _describe(log: Path, config: Config, *, quiet: bool, verbose: bool) -> bool:
    """Print what a log holds; say whether it can be fitted."""
    from icrtool.errors import IcrToolError
    from icrtool.logs import assemble, survey_log
    from icrtool.logs.describe import describe_survey

    with options.progress_bar(f"reading {log.name}", quiet=quiet) as progress:
        survey = survey_log(log, config, progress)
    measured, run, problem = None, None, ""
    try:
        measured = assemble(survey, config)
        run = _try(measured, config)
    except IcrToolError as err:
        problem = str(err)
    if not quiet:
        click.echo(describe_survey(survey, measured, everything=verbose))
        if run is not None:
            from icrtool.output.tables.run import excitation_lines

            click.echo("\n".join(excitation_lines(run)))
    found = run if run is not None else measured
    options.warn(list(found.warnings) if found is not None else list(survey.problems), quiet=quiet)
    if problem:
        click.echo(f"Error: {problem}", err=True)
    return run is not None


def _try(measured: RobotLog, config: Config) -> Run:
    """Fit the log: what the drive could show, and what contradicts what, only the filter tells."""
    from icrtool.estimation.fit import fit

    return fit(measured, config)
