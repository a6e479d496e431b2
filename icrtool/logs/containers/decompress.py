"""Decompression: of chunks, whose stated size is checked before memory is allocated, and of streams, piece by piece."""

from __future__ import annotations

import bz2
import lzma
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import cache, partial
from gzip import GzipFile
from typing import Any, NamedTuple, Protocol

import numpy as np

from icrtool.kernels.arrays import Bytes
from icrtool.logs.containers.channel import Block

LARGEST_CHUNK_BYTES = FREE_BYTES = 1 << 27
"""An eighth of a gibibyte. Recorders write chunks of 0.75 to some 10 MiB; four are in memory at a time."""

LARGEST_RATIO = 100
"""A log may take this many times its size when decompressed, and `FREE_BYTES` more.

Recorded chunks shrink by a factor of 2 to 20, images of one colour by more.
"""

STORED = ("", "none")
"""What logs call no compression."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_PIECE_BYTES = 1 << 24
"""Decompressed at once: libraries hold twice as much while they do. Of a message that states no size: at most."""


_INPUT_BYTES = 1 << 20
"""That a decoder of a stream is given at once."""

_BEHIND = b"icrtool: behind the last frame"


class DecompressionError(Exception):
    """A chunk that cannot be decompressed; `args[0]` is the reason."""


class Space:
    """Memory that is used again and again: fresh memory of the system costs as much as reading a file into it."""

    def __init__(self) -> None:
        self._bytes: Bytes = np.empty(0, np.uint8)

    def of(self, size: int) -> Bytes:
        """Return `size` bytes (size,), the same ones as before where there are as many."""
        if len(self._bytes) < size:
            self._bytes = np.empty(size, np.uint8)
        return self._bytes[:size]


class Packed(NamedTuple):
    """What is compressed in a chunk.

    Attributes
    ----------
    compression : ``""``/``none``, ``lz4``, ``zstd`` or ``bz2``
    size : decompressed size stated in the log [bytes]
    partial : the data is cut off, or `size` is only a part of it: what can be decompressed is wanted
    checksum : CRC-32 of the decompressed bytes, 0 where that is not checked
    """

    data: Bytes
    compression: str
    size: int
    partial: bool = False
    checksum: int = 0

    @property
    def claimed(self) -> int:
        """The bytes that it takes when decompressed, as stated."""
        return len(self.data) if self.compression in STORED else self.size


def decompress(packed: Packed, space: Bytes) -> Bytes:
    """Decompress a chunk.

    Parameters
    ----------
    space : for what is decompressed; one byte more than that

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
                out = _zstd(data, space[:size] if partial else space[: size + 1])
            case "lz4":
                import lz4.frame

                out = _in_pieces(lz4.frame.LZ4FrameDecompressor(), data, size)
            case "bz2":
                out = _in_pieces(bz2.BZ2Decompressor(), data, size)
            case _:
                raise DecompressionError(f"compression {compression!r} is not known")
    except (OSError, RuntimeError, EOFError, ValueError, MemoryError) as err:
        raise DecompressionError(str(err) or "not enough memory") from err
    if len(out) != packed.claimed and not partial:
        raise DecompressionError(f"{len(out)} bytes instead of {size}")
    if checksum and zlib.crc32(out.data) != checksum:
        raise DecompressionError("its checksum is wrong")
    return out


class Inflation:
    """Limits what the chunks of a log are decompressed to, to a multiple of their size in the file.

    Attributes
    ----------
    left : bytes that the next ones may take in addition
    """

    def __init__(self, left: int = FREE_BYTES) -> None:
        self.left = left

    def count(self, packed: int, unpacked: int) -> None:
        """Count what is decompressed [bytes].

        Raises
        ------
        DecompressionError
            It is more than one chunk, or the log, may take.
        """
        if unpacked > LARGEST_CHUNK_BYTES:
            raise DecompressionError(f"it claims {unpacked} bytes")
        left = self.left + LARGEST_RATIO * packed - unpacked
        if left < 0:
            raise DecompressionError(
                f"it inflates from {packed} to {unpacked} bytes; {LARGEST_RATIO} times are allowed"
            )
        self.left = left


def _zstd(data: Bytes, space: Bytes) -> Bytes:
    import zstandard

    try:
        # Where the space holds all of a frame, zstd decompresses straight into it.
        with zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES).stream_reader(data.data) as reader:
            return space[: reader.readinto(space)]
    except zstandard.ZstdError as err:
        raise DecompressionError(str(err)) from err


def _in_pieces(decoder: Any, data: Bytes, size: int) -> Bytes:  # noqa: ANN401 - of two libraries
    """Decompress up to `size` bytes and one more, a piece at a time."""
    piece = decoder.decompress(data, max_length=min(size + 1, _PIECE_BYTES))
    if len(piece) < _PIECE_BYTES:
        return np.frombuffer(piece, np.uint8)
    out = bytearray(piece)
    while not decoder.eof and (piece := decoder.decompress(b"", max_length=min(size + 1 - len(out), _PIECE_BYTES))):
        out += piece
    return np.frombuffer(out, np.uint8)


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
            if held > _PIECE_BYTES:
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
    try:
        size = zstandard.frame_content_size(data)
        if size >= 0:
            inflation.count(len(data), size)
        out = zstandard.ZstdDecompressor().decompress(data, max_output_size=_PIECE_BYTES)
        if size < 0:
            inflation.count(len(data), len(out))
    except (zstandard.ZstdError, MemoryError) as err:
        raise DecompressionError(str(err)) from err
    return out


class Readable(Protocol):
    """What is read from start to end."""

    def read(self, count: int, /) -> bytes:
        """Return the next bytes, at most `count`; none at the end."""
        ...


class _Frames:
    """What a decoder of the standard library, or of lz4, makes of frames that follow one another."""

    def __init__(self, make: Callable[[], Any], source: Readable) -> None:
        self._make, self._source, self._decoder = make, source, make()

    def read(self, count: int, /) -> bytes:
        """Return the next bytes, at most `count`."""
        while True:
            data = b""
            if self._decoder.eof:
                if not (data := self._decoder.unused_data or self._source.read(_INPUT_BYTES)):
                    return b""
                self._decoder = self._make()
            elif self._decoder.needs_input and not (data := self._source.read(_INPUT_BYTES)):
                raise EOFError("no end mark")
            if out := self._decoder.decompress(data, max_length=count):
                return bytes(out)


class _Zstd:
    """What zstandard makes of frames that follow one another.

    Its reader does not show whether the last frame has ended: a frame of our own behind it comes out only then.
    """

    def __init__(self, source: Readable) -> None:
        import zstandard

        self._source, self._behind, self._held = source, zstandard.compress(_BEHIND), b""
        decoder = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES)
        self._decoded = decoder.stream_reader(_Reads(self._packed), read_across_frames=True)  # type: ignore[arg-type]  # reads alone are needed

    def _packed(self, count: int) -> bytes:
        if not (piece := self._source.read(count)):
            piece, self._behind = self._behind, b""
        return piece

    def read(self, count: int, /) -> bytes:
        """Return the next bytes, at most `count`."""
        while piece := self._decoded.read(count):
            together = self._held + piece
            ready, self._held = together[: -len(_BEHIND)], together[-len(_BEHIND) :]
            if ready:
                return ready
        if self._held != _BEHIND:
            raise EOFError("no end mark")
        return b""


class _Reads(NamedTuple):
    """What has a method `read`."""

    read: Callable[[int], bytes]


def _lz4(source: Readable) -> Readable:
    import lz4.frame

    return _Frames(lz4.frame.LZ4FrameDecompressor, source)


DECODERS: dict[bytes, Callable[[Readable], Readable]] = {
    ZSTD_MAGIC: _Zstd,
    b"\x1f\x8b": lambda source: GzipFile(fileobj=source, mode="rb"),  # type: ignore[call-overload]  # as above
    b"BZh": partial(_Frames, bz2.BZ2Decompressor),
    b"\x04\x22\x4d\x18": _lz4,
    b"\xfd7zXZ\0": partial(_Frames, partial(lzma.LZMADecompressor, memlimit=LARGEST_CHUNK_BYTES)),
}


@cache
def decoding_errors() -> tuple[type[Exception], ...]:
    """Return what decoders raise of data that is damaged or cut off."""
    import zstandard

    return (
        OSError, EOFError, RuntimeError, ValueError, NotImplementedError, zlib.error, lzma.LZMAError,
        zipfile.BadZipFile, zstandard.ZstdError,
    )  # fmt: skip
