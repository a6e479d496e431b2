"""Worker processes of a batch. A process that hangs is killed; a process that dies affects one log only.

A process works on one log after the other, so that it loads libraries and compiled code once. It reads requests from
its standard input as lines of JSON, and writes stages (texts) and rows (objects) to its standard output. Threads on
this machine, or threads of the workers of a cluster, call `process_apart` for each log.

`pebble.ProcessPool` and `concurrent.futures` are not used: an exception that cannot be unpickled, or a process killed
while it starts, ends all logs of their pools (pebble 5.2.3), and `concurrent.futures` has no time limit for a log.
"""

from __future__ import annotations

import gc
import logging
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from icrtool.errors import ConfigError
from icrtool.fleet.one_log import process_log, row_of_failure
from icrtool.logs.containers.recording_files import files_of_log
from icrtool.records.fleet_document import FleetLog
from icrtool.records.process_resources import remove_unfinished
from icrtool.records.requests import LogRequest, decode_request
from icrtool.records.stages import Watch, unwatched

if TYPE_CHECKING:
    from distributed import Client

KILL_GRACE_S = 0.3
"""Time in which a process may remove its unfinished files before it is killed [s]."""

LONGEST_DETAILS = 4000
"""Largest length of the output that is kept of a process that died [characters]."""

ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "MPLBACKEND": "agg",
    "MALLOC_ARENA_MAX": "1", "ARROW_DEFAULT_MEMORY_POOL": "system",
}  # fmt: skip
"""Environment variables of a process. Libraries use one thread, because several logs are processed at the same time.
The settings of the memory are the same as in `icrtool.cli.main`."""

NOT_INHERITED = "MALLOC_TRIM_THRESHOLD_"
"""Environment variable that Dask sets for its workers, and that processes of a batch do not get. With it, glibc returns
memory to the system so often that the system time doubles."""

PROCESS_COMMAND = (sys.executable, "-P", "-m", "icrtool.fleet.processes")
"""Command of a worker process."""

Lines = queue.SimpleQueue[bytes]
"""Queue of lines of text."""

LossReason = Callable[[], str]
"""Function that returns why no more logs can be processed, such as a lost scheduler; empty while they can."""

PROCESS_BYTES = 400 << 20
"""Memory that a process needs for a small log [bytes]."""

LOG_FACTOR, LOG_BYTES = 4.0, 3 << 30
"""Memory that a log needs: `LOG_FACTOR` times its size, at most `LOG_BYTES` [bytes], which 10 h at 100 Hz need."""

_ANSWER: msgspec.json.Decoder[str | FleetLog] = msgspec.json.Decoder(str | FleetLog)
"""Decoder of the answers of a process. It is made at import, because msgspec crashes if several threads use a type for
the first time."""

_over = threading.Event()
"""Set when this process is about to end."""

_all: set[Worker] = set()
"""All worker processes."""

_idle: list[Worker] = []
"""Worker processes that wait for a log. A thread with a log takes one of them, or starts a new process."""


def process_apart(request: bytes, timeout_s: float, watch: Watch = unwatched) -> FleetLog:
    """Return the row of a log, made by a separate process; if this process hangs or dies, the row states the reason.

    Parameters
    ----------
    request : result of `LogRequest.encode`
    timeout_s : time after which the process is killed [s]
    watch : called with the name of each stage, if the caller is on the same machine
    """
    if _over.is_set():
        raise CancelledError
    try:
        worker = _idle.pop()
    except IndexError:
        worker = Worker()
    row = worker.run(decode_request(request), timeout_s, watch)
    if worker in _all:
        _idle.append(worker)
    return row


def end_for_good() -> None:
    """End all worker processes, and start no new ones, because this process is about to end."""
    _over.set()
    close_all()


def close_all() -> None:
    """End all worker processes."""
    _idle.clear()
    for worker in list(_all):
        worker.ask_to_end()
    end_s = time.monotonic() + KILL_GRACE_S
    for worker in list(_all):
        worker.close(max(end_s - time.monotonic(), 0.0))


@contextmanager
def executor_of(
    logs: Sequence[Path], jobs: int | None, scheduler: str | None, worker_timeout_s: float
) -> Iterator[tuple[Executor, LossReason]]:
    """Yield an executor for `process_apart` (threads or a Dask cluster), and a function that returns why it is lost.

    Parameters
    ----------
    logs : paths of all logs of the batch
    jobs : number of logs that are processed at the same time on this machine; None: `default_jobs`
    scheduler : address of the scheduler of a cluster; None: this machine
    worker_timeout_s : time without scheduler or worker after which a cluster is lost [s]

    Raises
    ------
    ConfigError
        The cluster cannot be reached, or Dask is not installed.
    """
    if scheduler is None:
        try:
            with ThreadPoolExecutor(jobs if jobs is not None else default_jobs(logs), "log") as executor:
                yield executor, str
        finally:
            close_all()
        return
    try:
        from distributed import Client
    except ImportError as err:
        raise ConfigError("--scheduler", "needs Dask", "pip install 'icrtool[cluster]'") from err
    for name in ("distributed", "distributed.client", "distributed.utils", "tornado", "asyncio"):
        # These loggers print tracebacks when a scheduler is lost; the rows of the logs state it.
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        client = Client(scheduler, timeout=10)
    except (OSError, ValueError) as err:
        raise ConfigError(f"--scheduler {scheduler}", "no Dask scheduler answers there", str(err)) from err
    with client:
        # Dask's client is closed without waiting for the cluster, because a lost cluster never answers.
        yield client.get_executor(), _loss_reason(client, worker_timeout_s)


def _loss_reason(client: Client, worker_timeout_s: float) -> LossReason:
    """Return a function that returns a reason if a cluster had no scheduler or no worker for `worker_timeout_s`."""
    alive_s, given_up = time.monotonic(), ""

    def lost() -> str:
        nonlocal alive_s, given_up
        if given_up:
            return given_up
        why = "the scheduler of the cluster is gone"
        if client.status == "running":
            with suppress(OSError, TimeoutError):
                workers = client.scheduler_info(n_workers=-1)["workers"]
                why = "" if workers else f"the cluster had no worker for {worker_timeout_s:g} s"
        if not why:
            alive_s = time.monotonic()
        elif client.status == "closed" or time.monotonic() - alive_s > worker_timeout_s:
            given_up = why
        return given_up

    return lost


def default_jobs(logs: Sequence[Path]) -> int:
    """Return the number of logs to process at the same time: at most the cores, the logs, and what the memory holds.

    The memory is divided by the need of the largest log.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    sizes = [sum(file.stat().st_size for file in files_of_log(log) if file.is_file()) for log in logs]
    largest = max(sizes, default=0)
    each = PROCESS_BYTES + min(LOG_FACTOR * largest, LOG_BYTES)
    free = _free_bytes()
    return max(1, min(cores, len(logs), int(free // each) if free is not None else cores))


def _free_bytes() -> int | None:
    """Return the memory that is free for processes [bytes]; None where the system does not state it."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        return None


class Worker:
    """A worker process, which processes one log at a time."""

    def __init__(self) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        home = str(Path(__file__).resolve().parents[2])
        paths = os.pathsep.join(filter(None, [home, os.environ.get("PYTHONPATH")]))
        inherited = {name: value for name, value in os.environ.items() if name != NOT_INHERITED}
        # The process has its own session, so that Ctrl-C reaches only the command, which then ends its workers.
        self._process = subprocess.Popen(  # noqa: S603 - our own command
            PROCESS_COMMAND,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors,
            env={**inherited, **ENVIRONMENT, "PYTHONPATH": paths}, start_new_session=True,
        )  # fmt: skip
        assert self._process.stdin is not None  # noqa: S101 - for the type checker
        assert self._process.stdout is not None  # noqa: S101 - as above
        self._requests = self._process.stdin
        # An empty line, which is no answer, marks the end of the output.
        self._answers = _queue_lines(self._process.stdout, lambda lines: lines.put(b""))
        _all.add(self)

    def run(self, request: LogRequest, timeout_s: float, watch: Watch) -> FleetLog:
        """Return the row of a log that this process makes; arguments as in `process_apart`."""
        begun, begin_of_errors = time.monotonic(), self._errors.seek(0, os.SEEK_END)
        why = details = ""
        try:
            self._requests.write(request.encode() + b"\n")
            self._requests.flush()
            while True:
                left_s = begun + timeout_s - time.monotonic()
                answer = _ANSWER.decode(self._answers.get(timeout=max(left_s, 0.0)))
                if isinstance(answer, FleetLog):
                    return answer
                watch(answer)
        except queue.Empty:
            why = f"took longer than {timeout_s:g} s and was ended"
        except (OSError, ValueError):
            # The process died, perhaps in the middle of a line.
            why = self._end_reason()
            # After an interruption of the batch, the file with the output is closed.
            with suppress(ValueError):
                self._errors.seek(begin_of_errors)
                details = self._errors.read().decode(errors="replace").strip()[-LONGEST_DETAILS:]
            why += f": {details.splitlines()[-1]}" if details else ""
        self.close()
        took_s = round(time.monotonic() - begun, 3)
        return replace(row_of_failure(request, why, details=details, repeatable=False), took_s=took_s)

    def ask_to_end(self) -> None:
        """Close the input of the process, which then removes its unfinished files and ends."""
        # The process may have ended already.
        with suppress(OSError):
            self._requests.close()

    def close(self, grace_s: float = KILL_GRACE_S) -> None:
        """End the process; kill it if it has not ended after `grace_s`."""
        _all.discard(self)
        self.ask_to_end()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(grace_s)
        self._process.kill()
        self._process.wait()
        self._errors.close()

    def _end_reason(self) -> str:
        """Return a text about how the process ended: by its exit status, or by a signal."""
        try:
            status = self._process.wait(10)
        except subprocess.TimeoutExpired:
            return "its process closed its output and did not end"
        if status >= 0:
            return f"its process ended with exit status {status}"
        name = signal.Signals(-status).name
        return f"its process was ended by {name}{', perhaps for lack of memory' if name == 'SIGKILL' else ''}"


def _queue_lines(stream: IO[bytes], at_end: Callable[[Lines], object]) -> Lines:
    """Return a queue that a new thread fills with the lines of a stream; after the last one it calls `at_end`."""
    lines: Lines = queue.SimpleQueue()

    def read() -> None:
        with stream:
            for line in stream:
                lines.put(line)
        at_end(lines)

    threading.Thread(target=read, daemon=True).start()
    return lines


def main() -> None:
    """Process the logs of the requests on standard input, until it ends."""
    # Output of libraries goes to standard error. Standard input and output are opened again, because a thread that
    # waits for a line locks Python's standard input.
    requests, output = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.set_threshold(100_000)

    def send(answer: str | FleetLog) -> None:
        output.write(msgspec.json.encode(answer) + b"\n")
        output.flush()

    def end(_: Lines) -> None:
        # The parent process has ended, or ends this process, perhaps in the middle of a log.
        remove_unfinished()
        os._exit(1)

    lines = _queue_lines(requests, end)
    while True:
        send(process_log(decode_request(lines.get()), send))


if __name__ == "__main__":
    main()
