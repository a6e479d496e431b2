"""Output of a command: results as text or JSON on standard output; stages, warnings and errors on standard error.

Tables are laid out by rich on a terminal, and are plain text elsewhere.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import click

from icrtool import __version__
from icrtool.cli import lazy_imports
from icrtool.output.text_blocks import Block, Line, Table, fit_table, format_blocks, printed_parts
from icrtool.records.text import LONGEST_NAME, counted, escaped, listed, shortened

with lazy_imports():
    from icrtool import errors
    from icrtool.kernels import compiled
    from icrtool.output import text_format
    from icrtool.output.files import atomic, formats
    from icrtool.records import notes, plain_data, samples

if TYPE_CHECKING:
    import msgspec
    from rich.console import Console

    from icrtool.records.run import Run

CLEAR = "\r\x1b[K"
"""Control characters that clear the current line of a terminal."""

REFRESH_S = 0.1
"""Shortest time between two updates of the progress on a terminal [s]."""

WIDEST = 120
"""Largest used width of a terminal [characters]."""

FEWEST_COLUMNS = 3
"""Smallest number of columns of a table on a narrow terminal. Further columns are left out where they do not fit."""

TEXT_STYLES = {"title": "bold", "good": "green", "bad": "bold red", "as is": ""}
"""Styles of rich by the look of a line."""


def print_document(blocks: Iterable[Block], *, verbose: bool) -> None:
    """Print a document. ``NO_COLOR`` and ``TERM=dumb`` are respected; its text is not read as markup."""
    if not sys.stdout.isatty() or os.environ.get("TERM") == "dumb":
        click.echo(format_blocks(blocks, verbose=verbose))
        return
    from rich.console import Console
    from rich.text import Text as RichText

    console = Console(force_terminal=True, highlight=False, markup=False, emoji=False)
    console.width = min(console.width, WIDEST)
    for block in printed_parts(blocks, verbose=verbose):
        if isinstance(block, Table):
            _print_table(block, console)
        elif isinstance(block, Line):
            console.print(RichText(block.text, TEXT_STYLES[block.look]), soft_wrap=block.look == "as is")
        else:
            console.print(RichText(str(block)))


def _print_table(block: Table, console: Console) -> None:
    """Print a table on a terminal; columns that do not fit are left out and named."""
    from rich.table import Table as RichTable
    from rich.text import Text as RichText

    table, left_out = fit_table(block, console.width, FEWEST_COLUMNS)
    shown = RichTable(box=None, pad_edge=False, show_header=bool(table.head))
    sides = table.sides()
    for number, side in enumerate(sides):
        head = RichText(str(table.head[number])) if table.head else ""
        # Only the last column is wrapped, because it may hold a sentence.
        last = number == len(sides) - 1
        shown.add_column(
            head, justify="left" if side == "l" else "right", no_wrap=not last or side == "r", header_style="bold",
            style="" if number else "cyan", overflow="fold" if last else "ellipsis",
        )  # fmt: skip
    for row in table.rows:
        shown.add_row(*(RichText(str(cell)) for cell in row))
    console.print(shown)
    if left_out:
        why = f"the terminal has {console.width} columns"
        console.print(RichText(f"  ({', '.join(left_out)} left out: {why})", "dim"))


def write_or_print(text: str, output: Path | None) -> None:
    """Write a text to a file, or print it if the user names no file."""
    if output is None:
        click.echo(text, nl=False)
    else:
        atomic.write_file(output, text)


def signal_word(word: str, color: str) -> str:
    """Return the first word of a line on standard error, coloured on a terminal; NO_COLOR is respected."""
    wanted = sys.stderr.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
    return click.style(word, fg=color, bold=True) if wanted else word


def print_error(text: str) -> None:
    """Print an error as a line on standard error."""
    click.echo(f"{signal_word('Error:', 'red')} {text}", err=True)


class Printer(NamedTuple):
    """Printer of a command's results, warnings and stages, by its options -q, -v and --json."""

    quiet: bool = False
    verbose: bool = False
    as_json: bool = False

    @property
    def shows(self) -> bool:
        """Whether results are printed as text."""
        return not (self.quiet or self.as_json)

    def show(self, blocks: Iterable[Block]) -> None:
        """Print a document as text: all of it with -v, else the brief answer."""
        if self.shows:
            print_document(blocks, verbose=self.verbose)

    def text(self, text: str) -> None:
        """Print a text of the results."""
        if self.shows:
            click.echo(text)

    def json(self, command: str, document: msgspec.Struct | Mapping[str, object]) -> None:
        """Print the document of a command with --json; its schema becomes ``icrtool/<command>/1``.

        Parameters
        ----------
        command : name of the command on the command line
        document : a record, or plain data with arrays of numpy; infinity and NaN become null
        """
        if not self.as_json:
            return
        header = {"schema": f"icrtool/{command}/1", "tool_version": __version__}
        content = header | {key: value for key, value in plain_data.plain_value(document).items() if key not in header}
        click.echo(formats.json_bytes(content), nl=False)

    def detail(self, text: str) -> None:
        """Print a line on standard error with -v."""
        if self.verbose:
            click.echo(text, err=True)

    def warn(self, warnings: Iterable[str]) -> None:
        """Print warnings on standard error, unless -q is given."""
        if not self.quiet:
            for warning in warnings:
                click.echo(f"{signal_word('Warning:', 'yellow')} {warning}", err=True)

    def warn_about(self, run: Run, *, most: int | None = None) -> None:
        """Print the warnings of a run; with -v also the reason for the choice of each stream.

        Parameters
        ----------
        most : largest number of warnings, the gravest first, before the number of the others; None: all. -v and --json
            print all
        """
        # The result on a terminal names the gravest warning, so warnings are printed there only with -v or --json.
        if self.verbose or self.as_json or most is None:
            self.warn(run.warnings if self.verbose or self.as_json or not sys.stderr.isatty() else ())
        elif not sys.stderr.isatty():
            gravest = notes.gravest(run.notes)
            self.warn(finding.sentence for finding in gravest[:most])
            if len(gravest) > most and not self.quiet:
                click.echo(f"{counted(len(gravest) - most, 'more warning')}: -v, or run.json", err=True)
        if self.verbose:
            for stream in run.document.streams:
                topics = text_format.topics_text(stream.topic)
                self.detail(f"{samples.ROLE_WORDS[stream.role]}: {topics}: {stream.why}")

    def stages(self, name: str) -> Stages:
        """Return a display of the stages of the work on the log of this name."""
        return Stages(name, quiet=self.quiet, verbose=self.verbose)

    @contextmanager
    def progress(self, label: str) -> Iterator[Callable[[float], None]]:
        """Yield a function that shows the finished share of a work, 0 to 1, next to its label."""
        with Stages(label, quiet=self.quiet) as stages:
            stages.begin("")
            yield stages.share


class Inputs:
    """The inputs of a command. An error of one input is printed at once, and the other inputs are processed.

    Parameters
    ----------
    key : key of an input in the output of --json

    Attributes
    ----------
    documents : output of --json for each input; it begins with the place and the status of the input
    errors : error of each input that could not be used, by its place
    """

    def __init__(self, key: str) -> None:
        self._key = key
        self.documents: list[dict[str, Any]] = []
        self.errors: dict[str, errors.IcrToolError] = {}

    @contextmanager
    def document_of(self, source: Path) -> Iterator[dict[str, Any]]:
        """Yield the document of one input to the block, and print an error that the block raises."""
        document: dict[str, Any] = {self._key: escaped(str(source)), "status": "done"}
        self.documents.append(document)
        try:
            yield document
        except errors.IcrToolError as err:
            document |= {"status": "failed", "reason": str(err)}
            self.errors[str(source)] = err
            name = shortened(escaped(str(source)), LONGEST_NAME)
            named = any(part in str(err) for part in (name, escaped(source.name), escaped(source.stem)))
            print_error(str(err) if named else f"{name}: {err}")

    def exit_if_failed(self, inputs_word: str, *, limit_not_met: bool = False) -> None:
        """Exit with status 3 if a limit was not met, else with status 1 if an input could not be used.

        `inputs_word` is the word for the inputs in the last error. `limit_not_met`: an acceptance limit was not met or,
        with --strict, a run must not be used.
        """
        failed = [shortened(escaped(source), LONGEST_NAME) for source in self.errors]
        if failed and len(self.documents) > 1:
            print_error(f"{len(failed)} of {len(self.documents)} {inputs_word} could not be used: {listed(failed, 5)}")
        if limit_not_met or failed:
            raise SystemExit(3 if limit_not_met else 1)


class LiveLine:
    """A line on a terminal about the current work. The next output replaces it."""

    def __init__(self, *, quiet: bool = False) -> None:
        self.on_terminal = not quiet and sys.stderr.isatty()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.rewrite("")

    def rewrite(self, text: str) -> None:
        """Replace the text of the line."""
        if self.on_terminal:
            sys.stderr.write(f"{CLEAR}{text}")
            sys.stderr.flush()


class Stages(LiveLine):
    """Display of the stages of the work on one log. It is erased from the terminal at the end.

    Parameters
    ----------
    name : name of the log, which stands before the stage
    quiet : print nothing
    verbose : print a line for each stage if standard error is not a terminal
    """

    def __init__(self, name: str, *, quiet: bool = False, verbose: bool = False) -> None:
        super().__init__(quiet=quiet)
        self.name = name
        self.prints_lines = verbose and not quiet and not self.on_terminal
        self._title = name
        self._shown_s = 0.0
        self._watching = ExitStack()

    def __enter__(self) -> Self:
        if self.on_terminal:
            self._watching.enter_context(compiled.watched(self._compiling))
        return super().__enter__()

    def __exit__(self, *raised: object) -> None:
        self._watching.close()
        super().__exit__(*raised)

    def _compiling(self) -> None:
        """Show that kernels are being compiled, because the first command on a computer waits for this."""
        self.rewrite(f"{self._title} (compiling, once on this computer: about 8 s) …")

    def begin(self, stage: str) -> None:
        """Show the start of a stage with this name, for example ``reading``."""
        self._title = f"{self.name}: {stage}" if stage else self.name
        self._shown_s = time.monotonic()
        self.rewrite(f"{self._title} …")
        if self.prints_lines:
            click.echo(f"{self.name}: {stage}", err=True)

    def share(self, done: float) -> None:
        """Show the finished share of the stage, 0 to 1; at 1 only the name of the stage is shown."""
        now_s = time.monotonic()
        if self.on_terminal and now_s - self._shown_s >= REFRESH_S:
            self._shown_s = now_s
            percent = f"{100 * min(max(done, 0.0), 1.0):.0f} %" if done < 1.0 else "…"
            self.rewrite(f"{self._title} {percent}")
