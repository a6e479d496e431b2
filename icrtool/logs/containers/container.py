"""The base class of containers: an open log with its channels, which yields blocks of raw messages."""

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

Report = Callable[[str, str], None]
"""Function that is called with the code and the text of a problem."""

LATEST_NS = 1 << 62
"""Latest log time [ns], in the year 2116. A later time shows that the log is damaged, and differences of such times do
not fit into 64 bits."""


Times = TypeVar("Times", int, Ints)


def counted_ns(time_ns: Times) -> Times:
    """Return times before `LATEST_NS` in place of log times after it, with the same order and intervals.

    Damaged clocks give times around 2^63 and 2^64; such times of a log stay together.
    """
    return (time_ns + LATEST_NS // 2) & (LATEST_NS - 1)


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic of a log.

    Attributes
    ----------
    id : the number that blocks refer to
    message_type : ``package/Name``, without ROS 2's ``/msg/``
    encoding : ``cdr`` (ROS 2), ``ros1``, ``protobuf``, ``json``, or the name in the log of an unreadable encoding
    definition : text of the message definition, empty if the log has none; for Protobuf a character for each byte of
        the FileDescriptorSet
    definition_format : format of a definition of ROS
    count : number of messages by the log's index, None without an index
    """

    id: int
    topic: LogText
    message_type: LogText
    encoding: LogText
    definition: str = ""
    definition_format: Literal["msg", "idl"] = "msg"
    count: int | None = None


class MessageBlock(NamedTuple):
    """Messages that share one buffer. Valid until the next block is asked for.

    Attributes
    ----------
    data : uint8 (bytes,)
    channel : int64 (n,) channel ids
    log_time_ns : int64 (n,)
    start, end : int64 (n,) half-open byte ranges in `data`
    """

    data: Bytes
    channel: Ints
    log_time_ns: Ints
    start: Ints
    end: Ints

    def rows(self, chosen: Bools) -> MessageBlock:
        """Return the block of the chosen (n,) messages."""
        if chosen.all():
            return self
        _, *columns = self
        return MessageBlock(self.data, *(column[chosen] for column in columns))


class Cut(NamedTuple):
    """The part of a log that is read: log times in [begin_ns, end_ns), and all messages of the channels in `whole`."""

    begin_ns: int = 0
    end_ns: int = LATEST_NS
    whole: frozenset[int] = frozenset()

    def needs(self, held: frozenset[int] | None, begin_ns: int, end_ns: int, wanted: frozenset[int]) -> bool:
        """Return whether a chunk has to be read.

        Parameters
        ----------
        held : channels in the chunk, None without an index
        begin_ns, end_ns : first and last log time in the chunk by the index; 0 and 0 where they are not known
        """
        if held is not None and not held & wanted:
            return False
        known = 0 < begin_ns <= end_ns < LATEST_NS
        outside = known and (end_ns < self.begin_ns or begin_ns >= self.end_ns)
        return not outside or (bool(self.whole) and (held is None or bool(held & self.whole)))

    def of(self, block: MessageBlock) -> MessageBlock:
        """Return a block without the messages outside the cut."""
        if self == WHOLE:
            return block
        inside = (block.log_time_ns >= self.begin_ns) & (block.log_time_ns < self.end_ns)
        return block.rows(inside | np.isin(block.channel, list(self.whole)))


WHOLE = Cut()


def work_ahead(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int, count: int,
    weight: Callable[[Item], float] = lambda _: 0.0,
) -> Generator[tuple[Item, Callable[[], Result]]]:  # fmt: skip
    """Yield items, each with a function that returns the result of the work on it; threads work on the next items.

    Parameters
    ----------
    count : largest number of items that threads work on ahead of their use
    weight : returns the share of an item in the work that may be done ahead
    """
    pending: deque[tuple[Item, Future[Result]]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                pending.append((item, pool.submit(work, item)))
                while len(pending) > count or sum(weight(one) for one, _ in pending) > 1:
                    first, made = pending.popleft()
                    yield first, made.result
            while pending:
                first, made = pending.popleft()
                yield first, made.result
        finally:
            for _, made in pending:
                made.cancel()


def made_ahead(blocks: Iterator[MessageBlock], stop: Callable[[], object] | None = None) -> Generator[MessageBlock]:
    """Yield blocks; a thread makes the next block while a block is used.

    Parameters
    ----------
    stop : called when no more blocks are wanted, so that the thread ends
    """
    with ThreadPoolExecutor(1) as pool:
        try:
            pending = pool.submit(next, blocks, None)
            while (block := pending.result()) is not None:
                pending = pool.submit(next, blocks, None)
                yield block
        except BaseException:
            # called before the end of the pool, which waits for the next block
            if stop is not None:
                stop()
            raise


def unpack_messages(
    blocks: Iterator[MessageBlock], wanted: frozenset[int], compression: str, report: Report
) -> Iterator[MessageBlock]:
    """Yield blocks with the wanted messages decompressed, of a bag that was written with message compression.

    Parameters
    ----------
    compression : ``zstd``, or the name in metadata.yaml of a compression that is not supported
    report : called once, after the last block, with how many messages could not be decompressed, and why
    """
    left_out, reason = 0, ""
    inflation, decompressor = Inflation(), zstandard.ZstdDecompressor()
    for block in blocks:
        kept: list[int] = []
        messages: list[bytes] = []
        held = 0
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
                held += len(message)
            if row == rows[-1] or held > PIECE_BYTES:
                end = np.cumsum(np.fromiter(map(len, messages), np.int64, len(messages)))
                data = np.frombuffer(b"".join(messages), np.uint8)
                yield MessageBlock(data, block.channel[kept], block.log_time_ns[kept], np.append(0, end)[:-1], end)
                kept, messages, held = [], [], 0
    if left_out:
        report("messages_unreadable", f"{left_out} compressed messages left out: {reason}")


LARGEST_DESCRIPTIONS_BYTES = 1 << 24
"""Largest size of the schemas and topics of a log with their definitions [bytes]; 400 topics have 2 MB."""


def ros_type_name(name: str) -> LogText:
    """Return ``package/Name`` for ``package/msg/Name`` or ``package/Name``; a name of one part as it is."""
    package, separator, rest = name.partition("/")
    return LogText(f"{package}{separator}{rest.removeprefix('msg/')}")


class Origin(NamedTuple):
    """Origin of a log that was fetched, unpacked, or is read at an address.

    Attributes
    ----------
    inputs : files that were read for the log; empty: the files of the log
    transfer : returns a text about the transfer over a connection; empty without a transfer
    remove : removes the temporary files of the log
    """

    inputs: tuple[InputFile, ...] = ()
    transfer: Callable[[], str] = str
    remove: Callable[[], object] = str


class Container(ABC):
    """A log file or directory, opened.

    Attributes
    ----------
    path : path of the log in errors
    files : files of the log
    channels : the topics, known before any block is read
    mixed : a distant file was read in pieces that also hold other messages than the wanted ones
    message_compression : compression of each single message; empty for none
    origin : origin of a log that was fetched or unpacked
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
        """Findings about data that could not be read and were left out; complete after the last block."""
        return [*self._problems]

    def report(self, code: str, problem: str) -> None:
        """Add a finding about unreadable data; each finding is kept once, and at most `MOST_PROBLEMS` are kept."""
        finding = note(code, shortened(escaped(problem), LONGEST_PROBLEM), self._name)
        if finding not in self._problems and len(self._problems) <= MOST_PROBLEMS:
            is_last = len(self._problems) == MOST_PROBLEMS
            self._problems.append(note("log_more_problems", "and more of the kind", self._name) if is_last else finding)

    def inputs(self, ended: Event) -> tuple[InputFile, ...]:
        """Return the files that make up this log, with their SHA-256: of their beginning once `ended` is set."""
        return self.origin.inputs or tuple(
            InputFile(str(file), file.stat().st_size, file_sha256(file, ended)) for file in self.files
        )

    def transfer(self) -> str:
        """Return the amount of data over a connection as text, and why all was read; empty without a transfer."""
        why = "topics share compressed chunks, which are read whole" if self.mixed else ""
        return "; ".join(filter(None, [self.origin.transfer(), why]))

    def blocks(self, wanted: frozenset[int], cut: Cut = WHOLE) -> Generator[MessageBlock]:
        """Yield the messages of the channels in `wanted` in file order; other messages may be among them.

        Messages that are outside the cut by the index are not read.
        """
        if wanted:
            blocks = self._stored(wanted, cut)
            if self.message_compression:
                blocks = unpack_messages(blocks, wanted, self.message_compression, self.report)
            yield from blocks

    @abstractmethod
    def _stored(self, wanted: frozenset[int], cut: Cut) -> Iterator[MessageBlock]:
        """Yield the blocks of `blocks` with messages as they are stored, compressed or not."""

    @abstractmethod
    def span_ns(self) -> tuple[int, int] | None:
        """Return the log times of the first and the last message; None without an index."""

    @abstractmethod
    def share_read(self) -> float:
        """Return the share of the log that has been read, 0 to 1."""

    def close(self) -> None:
        """Close the files of the log, and remove its temporary files."""
        self.origin.remove()

    @cached_property
    def _is_beyond(self) -> bool:
        """Whether the index shows that all log times are beyond `LATEST_NS`: the clock of the recorder was wrong."""
        span = self.span_ns()
        return span is not None and span[0] >= LATEST_NS

    def _with_possible_times(self, block: MessageBlock) -> MessageBlock:
        """Return a block without the messages whose log time is negative or beyond `LATEST_NS`.

        Where all log times are beyond it, `counted_ns` keeps their order and intervals.
        """
        if self._is_beyond:
            why = "log times beyond the year 2116: the clock of the recorder was wrong; only their intervals are used"
            self.report("log_time_impossible", why)
            return block._replace(log_time_ns=counted_ns(block.log_time_ns))
        # Negative ones are above all others as unsigned numbers.
        possible = block.log_time_ns.view(np.uint64) < LATEST_NS
        if possible.all():
            return block
        self.report("messages_unreadable", "messages with an impossible log time left out")
        return block.rows(possible)
