"""Wheels as logs really hold them: joints in any order, several publishers, lists left empty, counters that wrap."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from icrtool.config import load_config
from icrtool.errors import ConfigError, DefinitionError
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.read_log import survey_log
from icrtool.logs.streams.message_types import MESSAGE_TYPES
from icrtool.logs.streams.sources import WheelSource
from icrtool.logs.streams.wheel_pairs import Side, pair_motion
from icrtool.logs.streams.wheels import Twist
from icrtool.records.samples import TWIST_TYPES, StreamChoice
from support.tables import read_source, table_of

START_NS, STEP_NS = 1_760_000_000_000_000_000, 20_000_000
CONFIG = load_config()
WHEELS = ("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel")
ARM = (
    "arm_shoulder_pan_joint",
    "arm_elbow_joint",
    "gripper_left_finger",
    "gripper_right_finger",
    "arm_wrist",
    "arm_tool",
)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)


def joint_state(
    store: Any, stamp_ns: int, names: Sequence[str], position: Sequence[float], velocity: Sequence[float]
) -> Any:
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    header = types["std_msgs/msg/Header"](*([0] if store is ROS1 else []), stamp, "")
    lists = (np.array(values, np.float64) for values in (position, velocity, []))
    return types["sensor_msgs/msg/JointState"](header, list(names), *lists)


def write_mcap(path: Path, publishers: Sequence[tuple[str, list[Any]]], name: str, store: Any = ROS2) -> Path:
    """Write each publisher's messages to a channel of its own, in the order of their stamps."""
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        text = store.generate_msgdef(name, ros_version=2)[0]
        schema = writer.register_schema(name, "ros2msg", text.encode())
        for topic, messages in publishers:
            channel = writer.register_channel(topic, "cdr", schema)
            for i, message in enumerate(messages):
                stamp_ns = START_NS + i * STEP_NS
                writer.add_message(channel, stamp_ns, bytes(store.serialize_cdr(message, name)), stamp_ns)
        writer.finish()
    return path


def write_bag(path: Path, publishers: Sequence[tuple[str, list[Any]]], name: str) -> Path:
    with Ros1Writer(path) as bag:
        for number, (topic, messages) in enumerate(publishers):
            connection = bag.add_connection(topic, name, typestore=ROS1, callerid=f"/publisher_{number}")
            for i, message in enumerate(messages):
                bag.write(connection, START_NS + i * STEP_NS, ROS1.serialize_ros1(message, name))
    return path


def column_table(message_type: str, topic: str = "/topic", **columns: Any) -> TopicTable:
    return table_of(message_type, {path.replace("__", "."): values for path, values in columns.items()}, topic)


def read(table: TopicTable, config: Any = CONFIG) -> WheelSource:
    return read_source("wheels", table, config)


def wheels_of(path: Path, *sets: str) -> WheelSource:
    return survey_log(path, load_config(sets=sets)).candidates.wheels[0]


@pytest.mark.parametrize("ros1", [False, True], ids=["mcap", "bag"])
def test_joints_are_told_apart_by_name_when_their_order_changes(tmp_path: Path, ros1: bool) -> None:
    store, rng, messages = ROS1 if ros1 else ROS2, np.random.default_rng(3), []
    position = rng.normal(size=(40, 4))
    velocity = rng.normal(size=(40, 4))
    for i in range(40):
        order = rng.permutation(4)
        names = [WHEELS[j] for j in order]
        messages.append(joint_state(store, START_NS + i * STEP_NS, names, position[i, order], velocity[i, order]))
    write = write_bag if ros1 else write_mcap
    motion = wheels_of(write(tmp_path / "log", [("/joint_states", messages)], "sensor_msgs/msg/JointState"))
    assert motion.position is not None
    assert motion.speed is not None
    np.testing.assert_array_equal(motion.position[0], position[:, [0, 2]].mean(axis=1))
    np.testing.assert_array_equal(motion.speed[1], velocity[:, [1, 3]].mean(axis=1))
    assert motion.stamps.header_ns is not None
    assert motion.stamps.header_ns.tolist() == [START_NS + i * STEP_NS for i in range(40)]


@pytest.mark.parametrize("arm_every", [1, 3], ids=["as often", "more often"])
@pytest.mark.parametrize("ros1", [False, True], ids=["mcap", "bag"])
def test_an_arm_on_the_same_topic_is_not_part_of_the_wheels(tmp_path: Path, ros1: bool, arm_every: int) -> None:
    store, rng = ROS1 if ros1 else ROS2, np.random.default_rng(4)
    count = 30
    wheels = rng.normal(size=(count, 4))
    messages = [joint_state(store, START_NS + i * STEP_NS, WHEELS, wheels[i], wheels[i] * 2) for i in range(count)]
    poses = rng.normal(size=(count * arm_every, len(ARM)))
    arm = [joint_state(store, START_NS + i * STEP_NS // 2, ARM, pose, []) for i, pose in enumerate(poses)]
    write = write_bag if ros1 else write_mcap
    publishers = [("/joint_states", arm), ("/joint_states", messages)]
    motion = wheels_of(write(tmp_path / "log", publishers, "sensor_msgs/msg/JointState"))
    assert motion.problem == ""
    assert motion.position is not None
    assert motion.speed is not None
    np.testing.assert_array_equal(motion.position[0], wheels[:, [0, 2]].mean(axis=1))
    np.testing.assert_array_equal(motion.speed[1], 2 * wheels[:, [1, 3]].mean(axis=1))
    assert len(motion.stamps.log_ns) == count


def test_axles_that_publish_apart_are_not_averaged_by_turns(tmp_path: Path) -> None:
    front = [joint_state(ROS2, START_NS + i * STEP_NS, WHEELS[:2], [i, 2.0 * i], []) for i in range(20)]
    rear = [joint_state(ROS2, START_NS + i * STEP_NS, WHEELS[2:], [i + 100.0, i + 100.0], []) for i in range(15)]
    path = write_mcap(
        tmp_path / "log.mcap", [("/joint_states", front), ("/joint_states", rear)], "sensor_msgs/msg/JointState"
    )
    motion = wheels_of(path)
    assert motion.position is not None
    assert motion.position[1].tolist() == [2.0 * i for i in range(20)]


def test_sides_in_different_messages_are_joined_by_time(tmp_path: Path) -> None:
    left = [joint_state(ROS2, START_NS + i * 50_000_000, ["left_wheel"], [i], []) for i in range(5)]
    right = [joint_state(ROS2, START_NS + i * 50_000_000, ["right_wheel"], [i], []) for i in range(5)]
    path = write_mcap(tmp_path / "log.mcap", [("/joints", left), ("/joints", right)], "sensor_msgs/msg/JointState")
    motion = wheels_of(path)
    assert not motion.problem
    assert [one.code for one in motion.notes] == ["wheels_joined"]
    assert motion.position is not None
    np.testing.assert_array_equal(motion.position, [range(5), range(5)])


@pytest.mark.parametrize("lacking", ["position", "velocity"])
def test_a_list_left_empty_is_not_told(tmp_path: Path, lacking: str) -> None:
    values = [[float(i), -float(i), 0.5 * i, -0.5 * i] for i in range(10)]
    messages = [
        joint_state(ROS2, START_NS + i * STEP_NS, WHEELS, *(([], v) if lacking == "position" else (v, [])))
        for i, v in enumerate(values)
    ]
    motion = wheels_of(write_mcap(tmp_path / "log.mcap", [("/joint_states", messages)], "sensor_msgs/msg/JointState"))
    told, untold = (motion.speed, motion.position) if lacking == "position" else (motion.position, motion.speed)
    assert untold is None
    assert told is not None
    assert told[0].tolist() == [0.75 * i for i in range(10)]


def test_a_joint_that_never_says_a_number_is_left_out_of_its_side(tmp_path: Path) -> None:
    messages = [
        joint_state(ROS2, START_NS + i * STEP_NS, WHEELS, [i, i, np.nan, np.nan if i == 4 else 3.0 * i], [])
        for i in range(6)
    ]
    motion = wheels_of(write_mcap(tmp_path / "log.mcap", [("/joint_states", messages)], "sensor_msgs/msg/JointState"))
    assert motion.position is not None
    assert motion.position is not None
    np.testing.assert_array_equal(motion.position[0], np.arange(6.0))
    np.testing.assert_array_equal(motion.position[1], [0.0, 2.0, 4.0, 6.0, np.nan, 10.0])


def test_all_nan_joints_tell_nothing(tmp_path: Path) -> None:
    messages = [joint_state(ROS2, START_NS, WHEELS, [np.nan] * 4, [np.nan] * 4) for _ in range(5)]
    motion = wheels_of(write_mcap(tmp_path / "log.mcap", [("/joint_states", messages)], "sensor_msgs/msg/JointState"))
    assert "neither position nor speed" in motion.problem


def test_configured_joints_go_before_names(tmp_path: Path) -> None:
    messages = [joint_state(ROS2, START_NS + i * STEP_NS, ["a", "b", "c"], [i, 2.0 * i, 9.0], []) for i in range(6)]
    path = write_mcap(tmp_path / "log.mcap", [("/joint_states", messages)], "sensor_msgs/msg/JointState")
    assert "no left and right wheel among its joints a, b, c" in wheels_of(path).problem
    motion = wheels_of(path, 'wheels.left_joints=["b"]', 'wheels.right_joints=["a"]')
    assert motion.position is not None
    assert motion.position[0].tolist() == [2.0 * i for i in range(6)]


@pytest.mark.parametrize(
    ("name", "bits"),
    [
        ("Int16", 16),
        ("UInt16", 16),
        ("Int32", 32),
        ("UInt32", 32),
        ("Int64", None),
        ("Float64", None),
        ("Float32", None),
    ],
)
def test_counters_are_unwrapped_at_the_width_of_their_type(tmp_path: Path, name: str, bits: int | None) -> None:
    rng = np.random.default_rng(8)
    span = 1 << (bits or 20)
    travelled = np.cumsum(rng.integers(0, span // 5, 60)) - np.cumsum(rng.integers(0, span // 9, 60))
    assert bits is None or np.ptp(travelled) > span
    lowest = 0 if name.startswith("UInt") else -(span // 2)
    wrapped = (travelled - lowest) % span + lowest if bits else travelled
    types = ROS2.types[f"std_msgs/msg/{name}"]
    kind = float if name.startswith("Float") else int
    messages = [types(kind(value)) for value in wrapped]
    publishers = [("/robot/lwheel_ticks", messages), ("/robot/rwheel_ticks", messages)]
    motion = wheels_of(write_mcap(tmp_path / "log.mcap", publishers, f"std_msgs/msg/{name}"))
    assert motion.topic == "/robot/lwheel_ticks + /robot/rwheel_ticks"
    assert motion.unit == ("unknown" if name.startswith("Float") else "counts")
    assert motion.position is not None
    for side in motion.position:
        np.testing.assert_array_equal(side - side[0], travelled - travelled[0])


def pair_tables(left: Any, right: Any, *, kinds: tuple[str, str] = ("Float64", "Float64"), topic: str = "speed") -> Any:
    return (
        column_table(f"std_msgs/{kinds[0]}", f"/left/{topic}", data=left),
        column_table(f"std_msgs/{kinds[1]}", f"/right/{topic}", data=right),
    )


def test_a_pair_is_read_only_while_both_sides_were_recorded() -> None:
    left, right = pair_tables(np.arange(100.0), np.arange(100.0), topic="angle")
    late = right.rows(np.arange(100) >= 60)
    motion = pair_motion(Side(left), Side(late), CONFIG)
    assert motion.position is not None
    assert motion.position is not None
    np.testing.assert_array_equal(motion.position[0], motion.position[1])
    assert motion.position[0].tolist() == list(range(60, 100))


def test_a_pair_of_different_integers_is_unwrapped_side_by_side() -> None:
    left, right = pair_tables([32_000, -32_000], [65_500, 66_500], kinds=("Int16", "Int32"), topic="ticks")
    motion = pair_motion(Side(left), Side(right), CONFIG)
    assert motion.message_type == "std_msgs/Int16 + std_msgs/Int32"
    assert motion.position is not None
    assert motion.position is not None
    assert np.diff(motion.position[0]) == 1536
    assert np.diff(motion.position[1]) == 1000


def test_a_side_without_messages_is_refused_in_words() -> None:
    left, right = pair_tables([1.0, 2.0], [1.0, 2.0])
    nothing = TopicTable(right.topic, right.message_type, np.empty(0, np.int64), {}, {}, 0)
    assert pair_motion(Side(left), Side(nothing), CONFIG).problem == "/right/speed holds no message"
    never = pair_motion(Side(left), Side(right.rows(np.array([True, False]))), CONFIG)
    assert never.problem == ""
    gone = TopicTable(right.topic, right.message_type, right.log_time_ns + 10**12, right.columns, {}, 0)
    assert pair_motion(Side(left), Side(gone), CONFIG).problem == "the two sides were not recorded at the same time"


def test_the_second_message_of_a_cycle_belongs_to_the_first() -> None:
    left, right = pair_tables([1.0, 2.0, 3.0], [10.0, 20.0, 30.0])
    shifted = TopicTable(right.topic, right.message_type, right.log_time_ns + 3_000_000, right.columns, {}, 0)
    motion = pair_motion(Side(left), Side(shifted), CONFIG)
    assert motion.speed is not None
    assert motion.speed[1].tolist() == [10.0, 20.0, 30.0]


def drivers(package: str) -> TopicTable:
    travel, velocity = np.array([[1.0, 2.0], [3.0, 5.0]]), np.array([[0.1, 0.2], [0.3, 0.5]])
    columns = {"drivers[*].measured_travel": travel, "drivers[*].measured_velocity": velocity}
    return table_of(f"{package}/Feedback", columns)


@pytest.mark.parametrize("package", ["jackal_msgs", "clearpath_platform_msgs"])
def test_driver_0_is_left_and_driver_1_is_right(package: str) -> None:
    motion = read(drivers(package))
    assert motion.position is not None
    assert motion.speed is not None
    assert motion.position[0].tolist() == [1.0, 3.0]
    assert motion.speed[1].tolist() == [0.2, 0.5]
    assert motion.unit == "rad"


def test_four_wheels_of_a_leo_are_front_and_rear_left_then_right() -> None:
    columns = {"position[*]": np.array([[1.0, 3.0, 5.0, 9.0]] * 2), "velocity[*]": np.array([[1.0, 2.0, 3.0, 4.0]] * 2)}
    motion = read(table_of("leo_msgs/WheelStates", columns))
    assert motion.position is not None
    assert motion.position is not None
    assert (motion.position[0][0], motion.position[1][0]) == (2.0, 7.0)


def test_a_segway_tells_metres() -> None:
    columns = {
        f"segway.{side}_wheel_{what}": np.array([1.0, 2.0]) * factor
        for side, factor in (("left", 1), ("right", 3))
        for what in ("velocity", "displacement")
    }
    for name in ("segway_rmp/SegwayStatusStamped", "segway_rmp_ros2/SegwayStatusStamped", "segway_interfaces/Stamped"):
        motion = read(table_of(name, columns))
        assert motion.unit == "m"
        assert motion.position is not None
        assert motion.position[1].tolist() == [3.0, 6.0]


def feedback_with_names(message_type: str, names: str, velocity: str, travel: str) -> TopicTable:
    columns: dict[str, Any] = {
        names: np.array([[0, 1], [1, 0]]),
        travel: np.array([[1.0, 2.0], [20.0, 10.0]]),
        velocity: np.array([[0.1, 0.2], [2.0, 1.0]]),
    }
    texts = {names: ["front_left_wheel_joint", "front_right_wheel_joint"]}
    return TopicTable("/a/feedback", message_type, START_NS + np.arange(2), columns, texts, 0)


@pytest.mark.parametrize(
    ("message_type", "names", "velocity", "travel"),
    [
        ("clearpath_motor_msgs/LynxMultiFeedback", "drivers[*].joint_name", "drivers[*].velocity", "drivers[*].travel"),
        *(
            (name, *(f"drivers_feedback[*].{field}" for field in ("device_name", "speed", "travel")))
            for name in ("clearpath_motor_msgs/PumaMultiFeedback", "puma_motor_msgs/MultiFeedback")
        ),
    ],
)
def test_motor_drivers_are_told_apart_by_their_joint(message_type: str, names: str, velocity: str, travel: str) -> None:
    motion = read(feedback_with_names(message_type, names, velocity, travel))
    assert motion.position is not None
    assert motion.speed is not None
    assert motion.position[0].tolist() == [1.0, 10.0]
    assert motion.speed[1].tolist() == [0.2, 2.0]


def twist_table(message_type: str, topic: str, prefix: str, x: Any, y: Any, turn: Any) -> TopicTable:
    columns = {f"{prefix}linear.x": np.array(x), f"{prefix}linear.y": np.array(y), f"{prefix}angular.z": np.array(turn)}
    return table_of(message_type, columns, topic)


@pytest.mark.parametrize(
    ("topic", "problem"),
    [("/vel", "moves sideways and never turns"), ("/gps/vel", "moves sideways"), ("/fix_velocity", "moves sideways")],
)
def test_a_velocity_east_and_north_is_not_taken_for_the_body(topic: str, problem: str) -> None:
    table = twist_table("geometry_msgs/TwistStamped", topic, "twist.", [1.0, 0.5], [0.5, 1.0], [0.0, 0.0])
    assert problem in read(table).problem


def test_a_reference_s_twist_is_not_the_wheels() -> None:
    table = twist_table("nav_msgs/Odometry", "/icp_odom", "twist.twist.", [1.0, 0.5], [0.0, 0.0], [0.1, 0.0])
    assert "reference" in read(table).problem


def test_the_turn_rate_of_a_twist_is_counter_clockwise_and_commands_rank_low() -> None:
    measured = read(twist_table("geometry_msgs/TwistStamped", "/twist", "twist.", [1.0], [0.0], [0.4]))
    commanded = read(twist_table("geometry_msgs/TwistStamped", "/cmd_vel_out", "twist.", [1.0], [0.0], [0.4]))
    assert measured.twist is not None
    assert measured.twist.tolist() == [[1.0, 0.4]]
    assert commanded.score < measured.score
    assert "(commanded)" in commanded.why


def test_wheels_that_stand_still_all_the_time_rank_last() -> None:
    moving = read(twist_table("nav_msgs/Odometry", "/odom", "twist.twist.", [1.0], [0.0], [0.4]))
    still = read(twist_table("nav_msgs/Odometry", "/odom", "twist.twist.", [0.0], [0.0], [0.0]))
    assert still.score < moving.score - 50
    assert still.why.endswith("never moves")


def test_more_elements_than_a_list_is_expected_to_hold_are_all_read(tmp_path: Path) -> None:
    names = [f"{side}_wheel_{i}" for i in range(150) for side in ("left", "right")]
    messages = [joint_state(ROS2, START_NS + i * STEP_NS, names[: 200 + i], np.arange(200.0 + i), []) for i in range(4)]
    path = write_mcap(tmp_path / "log.mcap", [("/joint_states", messages)], "sensor_msgs/msg/JointState")
    with mock.patch("icrtool.logs.streams.select.drop_used_columns"):
        (table,) = survey_log(path).tables
    assert table.columns["position[*]"].shape == (4, 203)
    assert table.columns["position[*]"][3].tolist() == list(range(203))


def test_publishers_of_different_versions_of_a_type_are_joined(tmp_path: Path) -> None:
    """Two nodes of a ROS 1 robot may have been built a year apart."""
    name, old, new = "scout_msgs/msg/ScoutStatus", get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS1_NOETIC)
    fields = "std_msgs/Header header\nfloat64 linear_velocity\nfloat64 angular_velocity\n"
    old.register(get_types_from_msg(fields, name))
    new.register(get_types_from_msg(f"{fields}float64 lateral_velocity\n", name))
    header = old.types["std_msgs/msg/Header"](0, old.types["builtin_interfaces/msg/Time"](0, 0), "")
    with Ros1Writer(tmp_path / "log.bag") as bag:
        for store, more in ((new, [0.0]), (old, [])):
            connection = bag.add_connection("/scout_status", name, typestore=store, callerid=f"/{len(more)}")
            for i in range(3):
                raw = store.serialize_ros1(store.types[name](header, 1.0 + i, 0.1, *more), name)
                bag.write(connection, START_NS + i, raw)
    motion = wheels_of(tmp_path / "log.bag")
    assert motion.twist is not None
    assert motion.twist[:, 0].tolist() == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]


def test_a_configured_topic_that_tells_nothing_is_an_error(tmp_path: Path) -> None:
    from icrtool.logs.read_log import read_log

    messages = [joint_state(ROS2, START_NS, ["a", "b"], [1.0, 2.0], []) for _ in range(3)]
    path = write_mcap(tmp_path / "log.mcap", [("/joint_states", messages)], "sensor_msgs/msg/JointState")
    with pytest.raises(ConfigError, match=r"topics\.wheels: /joint_states: no left and right wheel"):
        read_log(path, load_config(sets=["topics.wheels=/joint_states"]))


def ticks(**columns: Any) -> TopicTable:
    zeros = [0] * 4
    known = {"wheel_tick_factor": [200] * 4, "valid_wheels": zeros}
    known |= {f"wheel_{what}_{place}": zeros for what in ("ticks", "direction") for place in ("fl", "fr", "rl", "rr")}
    return column_table("xbot_msgs/WheelTick", **{**known, **columns})


@pytest.mark.parametrize("valid", [0, 12, 4 | 8 | 1], ids=["not stated", "rear", "rear and one in front"])
def test_ticks_count_up_and_the_direction_beside_them_gives_the_sign(valid: int) -> None:
    columns = {"wheel_ticks_rl": [0, 100, 150, 170], "wheel_direction_rl": [0, 0, 1, 0]}
    motion = read(ticks(**columns, wheel_ticks_rr=[2**32 - 50, 50, 250, 250], valid_wheels=[valid] * 4))
    assert motion.position is not None
    assert motion.unit == "m"
    np.testing.assert_allclose(motion.position[0], [0.0, 0.5, 0.25, 0.35])
    np.testing.assert_allclose(motion.position[1], [0.0, 0.5, 1.5, 1.5])


def test_ticks_of_four_wheels_are_the_mean_of_each_side() -> None:
    columns = {
        "wheel_ticks_rl": [0, 100, 200, 300],
        "wheel_ticks_fl": [7, 127, 247, 367],
        "wheel_ticks_rr": [0, 1, 2, 3],
    }
    motion = read(ticks(**columns, valid_wheels=[15] * 4, wheel_tick_factor=[0] * 4))
    assert motion.position is not None
    assert motion.unit == "counts"
    np.testing.assert_allclose(motion.position[0], [0.0, 110.0, 220.0, 330.0])
    np.testing.assert_allclose(motion.position[1], [0.0, 0.5, 1.0, 1.5])


def test_an_autopilot_s_wheels_are_metres_or_rpm_as_the_topic_states() -> None:
    kind, values = "mavros_msgs/WheelOdomStamped", {"data[*]": [[0.0, 30.0], [1.0, 60.0], [2.0, 60.0]]}
    distance = read(column_table(kind, "/mavros/wheel_odometry/distance", **values))
    rpm = read(column_table(kind, "/mavros/wheel_odometry/rpm", **values))
    assert (distance.unit, rpm.unit) == ("m", "rad")
    assert distance.position is not None
    assert rpm.speed is not None
    assert distance.position[1].tolist() == [30.0, 60.0, 60.0]
    np.testing.assert_allclose(rpm.speed[1], [np.pi, 2 * np.pi, 2 * np.pi])
    with pytest.raises(DefinitionError, match="fewer than 2 elements"):
        read(column_table(kind, **{"data[*]": [[1.0]]}))


def test_wheels_are_made_of_a_twist_by_the_meaning_of_their_type_not_by_words_in_its_name() -> None:
    assert {name for name, row in MESSAGE_TYPES["wheels"].items() if isinstance(row, Twist)} == TWIST_TYPES

    def stream(topic: str, message_type: str) -> StreamChoice:
        return StreamChoice("wheels", topic, message_type, 100, 50.0, "header", 0.0, "")

    assert stream("/cmd_vel", "geometry_msgs/Twist").is_twist
    assert not stream("/base.left_ticks + /base.right_ticks", "made_msgs/WheelOdometry").is_twist
    assert not stream("/left.linear.x + /right.linear.x", "geometry_msgs/Twist").is_twist
