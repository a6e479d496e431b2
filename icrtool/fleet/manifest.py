"""A manifest: which logs, and of which robot, with which configuration, in which group (CSV or TOML)."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec

from icrtool.config import parse_toml
from icrtool.errors import ConfigError
from icrtool.logs.containers.source import find
from icrtool.records.regular_file import read_regular
from icrtool.records.urls import UrlPath, place_of

COLUMNS = ("log", "robot", "config", "group", "tags")

SUFFIXES = {".csv", ".toml"}

LARGEST_BYTES = 10_000_000


@dataclass(frozen=True, slots=True)
class About:
    """What a manifest states about a log.

    Attributes
    ----------
    robot : a built-in robot, or the name of one that `config` describes
    config : configuration file
    """

    robot: str = ""
    config: Path | None = None
    group: str = ""
    tags: tuple[str, ...] = ()

    def updated(self, other: About) -> About:
        """Return it with what another one states in its place."""
        stated = {key: value for key in ("robot", "config", "group") if (value := getattr(other, key))}
        return replace(self, **stated, tags=tuple(dict.fromkeys((*self.tags, *other.tags))))


class _Line(msgspec.Struct, forbid_unknown_fields=True):
    """A line as it is written."""

    log: Annotated[str, msgspec.Meta(min_length=1)]
    robot: str = ""
    config: str = ""
    group: str = ""
    tags: list[str] = []


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of a manifest: the files and folders that its pattern matches, and what holds for them.

    `targets` are the places with links followed.
    """

    places: tuple[Path, ...]
    about: About
    targets: frozenset[Path]


def is_manifest(path: Path) -> bool:
    """Return whether a path is a manifest, by its suffix."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def read_manifest(path: Path) -> list[Entry]:
    """Read a manifest: CSV with the columns of `COLUMNS`, or TOML with a table ``[[logs]]`` each.

    Paths and patterns are relative to the manifest's folder. Tags in a CSV are separated by semicolons.

    Raises
    ------
    ConfigError
        It cannot be read, has an unknown column, a log that does not exist or a pattern that matches nothing.
    """
    try:
        text = read_regular(path, most_bytes=LARGEST_BYTES).decode("utf-8-sig")
        rows = _toml_rows(path, text) if path.suffix.lower() == ".toml" else _csv_rows(path, text)
    except OSError as err:
        raise ConfigError(path, "cannot be read", err.strerror or str(err)) from err
    except (ValueError, RecursionError, csv.Error) as err:
        raise ConfigError(path, "not a manifest", str(err) or "nested too deep") from err
    if not rows:
        raise ConfigError(path, "an empty manifest", "give it a line for each log or pattern")
    return [_entry(path, row) for row in rows]


def about(path: Path, entries: Sequence[Entry]) -> About:
    """Return what a manifest states about a recording; a later line adds to and replaces an earlier one."""
    found = About()
    whole = _target(path)
    around = {whole, *whole.parents}
    for entry in entries:
        if not around.isdisjoint(entry.targets):
            found = found.updated(entry.about)
    return found


def _target(place: Path) -> Path:
    """Return a place with links followed."""
    return place if isinstance(place, UrlPath) else place.resolve()


def _csv_rows(path: Path, text: str) -> list[Mapping[str, Any]]:
    reader = csv.DictReader(text.splitlines(), strict=True)
    if "log" not in (reader.fieldnames or ()):
        raise ConfigError(path, "not a manifest", f"its first line must name the column log, of {', '.join(COLUMNS)}")
    rows: list[Mapping[str, Any]] = []
    for number, row in enumerate(reader, start=2):
        if None in row or None in row.values():
            raise ConfigError(
                f"{path}:{number}", "has more or fewer values than the first line has names", "give one each"
            )
        rows.append({**row, "tags": [tag.strip() for tag in (row.get("tags") or "").split(";") if tag.strip()]})
    return rows


def _toml_rows(path: Path, text: str) -> list[Mapping[str, Any]]:
    document = parse_toml(text)
    rows = document.get("logs")
    if set(document) - {"logs"} or not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ConfigError(path, "not a manifest", "it holds tables [[logs]] and nothing else")
    return rows


def _entry(path: Path, row: Mapping[str, Any]) -> Entry:
    try:
        line = msgspec.convert(row, _Line)
    except msgspec.ValidationError as err:
        what = f"each line has a log or a pattern, and texts; of {', '.join(COLUMNS)}"
        raise ConfigError(f"{path}: log", what, str(err)) from err
    config = path.parent / line.config.strip() if line.config.strip() else None
    about = About(line.robot.strip(), config, line.group.strip(), tuple(line.tags))
    places = _matching(path, line.log)
    return Entry(places, about, frozenset(_target(place) for place in places))


def _matching(path: Path, pattern: str) -> tuple[Path, ...]:
    """Return what a pattern matches; a name with a bracket or a star of its own is taken as it is, if it is there."""
    if isinstance(address := place_of(pattern), UrlPath):
        return tuple(find(address))
    named = path.parent / pattern
    try:
        if named.exists():
            return (named,)
        base = Path(named.anchor) if Path(pattern).is_absolute() else path.parent
        relative = str(Path(pattern).relative_to(base)) if Path(pattern).is_absolute() else pattern
        found = tuple(sorted(base.glob(relative)))
    except (ValueError, NotImplementedError, OSError, RecursionError) as err:
        raise ConfigError(f"{path}: log", f"{pattern!r} is not a pattern", str(err)) from err
    if not found:
        raise ConfigError(f"{path}: log", f"{pattern!r} matches nothing", f"it is relative to {path.parent}")
    return found
