"""Drives of physics-simulated robots that nobody tuned for: robots, grounds and paths drawn with fixed seeds.

`load_drives` makes what its folder lacks; a 150 s drive takes half a minute.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "sample_logs"))
from skid_steer import (
    SAMPLE_S,
    TRACKED,
    WHEELED,
    Driver,
    Robot,
    drive,
    plan_curved,
    plan_figure_eight,
    plan_lawnmower,
)

from icrtool.kernels.arrays import Floats

PLANS = (plan_curved, plan_lawnmower, plan_figure_eight)
HUSKY = replace(
    WHEELED,
    name="husky",
    mass_kg=50.0,
    wheel_mass_kg=2.6,
    wheel_radius_m=0.1651,
    half_track_m=0.2775,
    wheel_forward_m=(0.256, -0.256),
    servo_nms=60.0,
    body_size_m=(0.98, 0.45, 0.25),
)
WARTHOG = replace(
    WHEELED,
    name="warthog",
    mass_kg=470.0,
    wheel_mass_kg=12.0,
    wheel_radius_m=0.285,
    half_track_m=0.54,
    wheel_forward_m=(0.46, -0.46),
    servo_nms=900.0,
    body_size_m=(1.4, 0.8, 0.4),
)
ICE_FRICTION = (0.06, 0.14)
USUAL_DRIVES = 36


@dataclass(frozen=True)
class TrueDrive:
    """What a robot did, every 0.01 s; all of shape (n,).

    Attributes
    ----------
    left_m, right_m : distance rolled by the wheels of a side
    """

    name: str
    width_m: float
    radius_m: float
    t_s: Floats
    north_m: Floats
    east_m: Floats
    heading_rad: Floats
    left_m: Floats
    right_m: Floats


def load_drives(folder: Path, count: int) -> list[TrueDrive]:
    """Return the first drives, from the folder where they are there, else simulated and stored."""
    folder.mkdir(parents=True, exist_ok=True)
    return [_load(folder / f"d{number:02d}.npz", number) for number in range(count)]


def _load(path: Path, number: int) -> TrueDrive:
    if not path.exists():
        _make(number, path)
    with np.load(path) as z:
        return TrueDrive(f"d{number:02d}", float(z["b"]), float(z["rad"]), *(z[key] for key in ("t", *"nehlr")))


def _make(number: int, path: Path) -> None:
    """Simulate one drive."""
    rng = np.random.default_rng([77, number])
    robot, seconds, speed = _usual(number, rng) if number < USUAL_DRIVES else _field(number, rng)
    heading = float(rng.uniform(-3.0, 3.0))
    plan = PLANS[number // 2 % 3]
    line = plan(2.0 * speed * seconds, heading)
    driver = Driver(line, speed, 4 * robot.half_track_m, np.random.default_rng([number, 0]))
    motion = drive(robot, driver, heading, round(seconds / SAMPLE_S) + 1)
    np.savez(
        path,
        t=motion.t_s, n=motion.north_m, e=motion.east_m, h=motion.heading_rad,
        l=motion.angle_left_rad * robot.wheel_radius_m, r=motion.angle_right_rad * robot.wheel_radius_m,
        b=2 * robot.half_track_m, rad=robot.wheel_radius_m,
    )  # fmt: skip


def _usual(number: int, rng: np.random.Generator) -> tuple[Robot, float, float]:
    """Return the robots of the sample logs in other sizes, for 100 to 200 s."""
    base = (WHEELED, TRACKED)[number % 2]
    factor = float(rng.uniform(0.7, 1.3))
    robot = replace(
        base,
        half_track_m=base.half_track_m * rng.uniform(0.85, 1.4),
        wheel_forward_m=tuple(x * factor for x in base.wheel_forward_m),
        mass_forward_m=float(rng.uniform(-0.08, 0.12)),
        friction=float(rng.uniform(0.35, 0.9)),
        mass_kg=base.mass_kg * rng.uniform(0.8, 1.5),
    )
    return robot, float(rng.choice([100.0, 150.0, 200.0])), float(rng.uniform(0.4, 1.1))


def _field(number: int, rng: np.random.Generator) -> tuple[Robot, float, float]:
    """Return robots that are used in the field, every third on ice, for 60 to 900 s."""
    base = (HUSKY, WARTHOG)[number % 2]
    friction = rng.uniform(*ICE_FRICTION) if is_on_ice(number) else rng.uniform(0.35, 0.9)
    robot = replace(base, friction=float(friction), mass_forward_m=float(rng.uniform(-0.1, 0.1)))
    return robot, 60.0 * math.exp(rng.uniform(0.0, math.log(15.0))), float(rng.uniform(0.5, 1.5))


def is_on_ice(number: int) -> bool:
    """Return whether a drive is on ice."""
    return number >= USUAL_DRIVES and number % 3 == 0
