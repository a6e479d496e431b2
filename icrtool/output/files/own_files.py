"""Which files of a directory icrtool wrote, so that a replacement keeps those that somebody else put there."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path, PurePosixPath

from icrtool.output.files import disk
from icrtool.records.regular_file import read_regular

OWN_FILES = ".icrtool-files"
"""List of the files that were written with a directory: JSON with `schema`, `kind`, `files` and `made_from`."""

SCHEMA = "icrtool/files/1"


def write_own_files(directory: Path, kind: str, made_from: Sequence[str] = ()) -> None:
    """Write the list of all files in a directory that is about to be put in place.

    Parameters
    ----------
    made_from : absolute paths of the files that its content was made from
    """
    files = sorted(path.as_posix() for path in files_in(directory))
    _write(directory / OWN_FILES, kind, files, made_from)


def kind_of(directory: Path) -> str | None:
    """Return the kind of directory that icrtool wrote here; None where no list of its files states one."""
    document = _read(directory)
    return document[0] if document is not None else None


def made_from(directory: Path) -> frozenset[str]:
    """Return the absolute paths of the files that a directory of ours was made from; empty where no list has them."""
    document = _read(directory)
    return document[2] if document is not None else frozenset()


def files_by_owner(directory: Path, names: Collection[str]) -> tuple[list[PurePosixPath], list[PurePosixPath]]:
    """Return the files below a directory that icrtool wrote, and all others, relative to it.

    Parameters
    ----------
    names : files at the top that are icrtool's though no list has them: they are written later than the directory
    """
    files = list(files_in(directory))
    lists: dict[PurePosixPath, frozenset[str]] = {}
    for parent in {parent for path in files for parent in path.parents}:
        document = _read(directory / parent)
        lists[parent] = document[1] if document is not None else frozenset()

    def is_own(path: PurePosixPath) -> bool:
        listed = any(str(path.relative_to(parent)) in lists[parent] for parent in path.parents)
        return listed or path.name == OWN_FILES or str(path) in names

    own = [path for path in files if is_own(path)]
    return own, sorted(set(files) - set(own))


def carry(source: Path, target: Path, files: list[PurePosixPath]) -> list[PurePosixPath]:
    """Give files of one directory a second name in another, where that has none of the same name.

    A directory of ours below `source` that some of them lie in stays one in `target`: its next content replaces it.

    Returns
    -------
    list of PurePosixPath
        Those that are in both directories now.

    Raises
    ------
    OSError
        One cannot be linked or copied.
    """
    carried = []
    for file in files:
        if not os.path.lexists(target / file):
            for parent in list(file.parents)[:-1]:
                kind = kind_of(source / parent)
                if kind is not None and not (target / parent / OWN_FILES).exists():
                    (target / parent).mkdir(parents=True, exist_ok=True)
                    _write(target / parent / OWN_FILES, kind, [])
            disk.link(source / file, target / file)
            carried.append(file)
    return carried


def files_in(directory: Path) -> Iterator[PurePosixPath]:
    """Yield all that is no directory, links to directories included, relative to `directory`."""
    for folder, folders, names in os.walk(directory):
        here = Path(folder)
        links = [name for name in folders if (here / name).is_symlink()]
        for name in (*links, *names):
            yield PurePosixPath((here / name).relative_to(directory).as_posix())


def _write(file: Path, kind: str, files: list[str], made_from: Sequence[str] = ()) -> None:
    document = {"schema": SCHEMA, "kind": kind, "files": files, "made_from": list(made_from)}
    file.write_text(json.dumps(document, indent=0) + "\n", encoding="utf-8")


def _read(directory: Path) -> tuple[str, frozenset[str], frozenset[str]] | None:
    try:
        document = json.loads(read_regular(directory / OWN_FILES, directory))
        if document["schema"] == SCHEMA:
            files, sources = (frozenset(map(str, document.get(key, ()))) for key in ("files", "made_from"))
            return str(document["kind"]), files, sources
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        pass
    return None
