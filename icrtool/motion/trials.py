"""Open-loop errors of a motion model from every start, by prefix sums: the trials of the dropout analysis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from icrtool.kernels.open_loop import trial_ends
from icrtool.motion.models import FittedModel, wheel_motion
from icrtool.motion.recording import MOVING_MPS, Recording, Steps, joined_steps, samples_a_step
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
        every = samples_a_step(recording)
        starts = np.flatnonzero(moving)[::every]
    return Trials(starts, trial_ends(drive, np.array(horizons_m, np.float64))[starts])


def trial_errors(
    recording: Recording, trials: Trials, rates: Floats, wheels_delay_s: float = 0.0, steps: Steps | None = None
) -> Floats:
    """Return the distance (k, h) [m] between open-loop position and reference at each trial's end, NaN for no trial.

    Parameters
    ----------
    rates : (3, n) body twist of each step, of `twist_rates`
    wheels_delay_s : delay of the wheels relative to the poses, a constant of the recording
    steps : the wheel samples joined, of which `rates` are; default single samples

    Notes
    -----
    The parameters are constants, so the path from any start is the same path, turned and shifted: one pass serves all.
    """
    drive = recording.drive
    reference = drive.north + 1j * drive.east
    errors: Floats = np.full(trials.ends.shape, np.nan)
    if steps is None:
        places, headings = wheels_path(recording, rates, wheels_delay_s)
        path: PathAt = lambda rows: (headings[rows], places[rows])  # noqa: E731 - one of two
    else:
        drawn, read_s = drawn_path(steps, rates), recording.t_s + wheels_delay_s
        path = lambda rows: drawn(read_s[rows])  # noqa: E731 - the other
    heading, begin = path(trials.starts)
    turn = np.exp(1j * (drive.heading[trials.starts] - heading))
    for h in range(trials.ends.shape[-1]):
        some = trials.ends[:, h] >= 0
        e = trials.ends[some, h]
        moved = turn[some] * (path(e)[1] - begin[some])
        errors[some, h] = np.abs(moved - (reference[e] - reference[trials.starts[some]]))
    return errors


PathAt = Callable[[Any], tuple[Floats, Complexes]]
"""Gives heading and place of a path at rows or times."""


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
    heading, place = drawn_path(joined_steps(recording, 1), rates)(recording.t_s + wheels_delay_s)
    return place, heading


def drawn_path(steps: Steps, rates: Floats) -> PathAt:
    """Return what gives heading (m,) [rad] and place (m,) [m], forward + j right, at times (m,) [s], from zero.

    Parameters
    ----------
    rates : (3, n) body twist of each step
    """
    v_x, v_y, omega = rates
    turned = steps.held * omega
    heading = np.concatenate([[0.0], np.cumsum(turned)])
    angle = heading[:-1] + steps.into * omega
    moved = np.empty(len(turned), np.complex128)
    cos, sin = np.cos(angle), np.sin(angle)
    moved.real, moved.imag = steps.held * (v_x * cos - v_y * sin), steps.held * (v_x * sin + v_y * cos)
    place = np.concatenate([[0.0], np.cumsum(moved)])

    def at_times(at: Floats) -> tuple[Floats, Complexes]:
        row, share = steps.locate(at)
        return heading[row] + share * turned[row], place[row] + share * moved[row]

    return at_times


def twist_rates(
    recording: Recording, fitted: FittedModel, gyro_bias: float = 0.0, steps: Steps | None = None
) -> Floats:
    """Return the body twist v_x, v_y, omega (3, n) of each wheel sample, or step of joined ones.

    Parameters
    ----------
    gyro_bias : added to the turn rate [rad/s]
    steps : the wheel samples joined; default single samples
    """
    of = steps if steps is not None else joined_steps(recording, 1)
    rates = fitted.twist(wheel_motion(of.v_left, of.v_right, recording.width_m, of.gyro))
    rates[2] += gyro_bias
    return rates
