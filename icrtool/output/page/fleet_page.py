"""The page of a fleet: ``report.html`` in the folder of a batch, a table that leads to the logs' pages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import quote

from icrtool.output.page.pictures import pictures_in
from icrtool.output.page.render import render
from icrtool.output.run_directory import PAGE_FILE
from icrtool.output.text_format import MODEL_WORDS, distance_text, duration_text, error_text
from icrtool.records.fleet_document import FleetDocument, FleetLog
from icrtool.records.regular_file import is_regular

PLOTS = "plots"

HORIZON_M = 10.0
"""At this distance the table shows the errors of each model."""

MODELS = MODEL_WORDS


class Cell(NamedTuple):
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
    cells: tuple[Cell, ...]


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
    return render(
        "fleet.html", ("fleet.js",), None, title=folder.absolute().name, lines=lines, columns=_columns(budgets),
        counts=document.counts, gates_failed=document.gates_failed, made_with=document.tool_version,
        choices=choices, named=[key for key in ("robot", "group") if len(choices[key]) > 1],
        unusable=sum(log.status == "done" and not log.usable for log in logs),
        horizon_m=HORIZON_M, calibrations=document.calibrations,
        pictures=list(pictures_in(folder / PLOTS, folder).values()),
        reasons=Counter(_reason(log) for log in logs if log.status == "failed").most_common(),
    )  # fmt: skip


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


def _cells(log: FleetLog, budgets: Sequence[str]) -> Iterator[Cell]:
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
    yield Cell(log.start_utc.replace("T", " ").removesuffix("Z"), log.start_utc or None)
    for count in (log.events, log.warnings, log.gates_failed):
        yield Cell("" if count is None else f"{count}", count)


def _within(log: FleetLog, name: str) -> Cell:
    """Return a distance within a budget; it may be a lower bound."""
    beyond = name in log.bounds
    return _cell(log.errors.get(name), lambda metres: f"{'> ' if beyond else ''}{metres:.1f} m")


def _cell(value: float | None, text: Any) -> Cell:  # noqa: ANN401 - one of the functions of text_format
    return Cell("", None) if value is None else Cell(text(value), value)


def _with_std(value: float | None, std: float | None, sign: str) -> Cell:
    spread = f" ± {std:.3f}" if std is not None else ""
    return _cell(value, lambda number: f"{number:{sign}.3f}{spread}".replace("-", "−"))


def _link(run: str, folder: Path) -> str:
    """Return the relative address of a log's page; empty where it is not there, or would lead out of the folder."""
    path = PurePosixPath(run)
    if path.is_absolute() or not is_regular(folder / path / PAGE_FILE, folder):
        return ""
    return f"./{quote(str(path / PAGE_FILE))}"
