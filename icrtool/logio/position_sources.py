"""Messages that tell where the robot is: geodetic fixes, or positions that are metric already."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from icrtool.logio.stamps import StampedRows, stamp_rows
from icrtool.logio.topic_table import TopicTable
from icrtool.tables import Bools, Floats

REFERENCE_WORDS = re.compile(
    r"gps|gnss|fix|map|icp|lidar|laser|slam|loam|\blio\b|mocap|vicon|optitrack|qualisys|ground|truth|\bgt\b|total|station|"
    r"prism|leica|utm|global|navsat|\bins\b|vectornav|novatel|sbg|ublox",
    re.IGNORECASE,
)
"""Names of odometry and pose topics that are a reference, not the robot's own dead reckoning."""

REFERENCE_FRAMES = {"map", "world", "utm", "earth", "ecef", "gps", "local_enu", "enu", "mocap", "vicon"}

GOOD_STD_M = 0.3
"""Better than this a fix is RTK or nearly so, and the first choice as reference."""


@dataclass(frozen=True, slots=True)
class PositionSource:
    """Positions of one topic.

    Attributes
    ----------
    geodetic : (n, 3) latitude, longitude [deg], ellipsoidal height [m]; None where metric
    metric : (n, 2) north, east [m] in the topic's own frame; None where geodetic
    variance : (n, 3) north, east, covariance of both [m^2]; NaN where not told
    usable : (n,) rows to use; `rejected` counts the others by reason
    has_orientation : the same message tells the heading in the same frame
    """

    topic: str
    message_type: str
    stamps: StampedRows
    geodetic: Floats | None
    metric: Floats | None
    variance: Floats
    usable: Bools
    rejected: dict[str, int] = field(default_factory=dict)
    has_orientation: bool = False
    score: float = 0.0
    why: str = ""
    problem: str = ""


def _geodetic(
    table: TopicTable, geodetic: Floats, variance: Floats, no_fix: Bools, score: float, what: str, stamp: str = "header.stamp"
) -> PositionSource:
    """Build a source from latitude, longitude, height; drop rows without a fix, not finite, or at 0, 0."""
    rejected: dict[str, int] = {}
    usable = np.ones(len(table), np.bool_)
    latitude, longitude = geodetic[:, 0], geodetic[:, 1]
    with np.errstate(invalid="ignore"):
        possible = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0)  # noqa: PLR2004 - degrees
    reasons = (
        ("no fix", no_fix),
        ("not finite", ~np.isfinite(latitude) | ~np.isfinite(longitude)),
        ("not a place on earth", ~possible),
        ("at 0, 0", (latitude == 0) & (longitude == 0)),
    )
    for reason, bad in reasons:
        count = int(np.count_nonzero(bad & usable))
        if count:
            rejected[reason] = count
        usable &= ~bad
    height = geodetic[:, 2]
    known = np.isfinite(height) & usable
    filled = np.where(np.isfinite(height), height, float(np.median(height[known])) if known.any() else 0.0)
    std = float(np.sqrt(np.nanmedian(variance[usable, :2]))) if np.isfinite(variance[usable, :2]).any() else float("nan")
    if std > GOOD_STD_M:
        score -= 35.0
    stated = f", states ±{std:.2g} m" if np.isfinite(std) else ", states no accuracy"
    return PositionSource(
        table.topic, table.message_type, stamp_rows(table, stamp),
        np.column_stack([latitude, longitude, filled]), None, variance, usable, rejected,
        score=score, why=f"{what}{stated}", problem="" if usable.any() else "no usable fix",
    )  # fmt: skip


def _no_variance(table: TopicTable) -> Floats:
    return np.full((len(table), 3), np.nan)


def _enu_variance(table: TopicTable, path: str) -> Floats:
    """Return north, east, covariance of a row-major 3 x 3 ENU covariance."""
    return np.column_stack([table.floats(f"{path}[4]"), table.floats(f"{path}[0]"), table.floats(f"{path}[1]")])


def _navsatfix(table: TopicTable) -> PositionSource:
    status = table.columns["status.status"]
    variance = _enu_variance(table, "position_covariance")
    unknown = table.columns["position_covariance_type"] == 0
    # COVARIANCE_TYPE_UNKNOWN: drivers leave the numbers at 0, or put any there.
    variance[unknown] = np.nan
    geodetic = np.column_stack([table.floats(name) for name in ("latitude", "longitude", "altitude")])
    return _geodetic(table, geodetic, variance, status == -1, 100.0, "GNSS fix")


def _gpsfix(table: TopicTable) -> PositionSource:
    status = table.columns["status.status"]
    variance = _enu_variance(table, "position_covariance")
    unknown = table.columns["position_covariance_type"] == 0
    # err_horz is a 95 % radius: 2.45 standard deviations of a circular normal distribution.
    radius = table.floats("err_horz")
    from_radius = np.where(radius > 0, (radius / 2.45) ** 2, np.nan)
    for column in (0, 1):
        variance[:, column] = np.where(unknown, from_radius, variance[:, column])
    variance[unknown, 2] = 0.0
    geodetic = np.column_stack([table.floats(name) for name in ("latitude", "longitude", "altitude")])
    return _geodetic(table, geodetic, variance, status == -1, 92.0, "GNSS fix")


def _accuracy(std: Floats) -> Floats:
    variance = np.where(std > 0, std**2, np.nan)
    return np.column_stack([variance, variance, np.zeros(len(std))])


def _navpvt(table: TopicTable) -> PositionSource:
    geodetic = np.column_stack(
        [table.floats("lat") * 1e-7, table.floats("lon") * 1e-7, table.floats("height") * 1e-3]
    )
    no_fix = (table.columns["flags"] & 1) == 0
    return _geodetic(table, geodetic, _accuracy(table.floats("hAcc") * 1e-3), no_fix, 85.0, "u-blox position")


def _navhpposllh(table: TopicTable) -> PositionSource:
    latitude = table.floats("lat") * 1e-7 + table.floats("latHp") * 1e-9
    longitude = table.floats("lon") * 1e-7 + table.floats("lonHp") * 1e-9
    height = table.floats("height") * 1e-3 + table.floats("heightHp") * 1e-4
    invalid = (table.floats("flags").astype(np.int64) & 1) == 1 if "flags" in table.columns else np.zeros(len(table), np.bool_)
    geodetic = np.column_stack([latitude, longitude, height])
    return _geodetic(table, geodetic, _accuracy(table.floats("hAcc") * 1e-4), invalid, 86.0, "u-blox high precision position")


def _pvtgeodetic(table: TopicTable) -> PositionSource:
    geodetic = np.column_stack(
        [np.degrees(table.floats("latitude")), np.degrees(table.floats("longitude")), table.floats("height")]
    )
    mode = table.columns["mode"] & 0x0F
    no_fix = (mode == 0) | (table.columns["error"] != 0)
    return _geodetic(table, geodetic, _accuracy(table.floats("h_accuracy") * 0.01), no_fix, 85.0, "Septentrio position")


def _bestpos(table: TopicTable) -> PositionSource:
    geodetic = np.column_stack([table.floats(name) for name in ("lat", "lon", "height")])
    variance = np.column_stack(
        [table.floats("lat_sigma") ** 2, table.floats("lon_sigma") ** 2, np.zeros(len(table))]
    )
    computed = [text == "SOL_COMPUTED" for text in table.texts.get("solution_status", [])]
    codes = table.columns["solution_status"]
    no_fix = ~np.array([*computed, False])[codes]
    return _geodetic(table, geodetic, variance, no_fix, 85.0, "NovAtel position")


def _metric(pose: str, covariance: str, score: float, what: str) -> Callable[[TopicTable], PositionSource]:
    """Read a pose: x is east and y north of the topic's own frame, wherever that points."""

    def read(table: TopicTable) -> PositionSource:
        x, y = table.floats(f"{pose}position.x"), table.floats(f"{pose}position.y")
        variance = _no_variance(table)
        if covariance:
            var_x, var_y, cov = (table.floats(f"{covariance}[{i}]") for i in (0, 7, 1))
            told = (var_x > 0) & (var_y > 0)
            variance[told] = np.column_stack([var_y, var_x, cov])[told]
        usable = np.isfinite(x) & np.isfinite(y)
        named = bool(REFERENCE_WORDS.search(table.topic)) or table.text("header.frame_id").lstrip("/") in REFERENCE_FRAMES
        problem = "" if usable.any() else "no finite position"
        if not named and score < 70.0:  # noqa: PLR2004 - odometry, which may be the wheels' own
            problem = "its name and frame do not say that it is a reference, not the wheels' own dead reckoning"
        count = int(np.count_nonzero(~usable))
        return PositionSource(
            table.topic, table.message_type, stamp_rows(table), None, np.column_stack([y, x]), variance, usable,
            {"not finite": count} if count else {}, has_orientation=True, score=score, why=what, problem=problem,
        )  # fmt: skip

    return read


def pose_paths(pose: str, covariance: str = "") -> tuple[str, ...]:
    """Return the fields of a pose message that position and heading need."""
    paths = [
        "header.stamp.sec", "header.stamp.nanosec", "header.frame_id",
        *(f"{pose}position.{axis}" for axis in "xy"), *(f"{pose}orientation.{axis}" for axis in "xyzw"),
    ]  # fmt: skip
    return (*paths, *(f"{covariance}[{i}]" for i in (0, 1, 7, 35) if covariance))


_HEADER = ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id")
_COVARIANCE = tuple(f"position_covariance[{i}]" for i in (0, 1, 4))
_FIX = (*_HEADER, "status.status", "latitude", "longitude", "altitude", *_COVARIANCE, "position_covariance_type")

POSITION_TYPES: dict[str, tuple[tuple[str, ...], Callable[[TopicTable], PositionSource]]] = {
    "sensor_msgs/NavSatFix": (_FIX, _navsatfix),
    "gps_common/GPSFix": ((*_FIX, "err_horz"), _gpsfix),
    "gps_msgs/GPSFix": ((*_FIX, "err_horz"), _gpsfix),
    "ublox_msgs/NavPVT": (("lat", "lon", "height", "hAcc", "flags"), _navpvt),
    "ublox_msgs/NavHPPOSLLH": (
        ("lat", "latHp", "lon", "lonHp", "height", "heightHp", "hAcc", "flags"),
        _navhpposllh,
    ),
    "septentrio_gnss_driver/PVTGeodetic": (
        (*_HEADER, "latitude", "longitude", "height", "mode", "error", "h_accuracy"),
        _pvtgeodetic,
    ),
    "novatel_gps_msgs/NovatelPosition": (
        (*_HEADER, "solution_status", "lat", "lon", "height", "lat_sigma", "lon_sigma"),
        _bestpos,
    ),
    "geometry_msgs/PoseStamped": (pose_paths("pose."), _metric("pose.", "", 70.0, "metric pose")),
    "geometry_msgs/PoseWithCovarianceStamped": (
        pose_paths("pose.pose.", "pose.covariance"),
        _metric("pose.pose.", "pose.covariance", 70.0, "metric pose"),
    ),
    "nav_msgs/Odometry": (
        pose_paths("pose.pose.", "pose.covariance"),
        _metric("pose.pose.", "pose.covariance", 60.0, "metric position of an odometry message"),
    ),
}
"""By message type: the fields to take, and how to read them."""
