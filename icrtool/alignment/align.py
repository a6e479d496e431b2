"""Align the sensors of a log: from what was sent to what the filter can use."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np

from icrtool.alignment.corrections import align_streams
from icrtool.alignment.findings import alignment_findings, start_icrs
from icrtool.alignment.position.gnss_quality import grade_fixes
from icrtool.alignment.position.gnss_steps import without_frozen
from icrtool.alignment.position.sensor_noise import heading_variance, position_variance, reference_noise
from icrtool.alignment.slip.slip_events import find_disagreements
from icrtool.alignment.stream_checks import check_streams
from icrtool.alignment.wheels.wheel_alignment import bridged
from icrtool.alignment.wheels.wheel_units import with_wheel_speeds
from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.records.measurements import Fixes, Measurements, SensorData
from icrtool.records.run import width_or_usual_m
from icrtool.records.samples import PositionFixes
from icrtool.records.tables import RobotLog


def align(log: RobotLog, config: Config) -> Measurements:
    """Find the errors of the streams of a log, and correct what is certain.

    Parameters
    ----------
    log : as `icrtool.read_log` returns it
    config : preset ``paper`` corrects nothing

    Returns
    -------
    Measurements
        The streams with every correction applied, and what was found.

    Raises
    ------
    DataError
        Streams that cannot be used together, or a heading that has nothing to do with the course over ground.
    """
    log = with_wheel_speeds(log, config)
    if config.filter.preset == "field":
        log = without_frozen(log)
    found = _align_once(log, config)
    if config.filter.preset == "paper":
        # it takes its wheels as they are
        return found
    found = _with_events(log, config, found)
    filled, note = bridged(found.sensors.wheels, config.filter.wheel_gap_s)
    notes = (f"{log.name}: {note}",) if note else ()
    return replace(found, sensors=replace(found.sensors, wheels=filled), warnings=(*found.warnings, *notes))


def _align_once(log: RobotLog, config: Config) -> Measurements:
    found = align_streams(log, config)
    heading = found.heading
    fix_steps = found.fix_steps
    quality = grade_fixes(found.log, config, fix_steps)
    noise = reference_noise(found.log, config.filter, fix_steps, found.heading_steps)
    sensors = sensors_as_sent(quality.log, config, noise)
    return Measurements(
        sensors=replace(
            sensors,
            fixes=replace(
                sensors.fixes,
                fix_class=quality.fix_class,
                misreported=quality.misreported,
                down_weighted=quality.down_weighted,
            ),
            headings=replace(
                sensors.headings,
                heading_rad=sensors.headings.heading_rad - heading.remaining_offset_rad,
                var_rad2=quality.log.heading.var_rad2
                if heading.is_estimated
                else heading_variance(quality.log.heading, config.filter, heading.applied_std_rad, noise[1]),
            ),
            heading_correlation_s=max(config.filter.heading_correlation_s, heading.applied_correlation_s),
            heading_is_estimated=heading.is_estimated,
            heading_is_measured=math.isfinite(noise[1]),
            turn_wander_rad=math.inf if found.fit is None else found.fit.turn_wander_rad,
            attitude=None if found.derived is None else found.derived.attitude,
            losses_ns=quality.losses_ns,
            icr_start=start_icrs(found.geometry, sensors.antenna_m, config),
        ),
        findings=alignment_findings(found, sensors.antenna_m),
        wheels=found.wheels.facts(found.fit),
        heading=heading.facts(),
        streams=found.log.streams,
        fix_statistics=quality.statistics,
        clock_std_s=found.delays.clock_std_s,
        antenna_is_known=log.antenna_m is not None or config.frames.antenna_right_m != "auto",
        warnings=(*quality.log.warnings, *found.warnings, *quality.warnings),
    )


def _with_events(log: RobotLog, config: Config, found: Measurements) -> Measurements:
    """Return the streams with the slip events and jumps found in them; where there are events, aligned again without.

    A log with too little besides them keeps its first alignment.
    """
    width = width_or_usual_m(config.robot.track_width_m)
    seen = find_disagreements(found.sensors, width)
    if seen.events:
        spans = tuple((event.begin_ns, event.end_ns) for event in seen.events)
        with suppress(DataError):
            found = _align_once(replace(log, slipping_ns=spans), config)
            seen = find_disagreements(found.sensors, width)
    return replace(found, sensors=replace(found.sensors, events=seen.events, jumps=seen.jumps))


def sensors_as_sent(log: RobotLog, config: Config, measured: tuple[float, float] = (math.nan, math.nan)) -> SensorData:
    """Return the streams of a log without any correction, each sample with its noise: for logs known to be right.

    Parameters
    ----------
    measured : noise of positions [m] and headings [rad], of `reference_noise`; NaN: as stated or configured

    Raises
    ------
    DataError
        Streams that cannot be used together.
    """
    check_streams(log)
    return SensorData(
        name=log.name,
        wheels=log.wheels,
        fixes=_fixes(log.gnss, config, measured[0]),
        headings=replace(log.heading, var_rad2=heading_variance(log.heading, config.filter, measured_rad=measured[1])),
        gyro=log.gyro,
        heading_from_position=log.heading_is_of_position,
        heading_correlation_s=config.filter.heading_correlation_s,
        antenna_m=_antenna_m(log, config),
        losses_ns=np.empty((0, 2), np.int64),
    )


def _fixes(gnss: PositionFixes, config: Config, measured_m: float) -> Fixes:
    variance = position_variance(gnss, config.filter, measured_m)
    none = np.zeros(len(gnss.stamp_ns), np.bool_)
    return Fixes(
        stamp_ns=gnss.stamp_ns,
        north_m=gnss.north_m,
        east_m=gnss.east_m,
        var_north_m2=np.ascontiguousarray(variance[:, 0]),
        var_east_m2=np.ascontiguousarray(variance[:, 1]),
        fix_class=np.zeros(len(gnss.stamp_ns), np.uint8),
        misreported=none,
        down_weighted=none,
    )


def _antenna_m(log: RobotLog, config: Config) -> tuple[float, float]:
    """Return the antenna's place in the body frame, forward and right [m]: configured, else the log's own, else 0."""
    forward, right = log.antenna_m if log.antenna_m is not None else (0.0, 0.0)
    given = config.frames
    return (
        forward if given.antenna_forward_m == "auto" else given.antenna_forward_m,
        right if given.antenna_right_m == "auto" else given.antenna_right_m,
    )
