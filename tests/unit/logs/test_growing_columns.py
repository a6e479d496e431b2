"""Columns that grow in place equal the parts they were made of, joined."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from icrtool.logs.messages.topic_table import GrowingColumn


def joined(parts: list[NDArray[Any]], lacking: float) -> NDArray[Any]:
    """Join parts the plain way: a list of rows, filled up."""
    if parts[0].ndim == 1:
        return np.concatenate(parts)
    width = max(part.shape[1] for part in parts)
    return np.array([[*row, *[lacking] * (width - len(row))] for part in parts for row in part.tolist()])


@pytest.mark.parametrize("expected", [0, 7, 1 << 60])
@pytest.mark.parametrize("seed", range(20))
def test_a_column_is_its_parts_joined(seed: int, expected: int) -> None:
    rng = np.random.default_rng(seed)
    floats, flat = bool(rng.integers(2)), bool(rng.integers(2))
    parts: list[NDArray[Any]] = []
    for _ in range(rng.integers(1, 8)):
        rows, width = int(rng.integers(0, 30)), int(rng.integers(1, 4))
        values = rng.normal(size=(rows, width)) if floats else rng.integers(-3, 3, (rows, width))
        if rng.random() < 0.5:
            values[:] = rng.choice([0, 1])
        if floats and rng.random() < 0.3:
            values[:] = np.nan
        parts.append(values[:, 0] if flat else values)
    column = GrowingColumn(-1)
    for part in parts:
        column.add(part.copy(), expected)
    found = column.rows()
    filled = [part for part in parts if len(part)]
    if filled:
        np.testing.assert_array_equal(found, joined(filled, np.nan if floats else -1))
        assert found.dtype == filled[0].dtype
    else:
        assert len(found) == 0


def test_equal_rows_take_the_memory_of_one() -> None:
    column = GrowingColumn(0)
    for _ in range(3):
        column.add(np.full((1000, 9), np.nan), 3000)
    assert column.rows().shape == (3000, 9)
    assert column.rows().strides[0] == 0


def test_zero_and_minus_zero_are_kept_apart() -> None:
    column = GrowingColumn(0)
    column.add(np.zeros(5), 10)
    column.add(-np.zeros(5), 10)
    assert np.signbit(column.rows()).tolist() == [False] * 5 + [True] * 5
