"""What runs at GitHub and GitLab is of the form that they read, and safe by zizmor's rules; so is what users copy."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from support.jobs import yaml_of

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "ci.md").read_text(encoding="utf-8")
SHOWN = [(block, yaml_of(block)[0]) for block in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)]
SHOWN_WORKFLOWS = [block for block, content in SHOWN if "jobs" in content]
SHOWN_GITLAB = [block for block, content in SHOWN if "include" in content]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
ACTION = ROOT / ".github" / "actions" / "icrtool" / "action.yml"
CONFIG = ROOT / ".github" / "zizmor.yml"


def check(*command: object) -> subprocess.CompletedProcess[str]:
    """Run a tool of the development environment."""
    tool, *arguments = map(str, command)
    return subprocess.run([Path(sys.executable).parent / tool, *arguments], capture_output=True, text=True, check=False)


def written(folder: Path, texts: list[str]) -> list[Path]:
    folder.mkdir(parents=True)
    files = [folder / f"{number}.yml" for number in range(len(texts))]
    for file, text in zip(files, texts, strict=True):
        file.write_text(text, encoding="utf-8")
    return files


def test_workflows_action_and_template_have_the_form_of_their_schemas(tmp_path: Path) -> None:
    template = (ROOT / ".gitlab" / "icrtool-job.yml").read_text(encoding="utf-8").split("\n---\n")
    assert SHOWN_WORKFLOWS
    assert SHOWN_GITLAB
    for schema, files in {
        "github-workflows": [*WORKFLOWS, *written(tmp_path / "github", SHOWN_WORKFLOWS)],
        "github-actions": [ACTION],
        "gitlab-ci": written(tmp_path / "gitlab", [*template, *SHOWN_GITLAB]),
    }.items():
        done = check("check-jsonschema", "--builtin-schema", f"vendor.{schema}", *files)
        assert done.returncode == 0, done.stdout + done.stderr


def test_a_step_that_no_runner_reads_is_found(tmp_path: Path) -> None:
    [wrong] = written(tmp_path / "wrong", [WORKFLOWS[0].read_text(encoding="utf-8").replace("runs-on:", "runs_on:")])
    assert check("check-jsonschema", "--builtin-schema", "vendor.github-workflows", wrong).returncode == 1


def test_zizmor_finds_nothing(tmp_path: Path) -> None:
    shown = written(tmp_path / ".github" / "workflows", SHOWN_WORKFLOWS)
    done = check("zizmor", "--offline", "--no-progress", "--config", CONFIG, *WORKFLOWS, ACTION, *shown)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("change", [("@[0-9a-f]{40}", "@v4"), ("permissions: .*\n", "")])
def test_an_action_by_a_tag_or_a_job_with_all_permissions_is_found(tmp_path: Path, change: tuple[str, str]) -> None:
    text = re.sub(*change, (ROOT / ".github" / "workflows" / "check.yml").read_text(encoding="utf-8"))
    [wrong] = written(tmp_path / ".github" / "workflows", [text])
    assert check("zizmor", "--offline", "--no-progress", wrong).returncode != 0


@pytest.mark.parametrize("file", [".github/actions/icrtool/action.yml", ".gitlab/icrtool-job.yml"])
def test_logs_stand_behind_two_dashes_so_that_none_is_an_option(file: str) -> None:
    calls = re.findall(r"icrtool batch .*?\$LOGS", (ROOT / file).read_text(encoding="utf-8"), re.DOTALL)
    assert len(calls) == 1
    assert calls[0].endswith(" -- $LOGS")
