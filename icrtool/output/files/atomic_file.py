"""A file that appears whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from icrtool.errors import OutputError
from icrtool.output.files import disk
from icrtool.records.regular_file import check_folders, open_regular
from icrtool.records.unfinished import unfinished

LONGEST_SUFFIX = 16
"""Letters of a suffix that is kept, from which a library takes the format."""

EXPORTED_MCAP = b"icrtool export"
"""Library in the header of an MCAP file that `icrtool export` wrote: it is no log of somebody's."""

PACKED = (b"\x28\xb5\x2f\xfd", b"\x1f\x8b", b"BZh", b"\x04\x22\x4d\x18")
"""How files packed with zstd, gzip, bzip2 and lz4 begin: nothing that icrtool writes, and perhaps a log."""

FIRST_BYTES = 4096

IsOurs = Callable[[bytes], bool]
"""Whether a file, of which the first bytes are given, is one that we wrote and may replace."""


@contextmanager
def atomic_file(file: Path, inside: Path | None = None, ours: IsOurs | None = None) -> Iterator[Path]:
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
    partial: Path | None = None
    try:
        place = _checked(file, inside, ours)
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
                disk.replace(partial, _checked(file, inside, ours))
        disk.sync(place.parent)
    except OSError as err:
        raise OutputError(file, "cannot be written", err.strerror or str(err)) from err
    finally:
        if partial is not None:
            disk.remove(partial)


def write_file(file: Path, content: str | bytes, inside: Path | None = None, ours: IsOurs | None = None) -> None:
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


def check_place(path: Path, inside: Path | None = None, ours: IsOurs | None = None) -> None:
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
    try:
        place = _checked(path, inside, ours)
        if not place.parent.is_dir():
            raise OutputError(path, "its directory does not exist", "make it first, or name another file")
    except OSError as err:
        raise OutputError(path, "cannot be written", err.strerror or str(err)) from err


def make_folders(folder: Path, inside: Path) -> None:
    """Make a folder below a directory, and those between, where they are not there; no link is followed.

    Raises
    ------
    OutputError
        A link or a file is in its place, or it cannot be made.
    """
    try:
        check_folders(folder, inside)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise OutputError(folder, "cannot be made", err.strerror or str(err)) from err


def is_page(first: bytes) -> bool:
    """Return whether a file is a page of ours, by its first bytes."""
    return b"icrtool</title>" in first


def _checked(path: Path, inside: Path | None, ours: IsOurs | None) -> Path:
    """Return the place of a file without links."""
    place = Path(os.path.realpath(path if inside is None else path.parent))
    if inside is not None:
        check_folders(path, inside)
        place /= path.name
        if place.is_symlink():
            return place
    if place.is_dir():
        raise OutputError(path, "is a directory", "name a file")
    if place.exists():
        if not place.is_file():
            raise OutputError(path, "is a device or pipe, which would be replaced", "name a file")
        _check_content(path, place, ours)
    return place


def _check_content(path: Path, place: Path, ours: IsOurs | None) -> None:
    """Refuse to replace a log, or what is not ours."""
    from icrtool.logs.containers.open_log import container_of

    try:
        with open_regular(place) as stream:
            first = stream.read(FIRST_BYTES)
            is_log = container_of(stream) is not None and EXPORTED_MCAP not in first[:64]
    except PermissionError:
        return  # it may be replaced without being read
    if is_log or first.startswith(PACKED):
        raise OutputError(path, "a log is there", "it is left alone; name another file")
    if ours is not None and first and not ours(first):
        raise OutputError(path, "a file that icrtool did not write is there", "it is left alone; name another place")
