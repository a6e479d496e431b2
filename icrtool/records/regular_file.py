"""Files that somebody else may have put there: opened as regular files, and below a directory without any link.

The path that a user names is followed, wherever links lead. What lies below it may come from a stranger: a link there
could lead to any file of the user, and a pipe or a device would never end.
"""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path  # its import would be a tenth of ``icrtool --help``

LARGEST_DOCUMENT_BYTES = 1 << 28
"""Of a file that is read into memory whole: the run.json of a long drive has some MB."""

# Windows has neither; there pipes are no files.
_FILE = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)

NOT_REGULAR = "not a regular file"
SAVE_IT = "save what it gives to a file, and name that"


class NotRegularFileError(OSError):
    """A link, pipe, device or directory where a regular file is expected."""

    def __init__(self, path: Path, why: str = NOT_REGULAR) -> None:
        advice = f"; {SAVE_IT}" if why == NOT_REGULAR else ""
        super().__init__(errno.EINVAL, f"{why}{advice}", str(path))


def open_regular(path: Path, inside: Path | None = None) -> BufferedReader:
    """Open a regular file for reading; never wait for a pipe or a device.

    Parameters
    ----------
    inside : a directory above the file; below it no link is followed. None: the user named this file, links are

    Raises
    ------
    NotRegularFileError
        It is a link, a pipe, a device or a directory, or a directory above it is a link.
    OSError
        It cannot be opened.
    """
    if inside is not None:
        check_links(path, inside)
    handle = os.open(path, _FILE if inside is None else _FILE | _NO_LINK)
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise NotRegularFileError(path)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_regular(path: Path, inside: Path | None = None, most_bytes: int = LARGEST_DOCUMENT_BYTES) -> bytes:
    """Return the content of a file that `open_regular` opens.

    Raises
    ------
    OSError
        As `open_regular`; the file is larger than `most_bytes`.
    """
    with open_regular(path, inside) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"larger than {most_bytes} bytes", str(path))
    return content


def is_special(path: Path) -> bool:
    """Return whether there is a pipe or a device, which could be read for ever."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def is_regular(path: Path, inside: Path) -> bool:
    """Return whether there is a file that `open_regular` opens."""
    try:
        open_regular(path, inside).close()
    except (OSError, ValueError):  # ValueError: what a stranger wrote is no path
        return False
    return True


def check_links(path: Path, inside: Path) -> None:
    """Refuse a path, of a file or a folder below a directory, that is a link or leads over one.

    Raises
    ------
    NotRegularFileError
        It does, or does not lie there.
    """
    place, names = inside, path.relative_to(inside).parts
    if ".." in names:
        raise NotRegularFileError(path, f"does not lie in {inside}")
    for name in names:
        place = place / name
        if place.is_symlink():
            raise NotRegularFileError(place, f"{name} is a link, which is not followed")
