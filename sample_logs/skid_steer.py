"""Rigid-body skid-steer robots on flat ground with friction contact (MuJoCo), and a driver who follows a path.

Nothing here uses instantaneous centres of rotation: they are a result of the contact forces.
MuJoCo's world is x forward, y left, z up; north is its x and east its -y, so heading (clockwise) is minus its yaw.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

SAMPLE_S = 0.01
STEPS_PER_SAMPLE = 10
SETTLE_S = 1.0
STAND_S = 1.0
SIDE_ACCELERATION_MPS2 = 1.0
LOOKAHEAD_M = 1.0


@dataclass(frozen=True)
class Robot:
    """A skid-steer robot.

    Attributes
    ----------
    mass_kg : with wheels
    half_track_m : centre plane of a side's wheels from the middle
    wheel_forward_m : positions of the wheels of a side; a track is a row of road wheels with equal speed
    mass_forward_m : centre of mass in front of the body origin, which is the geometric centre between the wheels
    wheel_shape : ``ellipsoid`` (a crowned tyre, one contact point) or ``cylinder`` (a flat shoe, two edges)
    friction : Coulomb, the same in every direction
    servo_nms : torque per wheel over its error of speed [N m s/rad]
    """

    name: str
    mass_kg: float
    wheel_mass_kg: float
    wheel_radius_m: float
    wheel_width_m: float
    wheel_shape: str
    half_track_m: float
    wheel_forward_m: tuple[float, ...]
    mass_forward_m: float
    friction: float
    servo_nms: float
    body_size_m: tuple[float, float, float]


WHEELED = Robot(
    name="segway-rmp400",
    mass_kg=118.0,
    wheel_mass_kg=6.0,
    wheel_radius_m=0.27,
    wheel_width_m=0.05,
    wheel_shape="ellipsoid",
    half_track_m=0.305,
    wheel_forward_m=(0.2, -0.2),
    mass_forward_m=0.0,
    friction=0.7,
    servo_nms=200.0,
    body_size_m=(0.6, 0.5, 0.3),
)
TRACKED = Robot(
    name="pentzer-tracked",
    mass_kg=37.0,
    wheel_mass_kg=0.5,
    wheel_radius_m=0.08,
    wheel_width_m=0.05,
    wheel_shape="cylinder",
    half_track_m=0.26,
    wheel_forward_m=(0.2, 0.1, 0.0, -0.1, -0.2),
    mass_forward_m=0.10,
    friction=0.6,
    servo_nms=5.0,
    body_size_m=(0.5, 0.4, 0.2),
)


@dataclass(frozen=True)
class Motion:
    """True motion of the robot, every `SAMPLE_S` from t = 0; all of shape (n,).

    Attributes
    ----------
    north_m, east_m : body origin
    heading_rad : clockwise from north, unwrapped
    angle_left_rad, angle_right_rad : mean of the side's wheels, zero at t = 0
    """

    t_s: Floats
    north_m: Floats
    east_m: Floats
    heading_rad: Floats
    angle_left_rad: Floats
    angle_right_rad: Floats


def describe_model(robot: Robot) -> str:
    """Return the robot on its plane as MuJoCo XML. Wheels touch the ground only, never each other."""
    count = len(robot.wheel_forward_m)
    body_kg = robot.mass_kg - 2 * count * robot.wheel_mass_kg
    body_forward = robot.mass_forward_m * robot.mass_kg / body_kg
    length, width, height = robot.body_size_m
    inertia = body_kg / 12 * np.array([width**2 + height**2, length**2 + height**2, length**2 + width**2])
    sides = [(side, y) for side, y in (("left", robot.half_track_m), ("right", -robot.half_track_m))]
    joints = [(f"{side}_{i}", x, y) for side, y in sides for i, x in enumerate(robot.wheel_forward_m)]
    wheels = "".join(_describe_wheel(robot, name, x, y) for name, x, y in joints)
    servos = "".join(f'<velocity joint="{name}" kv="{robot.servo_nms}"/>' for name, _, _ in joints)
    chains = "".join(
        f'<joint joint1="{side}_0" joint2="{side}_{i}" polycoef="0 1 0 0 0" solref="0.004 1"/>'
        for side, _ in sides
        for i in range(1, count)
    )
    return f"""
    <mujoco>
      <compiler angle="degree"/>
      <option timestep="{SAMPLE_S / STEPS_PER_SAMPLE}" integrator="implicitfast" cone="elliptic" impratio="10"/>
      <worldbody>
        <geom type="plane" size="0 0 1" contype="1" conaffinity="2" friction="{robot.friction} 0 0" solref="0.008 1"/>
        <body name="robot" pos="0 0 {robot.wheel_radius_m}">
          <freejoint/>
          <inertial pos="{body_forward} 0 0" mass="{body_kg}" diaginertia="{inertia[0]} {inertia[1]} {inertia[2]}"/>
          {wheels}
        </body>
      </worldbody>
      <equality>{chains}</equality>
      <actuator>{servos}</actuator>
    </mujoco>"""


def _describe_wheel(robot: Robot, name: str, forward_m: float, left_m: float) -> str:
    radius, half_width = robot.wheel_radius_m, robot.wheel_width_m / 2
    size = f"{radius} {half_width}" if robot.wheel_shape == "cylinder" else f"{radius} {radius} {half_width}"
    spin = robot.wheel_mass_kg * radius**2 / 2
    return f"""
          <body pos="{forward_m} {left_m} 0">
            <inertial pos="0 0 0" mass="{robot.wheel_mass_kg}" diaginertia="{spin / 2} {spin} {spin / 2}"/>
            <joint name="{name}" type="hinge" axis="0 1 0"/>
            <geom type="{robot.wheel_shape}" size="{size}" euler="90 0 0" contype="2" conaffinity="1" condim="3"
                  friction="{robot.friction} 0 0"/>
          </body>"""


class Driver:
    """Steers to a point ahead on the path, with noise.

    Pure pursuit gives a curvature; the speeds of the sides follow for a robot without slip and `assumed_width_m` wide.
    First-order noise is added to curvature (0.06 1/m, 2 s) and speed (10 %, 5 s).
    """

    def __init__(self, path: Floats, speed_mps: float, assumed_width_m: float, rng: np.random.Generator) -> None:
        self.path = path
        self.speed_mps = speed_mps
        self.assumed_width_m = assumed_width_m
        self.rng = rng
        self.ahead = 0
        self.curvature_wobble = 0.0
        self.speed_wobble = 0.0
        self.sides = np.zeros(2)

    def steer(self, t_s: float, north_m: float, east_m: float, heading_rad: float) -> Floats:
        """Return the speeds to hold over the next sample: left, right [m/s]."""
        if t_s < STAND_S:
            return self.sides
        window = self.path[self.ahead : self.ahead + 400] - (north_m, east_m)
        distance = np.hypot(window[:, 0], window[:, 1])
        # The target point only moves forward: a path that crosses itself has several nearest points.
        self.ahead += int(np.argmax(distance >= LOOKAHEAD_M))
        target_north, target_east = self.path[self.ahead] - (north_m, east_m)
        bearing = np.arctan2(target_east, target_north) - heading_rad
        self.curvature_wobble = self._wander(self.curvature_wobble, std=0.06, time_s=2.0)
        self.speed_wobble = self._wander(self.speed_wobble, std=0.10, time_s=5.0)
        curvature = np.clip(2 * np.sin(bearing) / LOOKAHEAD_M, -1.5, 1.5) + self.curvature_wobble
        difference = curvature * self.assumed_width_m / 2
        wanted = self.speed_mps * (1 + self.speed_wobble) * np.array([1 + difference, 1 - difference])
        most = SIDE_ACCELERATION_MPS2 * SAMPLE_S
        self.sides = self.sides + np.clip(wanted - self.sides, -most, most)
        return self.sides

    def _wander(self, value: float, *, std: float, time_s: float) -> float:
        kept = np.exp(-SAMPLE_S / time_s)
        return float(kept * value + std * np.sqrt(1 - kept**2) * self.rng.standard_normal())


def drive(robot: Robot, driver: Driver, start_heading_rad: float, samples: int) -> Motion:
    """Simulate the drive; the robot settles on its wheels before t = 0."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(describe_model(robot))
    data = mujoco.MjData(model)
    data.qpos[3:7] = np.cos(start_heading_rad / 2), 0.0, 0.0, -np.sin(start_heading_rad / 2)
    count = len(robot.wheel_forward_m)
    mujoco.mj_step(model, data, nstep=round(SETTLE_S / SAMPLE_S) * STEPS_PER_SAMPLE)
    origin = data.qpos[:2].copy()
    rows = np.empty((samples, 6))
    for k in range(samples):
        w, x, y, z = data.qpos[3:7]
        heading = -np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        north, west = data.qpos[:2] - origin
        left, right = data.qpos[7 : 7 + count].mean(), data.qpos[7 + count : 7 + 2 * count].mean()
        rows[k] = k * SAMPLE_S, north, -west, heading, left, right
        data.ctrl[:] = np.repeat(driver.steer(k * SAMPLE_S, north, -west, heading), count) / robot.wheel_radius_m
        mujoco.mj_step(model, data, nstep=STEPS_PER_SAMPLE)
    t, north_m, east_m, heading_rad, left_rad, right_rad = rows.T
    return Motion(t, north_m, east_m, np.unwrap(heading_rad), left_rad - left_rad[0], right_rad - right_rad[0])


def bend_path(heading_rad: Floats, step_m: float) -> Floats:
    """Return points (n, 2), north and east [m], `step_m` apart along the given headings."""
    return np.cumsum(np.column_stack([np.cos(heading_rad), np.sin(heading_rad)]) * step_m, axis=0)


def plan_lawnmower(length_m: float, start_heading_rad: float, step_m: float = 0.01) -> Floats:
    """Return a path of 9 m legs joined by half circles of 1 m radius, alternately to the right and to the left."""
    leg, radius = 9.0, 1.0
    turn = np.pi * radius
    s = np.arange(0.0, length_m, step_m)
    lap, within = np.divmod(s, leg + turn)
    angle = np.clip((within - leg) / radius, 0.0, np.pi)
    return bend_path(start_heading_rad + np.where(lap % 2 == 0, angle, np.pi - angle), step_m)


def plan_curved(length_m: float, start_heading_rad: float, step_m: float = 0.01) -> Floats:
    """Return a winding path: the heading varies by up to 1.7 rad, in two oscillations without a common period."""
    s = np.arange(0.0, length_m, step_m)
    return bend_path(start_heading_rad + 1.1 * np.sin(s / 2.3) + 0.6 * np.sin(s / 5.9), step_m)


def plan_figure_eight(length_m: float, start_heading_rad: float, step_m: float = 0.01) -> Floats:
    """Return a path of circles of 2.5 m radius, alternately clockwise and counter-clockwise."""
    radius = 2.5
    lap, within = np.divmod(np.arange(0.0, length_m, step_m), 2 * np.pi * radius)
    return bend_path(start_heading_rad + np.where(lap % 2 == 0, within, -within) / radius, step_m)
