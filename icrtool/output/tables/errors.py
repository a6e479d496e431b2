"""Errors over distance as blocks: of the shown models, of all other models, and the data behind the errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.kernels.arrays import Floats
from icrtool.output.figure_catalogue import FIGURES
from icrtool.output.text_blocks import VERBOSE, Block, Cell, Chart, Figure, Items, Section, Table
from icrtool.output.text_format import duration_text, error_text
from icrtool.records.acceptance import CHOICE_HORIZON_M, METRICS
from icrtool.records.dropout_document import DropoutDocument, ModelDocument, column_of
from icrtool.records.rows import LONGEST_ROW_NAME, in_order, shown_rows
from icrtool.records.run import why_no_vendor
from icrtool.records.run_document import RunDocument
from icrtool.records.text import counted, distance_text, shortened

LISTED_HORIZONS = 4
"""Largest number of horizons without a trial that are listed; more horizons are printed as a range."""

NOTED_STANDING = 0.05
"""Smallest share of standing states that is printed."""

SHOWN_HORIZONS_M = (1.0, 5.0, 10.0, 20.0)
"""Distances of the columns of the errors [m]."""

NO_TRIAL = {
    "too_little_way_left": "not counted: log ends", "across_wheel_gap": "  across a wheel gap",
    "ends_in_gnss_outage": "  ends in GNSS outage", "from_standstill": "  from standstill",
    "crosses_jump": "  across a reference jump", "across_slip_event": "  across a slip event",
}  # fmt: skip
"""Reasons why starts gave no trial, by the keys of report.json."""


def shown_horizons(horizons_m: Floats) -> list[int]:
    """Return the indices of the horizons (h,) nearest to 1, 5, 10 and 20 m, each once; of a few horizons, all."""
    if len(horizons_m) <= len(SHOWN_HORIZONS_M):
        return list(range(len(horizons_m)))
    nearest = (int(np.argmin(np.abs(horizons_m - shown_m))) for shown_m in SHOWN_HORIZONS_M)
    return sorted(set(nearest))


def model_of(report: DropoutDocument, name: str) -> ModelDocument | None:
    """Return a model of a report; None where it was not computed."""
    return next((model for model in report.models if model.name == name), None)


def in_row_order(models: Sequence[ModelDocument]) -> list[ModelDocument]:
    """Return models of a report in the order of `icrtool.records.rows`."""
    by_name = {model.name: model for model in models}
    return [by_name[name] for name in in_order(by_name)]


def trials_of_first(report: DropoutDocument) -> list[int]:
    """Return the number of trials of the row that is shown first, at each horizon of a report."""
    first = shown_rows([model.name for model in report.models])[:1]
    document = model_of(report, first[0]) if first else None
    return [row.trials for row in (report.trials if document is None else document.by_horizon)]


def errors_section(report: DropoutDocument, document: RunDocument) -> Section:
    """Return the errors over distance: of the shown rows, then of all rows, and the data behind them."""
    horizons = shown_horizons(np.array([row.horizon_m for row in report.trials]))
    counts = [report.trials[h] for h in horizons]
    main, models = shown_rows([model.name for model in report.models]), in_row_order(report.models)
    rows = [_error_row(model, horizons) for model in models if model.name in main]
    others = [_error_row(model, horizons) for model in models if model.name not in main]
    trials = trials_of_first(report)
    rows.append(["trials", "", *(f"{trials[h]:,}" for h in horizons)])
    head = ("distance without GNSS", "", *(f"{row.horizon_m:g} m" for row in counts))
    sentences = [*_source_lines(report), *_count_lines(report, document)]
    rests = [Table("llr", list(_other_rows(report, horizons)), head), *sentences, *_learned_blocks(report, horizons)]
    for split in report.by_turning:
        starts_word = "straight" if split.straight else "turning"
        errors = ", ".join(f"{name} {error_text(error)}" for name, error in split.expected_m.items())
        rests.append(f"{starts_word} over {split.horizon_m:g} m, expected error: {errors} ({split.trials:,} trials)")
    caption = (
        f"{FIGURES['summary'].caption} The budget is the dashed red line. Band: 95 % interval of the number itself, "
        "of the best row by wheels, or of the row whose name is pointed at."
    )
    return Section(
        "Error over distance without GNSS",
        [
            Figure(("summary",), "errors", (Chart("error-chart", FIGURES["summary"].title, caption),)),
            Table("llr", rows, head),
            Section(f"Other models ({len(others)})", [Table("llr", others, head)], VERBOSE),
            Section("What the errors rest on", rests, VERBOSE),
            Figure(("histogram", "examples")),
        ],
        name="errors",
    )


def _error_row(model: ModelDocument, horizons: Sequence[int]) -> list[str | Cell]:
    """Return the 95th percentile of a model's errors, its interval, and the expected error [m]."""
    cells = []
    for row in (model.by_horizon[h] for h in horizons):
        low, high = row.p95_low_m, row.p95_high_m
        interval = "too short" if low is None else f"{error_text(low).removesuffix(' m')}-{error_text(high)}"
        cells.append(_error_cell(row.horizon_m, row.p95_m, row.expected_error_m, interval))
    return [shortened(model.name, LONGEST_ROW_NAME), Cell("95 %", more=("interval", "expected")), *cells]


def _error_cell(horizon_m: float, p95_m: float | None, expected_m: float | None, *interval: str) -> Cell:
    """Return 95 % and the expected error, each with its share of the distance, and between them an interval."""
    share, expected_share = (
        "-" if error_m is None else f"{100 * error_m / horizon_m:.1f} %" for error_m in (p95_m, expected_m)
    )
    return Cell(error_text(p95_m), share, (*interval, f"{error_text(expected_m)} {expected_share:>7}"))


def _other_rows(report: DropoutDocument, horizons: Sequence[int]) -> Iterator[list[str | Cell]]:
    """Yield rows with the errors of a perfect model, the gain by the ICRs, and why starts gave no trial."""
    kinds, icr, no_slip = Cell("95 %", more=("expected",)), model_of(report, "icr"), model_of(report, "no_slip")
    if any(row.p95_m is not None for row in report.reference_error):
        reference = (report.reference_error[h] for h in horizons)
        yield ["reference alone", kinds, *(_error_cell(row.horizon_m, row.p95_m, row.expected_m) for row in reference)]
    if icr is not None and no_slip is not None:
        cells = []
        for ours, theirs in ((icr.by_horizon[h], no_slip.by_horizon[h]) for h in horizons):
            pairs = (theirs.p95_m, ours.p95_m), (theirs.expected_error_m, ours.expected_error_m)
            p95, expected = (f"{over / under:.1f} x" if over is not None and under else "-" for over, under in pairs)
            cells.append(Cell(p95, more=(expected,)))
        yield ["no_slip / icr", kinds, *cells]
    for key, label in NO_TRIAL.items():
        counts = [report.trials[h].no_trial.get(key, 0) for h in horizons]
        if any(counts):
            yield [label, "", *(f"{count:,}" for count in counts)]


def _source_lines(report: DropoutDocument) -> Iterator[str]:
    """Yield the data that each model was fitted to, and the part of its error that the reference can explain."""
    learned: dict[str, list[str]] = {}
    for model in report.models:
        learned.setdefault(model.knows, []).append(model.name)
    yield from (f"learned from {knows}: {', '.join(names)}" for knows, names in learned.items())
    for used in report.calibrations:
        yield f"{used.name}: {used.model} from {counted(used.logs, 'log')}, {used.created[:10]}, {used.fitted}"
    rows, icr = [row for row in report.reference_error if row.p95_m is not None], model_of(report, "icr")
    if rows and icr is not None:
        nearest = min(rows, key=lambda row: abs(row.horizon_m - CHOICE_HORIZON_M))
        icr_p95_m = next(row.p95_m for row in icr.by_horizon if row.horizon_m == nearest.horizon_m)
        error_words = f"icr, 95 % after {nearest.horizon_m:g} m: {error_text(icr_p95_m)}"
        yield f"{error_words}, of which the position reference can explain up to {error_text(nearest.p95_m)}"


def _count_lines(report: DropoutDocument, document: RunDocument) -> Iterator[str]:
    """Yield lines with the trials that count, the cost of slip events, and why horizons are empty."""
    smoothed = "; compared with the smoothed trajectory, which knows all of the drive"
    reference = smoothed if report.request.reference == "smoothed" else ""
    moving = "moving " if report.request.starts == "moving" else ""
    yield f"one trial from each {moving}state ({report.starts:,} states), by wheel speeds alone{reference}"
    if model_of(report, "no_slip") is None:
        yield "no_slip is left out: robot.track_width_m is not known"
    if document.config.robot.skid_factor is not None and model_of(report, "vendor") is None:
        yield f"vendor is left out: {why_no_vendor(document)}"
    if report.starts_standing > NOTED_STANDING * report.starts:
        share = 100 * report.starts_standing / report.starts
        standing_text = "each standstill is one start" if moving else "each is a start (--starts all)"
        yield f"the robot stood at {share:.0f} % of the states: {standing_text}"
    if document.reference_jumps and report.request.with_jumps:
        yield "trials across jumps of the reference count"
    yield from _event_lines(report, document)
    horizons: dict[str, list[str]] = {}
    for row in report.trials:
        if row.why_none is not None:
            horizons.setdefault(row.why_none, []).append(f"{row.horizon_m:g}")
    for why, lengths in horizons.items():
        span = ", ".join(lengths) if len(lengths) <= LISTED_HORIZONS else f"{lengths[0]} to {lengths[-1]}"
        yield f"no trial of {span} m: {why}"


def _event_lines(report: DropoutDocument, document: RunDocument) -> list[str]:
    """Return the errors with and without slip events, at the longest horizon with both kinds of trials."""
    cost, icr, events = report.without_events, model_of(report, "icr"), document.events
    if cost is None and events:
        lasted = duration_text(sum(event.end_s - event.begin_s for event in events))
        return [f"trials cross {counted(len(events), 'slip event')}, {lasted} in all; --without-events leaves them out"]
    if cost is None or icr is None:
        return []
    if not cost.events:
        return ["slip events: none in this log; --without-events changes nothing"]
    left_out = f"{counted(cost.events, 'slip event')} left out"
    rows = zip(icr.by_horizon, cost.with_events["icr"], report.trials, strict=True)
    both = [row for row in rows if row[0].trials and row[1].trials]
    if not both:
        return [f"{left_out}: no trial remains"]
    after, before, counts = both[-1]
    errors = f"{error_text(after.p95_m)} instead of {error_text(before.p95_m)}"
    crossing = counts.no_trial["across_slip_event"]
    return [f"{left_out}: icr after {after.horizon_m:g} m 95 % {errors} ({crossing:,} trials cross one)"]


def _learned_blocks(report: DropoutDocument, horizons: Sequence[int]) -> Iterator[Block]:
    """Yield the errors of the momentary ICRs before and after the ICRs were first learned."""
    split = report.by_learning
    if split is None:
        return
    if split.learned_s is None or split.learned_at_distance_m is None:
        yield "the ICRs were never learned: their standard deviations hardly fell in this drive"
        return
    if not any(split.before[h].trials for h in horizons):
        return
    rows = []
    for name, part in (("  before", split.before), ("  after", split.after)):
        errors = ((error_text(part[h].p95_m), error_text(part[h].expected_error_m)) for h in horizons)
        cells = [" / ".join(error.removesuffix(" m") for error in pair) for pair in errors]
        rows.append([name, *(cell if part[h].trials else "-" for cell, h in zip(cells, horizons, strict=True))])
    when = f"{duration_text(split.learned_s)}, {distance_text(split.learned_at_distance_m)}"
    caption = f"icr before and after the ICRs were first learned ({when}): 95 % / expected [m]"
    yield Table("lr", rows, ("", *(f"{report.trials[h].horizon_m:g} m" for h in horizons)), caption)


def baseline_sections(report: DropoutReport) -> Iterator[Section]:
    """Yield the differences of the errors to a baseline with their 95 % intervals, and what else differs from it."""
    baseline = report.baseline
    if baseline is None:
        return
    same, rows = baseline.is_of(report.run_document), []
    shown = [(h, float(report.horizons_m[h])) for h in shown_horizons(report.horizons_m)]
    for result, (label, metric) in product(report.results, (("95 %", "p95"), ("expected", "expected"))):
        cells, name = [], METRICS[metric]
        for h, horizon_m in shown:
            row, _ = baseline.at(result.name, horizon_m)
            before = math.nan if row is None else column_of([row], name)[0]
            difference = float(result.column(name)[h]) - before
            sums = result.block_sums[h] if result.block_sums else None
            half = baseline.half_width(result.name, horizon_m, metric, sums, 1.0, same=same)
            interval = f" ± {error_text(half)}" if math.isfinite(half) else ""
            cells.append(f"{difference:+z.3f} m{interval}" if math.isfinite(difference) else "-")
        rows.append([f"{result.name}, {label}", *cells])
    table = Table("lr", rows, ("difference to the baseline", *(f"{horizon_m:g} m" for _, horizon_m in shown)))
    title = f"Against the baseline ({baseline.log}, icrtool {baseline.tool_version})"
    yield Section(title, [table, Items(baseline.changes(report.run_document))], VERBOSE)
