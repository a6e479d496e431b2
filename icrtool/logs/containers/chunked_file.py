"""What MCAP files and ROS 1 bags share: one file of chunks, each with its first and last log time in an index."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Event
from typing import NamedTuple, TypeVar

import numpy as np

from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.channel import WHOLE, Block, Cut, Problems, made_ahead, with_possible_times
from icrtool.logs.containers.decompress import (
    LARGEST_CHUNK_BYTES,
    DecompressionError,
    Inflation,
    Packed,
    Space,
    decompress,
)
from icrtool.logs.containers.record_table import Records
from icrtool.logs.containers.source import NEAR_BYTES, Held, LocalFile, Source
from icrtool.records.samples import InputFile

Item = TypeVar("Item")

THREADS, BLOCKS_AHEAD = 2, 3
"""Threads that make blocks of chunks, and blocks that they make while one is used."""

READERS, SPANS_AHEAD, BYTES_AHEAD = 8, 16, 1 << 26
"""Of a distant file: threads that read, and pieces and their bytes that are read before they are used."""

FIRST_SPAN_BYTES, SPAN_BYTES = 1 << 22, 1 << 24
"""Of chunks that are read in one piece: of the first one, for which all that uses them waits, and of each other one."""

JOINED_BYTES = 1 << 22
"""Of the wanted records of chunks that are made one block: each block has a cost of its own."""


MIXED = "topics share compressed chunks, which are read whole"


class Chunk(NamedTuple):
    """A chunk in a file, and its entry in the index.

    Attributes
    ----------
    at, length : where its content is in the file; of a bag's index where its record begins
    channels : those it holds, None without an entry
    begin_ns, end_ns : first and last log time in it, 0 where they are not known
    index_length : of the message index records that follow it
    size : of its records, decompressed; -1 where there is no chunk in its place
    compression : as the log calls it
    messages : where its messages begin in the records that are read, by the index; None without one
    ranges : begin and end (2, n) of its wanted records, where only those are read
    held : its bytes, read ahead of a distant file
    records : the wanted ones, likewise
    """

    at: int
    length: int = 0
    channels: frozenset[int] | None = None
    begin_ns: int = 0
    end_ns: int = 0
    index_length: int = 0
    size: int = 0
    compression: str = ""
    messages: Ints | None = None
    ranges: Ints | None = None
    held: Held | None = None
    records: bytes | None = None

    @property
    def wanted_bytes(self) -> int:
        """Bytes of the records that are read."""
        return max(self.size, 0) if self.ranges is None else int((self.ranges[1] - self.ranges[0]).sum())


class NotByRangesError(Exception):
    """A distant file that cannot be read by ranges."""


class _PartError(DecompressionError):
    """Damaged records, read without their checksum: those of the chunks beside them are computed, too."""


class Spaces(NamedTuple):
    """Memory for a chunk as it is in the file, for its records, and for those of several chunks."""

    packed: Space
    records: Space
    joined: Space


class ChunkedFile(ABC):
    """An open file of chunks; `_chunks` is None for a file without an index, which is read from start to end.

    Parameters
    ----------
    source : where its bytes come from; None: from the file on disk
    """

    _chunks: Sequence[Chunk] | None = None
    _chunk_head = 0
    """Bytes before the content of a chunk, in which its record begins."""

    def __init__(self, path: Path, source: Source | None = None) -> None:
        self._path = path
        self.problems = Problems(path.name)
        self._inflation = Inflation()
        self._spaces: deque[Spaces] = deque()
        self._free()
        self._mixed = False
        self._source: Source = source if source is not None else LocalFile(path)
        self._at = 0
        self._size = self._source.size

    @abstractmethod
    def _packed(self, chunk: Chunk, space: Space, *, cut: bool = False) -> Packed:
        """Read a chunk from the file.

        Parameters
        ----------
        space : for the chunk as it is in the file
        cut : it is cut off

        Raises
        ------
        DecompressionError
            Its header is damaged.
        """

    @abstractmethod
    def _read_in_order(self, *, learn: bool = False) -> Iterator[Block]:
        """Yield the messages by reading the records one after the other, as far as they can be read.

        Parameters
        ----------
        learn : remember what other records state about channels
        """

    @abstractmethod
    def _scan(self, data: Bytes, begin: int, hint: Ints | None = None) -> Records:
        """Find records as `icrtool.logs.containers.record_table` does."""

    @abstractmethod
    def _learn(self, data: Bytes, record: tuple[int, int, int, int]) -> None:
        """Remember a record that is no message, of `others` of the scan of `data`."""

    def blocks(self, wanted: frozenset[int], cut: Cut = WHOLE) -> Generator[Block]:
        """Yield the messages of the wanted channels, in the order of their chunks; the next are made meanwhile."""
        if not wanted:
            return
        if self._chunks is None:
            yield from made_ahead(self._read_in_order())
        else:
            needed = (one for one in self._chunks if cut.needs(one.channels, one.begin_ns, one.end_ns, wanted))
            if self._source.distant:
                yield from self._indexed(self._read_ahead(needed, wanted))
            else:
                yield from self._indexed(self._located(chunk, wanted) for chunk in needed)
        self._free()

    def _read_ahead(self, chunks: Iterable[Chunk], wanted: frozenset[int]) -> Iterator[Chunk]:
        """Yield chunks of a distant file as `_located` does, with what is wanted of the next ones read meanwhile."""
        pending: deque[tuple[int, Future[list[Chunk]]]] = deque()
        with ThreadPoolExecutor(READERS) as pool:
            try:
                for group, begin, end in self._spans(chunks, wanted):
                    pending.append((end - begin, pool.submit(self._located_in, group, begin, end, wanted)))
                    while len(pending) > SPANS_AHEAD or sum(length for length, _ in pending) > BYTES_AHEAD:
                        yield from pending.popleft()[1].result()
                while pending:
                    yield from pending.popleft()[1].result()
            finally:
                for _, group_read in pending:
                    group_read.cancel()

    def _spans(self, chunks: Iterable[Chunk], wanted: frozenset[int]) -> Iterator[tuple[list[Chunk], int, int]]:
        """Yield chunks that follow one another and are read whole, and begin and end of what is read in one piece."""
        group: list[Chunk] = []
        begin = end = 0
        most = FIRST_SPAN_BYTES
        for chunk in chunks:
            first, last = self._span(chunk, wanted)
            if group and not (end <= first <= end + NEAR_BYTES and last - begin <= most and last > first):
                yield group, begin, end
                group, most = [], SPAN_BYTES
            begin, end = (begin if group else first), last
            group.append(chunk)
        if group:
            yield group, begin, end

    def _located_in(self, group: Sequence[Chunk], begin: int, end: int, wanted: frozenset[int]) -> list[Chunk]:
        if 0 < end - begin <= 2 * LARGEST_CHUNK_BYTES:
            self._source.hold(begin, end - begin)
        return [self._located(chunk, wanted) for chunk in group]

    @abstractmethod
    def _span(self, chunk: Chunk, wanted: frozenset[int]) -> tuple[int, int]:
        """Return begin and end of a chunk with its message index; an empty range where it is read in part."""

    def _indexed(self, chunks: Iterable[Chunk]) -> Iterator[Block]:
        """Yield the messages in some chunks."""
        with ThreadPoolExecutor(THREADS) as pool:
            groups = ((group, self._next_spaces()) for group in _groups(chunks))
            begun = ((group, spaces, pool.submit(self._joined, group, spaces)) for group, spaces in groups)
            for group, spaces, pending in ahead(begun, BLOCKS_AHEAD):
                self._at = group[-1].at
                yield from self._sound(group, spaces, pending.result)

    def _sound(
        self, group: Sequence[Chunk], spaces: Spaces, made: Callable[[], tuple[Block, Inflation]]
    ) -> Iterator[Block]:
        """Yield the block that is made of some chunks; where anything is damaged, one for each, or what is sound."""
        try:
            block, inflation = made()
        except (DecompressionError, MemoryError) as err:
            for chunk in group:
                if len(group) == 1 or isinstance(err, _PartError):
                    yield from self._read_chunk(chunk, spaces)
                else:
                    yield from self._sound([chunk], spaces, partial(self._joined, [chunk], spaces))
        else:
            self._inflation.left += inflation.left
            yield with_possible_times(block, self.problems)

    def _joined(self, group: Sequence[Chunk], spaces: Spaces) -> tuple[Block, Inflation]:
        """Return the messages of some chunks, and how much less than allowed these inflate.

        Raises
        ------
        DecompressionError
            Something is damaged, or not as the index states.
        """
        size = sum(chunk.wanted_bytes for chunk in group)
        if size > LARGEST_CHUNK_BYTES:
            raise DecompressionError(f"it claims {size} bytes")
        inflation = Inflation(0)
        joined = spaces.joined.of(size + 1)
        messages: list[Ints] = []
        data, stop = joined[:0], 0
        for chunk in group:
            begin = stop
            data = joined[: begin + self._unpack(chunk, spaces, joined[begin:], inflation)]
            hint = None if chunk.messages is None else chunk.messages + begin
            found, _, stop = self._scan(data, begin, hint)
            if stop < len(data):
                raise DecompressionError if chunk.ranges is None else _PartError
            messages.append(found)
        return Block(data, *np.concatenate(messages, axis=1)), inflation

    def _unpack(self, chunk: Chunk, spaces: Spaces, target: Bytes, inflation: Inflation) -> int:
        """Decompress the wanted records of a chunk, and return how many bytes they have.

        Raises
        ------
        DecompressionError
            As `decompress`, or they have more than the index states.
        """
        if chunk.records is not None:
            target[: len(chunk.records)] = np.frombuffer(chunk.records, np.uint8)
            return len(chunk.records)
        packed = self._packed(chunk, spaces.packed)
        inflation.count(len(packed.data), packed.claimed)
        if packed.claimed >= len(target):
            raise DecompressionError("larger than the index states")
        data = decompress(packed, target)
        if not np.may_share_memory(data, target):
            target[: len(data)] = data
        return len(data)

    def _located(self, chunk: Chunk, wanted: frozenset[int]) -> Chunk:  # noqa: ARG002 - all its records are read
        """Return a chunk of the index with what reading its wanted records needs."""
        return chunk

    def _learn_all(self) -> None:
        """Read a file without an index for what its records state about channels.

        Raises
        ------
        NotByRangesError
            It is a distant one, which is better read from disk.
        """
        if self._source.distant:
            raise NotByRangesError
        for _ in self._read_in_order(learn=True):
            pass
        self._free()

    def _free(self) -> None:
        """Give back the memory of chunks: a directory holds many files open."""
        self._spaces = deque(Spaces(Space(), Space(), Space()) for _ in range(BLOCKS_AHEAD + 1))

    def _next_spaces(self) -> Spaces:
        """Return the memory of the block that was used first."""
        self._spaces.rotate(1)
        return self._spaces[0]

    def inputs(self, ended: Event) -> tuple[InputFile, ...]:
        """Return the file with its SHA-256."""
        return self._source.inputs(ended)

    def transfer(self) -> str:
        """Return how much was read of a distant file, and why all of it."""
        return "; ".join(filter(None, [self._source.transfer(), MIXED if self._mixed and self._source.distant else ""]))

    def share_read(self) -> float:
        """Return the share of the file that has been read, 0 to 1."""
        return self._at / max(self._size, 1)

    def close(self) -> None:
        """Release the file."""
        self._source.close()

    def span_ns(self) -> tuple[int, int] | None:
        """Return first and last log time by the index, None without one."""
        known = [chunk for chunk in self._chunks or () if chunk.begin_ns]
        return (min(chunk.begin_ns for chunk in known), max(chunk.end_ns for chunk in known)) if known else None

    def _bytes(self, at: int, count: int) -> bytes:
        """Return bytes of the file, as many as there are."""
        return self._source.read_at(at, count)

    def _content(self, at: int, length: int, space: Space, held: Held | None = None) -> Bytes:
        """Return bytes of a chunk, as many as there are.

        Parameters
        ----------
        held : where they are, if they were read ahead

        Raises
        ------
        DecompressionError
            They are more than a chunk may have.
        """
        if length > LARGEST_CHUNK_BYTES:
            raise DecompressionError(f"it claims {length} bytes")
        length = max(min(length, self._size - at), 0)
        if held is not None and held.at <= at and at + length <= held.at + len(held.data):
            return np.frombuffer(held.data, np.uint8, length, at - held.at)
        content = space.of(length)
        return content[: self._source.read_into(at, content)]

    def _read_chunk(self, chunk: Chunk, spaces: Spaces, *, learn: bool = False, cut: bool = False) -> Iterator[Block]:
        """Yield the messages of a chunk; `cut`: it is cut off."""
        place = chunk.at - self._chunk_head
        self._at = min(chunk.at, self._size)
        try:
            packed = self._packed(chunk, spaces.packed, cut=cut)
            self._inflation.count(len(packed.data), packed.claimed)
            data = decompress(packed, spaces.records.of(packed.claimed + 1))
        except (DecompressionError, MemoryError) as err:
            if not cut:
                self.problems.add(f"chunk at byte {place} left out: {err}")
            return
        stop, begin = 0, -1
        while begin < stop < len(data):
            begin = stop
            block, stop = self._scanned(data, begin, learn=learn)
            yield block
        if stop < len(data) and not cut:
            self.problems.add(f"chunk at byte {place}: {len(data) - stop} of {len(data)} bytes left out, damaged")

    def _scanned(self, data: Bytes, begin: int = 0, *, learn: bool = False) -> tuple[Block, int]:
        """Return the messages among the records from `begin`, and the first byte not consumed."""
        messages, others, stop = self._scan(data, begin)
        for record in others if learn else ():
            self._learn(data, record)
        return with_possible_times(Block(data, *messages), self.problems), stop


def _groups(chunks: Iterable[Chunk]) -> Iterator[list[Chunk]]:
    """Yield the chunks in groups of up to `JOINED_BYTES` of wanted records, or of one chunk."""
    group: list[Chunk] = []
    size = 0
    for chunk in chunks:
        size += chunk.wanted_bytes
        if group and size > JOINED_BYTES:
            yield group
            group, size = [], chunk.wanted_bytes
        group.append(chunk)
    if group:
        yield group


def ahead(items: Iterable[Item], count: int) -> Iterator[Item]:
    """Yield items, each once `count` more of them have been made."""
    made: deque[Item] = deque()
    for item in items:
        made.append(item)
        if len(made) > count:
            yield made.popleft()
    yield from made
