"""Name a heading's constant offset: magnetic or grid north, quarter and half turns. It names, and applies nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

from icrtool.records.samples import Datum

LIKE_RAD = math.radians(1.0)
"""An offset is named after what it equals to within this: compasses in robots are no better. One that is not known
that well has no name."""

SMALLEST_NAME_RAD = math.radians(0.5)
UTM_LATITUDES_DEG = (-80.0, 84.0)
TURNS = {0.0: "", 90.0: "a quarter turn clockwise", -90.0: "a quarter turn counter-clockwise", 180.0: "half a turn"}


@dataclass(frozen=True, slots=True)
class OffsetName:
    """What an offset may come from.

    Attributes
    ----------
    text : for the user, empty where nothing fits
    declination_deg : magnetic declination (east positive) at the log's place and date, None where not known
    convergence_deg : UTM grid convergence there, grid north east of true north positive; None where not known
    """

    text: str
    declination_deg: float | None
    convergence_deg: float | None


NO_NAME = OffsetName("", None, None)


def name_offset(offset_rad: float, sigma_rad: float, datum: Datum | None, stamp_ns: int) -> OffsetName:
    """Name an offset of a heading clockwise from north.

    Parameters
    ----------
    offset_rad : heading minus course over ground; a heading from magnetic north is less by the declination
    datum : where; None: a metric reference without a known north
    stamp_ns : when, Unix time
    """
    if not sigma_rad <= LIKE_RAD:
        return NO_NAME
    declination = _declination_deg(datum, stamp_ns) if datum is not None else None
    convergence = utm_convergence_deg(datum) if datum is not None else None
    norths = [("", 0.0)]
    if declination is not None and abs(declination) > math.degrees(SMALLEST_NAME_RAD):
        norths.append((f"magnetic declination here is {declination:+.1f}°", math.radians(declination)))
    if convergence is not None and abs(convergence) > math.degrees(SMALLEST_NAME_RAD):
        norths.append((f"UTM grid convergence here is {convergence:+.1f}°", math.radians(convergence)))
    found = []
    for turn, turn_text in TURNS.items():
        for north_text, north in norths:
            away = abs(math.remainder(offset_rad - math.radians(turn) + north, 2 * math.pi))
            texts = [text for text in (turn_text, north_text) if text]
            if away <= max(LIKE_RAD, 2.0 * sigma_rad) and texts:
                # The fewer causes, the likelier; then the nearer.
                found.append((len(texts), away, " and ".join(texts)))
    return OffsetName(min(found)[2] if found else "", declination, convergence)


def utm_convergence_deg(datum: Datum) -> float | None:
    """Return the angle from true to grid north [deg], clockwise; None outside UTM.

    Notes
    -----
    tan(gamma) = tan(longitude - central meridian) sin(latitude) (Snyder 1987, Map Projections, Eq. 8-20, on the
    sphere: right to 0.01 deg within a zone).
    """
    latitude, longitude = datum.latitude_deg, math.remainder(datum.longitude_deg, 360.0)
    if not UTM_LATITUDES_DEG[0] <= latitude <= UTM_LATITUDES_DEG[1]:
        return None
    meridian = 6.0 * math.floor(longitude / 6.0) + 3.0
    away = math.radians(longitude - meridian)
    return math.degrees(math.atan(math.tan(away) * math.sin(math.radians(latitude))))


def _declination_deg(datum: Datum, stamp_ns: int) -> float | None:
    """Return the declination of the World Magnetic Model; None where it does not cover the date."""
    from pygeomag import GeoMag

    day = datetime.fromtimestamp(stamp_ns / 1e9, UTC)
    year = day.year + (day.timetuple().tm_yday - 1) / 365.25
    try:
        model = GeoMag(base_year=day)
        return float(model.calculate(datum.latitude_deg, datum.longitude_deg, datum.height_m / 1e3, year).d)
    except ValueError:
        # Stamps that count from the robot's start are 1970: there is no model of that year, and no date either.
        return None
