"""Messages that hold the robot's position: geodetic fixes, and the table of all message types that hold one."""

from __future__ import annotations

import math

import numpy as np

from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Bools, Bytes, Floats
from icrtool.logs.messages.nmea import GGA, GST, NMEA_SENTENCE, RMC
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.fix_class import (
    GPSFIX_STATUS,
    NMEA_QUALITY,
    UBLOX_CARRIER,
    class_by_carrier,
    class_by_code,
    class_by_mode,
    class_by_status,
    class_by_type,
)
from icrtool.logs.streams.metric_positions import ABSOLUTE_POSE, metric
from icrtool.logs.streams.sources import NEVER_MOVES, PositionEntry, PositionSource, of_topic

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

FARTHEST_M = 200_000.0
"""No robot drives further from the middle of its fixes."""

UBX_FLAGS = ("gnss_fix_ok", "invalid_llh", "gps_fix.fix_type", "carr_soln.status")
UBX_NO_FIX = (0, 1, 5)
"""GpsFix of u-blox: none, dead reckoning only, time only."""

STILL_M, METRES_PER_DEGREE = 0.5, 111_000.0
"""A receiver whose fixes stay within this is that of a base station, or of a robot that stands."""

GOOD_STD_M = 0.3
"""A fix with a smaller standard deviation is RTK or nearly so, and preferred as reference."""


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


def _ubx_navpvt(table: TopicTable) -> PositionSource:
    """Return the positions of ublox_dgnss, which spreads the flags over fields."""
    geodetic = _place(table, "lat", "lon", "height") * (1e-7, 1e-7, 1e-3)
    no_fix = (table.floats("gnss_fix_ok") == 0) | (table.floats("invalid_llh") == 1)
    no_fix |= np.isin(table.floats("gps_fix.fix_type"), UBX_NO_FIX)
    variance = _accuracy(table.floats("h_acc") * 1e-3)
    fix_class = class_by_code(table.integers("carr_soln.status"), UBLOX_CARRIER)
    return _geodetic(table, geodetic, variance, no_fix, 85.0, "u-blox position", fix_class)


def _nmea(table: TopicTable) -> PositionSource:
    """Return the fixes of GGA, with the deviations that GST states for the same time; of RMC where there is no GGA."""
    kinds = table.column("sentence_kind")
    kind, name = (GGA, "GGA") if (kinds == GGA).any() else (RMC, "RMC")
    fixes, deviations = table.rows(kinds == kind), table.rows(kinds == GST)
    if not len(fixes):
        raise DefinitionError(table.topic, "none of its sentences is GGA or RMC")
    std = np.full((len(fixes), 2), np.nan)
    if len(deviations):
        times_ns = deviations.log_time_ns
        after = np.searchsorted(times_ns[:-1] + np.diff(times_ns) // 2, fixes.log_time_ns)
        same = deviations.column("utc_s")[after] == fixes.column("utc_s")
        std[same] = np.column_stack([deviations.column("north_std"), deviations.column("east_std")])[after[same]]
    quality = fixes.column("quality")
    fix_class = class_by_code(quality, NMEA_QUALITY)
    no_fix = np.isin(quality, [*NMEA_QUALITY], invert=True)
    geodetic = _place(fixes, "latitude", "longitude", "altitude")
    return _geodetic(fixes, geodetic, _deviations(*std.T), no_fix, 84.0, f"GNSS fix ({name})", fix_class)


def _navhpposllh(table: TopicTable) -> PositionSource:
    geodetic = _place(table, "lat", "lon", "height") * (1e-7, 1e-7, 1e-3)
    for column, (names, unit) in enumerate(((LAT_HP, 1e-9), (LON_HP, 1e-9), (HEIGHT_HP, 1e-4))):
        geodetic[:, column] += np.nan_to_num(table.floats(*names)) * unit
    flags = table.integers("invalid_llh", "invalidLlh", "flags")
    invalid = _nowhere(table) if flags is None else (flags & 1) == 1
    variance = _accuracy(table.floats(*H_ACC) * 1e-4)
    return _geodetic(table, geodetic, variance, invalid, 86.0, "u-blox high precision position")


def _septentrio(mode: str, what: str, score: float, *accuracies: str) -> PositionEntry:
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
) -> PositionEntry:  # fmt: skip
    """Return the entry of a NovAtel log; a height above mean sea level comes with the undulation of the geoid."""

    def read(table: TopicTable) -> PositionSource:
        geodetic = _place(table, *place)
        geodetic[:, 2] += np.nan_to_num(table.floats("undulation"))
        variance = _deviations(*(table.floats(name) for name in deviations))
        fix_class = class_by_type(table, kind)
        return _geodetic(table, geodetic, variance, ~solved(table, status, accepted), score, what, fix_class)

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
