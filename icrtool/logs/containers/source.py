"""Where the bytes of a file of chunks come from: a file on disk, or one behind a connection, read by ranges."""

from __future__ import annotations

from pathlib import Path
from threading import Event, Lock
from typing import NamedTuple, Protocol

from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.split_files import inputs_of
from icrtool.records.samples import InputFile

NEAR_BYTES = 1 << 15
"""Between two ranges of a distant file that are read too: a request takes as long as some 100 kB."""


class Held(NamedTuple):
    """Bytes of a file from a place on."""

    at: int
    data: bytes


class Source(Protocol):
    """A file that is read at any place, by several threads.

    Attributes
    ----------
    distant : each read takes as long as many kilobytes: reads are few, and made ahead
    """

    size: int
    distant: bool

    def read_at(self, at: int, count: int) -> bytes:
        """Return bytes of the file, as many as there are."""
        ...

    def read_into(self, at: int, space: Bytes) -> int:
        """Fill some space with bytes of the file, and return how many there are."""
        ...

    def hold(self, at: int, count: int) -> Held | None:
        """Return bytes that this thread needs next, if reading them in one piece is faster; `read_at` has them too."""
        ...

    def gather(self, at: int, ranges: Ints) -> bytes:
        """Return what stands in several ranges (2, n) behind a place, one after the other."""
        ...

    def inputs(self, ended: Event) -> tuple[InputFile, ...]:
        """Return what run.json states about the file."""
        ...

    def transfer(self) -> str:
        """Return how much was read of a distant file, as words."""
        ...

    def close(self) -> None:
        """Release the file."""
        ...


class LocalFile:
    """A file on disk."""

    distant = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stream = path.open("rb")
        self._lock = Lock()
        self.size = path.stat().st_size

    def read_at(self, at: int, count: int) -> bytes:
        """Return bytes of the file, as many as there are."""
        with self._lock:
            self._stream.seek(at)
            return self._stream.read(count)

    def read_into(self, at: int, space: Bytes) -> int:
        """Fill some space with bytes of the file, and return how many there are."""
        with self._lock:
            self._stream.seek(min(at, self.size))
            return self._stream.readinto(space.data)

    def hold(self, at: int, count: int) -> None:
        """Return None."""

    def gather(self, at: int, ranges: Ints) -> bytes:
        """Return what stands in several ranges (2, n) behind a place, one after the other."""
        return b"".join(self.read_at(at + begin, end - begin) for begin, end in ranges.T.tolist())

    def inputs(self, ended: Event) -> tuple[InputFile, ...]:
        """Return the file with its SHA-256."""
        return inputs_of([self._path], ended)

    def transfer(self) -> str:
        """Return nothing."""
        return ""

    def close(self) -> None:
        """Release the file."""
        self._stream.close()
