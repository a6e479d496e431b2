"""Every error raised on purpose. One root; each leaf builds its one line from its fields.

The line reads ``<what>: <what is wrong>; <what was found, or what to do>``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


class IcrToolError(Exception):
    """A log, configuration or request that cannot be used. Its text is one line for a person."""

    def __init__(self, what: object, why: str, advice: str = "") -> None:
        self.what = what
        self.why = why
        self.advice = advice
        super().__init__(f"{what}: {why}; {advice}" if advice else f"{what}: {why}")


class ConfigError(IcrToolError):
    """A configuration key that is unknown, of the wrong type, or impossible."""


class LogError(IcrToolError):
    """A log that cannot be read."""


class DefinitionError(LogError):
    """A message type whose layout is not known."""


class MissingStreamError(LogError):
    """A log without one of wheels, position or heading."""

    def __init__(self, log: Path | str, role: str, needs: str, holds: Sequence[str]) -> None:
        self.role = role
        self.holds = tuple(holds)
        found = ", ".join(self.holds) if self.holds else "no topic at all"
        super().__init__(log, f"no {role} found", f"needs {needs}; the log holds {found}")


class DataError(IcrToolError):
    """Streams that were read but cannot be used together (no overlap, all NaN, one sample)."""


class OutputError(IcrToolError):
    """A result that cannot be written where it was asked for."""


class RunError(IcrToolError):
    """A run directory that is not ours, was edited, or is of another schema."""
