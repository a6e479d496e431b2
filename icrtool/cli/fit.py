"""``icrtool fit``, which writes a run, and ``icrtool info``, which prints the content and the problems of a log."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from icrtool.cli import lazy_imports, options
from icrtool.cli.inputs import ResultPlace, logs_of, run_directories
from icrtool.cli.options import PLACE, choice, flag, option
from icrtool.cli.printing import Inputs, Printer, print_error
from icrtool.records.choices import StatesFormat
from icrtool.records.places import Place, UrlPath, path_of
from icrtool.records.text import LogText, escaped

with lazy_imports():
    from icrtool import errors, pipeline
    from icrtool.alignment import wheel_units
    from icrtool.logs import read_log, topic_poses
    from icrtool.logs.streams import assembly
    from icrtool.output import run_directory, text_format
    from icrtool.output.tables import overview
    from icrtool.output.tables import run as run_tables
    from icrtool.records import notes, plain_data

if TYPE_CHECKING:
    from icrtool.config import Config, ConfigSources
    from icrtool.records.requests import FitRequest, ResultFiles
    from icrtool.records.run import Run

MOST_WARNINGS = 2
"""Number of warnings that `icrtool fit` prints below its results; -v prints all."""

REQUEST = options.options_as_record("request", f"{options.REQUESTS_MODULE}:FitRequest", options.options_as_record(
    "files",
    f"{options.REQUESTS_MODULE}:ResultFiles",
    options.PLACES,
    choice("--states", get_args(StatesFormat), "Format of the states; default: csv, but parquet for more than a "
           "million states."),
    options.PLOTS_OPTION,
    options.FIGURES_OPTION,
    option("--warm-start", "RUN|CAL.json", PLACE, "Start from the final ICRs and covariance of another run, or from a "
           "calibration."),
    option("--terrain-change changes_s", "T", lambda text: options.numbers_reader("T, finite seconds", 1)(text)[0],
           "The ground changes T seconds after the first state: inflate the ICR covariance there; repeatable.",
           multiple=True),
    flag("--smooth", "Also write the RTS smoother's states (smoothed.csv)."),
    options.CUT,
))  # fmt: skip
"""Options of a fit, as `request`, `files`, `place` and `warm_start`."""


@options.command("fit")
@options.LOGS
@REQUEST
@flag("--strict", "Exit with status 3 where a run must not be used.")
@options.CONFIGURATION
@options.INPUT_LIMITS
@options.printer_options(options.AS_JSON, options.QUIET, options.VERBOSE_OPTION)
def fit_command(
    logs: tuple[Path, ...], place: ResultPlace, warm_start: Path | None, request: FitRequest, files: ResultFiles,
    strict: bool, settings: ConfigSources, printer: Printer,
) -> None:  # fmt: skip
    """Learn the track ICRs of a robot from its logs, and write a run directory per log.

    Without options, topics are found by type and content. --robot, or --set robot.track_width_m=… and
    robot.wheel_radius_m=…, gives the numbers of the robot, which the messages do not hold.

    \b
    Example:
      icrtool fit field.mcap --robot husky-a200
      icrtool fit log.bag --set topics.gnss=/rtk/fix -o runs/today
    """  # noqa: D301 - click reads the escape
    config = settings.load()
    logs = logs_of(logs, printer)
    inputs, all_usable = Inputs("log"), True
    for log, run_place in zip(logs, run_directories(logs, place), strict=True):
        with inputs.document_of(log) as document:
            with fitted_log(log, run_place, config, request, files, printer, warm_start, warns=False) as (run, _):
                all_usable = all_usable and run.usable
            if strict and not (run.usable or printer.shows):
                print_error(f"{run.name}: do not use this run: {run.document.unusable_because}")
            where = escaped(str(path_of(run_place)))
            document |= {"directory": where, "run": run.summary}
            # For an unusable run, this is the next command: it reports the problems of the log.
            examine = shlex.join(
                ["icrtool", "info", escaped(str(log)), "-v", *options.options_to_repeat(settings, request)]
            )
            printer.show([*run_tables.run_blocks(run.document), *run_tables.next_blocks(run.document, where, examine)])
            printer.warn_about(run, most=MOST_WARNINGS)
    printer.json("fit", {"logs": inputs.documents})
    inputs.exit_if_failed("logs", limit_not_met=strict and not all_usable)


@contextmanager
def fitted_log(
    log: Path, place: Place, config: Config, request: FitRequest, files: ResultFiles, printer: Printer,
    warm_start: Path | None = None, *, warns: bool = True,
) -> Iterator[tuple[Run, Path]]:  # fmt: skip
    """Fit a log, and yield the run and its directory on disk; with `warns`, print warnings and streams afterwards.

    Files that the block writes into the directory belong to the run. A run that was made with other settings is
    replaced only if `files.overwrite` is set.
    """
    if not (files.overwrite or isinstance(path_of(place), UrlPath)):
        run_directory.check_target(place, log)
        run_directory.check_settings(path_of(place), config, request)
    reported: list[str] = []
    with (
        printer.stages(LogText(log.name)) as stages,
        pipeline.fit_into(
            place,
            log,
            config,
            request,
            files,
            stages.begin,
            warm_start=warm_start,
            share=stages.share,
            note=reported.append,
        ) as run_and_directory,  # fmt: skip
    ):
        yield run_and_directory
    if warns:
        printer.warn_about(run_and_directory[0])
    printer.warn(reported)
    for line in text_format.jump_lines(run_and_directory[0].document.reference_jumps):
        printer.detail(line)


@click.command("info")
@options.LOGS
@options.options_as_record("request", f"{options.REQUESTS_MODULE}:FitRequest", options.CUT)
@options.CONFIGURATION
@options.INPUT_LIMITS
@options.printer_options(options.AS_JSON, options.QUIET, options.VERBOSE_OPTION)
def info_command(logs: tuple[Path, ...], request: FitRequest, settings: ConfigSources, printer: Printer) -> None:
    """List the content of each log, the topics that are used for wheels, position and heading, and the problems found.

    The filter runs too, but no file is written. The output names the ICRs that the drive shows and, if an ICR is not
    shown, what to drive next.

    Exit status: 1 if `icrtool fit` could not run on a log.
    """
    config, options_given = settings.load(), options.options_to_repeat(settings, request)
    inputs = Inputs("log")
    for log in logs_of(logs, printer):
        with inputs.document_of(log) as document:
            _examine(log, config, request, options_given, document, printer)
    printer.json("info", {"logs": inputs.documents})
    inputs.exit_if_failed("logs")


def _examine(
    log: Path, config: Config, request: FitRequest, options_given: list[str], document: dict[str, Any], printer: Printer
) -> None:
    """Read and fit a log; print whether it can be fitted, its content, and the command to run next.

    The filter runs, because only its result shows which ICRs the drive determines and which sensors disagree.

    Parameters
    ----------
    options_given : options of this call that the next command needs too
    document : gets the content as plain data for --json; ``run`` is as in run.json, null if the log cannot be fitted

    Raises
    ------
    IcrToolError
        The log cannot be fitted; the findings before the error are printed.
    """
    survey = measured = run = problem = None
    try:
        with printer.stages(LogText(log.name)) as stages:
            stages.begin("reading")
            if read_log.is_table(log):
                measured = read_log.read_log(log, config, start=request.start, end=request.end)
            else:
                survey = read_log.survey_log(log, config, stages.share, start=request.start, end=request.end)
                measured = assembly.assemble(survey, config)
            measured = wheel_units.with_wheel_speeds(measured, config)
            run = pipeline.fit_log(measured, config, request, watch=stages.begin)
    except errors.IcrToolError as err:
        problem = err
    holds = read_log.survey_document(survey) if survey is not None else None
    # Errors and warnings about the log begin with its name or its path.
    names = (survey.name if survey is not None else LogText(log.stem), escaped(str(log)))
    command = overview.next_command(escaped(str(log)), options_given, run)
    used = [stream.topic for stream in measured.streams if stream.role == "gnss"] if measured is not None else []
    scorable = topic_poses.scorable_topics(holds, used) if holds is not None else ()
    findings = survey.problems if survey is not None else ()
    if measured is not None:
        findings = measured.notes if run is None else run.notes
    warnings = notes.warnings_of(findings)
    if printer.as_json:
        document.update(
            {
                "reason": None,
                **(plain_data.plain_value(holds) if holds is not None else {}),
                "streams": plain_data.plain_value(measured.streams) if measured is not None else [],
                "notes": plain_data.plain_value(findings),
                "warnings": list(warnings),
                "verdict": overview.verdict(run, problem, names),
                "next": command,
                "scorable": list(scorable),
                "run": run.summary if run is not None else None,
            }
        )
    elif printer.shows:
        printer.show(overview.info_blocks(holds, measured, run, problem, names, config, command, scorable))
    # On a terminal the result names the gravest warning, so warnings are printed only with -v or --json.
    if printer.verbose or printer.as_json or not sys.stderr.isatty():
        printer.warn(warnings)
    if problem is not None:
        raise problem
