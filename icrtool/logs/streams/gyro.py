"""The gyro of a log: the turn rate of an inertial unit, whichever topic is used for the heading."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

import numpy as np

from icrtool.kernels.arrays import Bools, Floats
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.heading_sources import frame_convention
from icrtool.logs.streams.stamps import StampedRows, stamp_rows, usable_rows
from icrtool.records.samples import GyroAxes, GyroSamples

GYRO_TYPE = "sensor_msgs/Imu"
GYRO_AXES = ("angular_velocity.x", "angular_velocity.y", "angular_velocity.z")
GYRO_FIELDS = (*HEADER, *GYRO_AXES)

FASTEST_RADPS = math.radians(1000.0)
"""No robot turns faster than this [rad/s]."""

MOST_BAD = 0.01
"""A topic is not used where a larger share of its rates is not finite."""


NOTHING_KNOWN: Mapping[str, StampedRows] = {}


def find_gyro(
    tables: Sequence[TopicTable],
    wheels_topic: str,
    heading_topic: str,
    clock: Literal["header", "log"],
    known: Mapping[str, StampedRows] = NOTHING_KNOWN,
) -> GyroSamples | None:
    """Return the turn rates of the best inertial unit, None without one.

    Parameters
    ----------
    tables : all topics that were read
    wheels_topic, heading_topic : the unit that is also the source of the heading is preferred, then one in the wheels'
        namespace, then the one with more samples
    clock : the clock of the other streams
    known : stamps of topics that were read before
    """
    home = wheels_topic.strip("/").split("/")[0]
    found = []
    for table, (rate,), sound in _units(tables, GYRO_AXES[2:]):
        near = table.topic == heading_topic, table.topic.strip("/").split("/")[0] == home, len(rate)
        found.append((near, table.topic, rate, sound, table))
    if not found:
        return None
    _, topic, rate, sound, table = max(found, key=lambda one: one[:2])
    stamps = (known.get(topic) or stamp_rows(table)).on(clock)
    rows = usable_rows(stamps, sound)
    sign = 1.0 if frame_convention(table)[0] == "ned" else -1.0
    return GyroSamples(topic, stamps[rows], sign * rate[rows])


def find_gyros(
    tables: Sequence[TopicTable], clock: Literal["header", "log"], known: Mapping[str, StampedRows] = NOTHING_KNOWN
) -> tuple[GyroAxes, ...]:
    """Return the turn rates of every inertial unit, about all three axes; parameters as of `find_gyro`."""
    found = []
    for table, axes, sound in _units(tables, GYRO_AXES):
        stamps = (known.get(table.topic) or stamp_rows(table)).on(clock)
        rows = usable_rows(stamps, sound)
        found.append(GyroAxes(table.topic, stamps[rows], np.array([rates[rows] for rates in axes]).T))
    return tuple(found)


def _units(tables: Sequence[TopicTable], axes: Sequence[str]) -> Iterator[tuple[TopicTable, list[Floats], Bools]]:
    """Yield the inertial units that measure about some axes, with the rates (n,) about each, and which are sound."""
    for table in tables:
        if table.message_type != GYRO_TYPE or len(table) < 2 or any(axis not in table.columns for axis in axes):
            continue
        rates = [table.floats(axis) for axis in axes]
        sound: Bools = np.logical_and.reduce([np.abs(one) <= FASTEST_RADPS for one in rates])
        if np.count_nonzero(~sound) <= MOST_BAD * len(sound) and any(np.ptp(one[sound]) for one in rates):
            yield table, rates, sound
