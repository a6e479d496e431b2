"""Run the filter over the sensors of a log, with the process noise of the pose that this log's innovations show."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np

from icrtool.config import Config
from icrtool.estimation.filter_setup import FilterSetup, ProcessNoise, configured_noise, set_up_filter
from icrtool.kernels.arrays import Bools
from icrtool.kernels.ekf import run_ekf
from icrtool.kernels.filter_records import REFERENCE_STEP_S, UNSEEN, FilterOutput
from icrtool.records.measurements import SensorData
from icrtool.records.process_resources import give_back_freed
from icrtool.records.run import WarmStart

TOLERATED_NIS = 1.25
"""Mean NIS of a stream, each counted up to its gate, per degree of freedom: 1 is expected where the noise is right."""

STEP = 2.0
LARGEST_POSITION_MPS = 10.0
LARGEST_HEADING_DEGPS = 120.0

TAIL_DEGREES = 4.0
"""Degrees of freedom of Student's t: Lange, Little and Taylor 1989 recommend it where outliers are few but gross."""

FLAT = 0.1
"""Costs that differ by less than this a measurement are alike: it is what 5 % of error in both deviations costs."""

MOST_ROUNDS = 3

Moving = tuple[Bools, Bools]
"""Which fixes (m,) and which headings (h,) were measured while the wheels turned."""

MOST_SAMPLES = 60_000
"""Wheel samples the search looks at: ten minutes at 100 Hz."""


def run_adaptively(
    sensors: SensorData, config: Config, warm_start: WarmStart | None, changes_s: tuple[float, ...]
) -> tuple[FilterSetup, FilterOutput, ProcessNoise]:
    """Run the filter; where fixes or headings contradict the wheels, with the process noise that they show.

    Returns set-up and output of the run, and the process noise that it was made with.

    The noise is searched for on at most ten minutes of driving; a log without contradiction takes one pass. Preset
    ``field`` only; what is configured is not searched for.
    """

    def run(one: SensorData, noise: ProcessNoise) -> tuple[FilterSetup, FilterOutput]:
        setup = set_up_filter(one, config, noise=noise, warm_start=warm_start, changes_s=changes_s)
        give_back_freed()
        return setup, run_ekf(*setup)

    noise, settings = configured_noise(config), config.filter
    setup, output = run(sensors, noise)
    if settings.preset != "field" or max(_capped_nis(setup, output, _moving(sensors))) <= TOLERATED_NIS:
        return setup, output, noise
    del setup, output  # of a long log, as large as all that the next run makes
    largest = min(LARGEST_HEADING_DEGPS, STEP * math.degrees(sensors.turn_wander_rad) / math.sqrt(REFERENCE_STEP_S))
    part = _busiest_part(sensors)
    moving = _moving(part)
    best = find_noise(
        lambda tried: innovation_cost(run(part, tried)[1], moving),
        noise,
        positions=settings.process_position_mps == "auto",
        headings=settings.process_heading_degps is None,
        largest_degps=largest,
    )
    return *run(sensors, best), best


def _busiest_part(sensors: SensorData) -> SensorData:
    """Return the `MOST_SAMPLES` wheel samples in which the wheels travel most, all where there are no more."""
    wheels = sensors.wheels
    if len(wheels.stamp_ns) <= MOST_SAMPLES:
        return sensors
    travel = np.concatenate([[0.0], np.cumsum(np.abs(wheels.v_left_mps) + np.abs(wheels.v_right_mps))])
    first = int(np.argmax(travel[MOST_SAMPLES:] - travel[:-MOST_SAMPLES]))
    return sensors.part(slice(first, first + MOST_SAMPLES))


def find_noise(
    cost: Callable[[ProcessNoise], float],
    start: ProcessNoise,
    *,
    positions: bool,
    headings: bool,
    largest_degps: float = LARGEST_HEADING_DEGPS,
) -> ProcessNoise:
    """Return the smallest process noise, from `start` up by doubling, whose cost is that of the best one.

    Parameters
    ----------
    cost : by noise, see `innovation_cost`
    positions, headings : whether the noise of the position, and of the heading, is searched for
    largest_degps : of the heading: what the turns of the wheels miss of its own turns

    Notes
    -----
    One coordinate after the other, each over all its doublings: too small a noise rejects nearly all measurements, and
    the first doublings may change nothing. Smallest: every noise whose cost is within `FLAT` of the least is as good.
    """
    cost_of = functools.cache(cost)
    largest = (LARGEST_POSITION_MPS if positions else 0.0, largest_degps if headings else 0.0)
    best = start
    for _ in range(MOST_ROUNDS if positions and headings else 1):
        before = best
        for name, first, last in zip(ProcessNoise._fields, start, largest, strict=True):
            steps = [first]
            while 0.0 < steps[-1] * STEP <= last:
                steps.append(steps[-1] * STEP)
            if last > 0.0:
                tried = [best._replace(**{name: value}) for value in steps]
                limit = min(map(cost_of, tried)) + FLAT
                best = next(one for one in tried if cost_of(one) <= limit)
        if best == before:
            break
    return best


def _moving(sensors: SensorData) -> Moving:
    return sensors.moving(sensors.fixes.stamp_ns), sensors.moving(sensors.headings.stamp_ns)


def innovation_cost(output: FilterOutput, moving: Moving | None = None) -> float:
    """Return what the innovations of a run cost: the mean over the fixes, and that over the headings, added.

    Parameters
    ----------
    moving : which fixes (m,) and headings (h,) count; None: all

    Notes
    -----
    Twice the negative log-likelihood of innovations with covariance S under Student's t with nu = `TAIL_DEGREES`,
    without its constant: (nu + d) ln(1 + NIS / nu) + ln det S, rejected ones included (Lange, Little and Taylor 1989).
    A normal likelihood raises the noise for a few gross errors. One that ends at the gate is least where everything
    is rejected. Means: samples of a fast stream err alike, so that their number is no weight.
    """
    fixes = output.gnss_code > UNSEEN
    headings = (output.heading_code > UNSEEN) & (output.heading_nis > 0.0)
    if moving is not None:
        fixes, headings = fixes & moving[0], headings & moving[1]
    variance = output.heading_innovation[headings] ** 2 / output.heading_nis[headings]
    streams = (2, output.gnss_nis[fixes], output.gnss_det[fixes]), (1, output.heading_nis[headings], variance)
    return sum(
        float(np.mean((TAIL_DEGREES + degrees) * np.log1p(nis / TAIL_DEGREES) + np.log(det)))
        for degrees, nis, det in streams
        if len(nis)
    )


def _capped_nis(setup: FilterSetup, output: FilterOutput, moving: Moving) -> tuple[float, float]:
    """Return mean NIS of fixes and of headings per degree of freedom, each counted up to its gate; 0 for none."""
    fixes = output.gnss_nis[(output.gnss_code > UNSEEN) & moving[0]]
    headings = output.heading_nis[(output.heading_code > UNSEEN) & moving[1]]
    return (
        float(np.minimum(fixes, setup.parameters.gnss_gate).mean()) / 2.0 if len(fixes) else 0.0,
        float(np.minimum(headings, setup.parameters.heading_gate).mean()) if len(headings) else 0.0,
    )
