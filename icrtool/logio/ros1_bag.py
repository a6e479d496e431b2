"""ROS 1 bags, version 2.0: indexed or not, whole or cut off (http://wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from icrtool.errors import LogError
from icrtool.logio.channel import Block, Channel, ros_type_name
from icrtool.logio.decompress import DecompressionError, decompress
from icrtool.logio.records import BAG_CONNECTION, BAG_MESSAGE, RecordTable

MAGIC = b"#ROSBAG V2.0\n"
_BAG_HEADER, _INDEX, _CHUNK, _CHUNK_INFO = 3, 4, 5, 6
_LARGEST_HEADER_BYTES = 1 << 24


class _Record(NamedTuple):
    """A top-level record: header fields, file offset of its data, length of its data."""

    fields: dict[str, bytes]
    at: int
    length: int

    @property
    def op(self) -> int:
        return int.from_bytes(self.fields.get("op", b"\0"), "little")

    def number(self, name: str) -> int:
        return int.from_bytes(self.fields.get(name, b""), "little")

    def text(self, name: str) -> str:
        return self.fields.get(name, b"").decode("utf-8", "replace")


class _Chunk(NamedTuple):
    """File offset of a chunk record; the connections in it, where the index tells."""

    at: int
    connections: frozenset[int] | None


class Ros1Bag:
    """One ROS 1 bag.

    Raises
    ------
    LogError
        Not a bag of version 2.0, or encrypted.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.files = [path]
        self.problems: list[str] = []
        self._table = RecordTable()
        self._connections: dict[int, Channel] = {}
        self._counts: dict[int, int] = {}
        self._stream = path.open("rb")
        self._size = path.stat().st_size
        try:
            self._check_start()
            self._chunks = self._read_index()
            if self._chunks is None:
                for _ in self._walk(frozenset(), report=False):
                    pass
        except LogError:
            self.close()
            raise
        self.channels = list(self._connections.values())

    def share_read(self) -> float:
        """Return the place in the file as a share of its size."""
        return self._stream.tell() / max(self._size, 1)

    def close(self) -> None:
        """Release the file."""
        self._stream.close()

    def blocks(self, wanted: frozenset[int]) -> Iterator[Block]:
        """Yield the messages of the wanted connections, chunk by chunk."""
        if not wanted:
            return
        if self._chunks is None:
            self.problems.append(f"{self._path.name}: has no index (not closed, or cut off); read from start to end")
            yield from self._walk(wanted, report=True)
            return
        for chunk in self._chunks:
            if chunk.connections is not None and not chunk.connections & wanted:
                continue
            record = self._record(chunk.at)
            if record is None or record.op != _CHUNK:
                self.problems.append(f"{self._path.name}: no chunk at byte {chunk.at}, where the index says one is")
                continue
            block = self._read_chunk(record, wanted, report=True)
            if block is not None:
                yield block

    def _check_start(self) -> None:
        start = self._stream.read(len(MAGIC))
        if start[:9] == b"#ROSBAG V" and start != MAGIC:
            raise LogError(self._path, "a bag of another version", "only 2.0 is read; `rosbag fix` turns older ones into it")
        if start != MAGIC:
            raise LogError(self._path, "not a ROS 1 bag", "its first bytes are not a bag's")

    def _record(self, at: int) -> _Record | None:
        """Read the header of the record at a file offset; None where no whole header stands."""
        self._stream.seek(at)
        head = self._stream.read(4)
        header_length = int.from_bytes(head, "little")
        if len(head) < 4 or header_length > min(_LARGEST_HEADER_BYTES, self._size - at - 8):
            return None
        header = self._stream.read(header_length)
        length = int.from_bytes(self._stream.read(4), "little")
        fields, place = {}, 0
        while place + 4 <= len(header):
            end = place + 4 + int.from_bytes(header[place : place + 4], "little")
            name, _, value = header[place + 4 : end].partition(b"=")
            fields[name.decode("ascii", "replace")] = value
            place = end
        return _Record(fields, at + header_length + 8, length)

    def _read_index(self) -> list[_Chunk] | None:
        """Return the chunks by the bag's index; None where there is none, or it is damaged."""
        first = self._record(len(MAGIC))
        if first is None or first.op != _BAG_HEADER:
            return None
        if first.text("encryptor"):
            raise LogError(self._path, "an encrypted bag", "decrypt it first")
        at, chunks, chunk_count = first.number("index_pos"), [], first.number("chunk_count")
        if not 0 < at <= self._size:
            return None
        while at < self._size:
            record = self._record(at)
            if record is None or record.at + record.length > self._size:
                return None
            self._stream.seek(record.at)
            content = self._stream.read(record.length)
            if record.op == BAG_CONNECTION:
                self._learn(record.number("conn"), record.text("topic"), content)
            elif record.op == _CHUNK_INFO:
                counts = np.frombuffer(content[: len(content) // 8 * 8], "<u4").reshape(-1, 2)
                for connection, count in counts.tolist():
                    self._counts[connection] = self._counts.get(connection, 0) + count
                chunks.append(_Chunk(record.number("chunk_pos"), frozenset(counts[:, 0].tolist()) or None))
            else:
                return None
            at = record.at + record.length
        if len(chunks) != chunk_count:
            return None
        self._connections = {
            number: Channel(c.id, c.topic, c.message_type, c.encoding, c.definition, count=self._counts.get(number, 0))
            for number, c in self._connections.items()
        }
        return sorted(chunks, key=lambda chunk: chunk.at)

    def _walk(self, wanted: frozenset[int], *, report: bool) -> Iterator[Block]:
        """Go through the records one after the other, as far as they can be read."""
        at = len(MAGIC)
        while at < self._size:
            record = self._record(at)
            if record is None or not record.fields or not 0 < record.op <= BAG_CONNECTION:
                break
            cut = record.at + record.length > self._size
            if record.op == _CHUNK:
                block = self._read_chunk(record, wanted, report=report, cut=cut)
                if block is not None:
                    yield block
            if cut:
                break
            if record.op == BAG_CONNECTION:
                self._stream.seek(record.at)
                self._learn(record.number("conn"), record.text("topic"), self._stream.read(record.length))
            at = record.at + record.length
        if report and at < self._size:
            self.problems.append(
                f"{self._path.name}: cut off or damaged at byte {at} of {self._size}; what stands before it was read"
            )

    def _read_chunk(self, record: _Record, wanted: frozenset[int], *, report: bool, cut: bool = False) -> Block | None:
        self._stream.seek(record.at)
        packed = self._stream.read(record.length)
        try:
            size = record.number("size")
            data = np.frombuffer(decompress(packed, record.text("compression"), size, partial=cut), np.uint8)
        except DecompressionError as err:
            if report:
                self.problems.append(f"{self._path.name}: chunk at byte {record.at} left out: {err.args[0]}")
            return None
        rows, stop = self._table.scan_bag(data)
        if report and stop < len(data) and not cut:
            self.problems.append(
                f"{self._path.name}: chunk at byte {record.at}: {len(data) - stop} of {len(data)} bytes left out, damaged"
            )
        if self._chunks_unknown():
            for row in rows[rows[:, 0] == BAG_CONNECTION]:
                self._learn(int(row[1]), "", bytes(data[row[3] : row[4]]))
        if not wanted:
            return None
        rows = rows[rows[:, 0] == BAG_MESSAGE]
        return Block(data, rows[:, 1].copy(), rows[:, 2].copy(), rows[:, 3].copy(), rows[:, 4].copy())

    def _chunks_unknown(self) -> bool:
        return getattr(self, "_chunks", None) is None

    def _learn(self, number: int, topic: str, content: bytes) -> None:
        """Remember a connection record; `content` is the header that the publisher sent."""
        fields, place = {}, 0
        while place + 4 <= len(content):
            end = place + 4 + int.from_bytes(content[place : place + 4], "little")
            name, _, value = content[place + 4 : end].partition(b"=")
            fields[name.decode("ascii", "replace")] = value.decode("utf-8", "replace")
            place = end
        if number in self._connections or "type" not in fields:
            return
        self._connections[number] = Channel(
            id=number,
            topic=topic or fields.get("topic", ""),
            message_type=ros_type_name(fields["type"]),
            encoding="ros1",
            definition=fields.get("message_definition", ""),
        )


def is_ros1_bag(stream: BinaryIO) -> bool:
    """Say whether a stream begins like a ROS 1 bag of any version."""
    return stream.read(9) == MAGIC[:9]
