"""Results on standard output: tables by rich on a terminal, plain text elsewhere."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import click

from icrtool.output.text_blocks import Line, Table, Text, narrowed

if TYPE_CHECKING:
    from rich.console import Console, JustifyMethod
    from rich.table import Table as RichTable

WIDEST = 120
"""Columns of a terminal that are used."""

FEWEST_COLUMNS = 3
"""Columns of a table that stay on the narrowest terminal."""

STYLES = {"title": "bold", "good": "green", "bad": "bold red", "as is": ""}


def show(text: str) -> None:
    """Print a result. ``NO_COLOR`` and ``TERM=dumb`` are respected; nothing in the text is read as markup."""
    if not isinstance(text, Text) or not sys.stdout.isatty() or os.environ.get("TERM") == "dumb":
        click.echo(text)
        return
    from rich.console import Console

    console = Console(force_terminal=True, highlight=False, markup=False, emoji=False)
    console.width = min(console.width, WIDEST)
    _print(text, console)


def _print(text: Text, console: Console) -> None:
    from rich.table import Table as RichTable
    from rich.text import Text as RichText

    for block in text.blocks:
        if isinstance(block, Line):
            console.print(RichText(block.text, STYLES[block.look]), soft_wrap=block.look == "as is")
        elif isinstance(block, str):
            console.print(RichText(str(block)))
        else:
            table, left_out = _fitting(narrowed(block, console.width), console.width)
            console.print(_rich_table(table, RichTable(box=None, pad_edge=False, show_header=bool(table.head))))
            if left_out:
                why = f"the terminal has {console.width} columns"
                console.print(RichText(f"  ({', '.join(left_out)} left out: {why})", "dim"))


def _fitting(table: Table, width: int) -> tuple[Table, list[str]]:
    """Return a table of numbers without the columns that a terminal has no place for, and their names.

    The first and the last one stay; a last column of text is wrapped and needs no more than a few words.
    """
    sides, rows = table.sides(), [[str(cell) for cell in row] for row in (table.head, *table.rows) if row]
    sizes = [max(map(len, column)) + 2 for column in zip(*rows, strict=True)]
    if sides[-1] == "l":
        sizes[-1] = min(sizes[-1], width // 4)
    kept, left_out = list(range(len(sides))), []
    while sum(sizes[column] for column in kept) - 2 > width and len(kept) > FEWEST_COLUMNS:
        out = kept.pop(len(kept) // 2)
        left_out.append(str(table.head[out]) if table.head else f"column {out + 1}")
    if not left_out:
        return table, []
    chosen = [[row[column] for column in kept] for row in table.rows]
    head = [table.head[column] for column in kept] if table.head else ()
    return Table("".join(sides[column] for column in kept), chosen, head), left_out


def _rich_table(table: Table, shown: RichTable) -> RichTable:
    from rich.text import Text as RichText

    sides = table.sides()
    for number, side in enumerate(sides):
        head = RichText(str(table.head[number])) if table.head else ""
        justify: JustifyMethod = "left" if side == "l" else "right"
        # A sentence, in the last column, is wrapped; a name or a number is not broken.
        last = number == len(sides) - 1
        shown.add_column(
            head, justify=justify, no_wrap=not last or side == "r", header_style="bold", style="" if number else "cyan",
            overflow="fold" if last else "ellipsis",
        )  # fmt: skip
    for row in table.rows:
        shown.add_row(*(RichText(str(cell)) for cell in row))
    return shown
