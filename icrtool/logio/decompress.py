"""Decompression with a ceiling: what a chunk claims to hold is checked before memory is asked for."""

from __future__ import annotations

import bz2

LARGEST_CHUNK_BYTES = 1 << 29
"""Half a gibibyte. Recorders write chunks of 0.75 to some 10 MiB; a chunk that claims more than this is damaged."""


class DecompressionError(Exception):
    """A chunk that does not decompress; `args[0]` says why."""


def decompress(data: bytes | memoryview, compression: str, size: int, *, partial: bool = False) -> bytes:
    """Decompress a chunk.

    Parameters
    ----------
    compression : ``""``/``none``, ``lz4``, ``zstd`` or ``bz2``
    size : the size the log says it has, in bytes
    partial : the data is cut off; return what can be had of it

    Raises
    ------
    DecompressionError
        Damaged data, another size than announced, or a compression that is not known.
    """
    if size > LARGEST_CHUNK_BYTES:
        raise DecompressionError(f"it claims {size} bytes")
    if compression in ("", "none"):
        return bytes(data)
    try:
        out = _DECODERS[compression](data, size)
    except KeyError:
        raise DecompressionError(f"compression {compression!r} is not known") from None
    except (OSError, RuntimeError, EOFError, ValueError) as err:
        raise DecompressionError(str(err)) from err
    if len(out) != size and not partial:
        raise DecompressionError(f"{len(out)} bytes instead of {size}")
    return out


def _lz4(data: bytes | memoryview, size: int) -> bytes:
    import lz4.frame

    decoder = lz4.frame.LZ4FrameDecompressor()
    return bytes(decoder.decompress(data, max_length=size + 1))


def _bz2(data: bytes | memoryview, size: int) -> bytes:
    return bz2.BZ2Decompressor().decompress(data, max_length=size + 1)


def _zstd(data: bytes | memoryview, size: int) -> bytes:
    import zstandard

    try:
        with zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES).stream_reader(data) as reader:
            return bytes(reader.read(size + 1))
    except zstandard.ZstdError as err:
        raise DecompressionError(str(err)) from err


_DECODERS = {"lz4": _lz4, "zstd": _zstd, "bz2": _bz2}


def decompress_message(data: bytes, compression: str) -> bytes:
    """Decompress one message of a bag written with message compression.

    Raises
    ------
    DecompressionError
    """
    import zstandard

    if compression != "zstd":
        raise DecompressionError(f"compression {compression!r} is not known")
    try:
        size = zstandard.frame_content_size(data)
        if size > LARGEST_CHUNK_BYTES:
            raise DecompressionError(f"it claims {size} bytes")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 0) or 1 << 24)
    except zstandard.ZstdError as err:
        raise DecompressionError(str(err)) from err
