"""The heading of a log: as a sensor states it, or estimated from turn rates, positions and pairs of antennas."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from icrtool.alignment.drive_windows import DriveArrays, drive_arrays, fix_std_m
from icrtool.alignment.gyro_heading import HeadingEstimate, TurnRate, estimate_heading, measure_courses
from icrtool.alignment.heading_alignment import NOISY_SCATTER_RAD
from icrtool.errors import DataError
from icrtool.records.tables import Floats, GyroAxes, HeadingSamples, PositionFixes, RobotLog, StreamChoice

Source = Literal["orientation", "antennas", "gyro", "wheels", "fused"]

LARGEST_START_STD_RAD = math.radians(5.0)
"""Headings less certain than this are not given to the filter."""

LARGEST_RATE_HZ = 20.0
CORRELATION_S = 5.0
"""An estimated heading errs alike for about this long: a few courses."""

SHORTEST_BASELINE_M = 0.2
PAIR_S = 0.25
"""Headings of the baseline are averaged over this time."""

WHEEL_TURN = 0.6
"""Skid-steer robots turn about this much of what their wheels would without slip."""

RESPONSE_S = 0.15
"""How late robots answer their wheels; measured on rigid-body simulated ones: 0.1 s."""

BETTER = 0.01
"""A sensor axis other than z up is taken where successive courses agree by this much more (mean cosine)."""


@dataclass(frozen=True, slots=True)
class DerivedHeading:
    """A heading that was estimated.

    Attributes
    ----------
    source : what it was made of; topics : of it
    estimate : causal and smoothed; causal, smoothed : the same as samples, the causal ones for the filter
    why : how sure, for the user
    """

    source: Source
    topic: str
    estimate: HeadingEstimate
    causal: HeadingSamples
    smoothed: HeadingSamples
    why: str

    def apply(self, log: RobotLog) -> RobotLog:
        """Return the log with the causal heading."""
        rate = 1e9 / float(np.median(np.diff(self.causal.stamp_ns)))
        stream = StreamChoice(
            "heading", self.topic, "estimated", len(self.causal.stamp_ns), rate, "header", 0.0, self.why
        )
        streams = (*(one for one in log.streams if one.role != "heading"), stream)
        return replace(log, heading=self.causal, streams=streams)


def derive_heading(log: RobotLog, width_m: float) -> DerivedHeading:
    """Estimate the heading of a log without one, from the best of what it holds.

    Raises
    ------
    DataError
        Too little distance.
    """
    if min(len(log.wheels.stamp_ns), len(log.gnss.stamp_ns)) < 2:
        raise DataError(
            log.name, "no heading in it, and too few wheel or position samples", "record at least two of each"
        )
    drive = drive_arrays(log)
    epoch = int(log.wheels.stamp_ns[0])
    turns = [turn for turn in (_vertical_rate(drive, gyro, epoch) for gyro in log.gyros) if turn is not None]
    pairs = [pair for pair in (_baseline(log, other.fixes) for other in log.other_receivers) if pair is not None]
    pair = max(pairs, key=lambda one: one[0]) if pairs else None
    found, turn, source, topic = None, _wheel_turn(drive, width_m), "wheels", "wheels"
    for _, rate, name in turns:
        # of several units, the one that follows the courses best
        one = estimate_heading(drive, rate, None if pair is None else pair[1], absolute_walk=0.0)
        if one is not None and (found is None or _median_std(one) < _median_std(found)):
            found, turn, source, topic = one, rate, "gyro", name
    if found is None:
        found = estimate_heading(drive, turn, None if pair is None else pair[1], absolute_walk=0.0, stands=False)
    if found is None:
        raise DataError(
            log.name, "no heading in it, and too little distance to find one from positions", "drive some metres"
        )
    std = math.degrees(_median_std(found))
    places = next((stream.topic for stream in log.streams if stream.role == "gnss"), "positions")
    if pair is not None:
        source, topic = "antennas", f"{log.other_receivers[0].topic} + {topic}"
    words = {
        "antennas": f"two antennas {0.0 if pair is None else pair[0]:.2f} m apart, turn rate and course over ground",
        "gyro": f"turn rate and course over ground, bias {math.degrees(found.constants[1]):+.2f} deg/s at the end",
        "wheels": "course over ground and wheels: no usable turn rate in the log",
    }
    why = f"{words[source]}, σ {std:.2f}°"
    if source == "wheels":
        found = _with_response(found, turn)
    causal, smoothed = _samples(found, epoch)
    return DerivedHeading(source, f"{topic} + {places}", found, causal, smoothed, why)  # type: ignore[arg-type]


def _with_response(found: HeadingEstimate, turn: TurnRate) -> HeadingEstimate:
    """Add what a robot's late response to its wheels turns a heading by."""
    extra = RESPONSE_S * np.abs(np.interp(found.t, turn.t, turn.rate))
    return replace(
        found,
        causal_std=np.hypot(found.causal_std, extra),
        smoothed_std=np.hypot(found.smoothed_std, extra),
    )


def _samples(found: HeadingEstimate, epoch: int) -> tuple[HeadingSamples, HeadingSamples]:
    """Return causal and smoothed headings as samples, at most `LARGEST_RATE_HZ`."""
    interval = float(np.median(np.diff(found.t)))
    rows = np.arange(0, len(found.t), max(1, round(1.0 / (LARGEST_RATE_HZ * interval))))
    stamps = epoch + np.round(found.t[rows] * 1e9).astype(np.int64)

    def as_samples(psi: Floats, std: Floats, some: slice) -> HeadingSamples:
        return HeadingSamples(stamps[some], np.angle(np.exp(1j * psi[rows]))[some], (std[rows] ** 2)[some])

    sure = found.causal_std[rows] < max(LARGEST_START_STD_RAD, 2.0 * float(np.median(found.causal_std)))
    first = int(np.argmax(sure))
    return (
        as_samples(found.causal, found.causal_std, slice(first, None)),
        as_samples(found.smoothed, found.smoothed_std, slice(None)),
    )


def _median_std(found: HeadingEstimate) -> float:
    return float(np.median(found.smoothed_std))


def as_turn_rate(log: RobotLog, scatter_rad: float, width_m: float) -> RobotLog | None:
    """Return a log whose heading is a turn rate only, where it drifts and its rate gives a better one; else None.

    An orientation without a magnetometer is an integrated gyro: its offset wanders with the bias.

    Parameters
    ----------
    scatter_rad : of the heading about the course over ground
    width_m : the track width b
    """
    if scatter_rad < NOISY_SCATTER_RAD:
        return None
    rate = rate_of_heading(log)
    if rate is None:
        return None
    nothing = HeadingSamples(np.empty(0, np.int64), np.empty(0), np.empty(0))
    streams = tuple(one for one in log.streams if one.role != "heading")
    note = (
        f"{log.name}: the heading drifts ({math.degrees(scatter_rad):.0f}° about the course): only turn rates are used"
    )
    bare = replace(log, heading=nothing, gyros=(*log.gyros, rate), streams=streams, warnings=(*log.warnings, note))
    try:
        found = derive_heading(bare, width_m)
    except DataError:
        return None
    std = _median_std(found.estimate)
    return bare if found.source != "wheels" and std < min(scatter_rad / 2, NOISY_SCATTER_RAD) else None


def rate_of_heading(log: RobotLog) -> GyroAxes | None:
    """Return the turn rate of the measured heading about a sensor's upward axis; None with too few samples."""
    heading = log.heading
    stamps, rows = np.unique(heading.stamp_ns, return_index=True)
    if len(stamps) < 3:
        return None
    turned = np.diff(np.unwrap(heading.heading_rad)[rows])
    rate = -turned / (np.diff(stamps) / 1e9)
    topic = next((stream.topic for stream in log.streams if stream.role == "heading"), "heading")
    return GyroAxes(topic, stamps[:-1] + np.diff(stamps) // 2, np.repeat(rate[:, None], 3, axis=1))


def _wheel_turn(drive: DriveArrays, width_m: float) -> TurnRate:
    rate = WHEEL_TURN * (drive.v_left - drive.v_right) / width_m
    return TurnRate(drive.wheel_t, rate, scale_std=0.5, bias_std=math.radians(0.5))


def _vertical_rate(drive: DriveArrays, gyro: GyroAxes, epoch: int) -> tuple[float, TurnRate, str] | None:
    """Return how well successive courses agree, the turn rate about the vertical, and the topic.

    Each axis of the sensor is tried in both senses: z up, z down, mounted on its side.
    """
    t = (gyro.stamp_ns - epoch) / 1e9
    found: list[tuple[float, TurnRate, str]] = []
    for axis in (2, 0, 1):
        for sign in (-1.0, 1.0):
            turn = TurnRate(t, sign * gyro.rates_radps[:, axis])
            courses = measure_courses(drive, turn)
            if len(courses.end) < 3:
                continue
            near = np.diff(courses.begin) < 30.0
            change = np.diff(courses.angle - np.interp(courses.end, t, turn.integrated()))
            score = float(np.cos(change[near]).mean()) if near.any() else -1.0
            found.append(
                (score - (0.0 if not found else BETTER), turn, f"{'xyz'[axis]} {'up' if sign < 0 else 'down'}")
            )
    if not found:
        return None
    score, turn, axis_text = max(found, key=lambda one: one[0])
    topic = gyro.topic if axis_text == "z up" else f"{gyro.topic} ({axis_text})"
    return score, turn, topic


def _baseline(log: RobotLog, other: PositionFixes) -> tuple[float, tuple[Floats, Floats, Floats]] | None:
    """Return length [m] and headings (t, rad, std) of the line from the chosen antenna to another one."""
    mine = log.gnss
    if min(len(mine.stamp_ns), len(other.stamp_ns)) < 2:
        return None
    epoch = int(log.wheels.stamp_ns[0])
    t, s = (mine.stamp_ns - epoch) / 1e9, (other.stamp_ns - epoch) / 1e9
    after = np.clip(np.searchsorted(s, t), 1, len(s) - 1)
    near = (t >= s[0]) & (t <= s[-1]) & (s[after] - s[after - 1] < 3.0 * float(np.median(np.diff(s))))
    there = np.interp(t, s, other.north_m) + 1j * np.interp(t, s, other.east_m)
    line = (there - (mine.north_m + 1j * mine.east_m))[near]
    if len(line) < 2:
        return None
    length = float(np.median(np.abs(line)))
    noise = math.hypot(fix_std_m(mine), fix_std_m(other))
    if length < max(SHORTEST_BASELINE_M, 4.0 * noise):
        return None
    good = np.abs(np.abs(line) - length) < max(5.0 * noise, 0.05 * length)
    if np.count_nonzero(good) < len(good) / 2:
        return None
    line, at = line[good], t[near][good]
    cell = np.unique(np.floor(at / PAIR_S), return_inverse=True)[1]
    count = np.bincount(cell)
    mean = (np.bincount(cell, line.real) + 1j * np.bincount(cell, line.imag)) / count
    return length, (np.bincount(cell, at) / count, np.angle(mean), noise / length / np.sqrt(count))
