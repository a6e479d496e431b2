"""Requests and surroundings that no user means: numbers out of any range, no memory, a closed terminal or input."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

SAMPLES = Path(__file__).resolve().parents[2] / "sample_logs"
MOWER, CURVED = SAMPLES / "wheeled_lawnmower.mcap", SAMPLES / "tracked_curved.bag"
COMMAND = (sys.executable, "-P", "-m", "icrtool")
ROBOT = ("--robot", "segway-rmp400")

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits and signals as Linux has them")


def error_of(said: str) -> str:
    """Return the one line of an error."""
    (line,) = [one for one in said.splitlines() if one.startswith("Error: ")]
    assert "Traceback" not in said
    return line


@pytest.mark.parametrize("setting", ["robot.track_width_m=1e-320", "robot.wheel_radius_m=1e-320"])
def test_a_robot_smaller_than_a_hand_is_refused(icrtool, setting: str) -> None:
    status, _, said = icrtool("fit", MOWER, *ROBOT, "--set", setting, "--plots", "none")
    assert status == 1
    assert "expected a number ≥ 0.0" in error_of(said)


def test_a_thousand_horizons_are_refused_before_the_fit(icrtool, run_place: Path) -> None:
    many = "[" + ", ".join(f"{number / 100}" for number in range(1, 1100)) + "]"
    command = ("dropout-report", MOWER, *ROBOT, "--set", f"dropout.horizons_m={many}", "-o", "run", "--plots", "none")
    status, _, said = icrtool(*command)
    assert status == 1
    assert error_of(said) == "Error: dropout.horizons_m: 1099 numbers; at most 1000 are analysed"
    assert not (run_place / "run").exists()


@pytest.mark.parametrize("bound", ["1e400", "nan", "inf", "1" * 400])
def test_a_limit_of_no_finite_number_is_refused(icrtool, bound: str) -> None:
    gate = f"recommended.p95@10m <= {bound}"
    status, _, said = icrtool("dropout-report", MOWER, *ROBOT, "--gate", gate, "--plots", "none")
    assert status in (1, 2)
    assert "gate" in error_of(said)


@pytest.mark.parametrize("time_s", ["99999", "-5", "1e300"])
def test_a_terrain_change_outside_the_drive_is_named(icrtool, time_s: str) -> None:
    command = ("fit", CURVED, "--robot", "pentzer-tracked", "--terrain-change", time_s, "--plots", "none", "-o", "run")
    status, _, said = icrtool(*command)
    assert status == 0
    assert f"no terrain change at {float(time_s):g} s: the drive lasts 179.0 s" in said


def test_a_wheel_radius_nine_times_too_large_is_no_stand(icrtool) -> None:
    status, said, warned = icrtool("info", MOWER, *ROBOT, "--set", "robot.wheel_radius_m=2.4")
    assert status == 0
    assert "stand" not in said + warned
    assert "the log shows a wheel radius of 0.270 m" in " ".join(warned.split())


def test_a_log_named_as_an_option_is_a_log_behind_two_dashes(icrtool, run_place: Path) -> None:
    (run_place / "--config=cfg.mcap").write_bytes(MOWER.read_bytes())
    status, said, _ = icrtool("info", *ROBOT, "--", "--config=cfg.mcap")
    assert status == 0
    assert "can be fitted" in said


def test_standard_input_that_was_closed_is_one_line() -> None:
    command = ["sh", "-c", 'exec "$@" <&-', "sh", *COMMAND, "info", "-", "-q"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "standard input is closed" in error_of(done.stderr)


@pytest.mark.parametrize("kilobytes", [180_000, 320_000, 345_000, 415_000, 440_000])
def test_too_little_memory_is_one_line(kilobytes: int) -> None:
    command = ["sh", "-c", f'ulimit -v {kilobytes}; exec "$@"', "sh", *COMMAND, "info", str(MOWER), *ROBOT, "-q"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        assert done.returncode == 1, done.stderr
        assert error_of(done.stderr).startswith("Error: memory: the process has reached its limit")


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
def test_a_closed_terminal_ends_a_command_as_sigterm_does(tmp_path: Path, number: signal.Signals) -> None:
    """The signal comes when the handlers are set and no command is known yet: it is the same for all of them.

    At work, commands are interrupted by tests/e2e/test_signals.py, with SIGHUP too.
    """
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\n"
        "class Hanging:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'icrtool.cli.commands':\n"
        "            sys.meta_path.remove(self)\n"
        f"            os.kill(os.getpid(), {int(number)})\n"
        "            import time; time.sleep(60)\n"
        "sys.meta_path.insert(0, Hanging())\n"
    )
    environment = {"PYTHONPATH": str(tmp_path), "PATH": "/usr/bin:/bin", "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-m", "icrtool", "fit", "-", "-o", "run"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=50
    )
    assert done.returncode == 128 + number
    assert done.stderr == ""
    assert [path.name for path in tmp_path.iterdir() if path.name not in {"sitecustomize.py", "__pycache__"}] == []
