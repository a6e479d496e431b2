"""Slip events: where wheels and motion disagree beyond what the motion model and the noise of the sensors allow.

Pentzer 2014, Sections 2 and 7: ICRs that grow without bound mean pure slip or a robot that is stuck. Here it is found
from the aligned measurements, before any filter, by a test over windows of half a second and more.
"""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from icrtool.alignment.wheel_motion import MOVING_SHARE, Knots, Motion, Windows, compare, cut, fit_motion, lay_knots
from icrtool.records.events import SlipEvent, SlipKind
from icrtool.records.tables import Bools, Floats, GyroSamples, HeadingSamples, Ints, PositionFixes, WheelSamples

WINDOWS_S = (0.5, 1.0, 2.0)
LONGEST_WINDOW_S = 16.0
"""Windows are doubled to this where the fixes are too noisy for shorter ones."""

LEAST_DISTANCE2 = 36.0
"""Squared Mahalanobis distance of a window in which an event is seen."""

LEAST_SHARE = 0.3
"""... and the least share of the wheels' motion that the robot does not make, or makes sideways."""

SHORTEST_EVENT_S = 0.5
FEWEST_INTERVALS = 2
"""An event is seen in at least so many intervals between fixes: one alone may be a jump."""

STUCK_SHARE = 0.2
"""Robot that moves and turns less than this share of what its wheels do: immobilised."""

RESPONSE_STD_S = 0.1
"""How far the time differs by which a robot follows its wheels."""

LEAST_MODEL_ERROR = 0.03
FIRST_QUANTILE, LATER_QUANTILE = 0.7, 0.95
"""The model's error is what this share of the windows stays within: the first time events are still among them."""

NORMAL_QUANTILE = {FIRST_QUANTILE: 1.0364, LATER_QUANTILE: 1.9600}
"""Of the absolute value of a standard normal."""

ROUNDS = 2

MOST_EVIDENCE = 4.0
"""One interval between fixes counts no more than this for an event or against it: a jump is not one."""

LOST_EVIDENCE = 8.0
"""An event has ended where this much of its evidence is lost again."""

JUMP_SIGMAS = 6.0
JUMP_SPEED_SHARE, JUMP_MPS = 2.0, 0.3
"""A step beyond the noise by so many deviations, and beyond what wheels and a slide can do, is no motion."""

TURNING_MPS = 0.05
"""Wheels slower than this do not turn."""

NOISE_WINDOWS, NOISE_SAMPLES = 6, 16
"""Noise is taken from so many windows to each side, at so many places."""

MAD_TO_STD_OF_DIFFERENCE = 1.4826 / math.sqrt(2.0)

CLEAR_STEP = 2.0
"""A step whose missing motion is so many standard deviations shows where in it an event begins."""

CHUNK = 64
LOCAL = False
VERBOSE = False
MOST_FALSE = 0.25


STRETCH_S = 1.0
"""Size and kind of an event are summed over stretches of this duration: long enough for the fixes' noise."""


class _Evidence(NamedTuple):
    """Windows of all lengths that show an event: rows of the knots, squared Mahalanobis distance."""

    begin: Ints
    end: Ints
    distance2: Floats


class _Span(NamedTuple):
    """An event between two knots; `begin_s` and `end_s` lie between those and their neighbours."""

    first: int
    last: int
    begin_s: float
    end_s: float
    windows: Windows
    distance2: float


def find_slip_events(
    wheels: WheelSamples,
    fixes: PositionFixes,
    heading: HeadingSamples,
    *,
    gyro: GyroSamples | None = None,
    width_m: float,
    motion: Motion | None = None,
) -> tuple[SlipEvent, ...]:
    """Find the spans in which the robot did not do what its wheels did.

    Parameters
    ----------
    wheels, fixes, heading : aligned: sides, signs, scale, conventions and delays corrected
    gyro : turn rates, used for turns where they agree with the heading and scatter less
    width_m : distance b between the track centre lines, or what stands for it
    motion : of the robot without slip; default: fitted to the log itself

    Returns
    -------
    tuple of SlipEvent
        In order of time; none where the motion model cannot be fitted.

    Notes
    -----
    Windows of 0.5 to 2 s: displacement ahead and aside and turn, reference minus model, over their standard deviations
    (noise of fixes and heading, wheel values held by the recorder, response time at changes of speed, and the model's
    own error, a share of the distance, estimated from the log); chi-squared with 3 degrees of freedom. Begin and end
    are those of the largest likelihood ratio of steps between fixes (Page 1954), each step bounded.
    """
    knots = lay_knots(wheels, fixes, heading, gyro, width_m)
    if knots is None:
        return ()
    knots = _without_jumps(knots)
    quiet = np.ones(len(knots.t), np.bool_)
    spans: list[_Span] = []
    for quantile in (FIRST_QUANTILE, LATER_QUANTILE):
        model = motion if motion is not None else fit_motion(knots, quiet)
        if model is None:
            return ()
        spans = _spans(knots, model, quiet, quantile)
        quiet = np.ones(len(knots.t), np.bool_)
        for span in spans:
            quiet[max(span.first - 1, 0) : span.last + 2] = False
    tests = max(1.0, float(knots.t[-1] - knots.t[0]) / WINDOWS_S[0])
    return tuple(_event(knots, span, tests) for span in sorted(spans, key=lambda span: span.first))


def _without_jumps(knots: Knots) -> Knots:
    """Return the knots without single outliers; a jump that stays becomes a hole, which no window spans."""

    def impossible(first: Ints, last: Ints) -> Bools:
        noise = np.sqrt(knots.variance[first] + knots.variance[last])
        can = JUMP_SPEED_SHARE * (knots.path_m[last] - knots.path_m[first]) + JUMP_MPS * (knots.t[last] - knots.t[first])
        return np.asarray(np.abs(knots.place[last] - knots.place[first]) > JUMP_SIGMAS * noise + can)

    row = np.arange(len(knots.t))
    step, over = impossible(row[:-1], row[1:]), impossible(row[:-2], row[2:])
    kept = np.ones(len(row), np.bool_)
    kept[1:-1] = ~(step[:-1] & step[1:] & ~over)
    knots = knots.rows(kept)
    row = row[: len(knots.t)]
    return knots._replace(holes=knots.holes + np.concatenate([[0], np.cumsum(impossible(row[:-1], row[1:]))]))


def _spans(knots: Knots, motion: Motion, quiet: Bools, quantile: float) -> list[_Span]:
    """Return the events, the clearest first; `quiet` (m,) marks the knots that the model's error is taken from."""
    begin, end, distance2, excess, stuck, twice = [], [], [], [], [], []
    durations = _durations(knots)
    error = np.full(3, LEAST_MODEL_ERROR)
    for duration in reversed(durations):
        first, last = cut(knots, duration)
        long = last - first >= FEWEST_INTERVALS
        windows = compare(knots, motion, first[long], last[long], RESPONSE_STD_S)
        if LOCAL: windows = _with_local_noise(knots, windows, duration)
        error = _model_error(windows, quiet, quantile)
        square = _distance2(windows, error)
        moved = windows.path_m > TURNING_MPS * duration
        shows = moved & (square > LEAST_DISTANCE2) & (_missed(windows) > LEAST_SHARE * windows.path_m)
        excess.append(_exceeds(windows)[shows])
        stuck.append(windows.made[shows] < STUCK_SHARE * windows.path_m[shows])
        twice.append(_doubled(windows)[shows] < STUCK_SHARE * windows.path_m[shows])
        begin.append(windows.begin[shows])
        end.append(windows.end[shows])
        distance2.append(square[shows])
    evidence = _Evidence(np.concatenate(begin), np.concatenate(end), np.concatenate(distance2))
    decoy = np.concatenate(excess)
    still, double = np.concatenate(stuck), np.concatenate(twice)
    rate = np.minimum(_false_rate(evidence.distance2, ~decoy, decoy), np.where(still, _false_rate(evidence.distance2, still, double), np.inf))
    decoy &= ~still
    if VERBOSE: print('still',still.sum(),'double',double.sum(),'targets',np.sum(~decoy),'decoys',decoy.sum(), np.sort(evidence.distance2[decoy])[-5:].round(), 'kept',np.sum((rate<MOST_FALSE)&~decoy), 'error',error)
    row = np.arange(len(knots.t))
    steps = compare(knots, motion, row[:-1], row[1:], RESPONSE_STD_S)
    whole = knots.holes[1:] == knots.holes[:-1]
    taken, spans = np.zeros(len(steps.begin), np.bool_), []
    for at in np.argsort(-evidence.distance2, kind="stable"):
        core = slice(int(evidence.begin[at]), int(evidence.end[at]))
        if decoy[at] or rate[at] > MOST_FALSE or taken[core].any():
            continue
        span = _grown(knots, motion, steps, whole & ~taken, error, core)
        if span is not None:
            taken[span.first : span.last] = True
            spans.append(span._replace(distance2=float(evidence.distance2[at])))
    return spans


def _with_local_noise(knots: Knots, windows: Windows, duration_s: float) -> Windows:
    """Return the windows with variances no less than the scatter of the windows about them.

    The scatter is that of differences between a window and the next one: an event changes those at its begin and its
    end only, a reference that is noisy for a while all of them.
    """
    if not len(windows.begin):
        return windows
    following = np.full(len(knots.t), -1)
    following[windows.begin] = np.arange(len(windows.begin))
    after = following[windows.end]
    change = np.abs(windows.residual[after] - windows.residual)
    change[after < 0] = np.nan
    half = max(1, round(NOISE_WINDOWS * duration_s / float(np.median(np.diff(knots.t)))))
    stride = max(1, half // NOISE_SAMPLES)
    half = stride * (half // stride)
    padded = np.pad(change, ((half, half), (0, 0)), constant_values=np.nan)
    around = sliding_window_view(padded, 2 * half + 1, axis=0)[:, :, ::stride]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        local = np.nan_to_num(np.nanmedian(around, axis=2)) * MAD_TO_STD_OF_DIFFERENCE
    return windows._replace(sensor=np.maximum(windows.sensor, local**2))


def _durations(knots: Knots) -> list[float]:
    """Return the durations of the windows: doubled until the usual distance stands out of the noise of the fixes."""
    path, dt = np.diff(knots.path_m), np.diff(knots.t)
    moving = path > TURNING_MPS * dt
    if not moving.any():
        return list(WINDOWS_S)
    speed = float(np.median(path[moving] / dt[moving]))
    needed = math.sqrt(2 * LEAST_DISTANCE2 * float(np.median(knots.variance)))
    durations = list(WINDOWS_S)
    while speed * durations[-1] < needed and durations[-1] < LONGEST_WINDOW_S:
        durations.append(2 * durations[-1])
    return durations


def _model_error(windows: Windows, quiet: Bools, quantile: float) -> Floats:
    """Return the standard deviation of the model's error (3,), a share of the wheels' motion.

    Sensor noise s and model error k p leave a share q of the residuals r within n standard deviations where k is the
    q-quantile of sqrt(r^2 / n^2 - s^2) / p.
    """
    disturbed = np.concatenate([[0], np.cumsum(~quiet)])
    used = disturbed[windows.end + 1] == disturbed[windows.begin]
    used &= windows.path_m > MOVING_SHARE * (float(np.quantile(windows.path_m, 0.9)) if len(used) else 0.0)
    if not used.any():
        return np.full(3, LEAST_MODEL_ERROR)
    excess = (windows.residual[used] / NORMAL_QUANTILE[quantile]) ** 2 - windows.sensor[used]
    square = np.quantile(excess / windows.path_m[used, None] ** 2, quantile, axis=0)
    return np.sqrt(np.maximum(square, LEAST_MODEL_ERROR**2))


def _distance2(windows: Windows, error: Floats) -> Floats:
    variance = windows.sensor + (error * windows.path_m[:, None]) ** 2
    return np.asarray((windows.residual**2 / variance).sum(axis=1))


def _exceeds(windows: Windows) -> Bools:
    """Return which windows show a side that does more than its wheels, or goes against them."""
    left, right = windows.model_ahead + windows.model_turned, windows.model_ahead - windows.model_turned
    miss_left, miss_right = -(windows.ahead + windows.turned), -(windows.ahead - windows.turned)
    least = LEAST_SHARE * windows.path_m
    beyond = np.zeros(len(left), np.bool_)
    for side, miss in ((left, miss_left), (right, miss_right)):
        forward = np.sign(side) * miss
        beyond |= (forward < -least) | (forward > np.abs(side) + least)
    return beyond


def _doubled(windows: Windows) -> Floats:
    """Return how far the robot is from twice the motion of its wheels (w,) [m]: the opposite of standing still."""
    place = np.hypot(windows.ahead - windows.model_ahead, windows.aside)
    return np.maximum(place, np.abs(windows.turned - windows.model_turned))


def _false_rate(distance2: Floats, target: Bools, decoy: Bools) -> Floats:
    """Return, for each window, the decoys among those as clear as it or clearer, over the targets (Benjamini 1995)."""
    order = np.argsort(-distance2, kind="stable")
    decoys, targets = np.cumsum(decoy[order]), np.cumsum(target[order])
    rate = np.empty(len(order))
    rate[order] = np.minimum.accumulate((decoys / np.maximum(targets, 1))[::-1])[::-1]
    return rate


def _missed(windows: Windows) -> Floats:
    """Return the motion that a window misses (w,) [m]: the mean of both sides, or what it moves sideways."""
    return np.asarray(np.abs(windows.residual).max(axis=1))


def _grown(knots: Knots, motion: Motion, steps: Windows, usable: Bools, error: Floats, core: slice) -> _Span | None:
    """Return the event about a window that shows one; None where no event of its own is left.

    First the part of the window with the largest sum of evidence, then outwards as long as the evidence grows.
    """
    span = core
    for _ in range(2):
        shares = _missed_shares(steps, span)
        inside = np.where(usable[core], _evidence_of(steps, error, shares, core), -MOST_EVIDENCE)
        first, last = _best_part(inside)
        if first == last:
            return None
        first, last = core.start + first, core.start + last
        last += _growth(steps, error, shares, usable, range(last, len(usable)))
        first -= _growth(steps, error, shares, usable, range(first - 1, -1, -1))
        span = slice(first, last)

    def time_in(row: int, *, inside: bool) -> float:
        return _part_of(steps, error, shares, usable, row, whole=inside) * _interval(knots, row)

    begin_s = knots.t[span.start + 1] - time_in(span.start, inside=True) - time_in(span.start - 1, inside=False)
    end_s = knots.t[span.stop - 1] + time_in(span.stop - 1, inside=True) + time_in(span.stop, inside=False)
    if end_s - begin_s < SHORTEST_EVENT_S or span.stop - span.start < FEWEST_INTERVALS:
        return None
    rows = np.append(np.arange(span.start, span.stop, max(1, round(STRETCH_S / float(np.median(np.diff(knots.t)))))), span.stop)
    windows = compare(knots, motion, rows[:-1], rows[1:], RESPONSE_STD_S)
    if _missed(windows).sum() < LEAST_SHARE * windows.path_m.sum():
        return None
    return _Span(span.start, span.stop, float(begin_s), float(end_s), windows, 0.0)


def _sides(steps: Windows, rows: slice) -> tuple[Floats, Floats]:
    """Return the motion of the left and of the right side by the model [m]."""
    return steps.model_ahead[rows] + steps.model_turned[rows], steps.model_ahead[rows] - steps.model_turned[rows]


def _missed_shares(steps: Windows, rows: slice) -> Floats:
    """Return the shares that the left and the right side miss of their motion, and that the robot moves aside (3,)."""
    left, right = _sides(steps, rows)
    ahead, aside, turned = steps.ahead[rows], steps.aside[rows], steps.turned[rows]
    noise = steps.sensor[rows].sum() / 2
    path = steps.path_m[rows]
    return -np.array([
        left @ (ahead + turned) / (left @ left + noise),
        right @ (ahead - turned) / (right @ right + noise),
        path @ aside / (path @ path + noise),
    ])  # fmt: skip


def _expected(steps: Windows, shares: Floats, rows: slice) -> Floats:
    """Return the residual of steps that miss these shares (k, 3) [m]."""
    left, right = (share * side for share, side in zip(shares[:2], _sides(steps, rows), strict=True))
    return -np.column_stack([(left + right) / 2, shares[2] * steps.path_m[rows], (left - right) / 2])


def _evidence_of(steps: Windows, error: Floats, shares: Floats, rows: slice) -> Floats:
    """Return the log likelihood ratio of steps (k,): missing these shares over missing none; bounded."""
    seen = steps.residual_of(rows)
    variance = steps.sensor[rows] + (error * steps.path_m[rows, None]) ** 2
    ratio = ((seen**2 - (seen - _expected(steps, shares, rows)) ** 2) / (2 * variance)).sum(axis=1)
    return np.clip(ratio, -MOST_EVIDENCE, MOST_EVIDENCE)


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


def _growth(steps: Windows, error: Floats, shares: Floats, usable: Bools, rows: range) -> int:
    """Return how many of the rows belong to the event: up to the largest sum of evidence before it is lost again."""
    total, best, count, done = 0.0, 0.0, 0, 0
    while done < len(rows):
        chunk = rows[done : done + CHUNK]
        low, high = min(chunk), max(chunk) + 1
        values = _evidence_of(steps, error, shares, slice(low, high))[:: rows.step]
        for value, fine in zip(values, usable[low:high][:: rows.step], strict=True):
            total, done = total + float(value), done + 1
            if not fine or total < best - LOST_EVIDENCE:
                return count
            if total > best:
                best, count = total, done
    return count


def _part_of(steps: Windows, error: Floats, shares: Floats, usable: Bools, row: int, *, whole: bool) -> float:
    """Return the part of a step that lies in the event: `whole` or nothing where the fixes are too noisy for more."""
    if not 0 <= row < len(usable) or not usable[row]:
        return 0.0
    one = slice(row, row + 1)
    deviation = np.sqrt(steps.sensor[row] + (error * steps.path_m[row]) ** 2)
    expected, seen = _expected(steps, shares, one)[0] / deviation, steps.residual_of(one)[0] / deviation
    size2 = float(expected @ expected)
    part = float(np.clip(expected @ seen / max(size2, 1e-12), 0.0, 1.0))
    return part if size2 > CLEAR_STEP**2 else float(whole)


def _interval(knots: Knots, row: int) -> float:
    return float(knots.t[row + 1] - knots.t[row]) if 0 <= row < len(knots.t) - 1 else 0.0


def _event(knots: Knots, span: _Span, tests: float) -> SlipEvent:
    windows = span.windows
    noise = 2 * knots.variance[windows.begin]
    made = np.sqrt(np.maximum(windows.made**2 - noise, 0.0))
    path = float(windows.path_m.sum())
    sizes = dict(zip(("slip", "skid", "spin"), np.abs(windows.residual).sum(axis=0), strict=True))
    kind: SlipKind = "immobilised" if made.sum() < STUCK_SHARE * path else max(sizes, key=lambda name: sizes[name])
    place = complex(knots.place[span.first])
    return SlipEvent(
        kind=kind,
        begin_ns=knots.epoch_ns + round(span.begin_s * 1e9),
        end_ns=knots.epoch_ns + round(span.end_s * 1e9),
        north_m=place.real,
        east_m=place.imag,
        distance_m=float(made.sum()),
        severity=min(1.0, float(_missed(windows).sum()) / path),
        confidence=max(0.0, 1.0 - tests * _tail(span.distance2)),
    )


def _tail(distance2: float) -> float:
    """Return the probability that chi-squared with 3 degrees of freedom exceeds a value."""
    return math.erfc(math.sqrt(distance2 / 2)) + math.sqrt(2 * distance2 / math.pi) * math.exp(-distance2 / 2)
