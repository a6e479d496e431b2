"""The command line: the only package that uses click, and the only error boundary.

At Ctrl-C and SIGTERM what is half written is removed, and the process ends at once. No exception is raised: in the
middle of an import it could leave the import lock held, and in llvmlite's bookkeeping it is lost. The interpreter calls
a handler only after the compiled loop, or the call of a library, that the main thread is in; where that takes too long,
a second thread does the same.
"""

from __future__ import annotations

import errno
import gc
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

__all__ = ["main", "when_used"]

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that end a command; Windows has no SIGHUP."""

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of a program that Ctrl-C ended."""

SIGNAL_GRACE_S = 0.5
"""Time in which the main thread may end the process, and the processes of a batch, after a signal [s]."""

OVER = 0
"""Stands for the end of the block where the number of a signal is read."""


def main() -> None:
    """Run the command line; the one place where errors become text and an exit code."""
    # BLAS is given small matrices only (a dozen columns): its threads take more time to start than they would save.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Kernels of small loops run as fast, and compile in three quarters of the time.
    os.environ.setdefault("NUMBA_OPT", "1")
    # What pyarrow frees is given back with the rest.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    # No figure is shown, and matplotlib cannot be imported where this names no backend.
    os.environ["MPLBACKEND"] = "agg"
    if len(sys.argv) > 2:
        # Before the first thread starts; not where only help is asked for, since it takes some milliseconds.
        keep_freed()
    # Little of what a command makes is cyclic rubbish; looking for it every 700 objects costs a tenth of loading
    # numba and matplotlib, and of drawing. What a command loads is less than so many.
    gc.set_threshold(300_000)
    with suppress(ImportError, ValueError, OSError):
        # A recording split every minute has more files than a process may open; on Windows there is no such limit.
        import resource

        resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    with end_at_once(), standard_streams() as output:
        status = _run()
        if output.lost:
            sys.stderr.write(f"Error: standard output: cannot be written; {output.lost}\n")
            status = status or 1
    # At its end the interpreter looks for cyclic rubbish among all that was imported: a tenth of a second or two.
    gc.freeze()
    sys.exit(status)


def _run() -> int:
    """Run the command that was called; return the exit status."""
    try:
        import click

        from icrtool.cli.commands import icrtool
        from icrtool.errors import IcrToolError

        if "_ICRTOOL_COMPLETE" in os.environ:
            from icrtool.cli.installation import register_completion

            register_completion()
        try:
            status = icrtool.main(standalone_mode=False)
        except (IcrToolError, OSError) as err:
            if isinstance(err, OSError) and err.filename is None:
                raise
            from icrtool.cli.printing import print_error
            from icrtool.records.text import LogText

            # A path that is too long, or on a disk that fails, where no command knows more about it.
            print_error(f"{LogText(str(err.filename))}: {err.strerror}" if isinstance(err, OSError) else str(err))
            return 1
        except (MemoryError, ImportError, SystemError) as err:
            # without memory, a library or a module may be loaded in part only
            if not (isinstance(err, MemoryError) or _memory_is_limited()):
                raise
            advice = "give it more (ulimit -v), or read a part of the log (--from, --to)"
            sys.stderr.write(f"Error: memory: there is not enough; {advice}\n")
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
    # Asked for help, click returns a status; a command returns nothing.
    return status if isinstance(status, int) else 0


def _memory_is_limited() -> bool:
    """Return whether the address space of the process has a limit (``ulimit -v``)."""
    with suppress(ImportError):
        import resource

        return resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY
    return False


class _Unloaded:
    """Finds the modules of icrtool, each to be loaded at the first use of a name in it; packages at once."""

    @staticmethod
    def find_spec(fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return how a module is loaded; None of those of others."""
        spec = PathFinder.find_spec(fullname, path, target) if fullname.startswith("icrtool.") else None
        if spec is not None and spec.loader is not None and spec.submodule_search_locations is None:
            spec.loader = LazyLoader(spec.loader)
        return spec


@contextmanager
def when_used() -> Iterator[None]:
    """Have what the block imports (``from icrtool.output import series``) loaded when it is used first.

    So the help of a command loads no numpy, pandas or pyarrow. Two threads must not be the first to use a module.
    Packages are loaded at once: `icrtool.output.figures`, which loads matplotlib, is imported where it is used.
    """
    sys.meta_path.insert(sys.meta_path.index(PathFinder), _Unloaded)
    try:
        yield
    finally:
        sys.meta_path.remove(_Unloaded)


@contextmanager
def end_at_once() -> Iterator[None]:
    """Have the signals of `ENDING` end the process with the status 128 and their number; on Windows nothing changes.

    SIGHUP comes where a terminal is closed.
    """
    if threading.current_thread() is not threading.main_thread() or sys.platform == "win32":
        yield
        return
    # A signal that the parent process set to be ignored, as a shell does for background jobs, stays ignored.
    handled = [one for one in ENDING if signal.getsignal(one) is not signal.SIG_IGN]
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
    """Wait for one of these signals, and end the process where the main thread does not."""
    while (number := os.read(arrived, 1)[0]) != OVER:
        if number in ENDING and not over.wait(SIGNAL_GRACE_S):
            _end(number)
    os.close(arrived)


def _end(number: int, frame: FrameType | None = None) -> None:
    """Remove what this process is writing, and end it and its worker processes, whatever its threads do."""
    if frame is not None and not may_end():
        return  # `_watch` ends it
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

    def isatty(self) -> bool:
        """Return whether it is a terminal; a stream that was closed is none."""
        return self._stream is not None and self._stream.isatty()

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
