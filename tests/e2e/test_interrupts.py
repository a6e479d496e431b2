"""Ctrl-C and a kill in the middle of an import, of compiled code and of what the interpreter does by itself."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no thread watches the time there")

LOADING = """
import os, signal, sys, time
os.kill(os.getpid(), int(os.environ["SIGNAL"]))
time.sleep(float(os.environ["REST_S"]))
print("loaded", flush=True)
"""

COMMAND = """
import signal, sys
from pathlib import Path
from icrtool.cli import exit_on_signals
from icrtool.records.process_resources import unfinished

def command():
    half = Path(sys.argv[1])
    with unfinished(half):
        half.write_text("half")
        import loading
        signal.pause()

with exit_on_signals():
    command()
"""


def load(folder: Path, number: int, rest_s: float, before: str = "") -> tuple[int, list[str]]:
    """Load a module that gets a signal and goes on for some time; return the exit status and what was printed."""
    (folder / "loading.py").write_text(LOADING)
    path = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "SIGNAL": str(int(number)), "REST_S": str(rest_s)}
    line = [sys.executable, "-c", before + COMMAND, str(folder / "half")]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == ("Aborted!\n" if done.returncode == 130 else "")
    return done.returncode, done.stdout.split()


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_in_an_import_ends_the_process_soon_and_leaves_nothing(
    tmp_path: Path, number: int, status: int
) -> None:
    assert load(tmp_path, number, rest_s=30.0) == (status, [])
    assert not (tmp_path / "half").exists()


def test_what_was_ignored_stays_ignored(tmp_path: Path) -> None:
    before = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); signal.pause = lambda: None\n"
    assert load(tmp_path, signal.SIGINT, 0.0, before=before) == (0, ["loaded"])


UNDISTURBED = """
import os, signal, sys, time
from icrtool.cli import exit_on_signals
from icrtool.records.process_resources import undisturbed

with exit_on_signals():
    with undisturbed():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)
        print("whole", flush=True)
    time.sleep(60)
"""


def test_a_signal_waits_for_the_end_of_a_block_that_it_must_not_disturb() -> None:
    done = subprocess.run([sys.executable, "-c", UNDISTURBED], capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "whole\n", "Aborted!\n")


COMPUTING = """
import hashlib, os, signal, sys, threading
from pathlib import Path
from icrtool.cli import exit_on_signals
from icrtool.records.process_resources import unfinished

def command():
    folder = Path(sys.argv[1])
    with unfinished(folder):
        folder.mkdir()
        (folder / "file").write_text("half")
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM)).start()
        hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)  # minutes of compiled code that looks for no signal

with exit_on_signals():
    command()
"""


def test_compiled_code_that_looks_for_no_signal_is_ended_and_leaves_nothing(tmp_path: Path) -> None:
    begin = time.monotonic()
    command = [sys.executable, "-c", COMPUTING, str(tmp_path / "half")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (143, "", "")
    assert not (tmp_path / "half").exists()
    assert time.monotonic() - begin < 10


AT_THE_END = """
import hashlib, os, signal, sys, threading
from icrtool.cli import exit_on_signals

def compute():
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)

def command():
    threading.Thread(target=compute).start()
    os.kill(os.getpid(), signal.SIGTERM)
    signal.pause()

with exit_on_signals():
    command()
"""


def test_a_thread_that_computes_does_not_hold_up_the_end() -> None:
    """The interpreter waits for its threads when it ends."""
    begin = time.monotonic()
    done = subprocess.run([sys.executable, "-c", AT_THE_END], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (143, "", "")
    assert time.monotonic() - begin < 10


IN_A_CALLBACK = """
import os, signal, time, weakref
from icrtool.cli import exit_on_signals

def gone(_):
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)

def command():
    thing = type("Thing", (), {})()
    reference = weakref.ref(thing, gone)
    del thing
    time.sleep(60)

with exit_on_signals():
    command()
"""


def test_a_signal_whose_exception_the_interpreter_loses_ends_the_process_too() -> None:
    begin = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", IN_A_CALLBACK], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "Aborted!\n")
    assert time.monotonic() - begin < 10
