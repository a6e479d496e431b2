"""From aligned sensors and a configuration to the arguments of the kernel: times, noises, the start."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from icrtool.config import Config
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.filter_records import GUARDED, PRINTED, REFERENCE_STEP_S, FilterInputs, FilterParameters
from icrtool.records.measurements import RESPONSE_S, IcrStart, SensorData, intervals_in
from icrtool.records.presets import FIELD, ProcessNoise
from icrtool.records.run import WarmStart, width_or_usual_m

USUAL_FACTOR = 1.5
"""y right and -y left of a robot of which nothing is known, in parts of b/2; x is 0.

Published skid factors are 1.125 to 1.875 (Clearpath A200, J100, W200, A300, Husarion WH01, WH05), the robots of Pentzer
2014 have 1.58 and 2.28.
"""

USUAL_FACTOR_STD = 1.0
"""Standard deviation of each ICR at the start of a robot of which nothing is known, in parts of b/2.

All robots that were seen lie within it or little beyond: 1.0 (wheels that roll) to 2.7 (a rigid-body simulation on a
circle). The published factors alone spread by 0.36 about 1.5. With 0.4 in place of 1.0, expected errors after 10 m
with momentary ICRs are 1.08 times as large on 25 logs (geometric mean), 2.4 times on the circle: the filter learns a
robot far from the usual ones more slowly.
"""

SKID_FACTOR_STD = 0.4
"""Standard deviation of y right and y left at the start of a robot of published skid factor, in parts of b/2.

On five recorded Warthog logs and one of a Husky the y ICRs differ from their published factors by 0.13 (rms), from one
ground to another by 0.1; other grounds may differ more. The factor states nothing of x.
"""

LEAST_START_STD_M = 0.3
"""Standard deviation of each ICR at the start of robots narrower than 0.6 m [m].

A track width configured too small would hold the filter back: if 0.15 m is configured for 0.8 m, the y ICRs end 0.03 m
too near to 0, and without this limit 0.11 m. It costs robots of 0.2 m nothing.
"""

FARTHEST_START_M, LARGEST_START_STD_M = 1000.0, 10_000.0
"""Largest distance of an ICR and largest standard deviation in a warm start [m], as for a configured start."""

GAP_MOVE_STD, GAP_TURN_STD = 2.0, 1.0
"""Standard deviation of the position [m/√s] and of the heading [rad/√s] in a gap in the wheel data: both variances grow
in proportion to time."""

WHEEL_GAP_IN_INTERVALS = 2.5
"""Smallest ratio of a gap to the usual interval between wheel samples, for slow streams."""

LEAST_ICR_IN_HALF_WIDTHS = 0.2
"""Smallest distance of a y ICR from the centre line, in half track widths. ICRs lie outside the tracks (Pentzer 2014,
Section 2), but an antenna off centre may shift them."""

EVENT_MARGIN_S = 0.2
"""Time by which slip events are extended on both sides [s], because begin and end are uncertain by this time."""

RECOVERY_COUNT, RECOVERY_S = 10, 1.0
"""Number of rejected measurements, and time [s] between the first and the last one, that must agree with each other
before measurements are accepted again."""

TURN_WANDER_RAD = math.radians(1.2)
"""Random walk of the difference between a body's turn and its wheels' turn [rad/sqrt(s)]. Errors of an attitude sensor
hide it, but with estimated headings of 0.1 deg the ICRs would follow it."""

CHANGE_S = 0.5
"""Duration of a change of the turn rate [s]."""

MEMORY_S = 0.5
"""Time over which estimated headings of 0.1 deg are averaged [s]. Otherwise the ICRs would be learned from the shortest
turns. In these, tracked robots turn by 2 % more than over some metres, and encoders with few counts show no turn."""


class FilterSetup(NamedTuple):
    """One run, ready for the kernels: the arguments of `run_ekf` and `run_smoother`.

    Attributes
    ----------
    t0 : time of the start [s]; x0 (6,), P0 (6, 6) : state and covariance there
    """

    data: FilterInputs
    t0: float
    x0: Floats
    P0: Floats
    parameters: FilterParameters


def check_start(config: Config) -> None:
    """Raise where configured initial ICRs are on the wrong side, if the preset keeps the sides.

    Raises
    ------
    ConfigError
        An ICR is on the wrong side; the key is named.
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
                f"found {value:g}; preset paper starts anywhere",
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
    noise : process noise of the pose, in place of the configured one
    changes_s : terrain changes, seconds since the first recorded state; the ICR covariance is inflated there
    warm_start : final ICRs of another run, in place of the configured start
    outages_ns : half-open spans in which GNSS and heading are left out
    start : ICRs that a run started from; default: `initial_icrs`

    Raises
    ------
    DataError
        No wheel sample after the first fix and heading, or outages that leave no fix or no heading.
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
        # A forced outage has no slip events, because these were found with the fixes in it.
        slipping=intervals_in(wheels.stamp_ns, events) & ~intervals_in(wheels.stamp_ns, outages_ns),
    )
    start = initial_icrs(config) if start is None else start
    icrs, icr_std = np.array(start.icrs_m), np.array(start.std_m)
    if sensors.facts.headings_are_precise:
        data = data._replace(turn_variance=_response_variance(data, float(icrs[0] - icrs[1])) + TURN_WANDER_RAD**2)
    data = _without_lost_headings(data, config, sensors.facts.antenna_m)
    if not (len(gnss_t) and len(heading_t)):
        raise DataError(sensors.name, "the outages leave no fix or no heading", "shorten them")
    # the first stamp by which wheel, GNSS and heading have each been seen
    t0 = max(float(wheel_t[0]), float(gnss_t[0]), float(heading_t[0]))
    if t0 >= wheel_t[-1]:
        why = "no wheel sample after the first fix and the first heading"
        raise DataError(sensors.name, why, "check the streams' clocks")
    first_state = float(wheel_t[np.searchsorted(wheel_t, t0)])
    data = data._replace(change_t=np.array(sorted(changes_s), np.float64) + first_state)
    parameters = _parameters(config, data, sensors, noise or configured_noise(config))
    x0, P0 = _start_state(data, t0, (icrs, icr_std), parameters, warm_start)
    return FilterSetup(data, t0, x0, P0, parameters)


LOST_RAD = 0.5
"""Standard deviation of a heading after a gap from which on it is lost [rad]: the filter is linear in the heading."""

LOST_FIX_VARIANCE_M2 = 100.0
"""Variance of a fix of an antenna aside of the body origin while the heading is lost [m^2]. With its own variance such
a fix would turn the heading."""


def _without_lost_headings(data: FilterInputs, config: Config, antenna_m: tuple[float, float]) -> FilterInputs:
    """Return the inputs with wheel samples marked that follow a gap in wheels and headings, until the next heading.

    The filter does not dead-reckon through marked samples, as in a slip event. If the pose moved along an unknown
    heading, the filter would get a wrong heading with a small standard deviation, and reject the measured headings.
    """
    if not config.filter.rules.corrects or len(data.wheel_t) < 2 or not len(data.heading_t):
        return data
    gaps = np.flatnonzero(np.diff(data.wheel_t) > wheel_gap_s(config, data.wheel_t))
    lost, of_fixes = np.zeros(len(data.wheel_t), np.bool_), np.zeros(len(data.gnss_t), np.bool_)
    for row in gaps.tolist():
        end = data.wheel_t[row + 1]
        after = int(np.searchsorted(data.heading_t, end))
        seen = max(data.wheel_t[row], data.heading_t[after - 1]) if after else data.wheel_t[row]
        if GAP_TURN_STD * math.sqrt(end - seen) <= LOST_RAD or after == len(data.heading_t):
            continue
        until = data.heading_t[after]
        # a sample is held until the next one: the heading is unknown in all of these
        lost[row + 1 : np.searchsorted(data.wheel_t, until)] = True
        of_fixes |= (data.gnss_t > seen) & (data.gnss_t <= until)
    if not (lost.any() or of_fixes.any()):
        return data
    variance = data.gnss_r
    if any(antenna_m):
        variance = np.where(of_fixes[:, None], np.maximum(variance, LOST_FIX_VARIANCE_M2), variance)
    return data._replace(slipping=data.slipping | lost if len(data.slipping) else lost, gnss_r=variance)


def chi2_gate(probability: float, degrees: int) -> float:
    """Return the quantile of the chi-squared distribution with 1 or 2 degrees of freedom."""
    if degrees == 2:
        return -2.0 * math.log(1.0 - probability)
    return NormalDist().inv_cdf((1.0 + probability) / 2.0) ** 2


def _kept(stamps_ns: Ints, outages_ns: tuple[tuple[int, int], ...]) -> Ints | slice:
    """Return the rows outside the outages; without outages a slice, to avoid a copy."""
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
) -> tuple[Floats, Floats]:
    fix = int(np.searchsorted(data.gnss_t, t0, side="right")) - 1
    sample = int(np.searchsorted(data.heading_t, t0, side="right")) - 1
    psi = math.remainder(float(data.heading_z[sample]), 2 * math.pi)
    forward, right = parameters.antenna_forward, parameters.antenna_right
    north = data.gnss_z[fix, 0] - (forward * math.cos(psi) - right * math.sin(psi))
    east = data.gnss_z[fix, 1] - (forward * math.sin(psi) + right * math.cos(psi))
    x0 = np.array([north, east, psi, *icrs[0]])
    P0 = np.diag([*data.gnss_r[fix], data.heading_r[sample], *(icrs[1] ** 2)])
    if warm_start is not None:
        _check_warm_start(warm_start)
        x0[3:], P0[3:, 3:] = warm_start.icrs_m, warm_start.covariance_m2
    return x0, P0


def _check_warm_start(start: WarmStart) -> None:
    """Refuse ICRs and a covariance that cannot be the end of a run."""
    icrs, covariance = np.asarray(start.icrs_m, np.float64), np.asarray(start.covariance_m2, np.float64)
    if icrs.shape != (3,) or not (np.abs(icrs) <= FARTHEST_START_M).all():
        values = ", ".join(f"{value:.4g}" for value in icrs.ravel()[:3])
        raise ConfigError("warm start", f"its ICRs are {values} m", f"each lies within {FARTHEST_START_M:g} m")
    sound = covariance.shape == (3, 3) and bool((np.abs(covariance) <= LARGEST_START_STD_M**2).all())
    if not sound or np.linalg.eigvalsh(covariance).min() < -1e-9 * max(1.0, float(np.abs(covariance).max())):
        raise ConfigError("warm start", "its covariance matrix is not valid", "fit the log that it comes from again")


def initial_icrs(config: Config) -> IcrStart:
    """Return the ICRs at the start and their standard deviations: configured, else from the preset.

    They do not depend on the log. In preset ``field`` they come from the robot's published skid factor where it has one
    (`SKID_FACTOR_STD`), else from usual skid-steer robots (`USUAL_FACTOR`). In this preset a configured start inside
    the tracks is moved out to the tracks, because close to W = 0 the filter would need very long to recover. The
    standard deviation of a start far from the tracks equals its distance from them.
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
    """Return the interval between wheel samples [s] above which there is a gap: at least a few usual intervals."""
    return max(config.filter.wheel_gap_s, WHEEL_GAP_IN_INTERVALS * float(np.median(np.diff(wheel_t))))


def configured_noise(config: Config) -> ProcessNoise:
    """Return the process noise of the pose that a run starts with: as configured, else the preset's."""
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
    """Return 2 tau / interval, at least 1: the number of headings with as much information as one independent heading.

    Notes
    -----
    An error with correlation exp(-|t|/tau), sampled much faster than tau, averages over time T like T / (2 tau)
    independent samples. With precise headings of variance s^2 and correlation time tau, and process noise of density q,
    the filter's variance is sqrt(2 tau s^2 q). With tau = s^2 / (2 q) it equals s^2, the variance of the estimate. The
    filter's memory is then sqrt(2 tau s^2 / q), at least `MEMORY_S` with the usual noise. All headings count, so that
    an outage does not change the weights of the other headings.
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

    A body follows its wheels with a delay, or slips less at first. Each change of the turn rate therefore moves the
    heading by up to `RESPONSE_S` times this change. Within a change the errors of all steps have one sign, so white
    noise with the size of a single step's error would be too small, and most of the error would go into the ICRs.
    `width_m` is the ICRs' separation.
    """
    t = data.wheel_t
    turned = np.concatenate([[0.0], np.cumsum((data.v_left - data.v_right)[:-1] * np.diff(t))]) / width_m
    before, after = (np.interp(t + shift, t, turned) for shift in (-CHANGE_S, CHANGE_S))
    change = (after - 2.0 * turned + before) / CHANGE_S
    return np.asarray((RESPONSE_S * change) ** 2 / CHANGE_S)


def _parameters(config: Config, data: FilterInputs, sensors: SensorData, noise: ProcessNoise) -> FilterParameters:
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
