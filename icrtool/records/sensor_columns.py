"""What the sensors of one drive measured, before it becomes messages of a log."""

from __future__ import annotations

from dataclasses import dataclass, fields

from icrtool.kernels.arrays import Floats, Ints


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
