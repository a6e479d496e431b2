"""Open-loop errors of a motion model from every start, by prefix sums: the trials of the dropout analysis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Complexes, Floats, Ints
from icrtool.kernels.track import Track, ends_from
from icrtool.kernels.window_residuals import OMEGA, path_at
from icrtool.motion.models import FittedModel, wheel_motion
from icrtool.motion.recording import (
    NO_CONSTANTS,
    LogConstants,
    Recording,
    Totals,
    moving_states,
    samples_a_step,
)

MOST_STARTS = 4_000


class Trials(NamedTuple):
    """Trials of one recording.

    Attributes
    ----------
    starts : (k,) states they start from
    ends : (k, h) states they end at, negative where there is no trial
    """

    starts: Ints
    ends: Ints


def cut_trials(recording: Recording, horizons_m: Sequence[float], pooled: Totals | None = None) -> Trials:
    """Return the trials of a recording from states in which it moves.

    They are as far apart as the steps of the fits are long, about `MOST_STARTS` of a long drive: nearer ones are copies
    of one another.

    Parameters
    ----------
    pooled : of all that is fitted together, default the recording
    """
    moving = np.flatnonzero(moving_states(recording.track))
    step = samples_a_step(recording.track, None if pooled is None else pooled.seconds)
    starts = moving[:: max(step, len(moving) // MOST_STARTS)].copy()
    return Trials(starts, ends_from(recording.track, np.array(horizons_m, np.float64), starts))


class TrialErrors(NamedTuple):
    """Errors of a model at the ends of trials (k, h), NaN where there is no trial.

    Attributes
    ----------
    position : distance between open-loop position and reference [m]
    heading : size of the difference between open-loop turn and that of the reference [rad]
    """

    position: Floats
    heading: Floats

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> TrialErrors:
        """Return errors of trials that have none yet, a horizon contiguous."""
        return cls(*(np.full(shape[::-1], np.nan).T for _ in cls._fields))


ErrorsOf = Callable[[Trials], TrialErrors]
"""Gives the errors (k, h) of a model in trials."""

PathAt = Callable[[Floats], tuple[Floats, Complexes]]
"""Gives heading (m,) [rad] and place (m,) [m], forward + j right of the first step, of a path at times (m,) [s]: each
call drives all of it."""


def trial_errors(recording: Recording, start: Ints, end: Ints, path: PathAt) -> TrialErrors:
    """Return the errors (m,) at the ends of trials.

    Parameters
    ----------
    start, end : (m,) states

    Notes
    -----
    The parameters are constants, so the path from any start is the same path, turned and shifted: one pass serves all.
    """
    track, first = recording.track, int(start.min())
    s, e = start - first, end - first
    used = np.zeros(int(e.max()) + 1, np.bool_)
    used[s] = used[e] = True
    rows, number = first + np.flatnonzero(used), np.cumsum(used) - 1
    turned, place = path(recording.track.t[rows])
    s, e, off = number[s], number[e], turned - track.heading[rows]
    turn, reference = np.exp(-1j * off), track.north[rows] + 1j * track.east[rows]
    missed = turn[s] * (place[e] - place[s]) - (reference[e] - reference[s])
    return TrialErrors(np.abs(missed), np.abs(off[e] - off[s]))


def predicted_path(
    recording: Recording, fitted: FittedModel, own: LogConstants = NO_CONSTANTS, steps: Track | None = None
) -> PathAt:
    """Return the path that a model makes of a recording's wheels and gyro, at times of its poses.

    Parameters
    ----------
    own : constants of the recording
    steps : the wheel samples joined; default single samples, Euler steps as in `icrtool.kernels.open_loop.direct`

    Notes
    -----
    Nothing moves through a gap in the wheel data. The offset of the reference's heading is taken from that of the path.
    """
    of = steps if steps is not None else recording.track

    def twists(some: slice) -> tuple[Floats, Ints, Floats]:
        gyro = None if of.gyro is None else of.gyro[some]
        if gyro is not None and own.gyro_later_s:
            gyro = gyro + own.gyro_later_s * of.gyro_change(some)
        motion = wheel_motion(of.v_left[some], of.v_right[some], recording.width_m, gyro)
        moving = fitted.twist(motion)
        moving[OMEGA] += own.gyro_bias_radps
        return moving, np.empty(0, np.int64), np.empty((0, len(motion.v)))

    def at_times(at: Floats) -> tuple[Floats, Complexes]:
        path = path_at(of, twists, np.empty(0), at + own.wheels_later_s)
        return path.heading - own.heading_offset_rad, path.place

    return at_times
