"""What MCAP files and ROS 1 bags share: one file of chunks, each with its first and last log time in an index."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.channel import WHOLE, Block, Cut, Problems, with_possible_times
from icrtool.logs.containers.decompress import LARGEST_CHUNK_BYTES, DecompressionError, Inflation, Space

MCAP_SCHEMA, MCAP_CHANNEL, MCAP_MESSAGE, MCAP_MESSAGE_INDEX = 3, 4, 5, 7
BAG_MESSAGE, BAG_CONNECTION = 2, 7
"""Operation codes of records."""

BLOCKS_AHEAD = 2
"""Made while one is used: the thread that makes them does not wait for the one that uses them."""

MOST_ROWS, _LEAST_RECORD_BYTES = 1 << 18, 16
"""Messages that a scan finds at a time; a record has more bytes than this."""


class Chunk(NamedTuple):
    """A chunk in a file, and its entry in the index.

    Attributes
    ----------
    at, length : where its content is in the file; of a bag only where its record begins
    channels : those it holds, None without an entry
    begin_ns, end_ns : first and last log time in it, 0 where they are not known
    index_length : of the message index records that follow it
    size : of its records, decompressed
    stored : they are not compressed
    """

    at: int
    length: int = 0
    channels: frozenset[int] | None = None
    begin_ns: int = 0
    end_ns: int = 0
    index_length: int = 0
    size: int = 0
    stored: bool = False


class Spaces(NamedTuple):
    """Memory for a chunk as it is in the file, for its records, and for records of several chunks."""

    packed: Space
    records: Space
    joined: Space


class ChunkedFile(ABC):
    """An open file of chunks; `_chunks` is None for a file without an index, which is read from start to end."""

    _chunks: Sequence[Chunk] | None = None

    def __init__(self, path: Path) -> None:
        self._path = path
        self.files = [path]
        self.problems = Problems(path.name)
        self._inflation = Inflation()
        # One block is used while the next ones are made.
        self._spaces = deque(Spaces(Space(), Space(), Space()) for _ in range(BLOCKS_AHEAD + 1))
        self._stream = path.open("rb")
        self._at = 0
        self._size = path.stat().st_size

    @abstractmethod
    def _indexed(self, chunks: list[Chunk], wanted: frozenset[int]) -> Iterator[Block]:
        """Yield the messages of the wanted channels in some chunks."""

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
        if self._chunks is None:
            blocks = self._read_in_order()
        else:
            needed = [one for one in self._chunks if cut.needs(one.channels, one.begin_ns, one.end_ns, wanted)]
            blocks = self._indexed(needed, wanted)
        with ThreadPoolExecutor(1) as pool:
            pending = deque(pool.submit(next, blocks, None) for _ in range(BLOCKS_AHEAD))
            while (block := pending.popleft().result()) is not None:
                pending.append(pool.submit(next, blocks, None))
                yield block
        self._free()

    def _learn_all(self) -> None:
        """Read a file without an index for what its records state about channels."""
        for _ in self._read_in_order(learn=True):
            pass
        self._free()

    def _free(self) -> None:
        """Give back the memory of chunks: a directory holds many files open."""
        for spaces in self._spaces:
            for space in spaces:
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

    def _bytes(self, at: int, count: int) -> bytes:
        """Return bytes of the file, as many as there are."""
        self._stream.seek(at)
        return self._stream.read(count)

    def _read(self, at: int, length: int) -> Bytes:
        """Return bytes of the file, as many as there are, in the space for chunks as they are there."""
        space = self._spaces[0].packed.of(max(min(length, self._size - at), 0))
        self._at = min(at, self._size)
        self._stream.seek(self._at)
        found = space[: self._stream.readinto(space.data)]
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
        self._spaces.rotate(1)
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
