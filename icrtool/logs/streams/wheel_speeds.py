"""From what the wheels tell (rad, counts, m; position or speed; a body twist) to the speed of each side in m/s."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from icrtool.config import Config
from icrtool.errors import ConfigError, DataError
from icrtool.logs.streams.stamps import increasing
from icrtool.logs.streams.wheel_sources import Unit, WheelMotion
from icrtool.records.tables import Bools, Floats, Ints, PositionFixes, WheelSamples

WINDOW_S = 2.0
LEAST_MOVE_M = 0.3
FEWEST_WINDOWS = 8
"""The reference's way is held against the wheels' over straight windows of this length."""

FASTEST_MPS = 100.0
"""No robot on wheels or tracks is faster: a number over it is damage, and would make a way of any length."""

SPIKE_MPS, SPIKE_RATIO, USUAL_SHARE = 3.0, 10.0, 0.995
"""A single sample faster than this, and that much faster than almost all and than its neighbours, is no driving."""

UNIT_TOLERANCE = 0.35
"""A unit is recognised when the reference confirms its size within this share (slip and soil change it by less)."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Metres by the position reference per unit the wheels tell: median, its standard deviation, windows used."""

    value: float
    std: float
    windows: int


def wheel_samples(
    motion: WheelMotion, stamps: Ints, config: Config, gnss: PositionFixes, log_name: str
) -> tuple[WheelSamples, str, list[str]]:
    """Turn wheel motion into speeds held over each interval.

    Returns
    -------
    samples, how, warnings : how says in words what was used

    Raises
    ------
    ConfigError
        A radius, width or resolution that is needed and cannot be found from the log.
    DataError
        Fewer than two usable samples.
    """
    rows, backwards, dropped = increasing(stamps)
    warnings = []
    if backwards:
        warnings.append(f"{log_name}: {motion.topic}: {backwards} wheel stamps go back; sorted")
    if dropped > len(stamps) // 100:
        warnings.append(
            f"{log_name}: {motion.topic}: {dropped} of {len(stamps)} wheel samples share a stamp with another; "
            "the last was kept"
        )
    left, right, unit, is_position = _pick(motion, config)
    left, right = left[rows], right[rows]
    told = np.isfinite(left) & np.isfinite(right)
    stamps, left, right = stamps[rows][told], left[told], right[told]
    if len(stamps) < 2:
        raise DataError(log_name, f"{motion.topic} holds {len(stamps)} usable wheel samples", "at least two are needed")
    if is_position:
        interval = np.diff(stamps) / 1e9
        with np.errstate(over="ignore"):
            left, right = (np.append(np.diff(side) / interval, 0.0) for side in (left, right))
        left[-1], right[-1] = left[-2], right[-2]
    factor, how, estimated = _metres_per_unit(motion, unit, stamps, left, right, gnss, config, is_position=is_position)
    warnings += [f"{log_name}: {note}" for note in (*_assumptions(motion, config), *estimated)]
    with np.errstate(over="ignore"):
        left = left * factor * _side_scale(config.wheels.left_scale)
        right = right * factor * _side_scale(config.wheels.right_scale)
    possible = (np.abs(left) <= FASTEST_MPS) & (np.abs(right) <= FASTEST_MPS)
    if not possible.all():
        count = np.count_nonzero(~possible)
        warnings.append(f"{log_name}: {motion.topic}: {count} wheel speeds over {FASTEST_MPS:.0f} m/s left out")
        stamps, left, right = stamps[possible], left[possible], right[possible]
    if (spikes := _spikes(left) | _spikes(right)).any():
        warnings.append(
            f"{log_name}: {motion.topic}: {np.count_nonzero(spikes)} wheel speeds, up to "
            f"{max(np.abs(left).max(), np.abs(right).max()):.0f} m/s, unlike those around them left out: "
            "were counters reset?"
        )
        stamps, left, right = stamps[~spikes], left[~spikes], right[~spikes]
    if len(stamps) < 2:
        raise DataError(log_name, f"{motion.topic} holds {len(stamps)} usable wheel samples", "at least two are needed")
    samples = WheelSamples(stamps, left, right)
    return samples, f"{'position' if is_position else 'speed'}{how}", warnings


def _spikes(speed: Floats) -> Bools:
    """Mark single samples (n,) far faster than those before and after them, and than almost all others."""
    size = np.abs(speed)
    if len(size) < 2:
        return np.zeros(len(size), np.bool_)
    around = np.maximum(np.append(size[1], size[:-1]), np.append(size[1:], size[-2]))
    usual = float(np.quantile(size, USUAL_SHARE))
    spikes: Bools = (size > max(SPIKE_MPS, SPIKE_RATIO * usual)) & (size > SPIKE_RATIO * around)
    return spikes


def _side_scale(scale: float | str) -> float:
    """Return a side's configured scale; ``auto`` is 1 here, and judged where position and heading are known."""
    return scale if isinstance(scale, float | int) else 1.0


def reference_scale(stamps: Ints, left: Floats, right: Floats, gnss: PositionFixes) -> Scale | None:
    """Compare the reference's way with the wheels' over straight windows; None where too few are straight."""
    if len(gnss.stamp_ns) < 2:
        return None
    begin, end, window = max(stamps[0], gnss.stamp_ns[0]), min(stamps[-1], gnss.stamp_ns[-1]), int(WINDOW_S * 1e9)
    inside = gnss.stamp_ns[(gnss.stamp_ns >= begin) & (gnss.stamp_ns < end)]
    # Only windows that a fix begins: one stamp that is years off would make billions of them.
    edges = begin + window * np.unique((inside - begin) // window)
    if len(edges) < 2:
        return None
    places = np.searchsorted(gnss.stamp_ns, edges)
    places = places[places < len(gnss.stamp_ns)]
    moments = gnss.stamp_ns[places]
    interval = np.diff(stamps) / 1e9
    ways = []
    for speed in (left, right):
        travelled = np.concatenate([[0.0], np.cumsum(speed[:-1] * interval)])
        ways.append(np.diff(np.interp(moments, stamps, travelled)))
    way, turn = (ways[0] + ways[1]) / 2, np.abs(ways[0] - ways[1])
    chord = np.hypot(np.diff(gnss.north_m[places]), np.diff(gnss.east_m[places]))
    whole = np.abs(np.diff(moments) / 1e9 - WINDOW_S) < WINDOW_S / 4
    straight = whole & (turn < 0.1 * np.abs(way)) & (chord > LEAST_MOVE_M) & (np.abs(way) > 0)
    if np.count_nonzero(straight) < FEWEST_WINDOWS:
        return None
    ratio = chord[straight] / np.abs(way[straight])
    centre = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - centre)))
    return Scale(centre, 1.2533 * spread / math.sqrt(len(ratio)), len(ratio))


def _pick(motion: WheelMotion, config: Config) -> tuple[Floats, Floats, Unit, bool]:
    """Return left, right, their unit, and whether they are positions."""
    if motion.twist is not None:
        width = _twist_width_m(config)
        if width is None:
            raise ConfigError(
                "robot.track_width_m", f"needed to undo the body twist of {motion.topic}", "give it, or --robot NAME"
            )
        speed, turn = motion.twist.T
        return speed - turn * width / 2, speed + turn * width / 2, "m", False
    wanted = config.wheels.quantity
    positions = _both(motion.position_left, motion.position_right)
    speeds = _both(motion.speed_left, motion.speed_right)
    by_position = positions is not None and wanted != "velocity" and (wanted != "auto" or _alive(positions, speeds))
    if wanted in ("position", "counts") and positions is None:
        raise ConfigError("wheels.quantity", f"{motion.topic} tells no {wanted}", "leave it on auto")
    if speeds is not None and not by_position:
        return *speeds, motion.speed_unit, False
    if positions is None or wanted == "velocity":
        raise ConfigError("wheels.quantity", f"{motion.topic} tells no velocity of both sides", "leave it on auto")
    unit: Unit = "counts" if wanted == "counts" else motion.position_unit
    return *positions, unit, True


def _twist_width_m(config: Config) -> float | None:
    given = config.wheels.twist_width_m
    return given if given is not None else config.robot.track_width_m


def _assumptions(motion: WheelMotion, config: Config) -> list[str]:
    """Say what was taken for granted of a body twist, and where it can be set."""
    if motion.twist is None or config.wheels.twist_width_m is not None:
        return []
    undone = f"undone with {config.robot.track_width_m:g} m (robot.track_width_m)"
    advice = "where its controller multiplies the wheel separation, set wheels.twist_width_m to the product"
    return [f"{motion.topic} tells a body twist: {undone}; {advice}, or the ICRs come out too close"]


def _both(left: Floats | None, right: Floats | None) -> tuple[Floats, Floats] | None:
    return (left, right) if left is not None and right is not None else None


def _alive(positions: tuple[Floats, Floats], speeds: tuple[Floats, Floats] | None) -> bool:
    """Say whether the positions move where the speeds do: some drivers leave the position at zero."""
    finite = np.isfinite(positions[0]) & np.isfinite(positions[1])
    if np.count_nonzero(finite) < len(finite) / 2:
        return False
    if speeds is None:
        return True
    still = [float(np.ptp(side[finite])) == 0.0 for side in positions]
    moves = [float(np.nanmax(np.abs(side))) > 0.0 for side in speeds]
    return not any(s and m for s, m in zip(still, moves, strict=True))


def _metres_per_unit(
    motion: WheelMotion, unit: Unit, stamps: Ints, left: Floats, right: Floats, gnss: PositionFixes, config: Config,
    *, is_position: bool,
) -> tuple[float, str, list[str]]:  # fmt: skip
    """Return metres per unit, how it is known in words, and what had to be estimated for want of a key."""
    radius, counts = config.robot.wheel_radius_m, config.robot.encoder_counts_per_rev
    known: dict[Unit, float] = {"m": 1.0}
    if radius is not None:
        known["rad"] = radius
        if counts is not None:
            known["counts"] = 2 * math.pi * radius / counts
    per = "" if is_position else "/s"
    if unit in known:
        return known[unit], "" if unit == "m" else f" in {unit}{per}", []
    scale = reference_scale(stamps, left, right, gnss)
    if unit == "unknown" and scale is not None:
        name, value = min(known.items(), key=lambda item: abs(math.log(scale.value / item[1])))
        if abs(math.log(scale.value / value)) < UNIT_TOLERANCE:
            return value, f" in {name}{per} (by the position reference)", []
    if scale is None and unit == "unknown":
        raise ConfigError(
            "wheels.quantity",
            f"{motion.topic} names no unit, and the log has no straight driving to find it from",
            "drive straight for some metres; where they are ticks, give --set wheels.quantity=counts",
        )
    lacking = "robot.wheel_radius_m" if radius is None else "robot.encoder_counts_per_rev"
    if scale is None:
        raise ConfigError(
            lacking,
            f"needed to read {motion.topic}, which is in {unit}",
            f"give it with --set {lacking}=…; the log has no straight driving to find the scale from",
        )
    how = f", 1 unit = {scale.value:.5g} ± {scale.std:.2g} m (found from the position reference; {unit})"
    why = "no unit that the robot's keys know fits" if radius and counts else f"{lacking} is not given"
    return scale.value, how, [f"{why}{how}"]
