"""Printed text: sentences and tables; plain here, and by `icrtool.cli.terminal` on a terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Sequence
from typing import Literal, NamedTuple, Self

TEXT_WIDTH = 100
"""Characters in a line of plain text."""

LABEL = 10
"""Width of the labels of `labelled` rows."""

Look = Literal["title", "good", "bad", "as is"]


class Line(NamedTuple):
    """A line that is more than a sentence: a title, a verdict, or what is copied and so is never wrapped."""

    text: str
    look: Look


class Table(NamedTuple):
    """Cells in columns; the last column is wrapped where it is text and too wide.

    Attributes
    ----------
    align : ``l`` or ``r`` for each column; the last one holds for the columns after it too
    rows : as many cells in each
    head : names of the columns; empty: none
    """

    align: str
    rows: Sequence[Sequence[str]]
    head: Sequence[str] = ()

    def sides(self) -> str:
        """Return ``l`` or ``r`` for every column."""
        columns = len(self.head or next(iter(self.rows), ()))
        return self.align.ljust(columns, self.align[-1])[:columns]


Block = str | Line | Table
"""A `str` is a sentence; what follows its first line is indented by two more characters."""


class Text(str):
    """Plain text that knows its sentences and tables.

    Attributes
    ----------
    blocks : of which it is made
    """

    blocks: tuple[Block, ...]

    def __new__(cls, blocks: Iterable[Block]) -> Self:
        """Return `blocks` as plain text, at most `TEXT_WIDTH` wide where it can be wrapped; no line end."""
        blocks = tuple(blocks)
        self = super().__new__(cls, "\n".join(line.rstrip() for block in blocks for line in _lines(block)))
        self.blocks = blocks
        return self


def labelled(rows: Iterable[tuple[str, str]]) -> list[Table]:
    """Return rows of a label and a sentence as a table, whose sentences begin in one column; no rows: no table."""
    padded = [(label.ljust(LABEL), text) for label, text in rows]
    return [Table("l", padded)] if padded else []


def _lines(block: Block) -> Iterable[str]:
    if isinstance(block, Table):
        return _table_lines(block)
    if isinstance(block, Line):
        return block.text.split("\n")
    indent = " " * (len(block) - len(block.lstrip()) + 2)
    return _wrap(str(block), "", indent) or [""]


def _table_lines(table: Table) -> Iterator[str]:
    rows = [[str(cell) for cell in row] for row in ((table.head, *table.rows) if table.head else table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = table.sides()
    for row in rows:
        *first, last = (
            cell.ljust(width) if side == "l" else cell.rjust(width)
            for cell, width, side in zip(row, widths, sides, strict=True)
        )
        lead = "".join(f"{cell}  " for cell in first)
        if sides[-1] == "l" and len(lead) < TEXT_WIDTH // 2:
            yield from _wrap(last.rstrip(), lead, " " * len(lead)) or [lead]
        else:
            yield lead + last


def _wrap(text: str, first: str, later: str) -> list[str]:
    return textwrap.wrap(
        text, TEXT_WIDTH, initial_indent=first, subsequent_indent=later, break_long_words=False, break_on_hyphens=False
    )
