"""Calibrate from one run or many: every motion model fitted to all, tested on what it was not fitted to."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from icrtool import __version__
from icrtool.calibration.controller_numbers import controller_errors
from icrtool.calibration.error_growth import cut_error_windows, measure_error_sources
from icrtool.calibration.held_out import GYRO, HeldOut, errors_without, hold_out
from icrtool.calibration.record import Calibration
from icrtool.errors import ConfigError
from icrtool.motion.fit import Fold, Prediction, own_constants
from icrtool.motion.models import MODELS, RECOMMENDED
from icrtool.motion.recording import ErrorsOf, Recording, cut_windows
from icrtool.records.calibration_document import CalibratedRobot, CalibrationLog, HeldOutScore, PooledScore


class LeftOut(NamedTuple):
    """A log that a calibration leaves out, and why."""

    name: str
    why: str

    def __str__(self) -> str:
        return f"{self.name}: left out: {self.why}"


class CalibrationResult(NamedTuple):
    """A calibration with the table that it was tested by."""

    calibration: Calibration
    table: HeldOut
    notes: tuple[str, ...]
    left_out: tuple[LeftOut, ...] = ()


def calibrate_recordings(recordings: Sequence[Recording], robot: CalibratedRobot | None = None) -> CalibrationResult:
    """Fit the motion models to all recordings, and test each on what it was not fitted to.

    Parameters
    ----------
    recordings : one or many, of one robot
    robot : as its calibration holds it; default: of no name

    Raises
    ------
    ConfigError
        Recordings of robots of different width, or one recording twice.
    DataError
        Too short a drive.
    """
    widths = {one.width_m for one in recordings}
    if len(widths) > 1:
        found = ", ".join(f"{width:g} m" for width in sorted(widths))
        raise ConfigError("robot.track_width_m", f"{found} in the logs given", "calibrate one robot at a time")
    known = [one for one in recordings if one.sha256]
    if twice := {one.name for one in known if sum(one.sha256 == other.sha256 for other in known) > 1}:
        raise ConfigError(min(twice), "given twice", "name each log once: it would be tested on itself")
    table = hold_out(recordings)
    return CalibrationResult(calibration_from(table, robot), table, _notes(recordings))


def calibration_from(table: HeldOut, robot: CalibratedRobot | None = None) -> Calibration:
    """Return the calibration of the recordings that a held-out table is of."""
    recordings, best = table.recordings, table.fits[RECOMMENDED]
    constants = [best.constants(i) for i in range(len(recordings))]
    logs = tuple(
        CalibrationLog(
            one.name, one.path, one.sha256, float(one.track.distance[-1]), math.degrees(own.heading_offset_rad),
            -own.wheels_later_s, one.begin_ns,
        )
        for one, own in zip(recordings, constants, strict=True)
    )  # fmt: skip
    cut = cut_error_windows(recordings)
    return Calibration(
        robot=robot if robot is not None else CalibratedRobot(track_width_m=recordings[0].width_m),
        fitted=best.fitted,
        others={name: table.fits[name].fitted for name in MODELS},
        gyro=table.fits[f"{RECOMMENDED}{GYRO}"].fitted if table.has_gyro else None,
        logs=logs,
        held_out=tuple(_scores(table)),
        pooled=tuple(_pooled(table)),
        controller=controller_errors(cut, table),
        sources=measure_error_sources(cut, table, RECOMMENDED),
        gyro_sources=measure_error_sources(cut, table, f"{RECOMMENDED}{GYRO}") if table.has_gyro else None,
        warnings=(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        tool_version=__version__,
    )


def _notes(recordings: Sequence[Recording]) -> tuple[str, ...]:
    without = [one.name for one in recordings if one.track.gyro is None]
    return () if not without else (f"no gyro that turns with the robot in {', '.join(without)}: wheels alone",)


def _scores(table: HeldOut) -> Iterator[HeldOutScore]:
    """Yield the rows of ``held_out``; a score without trials is left out."""
    for row in table.scores:
        for fold, summary in zip(table.folds, row.folds, strict=True):
            for h, horizon in enumerate(table.horizons_m):
                if summary.trials[h]:
                    yield HeldOutScore(row.name, horizon, float(summary.p95[h]), float(summary.expected[h]), fold.name)


def _pooled(table: HeldOut) -> Iterator[PooledScore]:
    """Yield the scores of all trials together; one without trials is left out."""
    for row in table.scores:
        for h, horizon in enumerate(table.horizons_m):
            if row.together.trials[h]:
                yield PooledScore(row.name, horizon, float(row.together.p95[h]), float(row.together.expected[h]))


def predictor(calibration: Calibration, recording: Recording, *, with_gyro: bool = False) -> ErrorsOf:
    """Return what gives the errors of a calibration in any trials of a recording; see `calibrated`."""
    found = calibrated(calibration, recording, with_gyro=with_gyro)
    folds = [Fold("", 0, 0, -np.inf, np.inf)]
    return lambda trials: errors_without(recording, trials, folds, 0, lambda _: found)


def calibrated(calibration: Calibration, recording: Recording, *, with_gyro: bool = False) -> Prediction:
    """Return the model of a calibration for a recording, and the recording's constants.

    Parameters
    ----------
    with_gyro : the turn rate is the weighted mean with the recording's gyro

    Raises
    ------
    ConfigError
        The calibration is of a robot of another width; or with_gyro, and one of the two has no gyro.
    DataError
        The drive is too short to find its own constants.

    Notes
    -----
    Constants of the recording are found in it with the parameters held.
    """
    if abs(recording.width_m - calibration.width_m) > 1e-3 * calibration.width_m:
        why = f"{recording.width_m:g} m, the calibration is of a robot of {calibration.width_m:g} m"
        raise ConfigError("robot.track_width_m", why, "use a calibration of this robot")
    if with_gyro and (calibration.gyro is None or recording.track.gyro is None):
        raise ConfigError("gyro", "not in the calibration, or not in the log", "use the wheels alone")
    fitted = calibration.gyro if with_gyro and calibration.gyro is not None else calibration.fitted
    return fitted, own_constants(cut_windows(recording), fitted, recording.width_m)
