"""Process noise that follows the log: its search, its cost, and what it does on drives whose wheels or heading err."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.estimation.run_filter import find_noise, innovation_cost, noise_of, set_up_again
from icrtool.kernels.ekf import run_ekf
from icrtool.kernels.filter_records import GATED
from icrtool.pipeline import fit
from icrtool.records.presets import FIELD, PAPER, ProcessNoise
from icrtool.records.run import Run
from icrtool.records.samples import Datum
from icrtool.records.tables import RobotLog
from support.documents import with_summary
from support.drives import ICRS, make_log

WIDTH = "robot.track_width_m=0.6"


def bowl(best: ProcessNoise, tried: list[ProcessNoise], plateau: float = 0.0) -> float:
    """Cost that is flat up to `plateau` doublings from the start and falls towards `best` from there."""
    one = tried[-1]
    up = math.log2(one.position_mps / FIELD.process_noise.position_mps)
    off = math.log2(one.position_mps / best.position_mps), math.log2(one.heading_degps / best.heading_degps)
    return 50.0 - 0.01 * up if up < plateau else off[0] ** 2 + off[1] ** 2


@pytest.mark.parametrize("plateau", [0.0, 3.5])
def test_the_search_passes_over_doublings_that_change_nothing(plateau: float) -> None:
    best, tried = ProcessNoise(4.8, 28.0), []

    def cost(noise: ProcessNoise) -> float:
        tried.append(noise)
        return bowl(best, tried, plateau)

    assert find_noise(cost, FIELD.process_noise, search_position=True, search_heading=True) == pytest.approx(best)
    assert len(tried) == len(set(tried)) <= 20


def test_of_noises_that_are_as_good_the_smallest_is_taken() -> None:
    assert (
        find_noise(lambda noise: 3.0, FIELD.process_noise, search_position=True, search_heading=True)
        == FIELD.process_noise
    )


def test_what_is_configured_is_not_searched_for() -> None:
    best = ProcessNoise(4.8, 28.0)
    found = find_noise(
        lambda noise: bowl(best, [noise]), FIELD.process_noise, search_position=False, search_heading=True
    )
    assert found == pytest.approx((FIELD.process_noise.position_mps, 28.0))


def cost_of(run: Run, noise: ProcessNoise) -> float:
    setup = set_up_again(with_summary(run, filter={"process_position_mps": noise.position_mps}))
    return innovation_cost(run_ekf(*setup))


def test_the_cost_is_least_near_the_noise_a_drive_was_made_with() -> None:
    """Track speeds with white errors of 0.6 m/s at 100 Hz: as Q of 0.6 m/s along the path."""
    log, rng = make_log(seed=3, seconds=120.0, rate=100.0), np.random.default_rng(4)
    both = 0.6 * rng.standard_normal(len(log.wheels.stamp_ns))
    wheels = replace(log.wheels, left=log.wheels.v_left_mps + both, right=log.wheels.v_right_mps + both)
    config = load_config(sets=[WIDTH, "filter.process_position_mps=0.3", "filter.process_heading_degps=7"])
    run = fit(replace(log, wheels=wheels), config)
    ladder = [0.075, 0.15, 0.3, 0.6, 1.2, 2.4]
    costs = [cost_of(run, ProcessNoise(one, 7.0)) for one in ladder]
    # half of the error's variance is in each direction: 0.42 m/s
    assert ladder[int(np.argmin(costs))] in (0.3, 0.6)


def test_gross_errors_of_a_few_fixes_do_not_raise_the_noise() -> None:
    log, rng = make_log(seed=1), np.random.default_rng(2)
    wrong = rng.random(len(log.gnss.stamp_ns)) < 0.15
    gnss = replace(log.gnss, north_m=log.gnss.north_m + wrong * rng.normal(0.0, 5.0, len(wrong)))
    run = fit(replace(log, gnss=gnss), load_config(sets=[WIDTH]))
    assert run.summary["gnss"]["rejected_by_gate"] > 0.1 * len(wrong)
    assert noise_of(run) == FIELD.process_noise


def turning_errors(log: RobotLog, std_degps: float, lasts_s: float = 0.5) -> RobotLog:
    """The log with wheels that report turns which the robot does not make, a new one every half a second."""
    rng, t = np.random.default_rng(5), (log.wheels.stamp_ns - log.wheels.stamp_ns[0]) / 1e9
    steps = (t / lasts_s).astype(int)
    turn = math.radians(std_degps) * rng.standard_normal(steps[-1] + 1)[steps]
    side = turn * 1.1 / 2
    return replace(
        log,
        wheels=replace(log.wheels, left=log.wheels.v_left_mps + side, right=log.wheels.v_right_mps - side),
    )


def test_the_heading_noise_follows_a_robot_whose_turns_are_not_its_wheels() -> None:
    log = turning_errors(make_log(seed=2), 40.0)
    run = fit(log, load_config(sets=[WIDTH]))
    fixed = fit(log, load_config(sets=[WIDTH, "filter.process_heading_degps=7", "filter.process_position_mps=0.3"]))
    assert noise_of(run).heading_degps > FIELD.process_noise.heading_degps
    assert noise_of(fixed) == FIELD.process_noise
    rejected = [float(np.mean(one.heading.code == GATED)) for one in (run, fixed)]
    assert rejected[0] < 0.02
    assert rejected[1] > 0.04
    assert run.summary["heading"]["rejected"] == int(np.count_nonzero(run.heading.code == GATED))
    assert any("filter.process_heading_degps" in warning for warning in run.warnings)
    assert run.summary["filter"]["process_heading_degps"] == noise_of(run).heading_degps


def test_a_clean_drive_takes_one_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    passes = []

    def counted(*given: object) -> object:
        passes.append(given)
        return run_ekf(*given)  # type: ignore[arg-type]

    monkeypatch.setattr("icrtool.estimation.run_filter.run_ekf", counted)
    fit(make_log(), load_config(sets=[WIDTH]))
    assert len(passes) == 1


def test_preset_paper_keeps_the_paper_s_noise() -> None:
    run = fit(turning_errors(make_log(seed=2), 40.0), load_config(sets=[WIDTH, "filter.preset=paper"]))
    assert noise_of(run) == PAPER.process_noise


def test_headings_are_as_noisy_as_the_wheels_turns_show_however_the_fixes_sway() -> None:
    """An antenna on a mast sways across; headings that state 30 deg cannot answer for it, though they err by 0.3."""
    log = make_log(0, 120.0, heading_std_deg=0.3)
    t = (log.gnss.stamp_ns - log.gnss.stamp_ns[0]) / 1e9
    psi = np.interp(log.gnss.stamp_ns, log.heading.stamp_ns, np.unwrap(log.heading.heading_rad))
    sway = 0.15 * np.sin(2.0 * math.pi * t / 4.0)
    gnss = replace(log.gnss, north_m=log.gnss.north_m - sway * np.sin(psi), east_m=log.gnss.east_m + sway * np.cos(psi))
    stated = np.full(len(log.heading.stamp_ns), math.radians(30.0) ** 2)
    log = replace(log, gnss=gnss, heading=replace(log.heading, var_rad2=stated), datum=Datum(40.8, -77.9, 350.0))
    run = fit(log, load_config(sets=["robot.track_width_m=0.8"]))
    assert run.usable
    assert noise_of(run).heading_degps <= 2.0 * FIELD.process_noise.heading_degps
    final = run.summary["icr"]["final"]
    assert final["y_icr_right_m"] == pytest.approx(ICRS[0], abs=0.03)
    assert final["y_icr_left_m"] == pytest.approx(ICRS[1], abs=0.03)
