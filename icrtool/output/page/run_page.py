"""The page of a run: ``report.html`` in its directory."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import msgspec

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.dropout_analysis.starts import with_smoothed_reference
from icrtool.errors import RunError
from icrtool.output.dropout_directory import DROPOUT_DIRECTORY, REPORT_FILE
from icrtool.output.files.atomic import is_page, write_file
from icrtool.output.files.formats import CHECKSUM_FILE, read_document, read_sums, schema_of
from icrtool.output.page.drive_data import drive_data
from icrtool.output.page.render import Picture, drawn_pictures, pictures_in, render
from icrtool.output.run_directory import check_sum
from icrtool.output.tables.dropout import answer_sections, model_sections, outage_blocks, verdict_lines, worst_section
from icrtool.output.tables.errors import errors_section, main_rows
from icrtool.output.tables.run import advice_blocks, log_sections, unusable_lines
from icrtool.output.text_blocks import PAGE, Block, Facts, Figure, Items, Section, Table, Title
from icrtool.output.text_format import driven_text, duration_text, position_word, run_title
from icrtool.records.dropout_document import DROPOUT_SCHEMA, DropoutDocument, TrialDocument
from icrtool.records.run import Run, check_type
from icrtool.records.run_document import EventDocument, RunDocument
from icrtool.records.text import distance_text

SCRIPTS = (
    "vendor/uPlot.iife.min.js",
    "vendor/d3.min.js",
    "columns.js",
    "open_loop.js",
    "charts.js",
    "map.js",
    "run.js",
)


def write_page(
    run: Run, report: DropoutReport, path: str | Path, *, plots: Path | None = None, coordinates: bool = True,
    inside: Path | None = None,
) -> None:  # fmt: skip
    """Write a run and its dropout report as one HTML file.

    Parameters
    ----------
    run : of `icrtool.fit` or `icrtool.open_run`
    report : of `icrtool.dropout_report`
    path : the file
    plots : directory of the run, whose PNG pictures the page shows where no script draws; default: that of `run`
    coordinates : False leaves out where on the globe the robot was
    inside : as in `icrtool.output.files.atomic.atomic_file`

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    check_type(run, Run, "icrtool.open_run(directory) reads one")
    pictures = pictures_of_run(plots if plots is not None else run.directory)
    page = run_page(run, report.document, pictures, coordinates=coordinates)
    write_file(Path(path), page, inside, ours=is_page if inside is not None else None)


def run_page(run: Run, report: DropoutDocument, pictures: Mapping[str, Picture], *, coordinates: bool = True) -> str:
    """Return the page of a run as HTML.

    Parameters
    ----------
    run, coordinates : as in `write_page`
    report : what report.json holds
    pictures : by name; those that the page is to show where no script draws
    """
    if not coordinates:
        pictures = _without_place(run, pictures)
        run, report = without_place(run, report)
    summary = run.document
    compared = with_smoothed_reference(run) if report.smoothed else run
    begun = f"{datetime.fromtimestamp(int(run.table.stamp_ns[0]) // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    return render(
        SCRIPTS, drive_data(compared, report, coordinates=coordinates), title=summary.log,
        kind="Drive without GNSS: report of one log",
        blocks=[
            Title(run_title(summary), f"{driven_text(summary.drive)}, from {begun}. {ABOUT}"),
            *page_blocks(summary, report),
            Section(
                "Log and settings", [*log_sections(summary), _provenance(summary, report, coordinates=coordinates)],
                name="log",
            ),
            Section("Words on this page", [Figure((), "words")], name="words"),
        ],
        pictures=pictures, position_word=position_word(summary), duration_s=summary.drive.duration_s,
        folded_models=len(report.models) - len(main_rows(report)),
    )  # fmt: skip


ABOUT = (
    "From this drive icrtool learned how the robot slips when it turns, and then tested how far wheel speeds alone "
    "keep its position."
)


def page_blocks(summary: RunDocument, report: DropoutDocument) -> list[Block]:
    """Return what the page of a run states: the answer, the drive, the errors, the motion model, the warnings."""
    drive: list[Block] = [Figure(("trajectory", "icr_estimates", "gnss_difference"), "drive")]
    if events := summary.events:
        rows = []
        for one in events:
            times = duration_text(one.begin_s), duration_text(one.end_s - one.begin_s)
            rows.append((one.kind, *times, distance_text(one.distance_m), f"{100 * one.severity:.0f} %"))
        head = ("kind", "from", "lasts", "distance", "missing motion")
        caption = "Slip events: the robot did not move as its wheels did"
        table = Table("lr", rows, head, caption, [one.begin_s for one in events])
        drive.append(Section("", [table], PAGE))
    drive += [*outage_blocks(report), Figure(("icr_clusters", "outages"))]
    warnings = [one.removeprefix(f"{summary.log}: ") for one in summary.warnings]
    return [
        *unusable_lines(summary), *advice_blocks(summary),
        Section("Answer", answer_sections(summary, report), name="answer"),
        Section("The drive", drive, name="drive"),
        errors_section(report, summary), worst_section(summary, report), *model_sections(report),
        *([Section("Acceptance limits", verdict_lines(report), name="limits")] if report.gates else []),
        Section("Warnings", [Items(warnings) if warnings else "None."], PAGE, name="warnings"),
    ]  # fmt: skip


def _provenance(summary: RunDocument, report: DropoutDocument, *, coordinates: bool) -> Section:
    """Return what the page was made from, where, and with what."""
    facts = [("log", f"{one.path}: {one.bytes:,} bytes, sha256 {one.sha256}") for one in summary.inputs]
    place, datum = "left out", summary.gnss.datum
    if coordinates:
        place = "metric reference, no datum"
        if datum is not None:
            place = f"datum {datum[0]:.6f}° {datum[1]:.6f}°, {datum[2]:.1f} m"
    made = (
        f"icrtool {summary.tool_version}, {summary.schema}, {report.schema}; {report.starts:,} states; "
        f"intervals by {report.bootstrap.method}"
    )
    return Section("Provenance", [Facts([*facts, ("place", place), ("made with", made)])], PAGE)


def read_report(directory: Path) -> DropoutDocument | None:
    """Return what the report.json of a run directory holds; None where it has none.

    Raises
    ------
    RunError
        It is not a report of this version, or was edited.
    """
    name = f"{DROPOUT_DIRECTORY}/{REPORT_FILE}"
    file = directory / name
    if not os.path.lexists(file):
        return None
    if name in (sums := _listed(directory)):
        check_sum(directory, name, sums)
    if schema_of(file, directory) != DROPOUT_SCHEMA:
        raise RunError(file, f"is no report of schema {DROPOUT_SCHEMA}", "make it again with icrtool dropout-report")
    try:
        return read_document(file, DropoutDocument, directory)
    except (ValueError, RecursionError) as err:
        why = f"is not as this version of icrtool writes it ({err})"
        raise RunError(file, why, "make it again with icrtool dropout-report") from err


def pictures_of_run(directory: Path | None) -> dict[str, Picture]:
    """Return the pictures in a run's directory and in that of its dropout report."""
    if directory is None:
        return {}
    sums = _listed(directory)
    found = pictures_in(directory / "plots", directory, sums)
    return found | pictures_in(directory / DROPOUT_DIRECTORY / "plots", directory, sums)


def _listed(directory: Path) -> dict[str, str]:
    """Return the sums of the files of a run; none where it has no list of them."""
    return read_sums(directory) if os.path.lexists(directory / CHECKSUM_FILE) else {}


def draw_pictures(run: Run) -> dict[str, Picture]:
    """Draw the pictures of a run anew, into memory."""
    from icrtool.output.figure_catalogue import figures_of

    return drawn_pictures(figures_of("run", run))


def _without_place(run: Run, pictures: Mapping[str, Picture]) -> dict[str, Picture]:
    """Return the pictures that do not show coordinates; relative to a datum that is left out they show no place."""
    metric = run.document.gnss.datum is None
    return {name: one for name, one in pictures.items() if not (metric and one.with_place)}


Placed = TypeVar("Placed", EventDocument, TrialDocument)

HIDDEN = "left out"
"""Stands in place of a number that would show the place."""


def without_place(run: Run, report: DropoutDocument) -> tuple[Run, DropoutDocument]:
    """Return a run and what report.json holds of it, with the first state as origin and without the datum.

    Notes
    -----
    Where a position reference is metric its coordinates may be those of a map grid, so the origin moves there too.
    Magnetic declination and grid convergence narrow the place down, and are left out with their name.
    """
    table = run.table
    north, east = float(table.north_m[0]), float(table.east_m[0])

    changed, document = msgspec.structs.replace, run.document

    def moved(one: Placed) -> Placed:
        return changed(one, north_m=one.north_m - north, east_m=one.east_m - east)

    cause, datum = document.heading.offset_name, document.gnss.datum
    shown = changed(
        document,
        config=replace(document.config, frames=replace(document.config.frames, datum=None)),
        warnings=tuple(one.replace(cause, f"its cause is {HIDDEN}") if cause else one for one in document.warnings),
        gnss=changed(document.gnss, datum=None if datum is None else (math.nan, math.nan, math.nan)),
        heading=changed(document.heading, offset_name=None, magnetic_declination_deg=None, utm_convergence_deg=None),
        events=tuple(map(moved, document.events)),
    )
    sensors, fixes = run.sensors, run.sensors.fixes
    at_origin = replace(
        run,
        table=replace(table, north_m=table.north_m - north, east_m=table.east_m - east),
        sensors=replace(
            sensors,
            fixes=replace(fixes, north_m=fixes.north_m - north, east_m=fixes.east_m - east),
            events=tuple(one._replace(north_m=one.north_m - north, east_m=one.east_m - east) for one in sensors.events),
        ),
        document=shown,
    )
    worst, examples = tuple(map(moved, report.worst)), tuple(map(moved, report.examples))
    return at_origin, changed(report, worst=worst, examples=examples)
