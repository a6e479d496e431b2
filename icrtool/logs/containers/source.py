"""Files on disk, in object stores and on web servers, which are read by ranges or fetched to disk.

`icrtool.logs.containers.connection` opens the connections, only for addresses that the user or a manifest names.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Lock, local
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET

from icrtool.errors import LogError
from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.connection import (
    LARGEST_LISTING_BYTES,
    SLOWEST_BPS,
    ask_server,
    check_pace,
    filesystem,
    in_time,
)
from icrtool.logs.containers.container import work_ahead
from icrtool.logs.containers.recording_files import LOG_SUFFIXES, natural_order, unpacked_name
from icrtool.records.input_limits import most_bytes, server_timeout_s
from icrtool.records.places import LARGEST_DOCUMENT_BYTES, UrlPath, place_of, without_secrets
from icrtool.records.samples import InputFile
from icrtool.records.text import LONGEST_NAME

NEAR_BYTES = 1 << 15
"""Longest gap between two ranges of a distant file that are read by one request [bytes]. A request takes as long as the
transfer of about 100 kB."""

_LEAST_BYTES = 1 << 18
"""Smallest number of bytes of a distant file that are read at once. The records of an index follow one another."""

_FETCHED_BYTES, PIECES_AHEAD = 1 << 24, 4
"""Size of the pieces in which a file is fetched [bytes], and number of pieces that are requested at a time."""

_START_BYTES = 512
"""Number of first bytes of a file that show its format."""


class _NoRangeError(ValueError):
    """A server does not send the requested range."""


def _check_range(answer: Any, begin: int, end: int, size: int) -> None:  # noqa: ANN401 - of a library
    """Refuse an answer that is not the range [begin, end) of a file, before its body is read.

    Raises
    ------
    _NoRangeError
        The answer is not the range.
    """
    stated, encoding = answer.headers.get("Content-Range", ""), answer.headers.get("Content-Encoding", "identity")
    if answer.status != 206:
        raise _NoRangeError(f"its server answers a range with {answer.status}, not 206")
    if encoding.lower() not in ("identity", ""):
        raise _NoRangeError(f"its server sends a range with the encoding {encoding[:LONGEST_NAME]!r}")
    if stated.replace(" ", "") not in (f"bytes{begin}-{end - 1}/{size}", f"bytes{begin}-{end - 1}/*"):
        raise _NoRangeError(f"its server sends {stated[:LONGEST_NAME]!r} for bytes {begin}-{end - 1}/{size}")


class HeldBytes(NamedTuple):
    """A range of bytes of a file in memory; `at` is the offset of its first byte in the file."""

    at: int
    data: bytes

    def has(self, at: int, end: int) -> bool:
        """Return whether the bytes contain the range [at, end) of the file."""
        return self.at <= at and end <= self.at + len(self.data)


class _ThreadBytes(local):
    """The range of bytes that each thread read last."""

    held = HeldBytes(0, b"")


class LocalFile:
    """A file on disk that several threads may read."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb")
        self.close = self._stream.close
        self._lock = Lock()
        self.size = path.stat().st_size

    def read_at(self, at: int, count: int) -> bytes:
        """Return `count` bytes of the file from `at` on; fewer at its end."""
        with self._lock:
            self._stream.seek(min(at, self.size))
            return self._stream.read(count)

    def read_into(self, at: int, space: Bytes) -> int:
        """Write bytes of the file from `at` on into memory (n,), and return their number, fewer than n at its end."""
        with self._lock:
            self._stream.seek(min(at, self.size))
            return self._stream.readinto(space.data)


class RemoteFile:
    """A file or folder at an address.

    A request takes as long as the transfer of about 100 kB. Therefore requests are few, and are sent ahead.

    Parameters
    ----------
    about : information of the store about the file; None: it is requested

    Raises
    ------
    LogError
        The file does not exist, access is refused, or the library for the address is missing.
    """

    def __init__(self, path: UrlPath, about: dict[str, Any] | None = None) -> None:
        self.path = path
        self._files, self._name = filesystem(path)
        about = _about(path) if about is None else about
        self.is_folder = about.get("type") == "directory"
        self.size = int(about.get("size") or 0)
        self.has_ranges = not self.is_folder and self.size > 0 and about.get("partial") is not False
        if self.has_ranges and path.scheme.startswith("http"):
            self.has_ranges = ask_server(path, self._has_last_byte)
        self.version = version_of(about)
        """Version of the content by `version_of`."""
        self.input = InputFile(str(path), self.size, None, **self.version, address=path.digest)
        """The file in run.json if it is read by ranges, without SHA-256."""
        self.bytes_read = 0
        self._ends: tuple[HeldBytes, ...] = ()
        self._last = _ThreadBytes()

    def _has_last_byte(self) -> bool:
        """Return whether the server sends the last byte when this range is requested."""
        try:
            return len(self._web_ranges([self.size - 1], [self.size])[0]) == 1
        except _NoRangeError:
            return False

    def _web_ranges(self, begins: list[int], ends: list[int]) -> list[bytes]:
        """Return ranges of a file on a web server; of a longer answer only the length of the range is read.

        Raises
        ------
        _NoRangeError
            An answer is not the requested range.
        """
        import asyncio

        from fsspec.asyn import sync

        async def read_range(begin: int, end: int) -> bytes:
            session = await self._files.set_session()
            headers = {"Range": f"bytes={begin}-{end - 1}", "Accept-Encoding": "identity"}
            began_s, quiet_s = time.monotonic(), server_timeout_s()
            async with (
                asyncio.timeout(quiet_s + (end - begin) / SLOWEST_BPS),
                session.get(self._files.encode_url(self._name), headers=headers) as answer,
            ):
                if answer.status >= 400:
                    answer.raise_for_status()
                _check_range(answer, begin, end, self.size)
                pieces, missing = [], end - begin
                while missing and (piece := await answer.content.read(missing)):
                    pieces.append(piece)
                    missing -= len(piece)
                    check_pace(began_s, end - begin - missing, quiet_s)
                return b"".join(pieces)

        async def read_all() -> list[bytes]:
            return list(await asyncio.gather(*map(read_range, begins, ends)))

        pieces: list[bytes] = sync(self._files.loop, read_all)
        return pieces

    def read_at(self, at: int, count: int) -> bytes:
        """Return `count` bytes of the file from `at` on; fewer at its end."""
        end = min(at + count, self.size)
        if not self._ends:
            # Readers of an index read the start and the end of the file first.
            begins = sorted({0, max(self.size - _LEAST_BYTES, 0)})
            self._ends = tuple(map(HeldBytes, begins, self._ranges(begins, [begin + _LEAST_BYTES for begin in begins])))
        held = next((held_bytes for held_bytes in (*self._ends, self._last.held) if held_bytes.has(at, end)), None)
        if held is None:
            # Readers go backwards from the footer at the end of the file, so that the bytes before are read, too.
            first = max(min(at, self.size - _LEAST_BYTES), 0)
            held = self.hold(first, max(end - first, _LEAST_BYTES))
        return held.data[at - held.at : end - held.at]

    def hold(self, at: int, count: int) -> HeldBytes:
        """Return a range of bytes, and keep it: this thread may read it by `read_at` without another request."""
        if not self._last.held.has(at, min(at + count, self.size)):
            self._last.held = HeldBytes(at, self._range(at, count))
        return self._last.held

    def gather(self, at: int, ranges: Ints) -> bytes:
        """Return the bytes of several ranges (2, n), joined; the ranges count from offset `at` of the file."""
        is_far = np.append(True, ranges[0, 1:] - ranges[1, :-1] > NEAR_BYTES)
        begins, ends = at + ranges[0, is_far], at + ranges[1, np.append(is_far[1:], True)]
        pieces = self._ranges(begins.tolist(), ends.tolist())
        part = np.cumsum(is_far) - 1
        offsets = (at + ranges - begins[part]).T.tolist()
        return b"".join(pieces[row][first:last] for row, (first, last) in zip(part.tolist(), offsets, strict=True))

    def _range(self, at: int, count: int) -> bytes:
        return self._ranges([at], [at + count])[0] if at < self.size and count else b""

    def _ranges(self, begins: list[int], ends: list[int]) -> list[bytes]:
        """Return the bytes of several ranges, which are requested at the same time, each by its own request.

        Raises
        ------
        LogError
            The connection breaks, or the file is shorter than a range.
        """
        ends = [min(end, self.size) for end in ends]

        def ask() -> list[bytes]:
            if self.path.scheme.startswith("http"):
                return self._web_ranges(begins, ends)
            expected = sum(ends) - sum(begins)
            names = [self._name] * len(begins)
            pieces = in_time(self._files, "cat_ranges", names, begins, ends, expected_bytes=expected)
            if (broken := next((piece for piece in pieces if isinstance(piece, BaseException)), None)) is not None:
                raise broken
            return list(map(bytes, pieces))

        pieces = ask_server(self.path, ask)
        for piece, begin, end in zip(pieces, begins, ends, strict=True):
            if len(piece) != end - begin:
                why = f"its server sent {len(piece)} of {end - begin} requested bytes"
                raise LogError(self.path, why, "if it is being written, read it when it is complete")
        self.bytes_read += sum(map(len, pieces))
        return pieces

    def start(self) -> bytes:
        """Return the first 512 bytes of the file, or all bytes of a shorter file, without a request for a range."""
        start = b""
        for piece in self._yield_pieces():
            start += piece[: _START_BYTES - len(start)]
            if len(start) == _START_BYTES:
                break
        return start

    def fetch(self, target: Path, share: Callable[[float], None] | None) -> InputFile:
        """Write the file to a path on disk, and return the file as run.json states it, with SHA-256.

        Parameters
        ----------
        target : path of the file on disk
        share : called with the share of the file that was fetched, 0 to 1

        Raises
        ------
        LogError
            The file cannot be read to its end, or is longer than `SavedBytes` allows.
        OSError
            The disk is full.
        """
        digest, written, saved = hashlib.sha256(), 0, SavedBytes.into(target.parent)
        saved.check(self.path, self.size)
        with target.open("wb") as sink:
            for piece in self._yield_pieces():
                saved.check(self.path, written + len(piece))
                if self.size and written + len(piece) > self.size:
                    raise LogError(self.path, f"sends more than the {self.size:,} bytes that its server states")
                sink.write(piece)
                digest.update(piece)
                written += len(piece)
                if share is not None:
                    share(min(written / max(self.size, 1), 1.0))
        return replace(self.input, bytes=written, sha256=digest.hexdigest())

    def _yield_pieces(self) -> Iterator[bytes]:
        """Yield the content of the file in pieces; threads request the next pieces."""
        if not self.has_ranges:
            options = {"headers": {"Accept-Encoding": "identity"}} if self.path.scheme.startswith("http") else {}
            began_s, quiet_s, received = time.monotonic(), server_timeout_s(), 0
            with ask_server(self.path, lambda: self._files.open(self._name, block_size=0, **options)) as stream:
                while piece := ask_server(self.path, lambda: stream.read(_FETCHED_BYTES), again=False):
                    received += len(piece)
                    ask_server(self.path, partial(check_pace, began_s, received, quiet_s), again=False)
                    yield piece
            return
        offsets = range(0, self.size, _FETCHED_BYTES)
        for _, piece in work_ahead(lambda at: self._range(at, _FETCHED_BYTES), offsets, PIECES_AHEAD, PIECES_AHEAD):
            yield piece()

    def close(self) -> None:
        """Drop the bytes that are kept for `read_at`."""
        self._last = _ThreadBytes()


class SavedBytes(NamedTuple):
    """Limit on the size of an input that is saved in the temporary folder.

    Attributes
    ----------
    most : the limit [bytes]
    why : where the limit comes from, for messages
    """

    most: int
    why: str

    @classmethod
    def into(cls, folder: Path) -> SavedBytes:
        """Return the limit for a folder: `most_bytes`, else half of the free space of its disk."""
        limit = most_bytes()
        if limit is not None:
            return cls(limit, "--most-bytes")
        return cls(shutil.disk_usage(folder).free // 2, "half of the free space in the temporary folder")

    def check(self, path: Path, count: int) -> None:
        """Refuse an input of `count` bytes if it is longer than the limit.

        Raises
        ------
        LogError
            The input is longer than the limit.
        """
        if count > self.most:
            why = f"sends more than {self.most:,} bytes ({self.why})"
            raise LogError(path, why, "--most-bytes N sets the limit; TMPDIR names another temporary folder")


def read_by_ranges(files: Collection[RemoteFile]) -> str:
    """Return a text about the amount of data that was read from some files."""
    # Ranges may overlap: the number of bytes read may be larger than a small file.
    read, size = sum(min(file.bytes_read, file.size) for file in files), sum(file.size for file in files)
    return f"{read / 1e6:.3g} of {size / 1e6:.3g} MB read by ranges"


def version_of(about: dict[str, Any]) -> dict[str, str]:
    """Return the version of a file's content that a store states: ``version``, else ``etag``; empty without both."""
    for key, names in (("version", ("VersionId", "generation")), ("etag", ("ETag", "etag", "Last-Modified"))):
        version = next((str(about[name]) for name in names if about.get(name)), "null")
        if version != "null":
            return {key: version.strip('"')}
    return {}


def _about(path: UrlPath) -> dict[str, Any]:
    """Return the current information of a store about a file, not taken from a cache."""
    files, name = filesystem(path)
    files.invalidate_cache(name)
    about: dict[str, Any] = ask_server(path, lambda: in_time(files, "info", name))
    return about


def _files_in_folder(path: UrlPath) -> list[tuple[UrlPath, dict[str, Any]]]:
    """Return the addresses of the files in a folder with the current information of the store about each."""
    files, name = filesystem(path)
    files.invalidate_cache(name)
    entries: list[dict[str, Any]] = ask_server(path, lambda: files.ls(name, detail=True))
    return [(_address(files, entry["name"], path), entry) for entry in entries]


def _address(files: Any, name: str, asked_for: UrlPath) -> UrlPath:  # noqa: ANN401 - a file system of fsspec
    """Return the address of a file that a store listed, with the query of `asked_for` for a web server."""
    url = files.unstrip_protocol(name)
    query = asked_for.url.partition("?")[2] if asked_for.scheme.startswith("http") else ""
    place = place_of(f"{url}?{query}" if query and "?" not in url else url)
    if not isinstance(place, UrlPath):
        raise LogError(asked_for, "is no address", str(place))
    return place


def changed_since(path: UrlPath, inputs: Iterable[InputFile]) -> bool:
    """Return whether the files at an address changed after they were opened.

    Parameters
    ----------
    inputs : the files with size and version when they were opened
    """
    about = _about(path)
    is_folder = about.get("type") == "directory"
    now = {str(address): stated for address, stated in (_files_in_folder(path) if is_folder else [(path, about)])}
    for file in inputs:
        stated = now.get(file.path, {})
        version = {key: value for key in ("version", "etag") if (value := getattr(file, key)) is not UNSET}
        if stated.get("size") not in {file.bytes, None} or version_of(stated) != version:
            return True
    return False


def find_logs_at(path: UrlPath) -> list[UrlPath]:
    """Return the addresses of the logs that an address names: one log, the matches of a pattern, or logs in a folder.

    Raises
    ------
    LogError
        There is no log, or the logs cannot be listed.
    """
    url = without_secrets(path.url) if path.scheme.startswith("http") else path.url
    wild = r"[*\[]" if path.scheme.startswith("http") else r"[*?\[]"
    if not re.search(wild, url) or (not re.search(wild.replace("\\[", ""), url) and _exists(path)):
        logs = _recordings_below(path) if RemoteFile(path).is_folder else [path]
        if not logs:
            suffixes = ", ".join(sorted(LOG_SUFFIXES))
            raise LogError(path, "no recording in it", f"a log has one of the suffixes {suffixes}")
        return logs
    files, name = filesystem(path)
    # A server may list folders within folders without an end; the limit on time ends the search.
    most = LARGEST_LISTING_BYTES if path.scheme.startswith("http") else LARGEST_DOCUMENT_BYTES
    matched: dict[str, Any] = ask_server(path, lambda: in_time(files, "glob", name, detail=True, expected_bytes=most))
    logs = []
    for inner, about in matched.items():
        address = _address(files, inner, path)
        logs += _recordings_below(address) if about.get("type") == "directory" else [address]
    if not logs:
        raise LogError(path, "no file or folder matches this pattern", "put the pattern in quotes, and check it")
    return sorted(set(logs), key=natural_order)


def _exists(path: UrlPath) -> bool:
    """Return whether a file with exactly this name exists; a name may contain brackets."""
    files, name = filesystem(path)
    return bool(ask_server(path, lambda: in_time(files, "exists", name)))


def _recordings_below(folder: UrlPath) -> list[UrlPath]:
    """Return the recordings in a folder and its subfolders: bag directories, and files outside of bag directories.

    For a folder that is a run, the folder itself is returned.
    """
    files, name = filesystem(folder)
    names: list[str] = ask_server(folder, lambda: files.find(name))
    if f"{name.rstrip('/')}/run.json" in names:
        return [folder]
    bags = {file.rpartition("/")[0] for file in names if file.endswith("/metadata.yaml")}
    logs = {file for file in names if Path(unpacked_name(file.rpartition("/")[2])).suffix in LOG_SUFFIXES}
    recordings = {parent if (parent := file.rpartition("/")[0]) in bags else file for file in logs}
    return sorted((_address(files, recording, folder) for recording in recordings), key=natural_order)


def fetch_folder(
    path: UrlPath, folder: Path, share: Callable[[float], None] | None
) -> tuple[tuple[InputFile, ...], dict[str, RemoteFile]]:
    """Write the files of a bag directory at an address to a folder on disk, except MCAP files that are read by ranges.

    Parameters
    ----------
    path : address of the folder
    folder : the folder on disk
    share : called with the share of the files that was fetched, 0 to 1

    Returns
    -------
    inputs : the storage files as run.json states them
    distant : the MCAP files that are read by ranges, by their names; they are empty on disk

    Raises
    ------
    LogError
        A file cannot be read, or the folder holds no recording.
    """
    bag = [entry for entry in _files_in_folder(path) if re.search(r"\.(mcap|db3|bag)\b|metadata\.yaml$", entry[0].name)]
    if not bag:
        raise LogError(path, "no recording in it", "name a log in it")
    inputs: list[InputFile] = []
    distant: dict[str, RemoteFile] = {}
    for number, (address, about) in enumerate(bag):
        part = (lambda done, before=number: share((before + done) / len(bag))) if share is not None else None
        remote, file = RemoteFile(address, about), folder / address.name
        if file.suffix == ".mcap" and remote.has_ranges:
            file.touch()
            distant[file.name] = remote
            inputs.append(remote.input)
        else:
            inputs.append(remote.fetch(file, part))
    return tuple(file for file in inputs if not file.path.endswith("metadata.yaml")), distant
