"""A calibration as configuration for other people's controllers and filters: YAML with comments, or JSON."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Literal, get_args

from icrtool import __version__
from icrtool.calibration.controller_numbers import POSE_AFTER_M, TWIST_OVER_M, ExportNumbers, export_numbers
from icrtool.calibration.record import Calibration
from icrtool.output.exports.twist_model import format_twist
from icrtool.output.json_file import json_bytes
from icrtool.output.text_blocks import TEXT_WIDTH

Target = Literal["diff_drive_controller", "clearpath", "nav2", "husarion", "json", "icr"]
TARGETS: tuple[Target, ...] = get_args(Target)

EXPORT_SCHEMA = "icrtool/export/1"

NOT_PLANAR = 0.001
"""Variance of z, roll and pitch, which a plane does not show: the value the controller's own documentation gives."""

ODOMETRY_USED = (6, 11)
"""Of robot_localization's fifteen, x y z roll pitch yaw, their velocities, accelerations: vx and vyaw."""


def format_export(calibration: Calibration, target: Target) -> str:
    """Return the text to paste, no line end.

    Notes
    -----
    Keys as documented by ros2_controllers (diff_drive_controller parameters), Clearpath (robot.yaml,
    ``platform.extras.ros_parameters``), Husarion (``WH0x_controller.yaml``), nav2 (AMCL) and robot_localization.

    Raises
    ------
    DataError
        The drives were too short to measure covariances, which every target but ``icr`` holds.
    """
    return format_twist(calibration) if target == "icr" else _WRITERS[target](export_numbers(calibration))


def _json(numbers: ExportNumbers) -> str:
    document = {"schema": EXPORT_SCHEMA, "tool_version": __version__, "date": _date(numbers), **asdict(numbers)}
    return json_bytes(document).decode().rstrip("\n")


def _diff_drive_controller(numbers: ExportNumbers) -> str:
    body = ["diff_drive_controller:  # your controller's name", "  ros__parameters:", *_controller(numbers, 4)]
    return "\n".join([*_header(numbers), *body])


def _clearpath(numbers: ExportNumbers) -> str:
    body = [
        "# robot.yaml: merge into its platform section",
        "platform:",
        "  extras:",
        "    ros_parameters:",
        "      platform_velocity_controller:",
        *_controller(numbers, 8),
    ]
    return "\n".join([*_header(numbers), *body])


def _husarion(numbers: ExportNumbers) -> str:
    body = [
        "# husarion_ugv_controller: WH0x_controller.yaml, passed as controller_config_path",
        "/**:",
        "  drive_controller:",
        "    ros__parameters:",
        *_controller(numbers, 6),
    ]
    return "\n".join([*_header(numbers), *body])


def _nav2(numbers: ExportNumbers) -> str:
    (alpha1, alpha2), (alpha3, alpha4) = numbers.turn_noise, numbers.way_noise
    body = [
        "# robot_localization, odom frame: wheels give vx and vyaw, with the twist covariance of the odometry message:",
        f"# set there twist_covariance_diagonal: {_diagonal(numbers.twist_variance)}",
        "ekf_filter_node:",
        "  ros__parameters:",
        "    two_d_mode: true",
        "    world_frame: odom",
        "    odom0: odom  # your wheel odometry",
        f"    odom0_config: [{', '.join('true' if used in ODOMETRY_USED else 'false' for used in range(15))}]",
        "    odom0_differential: false",
        "    odom0_relative: false",
        "# AMCL: shares of variance of turn by turn, turn by distance, distance by distance, distance by turn",
        "amcl:",
        "  ros__parameters:",
        '    robot_model_type: "nav2_amcl::DifferentialMotionModel"',
        f"    alpha1: {_number(alpha1)}",
        f"    alpha2: {_number(alpha2)}",
        f"    alpha3: {_number(alpha3)}",
        f"    alpha4: {_number(alpha4)}",
    ]
    return "\n".join([*_header(numbers), *body])


def _controller(numbers: ExportNumbers, indent: int) -> list[str]:
    """Return the parameters of a diff_drive_controller."""
    lines = [f"wheel_separation: {_number(numbers.track_width_m)}"]
    if numbers.wheel_radius_m is not None:
        lines.append(f"wheel_radius: {_number(numbers.wheel_radius_m)}")
    for key, value, std in (
        ("wheel_separation_multiplier", numbers.separation_multiplier, numbers.separation_multiplier_std),
        ("left_wheel_radius_multiplier", numbers.left_radius_multiplier, numbers.left_radius_multiplier_std),
        ("right_wheel_radius_multiplier", numbers.right_radius_multiplier, numbers.right_radius_multiplier_std),
    ):
        lines.append(f"{key}: {value:.4f}  # ± {std:.4f}")
    lines += [
        f"# after {POSE_AFTER_M:g} m; x forward, y left, z, roll, pitch, yaw",
        f"pose_covariance_diagonal: {_diagonal(numbers.pose_variance)}",
        f"# of velocities over {TWIST_OVER_M:g} m",
        f"twist_covariance_diagonal: {_diagonal(numbers.twist_variance)}",
    ]
    return [" " * indent + line for line in lines]


def _header(numbers: ExportNumbers) -> list[str]:
    """Return the comments above: where the numbers come from, and what they cannot express."""
    right, left, x = numbers.icrs_m
    std_right, std_left, std_x = numbers.icr_std_m
    robot = f", {_one_line(numbers.robot)}" if numbers.robot else ""
    distance_m = numbers.distance_m
    origin = (
        f"icrtool {__version__}: {_one_line(numbers.log)}, driven {_date(numbers)}, {distance_m:.0f} m{robot}, "
        f"fitted {numbers.created[:10]}"
    )
    icrs = (
        f"y_icr_right {right:+.3f} ± {std_right:.3f} m, y_icr_left {left:+.3f} ± {std_left:.3f} m, "
        f"x_icr {x:+.3f} ± {std_x:.3f} m (body: x forward, y right)"
    )
    held_out = (
        f"held out of the fit, wheels alone, after {POSE_AFTER_M:g} m: 95 % within {numbers.p95_m:.2f} m with these "
        f"numbers, {numbers.full_p95_m:.2f} m with the whole model ({numbers.model}; icrtool export --for icr)"
    )
    lost = (
        f"not expressible here: x_icr {x:+.3f} m (a turn also moves the robot sideways, {abs(x):.3f} m a radian) "
        f"and the ICRs' middle {(right + left) / 2:+.3f} m right of the body's"
    )
    sentences = [origin, icrs, held_out, lost]
    if numbers.factor_to_old is not None and numbers.twist_width_m is not None:
        old = numbers.twist_width_m / numbers.track_width_m
        sentences.append(
            f"the odometry of the log was made with wheel_separation_multiplier {old:.4f}: the new one replaces it, "
            f"{numbers.factor_to_old:.4f} times the old"
        )
    sentences += [f"WARNING: {_one_line(warning)}" for warning in numbers.warnings]
    return [f"# {line}" for sentence in sentences for line in textwrap.wrap(sentence, TEXT_WIDTH)]


def _diagonal(planar: tuple[float, float, float]) -> str:
    x, y, yaw = (_number(value) for value in planar)
    rest = _number(NOT_PLANAR)
    return f"[{x}, {y}, {rest}, {rest}, {rest}, {yaw}]"


def _number(value: float) -> str:
    """Return a YAML float of four digits: always with a point, or ROS takes it for an integer."""
    if not math.isfinite(value):
        raise ValueError(f"{value} cannot be exported")
    text = f"{value:.4g}"
    if "e" in text:
        mantissa, _, exponent = text.partition("e")
        return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}"
    return text if "." in text else f"{text}.0"


def _date(numbers: ExportNumbers) -> str:
    if not numbers.begin_ns:
        return "at an unknown date"
    return datetime.fromtimestamp(numbers.begin_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M UTC")


def _one_line(text: str) -> str:
    """Return text fit for a comment: whatever a log is called."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


_WRITERS: dict[Target, Callable[[ExportNumbers], str]] = {
    "diff_drive_controller": _diff_drive_controller,
    "clearpath": _clearpath,
    "nav2": _nav2,
    "husarion": _husarion,
    "json": _json,
}
