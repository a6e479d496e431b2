"""Which topic feeds which role: every candidate with its reasons, and the choice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

from icrtool.config import Config
from icrtool.errors import ConfigError, MissingStreamError
from icrtool.logio.channel import Channel
from icrtool.logio.heading_sources import HEADING_TYPES, HeadingSource
from icrtool.logio.position_sources import POSITION_TYPES, PositionSource
from icrtool.logio.sides import right_twin
from icrtool.logio.topic_table import TopicTable
from icrtool.logio.wheel_sources import PAIR_TYPES, WHEEL_TYPES, WheelMotion, pair_motion
from icrtool.tables import Role

Source = TypeVar("Source", WheelMotion, PositionSource, HeadingSource)

NEEDS: dict[Role, str] = {
    "wheels": "wheel joints, encoders, motor feedback, wheel odometry or a twist",
    "gnss": "a GNSS fix, or a pose of a reference (total station, lidar, motion capture)",
    "heading": "an orientation (AHRS), a compass or a dual antenna heading",
}
SAME_NAMESPACE = 8.0
"""A candidate in the namespace of the wheels is the same robot's."""

SAME_MESSAGE = 100.0
"""Position and heading of one metric pose share a frame; a heading from elsewhere does not fit a local map."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """All sources found, best first by role; `unread` says of other topics of known types why they are none."""

    wheels: tuple[WheelMotion, ...]
    gnss: tuple[PositionSource, ...]
    heading: tuple[HeadingSource, ...]
    unread: dict[str, str] = field(default_factory=dict)


def fields_to_take(channels: Sequence[Channel], config: Config) -> dict[int, tuple[str, ...]]:
    """Return, by channel id, the fields that some role may need; channels of no use are absent."""
    wanted: dict[int, tuple[str, ...]] = {}
    pair_names = [channel.topic for channel in channels if channel.message_type in PAIR_TYPES]
    pairs = _configured_pair(config) or {
        topic for left in pair_names for topic in (left, right_twin(left, pair_names)) if right_twin(left, pair_names)
    }
    for channel in channels:
        kind, paths = channel.message_type, []
        if kind in WHEEL_TYPES and _may_feed(channel.topic, config.topics.wheels, config.topics.wheel_left):
            paths += WHEEL_TYPES[kind][0]
        if kind in POSITION_TYPES and _may_feed(channel.topic, config.topics.gnss):
            paths += POSITION_TYPES[kind][0]
        if kind in HEADING_TYPES and _may_feed(channel.topic, config.topics.heading):
            paths += HEADING_TYPES[kind][0]
        if channel.topic in pairs and kind in PAIR_TYPES and config.topics.wheels is None:
            paths.append("data")
        if paths:
            wanted[channel.id] = tuple(dict.fromkeys(paths))
    return wanted


def _configured_pair(config: Config) -> set[str]:
    left, right = config.topics.wheel_left, config.topics.wheel_right
    return {left, right} if left is not None and right is not None else set()


def _may_feed(topic: str, configured: str | None, instead: str | None = None) -> bool:
    return topic == configured if configured is not None else instead is None


def find_candidates(tables: Sequence[TopicTable], config: Config, unread: dict[str, str]) -> Candidates:
    """Read every decoded topic in each role it may have; rank by type, content and namespace."""
    wheels = _wheel_candidates(tables, config)
    gnss = [POSITION_TYPES[t.message_type][1](t) for t in tables if _has_role(t, POSITION_TYPES, config.topics.gnss)]
    heading = [HEADING_TYPES[t.message_type][1](t) for t in tables if _has_role(t, HEADING_TYPES, config.topics.heading)]
    ranked_wheels = _ranked(wheels, config.topics.wheels, "")
    home = _namespace(ranked_wheels[0].topic) if ranked_wheels else ""
    ranked_gnss = _ranked(gnss, config.topics.gnss, home)
    best = ranked_gnss[0] if ranked_gnss and not ranked_gnss[0].problem else None
    metric = best.topic if best is not None and best.metric is not None else ""
    return Candidates(
        tuple(ranked_wheels),
        tuple(ranked_gnss),
        tuple(_ranked(heading, config.topics.heading, home, same_message=metric)),
        unread,
    )


def _has_role(table: TopicTable, types: dict[str, tuple[tuple[str, ...], object]], configured: str | None) -> bool:
    return table.message_type in types and (configured is None or table.topic == configured) and len(table) > 0


def _wheel_candidates(tables: Sequence[TopicTable], config: Config) -> list[WheelMotion]:
    found = []
    single = config.topics.wheel_left is None
    for table in tables:
        if single and _has_role(table, WHEEL_TYPES, config.topics.wheels):
            motion = WHEEL_TYPES[table.message_type][1](table, config)
            if motion is not None:
                found.append(motion)
    by_topic = {table.topic: table for table in tables if table.message_type in PAIR_TYPES}
    names = list(by_topic)
    for left_name, left in by_topic.items():
        right_name = config.topics.wheel_right if left_name == config.topics.wheel_left else None
        if single:
            right_name = right_twin(left_name, names)
        right = by_topic.get(right_name) if right_name is not None else None
        if right is not None and (single is False or right.message_type == left.message_type):
            found.append(pair_motion(left, right, config))
    return found


def _ranked(sources: list[Source], configured: str | None, home: str, *, same_message: str = "") -> list[Source]:
    """Sort: usable before not, then by score."""

    def rank(source: Source) -> tuple[bool, float]:
        score = source.score + (SAME_NAMESPACE if home and _namespace(source.topic) == home else 0.0)
        if same_message:
            score += SAME_MESSAGE if source.topic == same_message else 0.0
        forced = configured is not None and source.topic == configured
        return (bool(source.problem) and not forced, -score)

    return sorted(sources, key=rank)


def _namespace(topic: str) -> str:
    """Return the first name of a topic with more than one."""
    parts = topic.strip("/").split("/")
    return parts[0] if len(parts) > 1 else ""


def choose(
    role: Role, sources: Sequence[Source], configured: str | None, log: str, channels: Sequence[Channel], unread: dict[str, str]
) -> tuple[Source, str]:
    """Return the source of a role and, in words, why it was chosen.

    Raises
    ------
    ConfigError
        The configured topic is not in the log, or cannot feed this role.
    MissingStreamError
        No candidate; the error lists what the log holds.
    """
    if configured is not None and not sources:
        topics = {channel.topic: channel.message_type for channel in channels}
        if configured not in topics:
            raise ConfigError(f"topics.{role}", f"{configured} is not in {log}", f"it holds {_listing(channels, unread)}")
        reason = unread.get(configured, f"{topics[configured]} cannot feed {role}")
        raise ConfigError(f"topics.{role}", f"{configured}: {reason}", f"it needs {NEEDS[role]}")
    usable = [source for source in sources if not source.problem or source.topic == configured]
    if not usable:
        refused = [f"{source.topic} ({source.message_type}: {source.problem})" for source in sources]
        others = [text for text in _entries(channels, unread) if text.split(" ")[0] not in {s.topic for s in sources}]
        raise MissingStreamError(log, {"gnss": "position"}.get(role, role), NEEDS[role], refused + others)
    best = usable[0]
    if configured is not None:
        return best, f"{best.why}; configured"
    rest = [source for source in sources if source is not best]
    over = f"; chosen over {', '.join(source.topic for source in rest[:3])}" if rest else ""
    return best, f"{best.why}{over}"


def _entries(channels: Sequence[Channel], unread: dict[str, str]) -> list[str]:
    entries = {}
    for channel in channels:
        reason = unread.get(channel.topic)
        entries[channel.topic] = f"{channel.topic} ({channel.message_type}{': ' + reason if reason else ''})"
    return list(entries.values())


def _listing(channels: Sequence[Channel], unread: dict[str, str]) -> str:
    return ", ".join(_entries(channels, unread)) or "no topic at all"


def common_clock(delays_s: Sequence[float | None]) -> Literal["header", "log"]:
    """Choose one clock for streams that are used together.

    `delays_s` holds, by stream, log time minus header stamp, None where there are no header stamps. Where some
    stream has only log times and another's header is far from them, all go by log time.
    """
    told = [delay for delay in delays_s if delay is not None]
    if len(told) == len(delays_s):
        return "header"
    return "log" if any(abs(delay) > 0.1 for delay in told) else "header"
