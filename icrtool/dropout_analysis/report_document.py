"""The document of a dropout report: its numbers as report.json holds them, from measured errors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET
from msgspec.structs import astuple

from icrtool import __version__
from icrtool.calibration.other_grounds import other_ground_ends
from icrtool.calibration.run_models import ComparedModels
from icrtool.dropout_analysis import report
from icrtool.kernels.error_statistics import (
    FEWEST_PATH_BLOCKS,
    HORIZONS_A_BLOCK,
    LEVEL,
    MOST_PATH_BLOCKS,
    NEXT_LEVEL,
)
from icrtool.kernels.open_loop import TOLERANCE_M
from icrtool.motion.models import RECOMMENDED
from icrtool.records import dropout_document as documents
from icrtool.records.acceptance import BudgetDistance, Verdict
from icrtool.records.dropout_document import TurningSplit, UsedCalibration
from icrtool.records.notes import Note, warnings_of
from icrtool.records.plain_data import plain_value
from icrtool.records.requests import ReportRequest
from icrtool.records.rows import TOPIC_ROW, kind_of, turned_by
from icrtool.records.run import Run
from icrtool.records.text import distance_text

ERROR_FIELDS = len(documents.ErrorRow.__struct_fields__)
"""Number of fields of `ErrorRow`, which are the first fields of `SummaryRow`."""


class ReportParts(NamedTuple):
    """The parts of a report that a request may leave out, each computed from the run and its errors.

    Attributes
    ----------
    with_events : errors of all trials; given if the report leaves out the trials that cross a slip event
    calibrations : the record of each used calibration
    compared_models, left_out : the rows of this log's own models; why they were left out
    budgets, gates : distances within budgets, and verdicts on acceptance limits
    by_turning : errors of straight and of turning trials
    worst, examples, outages : trials and outages that are shown one by one
    path_errors : errors of trials along the path
    baseline : an earlier report
    usable : whether the numbers of the run may be used
    notes : notes about the rows, in addition to the notes of the run
    """

    with_events: report.OpenLoopErrors | None = None
    calibrations: tuple[UsedCalibration, ...] = ()
    compared_models: ComparedModels | None = None
    left_out: str = ""
    budgets: tuple[BudgetDistance, ...] = ()
    gates: tuple[Verdict, ...] = ()
    by_turning: tuple[TurningSplit, ...] = ()
    worst: tuple[documents.ExampleTrial, ...] = ()
    examples: tuple[documents.ExampleTrial, ...] = ()
    outages: tuple[documents.Outage, ...] = ()
    path_errors: documents.PathErrors | None = None
    baseline: report.BaselineReport | None = None
    usable: bool = True
    notes: tuple[Note, ...] = ()


def complete_report(
    run: Run, errors: report.OpenLoopErrors, request: ReportRequest, parts: ReportParts
) -> report.DropoutReport:
    """Return the report of a run from the errors of its models and the further parts."""
    compared = parts.compared_models
    return report.DropoutReport(
        **{field.name: getattr(errors, field.name) for field in fields(errors)},
        document=_document(run, errors, request, parts),
        run_directory=run.directory,
        reference_north_m=run.table.north_m,
        reference_east_m=run.table.east_m,
        usable=parts.usable,
        worst=parts.worst,
        examples=parts.examples,
        outages=parts.outages,
        path_errors=parts.path_errors,
        calibration=None if compared is None else compared.calibration,
        baseline=parts.baseline,
    )


def _document(
    run: Run, errors: report.OpenLoopErrors, request: ReportRequest, parts: ReportParts
) -> documents.DropoutDocument:
    """Return the content of report.json."""
    compared = parts.compared_models
    calibration = None if compared is None else compared.calibration
    notes = (*run.notes, *(() if compared is None else compared.notes), *parts.notes)
    return documents.DropoutDocument(
        schema=documents.DROPOUT_SCHEMA,
        tool_version=__version__,
        run=documents.RunOfReport(*(getattr(run.document, key) for key in documents.RunOfReport.__struct_fields__)),
        usable=run.usable,
        unusable_because=run.document.unusable_because,
        notes=notes,
        warnings=warnings_of(notes),
        request=request,
        starts=errors.states,
        starts_standing=errors.standing,
        without_events=_event_cost(run, parts.with_events),
        tolerance_m=TOLERANCE_M,
        intervals=documents.IntervalsDocument(
            method="Student's t over blocks of path",
            block=f"{HORIZONS_A_BLOCK} horizons or more, {FEWEST_PATH_BLOCKS} to {MOST_PATH_BLOCKS} blocks",
            level=LEVEL,
            seed=request.seed,
            next_level=NEXT_LEVEL,
        ),
        models=tuple(result.document for result in errors.results),
        trials=tuple(_counts(errors, parts.with_events)),
        reference_error=errors.reference,
        by_learning=errors.by_learning,
        calibrations=parts.calibrations,
        # The date is left out, so that the same run gives the same file.
        recommended=None if calibration is None else msgspec.structs.replace(calibration, created=UNSET),
        budgets=parts.budgets,
        best=report.best_row(errors, parts.calibrations) if parts.usable else None,
        by_turning=parts.by_turning,
        ladder=_ladder(errors, parts),
        gates=parts.gates,
        passed=all(verdict.passed for verdict in parts.gates),
        baseline=_earlier_report(run, parts.baseline),
        outages=tuple(outage.document for outage in parts.outages),
        worst=tuple(trial.document for trial in parts.worst),
        examples=tuple(trial.document for trial in parts.examples),
    )


def _event_cost(run: Run, with_events: report.OpenLoopErrors | None) -> documents.EventCostDocument | None:
    """Return the errors of all trials, the trials across slip events among them; None if no trial was left out."""
    if with_events is None:
        return None
    numbers = {
        model.name: [documents.ErrorRow(*astuple(row)[:ERROR_FIELDS]) for row in model.document.by_horizon]
        for model in with_events.results
    }
    return documents.EventCostDocument(len(run.sensors.events), numbers)


def _earlier_report(run: Run, baseline: report.BaselineReport | None) -> documents.BaselineDocument | None:
    """Return what a report states of its baseline; None without one."""
    if baseline is None:
        return None
    same, changes = baseline.is_of(run.document), baseline.changes(run.document)
    return documents.BaselineDocument(baseline.path, baseline.log, baseline.tool_version, same, changes)


def _counts(
    errors: report.OpenLoopErrors, with_events: report.OpenLoopErrors | None
) -> Iterator[documents.CountDocument]:
    """Yield how many starts gave a trial at each horizon, and why the others gave none."""
    # The reasons are counted over all trials. With --without-events a slip event would be counted as a gap.
    counts = (with_events or errors).counts
    crossing = counts.trials - errors.counts.trials
    driven = distance_text(errors.run_document.drive.distance_m)
    reasons = {
        "too_little_way_left": (f"less than that is left of the {driven} driven", counts.short),
        "across_wheel_gap": ("the path crosses a gap in the wheel data", counts.gap),
        "ends_in_gnss_outage": ("it ends in a GNSS outage", counts.outage),
        "from_standstill": ("the robot stands", counts.standing),
        "crosses_jump": ("the reference jumps on the path", counts.crosses_jump),
        "across_slip_event": ("the path crosses a slip event", crossing),
    }
    for h, horizon_m in enumerate(errors.horizons_m.tolist()):
        trials, starts = int(errors.counts.trials[h]), {key: int(count[h]) for key, (_, count) in reasons.items()}
        why = ", ".join(f"{text} ({starts[key]:,} starts)" for key, (text, _) in reasons.items() if starts[key])
        if starts["too_little_way_left"] == errors.states:
            why = reasons["too_little_way_left"][0]
        yield documents.CountDocument(horizon_m, trials, starts, None if trials else why)


def _ladder(errors: report.OpenLoopErrors, parts: ReportParts) -> documents.LadderDocument:
    """Return the comparison of the models, or why it was left out."""
    compared_models = parts.compared_models
    if compared_models is None:
        return documents.LadderDocument(left_out=parts.left_out)
    calibration_names, heading_suffix = {used.name for used in parts.calibrations}, f"_{compared_models.heading}"
    models = []
    for result in errors.results:
        if result.name not in calibration_names and kind_of(result.name) != TOPIC_ROW:
            with_heading = bool(compared_models.heading) and result.name.endswith(heading_suffix)
            rows = [astuple(row)[1:ERROR_FIELDS] for row in result.document.by_horizon]
            heading = compared_models.heading if with_heading else "wheels"
            models.append(
                documents.ScoreDocument(
                    result.name, result.document.knows, heading, *map(list, zip(*rows, strict=True))
                )
            )
    table, fits = compared_models.table, {}
    for name, fit in table.fits.items():
        value, std = (dict(zip(fit.model.terms, column.tolist(), strict=True)) for column in (fit.parameters, fit.std))
        fits[name] = documents.FitDocument(plain_value(value), plain_value(std))
    return documents.LadderDocument(
        horizons_m=errors.horizons_m.tolist(),
        blocks=len(table.folds),
        starts=int(np.count_nonzero((table.trials[0].ends >= 0).any(axis=1))),
        heading=compared_models.heading or None,
        notes=list(compared_models.notes),
        models=models,
        width_m=table.recordings[0].width_m,
        fits=fits,
    )


def with_other_grounds(
    budgets: Iterable[BudgetDistance], calibrations: Sequence[UsedCalibration]
) -> tuple[BudgetDistance, ...]:
    """Return the distances within budgets; for rows with a calibration, with the interval on another ground."""
    scores = {
        used.name: used.calibration.other_grounds or ()
        for used in calibrations
        if used.calibration is not None and not used.fitted_to_this
    }
    # Row ``adaptive`` begins with the first calibration that was not fitted to this log.
    first = next(iter(scores.values()), ())
    distances = []
    for reach in budgets:
        turn_sensor, row_kind = turned_by(reach.model), kind_of(reach.model)
        row = f"{RECOMMENDED if row_kind == 'calibration' else row_kind}{f'_{turn_sensor}' if turn_sensor else ''}"
        row_scores = {"calibration": scores.get(reach.model, ()), "adaptive": first}.get(row_kind, ())
        ends = other_ground_ends(row_scores, row, reach.budget_m)
        if ends is None:
            distances.append(reach)
        else:
            distances.append(msgspec.structs.replace(reach, other_low_m=ends[0], other_high_m=ends[1]))
    return tuple(distances)
