"""Findings are data: no module searches in their texts, and each code is explained, used and on docs/warnings.md."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from icrtool.records.note_catalogue import CATALOGUE, GROUPS
from support.scripts import load_script
from support.sources import tree_of

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "icrtool"
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.name not in {"note_catalogue.py", "log_codes.py"})

TEXTS = {"warnings", "sentence", "sentences", "unusable_because", "reason"}
"""Attributes that hold the text of findings, or several."""

NOTES = {"notes", "problems", "warnings", "sentences"}
"""Attributes and variables that hold several findings, or texts of them."""

SEARCHES = {"startswith", "endswith", "find", "rfind", "index", "count", "removeprefix", "removesuffix"}
"""Methods of texts by which a program asks what stands in them."""

MATCHES = {"match", "search", "fullmatch", "findall", "finditer"}
"""Functions of `re` that do."""


def name_of(node: ast.expr) -> str:
    """The last name of a variable or attribute, else empty."""
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def members_of(loop: ast.For | ast.comprehension) -> set[str]:
    """The variables that a loop over findings, or over their texts, binds."""
    parts = [part for part in ast.walk(loop.iter) if isinstance(part, ast.expr)]
    names = {one.id for one in ast.walk(loop.target) if isinstance(one, ast.Name)}
    return names if any(name_of(part) in NOTES for part in parts) else set()


def is_text(node: ast.expr, members: set[str]) -> bool:
    """Whether a value is the text of a finding, or made of it by a method; `members`: variables of loops around it."""
    if isinstance(node, ast.Attribute):
        return node.attr in TEXTS or (node.attr == "text" and name_of(node.value) in members | {"note"})
    if isinstance(node, ast.Name):
        return node.id in NOTES | members
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Attribute) and is_text(node.func.value, members)
    return isinstance(node, ast.Subscript) and is_text(node.value, members)


def is_search(node: ast.AST, members: set[str]) -> bool:
    """Whether a comparison or call asks what the text of a finding is, or holds."""
    if isinstance(node, ast.Compare):
        parts = [node.left, *node.comparators]
        searched = type(node.ops[0]).__name__.endswith("In") and is_text(node.comparators[0], members)
        words = any(isinstance(ast.literal_eval(one), str) for one in parts if isinstance(one, ast.Constant))
        return searched or (words and any(is_text(part, members) for part in parts))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        if node.func.attr in SEARCHES:
            return is_text(node.func.value, members)
        return node.func.attr in MATCHES and any(is_text(part, members) for part in (node.func.value, *node.args))
    return False


def texts_searched(source: str) -> list[int]:
    """Return the lines in which a module compares or searches in the text of a finding."""
    found: list[int] = []

    def visit(node: ast.AST, members: set[str]) -> None:
        loops = [node] if isinstance(node, ast.For) else getattr(node, "generators", [])
        members = members.union(*map(members_of, loops))
        if isinstance(node, ast.expr) and is_search(node, members):
            found.append(node.lineno)
        for child in ast.iter_child_nodes(node):
            visit(child, members)

    visit(tree_of(source), set())
    return found


@pytest.fixture(scope="module", params=MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def module(request: pytest.FixtureRequest) -> Path:
    """Each module in turn: pytest runs the tests of one after the other, so that it is parsed once."""
    return request.param


def test_no_module_searches_in_the_text_of_a_finding(module: Path) -> None:
    assert texts_searched(module.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "source",
    [
        'next((one for one in warnings if CUT_OFF in one), "")',
        'plain = [one.removeprefix(f"{log}: ") for one in summary.warnings]',
        'reasons = [one for one in calibration.warnings if one.startswith("not usable")]',
        "found = [note for note in notes if OPPOSITE_SENSE in note]",
        "found = [note for note in notes if OPPOSITE_SENSE in note.text]",
        'next((one for one in excitation.sentences if "drive two full turns" in one), "")',
        'cause = row.reason.removeprefix("not usable: ")',
        'is_cut = row.reason.lower().startswith("truncated")',
        'for one in run.notes:\n    if re.search("cut", one.sentence):\n        pass',
        'if run.document.unusable_because == "ends inverted":\n    pass',
        'if "cut off" in run.warnings[0]:\n    pass',
    ],
)
def test_a_search_in_the_text_of_a_finding_is_found(source: str) -> None:
    assert texts_searched(source)


@pytest.mark.parametrize(
    "source",
    [
        'cut = next((one.sentence for one in notes if one.code == "log_cut_off"), "")',
        "texts = [one.text for one in summary.notes if not is_grave(one)]",
        'shown = "; ".join(run.warnings)',
        "if run.document.unusable_because is None:\n    pass",
        "if found not in self._held:\n    pass",
    ],
)
def test_codes_and_grades_may_be_compared(source: str) -> None:
    assert texts_searched(source) == []


def code_arguments(source: str) -> Iterator[ast.expr]:
    """Yield what a module gives as a code: to `note`, to `report` of a container, to `stop` of what it unpacks."""
    for node in ast.walk(tree_of(source)):
        if isinstance(node, ast.Call) and node.args and name_of(node.func) in {"note", "report", "stop"}:
            one = node.args[0]
            if name_of(node.func) == "note" or len(node.args) == 2:
                yield one


def test_each_code_of_a_finding_is_explained(module: Path) -> None:
    given = [one.value for one in code_arguments(module.read_text(encoding="utf-8")) if isinstance(one, ast.Constant)]
    assert [code for code in given if code not in CATALOGUE] == []


def test_each_code_that_is_explained_is_used() -> None:
    # Most modules name no code and are not parsed.
    sources = [module.read_text(encoding="utf-8") for module in MODULES]
    words = {
        node.value
        for source in sources
        if CATALOGUE.keys() & set(re.findall(r'"(\w+)"', source))
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert sorted(CATALOGUE.keys() - words) == []


def test_codes_are_words_and_each_stands_in_one_group() -> None:
    codes = [code for group in GROUPS.values() for code in group]
    assert len(codes) == len(set(codes))
    assert [code for code in codes if not re.fullmatch(r"[a-z]+(_[a-z]+)*", code)] == []
    assert {entry.grade for entry in GROUPS["Do not use this run"].values()} == {"grave"}


def test_each_explanation_is_of_whole_sentences() -> None:
    parts = [part for entry in CATALOGUE.values() for part in (entry.cause, entry.consequence, entry.action)]
    assert [part for part in parts if not (part[:1].isupper() or part[:1] == "`" or part.startswith("x_icr"))] == []
    assert [part for part in parts if not part.endswith(".")] == []


def test_the_page_of_warnings_is_that_of_the_catalogue() -> None:
    script = load_script("warning_codes")
    page = script.PAGE.read_text(encoding="utf-8")
    assert page == script.page(), "run make schemas"
    assert re.findall(r"^### `(\w+)`$", page, re.MULTILINE) == list(CATALOGUE)
