"""Opening of logs: the content of a file, not its name, decides the container; several files may be one log."""

from __future__ import annotations

import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

import numpy as np

from icrtool.errors import LogChangedError, LogError
from icrtool.kernels.arrays import Ints
from icrtool.logs.containers import mcap_file, ros1_bag, sqlite_bag
from icrtool.logs.containers.chunked_file import NotByRangesError
from icrtool.logs.containers.container import Channel, Container, Cut, MessageBlock, Origin
from icrtool.logs.containers.mcap_file import McapFile
from icrtool.logs.containers.recording_files import (
    STANDARD_INPUT,
    BagFiles,
    FileTimes,
    bag_files,
    check_spans,
    file_sha256,
    files_of_log,
    split_files,
    unpacked_name,
)
from icrtool.logs.containers.ros1_bag import Ros1Bag
from icrtool.logs.containers.source import RemoteFile, SavedBytes, changed_since, fetch_folder, read_by_ranges
from icrtool.logs.containers.sqlite_bag import SqliteBag
from icrtool.logs.containers.unpack import ScratchFolder, is_packed, save_unpacked, unpack
from icrtool.records.notes import Note
from icrtool.records.places import NOT_REGULAR, SAVE_IT, UrlPath, is_special
from icrtool.records.samples import InputFile

MOST_CHANNELS = 1024
"""Largest number of channels that are read: topics, or publishers in a ROS 1 bag. A channel takes 0.5 to 2 ms."""

MOST_FILES = 5000
"""Largest number of files of a recording. Three days with a file for each minute are 4,320 files; a file takes about
1 ms."""

# Bags of every version are recognised, so that `Ros1Bag` can name a version that it does not read.
_CONTAINERS: dict[bytes, type[McapFile | Ros1Bag | SqliteBag]] = {
    mcap_file.MCAP_MAGIC: McapFile,
    ros1_bag.BAG_MAGIC[:9]: Ros1Bag,
    sqlite_bag.SQLITE_MAGIC: SqliteBag,
}

_NOT_A_LOG = (
    "not a log",
    "a log is an .mcap file, a ROS 1 .bag, a ROS 2 bag directory or a .db3 file, also compressed",
)


def open_log(path: Path, share: Callable[[float], None] | None = None) -> Container:
    """Return the open container of the log at a path or an address; ``-`` is standard input.

    Parameters
    ----------
    path : path or address of the log
    share : called with the share of the log that was fetched or unpacked, 0 to 1

    Raises
    ------
    LogError
        The path does not exist, the file is empty or no log, or nothing in it can be read.
    """
    try:
        remote, why_fetched = RemoteFile(path) if isinstance(path, UrlPath) else None, ""
        if remote is not None:
            opened = _open_by_ranges(path, remote)
            if not isinstance(opened, str):
                return opened
            why_fetched = opened
        elif path != STANDARD_INPUT and not _is_packed_file(path):
            return _plain_log(path)
        with ExitStack() as undo:
            scratch = ScratchFolder()
            undo.callback(scratch.close)
            log, origin, distant = _bring_to_disk(path, scratch.path, remote, why_fetched, share)
            problem = None
            try:
                if _is_packed_file(log):
                    log, problem = unpack(log, scratch.path / "unpacked", share)
                container = _plain_log(log, distant)
            except LogError as err:
                # The temporary file no longer exists when the user reads the message, which names the log instead.
                raise LogError(
                    path, err.why, "; ".join(filter(None, [problem.text if problem is not None else "", err.advice]))
                ) from err
            undo.pop_all()
    except FileNotFoundError as err:
        raise LogError(path, "no such file or directory") from err
    except OSError as err:
        raise LogError(path, "cannot be read", err.strerror or str(err)) from err
    if problem is not None:
        container.report(problem.code, problem.text)
    container.path, container.files = path, [path]
    container.origin = origin._replace(remove=scratch.close)
    return container


FileState = tuple[int, int, int]
"""Inode, size [bytes] and time of modification [ns] of a file."""


def states_of(path: Path) -> dict[str, FileState]:
    """Return the state of each file of a log by its path; empty for an address."""
    states: dict[str, FileState] = {}
    for file in () if isinstance(path, UrlPath) else files_of_log(path):
        with suppress(OSError):
            status = file.stat()
            states[str(file)] = status.st_ino, status.st_size, status.st_mtime_ns
    return states


def check_unchanged(path: Path, before: Mapping[str, FileState], inputs: Iterable[InputFile]) -> None:
    """Refuse a log that was written to while it was read.

    Parameters
    ----------
    before : result of `states_of` before the log was opened
    inputs : the files that were read

    Raises
    ------
    LogChangedError
        The log was written to while it was read.
    """
    if isinstance(path, UrlPath):
        changed = changed_since(path, inputs)
    else:
        now = states_of(path)
        changed = any(now.get(file.path) != before.get(file.path) for file in inputs)
    if changed:
        raise LogChangedError(path, "changed while it was read", "if it is being recorded, read it when it is complete")


@contextmanager
def plain_file(path: Path) -> Iterator[tuple[Path, InputFile]]:
    """Yield the path of a plain file on disk, and the file that was read for it.

    A file at an address is fetched, and a compressed file is decompressed, to a temporary folder.

    Raises
    ------
    LogError
        The file cannot be fetched, or cannot be decompressed to its end.
    OSError
        The file cannot be read.
    """
    with closing(ScratchFolder()) as scratch:
        remote = RemoteFile(path) if isinstance(path, UrlPath) else None
        file, origin, _ = _bring_to_disk(path, scratch.path, remote)
        if _is_packed_file(file):
            file, problem = unpack(file, scratch.path / "unpacked")
            if problem is not None:
                raise LogError(path, "does not decompress", problem.text)
        yield file, origin.inputs[0] if origin.inputs else InputFile(str(path), path.stat().st_size, file_sha256(path))


def _open_by_ranges(path: Path, remote: RemoteFile) -> Container | str:
    """Return the container of a file at an address, or the reason why the file has to be fetched to disk."""
    if remote.is_folder:
        return "SQLite files, or packed"
    if not remote.has_ranges:
        start = remote.start()
        if start and container_of(BytesIO(start)) is None and not is_packed(start):
            raise LogError(path, *_NOT_A_LOG)
        return "its server does not send parts of a file"
    start = remote.read_at(0, 512)
    kind = container_of(BytesIO(start))
    if kind is None and is_packed(start):
        return "it is packed"
    if kind is None:
        raise LogError(path, *_NOT_A_LOG)
    if kind is SqliteBag:
        return "an SQLite file"
    try:
        container = (McapFile if kind is McapFile else Ros1Bag)(path, source=remote)
    except NotByRangesError:
        return "it has no index"
    container.origin = Origin((remote.input,), lambda: read_by_ranges([remote]))
    return _with_limited_channels(container, path)


def _bring_to_disk(
    path: Path,
    folder: Path,
    remote: RemoteFile | None,
    why_fetched: str = "",
    share: Callable[[float], None] | None = None,
) -> tuple[Path, Origin, Mapping[str, RemoteFile]]:
    """Return the path of a log on disk, perhaps packed; a log that is not on disk is fetched or saved to a folder.

    Parameters
    ----------
    remote : file or folder at the address; None: the log is no address
    why_fetched : reason why a file is fetched

    Returns
    -------
    path, origin of the log, and its files that are read by ranges, as in `BagDirectory`
    """
    distant: dict[str, RemoteFile] = {}
    if remote is not None:
        log = folder / (path.name or "log")
        if remote.is_folder:
            log.mkdir()
            inputs, distant = fetch_folder(remote.path, log, share)
        else:
            inputs = (remote.fetch(log, share),)
        size = sum(file.bytes for file in inputs if file.sha256 is not None) / 1e6
        fetched = f"{size:.3g} MB fetched to a temporary folder: {why_fetched}" if size else ""

        def transfer() -> str:
            return "; ".join(filter(None, [fetched, read_by_ranges(distant.values()) if distant else ""]))

        return log, Origin(inputs, transfer), distant
    if path != STANDARD_INPUT:
        return path, Origin(), distant
    if sys.stdin is None or sys.stdin.closed:
        raise LogError(path, "standard input is closed", "pipe a log into it, or name one")
    if sys.stdin.isatty():
        raise LogError(path, "standard input is a terminal", "pipe a log into it, or name one")
    log = folder / "stdin"

    def check(start: bytes) -> None:
        if start and not is_packed(start) and container_of(BytesIO(start)) is None:
            raise LogError(path, *_NOT_A_LOG)

    saved = SavedBytes.into(folder)
    digest = save_unpacked(sys.stdin.buffer, log, check, lambda count: saved.check(path, count))
    return log, Origin((InputFile(str(path), log.stat().st_size, digest),)), distant


def _is_packed_file(path: Path) -> bool:
    """Return whether a path is a compressed file or an archive, which `unpack` reads."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return is_packed(stream.read(512))


def _with_limited_channels(container: Container, path: Path) -> Container:
    """Return a container with at most `MOST_CHANNELS` channels.

    Raises
    ------
    LogError
        The container is damaged and has no channels.
    """
    if (count := len(container.channels)) > MOST_CHANNELS:
        kept = sorted(container.channels, key=lambda channel: -(channel.count or 0))[:MOST_CHANNELS]
        container.channels = sorted(kept, key=lambda channel: channel.id)
        container.report(
            "log_limit_reached", f"{count:,} topics and publishers: the {MOST_CHANNELS:,} with most messages are used"
        )
    if container.problems and not container.channels:
        container.close()
        raise LogError(path, "nothing in it can be read", container.problems[0].sentence)
    return container


def _plain_log(path: Path, distant: Mapping[str, RemoteFile] = MappingProxyType({})) -> Container:
    """Return the container of a log that is not packed; `distant` as in `BagDirectory`."""
    if (files := split_files(path)) or stat.S_ISDIR(path.stat().st_mode):
        return _with_limited_channels(BagDirectory(path, files, distant), path)
    if is_special(path):
        # Opening a pipe would block, and every container needs random access.
        raise LogError(path, NOT_REGULAR, SAVE_IT)
    with path.open("rb") as stream:
        if not stream.read(1):
            raise LogError(path, "an empty file", "the recording never began, or the copy failed")
        if (container := container_of(stream)) is not None:
            return _with_limited_channels(container(path), path)
    raise LogError(path, *_NOT_A_LOG)


def container_of(stream: BinaryIO) -> type[McapFile | Ros1Bag | SqliteBag] | None:
    """Return the class of container that reads a file, by its first bytes; None for a file that is no log."""
    stream.seek(0)
    start = stream.read(max(map(len, _CONTAINERS)))
    return next((container for magic, container in _CONTAINERS.items() if start.startswith(magic)), None)


class BagDirectory(Container):
    """A directory of storage files, or the files of a split recording, read as one log.

    Parameters
    ----------
    files : files of a split recording; empty: the storage files of the directory
    distant : MCAP files at an address by their names, which are empty in the directory; they are read by ranges if they
        have an index

    Raises
    ------
    LogError
        The directory has no storage file, none that can be read, or, without metadata.yaml, several recordings.
    """

    def __init__(
        self, path: Path, files: Sequence[Path] = (), distant: Mapping[str, RemoteFile] = MappingProxyType({})
    ) -> None:
        super().__init__(path)
        self._distant = distant
        self._scratch: ScratchFolder | None = None
        self._parts: dict[Path, Container] = {}
        self._reading = 0
        try:
            bag = BagFiles([*files]) if files else bag_files(path, self.report)
            self._by_name = bag.by_name
            if (count := len(bag.files)) > MOST_FILES:
                raise LogError(path, f"{count} storage files; at most {MOST_FILES} are read", "join some of them")
            for file in bag.files:
                try:
                    self._parts[file] = self._open(file, bag.message_compression)
                except LogError as err:
                    self.report("log_part_unreadable", f"{file.name}: {err.why}; {err.advice}")
                except OSError as err:
                    self.report("log_part_unreadable", f"{file.name}: cannot be read; {err.strerror}")
            if not self._parts:
                raise LogError(
                    path, "no storage file in it can be read", "; ".join(problem.sentence for problem in self.problems)
                )
        except BaseException:
            self.close()
            raise
        self.files = [*self._parts]
        self._numbers: list[tuple[Ints, Ints]] = []
        self.channels = self._merge_channels()

    @property
    def problems(self) -> list[Note]:
        """Findings about unreadable data in the directory and in each file."""
        return super().problems + [problem for part in self._parts.values() for problem in part.problems]

    def share_read(self) -> float:
        """Return the share of the log that has been read, 0 to 1: the mean of the shares of the files."""
        return (self._reading + [*self._parts.values()][self._reading].share_read()) / len(self._parts)

    def close(self) -> None:
        """Close all files, and remove the temporary files of the log."""
        for part in self._parts.values():
            part.close()
        if self._scratch is not None:
            self._scratch.close()
        super().close()

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and the last log time of all files [ns]; None if a file has no index."""
        known = [span for part in self._parts.values() if (span := part.span_ns()) is not None]
        if len(known) < len(self._parts):
            return None
        return min(begin for begin, _ in known), max(end for _, end in known)

    def _yield_blocks(self, wanted: frozenset[int], cut: Cut) -> Iterator[MessageBlock]:
        """Yield the messages of the wanted channels, file by file.

        Raises
        ------
        LogError
            The files were found by their names, and are recordings of different times; raised after the last block.
        """
        spans = []
        parts = zip(self._parts.items(), self._numbers, strict=True)
        for self._reading, ((file, part), (own, merged)) in enumerate(parts):
            if not len(own):
                continue
            begins, ends = [], []
            wanted_here, whole = (
                frozenset(own[np.isin(merged, list(numbers))].tolist()) for numbers in (wanted, cut.whole)
            )
            for block in part.blocks(wanted_here, cut._replace(whole=whole)):
                if len(block.log_time_ns):
                    begins.append(int(block.log_time_ns.min()))
                    ends.append(int(block.log_time_ns.max()))
                row = np.searchsorted(own, block.channel).clip(max=len(own) - 1)
                yield block._replace(channel=np.where(own[row] == block.channel, merged[row], -1))
            self.mixed |= part.mixed
            if begins:
                spans.append(FileTimes(min(begins), max(ends), file.name))
        if self._by_name:
            for overlap in check_spans(self.path, spans):
                self.report("log_parts_contradict", overlap)

    def _open(self, file: Path, message_compression: str) -> Container:
        """Return the container of a storage file; a compressed file is decompressed to a temporary folder."""
        storage = file
        if unpacked_name(file.name) != file.name:
            self._scratch = self._scratch or ScratchFolder()
            storage, problem = unpack(file, self._scratch.path / str(len(self._parts)))
            if problem is not None:
                self.report(problem.code, f"{file.name}: {problem.text}")
        if storage.suffix == ".bag":
            return Ros1Bag(storage)
        if (source := self._distant.get(storage.name)) is not None:
            try:
                return McapFile(storage, message_compression, source)
            except NotByRangesError:
                source.fetch(storage, None)
        return (McapFile if storage.suffix == ".mcap" else SqliteBag)(storage, message_compression)

    def _merge_channels(self) -> list[Channel]:
        """Return one channel for each topic of the directory, and store the numbers of the channels of each file."""
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
            numbers_of_part = np.array(sorted(numbers), np.int64)
            self._numbers.append(
                (numbers_of_part, np.array([numbers[number] for number in numbers_of_part.tolist()], np.int64))
            )
        return list(merged.values())
