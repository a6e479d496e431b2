"""The house: which room may know what (CONTRIBUTING.md, "The house"). A breach is reported as a sentence."""

from __future__ import annotations

import ast
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "icrtool"
ROOMS = ("core", "logio", "analysis", "report", "cli")
GROUND = ("errors", "tables", "config")
JUNK_DRAWERS = {"utils", "util", "tools", "common", "helpers", "misc"}
LONGEST_MODULE_LINES = 420

MUST_NOT_IMPORT = {
    **dict.fromkeys(GROUND, ROOMS),
    "core": (*GROUND, "logio", "analysis", "report", "cli"),
    "logio": ("analysis", "report", "cli"),
    "analysis": ("logio", "report", "cli"),
    "report": ("logio", "cli"),
}
ONLY_HOME = {"click": "cli", "matplotlib": "report"}
CORE_LIBRARIES = {"numpy", "numba"}
LATE_LIBRARIES = {"pandas"}


@dataclass(frozen=True)
class Import:
    module: str
    line: int
    at_start: bool
    """Carried out when the module is imported: neither inside a function nor for types only."""


def imports_of(source: str, package: str) -> list[Import]:
    """List the imports of a module that lies in `package`, relative ones made absolute."""
    found: list[Import] = []

    def visit(node: ast.AST, *, at_start: bool) -> None:
        if isinstance(node, ast.Import):
            found.extend(Import(name.name, node.lineno, at_start) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            faces = [f"{base}.{name.name}" for name in node.names] if base == "icrtool" else [base]
            found.extend(Import(module, node.lineno, at_start) for module in faces)
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            for child in node.body:
                visit(child, at_start=False)
            for child in node.orelse:
                visit(child, at_start=at_start)
        else:
            later = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
            for child in ast.iter_child_nodes(node):
                visit(child, at_start=at_start and not later)

    visit(ast.parse(source), at_start=True)
    return found


def breaches(path: Path, source: str) -> list[str]:
    """Say what is wrong with the module at `path` (relative to the package), one sentence each."""
    room = path.parts[0].removesuffix(".py")
    said = [f"icrtool/{path}: no module is named {name}" for name in _names(path) if name in JUNK_DRAWERS]
    if (lines := len(source.splitlines())) > LONGEST_MODULE_LINES:
        said.append(
            f"icrtool/{path}: {lines} lines are more than {LONGEST_MODULE_LINES}; split it where its subject splits"
        )
    for found in imports_of(source, ".".join(["icrtool", *path.parts[:-1]])):
        said += [f"icrtool/{path}:{found.line}: {why}" for why in _objections(room, found)]
    return said


def _names(path: Path) -> list[str]:
    return [part.removesuffix(".py").strip("_") for part in path.parts]


def _objections(room: str, found: Import) -> list[str]:
    top, _, rest = found.module.partition(".")
    said: list[str] = []
    if top == "icrtool":
        target = rest.partition(".")[0]
        if target in MUST_NOT_IMPORT.get(room, ()):
            said.append(f"{room} must not import {target}")
        known = {*ROOMS, *GROUND, "__version__"}
        if room in {*ROOMS, *GROUND} - {"cli"} and target not in known:
            said.append(f"{room} must not import {target or 'icrtool'} from the package face")
        return said
    if room == "core" and top not in CORE_LIBRARIES | sys.stdlib_module_names:
        said.append(f"core must not import {top}")
    if (home := ONLY_HOME.get(top)) and room not in {home, "core"}:
        said.append(f"{room} must not import {top}: only {home} does")
    if top in LATE_LIBRARIES and room != "core" and found.at_start:
        said.append(f"{room} must not import {top} at module level: import it in the function that needs it")
    return said


MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_module_keeps_to_its_room(module: Path) -> None:
    assert not (said := breaches(module, (PACKAGE / module).read_text(encoding="utf-8"))), "\n".join(said)


@pytest.mark.parametrize(
    ("module", "source", "sentence"),
    [
        ("core/ekf.py", "import pandas as pd", "core must not import pandas"),
        ("core/ekf.py", "from scipy.stats import chi2", "core must not import scipy"),
        ("core/ekf.py", "def f():\n    from icrtool.tables import States", "core must not import tables"),
        ("core/ekf.py", "if TYPE_CHECKING:\n    import pandas", "core must not import pandas"),
        ("tables.py", "from icrtool.core import ekf", "tables must not import core"),
        ("config.py", "from icrtool import logio", "config must not import logio"),
        ("logio/bag.py", "from ..analysis.fit import fit", "logio must not import analysis"),
        ("logio/bag.py", "from icrtool import fit", "logio must not import fit from the package face"),
        ("logio/bag.py", "import icrtool", "logio must not import icrtool from the package face"),
        ("analysis/fit.py", "import icrtool.logio.bag", "analysis must not import logio"),
        ("analysis/fit.py", "import matplotlib.pyplot as plt", "analysis must not import matplotlib: only report does"),
        ("analysis/fit.py", "import click", "analysis must not import click: only cli does"),
        ("report/figures.py", "from icrtool.logio import read_log", "report must not import logio"),
        ("report/figures.py", "import click", "report must not import click: only cli does"),
        ("cli/fit.py", "import matplotlib", "cli must not import matplotlib: only report does"),
        (
            "report/tables.py",
            "try:\n    import pandas\nexcept ImportError:\n    pass",
            "report must not import pandas at",
        ),
        ("logio/utils.py", "", "no module is named utils"),
        ("helpers/bag.py", "", "no module is named helpers"),
        ("logio/bag.py", "\n" * (LONGEST_MODULE_LINES + 1), "lines are more than"),
    ],
)
def test_breach_is_said_in_a_sentence(module: str, source: str, sentence: str) -> None:
    assert any(sentence in said for said in breaches(Path(module), source))


@pytest.mark.parametrize(
    ("module", "source"),
    [
        (
            "core/ekf.py",
            "import math\nimport numba\nimport numpy as np\nfrom icrtool.core.angles import wrap\nfrom . import angles",
        ),
        ("tables.py", "if TYPE_CHECKING:\n    import pandas as pd"),
        ("logio/bag.py", "from icrtool.core.gather import gather\nfrom icrtool.errors import LogError"),
        ("analysis/fit.py", "def frame():\n    import pandas as pd"),
        ("report/figures.py", "from matplotlib.figure import Figure\nfrom icrtool.analysis.fit import FilterRun"),
        ("cli/__init__.py", "import click\nfrom icrtool import __version__, read_log"),
    ],
)
def test_house_lets_through_what_it_should(module: str, source: str) -> None:
    assert breaches(Path(module), source) == []
