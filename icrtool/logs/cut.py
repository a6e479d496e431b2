"""The part of a log that is read: converts times given by a user to log times."""

from __future__ import annotations

import math
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from icrtool.errors import DataError, LogError
from icrtool.logs.containers.channel import LATEST_NS, WHOLE, Container, Cut

Moment = float | str | datetime
"""Seconds since the log's first message, or a time of day: a `datetime`, or a text in ISO 8601."""


def moment(given: Moment | None, key: str) -> float | datetime | None:
    """Return a moment as seconds since the log's first message, or as a time with a zone.

    Raises
    ------
    LogError
        Neither a finite number nor a time in ISO 8601.
    """
    if given is None:
        return None
    if isinstance(given, str):
        given = _parsed(given, key)
    if isinstance(given, datetime):
        return given if given.tzinfo is not None else given.replace(tzinfo=UTC)
    if not math.isfinite(given):
        raise LogError(key, f"{given} is not a number of seconds")
    return float(given)


def _parsed(text: str, key: str) -> float | datetime:
    with suppress(ValueError):
        return float(text)
    try:
        return datetime.fromisoformat(text)
    except ValueError as err:
        why = f"{text!r} is neither a number of seconds nor a time in ISO 8601"
        raise LogError(key, why, "for example 12.5, or 2026-05-04T09:30:00") from err


def cut_of(container: Container, start: float | datetime | None, end: float | datetime | None, log: Path) -> Cut:
    """Return the part of a log between two times, as log times.

    Raises
    ------
    DataError
        The end is not after the start.
    """
    if start is None and end is None:
        return WHOLE
    first = 0
    if isinstance(start, float) or isinstance(end, float):
        first = _first_ns(container)
    begin_ns = max(nanoseconds(start, first), 0) if start is not None else 0
    end_ns = nanoseconds(end, first) if end is not None else LATEST_NS
    if begin_ns >= end_ns:
        raise DataError(log, "the part to read ends before it begins", "give an end later than the start")
    return Cut(begin_ns, min(end_ns, LATEST_NS))


def nanoseconds(given: float | datetime, first_ns: int) -> int:
    """Return a moment as log time [ns]."""
    if isinstance(given, datetime):
        passed = given - datetime(1970, 1, 1, tzinfo=UTC)
        return (passed.days * 86_400 + passed.seconds) * 1_000_000_000 + passed.microseconds * 1000
    return first_ns + round(max(min(given, 1e9), -1e9) * 1e9)


def _first_ns(container: Container) -> int:
    """Return the log time of the first message [ns]; without an index all messages are read for it."""
    begin = container.begin_ns()
    if begin is not None:
        return begin
    numbers = frozenset(channel.id for channel in container.channels)
    begins = (int(block.log_time_ns.min()) for block in container.blocks(numbers) if len(block.log_time_ns))
    return min(begins, default=0)
