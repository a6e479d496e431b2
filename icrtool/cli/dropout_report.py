"""``icrtool dropout-report``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from icrtool.cli import options
from icrtool.cli.fit import fit_log
from icrtool.cli.inputs import RUNS, RunPlace, check_run_config, logs_of, run_directories
from icrtool.cli.printing import Inputs, Stages, print_json, show, warn
from icrtool.records.text import LogText, escaped

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.dropout_analysis.report import DropoutReport
    from icrtool.fleet.one_log import ReportOptions, TrialOptions
    from icrtool.output.exports.acceptance import Outcome
    from icrtool.output.files.baseline_file import Baseline
    from icrtool.records.run import Run

EPILOG_GATE = (
    'A limit of --gate reads "MODEL.p50|p95|expected|max@HORIZONm <= METRES", for example "recommended.p95@10m <= 1.2"'
    ', or "MODEL.within@ERRORm >= METRES", for example "recommended.within@0.5m >= 10".'
)


@dataclass(frozen=True, slots=True)
class Request:
    """The options, the same for every run.

    Attributes
    ----------
    config : that of the options; logs are fitted with it
    asked, baseline : of `icrtool.cli.options.report`
    further : what is asked beside that
    prints : results on standard output
    """

    config: Config
    asked: ReportOptions
    baseline: Baseline | None
    further: TrialOptions
    trials: bool
    overwrite: bool
    quiet: bool
    prints: bool
    verbose: bool


def distances(text: str) -> tuple[float, ...]:
    """Read the distances [m] of ``--horizons``."""
    found = options.numbers(text, "M,M,...")
    if min(found) <= 0:
        raise click.BadParameter(f"{text!r} has a distance that is not above zero")
    return found


@click.command("dropout-report", epilog=EPILOG_GATE)
@click.argument("sources", metavar="[RUN|LOG]...", nargs=-1, type=options.LOG)
@options.place
@click.option("--horizons", metavar="M,M,...", type=distances,
              help="Distances without GNSS [m], in place of the configured ones.")  # fmt: skip
@click.option("--calibration", "calibrations", metavar="CAL.json", type=options.FILE, multiple=True,
              help="Also predict with a calibration that icrtool calibrate wrote; repeatable.")  # fmt: skip
@click.option("--outage", "outages", metavar="SECONDS", type=options.POSITIVE, multiple=True,
              help="Force GNSS outages of this length, and report the error at their end; repeatable.")  # fmt: skip
@click.option("--outage-at", "outages_at", metavar="SECONDS", type=float, multiple=True,
              help="Begin of a forced outage, since the first state; default: equal spacing; repeatable.")  # fmt: skip
@click.option("--reference", type=click.Choice(["filter", "smoothed"]), default="filter", show_default=True,
              help="Compare trials with the states of the filter, or of the smoother (fit --smooth).")  # fmt: skip
@click.option("--without-events", is_flag=True,
              help="Leave out trials that cross a slip event, and report how much they change the errors.")  # fmt: skip
@click.option("--with-jumps", is_flag=True,
              help="Count trials that cross a jump of the reference too.")  # fmt: skip
@click.option("--starts", type=click.Choice(["moving", "all"]), default="moving", show_default=True,
              help="moving: each standstill is one start; all: every recorded state is one.")  # fmt: skip
@click.option("--trials", is_flag=True, help="Write every single trial to trials.parquet.")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the random draws.")
@options.report
@options.as_json
@options.configuration
@options.verbosity
def command(
    sources: tuple[Path, ...], output: Path | None, into: Path | None, overwrite: bool,
    horizons: tuple[float, ...] | None, calibrations: tuple[Path, ...], outages: tuple[float, ...],
    outages_at: tuple[float, ...], reference: Literal["filter", "smoothed"], without_events: bool,
    with_jumps: bool, starts: Literal["moving", "all"], trials: bool,
    seed: int | None, asked: ReportOptions, baseline: Path | None, junit: Path | None, markdown: Path | None,
    as_json: bool,
    config_file: Path | None, robot: str | None, sets: tuple[str, ...], quiet: bool, verbose: bool,
) -> None:  # fmt: skip
    """Report how far off a robot is without GNSS: open loop from every recorded state, over 1 to 20 m.

    RUN is a directory that `icrtool fit` wrote, or its address; a LOG is fitted first. Without an argument: the newest
    run below icrtool-runs/. The report is written into the run directory, as dropout/.

    \b
    Example:
      icrtool dropout-report
      icrtool dropout-report icrtool-runs/field --budget 0.5 --outage 20
      icrtool dropout-report icrtool-runs/field --calibration season.json --gate "calibration.p95@10m <= 0.6"
      icrtool dropout-report log.bag --robot jackal --gate "recommended.p95@10m <= 1.5" --junit gates.xml
    """  # noqa: D301 - click reads the escape
    from icrtool.fleet.one_log import TrialOptions
    from icrtool.output.dropout_directory import report_document
    from icrtool.output.files.documents import open_calibration
    from icrtool.records.dropout import DEFAULT_SEED

    config = options.load(config_file, robot, sets)
    dropout, given = config.dropout, config.given
    further = TrialOptions(
        horizons_m=horizons or (dropout.horizons_m if "dropout.horizons_m" in given else None),
        outage_s=outages or (dropout.forced_outage_s if "dropout.forced_outage_s" in given else None),
        calibrations=tuple(open_calibration(file) for file in calibrations), outage_at_s=outages_at,
        starts=starts, without_events=without_events, with_jumps=with_jumps, reference=reference,
        seed=DEFAULT_SEED if seed is None else seed,
    )  # fmt: skip
    request = Request(
        config=config, asked=asked, baseline=options.baseline_of(baseline, asked.gates), further=further,
        trials=trials, overwrite=overwrite, quiet=quiet, prints=not (quiet or as_json), verbose=verbose,
    )  # fmt: skip
    sources, places = plan_sources(sources, output, into, config, quiet=quiet)
    inputs = Inputs("source")
    reports: dict[str, DropoutReport] = {}
    for number, source in enumerate(sources):
        if number and request.prints:
            click.echo()
        with inputs.each(source) as document:
            reports[str(source)] = report = _report_one(source, places.get(source), request)
            if as_json:
                document["report"] = report_document(report)
    if as_json:
        print_json("dropout-report", {"reports": inputs.documents})
    write_exports({str(source): (inputs.errors | reports)[str(source)] for source in sources}, junit, markdown)
    verdicts = [one for report in reports.values() for one in report.verdicts]
    options.check_compared(verdicts)
    inputs.leave("runs and logs", gate_failed=not all(one.passed for one in verdicts))


def plan_sources(
    sources: tuple[Path, ...], output: Path | None, into: Path | None, config: Config, *, quiet: bool
) -> tuple[tuple[Path, ...], dict[Path, RunPlace]]:
    """Return the sources, the newest run where none is named, and the run directory of each that is a log.

    Everything that can be refused without reading a log is refused here: a finished run keeps its configuration and
    its place.
    """
    from icrtool.errors import ConfigError
    from icrtool.output.run_directory import RUN_FILE, is_run_directory, newest_run

    sources = logs_of(sources or (newest_run(RUNS),), quiet=quiet)
    logs = tuple(source for source in sources if not ((source / RUN_FILE).is_file() or is_run_directory(source)))
    if logs:
        return sources, dict(zip(logs, run_directories(logs, output, into), strict=True))
    check_run_config(config, free="dropout")
    if output or into:
        raise ConfigError("-o", "a report on a finished run is written into that run", "leave -o out")
    return sources, {}


def write_exports(outcomes: dict[str, Outcome], junit: Path | None, markdown: Path | None) -> None:
    """Write what machines that watch pull requests read, where it is asked for."""
    from icrtool.output.exports.acceptance import suite_of, write_junit, write_markdown

    if junit is not None:
        write_junit(junit, [suite_of(name, outcome) for name, outcome in outcomes.items()])
    if markdown is not None:
        write_markdown(markdown, list(outcomes.items()))


def _report_one(source: Path, place: RunPlace | None, request: Request) -> DropoutReport:
    """Report on one source; `place` is the run directory of a log, None for a run."""
    from icrtool.output.files.remote_place import on_disk

    reports: list[DropoutReport] = []

    def report_into(run: Run, directory: Path) -> None:
        reports.append(_analyse(run, directory, request))

    if place is None:
        directory = source
        with on_disk(source, needed=bool) as folder:
            run = _read(folder)
            report_into(run, folder)
    else:
        directory = place.directory
        # One result: where the report fails, an old run in this place stays, with its report.
        run = fit_log(
            source, directory, request.config, plots=request.asked.plots, figures=request.asked.figures,
            inside=place.inside, smooth=request.further.reference == "smoothed", overwrite=request.overwrite,
            then=report_into, quiet=request.quiet, verbose=request.verbose,
        )  # fmt: skip
    report = reports[0]
    if report.baseline is not None:
        warn([f"{run.name}: {change}" for change in report.baseline.changes(run.document)], quiet=request.quiet)
    if request.prints:
        _print(report, directory, request)
    else:
        for verdict in report.verdicts:
            if not verdict.passed:
                click.echo(verdict.verdict, err=True)
    return report


def _analyse(run: Run, directory: Path, request: Request) -> DropoutReport:
    """Analyse a run, and write its report into its directory."""
    from icrtool.dropout_analysis.dropout_report import forced_lengths_s
    from icrtool.fleet.one_log import report_and_write

    if request.further.outage_at_s and not forced_lengths_s(run, request.further.outage_s):
        raise click.UsageError("--outage-at gives the begin of an outage, and needs --outage for its length")
    baseline = request.baseline.find(run.name, run.document.content) if request.baseline is not None else None
    with Stages(LogText(run.name), quiet=request.quiet, verbose=request.verbose) as stages:
        return report_and_write(
            run, directory, request.asked, stages.begin, baseline=baseline, trials=request.trials,
            further=request.further,
        )  # fmt: skip


def _print(report: DropoutReport, directory: Path, request: Request) -> None:
    """Print the answer, with -v all that was found."""
    from icrtool.output.run_directory import PAGE_FILE
    from icrtool.output.tables.dropout import dropout_blocks
    from icrtool.output.text_blocks import Facts, Section, printed

    label, name = ("page", PAGE_FILE) if request.asked.page else ("written to", "dropout")
    place = Section("", [Facts([(label, escaped(str(directory / name)))])])
    show(printed([*dropout_blocks(report), place], verbose=request.verbose))


def _read(directory: Path) -> Run:
    """Read a run; what the analysis needs is loaded beside it."""
    from concurrent.futures import ThreadPoolExecutor

    from icrtool.output.run_directory import open_run

    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(open_run, directory)
        from icrtool.dropout_analysis.trials import load_kernels

        load_kernels()
        return reading.result()
