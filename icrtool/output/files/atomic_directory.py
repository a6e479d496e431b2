"""A directory that appears whole or not at all, and is replaced in one step.

The new directory is written and synced under a hidden name beside its place. Then both exchange their names
(``renameat2`` of Linux, ``renamex_np`` of macOS). Where platform or file system cannot, the old one is renamed aside
first; a process that is killed between the two renames leaves it there, and the next one renames it back.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from icrtool.errors import OutputError
from icrtool.output.files import disk
from icrtool.output.files.own_files import OWN_FILES, carry, files_by_owner, files_in, kind_of, write_own_files
from icrtool.records.regular_file import check_folders
from icrtool.records.text import escaped, listed
from icrtool.records.unfinished import end, unfinished

IsOurs = Callable[[Path], bool]
"""Whether a directory is one that we wrote and may replace."""


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
    try:
        if inside is not None:
            check_folders(directory, inside)
        place = _resolved(directory)
        outer = next((parent for parent in place.parents if ours(parent)), None)
        if outer is not None:
            raise OutputError(directory, f"lies inside the {kind} {outer}", "name a place outside it")
        restore(place, ours)
        if not place.exists():
            _check_parent(place)
        elif not place.is_dir():
            raise OutputError(directory, "a file is there", f"name another place for the {kind}")
        elif not _is_ours(place, ours, kind) and any(place.iterdir()):
            raise OutputError(
                directory, f"holds something that is not a {kind}", "it is left alone; name another place"
            )
        elif (inner := _inner(place, ours)) is not None:
            raise OutputError(directory, f"holds another {kind} ({inner})", "it is left alone; name another place")
        elif place.is_mount():
            raise OutputError(directory, "is a mount point, which cannot be replaced", "name a directory in it")
    except OSError as err:
        raise OutputError(directory, "cannot be written", err.strerror or str(err)) from err


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
    made: list[Path] = []
    try:
        place = _resolved(directory)
        made = [parent for parent in place.parents if not parent.exists()][::-1]
        _make_parents(place, made)
        with hidden_directory(place, names) as partial:
            yield partial
            check_directory(directory, ours, kind=kind, inside=inside)
            done = _put(partial, place, kind, names, made_from)
        made = []
        if note is not None and done:
            note(f"{directory}: {done}")
    except OSError as err:
        raise OutputError(directory, "cannot be written", err.strerror or str(err)) from err
    finally:
        for parent in reversed(made):
            with suppress(OSError):
                parent.rmdir()


@contextmanager
def hidden_directory(place: Path, names: Collection[str] = ()) -> Iterator[Path]:
    """Give a new directory beside a place, and remove it at the end; those of killed processes are removed first.

    Parameters
    ----------
    place : without links
    names : as in `atomic_directory`

    Raises
    ------
    OSError
        It cannot be made.
    """
    for left in disk.hidden(place, ".partial", ".old"):
        _clean(left, place, names)
    partial = disk.hidden_name(place, ".partial")
    try:
        with unfinished(partial):
            partial.mkdir()
            with disk.locked(partial):
                yield partial
    finally:
        _discard(partial, place, names)


def restore(directory: Path, ours: IsOurs) -> None:
    """Rename an old directory back to its place, where a killed process left it aside and put nothing there.

    Raises
    ------
    OSError
        It cannot be renamed.
    """
    place = _resolved(directory)
    if os.path.lexists(place):
        return
    aside = [path for path in disk.hidden(place, ".old") if ours(path) or kind_of(path) is not None]
    if aside:
        disk.rename(max(aside, key=lambda path: path.stat().st_mtime_ns), place)


def _put(partial: Path, place: Path, kind: str, names: Collection[str], made_from: Sequence[str]) -> str:
    """Move `partial` to `place`; return a line about what the replacement removed and kept, empty where nothing."""
    new = set(files_in(partial))
    write_own_files(partial, kind, made_from)
    removed: list[PurePosixPath] = []
    kept: list[PurePosixPath] = []
    replaces = place.exists()
    if replaces:
        own, foreign = files_by_owner(place, names)
        removed = [path for path in own if path not in new and path.name != OWN_FILES]
        kept = carry(place, partial, foreign)
        if lost := [path for path in foreign if path not in kept and path not in new]:
            raise OutputError(
                place, f"holds {_listed(lost, set())}, which icrtool did not write", "move it elsewhere first"
            )
    disk.sync_tree(partial)
    # From here on its name may be that of the old directory, whose files are looked after below.
    end(partial)
    old = exchange(partial, place, partial.with_suffix(".old")) if replaces else None
    if old is None:
        disk.rename(partial, place)
    disk.sync(place.parent)
    if old is not None:
        # Whoever put a file into the old directory in the meantime keeps it too.
        kept += carry(old, place, files_by_owner(old, names)[1])
        disk.remove(old)
    tops = {path.parts[0] for path in new}
    parts = [f"removed {_listed(removed, tops)}"] if removed else []
    parts += [f"kept {_listed(kept, tops)}, not written by icrtool"] if kept else []
    return f"replaced: {'; '.join(parts)}" if parts else ""


def exchange(partial: Path, place: Path, old: Path) -> Path:
    """Put `partial` into the place of a directory; return where the old one is now.

    Parameters
    ----------
    old : a hidden name beside the place, used where two directories cannot be exchanged in one step; `restore` finds it
    """
    if disk.exchange(partial, place):
        return partial
    try:
        disk.rename(place, old)
        disk.rename(partial, place)
    except BaseException:
        if old.exists() and not os.path.lexists(place):
            disk.rename(old, place)
        raise
    return old


def _clean(left: Path, place: Path, names: Collection[str]) -> None:
    """Remove what a killed process left beside the place."""
    # What was renamed aside is needed as long as nothing is in its place.
    if disk.is_abandoned(left) and (left.suffix == ".partial" or place.exists()):
        _discard(left, place, names)


def _discard(left: Path, place: Path, names: Collection[str]) -> None:
    """Remove a hidden directory; where it was in place once, foreign files that only it holds are kept."""
    with suppress(OSError):
        if kind_of(left) is not None and place.is_dir():
            carry(left, place, files_by_owner(left, names)[1])
        disk.remove(left)


def _is_ours(place: Path, ours: IsOurs, kind: str) -> bool:
    return ours(place) or kind_of(place) == kind


def _inner(place: Path, ours: IsOurs) -> Path | None:
    """Return a directory of the same kind below a place."""
    for folder, folders, _ in os.walk(place):
        for name in folders:
            if ours(inner := Path(folder, name)):
                return inner.relative_to(place)
    return None


def _resolved(directory: Path) -> Path:
    # Unlike Path.resolve it takes a link that leads to itself as it is.
    return Path(os.path.realpath(directory))


def _check_parent(directory: Path) -> None:
    """Refuse a place below a file."""
    for parent in directory.parents:
        if parent.exists():
            if not parent.is_dir():
                raise OutputError(directory, f"{parent} is a file", "name another place")
            return


def _make_parents(place: Path, missing: Collection[Path]) -> None:
    """Make the missing parents of `place`."""
    place.parent.mkdir(parents=True, exist_ok=True)
    for parent in missing:
        disk.sync(parent.parent)


def _listed(paths: Collection[PurePosixPath], tops: Collection[str]) -> str:
    """Return names in a line; a directory at the top stands for its files unless it is one of `tops`."""
    names = dict.fromkeys(
        f"{path.parts[0]}/" if len(path.parts) > 1 and path.parts[0] not in tops else str(path) for path in paths
    )
    return escaped(listed(list(names)))
