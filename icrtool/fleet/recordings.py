"""Find the recordings in files and folders, by content, and name the run of each."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from icrtool.errors import LogError
from icrtool.logs.containers.open_log import container_of, open_log
from icrtool.logs.containers.recording_files import (
    LEAST_OVERLAP_S,
    LOG_SUFFIXES,
    NumberedFile,
    is_bag_directory,
    log_name,
    natural_order,
    numbered_file,
    split_files,
    split_path,
    unpacked_name,
)
from icrtool.logs.containers.source import find
from icrtool.logs.containers.sqlite_bag import SqliteBag
from icrtool.records.urls import UrlPath

RUN_FILE = "run.json"

OWN_FILES = (RUN_FILE, "fleet.json", "study.json")
"""A folder that holds one of these is a result, not a place of recordings."""

LONGEST_RESTART_S = 60.0
"""A recorder that was restarted begins again within this time; two drives are further apart."""

FIRST_BYTES = 65536
"""The tables of an SQLite file are named on its first page, which is at most this long."""


@dataclass(frozen=True, slots=True)
class FoundRecording:
    """One recording.

    Attributes
    ----------
    path : as `icrtool.read_log` takes it
    name : path of its run below ``runs/``, unique in the batch
    log : path below the common parent of what was searched, as tables show it
    """

    path: Path
    name: str
    log: str


def find_recordings(places: Sequence[Path]) -> list[FoundRecording]:
    """Return the recordings among files and, searched recursively, folders; each once, in the order of their paths.

    Raises
    ------
    LogError
        A place does not exist, or there is no recording in any of them.
    """
    for place in places:
        if not (isinstance(place, UrlPath) or place.exists() or split_files(place)):
            raise LogError(place, "no such file or directory")
    logs, _ = logs_among(places)
    found = joined({os.path.realpath(log): log for log in logs if not log.is_dir() or is_bag_directory(log)})
    if not found:
        what = places[0] if len(places) == 1 else f"{len(places)} places"
        raise LogError(what, "no recording in it", "a log is an .mcap, .bag or .db3 file, or a ROS 2 bag directory")
    root = common_parent(places if not any(isinstance(place, UrlPath) for place in places) else list(found.values()))
    return _named(sorted(found.values(), key=natural_order), root)


def joined(found: Mapping[str, Path]) -> dict[str, Path]:
    """Return recordings with the files of a split one, or of a recorder that was restarted, as one.

    They are files of one folder whose names differ only in a count or a date, that have the same topics, and of which
    each begins at most `LONGEST_RESTART_S` after the end of the one before it. A file without index has no known end.

    Parameters
    ----------
    found : paths by real path; a file of a range that is there too is left out
    """
    of_ranges = {os.path.realpath(file) for path in found.values() for file in split_files(path)}
    single = {real: path for real, path in found.items() if real not in of_ranges}
    series: dict[tuple[Path, str, str], list[NumberedFile]] = {}
    for path in single.values():
        if path.suffix in LOG_SUFFIXES and path.is_file() and (one := numbered_file(path)) is not None:
            series.setdefault(one.series, []).append(one)
    replaced: dict[Path, Path] = {}
    for files in series.values():
        for group in _consecutive(sorted(files, key=lambda one: one.order)) if len(files) > 1 else ():
            replaced |= dict.fromkeys(group, split_path(group))
    paths = dict.fromkeys(replaced.get(path, path) for path in single.values())
    return {os.path.realpath(path): path for path in paths}


def _consecutive(files: Sequence[NumberedFile]) -> list[list[Path]]:
    """Return the groups of two and more files that follow one another in time."""
    extents = [_extent(one.path) for one in files]
    groups: list[list[Path]] = [[files[0].path]]
    for (one, before), (other, after) in pairwise(zip(files, extents, strict=True)):
        counted = not one.is_count or other.order[0] == one.order[0] + 1
        if counted and before is not None and after is not None and before.goes_on_in(after):
            groups[-1].append(other.path)
        else:
            groups.append([other.path])
    return [group for group in groups if len(group) > 1]


class Extent(NamedTuple):
    """When a file was recorded [ns], and its topics with their types."""

    begin_ns: int
    end_ns: int
    topics: frozenset[tuple[str, str]]

    def goes_on_in(self, other: Extent) -> bool:
        """Return whether another file continues where this one ends, with at least half of the topics in common."""
        pause_s = (other.begin_ns - self.end_ns) / 1e9
        fewer = min(len(self.topics), len(other.topics))
        in_common = 2 * len(self.topics & other.topics) >= fewer > 0
        return -LEAST_OVERLAP_S < pause_s <= LONGEST_RESTART_S and in_common


def _extent(path: Path) -> Extent | None:
    """Return when a file was recorded, by its index; None where it has none or cannot be read."""
    try:
        container = open_log(path)
    except LogError:
        return None
    try:
        span = container.span_ns()
        topics = frozenset((channel.topic, channel.message_type) for channel in container.channels)
    finally:
        container.close()
    return Extent(*span, topics) if span is not None else None


def logs_among(places: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Return the logs that a command is to use, each once, and the files beside them that are no logs.

    A folder that is no recording and no run stands for the recordings below it, if there are any. A file that only has
    the name of a recording among `places` (``drive.json`` beside ``drive.mcap``, from a pattern of the shell) is left
    out.
    """
    found: dict[str, Path] = {}
    for place in places:
        if isinstance(place, UrlPath):
            found |= {path.url: path for path in find(place)}
            continue
        searched = place.is_dir() and not is_bag_directory(place) and not (place / RUN_FILE).is_file()
        below = {os.path.realpath(path): path for path in sorted(_search(place), key=natural_order)} if searched else {}
        for real, path in (joined(below) or {os.path.realpath(place): place}).items():
            found.setdefault(real, path)
    logs = list(found.values())
    recordings = [path for path in logs if path.is_dir() or is_recording(path)]
    stems = {_absolute(path).parent / f"{log_name(path)}." for path in recordings}
    beside = [path for path in logs if path not in recordings and _is_beside(_absolute(path), stems)]
    return [path for path in logs if path not in beside], beside


def _is_beside(file: Path, stems: set[Path]) -> bool:
    """Return whether a file has a recording's name and another suffix: ``drive.truth.csv`` beside ``drive.bag``."""
    parts = file.name.split(".")
    return file.is_file() and any(file.parent / f"{'.'.join(parts[:k])}." in stems for k in range(1, len(parts)))


def distinct_names(logs: Sequence[Path]) -> list[str]:
    """Return a name for the run of each log: that of the log, or where two share it, what their paths differ in."""
    names = [log_name(log) for log in logs]
    if len({name.casefold() for name in names}) == len(names):
        return names
    count = Counter(name.casefold() for name in names)
    longer = [one.name.replace("/", "-") for one in _named(logs, common_parent(logs))]
    taken = {name.casefold() for name in names if count[name.casefold()] == 1}
    for index, name in enumerate(names):
        if count[name.casefold()] > 1:
            names[index] = unique_name(longer[index], taken)
    return names


def common_parent(places: Sequence[Path]) -> Path:
    """Return the folder that all places lie in; a folder that was given alone is that one, unless it is a recording."""
    folders = [place if place.is_dir() and not is_bag_directory(place) else _absolute(place).parent for place in places]
    return Path(os.path.commonpath([_absolute(folder) for folder in folders]))


def is_recording(file: Path) -> bool:
    """Return whether a file is a recording: by its first bytes, or by a recorder's suffix."""
    if not file.is_file():
        return False
    if Path(unpacked_name(file.name)).suffix in LOG_SUFFIXES:
        return True
    try:
        with file.open("rb") as stream:
            container = container_of(stream)
            if container is not SqliteBag:
                return container is not None
            stream.seek(0)
            # Other programs keep SQLite files too.
            first = stream.read(FIRST_BYTES)
            return b"messages" in first and b"topics" in first
    except OSError:
        return False


def _search(folder: Path) -> Iterable[Path]:
    """Yield the recordings below a folder; hidden entries and folders with results of ours are left out."""
    if is_bag_directory(folder):
        yield folder
        return
    if any((folder / name).is_file() for name in OWN_FILES):
        return
    try:
        entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as err:
        raise LogError(folder, "cannot be searched", err.strerror or str(err)) from err
    for entry in entries:
        if entry.is_dir():
            # A link to a folder could lead back up.
            if not entry.is_symlink():
                yield from _search(entry)
        elif is_recording(entry):
            yield entry


def _named(paths: Sequence[Path], root: Path) -> list[FoundRecording]:
    """Name each recording after its path below `root`; where names collide, with the suffix of the file."""
    logs = [PurePosixPath(Path(os.path.relpath(_absolute(path), root)).as_posix()) for path in paths]
    short = [str(log.parent / log_name(path)) for log, path in zip(logs, paths, strict=True)]
    # A run cannot lie in another one either.
    count = Counter(name.casefold() for name in short)
    parents = {str(parent).casefold() for name in short for parent in PurePosixPath(name).parents}
    names = [
        name if count[name.casefold()] == 1 and name.casefold() not in parents else str(log)
        for name, log in zip(short, logs, strict=True)
    ]
    taken: set[str] = set()
    names = [unique_name(name, taken) for name in names]
    return [
        FoundRecording(path, as_text(name), as_text(log)) for path, name, log in zip(paths, names, logs, strict=True)
    ]


def unique_name(name: str, taken: set[str]) -> str:
    """Return a name, with a number where it is taken; add it to those that are."""
    unique, number = name, 2
    while unique.casefold() in taken:
        unique, number = f"{name}-{number}", number + 1
    taken.add(unique.casefold())
    return unique


def _absolute(path: Path) -> Path:
    if isinstance(path, UrlPath):
        return Path("/", *path.parts)
    return Path(os.path.normpath(path.absolute()))


def as_text(path: object) -> str:
    """Return a path as text that every file takes: bytes of its name that are no UTF-8 as escapes."""
    return str(path).encode("utf-8", errors="backslashreplace").decode()
