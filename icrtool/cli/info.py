"""``icrtool info``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from icrtool.cli import options
from icrtool.cli.inputs import logs_of
from icrtool.cli.printing import Inputs, Stages, print_json, show, warn
from icrtool.records.text import LogText, escaped

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.errors import IcrToolError
    from icrtool.logs.streams.assembly import Survey
    from icrtool.records.run import Run
    from icrtool.records.tables import RobotLog


@click.command("info")
@options.LOGS
@options.as_json
@options.cut
@options.configuration
@options.verbosity
def command(
    logs: tuple[Path, ...], as_json: bool, start: str | None, end: str | None,
    config_file: Path | None, robot: str | None, sets: tuple[str, ...], quiet: bool, verbose: bool,
) -> None:  # fmt: skip
    """List what each log holds, which topics are used for wheels, position and heading, and the problems found.

    The filter runs too, but nothing is written. The report names the ICRs that the drive shows and, where
    one is not shown, what to drive next.

    Exit status 1 when `icrtool fit` could not run on a log.
    """
    from icrtool.errors import IcrToolError

    config = options.load(config_file, robot, sets)
    given = options.given(config_file, robot, sets, start, end)
    inputs = Inputs("log")
    for log in logs_of(logs, quiet=quiet):
        with inputs.each(log) as document:
            found = Found(log)
            try:
                with Stages(LogText(log.name), quiet=quiet, verbose=verbose) as stages:
                    _examine(found, config, (start, end), stages)
            except IcrToolError as err:
                found.problem = err
            if as_json:
                document.update(_document(found, given))
            elif not quiet:
                _print(found, config, given, everything=verbose)
            # On a terminal the answer names the gravest one.
            if verbose or as_json or not sys.stderr.isatty():
                warn(found.warnings, quiet=quiet)
            if found.problem is not None:
                raise found.problem
    if as_json:
        print_json("info", {"logs": inputs.documents})
    inputs.leave("logs")


@dataclass(slots=True)
class Found:
    """What was found in a log, as far as reading and fitting it came."""

    log: Path
    survey: Survey | None = None
    measured: RobotLog | None = None
    run: Run | None = None
    problem: IcrToolError | None = None

    @property
    def names(self) -> tuple[str, str]:
        """What errors and warnings of the log begin with: its name, or its path."""
        return self.survey.name if self.survey is not None else LogText(self.log.stem), escaped(str(self.log))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Those of the last step that was done."""
        found = self.run if self.run is not None else self.measured
        if found is not None:
            return found.warnings
        return self.survey.problems if self.survey is not None else ()


def _examine(found: Found, config: Config, part: tuple[str | None, str | None], stages: Stages) -> None:
    """Read and fit a log: only the filter shows which ICRs the drive determines, and which sensors disagree.

    Raises
    ------
    IcrToolError
        The log cannot be fitted.
    """
    from icrtool.alignment.sensors.wheel_units import with_wheel_speeds
    from icrtool.logs.read_log import read_log, survey_log
    from icrtool.logs.streams.assembly import assemble
    from icrtool.logs.table_file import is_table

    start, end = part
    stages.begin("reading")
    if is_table(found.log):
        found.measured = read_log(found.log, config, start=start, end=end)
    else:
        found.survey = survey_log(found.log, config, stages.share, start=start, end=end)
        found.measured = assemble(found.survey, config)
    found.measured = with_wheel_speeds(found.measured, config)
    from icrtool.calibration.fit import fit

    found.run = fit(found.measured, config, watch=stages.begin)


def _print(found: Found, config: Config, given: Sequence[str], *, everything: bool) -> None:
    """Print whether a log can be fitted, what it holds, and the command to run next; with -v all that was found."""
    from icrtool.logs.describe import describe_log, describe_survey
    from icrtool.output.tables.overview import info_blocks, next_command
    from icrtool.output.text_blocks import printed

    command = next_command(escaped(str(found.log)), given, found.run)
    if everything and found.survey is not None:
        click.echo(f"{describe_survey(found.survey, found.measured)}\n")
    elif everything and found.measured is not None:
        click.echo(f"{describe_log(found.measured)}\n")
    blocks = info_blocks(found.survey, found.measured, found.run, found.problem, found.names, config, command)
    show(printed(blocks, verbose=everything))


def _document(found: Found, given: Sequence[str]) -> dict[str, Any]:
    """Return what a log holds as plain data; ``run`` as in run.json, null where the log cannot be fitted."""
    from icrtool.logs.describe import streams_document, survey_document
    from icrtool.output.tables.overview import next_command, verdict

    return {
        "reason": None,
        **(survey_document(found.survey) if found.survey is not None else {}),
        "streams": streams_document(found.measured) if found.measured is not None else [],
        "warnings": list(found.warnings),
        "verdict": verdict(found.run, found.problem, found.names),
        "next": next_command(escaped(str(found.log)), given, found.run),
        "run": found.run.summary if found.run is not None else None,
    }
