"""Fit: learn the track ICRs of a robot from a log (Pentzer 2014, Sections 3 and 6)."""

from __future__ import annotations

from collections.abc import Callable

from icrtool.alignment.align import align
from icrtool.alignment.reference_choice import choose_reference
from icrtool.config import Config
from icrtool.estimation import smooth as smoother
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
    """Learn a robot's track ICRs from a log.

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
        No file is touched.

    Raises
    ------
    DataError
        Streams that cannot be used together, or hold values that are not finite numbers.
    ConfigError
        A start that preset ``field`` does not take.

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
    name, inputs, datum, rejected = log.name, log.inputs, log.datum, log.rejected_fixes
    # Its columns that the filter does not use take as much memory as half of the states.
    del log
    begin("filter")
    filtered = run_filter(measurements.sensors, config, warm_start=warm_start, changes_s=changes_s)
    smoothed = smoother.smooth(filtered, config) if smooth else None
    begin("summary")
    return Run(
        name=name,
        config=config,
        table=filtered.table,
        in_gap=filtered.in_gap,
        outages_ns=filtered.outages_ns,
        sensors=filtered.sensors,
        gnss=filtered.gnss,
        heading=filtered.heading,
        smoothed=smoothed,
        summary=summarise(measurements, filtered, config, inputs=inputs, datum=datum, rejected_fixes=rejected),
    )


def _ignore(stage: str) -> None:
    """Take no notice of a stage."""
