"""Odometry whose twist stays 0 while its pose moves: the distance and the turn of the pose are the wheels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from icrtool.config import Config, load_config
from icrtool.kernels.arrays import Floats
from icrtool.kernels.kinematics import drive
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.message_types import MESSAGE_TYPES
from icrtool.logs.streams.sources import WheelSource
from icrtool.logs.streams.wheel_samples import wheel_samples
from icrtool.logs.streams.wheels import pose_travel
from support.tables import table_of

WIDTH_M, EVERY_S = 0.6, 0.05
CONFIG = load_config(sets=[f"robot.track_width_m={WIDTH_M}"])


def sides(count: int = 1200) -> tuple[Floats, Floats, Floats]:
    """Return times, and speeds of the sides that are held from one to the next, also backward."""
    t = EVERY_S * np.arange(count)
    return t, 0.4 + 0.5 * np.sin(0.3 * t), 0.4 + 0.5 * np.sin(0.21 * t + 0.5)


def pose_columns(turned_by: float = 0.7) -> dict[str, Any]:
    """Return the columns of the pose that the wheels drive without slip, in ENU."""
    t, left, right = sides()
    icrs, which = np.array([[WIDTH_M / 2, -WIDTH_M / 2, 0.0]]), np.zeros(len(t), np.int64)
    north, east, psi = drive(t, left, right, icrs, which, np.array([3.0, -2.0, turned_by])).T
    yaw = np.pi / 2 - psi
    zero = np.zeros(len(t))
    return {
        "pose.pose.position.x": east, "pose.pose.position.y": north, "pose.pose.orientation.x": zero,
        "pose.pose.orientation.y": zero, "pose.pose.orientation.z": np.sin(yaw / 2),
        "pose.pose.orientation.w": np.cos(yaw / 2),
    }  # fmt: skip


def odometry(columns: dict[str, Any], twist: float = 0.0, topic: str = "/odom") -> TopicTable:
    count = len(next(iter(columns.values())))
    names = ("linear.x", "linear.y", "angular.z")
    zero = {f"twist.twist.{name}": np.full(count, twist if name != "linear.y" else 0.0) for name in names}
    return table_of("nav_msgs/Odometry", zero | columns, topic)


def read(table: TopicTable) -> WheelSource:
    found = MESSAGE_TYPES["wheels"]["nav_msgs/Odometry"].read(table, Config())
    assert isinstance(found, WheelSource)
    return found


def test_the_speeds_of_the_sides_are_those_that_drove_the_pose() -> None:
    motion = read(odometry(pose_columns()))
    t, left, right = sides()
    stamps = 1_760_000_000_000_000_000 + np.round(t * 1e9).astype(np.int64)
    samples, notes = wheel_samples(motion, stamps, CONFIG, "made")
    assert samples.from_position
    assert samples.unit == "m"
    np.testing.assert_allclose(samples.left[:-1], left[:-1], atol=2e-4)
    np.testing.assert_allclose(samples.right[:-1], right[:-1], atol=2e-4)
    assert [one.code for one in motion.notes] == ["wheels_from_pose"]
    assert "its twist stays 0" in motion.notes[0].text
    assert any(one.code == "wheels_from_twist" for one in notes)


def test_a_twist_that_moves_is_used_and_preferred() -> None:
    moving, still = read(odometry(pose_columns(), 0.3)), read(odometry(pose_columns()))
    assert moving.travelled is None
    assert moving.notes == ()
    assert moving.score > still.score > moving.score - 60.0


@pytest.mark.parametrize("left_out", ["pose.pose.orientation.w", "pose.pose.position.x"])
def test_without_a_pose_the_twist_never_moves(left_out: str) -> None:
    columns = pose_columns()
    del columns[left_out]
    motion = read(odometry(columns))
    assert motion.travelled is None
    assert "never moves" in motion.why


def test_a_pose_that_stands_or_never_turns_is_not_the_wheels() -> None:
    columns = pose_columns()
    still = {name: np.full(len(column), column[0]) for name, column in columns.items()}
    straight = columns | {name: still[name] for name in columns if "orientation" in name}
    for one in (still, straight):
        assert read(odometry(one)).travelled is None


def test_the_distance_of_an_arc_is_its_length() -> None:
    angle = np.linspace(0.0, 6.0, 25)
    zero = np.zeros(len(angle))
    found = pose_travel(
        2.0 * np.sin(angle), 2.0 * (1.0 - np.cos(angle)), zero, zero, np.sin(angle / 2), np.cos(angle / 2)
    )
    assert found is not None
    np.testing.assert_allclose(found, np.column_stack([2.0 * angle, angle]), atol=1e-9)
