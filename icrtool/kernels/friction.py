"""A planar skid-steer robot whose contacts slide with Coulomb friction: its ICRs follow from forces."""

from __future__ import annotations

import math
from typing import NamedTuple

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.compiled import njit, njit_part

GRAVITY_MPS2 = 9.81
"""Acceleration of gravity [m/s^2]."""

ROLLING_MPS = 0.02
"""Speed at which the rolling resistance is 0.7 of its limit [m/s]: it keeps the equations smooth about standstill."""

LONGEST_SUBSTEP_S = 0.001
"""Longest step of the integration [s]: friction damps a sliding contact within some 3 ms."""

LOAD_FOLLOWS_S = 0.05
"""Time constant with which the load of the contacts follows the acceleration [s]: the suspension of the body."""


class SlidingBody(NamedTuple):
    """Constants of a robot and its driver.

    Attributes
    ----------
    mass : mass of the robot [kg]
    inertia : moment of inertia about the vertical axis through the centre of mass [kg m^2]
    mass_forward, mass_right, mass_height : position of the centre of mass: ahead and to the right of the body origin,
        and above the ground [m]
    slip : sliding speed at which friction is 0.7 of its limit while a track stands [m/s]
    creep : growth of this sliding speed with the track speed
    lateral : ratio of the friction sideways to the friction along the track
    resistance : ratio of the rolling resistance to the load
    lag : time constant of the motors [s]; 0: no lag
    steering : turn rate commanded for a heading error [1/s]
    largest_turn : largest turn rate that the driver commands [rad/s]
    y_right, y_left : ICRs by which the driver turns velocities into track speeds [m]
    cell : length of the cells of `grip` [m]
    """

    mass: float
    inertia: float
    mass_forward: float
    mass_right: float
    mass_height: float
    slip: float
    creep: float
    lateral: float
    resistance: float
    lag: float
    steering: float
    largest_turn: float
    y_right: float
    y_left: float
    cell: float


@njit_part
def contact_forces(
    v_x: float, v_y: float, omega: float, left: float, right: float, per_x: float, per_y: float, contact_x: Floats,
    contact_y: Floats, grip: Floats, body: SlidingBody,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the force ahead and to the right [N], and its moment about the centre of mass [N m], of all contacts.

    Parameters
    ----------
    v_x, v_y, omega : velocity of the body origin [m/s] and turn rate [rad/s]
    left, right : track speeds [m/s]
    per_x, per_y : growth of a contact's load with its place ahead and to the right [N/m]
    contact_x, contact_y : (c,) contacts, body frame [m]
    grip : (2,) friction coefficient of left and right side
    body : constants

    Notes
    -----
    A contact with load p that slides with velocity s is held back by mu p s / sqrt(|s|^2 + s0^2) (regularised Coulomb
    friction).
    """
    force_x, force_y, moment = 0.0, 0.0, 0.0
    for i in range(len(contact_x)):
        x, y = contact_x[i], contact_y[i]
        load = max(body.mass * GRAVITY_MPS2 / len(contact_x) + per_x * x + per_y * y, 0.0)
        track = right if y > 0.0 else left
        along = v_x - omega * y
        slip_x, slip_y = along - track, v_y + omega * x
        smooth = body.slip + body.creep * abs(track)
        limit = grip[1 if y > 0.0 else 0] * load
        held = limit / math.sqrt(slip_x * slip_x + slip_y * slip_y + smooth * smooth)
        drag = body.resistance * load * along / math.sqrt(along * along + ROLLING_MPS * ROLLING_MPS)
        f_x, f_y = -held * slip_x - drag, -held * body.lateral * slip_y
        force_x += f_x
        force_y += f_y
        moment += (x - body.mass_forward) * f_y - (y - body.mass_right) * f_x
    return force_x, force_y, moment


@njit_part
def second_moments(contact_x: Floats, contact_y: Floats) -> tuple[float, float]:
    """Return the sums of the squared places of contacts (c,) ahead and to the right [m^2]."""
    sum_xx, sum_yy = 0.0, 0.0
    for i in range(len(contact_x)):
        sum_xx += contact_x[i] * contact_x[i]
        sum_yy += contact_y[i] * contact_y[i]
    return sum_xx, sum_yy


@njit_part
def load_growth(a_x: float, a_y: float, sum_xx: float, sum_yy: float, body: SlidingBody) -> tuple[float, float]:
    """Return the growth of a contact's load with its place ahead and to the right [N/m].

    Parameters
    ----------
    a_x, a_y : acceleration that the load follows [m/s^2]
    sum_xx, sum_yy : `second_moments` of the contacts [m^2]
    body : the simulated body
    """
    per_x = (GRAVITY_MPS2 * body.mass_forward - a_x * body.mass_height) * body.mass / sum_xx
    per_y = (GRAVITY_MPS2 * body.mass_right - a_y * body.mass_height) * body.mass / sum_yy
    return per_x, per_y


@njit_part
def driver_commands(forward: float, turn: float, heading_error: float, body: SlidingBody) -> tuple[float, float]:
    """Return the track speeds [m/s], left and right, that the driver commands.

    Parameters
    ----------
    forward, turn : velocity [m/s] and turn rate [rad/s] that the driver wants
    heading_error : wanted minus true heading [rad], which the driver steers against
    body : the simulated body
    """
    wanted = turn + body.steering * heading_error
    wanted = min(max(wanted, -body.largest_turn), body.largest_turn)
    return forward - body.y_left * wanted, forward - body.y_right * wanted


@njit_part
def origin_velocity(u: float, w: float, omega: float, body: SlidingBody) -> tuple[float, float]:
    """Return the velocity of the body origin, ahead and to the right [m/s].

    Parameters
    ----------
    u, w, omega : velocity of the centre of mass, ahead and to the right [m/s], and turn rate [rad/s]
    body : the simulated body
    """
    return u + omega * body.mass_right, w - omega * body.mass_forward


@njit_part
def moved_pose(
    north: float, east: float, psi: float, v_x: float, v_y: float, omega: float, dt: float
) -> tuple[float, float, float]:
    """Return the pose N, E [m], psi [rad] after `dt` [s] at a body velocity [m/s] and a turn rate [rad/s]."""
    middle = psi + 0.5 * dt * omega
    north += dt * (v_x * math.cos(middle) - v_y * math.sin(middle))
    east += dt * (v_x * math.sin(middle) + v_y * math.cos(middle))
    return north, east, psi + dt * omega


@njit
def slide(
    t: Floats, forward: Floats, turn: Floats, heading: Floats, decides: Ints, contact_x: Floats, contact_y: Floats,
    grip: Floats, slope: Floats, body: SlidingBody, commands: Floats, tracks: Floats, pose: Floats, velocity: Floats,
) -> None:  # fmt: skip
    """Integrate the motion of a robot on sliding contacts, and of the driver who steers it.

    Parameters
    ----------
    t : (n,) increasing [s]
    forward, turn, heading : (n,) velocity [m/s], turn rate [rad/s] and heading [rad] that the driver wants
    decides : (n,) 1 where the driver gives new commands, else 0
    contact_x, contact_y : (c,) contacts, body frame (x forward, y right) [m]; the sign of y is the side
    grip : (g, 2) friction coefficient of left and right side by cell of distance; it repeats
    slope : (n, 2) downhill slope ahead and to the right, as a share of the weight
    body : constants
    commands, tracks : (n, 2) become commanded speeds, and mean true speeds until the next time, left and right [m/s]
    pose : (n, 3) row 0 is the start; becomes N, E [m], psi [rad]
    velocity : (n, 3) becomes v_x, v_y [m/s], omega [rad/s] of the body origin

    Notes
    -----
    The equations of Newton and Euler in the body frame, with the forces of `contact_forces`, are solved in
    semi-implicit Euler steps of at most `LONGEST_SUBSTEP_S`. The load shifts with the acceleration and the height of
    the centre of mass.
    """
    cells = len(grip)
    sum_xx, sum_yy = second_moments(contact_x, contact_y)
    north, east, psi = pose[0, 0], pose[0, 1], pose[0, 2]
    # velocity of the centre of mass, acceleration that the load follows, distance; track speeds, commands
    u, w, omega, a_x, a_y, driven = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    left, right, command_left, command_right = 0.0, 0.0, 0.0, 0.0
    for k in range(len(t)):
        if decides[k]:
            command_left, command_right = driver_commands(forward[k], turn[k], heading[k] - psi, body)
        if k == 0:
            left, right, u, omega = command_left, command_right, forward[0], turn[0]
            w = omega * body.mass_forward
        v_x, v_y = origin_velocity(u, w, omega, body)
        commands[k, 0], commands[k, 1], tracks[k, 0], tracks[k, 1] = command_left, command_right, left, right
        pose[k, 0], pose[k, 1], pose[k, 2] = north, east, psi
        velocity[k, 0], velocity[k, 1], velocity[k, 2] = v_x, v_y, omega
        if k + 1 == len(t):
            break
        steps = math.ceil((t[k + 1] - t[k]) / LONGEST_SUBSTEP_S - 1e-9)
        dt = (t[k + 1] - t[k]) / steps
        kept = math.exp(-dt / body.lag) if body.lag > 0.0 else 0.0
        followed = 1.0 - math.exp(-dt / LOAD_FOLLOWS_S)
        mean_left, mean_right = 0.0, 0.0
        for _ in range(steps):
            left, right = command_left + (left - command_left) * kept, command_right + (right - command_right) * kept
            mean_left, mean_right = mean_left + left / steps, mean_right + right / steps
            v_x, v_y = origin_velocity(u, w, omega, body)
            cell = int(driven / body.cell) % cells
            per_x, per_y = load_growth(a_x, a_y, sum_xx, sum_yy, body)
            force_x, force_y, moment = contact_forces(
                v_x, v_y, omega, left, right, per_x, per_y, contact_x, contact_y, grip[cell], body
            )
            pull_x = force_x / body.mass + GRAVITY_MPS2 * slope[k, 0]
            pull_y = force_y / body.mass + GRAVITY_MPS2 * slope[k, 1]
            a_x, a_y = a_x + (pull_x - a_x) * followed, a_y + (pull_y - a_y) * followed
            u, w, omega = (
                u + dt * (pull_x + omega * w),
                w + dt * (pull_y - omega * u),
                omega + dt * moment / body.inertia,
            )
            v_x, v_y = origin_velocity(u, w, omega, body)
            north, east, psi = moved_pose(north, east, psi, v_x, v_y, omega, dt)
            driven += dt * math.sqrt(v_x * v_x + v_y * v_y)
        tracks[k, 0], tracks[k, 1] = mean_left, mean_right
