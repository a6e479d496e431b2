"""ROS 1 bags of version 2.0, with and without an index, complete or cut off (http://wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.errors import LogError
from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.chunk import (
    STORED,
    Buffer,
    Chunk,
    DecompressionError,
    PackedChunk,
    Records,
    record_starts,
    values_at_each_byte,
)
from icrtool.logs.containers.chunked_file import ChunkedFile, ChunkPart, reused_buffers
from icrtool.logs.containers.container import LARGEST_DESCRIPTIONS_BYTES, Channel, MessageBlock, ros_type_name
from icrtool.records.text import LogText

BAG_MAGIC = b"#ROSBAG V2.0\n"
"""First bytes of a ROS 1 bag."""

_BAG_MESSAGE, _BAG_HEADER, _INDEX_DATA, _BAG_CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
"""Operation codes of records."""

_LARGEST_HEADER_BYTES, _LARGEST_CONTENT_BYTES = 1 << 16, 1 << 22
_HEADER_BYTES = 1 << 12
"""Number of bytes of a chunk of a distant file that are read to learn its compression."""

_LENGTH = Struct("<I")
_NONE: Ints = np.empty(0, np.int64)
_MOST_FIELDS = 100
"""Largest number of fields of a header outside chunks. Real headers have at most ten."""

_MOST_HEADERS = 1 << 4
"""Largest number of different headers in a chunk with which all records are compared; other headers are read one by
one."""

_VALUE_BYTES = {b"op": 1, b"conn": 4, b"time": 8}
"""Sizes of the values in the headers of the records of a chunk [bytes]."""


class _Record(NamedTuple):
    """A record outside chunks: operation code, header fields, offset in the file and length of its data [bytes]."""

    op: int
    fields: dict[bytes, bytes]
    at: int
    length: int

    def number(self, name: bytes, size: int = 4) -> int:
        """Return the whole number in a header field, 0 without the field."""
        return int.from_bytes(self.fields.get(name, b"")[:size], "little")

    def time(self, name: bytes) -> int:
        """Return the time in a header field [ns], 0 without the field."""
        nanoseconds, seconds = divmod(self.number(name, 8), 1 << 32)
        return seconds * 1_000_000_000 + nanoseconds

    def text(self, name: bytes) -> str:
        """Return the text in a header field, empty without the field."""
        return self.fields.get(name, b"").decode("utf-8", "replace")


def _fields(header: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the fields of a header: name, and begin and end offset of the value."""
    end = 0
    while (begin := end + 4) <= len(header):
        end = begin + _LENGTH.unpack_from(header, begin - 4)[0]
        name, equals, _ = header[begin:end].partition(b"=")
        yield name, begin + len(name + equals), end


def _header_fields(header: bytes) -> dict[bytes, bytes]:
    """Return the values of the fields of a header by their names."""
    return {name: header[begin:end] for name, begin, end in islice(_fields(header), _MOST_FIELDS)}


def _message_index(index: bytes) -> tuple[Ints, Ints]:
    """Return the offsets of the messages of a chunk in its records (n,), and their connections (n,).

    Both are empty where the index is damaged.
    """
    offsets, connections, at = [_NONE], [_NONE], 0
    while at + 8 <= len(index):
        content = at + 8 + int.from_bytes(index[at : at + 4], "little")
        length = int.from_bytes(index[content - 4 : content], "little")
        entries = index[content : content + length]
        fields = _header_fields(index[at + 4 : content - 4])
        if len(entries) < length or fields.get(b"op") != bytes([_INDEX_DATA]):
            return _NONE, _NONE
        offsets.append(np.frombuffer(entries[: length // 12 * 12], "<u4")[2::3].astype(np.int64))
        connections.append(np.full(len(offsets[-1]), int.from_bytes(fields.get(b"conn", b"")[:4], "little")))
        at = content + length
    return np.concatenate(offsets), np.concatenate(connections)


def scan_bag(data: Bytes, begin: int, hint: Ints | None = None) -> Records:
    """Return the message and connection records from `begin` on.

    Parameters
    ----------
    data : memory with the records
    begin : offset of the first record
    hint : (n,) offsets of messages by the index, ascending; None without an index
    """
    starts, stop = record_starts(data, begin, hint, _behind_record, _record_ends)
    sizes = values_at_each_byte(data, "<u4")[starts] + np.int64(8)
    table = np.empty((5, len(starts)), np.int64)
    unread, rounds = np.arange(len(starts)), 0
    while len(unread):
        # The headers of most records have the same fields.
        size = int(sizes[unread[0]])
        fits = sizes[unread] == size if rounds < _MOST_HEADERS else np.arange(len(unread)) == 0
        heads = values_at_each_byte(data, f"V{size}")[starts[unread if fits.all() else unread[fits]]]
        header = heads[0].tobytes()[4:-4]
        values = [(name, begin + 4) for name, begin, end in _fields(header) if end - begin == _VALUE_BYTES.get(name)]
        fields = {name: at for name, at in values if at + _VALUE_BYTES[name] <= size - 4}
        same, end = np.ones(len(heads), np.bool_), 0
        # A name that occurs twice has its first position in the dict, but the place of its last value.
        for name, at in [*sorted(fields.items(), key=lambda field: field[1]), (b"", size - 4)]:
            if at > end:
                parts = _strided(heads, end, f"V{at - end}")
                same &= parts == parts[0]
            end = at + _VALUE_BYTES.get(name, 0)
        if not same.all():
            fits[fits] = same
            heads = heads[same]
        rows = slice(None) if len(heads) == len(starts) else unread[fits]
        table[0, rows] = _strided(heads, fields[b"op"], "u1") if b"op" in fields else 0
        table[1, rows] = _strided(heads, fields[b"conn"], "<u4") if b"conn" in fields else -1
        table[2, rows] = 0
        if b"time" in fields:
            seconds, nanoseconds = (_strided(heads, fields[b"time"] + part, "<u4") for part in (0, 4))
            table[2, rows] = seconds * np.int64(1_000_000_000) + nanoseconds
        table[3, rows] = starts[rows] + size
        table[4, rows] = table[3, rows] + _strided(heads, size - 4, "<u4")
        unread, rounds = unread[~fits], rounds + 1
    codes, messages = table[0], table[1:]
    is_message = codes == _BAG_MESSAGE
    others = [
        (_CONNECTION, int(starts[row]), *messages[2:, row].tolist()) for row in np.flatnonzero(codes == _CONNECTION)
    ]
    return Records(messages if is_message.all() else messages[:, is_message], others, stop)


def _behind_record(data: memoryview, at: int, end: int) -> int:
    """Return the end of the record at a byte; the byte itself if the record is cut off."""
    content = at + 8 + _LENGTH.unpack_from(data, at)[0] if at + 8 <= end else end + 1
    behind: int = content + _LENGTH.unpack_from(data, content - 4)[0] if content <= end else end + 1
    return behind if behind <= end else at


def _record_ends(data: Bytes, at: Ints) -> Ints:
    """Return the ends of records that begin at some bytes (n,).

    The byte itself is returned for a record whose header is not as long as the header of the first record.
    """
    lengths, last = values_at_each_byte(data, "<u4"), len(data) - 4
    size = 8 + int(lengths[at[0]]) if at[-1] <= last else len(data)
    if at[-1] + size > len(data):
        return at
    return np.where(lengths[at] == size - 8, at + (size + lengths[at + (size - 4)].astype(np.int64)), at)


def _strided(rows: NDArray[Any], offset: int, kind: str) -> NDArray[Any]:
    """Return a view of the values (n,) at an offset in rows of bytes."""
    return np.ndarray(len(rows), kind, rows, offset, rows.strides)


class Ros1Bag(ChunkedFile):
    """An open ROS 1 bag.

    Raises
    ------
    LogError
        The file is no bag of version 2.0, or is encrypted.
    """

    _find_records = staticmethod(scan_bag)
    _message_index = staticmethod(_message_index)

    _connections: dict[int, Channel]
    _described_bytes: int

    def _read_channels(self) -> list[Channel]:
        return list(self._connections.values())

    def _read_index(self) -> list[Chunk] | None:
        start = self._source.read_at(0, len(BAG_MAGIC))
        if start != BAG_MAGIC and start.startswith(BAG_MAGIC[:9]):
            advice = "only 2.0 can be read; `rosbag fix` converts older ones"
            raise LogError(self.path, "a bag of another version", advice)
        if start != BAG_MAGIC:
            raise LogError(self.path, "not a ROS 1 bag", "its first bytes are not a bag's")
        self._connections, self._described_bytes = {}, 0
        chunks = self._listed_chunks()
        if chunks is None:
            self.report("log_cut_off", "has no index (not closed, or cut off); read from start to end")
        return chunks

    def _complete(self, chunk: Chunk) -> Chunk:
        if self._remote is not None and chunk.is_uncompressed:
            self._remote.hold(chunk.at, _HEADER_BYTES)
        record = self._record(chunk.at)
        if record is None or record.op != _BAG_CHUNK:
            return Chunk(chunk.at, size=-1)
        found = _chunk_of(record)
        index_length = max(chunk.at + chunk.index_length - found.at - found.length, 0)
        return found._replace(channels=chunk.channels, index_length=index_length)

    def _record(self, at: int) -> _Record | None:
        """Return the record at a file offset; None without a complete header."""
        if not 0 <= at < self._size:
            return None
        header_length = int.from_bytes(self._source.read_at(at, 4), "little")
        if header_length > min(_LARGEST_HEADER_BYTES, self._size - at - 8):
            return None
        header = self._source.read_at(at + 4, header_length + 4)
        length = int.from_bytes(header[header_length:], "little")
        fields = _header_fields(header[:header_length])
        return _Record(int.from_bytes(fields.get(b"op", b"")[:1], "little"), fields, at + header_length + 8, length)

    def _listed_chunks(self) -> list[Chunk] | None:
        """Return the chunks that the index lists; None without an index, or where it is damaged."""
        first = self._record(len(BAG_MAGIC))
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
            if record.op == _CONNECTION:
                self._connect(record.fields, content)
            elif record.op == _CHUNK_INFO:
                counts_in_chunk = np.frombuffer(content[: len(content) // 8 * 8], "<u4").reshape(-1, 2).tolist()
                for connection, count in counts_in_chunk:
                    counts[connection] = counts.get(connection, 0) + count
                offset = record.number(b"chunk_pos", 8)
                connections = frozenset(connection for connection, _ in counts_in_chunk) or None
                chunks[offset] = Chunk(offset, 0, connections, record.time(b"start_time"), record.time(b"end_time"))
            else:
                return None
            at = record.at + record.length
        if (len(chunks), len(self._connections)) != (first.number(b"chunk_count"), first.number(b"conn_count")):
            return None
        self._connections = {n: replace(c, count=counts.get(n, 0)) for n, c in self._connections.items()}
        ordered = sorted(chunks.values(), key=lambda chunk: chunk.at)
        ends = [*(chunk.at for chunk in ordered), first.number(b"index_pos", 8)][1:]
        # Recorders write all chunks with one compression. Another compression of a chunk is found when it is read.
        record = self._record(ordered[0].at) if ordered else None
        compression = record.text(b"compression") if record is not None else "unknown"
        return [
            chunk._replace(index_length=end - chunk.at, compression=compression)
            for chunk, end in zip(ordered, ends, strict=False)
        ]

    def _read_in_order(self) -> Iterator[MessageBlock]:
        at, spaces = len(BAG_MAGIC), reused_buffers()
        memory = next(spaces)
        while at < self._size:
            record = self._record(at)
            if record is None or not 0 < record.op <= _CONNECTION:
                break
            is_cut = record.length > self._size - record.at
            if record.op == _BAG_CHUNK:
                chunk = _chunk_of(record)._replace(is_cut=is_cut)
                if (yield from self._read_chunk(ChunkPart(chunk), memory)):
                    memory = next(spaces)
            if is_cut:
                break
            if self._is_learning and record.op == _CONNECTION and record.length <= _LARGEST_CONTENT_BYTES:
                content = self._source.read_at(record.at, record.length)
                self._connect(record.fields, content)
            at = record.at + record.length
        if at < self._size:
            self.report(
                "log_cut_off", f"cut off or damaged at byte {at} of {self._size}; everything before it was read"
            )

    def _read_packed(self, part: ChunkPart, space: Buffer, needed: int = 0) -> PackedChunk:  # noqa: ARG002 - all of it
        chunk = part.chunk
        if chunk.size < 0:
            raise DecompressionError("no chunk")
        content = self._read_content(chunk.at, chunk.length, space, part.held)
        size = len(content) if chunk.compression in STORED else chunk.size
        return PackedChunk(content, chunk.compression, size, partial=chunk.is_cut)

    def _learn(self, data: Bytes, record: tuple[int, int, int, int]) -> None:
        _, at, start, end = record
        self._connect(_header_fields(bytes(data[at + 4 : start - 4])), bytes(data[start:end]))

    def _connect(self, header: dict[bytes, bytes], content: bytes) -> None:
        """Store the channel of a connection record; `content` is the header that the publisher sent."""
        number = int.from_bytes(header.get(b"conn", b"")[:4], "little")
        fields = {name: value.decode("utf-8", "replace") for name, value in _header_fields(content).items()}
        if number in self._connections or b"type" not in fields:
            return
        self._described_bytes += len(content)
        if self._described_bytes > LARGEST_DESCRIPTIONS_BYTES:
            self.report("log_damaged", f"connections of more than {LARGEST_DESCRIPTIONS_BYTES} bytes were left out")
            return
        self._connections[number] = Channel(
            id=number,
            topic=LogText(header.get(b"topic", b"").decode("utf-8", "replace") or fields.get(b"topic", "")),
            message_type=ros_type_name(fields[b"type"]),
            encoding=LogText("ros1"),
            definition=fields.get(b"message_definition", ""),
        )


def _chunk_of(record: _Record) -> Chunk:
    """Return the chunk that a chunk record describes."""
    compression = record.text(b"compression")
    size = record.length if compression in STORED else record.number(b"size")
    return Chunk(record.at, record.length, size=size, compression=compression)
