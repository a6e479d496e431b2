"""How receivers say fixed, float or other: numbers of the drivers' and the vendors' own documents."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from icrtool.config import Config
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, NOT_STATED, OTHER_FIX, RTK_FIX
from support.tables import read_source, table_of

WORD, NUMBER = "novatel_gps_msgs/NovatelPosition", "novatel_oem7_msgs/BESTPOS"


def stated(message_type: str, path: str, values: Any, texts: list[str] | None = None) -> list[int] | None:
    """Return the class of each fix of a topic that has a column, beside its places."""
    count = len(values)
    names = {name: np.full(count, 48.0) for name in ("latitude", "longitude", "lat", "lon")}
    columns = {**names, path: np.asarray(values)}
    table = replace(table_of(message_type, columns), texts={path: texts} if texts is not None else {})
    found = read_source("gnss", table, Config()).stated_class
    return None if found is None else found.tolist()


def test_a_navsatfix_says_rtk_with_gbas_and_nothing_where_it_never_does() -> None:
    name = "sensor_msgs/NavSatFix"
    assert stated(name, "status.status", [2, 0, 1, 2]) == [RTK_FIX, OTHER_FIX, OTHER_FIX, RTK_FIX]
    assert stated(name, "status.status", [0, 0, 1]) is None
    assert stated(name, "other", [0]) is None


def test_a_gpsfix_says_19_for_fixed_and_20_for_float() -> None:
    found = stated("gps_msgs/GPSFix", "status.status", [19, 20, 18, 33, 2, 7])
    assert found == [FIXED_FIX, FLOAT_FIX, OTHER_FIX, OTHER_FIX, RTK_FIX, NOT_STATED]
    assert stated("gps_msgs/GPSFix", "status.status", [0, 0]) is None


def test_navpvt_says_64_for_float_and_128_for_fixed() -> None:
    assert stated("ublox_msgs/NavPVT", "flags", [1, 1 + 64, 1 + 128 + 32]) == [OTHER_FIX, FLOAT_FIX, FIXED_FIX]
    assert stated("ublox_msgs/NavPVT", "other", [1]) is None


def test_septentrio_modes_are_4_for_fixed_and_5_for_float_whatever_the_high_bits() -> None:
    found = stated("septentrio_gnss_driver/PVTGeodetic", "mode", [4, 5, 6, 1, 4 | 0x40])
    assert found == [FIXED_FIX, FLOAT_FIX, OTHER_FIX, OTHER_FIX, FIXED_FIX]


@pytest.mark.parametrize(
    ("word", "number", "expected"),
    [
        ("NARROW_INT", 50, FIXED_FIX),
        ("L1_INT", 48, FIXED_FIX),
        ("INS_RTKFIXED", 56, FIXED_FIX),
        ("NARROW_FLOAT", 34, FLOAT_FIX),
        ("IONOFREE_FLOAT", 33, FLOAT_FIX),
        ("INS_RTKFLOAT", 55, FLOAT_FIX),
        ("SINGLE", 16, OTHER_FIX),
        ("WAAS", 18, OTHER_FIX),
        ("PPP", 69, OTHER_FIX),
    ],
)
def test_novatel_types_say_the_same_as_words_and_as_numbers(word: str, number: int, expected: int) -> None:
    assert stated(NUMBER, "pos_type.type", [number]) == [expected]
    assert stated(WORD, "position_type", [0, -1], [word]) == [expected, NOT_STATED]
