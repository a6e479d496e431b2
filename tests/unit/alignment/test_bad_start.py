"""First fixes that lie far from the others, and jumps of the reference: neither is distance that was driven."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.pipeline import fit
from icrtool.records.tables import RobotLog
from support.drives import make_log

CONFIG = load_config(sets=["robot.track_width_m=0.8"])
WHOLE_M = fit(make_log(seconds=120.0), CONFIG).document.drive.distance_m


def moved(log: RobotLog, rows: slice, by_m: float) -> RobotLog:
    """Return a log whose fixes of some rows lie further north."""
    north = log.gnss.north_m.copy()
    north[rows] += by_m
    return replace(log, gnss=replace(log.gnss, north_m=north))


@pytest.mark.parametrize(("count", "by_m"), [(1, 30.0), (1, 55_000.0), (3, 30.0)])
def test_first_fixes_far_away_are_left_out(count: int, by_m: float) -> None:
    run = fit(moved(make_log(seconds=120.0), slice(0, count), by_m), CONFIG)
    assert [one.code for one in run.document.notes if one.code == "first_fixes_apart"]
    assert run.usable
    assert run.document.drive.distance_m == pytest.approx(WHOLE_M, rel=0.02)


@pytest.mark.parametrize("by_m", [3.0, 100.0])
def test_a_jump_of_the_datum_is_no_distance(by_m: float) -> None:
    run = fit(moved(make_log(seconds=120.0), slice(1200, None), by_m), CONFIG)
    assert run.usable
    assert len(run.document.reference_jumps) == 1
    assert run.document.drive.distance_m == pytest.approx(WHOLE_M, rel=0.02)
    assert run.document.drive.speed_std_mps < 0.5


def test_fixes_that_scatter_are_no_bad_start() -> None:
    log = make_log(seconds=120.0, gnss_std=0.8)
    codes = [one.code for one in fit(log, CONFIG).document.notes]
    assert "first_fixes_apart" not in codes
    assert np.isfinite(log.gnss.north_m).all()
