"""``icrtool simulate``, which writes one drive as a log, and ``icrtool study``, which filters many drives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import click

from icrtool.cli import lazy_imports, options
from icrtool.cli.inputs import RUNS_FOLDER
from icrtool.cli.options import (
    FILE,
    NOT_NEGATIVE,
    POSITIVE,
    Option,
    RecordChange,
    choice,
    flag,
    numbers_reader,
    option,
    options_as_record,
)
from icrtool.cli.printing import Printer
from icrtool.records.choices import HeadingConvention, PathKind, PresetName, StudyName, WheelMessages

with lazy_imports():
    from icrtool import errors
    from icrtool.logs import write_log
    from icrtool.output import simulation_files
    from icrtool.output.tables import study as study_tables
    from icrtool.records import run as runs
    from icrtool.simulation import drives, friction, studies

if TYPE_CHECKING:
    from icrtool.config import Config, ConfigSources
    from icrtool.records.tables import Icrs
    from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors, TruthTable
    from icrtool.simulation.friction import FrictionRobot
    from icrtool.simulation.study_records import Study, StudyRequest

GNSS_NOISE_M = {"rtk": 0.01, "waas": 0.30}
"""Standard deviation of the position noise by kind of receiver [m] (Pentzer 2014, Sections 4 and 6.5)."""

DEFAULT_ROBOT = "pentzer-tracked"
"""Robot of a simulation without a configured robot."""

DEFAULT_MULTIPLIER = 1.5
"""Default of the true y ICRs, in half track widths. The default of x is 0."""

ENCODER_RATE_HZ, COMMAND_RATE_HZ = 100.0, 10.0
"""Default rates of wheel messages with counted travel, and with motor commands [Hz]."""

PAPER_COUNTS = 8192.0
"""Encoder counts of a wheel revolution, for a robot without configured counts."""


def change_text(text: str) -> tuple[float, tuple[float, ...]]:
    """Return the time [s] and the ICRs [m] in a text ``T:YR,YL,X``."""
    time, _, icrs = text.partition(":")
    return numbers_reader("T:YR,YL,X", 1)(time)[0], numbers_reader("T:YR,YL,X", 3)(icrs)


def span_text(text: str) -> tuple[float, ...]:
    """Return start and end [s] in a text ``BEGIN:END``; refuse a span that ends before it begins."""
    span = numbers_reader("BEGIN:END", 2)(text.replace(":", ",", 1) if ":" in text else "")
    if span[1] <= span[0]:
        raise click.BadParameter(f"{text!r} ends before it begins")
    return span


def gnss_text(text: str) -> float:
    """Return the standard deviation of positions [m] in a text: ``rtk``, ``waas`` or a number of metres."""
    if text in GNSS_NOISE_M:
        return GNSS_NOISE_M[text]
    noise_m = numbers_reader("rtk, waas or METRES", 1)(text)[0]
    if noise_m < 0:
        raise click.BadParameter(f"{text!r} is a negative noise")
    return noise_m


def check_changes(changes: Iterable[tuple[float, object]], duration_s: float) -> None:
    """Refuse a change of the ICRs after the end of a drive."""
    unreached = next((time for time, _ in changes if time >= duration_s), None)
    if unreached is not None:
        why = f"{unreached:g} s is after the end of the drive, which lasts {duration_s:g} s"
        raise click.BadParameter(why, param_hint="--change")


def angle_reader(within: click.FloatRange | None = None) -> Callable[[Any], float]:
    """Return a function that converts a text in degrees to radians, and refuses angles outside a given range."""

    def radians(text: Any) -> float:  # noqa: ANN401 - what click has: a text, or the default
        return math.radians((within or click.FLOAT).convert(text, None, None))

    return radians


DRIVE = (
    (
        "--icrs icrs_m",
        "YR,YL,X",
        numbers_reader("YR,YL,X", 3),
        "True ICRs [m]; default: from the robot's track width, or from the study.",
    ),
    (
        "--path kind",
        None,
        click.Choice(get_args(PathKind)),
        "Path to drive; study convergence then uses this path alone.",
    ),
    ("--duration duration_s", "S", POSITIVE, "Duration of a drive [s]; default: 100, or from the study."),
    ("--speed speed_mps", "MPS", POSITIVE, "Speed of the body [m/s]; for spins on the spot, of the faster track."),
    ("--radius radius_m", "M", NOT_NEGATIVE, "Radius of circles and of the tightest bends."),
    ("--leg leg_m", "M", POSITIVE, "Length of a lawnmower's legs."),
    ("--encoder-counts", "N", POSITIVE, "Encoder counts of a wheel turn; default: from the robot, else 8192."),
    ("--input-noise input_noise_mps", "MPS", NOT_NEGATIVE, "White noise of each sample of the track speeds."),
    ("--input-bias input_bias_mps", "MPS", float, "Bias of both track speeds."),
    ("--gnss gnss_std_m", "rtk|waas|METRES", gnss_text, "Noise of north and east: rtk 0.01 m, waas 0.30 m."),
    ("--gnss-rate gnss_rate_hz", "HZ", POSITIVE, "Fixes per second."),
)
"""Options of `simulate` and `study`: names, with the field of plan, path or sensors, metavar, type and help."""

DRIVE_DEFAULTS: dict[str, object] = {
    "kind": "curved", "speed_mps": 0.4, "radius_m": 1.5, "leg_m": 10.0, "input_noise_mps": 0.0, "input_bias_mps": 0.0,
    "gnss_std_m": "rtk", "gnss_rate_hz": 20.0,
}  # fmt: skip
"""Defaults of `simulate` by field. A study has its own defaults."""

DYNAMICS = (
    flag("--dynamics", "The robot slides on contacts with friction, and a driver steers: the ICRs result."),
    flag("--tracks", "With --dynamics: five road wheels a side, in place of two wheels."),
    option("--friction", "MU", POSITIVE, "With --dynamics: friction coefficient along the wheels; default 0.7."),
    option("--friction-std", "SHARE", NOT_NEGATIVE, "With --dynamics: standard deviation of the friction along the "
           "path, as a share of it; default 0.1."),
)  # fmt: skip
"""Options of `simulate` and `study` for a robot on sliding contacts."""

RECORDED = (
    ("--start-heading start_heading_rad", "DEG", angle_reader(), "Heading at the start, clockwise from north.", 30.0),
    ("--wheels", None, click.Choice(["encoder", "commanded"]),
     "Content of the wheel messages: counted travel, or the motor commands.", "encoder"),
    ("--wheel-messages", None, click.Choice(get_args(WheelMessages)), "Message type of the wheels.", "joint_states"),
    ("--wheel-rate", "HZ", POSITIVE, "Wheel messages a second; default 100, commanded 10.", None),
    ("--motor-lag motor_lag_s", "S", NOT_NEGATIVE, "Time constant of the tracks behind their commands [s].", 0.0),
    ("--antenna", "FORWARD,RIGHT", numbers_reader("FORWARD,RIGHT", 2),
     "Position of the antenna, from the body origin [m].", "0,0"),
    ("--gnss-delay gnss_delay_s", "S", float, "Time by which the stamps of the fixes lag [s].", 0.0),
    ("--heading convention", None, click.Choice(get_args(HeadingConvention)),
     "Convention of the Imu: REP-103, or REP-145's NED.", "enu"),
    ("--heading-std heading_std_rad", "DEG", angle_reader(NOT_NEGATIVE), "White noise of the heading.", 1.0),
    ("--heading-resolution heading_resolution_rad", "DEG", angle_reader(NOT_NEGATIVE), "Step of the rounded headings.",
     0.05),
    ("--heading-rate heading_rate_hz", "HZ", POSITIVE, "Headings a second.", 100.0),
    ("--heading-offset heading_offset_rad", "DEG", angle_reader(), "Added to every heading, clockwise.", 0.0),
    ("--heading-delay heading_delay_s", "S", float, "Time by which the stamps of the headings lag [s].", 0.0),
)  # fmt: skip
"""Further options of `simulate`, with the columns of `DRIVE` and their default."""


def drive_options(*further: Option, **defaults: object) -> Option:
    """Return a decorator that adds `DRIVE`, --change and further options, as functions that change path, plan, sensors.

    Parameters
    ----------
    defaults : defaults of `DRIVE` by field; other fields have no default
    """
    text = "New true ICRs [m] from T seconds on; repeatable."
    change = option("--change changes", "T:YR,YL,X", change_text, text, multiple=True)
    drive = [option(*row, default=defaults.get(row[0].split()[-1])) for row in DRIVE]
    robot = options_as_record("contacts", "icrtool.simulation.friction:FrictionRobot", *DYNAMICS, change=True)
    options_of_sensors = (*drive, change, robot, *further)
    sensors = options_as_record("sensors", "icrtool.simulation.drives:Sensors", *options_of_sensors, change=True)
    plan = options_as_record("plan", "icrtool.simulation.drives:DrivePlan", sensors, change=True)
    return options_as_record("path", "icrtool.simulation.drives:PathPlan", plan, change=True)


@options.command("simulate")
@option("-o --output log", "LOG", FILE, "Log to make: .mcap, .bag, or a ROS 2 directory.", required=True)
@flag("--force", "Replace a log that is there.")
@options.SEED
@option("--speeds", "FILE.csv", FILE, "Drive these track speeds instead: t_s, v_left_mps, v_right_mps.")
@drive_options(
    option("--outage outages_s", "BEGIN:END", span_text, "No fixes between these seconds; repeatable.", multiple=True),
    *(option(*row, default=default) for *row, default in RECORDED),
    **DRIVE_DEFAULTS,
)
@options.CONFIGURATION
@options.printer_options(options.QUIET, options.VERBOSE_OPTION)
def simulate_command(
    log: Path, force: bool, seed: int, speeds: Path | None, path: RecordChange[PathPlan], plan: RecordChange[DrivePlan],
    sensors: RecordChange[Sensors], encoder_counts: float | None, wheel_rate: float | None,
    antenna: tuple[float, float], wheel_messages: WheelMessages, convention: HeadingConvention,
    contacts: RecordChange[FrictionRobot], dynamics: bool, tracks: bool, settings: ConfigSources, printer: Printer,
) -> None:  # fmt: skip
    """Drive a robot of known ICRs, and write the log that its sensors would record and the true states.

    Kinematics (Eqs. 8-10, integrated without error) and sensors (Section 4) are those of Pentzer 2014. The robot is
    pentzer-tracked, unless --robot, --config or --set robot.… name another one. LOG.truth.csv holds the true pose
    (about latitude 40.7934, longitude -77.86), ICRs and track speeds at every wheel stamp.

    With --dynamics the robot slides on contacts with friction, and its ICRs result from speed, load and ground.

    \b
    Example:
      icrtool simulate -o drive.mcap --robot husky-a200 --path figure-eight
      icrtool fit drive.mcap --robot husky-a200
    """  # noqa: D301 - click reads the escape
    config = settings.load()
    if settings.robot is None and config.robot.track_width_m is None and config.robot.wheel_radius_m is None:
        config = settings._replace(robot=DEFAULT_ROBOT).load()
    driven = path(drives.PathPlan()) if speeds is None else simulation_files.read_speeds(speeds)
    duration_s = 100.0 if isinstance(driven, drives.PathPlan) else float(driven.t_s[-1])
    drive = plan(drives.DrivePlan(icrs_m=default_icrs(config), path=driven, duration_s=duration_s))
    drive = replace(drive, robot=friction_robot(contacts, config, dynamics=dynamics, tracks=tracks))
    check_changes(drive.changes, drive.duration_s)
    counts = encoder_counts or config.robot.encoder_counts_per_rev or PAPER_COUNTS
    radius_m = needed_number(config, "wheel_radius_m")
    metres_per_count = 2 * math.pi * radius_m / counts
    sensors_given = drives.Sensors(
        metres_per_count=metres_per_count, antenna_forward_m=antenna[0], antenna_right_m=antenna[1]
    )
    sensed = sensors(sensors_given)
    rate = wheel_rate or (COMMAND_RATE_HZ if sensed.wheels == "commanded" else ENCODER_RATE_HZ)
    sensed = replace(sensed, wheel_rate_hz=rate)
    if sensed.wheels == "commanded":
        drive = replace(drive, command_rate_hz=rate)
    if log.suffix not in ("", ".mcap", ".bag"):
        advice = "name a file .mcap or .bag, or for a ROS 2 bag a directory without a dot in its name"
        raise errors.ConfigError(log, f"no log of suffix {log.suffix} can be written", advice)
    writing = write_log.WriteOptions(
        container="mcap" if log.suffix == ".mcap" else "bag" if log.suffix == ".bag" else "db3",
        wheels=wheel_messages,
        heading=convention,
        wheel_radius_m=radius_m,
        track_width_m=needed_number(config, "track_width_m"),
        counts_per_rev=counts,
        heading_std_deg=math.degrees(sensed.heading_std_rad),
    )
    with simulation_files.log_and_truth(log, force=force) as (fresh_log, fresh_truth):
        recorded, truth = drives.simulate(drive, sensed, seed)
        write_log.write_log(fresh_log, recorded, writing)
        simulation_files.write_truth(truth, fresh_truth)
    truth_file = simulation_files.truth_path(log)
    printer.text(f"{_summary(config, drive, truth, seed)}\n\nwritten to {log}, truth to {truth_file}")
    printer.detail(f"sensors: {sensed}")


def friction_robot(
    contacts: RecordChange[FrictionRobot], config: Config, *, dynamics: bool, tracks: bool
) -> FrictionRobot | None:
    """Return the robot on sliding contacts with the configured track width; None without --dynamics."""
    if not dynamics:
        if tracks or contacts(friction.FrictionRobot()) != friction.FrictionRobot():
            raise click.UsageError("--tracks, --friction and --friction-std need --dynamics")
        return None
    robot = friction.TRACKED_ROBOT if tracks else friction.FrictionRobot()
    width_m = config.robot.track_width_m
    return contacts(robot if width_m is None else friction.scaled_robot(robot, width_m))


def default_icrs(config: Config) -> Icrs:
    """Return the default of the true ICRs: y right, y left, x [m]."""
    half = DEFAULT_MULTIPLIER * needed_number(config, "track_width_m") / 2
    return half, -half, 0.0


def needed_number(config: Config, key: Literal["track_width_m", "wheel_radius_m"]) -> float:
    """Return a configured number of the robot; refuse a robot without it, because a simulation needs it."""
    value: float | None = getattr(config.robot, key)
    if value is None:
        advice = f"--set robot.{key}=…, or --robot NAME"
        raise errors.ConfigError(f"robot.{key}", "is not set, and a simulation needs it", advice)
    return value


def _summary(config: Config, plan: DrivePlan, truth: TruthTable, seed: int) -> str:
    """Return the lines that are printed of a simulated drive: robot, path, ICRs."""
    import numpy as np

    distance_m = float(np.hypot(np.diff(truth["north_m"]), np.diff(truth["east_m"])).sum())
    right, left, x = plan.icrs_m
    if plan.robot is not None:
        right, left, x = (float(truth[name].mean()) for name in runs.ICR_COLUMNS)
    driven_text = f"{plan.path.kind} path" if isinstance(plan.path, drives.PathPlan) else "track speeds as given"
    lines = [
        f"robot  {config.robot.name or 'as configured'}, b = {needed_number(config, 'track_width_m'):g} m",
        f"drive  {driven_text}, {distance_m:.1f} m in {plan.duration_s:g} s, seed {seed}",
        f"ICRs   y right {right:+z.3f}, y left {left:+z.3f}, x {x:+z.3f} m{', mean' if plan.robot else ''}",
    ]
    lines += [f"       from {time:g} s on {', '.join(f'{icr:+z.3f}' for icr in icrs)} m" for time, icrs in plan.changes]
    return "\n".join(lines)


@options.command("study")
@click.argument("name", metavar="NAME", type=click.Choice(get_args(StudyName)))
@option("-o --output", "DIR", FILE, "Study directory; default icrtool-runs/study-NAME.")
@options_as_record(
    "request",
    "icrtool.simulation.study_records:StudyRequest",
    option("--runs", "N", click.IntRange(min=1), "Number of runs for each value (in study initial: for each start)."),
    options.SEED,
    option(
        "--values",
        "V,V,...",
        numbers_reader("V,V,..."),
        "Values of the quantity that the study varies, in the unit of the quantity.",
    ),
    change=True,
)
@choice("--preset", get_args(PresetName), "Study this preset alone; default: both, but paper in study initial, and in "
        "study convergence paper, or field with --robot.")  # fmt: skip
@drive_options(
    choice("--wheels", ("ideal", "encoder"), "ideal: wheel speeds without error; encoder: counted travel."),
    option("--rate", "HZ", click.FloatRange(min=1, max=200), "Wheel and heading samples per second."),
    option("--heading-std heading_std_rad", "DEG", angle_reader(POSITIVE), "White noise of the heading."),
)
@options.PLOTS_OPTION
@options.CONFIGURATION
@options.printer_options(options.QUIET, options.VERBOSE_OPTION)
def study_command(
    name: str, output: Path | None, request: RecordChange[StudyRequest], preset: PresetName | None,
    path: RecordChange[PathPlan], plan: RecordChange[DrivePlan], sensors: RecordChange[Sensors],
    encoder_counts: float | None, contacts: RecordChange[FrictionRobot], dynamics: bool, tracks: bool,
    rate: float | None, plots: tuple[str, ...],
    settings: ConfigSources, printer: Printer,
) -> None:  # fmt: skip
    """Simulate and filter many drives; report accuracy, convergence time and consistency of the ICRs.

    \b
    NAME is one of
      convergence   Figs. 4, 5    convergence time of the ICRs, by kind of path
      initial       Figs. 6, 7    which initial ICRs converge, without and with the sign guard
      icr-change    Figs. 8, 9    following a change of the ICRs, with and without covariance inflation
      turn-radius   Fig. 10       convergence after a change, by radius of the turn
      input-source  Fig. 11       encoders against commanded speeds
      input-noise   Fig. 12       ICR error by noise of the track speeds
      input-bias    Fig. 13       ICR error by bias of the track speeds
      gnss          Figs. 35-37   ICR error and open-loop error by noise of the GNSS
      speed         Figs. 38-44   ICRs of a robot on sliding contacts, by its speed
      rate                        whether logs of any rate give the same ICRs
      consistency                 whether the filter's covariance is right

    The defaults are those of Pentzer 2014, Section 5; --robot and the options replace them. DIR gets study.json,
    NAME.csv with every run, and the picture.

    \b
    Example:
      icrtool study convergence --robot husky-a200 --wheels encoder --gnss waas
    """  # noqa: D301 - click reads the escape
    config, arguments = settings.load(), click.get_current_context().params
    check_varied(studies.STUDIES[name], name, arguments)
    study_request, robot = request(studies.default_request(name, config)), config.robot
    driven, drive, sensed = path(study_request.path), study_request.plan, sensors(study_request.sensors)
    if robot.track_width_m is not None:
        drive = replace(drive, icrs_m=default_icrs(config))
    drive = plan(replace(drive, path=driven))
    if (robot_on_ground := friction_robot(contacts, config, dynamics=dynamics, tracks=tracks)) is not None:
        drive = replace(drive, robot=robot_on_ground)
    check_changes(drive.changes, drive.duration_s)
    if rate is not None:
        sensed = replace(sensed, wheel_rate_hz=rate, heading_rate_hz=rate)
    if robot.wheel_radius_m is not None:
        counts = encoder_counts or robot.encoder_counts_per_rev or PAPER_COUNTS
        sensed = replace(sensed, metres_per_count=2 * math.pi * robot.wheel_radius_m / counts)
    paths = (driven.kind,) if arguments["kind"] is not None and study_request.paths else study_request.paths
    if preset is None and "filter.preset" in config.given:
        preset = config.filter.preset
    if preset is None and name == "convergence" and robot.track_width_m is not None:
        preset = "field"
    presets = study_request.presets if preset is None else (preset,)
    study_request = replace(study_request, plan=drive, sensors=sensed, paths=paths, presets=presets)
    directory = output if output is not None else RUNS_FOLDER / f"study-{name}"
    simulation_files.check_study_target(directory)
    with printer.progress(f"study {name}") as progress:
        result = studies.run_study(study_request, progress)
    simulation_files.write_study(result, directory, plots=plots)
    printer.show(study_tables.study_blocks(result))
    printer.text(f"\nwritten to {directory}")
    printer.detail(f"settings: {study_request.settings()}")


def check_varied(study: Study, name: str, arguments: Mapping[str, object]) -> None:
    """Refuse an option for the quantity that a study varies, and values for a study that varies no number.

    Parameters
    ----------
    study, name : the study and its name
    arguments : values of the options by name
    """
    if arguments.get(study.varied) is not None:
        option = next(parameter.opts[0] for parameter in study_command.params if parameter.name == study.varied)
        raise click.UsageError(f"study {name} varies {option}; --values V,V,... sets its values")
    if arguments["values"] is not None and not study.varies:
        raise click.UsageError(f"study {name} varies no number, and has no --values")
