from __future__ import annotations

import math

import numpy as np
import pytest

from icrtool.dropout_analysis.starts import CELLS_A_HORIZON, STRAIGHT_RAD, heading_range
from icrtool.kernels.track import Track

HORIZON_M, STEP_M = 5.0, 0.6


def drive_along(distance: np.ndarray, heading: np.ndarray) -> Track:
    one = np.ones(len(distance))
    return Track.of_states(np.cumsum(one), one, one, one, 0 * one, 0 * one, heading, distance)


@pytest.mark.parametrize("seed", range(5))
def test_the_range_is_that_of_the_way_to_a_cell(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # standstill, spins on the spot and steps longer than a cell, in which the heading is between its neighbours
    distance = np.cumsum(rng.choice([0.0, 0.01, 0.1, STEP_M], size=600))
    heading = np.cumsum(rng.normal(0, 0.05, 600))
    found, cell = heading_range(drive_along(distance, heading), HORIZON_M), HORIZON_M / CELLS_A_HORIZON + STEP_M
    for k in np.flatnonzero(distance < distance[-1] - HORIZON_M - cell)[::7]:
        inner = heading[k:][distance[k:] <= distance[k] + HORIZON_M]
        outer = heading[(distance >= distance[k] - cell) & (distance <= distance[k] + HORIZON_M + cell)]
        assert np.ptp(inner) - 1e-12 <= found[k]
        assert found[k] <= np.ptp(outer) + 1e-12


def test_an_s_is_a_turn_and_a_jittering_heading_is_none() -> None:
    distance = np.linspace(0.0, 60.0, 6000)
    s_curve = math.radians(20.0) * np.sin(2 * np.pi * distance / HORIZON_M)
    jitter = np.random.default_rng(1).normal(0, math.radians(1.0), len(distance))
    early = distance < 50.0
    assert (heading_range(drive_along(distance, s_curve), HORIZON_M)[early] > STRAIGHT_RAD).all()
    assert (heading_range(drive_along(distance, jitter), HORIZON_M)[early] < STRAIGHT_RAD).all()
