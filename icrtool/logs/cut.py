"""The part of a log that is read: converts times given by a user to log times."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from icrtool.errors import DataError, LogError
from icrtool.logs.containers.channel import LATEST_NS, WHOLE, Cut
from icrtool.logs.containers.container import Container
from icrtool.records.samples import Samples
from icrtool.records.tables import RobotLog

PAUSE_S, LONGEST_PAUSE_S = 600.0, 86_400.0
"""A longer interval between samples is reported; a log whose samples are a day apart is of two recordings."""

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


def longest_part(log: RobotLog) -> RobotLog:
    """Return a log without what another clock stamped, and with warnings where its clock may have been set forward.

    Of parts that are `LONGEST_PAUSE_S` and more apart, that with the most wheel samples, and positions, is kept.
    """
    stamps, fixes = log.wheels.stamp_ns, log.gnss.stamp_ns
    ends = np.append(np.flatnonzero(np.diff(stamps) > LONGEST_PAUSE_S * 1e9), len(stamps) - 1)
    begins = np.append(0, ends[:-1] + 1)
    positions = np.searchsorted(fixes, stamps[ends], side="right") - np.searchsorted(fixes, stamps[begins])
    longest = int(np.argmax((ends - begins) * (positions > 1)))
    parts: dict[str, Any] = {}
    for role, margin_s in (("wheels", 0.0), ("gnss", LONGEST_PAUSE_S), ("heading", LONGEST_PAUSE_S)):
        margin_ns = int(margin_s * 1e9)
        first, last = stamps[begins[longest]] - margin_ns, stamps[ends[longest]] + margin_ns
        parts[role] = _between(getattr(log, role), first, last)
    counts = {role: (len(kept.stamp_ns), len(getattr(log, role).stamp_ns)) for role, kept in parts.items()}
    warnings = list(log.warnings)
    if lost := [f"{every - kept} of {every} ({role})" for role, (kept, every) in counts.items() if kept < every]:
        warnings.append(
            f"{log.name}: more than a day apart from the other samples, and left out: {', '.join(lost)}; if the clock "
            "was set, --from and --to read that part"
        )
    for role, kept in parts.items():
        longest_s = np.diff(kept.stamp_ns).max(initial=0) / 1e9
        if longest_s > PAUSE_S:
            why = "the recording was paused, or its clock was set forward"
            warnings.append(f"{log.name}: {role}: no samples for {longest_s:.0f} s: {why}")
            break
    return replace(log, warnings=tuple(warnings), **parts)


def _between(samples: Samples, begin_ns: int, end_ns: int) -> Samples:
    """Return the samples with stamps in [begin_ns, end_ns]."""
    inside = (samples.stamp_ns >= begin_ns) & (samples.stamp_ns <= end_ns)
    return samples if inside.all() else samples.cut(inside)


def _first_ns(container: Container) -> int:
    """Return the log time of the first message [ns]; without an index all messages are read for it."""
    if (span := container.span_ns()) is not None:
        return span[0]
    numbers = frozenset(channel.id for channel in container.channels)
    begins = (int(block.log_time_ns.min()) for block in container.blocks(numbers) if len(block.log_time_ns))
    return min(begins, default=0)
