"""Messages that hold the robot's position: geodetic fixes, or positions that are metric already."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from icrtool.kernels.arrays import Bools, Bytes, Floats
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.fix_class import (
    GPSFIX_STATUS,
    class_by_carrier,
    class_by_mode,
    class_by_status,
    class_by_type,
)
from icrtool.logs.streams.source import NEVER_MOVES, NO_ROWS, Source, of_topic

REFERENCE_WORDS = re.compile(
    r"gps|gnss|(?<![a-z])fix|map|icp|lidar|laser|slam|loam|\blio\b|mocap|vicon|optitrack|qualisys|ground|truth|\bgt\b|total|station|"
    r"prism|leica|utm|global|navsat|\bins\b|vectornav|novatel|sbg|ublox",
    re.IGNORECASE,
)
"""In names of odometry and pose topics, or of their frames: a reference, not the robot's own dead reckoning."""

REFERENCE_FRAMES = {"world", "earth", "ecef", "local_enu", "enu", "camera_init"}
"""Names of frames that are no such words; FAST-LIO and LOAM call their map ``camera_init``."""

GOAL_WORDS = re.compile(r"goal|initial_?pose|cmd|command|desired|setpoint", re.IGNORECASE)

RADIUS_95_IN_STD = 2.45
"""err_horz is a 95 % radius: this many standard deviations of a circular normal distribution."""

DEGREES = 180.0 / math.pi
STATUS_UNKNOWN = -2
SEPTENTRIO_UNKNOWN = 65535
HIGHEST_M = 20_000.0
"""A height beyond this means "unknown"; it is replaced by the median of the others."""

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

LEAST_AREA_M, FLAT, LARGEST_PLACE_M, MOST_PLACES = 1.0, 0.1, 1e8, 2000
"""A drive this wide (standard deviation) shows its plane where it is no thicker than a tenth of that."""

LEAST_RADIUS_M, LARGEST_RADIUS_M = 6.33e6, 6.40e6
"""Of the earth; UTM coordinates far from the equator may be as large, but have a height near 0."""

FARTHEST_M = 200_000.0
"""No robot drives further from the middle of its fixes."""

STILL_M, METRES_PER_DEGREE = 0.5, 111_000.0
"""A receiver whose fixes stay within this is that of a base station, or of a robot that stands."""

GOOD_STD_M = 0.3
"""A fix with a smaller standard deviation is RTK or nearly so, and preferred as reference."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionSource(Source):
    """Positions of one topic.

    Attributes
    ----------
    geodetic : (n, 3) latitude, longitude [deg], ellipsoidal height [m]; None where metric
    metric : (n, 2) north, east [m] in the topic's own frame; None where geodetic
    variance : (n, 3) north, east, covariance of both [m^2]; NaN where not stated
    usable : (n,) rows to use; `rejected` counts the others by reason
    stated_class : uint8 (n,) how the position was solved, None where no message states it
    """

    geodetic: Floats | None = None
    metric: Floats | None = None
    variance: Floats = field(default_factory=lambda: np.empty((0, 3)))
    usable: Bools = field(default_factory=lambda: NO_ROWS)
    rejected: dict[str, int] = field(default_factory=dict)
    stated_class: Bytes | None = None

    @property
    def is_empty(self) -> bool:
        """Whether no row can be used, even where the topic is configured."""
        return not self.usable.any()


Reader = Callable[[TopicTable], PositionSource]
Entry = tuple[tuple[str, ...], Reader]
"""The fields of a message type to take, and how to read them."""


def _geodetic(
    table: TopicTable, geodetic: Floats, variance: Floats, no_fix: Bools, score: float, what: str,
    stated_class: Bytes | None = None,
) -> PositionSource:  # fmt: skip
    """Return a source of latitude, longitude, height; rows without a fix, not finite, or at 0, 0 are not usable."""
    rejected: dict[str, int] = {}
    usable = np.ones(len(table), np.bool_)
    latitude, longitude = geodetic[:, 0], geodetic[:, 1]
    with np.errstate(invalid="ignore"):
        possible = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0)
    reasons = (
        ("no fix", no_fix),
        ("not finite", ~np.isfinite(latitude) | ~np.isfinite(longitude)),
        ("not a place on earth", ~possible),
        ("at 0, 0", (latitude == 0) & (longitude == 0)),
        ("far from the others", _far_away(geodetic, possible & ~no_fix & np.isfinite(geodetic[:, :2]).all(axis=1))),
    )
    for reason, bad in reasons:
        count = int(np.count_nonzero(bad & usable))
        if count:
            rejected[reason] = count
        usable &= ~bad
    height = geodetic[:, 2]
    plausible = np.abs(height) < HIGHEST_M
    known = plausible & usable
    filled = np.where(plausible, height, float(np.median(height[known])) if known.any() else 0.0)
    std = (
        float(np.sqrt(np.nanmedian(variance[usable, :2]))) if np.isfinite(variance[usable, :2]).any() else float("nan")
    )
    if std > GOOD_STD_M:
        score -= 35.0
    what, score = (f"{what} that never moves", score - NEVER_MOVES) if _is_still(geodetic[usable]) else (what, score)
    stated = f", states ±{std:.2g} m" if np.isfinite(std) else ", states no accuracy"
    problem = (
        "" if usable.any() else f"no usable fix ({', '.join(f'{why} {count}' for why, count in rejected.items())})"
    )
    return PositionSource(
        **of_topic(table), geodetic=np.column_stack([latitude, longitude, filled]), variance=variance, usable=usable,
        rejected=rejected, score=score, why=f"{what}{stated}", problem=problem,
        stated_class=stated_class,
    )  # fmt: skip


def _far_away(geodetic: Floats, known: Bools) -> Bools:
    """Return the known fixes (n,) of another place: a receiver that was switched on may send where it was last."""
    far, places_deg = np.zeros(len(known), np.bool_), geodetic[known, :2]
    if len(places_deg):
        away_deg = places_deg - places_deg[0]
        away_deg[:, 1] = np.mod(away_deg[:, 1] + 180.0, 360.0) - 180.0  # not across the date line
        away_deg -= np.median(away_deg, axis=0)
        away_deg[:, 1] *= math.cos(math.radians(float(np.median(places_deg[:, 0]))))
        far[known] = (np.abs(away_deg) * METRES_PER_DEGREE > FARTHEST_M).any(axis=1)
    return far


def _is_still(geodetic: Floats) -> bool:
    """Return whether 95 % of the fixes (n, 3) lie within `STILL_M`, whatever the latitude."""
    if len(geodetic) < 2:
        return False
    ends = np.percentile(geodetic[:, :2], [2.5, 97.5], axis=0)
    return bool((np.diff(ends, axis=0) * METRES_PER_DEGREE < (STILL_M, STILL_M)).all())


def _place(table: TopicTable, latitude: str, longitude: str, height: str) -> Floats:
    """Return latitude and longitude, which the type must have, and height, as recorded (n, 3)."""
    return np.column_stack([table.column(latitude), table.column(longitude), table.floats(height)]).astype(np.float64)


def _enu_variance(table: TopicTable) -> Floats:
    """Return north, east, covariance of the row-major 3 x 3 ENU covariance; NaN where it is unknown."""
    variance = np.column_stack([table.floats(f"position_covariance[{i}]") for i in (4, 0, 1)])
    # COVARIANCE_TYPE_UNKNOWN: drivers leave the numbers at 0, or write arbitrary ones.
    unknown = table.floats("position_covariance_type") == 0
    variance[unknown | ~(variance[:, 0] > 0) | ~(variance[:, 1] > 0)] = np.nan
    return variance


def _without_fix(table: TopicTable) -> Bools:
    """Return the rows (n,) with a negative status: -1 no fix, -2 unknown (the default of ROS 2).

    A driver that never changes the default states no status: no row is returned.
    """
    status = table.floats("status.status")
    return np.zeros(len(table), np.bool_) if np.all(status == STATUS_UNKNOWN) else np.asarray(status < 0)


def _geopose(table: TopicTable) -> PositionSource:
    geodetic = _place(table, *(f"{_GEO}{name}" for name in ("latitude", "longitude", "altitude")))
    unknown = np.full((len(table), 3), np.nan)
    return _geodetic(table, geodetic, unknown, _nowhere(table), 80.0, "position of an autopilot or navigation filter")


def _navsatfix(table: TopicTable) -> PositionSource:
    geodetic = _place(table, "latitude", "longitude", "altitude")
    fix_class = class_by_status(table)
    return _geodetic(table, geodetic, _enu_variance(table), _without_fix(table), 100.0, "GNSS fix", fix_class)


def _gpsfix(table: TopicTable) -> PositionSource:
    variance = _enu_variance(table)
    unknown = ~np.isfinite(variance[:, 0])
    radius = table.floats("err_horz")
    with np.errstate(over="ignore"):
        from_radius = np.where(radius > 0, (radius / RADIUS_95_IN_STD) ** 2, np.nan)
    for column in (0, 1):
        variance[:, column] = np.where(unknown, from_radius, variance[:, column])
    variance[unknown, 2] = np.where(np.isfinite(from_radius[unknown]), 0.0, np.nan)
    geodetic = _place(table, "latitude", "longitude", "altitude")
    fix_class = class_by_status(table, GPSFIX_STATUS)
    return _geodetic(table, geodetic, variance, _without_fix(table), 92.0, "GNSS fix", fix_class)


def _accuracy(std: Floats) -> Floats:
    """Return the variances (n, 3) of an accuracy (n,) [m] that is equal in all directions."""
    return _deviations(std, std)


def _deviations(north: Floats, east: Floats) -> Floats:
    positive = (north > 0) & (east > 0)
    with np.errstate(over="ignore"):
        return np.where(positive[:, None], np.column_stack([north**2, east**2, np.zeros(len(north))]), np.nan)


def _nowhere(table: TopicTable) -> Bools:
    return np.zeros(len(table), np.bool_)


def _navpvt(table: TopicTable) -> PositionSource:
    geodetic = _place(table, "lat", "lon", "height") * (1e-7, 1e-7, 1e-3)
    flags = table.integers("flags")
    no_fix = _nowhere(table) if flags is None else (flags & 1) == 0
    variance, fix_class = _accuracy(table.floats(*H_ACC) * 1e-3), class_by_carrier(flags)
    return _geodetic(table, geodetic, variance, no_fix, 85.0, "u-blox position", fix_class)


def _navhpposllh(table: TopicTable) -> PositionSource:
    geodetic = _place(table, "lat", "lon", "height") * (1e-7, 1e-7, 1e-3)
    for column, (names, unit) in enumerate(((LAT_HP, 1e-9), (LON_HP, 1e-9), (HEIGHT_HP, 1e-4))):
        geodetic[:, column] += np.nan_to_num(table.floats(*names)) * unit
    flags = table.integers("invalid_llh", "invalidLlh", "flags")
    invalid = _nowhere(table) if flags is None else (flags & 1) == 1
    variance = _accuracy(table.floats(*H_ACC) * 1e-4)
    return _geodetic(table, geodetic, variance, invalid, 86.0, "u-blox high precision position")


def _septentrio(mode: str, what: str, score: float, *accuracies: str) -> Entry:
    """Return the entry of a Septentrio block: angles in rad; low bits of the mode 0: no solution."""

    def read(table: TopicTable) -> PositionSource:
        geodetic = _place(table, "latitude", "longitude", "height")
        geodetic[:, :2] *= DEGREES
        modes, error = table.integers(mode), table.integers("error")
        no_fix = _nowhere(table) if modes is None else (modes & 0x0F) == 0
        if error is not None:
            no_fix = no_fix | (error != 0)
        # PVTGeodetic: one number in 0.01 m, 65535 for unknown. INSNavGeod: metres by axis, hugely negative for unknown.
        accuracy = table.floats("h_accuracy")
        variance = _accuracy(np.where(accuracy < SEPTENTRIO_UNKNOWN, accuracy * 0.01, np.nan))
        if "latitude_std_dev" in table.columns:
            variance = _deviations(table.floats("latitude_std_dev"), table.floats("longitude_std_dev"))
        return _geodetic(table, geodetic, variance, no_fix, score, what, class_by_mode(modes))

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
) -> Entry:  # fmt: skip
    """Return the entry of a NovAtel log; a height above mean sea level comes with the undulation of the geoid."""

    def read(table: TopicTable) -> PositionSource:
        geodetic = _place(table, *place)
        geodetic[:, 2] += np.nan_to_num(table.floats("undulation"))
        variance = _deviations(*(table.floats(name) for name in deviations))
        fix_class = class_by_type(table, kind)
        return _geodetic(table, geodetic, variance, ~solved(table, status, accepted), score, what, fix_class)

    return (*HEADER, status, kind, *place, "undulation", *deviations), read


def _metric(pose: str, covariance: str, score: float, what: str, *, odometry: bool = False) -> Entry:
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


_COVARIANCE = tuple(f"position_covariance[{i}]" for i in (0, 1, 4))
_FIX = (*HEADER, "status.status", "latitude", "longitude", "altitude", *_COVARIANCE, "position_covariance_type")
_GEO = "pose.position."
_WORD, _NUMBER = "position_type", "pos_type.type"
_OEM7_BESTPOS = _novatel(
    ("lat", "lon", "hgt"), ("lat_stdev", "lon_stdev"), "sol_status.status", SOLVED_CODES, _NUMBER,
    "NovAtel position", 85.0,
)  # fmt: skip

POSITION_TYPES: dict[str, Entry] = {
    "sensor_msgs/NavSatFix": (_FIX, _navsatfix),
    "gps_common/GPSFix": ((*_FIX, "err_horz"), _gpsfix),
    "gps_msgs/GPSFix": ((*_FIX, "err_horz"), _gpsfix),
    "ublox_msgs/NavPVT": (("lat", "lon", "height", *H_ACC, "flags"), _navpvt),
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
    "geometry_msgs/PoseStamped": _metric("pose.", "", 70.0, "metric pose"),
    "geometry_msgs/PoseWithCovarianceStamped": _metric("pose.pose.", "pose.covariance", 70.0, "metric pose"),
    "nav_msgs/Odometry": _metric(
        "pose.pose.", "pose.covariance", 60.0, "metric position of an odometry message", odometry=True
    ),
}  # fmt: skip
"""By message type: the fields to take, and how to read them."""
