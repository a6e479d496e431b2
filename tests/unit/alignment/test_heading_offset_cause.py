"""Names of heading offsets: magnetic and grid north, turns; numbers from the World Magnetic Model's own test values."""

from __future__ import annotations

import math
import sys

import pytest

from icrtool.alignment.heading_alignment import find_offset_cause, utm_convergence_deg
from icrtool.records.samples import Datum

SIGMA_RAD = math.radians(0.1)
AUTUMN_2025_NS = 1_760_000_000_000_000_000
PENNSYLVANIA = Datum(40.7934, -77.86, 350.0)
DECLINATION_DEG = -10.55
"""World Magnetic Model 2025 for that place and day; a degree is what a compass is good for."""


def test_a_heading_from_magnetic_north_is_named() -> None:
    cause = find_offset_cause(math.radians(-DECLINATION_DEG), SIGMA_RAD, PENNSYLVANIA, AUTUMN_2025_NS)
    assert cause.declination_deg == pytest.approx(DECLINATION_DEG, abs=0.1)
    assert cause.text == "magnetic declination here is -10.6°"
    assert find_offset_cause(math.radians(DECLINATION_DEG), SIGMA_RAD, PENNSYLVANIA, AUTUMN_2025_NS).text == ""


@pytest.mark.parametrize(
    ("degrees", "text"),
    [
        (90.2, "a quarter turn clockwise"),
        (-90.0, "a quarter turn counter-clockwise"),
        (-179.8, "half a turn"),
        (100.5, "a quarter turn clockwise and magnetic declination here is -10.6°"),
        (35.0, ""),
    ],
)
def test_turns_are_named_alone_and_with_magnetic_north(degrees: float, text: str) -> None:
    assert find_offset_cause(math.radians(degrees), SIGMA_RAD, PENNSYLVANIA, AUTUMN_2025_NS).text == text


def test_without_a_place_or_a_date_there_is_no_north_to_name() -> None:
    assert find_offset_cause(math.radians(10.5), SIGMA_RAD, None, AUTUMN_2025_NS).text == ""
    cause = find_offset_cause(math.radians(10.5), SIGMA_RAD, PENNSYLVANIA, 10**12)
    assert (cause.declination_deg, cause.text) == (None, "")


@pytest.mark.parametrize(("latitude", "longitude"), [(60.0, 11.5), (-35.0, 150.9), (47.0, 6.2), (0.0, 5.0)])
def test_grid_north_is_where_the_projected_parallel_says(latitude: float, longitude: float) -> None:
    """Convergence by Gauss-Krueger series on the ellipsoid (Snyder 1987, Eqs. 8-9 to 8-11), differentiated."""
    meridian = 6.0 * math.floor(longitude / 6.0) + 3.0
    step = 1e-5
    (x1, y1), (x2, y2) = (_transverse_mercator(latitude + d, longitude - meridian) for d in (-step, step))
    north = math.degrees(math.atan2(x2 - x1, y2 - y1))
    assert utm_convergence_deg(Datum(latitude, longitude, 0.0)) == pytest.approx(-north, abs=0.01)


def test_there_is_no_utm_at_the_poles() -> None:
    assert utm_convergence_deg(Datum(86.0, 10.0, 0.0)) is None


def _transverse_mercator(latitude: float, away: float) -> tuple[float, float]:
    a, e2 = 6378137.0, 0.00669437999014
    phi, ep2 = math.radians(latitude), e2 / (1 - e2)
    n = a / math.sqrt(1 - e2 * math.sin(phi) ** 2)
    t, c, x = math.tan(phi) ** 2, ep2 * math.cos(phi) ** 2, math.cos(phi) * math.radians(away)
    m = a * (
        (1 - e2 / 4 - 3 * e2**2 / 64 - 5 * e2**3 / 256) * phi
        - (3 * e2 / 8 + 3 * e2**2 / 32 + 45 * e2**3 / 1024) * math.sin(2 * phi)
        + (15 * e2**2 / 256 + 45 * e2**3 / 1024) * math.sin(4 * phi)
        - (35 * e2**3 / 3072) * math.sin(6 * phi)
    )
    easting = n * (x + (1 - t + c) * x**3 / 6 + (5 - 18 * t + t**2 + 72 * c - 58 * ep2) * x**5 / 120)
    northing = m + n * math.tan(phi) * (
        x**2 / 2 + (5 - t + 9 * c + 4 * c**2) * x**4 / 24 + (61 - 58 * t + t**2 + 600 * c - 330 * ep2) * x**6 / 720
    )
    return easting, northing


def test_the_name_costs_nothing_until_it_is_asked_for() -> None:
    import subprocess

    code = "import sys, icrtool.estimation.fit; sys.exit('pygeomag' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
