"""ROS 2 bag directories: metadata.yaml, one or more storage files, compressed by file or by message."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from icrtool.errors import LogError
from icrtool.kernels.arrays import Ints
from icrtool.logs.containers.chunked_file import NotByRangesError
from icrtool.logs.containers.container import Block, Channel, Container, Cut
from icrtool.logs.containers.mcap_file import McapFile
from icrtool.logs.containers.recording_files import Span, check_spans, storage_files, unpacked_name
from icrtool.logs.containers.ros1_bag import Ros1Bag
from icrtool.logs.containers.source import RemoteFile
from icrtool.logs.containers.sqlite_bag import SqliteBag
from icrtool.logs.containers.unpack import ScratchFolder, unpack
from icrtool.records.text import some_of

_LARGEST_METADATA_BYTES, _DEEPEST = 1 << 18, 20
"""Of metadata.yaml: the largest of a bag of 200 topics has some 100,000 bytes."""

_MOST_FILES = 5000
"""Of a recording: one of three days that begins a file every minute has 4,320. Each takes about 1 ms."""


@dataclass(frozen=True, slots=True)
class _Metadata:
    """The part of metadata.yaml that reading needs; `message_compression` is empty where there is none."""

    files: tuple[str, ...] = ()
    message_compression: str = ""


class BagDirectory(Container):
    """A directory of storage files, or several files of one split recording, read as one log.

    Parameters
    ----------
    files : of a recording that is not a directory
    distant : MCAP files that are empty there, and are read by ranges where they have an index, by their names

    Raises
    ------
    LogError
        No storage file in it, none that can be read, or, without metadata.yaml, more than one recording.
    """

    def __init__(
        self, path: Path, files: Sequence[Path] = (), distant: Mapping[str, RemoteFile] = MappingProxyType({})
    ) -> None:
        super().__init__(path)
        self._distant = distant
        self._scratch: ScratchFolder | None = None
        self._parts: dict[Path, Container] = {}
        self._by_name = False
        self._reading = 0
        metadata = self._read_metadata() if not files else _Metadata()
        try:
            files = files or self._find_files(metadata.files)
            if len(files) > _MOST_FILES:
                raise LogError(path, f"{len(files)} storage files; at most {_MOST_FILES} are read", "join some of them")
            for file in files:
                self._open_part(file, metadata.message_compression)
            if not self._parts:
                raise LogError(path, "no storage file in it can be read", "; ".join(self.problems))
        except BaseException:
            self.close()
            raise
        self.files = [*self._parts]
        self._numbers: list[tuple[Ints, Ints]] = []
        self.channels = self._merge_channels()

    @property
    def problems(self) -> list[str]:
        """What could not be read, of the directory and of each file."""
        return super().problems + [problem for part in self._parts.values() for problem in part.problems]

    def share_read(self) -> float:
        """Return the mean over the files, which are read one after the other."""
        return (self._reading + [*self._parts.values()][self._reading].share_read()) / len(self._parts)

    def close(self) -> None:
        """Release all files."""
        for part in self._parts.values():
            part.close()
        if self._scratch is not None:
            self._scratch.close()
        super().close()

    def span_ns(self) -> tuple[int, int] | None:
        """Return first and last log time of all files, None where one of them has no index."""
        known = [span for part in self._parts.values() if (span := part.span_ns()) is not None]
        if not known or len(known) < len(self._parts):
            return None
        begins, ends = zip(*known, strict=True)
        return min(begins), max(ends)

    def _stored(self, wanted: frozenset[int], cut: Cut) -> Iterator[Block]:
        """Yield the messages of the wanted channels, file by file.

        Raises
        ------
        LogError
            At the end: the files, found by name, are recordings of different times.
        """
        spans = []
        parts = zip(self._parts.items(), self._numbers, strict=True)
        for self._reading, ((file, part), (own, merged)) in enumerate(parts):
            if not len(own):
                continue
            begins, ends = [], []
            mine, whole = (frozenset(own[np.isin(merged, list(numbers))].tolist()) for numbers in (wanted, cut.whole))
            for block in part.blocks(mine, cut._replace(whole=whole)):
                if len(block.log_time_ns):
                    begins.append(int(block.log_time_ns.min()))
                    ends.append(int(block.log_time_ns.max()))
                place = np.searchsorted(own, block.channel).clip(max=len(own) - 1)
                yield block._replace(channel=np.where(own[place] == block.channel, merged[place], -1))
            self.mixed |= part.mixed
            if begins:
                spans.append(Span(min(begins), max(ends), file.name))
        if self._by_name:
            for odd in check_spans(self.path, spans):
                self.report(odd)

    def _read_metadata(self) -> _Metadata:
        """Return the content of metadata.yaml; a recorder that was killed leaves no such file, or half of it."""
        file = self.path / "metadata.yaml"
        if not file.is_file():
            self.report("no metadata.yaml; its storage files were found by their names")
            return _Metadata()
        try:
            if file.stat().st_size > _LARGEST_METADATA_BYTES:
                raise ValueError("too long")
            return _metadata(file.read_text(encoding="utf-8"))
        except (ValueError, OSError, RecursionError):
            self.report("its metadata.yaml cannot be read; its storage files were found by their names")
            return _Metadata()

    def _find_files(self, names: tuple[str, ...]) -> list[Path]:
        """Return the files that metadata.yaml names and that are there; all storage files where it names none."""
        named = list(dict.fromkeys(self._there(Path(name).name) for name in names))
        there = [file for file in named if os.path.isfile(file)]  # noqa: PTH113 - also of a name that is too long
        if len(there) < len(named):
            found = frozenset(there)
            missing = [file.name for file in named if file not in found]
            self.report(f"metadata.yaml names files that are not there: {some_of(missing)}")
        if there:
            return there
        self._by_name = True
        return storage_files(self.path)

    def _there(self, name: str) -> Path:
        """Return the path of a file that metadata.yaml names; of one that was unpacked since, without that suffix."""
        file, unpacked = self.path / name, self.path / unpacked_name(name)
        return unpacked if not os.path.isfile(file) and os.path.isfile(unpacked) else file  # noqa: PTH113 - as below

    def _open_part(self, file: Path, message_compression: str) -> None:
        try:
            storage = file if unpacked_name(file.name) == file.name else self._unpacked(file)
            self._parts[file] = self._part(storage, message_compression)
        except LogError as err:
            self.report(f"{file.name}: {err.why}; {err.advice}")
        except OSError as err:
            self.report(f"{file.name}: cannot be read; {err.strerror}")

    def _part(self, storage: Path, message_compression: str) -> Container:
        if storage.suffix == ".bag":
            return Ros1Bag(storage)
        if (source := self._distant.get(storage.name)) is not None:
            try:
                return McapFile(storage, message_compression, source)
            except NotByRangesError:
                source.fetch(storage, None)
        return (McapFile if storage.suffix == ".mcap" else SqliteBag)(storage, message_compression)

    def _unpacked(self, file: Path) -> Path:
        """Decompress a storage file to a temporary folder."""
        if self._scratch is None:
            self._scratch = ScratchFolder()
        folder = self._scratch.path / str(len(self._parts))
        folder.mkdir(exist_ok=True)
        path, problem = unpack(file, folder)
        if problem:
            self.report(f"{file.name}: {problem}")
        return path

    def _merge_channels(self) -> list[Channel]:
        """Give a topic that stands in several files one number."""
        merged: dict[tuple[str, str, str], Channel] = {}
        for part in self._parts.values():
            numbers: dict[int, int] = {}
            for channel in part.channels:
                key = (channel.topic, channel.message_type, channel.encoding)
                known = merged.get(key)
                if known is None:
                    merged[key] = replace(channel, id=len(merged))
                else:
                    both = known.count is not None and channel.count is not None
                    count = (known.count or 0) + (channel.count or 0) if both else None
                    merged[key] = replace(known, count=count, definition=known.definition or channel.definition)
                numbers[channel.id] = merged[key].id
            own = np.array(sorted(numbers), np.int64)
            self._numbers.append((own, np.array([numbers[number] for number in own.tolist()], np.int64)))
        return list(merged.values())


def _metadata(text: str) -> _Metadata:
    """Return what the text of a metadata.yaml states about the storage files.

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
    return _Metadata(
        files=tuple(name for name in files if isinstance(name, str)),
        message_compression=str(information.get("compression_format")) if by_message else "",
    )


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
