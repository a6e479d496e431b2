"""The compiled choice of rows at least a step apart, against plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest

from icrtool.kernels.kinematics import chord_rows


@pytest.mark.parametrize("step", [0.0, 0.1, 0.5, 100.0])
def test_rows_are_those_of_a_plain_loop(step: float) -> None:
    rng = np.random.default_rng(0)
    north, east = np.cumsum(rng.normal(0.0, 0.1, (2, 400)), axis=1)
    expected = [0]
    for k in range(1, 400):
        if math.hypot(north[k] - north[expected[-1]], east[k] - east[expected[-1]]) >= step:
            expected.append(k)
    assert chord_rows(north, east, step).tolist() == expected


def test_one_position_is_one_row() -> None:
    assert chord_rows(np.zeros(1), np.zeros(1), 0.1).tolist() == [0]
