"""Reader of the poses in topics without a role, which a localisation on the robot computed during the recording."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from icrtool.errors import ConfigError, DataError, DefinitionError
from icrtool.kernels.arrays import Bools, turned_axis, unwrapped
from icrtool.logs.containers.container import Channel
from icrtool.logs.containers.open_log import open_log
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.read_log import Progress, SurveyDocument, collect_tables, is_table, long_intervals
from icrtool.logs.streams.headings import Orientation, frame_convention
from icrtool.logs.streams.message_types import MESSAGE_TYPES
from icrtool.logs.streams.positions import (
    GOAL_WORDS,
    TRANSFORM_FIELDS,
    TRANSFORM_STAMP,
    TRANSFORM_TYPES,
    Fix,
    every_transform_pose,
    is_static,
)
from icrtool.logs.streams.sources import increasing_rows, number_of, stamp_rows
from icrtool.records.places import place_of
from icrtool.records.text import did_you_mean, listed
from icrtool.records.topic_poses import TopicPoses

LEAST_QUATERNION = 0.1
"""Smallest norm of a quaternion that is accepted as an orientation and normalised."""

LARGEST_QUATERNION = 10.0
"""Largest norm of a quaternion that is accepted as an orientation and normalised."""


def _pose_fields() -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each message type with metric poses, with its fields: x and y, then the quaternion x, y, z, w."""
    for name, fix in MESSAGE_TYPES["gnss"].items():
        turn = MESSAGE_TYPES["heading"].get(name)
        if isinstance(fix, Fix) and fix.metric and isinstance(turn, Orientation):
            yield name, (*fix.coordinates[:2], *(f"{turn.path}.{axis}" for axis in "xyzw"))


POSE_FIELDS = dict(_pose_fields())
"""Fields of the position x, y and of the quaternion x, y, z, w, by message type."""


def scorable_topics(survey: SurveyDocument, used: Iterable[str]) -> tuple[str, ...]:
    """Return the topics of a log with poses, without topics of goals and the topics in `used`."""
    excluded = set(used)
    return tuple(
        topic.topic
        for topic in survey.topics
        if topic.message_type in POSE_FIELDS
        and topic.topic not in excluded
        and topic.messages != 0
        and not GOAL_WORDS.search(topic.topic)
    )


def read_topic_poses(path: str | Path, topics: Sequence[str], progress: Progress | None = None) -> list[TopicPoses]:
    """Return the poses of some topics of a log, read in one pass over it.

    Parameters
    ----------
    path : path or address of a log, as for `icrtool.read_log`
    topics : names of topics. For a topic of type ``tf2_msgs/TFMessage``, the poses are of the robot's base in the root
        frame of the moving transforms
    progress : called with the share of the log that has been read, 0 to 1

    Raises
    ------
    LogError
        The log cannot be read.
    ConfigError
        A topic is not in the log, or holds no poses.
    DataError
        A topic holds fewer than two poses.
    """
    path = place_of(path)
    if is_table(path):
        raise ConfigError("score", f"{path} is a table, which has no topics", "name a bag or MCAP file")
    with contextlib.closing(open_log(path, progress)) as container:
        chosen = _channels_of(topics, container.channels)
        wanted = {channel.id: _fields_of(channel) for channel in chosen}
        tables, unread = collect_tables(container, wanted, progress=progress)
    by_topic = {str(table.topic): table for table in tables}
    poses = []
    for topic in topics:
        if topic in unread:
            raise ConfigError("score", f"{topic}: {unread[topic]}", "name another topic")
        try:
            poses.append(_poses_of(by_topic[topic], path))
        except DefinitionError as err:
            raise ConfigError("score", f"{topic}: {err.why}", "name another topic") from err
    return poses


def _channels_of(topics: Sequence[str], channels: Sequence[Channel]) -> list[Channel]:
    """Return the channels of some topics.

    Raises
    ------
    ConfigError
        The log has no such topic, or its messages are no poses.
    """
    chosen: list[Channel] = []
    by_topic: dict[str, list[Channel]] = {}
    for channel in channels:
        by_topic.setdefault(str(channel.topic), []).append(channel)
    poses = [topic for topic, topic_channels in by_topic.items() if _fields_of(topic_channels[0])]
    advice = f"the log has poses in {listed(poses)}" if poses else "the log has no topic with poses"
    for topic in topics:
        if topic not in by_topic:
            raise ConfigError("score", f"the log has no topic {topic}", f"{did_you_mean(topic, poses)}{advice}")
        for channel in by_topic[topic]:
            if not _fields_of(channel):
                raise ConfigError("score", f"{topic} is a {channel.message_type}, which holds no pose", advice)
            chosen.append(channel)
    return chosen


def _fields_of(channel: Channel) -> tuple[str, ...]:
    """Return the fields with the poses of a channel; empty for a channel without poses."""
    if channel.message_type in TRANSFORM_TYPES:
        return () if is_static(channel) else (*HEADER, *TRANSFORM_FIELDS, *TRANSFORM_STAMP)
    fields = POSE_FIELDS.get(channel.message_type)
    return () if fields is None else (*HEADER, *fields)


def _poses_of(table: TopicTable, log: Path) -> TopicPoses:
    """Return the poses in the messages of a topic.

    Raises
    ------
    DefinitionError
        The type, as the log defines it, lacks the pose.
    DataError
        There are fewer than two usable poses.
    """
    message_type = str(table.message_type)
    if table.message_type in TRANSFORM_TYPES:
        table = every_transform_pose(table)
    x, y, *q = (number_of(table, field, needed=True) for field in POSE_FIELDS[table.message_type])
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.sqrt(sum(component * component for component in q))
        usable: Bools = (norm > LEAST_QUATERNION) & (norm < LARGEST_QUATERNION) & np.isfinite(x) & np.isfinite(y)
    stamps = stamp_rows(table)
    order = stamps.header_ns if stamps.header_ns is not None else stamps.log_ns
    rows, _, _ = increasing_rows(order, usable)
    if len(order[rows]) < 2:
        raise DataError(log, f"{table.topic} holds {len(order[rows])} usable poses", "at least two are needed")
    ahead, left, _ = turned_axis(0, *(component[rows] / norm[rows] for component in q))
    # Seen from above, the y axis is left of the x axis; in a frame whose z axis points down, it is right of it.
    side = 1.0 if frame_convention(table)[0] == "ned" else -1.0
    heading = unwrapped(np.arctan2(side * left, ahead))
    header_ns = None if stamps.header_ns is None else stamps.header_ns[rows]
    log_ns = np.maximum.accumulate(stamps.log_ns[rows])
    gap = long_intervals(np.diff(order[rows]) / 1e9)
    return TopicPoses(str(table.topic), message_type, header_ns, log_ns, x[rows] + side * 1j * y[rows], heading, gap)
