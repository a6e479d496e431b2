"""Row ``adaptive`` of a report: the predictions of `icrtool.AdaptiveModel` at each start, from the past alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from icrtool.calibration.held_out import path_between
from icrtool.calibration.record import Calibration
from icrtool.kernels.arrays import ROWS_AT_ONCE, Floats, Ints, Rows
from icrtool.kernels.track import OpenLoopPath, Track
from icrtool.motion.adaptive import AdaptiveModel, Learned, TermsPrior
from icrtool.motion.drive_buffer import SampleRow
from icrtool.motion.recording import Recording, TrialErrors, Trials, predicted_path, steps_of, trial_errors
from icrtool.motion.robot_prior import prior_of_robots
from icrtool.motion.window_fit import Prediction


def prior_for(
    recording: Recording, calibrations: Sequence[Calibration] = (), *, refit_sensors: bool = False
) -> TermsPrior:
    """Return the prior for a recording: from the first calibration that was not fitted to it, else from other robots.

    Parameters
    ----------
    refit_sensors : do not use the constants of the calibration's sensors

    Notes
    -----
    The heading offset and the bias of the gyro come from the calibration. The delays begin at the corrections of this
    log, as for row ``icr``, because the delays of five drives of one robot, recorded by one computer, differ by 0.08 s.
    """
    unfitted = (calibration for calibration in calibrations if not calibration.fitted_to(recording.sha256))
    calibration = next(unfitted, None)
    if calibration is None:
        return prior_of_robots(recording.width_m)
    constants = recording.corrected._replace(wheels_later_s=np.nan, gyro_later_s=np.nan)
    return calibration.prior(corrected=None if refit_sensors else constants, heading_source=recording.heading_source)


def samples_of(recording: Recording, rows: slice = slice(None)) -> Floats:
    """Return the wheel samples and poses of a recording (10, n), in rows `SampleRow`."""
    wheels, track = recording.wheels(rows), recording.track
    samples = np.zeros((len(SampleRow), len(wheels.t)))
    samples[:3] = wheels.t, wheels.v_left, wheels.v_right
    samples[3:6] = track.north[rows], track.east[rows], track.heading[rows]
    if wheels.gyro is not None:
        samples[6] = wheels.gyro
    samples[7:] = ~track.in_outage[rows], track.jump[rows] | track.slipping[rows], wheels.held == 0.0
    return samples


@dataclass(frozen=True)
class KnownDrive:
    """A recording, and the model and constants that were known at each time of it.

    Attributes
    ----------
    recording : the recording
    learned : the known models and constants, in order of time; the first entry holds from before the drive on
    steps : track with joined wheel samples; None: single samples
    """

    recording: Recording
    learned: tuple[Learned, ...]
    steps: Track | None = None

    def errors(self, trials: Trials, *, turned: bool = False) -> TrialErrors:
        """Return the errors (k, h) of trials, each with the model known at its start; `turned`: with the gyro."""
        errors = TrialErrors.none(trials.ends.shape)
        for number, chunk in self._by_learned(trials.starts):
            column, row = np.nonzero(trials.ends[chunk].T >= 0)
            if not len(row):
                continue
            row += chunk.start
            start, end = trials.starts[row], trials.ends[row, column]
            span_steps = self._steps_around(start, end)
            path = predicted_path(self.recording, *self._known(number, turned=turned), span_steps)
            for all_errors, horizon_errors in zip(errors, trial_errors(self.recording, start, end, path), strict=True):
                all_errors[row, column] = horizon_errors
        return errors

    def path(self, start: int, end: int, *, turned: bool = False) -> OpenLoopPath:
        """Return the path from one state to another, with the model that was known at the first state."""
        starts = np.array([start], np.int64)
        ((number, _),) = self._by_learned(starts)
        steps = self._steps_around(starts, np.array([end], np.int64))
        return path_between(self.recording, self._known(number, turned=turned), steps, start, end)

    def _steps_around(self, start: Ints, end: Ints | Rows) -> Track:
        """Return the track with the wheel samples of trials from states `start` to states `end`."""
        track = self.recording.track
        span = float(track.t[start.min()]), float(track.t[end.max()])
        return self.recording.wheels(track.rows_around(*span)) if self.steps is None else self.steps.around(*span)

    def _by_learned(self, starts: Ints) -> Iterator[tuple[int, slice]]:
        """Yield the number of each used item of `learned`, and the rows of ascending starts at which it was known."""
        known_s = np.array([learned.t_s for learned in self.learned])
        number = np.searchsorted(known_s, self.recording.track.t[starts], side="right") - 1
        first = np.flatnonzero(np.diff(number, prepend=-1))
        for lo, hi in zip(first.tolist(), [*first[1:].tolist(), len(starts)], strict=True):
            yield int(number[lo]), slice(lo, hi)

    def _known(self, number: int, *, turned: bool) -> Prediction:
        """Return model and constants of an item of `learned`; `turned`: with the gyro if there is one."""
        learned = self.learned[number]
        return (
            (learned.turned, learned.turned_constants)
            if turned and learned.turned is not None
            else (learned.fitted, learned.constants)
        )


def adapt(recording: Recording, prior: TermsPrior, past: Recording | None = None) -> KnownDrive:
    """Return a recording with the models and constants that `AdaptiveModel` learns along it, by its gyro if it has one.

    Parameters
    ----------
    prior : prior of the robot
    past : the recording with the poses that were known when it was driven; default: its own poses
    """
    past = recording if past is None else past
    model = AdaptiveModel(prior, with_gyro=recording.track.gyro is not None)
    learned = [model.now._replace(t_s=-np.inf)]
    for lo in range(0, len(recording.track.t), ROWS_AT_ONCE):
        learned += model.observe_all(samples_of(past, slice(lo, lo + ROWS_AT_ONCE)))
    # The steps do not depend on the length of the log, because its end must not change earlier predictions.
    return KnownDrive(recording, tuple(learned), steps_of(recording, 0.0))
