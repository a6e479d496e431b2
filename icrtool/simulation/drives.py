"""Simulated drives: a robot on a path, the sensors of Pentzer 2014, Section 4, and their recording."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np

from icrtool.errors import ConfigError
from icrtool.kernels.arrays import Floats, Ints, wrapped
from icrtool.kernels.kinematics import drive, follow
from icrtool.logs.write_log import HEIGHT_STD_RATIO
from icrtool.records.choices import PathKind
from icrtool.records.samples import SensorColumns
from icrtool.records.tables import Icrs
from icrtool.simulation.friction import FrictionRobot, slide_path
from icrtool.simulation.truths import IcrTruth, Truth

CURVED_SWINGS = ((0.8, 1.4), (0.2, 3.0))
"""Two oscillations of path ``curved``: share of the curvature, and length in radii per radian. With these values the
heading varies by up to 1.7 rad and has no short period."""

TRUTH_STEP_S = 0.001
"""Default time for which track speeds of a path are held [s]. The intervals of all sensors are longer."""

PAPER_ICRS_M: Icrs = (0.5, -0.75, -0.25)
"""True y_icr_right, y_icr_left, x_icr of the simulations in Pentzer 2014, Section 5 [m]."""

GYRO_STD_RADPS = 0.003
"""White noise of the turn rate in the Imu messages [rad/s]."""

MOST_SIMULATED_SAMPLES = 20_000_000
"""Largest number of samples of a sensor and of steps of the truth: 5.5 h at the default step."""

LARGEST_SETTING, SMALLEST_SETTING = 1e6, 1e-9
"""Largest and smallest size of a setting of a drive or sensor, in its unit. 0 is allowed where it has a meaning."""

START_NS = 1_760_000_000_000_000_000
"""Stamp of time 0 [ns], in October 2025."""

DATUM = (40.7934, -77.86, 350.0)
"""Latitude, longitude [deg] and height [m] of the first pose."""

LARGEST_RTK_STD_M, LARGEST_SBAS_STD_M = 0.05, 0.6
"""Largest standard deviations of fixes with status GBAS and SBAS in NavSatStatus [m]; a fix with a larger standard
deviation is a plain fix."""

TruthTable = dict[str, Floats | Ints]
"""Truth at every wheel stamp: the columns of the truth CSV, (n,) each."""


@dataclass(frozen=True, slots=True)
class PathPlan:
    """A path of the body.

    Attributes
    ----------
    kind : ``circle`` (clockwise), ``curved`` (left and right), ``lawnmower`` (legs joined by half circles, right and
        left in turn), ``figure-eight`` (whole circles, right and left in turn), ``spins`` (whole turns on the spot,
        right and left in turn) or ``straight``
    speed_mps : speed of the body; of the faster track where the body stands (``spins``, ``circle`` of radius 0)
    radius_m : of circles and of the tightest bend; a lawnmower's legs are two radii apart
    leg_m : length of a lawnmower's legs
    phase_rad : phase of the oscillations of ``curved`` at the start
    """

    kind: PathKind = "curved"
    speed_mps: float = 0.4
    radius_m: float = 1.0
    leg_m: float = 20.0
    phase_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class TrackSpeeds:
    """Given track speeds: t_s (n,) increasing from 0; v_left_mps, v_right_mps (n,), held until the next row."""

    t_s: Floats
    v_left_mps: Floats
    v_right_mps: Floats


@dataclass(frozen=True, slots=True)
class DrivePlan:
    """Plan of a simulated drive: the robot's true ICRs, or its contacts; its path and its motors.

    Attributes
    ----------
    icrs_m : true y_icr_right, y_icr_left, x_icr; the track speeds of a path are computed with them
    robot : a robot on sliding contacts, whose ICRs follow from forces; its driver assumes `icrs_m`. None: the ICRs hold
    changes : (seconds, true ICRs from then on), in order of time; the track speeds do not change
    path : a path, or given track speeds
    command_rate_hz : rate of the motor commands, each held until the next; None: a command at every step
    motor_lag_s : time constant with which the tracks follow their commands; 0: without lag
    step_s : time for which track speeds of a path are held [s]: 1 over a whole number
    """

    icrs_m: Icrs = PAPER_ICRS_M
    changes: tuple[tuple[float, Icrs], ...] = ()
    path: PathPlan | TrackSpeeds = field(default_factory=PathPlan)
    duration_s: float = 100.0
    start_heading_rad: float = 0.5
    command_rate_hz: float | None = None
    motor_lag_s: float = 0.0
    step_s: float = TRUTH_STEP_S
    robot: FrictionRobot | None = None


@dataclass(frozen=True, slots=True)
class Sensors:
    """The sensors and their errors. The defaults are Section 4 of Pentzer 2014.

    Attributes
    ----------
    wheels : ``ideal`` (true displacement), ``encoder`` (whole counts) or ``commanded`` (motor commands)
    wheel_rate_hz, heading_rate_hz, gnss_rate_hz : samples per second
    metres_per_count : travel of one encoder count
    input_noise_mps, input_bias_mps : white noise per sample and bias, on both track speeds
    gnss_std_m : standard deviation of north and of east, white
    outages_s : (begin, end) without fixes
    heading_std_rad, heading_resolution_rad : white noise, and the step that headings are rounded to
    heading_offset_rad : added to every heading, clockwise
    antenna_forward_m, antenna_right_m : position of the antenna, body frame
    gnss_delay_s, heading_delay_s : lag of their stamps behind the wheels' clock
    """

    wheels: Literal["ideal", "encoder", "commanded"] = "encoder"
    wheel_rate_hz: float = 100.0
    metres_per_count: float = 2 * math.pi * 0.08 / 8192
    input_noise_mps: float = 0.0
    input_bias_mps: float = 0.0
    gnss_std_m: float = 0.01
    gnss_rate_hz: float = 20.0
    outages_s: tuple[tuple[float, float], ...] = ()
    heading_std_rad: float = math.radians(1.0)
    heading_resolution_rad: float = math.radians(0.05)
    heading_rate_hz: float = 100.0
    heading_offset_rad: float = 0.0
    antenna_forward_m: float = 0.0
    antenna_right_m: float = 0.0
    gnss_delay_s: float = 0.0
    heading_delay_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Readings:
    """Measurements of the sensors, by time of measurement.

    Attributes
    ----------
    wheel_t, travel_left_m, travel_right_m, v_left_mps, v_right_mps : (n,); a speed k is the travel from k to k + 1
    gnss_t : (m,); gnss_m : (m, 2) north, east of the antenna
    heading_t, heading_rad (unwrapped), yaw_rate_radps : (h,)
    """

    wheel_t: Floats
    travel_left_m: Floats
    travel_right_m: Floats
    v_left_mps: Floats
    v_right_mps: Floats
    gnss_t: Floats
    gnss_m: Floats
    heading_t: Floats
    heading_rad: Floats
    yaw_rate_radps: Floats


def check_drive(plan: DrivePlan, sensors: Sensors) -> None:
    """Refuse a plan that cannot be driven, and sensors that give too few samples.

    Raises
    ------
    ConfigError
        A value is impossible; the error names this value.
    """
    # Numbers are refused whose samples fill the memory, and those that no robot, sensor or drive has.
    for part in (plan, sensors, plan.path, *([] if plan.robot is None else [plan.robot])):
        for name in (each.name for each in fields(part) if not isinstance(part, TrackSpeeds)):
            for number in _numbers_in(getattr(part, name)):
                if number and not SMALLEST_SETTING <= abs(number) <= LARGEST_SETTING:
                    why = f"{number:g} is not of a magnitude from {SMALLEST_SETTING:g} to {LARGEST_SETTING:g}"
                    raise ConfigError(name, why, "give a number in the unit of its name")
    rates = (sensors.wheel_rate_hz, sensors.gnss_rate_hz, sensors.heading_rate_hz)
    fastest, slowest = max(1.0 / plan.step_s, *rates), min(rates)
    if not 0.0 < (samples := plan.duration_s * fastest) <= MOST_SIMULATED_SAMPLES:
        why = f"{plan.duration_s:g} s at {fastest:g} Hz are {samples:.3g} samples"
        raise ConfigError("duration", why, f"at most {MOST_SIMULATED_SAMPLES:,} are simulated")
    for number, (right, left, _) in enumerate([plan.icrs_m, *(icrs for _, icrs in plan.changes)]):
        if not right > left:
            why = f"y_icr_right {right:g} is not right of y_icr_left {left:g}"
            raise ConfigError("change" if number else "icrs", why, "y is positive to the right")
    path = plan.path
    if isinstance(path, PathPlan) and path.radius_m == 0 and path.kind not in ("circle", "spins", "straight"):
        advice = "only a circle may have radius 0"
        raise ConfigError("radius", f"a {path.kind} path has no bends of radius 0", advice)
    _check_robot(plan)
    times = [time for time, _ in plan.changes]
    if times != sorted(set(times)):
        raise ConfigError("change", f"the times {', '.join(f'{time:g}' for time in times)} do not increase")
    if plan.duration_s * slowest < 2:
        why = f"{plan.duration_s:g} s holds fewer than two samples at {slowest:g} Hz"
        raise ConfigError("duration", why, "drive longer")


def _check_robot(plan: DrivePlan) -> None:
    """Refuse settings that a robot on sliding contacts cannot have: ICRs that change, and given track speeds."""
    if plan.robot is not None and plan.changes:
        advice = "leave --change out, or --dynamics"
        raise ConfigError("change", "the ICRs of a robot on sliding contacts follow from forces", advice)
    if plan.robot is not None and isinstance(plan.path, TrackSpeeds):
        raise ConfigError("speeds", "a robot on sliding contacts follows a path", "leave --speeds or --dynamics out")


def _numbers_in(value: object) -> Iterator[float]:
    """Yield the numbers of a field: the field itself, or the numbers in its tuples."""
    if isinstance(value, tuple):
        for each in value:
            yield from _numbers_in(each)
    elif isinstance(value, int | float):
        yield float(value)


def plan_body(path: PathPlan, t: Floats, icrs_m: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return forward velocity [m/s] and turn rate [rad/s], clockwise positive, at times t (n,) [s]; (n,) each."""
    speed = np.full(len(t), path.speed_mps)
    distance = path.speed_mps * t
    if path.kind == "spins" or (path.kind == "circle" and path.radius_m == 0):
        turn = np.full(len(t), path.speed_mps / max(abs(icrs_m[0]), abs(icrs_m[1])))
        whole_turns = np.floor(turn * t / (2 * math.pi))
        return np.zeros(len(t)), turn if path.kind == "circle" else np.where(whole_turns % 2 == 0, turn, -turn)
    if path.kind == "straight":
        return speed, np.zeros(len(t))
    if path.kind == "circle":
        return speed, speed / path.radius_m
    if path.kind == "figure-eight":
        lap = np.floor(distance / (2 * math.pi * path.radius_m))
        return speed, np.where(lap % 2 == 0, 1.0, -1.0) * speed / path.radius_m
    if path.kind == "lawnmower":
        lap, within = np.divmod(distance, path.leg_m + math.pi * path.radius_m)
        bend = np.where(lap % 2 == 0, 1.0, -1.0) * speed / path.radius_m
        return speed, np.where(within < path.leg_m, 0.0, bend)
    swing = sum(
        share * np.cos(distance / (length * path.radius_m) + path.phase_rad * (number + 1))
        for number, (share, length) in enumerate(CURVED_SWINGS)
    )
    return speed, swing * speed / path.radius_m


def track_speeds(forward: Floats, turn: Floats, icrs_m: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return left and right track speeds [m/s] that give a forward velocity and a turn rate: Eqs. 8 and 10 solved.

    Parameters
    ----------
    forward, turn : (n,) [m/s], [rad/s] clockwise
    icrs_m : y_icr_right, y_icr_left, x_icr
    """
    right, left, _ = icrs_m
    return forward - left * turn, forward - right * turn


def drive_plan(plan: DrivePlan, tail_s: float, rng: np.random.Generator | None = None) -> Truth:
    """Return the true motion over a plan's duration plus `tail_s` [s]: the last wheel speed needs a next sample.

    `rng` draws the ground of a robot on sliding contacts; default: seed 0.
    """
    end = plan.duration_s + tail_s + 2 * plan.step_s
    times_s = plan.path.t_s if isinstance(plan.path, TrackSpeeds) else np.empty(0)
    edges = np.array([time for time, _ in plan.changes])
    # The times are quotients, because k / 100 and j / 20 give the same double for the same time; products may differ.
    grid = np.arange(math.ceil(end / plan.step_s)) / round(1 / plan.step_s)
    t = np.union1d(grid, np.concatenate([times_s[times_s < end], edges[edges < end]]))
    command_t = t
    if plan.command_rate_hz is not None:
        command_t = np.floor(t * plan.command_rate_hz * (1 + 1e-12)) / plan.command_rate_hz
    if plan.robot is not None and isinstance(plan.path, PathPlan):
        decides = np.append(True, np.diff(command_t) > 0)
        return slide_path(
            plan.robot, t, *plan_body(plan.path, command_t, plan.icrs_m), decides, plan.icrs_m,
            start_heading_rad=plan.start_heading_rad, lag_s=plan.motor_lag_s,
            rng=rng if rng is not None else np.random.default_rng(0),
        )  # fmt: skip
    if isinstance(plan.path, TrackSpeeds):
        row = np.clip(np.searchsorted(times_s, command_t, side="right") - 1, 0, None)
        left, right = plan.path.v_left_mps[row], plan.path.v_right_mps[row]
    else:
        left, right = track_speeds(*plan_body(plan.path, command_t, plan.icrs_m), plan.icrs_m)
    v_left, v_right = left, right
    if plan.motor_lag_s > 0:
        v_left, v_right = follow(left, t, plan.motor_lag_s), follow(right, t, plan.motor_lag_s)
    icrs = np.array([plan.icrs_m, *(icrs for _, icrs in plan.changes)], np.float64)
    icr_row = np.searchsorted(edges, t, side="right").astype(np.int64)
    step = np.diff(t)
    travel_left, travel_right = (np.concatenate([[0.0], np.cumsum(speed[:-1] * step)]) for speed in (v_left, v_right))
    start = np.array([0.0, 0.0, plan.start_heading_rad])
    pose = drive(t, v_left, v_right, icrs, icr_row, start)
    return IcrTruth(
        t_s=t, command_left_mps=left, command_right_mps=right, v_left_mps=v_left, v_right_mps=v_right,
        travel_left_m=travel_left, travel_right_m=travel_right, pose=pose, icrs_m=icrs, icr_row=icr_row,
    )  # fmt: skip


def sense_motion(truth: Truth, sensors: Sensors, duration_s: float, rng: np.random.Generator) -> Readings:
    """Return the measurements of the true motion from time 0 to `duration_s` [s].

    Notes
    -----
    Wheel noise is drawn as a speed per sample and summed into the travel, so that positions and speeds of a message
    agree. An encoder then rounds that travel to counts.
    """
    wheel_t = sample_times(sensors.wheel_rate_hz, duration_s)
    v_left, v_right = (_wheel_speed(truth, side, wheel_t, sensors, rng) for side in ("left", "right"))
    interval = np.diff(np.append(wheel_t, len(wheel_t) / sensors.wheel_rate_hz))
    travels = [np.concatenate([[0.0], np.cumsum(speed * interval)]) for speed in (v_left, v_right)]
    if sensors.wheels == "encoder":
        travels = [np.floor(travel / sensors.metres_per_count) * sensors.metres_per_count for travel in travels]
        v_left, v_right = (np.diff(travel) / interval for travel in travels)
    gnss_t = sample_times(sensors.gnss_rate_hz, duration_s)
    # Noise is drawn for the whole drive, so that an outage changes no fix outside it.
    noise = rng.normal(0.0, 1.0, (len(gnss_t), 2)) * sensors.gnss_std_m
    has_fix = np.ones(len(gnss_t), np.bool_)
    for begin, end in sensors.outages_s:
        has_fix &= (gnss_t < begin) | (gnss_t >= end)
    heading_t = sample_times(sensors.heading_rate_hz, duration_s)
    psi = truth.poses(heading_t)[:, 2] + sensors.heading_offset_rad
    psi += rng.normal(0.0, 1.0, len(heading_t)) * sensors.heading_std_rad
    if sensors.heading_resolution_rad > 0:
        psi = np.rint(psi / sensors.heading_resolution_rad) * sensors.heading_resolution_rad
    turn = truth.turn_rates(heading_t)
    turn += rng.normal(0.0, GYRO_STD_RADPS, len(heading_t))
    pose = truth.poses(gnss_t)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    forward, right = sensors.antenna_forward_m, sensors.antenna_right_m
    antenna = pose[:, :2] + np.column_stack([forward * c - right * s, forward * s + right * c])
    fixes = (antenna + noise)[has_fix]
    left_m, right_m = (travel[:-1] for travel in travels)
    return Readings(wheel_t, left_m, right_m, v_left, v_right, gnss_t[has_fix], fixes, heading_t, psi, turn)


def sample_times(rate_hz: float, duration_s: float) -> Floats:
    """Return the sample times [s] of a sensor of `rate_hz` in [0, duration_s)."""
    count = math.ceil(duration_s * rate_hz * (1 - 1e-12))
    return np.arange(count) / rate_hz


def _wheel_speed(
    truth: Truth, side: Literal["left", "right"], wheel_t: Floats, sensors: Sensors, rng: np.random.Generator
) -> Floats:
    """Return the speed (n,) [m/s] of a side over each interval, noise and bias included, before any counting."""
    if sensors.wheels == "commanded":
        command: Floats = getattr(truth, f"command_{side}_mps")
        speed = command[truth.rows(wheel_t)]
    else:
        edges = np.append(wheel_t, len(wheel_t) / sensors.wheel_rate_hz)
        speed = np.diff(np.interp(edges, truth.t_s, getattr(truth, f"travel_{side}_m"))) / np.diff(edges)
    # Noise is drawn even if its size is zero, so that runs with and without noise differ by the noise alone.
    noise: Floats = rng.normal(0.0, 1.0, len(wheel_t)) * sensors.input_noise_mps
    return speed + sensors.input_bias_mps + noise


def simulate(plan: DrivePlan, sensors: Sensors, seed: int) -> tuple[SensorColumns, TruthTable]:
    """Return the measurements and the truth of a simulated drive.

    Parameters
    ----------
    seed : of the sensors' noise; the same seed gives the same numbers

    Raises
    ------
    ConfigError
        The plan cannot be driven, or a sensor gives too few samples.
    """
    check_drive(plan, sensors)
    truth = drive_plan(plan, 1.0 / sensors.wheel_rate_hz, np.random.default_rng((seed, 2)))
    readings = sense_motion(truth, sensors, plan.duration_s, np.random.default_rng((seed, 0)))
    times, row = readings.wheel_t, truth.rows(readings.wheel_t)
    columns: TruthTable = {"stamp_ns": stamps_of(times), "t_s": times - times[0]}
    columns |= zip(("north_m", "east_m", "heading_rad"), truth.poses(times).T, strict=True)
    columns |= zip(("y_icr_right_m", "y_icr_left_m", "x_icr_m"), truth.icrs(times).T, strict=True)
    columns |= {"v_left_mps": truth.v_left_mps[row], "v_right_mps": truth.v_right_mps[row]}
    return record_drive(readings, sensors, np.random.default_rng((seed, 1))), columns


def record_drive(readings: Readings, sensors: Sensors, rng: np.random.Generator) -> SensorColumns:
    """Return readings with stamps from `START_NS` on, delays included, and with geodetic fixes about `DATUM`."""
    from pymap3d import ned2geodetic

    fixes = len(readings.gnss_t)
    down = rng.normal(0.0, HEIGHT_STD_RATIO * sensors.gnss_std_m, fixes)
    latitude, longitude, height = ned2geodetic(*readings.gnss_m.T, down, *DATUM)
    status = 2 if sensors.gnss_std_m <= LARGEST_RTK_STD_M else 1 if sensors.gnss_std_m <= LARGEST_SBAS_STD_M else 0
    return SensorColumns(
        wheel_stamp_ns=stamps_of(readings.wheel_t),
        wheel_position_left_m=readings.travel_left_m,
        wheel_position_right_m=readings.travel_right_m,
        wheel_v_left_mps=readings.v_left_mps,
        wheel_v_right_mps=readings.v_right_mps,
        gnss_stamp_ns=stamps_of(readings.gnss_t + sensors.gnss_delay_s),
        latitude_deg=np.asarray(latitude, np.float64),
        longitude_deg=np.asarray(longitude, np.float64),
        height_m=np.asarray(height, np.float64),
        gnss_std_m=np.full(fixes, sensors.gnss_std_m),
        gnss_status=np.full(fixes, status, np.int64),
        heading_stamp_ns=stamps_of(readings.heading_t + sensors.heading_delay_s),
        heading_rad=wrapped(readings.heading_rad),
        yaw_rate_radps=readings.yaw_rate_radps,
    )


def stamps_of(times: Floats, start_ns: int = START_NS) -> Ints:
    """Return times [s] as stamps of the log's clock."""
    return start_ns + np.rint(times * 1e9).astype(np.int64)
