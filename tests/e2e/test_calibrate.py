"""`icrtool calibrate` as a user runs it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from icrtool.config import load_config

ROOT = Path(__file__).resolve().parents[2]
LOG = ROOT / "sample_logs" / "wheeled_lawnmower.mcap"
ROBOT, HUSKY = ("--robot", "segway-rmp400"), ("--robot", "husky-a200")
RATES = ("--wheel-rate", "20", "--heading-rate", "20", "--gnss-rate", "5")


@pytest.fixture
def field(short_logs: Path) -> Path:
    return short_logs / "field.mcap"


def test_a_log_is_calibrated_printed_and_written(icrtool, field: Path, tmp_path: Path) -> None:
    status, out, err = icrtool("calibrate", field, *HUSKY, "-o", tmp_path / "calibration.json", "-v")
    assert status == 0, err
    assert "antenna forward − x ICR" in out
    assert "not separable" in out
    document = json.loads((tmp_path / "calibration.json").read_text())
    assert document["schema"] == "icrtool/calibration/1"
    for parameter in document["parameters"].values():
        assert parameter["verdict"] in {"shown", "weak", "not shown", "not separable", "given"}
    assert [path.name for path in tmp_path.iterdir()] == ["calibration.json"]


def test_the_misses_are_drawn_before_and_after(icrtool, field: Path, tmp_path: Path) -> None:
    status, out, err = icrtool("calibrate", field, *HUSKY, "--plot", "misses.png")
    assert (status, err) == (0, "")
    assert "drawn to misses.png" in out
    assert (tmp_path / "misses.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["misses.png"]
    status, _, err = icrtool("calibrate", field, *HUSKY, "--plot", "misses.txt")
    assert status == 1
    assert "not the suffix of a picture" in err


def test_a_picture_that_cannot_be_written_is_one_error(icrtool, field: Path, monkeypatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    for name in ("write_bytes", "replace", "unlink"):
        monkeypatch.setattr(Path, name, refuse)
    status, _, err = icrtool("calibrate", field, *HUSKY, "--plot", "misses.png", "-q")
    assert (status, err) == (1, "Error: misses.png: cannot be written; Read-only file system\n")


def test_a_home_directory_that_cannot_be_written_is_no_matter(tmp_path: Path, field: Path) -> None:
    (tmp_path / "file").touch()
    environment = {**os.environ, "MPLCONFIGDIR": str(tmp_path / "file" / "below"), "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-m", "icrtool", "calibrate", field, *HUSKY, "--plot", tmp_path / "misses.png"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""


def test_a_run_is_calibrated_with_its_configuration(icrtool, field: Path, tmp_path: Path) -> None:
    icrtool("fit", field, *HUSKY, "-o", "run", "--plots", "none", "-q")
    status, by_run, _ = icrtool("calibrate", "run")
    assert status == 0
    assert by_run == icrtool("calibrate", field, *HUSKY)[1]
    status, _, err = icrtool("calibrate", "run", *HUSKY)
    assert status == 1
    assert "keeps its own configuration" in err


def test_settings_can_be_pasted(icrtool, field: Path) -> None:
    wrong = ("--set", "wheels.left_scale=0.97", "--set", "wheels.right_scale=1.0")
    _, out, _ = icrtool("calibrate", field, *HUSKY, *wrong)
    line = next(line for line in out.splitlines() if "--set" in line)
    sets = [word for word in line.split() if word != "--set"]
    assert load_config(sets=sets).wheels.left_scale == pytest.approx(1.0, abs=0.01)


def test_a_known_antenna_is_used(icrtool, field: Path) -> None:
    _, out, _ = icrtool("calibrate", field, *HUSKY, "--set", "frames.antenna_forward_m=0.0", "-v")
    assert "with the antenna as given" in out


@pytest.mark.parametrize("place", ["other.json", "missing/calibration.json"])
def test_nothing_foreign_is_overwritten(icrtool, field: Path, tmp_path: Path, place: str) -> None:
    (tmp_path / "other.json").write_text("{}")
    status, out, err = icrtool("calibrate", field, *HUSKY, "-o", place)
    assert (status, out) == (1, "")
    assert err.startswith("Error: ")
    assert len(err.splitlines()) == 1
    assert (tmp_path / "other.json").read_text() == "{}"


def test_quiet_prints_nothing(icrtool, field: Path) -> None:
    assert icrtool("calibrate", field, *HUSKY, "-q") == (0, "", "")


def test_info_says_what_the_drive_could_show_and_what_to_drive_next(icrtool) -> None:
    status, out, err = icrtool("info", LOG, *ROBOT)
    assert (status, err) == (0, "")
    assert re.search(r"excitation all three ICRs shown.* turned 9\d\d° right, 8\d\d° left", " ".join(out.split()))
    assert re.search(r"heading +/imu/data \(gyro too\): 100 Hz", out)
    assert "gyro\n  -> /imu/data: 20000 turn rates" in icrtool("info", LOG, *ROBOT, "-v")[1]
    icrtool("simulate", "-o", "straight.mcap", "--path", "straight", "--duration", "60", "-q")
    status, out, err = icrtool("info", "straight.mcap", *ROBOT)
    assert status == 0
    assert re.search("y right, y left.* not shown", out)
    assert "two full turns on the spot" in err


def test_several_runs_are_pooled_and_each_is_left_out(icrtool, tmp_path: Path) -> None:
    from icrtool.output.files.formats import open_calibration

    for seed in (1, 2, 3):
        drive = ("--path", "curved", "--duration", "60", "--seed", seed, "-q", *RATES)
        icrtool("simulate", "-o", f"{seed}.mcap", *drive, *ROBOT)
    icrtool("fit", "2.mcap", *ROBOT, "-o", "run", "--plots", "none", "-q")
    status, out, err = icrtool("calibrate", "1.mcap", "3.mcap", *ROBOT, "-o", "cal.json", "-q")
    assert (status, out, err) == (0, "", "")
    status, out, _ = icrtool("calibrate", "1.mcap", "3.mcap", "run", *ROBOT, "-v")
    assert (status, "each log left out in turn (3 logs)" in out) == (0, True)
    status, out, _ = icrtool("calibrate", "1.mcap", "3.mcap", *ROBOT)
    assert len(out.splitlines()) <= 22
    assert "How far within 0.5 m (95 %), each log left out in turn?" in out
    status, _, err = icrtool("calibrate", "run", "run", *ROBOT)
    assert (status, "keeps its own configuration" in err) == (1, True)
    status, out, err = icrtool("calibrate", "1.mcap", "1.mcap", *ROBOT)
    assert (status, "How far within" in out) == (0, True)
    assert "1: left out: a copy of 1" in err
    calibration = open_calibration(tmp_path / "cal.json")
    assert [Path(log.path).name for log in calibration.logs] == ["1.mcap", "3.mcap"]
    assert all(len(log.sha256) == 64 for log in calibration.logs)
    assert {score.log for score in calibration.held_out} == {"1", "3"}
    assert icrtool("calibrate", "1.mcap", "3.mcap", *ROBOT, "--plot", "misses.png")[0] == 2
