"""Pages of many logs: ``report.html`` of a batch, whose table leads to the pages of the logs, and of a comparison."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import quote

from icrtool.motion.models import FAMILY
from icrtool.output.files.formats import read_document, schema_of
from icrtool.output.page.drive_data import ERROR_KEYS
from icrtool.output.page.render import drawn_pictures, pictures_in, render
from icrtool.output.run_directory import PAGE_FILE
from icrtool.output.tables.calibration import transfer_blocks
from icrtool.output.text_blocks import Block, Cell, Figure, Section, Table, Title
from icrtool.output.text_format import MODEL_WORDS, distance_text, duration_text, error_text, signed
from icrtool.records.calibration_document import GroupComparison, TransferCell
from icrtool.records.fleet_document import FleetCalibration, FleetDocument, FleetLog
from icrtool.records.regular_file import is_regular
from icrtool.records.text import counted

PLOTS = "plots"

HORIZON_M = 10.0
"""At this distance the table shows the errors of each model."""

MODELS = MODEL_WORDS


class Sortable(NamedTuple):
    """One cell of the table: what is shown, and the number it is sorted by (None: nothing to show)."""

    text: str
    order: float | str | None


class Line(NamedTuple):
    """One log of the table.

    Attributes
    ----------
    log : what fleet.json holds of it
    link : relative address of its page; empty where there is none
    search : what words are looked for in
    """

    log: FleetLog
    link: str
    search: str
    cells: tuple[Sortable, ...]


def fleet_page(document: FleetDocument, folder: Path) -> str:
    """Return the page of a fleet as HTML.

    Parameters
    ----------
    folder : of the batch; pages of logs that are there are linked
    """
    logs = document.logs
    budgets = _budgets(logs)
    lines = [Line(log, _link(log.run, folder), _search_text(log), tuple(_cells(log, budgets))) for log in logs]
    choices = {key: sorted({getattr(log, key) for log in logs} - {""}) for key in ("status", "robot", "group")}
    title = folder.absolute().name
    blocks: list[Block] = [Title(title, _counts_text(document))]
    if document.calibrations:
        blocks.append(Section("The robot, from all logs together", [_robots(document.calibrations)], name="robots"))
    blocks.append(Section("Logs", [Figure((), "fleet")], name="logs"))
    if reasons := Counter(_reason(log) for log in logs if log.status == "failed").most_common():
        table = Table("lr", [(reason, f"{count}") for reason, count in reasons], ("reason", "logs"))
        blocks.append(Section("Why logs failed", [table], name="failed"))
    if pictures := pictures_in(folder / PLOTS, folder):
        blocks.append(Section("All logs together", [Figure(tuple(pictures), folded=False)], name="pictures"))
    return render(
        ("fleet.js",), None, title=title, kind="Drive without GNSS: report of many logs", blocks=blocks, lines=lines,
        columns=_columns(budgets), choices=choices, pictures=pictures, horizon_m=HORIZON_M,
        named=[key for key in ("robot", "group") if len(choices[key]) > 1],
    )  # fmt: skip


def _counts_text(document: FleetDocument) -> str:
    """Return how many logs can be used, and how many not."""
    counts, unusable = document.counts, sum(log.status == "done" and not log.usable for log in document.logs)
    skipped = f" ({counts.skipped} of them before, skipped this time)" if counts.skipped else ""
    found = [f"{counts.done - unusable} can be used", f"{unusable} cannot", f"{counts.failed} failed{skipped}"]
    found += [f"acceptance limits not met: {document.gates_failed}"] if document.gates_failed else []
    return f"{len(document.logs)} logs: {', '.join(found)}. Made with icrtool {document.tool_version}."


def _robots(calibrations: Sequence[FleetCalibration]) -> Table:
    """Return what each robot's logs teach together."""
    grouped = any(one.group for one in calibrations)
    rows: list[list[str | Cell]] = []
    for one in calibrations:
        numbers = [Cell(one.reason), Cell("")]
        if one.multiplier is not None:
            within = "–" if one.within_m is None else f"{'more than ' if one.within_beyond else ''}{one.within_m:.1f} m"
            numbers = [Cell(f"{one.multiplier:.3f}", f"± {one.multiplier_std:.3f}"), Cell(within)]
        icrs = ", ".join(map(signed, one.icrs_m))
        more = [one.group] if grouped else []
        rows.append([one.robot or "all logs", *numbers, *more, f"{len(one.logs)}", icrs, ", ".join(one.left_out)])
    group = ("group",) if grouped else ()
    head = ("robot", "multiplier", "within 0.5 m (95 %) for", *group, "logs", "ICRs right, left, x [m]", "left out")
    return Table(f"lrr{'l' * grouped}rrl", rows, head, "Each log was predicted without itself")


def _reason(log: FleetLog) -> str:
    """Return why a log failed without what is particular to it: the first part of ``why; advice``."""
    return log.reason.split(";")[0].split(" (tried")[0]


def _budgets(logs: Sequence[FleetLog]) -> list[str]:
    """Return the error names of distances within a budget, of the best model that some log has."""
    names = dict.fromkeys(name for log in logs for name in log.errors if "_within_" in name)
    by_model = ([name for name in names if name.startswith(f"{model}_within_")] for model in MODELS)
    return next(filter(None, by_model), [])


def _columns(budgets: Sequence[str]) -> list[str]:
    within = [f"within {name.rpartition('_within_')[2].removesuffix('m_m')} m for" for name in budgets]
    errors = [f"error, {label}" for label in MODELS.values()]
    found = ["multiplier", "ICR y right", "ICR y left", "ICR x", "distance", "duration", "start"]
    return [*within, *errors, *found, "events", "warnings", "limits not met"]


def _search_text(log: FleetLog) -> str:
    words = (log.log, log.status, log.robot, log.group, log.reason, *log.tags)
    return " ".join(words).casefold()


def _cells(log: FleetLog, budgets: Sequence[str]) -> Iterator[Sortable]:
    icr, errors = log.icr, log.errors
    for name in budgets:
        yield _within(log, name)
    for model in MODELS:
        yield _cell(errors.get(f"{model}_p95_{HORIZON_M:g}m_m"), error_text)
    yield _with_std(log.multiplier, log.multiplier_std, "")
    for name in ("y_icr_right_m", "y_icr_left_m", "x_icr_m"):
        yield _with_std(icr.get(name), icr.get(f"std_{name}"), "+")
    yield _cell(log.distance_m, distance_text)
    yield _cell(log.duration_s, duration_text)
    yield Sortable(log.start_utc.replace("T", " ").removesuffix("Z"), log.start_utc or None)
    for count in (log.events, log.warnings, log.gates_failed):
        yield Sortable("" if count is None else f"{count}", count)


def _within(log: FleetLog, name: str) -> Sortable:
    """Return a distance within a budget; it may be a lower bound."""
    beyond = name in log.bounds
    return _cell(log.errors.get(name), lambda metres: f"{'> ' if beyond else ''}{metres:.1f} m")


def _cell(value: float | None, text: Any) -> Sortable:  # noqa: ANN401 - one of the functions of text_format
    return Sortable("", None) if value is None else Sortable(text(value), value)


def _with_std(value: float | None, std: float | None, sign: str) -> Sortable:
    spread = f" ± {std:.3f}" if std is not None else ""
    return _cell(value, lambda number: f"{number:{sign}.3f}{spread}".replace("-", "−"))


def _link(run: str, folder: Path) -> str:
    """Return the relative address of a log's page; empty where it is not there, or would lead out of the folder."""
    path = PurePosixPath(run)
    if path.is_absolute() or not is_regular(folder / path / PAGE_FILE, folder):
        return ""
    return f"./{quote(str(path / PAGE_FILE))}"


SCRIPTS = ("vendor/uPlot.iife.min.js", "vendor/d3.min.js", "columns.js", "charts.js", "comparison.js")

COMPARISON_FAMILY = "icrtool/compare/"


def comparison_page(found: GroupComparison, title: str) -> str:
    """Return the page of a comparison as HTML."""
    from icrtool.output.figures.calibrations import transfer

    names = list(found.groups)
    labels = {name: model.label for name, model in FAMILY.items()}
    groups = "; ".join(
        f"{name}: {counted(len(one.logs), 'log')}, model {labels.get(one.model, one.model)}"
        for name, one in found.groups.items()
    )
    return render(
        SCRIPTS, {"by_group": [_errors(found.transfer, names, name) for name in names]}, title=title,
        kind="Drive without GNSS: groups of runs compared",
        blocks=[Title(f"{', '.join(names)} ({title})", groups), *transfer_blocks(found)],
        names=names, pictures=drawn_pictures([("transfer", transfer(found))]),
    )  # fmt: skip


def _errors(cells: Sequence[TransferCell], names: Sequence[str], tested_on: str) -> dict[str, object]:
    """Return the errors in the runs of one group over distance, by the group of the calibration."""
    mine = [one for one in cells if one.tested_on == tested_on]
    horizons = sorted({one.horizon_m for one in mine})
    rows = {(one.calibrated_on, one.horizon_m): one for one in mine}
    return {
        "horizons_m": horizons,
        "models": [
            {"name": f"of {name}", "label": f"calibration of {name}{' (held out)' if name == tested_on else ''}"}
            | {key: [getattr(rows.get((name, h)), f"{key}_m", None) for h in horizons] for key in ERROR_KEYS}
            for name in names
        ],
        "reference": {"p95": [], "expected": []},
    }


def read_comparison(file: Path, inside: Path | None = None) -> GroupComparison:
    """Return what ``icrtool compare -o`` wrote.

    Raises
    ------
    OSError, ValueError, RecursionError
        It cannot be read, or is not of this version.
    """
    return read_document(file, GroupComparison, inside)


def comparison_in(place: Path) -> Path | None:
    """Return the file of a comparison: `place` itself, or the one in that folder; None where there is none."""
    inside = place if place.is_dir() else None
    files = [place] if inside is None else sorted(place.glob("*.json"))
    return next((file for file in files if schema_of(file, inside).startswith(COMPARISON_FAMILY)), None)
