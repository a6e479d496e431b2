"""Motion of the reference compared with the motion of the wheels, in windows of time; jumps of the reference.

The motion of the wheels is computed with the alignment's estimate. Place and turn are compared separately: for the
place, wheel speeds are integrated along the measured heading; for the turn, they are integrated alone.

A step that exceeds the motion of the wheels is slip of the robot or an error of the reference. A gyro separates the two
where the heading steps: if heading and position of a pose step while wheels and gyro do not turn, the reference jumps.
Otherwise a step is a jump only if no robot can make it, or if the receiver reports a change of its solution. Other
steps remain undecided and count as motion of the robot.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from icrtool.alignment.estimator import estimate_alignment
from icrtool.alignment.log_track import cut_drive_windows, track_of_streams
from icrtool.alignment.sensor_noise import FEWEST_FIXES, MOVES_MPS, OUTLIER_SIGMAS, USUAL_POSITION_STD_M, is_hole
from icrtool.kernels.arrays import Bools, Bytes, Complexes, Floats, Ints, trapezoids
from icrtool.kernels.robust import mad_std
from icrtool.kernels.track import Track
from icrtool.motion.recording import fit_gyro_line
from icrtool.records.measurements import CAUTIOUS_RESPONSE_STD_S, ReferenceJump, SensorData

KNOT_S = 0.1
"""Shortest time between two fixes that are compared [s]. Closer fixes add much noise and little information."""

SPEED_S = 0.1
"""Time over which the speed at a knot is averaged [s]."""

LONGEST_SAMPLE_HOLE_S = 0.6
"""Longest time between two samples without a hole [s]. No window spans a hole."""

LONGEST_HELD_IN_USUAL = 2.0
"""Time for which a wheel value is held, in usual times, above which the speed really was constant."""

MOTION_WINDOW_M = 1.0
"""Shortest window for the estimate of the motion [m]. It is shorter than in the alignment, so that events disturb fewer
windows."""

LEAST_TURN_GAIN = 1e-3
"""Smallest ratio of the robot's turn to its wheels' turn that the ICR separation is computed from."""

WINDOWS_S = (0.5, 1.0, 2.0)
"""Durations of the windows that are always compared [s]."""

LONGEST_MOTION_WINDOW_S = 16.0
"""Longest window [s]. Windows are doubled up to this time where the fixes are too noisy for shorter ones."""

FEWEST_INTERVALS = 2
"""Smallest number of intervals between fixes in an event. A single interval may be a jump."""

LEAST_DISTANCE2 = 36.0
"""Squared Mahalanobis distance from which on a window shows an event."""

LEAST_MODEL_ERROR = 0.03
"""Smallest standard deviation of the model's error, as a share of the wheels' motion."""

FIRST_QUANTILE, LATER_QUANTILE = 0.7, 0.95
"""Quantiles of the windows' residuals from which the model's error is computed: in the first round, and in later
rounds. In the first round the windows still include events."""

NORMAL_QUANTILE = {FIRST_QUANTILE: 1.0364, LATER_QUANTILE: 1.9600}
"""Quantiles of the absolute value of a standard normal variable."""

MOVING_SHARE = 0.2
"""Smallest motion of the wheels in a window that shows the model's error, as a share of the usual motion."""


class Knots(NamedTuple):
    """Fixes about `KNOT_S` apart, and the motion at them, as integrals since the first.

    Attributes
    ----------
    epoch_ns : stamp from which times count [ns]
    track : track of the log with these fixes alone; its distance is the wheels' distance
    variance : (m,) variance of a fix on one axis [m^2]
    heading : (m,) heading, unwrapped [rad]
    turn_variance : variance of one heading [rad^2]
    velocity : complex (m,) mean velocity of the sides along the heading, north + j east [m/s]
    apart : (m,) speed of the left side minus speed of the right side [m/s]
    held_m2 : (m,) variance that values held from sample to sample add to a side's distance [m^2]
    holes : (m,) number of earlier steps that touch a hole of any stream
    wheel_holes : (m,) number of earlier steps that touch a hole of the wheels
    fix_class : (m,) classes of the fixes
    turn_follows_place : the headings are estimated from the positions, and jump with them
    gyro : (m,) turn of the gyro [rad], in sense and scale of the headings; None without a gyro that agrees with them
    """

    epoch_ns: int
    track: Track
    variance: Floats
    heading: Floats
    turn_variance: float
    velocity: Complexes
    apart: Floats
    held_m2: Floats
    holes: Ints
    wheel_holes: Ints
    fix_class: Bytes
    turn_follows_place: bool
    gyro: Floats | None

    @property
    def t(self) -> Floats:
        """Times of the fixes (m,) [s] since `epoch_ns`."""
        return self.track.place_t


class Motion(NamedTuple):
    """Motion by the wheels at the knots, with the scale and the turn gain of an estimate.

    Attributes
    ----------
    displacement : complex (m,) displacement since the first knot, north + j east [m]
    turn : (m,) turn since the first knot, clockwise [rad]
    scale : distance of the robot per distance that the wheels report
    lever_m : half the ICR separation [m]; a turn times this lever is a distance
    """

    displacement: Complexes
    turn: Floats
    scale: float
    lever_m: float


class ComparedWindows(NamedTuple):
    """Motion of the reference minus the motion by the model, in windows between two knots.

    Attributes
    ----------
    begin, end : (w,) rows of the knots
    ahead, aside, turned : (w,) reference minus model [m]; turns are multiplied by half the ICR separation
    model_ahead, model_turned : (w,) motion by the wheels, in the same units
    made : (w,) motion of the reference itself, the larger of displacement and turn [m]
    path_m : (w,) motion of the wheels [m], scale included
    sensor : (w, 3) variance that noise, held values and change of speed give ahead, aside, turned [m^2]
    """

    begin: Ints
    end: Ints
    ahead: Floats
    aside: Floats
    turned: Floats
    model_ahead: Floats
    model_turned: Floats
    made: Floats
    path_m: Floats
    sensor: Floats

    @property
    def residual(self) -> Floats:
        """Reference minus model (w, 3): ahead, aside, turned [m]."""
        return np.column_stack([self.ahead, self.aside, self.turned])

    @property
    def side_residual(self) -> Floats:
        """Reference minus model of the left and of the right side (2, w) [m]."""
        return np.stack([self.ahead + self.turned, self.ahead - self.turned])

    @property
    def model_sides(self) -> Floats:
        """Motion of the left and of the right side by the model (2, w) [m]."""
        return np.stack([self.model_ahead + self.model_turned, self.model_ahead - self.model_turned])

    def rows(self, rows: Bools | slice) -> ComparedWindows:
        """Return the windows in some rows."""
        return ComparedWindows._make(column[rows] for column in self)


def lay_knots(sensors: SensorData) -> Knots | None:
    """Return the motion of the wheels at the times of the fixes; None where the streams share too little time."""
    wheels, fixes, headings = sensors.wheels, sensors.fixes, sensors.headings
    if min(len(wheels.stamp_ns), len(fixes.stamp_ns), len(headings.stamp_ns)) < FEWEST_FIXES:
        return None
    track = track_of_streams(wheels, fixes, headings, same_clock=sensors.facts.heading_from_position)
    left, right = track.v_left, track.v_right
    begin, end = (pick(track.t[at], track.heading_t[at]) for pick, at in ((max, 0), (min, -1)))
    rows = np.flatnonzero((track.place_t >= begin) & (track.place_t <= end))
    if len(rows) > 1:
        usual = float(np.median(np.diff(track.place_t[rows])))
        rows = rows[:: max(1, round(KNOT_S / usual))] if usual > 0 else rows
        rows = rows[np.diff(track.place_t[rows], prepend=-np.inf) > KNOT_S / 10]
    if len(rows) < FEWEST_FIXES:
        return None
    track = track.places(rows)
    t = track.place_t
    v_left, v_right = (
        (np.interp(t + SPEED_S / 2, track.t, travelled) - np.interp(t - SPEED_S / 2, track.t, travelled)) / SPEED_S
        for travelled in (track.cumulate(left), track.cumulate(right))
    )
    heading = track.heading_at(t)
    of_wheels, *of_others = (_in_hole(sampled, t) for sampled in (track.t, track.seen_heading_t, t))
    gyro, by_gyro = sensors.gyro, None
    if gyro is not None and len(gyro.stamp_ns) >= FEWEST_FIXES:
        at = (gyro.stamp_ns - wheels.stamp_ns[0]) / 1e9
        turned = trapezoids(at, gyro.rate_radps)
        line = fit_gyro_line(at, gyro.rate_radps, turned, t, heading)
        if line.is_yaw:
            by_gyro = line.scale * np.interp(t + line.lead_s, at, turned) + line.bias_radps * t
    return Knots(
        epoch_ns=int(wheels.stamp_ns[0]), track=track,
        variance=np.maximum((fixes.var_north_m2 + fixes.var_east_m2)[rows] / 2, USUAL_POSITION_STD_M**2),
        # The second differences give an upper bound of the noise, because they include motion.
        heading=heading, turn_variance=mad_std(np.diff(heading, 2), 0.0) ** 2 / 6,
        velocity=(v_left + v_right) / 2 * np.exp(1j * heading), apart=v_left - v_right,
        held_m2=np.interp(t, track.t, _held_variance(track.t, left, right)),
        holes=np.append(0, np.cumsum(np.logical_or.reduce([of_wheels, *of_others]))),
        wheel_holes=np.append(0, np.cumsum(of_wheels)), fix_class=fixes.fix_class[rows],
        turn_follows_place=sensors.facts.heading_is_estimated, gyro=by_gyro,
    )  # fmt: skip


def _in_hole(sampled: Floats, t: Floats) -> Bools:
    """Return which steps between times t (m,) begin or end in a hole of a stream, or hold one whole (m - 1,)."""
    before = np.flatnonzero(is_hole(np.diff(sampled), LONGEST_SAMPLE_HOLE_S))
    begun = np.searchsorted(sampled[before], t[1:])
    return np.asarray(begun > np.searchsorted(sampled[before + 1], t[:-1], side="right"))


def compare_by_duration(knots: Knots, motion: Motion) -> list[tuple[float, ComparedWindows]]:
    """Return the durations of the windows [s], the longest first, and the windows of each.

    Durations are doubled until the usual distance clearly exceeds the noise of the fixes. A window lasts for its
    duration, or one fix longer, and spans no hole.
    """
    path, dt = np.diff(knots.track.distance), np.diff(knots.t)
    moving, durations = path > MOVES_MPS * dt, list(WINDOWS_S)
    if moving.any():
        speed = float(np.median(path[moving] / dt[moving]))
        needed = math.sqrt(2 * LEAST_DISTANCE2 * float(np.median(knots.variance)))
        while speed * durations[-1] < needed and durations[-1] < LONGEST_MOTION_WINDOW_S:
            durations.append(2 * durations[-1])
    by_duration = []
    for duration_s in reversed(durations):
        last = np.searchsorted(knots.t, knots.t + duration_s - KNOT_S / 2)
        first = np.flatnonzero(last < len(knots.t))
        last = last[first]
        usable = (last - first >= FEWEST_INTERVALS) & (knots.holes[first] == knots.holes[last])
        by_duration.append(
            (duration_s, compare_with_wheels(knots, motion, first[usable], last[usable], CAUTIOUS_RESPONSE_STD_S))
        )
    return by_duration


def fit_motion(knots: Knots, width_m: float, quiet: Bools) -> Motion | None:
    """Return the motion by the wheels with the alignment's estimate; None where there is too little distance.

    Parameters
    ----------
    knots : the reference, at its knots
    width_m : the track width b [m]
    quiet : (m,) knots that may be inside a window
    """
    # No window spans these intervals between knots.
    is_excluded = ~(quiet[1:] & quiet[:-1]) | (np.diff(knots.holes) > 0)
    windows = cut_drive_windows(knots.track._replace(slipping=np.append(is_excluded, False)), MOTION_WINDOW_M)
    disturbed = np.concatenate([[0], np.cumsum(~quiet)])
    begin, end = np.searchsorted(knots.t, [windows.turn_begin, windows.turn_end]).clip(0, len(knots.t) - 1)
    undisturbed = (disturbed[end + 1] == disturbed[begin]) & (knots.holes[end] == knots.holes[begin])
    turn_begin, turn_end = windows.turn_begin[undisturbed], windows.turn_end[undisturbed]
    windows = replace(windows, turn_begin=turn_begin, turn_end=turn_end, turn_group=windows.turn_group[undisturbed])
    fit = estimate_alignment(windows, width_m)
    if fit is None:
        return None
    displacement, turn = fit.model.until_fixes(fit.solution.x)
    gain = max(abs(fit.estimate("turn")[0]), LEAST_TURN_GAIN)
    return Motion(displacement, turn, abs(fit.estimate("scale")[0]), width_m / 2 / gain)


def compare_with_wheels(
    knots: Knots, motion: Motion, first: Ints, last: Ints, response_std_s: float
) -> ComparedWindows:
    """Return the motion of the reference minus the motion of the wheels between rows of the knots (w,).

    Parameters
    ----------
    knots : the reference, at its knots
    motion : motion by the wheels until each knot
    first, last : (w,) rows of the knots at which each window begins and ends
    response_std_s : standard deviation of the time by which the robot lags its wheels [s]
    """
    level = np.exp(-0.5j * (knots.heading[first] + knots.heading[last]))
    moved, model, change = (
        level * (column[last] - column[first]) for column in (knots.track.place, motion.displacement, knots.velocity)
    )
    turn, model_turn, spin = (column[last] - column[first] for column in (knots.heading, motion.turn, knots.apart))
    missed, path_m, lever = moved - model, knots.track.distance[last] - knots.track.distance[first], motion.lever_m
    scale2 = motion.scale**2
    noise = knots.variance[first] + knots.variance[last]
    held = scale2 * (knots.held_m2[last] - knots.held_m2[first]) / 2
    ahead, spun = (scale2 * response_std_s**2 * square for square in (np.abs(change) ** 2, spin**2 / 4))
    turn_noise = lever**2 * 2 * knots.turn_variance
    return ComparedWindows(
        first, last, missed.real, missed.imag, lever * (turn - model_turn), model.real, lever * model_turn,
        np.maximum(np.abs(moved), lever * np.abs(turn)), motion.scale * path_m,
        np.column_stack([noise + held + ahead, noise + held / 4 + ahead / 4, turn_noise + held + spun]),
    )  # fmt: skip


def _held_variance(t: Floats, v_left: Floats, v_right: Floats) -> Floats:
    """Return the summed variance (n,) of a side's distance by held values.

    A value that changes by d after it was held for h may have changed at any time in between: (d h)^2 / 12.
    """
    change = np.hypot(np.diff(v_left), np.diff(v_right))
    changed = np.flatnonzero(change > 0) + 1
    held = np.diff(t[np.concatenate([[0], changed])])
    # Values of a standing robot do not count as held.
    held = np.minimum(held, LONGEST_HELD_IN_USUAL * float(np.median(held)) if len(held) else 0.0)
    variance = np.zeros(len(t))
    variance[changed] = (change[changed - 1] * held) ** 2 / 12
    return np.cumsum(variance)


def model_error(windows: ComparedWindows, quiet: Bools, quantile: float) -> Floats:
    """Return the standard deviation of the model's error (3,), a share of the wheels' motion.

    With sensor noise s and model error k p, a share q of the residuals r is within n standard deviations if k is the
    q-quantile of sqrt(r^2 / n^2 - s^2) / p.
    """
    disturbed = np.concatenate([[0], np.cumsum(~quiet)])
    used = disturbed[windows.end + 1] == disturbed[windows.begin]
    used &= windows.path_m > MOVING_SHARE * (float(np.quantile(windows.path_m, 0.9)) if len(used) else 0.0)
    if not used.any():
        return np.full(3, LEAST_MODEL_ERROR)
    excess = (windows.residual[used] / NORMAL_QUANTILE[quantile]) ** 2 - windows.sensor[used]
    square = np.quantile(excess / windows.path_m[used, None] ** 2, quantile, axis=0)
    return np.asarray(np.sqrt(np.maximum(square, LEAST_MODEL_ERROR**2)))


JUMP_SPEED_SHARE, JUMP_MPS = 2.0, 0.3
"""Motion that the robot may make beyond noise: a multiple of the wheels' distance, plus a slow slide [m/s]. A larger
step may be a jump."""

SLIDE_MPS = 2.0
"""Largest excess of a sliding robot's speed over the largest wheel speed [m/s]. It needs 1 s of free slide at 0.2 g; a
robot that brakes on ice keeps its speed."""

STAMP_STD_S = 0.1
"""Standard deviation of the stamps of poses [s], measured on recorded lidar poses. Single stamps are wrong by 0.3 s."""


def without_jumps(knots: Knots, width_m: float) -> tuple[Knots, Ints]:
    """Return the knots without single outliers, and the rows before steps that may be jumps; no window spans them."""
    row = np.arange(len(knots.t))
    step, over = _beyond(knots, row[:-1], row[1:], width_m), _beyond(knots, row[:-2], row[2:], width_m)
    is_kept = np.ones(len(row), np.bool_)
    is_kept[1:-1] = ~(step[:-1] & step[1:] & ~over)
    columns: dict[str, Any] = {
        name: value[is_kept] for name, value in knots._asdict().items() if isinstance(value, np.ndarray)
    }
    knots = knots._replace(track=knots.track.places(is_kept), **columns)
    row = row[: len(knots.t)]
    first = np.flatnonzero(_beyond(knots, row[:-1], row[1:], width_m))
    holes = np.searchsorted(first, row - 1, side="right")
    return knots._replace(holes=knots.holes + holes), first


def _beyond(knots: Knots, first: Ints, last: Ints, width_m: float) -> Bools:
    """Return which windows (w,) move or turn further than noise, wheels and a slow slide explain."""
    path, duration = knots.track.distance[last] - knots.track.distance[first], knots.t[last] - knots.t[first]
    by_robot = JUMP_SPEED_SHARE * path + JUMP_MPS * duration
    noise = np.sqrt(knots.variance[first] + knots.variance[last])
    moved = np.abs(knots.track.place[last] - knots.track.place[first]) > OUTLIER_SIGMAS * noise + by_robot
    if knots.turn_follows_place:
        return np.asarray(moved)
    turned = width_m * np.abs(knots.heading[last] - knots.heading[first])
    turn_noise = width_m * math.sqrt(2 * knots.turn_variance)
    return np.asarray(moved | (turned > OUTLIER_SIGMAS * turn_noise + by_robot))


def decide_jumps(knots: Knots, motion: Motion, first: Ints) -> tuple[ReferenceJump, ...]:
    """Return the jumps of the reference among the steps that may be jumps.

    Parameters
    ----------
    knots, first : result of `without_jumps`: the knots, and the rows before the steps
    motion : motion by the wheels
    """
    last = first + 1
    windows = compare_with_wheels(knots, motion, first, last, 0.0)
    duration = knots.t[last] - knots.t[first]
    speed = np.diff(knots.track.distance) / np.diff(knots.t)
    # The speed of the wheels is a quantile, so that single samples do not count.
    slide = (SLIDE_MPS + motion.scale * float(np.quantile(speed, 0.99))) * duration
    # `jitter` and `spin` are motion of the wheels in the time by which stamps may be wrong, before and after each step.
    reach = (knots.t[last] + 3 * STAMP_STD_S, knots.t[first] - 3 * STAMP_STD_S)
    jitter, spin = (
        np.abs(np.interp(reach[0], knots.t, along) - np.interp(reach[1], knots.t, along) - (along[last] - along[first]))
        for along in (motion.scale * knots.track.distance, motion.lever_m * motion.turn)
    )
    noise = OUTLIER_SIGMAS * np.sqrt(windows.sensor)
    ahead = np.maximum(np.abs(windows.ahead) - jitter, 0.0)
    moved = np.hypot(ahead, windows.aside) - noise[:, :2].max(axis=1)
    turned = np.maximum(np.abs(windows.turned) - spin, 0.0) - noise[:, 2]
    turned = np.where(knots.turn_follows_place, 0.0, turned)
    alone = turned > JUMP_MPS * duration
    shown = (moved > JUMP_MPS * duration) | alone
    if knots.gyro is None:
        alone[:] = False
    else:
        # The gyro's turn must be closer to the wheels' turn than to the reference's turn.
        by_gyro = motion.lever_m * (knots.gyro[last] - knots.gyro[first])
        slipped = np.abs(by_gyro - windows.model_turned)
        alone &= slipped < np.minimum(JUMP_MPS * duration, np.abs(windows.turned) / 2)
    restated = knots.fix_class[first] != knots.fix_class[last]
    causes = {
        "the receiver changes its solution there": restated,
        "gyro and wheels do not turn with it": alone,
        "faster than any slide": moved > slide,
        "turns faster than any robot": turned > slide,
    }
    why = np.select(list(causes.values()), list(causes), "")
    # Where the wheels are not known, a step without a cause counts as motion of the robot.
    shown &= (why != "") | (knots.wheel_holes[first] == knots.wheel_holes[last])
    level = np.exp(0.5j * (knots.heading[first] + knots.heading[last]))
    by = (windows.ahead + 1j * windows.aside) * level
    turn = np.zeros(len(first)) if knots.turn_follows_place else windows.turned / motion.lever_m
    stamps = knots.epoch_ns + np.rint(knots.t * 1e9).astype(np.int64)
    return tuple(
        ReferenceJump(
            kind="heading" if abs(turn[row]) * motion.lever_m > abs(by[row]) else "position",
            begin_ns=int(stamps[first[row]]),
            end_ns=int(stamps[last[row]]),
            north_m=float(knots.track.north[first[row]]),
            east_m=float(knots.track.east[first[row]]),
            size_m=float(abs(by[row])),
            turn_deg=math.degrees(turn[row]),
            moved_north_m=float(by[row].real),
            moved_east_m=float(by[row].imag),
            why=str(why[row]) or "may be slip: cause undecided",
            undecided=not why[row],
        )
        for row in np.flatnonzero(shown)
    )
