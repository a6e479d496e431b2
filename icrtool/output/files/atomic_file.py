"""A file that appears whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from icrtool.errors import OutputError
from icrtool.output.files import disk
from icrtool.records.unfinished import unfinished

LONGEST_SUFFIX = 16
"""Letters of a suffix that is kept, from which a library takes the format."""


@contextmanager
def atomic_file(file: Path) -> Iterator[Path]:
    """Give a path beside a file to write to; at the end of the block it is synced and moved to its place.

    A link stays a link: what it leads to is replaced.

    Raises
    ------
    OutputError
        As `check_place`, and for every OSError of the block (disk full, no permission); what was there before still is.
    """
    partial: Path | None = None
    try:
        place = Path(os.path.realpath(file))
        _check_kind(file, place)
        end = f".partial{place.suffix.lower()[:LONGEST_SUFFIX]}"
        for left in disk.hidden(place, end):
            if disk.is_abandoned(left):
                disk.remove(left)
        partial = disk.hidden_name(place, end)
        with unfinished(partial):
            partial.touch(exist_ok=False)
            with disk.locked(partial):
                yield partial
                disk.sync(partial)
                _check_kind(file, place)
                disk.replace(partial, place)
        disk.sync(place.parent)
    except OSError as err:
        raise OutputError(file, "cannot be written", err.strerror or str(err)) from err
    finally:
        if partial is not None:
            disk.remove(partial)


def write_file(file: Path, content: str | bytes) -> None:
    """Write a file, whole or not at all; of a text in UTF-8, what is no character becomes an escape.

    Raises
    ------
    OutputError
        As `atomic_file`.
    """
    with atomic_file(file) as partial:
        partial.write_bytes(content.encode("utf-8", errors="backslashreplace") if isinstance(content, str) else content)


def check_place(path: Path) -> None:
    """Refuse a file whose directory is not there, before any work is done for it.

    Raises
    ------
    OutputError
        The directory is missing; `path` is one itself, or a device or pipe.
    """
    try:
        place = Path(os.path.realpath(path))
        if not place.parent.is_dir():
            raise OutputError(path, "its directory does not exist", "make it first, or name another file")
        _check_kind(path, place)
    except OSError as err:
        raise OutputError(path, "cannot be written", err.strerror or str(err)) from err


def _check_kind(path: Path, place: Path) -> None:
    if place.is_dir():
        raise OutputError(path, "is a directory", "name a file")
    if place.exists() and not place.is_file():
        raise OutputError(path, "is a device or pipe, which would be replaced", "name a file")
