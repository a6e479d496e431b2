"""Standard output that is full, closed or no longer read, and Ctrl-C, as a process of its own meets them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

LOG = Path(__file__).resolve().parents[2] / "sample_logs" / "wheeled_lawnmower.mcap"
ROBOT = ("--set", "robot.track_width_m=0.55", "--set", "robot.wheel_radius_m=0.165")
COMMAND = (sys.executable, "-m", "icrtool")

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="/dev/full, and pipes as Linux has them")


def test_a_full_disk_behind_standard_output_is_one_error(short_logs: Path) -> None:
    with Path("/dev/full").open("w") as full:
        command = [*COMMAND, "info", short_logs / "field.mcap", *ROBOT]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    errors = [line for line in done.stderr.splitlines() if not line.startswith("Warning: ")]
    assert errors == ["Error: standard output: cannot be written; No space left on device"]
    assert done.returncode == 1


@pytest.mark.parametrize(("closed", "status"), [(1, 1), (2, 0)])
def test_a_standard_stream_that_was_closed_is_no_traceback(closed: int, status: int) -> None:
    command = [*COMMAND, "robots"]
    shell = ["sh", "-c", f'exec "$@" {closed}>&-', "sh", *command]
    done = subprocess.run(shell, capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stderr
    assert done.stderr in ("", "Error: standard output: cannot be written; Bad file descriptor\n")


def test_a_reader_that_has_enough_stops_nothing(tmp_path: Path, short_logs: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    log, lean = short_logs / "field.mcap", ("--plots", "none", "--no-ladder", "--no-page")
    command = [*COMMAND, "dropout-report", log, *ROBOT, "-o", "run", *lean, "--junit", "a"]
    failing = [*command, "--gate", "icr.p95@10m <= 0.001"]
    done = subprocess.run(failing, cwd=tmp_path, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert all(line.startswith("Warning: ") for line in done.stderr.splitlines())
    assert done.returncode == 3
    assert (tmp_path / "run" / "dropout" / "report.json").is_file()
    assert (tmp_path / "a").is_file()


@pytest.mark.parametrize("module", ["click", "icrtool.logs.read_log"])
def test_ctrl_c_while_modules_are_imported_is_one_line_and_status_130(tmp_path: Path, module: str) -> None:
    (tmp_path / "sitecustomize.py").write_text(
        "import os, signal, sys\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}:\n"
        "            sys.meta_path.remove(self)\n"
        f"            os.kill(os.getpid(), {int(signal.SIGINT)})\n"
        "sys.meta_path.insert(0, Interrupting())\n"
    )
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run([*COMMAND, "info", LOG], env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr.strip()) == (130, "", "Aborted!")


def test_a_command_that_is_killed_by_a_timeout_leaves_nothing_half_written(tmp_path: Path) -> None:
    arguments = ("fit", LOG, "--robot", "segway-rmp400", "-o", tmp_path / "run", "-q")
    with subprocess.Popen([*COMMAND, *map(str, arguments)], stderr=subprocess.PIPE) as process:
        while not list(tmp_path.iterdir()):
            assert process.poll() is None
            time.sleep(0.005)
        process.terminate()
        _, said = process.communicate(timeout=20)
    assert process.returncode == 143
    assert not said
    assert list(tmp_path.iterdir()) == []
