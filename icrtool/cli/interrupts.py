"""Ctrl-C and SIGTERM: they end a command in order, and by force where that takes too long.

In order means by an exception in the main thread, whose handlers remove what is half written. None is raised while
modules are imported: in the middle of an import it can leave the import lock held, and other threads then wait for
ever; in the middle of llvmlite's bookkeeping it is lost, or reported as an error of llvmlite. And the interpreter
raises it only after the compiled loop, or the call of a library, that the main thread is in. So a second thread
watches the time: after `GRACE_S` it removes what is half written and ends the process.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import CodeType, FrameType

from icrtool.records.unfinished import remove_unfinished

INTERRUPTED, TERMINATED = 130, 143
"""Exit status of a program that a signal ended: 128 plus the number of the signal."""

GRACE_S = 0.3
"""Time in which a command may end in order after a signal [s]."""

LLVMLITE = f"{os.sep}llvmlite{os.sep}"

OVER = 0
"""Stands for the end of the block where the number of a signal is read."""


@contextmanager
def end_in_order(boundary: CodeType) -> Iterator[Ending]:
    """Have SIGINT raise KeyboardInterrupt and SIGTERM leave with `TERMINATED`, at the latest after `GRACE_S`.

    Where a module is being loaded, the process ends after that time. The limit holds until the process ends: at its
    end the interpreter waits for threads, which may be compiling. After the block, signals have their default effect.

    Parameters
    ----------
    boundary : code of the function that catches both; what is loaded further out is no matter
    """
    watched = hasattr(signal, "pthread_sigmask")  # not on Windows
    ending = Ending(boundary, watched=watched)
    if threading.current_thread() is not threading.main_thread():
        yield ending
        return
    # A signal that the parent process set to be ignored, as a shell does for background jobs, stays ignored.
    handled = [one for one in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(one) is not signal.SIG_IGN]
    for number in handled:
        signal.signal(number, ending.come)
    if not watched:
        yield ending
        return
    with _watched(ending):
        before, sys.unraisablehook = sys.unraisablehook, _without_ends
        try:
            yield ending
        finally:
            sys.unraisablehook = before
            for number in handled:
                signal.signal(number, signal.SIG_DFL)


@contextmanager
def _watched(ending: Ending) -> Iterator[None]:
    """End the process `GRACE_S` after a signal that came in the block, if it still is there."""
    arrived, signalled = os.pipe()
    os.set_blocking(signalled, False)
    # The system's handler of a signal writes its number there at once, whatever the interpreter is doing.
    before = signal.set_wakeup_fd(signalled, warn_on_full_buffer=False)
    over = threading.Event()
    thread = threading.Thread(target=_watch, args=(arrived, over), name="interrupts", daemon=True)
    # It inherits this: where the main thread holds signals, another thread must not receive them either.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    thread.start()
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        if not ending.ended:
            over.set()
            # The end of the pipe would not be enough: a forked process has a copy of this side.
            os.write(signalled, bytes([OVER]))
            os.close(signalled)


def _without_ends(lost: sys.UnraisableHookArgs) -> None:
    """Print an exception that was lost, but not that of a signal: where one is, `_watch` ends the process."""
    if not isinstance(lost.exc_value, KeyboardInterrupt | SystemExit):
        sys.__unraisablehook__(lost)


def _watch(arrived: int, over: threading.Event) -> None:
    """Wait for SIGINT or SIGTERM, then for the end of the block, and end the process where that does not come."""
    while (number := os.read(arrived, 1)[0]) != OVER:
        if number in (signal.SIGINT, signal.SIGTERM) and not over.wait(GRACE_S):
            end_by_force(INTERRUPTED if number == signal.SIGINT else TERMINATED)
    os.close(arrived)


def end_by_force(status: int) -> None:
    """Remove what this process is writing, and end it, whatever its threads do."""
    # No import here: the main thread may hold its lock.
    remove_unfinished()
    with suppress(OSError):
        if status == INTERRUPTED:
            os.write(2, b"Aborted!\n")
    os._exit(status)


class Ending:
    """The end of a command, once a signal has asked for it; `ended`: its exception was raised."""

    def __init__(self, boundary: CodeType, *, watched: bool) -> None:
        self._boundary = boundary
        self._watched = watched
        self.ended = False

    def come(self, number: int, frame: FrameType | None) -> None:
        """End the command, or leave that to the thread that watches the time."""
        # Once ended, what is half written is being removed, in limited time.
        if self.ended or (self._watched and self._loading(frame)):
            return
        self.ended = self._watched
        if number == signal.SIGTERM:
            # Killed by a timeout or at a shutdown, a command still removes what is half written.
            sys.exit(TERMINATED)
        raise KeyboardInterrupt

    def _loading(self, frame: FrameType | None) -> bool:
        """Return whether the main thread is in the middle of an import, or in llvmlite."""
        while frame is not None and frame.f_code is not self._boundary:
            file = frame.f_code.co_filename
            if file.startswith("<frozen importlib.") or LLVMLITE in file:
                return True
            frame = frame.f_back
        return False
