"""What every container is: an open log with its channels, which yields blocks of raw messages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from threading import Event
from typing import NamedTuple

from icrtool.logs.containers.channel import WHOLE, Block, Channel, Cut, Problems
from icrtool.logs.containers.decompress import unpack_messages
from icrtool.logs.containers.recording_files import inputs_of
from icrtool.records.samples import InputFile


class Origin(NamedTuple):
    """What was done to have a log on disk, or to read it where it is.

    Attributes
    ----------
    inputs : what was read for it; empty: the files themselves
    transfer : returns in words how it came over a connection; empty for nothing
    remove : removes what was made for it
    """

    inputs: tuple[InputFile, ...] = ()
    transfer: Callable[[], str] = str
    remove: Callable[[], object] = str


MIXED = "topics share compressed chunks, which are read whole"


class Container(ABC):
    """A log file or directory, opened.

    Attributes
    ----------
    path : as errors name it
    files : those that make it up
    channels : the topics, known before any block is read
    mixed : of a distant file more was read than wanted
    message_compression : of each single message; empty for none
    origin : where it came from, if it was not there before
    """

    def __init__(self, path: Path, message_compression: str = "") -> None:
        self.path, self.files = path, [path]
        self.channels: Sequence[Channel] = []
        self.mixed = False
        self.message_compression = message_compression
        self.origin = Origin()
        self._problems = Problems(path.name)

    @property
    def problems(self) -> list[str]:
        """What could not be read and was left out; complete after the last block."""
        return list(self._problems)

    def report(self, problem: str) -> None:
        """Remember what could not be read."""
        self._problems.add(problem)

    def inputs(self, ended: Event) -> tuple[InputFile, ...]:
        """Return the files that make up this log, with their SHA-256: of their beginning once `ended` is set."""
        return self.origin.inputs or inputs_of(self.files, ended)

    def transfer(self) -> str:
        """Return in words how much came over a connection, and why all of it; empty for nothing."""
        return "; ".join(filter(None, [self.origin.transfer(), MIXED if self.mixed else ""]))

    def blocks(self, wanted: frozenset[int], cut: Cut = WHOLE) -> Generator[Block]:
        """Yield the messages of the channels in `wanted` in file order; others, and some outside the cut, among them.

        What an index shows to be outside the cut is not read.
        """
        if wanted:
            blocks = self._stored(wanted, cut)
            if self.message_compression:
                blocks = unpack_messages(blocks, wanted, self.message_compression, self.report)
            yield from blocks

    @abstractmethod
    def _stored(self, wanted: frozenset[int], cut: Cut) -> Iterator[Block]:
        """Yield what `blocks` does, each message as it is stored."""

    @abstractmethod
    def span_ns(self) -> tuple[int, int] | None:
        """Return the log times of the first and the last message, None where only reading the log shows them."""

    @abstractmethod
    def share_read(self) -> float:
        """Return the share of the log that has been read, 0 to 1."""

    def close(self) -> None:
        """Release files, and remove what was made for it."""
        self.origin.remove()
