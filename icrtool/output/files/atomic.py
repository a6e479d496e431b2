"""Files and directories that appear whole or not at all, and replace nothing that icrtool did not write.

A result is written and synced under a hidden name (``.icrtool-…``) in its folder, and then renamed to its place. A new
directory exchanges its name with the old one. Where the system cannot exchange two names in one step, the old directory
is renamed to a hidden name first. If a process is killed between the two renames, the next process that writes there
renames the old directory back.
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
from pathlib import Path, PurePath
from typing import NamedTuple
from zlib import crc32

from icrtool.errors import OutputError
from icrtool.records.places import Below, Place, open_regular, path_of
from icrtool.records.process_resources import mark_finished, mark_unfinished, remove_path, unfinished

MayReplace = Callable[[bytes], bool]
"""Function that states, by the first bytes of a file, whether icrtool wrote the file and may replace it."""

EXPORTED_MCAP = b"icrtool export"
"""Name of the library in the header of an MCAP file that `icrtool export` wrote: the file is no log of a user."""

PACKED_BEGINNINGS = (b"\x28\xb5\x2f\xfd", b"\x1f\x8b", b"BZh", b"\x04\x22\x4d\x18")
"""First bytes of files packed with zstd, gzip, bzip2 and lz4. icrtool writes no packed file: it may be a user's log."""

RECOGNISED_BYTES = 4096
"""Number of bytes that are read from the start of a file to recognise it."""

HIDDEN = ".icrtool-"
"""First characters of the names of files that icrtool uses while it writes results."""

FILE_MANAGER_FILES = {".DS_Store", "Thumbs.db", "desktop.ini"}
"""Names of files that file managers write into the folders they show."""

PARTIAL_SUFFIX, OLD_SUFFIX = ".partial", ".old"
"""Suffixes of hidden names: the first is of files and directories being written, the second of old directories."""

ABANDONED_S = 3600.0
"""Time without a change after which a hidden file counts as abandoned [s]. A report takes minutes."""

NO_SYNC = {errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP}
"""Error numbers of file systems that cannot sync a directory."""

SYNC_THREADS = 8
"""Number of threads that sync files. A file system commits simultaneous requests together: eight threads sync 16 files
in a fifth of the time of one thread."""

AT_FDCWD, RENAME_EXCHANGE = -100, 2
"""Arguments of the system call renameat2 of Linux, from <fcntl.h> and <linux/fs.h>."""


class DirectoryKind(NamedTuple):
    """A kind of directory that icrtool writes.

    Attributes
    ----------
    name : words for messages, for example "run directory"
    recognises : states whether a directory is of this kind
    files : matches the names of all files and directories that icrtool writes below it; a directory ends in ``/``
    """

    name: str
    recognises: Callable[[Path], bool]
    files: re.Pattern[str]


@contextmanager
def place_errors(place: Place) -> Iterator[None]:
    """Raise an OSError of the block as an OutputError of a place."""
    try:
        yield
    except OSError as err:
        raise OutputError(path_of(place), "cannot be written", err.strerror or str(err)) from err


def check_place(file: Place, may_replace: MayReplace | None = None) -> None:
    """Refuse a place where a file cannot be put, before any work is done for it.

    Parameters
    ----------
    file : the place of the file
    may_replace : as in `atomic_file`

    Raises
    ------
    OutputError
        The directory of the file is missing, or is a link below the folder of the place; or a log, a directory, a
        device, a pipe or a file that icrtool did not write is in this place.
    """
    with place_errors(file):
        if not _target_of(file, may_replace).parent.is_dir():
            raise OutputError(path_of(file), "its directory does not exist", "make it first, or name another file")


def _target_of(file: Place, may_replace: MayReplace | None) -> Path:
    """Return the path of a file without links; parameters and errors as in `check_place`."""
    path = path_of(file)
    if isinstance(file, Below):
        Below(file.folder, PurePath(file.name).parent).check_links()
        place = Path(os.path.realpath(path.parent)) / path.name
    else:
        place = Path(os.path.realpath(path))
    if place.is_dir():
        raise OutputError(path, "is a directory", "name a file")
    if place.is_symlink() or not place.exists():
        return place  # The link itself is replaced, not its target.
    if not place.is_file():
        raise OutputError(path, "is a device or pipe, which would be replaced", "name a file")
    from icrtool.logs.containers.open_log import container_of

    with open_regular(place) as stream:
        first = stream.read(RECOGNISED_BYTES)
        is_log = container_of(stream) is not None and EXPORTED_MCAP not in first[:64]
    if is_log or first.startswith(PACKED_BEGINNINGS):
        raise OutputError(path, "a log is there", "it is left alone; name another file")
    if may_replace is not None and first and not may_replace(first):
        raise OutputError(path, "a file that icrtool did not write is there", "it is left alone; name another place")
    return place


@contextmanager
def atomic_file(file: Place, may_replace: MayReplace | None = None) -> Iterator[Path]:
    """Yield a hidden path to write a file to; when the block ends without error, the file is renamed to its place.

    Parameters
    ----------
    file : place of the file; a log is never replaced. If the place is below a folder, a link there is replaced; if the
        user named the path, the link is kept and its target is replaced
    may_replace : states which files may be replaced; default: any file that is not a log

    Yields
    ------
    Path
        An empty file in the folder of `file`.

    Raises
    ------
    OutputError
        `check_place` refuses the place, or the block raised an OSError (disk full, no permission). The old file is then
        unchanged.
    """
    with place_errors(file), partial_at(_target_of(file, may_replace), Path.touch) as partial:
        yield partial
        sync(partial)
        put_in_place(partial, _target_of(file, may_replace))


def write_file(file: Place, content: str | bytes, may_replace: MayReplace | None = None) -> None:
    """Write a file, whole or not at all.

    Parameters
    ----------
    file, may_replace : as in `atomic_file`
    content : bytes, or a text, which is written in UTF-8; characters that UTF-8 cannot hold become escapes

    Raises
    ------
    OutputError
        `check_place` refuses the place, or the file cannot be written.
    """
    with atomic_file(file, may_replace) as partial:
        partial.write_bytes(content.encode("utf-8", errors="backslashreplace") if isinstance(content, str) else content)


def make_folders(folder: Below) -> None:
    """Make a folder, and the folders between, if they do not exist; no link is followed.

    Raises
    ------
    OutputError
        A link or a file is in the place of a folder, or a folder cannot be made.
    """
    with place_errors(folder):
        folder.check_links()
        folder.path.mkdir(parents=True, exist_ok=True)


def check_directory(directory: Place, kind: DirectoryKind) -> None:
    """Refuse a place where a directory of a kind cannot be put; restore an old one that a killed process renamed.

    Parameters
    ----------
    directory : place of the directory; an empty directory may be there, or a directory of the kind that holds no other
        files
    kind : kind of the directory

    Raises
    ------
    OutputError
        The place is a file, a directory of another kind, a directory with a file that icrtool did not write, a
        write-protected directory or a mount point; or it cannot be examined.
    """
    why, advice = "", "it is left alone; name another place"
    with place_errors(directory):
        if isinstance(directory, Below):
            directory.check_links()
        # Unlike `Path.resolve`, this does not fail on a link to itself.
        place = Path(os.path.realpath(path_of(directory)))
        aside = [path for path in place.parent.glob(_hidden_name(place, "*", OLD_SUFFIX)) if not path.is_symlink()]
        if aside and not os.path.lexists(place):
            max(aside, key=lambda path: path.stat().st_mtime_ns).rename(place)
        names = names_in(place)
        if file := next((path for path in (place, *place.parents) if path.exists() and not path.is_dir()), None):
            why = "a file is there" if file == place else f"{file} is a file"
            advice = f"name another place for the {kind.name}"
        elif not kind.recognises(place):
            if next(names, None) is not None:
                why = f"holds something that is not a {kind.name}"
        elif other := next((name for name in names if not kind.files.fullmatch(name)), None):
            why = f"holds {other}, which is no part of a {kind.name}"
            advice = "move it elsewhere first, or name another place"
        else:
            folders = [place, *(place / name for name in names_in(place) if name.endswith("/"))]
            if kept := next(
                (folder for folder in folders if folder.is_dir() and not os.access(folder, os.W_OK | os.X_OK)), None
            ):
                # A write-protected directory could be renamed but not removed, and would stay under a hidden name.
                why = "is write-protected, and so cannot be replaced"
                advice = f"make {kept.relative_to(place.parent)}/ writable, or name another place"
        if not why and place.is_mount():
            why, advice = "is a mount point, which cannot be replaced", "name a directory in it"
    if why:
        raise OutputError(path_of(directory), why, advice)


def names_in(directory: Path) -> Iterator[str]:
    """Yield the names of all files and directories below a directory, relative to it; a directory ends in ``/``.

    Raises
    ------
    OSError
        A directory cannot be read, and may hold any file.
    """

    def raise_unread(err: OSError) -> None:
        if not isinstance(err, FileNotFoundError):
            raise err

    for place, folders, files in os.walk(directory, onerror=raise_unread):
        # Hidden files of another process may disappear at any moment.
        folders[:] = [name for name in folders if not name.startswith(HIDDEN)]
        for name in (*folders, *files):
            path = Path(place, name)
            if name not in FILE_MANAGER_FILES and not name.startswith(HIDDEN):
                slash = "/" if name in folders and not path.is_symlink() else ""
                yield path.relative_to(directory).as_posix() + slash


@contextmanager
def atomic_directory(directory: Place, kind: DirectoryKind) -> Iterator[Path]:
    """Yield a hidden directory to write into; rename it to its place if the block ends without error, else remove it.

    Parameters
    ----------
    directory, kind : as in `check_directory`

    Yields
    ------
    Path
        A new empty directory in the folder of `directory`.

    Raises
    ------
    OutputError
        `check_directory` refuses the place, or the block raised an OSError (disk full, no permission).
    """
    check_directory(directory, kind)
    place = Path(os.path.realpath(path_of(directory)))
    with place_errors(directory):
        place.parent.mkdir(parents=True, exist_ok=True)
        with partial_at(place, Path.mkdir) as partial:
            yield partial
            sync_tree(partial)
            check_directory(directory, kind)
            put_in_place(partial, place)


@contextmanager
def partial_at(place: Path, make: Callable[[Path], object]) -> Iterator[Path]:
    """Make a file or directory under a hidden name in the folder of a place, yield its path, and remove it at the end.

    Hidden files that killed processes left there are removed too.
    """
    for abandoned in list(place.parent.glob(_hidden_name(place, "*-*-*"))):
        # An old directory under a hidden name is kept as long as nothing is in its place.
        with suppress(FileNotFoundError):
            if _has_no_writer(abandoned) and (abandoned.suffix == PARTIAL_SUFFIX or place.exists()):
                remove_path(abandoned)
    partial = place.with_name(_hidden_name(place, writer_id(), PARTIAL_SUFFIX))
    with unfinished(partial):
        try:
            make(partial)
            yield partial
        finally:
            remove_path(partial)


def _hidden_name(place: Path, writer: str, suffix: str = "") -> str:
    """Return a hidden name for a place; the length of the hidden name does not depend on the name of the place."""
    return f"{HIDDEN}{blake2b(os.fsencode(place.name), digest_size=8).hexdigest()}-{writer}{suffix}"


def writer_id() -> str:
    """Return a text with host, process and random letters that identifies this command in hidden names and claims."""
    return f"{crc32(platform.node().encode()):08x}-{os.getpid()}-{secrets.token_hex(4)}"


def _has_no_writer(path: Path) -> bool:
    """Return whether no process writes a hidden file any more: its process has ended, or it is `ABANDONED_S` old."""
    return not may_still_write("-".join(path.name.split("-")[-3:])) or path.lstat().st_mtime < time.time() - ABANDONED_S


def may_still_write(writer: str) -> bool:
    """Return whether the process in a `writer_id` may still write; True where that cannot be known."""
    host, _, rest = writer.partition("-")
    number = rest.partition("-")[0]
    if sys.platform != "linux" or not writer_id().startswith(f"{host}-") or not number.isdecimal():
        return True
    return Path("/proc", number).exists()


def put_in_place(partial: Path, place: Path) -> None:
    """Rename a synced hidden file or directory to its place; `partial_at` removes the old one.

    Raises
    ------
    OSError
        It cannot be renamed. The old file or directory is then unchanged.
    """
    # The old directory gets this hidden name. If this process is killed now, the old directory must not be removed.
    mark_finished(partial)
    if not place.is_dir():
        partial.replace(place)
    elif not _exchange(partial, place):
        old = place.with_name(_hidden_name(place, writer_id(), OLD_SUFFIX))
        place.rename(old)
        try:
            partial.rename(place)
        finally:
            # An interruption, or an error of a network file system, may come after the rename.
            if place.exists():
                remove_path(old)
            else:
                old.rename(place)
    mark_unfinished(partial)
    sync(place.parent)


def _exchange(first: Path, other: Path) -> bool:
    """Exchange the names of two directories in one step; return whether the system could do so."""
    if sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "renameat2"):
        return False
    names = AT_FDCWD, os.fsencode(first), AT_FDCWD, os.fsencode(other)
    return not ctypes.CDLL(None).renameat2(*names, RENAME_EXCHANGE)


def sync(path: Path) -> None:
    """Sync a file, or the names in a directory, to the disk."""
    if sys.platform == "win32" and path.is_dir():
        return
    # Windows syncs only files that are open for writing.
    handle = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as err:
        # Some network file systems cannot sync directories. A file whose sync fails may be lost, so this is an error.
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
