"""Numbers of a drive as parameters of `robot_localization`: YAML with comments for both of its nodes."""

from __future__ import annotations

import math
import textwrap

from icrtool.calibration.localization import Localization, SourcedValue
from icrtool.calibration.record import Calibration, export_notes
from icrtool.motion.models import FIVE
from icrtool.output.exports.controllers import NOT_PLANAR, export_origin, one_line, yaml_number
from icrtool.output.text_blocks import TEXT_WIDTH

STATE = ("x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz", "vroll", "vpitch", "vyaw", "ax", "ay", "az")
"""The state of robot_localization, in the order of its parameters."""

DEFAULT_PROCESS = (0.05, 0.05, 0.06, 0.03, 0.03, 0.06, 0.025, 0.025, 0.04, 0.01, 0.01, 0.02, 0.01, 0.01, 0.015)
"""Diagonal of robot_localization's own process noise, for each second, in the order of `STATE`."""

NO_IMU_TOPIC, NO_ODOMETRY_TOPIC = "imu/data", "odom"
"""Topics of parameter files of robot_localization, where the log has none."""


def format_localization(calibration: Calibration, numbers: Localization) -> str:
    """Return the YAML of both nodes, without the last line end."""
    lines = [*_header(calibration, numbers), *_filter(numbers)]
    if numbers.yaw_offset_rad is not None and numbers.declination_rad is not None:
        lines += [
            "navsat_transform_node:",
            "  ros__parameters:",
            *_value("magnetic_declination_radians", numbers.declination_rad),
            *_value("yaw_offset", numbers.yaw_offset_rad),
        ]
    return "\n".join([*lines, *_antenna(numbers), *_left_out(numbers)])


def _header(calibration: Calibration, numbers: Localization) -> list[str]:
    """Return origin, warnings, and the covariances that belong in messages."""
    v_x, v_y, yaw_rate = numbers.twist
    rest = yaml_number(NOT_PLANAR)
    row = ", ".join([*map(yaml_number, (v_x.value, v_y.value)), *[rest] * 3, yaml_number(yaw_rate.value)])
    lines = [
        *_comment(export_origin(calibration)),
        *(
            line
            for finding in export_notes(calibration, FIVE)
            for line in _comment(f"WARNING: {one_line(finding.sentence)}")
        ),
        "#",
        *_comment(
            "robot_localization takes the covariances of its inputs from their messages: it has no parameters for them."
        ),
        *_comment("Wheel odometry (twist.covariance); diff_drive_controller has a parameter for it:"),
        f"#   twist_covariance_diagonal: [{row}]",
        *(
            f"#   {name}: {_estimate(estimate, unit)}"
            for name, estimate, unit in (
                ("vx, [0]", v_x, "m²/s²"), ("vy, [7]", v_y, "m²/s²"), ("vyaw, [35]", yaw_rate, "rad²/s²"),
            )
        ),
        *_comment(f"vx, vy, vyaw: {v_x.source}; vz, vroll, vpitch: not shown on a plane", 2),
    ]  # fmt: skip
    if (gyro := numbers.gyro_rate) is not None:
        lines += [
            "# IMU (angular_velocity_covariance), in its driver:",
            f"#   vyaw, [8]: {_estimate(gyro, 'rad²/s²')}",
            *_comment(gyro.source, 2),
        ]
    return [*lines, "#"]


def _filter(numbers: Localization) -> list[str]:
    """Return the parameters of ekf_node."""
    odometry = numbers.wheel_topic
    source = "of the log" if odometry else "your wheel odometry"
    lines = [
        "ekf_filter_node:",
        "  ros__parameters:",
        "    two_d_mode: true  # the motion is estimated in the plane",
        "    world_frame: odom  # without GNSS; the filter of the map frame also takes odometry/gps",
        f"    odom0: {_text(odometry or NO_ODOMETRY_TOPIC)}  # {source}",
        "    # vx, vyaw of the wheels; vy, which they state as 0, with the variance of the sideways motion",
        *_used("odom0_config", {"vx", "vy", "vyaw"}),
        "    odom0_differential: false",
        "    odom0_relative: false",
    ]
    if numbers.gyro_rate is not None:
        imu = numbers.imu_topic
        lines += [
            f"    imu0: {_text(imu or NO_IMU_TOPIC)}  # {'of the log' if imu else 'your IMU'}: its yaw rate",
            *_used("imu0_config", {"vyaw"}),
            "    imu0_differential: false",
            "    imu0_relative: false",
        ]
    if numbers.process:
        for name, estimate in numbers.process.items():
            lines += _inner(f"{name}: {_estimate(estimate)}, {estimate.source}")
        lines += ["    process_noise_covariance:", *_matrix(numbers)]
    return lines


def _matrix(numbers: Localization) -> list[str]:
    """Return the lines of a matrix of 15 rows, with the defaults where the drive shows nothing."""
    noise = {name: estimate.value for name, estimate in numbers.process.items()}
    diagonal = [noise.get(name, default) for name, default in zip(STATE, DEFAULT_PROCESS, strict=True)]
    rows = (
        ", ".join(yaml_number(value) if column == row else "0.0" for column in range(len(STATE)))
        for row, value in enumerate(diagonal)
    )
    lines = [f"       {row}," for row in rows]
    lines[0] = lines[0].replace("       ", "      [", 1)
    lines[-1] = f"{lines[-1][:-1]}]"
    return lines


def _used(key: str, names: set[str]) -> list[str]:
    """Return the lines that state which values of a message are used."""
    words = ["true" if name in names else "false" for name in STATE]
    rows = [", ".join(words[first : first + 3]) for first in range(0, len(STATE), 3)]
    return [f"    {key}:", f"      [{rows[0]},", *(f"       {row}," for row in rows[1:-1]), f"       {rows[-1]}]"]


def _antenna(numbers: Localization) -> list[str]:
    """Return comments with the command that publishes the place of the antenna; none where it is not known."""
    if (antenna := numbers.antenna) is None:
        return []
    offset_text = f"--x {antenna.forward_m:.3f} --y {antenna.left_m:.3f} --z 0.0"
    return [
        *_comment(f"Antenna ({antenna.source}; its height is not shown; gps: the frame_id of your fixes):"),
        f"# ros2 run tf2_ros static_transform_publisher {offset_text} --frame-id base_link --child-frame-id gps",
    ]


def _left_out(numbers: Localization) -> list[str]:
    """Return comments with the parameters that are left out, each with the reason."""
    lines = (line for reason in numbers.left_out for line in _comment(f"- {one_line(reason)}", 0, "  "))
    return ["# Left out, because the drive does not show it:", *lines] if numbers.left_out else []


def _value(key: str, estimate: SourcedValue) -> list[str]:
    """Return a parameter [rad] below a comment with its standard deviation and source."""
    deviation = "" if estimate.std is None else f" ± {estimate.std:.4f} rad ({math.degrees(estimate.std):.1f} deg)"
    return [*_inner(estimate.source), f"    {key}: {estimate.value:z.4f}{f'  #{deviation}' if deviation else ''}"]


def _estimate(estimate: SourcedValue, unit: str = "") -> str:
    """Return a number with its standard deviation, as ``0.0012 ± 0.0003 m²/s²``; ``(no σ)`` without one."""
    deviation = f"± {estimate.std:.2g}" if estimate.std is not None else "(no σ)"
    return f"{estimate.value:.4g} {deviation} {unit}".rstrip()


def _text(topic: str) -> str:
    """Return the name of a topic as YAML, quoted if it has characters that have a meaning there."""
    plain = all(c.isalnum() or c in "/_~-." for c in topic) and topic.isascii()
    return topic if plain else '"' + "".join(c for c in one_line(topic) if c not in '"\\') + '"'


def _inner(text: str) -> list[str]:
    """Return a comment among the parameters of a node."""
    return textwrap.wrap(f"    # {text}", TEXT_WIDTH, subsequent_indent="    #   ")


def _comment(text: str, indent: int = 0, further: str = "") -> list[str]:
    """Return a comment in lines; `further` stands before each line after the first."""
    first = f"# {' ' * indent}"
    return textwrap.wrap(f"{first}{text}", TEXT_WIDTH, subsequent_indent=f"{first}{further}")
