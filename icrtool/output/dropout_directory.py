"""``RUN/dropout/``: what `icrtool dropout-report` leaves behind, whole or not at all, and what report.json holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from icrtool import __version__
from icrtool.calibration.model_comparison import FITTED_TO, ModelComparison
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.dropout_analysis.trials import ErrorSink
from icrtool.kernels.arrays import Ints
from icrtool.kernels.error_statistics import FEWEST_BLOCKS, HORIZONS_A_BLOCK, LEVEL, MOST_BLOCKS, Summary
from icrtool.kernels.open_loop import TOLERANCE_M
from icrtool.motion.models import FittedModel
from icrtool.output.files.atomic import atomic_directory
from icrtool.output.files.formats import csv_bytes, json_bytes, list_anew, schema_of
from icrtool.output.files.own_files import files_in
from icrtool.output.files.states_file import trials_file
from icrtool.output.run_directory import is_run_directory
from icrtool.output.text_format import FITTED, distance_text
from icrtool.records.dropout import ExampleTrial, ModelResult, error_columns
from icrtool.records.dropout_document import (
    DROPOUT_SCHEMA,
    BaselineDocument,
    BlocksDocument,
    CountDocument,
    DropoutDocument,
    ErrorRow,
    EventCostDocument,
    FitDocument,
    IntervalsDocument,
    LadderDocument,
    LearnedDocument,
    ModelDocument,
    OutageDocument,
    ReferenceRow,
    RunOfReport,
    ScoreDocument,
    SummaryRow,
    TrialDocument,
)
from icrtool.records.plain_data import plain, rows_of
from icrtool.records.run import FigureSet

REPORT_FILE = "report.json"
TRIALS_FILE = "trials.parquet"
DROPOUT_DIRECTORY = "dropout"
"""Where a report stands in its run directory."""
SCHEMA_FAMILY = "icrtool/dropout/"

KNOWS = {
    "icr": "the distance up to each start",
    "no_slip": "the track width",
    "icr_final": "all of the drive, the trial too",
}
"""What the numbers of a model were learned from; those of the others from the rest of the drive."""

ERROR_COLUMNS = ("icr", "no_slip", "recommended", "controller")


def write_report(
    analyse: Callable[[ErrorSink | None], DropoutReport],
    directory: Path,
    *,
    plots: tuple[str, ...] = ("png",),
    figures: FigureSet = "default",
    stamp_ns: Ints | None = None,
    inside: Path | None = None,
) -> DropoutReport:
    """Write a report, whole or not at all; an old one in its place is replaced. The list of its run names its files.

    Parameters
    ----------
    analyse : gives the report; it is called with what takes every single trial, None where they are not written
    plots : formats of the figures, of ``png``, ``svg`` and ``pdf``; none: no figures
    figures : ``all``: those of the paper too
    stamp_ns : (n,) of the starts, to write every single trial to trials.parquet; None: they are not written
    inside : as in `icrtool.output.files.own_files.check_directory`

    Raises
    ------
    OutputError
        Something that is not a dropout report stands in its place, or the disk does not take it.
    """
    with atomic_directory(directory, is_dropout_directory, kind="dropout report", inside=inside) as partial:
        with trials_file(partial / TRIALS_FILE, stamp_ns) if stamp_ns is not None else nullcontext() as sink:
            report = analyse(sink)
        if plots:
            from icrtool.output.figure_catalogue import draw_figures

            draw_figures("report", report, partial / "plots", plots, figures)
        write_tables(report, partial)
        names = [name.as_posix() for name in files_in(partial)]
        if in_run := is_run_directory(directory.parent):
            list_anew(directory.parent, directory.name)
    if in_run:
        list_anew(directory.parent, directory.name, names)
    return report


def is_dropout_directory(directory: Path) -> bool:
    """Return whether a directory is a dropout report of ours, of whatever version."""
    return schema_of(directory / REPORT_FILE, directory).startswith(SCHEMA_FAMILY)


def write_tables(report: DropoutReport, directory: Path) -> None:
    """Write summary.csv, histogram.csv, worst.csv and report.json into a directory, and ladder.csv where there is one.

    Raises
    ------
    OSError
        A file cannot be written.
    """
    summary = report.summary_columns()
    (directory / "summary.csv").write_bytes(csv_bytes(summary, zip(*summary.values(), strict=True)))
    (directory / "histogram.csv").write_bytes(csv_bytes(HISTOGRAM_COLUMNS, _histogram_rows(report)))
    (directory / "worst.csv").write_bytes(csv_bytes(WORST_COLUMNS, _worst_rows(report.worst)))
    if report.comparison is not None:
        (directory / "ladder.csv").write_bytes(
            csv_bytes(COMPARISON_COLUMNS, comparison_rows(report, report.comparison))
        )
    (directory / REPORT_FILE).write_bytes(json_bytes(report_document(report)))


def report_document(report: DropoutReport) -> DropoutDocument:
    """Return what report.json holds, equal to what is read back: None for a number that is not known."""
    run, made = report.run_document, report.calibration
    by_model: dict[str, list[SummaryRow]] = {result.name: [] for result in report.results}
    for row in rows_of(plain(report.summary_columns())):
        by_model[row.pop("model")].append(SummaryRow(**row))
    return DropoutDocument(
        schema=DROPOUT_SCHEMA,
        tool_version=__version__,
        run=RunOfReport(*(getattr(run, key) for key in RunOfReport.__struct_fields__)),
        usable=run.usable,
        unusable_because=run.unusable_because,
        reference=f"the {'smoother' if report.smoothed else 'filter'}'s estimate at the end of the trial",
        smoothed=report.smoothed,
        starts=report.states,
        starts_counted=report.starts,
        starts_standing=report.standing,
        with_jumps=report.with_jumps,
        without_events=_event_document(report),
        tolerance_m=TOLERANCE_M,
        # the key and its parts keep their names; nothing is resampled
        bootstrap=IntervalsDocument(
            method="Student's t over blocks of path",
            block=f"{HORIZONS_A_BLOCK} horizons or more, {FEWEST_BLOCKS} to {MOST_BLOCKS} blocks",
            resamples=0,
            level=LEVEL,
            seed=report.seed,
        ),
        models=tuple(_model_document(result, by_model[result.name], report) for result in report.results),
        trials=_count_documents(report),
        reference_error=_reference_rows(report),
        by_learning=_learned_document(report),
        calibrations=report.calibrations,
        # Without when it was made: the same run, the same file.
        recommended=None if made is None else msgspec.structs.replace(made, created=msgspec.UNSET),
        budgets=report.budgets,
        by_turning=report.by_turning,
        ladder=comparison_document(report),
        gates=report.verdicts,
        passed=report.passed,
        baseline=_baseline_document(report),
        outages=tuple(OutageDocument(*plain([getattr(one, name) for name in OUTAGE_KEYS])) for one in report.outages),
        worst=tuple(map(_trial_document, report.worst)),
        examples=tuple(map(_trial_document, report.examples)),
    )  # fmt: skip


HISTOGRAM_COLUMNS = ("model", "horizon_m", "bin_left_m", "bin_right_m", "percent")

OUTAGE_KEYS = OutageDocument.__struct_fields__

WORST_COLUMNS = (
    "rank", "model", "stamp_ns", "t_s", "north_m", "east_m", "horizon_m", "heading_change_deg", "speed_mean_mps",
    *(f"{model}_error_m" for model in ERROR_COLUMNS),
)  # fmt: skip


def _model_document(result: ModelResult, rows: list[SummaryRow], report: DropoutReport) -> ModelDocument:
    """Return one model's `rows` of summary.csv, under its name."""
    used = next((one for one in report.calibrations if one.name == result.name), None)
    knows = used.fitted if used is not None else KNOWS.get(result.name, "the rest of the drive")
    blocks = [
        BlocksDocument(
            horizon, **plain(sums._asdict() | {"errors_m": [float(f"{error:.6g}") for error in sums.errors_m]})
        )
        for horizon, sums in zip(report.horizons_m.tolist(), result.block_sums, strict=False)
        if sums is not None
    ]
    return ModelDocument(result.name, result.label, knows, rows, blocks)


def _baseline_document(report: DropoutReport) -> BaselineDocument | None:
    one, run = report.baseline, report.run_document
    if one is None:
        return None
    return BaselineDocument(one.path, one.log, one.tool_version, one.is_of(run), one.changes(run))


def _count_documents(report: DropoutReport) -> tuple[CountDocument, ...]:
    """Return how many starts were a trial at each horizon, and why the others were none."""
    counts, reasons = report.counts, no_trial(report)
    return tuple(
        CountDocument(
            horizon,
            int(counts.trials[h]),
            {key: int(starts[h]) for key, (_, starts) in reasons.items()},
            why_no_trial(report, h),
        )
        for h, horizon in enumerate(report.horizons_m.tolist())
    )


def no_trial(report: DropoutReport) -> dict[str, tuple[str, Ints]]:
    """Return the reasons why starts gave no trial: in words, and how many starts (h,)."""
    counts, cost = report.counts, report.event_cost
    driven = distance_text(report.run_document.drive.distance_m)
    slip = cost.trials if cost is not None else np.zeros_like(counts.short)
    return {
        "too_little_way_left": (f"less than that is left of the {driven} driven", counts.short),
        "across_wheel_gap": ("the path crosses a gap in the wheel data", counts.gap),
        "ends_in_gnss_outage": ("it ends in a GNSS outage", counts.outage),
        "from_standstill": ("the robot stands", counts.standing),
        "crosses_jump": ("the reference jumps on the path", counts.crosses_jump),
        "across_slip_event": ("the path crosses a slip event", slip),
    }


def why_no_trial(report: DropoutReport, h: int) -> str | None:
    """Return why a horizon has no trial, None where it has some."""
    counts, reasons = report.counts, no_trial(report)
    if not len(counts.trials) or counts.trials[h]:
        return None
    if counts.short[h] == report.states:
        return reasons["too_little_way_left"][0]
    return ", ".join(f"{why} ({int(starts[h]):,} starts)" for why, starts in reasons.values() if starts[h])


def _event_document(report: DropoutReport) -> EventCostDocument | None:
    """Return what slip events cost, None where they count."""
    cost = report.event_cost
    if cost is None:
        return None
    return EventCostDocument(
        cost.events, {name: _summary_rows(report, summary) for name, summary in cost.with_events.items()}
    )


def _reference_rows(report: DropoutReport) -> tuple[ReferenceRow, ...]:
    """Return the reference's own error at each horizon: what a perfect model would show."""
    own = report.reference_error
    return () if own is None else tuple(map(ReferenceRow, *plain([report.horizons_m, *own])))


def _learned_document(report: DropoutReport) -> LearnedDocument | None:
    """Return the trials before and after the ICRs were first learned."""
    split = report.by_learning
    if split is None:
        return None
    sides = (_summary_rows(report, one) for one in (split.before, split.after))
    return LearnedDocument("icr", split.learned_s, split.distance_m, *sides)


def _summary_rows(report: DropoutReport, summary: Summary) -> list[ErrorRow]:
    return list(map(ErrorRow, *plain([report.horizons_m, *error_columns(summary).values()])))


def _trial_document(trial: ExampleTrial) -> TrialDocument:
    return TrialDocument(*plain([
        trial.model, trial.stamp_ns, trial.t_s, trial.north_m, trial.east_m, trial.horizon_m,
        np.degrees(trial.heading_change_rad), trial.speed_mean_mps, trial.errors_m,
    ]))  # fmt: skip


def _histogram_rows(report: DropoutReport) -> Iterator[tuple[Any, ...]]:
    for result in report.results:
        for horizon, bins in zip(report.horizons_m, result.histograms, strict=True):
            for row in zip(*bins, strict=True):
                yield result.name, horizon, *row


def _worst_rows(worst: Sequence[ExampleTrial]) -> Iterator[tuple[Any, ...]]:
    for rank, trial in enumerate(worst, start=1):
        *columns, errors = msgspec.structs.astuple(_trial_document(trial))
        yield rank, *columns, *(errors.get(model) for model in ERROR_COLUMNS)


COMPARISON_COLUMNS = (
    "model", "fitted", "heading", "horizon_m", "trials", "expected_error_m", "p50_m", "p95_m", "max_m",
    "expected_pct", "p95_pct",
)  # fmt: skip


def compared_results(report: DropoutReport) -> list[ModelResult]:
    """Return the rows of the comparison: all of the report but those of calibrations."""
    given = {one.name for one in report.calibrations}
    return [one for one in report.results if one.name not in given]


def fitted_text(name: str, heading: str) -> str:
    """Return what the numbers of a row were fitted to; `heading` is what rows with a measured one go by."""
    return FITTED[FITTED_TO.get(name.removesuffix(f"_{heading}") if heading else name, "others")]


def comparison_rows(report: DropoutReport, comparison: ModelComparison) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of ladder.csv, a model and horizon each; see `COMPARISON_COLUMNS`."""
    for one in compared_results(report):
        fitted, heading = fitted_text(one.name, comparison.heading), _heading(one.name, comparison)
        for row in rows_of({"horizon_m": report.horizons_m, **error_columns(one.summary)}):
            shares = (100.0 * row[name] / row["horizon_m"] for name in ("expected_error_m", "p95_m"))
            yield one.name, fitted, heading, *row.values(), *shares


def comparison_document(report: DropoutReport) -> LadderDocument:
    """Return what report.json holds; why there is none where it was left out."""
    comparison = report.comparison
    if comparison is None:
        return LadderDocument(left_out=report.no_comparison)
    heading = comparison.heading
    return LadderDocument(
        horizons_m=report.horizons_m.tolist(),
        blocks=comparison.blocks,
        starts=comparison.starts,
        heading=heading or None,
        notes=list(comparison.notes),
        models=[
            ScoreDocument(
                one.name, one.label, fitted_text(one.name, heading), _heading(one.name, comparison),
                *plain(list(error_columns(one.summary).values())),
            )
            for one in compared_results(report)
        ],
        width_m=comparison.width_m,
        fits={name: _fit(fit) for name, fit in comparison.fits.items()},
    )  # fmt: skip


def _fit(fit: FittedModel) -> FitDocument:
    """Return the parameters of a fit with one standard deviation."""
    columns = (fit.parameters, np.sqrt(np.diag(fit.covariance)))
    return FitDocument(*(plain(dict(zip(fit.model.terms, column, strict=True))) for column in columns))


def _heading(name: str, comparison: ModelComparison) -> str:
    turned = comparison.heading and name.endswith(f"_{comparison.heading}")
    return comparison.heading if turned else "wheels"
