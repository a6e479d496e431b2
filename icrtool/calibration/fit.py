"""Fit with one motion model: what ``icrtool.fit`` and ``icrtool fit`` do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np

from icrtool.calibration.held_out import fit_models
from icrtool.calibration.pooled import robot_of
from icrtool.calibration.record import controller_numbers, fitted_document
from icrtool.calibration.run_recording import recording_of
from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.estimation.fit import fit as fit_filter
from icrtool.estimation.observability import WEAK_SHARE
from icrtool.kernels.arrays import Floats
from icrtool.motion.models import FIVE, ICRS, RECOMMENDED, TrackGeometry
from icrtool.records.run import ICR_COLUMNS, Run, WarmStart, check_type, width_or_usual_m
from icrtool.records.run_document import GeometryDocument, RunDocument
from icrtool.records.tables import RobotLog


def fit(
    log: RobotLog,
    config: Config | None = None,
    *,
    warm_start: WarmStart | None = None,
    changes_s: tuple[float, ...] = (),
    smooth: bool = False,
    watch: Callable[[str], None] | None = None,
) -> Run:
    """Learn a robot's track ICRs from a log, and its motion model.

    Parameters
    ----------
    log : as `icrtool.read_log` returns it
    config : default: all defaults
    warm_start : ICRs and covariance that another run ended with (Fig. 18), in place of the preset's start
    changes_s : terrain changes, seconds since the first recorded state: the ICR covariance is inflated there (Fig. 9)
    smooth : also make the states of the RTS smoother
    watch : called with the name of each stage when it begins

    Returns
    -------
    Run
        No file is touched. `document` holds the motion model, as `icrtool.calibrate` fits it, the ICRs and what a
        controller is given.

    Raises
    ------
    DataError
        Streams that cannot be used together, or hold values that are not finite numbers.
    ConfigError
        A start that preset ``field`` does not take.
    """
    check_type(log, RobotLog, "icrtool.read_log(path, config) reads one")
    # The callee alone holds the log, and frees what it needs no longer.
    logs = [log]
    del log
    run = fit_filter(logs.pop(), config, warm_start=warm_start, changes_s=changes_s, smooth=smooth, watch=watch)
    return replace(run, document=with_motion(run))


def with_motion(run: Run) -> RunDocument:
    """Return the document of a run with its motion model, ICRs and controller numbers.

    Notes
    -----
    ICRs and controller numbers come from one fit of `FIVE` to the windows of the drive, so that
    (right - left) / b is the multiplier. With preset ``paper`` they are those of the filter at the end.
    """
    recording = recording_of(run, width_m=width_or_usual_m(run.track_width_m))
    try:
        fits = fit_models([recording], (FIVE, RECOMMENDED)).fits
    except DataError:
        fits = {}
    if run.config.filter.preset == "paper":
        geometry, covariance = _of_filter(run, recording.width_m)
    elif FIVE in fits:
        geometry, covariance = fits[FIVE].geometry(recording.width_m)
    else:
        return run.document
    robot = robot_of(run, recording.width_m)
    found = None
    if run.usable and run.track_width_m is not None and RECOMMENDED in fits:
        found = fitted_document(fits[RECOMMENDED], geometry, covariance, robot)
    shown = _shown(run, geometry, covariance)
    numbers = controller_numbers(geometry, covariance, robot)
    return msgspec.structs.replace(
        run.document,
        recommended=found,
        geometry=_geometry_document(geometry, covariance, shown),
        controller=numbers if found is not None and all(shown[:2]) else None,
    )


def _of_filter(run: Run, width_m: float) -> tuple[TrackGeometry, Floats]:
    """Return the filter's final ICRs, with radii as configured, and their covariance (6, 6)."""
    right, left, x = run.table.icrs_at(-1)
    by_icr = np.zeros((len(TrackGeometry._fields), ICRS))
    by_icr[:ICRS] = np.eye(ICRS)
    by_icr[ICRS, :2] = 1.0 / width_m, -1.0 / width_m
    covariance: Floats = by_icr @ np.array(run.document.icr.final_covariance_m2) @ by_icr.T
    return TrackGeometry(right, left, x, (right - left) / width_m, 1.0, 1.0), covariance


def _shown(run: Run, geometry: TrackGeometry, covariance: Floats) -> list[bool]:
    """Return whether each ICR is shown: by the excitation of the drive, and by its own standard deviation."""
    verdicts = run.document.excitation.verdict
    largest = WEAK_SHARE * abs(geometry.y_icr_right_m - geometry.y_icr_left_m)
    std = np.sqrt(np.diag(covariance)[:ICRS])
    paper = run.config.filter.preset == "paper"
    return [
        paper or (verdicts[name] != "not shown" and bool(one <= largest))
        for name, one in zip(ICR_COLUMNS, std, strict=True)
    ]


def _geometry_document(geometry: TrackGeometry, covariance: Floats, shown: list[bool]) -> GeometryDocument:
    values: dict[str, float] = {}
    for name, value, variance, seen in zip(ICR_COLUMNS, geometry, np.diag(covariance), shown, strict=False):
        if seen:
            values |= {name: float(value), f"{name}_std": float(np.sqrt(variance))}
    return GeometryDocument(**values, covariance_m2=covariance[:ICRS, :ICRS].tolist())
