"""What a person sees: the answer in a terminal of 80 columns and 24 lines, nothing scrolls."""

from __future__ import annotations

import csv
import fcntl
import json
import os
import pty
import re
import shlex
import struct
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread

import pytest

from icrtool.cli import main
from icrtool.fleet.processes import process_apart

ROOT = Path(__file__).resolve().parents[2]
ROWS, COLUMNS, MOST_LINES = 24, 80, 22
ROBOT = ("--robot", "segway-rmp400")
LEAN = ("--plots", "none", "--no-page", "--no-ladder")
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")

Screen = Callable[..., tuple[int, list[str]]]


@contextmanager
def terminal(columns: int) -> Iterator[Callable[[], bytes]]:
    """Give this process a terminal for its three streams; give what ends it and returns all that was written to it."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, columns, 0, 0))
    shown: list[bytes] = []

    def read() -> None:
        # the terminal of a stream that was closed gives an error
        with suppress(OSError):
            while part := os.read(leader, 1 << 16):
                shown.append(part)

    reader = Thread(target=read)
    kept, streams = [os.dup(one) for one in range(3)], (sys.stdin, sys.stdout, sys.stderr)
    for one in range(3):
        os.dup2(follower, one)
    os.close(follower)
    sys.stdin, sys.stdout, sys.stderr = (
        open(one, mode, closefd=False)  # noqa: SIM115 - closed with the terminal
        for one, mode in enumerate("rww")
    )
    reader.start()

    def end() -> bytes:
        if kept:
            for one in (sys.stdout, sys.stderr):
                one.flush()
            sys.stdin, sys.stdout, sys.stderr = streams
            for one in range(3):
                os.dup2(kept[one], one)
                os.close(kept[one])
            kept.clear()
            reader.join()
            os.close(leader)
        return b"".join(shown)

    try:
        yield end
    finally:
        end()


@pytest.fixture
def screen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Screen:
    """Run a command in a terminal; give its status and the lines that stay on it, standard error among them."""
    monkeypatch.chdir(tmp_path)
    for name, value in {"TERM": "xterm", "COLUMNS": "", "LINES": ""}.items():
        monkeypatch.setenv(name, value)

    def run(*arguments: object, columns: int = COLUMNS) -> tuple[int, list[str]]:
        monkeypatch.setattr(sys, "argv", ["icrtool", *map(str, arguments)])
        status = 0
        with terminal(columns) as end:
            try:
                main()
            except SystemExit as left:
                status = int(left.code or 0)
            text = CONTROL.sub("", end().decode())
        # a line that is rewritten leaves its last state
        lines = [line.rstrip("\r").rpartition("\r")[2].rstrip() for line in text.split("\n")]
        while lines and not lines[-1]:
            lines.pop()
        return status, lines

    return run


def check_fits(lines: list[str]) -> None:
    assert len(lines) <= MOST_LINES, "\n".join(lines)
    assert max(map(len, lines)) <= COLUMNS, "\n".join(lines)


@pytest.mark.usefixtures("without_drawing")
def test_a_good_drive_is_answered_on_one_screen(screen: Screen, short_segway_log: Path) -> None:
    status, lines = screen("fit", short_segway_log, *ROBOT, "--plots", "none")
    check_fits(lines)
    text = "\n".join(lines)
    assert status == 0
    assert any(line.startswith("USABLE") for line in lines)
    found = re.search(
        r"wheel_separation_multiplier +([\d.]+) ±.*right ([+-][\d.]+) ±.*left ([+-][\d.]+) ±", text, re.DOTALL
    )
    assert found is not None
    multiplier, right, left = map(float, found.groups())
    assert (right - left) / 0.61 == pytest.approx(multiplier, abs=2e-3)
    status, lines = screen("dropout-report", "--plots", "none")
    check_fits(lines)
    text = "\n".join(lines)
    assert status == 0
    for question in ("within 0.5 m (95 %)", "controller  ", "recommended  ", "Trust?", "Worst", "20 m"):
        assert question in text
    assert lines[-1].endswith("report.html")


@pytest.mark.parametrize("times_s", [(100,), (60, 120, 180)])
def test_the_stretches_of_a_drive_on_several_grounds_are_whole(screen: Screen, times_s: tuple[int, ...]) -> None:
    # half the separation of the ICRs is 0.3 m or 0.45 m by turns
    icrs = ("0.3,-0.3,0.05", "0.45,-0.45,0.05")
    changes = [word for place, at_s in enumerate(times_s) for word in ("--change", f"{at_s}:{icrs[place % 2]}")]
    rates = ("--wheel-rate", "50", "--heading-rate", "50")
    assert screen("simulate", "-o", "grounds.mcap", "--duration", "240", "-q", *ROBOT, *rates, *changes)[0] == 0
    status, lines = screen("fit", "grounds.mcap", *ROBOT, "--plots", "none")
    # the next command is one line, however long
    check_fits([line[:COLUMNS] if line.startswith("next ") else line for line in lines])
    assert status == 0
    assert "PARTLY      the ground changes: no single multiplier fits the whole drive" in lines
    first = next(number for number, line in enumerate(lines) if line.startswith("multiplier "))
    row = "".join(lines[first : first + 3])
    found = re.findall(r"(\d+) to (\d+) s: (\d\.\d{3}) ± (0\.\d{3})", row)
    assert len(found) == len(times_s) + 1
    for begin_s, at_s in zip([int(one[0]) for one in found[1:]], times_s, strict=True):
        assert abs(begin_s - at_s) < 10
    for place, (_, _, multiplier, _) in enumerate(found[1:]):
        assert float(multiplier) == pytest.approx((0.6, 0.9)[place % 2] / 0.61, rel=0.03)
    assert len({one[2] for one in found}) == len(found)
    assert not any(line.endswith("…") for line in lines[: first + 3])


def test_a_drive_that_shows_too_little_says_what_to_drive(screen: Screen) -> None:
    straight = ("--path", "straight", "--duration", "60", "-q")
    assert screen("simulate", "-o", "straight.mcap", *straight)[0] == 0
    status, lines = screen("fit", "straight.mcap", *ROBOT, "--plots", "none")
    check_fits(lines)
    assert status == 0
    assert lines[0].startswith("Do not use: ")
    assert "two full turns" in " ".join(lines)
    assert "wheel_separation_multiplier" not in " ".join(lines)
    status, lines = screen("dropout-report", "--plots", "none", "--no-page")
    check_fits(lines)
    assert (status, lines[0][:11]) == (0, "Do not use:")
    assert "How far within" not in " ".join(lines)
    assert "two full turns on the spot to the right and two to the left" in " ".join(" ".join(lines).split())


def test_a_drive_with_turns_to_one_side_names_the_other(screen: Screen) -> None:
    assert screen("simulate", "-o", "circle.mcap", "--path", "circle", "--duration", "60", "-q", *ROBOT)[0] == 0
    status, lines = screen("fit", "circle.mcap", *ROBOT, "--plots", "none")
    check_fits(lines)
    assert status == 0
    first = next(number for number, line in enumerate(lines) if "excitation" in line)
    row = " ".join(" ".join(lines[first : first + 2]).split())
    assert re.fullmatch("! excitation y right.* weak: drive two full turns on the spot, or circles, to the left", row)


def test_a_short_drive_states_why_the_recommended_model_is_left_out(screen: Screen) -> None:
    assert screen("simulate", "-o", "short.mcap", "--path", "curved", "--duration", "40", "-q", *ROBOT)[0] == 0
    status, lines = screen("dropout-report", "short.mcap", *ROBOT, "--plots", "none", "--no-page")
    check_fits(lines)
    assert status == 0
    assert any(line.startswith("left out    recommended, controller: ") for line in lines), "\n".join(lines)


def test_without_a_track_width_no_slip_is_not_known(screen: Screen) -> None:
    log = ROOT / "sample_logs" / "tracked_curved.bag"
    status, lines = screen("dropout-report", log, "--plots", "none", "--no-page")
    check_fits(lines)
    text = " ".join(" ".join(lines).split())
    assert status == 0
    assert re.search(r"no_slip not known needs --robot", text)


def test_all_is_printed_on_request_and_a_narrow_terminal_loses_no_column_without_notice(screen: Screen) -> None:
    rates = ("--wheel-rate", "20", "--heading-rate", "20", "--gnss-rate", "5")
    assert screen("simulate", "-o", "log.mcap", "--path", "curved", "--duration", "80", "-q", *ROBOT, *rates)[0] == 0
    _, brief = screen("dropout-report", "log.mcap", *ROBOT, *LEAN)
    check_fits(brief)
    full, lines = (screen("dropout-report", *LEAN, "-v", columns=columns)[1] for columns in (COLUMNS, 60))
    assert len(full) > 2 * len(brief)
    text = " ".join(" ".join(lines).split())
    assert "left out: the terminal has 60 columns" in text
    assert "…" not in "".join(line for line in lines if "%" in line)


def test_a_log_is_described_on_one_screen(screen: Screen, tmp_path: Path) -> None:
    log = Path("drive.mcap")
    (tmp_path / log).symlink_to(ROOT / "sample_logs" / "wheeled_lawnmower.mcap")
    status, lines = screen("info", log, *ROBOT)
    check_fits(lines)
    assert (status, lines[0]) == (0, "verdict     can be fitted, all ICRs are shown")
    text = "\n".join(lines)
    for topic in ("/joint_states", "/gps/fix", "/imu/data"):
        assert text.count(topic) == 1
    assert text.endswith("icrtool report drive.mcap --robot segway-rmp400")
    assert len(screen("info", log, *ROBOT, "-v")[1]) > MOST_LINES


def test_a_log_that_cannot_be_fitted_says_so_first(screen: Screen) -> None:
    status, lines = screen("info", ROOT / "sample_logs" / "wheeled_figure_eight")
    check_fits([line for line in lines if not line.startswith("Error: ")])
    assert status == 1
    assert lines[0].startswith("verdict     cannot be fitted: robot.track_width_m")


def test_the_next_command_of_an_unusable_run_names_the_log_and_the_options(screen: Screen, tmp_path: Path) -> None:
    (tmp_path / "two words.mcap").symlink_to(ROOT / "sample_logs" / "wheeled_lawnmower.mcap")
    given = (*ROBOT, "--set", "frames.heading_offset_deg=40")
    status, lines = screen("fit", "two words.mcap", *given, "--plots", "none")
    check_fits([line for line in lines if not line.startswith("next ")])
    assert status == 0
    assert lines[0].startswith("Do not use: ")
    command = shlex.split(lines[-1].removeprefix("next"))
    assert command == ["icrtool", "info", "two words.mcap", "-v", *given]


def test_a_calibration_and_a_comparison_are_answered_on_one_screen(screen: Screen, short_logs: Path) -> None:
    logs, robot = [short_logs / name for name in ("field.mcap", "other.bag")], ("--robot", "husky-a200")
    status, lines = screen("calibrate", *logs, *robot)
    check_fits(lines)
    assert status == 0
    assert "wheel_separation_multiplier" in "\n".join(lines)
    assert "How far within 0.5 m (95 %), each log left out in turn?" in lines
    assert "omega_sw" not in "\n".join(lines)
    status, brief = screen("compare", *(f"{name}={log}" for name, log in zip("ab", logs, strict=True)), *robot)
    check_fits(brief)
    text = " ".join("\n".join(brief).split())
    assert status == 0
    assert text.startswith("b against a: no difference of the error found; with these 2 drives a change below")
    assert "Multiplier: b minus a is +" in text
    assert "The calibration of a, used on b, changes the error by " in text
    assert "error [m] after 10 m, calibrated on row, tested on column" in text
    full = screen("compare", *(f"{name}={log}" for name, log in zip("ab", logs, strict=True)), *robot, "-v")[1]
    assert len(full) > len(brief) + 8


def test_a_batch_has_a_line_a_log_and_says_which_one_is_cut_off(
    screen: Screen, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("icrtool.fleet.batch.process_apart", process_apart)
    (tmp_path / "season").mkdir()
    content = (ROOT / "sample_logs" / "wheeled_lawnmower.mcap").read_bytes()
    (tmp_path / "season" / "whole.mcap").write_bytes(content)
    (tmp_path / "season" / "short.mcap").write_bytes(content[: 6 * len(content) // 10])
    (tmp_path / "season" / "broken.mcap").write_bytes(content[:100])
    status, lines = screen("batch", "season", "-o", "fleet", *ROBOT, "--plots", "none", "--no-page", "-j", "1")
    check_fits([line for line in lines if not line.startswith("Error: ")])
    assert status == 1
    assert any(line.startswith("cut off  short.mcap") for line in lines)
    with (tmp_path / "fleet" / "fleet.csv").open() as file:
        rows = {row["log"]: row for row in csv.DictReader(file)}
    assert rows["short.mcap"]["status"] == "done"
    assert rows["short.mcap"]["reason"].startswith("truncated: ")
    assert {row["this_time"] for row in rows.values()} == {"processed"}
    (calibration,) = json.loads((tmp_path / "fleet" / "fleet.json").read_text())["calibrations"]
    assert (calibration["logs"], calibration["left_out"]) == (["whole.mcap"], ["short.mcap"])
