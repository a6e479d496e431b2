"""The filter and the smoother of a run: from aligned sensors to states (Pentzer 2014, Section 3).

The filter runs with the process noise of the pose that the innovations of the log show.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import fields
from typing import NamedTuple

import numpy as np

from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.estimation.filter_setup import (
    TURN_WANDER_RAD,
    FilterSetup,
    check_start,
    configured_noise,
    initial_icrs,
    set_up_filter,
    wheel_gap_s,
)
from icrtool.kernels.arrays import ROWS_AT_ONCE, Bools, Floats, Ints, wrapped
from icrtool.kernels.ekf import run_ekf, run_smoother
from icrtool.kernels.filter_records import REFERENCE_STEP_S, UNSEEN, FilterOutput, FilterParameters
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M
from icrtool.records.measurements import IcrStart, SensorData
from icrtool.records.presets import ProcessNoise
from icrtool.records.run import STATE_COLUMNS, MeasurementOutcome, Run, WarmStart
from icrtool.records.samples import WheelSamples
from icrtool.records.tables import States

OUTAGE_S = 2.0
"""Shortest GNSS outage [s], a time without a usable fix."""

OUTAGE_IN_INTERVALS = 5.0
"""Shortest GNSS outage, in usual intervals between fixes. Both limits must be exceeded."""


LONGEST_CARRY_S, LEAST_STD_RATIO = 1.0, 2.0
"""Longest time for which a precise heading is extended by the wheels' turn [s], and smallest ratio of the filter's
standard deviation to its own. With a smaller ratio the filter's heading is kept."""

LEAST_WHEEL_TRAVEL_M = 0.1
"""Sum of the distances that wheels roll forward and backward, below which they have not turned [m]."""

FAR_IN_SIGMAS = 6.0
"""Spread of positions, in their standard deviations, above which the robot has moved."""


class Filtered(NamedTuple):
    """Results of the filter; `icrtool.records.run.Run` describes the fields that are not listed here.

    Attributes
    ----------
    covariance : (6, 6) covariance of the last state
    noise : process noise of the pose in the run
    least_icr_m : smallest distance of the y ICRs from the centre line in the filter; -inf: no limit
    began_with : ICRs and covariance of the warm start; None without a warm start
    icr_start : ICRs at the start of a run without a warm start
    changes_s : terrain changes, seconds since the first recorded state, in order
    """

    sensors: SensorData
    table: States
    in_gap: Bools
    outages_ns: Ints
    gnss: MeasurementOutcome
    heading: MeasurementOutcome
    covariance: Floats
    noise: ProcessNoise
    least_icr_m: float
    began_with: WarmStart | None
    icr_start: IcrStart
    changes_s: tuple[float, ...]


def run_filter(
    sensors: SensorData,
    config: Config,
    *,
    warm_start: WarmStart | None = None,
    changes_s: tuple[float, ...] = (),
) -> Filtered:
    """Return the results of the filter over the sensors of a log.

    Parameters
    ----------
    sensors : the aligned streams
    config : the configuration
    warm_start : ICRs and covariance that the filter starts from; default: configured
    changes_s : terrain changes, seconds since the first recorded state

    Raises
    ------
    DataError
        There is no wheel sample after the first fix and the first heading, or the wheels never turn.
    ConfigError
        Preset ``field`` refuses the configured start.
    """
    check_start(config)
    _check_motion(sensors)
    changes_s = tuple(sorted(set(changes_s)))
    parameters, output, noise = filter_with_adapted_noise(sensors, config, warm_start, changes_s)
    gap_s = wheel_gap_s(config, (sensors.wheels.stamp_ns - sensors.wheels.stamp_ns[0]) / 1e9)
    table = _states(sensors.wheels, output)
    if table.fault:
        advice = "check warm start and configuration, or cut the log there (--from, --to)"
        raise DataError(sensors.name, f"the filter failed: {table.fault}", advice)
    start_ns, residual_m = int(table.stamp_ns[0]), np.hypot(*output.gnss_residual.T)
    gnss = MeasurementOutcome(sensors.fixes.stamp_ns, start_ns, output.gnss_nis, output.gnss_code, residual_m)
    heading = MeasurementOutcome(
        sensors.headings.stamp_ns, start_ns, output.heading_nis, output.heading_code, output.heading_innovation
    )
    in_gap = np.append(np.diff(table.t_s) > gap_s, False)
    carry_headings(table, sensors, heading.used)
    return Filtered(
        sensors=sensors,
        table=table,
        in_gap=in_gap,
        outages_ns=_outages(table, gnss, sensors.losses_ns),
        gnss=gnss,
        heading=heading,
        covariance=output.P,
        noise=noise,
        least_icr_m=parameters.least_icr,
        began_with=warm_start,
        icr_start=initial_icrs(config),
        changes_s=changes_s,
    )


def _check_motion(sensors: SensorData) -> None:
    """Refuse wheels that never turn, because they show no ICRs."""
    wheels, fixes = sensors.wheels, sensors.fixes
    interval = np.diff(wheels.stamp_ns) / 1e9
    travelled = [
        float(np.ptp(np.concatenate([[0.0], np.cumsum(speed[:-1] * interval)])))
        for speed in (wheels.v_left_mps, wheels.v_right_mps)
    ]
    if max(travelled) >= LEAST_WHEEL_TRAVEL_M:
        return
    # A few fixes may be wrong, so percentiles are used.
    north, east = (float(np.subtract(*np.percentile(column, [95, 5]))) for column in (fixes.north_m, fixes.east_m))
    moved, noise_m = math.hypot(north, east), float(np.sqrt(np.median(fixes.var_north_m2 + fixes.var_east_m2)))
    if moved > max(LEAST_WHEEL_TRAVEL_M, FAR_IN_SIGMAS * noise_m):
        why = f"the wheels never turn ({max(travelled):.2f} m), yet the position moves by {moved:.1f} m"
        raise DataError(sensors.name, why, "check the wheels' topic and joints (icrtool info)")
    why = f"the robot never moved: the wheels turned by {max(travelled):.2f} m, the position stays within {moved:.2f} m"
    raise DataError(sensors.name, why, "use a log in which it drives and turns")


def set_up_again(run: Run, outages_ns: tuple[tuple[int, int], ...] = ()) -> FilterSetup:
    """Return the set-up of the filter run that gave `run`, for the smoother or for forced outages."""
    return set_up_filter(
        run.sensors,
        run.config,
        noise=noise_of(run),
        changes_s=run.changes_s,
        warm_start=run.began_with,
        outages_ns=outages_ns,
        start=run.document.filter.icr_start,
    )


def noise_of(run: Run) -> ProcessNoise:
    """Return the process noise of the pose that a run was made with."""
    facts = run.document.filter
    return ProcessNoise(float(facts.process_position_mps), float(facts.process_heading_degps))


TOLERATED_NIS = 1.25
"""Largest mean NIS of a stream, per degree of freedom, that is tolerated. Each NIS is limited to its gate; with the
right noise the mean is 1."""

NOISE_FACTOR = 2.0
"""Factor between two tried process noises."""

LARGEST_POSITION_MPS = 10.0
"""Largest process noise of the position [m/s]."""

LARGEST_HEADING_DEGPS = 120.0
"""Largest process noise of the heading [deg/s]."""

TAIL_DEGREES = 4.0
"""Degrees of freedom of Student's t. Lange, Little and Taylor 1989 recommend this value for few, gross outliers."""

EQUAL_COST_MARGIN = 0.1
"""Largest difference of two costs per measurement that count as equal. An error of 5 % in both standard deviations has
this cost."""

MOST_ROUNDS = 3
"""Largest number of searches over both noises."""

Moving = tuple[Bools, Bools]
"""Flags of the fixes (m,) and headings (h,) that were measured while the wheels turned."""

MOST_SEARCHED_SAMPLES = 60_000
"""Largest number of wheel samples in the search: ten minutes at 100 Hz."""


def filter_with_adapted_noise(
    sensors: SensorData, config: Config, warm_start: WarmStart | None, changes_s: tuple[float, ...]
) -> tuple[FilterParameters, FilterOutput, ProcessNoise]:
    """Return parameters and output of the filter, and the process noise of the pose in it.

    If fixes or headings contradict the wheels, the process noise is increased, unless it is configured or preset is
    ``paper``. It is searched for on at most ten minutes of driving; a log without contradiction takes one pass.
    """

    def run(streams: SensorData, noise: ProcessNoise) -> tuple[FilterParameters, FilterOutput]:
        setup = set_up_filter(streams, config, noise=noise, warm_start=warm_start, changes_s=changes_s)
        return setup.parameters, run_ekf(*setup)

    noise, settings = configured_noise(config), config.filter
    parameters, output = run(sensors, noise)
    if not settings.rules.measures_noise:
        return parameters, output, noise
    moving = sensors.moving()
    # The mean NIS is per degree of freedom, and each NIS is limited to its gate.
    nis = (
        np.minimum(output.gnss_nis[(output.gnss_code > UNSEEN) & moving[0]], parameters.gnss_gate) / 2.0,
        np.minimum(output.heading_nis[(output.heading_code > UNSEEN) & moving[1]], parameters.heading_gate),
    )
    if all(not len(values) or values.mean() <= TOLERATED_NIS for values in nis):
        return parameters, output, noise
    del output, nis  # The memory is freed for the next run.
    wander_rad, largest = sensors.facts.turn_wander_rad, LARGEST_HEADING_DEGPS
    if wander_rad is not None:
        largest = min(largest, NOISE_FACTOR * math.degrees(wander_rad) / math.sqrt(REFERENCE_STEP_S))
    part = _busiest_part(sensors)
    moving = part.moving()
    best = find_noise(
        lambda tried: innovation_cost(run(part, tried)[1], moving),
        noise,
        search_position=settings.process_position_mps == "auto",
        search_heading=settings.process_heading_degps is None,
        largest_degps=largest,
    )
    return *run(sensors, best), best


def _busiest_part(sensors: SensorData) -> SensorData:
    """Return the streams during the `MOST_SEARCHED_SAMPLES` wheel samples in which the wheels travel most."""
    wheels = sensors.wheels
    if len(wheels.stamp_ns) <= MOST_SEARCHED_SAMPLES:
        return sensors
    travel = np.concatenate([[0.0], np.cumsum(np.abs(wheels.v_left_mps) + np.abs(wheels.v_right_mps))])
    first = int(np.argmax(travel[MOST_SEARCHED_SAMPLES:] - travel[:-MOST_SEARCHED_SAMPLES]))
    return sensors.part(slice(first, first + MOST_SEARCHED_SAMPLES))


def find_noise(
    cost: Callable[[ProcessNoise], float],
    start: ProcessNoise,
    *,
    search_position: bool,
    search_heading: bool,
    largest_degps: float = LARGEST_HEADING_DEGPS,
) -> ProcessNoise:
    """Return the smallest process noise, by doublings of `start`, whose cost is about the smallest cost.

    Parameters
    ----------
    cost : returns the cost of a noise, for example `innovation_cost`
    search_position, search_heading : search for the noise of the position, and of the heading
    largest_degps : upper limit of the heading's noise, from the difference between the turns of heading and wheels

    Notes
    -----
    Both noises are searched for in turn, each over all its doublings: if the noise is far too small, nearly all
    measurements are rejected, and the first doublings may change nothing. Costs within `EQUAL_COST_MARGIN` of the
    smallest cost count as equal.
    """
    cost_of = functools.cache(cost)
    largest = (LARGEST_POSITION_MPS if search_position else 0.0, largest_degps if search_heading else 0.0)
    best = start
    for _ in range(MOST_ROUNDS if search_position and search_heading else 1):
        before = best
        for name, first, last in zip(ProcessNoise._fields, start, largest, strict=True):
            steps = [first]
            while 0.0 < steps[-1] * NOISE_FACTOR <= last:
                steps.append(steps[-1] * NOISE_FACTOR)
            if last > 0.0:
                tried = [best._replace(**{name: value}) for value in steps]
                limit = min(map(cost_of, tried)) + EQUAL_COST_MARGIN
                best = next(noise for noise in tried if cost_of(noise) <= limit)
        if best == before:
            break
    return best


def innovation_cost(output: FilterOutput, moving: Moving | None = None) -> float:
    """Return the cost of the innovations of a run: the mean over the fixes plus the mean over the headings.

    Parameters
    ----------
    output : output of the filter
    moving : flags of the fixes (m,) and headings (h,) that count; None: all count

    Notes
    -----
    Twice the negative log-likelihood of innovations with covariance S under Student's t with nu = `TAIL_DEGREES`,
    without its constant: (nu + d) ln(1 + NIS / nu) + ln det S, also of rejected ones (Lange, Little and Taylor 1989). A
    normal likelihood would raise the noise for a few gross errors. A likelihood limited to the gate would be best if
    all measurements were rejected. Means are used, because the errors of a fast stream are correlated, so that the
    number of its samples must not be a weight.
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


def _states(wheels: WheelSamples, output: FilterOutput) -> States:
    """Return the recorded states in the output; its variances become standard deviations in place."""
    first = len(wheels.stamp_ns) - len(output.x)
    stamps = wheels.stamp_ns[first:]
    std = np.maximum(output.variance, 0.0, out=output.variance)
    np.sqrt(std, out=std)
    return States(
        stamp_ns=stamps,
        t_s=(stamps - stamps[0]) / 1e9,
        **dict(zip(STATE_COLUMNS, output.x.T, strict=True)),
        **{f"std_{name}": column for name, column in zip(STATE_COLUMNS, std.T, strict=True)},
        v_left_mps=wheels.v_left_mps[first:],
        v_right_mps=wheels.v_right_mps[first:],
        distance_m=output.distance,
    )


def carry_headings(table: States, sensors: SensorData, used: Bools) -> None:
    """Set the headings of states to the last precise heading that was `used` (h,), turned on by the wheels.

    The filter averages headings to learn the ICRs, but a single heading is closer to the body's heading than the
    average. The states are changed in place.
    """
    if not (sensors.facts.headings_are_precise and used.any()):
        return
    headings, psi, rows = sensors.headings, table.heading_rad, np.flatnonzero(used)
    stamps = headings.stamp_ns[rows]
    seen_s = (stamps - table.stamp_ns[0]) / 1e9
    difference_rad = wrapped(headings.heading_rad[rows] - np.interp(seen_s, table.t_s, psi))
    for lo in range(0, len(psi), ROWS_AT_ONCE):
        chunk = slice(lo, lo + ROWS_AT_ONCE)
        last = np.searchsorted(stamps, table.stamp_ns[chunk], side="right") - 1
        age = table.t_s[chunk] - seen_s[last]
        recent = (last >= 0) & (age < LONGEST_CARRY_S)
        std = np.sqrt(headings.var_rad2[rows[last]] + TURN_WANDER_RAD**2 * np.abs(age))
        clear = recent & (LEAST_STD_RATIO * std < table.std_heading_rad[chunk])
        np.add(psi[chunk], difference_rad[last], out=psi[chunk], where=clear)
        np.copyto(table.std_heading_rad[chunk], std, where=clear)


def _outages(table: States, gnss: MeasurementOutcome, rtk_losses_ns: Ints) -> Ints:
    """Return the spans between used fixes that are long enough to be outages, (k, 2) [ns].

    A fix that the gate rejected does not move the filter, and does not end an outage. While RTK was lost, fixes do not
    count, because the filter drove on with its wheels.
    """
    lost = np.zeros(len(gnss.stamp_ns), np.bool_)
    for begin, end in rtk_losses_ns:
        lost |= (gnss.stamp_ns > begin) & (gnss.stamp_ns < end)
    used = gnss.stamp_ns[gnss.used & ~lost]
    if len(used) < 2:
        return np.empty((0, 2), np.int64)
    interval = np.diff(used)
    shortest_outage_ns = max(OUTAGE_S * 1e9, OUTAGE_IN_INTERVALS * float(np.median(interval)))
    edges = np.flatnonzero(interval > shortest_outage_ns)
    spans = [(int(used[i]), int(used[i + 1])) for i in edges]
    if used[0] - table.stamp_ns[0] > shortest_outage_ns and lost[gnss.stamp_ns < used[0]].any():
        spans.insert(0, (int(table.stamp_ns[0]), int(used[0])))
    if table.stamp_ns[-1] - used[-1] > shortest_outage_ns:
        spans.append((int(used[-1]), int(table.stamp_ns[-1]) + 1))
    return np.array(spans, np.int64).reshape(-1, 2)


def smooth_run(run: Run) -> States:
    """Return the states of a finished run after the RTS smoother.

    Parameters
    ----------
    run : result of `icrtool.fit`

    Returns
    -------
    States
        The smoothed states, at the stamps of the run's states. Their path length is computed with the smoothed ICRs.

    Notes
    -----
    The smoother uses the noises of the filter, so that the smoothed ICRs vary with the process noise
    `filter.process_icr_mps`, too.
    """
    setup = set_up_again(run)
    smoothed = run_smoother(*setup)
    std = np.sqrt(np.maximum(smoothed.variance, 0.0))
    columns: dict[str, Floats] = {}
    for i, name in enumerate(STATE_COLUMNS):
        columns[name] = np.ascontiguousarray(smoothed.x[:, i])
        columns[f"std_{name}"] = np.ascontiguousarray(std[:, i])
    kept = {field.name: getattr(run.table, field.name) for field in fields(States) if field.name not in columns}
    table = States(**(kept | columns | {"distance_m": _distance(run, smoothed.x)}))
    carry_headings(table, run.sensors, run.heading.used)
    return table


def _distance(run: Run, x: Floats) -> Floats:
    """Return the path length (n,) [m] by the smoothed ICRs (Eqs. 8-12); gaps add nothing."""
    table = run.table
    right, left, ahead = x[:, 3], x[:, 4], x[:, 5]
    width = np.maximum(np.abs(left - right), MIN_ICR_SEPARATION_M)
    omega = (table.v_left_mps - table.v_right_mps) / width
    forward = (table.v_left_mps * right - table.v_right_mps * left) / width
    dt = np.where(run.in_gap, 0.0, np.append(np.diff(table.t_s), 0.0))
    distance: Floats = np.concatenate([[0.0], np.cumsum(dt * np.hypot(forward, omega * ahead))[:-1]])
    return distance
