"""Calibrate from finished runs: what ``icrtool.calibrate`` and ``icrtool calibrate`` do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any

from icrtool.calibration.pooled import CalibrationResult, LeftOut, calibrate_recordings
from icrtool.calibration.record import Calibration
from icrtool.calibration.run_recording import turning_recording_of
from icrtool.errors import ConfigError, DataError
from icrtool.motion.recording import Recording, cut_windows
from icrtool.records.run import MAKE_RUN, Run, check_type


def calibrate(runs: Run | Sequence[Run], *, allow_unusable: bool = False) -> Calibration:
    """Calibrate the motion model of a robot from one run or many, tested on what it was not fitted to.

    Parameters
    ----------
    runs : of `icrtool.fit` or `icrtool.open_run`, of one robot; of many, those are left out that are not usable, too
        short, or copies of another
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
    recordings: list[Recording] = []
    robots, left_out = [], []
    alone: tuple[str, ...] = ()
    warnings: list[str] = []
    for run in runs:
        check_type(run, Run, MAKE_RUN)
        recording = turning_recording_of(run)
        if why := _why_left_out(run, recording, recordings, allow_unusable=allow_unusable):
            left_out.append(LeftOut(run.name, why))
            continue
        recordings.append(recording)
        robots.append(robot_of(run))
        alone = use_warnings(run)
        warnings += use_warnings(run, alone=False)
    if not recordings:
        if not left_out:
            raise ConfigError("runs", "no usable one is given", "name at least one run or log")
        if len(left_out) == 1:
            raise DataError(*left_out[0], "--allow-unusable takes a run that is not usable")
        raise DataError("runs", f"none of {len(left_out)} can be used", "; ".join(map(str, left_out)))
    if len(found := {robot["wheel_radius_m"] for robot in robots}) > 1:
        why = f"{' and '.join(sorted(map(str, found)))} in the logs given"
        raise ConfigError("robot.wheel_radius_m", why, "fit them with the same value: parameters refer to it")
    result = calibrate_recordings(recordings, robots[0])
    known = alone if len(recordings) == 1 else tuple(dict.fromkeys(warnings))
    calibration = replace(result.calibration, warnings=known)
    return result._replace(calibration=calibration, left_out=tuple(left_out))


def _why_left_out(run: Run, recording: Recording, before: Sequence[Recording], *, allow_unusable: bool) -> str:
    """Return why a run is not calibrated with those before it; empty where it is."""
    if not (run.usable or allow_unusable):
        return f"not usable: {run.summary['unusable_because']}"
    same = next((one.name for one in before if recording.sha256 and one.sha256 == recording.sha256), None)
    if same is not None:
        return f"a copy of {same}"
    try:
        cut_windows(recording)
    except DataError as err:
        return f"too short: {err.why}"
    return ""


def robot_of(run: Run) -> dict[str, Any]:
    """Return what a calibration holds of the robot of a run, except its track width."""
    robot: dict[str, Any] = {"name": run.config.robot.name, "wheel_radius_m": run.config.robot.wheel_radius_m}
    if run.config.robot.encoder_counts_per_rev is not None:
        robot["encoder_counts_per_rev"] = run.config.robot.encoder_counts_per_rev
    if run.config.wheels.twist_width_m is not None and _from_twists(run):
        robot["twist_width_m"] = run.config.wheels.twist_width_m
    return robot


def _from_twists(run: Run) -> bool:
    """Return whether the wheels were read from the twists of an odometry."""
    stream = next((one for one in run.summary["streams"] if one["role"] == "wheels"), None)
    return stream is not None and "Odometry" in stream["message_type"]


def use_warnings(run: Run, *, alone: bool = True) -> tuple[str, ...]:
    """Return what to know of a run before a calibration from it is used; `alone`: it is from no other."""
    warnings: list[str] = []
    if alone:
        warnings += [] if run.usable else [f"not usable: {run.summary['unusable_because']}"]
        warnings += run.summary["excitation"]["sentences"]
    if _from_twists(run) and run.config.wheels.twist_width_m is None:
        warnings.append(
            "the wheels were read from odometry twists, which hold the controller's own multipliers: "
            "these numbers are right only where b and radius are those the twists were made with"
        )
    return tuple(warnings)
