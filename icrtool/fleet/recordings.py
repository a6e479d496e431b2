"""Search for the recordings of a batch in files and folders, names for their runs, and manifests.

A manifest (CSV or TOML) states robot, configuration, group and tags of logs.
"""

from __future__ import annotations

import csv
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import msgspec

from icrtool.config import parse_toml
from icrtool.errors import ConfigError, LogError
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
from icrtool.logs.containers.source import find_logs_at
from icrtool.logs.containers.sqlite_bag import SqliteBag
from icrtool.output.run_directory import RUN_FILE
from icrtool.records.places import UrlPath, place_of, read_regular

OWN_FILES = (RUN_FILE, "fleet.json", "study.json")
"""Names of files that show that a folder is a result of icrtool, in which no recordings are searched."""

LONGEST_RESTART_S = 60.0
"""Longest pause between two files of a restarted recorder [s]. Files with a longer pause are separate drives."""

SQLITE_PAGE_BYTES = 65536
"""Largest size of the first page of an SQLite file, which names its tables [bytes]."""


@dataclass(frozen=True, slots=True)
class FoundRecording:
    """A recording of a batch.

    Attributes
    ----------
    path : path of the recording for `icrtool.read_log`
    name : path of its run below ``runs/``, unique in the batch
    log : path of the recording below the common parent of the searched places, for tables
    """

    path: Path
    name: str
    log: str


def find_recordings(places: Sequence[Path]) -> list[FoundRecording]:
    """Return the recordings among files and in folders, which are searched recursively; each once, sorted by path.

    Raises
    ------
    LogError
        A place does not exist, or no place contains a recording.
    """
    for place in places:
        if not (isinstance(place, UrlPath) or place.exists() or split_files(place)):
            raise LogError(place, "no such file or directory")
    logs, _ = logs_among(places)
    recordings = join_split_recordings(
        {os.path.realpath(log): log for log in logs if not log.is_dir() or is_bag_directory(log)}
    )
    if not recordings:
        subject = places[0] if len(places) == 1 else f"{len(places)} places"
        raise LogError(subject, "no recording in it", "a log is an .mcap, .bag or .db3 file, or a ROS 2 bag directory")
    root = common_parent(
        places if not any(isinstance(place, UrlPath) for place in places) else list(recordings.values())
    )
    return _name_recordings(sorted(recordings.values(), key=natural_order), root)


def join_split_recordings(logs: Mapping[str, Path]) -> dict[str, Path]:
    """Return recordings by their real paths, with the files of each split recording joined to one path.

    Files are joined if they are in one folder, their names differ only in a count or a date, they have the same topics,
    and each begins at most `LONGEST_RESTART_S` after the end of the file before it. A file without an index is not
    joined, because its end is not known.

    Parameters
    ----------
    logs : paths by real path; a file of a split recording that is also in `logs` is left out
    """
    in_ranges = {os.path.realpath(file) for path in logs.values() for file in split_files(path)}
    single = {real: path for real, path in logs.items() if real not in in_ranges}
    series: dict[tuple[Path, str, str], list[NumberedFile]] = {}
    for path in single.values():
        if path.suffix in LOG_SUFFIXES and path.is_file() and (file := numbered_file(path)) is not None:
            series.setdefault(file.series, []).append(file)
    replaced: dict[Path, Path] = {}
    for files in series.values():
        for group in _consecutive_groups(sorted(files, key=lambda file: file.order)) if len(files) > 1 else ():
            replaced |= dict.fromkeys(group, split_path(group))
    paths = dict.fromkeys(replaced.get(path, path) for path in single.values())
    return {os.path.realpath(path): path for path in paths}


def _consecutive_groups(files: Sequence[NumberedFile]) -> list[list[Path]]:
    """Return the groups of two or more files that are parts of one recording."""
    extents = [_index_extent(file.path) for file in files]
    groups: list[list[Path]] = [[files[0].path]]
    for (file, before), (next_file, after) in pairwise(zip(files, extents, strict=True)):
        is_continued = False
        counted = not file.is_count or next_file.order[0] == file.order[0] + 1
        if counted and before is not None and after is not None:
            (_, end_ns, topics), (begin_ns, _, others) = before, after
            pause_s = (begin_ns - end_ns) / 1e9
            in_common = 2 * len(topics & others) >= min(len(topics), len(others)) > 0
            is_continued = in_common and -LEAST_OVERLAP_S < pause_s <= LONGEST_RESTART_S
        if is_continued:
            groups[-1].append(next_file.path)
        else:
            groups.append([next_file.path])
    return [group for group in groups if len(group) > 1]


def _index_extent(path: Path) -> tuple[int, int, frozenset[tuple[str, str]]] | None:
    """Return begin and end [ns] of a file by its index, and its topics with types; None without an index."""
    try:
        container = open_log(path)
    except LogError:
        return None
    with closing(container):
        span = container.span_ns()
        topics = frozenset((channel.topic, channel.message_type) for channel in container.channels)
    return (*span, topics) if span is not None else None


def logs_among(places: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Return the logs among some places, each once, and the files among them that are no logs.

    A folder that is neither a recording nor a run is replaced by the recordings in it, if it has any. A pattern of the
    shell may also match ``drive.json`` next to ``drive.mcap``: such a file is no log.
    """
    by_path: dict[str, Path] = {}
    for place in places:
        if isinstance(place, UrlPath):
            by_path |= {path.url: path for path in find_logs_at(place)}
            continue
        searched = place.is_dir() and not is_bag_directory(place) and not (place / RUN_FILE).is_file()
        below = {os.path.realpath(path): path for path in sorted(_search(place), key=natural_order)} if searched else {}
        for real, path in (join_split_recordings(below) or {os.path.realpath(place): place}).items():
            by_path.setdefault(real, path)
    logs = list(by_path.values())
    recordings = [path for path in logs if path.is_dir() or is_recording(path)]
    stems = {_absolute(path).parent / f"{log_name(path)}." for path in recordings}
    others = []
    for path in logs:
        # A file with the name of a recording and another suffix is no log, as drive.truth.csv next to drive.bag.
        file, parts = _absolute(path), path.name.split(".")
        beginnings = {file.parent / f"{'.'.join(parts[:k])}." for k in range(1, len(parts))}
        if path not in recordings and file.is_file() and not stems.isdisjoint(beginnings):
            others.append(path)
    return [path for path in logs if path not in others], others


def distinct_names(logs: Sequence[Path]) -> list[str]:
    """Return a unique name for the run of each log: its name, or, for equal names, the differing part of its path."""
    names = [log_name(log) for log in logs]
    if len({name.casefold() for name in names}) == len(names):
        return names
    count = Counter(name.casefold() for name in names)
    longer = [recording.name.replace("/", "-") for recording in _name_recordings(logs, common_parent(logs))]
    taken = {name.casefold() for name in names if count[name.casefold()] == 1}
    for index, name in enumerate(names):
        if count[name.casefold()] > 1:
            names[index] = unique_name(longer[index], taken)
    return names


def common_parent(places: Sequence[Path]) -> Path:
    """Return the folder that contains all places; for a single folder that is no recording, this folder."""
    folders = [place if place.is_dir() and not is_bag_directory(place) else _absolute(place).parent for place in places]
    return Path(os.path.commonpath([_absolute(folder) for folder in folders]))


def is_recording(file: Path) -> bool:
    """Return whether a file is a recording, by its first bytes or by the suffix that recorders use."""
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
            # Other programs also write SQLite files; a recording has the tables `messages` and `topics`.
            first = stream.read(SQLITE_PAGE_BYTES)
            return b"messages" in first and b"topics" in first
    except OSError:
        return False


def _search(folder: Path) -> Iterable[Path]:
    """Yield the recordings in a folder and its subfolders, without hidden entries and folders with results of icrtool.

    Raises
    ------
    LogError
        A folder cannot be read.
    """
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
            # Links to folders are not followed, because they could lead back to a parent.
            if not entry.is_symlink():
                yield from _search(entry)
        elif is_recording(entry):
            yield entry


def _name_recordings(paths: Sequence[Path], root: Path) -> list[FoundRecording]:
    """Return recordings with names after their paths below `root`; equal names get the suffix of the file."""
    logs = [PurePosixPath(Path(os.path.relpath(_absolute(path), root)).as_posix()) for path in paths]
    short = [str(log.parent / log_name(path)) for log, path in zip(logs, paths, strict=True)]
    # The directory of a run must not be in the directory of another run.
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
    """Return a name that is not in `taken`, with a number at its end if needed, and add it to `taken`."""
    unique, number = name, 2
    while unique.casefold() in taken:
        unique, number = f"{name}-{number}", number + 1
    taken.add(unique.casefold())
    return unique


def _absolute(path: Path) -> Path:
    """Return the absolute path, without following links; for an address a path with the same parts."""
    if isinstance(path, UrlPath):
        return Path("/", *path.parts)
    return Path(os.path.normpath(path.absolute()))


def as_text(path: object) -> str:
    """Return a path as valid UTF-8 text; other bytes of its name are escaped."""
    return str(path).encode("utf-8", errors="backslashreplace").decode()


MANIFEST_COLUMNS = ("log", "robot", "config", "group", "tags")
"""Columns of a manifest."""

MANIFEST_SUFFIXES = {".csv", ".toml"}
"""Suffixes of manifests."""

LARGEST_MANIFEST_BYTES = 10_000_000
"""Largest size of a manifest that is read [bytes]."""


@dataclass(frozen=True, slots=True)
class About:
    """The statements of a manifest about a log.

    Attributes
    ----------
    robot : name of a built-in robot, or of the robot that `config` describes; empty without a statement
    config : configuration file; None without a statement
    group : group of the log; empty without a statement
    tags : tags of the log
    """

    robot: str = ""
    config: Path | None = None
    group: str = ""
    tags: tuple[str, ...] = ()


class _Line(msgspec.Struct, forbid_unknown_fields=True):
    """A line of a manifest, as the user wrote it."""

    log: Annotated[str, msgspec.Meta(min_length=1)]
    robot: str = ""
    config: str = ""
    group: str = ""
    tags: list[str] = []


@dataclass(frozen=True, slots=True)
class ManifestEntry:
    """A line of a manifest.

    Attributes
    ----------
    places : files and folders that the pattern matches
    about : statements about them
    targets : real paths of the places, with links followed
    """

    places: tuple[Path, ...]
    about: About
    targets: frozenset[Path]


def is_manifest(path: Path) -> bool:
    """Return whether a path is a manifest, by its suffix."""
    return path.suffix.lower() in MANIFEST_SUFFIXES and path.is_file()


def read_manifest(path: Path) -> list[ManifestEntry]:
    """Return the lines of a manifest: CSV with the columns `MANIFEST_COLUMNS`, or TOML with tables ``[[logs]]``.

    Paths and patterns are relative to the folder of the manifest. Tags in a CSV file are separated by semicolons.

    Raises
    ------
    ConfigError
        The manifest cannot be read, has an unknown column or an empty log, or a pattern has no match.
    """
    try:
        text = read_regular(path, most_bytes=LARGEST_MANIFEST_BYTES).decode("utf-8-sig")
        if path.suffix.lower() == ".toml":
            document = parse_toml(text)
            rows = document.get("logs")
            if set(document) - {"logs"} or not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
                raise ConfigError(path, "not a manifest", "it holds tables [[logs]] and nothing else")
        else:
            rows = _csv_rows(path, text)
    except OSError as err:
        raise ConfigError(path, "cannot be read", err.strerror or str(err)) from err
    except (ValueError, RecursionError, csv.Error) as err:
        raise ConfigError(path, "not a manifest", str(err) or "nested too deep") from err
    if not rows:
        raise ConfigError(path, "is an empty manifest", "write a line for each log or pattern")
    return [_entry(path, row) for row in rows]


def about_recording(path: Path, entries: Sequence[ManifestEntry]) -> About:
    """Return the statements of a manifest about a recording; later lines replace earlier values and add tags."""
    about = About()
    target = _target(path)
    target_and_parents = {target, *target.parents}
    for entry in entries:
        if not target_and_parents.isdisjoint(entry.targets):
            stated = {key: value for key in ("robot", "config", "group") if (value := getattr(entry.about, key))}
            about = replace(about, **stated, tags=tuple(dict.fromkeys((*about.tags, *entry.about.tags))))
    return about


def _target(place: Path) -> Path:
    """Return the real path of a place, with links followed."""
    return place if isinstance(place, UrlPath) else place.resolve()


def _csv_rows(path: Path, text: str) -> list[Mapping[str, Any]]:
    """Return the rows of a manifest in CSV, with lists of tags; raise `ConfigError` for a wrong form."""
    reader = csv.DictReader(text.splitlines(), strict=True)
    if "log" not in (reader.fieldnames or ()):
        raise ConfigError(
            path, "not a manifest", f"its first line has no column log; columns are {', '.join(MANIFEST_COLUMNS)}"
        )
    rows: list[Mapping[str, Any]] = []
    for number, row in enumerate(reader, start=2):
        if None in row or None in row.values():
            why = "has more or fewer values than the first line has names"
            raise ConfigError(f"{path}:{number}", why, "write one value for each column")
        rows.append({**row, "tags": [tag.strip() for tag in (row.get("tags") or "").split(";") if tag.strip()]})
    return rows


def _entry(path: Path, row: Mapping[str, Any]) -> ManifestEntry:
    """Return a line of a manifest with the places that it matches; raise `ConfigError` for a wrong value."""
    try:
        line = msgspec.convert(row, _Line)
    except msgspec.ValidationError as err:
        why = f"a line needs a log or a pattern, and may have texts for {', '.join(MANIFEST_COLUMNS[1:])}"
        raise ConfigError(f"{path}: log", why, str(err)) from err
    config = path.parent / line.config.strip() if line.config.strip() else None
    about = About(line.robot.strip(), config, line.group.strip(), tuple(line.tags))
    places = _find_matches(path, line.log)
    return ManifestEntry(places, about, frozenset(_target(place) for place in places))


def _find_matches(path: Path, pattern: str) -> tuple[Path, ...]:
    """Return the files and folders that a pattern in a manifest matches; an existing path is not used as a pattern.

    Raises
    ------
    ConfigError
        The pattern is not valid, or matches no file and no folder.
    """
    if isinstance(address := place_of(pattern), UrlPath):
        return tuple(find_logs_at(address))
    full_pattern = path.parent / pattern
    try:
        if full_pattern.exists():
            return (full_pattern,)
        base = Path(full_pattern.anchor) if Path(pattern).is_absolute() else path.parent
        relative = str(Path(pattern).relative_to(base)) if Path(pattern).is_absolute() else pattern
        matches = tuple(sorted(base.glob(relative)))
    except (ValueError, NotImplementedError, OSError, RecursionError) as err:
        raise ConfigError(f"{path}: log", f"{pattern!r} is not a pattern", str(err)) from err
    if not matches:
        why = f"{pattern!r} matches no file or folder"
        raise ConfigError(f"{path}: log", why, f"patterns are relative to {path.parent}")
    return matches
