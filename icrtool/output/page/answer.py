"""The answer that a page begins with: how far without GNSS, which numbers for the controller, whether to trust it."""

from __future__ import annotations

from typing import Any, Literal

from icrtool.calibration.record import Calibration, calibration_of
from icrtool.errors import DataError
from icrtool.output.exports.controllers import controller_rows, format_export
from icrtool.output.tables.brief import reach_rows, to_drive, trust
from icrtool.output.text_format import controller_error_text, error_text, event_kinds, excitation_text, jump_count
from icrtool.records.dropout import CHOICE_HORIZON_M
from icrtool.records.dropout_document import DropoutDocument
from icrtool.records.run_document import RunDocument
from icrtool.records.text import counted

Grade = Literal["good", "care", "bad", "fact"]
Check = tuple[Grade, str]
"""One reason to trust the numbers, or not to."""

SMALLEST_SHOWN = 0.0005
"""A standard deviation below this would be printed as zero."""


def answer_of(summary: RunDocument, report: DropoutDocument) -> dict[str, Any]:
    """Return what the page of a run states first.

    Parameters
    ----------
    summary : of the run, equal to its run.json
    report : what report.json holds

    Returns
    -------
    dict
        ``drive``: what to drive where a run that is not usable lacks turns;
        ``grade`` and ``verdict``: may the numbers be used, in one word and in one sentence; ``checks``: why;
        ``reaches``: budget [m], and label, distance and note of each model as `icrtool dropout-report` prints them;
        ``numbers``: name and value of what a controller is given, ``with_numbers``: the error with these alone,
        ``export``: configuration of a diff_drive_controller, ``model``: the recommended one; empty where there is none.
    """
    found = report.recommended
    calibration = calibration_of(found) if found is not None else None
    grade, sentence = trust(
        summary, passed=report.passed, events_left_out=report.without_events is not None
    )  # fmt: skip
    return {
        "drive": "" if summary.usable else to_drive(summary),
        "grade": grade,
        "verdict": f"{sentence[:1].upper()}{sentence[1:]}.",
        "checks": _checks(summary, report),
        "reaches": _reaches(summary, report),
        "numbers": _numbers(calibration),
        "with_numbers": controller_error_text(calibration.controller) if calibration is not None else "",
        "export": _export(calibration),
        "model": calibration.fitted.model.label if calibration is not None else "",
    }


def _reaches(summary: RunDocument, report: DropoutDocument) -> list[tuple[float, list[tuple[str, str, str]]]]:
    budgets = report.budgets
    given = [(one.name, one.label, one.fitted) for one in report.calibrations]
    events = len(summary.events)
    sizes = dict.fromkeys(one.budget_m for one in budgets)
    return [(size, rows) for size in sizes if (rows := reach_rows(budgets, given, size, events))]


def _numbers(calibration: Calibration | None) -> list[tuple[str, str]]:
    rows = controller_rows(calibration.controller_numbers()) if calibration is not None else []
    return [(name, _with_std(value, std)) for name, value, std in rows]


def _with_std(value: float, std: float) -> str:
    if std == 0.0:
        return f"{value:.3f}, not estimated"
    return f"{value:.3f} ± {std:.3f}" if std >= SMALLEST_SHOWN else f"{value:.3f}, σ below 0.001"


def _export(calibration: Calibration | None) -> str:
    try:
        return format_export(calibration, "diff_drive_controller") if calibration is not None else ""
    except DataError:
        return ""


def _checks(summary: RunDocument, report: DropoutDocument) -> list[Check]:
    """Return the reasons, the gravest first."""
    grades: dict[Grade, int] = {"bad": 0, "care": 1, "good": 2, "fact": 3}
    shown = summary.excitation.verdict.all_shown
    found: list[Check] = [("good" if shown else "care", f"The drive: {excitation_text(summary.excitation)}.")]
    found += [("good" if one.passed else "bad", f"Acceptance limit: {one.verdict}.") for one in report.gates]
    found += [*_incidents(summary, report), *_trials(report)]
    return sorted(found, key=lambda one: grades[one[0]])


def _incidents(summary: RunDocument, report: DropoutDocument) -> list[Check]:
    """Return what happened on the drive: warnings, slip, outages, rejected fixes, jumps."""
    gnss, events = summary.gnss, summary.events
    found: list[Check] = []
    if warnings := len(summary.warnings):
        found.append(("care", f"{counted(warnings, 'warning')} about the log."))
    if events:
        what = "the ICRs are not learned there" + ("" if report.without_events else ", but trials across them count")
        found.append(("care", f"{counted(len(events), 'slip event')} ({event_kinds(events)}): {what}."))
    if real := [one for one in report.outages if one.kind == "real"]:
        worst = max(real, key=lambda one: one.end_error_m or 0.0)
        error = f"{error_text(worst.end_error_m)} off after {worst.distance_m:.1f} m"
        found.append(("fact", f"{counted(len(real), 'real outage')}: in the worst the filter was {error}."))
    if of := gnss.used + gnss.rejected:
        share = 100 * gnss.rejected / of
        found.append(("fact", f"{gnss.rejected:,} of {of:,} positions ({share:.0f} %) were rejected."))
    if jumps := jump_count(summary.reference_jumps):
        counts = "trials across them count" if report.with_jumps else "no trial crosses a jump"
        found.append(("care", f"{jumps}: {counts}."))
    return found


def _trials(report: DropoutDocument) -> list[Check]:
    """Return how many trials the distances rest on, and what share of the error the reference itself may have."""
    rows = [row for row in report.trials if row.trials]
    if not rows:
        return [("bad", "No trial was long enough to measure an error.")]
    row = min(rows, key=lambda one: abs(one.horizon_m - CHOICE_HORIZON_M))
    horizon_m = row.horizon_m
    found: list[Check] = [
        ("fact", f"{row.trials:,} trials of {horizon_m:g} m were driven from {report.starts:,} states.")
    ]
    icr = [row for one in report.models if one.name == "icr" for row in one.by_horizon]
    own, p95 = (
        next((one.p95_m for one in table if one.horizon_m == horizon_m), None)
        for table in (report.reference_error, icr)
    )
    if own is not None and p95 is not None:
        share = f"Up to {error_text(own)}" if own < p95 else "All"
        what = f"the {error_text(p95)} error of the ICRs after {horizon_m:g} m (95 %)"
        found.append(("fact", f"{share} of {what} can be the error of the position reference."))
    return found
