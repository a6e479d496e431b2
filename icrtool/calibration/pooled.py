"""Runs as recordings for the motion models, and calibrations from one recording or several."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from os import PathLike
from typing import Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET
from msgspec.structs import asdict

from icrtool import __version__
from icrtool.calibration import held_out
from icrtool.calibration.held_sensors import FEWEST_POOLED, sensors_of
from icrtool.calibration.other_grounds import leave_grounds_out
from icrtool.calibration.record import (
    MULTIPLIER_BETWEEN_SHARE,
    Calibration,
    fitted_document,
    parameter_documents,
)
from icrtool.errors import ConfigError, DataError
from icrtool.estimation.odometry import measured_headings
from icrtool.kernels.arrays import ROWS_AT_ONCE, Complexes, Floats
from icrtool.kernels.error_statistics import between_variance, pooled_variance
from icrtool.motion.models import FIVE, MODELS, RECOMMENDED, FittedModel, Lever, TrackGeometry
from icrtool.motion.recording import (
    ErrorsOf,
    GyroLine,
    LogConstants,
    PastLines,
    Recording,
    cut_windows,
    fit_gyro_line,
)
from icrtool.motion.window_fit import Fold, Pool, own_constants
from icrtool.records import calibration_document as documents
from icrtool.records.measurements import MeasuredHeading
from icrtool.records.notes import Note, note
from icrtool.records.run import MAKE_RUN, Run, check_type, track_of
from icrtool.records.run_document import RecommendedDocument
from icrtool.records.samples import are_twist


def recording_of(run: Run, heading: MeasuredHeading | None = None, *, width_m: float | None = None) -> Recording:
    """Return the recording of a run: wheels, reference and gyro, as the motion models use them.

    Parameters
    ----------
    heading : a measured heading of the run, for example of its gyro; its turn rate is used if it agrees with the
        reference
    width_m : track width b [m]; default: the track width of the run

    Raises
    ------
    ConfigError
        The robot's track width is not known.
    """
    width = width_m if width_m is not None else run.track_width_m
    if width is None:
        raise ConfigError(
            "robot.track_width_m", f"is not known in {run.name}", "fit the log again with it, or with --robot"
        )
    inputs = run.document.inputs
    left, right = (scale / error for scale, error in zip(run.wheel_scales, run.radius_errors, strict=True))
    without_gyro = Recording(
        name=run.name,
        track=track_of(run),
        width_m=width,
        path=inputs[0].path if inputs else "",
        sha256=(inputs[0].sha256 or "") if inputs else "",
        begin_ns=int(run.table.stamp_ns[0]),
        lever=Lever(*(coordinate_m is not None for coordinate_m in known_antenna_m(run))),
        x_clock_std_m=run.document.icr.x_clock_std_m,
        wheel_scales=(left, right),
        corrected=_corrected(run),
        heading_source=run.document.heading.source,
    )
    return without_gyro if heading is None else with_turn_rate(without_gyro, heading, run.config.frames.gyro_delay_s)


def _corrected(run: Run) -> LogConstants:
    """Return the corrections in the streams of a run as constants; an estimated heading has no offset."""
    offset_deg = 0.0 if run.sensors.facts.heading_is_estimated else run.document.heading.applied_offset_deg
    position = run.document.alignment.get("position_delay_s")
    return LogConstants(-math.radians(offset_deg), 0.0 if position is None else -position.applied)


def known_antenna_m(run: Run) -> tuple[float | None, float | None]:
    """Return the antenna's position forward and right [m]; None if neither the configuration nor the log states it."""
    used, frames = run.sensors.facts.antenna_m, run.config.frames
    in_log = run.sensors.facts.antenna_is_known and frames.antenna_right_m == "auto"
    return (
        used[0] if in_log or frames.antenna_forward_m != "auto" else None,
        used[1] if in_log or frames.antenna_right_m != "auto" else None,
    )


def with_turn_rate(
    without_gyro: Recording, heading: MeasuredHeading, delay_s: float | Literal["auto"] = "auto"
) -> Recording:
    """Return a recording with the turn rate of a measured heading; without it if heading and reference disagree.

    Parameters
    ----------
    without_gyro : the recording without a turn rate
    heading : the measured heading
    delay_s : lag of the heading behind the wheels [s]; ``auto``: estimated from the turns of the reference
    """
    if not np.isfinite(heading.angle_rad).all():
        return without_gyro
    t = without_gyro.track.t

    def rate(later_s: float) -> Floats:
        """Return the turn rate (n,) [rad/s] of the heading, read `later_s` after the wheels."""
        rates = np.zeros(len(t))
        for lo in range(0, len(t) - 1, ROWS_AT_ONCE):
            times_s = t[lo : lo + ROWS_AT_ONCE + 1]
            turns_rad, dt = np.diff(np.interp(times_s + later_s, t, heading.angle_rad)), np.diff(times_s)
            np.divide(turns_rad, dt, out=rates[lo : lo + len(dt)], where=dt > 0.0)
        return rates

    gyro_fit = _fit_gyro(without_gyro, rate(0.0))
    if not gyro_fit.is_yaw:
        return without_gyro
    later_s = gyro_fit.lead_s if delay_s == "auto" else delay_s
    track = without_gyro.track._replace(gyro=np.sign(gyro_fit.scale) * rate(later_s))
    corrected = without_gyro.corrected._replace(gyro_later_s=later_s)
    return replace(without_gyro, track=track, gyro_reversed=gyro_fit.scale < 0.0, corrected=corrected)


def turning_recording_of(run: Run, turn_sensor: str = "gyro", *, width_m: float | None = None) -> Recording:
    """Return the recording of a run with the turns of a sensor (``gyro`` or ``heading``), if the run has it."""
    return recording_of(
        run, next((heading for heading in measured_headings(run) if heading.kind == turn_sensor), None), width_m=width_m
    )


def gyro_line(recording: Recording) -> PastLines:
    """Return scale and bias of a recording's gyro, fitted to the reference of the whole drive."""
    gyro = recording.track.gyro
    gyro_fit = GyroLine(1.0, 0.0, 0.0) if gyro is None else _fit_gyro(recording, gyro)
    return PastLines(np.zeros(1, np.int64), np.array([gyro_fit.scale]), np.array([gyro_fit.bias_radps]))


def _fit_gyro(recording: Recording, rate: Floats) -> GyroLine:
    """Return scale, bias and lead that map a turn rate (n,) [rad/s] to the turns of a recording's reference."""
    track = recording.track
    return fit_gyro_line(track.t, rate, track.cumulate(rate), track.t, track.heading)


class LeftOut(NamedTuple):
    """A log that a calibration leaves out, and the reason."""

    name: str
    why: str

    def __str__(self) -> str:
        return f"{self.name}: left out: {self.why}"


class CalibrationResult(NamedTuple):
    """A calibration, the held-out table with its errors, notes about it, and the logs that it leaves out."""

    calibration: Calibration
    table: held_out.HeldOut
    notes: tuple[Note, ...]
    left_out: tuple[LeftOut, ...] = ()


def calibrate_recordings(
    recordings: Sequence[Recording], robot: documents.CalibratedRobot | None = None, findings: tuple[Note, ...] = (),
    grounds: Sequence[str] = (),
) -> CalibrationResult:  # fmt: skip
    """Return the calibration from recordings of a robot, tested on data that it was not fitted to.

    Parameters
    ----------
    recordings : one or more recordings of one robot
    robot : the robot that the calibration states; default: without a name
    findings : notes that a user needs before using the calibration
    grounds : name of the ground of each recording; with two or more names, each ground is left out in turn

    Raises
    ------
    ConfigError
        The recordings have different track widths, or one recording is given twice.
    DataError
        The recordings are too short.
    """
    widths = {recording.width_m for recording in recordings}
    if len(widths) > 1:
        widths_text = ", ".join(f"{width:g} m" for width in sorted(widths))
        raise ConfigError("robot.track_width_m", f"is {widths_text} in the given logs", "calibrate one robot at a time")
    with_sum = [recording for recording in recordings if recording.sha256]
    if twice := {
        recording.name for recording in with_sum if sum(recording.sha256 == other.sha256 for other in with_sum) > 1
    }:
        raise ConfigError(min(twice), "is given twice", "name each log once, else it would be tested on itself")
    table = held_out.hold_out(recordings)
    turnless = ", ".join(recording.name for recording in recordings if recording.track.gyro is None)
    text = f"{turnless}: no gyro turns with the robot, so the models use the wheels alone"
    notes = (note("gyro_not_used", text),) if turnless else ()
    calibration = calibration_of_table(table, robot, findings)
    if grounds:
        logs = tuple(
            msgspec.structs.replace(log, ground=ground) for log, ground in zip(calibration.logs, grounds, strict=True)
        )
        scores = leave_grounds_out(recordings, grounds)
        calibration = msgspec.structs.replace(calibration, logs=logs, other_grounds=scores or UNSET)
    return CalibrationResult(calibration, table, notes)


def calibration_of_table(
    table: held_out.HeldOut,
    robot: documents.CalibratedRobot | None = None,
    findings: tuple[Note, ...] = (),
    *,
    has_gyro: bool | None = None,
) -> Calibration:
    """Return the calibration from the recordings of a held-out table.

    Parameters
    ----------
    table : the held-out table
    robot, findings : as in `calibrate_recordings`
    has_gyro : whether a gyro measures the turn rate of the table; None: if the table has a turn rate. A turn rate that
        is derived from a measured heading does not become a part of the calibration
    """
    has_gyro = table.has_gyro if has_gyro is None else has_gyro
    recordings, best = table.recordings, table.fits[RECOMMENDED]
    with_gyro = table.fits[f"{RECOMMENDED}{held_out.GYRO_SUFFIX}"].fitted if has_gyro else None
    logs = []
    for i, recording in enumerate(recordings):
        constants, distance_m = best.constants(i), float(recording.track.distance[-1])
        offset_deg, delay_s = math.degrees(constants.heading_offset_rad), -constants.wheels_later_s
        sensors = sensors_of(recording, best.pool.windows[i], best.fitted, with_gyro)
        numbers = distance_m, offset_deg, delay_s, recording.begin_ns
        logs.append(
            documents.CalibrationLog(recording.name, recording.path, recording.sha256, *numbers, sensors=sensors)
        )
    by_fold, together = [], []
    for row in table.scores:
        # A score without trials is left out.
        for fold, summary in zip(table.folds, row.folds, strict=True):
            for h, horizon in enumerate(table.horizons_m):
                if summary.trials[h]:
                    p95, expected = float(summary.p95[h]), float(summary.expected[h])
                    by_fold.append(documents.HeldOutScore(row.name, horizon, p95, expected, fold.name))
        for h, horizon in enumerate(table.horizons_m):
            if row.together.trials[h]:
                p95, expected = float(row.together.p95[h]), float(row.together.expected[h])
                together.append(documents.PooledScore(row.name, horizon, p95, expected))
    gyro = None
    if with_gyro is not None:
        sources = held_out.measure_error_sources(table, f"{RECOMMENDED}{held_out.GYRO_SUFFIX}")
        gyro = documents.GyroDocument(with_gyro.model.name, *parameter_documents(with_gyro), sources)
    robot = robot if robot is not None else documents.CalibratedRobot(track_width_m=recordings[0].width_m)
    geometry, covariance = table.fits[FIVE].fitted.geometry(robot.track_width_m)
    shared_std = multiplier_between_std(table, robot.track_width_m, geometry.multiplier)
    document = fitted_document(best.fitted, geometry, covariance, robot, shared_std=shared_std)
    errors = held_out.measure_controller_errors(table, has_gyro=has_gyro)
    return Calibration(
        schema=documents.CALIBRATION_SCHEMA,
        tool_version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        robot=robot,
        recommended=document.model,
        **{name: getattr(document, name) for name in RecommendedDocument.__struct_fields__[1:-1]},
        controller=documents.ControllerDocument(
            **asdict(document.controller), **({} if errors is None else asdict(errors))
        ),
        gyro=gyro,
        models={name: documents.FittedDocument(*parameter_documents(table.fits[name].fitted)) for name in MODELS},
        logs=tuple(logs),
        held_out=tuple(by_fold),
        held_out_pooled=tuple(together),
        error_sources=held_out.measure_error_sources(table, RECOMMENDED),
        notes=findings,
        warnings=tuple(finding.sentence for finding in findings),
    )


def multiplier_between_std(table: held_out.HeldOut, width_m: float, multiplier: float) -> float | None:
    """Return the standard deviation of the multiplier between the logs of a calibration; None for one or two logs.

    Parameters
    ----------
    width_m : track width b [m]
    multiplier : the multiplier of all logs together

    Notes
    -----
    The variance between the logs beyond their own uncertainty (`between_variance`) is pooled with the variance between
    drives of other robots.
    """
    if len(table.recordings) < FEWEST_POOLED:
        return None
    pool = table.fits[FIVE].pool
    geometries = [Pool([windows], [width_m]).fit(MODELS[FIVE]).fitted.geometry(width_m) for windows in pool.windows]
    multiplier_index = TrackGeometry._fields.index("multiplier")
    values = np.array([geometry.multiplier for geometry, _ in geometries])
    measured = between_variance(
        values, np.array([covariance[multiplier_index, multiplier_index] for _, covariance in geometries])
    )
    variance_of_others = (MULTIPLIER_BETWEEN_SHARE * multiplier) ** 2
    return math.sqrt(pooled_variance(measured, len(values) - 1.0, variance_of_others)[0])


def predictor(calibration: Calibration, recording: Recording, *, with_gyro: bool = False) -> ErrorsOf:
    """Return a function that gives the errors of a calibration in trials of a recording, with its own constants.

    Raises
    ------
    ConfigError
        The robot of the calibration has another track width; or `with_gyro` is set, and calibration or recording has no
        gyro.
    DataError
        The recording is too short.
    """
    fitted_model = model_for(calibration, recording, with_gyro=with_gyro)
    fit = fitted_model, own_constants(cut_windows(recording), fitted_model, recording.width_m)
    folds = [Fold("", 0, 0, -np.inf, np.inf)]
    return lambda trials: held_out.errors_without(recording, trials, folds, 0, lambda _: fit)


def model_for(calibration: Calibration, recording: Recording, *, with_gyro: bool = False) -> FittedModel:
    """Return the model of a calibration for a recording.

    Parameters
    ----------
    with_gyro : return the model whose turn rate is the weighted mean of wheels and gyro

    Raises
    ------
    ConfigError
        The robot of the calibration has another track width; or `with_gyro` is set, and calibration or recording has no
        gyro.
    """
    if abs(recording.width_m - calibration.width_m) > 1e-3 * calibration.width_m:
        why = f"is {recording.width_m:g} m, and {calibration.width_m:g} m in the calibration"
        raise ConfigError("robot.track_width_m", why, "use a calibration of this robot")
    if with_gyro and (calibration.gyro is None or recording.track.gyro is None):
        raise ConfigError("gyro", "is missing in the calibration or in the log", "use the wheels alone")
    gyro_model = calibration.fitted_with_gyro if with_gyro else None
    return calibration.fitted if gyro_model is None else gyro_model


SAME_SHARE = 0.98
"""Share of the samples of a log that a longer log must also have. The log then counts as a part of the longer log."""

SAME_SPEED = 1e-6
"""Largest relative difference of two wheel speeds that count as the same."""


def calibrate(runs: Run | Sequence[Run] | Mapping[str, Sequence[Run]], *, allow_unusable: bool = False) -> Calibration:
    """Return the calibration of a robot from one run or many, tested on data that it was not fitted to.

    Parameters
    ----------
    runs : runs of one robot, from `icrtool.fit` or `icrtool.open_run`. One of several runs is left out if it is not
        usable, too short, a copy of another run, or a part of another run. A mapping from names of grounds to runs
        leaves each ground out in turn, too: a report with the calibration then states the distance on another ground
    allow_unusable : also take runs that are not usable

    Raises
    ------
    ConfigError
        The runs have different track widths or wheel radii, or a track width is not known.
    DataError
        No run is left, or the runs are too short.
    """
    if isinstance(runs, Mapping):
        grounds = [ground for ground, ground_runs in runs.items() for _ in ground_runs]
        all_runs = [run for ground_runs in runs.values() for run in ground_runs]
        return calibrate_runs(all_runs, allow_unusable=allow_unusable, grounds=grounds).calibration
    # A text is a sequence, too. As a single run, it is refused with a message about paths.
    run_list = [runs] if isinstance(runs, (Run, str, PathLike)) else runs
    return calibrate_runs(run_list, allow_unusable=allow_unusable).calibration


def calibrate_runs(
    runs: Iterable[Run], *, allow_unusable: bool = False, grounds: Iterable[str] = ()
) -> CalibrationResult:
    """Return the calibration of `calibrate` with its held-out table; only one run at a time is in memory.

    `grounds` has the name of the ground of each run, or is empty.
    """
    ground_of = iter(grounds)
    taken: list[_CalibratedRun] = []
    left_out: list[LeftOut] = []
    single_run_notes: tuple[Note, ...] = ()
    for run in runs:
        check_type(run, Run, MAKE_RUN)
        ground = next(ground_of, "")
        recording = turning_recording_of(run)
        robot = robot_of(run, recording.width_m)
        positions = run.sensors.fixes.north_m + 1j * run.sensors.fixes.east_m
        candidate = _CalibratedRun(recording, positions, robot, use_notes(run, alone=False), ground)
        if why := _why_left_out(run, candidate, taken, allow_unusable=allow_unusable):
            left_out.append(LeftOut(run.name, why))
            continue
        parts = [_is_part(before, candidate) for before in taken]
        left_out += [LeftOut(taken[i].recording.name, f"a part of {run.name}") for i in np.flatnonzero(parts)]
        taken = [*(before for before, is_part in zip(taken, parts, strict=True) if not is_part), candidate]
        single_run_notes = use_notes(run)
    recordings, robots = [log.recording for log in taken], [log.robot for log in taken]
    if not recordings:
        if not left_out:
            raise ConfigError("runs", "no run is given", "name at least one run or log")
        if len(left_out) == 1:
            raise DataError(*left_out[0], "--allow-unusable also takes a run that is not usable")
        raise DataError("runs", f"none of {len(left_out)} can be used", "; ".join(map(str, left_out)))
    if len(radii_m := {robot.wheel_radius_m for robot in robots}) > 1:
        why = f"is {' and '.join(sorted(map(str, radii_m)))} in the given logs"
        advice = "fit them with the same value, because the parameters refer to it"
        raise ConfigError("robot.wheel_radius_m", why, advice)
    notes = (
        single_run_notes if len(taken) == 1 else tuple(dict.fromkeys(finding for log in taken for finding in log.notes))
    )
    named = [log.ground for log in taken] if all(log.ground for log in taken) else []
    return calibrate_recordings(recordings, robots[0], notes, named)._replace(left_out=tuple(left_out))


class _CalibratedRun(NamedTuple):
    """A run that is calibrated.

    Attributes
    ----------
    recording : its recording
    positions : complex (m,) positions of its fixes, north + i east [m]
    robot : its robot
    notes : notes for its use together with other runs
    ground : name of its ground; empty if no ground was given
    """

    recording: Recording
    positions: Complexes
    robot: documents.CalibratedRobot
    notes: tuple[Note, ...]
    ground: str


def _is_part(log: _CalibratedRun, longer_log: _CalibratedRun) -> bool:
    """Return whether a log is a part of a longer log, for example because its recording was cut off.

    A part has stamps of the longer log, and at equal stamps equal wheel speeds and positions. Wheel speeds that were
    computed from wheel positions may differ at the ends of the part.
    """
    part, whole = log.recording, longer_log.recording
    stamps, theirs = (
        np.rint(1e9 * recording.track.t).astype(np.int64) + recording.begin_ns for recording in (part, whole)
    )
    if not (len(stamps) < len(theirs) and theirs[0] <= stamps[-1] and stamps[0] <= theirs[-1]):
        return False
    _, ours, others = np.intersect1d(stamps, theirs, assume_unique=True, return_indices=True)
    shorter, longer = part.wheels(ours), whole.wheels(others)
    same = np.isclose(shorter.v_left, longer.v_left, rtol=SAME_SPEED)
    same &= np.isclose(shorter.v_right, longer.v_right, rtol=SAME_SPEED)
    shared = np.count_nonzero(np.isin(log.positions, longer_log.positions))
    return bool(same.sum() >= SAME_SHARE * len(stamps) and shared >= SAME_SHARE * len(log.positions))


def _why_left_out(run: Run, candidate: _CalibratedRun, taken: Sequence[_CalibratedRun], *, allow_unusable: bool) -> str:
    """Return why a run is left out of the calibration; empty if it is taken."""
    if not (run.usable or allow_unusable):
        return f"not usable: {run.document.unusable_because}"
    recording = candidate.recording
    for other in taken:
        if recording.sha256 and other.recording.sha256 == recording.sha256:
            return f"a copy of {other.recording.name}"
        if _is_part(candidate, other):
            return f"a part of {other.recording.name}"
    try:
        cut_windows(recording)
    except DataError as err:
        return f"too short: {err.why}"
    return ""


def robot_of(run: Run, width_m: float) -> documents.CalibratedRobot:
    """Return the robot of a run as a calibration states it, with a track width [m]."""
    robot = run.config.robot
    left, right = (UNSET if error == 1.0 else error for error in run.radius_errors)
    return documents.CalibratedRobot(
        name=robot.name,
        wheel_radius_m=robot.wheel_radius_m,
        encoder_counts_per_rev=robot.encoder_counts_per_rev or UNSET,
        twist_width_m=(run.config.wheels.twist_width_m or UNSET) if are_twist(run.document.streams) else UNSET,
        left_scale=left,
        right_scale=right,
        track_width_m=width_m,
    )


def use_notes(run: Run, *, alone: bool = True) -> tuple[Note, ...]:
    """Return the notes that a user needs before using a calibration from a run.

    `alone` : the calibration is from this run alone.
    """
    notes: list[Note] = []
    if alone:
        notes += [] if run.usable else [note("run_not_usable", f"not usable: {run.document.unusable_because}")]
        notes += run.document.excitation.notes
    if are_twist(run.document.streams) and run.config.wheels.twist_width_m is None:
        why = (
            "the wheels were read from body twists, which hold the multipliers of the controller: the numbers refer to "
            "the width and the radius with which the controller computed them; set wheels.twist_width_m to this width"
        )
        notes.append(note("wheels_from_twist", why))
    return tuple(notes)
