"""MCAP files: chunked or not, indexed or not, whole or cut off (https://mcap.dev/spec)."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

from icrtool.errors import LogError
from icrtool.logio.channel import Block, Channel, ros_type_name
from icrtool.logio.decompress import DecompressionError, decompress
from icrtool.logio.records import MCAP_CHANNEL, MCAP_MESSAGE, MCAP_SCHEMA, RecordTable

if TYPE_CHECKING:
    from mcap.records import Channel as McapChannel
    from mcap.records import Schema

MAGIC = b"\x89MCAP0\r\n"
PIECE_BYTES = 1 << 22
_HEADER, _FOOTER, _CHUNK, _DATA_END = 1, 2, 6, 15
_ENCODINGS = {("cdr", "ros2msg"): "msg", ("cdr", "ros2idl"): "idl", ("ros1", "ros1msg"): "msg"}


class _Chunk(NamedTuple):
    """Where a chunk record's content is: file offset and length; channels it holds, where an index tells."""

    at: int
    length: int
    channels: frozenset[int] | None


class McapFile:
    """One MCAP file.

    Raises
    ------
    LogError
        Not an MCAP file, or nothing in it can be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.files = [path]
        self.problems: list[str] = []
        self._table = RecordTable()
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, McapChannel] = {}
        self._counts: dict[int, int] = {}
        self._stream = path.open("rb")
        self._size = path.stat().st_size
        if self._stream.read(len(MAGIC)) != MAGIC:
            self.close()
            raise LogError(path, "not an MCAP file", "its first bytes are not MCAP's")
        self._chunks = self._read_summary()
        if self._chunks is None:
            for _ in self._walk(frozenset(), report=False):
                pass
        self.channels = [self._channel(number) for number in sorted(self._channels)]

    def share_read(self) -> float:
        """Return the place in the file as a share of its size."""
        return self._stream.tell() / max(self._size, 1)

    def close(self) -> None:
        """Release the file."""
        self._stream.close()

    def blocks(self, wanted: frozenset[int]) -> Iterator[Block]:
        """Yield the messages of the wanted channels, chunk by chunk."""
        if not wanted:
            return
        if self._chunks is None:
            yield from self._walk(wanted, report=True)
            return
        for chunk in self._chunks:
            if chunk.channels is None or chunk.channels & wanted:
                block = self._read_chunk(chunk, wanted, report=True)
                if block is not None:
                    yield block

    def _channel(self, number: int) -> Channel:
        channel = self._channels[number]
        schema = self._schemas.get(channel.schema_id)
        encoding, written = channel.message_encoding, schema.encoding if schema else ""
        return Channel(
            id=number,
            topic=channel.topic,
            message_type=ros_type_name(schema.name) if schema else "",
            encoding=encoding,
            definition=schema.data.decode("utf-8", "replace") if schema and (encoding, written) in _ENCODINGS else "",
            definition_format="idl" if written == "ros2idl" else "msg",
            count=self._counts.get(number) if self._chunks is not None else None,
        )

    def _read_summary(self) -> list[_Chunk] | None:
        """Return the chunks by the file's index; None where there is none, or it does not cover the file."""
        from mcap.exceptions import McapError
        from mcap.reader import SeekingReader

        self._stream.seek(0)
        try:
            summary = SeekingReader(self._stream, record_size_limit=PIECE_BYTES * 16).get_summary()
        except (McapError, ValueError, OSError, EOFError, UnicodeDecodeError, MemoryError, KeyError):
            return None
        if summary is None or summary.statistics is None or not summary.chunk_indexes:
            return None
        if summary.statistics.chunk_count != len(summary.chunk_indexes):
            return None
        if summary.statistics.channel_count != len(summary.channels):
            return None
        self._schemas, self._channels = dict(summary.schemas), dict(summary.channels)
        self._counts = dict(summary.statistics.channel_message_counts)
        return [
            _Chunk(
                index.chunk_start_offset + 9,
                index.chunk_length - 9,
                frozenset(index.message_index_offsets) or None,
            )
            for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
        ]

    def _walk(self, wanted: frozenset[int], *, report: bool) -> Iterator[Block]:
        """Go through the records one after the other, as far as they can be read."""
        stream, at, complete = self._stream, len(MAGIC), False
        while at + 9 <= self._size:
            stream.seek(at)
            head = stream.read(9)
            opcode, length = head[0], int.from_bytes(head[1:], "little")
            left = self._size - at - 9
            if opcode == _CHUNK:
                block = self._read_chunk(_Chunk(at + 9, min(length, left), None), wanted, report=report, cut=length > left)
                if block is not None:
                    yield block
            elif opcode in (MCAP_SCHEMA, MCAP_CHANNEL, MCAP_MESSAGE) and length <= left:
                block, length = self._read_loose(at, length, wanted)
                if block is not None:
                    yield block
            elif opcode in (_FOOTER, _DATA_END):
                complete = True
                break
            elif opcode == 0 or length > left:
                break
            at += 9 + length
        if report and not complete:
            self.problems.append(
                f"{self._path.name}: cut off or damaged at byte {min(at, self._size)} of {self._size}; "
                "what stands before it was read"
            )

    def _read_loose(self, at: int, length: int, wanted: frozenset[int]) -> tuple[Block | None, int]:
        """Read a run of records that stand outside chunks; return them and the bytes consumed after the first 9."""
        self._stream.seek(at)
        piece = np.frombuffer(self._stream.read(max(PIECE_BYTES, 9 + length)), np.uint8)
        rows, stop = self._table.scan_mcap(piece)
        if stop == 0:
            return None, length
        return self._sort_rows(piece, rows, wanted), stop - 9

    def _read_chunk(self, chunk: _Chunk, wanted: frozenset[int], *, report: bool, cut: bool = False) -> Block | None:
        self._stream.seek(chunk.at)
        content = self._stream.read(chunk.length)
        try:
            data = _chunk_records(content, cut=cut)
        except DecompressionError as err:
            if report:
                self.problems.append(f"{self._path.name}: chunk at byte {chunk.at - 9} left out: {err.args[0]}")
            return None
        records = np.frombuffer(data, np.uint8)
        rows, stop = self._table.scan_mcap(records)
        if report and stop < len(records) and not cut:
            self.problems.append(
                f"{self._path.name}: chunk at byte {chunk.at - 9}: {len(records) - stop} of {len(records)} bytes left out, damaged"
            )
        return self._sort_rows(records, rows, wanted)

    def _sort_rows(self, data: np.ndarray, rows: np.ndarray, wanted: frozenset[int]) -> Block | None:
        kinds = rows[:, 0]
        if self._chunks is None or not self._channels:
            for row in rows[kinds != MCAP_MESSAGE]:
                self._learn(int(row[0]), bytes(data[row[3] : row[4]]))
        if not wanted:
            return None
        rows = rows[kinds == MCAP_MESSAGE]
        return Block(data, rows[:, 1].copy(), rows[:, 2].copy(), rows[:, 3].copy(), rows[:, 4].copy())

    def _learn(self, opcode: int, content: bytes) -> None:
        """Remember a schema or channel record that the walk came upon."""
        from io import BytesIO

        from mcap.data_stream import ReadDataStream
        from mcap.exceptions import McapError
        from mcap.records import Channel as McapChannel
        from mcap.records import Schema

        stream = ReadDataStream(BytesIO(content))
        try:
            if opcode == MCAP_SCHEMA:
                schema = Schema.read(stream)
                self._schemas.setdefault(schema.id, schema)
            else:
                channel = McapChannel.read(stream)
                self._channels.setdefault(channel.id, channel)
        except (McapError, ValueError, EOFError, UnicodeDecodeError, MemoryError):
            return


def _chunk_records(content: bytes, *, cut: bool) -> bytes:
    """Return the records of a chunk record's content, decompressed and checked against its checksum."""
    if len(content) < 40:
        raise DecompressionError("its header is cut off")
    size = int.from_bytes(content[16:24], "little")
    checksum = int.from_bytes(content[24:28], "little")
    name_end = 32 + int.from_bytes(content[28:32], "little")
    compression = content[32:name_end].decode("ascii", "replace")
    if name_end + 8 > len(content):
        raise DecompressionError("its header is damaged")
    length = int.from_bytes(content[name_end : name_end + 8], "little")
    packed = memoryview(content)[name_end + 8 : name_end + 8 + length]
    if len(packed) < length and not cut:
        raise DecompressionError("its header is damaged")
    data = decompress(packed, compression, size, partial=cut)
    if checksum and not cut and zlib.crc32(data) != checksum:
        raise DecompressionError("its checksum is wrong")
    return data


def is_mcap(stream: BinaryIO) -> bool:
    """Say whether a stream begins like an MCAP file."""
    return stream.read(len(MAGIC)) == MAGIC
