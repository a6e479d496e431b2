"""Fit with a recommendation: what ``icrtool.fit`` and ``icrtool fit`` do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import cast

from icrtool.calibration.from_runs import robot_of
from icrtool.calibration.held_out import recommend
from icrtool.calibration.record import fitted_document
from icrtool.calibration.run_recording import recording_of
from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.estimation.fit import fit as fit_filter
from icrtool.records.run import Run, WarmStart
from icrtool.records.run_document import RecommendedDocument
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
    """Learn a robot's track ICRs from a log, and which motion model to use.

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
        No file is touched. `summary` holds the recommended model, as `icrtool.calibrate` would recommend it.

    Raises
    ------
    DataError
        Streams that cannot be used together, or hold values that are not finite numbers.
    ConfigError
        A start that preset ``field`` does not take.
    """
    # The callee alone holds the log, and frees what it needs no longer.
    logs = [log]
    del log
    run = fit_filter(logs.pop(), config, warm_start=warm_start, changes_s=changes_s, smooth=smooth, watch=watch)
    return replace(run, summary=run.summary | {"recommended": recommendation(run)})


def recommendation(run: Run) -> RecommendedDocument | None:
    """Return the model, parameters and controller numbers that `calibrate` recommends for a run, without scores.

    Returns
    -------
    None where the track width is not known, or the drive is too short to fit on one part and test on another.
    """
    if run.track_width_m is None:
        return None
    recording = recording_of(run)
    try:
        found = recommend([recording])
    except DataError:
        return None
    robot = robot_of(run) | {"track_width_m": recording.width_m}
    plain = fitted_document(found.fit, found.controller, robot, found.typical)
    return cast("RecommendedDocument", {"label": found.fit.model.label, "why": found.why} | plain)
