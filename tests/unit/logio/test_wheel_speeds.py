"""From what wheels tell to speeds: what no wheel can have done is left out, and said."""

from __future__ import annotations

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.logio.stamps import StampedRows
from icrtool.logio.wheel_sources import motion_of
from icrtool.logio.wheel_speeds import wheel_samples
from icrtool.tables import Floats, Ints, PositionFixes

RADIUS_M, STEP_NS = 0.1, 20_000_000
CONFIG = load_config(sets=[f"robot.wheel_radius_m={RADIUS_M}"])
NOTHING = PositionFixes(np.empty(0, np.int64), *(np.empty(0) for _ in range(5)))


def speeds_of(left: Floats, right: Floats) -> tuple[Ints, Floats, Floats, list[str]]:
    stamps = STEP_NS * np.arange(len(left), dtype=np.int64)
    motion = motion_of("/wheels", "some/Type", StampedRows(None, stamps, "", 0), position=(left, right))
    samples, _, warnings = wheel_samples(motion, stamps, CONFIG, NOTHING, "log")
    return samples.stamp_ns, samples.v_left_mps, samples.v_right_mps, warnings


@pytest.fixture
def travel() -> Floats:
    """Positions [rad] of a wheel that speeds up to 8 rad/s, stops, and goes on."""
    t = np.arange(600) * STEP_NS / 1e9
    return np.cumsum(np.where((t > 5) & (t < 7), 0.0, np.minimum(4 * t, 8.0))) * STEP_NS / 1e9


@pytest.mark.parametrize("where", [1, 250, 300, 598])
def test_a_counter_that_is_reset_costs_one_sample_and_is_said(travel: Floats, where: int) -> None:
    _, clean, _, nothing = speeds_of(travel, travel)
    reset = np.where(np.arange(len(travel)) >= where, travel + 12.0, travel)
    stamps, left, right, warnings = speeds_of(reset, travel)
    kept = np.isin(STEP_NS * np.arange(len(travel)), stamps)
    assert np.count_nonzero(~kept) == 1
    assert left == pytest.approx(clean[kept], abs=1e-9)
    assert right == pytest.approx(clean[kept], abs=1e-9)
    assert len(warnings) == 1
    assert "1 wheel speeds, up to 60 m/s" in warnings[0] or "up to 61 m/s" in warnings[0]
    assert not nothing


def test_hard_braking_and_a_short_dash_of_a_robot_that_mostly_stands_are_driving() -> None:
    speed = np.zeros(5000)
    speed[1000:1008], speed[3000:3004] = 40.0, -40.0
    travel = np.concatenate([[0.0], np.cumsum(speed)[:-1]]) * STEP_NS / 1e9
    _, left, _, warnings = speeds_of(travel, travel)
    assert np.abs(left).max() == pytest.approx(40.0 * RADIUS_M)
    assert len(left) == 5000
    assert not warnings
