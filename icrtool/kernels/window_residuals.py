"""Paths of a motion model that is linear in its parameters, and residuals of windows of a path, with derivatives.

With z = forward + j right, heading Theta and place S are sums over the steps. A window from knot s to knot e displaces
the robot, in the body frame of its start, by d = e^{-j Theta_s} (S_e - S_s). omega is linear in the parameters theta,
so d Theta / d theta does not depend on them. Cumulative sums over the steps give Theta, S and their derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import ROWS_AT_ONCE, Complexes, Floats, Ints
from icrtool.kernels.track import Track

Number = TypeVar("Number", np.float64, np.complex128)

VX, VY, OMEGA = 0, 1, 2
"""Axes of the body twist."""

Twists = Callable[[slice], tuple[Floats, Ints, Floats]]
"""Function that returns for a slice of n steps: the twist without the free terms (3, n), v_x, v_y [m/s], omega [rad/s];
the axis of each free term (k,); the twist per unit of each parameter (k, n)."""


class PathKnots(NamedTuple):
    """A path at knots, and its derivatives by k terms: place and velocity are forward + j right in the first frame.

    Attributes
    ----------
    heading, turn_rate : (m,) [rad, rad/s]; place, velocity : complex (m,) [m, m/s]; the rates are 0 over gaps
    heading_by : (k, m) derivatives of the heading; place_by : complex (k, m) derivatives of the place
    """

    heading: Floats
    turn_rate: Floats
    place: Complexes
    velocity: Complexes
    heading_by: Floats
    place_by: Complexes


def sums_from(first: NDArray[Number], parts: NDArray[Number]) -> NDArray[Number]:
    """Return cumulative sums (..., n + 1) of parts (..., n), beginning with the first values (...)."""
    sums = np.empty((*parts.shape[:-1], parts.shape[-1] + 1), parts.dtype)
    sums[..., 0] = first
    sums[..., 1:] = parts
    np.cumsum(sums, axis=-1, out=sums)
    return sums


def path_at(track: Track, twists: Twists, parameters: Floats, at: Floats) -> PathKnots:
    """Return the path that a model makes of the wheel samples of a track, at knots.

    Parameters
    ----------
    track : track of the drive
    twists : returns the twists of some steps; all steps of a long drive would need much memory
    parameters : (k,) parameters of the free terms
    at : (m,) time of each knot [s], ascending
    """
    k, m = len(parameters), len(at)
    # These are the step of each knot and the part of the step before it. In a gap the speeds end with the step.
    row = np.maximum(np.searchsorted(track.t, at, side="right") - 1, 0)
    held = track.held[row]
    part = np.divide(np.clip(at - track.t[row], 0.0, held), held, out=np.zeros(m), where=held > 0.0)
    knots = PathKnots(
        np.empty(m), np.empty(m), np.empty(m, np.complex128), np.empty(m, np.complex128),
        np.zeros((k, m)), np.empty((k, m), np.complex128),
    )  # fmt: skip
    heading, place = np.zeros(1), np.zeros(1, np.complex128)
    turning, direction = np.empty(0, np.int64), np.empty((0, 1))
    heading_by, place_by = np.empty(0), np.zeros(k, np.complex128)
    for lo in range(0, len(track.t), ROWS_AT_ONCE):
        chunk = slice(lo, lo + ROWS_AT_ONCE)
        fixed, axis, columns = twists(chunk)
        if not lo:
            turning, direction = np.flatnonzero(axis == OMEGA), np.where(axis == VX, 1.0, 1j)[:, None]
            heading_by = np.zeros(len(turning))
        lasting = track.held[chunk]
        ahead = track.into * lasting
        v_x, v_y, omega = (
            fixed[component] + parameters[axis == component] @ columns[axis == component]
            for component in (VX, VY, OMEGA)
        )
        here = slice(*np.searchsorted(row, [lo, lo + len(lasting)]))
        step, share = row[here] - lo, part[here]
        turned = lasting * omega
        heading = sums_from(heading[-1], turned)
        angle, forward = heading[:-1] + ahead * omega, np.empty(len(lasting), np.complex128)
        forward.real, forward.imag = np.cos(angle), np.sin(angle)
        velocity = (v_x + 1j * v_y) * forward
        moved = lasting * velocity
        place = sums_from(place[-1], moved)
        moving = lasting[step] > 0.0
        knots.heading[here] = heading[step] + share * turned[step]
        knots.turn_rate[here] = np.where(moving, omega[step], 0.0)
        knots.place[here] = place[step] + share * moved[step]
        knots.velocity[here] = np.where(moving, velocity[step], 0.0)
        by = lasting * columns
        turned_by = sums_from(heading_by, by[turning])
        knots.heading_by[turning, here] = turned_by[:, step] + share * by[turning][:, step]
        moved_by = by * forward
        moved_by[turning] = (turned_by[:, :-1] + ahead * columns[turning]) * moved
        sums = sums_from(place_by, moved_by)
        # Turns, and velocities to the right, move the place at right angles to the summed direction.
        knots.place_by[:, here] = (sums[:, step] + share * moved_by[:, step]) * direction
        heading_by, place_by = turned_by[:, -1], sums[:, -1]
    return knots


def displacements(path: PathKnots, start: Ints, end: Ints) -> tuple[Complexes, Complexes]:
    """Return the displacements (w,) of windows of a path, forward + j right in the body frame of their start [m].

    The second result is their derivatives (k + 1, w) by the terms, and by a delay of the knots [s].
    """
    back, moved = np.exp(-1j * path.heading[start]), path.place[end] - path.place[start]
    by = np.empty((len(path.heading_by) + 1, len(start)), np.complex128)
    # The factor e^{-j Theta_s} adds -j dTheta_s times the displacement to the derivatives.
    by[:-1] = path.place_by[:, end] - path.place_by[:, start] - 1j * path.heading_by[:, start] * moved
    by[-1] = path.velocity[end] - path.velocity[start] - 1j * path.turn_rate[start] * moved
    return back * moved, back * by


def window_residuals(
    path: PathKnots, start: Ints, end: Ints, reference: Complexes, offset: float, root: Floats,
    shortened: Floats | float = 1.0,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return residuals (2 w,), (d - d_ref) / sqrt(length), forward then right, and their derivatives (2 w, k + 2).

    The derivatives are by the terms, by the heading offset [rad] and by a delay of the knots [s].

    Parameters
    ----------
    path : path at knots
    start, end : (w,) knots of each window; reference : complex (w,) displacement [m]; root : (w,) [m^0.5]
    offset : angle that is added to the reference's heading [rad]
    shortened : (w,) ratio of the mean displacement with a wandering heading to the displacement without
    """
    moved, by = displacements(path, start, end)
    turned = np.exp(-1j * offset) * reference
    residual = (shortened * moved - turned) / root
    by *= shortened
    by = np.concatenate([by[:-1], 1j * turned[None], by[-1:]])
    by /= root
    return np.concatenate([residual.real, residual.imag]), np.concatenate([by.real, by.imag], axis=1).T


def turn_residuals(path: PathKnots, start: Ints, end: Ints, turned: Floats, root: Floats) -> tuple[Floats, Floats]:
    """Return residuals (w,) of the turns of windows, (turn - turn_ref) / sqrt(length), and derivatives (w, k + 2).

    The derivatives are by the same quantities as in `window_residuals`.

    Parameters
    ----------
    path : path at knots
    start, end : (w,) knots of each window; turned : (w,) turn of the reference [rad]; root : (w,) [m^0.5]
    """
    by = np.zeros((len(path.heading_by) + 2, len(start)))
    by[:-2] = path.heading_by[:, end] - path.heading_by[:, start]
    by[-1] = path.turn_rate[end] - path.turn_rate[start]
    return (path.heading[end] - path.heading[start] - turned) / root, (by / root).T
