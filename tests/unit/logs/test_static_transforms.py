"""The antenna's place from /tf_static, written by another library."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.read_log import survey_log
from icrtool.logs.streams.positions import TRANSFORM_FIELDS, antenna_place
from icrtool.records.text import LogText

STORE = get_typestore(Stores.ROS2_HUMBLE)
HALF = np.sqrt(0.5)


def write(
    path: Path, transforms: list[tuple[str, str, tuple[float, ...], tuple[float, ...]]], frame: str = "gps"
) -> Path:
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    stamped = [
        types["geometry_msgs/msg/TransformStamped"](
            header=types["std_msgs/msg/Header"](stamp=time, frame_id=parent),
            child_frame_id=child,
            transform=types["geometry_msgs/msg/Transform"](translation=vector(*t), rotation=quaternion(*q)),
        )
        for parent, child, t, q in transforms
    ]
    fix = types["sensor_msgs/msg/NavSatFix"](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=frame),
        status=types["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
        latitude=40.0, longitude=-77.0, altitude=300.0,
        position_covariance=np.zeros(9), position_covariance_type=0,
    )  # fmt: skip
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, name, message in (
            ("/tf_static", "tf2_msgs/msg/TFMessage", types["tf2_msgs/msg/TFMessage"](transforms=stamped)),
            ("/gps/fix", "sensor_msgs/msg/NavSatFix", fix),
        ):
            connection = writer.add_connection(topic, name, typestore=STORE)
            writer.write(connection, 10**9, STORE.serialize_cdr(message, name))
    return path


def place(path: Path) -> tuple[float, float] | None:
    return antenna_place(survey_log(path).tables, "/gps/fix")


def test_a_chain_of_turned_frames_is_followed_from_the_base_to_the_antenna(tmp_path: Path) -> None:
    log = write(
        tmp_path / "log",
        [
            ("base_footprint", "base_link", (0.0, 0.0, 0.1), (0, 0, 0, 1)),
            ("base_link", "mast", (0.5, 0.0, 0.3), (0, 0, HALF, HALF)),
            ("mast", "gps", (0.2, 0.1, 1.0), (0, 0, 0, 1)),
        ],
    )
    # The mast looks left: its x axis is the body's left, its y axis the body's back.
    assert place(log) == pytest.approx((0.5 - 0.1, -0.2))


def test_an_antenna_beside_the_base_in_the_tree_is_found_through_their_common_root(tmp_path: Path) -> None:
    log = write(
        tmp_path / "log",
        [
            ("chassis", "robot/base_link", (1.0, 0.0, 0.0), (0, 0, 0, 1)),
            ("chassis", "gps", (1.2, -0.3, 0.5), (0, 0, 0, 1)),
        ],
    )
    assert place(log) == pytest.approx((0.2, 0.3))


@pytest.mark.parametrize(
    "transforms",
    [
        [("base_link", "camera", (0.2, 0.0, 0.0), (0, 0, 0, 1))],
        [("odd", "gps", (0.2, 0.0, 0.0), (0, 0, 0, 1))],
        [("base_link", "gps", (50.0, 0.0, 0.0), (0, 0, 0, 1))],
        [("gps", "base_link", (0.1, 0.0, 0.0), (0, 0, 0, 1)), ("base_link", "gps", (0.1, 0.0, 0.0), (0, 0, 0, 0))],
    ],
)
def test_a_tree_that_does_not_tell_gives_nothing(tmp_path: Path, transforms: list) -> None:
    assert place(write(tmp_path / "log", transforms)) is None


def test_transforms_in_a_circle_give_nothing(tmp_path: Path) -> None:
    log = write(
        tmp_path / "log",
        [
            ("a", "gps", (0.1, 0.0, 0.0), (0, 0, 0, 1)),
            ("gps", "a", (0.1, 0.0, 0.0), (0, 0, 0, 1)),
            ("root", "base_link", (0, 0, 0.0), (0, 0, 0, 1)),
        ],
    )
    assert place(log) is None


def test_base_and_antenna_in_one_circle_give_nothing(tmp_path: Path) -> None:
    circle = [
        ("gps", "base_link", (0.1, 0.0, 0.0), (0, 0, 0, 1)),
        ("base_link", "mast", (0.2, 0.0, 0.0), (0, 0, 0, 1)),
        ("mast", "gps", (0.3, 0.0, 0.0), (0, 0, 0, 1)),
    ]
    assert place(write(tmp_path / "log", circle)) is None
    assert place(write(tmp_path / "open", circle[1:])) == pytest.approx((0.5, 0.0))


def test_a_long_chain_of_frames_is_followed_once() -> None:
    count = 20_000
    names = ["base_link", *(f"f{k}" for k in range(1, count)), "gps"]
    columns = {TRANSFORM_FIELDS[0]: np.arange(count)[None], TRANSFORM_FIELDS[1]: np.arange(1, count + 1)[None]}
    columns |= {path: np.full((1, count), float(path.endswith("rotation.w"))) for path in TRANSFORM_FIELDS[2:]}
    columns[TRANSFORM_FIELDS[2]] = np.full((1, count), 1e-4)
    texts = {path: [LogText(name) for name in names] for path in TRANSFORM_FIELDS[:2]}
    static = TopicTable(LogText("/tf_static"), LogText("tf2_msgs/TFMessage"), np.array([0]), columns, texts, 0)
    fix = {"header.frame_id": np.array([0])}
    fixes = TopicTable(
        LogText("/gps/fix"), LogText("x/Y"), np.array([0]), fix, {"header.frame_id": [LogText("gps")]}, 0
    )
    begin = time.process_time()
    assert antenna_place([static, fixes], "/gps/fix") == pytest.approx((2.0, 0.0))
    assert time.process_time() - begin < 3.0


@pytest.mark.parametrize("number", [np.inf, np.nan, 1e300, 1e-300])
def test_transforms_of_impossible_numbers_are_left_out(tmp_path: Path, number: float) -> None:
    rows = [("base_link", "gps", (number, 0.0, 0.0), (0, 0, 0, 1)), ("base_link", "gps", (1, 0, 0), (number, 0, 0, 0))]
    assert place(write(tmp_path / "log", rows)) in (None, (0.0, 0.0), (1e-300, 0.0))
