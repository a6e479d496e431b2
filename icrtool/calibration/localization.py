"""Numbers of a drive for `robot_localization`: covariances, process noise, heading offset, place of the antenna.

Frames follow REP-103: x forward, y left, yaw counter-clockwise from east. Every number has its source and, if
it is known, its standard deviation. Numbers that the drive does not show are listed with the reason.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.calibration.held_out import TWIST_OVER_M
from icrtool.calibration.pooled import known_antenna_m
from icrtool.calibration.record import Calibration
from icrtool.calibration.sensor_findings import ANTENNA_AHEAD, ANTENNA_ASIDE
from icrtool.errors import DataError
from icrtool.estimation.filter_setup import configured_noise
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.filter_records import REFERENCE_STEP_S
from icrtool.records.run import Run

FILTER_PERIOD_S = 1.0 / 30.0
"""Time between two predictions of robot_localization [s], as its own parameter files set it."""

BLOCK_S = 1.0
"""Duration of the stretches of a drive that count as independent changes of its speed [s]."""

IMU_TYPE, FIX_TYPE = "sensor_msgs/Imu", "sensor_msgs/NavSatFix"
"""Message types that navsat_transform_node reads."""

DECLINATION_STD_DEG = 0.4
"""Standard deviation of the World Magnetic Model's declination [deg], as its authors state it for medium latitudes."""


class SourcedValue(NamedTuple):
    """A number, its standard deviation (None where it has none), and its source."""

    value: float
    std: float | None
    source: str


class AntennaPlace(NamedTuple):
    """Position of the antenna from the body origin, forward and left [m], and the source of it."""

    forward_m: float
    left_m: float
    source: str


class Localization(NamedTuple):
    """Numbers for the parameters of `robot_localization`.

    Attributes
    ----------
    twist : variances of v_x, v_y [m^2/s^2] and yaw rate [rad^2/s^2] in a message of wheel odometry
    gyro_rate : variance of the yaw rate of the gyro [rad^2/s^2]; None without a gyro
    process : process noise, as variance for each second, by the name of the state in `robot_localization`
    declination_rad, yaw_offset_rad : angles that navsat_transform_node adds to the yaw of the IMU; None if the drive
        does not show them
    antenna : position of the antenna; None if it is not known
    wheel_topic, imu_topic : topics of the log; empty if the log has none of the types
    left_out : parameter and reason for each number that the drive does not show
    """

    twist: tuple[SourcedValue, SourcedValue, SourcedValue]
    gyro_rate: SourcedValue | None
    process: dict[str, SourcedValue]
    declination_rad: SourcedValue | None
    yaw_offset_rad: SourcedValue | None
    antenna: AntennaPlace | None
    wheel_topic: str
    imu_topic: str
    left_out: tuple[str, ...]


def localization(calibration: Calibration, run: Run | None = None) -> Localization:
    """Return the numbers of a calibration and, if it is given, of the run that the calibration was fitted to.

    Raises
    ------
    DataError
        The drives were too short to measure errors of the wheels.
    """
    errors = calibration.controller_errors
    if errors is None:
        advice = "covariances need a longer drive"
        raise DataError(
            calibration.name or calibration.log_names(), "too short to measure the growth of errors", advice
        )
    source = f"held-out errors of the controller's model over {TWIST_OVER_M:g} m"
    stds = errors.twist_variance_std or (None, None, None)
    v_x, v_y, yaw_rate = (
        SourcedValue(*variance_and_std, source) for variance_and_std in zip(errors.twist_variance, stds, strict=True)
    )
    gyro_rate = None
    if errors.gyro_rate_variance is not None:
        gyro_origin = (
            f"held-out errors of the model with the gyro over {TWIST_OVER_M:g} m, the reference's noise included"
        )
        gyro_rate = SourcedValue(errors.gyro_rate_variance, errors.gyro_rate_variance_std, gyro_origin)
    left_out = [] if gyro_rate is not None else ["imu0: no gyro that turns with the robot"]
    if run is None:
        left_out += [
            "process_noise_covariance: a property of one drive; export its run",
            "navsat_transform_node and the antenna: properties of one log; export its run",
        ]
        return Localization((v_x, v_y, yaw_rate), gyro_rate, {}, None, None, None, "", "", tuple(left_out))
    process = _pose_noise(run) | _speed_noise(calibration, run)
    left_out.append("process noise of z, roll, pitch, vy and accelerations: the defaults of robot_localization")
    declination, offset, why_no_offset = _yaw(run)
    antenna, why_no_antenna = _antenna(run)
    wheels, imu = _topics(run)
    left_out += [why for why in (why_no_offset, why_no_antenna) if why]
    return Localization(
        (v_x, v_y, yaw_rate), gyro_rate, process, declination, offset, antenna, wheels, imu, tuple(left_out)
    )


def _topics(run: Run) -> tuple[str, str]:
    """Return the topics of the wheel odometry and of the gyro; empty if the log has none."""
    wheels = next(
        (stream.topic for stream in run.document.streams if stream.role == "wheels" and _is_odometry(stream)), ""
    )
    return wheels, "" if run.sensors.gyro is None else run.sensors.gyro.topic.partition(" (")[0]


def _is_odometry(stream: object) -> bool:
    """Return whether a stream consists of messages nav_msgs/Odometry."""
    return getattr(stream, "message_type", "") == "nav_msgs/Odometry"


def _pose_noise(run: Run) -> dict[str, SourcedValue]:
    """Return the process noise of x, y [m^2/s] and yaw [rad^2/s] that the filter ran with.

    Notes
    -----
    In a time dt the filter adds the variance REFERENCE_STEP_S dt sigma^2 (Pentzer 2014, Eq. 30, for any sample rate).
    robot_localization adds dt Q.
    """
    used, settings, configured = run.document.filter, run.config.filter, configured_noise(run.config)
    estimates: dict[str, SourcedValue] = {}
    for names, std, unit, first, key, is_searched in (
        (("x", "y"), used.process_position_mps, "m/s", configured.position_mps, "process_position_mps",
         settings.process_position_mps == "auto"),
        (("yaw",), used.process_heading_degps, "deg/s", configured.heading_degps, "process_heading_degps",
         settings.process_heading_degps is None),
    ):  # fmt: skip
        origin = f"of preset {used.preset}, not contradicted by the innovations" if is_searched else "configured"
        if std > first:
            origin = f"raised from {first:g} by the filter's innovations"
        source = f"({std:g} {unit})² × {REFERENCE_STEP_S:g} s, filter.{key}: {origin}"
        value = REFERENCE_STEP_S * (math.radians(std) if unit == "deg/s" else std) ** 2
        estimates |= {name: SourcedValue(value, None, source) for name in names}
    return estimates


def _speed_noise(calibration: Calibration, run: Run) -> dict[str, SourcedValue]:
    """Return the process noise of v_x [m^2/s^3] and of the yaw rate [rad^2/s^3]; empty if the drive is too short.

    Notes
    -----
    robot_localization predicts constant velocities: a change within its period dt has the variance dt Q.
    """
    table = run.table
    interval = np.diff(table.t_s)
    if len(interval) < 2:
        return {}
    k = max(1, math.ceil(FILTER_PERIOD_S / float(np.median(interval)) - 1e-6))
    lasted = table.t_s[k:] - table.t_s[:-k]
    moving = np.abs(table.v_left_mps) + np.abs(table.v_right_mps) > 0.0
    gaps = np.concatenate([[0], np.cumsum(run.in_gap)])
    good = moving[k:] & moving[:-k] & (gaps[k:-1] == gaps[: -k - 1]) & (lasted > 0.0)
    blocks, block = np.unique((table.t_s[:-k][good] // BLOCK_S).astype(np.int64), return_inverse=True)
    if len(blocks) < 2:
        return {}
    v_x, _, yaw_rate = calibration.twist(table.v_left_mps, table.v_right_mps)
    return {
        name: _mean_of_blocks((speed[k:] - speed[:-k])[good] ** 2 / lasted[good], block, float(np.median(lasted)))
        for name, speed in (("vx", v_x), ("vyaw", yaw_rate))
    }


def _mean_of_blocks(squares: Floats, block: Ints, lasted_s: float) -> SourcedValue:
    """Return the mean of squared changes (n,), with a standard deviation from the means of their blocks.

    Parameters
    ----------
    block : (n,) number of the block of each change, from 0
    lasted_s : time in which the changes happened
    """
    count = np.bincount(block)
    means = np.bincount(block, weights=squares) / count
    std = float(means.std() / math.sqrt(len(means)))
    return SourcedValue(
        float(squares.mean()), std, f"changes of the wheels' speed within {lasted_s:.3g} s, while moving"
    )


def _yaw(run: Run) -> tuple[SourcedValue | None, SourcedValue | None, str]:
    """Return the declination and the offset [rad] with which the IMU's yaw counts from east, and why there are none.

    Notes
    -----
    navsat_transform_node adds both angles to the yaw. Its declination is counter-clockwise: the negative of the usual
    declination, which is positive if magnetic north lies east of north.
    """
    sensor, heading = run.sensors.facts.heading_sensor, run.document.heading
    fixes = next((stream.message_type for stream in run.document.streams if stream.role == "gnss"), "")
    reason = ""
    if fixes != FIX_TYPE:
        reason = f"it reads {FIX_TYPE}, and the positions are {fixes or 'of another type'}"
    elif sensor is None or heading.source not in ("orientation", "fused"):
        reason = "no IMU of the log states a heading"
    elif sensor.message_type != IMU_TYPE:
        reason = f"it reads {IMU_TYPE}, and the heading is {sensor.message_type} ({sensor.topic})"
    elif sensor.convention == "ned" or heading.applied_mirror:
        reason = f"the yaw of {sensor.topic} is clockwise (NED), and it reads ENU: convert its messages first"
    elif heading.offset_deg is None:
        reason = "the drive is too short to compare the heading with the course over ground"
    if reason or sensor is None:
        return None, None, f"navsat_transform_node: {reason}"
    applied, std = math.radians(heading.applied_offset_deg), heading.offset_std_deg
    compared = f"heading minus course over ground {heading.offset_deg:+z.2f} deg, {heading.windows} windows"
    if heading.applied_offset_deg == 0.0:
        compared += ": too small to correct"
    declination = SourcedValue(0.0, None, "no declination shown: yaw_offset is the whole offset")
    declination_deg = heading.magnetic_declination_deg
    if declination_deg is not None and "magnetic declination" in (heading.offset_name or ""):
        north = f"magnetic north is {declination_deg:+z.1f} deg east of north"
        words = f"World Magnetic Model: {north}; the sign is that of ENU"
        declination = SourcedValue(-math.radians(declination_deg), math.radians(DECLINATION_STD_DEG), words)
        compared += ", without the declination"
    offset = math.remainder(applied - declination.value, 2.0 * math.pi)
    return declination, SourcedValue(offset, None if std is None else math.radians(std), compared), ""


def _antenna(run: Run) -> tuple[AntennaPlace | None, str]:
    """Return the position of the antenna, and the reason if it is not known."""
    forward, right = known_antenna_m(run)
    if forward is not None and right is not None:
        frames = run.config.frames
        configured = frames.antenna_forward_m != "auto" or frames.antenna_right_m != "auto"
        origin = "frames.antenna_forward_m, antenna_right_m" if configured else "the log's own transforms (/tf_static)"
        return AntennaPlace(forward, -right, origin), ""
    words = []
    for key, label in (
        (ANTENNA_AHEAD, "antenna forward - x ICR"),
        (ANTENNA_ASIDE, "antenna right - middle of the ICRs"),
    ):
        finding = run.document.alignment.get(key)
        if finding is not None and finding.value is not None and finding.std is not None:
            words.append(f"{label} = {finding.value:+z.3f} ± {finding.std:.3f} m")
    shown = f"; positions show {' and '.join(words)}" if words else ""
    return None, f"place of the antenna: not in the log{shown}; measure it and set frames.antenna_forward_m, _right_m"
