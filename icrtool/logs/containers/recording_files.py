"""The files of a recording: of a bag directory, and of a recorder that split its files or was restarted.

``drive_{0..3}.bag`` names all files from the first to the last one in the braces, in the order of their numbers or
dates. It is a path like any other: commands take it, tables show it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

from icrtool.errors import LogError
from icrtool.records.places import UrlPath, open_regular
from icrtool.records.text import listed

LOG_SUFFIXES = {".mcap", ".bag", ".db3"}
"""Suffixes of recordings. A file with such a suffix counts as a recording; if it cannot be read, that is reported."""

PACKED_SUFFIX = r"\.(?:zstd|zst|gz|lz4|bz2|xz)"
"""Suffixes of compressed files."""

_PACKED_END = re.compile(rf"{PACKED_SUFFIX}$", re.IGNORECASE)
_ARCHIVE_END = re.compile(r"\.(?:zip|tar|tgz|tbz2|txz)$", re.IGNORECASE)

STORAGE = re.compile(rf"\.(mcap|db3)(?:{PACKED_SUFFIX})?$")

LARGEST_METADATA_BYTES = 1 << 18
"""Largest size of metadata.yaml [bytes]. The file of a bag of 200 topics has some 100,000 bytes."""

_DEEPEST = 20
"""Largest depth of metadata.yaml."""

LONGEST_SPLIT_GAP_S = 3600.0
"""The files of a split recording follow one another without a gap. A longer gap: they are separate recordings."""

LEAST_OVERLAP_S = 1.0
"""The files of a split recording overlap by less than this: a recorder fills one buffer while it writes another."""


class FileTimes(NamedTuple):
    """First and last log time of the messages of a file [ns]."""

    begin_ns: int
    end_ns: int
    file: str


def storage_files(directory: Path) -> list[Path]:
    """Return the storage files of a directory, ``bag_10`` after ``bag_9``.

    Raises
    ------
    LogError
        There is none, or there are recordings of several kinds: the user must name one.
    """
    entries = sorted(directory.iterdir(), key=natural_order)
    storage = [entry for entry in entries if STORAGE.search(entry.name) and entry.is_file()]
    others = [
        entry
        for entry in entries
        if (entry / "metadata.yaml").is_file() or (entry.suffix == ".bag" and entry.is_file())
    ]
    kinds = {match[1] for file in storage if (match := STORAGE.search(file.name))}
    if len(kinds) == 1 and not others:
        return storage
    if not storage and len(others) == 1:
        raise LogError(directory, f"not a ROS 2 bag directory, but {others[0].name} is in it", "name that file")
    if storage or others:
        why = f"holds more than one recording: {listed([entry.name for entry in (*storage, *others)])}"
        raise LogError(directory, why, "name one of them")
    if (directory / "run.json").is_file():
        raise LogError(directory, "is a run, not a log", "icrtool dropout-report reads it; or name the log itself")
    if (directory / "fleet.json").is_file():
        advice = f"icrtool dropout-report {directory}/runs/NAME reads one of its runs; icrtool report makes its page"
        raise LogError(directory, "is the folder of a batch, not a log", advice)
    if runs := sorted(entry.parent.name for entry in directory.glob("*/run.json")):
        raise LogError(directory, f"holds runs, not a log: {listed(runs)}", "icrtool dropout-report reads one of them")
    raise LogError(directory, "not a ROS 2 bag directory", "it holds no .mcap or .db3 file")


class BagFiles(NamedTuple):
    """The storage files of a bag directory, and the compression of each message; empty for none.

    Attributes
    ----------
    by_name : the files were found by their names, because no metadata.yaml lists them
    """

    files: list[Path]
    message_compression: str = ""
    by_name: bool = False


def bag_files(directory: Path, report: Callable[[str, str], None]) -> BagFiles:
    """Return the files that metadata.yaml names and that are there; all storage files where it names none.

    Parameters
    ----------
    report : called with code and text of what is missing; a recorder that was killed leaves no such file, or half of it

    Raises
    ------
    LogError
        As `storage_files`.
    """
    file = directory / "metadata.yaml"
    names, message_compression, trouble = list[str](), "", ""
    if not file.is_file():
        trouble = "no metadata.yaml"
    else:
        try:
            if file.stat().st_size > LARGEST_METADATA_BYTES:
                raise ValueError("too long")
            names, message_compression = _metadata(file.read_text(encoding="utf-8"))
        except (ValueError, OSError, RecursionError):
            trouble = "its metadata.yaml cannot be read"
    if trouble:
        report("log_part_unreadable", f"{trouble}; its storage files were found by their names")
    there, missing = dict[Path, None](), dict[str, None]()
    for name in (Path(one).name for one in names):
        # a file may have been unpacked since
        stored = [directory / name, directory / unpacked_name(name)]
        existing = next((one for one in stored if os.path.isfile(one)), None)  # noqa: PTH113 - also of a name that is too long
        if existing is not None:
            there[existing] = None
        else:
            missing[stored[0].name] = None
    if missing:
        report("log_parts_contradict", f"metadata.yaml names files that are not there: {listed([*missing])}")
    if there:
        return BagFiles([*there], message_compression)
    return BagFiles(storage_files(directory), message_compression, by_name=True)


def _metadata(text: str) -> tuple[list[str], str]:
    """Return what the text of a metadata.yaml states: the names of storage files, and how each message is compressed.

    Raises
    ------
    ValueError
        The text is not YAML, or not the metadata of a bag; or it has an alias.
    """
    document = _plain_yaml(text)
    information = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else None
    files = information.get("relative_file_paths") if isinstance(information, dict) else None
    if not isinstance(information, dict) or not isinstance(files, list):
        raise ValueError("not the metadata of a bag")  # noqa: TRY004 - as for all that a text can be
    by_message = str(information.get("compression_mode")).upper() == "MESSAGE"
    compression = str(information.get("compression_format")) if by_message else ""
    return [name for name in files if isinstance(name, str)], compression


def _plain_yaml(text: str) -> object:
    """Return a YAML text as dicts, lists and strings; merge keys are ordinary keys.

    Raises
    ------
    ValueError
        The text is not YAML, is nested too deeply, has a key that is no text, or an alias: by aliases a short text
        stands for gigabytes.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.events import CollectionEndEvent, MappingStartEvent, NodeEvent, ScalarEvent, SequenceStartEvent

    def value(event: Any, depth: int) -> object:  # noqa: ANN401 - an event of the library
        if isinstance(event, ScalarEvent):
            return str(event.value)
        if not isinstance(event, MappingStartEvent | SequenceStartEvent) or depth == _DEEPEST:
            raise ValueError("has an alias, or is nested too deeply")
        parts: list[Any] = []
        while not isinstance(inner := next(events), CollectionEndEvent):
            parts.append(value(inner, depth + 1))
        if isinstance(event, SequenceStartEvent):
            return parts
        if not all(isinstance(key, str) for key in parts[::2]):
            raise ValueError("a key is no text")
        return dict(zip(parts[::2], parts[1::2], strict=True))

    try:
        events = iter(YAML(typ="safe").parse(text))
        first = next((event for event in events if isinstance(event, NodeEvent)), None)
        return None if first is None else value(first, 0)
    except YAMLError as err:
        raise ValueError("no YAML") from err


def is_bag_directory(folder: Path) -> bool:
    """Return whether a folder is one ROS 2 recording: it has metadata.yaml, or holds the files of one split alone."""
    if (folder / "metadata.yaml").is_file():
        return any(STORAGE.search(entry.name) for entry in folder.iterdir())
    try:
        files = storage_files(folder)
    except (LogError, OSError):
        return False
    # The recorder counts its files up: bag_0, bag_1, …
    stems = [file.name.split(".")[0].rpartition("_") for file in files]
    numbers = [int(number) if stem and number.isdecimal() else -1 for stem, _, number in stems]
    counted = len({stem for stem, _, _ in stems}) == 1 and all(b == a + 1 for a, b in pairwise(numbers))
    return len(files) > 1 and counted and min(numbers) >= 0


def check_spans(directory: Path, spans: Sequence[FileTimes]) -> list[str]:
    """Return the overlaps between the log times of files that were found by name.

    Returns
    -------
    list of str
        A sentence for each pair of files that overlap.

    Raises
    ------
    LogError
        They are recordings of different times.
    """
    ordered, odd = sorted(spans), []
    for number, (before, after) in enumerate(pairwise(ordered)):
        pause_s = (after.begin_ns - max(span.end_ns for span in ordered[: number + 1])) / 1e9
        if pause_s > LONGEST_SPLIT_GAP_S:
            why = f"not one recording: {pause_s / 3600:.1f} h pass between {before.file} and {after.file}"
            raise LogError(directory, why, f"name one of {listed([span.file for span in ordered])}")
        overlap_s = (min(before.end_ns, after.end_ns) - after.begin_ns) / 1e9
        if overlap_s > LEAST_OVERLAP_S:
            odd.append(
                f"{before.file} and {after.file} overlap by {overlap_s:.0f} s and were read as one recording; "
                "if they are two, name one of them"
            )
    return odd


def unpacked_name(name: str) -> str:
    """Return the name of a file without suffixes of compression and archives: ``a.mcap`` for ``a.mcap.zst``."""
    return _ARCHIVE_END.sub("", _PACKED_END.sub("", name))


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts ``drive_10`` after ``drive_9``."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", str(path))]


_SERIES_NAME = re.compile(r"^(|.*?[_\-. ])((?:19|20)\d\d[\d_.\-T]*|\d+)(\.[A-Za-z]\w*)$")
"""Groups: the text before a count or a date; the count, or the date (and count); the suffix."""

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
    match = _SERIES_NAME.match(path.name)
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
    numbered = filter(None, (numbered_file(file) for file in path.parent.iterdir() if file.name.startswith(match[1])))
    between = (one for one in numbered if one.series == first.series and first.order <= one.order <= last.order)
    return [one.path for one in sorted(between, key=lambda one: (one.order, one.number))]


def files_of_log(path: Path) -> list[Path]:
    """Return the files of a log: all files of a directory, the files of a range, or the one file."""
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.is_file())
    return split_files(path) or [path]


def log_name(path: Path) -> str:
    """Return a log's name: its (first) file without suffix, or its directory; ``log`` where the name is only dots.

    Runs are directories of this name: ``..mcap`` must not be the directory of all runs, nor ``..`` the one above it.
    """
    if path == STANDARD_INPUT:
        return "stdin"
    files = split_files(path)
    path_of_name = (
        path if isinstance(path, UrlPath) else Path(os.path.normpath((files[0] if files else path).absolute()))
    )
    name = path_of_name.name
    if not path_of_name.is_dir():
        plain = unpacked_name(name)
        name = Path(plain).stem if plain == name or Path(plain).suffix in {*LOG_SUFFIXES, ".csv"} else plain
    return name if name.strip(".") else "log"


def file_sha256(file: Path, ended: Event | None = None) -> str:
    """Return the SHA-256 of a file (hex), of its beginning once `ended` is set."""
    import hashlib

    digest, piece = hashlib.sha256(), bytearray(1 << 18)
    with open_regular(file) as stream:
        while not (ended and ended.is_set()) and (count := stream.readinto(piece)):
            digest.update(memoryview(piece)[:count])
    return digest.hexdigest()
