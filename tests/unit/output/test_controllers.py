"""What is printed loads in a YAML parser, with the keys the packages document, and says where it comes from."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest
from ruamel.yaml import YAML

from icrtool.calibration.pooled import calibrate
from icrtool.calibration.record import Calibration, factor_to_old, model_in_document, parameter_documents, unfit_reasons
from icrtool.errors import ConfigError, DataError
from icrtool.motion.models import MODELS, FittedModel, Lever, controller_model, wheel_motion
from icrtool.output.exports.controllers import CONTROLLER_TARGETS, format_export
from icrtool.output.text_blocks import TEXT_WIDTH
from icrtool.records.calibration_document import ControllerDocument
from icrtool.records.run_document import ControllerNumbers

CONTROLLER_KEYS = {
    "wheel_separation", "wheel_separation_multiplier", "left_wheel_radius_multiplier", "right_wheel_radius_multiplier",
    "pose_covariance_diagonal", "twist_covariance_diagonal",
}  # fmt: skip
"""As ros2_controllers' diff_drive_controller declares them."""


@pytest.fixture(scope="module")
def calibration(make_run) -> Calibration:
    return calibrate(make_run(duration_s=120.0))


def load(calibration: Calibration, target: str) -> dict:
    return YAML(typ="safe").load(format_export(calibration, target))


@pytest.mark.parametrize(
    ("target", "path"),
    [
        ("diff_drive_controller", ("diff_drive_controller", "ros__parameters")),
        ("clearpath", ("platform", "extras", "ros_parameters", "platform_velocity_controller")),
        ("husarion", ("/**", "drive_controller", "ros__parameters")),
    ],
)
def test_controllers_get_their_keys(calibration: Calibration, target: str, path: tuple[str, ...]) -> None:
    node = load(calibration, target)
    for key in path:
        node = node[key]
    assert set(node) >= CONTROLLER_KEYS
    assert node["wheel_separation_multiplier"] == pytest.approx((0.72 + 0.68) / 0.6, abs=0.1)
    for key in ("pose_covariance_diagonal", "twist_covariance_diagonal"):
        assert len(node[key]) == 6
        # ROS 2 refuses an integer in a list of doubles
        assert all(type(value) is float and value > 0 for value in node[key])
    assert type(node["wheel_separation"]) is float


def test_nav2_gets_filter_and_amcl(calibration: Calibration) -> None:
    document = load(calibration, "nav2")
    assert [i for i, used in enumerate(document["ekf_filter_node"]["ros__parameters"]["odom0_config"]) if used] == [
        6,
        11,
    ]
    amcl = document["amcl"]["ros__parameters"]
    assert all(type(amcl[f"alpha{i}"]) is float and 0 < amcl[f"alpha{i}"] < 1 for i in range(1, 5))


def test_json_holds_every_number(calibration: Calibration) -> None:
    document = json.loads(format_export(calibration, "json"))
    assert document["separation_multiplier"] == calibration.controller.multiplier
    assert document["schema"] == "icrtool/export/1"


@pytest.mark.parametrize("target", [target for target in CONTROLLER_TARGETS if target not in {"json", "icr"}])
def test_comments_say_log_date_doubt_and_what_is_lost(calibration: Calibration, target: str) -> None:
    text = " ".join(
        line.removeprefix("# ") for line in format_export(calibration, target).splitlines() if line[0] == "#"
    )
    for word in ("barn", "2025-10-09", "±", "x_icr", "not expressible here", "held out"):
        assert word in text
    assert max(len(line) for line in format_export(calibration, target).splitlines() if line[0] == "#") <= TEXT_WIDTH


def test_a_log_with_a_wild_name_stays_a_comment(calibration: Calibration) -> None:
    (log,) = calibration.logs
    wild = msgspec.structs.replace(
        calibration, logs=(msgspec.structs.replace(log, name="a\nwheel_separation: 3\n\t# b"),)
    )
    assert load(wild, "clearpath") == load(calibration, "clearpath")


def test_error_growth_is_measured(calibration: Calibration) -> None:
    errors = calibration.controller_errors
    assert errors is not None
    along, across, yaw = errors.pose_variance
    assert 0 < along < 0.1
    assert 0 < across < 0.1
    assert 0 < yaw < 0.01
    assert 0 < errors.p95_m < 1.0


def test_a_run_without_width_has_no_multiplier(make_run) -> None:
    with pytest.raises(ConfigError, match=r"robot\.track_width_m"):
        calibrate(make_run(track_width_m=None))


def test_without_measured_errors_only_the_twist_model_is_given(calibration: Calibration) -> None:
    numbers = {name: getattr(calibration.controller, name) for name in ControllerNumbers.__struct_fields__}
    short = msgspec.structs.replace(calibration, controller=ControllerDocument(**numbers))
    with pytest.raises(DataError):
        format_export(short, "nav2")
    assert json.loads(format_export(short, "icr"))["held_out"]["p95_m"] > 0.0


def test_the_twist_model_is_the_calibration_in_rep_103(calibration: Calibration) -> None:
    """Evaluated as a robot's node would, for every term of the models: v_y and turn rate change sign, v_x does not."""
    rng, b = np.random.default_rng(1), calibration.width_m
    for model in MODELS.values():
        k = len(model.terms)
        fitted = FittedModel(model, rng.normal(size=k), np.eye(k))
        terms, parameters, covariance = parameter_documents(fitted)
        one = msgspec.structs.replace(
            calibration, model=model.name, terms=terms, parameters=parameters, covariance=covariance
        )
        document = json.loads(format_export(one, "icr"))
        for v_left, v_right in ((0.4, 1.1), (-0.7, 0.9), (1.0, 1.0)):
            symbols = dict.fromkeys(("v_x", "v_y", "yaw_rate"), 0.0)
            v, w = (v_left + v_right) / 2, (v_right - v_left) / b
            known = {"v": v, "w": w, "b": b, "spin": abs(v_left - v_right) / (abs(v_left) + abs(v_right)), "abs": abs}
            for term in document["terms"]:
                symbols[term["output"]] += term["value"] * eval(term["formula"], {"__builtins__": {}}, known)
            v_x, v_y, omega = one.twist(v_left, v_right)
            assert list(symbols.values()) == pytest.approx([v_x, -v_y, -omega], abs=1e-12)
    icrs = json.loads(format_export(calibration, "icr"))["icrs"]
    assert icrs["y_icr_right_m"] < 0.0 < icrs["y_icr_left_m"]


def test_a_controller_drives_as_its_model_was_tested(calibration: Calibration) -> None:
    """The twist of a diff_drive_controller with the exported numbers, written out, is that of the tested model."""
    numbers = calibration.controller
    v_left, v_right, b = 0.4, 1.1, calibration.width_m
    left, right = numbers.left_radius * v_left, numbers.right_radius * v_right
    expected = [(left + right) / 2, 0.0, (left - right) / (numbers.multiplier * b)]
    motion = wheel_motion(np.array([v_left]), np.array([v_right]), b)
    tested = controller_model(model_in_document("five", calibration.models["five"]), Lever(ahead=True, aside=True), b)
    assert tested.twist(motion)[:, 0] == pytest.approx(expected)


def test_what_predicts_badly_is_not_fit_for_use(calibration: Calibration) -> None:
    assert unfit_reasons(calibration) == ()
    far = tuple(
        msgspec.structs.replace(one, p95_m=14.8) if one.model == "recommended" else one
        for one in calibration.held_out_pooled
    )
    worse = tuple(
        msgspec.structs.replace(one, expected_m=99.0) if one.model == "recommended" else one
        for one in calibration.held_out_pooled
    )
    for pooled, word in ((far, "14.8 m"), (worse, "no slip")):
        spoilt = msgspec.structs.replace(calibration, held_out_pooled=pooled)
        (reason,) = unfit_reasons(spoilt)
        assert word in reason.text
        assert f"WARNING: {reason.text.split(':')[0]}" in " ".join(format_export(spoilt, "clearpath").split("\n# "))


def test_the_factor_to_the_multiplier_that_made_the_odometry_is_given(calibration: Calibration) -> None:
    robot = msgspec.structs.replace(calibration.robot, twist_width_m=1.5 * calibration.width_m)
    made = msgspec.structs.replace(calibration, robot=robot)
    assert factor_to_old(made) == pytest.approx(made.controller.multiplier / 1.5)
    assert "wheel_separation_multiplier 1.5000" in " ".join(format_export(made, "clearpath").split("\n# "))
    assert factor_to_old(calibration) is None
