"""Messages that tell where the robot points: yaw in ENU, compass headings, antenna baselines."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from icrtool.logio.position_sources import pose_paths
from icrtool.logio.stamps import StampedRows, stamp_rows
from icrtool.logio.topic_table import TopicTable
from icrtool.tables import Bools, Floats

Convention = Literal["enu", "ned"]

QUATERNION_NORM_TOLERANCE = 0.1
_INS_WORDS = re.compile(r"\bins\b|vectornav|novatel|sbg|microstrain|xsens|gnss|gps|global|map|filtered", re.IGNORECASE)
_RAW_WORDS = re.compile(r"raw", re.IGNORECASE)
UPRIGHT_COSINE = math.cos(math.radians(45.0))
"""A sensor whose z axis is further than 45 deg from vertical is mounted on its side; its yaw is no heading."""


@dataclass(frozen=True, slots=True)
class HeadingSource:
    """Headings of one topic.

    Attributes
    ----------
    yaw_rad : (n,) as told: counter-clockwise from east where `convention` is ``enu``, clockwise from north where ``ned``
    variance : (n,) [rad^2], NaN where not told
    usable : (n,)
    convention_why : how the convention is known
    yaw_rate_radps : (n,) counter-clockwise turn rate of a gyro in the same message, None without one
    """

    topic: str
    message_type: str
    stamps: StampedRows
    yaw_rad: Floats
    variance: Floats
    usable: Bools
    convention: Convention
    convention_why: str
    yaw_rate_radps: Floats | None = None
    score: float = 0.0
    why: str = ""
    problem: str = ""
    note: str = ""

    def heading_rad(self, convention: Convention) -> Floats:
        """Return headings clockwise from north in (-pi, pi]."""
        heading = self.yaw_rad if convention == "ned" else math.pi / 2 - self.yaw_rad
        return np.pi - np.mod(np.pi - heading, 2 * np.pi)


def _quaternion(table: TopicTable, path: str) -> Floats:
    return np.column_stack([table.floats(f"{path}.{axis}") for axis in "xyzw"])


def _yaw(q: Floats) -> tuple[Floats, Bools, str]:
    """Return yaw [rad], which rows are rotations, and a note where the sensor is not mounted upright.

    Yaw is that of the sensor's x axis seen from above. A sensor on its side has another axis level all the time: that
    axis is used then, and points somewhere at a fixed angle to the robot's nose.
    """
    norm = np.linalg.norm(q, axis=1)
    usable = np.isfinite(norm) & (np.abs(norm - 1.0) < QUATERNION_NORM_TOLERANCE)
    x, y, z, w = (np.where(usable, q[:, i] / np.where(norm > 0, norm, 1.0), np.nan) for i in range(4))
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z)],
            [2 * (x * z + w * y), 2 * (y * z - w * x)],
        ]
    )
    vertical = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    upright = float(np.median(np.abs(vertical[2][usable]))) if usable.any() else 1.0
    if upright >= UPRIGHT_COSINE:
        return np.arctan2(axes[0, 1], axes[0, 0]), usable, ""
    level = int(np.argmin([np.median(np.abs(v[usable])) for v in vertical]))
    note = f"mounted on its side: its {'xyz'[level]} axis is level and stands for the nose, at an angle still to be found"
    return np.arctan2(axes[level, 1], axes[level, 0]), usable, note


def _frame_convention(table: TopicTable) -> tuple[Convention, str]:
    frame = table.text("header.frame_id")
    if frame.lower().endswith("_ned") or frame.lower() == "ned":
        return "ned", f"frame {frame} (REP-145)"
    return "enu", "REP-103"


def _constant(yaw: Floats, usable: Bools) -> bool:
    return bool(usable.any()) and float(np.ptp(yaw[usable])) == 0.0


def _orientation(
    path: str, covariance: str, place: int, score: float, what: str, *, compass: bool = False
) -> Callable[[TopicTable], HeadingSource]:
    """Read an orientation; `place` is that of the yaw variance in the covariance."""

    def read(table: TopicTable) -> HeadingSource:
        yaw, usable, note = _yaw(_quaternion(table, path))
        variance = table.floats(f"{covariance}[{place}]") if covariance else np.full(len(table), np.nan)
        variance = np.where(variance > 0, variance, np.nan)
        convention, why = ("ned", "compass angle as yaw") if compass else _frame_convention(table)
        lowered, problem = score, ""
        if covariance and place == 8 and np.all(table.floats(f"{covariance}[0]") == -1.0):  # noqa: PLR2004 - 3 x 3
            problem = "tells no orientation (covariance -1, REP-145)"
        elif not usable.any():
            problem = "no valid quaternion"
        elif _constant(yaw, usable):
            problem = "its orientation never changes"
        if _RAW_WORDS.search(table.topic):
            lowered -= 10.0
        rate = table.floats("angular_velocity.z") if "angular_velocity.z" in table.columns else None
        return HeadingSource(
            table.topic, table.message_type, stamp_rows(table), yaw, variance, usable, convention, why,
            rate, lowered, what, problem, note,
        )  # fmt: skip

    return read


def _odometry(table: TopicTable) -> HeadingSource:
    read = _orientation("pose.pose.orientation", "pose.covariance", 35, 60.0, "orientation of an odometry message")
    source = read(table)
    named = _INS_WORDS.search(table.topic) is not None
    return source if named else _rescored(source, 30.0)


def _rescored(source: HeadingSource, score: float) -> HeadingSource:
    from dataclasses import replace

    return replace(source, score=score)


def _azimuth(table: TopicTable) -> HeadingSource:
    """Read compass_msgs/Azimuth: the message says unit, orientation and reference itself."""
    degrees = table.columns["unit"] == 1
    factor = np.where(degrees, np.pi / 180.0, 1.0)
    yaw = table.floats("azimuth") * factor
    ned = bool(np.median(table.columns["orientation"]) == 1)
    reference = {0: "magnetic", 1: "geographic", 2: "UTM"}.get(int(np.median(table.columns["reference"])), "unknown")
    variance = table.floats("variance") * factor**2
    return HeadingSource(
        table.topic, table.message_type, stamp_rows(table), yaw, np.where(variance > 0, variance, np.nan),
        np.isfinite(yaw), "ned" if ned else "enu", "the message says so", None, 95.0, f"azimuth, {reference} north",
        "" if np.isfinite(yaw).any() else "no finite azimuth",
    )  # fmt: skip


_RELPOS_VALID, _HEADING_VALID = 1 << 2, 1 << 8


def _relposned(table: TopicTable) -> HeadingSource:
    """Read ublox_msgs/NavRELPOSNED9 (or the older NavRELPOSNED): the bearing of the antenna baseline."""
    flags = table.columns["flags"]
    if "relPosHeading" in table.columns:
        heading = np.radians(table.floats("relPosHeading") * 1e-5)
        std = np.radians(table.floats("accHeading") * 1e-5)
        usable = (flags & _HEADING_VALID) != 0
    else:
        north, east = table.floats("relPosN"), table.floats("relPosE")
        heading = np.arctan2(east, north)
        length = np.hypot(north, east)
        acc = np.hypot(table.floats("accN"), table.floats("accE")) * 0.01
        std = np.divide(acc, length, out=np.full(len(table), np.nan), where=length > 0)
        usable = ((flags & _RELPOS_VALID) != 0) & (length > 0)
    return HeadingSource(
        table.topic, table.message_type, stamp_rows(table), heading, np.where(std > 0, std**2, np.nan), usable,
        "ned", "u-blox: clockwise from north", None, 90.0, "u-blox moving base: bearing of the antenna baseline",
        "" if usable.any() else "no valid heading",
    )  # fmt: skip


def _degrees(path: str, deviation: str, score: float, what: str) -> Callable[[TopicTable], HeadingSource]:
    """Read a heading in degrees clockwise from north."""

    def read(table: TopicTable) -> HeadingSource:
        heading, std = np.radians(table.floats(path)), np.radians(table.floats(deviation))
        usable = np.isfinite(heading) & (np.abs(heading) <= 4 * np.pi)
        return HeadingSource(
            table.topic, table.message_type, stamp_rows(table), heading, np.where(std > 0, std**2, np.nan), usable,
            "ned", "degrees clockwise from north", None, score, what, "" if usable.any() else "no valid heading",
        )  # fmt: skip

    return read


_HEADER = ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id")
_ORIENTATION = tuple(f"orientation.{axis}" for axis in "xyzw")

HEADING_TYPES: dict[str, tuple[tuple[str, ...], Callable[[TopicTable], HeadingSource]]] = {
    "sensor_msgs/Imu": (
        (*_HEADER, *_ORIENTATION, "orientation_covariance[0]", "orientation_covariance[8]", "angular_velocity.z"),
        _orientation("orientation", "orientation_covariance", 8, 100.0, "orientation of the inertial unit"),
    ),
    "geometry_msgs/PoseStamped": (
        pose_paths("pose."),
        _orientation("pose.orientation", "", 0, 50.0, "orientation of the pose"),
    ),
    "geometry_msgs/PoseWithCovarianceStamped": (
        pose_paths("pose.pose.", "pose.covariance"),
        _orientation("pose.pose.orientation", "pose.covariance", 35, 50.0, "orientation of the pose"),
    ),
    "nav_msgs/Odometry": (pose_paths("pose.pose.", "pose.covariance"), _odometry),
    "geometry_msgs/QuaternionStamped": (
        (*_HEADER, *(f"quaternion.{axis}" for axis in "xyzw")),
        _orientation("quaternion", "", 0, 80.0, "heading of the GNSS receiver (nmea_navsat_driver)", compass=True),
    ),
    "compass_msgs/Azimuth": ((*_HEADER, "azimuth", "variance", "unit", "orientation", "reference"), _azimuth),
    "compass_interfaces/Azimuth": ((*_HEADER, "azimuth", "variance", "unit", "orientation", "reference"), _azimuth),
    "ublox_msgs/NavRELPOSNED9": (("relPosHeading", "accHeading", "flags"), _relposned),
    "ublox_msgs/NavRELPOSNED": (("relPosN", "relPosE", "accN", "accE", "flags"), _relposned),
    "septentrio_gnss_driver/AttEuler": (
        (*_HEADER, "heading"),
        _degrees("heading", "", 88.0, "Septentrio attitude"),
    ),
    "novatel_gps_msgs/NovatelDualAntennaHeading": (
        (*_HEADER, "heading", "heading_sigma"),
        _degrees("heading", "heading_sigma", 90.0, "NovAtel dual antenna heading"),
    ),
    "novatel_gps_msgs/NovatelHeading2": (
        (*_HEADER, "heading", "heading_sigma"),
        _degrees("heading", "heading_sigma", 90.0, "NovAtel dual antenna heading"),
    ),
    "novatel_gps_msgs/Inspvax": (
        (*_HEADER, "azimuth", "azimuth_std"),
        _degrees("azimuth", "azimuth_std", 92.0, "NovAtel INS azimuth"),
    ),
}
"""By message type: the fields to take, and how to read them."""
