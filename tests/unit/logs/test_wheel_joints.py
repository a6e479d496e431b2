"""Left from right, wheels from arms, and a topic's twin, by the names that robots really use."""

from __future__ import annotations

import pytest

from icrtool.logs.streams.wheel_pairs import find_right_twin
from icrtool.logs.streams.wheels import side_of, wheel_joints


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("front_left_wheel", "left"),
        ("rear_right_wheel_joint", "right"),
        ("wheel_left_joint", "left"),
        ("left_wheel", "left"),
        ("frontLeftWheel", "left"),
        ("rearRightWheel", "right"),
        ("wheel_FL_joint", "left"),
        ("wheel_RL_joint", "left"),
        ("wheel_FR_joint", "right"),
        ("wheel_RR_joint", "right"),
        ("fl_wheel_joint", "left"),
        ("rl_wheel_joint", "left"),
        ("fr_wheel_joint", "right"),
        ("rr_wheel_joint", "right"),
        ("panther/fl_wheel_joint", "left"),
        ("panther/rr_wheel_joint", "right"),
        ("wheel_l", "left"),
        ("RWheel", "right"),
        ("left_track", "left"),
        ("trackR", "right"),
        ("wheel_joint", ""),
        ("left_to_right_rod", ""),
        ("arm_elbow_joint", ""),
        ("", ""),
    ],
)
def test_the_side_of_a_joint_is_in_its_name(name: str, side: str) -> None:
    assert side_of(name)[0] == side


def test_wheels_are_picked_from_among_other_joints() -> None:
    names = [
        "arm_left_joint",
        "front_left_wheel",
        "gripper_right_finger",
        "front_right_wheel",
        "pan1_left",
        "left_flipper",
    ]
    assert wheel_joints(names) == ([1], [3])


def test_joints_that_are_called_after_a_side_alone_are_wheels_where_nothing_else_is() -> None:
    assert wheel_joints(["left", "right", "head"]) == ([0], [1])
    assert wheel_joints(["left", "left_wheel", "right_wheel"]) == ([1], [2])


def test_the_name_of_a_robot_is_not_the_name_of_a_joint() -> None:
    names = ["panther/fl_wheel_joint", "panther/fr_wheel_joint", "panther/rl_wheel_joint", "panther/rr_wheel_joint"]
    assert wheel_joints(names) == ([0, 2], [1, 3])


def test_steering_joints_are_not_wheels() -> None:
    assert wheel_joints(["front_left_steering_joint", "front_left_wheel", "front_right_wheel"]) == ([1], [2])


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("/left_drive/velocity", "/right_drive/velocity"),
        ("/robot/LeftWheel/ticks", "/robot/RightWheel/ticks"),
        ("/lwheel", "/rwheel"),
        ("/lwheel_encoder", "/rwheel_encoder"),
        ("/enc_L", "/enc_R"),
        ("/WL", "/WR"),
        ("/a/frontL/speed", "/a/frontR/speed"),
        ("/left/left_speed", "/right/right_speed"),
        ("/fl_wheel/speed", "/fr_wheel/speed"),
    ],
)
def test_a_left_topic_has_its_right_twin(left: str, right: str) -> None:
    assert find_right_twin(left, [left, "/lidar/speed", right]) == right


@pytest.mark.parametrize("name", ["/level", "/lidar/speed", "/battery_left", "/right_drive/velocity", "/load"])
def test_a_topic_without_a_twin_has_none(name: str) -> None:
    assert find_right_twin(name, [name, "/left_drive/velocity", "/temperature"]) is None
