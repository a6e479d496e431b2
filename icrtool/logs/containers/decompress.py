"""Decompression with a limit: the size that a chunk states is checked before memory is allocated."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterator

import numpy as np

from icrtool.logs.containers.channel import Block

LARGEST_CHUNK_BYTES = 1 << 28
"""A quarter of a gibibyte. Recorders write chunks of 0.75 to some 10 MiB; a chunk that states more is damaged."""

LARGEST_RATIO = 100
"""A log may take this many times its size when decompressed, and one chunk of the largest size more."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_BLOCK_BYTES = 1 << 24
_UNKNOWN_SIZE_BYTES = 1 << 24


class Inflation:
    """Counts the bytes decompressed from a log, and limits them to a multiple of their size in the file.

    Recorded chunks shrink by a factor of 2 to 20. A crafted chunk can grow by 1,000 times; a thousand such chunks would
    take minutes.
    """

    def __init__(self) -> None:
        self._left = LARGEST_CHUNK_BYTES

    def decompress(self, data: bytes | memoryview, compression: str, size: int, *, partial: bool = False) -> bytes:
        """Decompress a chunk as `decompress` does.

        Raises
        ------
        DecompressionError
            Damaged data; or the chunks before this one inflated more than `LARGEST_RATIO` times and one chunk.
        """
        self.check()
        out = decompress(data, compression, size, partial=partial)
        self.add(len(data), len(out))
        return out

    def check(self) -> None:
        """Refuse to decompress more, where what was decompressed is too much.

        Raises
        ------
        DecompressionError
            As `decompress`.
        """
        if self._left < 0:
            raise DecompressionError(f"the log inflates more than {LARGEST_RATIO} times")

    def add(self, packed: int, unpacked: int) -> None:
        """Count what was decompressed [bytes]."""
        self._left += LARGEST_RATIO * packed - unpacked


class DecompressionError(Exception):
    """A chunk that cannot be decompressed; `args[0]` is the reason."""


def decompress(data: bytes | memoryview, compression: str, size: int, *, partial: bool = False) -> bytes:
    """Decompress a chunk.

    Parameters
    ----------
    compression : ``""``/``none``, ``lz4``, ``zstd`` or ``bz2``
    size : decompressed size stated in the log [bytes]
    partial : the data is cut off; return the part that can be decompressed

    Raises
    ------
    DecompressionError
        Damaged data, a size other than `size`, or an unknown compression.
    """
    if compression in ("", "none"):
        return bytes(data)
    if size > LARGEST_CHUNK_BYTES:
        raise DecompressionError(f"it claims {size} bytes")
    decoder = _DECODERS.get(compression)
    if decoder is None:
        raise DecompressionError(f"compression {compression!r} is not known")
    try:
        out = decoder(data, size, partial)
    except (OSError, RuntimeError, EOFError, ValueError, MemoryError) as err:
        raise DecompressionError(str(err) or "not enough memory") from err
    if len(out) != size and not partial:
        raise DecompressionError(f"{len(out)} bytes instead of {size}")
    return out


def _lz4(data: bytes | memoryview, size: int, _: bool) -> bytes:
    import lz4.frame

    decoder = lz4.frame.LZ4FrameDecompressor()
    return bytes(decoder.decompress(data, max_length=size + 1))


def _bz2(data: bytes | memoryview, size: int, _: bool) -> bytes:
    return bz2.BZ2Decompressor().decompress(data, max_length=size + 1)


def _zstd(data: bytes | memoryview, size: int, partial: bool) -> bytes:
    import zstandard

    decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES)
    try:
        if not partial and zstandard.frame_content_size(data) == size:
            return decompressor.decompress(data)
        with decompressor.stream_reader(data) as reader:
            return bytes(reader.read(size + 1))
    except zstandard.ZstdError as err:
        raise DecompressionError(str(err)) from err


_DECODERS = {"lz4": _lz4, "zstd": _zstd, "bz2": _bz2}


def unpack_messages(
    blocks: Iterator[Block], wanted: frozenset[int], compression: str, report: Callable[[str], None]
) -> Iterator[Block]:
    """Decompress the wanted messages of a bag that was written with message compression.

    Parameters
    ----------
    compression : ``zstd``, or the name in metadata.yaml of a compression that is not supported
    report : called once, after the last block, with how many messages could not be decompressed, and why
    """
    left_out, reason = 0, ""
    inflation = Inflation()
    for block in blocks:
        rows: list[int] = []
        messages: list[bytes] = []
        held = 0
        for row in np.flatnonzero(np.isin(block.channel, list(wanted))).tolist():
            try:
                message = _unpack(block.data[block.start[row] : block.end[row]].tobytes(), compression, inflation)
            except DecompressionError as err:
                left_out, reason = left_out + 1, reason or str(err.args[0])
                continue
            rows.append(row)
            messages.append(message)
            held += len(message)
            if held > _BLOCK_BYTES:
                yield _repacked(block, rows, messages)
                rows, messages, held = [], [], 0
        yield _repacked(block, rows, messages)
    if left_out:
        report(f"{left_out} compressed messages left out: {reason}")


def _repacked(block: Block, rows: list[int], messages: list[bytes]) -> Block:
    """Return the given rows of a block, with `messages` as their contents."""
    end = np.cumsum(np.fromiter(map(len, messages), np.int64, len(messages)))
    start = np.concatenate([[0], end])[:-1].astype(np.int64)
    data = np.frombuffer(b"".join(messages), np.uint8)
    return Block(data, block.channel[rows], block.log_time_ns[rows], start, end)


def _unpack(data: bytes, compression: str, inflation: Inflation) -> bytes:
    """Decompress one message."""
    import zstandard

    if compression != "zstd":
        raise DecompressionError(f"compression {compression!r} is not known")
    inflation.check()
    try:
        size = zstandard.frame_content_size(data)
        if size > LARGEST_CHUNK_BYTES:
            raise DecompressionError(f"one claims {size} bytes")
        out = zstandard.ZstdDecompressor().decompress(data, max_output_size=_UNKNOWN_SIZE_BYTES if size < 0 else 0)
    except (zstandard.ZstdError, MemoryError) as err:
        raise DecompressionError(str(err)) from err
    inflation.add(len(data), len(out))
    return out
