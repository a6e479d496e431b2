"""`icrtool simulate` as a user runs it: files, words, exit status."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from click.testing import CliRunner

from icrtool.cli import main
from icrtool.cli.simulate import simulate_command as command

SHORT = ("--duration", "3")


@pytest.fixture
def run_in(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
    """Run a command in a directory, in this process."""

    def run(directory: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
        monkeypatch.chdir(directory)
        line = ["icrtool", *map(str, arguments)]
        monkeypatch.setattr(sys, "argv", line)
        with pytest.raises(SystemExit) as left:
            main()
        return subprocess.CompletedProcess(line, int(left.value.code or 0), *capfd.readouterr())

    return run


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path):
    """Run a command that must fail, in this process; return its exit status and what it said on stderr."""

    def run(*arguments: object) -> tuple[int, str]:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["icrtool", "simulate", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        said = capfd.readouterr()
        assert said.out == ""
        return int(left.value.code or 0), said.err

    return run


def test_terrain_changes_that_are_given_stand_in_table_and_run(run_in, tmp_path: Path) -> None:
    made = run_in(
        tmp_path, "simulate", "-o", "drive.mcap", "--robot", "segway-rmp400", "--icrs", "0.63,-0.76,0.06",
        "--change", "60:0.85,-1.0,0", "--path", "figure-eight", "--duration", 120, "--wheel-rate", 20,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    asked = ("--terrain-change", "60", "--plots", "none", "-o", "run")
    fitted = run_in(tmp_path, "fit", "drive.mcap", "--robot", "segway-rmp400", *asked)
    assert fitted.returncode == 0, fitted.stderr
    assert all(len(line) <= 100 for line in fitted.stdout.splitlines())
    segments = json.loads((tmp_path / "run" / "run.json").read_text())["segments"]
    assert [segment["begin_s"] for segment in segments] == [0.0, 60.0]
    assert segments[1]["mean"]["y_icr_right_m"] == pytest.approx(0.85, abs=0.05)
    refused = run_in(tmp_path, "fit", "drive.mcap", "--terrain-change", "soon")
    assert refused.returncode == 2
    assert "--terrain-change" in refused.stderr


def test_a_simulated_log_is_fitted_like_any_other(run_in, tmp_path: Path) -> None:
    made = run_in(tmp_path, "simulate", "-o", "drive.mcap", "--robot", "husky-a200", "--duration", 60, "--gnss", "waas")
    assert made.returncode == 0, made.stderr
    assert made.stderr == ""
    assert "husky-a200, b = 0.555 m" in made.stdout
    assert "y right +0.416, y left -0.416, x +0.000 m" in made.stdout
    assert made.stdout.endswith("written to drive.mcap, truth to drive.mcap.truth.csv\n")
    fitted = run_in(tmp_path, "fit", "drive.mcap", "--robot", "husky-a200", "--plots", "none")
    assert fitted.returncode == 0, fitted.stderr
    states = pd.read_csv(tmp_path / "icrtool-runs" / "drive" / "states.csv")
    truth = pd.read_csv(tmp_path / "drive.mcap.truth.csv")
    assert set(states.stamp_ns) <= set(truth.stamp_ns)


@pytest.mark.parametrize("log", ["drive.mcap", "drive.bag", "drive"])
def test_the_same_seed_gives_the_same_bytes(tmp_path: Path, log: str) -> None:
    for folder, seed in (("a", 7), ("b", 7), ("c", 8)):
        (tmp_path / folder).mkdir()
        done = CliRunner().invoke(command, ["-o", str(tmp_path / folder / log), *SHORT, "--seed", str(seed)])
        assert done.exit_code == 0, done.output

    def files(folder: str) -> dict[str, bytes]:
        root = tmp_path / folder
        return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}

    assert files("a") == files("b")
    assert files("a") != files("c")
    assert f"{log}.truth.csv" in files("a")


def test_a_log_that_is_there_is_kept_unless_forced(refused, tmp_path: Path) -> None:
    assert CliRunner().invoke(command, ["-o", str(tmp_path / "a.bag"), *SHORT]).exit_code == 0
    before = (tmp_path / "a.bag").read_bytes()
    assert refused("-o", "a.bag", *SHORT, "--seed", 1) == (
        1,
        "Error: a.bag: exists already; --force replaces it\n",
    )
    assert (tmp_path / "a.bag").read_bytes() == before
    forced = CliRunner().invoke(command, ["-o", str(tmp_path / "a.bag"), *SHORT, "--seed", "1", "--force"])
    assert forced.exit_code == 0
    assert (tmp_path / "a.bag").read_bytes() != before


def test_a_bag_directory_is_replaced_when_forced(tmp_path: Path) -> None:
    for seed in ("0", "1"):
        done = CliRunner().invoke(command, ["-o", str(tmp_path / "run"), *SHORT, "--seed", seed, "--force"])
        assert done.exit_code == 0, done.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run.truth.csv"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--icrs", "-0.5,0.5,0"), "icrs: y_icr_right -0.5 is not right of y_icr_left 0.5; y is positive to the right"),
        (("--path", "lawnmower", "--radius", "0"), "radius: a lawnmower path has no bends of radius 0"),
        (("--duration", "0.01"), "duration: 0.01 s holds fewer than two samples"),
        (("--set", "robot.track_width_m=0.5"), "robot.wheel_radius_m: is not set, and a simulation needs it"),
        (("--robot", "tank"), "robot 'tank': not a built-in robot"),
        (("--speeds", "nothing.csv"), "nothing.csv: cannot be read; No such file or directory"),
        (("--change", "9:0.5,-0.5,0", "--change", "3:0.4,-0.4,0"), "change: the times 9, 3 do not increase"),
    ],
)
def test_what_cannot_be_simulated_is_said_in_one_line(refused, tmp_path: Path, arguments, words: str) -> None:
    status, said = refused("-o", "a.mcap", *arguments)
    assert status == 1
    assert said.startswith(f"Error: {words}")
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_bare_db3_is_refused(refused) -> None:
    assert refused("-o", "a.db3")[1].startswith(
        "Error: a.db3: no log of suffix .db3 can be written; name a file .mcap or .bag"
    )


def test_a_folder_that_is_not_there_is_said(refused) -> None:
    assert refused("-o", "nowhere/a.mcap", *SHORT) == (
        1,
        "Error: nowhere/a.mcap: cannot be written; No such file or directory\n",
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--icrs", "1,2"), "'1,2' is not of the form YR,YL,X"),
        (("--icrs", "1,2,x"), "'1,2,x' is not of the form YR,YL,X"),
        (("--icrs", "1,2,nan"), "is not of the form YR,YL,X"),
        (("--change", "5,1,2,3"), "is not of the form T:YR,YL,X"),
        (("--outage", "20:10"), "'20:10' ends before it begins"),
        (("--gnss", "good"), "'good' is not of the form rtk, waas or METRES"),
        (("--gnss", "-1"), "'-1' is a negative noise"),
        (("--antenna", "1"), "'1' is not of the form FORWARD,RIGHT"),
        (("--speed", "0"), "0.0 is not in the range x>0"),
        ((), "Missing option '-o'"),
    ],
)
def test_wrong_usage_is_status_2(refused, arguments, words: str) -> None:
    status, said = refused(*(() if not arguments else ("-o", "a.mcap", *arguments)))
    assert status == 2
    assert words in said


def test_every_option_has_help() -> None:
    assert [option.name for option in command.params if not getattr(option, "help", None)] == []


def test_quiet_prints_nothing_and_verbose_says_more(tmp_path: Path) -> None:
    quiet = CliRunner().invoke(command, ["-o", str(tmp_path / "a.mcap"), *SHORT, "-q"])
    assert (quiet.exit_code, quiet.output) == (0, "")
    verbose = CliRunner().invoke(command, ["-o", str(tmp_path / "b.mcap"), *SHORT, "-v", "--change", "1:0.5,-0.4,0.1"])
    assert "from 1 s on +0.500, -0.400, +0.100 m" in verbose.stdout
    assert "sensors: Sensors(" in verbose.stderr


def test_a_change_after_the_end_and_a_time_that_is_none_are_wrong_usage(icrtool) -> None:
    status, _, err = icrtool("simulate", "-o", "a.mcap", "--duration", "20", "--change", "40:1,-1,0")
    assert status == 2
    assert "--change: 40 s is after the end of the drive, which lasts 20 s" in err
    short = ("study", "icr-change", "--duration", "100", "--runs", "1")
    status, _, err = icrtool(*short, "--change", "175:1,-1,0")
    assert status == 2
    assert "--change: 175 s is after the end of the drive, which lasts 100 s" in err
    status, _, err = icrtool(*short)
    assert status == 1
    assert err.startswith("Error: duration: 100 s end before the first change, at 175 s; drive longer")
    status, _, err = icrtool("fit", "a.mcap", "--terrain-change", "soon")
    assert status == 2
    assert "--terrain-change" in err


def test_speeds_whose_unit_the_reference_tells_are_in_metres_a_second(icrtool) -> None:
    robot = ("--robot", "husky-a200")
    options = ("--duration", "60", "--path", "lawnmower", "--wheel-messages", "float64_pair")
    icrtool("simulate", "-o", "a.mcap", *robot, *options, "-q")
    assert "; speed in m/s (by the position reference)" in icrtool("info", "a.mcap", *robot)[1]
