"""A dropout report as blocks: distance without GNSS, reasons for trust, worst trials, and all errors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress

from msgspec import UNSET
from msgspec.structs import replace

from icrtool.calibration.held_sensors import SENSORS_CONTRADICT
from icrtool.calibration.record import Calibration, model_in_document, stored_calibration
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import DataError
from icrtool.motion.models import TERMS, FittedModel
from icrtool.motion.robot_prior import OTHER_ROBOTS
from icrtool.output.exports.controllers import format_export
from icrtool.output.tables.errors import baseline_sections, errors_section, model_of, trials_of_first
from icrtool.output.tables.run import next_step, number_blocks, run_checks, unusable_line
from icrtool.output.text_blocks import (
    PAGE,
    VERBOSE,
    Block,
    Check,
    Checks,
    Facts,
    Figure,
    Grade,
    Line,
    Section,
    Table,
    Title,
    format_blocks,
)
from icrtool.output.text_format import (
    controller_error_text,
    direction_words,
    duration_text,
    error_text,
    plus_minus,
    run_title,
    turn_text,
)
from icrtool.records.acceptance import CHOICE_HORIZON_M, NEAR_HORIZONS_M, BudgetDistance
from icrtool.records.dropout_document import DropoutDocument, TrialDocument
from icrtool.records.notes import is_grave
from icrtool.records.rows import (
    FALLBACK_ROW,
    LONGEST_ROW_NAME,
    MAIN_ROW,
    TOPIC_ROW,
    in_order,
    kind_of,
    row_of,
    shown_rows,
    turned_by,
)
from icrtool.records.run_document import RunDocument
from icrtool.records.text import counted, distance_text, shortened

ReachRow = tuple[str, str, str, str]
"""Name of a row, distance on this drive, distance on the next drive, and note."""

NEXT_DRIVE = "next drive, 9 of 10"
NEXT_DRIVE_MEANS = "next drive: this robot, this kind of ground"
"""Title of the column with the range of the next drive, and its meaning."""


def format_dropout(report: DropoutReport) -> str:
    """Return a report as text, without the last line end."""
    return format_blocks(dropout_blocks(report))


def dropout_blocks(report: DropoutReport) -> list[Block]:
    """Return the output of `icrtool dropout-report` as blocks, with the differences from a baseline if given."""
    *blocks, verdicts = report_blocks(report.run_document, report.document)
    return [*blocks, *baseline_sections(report), verdicts]


def report_blocks(document: RunDocument, report: DropoutDocument) -> list[Block]:
    """Return a stored report as blocks, with the verdicts last.

    Parameters
    ----------
    document : content of run.json
    report : content of report.json; null for a number that is not known
    """
    document = with_verdict(document, report)
    # The trials of the first row are counted at the horizon with trials that is nearest to `CHOICE_HORIZON_M`.
    counts = zip(report.trials, trials_of_first(report), strict=True)
    row, count = min(
        counts, key=lambda row_and_trials: (not row_and_trials[1], abs(row_and_trials[0].horizon_m - CHOICE_HORIZON_M))
    )
    trials = f"{distance_text(report.run.drive.distance_m)}, {count:,} trials of {row.horizon_m:g} m"
    return [
        unusable_line(document),
        Title(run_title(document), trials),
        Facts([("next", next_step(document))]),
        *answer_sections(document, report),
        *outage_blocks(report),
        errors_section(report, document),
        model_section(report),
        Section("", verdict_lines(report)),
    ]


def with_verdict(document: RunDocument, report: DropoutDocument) -> RunDocument:
    """Return the document of a run with the verdict of its report, whose trials may show that it must not be used."""
    if report.usable or not document.usable:
        return document
    return replace(document, usable=False, unusable_because=report.unusable_because)


def answer_sections(document: RunDocument, report: DropoutDocument) -> list[Section]:
    """Return distance, trust and worst case; for a run that is not usable, a section that states this."""
    if not (report.usable or report.budgets):
        unknown = Section("How far without GNSS?", ["Not known: the run is not usable."], VERBOSE, name="reach")
        return [unknown, trust_section(document, report)._replace(depth=VERBOSE)]
    cards = [reach_section(document, report), numbers_section(document, report), trust_section(document, report)]
    for trial in report.worst[:1]:
        note = _meanwhile(trial, document, report)
        driven = f"{trial.horizon_m:g} m from {duration_text(trial.t_s)} on"
        turns_text = f"turning {turn_text(trial.heading_change_deg)} at {trial.speed_mean_mps:.2f} m/s"
        model_text = f"with {trial.model}{f'; meanwhile: {note}' if note else ''}"
        error = error_text(trial.errors_m[trial.model])
        text = f"after {driven}, {turns_text}, {model_text}"
        cards.append(Section("Where was it worst?", [], lead=error, text=text, label="Worst", name="worst-case"))
    return cards


def reach_rows(report: DropoutDocument, budget_m: float, events: int) -> tuple[list[ReachRow], list[ReachRow]]:
    """Return the rows that are shown first, and the others: name, distance on this and on the next drive, and note.

    Parameters
    ----------
    events : slip events of the run; the last row is the distance without them, where that is known
    """
    by_model = {reach.model: reach for reach in report.budgets if reach.budget_m == budget_m}
    best = report.best.model if report.best is not None else MAIN_ROW
    order = in_order(by_model)
    first = sorted(shown_rows(order), key=lambda name: name != best)
    notes = {used.name: used.fitted for used in report.calibrations}
    notes |= {model.name: model.knows for model in report.models if kind_of(model.name) == TOPIC_ROW}
    # A given calibration changes the numbers of this row.
    learned = (model for model in report.models if kind_of(model.name) == "adaptive")
    notes |= {model.name: "from the calibration" for model in learned if not model.knows.startswith(OTHER_ROBOTS)}
    if report.best is not None:
        notes[best] = "best by wheels"
        notes |= dict.fromkeys(report.best.as_good, "as good here")
    rows = [reach_row(by_model[name], notes.get(name, "")) for name in first]
    if report.run.config.robot.track_width_m is None:
        rows.append(("no_slip", "not known", "", "needs --robot"))
    leading = by_model.get(best) or by_model.get(FALLBACK_ROW)
    if events and leading is not None and (quiet := leading.without_events_text):
        rows.append((f"without its {counted(events, 'slip event')}", quiet, "", leading.model))
    return rows, [reach_row(by_model[name]) for name in order if name not in first]


def reach_row(distance: BudgetDistance, note: str = "") -> ReachRow:
    """Return name, distance on this drive, on the next one, and note of a row of a report."""
    low, high = distance.between_m
    if not note and high - low > NEAR_HORIZONS_M and not distance.beyond:
        note = f"between {low:g} and {high:g} m"
    return distance.model, distance.short_text, distance.next_text, note


def reach_section(document: RunDocument, report: DropoutDocument) -> Section:
    """Return the distances over which the robot stays within each budget, on this drive and on the next drive."""
    blocks: list[Block] = []
    lead, text = "", ""
    others_known = list(other_ground_lines(report))
    for budget_m in dict.fromkeys(reach.budget_m for reach in report.budgets):
        rows, others = reach_rows(report, budget_m, len(document.events))
        if rows and not lead:
            lead, text = _distance_to_plan_with(report, budget_m, rows[0])
            text += "".join(f"; {line}" for line in (*others_known[:1], *heading_lines(report)))
        shown = [(shortened(name, LONGEST_ROW_NAME), *rest) for name, *rest in rows]
        head = (f"within {budget_m:g} m (95 %)", "this drive", NEXT_DRIVE, "")
        blocks.append(Table("lrrl", shown, head, "How far without GNSS?"))
        blocks.append(Section("Other models", [Table("lrrl", others, head)], VERBOSE))
    if blocks:
        meaning = NEXT_DRIVE_MEANS if others_known else f"{NEXT_DRIVE_MEANS}; another ground is not shown"
        blocks += [*heading_lines(report), *as_good_lines(report), *others_known, meaning, *sensor_lines(report)]
    else:
        blocks.append("How far?  No trial is as long as the shortest horizon: no budget can be evaluated.")
    if report.ladder.left_out is not UNSET and report.ladder.left_out:
        blocks.append(Facts([("left out", f"recommended, controller: {report.ladder.left_out}")]))
    return Section("How far without GNSS?", blocks, lead=lead, text=text, name="reach")


def _distance_to_plan_with(report: DropoutDocument, budget_m: float, row: ReachRow) -> tuple[str, str]:
    """Return the distance that the next drive keeps in 9 of 10 cases, and in a sentence the distance on this drive.

    If the distance of the next drive is not known, the distance on this drive is returned.
    """
    name, this_drive, next_drive, _ = row
    measured = f"within {budget_m:g} m (95 %), by wheel speeds alone with {name}"
    planned = next((reach for reach in report.budgets if (reach.model, reach.budget_m) == (name, budget_m)), None)
    if planned is None or planned.to_plan_with_m is None:
        return this_drive, f"on this drive {measured}"
    then = f"{next_drive} on the next drive on this ground (9 of 10), {this_drive} on this drive"
    return f"plan with {distance_text(planned.to_plan_with_m)}", f"{measured}: {then}"


def other_ground_lines(report: DropoutDocument) -> Iterator[str]:
    """Yield the distance within each budget on a ground that the calibration was not fitted to."""
    grounds = {
        score.ground
        for used in report.calibrations
        if used.calibration is not None
        for score in used.calibration.other_grounds or ()
    }
    for budget_m in dict.fromkeys(reach.budget_m for reach in report.budgets):
        distances = [reach for reach in report.budgets if reach.budget_m == budget_m and reach.other_text]
        wheels = [reach for reach in distances if not turned_by(reach.model)]
        if wheels:
            best = max(wheels, key=lambda reach: math.inf if reach.other_low_m is None else reach.other_low_m or 0.0)
            reach_text = f"{best.other_text} within {budget_m:g} m (9 of 10) with {best.model}"
            yield f"on another ground: {reach_text}; from {counted(len(grounds), 'ground')}, each left out once"


def heading_lines(report: DropoutDocument) -> Iterator[str]:
    """Yield a line with the remedy if the heading at the start causes most of the error of the best row."""
    start_heading = UNSET if report.best is None else report.best.start_heading
    if report.best is not None and start_heading is not UNSET and start_heading.dominates:
        total_text = f"{error_text(start_heading.p95_m)} after {report.best.horizon_m:g} m (95 %)"
        aligned_text = f"{error_text(start_heading.aligned_p95_m)} with aligned headings"
        errors_text = f"{total_text}, but {aligned_text}"
        yield f"the heading at the start causes most of the error: {errors_text}; {start_heading.mend}"


def sensor_lines(report: DropoutDocument) -> Iterator[str]:
    """Yield a line for each constant of a calibration's sensors that the log contradicts."""
    return (finding.sentence for finding in report.notes if finding.code == SENSORS_CONTRADICT)


def as_good_lines(report: DropoutDocument) -> Iterator[str]:
    """Yield a line with the rows for comparison that are as good as the best row."""
    for name in report.best.as_good if report.best is not None else ():
        yield f"{name} ({row_of(name).words}) is not shown to be worse, and needs no calibration"


def trust_section(document: RunDocument, report: DropoutDocument) -> Section:
    """Return whether the numbers of a report can be trusted, the reasons for care, and what was checked."""
    checks = run_checks(document)
    cares = [f"{check.name} {check.text}" for check in checks if check.grade == "care" and check.name != "slip events"]
    if document.partly_because:
        cares.insert(0, document.partly_because)
    if events := document.events:
        crossed = "trials across them count" if report.without_events is None else "left out"
        cares.append(f"{counted(len(events), 'slip event')}, {crossed}")
    grade: Grade = "care" if cares else "good"
    lead, why = ("yes, with care:" if cares else "yes"), "; ".join(cares)
    if not (document.usable and report.passed):
        grade, lead, why = "bad", "no:", document.unusable_because or "an acceptance limit is not met"
    if count := sum(not is_grave(finding) for finding in document.notes):
        checks.append(Check("care", "log", f"{counted(count, 'warning')} about it"))
    section = Section("", [Checks(sorted(checks, key=lambda check: check.grade != "care"))], VERBOSE)
    return Section("May I trust it?", [section], lead=lead, text=why, label="Trust?", grade=grade, name="trust")


def verdict_lines(report: DropoutDocument) -> list[Line]:
    """Return the verdict on each acceptance limit."""
    return [Line(verdict.verdict, "good" if verdict.passed else "bad") for verdict in report.gates]


def worst_section(document: RunDocument, report: DropoutDocument) -> Section:
    """Return the trials with the largest errors."""
    if not report.worst:
        return Section("Worst cases", ["No trial was long enough."], VERBOSE, name="worst")
    first = report.worst[0]
    rows = [
        (
            f"{rank}", duration_text(trial.t_s), error_text(trial.errors_m[trial.model]),
            error_text(trial.errors_m.get("no_slip")), turn_text(trial.heading_change_deg),
            f"{trial.speed_mean_mps:.2f} m/s", f"{trial.north_m:z.1f} m", f"{trial.east_m:z.1f} m",
            _meanwhile(trial, document, report),
        )
        for rank, trial in enumerate(report.worst, start=1)
    ]  # fmt: skip
    across, up = (word.lower() for word in direction_words(document))
    head = ("", "from", "error", "no_slip", "turn", "mean speed", up, across, "meanwhile")
    caption = (
        f"Trials of {first.horizon_m:g} m with the largest error of {first.model} that do not "
        "overlap. What they share (a speed, a turn, a place) shows where the model fails"
    )
    moments = [trial.t_s for trial in report.worst]
    worst = Table("lrrrrrrrl", rows[:1], head, caption, moments[:1])
    further = Table("lrrrrrrrl", rows[1:], head, "", moments[1:])
    blocks: list[Block] = [
        worst,
        Section(f"The next {len(rows) - 1}", [further], PAGE),
        Figure(("error_map", "worst"), folded=False),
    ]
    return Section("Worst cases", blocks, PAGE, name="worst")


def _meanwhile(trial: TrialDocument, document: RunDocument, report: DropoutDocument) -> str:
    """Return what happened during a trial: jumps of the position, outages, slip."""
    speed = trial.speed_mean_mps
    end_s = trial.t_s + (trial.horizon_m / speed if speed else 0.0)
    end_ns = trial.stamp_ns + round(1e9 * (end_s - trial.t_s))
    sizes = [
        jump.size_m for jump in document.reference_jumps if jump.begin_ns < end_ns and jump.end_ns > trial.stamp_ns
    ]
    real = [out for out in report.outages if out.kind == "real"]
    lost = [out for out in real if out.begin_s < end_s and out.end_s > trial.t_s]
    slips = [slip.kind for slip in document.events if slip.begin_s < end_s and slip.end_s > trial.t_s]
    notes = [f"the position steps by {error_text(max(sizes))}"] if sizes else []
    notes += [f"outage of {duration_text(out.end_s - out.begin_s)}" for out in lost[:1]]
    notes += [f"slip event ({kind})" for kind in dict.fromkeys(slips)]
    return ", ".join(notes)


def outage_blocks(report: DropoutDocument) -> list[Block]:
    """Return the worst outage of each kind, and a table of all outages with p95 of trials over the same distance."""
    parts = []
    for kind in ("forced", "real"):
        if ours := [outage for outage in report.outages if outage.kind == kind]:
            worst = max(ours, key=lambda outage: outage.end_error_m or 0.0)
            parts.append(
                f"{len(ours)} {kind}, the worst {error_text(worst.end_error_m)} after {distance_text(worst.distance_m)}"
            )
    rows = [
        (
            f"{number} {outage.kind}", duration_text(outage.begin_s), duration_text(outage.end_s - outage.begin_s),
            distance_text(outage.distance_m), error_text(outage.end_error_m), error_text(outage.max_error_m),
            error_text(p95_at(report, "icr", outage.distance_m)),
        )
        for number, outage in enumerate(report.outages, start=1)
    ]  # fmt: skip
    head = ("outage", "from", "length", "distance", "end error", "max error", "95 % of trials")
    caption = "How far the filter was off when position fixes returned"
    table = Table("lr", rows, head, caption, [outage.begin_s for outage in report.outages])
    return [Facts([("Outages", "; ".join(parts))]), Section("", [table], VERBOSE)]


def p95_at(report: DropoutDocument, model: str, distance_m: float) -> float | None:
    """Return a model's p95 [m] at the horizon nearest to a distance; None beyond the last one, or without trials."""
    document = model_of(report, model)
    if document is None or not document.by_horizon or distance_m > document.by_horizon[-1].horizon_m:
        return None
    return min(document.by_horizon, key=lambda row: abs(row.horizon_m - distance_m)).p95_m


def model_section(report: DropoutDocument) -> Section:
    """Return the parameters of the recommended motion model, and how the models were compared."""
    parameters: list[Block] = []
    if (recommended := report.recommended) is not None:
        parameters = [
            parameter_table(model_in_document(recommended.model, recommended)),
            *(finding.sentence for finding in recommended.notes),
        ]
    notes = [finding.sentence for finding in report.ladder.notes or ()]
    blocks: list[Block] = [Section("Parameters of the motion model", parameters, VERBOSE), *notes]
    return Section("The motion model", blocks, VERBOSE, name="models")


WITH_GYRO = "with gyro: "
"""Prefix of the names of parameters of a model with a gyro."""


def parameter_table(fitted_model: FittedModel, gyro: FittedModel | None = None) -> Table:
    """Return the parameters of a model with one standard deviation each, and the parameters of its form with a gyro."""
    rows = [
        (name if model is fitted_model else f"{WITH_GYRO}{name}", plus_minus(value, std, 4),
         "not shown" if name in model.not_shown else "shown", TERMS[name].meaning)
        for model in (fitted_model, gyro) if model is not None
        for name, value, std in zip(model.model.terms, model.parameters, model.std, strict=True)
    ]  # fmt: skip
    return Table("lrll", rows, ("term", "value ± σ", "by this drive", "meaning"))


def numbers_section(document: RunDocument, report: DropoutDocument) -> Section:
    """Return the numbers for a controller, and the error with these numbers alone."""
    title = "Which numbers into the controller?"
    if report.recommended is None or document.config.robot.track_width_m is None:
        return Section(title, number_blocks(document), name="factors")
    calibration = stored_calibration(report.recommended)
    controller, *icrs = number_blocks(document, calibration.controller)
    blocks = [controller, Section("", icrs, VERBOSE)]
    if alone := controller_error_text(calibration.controller_errors):
        blocks.append(Section("", [alone], VERBOSE))
    return Section(title, blocks, name="factors")


def controller_section(report: DropoutDocument) -> Section:
    """Return the configuration of a controller, to copy, and the commands that write it for others; only on a page."""
    blocks: list[Block] = []
    if report.recommended is not None:
        with suppress(DataError):
            blocks = configuration_blocks(stored_calibration(report.recommended), "RUN")
    return Section("Configuration to copy", blocks, PAGE, name="controller")


EXPORTS = {"Clearpath": "clearpath", "Husarion": "husarion", "robot_localization, Nav2": "nav2",
           "another program": "json", "an ICR model": "icr"}  # fmt: skip
"""Targets of `icrtool export` that a page names beside the configuration of a diff_drive_controller, by their users."""


def configuration_blocks(calibration: Calibration, name: str) -> list[Block]:
    """Return the configuration of a diff_drive_controller, to copy, and the commands that write it for others.

    Raises
    ------
    DataError
        The calibration has no numbers for a controller.
    """
    text = format_export(calibration, "diff_drive_controller")
    others = [(user, f"icrtool export --for {target} {name}") for user, target in EXPORTS.items()]
    return [Line(text, "as is"), Table("ll", others, ("for", "command"))]
