"""Pages of many logs: ``report.html`` of a batch, whose table leads to the pages of the logs, and of a comparison."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

from icrtool.motion.models import FAMILY
from icrtool.output.files.formats import read_document, schema_of
from icrtool.output.page.drive_data import ERROR_KEYS
from icrtool.output.page.render import drawn_pictures, pictures_in, render
from icrtool.output.run_directory import PAGE_FILE
from icrtool.output.tables.calibration import transfer_blocks
from icrtool.output.text_blocks import Block, Cell, Figure, Section, Table, Title
from icrtool.output.text_format import MODEL_WORDS, duration_text, error_text, signed
from icrtool.records.calibration_document import GroupComparison, TransferCell
from icrtool.records.fleet_document import FleetCalibration, FleetDocument, FleetLog
from icrtool.records.places import is_regular
from icrtool.records.run import ICR_WORDS
from icrtool.records.text import counted, distance_text

PLOTS = "plots"

HORIZON_M = 10.0
"""At this distance the table shows the errors of each model."""


def fleet_page(document: FleetDocument, folder: Path) -> str:
    """Return the page of a fleet as HTML.

    Parameters
    ----------
    folder : of the batch; pages of logs that are there are linked
    """
    logs, title = document.logs, folder.absolute().name
    blocks: list[Block] = [Title(title, _counts_text(document))]
    if document.calibrations:
        blocks.append(Section("The robot, from all logs together", [_robots(document.calibrations)], name="robots"))
    blocks.append(Section("Logs", [_logs_table(logs, folder)], name="logs"))
    if reasons := Counter(_reason(log) for log in logs if log.status == "failed").most_common():
        table = Table("lr", [(reason, f"{count}") for reason, count in reasons], ("reason", "logs"))
        blocks.append(Section("Why logs failed", [table], name="failed"))
    if pictures := pictures_in(folder / PLOTS, folder):
        blocks.append(Section("All logs together", [Figure(tuple(pictures), folded=False)], name="pictures"))
    kind = "Drive without GNSS: report of many logs"
    return render(("fleet.js",), None, title=title, kind=kind, blocks=blocks, pictures=pictures)


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
    by_model = ([name for name in names if name.startswith(f"{model}_within_")] for model in MODEL_WORDS)
    return next(filter(None, by_model), [])


def _logs_table(logs: Sequence[FleetLog], folder: Path) -> Table:
    """Return a line a log, which leads to its page; of one that failed the reason stands in place of its numbers."""
    named = [key for key in ("robot", "group") if len({getattr(log, key) for log in logs} - {""}) > 1]
    columns, rows, search = _columns(logs), [], []
    for log in logs:
        status = Cell("not usable", note=log.reason) if log.status == "done" and not log.usable else log.status
        numbers = [log.reason] if log.status == "failed" else [cell(log) for cell in columns.values()]
        names = [getattr(log, key) for key in named]
        rows.append([Cell(log.log, link=_link(log.run, folder)), status, *names, *numbers])
        words = (log.log, log.status, log.robot, log.group, log.reason, *log.tags)
        chosen = {key: getattr(log, key) for key in ("status", "robot", "group")}
        search.append({"words": " ".join(words).casefold()} | chosen)
    caption = f"One line a log; its name opens its page. Errors: 95 % of the trials of {HORIZON_M:g} m stay below."
    head = ("log", "status", *named, *columns)
    return Table(f"ll{'l' * len(named)}r", rows, head, caption, search=search)


def _columns(logs: Sequence[FleetLog]) -> dict[str, Callable[[FleetLog], Cell]]:
    """Return what the table shows of a log, by the name of its column."""
    within = {
        f"within {name.rpartition('_within_')[2].removesuffix('m_m')} m for": partial(_within, name=name)
        for name in _budgets(logs)
    }
    errors = {label: f"{model}_p95_{HORIZON_M:g}m_m" for model, label in MODEL_WORDS.items()}
    return {
        **within,
        **{f"error, {label}": partial(_error, name=name) for label, name in errors.items()},
        "multiplier": lambda log: _with_std(log.multiplier, log.multiplier_std, ""),
        **{f"ICR {word}": partial(_icr, name=name) for name, word in ICR_WORDS.items()},
        "distance": lambda log: _cell(log.distance_m, distance_text),
        "duration": lambda log: _cell(log.duration_s, duration_text),
        "start": lambda log: Cell(log.start_utc.replace("T", " ").removesuffix("Z"), order=log.start_utc),
        "events": lambda log: _cell(log.events, str),
        "warnings": lambda log: _cell(log.warnings, str),
        "limits not met": lambda log: _cell(log.gates_failed, str),
    }


def _within(log: FleetLog, name: str) -> Cell:
    """Return a distance within a budget; it may be a lower bound."""
    beyond = name in log.bounds
    return _cell(log.errors.get(name), lambda metres: f"{'> ' if beyond else ''}{metres:.1f} m")


def _error(log: FleetLog, name: str) -> Cell:
    return _cell(log.errors.get(name), error_text)


def _icr(log: FleetLog, name: str) -> Cell:
    return _with_std(log.icr.get(name), log.icr.get(f"std_{name}"), "+")


def _cell(value: float | None, text: Callable[[Any], str]) -> Cell:
    """Return a number of a log; what is not known stands last, whatever the order."""
    return Cell("", order="") if value is None else Cell(text(value), order=value)


def _with_std(value: float | None, std: float | None, sign: str) -> Cell:
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
