"""The robot's pose where only transforms hold it: composed link by link, and taken where the map moves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from icrtool.config import load_config
from icrtool.logs.read_log import survey_log
from icrtool.logs.streams.assembly import Survey

START_NS, STEP_NS, COUNT, EVERY = 1_760_000_000_000_000_000, 50_000_000, 60, 5
STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
RNG = np.random.default_rng(5)


def turns(count: int) -> Rotation:
    """Return any yaw, with roll and pitch of a slope."""
    return Rotation.from_euler("zyx", RNG.normal(size=(count, 3)) * (2.0, 0.1, 0.1))


ODOMETRY = RNG.normal(size=(COUNT, 3)), turns(COUNT)
CORRECTIONS = RNG.normal(size=(COUNT // EVERY, 3)), turns(COUNT // EVERY)


def transform(parent: str, child: str, i: int, place: Any, turn: Rotation) -> Any:
    stamp_ns = START_NS + i * STEP_NS
    header = TYPES["std_msgs/msg/Header"](
        TYPES["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9), parent
    )
    vector = TYPES["geometry_msgs/msg/Vector3"](*map(float, place))
    rotation = TYPES["geometry_msgs/msg/Quaternion"](*turn.as_quat().tolist())
    moved = TYPES["geometry_msgs/msg/Transform"](vector, rotation)
    return TYPES["geometry_msgs/msg/TransformStamped"](header, child, moved)


def write(path: Path, messages: Sequence[tuple[str, str, int, Any]], *, lacking: str = "") -> Path:
    """Write a log; a field of its definitions that is to be lacking has another name."""
    with path.open("wb") as stream:
        writer, channels = McapWriter(stream), dict[str, int]()
        writer.start()
        for topic, name, i, message in messages:
            if topic not in channels:
                text = STORE.generate_msgdef(name, ros_version=2)[0].replace(f" {lacking}\n", " other\n").encode()
                channels[topic] = writer.register_channel(topic, "cdr", writer.register_schema(name, "ros2msg", text))
            stamp_ns = START_NS + i * STEP_NS
            writer.add_message(channels[topic], stamp_ns, bytes(STORE.serialize_cdr(message, name)), stamp_ns)
        writer.finish()
    return path


def moving(i: int, *transforms: Any) -> tuple[str, str, int, Any]:
    return "/tf", "tf2_msgs/msg/TFMessage", i, TYPES["tf2_msgs/msg/TFMessage"](list(transforms))


def odometry(root: str = "odom", base: str = "base_link") -> list[tuple[str, str, int, Any]]:
    return [moving(i, transform(root, base, i, ODOMETRY[0][i], ODOMETRY[1][i])) for i in range(COUNT)]


def with_map(step: int) -> list[tuple[str, str, int, Any]]:
    """Return the odometry, and a map that is sent before each one and moves after every `step` of them."""
    messages = []
    for i, (topic, name, _, message) in enumerate(odometry(base="r1/base_link")):
        k = i // step if step else 0
        correction = transform("r1/map", "/odom", i, CORRECTIONS[0][k], CORRECTIONS[1][k])
        wheel = transform("r1/base_link", "wheel", i, (0, 0, 0), ODOMETRY[1][i])
        messages += [moving(i, correction), (topic, name, i, message), moving(i, wheel)]
    return messages


def surveyed(path: Path, *sets: str) -> Survey:
    return survey_log(path, load_config(sets=sets))


def test_a_pose_is_composed_where_the_map_moves(tmp_path: Path) -> None:
    """Independent witness: rotations of scipy."""
    survey = surveyed(write(tmp_path / "log.mcap", with_map(EVERY)))
    (source,), (heading,) = survey.candidates.gnss, survey.candidates.heading
    rows = np.arange(EVERY, COUNT, EVERY)
    place = CORRECTIONS[0][1:] + CORRECTIONS[1][1:].apply(ODOMETRY[0][rows])
    assert (source.topic, source.message_type, source.problem) == ("/tf", "geometry_msgs/PoseStamped", "")
    assert source.metric is not None
    np.testing.assert_allclose(source.metric, place[:, [1, 0]], atol=1e-12)
    assert source.stamps.header_ns is not None
    assert source.stamps.header_ns.tolist() == (START_NS + rows * STEP_NS).tolist()
    ahead = (CORRECTIONS[1][1:] * ODOMETRY[1][rows]).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(np.exp(1j * heading.yaw_rad), np.exp(1j * np.arctan2(ahead[:, 1], ahead[:, 0])))


def test_a_single_link_is_a_pose_at_every_message(tmp_path: Path) -> None:
    survey = surveyed(write(tmp_path / "log.mcap", odometry(root="map")))
    (source,) = survey.candidates.gnss
    assert source.metric is not None
    np.testing.assert_allclose(source.metric, ODOMETRY[0][:, [1, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("messages", "reason"),
    [
        (odometry(), "its root, odom, does not show a position reference"),
        (with_map(0), "its frame r1/map never moves with respect to the odometry"),
        (odometry(base="wheel"), "it has no transform of a frame base_link"),
    ],
    ids=["odometry alone", "a map that stands", "no base"],
)
def test_transforms_that_are_no_reference_are_refused_with_the_reason(
    tmp_path: Path, messages: list[tuple[str, str, int, Any]], reason: str
) -> None:
    survey = surveyed(write(tmp_path / "log.mcap", messages))
    assert survey.candidates.gnss == ()
    assert reason in survey.candidates.unread["/tf"]


def test_transforms_whose_definition_lacks_a_part_are_refused_with_the_reason(tmp_path: Path) -> None:
    survey = surveyed(write(tmp_path / "log.mcap", odometry(root="map"), lacking="translation"))
    assert survey.candidates.gnss == ()
    assert "transform.translation.x" in survey.candidates.unread["/tf"]


def test_transforms_are_not_read_where_a_topic_is_the_position(tmp_path: Path) -> None:
    pose = TYPES["geometry_msgs/msg/PoseStamped"]
    still = TYPES["geometry_msgs/msg/Pose"](
        TYPES["geometry_msgs/msg/Point"](0.0, 0.0, 0.0), TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    )
    header = transform("map", "base", 0, (0, 0, 0), ODOMETRY[1][0]).header
    other = [("/icp_pose", "geometry_msgs/msg/PoseStamped", i, pose(header, still)) for i in range(5)]
    path = write(tmp_path / "log.mcap", [*with_map(EVERY), *other])
    assert [source.topic for source in surveyed(path).candidates.gnss] == ["/icp_pose"]
    assert [source.topic for source in surveyed(path, "topics.gnss=/tf").candidates.gnss] == ["/tf"]
