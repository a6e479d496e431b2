"""Files and directories that appear whole or not at all.

Each is written and synced under a hidden name beside its place. A file is then renamed; a directory exchanges its name
with the old one (``renameat2`` of Linux, ``renamex_np`` of macOS). Where platform or file system cannot exchange, the
old one is renamed aside first; where a process is killed between both renames, the next one renames it back.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from icrtool.output.files import disk
from icrtool.output.files.own_files import (
    IsOurFile,
    IsOurs,
    OwnFiles,
    check_directory,
    files_in,
    keep_foreign,
    place_of_file,
    real_place,
    reported,
    write_own_files,
)  # fmt: skip
from icrtool.records.process_resources import end, remove, unfinished, with_parents
from icrtool.records.regular_file import check_folders


@contextmanager
def atomic_file(file: Path, inside: Path | None = None, ours: IsOurFile | None = None) -> Iterator[Path]:
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
    with reported(file):
        place = place_of_file(file, inside, ours)
        with _hidden(place, lambda new: new.touch(exist_ok=False)) as partial:
            yield partial
            disk.sync(partial)
            partial.replace(place_of_file(file, inside, ours))
        disk.sync(place.parent)


def write_file(file: Path, content: str | bytes, inside: Path | None = None, ours: IsOurFile | None = None) -> None:
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


def make_folders(folder: Path, inside: Path) -> None:
    """Make a folder below a directory, and those between, where they are not there; no link is followed.

    Raises
    ------
    OutputError
        A link or a file is in its place, or it cannot be made.
    """
    with reported(folder):
        check_folders(folder, inside)
        folder.mkdir(parents=True, exist_ok=True)


@contextmanager
def atomic_directory(
    directory: Path,
    ours: IsOurs,
    *,
    kind: str,
    inside: Path | None = None,
    names: Collection[str] = (),
    made_from: Sequence[str] = (),
    note: Callable[[str], None] | None = None,
) -> Iterator[Path]:
    """Give a hidden directory to write into; put it in place when the block ends well, remove it otherwise.

    Files in the old directory that icrtool did not write are kept in the new one.

    Parameters
    ----------
    directory, ours, kind, inside : as in `check_directory`
    names : names at the top of the directory that are icrtool's though they are written later (``report.html``)
    made_from : absolute paths of the files that the content is made from
    note : called with one line where the replacement removed files that it did not write again, or kept foreign ones

    Yields
    ------
    Path
        A new empty directory beside `directory`.

    Raises
    ------
    OutputError
        As `check_directory`, and for every OSError of the block (disk full, no permission).
    """
    check_directory(directory, ours, kind=kind, inside=inside)
    place = real_place(directory)
    with reported(directory), with_parents(place) as made, _hidden(place, Path.mkdir) as partial:
        for parent in made:
            disk.sync(parent.parent)
        yield partial
        check_directory(directory, ours, kind=kind, inside=inside)
        own = OwnFiles(kind, frozenset(map(str, files_in(partial))), frozenset(made_from))
        done = keep_foreign(place, partial, names) if place.exists() else ""
        write_own_files(partial, own)
        disk.sync_tree(partial)
        put(partial, place)
    if note is not None and done:
        note(f"{directory}: {done}")


@contextmanager
def hidden_directory(place: Path) -> Iterator[Path]:
    """Give a new directory beside a place (without links), and remove what has its name at the end.

    Raises
    ------
    OSError
        It cannot be made.
    """
    with _hidden(place, Path.mkdir) as partial:
        yield partial


@contextmanager
def _hidden(place: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """Make a file or directory under a hidden name beside a place, and remove what has that name at the end.

    What killed processes left there is removed too.
    """
    # What was renamed aside is needed as long as nothing is in its place.
    for left in disk.hidden(place, ".partial") + (disk.hidden(place, ".old") if place.exists() else []):
        if disk.is_abandoned(left):
            remove(left)
    partial = disk.hidden_name(place)
    with unfinished(partial):
        try:
            make(partial)
            with disk.locked(partial):
                yield partial
        finally:
            remove(partial)


def put(partial: Path, place: Path, aside: Path | None = None) -> None:
    """Put a hidden directory in its place, and remove what was there.

    Parameters
    ----------
    aside : hidden name beside the place where the old one is meanwhile, if need be; default: that of `partial`

    Raises
    ------
    OSError
        It cannot be renamed; what was there still is.
    """
    # From here on its name may be that of the old directory, which has to stay where this process is ended by force.
    end(partial)
    old = partial
    if not place.exists():
        partial.rename(place)
    elif not disk.exchange(partial, place):
        old = (aside or partial).with_suffix(".old")
        place.rename(old)
        try:
            partial.rename(place)
        except BaseException:
            if not place.exists():
                old.rename(place)
            raise
    with unfinished(old):
        disk.sync(place.parent)
        remove(old)
