"""The calls that change names on the disk: hidden names beside a place, and their locks; exchange, link, sync."""

from __future__ import annotations

import ctypes
import errno
import glob
import os
import secrets
import shutil
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path

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


def hidden_name(place: Path, end: str = ".partial") -> Path:
    """Return a new hidden name beside a place, for what shall get its name."""
    return place.with_name(f"{_hidden_begin(place)}{secrets.token_hex(TOKEN_BYTES)}{end}")


def hidden(place: Path, end: str) -> list[Path]:
    """Return what has a name that `hidden_name` made of a place."""
    # Of exactly this length: the directories a and a.b may be beside one another.
    found = place.parent.glob(glob.escape(_hidden_begin(place)) + 2 * TOKEN_BYTES * "[0-9a-f]" + end)
    # A link is not ours: it would lead the cleaning elsewhere.
    return [path for path in found if not path.is_symlink()]


def _hidden_begin(place: Path) -> str:
    name = os.fsencode(place.name)
    return f".{blake2b(name, digest_size=16).hexdigest() if len(name) > LONGEST_NAME_BYTES else place.name}."


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a file or directory, where that is possible, until the block or the process ends."""
    handle = _lock(path)
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


def is_abandoned(path: Path) -> bool:
    """Return whether no living process writes what `locked` locked; where there are no locks its age decides."""
    try:
        handle = _lock(path)
    except BlockingIOError:
        return False
    if handle is None:
        return path.exists() and time.time() - path.stat().st_mtime > LONGEST_WRITE_S
    os.close(handle)
    return True


def _lock(path: Path) -> int | None:
    """Return the handle that holds a lock; None where there are no locks, or the path is not ours to open."""
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
