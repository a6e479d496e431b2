"""``RUN/dropout/``: what `icrtool dropout-report` leaves behind, whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from icrtool import __version__
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.dropout_analysis.trials import ErrorSink
from icrtool.kernels.arrays import Ints
from icrtool.kernels.open_loop.block_sums import FEWEST_BLOCKS, HORIZONS_A_BLOCK, LEVEL, MOST_BLOCKS
from icrtool.kernels.open_loop.prefix_sums import TOLERANCE_M
from icrtool.kernels.open_loop.trials import Summary
from icrtool.output.files.atomic import atomic_directory
from icrtool.output.files.checksums import list_anew
from icrtool.output.files.csv_file import csv_bytes
from icrtool.output.files.json_file import json_bytes, schema_of
from icrtool.output.files.own_files import files_in
from icrtool.output.files.states_file import trials_file
from icrtool.output.run_directory import is_run_directory
from icrtool.output.tables.dropout import no_trial, why_no_trial
from icrtool.output.tables.model_comparison import COMPARISON_COLUMNS, comparison_document, comparison_rows
from icrtool.records.dropout import ExampleTrial, ModelResult, error_columns
from icrtool.records.late_output import FigureSet
from icrtool.records.plain_data import rows_of

REPORT_FILE = "report.json"
TRIALS_FILE = "trials.parquet"
DROPOUT_DIRECTORY = "dropout"
"""Where a report stands in its run directory."""
DROPOUT_SCHEMA = "icrtool/dropout/1"
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


def report_document(report: DropoutReport) -> dict[str, Any]:
    """Return what report.json holds."""
    run = report.run_document
    return {
        "schema": DROPOUT_SCHEMA,
        "tool_version": __version__,
        "run": {key: getattr(run, key) for key in RUN_KEYS},
        "usable": run.usable,
        "unusable_because": run.unusable_because,
        "reference": f"the {'smoother' if report.smoothed else 'filter'}'s estimate at the end of the trial",
        "smoothed": report.smoothed,
        "starts": report.states,
        "starts_counted": report.starts,
        "starts_standing": report.standing,
        "with_jumps": report.with_jumps,
        "without_events": _event_document(report),
        "tolerance_m": TOLERANCE_M,
        # how the intervals were found: the key and its parts keep their names; nothing is resampled
        "bootstrap": {
            "method": "Student's t over blocks of path",
            "block": f"{HORIZONS_A_BLOCK} horizons or more, {FEWEST_BLOCKS} to {MOST_BLOCKS} blocks",
            "resamples": 0,
            "level": LEVEL,
            "seed": report.seed,
        },
        "models": [_model_document(result, report) for result in report.results],
        "trials": _count_documents(report),
        "reference_error": _reference_rows(report),
        "by_learning": _learned_document(report),
        "calibrations": [one._asdict() | {"fitted": one.fitted_text} for one in report.calibrations],
        # Without when it was made: the same run, the same file.
        "recommended": report.calibration
        and msgspec.structs.replace(report.calibration.document(), created=msgspec.UNSET),
        "budgets": [one._asdict() for one in report.budgets],
        "by_turning": [one._asdict() for one in report.by_turning],
        "ladder": comparison_document(report),
        "gates": [
            {**asdict(one.gate), **{key: getattr(one, key) for key in VERDICT_KEYS}, "value_bound_m": one.bound_m,
             "not_checked": one.not_checked or None, "unusable": one.unusable or None, "verdict": one.line()}
            for one in report.verdicts
        ],
        "passed": report.passed,
        "baseline": _baseline_document(report),
        "outages": [{name: getattr(one, name) for name in OUTAGE_KEYS} for one in report.outages],
        "worst": [_trial_document(one) for one in report.worst],
        "examples": [_trial_document(one) for one in report.examples],
    }  # fmt: skip


RUN_KEYS = ("schema", "tool_version", "log", "inputs", "config", "drive", "icr")

HISTOGRAM_COLUMNS = ("model", "horizon_m", "bin_left_m", "bin_right_m", "percent")

VERDICT_KEYS = ("value_m", "baseline_m", "margin_m", "margin_low_m", "margin_high_m", "passed")

OUTAGE_KEYS = ("kind", "begin_s", "end_s", "distance_m", "end_error_m", "max_error_m")

WORST_COLUMNS = (
    "rank", "model", "stamp_ns", "t_s", "north_m", "east_m", "horizon_m", "heading_change_deg", "speed_mean_mps",
    *(f"{model}_error_m" for model in ERROR_COLUMNS),
)  # fmt: skip


def _model_document(result: ModelResult, report: DropoutReport) -> dict[str, Any]:
    """Return one model's rows of summary.csv, under its name."""
    rows = [row for row in rows_of(report.summary_columns()) if row.pop("model") == result.name]
    used = next((one for one in report.calibrations if one.name == result.name), None)
    knows = used.fitted_text if used is not None else KNOWS.get(result.name, "the rest of the drive")
    blocks = [
        {"horizon_m": horizon, **sums._asdict(), "errors_m": [float(f"{error:.6g}") for error in sums.errors_m]}
        for horizon, sums in zip(report.horizons_m, result.block_sums, strict=False)
        if sums is not None
    ]
    return {"name": result.name, "label": result.label, "knows": knows, "by_horizon": rows, "blocks": blocks}


def _baseline_document(report: DropoutReport) -> dict[str, Any] | None:
    one, run = report.baseline, report.run_document
    if one is None:
        return None
    return {"path": one.path, "log": one.log, "tool_version": one.tool_version, "same_recording": one.is_of(run),
            "changes": one.changes(run)}  # fmt: skip


def _count_documents(report: DropoutReport) -> list[dict[str, Any]]:
    """Return how many starts were a trial at each horizon, and why the others were none."""
    reasons = no_trial(report)
    return [
        {
            "horizon_m": horizon,
            "trials": report.counts.trials[h],
            "no_trial": {one.key: one.starts[h] for one in reasons},
            "why_none": why_no_trial(report, h),
        }
        for h, horizon in enumerate(report.horizons_m)
    ]


def _event_document(report: DropoutReport) -> dict[str, Any] | None:
    """Return what slip events cost, None where they count."""
    cost = report.event_cost
    if cost is None:
        return None
    with_events = {name: _summary_rows(report, summary) for name, summary in cost.with_events.items()}
    return {"events": cost.events, "with_events": with_events}


def _reference_rows(report: DropoutReport) -> list[dict[str, Any]]:
    """Return the reference's own error at each horizon: what a perfect model would show."""
    own = report.reference_error
    if own is None:
        return []
    return rows_of({"horizon_m": report.horizons_m, "std_m": own[0], "expected_m": own[1], "p95_m": own[2]})


def _learned_document(report: DropoutReport) -> dict[str, Any] | None:
    """Return the trials before and after the ICRs were first learned."""
    split = report.by_learning
    if split is None:
        return None
    return {
        "model": "icr", "learned_s": split.learned_s, "learned_at_distance_m": split.distance_m,
        "before": _summary_rows(report, split.before), "after": _summary_rows(report, split.after),
    }  # fmt: skip


def _summary_rows(report: DropoutReport, summary: Summary) -> list[dict[str, Any]]:
    return rows_of({"horizon_m": report.horizons_m, **error_columns(summary)})


def _trial_document(trial: ExampleTrial) -> dict[str, Any]:
    return {
        "model": trial.model, "stamp_ns": trial.stamp_ns, "t_s": trial.t_s, "north_m": trial.north_m,
        "east_m": trial.east_m,
        "horizon_m": trial.horizon_m, "heading_change_deg": float(np.degrees(trial.heading_change_rad)),
        "speed_mean_mps": trial.speed_mean_mps, "errors_m": trial.errors_m,
    }  # fmt: skip


def _histogram_rows(report: DropoutReport) -> Iterator[tuple[Any, ...]]:
    for result in report.results:
        for horizon, bins in zip(report.horizons_m, result.histograms, strict=True):
            for row in zip(*bins, strict=True):
                yield result.name, horizon, *row


def _worst_rows(worst: Sequence[ExampleTrial]) -> Iterator[tuple[Any, ...]]:
    for rank, trial in enumerate(worst, start=1):
        document = _trial_document(trial)
        errors = document.pop("errors_m")
        yield rank, *document.values(), *(errors.get(model) for model in ERROR_COLUMNS)
