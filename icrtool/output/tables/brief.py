"""What a command prints unless -v is given: the answer, in at most 22 lines of 80 columns."""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from typing import Literal

import numpy as np

from icrtool.calibration.one_log import LogCalibration
from icrtool.calibration.pooled import CalibrationResult
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.estimation.observability import lacking_turns
from icrtool.motion.models import ICRS, TERMS
from icrtool.output.tables.calibration import setting_blocks
from icrtool.output.tables.dropout import shown_horizons
from icrtool.output.text_blocks import Block, Line, Look, Table, Text
from icrtool.output.text_format import (
    distance_text,
    duration_text,
    error_text,
    event_kinds,
    filter_agreement,
    jump_count,
    position_word,
    run_title,
    topics_text,
    turn_text,
    unusable_lines,
)
from icrtool.records.dropout import CHOICE_HORIZON_M, BudgetDistance
from icrtool.records.run import ICR_COLUMNS, ICR_WORDS, Run, icr_text
from icrtool.records.run_document import ControllerNumbers, RunDocument
from icrtool.records.text import counted, shortened

WIDTH, LABEL = 80, 12
"""Columns of a line, and of its label."""

NOTED_SHARE = 0.05
"""From this share of rejected fixes on, they are a reason for care."""

NOTED_SCALE = 0.002
"""A correction of wheel speeds below this is not mentioned."""

SMALLEST_OFFSET_DEG = 0.05
"""A correction of the heading below this is not mentioned."""

BUDGET_M = 0.5
"""Error within which a distance counts, where none is asked for."""

Check = tuple[bool, str, str]
"""Whether it is in order, what was checked, and the finding."""


def brief_run(run: Run, directory: str, examine: str) -> Text:
    """Return what `icrtool fit` prints: usable or not, the numbers, why to trust them, what is next.

    Parameters
    ----------
    directory : of the run
    examine : command that names what is wrong in the log
    """
    summary = run.document
    title = Line(_title(summary, _turned_text(summary)), "title")
    blocks: list[Block] = [*unusable_lines(summary), title, *_state_lines(summary)]
    if summary.usable:
        blocks += [
            Line(line, "as is") for line in (*_controller_lines(run), _icr_line(map(summary.icr_of_drive, ICR_COLUMNS)))
        ]
    blocks += _check_lines(summary)
    if corrected := corrections(summary):
        blocks.append(labelled_line("corrected", "; ".join(corrected)))
    blocks.append(labelled_line("inputs", "; ".join(_inputs(summary))))
    blocks.append(labelled_line("written to", directory))
    if summary.usable:
        blocks.append(copied("next", shlex.join(["icrtool", "dropout-report", directory])))
    else:
        drive = to_drive(summary)
        blocks.append(labelled_line("next", drive) if drive else copied("next", examine))
    return Text(blocks)


def _check_lines(summary: RunDocument) -> Iterator[Line]:
    """Yield what was checked; what is not in order takes up to two lines."""
    for number, (good, what, text) in enumerate(run_checks(summary)):
        first = f"{'' if number else 'checks':{LABEL}}{'ok' if good else '!':4}{what:{LABEL}}"
        yield Line(_wrapped(first, text, 1 if good else 2), "as is")


def brief_dropout(report: DropoutReport, place: str) -> Text:
    """Return what `icrtool dropout-report` prints: how far, whether to trust it, where it was worst.

    Parameters
    ----------
    place : page or directory of the report
    """
    summary = report.run_document
    blocks: list[Block] = [*unusable_lines(summary), Line(_title(summary, _trials_text(report)), "title")]
    if not report.usable and (drive := to_drive(summary)):
        blocks.append(labelled_line("next", drive))
    if report.usable:
        blocks += _reach_blocks(report)
        _, sentence = trust(summary, passed=report.passed, events_left_out=report.event_cost is not None)
        blocks.append(labelled_line("Trust?", sentence))
    if report.usable and report.worst:
        one = report.worst[0]
        turn, speed = turn_text(one.heading_change_rad), one.speed_mean_mps
        text = f"{error_text(one.errors_m[one.model])} after {one.horizon_m:g} m, turning {turn} at {speed:.2f} m/s"
        blocks.append(labelled_line("Worst", f"at {duration_text(one.t_s)}: {text}"))
    if report.usable and report.result("recommended") is None and report.no_comparison:
        blocks.append(labelled_line("left out", f"whole model, controller numbers: {report.no_comparison}"))
    blocks += [labelled_line("Outages", text) for text in _outages(report)]
    blocks += [_error_table(report)]
    blocks += [Line(one.verdict, "good" if one.passed else "bad") for one in report.verdicts]
    blocks.append(labelled_line("page" if place.endswith(".html") else "written to", place))
    return Text(blocks)


def _turned_text(summary: RunDocument) -> str:
    excitation = summary.excitation
    turned = f"{excitation.turned_right_deg:,.0f}° right, {excitation.turned_left_deg:,.0f}° left"
    return f"{duration_text(summary.drive.duration_s)}, turned {turned}"


def _trials_text(report: DropoutReport) -> str:
    """Return how many trials the numbers rest on, at the horizon nearest to `CHOICE_HORIZON_M` that has any."""
    trials = report.results[0].summary.trials
    h = int(np.argmin(np.where(trials > 0, np.abs(report.horizons_m - CHOICE_HORIZON_M), np.inf)))
    return f"{trials[h]:,} trials of {report.horizons_m[h]:g} m"


def _title(summary: RunDocument, more: str) -> str:
    facts = f"{distance_text(summary.drive.distance_m)}, {more}"
    title = run_title(summary)
    return f"{shortened(title, max(WIDTH - len(facts) - 3, LABEL))}   {facts}"


def _state_lines(summary: RunDocument) -> list[Line]:
    """Return that a run can be used, and its gravest warning."""
    head = gravest(summary.warnings, summary.log)
    if summary.usable:
        return [Line(_cut(f"{'USABLE':{LABEL}}{head}"), "good")]
    return [Line(_cut(f"{'':{LABEL}}{head}"), "as is")] if head else []


def gravest(warnings: Sequence[str], log: str) -> str:
    """Return how many warnings there are and the gravest: the first that nothing was done about; none: empty."""
    plain = [one.removeprefix(f"{log}: ") for one in warnings]
    first = min(plain, key=lambda one: ("is not given" in one) + 2 * (": corrected" in one), default="")
    return f"{counted(len(plain), 'warning')} (-v), first: {first}" if len(plain) > 1 else first


def _controller_lines(run: Run) -> Iterator[str]:
    if run.track_width_m is None:
        yield f"{'controller':{LABEL}}no multiplier: robot.track_width_m is not known (--robot, --set)"
    elif not (numbers := run.document.controller):
        unknown = [ICR_WORDS[name] for name in ICR_COLUMNS[:2] if run.document.icr_of_drive(name) is None]
        yield f"{'controller':{LABEL}}no multiplier: {' and '.join(unknown) or 'the ICRs'} could not be found"
    else:
        yield from _number_lines(numbers, run.track_width_m)


def _number_lines(numbers: ControllerNumbers, width_m: float) -> Iterator[str]:
    """Yield what a controller is given."""
    multiplier = f"{numbers.multiplier:.3f} ± {numbers.multiplier_std:.3f}"
    radii = f"{numbers.left_radius:.3f}, {numbers.right_radius:.3f}"
    std = max(numbers.left_radius_std, numbers.right_radius_std)
    yield f"{'controller':{LABEL}}wheel_separation_multiplier  {multiplier}"
    yield f"{'':{LABEL}}left, right wheel radius     {radii} ± {std:.3f} of the configured"
    yield f"{'':{LABEL}}= (right - left) / {width_m:g} m; without slip: ±{width_m / 2:.3g} m"


def _icr_line(icrs: Iterable[tuple[float, float] | None]) -> str:
    """Return the three ICRs, each with its standard deviation."""
    rows = zip(ICR_WORDS.values(), icrs, strict=True)
    parts = [f"{word.removeprefix('y ')} {icr_text(*(found or (None, None)))}" for word, found in rows]
    return f"{'ICRs [m]':{LABEL}}{'  '.join(parts)}"


def run_checks(summary: RunDocument) -> list[Check]:
    """Return what was checked of a run, each with its finding."""
    found: list[Check] = []
    if agreement := filter_agreement(summary):
        found.append((agreement.endswith("agrees"), "EKF", agreement))
    excitation, gnss, heading = summary.excitation, summary.gnss, summary.heading
    drive = to_drive(summary)
    # what was lacking stands beside the ICRs; what to drive, alone
    lacks = drive.rpartition(": ")[2]
    if excitation.verdict.all_shown:
        found.append(
            (not drive, "excitation", f"shown, but {drive}" if drive else "all three ICRs shown: enough turns for each")
        )
    else:
        verdicts = ((excitation.verdict[name], ICR_WORDS[name]) for name in ICR_COLUMNS)
        weak = [(one, word) for one, word in verdicts if one != "shown"]
        words = "; ".join(
            f"{', '.join(name for one, name in weak if one == verdict)} {verdict}"
            for verdict in dict.fromkeys(one for one, _ in weak)
        )
        found.append((False, "excitation", f"{words}{f': {lacks}' if lacks else ''}"))
    if of := gnss.used + gnss.rejected:
        good = gnss.rejected < NOTED_SHARE * of
        word = "fixes" if position_word(summary) == "GNSS fixes" else "positions"
        found.append((good, word, f"{gnss.rejected:,} of {of:,} rejected"))
    if jumps := jump_count(summary.reference_jumps):
        found.append((False, "reference", jumps))
    if heading.offset_deg is not None:
        value = f"{round(heading.offset_deg, 1) + 0.0:+.1f} ± {heading.offset_std_deg:.1f}°"
        found.append((True, "heading", f"{value} from the course over ground"))
    if spans := summary.outages_ns:
        away = duration_text(sum(end - begin for begin, end in spans) / 1e9)
        found.append((False, "outages", f"{len(spans)}, {away} in all"))
    if events := summary.events:
        found.append((False, "slip events", f"{event_kinds(events)}; left out of the fit"))
    return found


def corrections(summary: RunDocument) -> list[str]:
    """Return what the alignment corrected, a few words each."""
    applied = {name: one.applied for name, one in summary.alignment.items()}
    scale, left, right = (applied.get(name) or 1.0 for name in ("wheel_scale", "left_scale", "right_scale"))
    found = [f"wheels {100 * scale:.1f} %"] if abs(scale - 1.0) > NOTED_SCALE else []
    if abs(left - right) > NOTED_SCALE:
        side, share = ("left", (right - left) / right) if left < right else ("right", (left - right) / left)
        found.append(f"{side} {100 * share:.1f} % less")
    if abs(offset := summary.heading.applied_offset_deg) >= SMALLEST_OFFSET_DEG:
        found.append(f"heading {0.0 - offset:+.1f}°")
    delays = (("position", summary.filter.reference_delay_s), ("heading", summary.heading.applied_delay_s))
    found += [f"{word} {'lag' if delay > 0 else 'lead'} {abs(delay):.2f} s" for word, delay in delays if delay]
    return found


def _inputs(summary: RunDocument) -> list[str]:
    """Return the topics, each once, with what was taken from it."""
    roles: dict[str, list[str]] = {}
    for stream in summary.streams:
        topics = topics_text(stream.topic)
        roles.setdefault(topics, []).append("position" if stream.role == "gnss" else stream.role)
    return [f"{topic} ({', '.join(taken)})" for topic, taken in roles.items()]


def to_drive(summary: RunDocument) -> str:
    """Return what to drive to find the ICRs that a run does not show; empty where turns would not help."""
    excitation = summary.excitation
    right, left = np.radians([excitation.turned_right_deg, excitation.turned_left_deg]).tolist()
    advised = (one for one in excitation.sentences if "drive two full turns" in one)
    return lacking_turns(right, left) or next(advised, "")


NOTES = {"controller": "in any diff_drive_controller"}
"""What stands beside a distance."""

REACH_ROWS = ("controller", "recommended", "recommended_gyro", "recommended_heading", "icr", "no_slip")
"""Models whose distance is printed, as far as they are there; the momentary ICRs where nothing is held out."""

REACH_LABELS = {"recommended_gyro": "with the gyro", "recommended_heading": "with the heading"}


def reach_rows(
    budgets: Sequence[BudgetDistance], calibrations: Sequence[tuple[str, str, str]], budget_m: float, events: int
) -> list[tuple[str, str, str]]:
    """Return label, distance and note of each model whose distance within a budget is stated, in their order.

    Parameters
    ----------
    calibrations : name, label, and what it was fitted to, of each that was given
    events : slip events of the run; the last row is the distance without them, where that is known
    """
    by_model = {one.model: one for one in budgets if one.budget_m == budget_m}
    rows = [
        (label if label.startswith("calibration") else f"calibration {label}", by_model[name], note)
        for name, label, note in calibrations if name in by_model
    ]  # fmt: skip
    for name in REACH_ROWS:
        if name in by_model and not (name == "icr" and "recommended" in by_model):
            label = REACH_LABELS.get(name, by_model[name].label)
            note = NOTES.get(name, by_model[name].interval_text if name.startswith("recommended") else "")
            rows.append((label, by_model[name], note))
    found = [(label, one.short_text, note) for label, one, note in rows]
    best = by_model.get("recommended") or by_model.get("icr")
    if events and best is not None and (quiet := best.without_events_text):
        found.append((f"without its {counted(events, 'slip event')}", quiet, best.label))
    return found


def _reach_blocks(report: DropoutReport) -> list[Block]:
    """Return how far the robot stays within each budget."""
    blocks: list[Block] = []
    width_m = report.run_document.config.robot.track_width_m
    unknown = [("   no slip", "not known", "needs robot.track_width_m (--robot, --set)")] if width_m is None else []
    given = [(one.name, one.label, one.fitted) for one in report.calibrations]
    for budget_m in dict.fromkeys(one.budget_m for one in report.budgets):
        rows = [
            (f"   {shortened(label, 28)}", text, note)
            for label, text, note in reach_rows(report.budgets, given, budget_m, len(report.run_document.events))
        ]
        blocks += [Line(f"How far within {budget_m:g} m (95 %)?", "title"), Table("lrl", rows + unknown)]
    return blocks or ["How far?  No trial is as long as the shortest horizon."]


Trust = Literal["good", "care", "bad"]


def trust(summary: RunDocument, *, passed: bool, events_left_out: bool) -> tuple[Trust, str]:
    """Return whether the numbers of a report can be trusted, and the reasons for care, one sentence.

    Parameters
    ----------
    passed : every acceptance limit is met
    events_left_out : no trial crosses a slip event
    """
    if not summary.usable:
        return "bad", f"no: {summary.unusable_because}"
    if not passed:
        return "bad", "no: an acceptance limit is not met"
    reasons = [f"{what} {text}" for good, what, text in run_checks(summary) if not good and what != "slip events"]
    if events := summary.events:
        crossed = "left out" if events_left_out else "trials across them count"
        reasons.append(f"{counted(len(events), 'slip event')}, {crossed}")
    return ("care", f"yes, with care: {'; '.join(reasons)}") if reasons else ("good", "yes")


def _outages(report: DropoutReport) -> list[str]:
    """Return how many outages of each kind there are, and the worst; none: no text."""
    found = []
    for kind in ("forced", "real"):
        if ours := [one for one in report.outages if one.kind == kind]:
            worst = max(ours, key=lambda one: one.end_error_m)
            found.append(
                f"{len(ours)} {kind}, the worst {error_text(worst.end_error_m)} after {worst.distance_m:.1f} m"
            )
    return ["; ".join(found)] if found else []


TABLE_ROWS = ("recommended", "controller", "icr", "no_slip")


def _error_table(report: DropoutReport) -> Table:
    """Return the 95 % error of the models that count, at a few distances."""
    shown = shown_horizons(report.horizons_m)
    given = [one.name for one in report.calibrations]
    found = [result for name in (*given, *TABLE_ROWS) if (result := report.result(name)) is not None]
    if report.result("recommended") is not None:
        found = [one for one in found if one.name != "icr"]
    rows = [
        [shortened(one.label, 22), *(_metres(float(one.summary.p95[h])) for h in shown)] for one in found
    ]  # fmt: skip
    return Table("lr", rows, ("95 % error [m]".ljust(22), *(f"{report.horizons_m[h]:g} m" for h in shown)))


def _metres(error_m: float) -> str:
    return f"{error_m:7.2f}" if np.isfinite(error_m) else "-"


def labelled_line(label: str, text: str, look: Look = "as is", most: int = 2) -> Line:
    """Return a label and a text in so many lines of at most `WIDTH`; a path is not broken."""
    return Line(_wrapped(f"{label:{LABEL}}", text, most) or label, look)


def _wrapped(first: str, text: str, most: int) -> str:
    """Return a text behind `first` in so many lines at most."""
    lines = textwrap.wrap(
        text, WIDTH, initial_indent=first, subsequent_indent=" " * len(first), break_long_words=False,
        break_on_hyphens=False, max_lines=most, placeholder=" …",
    )  # fmt: skip
    return "\n".join(lines)


def copied(label: str, command: str) -> Line:
    """Return a command on one line, however long: it is copied."""
    return Line(f"{label:{LABEL}}{command}", "as is")


def _cut(line: str) -> str:
    return line if len(line) <= WIDTH else f"{line[: WIDTH - 1].rstrip()}…"


def brief_calibration(result: CalibrationResult | None, sensors: LogCalibration | None) -> Text:
    """Return what `icrtool calibrate` prints: numbers, how far on what they were not fitted to, settings of one log."""
    blocks: list[Block] = []
    if result is not None:
        calibration, table = result.calibration, result.table
        geometry, covariance = calibration.geometry()
        std = np.sqrt(np.diag(covariance)).tolist()
        icrs = zip(geometry[:ICRS], std, strict=False)
        distance_m = sum(log.distance_m for log in calibration.logs)
        robot = calibration.robot.name or "robot"
        title = f"{robot}: {counted(len(calibration.logs), 'log')}, {distance_text(distance_m)}"
        blocks += [Line(title, "title")]
        numbers = calibration.controller_numbers()
        blocks += [Line(line, "as is") for line in (*_number_lines(numbers, calibration.width_m), _icr_line(icrs))]
        rows = [
            (f"   {REACH_LABELS.get(row.name, row.label)}", reached.short_text, NOTES.get(row.name, ""))
            for row in sorted(table.scores, key=lambda row: (*REACH_ROWS, row.name).index(row.name))
            if row.name in REACH_ROWS and (reached := row.within(table.horizons_m, BUDGET_M)) is not None
        ]
        what = "log" if table.folds[0].whole else "block of distance"
        blocks += [Line(f"How far within {BUDGET_M:g} m (95 %), each {what} left out in turn?", "title")]
        blocks += [Table("lrl", rows)]
        if unknown := [TERMS[name].meaning for name in calibration.fitted.not_shown]:
            blocks.append(labelled_line("not found", f"too small, or not driven; taken as usual: {'; '.join(unknown)}"))
    if sensors is not None:
        blocks += setting_blocks(sensors)
    return Text(blocks)
