"""The process of a command: how signals end it, and standard streams that may be closed.

At Ctrl-C and SIGTERM what is half written is removed, and the process ends at once. No exception is raised: in the
middle of an import it could leave the import lock held, and in llvmlite's bookkeeping it is lost. The interpreter calls
a handler only after the compiled loop, or the call of a library, that the main thread is in; where that takes too long,
a second thread does the same.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, TextIO, cast

from icrtool.records.process_resources import remove_unfinished

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of a program that Ctrl-C ended."""

GRACE_S = 0.5
"""Time in which the main thread may end the process, and the processes of a batch, after a signal [s]."""

OVER = 0
"""Stands for the end of the block where the number of a signal is read."""


@contextmanager
def end_at_once() -> Iterator[None]:
    """Have SIGINT and SIGTERM end the process with the status 128 and their number; on Windows nothing changes."""
    if threading.current_thread() is not threading.main_thread() or sys.platform == "win32":
        yield
        return
    # A signal that the parent process set to be ignored, as a shell does for background jobs, stays ignored.
    handled = [one for one in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(one) is not signal.SIG_IGN]
    arrived, signalled = os.pipe()
    os.set_blocking(signalled, False)
    over = threading.Event()
    threading.Thread(target=_watch, args=(arrived, over), name="interrupts", daemon=True).start()
    # The system's handler of a signal writes its number there at once, whatever the interpreter is doing.
    before = signal.set_wakeup_fd(signalled, warn_on_full_buffer=False)
    for number in handled:
        signal.signal(number, _end)
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, signal.SIG_DFL)
        signal.set_wakeup_fd(before)
        over.set()
        # The end of the pipe would not be enough: a forked process has a copy of this side.
        os.write(signalled, bytes([OVER]))
        os.close(signalled)


def _watch(arrived: int, over: threading.Event) -> None:
    """Wait for SIGINT or SIGTERM, and end the process where the main thread does not."""
    while (number := os.read(arrived, 1)[0]) != OVER:
        if number in (signal.SIGINT, signal.SIGTERM) and not over.wait(GRACE_S):
            _end(number)
    os.close(arrived)


def _end(number: int, _frame: FrameType | None = None) -> None:
    """Remove what this process is writing, and end it and its worker processes, whatever its threads do."""
    # No import here: the main thread may hold its lock.
    if (processes := sys.modules.get("icrtool.fleet.processes")) is not None:
        processes.end_for_good()
    remove_unfinished()
    with suppress(OSError, ValueError, RuntimeError):  # RuntimeError: it was just being written
        sys.stdout.flush()
    with suppress(OSError):
        if number == signal.SIGINT:
            os.write(2, b"Aborted!\n")
    os._exit(128 + number)


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
