"""`write_log` against other people's readers: rosbags for ROS 1 bags and sqlite3 directories, mcap's own for MCAP."""

from __future__ import annotations

import itertools
import sqlite3
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.errors import ConfigError, OutputError
from icrtool.logs import write_log as writing_log
from icrtool.logs.messages.definitions import bundled_definitions, standard_definitions
from icrtool.logs.read_log import read_log
from icrtool.logs.write_log import SensorColumns, WriteOptions, load_typestore, topic_plans, write_log

START_NS = 1_760_000_000_000_000_000
RADIUS_M = 0.27
TRACK_WIDTH_M = 0.61
COUNTS_PER_REV = 8192.0
WHEELS = ("joint_states", "odometry", "float64_pair", "ticks", "jackal_feedback", "twist_stamped")
OPTIONS = WriteOptions(wheel_radius_m=RADIUS_M, track_width_m=TRACK_WIDTH_M, counts_per_rev=COUNTS_PER_REV)
EMPTY_INTS = np.zeros(0, dtype=np.int64)
EMPTY_FLOATS = np.zeros(0)


@dataclass(frozen=True)
class Recorded:
    """A message as a reader gave it back."""

    topic: str
    message_type: str
    log_time_ns: int
    message: Any


def make_columns(seed: int = 7, wheels: int = 40, fixes: int = 9, headings: int = 35) -> SensorColumns:
    rng = np.random.default_rng(seed)
    std = rng.uniform(0.01, 0.3, fixes)
    std[3:4] = np.nan
    return SensorColumns(
        wheel_stamp_ns=START_NS + np.arange(wheels) * 10_000_001,
        wheel_position_left_m=rng.normal(0, 50, wheels),
        wheel_position_right_m=rng.normal(0, 50, wheels),
        wheel_v_left_mps=rng.normal(0, 1, wheels),
        wheel_v_right_mps=rng.normal(0, 1, wheels),
        gnss_stamp_ns=START_NS + np.arange(fixes) * 50_000_003,
        latitude_deg=rng.uniform(-80, 80, fixes),
        longitude_deg=rng.uniform(-180, 180, fixes),
        height_m=rng.uniform(-100, 3000, fixes),
        gnss_std_m=std,
        gnss_status=rng.integers(-1, 3, fixes),
        heading_stamp_ns=START_NS + np.arange(headings) * 10_000_001,
        heading_rad=rng.uniform(-np.pi, np.pi, headings),
        yaw_rate_radps=rng.normal(0, 1, headings),
    )


def log_name(options: WriteOptions) -> str:
    return {"mcap": "drive.mcap", "bag": "drive.bag", "db3": "drive"}[options.container]


def read_back(path: Path) -> list[Recorded]:
    if path.suffix == ".mcap":
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory

        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            return [
                Recorded(channel.topic, schema.name, message.log_time, decoded)
                for schema, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False)
            ]
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        return [
            Recorded(connection.topic, connection.msgtype, stamp_ns, reader.deserialize(raw, connection.msgtype))
            for connection, stamp_ns, raw in reader.messages()
        ]


def on_topic(messages: list[Recorded], topic: str) -> list[Any]:
    return [recorded.message for recorded in messages if recorded.topic == topic]


def stamps_of(messages: list[Recorded], topic: str) -> list[int]:
    return [recorded.log_time_ns for recorded in messages if recorded.topic == topic]


def column(messages: list[Any], pick: Any) -> np.ndarray:
    return np.array([pick(message) for message in messages])


def header_stamps(messages: list[Any]) -> list[int]:
    # ROS 1 readers and ROS 2 readers name the parts of a time differently only in old versions; these are both new.
    return [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in messages]


def check_wheels(messages: list[Recorded], columns: SensorColumns, wheels: str) -> None:
    left, right = columns.wheel_v_left_mps, columns.wheel_v_right_mps
    travel_left, travel_right = columns.wheel_position_left_m, columns.wheel_position_right_m
    if wheels in ("float64_pair", "ticks"):
        left_topic, right_topic = {
            "float64_pair": ("/left_drive/velocity", "/right_drive/velocity"),
            "ticks": ("/lwheel_ticks", "/rwheel_ticks"),
        }[wheels]
        counts = COUNTS_PER_REV / (2 * np.pi * RADIUS_M)
        expected = (
            (left, right)
            if wheels == "float64_pair"
            else (np.rint(travel_left * counts), np.rint(travel_right * counts))
        )
        for topic, values in zip((left_topic, right_topic), expected, strict=True):
            assert stamps_of(messages, topic) == columns.wheel_stamp_ns.tolist()
            np.testing.assert_array_equal(column(on_topic(messages, topic), lambda m: m.data), values)
        return
    topic = {
        "joint_states": "/joint_states",
        "odometry": "/wheel_controller/odom",
        "jackal_feedback": "/feedback",
        "twist_stamped": "/wheel_controller/twist",
    }[wheels]
    found = on_topic(messages, topic)
    assert header_stamps(found) == columns.wheel_stamp_ns.tolist()
    if wheels == "joint_states":
        assert all(
            list(m.name)
            == ["front_left_wheel_joint", "front_right_wheel_joint", "rear_left_wheel_joint", "rear_right_wheel_joint"]
            for m in found
        )
        travels = np.column_stack([travel_left, travel_right, travel_left, travel_right]) / RADIUS_M
        speeds = np.column_stack([left, right, left, right]) / RADIUS_M
        np.testing.assert_array_equal(column(found, lambda m: list(m.position)), travels)
        np.testing.assert_array_equal(column(found, lambda m: list(m.velocity)), speeds)
        assert all(len(m.effort) == 0 for m in found)
    elif wheels == "jackal_feedback":
        for driver, travel, speed in ((0, travel_left, left), (1, travel_right, right)):
            reported = column(found, lambda m, d=driver: (m.drivers[d].measured_travel, m.drivers[d].measured_velocity))
            np.testing.assert_array_equal(np.float32(reported[:, 0]), np.float32(travel / RADIUS_M))
            np.testing.assert_array_equal(np.float32(reported[:, 1]), np.float32(speed / RADIUS_M))
    else:
        twists = [m.twist.twist if wheels == "odometry" else m.twist for m in found]
        np.testing.assert_array_equal(column(twists, lambda t: t.linear.x), (left + right) / 2)
        np.testing.assert_array_equal(column(twists, lambda t: t.angular.z), (right - left) / TRACK_WIDTH_M)
        assert all(t.linear.y == 0 for t in twists)


def check_position(messages: list[Recorded], columns: SensorColumns) -> None:
    found = on_topic(messages, "/gps/fix")
    assert header_stamps(found) == columns.gnss_stamp_ns.tolist()
    np.testing.assert_array_equal(column(found, lambda m: m.latitude), columns.latitude_deg)
    np.testing.assert_array_equal(column(found, lambda m: m.longitude), columns.longitude_deg)
    np.testing.assert_array_equal(column(found, lambda m: m.altitude), columns.height_m)
    np.testing.assert_array_equal(column(found, lambda m: m.status.status), columns.gnss_status)
    known = np.isfinite(columns.gnss_std_m)
    variance = np.where(known, columns.gnss_std_m**2, 0.0)
    diagonal = np.column_stack([variance, variance, 4 * variance])
    covariance = column(found, lambda m: list(m.position_covariance))
    np.testing.assert_allclose(covariance[:, [0, 4, 8]], diagonal, rtol=1e-15)
    np.testing.assert_array_equal(covariance[:, [1, 2, 3, 5, 6, 7]], 0)
    np.testing.assert_array_equal(column(found, lambda m: m.position_covariance_type), np.where(known, 2, 0))


def check_heading(messages: list[Recorded], columns: SensorColumns, convention: str) -> None:
    found = on_topic(messages, "/imu/data")
    assert header_stamps(found) == columns.heading_stamp_ns.tolist()
    assert {m.header.frame_id for m in found} == {"imu_link" if convention == "enu" else "imu_link_ned"}
    x, y, z, w = column(found, lambda m: (m.orientation.x, m.orientation.y, m.orientation.z, m.orientation.w)).T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    heading = np.pi / 2 - yaw if convention == "enu" else yaw
    error = np.angle(np.exp(1j * (heading - columns.heading_rad)))
    np.testing.assert_allclose(error, 0, atol=1e-14)  # rad; rounding of two trigonometric functions
    rate = column(found, lambda m: m.angular_velocity.z)
    np.testing.assert_array_equal(rate, -columns.yaw_rate_radps if convention == "enu" else columns.yaw_rate_radps)
    np.testing.assert_allclose(found[0].orientation_covariance[8], np.radians(1.0) ** 2, rtol=1e-15)


@pytest.mark.parametrize(
    ("container", "wheels", "heading"), list(itertools.product(("mcap", "bag", "db3"), WHEELS, ("enu", "ned")))
)
def test_other_readers_find_every_value_in_time_order(tmp_path, container, wheels, heading):
    columns = make_columns()
    options = replace(OPTIONS, container=container, wheels=wheels, heading=heading)
    path = tmp_path / log_name(options)

    assert write_log(path, columns, options) == path

    messages = read_back(path)
    check_wheels(messages, columns, wheels)
    check_position(messages, columns)
    check_heading(messages, columns, heading)
    times = [recorded.log_time_ns for recorded in messages]
    assert times == sorted(times)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("container", "compression"),
    [("mcap", "lz4"), ("mcap", "zstd"), ("bag", "bz2"), ("bag", "lz4"), ("db3", "zstd"), ("db3", "zstd-file")],
)
def test_compression_changes_no_value(tmp_path, container, compression):
    columns = make_columns()
    options = replace(OPTIONS, container=container, compression=compression)
    path = write_log(tmp_path / log_name(options), columns, options)
    messages = read_back(path)
    check_wheels(messages, columns, "joint_states")
    check_position(messages, columns)
    check_heading(messages, columns, "enu")


def test_a_message_is_what_rosbags_itself_would_serialise(tmp_path):
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    path = write_log(tmp_path / "drive", make_columns(), replace(OPTIONS, container="db3"))
    with Reader(path) as reader:
        for connection, _, raw in reader.messages():
            again = store.serialize_cdr(store.deserialize_cdr(raw, connection.msgtype), connection.msgtype)
            assert bytes(again) == bytes(raw)


def test_messages_with_equal_stamps_come_as_wheels_position_heading(tmp_path):
    path = write_log(tmp_path / "drive.mcap", make_columns(), OPTIONS)
    first = [recorded.topic for recorded in read_back(path) if recorded.log_time_ns == START_NS]
    assert first == ["/joint_states", "/gps/fix", "/imu/data"]


def test_stamps_out_of_order_are_written_in_order(tmp_path):
    columns = make_columns()
    shuffled = replace(columns, heading_stamp_ns=columns.heading_stamp_ns[::-1].copy())
    messages = read_back(write_log(tmp_path / "drive.mcap", shuffled, OPTIONS))
    times = [recorded.log_time_ns for recorded in messages]
    assert times == sorted(times)
    z = column(on_topic(messages, "/imu/data"), lambda m: m.angular_velocity.z)
    np.testing.assert_array_equal(z, -shuffled.yaw_rate_radps[::-1])


def test_ticks_wrap_around_at_32_bits(tmp_path):
    rollover_m = 2**31 / (COUNTS_PER_REV / (2 * np.pi * RADIUS_M))
    columns = replace(make_columns(wheels=2), wheel_position_left_m=np.array([rollover_m - 1e-6, rollover_m + 1.0]))
    messages = read_back(write_log(tmp_path / "drive.mcap", columns, replace(OPTIONS, wheels="ticks")))
    counts = [m.data for m in on_topic(messages, "/lwheel_ticks")]
    per_metre = COUNTS_PER_REV / (2 * np.pi * RADIUS_M)
    assert counts[0] == -(2**31)
    assert counts[1] == round((rollover_m + 1.0) * per_metre) - 2**32


@pytest.mark.parametrize("container", ["mcap", "bag", "db3"])
def test_a_sensor_without_rows_has_no_topic(tmp_path, container):
    columns = replace(
        make_columns(),
        gnss_stamp_ns=EMPTY_INTS,
        latitude_deg=EMPTY_FLOATS,
        longitude_deg=EMPTY_FLOATS,
        height_m=EMPTY_FLOATS,
        gnss_std_m=EMPTY_FLOATS,
        gnss_status=EMPTY_INTS,
    )
    options = replace(OPTIONS, container=container)
    messages = read_back(write_log(tmp_path / log_name(options), columns, options))
    assert {recorded.topic for recorded in messages} == {"/joint_states", "/imu/data"}


@pytest.mark.parametrize("container", ["mcap", "bag", "db3"])
def test_the_same_columns_make_the_same_bytes(tmp_path, container):
    options = replace(OPTIONS, container=container)
    contents = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        path = write_log(tmp_path / folder / log_name(options), make_columns(), options)
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        contents.append([file.read_bytes() for file in files])
    assert contents[0] == contents[1]


@pytest.mark.parametrize("container", ["mcap", "bag", "db3"])
@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), sqlite3.OperationalError("disk is full")])
def test_a_disk_that_fills_up_leaves_nothing_behind(tmp_path, monkeypatch, container, failure):
    whole = writing_log._in_time_order

    def broken_after_ten(topics):
        yield from itertools.islice(whole(topics), 10)
        raise failure

    monkeypatch.setattr(writing_log, "_in_time_order", broken_after_ten)
    options = replace(OPTIONS, container=container)
    with pytest.raises(OutputError, match=r"cannot be written; (No space left on device|disk is full)"):
        write_log(tmp_path / log_name(options), make_columns(), options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("container", ["mcap", "bag", "db3"])
def test_what_exists_is_left_as_it_is(tmp_path, container):
    options = replace(OPTIONS, container=container)
    path = tmp_path / log_name(options)
    path.write_bytes(b"precious")
    with pytest.raises(OutputError, match="exists already; remove it or choose another name"):
        write_log(path, make_columns(), options)
    assert path.read_bytes() == b"precious"


def test_a_folder_that_does_not_exist_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match="cannot be written; No such file or directory"):
        write_log(tmp_path / "missing" / "drive.mcap", make_columns(), OPTIONS)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            {"container": "bag", "compression": "zstd"},
            "compression: zstd does not exist in a bag log; choose none, bz2, lz4",
        ),
        (
            {"container": "mcap", "compression": "bz2"},
            "compression: bz2 does not exist in a mcap log; choose none, lz4, zstd",
        ),
        ({"wheel_radius_m": 0.0}, "wheel_radius_m: 0.0 is not a positive number"),
        ({"track_width_m": float("nan")}, "track_width_m: nan is not a positive number"),
    ],
)
def test_impossible_options_say_what_is_possible(change, line):
    with pytest.raises(ConfigError) as caught:
        replace(OPTIONS, **change)
    assert str(caught.value).startswith(line)


def test_columns_of_one_sensor_have_one_length():
    with pytest.raises(ValueError, match=r"SensorColumns.height_m has shape \(3,\), its stamps \(9,\)"):
        replace(make_columns(), height_m=np.zeros(3))


@pytest.mark.parametrize("wheels", WHEELS)
def test_ros_2_types_are_those_a_log_without_definitions_is_read_with(wheels):
    store, known = load_typestore(ros1=False), {**standard_definitions(), **bundled_definitions()}
    types = {plan.message_type for plan in topic_plans(make_columns(), replace(OPTIONS, wheels=wheels))}
    assert {name: store.fielddefs[name][1] for name in types} == {name: known[name][1] for name in types}


def test_the_ros_1_feedback_of_a_jackal_has_two_more_fields():
    """Of jackal_msgs as docs.ros.org prints it for ROS 1; the ROS 2 form lacks the temperatures."""
    of_ros1, of_ros2 = (
        [name for name, _ in load_typestore(ros1=ros1).fielddefs["jackal_msgs/msg/Feedback"][1]]
        for ros1 in (True, False)
    )
    assert [name for name in of_ros1 if name not in of_ros2] == ["pcb_temperature", "mcu_temperature"]


def test_jackal_feedback_is_read_back(tmp_path):
    columns = make_columns()
    options = replace(OPTIONS, container="db3", wheels="jackal_feedback")
    config = load_config(sets=[f"robot.wheel_radius_m={RADIUS_M}", "wheels.quantity=velocity"])
    log = read_log(write_log(tmp_path / "drive", columns, options), config)
    assert log.wheels.unit == "rad"
    np.testing.assert_allclose(log.wheels.left * RADIUS_M, columns.wheel_v_left_mps, rtol=1e-6)
    np.testing.assert_allclose(log.wheels.right * RADIUS_M, columns.wheel_v_right_mps, rtol=1e-6)
