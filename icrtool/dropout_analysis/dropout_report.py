"""The whole dropout report of a run: all that ``icrtool dropout-report`` gives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import msgspec
from msgspec import UNSET
from msgspec.structs import astuple

from icrtool.calibration.model_comparison import ComparedModels, compare_models
from icrtool.calibration.pooled import predictor
from icrtool.calibration.record import Calibration
from icrtool.calibration.run_recording import turning_recording_of
from icrtool.dropout_analysis.acceptance_limits import budget_distances, check_gate, parse_gate, verdict_on
from icrtool.dropout_analysis.example_trials import example_trials, split_by_turning, worst_trials
from icrtool.dropout_analysis.outages import force_outages, plan_outages, real_outages
from icrtool.dropout_analysis.reference import with_smoothed_reference
from icrtool.dropout_analysis.report import BaselineReport, DropoutReport
from icrtool.dropout_analysis.starts import Starts
from icrtool.dropout_analysis.trials import ConstantModel, ErrorSink, dropout
from icrtool.errors import ConfigError, DataError
from icrtool.estimation.odometry import measured_headings
from icrtool.kernels.track import TrialCounts
from icrtool.records.calibration_document import CalibrationFile
from icrtool.records.dropout import DEFAULT_SEED, CheckedGate, EventCost, Gate, Outage, UsedCalibration
from icrtool.records.process_resources import give_back_freed
from icrtool.records.run import MAKE_RUN, Run, check_type


def dropout_report(
    run: Run,
    *,
    horizons_m: Sequence[float] | None = None,
    budgets_m: Sequence[float] = (0.5,),
    gates: Sequence[str | Gate] = (),
    outage_s: Sequence[float] | None = None,
    outage_at_s: Sequence[float] = (),
    starts: Starts = "moving",
    without_events: bool = False,
    with_jumps: bool = False,
    calibrations: Sequence[Calibration] = (),
    comparison: bool = True,
    reference: Literal["filter", "smoothed"] = "filter",
    baseline: BaselineReport | None = None,
    strict: bool = False,
    allow_unusable: bool = False,
    seed: int = DEFAULT_SEED,
    sink: ErrorSink | None = None,
) -> DropoutReport:
    """Return how far a robot can drive without GNSS, with all that ``icrtool dropout-report`` gives.

    Parameters
    ----------
    run : of `icrtool.fit` or `icrtool.open_run`
    horizons_m : distances without GNSS; default those of the run's configuration. Horizons of `gates` are added
    budgets_m : for each, the distance over which 95 % of the trials stay within it
    gates : acceptance limits, for example ``"icr.p95@10m <= 3.8"``
    outage_s : lengths of outages to force on the filter; default those of the run's configuration
    outage_at_s : their begins, seconds since the first state; default: spaced over the time the robot moves
    starts : ``moving`` counts each standstill once, ``all`` takes every recorded state, as the paper does
    without_events : leave out trials that cross a slip event; ``event_cost`` of the report holds the difference
    with_jumps : count trials across jumps of the reference too, and fit across them
    calibrations : of `icrtool.calibrate` or `icrtool.open_calibration`; each becomes a row, ``calibration``, or
        ``calibration:STEM`` of its file where there are several; with ``_gyro`` behind it where both have a gyro
    comparison : also test models on distance they were not fitted to; without it the rows are the filter's and no slip
    reference : what trials are compared with: the filter's states or the smoother's
    baseline : an earlier report, for limits such as ``"icr.p95@10m <= 1.1 * baseline"``
    strict : compare such limits by the number alone, without the confidence interval of the difference
    allow_unusable : report on a run that is not usable as on any other; else it has the rows of the filter and of no
        slip alone, no distance, and every limit fails
    seed : of what the reference's own error is drawn from
    sink : receives every single error, see `icrtool.dropout_analysis.trials.ErrorSink`

    Raises
    ------
    ConfigError
        A limit, horizon, budget or outage that cannot be used, or a calibration of another robot.
    DataError
        The run has fewer than two states.
    RunError
        `reference` is ``smoothed`` and the run has no smoothed states.
    """
    check_type(run, Run, MAKE_RUN)
    if with_jumps:
        run = replace(run, sensors=replace(run.sensors, jumps=()))
    whole = run
    run = leave_out_events(run) if without_events else run
    limits = [gate if isinstance(gate, Gate) else parse_gate(gate) for gate in gates]
    forced = _force(run, outage_s, outage_at_s)
    compared = with_smoothed_reference(run) if reference == "smoothed" else run
    unusable = "" if run.usable or allow_unusable else str(run.document.unusable_because)
    used, further = _calibration_rows(compared, () if unusable else calibrations)
    found, why = _compare(compared, run) if comparison and not unusable else (None, unusable)
    give_back_freed()
    rows = found.rows if found is not None else ()
    further = [*(ConstantModel(row.name, row.label, row.errors_of) for row in rows), *further]
    horizons = _horizons(horizons_m if horizons_m is not None else run.config.dropout.horizons_m, limits)
    report = dropout(
        compared, horizons, further=further, starts=starts, seed=seed, sink=sink,
        starts_of_further=None if found is None else found.trials.starts, track=None if found is None else found.track,
    )  # fmt: skip
    give_back_freed()
    counts, cost = report.counts, None
    if without_events:
        counts, cost = _event_cost(report, replace(compared, in_gap=whole.in_gap), starts=starts, seed=seed)
    return replace(
        report,
        counts=counts,
        event_cost=cost,
        comparison=found.table if found is not None else None,
        calibrations=used,
        smoothed=reference == "smoothed",
        with_jumps=with_jumps,
        examples=example_trials(compared),
        worst=worst_trials(compared, found, starts=starts),
        outages=(*forced, *real_outages(compared)),
        budgets=() if unusable else tuple(one for budget in budgets_m for one in budget_distances(report, budget)),
        verdicts=tuple(
            verdict_on(CheckedGate(*astuple(gate), value_m=None, passed=False, unusable=unusable), run.name)
            if unusable
            else check_gate(gate, report, baseline, strict=strict)
            for gate in limits
        ),
        usable=not unusable,
        baseline=baseline,
        by_turning=split_by_turning(compared, starts),
        no_comparison=why,
    )


def forced_lengths_s(run: Run, outage_s: Sequence[float] | None) -> Sequence[float]:
    """Return the lengths of outages to force: those given, else those of the run's configuration."""
    return outage_s if outage_s is not None else run.config.dropout.forced_outage_s


def _force(run: Run, outage_s: Sequence[float] | None, outage_at_s: Sequence[float]) -> list[Outage]:
    lengths = forced_lengths_s(run, outage_s)
    if outage_at_s and not lengths:
        raise ConfigError("outage_at_s", "gives the begin of an outage without a length", "give outage_s too")
    plans = [plan_outages(run, length, outage_at_s) for length in lengths]
    return [outage for plan in plans for outage in force_outages(run, plan)]


def _horizons(horizons_m: Sequence[float], gates: Sequence[Gate]) -> list[float]:
    """Return the horizons asked for, and those that acceptance limits name."""
    horizons = list(horizons_m)
    for gate in gates:
        at = gate.horizon_m
        if at is not None and not any(math.isclose(at, horizon, rel_tol=1e-9) for horizon in horizons):
            horizons.append(at)
    return horizons


def _calibration_rows(
    run: Run, calibrations: Sequence[Calibration]
) -> tuple[tuple[UsedCalibration, ...], list[ConstantModel]]:
    """Return what is known of each calibration, and the model of its row."""
    used, models = [], []
    recording = turning_recording_of(run) if calibrations else None
    for number, one in enumerate(calibrations, start=1):
        stem = one.name or str(number)
        if sum(other.name == one.name for other in calibrations) > 1:
            stem = f"{stem}-{number}" if one.name else stem
        name = "calibration" if len(calibrations) == 1 else f"calibration:{stem}"
        label = "calibration" if len(calibrations) == 1 else stem
        if recording is None:
            continue
        created = one.created or ""
        of_sensors = dict.fromkeys(CalibrationFile.__struct_fields__[1:], UNSET)
        kept = msgspec.structs.replace(one, models={}, held_out=(), name=UNSET, **of_sensors)
        seen = one.fitted_to(recording.sha256)
        fitted = "fitted to this log" if seen else "not fitted to this log"
        rows = [(name, label, one.recommended, False)]
        if one.gyro is not None and recording.track.gyro is not None:
            rows.append((f"{name}_gyro", f"{label} + gyro", one.gyro.model, True))
        for name, label, model, with_gyro in rows:
            models.append(ConstantModel(name, label, predictor(one, recording, with_gyro=with_gyro)))
            used.append(UsedCalibration(name, label, model, len(one.logs), seen, created, with_gyro, kept, fitted))
    return tuple(used), models


def _compare(compared: Run, run: Run) -> tuple[ComparedModels | None, str]:
    """Compare the models of a run; where that cannot be, None and why."""
    try:
        return compare_models(compared, measured_headings(run)), ""
    except DataError as err:
        return None, f"{err.why}, {err.advice}"


def leave_out_events(run: Run) -> Run:
    """Return the run with a gap in place of each slip event: no trial, window or forced outage crosses a gap."""
    return replace(run, in_gap=run.in_gap | run.slipping)


def _event_cost(report: DropoutReport, run: Run, *, starts: Starts, seed: int) -> tuple[TrialCounts, EventCost]:
    """Return the counts of the report of `leave_out_events`, and what the slip events cost.

    Parameters
    ----------
    run : with its slip events
    """
    horizons: Sequence[float] = report.horizons_m.tolist()
    whole = dropout(run, horizons, starts=starts, seed=seed)
    cost = EventCost(
        events=len(run.sensors.events),
        trials=whole.counts.trials - report.counts.trials,
        with_events={result.name: result.summary for result in whole.results},
    )
    # starts at a gap, at an outage or at a standstill are counted as without the option
    return whole.counts._replace(trials=report.counts.trials), cost
