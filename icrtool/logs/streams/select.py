"""Choice of the topics for wheels, position and heading among candidates, with the reason for each choice."""

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
from icrtool.logs.streams.sources import HeadingSource, PositionSource, Source, WheelSource, topic_fields
from icrtool.logs.streams.wheel_pairs import PAIR_TYPES, pair_candidates, side_fields, topic_of_side
from icrtool.records.notes import Note, note
from icrtool.records.samples import ROLE_WORDS, Role
from icrtool.records.text import did_you_mean, listed

SourceType = TypeVar("SourceType", WheelSource, PositionSource, HeadingSource)

NEEDS: dict[Role, str] = {
    "wheels": "wheel joints, encoders, motor feedback, wheel odometry or a twist; for other message types, name the "
    "fields (/topic.field) in topics.wheel_left and wheel_right, or a body twist in topics.twist_speed and twist_turn",
    "gnss": "a GNSS fix, or a pose of a reference (total station, lidar, motion capture)",
    "heading": "an orientation (AHRS), a compass or a dual antenna heading",
}

"""Data that each role needs, for messages."""

NAMESPACE_BONUS = 8.0
"""Number that is added to the score of a candidate in the namespace of the wheels, which shows the same robot."""

ROLE_BONUS = 5.0
"""Number that is added to the score of wheels for each other role that their namespace can fill. Of two robots, the one
with all sensors is then chosen."""

LEAST_MEASURED_SCORE = 40.0
"""Smallest score of measured wheels. Topics with a smaller score hold commands or velocities of other sensors."""

POSE_HEADING_BONUS = 100.0
"""Number that is added to the score of a heading from the same topic as a metric position. Both have one frame; another
heading does not fit a local map."""

NO_SCHEMA = "no schema"
"""Text in place of the message type of a channel without one."""

MOST_LISTED_TOPICS = 40
"""Largest number of topics that an error lists."""

MOST_REFERENCES = 3
"""Largest number of other position references that are compared with the chosen one."""

FUSED_WORDS = re.compile(r"ekf|ukf|fused|filtered|localization|global", re.IGNORECASE)
"""Words in names of poses of another filter. Such a filter usually uses the wheels, so that agreement with the wheels
shows nothing."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """The sources that were found.

    Attributes
    ----------
    wheels, gnss, heading : sources for each role, the best one first
    unread : for each other topic of a known type the reason why it is no source
    """

    wheels: tuple[WheelSource, ...]
    gnss: tuple[PositionSource, ...]
    heading: tuple[HeadingSource, ...]
    unread: dict[str, str] = field(default_factory=dict)

    def by_role(self) -> dict[Role, Sequence[Source]]:
        """Return the sources of each role."""
        return {"wheels": self.wheels, "gnss": self.gnss, "heading": self.heading}


@dataclass(frozen=True, slots=True)
class Choice:
    """The chosen source of each role, with the reason in its `why`; `heading` is None where no topic holds one."""

    wheels: WheelSource
    gnss: PositionSource
    heading: HeadingSource | None


def wanted_fields(channels: Sequence[Channel], config: Config) -> dict[int, tuple[str, ...]]:
    """Return the paths of the fields to read, by channel id; channels that no role needs are absent.

    Moving transforms take longer to read than the rest of a log. They are read only if no other topic can be the
    position; an odometry whose name shows no position reference does not count as one.
    """
    topics, wanted, static, moving = config.topics, {}, {}, {}
    sides = side_fields(channels, topics)
    has_position = any(
        channel.message_type in MESSAGE_TYPES["gnss"]
        and (channel.message_type != "nav_msgs/Odometry" or REFERENCE_WORDS.search(channel.topic) is not None)
        for channel in channels
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
    # For a channel that is in several dicts, the fields of the last one are used.
    return wanted | static | moving


def find_candidates(tables: Sequence[TopicTable], config: Config, unread: dict[str, str]) -> Candidates:
    """Return all topics as sources for the roles that they may have, ranked by type, content and namespace.

    Columns that are no longer needed are removed from the tables. For topics that can only be wheels this is done
    before the other topics are read.

    Parameters
    ----------
    tables : tables of the topics
    config : the configuration
    unread : reason why a topic was not decoded, by topic
    """
    topics = config.topics
    # The wheels come first, because they have the largest columns, which are then removed.
    wheels = pair_candidates(tables, config)
    if not topics.fields_of_wheels:
        wheels = _read_all(tables, "wheels", config, WheelSource) + wheels
    others_read = MESSAGE_TYPES["gnss"].keys() | MESSAGE_TYPES["heading"].keys()
    drop_used_columns([table for table in tables if table.message_type not in others_read])
    gnss = _read_all(tables, "gnss", config, PositionSource)
    heading = _read_all(tables, "heading", config, HeadingSource)
    filled = [{_namespace(source.topic) for source in sources if not source.problem} for sources in (gnss, heading)]
    complete = {name: ROLE_BONUS * sum(name in names for names in filled) for name in set().union(*filled)}
    wheels = _rank_sources(wheels, topics.wheels, complete)
    near = {_namespace(wheels[0].topic): NAMESPACE_BONUS} if wheels else {}
    others = _other_robots(wheels)
    # The position in the messages whose twist is used for the wheels is refused, unless it is configured.
    own = wheels[0].topic if wheels and not wheels[0].problem and wheels[0].twist is not None else None
    dependent = "its twist is used for the wheels; a reference must be independent of them"
    gnss = [
        replace(source, problem=source.problem or dependent) if source.topic == own and topics.gnss != own else source
        for source in gnss
    ]
    gnss = _rank_sources(gnss, topics.gnss, near, others)
    best = gnss[0] if gnss and not gnss[0].problem else None
    metric = best.topic if best is not None and best.metric is not None else ""
    others -= {_namespace(metric)} if metric else set()
    heading = _rank_sources(heading, topics.heading, near, others, metric)
    lost = "none of its {} messages fits its message type"
    empty: dict[str, str] = {
        table.topic: lost.format(table.unreadable) if table.unreadable else "no message"
        for table in tables
        if not len(table)
    }
    drop_used_columns(tables)
    return Candidates(tuple(wheels), tuple(gnss), tuple(heading), unread | empty)


def drop_used_columns(tables: Sequence[TopicTable]) -> None:
    """Remove the columns that only candidates are made from, which take half of the memory of a log."""
    for table in tables:
        for name in table.columns.keys() - {*HEADER, *GYRO_AXES, *TRANSFORM_FIELDS}:
            del table.columns[name]


def _read_all(
    tables: Sequence[TopicTable], role: Role, config: Config, source_class: type[SourceType]
) -> list[SourceType]:
    """Return the topics of a role as sources; a topic whose type lacks a needed field gets a `problem`."""
    sources = []
    for table in tables:
        row = MESSAGE_TYPES[role].get(table.message_type)
        if row is not None and getattr(config.topics, role) in (None, table.topic) and len(table):
            try:
                sources.append(cast("SourceType", row.read(table, config)))
            except DefinitionError as err:
                sources.append(source_class(**topic_fields(table), problem=err.why))
    return sources


def _rank_sources(
    sources: Sequence[SourceType],
    configured: str | None,
    bonus: Mapping[str, float],
    others: frozenset[str] = frozenset(),
    pose_topic: str = "",
) -> list[SourceType]:
    """Return the sources sorted: usable ones first, sources of this robot before other robots, then by score.

    Parameters
    ----------
    configured : configured topic of the role, which counts as usable
    bonus : number that is added to the score, by namespace
    others : namespaces of other robots
    pose_topic : topic of the chosen metric pose, whose heading is preferred
    """

    def rank(source: SourceType) -> tuple[bool, bool, float]:
        home = _namespace(source.topic)
        score = source.score + (bonus.get(home, 0.0) if home else 0.0)
        score += POSE_HEADING_BONUS if source.topic == pose_topic else 0.0
        return bool(source.problem) and source.topic != configured, home in others, -score

    return sorted(sources, key=rank)


def _namespace(topic: str) -> str:
    """Return the namespace of a topic: the first part of its name; empty for a name of one part."""
    parts = topic.strip("/").split("/")
    return parts[0] if len(parts) > 1 else ""


def _other_robots(wheels: Sequence[WheelSource]) -> frozenset[str]:
    """Return the namespaces of wheels with the same message type as the best ones, which belong to other robots."""
    if not wheels:
        return frozenset()
    best = wheels[0]
    alike = (
        w for w in wheels if not w.problem and w.score >= LEAST_MEASURED_SCORE and w.message_type == best.message_type
    )
    return frozenset(_namespace(w.topic) for w in alike) - {_namespace(best.topic), ""}


def choose_streams(
    candidates: Candidates, config: Config, log: str, channels: Sequence[Channel], lost: str = ""
) -> Choice:
    """Return the source of each role.

    Parameters
    ----------
    candidates : sources of each role
    config : the configuration
    log : path of the log in errors
    channels : all channels of the log, for errors
    lost : text about unreadable parts of the log, for errors

    Raises
    ------
    ConfigError
        A configured topic is not in the log, or cannot feed its role; or no message lists a configured joint.
    MissingStreamError
        A role has no usable candidate. The error names all such roles and lists the topics of the log.
    """
    topics = config.topics
    topics_of_wheels = topics.wheels
    if sides := topics.fields_of_wheels:
        _check_sides(sides, candidates, log, channels)
        topics_of_wheels = " + ".join(sides.values())
    wheels = _choose_source(candidates.wheels, topics_of_wheels)
    check_joints(wheels, candidates.wheels, config)
    _check_roles(topics, candidates, log, channels)
    gnss, heading = _choose_source(candidates.gnss, topics.gnss), _choose_source(candidates.heading, topics.heading)
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
        raise MissingStreamError(log, needs, _list_topics(channels, reasons), lost)
    return Choice(wheels, gnss, heading)


def other_references(candidates: Candidates, choice: Choice, config: Config) -> tuple[Choice, ...]:
    """Return a choice for each other position reference that may be better than the chosen one.

    A pose is used with its own heading. A second GNSS receiver is no other reference. If a topic of position or heading
    is configured, no other reference is returned.
    """
    if config.topics.gnss is not None or config.topics.heading is not None:
        return ()
    poses = {source.topic for source in candidates.gnss if source.metric is not None}
    home, others = _namespace(choice.wheels.topic), _other_robots(candidates.wheels)
    choices = []
    for source in candidates.gnss:
        is_excluded = _namespace(source.topic) in others - {home} or bool(FUSED_WORDS.search(source.topic))
        both_geodetic = source.metric is None and choice.gnss.metric is None
        if source.topic == choice.gnss.topic or source.problem or is_excluded or both_geodetic:
            continue
        wanted = (
            {source.topic}
            if source.metric is not None
            else {candidate.topic for candidate in candidates.heading} - poses
        )
        heading = next(
            (candidate for candidate in candidates.heading if candidate.topic in wanted and not candidate.problem), None
        )
        if heading is not None:
            choices.append(Choice(choice.wheels, source, heading))
    return tuple(choices[:MOST_REFERENCES])


def _check_sides(sides: Mapping[str, str], candidates: Candidates, log: str, channels: Sequence[Channel]) -> None:
    """Refuse configured fields of the wheels that the log lacks or that cannot be used; raise `ConfigError`."""
    for side, name in sides.items():
        key, topic = f"topics.{side}", topic_of_side(name)
        needed = f"name the field of one side as {topic}.left or {topic}.data[0]"
        message_type = _type_in(log, channels, candidates.unread, key, topic)
        if message_type not in PAIR_TYPES and topic == name:
            raise ConfigError(key, f"{topic}: {message_type} is not the number of one side", needed)
        if topic in candidates.unread:
            raise ConfigError(key, f"{topic}: {candidates.unread[topic]}", needed)
    if candidates.wheels and candidates.wheels[0].is_empty:
        why = f"{candidates.wheels[0].topic}: {candidates.wheels[0].problem}"
        raise ConfigError(f"topics.{next(iter(sides))}", why, "name another pair")


def _check_roles(topics: TopicsConfig, candidates: Candidates, log: str, channels: Sequence[Channel]) -> None:
    """Refuse a configured topic that the log lacks or that has no usable row; raise `ConfigError`.

    Other problems of a configured topic are ignored.
    """
    for role, sources in candidates.by_role().items():
        if (configured := getattr(topics, role)) is None:
            continue
        key, needed = f"topics.{role}", f"it needs {NEEDS[role]}"
        message_type = _type_in(log, channels, candidates.unread, key, configured)
        if not sources:
            if role == "wheels" and message_type in PAIR_TYPES:
                needed = "name both sides in topics.wheel_left and topics.wheel_right"
            raise ConfigError(
                key, f"{configured}: {candidates.unread.get(configured, f'{message_type} cannot feed it')}", needed
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
        advice = f"{did_you_mean(topic, types)}it holds {', '.join(_list_topics(channels, unread))}"
        raise ConfigError(key, f"{topic} is not in {log}", advice)
    return types[topic]


def _choose_source(sources: Sequence[SourceType], configured: str | None) -> SourceType | None:
    """Return the first usable source, with the reason for the choice in its `why`; None without a usable source."""
    best = next((source for source in sources if not source.problem or source.topic == configured), None)
    if best is None:
        return None
    rest = [source.topic for source in sources if source is not best]
    over = f"; chosen over {listed(rest[:3])}" if rest else ""
    return replace(best, why=best.why + (over if configured is None else "; configured"))


def _list_topics(channels: Sequence[Channel], reasons: Mapping[str, str]) -> list[str]:
    """Return a text for each topic of the log: name, message type, reason of a refusal; refused topics come first."""
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
"""Keys of the configuration that name the joints of each side."""


def check_joints(chosen: WheelSource | None, candidates: Sequence[WheelSource], config: Config) -> None:
    """Refuse a configured joint that no message of the wheels' topic lists; its side would be a mean of fewer wheels.

    Parameters
    ----------
    chosen : the chosen wheels, None without usable wheels
    candidates : all wheels that were found; if `chosen` lists no joints, the topic with the most configured joints is
        named in the error
    config : the configuration

    Raises
    ------
    ConfigError
        No message lists a configured joint.
    """
    listing = [chosen] if chosen is not None and chosen.joints else [motion for motion in candidates if motion.joints]
    unlisted = [
        [(key, name) for key in JOINT_KEYS for name in getattr(config.wheels, key) if name not in motion.joints]
        for motion in listing
    ]
    closest = min(range(len(listing)), key=lambda i: len(unlisted[i]), default=None)
    if closest is not None and unlisted[closest]:
        key, name = unlisted[closest][0]
        why, advice = f"no message of {listing[closest].topic} lists a joint {name}", listed(listing[closest].joints)
        raise ConfigError(f"wheels.{key}", why, f"its joints are {advice}")


def ignored_joints(chosen: WheelSource, config: Config) -> list[Note]:
    """Return a finding for each configured list of joints that is not used because the messages list no joints."""
    if chosen.joints:
        return []
    reason = f"{chosen.topic} ({chosen.message_type}) lists no joints by name"
    return [
        note("joints_not_used", f"wheels.{key} is not used: {reason}")
        for key in JOINT_KEYS
        if getattr(config.wheels, key)
    ]
