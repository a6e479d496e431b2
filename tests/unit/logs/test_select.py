"""Which topic feeds which role, among the many that could; and what is said when none can."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.errors import ConfigError, MissingStreamError
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.assembly import Survey, assemble, common_clock
from icrtool.logs.streams.select import (
    Candidates,
    Choice,
    choose_streams,
    find_candidates,
    ignored_joints,
    other_references,
    wanted_fields,
)
from icrtool.logs.streams.sources import StampedRows
from icrtool.records.text import LogText

COUNT = 50
START_NS, STEP_NS = 1_760_000_000_000_000_000, 50_000_000
TIMES = START_NS + STEP_NS * np.arange(COUNT)
WAVE = np.sin(np.linspace(0.0, 6.0, COUNT))
FRAME = "header.frame_id"


def table(topic: str, message_type: str, texts: dict[str, list[str]] | None = None, **columns: Any) -> TopicTable:
    arrays = {path.replace("__", "."): np.asarray(values) for path, values in columns.items()}
    for path, found in (texts or {}).items():
        codes = np.tile(np.arange(len(found)), (COUNT, 1))
        arrays.setdefault(path, codes if "[*]" in path else codes[:, 0])
    return TopicTable(topic, message_type, TIMES, arrays, texts or {}, 0)


def joints(
    topic: str = "/joint_states", *, names: Sequence[str] = ("left_wheel", "right_wheel"), scale: float = 1.0
) -> TopicTable:
    values = np.column_stack([WAVE * scale] * len(names))
    found = table(topic, "sensor_msgs/JointState", {"name[*]": list(names)})
    return TopicTable(topic, found.message_type, TIMES, {**found.columns, "velocity[*]": values}, found.texts, 0)


def orientation(prefix: str = "orientation") -> dict[str, Any]:
    still = np.zeros(COUNT)
    return {f"{prefix}__x": still, f"{prefix}__y": still, f"{prefix}__z": np.sin(WAVE), f"{prefix}__w": np.cos(WAVE)}


def imu(topic: str = "/imu/data", **more: Any) -> TopicTable:
    return table(topic, "sensor_msgs/Imu", **orientation(), **more)


def fix(topic: str = "/gps/fix", std_m: float = 0.02) -> TopicTable:
    covariance = {f"position_covariance[{i}]": np.full(COUNT, v) for i, v in ((0, std_m**2), (1, 0.0), (4, std_m**2))}
    found = table(
        topic, "sensor_msgs/NavSatFix", status__status=np.zeros(COUNT), latitude=48.0 + WAVE * 1e-4,
        longitude=11.0 + WAVE * 1e-4, altitude=np.full(COUNT, 500.0), position_covariance_type=np.full(COUNT, 2),
    )  # fmt: skip
    return TopicTable(topic, found.message_type, TIMES, found.columns | covariance, {}, 0)


def odometry(topic: str = "/odom", frame: str = "odom") -> TopicTable:
    return table(
        topic, "nav_msgs/Odometry", {FRAME: [frame]}, pose__pose__position__x=WAVE, pose__pose__position__y=WAVE,
        twist__twist__linear__x=WAVE, twist__twist__linear__y=np.zeros(COUNT), twist__twist__angular__z=WAVE,
        **orientation("pose__pose__orientation"),
    )  # fmt: skip


def twist(topic: str = "/cmd_vel", *, turn: float = 1.0) -> TopicTable:
    columns = {"linear__x": WAVE, "linear__y": np.zeros(COUNT), "angular__z": turn * WAVE}
    return table(topic, "geometry_msgs/Twist", **columns)


def twist_stamped(topic: str, sideways: float = 0.0, turn: float = 1.0) -> TopicTable:
    columns = {"twist__linear__x": WAVE, "twist__linear__y": sideways * WAVE, "twist__angular__z": turn * WAVE}
    return table(topic, "geometry_msgs/TwistStamped", **columns)


def pose(topic: str = "/icp_pose") -> TopicTable:
    places = {"pose__position__x": WAVE, "pose__position__y": WAVE}
    return table(topic, "geometry_msgs/PoseStamped", **places, **orientation("pose__orientation"))


def side(topic: str, kind: str = "Float64") -> TopicTable:
    return table(topic, f"std_msgs/{kind}", data=WAVE if kind.startswith("Float") else (WAVE * 100).astype(np.int64))


def channels_of(tables: Sequence[TopicTable]) -> list[Channel]:
    return [Channel(i, each.topic, each.message_type, "cdr") for i, each in enumerate(tables)]


def find(tables: Sequence[TopicTable], *sets: str) -> Candidates:
    """Read the tables that `wanted_fields` asks for, as reading a log does."""
    config = load_config(sets=sets)
    wanted = wanted_fields(channels_of(tables), config)
    read = [replace(each, columns=dict(each.columns)) for i, each in enumerate(tables) if i in wanted]
    return find_candidates(read, config, {})


def choose(tables: Sequence[TopicTable], *sets: str) -> Choice:
    return choose_streams(find(tables, *sets), load_config(sets=sets), "drive.bag", channels_of(tables))


def topics_of(choice: Choice) -> tuple[str, str, str]:
    return choice.wheels.topic, choice.gnss.topic, choice.heading.topic


def test_each_role_finds_its_topic() -> None:
    choice = choose([joints(), fix(), imu()])
    assert topics_of(choice) == ("/joint_states", "/gps/fix", "/imu/data")
    assert choice.wheels.why == "wheel joints by name: left left_wheel, right right_wheel"
    assert "±0.02 m" in choice.gnss.why


def test_joints_go_before_odometry_before_commands_and_the_others_are_named() -> None:
    rest = [fix(), imu()]
    assert choose([twist(), odometry(), joints(), *rest]).wheels.topic == "/joint_states"
    assert choose([twist(), odometry(), *rest]).wheels.topic == "/odom"
    choice = choose([twist(), odometry(), joints(), *rest])
    assert choice.wheels.why.endswith("chosen over /odom, /cmd_vel")
    commanded = choose([twist(), *rest])
    assert commanded.wheels.topic == "/cmd_vel"
    assert "(commanded)" in commanded.wheels.why
    assert [one.code for one in commanded.wheels.notes] == ["wheels_commanded"]


def test_a_measured_twist_goes_before_a_commanded_one() -> None:
    assert (
        choose([twist_stamped("/cmd_vel_out"), twist_stamped("/base/twist"), fix(), imu()]).wheels.topic
        == "/base/twist"
    )
    assert choose([side("/left/cmd_speed"), side("/right/cmd_speed"), odometry(), fix(), imu()]).wheels.topic == "/odom"


def test_a_pair_of_topics_goes_before_odometry() -> None:
    choice = choose([side("/right_drive/velocity"), odometry(), side("/left_drive/velocity"), fix(), imu()])
    assert choice.wheels.topic == "/left_drive/velocity + /right_drive/velocity"


WHEELS = ("front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel")


@pytest.mark.parametrize("other", [[], [odometry()]], ids=["alone", "beside odometry"])
def test_a_configured_joint_that_no_message_lists_is_refused_by_name(other: list[TopicTable]) -> None:
    base = [joints(names=WHEELS), *other, fix(), imu()]
    with pytest.raises(ConfigError) as caught:
        choose(base, 'wheels.left_joints=["front_left_wheel", "rear_lft"]')
    expected = "wheels.left_joints: no message of /joint_states lists a joint rear_lft; its joints are "
    assert str(caught.value) == expected + ", ".join(WHEELS)
    with pytest.raises(ConfigError, match=r"wheels.right_joints: no message of /joint_states lists a joint r"):
        choose(base, 'wheels.right_joints=["r"]')


def test_configured_joints_are_looked_for_in_the_topic_that_is_used_alone() -> None:
    base = [joints("/wheels", names=WHEELS), joints("/arm", names=("l", "r", "m")), fix(), imu()]
    assert choose(base, 'wheels.left_joints=["l", "m"]', 'wheels.right_joints=["r"]').wheels.topic == "/arm"
    with pytest.raises(ConfigError, match="no message of /arm lists a joint n; its joints are l, r, m"):
        choose(base, 'wheels.left_joints=["l", "n"]', 'wheels.right_joints=["r"]')
    with pytest.raises(ConfigError, match="no message of /wheels lists a joint l;"):
        choose(base, 'wheels.left_joints=["l"]', 'topics.wheels="/wheels"')


def test_configured_joints_are_of_no_use_where_messages_list_none() -> None:
    config = load_config(sets=['wheels.left_joints=["l"]'])
    used = choose([odometry(), fix(), imu()], 'wheels.left_joints=["l"]').wheels
    assert [one.text for one in ignored_joints(used, config)] == [
        "wheels.left_joints is not used: /odom (nav_msgs/Odometry) lists no joints by name"
    ]
    assert not ignored_joints(used, load_config())
    assert not ignored_joints(choose([joints(names=("l", "right")), fix(), imu()]).wheels, config)


def test_joints_of_an_arm_alone_are_no_wheels() -> None:
    choice = choose([joints("/arm/joint_states", names=("arm_left_joint", "arm_wrist")), odometry(), fix(), imu()])
    assert choice.wheels.topic == "/odom"


def test_wheels_that_never_move_give_way_to_those_that_do() -> None:
    """A joint_state_publisher says zero for every wheel it knows from the model."""
    choice = choose([joints(scale=0.0), odometry(), fix(), imu()])
    assert choice.wheels.topic == "/odom"


def test_the_velocity_of_a_receiver_is_not_the_wheels() -> None:
    choice = choose([twist_stamped("/vel", sideways=1.0, turn=0.0), twist(), fix(), imu()])
    assert choice.wheels.topic == "/cmd_vel"


def test_fused_odometry_is_taken_only_where_nothing_else_tells_the_wheels() -> None:
    fused = odometry("/odometry/filtered")
    assert choose([fused, odometry("/platform/odom"), fix(), imu()]).wheels.topic == "/platform/odom"
    assert choose([odometry("/zed/vio"), odometry("/odom"), fix(), imu()]).wheels.topic == "/odom"
    assert choose([fused, fix(), imu()]).wheels.topic == "/odometry/filtered"


def test_a_namespace_holds_a_robot_together() -> None:
    tables = [
        *(
            make(f"/{robot}/{name}")
            for robot in ("a200_0001", "a200_0002")
            for make, name in ((fix, "gps/fix"), (imu, "imu"))
        ),
        joints("/a200_0002/platform/joint_states"),
    ]
    assert topics_of(choose(tables)) == ("/a200_0002/platform/joint_states", "/a200_0002/gps/fix", "/a200_0002/imu")


def test_of_two_robots_the_one_with_all_it_takes_is_chosen_whole() -> None:
    tables = [
        joints("/husky1/joint_states"),
        imu("/husky1/imu"),
        joints("/husky2/joint_states"),
        imu("/husky2/imu"),
        fix("/husky2/fix"),
    ]
    assert topics_of(choose(tables)) == ("/husky2/joint_states", "/husky2/fix", "/husky2/imu")


def test_another_robot_s_better_sensor_is_not_borrowed() -> None:
    compass = table(
        "/husky1/azimuth", "compass_msgs/Azimuth", azimuth=WAVE, unit=np.zeros(COUNT), orientation=np.ones(COUNT),
        reference=np.zeros(COUNT),
    )  # fmt: skip
    tables = [
        *(joints("/husky1/joint_states"), compass, fix("/husky1/fix", std_m=3.0)),
        *(joints("/husky2/joint_states"), imu("/husky2/imu"), fix("/husky2/fix", std_m=0.01)),
    ]
    choice = choose(tables)
    assert len({topic.split("/")[1] for topic in topics_of(choice)}) == 1


def test_a_namespace_named_after_a_sensor_is_no_other_robot() -> None:
    choice = choose([joints(), fix("/ublox/fix"), imu("/vectornav/imu"), odometry("/vectornav/odom")])
    assert topics_of(choice) == ("/joint_states", "/ublox/fix", "/vectornav/imu")


def test_the_configured_topic_decides_which_robot_is_meant() -> None:
    tables = [
        make(f"/{r}/{n}") for r in ("one", "two") for make, n in ((joints, "joint_states"), (fix, "fix"), (imu, "imu"))
    ]
    assert {topic.split("/")[1] for topic in topics_of(choose(tables))} == {"one"}
    assert {topic.split("/")[1] for topic in topics_of(choose(tables, "topics.gnss=/two/fix"))} == {"two"}
    assert {topic.split("/")[1] for topic in topics_of(choose(tables, "topics.wheels=/two/joint_states"))} == {"two"}


def test_wheel_odometry_is_never_taken_as_the_position() -> None:
    for topic in ("/odom", "/husky_velocity_controller/odom", "/platform/odom/filtered", "/base_controller/odom"):
        with pytest.raises(
            MissingStreamError, match=f"no position found; .*{topic} .*may be the wheels' dead reckoning"
        ):
            choose([joints(), odometry(topic), imu()])


def test_a_message_does_not_check_its_own_wheels() -> None:
    """Simulators put wheel odometry into the frame `map`: its pose is the sum of its twist."""
    with pytest.raises(MissingStreamError, match="its twist is used for the wheels"):
        choose([odometry("/odom", frame="map"), imu()])
    assert choose([odometry("/odom", frame="map"), joints(), imu()]).gnss.topic == "/odom"
    assert choose([odometry("/odom", frame="map"), imu()], "topics.gnss=/odom").gnss.topic == "/odom"


def test_a_reference_s_odometry_is_not_the_wheels() -> None:
    with pytest.raises(MissingStreamError, match="no wheels found"):
        choose([odometry("/icp_odom"), imu()])


def test_the_best_accuracy_is_the_first_choice_as_reference() -> None:
    assert choose([fix("/a/fix", std_m=2.5), fix("/b/fix", std_m=0.02), joints(), imu()]).gnss.topic == "/b/fix"
    assert choose([fix(std_m=2.5), pose(), joints(), imu()]).gnss.topic == "/icp_pose"
    assert choose([fix(std_m=0.02), pose(), joints(), imu()]).gnss.topic == "/gps/fix"


def test_a_base_station_is_not_the_robot() -> None:
    """Not even where it states a better accuracy, in the namespace of the wheels."""
    base = fix("/base/fix", std_m=0.005)
    still = base.columns | {"latitude": np.full(COUNT, 48.0), "longitude": np.full(COUNT, 11.0)}
    base = TopicTable(base.topic, base.message_type, TIMES, still, {}, 0)
    found = find([joints("/base/joint_states"), base, fix("/rover/fix"), imu()])
    assert [source.topic for source in found.gnss] == ["/rover/fix", "/base/fix"]
    assert "never moves" in found.gnss[1].why


def test_a_metric_pose_brings_its_own_heading() -> None:
    choice = choose([joints(), pose(), imu()])
    assert topics_of(choice) == ("/joint_states", "/icp_pose", "/icp_pose")


def test_a_heading_without_an_orientation_is_passed_over() -> None:
    gyro = imu("/imu/data_raw")
    gyro.columns["orientation_covariance[0]"] = np.full(COUNT, -1.0)
    assert choose([gyro, imu("/imu/data"), joints(), fix()]).heading.topic == "/imu/data"


# What is said


def test_one_missing_role_is_said_with_what_the_log_holds() -> None:
    with pytest.raises(MissingStreamError) as caught:
        choose([joints(), imu()])
    assert str(caught.value) == (
        "drive.bag: no position found; "
        "needs a GNSS fix, or a pose of a reference (total station, lidar, motion capture); "
        "the log holds /joint_states (sensor_msgs/JointState), /imu/data (sensor_msgs/Imu)"
    )
    assert caught.value.roles == ("position",)


def test_several_missing_roles_are_said_in_one_sentence() -> None:
    with pytest.raises(
        MissingStreamError, match=r"^drive\.bag: no wheels and no position found; wheels: .*; position: .*; the log"
    ) as two:
        choose([imu()])
    assert two.value.roles == ("wheels", "position")
    with pytest.raises(MissingStreamError, match="no wheels, no position and no heading found") as three:
        choose([])
    assert str(three.value).endswith("the log holds no topic at all")
    assert "\n" not in str(three.value)


def test_what_came_into_question_is_listed_first_with_the_reason() -> None:
    others = [table(f"/camera_{i}", "sensor_msgs/Image", data=np.zeros(COUNT)) for i in range(60)]
    bad = joints("/arm/joint_states", names=("a", "b"))
    with pytest.raises(MissingStreamError) as caught:
        choose([*others, bad, fix(), imu()])
    assert "the log holds /arm/joint_states (sensor_msgs/JointState: no left and right wheel among" in str(caught.value)
    assert str(caught.value).endswith("23 more")


def test_a_topic_whose_messages_are_all_damaged_says_so() -> None:
    nothing = TopicTable("/gps/fix", "sensor_msgs/NavSatFix", TIMES[:0], {}, {}, 7)
    with pytest.raises(MissingStreamError, match=r"/gps/fix .*none of its 7 messages"):
        choose([joints(), nothing, imu()])


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("topics.gnss=/other/fix", r"topics\.gnss: /other/fix is not in drive\.bag; did you mean /empty/fix\?"),
        ("topics.gnss=/imu/data", r"topics\.gnss: /imu/data: sensor_msgs/Imu cannot feed it; it needs a GNSS fix"),
        ("topics.heading=/joint_states", r"topics\.heading: /joint_states: sensor_msgs/JointState cannot feed it"),
        (
            "topics.wheels=/gps/fix",
            r"topics\.wheels: /gps/fix: sensor_msgs/NavSatFix cannot feed it; it needs wheel joints",
        ),
        (
            "topics.wheels=/left/speed",
            r"topics\.wheels: /left/speed: .* name both sides in topics\.wheel_left and topics\.wheel_right",
        ),
        ("topics.gnss=/empty/fix", r"topics\.gnss: /empty/fix: no message"),
        ("topics.wheels=/arm", r"topics\.wheels: /arm: no left and right wheel among its joints a, b"),
        ("topics.gnss=/bad/fix", r"topics\.gnss: /bad/fix: no usable fix"),
    ],
)
def test_a_configured_topic_that_cannot_be_used_is_a_clear_error(setting: str, sentence: str) -> None:
    empty = TopicTable("/empty/fix", "sensor_msgs/NavSatFix", TIMES[:0], {}, {}, 0)
    bad = fix("/bad/fix")
    bad.columns["status.status"] = np.full(COUNT, -1)
    tables = [joints(), fix(), imu(), empty, bad, joints("/arm", names=("a", "b")), side("/left/speed")]
    with pytest.raises(ConfigError, match=sentence) as caught:
        choose(tables, setting)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("left", "right", "sentence"),
    [
        ("/a/speed", "/nowhere", r"topics\.wheel_right: /nowhere is not in drive\.bag"),
        (
            "/joint_states",
            "/b/speed",
            r"topics\.wheel_left: /joint_states: sensor_msgs/JointState is not the number of one side",
        ),
        ("/a/speed", "/b/empty", r"topics\.wheel_right: /b/empty: no message"),
        (
            "/a/speed",
            "/b/later",
            r"topics\.wheel_left: /a/speed \+ /b/later: the two sides were not recorded at the same time",
        ),
    ],
)
def test_a_configured_pair_that_cannot_be_used_is_a_clear_error(left: str, right: str, sentence: str) -> None:
    empty = TopicTable("/b/empty", "std_msgs/Float64", TIMES[:0], {}, {}, 0)
    later = side("/b/later")
    later = TopicTable(later.topic, later.message_type, TIMES + 10**13, later.columns, {}, 0)
    tables = [joints(), fix(), imu(), side("/a/speed"), side("/b/speed"), empty, later]
    with pytest.raises(ConfigError, match=sentence):
        choose(tables, f"topics.wheel_left={left}", f"topics.wheel_right={right}")


def test_a_configured_pair_may_mix_types_and_namespaces() -> None:
    tables = [joints(), fix(), imu(), side("/port/motor", "Int16"), side("/starboard/drive/feedback", "Float32")]
    choice = choose(tables, "topics.wheel_left=/port/motor", "topics.wheel_right=/starboard/drive/feedback")
    assert choice.wheels.topic == "/port/motor + /starboard/drive/feedback"
    assert choice.wheels.why.endswith("; configured")
    assert (
        len(find(tables, "topics.wheel_left=/port/motor", "topics.wheel_right=/starboard/drive/feedback").wheels) == 1
    )


def test_a_configured_topic_is_used_in_spite_of_a_mere_doubt() -> None:
    choice = choose([joints(), odometry("/odom"), imu()], "topics.gnss=/odom")
    assert choice.gnss.topic == "/odom"
    assert choice.gnss.why.endswith("; configured")


# What is read at all


def test_topics_that_no_role_needs_are_not_decoded() -> None:
    tables = [joints(), fix(), imu(), side("/temperature"), side("/left/speed"), side("/right/speed"), twist()]
    names = {table.topic for i, table in enumerate(tables) if i in wanted_fields(channels_of(tables), load_config())}
    assert names == {"/joint_states", "/gps/fix", "/imu/data", "/left/speed", "/right/speed", "/cmd_vel"}


def test_a_configured_topic_leaves_its_rivals_unread() -> None:
    tables = [joints(), joints("/other"), fix(), fix("/other/fix"), imu(), side("/left/speed"), side("/right/speed")]
    config = load_config(sets=["topics.wheels=/other", "topics.gnss=/gps/fix"])
    names = {table.topic for i, table in enumerate(tables) if i in wanted_fields(channels_of(tables), config)}
    assert names == {"/other", "/gps/fix", "/imu/data"}


def test_an_odometry_is_read_for_all_its_roles_at_once() -> None:
    (paths,) = wanted_fields(channels_of([odometry()]), load_config()).values()
    assert {"twist.twist.linear.x", "pose.pose.position.x", "pose.pose.orientation.w"} <= set(paths)
    assert len(paths) == len(set(paths))


@pytest.mark.parametrize(
    ("delays", "clock"),
    [
        ([0.0, 0.1, 0.2], "header"),
        ([0.0, None, 0.05], "header"),
        ([1.0, None, 0.0], "log"),
        ([None, None, None], "header"),
    ],
)
def test_streams_that_are_used_together_go_by_one_clock(delays: list[float | None], clock: str) -> None:
    times = np.arange(3)
    rows = [StampedRows(None if d is None else times, times, "", int((d or 0.0) * 1e9)) for d in delays]
    assert common_clock(rows) == clock


def test_a_lidar_pose_is_another_reference_beside_gnss_and_brings_its_heading() -> None:
    tables = [joints(), fix(), imu(), odometry("/lidar/odom", "map"), odometry("/odometry/filtered", "map")]
    config = load_config()
    found = find_candidates(tables, config, {})
    choice = choose_streams(found, config, "log", [])
    assert choice.gnss.topic == "/gps/fix"
    (other,) = other_references(found, choice, config)
    assert (other.gnss.topic, other.heading.topic if other.heading else "") == ("/lidar/odom", "/lidar/odom")
    assert other.wheels is choice.wheels
    configured = load_config(sets=["topics.gnss=/gps/fix"])
    assert other_references(found, choice, configured) == ()


def test_a_log_holds_its_other_references_with_their_own_frame() -> None:
    tables = [joints(), fix(), imu(), odometry("/lidar/odom", "map")]
    config = load_config(sets=["robot.wheel_radius_m=0.2"])
    name = LogText("drive")
    log = assemble(Survey(name, name, (), tuple(tables), find_candidates(tables, config, {}), (), ()), config)
    (other,) = log.other_references
    assert {stream.role: stream.topic for stream in log.streams}["gnss"] == "/gps/fix"
    assert {stream.role: stream.topic for stream in other.streams}["gnss"] == "/lidar/odom"
    assert log.datum is not None
    assert other.datum is None
    assert np.array_equal(other.wheels.left, log.wheels.left)
    assert np.ptp(other.gnss.north_m) == pytest.approx(np.ptp(WAVE))
