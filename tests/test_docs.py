"""The documentation names what there is, and nothing that is not."""

from __future__ import annotations

import ast
import inspect
import re
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest
from click.testing import CliRunner

import icrtool
from icrtool.cli.commands import icrtool as command_line
from icrtool.config import SECTIONS, builtin_robots, load_config

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONFIGURATION = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
EQUATIONS = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PAGES = ("README.md", "CONTRIBUTING.md", "SECURITY.md", *(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")))
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


@pytest.mark.parametrize("command", sorted(command_line.list_commands(None)))  # type: ignore[arg-type]
def test_every_command_has_help_and_stands_in_the_documentation(command: str) -> None:
    result = CliRunner().invoke(command_line, [command, "--help"])
    assert result.exit_code == 0
    assert "Usage" in result.output
    assert "\\b" not in result.output
    pages = README + "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md"))
    assert f"icrtool {command}" in pages


def test_the_readme_names_every_built_in_robot() -> None:
    for robot in builtin_robots():
        assert f"`{robot}`" in README


@pytest.mark.parametrize("page", PAGES)
def test_the_files_a_page_links_to_are_there(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (ROOT / page).parent.joinpath(target).exists(), target


@pytest.mark.parametrize("page", PAGES)
def test_the_files_a_page_names_are_there(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for name in re.findall(r"`((?:icrtool|tests|docs|scripts|benchmarks|sample_logs)/[\w./-]*)`", text):
        assert (ROOT / name).exists(), name


def functions_in(path: Path) -> Iterator[str]:
    """List the functions of a module and the methods of its classes."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef):
            yield node.name


@pytest.mark.parametrize(("folder", "column"), [("icrtool", -2), ("tests", -1)])
def test_every_function_and_test_of_the_equation_index_exists(folder: str, column: int) -> None:
    rows = [line.strip("| ").split(" | ") for line in EQUATIONS.splitlines() if "::" in line]
    assert len(rows) > 30
    missing = []
    for row in rows:
        named = re.findall(r"`([\w/]+\.py)::(\w+)`", row[column])
        assert named, row
        for module, function in named:
            path = ROOT / folder / module
            if not path.is_file() or function not in functions_in(path):
                missing.append(f"{row[0]}: {folder}/{module}::{function}")
    assert not missing, "\n".join(missing)


def test_every_equation_of_the_paper_stands_in_the_index() -> None:
    listed: set[int] = set()
    for row in re.findall(r"^\| Eqs?\. ([\d, -]+)", EQUATIONS, re.MULTILINE):
        for part in row.strip(" ,").split(","):
            first, _, last = part.strip().partition("-")
            listed |= set(range(int(first), int(last or first) + 1))
    assert listed == set(range(1, 40))


def test_every_package_stands_in_the_architecture_page() -> None:
    for package in (path.parent for path in (ROOT / "icrtool").glob("*/__init__.py")):
        assert f"| `icrtool/{package.name}/` |" in ARCHITECTURE


@pytest.mark.parametrize("name", sorted(name for name in icrtool.__all__ if name.islower() and name.isidentifier()))
def test_a_public_function_documents_every_parameter(name: str) -> None:
    function = getattr(icrtool, name)
    if not inspect.isfunction(function):
        pytest.skip(f"{name} is no function")
    text = inspect.getdoc(function) or ""
    section = text.partition("Parameters\n----------\n")[2].partition("\n\n")[0]
    documented = {word for names in re.findall(r"^(\w[\w, ]*?) :", section, re.MULTILINE) for word in names.split(", ")}
    assert documented == set(inspect.signature(function).parameters)
