"""Fit: learn the track ICRs of a robot from a log (Pentzer 2014, Sections 3 and 6)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from icrtool.alignment.align import align, choose_reference
from icrtool.config import Config
from icrtool.estimation import smooth as smoother
from icrtool.estimation.followed_jumps import followed_jumps
from icrtool.estimation.run_filter import run_filter
from icrtool.estimation.summary import summarise
from icrtool.records.run import Run, WarmStart
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
    """Align the sensors of a log, run the filter, summarise: `icrtool.fit` without its recommendation.

    Parameters, return value and errors are those of `icrtool.calibration.fit.fit`.

    Notes
    -----
    The EKF of Pentzer 2014, Eqs. 13-25, event by event; ``filter.preset`` chooses between the paper's constants and
    start (``paper``) and those made for field logs (``field``).
    """
    config = config if config is not None else Config()
    begin = watch if watch is not None else _ignore
    begin("aligning")
    log = choose_reference(log, config)
    measurements = align(log, config)
    inputs, datum, rejected = log.inputs, log.datum, log.rejected_fixes
    # Its columns that the filter does not use take as much memory as half of the states.
    del log
    begin("filter")
    filtered = run_filter(measurements.sensors, config, warm_start=warm_start, changes_s=changes_s)
    jumps = followed_jumps(filtered.sensors, filtered.gnss, filtered.heading)
    filtered = filtered._replace(sensors=replace(filtered.sensors, jumps=jumps))
    begin("summary")
    run = Run(
        document=summarise(measurements, filtered, config, inputs=inputs, datum=datum, rejected_fixes=rejected),
        table=filtered.table,
        in_gap=filtered.in_gap,
        outages_ns=filtered.outages_ns,
        sensors=filtered.sensors,
        gnss=filtered.gnss,
        heading=filtered.heading,
        smoothed=None,
    )
    return replace(run, smoothed=smoother.smooth(run)) if smooth else run


def _ignore(stage: str) -> None:
    """Take no notice of a stage."""
