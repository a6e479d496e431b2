"""The command line: the only package that uses click, and the only error boundary.

At Ctrl-C and SIGTERM unfinished files are removed, and the process ends at once. No exception is raised: an exception
during an import could leave the import lock held, and llvmlite may drop it. The interpreter calls a signal handler only
after the compiled loop or the library call of the main thread has returned; if that takes too long, a second thread
ends the process.
"""

from __future__ import annotations

import errno
import gc
import math
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from types import FrameType, ModuleType
from typing import Any, TextIO, cast

from icrtool.records.process_resources import keep_freed, may_end, remove_unfinished

__all__ = ["lazy_imports", "main"]

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that end a command. Windows has no SIGHUP."""

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of a program that Ctrl-C ended."""

SIGNAL_GRACE_S = 0.5
"""Time after a signal in which the main thread may end the process and the processes of a batch [s]."""

END_OF_BLOCK = 0
"""Number in the pipe of `exit_on_signals` that stands for the end of the block; all others are numbers of signals."""


def main() -> None:
    """Run the command line. This is the only function that converts errors to a text and an exit status."""
    # BLAS gets only small matrices (a dozen columns): its threads take more time to start than they save.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # With this setting kernels of small loops run as fast, and compile in three quarters of the time.
    os.environ.setdefault("NUMBA_OPT", "1")
    # With this setting the memory that pyarrow frees is given back with all other freed memory.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    # No figure is shown, and an invalid MPLBACKEND of the user would stop the import of matplotlib.
    os.environ["MPLBACKEND"] = "agg"
    if len(sys.argv) > 2:
        # This call must come before the first thread starts. It takes milliseconds, so a call for help leaves it out.
        keep_freed()
    # Few objects of a command form cycles. A garbage collection every 700 objects costs a tenth of the time of loading
    # numba and matplotlib, and of drawing. A command loads fewer objects than this threshold.
    gc.set_threshold(300_000)
    with suppress(ImportError, ValueError, OSError):
        # A recording split every minute has more files than a process may open; on Windows there is no such limit.
        import resource

        resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    with exit_on_signals(), standard_streams() as output:
        status = _run()
        if output.lost:
            sys.stderr.write(f"Error: standard output: cannot be written; {output.lost}\n")
            status = status or 1
    # Without this call the interpreter collects garbage among all imported objects at its end, in 0.1 to 0.2 s.
    gc.freeze()
    sys.exit(status)


def _run() -> int:
    """Run the command on the command line; return its exit status."""
    try:
        import click

        from icrtool.cli.commands import icrtool
        from icrtool.errors import IcrToolError

        if "_ICRTOOL_COMPLETE" in os.environ:
            from icrtool.cli.installation import register_completion

            register_completion()
        try:
            if len(sys.argv) > 2 and _address_limit_bytes() < LEAST_ADDRESS_BYTES:
                raise MemoryError
            status = icrtool.main(standalone_mode=False)
        except (IcrToolError, OSError) as err:
            if isinstance(err, OSError) and err.filename is None:
                raise
            from icrtool.cli.printing import print_error
            from icrtool.records.text import LogText

            # For example a path that is too long, or a disk that fails, of which no command reports more.
            print_error(f"{LogText(str(err.filename))}: {err.strerror}" if isinstance(err, OSError) else str(err))
            return 1
        except (MemoryError, ImportError, RuntimeError, SystemError) as err:
            if not _shows_lack_of_memory(err):
                raise
            advice = "give it more (ulimit -v), or read a part of the log (--from, --to)"
            sys.stderr.write(f"Error: memory: the process has reached its limit; {advice}\n")
            return 1
        except click.ClickException as err:
            err.show()
            return err.exit_code
        except click.Abort as err:
            raise KeyboardInterrupt from err
    except SystemExit as left:
        return left.code if isinstance(left.code, int) else int(left.code is not None)
    except KeyboardInterrupt:
        sys.stderr.write("Aborted!\n")
        return INTERRUPTED
    # click returns a status after help, and None after a command.
    return status if isinstance(status, int) else 0


NO_THREAD = "can't start new thread"
"""Text of the RuntimeError that Python raises if there is no memory for the stack of a thread."""

LEAST_ADDRESS_BYTES = 420_000_000
"""Smallest address space in which NumPy, pandas and pyarrow are loaded [bytes]. In less, OpenBLAS ends the process, and
no error can be caught."""


def _shows_lack_of_memory(err: Exception) -> bool:
    """Return whether an error shows that the process has reached its limit of memory."""
    if isinstance(err, MemoryError):
        return True
    # After a lack of memory, a library or a module may be loaded only in part.
    return (str(err) == NO_THREAD or not isinstance(err, RuntimeError)) and math.isfinite(_address_limit_bytes())


def _address_limit_bytes() -> float:
    """Return the limit of the address space of the process (``ulimit -v``) [bytes]; infinite without a limit."""
    with suppress(ImportError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        return math.inf if limit == resource.RLIM_INFINITY else limit
    return math.inf


class _LazyFinder:
    """Finder of the modules of icrtool. A module is loaded at the first use of a name in it, a package at once."""

    @staticmethod
    def find_spec(fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return how a module is loaded; None for modules of other packages."""
        spec = PathFinder.find_spec(fullname, path, target) if fullname.startswith("icrtool.") else None
        if spec is not None and spec.loader is not None and spec.submodule_search_locations is None:
            spec.loader = LazyLoader(spec.loader)
        return spec


@contextmanager
def lazy_imports() -> Iterator[None]:
    """Load the modules that the block imports (``from icrtool.output import series``) only at their first use.

    The help of a command then loads no numpy, pandas or pyarrow. The first use of a module must not happen in two
    threads at the same time. Packages are loaded at once, so `icrtool.output.figures`, which loads matplotlib, is
    imported in the functions that use it.
    """
    sys.meta_path.insert(sys.meta_path.index(PathFinder), _LazyFinder)
    try:
        yield
    finally:
        sys.meta_path.remove(_LazyFinder)


@contextmanager
def exit_on_signals() -> Iterator[None]:
    """Let the signals of `ENDING` end the process, with 128 plus the number of the signal as status; not on Windows.

    A process gets SIGHUP when its terminal is closed.
    """
    if threading.current_thread() is not threading.main_thread() or sys.platform == "win32":
        yield
        return
    # A signal that the parent process set to be ignored, as a shell does for background jobs, stays ignored.
    handled = [ending for ending in ENDING if signal.getsignal(ending) is not signal.SIG_IGN]
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    block_ended = threading.Event()
    threading.Thread(target=_watch, args=(read_end, block_ended), name="interrupts", daemon=True).start()
    # The signal handler in C writes the number of the signal to this pipe at once, even during a library call.
    before = signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    for number in handled:
        signal.signal(number, _end)
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, signal.SIG_DFL)
        signal.set_wakeup_fd(before)
        block_ended.set()
        # Closing the pipe is not enough, because a forked process has a copy of this end.
        os.write(write_end, bytes([END_OF_BLOCK]))
        os.close(write_end)


def _watch(read_end: int, block_ended: threading.Event) -> None:
    """Wait for a signal of `ENDING`, and end the process if the main thread does not end it in `SIGNAL_GRACE_S`."""
    while (number := os.read(read_end, 1)[0]) != END_OF_BLOCK:
        if number in ENDING and not block_ended.wait(SIGNAL_GRACE_S):
            _end(number)
    os.close(read_end)


def _end(number: int, frame: FrameType | None = None) -> None:
    """Remove the unfinished files of this process, and end the process, its threads and its worker processes."""
    if frame is not None and not may_end():
        return  # The thread of `_watch` ends the process.
    # No import here, because the main thread may hold the import lock.
    if (processes := sys.modules.get("icrtool.fleet.processes")) is not None:
        processes.end_for_good()
    remove_unfinished()
    with suppress(
        OSError, ValueError, RuntimeError
    ):  # A RuntimeError means that the stream is being written at this moment.
        sys.stdout.flush()
    with suppress(OSError):
        if number == signal.SIGINT:
            os.write(2, b"Aborted!\n")
    os._exit(128 + number)


class Stream:
    """A standard stream whose failures do not stop a command: text that cannot be written is dropped.

    Attributes
    ----------
    lost : reason for which text was lost; empty if nothing was lost, or if the reader of a pipe closed it
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self.lost = ""

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the stream has
        return getattr(self._stream, name)

    def isatty(self) -> bool:
        """Return whether the stream is a terminal; False for a closed stream."""
        return self._stream is not None and self._stream.isatty()

    def write(self, text: str) -> int:
        """Write a text; drop the text if it cannot be written."""
        if self._stream is None:
            self.lost = os.strerror(errno.EBADF)
            return len(text)
        try:
            return self._stream.write(text)
        except OSError as err:
            self._drop(err)
            return len(text)

    def flush(self) -> None:
        """Write the buffered text; drop it if it cannot be written."""
        try:
            if self._stream is not None:
                self._stream.flush()
        except OSError as err:
            self._drop(err)

    def _drop(self, err: OSError) -> None:
        """Keep the reason for an error of the stream, and drop all buffered text."""
        if err.errno != errno.EPIPE:
            self.lost = err.strerror or str(err)
        # Buffered text is dropped too, because the interpreter would fail with the same error at its end.
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, cast(TextIO, self._stream).fileno())
            os.close(nowhere)


@contextmanager
def standard_streams() -> Iterator[Stream]:
    """Replace standard output and error by streams that may fail; yield the stream of standard output."""
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
