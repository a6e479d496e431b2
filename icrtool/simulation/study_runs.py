"""Filter many simulated runs, chunk by chunk on all cores; each chunk is reduced to the numbers a study needs."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from icrtool.alignment.align import sensors_as_sent
from icrtool.config import Config
from icrtool.estimation.filter_setup import FilterSetup, set_up_filter
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.filter.batch_filter import Batch, run_batch
from icrtool.kernels.filter.ekf_step import PLACES
from icrtool.kernels.kinematics import GUARDED
from icrtool.records.samples import HeadingSamples, PositionFixes, WheelSamples
from icrtool.records.tables import RobotLog
from icrtool.simulation.drives import DrivePlan, Icrs, Readings, Sensors, Truth, check_drive, drive_plan, sense
from icrtool.simulation.paths import PathPlan

Progress = Callable[[float], None]

CHUNK_STATES = 160_000
"""Recorded states of a chunk, over all its runs: some 15 MB."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """One setting of a study: drive, sensors and filter.

    Attributes
    ----------
    config : its filter section is used, and its robot for the start of preset ``field``
    vary_path : every run of a ``curved`` path has another phase
    inflate : inflate the ICR covariance at the drive's ICR changes (Section 5.2)
    guard : sign guard, of `icrtool.kernels.kinematics`; other than GUARDED the filter takes the Euler steps of Eq. 14
    """

    plan: DrivePlan
    sensors: Sensors
    config: Config
    vary_path: bool = True
    inflate: bool = False
    guard: int = GUARDED


@dataclass(frozen=True, slots=True)
class Chunk:
    """The filtered runs of a part of a scenario.

    Attributes
    ----------
    t_s : (k,) times of the recorded states, on the truth's clock
    x : (runs, k, 6) states; std : (runs, k, 6) square roots of the diagonal of P
    true_icrs_m : (k, 3), the same in every run
    stops_s : (s,) times at which the whole covariance was kept; P : (runs, s, 6, 6)
    true_pose : (runs, s, 3) there
    truths : the true motion of every run
    gnss_nis : (runs, m), heading_nis : (runs, h), NaN where unseen
    """

    scenario: Scenario
    t_s: Floats
    x: Floats
    std: Floats
    true_icrs_m: Floats
    stops_s: Floats
    P: Floats
    true_pose: Floats
    truths: tuple[Truth, ...]
    gnss_nis: Floats
    heading_nis: Floats


Job = TypeVar("Job")
Done = TypeVar("Done")
Measure = Callable[[Chunk], dict[str, Floats]]
"""Reduces a chunk to columns, one row a run."""


def with_start(config: Config, icrs_m: Icrs, std_m: float | None = None) -> Config:
    """Return the configuration with other initial ICRs, and their standard deviation where given."""
    names = ("initial_y_icr_right_m", "initial_y_icr_left_m", "initial_x_icr_m")
    change: dict[str, float] = dict(zip(names, icrs_m, strict=True))
    if std_m is not None:
        change["initial_icr_std_m"] = std_m
    return config.with_filter(**change)


def run_scenarios(
    scenarios: Sequence[Scenario],
    runs: int,
    seed: int,
    measure: Measure,
    *,
    stops_s: tuple[float, ...] = (),
    progress: Progress | None = None,
) -> list[dict[str, Floats]]:
    """Simulate and filter every scenario `runs` times.

    Parameters
    ----------
    seed : run i of every scenario draws from the generator seeded (seed, i): scenarios differ by their setting alone,
        and a run does not depend on how many there are or on the number of cores
    measure : what to keep of a chunk
    stops_s : times at which the whole covariance is kept; it is kept at the end in any case

    Returns
    -------
    list of the columns of `measure`, (runs, ...), a scenario each
    """
    for scenario in scenarios:
        check_drive(scenario.plan, scenario.sensors)
    jobs = [
        (number, part)
        for number, scenario in enumerate(scenarios)
        for part in chunks(runs, int(scenario.plan.duration_s * scenario.sensors.wheel_rate_hz))
    ]

    def work(job: tuple[int, range]) -> dict[str, Floats]:
        number, part = job
        return measure(_run_chunk(scenarios[number], part, seed, stops_s))

    parts: list[list[dict[str, Floats]]] = [[] for _ in scenarios]
    for (number, _), found in zip(jobs, on_all_cores(work, jobs, progress), strict=True):
        parts[number].append(found)
    return [joined(some) for some in parts]


def chunks(runs: int, states: int) -> list[range]:
    """Cut runs of so many states each into chunks."""
    size = max(1, CHUNK_STATES // max(states, 1))
    return [range(first, min(first + size, runs)) for first in range(0, runs, size)]


def on_all_cores(work: Callable[[Job], Done], jobs: Sequence[Job], progress: Progress | None) -> list[Done]:
    """Do every job, in threads (the kernels free the GIL); results in the order of the jobs."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        done = []
        for result in pool.map(work, jobs):
            done.append(result)
            if progress is not None:
                progress(len(done) / len(jobs))
    return done


def joined(parts: Sequence[dict[str, Floats]]) -> dict[str, Floats]:
    """Return the columns of all chunks, concatenated."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _run_chunk(scenario: Scenario, runs: range, seed: int, stops_s: tuple[float, ...]) -> Chunk:
    truths, readings = zip(*(_simulate(scenario, run, seed) for run in runs), strict=True)
    changes = tuple(time for time, _ in scenario.plan.changes) if scenario.inflate else ()
    setup = set_up_filter(
        sensors_as_sent(readings_log(readings[0], scenario.sensors), scenario.config),
        scenario.config,
        changes_s=changes,
    )
    data = setup.data
    stops = np.unique(np.append(np.searchsorted(data.wheel_t, stops_s, side="right") - 1, len(data.wheel_t) - 1))
    batch = stack(readings, setup, stops[data.wheel_t[stops] >= setup.t0])
    parameters = setup.parameters
    if scenario.guard != GUARDED:
        parameters = parameters._replace(guard=scenario.guard, step_heading=0.0)
    out = run_batch(batch, parameters)
    times = readings[0].wheel_t[len(data.wheel_t) - out.x.shape[1] :]
    at_stops = readings[0].wheel_t[batch.stops]
    return Chunk(
        scenario=scenario,
        t_s=times,
        x=out.x,
        std=np.sqrt(np.maximum(out.variance, 0.0)),
        true_icrs_m=truths[0].icrs_m[truths[0].which[truths[0].rows(times)]],
        stops_s=at_stops,
        P=out.P[..., PLACES],
        true_pose=np.array([truth.poses(at_stops) for truth in truths]),
        truths=truths,
        gnss_nis=out.gnss_nis,
        heading_nis=out.heading_nis,
    )


def _simulate(scenario: Scenario, run: int, seed: int) -> tuple[Truth, Readings]:
    rng = np.random.default_rng((seed, run))
    plan, phase = scenario.plan, rng.uniform(0.0, 2 * np.pi)
    if scenario.vary_path and isinstance(plan.path, PathPlan):
        plan = replace(plan, path=replace(plan.path, phase_rad=phase))
    truth = drive_plan(plan, 1 / scenario.sensors.wheel_rate_hz)
    return truth, sense(truth, scenario.sensors, plan.duration_s, rng)


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


def stack(readings: Sequence[Readings], setup: FilterSetup, stops: Ints) -> Batch:
    """Return readings of the same stamps as one batch; each run starts at its own first fix and heading."""
    data, x0 = setup.data, np.tile(setup.x0, (len(readings), 1))
    fix = int(np.searchsorted(data.gnss_t, setup.t0, side="right")) - 1
    sample = int(np.searchsorted(data.heading_t, setup.t0, side="right")) - 1
    x0[:, :2] = [one.gnss_m[fix] for one in readings]
    x0[:, 2] = [one.heading_rad[sample] for one in readings]
    return Batch(
        wheel_t=data.wheel_t,
        gnss_t=data.gnss_t,
        heading_t=data.heading_t,
        change_t=data.change_t,
        gnss_r=data.gnss_r,
        heading_r=data.heading_r,
        v_left=np.array([one.v_left_mps for one in readings]),
        v_right=np.array([one.v_right_mps for one in readings]),
        gnss_z=np.array([one.gnss_m for one in readings]),
        heading_z=np.array([one.heading_rad for one in readings]),
        t0=setup.t0,
        x0=x0,
        P0=setup.P0[np.triu_indices(6)],
        stops=stops,
    )
