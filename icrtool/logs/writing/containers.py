"""Write serialised messages to a file: one function per container; all topics merged in time order."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from icrtool.logs.writing.messages import TopicMessages
    from icrtool.logs.writing.records import Compression

ROSBAG2_VERSION: Final = 9


def write_mcap(
    path: Path,
    topics: Sequence[TopicMessages],
    store: Typestore,
    *,
    compression: Compression,
    definitions: bool,
    metadata: Mapping[str, str] | None = None,
    library: str = "icrtool",
) -> None:
    """Write one MCAP file of ROS 2 messages (CDR).

    Parameters
    ----------
    metadata : becomes its metadata record ``icrtool``
    library : name in its header
    """
    from mcap.writer import CompressionType, Writer

    kind = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}[compression]
    with path.open("wb") as stream:
        writer: Any = Writer(stream, compression=kind)
        writer.start(profile="ros2", library=library)
        channels = []
        for topic in topics:
            text = store.generate_msgdef(topic.message_type, ros_version=2)[0] if definitions else ""
            schema = writer.register_schema(topic.message_type, "ros2msg" if definitions else "", text.encode())
            channels.append(writer.register_channel(topic.topic, "cdr", schema))
        if metadata is not None:
            writer.add_metadata("icrtool", dict(metadata))
        for index, stamp_ns, data in _in_time_order(topics):
            writer.add_message(channels[index], log_time=stamp_ns, data=data, publish_time=stamp_ns)
        writer.finish()


def write_bag(path: Path, topics: Sequence[TopicMessages], store: Typestore, *, compression: Compression) -> None:
    """Write one ROS 1 bag."""
    from rosbags.rosbag1 import Writer

    bag = Writer(path)
    if compression != "none":
        bag.set_compression(Writer.CompressionFormat[compression.upper()])
    with bag:
        connections = [bag.add_connection(topic.topic, topic.message_type, typestore=store) for topic in topics]
        for index, stamp_ns, data in _in_time_order(topics):
            bag.write(connections[index], stamp_ns, data)


def write_db3(
    path: Path, topics: Sequence[TopicMessages], store: Typestore, *, compression: Compression, definitions: bool
) -> None:
    """Write a ROS 2 bag directory with sqlite3 storage."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    bag = Writer(path, version=ROSBAG2_VERSION, storage_plugin=StoragePlugin.SQLITE3)
    if compression != "none":
        mode = CompressionMode.MESSAGE if compression == "zstd" else CompressionMode.FILE
        bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        connections = [bag.add_connection(topic.topic, topic.message_type, typestore=store) for topic in topics]
        for index, stamp_ns, data in _in_time_order(topics):
            bag.write(connections[index], stamp_ns, data)
    if not definitions:
        _drop_definitions(path / f"{path.name}.db3")


def _drop_definitions(database: Path) -> None:
    """Convert a database to schema 3 of rosbag2 (ROS 2 Humble), the last one without message definitions."""
    connection = sqlite3.connect(database)
    try:
        connection.executescript(
            """
            DROP TABLE message_definitions;
            ALTER TABLE topics DROP COLUMN type_description_hash;
            UPDATE schema SET schema_version = 3, ros_distro = 'humble';
            """
        )
    finally:
        connection.close()


def _in_time_order(topics: Sequence[TopicMessages]) -> Iterator[tuple[int, int, bytes]]:
    """Yield (index of the topic, stamp, message); at equal stamps in the order of the topics."""
    if not topics:
        return
    stamps = np.concatenate([topic.stamp_ns for topic in topics])
    indices = np.repeat(np.arange(len(topics)), [len(topic.stamp_ns) for topic in topics])
    rows = np.concatenate([np.arange(len(topic.stamp_ns)) for topic in topics])
    order = np.argsort(stamps, kind="stable")
    payloads = [topic.payload for topic in topics]
    for index, stamp_ns, row in zip(indices[order].tolist(), stamps[order].tolist(), rows[order].tolist(), strict=True):
        yield index, stamp_ns, bytes(payloads[index][row])
