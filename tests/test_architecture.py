"""The architecture as a test: which package may import which, no circles, one meaning a name (docs/architecture.md).

A breach is reported as a sentence.
"""

from __future__ import annotations

import ast
import sys
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from support.sources import statements_in, tree_of

PACKAGE = Path(__file__).resolve().parents[1] / "icrtool"

LAYERS = (
    ("cli",),
    ("fleet",),
    ("pipeline",),
    ("output",),
    ("dropout_analysis", "simulation"),
    ("calibration",),
    ("estimation",),
    ("alignment", "logs"),
    ("motion",),
    ("kernels",),
)
"""The packages, from the top down: a package imports only from those below it."""

SHARED = ("errors", "records", "config")
"""Parts that every package but `kernels` may import; they import only one another."""

METHODS_THAT_IMPORT_UPWARDS = {
    ("records/run.py", "icrtool.output.run_directory"),
    ("records/run.py", "icrtool.output.tables.run"),
    ("calibration/record.py", "icrtool.output.files.formats"),
    ("dropout_analysis/report.py", "icrtool.output.dropout_directory"),
    ("dropout_analysis/report.py", "icrtool.output.tables.dropout"),
}
"""Modules of records, and what their methods import when they are called: a notebook expects ``run.write(path)``."""

IMPORT_BY_TEXT = {
    "__init__.py", "cli/commands.py", "cli/demo.py", "cli/installation.py", "cli/options.py", "kernels/compiled.py",
    "output/figure_catalogue.py",
}  # fmt: skip
"""Modules that import what a text names. These texts name modules that the module may import."""

IMPORTING_CALLS = {"import_module", "__import__", "resolve_name"}

RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}
VAGUE_NAMES = {"utils", "util", "tools", "common", "helpers", "misc"}
LONGEST_MODULE_LINES = 600

ONLY_IN = {"click": "cli", "matplotlib": "output"}
KERNEL_LIBRARIES = {"numpy", "numba", "llvmlite"}
LATE_LIBRARIES = {"pandas"}
"""Imported inside the function that needs them, so that ``--help`` is instant."""


@dataclass(frozen=True)
class Import:
    module: str
    line: int
    at_start: bool
    """Carried out when the module is imported: neither inside a function nor for types only."""
    names: tuple[str, ...] = ()
    """What is imported from the module, each with the module's name before it."""


@cache
def imports_of(source: str, package: str) -> list[Import]:
    """List the imports of a module that lies in `package`, relative ones made absolute."""
    found: list[Import] = []

    def visit(node: ast.AST, *, at_start: bool) -> None:
        if isinstance(node, ast.Import):
            found.extend(Import(name.name, node.lineno, at_start) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            names = [f"{base}.{name.name}" for name in node.names] if base == "icrtool" else [base]
            imported = tuple(f"{node.module}.{name.name}" for name in node.names if node.module)
            found.extend(Import(module, node.lineno, at_start, imported) for module in names)
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            for child in node.body:
                visit(child, at_start=False)
            for child in node.orelse:
                visit(child, at_start=at_start)
        else:
            later = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
            for child in statements_in(node):
                visit(child, at_start=at_start and not later)

    visit(tree_of(source), at_start=True)
    return found


def breaches(path: Path, source: str) -> list[str]:
    """Return what is wrong with the module at `path` (relative to the package), one sentence each."""
    package = path.parts[0].removesuffix(".py")
    names = [part.removesuffix(".py").strip("_") for part in path.parts]
    found = [f"icrtool/{path}: a module is named {name}" for name in names if name in VAGUE_NAMES]
    if (lines := len(source.splitlines())) > LONGEST_MODULE_LINES:
        found.append(
            f"icrtool/{path}: {lines} lines are more than {LONGEST_MODULE_LINES}; split it where its subject splits"
        )
    if path.as_posix() not in IMPORT_BY_TEXT:
        calls = [node.func for node in ast.walk(tree_of(source)) if isinstance(node, ast.Call)]
        names = [getattr(call, "attr", getattr(call, "id", "")) for call in calls]
        found += [f"icrtool/{path}: {name} imports what no test sees" for name in names if name in IMPORTING_CALLS]
    for one in imports_of(source, ".".join(["icrtool", *path.parts[:-1]])):
        if not one.at_start and (path.as_posix(), one.module) in METHODS_THAT_IMPORT_UPWARDS:
            continue
        found += [f"icrtool/{path}:{one.line}: {why}" for why in _objections(package, one)]
    return found


def _may_import(package: str, target: str) -> bool:
    if package == target:
        return True
    if package in SHARED:
        return target in SHARED or (package == "records" and target == "kernels")
    if package == "kernels":
        return False
    return target in SHARED or RANK[target] > RANK[package]


def _objections(package: str, one: Import) -> list[str]:
    top, _, rest = one.module.partition(".")
    found: list[str] = []
    if top == "icrtool":
        target = rest.partition(".")[0]
        if package not in {*RANK, *SHARED} or target == "__version__":
            return found  # the package's own __init__ and __main__ give the public API
        if target not in {*RANK, *SHARED}:
            if package != "cli":
                found.append(f"{package} must not import {target or 'icrtool'} from the public API")
        elif not _may_import(package, target):
            found.append(f"{package} must not import {target}")
        return found
    if package == "kernels" and top not in KERNEL_LIBRARIES | sys.stdlib_module_names:
        found.append(f"kernels must not import {top}")
    if (home := ONLY_IN.get(top)) and package not in {home, "kernels"}:
        found.append(f"{package} must not import {top}: only {home} does")
    if top in LATE_LIBRARIES and package != "kernels" and one.at_start:
        found.append(f"{package} must not import {top} at module level: import it in the function that needs it")
    return found


def circle_among(modules: dict[str, str]) -> list[str]:
    """Return the modules of an import circle, imports for types only included; empty where there is none.

    `modules` maps dotted module names to their sources.
    """
    graph: dict[str, set[str]] = {}
    for name, source in modules.items():
        package = name if f"{name}.__init__" in modules else name.rpartition(".")[0]
        # `from icrtool.a import b` may name the module b
        targets = {target for one in imports_of(source, package) for target in (one.module, *one.names)}
        file = f"{name.removeprefix('icrtool.').replace('.', '/')}.py"
        graph[name] = {
            target
            for target in targets
            if target in modules and target != name and (file, target) not in METHODS_THAT_IMPORT_UPWARDS
        }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as err:
        return list(err.args[1])
    return []


ENTRY_POINTS = {"main"}
"""Functions that each process has one of; nobody imports them."""


def defined_names(source: str) -> tuple[list[str], list[str]]:
    """Return the upper-case constants and the public functions that a module defines at its top level."""
    constants: list[str] = []
    functions: list[str] = []
    todo: list[ast.stmt] = list(tree_of(source).body)
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If | ast.Try):
            todo += [*node.body, *node.orelse]
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            functions.append(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
            constants += [name for name in names if name.strip("_").isupper()]
    return constants, [name for name in functions if not name.startswith("_") and name not in ENTRY_POINTS]


def names_with_two_meanings(modules: dict[str, str]) -> list[str]:
    """Return the constants and public functions that several modules define, a sentence each.

    A module that needs the constant of another one imports it: an equal value that is written twice is also a breach.
    """
    homes: dict[str, set[str]] = {}
    for module, source in modules.items():
        for name in (name for names in defined_names(source) for name in names):
            homes.setdefault(name, set()).add(module)
    return [
        f"{name} is defined in {', '.join(sorted(found))}: give each meaning its name, or import it"
        for name, found in sorted(homes.items())
        if len(found) > 1
    ]


MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))


@pytest.fixture(scope="module", params=MODULES, ids=str)
def module(request: pytest.FixtureRequest) -> Path:
    """Each module in turn: pytest runs the tests of one after the other, so that it is parsed once."""
    return request.param


def test_module_keeps_to_its_layer(module: Path) -> None:
    assert not (found := breaches(module, (PACKAGE / module).read_text(encoding="utf-8"))), "\n".join(found)


def test_no_imports_go_in_a_circle() -> None:
    sources = {
        ".".join(("icrtool", *path.with_suffix("").parts)): (PACKAGE / path).read_text(encoding="utf-8")
        for path in MODULES
        if path.name not in {"__init__.py", "__main__.py"}
    }
    assert (circle := circle_among(sources)) == [], " imports ".join(circle)


def test_a_name_has_one_meaning_in_the_package() -> None:
    sources = {str(path): (PACKAGE / path).read_text(encoding="utf-8") for path in MODULES}
    assert not (found := names_with_two_meanings(sources)), "\n".join(found)


@pytest.mark.parametrize(
    ("one", "other", "name"),
    [
        ("WIDTH_M = 0.5", "WIDTH_M = 0.6", "WIDTH_M"),
        ("WIDTH_M = 0.5", "WIDTH_M: float = 0.5", "WIDTH_M"),
        ("LEAST, MOST = 1, 2", "if True:\n    MOST = 3", "MOST"),
        ("_CHUNK = 6", "_CHUNK = 5", "_CHUNK"),
        ("def save(): ...", "def save(): ...", "save"),
    ],
)
def test_a_name_with_two_meanings_is_found(one: str, other: str, name: str) -> None:
    [sentence] = names_with_two_meanings({"a.py": one, "b.py": other})
    assert sentence.startswith(f"{name} is defined in a.py, b.py")


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("WIDTH_M = 0.5", "from a import WIDTH_M"),
        ("def main(): ...", "def main(): ..."),
        ("def _row(): ...", "def _row(): ..."),
        ("LEAST = 1\nLEAST = 2", "def f():\n    LEAST = 3"),
    ],
)
def test_a_name_that_is_imported_or_local_has_one_meaning(one: str, other: str) -> None:
    assert names_with_two_meanings({"a.py": one, "b.py": other}) == []


def test_a_circle_of_types_is_found() -> None:
    types = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from icrtool.a.one import One"
    assert circle_among({"icrtool.a.one": "from icrtool.a import two", "icrtool.a.two": types})


def presets_compared(source: str) -> list[int]:
    """Return the lines of comparisons of a preset with its name: what presets differ in is a field of their record."""
    return [
        node.lineno
        for node in ast.walk(tree_of(source))
        if isinstance(node, ast.Compare)
        and isinstance(node.comparators[0], ast.Constant)
        and isinstance(node.comparators[0].value, str)
        and ast.unparse(node.left).rpartition(".")[2].startswith("preset")
    ]


def test_no_module_asks_for_the_name_of_the_preset(module: Path) -> None:
    assert presets_compared((PACKAGE / module).read_text(encoding="utf-8")) == []


def test_a_preset_compared_with_its_name_is_found() -> None:
    assert presets_compared('x = 1\nif config.filter.preset != "paper":\n    x = 2') == [2]


@pytest.mark.parametrize(
    ("module", "source", "sentence"),
    [
        ("kernels/ekf.py", "import pandas as pd", "kernels must not import pandas"),
        ("kernels/ekf.py", "from scipy.stats import chi2", "kernels must not import scipy"),
        (
            "kernels/ekf.py",
            "def f():\n    from icrtool.records.tables import States",
            "kernels must not import records",
        ),
        ("kernels/ekf.py", "if TYPE_CHECKING:\n    import pandas", "kernels must not import pandas"),
        ("records/run.py", "from icrtool.estimation import fit", "records must not import estimation"),
        ("config.py", "from icrtool import logs", "config must not import logs"),
        ("logs/bag.py", "from ..estimation.fit import fit", "logs must not import estimation"),
        ("logs/bag.py", "from icrtool import fit", "logs must not import fit from the public API"),
        ("logs/bag.py", "import icrtool", "logs must not import icrtool from the public API"),
        ("alignment/delays.py", "import icrtool.logs.bag", "alignment must not import logs"),
        ("estimation/fit.py", "import matplotlib.pyplot as plt", "estimation must not import matplotlib: only output"),
        ("estimation/fit.py", "import click", "estimation must not import click: only cli does"),
        ("output/figures/filter_estimates.py", "from icrtool.cli import fit", "output must not import cli"),
        ("output/figures/filter_estimates.py", "import click", "output must not import click: only cli does"),
        ("cli/fit.py", "import matplotlib", "cli must not import matplotlib: only output does"),
        ("output/run.py", "try:\n    import pandas\nexcept ImportError:\n    pass", "output must not import pandas at"),
        ("records/run.py", "from icrtool.output.run_directory import write_run", "records must not import output"),
        ("records/run.py", "import importlib\nimportlib.import_module('icrtool.output')", "imports what no test sees"),
        ("logs/bag.py", "from pkgutil import resolve_name\nresolve_name('icrtool.cli')", "imports what no test sees"),
        ("logs/utils.py", "", "a module is named utils"),
        ("helpers/bag.py", "", "a module is named helpers"),
        ("logs/bag.py", "\n" * (LONGEST_MODULE_LINES + 1), "lines are more than"),
    ],
)
def test_a_breach_is_reported_in_a_sentence(module: str, source: str, sentence: str) -> None:
    assert any(sentence in found for found in breaches(Path(module), source))


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("kernels/ekf.py", "import math\nimport numba\nimport numpy as np\nfrom . import angles"),
        ("records/run.py", "if TYPE_CHECKING:\n    import pandas as pd"),
        ("records/run.py", "def write():\n    from icrtool.output.run_directory import write_run"),
        ("cli/commands.py", "from importlib import import_module\nimport_module('icrtool.cli.fit')"),
        ("logs/bag.py", "from icrtool.kernels.gather import gather\nfrom icrtool.errors import LogError"),
        ("estimation/fit.py", "def frame():\n    import pandas as pd"),
        ("output/run.py", "from matplotlib.figure import Figure\nfrom icrtool.estimation.fit import fit"),
        ("cli/__init__.py", "import click\nfrom icrtool import __version__, read_log"),
    ],
)
def test_what_is_allowed_is_not_reported(module: str, source: str) -> None:
    assert breaches(Path(module), source) == []
