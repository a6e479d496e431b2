"""Open a log: the container is recognised by its content, not by its file name."""

from __future__ import annotations

import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from threading import Event
from types import MappingProxyType
from typing import BinaryIO, NamedTuple

from icrtool.errors import LogChangedError, LogError
from icrtool.logs.containers import mcap_file, ros1_bag, sqlite_bag
from icrtool.logs.containers.bag_directory import BagDirectory
from icrtool.logs.containers.chunked_file import NotByRangesError
from icrtool.logs.containers.container import Container, Origin
from icrtool.logs.containers.mcap_file import McapFile
from icrtool.logs.containers.recording_files import STANDARD_INPUT, files_of_log, inputs_of, split_files
from icrtool.logs.containers.ros1_bag import Ros1Bag
from icrtool.logs.containers.source import RemoteFile, changed_since, fetch_folder, read_by_ranges
from icrtool.logs.containers.sqlite_bag import SqliteBag
from icrtool.logs.containers.unpack import ScratchFolder, is_packed, save, unpack
from icrtool.records.places import NOT_REGULAR, SAVE_IT, UrlPath, is_special
from icrtool.records.samples import InputFile

MOST_CHANNELS = 2048
"""Topics of a log, each publisher of a ROS 1 bag by itself, that are looked at: some 0.5 ms of time each."""

# A bag of any version: one of another than 2.0 is refused by name.
_CONTAINERS: dict[bytes, type[McapFile | Ros1Bag | SqliteBag]] = {
    mcap_file.MAGIC: McapFile,
    ros1_bag.MAGIC[:9]: Ros1Bag,
    sqlite_bag.MAGIC: SqliteBag,
}
_LONGEST_MAGIC = 16

KINDS = "an .mcap file, a ROS 1 .bag, a ROS 2 bag directory or a .db3 file, also compressed"


class Brought(NamedTuple):
    """A log that lies on disk now, perhaps packed.

    Attributes
    ----------
    inputs : what was read for it; none of one that was there before
    transfer : how it came over a connection
    distant : as in `BagDirectory`
    """

    log: Path
    inputs: tuple[InputFile, ...] = ()
    transfer: str = ""
    distant: Mapping[str, RemoteFile] = MappingProxyType({})

    def words(self) -> str:
        """Return how it came over a connection, and how much of what is distant was read since."""
        return "; ".join(filter(None, [self.transfer, read_by_ranges(self.distant.values()) if self.distant else ""]))


def open_log(path: Path, share: Callable[[float], None] | None = None) -> Container:
    """Return the opened container at a path or an address; ``-``: of what comes on standard input.

    Parameters
    ----------
    share : called with the share of a log that was fetched or unpacked

    Raises
    ------
    LogError
        The path does not exist, the file is empty, is not a known container, or nothing in it can be read.
    """
    try:
        remote, why = RemoteFile(path) if isinstance(path, UrlPath) else None, ""
        if remote is not None:
            opened = _by_ranges(path, remote)
            if not isinstance(opened, str):
                return opened
            why = opened
        elif path != STANDARD_INPUT and not _is_packed_file(path):
            return _plain_log(path)
        scratch = ScratchFolder()
        try:
            return _unpacked_log(path, _brought(path, scratch.path, remote, why, share), scratch, share)
        except BaseException:
            scratch.close()
            raise
    except FileNotFoundError as err:
        raise LogError(path, "no such file or directory") from err
    except OSError as err:
        raise LogError(path, "cannot be read", err.strerror or str(err)) from err


FileState = tuple[int, int, int] | None


def states_of(path: Path) -> dict[str, FileState]:
    """Return what changes where a file of a log is written to, by their paths; nothing of an address."""
    return {} if isinstance(path, UrlPath) else {str(file): _state(file) for file in files_of_log(path)}


def check_unchanged(path: Path, before: Mapping[str, FileState], inputs: Iterable[InputFile]) -> None:
    """Refuse a log that was written to while it was read.

    Parameters
    ----------
    before : of `states_of`, before it was opened
    inputs : the files as they were read

    Raises
    ------
    LogChangedError
        It was.
    """
    if isinstance(path, UrlPath):
        changed = changed_since(path, inputs)
    else:
        changed = any(_state(Path(one.path)) != before.get(one.path) for one in inputs)
    if changed:
        raise LogChangedError(path, "changed while it was read", "is it being recorded? read it when it is whole")


def _state(file: Path) -> FileState:
    try:
        status = file.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


@contextmanager
def plain_file(path: Path) -> Iterator[tuple[Path, InputFile]]:
    """Give a file on disk, fetched and decompressed where it is at an address or compressed; and what was read for it.

    Raises
    ------
    LogError
        It cannot be read, or decompressed to its end.
    OSError
        It cannot be read.
    """
    scratch = ScratchFolder()
    try:
        file, inputs, *_ = _brought(path, scratch.path, RemoteFile(path) if isinstance(path, UrlPath) else None)
        if _is_packed_file(file):
            file, problem = unpack(file, scratch.path / "unpacked")
            if problem:
                raise LogError(path, "does not decompress", problem)
        yield file, (inputs or inputs_of([path], Event()))[0]
    finally:
        scratch.close()


def _unpacked_log(
    path: Path, brought: Brought, scratch: ScratchFolder, share: Callable[[float], None] | None
) -> Container:
    """Return the container of a log that lies in a temporary folder, or is unpacked there, which is removed with it."""
    log, problem = brought.log, ""
    try:
        if _is_packed_file(log):
            log, problem = unpack(log, scratch.path / "unpacked", share)
        container = _plain_log(log, brought.distant)
    except LogError as err:
        # Its own path is gone when the user reads this.
        raise LogError(path, err.why, "; ".join(filter(None, [problem, err.advice]))) from err
    if problem:
        container.report(problem)
    container.path, container.files = path, [path]
    container.origin = Origin(brought.inputs, brought.words, scratch.close)
    return container


def _by_ranges(path: Path, remote: RemoteFile) -> Container | str:
    """Return the container of a file at an address, where it has an index; else why it has to be fetched."""
    if remote.is_folder:
        return "SQLite files, or packed"
    if not remote.has_ranges:
        return "its server gives no parts of a file"
    start = remote.read_at(0, 512)
    kind = container_of(BytesIO(start))
    if kind is None:
        if is_packed(start):
            return "it is packed"
        raise LogError(path, "not a log", f"a log is {KINDS}")
    if kind is SqliteBag:
        return "an SQLite file"
    try:
        container = McapFile(path, source=remote) if kind is McapFile else Ros1Bag(path, remote)
    except NotByRangesError:
        return "it has no index"
    container.origin = Origin((remote.input,), lambda: read_by_ranges([remote]))
    return _usable(container, path)


def _brought(
    path: Path, folder: Path, remote: RemoteFile | None, why: str = "", share: Callable[[float], None] | None = None
) -> Brought:
    """Return a log that was fetched or saved to a folder where it is not on disk; `why` it is fetched."""
    if remote is None and path != STANDARD_INPUT:
        return Brought(path)
    if remote is None:
        if sys.stdin.isatty():
            raise LogError(path, "standard input is a terminal", "pipe a log into it, or name one")
        log = folder / "stdin"
        digest = save(sys.stdin.buffer, log)
        return Brought(log, (InputFile(str(path), log.stat().st_size, digest),))
    log = folder / (path.name or "log")
    if remote.is_folder:
        log.mkdir()
        inputs, distant = fetch_folder(remote.path, log, share)
    else:
        inputs, distant = (remote.fetch(log, share),), {}
    size = sum(one.bytes for one in inputs if one.sha256 is not None) / 1e6
    transfer = f"{size:.3g} MB fetched to a temporary folder: {why}" if size else ""
    return Brought(log, inputs, transfer, distant)


def _is_packed_file(path: Path) -> bool:
    """Return whether there is a file that `unpack` reads."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return is_packed(stream.read(512))


def _usable(container: Container, path: Path) -> Container:
    """Return a container with the channels that are looked at; refuse one without any."""
    if (count := len(container.channels)) > MOST_CHANNELS:
        kept = sorted(container.channels, key=lambda channel: -(channel.count or 0))[:MOST_CHANNELS]
        container.channels = sorted(kept, key=lambda channel: channel.id)
        container.report(f"{count:,} topics and publishers: the {MOST_CHANNELS:,} of most messages are used")
    if container.problems and not container.channels:
        container.close()
        raise LogError(path, "nothing in it can be read", container.problems[0])
    return container


def _plain_log(path: Path, distant: Mapping[str, RemoteFile] = MappingProxyType({})) -> Container:
    """Return the container of a log that is not packed; `distant` as in `BagDirectory`."""
    if files := split_files(path):
        return _usable(BagDirectory(path, files), path)
    if stat.S_ISDIR(path.stat().st_mode):
        return _usable(BagDirectory(path, distant=distant), path)
    if is_special(path):
        # Opening a pipe would block, and every container needs random access.
        raise LogError(path, NOT_REGULAR, SAVE_IT)
    with path.open("rb") as stream:
        if not stream.read(1):
            raise LogError(path, "an empty file", "the recording never began, or the copy failed")
        if (container := container_of(stream)) is not None:
            return _usable(container(path), path)
    raise LogError(path, "not a log", f"a log is {KINDS}")


def container_of(stream: BinaryIO) -> type[McapFile | Ros1Bag | SqliteBag] | None:
    """Return which container the first bytes of a file are of; None where it is no log."""
    stream.seek(0)
    start = stream.read(_LONGEST_MAGIC)
    return next((container for magic, container in _CONTAINERS.items() if start.startswith(magic)), None)
