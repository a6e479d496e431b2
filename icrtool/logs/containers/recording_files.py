"""Files of one recording: of a bag directory, and of a recorder that split its files or was restarted.

The path ``drive_{0..3}.bag`` names all files from the first to the last number or date in the braces. Commands accept
such a path, and tables show it.
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
"""Suffixes of recordings. A file with such a suffix counts as a recording; an error is reported if it is unreadable."""

PACKED_SUFFIX = r"\.(?:zstd|zst|gz|lz4|bz2|xz)"
"""Pattern of the suffixes of compressed files."""

_PACKED_END = re.compile(rf"{PACKED_SUFFIX}$", re.IGNORECASE)
_ARCHIVE_END = re.compile(r"\.(?:zip|tar|tgz|tbz2|txz)$", re.IGNORECASE)

STORAGE = re.compile(rf"\.(mcap|db3)(?:{PACKED_SUFFIX})?$")
"""Pattern of the end of the name of a storage file of a ROS 2 bag."""

LARGEST_METADATA_BYTES = 1 << 18
"""Largest size of metadata.yaml [bytes]. The file of a bag of 200 topics has about 100,000 bytes."""

_DEEPEST = 20
"""Largest depth of nested values in metadata.yaml."""

LONGEST_SPLIT_GAP_S = 3600.0
"""Longest time between the files of one recording [s]. A recorder splits a recording without a gap."""

LEAST_OVERLAP_S = 1.0
"""Overlap of two files from which on it is reported [s]. The files of a split recording overlap by less, because a
recorder fills one buffer while it writes another."""


class FileTimes(NamedTuple):
    """First and last log time of the messages of a file [ns], and the name of the file."""

    begin_ns: int
    end_ns: int
    file: str


def storage_files(directory: Path) -> list[Path]:
    """Return the storage files of a directory, ``bag_10`` after ``bag_9``.

    Raises
    ------
    LogError
        The directory has no storage file, or holds several recordings, of which the user must name one.
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
        raise LogError(directory, f"not a ROS 2 bag directory; it holds {others[0].name}", f"name {others[0].name}")
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
    """The storage files of a recording.

    Attributes
    ----------
    files : the storage files in their order
    message_compression : compression of each single message; empty for none
    by_name : whether the files were found by their names, because no metadata.yaml lists them
    """

    files: list[Path]
    message_compression: str = ""
    by_name: bool = False


def bag_files(directory: Path, report: Callable[[str, str], None]) -> BagFiles:
    """Return the existing files that metadata.yaml lists; all storage files of the directory where it lists none.

    A recorder that was killed leaves no metadata.yaml, or an incomplete one.

    Parameters
    ----------
    directory : directory of the bag
    report : called with code and text of each finding about metadata.yaml

    Raises
    ------
    LogError
        The directory has no storage file, or holds several recordings.
    """
    file = directory / "metadata.yaml"
    names, message_compression, trouble = list[str](), "", ""
    if not file.is_file():
        trouble = "no metadata.yaml"
    else:
        try:
            if file.stat().st_size > LARGEST_METADATA_BYTES:
                raise ValueError("too long")
            names, message_compression = _parse_metadata(file.read_text(encoding="utf-8"))
        except (ValueError, OSError, RecursionError):
            trouble = "its metadata.yaml cannot be read"
    if trouble:
        report("log_part_unreadable", f"{trouble}; its storage files were found by their names")
    there, missing = dict[Path, None](), dict[str, None]()
    for name in (Path(name).name for name in names):
        # The file may have been decompressed after the recording.
        stored = [directory / name, directory / unpacked_name(name)]
        existing = next((file for file in stored if os.path.isfile(file)), None)  # noqa: PTH113 - also of a name that is too long
        if existing is not None:
            there[existing] = None
        else:
            missing[stored[0].name] = None
    if missing:
        report("log_parts_contradict", f"metadata.yaml names files that are not there: {listed([*missing])}")
    if there:
        return BagFiles([*there], message_compression)
    return BagFiles(storage_files(directory), message_compression, by_name=True)


def _parse_metadata(text: str) -> tuple[list[str], str]:
    """Return the names of the storage files, and the compression of each message, that a metadata.yaml states.

    Raises
    ------
    ValueError
        The text is not YAML, has an alias, or is not the metadata of a bag.
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
        The text is not YAML, is nested too deeply, has a key that is no text, or has an alias. With aliases a short
        text can expand to gigabytes.
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
    """Return whether a folder is one ROS 2 recording: with metadata.yaml, or with the files of one split recording."""
    if (folder / "metadata.yaml").is_file():
        return any(STORAGE.search(entry.name) for entry in folder.iterdir())
    try:
        files = storage_files(folder)
    except (LogError, OSError):
        return False
    # The recorder numbers its files: bag_0, bag_1, …
    stems = [file.name.split(".")[0].rpartition("_") for file in files]
    numbers = [int(number) if stem and number.isdecimal() else -1 for stem, _, number in stems]
    counted = len({stem for stem, _, _ in stems}) == 1 and all(b == a + 1 for a, b in pairwise(numbers))
    return len(files) > 1 and counted and min(numbers) >= 0


def check_spans(directory: Path, spans: Sequence[FileTimes]) -> list[str]:
    """Return a sentence for each pair of successive files whose log times overlap.

    Raises
    ------
    LogError
        More than `LONGEST_SPLIT_GAP_S` lie between two files: they are different recordings.
    """
    ordered, overlaps = sorted(spans), []
    for number, (before, after) in enumerate(pairwise(ordered)):
        pause_s = (after.begin_ns - max(span.end_ns for span in ordered[: number + 1])) / 1e9
        if pause_s > LONGEST_SPLIT_GAP_S:
            why = f"not one recording: {pause_s / 3600:.1f} h pass between {before.file} and {after.file}"
            raise LogError(directory, why, f"name one of {listed([span.file for span in ordered])}")
        overlap_s = (min(before.end_ns, after.end_ns) - after.begin_ns) / 1e9
        if overlap_s > LEAST_OVERLAP_S:
            overlaps.append(
                f"{before.file} and {after.file} overlap by {overlap_s:.0f} s and were read as one recording; "
                "if they are two recordings, name one of them"
            )
    return overlaps


def unpacked_name(name: str) -> str:
    """Return the name of a file without the suffixes of compression and archives, ``a.mcap`` for ``a.mcap.zst``."""
    return _ARCHIVE_END.sub("", _PACKED_END.sub("", name))


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Return the sorting key of a path, by which ``drive_10`` comes after ``drive_9``."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", str(path))]


_SERIES_NAME = re.compile(r"^(|.*?[_\-. ])((?:19|20)\d\d[\d_.\-T]*|\d+)(\.[A-Za-z]\w*)$")
"""Pattern of a numbered file; groups: the text before the count or date, the count or date (and count), the suffix."""

STANDARD_INPUT = Path("-")
"""Path that stands for a log on standard input."""

_RANGE = re.compile(r"^(.*)\{([\d_.\-T]+?)\.\.([\d_.\-T]+)\}(\.[A-Za-z]\w*)$")


class NumberedFile(NamedTuple):
    """A file whose name ends with a count or a date.

    Attributes
    ----------
    series : folder, begin of the name, and suffix, which all files of a series have in common
    number : the count or date in the name
    order : the numbers in the count or date, by which files are sorted
    path : path of the file
    """

    series: tuple[Path, str, str]
    number: str
    order: tuple[int, ...]
    path: Path

    @property
    def is_count(self) -> bool:
        """Whether the number is a count, which increases by one from file to file."""
        return len(self.order) == 1 and self.number.isdecimal()


def numbered_file(path: Path) -> NumberedFile | None:
    """Return a file with its series and number; None if its name has neither a count nor a date."""
    match = _SERIES_NAME.match(path.name)
    if match is None:
        return None
    order = tuple(int(part) for part in re.findall(r"\d+", match[2]))
    return NumberedFile((path.parent, match[1], match[3]), match[2], order, path)


def split_path(files: Sequence[Path]) -> Path:
    """Return the path ``drive_{0..3}.bag`` that stands for sorted files of one series.

    Raises
    ------
    ValueError
        The files are not of one series.
    """
    first, last = numbered_file(files[0]), numbered_file(files[-1])
    if first is None or last is None or first.series != last.series:
        raise ValueError("files: not of one series")
    folder, begin, suffix = first.series
    return folder / f"{begin}{{{first.number}..{last.number}}}{suffix}"


def split_files(path: Path) -> list[Path]:
    """Return the files that a path with a range in braces names, in their order; empty for any other path."""
    match = _RANGE.match(path.name)
    if match is None or path.exists() or not path.parent.is_dir():
        return []
    first, last = (numbered_file(path.with_name(f"{match[1]}{number}{match[4]}")) for number in (match[2], match[3]))
    if first is None or last is None:
        return []
    numbered = filter(None, (numbered_file(file) for file in path.parent.iterdir() if file.name.startswith(match[1])))
    between = (file for file in numbered if file.series == first.series and first.order <= file.order <= last.order)
    return [file.path for file in sorted(between, key=lambda file: (file.order, file.number))]


def files_of_log(path: Path) -> list[Path]:
    """Return the files of a log: all files of a directory, the files of a range, or the one file."""
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.is_file())
    return split_files(path) or [path]


def log_name(path: Path) -> str:
    """Return the name of a log: its (first) file without suffix, or its directory; ``log`` for a name of dots alone.

    The directory of a run has this name. ``..mcap`` must not become the directory of all runs, nor the folder above it.
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
    """Return the SHA-256 of a file (hex); hashing stops once `ended` is set."""
    import hashlib

    digest, piece = hashlib.sha256(), bytearray(1 << 18)
    with open_regular(file) as stream:
        while not (ended and ended.is_set()) and (count := stream.readinto(piece)):
            digest.update(memoryview(piece)[:count])
    return digest.hexdigest()
