"""The documentation names what there is, and nothing that is not."""

from __future__ import annotations

import re
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest
from click.testing import CliRunner

from icrtool.cli.commands import icrtool
from icrtool.config import SECTIONS, builtin_robots, load_config

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONFIGURATION = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
EXAMPLE = CONFIGURATION.split("```toml\n")[1].split("```")[0]


def test_the_configuration_page_is_a_configuration_that_loads(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(EXAMPLE, encoding="utf-8")
    assert load_config(file).robot.name == "my robot"


def test_the_configuration_page_names_every_key() -> None:
    example = tomllib.loads(EXAMPLE)
    for section, kind in SECTIONS.items():
        for key in fields(kind):
            assert key.name in example[section] or key.name in CONFIGURATION, f"{section}.{key.name}"


@pytest.mark.parametrize("command", sorted(icrtool.list_commands(None)))  # type: ignore[arg-type]
def test_every_command_has_help_and_stands_in_the_documentation(command: str) -> None:
    result = CliRunner().invoke(icrtool, [command, "--help"])
    assert result.exit_code == 0
    assert "Usage" in result.output
    assert "\\b" not in result.output
    pages = README + "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md"))
    assert f"icrtool {command}" in pages


def test_the_readme_names_every_built_in_robot() -> None:
    for robot in builtin_robots():
        assert f"`{robot}`" in README


def test_the_files_the_readme_links_to_are_there() -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).exists(), target
