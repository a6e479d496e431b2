"""Results on standard output: tables by rich on a terminal, plain text elsewhere."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import click

from icrtool.output.text_blocks import Line, Table, Text

if TYPE_CHECKING:
    from rich.console import Console, JustifyMethod
    from rich.table import Table as RichTable

WIDEST = 120
"""Columns of a terminal that are used."""

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
            console.print(_rich_table(block, RichTable(box=None, pad_edge=False, show_header=bool(block.head))))


def _rich_table(table: Table, shown: RichTable) -> RichTable:
    from rich.text import Text as RichText

    sides = table.sides()
    for number, side in enumerate(sides):
        head = RichText(str(table.head[number])) if table.head else ""
        justify: JustifyMethod = "left" if side == "l" else "right"
        # A name is cut rather than broken into lines; a sentence, in the last column, is wrapped.
        last = number == len(sides) - 1
        shown.add_column(
            head, justify=justify, no_wrap=not last, header_style="bold", style="" if number else "cyan",
            overflow="fold" if last else "ellipsis",
        )  # fmt: skip
    for row in table.rows:
        shown.add_row(*(RichText(str(cell)) for cell in row))
    return shown
