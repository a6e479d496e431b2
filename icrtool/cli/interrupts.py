"""Ctrl-C and SIGTERM: they end a command in order, and wait while modules are imported.

An exception in the middle of an import can leave the import lock held, and other threads then wait for ever. In the
middle of llvmlite's bookkeeping it is lost, or reported as an error of llvmlite.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import CodeType, FrameType

INTERRUPTED, TERMINATED = 130, 143
"""Exit status of a program that a signal ended: 128 plus the number of the signal."""

LLVMLITE = f"{os.sep}llvmlite{os.sep}"

AGAIN_S = 0.005
"""A signal that had to wait is handled again after this time [s]."""


def end_in_order(boundary: CodeType) -> None:
    """Have SIGINT raise KeyboardInterrupt and SIGTERM leave with `TERMINATED`, once no module is being loaded.

    Parameters
    ----------
    boundary : code of the function that catches both; what is loaded further out is no matter
    """
    if threading.current_thread() is threading.main_thread():
        ending = _Ending(boundary)
        for number in (signal.SIGINT, signal.SIGTERM):
            # A signal that the parent process set to be ignored, as a shell does for background jobs, stays ignored.
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, ending.come)
        if hasattr(signal, "setitimer"):
            signal.signal(signal.SIGALRM, ending.come_again)


class _Ending:
    """The end of a command, once a signal has asked for it."""

    def __init__(self, boundary: CodeType) -> None:
        self._boundary = boundary
        self._waiting: int | None = None

    def come(self, number: int, frame: FrameType | None) -> None:
        """End the command, or wait; asked a second time, do not wait."""
        if self._waiting is None and hasattr(signal, "setitimer") and self._loading(frame):
            self._waiting = number
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S, AGAIN_S)
        else:
            self._end(number)

    def come_again(self, _: int, frame: FrameType | None) -> None:
        """End the command if nothing is loaded any more."""
        if self._waiting is not None and not self._loading(frame):
            self._end(self._waiting)

    def _loading(self, frame: FrameType | None) -> bool:
        """Return whether the main thread is in the middle of an import, or in llvmlite."""
        while frame is not None and frame.f_code is not self._boundary:
            file = frame.f_code.co_filename
            if file.startswith("<frozen importlib.") or LLVMLITE in file:
                return True
            frame = frame.f_back
        return False

    def _end(self, number: int) -> None:
        if self._waiting is not None:
            self._waiting = None
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        if number == signal.SIGTERM:
            # Killed by a timeout or at a shutdown, a command still removes what is half written.
            sys.exit(TERMINATED)
        raise KeyboardInterrupt
