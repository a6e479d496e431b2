"""Wheel speeds of the chosen source, held between samples, with findings about its stamps and numbers."""

from __future__ import annotations

import math

import numpy as np

from icrtool.config import Config
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.logs.streams.bursts import spread_bursts
from icrtool.logs.streams.sources import WheelSource, increasing_rows
from icrtool.records.notes import Note, note
from icrtool.records.samples import WheelSamples, WheelUnit

MOST_NOT_FINITE = 0.01
"""Share of wheel samples that are not finite above which they are reported."""


def wheel_samples(motion: WheelSource, stamps: Ints, config: Config, log_name: str) -> tuple[WheelSamples, list[Note]]:
    """Return wheel speeds, each valid until the next sample, in the unit of the log per second, and findings.

    Parameters
    ----------
    motion : source of the wheels
    stamps : (n,) stamps of the rows of `motion` [ns]
    config : the configuration
    log_name : name of the log in errors

    Raises
    ------
    ConfigError
        The topic holds a body twist and no track width is configured, or lacks the configured quantity.
    DataError
        There are fewer than two usable samples.
    """
    topic, notes = motion.topic, list[Note]()
    left, right, unit, is_position = _pick_quantity(motion, config)
    if not _is_doubled(stamps, left, right):
        bursts = spread_bursts(stamps)
        stamps = bursts.stamp_ns
        text = bursts.sentence("wheel samples")
        notes += [note("wheel_bursts", f"{topic}: {text}")] if text else []
    rows, backwards, dropped = increasing_rows(stamps)
    if backwards:
        notes.append(note("rows_sorted", f"{topic}: {backwards} wheel stamps go back; sorted"))
    if dropped > len(stamps) // 100:
        shared = f"{dropped} of {len(stamps)} wheel samples share a stamp with another"
        notes.append(note("stamps_shared", f"{topic}: {shared}; the last was kept"))
    left, right = left[rows], right[rows]
    finite = np.isfinite(left) & np.isfinite(right)
    lost = len(finite) - int(np.count_nonzero(finite))
    if lost > len(finite) * MOST_NOT_FINITE:
        why = f"{topic}: {lost} of {len(finite)} wheel samples are not finite numbers; left out"
        notes.append(note("samples_not_finite", why))
    stamps, left, right = stamps[rows][finite], left[finite], right[finite]
    if len(stamps) < 2:
        raise DataError(log_name, f"{topic} holds {len(stamps)} usable wheel samples", "at least two are needed")
    if is_position:
        interval = np.diff(stamps) / 1e9
        with np.errstate(over="ignore"):
            left, right = (np.append(np.diff(side) / interval, 0.0) for side in (left, right))
        left[-1], right[-1] = left[-2], right[-2]
    if motion.twist is not None and config.wheels.twist_width_m is None:
        undone = f"converted to wheel speeds with {config.robot.track_width_m:g} m (robot.track_width_m)"
        advice = "if its controller multiplies the wheel separation, set wheels.twist_width_m to the product"
        why = f"{topic} holds a body twist: {undone}; {advice}, else the estimated ICRs are too close together"
        notes.append(note("wheels_from_twist", why))
    return WheelSamples(stamps, left, right, unit, is_position), notes


def _is_doubled(stamps: Ints, left: Floats, right: Floats) -> bool:
    """Return whether most samples with the stamp of the sample before also have its values: recorded twice."""
    again = np.flatnonzero(np.diff(stamps) == 0)
    moving = again[(left[again] != 0.0) | (right[again] != 0.0)]
    same = (left[moving] == left[moving + 1]) & (right[moving] == right[moving + 1])
    return len(moving) > 0 and float(same.mean()) > 0.5


def _pick_quantity(motion: WheelSource, config: Config) -> tuple[Floats, Floats, WheelUnit, bool]:
    """Return the numbers of the left and of the right side (n,), their unit, and whether they are positions.

    Raises
    ------
    ConfigError
        The topic lacks the configured quantity, or the track width that it needs is not configured.
    """
    if motion.twist is not None:
        given = config.wheels.twist_width_m
        width = given if given is not None else config.robot.track_width_m
        if width is None:
            why = f"needed to convert the body twist of {motion.topic} to wheel speeds"
            raise ConfigError("robot.track_width_m", why, "set robot.track_width_m, or give --robot NAME")
        if motion.travelled is not None:
            travel, turn = motion.travelled.T
            return travel - turn * width / 2, travel + turn * width / 2, "m", True
        speed, turn = motion.twist.T
        with np.errstate(over="ignore", invalid="ignore"):
            return speed - turn * width / 2, speed + turn * width / 2, "m", False
    wanted, positions, speeds = config.wheels.quantity, motion.position, motion.speed
    if wanted in ("position", "counts") and positions is None:
        raise ConfigError("wheels.quantity", f"{motion.topic} has no {wanted}", "leave it on auto")
    stuck = False
    if wanted == "auto" and positions is not None and speeds is not None:
        # Some drivers leave the position at 0 while the wheels turn.
        finite = np.isfinite(positions[0]) & np.isfinite(positions[1])
        stuck = int(np.count_nonzero(finite)) < len(finite) / 2 or any(
            np.ptp(travelled[finite]) == 0.0 and np.nanmax(np.abs(speed)) > 0.0
            for travelled, speed in zip(positions, speeds, strict=True)
        )
    factor, unit = WHEEL_UNITS.get(config.wheels.unit, (1.0, motion.unit))
    if positions is not None and wanted != "velocity" and not stuck:
        if config.wheels.unit == "rpm":
            raise ConfigError(
                "wheels.unit", f"{motion.topic} holds positions, which have no rpm", "give rad/s or deg/s"
            )
        left, right = positions
        return left * factor, right * factor, "counts" if wanted == "counts" else unit, True
    if speeds is None:
        raise ConfigError("wheels.quantity", f"{motion.topic} has no velocity of both sides", "leave it on auto")
    left, right = speeds
    return left * factor, right * factor, unit, False


WHEEL_UNITS: dict[str, tuple[float, WheelUnit]] = {
    "rad/s": (1.0, "rad"), "deg/s": (math.radians(1.0), "rad"), "rpm": (2 * math.pi / 60, "rad"),
    "m/s": (1.0, "m"), "counts": (1.0, "counts"),
}  # fmt: skip
"""Factor that converts numbers in each configured unit of wheels, and the unit of the products (per second for
speeds)."""
