"""Files that are read at any place: on disk, or in object stores and on web servers, by ranges or fetched whole.

`connection.py` opens the connections, and only for an address that the user, or his manifest, names.
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
"""Longest gap between two ranges of a distant file that is read with them [bytes]: a request takes the time of some 100
kB."""

_LEAST_BYTES = 1 << 18
"""Bytes of a distant file that are read at once, at least: the records of an index follow one another."""

_FETCHED_BYTES, PIECES_AHEAD = 1 << 24, 4

_START_BYTES = 512
"""Number of bytes that show what a file is."""


class _NoRangeError(ValueError):
    """A server does not give the range that it was asked for."""


def _check_range(answer: Any, begin: int, end: int, size: int) -> None:  # noqa: ANN401 - of a library
    """Refuse an answer that is not the range [begin, end) of a file, before anything of its body is read."""
    stated, encoding = answer.headers.get("Content-Range", ""), answer.headers.get("Content-Encoding", "identity")
    if answer.status != 206:
        raise _NoRangeError(f"its server answers a range with {answer.status}, not 206")
    if encoding.lower() not in ("identity", ""):
        raise _NoRangeError(f"its server sends a range with the encoding {encoding[:LONGEST_NAME]!r}")
    if stated.replace(" ", "") not in (f"bytes{begin}-{end - 1}/{size}", f"bytes{begin}-{end - 1}/*"):
        raise _NoRangeError(f"its server sends {stated[:LONGEST_NAME]!r} for bytes {begin}-{end - 1}/{size}")


class Held(NamedTuple):
    """Bytes of a file, beginning at a place."""

    at: int
    data: bytes

    def has(self, at: int, end: int) -> bool:
        """Return whether they hold a range of the file."""
        return self.at <= at and end <= self.at + len(self.data)


class _OfThread(local):
    """The bytes that a thread read last."""

    held = Held(0, b"")


class LocalFile:
    """A file on disk, read at any place by several threads."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb")
        self.close = self._stream.close
        self._lock = Lock()
        self.size = path.stat().st_size

    def read_at(self, at: int, count: int) -> bytes:
        """Return bytes of the file, as many as there are."""
        with self._lock:
            self._stream.seek(min(at, self.size))
            return self._stream.read(count)

    def read_into(self, at: int, space: Bytes) -> int:
        """Fill some space with bytes of the file, and return how many there are."""
        with self._lock:
            self._stream.seek(min(at, self.size))
            return self._stream.readinto(space.data)


class RemoteFile:
    """A file behind a connection. A request takes the time of some 100 kB: requests are few, and made ahead.

    Parameters
    ----------
    about : what its store states about it; None: the store is asked

    Raises
    ------
    LogError
        It is not there, must not be read, or is a folder; or the library for it is missing.
    """

    def __init__(self, path: UrlPath, about: dict[str, Any] | None = None) -> None:
        self.path = path
        self._files, self._name = filesystem(path)
        about = _about(path) if about is None else about
        self.is_folder = about.get("type") == "directory"
        self.size = int(about.get("size") or 0)
        self.has_ranges = not self.is_folder and self.size > 0 and about.get("partial") is not False
        if self.has_ranges and path.scheme.startswith("http"):
            self.has_ranges = ask_server(path, self._gives_last_byte)
        self.version = version_of(about)
        """What the store states about the content: ``version``, or else ``etag``; none where it states neither."""
        self.input = InputFile(str(path), self.size, None, **self.version, address=path.digest)
        """What run.json states about the file where not all of it is read: no SHA-256."""
        self.bytes_read = 0
        self._ends: tuple[Held, ...] = ()
        self._last = _OfThread()

    def _gives_last_byte(self) -> bool:
        try:
            return len(self._web_ranges([self.size - 1], [self.size])[0]) == 1
        except _NoRangeError:
            return False

    def _web_ranges(self, begins: list[int], ends: list[int]) -> list[bytes]:
        """Return ranges of a file on a web server, each read only up to its length.

        Raises
        ------
        _NoRangeError
            The server answers with anything else than the range that was asked for.
        """
        import asyncio

        from fsspec.asyn import sync

        async def one(begin: int, end: int) -> bytes:
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

        async def all_of_them() -> list[bytes]:
            return list(await asyncio.gather(*map(one, begins, ends)))

        pieces_of_all: list[bytes] = sync(self._files.loop, all_of_them)
        return pieces_of_all

    def read_at(self, at: int, count: int) -> bytes:
        """Return bytes of the file, as many as there are."""
        end = min(at + count, self.size)
        if not self._ends:
            # To read by an index begins with the start and the end of the file.
            begins = sorted({0, max(self.size - _LEAST_BYTES, 0)})
            self._ends = tuple(map(Held, begins, self._ranges(begins, [begin + _LEAST_BYTES for begin in begins])))
        held = next((one for one in (*self._ends, self._last.held) if one.has(at, end)), None)
        if held is None:
            # The end of a file is read from its footer backwards.
            first = max(min(at, self.size - _LEAST_BYTES), 0)
            held = self.hold(first, max(end - first, _LEAST_BYTES))
        return held.data[at - held.at : end - held.at]

    def hold(self, at: int, count: int) -> Held:
        """Return bytes that `read_at` gives to this thread without another request."""
        if not self._last.held.has(at, min(at + count, self.size)):
            self._last.held = Held(at, self._range(at, count))
        return self._last.held

    def gather(self, at: int, ranges: Ints) -> bytes:
        """Return what stands in several ranges (2, n) behind a place, one after the other."""
        far = np.append(True, ranges[0, 1:] - ranges[1, :-1] > NEAR_BYTES)
        begins, ends = at + ranges[0, far], at + ranges[1, np.append(far[1:], True)]
        pieces = self._ranges(begins.tolist(), ends.tolist())
        part = np.cumsum(far) - 1
        offsets = (at + ranges - begins[part]).T.tolist()
        return b"".join(pieces[one][first:last] for one, (first, last) in zip(part.tolist(), offsets, strict=True))

    def _range(self, at: int, count: int) -> bytes:
        return self._ranges([at], [at + count])[0] if at < self.size and count else b""

    def _ranges(self, begins: list[int], ends: list[int]) -> list[bytes]:
        """Return bytes of the file, each range by a request of its own, at the same time."""
        ends = [min(end, self.size) for end in ends]

        def ask() -> list[bytes]:
            if self.path.scheme.startswith("http"):
                return self._web_ranges(begins, ends)
            expected = sum(ends) - sum(begins)
            names = [self._name] * len(begins)
            pieces = in_time(self._files, "cat_ranges", names, begins, ends, expected_bytes=expected)
            if (broken := next((one for one in pieces if isinstance(one, BaseException)), None)) is not None:
                raise broken
            return list(map(bytes, pieces))

        pieces = ask_server(self.path, ask)
        for piece, begin, end in zip(pieces, begins, ends, strict=True):
            if len(piece) != end - begin:
                raise LogError(self.path, f"gave {len(piece)} bytes for {end - begin}", "is it being written?")
        self.bytes_read += sum(map(len, pieces))
        return pieces

    def start(self) -> bytes:
        """Return the first 512 bytes, without any range; fewer of a shorter file."""
        start = b""
        for piece in self._pieces():
            start += piece[: _START_BYTES - len(start)]
            if len(start) == _START_BYTES:
                break
        return start

    def fetch(self, place: Path, share: Callable[[float], None] | None) -> InputFile:
        """Write the file to a place on disk, and return what run.json states about it.

        Raises
        ------
        LogError
            It cannot be read to its end.
        OSError
            The disk is full.
        """
        digest, written, saved = hashlib.sha256(), 0, SavedBytes.into(place.parent)
        saved.check(self.path, self.size)
        with place.open("wb") as sink:
            for piece in self._pieces():
                saved.check(self.path, written + len(piece))
                if self.size and written + len(piece) > self.size:
                    raise LogError(self.path, f"sends more than the {self.size:,} bytes that its server states")
                sink.write(piece)
                digest.update(piece)
                written += len(piece)
                if share is not None:
                    share(min(written / max(self.size, 1), 1.0))
        return replace(self.input, bytes=written, sha256=digest.hexdigest())

    def _pieces(self) -> Iterator[bytes]:
        """Yield the content from start to end; the next pieces are read meanwhile."""
        if not self.has_ranges:
            options = {"headers": {"Accept-Encoding": "identity"}} if self.path.scheme.startswith("http") else {}
            began_s, quiet_s, received = time.monotonic(), server_timeout_s(), 0
            with ask_server(self.path, lambda: self._files.open(self._name, block_size=0, **options)) as stream:
                while piece := ask_server(self.path, lambda: stream.read(_FETCHED_BYTES), again=False):
                    received += len(piece)
                    ask_server(self.path, partial(check_pace, began_s, received, quiet_s), again=False)
                    yield piece
            return
        places = range(0, self.size, _FETCHED_BYTES)
        for _, piece in work_ahead(lambda at: self._range(at, _FETCHED_BYTES), places, PIECES_AHEAD, PIECES_AHEAD):
            yield piece()

    def close(self) -> None:
        """Forget what is held."""
        self._last = _OfThread()


class SavedBytes(NamedTuple):
    """How much of an input is saved in the temporary folder [bytes], and where this limit comes from."""

    most: int
    why: str

    @classmethod
    def into(cls, folder: Path) -> SavedBytes:
        """Return the limit for a folder: that of `most_bytes`, else half of the free space."""
        limit = most_bytes()
        if limit is not None:
            return cls(limit, "--most-bytes")
        return cls(shutil.disk_usage(folder).free // 2, "half of the free space in the temporary folder")

    def check(self, path: Path, count: int) -> None:
        """Refuse more bytes than are saved.

        Raises
        ------
        LogError
            There are more.
        """
        if count > self.most:
            why = f"sends more than {self.most:,} bytes ({self.why})"
            raise LogError(path, why, "--most-bytes N lets more be saved; TMPDIR names another temporary folder")


def read_by_ranges(files: Collection[RemoteFile]) -> str:
    """Return how much was read of some files."""
    # Ranges overlap a little: more bytes than a small file has may be read.
    read, size = sum(min(one.bytes_read, one.size) for one in files), sum(one.size for one in files)
    return f"{read / 1e6:.3g} of {size / 1e6:.3g} MB read by ranges"


def version_of(about: dict[str, Any]) -> dict[str, str]:
    """Return what a store states of the content of a file: its version, else its etag, else nothing."""
    for key, names in (("version", ("VersionId", "generation")), ("etag", ("ETag", "etag", "Last-Modified"))):
        version = next((str(about[name]) for name in names if about.get(name)), "null")
        if version != "null":
            return {key: version.strip('"')}
    return {}


def _about(path: UrlPath) -> dict[str, Any]:
    """Return what a store states about a file now, whatever it stated before."""
    files, name = filesystem(path)
    files.invalidate_cache(name)
    about: dict[str, Any] = ask_server(path, lambda: in_time(files, "info", name))
    return about


def _in_folder(path: UrlPath) -> list[tuple[UrlPath, dict[str, Any]]]:
    """Return the addresses of the files in a folder, and what a store states about them now."""
    files, name = filesystem(path)
    files.invalidate_cache(name)
    entries: list[dict[str, Any]] = ask_server(path, lambda: files.ls(name, detail=True))
    return [(_address(files, one["name"], path), one) for one in entries]


def _address(files: Any, name: str, asked_for: UrlPath) -> UrlPath:  # noqa: ANN401 - a file system of fsspec
    """Return the address of a found file, with the query of `asked_for` where a web server needs it."""
    url = files.unstrip_protocol(name)
    query = asked_for.url.partition("?")[2] if asked_for.scheme.startswith("http") else ""
    place = place_of(f"{url}?{query}" if query and "?" not in url else url)
    if not isinstance(place, UrlPath):
        raise LogError(asked_for, "is no address", str(place))
    return place


def changed_since(path: UrlPath, inputs: Iterable[InputFile]) -> bool:
    """Return whether the files at an address changed since they were opened.

    Parameters
    ----------
    inputs : the files as they were
    """
    about = _about(path)
    is_folder = about.get("type") == "directory"
    now = {str(one): stated for one, stated in (_in_folder(path) if is_folder else [(path, about)])}
    for one in inputs:
        stated = now.get(one.path, {})
        version = {key: value for key in ("version", "etag") if (value := getattr(one, key)) is not UNSET}
        if stated.get("size") not in {one.bytes, None} or version_of(stated) != version:
            return True
    return False


def find_logs_at(path: UrlPath) -> list[UrlPath]:
    """Return the logs that an address stands for: itself, what its pattern matches, or the recordings below a folder.

    Raises
    ------
    LogError
        There are none, or they cannot be listed.
    """
    address = without_secrets(path.url) if path.scheme.startswith("http") else path.url
    wild = r"[*\[]" if path.scheme.startswith("http") else r"[*?\[]"
    if not re.search(wild, address) or (not re.search(wild.replace("\\[", ""), address) and _is_there(path)):
        logs = _below(path) if RemoteFile(path).is_folder else [path]
        if not logs:
            suffixes = ", ".join(sorted(LOG_SUFFIXES))
            raise LogError(path, "no recording in it", f"a log has one of the suffixes {suffixes}")
        return logs
    files, name = filesystem(path)
    # folders in folders without an end are no reason to go on for ever
    most = LARGEST_LISTING_BYTES if path.scheme.startswith("http") else LARGEST_DOCUMENT_BYTES
    matched: dict[str, Any] = ask_server(path, lambda: in_time(files, "glob", name, detail=True, expected_bytes=most))
    logs = []
    for inner, about in matched.items():
        one = _address(files, inner, path)
        logs += _below(one) if about.get("type") == "directory" else [one]
    if not logs:
        raise LogError(path, "matches nothing")
    return sorted(set(logs), key=natural_order)


def _is_there(path: UrlPath) -> bool:
    """Return whether there is a file of this very name, which may have brackets."""
    files, name = filesystem(path)
    return bool(ask_server(path, lambda: in_time(files, "exists", name)))


def _below(folder: UrlPath) -> list[UrlPath]:
    """Return the recordings below a folder, by their names: bag directories, and files of no bag directory.

    A folder that is a run is itself.
    """
    files, name = filesystem(folder)
    names: list[str] = ask_server(folder, lambda: files.find(name))
    if f"{name.rstrip('/')}/run.json" in names:
        return [folder]
    bags = {one.rpartition("/")[0] for one in names if one.endswith("/metadata.yaml")}
    logs = {one for one in names if Path(unpacked_name(one.rpartition("/")[2])).suffix in LOG_SUFFIXES}
    recordings = {parent if (parent := one.rpartition("/")[0]) in bags else one for one in logs}
    return sorted((_address(files, one, folder) for one in recordings), key=natural_order)


def fetch_folder(
    path: UrlPath, place: Path, share: Callable[[float], None] | None
) -> tuple[tuple[InputFile, ...], dict[str, RemoteFile]]:
    """Write the storage files and metadata.yaml of a bag directory to a folder on disk, but MCAP files.

    Returns
    -------
    inputs : the storage files as run.json states them
    distant : the files that are read by ranges, by their names; they are empty on disk

    Raises
    ------
    LogError
        They cannot be read.
    """
    bag = [one for one in _in_folder(path) if re.search(r"\.(mcap|db3|bag)\b|metadata\.yaml$", one[0].name)]
    if not bag:
        raise LogError(path, "no recording in it", "name a log in it")
    inputs: list[InputFile] = []
    distant: dict[str, RemoteFile] = {}
    for number, (address, about) in enumerate(bag):
        part = (lambda done, before=number: share((before + done) / len(bag))) if share is not None else None
        remote, file = RemoteFile(address, about), place / address.name
        if file.suffix == ".mcap" and remote.has_ranges:
            file.touch()
            distant[file.name] = remote
            inputs.append(remote.input)
        else:
            inputs.append(remote.fetch(file, part))
    return tuple(one for one in inputs if not one.path.endswith("metadata.yaml")), distant
