"""Decompression with a limit: the size that a chunk states is checked before memory is allocated."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterator

import numpy as np

from icrtool.kernels.arrays import Bytes
from icrtool.logs.containers.channel import Block

LARGEST_CHUNK_BYTES = 1 << 28
"""A quarter of a gibibyte. Recorders write chunks of 0.75 to some 10 MiB; a chunk that states more is damaged."""

LARGEST_RATIO = 100
"""A log may take this many times its size when decompressed, and one chunk of the largest size more."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_BLOCK_BYTES = 1 << 24
_UNKNOWN_SIZE_BYTES = 1 << 24


class Space:
    """Memory that is used again and again: fresh memory of the system costs as much as reading a file into it."""

    def __init__(self) -> None:
        self._bytes: Bytes = np.empty(0, np.uint8)

    def of(self, size: int) -> Bytes:
        """Return `size` bytes (size,), the same ones as before as far as they reach."""
        if len(self._bytes) < size:
            self._bytes = np.empty(size, np.uint8)
        return self._bytes[:size]


class Inflation:
    """Counts the bytes decompressed from a log, and limits them to a multiple of their size in the file.

    Recorded chunks shrink by a factor of 2 to 20. A crafted chunk can grow by 1,000 times; a thousand such chunks would
    take minutes.
    """

    def __init__(self) -> None:
        self._left = LARGEST_CHUNK_BYTES
        self._space = Space()

    def decompress(self, data: memoryview, compression: str, size: int, *, partial: bool = False) -> Bytes:
        """Decompress a chunk.

        Parameters
        ----------
        compression : ``""``/``none``, ``lz4``, ``zstd`` or ``bz2``
        size : decompressed size stated in the log [bytes]
        partial : the data is cut off, or `size` is only a part of it; return what can be decompressed

        Returns
        -------
        uint8, valid until the next call.

        Raises
        ------
        DecompressionError
            Damaged data, a size other than `size`, or an unknown compression; or the chunks before this one inflated
            more than `LARGEST_RATIO` times and one chunk.
        """
        self.check()
        if compression in ("", "none"):
            size = len(data)
        if size > LARGEST_CHUNK_BYTES:
            raise DecompressionError(f"it claims {size} bytes")
        try:
            match compression:
                case "" | "none":
                    out = np.frombuffer(data, np.uint8)
                case "zstd":
                    out = self._zstd(data, size, partial=partial)
                case "lz4":
                    import lz4.frame

                    out = np.frombuffer(lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1), np.uint8)
                case "bz2":
                    out = np.frombuffer(bz2.BZ2Decompressor().decompress(data, size + 1), np.uint8)
                case _:
                    raise DecompressionError(f"compression {compression!r} is not known")
        except (OSError, RuntimeError, EOFError, ValueError, MemoryError) as err:
            raise DecompressionError(str(err) or "not enough memory") from err
        if len(out) != size and not partial:
            raise DecompressionError(f"{len(out)} bytes instead of {size}")
        self.add(len(data), len(out))
        out.flags.writeable = False  # as that of a database: the kernels are compiled once
        return out

    def _zstd(self, data: memoryview, size: int, *, partial: bool) -> Bytes:
        import zstandard

        out = self._space.of(size + 1)
        try:
            # Where the space holds all of a frame, zstd decompresses straight into it.
            with zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES).stream_reader(data) as reader:
                return out[: reader.readinto(out if not partial else out[:size])]
        except zstandard.ZstdError as err:
            raise DecompressionError(str(err)) from err

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
