"""A skid-steer robot on flat ground with friction, load transfer and lag: its ICRs follow from the contact forces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icrtool.kernels.arrays import Bools, Floats
from icrtool.kernels.friction import SlidingBody, slide
from icrtool.kernels.kinematics import lag
from icrtool.records.tables import Icrs
from icrtool.simulation.truths import FrictionTruth

STEERING_HZ = 0.5
"""Ratio of the turn rate that the driver commands to the heading error [rad/s per rad]. An error halves in 1.4 s."""

LARGEST_TURN_RADPS = 2.0
"""Largest turn rate that the driver commands [rad/s]."""

GRIP_CELL_M = 0.1
"""Length of the cells of ground in which the friction is constant [m]."""

GRIP_CELLS = 20_000
"""Number of cells before the ground repeats: 2 km."""

LEAST_FRICTION = 0.05
"""Smallest friction coefficient that is drawn: below it a robot hardly moves."""

ICR_WINDOW_S = 2.0
"""Time over which ICRs are fitted to the motion [s]. Single steps of a straight drive show no ICRs."""

SHOWN_TURN_RADPS = 0.02
"""Turn rate at which the motion has the same weight as the mean ICRs of the whole drive [rad/s]."""


@dataclass(frozen=True, slots=True)
class FrictionRobot:
    """A robot and its ground; the defaults are the wheeled robot of Pentzer 2014, Section 4.

    Attributes
    ----------
    half_track_m : distance from the middle to the centre line of a side
    contact_forward_m : places of the contacts of a side, ahead of the body origin: two wheels, or a track's road wheels
    mass_forward_m, mass_height_m : centre of mass, ahead of the body origin and above the ground
    gyration_m : radius of gyration about the vertical axis
    friction : Coulomb's coefficient along the track
    lateral_friction : sideways, as a multiple of it. With 2.4 the wheeled robot has the mean ICRs of the paper's Table
        II, with 2.0 the tracked robot has the mean ICRs of Table I.
    friction_std : standard deviation of the friction of each side along the path, as a share of it
    friction_length_m : distance over which the friction's variation is correlated
    creep : share of the track speed at which friction is 0.7 of its limit: soft ground has more
    slip_mps : sliding speed at which friction is 0.7 of its limit while a track stands
    resistance : rolling resistance over load
    mass_right_m : centre of mass, right of the body origin
    """

    mass_kg: float = 118.0
    half_track_m: float = 0.305
    contact_forward_m: tuple[float, ...] = (0.2, -0.2)
    mass_forward_m: float = 0.0
    mass_height_m: float = 0.3
    gyration_m: float = 0.3
    friction: float = 0.7
    lateral_friction: float = 2.4
    friction_std: float = 0.1
    friction_length_m: float = 2.0
    creep: float = 0.03
    slip_mps: float = 0.02
    resistance: float = 0.0
    mass_right_m: float = 0.0


TRACKED_ROBOT = FrictionRobot(
    mass_kg=37.0, half_track_m=0.26, contact_forward_m=(0.2, 0.1, 0.0, -0.1, -0.2), mass_forward_m=0.1,
    mass_height_m=0.12, gyration_m=0.2, friction=0.6, lateral_friction=2.0,
)  # fmt: skip
"""The tracked robot of Pentzer 2014, Section 4; five road wheels a side over 0.40 m are an assumption."""


def scaled_robot(robot: FrictionRobot, track_width_m: float) -> FrictionRobot:
    """Return a robot of another track width b [m]: lengths grow with b, the mass with its square."""
    factor = track_width_m / (2.0 * robot.half_track_m)
    lengths = ("half_track_m", "mass_forward_m", "mass_right_m", "mass_height_m", "gyration_m")
    return replace(
        robot,
        mass_kg=robot.mass_kg * factor**2,
        contact_forward_m=tuple(x * factor for x in robot.contact_forward_m),
        **{name: factor * getattr(robot, name) for name in lengths},
    )


def draw_grip(robot: FrictionRobot, rng: np.random.Generator) -> Floats:
    """Return the friction coefficient (g, 2) of left and right side, by cell of driven distance.

    A first-order autoregression along the path, independent for each side: left and right wheels run on different
    ground.
    """
    kept = np.exp(-GRIP_CELL_M / robot.friction_length_m)
    grip = np.empty((GRIP_CELLS, 2))
    for side in range(2):
        steps = rng.normal(0.0, np.sqrt(1.0 - kept**2), GRIP_CELLS)
        column = np.append(rng.normal(), steps[:-1] / (1.0 - kept))
        lag(column, np.full(GRIP_CELLS - 1, kept))
        grip[:, side] = robot.friction * (1.0 + robot.friction_std * column)
    return np.maximum(grip, LEAST_FRICTION)


def slide_path(
    robot: FrictionRobot, t: Floats, forward: Floats, turn: Floats, decides: Bools, icrs_m: Icrs, *,
    start_heading_rad: float, lag_s: float, rng: np.random.Generator, slope: Floats | None = None, steers: bool = True,
) -> FrictionTruth:  # fmt: skip
    """Return the motion of a robot whose driver follows the headings of a path.

    Parameters
    ----------
    t : (n,) increasing [s]
    forward, turn : (n,) velocity [m/s] and turn rate [rad/s], clockwise positive, that the driver wants
    decides : (n,) whether the driver gives new commands at a row
    icrs_m : ICRs by which the driver turns velocities into track speeds
    lag_s : time constant of the motors; 0: none
    rng : draws the ground
    slope : (n, 2) downhill slope ahead and to the right, as a share of the weight; default: flat ground
    steers : the driver corrects the heading; False: `forward` and `turn` are commanded as they are
    """
    heading = start_heading_rad + np.concatenate([[0.0], np.cumsum(turn[:-1] * np.diff(t))])
    x = np.array(robot.contact_forward_m * 2, np.float64)
    y = np.repeat([robot.half_track_m, -robot.half_track_m], len(robot.contact_forward_m))
    body = SlidingBody(
        mass=robot.mass_kg, inertia=robot.mass_kg * robot.gyration_m**2, mass_forward=robot.mass_forward_m,
        mass_right=robot.mass_right_m, mass_height=robot.mass_height_m, slip=robot.slip_mps, creep=robot.creep,
        lateral=robot.lateral_friction, resistance=robot.resistance, lag=lag_s,
        steering=STEERING_HZ if steers else 0.0, largest_turn=LARGEST_TURN_RADPS if steers else np.inf,
        y_right=float(icrs_m[0]), y_left=float(icrs_m[1]), cell=GRIP_CELL_M,
    )  # fmt: skip
    n = len(t)
    commands, tracks, pose, velocity = (np.empty((n, columns)) for columns in (2, 2, 3, 3))
    pose[0] = 0.0, 0.0, start_heading_rad
    slide(
        t, np.asarray(forward, np.float64).copy(), np.asarray(turn, np.float64).copy(), heading,
        decides.astype(np.int64), x, y, draw_grip(robot, rng), np.zeros((n, 2)) if slope is None else slope, body,
        commands, tracks, pose, velocity,
    )  # fmt: skip
    travel = np.vstack([np.zeros(2), np.cumsum(tracks[:-1] * np.diff(t)[:, None], axis=0)])
    (command_left, command_right), (left, right) = commands.T.copy(), tracks.T.copy()
    return FrictionTruth(
        t_s=t, command_left_mps=command_left, command_right_mps=command_right, v_left_mps=left, v_right_mps=right,
        travel_left_m=travel[:, 0].copy(), travel_right_m=travel[:, 1].copy(), pose=pose, velocity=velocity,
        icrs_m=fitted_icrs(t, velocity, left, right),
    )  # fmt: skip


def fitted_icrs(t: Floats, velocity: Floats, left: Floats, right: Floats) -> Floats:
    """Return the ICRs (n, 3) that best explain the motion around each time.

    Notes
    -----
    Pentzer 2014, Eqs. 8-10: V_r = v_x - omega y_r, V_l = v_x - omega y_l, v_y = -omega x. Least squares over
    `ICR_WINDOW_S`, towards the ICRs of the whole drive where the robot hardly turns there.
    """
    v_x, v_y, omega = velocity.T
    dt = np.append(np.diff(t), 0.0)
    products = np.column_stack([omega * (v_x - right), omega * (v_x - left), -omega * v_y, omega**2]) * dt[:, None]
    sums = np.vstack([np.zeros(4), np.cumsum(products, axis=0)])
    begin, end = (np.searchsorted(t, t + shift) for shift in (-ICR_WINDOW_S / 2.0, ICR_WINDOW_S / 2.0))
    near, whole = sums[end] - sums[begin], sums[-1]
    if whole[3] == 0.0:
        return np.full((len(t), 3), np.nan)
    pull = SHOWN_TURN_RADPS**2 * ICR_WINDOW_S
    return np.asarray((near[:, :3] + pull * whole[:3] / whole[3]) / (near[:, 3:] + pull))
