"""`icrtool study` as a user runs it: files, words, exit status."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from icrtool.cli import main
from icrtool.cli.simulate import study_command as command

ROOT = Path(__file__).resolve().parents[2]
SMALL = ("--runs", "2", "--duration", "5", "--plots", "none")


def study(*arguments: object) -> str:
    done = CliRunner().invoke(command, list(map(str, arguments)), catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert done.stderr == ""
    return done.stdout


def settings(directory: Path) -> dict:
    return json.loads((directory / "study.json").read_text(encoding="utf-8"))["settings"]


def test_a_study_prints_a_table_and_writes_its_directory(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error:::icrtool"}
    line = [sys.executable, "-m", "icrtool", "study", "rate", "--runs", "2", "--duration", "5"]
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("rate: whether logs of any rate give the same ICRs\n2 runs of 5 s each, seed 0;")
    assert done.stdout.endswith("written to icrtool-runs/study-rate\n")
    made = tmp_path / "icrtool-runs" / "study-rate"
    assert sorted(path.name for path in made.iterdir()) == ["rate.csv", "rate.png", "study.json"]


def test_the_same_seed_gives_the_same_study(tmp_path: Path) -> None:
    for folder, seed in (("a", 3), ("b", 3), ("c", 4)):
        study("input-noise", "-o", tmp_path / folder, *SMALL, "--values", "0.1", "--seed", seed)
    a, b, c = ((tmp_path / folder / "input-noise.csv").read_bytes() for folder in "abc")
    assert a == b
    assert a != c


def test_options_put_ones_own_robot_and_sensors_in(tmp_path: Path) -> None:
    study(
        "convergence", "-o", tmp_path / "own", *SMALL, "--robot", "husky-a200", "--path", "spins",
        "--wheels", "encoder",
        "--gnss", "waas", "--heading-std", 2, "--rate", 50, "--preset", "field", "--speed", 0.6, "--input-noise", 0.01,
    )  # fmt: skip
    told = settings(tmp_path / "own")
    assert told["drive"]["icrs_m"] == pytest.approx([0.41625, -0.41625, 0.0])
    assert (told["paths"], told["presets"]) == (["spins"], ["field"])
    assert told["drive"]["path"]["speed_mps"] == 0.6
    sensors = told["sensors"]
    assert (sensors["wheels"], sensors["gnss_std_m"], sensors["wheel_rate_hz"]) == ("encoder", 0.3, 50.0)
    assert sensors["metres_per_count"] == pytest.approx(2 * 3.141592653589793 * 0.1651 / 8192)
    assert told["config"]["robot"]["name"] == "husky-a200"


def test_left_out_is_the_papers(tmp_path: Path) -> None:
    study("turn-radius", "-o", tmp_path / "paper", "--runs", 1, "--duration", 25, "--values", "0,1", "--plots", "none")
    told = settings(tmp_path / "paper")
    assert told["drive"]["icrs_m"] == [0.5, -0.75, -0.25]
    assert told["sensors"]["gnss_std_m"] == 0.01
    assert told["config"]["robot"]["track_width_m"] == 0.51


def test_a_preset_set_in_the_configuration_is_the_one_studied(tmp_path: Path) -> None:
    study("rate", "-o", tmp_path / "set", *SMALL, "--set", "filter.preset=paper", "--values", "50")
    assert settings(tmp_path / "set")["presets"] == ["paper"]


def test_quiet_prints_nothing(tmp_path: Path) -> None:
    assert study("rate", "-o", tmp_path / "a", *SMALL, "--values", "50", "-q") == ""


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("gnss", "--gnss", "waas"), "study gnss varies --gnss; --values V,V,... sets its values"),
        (("rate", "--rate", "50"), "study rate varies --rate"),
        (("consistency", "--values", "1"), "study consistency varies no number, and has no --values"),
        (("nonsense",), "'nonsense' is not one of 'convergence'"),
        (("rate", "--values", "fast"), "'fast' is not of the form V,V,..."),
        (("rate", "--plots", "gif"), "'gif' is not one of png, svg, pdf, none"),
    ],
)
def test_wrong_usage_is_status_2(tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    done = CliRunner().invoke(command, [*arguments, "-o", str(tmp_path / "a")])
    assert done.exit_code == 2
    assert words in " ".join(done.stderr.split())
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_holds_something_else_is_refused_before_any_work(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes").touch()
    monkeypatch.setattr(
        sys, "argv", ["icrtool", "study", "consistency", "-o", str(tmp_path / "mine"), "--runs", "9999"]
    )
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 1
    assert "holds something that is not a study directory" in capfd.readouterr().err


def test_every_option_has_help() -> None:
    assert [one.name for one in command.params if one.name != "name" and not getattr(one, "help", None)] == []


def test_with_ones_own_robot_convergence_is_that_of_the_tools_own_preset(tmp_path: Path) -> None:
    study("convergence", "-o", tmp_path / "own", *SMALL, "--robot", "jackal", "--path", "spins")
    study("convergence", "-o", tmp_path / "paper", *SMALL, "--path", "spins")
    assert settings(tmp_path / "own")["presets"] == ["field"]
    assert settings(tmp_path / "paper")["presets"] == ["paper"]
