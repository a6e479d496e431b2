"""What a new user meets: robots, configuration, proposals, the verdict on a log, completion, stages."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.writer import Writer

from icrtool.cli.options import topics_of
from icrtool.cli.printing import Stages, signal_word
from icrtool.config import builtin_robots, load_config
from icrtool.kernels.compiled import Kernel

ROOT = Path(__file__).resolve().parents[2]
TRACKED = ROOT / "sample_logs" / "tracked_curved.bag"
MOWER = ROOT / "sample_logs" / "wheeled_lawnmower.mcap"


def test_robots_lists_every_robot_with_its_numbers(icrtool) -> None:
    status, out, err = icrtool("robots")
    assert (status, err) == (0, "")
    for name, robot in builtin_robots().items():
        (line,) = (line for line in out.splitlines() if line.startswith(f"{name} "))
        assert f"{robot['track_width_m']:.3f} m" in line
    document = json.loads(icrtool("robots", "--json")[1])
    assert document["schema"] == "icrtool/robots/1"
    assert [robot["name"] for robot in document["robots"]] == list(builtin_robots())


def test_the_configuration_that_is_written_can_be_used(icrtool, tmp_path: Path) -> None:
    assert icrtool("config", "--robot", "jackal", "--set", "filter.gnss_std_m=.02", "-o", "mine.toml") == (0, "", "")
    config = load_config(tmp_path / "mine.toml")
    assert (config.robot.name, config.filter.gnss_std_m) == ("jackal", 0.02)


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("fitt", "log.mcap"), "fit"),
        (("fit", TRACKED, "--robot", "husky"), "husky-a200"),
        (("fit", TRACKED, "--set", "topics.gnss=/gps/fixx"), "/gps/fix"),
        (("fit", TRACKED, "--set", "topics.wheel_left=/left_drive", "--set", "topics.wheel_right=/r"),
         "/left_drive/velocity"),
    ],
)  # fmt: skip
def test_a_misspelled_name_is_proposed_right(icrtool, arguments: tuple[object, ...], meant: str) -> None:
    status, _, err = icrtool(*arguments)
    assert status in (1, 2)
    assert f"did you mean {meant}?" in err


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("fit", TRACKED, "--set", "track_width_m=1"), "did you mean robot.track_width_m?"),
        (("export", "--for", "json", TRACKED), f"is a log, not a run or a calibration; icrtool fit {TRACKED}"),
        (("export", "--for", "evo", TRACKED), "is a log, and paths come from a run; icrtool fit"),
        (("export", "--for", "json", "nosuch.json"), "nosuch.json: no such file; icrtool calibrate -o"),
    ],
)
def test_what_was_meant_stands_in_the_message(icrtool, arguments: tuple[object, ...], part: str) -> None:
    status, out, err = icrtool(*arguments)
    assert (status, out) == (1, "")
    assert part in err


def test_help_begins_with_where_to_start_and_the_usual_options(icrtool) -> None:
    sections = [line for line in icrtool("--help")[1].splitlines() if line.endswith(":") and line[:1].isalpha()]
    assert sections[-3:] == ["Start here:", "Commands:", "More:"]
    for command in ("fit", "dropout-report", "batch", "simulate", "study"):
        usual, _, more = icrtool(command, "--help")[1].partition("\nOptions:\n")[2].partition("\nMore options:\n")
        assert usual.lstrip().startswith("-o, --output")
        assert "--robot" in usual
        assert more.strip().startswith("-")
    assert "--outage-at" not in icrtool("dropout-report", "--help")[1].partition("More options:")[0]


def test_strict_ends_with_3_where_a_run_must_not_be_used(icrtool, short_logs: Path) -> None:
    icrtool("simulate", "-o", "straight.mcap", "--path", "straight", "--duration", "60", "-q")
    command = ("fit", "straight.mcap", "--robot", "pentzer-tracked", "--plots", "none")
    assert icrtool(*command, "-q")[0] == 0
    status, _, err = icrtool(*command, "--strict", "-q")
    assert status == 3
    assert "do not use this run" in err
    usable = ("fit", short_logs / "field.mcap", "--robot", "husky-a200", "--plots", "none", "-q", "--strict")
    assert icrtool(*usable) == (0, "", "")


def test_the_first_run_says_that_it_compiles(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    kernel = Kernel(heading_of)
    with Stages("log") as stages:
        stages.begin("filter")
        assert kernel(1.0) == 2.0
        assert "log: filter (compiling, once on this computer: about 8 s) …" in capsys.readouterr().err
        assert kernel(2.0) == 3.0
        assert "compiling" not in capsys.readouterr().err
    assert Kernel(heading_of)(1.0) == 2.0


def heading_of(value: float) -> float:
    """Return a number, as a kernel does."""
    return value + 1.0


@pytest.mark.usefixtures("without_drawing")
def test_info_gives_date_extent_verdict_and_a_next_command_that_works(icrtool, short_logs: Path) -> None:
    status, out, _ = icrtool("info", MOWER, "--robot", "segway-rmp400")
    assert status == 0
    lines = {line.partition(" ")[0]: line.partition(" ")[2].strip() for line in out.splitlines()}
    assert lines["recorded"].startswith("2025-10-09 08:53:20 UTC, 3:20 min")
    assert lines["driven"].startswith("12")
    assert "m north-south about 40.79" in lines["area"]
    assert lines["verdict"] == "can be fitted, all ICRs are shown"
    assert "missing" not in lines
    document = json.loads(icrtool("info", MOWER, "--robot", "segway-rmp400", "--json")[1])["logs"][0]
    assert (document["verdict"], document["next"]) == (lines["verdict"], lines["next"])
    log = short_logs / "field.mcap"
    following = icrtool("info", log, "--robot", "husky-a200")[1].splitlines()[-1]
    name, *arguments = shlex.split(following.removeprefix("next"))
    assert (name, arguments[:2]) == ("icrtool", ["report", str(log)])
    status, out, _ = icrtool(*arguments)
    assert status == 0
    assert "How far without GNSS?" in out


def test_info_without_a_track_width_names_it_as_missing(icrtool) -> None:
    status, out, _ = icrtool("info", TRACKED)
    assert status == 0
    assert out.startswith("verdict     can be fitted")
    assert "\nmissing     robot.track_width_m" in out
    assert out.splitlines()[-1].endswith("tracked_curved.bag --robot NAME")


def test_info_of_a_log_that_cannot_be_fitted_states_why(icrtool, tmp_path: Path) -> None:
    table = tmp_path / "wheels.csv"
    rows = "".join(f"{k / 10},0,0,0,0,0\n" for k in range(100))
    table.write_text(f"t_s,v_left_mps,v_right_mps,north_m,east_m,heading_rad\n{rows}", encoding="utf-8")
    status, out, err = icrtool("info", table)
    assert "\nrecorded    at an unknown date" in out
    if status:
        assert "verdict     cannot be fitted: " in out
        assert err.startswith("Error: ")


def test_stages_are_lines_with_v_and_nothing_without(icrtool) -> None:
    _, _, err = icrtool("fit", TRACKED, "-v", "--plots", "none")
    stages = [line.partition(": ")[2] for line in err.splitlines() if line.startswith("tracked_curved.bag: ")]
    assert stages == ["reading", "aligning", "filter", "summary", "motion model", "writing"]
    _, _, err = icrtool("dropout-report", "--plots", "none", "--no-ladder")
    assert "outages and examples" not in err


def test_on_a_terminal_the_stage_is_rewritten_and_cleared(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr("icrtool.cli.printing.REFRESH_S", 0.0)
    with Stages("log") as stages:
        stages.begin("reading")
        stages.share(0.964)
        stages.share(1.0)
        stages.begin("filter")
    shown = capsys.readouterr().err.split("\r\x1b[K")
    assert shown == ["", "log: reading …", "log: reading 96 %", "log: reading …", "log: filter …", ""]


def test_colours_are_for_terminals_without_no_color(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert signal_word("Error:", "red") == "Error:"
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert signal_word("Error:", "red") == "\x1b[31m\x1b[1mError:\x1b[0m"
    monkeypatch.setenv("NO_COLOR", "1")
    assert signal_word("Error:", "red") == "Error:"


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A command named icrtool that runs this checkout."""
    script = tmp_path_factory.mktemp("bin") / "icrtool"
    script.write_text(
        f"#!{sys.executable} -P\nimport sys\nsys.path.insert(0, {str(ROOT)!r})\nfrom icrtool.cli import main\nmain()\n",
        encoding="utf-8",
    )
    script.chmod(0o755)
    return script


@pytest.fixture(scope="module")
def completion(command: Path) -> str:
    """What the command gives bash to evaluate."""
    return subprocess.run([command, "completion", "bash"], capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (["fit", "--robot", "hu"], {"husky-a200"}),
        (["fit", "--robot", "=", "ja"], {"jackal"}),
        (["info", "--set", "filter.gnss"], {"filter.gnss_std_m=", "filter.gnss_std_floor_m="}),
        (["fit", "--set", "frames.heading", "=", "e"], {"enu"}),
        (["fit", str(TRACKED), "--set", "topics.gnss", "=", "/g"], {"/gps/fix"}),
        (["dropout-report", str(TRACKED), "--set", "topics.heading", "="],
         {"/gps/fix", "/imu/data", "/left_drive/velocity", "/right_drive/velocity"}),
        (["ro"], {"robots"}),
    ],
)  # fmt: skip
def test_bash_completes_names_keys_and_topics(
    command: Path, completion: str, words: list[str], completed: set[str]
) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("bash is not installed")
    script = f"""
        {completion}
        COMP_WORDS=(icrtool {shlex.join(words)}); COMP_CWORD={len(words)}
        _icrtool_completion {shlex.quote(str(command))}
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    done = subprocess.run([bash, "-c", script], capture_output=True, text=True, check=False, env=dict(os.environ))
    assert set(done.stdout.split()) == completed


def test_only_names_of_ros_are_completed(tmp_path: Path) -> None:
    """Bash does not quote what it puts into the line."""
    with (tmp_path / "log.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
        for topic in ("/a;reboot", "/$(reboot)", "/two words", "/`id`", "/robot_1/gps/fix", "/\x1b[2J"):
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, 1, bytes(12), 1)
        writer.finish()
    assert topics_of([tmp_path / "log.mcap"]) == ("/robot_1/gps/fix",)


def test_the_verdict_on_a_log_begins_with_what_is_missing(icrtool, tmp_path: Path) -> None:
    with (tmp_path / "log.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/Temperature", "ros2msg", b"float64 temperature")
        writer.add_message(writer.register_channel("/motor", "cdr", schema), 1, bytes(12), 1)
        writer.finish()
    status, out, err = icrtool("info", tmp_path / "log.mcap")
    assert status == 1
    assert out.startswith("verdict     cannot be fitted: no wheels, no position and no heading found;")
    assert err.startswith(f"Error: {tmp_path / 'log.mcap'}: ")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_has_its_completion(icrtool, shell: str) -> None:
    status, out, _ = icrtool("completion", shell)
    assert status == 0
    assert f"_ICRTOOL_COMPLETE={shell}_complete" in out
