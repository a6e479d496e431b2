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
from icrtool.cli.options import Span
from icrtool.cli.printing import Inputs, Printer, Stages
from icrtool.records.text import LogText, escaped

if TYPE_CHECKING:
    from icrtool.config import Config, ConfigSources
    from icrtool.errors import IcrToolError
    from icrtool.logs.describe import SurveyDocument
    from icrtool.logs.streams.assembly import Survey
    from icrtool.records.run import Run
    from icrtool.records.tables import RobotLog


@click.command("info")
@options.LOGS
@options.CUT
@options.CONFIGURATION
@options.printing(options.AS_JSON, options.QUIET, options.VERBOSE)
def command(logs: tuple[Path, ...], span: Span, settings: ConfigSources, printer: Printer) -> None:
    """List what each log holds, which topics are used for wheels, position and heading, and the problems found.

    The filter runs too, but nothing is written. The report names the ICRs that the drive shows and, where
    one is not shown, what to drive next.

    Exit status 1 when `icrtool fit` could not run on a log.
    """
    from icrtool.errors import IcrToolError

    config, given = settings.load(), options.given(settings, span)
    inputs = Inputs("log")
    for log in logs_of(logs, printer):
        with inputs.each(log) as document:
            found = Found(log)
            try:
                with printer.stages(LogText(log.name)) as stages:
                    _examine(found, config, span, stages)
            except IcrToolError as err:
                found.problem = err
            if printer.as_json:
                document.update(_document(found, given))
            elif printer.shows:
                _print(found, config, given, printer)
            # On a terminal the answer names the gravest one.
            if printer.verbose or printer.as_json or not sys.stderr.isatty():
                printer.warn(found.warnings)
            if found.problem is not None:
                raise found.problem
    printer.json("info", {"logs": inputs.documents})
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
    def holds(self) -> SurveyDocument | None:
        """Its files, topics and candidates; None of a table."""
        from icrtool.logs.describe import survey_document

        return survey_document(self.survey) if self.survey is not None else None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Those of the last step that was done."""
        found = self.run if self.run is not None else self.measured
        if found is not None:
            return found.warnings
        return self.survey.problems if self.survey is not None else ()


def _examine(found: Found, config: Config, part: Span, stages: Stages) -> None:
    """Read and fit a log: only the filter shows which ICRs the drive determines, and which sensors disagree.

    Raises
    ------
    IcrToolError
        The log cannot be fitted.
    """
    from icrtool.alignment.wheel_units import with_wheel_speeds
    from icrtool.logs.read_log import is_table, read_log, survey_log
    from icrtool.logs.streams.assembly import assemble

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


def _print(found: Found, config: Config, given: Sequence[str], printer: Printer) -> None:
    """Print whether a log can be fitted, what it holds, and the command to run next; with -v all that was found."""
    from icrtool.output.tables.overview import info_blocks, next_command

    command = next_command(escaped(str(found.log)), given, found.run)
    printer.show(info_blocks(found.holds, found.measured, found.run, found.problem, found.names, config, command))


def _document(found: Found, given: Sequence[str]) -> dict[str, Any]:
    """Return what a log holds as plain data; ``run`` as in run.json, null where the log cannot be fitted."""
    from icrtool.output.tables.overview import next_command, verdict
    from icrtool.records.plain_data import plain

    return {
        "reason": None,
        **(plain(found.holds) if found.holds is not None else {}),
        "streams": plain(found.measured.streams) if found.measured is not None else [],
        "warnings": list(found.warnings),
        "verdict": verdict(found.run, found.problem, found.names),
        "next": next_command(escaped(str(found.log)), given, found.run),
        "run": found.run.summary if found.run is not None else None,
    }
