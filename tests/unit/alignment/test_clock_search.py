"""Streams that are stamped wrongly by seconds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from icrtool.alignment.clock_search import _correlations, take_shifts
from icrtool.config import load_config
from icrtool.kernels.arrays import Floats
from icrtool.pipeline import fit
from icrtool.records.run import Run
from icrtool.records.samples import GyroAxes, GyroSamples
from icrtool.records.tables import RobotLog
from support.drives import ICRS, make_log

WIDTH_M = 0.8
SETS = (f"robot.track_width_m={WIDTH_M}",)


def later(log: RobotLog, **by_s: float) -> RobotLog:
    """Return a log whose streams are stamped later."""
    moved: dict[str, Any] = {
        name: replace(getattr(log, name), stamp_ns=getattr(log, name).stamp_ns + round(shift * 1e9))
        for name, shift in by_s.items()
    }
    return replace(log, **moved)


def check(run: Run) -> list[str]:
    """Check the ICRs of a run, and return the codes of its findings."""
    assert run.usable
    numbers = run.document.controller
    assert numbers is not None
    assert numbers.multiplier == pytest.approx((ICRS[0] - ICRS[1]) / WIDTH_M, abs=0.02)
    return [one.code for one in run.document.notes]


@pytest.mark.parametrize("shift_s", [18.0, -18.0, 7.3, -26.0])
def test_fixes_of_another_clock_are_moved_back(shift_s: float) -> None:
    run = fit(later(make_log(seconds=120.0), gnss=shift_s), load_config(sets=SETS))
    assert "clock_shifted" in check(run)
    assert run.document.alignment["position_delay_s"].applied == pytest.approx(shift_s, abs=0.1)
    (text,) = [one.text for one in run.document.notes if one.code == "clock_shifted"]
    assert ("GPS time is 18 s ahead of UTC" in text) is (abs(shift_s) == 18.0)


@pytest.mark.parametrize("streams", [("heading",), ("gnss", "heading")], ids=" and ".join)
def test_headings_of_another_clock_are_moved_back(streams: tuple[str, ...]) -> None:
    run = fit(later(make_log(seconds=120.0), **dict.fromkeys(streams, 18.0)), load_config(sets=SETS))
    check(run)
    assert run.document.alignment["heading_delay_s"].applied == pytest.approx(18.0, abs=0.1)


def with_gyro(log: RobotLog, topic: str) -> RobotLog:
    """Return a log with the turn rates of an inertial unit, at the stamps of its headings."""
    stamps, turned = log.heading.stamp_ns, np.unwrap(log.heading.heading_rad)
    # a second of headings hides their noise
    t = (stamps - stamps[0]) / 1e9
    rate = np.interp(t + 0.5, t, turned) - np.interp(t - 0.5, t, turned)
    axes = GyroAxes(topic, stamps, np.column_stack([0.0 * rate, 0.0 * rate, -rate]))
    return replace(log, gyros=(axes,), gyro=GyroSamples(topic, stamps, rate))


@pytest.mark.parametrize("same_message", [True, False])
def test_turn_rates_of_another_clock_are_moved_back(same_message: bool) -> None:
    plain = make_log(seconds=120.0)
    sent = later(plain, heading=18.0)
    topic = sent.topic("heading") if same_message else "/imu/gyro"
    log = with_gyro(sent, topic)
    moved, _, shifts = take_shifts(log, load_config(sets=SETS))
    # the alignment finds the rest of it
    assert shifts.heading == pytest.approx(18.0, abs=0.2)
    assert moved.gyro is not None
    for gyro in (moved.gyro, *moved.gyros):
        off = (gyro.stamp_ns - plain.heading.stamp_ns) / 1e9
        assert np.abs(off).max() < 0.3
    assert sum("turn rates of the gyro" in one.text for one in shifts.notes) == (not same_message)


def test_turn_rates_of_one_clock_with_the_wheels_stay_where_they_are() -> None:
    log = with_gyro(make_log(seconds=120.0), "/imu/gyro")
    moved, _, shifts = take_shifts(log, load_config(sets=SETS))
    assert moved is log
    assert not shifts.notes


@pytest.mark.parametrize("shift_s", [18.0, -45.0])
def test_a_configured_delay_moves_the_fixes_before_they_are_looked_at(shift_s: float) -> None:
    config = load_config(sets=[*SETS, f"frames.reference_delay_s={shift_s}"])
    run = fit(later(make_log(seconds=120.0), gnss=shift_s), config)
    assert "clock_shifted" not in check(run)
    assert run.document.alignment["position_delay_s"].applied == pytest.approx(shift_s, abs=1e-9)
    assert run.document.config.frames.reference_delay_s == shift_s


def test_clocks_that_agree_are_left_alone() -> None:
    run = fit(make_log(seconds=120.0), load_config(sets=SETS))
    assert "clock_shifted" not in check(run)


@pytest.mark.parametrize("row", [-1, 700])
@pytest.mark.parametrize("shift_s", [0.0, 18.0])
def test_a_fix_that_jumps_shows_no_shift(row: int, shift_s: float) -> None:
    log = later(make_log(seconds=120.0), gnss=shift_s)
    north = log.gnss.north_m.copy()
    north[row] += 55_000.0
    found = take_shifts(replace(log, gnss=replace(log.gnss, north_m=north)), load_config(sets=SETS))[2]
    assert found.gnss == pytest.approx(shift_s, abs=0.2)


def test_a_drive_that_repeats_itself_shows_no_shift() -> None:
    log = make_log(seconds=120.0)
    t = (log.wheels.stamp_ns - log.wheels.stamp_ns[0]) / 1e9
    speed = 0.5 + 0.2 * np.sign(np.sin(2 * np.pi * t / 10.0))
    wheels = replace(log.wheels, left=speed, right=speed)
    north = np.interp(log.gnss.stamp_ns, log.wheels.stamp_ns, np.cumsum(speed) * 0.02)
    repeated = replace(log, wheels=wheels, gnss=replace(log.gnss, north_m=north, east_m=0.0 * north))
    heading = replace(log.heading, heading_rad=0.0 * log.heading.heading_rad)
    found = take_shifts(later(replace(repeated, heading=heading), gnss=12.0), load_config(sets=SETS))[2]
    assert found.gnss == 0.0


def by_pairs(own: Floats, seen: Floats, lag: int) -> tuple[float, int]:
    """Return the squared correlation at a lag and its number of pairs, pair by pair."""
    pairs = [(own[i], seen[i + lag]) for i in range(len(own)) if 0 <= i + lag < len(seen)]
    a, b = np.array([pair for pair in pairs if np.isfinite(pair).all()]).reshape(-1, 2).T
    if len(a) < 3 or np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
        return 0.0, len(a)
    return float(np.corrcoef(a, b)[0, 1]) ** 2, len(a)


@pytest.mark.parametrize("kind", ["random", "parked, then driven", "parked", "one spike", "mostly unknown", "unknown"])
def test_correlations_by_transforms_are_those_of_the_pairs(kind: str) -> None:
    rng = np.random.default_rng(5)
    own = np.cumsum(rng.normal(size=400)) + 1e3
    seen = np.roll(own, 12) + rng.normal(size=400)
    if kind == "parked, then driven":
        own[:330], seen[:350] = 0.0, rng.normal(0.0, 1e-6, 350)
    elif kind == "parked":
        own[:] = 0.0
    elif kind == "one spike":
        seen[395] = 1e7
    for column in (own, seen):
        column[rng.random(400) < {"mostly unknown": 0.8, "unknown": 1.0}.get(kind, 0.1)] = np.nan
    lags = np.arange(-150, 151)
    found, counts = _correlations(own, seen, lags)
    expected = np.array([by_pairs(own, seen, lag) for lag in lags.tolist()])
    np.testing.assert_array_equal(counts, expected[:, 1])
    few = expected[:, 1] < 0.5 * expected[:, 1].max()
    np.testing.assert_allclose(found, np.where(few, 0.0, expected[:, 0]), rtol=0.0, atol=1e-9)
