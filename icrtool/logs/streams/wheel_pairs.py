"""Wheels recorded as one topic per side: messages without header, paired by log time."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Bools, Floats
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.stamps import StampedRows
from icrtool.logs.streams.wheel_sources import COMMAND_NOTE, COMMANDED, Unit, WheelMotion, motion_of
from icrtool.records.text import LogText

PAIR_TYPES = {f"std_msgs/{name}" for name in ("Float32", "Float64", "Int16", "Int32", "Int64", "UInt32")}
"""Message types that hold one number of one side."""

_SPEED_WORDS = re.compile(r"vel|speed|rate|rpm|twist", re.IGNORECASE)
_PLACE_WORDS = re.compile(r"tick|count|enc|pos|angle|travel|dist|odo", re.IGNORECASE)
_BITS = {"std_msgs/Int16": 16, "std_msgs/Int32": 32, "std_msgs/UInt32": 32, "std_msgs/Int64": 64}
_HOLD_NS = 500_000_000
"""A side that ends before the other is held for this long at most [s]."""


def pair_motion(left: TopicTable, right: TopicTable, config: Config) -> WheelMotion:
    """Return the wheel motion of a left and a right topic without headers, at the left one's stamps.

    Counters of the type's width are unwrapped. Positions are interpolated, speeds are held.
    """
    kind = LogText(" + ".join(dict.fromkeys(LogText(side.message_type).raw for side in (left, right))))
    topic = LogText(f"{LogText(left.topic).raw} + {LogText(right.topic).raw}")
    commanded = bool(COMMANDED.search(left.topic))
    score, why = 80.0 - (40.0 if commanded else 0.0), "a pair of topics" + (" (commanded)" if commanded else "")
    note = COMMAND_NOTE if commanded else ""

    def unusable(problem: str) -> WheelMotion:
        stamps = StampedRows(None, left.log_time_ns, "no header", 0)
        return WheelMotion(topic=topic, message_type=kind, stamps=stamps, score=score, problem=problem)

    if not (len(left) and len(right)):
        return unusable(f"{(right if len(left) else left).topic} holds no message")
    try:
        values = [_unwrapped(table.column("data"), _BITS.get(table.message_type)) for table in (left, right)]
    except DefinitionError as err:
        return unusable(err.why)
    both = _while_both(left, right)
    if not both.any():
        return unusable("the two sides were not recorded at the same time")
    moments = left.log_time_ns[both]
    stamps = StampedRows(None, moments, "no header", 0, set_back=max(left.set_back, right.set_back))
    integer = left.message_type in _BITS
    if _is_position(left.topic, values[0], config, integer=integer):
        unit: Unit = "counts" if integer or config.wheels.quantity == "counts" else "unknown"
        other = np.interp(moments, right.log_time_ns, values[1])
        why = f"{why}: {'ticks' if unit == 'counts' else 'angles or distances'}"
        pair = WheelMotion(topic=topic, message_type=kind, stamps=stamps, unit=unit, score=score, why=why, note=note)
        return motion_of(pair, (values[0][both], other))
    place = np.clip(np.searchsorted(right.log_time_ns, moments + _half_interval(left), side="right") - 1, 0, None)
    speed = (values[0][both], values[1][place])
    pair = WheelMotion(
        topic=topic, message_type=kind, stamps=stamps, unit="unknown", score=score, why=f"{why}: speeds", note=note
    )
    return motion_of(pair, speed=speed)


def _half_interval(table: TopicTable) -> int:
    """Return half the median interval [ns]: messages of one control cycle are logged closer together than this."""
    return int(np.median(np.diff(table.log_time_ns))) // 2 if len(table) > 1 else 0


def _while_both(left: TopicTable, right: TopicTable) -> Bools:
    """Return the left rows (n,) recorded while the right side was, too: a side held for long would look like a turn."""
    slack = max(_half_interval(left), _half_interval(right))
    first, last = right.log_time_ns[0] - slack, right.log_time_ns[-1] + max(slack, _HOLD_NS)
    both: Bools = np.logical_and(left.log_time_ns >= first, left.log_time_ns <= last)
    return both


def _unwrapped(values: NDArray[Any], bits: int | None) -> Floats:
    if bits is None or bits == 64 or values.dtype.kind == "f" or not len(values):
        return values.astype(np.float64)
    span = 1 << bits
    steps = np.mod(np.diff(values.astype(np.int64)) + span // 2, span) - span // 2
    return np.concatenate([[0], np.cumsum(steps)]).astype(np.float64) + float(values[0])


def _is_position(topic: str, values: Floats, config: Config, *, integer: bool) -> bool:
    """Return whether a pair's numbers are positions (ticks, angles), not speeds."""
    if config.wheels.quantity != "auto":
        return config.wheels.quantity in ("position", "counts")
    if _SPEED_WORDS.search(topic):
        return False
    if _PLACE_WORDS.search(topic):
        return True
    finite = values[np.isfinite(values)]
    if len(finite) < 3 or np.ptp(finite) == 0:
        return integer
    # A position's steps add up to about its range; a speed goes up and down around few values.
    return bool(np.abs(np.diff(finite)).sum() < 3.0 * np.ptp(finite) and np.ptp(finite) > 5.0)
