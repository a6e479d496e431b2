"""Input of the log writer: sensor columns in the frames of `icrtool`, and how a robot would have recorded them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal

from icrtool.errors import ConfigError

if TYPE_CHECKING:
    from icrtool.records.tables import Floats, Ints

Container = Literal["mcap", "bag", "db3"]
WheelMessages = Literal["joint_states", "odometry", "float64_pair", "ticks", "jackal_feedback", "twist_stamped"]
Compression = Literal["none", "bz2", "lz4", "zstd", "zstd-file"]

COMPRESSIONS: dict[Container, tuple[Compression, ...]] = {
    "mcap": ("none", "lz4", "zstd"),
    "bag": ("none", "bz2", "lz4"),
    "db3": ("none", "zstd", "zstd-file"),
}
"""Compressions of each container. For db3, ``zstd`` compresses message by message, ``zstd-file`` the closed file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorColumns:
    """Measurements of the sensors on one drive, in the frames of `icrtool`: y right, heading clockwise from north.

    Attributes
    ----------
    wheel_stamp_ns : int64 (n,)
    wheel_position_left_m, wheel_position_right_m : float64 (n,), travel of each side since an arbitrary start
    wheel_v_left_mps, wheel_v_right_mps : float64 (n,), forward positive
    gnss_stamp_ns : int64 (m,)
    latitude_deg, longitude_deg : float64 (m,), WGS 84
    height_m : float64 (m,), above the ellipsoid
    gnss_std_m : float64 (m,), of north and of east; NaN writes a fix whose covariance is unknown
    gnss_status : int64 (m,), NavSatStatus: -1 none, 0 fix, 1 SBAS, 2 GBAS (RTK)
    heading_stamp_ns : int64 (k,)
    heading_rad : float64 (k,), clockwise from north
    yaw_rate_radps : float64 (k,), clockwise positive

    Notes
    -----
    A sensor without rows leaves its topics out of the log. Stamps need not increase: the log is written in their order.
    """

    wheel_stamp_ns: Ints
    wheel_position_left_m: Floats
    wheel_position_right_m: Floats
    wheel_v_left_mps: Floats
    wheel_v_right_mps: Floats
    gnss_stamp_ns: Ints
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    gnss_std_m: Floats
    gnss_status: Ints
    heading_stamp_ns: Ints
    heading_rad: Floats
    yaw_rate_radps: Floats

    def __post_init__(self) -> None:
        stamps: Ints = self.wheel_stamp_ns
        for field in fields(self):
            column = getattr(self, field.name)
            if field.name.endswith("stamp_ns"):
                stamps = column
            if column.shape != (len(stamps),):
                raise ValueError(f"SensorColumns.{field.name} has shape {column.shape}, its stamps ({len(stamps)},)")


@dataclass(frozen=True, slots=True, kw_only=True)
class WriteOptions:
    """How a log is recorded: container, message types and conventions.

    Attributes
    ----------
    container : ``mcap`` (one ROS 2 file), ``bag`` (one ROS 1 file) or ``db3`` (a ROS 2 directory, sqlite3 storage)
    wheels : message type of the wheels. ``float64_pair`` [m/s] and ``ticks`` (Int32, wraps) are pairs without header
    heading : convention of the Imu. ``enu``: REP-103. ``ned``: yaw is the compass heading, body z down, and the frame
        is ``imu_link_ned`` (REP-145)
    namespace : put before every topic (``/j100_0042``)
    compression : one of `COMPRESSIONS` of the container
    wheel_radius_m : converts metres to radians and counts
    track_width_m : b, by which a wheel controller divides for its angular velocity [m]
    counts_per_rev : encoder counts of one wheel revolution
    heading_std_deg : written as the orientation's covariance
    definitions : False: only the names of the types are written, as in ROS 2 Humble and older (not in a ROS 1 bag)
    """

    container: Container = "mcap"
    wheels: WheelMessages = "joint_states"
    heading: Literal["enu", "ned"] = "enu"
    namespace: str = ""
    compression: Compression = "none"
    wheel_radius_m: float
    track_width_m: float
    counts_per_rev: float = 8192.0
    heading_std_deg: float = 1.0
    definitions: bool = True

    def __post_init__(self) -> None:
        offered = COMPRESSIONS[self.container]
        if self.compression not in offered:
            why = f"{self.compression} does not exist in a {self.container} log"
            raise ConfigError("compression", why, f"choose {', '.join(offered)}")
        if not self.definitions and self.container == "bag":
            raise ConfigError("definitions", "a ROS 1 bag always carries them", "choose mcap or db3 to leave them out")
        for name in ("wheel_radius_m", "track_width_m", "counts_per_rev"):
            if not getattr(self, name) > 0:
                raise ConfigError(name, f"{getattr(self, name)} is not a positive number")
