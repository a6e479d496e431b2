"""Stages of the work on one log: the function that is called when each begins."""

from __future__ import annotations

from collections.abc import Callable

Watch = Callable[[str], None]
"""Called with the name of each stage when it begins, for example ``aligning``."""


def unwatched(stage: str) -> None:
    """Do nothing at the start of a stage."""
