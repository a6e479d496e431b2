"""What MCAP files and ROS 1 bags share: one file of chunks, each with its first and last log time in an index."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from icrtool.logs.containers.channel import Problems
from icrtool.logs.containers.decompress import Inflation
from icrtool.logs.containers.record_table import RecordTable


class IndexedChunk(Protocol):
    """First and last log time of a chunk [ns], 0 where they are not known."""

    @property
    def begin_ns(self) -> int:
        """First log time."""
        ...

    @property
    def end_ns(self) -> int:
        """Last log time."""
        ...


class ChunkedFile:
    """An open file of chunks; `_chunks` is None for a file without an index, which is read from start to end."""

    _chunks: Sequence[IndexedChunk] | None = None

    def __init__(self, path: Path) -> None:
        self._path = path
        self.files = [path]
        self.problems = Problems(path.name)
        self._table = RecordTable()
        self._inflation = Inflation()
        self._stream = path.open("rb")
        self._size = path.stat().st_size

    def share_read(self) -> float:
        """Return the share of the file that has been read, 0 to 1."""
        return self._stream.tell() / max(self._size, 1)

    def close(self) -> None:
        """Release the file."""
        self._stream.close()

    def begin_ns(self) -> int | None:
        """Return the log time of the first message by the index, None without one."""
        return min((chunk.begin_ns for chunk in self._chunks or () if chunk.begin_ns), default=None)

    def end_ns(self) -> int | None:
        """Return the log time of the last message by the index, None without one."""
        return max((chunk.end_ns for chunk in self._chunks or () if chunk.end_ns), default=None)
