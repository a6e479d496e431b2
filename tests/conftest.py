from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

# Threads of OpenBLAS wait in a loop for the next matrix: an eighth to a fifth of the CPU time of the tests. NumPy reads
# this when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# How long an example takes depends on what else the machine does.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


@pytest.fixture(scope="session", autouse=True)
def interrupts_arrive() -> None:
    """A shell starts what runs in the background with SIGINT ignored; the processes of the tests would inherit that."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shared_logs() -> Path:
    """The folder of recorded and simulated logs that stands beside the checkout, where there is one."""
    logs = Path(__file__).resolve().parents[2] / "shared" / "logs"
    if not logs.is_dir():
        pytest.skip("shared logs not present: tests on them need the folder shared/logs beside the checkout")
    return logs
