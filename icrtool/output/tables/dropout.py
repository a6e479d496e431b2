"""A dropout report as text: the few lines a field engineer reads first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.kernels.arrays import Floats, Ints
from icrtool.output.text_blocks import Block, Line, Table, Text
from icrtool.output.text_format import (
    MODEL_WORDS,
    controller_error_text,
    controller_text,
    distance_text,
    driven_text,
    duration_text,
    error_text,
    run_title,
    unusable_lines,
)
from icrtool.records.dropout import CHOICE_HORIZON_M, BudgetDistance, ModelResult, Outage, TurningSplit
from icrtool.records.text import counted

MODEL = 26
"""Characters of a model's name that are printed."""

LISTED_HORIZONS = 4
"""More horizons than this without a trial are printed as a range."""


STARTS_TEXT = {"moving": "moving ", "all": ""}

NOTED_STANDING = 0.05
"""From this share of standing states on, they are mentioned."""

Rows = list[list[str]]


def format_dropout(report: DropoutReport) -> Text:
    """Return the table of a report: errors by model and horizon, budgets, no trials, outages, verdicts; no line end."""
    reference = "; compared with the smoothed trajectory" if report.smoothed else ""
    driven = driven_text(report.run_document.drive)
    starts = f"a trial from each {STARTS_TEXT[report.starts]}state of {report.states:,}"
    rows = [*_error_rows(report), *_reference_rows(report), *_ratio_rows(report), *_count_rows(report)]
    head = ("distance without GNSS", "", *_horizon_texts(report))
    blocks: list[Block] = [
        *unusable_lines(report.run_document),
        Line(run_title(report.run_document), "title"),
        f"{driven}; without GNSS, wheel speeds only, {starts}{reference}",
        "",
    ]
    if sentences := headline(report):
        blocks += [" ".join(sentences), ""]
    blocks += [
        Table("llr", rows, head),
        "",
        *_calibration_lines(report),
        *_fitted_lines(report),
        *_reference_lines(report),
    ]
    blocks += [*_learned_blocks(report), *_count_lines(report), *map(_turning_line, report.by_turning)]
    blocks += ["", *budget_lines(report.budgets)]
    if report.comparison is not None:
        blocks += ["", *report.comparison.notes]
    elif report.no_comparison:
        blocks += ["", f"whole model and controller numbers: left out: {report.no_comparison}"]
    if report.outages:
        blocks += ["", _outage_table(report.outages, report)]
    if report.verdicts:
        blocks += ["", *(Line(one.verdict, "good" if one.passed else "bad") for one in report.verdicts)]
    return Text(blocks)


SHOWN_HORIZONS_M = (1.0, 5.0, 10.0, 20.0)


def shown_horizons(horizons_m: Floats) -> list[int]:
    """Return the places of the horizons (h,) nearest to 1, 5, 10 and 20 m, each once; of a few horizons, all."""
    if len(horizons_m) <= len(SHOWN_HORIZONS_M):
        return list(range(len(horizons_m)))
    nearest = (int(np.argmin(np.abs(horizons_m - metres))) for metres in SHOWN_HORIZONS_M)
    return sorted(set(nearest))


def p95_at(result: ModelResult, report: DropoutReport, distance_m: float) -> float | None:
    """Return a model's p95 [m] at the horizon nearest to a distance; None beyond the last one, or without trials."""
    if distance_m > report.horizons_m[-1]:
        return None
    value = float(result.summary.p95[int(np.argmin(np.abs(report.horizons_m - distance_m)))])
    return value if np.isfinite(value) else None


def headline(report: DropoutReport) -> list[str]:
    """Return how far the robot goes without GNSS, and what a controller is given."""
    reached = {one.model: one for one in reversed(report.budgets)}
    if (best := reached.get("recommended")) is None:
        return []
    interval = f" ({best.interval_text})" if best.interval_text else ""
    without = f"; no slip: {reached['no_slip'].reach_text}" if "no_slip" in reached else ""
    found = [
        f"Without GNSS this robot stays within {best.budget_m:g} m (95 %) for {best.reach_text}{interval}{without}."
    ]
    if (calibration := report.calibration) is not None:
        alone = controller_error_text(calibration.controller)
        numbers = controller_text(calibration.controller_numbers())
        found.append(f"Controller: {numbers}{f'; {alone}' if alone else ''}.")
    return found


def _calibration_lines(report: DropoutReport) -> list[str]:
    return [
        f"{one.label}: {one.model} from {counted(one.logs, 'log')}, {one.created[:10]}, {one.fitted}"
        for one in report.calibrations
    ]


def _fitted_lines(report: DropoutReport) -> list[str]:
    """Return which rows are of numbers that the fit of the trial itself has seen."""
    final = report.result("icr_final")
    return [f"{final.label}: fitted to the whole drive, its trials too"] if final is not None else []


def budget_lines(budgets: Sequence[BudgetDistance]) -> list[str]:
    """Return a sentence a budget: how far each model stays within it."""
    if not budgets:
        return ["no trial is as long as the shortest horizon: no budget can be evaluated"]
    lines = []
    for budget_m in dict.fromkeys(one.budget_m for one in budgets):
        first, *others = (one for one in budgets if one.budget_m == budget_m)
        more = "".join(f"; {one.label}: {one.reach_text}" for one in others)
        lines.append(f"stays within {budget_m:g} m (95 %) for {first.reach_text} ({first.label}){more}")
    return lines


def _horizon_texts(report: DropoutReport) -> list[str]:
    return [f"{report.horizons_m[h]:g} m" for h in shown_horizons(report.horizons_m)]


def _error_rows(report: DropoutReport) -> Rows:
    """Return 95 %, its interval and the expected error of each model, what is recommended first."""
    shown, rows = shown_horizons(report.horizons_m), []
    for result in sorted(report.results, key=lambda one: one.name != "recommended"):
        summary, intervals = result.summary, result.intervals
        label = result.label if len(result.label) <= MODEL else f"{result.label[: MODEL - 1]}…"
        spans = (_span_text(float(intervals.p95_low[h]), float(intervals.p95_high[h])) for h in shown)
        rows += [
            [label, "95 %", *(_error_text(float(summary.p95[h]), report, h) for h in shown)],
            ["", "interval", *spans],
            ["", "expected", *(_error_text(float(summary.expected[h]), report, h) for h in shown)],
        ]
    return rows


def _ratio_rows(report: DropoutReport) -> Rows:
    icr, no_slip = report.result("icr"), report.result("no_slip")
    if icr is None or no_slip is None:
        return []
    rows = []
    for lead, label, column in (("no slip / ICR", "95 %", "p95"), ("", "expected", "expected")):
        ours, theirs = getattr(icr.summary, column), getattr(no_slip.summary, column)
        ratios = (float(theirs[h] / ours[h]) if ours[h] > 0 else math.nan for h in shown_horizons(report.horizons_m))
        rows.append([lead, label, *(f"{ratio:.1f} x" if math.isfinite(ratio) else "-" for ratio in ratios)])
    return rows


def _turning_line(split: TurningSplit) -> str:
    kind = "straight" if split.straight else "turning"
    errors = ", ".join(f"{MODEL_WORDS[name]} {error_text(error)}" for name, error in split.expected_m.items())
    return f"{kind} over {split.horizon_m:g} m, expected error: {errors} ({split.trials:,} trials)"


def _count_rows(report: DropoutReport) -> Rows:
    """Return the number of trials, and why other starts are none."""
    shown = shown_horizons(report.horizons_m)
    named = [("trials", report.counts.trials)]
    named += [(one.label, one.starts) for one in no_trial(report) if one.starts[shown].any()]
    return [[label, "", *(f"{int(column[h]):,}" for h in shown)] for label, column in named]


class NoTrial(NamedTuple):
    """A reason why starts gave no trial: its key in report.json, words in the table, and number of `starts` (h,)."""

    key: str
    label: str
    why: str
    starts: Ints


def no_trial(report: DropoutReport) -> tuple[NoTrial, ...]:
    """Return the reasons why starts gave no trial."""
    counts, cost = report.counts, report.event_cost
    driven = distance_text(report.run_document.drive.distance_m)
    slip = cost.trials if cost is not None else np.zeros_like(counts.short)
    return (
        NoTrial("too_little_way_left", "not counted: log ends", f"less than that is left of the {driven} driven",
                counts.short),
        NoTrial("across_wheel_gap", "  across a wheel gap", "the path crosses a gap in the wheel data", counts.gap),
        NoTrial("ends_in_gnss_outage", "  ends in GNSS outage", "it ends in a GNSS outage", counts.outage),
        NoTrial("from_standstill", "  from standstill", "the robot stands", counts.standing),
        NoTrial("crosses_jump", "  across a reference jump", "the reference jumps on the path", counts.crosses_jump),
        NoTrial("across_slip_event", "  across a slip event", "the path crosses a slip event", slip),
    )  # fmt: skip


def _count_lines(report: DropoutReport) -> list[str]:
    lines = []
    if report.result("no_slip") is None:
        lines.append("no slip is left out: robot.track_width_m is not known")
    if report.standing > NOTED_STANDING * report.states:
        share = 100 * report.standing / report.states
        counted = "each standstill is one start" if report.starts == "moving" else "each is a start (--starts all)"
        lines.append(f"the robot stood at {share:.0f} % of the states: {counted}")
    return [*lines, *_event_lines(report), *_empty_lines(report)]


def _event_lines(report: DropoutReport) -> list[str]:
    """Return what slip events cost, at the longest horizon with trials on both sides."""
    cost, icr, events = report.event_cost, report.result("icr"), report.run_document.events
    if cost is None and events:
        lasted = duration_text(sum(event.end_s - event.begin_s for event in events))
        return [f"trials cross {counted(len(events), 'slip event')}, {lasted} in all: --without-events leaves them out"]
    if cost is None or icr is None:
        return []
    if not cost.events:
        return ["slip events: none in this log; --without-events changes nothing"]
    left_out, before, after = f"{counted(cost.events, 'slip event')} left out", cost.with_events["icr"], icr.summary
    both = np.flatnonzero((after.trials > 0) & (before.trials > 0))
    if not len(both):
        return [f"{left_out}: no trial remains"]
    h = int(both[-1])
    errors = f"{error_text(float(after.p95[h]))} instead of {error_text(float(before.p95[h]))}"
    what = f"ICR after {report.horizons_m[h]:g} m 95 % {errors}"
    return [f"{left_out}: {what} ({int(cost.trials[h]):,} trials cross one)"]


def why_no_trial(report: DropoutReport, h: int) -> str | None:
    """Return why a horizon has no trial, None where it has some."""
    counts = report.counts
    if not len(counts.trials) or counts.trials[h]:
        return None
    reasons = no_trial(report)
    if counts.short[h] == report.states:
        return reasons[0].why
    return ", ".join(f"{one.why} ({int(one.starts[h]):,} starts)" for one in reasons if one.starts[h])


def _empty_lines(report: DropoutReport) -> list[str]:
    """Return a line for each reason why horizons are empty."""
    horizons: dict[str, list[str]] = {}
    for h, horizon in enumerate(report.horizons_m):
        if (why := why_no_trial(report, h)) is not None:
            horizons.setdefault(why, []).append(f"{horizon:g}")
    lines = []
    for why, lengths in horizons.items():
        span = ", ".join(lengths) if len(lengths) <= LISTED_HORIZONS else f"{lengths[0]} to {lengths[-1]}"
        lines.append(f"no trial of {span} m: {why}")
    return lines


def _reference_rows(report: DropoutReport) -> Rows:
    own, shown = report.reference_error, shown_horizons(report.horizons_m)
    if own is None or not np.isfinite(own.p95).any():
        return []
    return [
        [lead, label, *(_error_text(float(values[h]), report, h) for h in shown)]
        for lead, label, values in (("reference alone", "95 %", own.p95), ("", "expected", own.expected))
    ]


def _reference_lines(report: DropoutReport) -> list[str]:
    """Return how much of the momentary ICRs' error can be the reference's own."""
    own, icr = report.reference_error, report.result("icr")
    if own is None or icr is None or not np.isfinite(own.p95).any():
        return []
    h = int(np.argmin(np.where(np.isfinite(own.p95), np.abs(report.horizons_m - CHOICE_HORIZON_M), np.inf)))
    whole, part = error_text(float(icr.summary.p95[h])), error_text(float(own.p95[h]))
    what = f"the {whole} of the momentary ICRs (95 %, {report.horizons_m[h]:g} m)"
    return [f"up to {part} of {what} can be the error of the position reference"]


def _learned_blocks(report: DropoutReport) -> list[Block]:
    """Return the errors of the momentary ICRs before and after the ICRs were first learned."""
    split, shown = report.by_learning, shown_horizons(report.horizons_m)
    if split is None:
        return []
    if split.learned_s is None or split.distance_m is None:
        return ["the ICRs were never learned: their standard deviations hardly fell in this drive"]
    if not split.before.trials[shown].any():
        return []
    when = f"{duration_text(split.learned_s)}, {distance_text(split.distance_m)}"
    rows = [
        [name, *(f"{_bare(part.p95[h])} / {_bare(part.expected[h])}" if part.trials[h] else "-" for h in shown)]
        for name, part in (("  before", split.before), ("  after", split.after))
    ]
    head = f"ICR, momentary, before and after the ICRs were first learned ({when}): 95 % / expected [m]"
    return [head, Table("lr", rows, ("", *_horizon_texts(report)))]


def _outage_table(outages: Sequence[Outage], report: DropoutReport) -> Table:
    """Return a row an outage, in it p95 of the momentary ICRs over as much distance."""
    icr, rows = report.result("icr"), []
    for number, one in enumerate(outages, start=1):
        usual = p95_at(icr, report, one.distance_m) if icr is not None else None
        rows.append(
            (
                f"{number} {one.kind}", f"{one.begin_s:.1f} s", f"{one.end_s - one.begin_s:.1f} s",
                f"{one.distance_m:.1f} m", error_text(one.end_error_m), error_text(one.max_error_m),
                error_text(usual) if usual is not None else "-",
            )
        )  # fmt: skip
    return Table("lr", rows, ("outage", "from", "length", "distance", "end error", "max error", "95 % of trials"))


def _error_text(error_m: float, report: DropoutReport, h: int) -> str:
    percent = 100 * error_m / float(report.horizons_m[h])
    return f"{error_text(error_m)} {f'{percent:.1f} %' if math.isfinite(percent) else '-':>7}"


def _span_text(low_m: float, high_m: float) -> str:
    if not math.isfinite(low_m):
        return "too short"
    return f"{error_text(low_m).removesuffix(' m')}-{error_text(high_m)}"


def _bare(metres: float) -> str:
    return error_text(float(metres)).removesuffix(" m")
