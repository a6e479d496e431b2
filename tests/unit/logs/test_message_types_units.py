"""What the numbers of a position or heading message mean: units, validity, conventions, in every spelling."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.sources import HeadingSource, PositionSource, increasing_rows, stamp_rows
from support.tables import START_NS, STEP_NS, read_source, table_of

ROUNDING_DEG = 1e-12
"""A degree near 180 is rounded at 3e-14; a few operations follow."""

ROUNDING_RAD = 1e-12


def position(message_type: str, topic: str = "/topic", **columns: Any) -> PositionSource:
    return read_source("gnss", table_of(message_type, spelled(columns), topic), Config())


def heading(message_type: str, topic: str = "/topic", **columns: Any) -> HeadingSource:
    return read_source("heading", table_of(message_type, spelled(columns), topic), Config())


def spelled(columns: dict[str, Any]) -> dict[str, Any]:
    """A keyword cannot hold a dot or an index: ``status__status``, ``position_covariance_0_``."""
    import re

    return {re.sub(r"_(\d+)_$", r"[\1]", path).replace("__", "."): values for path, values in columns.items()}


def fix(**columns: Any) -> dict[str, Any]:
    base = {"status__status": [0] * 3, "latitude": [48.0] * 3, "longitude": [11.0] * 3, "altitude": [500.0] * 3}
    covariance = {f"position_covariance_{i}_": [v] * 3 for i, v in ((0, 4e-4), (1, 1e-5), (4, 9e-4))}
    return base | covariance | {"position_covariance_type": [2] * 3} | columns


def about(yaw: Any) -> dict[str, Any]:
    """Return the quaternion of a yaw about z."""
    half = np.asarray(yaw) / 2
    return {"x": np.zeros_like(half), "y": np.zeros_like(half), "z": np.sin(half), "w": np.cos(half)}


def imu(yaw: Any, frame: str = "imu_link", **more: Any) -> dict[str, Any]:
    length = len(np.asarray(yaw))
    orientation = {f"orientation__{axis}": values for axis, values in about(yaw).items()}
    return {**orientation, "header__frame_id": [frame] * length, **more}


# Positions


def test_a_covariance_whose_type_is_a_word_is_stated() -> None:
    source = position("sensor_msgs/NavSatFix", **fix(position_covariance_type=["KNOWN"] * 3))
    assert np.isfinite(source.variance).all()


@pytest.mark.parametrize("name", ["sensor_msgs/NavSatFix", "gps_common/GPSFix", "gps_msgs/GPSFix"])
def test_an_enu_covariance_is_turned_to_north_and_east(name: str) -> None:
    source = position(name, **fix())
    assert source.variance[0].tolist() == [9e-4, 4e-4, 1e-5]
    assert source.geodetic is not None
    assert source.geodetic[0].tolist() == [48.0, 11.0, 500.0]
    assert source.usable.all()


def test_a_pose_in_a_camera_s_optical_frame_is_no_position() -> None:
    """Its z is forward and its y down; a slope and a narrow straight drive are level."""
    t = np.linspace(0.0, 20.0, 200)
    ahead, left, up = 4.0 * np.sin(0.4 * t) + t, 5.0 * np.cos(0.3 * t), 0.02 * np.sin(9.0 * t)

    def problem(x: Any, y: Any, z: Any) -> str:
        columns = {f"pose__position__{axis}": values for axis, values in zip("xyz", (x, y, z), strict=True)}
        columns |= {f"pose__orientation__{axis}": values for axis, values in about(0.1 * t).items()}
        return position("geometry_msgs/PoseStamped", "/slam/pose", **columns).problem

    assert "optical frame" in problem(-left, up, ahead)
    assert problem(ahead, left, up) == problem(ahead, left, 0.3 * ahead + up) == problem(ahead, up, 0.3 * t) == ""


def test_positions_counted_from_the_centre_of_the_earth_are_refused_as_such() -> None:
    """UTM coordinates, which are as large, are read."""
    t = np.linspace(0.0, 20.0, 200)

    def problem(*places: Any) -> str:
        columns = {f"pose__pose__position__{axis}": values for axis, values in zip("xyz", places, strict=True)}
        columns |= {f"pose__pose__orientation__{axis}": values for axis, values in about(0.1 * t).items()}
        return position("nav_msgs/Odometry", "/ins/odom", **columns).problem

    assert "(ECEF)" in problem(1.25e6 + 5 * np.sin(t), -4.16e6 + t, 4.65e6 + np.cos(t))
    assert problem(3.3e5 + 5 * np.sin(t), 5.18e6 + t, 98.0 + np.cos(t)) == ""


def test_a_position_of_an_autopilot_is_geodetic_and_its_yaw_in_enu() -> None:
    name, yaw = "geographic_msgs/GeoPoseStamped", np.array([0.1, 0.2, 0.4])
    columns = {"latitude": [48.0] * 3, "longitude": [11.0] * 3, "altitude": [500.0, np.nan, 500.0]}
    source = position(name, **{f"pose__position__{field}": values for field, values in columns.items()})
    assert source.geodetic is not None
    assert source.geodetic[1].tolist() == [48.0, 11.0, 500.0]
    found = heading(name, **{f"pose__orientation__{axis}": values for axis, values in about(yaw).items()})
    np.testing.assert_allclose(found.heading_rad(found.convention), math.pi / 2 - yaw, atol=ROUNDING_RAD)


@pytest.mark.parametrize("frame", ["camera_init", "odom_lidar", "map", "odom"])
def test_the_frame_of_an_odometry_shows_a_reference(frame: str) -> None:
    """FAST-LIO writes /Odometry in camera_init, KISS-ICP /kiss/odometry in odom_lidar."""
    t = np.linspace(0.0, 20.0, 200)
    columns = {f"pose__pose__position__{axis}": values for axis, values in zip("xyz", (t, t**2, 0 * t), strict=True)}
    columns |= {f"pose__pose__orientation__{axis}": values for axis, values in about(0.1 * t).items()}
    source = position("nav_msgs/Odometry", "/Odometry", header__frame_id=[frame] * 200, **columns)
    assert ("topics.gnss" in source.problem) == (frame == "odom")


@pytest.mark.parametrize("name", ["sensor_msgs/NavSatFix", "gps_common/GPSFix", "gps_msgs/GPSFix"])
def test_a_negative_status_is_no_fix(name: str) -> None:
    source = position(name, **fix(status__status=[-1, 0, -2]))
    assert source.usable.tolist() == [False, True, False]
    assert source.rejected == {"no fix": 2}


@pytest.mark.parametrize("longitude", [11.0, 180.0])
def test_fixes_of_the_place_where_a_receiver_was_last_are_left_out(longitude: float) -> None:
    """The local plane would be laid there. At the date line fixes on both sides are of one place."""
    longitudes = [114.05, *[longitude, -longitude if longitude == 180.0 else longitude] * 5]
    columns = {"status__status": [0] * 11, "latitude": [22.54, *[48.0] * 10], "longitude": longitudes}
    source = position("sensor_msgs/NavSatFix", **columns, altitude=[500.0] * 11, position_covariance_type=[0] * 11)
    assert source.usable.tolist() == [False, *[True] * 10]
    assert source.rejected == {"far from the others": 1}


def test_a_longitude_that_is_no_number_is_compared_with_none() -> None:
    columns = {"status__status": [0] * 4, "latitude": [48.0] * 4, "longitude": [11.0, np.inf, -1.7e308, np.nan]}
    source = position("sensor_msgs/NavSatFix", **columns, altitude=[500.0] * 4, position_covariance_type=[0] * 4)
    assert source.rejected == {"not finite": 2, "not a place on earth": 1}


def test_a_status_that_is_never_told_refuses_nothing() -> None:
    assert position("sensor_msgs/NavSatFix", **fix(status__status=[-2] * 3)).usable.all()
    never = fix()
    del never["status__status"]
    assert position("sensor_msgs/NavSatFix", **never).usable.all()


def test_rows_at_0_0_and_not_finite_and_off_the_earth_are_dropped_with_the_reason() -> None:
    source = position("sensor_msgs/NavSatFix", **fix(latitude=[0.0, np.nan, 48.0], longitude=[0.0, 11.0, 1e9]))
    assert not source.usable.any()
    assert source.rejected == {"at 0, 0": 1, "not finite": 1, "not a place on earth": 1}
    assert source.problem == "no usable fix (not finite 1, not a place on earth 1, at 0, 0 1)"


def test_an_altitude_that_is_nan_or_absurd_becomes_the_usual_one() -> None:
    source = position("sensor_msgs/NavSatFix", **fix(altitude=[np.nan, 512.0, -2e10]))
    assert source.geodetic is not None
    assert source.geodetic[:, 2].tolist() == [512.0, 512.0, 512.0]
    assert source.usable.all()
    useless = position("sensor_msgs/NavSatFix", **fix(altitude=[np.nan] * 3))
    assert useless.geodetic is not None
    assert useless.geodetic[:, 2].tolist() == [0.0] * 3


@pytest.mark.parametrize(
    "unsaid",
    [
        {"position_covariance_type": [0] * 3},
        {"position_covariance_0_": [0.0] * 3},
        {"position_covariance_4_": [np.nan] * 3},
    ],
)
def test_a_covariance_of_unknown_type_or_of_zeros_says_nothing(unsaid: dict[str, Any]) -> None:
    assert np.isnan(position("sensor_msgs/NavSatFix", **fix(**unsaid)).variance).all()


def test_a_95_percent_radius_stands_in_for_the_covariance_of_a_gpsfix() -> None:
    unknown = {"position_covariance_type": [0] * 3, "err_horz": [2.45, 0.0, np.nan]}
    variance = position("gps_msgs/GPSFix", **fix(**unknown)).variance
    assert variance[0].tolist() == pytest.approx([1.0, 1.0, 0.0])
    assert np.isnan(variance[1:]).all()
    known = position("gps_msgs/GPSFix", **fix(err_horz=[2.45] * 3)).variance
    assert known[0].tolist() == [9e-4, 4e-4, 1e-5]


def test_a_fix_of_metres_ranks_below_one_of_centimetres() -> None:
    worse = {f"position_covariance_{i}_": [4.0] * 3 for i in (0, 4)}
    assert (
        position("sensor_msgs/NavSatFix", **fix(**worse)).score < position("sensor_msgs/NavSatFix", **fix()).score - 30
    )


@pytest.mark.parametrize("accuracy", ["hAcc", "h_acc"])
def test_navpvt_is_in_1e_7_degrees_and_mm_and_bit_0_is_a_fix(accuracy: str) -> None:
    columns = {
        "lat": [480000001] * 2,
        "lon": [-110000002] * 2,
        "height": [500123] * 2,
        "flags": [131, 130],
        accuracy: [14] * 2,
    }
    source = position("ublox_msgs/NavPVT", **columns)
    assert source.geodetic is not None
    np.testing.assert_allclose(source.geodetic[0], [48.0000001, -11.0000002, 500.123], rtol=0, atol=ROUNDING_DEG)
    assert source.usable.tolist() == [True, False]
    assert source.variance[0].tolist() == pytest.approx([0.014**2, 0.014**2, 0.0])
    assert source.stamps.header_ns is None


@pytest.mark.parametrize(
    "spelling",
    [("latHp", "lonHp", "heightHp", "hAcc", "invalid_llh"), ("lat_hp", "lon_hp", "height_hp", "h_acc", "invalid_llh")],
    ids=["ROS 1", "ROS 2"],
)
def test_navhpposllh_adds_the_high_precision_part(spelling: tuple[str, ...]) -> None:
    fine = dict(zip(spelling, ([-7, 0], [9, 0], [5, 0], [140, 140], [0, 1]), strict=True))
    source = position("ublox_msgs/NavHPPOSLLH", lat=[480000001] * 2, lon=[110000002] * 2, height=[500123] * 2, **fine)
    assert source.geodetic is not None
    np.testing.assert_allclose(source.geodetic[0], [48.000000093, 11.000000209, 500.1235], rtol=0, atol=ROUNDING_DEG)
    assert source.variance[0, 0] == pytest.approx(0.014**2)
    assert source.usable.tolist() == [True, False]


def test_pvtgeodetic_is_in_rad_and_0_01_m() -> None:
    source = position(
        "septentrio_gnss_driver/PVTGeodetic",
        latitude=np.radians([48.0, 48.0, 48.0, -2e10]),
        longitude=np.radians([11.0, 11.0, 11.0, 11.0]),
        height=[500.0] * 4,
        mode=[4, 64, 4, 4],
        error=[0, 0, 3, 0],
        h_accuracy=[3, 3, 65535, 65535],
    )
    assert source.geodetic is not None
    np.testing.assert_allclose(source.geodetic[0], [48.0, 11.0, 500.0], rtol=0, atol=ROUNDING_DEG)
    assert source.usable.tolist() == [True, False, False, False]
    assert source.variance[0].tolist() == pytest.approx([9e-4, 9e-4, 0.0])
    assert np.isnan(source.variance[2]).all()


def test_insnavgeod_is_in_rad_and_metres() -> None:
    source = position(
        "septentrio_gnss_driver/INSNavGeod",
        latitude=np.radians([48.0] * 3),
        longitude=np.radians([11.0] * 3),
        height=[500.0, 500.0, -2e10],
        gnss_mode=[4, 0, 4],
        error=[0, 0, 0],
        latitude_std_dev=[0.02, 0.02, -2e10],
        longitude_std_dev=[0.03, 0.03, 0.03],
    )
    assert source.usable.tolist() == [True, False, True]
    assert source.variance[0].tolist() == pytest.approx([4e-4, 9e-4, 0.0])
    assert np.isnan(source.variance[2]).all()


def test_a_novatel_position_is_used_when_it_was_computed() -> None:
    common = {"lat": [48.0] * 2, "lon": [11.0] * 2, "undulation": [45.0, np.nan]}
    words = position(
        "novatel_gps_msgs/NovatelPosition", **common, height=[455.0, 455.0],
        solution_status=["SOL_COMPUTED", "INSUFFICIENT_OBS"], lat_sigma=[0.02] * 2, lon_sigma=[0.03] * 2,
    )  # fmt: skip
    numbers = position(
        "novatel_oem7_msgs/BESTPOS", **common, hgt=[455.0, 455.0],
        sol_status__status=[0, 1], lat_stdev=[0.02] * 2, lon_stdev=[0.03] * 2,
    )  # fmt: skip
    for source in (words, numbers):
        assert source.usable.tolist() == [True, False]
        assert source.variance[0].tolist() == pytest.approx([4e-4, 9e-4, 0.0])
        assert source.geodetic is not None
        assert source.geodetic[:, 2].tolist() == [500.0, 455.0]


def test_an_inertial_novatel_solution_is_used_when_it_is_good() -> None:
    common = {"latitude": [48.0] * 3, "longitude": [11.0] * 3, "azimuth": [90.0] * 3}
    words = common | {"altitude": [1.0] * 3, "ins_status": ["INS_SOLUTION_GOOD", "INS_ALIGNING", "INS_SOLUTION_FREE"]}
    numbers = common | {"height": [1.0] * 3, "ins_status__status": [3, 1, 6]}
    for name, columns in (("novatel_gps_msgs/Inspvax", words), ("novatel_oem7_msgs/INSPVAX", numbers)):
        assert position(name, **columns).usable.tolist() == [True, False, True]
        assert heading(name, **columns).usable.tolist() == [True, False, True]


def pose(x: Any, y: Any, prefix: str = "pose__") -> dict[str, Any]:
    return {f"{prefix}position__x": np.asarray(x), f"{prefix}position__y": np.asarray(y)}


def test_a_metric_pose_has_x_east_and_y_north() -> None:
    source = position("geometry_msgs/PoseStamped", "/icp_pose", **pose([1.0, np.nan], [2.0, 0.0]))
    assert source.metric is not None
    assert source.metric[0].tolist() == [2.0, 1.0]
    assert source.rejected == {"not finite": 1}


@pytest.mark.parametrize("topic", ["/move_base_simple/goal", "/goal_pose", "/initialpose", "/cmd_pose"])
def test_a_goal_is_not_a_measurement(topic: str) -> None:
    columns = pose([1.0, 2.0], [2.0, 0.0]) | {f"pose__orientation__{a}": v for a, v in about([0.1, 0.2]).items()}
    assert "goal" in position("geometry_msgs/PoseStamped", topic, **columns).problem
    assert "goal" in heading("geometry_msgs/PoseStamped", topic, **columns).problem


@pytest.mark.parametrize(
    ("topic", "frame", "refused"),
    [
        ("/odom", "odom", True),
        ("/platform/odom/filtered", "odom", True),
        ("/husky_velocity_controller/odom", "odom", True),
        ("/prefix/odom", "odom", True),
        ("/odom", "map", False),
        ("/odometry/gps", "odom", False),
        ("/icp_odom", "odom", False),
        ("/ground_truth/state", "world", False),
    ],
)
def test_odometry_is_a_reference_only_where_its_name_or_frame_says_so(topic: str, frame: str, refused: bool) -> None:
    columns = pose([1.0, 2.0], [2.0, 0.0], "pose__pose__") | {"header__frame_id": [frame] * 2}
    assert bool(position("nav_msgs/Odometry", topic, **columns).problem) is refused


def test_a_fused_pose_that_is_called_odometry_is_no_reference() -> None:
    columns = pose([1.0, 2.0], [2.0, 0.0], "pose__pose__")
    source = position("geometry_msgs/PoseWithCovarianceStamped", "/robot_pose_ekf/odom_combined", **columns)
    assert "dead reckoning" in source.problem


# Headings


@pytest.mark.parametrize(
    ("frame", "convention", "expected"),
    [
        ("imu_link", "enu", [90.0, 0.0, -90.0]),
        ("imu_link_ned", "ned", [0.0, 90.0, 180.0]),
        ("NED", "ned", [0.0, 90.0, 180.0]),
    ],
)
def test_the_yaw_of_an_imu_is_enu_unless_its_frame_says_ned(frame: str, convention: Any, expected: list[float]) -> None:
    source = heading("sensor_msgs/Imu", **imu([0.0, np.pi / 2, np.pi], frame))
    assert source.convention == convention
    found = np.degrees(source.heading_rad(source.convention))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_variance_of_minus_one_means_that_an_imu_tells_no_orientation() -> None:
    columns = imu([0.0, 0.1], orientation_covariance_0_=[-1.0] * 2, orientation_covariance_8_=[0.0] * 2)
    source = heading("sensor_msgs/Imu", **columns)
    assert "REP-145" in source.problem
    assert np.isnan(source.variance).all()


@pytest.mark.parametrize("yaw", [[0.3] * 4, [0.0] * 4])
def test_an_orientation_that_never_changes_is_refused(yaw: list[float]) -> None:
    assert heading("sensor_msgs/Imu", **imu(yaw)).problem == "its orientation never changes"


def test_a_quaternion_of_zeros_or_nan_is_no_rotation() -> None:
    columns = imu([0.0, 0.1, 0.2])
    columns["orientation__w"] = np.array([np.nan, 0.0, 1e200])
    columns["orientation__z"] = np.array([0.0, 0.0, 0.0])
    source = heading("sensor_msgs/Imu", **columns)
    assert not source.usable.any()
    assert source.problem == "no valid quaternion"


@pytest.mark.parametrize("topic", ["/heading", "/gnss/heading", "/nmea/true_heading"])
def test_a_receiver_stuffs_a_compass_angle_into_the_quaternion(topic: str) -> None:
    columns = {f"quaternion__{axis}": values for axis, values in about(np.radians([30.0, 120.0])).items()}
    source = heading("geometry_msgs/QuaternionStamped", topic, **columns)
    assert source.convention == "ned"
    np.testing.assert_allclose(np.degrees(source.heading_rad("ned")), [30.0, 120.0], atol=1e-9)


@pytest.mark.parametrize("topic", ["/filter/quaternion", "/imu/orientation"])
def test_a_quaternion_of_an_inertial_unit_is_enu(topic: str) -> None:
    columns = {f"quaternion__{axis}": values for axis, values in about(np.radians([30.0, 120.0])).items()}
    assert heading("geometry_msgs/QuaternionStamped", topic, **columns).convention == "enu"


@pytest.mark.parametrize("package", ["compass_msgs", "compass_interfaces"])
@pytest.mark.parametrize("degrees", [False, True], ids=["rad", "deg"])
@pytest.mark.parametrize("ned", [False, True], ids=["enu", "ned"])
def test_an_azimuth_says_its_unit_and_orientation_itself(package: str, degrees: bool, ned: bool) -> None:
    told = np.array([10.0, 100.0]) if degrees else np.radians([10.0, 100.0])
    variance = [4.0, 0.0] if degrees else [np.radians(2.0) ** 2, 0.0]
    source = heading(
        f"{package}/Azimuth",
        azimuth=told,
        variance=variance,
        unit=[int(degrees)] * 2,
        orientation=[int(ned)] * 2,
        reference=[1, 1],
    )
    expected = [10.0, 100.0] if ned else [80.0, -10.0]
    np.testing.assert_allclose(np.degrees(source.heading_rad(source.convention)), expected, atol=1e-9)
    assert source.variance[0] == pytest.approx(math.radians(2.0) ** 2)
    assert np.isnan(source.variance[1])
    assert "geographic north" in source.why


def test_azimuths_of_both_orientations_on_one_topic_agree() -> None:
    source = heading(
        "compass_msgs/Azimuth", azimuth=[10.0, 80.0, 10.0], unit=[1] * 3, orientation=[1, 0, 1], reference=[0] * 3
    )
    np.testing.assert_allclose(np.degrees(source.heading_rad(source.convention)), [10.0] * 3, atol=1e-9)


@pytest.mark.parametrize("names", [("relPosHeading", "accHeading"), ("rel_pos_heading", "acc_heading")])
def test_relposned9_needs_a_valid_baseline_and_a_valid_heading(names: tuple[str, str]) -> None:
    flags = [256 | 4, 256, 4, 0]
    columns = {names[0]: [9_000_000, 1, 1, 1], names[1]: [50_000] * 4, "flags": flags}
    source = heading("ublox_msgs/NavRELPOSNED9", **columns)
    assert source.usable.tolist() == [True, False, False, False]
    assert source.convention == "ned"
    assert source.yaw_rad[0] == pytest.approx(np.pi / 2, abs=ROUNDING_RAD)
    assert source.variance[0] == pytest.approx(math.radians(0.5) ** 2)


@pytest.mark.parametrize("ros2", [False, True])
def test_an_older_relposned_tells_the_bearing_by_its_components(ros2: bool) -> None:
    camel = ("relPosN", "relPosE", "relPosHPN", "relPosHPE", "accN", "accE")
    snake = ("rel_pos_n", "rel_pos_e", "rel_pos_hpn", "rel_pos_hpe", "acc_n", "acc_e")
    values = ([0, 0, 100], [100, 0, 100], [0, 0, 50], [0, 0, 50], [100] * 3, [100] * 3)
    columns = dict(zip(snake if ros2 else camel, values, strict=True))
    source = heading("ublox_msgs/NavRELPOSNED", **columns, flags=[5, 5, 1])
    assert source.usable.tolist() == [True, False, False]
    np.testing.assert_allclose(np.degrees(source.yaw_rad[[0, 2]]), [90.0, 45.0], atol=1e-9)
    assert source.variance[0] == pytest.approx(0.01**2)


def test_a_septentrio_attitude_is_enu_as_the_driver_writes_it_by_default() -> None:
    source = heading(
        "septentrio_gnss_driver/AttEuler",
        heading=[90.0, -2e10, np.nan, 10.0, 10.0],
        error=[0, 0, 0, 1, 0],
        mode=[2, 2, 2, 2, 0],
    )
    assert source.usable.tolist() == [True, False, False, False, False]
    assert source.convention == "enu"
    assert "use_ros_axis_orientation" in source.convention_why
    assert source.heading_rad("enu")[0] == pytest.approx(0.0, abs=ROUNDING_RAD)
    assert source.heading_rad("ned")[0] == pytest.approx(np.pi / 2, abs=ROUNDING_RAD)


def test_an_inertial_septentrio_heading_carries_its_deviation() -> None:
    source = heading("septentrio_gnss_driver/INSNavGeod", heading=[45.0], heading_std_dev=[0.5], error=[0])
    assert source.usable.tolist() == [True]
    assert source.variance[0] == pytest.approx(math.radians(0.5) ** 2)


@pytest.mark.parametrize(
    ("name", "columns"),
    [
        (
            "novatel_gps_msgs/NovatelDualAntennaHeading",
            {"heading_sigma": [0.5] * 2, "solution_status": ["SOL_COMPUTED", "X"]},
        ),
        ("novatel_gps_msgs/NovatelHeading2", {"heading_sigma": [0.5] * 2, "solution_status": ["SOL_COMPUTED", "X"]}),
        ("novatel_oem7_msgs/HEADING2", {"heading_stdev": [0.5] * 2, "sol_status__status": [0, 1]}),
    ],
)
def test_a_dual_antenna_heading_is_clockwise_from_north(name: str, columns: dict[str, Any]) -> None:
    source = heading(name, heading=[270.0, 270.0], **columns)
    assert source.usable.tolist() == [True, False]
    assert source.heading_rad(source.convention)[0] == pytest.approx(-np.pi / 2, abs=ROUNDING_RAD)
    assert source.variance[0] == pytest.approx(math.radians(0.5) ** 2)


@pytest.mark.parametrize(
    ("name", "columns"),
    [
        ("novatel_gps_msgs/Gphdt", {"heading": [30.0]}),
        ("novatel_gps_msgs/Inspva", {"azimuth": [30.0], "status": ["INS_SOLUTION_GOOD"]}),
        ("novatel_oem7_msgs/INSPVA", {"azimuth": [30.0], "status__status": [3]}),
    ],
)
def test_a_true_heading_is_clockwise_from_north(name: str, columns: dict[str, Any]) -> None:
    source = heading(name, **columns)
    assert source.usable.all()
    assert source.heading_rad(source.convention)[0] == pytest.approx(math.radians(30.0))


def test_odometry_of_an_inertial_system_ranks_above_that_of_wheels() -> None:
    columns = {f"pose__pose__orientation__{axis}": values for axis, values in about([0.1, 0.2]).items()}
    named = heading("nav_msgs/Odometry", "/vectornav/Odom", **columns)
    assert named.score > heading("nav_msgs/Odometry", "/odom", **columns).score


# Fields and stamps


@pytest.mark.parametrize(
    ("name", "lacking"),
    [("sensor_msgs/NavSatFix", "latitude"), ("ublox_msgs/NavPVT", "lat"), ("nav_msgs/Odometry", "pose")],
)
def test_a_position_without_a_field_it_needs_is_refused_by_the_field_s_name(name: str, lacking: str) -> None:
    with pytest.raises(DefinitionError, match=f"no numeric field {lacking}"):
        position(name, other=[1.0, 2.0])


def stamped(header_ns: Any, log_ns: Any) -> TopicTable:
    header = np.asarray(header_ns)
    columns = {"header.stamp.sec": header // 10**9, "header.stamp.nanosec": header % 10**9}
    return TopicTable("/t", "t/T", np.asarray(log_ns), columns, {}, 0)


@pytest.mark.parametrize("count", [20, 300])
def test_a_first_stamp_of_zero_is_put_where_its_log_time_says(count: int) -> None:
    log_ns = START_NS + STEP_NS * np.arange(count)
    header = log_ns - 7_000_000
    header[0] = 0
    rows = stamp_rows(stamped(header, log_ns))
    assert rows.header_ns is not None
    assert rows.header_ns[0] == log_ns[0] - 7_000_000
    assert rows.delay_ns == 7_000_000


@pytest.mark.parametrize(
    ("header", "note"),
    [
        (np.zeros(100, np.int64), "100 % of the header stamps are 0"),
        (START_NS + STEP_NS * np.arange(100) - 18 * 10**9, "header stamps are +18.0 s from log time"),
        (START_NS + STEP_NS * (np.arange(100) ^ 1), "51 % of the header stamps go back"),
    ],
)
def test_header_stamps_that_are_not_sane_are_left_and_the_reason_said(header: Any, note: str) -> None:
    rows = stamp_rows(stamped(header, START_NS + STEP_NS * np.arange(100)))
    assert rows.header_ns is None
    assert rows.note == note


def test_stamps_become_increasing_and_of_equals_the_last_stays() -> None:
    rows, backwards, dropped = increasing_rows(np.array([10, 30, 20, 20, 40]))
    assert rows.tolist() == [0, 3, 1, 4]
    assert (backwards, dropped) == (1, 1)


def test_an_orientation_that_is_not_known_yet_is_left_out() -> None:
    """A moving base without a solution writes a variance of 1000; where all have one it means nothing."""
    variance = {f"orientation_covariance_{i}_": [v, v, v] for i, v in ((0, 1e-4),)}
    first = heading(
        "sensor_msgs/Imu", **imu([2.0, 0.1, 0.2]), **variance, orientation_covariance_8_=[1000.0, 1e-4, 1e-4]
    )
    assert first.usable.tolist() == [False, True, True]
    assert heading(
        "sensor_msgs/Imu", **imu([0.0, 0.1, 0.2]), **variance, orientation_covariance_8_=[1e3] * 3
    ).usable.all()
