"""The export for robot_localization loads, has its parameter names and signs, and its filter states its error."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

import icrtool
from icrtool.calibration.localization import Localization, localization
from icrtool.calibration.pooled import calibrate
from icrtool.calibration.record import Calibration
from icrtool.output.exports.localization import format_localization
from icrtool.output.text_blocks import TEXT_WIDTH
from icrtool.records.run import Run
from support.field_logs import DATUM, ROBOT, Drive, fixes, header, imus, joint_states, made, make_drive, write_messages
from support.field_logs import Message as FieldMessage

SAMPLES = Path(__file__).resolve().parents[3] / "sample_logs"

EKF_PARAMETERS = {
    "frequency", "sensor_timeout", "two_d_mode", "transform_time_offset", "transform_timeout", "print_diagnostics",
    "debug", "debug_out_file", "publish_tf", "publish_acceleration", "map_frame", "odom_frame", "base_link_frame",
    "world_frame", "odom0", "odom0_config", "odom0_queue_size", "odom0_differential", "odom0_relative",
    "odom0_pose_rejection_threshold", "odom0_twist_rejection_threshold", "imu0", "imu0_config", "imu0_differential",
    "imu0_relative", "imu0_queue_size", "imu0_pose_rejection_threshold", "imu0_twist_rejection_threshold",
    "imu0_linear_acceleration_rejection_threshold", "imu0_remove_gravitational_acceleration", "use_control",
    "stamped_control", "control_timeout", "control_config", "acceleration_limits", "deceleration_limits",
    "acceleration_gains", "deceleration_gains", "process_noise_covariance", "initial_estimate_covariance",
}  # fmt: skip
"""Of params/ekf.yaml in the repository cra-ros-pkg/robot_localization (branches ros2 and rolling)."""

NAVSAT_PARAMETERS = {
    "frequency", "delay", "magnetic_declination_radians", "yaw_offset", "zero_altitude", "broadcast_utm_transform",
    "broadcast_utm_transform_as_parent_frame", "publish_filtered_gps", "use_odometry_yaw", "wait_for_datum", "datum",
}  # fmt: skip
"""Of params/navsat_transform.yaml there."""

DEFAULT_NOISE = (0.05, 0.05, 0.06, 0.03, 0.03, 0.06, 0.025, 0.025, 0.04, 0.01, 0.01, 0.02, 0.01, 0.01, 0.015)
"""Diagonal of process_noise_covariance in params/ekf.yaml."""

OFFSET_DEG, ANTENNA = 20.0, (0.30, 0.10)
"""What the heading of the field log states too much, and its antenna from the body origin, forward and left [m]."""


def transforms(stamp_ns: int) -> FieldMessage:
    """Return the static transform from the base to the antenna."""
    at = made("geometry_msgs/msg/Vector3", x=ANTENNA[0], y=ANTENNA[1], z=0.5)
    none = made("geometry_msgs/msg/Quaternion", w=1.0)
    moved = made("geometry_msgs/msg/Transform", translation=at, rotation=none)
    kind = "geometry_msgs/msg/TransformStamped"
    one = made(kind, header=header(stamp_ns, "base_link"), child_frame_id="gps", transform=moved)
    return FieldMessage(
        stamp_ns, "/tf_static", "tf2_msgs/msg/TFMessage", made("tf2_msgs/msg/TFMessage", transforms=[one])
    )


def field_run(tmp_path: Path, drive: Drive, *, antenna: bool = True, clockwise: bool = False) -> Run:
    """Fit a log whose IMU states headings that are wrong by `OFFSET_DEG`, its antenna not at the body origin."""
    ahead, left = ANTENNA if antenna else (0.0, 0.0)
    sin, cos = np.sin(drive.heading), np.cos(drive.heading)
    place = drive._replace(north=drive.north + ahead * cos + left * sin, east=drive.east + ahead * sin - left * cos)
    stated = drive.heading + math.radians(OFFSET_DEG)
    turned = drive._replace(heading=math.pi / 2 - stated if clockwise else stated)
    streams = [joint_states(drive), fixes(place), imus(turned)]
    streams += [iter([transforms(int(drive.stamp_ns[0]))])] if antenna else []
    path = write_messages(tmp_path / "field.mcap", *streams)
    config = icrtool.load_config(sets=[*ROBOT])
    return icrtool.fit(icrtool.read_log(path, config), config)


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> tuple[Drive, Run]:
    drive = make_drive(120.0)
    return drive, field_run(tmp_path_factory.mktemp("field"), drive)


@functools.cache
def exported(run: Run) -> tuple[Calibration, Localization, str]:
    calibration = calibrate(run)
    numbers = localization(calibration, run)
    return calibration, numbers, format_localization(calibration, numbers)


def words_of(text: str) -> str:
    """Return the words of the comments, without line ends."""
    return " ".join(line.removeprefix("#").strip() for line in text.splitlines())


def test_every_parameter_is_one_of_robot_localization(field: tuple[Drive, Run]) -> None:
    _, _, text = exported(field[1])
    document = YAML(typ="safe").load(text)
    assert set(document) == {"ekf_filter_node", "navsat_transform_node"}
    assert all(set(node) == {"ros__parameters"} for node in document.values())
    ekf = document["ekf_filter_node"]["ros__parameters"]
    navsat = document["navsat_transform_node"]["ros__parameters"]
    assert set(ekf) <= EKF_PARAMETERS
    assert set(ekf) >= {"odom0", "odom0_config", "imu0", "imu0_config", "process_noise_covariance", "two_d_mode"}
    assert set(navsat) == {"magnetic_declination_radians", "yaw_offset"} <= NAVSAT_PARAMETERS
    assert ekf["imu0"] == "/imu/data"
    for key, used in (("odom0_config", [6, 7, 11]), ("imu0_config", [11])):
        assert [i for i, one in enumerate(ekf[key]) if one] == used
        assert len(ekf[key]) == 15
    # ROS 2 refuses an integer in a list of doubles, and a matrix that is not whole
    noise = ekf["process_noise_covariance"]
    assert len(noise) == 225
    assert all(type(value) is float for value in (*noise, *navsat.values()))
    diagonal = np.array(noise).reshape(15, 15)
    assert np.count_nonzero(diagonal) == 15
    assert [diagonal[i, i] for i in (2, 3, 4, 7, 8, 9, 10, 12, 13, 14)] == [
        DEFAULT_NOISE[i] for i in (2, 3, 4, 7, 8, 9, 10, 12, 13, 14)
    ]
    comments = [line for line in text.splitlines() if line.lstrip().startswith("#") and "ros2 run" not in line]
    assert max(map(len, comments)) <= TEXT_WIDTH


def test_the_row_to_copy_is_that_of_the_controller(field: tuple[Drive, Run]) -> None:
    calibration, _, text = exported(field[1])
    line = next(one for one in text.splitlines() if "twist_covariance_diagonal" in one)
    row = YAML(typ="safe").load(line.removeprefix("#"))["twist_covariance_diagonal"]
    errors = calibration.controller_errors
    assert errors is not None
    assert errors.twist_variance_std is not None
    assert [row[i] for i in (0, 1, 5)] == pytest.approx(list(errors.twist_variance), rel=1e-3)
    assert all(0.0 < std < value for value, std in zip(errors.twist_variance, errors.twist_variance_std, strict=True))
    assert "no parameters for them" in words_of(text)


def test_the_yaw_of_the_imu_plus_both_angles_counts_from_east(field: tuple[Drive, Run]) -> None:
    """navsat_transform_node adds magnetic_declination_radians and yaw_offset to the yaw of the message."""
    drive, run = field
    _, numbers, text = exported(run)
    navsat = YAML(typ="safe").load(text)["navsat_transform_node"]["ros__parameters"]
    sent = math.pi / 2 - (drive.heading + math.radians(OFFSET_DEG))
    used = sent + navsat["magnetic_declination_radians"] + navsat["yaw_offset"]
    assert numbers.yaw_offset_rad is not None
    assert numbers.yaw_offset_rad.std is not None
    error = np.angle(np.exp(1j * (used - (math.pi / 2 - drive.heading))))
    assert np.abs(error).max() < 3.0 * numbers.yaw_offset_rad.std
    assert 0.0 < numbers.yaw_offset_rad.std < math.radians(3.0)


def test_a_declination_has_the_sign_of_the_node(tmp_path: Path) -> None:
    """Its own example has +0.0429 where magnetic north is 2.5 deg *west*: counter-clockwise, as yaw in ENU."""
    from pygeomag import GeoMag

    drive = make_drive(120.0)
    day = np.datetime64(int(drive.stamp_ns[0]), "ns").astype("datetime64[D]").item()
    declination = GeoMag(base_year=day).calculate(*DATUM[:2], DATUM[2] / 1e3, day.year + 0.77).d
    assert declination > 3.0
    compass = drive._replace(heading=drive.heading - math.radians(declination))
    path = write_messages(tmp_path / "compass.mcap", joint_states(drive), fixes(drive), imus(compass))
    config = icrtool.load_config(sets=[*ROBOT])
    _, numbers, text = exported(icrtool.fit(icrtool.read_log(path, config), config))
    navsat = YAML(typ="safe").load(text)["navsat_transform_node"]["ros__parameters"]
    assert navsat["magnetic_declination_radians"] == pytest.approx(-math.radians(declination), abs=1e-3)
    assert numbers.yaw_offset_rad is not None
    assert numbers.yaw_offset_rad.std is not None
    assert abs(navsat["yaw_offset"]) < 3.0 * numbers.yaw_offset_rad.std
    assert "World Magnetic Model" in text


def test_the_antenna_is_a_line_for_tf2(field: tuple[Drive, Run]) -> None:
    """y to the left; the body origin of the log's own transforms."""
    _, _, text = exported(field[1])
    line = next(one for one in text.splitlines() if "static_transform_publisher" in one)
    words = line.removeprefix("# ").split()
    assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    options = dict(zip(words[4::2], words[5::2], strict=True))
    assert (float(options["--x"]), float(options["--y"])) == pytest.approx(ANTENNA)
    assert (options["--frame-id"], options["--child-frame-id"]) == ("base_link", "gps")


def test_what_the_log_does_not_show_is_left_out_and_named(tmp_path: Path, field: tuple[Drive, Run]) -> None:
    run = field_run(tmp_path, make_drive(120.0), antenna=False, clockwise=True)
    _, _, text = exported(run)
    words = words_of(text)
    document = YAML(typ="safe").load(text)
    assert set(document) == {"ekf_filter_node"}
    assert "static_transform_publisher" not in text
    assert "Left out" in text
    for reason in ("NED", "place of the antenna: not in the log; positions show antenna forward - x ICR"):
        assert reason in words
    calibration, _, _ = exported(field[1])
    of_calibration = format_localization(calibration, localization(calibration))
    ekf = YAML(typ="safe").load(of_calibration)["ekf_filter_node"]["ros__parameters"]
    assert "process_noise_covariance" not in ekf
    assert "process_noise_covariance: a property of one drive" in of_calibration


def test_a_topic_of_any_name_stays_a_text(field: tuple[Drive, Run]) -> None:
    calibration, numbers, _ = exported(field[1])
    wild = numbers._replace(imu_topic='/a"b: [\n# c\\', wheel_topic="/räder/odom")
    ekf = YAML(typ="safe").load(format_localization(calibration, wild))["ekf_filter_node"]["ros__parameters"]
    assert (ekf["imu0"], ekf["odom0"]) == ("/ab: [ # c", "/räder/odom")


@pytest.mark.parametrize(
    ("log", "robot"), [("tracked_curved.bag", "pentzer-tracked"), ("wheeled_lawnmower.mcap", "segway-rmp400")]
)
def test_its_filter_states_its_own_error_after_ten_metres(log: str, robot: str) -> None:
    """A plain transcription of robot_localization's EKF in the plane, with the exported numbers, without GNSS.

    State x, y, yaw, vx, vy, vyaw; P = F P F' + dt Q at about its 30 Hz; then the wheels' twist with its covariance.
    """
    config = icrtool.load_config(robot=robot)
    run = icrtool.fit(icrtool.read_log(SAMPLES / log, config), config)
    calibration, _, text = exported(run)
    noise = YAML(typ="safe").load(text)["ekf_filter_node"]["ros__parameters"]["process_noise_covariance"]
    Q = np.diag(np.diag(np.array(noise).reshape(15, 15))[[0, 1, 5, 6, 7, 11]])
    errors = calibration.controller_errors
    assert errors is not None
    R, numbers, table = np.diag(errors.twist_variance), calibration.controller, run.table
    rows = np.arange(0, len(table), round(1.0 / 30.0 / float(np.median(np.diff(table.t_s)))))
    t, north, east = table.t_s[rows], table.north_m[rows], table.east_m[rows]
    yaw, driven = math.pi / 2 - table.heading_rad[rows], table.distance_m[rows]
    left, right = numbers.left_radius * table.v_left_mps[rows], numbers.right_radius * table.v_right_mps[rows]
    twist = np.column_stack(
        [(left + right) / 2, np.zeros(len(rows)), (right - left) / (numbers.multiplier * calibration.width_m)]
    )
    missed, stated = [], []
    for begin in range(0, len(rows), len(rows) // 25):
        end = int(np.searchsorted(driven, driven[begin] + 10.0))
        if end >= len(rows):
            break
        x, P = np.array([east[begin], north[begin], yaw[begin], *twist[begin]]), np.diag([1e-9] * 3 + [*np.diag(R)])
        for i in range(begin + 1, end + 1):
            dt, cos, sin = t[i] - t[i - 1], math.cos(x[2]), math.sin(x[2])
            F = np.eye(6)
            F[0, 2:5] = dt * np.array([-sin * x[3] - cos * x[4], cos, -sin])
            F[1, 2:5] = dt * np.array([cos * x[3] - sin * x[4], sin, cos])
            F[2, 5] = dt
            x = x + dt * np.array([cos * x[3] - sin * x[4], sin * x[3] + cos * x[4], x[5], 0.0, 0.0, 0.0])
            P = F @ P @ F.T + dt * Q
            S = P[3:, 3:] + R
            K = np.linalg.solve(S, P[3:, :]).T
            x, P = x + K @ (twist[i] - x[3:]), P - K @ S @ K.T
        missed.append((x[0] - east[end]) ** 2 + (x[1] - north[end]) ** 2)
        stated.append(P[0, 0] + P[1, 1])
    ratio = math.sqrt(np.mean(stated) / np.mean(missed))
    # measured 1.2 to 1.9 here, 1.2 to 2.5 on recorded drives: a filter that states less than its error is refused
    assert 0.9 < ratio < 3.0
