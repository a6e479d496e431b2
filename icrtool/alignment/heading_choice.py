"""The heading of a log: as a sensor states it, or estimated from turn rates, positions, antennas and this sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from icrtool.alignment.estimator import ATTITUDE_STD_RAD
from icrtool.alignment.gyro_heading import (
    LAG,
    WANDERS,
    AbsoluteHeading,
    HeadingEstimate,
    estimate_heading,
)
from icrtool.alignment.log_track import fix_std_m, track_of_log
from icrtool.alignment.sensor_noise import is_hole
from icrtool.alignment.sparse_reference import are_rare
from icrtool.alignment.turn_rates import BETTER_SCATTER_RATIO, TurnRate, course_changes, gyro_rates, wheel_rate
from icrtool.alignment.wheel_alignment import compare_turns
from icrtool.alignment.wheel_units import refuse_standing
from icrtool.errors import DataError
from icrtool.kernels.arrays import Bools, Floats, rows_of_cells, trapezoids, unwrapped, wrapped
from icrtool.kernels.robust import mad_std
from icrtool.kernels.track import Track
from icrtool.records.notes import note
from icrtool.records.samples import (
    NO_HEADINGS,
    GyroAxes,
    GyroSamples,
    HeadingSamples,
    StreamChoice,
    without_repeats,
)
from icrtool.records.tables import RobotLog

ATTITUDE_CELL_S, PAIR_CELL_S = 1.0, 0.5
"""Times over which headings of an attitude sensor and of a pair of antennas are averaged, corrected for the turn
[s]."""

SHORTEST_BASELINE_M = 0.2
"""Smallest distance of two antennas whose bearing is used [m]."""

LEAST_ATTITUDE_STD_RAD = math.radians(0.01)
"""Smallest white noise of an attitude sensor's heading [rad]."""


def antenna_bearing(log: RobotLog, turn: TurnRate) -> AbsoluteHeading | None:
    """Return the bearing from the chosen antenna to the furthest other antenna; None without a bearing."""
    fixes, epoch = log.gnss, int(log.wheels.stamp_ns[0])
    best, baseline_m = None, 0.0
    for topic, other in ((receiver.topic, receiver.fixes) for receiver in log.other_receivers):
        if min(len(fixes.stamp_ns), len(other.stamp_ns)) < 2:
            continue
        t, s = (fixes.stamp_ns - epoch) / 1e9, (other.stamp_ns - epoch) / 1e9
        after = np.clip(np.searchsorted(s, t), 1, len(s) - 1)
        near = (t >= s[0]) & (t <= s[-1]) & ~is_hole(np.diff(s))[after - 1]
        there = np.interp(t, s, other.north_m) + 1j * np.interp(t, s, other.east_m)
        line = (there - (fixes.north_m + 1j * fixes.east_m))[near]
        length = float(np.median(np.abs(line))) if len(line) > 1 else 0.0
        noise = math.hypot(fix_std_m(fixes), fix_std_m(other))
        good = np.abs(np.abs(line) - length) < max(5.0 * noise, 0.05 * length)
        short = length < max(SHORTEST_BASELINE_M, 4.0 * noise) or length <= baseline_m
        if not short and np.count_nonzero(good) >= len(good) / 2:
            cells = _average_cells(t[near][good], np.angle(line[good]), turn, PAIR_CELL_S)
            part = f"two antennas {length:.2f} m apart"
            best, baseline_m = cells._replace(std=noise / length * cells.std, topic=topic, part=part), length
    return best


def _average_cells(t: Floats, angle: Floats, turn: TurnRate, cell_s: float) -> AbsoluteHeading:
    """Return mean headings over cells of time, at each cell's last sample; `std` is a ratio to the noise of a sample.

    The turn rate moves the samples of a cell to the cell's end, so that the mean is causal.
    """
    inside = (t >= turn.t[0]) & (t <= turn.t[-1])
    t, angle = t[inside], angle[inside]
    if not len(t):
        return AbsoluteHeading(t, angle, angle, angle)
    turned = np.interp(t, turn.t, turn.integrated)
    first = rows_of_cells(t, lambda times: np.floor(times / cell_s))
    count = np.diff(first, append=len(t))
    last = first + count - 1
    mean = np.add.reduceat(np.exp(1j * (angle - turned)), first)
    rate = np.add.reduceat(np.interp(t, turn.t, turn.rate), first) / count
    return AbsoluteHeading(t[last], np.angle(mean * np.exp(1j * turned[last])), 1.0 / np.sqrt(count), rate)


LARGEST_START_STD_RAD = math.radians(5.0)
"""Largest standard deviation of headings that are given to the filter at its start [rad]."""

LARGEST_DRIFT = math.radians(10.0)
"""Random walk of a gyro's integral from which on it is dead or in another unit [rad/sqrt(s)]. Wheels may then be
better."""

TURNS_COMPARED_S = 1.0
"""Time over which the turns of gyro and wheels are compared [s]."""

RESIDUAL_SHARE = 0.3
"""Largest scatter of the gyro's turns about the wheels' turns, as a share of the rms turn, at which both agree. A
conflict with the course over ground is then attributed to the fixes."""

LEAST_GAIN, LARGEST_GAIN = 0.15, 1.3
"""Smallest and largest ratio of the gyro's turns to the wheels' turns at which both agree."""

NOISY_SCATTER_RAD = math.radians(6.0)
"""Scatter about the course over ground above which a heading drifts or is noise [rad]. Attitude sensors scatter
less."""


@dataclass(frozen=True, slots=True)
class DerivedHeading:
    """A heading that was estimated.

    Attributes
    ----------
    source : source of the heading, as in `HeadingFacts`
    topic : topics of the sensors, joined by " + "
    estimate : causal and smoothed heading with their standard deviations
    causal, smoothed : the headings of the estimate as samples; the filter uses the causal ones
    gyro : the turn rate that was used; None if the wheels' turn rate was used
    attitude : the attitude sensor's own heading, corrected by the offset of the estimate; None where none was used
    why : the sensors and the standard deviation of the heading, for the user
    measured_t : times of courses over ground [s] where fixes are rare and the wheels carry the heading in between; else
        None
    """

    source: str
    topic: str
    estimate: HeadingEstimate
    causal: HeadingSamples
    smoothed: HeadingSamples
    gyro: GyroSamples | None
    attitude: HeadingSamples | None
    why: str
    measured_t: Floats | None = None

    def apply(self, log: RobotLog) -> RobotLog:
        """Return the log with the causal heading, for the filter, and the turn rate that agrees with it."""
        heading = self.causal
        rate = 1e9 / float(np.median(np.diff(heading.stamp_ns)))
        stream = StreamChoice("heading", self.topic, "estimated", len(heading.stamp_ns), rate, "header", 0.0, self.why)
        streams = (*(choice for choice in log.streams if choice.role != "heading"), stream)
        return replace(log, heading=heading, streams=streams, gyro=self.gyro if self.gyro is not None else log.gyro)


def derive_heading(log: RobotLog, width_m: float) -> DerivedHeading:
    """Return the estimated heading of a log without a heading, from its best sources.

    Raises
    ------
    DataError
        Too little distance, or a robot on a stand.
    """
    if min(len(log.wheels.stamp_ns), len(log.gnss.stamp_ns)) < 2:
        refuse_standing(log)
        raise DataError(
            log.name, "no heading in it, and too few wheel or position samples", "record at least two of each"
        )
    track = track_of_log(log)
    by_gyro = _with_gyro(log, track, None)
    alive = by_gyro is not None and by_gyro.estimate.noises["angle"] < LARGEST_DRIFT
    if by_gyro is not None and (alive or _follows_wheels(by_gyro, track, width_m, log)):
        return by_gyro
    why = "no turn rate in the log"
    if by_gyro is not None:
        why = "the turn rate drifts more"
    elif log.gyros:
        why = "the turn rate does not cover enough of the drive"
    by_wheels = _derive_with_rate(log, track, wheel_rate(track, width_m), None, None, instead=why)
    if by_wheels is not None and (by_gyro is None or by_wheels.estimate.median_std < by_gyro.estimate.median_std):
        return by_wheels
    if by_gyro is None:
        refuse_standing(log)
        raise DataError(
            log.name,
            f"no heading in it, and a drive of {track.travel[-1]:.0f} m is too short to find one from positions of "
            f"±{track.place_std_m:.2f} m",
            "record an orientation (AHRS), use RTK, or drive several times as far",
        )
    return by_gyro


def fuse_heading(log: RobotLog, track: Track) -> DerivedHeading | None:
    """Return the heading estimated from gyro, course over ground and the heading that the log states.

    None without a gyro, with a dead gyro, where the stated heading alone is equally good, and where the stated heading
    comes from the position reference.

    Parameters
    ----------
    log : the log
    track : track of the log
    """
    if track.same_clock:
        return None
    fused = _with_gyro(log, track, log.heading)
    if fused is None or fused.estimate.noises["angle"] >= LARGEST_DRIFT:
        return None
    return fused if fused.estimate.median_std <= math.hypot(fused.estimate.noises[WANDERS], ATTITUDE_STD_RAD) else None


def _follows_wheels(derived: DerivedHeading, track: Track, width_m: float, log: RobotLog) -> bool:
    """Return whether the turns of a gyro agree with the turns of wheels that may slip, in windows of time."""
    if derived.gyro is None:
        return False
    t = (derived.gyro.stamp_ns - int(log.wheels.stamp_ns[0])) / 1e9
    by_gyro = track._replace(heading_t=t, heading=trapezoids(t, derived.gyro.rate_radps), measured_t=None)
    return any(
        comparison.residual_rad < RESIDUAL_SHARE * comparison.turn_rad and LEAST_GAIN < comparison.ratio < LARGEST_GAIN
        for comparison in compare_turns(by_gyro, width_m, 0.0, (TURNS_COMPARED_S,))
    )


def _with_gyro(log: RobotLog, track: Track, stated: HeadingSamples | None) -> DerivedHeading | None:
    """Return the estimate with the gyro that follows the courses over ground best; None where none covers them."""
    if not log.gyros:
        return None
    best_heading, least, changes, epoch = None, math.inf, course_changes(track), int(log.wheels.stamp_ns[0])
    for gyro in log.gyros:
        rates = gyro_rates(track, changes, gyro, epoch)
        # With a stated heading only the usual mounting is tried, because that heading would fit to both senses.
        for row, (turn, axis) in enumerate(rates if stated is None else rates[:1]):
            topic = gyro.topic if axis == "z up" else f"{gyro.topic} ({axis})"
            candidate = _derive_with_rate(log, track, turn, topic, stated)
            std = math.inf if candidate is None else candidate.estimate.median_std
            std *= 1.0 if row else BETTER_SCATTER_RATIO
            if std < least:
                best_heading, least = candidate, std
    return best_heading


def _derive_with_rate(
    log: RobotLog, track: Track, turn: TurnRate, gyro_topic: str | None, stated: HeadingSamples | None,
    instead: str = "",
) -> DerivedHeading | None:  # fmt: skip
    """Return the estimate with a turn rate, a stated heading and other antennas; None with too few courses.

    Parameters
    ----------
    gyro_topic : topic of the turn rate; None: it is the wheels' turn rate, for the reason `instead`
    """
    epoch, absolute = int(log.wheels.stamp_ns[0]), list[AbsoluteHeading]()
    if stated is not None:
        # The stated heading gets the white noise that it shows relative to the turn rate.
        measured = track.seen_heading_t
        attitude_cells = _average_cells(measured, track.heading_at(measured), turn, ATTITUDE_CELL_S)
        step = np.diff(attitude_cells.heading - np.interp(attitude_cells.t, turn.t, turn.integrated))
        noise = mad_std(wrapped(step - np.median(step))) / math.sqrt(2.0) if len(step) else 0.0
        std = np.full(len(attitude_cells.t), max(noise, LEAST_ATTITUDE_STD_RAD))
        topic = log.topic("heading", "orientation")
        absolute.append(attitude_cells._replace(std=std, aligned_std=ATTITUDE_STD_RAD, topic=topic, part="orientation"))
    bearing = antenna_bearing(log, turn)
    absolute += [bearing] if bearing is not None else []
    estimate = estimate_heading(track, turn, absolute, stands=gyro_topic is not None)
    if estimate is None:
        return None
    bias = f"turn rate (bias {math.degrees(estimate.constants[1]):+z.2f} deg/s at the end)"
    parts = [*(sensor.part for sensor in absolute), bias if gyro_topic else f"wheels ({instead})", "course over ground"]
    names = [*(sensor.topic for sensor in absolute), gyro_topic or "wheels", log.topic("gnss", "positions")]
    source = "gyro_course" if gyro_topic else "wheels_course"
    if bearing is not None:
        source = "antenna_pair"
    attitude = None
    if stated is not None:
        source = "fused"
        parts[0] += f" (error {math.degrees(estimate.noises[WANDERS]):.1f}°)"
        lag = round(float(estimate.constants[LAG]) * 1e9)
        attitude = HeadingSamples(
            stated.stamp_ns - lag, stated.heading_rad - estimate.offset[0], without_repeats(stated.var_rad2)
        )
    stamps, turn_stamps = (epoch + np.round(t * 1e9).astype(np.int64) for t in (estimate.t, turn.t))
    causal, smoothed = wrapped(estimate.causal), wrapped(estimate.smoothed)
    # The causal heading begins where it is known, and begins again after a hole of the turn rate.
    std = estimate.causal_std
    clear = is_heading_known(estimate.t, std, turn.holes)
    return DerivedHeading(
        source,
        " + ".join(names),
        estimate,
        HeadingSamples(stamps[clear], causal[clear], std[clear] ** 2),
        HeadingSamples(stamps, smoothed, estimate.smoothed_std**2),
        GyroSamples(gyro_topic, turn_stamps, turn.rate) if gyro_topic else None,
        attitude,
        f"{', '.join(parts)}; σ {math.degrees(estimate.median_causal_std):.2f}°",
        None if gyro_topic or not are_rare(track) else estimate.seen_t,
    )


def is_heading_known(t: Floats, std: Floats, holes: Floats) -> Bools:
    """Return which causal headings (n,) are known: not the first ones, nor those after a hole, while sigma is large.

    The headings that are left out share one error: the error at the start, or the error of the turn in the hole. The
    filter would treat it as many independent errors.

    Parameters
    ----------
    t : (n,) stamps of the headings [s]
    std : (n,) standard deviations of the headings [rad]
    holes : (m, 2) starts and ends of the holes of the turn rate [s]
    """
    clear = std < max(LARGEST_START_STD_RAD, 2.0 * float(np.median(std)))
    is_known, clear_rows = np.ones(len(t), np.bool_), np.flatnonzero(clear)
    for begin, until in ((-math.inf, -math.inf), *holes.tolist()):
        first = int(np.searchsorted(t, begin, side="right"))
        after = int(np.searchsorted(clear_rows, max(first, int(np.searchsorted(t, until)))))
        if after < len(clear_rows) or math.isfinite(begin):
            unclear = slice(first, clear_rows[after] if after < len(clear_rows) else None)
            is_known[unclear] &= clear[unclear]
    return is_known


def as_turn_rate(log: RobotLog, scatter_rad: float, width_m: float) -> RobotLog | None:
    """Return a log with only the turn rate of its heading, where the heading drifts and the rate is better; else None.

    An orientation without a magnetometer is an integrated gyro. Its offset drifts with the bias.

    Parameters
    ----------
    log : the log
    scatter_rad : scatter of the heading about the course over ground [rad]
    width_m : the track width b [m]
    """
    if scatter_rad < NOISY_SCATTER_RAD:
        return None
    stamps, rows = np.unique(log.heading.stamp_ns, return_index=True)
    if len(stamps) < 3:
        return None
    # The rate is about the upward axis of the sensor.
    rates = np.zeros((len(stamps) - 1, 3))
    rates[:, 2] = -np.diff(unwrapped(log.heading.heading_rad)[rows]) / (np.diff(stamps) / 1e9)
    gyro = GyroAxes(log.topic("heading", "heading"), stamps[:-1] + np.diff(stamps) // 2, rates)
    why = (
        f"the heading drifts ({math.degrees(scatter_rad):.0f}° about the course over ground): only turn rates are used"
    )
    bare = replace(without_heading(log, why), gyros=(*log.gyros, gyro))
    try:
        derived = derive_heading(bare, width_m)
    except DataError:
        return None
    std = derived.estimate.median_std
    return bare if derived.source != "wheels_course" and std < min(scatter_rad / 2, NOISY_SCATTER_RAD) else None


def without_heading(log: RobotLog, why: str) -> RobotLog:
    """Return the log without its heading, so that a heading is estimated; `why` is reported."""
    streams = tuple(stream for stream in log.streams if stream.role != "heading")
    return replace(
        log, heading=NO_HEADINGS, streams=streams, notes=(*log.notes, note("heading_left_out", why, log.name))
    )
