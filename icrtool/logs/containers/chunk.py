"""A chunk of an MCAP file or a ROS 1 bag: where it is, what it decompresses to, and where its records begin.

Its stated size is checked before memory is allocated. The index of messages is only a hint. Each record must begin
where the record before it ends, which is checked for all records at once. Records that the index lacks are found by
following their lengths; where the index is wrong, all records are.
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
"""Largest decompressed chunk [bytes], an eighth of a gibibyte. Recorders write chunks of 0.75 to some 10 MiB; four are
in memory at a time."""

FREE_BYTES = LARGEST_CHUNK_BYTES
"""Largest size of a decompressed log of any ratio [bytes]."""

LARGEST_RATIO = 100
"""Largest size of a decompressed log over its size; `FREE_BYTES` more are allowed.

Recorded chunks shrink by a factor of 2 to 20, images of one colour by more.
"""

STORED = ("", "none")
"""Names of no compression in logs."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
PIECE_BYTES = 1 << 24
"""Bytes that are decompressed at once, while libraries hold twice that size; also the largest message that states no
size."""

MOST_RECORDS = 1 << 18
"""Number of records that are followed at a time."""

_MOST_GAPS = 1 << 8
"""Largest number of gaps between messages of an index whose records are followed; with more gaps, all records are
followed."""


class DecompressionError(Exception):
    """A chunk that cannot be decompressed; `args[0]` is the reason."""


class Space:
    """Memory that is used again: fresh memory of the system takes the time of reading a file into it."""

    _bytes: Bytes = np.empty(0, np.uint8)

    def of(self, size: int) -> Bytes:
        """Return `size` bytes (size,), the same memory as before where it is large enough."""
        if len(self._bytes) < size:
            self._bytes = np.empty(size, np.uint8)
        return self._bytes[:size]


class Chunk(NamedTuple):
    """A chunk in a file, by the index.

    Attributes
    ----------
    at, length : where its content is in the file; before a bag's record is read: where that begins, and 0
    channels : the channels that it holds, None without an entry
    begin_ns, end_ns : first and last log time in it, 0 where they are not known
    index_length : length of the message index records that follow it, and of the unread part of a bag's record
    size : of its records, decompressed; -1 where there is no chunk in its place
    compression : as the log calls it
    is_cut : the file ends in it: what can be decompressed is not checked
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
        """Return whether it holds other channels, too."""
        return self.channels is not None and not self.channels <= wanted

    @property
    def is_stored(self) -> bool:
        """Whether its records can be read one by one."""
        return self.compression in STORED and self.index_length > 0 and self.size <= self.length


class Packed(NamedTuple):
    """The compressed part of a chunk.

    Attributes
    ----------
    compression : ``""``/``none``, ``lz4``, ``zstd`` or ``bz2``
    size : size when decompressed, as the log states; of uncompressed data, its own size [bytes]
    partial : the data is cut off, or `size` is only a part of it: what can be decompressed is wanted
    checksum : CRC-32 of the decompressed bytes, 0 where that is not checked
    """

    data: Bytes
    compression: str
    size: int
    partial: bool = False
    checksum: int = 0


def decompress(packed: Packed, space: Bytes) -> Bytes:
    """Decompress a chunk.

    Parameters
    ----------
    space : memory for the decompressed bytes, and one byte more

    Returns
    -------
    uint8, not to be written to; in `space`, in the chunk's data, or in memory of its own.

    Raises
    ------
    DecompressionError
        Damaged data, a size or checksum other than stated, or an unknown compression.
    """
    data, compression, size, partial, checksum = packed
    try:
        match compression:
            case "" | "none":
                out = data
            case "zstd":
                # Where the space holds all of a frame, zstd decompresses straight into it.
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
    """Decompress up to `size` bytes and one more, a piece at a time."""
    piece = decoder.decompress(data, max_length=min(size + 1, PIECE_BYTES))
    if len(piece) < PIECE_BYTES:
        return np.frombuffer(piece, np.uint8)
    out = bytearray(piece)
    while not decoder.eof and (piece := decoder.decompress(b"", max_length=min(size + 1 - len(out), PIECE_BYTES))):
        out += piece
    return np.frombuffer(out, np.uint8)


@dataclass(slots=True)
class Inflation:
    """Limits the decompressed size of the chunks of a log to a multiple of their size in the file.

    Attributes
    ----------
    left : bytes that the next chunks may take in addition
    """

    left: int = FREE_BYTES

    def count(self, packed: int, unpacked: int) -> None:
        """Count what is decompressed [bytes].

        Raises
        ------
        DecompressionError
            It is larger than the limit of a chunk or of the log.
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
    """Records that follow one another.

    Attributes
    ----------
    messages : (4, n) channel, log time [ns], begin and end of the content
    others : operation code, begin, and begin and end of the content of all other records
    stop : the first byte after the records: an incomplete record, another kind of record, or the end
    """

    messages: Ints
    others: list[tuple[int, int, int, int]]
    stop: int


def record_starts(
    data: Bytes,
    begin: int,
    hint: Ints | None,
    behind: Callable[[memoryview, int, int], int],
    ends: Callable[[Bytes, Ints], Ints],
) -> tuple[Ints, int]:
    """Return where records begin (n,), and the first byte behind them.

    Parameters
    ----------
    behind : returns where the record at a place ends, if that is before an end; the place itself where there is none
    ends : returns where messages (n,) end; their begin where there is none
    """
    view = data.data
    if hint is not None and 0 < len(hint) <= MOST_RECORDS and hint[0] >= begin:
        first, last = np.append(begin, ends(data, hint)), np.append(hint, len(data))
        gaps = np.flatnonzero(first != last)
        if (first <= last).all() and (last[:-1] < first[1:]).all() and len(gaps) <= _MOST_GAPS:
            found = [
                follow_records(view, *gap, behind)
                for gap in zip(first[gaps].tolist(), last[gaps].tolist(), strict=True)
            ]
            if all(stop == last[gap] for gap, (_, stop) in zip(gaps, found, strict=True)):
                others = np.array([at for some, _ in found for at in some], np.int64)
                return (np.sort(np.append(hint, others)) if len(others) else hint), len(data)
    starts, stop = follow_records(view, begin, len(data), behind)
    return np.array(starts, np.int64), stop


def follow_records(
    data: memoryview, at: int, end: int, behind: Callable[[memoryview, int, int], int]
) -> tuple[list[int], int]:
    """Return where the records [at, end) begin, one after the other, and where they stop."""
    starts: list[int] = []
    while len(starts) < MOST_RECORDS and (after := behind(data, at, end)) > at:
        starts.append(at)
        at = after
    return starts, at


def values_at_each_byte(data: Bytes, kind: str | np.dtype[Any]) -> NDArray[Any]:
    """Return the value that begins at each byte."""
    return np.ndarray(max(len(data) - np.dtype(kind).itemsize + 1, 0), kind, data, strides=(1,))
