"""Files and directories that this process is writing: one that is ended by force removes them before it goes."""

from __future__ import annotations

import shutil
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path  # its import would be a tenth of ``icrtool --help``

TRIES = 20
"""Another thread may still add files to a directory while it is removed."""

_paths: set[Path] = set()
_parents: list[Path] = []


def begin(path: Path) -> None:
    """Have `remove_unfinished` remove a file or directory, until `end` is called."""
    _paths.add(path)


def end(path: Path) -> None:
    """Keep what is at a path from now on: it is complete, or its name is about to become another's."""
    _paths.discard(path)


@contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Remove a file or directory in `remove_unfinished` until the block ends."""
    begin(path)
    try:
        yield
    finally:
        end(path)


@contextmanager
def with_parents(path: Path) -> Iterator[list[Path]]:
    """Make the directories above a path, and give those that were missing; what is empty at the end is removed again.

    Raises
    ------
    OSError
        One cannot be made.
    """
    missing = [parent for parent in path.parents if not parent.exists()]
    _parents.extend(missing)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield missing
    finally:
        _remove_empty(missing)
        for parent in missing:
            _parents.remove(parent)


def remove_unfinished() -> None:
    """Remove all that is being written; called where no other code of this process will do it any more."""
    for path in list(_paths):
        for _ in range(TRIES):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
            if not path.exists():
                break
    _remove_empty(list(_parents))


def _remove_empty(directories: list[Path]) -> None:
    for directory in directories:
        with suppress(OSError):
            directory.rmdir()
