"""Choose the topic for each role: wheels, position and heading; each candidate with its reasons."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

from icrtool.config import Config, TopicsConfig
from icrtool.errors import ConfigError, DefinitionError, MissingStreamError
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.topic_table import HEADER, READ_ENCODINGS, TopicTable
from icrtool.logs.streams.headings import GYRO_AXES, GYRO_TYPE
from icrtool.logs.streams.message_types import MESSAGE_TYPES
from icrtool.logs.streams.positions import (
    REFERENCE_WORDS,
    TRANSFORM_FIELDS,
    TRANSFORM_STAMP,
    TRANSFORM_TYPES,
    is_static,
)
from icrtool.logs.streams.sources import HeadingSource, PositionSource, Source, WheelSource, of_topic
from icrtool.logs.streams.wheel_pairs import PAIR_TYPES, pair_candidates, side_fields, topic_of_side
from icrtool.records.notes import Note, note
from icrtool.records.samples import ROLE_WORDS, Role
from icrtool.records.text import did_you_mean, listed

Kind = TypeVar("Kind", WheelSource, PositionSource, HeadingSource)

NEEDS: dict[Role, str] = {
    "wheels": "wheel joints, encoders, motor feedback, wheel odometry or a twist; of messages of other types "
    "topics.wheel_left and wheel_right name the fields (/topic.field), of a body twist twist_speed and twist_turn",
    "gnss": "a GNSS fix, or a pose of a reference (total station, lidar, motion capture)",
    "heading": "an orientation (AHRS), a compass or a dual antenna heading",
}

SAME_NAMESPACE = 8.0
"""Added to the score of a candidate in the namespace of the wheels, which belongs to the same robot."""

COMPLETE = 5.0
"""Added for each other role that the wheels' namespace can fill: of two robots, the one with all sensors is chosen."""

WORTHY = 40.0
"""Least score of measured wheels; topics below are commands or velocities of other sensors."""

SAME_MESSAGE = 100.0
"""Added to the score of the heading of the metric pose that gives the position: both share a frame, and another heading
does not fit a local map."""

NO_SCHEMA = "no schema"
"""Stands for the message type of a channel that states none."""

MOST_LISTED_TOPICS = 40
MOST_REFERENCES = 3

FUSED_WORDS = re.compile(r"ekf|ukf|fused|filtered|localization|global", re.IGNORECASE)
"""Words in names of poses that another filter made, usually with the wheels: agreement with the wheels shows
nothing."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """All sources found, best first by role; `unread`: why other topics of known types cannot be sources."""

    wheels: tuple[WheelSource, ...]
    gnss: tuple[PositionSource, ...]
    heading: tuple[HeadingSource, ...]
    unread: dict[str, str] = field(default_factory=dict)

    def by_role(self) -> dict[Role, Sequence[Source]]:
        """Return the sources of each role."""
        return {"wheels": self.wheels, "gnss": self.gnss, "heading": self.heading}


@dataclass(frozen=True, slots=True)
class Choice:
    """The source of each role, with the reason for the choice; `heading` is None where no topic holds one."""

    wheels: WheelSource
    gnss: PositionSource
    heading: HeadingSource | None


def fields_to_take(channels: Sequence[Channel], config: Config) -> dict[int, tuple[str, ...]]:
    """Return, by channel id, the fields that some role may need; other channels are absent.

    Moving transforms are taken where no topic can be the position: reading them takes longer than the rest of a log. An
    odometry that is no reference by name does not count.
    """
    topics, wanted, static, moving = config.topics, {}, {}, {}
    sides = side_fields(channels, topics)
    has_position = any(
        one.message_type in MESSAGE_TYPES["gnss"]
        and (one.message_type != "nav_msgs/Odometry" or REFERENCE_WORDS.search(one.topic) is not None)
        for one in channels
    )
    for channel in channels:
        paths = sorted(sides[channel.id])
        for role in ROLE_WORDS:
            row = MESSAGE_TYPES[role].get(channel.message_type)
            is_open = getattr(topics, role) in (None, channel.topic) and (
                role != "wheels" or not topics.fields_of_wheels
            )
            paths += row.fields if row is not None and is_open else ()
        if channel.message_type == GYRO_TYPE:
            paths += GYRO_AXES
        if paths:
            wanted[channel.id] = tuple(dict.fromkeys([*HEADER, *paths]))
        if is_static(channel):
            static[channel.id] = TRANSFORM_FIELDS
        elif channel.message_type in TRANSFORM_TYPES and (
            topics.gnss == channel.topic or not (has_position or topics.gnss)
        ):
            moving[channel.id] = (*TRANSFORM_FIELDS, *TRANSFORM_STAMP)
    # if a frame is in both, the moving transform counts
    return wanted | static | moving


def find_candidates(tables: Sequence[TopicTable], config: Config, unread: dict[str, str]) -> Candidates:
    """Return every decoded topic as a source of each role it may have, ranked by type, content and namespace.

    Columns from which only candidates are made are removed: for topics that can only be wheels, before others are read.
    """
    topics = config.topics
    # the wheels first: their memory, the largest, is then free for the others
    wheels = pair_candidates(tables, config)
    if not topics.fields_of_wheels:
        wheels = _read_all(tables, "wheels", config, WheelSource) + wheels
    others_read = MESSAGE_TYPES["gnss"].keys() | MESSAGE_TYPES["heading"].keys()
    drop_used_columns([table for table in tables if table.message_type not in others_read])
    gnss = _read_all(tables, "gnss", config, PositionSource)
    heading = _read_all(tables, "heading", config, HeadingSource)
    filled = [{_namespace(source.topic) for source in sources if not source.problem} for sources in (gnss, heading)]
    complete = {name: COMPLETE * sum(name in names for names in filled) for name in set().union(*filled)}
    wheels = _ranked(wheels, topics.wheels, complete)
    near = {_namespace(wheels[0].topic): SAME_NAMESPACE} if wheels else {}
    others = _other_robots(wheels)
    # The position of the message whose twist is used for the wheels is refused, where it is not configured.
    own = wheels[0].topic if wheels and not wheels[0].problem and wheels[0].twist is not None else None
    dependent = "its twist is used for the wheels; a reference must be independent of them"
    gnss = [
        replace(one, problem=one.problem or dependent) if one.topic == own and topics.gnss != own else one
        for one in gnss
    ]
    gnss = _ranked(gnss, topics.gnss, near, others)
    best = gnss[0] if gnss and not gnss[0].problem else None
    metric = best.topic if best is not None and best.metric is not None else ""
    others -= {_namespace(metric)} if metric else set()
    heading = _ranked(heading, topics.heading, near, others, metric)
    lost = "none of its {} messages fits its message type"
    empty: dict[str, str] = {
        table.topic: lost.format(table.unreadable) if table.unreadable else "no message"
        for table in tables
        if not len(table)
    }
    drop_used_columns(tables)
    return Candidates(tuple(wheels), tuple(gnss), tuple(heading), unread | empty)


def drop_used_columns(tables: Sequence[TopicTable]) -> None:
    """Remove the columns from which only candidates were made: half of the memory of a log."""
    for table in tables:
        for name in table.columns.keys() - {*HEADER, *GYRO_AXES, *TRANSFORM_FIELDS}:
            del table.columns[name]


def _read_all(tables: Sequence[TopicTable], role: Role, config: Config, kind: type[Kind]) -> list[Kind]:
    """Return the topics of one role as sources; a topic whose type lacks a needed field in this log is not usable."""
    sources = []
    for table in tables:
        row = MESSAGE_TYPES[role].get(table.message_type)
        if row is not None and getattr(config.topics, role) in (None, table.topic) and len(table):
            try:
                sources.append(cast("Kind", row.read(table, config)))
            except DefinitionError as err:
                sources.append(kind(**of_topic(table), problem=err.why))
    return sources


def _ranked(
    sources: Sequence[Kind],
    configured: str | None,
    bonus: Mapping[str, float],
    others: frozenset[str] = frozenset(),
    same: str = "",
) -> list[Kind]:
    """Return the sources sorted: usable ones first, this robot's before other robots', then by score and bonus.

    Parameters
    ----------
    bonus, others : what is added to a score, by namespace; namespaces of other robots
    same : the topic of a metric pose, whose heading is preferred
    """

    def rank(source: Kind) -> tuple[bool, bool, float]:
        home = _namespace(source.topic)
        worth = source.score + (bonus.get(home, 0.0) if home else 0.0) + (SAME_MESSAGE if source.topic == same else 0.0)
        return bool(source.problem) and source.topic != configured, home in others, -worth

    return sorted(sources, key=rank)


def _namespace(topic: str) -> str:
    """Return the first name of a topic with more than one."""
    parts = topic.strip("/").split("/")
    return parts[0] if len(parts) > 1 else ""


def _other_robots(wheels: Sequence[WheelSource]) -> frozenset[str]:
    """Return the namespaces in which another robot's wheels of the same type turn."""
    if not wheels:
        return frozenset()
    best = wheels[0]
    alike = (w for w in wheels if not w.problem and w.score >= WORTHY and w.message_type == best.message_type)
    return frozenset(_namespace(w.topic) for w in alike) - {_namespace(best.topic), ""}


def choose_streams(
    candidates: Candidates, config: Config, log: str, channels: Sequence[Channel], lost: str = ""
) -> Choice:
    """Return the source of each role; `lost`: what of the log could not be read.

    Raises
    ------
    ConfigError
        A configured topic is not in the log, or cannot feed its role; a configured joint is not among the wheels'.
    MissingStreamError
        No candidate for one role or more; the error names them all and lists what the log holds.
    """
    topics = config.topics
    topics_of_wheels = topics.wheels
    if sides := topics.fields_of_wheels:
        _check_sides(sides, candidates, log, channels)
        topics_of_wheels = " + ".join(sides.values())
    wheels = _chosen(candidates.wheels, topics_of_wheels)
    check_joints(wheels, candidates.wheels, config)
    _check_roles(topics, candidates, log, channels)
    gnss, heading = _chosen(candidates.gnss, topics.gnss), _chosen(candidates.heading, topics.heading)
    if wheels is None or gnss is None:
        by_role: dict[Role, object] = {"wheels": wheels, "gnss": gnss, "heading": heading}
        missing = [role for role, source in by_role.items() if source is None]
        refused: dict[str, dict[str, None]] = {}
        for role in missing:
            for source in candidates.by_role()[role]:
                for topic in map(topic_of_side, source.topic.split(" + ")):
                    refused.setdefault(topic, {})[source.problem] = None
        reasons = candidates.unread | {topic: ", ".join(problems) for topic, problems in refused.items()}
        needs = {ROLE_WORDS[role]: NEEDS[role] for role in missing}
        raise MissingStreamError(log, needs, _listing(channels, reasons), lost)
    return Choice(wheels, gnss, heading)


def other_references(candidates: Candidates, choice: Choice, config: Config) -> tuple[Choice, ...]:
    """Return the choice with each other position reference that may be better than the chosen one.

    A pose brings its own heading; GNSS receivers next to the chosen one are no other reference. A configured topic of
    position or heading has precedence: then there is none.
    """
    if config.topics.gnss is not None or config.topics.heading is not None:
        return ()
    poses = {source.topic for source in candidates.gnss if source.metric is not None}
    home, others = _namespace(choice.wheels.topic), _other_robots(candidates.wheels)
    choices = []
    for source in candidates.gnss:
        foreign = _namespace(source.topic) in others - {home} or bool(FUSED_WORDS.search(source.topic))
        same_kind = source.metric is None and choice.gnss.metric is None
        if source.topic == choice.gnss.topic or source.problem or foreign or same_kind:
            continue
        wanted = {source.topic} if source.metric is not None else {one.topic for one in candidates.heading} - poses
        heading = next((one for one in candidates.heading if one.topic in wanted and not one.problem), None)
        if heading is not None:
            choices.append(Choice(choice.wheels, source, heading))
    return tuple(choices[:MOST_REFERENCES])


def _check_sides(sides: Mapping[str, str], candidates: Candidates, log: str, channels: Sequence[Channel]) -> None:
    """Refuse a configured pair of fields, by key, that the log does not have or that cannot be used."""
    for side, name in sides.items():
        key, topic = f"topics.{side}", topic_of_side(name)
        needed = f"name the field of one side as {topic}.left or {topic}.data[0]"
        if (kind := _type_in(log, channels, candidates.unread, key, topic)) not in PAIR_TYPES and topic == name:
            raise ConfigError(key, f"{topic}: {kind} is not the number of one side", needed)
        if topic in candidates.unread:
            raise ConfigError(key, f"{topic}: {candidates.unread[topic]}", needed)
    if candidates.wheels and candidates.wheels[0].is_empty:
        why = f"{candidates.wheels[0].topic}: {candidates.wheels[0].problem}"
        raise ConfigError(f"topics.{next(iter(sides))}", why, "name another pair")


def _check_roles(topics: TopicsConfig, candidates: Candidates, log: str, channels: Sequence[Channel]) -> None:
    """Refuse a configured topic that the log does not have or that has no usable row; other problems do not count."""
    for role, sources in candidates.by_role().items():
        if (configured := getattr(topics, role)) is None:
            continue
        key, needed = f"topics.{role}", f"it needs {NEEDS[role]}"
        kind = _type_in(log, channels, candidates.unread, key, configured)
        if not sources:
            if role == "wheels" and kind in PAIR_TYPES:
                needed = "name both sides in topics.wheel_left and topics.wheel_right"
            raise ConfigError(
                key, f"{configured}: {candidates.unread.get(configured, f'{kind} cannot feed it')}", needed
            )
        if sources[0].is_empty:
            raise ConfigError(key, f"{configured}: {sources[0].problem or 'nothing usable in it'}", needed)


def _type_in(log: str, channels: Sequence[Channel], unread: Mapping[str, str], key: str, topic: str) -> str:
    """Return the message type of a configured topic.

    Raises
    ------
    ConfigError
        The log does not have the topic.
    """
    types: dict[str, str] = {channel.topic: channel.message_type for channel in channels}
    if topic not in types:
        advice = f"{did_you_mean(topic, types)}it holds {', '.join(_listing(channels, unread))}"
        raise ConfigError(key, f"{topic} is not in {log}", advice)
    return types[topic]


def _chosen(sources: Sequence[Kind], configured: str | None) -> Kind | None:
    """Return the first source that can be used, with the reason for the choice; None without one."""
    best = next((source for source in sources if not source.problem or source.topic == configured), None)
    if best is None:
        return None
    rest = [source.topic for source in sources if source is not best]
    over = f"; chosen over {listed(rest[:3])}" if rest else ""
    return replace(best, why=best.why + (over if configured is None else "; configured"))


def _listing(channels: Sequence[Channel], reasons: Mapping[str, str]) -> list[str]:
    """Return the log's topics with their types, refused candidates first."""
    entries: dict[str, str] = {}
    for channel in channels:
        reason = f": {reasons[channel.topic]}" if channel.topic in reasons else ""
        if not reason and channel.encoding not in READ_ENCODINGS:
            reason = f": serialization {str(channel.encoding)!r} is not read"
        entries[channel.topic] = f"{channel.topic} ({channel.message_type or NO_SCHEMA}{reason})"
    ordered = [entries[topic] for topic in sorted(entries, key=lambda topic: topic not in reasons)]
    more = len(ordered) - MOST_LISTED_TOPICS
    return ([*ordered[:MOST_LISTED_TOPICS], f"{more} more"] if more > 0 else ordered) or ["no topic at all"]


JOINT_KEYS = ("left_joints", "right_joints")


def check_joints(chosen: WheelSource | None, candidates: Sequence[WheelSource], config: Config) -> None:
    """Refuse a configured joint that no message of the wheels' topic lists: its side would be the mean of fewer wheels.

    Parameters
    ----------
    chosen : the wheels that would be used, None where there are none
    candidates : all wheels that were found; where `chosen` lists no joints they are looked for here

    Raises
    ------
    ConfigError
        The first such joint, with the listed joints.
    """
    # If the chosen topic lists no joints, none of the others has the configured ones: name the closest one.
    listing = [chosen] if chosen is not None and chosen.joints else [motion for motion in candidates if motion.joints]
    unlisted = [
        [(key, name) for key in JOINT_KEYS for name in getattr(config.wheels, key) if name not in motion.joints]
        for motion in listing
    ]
    closest = min(range(len(listing)), key=lambda place: len(unlisted[place]), default=None)
    if closest is not None and unlisted[closest]:
        key, name = unlisted[closest][0]
        why, advice = f"no message of {listing[closest].topic} lists a joint {name}", listed(listing[closest].joints)
        raise ConfigError(f"wheels.{key}", why, f"its joints are {advice}")


def ignored_joints(chosen: WheelSource, config: Config) -> list[Note]:
    """Return a warning for every configured joint list that is not used, because the messages list no joints."""
    if chosen.joints:
        return []
    why = f"{chosen.topic} ({chosen.message_type}) lists no joints by name"
    return [
        note("joints_not_used", f"wheels.{key} is not used: {why}") for key in JOINT_KEYS if getattr(config.wheels, key)
    ]
