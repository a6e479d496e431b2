"""``icrtool info``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import options
from icrtool.records.text import LogText

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.records.run import Run
    from icrtool.records.tables import RobotLog


@click.command("info")
@options.LOGS
@options.cut
@options.configuration
@options.verbosity
def command(
    logs: tuple[Path, ...],
    start: str | None,
    end: str | None,
    config_file: Path | None,
    robot: str | None,
    sets: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> None:
    """List what each log holds, which topics are used for wheels, position and heading, and the problems found.

    The filter runs as well, and nothing is written: the report includes which ICRs the drive determines, and what to
    drive next where one of them is not determined.

    Exit status 1 when `icrtool fit` could not run on a log.
    """
    from icrtool.errors import IcrToolError

    config = options.load(config_file, robot, sets)
    failed = 0
    for log in logs:
        try:
            usable = _describe(log, config, (start, end), quiet=quiet, verbose=verbose)
        except IcrToolError as err:
            click.echo(f"Error: {err}", err=True)
            usable = False
        failed += not usable
    if failed:
        raise SystemExit(1)


def _describe(log: Path, config: Config, part: tuple[str | None, str | None], *, quiet: bool, verbose: bool) -> bool:
    """Print what a log holds; return whether it can be fitted."""
    from icrtool.alignment.wheel_units import with_wheel_speeds
    from icrtool.errors import IcrToolError
    from icrtool.logs import assemble, read_log, survey_log
    from icrtool.logs.describe import describe_log, describe_survey
    from icrtool.logs.table_file import is_table

    start, end = part
    survey, measured, run, problem = None, None, None, ""
    if not is_table(log):
        with options.progress_bar(f"reading {LogText(log.name)}", quiet=quiet) as progress:
            survey = survey_log(log, config, progress, start=start, end=end)
    try:
        measured = assemble(survey, config) if survey is not None else read_log(log, config, start=start, end=end)
        measured = with_wheel_speeds(measured, config)
        run = _try(measured, config)
    except IcrToolError as err:
        problem = str(err)
    if not quiet:
        if survey is not None:
            click.echo(describe_survey(survey, measured, everything=verbose))
        elif measured is not None:
            click.echo(describe_log(measured))
        if run is not None:
            from icrtool.output.tables.run import excitation_lines

            click.echo("\n".join(excitation_lines(run)))
    found = run if run is not None else measured
    options.warn(
        list(found.warnings) if found is not None else list(survey.problems if survey is not None else ()), quiet=quiet
    )
    if problem:
        click.echo(f"Error: {problem}", err=True)
    return run is not None


def _try(measured: RobotLog, config: Config) -> Run:
    """Fit the log: only the filter shows which ICRs the drive determines, and which sensors disagree."""
    from icrtool.estimation.fit import fit

    return fit(measured, config)
