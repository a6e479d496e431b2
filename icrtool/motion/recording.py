"""Data to which motion models are fitted and on which they are tested: wheels, reference, gyro; windows and trials.

The turns of a gyro are compared with the turns of the reference by a line, also in the alignment.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icrtool.errors import DataError
from icrtool.kernels.arrays import ROWS_AT_ONCE, Complexes, Floats, Ints, Rows, rows_at_steps
from icrtool.kernels.robust import LOSS_SIGMAS, robust_least_squares
from icrtool.kernels.track import Track, Windows, cut, ends_from
from icrtool.kernels.window_residuals import OMEGA, path_at
from icrtool.motion.models import NO_LEVER, FittedModel, Lever, wheel_motion
from icrtool.records.measurements import TURNING_MPS

WINDOWS_M = (5.0, 10.0)
"""Lengths of the windows [m]. With one length alone, a drive on a circle of this circumference would show nothing."""

FULL_SIZE_WIDTH_M = 0.5
"""Track width above which windows and stretches have their full length [m]. For smaller robots all lengths are smaller
in proportion, because their paths and errors are smaller, too."""

EVERY_M = 0.5
"""Distance between the starts of two windows of one length [m]."""

MOST_STARTS = 800
"""Approximate largest number of windows of one length in all logs together. On long drives windows start further
apart."""

LEAST_OFTEN_M = 2.5
"""Largest distance between the starts of two windows [m]: half of the shortest window."""

RECORDING_STEP_S = 0.1
"""Length of the steps to which wheel samples are joined [s]."""

MOST_RECORDING_STEPS = 10_000
"""Number of steps above which longer steps are used."""

LONGEST_RECORDING_STEP_S, LONGEST_STEP_M = 0.4, 0.25
"""Longest step in time [s] and in distance [m]."""

STRETCH_M = 20.0
"""Distance within which errors depend on one another [m], for the covariance: twice the longest window."""

FEWEST_FIT_WINDOWS = 10
"""Smallest number of windows for a fit."""


class LogConstants(NamedTuple):
    """Constants of one recording, in addition to the parameters of its robot.

    Attributes
    ----------
    heading_offset_rad : angle that is added to the heading of the reference
    wheels_later_s : time by which the wheels are read later than the poses
    gyro_bias_radps : turn rate that is added to the turn rate of a model with a gyro
    gyro_later_s : time by which the gyro is read later than the wheels, to first order
    """

    heading_offset_rad: float = 0.0
    wheels_later_s: float = 0.0
    gyro_bias_radps: float = 0.0
    gyro_later_s: float = 0.0

    def plus(self, other: LogConstants) -> LogConstants:
        """Return the sum of two corrections; the heading offset is within half a turn."""
        return self._summed(other, 1.0)

    def minus(self, other: LogConstants) -> LogConstants:
        """Return the difference of two corrections; the heading offset is within half a turn."""
        return self._summed(other, -1.0)

    def _summed(self, other: LogConstants, sign: float) -> LogConstants:
        """Return the sum with `sign` times other constants."""
        offset, *others = (value + sign * two for value, two in zip(self, other, strict=True))
        return LogConstants(math.remainder(offset, 2.0 * math.pi), *others)


NO_CONSTANTS = LogConstants()
"""Constants of a recording in which nothing has to be corrected."""


@dataclass(frozen=True, slots=True)
class Recording:
    """One log as input of the motion models.

    Attributes
    ----------
    name : name of the log
    track : states of the run and turn rate of the gyro, with the wheel speeds as recorded
    width_m : track width b
    path, sha256 : first file of the log; empty if it is not known
    gyro_reversed : whether the gyro counts turns in the other direction, so that its sign was changed
    begin_ns : stamp of the first state; 0 if it is not known
    lever : known parts of the lever to the measured position
    x_clock_std_m : standard deviation of x_icr [m] from the unknown time between position and heading
    wheel_scales : ratios of the left and right speeds of `track` to the speeds that models are fitted to
    corrected : constants that were corrected in `track`. The constants of the log's sensors are the sum of these and of
        the constants that are found in `track`
    heading_source : source of the heading, as `HeadingFacts.source`; empty if it is not known
    """

    name: str
    track: Track
    width_m: float
    path: str = ""
    sha256: str = ""
    gyro_reversed: bool = False
    begin_ns: int = 0
    lever: Lever = NO_LEVER
    x_clock_std_m: float = 0.0
    wheel_scales: tuple[float, float] = (1.0, 1.0)
    corrected: LogConstants = NO_CONSTANTS
    heading_source: str = ""

    def wheels(self, rows: Ints | slice = slice(None)) -> Track:
        """Return the track with some of its wheel samples, with the speeds that models are fitted to."""
        track, (left, right) = self.track.wheels(rows), self.wheel_scales
        if (left, right) == (1.0, 1.0):
            return track
        return track._replace(v_left=track.v_left / left, v_right=track.v_right / right)


class Totals(NamedTuple):
    """Distance [m] and time [s] of all recordings that are fitted together."""

    metres: float
    seconds: float


def totals_of(*recordings: Recording) -> Totals:
    """Return distance and time of recordings together."""
    return Totals(
        sum(float(recording.track.distance[-1]) for recording in recordings),
        sum(float(recording.track.held.sum()) for recording in recordings),
    )


def size_of(width_m: float) -> float:
    """Return the factor of the usual distances for a robot of track width b [m], at most 1."""
    return min(1.0, width_m / FULL_SIZE_WIDTH_M)


def cut_windows(
    recording: Recording, lengths_m: Sequence[float] | None = None, pooled: Totals | None = None
) -> Windows:
    """Return the windows of driven distance of a recording for a fit; the wheel samples of their track are joined.

    Parameters
    ----------
    lengths_m : lengths of the windows; default: `WINDOWS_M`, shorter for small robots
    pooled : distance and time of all recordings that are fitted together; default: of this recording. With larger
        totals windows start further apart, and steps are longer

    Raises
    ------
    DataError
        There are fewer than `FEWEST_FIT_WINDOWS` windows.
    """
    track, pooled, size = recording.track, pooled or totals_of(recording), size_of(recording.width_m)
    lengths_m = [size * length_m for length_m in WINDOWS_M] if lengths_m is None else lengths_m
    every = min(max(size * EVERY_M, pooled.metres / MOST_STARTS), size * LEAST_OFTEN_M)
    windows = cut(track, lengths_m, every)
    if len(windows.begin) < FEWEST_FIT_WINDOWS:
        why = f"only {len(windows.begin)} windows of {min(lengths_m):g} m of driven distance"
        raise DataError(recording.name, why, "a calibration needs a longer drive")
    return replace(windows, track=steps_of(recording, pooled.seconds))


def samples_a_step(recording: Recording, pooled_s: float | None = None) -> int:
    """Return the number of wheel samples in a step of the fits.

    A step is 0.1 s long; on a long drive it is longer, at most 0.4 s and 0.25 m. `pooled_s` is the time of all
    recordings that are fitted together.
    """
    duration_s = recording.track.held
    lasting, travel = duration_s > 0.0, np.empty(len(duration_s))
    if not lasting.any():
        return 1
    total_s = float(duration_s.sum())
    for lo in range(0, len(duration_s), ROWS_AT_ONCE):
        chunk = slice(lo, lo + ROWS_AT_ONCE)
        wheels = recording.wheels(chunk)
        travel[chunk] = wheels.held * (np.abs(wheels.v_left) + np.abs(wheels.v_right))
    speed_mps = float(travel.sum()) / 2.0 / total_s
    step_s = min(
        (total_s if pooled_s is None else pooled_s) / MOST_RECORDING_STEPS,
        LONGEST_STEP_M / max(speed_mps, 1e-3),
        LONGEST_RECORDING_STEP_S,
    )
    return max(int(max(step_s, RECORDING_STEP_S) / float(np.median(duration_s[lasting], overwrite_input=True))), 1)


def steps_of(recording: Recording, pooled_s: float | None = None) -> Track:
    """Return the track of a recording with its wheel samples joined to the steps of the fits (`samples_a_step`)."""
    samples = samples_a_step(recording, pooled_s)
    if samples == 1:
        return recording.wheels()
    # The samples are joined in chunks, to bound the memory.
    rows, into = max(ROWS_AT_ONCE // samples, 1) * samples, (samples - 1) / (2.0 * samples)
    parts = []
    for lo in range(0, len(recording.track.t), rows):
        chunk = recording.wheels(slice(lo, lo + rows))
        parts.append(chunk.joined(np.arange(0, len(chunk.t), samples), into))
    t, held, left, right = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "held", "v_left", "v_right")
    )
    gyro = (
        None if recording.track.gyro is None else np.concatenate([part.gyro for part in parts if part.gyro is not None])
    )
    return parts[0]._replace(t=t, held=held, v_left=left, v_right=right, gyro=gyro)


MOST_TRIALS = 4_000
"""Approximate largest number of trials. On long drives trials start further apart."""


class Trials(NamedTuple):
    """Trials of one recording.

    Attributes
    ----------
    starts : (k,) states at which the trials start
    ends : (k, h) states at which the trials end; negative for a start without a trial
    """

    starts: Ints
    ends: Rows


def cut_trials(recording: Recording, horizons_m: Sequence[float], pooled: Totals | None = None) -> Trials:
    """Return the trials of a recording from states in which it moves.

    Their starts are one step of the fits apart, and further on a long drive (about `MOST_TRIALS` starts), because
    trials that start closer together are nearly equal.

    Parameters
    ----------
    horizons_m : (h,) lengths of the trials [m]
    pooled : distance and time of all recordings that are fitted together; default: of this recording
    """
    track = recording.track
    # Trials that start while the robot stands are nearly equal.
    least = np.diff(track.t)
    least *= TURNING_MPS
    moving = np.flatnonzero(np.diff(track.distance) > least)
    step = samples_a_step(recording, None if pooled is None else pooled.seconds)
    starts = moving[:: max(step, len(moving) // MOST_TRIALS)].copy()
    return Trials(starts, ends_from(track, np.array(horizons_m, np.float64), starts))


class TrialErrors(NamedTuple):
    """Errors of a model at the ends of trials (k, h); NaN without a trial.

    Attributes
    ----------
    position : distance between open-loop position and reference [m]
    heading : size of the difference between the open-loop turn and the reference's turn [rad]
    aligned : as `position`, after the path is turned into the direction of the reference's first `ALIGNED_OVER_M` [m];
        NaN for a trial that is shorter than twice this distance
    """

    position: Floats
    heading: Floats
    aligned: Floats

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> TrialErrors:
        """Return errors that are all NaN, each horizon contiguous in memory."""
        return cls(*(np.full(shape[::-1], np.nan).T for _ in cls._fields))


ErrorsOf = Callable[[Trials], TrialErrors]
"""Function that returns the errors (k, h) of a model in trials."""

PathAt = Callable[[Floats], tuple[Floats, Complexes]]
"""Function that returns heading (m,) [rad] and place (m,) [m], forward + j right of the first step, of a path at times
(m,) [s]. Each call computes the whole path."""


ALIGNED_OVER_M = 2.0
"""Distance over which the directions of a path and of the reference are compared [m]. Fixes of 1 cm show the direction
to 0.4°, and an error of the turn rate has turned the path only little."""


def trial_errors(recording: Recording, start: Ints, end: Rows, path: PathAt) -> TrialErrors:
    """Return the errors (m,) at the ends of trials.

    Parameters
    ----------
    recording : the recording of the trials
    start, end : (m,) states at which the trials start and end
    path : path of the model

    Notes
    -----
    The parameters are constant, so the path from any start is the same path, turned and shifted. One pass over the
    samples gives all trials.
    """
    track, first = recording.track, int(start.min())
    s, e = start - first, end - first
    a = np.minimum(np.searchsorted(track.distance, track.distance[start] + ALIGNED_OVER_M) - first, e)
    used = np.zeros(int(e.max()) + 1, np.bool_)
    used[s] = used[e] = used[a] = True
    rows, number = first + np.flatnonzero(used), np.cumsum(used) - 1
    path_heading, position = path(recording.track.t[rows])
    s, e, a, heading_error = number[s], number[e], number[a], path_heading - track.heading[rows]
    turn, reference = np.exp(-1j * heading_error), track.north[rows] + 1j * track.east[rows]
    moved_by_model, moved_by_reference = turn[s] * (position[e] - position[s]), reference[e] - reference[s]
    # A robot that turns back within the first metres shows no direction.
    first_by_model, first_by_reference = turn[s] * (position[a] - position[s]), reference[a] - reference[s]
    shown = np.minimum(np.abs(first_by_model), np.abs(first_by_reference)) > ALIGNED_OVER_M / 2.0
    moved_aligned = moved_by_model * np.where(
        shown, np.exp(1j * np.angle(first_by_reference * np.conj(first_by_model))), 1.0
    )
    long_enough = track.distance[end] - track.distance[start] >= 2.0 * ALIGNED_OVER_M
    aligned = np.where(long_enough, np.abs(moved_aligned - moved_by_reference), np.nan)
    return TrialErrors(
        np.abs(moved_by_model - moved_by_reference), np.abs(heading_error[e] - heading_error[s]), aligned
    )


def predicted_path(
    recording: Recording, fitted_model: FittedModel, constants: LogConstants = NO_CONSTANTS, steps: Track | None = None
) -> PathAt:
    """Return a function for the path that a model makes of a recording's wheels and gyro, at times of its poses.

    Parameters
    ----------
    constants : constants of the recording
    steps : track with joined wheel samples; default: single samples, in Euler steps as in `icrtool.kernels.open_loop`

    Notes
    -----
    The path stands still in a gap of the wheel data. The offset of the reference's heading is subtracted from the
    path's heading.
    """
    driven = steps if steps is not None else recording.track

    def twists(rows: slice) -> tuple[Floats, Ints, Floats]:
        """Return the twist of some steps, which has no free terms."""
        wheels = recording.wheels(rows) if steps is None else steps.wheels(rows)
        gyro = wheels.gyro
        if gyro is not None and constants.gyro_later_s:
            gyro = gyro + constants.gyro_later_s * driven.gyro_change(rows)
        motion = wheel_motion(wheels.v_left, wheels.v_right, recording.width_m, gyro)
        moving = fitted_model.twist(motion)
        moving[OMEGA] += constants.gyro_bias_radps
        return moving, np.empty(0, np.int64), np.empty((0, len(motion.v)))

    def at_times(at: Floats) -> tuple[Floats, Complexes]:
        """Return heading and place of the path at times of poses."""
        path = path_at(driven, twists, np.empty(0), at + constants.wheels_later_s)
        return path.heading - constants.heading_offset_rad, path.place

    return at_times


TURN_S = 1.0
"""Time over which the turns of a gyro and of the reference are compared [s]."""

FEWEST_TURNS = 10
"""Smallest number of turns for a comparison of a gyro."""

GYRO_PRIOR_STD = np.array([10.0, 0.005, 0.2])
"""Prior standard deviations of a gyro's scale, bias [rad/s] and lead [s]. The prior of the scale is wide, because its
sign is not known. On a circle, only the prior separates scale and bias."""

GYRO_SCALE_RANGE = 0.1
"""Largest difference between the scale of a gyro and 1 or -1. Beyond it, the gyro does not measure the robot's yaw."""


class GyroLine(NamedTuple):
    """Scale, bias [rad/s] and lead [s] of a gyro; if too few turns show them, NaN and no lead."""

    scale: float
    bias_radps: float
    lead_s: float

    @property
    def is_yaw(self) -> bool:
        """Whether the gyro measures the robot's yaw, in either sense."""
        return abs(abs(self.scale) - 1.0) < GYRO_SCALE_RANGE


def fit_gyro_line(t: Floats, rate: Floats, gyro_turn: Floats, heading_t: Floats, heading: Floats) -> GyroLine:
    """Return scale, bias and lead that map the turns of a gyro over `TURN_S` to the turns of the reference.

    Parameters
    ----------
    t : (n,) times [s]; rate : (n,) of the gyro [rad/s]; gyro_turn : (n,) its integral [rad]
    heading_t : (m,) times of the headings [s], ascending; heading : (m,) of the reference, unwrapped [rad]
    """
    every = rows_at_steps(heading_t - heading_t[0], TURN_S)
    if len(every) < FEWEST_TURNS:
        return GyroLine(float("nan"), float("nan"), 0.0)
    reference_turns, durations_s = np.diff(heading[every]), np.diff(heading_t[every])

    def evaluate(x: Floats) -> tuple[Floats, Floats]:
        read = heading_t[every] + x[2]
        by_scale, by_lead = (np.diff(np.interp(read, t, column)) for column in (gyro_turn, rate))
        residuals = x[0] * by_scale + x[1] * durations_s - reference_turns
        return residuals, np.column_stack([by_scale, durations_s, x[0] * by_lead])

    zero = np.zeros(3)
    return GyroLine(*robust_least_squares(evaluate, zero, zero, GYRO_PRIOR_STD, overlap=10.0).x.tolist())


GYRO_START_STD = (0.02, 0.005)
"""Standard deviations of a gyro's scale and bias [rad/s] before a drive, the same as in `TERMS` and
`GYRO_PRIOR_STD`."""

SMALLEST_SCALE_STD = 1e-6
"""Standard deviation of a known scale. A turn of 1000 rad does not show it."""

TURN_NOISE_RAD = 0.01
"""Assumed standard deviation of the differences of turns over `TURN_S` before a drive [rad]."""

GUESSED_TURNS = 5
"""Number of measured differences that the assumed standard deviation counts as."""

MISSED_TURN_SHARE = 0.05
"""Standard deviation of a difference of turns by lags and slip, which differ from turn to turn, as a share of the turn.

Without this part, the standard deviation of a robot that stands at first is too small, and one turn changes the scale
by 6 % (a recorded Warthog on asphalt)."""

MEAN_TO_STD = 1.2533
"""Ratio of the standard deviation of normal values to their mean size."""

MOST_SIGMAS = 3.0
"""Size of a difference of turns, in standard deviations, to which larger differences are limited."""

RENEWED_S = 10.0
"""Time between two lines of a gyro [s], because scale and bias change slowly. In the first seconds of a drive there are
more lines."""


class PastLines(NamedTuple):
    """Lines (scale and bias) of a gyro. Each holds from a state on, and comes from turns that ended before this state.

    Attributes
    ----------
    row : (k,) state from which each line holds; the first is 0
    scale, bias_radps : (k,) scale and bias
    """

    row: Ints
    scale: Floats
    bias_radps: Floats


def past_gyro_lines(track: Track) -> PastLines:
    """Return the lines of a track's gyro that are known from the past of each state."""
    gyro_turn = np.zeros(len(track.t)) if track.gyro is None else track.cumulate(track.gyro)
    return past_lines(track, lambda rows: gyro_turn[rows], GYRO_START_STD)


def past_lines(track: Track, turned_at: Callable[[Ints], Floats], before_std: tuple[float, float]) -> PastLines:
    """Return the lines that map measured turns to the turns of the reference, as known from the past of each state.

    Parameters
    ----------
    track : track with the reference
    turned_at : returns the measured angle at some states [rad], from any origin
    before_std : standard deviations of scale and bias [rad/s] before the drive, about 1 and 0; for 0 the scale is 1

    Notes
    -----
    Recursive least squares over turns of `TURN_S` (Kalman 1960, constant state): each turn adds to the normal
    equations, with the soft-L1 weight of its residual from the line before.
    """
    t, lasted = track.t - track.t[0], track.cumulate(np.ones(len(track.t)))
    every = rows_at_steps(t, TURN_S)
    begins = [0.0]
    while begins[-1] < t[-1]:
        begins.append(begins[-1] + min(max(begins[-1], TURN_S), RENEWED_S))
    rows = np.searchsorted(t, begins[: max(len(begins) - 1, 1)])
    steps = [np.diff(column).tolist() for column in (turned_at(every), lasted[every], track.heading[every])]
    # These are the information matrix of scale - 1 and bias, and the product of information and mean.
    a, b, c = max(before_std[0], SMALLEST_SCALE_STD) ** -2.0, 0.0, before_std[1] ** -2.0
    p = q = scale = bias = 0.0
    count, sizes, done = GUESSED_TURNS, GUESSED_TURNS * TURN_NOISE_RAD / MEAN_TO_STD, 0
    lines = []
    for row in rows.tolist():
        until = int(np.searchsorted(every[1:], row, side="right"))
        for turn, time, truth in zip(*(column[done:until] for column in steps), strict=True):
            spread = MEAN_TO_STD * sizes / count
            residual = truth - turn - scale * turn - bias * time
            std = math.hypot(spread, MISSED_TURN_SHARE * turn)
            weight = 1.0 / (std**2 * math.sqrt(1.0 + (residual / (LOSS_SIGMAS * std)) ** 2))
            a, b, c = a + weight * turn * turn, b + weight * turn * time, c + weight * time * time
            p, q = p + weight * turn * (truth - turn), q + weight * time * (truth - turn)
            determinant = a * c - b * b
            scale, bias = (c * p - b * q) / determinant, (a * q - b * p) / determinant
            count, sizes = count + 1, sizes + min(abs(residual) / std, MOST_SIGMAS) * spread
        done = until
        lines.append((1.0 + scale, bias))
    columns = np.array(lines)
    return PastLines(rows, columns[:, 0], columns[:, 1])
