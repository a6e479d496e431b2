"""A heading from turn rates and positions is the true one, with a standard deviation that holds."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import icrtool
from icrtool.alignment.corrections import align_streams
from icrtool.alignment.drive_windows import drive_arrays
from icrtool.alignment.gyro_heading import TurnRate, estimate_heading
from icrtool.alignment.heading_choice import derive_heading
from icrtool.alignment.wheel_units import with_wheel_speeds
from icrtool.kernels.heading_kalman import HeadingEvents, filter_headings, smooth_headings
from icrtool.records.tables import GyroAxes, HeadingSamples, OtherReceiver, RobotLog
from support.exact_drives import CONFIG, simulate

LARGEST_RMS_DEG = 0.3
WIDTH_M = 0.6
BIAS_RADPS, GYRO_STD_RADPS = 0.004, 0.003
NO_HEADING = HeadingSamples(np.empty(0, np.int64), np.empty(0), np.empty(0))

Truth = tuple[np.ndarray, np.ndarray]


def without_heading(seed: int, axis: int = 2, sign: float = -1.0) -> tuple[RobotLog, Truth]:
    """Return a log with a gyro on one axis of its sensor in place of the heading, and stamps and true heading."""
    log = simulate(seed, lever=(0.0, 0.0), offset_deg=0.0, scales=(1.0, 1.0), seconds=160.0, heading_std_deg=0.0)
    rng = np.random.default_rng(100 + seed)
    psi, stamps = np.unwrap(log.heading.heading_rad), log.heading.stamp_ns
    rate = np.gradient(psi, (stamps - stamps[0]) / 1e9)
    axes = rng.normal(0.0, GYRO_STD_RADPS, (len(rate), 3))
    axes[:, axis] += sign * (rate + BIAS_RADPS)
    return replace(log, heading=NO_HEADING, gyros=(GyroAxes("/imu", stamps, axes),)), (stamps, psi)


def error_deg(samples: HeadingSamples, truth: Truth) -> np.ndarray:
    expected = np.interp(samples.stamp_ns - truth[0][0], truth[0] - truth[0][0], truth[1])
    return np.degrees(np.angle(np.exp(1j * (samples.heading_rad - expected))))


@pytest.mark.parametrize(("axis", "sign"), [(2, -1.0), (2, 1.0), (0, -1.0), (1, 1.0)])
def test_axis_and_sense_of_the_gyro_are_found(axis: int, sign: float) -> None:
    log, truth = without_heading(1, axis, sign)
    found = derive_heading(log, WIDTH_M)
    assert found.source == "gyro"
    assert math.sqrt((error_deg(found.smoothed, truth) ** 2).mean()) < LARGEST_RMS_DEG


def test_the_standard_deviation_covers_the_error_over_many_drives() -> None:
    inside = []
    for seed in range(8):
        log, truth = without_heading(seed)
        found = derive_heading(log, WIDTH_M)
        inside += [
            np.mean(np.abs(error_deg(samples, truth)) < 2.0 * np.degrees(np.sqrt(samples.var_rad2)))
            for samples in (found.smoothed, found.causal)
        ]
    assert np.mean(inside) > 0.85


def test_the_filter_knows_nothing_of_later_events() -> None:
    rng = np.random.default_rng(5)
    events = HeadingEvents(
        np.full(40, 0.5), rng.normal(0, 0.1, 40), rng.normal(0, 1, 40), np.tile([1.0, 0.0, 0.0], (40, 1)),
        np.full(40, 0.01), np.ones(40, np.bool_),
    )  # fmt: skip
    start, spread, walk = np.zeros(3), np.diag([1.0, 0.01, 0.01]), np.array([1e-4, 1e-6, 0.0])
    whole = filter_headings(events, start, spread, walk)
    half = filter_headings(HeadingEvents(*(one[:20] for one in events)), start, spread, walk)
    np.testing.assert_array_equal(whole.x[:20], half.x)
    np.testing.assert_array_equal(whole.P[:20], half.P)


def test_the_smoother_is_the_least_squares_solution_of_all_events() -> None:
    """Without process noise the smoothed state is constant: the weighted normal equations, solved another way."""
    rng = np.random.default_rng(6)
    dt, turn = np.full(30, 0.5), rng.normal(0.0, 0.2, 30)
    since, turned = np.cumsum(dt), np.cumsum(turn)
    truth = np.array([0.3, 0.01, 0.02])
    design = np.column_stack([np.ones(30), -since, turned])
    z = design @ truth + turned + rng.normal(0.0, 0.05, 30)
    events = HeadingEvents(dt, turn, z, np.tile([1.0, 0.0, 0.0], (30, 1)), np.full(30, 0.05**2), np.zeros(30, np.bool_))
    spread = np.diag([1.0, 0.1, 0.1]) ** 2
    states, covariances = smooth_headings(events, filter_headings(events, np.zeros(3), spread, np.zeros(3)))
    information = design.T @ design / 0.05**2 + np.linalg.inv(spread)
    expected = np.linalg.solve(information, design.T @ (z - turned) / 0.05**2)
    assert states[-1, 1:] == pytest.approx(expected[1:], abs=1e-9)
    assert states[-1, 0] == pytest.approx(
        expected[0] - since[-1] * expected[1] + turned[-1] * (1 + expected[2]), abs=1e-9
    )
    assert covariances[0, 1:, 1:] == pytest.approx(np.linalg.inv(information)[1:, 1:], abs=1e-12)


def test_two_antennas_point_wherever_they_are_mounted() -> None:
    log, truth = without_heading(3)
    psi = np.interp(log.gnss.stamp_ns - truth[0][0], truth[0] - truth[0][0], truth[1])
    rng = np.random.default_rng(3)
    away = 0.9 * np.exp(1j * (psi + math.radians(130.0))) + rng.normal(0, 0.01, (2, len(psi))).T @ [1, 1j]
    other = replace(log.gnss, north_m=log.gnss.north_m + away.real, east_m=log.gnss.east_m + away.imag)
    found = derive_heading(replace(log, other_receivers=(OtherReceiver("/rear", other),)), WIDTH_M)
    assert found.source == "antennas"
    assert math.sqrt((error_deg(found.smoothed, truth) ** 2).mean()) < LARGEST_RMS_DEG


def test_a_drive_too_short_for_courses_gives_no_heading() -> None:
    log, _ = without_heading(4)
    drive = drive_arrays(log)
    turn = TurnRate(drive.wheel_t[:50], np.zeros(50))
    assert estimate_heading(drive, turn) is None


@pytest.mark.parametrize("name", ["tracked_gyro.bag", "wheeled_two_antennas"])
def test_physics_logs_without_an_attitude_sensor_give_the_true_heading(shared_logs: Path, name: str) -> None:
    config = icrtool.load_config(robot=ROBOTS[name])
    log = with_wheel_speeds(icrtool.read_log(shared_logs / "simulated" / name, config), config)
    found = derive_heading(log, WIDTH_M)
    with np.load(shared_logs / "simulated" / f"{name}.truth.npz") as truth:
        stamps = log.wheels.stamp_ns[0] + np.round((truth["t"] - truth["t"][0]) * 1e9).astype(np.int64)
        expected = stamps, np.unwrap(truth["heading"])
    assert math.sqrt((error_deg(found.smoothed, expected) ** 2).mean()) < LARGEST_RMS_DEG


ROBOTS = {"tracked_gyro.bag": "pentzer-tracked", "wheeled_two_antennas": "segway-rmp400"}


def test_of_several_units_the_one_that_agrees_with_the_courses_is_used() -> None:
    log, truth = without_heading(2)
    good = log.gyros[0]
    rng = np.random.default_rng(6)
    loose = GyroAxes("/loose", good.stamp_ns, good.rates_radps + rng.normal(0.0, 0.5, good.rates_radps.shape))
    dead = GyroAxes("/dead", good.stamp_ns, np.zeros_like(good.rates_radps))
    found = derive_heading(replace(log, gyros=(dead, loose, good)), WIDTH_M)
    assert found.topic.startswith(good.topic)
    assert math.sqrt((error_deg(found.smoothed, truth) ** 2).mean()) < LARGEST_RMS_DEG


def test_an_orientation_that_drifts_is_used_as_a_turn_rate() -> None:
    """Truth: the heading before a bias of 0.5 deg/s was added to it."""
    log = simulate(3, lever=(0.0, 0.0), offset_deg=0.0, scales=(1.0, 1.0), seconds=160.0, heading_std_deg=0.1)
    psi, stamps = np.unwrap(log.heading.heading_rad), log.heading.stamp_ns
    drifting = psi + math.radians(0.5) * (stamps - stamps[0]) / 1e9
    spoilt = replace(log, heading=replace(log.heading, heading_rad=np.angle(np.exp(1j * drifting))))
    found = align_streams(spoilt, CONFIG)
    assert found.source == "gyro"
    assert found.derived is not None
    assert any("drifts" in warning for warning in found.log.warnings)
    assert math.sqrt((error_deg(found.derived.smoothed, (stamps, psi)) ** 2).mean()) < 1.0
