"""A directory that appears whole or not at all."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from icrtool.errors import OutputError

IsOurs = Callable[[Path], bool]
"""Whether a directory is one that we wrote and may replace."""


def check_place(directory: Path, ours: IsOurs, *, kind: str) -> None:
    """Refuse a place where a directory of ours cannot be put.

    Parameters
    ----------
    directory : where it shall appear; nothing, an empty directory and one of ours may be there
    ours : whether a directory may be replaced
    kind : what is being written, for the message ("run directory")

    Raises
    ------
    OutputError
        A file or a foreign directory is there, or nothing can be known about the place.
    """
    try:
        if not directory.exists():
            _check_parent(directory)
        elif not directory.is_dir():
            raise OutputError(directory, "a file is there", f"name another place for the {kind}")
        elif not ours(directory) and any(directory.iterdir()):
            raise OutputError(
                directory, f"holds something that is not a {kind}", "it is left alone; name another place"
            )
    except OSError as err:
        raise OutputError(directory, "cannot be written", err.strerror or str(err)) from err


@contextmanager
def atomic_directory(directory: Path, ours: IsOurs, *, kind: str) -> Iterator[Path]:
    """Give a hidden directory to write into; put it in place when the block ends well, remove it otherwise.

    Parameters
    ----------
    directory, ours, kind : as in `check_place`

    Yields
    ------
    Path
        A new empty directory beside `directory`.

    Raises
    ------
    OutputError
        As `check_place`, and for every OSError of the block (disk full, no permission).
    """
    check_place(directory, ours, kind=kind)
    made: list[Path] = []
    partial: Path | None = None
    try:
        place = directory.resolve()
        made = _make_parents(place)
        partial = place.with_name(f".{place.name}.{secrets.token_hex(4)}.partial")
        partial.mkdir()
        yield partial
        check_place(place, ours, kind=kind)
        _put(partial, place)
        made = []
    except OSError as err:
        raise OutputError(directory, "cannot be written", err.strerror or str(err)) from err
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
        for parent in reversed(made):
            with suppress(OSError):
                parent.rmdir()


def _check_parent(directory: Path) -> None:
    """Refuse a place below a file."""
    for parent in directory.absolute().parents:
        if parent.exists():
            if not parent.is_dir():
                raise OutputError(directory, f"{parent} is a file", "name another place")
            return


def _make_parents(place: Path) -> list[Path]:
    """Make the missing parents of `place`; return those made, outermost first."""
    missing = [parent for parent in place.parents if not parent.exists()]
    place.parent.mkdir(parents=True, exist_ok=True)
    return missing[::-1]


def _put(partial: Path, place: Path) -> None:
    """Move `partial` to `place`, an old directory there aside first and back again if that fails."""
    if not place.exists():
        partial.rename(place)
        return
    old = partial.with_suffix(".old")
    place.rename(old)
    try:
        partial.rename(place)
    except BaseException:
        old.rename(place)
        raise
    # The new one stands; what cannot be removed of the old one is hidden and hurts nobody.
    shutil.rmtree(old, ignore_errors=True)
