"""Base class of containers: an open log with its channels, which yields blocks of raw messages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Event
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import zstandard

from icrtool.kernels.arrays import Bools, Bytes, Ints
from icrtool.logs.containers.chunk import PIECE_BYTES, DecompressionError, Inflation
from icrtool.logs.containers.recording_files import file_sha256
from icrtool.records.notes import Note, note
from icrtool.records.samples import InputFile
from icrtool.records.text import LogText, escaped, shortened

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST_PROBLEMS, LONGEST_PROBLEM = 20, 500
"""Largest number of findings of a container, and largest length of the text of a finding [characters]."""

Report = Callable[[str, str], None]
"""Function that is called with the code and the text of a problem."""

LATEST_NS = 1 << 62
"""Latest log time [ns], in the year 2116. A later time shows that the log is damaged, and differences of such times
do not fit into 64 bits."""


Times = TypeVar("Times", int, Ints)
"""One log time, or log times (n,) [ns]."""


def folded_ns(time_ns: Times) -> Times:
    """Return log times modulo `LATEST_NS` [ns], shifted by half of it.

    Times of a damaged clock are near 2^63 or 2^64. The shift keeps the order and the intervals of such times.
    """
    return (time_ns + LATEST_NS // 2) & (LATEST_NS - 1)


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic of a log, or the messages of one publisher of a topic.

    Attributes
    ----------
    id : number of the channel in blocks
    topic : name of the topic
    message_type : ``package/Name``, without ROS 2's ``/msg/``
    encoding : serialization of the messages: ``cdr`` (ROS 2), ``ros1``, ``protobuf``, ``json``, or another name, whose
        messages are not read
    definition : text of the message definition, empty if the log has none; for Protobuf one character for each byte of
        the FileDescriptorSet
    definition_format : language of a ROS definition
    count : number of messages by the index, None without an index
    """

    id: int
    topic: LogText
    message_type: LogText
    encoding: LogText
    definition: str = ""
    definition_format: Literal["msg", "idl"] = "msg"
    count: int | None = None


class MessageBlock(NamedTuple):
    """Messages in one buffer. A block is valid until the next block is requested.

    Attributes
    ----------
    data : (b,) uint8, the buffer
    channel : (n,) int64, the id of the channel of each message
    log_time_ns : (n,) int64, times at which the recorder received the messages
    start, end : (n,) int64, half-open range of each message in `data`
    """

    data: Bytes
    channel: Ints
    log_time_ns: Ints
    start: Ints
    end: Ints

    def rows(self, chosen: Bools) -> MessageBlock:
        """Return a block of the messages that a mask (n,) chooses."""
        if chosen.all():
            return self
        _, *columns = self
        return MessageBlock(self.data, *(column[chosen] for column in columns))


class Cut(NamedTuple):
    """The part of a log that is read.

    Attributes
    ----------
    begin_ns, end_ns : range [begin_ns, end_ns) of the log times that are read [ns]
    whole : channels of which all messages are read
    """

    begin_ns: int = 0
    end_ns: int = LATEST_NS
    whole: frozenset[int] = frozenset()

    def needs(self, channels: frozenset[int] | None, begin_ns: int, end_ns: int, wanted: frozenset[int]) -> bool:
        """Return whether a chunk has to be read.

        Parameters
        ----------
        channels : channels in the chunk, None without an index
        begin_ns, end_ns : first and last log time in the chunk by the index [ns]; 0 and 0 where they are not known
        wanted : channels that are read
        """
        if channels is not None and not channels & wanted:
            return False
        known = 0 < begin_ns <= end_ns < LATEST_NS
        outside = known and (end_ns < self.begin_ns or begin_ns >= self.end_ns)
        return not outside or (bool(self.whole) and (channels is None or bool(channels & self.whole)))

    def apply(self, block: MessageBlock) -> MessageBlock:
        """Return a block without the messages outside the cut."""
        if self == WHOLE:
            return block
        inside = (block.log_time_ns >= self.begin_ns) & (block.log_time_ns < self.end_ns)
        return block.rows(inside | np.isin(block.channel, list(self.whole)))


WHOLE = Cut()
"""A cut that keeps all messages."""


def work_ahead(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int, count: int,
    weight: Callable[[Item], float] = lambda _: 0.0,
) -> Generator[tuple[Item, Callable[[], Result]]]:  # fmt: skip
    """Yield each item with a function that returns the result of the work on it; threads work on the next items.

    Parameters
    ----------
    work : function that is called with each item, in a thread
    items : items to work on
    threads : number of threads
    count : largest number of items that are worked on before they are yielded
    weight : returns the weight of an item; items are worked on ahead up to a total weight of 1
    """
    pending: deque[tuple[Item, Future[Result]]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                pending.append((item, pool.submit(work, item)))
                while len(pending) > count or sum(weight(item_ahead) for item_ahead, _ in pending) > 1:
                    first, made = pending.popleft()
                    yield first, made.result
            while pending:
                first, made = pending.popleft()
                yield first, made.result
        finally:
            for _, made in pending:
                made.cancel()


def make_ahead(blocks: Iterator[MessageBlock], stop: Callable[[], object] | None = None) -> Generator[MessageBlock]:
    """Yield blocks; a thread makes the next block while the caller uses a block.

    Parameters
    ----------
    blocks : blocks, made one after the other
    stop : called when the caller wants no more blocks; it ends the work of the thread
    """
    with ThreadPoolExecutor(1) as pool:
        try:
            pending = pool.submit(next, blocks, None)
            while (block := pending.result()) is not None:
                pending = pool.submit(next, blocks, None)
                yield block
        except BaseException:
            # The end of the pool waits for the next block, so that the thread is stopped before.
            if stop is not None:
                stop()
            raise


def unpack_messages(
    blocks: Iterator[MessageBlock], wanted: frozenset[int], compression: str, report: Report
) -> Iterator[MessageBlock]:
    """Yield blocks of decompressed messages, from blocks of a bag in which each message is compressed.

    Parameters
    ----------
    wanted : channels whose messages are decompressed; other messages are left out
    compression : ``zstd``, or the name in metadata.yaml of a compression that is not supported
    report : called after the last block if messages could not be decompressed, with their number and the reason
    """
    left_out, reason = 0, ""
    inflation, decompressor = Inflation(), zstandard.ZstdDecompressor()
    for block in blocks:
        kept: list[int] = []
        messages: list[bytes] = []
        size_kept = 0
        is_wanted = np.isin(block.channel, list(wanted))
        if not is_wanted.any():
            # The reader updates its progress with each block.
            yield block.rows(is_wanted)
        rows = np.flatnonzero(is_wanted)
        for row in rows.tolist():
            packed = block.data[block.start[row] : block.end[row]].tobytes()
            try:
                if compression != "zstd":
                    raise DecompressionError(f"compression {compression!r} is not known")
                size = zstandard.frame_content_size(packed)
                if size >= 0:
                    inflation.count(len(packed), size)
                message = decompressor.decompress(packed, max_output_size=PIECE_BYTES)
                if size < 0:
                    inflation.count(len(packed), len(message))
            except (DecompressionError, zstandard.ZstdError, MemoryError) as err:
                left_out, reason = left_out + 1, reason or str(err)
            else:
                kept.append(row)
                messages.append(message)
                size_kept += len(message)
            if row == rows[-1] or size_kept > PIECE_BYTES:
                end = np.cumsum(np.fromiter(map(len, messages), np.int64, len(messages)))
                data = np.frombuffer(b"".join(messages), np.uint8)
                yield MessageBlock(data, block.channel[kept], block.log_time_ns[kept], np.append(0, end)[:-1], end)
                kept, messages, size_kept = [], [], 0
    if left_out:
        report("messages_unreadable", f"{left_out} compressed messages left out: {reason}")


LARGEST_DESCRIPTIONS_BYTES = 1 << 24
"""Largest total size of the schemas, topics and definitions of a log [bytes]. 400 topics have 2 MB."""


def ros_type_name(name: str) -> LogText:
    """Return ``package/Name`` for ``package/msg/Name`` and for ``package/Name``; a name of one part unchanged."""
    package, separator, rest = name.partition("/")
    return LogText(f"{package}{separator}{rest.removeprefix('msg/')}")


class Origin(NamedTuple):
    """Origin of a log that was fetched or unpacked, or that is read at an address.

    Attributes
    ----------
    inputs : files that were read for the log; empty: the files of the container
    transfer : returns a text about the data that was transferred; empty without a transfer
    remove : removes the temporary files of the log
    """

    inputs: tuple[InputFile, ...] = ()
    transfer: Callable[[], str] = str
    remove: Callable[[], object] = str


class Container(ABC):
    """An open log file or directory.

    Attributes
    ----------
    path : path of the log in errors
    files : files of the log
    channels : channels of the log, known before any block is read
    mixed : whether pieces of a distant file were read that also hold messages of other channels than the wanted ones
    message_compression : compression of each single message; empty for none
    origin : origin of the log
    """

    def __init__(self, path: Path, message_compression: str = "") -> None:
        self.path, self.files = path, [path]
        self.channels: Sequence[Channel] = []
        self.mixed = False
        self.message_compression = message_compression
        self.origin = Origin()
        self._name, self._problems = LogText(path.name), list[Note]()

    @property
    def problems(self) -> list[Note]:
        """Findings about data that could not be read; the list is complete after the last block."""
        return [*self._problems]

    def report(self, code: str, problem: str) -> None:
        """Add a finding about unreadable data; each finding is kept once, and at most `MOST_PROBLEMS` are kept."""
        finding = note(code, shortened(escaped(problem), LONGEST_PROBLEM), self._name)
        if finding not in self._problems and len(self._problems) <= MOST_PROBLEMS:
            is_last = len(self._problems) == MOST_PROBLEMS
            self._problems.append(note("log_more_problems", "and more of the kind", self._name) if is_last else finding)

    def inputs(self, ended: Event) -> tuple[InputFile, ...]:
        """Return the files of the log with size and SHA-256; hashing stops once `ended` is set."""
        return self.origin.inputs or tuple(
            InputFile(str(file), file.stat().st_size, file_sha256(file, ended)) for file in self.files
        )

    def transfer(self) -> str:
        """Return a text about the data that was transferred over a connection; empty without a transfer."""
        why = "topics share compressed chunks, which are read whole" if self.mixed else ""
        return "; ".join(filter(None, [self.origin.transfer(), why]))

    def blocks(self, wanted: frozenset[int], cut: Cut = WHOLE) -> Generator[MessageBlock]:
        """Yield the messages of the wanted channels in the order of the file.

        The blocks may also hold messages of other channels, and messages outside the cut in a chunk of which a part is
        inside.
        """
        if wanted:
            blocks = self._yield_blocks(wanted, cut)
            if self.message_compression:
                blocks = unpack_messages(blocks, wanted, self.message_compression, self.report)
            yield from blocks

    @abstractmethod
    def _yield_blocks(self, wanted: frozenset[int], cut: Cut) -> Iterator[MessageBlock]:
        """Yield the blocks of `blocks` before the decompression of single messages."""

    @abstractmethod
    def span_ns(self) -> tuple[int, int] | None:
        """Return the log times of the first and the last message [ns]; None without an index."""

    @abstractmethod
    def share_read(self) -> float:
        """Return the share of the log that has been read, 0 to 1."""

    def close(self) -> None:
        """Close the files of the log, and remove its temporary files."""
        self.origin.remove()

    @cached_property
    def _is_beyond(self) -> bool:
        """Whether all log times are beyond `LATEST_NS` by the index: the clock of the recorder was wrong."""
        span = self.span_ns()
        return span is not None and span[0] >= LATEST_NS

    def _with_possible_times(self, block: MessageBlock) -> MessageBlock:
        """Return a block without the messages whose log time is negative or beyond `LATEST_NS`.

        If all log times of the log are beyond it, all messages are kept with their times by `folded_ns`.
        """
        if self._is_beyond:
            why = "log times beyond the year 2116: the clock of the recorder was wrong; only their intervals are used"
            self.report("log_time_impossible", why)
            return block._replace(log_time_ns=folded_ns(block.log_time_ns))
        # As unsigned numbers, negative times are above all others.
        possible = block.log_time_ns.view(np.uint64) < LATEST_NS
        if possible.all():
            return block
        self.report("messages_unreadable", "messages with an impossible log time left out")
        return block.rows(possible)
