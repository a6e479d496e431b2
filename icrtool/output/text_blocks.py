"""Blocks: the content of a document in one form; laid out as text and Markdown here, in a terminal, and on a page.

A document (a run, a report, a comparison) is a list of blocks. The code that lays blocks out (here, in
`icrtool.cli.printing` and `icrtool.output.page`) does not depend on runs or reports. A document lists all possible
blocks; empty blocks are left out of the layout (`filled_blocks`).
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

from icrtool.records.text import escaped, shortened

TEXT_WIDTH = 100
"""Largest number of characters in a line of plain text."""

BRIEF_WIDTH, BRIEF_LINES = 80, 2
"""Largest number of columns of a brief answer, and of lines of a labelled sentence in it."""

MOST_ITEMS = 4
"""Largest number of sentences of a list in a brief answer."""

LABEL = 10
"""Number of characters of the labels of sentences; two blanks follow."""

NARROWEST, NARROWEST_LAST = 8, 12
"""Smallest width of a shortened cell of text in a table that is too wide, and of a wrapped last column [characters]."""

Look = Literal["title", "good", "bad", "as is"]
"""Look of a line."""

Grade = Literal["good", "care", "bad", "fact"]
"""Grade of a check."""

BRIEF, VERBOSE, PAGE = 0, 1, 2
"""Depth of a section: always shown; with -v, and folded on a page; only on a page."""


class Title(NamedTuple):
    """Subject of a document, and the amount of its data. `about` is a sentence that only a wide page shows."""

    text: str
    facts: str
    about: str = ""


class Line(NamedTuple):
    """A line that is not a plain sentence: a title, a verdict, or a text to copy, which is never wrapped."""

    text: str
    look: Look


class Cell(NamedTuple):
    """A cell with a first and a second number, and further lines; a brief table has only the first number.

    Attributes
    ----------
    order : sort key of the cell on a page, where "" is last; None: the text is the key
    link, note : on a page, target of its link, and text shown when the pointer is on it
    """

    text: str
    aside: str = ""
    more: tuple[str, ...] = ()
    order: float | str | None = None
    link: str = ""
    note: str = ""

    def lines(self) -> tuple[str, ...]:
        """Return the lines of the cell; second numbers are aligned in a column."""
        return (f"{self.text} {self.aside:>7}" if self.aside else self.text, *self.more)


class Table(NamedTuple):
    """Cells in columns; the last column is wrapped where it is text and too wide.

    Attributes
    ----------
    align : ``l`` or ``r`` for each column; the last one holds for the columns after it too
    rows : one cell for each column; a row of a searched table may have fewer cells, of which the last is a sentence
    head : names of the columns; empty: none
    caption : sentence about the content
    moments : start of each row [s], which a page shows on its map; empty: no times
    search : for each row the `words` that a page searches, and by name the values for its lists of choices. A page also
        sorts such a table; empty: it does neither
    folded : names of the columns that a page shows only after a click
    """

    align: str
    rows: Sequence[Sequence[str | Cell]]
    head: Sequence[str] = ()
    caption: str = ""
    moments: Sequence[float] = ()
    search: Sequence[Mapping[str, str]] = ()
    folded: Sequence[str] = ()

    def sides(self) -> str:
        """Return ``l`` or ``r`` for every column."""
        columns = len(self.head or next(iter(self.rows), ()))
        return self.align.ljust(columns, self.align[-1])[:columns]

    def lines(self, *, brief: bool = False) -> list[list[str]]:
        """Return the rows as texts, several of a row whose cells have several lines."""
        rows = []
        for row in self.rows:
            cells = [
                ((cell.text,) if brief else cell.lines()) if isinstance(cell, Cell) else (str(cell),) for cell in row
            ]
            depth = max(map(len, cells))
            rows += [[cell[line] if line < len(cell) else "" for cell in cells] for line in range(depth)]
        return rows


class Facts(NamedTuple):
    """Labelled sentences. A sentence without a label continues the sentence above it; an empty sentence is left out.

    Attributes
    ----------
    label : common label of all sentences; names and numbers then stand in two columns
    """

    rows: Sequence[tuple[str, str]]
    label: str = ""


class Check(NamedTuple):
    """A check and its finding; `more` has the details. A fact is a check that is neither good nor bad."""

    grade: Grade
    name: str
    text: str
    more: tuple[str, ...] = ()


class Checks(NamedTuple):
    """A list of checks."""

    rows: Sequence[Check]


class Items(NamedTuple):
    """Sentences as a list."""

    texts: Sequence[str]


class Chart(NamedTuple):
    """A drawing of a page's script in the element `name`, with its title and caption."""

    name: str
    title: str
    caption: str


class Figure(NamedTuple):
    """Figures of `icrtool.output.figure_catalogue`.

    Attributes
    ----------
    names : beginnings of the names of its pictures
    drawing : template of the drawing that a page's scripts make in place of the pictures; empty: none
    charts : charts of this drawing
    folded : whether a page shows only the titles of its pictures at first
    """

    names: tuple[str, ...]
    drawing: str = ""
    charts: tuple[Chart, ...] = ()
    folded: bool = True


class Section(NamedTuple):
    """Blocks under a title.

    Attributes
    ----------
    lead, text : the answer in a few words, and the rest of its sentence
    label : label of lead and text in a brief answer; empty: they are not printed there
    name : name of its place on a page
    """

    title: str
    blocks: Sequence[Block]
    depth: int = BRIEF
    lead: str = ""
    text: str = ""
    label: str = ""
    grade: Grade = "fact"
    name: str = ""


Block = str | Title | Line | Table | Facts | Checks | Items | Figure | Section
"""Any block. A `str` is a sentence; its lines after the first are indented by two more characters."""

Printed = str | Line | Table
"""Parts of a document that are printed."""


def filled_blocks(blocks: Iterable[Block]) -> Iterator[Block]:
    """Yield the blocks that are not empty, after empty sentences of facts are left out."""
    for block in blocks:
        match block:
            case Section():
                if (inner := list(filled_blocks(block.blocks))) or block.lead:
                    yield block._replace(blocks=inner)
            case Facts():
                if rows := [row for row in block.rows if row[1]]:
                    yield block._replace(rows=rows)
            case Line(text=content) | Table(rows=content) | Checks(rows=content) | Items(texts=content) if not content:
                pass
            case _:
                yield block


def format_blocks(blocks: Iterable[Block], *, verbose: bool = True) -> str:
    """Return a document as plain text without the last line end, wrapped to `TEXT_WIDTH` where possible."""
    lines: list[str] = []
    for block in printed_parts(blocks, verbose=verbose):
        if isinstance(block, Table):
            lines += _table_lines(block)
        elif isinstance(block, Line):
            lines += block.text.split("\n")
        else:
            lines += _wrap(str(block), "", " " * (len(block) - len(block.lstrip()) + 2)) or [""]
    return "\n".join(line.rstrip() for line in lines)


GRADE_LOOKS: dict[Grade, Look] = {"good": "good", "care": "as is", "bad": "bad", "fact": "as is"}
GRADE_MARKS: dict[Grade, str] = {"good": "ok", "care": "!", "bad": "!", "fact": ""}
"""Look of a line, and mark before it, by the grade of a check."""


def printed_parts(blocks: Iterable[Block], *, verbose: bool) -> Iterator[Printed]:
    """Yield the printed parts of a document: the brief answer in `BRIEF_WIDTH`, or all parts that are not page-only."""
    for block in filled_blocks(blocks):
        if isinstance(block, str | Line):
            yield block
        elif isinstance(block, Title):
            name = shortened(block.text, TEXT_WIDTH if verbose else BRIEF_WIDTH)
            if verbose or len(name) + 3 + len(block.facts) <= BRIEF_WIDTH:
                yield Line(f"{name}   {block.facts}", "title")
            else:
                yield from (Line(name, "title"), Line(f"{'':{LABEL + 2}}{block.facts}", "as is"))
        elif isinstance(block, Facts | Checks):
            for first, text, most in _labelled(block, verbose):
                yield _sentence(first, text, most, verbose=verbose)
        elif isinstance(block, Items):
            most = len(block.texts) if verbose else MOST_ITEMS
            yield from list(block.texts)[:most]
            yield from [f"and {len(block.texts) - most} more: -v"] if len(block.texts) > most else []
        elif isinstance(block, Section):
            yield from _printed_section(block, verbose) if block.depth <= (VERBOSE if verbose else BRIEF) else ()
        elif isinstance(block, Table):
            yield from [Line(block.caption, "as is" if verbose else "title")] if block.caption else []
            indent = "   " if block.caption and not verbose else ""
            yield block._replace(rows=[(indent + row[0], *row[1:]) for row in block.lines(brief=not verbose)])


def _printed_section(section: Section, verbose: bool) -> Iterator[Printed]:
    """Yield the printed parts of a section: title, labelled answer, blocks."""
    if verbose and (section.blocks or section.label):
        yield ""
        yield from [Line(section.title, "title")] if section.title else []
    if section.label:
        label, text = f"{section.label:{LABEL + 2}}", f"{section.lead} {section.text}".strip()
        yield _sentence(label, text, 3, GRADE_LOOKS[section.grade], verbose=verbose)
    # A table does not repeat the title that was just printed as its caption.
    titled = section.title if verbose else ""
    yield from printed_parts(
        (
            part._replace(caption="") if isinstance(part, Table) and titled and part.caption == titled else part
            for part in section.blocks
        ),
        verbose=verbose,
    )


def _labelled(block: Facts | Checks, verbose: bool) -> Iterator[tuple[str, str, int]]:
    """Yield the label before each sentence, the sentence, and its largest number of lines in a brief answer."""
    if isinstance(block, Facts):
        widest = max((len(name) for name, _ in block.rows), default=0)
        for number, (name, text) in enumerate(block.rows):
            label = f"{'' if number else block.label:{LABEL + 2}}{name:{widest}}  "
            yield label if block.label else f"{name:{LABEL + 2}}", text, BRIEF_LINES
        return
    for number, row in enumerate(row for row in block.rows if verbose or row.grade != "fact"):
        first = f"{'' if number else 'checks':{LABEL + 2}}{GRADE_MARKS[row.grade]:4}{row.name:{LABEL + 3}}"
        yield first, row.text, 1 if row.grade == "good" else BRIEF_LINES
        yield from ((" " * len(first), more, BRIEF_LINES) for more in (row.more if verbose else ()))


def _sentence(first: str, text: str, most: int, look: Look = "as is", *, verbose: bool) -> Printed:
    """Return a sentence after its label, in at most `most` lines of a brief answer; no path is broken."""
    if verbose:
        return Table("l", [(first[:-2], text)])
    return Line("\n".join(_wrap(text, first, " " * len(first), BRIEF_WIDTH, most)) or first.rstrip(), look)


def fit_table(table: Table, width: int, fewest: int) -> tuple[Table, list[str]]:
    """Return a table with one line for each row, of a width where possible, and the columns that are left out.

    The widest cells of text are shortened first. Then columns are left out, from the middle, until `fewest` are left. A
    last column of text is wrapped, and needs the width of only a few words.
    """
    sides, head = table.sides(), [list(map(str, table.head))] if table.head else []
    rows = [*head, *table.lines()]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    if sides.endswith("l"):
        widths[-1] = min(widths[-1], NARROWEST_LAST)
    texts = [column for column, side in enumerate(sides[:-1]) if side == "l" and column]
    while texts and sum(widths) + 2 * (len(widths) - 1) > width:
        widest = max(texts, key=lambda column: widths[column])
        if widths[widest] <= NARROWEST:
            break
        widths[widest] -= 1
    columns_kept, left_out = list(range(len(widths))), []
    while (
        len(columns_kept) > fewest
        and sum(widths[column] for column in columns_kept) + 2 * (len(columns_kept) - 1) > width
    ):
        out = columns_kept.pop(len(columns_kept) // 2)
        left_out.append(head[0][out] if head else f"column {out + 1}")
    rows = [
        [shortened(row[column], widths[column]) if column in texts else row[column] for column in columns_kept]
        for row in rows
    ]
    align = "".join(sides[column] for column in columns_kept)
    return table._replace(align=align, rows=rows[len(head) :], head=rows[0] if head else ()), left_out


def _table_lines(table: Table) -> Iterator[str]:
    """Yield the lines of a table in columns; a last column of text is wrapped to `TEXT_WIDTH`."""
    sides = table.sides()
    table, _ = fit_table(table, TEXT_WIDTH, len(sides))
    rows = [[str(cell) for cell in row] for row in ((table.head, *table.rows) if table.head else table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        *first, last = (
            cell.ljust(width) if side == "l" else cell.rjust(width)
            for cell, width, side in zip(row, widths, sides, strict=True)
        )
        lead = "".join(f"{cell}  " for cell in first)
        if sides[-1] == "l" and len(lead) <= TEXT_WIDTH - 2 * NARROWEST_LAST:
            yield from _wrap(last.rstrip(), lead, " " * len(lead)) or [lead]
        else:
            yield lead + last


def _wrap(text: str, first: str, later: str, width: int = TEXT_WIDTH, most: int | None = None) -> list[str]:
    """Return a text in lines after `first` and `later`; words are not broken, and more than `most` lines are cut."""
    return textwrap.wrap(
        text, width, initial_indent=first, subsequent_indent=later, break_long_words=False, break_on_hyphens=False,
        max_lines=most, placeholder=" …",
    )  # fmt: skip


def format_markdown(blocks: Iterable[Block]) -> str:
    """Return a document as Markdown: a heading for each title and section, an item for each sentence."""
    return re.sub("\n{3,}", "\n\n", "\n".join(_markdown_lines(blocks))).strip() + "\n"


def _markdown_lines(blocks: Iterable[Block]) -> Iterator[str]:
    """Yield the lines of a document as Markdown."""
    for block in blocks:
        if isinstance(block, Title):
            yield from ("", f"## {_escaped_markdown(block.text)}", "", _escaped_markdown(block.facts), "")
            continue
        for part in printed_parts([block], verbose=True):
            if isinstance(part, Table):
                rows = [[_escaped_markdown(cell.strip()) for cell in row] for row in part.lines()]
                rule = ["---" if side == "l" else "---:" for side in part.sides()]
                head = map(_escaped_markdown, part.head)
                table = ["", *(f"| {' | '.join(row)} |" for row in (head, rule, *rows)), ""]
                yield from table if part.head else (f"- {' '.join(filter(None, row))}" for row in rows)
            elif isinstance(part, Line) and part.look == "title":
                yield from ("", f"### {_escaped_markdown(part.text)}", "")
            elif text := part.text if isinstance(part, Line) else part:
                yield f"- {_escaped_markdown(text)}"


def _escaped_markdown(text: str) -> str:
    """Return text with Markdown's markup characters escaped."""
    plain = re.sub(r"([\\`*_{}\[\]<>|#~&$])", r"\\\1", escaped(" ".join(text.split())))
    # GitHub and GitLab notify the user whose name follows an @, even after an escape. A word joiner prevents this.
    return plain.replace("@", "@\u2060")
