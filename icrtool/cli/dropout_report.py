"""``icrtool dropout-report``, which computes the open-loop errors of a run."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, get_args

import click

from icrtool.cli import lazy_imports, options
from icrtool.cli.fit import fitted_log
from icrtool.cli.inputs import RUNS_FOLDER, ResultPlace, check_run_config, logs_of, run_directories
from icrtool.cli.options import POSITIVE, Exports, choice, flag, option
from icrtool.cli.printing import Inputs, Printer
from icrtool.records.choices import Reference, Starts
from icrtool.records.places import Place, UrlPath, path_of
from icrtool.records.text import LogText, escaped

with lazy_imports():
    from icrtool import errors, pipeline
    from icrtool.dropout_analysis import dropout_report
    from icrtool.logs.containers import recording_files
    from icrtool.output import run_directory, text_blocks
    from icrtool.output.exports import acceptance
    from icrtool.output.files import remote_place
    from icrtool.output.tables import dropout

if TYPE_CHECKING:
    from icrtool.calibration.record import Calibration
    from icrtool.config import Config, ConfigSources
    from icrtool.dropout_analysis.report import DropoutReport
    from icrtool.output.dropout_directory import Baseline
    from icrtool.records.requests import ReportRequest, ResultFiles

EPILOG_GATE = (
    'A limit of --gate reads "MODEL.p50|p95|expected|max@HORIZONm <= METRES", for example "recommended.p95@10m <= 1.2"'
    ', or "MODEL.within@ERRORm >= METRES", for example "recommended.within@0.5m >= 10".'
)
"""Text below the help of the command."""


def read_horizons(text: str) -> tuple[float, ...]:
    """Return the distances [m] in the value of ``--horizons``; refuse a distance that is not above zero."""
    horizons_m = options.numbers_reader("M,M,...")(text)
    if min(horizons_m) <= 0:
        raise click.BadParameter(f"{text!r} has a distance that is not above zero")
    return horizons_m


REPORT_OPTIONS = options.report_options(
    options.PLACES,
    option("--horizons horizons_m", "M,M,...", read_horizons, "Distances without GNSS [m]; default: from the "
           "configuration."),
    option("--score", "TOPIC", None, "Also compare the poses of a topic of the LOG with the reference, for example "
           "/odometry/filtered; the LOG is read again; repeatable.", multiple=True),
    option("--outage outage_s", "SECONDS", POSITIVE, "Force GNSS outages of this length, and report the error at their "
           "end; repeatable.", multiple=True),
    option("--outage-at outage_at_s", "SECONDS", float, "Start of a forced outage, in seconds since the first "
           "state; default: evenly spaced; repeatable.", multiple=True),
    choice("--reference", get_args(Reference), "Compare trials with the states of the filter, or of the smoother "
           "(fit --smooth).", default="filter"),
    flag("--without-events", "Leave out trials that cross a slip event; report how much they change the errors."),
    flag("--with-jumps", "Also count trials that cross a jump of the reference."),
    choice("--starts", get_args(Starts), "moving: each standstill is one start; all: every recorded state is a start.",
           default="moving"),
    flag("--trials", "Write every trial to trials.parquet."),
    option("--seed", None, click.IntRange(min=0), "Seed of the random draws."),
)  # fmt: skip
"""Options of a report, as `place`, `calibrations`, `report`, `files`, `baseline` and `exports`."""


@options.command("dropout-report", epilog=EPILOG_GATE)
@click.argument("sources", metavar="[RUN|LOG]...", nargs=-1, type=options.LOG)
@REPORT_OPTIONS
@options.CONFIGURATION
@options.INPUT_LIMITS
@options.printer_options(options.AS_JSON, options.QUIET, options.VERBOSE_OPTION)
def dropout_report_command(
    sources: tuple[Path, ...], place: ResultPlace, calibrations: tuple[Path, ...], report: ReportRequest,
    files: ResultFiles, baseline: Path | None, exports: Exports, settings: ConfigSources, printer: Printer,
) -> None:  # fmt: skip
    """Report the position errors of a robot without GNSS: open loop from every recorded state, over 1 to 20 m.

    RUN is a directory that `icrtool fit` wrote, or its address; a LOG is fitted first. Without an argument, the newest
    run below icrtool-runs/ is used. The report is written to dropout/ in the run directory.

    \b
    Example:
      icrtool dropout-report
      icrtool dropout-report icrtool-runs/field --budget 0.5 --outage 20
      icrtool dropout-report icrtool-runs/field --calibration season.json --gate "calibration.p95@10m <= 0.6"
      icrtool dropout-report log.bag --robot jackal --gate "recommended.p95@10m <= 1.5" --junit gates.xml
    """  # noqa: D301 - click reads the escape
    opened_calibrations = options.calibrations_of(calibrations, report)
    config = settings.load()
    compared = options.baseline_of(baseline, report.gates)
    report = report.configured(config)
    other_results = OtherResults(opened_calibrations, compared)
    sources, places = plan_sources(sources, place, config, printer)
    if report.score and (runs := [source for source in sources if source not in places]):
        why = f"{escaped(str(runs[0]))} is a run, which holds no poses of other topics"
        raise errors.ConfigError("--score", why, "name its LOG in place of the run")
    if report.score and recording_files.STANDARD_INPUT in sources:
        raise errors.ConfigError("--score", "the log is read twice, and standard input can be read once", "name a file")
    if compared is not None and len(places) == len(sources) and any(map(options.names_baseline, report.gates)):
        robot = config.robot.name or ""
        compared.check_compares((recording_files.log_name(log), content_of(log), robot, "") for log in sources)
    inputs = Inputs("source")
    reports: dict[str, DropoutReport] = {}
    for number, source in enumerate(sources):
        if number:
            printer.text("")
        with inputs.document_of(source) as document:
            result = report_one(source, places.get(source), config, report, files, other_results, printer)
            reports[str(source)] = result
            if printer.as_json:
                document["report"] = result.document
    printer.json("dropout-report", {"reports": inputs.documents})
    outcomes = [(str(source), (inputs.errors | reports)[str(source)]) for source in sources]
    exports.write(
        "dropout-report",
        lambda: [acceptance.suite_of(*outcome) for outcome in outcomes],
        lambda: acceptance.format_outcomes(outcomes),
    )
    verdicts = [verdict for result in reports.values() for verdict in result.document.gates]
    options.check_compared(verdicts)
    inputs.exit_if_failed("runs and logs", limit_not_met=not all(verdict.passed for verdict in verdicts))


def plan_sources(
    sources: tuple[Path, ...], place: ResultPlace, config: Config, printer: Printer
) -> tuple[tuple[Path, ...], dict[Path, Place]]:
    """Return the sources, and the run directory of each source that is a log.

    If the user names no source, the newest run is the source. A request that can be refused before a log is read is
    refused here: a finished run keeps its configuration and its place.

    Raises
    ------
    ConfigError
        Settings or a place are given for finished runs.
    RunError
        There is no run.
    """
    sources = logs_of(sources or (run_directory.newest_run(RUNS_FOLDER),), printer)
    logs = tuple(
        source
        for source in sources
        if not ((source / run_directory.RUN_FILE).is_file() or run_directory.is_run_directory(source))
    )
    if logs:
        return sources, dict(zip(logs, run_directories(logs, place), strict=True))
    check_run_config(config, free="dropout")
    if place.output or place.into:
        why = "a report on a finished run is written into that run"
        raise errors.ConfigError("-o", why, "leave -o out")
    return sources, {}


def content_of(log: Path) -> tuple[str, ...]:
    """Return the SHA-256 of each file of a log on disk, by which a baseline finds the log; empty for an address."""
    if isinstance(log, UrlPath):
        return ()
    return tuple(recording_files.file_sha256(file) for file in recording_files.files_of_log(log) if file.is_file())


class OtherResults(NamedTuple):
    """Results that a report is compared with: calibrations, and earlier reports."""

    calibrations: tuple[Calibration, ...]
    baseline: Baseline | None


def report_one(
    source: Path, place: Place | None, config: Config, request: ReportRequest, files: ResultFiles,
    other_results: OtherResults, printer: Printer,
) -> DropoutReport:  # fmt: skip
    """Write, print and return the report on one source.

    Parameters
    ----------
    source : a run or a log
    place : run directory of a log, which is fitted first; None for a run
    """
    with ExitStack() as stack:
        if place is None:
            folder = stack.enter_context(remote_place.folder_on_disk(source, needed=bool))
            run = run_directory.open_run(folder, whole=False)
        else:
            # Run and report are one result: if the report fails, an older run in this place stays there with its
            # report.
            run, folder = stack.enter_context(fitted_log(source, place, config, request.fit, files, printer))
        if request.outage_at_s and not dropout_report.forced_lengths_s(run, request):
            raise click.UsageError("--outage-at gives the start of an outage, and needs --outage for its length")
        baseline = None
        if other_results.baseline is not None:
            robot = run.document.config.robot.name or ""
            baseline = other_results.baseline.find(run.name, run.document.content, robot)
        with printer.stages(LogText(run.name)) as stages:
            report = pipeline.report_into(
                folder, run, request, files, stages.begin, log=None if place is None else source,
                calibrations=other_results.calibrations, baseline=baseline,
            )  # fmt: skip
    if report.baseline is not None:
        printer.warn(f"{run.name}: {change}" for change in report.baseline.changes(run.document))
    directory = source if place is None else path_of(place)
    label, name = ("page", run_directory.PAGE_FILE) if files.page else ("written to", "dropout")
    where = text_blocks.Section("", [text_blocks.Facts([(label, escaped(str(directory / name)))])])
    printer.show([*dropout.dropout_blocks(report), where])
    if not printer.shows:
        for verdict in report.document.gates:
            if not verdict.passed:
                click.echo(verdict.verdict, err=True)
    return report
