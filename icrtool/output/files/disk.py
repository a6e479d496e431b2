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
from contextlib import contextmanager, suppress
from hashlib import blake2b
from pathlib import Path

if sys.platform != "win32":
    import fcntl

NO_EXCHANGE = {errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP}
"""What a kernel or a file system answers that cannot exchange; network file systems are among them."""

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
    handle = None
    with suppress(OSError):
        handle = _lock(path)
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


def is_abandoned(path: Path) -> bool:
    """Return whether no living process writes what `locked` locked."""
    try:
        os.close(_lock(path))
    except BlockingIOError:
        return False
    except OSError:  # no locks here, or not ours to open: its age decides
        return path.exists() and time.time() - path.stat().st_mtime > LONGEST_WRITE_S
    return True


def _lock(path: Path) -> int:
    if sys.platform == "win32":
        raise OSError(errno.ENOSYS, "no locks", str(path))
    handle = os.open(path, _LOOK)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise
    return handle


def exchange(one: Path, other: Path) -> bool:
    """Give two directories each other's names in one step.

    Returns
    -------
    bool
        Whether it was done; False where the platform or the file system has no such call.

    Raises
    ------
    OSError
        It has one, and it failed.
    """
    if sys.platform not in ("linux", "darwin"):
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "renameat2"):
        failed = libc.renameat2(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE)
    elif hasattr(libc, "renamex_np"):
        failed = libc.renamex_np(os.fsencode(one), os.fsencode(other), RENAME_EXCHANGE)
    else:
        return False
    if failed and (number := ctypes.get_errno()) not in NO_EXCHANGE:
        raise OSError(number, os.strerror(number), str(one))
    return not failed


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
        if err.errno not in NO_EXCHANGE or not path.is_dir():
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


def remove(path: Path) -> None:
    """Remove a file or a directory; what cannot be removed is hidden, and is left to the next run."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)
