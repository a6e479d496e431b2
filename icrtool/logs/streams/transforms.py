"""Transforms: where the antenna is on the robot (``/tf_static``), and the robot's pose where only ``/tf`` holds it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icrtool.config import TopicsConfig
from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.topic_table import FRAME, STAMPS, TopicTable
from icrtool.logs.streams.message_types import MESSAGE_TYPES
from icrtool.logs.streams.positions import REFERENCE_FRAMES, REFERENCE_WORDS
from icrtool.records.text import LogText

TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
BASE_FRAMES = ("base_link", "base_footprint", "chassis_link", "base")
LARGEST_LEVER_ARM_M = 5.0
"""No antenna is further from the body origin than this [m]: such a transform is ignored."""

LARGEST_TRANSLATION_M = 1e9
"""Beyond it a transform is damaged; UTM coordinates reach 1e7."""

_PREFIX = "transforms[*]."
FIELDS = (
    f"{_PREFIX}header.frame_id",
    f"{_PREFIX}child_frame_id",
    *(f"{_PREFIX}transform.translation.{axis}" for axis in "xyz"),
    *(f"{_PREFIX}transform.rotation.{axis}" for axis in "xyzw"),
)
"""Of a transform: parent, child, translation, rotation."""

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
    frame = next((_plain(t.text(FRAME)) for t in tables if t.topic == antenna_topic), "")
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
        if all(path in table.columns for path in FIELDS):
            links = _links(table)
            found |= {child: (one.parent, one.place[-1], _matrix(one.turn[-1])) for child, one in links.items()}
    return found


def _matrix(q: Floats) -> Floats:
    """Return the rotation matrix of a unit quaternion x, y, z, w."""
    x, y, z, w = q
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


_STAMP = tuple(f"transforms[*].header.stamp.{part}" for part in ("sec", "nanosec"))
_POSE = tuple(f"pose.{name}" for name in ("position.x", "position.y", "position.z",
              "orientation.x", "orientation.y", "orientation.z", "orientation.w"))  # fmt: skip


class _Link(NamedTuple):
    """A frame in its parent: the messages (n,) and places in them (n,), translations (n, 3), quaternions (n, 4)."""

    parent: LogText
    rows: Ints
    places: Ints
    place: Floats
    turn: Floats


def transform_channels(channels: Sequence[Channel], topics: TopicsConfig) -> dict[int, tuple[str, ...]]:
    """Return the channels of moving transforms with the fields to take, where no topic can be the position.

    Reading all transforms takes longer than the rest of a log. An odometry that is no reference by name does not count.
    """
    named = any(
        one.message_type in MESSAGE_TYPES["gnss"]
        and (one.message_type != "nav_msgs/Odometry" or REFERENCE_WORDS.search(one.topic) is not None)
        for one in channels
    )
    return {
        one.id: (*FIELDS, *_STAMP)
        for one in channels
        if one.message_type in TYPES and not is_static(one) and (topics.gnss == one.topic or not (named or topics.gnss))
    }


def transform_pose(table: TopicTable) -> TopicTable:
    """Return the poses of the robot's base in the root of the transforms, as messages of PoseStamped.

    Where the base is an odometry's and the root moves against it, as a map does by each scan that is matched, there is
    a pose at the first odometry after each such step: later ones differ by what the odometry alone added.

    Raises
    ------
    DefinitionError
        No base frame moves, or the root is no reference.
    """
    links = _links(table)
    base = next((one for last in BASE_FRAMES for one in links if one.rsplit("/", 1)[-1] == last), None)
    if base is None:
        raise DefinitionError(table.topic, f"it moves none of the frames {', '.join(BASE_FRAMES)}")
    root, rows, places, place, turn = links.pop(base)
    step = np.zeros(len(rows), np.bool_)
    lowest = True
    while root in links:
        above = links.pop(root)
        held = np.searchsorted(above.rows, rows, side="right") - 1
        known = held >= 0
        rows, places, step, held = rows[known], places[known], step[known], held[known]
        changed = np.diff(above.place, axis=0).any(axis=1) | np.diff(above.turn, axis=0).any(axis=1)
        version = np.append(0, np.cumsum(changed))[held]
        step[1:] |= version[1:] != version[:-1]
        place = above.place[held] + _rotated(above.turn[held], place[known])
        turn = _product(above.turn[held], turn[known])
        root, lowest = above.parent, False
    if not (REFERENCE_WORDS.search(root) or root in REFERENCE_FRAMES):
        why = f"its root, {root}, does not show a position reference: it may be the wheels' dead reckoning"
        raise DefinitionError(table.topic, why)
    step |= lowest
    if not step.any():
        raise DefinitionError(table.topic, f"its {root} never moves against the odometry: that is dead reckoning")
    stamps = (table.column(path)[rows[step], places[step]] for path in _STAMP)
    frame = np.zeros(np.count_nonzero(step), np.int64)
    values = [*stamps, frame, *place[step].T, *turn[step].T]
    columns = dict(zip((*STAMPS[0], FRAME, *_POSE), values, strict=True))
    return replace(
        table, message_type=LogText("geometry_msgs/PoseStamped"), log_time_ns=table.log_time_ns[rows[step]],
        columns=columns, texts={FRAME: [root]},
    )  # fmt: skip


def _links(table: TopicTable) -> dict[str, _Link]:
    """Return the frames that a topic holds by name, without their leading slash."""
    parents, parent_names = table.words(FIELDS[0])
    children, child_names = table.words(FIELDS[1])
    numbers = np.stack([table.floats(path) for path in FIELDS[2:]], axis=-1)
    length, size = (np.abs(part).max(axis=-1) for part in (numbers[..., :3], numbers[..., 3:]))
    sound = (length < LARGEST_TRANSLATION_M) & (size > 0.01) & (size < 100.0)  # a unit quaternion, or nearly
    all_rows, all_places = np.nonzero((children >= 0) & sound)
    order = np.argsort(children[all_rows, all_places], kind="stable")
    ends = np.cumsum(np.bincount(children[all_rows, all_places], minlength=len(child_names)))
    found: dict[str, _Link] = {}
    for name, of_child in zip(child_names, np.split(order, ends[:-1]), strict=True):
        if len(of_child):
            rows, places = all_rows[of_child], all_places[of_child]
            pose = numbers[rows, places]
            parent = LogText(_plain(parent_names[parents[rows[-1], places[-1]]]))
            turn = pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1)[:, None]
            found[_plain(name)] = _Link(parent, rows, places, pose[:, :3], turn)
    return found


def _product(a: Floats, b: Floats) -> Floats:
    """Return the products (n, 4) of quaternions x, y, z, w."""
    vector = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
    return np.column_stack([vector, a[:, 3] * b[:, 3] - np.sum(a[:, :3] * b[:, :3], axis=1)])


def _rotated(q: Floats, places: Floats) -> Floats:
    """Return places (n, 3) rotated by quaternions (n, 4)."""
    twice = 2.0 * np.cross(q[:, :3], places)
    return places + q[:, 3:] * twice + np.cross(q[:, :3], twice)
