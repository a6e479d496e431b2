"""Wheel speeds in m/s from the values of a log: metres per unit by the configuration, else by the position reference.

A robot that does not move, for example on a stand, shows no unit and is refused here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icrtool.alignment.estimator import EVIDENCE_SIGMAS
from icrtool.alignment.log_track import (
    CHORD_S,
    FEWEST_ALIGNMENT_WINDOWS,
    LEAST_CHORD_M,
    DriveWindows,
    chord_s,
    cut_chords,
    rows_of_chords,
    track_of_streams,
)
from icrtool.alignment.sparse_reference import wheel_path
from icrtool.config import Config, builtin_robots
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.kernels.robust import mad_std
from icrtool.records.notes import Note, note, notes_about
from icrtool.records.run import ROLLING_SCALE
from icrtool.records.samples import NO_HEADINGS, PositionFixes, WheelSamples, WheelUnit
from icrtool.records.tables import RobotLog
from icrtool.records.text import counted

WELL_FITTED = 0.1
"""Largest misfit of the wheels' path between rare fixes at which its length is compared, `WheelPath.misfit`."""

LARGEST_STRAIGHT_DIFFERENCE = 0.1
"""Largest relative difference of the sides' distances in the straight spans in which wheels and position reference are
compared."""

LARGEST_BENT_DIFFERENCE = 1.0
"""Largest relative difference of the sides' distances in bent spans. They are used if too few spans are straight."""

LARGEST_BEND_RAD = 1.2
"""Largest change of direction in bent spans [rad]."""

FASTEST_MPS = 100.0
"""Largest possible wheel speed [m/s]. A larger number is damaged, and would give any distance."""

LEAST_SPIKE_MPS = 3.0
"""Smallest speed of a spike [m/s]. A spike is a single sample that is not a motion of the robot."""

LEAST_SPIKE_RATIO = 10.0
"""Smallest ratio of a spike to its neighbours, and to the usual speed."""

USUAL_QUANTILE = 0.995
"""Quantile of the speeds that is the usual speed."""

GAP_IN_USUAL = 2.5
"""Shortest gap after which wheel positions may have begun again because the base restarted [usual intervals]."""

LEAST_RESTART_RATIO = 1.5
"""Smallest ratio of the speed in such a gap to the speed in almost all other intervals."""

PARKED_M = 0.5
"""Radius within which 95 % of a standing robot's positions lie [m]."""

PARKED_SIGMAS = 3.0
"""The same radius in standard deviations of the positions; the larger radius counts."""

LEAST_TURNING_SHARE = 0.2
"""Smallest share of the time in which the wheels of a standing robot turn."""

UNIT_TOLERANCE = 0.35
"""Largest relative difference from the size by the reference at which a unit is recognised. Slip and soil change the
size by less."""


OTHER_UNIT_TOLERANCE = 0.1
"""The same difference for another unit than the message type's. It is smaller, because slip of 90 % would look like
rpm."""


FACTOR_TWO_TOLERANCE = 0.08
"""Largest relative difference of a scale from 2 or 1/2 at which the scale is that factor: a diameter was used as a
radius, or the reverse."""

LARGEST_SIZE_STD = 0.04
"""Largest standard deviation of the factor of a wrong wheel size, as a share of it. Slip that varies gives a
larger one."""

LEAST_STANDING_SHARE = 0.8
"""Share of the windows with a small displacement above which the robot does not move."""

LARGEST_STILL_RATIO = 0.2
"""Largest ratio of a small displacement to the distance of the wheels."""


class Scale(NamedTuple):
    """Metres by the position reference per unit of the wheels: median, its standard deviation, number of spans."""

    value: float
    std: float
    spans: int = 0


def with_wheel_speeds(log: RobotLog, config: Config) -> RobotLog:
    """Return the log with wheel speeds in m/s; the same log if its speeds are in m/s already.

    Speeds that no wheel can have are left out. The unit that was used or estimated is stated in the stream's ``why``
    and in the findings.

    Raises
    ------
    ConfigError
        A radius or resolution that is needed and cannot be found from the log.
    DataError
        Fewer than two usable samples; wheels without a unit that turn while the robot stands.
    """
    wheels = log.wheels
    if wheels.unit == "mps":
        return log
    topic = log.topic("wheels", "wheels")
    try:
        factor, unit_words, estimated = _metres_per_unit(wheels, log.gnss, config, topic)
    except ConfigError:
        refuse_standing(log)
        raise
    notes = [*estimated]
    with np.errstate(over="ignore"):
        left, right = wheels.left * factor, wheels.right * factor
    stamps, restarts = wheels.stamp_ns, np.zeros(0, np.int64)
    if wheels.from_position and (again := _restarts(stamps, left, right)).any():
        restarts = stamps[again]
        left, right = (np.where(again, np.append(side[:1], side[:-1]), side) for side in (left, right))
        text = f"{topic}: the wheel positions begin again in {counted(len(restarts), 'gap')}: the base restarted"
        notes.append(note("wheel_positions_restart", f"{text}; what was driven there is not known"))
    possible = (np.abs(left) <= FASTEST_MPS) & (np.abs(right) <= FASTEST_MPS)
    if not possible.all():
        count = np.count_nonzero(~possible)
        text = f"{topic}: {count} wheel speeds over {FASTEST_MPS:.0f} m/s left out"
        notes.append(note("wheel_speeds_impossible", text))
        stamps, left, right = stamps[possible], left[possible], right[possible]
    if (spikes := _spikes(left) | _spikes(right)).any():
        text = (
            f"{topic}: {np.count_nonzero(spikes)} wheel speeds, up to "
            f"{max(np.abs(left).max(), np.abs(right).max()):.0f} m/s, unlike those around them left out: "
            "were counters reset?"
        )
        notes.append(note("wheel_speeds_impossible", text))
        stamps, left, right = stamps[~spikes], left[~spikes], right[~spikes]
    if len(stamps) < 2:
        raise DataError(log.name, f"{topic} holds {len(stamps)} usable wheel samples", "at least two are needed")
    streams = tuple(
        replace(stream, count=len(stamps), why=f"{stream.why}{unit_words}") if stream.role == "wheels" else stream
        for stream in log.streams
    )
    kept = tuple(np.intersect1d(restarts, stamps).tolist())
    samples = WheelSamples(stamps, left, right, from_position=wheels.from_position, restarts_ns=kept)
    return replace(log, wheels=samples, streams=streams, notes=(*log.notes, *notes_about(log.name, notes)))


def with_right_size(log: RobotLog, config: Config) -> tuple[RobotLog, float]:
    """Return the log with wheel speeds of the right size, and the factor that was applied; 1 for none.

    A constant factor that tyres and soil do not explain is the factor of a wrong radius, resolution, gear or unit: slip
    is not the same in every span. Configured scales are left as they are.
    """
    wheels, settings = log.wheels, config.wheels
    if settings.left_scale != "auto" or settings.right_scale != "auto":
        return log, 1.0
    if not all(np.isfinite(column).all() for column in (log.gnss.north_m, log.gnss.east_m, wheels.left, wheels.right)):
        # A log with damaged positions or speeds is refused later, with the reason.
        return log, 1.0
    scale = reference_scale(wheels.stamp_ns, wheels.v_left_mps, wheels.v_right_mps, log.gnss)
    if scale is None or abs(scale.value - 1.0) <= ROLLING_SCALE + EVIDENCE_SIGMAS * scale.std:
        return log, 1.0
    finding = wrong_size(scale, log, config)
    if finding is None:
        return log, 1.0
    factor = scale.value
    size = replace(wheels, left=factor * wheels.v_left_mps, right=factor * wheels.v_right_mps)
    return replace(log, wheels=size, notes=(*log.notes, *notes_about(log.name, [finding]))), factor


def wrong_size(scale: Scale, log: RobotLog, config: Config) -> Note | None:
    """Return the finding that the wheel speeds have a constant factor, which is corrected; None without such a factor.

    Where the reference is no GNSS, its own unit or scale may be wrong, as in visual SLAM. Then only a factor of two is
    a factor of the wheels: a diameter was used as a radius, or the reverse.

    Parameters
    ----------
    scale : differs from 1 by more than tyres and soil explain
    log : the log
    config : the configuration
    """
    if not (scale.value > 0.0 and scale.std <= LARGEST_SIZE_STD * scale.value):
        return None
    if log.datum is None and all(abs(scale.value / two - 1.0) >= FACTOR_TWO_TOLERANCE for two in (0.5, 2.0)):
        return None
    percent = _with_std(Scale(100.0 * scale.value, 100.0 * scale.std))
    check = f"{radius_hint(log, config, scale.value)}wheel radius, encoder resolution, gear and units"
    text = f"the robot goes {percent} % of the distance that the wheels report: corrected; {check}"
    return note("wheel_size_wrong", text)


def radius_hint(log: RobotLog, config: Config, scale: float) -> str:
    """Return a text on the wheel radius that the log shows; "check " where the wheel speeds need no radius."""
    robot, radius_m = config.robot.name, config.robot.wheel_radius_m
    by_radius = any(choice.role == "wheels" and _ANGLES.search(choice.why) for choice in log.streams)
    if radius_m is None or not by_radius:
        return "check "
    is_robots_radius = radius_m == builtin_robots().get(robot or "", {}).get("wheel_radius_m")
    given = (
        f"{robot} has {radius_m:g} m: is --robot right?"
        if is_robots_radius
        else f"robot.wheel_radius_m is {radius_m:g} m:"
    )
    return f"the log shows a wheel radius of {scale * radius_m:.3f} m, {given} check "


_ANGLES = re.compile(r" in (rad|counts)")
"""Words in the `why` of a stream whose speeds were computed with the configured wheel radius."""


def refuse_standing(log: RobotLog, windows: DriveWindows | None = None) -> None:
    """Raise where the wheels turn and the robot does not move, because it is on a stand or held.

    Parameters
    ----------
    log : the log
    windows : windows of the log. Without windows the robot stands if its positions stay within their noise. A log of a
        robot on a stand has no windows, because it shows no heading or no unit; a log of a robot that spins on the spot
        may have windows

    Raises
    ------
    DataError
        The robot does not move, or moves far less than its wheels.
    """
    gone = ""
    laid_m = went_m = 0.0
    if windows is not None:
        track = windows.track
        if len(windows.begin) < FEWEST_ALIGNMENT_WINDOWS:
            return
        turned = np.abs(windows.turned)
        apart = np.abs(windows.over(track.at_places(track.half_difference)))
        laid, went = np.abs(windows.laid), np.abs(windows.seen)
        moved = (went > LARGEST_STILL_RATIO * np.maximum(laid, apart / 4)) | (turned > math.radians(10.0))
        clear = np.maximum(laid, apart) > windows.length_m / 4
        if np.count_nonzero(clear) < FEWEST_ALIGNMENT_WINDOWS or float((~moved)[clear].mean()) <= LEAST_STANDING_SHARE:
            return
        laid_m, went_m = float(laid[clear].sum()), float(went[clear].sum())
        gone = f" ({track.travel[-1]:.0f} m)"
    elif (
        not len(log.gnss.stamp_ns)
        or np.mean((log.wheels.left != 0.0) | (log.wheels.right != 0.0)) < LEAST_TURNING_SHARE
    ):
        return
    position = log.gnss.north_m + 1j * log.gnss.east_m
    away = np.abs(position - (np.median(position.real) + 1j * np.median(position.imag)))
    reach_m = float(np.percentile(away, 95))
    variance = (log.gnss.var_north_m2 + log.gnss.var_east_m2) / 2
    stated_variance = variance[np.isfinite(variance)]
    noise_m = math.sqrt(float(np.median(stated_variance))) if len(stated_variance) else 0.0
    moves = reach_m >= max(PARKED_M, PARKED_SIGMAS * noise_m)
    if moves and windows is None:
        return
    if moves and went_m > PARKED_M:
        raise DataError(
            log.name,
            f"the wheels turn{gone} {laid_m / went_m:.3g} times as far as the positions show",
            "is robot.wheel_radius_m, or the unit of the wheels (wheels.unit), too large by that factor?",
        )
    raise DataError(
        log.name,
        f"the wheels turn{gone} and the robot does not move",
        f"95 % of the positions lie within {reach_m:.2f} m: is it on a stand?",
    )


def _restarts(stamps: Ints, left: Floats, right: Floats) -> Bools:
    """Return the samples (n,) after which positions began again: the speed in the gap is far above almost all others.

    A robot is on average no faster in a gap than its fastest samples.
    """
    interval = np.append(np.diff(stamps), 0)
    if len(interval) < 3:
        return np.zeros(len(stamps), np.bool_)
    gap = interval > GAP_IN_USUAL * float(np.median(interval[:-1]))
    fastest = np.maximum(np.abs(left), np.abs(right))
    if not gap.any() or gap.all():
        return np.zeros(len(stamps), np.bool_)
    return np.asarray(
        gap & (fastest > LEAST_RESTART_RATIO * float(np.quantile(fastest[~gap], USUAL_QUANTILE))) & (fastest > 0.0)
    )


def _spikes(speed: Floats) -> Bools:
    """Return which single samples (n,) are far faster than their neighbours and than almost all other samples."""
    size = np.abs(speed)
    if len(size) < 2:
        return np.zeros(len(size), np.bool_)
    around = np.maximum(np.append(size[1], size[:-1]), np.append(size[1:], size[-2]))
    usual = float(np.quantile(size, USUAL_QUANTILE))
    spikes: Bools = (size > max(LEAST_SPIKE_MPS, LEAST_SPIKE_RATIO * usual)) & (size > LEAST_SPIKE_RATIO * around)
    return spikes


def reference_scale(stamps: Ints, left: Floats, right: Floats, gnss: PositionFixes) -> Scale | None:
    """Return the ratio of the distances by reference and wheels over `chord_s`; None where there are too few spans.

    Notes
    -----
    Straight spans are used where there are enough, else bent ones. The chords of bent spans are converted to arcs with
    the directions of the chords before and after. Between rare fixes the robot may turn to both sides: there the chords
    of `wheel_path` are used. The signs of the wheel speeds have no effect.
    `icrtool.alignment.estimator` cannot be used, because it needs m/s and a heading, which are found later.
    """
    if min(len(stamps), len(gnss.stamp_ns)) < 2:
        return None
    track = track_of_streams(WheelSamples(stamps, left, right), gnss, NO_HEADINGS, same_clock=False)
    usual_s, (duration, step, left, right) = chord_s(track), cut_chords(track)
    left, right, chord = np.abs(left), np.abs(right), np.abs(step)
    distance, turn = (left + right) / 2, np.abs(left - right)
    usable = (np.abs(duration - usual_s) < usual_s / 4) & (chord > LEAST_CHORD_M) & (distance > 0)
    straight = usable & (turn < LARGEST_STRAIGHT_DIFFERENCE * distance)
    path = wheel_path(track) if usual_s > CHORD_S else None
    if path is not None and path.misfit < WELL_FITTED:
        by_path = np.abs(np.diff(path.position[rows_of_chords(track)]))
        straight = usable & (by_path > distance / 2)
        distance = by_path
    elif np.count_nonzero(straight) < FEWEST_ALIGNMENT_WINDOWS:
        bend = np.full(len(chord), np.inf)
        bend[1:-1] = np.abs(np.angle(step[2:] * np.conj(step[:-2]))) / 2
        enclosed = usable.copy()
        enclosed[1:-1] &= usable[2:] & usable[:-2]
        straight = enclosed & (turn < LARGEST_BENT_DIFFERENCE * distance) & (bend < LARGEST_BEND_RAD)
        chord[straight] /= np.sinc(bend[straight] / 2 / math.pi)
    if np.count_nonzero(straight) < FEWEST_ALIGNMENT_WINDOWS:
        return None
    ratio = chord[straight] / distance[straight]
    centre = float(np.median(ratio))
    return Scale(centre, 1.2533 * mad_std(ratio) / math.sqrt(len(ratio)), len(ratio))


def _metres_per_unit(
    wheels: WheelSamples, gnss: PositionFixes, config: Config, topic: str
) -> tuple[float, str, list[Note]]:
    """Return metres per unit, its source in words, and findings where it had to be estimated."""
    radius, counts = config.robot.wheel_radius_m, config.robot.encoder_counts_per_rev
    metres_by_unit: dict[WheelUnit, float] = {"m": 1.0}
    if radius is not None:
        metres_by_unit["rad"] = radius
        if counts is not None:
            metres_by_unit["counts"] = 2 * math.pi * radius / counts
    unit, per = wheels.unit, "" if wheels.from_position else "/s"
    nothing_given = config.wheels.unit == config.wheels.left_scale == config.wheels.right_scale == "auto"
    if unit == "rad" and radius is not None and not wheels.from_position and nothing_given:
        scale = reference_scale(wheels.stamp_ns, wheels.left, wheels.right, gnss)
        is_other = scale is not None and scale.value > 0.0 and abs(math.log(scale.value / radius)) >= 2 * UNIT_TOLERANCE
        # Drivers fill speeds of joints in these units.
        for other, value in (("m/s", 1.0), ("rpm", 2 * math.pi * radius / 60), ("deg/s", math.radians(radius))):
            if scale is not None and is_other and abs(math.log(scale.value / value)) < OTHER_UNIT_TOLERANCE:
                text = f"{topic} is read in {other}, not rad/s: the position reference goes as far in this unit"
                return value, f" in {other} (by the position reference)", [note("wheel_unit_found", text)]
    if unit in metres_by_unit:
        return metres_by_unit[unit], "" if unit == "m" else f" in {unit}{per}", []
    scale = reference_scale(wheels.stamp_ns, wheels.left, wheels.right, gnss)
    if unit == "unknown" and scale is not None:
        recognised = _recognised(scale, metres_by_unit, None if wheels.from_position else radius)
        if recognised is not None:
            name, value = recognised
            return value, f" in {name}{per if name in metres_by_unit else ''} (by the position reference)", []
    if scale is None and unit == "unknown":
        raise ConfigError(
            "wheels.unit",
            f"{topic} names no unit, and the log has too little driving to find it",
            "give rad/s, m/s, rpm, deg/s or counts (ticks: wheels.quantity=counts), or drive for half a minute",
        )
    lacking = "robot.wheel_radius_m" if radius is None else "robot.encoder_counts_per_rev"
    if scale is None:
        raise ConfigError(
            lacking,
            f"needed to read {topic}, which is in {unit}",
            f"give it with --set {lacking}=…; the log has too little driving to estimate it",
        )
    size = {"rad": "wheel radius", "counts": "travel of a count"}.get(unit, "travel of a unit of the wheels")
    estimate = f"{size} {_with_std(scale)} m (estimated from the position reference)"
    reason = (
        f"{topic} names no unit, and none that is known fits (wheels.unit sets it)"
        if unit == "unknown"
        else f"{lacking} is not given"
    )
    return scale.value, f", {estimate}", [note("wheel_unit_estimated", f"{reason}: {estimate}")]


def _recognised(scale: Scale, known: Mapping[WheelUnit, float], radius: float | None) -> tuple[str, float] | None:
    """Return the unit that the position reference confirms, and its length [m]; None where it confirms no unit.

    Parameters
    ----------
    known : length of each unit that the configuration defines [m]
    radius : radius of the wheels [m], where their speeds may be in rpm or deg/s
    """
    name, value = min(known.items(), key=lambda item: abs(math.log(scale.value / item[1])))
    if abs(math.log(scale.value / value)) < UNIT_TOLERANCE:
        return name, value
    turning = {} if radius is None else {"rpm": 2 * math.pi * radius / 60, "deg/s": math.radians(radius)}
    near = (
        (name, value) for name, value in turning.items() if abs(math.log(scale.value / value)) < OTHER_UNIT_TOLERANCE
    )
    return next(near, None)


def _with_std(scale: Scale) -> str:
    """Return a scale with its standard deviation, of which one digit is shown, two if the first is a 1."""
    if not 0.0 < scale.std < math.inf:
        return f"{scale.value:.4g}"
    digits = -math.floor(math.log10(scale.std)) + (scale.std < 2 * 10 ** math.floor(math.log10(scale.std)))
    digits = max(digits, 0)
    return f"{scale.value:.{digits}f} ± {scale.std:.{digits}f}"
