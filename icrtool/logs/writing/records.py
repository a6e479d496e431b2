"""How a robot would have recorded sensor columns: the options of the log writer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from icrtool.errors import ConfigError

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
