"""A chunk of an MCAP file or a ROS 1 bag: its place, its decompressed content, and the begins of its records.

The stated size of a chunk is checked before memory is allocated. The index of messages is only a hint: each record must
begin at the end of the record before it, which is checked for all records at once. Records that the index lacks are
found by their lengths; if the index is wrong, all records are found by their lengths.
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
"""Largest decompressed chunk [bytes], 128 MiB. Recorders write chunks of 0.75 to about 10 MiB; four chunks are in
memory at a time."""

FREE_BYTES = LARGEST_CHUNK_BYTES
"""Largest size of a decompressed log of any ratio [bytes]."""

LARGEST_RATIO = 100
"""Largest ratio of the decompressed size of a log to its size; `FREE_BYTES` more are allowed.

Compression makes recorded chunks 2 to 20 times smaller; the factor is larger for images of one colour.
"""

STORED = ("", "none")
"""Names of no compression in logs."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
PIECE_BYTES = 1 << 24
"""Number of bytes that are decompressed at a time; libraries hold twice this number. Also the largest size of a message
without a stated size [bytes]."""

MOST_RECORDS = 1 << 18
"""Number of records that are followed at a time."""

_MOST_GAPS = 1 << 8
"""Largest number of gaps between messages of an index whose records are followed; with more gaps, all records are
followed."""


class DecompressionError(Exception):
    """A chunk that cannot be decompressed; `args[0]` is the reason."""


class Space:
    """Memory that is used again, because new memory of the system takes as long as reading a file into it."""

    _bytes: Bytes = np.empty(0, np.uint8)

    def of(self, size: int) -> Bytes:
        """Return memory (size,) of `size` bytes; the memory of the last call if it is large enough."""
        if len(self._bytes) < size:
            self._bytes = np.empty(size, np.uint8)
        return self._bytes[:size]


class Chunk(NamedTuple):
    """A chunk in a file, by the index.

    Attributes
    ----------
    at, length : place and length of the content in the file [bytes]; before the record of a bag is read: place of the
        record, and 0
    channels : channels in the chunk, None without an entry in the index
    begin_ns, end_ns : first and last log time in the chunk, 0 where they are not known
    index_length : length of the following message index records and of the unread part of a bag's record [bytes]
    size : decompressed size of the records [bytes]; -1 if there is no chunk at this place
    compression : name of the compression in the log
    is_cut : the file ends inside the chunk; the checksum of the decompressed part is not checked
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
        """Return whether the chunk holds other channels, too."""
        return self.channels is not None and not self.channels <= wanted

    @property
    def is_stored(self) -> bool:
        """Whether the records are not compressed, and can be read one by one."""
        return self.compression in STORED and self.index_length > 0 and self.size <= self.length


class Packed(NamedTuple):
    """The compressed part of a chunk.

    Attributes
    ----------
    compression : ``""``/``none``, ``lz4``, ``zstd`` or ``bz2``
    size : decompressed size as the log states; for uncompressed data its size [bytes]
    partial : the data is cut off, or only a part of `size` bytes is wanted; the result may be shorter than `size`
    checksum : CRC-32 of the decompressed bytes, 0 for no check
    """

    data: Bytes
    compression: str
    size: int
    partial: bool = False
    checksum: int = 0


def decompress(packed: Packed, space: Bytes) -> Bytes:
    """Return the decompressed bytes of a chunk.

    Parameters
    ----------
    space : memory for the decompressed bytes and one further byte

    Returns
    -------
    uint8, read-only: a part of `space`, of the data of the chunk, or new memory.

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
                # If the space holds a whole frame, zstd decompresses into it without a copy.
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
    """Return up to `size` decompressed bytes and one further byte, decompressed piece by piece."""
    piece = decoder.decompress(data, max_length=min(size + 1, PIECE_BYTES))
    if len(piece) < PIECE_BYTES:
        return np.frombuffer(piece, np.uint8)
    out = bytearray(piece)
    while not decoder.eof and (piece := decoder.decompress(b"", max_length=min(size + 1 - len(out), PIECE_BYTES))):
        out += piece
    return np.frombuffer(out, np.uint8)


@dataclass(slots=True)
class Inflation:
    """Limit on the decompressed size of the chunks of a log, as a multiple of their size in the file.

    Attributes
    ----------
    left : bytes that the next chunks may have in addition
    """

    left: int = FREE_BYTES

    def count(self, packed: int, unpacked: int) -> None:
        """Count decompressed bytes.

        Raises
        ------
        DecompressionError
            Their number is larger than the limit of a chunk or of the log.
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
    """Return the begins of records (n,), and the first byte after the last record.

    Parameters
    ----------
    behind : returns the end of the record at a place if it is before an end; the place itself if it has no record
    ends : returns the ends of messages (n,); the begin of a message where there is no message
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
    """Return the begins of the records in [at, end), found one after the other, and the place where they stop."""
    starts: list[int] = []
    while len(starts) < MOST_RECORDS and (after := behind(data, at, end)) > at:
        starts.append(at)
        at = after
    return starts, at


def values_at_each_byte(data: Bytes, kind: str | np.dtype[Any]) -> NDArray[Any]:
    """Return the value that begins at each byte."""
    return np.ndarray(max(len(data) - np.dtype(kind).itemsize + 1, 0), kind, data, strides=(1,))
