"""Drives whose ground changes are named as that, and not as filtered odometry."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.output.tables.run import format_run
from icrtool.pipeline import fit
from icrtool.records.tables import RobotLog
from support.drives import ICRS, make_log

WIDTH_M = 0.8
CONFIG = load_config(sets=[f"robot.track_width_m={WIDTH_M}"])
BEFORE = (ICRS[0] - ICRS[1]) / WIDTH_M


def with_changes(changes: list[tuple[float, float]], seconds: float, seed: int = 0) -> RobotLog:
    """Return a drive whose y ICRs are some factor times as far apart from each time on.

    The sides' difference is divided by it, their mean kept: the same path with other wheels.
    """
    log = make_log(seed, seconds=seconds, rate=20.0)
    t = (log.wheels.stamp_ns - log.wheels.stamp_ns[0]) / 1e9
    left, right = log.wheels.v_left_mps, log.wheels.v_right_mps
    width = ICRS[0] - ICRS[1]
    # V = v + omega y for each side, of the same motion
    omega = (left - right) / width
    forward = (ICRS[0] * left - ICRS[1] * right) / width
    factor = np.ones(len(t))
    for one, at_s in changes:
        factor[t >= at_s] = one
    y_right, y_left = (factor * y for y in ICRS[:2])
    sides = forward - omega * y_left, forward - omega * y_right
    wheels = replace(log.wheels, left=sides[0], right=sides[1])
    return replace(log, wheels=wheels)


def with_change(factor: float, at_s: float, seconds: float = 240.0) -> RobotLog:
    return with_changes([(factor, at_s)], seconds)


def test_the_wheels_of_an_unchanged_ground_are_those_of_the_log() -> None:
    log, same = make_log(seconds=240.0, rate=20.0), with_change(1.0, 120.0)
    np.testing.assert_allclose(same.wheels.left, log.wheels.left, rtol=0, atol=1e-12)
    np.testing.assert_allclose(same.wheels.right, log.wheels.right, rtol=0, atol=1e-12)


@pytest.mark.parametrize("factor", [0.7, 0.85, 1.2])
@pytest.mark.parametrize("at_s", [90.0, 140.0])
def test_a_change_is_named_with_its_time_and_both_multipliers(factor: float, at_s: float) -> None:
    run = fit(with_change(factor, at_s), CONFIG)
    codes = [one.code for one in run.document.notes]
    assert "wheels_filtered" not in codes
    assert "ground_changed" in codes
    assert run.document.wheels.ground_change_s == pytest.approx(at_s, abs=10.0)
    (text,) = [one.text for one in run.document.notes if one.code == "ground_changed"]
    before, after = (float(part.split()[-1]) for part in text.split(" ± ")[:2])
    assert (before, after) == pytest.approx((BEFORE, factor * BEFORE), rel=0.05)
    assert run.usable
    assert run.document.partly_because == text
    assert "PARTLY" in format_run(run)


def test_a_drive_on_one_ground_shows_no_change() -> None:
    run = fit(make_log(seconds=240.0, rate=20.0), CONFIG)
    assert run.document.wheels.ground_change_s is None
    assert run.document.partly_because is None
    assert run.document.wheels.turn_unexplained is not None
    assert run.document.wheels.turn_unexplained < 0.05
    assert run.document.wheels.ground_stretches == ()


SEVERAL = [
    [(0.75, 100.0), (1.0, 220.0)],
    [(0.8, 110.0), (0.6, 210.0)],
    [(1.25, 90.0), (0.9, 200.0)],
    [(0.7, 80.0), (1.0, 160.0), (0.7, 240.0)],
    [(0.8, 90.0), (0.6, 170.0), (1.1, 260.0)],
]


@pytest.mark.parametrize(("changes", "seed"), [*((one, 0) for one in SEVERAL), (SEVERAL[0], 1), (SEVERAL[-1], 1)])
def test_two_and_three_changes_are_named_each_with_its_stretch(changes: list[tuple[float, float]], seed: int) -> None:
    run = fit(with_changes(changes, 340.0, seed), CONFIG)
    stretches = run.document.wheels.ground_stretches
    assert len(stretches) == len(changes) + 1
    for one, (factor, at_s) in zip(stretches, [(1.0, 0.0), *changes], strict=True):
        assert one.begin_s == pytest.approx(at_s, abs=8.0)
        assert abs(one.multiplier - factor * BEFORE) < max(4.0 * one.multiplier_std, 0.04)
    for before, after in pairwise(stretches):
        assert before.end_s == after.begin_s
    (text,) = [one.text for one in run.document.notes if one.code == "ground_changed"]
    assert text.count("--terrain-change") == len(changes)
    assert text.count(" ± ") == len(stretches)
    shown = format_run(run)
    assert run.document.partly_because == text
    assert all(f"{one.multiplier:.3f}" in shown for one in stretches)
    assert "multiplier ± σ by the turns" in shown


@pytest.mark.parametrize("seed", range(6))
def test_a_drive_on_one_ground_has_one_stretch(seed: int) -> None:
    assert fit(make_log(seed, seconds=340.0, rate=20.0), CONFIG).document.wheels.ground_stretches == ()
