"""MCAP files, with and without chunks, with and without an index, complete or cut off (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from functools import cache
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from icrtool.errors import LogError
from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.chunk import (
    LARGEST_CHUNK_BYTES,
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

if TYPE_CHECKING:
    from mcap.records import Channel as McapChannel
    from mcap.records import Schema, Statistics

MCAP_MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of an MCAP file."""

MCAP_PIECE_BYTES = 1 << 22
"""Number of bytes of a file without index that are read at a time."""

_SCHEMA, _CHANNEL, _MESSAGE = 3, 4, 5
_FOOTER, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX, _STATISTICS, _DATA_END = 2, 6, 7, 8, 11, 15
"""Operation codes of records."""

_HEAD, _INDEX_HEAD = struct.Struct("<BQ"), struct.Struct("<BQHI")
_HEAD_BYTES, _FOOTER_BYTES, _CHECKSUM_BYTES = 9, 20, 4
_MESSAGE_HEADS = np.dtype(
    [("code", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("time", "<i8"), ("published", "<u8")]
)
_LEAST_MESSAGE_BYTES = _MESSAGE_HEADS.itemsize - _HEAD_BYTES

_ENCODINGS = {
    ("cdr", "ros2msg"), ("cdr", "ros2idl"), ("ros1", "ros1msg"), ("protobuf", "protobuf"), ("json", "jsonschema")
}  # fmt: skip

_LARGEST_BLOCK_BYTES = (1 << 17) + 1024
"""Largest size of a zstd block with the header of a frame [bytes]. To decompress n bytes, a decoder needs at most n
compressed bytes and this number of further ones."""


def scan_mcap(data: Bytes, begin: int, hint: Ints | None = None) -> Records:
    """Return the schema, channel and message records from `begin` on.

    Parameters
    ----------
    data : memory with the records
    begin : offset of the first record
    hint : (n,) offsets of messages by the index, ascending; None without an index
    """
    starts, stop = record_starts(data, begin, hint, _behind_record, _message_ends)
    codes = data[starts]
    is_message = codes == _MESSAGE
    at = starts if is_message.all() else starts[is_message]
    heads = _message_heads(data, at)
    messages = np.empty((4, len(at)), np.int64)
    messages[0], messages[1] = heads["channel"], heads["time"]
    messages[2], messages[3] = at + _MESSAGE_HEADS.itemsize, at + (9 + heads["length"].astype(np.int64))
    others = []
    for offset in starts[~is_message].tolist():
        code, length = _HEAD.unpack_from(data.data, offset)
        others.append((code, offset, offset + 9, offset + 9 + length))
    return Records(messages, others, stop)


def _behind_record(data: memoryview, at: int, end: int) -> int:
    """Return the end of the record at a byte; the byte itself if the record is cut off or of another kind."""
    code, length = _HEAD.unpack_from(data, at) if at + _HEAD_BYTES <= end else (0, 0)
    is_record = _SCHEMA <= code <= _MESSAGE and (code != _MESSAGE or length >= _LEAST_MESSAGE_BYTES)
    behind: int = at + _HEAD_BYTES + length
    return behind if is_record and behind <= end else at


def _message_ends(data: Bytes, at: Ints) -> Ints:
    """Return the ends of the messages that begin at some bytes (n,); the byte itself where no message begins."""
    if at[-1] > len(data) - _MESSAGE_HEADS.itemsize:
        return at
    heads = _message_heads(data, at)
    length = heads["length"]
    good = (heads["code"] == _MESSAGE) & (length >= _LEAST_MESSAGE_BYTES) & (length <= len(data))
    return np.where(good, at + (length.astype(np.int64) + 9), at)


def _message_heads(data: Bytes, at: Ints) -> NDArray[Any]:
    """Return the header of each message (n,)."""
    together: NDArray[Any] = values_at_each_byte(data, f"V{_MESSAGE_HEADS.itemsize}")[at].view(_MESSAGE_HEADS)
    return together


def _message_index(index: bytes) -> tuple[Ints, Ints]:
    """Return the offsets of the messages of a chunk in its records (n,), and their channels (n,).

    Both are empty where the index is damaged.
    """
    offsets, channels, at = [np.empty(0, np.int64)], [np.empty(0, np.int64)], 0
    while at + _INDEX_HEAD.size <= len(index):
        code, length, channel, _ = _INDEX_HEAD.unpack_from(index, at)
        if code != _MESSAGE_INDEX or not 6 <= length <= len(index) - at - _HEAD_BYTES or len(offsets) > 1 << 16:
            return offsets[0], channels[0]
        entries = np.frombuffer(index, "<u8", (length - 6) // 16 * 2, at + _INDEX_HEAD.size)
        offsets.append(entries[1::2].astype(np.int64))
        channels.append(np.full(len(entries) // 2, channel))
        at += _HEAD_BYTES + length
    return np.concatenate(offsets), np.concatenate(channels)


class McapFile(ChunkedFile):
    """An open MCAP file.

    Parameters
    ----------
    message_compression : compression of each single message, from rosbag2's metadata.yaml; empty for none

    Raises
    ------
    LogError
        The file is no MCAP file.
    """

    _chunk_head = _HEAD_BYTES
    _unpacks_parts = True
    _find_records = staticmethod(scan_mcap)
    _message_index = staticmethod(_message_index)
    _schemas: dict[int, Schema]
    _channels: dict[int, McapChannel]
    _counts: dict[int, int]
    _described_bytes: int

    def _read_channels(self) -> list[Channel]:
        described = []

        @cache
        def text_of(number: int) -> str:
            """Return the text of a schema, which is decoded once for all of its channels."""
            schema = self._schemas[number]
            text = ("latin-1",) if schema.encoding == "protobuf" else ("utf-8", "replace")
            return schema.data.decode(*text)

        for number, channel in sorted(self._channels.items()):
            schema = self._schemas.get(channel.schema_id)
            encoding, written = channel.message_encoding, schema.encoding if schema else ""
            is_known = schema is not None and (encoding, written) in _ENCODINGS
            described.append(
                Channel(
                    id=number,
                    topic=LogText(channel.topic),
                    message_type=ros_type_name(schema.name) if schema else LogText(""),
                    encoding=LogText(encoding),
                    definition=text_of(channel.schema_id) if is_known else "",
                    definition_format="idl" if written == "ros2idl" else "msg",
                    count=self._counts.get(number) if self._chunks is not None else None,
                )
            )
        return described

    def _read_index(self) -> list[Chunk] | None:
        if self._source.read_at(0, len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise LogError(self.path, "not an MCAP file", "its first bytes are not an MCAP file's")
        # The channels come from the index, or, without an index, from the records.
        self._schemas, self._channels, self._counts, self._described_bytes = {}, {}, {}, 0
        start, summary = self._summary()
        chunks: list[Chunk] = []
        schemas: dict[int, Schema] = {}
        channels: dict[int, McapChannel] = {}
        statistics: Statistics | None = None
        at = 0
        while at + _HEAD_BYTES <= len(summary):
            opcode, length = _HEAD.unpack_from(summary, at)
            content = summary[at + _HEAD_BYTES : at + _HEAD_BYTES + length]
            at += _HEAD_BYTES + length
            if opcode not in (_SCHEMA, _CHANNEL, _CHUNK_INDEX, _STATISTICS):
                continue
            if (record := _parse(opcode, content)) is None:
                return None
            if opcode == _CHUNK_INDEX:
                chunks.append(record)
            elif opcode == _STATISTICS:
                statistics = record
            else:
                (schemas if opcode == _SCHEMA else channels)[record.id] = record
        if statistics is None or not chunks or len(chunks) != statistics.chunk_count:
            return None
        if len(schemas) < statistics.schema_count or len(channels) < statistics.channel_count:
            return None
        chunks.sort(key=lambda chunk: chunk.at)
        if not self._is_complete(chunks, start):
            return None
        self._schemas, self._channels = schemas, channels
        self._counts = dict(statistics.channel_message_counts)
        return chunks

    def _summary(self) -> tuple[int, bytes]:
        """Return the offset of the summary and its records; 0 and no records if the summary is damaged."""
        end = self._size - len(MCAP_MAGIC) - _FOOTER_BYTES - _HEAD_BYTES
        footer = self._source.read_at(max(end, 0), _HEAD_BYTES + _FOOTER_BYTES)
        start = int.from_bytes(footer[9:17], "little")
        if (
            footer[:1] != bytes([_FOOTER])
            or self._source.read_at(self._size - len(MCAP_MAGIC), len(MCAP_MAGIC)) != MCAP_MAGIC
            or not 0 < start <= end
            or end - start > LARGEST_CHUNK_BYTES
        ):
            return 0, b""
        summary = self._source.read_at(start, end - start)
        checksum = int.from_bytes(footer[-_CHECKSUM_BYTES:], "little")
        if checksum and zlib.crc32(footer[:-_CHECKSUM_BYTES], zlib.crc32(summary)) != checksum:
            return 0, b""
        return start, summary

    def _is_complete(self, chunks: Sequence[Chunk], end: int) -> bool:
        """Return whether the chunks of the index do not overlap, and hold all messages before `end`.

        A chunk that is not at the offset that the index states is damaged; but if the same number of chunks is found
        without the index, the index is wrong.
        """
        at, damaged = len(MCAP_MAGIC), []
        ranges = [(chunk.at - _HEAD_BYTES, chunk.at + chunk.length + chunk.index_length) for chunk in chunks]
        for begin, behind in [*ranges, (end, end)]:
            if at > begin:
                return False
            while at < begin:
                opcode, length = self._head(at)
                if opcode in (_MESSAGE, _CHUNK):
                    return False
                if opcode == 0 or length > begin - at - _HEAD_BYTES:
                    damaged.append(f"damaged at byte {at}; reading goes on at byte {begin}")
                    break
                at += _HEAD_BYTES + length
            at = behind
        # Requests for each header of a distant file take minutes. A file that may be damaged is fetched to disk.
        heads = (self._head(chunk.at - _HEAD_BYTES) for chunk in (chunks[:1] if self._remote is not None else chunks))
        suspect = damaged or any(head != (_CHUNK, chunk.length) for head, chunk in zip(heads, chunks, strict=False))
        if suspect and (self._remote is not None or self._chunks_in_order(end) == len(chunks)):
            return False
        for damage in damaged:
            self.report("log_damaged", damage)
        return True

    def _chunks_in_order(self, end: int) -> int:
        """Return the number of chunks among the records up to `end`; 0 if there are gaps between the records."""
        at, count = len(MCAP_MAGIC), 0
        while at < end:
            opcode, length = self._head(at)
            if opcode == 0:
                return 0
            at, count = at + _HEAD_BYTES + length, count + (opcode == _CHUNK)
        return count if at == end else 0

    def _head(self, at: int) -> tuple[int, int]:
        """Return operation code and length of the record at a file offset; code 0 without a record."""
        head = self._source.read_at(at, _HEAD_BYTES) if 0 <= at < self._size else b""
        return (head[0], int.from_bytes(head[1:], "little")) if len(head) == _HEAD_BYTES else (0, 0)

    def _read_in_order(self) -> Iterator[MessageBlock]:
        """Yield the messages up to the first byte where no record begins."""
        at, spaces = len(MCAP_MAGIC), reused_buffers()
        memory = next(spaces)
        while True:
            opcode, length = self._head(at)
            remaining = self._size - at - _HEAD_BYTES
            if opcode in (_FOOTER, _DATA_END):
                return
            if opcode == _CHUNK:
                chunk = Chunk(at + _HEAD_BYTES, min(length, remaining), is_cut=length > remaining)
                if (yield from self._read_chunk(ChunkPart(chunk), memory)):
                    memory = next(spaces)
            elif opcode in (_SCHEMA, _CHANNEL, _MESSAGE) and length <= remaining:
                block, length = self._read_outside_chunks(at, length)
                if block is not None:
                    yield block
            if opcode == 0 or length > remaining:
                break
            at += _HEAD_BYTES + length
        self.report("log_cut_off", f"cut off or damaged at byte {at} of {self._size}; everything before it was read")

    def _read_outside_chunks(self, at: int, length: int) -> tuple[MessageBlock | None, int]:
        """Return the messages of records outside chunks, and the number of bytes that were read after the first 9."""
        stop = 0
        if length <= LARGEST_CHUNK_BYTES:
            self._at = at
            piece = np.frombuffer(self._source.read_at(at, max(MCAP_PIECE_BYTES, _HEAD_BYTES + length)), np.uint8)
            block, stop = self._scan(piece)
            if stop:
                return block, stop - _HEAD_BYTES
        self.report("log_damaged", f"record at byte {at} left out: damaged")
        return None, length

    def _read_packed(self, part: ChunkPart, space: Buffer, needed: int = 0) -> PackedChunk:
        length = min(part.chunk.length, needed + _LARGEST_BLOCK_BYTES) if needed else part.chunk.length
        content = self._read_content(part.chunk.at, length, space, part.held)
        if len(content) < 40:
            raise DecompressionError("its header is cut off")
        size = int.from_bytes(content[16:24], "little")
        checksum = int.from_bytes(content[24:28], "little")
        name_end = 32 + int.from_bytes(content[28:32], "little")
        compression = bytes(content[32 : min(name_end, 32 + 64)]).decode("ascii", "replace")
        if name_end + 8 > len(content):
            raise DecompressionError("its header is damaged")
        packed = int.from_bytes(content[name_end : name_end + 8], "little")
        data = content[name_end + 8 : name_end + 8 + packed]
        if compression in STORED:
            size = len(data)
        if part.chunk.is_cut or needed:
            return PackedChunk(data, compression, min(size, needed or LARGEST_CHUNK_BYTES), partial=True)
        # A header of zeros is valid for an empty chunk alone; the index of a damaged chunk may state a size.
        if len(data) < packed or (not checksum and not packed and part.chunk.size > 0):
            raise DecompressionError("its header is damaged")
        return PackedChunk(data, compression, size, checksum=checksum)

    def _learn(self, data: Bytes, record: tuple[int, int, int, int]) -> None:
        code, _, start, end = record
        if end - start > LARGEST_DESCRIPTIONS_BYTES - self._described_bytes:
            self.report(
                "log_damaged", f"schemas and channels of more than {LARGEST_DESCRIPTIONS_BYTES} bytes were left out"
            )
            return
        described = _parse(code, bytes(data[start:end]))
        if described is None:
            self.report("log_damaged", "a schema or channel that cannot be read was left out")
            return
        before: dict[int, Any] = self._schemas if code == _SCHEMA else self._channels
        if described.id not in before:
            self._described_bytes += end - start
        known = before.setdefault(described.id, described) == described
        if not known:
            subject = f"{type(described).__name__.lower()} {described.id}"
            self.report(
                "log_parts_contradict", f"{subject} has two different descriptions; the first description was used"
            )


def _parse(opcode: int, content: bytes) -> Any:  # noqa: ANN401 - a chunk, or a record of the library
    """Return the content of a chunk index, schema, channel or statistics record; None for a damaged record."""
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.records import Channel, Schema, Statistics

    kinds = {_SCHEMA: Schema.read, _CHANNEL: Channel.read, _STATISTICS: Statistics.read}
    try:
        if opcode != _CHUNK_INDEX:
            return kinds[opcode](ReadDataStream(BytesIO(content)))
        begin_ns, end_ns, start, length, map_bytes = struct.unpack_from("<QQQQI", content)
        channels = frozenset(channel for channel, _ in struct.iter_unpack("<HQ", content[36 : 36 + map_bytes]))
        index_length, name_bytes = struct.unpack_from("<QI", content, 36 + map_bytes)
        name_end = 48 + map_bytes + name_bytes
        compression = content[48 + map_bytes : name_end].decode("ascii", "replace")
        _, size = struct.unpack_from("<QQ", content, name_end)
        at, length = start + _HEAD_BYTES, length - _HEAD_BYTES
        return Chunk(at, length, channels or None, begin_ns, end_ns, index_length, size, compression)
    except (McapError, struct.error, ValueError, OverflowError, MemoryError):
        return None
