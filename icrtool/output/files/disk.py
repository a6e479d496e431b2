"""What changes names on the disk: hidden names beside a place, and their locks; exchange, link, sync.

A file is put in its place by a rename; a directory exchanges its name with the old one (``renameat2`` of Linux,
``renamex_np`` of macOS). Where platform or file system cannot exchange, the old one is renamed aside first; where a
process is killed between both renames, the next one renames it back.
"""

from __future__ import annotations

import ctypes
import errno
import glob
import os
import secrets
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path

from icrtool.records.process_resources import end, remove, unfinished

if sys.platform != "win32":
    import fcntl

NO_SYNC = {errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP}

NO_LINK = {errno.EPERM, errno.EXDEV, errno.EMLINK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EACCES}

AT_FDCWD = -100
RENAME_EXCHANGE = 2
"""Linux <linux/fs.h> and macOS <sys/stdio.h> (RENAME_SWAP) have the same number."""

LONGEST_NAME_BYTES = 200
"""A hidden name is that of the place and some letters; a longer one is shortened to its hash."""

TOKEN_BYTES = 4

LONGEST_WRITE_S = 86400.0
"""Where a file system has no locks, what is being written counts as abandoned after this time."""

SYNC_THREADS = 8
"""A journal commits what is asked for together: eight threads sync 16 files in a fifth of the time of one."""

_LOOK = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


def hidden_name(place: Path, suffix: str = ".partial") -> Path:
    """Return a new hidden name beside a place, for what shall get its name."""
    return place.with_name(f"{_hidden_begin(place)}{secrets.token_hex(TOKEN_BYTES)}{suffix}")


def hidden(place: Path, suffix: str) -> list[Path]:
    """Return what has a name that `hidden_name` made of a place."""
    # Of exactly this length: the directories a and a.b may be beside one another.
    found = place.parent.glob(glob.escape(_hidden_begin(place)) + 2 * TOKEN_BYTES * "[0-9a-f]" + suffix)
    # A link is not ours: it would lead the cleaning elsewhere.
    return [path for path in found if not path.is_symlink()]


def _hidden_begin(place: Path) -> str:
    name = os.fsencode(place.name)
    return f".{blake2b(name, digest_size=16).hexdigest() if len(name) > LONGEST_NAME_BYTES else place.name}."


@contextmanager
def beside(place: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """Make a file or directory under a hidden name beside a place, and remove what has that name at the end.

    What killed processes left there is removed too.
    """
    # What was renamed aside is needed as long as nothing is in its place.
    for left in hidden(place, ".partial") + (hidden(place, ".old") if place.exists() else []):
        try:
            handle = _lock(left)
        except BlockingIOError:
            continue  # a living process writes it
        if handle is not None:
            os.close(handle)
        elif not left.exists() or time.time() - left.stat().st_mtime < LONGEST_WRITE_S:
            continue
        remove(left)
    partial = hidden_name(place)
    with unfinished(partial):
        try:
            make(partial)
            handle = _lock(partial)
            try:
                yield partial
            finally:
                if handle is not None:
                    os.close(handle)
        finally:
            remove(partial)


def put(partial: Path, place: Path) -> None:
    """Put a hidden file or directory, which is synced, in its place, and remove what was there.

    Raises
    ------
    OSError
        It cannot be renamed; what was there still is.
    """
    # From here on its name may be that of the old directory, which has to stay where this process is ended by force.
    end(partial)
    old = partial
    if not place.is_dir():
        partial.replace(place)
    elif not exchange(partial, place):
        old = hidden_name(place, ".old")
        place.rename(old)
        try:
            partial.rename(place)
        except BaseException:
            if not place.exists():
                old.rename(place)
            raise
    with unfinished(old):
        sync(place.parent)
        remove(old)


def _lock(path: Path) -> int | None:
    """Lock a file or directory until its handle, which is returned, is closed, or the process ends.

    None where there are no locks, or the path is not ours to open.

    Raises
    ------
    BlockingIOError
        A living process has locked it.
    """
    if sys.platform == "win32":
        return None
    handle = None
    try:
        handle = os.open(path, _LOOK)
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as err:
        if handle is not None:
            os.close(handle)
        if isinstance(err, BlockingIOError):
            raise
        return None
    return handle


def exchange(one: Path, other: Path) -> bool:
    """Give two directories each other's names in one step, and return whether that was possible here."""
    if sys.platform not in ("linux", "darwin"):
        return False
    libc, names = ctypes.CDLL(None), (os.fsencode(one), os.fsencode(other))
    if hasattr(libc, "renameat2"):
        return not libc.renameat2(AT_FDCWD, names[0], AT_FDCWD, names[1], RENAME_EXCHANGE)
    return hasattr(libc, "renamex_np") and not libc.renamex_np(*names, RENAME_EXCHANGE)


def link(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it where the file system has no links; a symbolic link stays one."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target, follow_symlinks=False)
    except (OSError, NotImplementedError) as err:
        if isinstance(err, OSError) and err.errno not in NO_LINK:
            raise
        shutil.copy2(source, target, follow_symlinks=False)


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
    """Sync all regular files below a directory, then all directories, the outermost last."""
    files, directories = [], []
    for folder, _, names in os.walk(directory, topdown=False):
        directories.append(Path(folder))
        files += [path for name in names if (path := Path(folder, name)).is_file() and not path.is_symlink()]
    with ThreadPoolExecutor(SYNC_THREADS) as pool:
        list(pool.map(sync, files))
    for path in directories:
        sync(path)
