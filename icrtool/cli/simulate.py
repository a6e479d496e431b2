"""``icrtool simulate``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from icrtool.cli import options
from icrtool.cli.drive_options import CHANGE, PATHS, check_changes, gnss_text, icrs_text, place_text, span_text
from icrtool.cli.options import NOT_NEGATIVE, POSITIVE

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.logs.writing.log import WriteOptions
    from icrtool.simulation.drives import DrivePlan, Icrs, Sensors
    from icrtool.simulation.record import TruthTable

WHEEL_MESSAGES = ("joint_states", "odometry", "float64_pair", "ticks", "jackal_feedback", "twist_stamped")
DEFAULT_ROBOT = "pentzer-tracked"
DEFAULT_MULTIPLIER = 1.5
"""The true ICRs where none are given: this many half track widths to either side, x 0."""

ENCODER_RATE_HZ, COMMAND_RATE_HZ = 100.0, 10.0


@click.command("simulate")
@click.option(
    "-o",
    "--output",
    "log",
    metavar="LOG",
    required=True,
    type=click.Path(path_type=Path),
    help="Log to make: .mcap, .bag, or a ROS 2 directory.",
)
@click.option("--force", is_flag=True, help="Replace a log that is there.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Seed of all noise; the same seed, the same bytes.",
)
@click.option("--path", "kind", type=click.Choice(PATHS), default="curved", show_default=True, help="What is driven.")
@click.option(
    "--speeds",
    metavar="FILE.csv",
    type=click.Path(path_type=Path),
    help="Drive these track speeds instead: t_s, v_left_mps, v_right_mps.",
)
@click.option(
    "--duration", metavar="S", type=POSITIVE, help="Length of the drive [s]; default 100, or that of --speeds."
)
@click.option(
    "--speed",
    metavar="MPS",
    type=POSITIVE,
    default=0.4,
    show_default=True,
    help="Speed of the body; of the faster track on the spot.",
)
@click.option(
    "--radius",
    metavar="M",
    type=NOT_NEGATIVE,
    default=1.5,
    show_default=True,
    help="Radius of circles and of the tightest bends.",
)
@click.option(
    "--leg", metavar="M", type=POSITIVE, default=10.0, show_default=True, help="Length of a lawnmower's legs."
)
@click.option(
    "--start-heading",
    metavar="DEG",
    type=float,
    default=30.0,
    show_default=True,
    help="Heading at the start, clockwise from north.",
)
@click.option(
    "--icrs",
    metavar="YR,YL,X",
    type=icrs_text,
    help="True ICRs [m]; default: 1.5 times half the track width to either side, x 0.",
)
@CHANGE
@click.option(
    "--wheels",
    type=click.Choice(["encoder", "commanded"]),
    default="encoder",
    show_default=True,
    help="Content of the wheel messages: true travel, counted travel, or the motor commands.",
)
@click.option(
    "--wheel-messages",
    type=click.Choice(WHEEL_MESSAGES),
    default="joint_states",
    show_default=True,
    help="Message type of the wheels.",
)
@click.option("--wheel-rate", metavar="HZ", type=POSITIVE, help="Wheel messages a second; default 100, commanded 10.")
@click.option(
    "--encoder-counts", metavar="N", type=POSITIVE, help="Counts of a wheel revolution; default the robot's, or 8192."
)
@click.option(
    "--motor-lag",
    metavar="S",
    type=NOT_NEGATIVE,
    default=0.0,
    show_default=True,
    help="Time constant with which the tracks follow their commands.",
)
@click.option(
    "--input-noise",
    metavar="MPS",
    type=NOT_NEGATIVE,
    default=0.0,
    show_default=True,
    help="White noise of the track speeds, a sample.",
)
@click.option(
    "--input-bias", metavar="MPS", type=float, default=0.0, show_default=True, help="Bias of both track speeds."
)
@click.option(
    "--gnss",
    metavar="rtk|waas|METRES",
    type=gnss_text,
    default="rtk",
    show_default=True,
    help="Noise of north and east: 0.01, 0.30 or so many metres.",
)
@click.option("--gnss-rate", metavar="HZ", type=POSITIVE, default=20.0, show_default=True, help="Fixes a second.")
@click.option(
    "--outage",
    "outages",
    metavar="BEGIN:END",
    type=span_text,
    multiple=True,
    help="No fixes between these seconds; repeatable.",
)
@click.option(
    "--antenna",
    metavar="FORWARD,RIGHT",
    type=place_text,
    default="0,0",
    help="Position of the antenna, from the body origin [m].",
)
@click.option(
    "--gnss-delay", metavar="S", type=float, default=0.0, show_default=True, help="The stamps of the fixes lag by this."
)
@click.option(
    "--heading",
    "convention",
    type=click.Choice(["enu", "ned"]),
    default="enu",
    show_default=True,
    help="Convention of the Imu: REP-103, or REP-145's NED.",
)
@click.option(
    "--heading-std",
    metavar="DEG",
    type=NOT_NEGATIVE,
    default=1.0,
    show_default=True,
    help="White noise of the heading.",
)
@click.option(
    "--heading-resolution",
    metavar="DEG",
    type=NOT_NEGATIVE,
    default=0.05,
    show_default=True,
    help="Headings are rounded to this.",
)
@click.option(
    "--heading-rate", metavar="HZ", type=POSITIVE, default=100.0, show_default=True, help="Headings a second."
)
@click.option(
    "--heading-offset",
    metavar="DEG",
    type=float,
    default=0.0,
    show_default=True,
    help="Added to every heading, clockwise.",
)
@click.option(
    "--heading-delay",
    metavar="S",
    type=float,
    default=0.0,
    show_default=True,
    help="The stamps of the headings lag by this.",
)
@options.configuration
@options.verbosity
def command(
    log: Path, config_file: Path | None, robot: str | None, sets: tuple[str, ...], quiet: bool, verbose: bool,
    **given: Any,
) -> None:  # fmt: skip
    """Drive a robot of known ICRs and record the log that its sensors would have written, with the truth beside it.

    The kinematics are the paper's (Eqs. 8-10), integrated without error; the sensors those of its Section 4. The robot
    is pentzer-tracked unless --robot, --config or --set robot.… name another. LOG.truth.csv holds the true pose (about
    latitude 40.7934, longitude -77.86), ICRs and track speeds at every wheel stamp.

    \b
    Example:
      icrtool simulate -o drive.mcap --robot husky-a200 --path lawnmower --gnss waas
      icrtool fit drive.mcap --robot husky-a200
    """  # noqa: D301 - click reads the escape
    config = simulated_robot(config_file, robot, sets)
    plan, sensors = _plan(config, given), _sensors(config, given)
    writing = _write_options(log, config, sensors, given)
    from icrtool.logs.writing.log import write_log
    from icrtool.output.truth_file import log_and_truth, truth_path, write_truth
    from icrtool.simulation.record import simulate

    with log_and_truth(log, force=given["force"]) as (fresh_log, fresh_truth):
        recorded, truth = simulate(plan, sensors, given["seed"])
        write_log(fresh_log, recorded, writing)
        write_truth(truth, fresh_truth)
    if not quiet:
        click.echo(_summary(config, plan, truth, given))
        click.echo(f"\nwritten to {log}, truth to {truth_path(log)}")
    if verbose:
        click.echo(f"sensors: {sensors}", err=True)


def simulated_robot(config_file: Path | None, robot: str | None, sets: tuple[str, ...]) -> Config:
    """Return the configuration; without any setting of a robot, it is the paper's."""
    config = options.load(config_file, robot, sets)
    if robot is None and config.robot.track_width_m is None and config.robot.wheel_radius_m is None:
        return options.load(config_file, DEFAULT_ROBOT, sets)
    return config


def default_icrs(config: Config) -> Icrs:
    """Return the true ICRs where none are given."""
    half = DEFAULT_MULTIPLIER * needed(config, "track_width_m") / 2
    return half, -half, 0.0


def needed(config: Config, key: Literal["track_width_m", "wheel_radius_m"]) -> float:
    """Return a number of the robot that a simulation cannot do without."""
    from icrtool.errors import ConfigError

    value: float | None = getattr(config.robot, key)
    if value is None:
        raise ConfigError(f"robot.{key}", "needed to simulate a robot", f"--set robot.{key}=…, or --robot NAME")
    return value


def _plan(config: Config, given: dict[str, Any]) -> DrivePlan:
    from icrtool.simulation.drives import DrivePlan
    from icrtool.simulation.paths import PathPlan

    path: Any = PathPlan(given["kind"], given["speed"], given["radius"], given["leg"])
    duration = given["duration"]
    if given["speeds"] is not None:
        from icrtool.output.truth_file import read_speeds

        path = read_speeds(given["speeds"])
        duration = duration if duration is not None else float(path.t_s[-1])
    duration = duration if duration is not None else 100.0
    check_changes(given["changes"], duration)
    rate = given["wheel_rate"] or COMMAND_RATE_HZ
    return DrivePlan(
        icrs_m=given["icrs"] or default_icrs(config),
        changes=given["changes"],
        path=path,
        duration_s=duration,
        start_heading_rad=math.radians(given["start_heading"]),
        command_rate_hz=rate if given["wheels"] == "commanded" else None,
        motor_lag_s=given["motor_lag"],
    )


def _sensors(config: Config, given: dict[str, Any]) -> Sensors:
    from icrtool.simulation.drives import Sensors

    default_rate = COMMAND_RATE_HZ if given["wheels"] == "commanded" else ENCODER_RATE_HZ
    return Sensors(
        wheels=given["wheels"],
        wheel_rate_hz=given["wheel_rate"] or default_rate,
        metres_per_count=2 * math.pi * needed(config, "wheel_radius_m") / encoder_counts(config, given),
        input_noise_mps=given["input_noise"],
        input_bias_mps=given["input_bias"],
        gnss_std_m=given["gnss"],
        gnss_rate_hz=given["gnss_rate"],
        outages_s=given["outages"],
        heading_std_rad=math.radians(given["heading_std"]),
        heading_resolution_rad=math.radians(given["heading_resolution"]),
        heading_rate_hz=given["heading_rate"],
        heading_offset_rad=math.radians(given["heading_offset"]),
        antenna_forward_m=given["antenna"][0],
        antenna_right_m=given["antenna"][1],
        gnss_delay_s=given["gnss_delay"],
        heading_delay_s=given["heading_delay"],
    )


def encoder_counts(config: Config, given: dict[str, Any]) -> float:
    """Return the counts of a wheel revolution: as given, the robot's, or the paper's."""
    counts: float = given["encoder_counts"] or config.robot.encoder_counts_per_rev or 8192.0
    return counts


def _write_options(log: Path, config: Config, sensors: Sensors, given: dict[str, Any]) -> WriteOptions:
    from icrtool.errors import ConfigError
    from icrtool.logs.writing.log import WriteOptions

    if log.suffix not in ("", ".mcap", ".bag"):
        raise ConfigError(
            log,
            f"{log.suffix} is not written",
            "name an .mcap or .bag file, or for a ROS 2 bag a directory, without a dot",
        )
    return WriteOptions(
        container="mcap" if log.suffix == ".mcap" else "bag" if log.suffix == ".bag" else "db3",
        wheels=given["wheel_messages"],
        heading=given["convention"],
        wheel_radius_m=needed(config, "wheel_radius_m"),
        track_width_m=needed(config, "track_width_m"),
        counts_per_rev=encoder_counts(config, given),
        heading_std_deg=math.degrees(sensors.heading_std_rad),
    )


def _summary(config: Config, plan: DrivePlan, truth: TruthTable, given: dict[str, Any]) -> str:
    import numpy as np

    distance_m = float(np.hypot(np.diff(truth.north_m), np.diff(truth.east_m)).sum())
    what = "track speeds as given" if given["speeds"] is not None else f"{given['kind']} path"
    lines = [
        f"robot  {config.robot.name or 'as configured'}, b = {needed(config, 'track_width_m'):g} m",
        f"drive  {what}, {distance_m:.1f} m in {plan.duration_s:g} s, seed {given['seed']}",
        f"ICRs   y right {plan.icrs_m[0]:+.3f}, y left {plan.icrs_m[1]:+.3f}, x {plan.icrs_m[2]:+.3f} m",
    ]
    lines += [
        f"       from {time:g} s on {right:+.3f}, {left:+.3f}, {x:+.3f} m" for time, (right, left, x) in plan.changes
    ]
    return "\n".join(lines)
