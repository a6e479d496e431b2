"""Filter many simulated runs on all cores; each is reduced at once to the numbers that a study needs.

A measurement of a run gives named numbers, which are columns of the study's CSV, and arrays for its picture.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import cast

import numpy as np

from icrtool.alignment.align import sensors_as_sent
from icrtool.config import Config
from icrtool.estimation.filter_setup import configured_noise, process_variance, set_up_filter
from icrtool.kernels.arrays import Floats, Ints, wrapped
from icrtool.kernels.ekf import run_ekf
from icrtool.kernels.kinematics import drive, model_states
from icrtool.records.samples import HeadingSamples, PositionFixes, WheelSamples
from icrtool.records.tables import RobotLog
from icrtool.simulation import drives
from icrtool.simulation.drives import DrivePlan, PathPlan, Readings, Sensors
from icrtool.simulation.truths import Truth

Progress = Callable[[float], None]
"""Function that is called with the share of the work that is done."""

STOP_EVERY_S = 5.0
"""Time between two rows at which the complete covariance is kept [s]; it is also kept at the end."""


ICR_NAMES = ("y_icr_right", "y_icr_left", "x_icr")
"""Names of the ICRs in columns."""

STUDY_STATES = ("north", "east", "heading", *ICR_NAMES)
"""Names of the states in columns."""

FATES = ("converged", "inverted", "elsewhere")
"""Outcomes of a run with given initial ICRs."""

SETTLED_SHARE = 0.1
"""Share of its initial error below which an estimate counts as settled."""

SETTLED_M = 0.02
"""Error below which an estimate counts as settled [m]. It also counts as settled below a tenth of its initial error."""

CONVERGED_M = 0.1
"""Largest error of a converged run's ICRs [m]: all three, averaged over the last tenth of the run."""

LAST_SHARE = 10
"""The last part of a run is one of this number of equal parts."""

TRACE_POINTS = 400
"""Approximate number of rows of a trace."""

ZOOM_S = 10.0
"""Time around a change of the ICRs that is shown [s]."""

TRIAL_M = 10.0
"""Distance of an open-loop trial [m]."""

TRIAL_STARTS = 40
"""Number of open-loop trials of a run. Their starts are evenly spaced."""

COVARIANCE_FROM_S = 10.0
"""Time after which covariances count [s]. Before it, the presets' initial values have an effect."""

LEAST_STD = 1e-12
"""Smallest standard deviation to divide by, which avoids a division by zero."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """One setting of a study: drive, sensors and filter.

    Attributes
    ----------
    config : its filter section is used, and its robot for the start of preset ``field``
    inflate : inflate the ICR covariance at the drive's ICR changes (Section 5.2)
    guard : sign guard, of `icrtool.kernels.filter_records`, with the Euler steps of Eq. 14; None: as in the preset
    model_icr_std_m : standard deviation of the true ICRs at the start [m]. The truth then obeys the filter's model:
        Eq. 14 with process noise drawn from Q (Eq. 30). None: constant ICRs and exact kinematics
    """

    plan: DrivePlan
    sensors: Sensors
    config: Config
    inflate: bool = False
    guard: int | None = None
    model_icr_std_m: float | None = None


@dataclass(frozen=True, slots=True)
class StudyRun:
    """A filtered run.

    Attributes
    ----------
    scenario : the setting that was run
    t_s : (k,) times of the recorded states, on the truth's clock
    v_left : (k,) speed of the left track as the filter got it
    x : (k, 6) states; std : (k, 6) square roots of the diagonal of P
    truth : (k, 6) true states
    stops : (s,) rows at which the whole covariance was kept; P : (s, 6, 6)
    motion : the true motion; None where the truth obeys the filter's model
    gnss_nis : (m,), heading_nis : (h,), NaN where unseen
    """

    scenario: Scenario
    t_s: Floats
    v_left: Floats
    x: Floats
    std: Floats
    truth: Floats
    stops: Ints
    P: Floats
    motion: Truth | None
    gnss_nis: Floats
    heading_nis: Floats


RunNumbers = dict[str, float | Floats]
"""Numbers and arrays of a run, by name."""

Measure = Callable[[StudyRun], RunNumbers]
"""Function that reduces a run to numbers, or to arrays that have the same shape in all runs of a scenario."""


def run_scenarios(
    scenarios: Sequence[Scenario], runs: int, seed: int, measures: Sequence[Measure], progress: Progress | None = None
) -> list[dict[str, Floats]]:
    """Return the results of `runs` filtered simulations of every scenario, on all cores (the kernels free the GIL).

    Parameters
    ----------
    seed : run i of every scenario draws from the generator with the seed (seed, i). So scenarios differ by their
        setting alone, and a run depends neither on the number of runs nor on the number of cores
    measures : functions that give the results to keep of a run

    Returns
    -------
    list with one element per scenario: the columns of `measures`, (runs, ...)
    """
    for scenario in scenarios:
        drives.check_drive(scenario.plan, scenario.sensors)
    jobs = [(scenario, run) for scenario in scenarios for run in range(runs)]

    def work(job: tuple[Scenario, int]) -> RunNumbers:
        run = _filter_run(*job, seed)
        return {name: value for measure in measures for name, value in measure(run).items()}

    done = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for measured in pool.map(work, jobs):
            done.append(measured)
            if progress is not None:
                progress(len(done) / len(jobs))
    of_scenarios = (done[first : first + runs] for first in range(0, len(done), runs))
    return [{name: np.array([found[name] for found in results]) for name in results[0]} for results in of_scenarios]


def _filter_run(scenario: Scenario, run: int, seed: int) -> StudyRun:
    """Return run number `run` of a scenario, simulated and filtered."""
    simulate = _simulate if scenario.model_icr_std_m is None else _simulate_model
    readings, truth, motion = simulate(scenario, np.random.default_rng((seed, run)))
    changes = tuple(time for time, _ in scenario.plan.changes) if scenario.inflate else ()
    sensors = sensors_as_sent(readings_log(readings, scenario.sensors), scenario.config)
    setup = set_up_filter(sensors, scenario.config, changes_s=changes)
    if scenario.guard is not None:
        euler = setup.parameters._replace(guard=scenario.guard, step_heading=0.0)
        setup = setup._replace(parameters=euler)
    first = int(np.searchsorted(setup.data.wheel_t, setup.t0))
    times = readings.wheel_t[first:]
    stops_s = np.arange(STOP_EVERY_S, scenario.plan.duration_s, STOP_EVERY_S)
    stops = np.unique(np.append(np.searchsorted(times, stops_s, side="right") - 1, len(times) - 1))
    stops = stops[stops >= 0]
    out = run_ekf(*setup, stops.tolist())
    return StudyRun(
        scenario=scenario,
        t_s=times,
        v_left=readings.v_left_mps[first:],
        x=out.x,
        std=np.sqrt(np.maximum(out.variance, 0.0)),
        truth=truth[first:],
        stops=stops,
        P=out.P_at_stops,
        motion=motion,
        gnss_nis=out.gnss_nis,
        heading_nis=out.heading_nis,
    )


def _simulate(scenario: Scenario, rng: np.random.Generator) -> tuple[Readings, Floats, Truth]:
    """Return the measurements of a drive, its true states at the wheel stamps (n, 6), and its motion.

    Every run of a ``curved`` path has another phase.
    """
    plan, phase = scenario.plan, rng.uniform(0.0, 2 * np.pi)
    if isinstance(plan.path, PathPlan):
        plan = replace(plan, path=replace(plan.path, phase_rad=phase))
    motion = drives.drive_plan(plan, 1 / scenario.sensors.wheel_rate_hz, rng)
    readings = drives.sense_motion(motion, scenario.sensors, plan.duration_s, rng)
    return readings, np.column_stack([motion.poses(readings.wheel_t), motion.icrs(readings.wheel_t)]), motion


def _simulate_model(scenario: Scenario, rng: np.random.Generator) -> tuple[Readings, Floats, None]:
    """Return the measurements of true states (n, 6) that obey the filter's model, and the states."""
    plan, sensors = scenario.plan, scenario.sensors
    t = drives.sample_times(sensors.wheel_rate_hz, plan.duration_s)
    speeds = drives.track_speeds(*drives.plan_body(cast(PathPlan, plan.path), t, plan.icrs_m), plan.icrs_m)
    icrs = np.array(plan.icrs_m) + rng.normal(0.0, scenario.model_icr_std_m or 0.0, 3)
    x0 = np.array([0.0, 0.0, plan.start_heading_rad, *icrs])
    variance = np.array(process_variance(scenario.config, configured_noise(scenario.config)))
    noise = rng.normal(0.0, 1.0, (len(t), 6))
    states = model_states(x0, t, *speeds, np.sqrt(variance), scenario.config.filter.rules.rate_invariant, noise)
    # States are measured at wheel stamps that equal the stamp of a fix or a heading.
    fix, sample = (
        np.arange(0, len(t), max(1, round(sensors.wheel_rate_hz / rate)))
        for rate in (sensors.gnss_rate_hz, sensors.heading_rate_hz)
    )
    gnss_m = states[fix, :2] + rng.normal(0.0, sensors.gnss_std_m, (len(fix), 2))
    heading_rad = states[sample, 2] + rng.normal(0.0, sensors.heading_std_rad, len(sample))
    no_rate = np.zeros(len(sample))
    readings = Readings(t, *speeds, *speeds, t[fix], gnss_m, t[sample], heading_rad, no_rate)
    return readings, states, None


def readings_log(readings: Readings, sensors: Sensors) -> RobotLog:
    """Return readings as a log, whose stamps begin at 0."""
    fixes, headings = len(readings.gnss_t), len(readings.heading_t)
    variance = np.full(fixes, sensors.gnss_std_m**2)
    north, east = readings.gnss_m.T
    return RobotLog(
        name="study",
        wheels=WheelSamples(drives.stamps_of(readings.wheel_t, 0), readings.v_left_mps, readings.v_right_mps),
        gnss=PositionFixes(drives.stamps_of(readings.gnss_t, 0), north, east, variance, variance, np.zeros(fixes)),
        heading=HeadingSamples(
            drives.stamps_of(readings.heading_t, 0), readings.heading_rad, np.full(headings, sensors.heading_std_rad**2)
        ),
        datum=None,
        streams=(),
        inputs=(),
        rejected_fixes={},
        notes=(),
    )


def measure_estimates(run: StudyRun) -> RunNumbers:
    """Return mean and rms error and the stated std of each ICR over the second half of a run, and the NIS."""
    half = len(run.t_s) // 2
    error = run.x[half:, 3:] - run.truth[half:, 3:]
    numbers: RunNumbers = {"inverted": is_inverted(run)}
    for place, name in enumerate(ICR_NAMES):
        numbers[f"final_{name}_m"] = run.x[-1, 3 + place]
        numbers[f"std_{name}_m"] = run.std[-1, 3 + place]
        numbers[f"error_{name}_m"] = error[:, place].mean()
        numbers[f"rms_{name}_m"] = np.sqrt((error[:, place] ** 2).mean())
    return numbers | _mean_nis(run)


def measure_means(run: StudyRun) -> RunNumbers:
    """Return mean and standard deviation of each estimated ICR over the second half of a run, and the mean truth [m].

    The mean distance of the filter's position from the true position is returned too.
    """
    half = len(run.t_s) // 2
    means: RunNumbers = {"inverted": is_inverted(run)}
    for place, name in enumerate(ICR_NAMES, start=3):
        means[f"mean_{name}_m"] = run.x[half:, place].mean()
        means[f"scatter_{name}_m"] = run.x[half:, place].std()
        means[f"true_{name}_m"] = run.truth[half:, place].mean()
    means["position_error_m"] = float(np.hypot(*(run.x[half:, :2] - run.truth[half:, :2]).T).mean())
    return means


def _mean_nis(run: StudyRun) -> RunNumbers:
    """Return the mean NIS of fixes and of headings of a run."""
    return {"nis_gnss": float(np.nanmean(run.gnss_nis)), "nis_heading": float(np.nanmean(run.heading_nis))}


def measure_times(run: StudyRun, since_s: float = 0.0, until_s: float = np.inf) -> RunNumbers:
    """Return convergence and settling times [s] of every ICR after `since_s`; NaN where `until_s` comes first."""
    begin = max(int(np.searchsorted(run.t_s, since_s - 1e-9)) - 1, 0)
    end = int(np.searchsorted(run.t_s, until_s - 1e-9))
    t = run.t_s[begin:end] - max(since_s, run.t_s[0])
    times: RunNumbers = {}
    for place, name in enumerate(ICR_NAMES):
        value, target = run.x[begin:end, 3 + place], float(run.truth[end - 1, 3 + place])
        times[f"rise_{name}_s"] = convergence_time(t, value, target)
        times[f"settle_{name}_s"] = settling_time(t, value, target)
    return {**times, "settle_s": float(np.max([times[f"settle_{name}_s"] for name in ICR_NAMES]))}


def measure_changes(run: StudyRun) -> RunNumbers:
    """Return whether a run ended inverted, and its times after every change of the ICRs, until the next one."""
    plan = run.scenario.plan
    spans = enumerate(pairwise([*(time for time, _ in plan.changes), plan.duration_s]), start=1)
    times = {f"change{n}_{name}": time for n, span in spans for name, time in measure_times(run, *span).items()}
    return {"inverted": is_inverted(run), **times}


def measure_one_change(run: StudyRun) -> RunNumbers:
    """Return whether a run ended inverted, and its times after the first change of the ICRs."""
    return {"inverted": is_inverted(run), **measure_times(run, run.scenario.plan.changes[0][0])}


def convergence_time(t: Floats, value: Floats, target: float) -> float:
    """Return the time [s] between the first samples past 10 % and past 90 % of the change to the target.

    Parameters
    ----------
    t : (k,) [s]; value : (k,); target : the true ICR [m]

    Returns
    -------
    NaN where the run does not reach 90 %. An estimate that jumps past the target has 0.

    Notes
    -----
    Pentzer 2014, Section 5.2. `icrtool.estimation.convergence.converge` is for runs whose truth is not known: its
    target is the median of the run's second half, and at the time that it returns, the estimate has come within 10 % of
    the change and stays there for some seconds. `settling_time` is the time to stay near the truth.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (value - value[0]) / (target - value[0])
    first = int(np.argmax(share >= 0.1))
    last = first + int(np.argmax(share[first:] >= 0.9))
    return float(t[last] - t[first]) if share[first] >= 0.1 and share[last] >= 0.9 else np.nan


def settling_time(t: Floats, value: Floats, target: float) -> float:
    """Return the time [s] from which on the value (k,) stays near the target (`SETTLED_SHARE`); else NaN."""
    near = max(SETTLED_SHARE * abs(target - float(value[0])), SETTLED_M)
    away = np.flatnonzero(~(np.abs(value - target) <= near))
    settled = int(away[-1]) + 1 if len(away) else 0
    return max(float(t[settled]), 0.0) if settled < len(t) else np.nan


def is_inverted(run: StudyRun) -> float:
    """Return 1 where a run ended with y_icr_right <= y_icr_left, or with NaN; else 0."""
    return float(not run.x[-1, 3] > run.x[-1, 4])


def measure_fate(run: StudyRun) -> RunNumbers:
    """Return 1 for the outcome of a run, 0 for the other `FATES`, and the ICRs at its end."""
    last = max(1, len(run.x) // LAST_SHARE)
    error = np.abs(run.x[-last:, 3:] - run.truth[-last:, 3:]).mean(axis=0)
    near, wrong = float((error < CONVERGED_M).all()), is_inverted(run)
    fates = dict(zip(FATES, (near, wrong * (1 - near), (1 - wrong) * (1 - near)), strict=True))
    return {**fates, **{f"final_{name}_m": run.x[-1, 3 + place] for place, name in enumerate(ICR_NAMES)}}


def trace(begin_s: float = 0.0, end_s: float = np.inf, name: str = "trace") -> Measure:
    """Return a measure that keeps time, ICR estimates and left track speed between two times, as array `name`.

    The array is (about 400, 5) [s, m, m, m, m/s].
    """

    def measure(run: StudyRun) -> RunNumbers:
        first = max(int(np.searchsorted(run.t_s, begin_s, "right")) - 1, 0)
        last = int(np.searchsorted(run.t_s, end_s, "right")) - 1
        rows = np.unique(np.linspace(first, last, TRACE_POINTS).astype(np.int64))
        return {name: np.column_stack([run.t_s[rows], run.x[rows, 3:], run.v_left[rows]])}

    return measure


def trace_change(run: StudyRun) -> RunNumbers:
    """Return the trace around the first change of the ICRs, as array ``zoom``."""
    change_s = run.scenario.plan.changes[0][0]
    return trace(change_s - 1.0, change_s + ZOOM_S, "zoom")(run)


def measure_open_loop(run: StudyRun) -> RunNumbers:
    """Return the 95th percentile of the open-loop error after 10 m [m]: with the final ICRs, and without slip.

    Notes
    -----
    Section 6.4 with the filter's final ICRs, over starts along the whole true path.
    """
    truth = run.motion
    if truth is None:
        raise ValueError("open-loop errors need the true motion")
    half_width = (run.scenario.config.robot.track_width_m or np.nan) / 2
    no_slip = np.array([half_width, -half_width, 0.0])
    north, east = truth.pose[:, 0], truth.pose[:, 1]
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(north), np.diff(east)))])
    ends = np.searchsorted(distance, distance + TRIAL_M)
    starts = np.flatnonzero(ends < len(distance))
    if len(starts):
        starts = starts[np.linspace(0, len(starts) - 1, TRIAL_STARTS).astype(np.int64)]
    numbers: RunNumbers = {}
    for name, icrs in (("blind_icr_10m_p95_m", run.x[-1, 3:]), ("blind_no_slip_10m_p95_m", no_slip)):
        errors = []
        for first, last in zip(starts, ends[starts], strict=True):
            rows = slice(first, last + 1)
            t, v_left, v_right = truth.t_s[rows], truth.v_left_mps[rows], truth.v_right_mps[rows]
            end = drive(t, v_left, v_right, icrs[None, :], np.zeros(len(t), np.int64), truth.pose[first])[-1]
            errors.append(np.hypot(*(end - truth.pose[last])[:2]))
        numbers[name] = float(np.percentile(errors or [np.nan], 95))
    return numbers


def measure_consistency(run: StudyRun) -> RunNumbers:
    """Return mean NEES and NIS, the final errors in standard deviations, and arrays of the values at all stops.

    The arrays are ``stops_s`` (s,), ``all nees`` (s,); of the stops that count ``settled nees`` (c,) and the errors in
    standard deviations ``ratio`` (c, 6); ``all nis_gnss`` (m,), ``all nis_heading`` (h,).
    """
    stops_s = run.t_s[run.stops]
    nees, ratio = errors_over_std(run.x[run.stops] - run.truth[run.stops], run.P)
    settled = stops_s >= min(COVARIANCE_FROM_S, stops_s[-1])
    at_end = {f"end_error_over_std_{state}": float(error) for state, error in zip(STUDY_STATES, ratio[-1], strict=True)}
    return {
        "nees": float(nees[settled].mean()), **_mean_nis(run), **at_end,
        "stops_s": stops_s, "all nees": nees, "settled nees": nees[settled], "ratio": ratio[settled],
        "all nis_gnss": run.gnss_nis, "all nis_heading": run.heading_nis,
    }  # fmt: skip


def errors_over_std(error: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return NEES (...) and error over its std (..., 6), of errors (..., 6) with covariances (..., 6, 6).

    Notes
    -----
    The heading error is wrapped. The covariance is scaled to correlations first, because metres and radians differ by
    orders of magnitude.
    """
    error = error.copy()
    error[..., 2] = wrapped(error[..., 2])
    std = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), LEAST_STD**2))
    ratio = error / std
    correlation = covariance / (std[..., :, None] * std[..., None, :])
    nees = (ratio * np.linalg.solve(correlation, ratio[..., None])[..., 0]).sum(axis=-1)
    return nees, ratio
