"""``icrtool report``, the answer about a log or the page of a result, and ``icrtool compare``, for groups of runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import dropout_report, lazy_imports, options
from icrtool.cli.inputs import (
    RUNS_FOLDER,
    ResultPlace,
    check_run_config,
    groups_of,
    is_log,
    run_directories,
    runs_named,
    runs_or_logs,
)
from icrtool.cli.options import FILE, NEW_FILE, NEW_PICTURE, flag, option
from icrtool.cli.printing import Inputs, Printer
from icrtool.records.places import NOT_REGULAR, SAVE_IT, Below, Place, UrlPath, is_special, path_of
from icrtool.records.text import escaped

with lazy_imports():
    from icrtool import errors
    from icrtool.calibration import transfer
    from icrtool.dropout_analysis import dropout_report as analysis
    from icrtool.output import run_directory
    from icrtool.output.files import atomic, formats
    from icrtool.output.page import pages, render
    from icrtool.output.tables import calibration as tables
    from icrtool.output.tables import dropout
    from icrtool.records import calibration_document, fleet_document, requests

if TYPE_CHECKING:
    from icrtool.config import Config, ConfigSources
    from icrtool.output.text_blocks import Block
    from icrtool.records.run import Run


@click.command("report")
@click.argument("sources", metavar="[LOG|RUN|FLEET|COMPARISON|CAL.json]...", nargs=-1, type=options.LOG)
@option("-o --output", "FILE", FILE, "File of the page; default: report.html in the directory of the run or fleet.")
@flag("--no-coordinates", "Leave out the place on the globe, for a page that others will read.")
@option("--into", "DIR", FILE, "Folder of the run directories of logs; default: icrtool-runs.")
@flag("--overwrite", "Also replace the run of another recording, or a run that was made with other settings.")
@options.options_as_record("report", f"{options.REQUESTS_MODULE}:ReportRequest", options.CALIBRATION_OPTIONS)
@options.CONFIGURATION
@options.INPUT_LIMITS
@options.printer_options(options.QUIET, options.VERBOSE_OPTION)
def report_command(
    sources: tuple[Path, ...], output: Path | None, no_coordinates: bool, into: Path | None, overwrite: bool,
    calibrations: tuple[Path, ...], report: requests.ReportRequest, settings: ConfigSources, printer: Printer,
) -> None:  # fmt: skip
    """Fit and test a LOG, with the answer on one screen and one page; or write the page of a result.

    A LOG is fitted, unless its run exists, and tested. The answer has numbers for the controller, the distance without
    GNSS, reasons for trust, and the worst case. RUN is a directory that `icrtool fit` wrote, with or without its
    dropout report; with --calibration the report is made again. FLEET is the folder of `icrtool batch`, COMPARISON a
    file of `icrtool compare -o`, CAL.json a file of `icrtool calibrate -o`. Without an argument, the newest run below
    icrtool-runs/ is used. A page is one HTML file that needs no network.

    \b
    Example:
      icrtool report field.mcap --robot husky-a200
      icrtool report field.mcap --robot husky-a200 --calibration season.json
      icrtool report icrtool-runs/field -o field.html --no-coordinates
      icrtool report results/
      icrtool report season.json
    """  # noqa: D301 - click reads the escape
    other_results = dropout_report.OtherResults(options.calibrations_of(calibrations, report), None)
    config = settings.load()
    sources = sources or (run_directory.newest_run(RUNS_FOLDER),)
    if output is not None and len(sources) > 1:
        advice = "leave it out: each page goes to its own directory"
        raise errors.ConfigError("-o", "names one file for several pages", advice)
    logs = tuple(source for source in sources if is_log(source))
    again = tuple(source for source in sources if calibrations and run_directory.is_run_directory(source))
    if calibrations and (others := [source for source in sources if source not in {*logs, *again}]):
        why = f"{escaped(str(others[0]))} is neither a log nor a run, so no report is made for its page"
        raise errors.ConfigError("--calibration", why, "name logs or runs")
    if not logs:
        check_run_config(config, free="dropout" if again else "")
    places = dict(zip(logs, run_directories(logs, ResultPlace(into=into)), strict=True))
    inputs = Inputs("source")
    for source in sources:
        with inputs.document_of(source):
            result = source
            files = requests.ResultFiles(overwrite=overwrite, page=output is None and not no_coordinates)
            if source in places:
                _report_on_log(source, places[source], config, report, files, other_results, printer)
                result = path_of(places[source])
            elif source in again:
                request = report.configured(config)
                dropout_report.report_one(source, None, config, request, files, other_results, printer)
            reported = source in {*places, *again}
            if not (reported and files.page):
                _write_page(result, output, coordinates=not no_coordinates, answers=not reported, printer=printer)
    inputs.exit_if_failed("sources")


def _report_on_log(
    source: Path, place: Place, config: Config, report: requests.ReportRequest, files: requests.ResultFiles,
    other_results: dropout_report.OtherResults, printer: Printer,
) -> None:  # fmt: skip
    """Write the run and the report of a log, and print the report; an existing run is not fitted again."""
    request = report.configured(config)
    has_run = run_directory.holds_run_of(path_of(place), source, config, request.fit)
    if has_run:
        dropout_report.report_one(path_of(place), None, config, request, files, other_results, printer)
    else:
        dropout_report.report_one(source, place, config, request, files, other_results, printer)


def _write_page(source: Path, output: Path | None, *, coordinates: bool, answers: bool, printer: Printer) -> None:
    """Write the page of a result to `output` or into its folder; with `answers`, also print the report of a run."""
    if isinstance(source, UrlPath):
        advice = "copy it to a disk, or write its page to the address: icrtool dropout-report ADDRESS"
        raise errors.RunError(source, "is a run at an address", advice)
    place = output or (source / run_directory.PAGE_FILE if source.is_dir() else source.with_suffix(".html"))
    # A stranger may have put files into the folder of a result, so only a page is replaced there.
    file, may_replace = (Below(place.parent, place.name), run_directory.is_page) if output is None else (place, None)
    atomic.check_place(file, may_replace)
    if run_directory.is_run_directory(source):
        with _as_written(source, "fit the log again, or make its report again with icrtool dropout-report"):
            page, blocks = _page_of_run(source, coordinates=coordinates)
            if answers:
                printer.show(blocks)
    else:
        page = _page_of(source)
    atomic.write_file(file, page, may_replace)
    printer.text(f"page        {place}")


def _page_of(source: Path) -> str:
    """Return the page of a fleet, a comparison or a calibration.

    Raises
    ------
    RunError
        The place has none of these, or another version wrote it.
    """
    fleet = source / fleet_document.FLEET_FILE
    if formats.schema_of(Below(source, fleet_document.FLEET_FILE)).startswith(fleet_document.FLEET_FAMILY):
        with _as_written(fleet, "run icrtool batch again"):
            return pages.fleet_page(formats.read_fleet(source), source)
    if (file := pages.comparison_in(source)) is not None:
        with _as_written(path_of(file), "run icrtool compare again"):
            comparison = formats.read_document(file, calibration_document.GroupComparison)
            return pages.comparison_page(comparison, path_of(file).stem)
    if formats.schema_of(source) == calibration_document.CALIBRATION_SCHEMA:
        with _as_written(source, "make it again with icrtool calibrate -o"):
            return pages.calibration_page(formats.open_calibration(source))
    if is_special(source):
        raise errors.RunError(source, NOT_REGULAR, SAVE_IT)
    if not source.exists():
        advice = "name a log, or a result of icrtool fit, batch, compare -o or calibrate -o"
        raise errors.RunError(source, "no such file or directory", advice)
    why = "holds no run, fleet, comparison or calibration"
    raise errors.RunError(source, why, "icrtool fit, batch, compare and calibrate -o make one")


def _page_of_run(directory: Path, *, coordinates: bool) -> tuple[str, list[Block]]:
    """Return the page of a run and the blocks of its report; a missing report and missing pictures are made for it."""
    run, report = run_directory.open_run(directory), pages.read_report(directory)
    pictures = pages.pictures_of_run(directory)
    if "trajectory" not in pictures:
        pictures = pages.draw_pictures(run) | pictures
    document = analysis.dropout_report(run).document if report is None else report
    with _as_written(directory / "dropout", "make it again with icrtool dropout-report"):
        page = pages.run_page(run, document, pictures, coordinates=coordinates)
        return page, dropout.report_blocks(run.document, document)


@contextmanager
def _as_written(place: Path, advice: str) -> Iterator[None]:
    """Raise a RunError if the block fails, because a document was edited or another version wrote it."""
    from jinja2 import TemplateError

    try:
        yield
    except (*render.DOCUMENT_ERRORS, TemplateError) as err:
        raise errors.RunError(place, "is not as this version of icrtool writes it", advice) from err


@click.command("compare")
@click.argument("sources", metavar="[NAME=]RUN|LOG|FOLDER...", nargs=-1, required=True)
@option("--csv", "FILE", NEW_FILE, "Write the errors of the calibration of each group in each group (transfer matrix).")
@option("-o --output", "FILE", NEW_FILE, "Write the comparison as JSON, for icrtool report.")
@option("--plot", "FILE", NEW_PICTURE, "Draw the comparison: png, svg, pdf.")
@options.CONFIGURATION
@options.INPUT_LIMITS
@options.printer_options(options.AS_JSON, options.QUIET, options.VERBOSE_OPTION)
def compare_command(
    sources: tuple[str, ...],
    csv: Path | None,
    output: Path | None,
    plot: Path | None,
    settings: ConfigSources,
    printer: Printer,
) -> None:
    """Compare groups of runs: ICRs, multiplier, errors, and the errors of the calibration of one group in another.

    Each argument is a group: a run, a log, or a folder of runs or logs; arguments with the same NAME are one group. The
    first group is compared with each of the other groups. The folder of a batch, as the only argument, stands for its
    robots and groups.

    \b
    Example:
      icrtool compare old=season1/ new=season2/
      icrtool compare before=may/*.mcap after=june/*.mcap --robot husky-a200
      icrtool compare grass=icrtool-runs/monday asphalt=icrtool-runs/tuesday --json
    """  # noqa: D301 - click reads the escape
    config = settings.load()
    places_of_groups = [
        (name, run_or_log)
        for name, places in groups_of(sources).items()
        for path in places
        for run_or_log in runs_or_logs(path)
    ]
    groups: dict[str, list[Run]] = {}
    runs = runs_named([path for _, path in places_of_groups], config, printer)
    for (name, _), run in zip(places_of_groups, runs, strict=True):
        groups.setdefault(name, []).append(run)
    compared = transfer.compare_groups(groups)
    for file, content in ((csv, tables.transfer_csv(compared)), (output, formats.json_bytes(compared))):
        if file is not None:
            atomic.write_file(file, content)
    if plot is not None:
        from icrtool.output.figures.calibrations import transfer as transfer_figure

        formats.save_picture(transfer_figure(compared), plot)
    printer.json("compare", compared)
    printer.show(tables.transfer_blocks(compared))
