"""What an inertial unit shows: yaw from its quaternion, in whatever order that was written, and its turn rate."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

import numpy as np

from icrtool.kernels.arrays import Bools, Floats
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.sources import StampedRows, stamp_rows, usable_rows
from icrtool.records.samples import GyroAxes, GyroSamples

Convention = Literal["enu", "ned"]

QUATERNION_NORM_TOLERANCE = 0.1
UPRIGHT_COSINE = math.cos(math.radians(45.0))
"""A sensor whose z axis is further than 45 deg from vertical is mounted on its side; its yaw is no heading."""

LEVEL_COSINE = math.cos(math.radians(30.0))
TILTED_SHARE = 0.01
"""Largest share of the time in which no axis of the sensor is upright, for a robot on the ground."""

CLEAR_CORRELATION = 0.5
STRETCHES = 200
MOST_LOOKED_AT = 5000

ORDERS: tuple[tuple[tuple[int, int, int, int], str], ...] = (
    ((1, 2, 3, 0), "its quaternion is written w first: read as w, x, y, z"),
    ((3, 1, 2, 0), "its quaternion has x and w swapped: swapped back"),
)
"""Positions of x, y, z, w among the four fields, where a driver filled them in another order."""


def frame_convention(table: TopicTable) -> tuple[Convention, str]:
    """Return the convention of a message's frame, and how it is known."""
    frame = table.text("header.frame_id")
    if frame.lower().endswith("_ned") or frame.lower() == "ned":
        return "ned", f"frame {frame} (REP-145)"
    return "enu", "REP-103"


def nose_yaw(q: Floats, yaw_rate_radps: Floats | None = None) -> tuple[Floats, Bools, str]:
    """Return yaw [rad] (n,), which rows are rotations (n,), and a note where the sensor is not mounted upright.

    Yaw is that of the sensor's x axis seen from above. In a sensor mounted on its side another axis is level all the
    time: that axis is used, and has a constant angle to the robot's forward axis.

    Parameters
    ----------
    q : (n, 4) the fields x, y, z, w
    yaw_rate_radps : (n,) of a gyro in the same message; a quaternion in another order must turn with it
    """
    with np.errstate(over="ignore"):
        norm = np.sqrt(np.einsum("ij,ij->i", q, q))
    usable = np.abs(norm - 1.0) < QUATERNION_NORM_TOLERANCE
    unit = q / np.where(usable, norm, np.nan)[:, None]
    if usable.all():
        order, note = _written_order(unit, yaw_rate_radps)
    else:
        order, note = _written_order(unit[usable], None if yaw_rate_radps is None else yaw_rate_radps[usable])
    x, y, z, w = (unit[:, place] for place in order)
    upright = float(np.median(np.abs(1 - 2 * (x * x + y * y))[usable])) if usable.any() else 1.0
    if upright >= UPRIGHT_COSINE:
        return np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)), usable, note
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z)],
            [2 * (x * z + w * y), 2 * (y * z - w * x)],
        ]
    )
    vertical = _vertical(x, y, z, w)
    level = int(np.argmin([np.median(np.abs(v[usable])) for v in vertical]))
    note = (
        f"mounted on its side: its {'xyz'[level]} axis is level and is used as heading, with an offset to be estimated"
    )
    return np.arctan2(axes[level, 1], axes[level, 0]), usable, note


def _written_order(unit: Floats, yaw_rate_radps: Floats | None) -> tuple[Sequence[int], str]:
    """Return the positions of x, y, z, w, and a note where they are not in this order.

    On the ground one axis of the sensor stays upright, whatever the mounting. If no axis does, and another order of the
    components gives a level sensor all the time, that order is used.
    """
    as_named = (0, 1, 2, 3)
    some = unit[:: max(1, len(unit) // MOST_LOOKED_AT)]
    if len(some) < 2 or (_tilted_share(some, UPRIGHT_COSINE) < TILTED_SHARE).any():
        return as_named, ""
    for order, note in ORDERS:
        meant = unit[:, order]
        if _tilted_share(meant[:: max(1, len(unit) // MOST_LOOKED_AT)], LEVEL_COSINE)[2] < TILTED_SHARE and _turns_with(
            meant, yaw_rate_radps
        ):
            return order, note
    return as_named, ""


def _tilted_share(unit: Floats, cosine: float) -> Floats:
    """Return, for each axis of the sensor (3,), the share of the time in which it is not upright."""
    share: Floats = (np.abs(_vertical(*unit.T)) < cosine).mean(axis=1)
    return share


def _vertical(x: Floats, y: Floats, z: Floats, w: Floats) -> Floats:
    """Return the vertical component of the sensor's axes (3, n)."""
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


def _turns_with(unit: Floats, yaw_rate_radps: Floats | None) -> bool:
    """Return whether yaw changes correlate with the gyro's; True where there is no gyro or it does not turn."""
    if yaw_rate_radps is None or not np.isfinite(yaw_rate_radps).all() or np.ptp(yaw_rate_radps) == 0:
        return True
    x, y, z, w = unit.T
    yaw = np.unwrap(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))
    # Over many samples: from one to the next there is more noise than turning.
    edges = np.unique(np.linspace(0, len(yaw) - 1, STRETCHES + 1).astype(np.int64))
    turned, measured = np.diff(yaw[edges]), np.add.reduceat(yaw_rate_radps, edges[:-1])
    if len(turned) < 3 or float(np.ptp(turned)) == 0 or float(np.ptp(measured)) == 0:
        return False
    return float(np.corrcoef(turned, measured)[0, 1]) > CLEAR_CORRELATION


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
