"""Smoothing a run: nearer to the truth, no less certain, in the run's own table."""

from __future__ import annotations

import numpy as np
import pytest

from icrtool.config import parse_config
from icrtool.estimation.run_filter import smooth_run
from icrtool.pipeline import fit
from icrtool.records.run import Run
from icrtool.records.tables import States
from support.drives import ICRS, make_log

CONFIG = parse_config({"robot": {"track_width_m": 0.6}})


@pytest.fixture(scope="module")
def pair() -> tuple[Run, States]:
    run = fit(make_log(0, 60.0), CONFIG)
    return run, smooth_run(run)


def test_the_table_is_the_runs_row_by_row(pair: tuple[Run, States]) -> None:
    run, smoothed = pair
    for name in ("stamp_ns", "t_s", "v_left_mps", "v_right_mps"):
        assert np.array_equal(getattr(smoothed, name), getattr(run.table, name))
    assert np.all(np.diff(smoothed.distance_m) >= 0)
    assert smoothed.distance_m[-1] == pytest.approx(run.table.distance_m[-1], rel=0.05)


def test_it_is_never_less_certain_than_the_filter(pair: tuple[Run, States]) -> None:
    run, smoothed = pair
    for name in ("north_m", "east_m", "heading_rad", "y_icr_right_m", "y_icr_left_m", "x_icr_m"):
        assert np.all(getattr(smoothed, f"std_{name}") <= getattr(run.table, f"std_{name}") * (1 + 1e-6) + 1e-9)


def test_the_icrs_are_known_from_the_first_second(pair: tuple[Run, States]) -> None:
    run, smoothed = pair
    early = run.table.t_s < 2.0
    for name, truth in zip(("y_icr_right_m", "y_icr_left_m", "x_icr_m"), ICRS, strict=True):
        filtered_miss = np.abs(getattr(run.table, name)[early] - truth).mean()
        miss = np.abs(getattr(smoothed, name)[early] - truth)
        assert miss.mean() < 0.3 * filtered_miss or miss.mean() < 0.02
        assert np.all(miss < 4 * getattr(smoothed, f"std_{name}")[early])


def test_fit_smooths_as_the_run_it_returns(pair: tuple[Run, States]) -> None:
    run = fit(make_log(0, 60.0), CONFIG, smooth=True)
    assert run.smoothed is not None
    for name, column in run.smoothed.columns().items():
        assert np.array_equal(column, getattr(pair[1], name)), name
