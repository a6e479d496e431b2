"""The documentation site: it builds, its commands and Python lines run, and its tables name what is written."""

from __future__ import annotations

import csv
import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import pytest
from click.testing import CliRunner

from icrtool.cli.commands import icrtool as command_line
from support.pictures import blank_pictures

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
SESSIONS = ["tutorial.md", "how-to/another-robot.md", "how-to/controllers.md", "how-to/notebook.md"]
"""Pages whose commands and Python blocks run as they stand, in order."""
FILES = (DOCS / "reference" / "files.md").read_text(encoding="utf-8")


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    if importlib.util.find_spec("sphinx") is None:
        pytest.skip("Sphinx is not installed")
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "-b", "dummy", str(DOCS), str(tmp_path)]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", SESSIONS)
def test_the_lines_of_a_page_run_in_order(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with blank_pictures():
        run_lines(page, tmp_path, monkeypatch)


def run_lines(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mpl.use("agg")
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")
    blocks = re.findall(r"```(sh|python)\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    names: dict[str, object] = {}
    for language, block in blocks:
        if language == "python":
            exec(block, names)
            continue
        for line in block.splitlines():
            result = CliRunner().invoke(command_line, shlex.split(line, comments=True)[1:])
            assert result.exit_code == 0, (line, result.output, result.exception)
    if page == "tutorial.md":
        check_columns(tmp_path / "icrtool-runs" / "wheeled_lawnmower")


def check_columns(run: Path) -> None:
    """Compare the columns of every CSV file of a run with those that the page lists under its name."""
    files = [*run.glob("*.csv"), *(run / "dropout").glob("*.csv")]
    assert len(files) >= 5
    for file in files:
        with file.open(newline="") as lines:
            written = set(next(csv.reader(lines)))
        section = next(part for part in FILES.split("\n### ") if file.name in part.splitlines()[0])
        rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
        listed = set(re.findall(r"`(\w+)`", "".join(rows)))
        assert written <= listed, (file.name, written - listed)
        if "and" not in section.splitlines()[0]:
            assert listed == written, file.name
