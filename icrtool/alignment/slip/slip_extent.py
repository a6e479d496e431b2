"""Begin, end, kind and size of one slip event, from the steps between neighbouring fixes.

A step between two fixes shows little, and a sum of them much: the log likelihood ratio of "this share of each side's
motion is missing" over "none is" grows through an event and falls outside it (Page 1954).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.alignment.slip.slip_windows import ComparedWindows
from icrtool.kernels.arrays import Bools, Floats
from icrtool.records.measurements import SlipKind

SHORTEST_EVENT_S = 0.5
FEWEST_STEPS = 2

MOST_EVIDENCE = 4.0
"""One step counts no more than this for an event or against it: a jump is not one."""

LOST_EVIDENCE = 8.0
"""An event has ended where this much of its evidence is lost again."""

CLEAR_STEP = 2.0
"""A step whose missing motion is so many standard deviations shows where in it an event begins."""

CHUNK = 64
"""Steps that are evaluated together while an event grows."""


class Extent(NamedTuple):
    """One event.

    Attributes
    ----------
    first, last : rows of the knots about it
    begin_s, end_s : within a step of those
    kind : slip, skid or spin: the largest part of what is missed
    severity : share of the motion of both sides that is missed, or made sideways if that is more; at most 1
    made_share : share of the wheels' motion that the robot made in any direction
    distance_m : the robot's path through the event
    """

    first: int
    last: int
    begin_s: float
    end_s: float
    kind: SlipKind
    severity: float
    made_share: float
    distance_m: float


def find_extent(t: Floats, steps: ComparedWindows, error: Floats, usable: Bools, core: slice) -> Extent | None:
    """Return the event about a window that shows one; None where none of its own is left.

    First the part of the window with the largest sum of evidence, then outwards as long as the evidence grows.

    Parameters
    ----------
    t : (m,) [s] of the knots
    steps : (m - 1,) windows between neighbouring knots
    error : (3,) of the motion model, a share of the wheels' motion
    usable : (m - 1,) steps that no hole and no other event takes
    core : rows of the steps of the window
    """
    span = core
    shares = missed_shares(steps.rows(core))
    for _ in range(2):
        first, last = _best_part(np.where(usable[core], _evidence(steps.rows(core), error, shares), -MOST_EVIDENCE))
        if first == last:
            return None
        first, last = core.start + first, core.start + last
        last += _growth(steps, error, shares, usable, range(last, len(usable)))
        first -= _growth(steps, error, shares, usable, range(first - 1, -1, -1))
        span = slice(first, last)
        shares = missed_shares(steps.rows(span))

    def time_in(row: int, *, inside: bool) -> float:
        if not 0 <= row < len(usable) or not usable[row]:
            return 0.0
        return _part(steps, error, shares, row, default=float(inside)) * float(t[row + 1] - t[row])

    begin_s = float(t[span.start + 1]) - time_in(span.start, inside=True) - time_in(span.start - 1, inside=False)
    end_s = float(t[span.stop - 1]) + time_in(span.stop - 1, inside=True) + time_in(span.stop, inside=False)
    if end_s - begin_s < SHORTEST_EVENT_S or span.stop - span.start < FEWEST_STEPS:
        return None
    return _measured(steps.rows(span), span, shares, begin_s, end_s)


def missed_shares(steps: ComparedWindows) -> Floats:
    """Return the shares that the left and the right side miss of their motion, and that the robot moves aside (3,).

    Sums, and no least squares over steps: the noise of the fixes cancels except that of the first and the last.
    """
    (left, right), (of_left, of_right) = steps.model_sides, steps.of_sides
    noise = float(steps.sensor.sum(axis=1).mean())

    def share(moved: Floats, missed: Floats) -> float:
        size = float(np.abs(moved).sum())
        return float(np.sign(moved) @ missed) * size / (size**2 + noise)

    return np.array([share(left, -of_left), share(right, -of_right), share(steps.path_m, -steps.aside)])


def _measured(steps: ComparedWindows, span: slice, shares: Floats, begin_s: float, end_s: float) -> Extent:
    left, right = steps.model_sides
    miss_left, miss_right = shares[0] * left, shares[1] * right
    path = float(steps.path_m.sum())
    aside = abs(float(shares[2])) * path
    missed: dict[SlipKind, float] = {
        "slip": float(np.abs(miss_left + miss_right).sum()) / 2,
        "spin": float(np.abs(miss_left - miss_right).sum()) / 2,
        "skid": aside,
    }
    of_sides = float(np.abs(miss_left).sum() + np.abs(miss_right).sum()) / 2
    made = float(np.abs(left - miss_left).sum() + np.abs(right - miss_right).sum()) / 2
    ahead = float(np.abs(left + right - miss_left - miss_right).sum()) / 2
    return Extent(
        span.start, span.stop, begin_s, end_s, max(missed, key=lambda kind: missed[kind]),
        min(1.0, max(of_sides, aside) / path), max(made, aside) / path, float(np.hypot(ahead, aside)),
    )  # fmt: skip


def _expected(steps: ComparedWindows, shares: Floats) -> Floats:
    """Return the residual of steps that miss these shares (k, 3) [m]."""
    left, right = shares[:2, None] * steps.model_sides
    return -np.column_stack([(left + right) / 2, shares[2] * steps.path_m, (left - right) / 2])


def _evidence(steps: ComparedWindows, error: Floats, shares: Floats) -> Floats:
    """Return the log likelihood ratio of steps (k,): missing these shares over missing none; bounded."""
    seen = steps.residual
    # while the robot parks, sensors without noise leave no variance, and nothing is expected
    variance = np.maximum(steps.sensor + (error * steps.path_m[:, None]) ** 2, np.finfo(np.float64).tiny)
    ratio = ((seen**2 - (seen - _expected(steps, shares)) ** 2) / (2 * variance)).sum(axis=1)
    return np.asarray(np.clip(ratio, -MOST_EVIDENCE, MOST_EVIDENCE))


def _best_part(evidence: Floats) -> tuple[int, int]:
    """Return the half-open range of the largest sum (Kadane); an empty one where nothing is positive."""
    best, begin, total, part = 0.0, 0, 0.0, (0, 0)
    for row, value in enumerate(evidence):
        if total <= 0.0:
            begin, total = row, 0.0
        total += float(value)
        if total > best:
            best, part = total, (begin, row + 1)
    return part


def _growth(steps: ComparedWindows, error: Floats, shares: Floats, usable: Bools, rows: range) -> int:
    """Return how many of the rows belong to the event: up to the largest sum of evidence before it is lost again."""
    total, best, count, done = 0.0, 0.0, 0, 0
    while done < len(rows):
        chunk = rows[done : done + CHUNK]
        low, high = min(chunk), max(chunk) + 1
        values = _evidence(steps.rows(slice(low, high)), error, shares)[:: rows.step]
        for value, fine in zip(values, usable[low:high][:: rows.step], strict=True):
            total, done = total + float(value), done + 1
            if not fine or total < best - LOST_EVIDENCE:
                return count
            if total > best:
                best, count = total, done
    return count


def _part(steps: ComparedWindows, error: Floats, shares: Floats, row: int, *, default: float) -> float:
    """Return the part of a step that lies in the event, or a default where the fixes are too noisy to show it."""
    one = steps.rows(slice(row, row + 1))
    deviation = np.sqrt(one.sensor + (error * one.path_m) ** 2)[0]
    expected, seen = _expected(one, shares)[0] / deviation, one.residual[0] / deviation
    size2 = float(expected @ expected)
    return float(np.clip(expected @ seen / size2, 0.0, 1.0)) if size2 > CLEAR_STEP**2 else default
