"""Files and directories that appear whole or not at all, and replace nothing that icrtool did not write.

Each is written and synced under a hidden name beside its place (``.icrtool-…``), then renamed. A directory exchanges
its name with the old one; where that is not possible, the old one is renamed aside before, and where a process is
killed between both renames, the next one that writes there renames it back.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import re
import secrets
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

from icrtool.errors import OutputError
from icrtool.records.places import check_links, open_regular
from icrtool.records.process_resources import begin, end, remove, unfinished

IsOurFile = Callable[[bytes], bool]
"""Whether a file, of which the first bytes are given, is one that we wrote and may replace."""

EXPORTED_MCAP = b"icrtool export"
"""Library in the header of an MCAP file that `icrtool export` wrote: it is no log of somebody's."""

PACKED_BEGINNINGS = (b"\x28\xb5\x2f\xfd", b"\x1f\x8b", b"BZh", b"\x04\x22\x4d\x18")
"""How files packed with zstd, gzip, bzip2 and lz4 begin: nothing that icrtool writes, and perhaps a log."""

RECOGNISED_BYTES = 4096

HIDDEN = ".icrtool-"
"""How the names of all files begin that are icrtool's and no results."""

OF_NOBODY = {".DS_Store", "Thumbs.db", "desktop.ini"}
"""What file managers leave in a folder that they show."""

PARTIAL_SUFFIX, OLD_SUFFIX = ".partial", ".old"
"""Suffixes of those that are being written, and of old directories that were renamed aside."""

ABANDONED_S = 3600.0
"""What was not changed for so long is written by no process any more: a report takes minutes."""

NO_SYNC = {errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP}

SYNC_THREADS = 8
"""A journal commits what is asked for together: eight threads sync 16 files in a fifth of the time of one."""

AT_FDCWD, RENAME_EXCHANGE = -100, 2
"""Of Linux: <fcntl.h>, <linux/fs.h>."""


class Kind(NamedTuple):
    """A kind of directory that icrtool writes.

    Attributes
    ----------
    name : for messages ("run directory")
    is_one : whether a directory is one
    files : matches the names below it of all that icrtool writes there; of a directory, with ``/`` at the end
    """

    name: str
    is_one: Callable[[Path], bool]
    files: re.Pattern[str]


@contextmanager
def place_errors(path: Path) -> Iterator[None]:
    """Raise an OSError of the block as an OutputError of a place."""
    try:
        yield
    except OSError as err:
        raise OutputError(path, "cannot be written", err.strerror or str(err)) from err


def check_place(path: Path, inside: Path | None = None, ours: IsOurFile | None = None) -> None:
    """Refuse a place where a file cannot be put, before any work is done for it.

    Parameters
    ----------
    inside, ours : as in `atomic_file`

    Raises
    ------
    OutputError
        The directory is missing, or a link below `inside`; a log, a directory, a device or a pipe is there, or another
        file than one of ours.
    """
    with place_errors(path):
        if not _place_of_file(path, inside, ours).parent.is_dir():
            raise OutputError(path, "its directory does not exist", "make it first, or name another file")


def _place_of_file(path: Path, inside: Path | None, ours: IsOurFile | None) -> Path:
    """Return the place of a file without links; parameters and errors as of `check_place`."""
    place = Path(os.path.realpath(path if inside is None else path.parent))
    if inside is not None:
        check_links(path.parent, inside)
        place /= path.name
    if place.is_dir():
        raise OutputError(path, "is a directory", "name a file")
    if place.is_symlink() or not place.exists():
        return place  # a link is replaced itself
    if not place.is_file():
        raise OutputError(path, "is a device or pipe, which would be replaced", "name a file")
    from icrtool.logs.containers.open_log import container_of

    with open_regular(place) as stream:
        first = stream.read(RECOGNISED_BYTES)
        is_log = container_of(stream) is not None and EXPORTED_MCAP not in first[:64]
    if is_log or first.startswith(PACKED_BEGINNINGS):
        raise OutputError(path, "a log is there", "it is left alone; name another file")
    if ours is not None and first and not ours(first):
        raise OutputError(path, "a file that icrtool did not write is there", "it is left alone; name another place")
    return place


@contextmanager
def atomic_file(file: Path, inside: Path | None = None, ours: IsOurFile | None = None) -> Iterator[Path]:
    """Give a path beside a file to write to; at the end of the block it is synced and moved to its place.

    Parameters
    ----------
    file : where it shall appear; a log is never replaced
    inside : a directory above the file. Below it no link is followed: one in the file's place is replaced.
        None: the user named this file, and a link stays a link: what it leads to is replaced
    ours : what may be replaced; default: any file that is no log

    Raises
    ------
    OutputError
        As `check_place`, and for every OSError of the block (disk full, no permission); what was there before still is.
    """
    with place_errors(file), beside(_place_of_file(file, inside, ours), Path.touch) as partial:
        yield partial
        sync(partial)
        put(partial, _place_of_file(file, inside, ours))


def write_file(file: Path, content: str | bytes, inside: Path | None = None, ours: IsOurFile | None = None) -> None:
    """Write a file, whole or not at all; of a text in UTF-8, what is no character becomes an escape.

    Parameters
    ----------
    inside, ours : as in `atomic_file`

    Raises
    ------
    OutputError
        As `atomic_file`.
    """
    with atomic_file(file, inside, ours) as partial:
        partial.write_bytes(content.encode("utf-8", errors="backslashreplace") if isinstance(content, str) else content)


def make_folders(folder: Path, inside: Path) -> None:
    """Make a folder below a directory, and those between, where they are not there; no link is followed.

    Raises
    ------
    OutputError
        A link or a file is in its place, or it cannot be made.
    """
    with place_errors(folder):
        check_links(folder, inside)
        folder.mkdir(parents=True, exist_ok=True)


def check_directory(directory: Path, kind: Kind, inside: Path | None = None) -> None:
    """Refuse a place where a directory of a kind cannot be put; rename back what a killed process left aside.

    Parameters
    ----------
    directory : where it shall appear; nothing, an empty directory, or one of the kind without files of others is there
    inside : a directory above it; below that no link is followed. None: the user named `directory`, and links are

    Raises
    ------
    OutputError
        A file, something else than a directory of the kind, or files of others are there; what is there could not be
        removed; it is a mount point; or nothing can be known about the place.
    """
    why, advice = "", "it is left alone; name another place"
    with place_errors(directory):
        if inside is not None:
            check_links(directory, inside)
        # Unlike `Path.resolve`, this takes a link that leads to itself as it is.
        place = Path(os.path.realpath(directory))
        aside = [path for path in place.parent.glob(_hidden_name(place, "*", OLD_SUFFIX)) if not path.is_symlink()]
        if aside and not os.path.lexists(place):
            max(aside, key=lambda path: path.stat().st_mtime_ns).rename(place)
        names = names_in(place)
        if file := next((one for one in (place, *place.parents) if one.exists() and not one.is_dir()), None):
            why = "a file is there" if file == place else f"{file} is a file"
            advice = f"name another place for the {kind.name}"
        elif not kind.is_one(place):
            if next(names, None) is not None:
                why = f"holds something that is not a {kind.name}"
        elif other := next((name for name in names if not kind.files.fullmatch(name)), None):
            why = f"holds {other}, which is no part of a {kind.name}"
            advice = "move it elsewhere first, or name another place"
        else:
            folders = [place, *(place / name for name in names_in(place) if name.endswith("/"))]
            if kept := next((one for one in folders if one.is_dir() and not os.access(one, os.W_OK | os.X_OK)), None):
                # It could be renamed, but not removed: it would stay under a hidden name.
                why = "is write-protected, and so cannot be replaced"
                advice = f"make {kept.relative_to(place.parent)}/ writable, or name another place"
        if not why and place.is_mount():
            why, advice = "is a mount point, which cannot be replaced", "name a directory in it"
    if why:
        raise OutputError(directory, why, advice)


def names_in(directory: Path) -> Iterator[str]:
    """Yield all that is in a directory, relative to it; a directory with ``/`` at its end.

    Raises
    ------
    OSError
        One cannot be looked into: it may hold anything.
    """

    def unseen(err: OSError) -> None:
        if not isinstance(err, FileNotFoundError):
            raise err

    for place, folders, files in os.walk(directory, onerror=unseen):
        # What another process writes there may be gone at any moment.
        folders[:] = [name for name in folders if not name.startswith(HIDDEN)]
        for name in (*folders, *files):
            path = Path(place, name)
            if name not in OF_NOBODY and not name.startswith(HIDDEN):
                slash = "/" if name in folders and not path.is_symlink() else ""
                yield path.relative_to(directory).as_posix() + slash


@contextmanager
def atomic_directory(directory: Path, kind: Kind, inside: Path | None = None) -> Iterator[Path]:
    """Give a hidden directory to write into; put it in place when the block ends well, remove it otherwise.

    Parameters
    ----------
    directory, kind, inside : as in `check_directory`

    Yields
    ------
    Path
        A new empty directory beside `directory`.

    Raises
    ------
    OutputError
        As `check_directory`, and for every OSError of the block (disk full, no permission).
    """
    check_directory(directory, kind, inside)
    place = Path(os.path.realpath(directory))
    with place_errors(directory):
        place.parent.mkdir(parents=True, exist_ok=True)
        with beside(place, Path.mkdir) as partial:
            yield partial
            sync_tree(partial)
            check_directory(directory, kind, inside)
            put(partial, place)


@contextmanager
def beside(place: Path, make: Callable[[Path], object]) -> Iterator[Path]:
    """Make a file or directory under a hidden name beside a place, and remove what has that name at the end.

    What killed processes left there is removed too.
    """
    for left in list(place.parent.glob(_hidden_name(place, "*-*-*"))):
        # What was renamed aside is needed as long as nothing is in its place.
        with suppress(FileNotFoundError):
            if _is_left(left) and (left.suffix == PARTIAL_SUFFIX or place.exists()):
                remove(left)
    partial = place.with_name(_hidden_name(place, _writer(), PARTIAL_SUFFIX))
    with unfinished(partial):
        try:
            make(partial)
            yield partial
        finally:
            remove(partial)


def _hidden_name(place: Path, writer: str, suffix: str = "") -> str:
    """Return a name beside a place, which is never too long."""
    return f"{HIDDEN}{blake2b(os.fsencode(place.name), digest_size=8).hexdigest()}-{writer}{suffix}"


def _writer() -> str:
    """Return host and process in letters of a hidden name, and some that are used once."""
    return f"{crc32(platform.node().encode()):08x}-{os.getpid()}-{secrets.token_hex(4)}"


def _is_left(path: Path) -> bool:
    """Return whether no process writes what has a hidden name: its own has ended, or it is `ABANDONED_S` old."""
    host, process, _ = path.name.split("-")[-3:]
    is_here = sys.platform == "linux" and _writer().startswith(f"{host}-")
    return (is_here and not Path("/proc", process).exists()) or path.lstat().st_mtime < time.time() - ABANDONED_S


def put(partial: Path, place: Path) -> None:
    """Put a hidden file or directory, which is synced, in its place; `beside` removes the old one.

    Raises
    ------
    OSError
        It cannot be renamed; what was there still is.
    """
    # Where this process is ended by force, the old directory is not to be removed under the hidden name.
    end(partial)
    if not place.is_dir():
        partial.replace(place)
    elif not _exchange(partial, place):
        old = place.with_name(_hidden_name(place, _writer(), OLD_SUFFIX))
        place.rename(old)
        try:
            partial.rename(place)
        finally:
            # An interruption, or the failure that a network file system reports, may come behind the rename.
            if place.exists():
                remove(old)
            else:
                old.rename(place)
    begin(partial)
    sync(place.parent)


def _exchange(one: Path, other: Path) -> bool:
    """Give two directories each other's names in one step, and return whether that was possible here."""
    if sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "renameat2"):
        return False
    names = AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other)
    return not ctypes.CDLL(None).renameat2(*names, RENAME_EXCHANGE)


def sync(path: Path) -> None:
    """Have the system write a file's content, or a directory's names, to the disk."""
    if sys.platform == "win32" and path.is_dir():
        return
    # Windows syncs only what is open for writing.
    handle = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as err:
        # Some network file systems have no sync for directories; a file whose sync fails is not written.
        if err.errno not in NO_SYNC or not path.is_dir():
            raise
    finally:
        os.close(handle)


def sync_tree(directory: Path) -> None:
    """Sync all files below a directory, then all directories, the outermost last."""
    paths = [directory, *directory.rglob("*")]
    with ThreadPoolExecutor(SYNC_THREADS) as pool:
        list(pool.map(sync, (path for path in paths if not path.is_dir())))
    for path in reversed(paths):
        if path.is_dir():
            sync(path)
