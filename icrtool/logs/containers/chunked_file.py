"""What MCAP files and ROS 1 bags share: one file of chunks, each with its first and last log time in an index."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.channel import WHOLE, Block, Cut, Problems, with_possible_times
from icrtool.logs.containers.decompress import LARGEST_CHUNK_BYTES, DecompressionError, Inflation, Space

MCAP_SCHEMA, MCAP_CHANNEL, MCAP_MESSAGE, MCAP_MESSAGE_INDEX = 3, 4, 5, 7
BAG_MESSAGE, BAG_CONNECTION = 2, 7
"""Operation codes of records."""

MOST_ROWS, _LEAST_RECORD_BYTES = 1 << 18, 16
"""Messages that a scan finds at a time; a record has more bytes than this."""


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


class Spaces(NamedTuple):
    """Memory for a chunk as it is in the file, for its records, and for records of several chunks."""

    packed: Space
    records: Space
    joined: Space


class ChunkedFile(ABC):
    """An open file of chunks; `_chunks` is None for a file without an index, which is read from start to end."""

    _chunks: Sequence[IndexedChunk] | None = None

    def __init__(self, path: Path) -> None:
        self._path = path
        self.files = [path]
        self.problems = Problems(path.name)
        self._inflation = Inflation()
        # A block is used while the next one is made.
        self._spaces, self._other_spaces = (Spaces(Space(), Space(), Space()) for _ in range(2))
        self._stream = path.open("rb")
        self._at = 0
        self._size = path.stat().st_size

    @abstractmethod
    def _indexed(self, wanted: frozenset[int], cut: Cut) -> Iterator[Block]:
        """Yield the messages of the wanted channels by the index."""

    @abstractmethod
    def _read_in_order(self, *, learn: bool = False) -> Iterator[Block]:
        """Yield the messages by reading the records one after the other, as far as they can be read.

        Parameters
        ----------
        learn : remember what other records state about channels
        """

    @abstractmethod
    def _scan(self, data: Bytes, begin: int, messages: Ints, others: Ints) -> tuple[int, int, int]:
        """Find records as `icrtool.logs.containers.record_table` does; what only opens a file does not load it."""

    @abstractmethod
    def _learn(self, row: Ints, data: Bytes) -> None:
        """Remember a record that is no message; `row` is its column in `others` of the scan of `data`."""

    def blocks(self, wanted: frozenset[int], cut: Cut = WHOLE) -> Generator[Block]:
        """Yield the messages of the wanted channels, chunk by chunk; the next is made while one is used."""
        if not wanted:
            return
        blocks = self._read_in_order() if self._chunks is None else self._indexed(wanted, cut)
        with ThreadPoolExecutor(1) as pool:
            pending = pool.submit(next, blocks, None)
            while (block := pending.result()) is not None:
                pending = pool.submit(next, blocks, None)
                yield block
        self._free()

    def _learn_all(self) -> None:
        """Read a file without an index for what its records state about channels."""
        for _ in self._read_in_order(learn=True):
            pass
        self._free()

    def _free(self) -> None:
        """Give back the memory of chunks: a directory holds many files open."""
        for space in (*self._spaces, *self._other_spaces):
            space.free()

    def share_read(self) -> float:
        """Return the share of the file that has been read, 0 to 1."""
        return self._at / max(self._size, 1)

    def close(self) -> None:
        """Release the file."""
        self._stream.close()

    def span_ns(self) -> tuple[int, int] | None:
        """Return first and last log time by the index, None without one."""
        known = [chunk for chunk in self._chunks or () if chunk.begin_ns]
        return (min(chunk.begin_ns for chunk in known), max(chunk.end_ns for chunk in known)) if known else None

    def _read(self, at: int, length: int) -> Bytes:
        """Return bytes of the file, as many as there are, in the space for chunks as they are there."""
        space = self._spaces.packed.of(max(min(length, self._size - at), 0))
        self._at = at
        found = space[: os.preadv(self._stream.fileno(), [space.data], at) if len(space) else 0]
        found.flags.writeable = False  # as what is decompressed: the kernels are compiled once
        return found

    def _chunk(
        self, at: int, length: int, place: int, unpack: Callable[[Bytes], Bytes], *, learn: bool, cut: bool
    ) -> Iterator[Block]:
        """Yield the messages of a chunk.

        Parameters
        ----------
        at, length : of its content in the file
        place : byte of the file at which its record begins
        unpack : returns the records in its content
        cut : the content is cut off
        """
        try:
            if length > LARGEST_CHUNK_BYTES:
                raise DecompressionError(f"it claims {length} bytes")
            data = unpack(self._read(at, length))
        except DecompressionError as err:
            if not cut:
                self.problems.add(f"chunk at byte {place} left out: {err.args[0]}")
            return
        stop, begin = 0, -1
        while begin < stop < len(data):
            begin = stop
            block, stop = self._scanned(data, begin, learn=learn)
            yield block
        self._spaces, self._other_spaces = self._other_spaces, self._spaces
        if stop < len(data) and not cut:
            self.problems.add(f"chunk at byte {place}: {len(data) - stop} of {len(data)} bytes left out, damaged")

    def _scanned(self, data: Bytes, begin: int = 0, *, learn: bool = False) -> tuple[Block, int]:
        """Return the messages among the records from `begin`, and the first byte not consumed."""
        most = min((len(data) - begin) // _LEAST_RECORD_BYTES + 1, MOST_ROWS)
        messages, others = np.empty((4, most), np.int64), np.empty((4, most if learn else 0), np.int64)
        count, other, stop = self._scan(data, begin, messages, others)
        for row in others[:, :other].T:
            self._learn(row, data)
        return with_possible_times(Block(data, *messages[:, :count]), self.problems), stop
