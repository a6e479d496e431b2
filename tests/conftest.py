from __future__ import annotations

import gc
import os
import signal
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import settings

# Threads of OpenBLAS wait in a loop for the next matrix: an eighth to a fifth of the CPU time of the tests. NumPy reads
# this when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# How long an example takes depends on what else the machine does.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


def pytest_collection_finish() -> None:
    """Leave what was collected out of the search for cycles, each of which would go through a million objects."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def interrupts_arrive() -> None:
    """A shell starts what runs in the background with SIGINT ignored, nohup with SIGHUP: processes inherit that."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    hang_up = getattr(signal, "SIGHUP", None)
    if hang_up is not None and signal.getsignal(hang_up) is signal.SIG_IGN:
        signal.signal(hang_up, signal.SIG_DFL)


SHORT_DRIVE = (
    "--path", "lawnmower", "--speed", "0.8", "--duration", "90", "--wheel-rate", "20", "--heading-rate", "20",
    "--gnss-rate", "5",
)  # fmt: skip
"""Options of `icrtool simulate`: all rows of a report, and a tenth of the messages of a sample log."""


def simulate_short_drive(log: Path, robot: str, seed: int) -> Path:
    from icrtool.cli.simulate import simulate_command

    words = ("-o", str(log), "--robot", robot, "--seed", str(seed), "-q", *SHORT_DRIVE)
    done = CliRunner().invoke(simulate_command, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return log


@pytest.fixture(scope="session")
def short_logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with short drives of a husky-a200: field.mcap, other.bag and the directory third with third.db3."""
    folder = tmp_path_factory.mktemp("short_logs")
    for seed, log in enumerate(("field.mcap", "other.bag", "third"), start=1):
        simulate_short_drive(folder / log, "husky-a200", seed)
    return folder


@pytest.fixture(scope="session")
def short_segway_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short drive of a segway-rmp400, which has the wheels of the sample log."""
    return simulate_short_drive(tmp_path_factory.mktemp("segway") / "drive.mcap", "segway-rmp400", 1)


@pytest.fixture(scope="session")
def shared_logs() -> Path:
    """The folder of recorded and simulated logs that stands beside the checkout, where there is one."""
    logs = Path(__file__).resolve().parents[2] / "shared" / "logs"
    if not logs.is_dir():
        pytest.skip("shared logs not present: tests on them need the folder shared/logs beside the checkout")
    return logs
