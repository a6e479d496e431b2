"""Rows at equal steps: those of a search for every step, in memory that does not grow with the values; runs; angles."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from icrtool.kernels.arrays import in_spans, rows_at_steps, runs_of, unwrapped, wrapped


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


@pytest.mark.parametrize("seed", range(5))
def test_angles_wrap_and_unwrap_as_numpy_has_them(seed: int) -> None:
    turned = np.cumsum(np.random.default_rng(seed).uniform(-3.1, 3.1, 500))
    angle = wrapped(turned)
    assert np.abs(angle).max() <= np.pi
    # rounding of a hundred turns
    assert angle == pytest.approx(np.angle(np.exp(1j * turned)), abs=1e-12)
    assert unwrapped(angle) == pytest.approx(np.unwrap(angle), abs=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_times_in_spans_about_runs_are_those_near_a_marked_row(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, at = np.sort(rng.uniform(0.0, 100.0, 300)), np.sort(rng.uniform(-10.0, 110.0, 200))
    marked = rng.random(300) < rng.choice([0.0, 0.02, 0.5, 1.0])
    begin, behind = runs_of(marked)
    assert np.flatnonzero(marked).tolist() == [row for span in zip(begin, behind, strict=True) for row in range(*span)]
    inside = [any(low <= one <= high for low, high in zip(t[begin] - 1, t[behind - 1] + 1, strict=True)) for one in at]
    assert in_spans(at, t[begin] - 1, t[behind - 1] + 1).tolist() == inside
