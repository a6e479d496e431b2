"""Chunks of MCAP files and ROS 1 bags: their place in the file, their decompression, and the records in them.

The stated size of a chunk is checked before memory is allocated. The index of messages is only a hint: each record must
begin at the end of the record before it, which is checked for all records at once. Records that the index lacks are
found by their lengths. If the index is wrong, all records are found by their lengths.
"""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from icrtool.kernels.arrays import Bytes, Ints

LARGEST_CHUNK_BYTES = 1 << 27
"""Largest size of a decompressed chunk [bytes]. Recorders write chunks of 0.75 to about 10 MiB; four chunks are in
memory at a time."""

FREE_BYTES = LARGEST_CHUNK_BYTES
"""Size up to which a log may be decompressed whatever its compressed size is [bytes]."""

LARGEST_RATIO = 100
"""Largest ratio of the decompressed to the compressed size of a log, beyond the first `FREE_BYTES`.

Compression makes recorded chunks 2 to 20 times smaller; the factor is larger for images of one colour.
"""

STORED = ("", "none")
"""Names with which logs state that a chunk is not compressed."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of a zstd frame."""

PIECE_BYTES = 1 << 24
"""Number of bytes that are decompressed at a time, for which libraries need twice the memory. It is also the largest
size of a compressed message that does not state its size [bytes]."""

MOST_RECORDS = 1 << 18
"""Largest number of records that are found at a time."""

_MOST_GAPS = 1 << 8
"""Largest number of gaps between the messages of an index that are searched for records one by one. With more gaps, the
index is not used."""


class DecompressionError(Exception):
    """A chunk cannot be decompressed; `args[0]` is the reason."""


class Buffer:
    """Memory that is reused, because to get new memory from the system takes as long as to read a file into it."""

    _bytes: Bytes = np.empty(0, np.uint8)

    def take(self, size: int) -> Bytes:
        """Return memory (size,), uint8: the memory of the last call if it is large enough."""
        if len(self._bytes) < size:
            self._bytes = np.empty(size, np.uint8)
        return self._bytes[:size]


class Chunk(NamedTuple):
    """A chunk of a file, as the index describes it.

    Attributes
    ----------
    at, length : offset in the file, and length, of the content [bytes]; for a bag whose chunk record was not read yet,
        the offset of the record, and 0
    channels : channels of the messages in the chunk, None where the index does not list them
    begin_ns, end_ns : first and last log time in the chunk [ns], 0 where they are not known
    index_length : length of the message index records behind the content [bytes]; for a bag whose chunk record was not
        read yet, with the length of the chunk record
    size : decompressed size of the records [bytes]; -1 if there is no chunk at this offset
    compression : name of the compression in the log
    is_cut : whether the file ends inside the chunk; the checksum is then not checked
    """

    at: int
    length: int = 0
    channels: frozenset[int] | None = None
    begin_ns: int = 0
    end_ns: int = 0
    index_length: int = 0
    size: int = 0
    compression: str = ""
    is_cut: bool = False

    def is_partly(self, wanted: frozenset[int]) -> bool:
        """Return whether the chunk holds messages of channels that are not wanted; False where it is not known."""
        return self.channels is not None and not self.channels <= wanted

    @property
    def is_uncompressed(self) -> bool:
        """Whether the records are not compressed, so that each can be read alone."""
        return self.compression in STORED and self.index_length > 0 and self.size <= self.length


class PackedChunk(NamedTuple):
    """The compressed content of a chunk.

    Attributes
    ----------
    data : (n,) the compressed bytes
    compression : ``""``/``none``, ``lz4``, ``zstd`` or ``bz2``
    size : decompressed size that the log states [bytes]; for uncompressed data its size
    partial : whether the data is cut off, or only its first `size` bytes are wanted; the result may be shorter
    checksum : CRC-32 of the decompressed bytes, 0 for no check
    """

    data: Bytes
    compression: str
    size: int
    partial: bool = False
    checksum: int = 0


def decompress(packed: PackedChunk, space: Bytes) -> Bytes:
    """Return the decompressed bytes of a chunk (n,).

    Parameters
    ----------
    packed : the compressed content
    space : memory for the decompressed bytes and one further byte

    Returns
    -------
    Bytes
        uint8, read-only: a part of `space`, of the data of the chunk, or new memory.

    Raises
    ------
    DecompressionError
        The data is damaged, its size or checksum differs from the stated one, or the compression is not known.
    """
    data, compression, size, partial, checksum = packed
    try:
        match compression:
            case "" | "none":
                out = data
            case "zstd":
                # zstd decompresses a frame without a copy if the memory is large enough for all of it.
                space = space[: size if partial else size + 1]
                with zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES).stream_reader(data.data) as reader:
                    out = space[: reader.readinto(space)]
            case "lz4":
                out = _in_pieces(lz4.frame.LZ4FrameDecompressor(), data, size)
            case "bz2":
                out = _in_pieces(bz2.BZ2Decompressor(), data, size)
            case _:
                raise DecompressionError(f"compression {compression!r} is not known")
    except (OSError, RuntimeError, EOFError, ValueError, MemoryError, zstandard.ZstdError) as err:
        raise DecompressionError(str(err) or "not enough memory") from err
    if len(out) != size and not partial:
        raise DecompressionError(f"{len(out)} bytes instead of {size}")
    if checksum and zlib.crc32(out.data) != checksum:
        raise DecompressionError("its checksum is wrong")
    return out


def _in_pieces(decoder: Any, data: Bytes, size: int) -> Bytes:  # noqa: ANN401 - of two libraries
    """Return at most `size` + 1 decompressed bytes, decompressed piece by piece."""
    piece = decoder.decompress(data, max_length=min(size + 1, PIECE_BYTES))
    if len(piece) < PIECE_BYTES:
        return np.frombuffer(piece, np.uint8)
    out = bytearray(piece)
    while not decoder.eof and (piece := decoder.decompress(b"", max_length=min(size + 1 - len(out), PIECE_BYTES))):
        out += piece
    return np.frombuffer(out, np.uint8)


@dataclass(slots=True)
class Inflation:
    """Limit on the total decompressed size of the chunks of a log, as a multiple of their size in the file.

    Attributes
    ----------
    left : bytes that further chunks may have beyond `LARGEST_RATIO` times their size in the file
    """

    left: int = FREE_BYTES

    def count(self, packed: int, unpacked: int) -> None:
        """Count a chunk of `packed` compressed and `unpacked` decompressed bytes.

        Raises
        ------
        DecompressionError
            The decompressed size is larger than the limit of a chunk or of the log.
        """
        if unpacked > LARGEST_CHUNK_BYTES:
            raise DecompressionError(f"it claims {unpacked} bytes")
        allowed_bytes = self.left + LARGEST_RATIO * packed - unpacked
        if allowed_bytes < 0:
            raise DecompressionError(
                f"it inflates from {packed} to {unpacked} bytes; {LARGEST_RATIO} times are allowed"
            )
        self.left = allowed_bytes


class Records(NamedTuple):
    """Records that follow one another in memory.

    Attributes
    ----------
    messages : (4, n) channel, log time [ns], begin and end offset of the content of each message
    others : operation code, offset, and begin and end offset of the content of each other record
    stop : the byte behind the last record: an incomplete record, another kind of record, or the end
    """

    messages: Ints
    others: list[tuple[int, int, int, int]]
    stop: int


def record_starts(
    data: Bytes,
    begin: int,
    hint: Ints | None,
    record_end: Callable[[memoryview, int, int], int],
    message_ends: Callable[[Bytes, Ints], Ints],
) -> tuple[Ints, int]:
    """Return the offsets of the records from `begin` on (n,), and the byte behind the last record.

    Parameters
    ----------
    data : memory with the records
    begin : offset of the first record
    hint : (m,) offsets of messages by the index, ascending; None without an index
    record_end : returns the end of the record at a byte, given the end of the data; the byte itself without a record
    message_ends : returns the ends of messages (n,); the offset of a message where there is none
    """
    view = data.data
    if hint is not None and 0 < len(hint) <= MOST_RECORDS and hint[0] >= begin:
        first, last = np.append(begin, message_ends(data, hint)), np.append(hint, len(data))
        gaps = np.flatnonzero(first != last)
        if (first <= last).all() and (last[:-1] < first[1:]).all() and len(gaps) <= _MOST_GAPS:
            found = [
                follow_records(view, *gap, record_end)
                for gap in zip(first[gaps].tolist(), last[gaps].tolist(), strict=True)
            ]
            if all(stop == last[gap] for gap, (_, stop) in zip(gaps, found, strict=True)):
                others = np.array([at for starts, _ in found for at in starts], np.int64)
                return (np.sort(np.append(hint, others)) if len(others) else hint), len(data)
    starts, stop = follow_records(view, begin, len(data), record_end)
    return np.array(starts, np.int64), stop


def follow_records(
    data: memoryview, at: int, end: int, record_end: Callable[[memoryview, int, int], int]
) -> tuple[list[int], int]:
    """Return the offsets of the records in [at, end), found one by one, and the byte behind the last record."""
    starts: list[int] = []
    while len(starts) < MOST_RECORDS and (after := record_end(data, at, end)) > at:
        starts.append(at)
        at = after
    return starts, at


def values_at_each_byte(data: Bytes, kind: str | np.dtype[Any]) -> NDArray[Any]:
    """Return the value of type `kind` that begins at each byte, as a view (n,)."""
    return np.ndarray(max(len(data) - np.dtype(kind).itemsize + 1, 0), kind, data, strides=(1,))
