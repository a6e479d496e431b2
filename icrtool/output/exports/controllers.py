"""A calibration as configuration for other people's controllers and filters: YAML with comments, or JSON."""

from __future__ import annotations

import math
import textwrap
from datetime import UTC, datetime
from typing import get_args

import msgspec
import numpy as np

from icrtool import __version__
from icrtool.calibration.held_out import TWIST_OVER_M
from icrtool.calibration.record import POSE_AFTER_M, Calibration, export_notes, factor_to_old
from icrtool.errors import DataError
from icrtool.kernels.window_residuals import OMEGA, VX, VY
from icrtool.motion.models import FIVE, TERMS, Term, wheel_motion
from icrtool.output.files.formats import json_bytes
from icrtool.output.text_blocks import TEXT_WIDTH
from icrtool.output.text_format import controller_error_text
from icrtool.records.calibration_document import ControllerErrors
from icrtool.records.choices import ControllerTarget
from icrtool.records.plain_data import plain_value
from icrtool.records.run import ICR_COLUMNS

CONTROLLER_TARGETS: tuple[ControllerTarget, ...] = get_args(ControllerTarget)
"""Names of the targets."""

EXPORT_SCHEMA = "icrtool/export/1"
"""Schema of an export of target ``json``."""

NOT_PLANAR = 0.001
"""Variance of z, roll and pitch, which a plane does not show: the value the controller's own documentation gives."""

ODOMETRY_USED = (6, 11)
"""Places of vx and vyaw among the 15 values of robot_localization: x y z roll pitch yaw, velocities, accelerations."""


CONTROLLER_PLACES: dict[ControllerTarget, tuple[str, ...]] = {
    "diff_drive_controller": ("diff_drive_controller:  # your controller's name", "  ros__parameters:"),
    "clearpath": (
        "# robot.yaml: merge into its platform section", "platform:", "  extras:", "    ros_parameters:",
        "      platform_velocity_controller:",
    ),
    "husarion": (
        "# husarion_ugv_controller: WH0x_controller.yaml, passed as controller_config_path", "/**:",
        "  drive_controller:", "    ros__parameters:",
    ),
}  # fmt: skip
"""Lines above the parameters of a diff_drive_controller in each robot's configuration."""


NAV2 = """\
# robot_localization, odom frame: wheels give vx and vyaw, with the twist covariance of the message:
# set there twist_covariance_diagonal: {twist}
ekf_filter_node:
  ros__parameters:
    two_d_mode: true
    world_frame: odom
    odom0: odom  # your wheel odometry
    odom0_config: [{used}]
    odom0_differential: false
    odom0_relative: false
# AMCL: shares of variance: turn by turn, turn by distance, distance by distance, distance by turn
amcl:
  ros__parameters:
    robot_model_type: "nav2_amcl::DifferentialMotionModel"
"""
"""Parameters of AMCL and of robot_localization, with places for covariances and noises."""


def format_export(calibration: Calibration, target: ControllerTarget) -> str:
    """Return the text to paste, without the last line end.

    Notes
    -----
    Keys as documented by ros2_controllers (diff_drive_controller parameters), Clearpath (robot.yaml,
    ``platform.extras.ros_parameters``), Husarion (``WH0x_controller.yaml``), nav2 (AMCL) and robot_localization.

    Raises
    ------
    DataError
        The drives were too short to measure covariances, which every target but ``icr`` holds.
    """
    if target == "icr":
        return format_twist(calibration)
    errors = calibration.controller_errors
    if errors is None:
        advice = "covariances need a longer drive"
        raise DataError(calibration.name or calibration.log_names(), "too short to measure the error growth", advice)
    begin_ns, date, distance_m = _driven(calibration)
    numbers, robot = calibration.controller, calibration.robot
    if target == "json":
        document = {
            "schema": EXPORT_SCHEMA,
            "tool_version": __version__,
            "date": date,
            "log": calibration.log_names(),
            "begin_ns": begin_ns,
            "distance_m": distance_m,
            "robot": robot.name,
            "track_width_m": calibration.width_m,
            "wheel_radius_m": robot.wheel_radius_m,
            "model": calibration.recommended,
            "created": calibration.created or "",
            "separation_multiplier": numbers.multiplier,
            "separation_multiplier_std": numbers.multiplier_std,
            "separation_multiplier_next_std": numbers.multiplier_next_std,
            "left_radius_multiplier": numbers.left_radius,
            "left_radius_multiplier_std": numbers.left_radius_std,
            "right_radius_multiplier": numbers.right_radius,
            "right_radius_multiplier_std": numbers.right_radius_std,
            "icrs_m": [calibration.geometry[name] for name in ICR_COLUMNS],
            "icr_std_m": [calibration.geometry_std[name] for name in ICR_COLUMNS],
            **msgspec.structs.asdict(errors),
            "warnings": [finding.sentence for finding in export_notes(calibration)],
            "twist_width_m": robot.twist_width_m or None,
        }
        return json_bytes(document).decode().rstrip("\n")
    return "\n".join([*_header(calibration, errors), *_parameters(calibration, errors, target)])


def _driven(calibration: Calibration) -> tuple[int, str, float]:
    """Return stamp and date of the first drive, and the distance [m] of all drives."""
    begin_ns = min(log.begin_ns for log in calibration.logs)
    date = "at an unknown date"
    if begin_ns:
        date = datetime.fromtimestamp(begin_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M UTC")
    return begin_ns, date, sum(log.distance_m for log in calibration.logs)


def export_origin(calibration: Calibration) -> str:
    """Return a line with the program, the logs, their date and distance, and the robot."""
    _, date, distance_m = _driven(calibration)
    robot = f", {one_line(name)}" if (name := calibration.robot.name) else ""
    # The calibration of a report has no date, so that the same run gives the same file.
    fitted = f", fitted {calibration.created[:10]}" if calibration.created else ""
    driven = f"driven {date}, {distance_m:.0f} m"
    return f"icrtool {__version__}: {one_line(calibration.log_names())}, {driven}{robot}{fitted}"


def _parameters(calibration: Calibration, errors: ControllerErrors, target: ControllerTarget) -> list[str]:
    """Return the lines of YAML: for a diff_drive_controller of the target, or for nav2 and robot_localization."""
    rest = yaml_number(NOT_PLANAR)
    pose, twist = (
        f"[{yaml_number(x)}, {yaml_number(y)}, {rest}, {rest}, {rest}, {yaml_number(yaw)}]"
        for x, y, yaw in (errors.pose_variance, errors.twist_variance)
    )
    if target == "nav2":
        used = ", ".join("true" if place in ODOMETRY_USED else "false" for place in range(15))
        alphas = enumerate((*errors.turn_noise, *errors.way_noise), start=1)
        return [
            *NAV2.format(twist=twist, used=used).splitlines(),
            *(f"    alpha{i}: {yaml_number(alpha)}" for i, alpha in alphas),
        ]
    numbers, radius = calibration.controller, calibration.robot.wheel_radius_m
    lines = [f"wheel_separation: {yaml_number(calibration.width_m)}"]
    if radius is not None:
        lines.append(f"wheel_radius: {yaml_number(radius)}")
    for key, value, std, next_std in (
        ("wheel_separation_multiplier", numbers.multiplier, numbers.multiplier_std, numbers.multiplier_next_std),
        ("left_wheel_radius_multiplier", numbers.left_radius, numbers.left_radius_std, numbers.left_radius_next_std),
        (
            "right_wheel_radius_multiplier",
            numbers.right_radius,
            numbers.right_radius_std,
            numbers.right_radius_next_std,
        ),
    ):
        deviation = f"± {std:.4f} here, ± {next_std:.4f} on the next drive" if std > 0.0 else "not estimated"
        lines.append(f"{key}: {value:.4f}  # {deviation}")
    lines += [
        f"# after {POSE_AFTER_M:g} m; x forward, y left, z, roll, pitch, yaw",
        f"pose_covariance_diagonal: {pose}",
        f"# of velocities over {TWIST_OVER_M:g} m",
        f"twist_covariance_diagonal: {twist}",
    ]
    place = CONTROLLER_PLACES[target]
    indent = len(place[-1]) - len(place[-1].lstrip()) + 2
    return [*place, *textwrap.indent("\n".join(lines), " " * indent).splitlines()]


def _header(calibration: Calibration, errors: ControllerErrors) -> list[str]:
    """Return the comments at the top: where the numbers come from, and what they cannot express."""
    (right, left, x), (std_right, std_left, std_x) = (
        [numbers_by_name[name] for name in ICR_COLUMNS]
        for numbers_by_name in (calibration.geometry, calibration.geometry_std)
    )
    icrs = (
        f"y_icr_right {right:+z.3f} ± {std_right:.3f} m, y_icr_left {left:+z.3f} ± {std_left:.3f} m, "
        f"x_icr {x:+z.3f} ± {std_x:.3f} m (body: x forward, y right)"
    )
    held_out = f"{controller_error_text(errors)}, which icrtool export --for icr writes"
    lost = (
        f"not expressible here: x_icr {x:+z.3f} m (a turn also moves the robot sideways, {abs(x):.3f} m a radian) "
        f"and the ICRs' middle {(right + left) / 2:+z.3f} m right of the body's"
    )
    sentences = [export_origin(calibration), icrs, held_out, lost]
    if (factor := factor_to_old(calibration)) is not None:
        old = calibration.controller.multiplier / factor
        sentences.append(
            f"the odometry of the log was made with wheel_separation_multiplier {old:.4f}: the new value replaces "
            f"it, and is {factor:.4f} times the old value"
        )
    sentences += [f"WARNING: {one_line(finding.sentence)}" for finding in export_notes(calibration, FIVE)]
    return [
        line for sentence in sentences for line in textwrap.wrap(f"# {sentence}", TEXT_WIDTH, subsequent_indent="# ")
    ]


def yaml_number(value: float) -> str:
    """Return a number as YAML, of four digits with a point; without a point ROS would read an integer."""
    if not math.isfinite(value):
        raise ValueError(f"{value} cannot be exported")
    mantissa, e, exponent = f"{value:.4g}".partition("e")
    return f"{mantissa if '.' in mantissa else f'{mantissa}.0'}{e}{exponent}"


def one_line(text: str) -> str:
    """Return a text on one line for a comment, without the line ends that the name of a log may hold."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


TWIST_SCHEMA = "icrtool/twist/1"
"""Schema of an export of target ``icr``."""

AXES = {VX: "v_x", VY: "v_y", OMEGA: "yaw_rate"}
"""Names of the outputs in an export of target ``icr``, by axis."""

SYMBOLS = {
    "v": "(v_left + v_right) / 2",
    "w": "(v_right - v_left) / b",
    "spin": "abs(v_left - v_right) / (abs(v_left) + abs(v_right)), 0 where both are 0",
    "b": "track_width_m",
}
"""Meanings of the symbols in the formulas of an export of target ``icr``."""


def format_twist(calibration: Calibration) -> str:
    """Return a calibration as JSON without the last line end.

    `v_x`, `v_y` and `yaw_rate` are each the sum of the products of value and formula.
    """
    fitted_model = calibration.fitted
    terms = [TERMS[name] for name in fitted_model.model.terms]
    signs = np.array([sign_in_rep103(term) for term in terms])
    fixed = [term for term in TERMS.values() if term.nominal and term not in terms]
    geometry, stds = calibration.geometry, calibration.geometry_std
    p95, expected = calibration.held_out_m("recommended", POSE_AFTER_M)
    document = {
        "schema": TWIST_SCHEMA,
        "tool_version": __version__,
        "created": calibration.created or "",
        "robot": plain_value(calibration.robot),
        "frame": "REP-103: x forward, y left, yaw counter-clockwise",
        "inputs": "v_left, v_right [m/s]: wheel speeds at the configured radius, forward positive",
        "outputs": "v_x, v_y [m/s], yaw_rate [rad/s]",
        "model": fitted_model.model.name,
        "symbols": SYMBOLS,
        "track_width_m": calibration.width_m,
        "terms": [
            {"name": term.name, "output": AXES[term.axis], "formula": term.formula, "value": value, "std": std}
            for term, value, std in [
                *((term, sign_in_rep103(term) * term.nominal, 0.0) for term in fixed),
                *zip(terms, (signs * fitted_model.parameters).tolist(), fitted_model.std.tolist(), strict=True),
            ]
        ],
        "covariance": {
            "of": list(fitted_model.model.terms),
            "matrix": (np.outer(signs, signs) * fitted_model.covariance).tolist(),
        },
        "icrs": {
            "y_icr_right_m": -geometry["y_icr_right_m"], "y_icr_left_m": -geometry["y_icr_left_m"],
            "x_icr_m": geometry["x_icr_m"], "std": {name: stds[name] for name in ICR_COLUMNS},
        },
        "held_out": {"horizon_m": POSE_AFTER_M, "p95_m": p95, "expected_m": expected},
        "logs": plain_value(calibration.logs),
        "warnings": list(calibration.warnings),
    }  # fmt: skip
    return json_bytes(document).decode().rstrip("\n")


def sign_in_rep103(term: Term) -> float:
    """Return the sign that a parameter changes by in REP-103, where y points left and a turn w is counter-clockwise."""
    left, right = np.array([0.3]), np.array([0.1])
    same = term.column(wheel_motion(left, right, 1.0))[0] == term.column(wheel_motion(right, left, 1.0))[0]
    return 1.0 if same == (term.axis == VX) else -1.0
