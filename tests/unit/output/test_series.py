from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from icrtool.output.series import (
    breaks_after,
    evenly_spaced_rows,
    extremes,
    round_steps,
    rows_entering_cells,
    scale_end_m,
    scale_of,
)


@given(st.integers(1, 5000), st.integers(4, 600), st.integers(0, 99))
def test_thinning_keeps_both_ends_and_every_extreme(rows: int, points: int, seed: int) -> None:
    column = np.random.default_rng(seed).standard_normal(rows)
    shown = extremes(column, points=points)
    assert shown[0] == 0
    assert shown[-1] == rows - 1
    assert np.all(np.diff(shown) > 0) if rows > 1 else len(shown) == 1
    assert column[shown].min() == column.min()
    assert column[shown].max() == column.max()
    assert len(shown) <= points + 4


def test_a_single_spike_survives_in_either_column() -> None:
    low, high = np.zeros(100_000), np.zeros(100_000)
    low[12_345], high[77_777] = -1.0, 1.0
    shown = extremes(low, high, points=100)
    assert {12_345, 77_777} <= set(shown.tolist())
    assert len(shown) < 110


def test_missing_values_hide_no_extreme() -> None:
    column = np.sin(np.arange(10_000) / 100)
    column[::3] = np.nan
    shown = column[extremes(column, points=50)]
    assert np.nanmax(shown) == np.nanmax(column)
    assert np.nanmin(shown) == np.nanmin(column)


def test_a_break_in_the_line_stays_a_break() -> None:
    column = np.linspace(0.0, 1.0, 10_000)
    column[[4321, 7000, 7001]] = np.nan
    shown = column[extremes(column, points=200)]
    assert np.count_nonzero(np.isnan(shown)) == 2


def test_short_columns_are_left_whole() -> None:
    assert extremes(np.array([3.0, 1.0, 2.0])).tolist() == [0, 1, 2]


def test_a_path_keeps_a_point_in_every_cell_it_enters() -> None:
    way = np.linspace(0, 20 * np.pi, 200_000)
    north, east = 10 * np.cos(way), 10 * np.sin(way)
    shown = rows_entering_cells(north, east, 0.5)
    assert shown[0] == 0
    assert shown[-1] == len(way) - 1
    step = np.hypot(np.diff(north[shown]), np.diff(east[shown]))
    assert step.max() < 0.5 * np.sqrt(2) + 1e-3
    assert len(shown) < 5_000


@pytest.mark.parametrize("rows", [0, 1])
def test_hardly_any_path_is_no_trouble(rows: int) -> None:
    assert len(rows_entering_cells(np.zeros(rows), np.zeros(rows), 1.0)) == rows


def test_a_line_breaks_where_nothing_was_measured_for_long() -> None:
    t = np.concatenate([np.arange(0.0, 50.0, 0.1), np.arange(60.0, 100.0, 0.1)])
    assert breaks_after(t).tolist() == [499]
    assert breaks_after(np.delete(t, [100, 101])).tolist() == [497]
    assert breaks_after(t[:1]).tolist() == []


def test_a_few_outliers_do_not_flatten_a_scale_of_differences() -> None:
    usual = np.linspace(0.01, 0.02, 10_000)
    assert scale_end_m(usual) == pytest.approx(1.1 * 0.02)
    assert scale_end_m(np.append(usual, 50.0)) == pytest.approx(1.6 * 0.02, rel=0.01)
    assert scale_end_m(np.empty(0)) == 1.0


@given(st.integers(1, 5000), st.floats(1.0, 600.0))
def test_evenly_spaced_rows_end_with_the_last_one(rows: int, most: float) -> None:
    chosen, every = evenly_spaced_rows(rows, most)
    assert (chosen[0], chosen[-1]) == (0, rows - 1)
    assert set(np.diff(chosen[:-1]).tolist()) <= {every}
    assert len(chosen) <= most + 2
    assert every == 1 or rows > most


@given(st.floats(1e-6, 1e6))
def test_a_length_lies_between_the_first_and_the_last_round_one(length: float) -> None:
    steps = round_steps(length)
    assert steps[0] <= length * (1 + 1e-12)
    assert length < steps[-1] * (1 + 1e-12)
    assert steps / steps[0] == pytest.approx([1.0, 2.0, 5.0, 10.0])


def test_a_scale_holds_its_numbers_in_the_middle_and_is_never_a_point() -> None:
    low, high = scale_of([3.0, -1.0, 2.0])
    assert low < -1.0
    assert high > 3.0
    assert (low + high) / 2 == pytest.approx(1.0)
    low, high = scale_of([0.5])
    assert low < 0.5 < high
