"""Filter many simulated runs on all cores; each is reduced at once to the numbers that a study needs of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from icrtool.alignment.align import sensors_as_sent
from icrtool.config import Config
from icrtool.estimation.filter_setup import configured_noise, process_variance, rate_invariant, set_up_filter
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.ekf import run_ekf
from icrtool.kernels.filter_records import GUARDED
from icrtool.kernels.kinematics import model_states
from icrtool.records.samples import HeadingSamples, PositionFixes, WheelSamples
from icrtool.records.tables import RobotLog
from icrtool.simulation.drives import DrivePlan, Readings, Sensors, Truth, check_drive, drive_plan, sample_times, sense
from icrtool.simulation.paths import PathPlan, plan_body, track_speeds

Progress = Callable[[float], None]

STOP_EVERY_S = 5.0
"""The whole covariance is kept so often [s], and at the end."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """One setting of a study: drive, sensors and filter.

    Attributes
    ----------
    config : its filter section is used, and its robot for the start of preset ``field``
    inflate : inflate the ICR covariance at the drive's ICR changes (Section 5.2)
    guard : sign guard, of `icrtool.kernels.kinematics`; other than GUARDED the filter takes the Euler steps of Eq. 14
    model_icr_std_m : the truth obeys the filter's model, Eq. 14 with process noise drawn from Q (Eq. 30), from ICRs
        drawn with this standard deviation on; None: constant ICRs and exact kinematics
    """

    plan: DrivePlan
    sensors: Sensors
    config: Config
    inflate: bool = False
    guard: int = GUARDED
    model_icr_std_m: float | None = None


@dataclass(frozen=True, slots=True)
class StudyRun:
    """A filtered run.

    Attributes
    ----------
    scenario : what was run
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


Measure = Callable[[StudyRun], dict[str, float | Floats]]
"""Reduces a run to numbers, or arrays as large in all runs of a scenario."""


def run_scenarios(
    scenarios: Sequence[Scenario], runs: int, seed: int, measures: Sequence[Measure], progress: Progress | None = None
) -> list[dict[str, Floats]]:
    """Simulate and filter every scenario `runs` times, on all cores (the kernels free the GIL).

    Parameters
    ----------
    seed : run i of every scenario draws from the generator seeded (seed, i): scenarios differ by their setting alone,
        and a run does not depend on how many there are or on the number of cores
    measures : what to keep of a run

    Returns
    -------
    list of the columns of `measures`, (runs, ...), a scenario each
    """
    for scenario in scenarios:
        check_drive(scenario.plan, scenario.sensors)
    jobs = [(scenario, run) for scenario in scenarios for run in range(runs)]

    def work(job: tuple[Scenario, int]) -> dict[str, float | Floats]:
        run = _filtered(*job, seed)
        return {name: value for measure in measures for name, value in measure(run).items()}

    done = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for found in pool.map(work, jobs):
            done.append(found)
            if progress is not None:
                progress(len(done) / len(jobs))
    of_scenarios = (done[first : first + runs] for first in range(0, len(done), runs))
    return [{name: np.array([one[name] for one in some]) for name in some[0]} for some in of_scenarios]


def _filtered(scenario: Scenario, run: int, seed: int) -> StudyRun:
    simulate = _simulate if scenario.model_icr_std_m is None else _simulate_model
    readings, truth, motion = simulate(scenario, np.random.default_rng((seed, run)))
    changes = tuple(time for time, _ in scenario.plan.changes) if scenario.inflate else ()
    sensors = sensors_as_sent(readings_log(readings, scenario.sensors), scenario.config)
    setup = set_up_filter(sensors, scenario.config, changes_s=changes)
    if scenario.guard != GUARDED:
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
    motion = drive_plan(plan, 1 / scenario.sensors.wheel_rate_hz)
    readings = sense(motion, scenario.sensors, plan.duration_s, rng)
    icrs = motion.icrs_m[motion.which[motion.rows(readings.wheel_t)]]
    return readings, np.column_stack([motion.poses(readings.wheel_t), icrs]), motion


def _simulate_model(scenario: Scenario, rng: np.random.Generator) -> tuple[Readings, Floats, None]:
    """Return the measurements of true states (n, 6) that obey the filter's model, and those."""
    plan, sensors = scenario.plan, scenario.sensors
    t = sample_times(sensors.wheel_rate_hz, plan.duration_s)
    speeds = track_speeds(*plan_body(cast(PathPlan, plan.path), t, plan.icrs_m), plan.icrs_m)
    icrs = np.array(plan.icrs_m) + rng.normal(0.0, scenario.model_icr_std_m or 0.0, 3)
    x0 = np.array([0.0, 0.0, plan.start_heading_rad, *icrs])
    variance = np.array(process_variance(scenario.config, configured_noise(scenario.config)))
    noise = rng.normal(0.0, 1.0, (len(t), 6))
    states = model_states(x0, t, *speeds, np.sqrt(variance), rate_invariant(scenario.config), noise)
    return _readings(states, t, speeds, sensors, rng), states, None


def _readings(
    states: Floats, wheel_t: Floats, speeds: tuple[Floats, Floats], sensors: Sensors, rng: np.random.Generator
) -> Readings:
    """Measure states (n, 6) at the wheel stamps that fall together with a fix or a heading."""
    fix, sample = (
        np.arange(0, len(wheel_t), max(1, round(sensors.wheel_rate_hz / rate)))
        for rate in (sensors.gnss_rate_hz, sensors.heading_rate_hz)
    )
    return Readings(
        wheel_t, *speeds, *speeds,
        wheel_t[fix], states[fix, :2] + rng.normal(0.0, sensors.gnss_std_m, (len(fix), 2)),
        wheel_t[sample], states[sample, 2] + rng.normal(0.0, sensors.heading_std_rad, len(sample)),
        np.zeros(len(sample)),
    )  # fmt: skip


def readings_log(readings: Readings, sensors: Sensors) -> RobotLog:
    """Return readings as a log."""

    def stamps(times: Floats) -> Ints:
        return np.rint(times * 1e9).astype(np.int64)

    fixes, headings = len(readings.gnss_t), len(readings.heading_t)
    variance = np.full(fixes, sensors.gnss_std_m**2)
    north, east = readings.gnss_m.T
    return RobotLog(
        name="study",
        wheels=WheelSamples(stamps(readings.wheel_t), readings.v_left_mps, readings.v_right_mps),
        gnss=PositionFixes(stamps(readings.gnss_t), north, east, variance, variance, np.zeros(fixes)),
        heading=HeadingSamples(
            stamps(readings.heading_t), readings.heading_rad, np.full(headings, sensors.heading_std_rad**2)
        ),
        datum=None,
        streams=(),
        inputs=(),
        rejected_fixes={},
        warnings=(),
    )
