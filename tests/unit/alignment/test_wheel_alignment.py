"""What wheel data get wrong is found, reported, and corrected where it is certain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.corrections import align_streams
from icrtool.config import load_config
from icrtool.estimation.fit import fit
from icrtool.records.tables import HeadingSamples, PositionFixes, RobotLog, WheelSamples
from icrtool.simulation.drives import DrivePlan, Sensors, drive_plan, sense
from icrtool.simulation.paths import PathPlan
from icrtool.simulation.study_runs import readings_log
from support.drives import ICRS, make_log

CONFIG = load_config(sets=["robot.track_width_m=0.8"])
ICR_TOLERANCE_M = 0.05


def with_wheels(log: RobotLog, left: np.ndarray, right: np.ndarray) -> RobotLog:
    return replace(log, wheels=replace(log.wheels, left=left, right=right))


def test_good_wheels_are_left_as_they_are() -> None:
    log = make_log(seconds=120.0)
    check = align_streams(log, CONFIG).wheels
    assert check.warnings == ()
    assert check.log is log
    assert check.scale == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda left, right: (right, left), "swapped"),
        (lambda left, right: (-left, right), "left wheels count backwards"),
        (lambda left, right: (left, -right), "right wheels count backwards"),
        (lambda left, right: (-left, -right), "both wheels count backwards"),
        (lambda left, right: (1.07 * left, 1.07 * right), "goes 93"),
        (lambda left, right: (0.95 * left, 0.95 * right), "goes 105"),
        (lambda left, right: (1.02 * left, 0.98 * right), "left side goes 4"),
        (lambda left, right: (0.93 * left, 0.97 * right), "right side goes 4"),
    ],
)
def test_certain_faults_are_put_right_and_said(spoil, words: str) -> None:  # type: ignore[no-untyped-def]
    log = make_log(seconds=120.0)
    spoilt = with_wheels(log, *spoil(log.wheels.v_left_mps, log.wheels.v_right_mps))
    run = fit(spoilt, CONFIG)
    assert any(words in warning for warning in run.warnings)
    final = run.summary["icr"]["final"]
    assert (final["y_icr_right_m"], final["y_icr_left_m"]) == pytest.approx(ICRS[:2], abs=ICR_TOLERANCE_M)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda left, right: (0 * left, right), "left wheels hardly ever move"),
        (lambda left, right: (left, left), "copy"),
        (lambda left, right: (3 * left, 3 * right), "check wheel radius"),
        (
            lambda left, right: (np.repeat(left[::10], 10)[: len(left)], np.repeat(right[::10], 10)[: len(right)]),
            "held",
        ),
    ],
)
def test_faults_that_cannot_be_put_right_are_named(spoil, words: str) -> None:  # type: ignore[no-untyped-def]
    log = make_log(seconds=120.0)
    check = align_streams(with_wheels(log, *spoil(log.wheels.v_left_mps, log.wheels.v_right_mps)), CONFIG).wheels
    assert any(words in warning for warning in check.warnings)
    assert check.applied == (1.0, 1.0)


@pytest.mark.parametrize(("left", "right"), [(1.02, 0.98), (1.08, 1.03), (0.95, 0.95)])
def test_a_run_stores_the_scales_of_its_sides_and_they_can_be_undone(left: float, right: float) -> None:
    log = make_log(seconds=120.0)
    run = fit(with_wheels(log, left * log.wheels.v_left_mps, right * log.wheels.v_right_mps), CONFIG)
    assert run.wheel_scales == pytest.approx((1 / left, 1 / right), abs=0.008)
    assert run.table.v_left_mps / run.wheel_scales[0] == pytest.approx(left * log.wheels.v_left_mps)
    assert run.table.v_right_mps / run.wheel_scales[1] == pytest.approx(right * log.wheels.v_right_mps)


def test_a_drive_too_straight_to_tell_the_convention_swaps_no_wheels() -> None:
    """Swapped wheels and a heading of the other convention look alike there, under fixes this bad."""
    log, t, fix = make_log(seconds=1.0), np.arange(0.0, 180.0, 0.02), slice(0, None, 5)
    psi = np.radians(4.0) * np.sin(2 * np.pi * t / 20.0)
    ahead = np.gradient(psi, t) * (ICRS[0] - ICRS[1]) / 2
    place = np.cumsum(0.8 * 0.02 * np.exp(1j * psi))[fix]
    stamps = log.wheels.stamp_ns[0] + np.round(t * 1e9).astype(np.int64)
    known = np.ones(len(place))
    for seed in range(12):
        rng = np.random.default_rng(seed)
        north, east = np.stack([place.real, place.imag]) + rng.normal(0.0, 1.0, (2, len(place)))
        told = psi + rng.normal(0.0, 0.01, len(t))
        straight = replace(
            log,
            wheels=WheelSamples(stamps, 0.8 + ahead, 0.8 - ahead),
            gnss=PositionFixes(stamps[fix], north, east, known, known, 0 * known),
            heading=HeadingSamples(stamps, told, np.full(len(t), 1e-4)),
        )
        assert align_streams(straight, CONFIG).wheels.warnings == ()


def test_spins_about_a_point_beside_the_origin_are_no_wheel_that_counts_backwards() -> None:
    """With a side turned round, the origin's small circle would look like driving."""
    icrs, sensors = (0.5, -0.75, -0.25), Sensors(input_noise_mps=0.03)
    truth = drive_plan(DrivePlan(icrs_m=icrs, path=PathPlan("spins", 0.4), duration_s=90.0), 0.01)
    log = readings_log(sense(truth, sensors, 90.0, np.random.default_rng(0)), sensors)
    run = fit(log, CONFIG)
    # The ICRs do lie to one side of the origin; nothing is said of wheels and heading.
    assert all("to the left of the antenna" in warning for warning in run.warnings)
    final = run.summary["icr"]["final"]
    assert [final[name] for name in final] == pytest.approx(icrs, abs=ICR_TOLERANCE_M)


def test_preset_paper_corrects_nothing() -> None:
    log = make_log(seconds=120.0)
    spoilt = with_wheels(log, log.wheels.v_right_mps, log.wheels.v_left_mps)
    check = align_streams(spoilt, load_config(sets=["filter.preset=paper"])).wheels
    assert check.log is spoilt


def test_a_configured_scale_is_not_touched() -> None:
    log = make_log(seconds=120.0)
    spoilt = with_wheels(log, 1.07 * log.wheels.v_left_mps, 1.07 * log.wheels.v_right_mps)
    check = align_streams(spoilt, load_config(sets=["wheels.left_scale=1.0", "wheels.right_scale=1.0"])).wheels
    assert check.applied == (1.0, 1.0)
    assert any("check wheel radius" in warning for warning in check.warnings)
