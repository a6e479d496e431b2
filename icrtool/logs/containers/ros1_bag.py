"""ROS 1 bags, version 2.0: indexed or not, whole or cut off (http://wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from icrtool.errors import LogError
from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.channel import CUT_OFF, Block, Channel, ros_type_name
from icrtool.logs.containers.chunked_file import ChunkedFile, Spaces, reused_spaces
from icrtool.logs.containers.decompress import STORED, DecompressionError, Packed, Space
from icrtool.logs.containers.record_table import BAG_CONNECTION, Chunk, Part, scan_bag
from icrtool.logs.containers.source import Source
from icrtool.records.text import LogText

MAGIC = b"#ROSBAG V2.0\n"
_BAG_HEADER, _INDEX_DATA, _CHUNK, _CHUNK_INFO = 3, 4, 5, 6
_LARGEST_HEADER_BYTES, _LARGEST_CONTENT_BYTES = 1 << 16, 1 << 22
_HEADER_BYTES = 1 << 12
"""Of a chunk that are read to learn how it is compressed, where it may be read in part."""

_NONE: Ints = np.empty(0, np.int64)
_MOST_FIELDS = 100
"""Of a header; real ones have ten at most."""


class _Record(NamedTuple):
    """A top-level record: header fields, file offset of its data, length of its data."""

    fields: dict[bytes, bytes]
    at: int
    length: int

    @property
    def op(self) -> int:
        return self.number(b"op", 1)

    def number(self, name: bytes, size: int = 4) -> int:
        return int.from_bytes(self.fields.get(name, b"")[:size], "little")

    def time(self, name: bytes) -> int:
        """Return a time [ns], 0 where there is none."""
        seconds, nanoseconds = (int.from_bytes(self.fields.get(name, b"")[at : at + 4], "little") for at in (0, 4))
        return seconds * 1_000_000_000 + nanoseconds

    def text(self, name: bytes) -> str:
        return self.fields.get(name, b"").decode("utf-8", "replace")


def _header_fields(header: bytes) -> dict[bytes, bytes]:
    """Return the fields of a record's or a connection's header by name."""
    fields: dict[bytes, bytes] = {}
    place = 0
    for _ in range(_MOST_FIELDS):
        if place + 4 > len(header):
            break
        end = place + 4 + int.from_bytes(header[place : place + 4], "little")
        name, _, value = header[place + 4 : end].partition(b"=")
        fields[name] = value
        place = end
    return fields


def _message_index(index: bytes) -> tuple[Ints, Ints]:
    """Return where in its records the messages of a chunk begin (n,), and their connections (n,); none if damaged."""
    places, connections, at = [_NONE], [_NONE], 0
    while at + 8 <= len(index):
        content = at + 8 + int.from_bytes(index[at : at + 4], "little")
        length = int.from_bytes(index[content - 4 : content], "little")
        entries = index[content : content + length]
        fields = _header_fields(index[at + 4 : content - 4])
        if len(entries) < length or fields.get(b"op") != bytes([_INDEX_DATA]):
            return _NONE, _NONE
        places.append(np.frombuffer(entries[: length // 12 * 12], "<u4")[2::3].astype(np.int64))
        connections.append(np.full(len(places[-1]), int.from_bytes(fields.get(b"conn", b"")[:4], "little")))
        at = content + length
    return np.concatenate(places), np.concatenate(connections)


class Ros1Bag(ChunkedFile):
    """One ROS 1 bag.

    Raises
    ------
    LogError
        Not a bag of version 2.0, or encrypted.
    """

    _scan = staticmethod(scan_bag)
    _message_index = staticmethod(_message_index)

    def __init__(self, path: Path, source: Source | None = None) -> None:
        super().__init__(path, source=source)
        self._connections: dict[int, Channel] = {}
        try:
            self._check_start()
            self._chunks: list[Chunk] | None = self._read_index()
            if self._chunks is None:
                self.report(f"has no index (not closed, or {CUT_OFF}); read from start to end")
                self._learn_all()
        except BaseException:
            self.close()
            raise
        self.channels = list(self._connections.values())

    def _described(self, chunk: Chunk) -> Chunk:
        if self._remote is not None and chunk.is_stored:
            self._remote.hold(chunk.at, _HEADER_BYTES)
        record = self._record(chunk.at)
        if record is None or record.op != _CHUNK:
            return Chunk(chunk.at, size=-1)
        found = _chunk_of(record)
        index_length = max(chunk.at + chunk.index_length - found.at - found.length, 0)
        return found._replace(channels=chunk.channels, index_length=index_length)

    def _check_start(self) -> None:
        start = self._source.read_at(0, len(MAGIC))
        if start[:9] == MAGIC[:9] and start != MAGIC:
            raise LogError(
                self.path, "a bag of another version", "only 2.0 can be read; `rosbag fix` converts older ones"
            )
        if start != MAGIC:
            raise LogError(self.path, "not a ROS 1 bag", "its first bytes are not a bag's")

    def _record(self, at: int) -> _Record | None:
        """Return the record at a file offset with its header fields; None where there is no complete header."""
        if not 0 <= at < self._size:
            return None
        header_length = int.from_bytes(self._source.read_at(at, 4), "little")
        if header_length > min(_LARGEST_HEADER_BYTES, self._size - at - 8):
            return None
        header = self._source.read_at(at + 4, header_length + 4)
        length = int.from_bytes(header[header_length:], "little")
        return _Record(_header_fields(header[:header_length]), at + header_length + 8, length)

    def _read_index(self) -> list[Chunk] | None:
        """Return the chunks listed in the bag's index; None where there is none, or it is damaged."""
        first = self._record(len(MAGIC))
        if first is None or first.op != _BAG_HEADER:
            return None
        if first.text(b"encryptor"):
            raise LogError(self.path, "an encrypted bag", "decrypt it first")
        at = first.number(b"index_pos", 8)
        if at <= 0:
            return None
        chunks: dict[int, Chunk] = {}
        counts: dict[int, int] = {}
        while at != self._size:
            record = self._record(at)
            if record is None or record.length > min(_LARGEST_CONTENT_BYTES, self._size - record.at):
                return None
            content = self._source.read_at(record.at, record.length)
            if record.op == BAG_CONNECTION:
                self._connect(record.number(b"conn"), record.text(b"topic"), content)
            elif record.op == _CHUNK_INFO:
                held = np.frombuffer(content[: len(content) // 8 * 8], "<u4").reshape(-1, 2).tolist()
                for connection, count in held:
                    counts[connection] = counts.get(connection, 0) + count
                place = record.number(b"chunk_pos", 8)
                connections = frozenset(connection for connection, _ in held) or None
                chunks[place] = Chunk(place, 0, connections, record.time(b"start_time"), record.time(b"end_time"))
            else:
                return None
            at = record.at + record.length
        if (len(chunks), len(self._connections)) != (first.number(b"chunk_count"), first.number(b"conn_count")):
            return None
        self._connections = {n: replace(c, count=counts.get(n, 0)) for n, c in self._connections.items()}
        ordered = sorted(chunks.values(), key=lambda chunk: chunk.at)
        ends = [*(chunk.at for chunk in ordered), first.number(b"index_pos", 8)][1:]
        # One compression for all, as recorders write; where a chunk has another, that is found when it is read.
        record = self._record(ordered[0].at) if ordered else None
        kind = record.text(b"compression") if record is not None else "unknown"
        return [
            chunk._replace(index_length=end - chunk.at, compression=kind)
            for chunk, end in zip(ordered, ends, strict=False)
        ]

    def _read_in_order(self, *, learn: bool = False) -> Iterator[Block]:
        at, spaces = len(MAGIC), reused_spaces()
        while at < self._size:
            record = self._record(at)
            if record is None or not 0 < record.op <= BAG_CONNECTION:
                break
            cut = record.length > self._size - record.at
            if record.op == _CHUNK:
                yield from self._read_chunk(Part(_chunk_of(record)), next(spaces), learn=learn, cut=cut)
            if cut:
                break
            if learn and record.op == BAG_CONNECTION and record.length <= _LARGEST_CONTENT_BYTES:
                content = self._source.read_at(record.at, record.length)
                self._connect(record.number(b"conn"), record.text(b"topic"), content)
            at = record.at + record.length
        if at < self._size:
            self.report(f"{CUT_OFF} or damaged at byte {at} of {self._size}; everything before it was read")

    def _read_chunk(self, part: Part, spaces: Spaces, *, learn: bool = False, cut: bool = False) -> Iterator[Block]:
        if part.chunk.size < 0:
            self.report(f"no chunk at byte {part.chunk.at}, where the index lists one")
        else:
            yield from super()._read_chunk(part, spaces, learn=learn, cut=cut)

    def _packed(self, part: Part, space: Space, *, cut: bool = False, needed: int = 0) -> Packed:  # noqa: ARG002 - all of it
        chunk = part.chunk
        if chunk.size < 0:
            raise DecompressionError("no chunk")
        content = self._content(chunk.at, chunk.length, space, part.held)
        return Packed(content, chunk.compression, chunk.size, partial=cut)

    def _learn(self, data: Bytes, record: tuple[int, int, int, int]) -> None:
        _, at, start, end = record
        described = _Record(_header_fields(bytes(data[at + 4 : start - 4])), start, end - start)
        self._connect(described.number(b"conn"), described.text(b"topic"), bytes(data[start:end]))

    def _connect(self, number: int, topic: str, content: bytes) -> None:
        """Remember a connection record; `content` is the header that the publisher sent."""
        fields = {name: value.decode("utf-8", "replace") for name, value in _header_fields(content).items()}
        if number in self._connections or b"type" not in fields:
            return
        self._connections[number] = Channel(
            id=number,
            topic=LogText(topic or fields.get(b"topic", "")),
            message_type=ros_type_name(fields[b"type"]),
            encoding=LogText("ros1"),
            definition=fields.get(b"message_definition", ""),
        )


def _chunk_of(record: _Record) -> Chunk:
    compression = record.text(b"compression")
    size = record.length if compression in STORED else record.number(b"size")
    return Chunk(record.at, record.length, size=size, compression=compression)
