"""What wheel data get wrong is found, reported, and corrected where it is certain."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.corrections import align_streams
from icrtool.alignment.wheel_alignment import bridge_gaps
from icrtool.config import load_config
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.errors import DataError
from icrtool.pipeline import fit
from icrtool.records.measurements import Fixes
from icrtool.records.notes import warnings_of
from icrtool.records.samples import GyroSamples, HeadingSamples, PositionFixes, WheelSamples
from icrtool.records.tables import RobotLog
from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors, drive_plan, sense_motion
from icrtool.simulation.study_runs import readings_log
from support.drives import ICRS, make_log

CONFIG = load_config(sets=["robot.track_width_m=0.8"])
ICR_TOLERANCE_M = 0.05


NONE = np.empty(0)
NO_FIXES = Fixes(np.empty(0, np.int64), *[NONE] * 4, np.empty(0, np.uint8), *[np.empty(0, np.bool_)] * 2)


def with_wheels(log: RobotLog, left: np.ndarray, right: np.ndarray) -> RobotLog:
    return replace(log, wheels=replace(log.wheels, left=left, right=right))


def test_good_wheels_are_left_as_they_are() -> None:
    log = make_log(seconds=120.0)
    found = align_streams(log, CONFIG)
    assert warnings_of(found.notes) == ()
    assert found.log.wheels is log.wheels
    assert found.wheels.scale == pytest.approx(1.0, abs=0.01)


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
        (
            lambda left, right: (left, np.where(np.arange(len(right)) > 4000, 0.0, right)),
            "right wheels hardly ever move from 80 s",
        ),
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
    check = align_streams(with_wheels(log, *spoil(log.wheels.v_left_mps, log.wheels.v_right_mps)), CONFIG)
    assert any(words in warning for warning in warnings_of(check.notes))
    assert check.scales == (1.0, 1.0)


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
        found = align_streams(straight, CONFIG)
        assert found.scales == (1.0, 1.0)
        assert not [warning for warning in warnings_of(found.notes) if re.search("wheel|side|mirrored", warning)]


def test_spins_about_a_point_beside_the_origin_are_no_wheel_that_counts_backwards() -> None:
    """With a side turned round, the origin's small circle would look like driving."""
    icrs, sensors = (0.5, -0.75, -0.25), Sensors(input_noise_mps=0.03)
    truth = drive_plan(DrivePlan(icrs_m=icrs, path=PathPlan("spins", 0.4), duration_s=90.0), 0.01)
    log = readings_log(sense_motion(truth, sensors, 90.0, np.random.default_rng(0)), sensors)
    run = fit(log, CONFIG)
    # The ICRs do lie to one side of the origin; nothing is said of wheels and heading.
    assert all("to the left of the position sensor" in warning for warning in run.warnings)
    final = run.summary["icr"]["final"]
    assert [final[name] for name in final] == pytest.approx(icrs, abs=ICR_TOLERANCE_M)


def test_preset_paper_corrects_nothing() -> None:
    log = make_log(seconds=120.0)
    spoilt = with_wheels(log, log.wheels.v_right_mps, log.wheels.v_left_mps)
    assert align_streams(spoilt, load_config(sets=["filter.preset=paper"])).log is spoilt


def test_a_configured_scale_is_not_touched() -> None:
    log = make_log(seconds=120.0)
    spoilt = with_wheels(log, 1.07 * log.wheels.v_left_mps, 1.07 * log.wheels.v_right_mps)
    check = align_streams(spoilt, load_config(sets=["wheels.left_scale=1.0", "wheels.right_scale=1.0"]))
    assert check.scales == (1.0, 1.0)
    assert any("check wheel radius" in warning for warning in warnings_of(check.notes))


def with_gaps(log: RobotLog, *, every_s: float, gap_s: float, from_position: bool) -> RobotLog:
    """Leave out wheel samples; what remains holds the mean speed to the next sample, as counts give it."""
    t = (log.wheels.stamp_ns - log.wheels.stamp_ns[0]) / 1e9
    kept = np.flatnonzero(np.mod(t + gap_s, every_s) >= gap_s)
    sides = []
    for speed in (log.wheels.v_left_mps, log.wheels.v_right_mps):
        travelled = np.concatenate([[0.0], np.cumsum(speed[:-1] * np.diff(t))])
        sides.append(np.append(np.diff(travelled[kept]) / np.diff(t[kept]), speed[-1]))
    return replace(log, wheels=WheelSamples(log.wheels.stamp_ns[kept], *sides, from_position=from_position))


def test_gaps_of_wheels_that_report_positions_are_bridged() -> None:
    log = make_log(seconds=180.0, rate=20.0)
    whole = fit(log, CONFIG)
    runs = [fit(with_gaps(log, every_s=8.0, gap_s=2.0, from_position=kind), CONFIG) for kind in (True, False)]
    counted, open_ = runs
    assert not counted.in_gap.any()
    assert np.count_nonzero(open_.in_gap) == len(open_.summary["wheel_gaps_ns"]) > 20
    assert any("are bridged" in warning for warning in warnings_of(counted.notes))
    assert not any("are bridged" in warning for warning in warnings_of(open_.notes))
    distance = whole.summary["drive"]["distance_m"]
    assert counted.summary["drive"]["distance_m"] == pytest.approx(distance, rel=0.01)
    assert counted.table.distance_m[-1] == pytest.approx(whole.table.distance_m[-1], rel=0.01)
    final = counted.summary["icr"]["final"]
    assert (final["y_icr_right_m"], final["y_icr_left_m"]) == pytest.approx(ICRS[:2], abs=ICR_TOLERANCE_M)
    trials, missing, full = (
        dropout_report(run, horizons_m=[20.0], ladder=False).summary for run in (counted, open_, whole)
    )

    def count(summary):  # type: ignore[no-untyped-def]
        return int(summary.set_index(["model", "horizon_m"]).loc[("icr", 20.0), "trials"])

    assert count(missing) == 0 or count(missing) < 0.2 * count(full)
    assert count(trials) > 0.9 * count(full)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_wheel_samples_have_nothing_to_bridge(count: int) -> None:
    stamps = np.arange(count, dtype=np.int64) * 100_000_000
    wheels = WheelSamples(stamps, np.ones(count), np.ones(count), from_position=True)
    assert bridge_gaps(wheels, 0.5, NO_FIXES) == (wheels, None)


def test_a_gap_of_more_than_five_seconds_stays_a_gap() -> None:
    stamps = np.concatenate([np.arange(50), np.arange(200, 250)]).astype(np.int64) * 100_000_000
    wheels = WheelSamples(stamps, np.ones(100), np.ones(100), from_position=True)
    assert bridge_gaps(wheels, 0.5, NO_FIXES)[0] is wheels
    short = replace(wheels, stamp_ns=np.where(stamps > 10**10, stamps - 12 * 10**9, stamps))
    filled, note = bridge_gaps(short, 0.5, NO_FIXES)
    assert np.diff(filled.stamp_ns).tolist() == [100_000_000] * (len(filled.stamp_ns) - 1)
    assert note is not None
    assert note.text.startswith("1 gaps")


def test_a_robot_on_a_stand_is_refused() -> None:
    log, rng = make_log(seconds=120.0), np.random.default_rng(0)
    count = len(log.gnss.north_m)
    gnss = replace(log.gnss, north_m=rng.normal(3.0, 0.01, count), east_m=rng.normal(-2.0, 0.01, count))
    heading = replace(log.heading, heading_rad=rng.normal(0.4, 0.01, len(log.heading.heading_rad)))
    with pytest.raises(DataError, match="the robot does not move"):
        fit(replace(log, gnss=gnss, heading=heading), CONFIG)


@pytest.mark.parametrize(
    ("message_type", "share", "warned"),
    [("nav_msgs/Odometry", 1.0, True), ("nav_msgs/Odometry", 0.9, False), ("sensor_msgs/JointState", 1.0, False)],
)
def test_fused_odometry_offered_as_wheels_is_reported(message_type: str, share: float, warned: bool) -> None:
    """A turn rate of the wheels that is the gyro's was not measured by wheels."""
    log, rng = make_log(seconds=120.0), np.random.default_rng(0)
    speed = (log.wheels.v_left_mps + log.wheels.v_right_mps) / 2
    rate = np.gradient(np.unwrap(log.heading.heading_rad), 0.02)
    rate = np.convolve(rate, np.ones(50) / 50, "same") + rng.normal(0.0, 0.002, len(rate))
    turn = share * rate + (1.0 - share) * rng.normal(0.0, 0.3, len(rate))
    streams = tuple(replace(stream, message_type=message_type) for stream in log.streams)
    gyro = GyroSamples("/imu", log.wheels.stamp_ns, rate)
    fused = replace(with_wheels(log, speed + 0.4 * turn, speed - 0.4 * turn), streams=streams, gyro=gyro)
    warnings = warnings_of(align_streams(fused, CONFIG).notes)
    assert any("it is fused" in warning and "topics.wheels" in warning for warning in warnings) == warned


@pytest.mark.parametrize(("slip", "noise_radps"), [(1.01, 0.0), (1.01, 0.002), (1.0, 0.002), (0.99, 0.0)])
def test_wheels_that_slip_a_little_are_not_called_fused(slip: float, noise_radps: float) -> None:
    """Their turns correlate with a good gyro by more than 0.9995, but are not 1 of it, or lack its noise."""
    log, rng = make_log(seconds=120.0, heading_std_deg=0.0), np.random.default_rng(0)
    speed = (log.wheels.v_left_mps + log.wheels.v_right_mps) / 2
    rate = np.gradient(np.unwrap(log.heading.heading_rad), 0.02)
    streams = tuple(replace(stream, message_type="nav_msgs/Odometry") for stream in log.streams)
    gyro = GyroSamples("/imu", log.wheels.stamp_ns, rate + rng.normal(0.0, noise_radps, len(rate)))
    width = CONFIG.robot.track_width_m
    assert width is not None
    sides = (speed + sign * slip * rate * width / 2 for sign in (1, -1))
    slipping = replace(with_wheels(log, *sides), streams=streams, gyro=gyro)
    assert not [one for one in align_streams(slipping, CONFIG).notes if one.code == "wheels_fused"]


def test_the_diameter_for_the_radius_is_corrected_on_wheels_that_roll_at_less_than_their_radius_too() -> None:
    log = make_log(seconds=120.0)
    left, right = (2.0 / 0.955 * speed for speed in (log.wheels.left, log.wheels.right))
    found = align_streams(with_wheels(log, left, right), CONFIG)
    assert found.wheels.applied_scale == pytest.approx(0.955 / 2.0, rel=0.01)


def test_a_scale_that_nothing_explains_makes_the_run_unusable() -> None:
    log = make_log(seconds=120.0)
    run = fit(with_wheels(log, 1.4 * log.wheels.left, 1.4 * log.wheels.right), CONFIG)
    assert not run.usable
    assert "71 % of the distance" in run.summary["unusable_because"]
