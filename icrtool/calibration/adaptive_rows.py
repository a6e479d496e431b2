"""Row ``adaptive`` of a report: what `icrtool.AdaptiveModel` predicts at each start, from the past alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from icrtool.calibration.held_out import path_between
from icrtool.calibration.record import Calibration
from icrtool.kernels.arrays import ROWS_AT_ONCE, Floats, Ints
from icrtool.kernels.track import OpenLoopPath, Track
from icrtool.motion.adaptive import AdaptiveModel, Learned, TermsPrior
from icrtool.motion.drive_buffer import SampleRow
from icrtool.motion.recording import Recording, TrialErrors, Trials, predicted_path, steps_of, trial_errors
from icrtool.motion.robot_prior import prior_of_robots
from icrtool.motion.window_fit import Prediction


def prior_for(recording: Recording, calibrations: Sequence[Calibration] = ()) -> TermsPrior:
    """Return what is known before a recording: of calibrations the first one not fitted to it, else of robots."""
    found = (one.prior() for one in calibrations if not one.fitted_to(recording.sha256))
    return next(found, None) or prior_of_robots(recording.width_m)


def samples_of(recording: Recording, rows: slice = slice(None)) -> Floats:
    """Return the wheel samples and poses of a recording (10, n), as `AdaptiveModel` takes them."""
    wheels, track = recording.wheels(rows), recording.track
    samples = np.zeros((len(SampleRow), len(wheels.t)))
    samples[:3] = wheels.t, wheels.v_left, wheels.v_right
    samples[3:6] = track.north[rows], track.east[rows], track.heading[rows]
    if wheels.gyro is not None:
        samples[6] = wheels.gyro
    samples[7:] = ~track.in_outage[rows], track.jump[rows] | track.slipping[rows], wheels.held == 0.0
    return samples


@dataclass(frozen=True)
class AdaptedDrive:
    """A recording as `AdaptiveModel` drove it.

    Attributes
    ----------
    prior : what was known before
    learned : what was known, in order of time; the first one before the drive
    steps : the wheel samples joined
    """

    recording: Recording
    prior: TermsPrior
    learned: tuple[Learned, ...]
    steps: Track

    def errors(self, trials: Trials, *, turned: bool = False) -> TrialErrors:
        """Return the errors of trials, each with what was known at its start; `turned`: with the gyro."""
        track, errors = self.recording.track, TrialErrors.none(trials.ends.shape)
        for number, some in self._by_learned(trials.starts):
            column, row = np.nonzero(trials.ends[some].T >= 0)
            if not len(row):
                continue
            row += some.start
            start, end = trials.starts[row], trials.ends[row, column]
            near = self.steps.around(track.t[start.min()], track.t[end.max()])
            path = predicted_path(self.recording, *self._known(number, turned=turned), near)
            for all_errors, missed in zip(errors, trial_errors(self.recording, start, end, path), strict=True):
                all_errors[row, column] = missed
        return errors

    def path(self, start: int, end: int, *, turned: bool = False) -> OpenLoopPath:
        """Return the path from one state to another, with what was known at the first one."""
        ((number, _),) = self._by_learned(np.array([start]))
        return path_between(self.recording, self._known(number, turned=turned), self.steps, start, end)

    def _by_learned(self, starts: Ints) -> Iterator[tuple[int, slice]]:
        """Yield the number of what was known, and the starts (ascending) from which on it was."""
        known_s = np.array([one.t_s for one in self.learned])
        number = np.searchsorted(known_s, self.recording.track.t[starts], side="right") - 1
        first = np.flatnonzero(np.diff(number, prepend=-1))
        for lo, hi in zip(first.tolist(), [*first[1:].tolist(), len(starts)], strict=True):
            yield int(number[lo]), slice(lo, hi)

    def _known(self, number: int, *, turned: bool) -> Prediction:
        one = self.learned[number]
        return (one.turned, one.turned_constants) if turned and one.turned is not None else (one.fitted, one.constants)


def adapt(recording: Recording, prior: TermsPrior) -> AdaptedDrive:
    """Let `AdaptiveModel` drive a recording, with its gyro where it has one."""
    model = AdaptiveModel(prior, with_gyro=recording.track.gyro is not None)
    learned = [model.now._replace(t_s=-np.inf)]
    for lo in range(0, len(recording.track.t), ROWS_AT_ONCE):
        learned += model.observe_all(samples_of(recording, slice(lo, lo + ROWS_AT_ONCE)))
    # the shortest steps, however long the log is: its end must not change what is predicted before
    return AdaptedDrive(recording, prior, tuple(learned), steps_of(recording, 0.0))
