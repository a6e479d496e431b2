"""Pairs of drives of skid-steer robots whose slip is made by friction, not by the motion models of icrtool.

Each robot drives three times: A and B on one ground, whose friction is drawn again within what grounds of one kind
differ by, and C on another one. Robots, grounds, paths and slip are drawn with fixed seeds.
`icrtool.simulation.friction` drives them: each contact of a wheel or of a part of a track slides with a velocity s, and
the ground pulls back with mu N s / sqrt(s^2 + s_0^2), less sideways than along the wheel. s_0 grows with the wheel's
speed (shear of the ground). Load moves with the acceleration; rolling resistance, slopes and friction that varies along
the path act too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from unseen_drives import TrueDrive

from icrtool.kernels.arrays import Floats
from icrtool.records.samples import GyroSamples, HeadingSamples, PositionFixes, StreamChoice, WheelSamples
from icrtool.records.tables import RobotLog
from icrtool.records.text import LogText
from icrtool.simulation.friction import FrictionRobot, slide_path

SECONDS, STEP_S = 200.0, 0.01

LAG_S = 0.15
"""Time constant of the motors [s]."""

UNEVEN_LENGTH_M = 5.0
"""Distance over which the friction's variation is correlated [m]."""

DRIVES = ("A", "B", "C")
START_NS = 1_760_000_000_000_000_000


@dataclass(frozen=True)
class Ground:
    """How a ground holds a wheel.

    Attributes
    ----------
    friction : largest force over load
    slide_mps, slide_share : sliding at which half of it acts, and its growth with the wheel's speed
    sideways : share of it that acts across the wheel
    resistance : rolling resistance over load
    uneven : relative variation of the friction of each side along the path
    slope : variation of the slope across and along
    """

    friction: float
    slide_mps: float
    slide_share: float
    sideways: float
    resistance: float
    uneven: float
    slope: float


@dataclass(frozen=True)
class GroundRobot:
    """A robot: size [m], contacts a side, place of the centre of mass, radius error of each side."""

    width_m: float
    base_m: float
    contacts: int
    mass_forward_m: float
    mass_right_m: float
    height_m: float
    speed_mps: float
    left_scale: float
    right_scale: float


def draw_robot(rng: np.random.Generator) -> GroundRobot:
    """Draw a robot."""
    width = float(np.exp(rng.uniform(math.log(0.4), math.log(1.1))))
    return GroundRobot(
        width, width * float(rng.uniform(0.6, 1.1)), int(rng.choice([2, 2, 5])), width * float(rng.normal(0.0, 0.08)),
        width * float(rng.normal(0.0, 0.03)), width * float(rng.uniform(0.3, 0.6)),
        float(rng.uniform(0.5, 1.0)) * min(1.0, width / 0.5), *np.exp(rng.normal(0.0, 0.004, 2)).tolist(),
    )  # fmt: skip


def draw_ground(rng: np.random.Generator) -> Ground:
    """Draw a ground."""
    friction, slide_mps = rng.uniform(0.4, 0.9), rng.uniform(0.02, 0.05)
    slide_share = np.exp(rng.uniform(math.log(0.02), math.log(0.25)))
    others = [rng.uniform(low, high) for low, high in ((0.6, 1.0), (0.02, 0.08), (0.01, 0.05), (0.0, 0.012))]
    return Ground(*map(float, (friction, slide_mps, slide_share, *others)))


def of_one_kind(ground: Ground, rng: np.random.Generator) -> Ground:
    """Return a ground of the same kind on another day: each number differs by 5 %."""
    factors = np.exp(rng.normal(0.0, 0.05, 7)).tolist()
    numbers = [
        getattr(ground, name) * factor for name, factor in zip(Ground.__dataclass_fields__, factors, strict=True)
    ]
    return Ground(*numbers)


def _wander(rng: np.random.Generator, length_s: float, n: int) -> Floats:
    """Return a random function of time (n,), of variance one, that changes within a length."""
    knots = rng.normal(size=int(n * STEP_S / length_s) + 3)
    at = np.arange(n) * STEP_S / length_s
    row = at.astype(np.int64)
    part = (1.0 - np.cos(np.pi * (at - row))) / 2.0
    return (1.0 - part) * knots[row] + part * knots[row + 1]


def _commands(robot: GroundRobot, rng: np.random.Generator, n: int) -> tuple[Floats, Floats]:
    """Return wheel speeds that a driver asks of left and right (n,): straight, curves, spins and stops in turn."""
    left, right = np.zeros(n), np.zeros(n)
    row = int(2.0 / STEP_S)
    while row < n:
        lasting = int(rng.uniform(2.0, 9.0) / STEP_S)
        kind, speed = rng.random(), robot.speed_mps * float(rng.uniform(0.6, 1.2))
        turn = 0.0
        if kind < 0.04:
            speed = 0.0
        elif kind < 0.12:
            speed, turn = 0.0, float(rng.choice([-1.0, 1.0])) * robot.speed_mps * 0.6
            lasting = min(lasting, int(3.0 / STEP_S))
        elif kind < 0.7:
            turn = float(rng.normal(0.0, 0.35)) * speed
        left[row : row + lasting], right[row : row + lasting] = speed + turn, speed - turn
        row += lasting
    return left, right


def simulate(count: int, seed: int = 40) -> list[dict[str, TrueDrive]]:
    """Return the drives of some robots, by name."""
    made = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        robot, ground = draw_robot(rng), draw_ground(rng)
        drives = {}
        for name, each in zip(
            DRIVES, (of_one_kind(ground, rng), of_one_kind(ground, rng), draw_ground(rng)), strict=True
        ):
            # a robot's load differs a little from drive to drive
            loaded = replace(robot, mass_forward_m=robot.mass_forward_m + robot.width_m * float(rng.normal(0.0, 0.01)))
            drives[name] = _drive(f"robot{number:02d}{name}", loaded, each, rng)
        made.append(drives)
    return made


def simulate_grounds(count: int, seed: int, grounds: int) -> list[dict[str, TrueDrive]]:
    """Return a drive of each of some robots on each of some grounds of different kinds, by name."""
    made = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        robot = draw_robot(rng)
        names = [f"ground{one}" for one in range(grounds)]
        made.append({name: _drive(f"robot{number:02d}{name}", robot, draw_ground(rng), rng) for name in names})
    return made


def _drive(name: str, robot: GroundRobot, ground: Ground, rng: np.random.Generator) -> TrueDrive:
    """Return one drive, with the wheel speeds of `_commands` as they are."""
    t = np.arange(round(SECONDS / STEP_S)) * STEP_S
    left, right = _commands(robot, rng, len(t))
    slope = np.column_stack([ground.slope * _wander(rng, 16.0 / robot.speed_mps, len(t)) for _ in range(2)])
    half = robot.width_m / 2.0
    truth = slide_path(
        sliding_robot(robot, ground), t, (left + right) / 2.0, (left - right) / robot.width_m,
        np.ones(len(t), np.bool_), (half, -half, 0.0), start_heading_rad=0.0, lag_s=LAG_S, rng=rng, slope=slope,
        steers=False,
    )  # fmt: skip
    north, east, heading = truth.pose.T
    sides = truth.travel_left_m / robot.left_scale, truth.travel_right_m / robot.right_scale
    return TrueDrive(name, robot.width_m, 0.15, t, north, east, heading, *sides)


def sliding_robot(robot: GroundRobot, ground: Ground) -> FrictionRobot:
    """Return a robot on a ground as `icrtool.simulation.friction` drives it."""
    return FrictionRobot(
        mass_kg=1.0, half_track_m=robot.width_m / 2.0,
        contact_forward_m=tuple((np.linspace(0.5, -0.5, robot.contacts) * robot.base_m).tolist()),
        mass_forward_m=robot.mass_forward_m, mass_right_m=robot.mass_right_m, mass_height_m=robot.height_m,
        gyration_m=math.sqrt((robot.width_m**2 + (1.4 * robot.base_m) ** 2) / 12.0), friction=ground.friction,
        lateral_friction=ground.sideways, friction_std=ground.uneven, friction_length_m=UNEVEN_LENGTH_M,
        creep=ground.slide_share, slip_mps=ground.slide_mps, resistance=ground.resistance,
    )  # fmt: skip


def measure(drive: TrueDrive, seed: int, *, gyro: bool = True) -> RobotLog:
    """Return what sensors measure of a drive: wheels and gyro at 50 Hz, fixes of 1 cm at 10 Hz, heading of 1 degree."""
    rng = np.random.default_rng([seed, 1])
    t, stamps = drive.t_s, START_NS + np.rint(drive.t_s * 1e9).astype(np.int64)
    fast, slow = slice(None, None, 2), slice(None, None, 10)
    speeds = [np.diff(side[fast], append=side[-1]) / (t[2] - t[0]) for side in (drive.left_m, drive.right_m)]
    speeds[0][-1], speeds[1][-1] = speeds[0][-2], speeds[1][-2]
    fixes, headings = stamps[slow], stamps[fast]
    m, k = len(fixes), len(headings)
    smooth = np.convolve(rng.normal(0.0, 1.0, k + 200), np.ones(100) / 10.0, "same")[100 : 100 + k]
    psi = drive.heading_rad[fast] + math.radians(0.4) * smooth + math.radians(0.5) * rng.normal(size=k)
    variance = np.full(m, 1e-4)
    rate = np.gradient(drive.heading_rad[fast], t[fast]) * 1.005 + 0.002 + rng.normal(0.0, 0.003, k)
    streams = [
        StreamChoice(role, LogText(topic), LogText("made/Made"), len(at), hz, "header", 0.0, "made")
        for role, topic, at, hz in (
            ("wheels", "/w", headings, 50.0), ("gnss", "/p", fixes, 10.0), ("heading", "/h", headings, 50.0)
        )
    ]  # fmt: skip
    north, east = drive.north_m[slow] + rng.normal(0.0, 0.01, m), drive.east_m[slow] + rng.normal(0.0, 0.01, m)
    return RobotLog(
        LogText(drive.name), WheelSamples(headings, *speeds),
        PositionFixes(fixes, north, east, variance, variance.copy(), np.zeros(m)),
        HeadingSamples(headings, np.angle(np.exp(1j * psi)), np.full(k, math.radians(1.0) ** 2)),
        None, tuple(streams), (), {}, (), None, GyroSamples(LogText("/imu"), headings, rate) if gyro else None,
    )  # fmt: skip
