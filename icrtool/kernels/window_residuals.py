"""Residuals of windows of driven distance for a motion model that is linear in its parameters, with derivatives.

With z = forward + j right, heading Theta and place S are sums over steps, and a window from knot s to knot e displaces
the robot, in the body frame of its start, by d = e^{-j Theta_s} (S_e - S_s). omega is linear in the parameters, so
d Theta / d theta does not depend on them; one pass over the steps gives both and their derivatives.
"""

from __future__ import annotations

import math

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.compiled import njit

VX, VY, OMEGA = 0, 1, 2
"""Axes of the body twist."""


@njit
def _derive_step(
    columns: Floats, axis: Ints, i: int, held: float, into: float, c: float, s: float, north: float, east: float,
    state: Floats, step: Floats,
) -> None:  # fmt: skip
    """Fill what a step i adds to the derivatives of heading and place (k, 3), from those at its begin, `state`."""
    for a in range(len(axis)):
        unit = columns[a, i] * held
        if axis[a] == VX:
            step[a, 1], step[a, 2] = unit * c, unit * s
        elif axis[a] == VY:
            step[a, 1], step[a, 2] = -unit * s, unit * c
        else:
            turned = (state[a, 0] + columns[a, i] * into) * held
            step[a, 0], step[a, 1], step[a, 2] = unit, -turned * east, turned * north


@njit
def sums_at_knots(
    fixed: Floats, columns: Floats, axis: Ints, parameters: Floats, held: Floats, into: Floats,
    t: Floats, at: Floats, rate: Floats, sums: Floats, by: Floats,
) -> None:  # fmt: skip
    """Fill heading, place and their derivatives at knots.

    Parameters
    ----------
    fixed : (3, n) twist without the free terms, v_x, v_y [m/s], omega [rad/s]
    columns : (k, n) twist per unit parameter of each free term, on its `axis` (k,); parameters : (k,)
    held : (n,) duration of each step [s], 0 over gaps; into : (n,) how far into the step its heading is taken [s]
    t, at : (n,), (m,) begin of each step and time of each knot [s], both ascending
    rate : (m, 3) filled with the velocity [m/s], forward and right in the frame of the path, and omega; 0 over gaps
    sums : (m, 3) filled with heading [rad] and place [m]
    by : (k, m, 3) filled with their derivatives
    """
    k, m, n = len(parameters), len(at), len(held)
    theta, x, y, knot = 0.0, 0.0, 0.0, 0
    state = np.zeros((k, 3))
    step = np.zeros((k, 3))
    for i in range(n):
        if knot >= m:
            return
        v_x, v_y, omega = fixed[0, i], fixed[1, i], fixed[2, i]
        for a in range(k):
            value = parameters[a] * columns[a, i]
            if axis[a] == VX:
                v_x += value
            elif axis[a] == VY:
                v_y += value
            else:
                omega += value
        c, s = math.cos(theta + omega * into[i]), math.sin(theta + omega * into[i])
        north, east = v_x * c - v_y * s, v_x * s + v_y * c
        _derive_step(columns, axis, i, held[i], into[i], c, s, north, east, state, step)
        moving = 1.0 if held[i] > 0.0 else 0.0
        while knot < m and (i == n - 1 or at[knot] < t[i + 1]):
            part = min(max(at[knot] - t[i], 0.0), held[i]) / held[i] if held[i] > 0.0 else 0.0
            rate[knot, 0], rate[knot, 1], rate[knot, 2] = moving * north, moving * east, moving * omega
            sums[knot, 0] = theta + part * omega * held[i]
            sums[knot, 1] = x + part * north * held[i]
            sums[knot, 2] = y + part * east * held[i]
            by[:, knot] = state + part * step
            knot += 1
        theta, x, y = theta + omega * held[i], x + north * held[i], y + east * held[i]
        state += step


@njit
def window_residuals(
    rate: Floats, sums: Floats, by: Floats, start: Ints, end: Ints, reference: Floats, offset: float, root: Floats,
    residual: Floats, jacobian: Floats,
) -> None:  # fmt: skip
    """Fill residuals, (d - d_ref) / sqrt(length), and their derivatives by terms, heading offset and delay of knots.

    Parameters
    ----------
    rate, sums, by : of `sums_at_knots`
    start, end : (w,) knots of each window; reference : (w, 2) displacement forward and right [m]; root : (w,) [m^0.5]
    offset : added to the reference's heading [rad]
    residual : (2 w,), forward then right; jacobian : (2 w, k + 2)
    """
    k, w = len(by), len(start)
    cos_offset, sin_offset = math.cos(offset), math.sin(offset)
    for i in range(w):
        s, e, scale = start[i], end[i], 1.0 / root[i]
        c, n = math.cos(sums[s, 0]), math.sin(sums[s, 0])
        dx, dy = sums[e, 1] - sums[s, 1], sums[e, 2] - sums[s, 2]
        # e^{-j offset} d_ref
        forward = reference[i, 0] * cos_offset + reference[i, 1] * sin_offset
        right = reference[i, 1] * cos_offset - reference[i, 0] * sin_offset
        residual[i] = (dx * c + dy * n - forward) * scale
        residual[w + i] = (dy * c - dx * n - right) * scale
        for a in range(k):
            turned = by[a, s, 0]
            # the derivative of e^{-j Theta_s} times the displacement is -j dTheta_s times it
            gx = by[a, e, 1] - by[a, s, 1] + turned * dy
            gy = by[a, e, 2] - by[a, s, 2] - turned * dx
            jacobian[i, a] = (gx * c + gy * n) * scale
            jacobian[w + i, a] = (gy * c - gx * n) * scale
        jacobian[i, k], jacobian[w + i, k] = -right * scale, forward * scale
        gx = rate[e, 0] - rate[s, 0] + rate[s, 2] * dy
        gy = rate[e, 1] - rate[s, 1] - rate[s, 2] * dx
        jacobian[i, k + 1], jacobian[w + i, k + 1] = (gx * c + gy * n) * scale, (gy * c - gx * n) * scale
