"""Files of one recording that a recorder split or restarted, beside one another: ``drive_{0..3}.bag``.

Such a path names all files from the first to the last one in the braces, in the order of their numbers or dates. It is
a path like any other: commands take it, tables show it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from threading import Event
from typing import NamedTuple

from icrtool.logs.containers.one_recording import LOG_SUFFIXES, unpacked_name
from icrtool.records.regular_file import open_regular
from icrtool.records.samples import InputFile
from icrtool.records.urls import UrlPath

_NAME = re.compile(r"^(|.*?[_\-. ])((?:19|20)\d\d[\d_.\-T]*|\d+)(\.[A-Za-z]\w*)$")
"""What comes before a count or a date, the count or date (and count), the suffix."""

STANDARD_INPUT = Path("-")
"""Stands for the log that is given on standard input."""

_RANGE = re.compile(r"^(.*)\{([\d_.\-T]+?)\.\.([\d_.\-T]+)\}(\.[A-Za-z]\w*)$")


class NumberedFile(NamedTuple):
    """A file whose name ends with a count or a date.

    Attributes
    ----------
    series : what all files of a series share: their folder, the begin of their names, their suffix
    number : the count or date as it is written
    order : its numbers
    """

    series: tuple[Path, str, str]
    number: str
    order: tuple[int, ...]
    path: Path

    @property
    def is_count(self) -> bool:
        """Whether it is a count, which goes up by one."""
        return len(self.order) == 1 and self.number.isdecimal()


def numbered_file(path: Path) -> NumberedFile | None:
    """Return a file's place in a series; None where its name has no count and no date."""
    match = _NAME.match(path.name)
    if match is None:
        return None
    order = tuple(int(part) for part in re.findall(r"\d+", match[2]))
    return NumberedFile((path.parent, match[1], match[3]), match[2], order, path)


def split_path(files: Sequence[Path]) -> Path:
    """Return the path that stands for several files of one series, in their order."""
    first, last = numbered_file(files[0]), numbered_file(files[-1])
    if first is None or last is None or first.series != last.series:
        raise ValueError("files: not of one series")
    folder, begin, suffix = first.series
    return folder / f"{begin}{{{first.number}..{last.number}}}{suffix}"


def split_files(path: Path) -> list[Path]:
    """Return the files that a path with a range names, in their order; none where it is another path."""
    match = _RANGE.match(path.name)
    if match is None or path.exists() or not path.parent.is_dir():
        return []
    first, last = (numbered_file(path.with_name(f"{match[1]}{number}{match[4]}")) for number in (match[2], match[3]))
    if first is None or last is None:
        return []
    beside = (numbered_file(file) for file in path.parent.iterdir() if file.name.startswith(match[1]))
    return in_order(one for one in beside if one is not None and one.series == first.series
                    and first.order <= one.order <= last.order)  # fmt: skip


def in_order(files: Iterable[NumberedFile]) -> list[Path]:
    """Return the paths of files in the order of their counts or dates."""
    return [one.path for one in sorted(files, key=lambda one: (one.order, one.number))]


def files_of_log(path: Path) -> list[Path]:
    """Return the files of a log: all of a directory, those of a range, or the one file."""
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.is_file())
    return split_files(path) or [path]


def log_name(path: Path) -> str:
    """Return a log's name: that of its (first) file without suffix, or of the directory; ``log`` where it is only dots.

    Runs are directories of this name: ``..mcap`` must not be the directory of all runs, nor ``..`` the one above it.
    """
    if path == STANDARD_INPUT:
        return "stdin"
    files = split_files(path)
    named = path if isinstance(path, UrlPath) else Path(os.path.normpath((files[0] if files else path).absolute()))
    name = named.name
    if not named.is_dir():
        plain = unpacked_name(name)
        name = Path(plain).stem if plain == name or Path(plain).suffix in {*LOG_SUFFIXES, ".csv"} else plain
    return name if name.strip(".") else "log"


def inputs_of(files: Iterable[Path], ended: Event) -> tuple[InputFile, ...]:
    """Return files with their size and SHA-256, as `file_sha256`."""
    return tuple(InputFile(str(file), file.stat().st_size, file_sha256(file, ended)) for file in files)


def file_sha256(file: Path, ended: Event | None = None) -> str:
    """Return the SHA-256 of a file (hex), of its beginning once `ended` is set."""
    import hashlib

    digest, piece = hashlib.sha256(), bytearray(1 << 18)
    with open_regular(file) as stream:
        while not (ended and ended.is_set()) and (count := stream.readinto(piece)):
            digest.update(memoryview(piece)[:count])
    return digest.hexdigest()
