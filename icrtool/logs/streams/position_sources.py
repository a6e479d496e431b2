"""Messages that hold the robot's position: geodetic fixes, and poses that are metric already, in their own frame."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np

from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Bools, Floats
from icrtool.logs.messages.nmea import GGA, GST, NMEA_SENTENCE, RMC
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.fixes import (
    GPSFIX_STATUS,
    NMEA_QUALITY,
    UBLOX_CARRIER,
    XBOT_FLAGS,
    axis_variance,
    class_by_carrier,
    class_by_code,
    class_by_mode,
    class_by_status,
    class_by_type,
    enu_variance,
    equal_variance,
    geodetic_source,
    nowhere,
    place_in,
    without_fix,
)
from icrtool.logs.streams.sources import PositionEntry, PositionSource, of_topic

REFERENCE_WORDS = re.compile(
    r"gps|gnss|(?<![a-z])fix|map|icp|lidar|laser|slam|loam|\blio\b|mocap|vicon|optitrack|qualisys|ground|truth|\bgt\b|total|station|"
    r"prism|leica|utm|global|navsat|\bins\b|vectornav|novatel|sbg|ublox",
    re.IGNORECASE,
)
"""In names of odometry and pose topics, or of their frames: a reference, not the robot's own dead reckoning."""

REFERENCE_FRAMES = {"world", "earth", "ecef", "local_enu", "enu", "camera_init"}
"""Names of frames that are no such words; FAST-LIO and LOAM call their map ``camera_init``."""

GOAL_WORDS = re.compile(r"goal|initial_?pose|cmd|command|desired|setpoint", re.IGNORECASE)

LEAST_AREA_M, FLAT, LARGEST_PLACE_M, MOST_PLACES = 1.0, 0.1, 1e8, 2000
"""A drive this wide (standard deviation) shows its plane where it is no thicker than a tenth of that."""

LEAST_RADIUS_M, LARGEST_RADIUS_M = 6.33e6, 6.40e6
"""Of the earth; UTM coordinates far from the equator may be as large, but have a height near 0."""

XBOT_FUSED, XBOT_DEAD_RECKONING = 100, 8
"""Source and flag of xbot_msgs/AbsolutePose: fused with the wheels; not by satellites."""


def metric(pose: str, covariance: str, score: float, what: str, *, odometry: bool = False) -> PositionEntry:
    """Return the entry of a pose: x is taken as east and y as north, in the topic's own frame."""

    def read(table: TopicTable) -> PositionSource:
        x, y = (table.column(f"{pose}position.{axis}").astype(np.float64) for axis in "xy")
        variance = np.full((len(table), 3), np.nan)
        if covariance:
            var_x, var_y, cov = (table.floats(f"{covariance}[{i}]") for i in (0, 7, 1))
            positive = (var_x > 0) & (var_y > 0)
            variance[positive] = np.column_stack([var_y, var_x, cov])[positive]
        usable = np.isfinite(x) & np.isfinite(y)
        frame = table.text("header.frame_id").lstrip("/")
        named = bool(REFERENCE_WORDS.search(f"{table.topic} {frame}")) or frame in REFERENCE_FRAMES
        problem = "" if usable.any() else "no finite position"
        places = np.column_stack([x, y, table.floats(f"{pose}position.z")])[usable]
        if len(places) and LEAST_RADIUS_M < np.linalg.norm(np.median(places, axis=0)) < LARGEST_RADIUS_M:
            problem = "its positions are counted from the centre of the earth (ECEF), which is not read"
        elif not _is_level(places):
            problem = "its positions lie in a plane that stands upright: z is not up, as in a camera's optical frame"
        if GOAL_WORDS.search(table.topic):
            problem = problem or "its name is that of a goal, not of a measurement"
        elif not named and (odometry or "odom" in table.topic.lower()):
            problem = (
                problem
                or "its name and frame do not show a position reference: it may be the wheels' dead reckoning; "
                "topics.gnss names it if it is a reference"
            )
        count = int(np.count_nonzero(~usable))
        return PositionSource(
            **of_topic(table), metric=np.column_stack([y, x]), variance=variance, usable=usable,
            rejected={"not finite": count} if count else {}, score=score, why=what, problem=problem,
        )  # fmt: skip

    variances = tuple(f"{covariance}[{i}]" for i in (0, 1, 7) if covariance)
    return (*HEADER, *(f"{pose}position.{axis}" for axis in "xyz"), *variances), read


def _is_level(places_m: Floats) -> bool:
    """Return whether a drive (n, 3) that has an area lies in a plane whose normal is within 45 deg of z."""
    some = places_m[:: max(1, len(places_m) // MOST_PLACES)]
    if len(some) < 3 or not (np.abs(some) < LARGEST_PLACE_M).all():
        return True
    # single jumps are no place
    kept = np.clip(some, *np.percentile(some, [2.5, 97.5], axis=0))
    _, size, axes = np.linalg.svd(kept - kept.mean(axis=0), full_matrices=False)
    _, across_m, off_m = size / math.sqrt(len(some))
    return bool(across_m < LEAST_AREA_M or off_m > FLAT * across_m or abs(axes[2, 2]) > math.sqrt(0.5))


_POSE_FIELDS, _read_pose = metric("pose.pose.", "pose.covariance", 90.0, "GNSS position of OpenMower")


def _absolute_pose(table: TopicTable) -> PositionSource:
    """Return the positions of OpenMower, x east and y north of its datum; its own filter's are refused."""
    pose = _read_pose(table)
    flags, source = table.integers("flags"), table.integers("source")
    std = table.floats("position_accuracy")
    stated = np.where((std > 0)[:, None], np.column_stack([std**2, std**2, np.zeros(len(std))]), np.nan)
    usable = pose.usable
    rejected = dict(pose.rejected)
    if flags is not None:
        dead = (flags & XBOT_DEAD_RECKONING) != 0
        rejected |= {"no fix": int(np.count_nonzero(dead & usable))} if dead.any() else {}
        usable = usable & ~dead
    problem = pose.problem or ("" if usable.any() else "no usable fix")
    if source is not None and len(source) and np.median(source) == XBOT_FUSED:
        problem = "its positions are fused with the wheels; a reference must be independent of them"
    return replace(
        pose,
        variance=np.where(np.isfinite(pose.variance), pose.variance, stated),
        usable=usable,
        rejected=rejected,
        stated_class=class_by_code(None if flags is None else flags & 7, XBOT_FLAGS),
        problem=problem,
    )


ABSOLUTE_POSE: PositionEntry = ((*_POSE_FIELDS, "source", "flags", "position_accuracy"), _absolute_pose)


RADIUS_95_IN_STD = 2.45
"""err_horz is a 95 % radius: this many standard deviations of a circular normal distribution."""

DEGREES = 180.0 / math.pi
SEPTENTRIO_UNKNOWN = 65535

SOLVED, SOLVED_CODES = frozenset({"SOL_COMPUTED"}), frozenset({0})
INS_SOLVED = frozenset({"INS_SOLUTION_GOOD", "INS_SOLUTION_FREE", "INS_ALIGNMENT_COMPLETE"})
INS_SOLVED_CODES = frozenset({3, 6, 7})
"""What NovAtel calls a solution, in words (novatel_gps_msgs) and as numbers (novatel_oem7_msgs)."""

H_ACC, LAT_HP, LON_HP, HEIGHT_HP = (
    ("hAcc", "h_acc"),
    ("latHp", "lat_hp"),
    ("lonHp", "lon_hp"),
    ("heightHp", "height_hp"),
)
"""u-blox fields as ROS 1 and as ROS 2 spell them."""


GST_NEAR_NS = 1_500_000_000
"""Receivers send GST with each fix, or once a second."""

UBX_FLAGS = ("gnss_fix_ok", "invalid_llh", "gps_fix.fix_type", "carr_soln.status")
UBX_NO_FIX = (0, 1, 5)
"""GpsFix of u-blox: none, dead reckoning only, time only."""


def _geopose(table: TopicTable) -> PositionSource:
    geodetic = place_in(table, *(f"{_GEO}{name}" for name in ("latitude", "longitude", "altitude")))
    unknown = np.full((len(table), 3), np.nan)
    return geodetic_source(
        table, geodetic, unknown, nowhere(table), 80.0, "position of an autopilot or navigation filter"
    )


def _navsatfix(table: TopicTable) -> PositionSource:
    geodetic = place_in(table, "latitude", "longitude", "altitude")
    fix_class = class_by_status(table)
    return geodetic_source(table, geodetic, enu_variance(table), without_fix(table), 100.0, "GNSS fix", fix_class)


def _gpsfix(table: TopicTable) -> PositionSource:
    variance = enu_variance(table)
    unknown = ~np.isfinite(variance[:, 0])
    radius = table.floats("err_horz")
    with np.errstate(over="ignore"):
        from_radius = np.where(radius > 0, (radius / RADIUS_95_IN_STD) ** 2, np.nan)
    for column in (0, 1):
        variance[:, column] = np.where(unknown, from_radius, variance[:, column])
    variance[unknown, 2] = np.where(np.isfinite(from_radius[unknown]), 0.0, np.nan)
    geodetic = place_in(table, "latitude", "longitude", "altitude")
    fix_class = class_by_status(table, GPSFIX_STATUS)
    return geodetic_source(table, geodetic, variance, without_fix(table), 92.0, "GNSS fix", fix_class)


def _navpvt(table: TopicTable) -> PositionSource:
    geodetic = place_in(table, "lat", "lon", "height") * (1e-7, 1e-7, 1e-3)
    flags = table.integers("flags")
    no_fix = nowhere(table) if flags is None else (flags & 1) == 0
    variance, fix_class = equal_variance(table.floats(*H_ACC) * 1e-3), class_by_carrier(flags)
    return geodetic_source(table, geodetic, variance, no_fix, 85.0, "u-blox position", fix_class)


def _ubx_navpvt(table: TopicTable) -> PositionSource:
    """Return the positions of ublox_dgnss, which spreads the flags over fields."""
    geodetic = place_in(table, "lat", "lon", "height") * (1e-7, 1e-7, 1e-3)
    no_fix = (table.floats("gnss_fix_ok") == 0) | (table.floats("invalid_llh") == 1)
    no_fix |= np.isin(table.floats("gps_fix.fix_type"), UBX_NO_FIX)
    variance = equal_variance(table.floats("h_acc") * 1e-3)
    fix_class = class_by_code(table.integers("carr_soln.status"), UBLOX_CARRIER)
    return geodetic_source(table, geodetic, variance, no_fix, 85.0, "u-blox position", fix_class)


def _nmea(table: TopicTable) -> PositionSource:
    """Return the fixes of GGA, with the deviations of the nearest GST; of RMC where there is no GGA."""
    kinds = table.column("sentence_kind")
    kind, name = (GGA, "GGA") if (kinds == GGA).any() else (RMC, "RMC")
    fixes, deviations = table.rows(kinds == kind), table.rows(kinds == GST)
    if not len(fixes):
        raise DefinitionError(table.topic, "none of its sentences is GGA or RMC")
    std = np.full((len(fixes), 2), np.nan)
    if len(deviations):
        times_ns = deviations.log_time_ns
        nearest = np.searchsorted(times_ns[:-1] + np.diff(times_ns) // 2, fixes.log_time_ns)
        near = np.abs(times_ns[nearest] - fixes.log_time_ns) < GST_NEAR_NS
        std[near] = np.column_stack([deviations.column("north_std"), deviations.column("east_std")])[nearest[near]]
    quality = fixes.column("quality")
    fix_class = class_by_code(quality, NMEA_QUALITY)
    no_fix = np.isin(quality, [*NMEA_QUALITY], invert=True)
    geodetic = place_in(fixes, "latitude", "longitude", "altitude")
    return geodetic_source(fixes, geodetic, axis_variance(*std.T), no_fix, 84.0, f"GNSS fix ({name})", fix_class)


def _navhpposllh(table: TopicTable) -> PositionSource:
    geodetic = place_in(table, "lat", "lon", "height") * (1e-7, 1e-7, 1e-3)
    for column, (names, unit) in enumerate(((LAT_HP, 1e-9), (LON_HP, 1e-9), (HEIGHT_HP, 1e-4))):
        geodetic[:, column] += np.nan_to_num(table.floats(*names)) * unit
    flags = table.integers("invalid_llh", "invalidLlh", "flags")
    invalid = nowhere(table) if flags is None else (flags & 1) == 1
    variance = equal_variance(table.floats(*H_ACC) * 1e-4)
    return geodetic_source(table, geodetic, variance, invalid, 86.0, "u-blox high precision position")


def _septentrio(mode: str, what: str, score: float, *accuracies: str) -> PositionEntry:
    """Return the entry of a Septentrio block: angles in rad; low bits of the mode 0: no solution."""

    def read(table: TopicTable) -> PositionSource:
        geodetic = place_in(table, "latitude", "longitude", "height")
        geodetic[:, :2] *= DEGREES
        modes, error = table.integers(mode), table.integers("error")
        no_fix = nowhere(table) if modes is None else (modes & 0x0F) == 0
        if error is not None:
            no_fix = no_fix | (error != 0)
        # PVTGeodetic: one number in 0.01 m, 65535 for unknown. INSNavGeod: metres by axis, hugely negative for unknown.
        accuracy = table.floats("h_accuracy")
        variance = equal_variance(np.where(accuracy < SEPTENTRIO_UNKNOWN, accuracy * 0.01, np.nan))
        if "latitude_std_dev" in table.columns:
            variance = axis_variance(table.floats("latitude_std_dev"), table.floats("longitude_std_dev"))
        return geodetic_source(table, geodetic, variance, no_fix, score, what, class_by_mode(modes))

    return (*HEADER, "latitude", "longitude", "height", mode, "error", *accuracies), read


def solved(table: TopicTable, path: str, accepted: frozenset[str] | frozenset[int]) -> Bools:
    """Return the rows (n,) whose status, a word or a number, is an accepted one; all where the type has none."""
    if path in table.texts:
        codes, texts = table.words(path)
        return np.array([*(text in accepted for text in texts), False])[codes]
    values = table.find(path)
    return np.ones(len(table), np.bool_) if values is None else np.isin(values, sorted(accepted))


def _novatel(
    place: tuple[str, str, str], deviations: tuple[str, str], status: str, accepted: frozenset[str] | frozenset[int],
    kind: str, what: str, score: float,
) -> PositionEntry:  # fmt: skip
    """Return the entry of a NovAtel log; a height above mean sea level comes with the undulation of the geoid."""

    def read(table: TopicTable) -> PositionSource:
        geodetic = place_in(table, *place)
        geodetic[:, 2] += np.nan_to_num(table.floats("undulation"))
        variance = axis_variance(*(table.floats(name) for name in deviations))
        fix_class = class_by_type(table, kind)
        return geodetic_source(table, geodetic, variance, ~solved(table, status, accepted), score, what, fix_class)

    return (*HEADER, status, kind, *place, "undulation", *deviations), read


_COVARIANCE = tuple(f"position_covariance[{i}]" for i in (0, 1, 4))
_FIX = (*HEADER, "status.status", "latitude", "longitude", "altitude", *_COVARIANCE, "position_covariance_type")
_GEO = "pose.position."
_WORD, _NUMBER = "position_type", "pos_type.type"
_OEM7_BESTPOS = _novatel(
    ("lat", "lon", "hgt"), ("lat_stdev", "lon_stdev"), "sol_status.status", SOLVED_CODES, _NUMBER,
    "NovAtel position", 85.0,
)  # fmt: skip

POSITION_TYPES: dict[str, PositionEntry] = {
    "sensor_msgs/NavSatFix": (_FIX, _navsatfix),
    "foxglove.LocationFix": (_FIX, _navsatfix),
    "gps_common/GPSFix": ((*_FIX, "err_horz"), _gpsfix),
    "gps_msgs/GPSFix": ((*_FIX, "err_horz"), _gpsfix),
    "ublox_msgs/NavPVT": (("lat", "lon", "height", *H_ACC, "flags"), _navpvt),
    "ublox_ubx_msgs/UBXNavPVT": (
        (*HEADER, "lat", "lon", "height", "h_acc", *UBX_FLAGS),
        _ubx_navpvt,
    ),
    NMEA_SENTENCE: ((*HEADER, "sentence"), _nmea),
    "ublox_msgs/NavHPPOSLLH": (
        ("lat", "lon", "height", *LAT_HP, *LON_HP, *HEIGHT_HP, *H_ACC, "invalid_llh", "invalidLlh", "flags"),
        _navhpposllh,
    ),
    "septentrio_gnss_driver/PVTGeodetic": _septentrio("mode", "Septentrio position", 85.0, "h_accuracy"),
    "septentrio_gnss_driver/INSNavGeod": _septentrio(
        "gnss_mode", "Septentrio INS position", 84.0, "latitude_std_dev", "longitude_std_dev"
    ),
    "novatel_gps_msgs/NovatelPosition": _novatel(
        ("lat", "lon", "height"), ("lat_sigma", "lon_sigma"), "solution_status", SOLVED, _WORD,
        "NovAtel position", 85.0,
    ),
    "novatel_gps_msgs/Inspvax": _novatel(
        ("latitude", "longitude", "altitude"), ("latitude_std", "longitude_std"), "ins_status", INS_SOLVED, _WORD,
        "NovAtel INS position", 84.0,
    ),
    "novatel_oem7_msgs/BESTPOS": _OEM7_BESTPOS,
    "novatel_oem7_msgs/BESTGNSSPOS": _OEM7_BESTPOS,
    "novatel_oem7_msgs/INSPVAX": _novatel(
        ("latitude", "longitude", "height"), ("latitude_stdev", "longitude_stdev"), "ins_status.status",
        INS_SOLVED_CODES, _NUMBER, "NovAtel INS position", 84.0,
    ),
    "geographic_msgs/GeoPoseStamped": (
        (*HEADER, *(f"{_GEO}{name}" for name in ("latitude", "longitude", "altitude"))), _geopose
    ),
    "geometry_msgs/PoseStamped": metric("pose.", "", 70.0, "metric pose"),
    "foxglove.PoseInFrame": metric("pose.", "", 70.0, "metric pose"),
    "geometry_msgs/PoseWithCovarianceStamped": metric("pose.pose.", "pose.covariance", 70.0, "metric pose"),
    "xbot_msgs/AbsolutePose": ABSOLUTE_POSE,
    "nav_msgs/Odometry": metric(
        "pose.pose.", "pose.covariance", 60.0, "metric position of an odometry message", odometry=True
    ),
}  # fmt: skip
"""By message type: the fields to take, and how to read them."""
