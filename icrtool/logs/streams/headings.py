"""Messages that hold the robot's heading: yaw in ENU, compass headings, antenna baselines; and turn rates of gyros."""

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
from icrtool.logs.streams.gyro_units import DEGREE, FASTEST_RADPS, MOST_BAD
from icrtool.logs.streams.positions import GOAL, GOAL_WORDS, is_fused
from icrtool.logs.streams.sources import (
    Clock,
    Convention,
    HeadingSource,
    StampedRows,
    all_valid,
    fields_in,
    increasing_rows,
    number_of,
    of_topic,
    stamp_rows,
)
from icrtool.records.notes import Note, note
from icrtool.records.samples import GyroSamples

FUSED_WORTH = 30.0
"""Worth of a heading that is fused with the wheels."""


@dataclass(frozen=True, slots=True)
class Bearing:
    """A message type with an angle that is the heading.

    Attributes
    ----------
    what, worth : what it is called where it is chosen, and how suitable it is
    angle, std, variance : to rad and rad^2, as `number_of` reads them; std and variance: either or none. Degrees of 720
        and more stand for "unknown": Septentrio writes -2e10
    valid : checks, all of which a heading must pass
    convention, known_by : ``ned``: clockwise from north, ``enu``: counter-clockwise from east; how that is known
    independent : checks of an independent heading; if half of the messages fail, it is fused with the wheels
    """

    what: str
    worth: float
    angle: str = "heading < 720 * deg"
    std: str = ""
    variance: str = ""
    valid: tuple[str, ...] = ()
    convention: Convention = "ned"
    known_by: str = "degrees clockwise from north"
    independent: tuple[str, ...] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read."""
        return fields_in((self.angle, self.std, self.variance), (*self.valid, *self.independent))

    def read(self, table: TopicTable, _: Config) -> HeadingSource:
        """Return its headings."""
        angle, variance = number_of(table, self.angle, needed=True), np.full(len(table), np.nan)
        if self.variance:
            variance = number_of(table, self.variance)
        elif self.std:
            std = number_of(table, self.std)
            variance = std * np.abs(std)  # keeps the sign: a deviation that is not positive counts as not stated
        worth = min(self.worth, FUSED_WORTH) if is_fused(table, self.independent) else self.worth
        return replace(self, worth=worth).of(table, angle, variance, all_valid(table, self.valid))

    def of(self, table: TopicTable, angle: Floats, variance: Floats, valid: Bools) -> HeadingSource:
        """Return headings of angles [rad] (n,), their variances [rad^2] (n,), and which are valid (n,)."""
        yaw, stated = np.where(np.isfinite(angle), angle, np.nan), np.where(variance > 0, variance, np.nan)
        usable = valid & np.isfinite(angle)
        problem = "" if usable.any() else "no valid heading"
        return HeadingSource(
            **of_topic(table), yaw_rad=yaw, variance=stated, usable=usable, convention=self.convention,
            convention_why=self.known_by, score=self.worth, why=self.what, problem=problem,
        )  # fmt: skip


_NORTHS = {0.0: "magnetic", 1.0: "geographic", 2.0: "UTM"}
_AZIMUTH = Bearing("azimuth", 95.0, known_by="stated in the message")
AZIMUTH_FIELDS = ("azimuth", "variance", "unit", "orientation", "reference")


def read_azimuths(table: TopicTable, _: Config) -> HeadingSource:
    """Return the headings of an Azimuth of the compass stack: the message states unit, orientation and reference."""
    factor = np.where(table.column("unit") == 1, math.radians(1.0), 1.0)
    yaw = table.column("azimuth") * factor
    orientation = table.column("orientation")
    ned = bool(np.median(orientation) == 1)
    # Rows of the other orientation are converted: pi/2 - yaw, which holds in both directions.
    yaw = np.where((orientation == 1) == ned, yaw, np.pi / 2 - yaw)
    north = _NORTHS.get(float(np.median(table.floats("reference"))), "unknown")
    row = replace(_AZIMUTH, what=f"{_AZIMUTH.what}, {north} north", convention="ned" if ned else "enu")
    return row.of(table, yaw, table.floats("variance") * factor**2, np.ones(len(table), np.bool_))


BASELINE = Bearing(
    "u-blox moving base: bearing of the antenna baseline", 90.0, "relPosHeading|rel_pos_heading * 1e-5 * deg",
    "accHeading|acc_heading * 1e-5 * deg", valid=("flags & 260 == 260",), known_by="u-blox: clockwise from north",
)  # fmt: skip
"""Heading of an antenna baseline. Flag 4: the baseline is valid; flag 256: its heading is valid."""

_COMPONENTS = "relPosN|rel_pos_n + relPosHPN|rel_pos_hpn * 0.01", "relPosE|rel_pos_e + relPosHPE|rel_pos_hpe * 0.01"
_ACCURACIES, _BASELINE_VALID = ("accN|acc_n * 0.01", "accE|acc_e * 0.01"), ("flags & 4 == 4",)
BASELINE_FIELDS = fields_in((*_COMPONENTS, *_ACCURACIES), _BASELINE_VALID)
"""Fields of a baseline with components to the north and to the east [cm]."""

LEAST_BASELINE_CM = 0.005
"""Shortest baseline that has a direction [cm]: half of the resolution of its fields."""


def read_baselines(table: TopicTable, _: Config) -> HeadingSource:
    """Return the bearings of the antenna baseline of ublox_msgs/NavRELPOSNED, which states its components."""
    north, east = (number_of(table, one, needed=True) for one in _COMPONENTS)
    length = np.hypot(north, east)
    measured = (length > LEAST_BASELINE_CM) & np.isfinite(length)
    accuracy = np.maximum(*(number_of(table, one) for one in _ACCURACIES))
    std = np.divide(accuracy, length, out=np.full(len(table), np.nan), where=measured)
    valid = all_valid(table, _BASELINE_VALID) & measured
    return BASELINE.of(table, np.arctan2(east, north), std * np.abs(std), valid)


INS_WORDS = re.compile(r"\bins\b|vectornav|novatel|sbg|microstrain|xsens|gnss|gps|global|map|filtered", re.IGNORECASE)
_RAW_WORDS = re.compile(r"raw", re.IGNORECASE)
_ATTITUDE_WORDS = re.compile(r"quaternion|filter|imu|attitude|orientation|ahrs|xsens|mti", re.IGNORECASE)
"""Topics of QuaternionStamped that hold an inertial unit's orientation, not a receiver's compass angle."""

RAW = 10.0
"""Subtracted from the worth of a raw topic."""

NOT_INS = 30.0
"""Subtracted from the worth of an odometry of no inertial navigation system."""

UNKNOWN_RAD2 = (2 * np.pi) ** 2
"""Variance from which a heading counts as not known [rad^2], a standard deviation of one turn: drivers of moving bases
write 1000."""


@dataclass(frozen=True, slots=True)
class Orientation:
    """A message type with an orientation.

    Attributes
    ----------
    what, worth : what it is called where it is chosen, and how suitable it is
    path : the field of the quaternion
    variance : the field of the variance of yaw
    absent : the field that is -1 where messages hold no orientation
    rate : the field of the turn rate of a gyro in the same message
    stuffed : some drivers of GNSS receivers write a compass angle into the quaternion as if it were a yaw
    odometry : preferred where its name shows an inertial navigation system
    """

    what: str
    worth: float
    path: str
    variance: str = ""
    absent: str = ""
    rate: str = ""
    stuffed: bool = False
    odometry: bool = False

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read."""
        return fields_in((*(f"{self.path}.{axis}" for axis in "xyzw"), self.variance, self.absent, self.rate))

    def read(self, table: TopicTable, _: Config) -> HeadingSource:
        """Return the yaw of its orientations."""
        q = [table.column(f"{self.path}.{axis}").astype(np.float64, copy=False) for axis in "xyzw"]
        yaw, usable, mounting = nose_yaw(q, table.floats(self.rate) if self.rate in table.columns else None)
        variance = table.floats(self.variance)
        variance = np.where(variance > 0, variance, np.nan)
        unknown = variance >= UNKNOWN_RAD2
        # where all messages have it, the number means nothing
        usable = usable if unknown[usable].all() else usable & ~unknown
        convention, why = frame_convention(table)
        if self.stuffed and not _ATTITUDE_WORDS.search(table.topic):
            convention, why = "ned", "compass angle as yaw"
        problem = ""
        if np.all(table.floats(self.absent) == -1.0):
            problem = "holds no orientation (covariance -1, REP-145)"
        elif not usable.any():
            problem = "no valid quaternion"
        elif float(np.ptp(yaw[usable])) == 0.0:
            problem = "its orientation never changes"
        elif GOAL_WORDS.search(table.topic):
            problem = GOAL
        off = NOT_INS if self.odometry and not INS_WORDS.search(table.topic) else 0.0
        off += RAW if _RAW_WORDS.search(table.topic) else 0.0
        return HeadingSource(
            **of_topic(table), yaw_rad=yaw, variance=variance, usable=usable, convention=convention, convention_why=why,
            score=self.worth - off, why=self.what, problem=problem, notes=() if mounting is None else (mounting,),
        )  # fmt: skip


QUATERNION_NORM_TOLERANCE = 0.1
UPRIGHT_COSINE = math.cos(math.radians(45.0))
"""Cosine of the largest tilt of an upright sensor, 45 deg. With more tilt it is mounted on its side, and its yaw is no
heading."""

LEVEL_COSINE = math.cos(math.radians(30.0))
TILTED_SHARE = 0.01
"""Largest share of the time in which no axis of the sensor is upright, for a robot on the ground."""

CLEAR_CORRELATION = 0.5
STRETCHES = 200
MOST_ORIENTATIONS = 5000

ORDERS: tuple[tuple[tuple[int, int, int, int], str], ...] = (
    ((1, 2, 3, 0), "its quaternion is written w first: read as w, x, y, z"),
    ((3, 1, 2, 0), "its quaternion has x and w swapped: swapped back"),
)
"""Positions of x, y, z, w among the four fields, where a driver filled them in another order."""


def frame_convention(table: TopicTable) -> tuple[Convention, str]:
    """Return the convention of a message's frame, and how it is known."""
    frame = table.text(FRAME_FIELD)
    if frame.lower().endswith("_ned") or frame.lower() == "ned":
        return "ned", f"frame {frame} (REP-145)"
    return "enu", "REP-103"


def nose_yaw(q: Sequence[Floats], yaw_rate_radps: Floats | None = None) -> tuple[Floats, Bools, Note | None]:
    """Return yaw [rad] (n,), which rows are rotations (n,), and a note where the sensor is not mounted upright.

    Yaw is the direction of the sensor's x axis seen from above. In a sensor mounted on its side another axis is level
    all the time: this axis is used, and has a constant angle to the robot's forward axis.

    Parameters
    ----------
    q : the fields x, y, z, w, (n,) each
    yaw_rate_radps : (n,) of a gyro in the same message, with which a quaternion in another order must turn
    """
    with np.errstate(over="ignore"):
        norm = _of_rows(lambda *fields: np.sqrt(sum(field * field for field in fields)), q)
    off = norm - 1.0
    usable = np.abs(off, out=off) < QUATERNION_NORM_TOLERANCE
    del off
    norm[~usable] = np.nan
    places, notes = _written_order(q, norm, usable, yaw_rate_radps)
    ordered = [q[place] for place in places]

    def tilt(axis: int) -> float:
        upward = _of_rows(lambda *unit: np.abs(turned_axis(axis, *unit)[2]), ordered, norm)[usable]
        return float(np.median(upward, overwrite_input=True)) if len(upward) else 1.0

    level = 0
    if tilt(2) < UPRIGHT_COSINE:
        level = min(range(3), key=tilt)
        used = "is level and is used as heading, with an offset to be estimated"
        notes = note("heading_mounting", f"mounted on its side: its {'xyz'[level]} axis {used}")
    return _of_rows(partial(_bearing, level), ordered, norm), usable, notes


def _of_rows(make: Callable[..., Floats], q: Sequence[Floats], norm: Floats | float = 1.0) -> Floats:
    """Return the result (n,) of a function of four columns over their norm, computed in parts to bound memory."""
    scaled, norms = np.empty(len(q[0])), np.broadcast_to(norm, len(q[0]))
    for lo in range(0, len(scaled), ROWS_AT_ONCE):
        some = slice(lo, lo + ROWS_AT_ONCE)
        scaled[some] = make(*(field[some] / norms[some] for field in q))
    return scaled


def _bearing(axis: int, x: Floats, y: Floats, z: Floats, w: Floats) -> Floats:
    """Return the direction in which an axis of the sensor points, seen from above [rad] (n,)."""
    east, north, _ = turned_axis(axis, x, y, z, w)
    return np.arctan2(north, east)


def _written_order(
    q: Sequence[Floats], norm: Floats, usable: Bools, yaw_rate_radps: Floats | None
) -> tuple[Sequence[int], Note | None]:
    """Return the positions of x, y, z, w, and a note where they are not in this order.

    On the ground one axis of the sensor stays upright, whatever the mounting. If no axis does, and another order of the
    components gives a level sensor all the time, that order is used.
    """
    rows = np.flatnonzero(usable)

    def unit(chosen: Ints) -> Floats:
        return np.column_stack([field[chosen] for field in q]) / norm[chosen, None]

    as_named, some = (0, 1, 2, 3), unit(rows[:: max(1, len(rows) // MOST_ORIENTATIONS)])
    # For each axis of the sensor, the share of the time in which it is not upright.
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
    """Return whether yaw changes correlate with the gyro's; True where there is no gyro or it does not turn."""
    if yaw_rate_radps is None or not np.isfinite(yaw_rate_radps).all() or np.ptp(yaw_rate_radps) == 0:
        return True
    yaw = unwrapped(_bearing(0, *unit.T))
    # Over many samples: between two samples the noise is larger than the turn.
    edges = np.unique(np.linspace(0, len(yaw) - 1, STRETCHES + 1).astype(np.int64))
    turned, measured = np.diff(yaw[edges]), np.add.reduceat(yaw_rate_radps, edges[:-1])
    if len(turned) < 3 or float(np.ptp(turned)) == 0 or float(np.ptp(measured)) == 0:
        return False
    return float(np.corrcoef(turned, measured)[0, 1]) > CLEAR_CORRELATION


GYRO_TYPE = "sensor_msgs/Imu"
GYRO_AXES = ("angular_velocity.x", "angular_velocity.y", "angular_velocity.z")


def find_gyro(
    tables: Sequence[TopicTable],
    wheels_topic: str,
    heading_topic: str,
    clock: Clock,
    known: Mapping[str, StampedRows] = {},
) -> GyroSamples | None:
    """Return the turn rates of the best inertial unit, None without one.

    Parameters
    ----------
    tables : all topics that were read
    wheels_topic, heading_topic : the unit that is also the source of the heading is preferred, then one in the wheels'
        namespace, then the one with more samples
    clock : the clock of the other streams
    known : stamps of topics that were computed before
    """
    home = wheels_topic.strip("/").split("/")[0]
    gyros = []
    for table, stamps, (rate,) in inertial_units(tables, GYRO_AXES[2:], clock, known):
        near = table.topic == heading_topic, table.topic.strip("/").split("/")[0] == home, len(table)
        gyros.append((near, table.topic, stamps, rate if frame_convention(table)[0] == "ned" else -rate))
    return GyroSamples(*max(gyros, key=lambda one: one[:2])[1:]) if gyros else None


def inertial_units(
    tables: Sequence[TopicTable], axes: Sequence[str], clock: Clock, known: Mapping[str, StampedRows]
) -> Iterator[tuple[TopicTable, Ints, list[Floats]]]:
    """Yield the inertial units that measure about some axes, with the stamps (n,) and the sound rates about each."""
    for table in tables:
        if table.message_type != GYRO_TYPE or len(table) < 2 or any(axis not in table.columns for axis in axes):
            continue
        rates = [table.floats(axis) for axis in axes]
        # in rad/s or in deg/s: the turns show the unit later
        sound: Bools = np.logical_and.reduce([np.abs(one) <= FASTEST_RADPS for one in rates])
        if np.count_nonzero(~sound) > MOST_BAD * len(sound):
            sound = np.logical_and.reduce([np.abs(one) * DEGREE <= FASTEST_RADPS for one in rates])
        if np.count_nonzero(~sound) <= MOST_BAD * len(sound) and any(np.ptp(one[sound]) for one in rates):
            stamps = (known.get(table.topic) or stamp_rows(table)).on(clock)
            rows, _, _ = increasing_rows(stamps, sound)
            yield table, stamps[rows], [one[rows] for one in rates]
