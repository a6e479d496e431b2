"""Base class of MCAP files and ROS 1 bags: a file of chunks, with an index of the log times of each chunk."""

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
    Buffer,
    Chunk,
    DecompressionError,
    Inflation,
    PackedChunk,
    Records,
    decompress,
)
from icrtool.logs.containers.container import Channel, Container, Cut, MessageBlock, make_ahead, work_ahead
from icrtool.logs.containers.source import NEAR_BYTES, HeldBytes, LocalFile, RemoteFile

CHUNK_THREADS = 2
"""Number of threads that decompress chunks and make blocks of messages."""

BLOCKS_AHEAD = 3
"""Largest number of blocks that are made before they are used."""

READERS = 8
"""Number of threads that read a distant file."""

SPANS_AHEAD = 16
"""Largest number of pieces of a distant file that are read before they are used."""

BYTES_AHEAD = 1 << 26
"""Largest number of bytes of a distant file that are read before they are used."""

FIRST_SPAN_BYTES = 1 << 22
"""Size of the first piece of a distant file that is read [bytes]. It is small because the reader waits for it."""

SPAN_BYTES = 1 << 24
"""Size of each further piece of a distant file that is read [bytes]."""

JOINED_BYTES = 1 << 23
"""Size of wanted records up to which several chunks become one block [bytes]. Fewer blocks take less time."""

SMALL_PART = 0.5
"""Share of wanted records below which a chunk is decompressed only up to the last wanted message, without its checksum.

In a chunk with images a few percent are wanted, and most recorders close a chunk behind the image that filled it.
"""


class NotByRangesError(Exception):
    """A distant file cannot be read by ranges."""


class ChunkPart(NamedTuple):
    """The part of a chunk that is read.

    Attributes
    ----------
    chunk : the chunk
    messages : (m,) offsets of the messages in the records that are read, by the index; None without an index
    ranges : (2, n) begin and end offsets of the wanted records if only these are read; None: all are read
    held : bytes of a distant file that were read ahead and contain the chunk; None: not read ahead
    records : wanted records of a distant file that were read ahead; None: not read ahead
    """

    chunk: Chunk
    messages: Ints | None = None
    ranges: Ints | None = None
    held: HeldBytes | None = None
    records: bytes | None = None

    @property
    def wanted_bytes(self) -> int:
        """Size of the records that are read [bytes]."""
        return max(self.chunk.size, 0) if self.ranges is None else int((self.ranges[1] - self.ranges[0]).sum())


class Buffers(NamedTuple):
    """Memory for a compressed chunk, for its decompressed records, and for the wanted records of several chunks."""

    packed: Buffer
    records: Buffer
    joined: Buffer


def reused_buffers() -> Iterator[Buffers]:
    """Yield memory for each block; it is reused for the block after the next `BLOCKS_AHEAD` blocks."""
    return cycle([Buffers(Buffer(), Buffer(), Buffer()) for _ in range(BLOCKS_AHEAD + 1)])


class ChunkedFile(Container):
    """An open file of chunks.

    Parameters
    ----------
    source : file on disk or distant file; None: the file on disk at `path`

    Raises
    ------
    NotByRangesError
        The file is distant and has no index. It must be fetched to disk first.
    """

    _chunks: Sequence[Chunk] | None = None
    """Chunks by the index; None for a file without an index, which is read from start to end."""

    _is_learning = False
    """Whether channels are learned from records, as long as a file without an index is being opened."""

    _chunk_head = 0
    """Number of bytes from the start of the record of a chunk to its content."""

    _unpacks_parts = False
    """Whether a compressed chunk may be decompressed in part. This saves time only where it has a checksum."""

    _find_records: Callable[[Bytes, int, Ints | None], Records]
    """Function that finds records: `scan_mcap` or `scan_bag`."""

    _message_index: Callable[[bytes], tuple[Ints, Ints]]
    """Function that returns the offsets of the messages of a chunk in its records (n,), and their channels (n,);
    both are empty where the index is damaged."""

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
                # Without an index, the records describe the channels.
                self._is_learning = True
                for _ in self._read_in_order():
                    pass
                self._is_learning = False
            self.channels = self._read_channels()
        except BaseException:
            self.close()
            raise

    @abstractmethod
    def _read_index(self) -> Sequence[Chunk] | None:
        """Return the chunks that the index lists; None without an index, or where the index does not fit the file.

        Raises
        ------
        LogError
            The file is of another kind.
        """

    @abstractmethod
    def _read_channels(self) -> Sequence[Channel]:
        """Return the channels that the index or the records describe."""

    @abstractmethod
    def _read_packed(self, part: ChunkPart, space: Buffer, needed: int = 0) -> PackedChunk:
        """Return the compressed content of a chunk, read from the file.

        Parameters
        ----------
        space : memory for the compressed content
        needed : number of decompressed bytes that are needed, which are then not checked; 0: all

        Raises
        ------
        DecompressionError
            The header of the chunk is damaged.
        """

    @abstractmethod
    def _read_in_order(self) -> Iterator[MessageBlock]:
        """Yield the messages up to the first record that cannot be read, without an index."""

    @abstractmethod
    def _learn(self, data: Bytes, record: tuple[int, int, int, int]) -> None:
        """Store a record of `data` that describes a channel; `record` is an item of `Records.others`."""

    def _complete(self, chunk: Chunk) -> Chunk:
        """Return a chunk of the index, completed by the header of its record."""
        return chunk

    def _yield_blocks(self, wanted: frozenset[int], cut: Cut) -> Iterator[MessageBlock]:
        """Yield the messages of the wanted channels in the order of their chunks; threads make the next blocks."""
        if self._chunks is None:
            yield from make_ahead(self._read_in_order())
            return
        needed = (chunk for chunk in self._chunks if cut.needs(chunk.channels, chunk.begin_ns, chunk.end_ns, wanted))
        located = (self._locate_part(chunk, wanted) for chunk in needed)
        parts = located if self._remote is None else self._read_ahead(self._remote, needed, wanted)
        groups = zip(_group_parts(parts), reused_buffers(), strict=False)
        for (group, spaces), join in work_ahead(
            lambda item: self._join_parts(*item), groups, CHUNK_THREADS, BLOCKS_AHEAD
        ):
            self._at = group[-1].chunk.at
            try:
                block, inflation = join()
            except (DecompressionError, MemoryError):
                # A chunk of the group is damaged: each chunk is read alone, up to its damage.
                for part in group:
                    yield from self._read_chunk(part, spaces)
            else:
                self._inflation.left += inflation.left
                yield self._with_possible_times(block)

    def _read_ahead(self, remote: RemoteFile, chunks: Iterable[Chunk], wanted: frozenset[int]) -> Iterator[ChunkPart]:
        """Yield the parts of the chunks of a distant file; threads read the wanted bytes of the next parts."""

        def locate(span: tuple[list[Chunk], int, int]) -> list[ChunkPart]:
            group, begin, end = span
            if 0 < end - begin <= 2 * LARGEST_CHUNK_BYTES:
                remote.hold(begin, end - begin)
            return [self._locate_part(chunk, wanted) for chunk in group]

        spans = _group_spans(chunks, wanted)
        for _, parts in work_ahead(locate, spans, READERS, SPANS_AHEAD, lambda span: (span[2] - span[1]) / BYTES_AHEAD):
            yield from parts()

    def _locate_part(self, chunk: Chunk, wanted: frozenset[int]) -> ChunkPart:
        """Return the part of a chunk to read: its messages by the index, and ranges if few records are wanted.

        Without an index, and with a wrong index, the part has neither.
        """
        chunk = self._complete(chunk)
        if max(chunk.size, chunk.length, chunk.index_length) > LARGEST_CHUNK_BYTES:
            return ChunkPart(chunk)
        is_partly, by_message = chunk.is_partly(wanted), chunk.is_partly(wanted) and chunk.is_uncompressed
        held, behind = None, chunk.at + chunk.length
        if self._remote is not None:
            self.mixed |= is_partly and not by_message
            begin = behind if by_message else chunk.at
            held = self._remote.hold(begin, behind + chunk.index_length - begin)
        offsets, channels = self._message_index(self._source.read_at(behind, chunk.index_length))
        order = np.argsort(offsets, kind="stable")
        begins = offsets[order]
        ends = np.append(begins[1:], chunk.size)
        if not len(begins) or (ends <= begins).any():
            return ChunkPart(chunk, held=held)
        is_wanted = np.isin(channels, list(wanted))[order] if is_partly else np.ones(len(begins), np.bool_)
        sizes = (ends - begins)[is_wanted]
        in_part = is_partly and (chunk.is_uncompressed or self._unpacks_parts)
        if not (in_part and 0 < sizes.sum() < SMALL_PART * chunk.size):
            return ChunkPart(chunk, begins, held=held)
        first, last = begins[is_wanted], ends[is_wanted]
        apart = first[1:] != last[:-1]
        ranges = np.stack([first[np.append(True, apart)], last[np.append(apart, True)]])
        records = None
        if by_message and self._remote is not None:
            records = self._remote.gather(behind - chunk.size, ranges)
        return ChunkPart(chunk, np.cumsum(sizes) - sizes, ranges, held, records)

    def _join_parts(self, group: Sequence[ChunkPart], spaces: Buffers) -> tuple[MessageBlock, Inflation]:
        """Return the messages of a group of chunks as one block, and the count of their decompressed bytes.

        Raises
        ------
        DecompressionError
            A chunk is damaged, or not as the index states.
        """
        size = sum(part.wanted_bytes for part in group)
        if size > LARGEST_CHUNK_BYTES:
            raise DecompressionError(f"it claims {size} bytes")
        inflation = Inflation(0)
        joined = spaces.joined.take(size + 1)
        messages: list[Ints] = []
        data, stop = joined[:0], 0
        for part in group:
            begin = stop
            data = joined[: begin + self._unpack(part, spaces, joined[begin:], inflation)]
            hint = None if part.messages is None else part.messages + begin
            found, _, stop = self._find_records(data, begin, hint)
            if stop < len(data):
                raise DecompressionError
            messages.append(found)
        return MessageBlock(data, *np.concatenate(messages, axis=1)), inflation

    def _unpack(self, part: ChunkPart, spaces: Buffers, target: Bytes, inflation: Inflation) -> int:
        """Write the wanted records of a chunk to `target`, and return their size [bytes].

        A compressed chunk is read from its start to the last wanted record, an uncompressed chunk from the first wanted
        record to the last.

        Raises
        ------
        DecompressionError
            The chunk cannot be decompressed, or its size is not the size that the index states.
        """
        chunk, at = part.chunk, 0
        if part.records is not None:
            target[: len(part.records)] = np.frombuffer(part.records, np.uint8)
            return len(part.records)
        if part.ranges is None:
            packed = self._read_packed(part, spaces.packed)
            inflation.count(len(packed.data), packed.size)
            if packed.size >= len(target):
                raise DecompressionError("larger than the index states")
            data = decompress(packed, target)
            if not np.may_share_memory(data, target):
                target[: len(data)] = data
            return len(data)
        first, needed = int(part.ranges[0, 0]), int(part.ranges[1, -1])
        if chunk.is_uncompressed:
            begin = chunk.at + chunk.length - chunk.size + first
            data = self._read_content(begin, needed - first, spaces.packed, part.held)
        else:
            # A whole frame is decompressed in one step.
            first, needed = 0, chunk.size if 2 * needed > chunk.size else needed
            packed = self._read_packed(part, spaces.packed, needed=needed)
            inflation.count(len(packed.data), packed.size)
            data = decompress(packed, spaces.records.take(packed.size + 1))
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
        """Close the file."""
        self._source.close()
        super().close()

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and the last log time by the index [ns]; None without an index."""
        known = [chunk for chunk in self._chunks or () if chunk.begin_ns]
        return (min(chunk.begin_ns for chunk in known), max(chunk.end_ns for chunk in known)) if known else None

    def _read_content(self, at: int, length: int, space: Buffer, held: HeldBytes | None = None) -> Bytes:
        """Return `length` bytes of the file from `at` on; fewer at its end.

        Parameters
        ----------
        space : memory for the bytes
        held : bytes that were read ahead, which may contain the wanted ones

        Raises
        ------
        DecompressionError
            `length` is above the limit of a chunk.
        """
        if length > LARGEST_CHUNK_BYTES:
            raise DecompressionError(f"it claims {length} bytes")
        length = max(min(length, self._size - at), 0)
        if isinstance(self._source, RemoteFile):
            if held is None or not held.has(at, at + length):
                held = self._source.hold(at, length)
            return np.frombuffer(held.data, np.uint8, length, at - held.at)
        content = space.take(length)
        return content[: self._source.read_into(at, content)]

    def _read_chunk(self, part: ChunkPart, spaces: Buffers) -> Generator[MessageBlock, None, bool]:
        """Yield the messages of a chunk, and return whether there were any; they then occupy the memory."""
        chunk = part.chunk
        offset = chunk.at - self._chunk_head
        if chunk.size < 0:
            self.report("log_parts_contradict", f"no chunk at byte {offset}, where the index lists one")
            return False
        self._at = min(chunk.at, self._size)
        try:
            packed = self._read_packed(part, spaces.packed)
            self._inflation.count(len(packed.data), packed.size)
            data = decompress(packed, spaces.records.take(packed.size + 1))
        except (DecompressionError, MemoryError) as err:
            if not chunk.is_cut:
                self.report("log_damaged", f"chunk at byte {offset} left out: {err}")
            return False
        stop, begin = 0, -1
        while begin < stop < len(data):
            begin = stop
            block, stop = self._scan(data, begin)
            yield block
        if stop < len(data) and not chunk.is_cut:
            self.report(
                "log_damaged", f"chunk at byte {offset}: {len(data) - stop} of {len(data)} bytes left out, damaged"
            )
        return begin >= 0

    def _scan(self, data: Bytes, begin: int = 0) -> tuple[MessageBlock, int]:
        """Return the messages among the records from `begin` on, and the byte behind the last record."""
        messages, others, stop = self._find_records(data, begin, None)
        for record in others if self._is_learning else ():
            self._learn(data, record)
        return self._with_possible_times(MessageBlock(data, *messages)), stop


def _group_spans(chunks: Iterable[Chunk], wanted: frozenset[int]) -> Iterator[tuple[list[Chunk], int, int]]:
    """Yield groups of chunks that one request reads, each with begin and end offset of the range of this request."""
    group: list[Chunk] = []
    begin = end = 0
    most = FIRST_SPAN_BYTES
    for chunk in chunks:
        by_message = chunk.is_partly(wanted) and chunk.is_uncompressed
        first, last = chunk.at, chunk.at + (0 if by_message else chunk.length + chunk.index_length)
        if group and not (end <= first <= end + NEAR_BYTES and last - begin <= most and last > first):
            yield group, begin, end
            group, most = [], SPAN_BYTES
        begin, end = (begin if group else first), last
        group.append(chunk)
    if group:
        yield group, begin, end


def _group_parts(parts: Iterable[ChunkPart]) -> Iterator[list[ChunkPart]]:
    """Yield groups of parts with up to `JOINED_BYTES` of wanted records in each; a larger part is a group alone."""
    group: list[ChunkPart] = []
    size = 0
    for part in parts:
        size += part.wanted_bytes
        if group and size > JOINED_BYTES:
            yield group
            group, size = [], part.wanted_bytes
        group.append(part)
    if group:
        yield group
