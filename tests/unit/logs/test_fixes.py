"""How receivers say fixed, float or other: numbers of the drivers' and the vendors' own documents."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.fixes import (
    GPSFIX_STATUS,
    class_by_carrier,
    class_by_mode,
    class_by_status,
    class_by_type,
)
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, NOT_STATED, OTHER_FIX, RTK_FIX


def table_of(path: str, values: Any, texts: list[str] | None = None) -> TopicTable:
    column = np.asarray(values)
    return TopicTable(
        "/t", "x/Y", np.arange(len(column)), {path: column}, {path: texts} if texts is not None else {}, 0, ""
    )


def told(found: Any) -> list[int]:
    return [int(code) for code in found]


def test_a_navsatfix_says_rtk_with_gbas_and_nothing_where_it_never_does() -> None:
    assert told(class_by_status(table_of("status.status", [2, 0, 1, 2]))) == [RTK_FIX, OTHER_FIX, OTHER_FIX, RTK_FIX]
    assert class_by_status(table_of("status.status", [0, 0, 1])) is None
    assert class_by_status(table_of("other", [0])) is None


def test_a_gpsfix_says_19_for_fixed_and_20_for_float() -> None:
    found = class_by_status(table_of("status.status", [19, 20, 18, 33, 2, 7]), GPSFIX_STATUS)
    assert told(found) == [FIXED_FIX, FLOAT_FIX, OTHER_FIX, OTHER_FIX, RTK_FIX, NOT_STATED]
    assert class_by_status(table_of("status.status", [0, 0]), GPSFIX_STATUS) is None


def test_navpvt_says_64_for_float_and_128_for_fixed() -> None:
    assert told(class_by_carrier(np.array([1, 1 + 64, 1 + 128 + 32]))) == [OTHER_FIX, FLOAT_FIX, FIXED_FIX]
    assert class_by_carrier(None) is None


def test_septentrio_modes_are_4_for_fixed_and_5_for_float_whatever_the_high_bits() -> None:
    assert told(class_by_mode(np.array([4, 5, 6, 1, 4 | 0x40]))) == [
        FIXED_FIX, FLOAT_FIX, OTHER_FIX, OTHER_FIX, FIXED_FIX
    ]  # fmt: skip


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
    assert told(class_by_type(table_of("pos_type.type", [number]), "pos_type.type")) == [expected]
    assert told(class_by_type(table_of("position_type", [0, -1], [word]), "position_type")) == [expected, NOT_STATED]
