"""``icrtool simulate``, and the options of a simulated drive, which ``study`` has too."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from icrtool.cli import options
from icrtool.cli.options import (
    FILE,
    NOT_NEGATIVE,
    POSITIVE,
    Command,
    Option,
    add_options,
    flag,
    numbers,
    option,
)
from icrtool.cli.printing import Printer

if TYPE_CHECKING:
    from icrtool.config import Config, ConfigSources
    from icrtool.logs.writing.log import WriteOptions
    from icrtool.records.tables import Icrs
    from icrtool.simulation.drives import DrivePlan, Sensors
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

MANY = object()
"""In place of a default: an option that may be given more than once."""

RECORDED = (
    ("--start-heading start_heading_rad", "DEG", degrees(), "Heading at the start, clockwise from north.", 30.0),
    ("--wheels", None, click.Choice(["encoder", "commanded"]),
     "Content of the wheel messages: counted travel, or the motor commands.", "encoder"),
    ("--wheel-messages", None, click.Choice(WHEEL_MESSAGES), "Message type of the wheels.", "joint_states"),
    ("--wheel-rate wheel_rate_hz", "HZ", POSITIVE, "Wheel messages a second; default 100, commanded 10.", None),
    ("--motor-lag motor_lag_s", "S", NOT_NEGATIVE, "Time constant with which the tracks follow their commands.", 0.0),
    ("--outage outages_s", "BEGIN:END", span_text, "No fixes between these seconds; repeatable.", MANY),
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
"""Further options of `simulate`, as in `DRIVE`, with their default; the one with an empty one is repeatable."""


def drive_options(**defaults: object) -> Option:
    """Return what adds `DRIVE` and --change to a command; `defaults`: by field, none for the others."""
    text = "The ICRs become these after T seconds; repeatable."
    change = option("--change changes", "T:YR,YL,X", change_text, text, multiple=True)
    of_drive = [option(*row, default=defaults.get(row[0].split()[-1])) for row in DRIVE]
    return lambda command: add_options(command, *of_drive, change)


def recorded_options(command: Command) -> Command:
    """Add `RECORDED` to a command."""
    return add_options(
        command,
        *(
            option(*row, default=None if default is MANY else default, multiple=default is MANY)
            for *row, default in RECORDED
        ),
    )


def given_fields(record: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that set fields of a record, those that were given or have a default."""
    names = (field.name for field in fields(record))
    return {name: given[name] for name in names if given.get(name) not in (None, ())}


@click.command("simulate")
@option("-o --output log", "LOG", FILE, "Log to make: .mcap, .bag, or a ROS 2 directory.", required=True)
@flag("--force", "Replace a log that is there.")
@options.SEED
@option("--speeds", "FILE.csv", FILE, "Drive these track speeds instead: t_s, v_left_mps, v_right_mps.")
@drive_options(**DRIVE_DEFAULTS)
@recorded_options
@options.CONFIGURATION
@options.printing(options.QUIET, options.VERBOSE)
def command(log: Path, settings: ConfigSources, printer: Printer, **given: Any) -> None:
    """Drive a robot of known ICRs and record the log that its sensors would have written, with the truth beside it.

    The kinematics are the paper's (Eqs. 8-10), integrated without error; the sensors those of its Section 4. The robot
    is pentzer-tracked unless --robot, --config or --set robot.… name another. LOG.truth.csv holds the true pose (about
    latitude 40.7934, longitude -77.86), ICRs and track speeds at every wheel stamp.

    \b
    Example:
      icrtool simulate -o drive.mcap --robot husky-a200 --path figure-eight
      icrtool fit drive.mcap --robot husky-a200
    """  # noqa: D301 - click reads the escape
    config = simulated_robot(settings)
    plan, sensors = _plan(config, given), _sensors(config, given)
    writing = _write_options(log, config, sensors, given)
    from icrtool.logs.writing.log import write_log
    from icrtool.output.files.truth_file import log_and_truth, truth_path, write_truth
    from icrtool.simulation.record import simulate

    with log_and_truth(log, force=given["force"]) as (fresh_log, fresh_truth):
        recorded, truth = simulate(plan, sensors, given["seed"])
        write_log(fresh_log, recorded, writing)
        write_truth(truth, fresh_truth)
    printer.text(f"{_summary(config, plan, truth, given)}\n\nwritten to {log}, truth to {truth_path(log)}")
    printer.detail(f"sensors: {sensors}")


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


def _plan(config: Config, given: dict[str, Any]) -> DrivePlan:
    from icrtool.simulation.drives import DrivePlan
    from icrtool.simulation.paths import PathPlan

    path: Any = PathPlan(**given_fields(PathPlan, given))
    duration = given["duration_s"]
    if given["speeds"] is not None:
        from icrtool.output.files.truth_file import read_speeds

        path = read_speeds(given["speeds"])
        duration = duration if duration is not None else float(path.t_s[-1])
    duration = duration if duration is not None else 100.0
    check_changes(given["changes"], duration)
    commanded = given["wheels"] == "commanded"
    return DrivePlan(**given_fields(DrivePlan, given) | {
        "icrs_m": given["icrs_m"] or default_icrs(config), "path": path, "duration_s": duration,
        "command_rate_hz": (given["wheel_rate_hz"] or COMMAND_RATE_HZ) if commanded else None,
    })  # fmt: skip


def _sensors(config: Config, given: dict[str, Any]) -> Sensors:
    from icrtool.simulation.drives import Sensors

    default_rate = COMMAND_RATE_HZ if given["wheels"] == "commanded" else ENCODER_RATE_HZ
    forward, right = given["antenna"]
    return Sensors(**given_fields(Sensors, given) | {
        "wheel_rate_hz": given["wheel_rate_hz"] or default_rate,
        "metres_per_count": 2 * math.pi * needed(config, "wheel_radius_m") / encoder_counts(config, given),
        "antenna_forward_m": forward, "antenna_right_m": right,
    })  # fmt: skip


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

    distance_m = float(np.hypot(np.diff(truth["north_m"]), np.diff(truth["east_m"])).sum())
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
