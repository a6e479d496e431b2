"""A process of its own for the work on a log: what hangs is killed, what dies is replaced, and costs one log.

A worker process is started once and processes log after log, so that libraries and compiled code are loaded once.
Requests and rows travel as lines of JSON through its standard input and output.
"""

from __future__ import annotations

import gc
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, NamedTuple

import msgspec

from icrtool.fleet.fit_and_report import Stage
from icrtool.fleet.one_log import Request, decode_request, failed, process
from icrtool.fleet.row import Row
from icrtool.records.memory import give_back_freed
from icrtool.records.unfinished import remove_unfinished

GRACE_S = 0.3
"""Time in which a process may remove what it is writing before it is killed [s]."""

LONGEST_DETAILS = 4000
"""Letters kept of what a process printed before it died."""

ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "MPLBACKEND": "agg",
    "MALLOC_ARENA_MAX": "1", "ARROW_DEFAULT_MEMORY_POOL": "system",
}  # fmt: skip
"""One thread a log: the logs are what runs at the same time. Memory as `icrtool.cli.main` has it."""

NOT_INHERITED = "MALLOC_TRIM_THRESHOLD_"
"""Dask sets it for its workers: memory then goes back to the system again and again, which doubles system time."""


COMMAND = (sys.executable, "-P", "-m", "icrtool.fleet.worker")


class Line(NamedTuple):
    """What a worker process prints: the stage it is in, or the row it ends with."""

    stage: str = ""
    row: Row | None = None


_LINE = msgspec.json.Decoder(Line)
"""Made at import: msgspec crashes where several threads are the first to use a type."""


class Worker:
    """A process that processes one log at a time; started when it is needed."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._errors: IO[bytes] | None = None

    def run(self, request: Request, timeout_s: float, stage: Stage) -> Row:
        """Process a log; one that hangs or kills the process gives a row with the reason."""
        process, errors = self._started()
        begin_of_errors = errors.seek(0, os.SEEK_END)
        begun = time.monotonic()
        end = begun + timeout_s
        try:
            assert process.stdin is not None  # noqa: S101 - for the type checker
            process.stdin.write(request.encode() + b"\n")
            process.stdin.flush()
            while (text := self._lines.get(timeout=max(end - time.monotonic(), 0.0))) is not None:
                line = _LINE.decode(text)
                if line.row is not None:
                    return line.row
                stage(line.stage)
        except queue.Empty:
            self.close()
            return _after(begun, failed(request, f"took longer than {timeout_s:g} s and was ended", repeatable=False))
        except (OSError, ValueError):
            pass  # it died, or what it wrote was cut off when it did
        why = _how_it_ended(process)
        details = ""
        with suppress(ValueError):  # closed, where the batch was interrupted
            errors.seek(begin_of_errors)
            details = errors.read().decode(errors="replace").strip()[-LONGEST_DETAILS:]
        self.close()
        last = f": {details.splitlines()[-1]}" if details else ""
        return _after(begun, failed(request, f"{why}{last}", details=details, repeatable=False))

    def ask_to_end(self) -> None:
        """Close its input: it removes what it is writing, and ends."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):  # its other end is gone
                self._process.stdin.close()

    def close(self) -> None:
        """End the process, whatever it does."""
        self.ask_to_end()
        process, self._process = self._process, None
        if process is not None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(GRACE_S)
            process.kill()
            process.wait()
        if self._errors is not None:
            self._errors.close()
            self._errors = None

    def _started(self) -> tuple[subprocess.Popen[bytes], IO[bytes]]:
        """Return the process and the file that its errors go to."""
        if self._process is not None and self._errors is not None and self._process.poll() is None:
            return self._process, self._errors
        self.close()
        errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        home = str(Path(__file__).resolve().parents[2])
        paths = os.pathsep.join(filter(None, [home, os.environ.get("PYTHONPATH")]))
        inherited = {name: value for name, value in os.environ.items() if name != NOT_INHERITED}
        # In a session of its own: Ctrl-C reaches the command, which ends its workers.
        process = subprocess.Popen(  # noqa: S603 - our own command
            COMMAND,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
            env={**inherited, **ENVIRONMENT, "PYTHONPATH": paths}, start_new_session=True,
        )  # fmt: skip
        self._process, self._errors, self._lines = process, errors, queue.SimpleQueue()
        threading.Thread(target=_forward, args=(process.stdout, self._lines), daemon=True).start()
        return process, errors


def _after(begun: float, row: Row) -> Row:
    """Return a row with the time [s] since a reading of the monotonic clock."""
    return replace(row, took_s=round(time.monotonic() - begun, 3))


def _how_it_ended(process: subprocess.Popen[bytes]) -> str:
    try:
        status = process.wait(10)
    except subprocess.TimeoutExpired:
        return "its process closed its output and did not end"
    if status >= 0:
        return f"its process ended with exit status {status}"
    name = signal.Signals(-status).name
    return f"its process was ended by {name}{', perhaps for lack of memory' if name == 'SIGKILL' else ''}"


_mine = threading.local()
_all: set[Worker] = set()


def process_apart(request: bytes, timeout_s: float, stage: Stage | None = None) -> Row:
    """Process a log in the process that belongs to the calling thread; the same on this machine and on a cluster.

    Parameters
    ----------
    request : of `Request.encode`
    timeout_s : after which the process is killed
    stage : called with what is done next, where the caller is on the same machine
    """
    worker: Worker | None = getattr(_mine, "worker", None)
    if worker is None:
        worker = _mine.worker = Worker()
        _all.add(worker)
    return worker.run(decode_request(request), timeout_s, stage if stage is not None else _unheard)


def close_all() -> None:
    """End the worker processes of all threads."""
    for worker in list(_all):
        worker.ask_to_end()
    while _all:
        _all.pop().close()


def _unheard(_: str) -> None:
    """Take a stage that nobody follows."""


def _forward(stream: IO[bytes], lines: queue.SimpleQueue[bytes | None]) -> None:
    """Put the lines of a process into a queue, None at its end."""
    with stream:
        for line in stream:
            lines.put(line)
    lines.put(None)


def main() -> None:
    """Process the logs that standard input asks for, until it ends."""
    # What a library prints goes with the errors. Files of our own: Python's are locked by who waits for a line.
    requests, output = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.set_threshold(100_000)

    def send(line: Line) -> None:
        output.write(msgspec.json.encode(line) + b"\n")
        output.flush()

    def begin(stage: str) -> None:
        give_back_freed()
        send(Line(stage))

    for text in _lines_of(requests):
        send(Line(row=process(decode_request(text), begin)))


def _lines_of(stream: IO[bytes]) -> Iterator[bytes]:
    """Yield the lines of a stream; end the process when it is closed, in the middle of a log too."""
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read() -> None:
        for line in stream:
            lines.put(line)
        # The process that asked has ended, or ends this one.
        remove_unfinished()
        os._exit(1)

    threading.Thread(target=read, daemon=True).start()
    while True:
        yield lines.get()


if __name__ == "__main__":
    main()
