"""The page of a run: ``report.html`` in its directory."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from icrtool.dropout_analysis.reference import with_smoothed_reference
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import RunError
from icrtool.motion.models import TERMS
from icrtool.output.dropout_directory import DROPOUT_DIRECTORY, REPORT_FILE, report_document
from icrtool.output.files.atomic import write_file
from icrtool.output.files.formats import CHECKSUM_FILE, read_sums, schema_of
from icrtool.output.files.own_files import is_page
from icrtool.output.page.answer import answer_of
from icrtool.output.page.drive_data import drive_data, in_order, main_rows
from icrtool.output.page.pictures import Picture, drawn_pictures, pictures_in
from icrtool.output.page.render import render
from icrtool.output.page.without_place import without_place
from icrtool.output.stored_run import check_sum
from icrtool.output.tables.dropout import shown_horizons
from icrtool.output.text_format import duration_text, error_text, position_word, role_word
from icrtool.records.dropout_document import DROPOUT_SCHEMA, DropoutDocument
from icrtool.records.plain_data import plain
from icrtool.records.regular_file import read_regular
from icrtool.records.run import ICR_WORDS, Run, check_type
from icrtool.records.run_document import RunDocument
from icrtool.records.text import escaped_texts

SCRIPTS = (
    "vendor/uPlot.iife.min.js",
    "vendor/d3.min.js",
    "columns.js",
    "open_loop.js",
    "charts.js",
    "map.js",
    "run.js",
)

TWINS = ("trajectory", "icr_estimates", "gnss_difference", "summary")
"""Pictures that a browser with scripts draws itself; they are for printing, and for readers without scripts."""


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
    page = run_page(run, report_document(report), pictures, coordinates=coordinates)
    write_file(Path(path), page, inside, ours=is_page if inside is not None else None)


def run_page(
    run: Run, report: DropoutDocument, pictures: Mapping[str, Picture], *, coordinates: bool = True
) -> str:  # fmt: skip
    """Return the page of a run as HTML.

    Parameters
    ----------
    run, coordinates : as in `write_page`
    report : what report.json holds
    pictures : by name; those that the page is to show where no script draws
    """
    document = msgspec.convert(plain(report), DropoutDocument)  # null for what is no number
    if not coordinates:
        pictures = _without_place(run, pictures)
        run, document = without_place(run, document)
    summary = run.document
    compared = with_smoothed_reference(run) if document.smoothed else run
    return render(
        "run.html", SCRIPTS, drive_data(compared, document, coordinates=coordinates),
        title=summary.log, summary=summary, report=document, answer=answer_of(summary, document),
        pictures=pictures, twins=TWINS, icr_words=ICR_WORDS, position_word=position_word(summary),
        warnings=[one.removeprefix(f"{summary.log}: ") for one in summary.warnings],
        streams=[(role_word(summary, one.role), one) for one in summary.streams],
        begun=_utc(int(run.table.stamp_ns[0])),
        errors=_error_rows(document), worst=_worst_rows(document, summary),
        config=_config_lines(summary.config.effective()),
        coordinates=coordinates, samples=len(run.table), worst_label=_worst_label(document),
        main_rows=main_rows(document), meanings={name: term.meaning for name, term in TERMS.items()},
    )  # fmt: skip


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
        return msgspec.convert(escaped_texts(json.loads(read_regular(file, directory))), DropoutDocument)
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


def _utc(stamp_ns: int) -> str:
    return f"{datetime.fromtimestamp(stamp_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _error_rows(report: DropoutDocument) -> dict[str, Any]:
    """Return the errors by model at the horizons of the table: those nearest to 1, 5, 10 and 20 m."""
    horizons = [row.horizon_m for row in report.trials]
    shown = shown_horizons(np.array(horizons))
    return {
        "heads": _heads([horizons[h] for h in shown]),
        "trials": [report.trials[h].trials for h in shown],
        "why_none": [report.trials[h].why_none for h in shown],
        "models": [
            {"name": one.name, "label": one.label, "knows": one.knows, "rows": [one.by_horizon[h] for h in shown]}
            for one in in_order(report.models)
        ],
        "reference": [report.reference_error[h] for h in shown] if report.reference_error else [],
    }


def _worst_rows(report: DropoutDocument, summary: RunDocument) -> list[dict[str, Any]]:
    """Return the worst trials, each with what happened meanwhile: jumps of the position, outages, slip."""
    found: list[dict[str, Any]] = []
    for one in report.worst:
        speed = one.speed_mean_mps
        end_s = one.t_s + (one.horizon_m / speed if speed else 0.0)
        end_ns = one.stamp_ns + round(1e9 * (end_s - one.t_s))
        sizes = [
            jump.size_m for jump in summary.reference_jumps if jump.begin_ns < end_ns and jump.end_ns > one.stamp_ns
        ]
        real = [out for out in report.outages if out.kind == "real"]
        lost = [out for out in real if out.begin_s < end_s and out.end_s > one.t_s]
        slips = [slip.kind for slip in summary.events if slip.begin_s < end_s and slip.end_s > one.t_s]
        notes = [f"the position steps by {error_text(max(sizes))}"] if sizes else []
        notes += [f"outage of {duration_text(out.end_s - out.begin_s)}" for out in lost[:1]]
        notes += [f"slip event ({kind})" for kind in dict.fromkeys(slips)]
        found.append({**msgspec.structs.asdict(one), "rank": len(found) + 1, "note": ", ".join(notes)})
    return found


def _worst_label(report: DropoutDocument) -> str:
    """Return the label of the model that the worst trials are of; in earlier versions the momentary ICRs."""
    name = next((one.model for one in report.worst), "icr")
    return next((f"the {one.label}" for one in report.models if one.name == name), name)


def _heads(horizons_m: Sequence[float]) -> list[str]:
    return [f"after {metres:g} m" for metres in horizons_m]


def _config_lines(config: Mapping[str, Any]) -> Sequence[str]:
    """Return the configuration a key a line, in the form of a configuration file."""
    lines = []
    for section, keys in config.items():
        lines.append(f"[{section}]")
        lines += [f"{key} = {json.dumps(value)}" for key, value in keys.items() if value is not None]
        lines.append("")
    return lines
