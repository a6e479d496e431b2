"""Compiled Gauss-Newton steps with the windows of a drive that have just ended, for a model that learns as it drives.

Path, residuals and derivatives are the same as in `icrtool.kernels.window_residuals`, weights and normal equations the
same as in `icrtool.kernels.robust` and `icrtool.kernels.elimination`. The kernel is compiled because there are only a
few dozen windows at a time, and calls of NumPy would take most of the time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Complexes, Floats, Ints
from icrtool.kernels.compiled import njit, njit_part
from icrtool.kernels.robust import LOSS_SIGMAS


class LearnedWindows(NamedTuple):
    """Windows of a drive, and the wheel samples that a model moves them with.

    Attributes
    ----------
    t, held : (n,) begin of each wheel sample [s], and how long it holds [s]
    into : share of a wheel sample's time after which its heading is taken
    fixed : (3, n) twist without the free terms; axis : (p,) axis of each term; columns : (p, n) twist per unit of each
        term; values : (p,) of the terms
    knot_t : (m,) time of each knot [s], ascending, the delay of the poses added
    begin, end : (w,) knots of each window
    moved : (w,) displacement of the reference, forward + j right in the body frame of the begin [m]
    turned : (w,) turn of the reference [rad]
    length_m : (w,); offset : added to the reference's heading [rad]
    wander : growth of the variance of the path's heading [rad^2/m]
    """

    t: Floats
    held: Floats
    into: float
    fixed: Floats
    axis: Ints
    columns: Floats
    values: Floats
    knot_t: Floats
    begin: Ints
    end: Ints
    moved: Complexes
    turned: Floats
    length_m: Floats
    offset: float
    wander: float


class Belief(NamedTuple):
    """Estimate of q parameters and its information: p terms (the first k are a model's), heading offset, delay.

    Attributes
    ----------
    x : (q,), changed in place
    information, pull : (q, q), (q,) of the prior: information, and information times mean
    matrix, vector : (q, q), (q,) normal equations of the data; windows are added in place
    scale : (2,) robust standard deviation of the residuals of displacements and turns
    overlap : number of residuals that count as one independent residual
    largest_delay_s : limit of the size of the delay [s]
    """

    x: Floats
    information: Floats
    pull: Floats
    matrix: Floats
    vector: Floats
    scale: Floats
    overlap: float
    largest_delay_s: float


UNIT_AXES = np.eye(3)
"""Column by column, the axis of a twist."""


@njit_part
def follow_path(
    t: Floats, held: Floats, into: float, fixed: Floats, axes: Floats, columns: Floats, values: Floats, knot_t: Floats,
    sums: Floats, by: Floats, knots: Floats,
) -> None:  # fmt: skip
    """Fill the knots (m, 3 (p + 2)) of the path by the wheel samples; sums (0), by: (3 (p + 2),) of memory.

    A knot has the derivatives of the heading by each term, its rate, and its value; then those of the place ahead, and
    of the place to the right.
    """
    n, m, p = len(t), len(knot_t), len(values)
    value, wide, knot = p + 1, p + 2, 0
    for i in range(n):
        lasting = held[i]
        v_x = fixed[0, i]
        v_y = fixed[1, i]
        omega = fixed[2, i]
        for j in range(p):
            added = values[j] * columns[j, i]
            v_x += axes[0, j] * added
            v_y += axes[1, j] * added
            omega += axes[2, j] * added
        angle = sums[value] + into * lasting * omega
        c = math.cos(angle)
        s = math.sin(angle)
        ahead = lasting * (v_x * c - v_y * s)
        aside = lasting * (v_x * s + v_y * c)
        by[value] = lasting * omega
        by[wide + value] = ahead
        by[2 * wide + value] = aside
        for j in range(p):
            along = lasting * columns[j, i]
            by[j] = axes[2, j] * along
            # a turn moves the path at right angles to its motion
            turn = sums[j] + into * by[j]
            by[wide + j] = along * (axes[0, j] * c - axes[1, j] * s) - turn * aside
            by[2 * wide + j] = along * (axes[0, j] * s + axes[1, j] * c) + turn * ahead
        while knot < m and (i + 1 == n or knot_t[knot] < t[i + 1]):
            share, rate = 0.0, 0.0
            if lasting > 0.0 and knot_t[knot] > t[i]:
                share = (knot_t[knot] - t[i]) / lasting
                share = min(share, 1.0)
            if lasting > 0.0:
                rate = 1.0 / lasting
            for j in range(3 * wide):
                knots[knot, j] = sums[j] + share * by[j]
            for j in range(p, 3 * wide, wide):
                knots[knot, j] = rate * by[j + 1]
            knot += 1
        for j in range(3 * wide):
            sums[j] += by[j]


@njit_part
def compare_windows(
    knots: Floats, windows: Ints, seen: Floats, offset: float, k: int, residuals: Floats, jacobian: Floats
) -> None:
    """Fill residuals (3 w,), forward, right and turn over sqrt(length), and derivatives (3 w, q) by all parameters.

    The order of the parameters is that of `Belief`. windows (2, w): knots of begin and end; seen (5, w): displacement
    of the reference forward and right, its turn, each over sqrt(length); 1 / sqrt(length), and times the shortening.
    """
    w, wide = windows.shape[1], knots.shape[1] // 3
    p, value = wide - 2, wide - 1
    co, so = math.cos(offset), math.sin(offset)
    for i in range(w):
        b = windows[0, i]
        e = windows[1, i]
        c = seen[4, i] * math.cos(knots[b, value])
        s = seen[4, i] * math.sin(knots[b, value])
        ahead = knots[e, wide + value] - knots[b, wide + value]
        aside = knots[e, 2 * wide + value] - knots[b, 2 * wide + value]
        seen_ahead = co * seen[0, i] + so * seen[1, i]
        seen_aside = co * seen[1, i] - so * seen[0, i]
        residuals[i] = c * ahead + s * aside - seen_ahead
        residuals[w + i] = c * aside - s * ahead - seen_aside
        residuals[2 * w + i] = (knots[e, value] - knots[b, value]) * seen[3, i] - seen[2, i]
        jacobian[i, k] = -seen_aside
        jacobian[w + i, k] = seen_ahead
        jacobian[2 * w + i, k] = 0.0
        for j in range(p + 1):
            at = j
            if j == p:
                at = k + 1
            elif j >= k:
                at = j + 2
            # a turn of the frame by -turn moves the displacement at right angles
            turn = knots[b, j]
            by_ahead = knots[e, wide + j] - knots[b, wide + j] + turn * aside
            by_aside = knots[e, 2 * wide + j] - knots[b, 2 * wide + j] - turn * ahead
            jacobian[i, at] = c * by_ahead + s * by_aside
            jacobian[w + i, at] = c * by_aside - s * by_ahead
            jacobian[2 * w + i, at] = (knots[e, j] - turn) * seen[3, i]


@njit_part
def solve_positive(matrix: Floats, q: int) -> None:
    """Replace the last row of a matrix (q + 1, q) by the solution of the rows above it (Cholesky); NaN if singular."""
    for a in range(q + 1):
        for b in range(q):
            if b <= a:
                total = matrix[a, b]
                for i in range(b):
                    total -= matrix[a, i] * matrix[b, i]
                # the last row becomes the solution of the first triangle
                matrix[a, b] = math.sqrt(total) if a == b else total / matrix[b, b]
    for a in range(q - 1, -1, -1):
        total = matrix[q, a]
        for i in range(a + 1, q):
            total -= matrix[i, a] * matrix[q, i]
        matrix[q, a] = total / matrix[a, a]


@njit
def take_windows(  # noqa: C901, PLR0912 - fewer functions are compiled in less time
    t: Floats, held: Floats, into: float, fixed: Floats, axes: Floats, columns: Floats, values: Floats, knot_t: Floats,
    windows: Ints, seen: Floats, offset: float, belief: Floats, scale: Floats, overlap: float, largest_delay_s: float,
    k: int, steps: int, sums: Floats, by: Floats, knots: Floats, residuals: Floats, jacobian: Floats, change: Floats,
    added: Floats, whole: Floats,
) -> None:  # fmt: skip
    """Take `steps` Gauss-Newton steps with windows, linearised at the first parameters, and add their equations.

    Parameters
    ----------
    t to offset, sums, by, knots : as in `follow_path` and `compare_windows`
    belief : (2 q + 3, q): information and matrix (q, q) each, pull, vector, x, of `Belief`
    scale, overlap, largest_delay_s : as in `Belief`
    k : number of the model's terms
    change : (q,), 0; residuals, jacobian : (3 w,), (3 w, q); added, whole : (q + 1, q); all are memory for intermediate
        results
    """
    follow_path(t, held, into, fixed, axes, columns, values, knot_t, sums, by, knots)
    compare_windows(knots, windows, seen, offset, k, residuals, jacobian)
    m, q = jacobian.shape
    last = 2 * q + 2
    for step in range(steps + 1):
        for a in range(q + 1):
            for b in range(q):
                added[a, b] = 0.0
        for i in range(m):
            here, target = residuals[i], -residuals[i]
            for a in range(q):
                here += jacobian[i, a] * change[a]
                target += jacobian[i, a] * (belief[last, a] - change[a])
            std = scale[0] if 3 * i < 2 * m else scale[1]
            z = here / std / LOSS_SIGMAS
            weight = 1.0 / math.sqrt(1.0 + z * z) / overlap / (std * std)
            for a in range(q):
                weighted = weight * jacobian[i, a]
                added[q, a] += weighted * target
                for b in range(a + 1):
                    added[a, b] += weighted * jacobian[i, b]
        if step == steps:
            break
        for a in range(q):
            for b in range(a + 1):
                whole[a, b] = added[a, b] + belief[a, b] + belief[q + a, b]
            whole[q, a] = added[q, a] + belief[2 * q, a] + belief[2 * q + 1, a]
        solve_positive(whole, q)
        delay, finite = whole[q, k + 1], True
        if delay > largest_delay_s:
            whole[q, k + 1] = largest_delay_s
        if delay < -largest_delay_s:
            whole[q, k + 1] = -largest_delay_s
        for a in range(q):
            finite = finite and math.isfinite(whole[q, a])
        if finite:
            for a in range(q):
                change[a] += whole[q, a] - belief[last, a]
                belief[last, a] = whole[q, a]
    for a in range(q):
        belief[2 * q + 1, a] += added[q, a]
        for b in range(a + 1):
            belief[q + a, b] += added[a, b]
            belief[q + b, a] = belief[q + a, b]


def learn(of: LearnedWindows, belief: Belief, k: int, steps: int) -> Belief:
    """Return the belief after some windows: `steps` Gauss-Newton steps from `belief.x`, and the windows added.

    Parameters
    ----------
    k : number of the model's terms

    Notes
    -----
    Soft-L1 weights follow the residuals of each step, whose linearisation is that of the first one.
    """
    w, p, q = len(of.begin), len(of.values), len(belief.x)
    seen = np.empty((5, w))
    seen[3] = 1.0 / np.sqrt(of.length_m)
    seen[0], seen[1], seen[2] = of.moved.real, of.moved.imag, of.turned
    seen[:3] *= seen[3]
    seen[4] = np.exp(-of.wander / 4.0 * of.length_m) * seen[3]
    known = np.concatenate([belief.information, belief.matrix, [belief.pull, belief.vector, belief.x]])
    take_windows(
        of.t, of.held, of.into, of.fixed, np.take(UNIT_AXES, of.axis, axis=1), of.columns, of.values, of.knot_t,
        np.stack([of.begin, of.end]), seen, of.offset, known, belief.scale, belief.overlap, belief.largest_delay_s, k,
        steps, np.zeros(3 * (p + 2)), np.empty(3 * (p + 2)), np.empty((len(of.knot_t), 3 * (p + 2))), np.empty(3 * w),
        np.empty((3 * w, q)), np.zeros(q), np.empty((q + 1, q)), np.empty((q + 1, q)),
    )  # fmt: skip
    return belief._replace(x=known[2 * q + 2], matrix=known[q : 2 * q], vector=known[2 * q + 1])


def prepare() -> None:
    """Load the kernel of `learn`; where this computer has not compiled it yet, compile it, which takes seconds."""
    none, rows = np.empty(0), np.empty(0, np.int64)
    of = LearnedWindows(
        none,
        none,
        0.0,
        np.empty((3, 0)),
        rows,
        np.empty((0, 0)),
        none,
        none,
        rows,
        rows,
        none.astype(np.complex128),
        none,
        none,
        0.0,
        0.0,
    )
    learn(of, Belief(np.zeros(2), np.eye(2), np.zeros(2), np.eye(2), np.zeros(2), np.ones(2), 1.0, 1.0), 0, 0)
