"""The complete dropout report of a run, as ``icrtool dropout-report`` gives it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET
from msgspec.structs import astuple

from icrtool import __version__
from icrtool.calibration.calibration_rows import calibrated_drive
from icrtool.calibration.other_grounds import other_ground_ends
from icrtool.calibration.pooled import turning_recording_of
from icrtool.calibration.record import Calibration
from icrtool.calibration.run_models import ComparedModels, ComparedRow, Model, compare_models, with_poses_of
from icrtool.dropout_analysis import report, shown_paths
from icrtool.dropout_analysis.guard import why_unusable
from icrtool.dropout_analysis.starts import split_by_turning, with_smoothed_reference
from icrtool.dropout_analysis.topic_rows import topic_rows
from icrtool.dropout_analysis.trials import ErrorSink, measure_errors
from icrtool.errors import ConfigError, DataError
from icrtool.estimation.odometry import measured_headings
from icrtool.kernels.error_statistics import (
    FEWEST_PATH_BLOCKS,
    HORIZONS_A_BLOCK,
    LEVEL,
    MOST_PATH_BLOCKS,
    NEXT_LEVEL,
)
from icrtool.kernels.open_loop import TOLERANCE_M
from icrtool.logs.topic_poses import read_topic_poses
from icrtool.motion.models import RECOMMENDED
from icrtool.records import dropout_document as documents
from icrtool.records.acceptance import DEFAULT_SEED, BudgetDistance, Gate, Verdict
from icrtool.records.calibration_document import CalibrationFile
from icrtool.records.choices import Reference, Starts
from icrtool.records.dropout_document import TurningSplit, UsedCalibration
from icrtool.records.notes import Note, warnings_of
from icrtool.records.plain_data import plain_value
from icrtool.records.requests import ReportRequest
from icrtool.records.rows import TOPIC_ROW, kind_of, turned_by
from icrtool.records.run import MAKE_RUN, Run, check_type, track_of
from icrtool.records.stages import Watch, unwatched
from icrtool.records.text import distance_text
from icrtool.records.topic_poses import TopicPoses

ERROR_FIELDS = len(documents.ErrorRow.__struct_fields__)
"""Number of fields of `ErrorRow`, which are the first fields of `SummaryRow`."""


def dropout(
    run: Run,
    horizons_m: Sequence[float] | None = None,
    *,
    starts: Starts = "moving",
    models: Sequence[Model] | None = None,
    seed: int = DEFAULT_SEED,
    sink: ErrorSink | None = None,
) -> report.DropoutReport:
    """Return the errors of the predicted position after distances without GNSS (Pentzer 2014, Section 6.4).

    Parameters
    ----------
    run : of `icrtool.fit` or `icrtool.open_run`
    horizons_m : distances without GNSS, in any order; default: from the run's configuration
    starts : ``moving`` counts each standstill once, ``all`` takes every recorded state, as the paper does
    models : models that predict; default: `models_of` of the run
    seed : seed of the random draws of the reference's own error
    sink : receives every error (for ``--trials``)

    Returns
    -------
    DropoutReport
        Mean, median, 95th percentile and largest error [m] by model and horizon, with intervals; no file is touched.

    Raises
    ------
    DataError
        The run has fewer than two states.
    ConfigError
        A horizon is not a positive number.
    ValueError
        Two models have the same name.

    Notes
    -----
    A trial starts at a recorded state and keeps its ICRs; wheel speeds alone predict the path. The error is the
    horizontal distance to the filter's estimate at the first state that is one horizon further along the path. A start
    gives no trial if less path is left, if the path crosses a gap in the wheel data, or if it ends in a GNSS outage of
    the log. Only the last state of a standstill starts trials, because the other states would repeat the same trial,
    and a parked robot would decide the result. Overlapping trials are not independent, so the intervals come from
    blocks of path of at least four horizons (`icrtool.kernels.error_statistics`).
    """
    check_type(run, Run, MAKE_RUN)
    request = ReportRequest(
        horizons_m=None if horizons_m is None else tuple(horizons_m), budgets_m=(), starts=starts, ladder=False,
        seed=seed,
    )  # fmt: skip
    horizons_m = request.horizons_m if request.horizons_m is not None else run.config.dropout.horizons_m
    errors = measure_errors(run, horizons_m, starts=starts, seed=seed, models=models, sink=sink)
    return _report(run, errors, request)


def dropout_report(
    run: Run,
    *,
    horizons_m: Sequence[float] | None = None,
    budgets_m: Sequence[float] = (0.5,),
    gates: Sequence[str | Gate] = (),
    strict_gates: bool = False,
    allow_unusable: bool = False,
    outage_s: Sequence[float] | None = None,
    outage_at_s: Sequence[float] = (),
    starts: Starts = "moving",
    reference: Reference = "filter",
    without_events: bool = False,
    with_jumps: bool = False,
    refit_sensors: bool = False,
    ladder: bool = True,
    score: Sequence[str] = (),
    seed: int = DEFAULT_SEED,
    log: str | Path | None = None,
    calibrations: Sequence[Calibration] = (),
    baseline: report.BaselineReport | None = None,
    sink: ErrorSink | None = None,
) -> report.DropoutReport:
    """Return the complete dropout report of a run, with all results of ``icrtool dropout-report``.

    Parameters
    ----------
    run : result of `icrtool.fit` or `icrtool.open_run`
    horizons_m, budgets_m : distances without GNSS [m]; largest allowed errors [m], for which the distance is reported
    gates, strict_gates, allow_unusable : acceptance limits, and how they are checked
    outage_s, outage_at_s : lengths and start times of forced outages [s]
    starts, reference : states that trials start from; estimates that trials are compared with
    without_events, with_jumps : leave out trials across slip events; count trials across jumps of the reference
    refit_sensors : refit heading offset, delays and gyro bias of `calibrations` in this log
    ladder, seed : test models on held-out distance; seed of the random draws
    score : topics of poses in the log; each becomes a row ``topic:NAME``
    log : the log of the run, as `icrtool.read_log` takes it; scored topics are read from it
    calibrations : results of `icrtool.calibrate` or `icrtool.open_calibration`. Each becomes a row ``calibration``; one
        of several becomes ``calibration:STEM`` with the stem of its file. If calibration and log have a gyro, there is
        also a row with the suffix ``_gyro``. Row ``adaptive`` begins with the first calibration that was not fitted to
        this log, else with the prior of other robots
    baseline : an earlier report, for limits such as ``"icr.p95@10m <= 1.1 * baseline"``
    sink : receives every error, see `icrtool.dropout_analysis.trials.ErrorSink`

    Raises
    ------
    ConfigError
        A limit, horizon, budget, outage or scored topic cannot be used, or a calibration is of another robot.
    DataError
        The run has fewer than two states.
    LogError
        The log of scored topics cannot be read.
    RunError
        The reference is ``smoothed`` and the run has no smoothed states.

    Notes
    -----
    `icrtool.records.requests.ReportRequest` has fields of the same names, and states the meaning of each.
    """
    request = ReportRequest(
        horizons_m=None if horizons_m is None else tuple(horizons_m),
        budgets_m=tuple(budgets_m),
        gates=tuple(gate.text if isinstance(gate, Gate) else gate for gate in gates),
        strict_gates=strict_gates,
        allow_unusable=allow_unusable,
        outage_s=None if outage_s is None else tuple(outage_s),
        outage_at_s=tuple(outage_at_s),
        starts=starts,
        reference=reference,
        without_events=without_events,
        with_jumps=with_jumps,
        refit_sensors=refit_sensors,
        ladder=ladder,
        score=tuple(score),
        seed=seed,
    )
    return report_on(run, request, log=log, calibrations=calibrations, baseline=baseline, sink=sink)


def report_on(
    run: Run,
    request: ReportRequest,
    *,
    log: str | Path | None = None,
    calibrations: Sequence[Calibration] = (),
    baseline: report.BaselineReport | None = None,
    sink: ErrorSink | None = None,
    watch: Watch = unwatched,
) -> report.DropoutReport:
    """Return the dropout report of a request.

    `dropout_report` describes the other parameters and the errors. `watch` is called with the name of each stage when
    it begins.
    """
    check_type(run, Run, MAKE_RUN)
    watch("outages and examples")
    limits = [report.parse_gate(gate) for gate in request.gates]
    runs = _Runs.from_request(run, request)
    plans = _outage_plans(runs.filtered, request)
    scored = _scored_topics(request, log)
    forced = [outage for plan in plans for outage in shown_paths.force_outages(runs.filtered, plan)]
    compared = runs.compared
    unusable = "" if run.usable or request.allow_unusable else str(run.document.unusable_because)
    # Both are computed and released before the models are compared, which needs columns of the same size.
    examples, by_turning = shown_paths.example_trials(compared), split_by_turning(compared, request.starts)
    rows = _TestedRows((), (), (), (), None, unusable)
    if not unusable:
        rows = _tested_rows(runs, calibrations, scored, request, watch)
    compared_models, horizons_m = rows.compared_models, _horizons_of(run, request, limits)
    errors = measure_errors(
        compared, horizons_m, further=rows.all, starts=request.starts, seed=request.seed, sink=sink,
        starts_of_further=None if compared_models is None else compared_models.table.trials[0].starts,
        track=None if compared_models is None else compared_models.track, watch=watch,
    )  # fmt: skip
    watch("budgets and limits")
    if compared_models is not None and (
        against := why_unusable(run.document, errors, [row.name for row in compared_models.rows])
    ):
        compared, errors = _contradicted(compared, errors, against)
        compared_models, unusable = (
            compared_models._replace(calibration=None),
            "" if request.allow_unusable else against.text,
        )
    cost = None
    if request.without_events:
        crossed = replace(compared, in_gap=runs.with_events.in_gap)
        cost = measure_errors(crossed, horizons_m, starts=request.starts, seed=request.seed)
    by_start = shown_paths.errors_by_start(compared, compared_models, starts=request.starts)
    budgets_m = () if unusable else request.budgets_m
    budgets = [reach for budget_m in budgets_m for reach in report.budget_distances(errors, budget_m)]
    return _report(
        compared, errors, request,
        with_events=cost,
        compared_models=compared_models,
        left_out=rows.left_out,
        calibrations=rows.calibrations,
        examples=examples,
        worst=shown_paths.worst_trials(compared, compared_models, further=rows.of_topics, errors=by_start),
        path_errors=by_start.on_path,
        outages=(*forced, *shown_paths.real_outages(compared)),
        budgets=with_other_grounds(budgets, rows.calibrations),
        gates=tuple(
            report.verdict_on(gate, run.name, passed=False, unusable=unusable)
            if unusable
            else report.check_gate(gate, errors, baseline, strict=request.strict_gates)
            for gate in limits
        ),
        usable=not unusable,
        baseline=baseline,
        by_turning=by_turning,
        notes=rows.notes,
    )  # fmt: skip


class _Runs(NamedTuple):
    """The run of a report in three forms. A form is the run itself if the request does not change it.

    Attributes
    ----------
    with_events : the run whose trials may cross slip events
    filtered : the run with the filter's poses; slip events are gaps if the request leaves them out
    compared : the run with the poses that trials are compared with
    """

    with_events: Run
    filtered: Run
    compared: Run

    @classmethod
    def from_request(cls, run: Run, request: ReportRequest) -> _Runs:
        """Return the forms of a run for a request.

        Raises
        ------
        RunError
            The reference is ``smoothed`` and the run has no smoothed states.
        """
        if request.with_jumps:
            run = replace(run, sensors=replace(run.sensors, jumps=()))
        # No trial, window or forced outage crosses a gap.
        filtered = replace(run, in_gap=run.in_gap | run.slipping) if request.without_events else run
        return cls(run, filtered, with_smoothed_reference(filtered) if request.reference == "smoothed" else filtered)


def _outage_plans(run: Run, request: ReportRequest) -> list[tuple[tuple[int, int], ...]]:
    """Return the begins and ends [ns] of the forced outages of each length."""
    lengths_s = forced_lengths_s(run, request)
    if request.outage_at_s and not lengths_s:
        raise ConfigError("outage_at_s", "gives begins of outages without a length", "give outage_s too")
    return [shown_paths.plan_outages(run, length, request.outage_at_s) for length in lengths_s]


def _horizons_of(run: Run, request: ReportRequest, limits: Iterable[Gate]) -> list[float]:
    """Return the requested or else configured horizons [m], and the horizons of acceptance limits."""
    horizons_m = list(request.horizons_m if request.horizons_m is not None else run.config.dropout.horizons_m)
    for at_m in (gate.horizon_m for gate in limits):
        if at_m is not None and not any(math.isclose(at_m, horizon, rel_tol=1e-9) for horizon in horizons_m):
            horizons_m.append(at_m)
    return horizons_m


class _TestedRows(NamedTuple):
    """The rows of a report that do not come from the filter's ICRs.

    Attributes
    ----------
    of_calibrations, of_topics : rows of the calibrations, and of the scored topics
    calibrations : the record of each used calibration
    notes : findings about the sensors of calibrations, and about topics
    compared_models : the rows of this log's own models; None if they were left out
    left_out : reason for which they were left out
    """

    of_calibrations: Sequence[ComparedRow]
    of_topics: Sequence[ComparedRow]
    calibrations: tuple[UsedCalibration, ...]
    notes: tuple[Note, ...]
    compared_models: ComparedModels | None
    left_out: str

    @property
    def all(self) -> list[ComparedRow]:
        """All rows, in the order of the report."""
        return [
            *(() if self.compared_models is None else self.compared_models.rows),
            *self.of_calibrations,
            *self.of_topics,
        ]


def _tested_rows(
    runs: _Runs, calibrations: Sequence[Calibration], scored: Sequence[TopicPoses], request: ReportRequest, watch: Watch
) -> _TestedRows:
    """Return the rows of calibrations, of scored topics and of this log's own models."""
    filtered, compared = runs.filtered, runs.compared
    watch("calibrations")
    used, of_calibrations, notes = _calibration_rows(compared, filtered, calibrations, request)
    of_topics, topic_notes = topic_rows(compared, track_of(compared), scored) if scored else ([], [])
    compared_models, left_out = None, ""
    if request.ladder:
        watch("comparing models")
        try:
            compared_models = compare_models(
                compared, measured_headings(filtered), calibrations, filtered, refit_sensors=request.refit_sensors
            )
        except DataError as err:
            left_out = f"{err.why}, {err.advice}"
    return _TestedRows(of_calibrations, of_topics, used, (*notes, *topic_notes), compared_models, left_out)


def _contradicted(run: Run, errors: report.OpenLoopErrors, why: Note) -> tuple[Run, report.OpenLoopErrors]:
    """Return a run and its errors, marked as not usable; the errors stay in the report to show the contradiction."""
    document = msgspec.structs.replace(
        run.document, usable=False, unusable_because=why.text, recommended=None, notes=(*run.document.notes, why)
    )
    return replace(run, document=document), replace(errors, run_document=document)


def _scored_topics(request: ReportRequest, log: str | Path | None) -> Sequence[TopicPoses]:
    """Return the poses of the requested topics.

    Raises
    ------
    ConfigError
        There is no log to read the topics from, or a topic cannot be used.
    LogError
        The log cannot be read.
    """
    if not request.score:
        return ()
    if log is None:
        why = "a run holds no poses of other topics, and opens no log by itself"
        raise ConfigError("score", why, "give the log that the run was made of")
    return read_topic_poses(log, list(dict.fromkeys(request.score)))


def _report(
    run: Run, errors: report.OpenLoopErrors, request: ReportRequest, *,
    with_events: report.OpenLoopErrors | None = None, calibrations: tuple[UsedCalibration, ...] = (),
    budgets: tuple[BudgetDistance, ...] = (), gates: tuple[Verdict, ...] = (),
    by_turning: tuple[TurningSplit, ...] = (), compared_models: ComparedModels | None = None, left_out: str = "",
    worst: tuple[documents.ExampleTrial, ...] = (), examples: tuple[documents.ExampleTrial, ...] = (),
    outages: tuple[documents.Outage, ...] = (), baseline: report.BaselineReport | None = None, usable: bool = True,
    notes: tuple[Note, ...] = (), path_errors: documents.PathErrors | None = None,
) -> report.DropoutReport:  # fmt: skip
    """Return the report of a run.

    Parameters
    ----------
    errors : errors of the models of the run
    with_events : errors of all trials, if `errors` leaves out the trials that cross a slip event
    notes : notes about the rows, in addition to the notes of the run
    """
    calibration = None if compared_models is None else compared_models.calibration
    notes = (*run.notes, *(() if compared_models is None else compared_models.notes), *notes)
    event_cost = None
    if with_events is not None:
        all_rows = {result.name: result.document.by_horizon for result in with_events.results}
        numbers = {
            name: [documents.ErrorRow(*astuple(row)[:ERROR_FIELDS]) for row in rows] for name, rows in all_rows.items()
        }
        event_cost = documents.EventCostDocument(len(run.sensors.events), numbers)
    earlier = None
    if baseline is not None:
        same, changes = baseline.is_of(run.document), baseline.changes(run.document)
        earlier = documents.BaselineDocument(baseline.path, baseline.log, baseline.tool_version, same, changes)
    document = documents.DropoutDocument(
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
        without_events=event_cost,
        tolerance_m=TOLERANCE_M,
        intervals=documents.IntervalsDocument(
            method="Student's t over blocks of path",
            block=f"{HORIZONS_A_BLOCK} horizons or more, {FEWEST_PATH_BLOCKS} to {MOST_PATH_BLOCKS} blocks",
            level=LEVEL,
            seed=request.seed,
            next_level=NEXT_LEVEL,
        ),
        models=tuple(result.document for result in errors.results),
        trials=tuple(_counts(errors, with_events)),
        reference_error=errors.reference,
        by_learning=errors.by_learning,
        calibrations=calibrations,
        # The date is left out, so that the same run gives the same file.
        recommended=None if calibration is None else msgspec.structs.replace(calibration, created=UNSET),
        budgets=budgets,
        best=report.best_row(errors, calibrations) if usable else None,
        by_turning=by_turning,
        ladder=_ladder(errors, calibrations, compared_models, left_out),
        gates=gates,
        passed=all(verdict.passed for verdict in gates),
        baseline=earlier,
        outages=tuple(outage.document for outage in outages),
        worst=tuple(trial.document for trial in worst),
        examples=tuple(trial.document for trial in examples),
    )
    return report.DropoutReport(
        **{field.name: getattr(errors, field.name) for field in fields(errors)}, document=document,
        run_directory=run.directory, reference_north_m=run.table.north_m, reference_east_m=run.table.east_m,
        usable=usable, worst=worst, examples=examples, outages=outages, path_errors=path_errors,
        calibration=calibration, baseline=baseline,
    )  # fmt: skip


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


def _ladder(
    errors: report.OpenLoopErrors,
    calibrations: Sequence[UsedCalibration],
    compared_models: ComparedModels | None,
    why_none: str,
) -> documents.LadderDocument:
    """Return the comparison of the models, or why it was left out."""
    if compared_models is None:
        return documents.LadderDocument(left_out=why_none)
    of_calibrations, turned = {used.name for used in calibrations}, f"_{compared_models.heading}"
    models = []
    for result in errors.results:
        if result.name not in of_calibrations and kind_of(result.name) != TOPIC_ROW:
            with_heading = bool(compared_models.heading) and result.name.endswith(turned)
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


def forced_lengths_s(run: Run, request: ReportRequest) -> Sequence[float]:
    """Return the lengths [s] of the forced outages, from the request or else from the run's configuration."""
    return request.outage_s if request.outage_s is not None else run.config.dropout.forced_outage_s


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
        by, row_kind = turned_by(reach.model), kind_of(reach.model)
        row = f"{RECOMMENDED if row_kind == 'calibration' else row_kind}{f'_{by}' if by else ''}"
        of_row = {"calibration": scores.get(reach.model, ()), "adaptive": first}.get(row_kind, ())
        ends = other_ground_ends(of_row, row, reach.budget_m)
        if ends is None:
            distances.append(reach)
        else:
            distances.append(msgspec.structs.replace(reach, other_low_m=ends[0], other_high_m=ends[1]))
    return tuple(distances)


def _calibration_rows(
    run: Run, past: Run, calibrations: Sequence[Calibration], request: ReportRequest
) -> tuple[tuple[UsedCalibration, ...], list[ComparedRow], list[Note]]:
    """Return the record of each used calibration, the rows of the calibrations, and notes about their sensors.

    `past` is the run with the poses of the filter.
    """
    used, models, notes = [], [], list[Note]()
    if not calibrations:
        return (), [], []
    recording = turning_recording_of(run)
    driven = with_poses_of(recording, past)
    for number, calibration in enumerate(calibrations, start=1):
        name = "calibration"
        if len(calibrations) > 1:
            stem = calibration.name or str(number)
            if calibration.name and sum(other.name == calibration.name for other in calibrations) > 1:
                stem = f"{stem}-{number}"
            name = f"calibration:{stem}"
        created = calibration.created or ""
        of_sensors = dict.fromkeys(CalibrationFile.__struct_fields__[1:], UNSET)
        short_record = msgspec.structs.replace(calibration, models={}, held_out=(), name=UNSET, **of_sensors)
        fitted_to_this = calibration.fitted_to(recording.sha256)
        fitted = "fitted to this log" if fitted_to_this else "not fitted to this log"
        refitted = "; sensors refitted" if request.refit_sensors else ""
        rows = [(name, calibration.recommended, False)]
        if calibration.gyro is not None and recording.track.gyro is not None:
            rows.append((f"{name}_gyro", calibration.gyro.model, True))
        for row, model, with_gyro in rows:
            tested = calibrated_drive(
                calibration, recording, row, driven, with_gyro=with_gyro, refit_sensors=request.refit_sensors
            )
            models.append(ComparedRow(row, tested.drive.errors, knows=f"other logs ({fitted}); {tested.knows}"))
            notes += tested.notes
            words = f"{fitted}{refitted}", tested.sensors
            used.append(
                UsedCalibration(
                    row, model, len(calibration.logs), fitted_to_this, created, with_gyro, short_record, *words
                )
            )
    return tuple(used), models, notes
