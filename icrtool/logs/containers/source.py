"""Files that are read at any place: on disk, or in object stores and on web servers, by ranges or fetched whole."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Lock, local
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET

from icrtool.errors import LogError
from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.address import address_of, asked, filesystem
from icrtool.logs.containers.channel import ahead
from icrtool.logs.containers.recording_files import LOG_SUFFIXES, natural_order, unpacked_name
from icrtool.records.samples import InputFile
from icrtool.records.urls import UrlPath, without_secrets

NEAR_BYTES = 1 << 15
"""Between two ranges of a distant file that are read too: a request takes as long as some 100 kB."""

_LEAST_BYTES = 1 << 18
"""That are read at once: the records of an index follow one another."""

_PIECE_BYTES, PIECES_AHEAD = 1 << 24, 4


class Held(NamedTuple):
    """Bytes of a file from a place on."""

    at: int
    data: bytes

    def has(self, at: int, end: int) -> bool:
        """Return whether they hold a range of the file."""
        return self.at <= at and end <= self.at + len(self.data)


class LocalFile:
    """A file on disk, read at any place by several threads."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb")
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

    def close(self) -> None:
        """Release the file."""
        self._stream.close()


class RemoteFile:
    """A file behind a connection; each read takes as long as many kilobytes: reads are few, and made ahead.

    Parameters
    ----------
    about : what its store states about it; None: it is asked

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
        self.has_ranges = self._finds_ranges(about)
        self._about = about
        self.bytes_read = 0
        self._ends: tuple[Held, ...] = ()
        self._held = local()

    def _finds_ranges(self, about: dict[str, Any]) -> bool:
        """Return whether the server gives parts of the file."""
        if self.is_folder or not self.size or about.get("partial") is False:
            return False
        if not self.path.scheme.startswith("http"):
            return True
        return asked(self.path, self._gives_last_byte)

    def _gives_last_byte(self) -> bool:
        try:
            with self._files.open(self._name, block_size=_LEAST_BYTES, cache_type="none") as file:
                file.seek(self.size - 1)
                return len(file.read(1)) == 1
        except ValueError:
            return False

    def read_at(self, at: int, count: int) -> bytes:
        """Return bytes of the file, as many as there are."""
        end = min(at + count, self.size)
        if not self._ends:
            self._ends = self._read_ends()
        held = next((one for one in (*self._ends, self._last) if one.has(at, end)), None)
        if held is None:
            # What stands at the end of a file is read from its footer backwards.
            first = max(min(at, self.size - _LEAST_BYTES), 0)
            held = self.hold(first, max(end - first, _LEAST_BYTES))
        return held.data[at - held.at : end - held.at]

    def _read_ends(self) -> tuple[Held, ...]:
        """Return start and end of the file, which all that is read by an index begins with, by one request each."""
        begins = sorted({0, max(self.size - _LEAST_BYTES, 0)})
        return tuple(map(Held, begins, self._ranges(begins, [begin + _LEAST_BYTES for begin in begins])))

    @property
    def _last(self) -> Held:
        """What this thread read last."""
        return getattr(self._held, "last", Held(0, b""))

    def read_into(self, at: int, space: Bytes) -> int:
        """Fill some space with bytes of the file, and return how many there are."""
        data = self._range(at, len(space))
        space[: len(data)] = np.frombuffer(data, np.uint8)
        return len(data)

    def hold(self, at: int, count: int) -> Held:
        """Return bytes that `read_at` gives to this thread without another request."""
        held = self._last
        if held.has(at, min(at + count, self.size)):
            return held
        held = Held(at, self._range(at, count))
        self._held.last = held
        return held

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
            pieces = self._files.cat_ranges([self._name] * len(begins), begins, ends)
            if (broken := next((one for one in pieces if isinstance(one, BaseException)), None)) is not None:
                raise broken
            return list(map(bytes, pieces))

        pieces = asked(self.path, ask)
        for piece, begin, end in zip(pieces, begins, ends, strict=True):
            if len(piece) != end - begin:
                raise LogError(self.path, f"gave {len(piece)} bytes for {end - begin}", "is it being written?")
        self.bytes_read += sum(map(len, pieces))
        return pieces

    def pieces(self) -> Iterator[bytes]:
        """Yield the content from start to end; the next pieces are read meanwhile."""
        if not self.has_ranges:
            with asked(self.path, lambda: self._files.open(self._name, block_size=0)) as stream:
                while piece := asked(self.path, lambda: stream.read(_PIECE_BYTES), again=False):
                    yield piece
            return
        places = range(0, self.size, _PIECE_BYTES)
        for _, piece in ahead(lambda at: self._range(at, _PIECE_BYTES), places, PIECES_AHEAD, PIECES_AHEAD):
            yield piece()

    def fetch(self, place: Path, share: Callable[[float], None] | None) -> InputFile:
        """Write the file to a place on disk, and return what run.json states about it.

        Raises
        ------
        LogError
            It cannot be read to its end.
        OSError
            The disk is full.
        """
        digest, written = hashlib.sha256(), 0
        with place.open("wb") as sink:
            for piece in self.pieces():
                sink.write(piece)
                digest.update(piece)
                written += len(piece)
                if share is not None:
                    share(min(written / max(self.size, 1), 1.0))
        return replace(self.input, bytes=written, sha256=digest.hexdigest())

    @property
    def version(self) -> dict[str, str]:
        """What the store states about the content: ``version``, or else ``etag``; none where it states neither."""
        return _version_of(self._about)

    @property
    def input(self) -> InputFile:
        """What run.json states about the file where not all of it is read: no SHA-256."""
        return InputFile(str(self.path), self.size, None, **self.version)

    def close(self) -> None:
        """Forget what is held."""
        self._held = local()


Source = LocalFile | RemoteFile


def read_by_ranges(files: Collection[RemoteFile]) -> str:
    """Return how much was read of some files."""
    # Ranges overlap a little: of a small file more comes than it has.
    read, size = sum(min(one.bytes_read, one.size) for one in files), sum(one.size for one in files)
    return f"{read / 1e6:.3g} of {size / 1e6:.3g} MB read by ranges"


def _version_of(about: dict[str, Any]) -> dict[str, str]:
    for key, names in (("version", ("VersionId", "generation")), ("etag", ("ETag", "etag", "Last-Modified"))):
        stated = next((str(about[name]) for name in names if about.get(name)), "null")
        if stated != "null":
            return {key: stated.strip('"')}
    return {}


def changed_since(path: UrlPath, inputs: Iterable[InputFile]) -> bool:
    """Return whether the files at an address are not those that they were when they were opened.

    Parameters
    ----------
    inputs : the files as they were
    """
    about = _about(path)
    now = (
        {str(one): stated for one, stated in _in_folder(path)}
        if about.get("type") == "directory"
        else {str(path): about}
    )
    for one in inputs:
        stated = now.get(one.path, {})
        version = {key: value for key in ("version", "etag") if (value := getattr(one, key)) is not UNSET}
        if stated.get("size") not in {one.bytes, None} or _version_of(stated) != version:
            return True
    return False


def _about(path: UrlPath) -> dict[str, Any]:
    """Return what a store states about a file now, whatever it stated before."""
    files, name = filesystem(path)
    files.invalidate_cache(name)
    about: dict[str, Any] = asked(path, lambda: files.info(name))
    return about


def _in_folder(path: UrlPath) -> list[tuple[UrlPath, dict[str, Any]]]:
    """Return the addresses of the files in a folder, and what a store states about them now."""
    files, name = filesystem(path)
    files.invalidate_cache(name)
    found: list[dict[str, Any]] = asked(path, lambda: files.ls(name, detail=True))
    return [(address_of(files.unstrip_protocol(one["name"]), path), one) for one in found]


def find(path: UrlPath) -> list[UrlPath]:
    """Return the logs that an address stands for: itself, what its pattern matches, or the recordings below a folder.

    Raises
    ------
    LogError
        There are none, or they cannot be listed.
    """
    address = without_secrets(path.url) if path.scheme.startswith("http") else path.url
    if not re.search(r"[*\[]" if path.scheme.startswith("http") else r"[*?\[]", address):
        one = RemoteFile(path)
        found = _below(path) if one.is_folder else [path]
        if not found:
            raise LogError(
                path, "no recording in it", f"a log has one of the suffixes {', '.join(sorted(LOG_SUFFIXES))}"
            )
        return found
    files, name = filesystem(path)
    matched: dict[str, Any] = asked(path, lambda: files.glob(name, detail=True))
    found = []
    for inner, about in matched.items():
        one_path = address_of(files.unstrip_protocol(inner), path)
        found += _below(one_path) if about.get("type") == "directory" else [one_path]
    if not found:
        raise LogError(path, "matches nothing")
    return sorted(set(found), key=natural_order)


def _below(folder: UrlPath) -> list[UrlPath]:
    """Return the recordings below a folder, by their names: bag directories, and files of no bag directory.

    A folder that is a run is itself.
    """
    files, name = filesystem(folder)
    names: list[str] = asked(folder, lambda: files.find(name))
    if f"{name.rstrip('/')}/run.json" in names:
        return [folder]
    bags = {one.rpartition("/")[0] for one in names if one.endswith("/metadata.yaml")}
    logs = {one for one in names if Path(unpacked_name(one.rpartition("/")[2])).suffix in LOG_SUFFIXES}
    found = {parent if (parent := one.rpartition("/")[0]) in bags else one for one in logs}
    return sorted((address_of(files.unstrip_protocol(one), folder) for one in found), key=natural_order)


class FetchedFolder(NamedTuple):
    """A bag directory on disk: its storage files as run.json states them, and those that are read by ranges.

    The latter are empty on disk.
    """

    inputs: tuple[InputFile, ...]
    distant: dict[str, RemoteFile]


def fetch_folder(path: UrlPath, place: Path, share: Callable[[float], None] | None) -> FetchedFolder:
    """Write the storage files and metadata.yaml of a bag directory to a folder on disk, but MCAP files.

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
    return FetchedFolder(tuple(one for one in inputs if not one.path.endswith("metadata.yaml")), distant)
