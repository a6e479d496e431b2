"""Wheels that contradict themselves are named as that: exchanged sides, a clock of another rate, speeds cut off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.kernels.arrays import Floats
from icrtool.output.tables.run import format_run
from icrtool.pipeline import fit
from icrtool.records.run import Run
from icrtool.records.tables import RobotLog
from support.drives import make_log

CONFIG = load_config(sets=["robot.track_width_m=0.8"])
Sides = tuple[Floats, Floats]


def drive(change: Callable[[Floats, Floats, Floats], Sides] = lambda _, left, right: (left, right)) -> RobotLog:
    """A drive whose measured speeds are changed: `change` takes times, left and right."""
    log = make_log(seconds=240.0, rate=20.0)
    rng, t = np.random.default_rng(1), (log.wheels.stamp_ns - log.wheels.stamp_ns[0]) / 1e9
    measured = (side + rng.normal(0.0, 0.005, len(t)) for side in (log.wheels.v_left_mps, log.wheels.v_right_mps))
    left, right = change(t, *measured)
    return replace(log, wheels=replace(log.wheels, left=left, right=right))


def with_clock(rate: float) -> RobotLog:
    log = drive()
    stamps = log.wheels.stamp_ns
    passed = np.rint((stamps - stamps[0]) * (1.0 + rate)).astype(np.int64)
    return replace(log, wheels=replace(log.wheels, stamp_ns=stamps[0] + passed))


def codes(run: Run) -> set[str]:
    return {one.code for one in run.document.notes}


def test_sides_that_are_exchanged_half_way_are_named_with_their_time() -> None:
    run = fit(
        drive(lambda t, left, right: (np.where(t < 130.0, left, right), np.where(t < 130.0, right, left))), CONFIG
    )
    assert not run.usable
    assert run.document.wheels.exchanged_s == pytest.approx(130.0, abs=6.0)
    assert "exchanged before or after about" in (run.document.unusable_because or "")
    assert not codes(run) & {"wheels_filtered", "wheels_slip", "turns_unexplained"}


@pytest.mark.parametrize("rate", [0.005, -0.005])
def test_a_clock_of_another_rate_is_named_with_its_rate(rate: float) -> None:
    run = fit(with_clock(rate), CONFIG)
    wheels = run.document.wheels
    assert wheels.clock_rate is not None
    assert wheels.clock_rate_std is not None
    assert abs(wheels.clock_rate - rate) < max(4.0 * wheels.clock_rate_std, 0.0005)
    assert "wheel_clock_differs" in codes(run)
    assert "wheels_filtered" not in codes(run)


@pytest.mark.parametrize("limit_mps", [0.68, 0.6])
def test_speeds_that_are_cut_off_are_named_and_the_numbers_hedged(limit_mps: float) -> None:
    run = fit(drive(lambda _, *sides: tuple(np.clip(side, -limit_mps, limit_mps) for side in sides)), CONFIG)
    assert run.document.wheels.limit_mps == limit_mps
    assert "PARTLY" in format_run(run)
    assert "speeds that were cut off" in (run.document.partly_because or "")


def test_a_sound_drive_has_none_of_them() -> None:
    run = fit(drive(), CONFIG)
    wheels = run.document.wheels
    assert (wheels.exchanged_s, wheels.clock_rate, wheels.limit_mps) == (None, None, None)
    assert not codes(run) & {"wheels_limited", "wheel_clock_differs", "sides_exchanged"}
    assert "agrees" in format_run(run)


def test_across_grounds_the_filter_agrees_with_none() -> None:
    log = drive(scaled)
    shown = format_run(fit(log, CONFIG))
    assert ": across grounds" in shown
    assert ": agrees" not in shown


def scaled(t: Floats, left: Floats, right: Floats) -> Sides:
    """Return sides whose difference is larger from the middle on: the multiplier is smaller."""
    factor = np.where(t < 120.0, 1.0, 0.75)
    return (left + right) / 2 + factor * (left - right) / 2, (left + right) / 2 - factor * (left - right) / 2
