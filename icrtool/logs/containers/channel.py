"""What logs are read as: channels, blocks of raw messages, and sentences about what cannot be read."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from icrtool.kernels.arrays import Bytes, Ints
from icrtool.records.text import LogText, escaped, shortened

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST_PROBLEMS, LONGEST_PROBLEM = 20, 500

MOST_NAMED = 12
"""Names that a message to the user lists; of more names it shows that there are more."""

LATEST_NS = 1 << 62
"""The year 2116. A log time beyond it is damage, and differences of such times do not fit into 64 bits."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic of a log.

    Attributes
    ----------
    id : the number that blocks refer to
    message_type : ``package/Name``, without ROS 2's ``/msg/``
    encoding : ``cdr`` (ROS 2), ``ros1``, ``protobuf``, ``json``, or what the log calls one that cannot be read
    definition : text of the message definition, empty when the log does not carry it; of Protobuf a character for each
        byte of its FileDescriptorSet
    definition_format : how a definition of ROS is written
    count : number of messages by the log's index, None without an index
    """

    id: int
    topic: LogText
    message_type: LogText
    encoding: LogText
    definition: str = ""
    definition_format: Literal["msg", "idl"] = "msg"
    count: int | None = None


class Cut(NamedTuple):
    """The part of a log that is read: log times in [begin_ns, end_ns); the channels in `whole` are read in full."""

    begin_ns: int = 0
    end_ns: int = LATEST_NS
    whole: frozenset[int] = frozenset()

    def needs(self, held: frozenset[int] | None, begin_ns: int, end_ns: int, wanted: frozenset[int]) -> bool:
        """Return whether a chunk has to be read.

        Parameters
        ----------
        held : its channels, None without an index
        begin_ns, end_ns : its first and last log time by the index; 0 and 0 where that is not known
        """
        if held is not None and not held & wanted:
            return False
        known = 0 < begin_ns <= end_ns
        outside = known and (end_ns < self.begin_ns or begin_ns >= self.end_ns)
        return not outside or (bool(self.whole) and (held is None or bool(held & self.whole)))

    def of(self, block: Block) -> Block:
        """Return a block without the messages outside the cut."""
        if self == WHOLE:
            return block
        inside = (block.log_time_ns >= self.begin_ns) & (block.log_time_ns < self.end_ns)
        if self.whole:
            inside |= np.isin(block.channel, list(self.whole))
        if inside.all():
            return block
        _, *columns = block
        return Block(block.data, *(column[inside] for column in columns))


WHOLE = Cut()


class Block(NamedTuple):
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


def made_ahead(blocks: Iterator[Block], stop: Callable[[], object] | None = None) -> Generator[Block]:
    """Yield blocks; the next one is made in a thread while one is used.

    Parameters
    ----------
    stop : called where no more blocks are wanted, to end the making of the next one
    """
    with ThreadPoolExecutor(1) as pool:
        try:
            pending = pool.submit(next, blocks, None)
            while (block := pending.result()) is not None:
                pending = pool.submit(next, blocks, None)
                yield block
        except BaseException:
            if stop is not None:
                stop()
            raise


def ahead(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int, count: int,
    weight: Callable[[Item], float] = lambda _: 0.0,
) -> Generator[tuple[Item, Callable[[], Result]]]:  # fmt: skip
    """Yield items, each with what returns the result of some work on it; threads work on the next ones meanwhile.

    Parameters
    ----------
    count : of the items worked on before they are used
    weight : the share that an item takes of what may be worked on before it is used
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


CUT_OFF = "cut off"
"""Stands in the sentence about a file whose end is missing."""


def truncation(warnings: Iterable[str]) -> str:
    """Return the warning that the end of a log is missing; empty where it is there."""
    return next((one for one in warnings if CUT_OFF in one), "")


class Problems(list[str]):
    """Sentences about what could not be read of a file: each is kept once, and at most `MOST_PROBLEMS` of them."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._name = LogText(name)

    def add(self, problem: str) -> None:
        """Add a sentence, if it is new and there is space."""
        text = shortened(escaped(f"{self._name}: {problem}"), LONGEST_PROBLEM)
        if text not in self and len(self) <= MOST_PROBLEMS:
            self.append(text if len(self) < MOST_PROBLEMS else f"{self._name}: and more of the kind")


def with_possible_times(block: Block, report: Callable[[str], None]) -> Block:
    """Return a block without the messages whose log time is negative or beyond `LATEST_NS`."""
    # Negative ones are above all others as unsigned numbers.
    possible = block.log_time_ns.view(np.uint64) < LATEST_NS
    if possible.all():
        return block
    report("messages with an impossible log time left out")
    _, *columns = block
    return Block(block.data, *(column[possible] for column in columns))


def some_of(names: Sequence[str]) -> str:
    """Return names from a log, separated by commas; of many names only the first ones."""
    shown = [str(LogText(name)) for name in names[:MOST_NAMED]]
    return ", ".join([*shown, *(["…"] if len(names) > MOST_NAMED else [])])


def ros_type_name(name: str) -> LogText:
    """Return ``package/Name`` for ``package/msg/Name`` or ``package/Name``; a name of one part as it is."""
    package, separator, rest = name.partition("/")
    return LogText(f"{package}{separator}{rest.removeprefix('msg/')}")
