"""Open-loop errors of a motion model from every start, by prefix sums: the trials of the dropout analysis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icrtool.kernels.open_loop import trial_ends
from icrtool.motion.fit import Turning
from icrtool.motion.models import MotionModel, twist, wheel_motion
from icrtool.motion.recording import MOVING_MPS, Recording, samples_a_step
from icrtool.records.tables import Complexes, Floats, Ints


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


def trial_errors(recording: Recording, trials: Trials, rates: Floats, wheels_delay_s: float = 0.0) -> Floats:
    """Return the distance (k, h) [m] between open-loop position and reference at each trial's end, NaN for no trial.

    Parameters
    ----------
    rates : (3, n) body twist of each wheel sample, of `twist_rates`
    wheels_delay_s : delay of the wheels relative to the poses, a constant of the recording

    Notes
    -----
    The parameters are constants, so the path from any start is the same path, turned and shifted: one pass serves all.
    """
    drive = recording.drive
    errors: Floats = np.full(trials.ends.shape, np.nan)
    place, heading = wheels_path(recording, rates, wheels_delay_s)
    reference = drive.north + 1j * drive.east
    turn = np.exp(1j * (drive.heading - heading))
    for h in range(trials.ends.shape[-1]):
        some = trials.ends[:, h] >= 0
        s, e = trials.starts[some], trials.ends[some, h]
        errors[some, h] = np.abs(turn[s] * (place[e] - place[s]) - (reference[e] - reference[s]))
    return errors


def wheels_path(recording: Recording, rates: Floats, wheels_delay_s: float = 0.0) -> tuple[Complexes, Floats]:
    """Return the path that a twist makes from the origin, at every state.

    Parameters
    ----------
    rates, wheels_delay_s : as in `trial_errors`

    Returns
    -------
    complex (n,), forward + j right of the first heading [m]; float64 (n,), clockwise turn since the first state [rad].

    Notes
    -----
    Euler steps as in `icrtool.kernels.open_loop`; nothing moves through a gap in the wheel data.
    """
    held, t = recording.held_s, recording.t_s
    v_x, v_y, omega = rates
    heading = np.concatenate([[0.0], np.cumsum(held * omega)])[:-1]
    place = np.concatenate([[0.0], np.cumsum(held * (v_x + 1j * v_y) * np.exp(1j * heading))])[:-1]
    if wheels_delay_s:
        later = t + wheels_delay_s
        heading, place = np.interp(later, t, heading), np.interp(later, t, place)
    return place, heading


def twist_rates(
    recording: Recording,
    model: MotionModel,
    parameters: Floats,
    wheels: Turning | None = None,
    gyro_bias: float = 0.0,
) -> Floats:
    """Return the body twist v_x, v_y, omega (3, n) of each wheel sample.

    Parameters
    ----------
    wheels : for a model with a gyro, the wheels-only model and its parameters, whose turn rate it uses
    gyro_bias : added to the turn rate [rad/s]
    """
    motion = wheel_motion(recording.drive.v_left, recording.drive.v_right, recording.width_m)
    if wheels is not None and recording.gyro_radps is not None:
        motion = motion._replace(gyro=recording.gyro_radps, turn=twist(wheels[0], wheels[1], motion)[2])
    rates = twist(model, parameters, motion)
    rates[2] += gyro_bias
    return rates
