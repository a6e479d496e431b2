"""The documentation names what there is, and nothing that is not."""

from __future__ import annotations

import ast
import contextlib
import functools
import inspect
import itertools
import math
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

import icrtool
from icrtool.cli.commands import icrtool as command_line
from icrtool.config import Config, builtin_robots
from icrtool.logs.streams.message_types import MESSAGE_TYPES
from icrtool.logs.streams.wheel_pairs import PAIR_TYPES
from icrtool.output.tables.configuration import format_configuration

ROOT = Path(__file__).resolve().parents[1]
SCHEMA = re.compile(r"icrtool/[a-z-]+/\d+")
"""Names of JSON schemas look like paths."""
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONFIGURATION = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
EQUATIONS = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    *(str(page.relative_to(ROOT)) for page in sorted((ROOT / "docs").rglob("*.md"))),
)
EXAMPLE = CONFIGURATION.split("```toml\n")[1].split("```")[0]


def test_the_configuration_page_shows_what_the_command_prints() -> None:
    assert format_configuration(Config()) == EXAMPLE


@pytest.mark.parametrize("command", sorted(command_line.list_commands(None)))  # type: ignore[arg-type]
def test_every_command_has_help_and_stands_in_the_documentation(command: str) -> None:
    result = CliRunner().invoke(command_line, [command, "--help"])
    assert result.exit_code == 0
    assert "Usage" in result.output
    assert "\\b" not in result.output
    pages = README + "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md"))
    assert f"icrtool {command}" in pages


def test_the_readme_names_every_built_in_robot() -> None:
    for robot in builtin_robots():
        assert f"`{robot}`" in README


@pytest.mark.parametrize(
    ("role", "types"),
    [
        ("Wheels", {*MESSAGE_TYPES["wheels"], *PAIR_TYPES}),
        ("Position", MESSAGE_TYPES["gnss"]),
        ("Heading", MESSAGE_TYPES["heading"]),
    ],
)
def test_the_page_of_message_types_names_those_that_are_read_and_no_other(role: str, types: set[str]) -> None:
    page = (ROOT / "docs" / "reference" / "message-types.md").read_text(encoding="utf-8")
    section = page.split(f"## {role}\n")[1].split("\n## ")[0]
    named = {name for row in re.findall(r"^\| (.*?) \|", section, re.MULTILINE) for name in re.findall(r"`(.*?)`", row)}
    assert {name for name in named if re.search(r"^foxglove\.|\w/", name)} - {"tf2_msgs/TFMessage"} == {*types}


@pytest.mark.parametrize("page", PAGES)
def test_the_files_a_page_links_to_are_there(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (ROOT / page).parent.joinpath(target).exists(), target


@pytest.mark.parametrize("page", PAGES)
def test_the_files_a_page_names_are_there(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for name in re.findall(r"`((?:icrtool|tests|docs|scripts|benchmarks|sample_logs)/[\w./-]*)`", text):
        if not SCHEMA.fullmatch(name):
            assert (ROOT / name).exists(), name


@pytest.mark.parametrize("page", PAGES)
def test_the_public_names_of_a_page_exist(page: str) -> None:
    for name in re.findall(r"\bicrtool\.([a-z]\w+)\b(?!\.)", (ROOT / page).read_text(encoding="utf-8")):
        assert hasattr(icrtool, name), name


@functools.cache
def functions_in(path: Path) -> set[str]:
    """Return the names of the functions of a module and of the methods of its classes."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return {node.name for node in nodes if isinstance(node, ast.FunctionDef)}


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


COMMANDS = [
    (page, line)
    for page in PAGES
    for block in re.findall(r"```sh\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)
    for line in block.splitlines()
    if line.startswith("icrtool ")
]


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_a_command_that_a_page_shows_has_these_arguments(
    page: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")
    for log in ("field.mcap", "other.bag"):
        (tmp_path / log).touch()
    for run in ("RUN", "icrtool-runs/field"):
        (tmp_path / run).mkdir(parents=True)
    name, *arguments = shlex.split(line, comments=True)[1:]
    command = command_line.get_command(None, name)  # type: ignore[arg-type]
    assert command is not None
    command.make_context(name, arguments)


@pytest.fixture(scope="module")
def readme_session() -> dict[str, Any]:
    """Return what the README's Python blocks leave behind, run in order, and the report on the run."""
    names: dict[str, Any] = {}
    with contextlib.chdir(ROOT):
        exec("".join(re.findall(r"```python\n(.*?)```", README, re.DOTALL)), names)
    assert names["report"].result("calibration") is not None
    return names | {"whole_report": icrtool.dropout_report(names["run"])}


def readme_table(first_cell: str, page: str = README) -> list[list[str]]:
    """Return the rows below the header of the table, in the README or another page, whose header begins with a cell."""
    lines = page.partition(f"\n| {first_cell} |")[2].splitlines()[2:]
    rows = itertools.takewhile(lambda line: line.startswith("|"), lines)
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in rows]


RESULTS_PAGE = (ROOT / "docs" / "how-to" / "read-the-result.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("page", "count"), [(README, 4), (RESULTS_PAGE, 8)])
def test_the_errors_of_a_page_are_those_of_the_sample_log(
    page: str, count: int, readme_session: dict[str, Any]
) -> None:
    summary = readme_session["whole_report"].summary.set_index(["model", "horizon_m"])
    rows = readme_table("row", page)
    assert len(rows) == count
    for row in rows:
        model = row[0].split("`")[1]
        found = [f"{summary.loc[(model, horizon), 'p95_m']:.3f}" for horizon in (1, 5, 10, 20)]
        assert found == row[1:]


def test_the_readmes_icrs_are_those_of_the_sample_log(readme_session: dict[str, Any]) -> None:
    geometry, controller = (readme_session["run"].summary[name] for name in ("geometry", "controller"))
    rows = dict(row[:2] for row in readme_table("of the drive"))
    for label, column in (("y right", "y_icr_right_m"), ("y left", "y_icr_left_m"), ("x", "x_icr_m")):
        assert rows[label] == f"{geometry[column]:+.3f} ± {geometry[f'{column}_std']:.3f} m"
    next_std = math.hypot(controller["multiplier_std"], controller["multiplier_between_std"])
    here = f"{controller['multiplier']:.3f} ± {controller['multiplier_std']:.3f}"
    assert rows["multiplier"] == f"{here}, next drive ± {next_std:.2g}"


def test_the_readmes_distances_are_those_of_the_sample_log(readme_session: dict[str, Any]) -> None:
    by_model = {one.model: one for one in readme_session["whole_report"].document.budgets}
    rows = readme_table("within 0.5 m (95 %)")
    assert len(rows) == 4
    for row in rows:
        one = by_model[row[0].strip("`")]
        assert [one.short_text, one.next_text] == row[1:]


def test_the_lines_of_the_first_change_stand_in_the_files_they_name() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## Set-up")[0]
    blocks = re.findall(r"```diff\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    assert len(lines) > 10
    file = ""
    for line in lines:
        if line.startswith("+++ "):
            file = (ROOT / line.removeprefix("+++ ")).read_text(encoding="utf-8")
        else:
            assert f"{line.removeprefix('+')}\n" in file, line


def test_the_page_on_results_shows_the_distances_of_the_readme() -> None:
    for row, *cells in readme_table("within 0.5 m (95 %)"):
        shown = re.search(rf"^ +{row.strip('`')} +(\S+ m) +(\S.*? m(?: or more)?)(?:  |$)", RESULTS_PAGE, re.MULTILINE)
        assert shown is not None
        assert list(shown.groups()) == cells


def test_the_example_of_make_where_shows_what_the_script_prints() -> None:
    shown = ARCHITECTURE.partition("$ make where WORDS=decide_jumps\n")[2].partition("```")[0]
    script = [sys.executable, str(ROOT / "scripts" / "where.py"), "decide_jumps"]
    printed = subprocess.run(script, capture_output=True, text=True, check=True).stdout
    # Line numbers change with every edit of the module.
    assert shown
    assert re.sub(r":\d+:", "::", shown) == re.sub(r":\d+:", "::", printed)
