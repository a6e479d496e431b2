"""Mirrored positions (a wrong sign of latitude or longitude, or both exchanged), found by a heading or a gyro alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from icrtool.alignment.clock_search import with_configured_delays
from icrtool.alignment.conventions import DECISIVE, NamedFit, gyro_sense
from icrtool.alignment.log_track import FEWEST_OVERLAPPING, check_streams, windows_of_log
from icrtool.alignment.turn_rates import Z_UP
from icrtool.alignment.wheel_units import reference_scale, with_wheel_speeds
from icrtool.config import Config
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.arrays import trapezoids, wrapped
from icrtool.records.notes import note
from icrtool.records.run import width_or_usual_m
from icrtool.records.samples import Datum, HeadingSamples, PositionFixes
from icrtool.records.tables import RobotLog

WITNESS_SIGMAS = 5.0
"""Smallest ratio of the heading's turn to the wheels' turn, in its standard deviations. A smaller ratio does not show
that both turn in one sense."""

LEAST_GYRO_TURN_RAD = math.pi / 2
"""Smallest range of the heading by a gyro alone [rad]. The drift of a gyro that turns less may look like a turn."""

EARTH_RADIUS_M, EARTH_ECCENTRICITY_2 = 6_378_137.0, 6.694379990141e-3
"""Equatorial radius [m] and squared eccentricity of the ellipsoid WGS 84."""


def with_right_positions(log: RobotLog, config: Config) -> RobotLog:
    """Return the log with its positions, and their datum, exchanged back where they are mirrored.

    Gyro, heading and wheels are three witnesses of the sense in which the robot turns. Where they agree, and the course
    over ground turns in the other sense, the positions are mirrored. In a log without a heading, gyro and wheels are
    the witnesses; two faults, an exchanged pair of sides and a gyro upside down, would look the same. In a log without
    a gyro, the distances of the wheels show an exchange of latitude and longitude. Metric positions with a heading are
    left to `icrtool.alignment.conventions`. Preset ``paper`` corrects nothing.
    """
    by_gyro = not len(log.heading.stamp_ns)
    if not config.filter.rules.corrects or (not by_gyro and log.datum is None):
        return log
    width = width_or_usual_m(config.robot.track_width_m)
    moved, inner, _ = with_configured_delays(log, config)
    try:
        with_speeds = with_wheel_speeds(moved, inner)
        if log.gyro is None and not log.gyros:
            return _exchanged_by_distance(log, with_speeds)
        if by_gyro:
            with_speeds = _with_turned_heading(with_speeds)
        check_streams(with_speeds)
    except (ConfigError, DataError):
        # A log that cannot be used is refused later, with the reason.
        return log
    windows = windows_of_log(with_speeds, width)
    enough = min(len(windows.begin), len(windows.turn_begin)) >= FEWEST_OVERLAPPING
    as_sent = NamedFit.of(windows) if enough else None
    if (
        as_sent is None
        or as_sent.turn_sigmas < WITNESS_SIGMAS
        or not (by_gyro or gyro_sense(with_speeds, windows.track) > 0)
    ):
        return log
    candidates = []
    for words, candidate in _exchanges(log):
        fixes = candidate.gnss
        track = windows.track._replace(north=fixes.north_m, east=fixes.east_m)
        candidates.append((NamedFit.of(replace(windows, track=track)), words, candidate))
    scatter = min((fit.scatter for fit, _, _ in candidates), default=0.0)
    scatter = max(scatter, 0.5 * windows.track.place_std_m / float(windows.length_m[0]))
    costs = [fit.cost(scatter) for fit, _, _ in candidates]
    gain = as_sent.cost(scatter) - min(costs, default=math.inf)
    if not gain > DECISIVE:
        return log
    near = [candidate for candidate, cost in zip(candidates, costs, strict=True) if cost < min(costs) + DECISIVE]
    if by_gyro:
        # Without a heading nothing decides between exchanges that fit equally well: their paths differ by a turn.
        exchange, corrected = " or ".join(words for _, words, _ in near), near[0][2]
        witnesses = "gyro and wheels, which agree"
        exchange += " (or the gyro is upside down, and the sides are exchanged)"
    else:
        # The offset of the heading decides between exchanges that fit equally well.
        _, exchange, corrected = min(near, key=lambda candidate: abs(candidate[0].offset_rad))
        witnesses = "gyro, heading and wheels, which agree"
    text = (
        f"the positions turn in the opposite sense to {witnesses}: {exchange}; corrected "
        f"(twice the gain in log-likelihood {gain:.0f}, decisive from {DECISIVE:.0f} on)"
    )
    return replace(corrected, notes=(*corrected.notes, note("positions_mirrored", text, log.name)))


def _exchanged_by_distance(log: RobotLog, named: RobotLog) -> RobotLog:
    """Return the log with latitude and longitude exchanged where its distances then fit the wheels; else the log.

    A degree of latitude and a degree of longitude have other lengths: where they are exchanged, the distance of the
    positions per distance of the wheels varies with the direction. Of two scatters s of n spans, twice the gain in
    log-likelihood is 2 n log(s_1/s_2).

    Parameters
    ----------
    named : the same log with wheel speeds
    """
    other = None if log.datum is None else _both_exchanged(log, log.datum)
    if other is None:
        return log
    wheels = named.wheels
    sent, back = (
        reference_scale(wheels.stamp_ns, wheels.v_left_mps, wheels.v_right_mps, candidate.gnss)
        for candidate in (named, other)
    )
    if sent is None or back is None or not min(sent.value, sent.std, back.value, back.std) > 0.0:
        return log
    ratio = (sent.std / sent.value * math.sqrt(sent.spans)) / (back.std / back.value * math.sqrt(back.spans))
    gain = 2.0 * min(sent.spans, back.spans) * math.log(ratio)
    if not gain > DECISIVE:
        return log
    text = (
        "the distances of the positions fit the wheels' in all directions where latitude and longitude are exchanged: "
        f"corrected (twice the gain in log-likelihood {gain:.0f}, decisive from {DECISIVE:.0f} on)"
    )
    return replace(other, notes=(*other.notes, note("positions_mirrored", text, log.name)))


def _with_turned_heading(log: RobotLog) -> RobotLog:
    """Return the log with the integral of its gyro (z up) as heading; without a heading if no gyro turns enough.

    The heading starts at any angle.

    The bias of the gyro is its rate where the wheels do not turn, by regression on their turn.
    """
    for gyro in log.gyros:
        rate = gyro.rates_radps @ Z_UP
        wheels = log.wheels.v_left_mps - log.wheels.v_right_mps
        apart = np.interp(gyro.stamp_ns, log.wheels.stamp_ns, wheels)
        finite = np.isfinite(rate) & np.isfinite(apart)
        if np.count_nonzero(finite) < FEWEST_OVERLAPPING or not np.ptp(apart[finite]) > 0.0:
            continue
        stamps, rate, apart = gyro.stamp_ns[finite], rate[finite], apart[finite]
        # On a straight drive the regression has many solutions: the solution of least norm is taken.
        bias = np.linalg.lstsq(np.column_stack([apart, np.ones(len(apart))]), rate)[0][1]
        heading = trapezoids((stamps - stamps[0]) / 1e9, rate - bias)
        if np.ptp(heading) > LEAST_GYRO_TURN_RAD:
            return replace(log, heading=HeadingSamples(stamps, wrapped(heading), np.full(len(stamps), np.nan)))
    return log


def _exchanges(log: RobotLog) -> list[tuple[str, RobotLog]]:
    """Return the possible exchanges of a log's positions: each in words, with the log after it is undone."""
    if log.datum is None:
        mirrored = replace(log.gnss, east_m=-log.gnss.east_m, cov_north_east_m2=-log.gnss.cov_north_east_m2)
        return [("two axes are exchanged, or one has the other sign", replace(log, gnss=mirrored))]
    tried = ((words, exchange(log, log.datum)) for words, exchange in EXCHANGES)
    return [(words, candidate) for words, candidate in tried if candidate is not None]


def _exchanged(log: RobotLog, datum: Datum, exchange: Callable[[PositionFixes], PositionFixes]) -> RobotLog:
    """Return a log with another datum and exchanged positions of all its receivers."""
    others = tuple(replace(receiver, fixes=exchange(receiver.fixes)) for receiver in log.other_receivers)
    return replace(log, datum=datum, gnss=exchange(log.gnss), other_receivers=others)


def _other_longitude(log: RobotLog, datum: Datum) -> RobotLog | None:
    """Return the log with the other sign of its longitudes."""
    return _exchanged(
        log, replace(datum, longitude_deg=-datum.longitude_deg),
        lambda fixes: replace(fixes, east_m=-fixes.east_m, cov_north_east_m2=-fixes.cov_north_east_m2),
    )  # fmt: skip


def _other_latitude(log: RobotLog, datum: Datum) -> RobotLog | None:
    """Return the log with the other sign of its latitudes."""
    return _exchanged(
        log, replace(datum, latitude_deg=-datum.latitude_deg),
        lambda fixes: replace(fixes, north_m=-fixes.north_m, cov_north_east_m2=-fixes.cov_north_east_m2),
    )  # fmt: skip


def _both_exchanged(log: RobotLog, datum: Datum) -> RobotLog | None:
    """Return the log with latitude and longitude exchanged; None where the longitude cannot be a latitude."""
    if abs(datum.longitude_deg) >= 90.0:
        return None
    of_north, of_east = metres_per_radian(datum.latitude_deg)
    to_north, to_east = metres_per_radian(datum.longitude_deg)
    north, east = to_north / of_east, to_east / of_north
    return _exchanged(
        log, Datum(datum.longitude_deg, datum.latitude_deg, datum.height_m),
        lambda fixes: replace(
            fixes, north_m=north * fixes.east_m, east_m=east * fixes.north_m, var_north_m2=north**2 * fixes.var_east_m2,
            var_east_m2=east**2 * fixes.var_north_m2, cov_north_east_m2=north * east * fixes.cov_north_east_m2,
        ),
    )  # fmt: skip


def metres_per_radian(latitude_deg: float) -> tuple[float, float]:
    """Return metres to the north per radian of latitude, and to the east per radian of longitude (WGS 84)."""
    phi = math.radians(latitude_deg)
    w = math.sqrt(1.0 - EARTH_ECCENTRICITY_2 * math.sin(phi) ** 2)
    return EARTH_RADIUS_M * (1.0 - EARTH_ECCENTRICITY_2) / w**3, EARTH_RADIUS_M * math.cos(phi) / w


EXCHANGES: tuple[tuple[str, Callable[[RobotLog, Datum], RobotLog | None]], ...] = (
    ("the longitude has the other sign", _other_longitude),
    ("the latitude has the other sign", _other_latitude),
    ("latitude and longitude are exchanged", _both_exchanged),
)
"""Possible exchanges of geodetic positions: each in words, with a function that undoes the exchange in a log."""
