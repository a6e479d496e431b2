"""Position of the antenna on the robot, from the transforms on ``/tf_static``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.logs.containers.channel import Channel
from icrtool.logs.messages.topic_table import TopicTable

TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
BASE_FRAMES = ("base_link", "base_footprint", "chassis_link", "base")
LARGEST_LEVER_ARM_M = 5.0
"""No antenna is further from the body origin than this [m]: such a transform is ignored."""

LARGEST_TRANSLATION_M = 1e9
"""Beyond it a transform is damaged; UTM coordinates reach 1e7."""

_PREFIX = "transforms[*]."
_TRANSLATION = tuple(f"{_PREFIX}transform.translation.{axis}" for axis in "xyz")
_ROTATION = tuple(f"{_PREFIX}transform.rotation.{axis}" for axis in "xyzw")
FIELDS = (f"{_PREFIX}header.frame_id", f"{_PREFIX}child_frame_id", *_TRANSLATION, *_ROTATION)

Transforms = dict[str, tuple[str, Floats, Floats]]
"""Child frame to (parent frame, translation (3,) [m], rotation (3, 3)); parent coordinates = R child + t."""


def is_static(channel: Channel) -> bool:
    """Return whether a channel carries static transforms."""
    return channel.message_type in TYPES and channel.topic.rstrip("/").endswith("tf_static")


def antenna_place(tables: Sequence[TopicTable], antenna_topic: str) -> tuple[float, float] | None:
    """Return the antenna's position in the body frame, forward and right [m]; None where the log has no transform.

    Parameters
    ----------
    antenna_topic : topic of the fixes; its header names the antenna's frame
    """
    frame = next((_plain(t.text("header.frame_id")) for t in tables if t.topic == antenna_topic), "")
    transforms = _transforms([t for t in tables if t.message_type in TYPES])
    if not frame or frame not in transforms:
        return None
    placed = _in_roots(transforms)
    root, place, _ = placed[frame]
    names = sorted(placed)
    bases = [name for last in BASE_FRAMES for name in names if name.rsplit("/", 1)[-1] == last]
    for base in bases:
        base_root, origin, rotation = placed[base]
        if base_root == root:
            forward, left, _up = rotation.T @ (place - origin)
            if np.hypot(forward, left) <= LARGEST_LEVER_ARM_M:
                return float(forward), -float(left)
    return None


def _plain(frame: str) -> str:
    return frame.strip("/")


def _transforms(tables: Sequence[TopicTable]) -> Transforms:
    """Return the transforms of all messages; of several for one child frame, the last."""
    found: Transforms = {}
    for table in tables:
        if not all(path in table.columns for path in FIELDS):
            continue
        parents, parent_names = table.words(FIELDS[0])
        children, child_names = table.words(FIELDS[1])
        translation = np.stack([table.floats(path) for path in _TRANSLATION], axis=-1)
        rotation = np.stack([table.floats(path) for path in _ROTATION], axis=-1)
        length, size = np.abs(translation).max(axis=-1), np.abs(rotation).max(axis=-1)
        sound = (length < LARGEST_TRANSLATION_M) & (size > 0.01) & (size < 100.0)  # a unit quaternion, or nearly
        rows, places = np.nonzero((children >= 0) & sound)
        last = dict(zip(children[rows, places].tolist(), zip(rows.tolist(), places.tolist(), strict=True), strict=True))
        for child, at in last.items():
            parent = _plain(parent_names[parents[at]])
            found[_plain(child_names[child])] = (parent, translation[at], _matrix(rotation[at]))
    return found


def _matrix(q: Floats) -> Floats:
    """Return the rotation matrix of a quaternion x, y, z, w."""
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _in_roots(transforms: Transforms) -> Transforms:
    """Return each frame's root, and its origin and axes in it; a frame in a circle of frames is its own root."""
    placed: Transforms = {}
    for name in transforms:
        chain: dict[str, None] = {}
        frame = name
        while frame in transforms and frame not in placed and frame not in chain:
            chain[frame] = None
            frame = transforms[frame][0]
        below = list(chain)
        if frame in chain:
            circle = below.index(frame)
            placed |= {one: (one, np.zeros(3), np.eye(3)) for one in below[circle:]}
            del below[circle:]
        root, origin, rotation = placed.setdefault(frame, (frame, np.zeros(3), np.eye(3)))
        for one in reversed(below):
            _, translation, turn = transforms[one]
            origin, rotation = rotation @ translation + origin, rotation @ turn
            placed[one] = (root, origin, rotation)
    return placed
