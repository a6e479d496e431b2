"""What is printed loads in a YAML parser, with the keys the packages document, and says where it comes from."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from ruamel.yaml import YAML

from icrtool.calibration.controller_numbers import ExportNumbers, export_numbers
from icrtool.errors import ConfigError
from icrtool.output.exports.controllers import TARGETS, format_export

CONTROLLER_KEYS = {
    "wheel_separation", "wheel_separation_multiplier", "left_wheel_radius_multiplier", "right_wheel_radius_multiplier",
    "pose_covariance_diagonal", "twist_covariance_diagonal",
}  # fmt: skip
"""As ros2_controllers' diff_drive_controller declares them."""


@pytest.fixture(scope="module")
def numbers(make_run) -> ExportNumbers:
    return export_numbers(make_run(duration_s=120.0))


def load(numbers: ExportNumbers, target: str) -> dict:
    return YAML(typ="safe").load(format_export(numbers, target))


@pytest.mark.parametrize(
    ("target", "path"),
    [
        ("diff_drive_controller", ("diff_drive_controller", "ros__parameters")),
        ("clearpath", ("platform", "extras", "ros_parameters", "platform_velocity_controller")),
        ("husarion", ("/**", "drive_controller", "ros__parameters")),
    ],
)
def test_controllers_get_their_keys(numbers: ExportNumbers, target: str, path: tuple[str, ...]) -> None:
    node = load(numbers, target)
    for key in path:
        node = node[key]
    assert set(node) >= CONTROLLER_KEYS
    assert node["wheel_separation_multiplier"] == pytest.approx((0.72 + 0.68) / 0.6, abs=0.1)
    for key in ("pose_covariance_diagonal", "twist_covariance_diagonal"):
        assert len(node[key]) == 6
        # ROS 2 refuses an integer in a list of doubles
        assert all(type(value) is float and value > 0 for value in node[key])
    assert type(node["wheel_separation"]) is float


def test_nav2_gets_filter_and_amcl(numbers: ExportNumbers) -> None:
    document = load(numbers, "nav2")
    assert [i for i, used in enumerate(document["ekf_filter_node"]["ros__parameters"]["odom0_config"]) if used] == [
        6,
        11,
    ]
    amcl = document["amcl"]["ros__parameters"]
    assert all(type(amcl[f"alpha{i}"]) is float and 0 < amcl[f"alpha{i}"] < 1 for i in range(1, 5))


def test_json_holds_every_number(numbers: ExportNumbers) -> None:
    document = json.loads(format_export(numbers, "json"))
    assert document["separation_multiplier"] == numbers.separation_multiplier
    assert document["schema"] == "icrtool/export/1"


@pytest.mark.parametrize("target", [target for target in TARGETS if target != "json"])
def test_comments_say_log_date_doubt_and_what_is_lost(numbers: ExportNumbers, target: str) -> None:
    text = " ".join(line.removeprefix("# ") for line in format_export(numbers, target).splitlines() if line[0] == "#")
    for word in ("barn", "2025-10-09", "±", "x_icr", "not expressible here", "held out"):
        assert word in text


def test_a_log_with_a_wild_name_stays_a_comment(numbers: ExportNumbers) -> None:
    wild = replace(numbers, log="a\nwheel_separation: 3\n\t# b")
    assert load(wild, "clearpath") == load(numbers, "clearpath")


def test_error_growth_is_measured(numbers: ExportNumbers) -> None:
    along, across, yaw = numbers.pose_variance
    assert 0 < along < 0.1
    assert 0 < across < 0.1
    assert 0 < yaw < 0.01
    assert 0 < numbers.p95_m < 1.0


def test_a_run_without_width_has_no_multiplier(make_run) -> None:
    with pytest.raises(ConfigError, match=r"robot\.track_width_m"):
        export_numbers(make_run(track_width_m=None))
