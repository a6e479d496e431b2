"""The chosen wheels (position, speed or body twist) as speeds of both sides; and which configured joints they lack."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from icrtool.config import Config
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.logs.containers.channel import some_of
from icrtool.logs.streams.sources import Pair, Unit, WheelMotion
from icrtool.logs.streams.stamps import increasing
from icrtool.records.samples import WheelSamples

_Key = Literal["left_joints", "right_joints"]
_KEYS: tuple[_Key, _Key] = ("left_joints", "right_joints")


def check_joints(chosen: WheelMotion | None, candidates: Sequence[WheelMotion], config: Config) -> None:
    """Refuse a configured joint that no message of the wheels' topic lists: its side would be the mean of fewer wheels.

    Parameters
    ----------
    chosen : the wheels that would be used, None where there are none
    candidates : all wheels that were found; where `chosen` lists no joints they are looked for here

    Raises
    ------
    ConfigError
        The first such joint, with those that are listed.
    """
    if not _keys_given(config):
        return
    # If the chosen topic lists no joints, none of the others has the configured ones: name the closest one.
    listing = [motion for motion in candidates if motion.joints]
    if chosen is not None and chosen.joints:
        listing = [chosen]
    closest = min(listing, key=lambda motion: len(_unlisted(motion, config)), default=None)
    unlisted = _unlisted(closest, config) if closest is not None else []
    if closest is None or not unlisted:
        return
    key, name = unlisted[0]
    why, advice = f"no message of {closest.topic} lists a joint {name}", f"its joints are {some_of(closest.joints)}"
    raise ConfigError(f"wheels.{key}", why, advice)


def ignored_joints(chosen: WheelMotion, config: Config) -> list[str]:
    """Return a warning for every configured joint list that is not used, because the messages list no joints."""
    if chosen.joints:
        return []
    why = f"{chosen.topic} ({chosen.message_type}) lists no joints by name"
    return [f"wheels.{key} is not used: {why}" for key in _keys_given(config)]


def _keys_given(config: Config) -> list[_Key]:
    return [key for key in _KEYS if getattr(config.wheels, key)]


def _unlisted(motion: WheelMotion, config: Config) -> list[tuple[_Key, str]]:
    return [(key, name) for key in _KEYS for name in getattr(config.wheels, key) if name not in motion.joints]


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
