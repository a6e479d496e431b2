"""The complete dropout report of a run, as ``icrtool dropout-report`` gives it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec

from icrtool.calibration.record import Calibration
from icrtool.calibration.run_models import Model
from icrtool.dropout_analysis import report, shown_paths
from icrtool.dropout_analysis.guard import why_unusable
from icrtool.dropout_analysis.report_document import ReportParts, complete_report, with_other_grounds
from icrtool.dropout_analysis.starts import split_by_turning, with_smoothed_reference
from icrtool.dropout_analysis.tested_rows import TestedRows, tested_rows
from icrtool.dropout_analysis.trials import ErrorSink, measure_errors
from icrtool.errors import ConfigError
from icrtool.logs.topic_poses import read_topic_poses
from icrtool.records.acceptance import DEFAULT_SEED, BudgetDistance, Gate, Verdict
from icrtool.records.choices import Reference, Starts
from icrtool.records.dropout_document import UsedCalibration
from icrtool.records.notes import Note
from icrtool.records.requests import ReportRequest
from icrtool.records.run import MAKE_RUN, Run, check_type
from icrtool.records.stages import Watch, unwatched
from icrtool.records.topic_poses import TopicPoses


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
    return complete_report(run, errors, request, ReportParts())


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
    horizons_m : distances without GNSS [m]; None: from the configuration
    budgets_m : largest allowed errors [m], for which the distance is reported
    gates : acceptance limits, as text or as `Gate`
    strict_gates : check limits relative to `baseline` by the number alone, without its interval
    allow_unusable : report all rows and distances of a run that is not usable, too
    outage_s : lengths of forced outages [s]; None: from the configuration
    outage_at_s : start times of forced outages since the first state [s]; empty: evenly spaced
    starts : states that trials start from
    reference : estimates that trials are compared with
    without_events : leave out trials across slip events
    with_jumps : count trials across jumps of the reference
    refit_sensors : refit heading offset, delays and gyro bias of `calibrations` in this log
    ladder : test models on held-out distance
    score : topics of poses in the log; each becomes a row ``topic:NAME``
    seed : seed of the random draws
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
        horizons_m=None if horizons_m is None else tuple(horizons_m), budgets_m=tuple(budgets_m),
        gates=tuple(gate.text if isinstance(gate, Gate) else gate for gate in gates), strict_gates=strict_gates,
        allow_unusable=allow_unusable, outage_s=None if outage_s is None else tuple(outage_s),
        outage_at_s=tuple(outage_at_s), starts=starts, reference=reference, without_events=without_events,
        with_jumps=with_jumps, refit_sensors=refit_sensors, ladder=ladder, score=tuple(score), seed=seed,
    )  # fmt: skip
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
    rows = TestedRows((), (), (), (), None, unusable)
    if not unusable:
        rows = tested_rows(compared, runs.filtered, calibrations, scored, request, watch)
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
        compared_models = compared_models._replace(calibration=None)
        unusable = "" if request.allow_unusable else against.text
    by_start = shown_paths.errors_by_start(compared, compared_models, starts=request.starts)
    parts = ReportParts(
        with_events=_errors_with_events(runs, compared, horizons_m, request),
        calibrations=rows.calibrations,
        compared_models=compared_models,
        left_out=rows.left_out,
        budgets=_distances_within(errors, () if unusable else request.budgets_m, rows.calibrations),
        gates=_verdicts(limits, errors, baseline, unusable, strict=request.strict_gates),
        by_turning=by_turning,
        worst=shown_paths.worst_trials(compared, compared_models, further=rows.of_topics, errors=by_start),
        examples=examples,
        outages=(*forced, *shown_paths.real_outages(compared)),
        path_errors=by_start.on_path,
        baseline=baseline,
        usable=not unusable,
        notes=rows.notes,
    )
    return complete_report(compared, errors, request, parts)


def _errors_with_events(
    runs: _Runs, compared: Run, horizons_m: Iterable[float], request: ReportRequest
) -> report.OpenLoopErrors | None:
    """Return the errors of all trials if the request leaves out the trials across slip events, else None."""
    if not request.without_events:
        return None
    crossed = replace(compared, in_gap=runs.with_events.in_gap)
    return measure_errors(crossed, horizons_m, starts=request.starts, seed=request.seed)


def _distances_within(
    errors: report.OpenLoopErrors, budgets_m: Iterable[float], calibrations: Sequence[UsedCalibration]
) -> tuple[BudgetDistance, ...]:
    """Return the distance within each budget [m] by row, with the intervals on another ground."""
    reaches = [reach for budget_m in budgets_m for reach in report.budget_distances(errors, budget_m)]
    return with_other_grounds(reaches, calibrations)


def _verdicts(
    limits: Iterable[Gate],
    errors: report.OpenLoopErrors,
    baseline: report.BaselineReport | None,
    unusable: str,
    *,
    strict: bool,
) -> tuple[Verdict, ...]:
    """Return the verdict on each acceptance limit; a run that is not usable fails them all, for the reason given."""
    if unusable:
        log = errors.run_document.log
        return tuple(report.verdict_on(gate, log, passed=False, unusable=unusable) for gate in limits)
    return tuple(report.check_gate(gate, errors, baseline, strict=strict) for gate in limits)


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
    """Return the starts and ends [ns] of the forced outages of each length."""
    lengths_s = forced_lengths_s(run, request)
    if request.outage_at_s and not lengths_s:
        raise ConfigError("outage_at_s", "gives starts of outages without a length", "give outage_s too")
    return [shown_paths.plan_outages(run, length, request.outage_at_s) for length in lengths_s]


def _horizons_of(run: Run, request: ReportRequest, limits: Iterable[Gate]) -> list[float]:
    """Return the requested or else configured horizons [m], and the horizons of acceptance limits."""
    horizons_m = list(request.horizons_m if request.horizons_m is not None else run.config.dropout.horizons_m)
    for at_m in (gate.horizon_m for gate in limits):
        if at_m is not None and not any(math.isclose(at_m, horizon, rel_tol=1e-9) for horizon in horizons_m):
            horizons_m.append(at_m)
    return horizons_m


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


def forced_lengths_s(run: Run, request: ReportRequest) -> Sequence[float]:
    """Return the lengths [s] of the forced outages, from the request or else from the run's configuration."""
    return request.outage_s if request.outage_s is not None else run.config.dropout.forced_outage_s
