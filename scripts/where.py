"""Where something is in the code: ``python scripts/where.py [WORD ...]``, or ``make where WORDS="innovation gate"``.

Prints the place of each module, class, function and constant of `icrtool` whose name or first line has all the words.
Without a word it prints the modules.
"""

from __future__ import annotations

import ast
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]


class Place(NamedTuple):
    """A module, or what it defines: path and line, name (empty of a module), first line of its docstring."""

    path: str
    line: int
    name: str
    text: str

    def has(self, words: list[str]) -> bool:
        """Return whether name and text, or the path of a module, have all the words, in any case."""
        named = self.name or self.path
        text = f"{named} {named.replace('_', ' ')} {self.text}".lower()
        return all(word.lower() in text for word in words)


def first_line(text: str | None) -> str:
    """Return the first line of a docstring, empty without one."""
    return (text or "").strip().partition("\n")[0]


def places_in(path: str, source: str) -> Iterator[Place]:
    """Yield a module, then its classes, functions, methods and constants with a docstring, in order."""
    tree = ast.parse(source)
    yield Place(path, 1, "", first_line(ast.get_docstring(tree)))
    for node, after in itertools.pairwise([*tree.body, ast.Pass()]):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            inside = node.body if isinstance(node, ast.ClassDef) else ()
            for one in (node, *inside):
                if isinstance(one, ast.FunctionDef | ast.ClassDef):
                    name = one.name if one is node else f"{node.name}.{one.name}"
                    yield Place(path, one.lineno, name, first_line(ast.get_docstring(one)))
        elif isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(after, ast.Expr):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
                yield Place(path, node.lineno, ast.unparse(target), first_line(after.value.value))


def find(words: list[str]) -> Iterator[Place]:
    """Yield what has all the words, the modules alone where there is none."""
    for path in sorted((ROOT / "icrtool").rglob("*.py")):
        name, source = path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        # Most sources lack a word: they are not parsed.
        text = f"{name} {source}".lower().replace("_", " ")
        if all(word.lower().replace("_", " ") in text for word in words):
            places = places_in(name, source)
            yield from (place for place in places if place.has(words)) if words else itertools.islice(places, 1)


if __name__ == "__main__":
    for place in find(sys.argv[1:]):
        print(f"{place.path}:{place.line}: {place.name}{': ' if place.name else ''}{place.text}")
