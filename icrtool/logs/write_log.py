"""Write a robot log from columns; used by `icrtool simulate`, the sample logs and the tests."""

from __future__ import annotations

import os
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from icrtool.errors import OutputError
from icrtool.logs.written_messages import (
    Compression,
    Container,
    WheelMessages,
    WriteOptions,
    load_typestore,
    serialise_topics,
)
from icrtool.records.process_resources import unfinished
from icrtool.records.samples import SensorColumns

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from icrtool.logs.written_messages import TopicMessages

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


__all__ = ["Compression", "Container", "SensorColumns", "WheelMessages", "WriteOptions", "write_log"]


def write_log(path: str | Path, columns: SensorColumns, options: WriteOptions) -> Path:
    """Write `columns` as the log a robot would have recorded, in ROS conventions (REP-103, or REP-145 NED).

    Parameters
    ----------
    path : the file to make (``mcap``, ``bag``), or the directory (``db3``); it must not exist
    columns : sensor columns in the frames of `icrtool`
    options : container, message types and conventions

    Returns
    -------
    `path`

    Raises
    ------
    OutputError
        `path` exists or cannot be written. No incomplete file stays: the log is written next to it under another name,
        and renamed when it is complete.

    Notes
    -----
    Log time is the stamp. Topics: ``/imu/data``, ``/gps/fix``, and by `options.wheels` ``/joint_states``,
    ``/wheel_controller/odom``, ``/wheel_controller/twist``, ``/feedback``, ``/left_drive/velocity`` with
    ``/right_drive/velocity``, or ``/lwheel_ticks`` with ``/rwheel_ticks``.
    """
    path = Path(path)
    if os.path.lexists(path):
        raise OutputError(path, "exists already", "remove it or choose another name")
    store = load_typestore(ros1=options.container == "bag")
    topics = serialise_topics(columns, options, store)
    try:
        with (
            tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as scratch,
            unfinished(Path(scratch)),
        ):
            partial = Path(scratch) / path.name
            if options.container == "mcap":
                write_mcap(partial, topics, store, compression=options.compression, definitions=options.definitions)
            elif options.container == "bag":
                write_bag(partial, topics, store, compression=options.compression)
            else:
                write_db3(partial, topics, store, compression=options.compression, definitions=options.definitions)
            partial.rename(path)
    except (OSError, sqlite3.Error) as err:
        reason = err.strerror if isinstance(err, OSError) and err.strerror else str(err)
        raise OutputError(path, "cannot be written", reason) from err
    return path
