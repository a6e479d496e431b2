"""Readers of messages with the robot's heading (yaw in ENU, compass headings, antenna baselines) or turn rates."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from icrtool.config import Config
from icrtool.kernels.arrays import ROWS_AT_ONCE, Bools, Floats, Ints, turned_axis, unwrapped
from icrtool.logs.messages.topic_table import FRAME_FIELD, TopicTable
from icrtool.logs.streams.gyro_units import DEGREE, FASTEST_RADPS, LARGEST_BAD_SHARE
from icrtool.logs.streams.positions import GOAL_PROBLEM, GOAL_WORDS, is_fused
from icrtool.logs.streams.sources import (
    Clock,
    HeadingSource,
    StampedRows,
    YawConvention,
    all_valid,
    fields_in,
    increasing_rows,
    number_of,
    stamp_rows,
    topic_fields,
)
from icrtool.records.notes import Note, note
from icrtool.records.samples import GyroSamples

FUSED_WORTH = 30.0
"""Largest worth of a heading that is fused with the wheels."""


@dataclass(frozen=True, slots=True)
class Bearing:
    """A message type with an angle that is the heading.

    Attributes
    ----------
    label : name of the data, for the reason of a choice
    worth : score of the type; the source with the highest score is chosen
    angle : number of the heading for `number_of` [rad]. 720 deg and more stand for "unknown": Septentrio writes -2e10
    std, variance : numbers of the standard deviation [rad] or the variance [rad^2]; one of them, or none
    valid : checks that a valid heading passes
    convention : ``ned``: clockwise from north; ``enu``: counter-clockwise from east
    known_by : text about how the convention is known
    independent : checks that an independent heading passes; if half of the messages fail, it is fused with the wheels
    """

    label: str
    worth: float
    angle: str = "heading < 720 * deg"
    std: str = ""
    variance: str = ""
    valid: tuple[str, ...] = ()
    convention: YawConvention = "ned"
    known_by: str = "degrees clockwise from north"
    independent: tuple[str, ...] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read."""
        return fields_in((self.angle, self.std, self.variance), (*self.valid, *self.independent))

    def read(self, table: TopicTable, _: Config) -> HeadingSource:
        """Return the headings of a topic; raise `DefinitionError` where the type lacks the angle."""
        angle, variance = number_of(table, self.angle, needed=True), np.full(len(table), np.nan)
        if self.variance:
            variance = number_of(table, self.variance)
        elif self.std:
            std = number_of(table, self.std)
            # The sign is kept: a standard deviation that is not positive counts as not stated.
            variance = std * np.abs(std)
        worth = min(self.worth, FUSED_WORTH) if is_fused(table, self.independent) else self.worth
        return replace(self, worth=worth).source(table, angle, variance, all_valid(table, self.valid))

    def source(self, table: TopicTable, angle: Floats, variance: Floats, valid: Bools) -> HeadingSource:
        """Return the source with angles (n,) [rad], their variances (n,) [rad^2], and a mask of valid ones (n,)."""
        yaw, stated = np.where(np.isfinite(angle), angle, np.nan), np.where(variance > 0, variance, np.nan)
        usable = valid & np.isfinite(angle)
        problem = "" if usable.any() else "no valid heading"
        return HeadingSource(
            **topic_fields(table), yaw_rad=yaw, variance=stated, usable=usable, convention=self.convention,
            convention_why=self.known_by, score=self.worth, why=self.label, problem=problem,
        )  # fmt: skip


_NORTHS = {0.0: "magnetic", 1.0: "geographic", 2.0: "UTM"}
_AZIMUTH = Bearing("azimuth", 95.0, known_by="stated in the message")
AZIMUTH_FIELDS = ("azimuth", "variance", "unit", "orientation", "reference")
"""Fields of an azimuth message."""


def read_azimuths(table: TopicTable, _: Config) -> HeadingSource:
    """Return the headings of Azimuth messages, which state their unit, orientation and reference."""
    factor = np.where(table.column("unit") == 1, math.radians(1.0), 1.0)
    yaw = table.column("azimuth") * factor
    orientation = table.column("orientation")
    ned = bool(np.median(orientation) == 1)
    # Rows of the other orientation are converted by pi/2 - yaw, which is right for both directions of conversion.
    yaw = np.where((orientation == 1) == ned, yaw, np.pi / 2 - yaw)
    north = _NORTHS.get(float(np.median(table.floats("reference"))), "unknown")
    row = replace(_AZIMUTH, label=f"{_AZIMUTH.label}, {north} north", convention="ned" if ned else "enu")
    return row.source(table, yaw, table.floats("variance") * factor**2, np.ones(len(table), np.bool_))


BASELINE = Bearing(
    "u-blox moving base: bearing of the antenna baseline", 90.0, "relPosHeading|rel_pos_heading * 1e-5 * deg",
    "accHeading|acc_heading * 1e-5 * deg", valid=("flags & 260 == 260",), known_by="u-blox: clockwise from north",
)  # fmt: skip
"""Heading of an antenna baseline. Flag 4 states that the baseline is valid, flag 256 that its heading is valid."""

_COMPONENTS = "relPosN|rel_pos_n + relPosHPN|rel_pos_hpn * 0.01", "relPosE|rel_pos_e + relPosHPE|rel_pos_hpe * 0.01"
_ACCURACIES, _BASELINE_VALID = ("accN|acc_n * 0.01", "accE|acc_e * 0.01"), ("flags & 4 == 4",)
BASELINE_FIELDS = fields_in((*_COMPONENTS, *_ACCURACIES), _BASELINE_VALID)
"""Fields of a baseline with components to the north and to the east [cm]."""

LEAST_BASELINE_CM = 0.005
"""Shortest baseline whose direction is used [cm]. It is half of the resolution of the fields."""


def read_baselines(table: TopicTable, _: Config) -> HeadingSource:
    """Return the headings of ublox_msgs/NavRELPOSNED, which states the components of an antenna baseline."""
    north, east = (number_of(table, component, needed=True) for component in _COMPONENTS)
    length = np.hypot(north, east)
    measured = (length > LEAST_BASELINE_CM) & np.isfinite(length)
    accuracy = np.maximum(*(number_of(table, accuracy_field) for accuracy_field in _ACCURACIES))
    std = np.divide(accuracy, length, out=np.full(len(table), np.nan), where=measured)
    valid = all_valid(table, _BASELINE_VALID) & measured
    return BASELINE.source(table, np.arctan2(east, north), std * np.abs(std), valid)


INS_WORDS = re.compile(r"\bins\b|vectornav|novatel|sbg|microstrain|xsens|gnss|gps|global|map|filtered", re.IGNORECASE)
"""Words in names of topics with the orientation of an inertial navigation system."""

_RAW_WORDS = re.compile(r"raw", re.IGNORECASE)
_ATTITUDE_WORDS = re.compile(r"quaternion|filter|imu|attitude|orientation|ahrs|xsens|mti", re.IGNORECASE)
"""Words in names of topics of QuaternionStamped that hold the orientation of an inertial unit. Other topics of this
type hold a compass angle of a receiver."""

RAW_PENALTY = 10.0
"""Number that is subtracted from the worth of a topic with ``raw`` in its name."""

NOT_INS_PENALTY = 30.0
"""Number that is subtracted from the worth of an odometry whose name shows no inertial navigation system."""

UNKNOWN_RAD2 = (2 * np.pi) ** 2
"""Variance from which on a heading counts as unknown [rad^2], a standard deviation of one turn. Drivers of moving bases
write 1000."""


@dataclass(frozen=True, slots=True)
class Orientation:
    """A message type with an orientation.

    Attributes
    ----------
    label : name of the data, for the reason of a choice
    worth : score of the type; the source with the highest score is chosen
    path : field of the quaternion
    variance : field of the variance of yaw [rad^2]
    absent : field that is -1 in messages without an orientation
    rate : field of the turn rate of a gyro in the same message [rad/s]
    compass_as_yaw : whether drivers of GNSS receivers write a compass angle into the quaternion as if it were a yaw
    odometry : whether the type is an odometry, which is preferred if its name shows an inertial navigation system
    """

    label: str
    worth: float
    path: str
    variance: str = ""
    absent: str = ""
    rate: str = ""
    compass_as_yaw: bool = False
    odometry: bool = False

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read."""
        return fields_in((*(f"{self.path}.{axis}" for axis in "xyzw"), self.variance, self.absent, self.rate))

    def read(self, table: TopicTable, _: Config) -> HeadingSource:
        """Return the yaw of the orientations of a topic; raise `DefinitionError` where the type lacks them."""
        q = [table.column(f"{self.path}.{axis}").astype(np.float64, copy=False) for axis in "xyzw"]
        yaw, usable, mounting = nose_yaw(q, table.floats(self.rate) if self.rate in table.columns else None)
        variance = table.floats(self.variance)
        variance = np.where(variance > 0, variance, np.nan)
        unknown = variance >= UNKNOWN_RAD2
        # A variance that is too large in all messages states nothing about single ones.
        usable = usable if unknown[usable].all() else usable & ~unknown
        convention, why = frame_convention(table)
        if self.compass_as_yaw and not _ATTITUDE_WORDS.search(table.topic):
            convention, why = "ned", "compass angle as yaw"
        problem = ""
        if np.all(table.floats(self.absent) == -1.0):
            problem = "holds no orientation (covariance -1, REP-145)"
        elif not usable.any():
            problem = "no valid quaternion"
        elif float(np.ptp(yaw[usable])) == 0.0:
            problem = "its orientation never changes"
        elif GOAL_WORDS.search(table.topic):
            problem = GOAL_PROBLEM
        off = NOT_INS_PENALTY if self.odometry and not INS_WORDS.search(table.topic) else 0.0
        off += RAW_PENALTY if _RAW_WORDS.search(table.topic) else 0.0
        return HeadingSource(
            **topic_fields(table), yaw_rad=yaw, variance=variance, usable=usable, convention=convention,
            convention_why=why, score=self.worth - off, why=self.label, problem=problem,
            notes=() if mounting is None else (mounting,),
        )  # fmt: skip


QUATERNION_NORM_TOLERANCE = 0.1
"""Largest difference of the norm of a quaternion from 1 with which it is used."""

UPRIGHT_COSINE = math.cos(math.radians(45.0))
"""Cosine of the largest tilt of an upright sensor, 45 deg. A sensor with a larger tilt is mounted on its side, and its
yaw is no heading."""

LEVEL_COSINE = math.cos(math.radians(30.0))
"""Cosine of the largest tilt of a robot on the ground, 30 deg."""

TILTED_SHARE = 0.01
"""Largest share of the time in which a sensor on a robot may be tilted further."""

CLEAR_CORRELATION = 0.5
"""Smallest correlation of the turns by yaw with the turns by the gyro in the same message."""

STRETCHES = 200
"""Number of stretches of time over which these turns are compared."""

MOST_ORIENTATIONS = 5000
"""Largest number of orientations from which the order of the components is found."""

ORDERS: tuple[tuple[tuple[int, int, int, int], str], ...] = (
    ((1, 2, 3, 0), "its quaternion is written w first: read as w, x, y, z"),
    ((3, 1, 2, 0), "its quaternion has x and w swapped: swapped back"),
)
"""Positions of x, y, z, w among the four fields in the orders that some drivers write, and text for the finding."""


def frame_convention(table: TopicTable) -> tuple[YawConvention, str]:
    """Return the convention of the frame of a topic's messages, and a text about how it is known."""
    frame = table.text(FRAME_FIELD)
    if frame.lower().endswith("_ned") or frame.lower() == "ned":
        return "ned", f"frame {frame} (REP-145)"
    return "enu", "REP-103"


def nose_yaw(q: Sequence[Floats], yaw_rate_radps: Floats | None = None) -> tuple[Floats, Bools, Note | None]:
    """Return yaw (n,) [rad], a mask of valid quaternions (n,), and a finding if the sensor is not mounted upright.

    Yaw is the direction of the sensor's x axis seen from above, counter-clockwise. If the sensor is mounted on its
    side, an axis that is always level is used; it has a constant angle to the forward axis of the robot.

    Parameters
    ----------
    q : the fields x, y, z, w, (n,) each
    yaw_rate_radps : (n,) turn rate of a gyro in the same message; quaternions in another order must turn with it
    """
    with np.errstate(over="ignore"):
        norm = _over_rows(lambda *fields: np.sqrt(sum(field * field for field in fields)), q)
    off = norm - 1.0
    usable = np.abs(off, out=off) < QUATERNION_NORM_TOLERANCE
    del off
    norm[~usable] = np.nan
    order, notes = _written_order(q, norm, usable, yaw_rate_radps)
    ordered = [q[component] for component in order]

    def tilt(axis: int) -> float:
        upward = _over_rows(lambda *unit: np.abs(turned_axis(axis, *unit)[2]), ordered, norm)[usable]
        return float(np.median(upward, overwrite_input=True)) if len(upward) else 1.0

    level = 0
    if tilt(2) < UPRIGHT_COSINE:
        level = min(range(3), key=tilt)
        used = "is level and is used as heading, with an offset to be estimated"
        notes = note("heading_mounting", f"mounted on its side: its {'xyz'[level]} axis {used}")
    return _over_rows(partial(_bearing, level), ordered, norm), usable, notes


def _over_rows(function: Callable[..., Floats], q: Sequence[Floats], norm: Floats | float = 1.0) -> Floats:
    """Return `function` (n,) of the four columns, each divided by `norm`.

    It is computed in parts of `ROWS_AT_ONCE` rows, to limit the memory.
    """
    scaled, norms = np.empty(len(q[0])), np.broadcast_to(norm, len(q[0]))
    for lo in range(0, len(scaled), ROWS_AT_ONCE):
        rows = slice(lo, lo + ROWS_AT_ONCE)
        scaled[rows] = function(*(column[rows] / norms[rows] for column in q))
    return scaled


def _bearing(axis: int, x: Floats, y: Floats, z: Floats, w: Floats) -> Floats:
    """Return the direction of an axis of the sensor seen from above, counter-clockwise from east (n,) [rad]."""
    east, north, _ = turned_axis(axis, x, y, z, w)
    return np.arctan2(north, east)


def _written_order(
    q: Sequence[Floats], norm: Floats, usable: Bools, yaw_rate_radps: Floats | None
) -> tuple[Sequence[int], Note | None]:
    """Return the positions of x, y, z, w among the four fields, and a finding if they are not in this order.

    On the ground one axis of the sensor always stays upright. If no axis does, and in another order of the components
    the sensor is always level, this order is used.
    """
    rows = np.flatnonzero(usable)

    def unit(chosen: Ints) -> Floats:
        return np.column_stack([field[chosen] for field in q]) / norm[chosen, None]

    as_named, some = (0, 1, 2, 3), unit(rows[:: max(1, len(rows) // MOST_ORIENTATIONS)])
    # The vertical component of each axis of the sensor shows the share of the time in which the axis is not upright.
    upward = np.array([turned_axis(axis, *some.T)[2] for axis in range(3)])
    if len(some) < 2 or ((np.abs(upward) < UPRIGHT_COSINE).mean(axis=1) < TILTED_SHARE).any():
        return as_named, None
    rate = None if yaw_rate_radps is None else yaw_rate_radps[rows]
    for order, why in ORDERS:
        tilted = (np.abs(turned_axis(2, *some[:, order].T)[2]) < LEVEL_COSINE).mean()
        if tilted < TILTED_SHARE and _turns_with(unit(rows)[:, order], rate):
            return order, note("heading_mounting", why)
    return as_named, None


def _turns_with(unit: Floats, yaw_rate_radps: Floats | None) -> bool:
    """Return whether changes of yaw correlate with the gyro's turns; True without a gyro, and if it does not turn."""
    if yaw_rate_radps is None or not np.isfinite(yaw_rate_radps).all() or np.ptp(yaw_rate_radps) == 0:
        return True
    yaw = unwrapped(_bearing(0, *unit.T))
    # Turns are compared over many samples, because between two samples the noise is larger than the turn.
    edges = np.unique(np.linspace(0, len(yaw) - 1, STRETCHES + 1).astype(np.int64))
    turned, measured = np.diff(yaw[edges]), np.add.reduceat(yaw_rate_radps, edges[:-1])
    if len(turned) < 3 or float(np.ptp(turned)) == 0 or float(np.ptp(measured)) == 0:
        return False
    return float(np.corrcoef(turned, measured)[0, 1]) > CLEAR_CORRELATION


GYRO_TYPE = "sensor_msgs/Imu"
"""Message type of the turn rates of an inertial unit."""

GYRO_AXES = ("angular_velocity.x", "angular_velocity.y", "angular_velocity.z")
"""Fields of the turn rates about the axes of an inertial unit [rad/s]."""


def find_gyro(
    tables: Sequence[TopicTable],
    wheels_topic: str,
    heading_topic: str,
    clock: Clock,
    known: Mapping[str, StampedRows] = {},
) -> GyroSamples | None:
    """Return the turn rates of the best inertial unit, clockwise [rad/s]; None without one.

    The unit that is also the source of the heading is preferred, then a unit in the namespace of the wheels, then the
    unit with the most samples.

    Parameters
    ----------
    tables : all topics that were read
    wheels_topic, heading_topic : topics of the chosen wheels and of the chosen heading
    clock : clock of the stamps
    known : stamps of topics that were computed before
    """
    home = wheels_topic.strip("/").split("/")[0]
    gyros = []
    for table, stamps, (rate,) in inertial_units(tables, GYRO_AXES[2:], clock, known):
        near = table.topic == heading_topic, table.topic.strip("/").split("/")[0] == home, len(table)
        gyros.append((near, table.topic, stamps, rate if frame_convention(table)[0] == "ned" else -rate))
    return GyroSamples(*max(gyros, key=lambda gyro: gyro[:2])[1:]) if gyros else None


def inertial_units(
    tables: Sequence[TopicTable], axes: Sequence[str], clock: Clock, known: Mapping[str, StampedRows]
) -> Iterator[tuple[TopicTable, Ints, list[Floats]]]:
    """Yield the inertial units that have the fields `axes`, with stamps (n,) [ns] and turn rates (n,) of each field.

    The unit of the rates is not known here. Rates that are impossible in rad/s, or else in deg/s, are left out.
    """
    for table in tables:
        if table.message_type != GYRO_TYPE or len(table) < 2 or any(axis not in table.columns for axis in axes):
            continue
        rates = [table.floats(axis) for axis in axes]
        # The rates are in rad/s or in deg/s. Later, a comparison of turns shows which (`is_in_degrees`).
        sound: Bools = np.logical_and.reduce([np.abs(rate) <= FASTEST_RADPS for rate in rates])
        if np.count_nonzero(~sound) > LARGEST_BAD_SHARE * len(sound):
            sound = np.logical_and.reduce([np.abs(rate) * DEGREE <= FASTEST_RADPS for rate in rates])
        if np.count_nonzero(~sound) <= LARGEST_BAD_SHARE * len(sound) and any(np.ptp(rate[sound]) for rate in rates):
            stamps = (known.get(table.topic) or stamp_rows(table)).on(clock)
            rows, _, _ = increasing_rows(stamps, sound)
            yield table, stamps[rows], [rate[rows] for rate in rates]
