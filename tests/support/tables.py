"""The messages of one topic without a log: bytes as a container gives them, and columns as they are gathered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from icrtool.config import Config
from icrtool.logs.containers.container import Channel, MessageBlock
from icrtool.logs.messages.topic_table import TopicTable, collector_for
from icrtool.logs.streams.message_types import MESSAGE_TYPES
from icrtool.logs.streams.sources import Source
from icrtool.records.samples import Role
from icrtool.records.text import LogText

START_NS, STEP_NS = 1_760_000_000_000_000_000, 50_000_000


def block_of(messages: Sequence[tuple[int, bytes]]) -> MessageBlock:
    """Return a block of messages of channel 0, each with its log time."""
    sizes = np.array([len(data) for _, data in messages])
    times, end = np.array([stamp for stamp, _ in messages]), np.cumsum(sizes)
    data = np.frombuffer(b"".join(data for _, data in messages), np.uint8)
    return MessageBlock(data, np.zeros(len(messages), np.int64), times, end - sizes, end)


def collected(channel: Channel, wanted: tuple[str, ...], *blocks: Sequence[tuple[int, bytes]]) -> TopicTable:
    """Return the wanted columns of messages that come in blocks."""
    collector = collector_for(channel, wanted)
    for messages in blocks:
        collector.feed(block_of(messages), channel.id)
    return collector.table()


def channel_of(message_type: str, encoding: str = "cdr", definition: str = "") -> Channel:
    """Return a channel."""
    return Channel(0, LogText("/t"), LogText(message_type), LogText(encoding), definition)


def table_of(message_type: str, columns: Mapping[str, Any], topic: str = "/topic") -> TopicTable:
    """Return a table of columns, a message each 50 ms; a column of texts is given as texts."""
    arrays, texts = {}, {}
    for path, values in columns.items():
        if isinstance(values, list) and isinstance(values[0], str):
            texts[path] = list(dict.fromkeys(values))
            arrays[path] = np.array([texts[path].index(value) for value in values])
        else:
            arrays[path] = np.asarray(values)
    length = len(next(iter(arrays.values())))
    return TopicTable(topic, message_type, START_NS + STEP_NS * np.arange(length), arrays, texts, 0)


def fields_of(role: Role, message_type: str) -> tuple[str, ...]:
    """Return the fields that a role reads of a message type."""
    row = MESSAGE_TYPES[role].get(message_type)
    return row.fields if row is not None else ()


def read_source(role: Role, table: TopicTable, config: Config) -> Source:
    """Return what a topic, of one of the types of a role, has for it."""
    return MESSAGE_TYPES[role][table.message_type].read(table, config)
