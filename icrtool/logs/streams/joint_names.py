"""Checks the joints that a configuration names against those that messages list."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from icrtool.config import Config
from icrtool.errors import ConfigError
from icrtool.logs.containers.channel import some_of
from icrtool.logs.streams.wheel_sources import WheelMotion

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
