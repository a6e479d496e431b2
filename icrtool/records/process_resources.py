"""Resources that a process releases: unfinished files when a signal ends it, and memory that it freed."""

from __future__ import annotations

import shutil
import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path  # its import would take a tenth of the time of ``icrtool --help``

TRIES = 20
"""Number of attempts to remove a directory. Another thread may still add files to the directory."""

_paths: set[Path] = set()
_undisturbed: list[bool] = []


def mark_unfinished(path: Path) -> None:
    """Add a path to the paths that `remove_unfinished` removes, until `mark_finished` is called."""
    _paths.add(path)


def mark_finished(path: Path) -> None:
    """Take a path from the paths that `remove_unfinished` removes: it is complete, or another file gets its name."""
    _paths.discard(path)


@contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Mark a path as unfinished until the block ends."""
    mark_unfinished(path)
    try:
        yield
    finally:
        mark_finished(path)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Delay the end of the process by a signal until the block ends.

    The block is short, and makes a file under a name that `remove_unfinished` does not know yet.
    """
    _undisturbed.append(True)
    try:
        yield
    finally:
        _undisturbed.pop()


def may_end() -> bool:
    """Return whether the process is in no block of `undisturbed`."""
    return not _undisturbed


def remove_unfinished() -> None:
    """Remove all unfinished files and directories. It is called when no other code of this process will run."""
    for path in list(_paths):
        for _ in range(TRIES):
            remove_path(path)
            if not path.exists():
                break


def remove_path(path: Path) -> None:
    """Remove a file or a directory; files that cannot be removed stay."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


LARGE_BYTES = 600 << 20
"""Memory use below which a process keeps its freed memory [bytes]. A log of up to 1 h needs less memory."""

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Numbers of parameters of ``mallopt``, from glibc's ``malloc.h``."""

KEPT_BYTES = 1 << 27
"""Largest size of the free memory at the end of the heap that glibc keeps [bytes]."""

OWN_PAGES_BYTES = 1 << 22
"""Smallest array to which glibc gives pages of its own [bytes]; these pages go back to the system with the array.

A column of 1 h at 100 Hz has 2.9 MB: its memory is used again. The pages of longer columns go back without a call of
`give_back_freed`. The pipeline calls `give_back_freed` at each stage; without these calls a report on 10 h took 1168 MB
in place of 958 MB."""


def keep_freed() -> None:
    """Set glibc to allocate for all threads in one arena, and to use freed memory again.

    By default each thread has an arena, whose free end `malloc_trim` does not give back. Also by default, glibc gives
    the memory of a column of 1 h back and requests it again for the next column: half of all pages of a fit.
    """
    _call_libc("mallopt", M_ARENA_MAX, 1)
    _call_libc("mallopt", M_TRIM_THRESHOLD, KEPT_BYTES)
    _call_libc("mallopt", M_MMAP_THRESHOLD, OWN_PAGES_BYTES)


def give_back_freed() -> None:
    """Give freed memory back to the system.

    glibc keeps freed blocks of up to 32 MB, in pieces that are too small for another column of a long log: 0.3 GB after
    reading 10 h at 100 Hz.
    """
    if sys.platform == "linux":
        from resource import RUSAGE_SELF, getrusage

        if getrusage(RUSAGE_SELF).ru_maxrss * 1024 > LARGE_BYTES:
            _call_libc("malloc_trim", 0)


def _call_libc(name: str, *arguments: int) -> None:
    """Call a function of glibc; do nothing on systems without this function (musl, macOS, Windows)."""
    if sys.platform == "linux":
        import ctypes

        function = getattr(ctypes.CDLL(None), name, None)
        if function is not None:
            function(*arguments)
