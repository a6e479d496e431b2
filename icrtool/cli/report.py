"""``icrtool report``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from icrtool.cli import options
from icrtool.cli.inputs import RUNS
from icrtool.cli.options import FILE, flag, option
from icrtool.cli.printing import Printer


@click.command("report")
@click.argument("sources", metavar="[RUN|FLEET|COMPARISON]...", nargs=-1, type=FILE)
@option("-o --output", "FILE", FILE, "The page; default: report.html in the directory of the run or fleet.")
@flag("--no-coordinates", "Leave out the place on the globe, for a page that others will read.")
@options.printing(options.QUIET_RESULTS)
def command(sources: tuple[Path, ...], output: Path | None, no_coordinates: bool, printer: Printer) -> None:
    """Write a run, a fleet or a comparison as one HTML file that needs no network.

    RUN is a directory that `icrtool fit` wrote, with or without its dropout report; FLEET the folder of `icrtool
    batch`; COMPARISON what `icrtool compare -o` wrote. Without an argument: the newest run below icrtool-runs/.

    \b
    Example:
      icrtool report
      icrtool report icrtool-runs/field -o field.html --no-coordinates
      icrtool report results/
    """  # noqa: D301 - click reads the escape
    from icrtool.errors import ConfigError
    from icrtool.output.files.atomic import check_place, is_page, write_file
    from icrtool.output.run_directory import PAGE_FILE, newest_run

    sources = sources or (newest_run(RUNS),)
    if output is not None and len(sources) > 1:
        raise ConfigError("-o", "names one file for several pages", "leave it out: each page goes to its own directory")
    for source in sources:
        place = output or (source / PAGE_FILE if source.is_dir() else source.with_suffix(".html"))
        # A page in its usual place is beside what a stranger may have put there.
        inside = place.parent if output is None else None
        ours = is_page if output is None else None
        check_place(place, inside, ours)
        page = _page_of(source, coordinates=not no_coordinates)
        write_file(place, page, inside, ours)
        printer.text(f"written to {place} ({place.stat().st_size / 1e6:.1f} MB)")


def _page_of(source: Path, *, coordinates: bool) -> str:
    """Return the page of a run, a fleet or a comparison."""
    from icrtool.errors import RunError
    from icrtool.output.files.formats import read_fleet, schema_of
    from icrtool.output.page.group_pages import comparison_in, comparison_page, fleet_page, read_comparison
    from icrtool.output.run_directory import is_run_directory
    from icrtool.records.fleet_document import FLEET_FAMILY, FLEET_FILE
    from icrtool.records.regular_file import NOT_REGULAR, SAVE_IT, is_special

    if is_run_directory(source):
        with _as_written(source, "fit the log again, or make its report again with icrtool dropout-report"):
            return _page_of_run(source, coordinates=coordinates)
    if schema_of(source / FLEET_FILE, source).startswith(FLEET_FAMILY):
        with _as_written(source / FLEET_FILE, "run icrtool batch again"):
            return fleet_page(read_fleet(source), source)
    if (file := comparison_in(source)) is not None:
        with _as_written(file, "run icrtool compare again"):
            return comparison_page(read_comparison(file, source if source.is_dir() else None), file.stem)
    if is_special(source):
        raise RunError(source, NOT_REGULAR, SAVE_IT)
    what = "no run, fleet or comparison in it" if source.exists() else "no such file or directory"
    raise RunError(source, what, "icrtool fit, batch and compare make one")


def _page_of_run(directory: Path, *, coordinates: bool) -> str:
    """Return the page of a run; what it has no dropout report of, and no pictures, is made for the page."""
    from icrtool.output.page.run_page import draw_pictures, pictures_of_run, read_report, run_page
    from icrtool.output.run_directory import open_run

    run, report, pictures = open_run(directory), read_report(directory), pictures_of_run(directory)
    if "trajectory" not in pictures:
        pictures = draw_pictures(run) | pictures
    if report is None:
        from icrtool.dropout_analysis.dropout_report import dropout_report

        return run_page(run, dropout_report(run).document, pictures, coordinates=coordinates)
    with _as_written(directory / "dropout", "make it again with icrtool dropout-report"):
        return run_page(run, report, pictures, coordinates=coordinates)


@contextmanager
def _as_written(place: Path, advice: str) -> Iterator[None]:
    """Refuse a document that was edited, or that another version wrote."""
    from jinja2 import TemplateError

    from icrtool.errors import RunError
    from icrtool.output.page.render import DOCUMENT_ERRORS

    try:
        yield
    except (*DOCUMENT_ERRORS, TemplateError) as err:
        raise RunError(place, "is not as this version of icrtool writes it", advice) from err
