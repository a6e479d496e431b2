"""Pages in HTML: of a run, of a batch with links to the pages of its logs, of a comparison and of a calibration."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import msgspec

from icrtool.calibration.record import Calibration
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.dropout_analysis.starts import with_smoothed_reference
from icrtool.errors import RunError
from icrtool.motion.models import CONTROLLER, MODELS
from icrtool.output.dropout_directory import DROPOUT_DIRECTORY, REPORT_FILE
from icrtool.output.figure_catalogue import drive_charts
from icrtool.output.files.atomic import write_file
from icrtool.output.files.formats import CHECKSUM_FILE, read_document, read_sums, schema_of
from icrtool.output.page.drive_data import ERROR_KEYS, drive_data, row_look
from icrtool.output.page.render import Picture, drawn_pictures, pictures_in, render
from icrtool.output.page.sketch import drive_sketch, geometry_sketch, group_sketch
from icrtool.output.run_directory import PAGE_FILE, check_sum, is_page
from icrtool.output.tables.calibration import calibration_file_blocks, comparison_title, transfer_blocks
from icrtool.output.tables.configuration import format_settings
from icrtool.output.tables.dropout import (
    answer_sections,
    controller_section,
    model_section,
    outage_blocks,
    reach_row,
    verdict_lines,
    with_verdict,
    worst_section,
)
from icrtool.output.tables.errors import errors_section
from icrtool.output.tables.run import next_step, streams_section, unusable_line
from icrtool.output.text_blocks import PAGE, Block, Cell, Chart, Facts, Figure, Items, Line, Section, Table, Title
from icrtool.output.text_format import (
    GLOSSARY,
    direction_words,
    driven_text,
    duration_text,
    error_text,
    plus_minus,
    position_word,
    role_word,
    run_title,
    signed_text,
)
from icrtool.records.acceptance import CHOICE_HORIZON_M
from icrtool.records.calibration_document import ErrorsAt, GroupComparison
from icrtool.records.dropout_document import DROPOUT_SCHEMA, DropoutDocument
from icrtool.records.fleet_document import FleetCalibration, FleetDocument, FleetLog, next_low_name
from icrtool.records.notes import is_grave, warnings_of
from icrtool.records.places import Below, Place, is_regular
from icrtool.records.rows import FALLBACK_ROW, IN_CSV, MAIN_ROW, rows_of, shown_rows
from icrtool.records.run import ICR_WORDS, Run, check_type
from icrtool.records.run_document import RunDocument
from icrtool.records.text import counted, distance_text

VENDOR = ("vendor/uPlot.iife.min.js", "vendor/d3-subset.min.js")
"""Scripts of other projects, in ``static``."""

COPY = "copy.js"
SCRIPTS = (*VENDOR, "columns.js", "open_loop.js", "charts.js", "map.js", "run.js", COPY)
"""Scripts of the page of a run, in the order in which they run. `COPY` copies a text to the clipboard."""


def write_page(
    run: Run, report: DropoutReport, path: str | Place, *, plots: Path | None = None, coordinates: bool = True
) -> None:
    """Write a run and its dropout report as one HTML file.

    Parameters
    ----------
    run : result of `icrtool.fit` or `icrtool.open_run`
    report : result of `icrtool.dropout_report`
    path : place of the file. If it is below a folder, only a page is replaced
    plots : run directory whose PNG pictures the page shows where no script draws; default: `run.directory`
    coordinates : False leaves out the place of the robot on the globe

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    check_type(run, Run, "icrtool.open_run(directory) reads one")
    pictures = pictures_of_run(plots if plots is not None else run.directory)
    page = run_page(run, report.document, pictures, coordinates=coordinates)
    file = Path(path) if isinstance(path, str) else path
    write_file(file, page, may_replace=is_page if isinstance(file, Below) else None)


def run_page(run: Run, report: DropoutDocument, pictures: Mapping[str, Picture], *, coordinates: bool = True) -> str:
    """Return the page of a run as HTML.

    Parameters
    ----------
    run, coordinates : as in `write_page`
    report : content of report.json
    pictures : pictures by name; the page shows them where no script draws
    """
    summary, report_document = run.document, report
    if not coordinates:
        # Coordinates relative to a datum do not show the place, once the datum is left out. Metric ones may show it.
        metric = summary.gnss.datum is None
        pictures = {name: picture for name, picture in pictures.items() if not (metric and picture.with_place)}
        summary, report_document = without_place(run, report)
    compared = with_smoothed_reference(run) if report.request.reference == "smoothed" else run
    begun = f"{datetime.fromtimestamp(int(run.table.stamp_ns[0]) // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    origin_text, datum = "left out", summary.gnss.datum
    if coordinates:
        origin_text = "metric reference, no datum"
        if datum is not None:
            origin_text = f"datum {datum[0]:z.6f}° {datum[1]:z.6f}°, {datum[2]:z.1f} m"
    made_with = (
        f"icrtool {summary.tool_version}, {summary.schema}, {report.schema}; {report.starts:,} states; "
        f"intervals by {report.intervals.method}"
    )
    provenance = [("log", f"{file.path}: {file.bytes:,} bytes, sha256 {file.sha256}") for file in summary.inputs]
    made_from = Section("Provenance", [Facts([*provenance, ("place", origin_text), ("made with", made_with)])], PAGE)
    about = (
        "From this drive icrtool learned how the robot slips, and tested how far wheel speeds alone keep the position."
    )
    if not with_verdict(summary, report_document).usable:
        about = "How the robot slips when it turns could not be learned from this drive."
    rows = rows_of(model.name for model in report.models)
    meanings = {name: f"{row.words}; learned from {row.knows}" for name, row in rows.items()}
    words = Section("ICR, recommended, no_slip, trial, σ …", [Facts(list((meanings | GLOSSARY).items()))], PAGE)
    blocks = [
        Title(run_title(summary), f"{driven_text(summary.drive)}, from {begun}.", about),
        *page_blocks(summary, report_document),
        Section("Log and settings", [streams_section(summary), *_settings(summary), made_from], name="log"),
        Section("Words on this page", [words], name="words"),
    ]
    return render(
        SCRIPTS, drive_data(compared, report, coordinates=coordinates), title=summary.log,
        kind="Drive without GNSS: report of one log", blocks=blocks, pictures=pictures,
        duration_s=summary.drive.duration_s, directions=[word.lower() for word in direction_words(summary)], groups=(),
        folded_models=len(rows) - len(shown_rows(list(rows))),
        sketch=drive_sketch(run, report_document),
    )  # fmt: skip


def page_blocks(document: RunDocument, report: DropoutDocument) -> list[Block]:
    """Return the blocks of the page of a run: answer, drive, errors, motion model, limits, warnings."""
    document = with_verdict(document, report)
    rows = [
        (
            event.kind, duration_text(event.begin_s), duration_text(event.end_s - event.begin_s),
            distance_text(event.distance_m), f"{100 * event.severity:.0f} %",
        )
        for event in document.events
    ]  # fmt: skip
    head = ("kind", "from", "lasts", "distance", "missing motion")
    caption = "Slip events: the robot did not move as its wheels did"
    events = Table("lr", rows, head, caption, [event.begin_s for event in document.events])
    drive = [
        Figure(("trajectory", "icr_estimates", "gnss_difference"), "drive", drive_charts(position_word(document))),
        Section("", [events], PAGE), *outage_blocks(report), Figure(("icr_clusters", "outages")),
    ]  # fmt: skip
    warnings = [finding.text for finding in document.notes if not is_grave(finding)]
    return [
        unusable_line(document), *(f"What to do: {step}" for step in (next_step(document),) if step),
        Section("Answer", _cards(document, report), name="answer"),
        controller_section(report),
        Section("The drive", drive, name="drive"),
        errors_section(report, document), worst_section(document, report), model_section(report),
        Section("Acceptance limits", verdict_lines(report), name="limits"),
        Section("Warnings", [Items(warnings) if warnings else "None."], PAGE, name="warnings"),
    ]  # fmt: skip


def _cards(document: RunDocument, report: DropoutDocument) -> list[Section]:
    """Return the answer as cards; the last card has the drive from above."""
    cards = []
    for section in answer_sections(document, report):
        blocks = [
            block._replace(caption="") if isinstance(block, Table) and block.caption == section.title else block
            for block in section.blocks
        ]
        # The checks of the card already state the reasons for care, except a change of ground.
        care = section.name == "trust" and section.grade == "care"
        cards.append(section._replace(blocks=blocks, text=document.partly_because or "" if care else section.text))
    up = "The drive from above, north up" if document.gnss.datum is not None else "The drive from above"
    marks = f"{up}; ○ start, ■ end{', red: the trial with the largest error' if report.worst else ''}."
    drawing = Figure((), "sketch", (Chart("sketch", up, marks),))
    if cards[-1].name != "worst-case":
        return [*cards, Section("The drive", [drawing], name="worst-case")]
    return [*cards[:-1], cards[-1]._replace(blocks=[drawing])]


def _settings(document: RunDocument) -> list[Section]:
    """Return the sections with the chosen streams, the findings about them, and the configuration of a run."""
    stream_blocks: list[Block] = [
        Facts([(role_word(document, stream.role), stream.why) for stream in document.streams])
    ]
    alignment = []
    for name, finding in document.alignment.items():
        value, applied = plus_minus(finding.value, finding.std, 4, ""), plus_minus(finding.applied or None, None, 4, "")
        alignment.append((name, value, applied, finding.why))
    caption = "Alignment of the streams: findings and corrections"
    stream_blocks.append(Table("lrrl", alignment, ("estimate", "value ± σ", "applied", "why"), caption))
    return [
        Section("Reasons for these streams, and findings about them", stream_blocks, PAGE),
        Section("Configuration that the run was made with", [Line(format_settings(document.config), "as is")], PAGE),
    ]


def read_report(directory: Path) -> DropoutDocument | None:
    """Return the content of the report.json in a run directory; None if the run has no report.

    Raises
    ------
    RunError
        Another version wrote the report, or it was edited.
    """
    name = f"{DROPOUT_DIRECTORY}/{REPORT_FILE}"
    file = directory / name
    if not os.path.lexists(file):
        return None
    if name in (sums := _checksums(directory)):
        check_sum(directory, name, sums)
    if schema_of(Below(directory, name)) != DROPOUT_SCHEMA:
        raise RunError(file, f"is not a report of schema {DROPOUT_SCHEMA}", "make it again with icrtool dropout-report")
    try:
        return read_document(Below(directory, name), DropoutDocument)
    except (ValueError, RecursionError) as err:
        why = f"is not as this version of icrtool writes it ({err})"
        raise RunError(file, why, "make it again with icrtool dropout-report") from err


def pictures_of_run(directory: Path | None) -> dict[str, Picture]:
    """Return the pictures of a run and of its dropout report by name; none without a directory."""
    if directory is None:
        return {}
    sums = _checksums(directory)
    return pictures_in(Below(directory, "plots"), sums) | pictures_in(
        Below(directory, f"{DROPOUT_DIRECTORY}/plots"), sums
    )


def _checksums(directory: Path) -> dict[str, str]:
    """Return the checksums of the files of a run by path; none if the run has no list of checksums."""
    return read_sums(directory) if os.path.lexists(directory / CHECKSUM_FILE) else {}


def draw_pictures(run: Run) -> dict[str, Picture]:
    """Return new pictures of a run by name."""
    from icrtool.output.figure_catalogue import figures_of

    return drawn_pictures(figures_of("run", run))


def without_place(run: Run, report: DropoutDocument) -> tuple[RunDocument, DropoutDocument]:
    """Return the documents of a run and its report without the datum, with the first state as origin.

    Notes
    -----
    The coordinates of a metric position reference may be map coordinates, so their origin is moved, too. Magnetic
    declination and grid convergence would show the place roughly, so they are left out, also in the texts of notes.
    """
    document, changed = run.document, msgspec.structs.replace
    north, east = float(run.table.north_m[0]), float(run.table.east_m[0])
    cause, datum, notes = document.heading.offset_name, document.gnss.datum, document.notes
    report_notes = report.notes
    if cause:
        notes, report_notes = (
            tuple(changed(finding, text=finding.text.replace(cause, "its cause is left out")) for finding in findings)
            for findings in (notes, report_notes)
        )
    document_without = changed(
        document,
        config=replace(document.config, frames=replace(document.config.frames, datum=None)),
        notes=notes,
        warnings=warnings_of(notes),
        gnss=changed(document.gnss, datum=None if datum is None else (math.nan, math.nan, math.nan)),
        heading=changed(document.heading, offset_name=None, magnetic_declination_deg=None, utm_convergence_deg=None),
    )
    moved = (changed(trial, north_m=trial.north_m - north, east_m=trial.east_m - east) for trial in report.worst)
    return document_without, changed(report, worst=tuple(moved), notes=report_notes, warnings=warnings_of(report_notes))


def fleet_page(document: FleetDocument, folder: Path) -> str:
    """Return the page of a fleet as HTML.

    Parameters
    ----------
    document : content of fleet.json
    folder : folder of the batch; the page links to the pages of logs in it
    """
    logs, title, counts = document.logs, folder.absolute().name, document.counts
    unusable = sum(log.status == "done" and not log.usable for log in logs)
    skipped = f" ({counts.skipped} of them before, skipped this time)" if counts.skipped else ""
    counts_text = [f"{counts.done - unusable} can be used", f"{unusable} cannot", f"{counts.failed} failed{skipped}"]
    counts_text += [f"acceptance limits not met: {document.gates_failed}"] if document.gates_failed else []
    about = f"{len(logs)} logs: {', '.join(counts_text)}. Made with icrtool {document.tool_version}."
    # The first part of ``why; advice`` is the reason without details of a single log.
    reasons = Counter(log.reason.split(";")[0].split(" (tried")[0] for log in logs if log.status == "failed")
    why = Table("lr", [(reason, f"{count}") for reason, count in reasons.most_common()], ("reason", "logs"))
    pictures = pictures_in(Below(folder, "plots"))
    blocks: list[Block] = [
        Title(title, about),
        Section("Each robot, from all its logs together", [_robots_table(document.calibrations)], name="robots"),
        Section("All logs together", [Figure(tuple(pictures), folded=False)] if pictures else [], name="pictures"),
        Section("Logs", [_logs_table(logs, folder)], name="logs"),
        Section("Why logs failed", [why], name="failed"),
    ]
    kind = "Drive without GNSS: report of many logs"
    return render(("fleet.js",), None, title=title, kind=kind, blocks=blocks, pictures=pictures)


def _robots_table(calibrations: Sequence[FleetCalibration]) -> Table:
    """Return the table of the calibrations: the numbers of each robot from all its logs."""
    grouped = any(calibration.group for calibration in calibrations)
    rows: list[list[str | Cell]] = []
    incomplete = any(calibration.left_out for calibration in calibrations)
    labels = {name: model.label for name, model in MODELS.items()}
    for calibration in calibrations:
        numbers = [Cell(calibration.reason), Cell("")]
        if calibration.multiplier is not None:
            reach = calibration.within
            _, distance, _, between = ("", "–", "", "") if reach is None else reach_row(reach)
            numbers = [
                Cell(f"{calibration.multiplier:.3f}", f"± {calibration.multiplier_std:.3f}"),
                Cell(distance, more=(between,) if between else ()),
            ]
        icrs = ", ".join(map(signed_text, calibration.icrs_m))
        group_cell = [calibration.group] if grouped else []
        left_out = [", ".join(calibration.left_out)] if incomplete else []
        model = labels.get(calibration.recommended, calibration.recommended)
        rows.append(
            [
                calibration.robot or "all logs",
                *numbers,
                *group_cell,
                f"{len(calibration.logs)}",
                icrs,
                model,
                calibration.file,
                *left_out,
            ]
        )
    group, omitted = ("group",) if grouped else (), ("left out",) if incomplete else ()
    head = ("robot", "multiplier", "within 0.5 m (95 %)", *group, "logs", "ICRs right, left, x [m]",
            "motion model", "calibration file", *omitted)  # fmt: skip
    return Table(
        f"lrr{'l' * grouped}rrll{'l' * incomplete}", rows, head, "Each log was predicted by a fit to the other logs"
    )


def _logs_table(logs: Sequence[FleetLog], folder: Path) -> Table:
    """Return the table of the logs: a row links to the page of its log; a failed log has no numbers."""
    varied = [key for key in ("robot", "group") if len({getattr(log, key) for log in logs} - {""}) > 1]
    # Distances within a budget come from the best model that at least one log has.
    distances = dict.fromkeys(name for log in logs for name in log.errors if "_within_" in name)
    by_model = ([name for name in distances if name.startswith(f"{model}_within_")] for model in IN_CSV)
    budgets = next(filter(None, by_model), [])
    numbers_of = [_columns(log, budgets) for log in logs]
    filled = [name for name in next(iter(numbers_of), ()) if any(columns[name].text for columns in numbers_of)]
    numbers_of = [{name: columns[name] for name in filled} for columns in numbers_of]
    rows, search = [], []
    for log, columns in zip(logs, numbers_of, strict=True):
        status = Cell("not usable", note=log.reason) if log.status == "done" and not log.usable else log.status
        names = [getattr(log, key) for key in varied]
        page = PurePosixPath(log.run) / PAGE_FILE
        # The page of a log is linked only if it exists and lies in the folder.
        link = "" if page.is_absolute() or not is_regular(Below(folder, page)) else f"./{quote(str(page))}"
        numbers = [log.reason] if log.status == "failed" else columns.values()
        rows.append([Cell(log.log, link=link), status, *names, *numbers])
        words = (log.log, log.status, log.robot, log.group, log.reason, *log.tags)
        chosen = {key: getattr(log, key) for key in ("status", "robot", "group")}
        search.append({"words": " ".join(words).casefold()} | chosen)
    caption = (
        f"The name of a log opens its page. Error: 95 % of the trials of {CHOICE_HORIZON_M:g} m stay below it; the "
        "95 % interval stands under it. Next drive: 9 of 10 further drives on this ground stay within the budget over "
        "this distance, with the row in the column before."
    )
    head = ("log", "status", *varied, *next(iter(numbers_of), ()))
    return Table(f"ll{'l' * len(varied)}r", rows, head, caption, search=search, folded=_folded_columns(logs))


def _columns(log: FleetLog, budgets: Sequence[str]) -> dict[str, Cell]:
    """Return the cells of a log by the name of the column; `budgets` are keys of distances in `log.errors`."""
    day, _, time = log.start_utc.removesuffix("Z").partition("T")
    columns = {
        "start": Cell(day, order=log.start_utc, more=(time[:5],) if time else ()),
        "duration": _cell(log.duration_s, duration_text),
        "distance": _cell(log.distance_m, distance_text),
    }
    for name in budgets:
        bound, (row, _, budget) = "> " if name in log.bounds else "", name.removesuffix("m_m").rpartition("_within_")
        columns[f"{row} within {budget} m"] = _cell(log.errors.get(name), partial("{}{:.1f} m".format, bound))
        columns[f"next drive, {budget} m"] = _cell(
            log.errors.get(next_low_name(row, float(budget))), "≥ {:.1f} m".format
        )
    for model in IN_CSV:
        columns[_error_column(model)] = _error_cell(log, model)
    multiplier, _, std = plus_minus(log.multiplier, log.multiplier_std, sign="").partition(" ± ")
    columns["multiplier"] = _cell(log.multiplier, lambda _: multiplier)._replace(more=(f"± {std}",) if std else ())
    for name, word in ICR_WORDS.items():
        columns[f"ICR {word}"] = _with_std(log.icr.get(name), log.icr.get(f"std_{name}"), "+")
    return columns | {
        "events": _cell(log.events, str),
        "warnings": _cell(log.warnings, str)._replace(note=", ".join(log.codes)),
        "limits not met": _cell(log.gates_failed, str),
    }


def _error_cell(log: FleetLog, model: str) -> Cell:
    """Return the cell of the 95 % error of a model at `CHOICE_HORIZON_M`, with its interval if it is known."""
    p95, low, high = (
        log.errors.get(f"{model}_{number}_{CHOICE_HORIZON_M:g}m_m") for number in ("p95", "p95_low", "p95_high")
    )
    interval = "" if low is None or high is None else f"{error_text(low).removesuffix(' m')}-{error_text(high)}"
    return _cell(p95, error_text)._replace(more=(interval,) if interval else ())


def _error_column(model: str) -> str:
    """Return the name of the column with the errors of a model."""
    return f"error, {model}"


def _folded_columns(logs: Sequence[FleetLog]) -> list[str]:
    """Return the names of the columns of a fleet that a page shows only on demand.

    Notes
    -----
    These are further rows, ICRs, events, and acceptance limits if all are met. The other columns fit on a screen of
    1280 pixels.
    """
    names = {name.partition("_p95_")[0] for log in logs for name in log.errors}
    unfolded = (CONTROLLER, MAIN_ROW if MAIN_ROW in names else FALLBACK_ROW, "no_slip")
    further = [_error_column(model) for model in IN_CSV if model not in unfolded]
    limits = [] if any(log.gates_failed for log in logs) else ["limits not met"]
    return [*further, *(f"ICR {word}" for word in ICR_WORDS.values()), "events", *limits]


def _cell(value: float | None, text: Callable[[Any], str]) -> Cell:
    """Return the cell of a number; an unknown number is an empty cell, which is always sorted last."""
    return Cell("", order="") if value is None else Cell(text(value), order=value)


def _with_std(value: float | None, std: float | None, sign: str) -> Cell:
    """Return the cell of a number with its standard deviation; `sign` is ``+`` to print the sign of any number."""
    return _cell(value, lambda number: plus_minus(number, std, sign=sign))


def calibration_page(calibration: Calibration) -> str:
    """Return the page of a calibration as HTML."""
    title = calibration.name or calibration.robot.name or "calibration"
    return render(
        (COPY,), None, title=title, kind="Drive without GNSS: calibration of a robot",
        blocks=calibration_file_blocks(calibration, title), geometry=geometry_sketch(calibration),
    )  # fmt: skip


COMPARISON_FAMILY = "icrtool/compare/"
"""First part of the schema of a comparison, without its version."""


def comparison_page(comparison: GroupComparison, title: str) -> str:
    """Return the page of a comparison as HTML."""
    from icrtool.output.figures.calibrations import transfer

    names, labels = list(comparison.groups), {name: model.label for name, model in MODELS.items()}
    groups = "; ".join(
        f"{name}: {counted(len(group.logs), 'log')}, {labels.get(group.model, group.model)}"
        for name, group in comparison.groups.items()
    )
    # Each group has the errors of all calibrations in its runs, over distance.
    by_group: list[dict[str, object]] = []
    looks = rows_of(f"calibration:{name}" for name in names)
    for tested_on in names:
        rows = {
            (cell.calibrated_on, cell.horizon_m): cell for cell in comparison.transfer if cell.tested_on == tested_on
        }
        horizons = sorted({horizon_m for _, horizon_m in rows})
        models = [
            {
                "name": f"of {name}",
                "label": f"calibration of {name}{' (held out)' if name == tested_on else ''}",
                "shown": True,
                **row_look(looks[f"calibration:{name}"]),
            }
            | {key: [getattr(rows.get((name, h)), f"{key}_m", None) for h in horizons] for key in ERROR_KEYS}
            for name in names
        ]
        by_group.append({"horizons_m": horizons, "models": models, "reference": {"p95": [], "expected": []}})
    # The chart first shows the group in which a foreign calibration adds the largest error.
    costs = [cost for cost in comparison.costs if cost.horizon_m == CHOICE_HORIZON_M and cost.p95_m is not None]
    costliest = max(costs or comparison.costs, key=lambda cost: cost.p95_m or 0.0, default=None)
    verdict = comparison_title(comparison)
    sections = [
        block for block in transfer_blocks(comparison) if len(comparison.pairs) > 1 or not isinstance(block, str)
    ]
    sections = [
        _comparison_answer(comparison, block) if isinstance(block, Section) and block.name == "verdict" else block
        for block in sections
    ]
    return render(
        (*VENDOR, "columns.js", "charts.js", "comparison.js"), {"by_group": by_group}, title=title,
        kind=f"Drive without GNSS: groups of runs compared ({title})",
        blocks=[verdict._replace(about=f"Groups: {groups}."), *sections], drawn=group_sketch(comparison), groups=names,
        opened="" if costliest is None else costliest.tested_on, folded_models=0,
        pictures=drawn_pictures([("transfer", transfer(comparison))]),
    )  # fmt: skip


def _comparison_answer(comparison: GroupComparison, verdict: Section) -> Section:
    """Return the answer of a comparison as cards: errors of the groups, a chart, and the verdicts."""
    horizon_text = f"after {CHOICE_HORIZON_M:g} m"
    own_errors = (cell for cell in comparison.transfer if cell.calibrated_on == cell.tested_on)
    rows = [_row_of_errors(cell.tested_on, cell, "") for cell in own_errors if cell.horizon_m == CHOICE_HORIZON_M]
    for pair in comparison.pairs:
        at_choice = (difference for difference in pair.errors if difference.horizon_m == CHOICE_HORIZON_M)
        rows += [_row_of_errors(f"{pair.second} − {pair.first}", difference, "+") for difference in at_choice]
    errors = Table("lrr", [row for row in rows if row[1]], (f"95 % error {horizon_text}", "error", "95 % interval"))
    chart = Chart(
        "groups",
        f"95 % error {horizon_text} of each group",
        f"95 % error {horizon_text} of each group, with 95 % interval.",
    )
    cards = [
        Section("How large is the error?", [errors], name="reach"),
        Section("Side by side", [Figure((), "groups", (chart,))], name="worst-case"),
        verdict._replace(name="trust"),
    ]
    return Section("Answer", cards, name="answer")


def _row_of_errors(name: str, error: ErrorsAt, sign: str) -> tuple[str, str, str]:
    """Return the row of a 95 % error [m]: name, error, interval; unknown numbers are empty texts."""
    if error.p95_m is None:
        return name, "", ""
    known = error.p95_low_m is not None and error.p95_high_m is not None
    interval = f"{error.p95_low_m:{sign}z.2f} to {error.p95_high_m:{sign}z.2f} m" if known else "too short"
    return name, f"{error.p95_m:{sign}z.2f} m", interval


def comparison_in(place: Path) -> Place | None:
    """Return the file of a comparison: `place` itself, or the first such file in this folder; None if there is none."""
    files: list[Place] = [place]
    if place.is_dir():
        files = [Below(place, file.name) for file in sorted(place.glob("*.json"))]
    return next((file for file in files if schema_of(file).startswith(COMPARISON_FAMILY)), None)
