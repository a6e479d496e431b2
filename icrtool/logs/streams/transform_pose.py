"""The pose of the robot where only transforms hold it, as of a SLAM that moves the map's frame on ``/tf``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icrtool.config import TopicsConfig
from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.logs.containers.channel import Channel
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.metric_positions import REFERENCE_FRAMES, REFERENCE_WORDS
from icrtool.logs.streams.position_sources import POSITION_TYPES
from icrtool.logs.streams.static_transforms import BASE_FRAMES, FIELDS, TYPES, is_static
from icrtool.records.text import LogText

_STAMP = tuple(f"transforms[*].header.stamp.{part}" for part in ("sec", "nanosec"))
_POSE = tuple(f"pose.{name}" for name in ("position.x", "position.y", "position.z",
              "orientation.x", "orientation.y", "orientation.z", "orientation.w"))  # fmt: skip


class _Link(NamedTuple):
    """A moving frame: its parent, the messages (n,) that hold it, stamps (n, 2), places (n, 3), quaternions (n, 4)."""

    parent: LogText
    rows: Ints
    stamps: Ints
    place: Floats
    turn: Floats


def transform_channels(channels: Sequence[Channel], topics: TopicsConfig) -> dict[int, tuple[str, ...]]:
    """Return the channels of moving transforms with the fields to take, where no topic can be the position.

    Reading all transforms takes longer than the rest of a log. An odometry that is no reference by name does not count.
    """
    named = any(
        one.message_type in POSITION_TYPES
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
    root, rows, stamps, place, turn = links.pop(base)
    step = np.zeros(len(rows), np.bool_)
    lowest = True
    while root in links:
        above = links.pop(root)
        held = np.searchsorted(above.rows, rows, side="right") - 1
        known = held >= 0
        rows, stamps, step, held = rows[known], stamps[known], step[known], held[known]
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
    frame = np.zeros((np.count_nonzero(step), 1), np.int64)
    values = [*stamps[step].T, *frame.T, *place[step].T, *turn[step].T]
    columns = dict(zip((*HEADER, *_POSE), values, strict=True))
    return replace(
        table, message_type=LogText("geometry_msgs/PoseStamped"), log_time_ns=table.log_time_ns[rows[step]],
        columns=columns, texts={HEADER[2]: [root]},
    )  # fmt: skip


def _links(table: TopicTable) -> dict[str, _Link]:
    """Return the moving frames by name, without their leading slash."""
    parents, parent_names = table.words(FIELDS[0])
    children, child_names = table.words(FIELDS[1])
    stamps = np.stack([table.column(path) for path in _STAMP], axis=-1)
    numbers = np.stack([table.floats(path) for path in FIELDS[2:]], axis=-1)
    found: dict[str, _Link] = {}
    for code, name in enumerate(child_names):
        rows, places = np.nonzero(children == code)
        pose = numbers[rows, places]
        size = np.linalg.norm(pose[:, 3:], axis=1)
        sound = np.isfinite(pose).all(axis=1) & (size > 0.0)
        rows, places, pose, size = (one[sound] for one in (rows, places, pose, size))
        if len(rows):
            parent = LogText(parent_names[parents[rows[-1], places[-1]]].strip("/"))
            turn = pose[:, 3:] / size[:, None]
            found[name.strip("/")] = _Link(parent, rows, stamps[rows, places], pose[:, :3], turn)
    return found


def _product(a: Floats, b: Floats) -> Floats:
    """Return the products (n, 4) of quaternions x, y, z, w."""
    vector = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
    return np.column_stack([vector, a[:, 3] * b[:, 3] - np.sum(a[:, :3] * b[:, :3], axis=1)])


def _rotated(q: Floats, places: Floats) -> Floats:
    """Return places (n, 3) rotated by quaternions (n, 4)."""
    twice = 2.0 * np.cross(q[:, :3], places)
    return places + q[:, 3:] * twice + np.cross(q[:, :3], twice)
