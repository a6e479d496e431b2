"""Calibrations of several logs pooled: of runs, and of the recordings that they are."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from os import PathLike
from typing import NamedTuple

import numpy as np
from msgspec import UNSET
from msgspec.structs import asdict

from icrtool import __version__
from icrtool.calibration.error_growth import cut_error_windows, measure_controller_errors, measure_error_sources
from icrtool.calibration.held_out import GYRO, HeldOut, errors_without, hold_out
from icrtool.calibration.record import Calibration, fitted_document, parameter_documents
from icrtool.calibration.run_recording import turning_recording_of
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.arrays import Complexes
from icrtool.motion.models import FIVE, MODELS, RECOMMENDED
from icrtool.motion.recording import ErrorsOf, Recording, Windows, cut_windows
from icrtool.motion.window_fit import Fold, Prediction, own_constants
from icrtool.records.calibration_document import (
    CALIBRATION_SCHEMA,
    CalibratedRobot,
    CalibrationLog,
    ControllerDocument,
    FittedDocument,
    GyroDocument,
    HeldOutScore,
    PooledScore,
)
from icrtool.records.run import MAKE_RUN, Run, check_type
from icrtool.records.run_document import RecommendedDocument


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


def calibrate_recordings(
    recordings: Sequence[Recording], robot: CalibratedRobot | None = None, warnings: tuple[str, ...] = ()
) -> CalibrationResult:
    """Fit the motion models to all recordings, and test each on what it was not fitted to.

    Parameters
    ----------
    recordings : one or many, of one robot
    robot : as its calibration holds it; default: of no name
    warnings : what to know before use

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
    return CalibrationResult(calibration_from(table, robot, warnings), table, _notes(recordings))


def calibration_from(
    table: HeldOut, robot: CalibratedRobot | None = None, warnings: tuple[str, ...] = ()
) -> Calibration:
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
    robot = robot if robot is not None else CalibratedRobot(track_width_m=recordings[0].width_m)
    geometry, covariance = table.fits[FIVE].fitted.geometry(robot.track_width_m)
    found, cut = fitted_document(best.fitted, geometry, covariance, robot), cut_error_windows(recordings)
    errors = measure_controller_errors(cut, table)
    return Calibration(
        schema=CALIBRATION_SCHEMA,
        tool_version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        robot=robot,
        recommended=found.model,
        **{name: getattr(found, name) for name in RecommendedDocument.__struct_fields__[1:-1]},
        controller=ControllerDocument(**asdict(found.controller), **({} if errors is None else asdict(errors))),
        gyro=_gyro(cut, table) if table.has_gyro else None,
        models={name: FittedDocument(*parameter_documents(table.fits[name].fitted)) for name in MODELS},
        logs=logs,
        held_out=tuple(_scores(table)),
        held_out_pooled=tuple(_pooled(table)),
        error_sources=measure_error_sources(cut, table, RECOMMENDED),
        warnings=warnings,
    )


def _gyro(cut: Sequence[tuple[int, Recording, Windows]], table: HeldOut) -> GyroDocument:
    """Return the recommended model with a gyro, and its sources of error."""
    name = f"{RECOMMENDED}{GYRO}"
    fitted = table.fits[name].fitted
    return GyroDocument(fitted.model.name, *parameter_documents(fitted), measure_error_sources(cut, table, name))


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
    turned = calibration.fitted_with_gyro if with_gyro else None
    fitted = calibration.fitted if turned is None else turned
    return fitted, own_constants(cut_windows(recording), fitted, recording.width_m)


SAME_SHARE, SAME_SPEED = 0.98, 1e-6
"""A log is a part of another that has so much of its rows, with speeds that differ by no more than this share."""


def calibrate(runs: Run | Sequence[Run], *, allow_unusable: bool = False) -> Calibration:
    """Calibrate the motion model of a robot from one run or many, tested on what it was not fitted to.

    Parameters
    ----------
    runs : of `icrtool.fit` or `icrtool.open_run`, of one robot; of many, those are left out that are not usable, too
        short, copies of another, or a part of one
    allow_unusable : take runs that are not usable, too

    Raises
    ------
    ConfigError
        Runs of different robots or wheel radii, or a track width that is not known.
    DataError
        No run is left, or too short a drive.
    """
    # A path is refused as what it is, not as a sequence of letters.
    several = [runs] if isinstance(runs, (Run, str, PathLike)) else runs
    return calibrate_runs(several, allow_unusable=allow_unusable).calibration


def calibrate_runs(runs: Iterable[Run], *, allow_unusable: bool = False) -> CalibrationResult:
    """Calibrate as `calibrate` does, with the table of the test; one run at a time is held."""
    taken: list[_Taken] = []
    left_out: list[LeftOut] = []
    alone: tuple[str, ...] = ()
    for run in runs:
        check_type(run, Run, MAKE_RUN)
        recording = turning_recording_of(run)
        robot = robot_of(run, recording.width_m)
        one = _Taken(recording, _positions(run), robot, use_warnings(run, alone=False))
        if why := _why_left_out(run, one, taken, allow_unusable=allow_unusable):
            left_out.append(LeftOut(run.name, why))
            continue
        parts = [_is_part(before, one) for before in taken]
        left_out += [LeftOut(taken[i].recording.name, f"a part of {run.name}") for i in np.flatnonzero(parts)]
        taken = [*(before for before, is_part in zip(taken, parts, strict=True) if not is_part), one]
        alone = use_warnings(run)
    recordings, robots = [one.recording for one in taken], [one.robot for one in taken]
    if not recordings:
        if not left_out:
            raise ConfigError("runs", "no usable one is given", "name at least one run or log")
        if len(left_out) == 1:
            raise DataError(*left_out[0], "--allow-unusable takes a run that is not usable")
        raise DataError("runs", f"none of {len(left_out)} can be used", "; ".join(map(str, left_out)))
    if len(found := {robot.wheel_radius_m for robot in robots}) > 1:
        why = f"{' and '.join(sorted(map(str, found)))} in the logs given"
        raise ConfigError("robot.wheel_radius_m", why, "fit them with the same value: parameters refer to it")
    known = alone if len(taken) == 1 else tuple(dict.fromkeys(text for one in taken for text in one.warnings))
    return calibrate_recordings(recordings, robots[0], known)._replace(left_out=tuple(left_out))


class _Taken(NamedTuple):
    """A run that is calibrated.

    Attributes
    ----------
    positions : complex (m,), of its fixes, north + i east [m]
    warnings : of its use beside others
    """

    recording: Recording
    positions: Complexes
    robot: CalibratedRobot
    warnings: tuple[str, ...]


def _positions(run: Run) -> Complexes:
    found: Complexes = run.sensors.fixes.north_m + 1j * run.sensors.fixes.east_m
    return found


def _is_part(one: _Taken, of: _Taken) -> bool:
    """Return whether a log, as one that was cut off, holds nothing but a part of a longer one.

    It has the other's stamps, and where both have them the same wheel speeds and positions. At its ends speeds that
    were made from positions of the wheels may differ.
    """
    part, whole = one.recording, of.recording
    stamps, theirs = (np.rint(1e9 * log.track.t).astype(np.int64) + log.begin_ns for log in (part, whole))
    if not (len(stamps) < len(theirs) and theirs[0] <= stamps[-1] and stamps[0] <= theirs[-1]):
        return False
    _, ours, others = np.intersect1d(stamps, theirs, assume_unique=True, return_indices=True)
    same = np.isclose(part.track.v_left[ours], whole.track.v_left[others], rtol=SAME_SPEED)
    same &= np.isclose(part.track.v_right[ours], whole.track.v_right[others], rtol=SAME_SPEED)
    shared = np.count_nonzero(np.isin(one.positions, of.positions))
    return bool(same.sum() >= SAME_SHARE * len(stamps) and shared >= SAME_SHARE * len(one.positions))


def _why_left_out(run: Run, one: _Taken, before: Sequence[_Taken], *, allow_unusable: bool) -> str:
    """Return why a run is not calibrated with those before it; empty where it is."""
    if not (run.usable or allow_unusable):
        return f"not usable: {run.document.unusable_because}"
    recording = one.recording
    for other in before:
        if recording.sha256 and other.recording.sha256 == recording.sha256:
            return f"a copy of {other.recording.name}"
        if _is_part(one, other):
            return f"a part of {other.recording.name}"
    try:
        cut_windows(recording)
    except DataError as err:
        return f"too short: {err.why}"
    return ""


def robot_of(run: Run, width_m: float) -> CalibratedRobot:
    """Return what a calibration holds of the robot of a run, of track width `width_m`."""
    robot = run.config.robot
    return CalibratedRobot(
        name=robot.name,
        wheel_radius_m=robot.wheel_radius_m,
        encoder_counts_per_rev=robot.encoder_counts_per_rev or UNSET,
        twist_width_m=(run.config.wheels.twist_width_m or UNSET) if _from_twists(run) else UNSET,
        track_width_m=width_m,
    )


def _from_twists(run: Run) -> bool:
    """Return whether the wheels were read from the twists of an odometry."""
    stream = next((one for one in run.document.streams if one.role == "wheels"), None)
    return stream is not None and "Odometry" in stream.message_type


def use_warnings(run: Run, *, alone: bool = True) -> tuple[str, ...]:
    """Return what to know of a run before a calibration from it is used; `alone`: it is from no other."""
    warnings: list[str] = []
    if alone:
        warnings += [] if run.usable else [f"not usable: {run.document.unusable_because}"]
        warnings += run.document.excitation.sentences
    if _from_twists(run) and run.config.wheels.twist_width_m is None:
        warnings.append(
            "the wheels were read from odometry twists, which hold the controller's own multipliers: "
            "these numbers are right only where b and radius are those the twists were made with"
        )
    return tuple(warnings)
