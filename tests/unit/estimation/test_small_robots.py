"""Robots of 20 cm under motion capture: their multiplier is shown, and its standard deviation fits its scatter."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from icrtool.calibration.run_models import with_motion
from icrtool.config import load_config
from icrtool.pipeline import fit
from icrtool.records.run import Run
from support.drives import make_pose_log

CONFIG = load_config(sets=["robot.track_width_m=0.2"])
ROLLS, SLIPS = (0.101, -0.101, 0.0), (0.15, -0.14, 0.0)
SEEDS = 8


@functools.cache
def run_of(seed: int, icrs: tuple[float, float, float], wheels_vary: float = 0.01) -> Run:
    return fit(make_pose_log(seed, 3e-4, 0.1, icrs, wheels_vary=wheels_vary), CONFIG)


@pytest.mark.parametrize(("icrs", "largest"), [(ROLLS, 0.02), (SLIPS, 0.05)])
def test_the_multiplier_of_a_small_robot_is_shown_with_a_sigma_that_fits_its_scatter(
    icrs: tuple[float, float, float], largest: float
) -> None:
    truth = (icrs[0] - icrs[1]) / 0.2
    found = [run_of(seed, icrs).summary for seed in range(SEEDS)]
    assert all(one["excitation"]["verdict"]["y_icr_right_m"] == "shown" for one in found)
    values, stds = (
        np.array([one["icr"][key] for one in found]) for key in ("separation_multiplier", "separation_multiplier_std")
    )
    assert stds.max() < largest
    assert np.sqrt(np.mean(((values - truth) / stds) ** 2)) < 1.2
    # most of what is stated where it slips is what stretches of other ground would differ by; here they do not
    assert values.std() > stds.mean() / 10.0


def test_only_a_robot_that_rolls_is_said_to_turn_as_a_differential_drive() -> None:
    rolls, slips = (" ".join(run_of(0, icrs, 0.0).summary["warnings"]) for icrs in (ROLLS, SLIPS))
    assert "differential drive" in rolls
    assert "differential drive" not in slips


@pytest.mark.parametrize("icrs", [ROLLS, SLIPS])
def test_the_controllers_multiplier_of_a_small_robot_is_known_to_half_a_percent(
    icrs: tuple[float, float, float],
) -> None:
    for seed in range(3):
        controller = with_motion(run_of(seed, icrs, 0.0)).controller
        assert controller is not None
        assert controller.multiplier_std < 0.005
        assert abs(controller.multiplier - (icrs[0] - icrs[1]) / 0.2) < 3.0 * controller.multiplier_std
