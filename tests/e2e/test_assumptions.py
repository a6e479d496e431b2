"""What a log does not say and the tool takes for granted is said, and can be set."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

SAMPLES = Path(__file__).resolve().parents[2] / "sample_logs"
MOWER = SAMPLES / "wheeled_lawnmower.mcap"
ROBOT = ("--robot", "segway-rmp400")
QUIET = ("--plots", "none")


def separation(run: Path) -> float:
    final = json.loads((run / "run.json").read_text())["icr"]["final"]
    return final["y_icr_right_m"] - final["y_icr_left_m"]


def test_a_body_twist_is_undone_with_the_width_it_was_made_with(icrtool, tmp_path: Path) -> None:
    drive = ("--path", "figure-eight", "--wheel-messages", "twist_stamped", "--duration", "90", "--wheel-rate", "20")
    assert icrtool("simulate", "-o", "eight.mcap", *ROBOT, *drive, "-q")[0] == 0
    fit = ("fit", "eight.mcap", *ROBOT, *QUIET)
    _, _, said = icrtool(*fit, "-o", tmp_path / "right")
    assert "0.61 m (robot.track_width_m)" in said
    _, _, said = icrtool(*fit, "--set", "robot.track_width_m=0.4", "-o", tmp_path / "wrong")
    assert "with 0.4 m" in said
    told = ("--set", "robot.track_width_m=0.4", "--set", "wheels.twist_width_m=0.61")
    _, _, said = icrtool(*fit, *told, "-o", tmp_path / "told")
    assert "twist" not in said
    assert separation(tmp_path / "told") == pytest.approx(separation(tmp_path / "right"), abs=0.02)
    assert separation(tmp_path / "wrong") < 0.8 * separation(tmp_path / "right")


def test_a_wheel_radius_that_had_to_be_estimated_is_said(icrtool, tmp_path: Path) -> None:
    _, _, said = icrtool("fit", MOWER, *QUIET, "-o", tmp_path / "run")
    assert "robot.wheel_radius_m is not given: wheel radius 0.27" in said


@pytest.mark.parametrize("setting", ["wheel_radius_m=27", "track_width_m=61"])
def test_centimetres_are_refused(icrtool, setting: str) -> None:
    status, _, said = icrtool("fit", MOWER, *ROBOT, "--set", f"robot.{setting}")
    assert status == 1
    assert said.startswith(f"Error: robot.{setting.partition('=')[0]}: expected a number ≥ 0.0")


def test_a_warm_start_from_another_robot_is_said(icrtool, short_logs: Path, tmp_path: Path) -> None:
    fit = ("fit", short_logs / "field.mcap", "--robot", "husky-a200", *QUIET)
    icrtool(*fit, "-o", tmp_path / "first")
    again = (*fit, "--warm-start", tmp_path / "first")
    _, _, said = icrtool(*again, "-o", tmp_path / "same")
    assert "track width" not in said
    _, _, said = icrtool(*again, "--set", "robot.track_width_m=0.8", "-o", tmp_path / "other")
    assert "made with a track width of 0.555 m, not 0.8 m" in said
    _, _, said = icrtool(*again, "--set", "robot.track_width_m=0.8", "-o", tmp_path / "first", "--overwrite")
    assert "made with a track width of 0.555 m, not 0.8 m" in said
