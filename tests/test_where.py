"""``make where`` finds modules, functions and constants by the words of their first lines."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from support.scripts import load_script

ROOT = Path(__file__).resolve().parents[1]
SOURCE = '''"""Sliding of wheels on ice."""

LARGEST_M = 2.0
"""Largest step [m] of a reference."""

OTHER = 1


class Gate:
    """A limit."""

    def has(self):
        """Return whether it holds."""


def drift(x):
    """Return the drift.

    More of it.
    """
'''


@pytest.fixture(scope="module")
def where() -> Any:
    return load_script("where")


def test_what_a_module_defines_is_listed_with_its_line_and_first_line(where: Any) -> None:
    assert [tuple(one) for one in where.places_in("a.py", SOURCE)] == [
        ("a.py", 1, "", "Sliding of wheels on ice."),
        ("a.py", 3, "LARGEST_M", "Largest step [m] of a reference."),
        ("a.py", 9, "Gate", "A limit."),
        ("a.py", 12, "Gate.has", "Return whether it holds."),
        ("a.py", 16, "drift", "Return the drift."),
    ]


def test_a_place_is_found_by_words_of_its_name_and_of_its_line(where: Any) -> None:
    place = where.Place("icrtool/a.py", 3, "LARGEST_M", "Largest step [m] of a reference.")
    assert place.has(["STEP", "largest_m"])
    assert not place.has(["step", "icrtool"])
    assert where.Place("icrtool/a.py", 1, "", "Sliding.").has(["icrtool/a", "sliding"])


def test_every_module_is_listed_and_has_a_first_line(where: Any) -> None:
    modules = list(where.find([]))
    assert {one.path for one in modules} == {
        path.relative_to(ROOT).as_posix() for path in (ROOT / "icrtool").rglob("*.py")
    }
    assert not [one.path for one in modules if not one.text]


def test_the_architecture_page_shows_where_a_function_is(where: Any) -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    command, shown = page.partition("$ make where WORDS=")[2].splitlines()[:2]
    (place,) = where.find([command])
    assert shown.startswith(f"{place.path}:")
    assert f" {place.name}: " in shown


def test_the_script_prints_place_name_and_line() -> None:
    done = subprocess.run(
        [sys.executable, "scripts/where.py", "decide_jumps"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("icrtool/alignment/reference_motion.py:")
    assert ": decide_jumps: " in done.stdout
