"""The answer that a page begins with: how far without GNSS, which numbers for the controller, whether to trust it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from icrtool.calibration.record import Calibration
from icrtool.calibration.stored import calibration_of
from icrtool.errors import DataError
from icrtool.output.exports.controllers import format_export
from icrtool.output.tables.dropout import reach_text
from icrtool.output.text_format import controller_error_text, error_text
from icrtool.records.dropout import CHOICE_HORIZON_M, BudgetDistance
from icrtool.records.run import ICR_WORDS
from icrtool.records.text import counted

Grade = Literal["good", "care", "bad", "fact"]

IN_SAMPLE = {"icr_final": "ICR, final (fitted to the same drive)"}

SMALLEST_SHOWN = 0.0005
"""A standard deviation below this would be printed as zero."""


class Reach(NamedTuple):
    """How far the best model stays within a budget, and the others."""

    budget_m: float
    label: str
    text: str
    interval: str
    others: tuple[tuple[str, str], ...]


class Number(NamedTuple):
    """A number for a controller with its standard deviation, and what it is."""

    name: str
    value: str
    meaning: str


class Check(NamedTuple):
    """One reason to trust the numbers, or not to."""

    grade: Grade
    text: str


class Answer(NamedTuple):
    """What a reader wants to know first.

    Attributes
    ----------
    grade, verdict : may the numbers be used, in one word and in one sentence
    no_numbers : reason why there is no number, or no multiplier; empty where there is one
    with_numbers : the error with these numbers alone; empty where it was not measured
    export : configuration of a diff_drive_controller; empty without a calibration
    """

    grade: Grade
    verdict: str
    reaches: tuple[Reach, ...]
    numbers: tuple[Number, ...]
    no_numbers: str
    with_numbers: str
    export: str
    model: str
    checks: tuple[Check, ...]


def answer_of(summary: Mapping[str, Any], report: Mapping[str, Any]) -> Answer:
    """Return the answer of a run.

    Parameters
    ----------
    summary : of the run, equal to its run.json
    report : what report.json holds
    """
    found = report["recommended"]
    calibration = calibration_of({**found, "created": ""}) if found is not None else None
    warnings = len(summary["warnings"])
    grade: Grade
    if not summary["usable"]:
        grade, verdict = "bad", f"No: {summary['unusable_because']}."
    elif not report["passed"]:
        grade, verdict = "bad", "No: an acceptance limit is not met."
    elif warnings:
        grade, verdict = "care", f"Yes, after reading {'the warning' if warnings == 1 else f'the {warnings} warnings'}."
    else:
        grade, verdict = "good", "Yes."
    numbers, no_numbers = _numbers(summary, calibration)
    return Answer(
        grade=grade,
        verdict=verdict,
        reaches=_reaches(report),
        numbers=numbers,
        no_numbers=no_numbers,
        with_numbers=controller_error_text(calibration.controller) if calibration is not None else "",
        export=_export(calibration),
        model=calibration.fitted.model.label if calibration is not None else "",
        checks=tuple(_checks(summary, report)),
    )


def _reaches(report: Mapping[str, Any]) -> tuple[Reach, ...]:
    rows: list[dict[str, Any]] = [
        {key: math.nan if value is None else value for key, value in one.items()} for one in report["budgets"]
    ]
    known = [BudgetDistance(**one) for one in rows]
    found = []
    for budget_m in dict.fromkeys(one.budget_m for one in known):
        mine = [one for one in known if one.budget_m == budget_m]
        best = next((one for one in mine if one.model == "recommended"), mine[0])
        others = tuple((IN_SAMPLE.get(one.model, one.label), reach_text(one)) for one in mine if one is not best)
        interval = best.interval_text or "too few trials for an interval"
        if best.beyond and not best.interval_text:
            interval = f"no trial is longer than {best.distance_m:g} m"
        found.append(Reach(budget_m, best.label, reach_text(best), interval, others))
    return tuple(found)


def _numbers(summary: Mapping[str, Any], calibration: Calibration | None) -> tuple[tuple[Number, ...], str]:
    icr, numbers = summary["icr"], list[Number]()
    width = summary["config"]["robot"]["track_width_m"]
    if calibration is not None:
        one, share = calibration.controller_numbers(), "wheels roll this share of the configured radius"
        meaning = f"the robot turns as if its tracks were {one.multiplier:.2f} times as far apart as {width:g} m"
        numbers = [
            Number("wheel_separation_multiplier", _with_std(one.multiplier, one.multiplier_std), meaning),
            Number("left_wheel_radius_multiplier", _with_std(one.left_radius, one.left_radius_std), f"left {share}"),
            Number(
                "right_wheel_radius_multiplier", _with_std(one.right_radius, one.right_radius_std), f"right {share}"
            ),
        ]
    elif (multiplier := icr["separation_multiplier"]) is not None and (
        std := icr["separation_multiplier_std"]
    ) is not None:
        text = _with_std(multiplier, std)
        numbers = [Number("wheel_separation_multiplier", text, "of the final ICRs; not tested on held-out distance")]
    why_none = "" if numbers else "The drive shows none of them."
    if width is None:
        why_none = "robot.track_width_m is not known: without it there is no multiplier and no no-slip model."
    return tuple(numbers), why_none


def _with_std(value: float, std: float) -> str:
    if std == 0.0:
        return f"{value:.3f}, not estimated"
    return f"{value:.3f} ± {std:.3f}" if std >= SMALLEST_SHOWN else f"{value:.3f}, σ below 0.001"


def _export(calibration: Calibration | None) -> str:
    if calibration is None:
        return ""
    try:
        return format_export(calibration, "diff_drive_controller")
    except DataError:
        return ""


def _checks(summary: Mapping[str, Any], report: Mapping[str, Any]) -> list[Check]:
    """Return the reasons, the gravest first."""
    grades: dict[Grade, int] = {"bad": 0, "care": 1, "good": 2, "fact": 3}
    found = [_excitation(summary), *_limits(report), *_incidents(summary, report), *_trials(report)]
    return sorted(found, key=lambda one: grades[one.grade])


def _excitation(summary: Mapping[str, Any]) -> Check:
    shown = summary["excitation"]
    weak = [f"{ICR_WORDS[column]} {verdict}" for column, verdict in shown["verdict"].items() if verdict != "shown"]
    turned = f"it turned {shown['turned_right_deg']:,.0f}° right and {shown['turned_left_deg']:,.0f}° left"
    if weak:
        return Check(
            "care", f"The drive does not show every ICR ({', '.join(weak).replace('weak', 'weakly shown')}): {turned}."
        )
    return Check("good", f"The drive shows all three ICRs: {turned}.")


def _limits(report: Mapping[str, Any]) -> list[Check]:
    return [
        Check("good" if one["passed"] else "bad", f"Acceptance limit: {one['verdict']}.") for one in report["gates"]
    ]


def _incidents(summary: Mapping[str, Any], report: Mapping[str, Any]) -> list[Check]:
    """Return what happened on the drive: warnings, slip, outages, rejected fixes."""
    gnss, events = summary["gnss"], summary["events"]
    found = []
    if warnings := len(summary["warnings"]):
        found.append(Check("care", f"{counted(warnings, 'warning')} about the log."))
    if events:
        kinds = [one["kind"] for one in events]
        each = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
        what = "the ICRs are not learned there" + ("" if report["without_events"] else ", but trials across them count")
        found.append(Check("care", f"{counted(len(events), 'slip event')} ({each}): {what}."))
    real = [one for one in report["outages"] if one["kind"] == "real"]
    if real:
        worst = max(real, key=lambda one: one["end_error_m"] or 0.0)
        error = f"{error_text(worst['end_error_m'])} off after {worst['distance_m']:.1f} m"
        found.append(Check("fact", f"{counted(len(real), 'real outage')}: in the worst the filter was {error}."))
    of = gnss["used"] + gnss["rejected"]
    if of:
        rejected = f"{gnss['rejected']:,} ({100 * gnss['rejected'] / of:.0f} %)" if gnss["rejected"] else "None"
        found.append(Check("fact", f"{rejected} of {of:,} positions were rejected."))
    if gnss["jumps"]:
        text = f"{counted(gnss['jumps'], 'jump')} of the position: a trial across one shows its size as an error."
        found.append(Check("care", text))
    return found


def _trials(report: Mapping[str, Any]) -> list[Check]:
    """Return how many trials the distances rest on, and what share of the error the reference itself may have."""
    rows = [row for row in report["trials"] if row["trials"]]
    if not rows:
        return [Check("bad", "No trial was long enough to measure an error.")]
    row = min(rows, key=lambda one: abs(one["horizon_m"] - CHOICE_HORIZON_M))
    horizon_m = row["horizon_m"]
    found = [
        Check("fact", f"{row['trials']:,} trials of {horizon_m:g} m were driven from {report['starts']:,} states.")
    ]
    own, p95 = (
        next((one["p95_m"] for one in table if one["horizon_m"] == horizon_m), None)
        for table in (
            report["reference_error"],
            *(one["by_horizon"] for one in report["models"] if one["name"] == "icr"),
        )
    )
    if own is not None and p95 is not None:
        share = f"Up to {error_text(own)}" if own < p95 else "All"
        what = f"the {error_text(p95)} error of the ICRs after {horizon_m:g} m (95 %)"
        found.append(Check("fact", f"{share} of {what} can be the error of the position reference."))
    return found
