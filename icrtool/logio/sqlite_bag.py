"""rosbag2's sqlite3 storage: one ``.db3`` file."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

import numpy as np

from icrtool.errors import LogError
from icrtool.logio.channel import Block, Channel, ros_type_name
from icrtool.logio.decompress import DecompressionError, decompress_message

MAGIC = b"SQLite format 3\0"
_ROWS_A_BLOCK = 4096


class SqliteBag:
    """One ``.db3`` file.

    Parameters
    ----------
    message_compression : ``zstd`` where each message was compressed on its own, else empty

    Raises
    ------
    LogError
        Not an SQLite file, or not one of rosbag2's.
    """

    def __init__(self, path: Path, message_compression: str = "") -> None:
        self._path = path
        self._message_compression = message_compression
        self.files = [path]
        self.problems: list[str] = []
        journal = path.with_name(path.name + "-wal")
        # Without immutable=1 SQLite wants to write beside a log that was recorded in WAL mode.
        immutable = "" if journal.exists() and journal.stat().st_size else "&immutable=1"
        self._database = sqlite3.connect(
            f"file:{quote(str(path.absolute()))}?mode=ro{immutable}", uri=True, check_same_thread=False
        )
        self._last_row = self._rows = 0
        try:
            self.channels = self._read_topics()
            self._rows = int(self._database.execute("SELECT max(id) FROM messages").fetchone()[0] or 0)
        except sqlite3.DatabaseError as err:
            self.close()
            raise LogError(path, "not a readable rosbag2 database", str(err)) from err

    def share_read(self) -> float:
        """Return the last row read as a share of all rows."""
        return self._last_row / max(self._rows, 1)

    def close(self) -> None:
        """Release the database."""
        self._database.close()

    def _read_topics(self) -> list[Channel]:
        tables = {name for (name,) in self._database.execute("SELECT name FROM sqlite_master WHERE type='table'")}
        if not {"topics", "messages"} <= tables:
            raise sqlite3.DatabaseError(f"its tables are {', '.join(sorted(tables)) or 'none'}")
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            for name, encoding, text in self._database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                definitions[name] = (encoding, text)
        channels = []
        for number, topic, name, encoding in self._database.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            written, text = definitions.get(name, ("", ""))
            channels.append(
                Channel(
                    id=int(number),
                    topic=str(topic),
                    message_type=ros_type_name(str(name)),
                    encoding=str(encoding),
                    definition=text if written in ("ros2msg", "ros2idl") else "",
                    definition_format="idl" if written == "ros2idl" else "msg",
                )
            )
        return channels

    def blocks(self, wanted: frozenset[int]) -> Iterator[Block]:
        """Yield the messages of the wanted topics in the order they were stored."""
        if not wanted:
            return
        places = ",".join(str(number) for number in sorted(wanted))
        # The ids are integers from the database itself; a parameter list has SQLite's limit of variables.
        cursor = self._database.cursor()
        cursor.arraysize = _ROWS_A_BLOCK
        try:
            cursor.execute(f"SELECT topic_id, timestamp, data, id FROM messages WHERE topic_id IN ({places})")  # noqa: S608
            while rows := cursor.fetchmany():
                yield self._block(rows)
        except sqlite3.DatabaseError as err:
            self.problems.append(f"{self._path.name}: damaged ({err}); what stands before the damage was read")

    def _block(self, rows: list[tuple[int, int, bytes, int]]) -> Block:
        channels, times, messages, numbers = zip(*rows, strict=True)
        self._last_row = numbers[-1]
        if self._message_compression:
            messages = tuple(self._unpack(message) for message in messages)
        lengths = np.fromiter(map(len, messages), np.int64, len(messages))
        end = np.cumsum(lengths)
        data = np.frombuffer(b"".join(messages), np.uint8)
        return Block(data, np.array(channels, np.int64), np.array(times, np.int64), end - lengths, end)

    def _unpack(self, message: bytes) -> bytes:
        try:
            return decompress_message(message, self._message_compression)
        except DecompressionError as err:
            problem = f"{self._path.name}: messages that do not decompress left out: {err.args[0]}"
            if problem not in self.problems:
                self.problems.append(problem)
            return b""


def is_sqlite(stream: BinaryIO) -> bool:
    """Say whether a stream begins like an SQLite database."""
    return stream.read(len(MAGIC)) == MAGIC
