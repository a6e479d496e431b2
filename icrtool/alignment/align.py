"""Alignment of the sensors of a log: its streams corrected for the filter, and the choice of its position reference."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np

from icrtool.alignment.clock_search import NO_SHIFTS, take_shifts, with_configured_delays, with_shifts
from icrtool.alignment.conventions import apply_convention, decide_conventions
from icrtool.alignment.corrections import AlignedStreams, align_streams
from icrtool.alignment.estimator import ESTIMATE_PRIOR_STD, POSITION_LAG, estimate_alignment
from icrtool.alignment.gnss_quality import grade_fixes
from icrtool.alignment.gyro_heading import DELAY
from icrtool.alignment.log_track import check_streams, cut_drive_windows, track_of_log
from icrtool.alignment.sensor_noise import (
    fixes_of,
    heading_variance,
    reference_noise,
    without_bad_start,
    without_frozen,
)
from icrtool.alignment.slip_events import find_disagreements
from icrtool.alignment.sparse_reference import without_interpolated
from icrtool.alignment.wheel_alignment import bridge_gaps
from icrtool.alignment.wheel_units import with_right_size, with_wheel_speeds
from icrtool.config import Config
from icrtool.errors import ConfigError, DataError
from icrtool.records.measurements import AlignmentEstimate, LogFacts, Measurements, SensorData
from icrtool.records.notes import note, notes_about
from icrtool.records.plain_data import finite_or_none
from icrtool.records.run import width_or_usual_m
from icrtool.records.tables import RobotLog


def align(log: RobotLog, config: Config) -> Measurements:
    """Return the streams of a log with their certain errors corrected, and all errors that were found.

    Parameters
    ----------
    log : as `icrtool.read_log` returns it
    config : preset ``paper`` corrects nothing

    Returns
    -------
    Measurements
        The streams with every correction applied, and the findings.

    Raises
    ------
    DataError
        Streams that cannot be used together, or a heading without any relation to the course over ground.
    """
    configured_shifts = NO_SHIFTS
    if config.filter.rules.corrects:
        # Delays are corrected first, because all later steps compare the streams.
        log, config, configured_shifts = with_configured_delays(log, config)
        log = without_interpolated(log)
    log = with_wheel_speeds(log, config)
    if not config.filter.rules.corrects:
        # Preset ``paper`` uses the wheel speeds as sent.
        return _align_once(log, config)
    log, size = with_right_size(without_bad_start(without_frozen(log)), config)
    width = width_or_usual_m(config.robot.track_width_m)
    log, config, shifts = take_shifts(log, config)
    measurements = _align_once(log, config)
    disagreements = find_disagreements(measurements.sensors, width)
    if disagreements.events:
        # The log is aligned again without the events, if the rest of the drive is long enough.
        with suppress(DataError):
            spans = tuple((event.begin_ns, event.end_ns) for event in disagreements.events)
            measurements = _align_once(replace(log, slipping_ns=spans), config)
            disagreements = find_disagreements(measurements.sensors, width)
    filled, bridge = bridge_gaps(measurements.sensors.wheels, config.filter.wheel_gap_s, measurements.sensors.fixes)
    notes = notes_about(log.name, [*shifts.notes, *([] if bridge is None else [bridge])])
    sensors = replace(measurements.sensors, wheels=filled, events=disagreements.events, jumps=disagreements.jumps)
    estimates = with_shifts(with_shifts(measurements.estimates, configured_shifts), shifts)
    measurements = _with_size(replace(measurements, estimates=estimates), size)
    return replace(measurements, sensors=sensors, notes=(*measurements.notes, *notes))


def _with_size(found: Measurements, factor: float) -> Measurements:
    """Return measurements whose wheel scales include the factor by which `with_right_size` multiplied the speeds."""
    if factor == 1.0:
        return found
    facts = found.wheels
    wheels = msgspec.structs.replace(
        facts,
        scale=None if facts.scale is None else factor * facts.scale,
        scale_std=None if facts.scale_std is None else factor * facts.scale_std,
        applied_scale=factor * facts.applied_scale,
        applied_left_scale=factor * facts.applied_left_scale,
        applied_right_scale=factor * facts.applied_right_scale,
    )
    scaled = {
        name: AlignmentEstimate(
            None if estimate.value is None else factor * estimate.value,
            None if estimate.std is None else factor * estimate.std,
            factor * estimate.applied,
            "corrected",
        )
        for name in ("wheel_scale", "left_scale", "right_scale")
        if (estimate := found.estimates.get(name)) is not None
    }
    return replace(found, wheels=wheels, estimates={**found.estimates, **scaled})


def _align_once(log: RobotLog, config: Config) -> Measurements:
    """Return the measurements of a log with wheel speeds in m/s, without slip events and jumps; raise as `align`."""
    streams = align_streams(log, config)
    heading, derived = streams.heading, streams.derived
    fix_steps, heading_steps = streams.steps()
    position_std_m, heading_std_rad = reference_noise(streams.log, config.filter, fix_steps, heading_steps)
    quality = grade_fixes(streams.log, config, fix_steps, position_std_m)
    check_streams(streams.log)
    headings, antenna_m = streams.log.heading, _antenna_m(log, config)
    estimates = alignment_estimates(streams, antenna_m)
    if derived is None:
        noise = heading_variance(headings, config.filter, math.radians(heading.applied_std_deg), heading_std_rad)
        corrected = headings.heading_rad - math.radians(heading.applied_offset_deg)
        headings = replace(headings, heading_rad=corrected, var_rad2=noise)
    sensors = SensorData(
        name=log.name,
        wheels=streams.log.wheels,
        fixes=quality.fixes,
        headings=headings,
        gyro=streams.log.gyro,
        facts=LogFacts(
            heading_from_position=streams.log.heading_is_of_position,
            heading_correlation_s=max(config.filter.heading_correlation_s, streams.correlation_s),
            heading_is_estimated=derived is not None,
            heading_is_measured=math.isfinite(heading_std_rad),
            turn_wander_rad=None if streams.fit is None else finite_or_none(streams.fit.turn_wander_rad),
            antenna_m=antenna_m,
            antenna_is_known=log.antenna_m is not None or config.frames.antenna_right_m != "auto",
            clock_std_s=_clock_std_s(streams),
            heading_common_std_rad=0.0 if derived is None else derived.estimate.common_std,
            heading_sensor=log.heading_sensor,
        ),
        losses_ns=quality.losses_ns,
        attitude=None if derived is None else derived.attitude,
    )
    return Measurements(
        sensors=sensors,
        estimates=estimates,
        wheels=streams.wheels,
        heading=heading,
        streams=streams.log.streams,
        fix_statistics=quality.statistics,
        notes=(*streams.log.notes, *streams.notes, *quality.notes),
    )


def _clock_std_s(streams: AlignedStreams) -> float:
    """Return the standard deviation of the time between position and heading after the correction [s].

    A heading that is estimated by courses over ground has an error from a delay of the positions, so that the time
    between both is known no better than the courses show it. At constant speed it is then known by its prior alone.
    Where a delay was corrected that is longer than the prior's standard deviation, this prior was too narrow, and the
    standard deviation is enlarged in proportion.
    """
    delays, derived = streams.delays, streams.derived
    if derived is None or derived.source not in ("gyro_course", "wheels_course"):
        return delays.clock_std_s
    corrected_s = abs(delays.applied_gnss_s - delays.applied_heading_s)
    by_windows = delays.clock_std_s * max(1.0, corrected_s / float(ESTIMATE_PRIOR_STD[POSITION_LAG]))
    return max(by_windows, float(derived.estimate.constants_std[DELAY]))


def sensors_as_sent(log: RobotLog, config: Config) -> SensorData:
    """Return the streams of a log without any correction, with the noise of each sample, as for simulated logs.

    Raises
    ------
    DataError
        Streams that cannot be used together.
    """
    check_streams(log)
    return SensorData(
        name=log.name,
        wheels=log.wheels,
        fixes=fixes_of(log.gnss, config.filter),
        headings=replace(log.heading, var_rad2=heading_variance(log.heading, config.filter)),
        gyro=log.gyro,
        facts=LogFacts(
            heading_from_position=log.heading_is_of_position,
            heading_correlation_s=config.filter.heading_correlation_s,
            antenna_m=_antenna_m(log, config),
        ),
        losses_ns=np.empty((0, 2), np.int64),
    )


def _antenna_m(log: RobotLog, config: Config) -> tuple[float, float]:
    """Return the antenna's position forward and right [m], body frame: from the configuration, else the log, else 0."""
    forward, right = log.antenna_m if log.antenna_m is not None else (0.0, 0.0)
    frames = config.frames
    return (
        forward if frames.antenna_forward_m == "auto" else frames.antenna_forward_m,
        right if frames.antenna_right_m == "auto" else frames.antenna_right_m,
    )


NOT_A_CORRECTION = "compared with the filter's ICRs"
"""Reason in findings about ICRs, which correct no stream."""


def alignment_estimates(streams: AlignedStreams, antenna_m: tuple[float, float]) -> dict[str, AlignmentEstimate]:
    """Return all estimates of the alignment by their names, which end with the unit.

    Without a fit there are no scales of single sides and no ICRs.

    Parameters
    ----------
    streams : the aligned streams
    antenna_m : position of the antenna in the body frame, forward and right [m]; ICRs refer to the body origin
    """
    wheels, heading, delays = streams.wheels, streams.heading, streams.delays
    offset = None if heading.offset_deg is None else -heading.offset_deg
    estimates = {
        "wheel_scale": _estimate(wheels.scale, wheels.scale_std, wheels.applied_scale, nothing=1.0),
        "heading_offset_deg": _estimate(offset, heading.offset_std_deg, -heading.applied_offset_deg),
        "heading_delay_s": _estimate(*delays.heading, delays.applied_heading_s),
        "position_delay_s": _estimate(*delays.gnss, delays.applied_gnss_s),
        "position_delay_against_heading_s": _estimate(
            *delays.apart, delays.applied_gnss_s - delays.applied_heading_s if not delays.together else 0.0
        ),
    }
    if streams.fit is None:
        return estimates
    (right, left, x, multiplier, left_scale, right_scale), covariance = streams.fit.geometry()
    (forward_m, right_m), width = antenna_m, streams.fit.width_m
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    middle_std = math.sqrt(max(float(covariance[:2, :2].sum()), 0.0)) / 2
    reason = "only the position of the antenna relative to the ICRs is determined"
    return estimates | {
        "left_scale": _estimate(left_scale, std[4], streams.scales[0], nothing=1.0),
        "right_scale": _estimate(right_scale, std[5], streams.scales[1], nothing=1.0),
        "icr_separation_m": AlignmentEstimate(width * multiplier, width * std[3], 0.0, NOT_A_CORRECTION),
        "antenna_forward_minus_x_icr_m": AlignmentEstimate(-x, std[2], forward_m, reason),
        "antenna_right_minus_icr_middle_m": AlignmentEstimate(-(right + left) / 2, middle_std, right_m, reason),
        "y_icr_right_m": AlignmentEstimate(right + right_m, std[0], 0.0, NOT_A_CORRECTION),
        "y_icr_left_m": AlignmentEstimate(left + right_m, std[1], 0.0, NOT_A_CORRECTION),
        "x_icr_m": AlignmentEstimate(x + forward_m, std[2], 0.0, NOT_A_CORRECTION),
    }


def _estimate(value: float | None, std: float | None, applied: float, nothing: float = 0.0) -> AlignmentEstimate:
    """Return an estimate with its correction.

    Parameters
    ----------
    value, std : estimate and its standard deviation; None or not finite if they are not known
    applied : the correction that was applied
    nothing : value of `applied` without a correction
    """
    if value is None or std is None or not math.isfinite(value + std):
        value = std = None
    if applied != nothing:
        why = "corrected"
    elif value is not None:
        why = "not corrected: too small, too uncertain, or not separable from wheel slip"
    else:
        why = "not corrected: this drive does not show it"
    return AlignmentEstimate(value, std, applied, why)


LENGTH_M = 10.0
"""Length of the windows in which references are compared [m]."""

SHARE = 0.9
"""Quantile of the residuals in these windows by which references are compared."""

POOR_M = 1.0
"""Residual up to which the chosen reference is kept [m]. Positions of GNSS are geodetic and do not drift."""

BETTER_RESIDUAL_RATIO = 0.5
"""Largest ratio of the residual of another reference to the residual of the chosen one with which it may replace it."""

LEAST_SHARE_COVERED = 0.7
"""Smallest ratio of the distance that another reference covers to the distance that the chosen one covers, with which
it may replace it."""


class Agreement(NamedTuple):
    """Agreement of a position reference with wheels and heading.

    Attributes
    ----------
    residual_m : quantile `SHARE` of the residuals of displacements over `LENGTH_M` [m]; inf if they cannot be compared
    distance_m : driven distance that the windows cover [m]
    """

    residual_m: float
    distance_m: float


NONE = Agreement(math.inf, 0.0)
"""Agreement of streams that cannot be compared."""


def choose_reference(log: RobotLog, config: Config) -> RobotLog:
    """Return the log with the position reference that its wheels and headings support; preset ``paper``: unchanged."""
    if not log.other_references or not config.filter.rules.corrects or not len(log.heading.stamp_ns):
        return log
    chosen = measure_agreement(log, config)
    if chosen.residual_m <= POOR_M:
        return log
    candidates = [(measure_agreement(other, config), other) for other in log.other_references]
    least = LEAST_SHARE_COVERED * chosen.distance_m
    fit = [(agreement.residual_m, other) for agreement, other in candidates if agreement.distance_m > least]
    residual, best = min(fit, key=lambda candidate: candidate[0], default=(math.inf, log))
    if not residual < min(BETTER_RESIDUAL_RATIO * chosen.residual_m, POOR_M):
        return log
    topics = [candidate.topic("gnss") for candidate in (best, log)]
    against = f"{chosen.residual_m:.2f} m" if math.isfinite(chosen.residual_m) else "not comparable"
    why = f"agrees with wheels and heading within {residual:.2f} m over {LENGTH_M:.0f} m ({topics[1]}: {against})"
    streams = tuple(
        replace(stream, why=f"{stream.why}; {why}") if stream.role == "gnss" else stream for stream in best.streams
    )
    found_better = note(
        "reference_chosen", f"the position reference is {topics[0]}, which {why}; topics.gnss sets it", log.name
    )
    return replace(best, streams=streams, notes=(*best.notes, found_better))


def measure_agreement(log: RobotLog, config: Config) -> Agreement:
    """Return the agreement of the position reference of a log with its wheels and headings."""
    width = width_or_usual_m(config.robot.track_width_m)
    log, config, _ = with_configured_delays(log, config)
    try:
        log = with_wheel_speeds(log, config)
        check_streams(log)
    except (ConfigError, DataError):
        return NONE
    track = track_of_log(log)
    windows = cut_drive_windows(track, length_m=LENGTH_M)
    free = config.frames.heading == "auto"
    decision = decide_conventions(windows, metric=log.datum is None and free, mirror_allowed=free)
    named_log = apply_convention(log, decision.convention)
    fit = estimate_alignment(windows if named_log is log else replace(windows, track=track_of_log(named_log)), width)
    if fit is None:
        return NONE
    count = len(windows.begin)
    size = np.hypot(fit.solution.residuals[:count], fit.solution.residuals[count : 2 * count])
    covered = np.unique(np.floor(track.distance[windows.begin] / LENGTH_M))
    return Agreement(float(np.quantile(size, SHARE)), LENGTH_M * len(covered))
