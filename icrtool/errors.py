"""Every error raised on purpose. One root; each leaf builds its one line from its fields.

The line reads ``<what>: <what is wrong>; <what was found, or what to do>``. It is escaped and bounded in length,
because its parts may come from a log.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from icrtool.records.text import LONGEST_MESSAGE, LONGEST_NAME, LONGEST_STORED, escaped, shortened

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path  # its import would be a tenth of ``icrtool --help``


class IcrToolError(Exception):
    """A log, configuration or request that cannot be used. Its text is one line for a person."""

    def __init__(self, what: object, why: str, advice: str = "") -> None:
        self.what = what
        self.why = why
        self.advice = advice
        # an address of any length leaves space for the reason
        super().__init__(_line(f"{shortened(str(what), LONGEST_STORED)}: {self.reason}"))

    @property
    def reason(self) -> str:
        """Why it cannot be used, and the advice."""
        return f"{self.why}; {self.advice}" if self.advice else self.why

    def text_without(self, *names: str) -> str:
        """Return the line without its name, for a place that already shows one of some names."""
        what = shortened(str(self.what), LONGEST_NAME)
        return _line(self.reason) if what in (shortened(str(one), LONGEST_NAME) for one in names) else str(self)


def _line(text: str) -> str:
    return shortened(escaped(text), LONGEST_MESSAGE)


class ConfigError(IcrToolError):
    """A configuration key that is unknown, of the wrong type, or impossible."""


class LogError(IcrToolError):
    """A log that cannot be read."""


class LogChangedError(LogError):
    """A log, or another input of a batch, that was written to while it was used."""


class DefinitionError(LogError):
    """A message type whose layout is not known."""


class MissingStreamError(LogError):
    """A log without wheels, position or heading.

    Parameters
    ----------
    needs : for each missing role, what could fill it
    holds : topics of the log
    lost : what of the log could not be read
    """

    def __init__(self, log: Path | str, needs: Mapping[str, str], holds: Sequence[str], lost: str = "") -> None:
        self.roles = tuple(needs)
        self.holds = tuple(holds)
        *others, last = (f"no {role}" for role in needs)
        missing = f"{', '.join(others)} and {last}" if others else last
        wanted = "; ".join(f"needs {need}" if len(needs) == 1 else f"{role}: {need}" for role, need in needs.items())
        unread = f"; what could not be read: {lost}" if lost else ""
        super().__init__(log, f"{missing} found", f"{wanted}; the log holds {', '.join(self.holds)}{unread}")


class DataError(IcrToolError):
    """Streams that were read but cannot be used together (no overlap, all NaN, one sample)."""


class OutputError(IcrToolError):
    """A result that cannot be written where it was asked for."""


class RunError(IcrToolError):
    """A run directory that icrtool did not write, that was edited, or that has another schema."""
