"""Open-loop errors of a motion model from every start, by prefix sums: the trials of the dropout analysis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icrtool.kernels.open_loop import trial_ends
from icrtool.motion.models import MotionModel, twist, wheel_motion
from icrtool.motion.recording import MOVING_MPS, Recording, samples_a_step
from icrtool.records.tables import Floats, Ints


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
        every = samples_a_step(recording.held_s, drive.v_left, drive.v_right)
        starts = np.flatnonzero(moving)[::every]
    return Trials(starts, trial_ends(drive, np.array(horizons_m, np.float64))[starts])


def trial_errors(
    recording: Recording, trials: Trials, model: MotionModel, parameters: Floats, gyro_bias: float = 0.0
) -> Floats:
    """Return the distance (k, h) [m] between open-loop position and reference at each trial's end, NaN for no trial.

    Parameters
    ----------
    parameters : (k,) of the model's terms
    gyro_bias : added to the turn rate of a model with a gyro [rad/s]

    Notes
    -----
    Euler steps as in `icrtool.kernels.open_loop`. The parameters are constants, so the path from any start is the same
    path, turned and shifted: one pass serves all.
    """
    errors = np.full(trials.ends.shape, np.nan)
    if not len(trials.starts):
        return errors
    first, stop = int(trials.starts[0]), max(int(trials.ends.max()), int(trials.starts[-1])) + 1
    drive, rows = recording.drive, slice(first, stop)
    gyro = recording.gyro_radps[rows] if model.uses_gyro and recording.gyro_radps is not None else None
    motion = wheel_motion(drive.v_left[rows], drive.v_right[rows], recording.width_m, gyro)
    v_x, v_y, omega = twist(model, parameters, motion)
    if model.uses_gyro:
        omega = omega + gyro_bias
    held = recording.held_s[rows]
    heading = np.concatenate([[0.0], np.cumsum(held * omega)])[:-1]
    place = np.concatenate([[0.0], np.cumsum(held * (v_x + 1j * v_y) * np.exp(1j * heading))])[:-1]
    reference = drive.north[rows] + 1j * drive.east[rows]
    turn = np.exp(1j * (drive.heading[rows] - heading))
    for h in range(errors.shape[1]):
        some = trials.ends[:, h] >= 0
        s, e = trials.starts[some] - first, trials.ends[some, h] - first
        errors[some, h] = np.abs(turn[s] * (place[e] - place[s]) - (reference[e] - reference[s]))
    return errors
