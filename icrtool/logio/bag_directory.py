"""ROS 2 bag directories: metadata.yaml, one or more storage files, compressed by file or by message."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from icrtool.errors import LogError
from icrtool.logio.channel import Block, Channel, Container
from icrtool.logio.mcap_file import McapFile
from icrtool.logio.sqlite_bag import SqliteBag

_STORAGE = re.compile(r"\.(mcap|db3)(\.zstd|\.zst)?$")


@dataclass(frozen=True, slots=True)
class _Metadata:
    """The part of metadata.yaml that reading needs."""

    files: tuple[str, ...]
    compression_mode: str
    compression_format: str


class BagDirectory:
    """A directory of storage files, read as one log.

    Raises
    ------
    LogError
        No storage file in it, an unreadable metadata.yaml, or none of its files can be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._problems: list[str] = []
        self._scratch: tempfile.TemporaryDirectory[str] | None = None
        self._parts: list[Container] = []
        metadata = _read_metadata(path)
        self.files = self._find_files(metadata)
        try:
            for file in self.files:
                self._open_part(file, metadata)
        except BaseException:
            self.close()
            raise
        if not self._parts:
            raise LogError(path, "no storage file in it can be read", "; ".join(self._problems))
        self._numbers: list[dict[int, int]] = []
        self.channels = self._merge_channels()

    @property
    def problems(self) -> list[str]:
        """What could not be read, of the directory and of each file."""
        return self._problems + [problem for part in self._parts for problem in part.problems]

    def share_read(self) -> float:
        """Return the mean over the files."""
        return sum(part.share_read() for part in self._parts) / max(len(self._parts), 1)

    def close(self) -> None:
        """Release all files."""
        for part in self._parts:
            part.close()
        if self._scratch is not None:
            self._scratch.cleanup()

    def blocks(self, wanted: frozenset[int]) -> Iterator[Block]:
        """Yield the messages of the wanted channels, file by file."""
        import numpy as np

        for part, numbers in zip(self._parts, self._numbers, strict=True):
            own = frozenset(number for number, merged in numbers.items() if merged in wanted)
            table = np.full(max(numbers, default=0) + 1, -1, np.int64)
            for number, merged in numbers.items():
                table[number] = merged
            for block in part.blocks(own):
                known = (block.channel >= 0) & (block.channel < len(table))
                yield block._replace(channel=np.where(known, table[np.where(known, block.channel, 0)], -1))

    def _find_files(self, metadata: _Metadata | None) -> list[Path]:
        if metadata is not None and metadata.files:
            named = [self._path / Path(name).name for name in metadata.files]
            missing = [file.name for file in named if not file.is_file()]
            if missing and len(missing) < len(named):
                self._problems.append(f"{self._path.name}: metadata.yaml names files that are not there: {', '.join(missing)}")
            named = [file for file in named if file.is_file()]
            if named:
                return named
        found = sorted(
            (file for file in self._path.iterdir() if file.is_file() and _STORAGE.search(file.name)), key=_natural_key
        )
        if not found:
            raise LogError(self._path, "not a ROS 2 bag directory", "it holds no .mcap or .db3 file")
        if metadata is None:
            self._problems.append(f"{self._path.name}: no metadata.yaml; the storage files in it were read by name")
        return found

    def _open_part(self, file: Path, metadata: _Metadata | None) -> None:
        by_message = metadata is not None and metadata.compression_mode.upper() == "MESSAGE"
        message_compression = metadata.compression_format if metadata is not None and by_message else ""
        try:
            storage = self._unpacked(file) if file.suffix in (".zstd", ".zst") else file
            if storage.suffix == ".mcap":
                self._parts.append(McapFile(storage))
            else:
                self._parts.append(SqliteBag(storage, message_compression))
        except LogError as err:
            self._problems.append(str(err))

    def _unpacked(self, file: Path) -> Path:
        """Decompress a storage file to a temporary folder, a piece at a time."""
        import zstandard

        if self._scratch is None:
            self._scratch = tempfile.TemporaryDirectory(prefix="icrtool-")
        target = Path(self._scratch.name) / file.stem
        try:
            with file.open("rb") as source, target.open("wb") as sink:
                zstandard.ZstdDecompressor().copy_stream(source, sink)
        except zstandard.ZstdError as err:
            if not target.stat().st_size:
                raise LogError(file, "does not decompress", str(err)) from err
            self._problems.append(f"{file.name}: cut off or damaged ({err}); what could be decompressed was read")
        except OSError as err:
            needed = shutil.disk_usage(self._scratch.name).free
            raise LogError(file, f"cannot be decompressed: {err.strerror}", f"{needed} bytes are free for it") from err
        return target

    def _merge_channels(self) -> list[Channel]:
        """Give a topic that stands in several files one number."""
        merged: dict[tuple[str, str, str], Channel] = {}
        for part in self._parts:
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
            self._numbers.append(numbers)
        return list(merged.values())


def _natural_key(path: Path) -> list[tuple[int, str]]:
    """Sort ``bag_10`` after ``bag_9``."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _read_metadata(path: Path) -> _Metadata | None:
    """Return what metadata.yaml says; None where there is none."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    file = path / "metadata.yaml"
    if not file.is_file():
        return None
    try:
        document = YAML(typ="safe").load(file.read_text(encoding="utf-8"))
        information = document["rosbag2_bagfile_information"]
        return _Metadata(
            files=tuple(str(name) for name in information["relative_file_paths"]),
            compression_mode=str(information.get("compression_mode") or ""),
            compression_format=str(information.get("compression_format") or ""),
        )
    except (YAMLError, KeyError, TypeError, AttributeError, ValueError, OSError) as err:
        raise LogError(file, "not a rosbag2 metadata file", "remove it to read the storage files by name") from err
