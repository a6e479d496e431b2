"""Convert the wheel motion of a topic (position, speed or body twist) to speeds of both sides, in its unit."""

from __future__ import annotations

import numpy as np

from icrtool.config import Config
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.logs.streams.stamps import increasing
from icrtool.logs.streams.wheel_sources import Pair, Unit, WheelMotion
from icrtool.records.samples import WheelSamples

MOST_NOT_FINITE = 0.01
"""A larger share of wheel samples without a number is reported."""


def wheel_samples(motion: WheelMotion, stamps: Ints, config: Config, log_name: str) -> tuple[WheelSamples, list[str]]:
    """Return wheel speeds held over each interval, in the unit of the log, and warnings.

    Returns
    -------
    samples, warnings

    Raises
    ------
    ConfigError
        A body twist whose track width is not configured, or a configured quantity that the topic does not have.
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
    finite = np.isfinite(left) & np.isfinite(right)
    lost = len(finite) - int(np.count_nonzero(finite))
    if lost > len(finite) * MOST_NOT_FINITE:
        warnings.append(
            f"{log_name}: {motion.topic}: {lost} of {len(finite)} wheel samples are not finite numbers; left out"
        )
    stamps, left, right = stamps[rows][finite], left[finite], right[finite]
    if len(stamps) < 2:
        raise DataError(log_name, f"{motion.topic} holds {len(stamps)} usable wheel samples", "at least two are needed")
    if is_position:
        interval = np.diff(stamps) / 1e9
        with np.errstate(over="ignore"):
            left, right = (np.append(np.diff(side) / interval, 0.0) for side in (left, right))
        left[-1], right[-1] = left[-2], right[-2]
    warnings += [f"{log_name}: {note}" for note in _assumptions(motion, config)]
    return WheelSamples(stamps, left, right, unit, is_position), warnings


def _pick(motion: WheelMotion, config: Config) -> tuple[Floats, Floats, Unit, bool]:
    """Return left, right, their unit, and whether they are positions."""
    if motion.twist is not None:
        width = _twist_width_m(config)
        if width is None:
            raise ConfigError(
                "robot.track_width_m",
                f"needed to convert the body twist of {motion.topic} to wheel speeds",
                "give it, or --robot NAME",
            )
        speed, turn = motion.twist.T
        with np.errstate(over="ignore", invalid="ignore"):
            return speed - turn * width / 2, speed + turn * width / 2, "m", False
    wanted = config.wheels.quantity
    positions, speeds = motion.position, motion.speed
    by_position = positions is not None and wanted != "velocity" and (wanted != "auto" or _alive(positions, speeds))
    if wanted in ("position", "counts") and positions is None:
        raise ConfigError("wheels.quantity", f"{motion.topic} has no {wanted}", "leave it on auto")
    if speeds is not None and not by_position:
        return *speeds, motion.unit, False
    if positions is None or wanted == "velocity":
        raise ConfigError("wheels.quantity", f"{motion.topic} has no velocity of both sides", "leave it on auto")
    unit: Unit = "counts" if wanted == "counts" else motion.unit
    return *positions, unit, True


def _twist_width_m(config: Config) -> float | None:
    given = config.wheels.twist_width_m
    return given if given is not None else config.robot.track_width_m


def _assumptions(motion: WheelMotion, config: Config) -> list[str]:
    """Return a warning with the width assumed for a body twist, and the option that sets it."""
    if motion.twist is None or config.wheels.twist_width_m is not None:
        return []
    undone = f"converted to wheel speeds with {config.robot.track_width_m:g} m (robot.track_width_m)"
    advice = "if its controller multiplies the wheel separation, set wheels.twist_width_m to the product"
    return [f"{motion.topic} holds a body twist: {undone}; {advice}, else the estimated ICRs are too close together"]


def _alive(positions: Pair, speeds: Pair | None) -> bool:
    """Return whether the positions change where the speeds do: some drivers leave the position at zero."""
    finite = np.isfinite(positions[0]) & np.isfinite(positions[1])
    if np.count_nonzero(finite) < len(finite) / 2:
        return False
    if speeds is None:
        return True
    still = [float(np.ptp(side[finite])) == 0.0 for side in positions]
    moves = [float(np.nanmax(np.abs(side))) > 0.0 for side in speeds]
    return not any(s and m for s, m in zip(still, moves, strict=True))
