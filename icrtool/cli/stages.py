"""What a command is doing: a line that is rewritten on a terminal; with -v, elsewhere, a line for each stage."""

from __future__ import annotations

import os
import sys
import time
from types import TracebackType
from typing import Self

from icrtool.records.process_resources import give_back_freed

CLEAR = "\r\x1b[K"
REFRESH_S = 0.1
"""The share done is rewritten at most this often."""


def signal_word(word: str, color: str) -> str:
    """Return the word that begins a line on standard error, coloured on a terminal; NO_COLOR is respected."""
    from click import style

    wanted = sys.stderr.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
    return style(word, fg=color, bold=True) if wanted else word


class Stages:
    """The stages of the work on one log; ended, nothing of them stays on a terminal.

    Parameters
    ----------
    name : of the log, printed before the stage
    quiet : print nothing
    verbose : where standard error is no terminal, print a line for each stage
    """

    def __init__(self, name: str, *, quiet: bool = False, verbose: bool = False) -> None:
        self.name = name
        self.on_terminal = not quiet and sys.stderr.isatty()
        self.prints_lines = verbose and not quiet and not self.on_terminal
        self._stage = ""
        self._shown_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def begin(self, stage: str) -> None:
        """Begin a stage: what is being done, for example ``reading``."""
        give_back_freed()
        self._stage = stage
        self._shown_s = time.monotonic()
        if self.on_terminal:
            self._write(f"{CLEAR}{self._title()} …")
        elif self.prints_lines:
            self._write(f"{self.name}: {stage}\n")

    def share(self, done: float) -> None:
        """Show which share of the stage is done, 0 to 1; at the end of it, only the stage."""
        now_s = time.monotonic()
        if self.on_terminal and now_s - self._shown_s >= REFRESH_S:
            self._shown_s = now_s
            percent = f"{100 * min(max(done, 0.0), 1.0):.0f} %" if done < 1.0 else "…"
            self._write(f"{CLEAR}{self._title()} {percent}")

    def end(self) -> None:
        """Clear the line; what is printed next begins at its left."""
        if self.on_terminal:
            self._write(CLEAR)

    def _title(self) -> str:
        return f"{self.name}: {self._stage}" if self._stage else self.name

    def _write(self, text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()
