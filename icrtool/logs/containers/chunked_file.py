"""What MCAP files and ROS 1 bags share: one file of chunks, each with its first and last log time in an index."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.chunk import (
    LARGEST_CHUNK_BYTES,
    Chunk,
    DecompressionError,
    Inflation,
    Packed,
    Records,
    Space,
    decompress,
)
from icrtool.logs.containers.container import Channel, Container, Cut, MessageBlock, made_ahead, work_ahead
from icrtool.logs.containers.source import NEAR_BYTES, Held, LocalFile, RemoteFile

CHUNK_THREADS = 2
"""Number of threads that make blocks of chunks."""

BLOCKS_AHEAD = 3
"""Number of blocks that the threads make while one is used."""

READERS = 8
"""Number of threads that read a distant file."""

SPANS_AHEAD = 16
"""Largest number of pieces of a distant file that are read before they are used."""

BYTES_AHEAD = 1 << 26
"""Largest number of bytes of a distant file that are read before they are used."""

FIRST_SPAN_BYTES = 1 << 22
"""Bytes of chunks in the first piece that is read. It is small because the reader waits for it."""

SPAN_BYTES = 1 << 24
"""Bytes of chunks in each further piece that is read."""

JOINED_BYTES = 1 << 22
"""Bytes of wanted records up to which several chunks become one block: each block has a cost of its own."""

SMALL_PART = 0.5
"""Share of a chunk below which it is decompressed only up to the last wanted message; its checksum is not computed.

In a chunk with images a few percent are wanted, and most recorders close a chunk behind the image that filled it.
"""


class NotByRangesError(Exception):
    """A distant file that cannot be read by ranges."""


class Part(NamedTuple):
    """The part of a chunk that is read.

    Attributes
    ----------
    messages : where messages begin in the records that are read, by the message index; None without an index
    ranges : begin and end (2, n) of the wanted records, where only these are read
    held : its bytes, read ahead of a distant file
    records : the wanted records, read ahead of a distant file
    """

    chunk: Chunk
    messages: Ints | None = None
    ranges: Ints | None = None
    held: Held | None = None
    records: bytes | None = None

    @property
    def wanted_bytes(self) -> int:
        """Bytes of the records that are read."""
        return max(self.chunk.size, 0) if self.ranges is None else int((self.ranges[1] - self.ranges[0]).sum())


class Spaces(NamedTuple):
    """Memory for a chunk as it is in the file, for its records, and for the records of several chunks."""

    packed: Space
    records: Space
    joined: Space


def reused_spaces() -> Iterator[Spaces]:
    """Yield memory for one block after the other; it is used again when the blocks made ahead have all been made."""
    return cycle([Spaces(Space(), Space(), Space()) for _ in range(BLOCKS_AHEAD + 1)])


class ChunkedFile(Container):
    """An open file of chunks; `_chunks` is None for a file without an index, which is read from start to end.

    Parameters
    ----------
    source : where its bytes come from; None: from the file on disk

    Raises
    ------
    NotByRangesError
        It is distant and has no index: it is better read from disk.
    """

    _chunks: Sequence[Chunk] | None = None
    _learns = False
    """Whether channels are still learned from records: while a file without an index is opened."""

    _chunk_head = 0
    """Bytes before the content of a chunk, in which its record begins."""

    _unpacks_parts = False
    """Whether a compressed chunk is decompressed in part: without a checksum to compute, that saves nothing."""

    _scan: Callable[[Bytes, int, Ints | None], Records]
    """Finds records: `scan_mcap` or `scan_bag`."""

    _message_index: Callable[[bytes], tuple[Ints, Ints]]
    """Returns where in its records the messages of a chunk begin (n,), and their channels (n,); none where damaged."""

    def __init__(self, path: Path, message_compression: str = "", source: LocalFile | RemoteFile | None = None) -> None:
        super().__init__(path, message_compression)
        self._inflation = Inflation()
        self._source: LocalFile | RemoteFile = source if source is not None else LocalFile(path)
        self._remote = source if isinstance(source, RemoteFile) else None
        self._at = 0
        self._size = self._source.size
        try:
            self._chunks = self._read_index()
            if self._chunks is None and self._remote is not None:
                raise NotByRangesError
            if self._chunks is None:
                # Its records state what its channels are.
                self._learns = True
                for _ in self._read_in_order():
                    pass
                self._learns = False
            self.channels = self._described_channels()
        except BaseException:
            self.close()
            raise

    @abstractmethod
    def _read_index(self) -> Sequence[Chunk] | None:
        """Return the chunks that the file's index lists, None without an index, or where it does not fit the file.

        Raises
        ------
        LogError
            The file is of another kind.
        """

    @abstractmethod
    def _described_channels(self) -> Sequence[Channel]:
        """Return the channels, as the index or the records describe them."""

    @abstractmethod
    def _packed(self, part: Part, space: Space, needed: int = 0) -> Packed:
        """Read a chunk from the file.

        Parameters
        ----------
        space : for the chunk as it is in the file
        needed : where not 0, this number of bytes of its records is enough, and they are not checked

        Raises
        ------
        DecompressionError
            Its header is damaged.
        """

    @abstractmethod
    def _read_in_order(self) -> Iterator[MessageBlock]:
        """Yield the messages by reading the records one after the other, as far as they can be read."""

    @abstractmethod
    def _learn(self, data: Bytes, record: tuple[int, int, int, int]) -> None:
        """Remember a record that is no message, of `others` of the scan of `data`."""

    def _described(self, chunk: Chunk) -> Chunk:
        """Return a chunk of the index with what its own record states."""
        return chunk

    def _stored(self, wanted: frozenset[int], cut: Cut) -> Iterator[MessageBlock]:
        """Yield the messages of the wanted channels, in the order of their chunks; the next are made meanwhile."""
        if self._chunks is None:
            yield from made_ahead(self._read_in_order())
            return
        needed = (one for one in self._chunks if cut.needs(one.channels, one.begin_ns, one.end_ns, wanted))
        located = (self._located(chunk, wanted) for chunk in needed)
        parts = located if self._remote is None else self._read_ahead(self._remote, needed, wanted)
        groups = zip(_groups(parts), reused_spaces(), strict=False)
        for (group, spaces), made in work_ahead(lambda one: self._joined(*one), groups, CHUNK_THREADS, BLOCKS_AHEAD):
            self._at = group[-1].chunk.at
            try:
                block, inflation = made()
            except (DecompressionError, MemoryError):
                # the sound parts of each chunk, all of them checked
                for part in group:
                    yield from self._read_chunk(part, spaces)
            else:
                self._inflation.left += inflation.left
                yield self._with_possible_times(block)

    def _read_ahead(self, remote: RemoteFile, chunks: Iterable[Chunk], wanted: frozenset[int]) -> Iterator[Part]:
        """Yield parts of a distant file as `_located` does, while the wanted bytes of the next parts are read."""

        def located(span: tuple[list[Chunk], int, int]) -> list[Part]:
            group, begin, end = span
            if 0 < end - begin <= 2 * LARGEST_CHUNK_BYTES:
                remote.hold(begin, end - begin)
            return [self._located(chunk, wanted) for chunk in group]

        spans = _spans(chunks, wanted)
        for _, parts in work_ahead(
            located, spans, READERS, SPANS_AHEAD, lambda span: (span[2] - span[1]) / BYTES_AHEAD
        ):
            yield from parts()

    def _located(self, chunk: Chunk, wanted: frozenset[int]) -> Part:
        """Return what to read of a chunk: its messages by the message index; of a small wanted part also the ranges.

        Where the index cannot be right, the part has neither.
        """
        chunk = self._described(chunk)
        if max(chunk.size, chunk.length, chunk.index_length) > LARGEST_CHUNK_BYTES:
            return Part(chunk)
        is_partly, by_message = chunk.is_partly(wanted), chunk.is_partly(wanted) and chunk.is_stored
        held, behind = None, chunk.at + chunk.length
        if self._remote is not None:
            self.mixed |= is_partly and not by_message
            begin = behind if by_message else chunk.at
            held = self._remote.hold(begin, behind + chunk.index_length - begin)
        places, channels = self._message_index(self._source.read_at(behind, chunk.index_length))
        order = np.argsort(places, kind="stable")
        begins = places[order]
        ends = np.append(begins[1:], chunk.size)
        if not len(begins) or (ends <= begins).any():
            return Part(chunk, held=held)
        is_wanted = np.isin(channels, list(wanted))[order] if is_partly else np.ones(len(begins), np.bool_)
        sizes = (ends - begins)[is_wanted]
        in_part = is_partly and (chunk.is_stored or self._unpacks_parts)
        if not (in_part and 0 < sizes.sum() < SMALL_PART * chunk.size):
            return Part(chunk, begins, held=held)
        first, last = begins[is_wanted], ends[is_wanted]
        apart = first[1:] != last[:-1]
        ranges = np.stack([first[np.append(True, apart)], last[np.append(apart, True)]])
        records = None
        if by_message and self._remote is not None:
            records = self._remote.gather(behind - chunk.size, ranges)
        return Part(chunk, np.cumsum(sizes) - sizes, ranges, held, records)

    def _joined(self, group: Sequence[Part], spaces: Spaces) -> tuple[MessageBlock, Inflation]:
        """Return the messages of some chunks, and what is left of their limit of decompressed bytes.

        Raises
        ------
        DecompressionError
            Something is damaged, or not as the index states.
        """
        size = sum(part.wanted_bytes for part in group)
        if size > LARGEST_CHUNK_BYTES:
            raise DecompressionError(f"it claims {size} bytes")
        inflation = Inflation(0)
        joined = spaces.joined.of(size + 1)
        messages: list[Ints] = []
        data, stop = joined[:0], 0
        for part in group:
            begin = stop
            data = joined[: begin + self._unpack(part, spaces, joined[begin:], inflation)]
            hint = None if part.messages is None else part.messages + begin
            found, _, stop = self._scan(data, begin, hint)
            if stop < len(data):
                raise DecompressionError
            messages.append(found)
        return MessageBlock(data, *np.concatenate(messages, axis=1)), inflation

    def _unpack(self, part: Part, spaces: Spaces, target: Bytes, inflation: Inflation) -> int:
        """Decompress the wanted records of a chunk, and return how many bytes they have.

        A compressed part is read from its begin to the last wanted record, an uncompressed part from the first to the
        last.

        Raises
        ------
        DecompressionError
            As `decompress`, or they have more than the index states, or less.
        """
        chunk, at = part.chunk, 0
        if part.records is not None:
            target[: len(part.records)] = np.frombuffer(part.records, np.uint8)
            return len(part.records)
        if part.ranges is None:
            packed = self._packed(part, spaces.packed)
            inflation.count(len(packed.data), packed.size)
            if packed.size >= len(target):
                raise DecompressionError("larger than the index states")
            data = decompress(packed, target)
            if not np.may_share_memory(data, target):
                target[: len(data)] = data
            return len(data)
        first, needed = int(part.ranges[0, 0]), int(part.ranges[1, -1])
        if chunk.is_stored:
            begin = chunk.at + chunk.length - chunk.size + first
            data = self._content(begin, needed - first, spaces.packed, part.held)
        else:
            # A whole frame is decompressed in one step.
            first, needed = 0, chunk.size if 2 * needed > chunk.size else needed
            packed = self._packed(part, spaces.packed, needed=needed)
            inflation.count(len(packed.data), packed.size)
            data = decompress(packed, spaces.records.of(packed.size + 1))
        if len(data) < needed - first:
            raise DecompressionError("smaller than the index states")
        for begin, end in (part.ranges - first).T.tolist():
            target[at : at + end - begin] = data[begin:end]
            at += end - begin
        return at

    def share_read(self) -> float:
        """Return the share of the file that has been read, 0 to 1."""
        return self._at / max(self._size, 1)

    def close(self) -> None:
        """Release the file."""
        self._source.close()
        super().close()

    def span_ns(self) -> tuple[int, int] | None:
        """Return first and last log time by the index, None without one."""
        known = [chunk for chunk in self._chunks or () if chunk.begin_ns]
        return (min(chunk.begin_ns for chunk in known), max(chunk.end_ns for chunk in known)) if known else None

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
        if isinstance(self._source, RemoteFile):
            if held is None or not held.has(at, at + length):
                held = self._source.hold(at, length)
            return np.frombuffer(held.data, np.uint8, length, at - held.at)
        content = space.of(length)
        return content[: self._source.read_into(at, content)]

    def _read_chunk(self, part: Part, spaces: Spaces) -> Generator[MessageBlock, None, bool]:
        """Yield the messages of a chunk, and return whether there are blocks, which then hold the memory."""
        chunk = part.chunk
        place = chunk.at - self._chunk_head
        if chunk.size < 0:
            self.report("log_parts_contradict", f"no chunk at byte {place}, where the index lists one")
            return False
        self._at = min(chunk.at, self._size)
        try:
            packed = self._packed(part, spaces.packed)
            self._inflation.count(len(packed.data), packed.size)
            data = decompress(packed, spaces.records.of(packed.size + 1))
        except (DecompressionError, MemoryError) as err:
            if not chunk.is_cut:
                self.report("log_damaged", f"chunk at byte {place} left out: {err}")
            return False
        stop, begin = 0, -1
        while begin < stop < len(data):
            begin = stop
            block, stop = self._scanned(data, begin)
            yield block
        if stop < len(data) and not chunk.is_cut:
            self.report(
                "log_damaged", f"chunk at byte {place}: {len(data) - stop} of {len(data)} bytes left out, damaged"
            )
        return begin >= 0

    def _scanned(self, data: Bytes, begin: int = 0) -> tuple[MessageBlock, int]:
        """Return the messages among the records from `begin`, and the first byte not consumed."""
        messages, others, stop = self._scan(data, begin, None)
        for record in others if self._learns else ():
            self._learn(data, record)
        return self._with_possible_times(MessageBlock(data, *messages)), stop


def _spans(chunks: Iterable[Chunk], wanted: frozenset[int]) -> Iterator[tuple[list[Chunk], int, int]]:
    """Yield chunks that follow one another and are read whole, and begin and end of what is read in one piece."""
    group: list[Chunk] = []
    begin = end = 0
    most = FIRST_SPAN_BYTES
    for chunk in chunks:
        by_message = chunk.is_partly(wanted) and chunk.is_stored
        first, last = chunk.at, chunk.at + (0 if by_message else chunk.length + chunk.index_length)
        if group and not (end <= first <= end + NEAR_BYTES and last - begin <= most and last > first):
            yield group, begin, end
            group, most = [], SPAN_BYTES
        begin, end = (begin if group else first), last
        group.append(chunk)
    if group:
        yield group, begin, end


def _groups(parts: Iterable[Part]) -> Iterator[list[Part]]:
    """Yield parts of chunks in groups of up to `JOINED_BYTES` of wanted records, or of one chunk."""
    group: list[Part] = []
    size = 0
    for part in parts:
        size += part.wanted_bytes
        if group and size > JOINED_BYTES:
            yield group
            group, size = [], part.wanted_bytes
        group.append(part)
    if group:
        yield group
