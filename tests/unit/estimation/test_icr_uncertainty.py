"""The stated σ of the final ICRs: against the truth over seeds, and where the robot's slip varies along the drive."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.estimation.observability import multiplier_std
from icrtool.pipeline import fit
from icrtool.records.run import ICR_COLUMNS, Run
from icrtool.records.tables import RobotLog
from support.drives import ICRS, make_log

WIDTH = "robot.track_width_m=0.6"


def errors_in_sigmas(run: Run, truth: tuple[float, float, float] = ICRS) -> list[float]:
    icr = run.summary["icr"]
    return [
        (icr["final"][name] - value) / icr["final_std"][name] for name, value in zip(ICR_COLUMNS, truth, strict=True)
    ]


def slipping(log: RobotLog, seed: int, share: float = 0.08, lasts_s: float = 20.0) -> RobotLog:
    """The log with wheels that slip in every stretch by another share, each side its own."""
    rng, t = np.random.default_rng(seed), (log.wheels.stamp_ns - log.wheels.stamp_ns[0]) / 1e9
    steps = (t / lasts_s).astype(int)
    left, right = 1.0 + share * rng.standard_normal((2, steps[-1] + 1))[:, steps]
    wheels = replace(log.wheels, left=left * log.wheels.v_left_mps, right=right * log.wheels.v_right_mps)
    return replace(log, wheels=wheels)


def test_two_sigma_cover_the_truth_over_seeds() -> None:
    config = load_config(sets=[WIDTH])
    errors = [errors_in_sigmas(fit(make_log(seed=seed, seconds=90.0), config)) for seed in range(8)]
    assert np.mean(np.abs(errors) < 2.0) >= 0.9


def test_the_filter_s_own_sigma_does_not_cover_slip_that_varies_and_the_stated_one_does() -> None:
    config = load_config(sets=[WIDTH])
    stated, own = [], []
    for seed in range(8):
        run = fit(slipping(make_log(seed=seed, seconds=160.0), seed), config)
        # unequal slip moves y right and y left, x follows from the heading
        for name, error in list(zip(ICR_COLUMNS, errors_in_sigmas(run), strict=True))[:2]:
            stated.append(error)
            own.append(error * run.summary["icr"]["final_std"][name] / run.states[f"std_{name}"].iloc[-1])
    assert np.mean(np.abs(own) < 2.0) < 0.85
    assert np.mean(np.abs(stated) < 2.0) >= 0.85


def test_the_states_keep_the_filter_s_own_sigma_and_preset_paper_states_it() -> None:
    log = make_log()
    field, paper = (fit(log, load_config(sets=[WIDTH, f"filter.preset={name}"])) for name in ("field", "paper"))
    for name in ICR_COLUMNS:
        assert field.summary["icr"]["final_std"][name] > field.states[f"std_{name}"].iloc[-1]
        assert paper.summary["icr"]["final_std"][name] == paper.states[f"std_{name}"].iloc[-1]


def test_the_multiplier_s_sigma_is_that_of_the_difference() -> None:
    assert multiplier_std(np.diag([0.03**2, 0.04**2, 1.0]), 0.5) == pytest.approx(0.1)
    together = np.full((3, 3), 0.05**2)
    assert multiplier_std(together, 0.5) == 0.0


def test_icrs_at_the_filter_s_limit_are_not_shown() -> None:
    """Wheels that turn the robot twice as fast as ICRs at the tracks could: the limit is all that is left."""
    log = make_log(icrs=(0.055, -0.055, 0.0), seconds=60.0)
    run = fit(log, load_config(sets=["robot.track_width_m=0.6"]))
    final = [getattr(run.table, name)[-1] for name in ICR_COLUMNS[:2]]
    assert np.abs(final) == pytest.approx([0.06, 0.06], abs=0.006)
    assert run.summary["icr"]["final"]["y_icr_right_m"] is None
    assert run.summary["icr"]["separation_multiplier"] is None
    assert not run.usable
    assert any("limit" in warning for warning in run.warnings)


def test_icrs_as_uncertain_as_at_the_start_are_not_shown() -> None:
    run = fit(make_log(gnss_std=10.0, seconds=30.0), load_config(sets=[WIDTH]))
    assert run.table.std_x_icr_m[-1] > 0.7 * 0.3
    assert run.summary["icr"]["final"]["x_icr_m"] is None
    assert run.summary["icr"]["final_std"]["x_icr_m"] is None


def test_a_run_whose_icrs_are_not_shown_still_starts_another() -> None:
    config = load_config(sets=[WIDTH])
    first = fit(make_log(gnss_std=10.0, seconds=30.0), config)
    again = fit(make_log(seed=1), config, warm_start=first.ended_with)
    assert again.usable
    assert max(map(abs, errors_in_sigmas(again))) < 3.0
    assert math.isfinite(first.ended_with.icrs_m.sum())
