"""`icrtool fit` prints its verdict and numbers first, then the gravest warnings; the others by -v."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

SCALES = ("--set", "wheels.left_scale=1", "--set", "wheels.right_scale=1")
WRONG = ("--robot", "husky-a200", *SCALES, "--plots", "none")
"""The robot of the log has wheels of 0.27 m, this one of 0.165 m; a scale that is set is not corrected."""


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory, short_segway_log: Path) -> tuple[list[str], list[str], list[str]]:
    """What is printed of a run with a wrong robot, both streams in one, without and with -v; the run's warnings."""
    place = tmp_path_factory.mktemp("order")
    outputs = []
    for further in ((), ("-v",)):
        command = [sys.executable, "-m", "icrtool", "fit", str(short_segway_log), *WRONG, "-o", "run", *further]
        done = subprocess.run(command, cwd=place, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=True)
        outputs.append(done.stdout.decode().splitlines())
    document = json.loads((place / "run" / "run.json").read_text(encoding="utf-8"))
    return outputs[0], outputs[1], document["warnings"]


def test_the_verdict_is_the_first_line_and_warnings_are_the_last(
    printed: tuple[list[str], list[str], list[str]],
) -> None:
    brief, _, warnings = printed
    assert brief[0].startswith("Do not use: ")
    numbers = next(i for i, line in enumerate(brief) if line.startswith("next  "))
    below = [line for line in brief[numbers + 1 : -1] if not line.startswith(" " * 12)]
    assert all(line.startswith("Warning: ") for line in below)
    assert len(below) == 2
    assert brief[-1] == f"{len(warnings) - 2} more warning{'s' if len(warnings) > 3 else ''}: -v, or run.json"


def test_all_warnings_are_printed_on_request(printed: tuple[list[str], list[str], list[str]]) -> None:
    _, verbose, warnings = printed
    assert [line.removeprefix("Warning: ") for line in verbose if line.startswith("Warning: ")] == warnings
    assert len(warnings) > 2


def test_a_wrong_robot_is_asked_for_with_the_radius_that_the_log_shows(
    printed: tuple[list[str], list[str], list[str]],
) -> None:
    (named,) = (one for one in printed[2] if "is --robot right?" in one)
    assert "the log shows a wheel radius of 0.27" in named
    assert "husky-a200 has 0.165" in named
    # the radius is the first reason and the next step: further turns would not help
    assert re.match("Do not use: the robot goes [0-9]+ % of the distance that the wheels report; ", printed[0][0])
    following = " ".join(line.strip() for line in printed[0] if line.startswith(("next  ", "     ")))
    assert "is --robot right? check wheel radius" in following
    assert not any("two full turns" in line for line in printed[0])


def test_a_usable_run_names_the_command_that_tests_the_distance(icrtool, tmp_path: Path, short_logs: Path) -> None:
    log = short_logs / "field.mcap"
    status, out, _ = icrtool("fit", log, "--robot", "husky-a200", "--plots", "none", "-o", tmp_path / "run")
    assert status == 0
    assert out.splitlines()[-2:] == [
        "distance    without GNSS: not known yet; the next command tests it",
        f"next        icrtool dropout-report {tmp_path / 'run'}",
    ]
    for further in ((), ("-v", "--no-ladder")):
        status, out, _ = icrtool("dropout-report", tmp_path / "run", "--plots", "none", "--no-page", *further)
        assert status == 0
        assert out.count("How far without GNSS?") == 1
