"""Sources of the package as trees, parsed once where tests that follow one another need the same one."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import lru_cache


@lru_cache(maxsize=4)
def tree_of(source: str) -> ast.Module:
    """Return the tree of a module's source; it must not be changed."""
    return ast.parse(source)


def statements_in(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the statements of a node's blocks, and what holds blocks in it: no expression, a tenth of all nodes."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.expr | ast.expr_context):
            yield child
