"""A file that appears whole or not at all."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from icrtool.errors import OutputError


@contextmanager
def atomic_file(file: Path) -> Iterator[Path]:
    """Give a path beside a file to write to; at the end of the block it is moved to its place.

    Raises
    ------
    OutputError
        For every OSError of the block (disk full, no permission); what was there before still is.
    """
    partial = file.with_name(f".{file.stem}.{secrets.token_hex(4)}.partial{file.suffix.lower()}")
    try:
        yield partial
        partial.replace(file)
    except OSError as err:
        raise OutputError(file, "cannot be written", err.strerror or str(err)) from err
    finally:
        # Where nothing can be written nothing can be removed either; the error already states why.
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def check_place(path: Path) -> None:
    """Refuse a file whose directory is not there, before any work is done for it.

    Raises
    ------
    OutputError
        The directory is missing, or `path` is one itself.
    """
    if not path.absolute().parent.is_dir():
        raise OutputError(path, "its directory does not exist", "make it first, or name another file")
    if path.is_dir():
        raise OutputError(path, "is a directory", "name a file")
