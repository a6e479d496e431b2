"""Every command and Python block that a page shows runs, in one folder, with a short log in place of the reader's."""

from __future__ import annotations

import contextlib
import re
import shlex
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from icrtool.cli.commands import icrtool as command_line
from support.batches import in_this_process
from support.pictures import blank_pictures
from support.pose_topics import dead_reckoned, measured, pose_plan, true_poses, write_pose_log

ROOT = Path(__file__).resolve().parents[1]

ELSEWHERE = {
    "docs/ci.md": "tests/e2e/test_ci.py runs its jobs",
    "docs/tutorial.md": "tests/test_docs_site.py runs it in order",
    "docs/how-to/another-robot.md": "tests/test_docs_site.py runs it in order",
    "docs/how-to/controllers.md": "tests/test_docs_site.py runs it in order",
    "docs/how-to/notebook.md": "tests/test_docs_site.py runs it in order",
    "docs/cloud.md": "needs an object store; tests/unit/logs/test_remote_logs.py reads logs of moto's server",
    "docs/how-to/autopilot.md": "tests/test_docs_autopilot.py runs it on logs of both autopilots",
}
NOT_RUN = {
    "icrtool demo": "tests/e2e/test_demo.py runs it",
    "icrtool batch /shared/season -o /shared/results --scheduler tcp://host:8786": "needs a cluster; "
    "tests/unit/fleet/test_cluster.py runs one of Dask on this machine",
}
FEWER = {
    "study": ["--runs", "2", "--duration", "20"], "simulate": ["--duration", "40", "--heading-rate", "50"],
    "fit": ["--plots", "none"], "dropout-report": ["--plots", "none", "--no-page", "--no-ladder"],
    "batch": ["--plots", "none", "--no-ladder", "--no-page"],
}  # fmt: skip
"""Options added so that a command takes a second, not minutes; pictures are drawn by the tests of each command."""

MEANT = {"icrtool-runs/*": ["icrtool-runs/field"], "RUN": ["icrtool-runs/field"]}
"""What a word of a page stands for here: the folder also has runs of other robots."""


def shown_commands() -> Iterator[tuple[str, str]]:
    """Yield page and command of every line of code that begins with ``icrtool``, without comment and pipe."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        name = page.relative_to(ROOT).as_posix()
        text = page.read_text(encoding="utf-8")
        blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL) + re.findall(r"(?:^    .*\n)+", text, re.MULTILINE)
        for line in "\n".join(blocks).splitlines():
            if line.strip().startswith("icrtool ") and name not in ELSEWHERE:
                yield name, shlex.join(shlex.split(line, comments=True)).partition(" '|' ")[0]


TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
COMMANDS: dict[str, str] = {}
for found_on, line in shown_commands():
    if line not in NOT_RUN and f"{line}\n" not in TUTORIAL:
        COMMANDS.setdefault(line, found_on)
"""Each command once, and a page that shows it."""


def shown_python() -> Iterator[tuple[str, str]]:
    """Yield each page with Python, and its blocks as one program; tests/test_docs.py runs those of the README."""
    block_of_python = re.compile(r"^ *```(?:python|py)\n(.*?)```", re.DOTALL | re.MULTILINE)
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        name = page.relative_to(ROOT).as_posix()
        blocks = block_of_python.findall(page.read_text(encoding="utf-8"))
        if blocks and name not in {*ELSEWHERE, "README.md"}:
            yield name, "\n".join(textwrap.dedent(block) for block in blocks)


PYTHON = dict(shown_python())


def run(*words: str) -> Result:
    return CliRunner().invoke(command_line, list(words))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with what the pages name: logs, runs, calibrations, a comparison, a plan."""
    folder = tmp_path_factory.mktemp("pages")
    with contextlib.chdir(folder), blank_pictures(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("icrtool.fleet.batch.process_apart", in_this_process)
        Path("sample_logs").symlink_to(ROOT / "sample_logs")
        robot = ["--robot", "husky-a200"]
        options = [*robot, "--path", "lawnmower", "--speed", "0.8", "--duration", "45", "--wheel-rate", "20",
                   "--heading-rate", "20", "--gnss-rate", "5"]  # fmt: skip
        for log, seed in {"field.mcap": "1", "other.bag": "2", "season/a.mcap": "3"}.items():
            Path(log).parent.mkdir(exist_ok=True)
            assert run("simulate", "-o", log, "--seed", seed, *options).exit_code == 0
        true, odometry = true_poses(), "nav_msgs/msg/Odometry"
        poses = {"/odometry/filtered": measured(true, 0.01, 0.002), "/visual/odom": dead_reckoned(true, 1.0, 0.01)}
        plans = [pose_plan(topic, odometry, of_topic) for topic, of_topic in poses.items()]
        write_pose_log(Path("localised.mcap"), plans, radius_m=0.1651)
        fits = {"field.mcap": "icrtool-runs/field", "season/a.mcap": "season1/a"}
        for log, directory in fits.items():
            assert run("fit", log, *robot, "--plots", "none", "-o", directory, "-q").exit_code == 0
        shutil.copytree("icrtool-runs/field", "season2/field")
        assert run("calibrate", "icrtool-runs/field", "-o", "season.json", "-q").exit_code == 0
        assert run("compare", "season1/", "season2/", "-o", "comparison.json", "-q").exit_code == 0
        for day in ("monday", "tuesday", "friday"):
            shutil.copy("field.mcap", f"{day}.mcap")
        shutil.copy("season.json", "husky.json")
        Path("plan.csv").write_text("east_m,north_m\n0,0\n5,0\n5,8\n", encoding="utf-8")
        yield folder


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_that_a_page_shows_runs(folder: Path, command: str) -> None:
    name, *words = shlex.split(command)[1:]
    words = [part for word in words for part in MEANT.get(word, [word])]
    # A limit on the row recommended needs the ladder.
    fewer = [one for one in FEWER.get(name, []) if not (one == "--no-ladder" and "recommended" in command)]
    result = run(name, *words, *fewer)
    assert result.exit_code == 0, (COMMANDS[command], result.output, result.exception)


@pytest.mark.parametrize("page", PYTHON)
def test_the_python_of_a_page_runs_as_it_stands(folder: Path, page: str) -> None:
    exec(compile(PYTHON[page], page, "exec"), {})


def test_the_callback_of_the_page_on_board_publishes_the_twist_of_its_model(folder: Path) -> None:
    published: list[tuple[float, float, float]] = []
    names: dict[str, Any] = {
        "stamp_s": lambda msg: msg[0],
        "wheel_speeds": lambda msg: msg[1:],
        "filtered_pose": lambda: None,
        "publish": lambda *twist: published.append(twist),
    }
    exec(compile(PYTHON["docs/how-to/on-board.md"], "on-board.md", "exec"), names)
    names["on_wheels"]((0.02, 0.5, 0.7))
    v_x, v_y, omega = names["model"].twist(0.5, 0.7)
    assert published == [(v_x, -v_y, -omega)]
    assert 0.5 < v_x < 0.7
    assert omega < 0.0


def test_what_is_run_elsewhere_or_not_at_all_is_still_shown() -> None:
    shown = {command for _, command in shown_commands()}
    assert set(NOT_RUN) <= shown
    assert all((ROOT / page).is_file() for page in ELSEWHERE)
    assert len(COMMANDS) > 20
