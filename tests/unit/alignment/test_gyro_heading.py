"""A heading from turn rates and positions is the true one, with a standard deviation that holds."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import icrtool
from icrtool.alignment.corrections import align_streams
from icrtool.alignment.gyro_heading import estimate_heading
from icrtool.alignment.heading_choice import DerivedHeading, derive_heading, fuse_heading
from icrtool.alignment.log_track import track_of_log
from icrtool.alignment.turn_rates import TurnRate
from icrtool.alignment.wheel_units import with_wheel_speeds
from icrtool.pipeline import fit
from icrtool.records.samples import NO_HEADINGS, GyroAxes, HeadingSamples, OtherReceiver
from icrtool.records.tables import RobotLog
from support.exact_drives import CONFIG, simulate
from support.recordings import first_order

LARGEST_RMS_DEG = 0.3
FIRST_S = 10.0
WIDTH_M = 0.6
BIAS_RADPS, GYRO_STD_RADPS = 0.004, 0.003

Truth = tuple[np.ndarray, np.ndarray]


def without_heading(seed: int, axis: int = 2, sign: float = -1.0) -> tuple[RobotLog, Truth]:
    """Return a log with a gyro on one axis of its sensor in place of the heading, and stamps and true heading."""
    log = simulate(seed, lever=(0.0, 0.0), offset_deg=0.0, scales=(1.0, 1.0), seconds=160.0, heading_std_deg=0.0)
    rng = np.random.default_rng(100 + seed)
    psi, stamps = np.unwrap(log.heading.heading_rad), log.heading.stamp_ns
    rate = np.gradient(psi, (stamps - stamps[0]) / 1e9)
    axes = rng.normal(0.0, GYRO_STD_RADPS, (len(rate), 3))
    axes[:, axis] += sign * (rate + BIAS_RADPS)
    return replace(log, heading=NO_HEADINGS, gyros=(GyroAxes("/imu", stamps, axes),)), (stamps, psi)


def error_deg(samples: HeadingSamples, truth: Truth) -> np.ndarray:
    """Return the errors (n,), those of the first seconds as 0: the heading is found while the robot drives."""
    expected = np.interp(samples.stamp_ns - truth[0][0], truth[0] - truth[0][0], truth[1])
    error = np.degrees(np.angle(np.exp(1j * (samples.heading_rad - expected))))
    return np.where(samples.stamp_ns - truth[0][0] < FIRST_S * 1e9, 0.0, error)


@pytest.mark.parametrize(("axis", "sign"), [(2, -1.0), (2, 1.0), (0, -1.0), (1, 1.0)])
def test_axis_and_sense_of_the_gyro_are_found(axis: int, sign: float) -> None:
    log, truth = without_heading(1, axis, sign)
    found = derive_heading(log, WIDTH_M)
    assert found.source == "gyro_course"
    assert math.sqrt((error_deg(found.smoothed, truth) ** 2).mean()) < LARGEST_RMS_DEG


@pytest.mark.parametrize(("axis", "sign", "name"), [(0, -1.0, "x up"), (1, 1.0, "y down"), (2, -1.0, "")])
@pytest.mark.parametrize("seed", [2, 3])
def test_a_gyro_on_its_side_is_found_beside_fixes_that_wander(axis: int, sign: float, name: str, seed: int) -> None:
    """A receiver without corrections: the error of 0.8 m lasts for a minute, and the courses show no axis."""
    log, truth = without_heading(seed, axis, sign)
    rng, fixes = np.random.default_rng(300 + seed), log.gnss
    kept = math.exp(-float(np.median(np.diff(fixes.stamp_ns))) / 60e9)
    push = rng.normal(0.0, 0.8 * math.sqrt(1.0 - kept**2), (2, len(fixes.stamp_ns)))
    push[:, 0] = rng.normal(0.0, 0.8, 2)
    north, east = np.array([first_order(kept, one) for one in push]) + rng.normal(0.0, 0.1, push.shape)
    variance = np.ones(len(fixes.stamp_ns))
    wandering = replace(
        fixes, north_m=fixes.north_m + north, east_m=fixes.east_m + east, var_north_m2=variance, var_east_m2=variance
    )
    found = derive_heading(replace(log, gnss=wandering), WIDTH_M)
    assert found.source == "gyro_course"
    assert found.topic.startswith(f"/imu ({name})" if name else "/imu +")
    smoothed, std = error_deg(found.smoothed, truth), np.degrees(np.sqrt(found.smoothed.var_rad2))
    assert math.sqrt((smoothed**2).mean()) < 3.0 * float(np.median(std))
    assert float(np.median(std)) < 4.0


def with_attitude(log: RobotLog, truth: Truth, seed: int, offset_deg: float = 0.0, lag_s: float = 0.0) -> RobotLog:
    """Return the log with an attitude sensor as well: slow error (0.85 deg, 30 s) and white noise (0.5 deg)."""
    rng, (stamps, psi) = np.random.default_rng(200 + seed), truth
    t = (stamps - stamps[0]) / 1e9
    kept = math.exp(-0.01 / 30.0)
    push = rng.normal(0.0, 0.85 * math.sqrt(1.0 - kept**2), len(psi))
    push[0] = rng.normal(0.0, 0.85)
    error = np.radians(first_order(kept, push) + rng.normal(0.0, 0.5, len(psi)) + offset_deg)
    heading = np.interp(t - lag_s, t, psi) + error
    samples = HeadingSamples(stamps, np.angle(np.exp(1j * heading)), np.full(len(psi), math.radians(1.0) ** 2))
    return replace(log, heading=samples)


def fused(log: RobotLog) -> DerivedHeading:
    found = fuse_heading(log, track_of_log(log))
    assert found is not None
    return found


def rms_deg(samples: HeadingSamples, truth: Truth) -> float:
    return math.sqrt((error_deg(samples, truth) ** 2).mean())


def coverage(samples: HeadingSamples, truth: Truth) -> float:
    return float(np.mean(np.abs(error_deg(samples, truth)) < 2.0 * np.degrees(np.sqrt(samples.var_rad2))))


def test_the_standard_deviation_covers_the_error_over_many_drives() -> None:
    inside, square = [], []
    for seed in range(10):
        log, truth = without_heading(seed)
        found = derive_heading(log, WIDTH_M)
        for samples in (found.smoothed, found.causal):
            inside.append(coverage(samples, truth))
            square.append((np.radians(error_deg(samples, truth)) ** 2 / samples.var_rad2).mean())
    assert 0.90 < np.mean(inside) <= 0.995
    assert 0.5 < np.mean(square) < 1.5


def with_second_antenna(log: RobotLog, truth: Truth, seed: int) -> RobotLog:
    """Return the log with another antenna 0.9 m away, of 1 cm."""
    gnss, rng = log.gnss, np.random.default_rng(seed)
    psi = np.interp(gnss.stamp_ns - truth[0][0], truth[0] - truth[0][0], truth[1])
    away = 0.9 * np.exp(1j * (psi + math.radians(130.0))) + rng.normal(0, 0.01, (2, len(psi))).T @ [1, 1j]
    other = replace(gnss, north_m=gnss.north_m + away.real, east_m=gnss.east_m + away.imag)
    return replace(log, other_receivers=(OtherReceiver("/rear", other),))


def test_the_antenna_that_gives_the_heading_is_the_one_that_is_named() -> None:
    log, truth = without_heading(3)
    far = with_second_antenna(log, truth, 3)
    [rear] = far.other_receivers
    beside = OtherReceiver("/beside", replace(log.gnss, north_m=log.gnss.north_m + 0.01))
    found = derive_heading(replace(far, other_receivers=(beside, rear)), WIDTH_M)
    assert found.source == "antenna_pair"
    assert found.topic.startswith("/rear + ")


def with_mean_rates(log: RobotLog, truth: Truth, seed: int) -> RobotLog:
    """Return the log with a gyro that gives means over the interval before its stamps, or after them."""
    gyro, (stamps, psi) = log.gyros[0], truth
    turned = np.diff(psi) / (np.diff(stamps) / 1e9)
    means = np.concatenate([turned[:1], turned] if seed % 2 else [turned, turned[-1:]])
    rates = gyro.rates_radps.copy()
    rates[:, 2] += np.gradient(psi, (stamps - stamps[0]) / 1e9) - means
    return replace(log, gyros=(replace(gyro, rates_radps=rates),))


@pytest.mark.parametrize("source", ["gyro_course", "fused", "antenna_pair"])
def test_the_stated_deviation_is_that_of_the_heading_that_the_filter_is_given(source: str) -> None:
    square, stated = [], []
    for seed in range(8):
        log, truth = without_heading(seed)
        log = with_mean_rates(log, truth, seed)
        if source == "fused":
            log = with_attitude(log, truth, seed)
        elif source == "antenna_pair":
            log = with_second_antenna(log, truth, seed)
        found = align_streams(log, CONFIG)
        assert found.heading.source == source
        later = found.log.heading.stamp_ns - truth[0][0] >= FIRST_S * 1e9
        square.append((error_deg(found.log.heading, truth)[later] ** 2).mean())
        assert found.heading.std_deg is not None
        stated.append(found.heading.std_deg**2)
    assert 0.8 < math.sqrt(np.mean(square) / np.mean(stated)) < 1.25


def test_the_stated_deviation_is_no_worse_for_a_robot_that_stands_at_first() -> None:
    """Until it drives, no direction is known: neither is any trial begun there."""
    log, _ = without_heading(1)
    found = derive_heading(log, WIDTH_M).estimate
    unknown = np.full(2 * len(found.t), math.pi)
    stood = replace(found, causal_std=np.concatenate([unknown, found.causal_std]))
    assert stood.median_causal_std == pytest.approx(found.median_causal_std, rel=0.02)


@pytest.mark.parametrize(("offset_deg", "lag_s"), [(0.0, 0.0), (12.0, 0.0), (0.0, 0.1)])
def test_the_fused_heading_is_better_than_the_attitude_sensor(offset_deg: float, lag_s: float) -> None:
    inside = []
    for seed in range(4):
        log, truth = without_heading(seed)
        log = with_attitude(log, truth, seed, offset_deg, lag_s)
        alone = error_deg(log.heading, truth)
        found = fused(log)
        assert found.source == "fused"
        for samples in (found.smoothed, found.causal):
            assert rms_deg(samples, truth) < min(LARGEST_RMS_DEG, 0.6 * float(alone.std()))
            inside.append(coverage(samples, truth))
    assert np.mean(inside) > 0.90


def test_an_attitude_sensor_helps_where_positions_say_little() -> None:
    for seed in range(2):
        log, truth = without_heading(seed)
        gnss, rng = log.gnss, np.random.default_rng(seed)
        noisy = (rng.normal(0.0, 0.3, len(gnss.stamp_ns)) for _ in range(2))
        metres = replace(gnss, north_m=gnss.north_m + next(noisy), east_m=gnss.east_m + next(noisy))
        log = replace(
            log, gnss=replace(metres, var_north_m2=gnss.var_north_m2 + 0.09, var_east_m2=gnss.var_east_m2 + 0.09)
        )
        without = rms_deg(derive_heading(log, WIDTH_M).causal, truth)
        log = with_attitude(log, truth, seed)
        found = fused(log)
        assert rms_deg(found.causal, truth) < min(without, 1.1 * float(error_deg(log.heading, truth).std()))


def test_a_hole_of_a_second_in_the_gyro_is_bridged() -> None:
    log, truth = without_heading(1)
    gyro = log.gyros[0]
    t = (gyro.stamp_ns - gyro.stamp_ns[0]) / 1e9
    kept = ~(((t % 20.0) > 10.0) & ((t % 20.0) < 11.0))
    holed = GyroAxes(gyro.topic, gyro.stamp_ns[kept], gyro.rates_radps[kept])
    found = derive_heading(replace(log, gyros=(holed,)), WIDTH_M)
    assert found.source == "gyro_course"
    assert rms_deg(found.smoothed, truth) < 1.0
    assert coverage(found.causal, truth) > 0.85


def test_a_gyro_that_is_mounted_at_an_angle_is_turned_to_the_vertical() -> None:
    log, truth = without_heading(2)
    gyro = log.gyros[0]
    c, s = math.cos(math.radians(35.0)), math.sin(math.radians(35.0))
    tilted = gyro.rates_radps @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    found = derive_heading(replace(log, gyros=(GyroAxes("/imu", gyro.stamp_ns, tilted),)), WIDTH_M)
    assert "tilted" in found.topic
    assert rms_deg(found.smoothed, truth) < LARGEST_RMS_DEG


def test_few_noisy_fixes_and_a_wandering_bias_still_give_a_heading() -> None:
    """5 Hz positions of 3.5 cm, a bias that walks by 0.1 deg/s in each root of a second."""
    errors = []
    for seed in range(3):
        log, truth = without_heading(seed)
        rng = np.random.default_rng(300 + seed)
        gyro, some = log.gyros[0], slice(0, None, 4)
        bias = np.cumsum(rng.normal(0.0, math.radians(0.1) * 0.1, len(gyro.stamp_ns)))
        rates = gyro.rates_radps - bias[:, None] * [0.0, 0.0, 1.0]
        gnss = log.gnss.cut(some)
        n = len(gnss.stamp_ns)
        gnss = replace(
            gnss, north_m=gnss.north_m + rng.normal(0.0, 0.034, n), east_m=gnss.east_m + rng.normal(0.0, 0.034, n),
            var_north_m2=np.full(n, 0.035**2), var_east_m2=np.full(n, 0.035**2),
        )  # fmt: skip
        found = derive_heading(replace(log, gnss=gnss, gyros=(GyroAxes("/imu", gyro.stamp_ns, rates),)), WIDTH_M)
        errors.append(np.abs(error_deg(found.smoothed, truth)))
    together = np.concatenate(errors)
    assert np.median(together) < 1.0
    assert np.percentile(together, 95) < 3.5


def test_two_antennas_point_wherever_they_are_mounted() -> None:
    log, truth = without_heading(3)
    found = derive_heading(with_second_antenna(log, truth, 3), WIDTH_M)
    assert found.source == "antenna_pair"
    assert math.sqrt((error_deg(found.smoothed, truth) ** 2).mean()) < LARGEST_RMS_DEG


def test_a_drive_too_short_for_courses_gives_no_heading() -> None:
    log, _ = without_heading(4)
    track = track_of_log(log)
    turn = TurnRate(track.t[:50], np.zeros(50))
    assert estimate_heading(track, turn) is None


@pytest.mark.parametrize("name", ["tracked_gyro.bag", "wheeled_two_antennas"])
def test_physics_logs_without_an_attitude_sensor_give_the_true_heading(shared_logs: Path, name: str) -> None:
    config = icrtool.load_config(robot=ROBOTS[name])
    log = with_wheel_speeds(icrtool.read_log(shared_logs / "simulated" / name, config), config)
    found = derive_heading(log, WIDTH_M)
    with np.load(shared_logs / "simulated" / f"{name}.truth.npz") as truth:
        stamps = log.wheels.stamp_ns[0] + np.round((truth["t"] - truth["t"][0]) * 1e9).astype(np.int64)
        expected = stamps, np.unwrap(truth["heading"])
    assert math.sqrt((error_deg(found.smoothed, expected) ** 2).mean()) < LARGEST_RMS_DEG
    # and so do the states, in turns too
    table = fit(log, config).table
    states = HeadingSamples(table.stamp_ns, table.heading_rad, table.std_heading_rad**2)
    assert math.sqrt((error_deg(states, expected) ** 2).mean()) < LARGEST_RMS_DEG
    assert coverage(states, expected) > 0.9


def test_noise_of_the_fixes_is_no_drift_of_the_heading() -> None:
    log, truth = without_heading(1)
    rng = np.random.default_rng(3)
    north, east = (one + rng.normal(0.0, 1.0, len(one)) for one in (log.gnss.north_m, log.gnss.east_m))
    log = with_attitude(replace(log, gnss=replace(log.gnss, north_m=north, east_m=east)), truth, 1)
    found = align_streams(log, CONFIG)
    assert found.heading.source in ("orientation", "fused")
    assert not any("drifts" in warning for warning in found.log.warnings)


def test_a_slow_robot_with_positions_of_a_metre_gets_a_heading() -> None:
    """The log of a robot at a quarter of the speed: a course of 6 m takes half a minute."""
    log, truth = without_heading(4)
    epoch, times = log.wheels.stamp_ns[0], 4

    def slower(stamps: np.ndarray) -> np.ndarray:
        return np.asarray(epoch + times * (stamps - epoch))

    rng, gnss, wheels, gyro = np.random.default_rng(5), log.gnss, log.wheels, log.gyros[0]
    north, east = (one + rng.normal(0.0, 1.0, len(one)) for one in (gnss.north_m, gnss.east_m))
    slow = replace(
        log,
        wheels=replace(wheels, stamp_ns=slower(wheels.stamp_ns), left=wheels.left / times, right=wheels.right / times),
        gnss=replace(gnss, stamp_ns=slower(gnss.stamp_ns), north_m=north, east_m=east),
        gyros=(replace(gyro, stamp_ns=slower(gyro.stamp_ns), rates_radps=gyro.rates_radps / times),),
    )
    found = derive_heading(slow, WIDTH_M)
    assert found.source == "gyro_course"
    assert coverage(found.causal, (slower(truth[0]), truth[1])) > 0.9


def test_a_gyro_that_shows_no_turn_gives_way_to_the_wheels() -> None:
    log, truth = without_heading(2)
    dead = replace(log.gyros[0], rates_radps=np.zeros_like(log.gyros[0].rates_radps))
    found = derive_heading(replace(log, gyros=(dead,)), WIDTH_M)
    assert found.source == "wheels_course"
    assert coverage(found.causal, truth) > 0.9


def test_a_gyro_that_shows_no_turn_is_not_fused_with_a_poor_compass() -> None:
    """Its means over a second would lag the robot by half a second."""
    log, truth = without_heading(3)
    dead = replace(log.gyros[0], rates_radps=np.zeros_like(log.gyros[0].rates_radps))
    hard_iron = truth[1] + math.radians(14.0) * np.sin(truth[1])
    samples = HeadingSamples(truth[0], np.angle(np.exp(1j * hard_iron)), np.full(len(hard_iron), 3e-4))
    compass = replace(log, heading=samples, gyros=(dead,))
    assert fuse_heading(compass, track_of_log(compass)) is None


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
    assert found.heading.source == "gyro_course"
    assert found.derived is not None
    assert any("drifts" in warning for warning in found.log.warnings)
    assert math.sqrt((error_deg(found.derived.smoothed, (stamps, psi)) ** 2).mean()) < 1.0
