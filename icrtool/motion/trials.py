"""Open-loop errors of a motion model from every start, by prefix sums: the trials of the dropout analysis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Complexes, Floats, Ints
from icrtool.kernels.open_loop import ends_from
from icrtool.motion.models import FittedModel, wheel_motion
from icrtool.motion.recording import (
    MOVING_MPS,
    NO_CONSTANTS,
    LogConstants,
    Recording,
    Steps,
    joined_steps,
    samples_a_step,
)


class Trials(NamedTuple):
    """Trials of one recording.

    Attributes
    ----------
    starts : (k,) states they start from
    ends : (k, h) states they end at, negative where there is no trial
    """

    starts: Ints
    ends: Ints

    def within(self, distance: Floats, begin_m: float, end_m: float) -> Trials:
        """Return the trials that lie between two path lengths; `distance` (n,) is the recording's."""
        inside = (distance[self.starts] >= begin_m) & (distance[self.starts] < end_m)
        ends = self.ends[inside]
        return Trials(self.starts[inside], np.where((ends >= 0) & (distance[ends] <= end_m), ends, -1))


def cut_trials(recording: Recording, horizons_m: Sequence[float], *, all_starts: bool = False) -> Trials:
    """Return the trials of a recording.

    Parameters
    ----------
    all_starts : from every recorded state, as the paper; default from moving ones, as far apart as the steps of the
        fits are long, since nearer ones are copies of one another
    """
    drive = recording.drive
    starts = np.arange(len(drive.distance))
    if not all_starts:
        moving = np.append(np.diff(drive.distance) > MOVING_MPS * drive.dt_s[:-1], False)
        every = samples_a_step(recording)
        starts = np.flatnonzero(moving)[::every]
    return Trials(starts, ends_from(drive, np.array(horizons_m, np.float64), starts))


PathAt = Callable[[Floats], tuple[Floats, Complexes]]
"""Gives heading (m,) [rad] and place (m,) [m], forward + j right of the first step, of a path at times (m,) [s]."""


def trial_errors(recording: Recording, trials: Trials, path: PathAt) -> Floats:
    """Return the distance (k, h) [m] between open-loop position and reference at each trial's end, NaN for no trial.

    Notes
    -----
    The parameters are constants, so the path from any start is the same path, turned and shifted: one pass serves all.
    """
    drive, t = recording.drive, recording.t_s
    reference = drive.north + 1j * drive.east
    if trials.ends.size > len(t):
        headings, places = path(t)
        at: Callable[[Ints], tuple[Floats, Complexes]] = lambda rows: (headings[rows], places[rows])  # noqa: E731 - one of two
    else:
        at = lambda rows: path(t[rows])  # noqa: E731 - the other
    heading, begin = at(trials.starts)
    turn = np.exp(1j * (drive.heading[trials.starts] - heading))
    errors: Floats = np.full(trials.ends.shape, np.nan)
    for h in range(trials.ends.shape[-1]):
        some = trials.ends[:, h] >= 0
        e = trials.ends[some, h]
        moved = turn[some] * (at(e)[1] - begin[some])
        errors[some, h] = np.abs(moved - (reference[e] - reference[trials.starts[some]]))
    return errors


def model_errors(recording: Recording, trials: Trials, fitted: FittedModel, own: LogConstants = NO_CONSTANTS) -> Floats:
    """Return `trial_errors` of `predicted_path`, predicted over no more of the recording than the trials touch."""
    errors: Floats = np.full(trials.ends.shape, np.nan)
    tried = np.flatnonzero((trials.ends >= 0).any(axis=1))
    if not len(tried):
        return errors
    t, starts, ends = recording.t_s, trials.starts[tried], trials.ends[tried]
    reach = abs(own.wheels_later_s) * np.array([-1.0, 1.0])
    first, stop = np.searchsorted(t, t[[starts.min(), ends.max()]] + reach)
    # the gyro's change at a sample is that between its neighbours
    first = max(int(first) - 2, 0)
    part = recording.part(first, int(stop) + 2)
    moved = Trials(starts - first, np.where(ends >= 0, ends - first, -1))
    errors[tried] = trial_errors(part, moved, predicted_path(part, fitted, own))
    return errors


def predicted_path(
    recording: Recording, fitted: FittedModel, own: LogConstants = NO_CONSTANTS, steps: Steps | None = None
) -> PathAt:
    """Return the path that a model makes of a recording's wheels and gyro, at times of its poses.

    Parameters
    ----------
    own : constants of the recording
    steps : the wheel samples joined; default single samples, Euler steps as in `icrtool.kernels.open_loop`

    Notes
    -----
    Nothing moves through a gap in the wheel data. The offset of the reference's heading is taken from that of the path.
    """
    of = steps if steps is not None else joined_steps(recording, 1)
    gyro = of.gyro + own.gyro_later_s * of.gyro_change()
    v_x, v_y, omega = fitted.twist(wheel_motion(of.v_left, of.v_right, recording.width_m, gyro))
    turned = of.held * (omega + own.gyro_bias_radps)
    heading = np.concatenate([[0.0], np.cumsum(turned)])
    angle = heading[:-1] + of.into * (omega + own.gyro_bias_radps)
    moved = np.empty(len(turned), np.complex128)
    cos, sin = np.cos(angle), np.sin(angle)
    moved.real, moved.imag = of.held * (v_x * cos - v_y * sin), of.held * (v_x * sin + v_y * cos)
    place = np.concatenate([[0.0], np.cumsum(moved)])

    def at_times(at: Floats) -> tuple[Floats, Complexes]:
        row, share = of.locate(at + own.wheels_later_s)
        return heading[row] + share * turned[row] - own.heading_offset_rad, place[row] + share * moved[row]

    return at_times
