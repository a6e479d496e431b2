"""Who draws: this process, or a second one while this one computes and writes.

Matplotlib takes longer to load and to draw than a log takes to filter, and holds the interpreter while it does.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

Write = Callable[..., None]
"""Called with a directory, formats, and what to draw; a function of a module, which another process can import."""

Draw = Callable[..., None]
"""Called with a `Write` and what it draws."""


class Drawer(Protocol):
    """Who draws figures."""

    @property
    def formats(self) -> tuple[str, ...]:
        """Of ``png``, ``svg`` and ``pdf``."""
        ...

    def into(self, directory: Path) -> AbstractContextManager[Draw]:
        """Give ``draw(write, *content)``, which has figures written into a new directory by the end of the block."""
        ...


@contextmanager
def matplotlib_unsaid() -> Iterator[None]:
    """Suppress what matplotlib prints about a home directory it cannot write: it does not concern our user."""
    logger = logging.getLogger("matplotlib")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


class DrawingHere:
    """Draws in this process, at once.

    Parameters
    ----------
    formats : of ``png``, ``svg`` and ``pdf``; with none nothing is drawn
    """

    def __init__(self, formats: tuple[str, ...]) -> None:
        self.formats = formats

    @contextmanager
    def into(self, directory: Path) -> Iterator[Draw]:
        """Give ``draw(write, *content)``; see `Drawer`."""

        def draw(write: Write, *content: object) -> None:
            if not self.formats:
                return
            directory.mkdir(exist_ok=True)
            with matplotlib_unsaid():
                write(directory, self.formats, *content)

        yield draw


class DrawingProcess:
    """A process that draws figures; it lives as long as its ``with`` block.

    On Linux it is forked: what was loaded before is there at once, but a process with threads should not be forked.

    Parameters
    ----------
    formats : of ``png``, ``svg`` and ``pdf``; with none nothing is started and nothing drawn
    load : called there at once, to load what drawing will need beyond matplotlib; a function of a module
    """

    def __init__(self, formats: tuple[str, ...], load: Callable[[], None] | None = None) -> None:
        self.formats = formats
        self._load = load
        self._pool: ProcessPoolExecutor | None = None
        self._workers: list[BaseProcess] = []

    def __enter__(self) -> Self:
        try:
            # A signal between two steps of this would leave a process that nobody ends.
            with _signals_held():
                self._start()
        except BaseException:
            self._stop(at_once=True)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Nobody waits for pictures of what failed.
        self._stop(at_once=kind is not None)

    def _start(self) -> None:
        if not self.formats:
            return
        method = "fork" if sys.platform == "linux" else None
        self._pool = ProcessPoolExecutor(1, multiprocessing.get_context(method), initializer=_begin)
        others = multiprocessing.active_children()
        self._pool.submit(_load_matplotlib)
        if self._load is not None:
            self._pool.submit(self._load)
        self._workers = [process for process in multiprocessing.active_children() if process not in others]

    def _stop(self, *, at_once: bool) -> None:
        if self._pool is None:
            return
        for process in self._workers if at_once else ():
            process.terminate()
        self._pool.shutdown(cancel_futures=True)

    @contextmanager
    def into(self, directory: Path) -> Iterator[Draw]:
        """Give ``draw(write, *content)``; wait for all figures at the end. See `Drawer`.

        Raises
        ------
        OSError
            A file cannot be written, or the process is gone.
        """
        pending: list[Future[None]] = []

        def draw(write: Write, *content: object) -> None:
            if self._pool is not None:
                directory.mkdir(exist_ok=True)
                pending.append(self._pool.submit(write, directory, self.formats, *content))

        try:
            yield draw
            for drawn in pending:
                drawn.result()
        except BrokenProcessPool as err:
            raise OSError("the process that draws was ended from outside, for want of memory perhaps") from err
        finally:
            for drawn in pending:
                drawn.cancel()
            wait(pending)


@contextmanager
def _signals_held() -> Iterator[None]:
    """Have Ctrl-C, a kill and an alarm wait for the end of the block, where that can be."""
    if not hasattr(signal, "pthread_sigmask") or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGALRM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin() -> None:
    """Leave an interrupt to the parent, and suppress what matplotlib prints about an unwritable home directory."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # That of the parent, which would take this process's signals for its own.
    signal.set_wakeup_fd(-1)
    if hasattr(signal, "pthread_sigmask"):
        # Held by the parent while it forked.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


def _end_with_parent() -> None:
    """End this process when its parent is killed: it would wait for ever, and hold the parent's output open."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _load_matplotlib() -> None:
    """Load what drawing needs, and fill the font cache, while there is nothing to draw yet."""
    from io import BytesIO

    configured = "MPLCONFIGDIR" in os.environ
    from icrtool.output.figures.style import new_figure, style

    if not configured and (temporary := os.environ.get("MPLCONFIGDIR")) is not None:
        # Without a home it can write matplotlib makes itself a folder, and removes it at an exit that a process of
        # multiprocessing does not take.
        Finalize(None, shutil.rmtree, (temporary, True), exitpriority=0)
    with style():
        figure = new_figure("A", "b", width_in=1, height_in=1)
        figure.subplots().plot([0.0, 1.0], label="c")
        figure.legend()
        figure.savefig(BytesIO(), format="png")
