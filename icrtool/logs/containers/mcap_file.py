"""MCAP files: chunked or not, indexed or not, whole or cut off (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

from icrtool.errors import LogError
from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.channel import WHOLE, Block, Channel, Cut, joined, ros_type_name
from icrtool.logs.containers.chunked_file import MCAP_CHANNEL, MCAP_MESSAGE, MCAP_SCHEMA, ChunkedFile
from icrtool.logs.containers.decompress import (
    LARGEST_CHUNK_BYTES,
    DecompressionError,
    Inflation,
    unpack_messages,
)
from icrtool.records.text import LogText

if TYPE_CHECKING:
    from mcap.records import Channel as McapChannel
    from mcap.records import ChunkIndex, Schema, Statistics

    _Parsed = Schema | McapChannel | ChunkIndex | Statistics

MAGIC = b"\x89MCAP0\r\n"
PIECE_BYTES = 1 << 22
_FOOTER, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX, _STATISTICS, _DATA_END = 2, 6, 7, 8, 11, 15
_HEAD_BYTES, _FOOTER_BYTES = 9, 20
_CHECKSUM_BYTES = 4
_ENCODINGS = {("cdr", "ros2msg"), ("cdr", "ros2idl"), ("ros1", "ros1msg")}


_INDEX_HEAD_BYTES = _HEAD_BYTES + 6
_LARGEST_BLOCK_BYTES = (1 << 17) + 1024
"""Of a zstd block with the frame's header: so many compressed bytes more give all bytes up to a place."""

SMALL_PART = 0.5
"""A chunk of which less is wanted is decompressed up to the last wanted message; its checksum is not computed.

Of a chunk with images that is a few percent, and most recorders close a chunk behind the image that filled it.
"""


JOINED_BYTES = 1 << 20
"""Such parts are handed on together once they have so many bytes: each block has a cost of its own."""


class _Chunk(NamedTuple):
    """Where a chunk record's content is in the file: offset and length; and its entry in the index.

    Attributes
    ----------
    channels : those it holds, None without an entry
    index_length : length of the message index records that follow it
    begin_ns, end_ns : first and last log time in it, 0 without an entry
    size : of its records, decompressed
    stored : they are not compressed
    """

    at: int
    length: int
    channels: frozenset[int] | None = None
    index_length: int = 0
    begin_ns: int = 0
    end_ns: int = 0
    size: int = 0
    stored: bool = False


class McapFile(ChunkedFile):
    """One MCAP file.

    Parameters
    ----------
    message_compression : compression of each single message, from rosbag2's metadata.yaml; empty for none

    Raises
    ------
    LogError
        Not an MCAP file.
    """

    def __init__(self, path: Path, message_compression: str = "") -> None:
        super().__init__(path, MCAP_MESSAGE)
        self._message_compression = message_compression
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, McapChannel] = {}
        self._counts: dict[int, int] = {}
        try:
            if self._stream.read(len(MAGIC)) != MAGIC:
                raise LogError(path, "not an MCAP file", "its first bytes are not those of MCAP")
            self._chunks: list[_Chunk] | None = self._read_index()
            if self._chunks is None:
                self._learn_all()
        except BaseException:
            self.close()
            raise
        self.channels = [self._channel(number) for number in sorted(self._channels)]

    def blocks(self, wanted: frozenset[int], cut: Cut = WHOLE) -> Iterator[Block]:
        """Yield the messages of the wanted channels, chunk by chunk."""
        blocks = super().blocks(wanted, cut)
        if self._message_compression:
            blocks = unpack_messages(blocks, wanted, self._message_compression, self.problems.add)
        yield from blocks

    def _indexed(self, wanted: frozenset[int], cut: Cut) -> Iterator[Block]:
        small: list[Block] = []
        held = 0
        for chunk in self._chunks or ():
            if cut.needs(chunk.channels, chunk.begin_ns, chunk.end_ns, wanted):
                needed = self._needed(chunk, wanted)
                part = self._read_part(chunk, needed) if needed is not None else None
                is_small = part is not None and len(part.data) <= JOINED_BYTES
                if part is not None and is_small:
                    small.append(part._replace(data=part.data.copy()))
                    held += len(part.data)
                if small and (not is_small or held > JOINED_BYTES):
                    yield joined(small)
                    small, held = [], 0
                if part is None:
                    yield from self._read_chunk(chunk)
                elif not is_small:
                    yield part
        if small:
            yield joined(small)

    def _needed(self, chunk: _Chunk, wanted: frozenset[int]) -> Ints | None:
        """Return where the wanted messages of a chunk begin and end (n, 2), by its index; None where most is wanted."""
        if chunk.channels is None or chunk.channels <= wanted or chunk.index_length > LARGEST_CHUNK_BYTES:
            return None
        index, at = bytes(self._read(chunk.at + chunk.length, chunk.index_length)), 0
        offsets, flags = [], []
        while at + _INDEX_HEAD_BYTES <= len(index):
            opcode, length, channel = struct.unpack_from("<BQH", index, at)
            at += _HEAD_BYTES + length
            if opcode != _MESSAGE_INDEX or length < _INDEX_HEAD_BYTES - _HEAD_BYTES or at > len(index):
                return None
            count = (length - _INDEX_HEAD_BYTES + _HEAD_BYTES) // 16
            offsets.append(np.frombuffer(index, "<i8", 2 * count, at - 16 * count)[1::2])
            flags.append(np.full(count, channel in wanted))
        if not offsets or not chunk.size:
            return None
        begin = np.concatenate(offsets)
        order = np.argsort(begin)
        edges = np.append(begin[order], chunk.size)
        places = np.column_stack([edges[:-1], edges[1:]])[np.concatenate(flags)[order]]
        sound = len(places) and edges[0] >= 0 and np.diff(edges).min() > 0
        return places if sound and np.diff(places).sum() < SMALL_PART * chunk.size else None

    def _read_part(self, chunk: _Chunk, places: Ints) -> Block | None:
        """Return the messages at some places of a chunk; None where all of it has to be read for them.

        What is compressed is read up to the last of them, of other chunks nothing else is read.
        """
        needed = int(places.max(initial=0))
        try:
            if chunk.stored:
                first, parts = chunk.at + chunk.length - chunk.size, []
                gaps = np.flatnonzero(places[1:, 0] > places[:-1, 1])
                for begin, end in zip(places[np.append(0, gaps + 1), 0], places[np.append(gaps, -1), 1], strict=True):
                    parts.append(bytes(self._read(first + int(begin), int(end - begin))))
                records = np.frombuffer(b"".join(parts), np.uint8)
                needed = int(np.diff(places).sum())
            else:
                content = self._read(chunk.at, min(needed + _LARGEST_BLOCK_BYTES, chunk.length))
                records = _chunk_records(content, self._inflation, cut=True, needed=needed)
        except DecompressionError:
            return None
        block, stop = self._scanned(records)
        return block if stop >= needed else None

    def _channel(self, number: int) -> Channel:
        channel = self._channels[number]
        schema = self._schemas.get(channel.schema_id)
        encoding, written = channel.message_encoding, schema.encoding if schema else ""
        return Channel(
            id=number,
            topic=LogText(channel.topic),
            message_type=ros_type_name(schema.name) if schema else LogText(""),
            encoding=LogText(encoding),
            definition=schema.data.decode("utf-8", "replace") if schema and (encoding, written) in _ENCODINGS else "",
            definition_format="idl" if written == "ros2idl" else "msg",
            count=self._counts.get(number) if self._chunks is not None else None,
        )

    def _read_index(self) -> list[_Chunk] | None:
        """Return the chunks listed in the file's index; None without an index, or where it does not fit the file."""
        from mcap.records import Channel as McapChannel
        from mcap.records import ChunkIndex, Schema, Statistics

        chunks: list[_Chunk] = []
        schemas: dict[int, Schema] = {}
        channels: dict[int, McapChannel] = {}
        statistics: Statistics | None = None
        for opcode, content in self._summary_records():
            match _parse(opcode, content):
                case Schema() as schema:
                    schemas[schema.id] = schema
                case McapChannel() as channel:
                    channels[channel.id] = channel
                case Statistics() as found:
                    statistics = found
                case ChunkIndex() as index:
                    held = frozenset(index.message_index_offsets) or None
                    start, length = index.chunk_start_offset + _HEAD_BYTES, index.chunk_length - _HEAD_BYTES
                    times = index.message_start_time, index.message_end_time
                    size = index.uncompressed_size
                    stored = index.compression in ("", "none") and size <= length
                    chunks.append(_Chunk(start, length, held, index.message_index_length, *times, size, stored))
                case None:
                    return None
        if statistics is None or not chunks or len(chunks) != statistics.chunk_count:
            return None
        if len(schemas) < statistics.schema_count or len(channels) < statistics.channel_count:
            return None
        chunks.sort(key=lambda chunk: chunk.at)
        standing = self._found_in_file(chunks)
        if standing is not None:
            self._schemas, self._channels = schemas, channels
            self._counts = dict(statistics.channel_message_counts)
        return standing

    def _summary_records(self) -> Iterator[tuple[int, bytes]]:
        """Yield opcode and content of the records of the summary that reading needs; none where it is damaged."""
        end = self._size - len(MAGIC) - _FOOTER_BYTES - _HEAD_BYTES
        self._stream.seek(max(end, 0))
        footer = self._stream.read(_HEAD_BYTES + _FOOTER_BYTES)
        start = int.from_bytes(footer[9:17], "little")
        if footer[:1] != bytes([_FOOTER]) or self._stream.read() != MAGIC or not 0 < start <= end:
            return
        if end - start > LARGEST_CHUNK_BYTES:
            return
        self._stream.seek(start)
        summary = self._stream.read(end - start)
        checksum = int.from_bytes(footer[-_CHECKSUM_BYTES:], "little")
        if checksum and zlib.crc32(footer[:-_CHECKSUM_BYTES], zlib.crc32(summary)) != checksum:
            return
        at = 0
        while at + _HEAD_BYTES <= len(summary):
            opcode, length = struct.unpack_from("<BQ", summary, at)
            at += _HEAD_BYTES
            if opcode in (MCAP_SCHEMA, MCAP_CHANNEL, _CHUNK_INDEX, _STATISTICS):
                yield opcode, summary[at : at + length]
            at += length

    def _found_in_file(self, chunks: list[_Chunk]) -> list[_Chunk] | None:
        """Return the chunks of the index that are at their stated offsets; None where the index must not be used.

        It must not be used where messages are outside chunks, or where it does not fit a complete file: reading the
        records one after the other finds more messages then.
        """
        by_place = {chunk.at - _HEAD_BYTES: chunk for chunk in chunks}
        if len(by_place) == len(chunks) and self._reaches_end(by_place):
            return chunks
        if self._reaches_end(None):
            return None
        standing = []
        for at, chunk in by_place.items():
            if self._head(at) == (_CHUNK, chunk.length):
                standing.append(chunk)
            else:
                self.problems.add(f"no chunk at byte {at}, where the index lists one")
        return standing or None

    def _reaches_end(self, chunks: dict[int, _Chunk] | None) -> bool:
        """Return whether the records follow one another to the end of the data.

        Parameters
        ----------
        chunks : by file offset of their record; True then also means that the file has no other chunk, and no message
            outside them. None: any records.
        """
        at, left = len(MAGIC), dict(chunks or {})
        while True:
            opcode, length = self._head(at)
            if opcode in (_FOOTER, _DATA_END):
                return not left
            if opcode == 0 or length > self._size - at - _HEAD_BYTES:
                return False
            chunk = left.pop(at, None)
            if chunks is not None and (opcode == MCAP_MESSAGE or (opcode == _CHUNK) != (chunk is not None)):
                return False
            at += _HEAD_BYTES + length
            if chunk is not None:
                if chunk.length != length:
                    return False
                at += chunk.index_length

    def _head(self, at: int) -> tuple[int, int]:
        """Return opcode and length of the record at a file offset; opcode 0 where there is none."""
        if not 0 <= at < self._size:
            return 0, 0
        self._stream.seek(at)
        head = self._stream.read(_HEAD_BYTES)
        return (head[0], int.from_bytes(head[1:], "little")) if len(head) == _HEAD_BYTES else (0, 0)

    def _read_in_order(self, *, learn: bool = False) -> Iterator[Block]:
        at = len(MAGIC)
        while True:
            opcode, length = self._head(at)
            left = self._size - at - _HEAD_BYTES
            if opcode in (_FOOTER, _DATA_END):
                return
            if opcode == _CHUNK:
                chunk = _Chunk(at + _HEAD_BYTES, min(length, left))
                yield from self._read_chunk(chunk, learn=learn, cut=length > left)
            elif opcode in (MCAP_SCHEMA, MCAP_CHANNEL, MCAP_MESSAGE) and length <= left:
                block, length = self._read_loose(at, length, learn=learn)
                if block is not None:
                    yield block
            if opcode == 0 or length > left:
                break
            at += _HEAD_BYTES + length
        self.problems.add(f"cut off or damaged at byte {at} of {self._size}; everything before it was read")

    def _read_loose(self, at: int, length: int, *, learn: bool) -> tuple[Block | None, int]:
        """Return the messages of records outside chunks, and the number of bytes consumed after the first 9."""
        stop = 0
        if length <= LARGEST_CHUNK_BYTES:
            self._stream.seek(at)
            piece = np.frombuffer(self._stream.read(max(PIECE_BYTES, _HEAD_BYTES + length)), np.uint8)
            block, stop = self._scanned(piece, learn=learn)
            if stop:
                return block, stop - _HEAD_BYTES
        self.problems.add(f"record at byte {at} left out: damaged")
        return None, length

    def _read_chunk(self, chunk: _Chunk, *, learn: bool = False, cut: bool = False) -> Iterator[Block]:
        def unpack(content: memoryview) -> Bytes:
            return _chunk_records(content, self._inflation, cut=cut)

        return self._chunk(chunk.at, chunk.length, chunk.at - _HEAD_BYTES, unpack, learn=learn, cut=cut)

    def _scan(self, data: Bytes, begin: int, rows: Ints) -> tuple[int, int]:
        from icrtool.logs.containers.record_table import scan_mcap

        return scan_mcap(data, begin, rows)

    def _learn(self, row: Ints, data: Bytes) -> None:
        from mcap.records import Channel as McapChannel
        from mcap.records import Schema

        record = _parse(int(row[0]), bytes(data[row[3] : row[4]]))
        if isinstance(record, Schema):
            known = self._schemas.setdefault(record.id, record) == record
        elif isinstance(record, McapChannel):
            known = self._channels.setdefault(record.id, record) == record
        else:
            self.problems.add("a schema or channel that cannot be read was left out")
            return
        if not known:
            what = f"{type(record).__name__.lower()} {record.id}"
            self.problems.add(f"{what} is described twice, differently; the first description was used")


def _parse(opcode: int, content: bytes) -> _Parsed | None:
    """Return a schema, channel, chunk index or statistics record, None where it is damaged."""
    from io import BytesIO

    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.records import Channel as McapChannel
    from mcap.records import ChunkIndex, Schema, Statistics

    kinds: dict[int, type[Schema | McapChannel | ChunkIndex | Statistics]] = {
        MCAP_SCHEMA: Schema,
        MCAP_CHANNEL: McapChannel,
        _CHUNK_INDEX: ChunkIndex,
        _STATISTICS: Statistics,
    }
    try:
        record: _Parsed = kinds[opcode].read(ReadDataStream(BytesIO(content)))
    except (McapError, struct.error, ValueError, OverflowError, MemoryError):
        return None
    return record


def _chunk_records(content: memoryview, inflation: Inflation, *, cut: bool, needed: int = LARGEST_CHUNK_BYTES) -> Bytes:
    """Return the records of a chunk record's content, decompressed and checked against its checksum.

    Parameters
    ----------
    cut : the content is cut off; what can be decompressed is not checked
    needed : so many bytes of a content that is cut off are enough
    """
    if len(content) < 40:
        raise DecompressionError("its header is cut off")
    size = int.from_bytes(content[16:24], "little")
    checksum = int.from_bytes(content[24:28], "little")
    name_end = 32 + int.from_bytes(content[28:32], "little")
    compression = bytes(content[32 : min(name_end, 32 + 64)]).decode("ascii", "replace")
    if name_end + 8 > len(content):
        raise DecompressionError("its header is damaged")
    length = int.from_bytes(content[name_end : name_end + 8], "little")
    packed = content[name_end + 8 : name_end + 8 + length]
    if len(packed) < length and not cut:
        raise DecompressionError("its header is damaged")
    data = inflation.decompress(packed, compression, min(size, needed) if cut else size, partial=cut)
    if checksum and not cut and zlib.crc32(data.data) != checksum:
        raise DecompressionError("its checksum is wrong")
    return data


def is_mcap(stream: BinaryIO) -> bool:
    """Return whether a stream begins like an MCAP file."""
    return stream.read(len(MAGIC)) == MAGIC
