"""The logs of a batch: recordings found by content in files and folders, the names of their runs, and manifests.

A manifest states which logs are of which robot, with which configuration, in which group (CSV or TOML).
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
"""Names of files by which a folder is recognised as a result of icrtool, in which no recordings are searched."""

LONGEST_RESTART_S = 60.0
"""Longest pause between two files of a restarted recorder [s]. Files after a longer pause are separate drives."""

SQLITE_PAGE_BYTES = 65536
"""Length of the longest first page of an SQLite file, which names its tables [bytes]."""


@dataclass(frozen=True, slots=True)
class FoundRecording:
    """One recording.

    Attributes
    ----------
    path : argument for `icrtool.read_log`
    name : path of the run below ``runs/``, unique in the batch
    log : path below the common parent of the searched places, as tables show it
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
    recordings = join_split_recordings(
        {os.path.realpath(log): log for log in logs if not log.is_dir() or is_bag_directory(log)}
    )
    if not recordings:
        what = places[0] if len(places) == 1 else f"{len(places)} places"
        raise LogError(what, "no recording in it", "a log is an .mcap, .bag or .db3 file, or a ROS 2 bag directory")
    root = common_parent(
        places if not any(isinstance(place, UrlPath) for place in places) else list(recordings.values())
    )
    return _named(sorted(recordings.values(), key=natural_order), root)


def join_split_recordings(logs: Mapping[str, Path]) -> dict[str, Path]:
    """Return recordings in which the files of a split recording, or of a restarted recorder, are joined.

    Files are joined if they lie in one folder, their names differ only in a count or a date, they have the same topics,
    and each begins at most `LONGEST_RESTART_S` after the end of the file before it. A file without index is not joined,
    because its end is not known.

    Parameters
    ----------
    logs : paths by real path; the single files of a split recording that is also in `logs` are left out
    """
    of_ranges = {os.path.realpath(file) for path in logs.values() for file in split_files(path)}
    single = {real: path for real, path in logs.items() if real not in of_ranges}
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
        goes_on = False
        counted = not one.is_count or other.order[0] == one.order[0] + 1
        if counted and before is not None and after is not None:
            (_, end_ns, topics), (begin_ns, _, others) = before, after
            pause_s = (begin_ns - end_ns) / 1e9
            in_common = 2 * len(topics & others) >= min(len(topics), len(others)) > 0
            goes_on = in_common and -LEAST_OVERLAP_S < pause_s <= LONGEST_RESTART_S
        if goes_on:
            groups[-1].append(other.path)
        else:
            groups.append([other.path])
    return [group for group in groups if len(group) > 1]


def _extent(path: Path) -> tuple[int, int, frozenset[tuple[str, str]]] | None:
    """Return begin and end [ns] of a file by its index, and its topics with types; None for a file without index."""
    try:
        container = open_log(path)
    except LogError:
        return None
    with closing(container):
        span = container.span_ns()
        topics = frozenset((channel.topic, channel.message_type) for channel in container.channels)
    return (*span, topics) if span is not None else None


def logs_among(places: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Return the logs that a command is to use, each once, and the files among the places that are no logs.

    A folder that is neither a recording nor a run is replaced by the recordings below it, if there are any. A pattern
    of the shell may also name ``drive.json`` next to ``drive.mcap``: such a file is no log.
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
        # A file with a recording's name and another suffix: drive.truth.csv next to drive.bag.
        file, parts = _absolute(path), path.name.split(".")
        beginnings = {file.parent / f"{'.'.join(parts[:k])}." for k in range(1, len(parts))}
        if path not in recordings and file.is_file() and not stems.isdisjoint(beginnings):
            others.append(path)
    return [path for path in logs if path not in others], others


def distinct_names(logs: Sequence[Path]) -> list[str]:
    """Return a name for the run of each log: the name of the log, or for equal names the differing part of the path."""
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
    """Return the folder that all places lie in; a single folder is returned itself, unless it is a recording."""
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
            first = stream.read(SQLITE_PAGE_BYTES)
            return b"messages" in first and b"topics" in first
    except OSError:
        return False


def _search(folder: Path) -> Iterable[Path]:
    """Yield the recordings below a folder; hidden entries and folders with results of icrtool are left out."""
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
    # A run cannot lie in another run.
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
    """Return a name that is not taken, with a number where needed, and add it to the taken names."""
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
    """Return a path as valid UTF-8 text; other bytes of its name become escapes."""
    return str(path).encode("utf-8", errors="backslashreplace").decode()


MANIFEST_COLUMNS = ("log", "robot", "config", "group", "tags")

MANIFEST_SUFFIXES = {".csv", ".toml"}

LARGEST_MANIFEST_BYTES = 10_000_000


@dataclass(frozen=True, slots=True)
class About:
    """The statements of a manifest about a log.

    Attributes
    ----------
    robot : name of a built-in robot, or of the robot that `config` describes
    config : configuration file
    """

    robot: str = ""
    config: Path | None = None
    group: str = ""
    tags: tuple[str, ...] = ()


class _Line(msgspec.Struct, forbid_unknown_fields=True):
    """A line of a manifest as the user wrote it."""

    log: Annotated[str, msgspec.Meta(min_length=1)]
    robot: str = ""
    config: str = ""
    group: str = ""
    tags: list[str] = []


@dataclass(frozen=True, slots=True)
class ManifestEntry:
    """One line of a manifest: the files and folders that its pattern matches, and the statements about them.

    `targets` are the real paths of the places, with links followed.
    """

    places: tuple[Path, ...]
    about: About
    targets: frozenset[Path]


def is_manifest(path: Path) -> bool:
    """Return whether a path is a manifest, by its suffix."""
    return path.suffix.lower() in MANIFEST_SUFFIXES and path.is_file()


def read_manifest(path: Path) -> list[ManifestEntry]:
    """Return the lines of a manifest: CSV with the columns `MANIFEST_COLUMNS`, or TOML with tables ``[[logs]]``.

    Paths and patterns are relative to the manifest's folder. Tags in a CSV are separated by semicolons.

    Raises
    ------
    ConfigError
        The manifest cannot be read, or has an unknown column, a missing log, or a pattern that matches nothing.
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
        raise ConfigError(path, "an empty manifest", "give it a line for each log or pattern")
    return [_entry(path, row) for row in rows]


def about_recording(path: Path, entries: Sequence[ManifestEntry]) -> About:
    """Return the statements of a manifest about a recording; later lines replace earlier values and add tags."""
    about = About()
    whole = _target(path)
    around = {whole, *whole.parents}
    for entry in entries:
        if not around.isdisjoint(entry.targets):
            of_entry = {key: value for key in ("robot", "config", "group") if (value := getattr(entry.about, key))}
            about = replace(about, **of_entry, tags=tuple(dict.fromkeys((*about.tags, *entry.about.tags))))
    return about


def _target(place: Path) -> Path:
    """Return the real path of a place, with links followed."""
    return place if isinstance(place, UrlPath) else place.resolve()


def _csv_rows(path: Path, text: str) -> list[Mapping[str, Any]]:
    reader = csv.DictReader(text.splitlines(), strict=True)
    if "log" not in (reader.fieldnames or ()):
        raise ConfigError(
            path, "not a manifest", f"its first line must name the column log, of {', '.join(MANIFEST_COLUMNS)}"
        )
    rows: list[Mapping[str, Any]] = []
    for number, row in enumerate(reader, start=2):
        if None in row or None in row.values():
            why = "has more or fewer values than the first line has names"
            raise ConfigError(f"{path}:{number}", why, "give one each")
        rows.append({**row, "tags": [tag.strip() for tag in (row.get("tags") or "").split(";") if tag.strip()]})
    return rows


def _entry(path: Path, row: Mapping[str, Any]) -> ManifestEntry:
    try:
        line = msgspec.convert(row, _Line)
    except msgspec.ValidationError as err:
        what = f"each line has a log or a pattern, and texts; of {', '.join(MANIFEST_COLUMNS)}"
        raise ConfigError(f"{path}: log", what, str(err)) from err
    config = path.parent / line.config.strip() if line.config.strip() else None
    about = About(line.robot.strip(), config, line.group.strip(), tuple(line.tags))
    places = _matching(path, line.log)
    return ManifestEntry(places, about, frozenset(_target(place) for place in places))


def _matching(path: Path, pattern: str) -> tuple[Path, ...]:
    """Return the files and folders that a pattern matches; an existing file with this name comes before the pattern."""
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
        raise ConfigError(f"{path}: log", f"{pattern!r} matches nothing", f"it is relative to {path.parent}")
    return matches
