"""Geodetic fixes: which are usable, how exact they are, and how a receiver solved them (RTK fixed, float, other)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from icrtool.kernels.arrays import Bools, Bytes, Floats, Ints
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.sources import NEVER_MOVES, PositionSource, of_topic
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, NOT_STATED, OTHER_FIX, RTK_FIX

STATUS_UNKNOWN = -2

HIGHEST_M = 20_000.0
"""A height beyond this means "unknown"; it is replaced by the median of the others."""

FARTHEST_M = 200_000.0
"""No robot drives further from the middle of its fixes."""

STILL_M, METRES_PER_DEGREE = 0.5, 111_000.0
"""A receiver whose fixes stay within this is that of a base station, or of a robot that stands."""

GOOD_STD_M = 0.3
"""A fix with a smaller standard deviation is RTK or nearly so, and preferred as reference."""


def geodetic_source(
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


def place_in(table: TopicTable, latitude: str, longitude: str, height: str) -> Floats:
    """Return latitude and longitude, which the type must have, and height, as recorded (n, 3)."""
    return np.column_stack([table.column(latitude), table.column(longitude), table.floats(height)]).astype(np.float64)


def enu_variance(table: TopicTable) -> Floats:
    """Return north, east, covariance of the row-major 3 x 3 ENU covariance; NaN where it is unknown."""
    variance = np.column_stack([table.floats(f"position_covariance[{i}]") for i in (4, 0, 1)])
    # COVARIANCE_TYPE_UNKNOWN: drivers leave the numbers at 0, or write arbitrary ones.
    unknown = table.floats("position_covariance_type") == 0
    variance[unknown | ~(variance[:, 0] > 0) | ~(variance[:, 1] > 0)] = np.nan
    return variance


def without_fix(table: TopicTable) -> Bools:
    """Return the rows (n,) with a negative status: -1 no fix, -2 unknown (the default of ROS 2).

    A driver that never changes the default states no status: no row is returned.
    """
    status = table.floats("status.status")
    return np.zeros(len(table), np.bool_) if np.all(status == STATUS_UNKNOWN) else np.asarray(status < 0)


def equal_variance(std: Floats) -> Floats:
    """Return the variances (n, 3) of an accuracy (n,) [m] that is equal in all directions."""
    return axis_variance(std, std)


def axis_variance(north: Floats, east: Floats) -> Floats:
    """Return the variances (n, 3) of deviations (n,) [m] to the north and to the east."""
    positive = (north > 0) & (east > 0)
    with np.errstate(over="ignore"):
        return np.where(positive[:, None], np.column_stack([north**2, east**2, np.zeros(len(north))]), np.nan)


def nowhere(table: TopicTable) -> Bools:
    """Return no row (n,), where a type does not state which are no fixes."""
    return np.zeros(len(table), np.bool_)


GBAS = 2
"""NavSatStatus: 2 is fixed or float, drivers differ. A log without any of these states nothing about the solution."""

GPSFIX_STATUS = {
    0: OTHER_FIX, 1: OTHER_FIX, GBAS: RTK_FIX, 18: OTHER_FIX, 19: FIXED_FIX, 20: FLOAT_FIX, 33: OTHER_FIX,
}  # fmt: skip
"""GPSStatus of gps_msgs: 18 DGPS, 19 and 20 RTK, 33 WAAS."""

UBLOX_CARRIER = {0: OTHER_FIX, 1: FLOAT_FIX, 2: FIXED_FIX}
"""carrSoln of u-blox, bits 6 and 7 of NavPVT.flags."""

NMEA_QUALITY = {1: OTHER_FIX, 2: OTHER_FIX, 3: OTHER_FIX, 4: FIXED_FIX, 5: FLOAT_FIX, 8: OTHER_FIX, 9: OTHER_FIX}
"""Quality of GGA: single, differential, PPS, RTK fixed and float, simulated, SBAS of NovAtel.

The others are no fixes: 0 none, 6 dead reckoning, 7 typed in.
"""

XBOT_FLAGS = {0: OTHER_FIX, 1: OTHER_FIX, 2: FIXED_FIX, 3: FIXED_FIX, 4: FLOAT_FIX, 5: FLOAT_FIX}
"""Low bits of the flags of xbot_msgs/AbsolutePose: 1 corrections, 2 RTK fixed, 4 RTK float."""

SEPTENTRIO_MODE = {1: OTHER_FIX, 2: OTHER_FIX, 4: FIXED_FIX, 5: FLOAT_FIX, 6: OTHER_FIX, 7: FIXED_FIX, 8: FLOAT_FIX}
"""Low bits of the mode: stand-alone, DGPS, RTK fixed and float, SBAS, moving-base fixed and float."""

NOVATEL_TYPES = {32: FLOAT_FIX, 33: FLOAT_FIX, 34: FLOAT_FIX, 48: FIXED_FIX, 49: FIXED_FIX, 50: FIXED_FIX,
                 51: FIXED_FIX, 55: FLOAT_FIX, 56: FIXED_FIX}  # fmt: skip
"""Position types of NovAtel, numbered as in novatel_oem7_msgs; all others have neither fixed nor float ambiguities."""


def class_by_status(table: TopicTable, codes: Mapping[int, int] | None = None) -> Bytes | None:
    """Return the class (n,) by ``status.status``, of NavSatFix or by `codes`; None where the status states no class.

    Many drivers of NavSatFix write 0 for every fix: a log without a single GBAS (2) states no class.
    """
    status = table.integers("status.status")
    if status is None:
        return None
    if codes is None:
        if not (status == GBAS).any():
            return None
        return np.where(status == GBAS, RTK_FIX, OTHER_FIX).astype(np.uint8)
    classes = _looked_up(status, codes, NOT_STATED)
    informative = (classes == FIXED_FIX) | (classes == FLOAT_FIX) | (classes == RTK_FIX)
    return classes if informative.any() else None


def class_by_carrier(flags: Ints | None) -> Bytes | None:
    """Return the class (n,) by the carrier solution in u-blox flags (n,)."""
    return None if flags is None else class_by_code((flags >> 6) & 3, UBLOX_CARRIER)


def class_by_code(values: Ints | None, codes: Mapping[int, int]) -> Bytes | None:
    """Return the class (n,) by codes (n,); those that are not known state none."""
    return None if values is None else _looked_up(values, codes, NOT_STATED)


def class_by_mode(modes: Ints | None) -> Bytes | None:
    """Return the class (n,) by the mode of a Septentrio block (n,)."""
    return None if modes is None else _looked_up(modes & 0x0F, SEPTENTRIO_MODE, OTHER_FIX)


def class_by_type(table: TopicTable, path: str) -> Bytes | None:
    """Return the class (n,) by a NovAtel position type, which is a word (``NARROW_INT``) or a number."""
    if path in table.texts:
        codes, texts = table.words(path)
        by_word = [_of_word(text) for text in texts]
        return np.array([*by_word, NOT_STATED], np.uint8)[codes]
    values = table.integers(path)
    return None if values is None else _looked_up(values, NOVATEL_TYPES, OTHER_FIX)


def _of_word(text: str) -> int:
    if not text:
        return NOT_STATED
    if text.endswith(("_FLOAT", "RTKFLOAT")):
        return FLOAT_FIX
    return FIXED_FIX if text.endswith(("_INT", "RTKFIXED", "RTK_DIRECT_INS")) else OTHER_FIX


def _looked_up(values: Ints, codes: Mapping[int, int], otherwise: int) -> Bytes:
    classes = np.full(len(values), otherwise, np.uint8)
    for value, code in codes.items():
        classes[values == value] = code
    return classes
