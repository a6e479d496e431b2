"""Messages that hold the robot's heading: yaw in ENU, compass headings, antenna baselines."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Bools, Floats
from icrtool.logs.messages.nmea import HDT, NMEA_SENTENCE
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.inertial import Convention, frame_convention, nose_yaw
from icrtool.logs.streams.position_sources import (
    GOAL_WORDS,
    INS_SOLVED,
    INS_SOLVED_CODES,
    SOLVED,
    SOLVED_CODES,
    XBOT_FUSED,
    solved,
)
from icrtool.logs.streams.sources import NO_ROWS, Source, of_topic

_INS_WORDS = re.compile(r"\bins\b|vectornav|novatel|sbg|microstrain|xsens|gnss|gps|global|map|filtered", re.IGNORECASE)
_RAW_WORDS = re.compile(r"raw", re.IGNORECASE)
_ATTITUDE_WORDS = re.compile(r"quaternion|filter|imu|attitude|orientation|ahrs|xsens|mti", re.IGNORECASE)
"""Topics of QuaternionStamped that hold an inertial unit's orientation, not a receiver's compass angle."""

_RELPOS_VALID, _HEADING_VALID = 1 << 2, 1 << 8
_HEADING = ("relPosHeading", "rel_pos_heading")
_BASELINE = (
    (("relPosN", "rel_pos_n"), ("relPosHPN", "rel_pos_hpn")),
    (("relPosE", "rel_pos_e"), ("relPosHPE", "rel_pos_hpe")),
)
_BASELINE_ACCURACY = ("accN", "acc_n", "accE", "acc_e")
"""u-blox fields as ROS 1 and as ROS 2 spell them."""

_REFERENCES = {0.0: "magnetic", 1.0: "geographic", 2.0: "UTM"}
UNKNOWN_RAD2 = (2 * np.pi) ** 2
"""A heading with a standard deviation of a turn is not known yet: drivers of moving bases write 1000."""

LEAST_BASELINE_CM = 0.005
"""Half of what the fields of a baseline resolve: a shorter one has no direction."""

LARGEST_DEG = 720.0
"""A heading beyond this stands for "unknown": Septentrio writes -2e10."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadingSource(Source):
    """Headings of one topic.

    Attributes
    ----------
    yaw_rad : (n,) as recorded: counter-clockwise from east where `convention` is ``enu``, else clockwise from north
    variance : (n,) [rad^2], NaN where not stated
    usable : (n,)
    convention_why : how the convention is known
    note : what was assumed, for the user
    """

    yaw_rad: Floats = field(default_factory=lambda: np.empty(0))
    variance: Floats = field(default_factory=lambda: np.empty(0))
    usable: Bools = field(default_factory=lambda: NO_ROWS)
    convention: Convention = "enu"
    convention_why: str = ""
    note: str = ""

    @property
    def is_empty(self) -> bool:
        """Whether no row can be used, even where the topic is configured."""
        return not self.usable.any()

    def heading_rad(self, convention: Convention) -> Floats:
        """Return headings clockwise from north in (-pi, pi]."""
        heading = self.yaw_rad if convention == "ned" else math.pi / 2 - self.yaw_rad
        return np.pi - np.mod(np.pi - heading, 2 * np.pi)


HeadingEntry = tuple[tuple[str, ...], Callable[[TopicTable], HeadingSource]]
"""The fields of a message type to take, and how to read them."""


def _quaternion(table: TopicTable, path: str) -> Floats:
    return np.array([table.column(f"{path}.{axis}") for axis in "xyzw"], np.float64).T


def _constant(yaw: Floats, usable: Bools) -> bool:
    return bool(usable.any()) and float(np.ptp(yaw[usable])) == 0.0


def _orientation(
    path: str, covariance: str, place: int, score: float, what: str, *, stuffed: bool = False, rate: str = ""
) -> HeadingEntry:
    """Return the entry of an orientation; `place` is the index of the yaw variance in the covariance.

    `rate`: field of the turn rate of a gyro in the same message.
    `stuffed`: some drivers of GNSS receivers write a compass angle into the quaternion as if it were a yaw.
    """

    def read(table: TopicTable) -> HeadingSource:
        turning = table.floats(rate) if rate in table.columns else None
        yaw, usable, note = nose_yaw(_quaternion(table, path), turning)
        variance = table.floats(f"{covariance}[{place}]") if covariance else np.full(len(table), np.nan)
        variance = np.where(variance > 0, variance, np.nan)
        unknown = variance >= UNKNOWN_RAD2
        # where all are, the number means nothing
        usable = usable if unknown[usable].all() else usable & ~unknown
        convention, why = frame_convention(table)
        if stuffed and not _ATTITUDE_WORDS.search(table.topic):
            convention, why = "ned", "compass angle as yaw"
        lowered, problem = score, ""
        if covariance and place == 8 and np.all(table.floats(f"{covariance}[0]") == -1.0):
            problem = "holds no orientation (covariance -1, REP-145)"
        elif not usable.any():
            problem = "no valid quaternion"
        elif _constant(yaw, usable):
            problem = "its orientation never changes"
        elif GOAL_WORDS.search(table.topic):
            problem = "its name is that of a goal, not of a measurement"
        if _RAW_WORDS.search(table.topic):
            lowered -= 10.0
        return HeadingSource(
            **of_topic(table), yaw_rad=yaw, variance=variance, usable=usable, convention=convention, convention_why=why,
            score=lowered, why=what, problem=problem, note=note,
        )  # fmt: skip

    variances = tuple(f"{covariance}[{i}]" for i in (0, place) if covariance)
    return (*HEADER, *(f"{path}.{axis}" for axis in "xyzw"), *variances, *(name for name in (rate,) if name)), read


_POSE = _orientation("pose.pose.orientation", "pose.covariance", 35, 60.0, "orientation of an odometry message")


def _odometry(table: TopicTable) -> HeadingSource:
    source = _POSE[1](table)
    return source if _INS_WORDS.search(table.topic) else replace(source, score=30.0)


def _stated(
    table: TopicTable, heading: Floats, variance: Floats, usable: Bools, score: float, what: str, convention_why: str
) -> HeadingSource:
    """Return headings clockwise from north (n,), with the variances (n,) that the messages state, NaN for unknown."""
    finite = np.isfinite(heading)
    heading, usable = np.where(finite, heading, np.nan), usable & finite
    return HeadingSource(
        **of_topic(table), yaw_rad=heading, variance=variance, usable=usable, convention="ned",
        convention_why=convention_why, score=score, why=what, problem="" if usable.any() else "no valid heading",
    )  # fmt: skip


def _azimuth(table: TopicTable) -> HeadingSource:
    """Return the headings of an Azimuth of the compass stack: the message states unit, orientation and reference."""
    factor = np.where(table.column("unit") == 1, np.pi / 180.0, 1.0)
    yaw = table.column("azimuth") * factor
    orientation = table.column("orientation")
    ned = bool(np.median(orientation) == 1)
    # Rows of the other orientation are converted: pi/2 - yaw, in both directions.
    yaw = np.where((orientation == 1) == ned, yaw, np.pi / 2 - yaw)
    codes = table.floats("reference")
    reference = _REFERENCES.get(float(np.median(codes)), "unknown") if len(codes) else "unknown"
    variance, what = table.floats("variance") * factor**2, f"azimuth, {reference} north"
    variance = np.where(variance > 0, variance, np.nan)
    source = _stated(table, yaw, variance, np.ones(len(yaw), np.bool_), 95.0, what, "stated in the message")
    return source if ned else replace(source, convention="enu")


def _relposned(table: TopicTable) -> HeadingSource:
    """Return the bearings of the antenna baseline of ublox_msgs/NavRELPOSNED9 (or the older NavRELPOSNED)."""
    flags = table.integers("flags")
    if flags is None:
        raise DefinitionError(table.topic, f"its {table.message_type} has no flags")
    if table.find(*_HEADING) is not None:
        needed = _RELPOS_VALID | _HEADING_VALID
        heading = np.radians(table.column(*_HEADING) * 1e-5)
        std = np.radians(table.floats("accHeading", "acc_heading") * 1e-5)
        usable = (flags & needed) == needed
    else:
        north, east = (table.column(*names) + 0.01 * np.nan_to_num(table.floats(*fine)) for names, fine in _BASELINE)
        heading, length = np.arctan2(east, north), np.hypot(north, east)
        measured = (length > LEAST_BASELINE_CM) & np.isfinite(length)
        # The baseline in cm, its accuracy in 0.1 mm.
        acc = np.maximum(table.floats("accN", "acc_n"), table.floats("accE", "acc_e")) * 0.01
        std = np.divide(acc, length, out=np.full(len(table), np.nan), where=measured)
        usable = ((flags & _RELPOS_VALID) != 0) & measured
    what = "u-blox moving base: bearing of the antenna baseline"
    variance = np.where(std > 0, std**2, np.nan)
    return _stated(table, heading, variance, usable, 90.0, what, "u-blox: clockwise from north")


def _degrees(
    path: str, deviation: str, score: float, what: str, status: str = "",
    accepted: frozenset[str] | frozenset[int] = frozenset[int](),
) -> HeadingEntry:  # fmt: skip
    """Return the entry of degrees clockwise from north; `accepted` are the values of `status` that mean a solution."""

    def read(table: TopicTable) -> HeadingSource:
        degrees = table.column(path).astype(np.float64)
        std = np.radians(table.floats(deviation))
        usable = np.abs(degrees) <= LARGEST_DEG
        if status:
            usable = usable & solved(table, status, accepted)
        heading = np.radians(np.where(np.abs(degrees) <= LARGEST_DEG, degrees, np.nan))
        variance = np.where(std > 0, std**2, np.nan)
        return _stated(table, heading, variance, usable, score, what, "degrees clockwise from north")

    return (*HEADER, *(name for name in (path, deviation, status) if name)), read


def _septentrio(deviation: str, mode: str, score: float, what: str) -> HeadingEntry:
    """Return the entry of a Septentrio attitude: ENU unless `use_ros_axis_orientation` was off, which none states."""
    fields, read_degrees = _degrees("heading", deviation, score, what)

    def read(table: TopicTable) -> HeadingSource:
        source = read_degrees(table)
        usable = source.usable
        for path, sound in (("error", table.floats("error") == 0), (mode, table.floats(mode) != 0)):
            usable = usable & sound if path in table.columns else usable
        problem = "" if usable.any() else "no valid heading"
        why = "the Septentrio driver's default, use_ros_axis_orientation"
        return replace(source, usable=usable, problem=problem, convention="enu", convention_why=why)

    return (*fields, "error", *(name for name in (mode,) if name)), read


def _nmea(table: TopicTable) -> HeadingSource:
    """Return the true headings of HDT."""
    headings = table.rows(table.column("sentence_kind") == HDT)
    if not len(headings):
        raise DefinitionError(table.topic, "none of its sentences is HDT")
    heading = np.radians(headings.column("heading"))
    unknown = np.full(len(headings), np.nan)
    all_of_them = np.ones(len(headings), np.bool_)
    what = "NMEA: clockwise from true north"
    return _stated(headings, heading, unknown, all_of_them, 88.0, "heading of the GNSS receiver (HDT)", what)


def _location_fix(table: TopicTable) -> HeadingSource:
    """Return the headings of Foxglove's LocationFix, clockwise from north."""
    variance = table.floats("heading_variance")
    variance, usable = np.where(variance > 0, variance, np.nan), np.ones(len(table), np.bool_)
    what = "Foxglove: clockwise from north"
    return _stated(table, table.column("heading"), variance, usable, 88.0, "heading of the GNSS receiver", what)


def _absolute_pose(table: TopicTable) -> HeadingSource:
    """Return the headings of OpenMower, counter-clockwise from east, where its receiver has two antennas."""
    std = table.floats("orientation_accuracy")
    variance = np.where(std > 0, std**2, np.nan)
    valid = table.floats("orientation_valid") != 0
    source = table.floats("source")
    score = 30.0 if len(source) and np.median(source) == XBOT_FUSED else 90.0
    stated = _stated(table, table.floats("vehicle_heading"), variance, valid, score, "OpenMower's heading", "REP-103")
    return replace(stated, convention="enu")


_AZIMUTH = ((*HEADER, "azimuth", "variance", "unit", "orientation", "reference"), _azimuth)
_DUAL = _degrees("heading", "heading_sigma", 90.0, "NovAtel dual antenna heading", "solution_status", SOLVED)
_INS = "NovAtel INS azimuth"

HEADING_TYPES: dict[str, HeadingEntry] = {
    "sensor_msgs/Imu": _orientation(
        "orientation", "orientation_covariance", 8, 100.0, "orientation of the inertial unit", rate="angular_velocity.z"
    ),
    "geographic_msgs/GeoPoseStamped": _orientation("pose.orientation", "", 0, 50.0, "orientation of the pose"),
    "geometry_msgs/PoseStamped": _orientation("pose.orientation", "", 0, 50.0, "orientation of the pose"),
    "foxglove.PoseInFrame": _orientation("pose.orientation", "", 0, 50.0, "orientation of the pose"),
    "foxglove.LocationFix": ((*HEADER, "heading", "heading_variance"), _location_fix),
    "geometry_msgs/PoseWithCovarianceStamped": _orientation(
        "pose.pose.orientation", "pose.covariance", 35, 50.0, "orientation of the pose"
    ),
    "nav_msgs/Odometry": (_POSE[0], _odometry),
    "geometry_msgs/QuaternionStamped": _orientation(
        "quaternion", "", 0, 80.0, "heading of the GNSS receiver (nmea_navsat_driver)", stuffed=True
    ),
    NMEA_SENTENCE: ((*HEADER, "sentence"), _nmea),
    "xbot_msgs/AbsolutePose": (
        (*HEADER, "vehicle_heading", "orientation_valid", "orientation_accuracy", "source"),
        _absolute_pose,
    ),
    "compass_msgs/Azimuth": _AZIMUTH,
    "compass_interfaces/Azimuth": _AZIMUTH,
    "ublox_msgs/NavRELPOSNED9": ((*_HEADING, "accHeading", "acc_heading", "flags"), _relposned),
    "ublox_msgs/NavRELPOSNED": (
        (*(name for pair in _BASELINE for names in pair for name in names), *_BASELINE_ACCURACY, "flags"),
        _relposned,
    ),
    "septentrio_gnss_driver/AttEuler": _septentrio("", "mode", 88.0, "Septentrio attitude"),
    "septentrio_gnss_driver/INSNavGeod": _septentrio("heading_std_dev", "", 89.0, "Septentrio INS attitude"),
    "novatel_gps_msgs/NovatelDualAntennaHeading": _DUAL,
    "novatel_gps_msgs/NovatelHeading2": _DUAL,
    "novatel_gps_msgs/Gphdt": _degrees("heading", "", 88.0, "NovAtel true heading (HDT)"),
    "novatel_gps_msgs/Inspva": _degrees("azimuth", "", 90.0, _INS, "status", INS_SOLVED),
    "novatel_gps_msgs/Inspvax": _degrees("azimuth", "azimuth_std", 92.0, _INS, "ins_status", INS_SOLVED),
    "novatel_oem7_msgs/HEADING2": _degrees(
        "heading", "heading_stdev", 90.0, "NovAtel dual antenna heading", "sol_status.status", SOLVED_CODES
    ),
    "novatel_oem7_msgs/INSPVA": _degrees("azimuth", "", 90.0, _INS, "status.status", INS_SOLVED_CODES),
    "novatel_oem7_msgs/INSPVAX": _degrees(
        "azimuth", "azimuth_stdev", 92.0, _INS, "ins_status.status", INS_SOLVED_CODES
    ),
}
"""By message type: the fields to take, and how to read them."""
