"""Calibrate from finished runs: what ``icrtool.calibrate`` and ``icrtool calibrate`` do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from icrtool.calibration.pooled import CalibrationResult, calibrate_recordings
from icrtool.calibration.record import Calibration
from icrtool.calibration.run_recording import turning_recording_of
from icrtool.errors import ConfigError
from icrtool.records.run import Run


def calibrate(runs: Run | Sequence[Run]) -> Calibration:
    """Calibrate the motion model of a robot from one run or many, tested on what it was not fitted to.

    Parameters
    ----------
    runs : of `icrtool.fit` or `icrtool.open_run`, of one robot

    Raises
    ------
    ConfigError
        Runs of different robots or wheel radii, one run twice, or a track width that is not known.
    DataError
        Too short a drive.
    """
    return calibrate_runs([runs] if isinstance(runs, Run) else runs).calibration


def calibrate_runs(runs: Iterable[Run]) -> CalibrationResult:
    """Calibrate as `calibrate` does, with the tables by which the model was chosen; one run at a time is held."""
    recordings, robots = [], []
    alone: tuple[str, ...] = ()
    warnings: list[str] = []
    for run in runs:
        recordings.append(turning_recording_of(run))
        robots.append(robot_of(run))
        alone = use_warnings(run)
        warnings += use_warnings(run, alone=False)
    if not recordings:
        raise ConfigError("runs", "no usable one is given", "name at least one run or log")
    if len(found := {robot["wheel_radius_m"] for robot in robots}) > 1:
        why = f"{' and '.join(sorted(map(str, found)))} in the logs given"
        raise ConfigError("robot.wheel_radius_m", why, "fit them with the same value: parameters refer to it")
    result = calibrate_recordings(recordings, robots[0])
    known = alone if len(recordings) == 1 else tuple(dict.fromkeys(warnings))
    return result._replace(calibration=replace(result.calibration, warnings=known))


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
