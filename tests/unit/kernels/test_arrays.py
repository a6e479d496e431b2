"""Rows at equal steps: those of a search for every step, in memory that does not grow with the values."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from icrtool.kernels.arrays import rows_at_steps


@pytest.mark.parametrize("seed", range(20))
def test_rows_are_those_of_a_search_for_every_step(seed: int) -> None:
    rng = np.random.default_rng(seed)
    progress = np.concatenate([[0.0], np.cumsum(rng.exponential(1.0, 200) * (rng.random(200) < 0.7))])
    for step in (0.1, 1.0, 7.3, 1e4):
        searched = np.unique(np.searchsorted(progress, np.arange(0.0, float(progress[-1]), step)))
        assert rows_at_steps(progress, step).tolist() == searched.tolist()


@pytest.mark.parametrize("progress", [[], [0.0], [0.0, 0.0], [np.nan, np.nan]])
def test_where_nothing_moves_there_are_no_rows(progress: list[float]) -> None:
    assert len(rows_at_steps(np.array(progress), 1.0)) == 0


def test_a_huge_distance_takes_no_memory() -> None:
    progress = np.array([0.0, 1.0, 1e15, 2e15])
    tracemalloc.start()
    rows = rows_at_steps(progress, 0.1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert rows.tolist() == [0, 1, 2, 3]
    assert peak < 100_000
