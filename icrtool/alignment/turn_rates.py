"""Turn rates, and courses over ground to compare them with: directions in which fixes moved.

Over windows of driven distance the fixes p_i are regressed on the wheels' speed laid along the integrated turn rate,
S_i = ∫ v e^{jG}, both about their means: the angle of sum p_i S_i* is the heading at the window's end, G being 0
there.
Three further effects on the angle are linear; each is divided by sum |S_i|^2:

    an error δpsi(t) of the heading           Re(sum ∫ δpsi v e^{jG} S_i*)
    an ICR ahead of the antenna               x Im(sum -e^{jG_i} S_i*)
    positions that lag by tau                 tau Im(sum -v_i e^{jG_i} S_i*)

Wheels that run backwards change the sign of S.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from icrtool.alignment.log_track import ALIGNMENT_WINDOW_M
from icrtool.alignment.sensor_noise import JUMP_SIGMAS, SLIP_SHARE, is_hole
from icrtool.kernels.arrays import Complexes, Floats, Ints, trapezoids, wrapped
from icrtool.kernels.robust import mad_std, robust_regression, soft_l1_weights
from icrtool.kernels.track import Track
from icrtool.records.measurements import CAUTIOUS_RESPONSE_STD_S
from icrtool.records.samples import GyroAxes

COURSE_WINDOW_M, COURSE_IN_POSITION_STD, SHORTEST_IN_POSITION_STD = 1.0, 12.0, 6.0
"""Length of a window: at least [m]; usually, in standard deviations of a position; on a short drive at least, in
standard deviations of a position."""

ENOUGH_COURSES = 24.0
"""Number of windows that a short drive is cut into, by shortening them. On a longer drive the noise of the fixes sets
the length of the windows."""

LARGEST_TURN_ERROR_RAD = 2.0
"""Largest turn of a window by the unknown bias and scale of the turn rate [rad]. With a larger one it is not used."""

FIXES_A_WINDOW = 5
"""Smallest usual number of fixes in a window. Windows share no fix, so that their errors are independent; with fewer
fixes most of the distance between windows would be lost."""

LONG_WINDOW = 2.0
"""Length of a window of `FIXES_A_WINDOW` fixes, in lengths, above which fixes are rare. Windows then share their first
and last fix: the noise of this fix has a small effect on the direction of so long a window."""

MIDDLE_NOISE = 0.01
"""Smallest spread of the sides' relative speed difference that shows `Guess.middle`, even with exact courses."""

MIDDLE_STD = 0.1
"""Prior standard deviation of `Guess.middle` about 0, because robots are symmetric: an antenna 0.1 m off the middle of
ICRs that are 1 m apart has 0.2."""

LONGEST_STRETCH_S = 60.0
"""Longest duration of two displacements, and longest time between them, to compare them without a turn rate [s]."""

LEAST_HOLE_STD_RADPS = math.radians(10.0)
"""Smallest standard deviation of a turn rate that nothing measured [rad/s]."""


@dataclass(frozen=True)
class TurnRate:
    """A turn rate, clockwise.

    Attributes
    ----------
    t : (n,) stamps [s]
    rate : (n,) turn rate [rad/s]
    holes : (m, 2) starts and ends of stretches [s] in which the rate was not measured
    scale_std, bias_std : standard deviations of the rate's scale, and of its bias [rad/s], before the log
    hole_std : standard deviation of the rate within each hole (m,), or within all holes [rad/s]
    delay_std_s : standard deviation of the stamps [s]; None: half an interval
    """

    t: Floats
    rate: Floats
    holes: Floats = field(default_factory=lambda: np.empty((0, 2)))
    scale_std: float = 0.02
    bias_std: float = math.radians(2.0)
    hole_std: float | Floats = LEAST_HOLE_STD_RADPS
    delay_std_s: float | None = None

    @cached_property
    def integrated(self) -> Floats:
        """Turn since the first sample (n,) [rad], by trapezoids."""
        return trapezoids(self.t, self.rate)

    def hole_variance(self, t: Floats) -> Floats:
        """Return the variance that its holes have added until times t (n,) [rad^2]."""
        total = np.zeros(len(t))
        for (begin, end), std in zip(self.holes, np.broadcast_to(self.hole_std, len(self.holes)), strict=True):
            total += (std * np.clip(t - begin, 0.0, end - begin)) ** 2
        return total


class Guess(NamedTuple):
    """Errors at which courses are linearised.

    Attributes
    ----------
    bias : (n,) bias of the turn rate at its samples [rad/s]
    bias_std, scale_std : standard deviations of bias [rad/s] and scale
    x : distance of the ICRs ahead of the antenna [m]
    delay_s : delay of the positions [s]
    middle : derivative of the antenna's speed by half the speed difference of the sides (left - right)
    """

    bias: Floats
    bias_std: float
    scale_std: float
    x: float = 0.0
    delay_s: float = 0.0
    middle: float = 0.0


class Courses(NamedTuple):
    """Courses over ground in windows of driven distance, each array (w,).

    Attributes
    ----------
    begin, end : times of the first and of the last fix [s]
    angle : heading at the end, by the fixes [rad]
    x_derivative, delay_derivative, bias_derivative, scale_derivative : derivatives of the angle by x_icr [rad/m], by
        the delay of the positions [rad/s], by the bias of the turn rate [s] and by its scale error [rad]
    std : standard deviation of the angle by the noise of the fixes [rad]
    length : ratio of the displacement by the fixes to the displacement by the wheels
    middle_derivative : derivative of the length by `Guess.middle`
    """

    begin: Floats
    end: Floats
    angle: Floats
    x_derivative: Floats
    delay_derivative: Floats
    bias_derivative: Floats
    scale_derivative: Floats
    std: Floats
    length: Floats
    middle_derivative: Floats


def measure_courses(track: Track, turn: TurnRate, guess: Guess) -> Courses:
    """Return the course over ground of a drive in each of the windows of distance that follow one another."""
    corrected = trapezoids(turn.t, turn.rate - guess.bias)
    v, u = track.mean_speed, track.half_difference
    middle = track.t + track.held / 2
    psi = np.interp(middle, turn.t, corrected)
    unit = np.exp(1j * psi)
    nose = unit * track.held
    step = (v + guess.middle * u) * nose
    span = max(track.t[0], turn.t[0]), min(track.t[-1], turn.t[-1])
    length, t, position, begin, end = _cut_courses(track._replace(place_t=track.place_t - guess.delay_s), *span)
    if not len(begin):
        return Courses(*(np.empty(0) for _ in Courses._fields))
    count, used = end + 1 - begin, slice(0, end[-1] + 1)

    def centred(values: Complexes) -> Complexes:
        """Return values at the fixes about the mean of their window."""
        mean = np.add.reduceat(values[used], begin) / count
        return np.asarray(values[used] - np.repeat(mean, count), np.complex128)

    def laid(rate: Complexes) -> Complexes:
        along = np.concatenate([[0.0], np.cumsum(rate[:-1])])
        return np.asarray(np.interp(t, track.t, along), np.complex128)

    def product(values: Complexes) -> Complexes:
        return np.asarray(np.add.reduceat(values * np.conj(path), begin), np.complex128)

    turned = np.interp(t, turn.t, corrected)
    swing = np.exp(1j * turned)
    laid_path = laid(step)
    path = centred(laid_path - guess.x * swing)
    speed = v[np.clip(np.searchsorted(track.t, t, side="right") - 1, 0, len(v) - 1)]
    square = np.maximum(product(path).real, 1e-12)
    displacement = product(centred(position)) / square
    unknown = guess.bias_std * (t[end] - t[begin]) + guess.scale_std * np.abs(turned[end] - turned[begin])
    usable = (unknown < LARGEST_TURN_ERROR_RAD) & (np.abs(displacement) > 0.3)
    usable &= np.abs(laid_path[end] - laid_path[begin]) > 0.5 * length * (count - 1) / count
    usable &= track.clear(t[begin], t[end])
    usable &= np.searchsorted(turn.holes[:, 1], t[begin]) == np.searchsorted(turn.holes[:, 0], t[end])
    x_derivative, delay_derivative = (product(centred(-signal)).imag / square for signal in (swing, speed * swing))
    bias_derivative = t[end] - product(centred(laid(step * middle) - guess.x * t * swing)).real / square
    scale_derivative = product(centred(laid(step * psi) - guess.x * turned * swing)).real / square - turned[end]
    chord = laid_path[end] - laid_path[begin]
    travel, doubled = (laid(np.abs(v) * one) for one in (np.asarray(track.held, np.complex128), nose * unit))
    slip_std = _slip_std(chord, (travel[end] - travel[begin]).real, doubled[end] - doubled[begin])
    std = np.hypot(track.place_std_m / np.sqrt(square), slip_std)
    # The angle is stated for zero bias, zero x_icr and zero delay.
    bias_at = np.interp(t[end], turn.t, guess.bias)
    angle = (
        np.angle(displacement * swing[end])
        + bias_at * bias_derivative
        + guess.x * x_derivative
        + guess.delay_s * delay_derivative
    )
    courses = Courses(
        t[begin], t[end], angle, x_derivative, delay_derivative, bias_derivative, scale_derivative, std,
        np.abs(displacement), product(centred(laid(u * nose))).real / square,
    )  # fmt: skip
    return Courses(*(values[usable] for values in courses))


def _slip_std(chord: Complexes, gone_m: Floats, doubled: Complexes) -> Floats:
    """Return the standard deviation of the direction of displacements (w,) by slip that varies within them [rad].

    Slip of `SLIP_SHARE` in each `ALIGNMENT_WINDOW_M` of travel moves the end by this share of the travel to the side of
    the chord. Slip that is the same in all of a displacement does not turn it.

    Parameters
    ----------
    chord : by the wheels [m]; gone_m : travel; doubled : integral of the speed along twice the heading [m]
    """
    size = np.maximum(np.abs(chord), 1e-12)
    aside_m = np.maximum(gone_m - (doubled * np.conj(chord / size) ** 2).real, 0.0) / 2.0
    varies = np.clip(1.0 - ALIGNMENT_WINDOW_M / np.maximum(gone_m, 1e-9), 0.0, 1.0)
    return np.asarray(SLIP_SHARE * np.sqrt(ALIGNMENT_WINDOW_M * varies * aside_m) / size)


def fit_middle(courses: Courses, guess: Guess) -> float:
    """Return `Guess.middle` from the lengths of the courses: robust regression on the difference of the sides."""
    x, y = courses.middle_derivative, courses.length
    slope, weights, prior = 0.0, np.ones(len(x)), 0.0
    for _ in range(3):
        mean_x, mean_y = np.average(x, weights=weights), np.average(y, weights=weights)
        spread = float((weights * (x - mean_x) ** 2).sum()) + len(x) * MIDDLE_NOISE**2
        slope = float((weights * (x - mean_x) * (y - mean_y)).sum()) - prior * guess.middle
        slope /= spread + prior
        residuals = y - mean_y - slope * (x - mean_x)
        scale = max(mad_std(residuals, 0.0), 1e-6)
        weights, prior = soft_l1_weights(residuals / scale), (scale / MIDDLE_STD) ** 2
    return guess.middle + slope


def course_changes(track: Track) -> tuple[Floats, Floats, Floats]:
    """Return the turns of the course over ground from each window of distance to the next one.

    Only displacements and the sense of the wheels' turning are used, because the heading is not known yet.

    Returns
    -------
    middle times (m,) of the earlier windows [s]; middle times (m,) of the later windows [s]; turns (m,) of the course
    over ground between them, clockwise [rad]
    """
    along = track.cumulate(track.mean_speed)
    length, t, position, begin, end = _cut_courses(track, float(track.t[0]), float(track.t[-1]))
    went = np.interp(t[end], track.t, along) - np.interp(t[begin], track.t, along)
    displacement = (position[end] - position[begin]) * np.sign(went)
    usable = (np.abs(went) > 0.3 * length) & (np.abs(displacement) > 0.3 * np.abs(went))
    usable &= t[end] - t[begin] < LONGEST_STRETCH_S
    middle, displacement = ((t[begin] + t[end]) / 2)[usable], displacement[usable]
    near = np.diff(middle) < LONGEST_STRETCH_S
    return middle[:-1][near], middle[1:][near], np.angle(displacement[1:] * np.conj(displacement[:-1]))[near]


def _cut_courses(track: Track, first_s: float, last_s: float) -> tuple[float, Floats, Complexes, Ints, Ints]:
    """Return windows of driven distance of a span of a drive; they follow one another and share no fix.

    Returns
    -------
    length of the windows [m]; times and positions of the fixes, without fixes that lie far from both neighbours; rows
    of these (w,), first and last of each window
    """
    std = min(track.place_std_m, 10.0)
    short = max(float(track.travel[-1]) / ENOUGH_COURSES, SHORTEST_IN_POSITION_STD * std)
    length = max(COURSE_WINDOW_M, min(COURSE_IN_POSITION_STD * std, short))
    rows = np.flatnonzero((track.place_t >= first_s) & (track.place_t <= last_s))
    t, position = track.place_t[rows], track.place[rows]
    if len(rows) > 2:
        bend = np.abs(position[1:-1] - (position[:-2] + position[2:]) / 2)
        far = bend > JUMP_SIGMAS * max(mad_std(bend, 0.0), track.place_std_m)
        # A spike also bends the path at its two neighbours, by half of the angle.
        spike = far & (bend >= np.maximum(np.append(bend[1:], 0.0), np.append(0.0, bend[:-1])))
        kept = np.concatenate([[True], ~spike, [True]])
        t, position = t[kept], position[kept]
    gone = np.interp(t, track.t, track.cumulate(np.abs(track.mean_speed)))
    step = np.diff(gone)
    if FIXES_A_WINDOW * float(np.median(step[step > 0.0] if (step > 0.0).any() else 0.0)) > LONG_WINDOW * length:
        rows, begin, end = _windows_of_rare(gone, length)
        return length, t[rows], position[rows], begin, end
    cell = np.floor(gone / length)
    edges = [0]
    for row in (np.flatnonzero(np.diff(cell) > 0) + 1).tolist():
        if row - edges[-1] >= FIXES_A_WINDOW:
            edges.append(row)
    return length, t, position, np.array(edges[:-1], np.int64), np.array(edges[1:], np.int64) - 1


def _windows_of_rare(gone_m: Floats, length_m: float) -> tuple[Ints, Ints, Ints]:
    """Return rows of fixes, each shared fix twice, and where among them windows of at least a length begin and end.

    Parameters
    ----------
    gone_m : (m,) driven distance at the fixes
    """
    edges = [0]
    for row in range(1, len(gone_m)):
        if gone_m[row] - gone_m[edges[-1]] >= length_m:
            edges.append(row)
    count = np.diff(edges) + 1
    end = np.cumsum(count) - 1
    return np.arange(int(count.sum())) - np.repeat(np.arange(len(count)), count), end + 1 - count, end


WHEEL_TURN, WHEEL_SCALE_STD = 0.6, 0.5
"""Prior mean and standard deviation of the ratio of a skid-steer robot's turn to its wheels' turn without slip."""

Z_UP = np.array([0.0, 0.0, -1.0])
"""The downward vertical in a sensor whose z axis points up."""

ALONG_AN_AXIS = 0.95
"""Cosine of the angle between a sensor's axis and the vertical above which the axis is taken to be vertical."""

BETTER_SCATTER_RATIO = 0.9
"""Largest ratio of another axis's scatter to the scatter with z up at which the other axis is used. The scatter is of
the turns of the course over ground, or the standard deviation of the heading."""

LARGEST_CHANGE_RAD = 2.5
"""Largest turn between two courses that the axis of a gyro is found with [rad]. A larger one may be a turn to the other
side."""

SHORTEST_HOLE_S = 0.1
"""Shortest interval that is a hole in a turn rate [s]."""

AXIS_PRIOR_STD = np.array([0.3, 0.3, 0.3, math.radians(1.0)])
"""Prior standard deviations of the vertical's three components, and of the gyro's bias [rad/s]. A drive on level ground
shows little of the horizontal axes."""

LEAST_AXIS = 0.3
"""Smallest share of the changes of the course over ground that a gyro must show. A gyro with less shows no axis."""


def wheel_rate(track: Track, width_m: float) -> TurnRate:
    """Return the turn rate of the wheels, with a wide prior of its scale."""
    rate = WHEEL_TURN * (track.v_left - track.v_right) / width_m
    gaps = np.flatnonzero(track.held[:-1] == 0.0)
    holes = np.column_stack([track.t[gaps], track.t[gaps + 1]])
    return TurnRate(
        track.t, rate, holes, scale_std=WHEEL_SCALE_STD, bias_std=math.radians(0.5), hole_std=_any_rate_std(rate),
        delay_std_s=CAUTIOUS_RESPONSE_STD_S,
    )  # fmt: skip


def _any_rate_std(rate: Floats) -> float:
    """Return the standard deviation of a rate that was not measured [rad/s]: the rms rate of the drive."""
    return max(float(np.sqrt(np.mean(rate**2))) if len(rate) else 0.0, LEAST_HOLE_STD_RADPS)


def gyro_rates(
    track: Track, changes: tuple[Floats, Floats, Floats], gyro: GyroAxes, epoch_ns: int
) -> list[tuple[TurnRate, str]]:
    """Return candidates of a gyro's turn rate about the vertical, each with the mounting that it assumes.

    There is one candidate if the changes of the course over ground, regressed on the turns about the sensor's three
    axes, show the vertical, or if the sensor turned most about its z axis, which then points up. Otherwise both senses
    of the axis with most turn follow; the agreement of the resulting headings with the courses decides. The list is
    empty where the gyro does not cover courses.
    """
    t = (gyro.stamp_ns - epoch_ns) / 1e9
    begin, end, change = changes
    inside = (begin >= t[0]) & (end <= t[-1])
    begin, end, change = begin[inside], end[inside], change[inside]
    if len(change) < 3:
        return []
    angles = [trapezoids(t, rate) for rate in gyro.rates_radps.T]
    turned = np.column_stack([np.interp(end, t, angle) - np.interp(begin, t, angle) for angle in angles])
    small = np.abs(turned).max(axis=1) < LARGEST_CHANGE_RAD
    by_courses = None
    if np.count_nonzero(small) >= 6:
        by_courses = _axis_by_courses(turned[small], (end - begin)[small], change[small])
    axes = [(Z_UP, "z up")] if by_courses is None else [by_courses]
    if by_courses is None and (about := _main_axis(turned, end - begin, change)) is not None:
        axes += [_named(about), _named(-about)]
    return [(_bridged(t, gyro.rates_radps @ axis, track), name) for axis, name in axes]


def _named(axis: Floats) -> tuple[Floats, str]:
    """Return the downward vertical in a sensor (3,), set to one of its axes if close to it, and its name."""
    main = int(np.argmax(np.abs(axis)))
    if abs(axis[main]) <= ALONG_AN_AXIS:
        return axis, "tilted"
    return np.sign(axis[main]) * np.eye(3)[main], f"{'xyz'[main]} {'down' if axis[main] > 0 else 'up'}"


def _axis_by_courses(turned: Floats, seconds: Floats, change: Floats) -> tuple[Floats, str] | None:
    """Return the downward vertical in the sensor (3,), and its name; None where the courses over ground show none.

    Parameters
    ----------
    turned : (m, 3) turn about each axis of the sensor [rad]
    seconds : (m,) time of the turn [s]
    change : (m,) turn of the course over ground in this time [rad]
    """
    solution = robust_regression(np.column_stack([turned, seconds]), change, AXIS_PRIOR_STD).x
    size = float(np.linalg.norm(solution[:3]))
    if size <= LEAST_AXIS:
        return None
    axis, name = _named(solution[:3] / size)
    residuals = change[:, None] - solution[3] * seconds[:, None] - turned @ np.column_stack([axis, Z_UP])
    scatter = np.abs(wrapped(residuals)).mean(axis=0)
    return (axis, name) if name == "z up" or scatter[0] < BETTER_SCATTER_RATIO * scatter[1] else None


def _main_axis(turned: Floats, seconds: Floats, change: Floats) -> Floats | None:
    """Return the direction (3,), of either sense, of the axis about which a sensor turned most, without its bias.

    None where that is its z axis, or where it hardly turned; parameters as in `_axis_by_courses`.
    """
    beyond = turned - np.outer(seconds, turned.sum(axis=0) / seconds.sum())
    largest = float(np.abs(beyond).max())
    if not LEAST_AXIS * float(np.abs(change).max()) < largest < math.inf:
        return None
    axis = np.linalg.svd(beyond / largest, full_matrices=False)[2][0]
    return None if abs(axis[2]) > ALONG_AN_AXIS else np.asarray(axis, np.float64)


COVERED_SHARE = 0.9
"""Share of a hole of the gyro that the wheels must cover to bridge it."""


def _bridged(t: Floats, rate: Floats, track: Track) -> TurnRate:
    """Return a gyro's rate with its holes bridged by the wheels' turn, scaled as the gyro shows it elsewhere."""
    long = np.flatnonzero(is_hole(np.diff(t), SHORTEST_HOLE_S))
    holes = np.column_stack([t[long], t[long + 1]])
    if not len(holes):
        return TurnRate(t, rate, holes)
    apart = track.v_left - track.v_right
    there = np.interp(track.t, t, rate)
    hole = np.searchsorted(holes[:, 0], track.t) > np.searchsorted(holes[:, 1], track.t, side="right")
    measured = ~hole & (track.t >= t[0]) & (track.t <= t[-1])
    factor = float(apart[measured] @ there[measured]) / max(float(apart[measured] @ apart[measured]), 1e-12)
    residuals = there[measured] - factor * apart[measured]
    wheels = hole & (track.held > 0.0)
    order = np.argsort(np.concatenate([t, track.t[wheels]]), kind="stable")
    # In a hole that the wheels do not cover, the standard deviation is the rms turn rate of the drive.
    covered_s = np.interp(holes, track.t, np.concatenate([[0.0], np.cumsum(track.held[:-1])])) @ [-1.0, 1.0]
    covered = covered_s > COVERED_SHARE * (holes[:, 1] - holes[:, 0])
    by_wheels = float(np.sqrt(np.mean(residuals**2))) if len(residuals) else LEAST_HOLE_STD_RADPS
    return TurnRate(
        np.concatenate([t, track.t[wheels]])[order],
        np.concatenate([rate, factor * apart[wheels] + float(np.median(residuals))])[order],
        holes, hole_std=np.where(covered, by_wheels, _any_rate_std(rate)),
    )  # fmt: skip
