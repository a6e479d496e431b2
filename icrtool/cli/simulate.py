"""``icrtool simulate``, and the options of a simulated drive, which ``study`` has too."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from icrtool.cli import options
from icrtool.cli.options import NOT_NEGATIVE, POSITIVE, Change, Option, changes, flag, numbers, option
from icrtool.cli.printing import Printer

if TYPE_CHECKING:
    from icrtool.config import Config, ConfigSources
    from icrtool.logs.write_log import WheelMessages, WriteOptions
    from icrtool.records.tables import Icrs
    from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors
    from icrtool.simulation.record import TruthTable

PATHS = ("circle", "curved", "lawnmower", "figure-eight", "spins", "straight")
GNSS_NOISE_M = {"rtk": 0.01, "waas": 0.30}
"""Pentzer 2014, Sections 4 and 6.5."""

WHEEL_MESSAGES = ("joint_states", "odometry", "float64_pair", "ticks", "jackal_feedback", "twist_stamped")
DEFAULT_ROBOT = "pentzer-tracked"
DEFAULT_MULTIPLIER = 1.5
"""The true ICRs where none are given: this many half track widths to either side, x 0."""

ENCODER_RATE_HZ, COMMAND_RATE_HZ = 100.0, 10.0


def icrs_text(text: str) -> tuple[float, ...]:
    """Read ``YR,YL,X``."""
    return numbers(text, "YR,YL,X", 3)


def change_text(text: str) -> tuple[float, tuple[float, ...]]:
    """Read ``T:YR,YL,X``."""
    time, _, icrs = text.partition(":")
    return numbers(time, "T:YR,YL,X", 1)[0], numbers(icrs, "T:YR,YL,X", 3)


def span_text(text: str) -> tuple[float, ...]:
    """Read ``BEGIN:END``."""
    span = numbers(text.replace(":", ",", 1) if ":" in text else "", "BEGIN:END", 2)
    if span[1] <= span[0]:
        raise click.BadParameter(f"{text!r} ends before it begins")
    return span


def place_text(text: str) -> tuple[float, ...]:
    """Read ``FORWARD,RIGHT``."""
    return numbers(text, "FORWARD,RIGHT", 2)


def gnss_text(text: str) -> float:
    """Read ``rtk``, ``waas`` or metres."""
    if text in GNSS_NOISE_M:
        return GNSS_NOISE_M[text]
    metres = numbers(text, "rtk, waas or METRES", 1)[0]
    if metres < 0:
        raise click.BadParameter(f"{text!r} is a negative noise")
    return metres


def check_changes(changes: Iterable[tuple[float, object]], duration_s: float) -> None:
    """Refuse a change of the ICRs that a drive is too short for."""
    unreached = next((time for time, _ in changes if time >= duration_s), None)
    if unreached is not None:
        why = f"no change at {unreached:g} s: the drive lasts {duration_s:g} s"
        raise click.BadParameter(why, param_hint="--change")


def degrees(within: click.FloatRange | None = None) -> Callable[[Any], float]:
    """Return what reads an angle in degrees, of a range where one is given, and gives radians."""

    def radians(text: Any) -> float:  # noqa: ANN401 - what click has: a text, or the default
        return math.radians((within or click.FLOAT).convert(text, None, None))

    return radians


DRIVE = (
    ("--icrs icrs_m", "YR,YL,X", icrs_text, "True ICRs [m]; default: by the robot's width, or the study's."),
    ("--path kind", None, click.Choice(PATHS), "Path to drive; study convergence then has no other."),
    ("--duration duration_s", "S", POSITIVE, "Duration of a drive [s]; default: 100, or the study's."),
    ("--speed speed_mps", "MPS", POSITIVE, "Speed of the body; on the spot: of the faster track."),
    ("--radius radius_m", "M", NOT_NEGATIVE, "Radius of circles and of the tightest bends."),
    ("--leg leg_m", "M", POSITIVE, "Length of a lawnmower's legs."),
    ("--encoder-counts", "N", POSITIVE, "Counts per wheel turn; default: the robot's, or 8192."),
    ("--input-noise input_noise_mps", "MPS", NOT_NEGATIVE, "White noise of each sample of the track speeds."),
    ("--input-bias input_bias_mps", "MPS", float, "Bias of both track speeds."),
    ("--gnss gnss_std_m", "rtk|waas|METRES", gnss_text, "Noise of north and east: rtk 0.01 m, waas 0.30 m."),
    ("--gnss-rate gnss_rate_hz", "HZ", POSITIVE, "Fixes per second."),
)
"""Options of `simulate` and `study`: the field of the plan, path or sensors that each sets, metavar, type, help."""

DRIVE_DEFAULTS: dict[str, object] = {
    "kind": "curved", "speed_mps": 0.4, "radius_m": 1.5, "leg_m": 10.0, "input_noise_mps": 0.0, "input_bias_mps": 0.0,
    "gnss_std_m": "rtk", "gnss_rate_hz": 20.0,
}  # fmt: skip
"""Of `simulate`, by field; a study has its own."""

RECORDED = (
    ("--start-heading start_heading_rad", "DEG", degrees(), "Heading at the start, clockwise from north.", 30.0),
    ("--wheels", None, click.Choice(["encoder", "commanded"]),
     "Content of the wheel messages: counted travel, or the motor commands.", "encoder"),
    ("--wheel-messages", None, click.Choice(WHEEL_MESSAGES), "Message type of the wheels.", "joint_states"),
    ("--wheel-rate", "HZ", POSITIVE, "Wheel messages a second; default 100, commanded 10.", None),
    ("--motor-lag motor_lag_s", "S", NOT_NEGATIVE, "Time constant with which the tracks follow their commands.", 0.0),
    ("--antenna", "FORWARD,RIGHT", place_text, "Position of the antenna, from the body origin [m].", "0,0"),
    ("--gnss-delay gnss_delay_s", "S", float, "The stamps of the fixes lag by this.", 0.0),
    ("--heading convention", None, click.Choice(["enu", "ned"]), "Convention of the Imu: REP-103, or REP-145's NED.",
     "enu"),
    ("--heading-std heading_std_rad", "DEG", degrees(NOT_NEGATIVE), "White noise of the heading.", 1.0),
    ("--heading-resolution heading_resolution_rad", "DEG", degrees(NOT_NEGATIVE), "Headings are rounded to this.",
     0.05),
    ("--heading-rate heading_rate_hz", "HZ", POSITIVE, "Headings a second.", 100.0),
    ("--heading-offset heading_offset_rad", "DEG", degrees(), "Added to every heading, clockwise.", 0.0),
    ("--heading-delay heading_delay_s", "S", float, "The stamps of the headings lag by this.", 0.0),
)  # fmt: skip
"""Further options of `simulate`, as in `DRIVE`, with their default."""


def drive_options(*further: Option, **defaults: object) -> Option:
    """Return what adds `DRIVE`, --change and further options, as what changes a path, a plan, and sensors.

    Parameters
    ----------
    defaults : of `DRIVE`, by field, none for the others
    """
    text = "The ICRs become these after T seconds; repeatable."
    change = option("--change changes", "T:YR,YL,X", change_text, text, multiple=True)
    of_drive = [option(*row, default=defaults.get(row[0].split()[-1])) for row in DRIVE]
    of_sensors = changes("sensors", "icrtool.simulation.drives:Sensors", *of_drive, change, *further)
    of_plan = changes("plan", "icrtool.simulation.drives:DrivePlan", of_sensors)
    return changes("path", "icrtool.simulation.drives:PathPlan", of_plan)


@click.command("simulate")
@option("-o --output log", "LOG", options.FILE, "Log to make: .mcap, .bag, or a ROS 2 directory.", required=True)
@flag("--force", "Replace a log that is there.")
@options.SEED
@option("--speeds", "FILE.csv", options.FILE, "Drive these track speeds instead: t_s, v_left_mps, v_right_mps.")
@drive_options(
    option("--outage outages_s", "BEGIN:END", span_text, "No fixes between these seconds; repeatable.", multiple=True),
    *(option(*row, default=default) for *row, default in RECORDED),
    **DRIVE_DEFAULTS,
)
@options.CONFIGURATION
@options.printing(options.QUIET, options.VERBOSE)
def command(
    log: Path, force: bool, seed: int, speeds: Path | None, path: Change[PathPlan], plan: Change[DrivePlan],
    sensors: Change[Sensors], encoder_counts: float | None, wheel_rate: float | None, antenna: tuple[float, float],
    wheel_messages: WheelMessages, convention: Literal["enu", "ned"], settings: ConfigSources, printer: Printer,
) -> None:  # fmt: skip
    """Drive a robot of known ICRs and record the log that its sensors would have written, with the truth beside it.

    The kinematics are the paper's (Eqs. 8-10), integrated without error; the sensors those of its Section 4. The robot
    is pentzer-tracked unless --robot, --config or --set robot.… name another. LOG.truth.csv holds the true pose (about
    latitude 40.7934, longitude -77.86), ICRs and track speeds at every wheel stamp.

    \b
    Example:
      icrtool simulate -o drive.mcap --robot husky-a200 --path figure-eight
      icrtool fit drive.mcap --robot husky-a200
    """  # noqa: D301 - click reads the escape
    from icrtool.logs.write_log import write_log
    from icrtool.output.simulation_files import log_and_truth, read_speeds, truth_path, write_truth
    from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors
    from icrtool.simulation.record import simulate

    config = simulated_robot(settings)
    driven = path(PathPlan()) if speeds is None else read_speeds(speeds)
    duration_s = 100.0 if isinstance(driven, PathPlan) else float(driven.t_s[-1])
    drive = plan(DrivePlan(icrs_m=default_icrs(config), path=driven, duration_s=duration_s))
    check_changes(drive.changes, drive.duration_s)
    counts = encoder_counts or encoder_counts_of(config)
    metres = 2 * math.pi * needed(config, "wheel_radius_m") / counts
    sensed = sensors(Sensors(metres_per_count=metres, antenna_forward_m=antenna[0], antenna_right_m=antenna[1]))
    rate = wheel_rate or (COMMAND_RATE_HZ if sensed.wheels == "commanded" else ENCODER_RATE_HZ)
    sensed = replace(sensed, wheel_rate_hz=rate)
    if sensed.wheels == "commanded":
        drive = replace(drive, command_rate_hz=rate)
    writing = _write_options(log, config, sensed, wheel_messages, convention, counts)
    with log_and_truth(log, force=force) as (fresh_log, fresh_truth):
        recorded, truth = simulate(drive, sensed, seed)
        write_log(fresh_log, recorded, writing)
        write_truth(truth, fresh_truth)
    printer.text(f"{_summary(config, drive, truth, seed)}\n\nwritten to {log}, truth to {truth_path(log)}")
    printer.detail(f"sensors: {sensed}")


def simulated_robot(settings: ConfigSources) -> Config:
    """Return the configuration; without any setting of a robot, it is the paper's."""
    config = settings.load()
    if settings.robot is None and config.robot.track_width_m is None and config.robot.wheel_radius_m is None:
        return settings._replace(robot=DEFAULT_ROBOT).load()
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


def encoder_counts_of(config: Config) -> float:
    """Return the counts of a wheel revolution: the robot's, or the paper's."""
    return config.robot.encoder_counts_per_rev or 8192.0


def _write_options(
    log: Path, config: Config, sensors: Sensors, wheels: WheelMessages, heading: Literal["enu", "ned"], counts: float
) -> WriteOptions:
    from icrtool.errors import ConfigError
    from icrtool.logs.write_log import WriteOptions

    if log.suffix not in ("", ".mcap", ".bag"):
        raise ConfigError(
            log,
            f"{log.suffix} is not written",
            "name an .mcap or .bag file, or for a ROS 2 bag a directory, without a dot",
        )
    return WriteOptions(
        container="mcap" if log.suffix == ".mcap" else "bag" if log.suffix == ".bag" else "db3",
        wheels=wheels,
        heading=heading,
        wheel_radius_m=needed(config, "wheel_radius_m"),
        track_width_m=needed(config, "track_width_m"),
        counts_per_rev=counts,
        heading_std_deg=math.degrees(sensors.heading_std_rad),
    )


def _summary(config: Config, plan: DrivePlan, truth: TruthTable, seed: int) -> str:
    import numpy as np

    from icrtool.simulation.drives import PathPlan

    distance_m = float(np.hypot(np.diff(truth["north_m"]), np.diff(truth["east_m"])).sum())
    what = f"{plan.path.kind} path" if isinstance(plan.path, PathPlan) else "track speeds as given"
    lines = [
        f"robot  {config.robot.name or 'as configured'}, b = {needed(config, 'track_width_m'):g} m",
        f"drive  {what}, {distance_m:.1f} m in {plan.duration_s:g} s, seed {seed}",
        f"ICRs   y right {plan.icrs_m[0]:+.3f}, y left {plan.icrs_m[1]:+.3f}, x {plan.icrs_m[2]:+.3f} m",
    ]
    lines += [
        f"       from {time:g} s on {right:+.3f}, {left:+.3f}, {x:+.3f} m" for time, (right, left, x) in plan.changes
    ]
    return "\n".join(lines)
