"""What a process has to clear: unfinished files, where it is ended by force, and memory that it freed."""

from __future__ import annotations

import shutil
import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path  # its import would be a tenth of ``icrtool --help``

TRIES = 20
"""Attempts to remove a directory: another thread may still add files to it."""

_paths: set[Path] = set()
_undisturbed: list[bool] = []


def mark_unfinished(path: Path) -> None:
    """Have `remove_unfinished` remove a file or directory, until `mark_finished` is called."""
    _paths.add(path)


def mark_finished(path: Path) -> None:
    """Keep what is at a path from now on: it is complete, or its name is about to become another's."""
    _paths.discard(path)


@contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Remove a file or directory in `remove_unfinished` until the block ends."""
    mark_unfinished(path)
    try:
        yield
    finally:
        mark_finished(path)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Let a signal end the process only after the block, which is short and makes a file under an unknown name."""
    _undisturbed.append(True)
    try:
        yield
    finally:
        _undisturbed.pop()


def may_end() -> bool:
    """Return whether the process is in no block of `undisturbed`."""
    return not _undisturbed


def remove_unfinished() -> None:
    """Remove all that is being written; called where no other code of this process will do it any more."""
    for path in list(_paths):
        for _ in range(TRIES):
            remove_path(path)
            if not path.exists():
                break


def remove_path(path: Path) -> None:
    """Remove a file or a directory, as far as that is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


LARGE_BYTES = 600 << 20
"""Memory below which a process does not give freed memory back [bytes]: logs of up to an hour take less, and the gain
would not matter."""

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Of glibc's ``malloc.h``."""

KEPT_BYTES = 1 << 27
"""Largest free end of the memory that glibc keeps [bytes]."""

OWN_PAGES_BYTES = 1 << 22
"""Size from which on glibc gives an array pages of its own, which are given back with it [bytes]. A column of 1 h at
100 Hz has 2.9 MB: it uses memory again. Columns of longer logs are given back without a call of `give_back_freed`. The
pipeline calls it at each stage: without these calls a report on 10 h took 1168 MB in place of 958 MB."""


def keep_freed() -> None:
    """Let new threads allocate in the main thread's memory, and use memory again that other threads freed.

    glibc gives each thread an arena of its own, whose free end `malloc_trim` does not give back; and glibc gives the
    memory of a column of 1 h back and requests it again for the next column: half of all pages of a fit.
    """
    _call_libc("mallopt", M_ARENA_MAX, 1)
    _call_libc("mallopt", M_TRIM_THRESHOLD, KEPT_BYTES)
    _call_libc("mallopt", M_MMAP_THRESHOLD, OWN_PAGES_BYTES)


def give_back_freed() -> None:
    """Have the C library give freed memory back.

    glibc keeps freed blocks of up to 32 MB, in pieces that are too small for another column of a long log: 0.3 GB after
    reading 10 h at 100 Hz.
    """
    if sys.platform == "linux":
        from resource import RUSAGE_SELF, getrusage

        if getrusage(RUSAGE_SELF).ru_maxrss * 1024 > LARGE_BYTES:
            _call_libc("malloc_trim", 0)


def _call_libc(name: str, *arguments: int) -> None:
    """Call a function of the C library; other systems, and musl, have none of that name."""
    if sys.platform == "linux":
        import ctypes

        function = getattr(ctypes.CDLL(None), name, None)
        if function is not None:
            function(*arguments)
