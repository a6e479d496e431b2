"""Values at the ends of what a float holds: no reader's arithmetic warns, as warnings are errors here."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.errors import IcrToolError
from icrtool.kernels.arrays import Floats
from icrtool.logs.messages.topic_table import LARGEST_VALUE, GrowingColumn, TopicTable
from icrtool.logs.streams.message_types import MESSAGE_TYPES
from icrtool.logs.streams.sources import HeadingSource, PositionSource
from icrtool.records.samples import ROLE_WORDS, Role
from icrtool.records.text import LogText
from support.tables import fields_of, read_source

CONFIG = load_config(sets=["robot.track_width_m=0.55"])
EXTREME = [
    0.0,
    -1.0,
    1.0,
    np.nan,
    np.inf,
    -np.inf,
    LARGEST_VALUE,
    -LARGEST_VALUE,
    1.7e308,
    -1.7e308,
    1e155,
    5e-324,
    1e-310,
]
WHEELS = [LogText(f"{end}_{side}_wheel") for end in ("front", "rear") for side in ("left", "right")]
CODES = ("status", "flags", "mode", "error", "orientation", "unit", "reference", "type")
"""Last words of the fields that are whole numbers."""


def held(values: Floats) -> Floats:
    """Return values (n,) or (n, k) as a column of a log holds them."""
    column = GrowingColumn(0)
    column.add(values, len(values))
    return np.array(column.rows())


def table_of(message_type: str, fields: tuple[str, ...], rng: np.random.Generator) -> TopicTable:
    """Return a table of a type whose numbers are now and then, often or always extreme."""
    count, share = int(rng.choice([1, 2, 3, 40])), rng.choice([0.05, 0.5, 1.0])
    some = rng.choice(EXTREME, rng.integers(1, 6))
    columns, texts = {}, {}
    for path in fields:
        last = path.replace("[*]", "").rsplit(".", 1)[-1]
        if last in ("sec", "nanosec"):
            columns[path] = np.arange(count)
        elif "name" in last or last == "frame_id":
            texts[path] = WHEELS if "[*]" in path else [LogText("x")]
            columns[path] = np.tile(np.arange(4), (count, 1)) if "[*]" in path else np.zeros(count, np.int64)
        elif last.endswith(CODES) and "." not in path.removeprefix("status."):
            columns[path] = rng.integers(0, 512 if last == "flags" else 3, count)
        else:
            shape = (count, 4) if "[*]" in path else (count,)
            usual, extreme = rng.normal(size=shape), rng.choice(some, shape)
            columns[path] = held(np.where(rng.random(shape) < share, extreme, usual))
    return TopicTable(LogText("/a/b"), LogText(message_type), np.arange(count) * 10**8, columns, texts, 0)


def test_what_is_too_large_is_infinite_in_a_column_and_all_else_is_kept() -> None:
    values = np.array([1.0, LARGEST_VALUE, -LARGEST_VALUE, 1.7e308, -1e31, np.inf, -np.inf, np.nan, 5e-324, -0.0])
    expected = [1.0, LARGEST_VALUE, -LARGEST_VALUE, np.inf, -np.inf, np.inf, -np.inf, np.nan, 5e-324, -0.0]
    np.testing.assert_array_equal(held(values), expected)
    np.testing.assert_array_equal(held(np.full(5, -1.7e308)), np.full(5, -np.inf))


@pytest.mark.parametrize(("role", "name"), [(role, name) for role in ROLE_WORDS for name in MESSAGE_TYPES[role]])
def test_messages_of_any_type_are_read_without_a_warning(role: Role, name: str) -> None:
    for seed in range(60):
        with suppress(IcrToolError):
            source = read_source(role, table_of(name, fields_of(role, name), np.random.default_rng(seed)), CONFIG)
            if isinstance(source, HeadingSource):
                assert np.isfinite(source.heading_rad("ned")[source.usable]).all()
                source.heading_rad("enu")
            elif isinstance(source, PositionSource):
                place = source.geodetic if source.geodetic is not None else source.metric
                assert place is not None
                assert np.isfinite(place[source.usable, :2]).all()
