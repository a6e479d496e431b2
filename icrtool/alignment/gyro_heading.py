"""Heading from turn rates and positions: course over ground, rate bias and scale, in a Kalman filter and smoother.

Over windows of driven distance the fixes p_i are regressed on the wheels' speed laid along the integrated turn rate,
S_i = ∫ v e^{jG}: the angle of sum p_i S_i* (about the means) is the heading at the window's end, G being 0 there, plus

    x_icr Im(sum -e^{jG_i} S_i*)/sum |S_i|^2 + tau Im(sum -v_i e^{jG_i} S_i*)/sum |S_i|^2

for ICRs ahead of the antenna and positions that lag. Wheels that run backwards turn S round. While the robot
stands, the rate is its own bias. Absolute headings (an attitude sensor, the bearing between two antennas) enter with an
offset that wanders slowly. What varies in time has a causal estimate (the past alone) and a smoothed one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from icrtool.alignment.drive_windows import DriveArrays
from icrtool.alignment.estimator import ATTITUDE_STD_RAD, ATTITUDE_TIME_S
from icrtool.kernels.robust import huber_weights, long_run_factor, mad_std
from icrtool.records.tables import Complexes, Floats, Ints

if TYPE_CHECKING:
    from icrtool.kernels.heading_kalman import HeadingEvents, HeadingPasses

PSI, BIAS, SCALE, X, DELAY, OFFSET = range(6)
COURSE, STANDING, ATTITUDE = range(3)
HUBER_SIGMAS = 2.5
SPIKE_SIGMAS = 8.0
SETTLED_SIGMAS = 3.0

COURSE_WINDOW_M, COURSE_IN_POSITION_STD = 1.0, 12.0
LONGEST_COURSE_S = 10.0
STANDING_S = 0.6
FEWEST_COURSES = 8

SLIP_STD_RAD = math.radians(0.3)
"""What wheels and ground turn a course by, whatever the fixes' noise."""

ANGLE_WALKS = tuple(math.radians(rate) ** 2 for rate in (0.01, 0.03, 0.1, 0.3, 1.0, 3.0))
BIAS_WALKS = tuple(math.radians(rate) ** 2 for rate in (0.001, 0.01, 0.03, 0.1, 0.3))
"""Random walks of the integrated rate [rad^2/s] and of its bias [(rad/s)^2/s]: the likelihood chooses."""

PRIOR_STD = np.array([math.pi, math.radians(2.0), 0.02, 0.3, 0.1, math.pi])
STANDING_RATE_STD = math.radians(0.05)
ATTITUDE_WALK = 2 * ATTITUDE_STD_RAD**2 / ATTITUDE_TIME_S
DELAY_ROUNDS, LONG_DELAY_S = 3, 0.15
"""A delay of the fixes up to this is linear, and partly a robot's response to its wheels; a longer one takes rounds."""


class TurnRate(NamedTuple):
    """A turn rate, clockwise: t (n,) [s], rate (n,) [rad/s]; deviations of its scale and bias before the log."""

    t: Floats
    rate: Floats
    scale_std: float = 0.02
    bias_std: float = math.radians(2.0)

    def integrated(self) -> Floats:
        """Return the turn since the first sample (n,) [rad], by trapezoids."""
        return np.concatenate([[0.0], np.cumsum(np.diff(self.t) * (self.rate[:-1] + self.rate[1:]) / 2)])


class Courses(NamedTuple):
    """Windows of driven distance.

    Attributes
    ----------
    begin, end : (w,) [s]; angle : (w,) of the displacement against what was laid along the rate [rad]
    of_x, of_delay : (w,) derivatives by x_icr and by the delay of the positions; std : (w,) [rad]
    """

    begin: Floats
    end: Floats
    angle: Floats
    of_x: Floats
    of_delay: Floats
    std: Floats


@dataclass(frozen=True, slots=True)
class HeadingEstimate:
    """Headings at times t (n,) [s].

    Attributes
    ----------
    causal, causal_std : (n,) from the past alone, constants excepted; smoothed, smoothed_std : (n,) from all
    constants, constants_std : (6,) bias at the end, scale error, x [m], delay [s], offset [rad]; the first is unused
    walks : random walks that the likelihood chose, of the angle and of the bias
    """

    t: Floats
    causal: Floats
    causal_std: Floats
    smoothed: Floats
    smoothed_std: Floats
    constants: Floats
    constants_std: Floats
    walks: tuple[float, float]


def measure_courses(drive: DriveArrays, turn: TurnRate) -> Courses:
    """Cut the drive into windows of distance that follow one another, and measure the course in each."""
    angle_at = turn.integrated()
    v = (drive.v_left + drive.v_right) / 2
    psi = np.interp(drive.wheel_t + drive.wheel_dt / 2, turn.t, angle_at)
    nose = np.exp(1j * psi)
    laid = np.concatenate([[0.0], np.cumsum((v * nose * drive.wheel_dt)[:-1])])
    gone = np.concatenate([[0.0], np.cumsum((np.abs(v) * drive.wheel_dt)[:-1])])
    length = max(COURSE_WINDOW_M, COURSE_IN_POSITION_STD * min(drive.fix_std_m, 10.0))
    t, place = _without_spikes(drive, max(drive.wheel_t[0], turn.t[0]), min(drive.wheel_t[-1], turn.t[-1]))
    cell = np.floor(np.interp(t, drive.wheel_t, gone) / length)
    edge = np.flatnonzero(np.diff(cell, prepend=cell[:1] - 1.0) > 0)
    begin, end = edge[:-1], edge[1:]
    G = np.interp(t, turn.t, angle_at)
    path, swing = np.interp(t, drive.wheel_t, laid), np.exp(1j * G)
    speed = v[np.clip(np.searchsorted(drive.wheel_t, t, side="right") - 1, 0, len(v) - 1)]

    def product(values: Complexes, others: Complexes) -> Complexes:
        """Return the sums of values times conjugate others about their means, both ends of a window included."""
        sums = [np.concatenate([[0.0], np.cumsum(one)]) for one in (values * np.conj(others), values, others)]
        both, first, second = (one[end + 1] - one[begin] for one in sums)
        return np.asarray(both - first * np.conj(second) / (end + 1 - begin), np.complex128)

    square = product(path, path).real
    seen = product(place - place.mean() if len(place) else place, path)
    kept = (t[end] - t[begin] < LONGEST_COURSE_S) & (np.abs(path[end] - path[begin]) > 0.5 * length)
    kept &= np.abs(seen) > 0.3 * square
    gap = drive.wheel_t[:-1][drive.wheel_dt[:-1] == 0.0]
    kept &= np.searchsorted(gap, t[begin]) == np.searchsorted(gap, t[end])
    of_x = product(-swing, path).imag
    of_delay = product(-speed * swing, path).imag
    size = np.maximum(square, 1e-12)
    return Courses(
        t[begin][kept], t[end][kept], np.angle(seen * np.exp(1j * G[end]))[kept],
        (of_x / size)[kept], (of_delay / size)[kept], (drive.fix_std_m / np.sqrt(size))[kept],
    )  # fmt: skip


def _without_spikes(drive: DriveArrays, first: float, last: float) -> tuple[Floats, Complexes]:
    """Return times and places of the fixes in a span, without those that lie far from both neighbours."""
    rows = np.flatnonzero((drive.fix_t >= first) & (drive.fix_t <= last))
    t, place = drive.fix_t[rows], drive.fix[rows]
    if len(rows) < 3:
        return t, place
    bend = np.abs(place[1:-1] - (place[:-2] + place[2:]) / 2)
    far = bend > SPIKE_SIGMAS * max(mad_std(bend, 0.0), drive.fix_std_m)
    # the neighbours of a spike bend by half as much
    spike = far & (bend >= np.maximum(np.append(bend[1:], 0.0), np.append(0.0, bend[:-1])))
    kept = np.concatenate([[True], ~spike, [True]])
    return t[kept], place[kept]


def _standing(drive: DriveArrays, turn: TurnRate) -> tuple[Floats, Floats]:
    """Return ends of spans [s] in which the wheels stood, and the mean rate in each [rad/s]."""
    edges = drive.wheel_t[0] + STANDING_S * np.unique(np.floor((drive.wheel_t - drive.wheel_t[0]) / STANDING_S))
    begin, end = edges[:-1], edges[1:]
    gone = np.concatenate([[0.0], np.cumsum((np.abs(drive.v_left) + np.abs(drive.v_right))[:-1] * drive.wheel_dt[:-1])])
    still = np.interp(end, drive.wheel_t, gone) - np.interp(begin - STANDING_S, drive.wheel_t, gone) < 1e-3
    still &= (end - begin < 1.5 * STANDING_S) & (begin >= turn.t[0]) & (end <= turn.t[-1])
    G = turn.integrated()
    rate = (np.interp(end, turn.t, G) - np.interp(begin, turn.t, G)) / (end - begin)
    return end[still], rate[still]


def estimate_heading(
    drive: DriveArrays,
    turn: TurnRate,
    absolute: tuple[Floats, Floats, Floats] | None = None,
    *,
    absolute_walk: float = ATTITUDE_WALK,
    stands: bool = True,
) -> HeadingEstimate | None:
    """Estimate the heading; None with too few courses.

    Parameters
    ----------
    turn : of a gyro, or of the wheels with a wide prior of its scale
    absolute : t, heading, std (m,) of headings with an unknown offset, already thinned to independent ones
    absolute_walk : random walk of that offset [rad^2/s]
    stands : whether the rate is zero while the wheels stand
    """
    late, found = 0.0, None
    for _ in range(DELAY_ROUNDS):
        found = _estimate(drive, late, turn, absolute, absolute_walk, stands=stands)
        if found is None:
            return None
        step = float(found.constants[DELAY]) - late
        late += step
        if abs(step) < max(3.0 * float(found.constants_std[DELAY]), LONG_DELAY_S):
            break
    return found


def _estimate(
    drive: DriveArrays, late: float, turn: TurnRate, absolute: tuple[Floats, Floats, Floats] | None,
    absolute_walk: float, *, stands: bool,
) -> HeadingEstimate | None:  # fmt: skip
    """Run filter and smoother once about a delay of the fixes of `late` [s]: it is linear here, and takes rounds."""
    from icrtool.kernels.heading_kalman import HeadingEvents, filter_headings, smooth_headings

    courses = measure_courses(drive._replace(fix_t=drive.fix_t - late), turn)
    courses = courses._replace(angle=courses.angle + late * courses.of_delay)
    if len(courses.end) < FEWEST_COURSES:
        return None
    still_t, still_rate = _standing(drive, turn) if stands else (np.empty(0), np.empty(0))
    attitude = absolute if absolute is not None else (np.empty(0),) * 3
    t = np.concatenate([courses.end, still_t, attitude[0]])
    kind = np.repeat([COURSE, STANDING, ATTITUDE], [len(courses.end), len(still_t), len(attitude[0])])
    order = np.lexsort((kind, t))
    h = np.zeros((len(t), 6))
    h[kind != STANDING, PSI] = 1.0
    h[kind == STANDING, BIAS] = 1.0
    h[kind == ATTITUDE, OFFSET] = 1.0
    h[kind == COURSE, X], h[kind == COURSE, DELAY] = courses.of_x, courses.of_delay
    # the angle is that of the window's middle, carried to its end by a rate with bias and scale error
    G = turn.integrated()
    middle = (courses.begin + courses.end) / 2
    h[kind == COURSE, BIAS] = courses.end - middle
    h[kind == COURSE, SCALE] = np.interp(middle, turn.t, G) - np.interp(courses.end, turn.t, G)
    z = np.concatenate([courses.angle, still_rate, attitude[1]])
    r = np.concatenate(
        [courses.std**2 + SLIP_STD_RAD**2, np.full(len(still_t), STANDING_RATE_STD**2), attitude[2] ** 2]
    )
    t, kind, h, z, r = t[order], kind[order], h[order], z[order], r[order]
    at = np.interp(t, turn.t, G)
    events = HeadingEvents(np.diff(t, prepend=t[:1]), np.diff(at, prepend=at[:1]), z, h, r, kind != STANDING)
    std = PRIOR_STD.copy()
    std[SCALE], std[BIAS] = turn.scale_std, turn.bias_std
    x0, P0 = np.zeros(6), np.diag(std**2)
    first = int(np.argmax(kind == COURSE))
    x0[PSI] = z[first] - (at[first] - at[0])
    if absolute is None:
        P0[OFFSET, OFFSET] = 1e-12
    else:
        one = int(np.argmax(kind == ATTITUDE))
        x0[OFFSET] = math.remainder(z[one] - x0[PSI] - (at[one] - at[0]), 2 * math.pi)
    wander = absolute_walk if absolute is not None else 0.0

    def q(walks: tuple[float, float]) -> Floats:
        return np.array([*walks, 0.0, 0.0, 0.0, wander])

    events, walks = _choose(events, kind, lambda one, w: filter_headings(one, x0, P0, q(w)))
    passes = filter_headings(events, x0, P0, q(walks))
    states, covariances = smooth_headings(events, passes)
    constants, variances = states[-1], np.diagonal(covariances[-1])
    known = np.array([SCALE, X, DELAY])
    x1, P1 = x0.copy(), P0.copy()
    x1[known] = constants[known]
    P1[known, known] = variances[known]
    causal = filter_headings(events, x1, P1, q(walks))
    return _at_rate_samples(turn, G, _Passes(t, causal.x, causal.P, states, covariances, walks))


def _choose(
    events: HeadingEvents, kind: Ints, run: Callable[[HeadingEvents, tuple[float, float]], HeadingPasses]
) -> tuple[HeadingEvents, tuple[float, float]]:
    """Return events with robust variances of the courses, and the random walks with the largest likelihood."""
    course = kind == COURSE
    nominal, walks = events.r, (ANGLE_WALKS[1], BIAS_WALKS[1])
    for _ in range(3):
        passes = run(events, walks)
        z = passes.innovation[course] / np.sqrt(passes.variance[course])
        settled = z[len(z) // 20 + 2 :]
        spread = float(np.clip(mad_std(settled, 0.0), 0.7, 10.0)) if len(settled) >= FEWEST_COURSES else 1.0
        nominal = np.where(course, nominal * spread**2, nominal)
        weights = np.ones(len(nominal))
        weights[course] = huber_weights(z / spread, HUBER_SIGMAS)
        events = events._replace(r=nominal / np.maximum(weights, 0.02) ** 2)
        walks = max(
            ((angle, bias) for angle in ANGLE_WALKS for bias in BIAS_WALKS),
            key=lambda one: run(events, one).log_likelihood(),
        )
    # courses of windows that follow one another err alike, by slip that the model lacks
    passes = run(events, walks)
    z = np.clip(passes.innovation[course] / np.sqrt(passes.variance[course]), -SETTLED_SIGMAS, SETTLED_SIGMAS)
    alike = float(long_run_factor(z[len(z) // 20 + 2 :, None])[0])
    return events._replace(r=np.where(course, events.r * alike, events.r)), walks


class _Passes(NamedTuple):
    """Events (n,) [s] with the causal filter's states (n, 6) and covariances, the smoother's, and their walks."""

    t: Floats
    x: Floats
    P: Floats
    states: Floats
    covariances: Floats
    walks: tuple[float, float]


def _at_rate_samples(turn: TurnRate, G: Floats, passes: _Passes) -> HeadingEstimate:
    """Return the estimates at the rate's samples: carried on by the rate from the last event, or between events."""
    t, x, P, states, covariances, walks = passes
    constants, variances = states[-1], np.diagonal(covariances[-1])
    rows = np.flatnonzero((turn.t >= t[0]) & (turn.t <= t[-1] + 2.0))
    s = turn.t[rows]
    last = np.clip(np.searchsorted(t, s, side="right") - 1, 0, len(t) - 1)
    dt, dG = s - t[last], G[rows] - np.interp(t, turn.t, G)[last]
    causal = x[last, PSI] + (1 + x[last, SCALE]) * dG - x[last, BIAS] * dt
    f = np.zeros((len(rows), 6))
    f[:, PSI], f[:, BIAS], f[:, SCALE] = 1.0, -dt, dG
    variance = np.einsum("ni,nij,nj->n", f, P[last], f) + walks[0] * dt
    scaled = (1 + constants[SCALE]) * G
    smoothed = scaled[rows] + np.interp(s, t, states[:, PSI] - np.interp(t, turn.t, scaled))
    smoothed_std = np.sqrt(np.interp(s, t, covariances[:, PSI, PSI]))
    return HeadingEstimate(
        s, causal, np.sqrt(np.maximum(variance, 0.0)), smoothed, smoothed_std, constants, np.sqrt(variances), walks
    )
