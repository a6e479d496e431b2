"""Files and directories that appear whole or not at all, and replace nothing that somebody else put there.

Each is written and synced under a hidden name beside its place, then put there (`icrtool.output.files.disk`).
``.icrtool-files`` in a directory lists what was written there with it: all else is kept where that is replaced.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Literal

import msgspec

from icrtool.errors import OutputError
from icrtool.output.files import disk
from icrtool.records.places import check_links, open_regular, read_regular
from icrtool.records.plain_data import Record
from icrtool.records.process_resources import with_parents
from icrtool.records.text import escaped, listed

IsOurs = Callable[[Path], bool]
"""Whether a directory is one that we wrote and may replace."""

IsOurFile = Callable[[bytes], bool]
"""Whether a file, of which the first bytes are given, is one that we wrote and may replace."""

OWN_FILES = ".icrtool-files"
"""List of the files that were written with a directory: `OwnFiles` as JSON."""

EXPORTED_MCAP = b"icrtool export"
"""Library in the header of an MCAP file that `icrtool export` wrote: it is no log of somebody's."""

PACKED = (b"\x28\xb5\x2f\xfd", b"\x1f\x8b", b"BZh", b"\x04\x22\x4d\x18")
"""How files packed with zstd, gzip, bzip2 and lz4 begin: nothing that icrtool writes, and perhaps a log."""

FIRST_BYTES = 4096


@contextmanager
def reported(path: Path) -> Iterator[None]:
    """Raise an OSError of the block as an OutputError of a place."""
    try:
        yield
    except OSError as err:
        raise OutputError(path, "cannot be written", err.strerror or str(err)) from err


def check_place(path: Path, inside: Path | None = None, ours: IsOurFile | None = None) -> None:
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
    with reported(path):
        if not _place_of_file(path, inside, ours).parent.is_dir():
            raise OutputError(path, "its directory does not exist", "make it first, or name another file")


def _place_of_file(path: Path, inside: Path | None, ours: IsOurFile | None) -> Path:
    """Return the place of a file without links; parameters and errors as of `check_place`."""
    place = Path(os.path.realpath(path if inside is None else path.parent))
    if inside is not None:
        check_links(path.parent, inside)
        place /= path.name
        if place.is_symlink() and not place.is_dir():
            return place  # it is replaced itself
    if place.is_dir():
        raise OutputError(path, "is a directory", "name a file")
    if place.exists():
        if not place.is_file():
            raise OutputError(path, "is a device or pipe, which would be replaced", "name a file")
        from icrtool.logs.containers.open_log import container_of

        try:
            with open_regular(place) as stream:
                first = stream.read(FIRST_BYTES)
                is_log = container_of(stream) is not None and EXPORTED_MCAP not in first[:64]
        except PermissionError:
            return place  # it may be replaced without being read
        if is_log or first.startswith(PACKED):
            raise OutputError(path, "a log is there", "it is left alone; name another file")
        if ours is not None and first and not ours(first):
            why = "a file that icrtool did not write is there"
            raise OutputError(path, why, "it is left alone; name another place")
    return place


def is_page(first: bytes) -> bool:
    """Return whether a file is a page of ours, by its first bytes."""
    return b"icrtool</title>" in first


def check_directory(directory: Path, ours: IsOurs, *, kind: str, inside: Path | None = None) -> None:
    """Refuse a place where a directory of ours cannot be put; restore what a killed process renamed aside.

    Parameters
    ----------
    directory : where it shall appear; nothing, an empty directory and one of ours may be there
    ours : whether a directory may be replaced
    kind : what is being written, for the message ("run directory")
    inside : a directory above it; below that no link is followed. None: the user named `directory`, and links are

    Raises
    ------
    OutputError
        A file or a foreign directory is there; the place is inside a directory of this kind, holds one, or is a mount
        point; or nothing can be known about the place.
    """
    why, advice = "", "it is left alone; name another place"
    with reported(directory):
        if inside is not None:
            check_links(directory, inside)
        # Unlike `Path.resolve`, this takes a link that leads to itself as it is.
        place = Path(os.path.realpath(directory))
        restore(place, ours)
        if outer := next((parent for parent in place.parents if ours(parent)), None):
            why, advice = f"lies inside the {kind} {outer}", "name a place outside it"
        elif file := next((one for one in (place, *place.parents) if one.exists() and not one.is_dir()), None):
            why = "a file is there" if file == place else f"{file} is a file"
            advice = f"name another place for the {kind}"
        elif not place.exists():
            return
        elif not ours(place) and own_files(place).kind != kind and any(place.iterdir()):
            why = f"holds something that is not a {kind}"
        elif inner := next((one for one in place.glob("**/*/") if ours(one)), None):
            why = f"holds another {kind} ({inner.relative_to(place)})"
        elif place.is_mount():
            why, advice = "is a mount point, which cannot be replaced", "name a directory in it"
    if why:
        raise OutputError(directory, why, advice)


def restore(directory: Path, ours: IsOurs) -> None:
    """Rename an old directory back to its place, where a killed process left it aside and put nothing there.

    Raises
    ------
    OSError
        It cannot be renamed.
    """
    place = Path(os.path.realpath(directory))
    if not os.path.lexists(place):
        aside = [path for path in disk.hidden(place, ".old") if ours(path) or own_files(path).kind]
        if aside:
            max(aside, key=lambda path: path.stat().st_mtime_ns).rename(place)


class OwnFiles(Record, frozen=True):
    """What icrtool wrote in a directory, as its list states.

    Attributes
    ----------
    kind : of directory; empty where no list states one
    files : relative to the directory
    made_from : absolute paths of the files that the directory was made from
    """

    kind: str = ""
    files: frozenset[str] = frozenset()
    made_from: frozenset[str] = frozenset()
    schema: Literal["icrtool/files/1"] = "icrtool/files/1"


def own_files(directory: Path) -> OwnFiles:
    """Return what the list of a directory states; nothing where it has none."""
    try:
        return msgspec.convert(json.loads(read_regular(directory / OWN_FILES, directory)), OwnFiles)
    except (OSError, ValueError, RecursionError):
        return OwnFiles()


def files_in(directory: Path) -> list[PurePosixPath]:
    """Return all that is no directory, links to directories included, relative to `directory`."""
    found = (path for path in directory.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(PurePosixPath(path.relative_to(directory).as_posix()) for path in found)


def _write_own_files(directory: Path, own: OwnFiles) -> None:
    """Write the list of a directory that is about to be put in place."""
    document = {"schema": own.schema, "kind": own.kind, "files": sorted(own.files), "made_from": sorted(own.made_from)}
    (directory / OWN_FILES).write_text(json.dumps(document, indent=0) + "\n", encoding="utf-8")


def _keep_foreign(place: Path, partial: Path, names: Collection[str]) -> str:
    """Give the files that icrtool did not write a second name in the directory that replaces theirs.

    Parameters
    ----------
    partial : the new directory, in which its list is not yet written
    names : as in `atomic_directory`

    Returns
    -------
    str
        A line about what the replacement removes and keeps; empty where that is nothing.

    Raises
    ------
    OutputError
        One has the name of a directory of ours, or ours of one of its directories.
    """
    new, there = files_in(partial), files_in(place)
    parents = {parent for path in there for parent in path.parents}
    of_lists = {parent / name for parent in parents for name in own_files(place / parent).files}
    own = {path for path in there if path.name == OWN_FILES or str(path) in names or path in of_lists}
    removed = [path for path in there if path in own and path not in new and path.name != OWN_FILES]
    foreign = [path for path in there if path not in own]
    kept = [path for path in foreign if not os.path.lexists(partial / path)]
    if lost := [path for path in foreign if path not in kept and path not in new]:
        raise OutputError(place, f"holds {_names(lost, ())}, which icrtool did not write", "move it elsewhere first")
    for path in kept:
        disk.link(place / path, partial / path)
        # A directory of ours that it lies in stays one: its next content replaces it.
        for parent in list(path.parents)[:-1]:
            if kind := own_files(place / parent).kind:
                _write_own_files(partial / parent, OwnFiles(kind))
    tops = {path.parts[0] for path in new}
    parts = [f"removed {_names(removed, tops)}"] if removed else []
    parts += [f"kept {_names(kept, tops)}, not written by icrtool"] if kept else []
    return f"replaced: {'; '.join(parts)}" if parts else ""


def _names(paths: Collection[PurePosixPath], tops: Collection[str]) -> str:
    """Return names in a line; a directory at the top stands for its files unless it is one of `tops`."""
    names = dict.fromkeys(
        f"{path.parts[0]}/" if len(path.parts) > 1 and path.parts[0] not in tops else str(path) for path in paths
    )
    return escaped(listed(list(names)))


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
        place = _place_of_file(file, inside, ours)
        with disk.beside(place, lambda new: new.touch(exist_ok=False)) as partial:
            yield partial
            disk.sync(partial)
            disk.put(partial, _place_of_file(file, inside, ours))


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
        check_links(folder, inside)
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
    place = Path(os.path.realpath(directory))
    with reported(directory), with_parents(place) as made, disk.beside(place, Path.mkdir) as partial:
        for parent in made:
            disk.sync(parent.parent)
        yield partial
        check_directory(directory, ours, kind=kind, inside=inside)
        own = OwnFiles(kind, frozenset(map(str, files_in(partial))), frozenset(made_from))
        done = _keep_foreign(place, partial, names) if place.exists() else ""
        _write_own_files(partial, own)
        disk.sync_tree(partial)
        disk.put(partial, place)
    if note is not None and done:
        note(f"{directory}: {done}")
