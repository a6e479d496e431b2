"""Arguments of the filter kernel from aligned sensors and a configuration: times, noises, start."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from icrtool.config import Config
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.filter_records import GUARDED, PRINTED, REFERENCE_STEP_S, FilterInputs, FilterParameters
from icrtool.records.measurements import CAUTIOUS_RESPONSE_STD_S, IcrStart, SensorData, intervals_in
from icrtool.records.presets import FIELD, ProcessNoise
from icrtool.records.run import WarmStart, width_or_usual_m

USUAL_FACTOR = 1.5
"""y right and -y left at the start of a robot of which nothing is known, in half track widths b/2; x is 0.

Published skid factors are 1.125 to 1.875 (Clearpath A200, J100, W200, A300, Husarion WH01, WH05), the robots of Pentzer
2014 have 1.58 and 2.28.
"""

USUAL_FACTOR_STD = 1.0
"""Standard deviation of each ICR at the start of a robot of which nothing is known, in half track widths b/2.

The ICRs of all observed robots are 1.0 (wheels that roll) to 2.7 (a rigid-body simulation on a circle). The published
factors alone have a standard deviation of 0.36 about 1.5. With 0.4 instead of 1.0, expected errors after 10 m with
momentary ICRs are 1.08 times as large on 25 logs (geometric mean) and 2.4 times on the circle, because the filter
learns an unusual robot more slowly."""

SKID_FACTOR_STD = 0.4
"""Standard deviation of y right and y left at the start of a robot with a published skid factor, in half track widths.

On five recorded Warthog logs and one Husky log, the y ICRs differ from their published factors by 0.13 (rms), and
between grounds by 0.1; other grounds may differ more. The factor does not state x.
"""

LEAST_START_STD_M = 0.3
"""Smallest standard deviation of an ICR at the start [m]. It applies to robots that are narrower than 0.6 m.

If the configured track width is too small, a small standard deviation would keep the ICRs near the start: with 0.15 m
configured for 0.8 m, the y ICRs end 0.03 m too near to 0, and without this limit 0.11 m. The errors of robots of 0.2 m
do not change.
"""

FARTHEST_START_M, LARGEST_START_STD_M = 1000.0, 10_000.0
"""Largest distance of an ICR from the origin, and largest standard deviation, in a warm start [m]."""

GAP_MOVE_STD, GAP_TURN_STD = 2.0, 1.0
"""Random walks of the position [m/√s] and of the heading [rad/√s] in a gap in the wheel data."""

WHEEL_GAP_IN_INTERVALS = 2.5
"""Smallest length of a gap in the wheel data, in usual intervals between samples. It matters for slow streams."""

LEAST_ICR_IN_HALF_WIDTHS = 0.2
"""Smallest distance of a y ICR from the centre line, in half track widths. ICRs lie outside of the tracks (Pentzer
2014, Section 2), but an antenna off the centre line shifts them."""

EVENT_MARGIN_S = 0.2
"""Time by which slip events are extended on both sides [s], because their starts and ends are uncertain by this
time."""

RECOVERY_COUNT, RECOVERY_S = 10, 1.0
"""Smallest number of rejected measurements that agree with each other, and smallest time between the first and the last
of them [s], after which measurements are accepted again."""

TURN_WANDER_RAD = math.radians(1.2)
"""Random walk of the difference between the turn of a body and of its wheels [rad/√s]. The errors of an attitude sensor
are larger, but with estimated headings of 0.1 deg the ICRs would follow this difference."""

CHANGE_S = 0.5
"""Duration of a change of the turn rate [s]."""

MEMORY_S = 0.5
"""Time over which estimated headings of 0.1 deg are averaged [s]. Otherwise the ICRs would be learned from the shortest
turns, in which tracked robots turn by 2 % more than over some metres, and encoders with few counts show no turn."""


class FilterSetup(NamedTuple):
    """Arguments of `run_ekf` and `run_smoother` for one run.

    Attributes
    ----------
    data, parameters : inputs and constants of the filter
    t0 : time of the start [s]; x0 (6,), P0 (6, 6) : state and covariance at the start
    """

    data: FilterInputs
    t0: float
    x0: Floats
    P0: Floats
    parameters: FilterParameters


def check_start(config: Config) -> None:
    """Refuse configured initial ICRs on the wrong side, if the preset keeps the ICRs on their sides.

    Raises
    ------
    ConfigError
        An ICR is on the wrong side; the error names its key.
    """
    settings = config.filter
    if not settings.rules.keeps_sides:
        return
    sides = (("right", 1.0, settings.initial_y_icr_right_m), ("left", -1.0, settings.initial_y_icr_left_m))
    for side, sign, value in sides:
        if value is not None and value * sign <= 0:
            raise ConfigError(
                f"filter.initial_y_icr_{side}_m",
                "preset field keeps the right ICR right and the left one left (right > 0 > left)",
                f"found {value:g}; preset paper starts with any ICRs",
            )


def set_up_filter(
    sensors: SensorData,
    config: Config,
    *,
    noise: ProcessNoise | None = None,
    changes_s: tuple[float, ...] = (),
    warm_start: WarmStart | None = None,
    outages_ns: tuple[tuple[int, int], ...] = (),
    start: IcrStart | None = None,
) -> FilterSetup:
    """Return the arguments of the kernel for a filter run.

    Parameters
    ----------
    sensors : the aligned streams
    config : the configuration
    noise : process noise of the pose; default: configured
    changes_s : terrain changes, seconds since the first recorded state, at which the ICR covariance is inflated
    warm_start : final ICRs of another run, in place of the configured start
    outages_ns : half-open spans in which fixes and headings are left out
    start : ICRs at the start; default: `initial_icrs`

    Raises
    ------
    DataError
        There is no wheel sample after the first fix and heading, or the outages leave no fix or no heading.
    """
    wheels, fixes, headings = sensors.wheels, sensors.fixes, sensors.headings
    epoch = int(wheels.stamp_ns[0])
    fix, sample = _kept(fixes.stamp_ns, outages_ns), _kept(headings.stamp_ns, outages_ns)
    margin = round(EVENT_MARGIN_S * 1e9)
    events = ((event.begin_ns - margin, event.end_ns + margin) for event in sensors.events)
    wheel_t, gnss_t, heading_t = (
        (stamps - epoch) / 1e9 for stamps in (wheels.stamp_ns, fixes.stamp_ns[fix], headings.stamp_ns[sample])
    )
    data = FilterInputs(
        wheel_t=wheel_t,
        v_left=wheels.v_left_mps,
        v_right=wheels.v_right_mps,
        gnss_t=gnss_t,
        gnss_z=np.column_stack([fixes.north_m, fixes.east_m])[fix],
        gnss_r=np.column_stack([fixes.var_north_m2, fixes.var_east_m2])[fix],
        heading_t=heading_t,
        heading_z=headings.heading_rad[sample],
        heading_r=headings.var_rad2[sample],
        change_t=np.empty(0),
        # A forced outage has no slip events, because the events in it were found with its fixes.
        slipping=intervals_in(wheels.stamp_ns, events) & ~intervals_in(wheels.stamp_ns, outages_ns),
    )
    start = initial_icrs(config) if start is None else start
    icrs, icr_std = np.array(start.icrs_m), np.array(start.std_m)
    if sensors.facts.headings_are_precise:
        data = data._replace(turn_variance=_response_variance(data, float(icrs[0] - icrs[1])) + TURN_WANDER_RAD**2)
    data = _without_lost_headings(data, config, sensors.facts.antenna_m)
    if not (len(gnss_t) and len(heading_t)):
        raise DataError(sensors.name, "the outages leave no fix or no heading", "shorten them")
    # The run starts when a wheel sample, a fix and a heading have been measured.
    t0 = max(float(wheel_t[0]), float(gnss_t[0]), float(heading_t[0]))
    if t0 >= wheel_t[-1]:
        why = "no wheel sample after the first fix and the first heading"
        raise DataError(sensors.name, why, "check the streams' clocks")
    first_state = float(wheel_t[np.searchsorted(wheel_t, t0)])
    data = data._replace(change_t=np.array(sorted(changes_s), np.float64) + first_state)
    parameters = _parameters(config, data, sensors, noise or configured_noise(config))
    x0, P0 = _start_state(data, t0, (icrs, icr_std), parameters, warm_start, corrects=config.filter.rules.corrects)
    return FilterSetup(data, t0, x0, P0, parameters)


LOST_RAD = 0.5
"""Standard deviation of a heading after a gap above which it is lost [rad]. The filter is linear in the heading."""

LOST_FIX_VARIANCE_M2 = 100.0
"""Variance of a fix while the heading is lost, for an antenna away from the body origin [m^2]. With its own variance,
such a fix would turn the heading."""


def _without_lost_headings(data: FilterInputs, config: Config, antenna_m: tuple[float, float]) -> FilterInputs:
    """Return the inputs in which wheel samples after a gap in wheels and headings are marked, until the next heading.

    The filter does not dead-reckon through marked samples, as in a slip event. Otherwise the pose would move along an
    unknown heading: the filter would get a wrong heading with a small standard deviation, and reject measured headings.
    """
    if not config.filter.rules.corrects or len(data.wheel_t) < 2 or not len(data.heading_t):
        return data
    gaps = np.flatnonzero(np.diff(data.wheel_t) > wheel_gap_s(config, data.wheel_t))
    lost, lost_fixes = np.zeros(len(data.wheel_t), np.bool_), np.zeros(len(data.gnss_t), np.bool_)
    for row in gaps.tolist():
        end = data.wheel_t[row + 1]
        after = int(np.searchsorted(data.heading_t, end))
        seen = max(data.wheel_t[row], data.heading_t[after - 1]) if after else data.wheel_t[row]
        if GAP_TURN_STD * math.sqrt(end - seen) <= LOST_RAD or after == len(data.heading_t):
            continue
        until = data.heading_t[after]
        # A sample holds until the next one, so the heading is unknown in all samples of the span.
        lost[row + 1 : np.searchsorted(data.wheel_t, until)] = True
        lost_fixes |= (data.gnss_t > seen) & (data.gnss_t <= until)
    if not (lost.any() or lost_fixes.any()):
        return data
    variance = data.gnss_r
    if any(antenna_m):
        variance = np.where(lost_fixes[:, None], np.maximum(variance, LOST_FIX_VARIANCE_M2), variance)
    return data._replace(slipping=data.slipping | lost if len(data.slipping) else lost, gnss_r=variance)


def chi2_gate(probability: float, degrees: int) -> float:
    """Return the quantile of the chi-squared distribution with 1 or 2 degrees of freedom."""
    if degrees == 2:
        return -2.0 * math.log(1.0 - probability)
    return NormalDist().inv_cdf((1.0 + probability) / 2.0) ** 2


def _kept(stamps_ns: Ints, outages_ns: tuple[tuple[int, int], ...]) -> Ints | slice:
    """Return the rows of stamps outside of the outages; without outages a slice, to avoid a copy."""
    if not outages_ns:
        return slice(None)
    kept = np.ones(len(stamps_ns), np.bool_)
    for begin, end in outages_ns:
        kept &= (stamps_ns < begin) | (stamps_ns >= end)
    return np.flatnonzero(kept)


def _start_state(
    data: FilterInputs,
    t0: float,
    icrs: tuple[Floats, Floats],
    parameters: FilterParameters,
    warm_start: WarmStart | None,
    *,
    corrects: bool,
) -> tuple[Floats, Floats]:
    """Return state (6,) and covariance (6, 6) at the start `t0` [s].

    Parameters
    ----------
    icrs : initial ICRs and standard deviations; corrects : False takes the last fix as the position at the start
    """
    fix = int(np.searchsorted(data.gnss_t, t0, side="right")) - 1
    sample = int(np.searchsorted(data.heading_t, t0, side="right")) - 1
    psi = math.remainder(float(data.heading_z[sample]), 2 * math.pi)
    forward, right = parameters.antenna_forward, parameters.antenna_right
    north = data.gnss_z[fix, 0] - (forward * math.cos(psi) - right * math.sin(psi))
    east = data.gnss_z[fix, 1] - (forward * math.sin(psi) + right * math.cos(psi))
    x0 = np.array([north, east, psi, *icrs[0]])
    P0 = np.diag([*data.gnss_r[fix], data.heading_r[sample], *(icrs[1] ** 2)])
    if corrects:
        # the robot has driven since its last fix, in a direction that is not known yet
        P0[[0, 1], [0, 1]] += _travel_m(data, float(data.gnss_t[fix]), t0) ** 2
    if warm_start is not None:
        _check_warm_start(warm_start)
        x0[3:], P0[3:, 3:] = warm_start.icrs_m, warm_start.covariance_m2
    return x0, P0


def _travel_m(data: FilterInputs, begin_s: float, end_s: float) -> float:
    """Return the mean distance of the sides between two times [m]."""
    edges = np.clip(np.append(data.wheel_t, math.inf), begin_s, end_s)
    return float(np.diff(edges) @ (np.abs(data.v_left) + np.abs(data.v_right))) / 2.0


def _check_warm_start(start: WarmStart) -> None:
    """Refuse a warm start whose ICRs or covariance cannot be the result of a run."""
    icrs, covariance = np.asarray(start.icrs_m, np.float64), np.asarray(start.covariance_m2, np.float64)
    if icrs.shape != (3,) or not (np.abs(icrs) <= FARTHEST_START_M).all():
        values = ", ".join(f"{value:.4g}" for value in icrs.ravel()[:3])
        raise ConfigError("warm start", f"its ICRs are {values} m", f"each lies within {FARTHEST_START_M:g} m")
    sound = covariance.shape == (3, 3) and bool((np.abs(covariance) <= LARGEST_START_STD_M**2).all())
    if not sound or np.linalg.eigvalsh(covariance).min() < -1e-9 * max(1.0, float(np.abs(covariance).max())):
        raise ConfigError("warm start", "its covariance matrix is not valid", "fit the log that it comes from again")


def initial_icrs(config: Config) -> IcrStart:
    """Return the ICRs at the start and their standard deviations, configured or else from the preset.

    They do not depend on the log. In preset ``field`` they come from the robot's published skid factor if it has one
    (`SKID_FACTOR_STD`), else from usual skid-steer robots (`USUAL_FACTOR`). In this preset, a configured start between
    the tracks is moved to the tracks, because close to W = 0 the filter would recover very slowly. If a start is far
    outside of the tracks, its standard deviation equals its distance from them.
    """
    settings, robot, half = config.filter, config.robot, width_or_usual_m(config.robot.track_width_m) / 2
    factor = None if robot.track_width_m is None else robot.skid_factor
    rules, usual = settings.rules, (USUAL_FACTOR if factor is None else factor) * half
    configured = (settings.initial_y_icr_right_m, settings.initial_y_icr_left_m, settings.initial_x_icr_m)
    preset = rules.initial_icrs_m or (usual, -usual, 0.0)
    right, left, x = (
        value if value is not None else default for value, default in zip(configured, preset, strict=True)
    )
    if rules.keeps_sides:
        right, left = max(right, half), min(left, -half)
    away = max(abs(right - half), abs(left + half), abs(x))
    std = settings.initial_icr_std_m
    if std is None and rules.keeps_sides and factor is not None and configured == (None, None, None):
        return IcrStart((right, left, x), (SKID_FACTOR_STD * half, SKID_FACTOR_STD * half, USUAL_FACTOR_STD * half))
    if std is None:
        std = rules.initial_icr_std_m or max(USUAL_FACTOR_STD * half, LEAST_START_STD_M, away)
    return IcrStart((right, left, x), (std, std, std))


def wheel_gap_s(config: Config, wheel_t: Floats) -> float:
    """Return the interval between wheel samples above which there is a gap [s]: configured, or some usual intervals."""
    return max(config.filter.wheel_gap_s, WHEEL_GAP_IN_INTERVALS * float(np.median(np.diff(wheel_t))))


def configured_noise(config: Config) -> ProcessNoise:
    """Return the process noise of the pose at the start of a run, configured or else from the preset."""
    settings = config.filter
    preset = settings.rules.process_noise
    position, heading = settings.process_position_mps, settings.process_heading_degps
    return ProcessNoise(
        position if position != "auto" else preset.position_mps,
        heading if heading is not None else preset.heading_degps,
    )


def process_variance(config: Config, noise: ProcessNoise) -> tuple[float, float, float, float, float, float]:
    """Return the diagonal of Q (Eq. 30), in the units of `FilterParameters`."""
    position, icr = noise.position_mps**2, config.filter.process_icr_mps**2
    return position, position, math.radians(noise.heading_degps) ** 2, icr, icr, icr


def _samples_that_err_alike(sensors: SensorData, noise: ProcessNoise) -> float:
    """Return the number of headings that have the information of one independent heading: 2 tau / interval, at least 1.

    Notes
    -----
    An error with correlation exp(-|t|/tau), sampled much faster than tau, averages over time T like T / (2 tau)
    independent samples. With precise headings of variance s^2 and correlation time tau, and process noise of density q,
    the filter's variance is sqrt(2 tau s^2 q). With tau = s^2 / (2 q) it equals s^2, the variance of the estimate. The
    filter's memory is then sqrt(2 tau s^2 / q), at least `MEMORY_S` with the usual noise. The interval is taken from
    all headings, so that an outage does not change the weights of the other headings.
    """
    tau_s, stamps = sensors.facts.heading_correlation_s, sensors.headings.stamp_ns
    if sensors.facts.headings_are_precise:
        density, usual = (
            math.radians(process.heading_degps) ** 2 * REFERENCE_STEP_S + TURN_WANDER_RAD**2
            for process in (noise, FIELD.process_noise)
        )
        variance = float(np.median(sensors.headings.var_rad2))
        tau_s = max(variance / (2.0 * density), MEMORY_S**2 * usual / (2.0 * variance))
    interval_s = float(np.median(np.diff(stamps))) / 1e9 if len(stamps) > 1 else 0.0
    return max(1.0, 2.0 * tau_s / interval_s) if interval_s > 0 else 1.0


def _response_variance(data: FilterInputs, width_m: float) -> Floats:
    """Return the growth of the heading's variance while the wheels change the turn rate (n,) [rad^2/s].

    Parameters
    ----------
    width_m : separation of the ICRs

    Notes
    -----
    A body follows its wheels with a delay, or slips less at first. Each change of the turn rate therefore moves the
    heading by the response time, with the standard deviation `CAUTIOUS_RESPONSE_STD_S`, times this change. Within a
    change the errors of all steps have one sign, so white noise with the size of a single step's error would be too
    small, and most of the error would go into the ICRs.
    """
    t = data.wheel_t
    turn_rad = np.concatenate([[0.0], np.cumsum((data.v_left - data.v_right)[:-1] * np.diff(t))]) / width_m
    before, after = (np.interp(t + shift, t, turn_rad) for shift in (-CHANGE_S, CHANGE_S))
    change = (after - 2.0 * turn_rad + before) / CHANGE_S
    return np.asarray((CAUTIOUS_RESPONSE_STD_S * change) ** 2 / CHANGE_S)


def _parameters(config: Config, data: FilterInputs, sensors: SensorData, noise: ProcessNoise) -> FilterParameters:
    """Return the constants of the filter for a run."""
    settings, width_m = config.filter, width_or_usual_m(config.robot.track_width_m)
    rules = settings.rules
    gates = [chi2_gate(settings.gate_probability, degrees) if rules.gates else math.inf for degrees in (2, 1)]
    return FilterParameters(
        process_variance=process_variance(config, noise),
        rate_invariant=rules.rate_invariant,
        step_heading=rules.step_heading,
        gnss_gate=gates[0],
        heading_gate=gates[1],
        heading_correlation=_samples_that_err_alike(sensors, noise) if rules.measures_noise else 1.0,
        antenna_forward=sensors.facts.antenna_m[0] if rules.corrects else 0.0,
        antenna_right=sensors.facts.antenna_m[1] if rules.corrects else 0.0,
        wheel_gap_s=wheel_gap_s(config, data.wheel_t) if rules.corrects else math.inf,
        gap_speed_variance=GAP_MOVE_STD**2,
        gap_turn_variance=GAP_TURN_STD**2,
        recovery_count=RECOVERY_COUNT,
        recovery_s=RECOVERY_S,
        icr_inflation_m2=(settings.terrain_icr_std_m or rules.terrain_icr_std_m or width_m) ** 2,
        least_icr=LEAST_ICR_IN_HALF_WIDTHS * width_m / 2 if rules.keeps_sides else -math.inf,
        guard=PRINTED if rules.printed_derivatives else GUARDED,
    )
