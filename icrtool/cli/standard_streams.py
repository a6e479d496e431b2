"""Standard output and error that may be closed: a command completes its work even if nobody reads its output."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast


class Stream:
    """A standard stream whose failures do not stop a command: text that cannot be written is dropped.

    Attributes
    ----------
    lost : why something could not be written; empty where nothing was lost, and where a reader had enough (a pipe)
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self.lost = ""

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the stream has
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, or drop it."""
        if self._stream is None:
            self.lost = os.strerror(errno.EBADF)
            return len(text)
        try:
            return self._stream.write(text)
        except OSError as err:
            self._drop(err)
            return len(text)

    def flush(self) -> None:
        """Write what is held back, or drop it."""
        try:
            if self._stream is not None:
                self._stream.flush()
        except OSError as err:
            self._drop(err)

    def _drop(self, err: OSError) -> None:
        if err.errno != errno.EPIPE:
            self.lost = err.strerror or str(err)
        # Buffered text is dropped, too: the interpreter would fail with the same error when it ends.
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, cast(TextIO, self._stream).fileno())
            os.close(nowhere)


@contextmanager
def standard_streams() -> Iterator[Stream]:
    """Put streams that may go away in the place of standard output and error; give that of the output."""
    before = sys.stdout, sys.stderr
    for stream in before:
        # A terminal that cannot show a degree sign gets a question mark, not a traceback.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    output = Stream(sys.stdout)
    sys.stdout, sys.stderr = cast(TextIO, output), cast(TextIO, Stream(sys.stderr))
    try:
        yield output
    finally:
        sys.stdout, sys.stderr = before
