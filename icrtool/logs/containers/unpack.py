"""Unpacking of compressed logs and archives to a temporary folder, piece by piece and with a limit on the size.

The first bytes of a file show its format. A log may be compressed (``drive.mcap.zst``), or be a file or a bag directory
in an archive; a file in an archive may be compressed, too.
"""

from __future__ import annotations

import bz2
import hashlib
import lzma
import math
import os
import platform
import re
import secrets
import shutil
import tempfile
import weakref
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from io import BufferedReader
from pathlib import Path, PurePosixPath
from tarfile import AREGTYPE, CONTTYPE, REGTYPE, SUPPORTED_TYPES, TarError, TarInfo
from types import SimpleNamespace
from typing import Any, Protocol

import lz4.frame
import zstandard

from icrtool.errors import LogError
from icrtool.logs.containers.chunk import LARGEST_CHUNK_BYTES, LARGEST_RATIO, ZSTD_MAGIC
from icrtool.logs.containers.recording_files import LOG_SUFFIXES, PACKED_SUFFIX, is_bag_directory, unpacked_name
from icrtool.records import process_resources
from icrtool.records.notes import Note, note
from icrtool.records.places import open_regular
from icrtool.records.text import LogText, listed

_PARTS_OF_LOGS = re.compile(rf"^(?!\.).*\.(?:mcap|bag|db3)(?:{PACKED_SUFFIX})?$|\.db3-wal$|^metadata\.yaml$")

_PIECE_BYTES = 1 << 20
"""Number of bytes that are unpacked at a time."""

_FRAME_PIECE_BYTES = 1 << 16
"""Number of bytes that a decoder of frames gets at a time. The bytes behind the end of a frame are copied for the next
frame."""

_MOST_FRAMES, _LEAST_FRAME_BYTES = 10_000, 100
"""Number of frames that every file may have, and size of the file for each further frame [bytes]. The frames of
parallel compressors have 64 kB and more."""

_DECODER_BYTES = LARGEST_CHUNK_BYTES
"""Largest size of the memory of a decoder [bytes]."""

_MOST_ENTRIES = 100_000
"""Largest number of entries of an archive that are read."""

_MOST_FOLDERS = 100
"""Largest number of folders with logs in an archive. A recording has one folder."""

_LARGEST_EXTRA_BYTES = 1 << 16
"""Largest size of a long name in a tar archive [bytes]."""

_LARGEST_READ_BYTES = 1 << 22
"""Largest piece that zipfile may read at once, such as the directory of an archive [bytes]."""

_ENCRYPTED = 1
"""Flag of an entry of a zip archive whose content is encrypted."""

_BEHIND = b"icrtool: behind the last frame"
"""Content of the frame that is put behind the last frame of a zstd file."""

_TAR_BLOCK_BYTES, _ZIP = 512, b"PK\x03\x04"
_SPARSE_MORE = 482
"""Offset of the byte, in the header of a sparse file of a tar archive, that states whether another block of the header
follows."""

_TAR = b"ustar"
"""Characters that mark a tar archive."""

_TAR_MARK = slice(257, 262)
"""Range of these characters in the first block of the archive."""


class Readable(Protocol):
    """A stream of bytes that is read from start to end."""

    def read(self, count: int, /) -> bytes:
        """Return the next bytes, at most `count`; empty at the end."""
        ...


class _Frames:
    """Stream of the decompressed bytes of successive frames, with a decoder of the standard library or of lz4."""

    def __init__(self, make: Callable[[], Any], source: Readable) -> None:
        self._make, self._source, self._decoder = make, source, make()
        self._frames, self._given = 1, 0

    def read(self, count: int, /) -> bytes:
        """Return the next bytes, at most `count`."""
        while True:
            data = b""
            if self._decoder.eof:
                if not (data := self._decoder.unused_data or self._next_piece()):
                    return b""
                self._frames += 1
                if self._frames > _MOST_FRAMES + self._given / _LEAST_FRAME_BYTES:
                    raise ValueError(f"{self._frames:,} frames of little content")
                self._decoder = self._make()
            elif self._decoder.needs_input and not (data := self._next_piece()):
                raise EOFError("no end mark")
            if out := self._decoder.decompress(data, max_length=count):
                return bytes(out)

    def _next_piece(self) -> bytes:
        piece = self._source.read(_FRAME_PIECE_BYTES)
        self._given += len(piece)
        return piece


class _Gzip:
    """Decoder of a member of a gzip file, with the attributes of the decoders of bz2 and lzma.

    `gzip.GzipFile` is not used because it reads the name in a header byte by byte.
    """

    def __init__(self) -> None:
        self._decoder = zlib.decompressobj(wbits=31)
        self._is_held = False

    @property
    def eof(self) -> bool:
        """Whether the member has ended."""
        return self._decoder.eof

    @property
    def unused_data(self) -> bytes:
        """The bytes behind the member, without the zeros that fill up a block."""
        return self._decoder.unused_data.lstrip(b"\0")

    @property
    def needs_input(self) -> bool:
        """Whether the decoder returns further bytes only after further input."""
        return not self._is_held

    def decompress(self, data: bytes, max_length: int) -> bytes:
        """Return decompressed bytes, at most `max_length`."""
        out = self._decoder.decompress(self._decoder.unconsumed_tail + data, max_length)
        self._is_held = bool(self._decoder.unconsumed_tail) or len(out) == max_length
        return out


class _Zstd:
    """Stream of the decompressed bytes of successive zstd frames.

    The reader of zstandard does not show whether the last frame is complete. Therefore a further frame is put behind
    it, whose content is decompressed only if the last frame is complete.
    """

    def __init__(self, source: Readable) -> None:
        self._source, self._behind, self._held = source, zstandard.compress(_BEHIND), b""
        decoder = zstandard.ZstdDecompressor(max_window_size=_DECODER_BYTES)
        self._decoded = decoder.stream_reader(SimpleNamespace(read=self._read_packed), read_across_frames=True)  # type: ignore[arg-type]  # reads alone are needed

    def _read_packed(self, count: int) -> bytes:
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


DECODERS: dict[bytes, Callable[[Readable], Readable]] = {
    ZSTD_MAGIC: _Zstd,
    b"\x1f\x8b": partial(_Frames, _Gzip),
    b"BZh": partial(_Frames, bz2.BZ2Decompressor),
    b"\x04\x22\x4d\x18": partial(_Frames, lz4.frame.LZ4FrameDecompressor),
    b"\xfd7zXZ\0": partial(_Frames, partial(lzma.LZMADecompressor, memlimit=_DECODER_BYTES)),
}

_DECODING_ERRORS = (
    OSError, EOFError, RuntimeError, ValueError, NotImplementedError, zlib.error, lzma.LZMAError,
    zipfile.BadZipFile, zstandard.ZstdError,
)  # fmt: skip
"""Errors of decoders if the data is damaged or cut off."""


def _scratch_prefix() -> str:
    """Return the start of the names of the temporary folders of icrtool on this host."""
    return f"icrtool-{re.sub(r'[^A-Za-z0-9.]', '_', platform.node())[:64]}-"


def _remove_abandoned(folder: Path) -> None:
    """Remove the temporary folders of this user and host that a killed process left."""
    own = _scratch_prefix()
    with suppress(OSError):
        for entry in list(os.scandir(folder)):
            number = entry.name.removeprefix(own).partition("-")[0] if entry.name.startswith(own) else ""
            if not number.isdecimal() or not entry.is_dir(follow_symlinks=False):
                continue
            is_ours = not hasattr(os, "geteuid") or entry.stat(follow_symlinks=False).st_uid == os.geteuid()
            if is_ours and not _is_running(int(number)):
                shutil.rmtree(entry.path, ignore_errors=True)


def _is_running(number: int) -> bool:
    """Return whether a process with this number exists; True where this is not known."""
    if os.name == "nt":
        return True
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


class ScratchFolder:
    """A temporary folder that is removed when it is closed, or when a signal ends the process."""

    def __init__(self) -> None:
        # Python finds the folder by writing a file, which a signal must not leave behind.
        with process_resources.undisturbed():
            folder = Path(tempfile.gettempdir())
        _remove_abandoned(folder)
        self.path = folder / f"{_scratch_prefix()}{os.getpid()}-{secrets.token_hex(8)}"
        # The folder is registered before it is made, because a signal may come at any time.
        process_resources.mark_unfinished(self.path)
        self.path.mkdir(mode=0o700)
        self._remove = weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)

    def close(self) -> None:
        """Remove the folder."""
        self._remove()
        process_resources.mark_finished(self.path)


def is_packed(start: bytes) -> bool:
    """Return whether a file is compressed or an archive, given its first 512 bytes."""
    return start.startswith((_ZIP, *DECODERS)) or start[_TAR_MARK] == _TAR


def save_unpacked(
    source: Readable, target: Path, check: Callable[[bytes], None], check_length: Callable[[int], None]
) -> str:
    """Write a stream to a file, and return its SHA-256 (hex).

    Parameters
    ----------
    source : the stream
    target : path of the file
    check : called with the first 512 bytes before more is read; it raises an error to refuse the stream
    check_length : called with the total number of bytes before they are written; it raises an error if it is too large

    Raises
    ------
    OSError
        The disk is full.
    """
    digest, written, start = hashlib.sha256(), 0, b""
    while len(start) < _TAR_BLOCK_BYTES and (piece := source.read(_TAR_BLOCK_BYTES - len(start))):
        start += piece
    check(start)
    with target.open("wb") as sink:
        piece = start
        while piece or (piece := source.read(_PIECE_BYTES)):
            written += len(piece)
            check_length(written)
            sink.write(piece)
            digest.update(piece)
            piece = b""
    return digest.hexdigest()


def unpack(path: Path, folder: Path, share: Callable[[float], None] | None = None) -> tuple[Path, Note | None]:
    """Return the path of the log in a compressed file or an archive, after unpacking it, and a finding about damage.

    Parameters
    ----------
    path : path of the file
    folder : folder for the unpacked files, which keep the names that they have in an archive
    share : called with the share of the file that was unpacked, 0 to 1

    Returns
    -------
    path of the file or bag directory; finding about the first problem, None without a problem

    Raises
    ------
    LogError
        The file cannot be decompressed, the disk is full, or the archive holds no log or several logs.
    """
    folder.mkdir(exist_ok=True)
    try:
        with open_regular(path) as file:
            size = path.stat().st_size
            budget = _Budget(LARGEST_CHUNK_BYTES + LARGEST_RATIO * size)
            watch = (lambda: share(file.tell() / max(size, 1))) if share is not None else None
            logs = _unpack_file(path, file, folder, budget, watch)
    except OSError as err:
        free = shutil.disk_usage(folder).free
        raise LogError(path, f"cannot be unpacked: {err.strerror}", f"{free} bytes are free for it") from err
    written = [file for file in folder.rglob("*") if file.is_file() and file.stat().st_size]
    if budget.trouble is None:
        return logs, None
    if not written:
        raise LogError(path, "does not decompress", budget.trouble.text)
    return logs, note(budget.trouble.code, f"{budget.trouble.text}; what could be unpacked was read")


@dataclass(slots=True)
class _Budget:
    """Limit on the size of the unpacked files.

    Attributes
    ----------
    left : number of bytes that may still be unpacked
    trouble : finding about the first problem; after it nothing more is unpacked
    """

    left: int
    trouble: Note | None = None

    def stop(self, code: str, trouble: object) -> None:
        """Store a problem, so that nothing more is unpacked; only the first problem is kept."""
        self.trouble = self.trouble or note(code, str(trouble))


class _Stream:
    """A stream that ends where its source is damaged, or at the limit of its budget.

    Parameters
    ----------
    size : length of the part of `source` that is read [bytes]; by default all
    """

    def __init__(self, source: Readable, budget: _Budget, size: float = math.inf) -> None:
        # `read1` returns the bytes before a damaged part; `read` would lose them.
        self._read: Callable[[int], bytes] = getattr(source, "read1", source.read)
        self._budget, self._left, self._head = budget, size, b""

    def read(self, count: int, /) -> bytes:
        """Return the next bytes, at most `count`."""
        if self._head:
            piece, self._head = self._head[:count], self._head[count:]
            return piece
        count = int(min(count, self._left))
        if self._budget.trouble or not count:
            return b""
        try:
            piece = self._read(count)
        except _DECODING_ERRORS as err:
            # An error number shows that the disk failed; the data is not the cause.
            if isinstance(err, OSError) and err.errno is not None:
                raise
            self._budget.stop("log_cut_off", f"cut off or damaged ({err})")
            return b""
        self._left -= len(piece)
        if not piece and self._left < math.inf:
            self._budget.stop("log_cut_off", "cut off")
        self._budget.left -= len(piece)
        if self._budget.left < 0:
            self._budget.stop("log_limit_reached", f"more than {LARGEST_RATIO} times its size when unpacked")
            return b""
        return piece

    def exactly(self, count: int) -> bytes:
        """Return the next `count` bytes; fewer at the end."""
        pieces = []
        while count and (piece := self.read(min(count, _PIECE_BYTES))):
            pieces.append(piece)
            count -= len(piece)
        return b"".join(pieces)

    def skip(self, count: float = math.inf) -> None:
        """Pass over the next `count` bytes, by default over all."""
        while count and (piece := self.read(int(min(count, _PIECE_BYTES)))):
            count -= len(piece)

    def start(self) -> bytes:
        """Return the next 512 bytes without consuming them."""
        self._head = self.exactly(_TAR_BLOCK_BYTES)
        return self._head

    def decompressed(self) -> _Stream:
        """Return the stream of the decompressed content; the stream itself if it is not compressed."""
        start = self.start()
        decoder_found = next((decoder for magic, decoder in DECODERS.items() if start.startswith(magic)), None)
        return self if decoder_found is None else _Stream(decoder_found(self), self._budget)

    def write_to(self, target: Path, watch: Callable[[], None] | None) -> None:
        """Write the rest of the stream to a file; call `watch` after each piece."""
        with target.open("wb") as sink:
            while piece := self.read(_PIECE_BYTES):
                sink.write(piece)
                if watch is not None:
                    watch()


def _unpack_file(
    path: Path, file: BufferedReader, folder: Path, budget: _Budget, watch: Callable[[], None] | None
) -> Path:
    """Unpack an open file, and return the path of the log: a file or a bag directory; raise as `unpack`."""
    packed = _Stream(file, budget)
    if not is_packed(start := packed.start()):
        raise LogError(path, "does not decompress", "its first bytes belong to no known compression")
    if start.startswith(_ZIP):
        entries = _zip_entries(file, budget)
    else:
        content = packed.decompressed()
        if content.start()[_TAR_MARK] != _TAR:
            whole = folder / (unpacked_name(path.name) or "log")
            content.write_to(whole, watch)
            return whole
        entries = _tar_entries(content, budget)
    groups: dict[PurePosixPath, Path] = {}
    others: list[str] = []
    logs: list[str] = []
    found: list[Path] = []
    for name, entry in entries:
        entry_path = PurePosixPath(name)
        if len(groups) > _MOST_FOLDERS:
            raise LogError(path, f"has logs in more than {_MOST_FOLDERS} folders", "unpack it, and name one of them")
        if not _PARTS_OF_LOGS.search(entry_path.name):
            others.append(name)
            continue
        group = groups.setdefault(
            entry_path.parent, folder / str(len(groups)) / (entry_path.parent.name.strip(".") or "log")
        )
        group.mkdir(parents=True, exist_ok=True)
        target = group / unpacked_name(entry_path.name)
        if target.suffix in LOG_SUFFIXES:
            logs.append(name)
            found.append(target)
        if not target.exists():
            entry.decompressed().write_to(target, watch)
    if not logs and not budget.trouble:
        raise LogError(path, "no log in it", f"it holds {listed(others) or 'nothing'}")
    if not found:
        return folder
    # A bag directory is one recording. A file that the archive holds twice is two recordings.
    bags = {group for group in groups.values() if is_bag_directory(group)}
    found = [*bags] + [file for file in found if file.parent not in bags]
    if len(found) > 1:
        raise LogError(path, f"holds more than one recording: {listed(logs)}", "unpack it, and name one of them")
    return found[0]


def _tar_entries(stream: _Stream, budget: _Budget) -> Iterator[tuple[str, _Stream]]:
    """Yield name and content of the files in a tar archive.

    Notes
    -----
    `tarfile.TarFile` is not used because it keeps all entries and reads names of any length, so that an archive could
    exhaust the memory.
    """
    name, stated_size = "", None
    for _ in range(_MOST_ENTRIES):
        head = stream.exactly(_TAR_BLOCK_BYTES)
        if not any(head):
            return
        try:
            info = TarInfo.frombuf(head, "utf-8", "surrogateescape")
        except TarError as err:
            return budget.stop("log_cut_off", f"cut off or damaged ({err})")
        if info.type in {b"L", b"x"}:
            # This entry holds a name or a size that does not fit into the header of the next entry.
            fields = _extra_fields(info.type, stream.exactly(min(info.size, _LARGEST_EXTRA_BYTES)))
            stream.skip(max(info.size - _LARGEST_EXTRA_BYTES, 0) + -info.size % _TAR_BLOCK_BYTES)
            name = fields.get(b"path", name.encode("utf-8", "surrogateescape")).decode("utf-8", "surrogateescape")
            size_field = fields.get(b"size", b"")
            stated_size = int(size_field) if re.fullmatch(rb"\d{1,18}", size_field) else stated_size
            continue
        if info.type == b"K":
            # This entry holds the target of a link. It does not change the name of the next entry.
            stream.skip(info.size + -info.size % _TAR_BLOCK_BYTES)
            continue
        size = info.size if stated_size is None else stated_size
        if info.type in {REGTYPE, AREGTYPE, CONTTYPE}:
            entry = _Stream(stream, budget, size)
            yield name or info.name, entry
            entry.skip()
            stream.skip(-size % _TAR_BLOCK_BYTES)
        elif info.type == b"S":
            if _PARTS_OF_LOGS.search(PurePosixPath(name or info.name).name):
                return budget.stop(
                    "log_damaged", f"{LogText(name or info.name)} is a sparse file; pack it without --sparse"
                )
            more = head[_SPARSE_MORE]
            while more and (block := stream.exactly(_TAR_BLOCK_BYTES)):
                more = block[504] if len(block) == _TAR_BLOCK_BYTES else 0
            stream.skip(size + -size % _TAR_BLOCK_BYTES)
        elif info.type not in SUPPORTED_TYPES or info.type == b"g":
            stream.skip(size + -size % _TAR_BLOCK_BYTES)
        name, stated_size = "", None
    return budget.stop("log_limit_reached", f"more than {_MOST_ENTRIES} entries")


def _extra_fields(kind: bytes, extra: bytes) -> dict[bytes, bytes]:
    """Return the fields of an extended header: ``path`` of a long name, or all fields of pax (``20 path=a.mcap``)."""
    if kind == b"L":
        return {b"path": extra.partition(b"\0")[0]}
    fields, at = {}, 0
    while match := re.compile(rb"(\d{1,6}) ([^=]*)=").match(extra, at):
        if (end := at + int(match[1])) <= match.end():
            break
        fields[match[2]] = extra[match.end() : end - 1].partition(b"\0")[0]
        at = end
    return fields


class _FrugalFile:
    """A file that refuses reads that are larger than a sound archive needs."""

    def __init__(self, file: BufferedReader) -> None:
        self._file = file
        self.tell, self.seekable, self.close = file.tell, file.seekable, file.close

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Move to an offset, and return it.

        Raises
        ------
        zipfile.BadZipFile
            The offset is negative.
        """
        if whence == os.SEEK_SET and offset < 0:
            raise zipfile.BadZipFile("its directory names an offset before the start of the file")
        return self._file.seek(offset, whence)

    def read(self, count: int = -1, /) -> bytes:
        """Return the next `count` bytes; fewer at the end.

        Raises
        ------
        zipfile.BadZipFile
            `count` is above the limit.
        """
        if count > _LARGEST_READ_BYTES:
            raise zipfile.BadZipFile("its directory is too large")
        return self._file.read(count if count >= 0 else _LARGEST_READ_BYTES)


def _zip_entries(file: BufferedReader, budget: _Budget) -> Iterator[tuple[str, _Stream]]:
    """Yield name and content of the files in a zip archive."""
    try:
        with zipfile.ZipFile(_FrugalFile(file)) as archive:
            for info in archive.infolist()[:_MOST_ENTRIES]:
                # An entry without a name is skipped first, because `is_dir` of Python 3.11 needs a last character.
                if not info.filename or info.is_dir():
                    continue
                if info.flag_bits & _ENCRYPTED:
                    budget.stop("log_part_unreadable", f"{LogText(info.filename)} is encrypted")
                    return
                if info.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2}:
                    budget.stop(
                        "log_part_unreadable", f"compression {info.compress_type} of {info.filename} is not known"
                    )
                with archive.open(info) as content:
                    yield info.filename, _Stream(content, budget)
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, ValueError) as err:
        budget.stop("log_damaged", err)
