"""Simulated drives: paths, sensors, stamps and truth, against what they are defined to be."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import get_args

import numpy as np
import pytest

from icrtool.cli.simulate import study_command
from icrtool.errors import ConfigError
from icrtool.kernels.kinematics import body_velocity
from icrtool.records.choices import PathKind, StudyName
from icrtool.simulation.drives import (
    DATUM,
    START_NS,
    DrivePlan,
    PathPlan,
    Sensors,
    TrackSpeeds,
    check_drive,
    drive_plan,
    plan_body,
    record_drive,
    sample_times,
    sense_motion,
    simulate,
    track_speeds,
)

ROUNDING = 1e-9
"""Sums of some ten thousand doubles of order 1 [m]."""
NOISE_SHARE = 0.05
"""A standard deviation from 2000 samples is known to 1.6 %; three of those."""

QUIET = Sensors(wheels="ideal", gnss_std_m=0.0, heading_std_rad=0.0, heading_resolution_rad=0.0)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize("kind", get_args(PathKind))
def test_track_speeds_give_the_body_what_the_path_asks(kind) -> None:
    t = np.linspace(0, 60, 500)
    icrs = (0.5, -0.75, -0.25)
    forward, turn = plan_body(PathPlan(kind), t, icrs)
    left, right = track_speeds(forward, turn, icrs)
    for k in range(0, 500, 50):
        v_x, _, omega = body_velocity(left[k], right[k], *icrs)
        assert (v_x, omega) == pytest.approx((forward[k], turn[k]), abs=ROUNDING)


@pytest.mark.parametrize("kind", ["circle", "figure-eight"])
def test_a_circle_is_driven_at_the_radius_asked_for(kind) -> None:
    truth = drive_plan(
        DrivePlan(path=PathPlan(kind, radius_m=2.0), icrs_m=(0.4, -0.4, 0.0), start_heading_rad=0.0), 0.0
    )
    first = truth.t_s < 2 * math.pi * 2.0 / 0.4
    assert np.ptp(truth.pose[first, 0]) == pytest.approx(4.0, abs=1e-3)
    assert truth.pose[first, 1].min() == pytest.approx(0.0, abs=ROUNDING)


def test_a_lawnmower_comes_back_beside_its_first_leg() -> None:
    path = PathPlan("lawnmower", speed_mps=1.0, radius_m=1.0, leg_m=10.0)
    truth = drive_plan(
        DrivePlan(path=path, icrs_m=(0.4, -0.4, 0.0), start_heading_rad=0.0, duration_s=20 + math.pi), 0.0
    )
    end = truth.poses(np.array([20.0 + math.pi]))[0]
    # One held step of 1 ms at a corner of the plan turns the second leg by half a milliradian.
    np.testing.assert_allclose(end, [0.0, 2.0, math.pi], atol=0.01)


def test_spins_turn_whole_turns_to_either_side_on_the_spot() -> None:
    truth = drive_plan(DrivePlan(path=PathPlan("spins"), icrs_m=(0.5, -0.75, 0.0)), 0.0)
    assert np.abs(truth.pose[:, :2]).max() < ROUNDING
    assert np.ptp(truth.pose[:, 2]) == pytest.approx(2 * math.pi, abs=0.01)
    assert np.abs(truth.v_left_mps).max() == pytest.approx(0.4)


def test_the_truth_keeps_its_books() -> None:
    truth = drive_plan(DrivePlan(changes=((30.0, (0.6, -0.6, 0.0)),)), 0.01)
    np.testing.assert_allclose(np.diff(truth.travel_left_m), truth.v_left_mps[:-1] * np.diff(truth.t_s), atol=ROUNDING)
    turn = (truth.v_left_mps - truth.v_right_mps) / np.where(truth.t_s < 30.0, 1.25, 1.2)
    np.testing.assert_allclose(np.diff(truth.pose[:, 2]), turn[:-1] * np.diff(truth.t_s), atol=ROUNDING)


def test_icrs_change_at_their_time_to_the_nanosecond() -> None:
    change = 10.0003
    truth = drive_plan(DrivePlan(changes=((change, (0.6, -0.6, 0.0)),)), 0.0)
    row = int(np.searchsorted(truth.t_s, change))
    assert truth.t_s[row] == change
    assert truth.icr_row[row - 1] == 0
    assert truth.icr_row[row] == 1


def test_given_track_speeds_are_driven_as_they_are() -> None:
    speeds = TrackSpeeds(np.array([0.0, 1.5, 3.2]), np.array([0.5, 0.2, 0.0]), np.array([0.1, 0.2, 0.3]))
    truth = drive_plan(DrivePlan(path=speeds, duration_s=4.0), 0.1)
    assert truth.travel_left_m[np.searchsorted(truth.t_s, 3.2)] == pytest.approx(0.5 * 1.5 + 0.2 * 1.7, abs=ROUNDING)
    assert truth.v_right_mps[np.searchsorted(truth.t_s, 4.0)] == 0.3


def test_the_same_seed_gives_the_same_numbers_and_another_does_not() -> None:
    one, again, other = (asdict(simulate(DrivePlan(duration_s=5.0), Sensors(), seed)[0]) for seed in (1, 1, 2))
    for name, values in one.items():
        np.testing.assert_array_equal(values, again[name])
    assert not np.array_equal(one["heading_rad"], other["heading_rad"])


def test_sensors_without_error_tell_the_truth() -> None:
    plan = DrivePlan(duration_s=20.0)
    truth = drive_plan(plan, 0.01)
    seen = sense_motion(truth, QUIET, 20.0, rng())
    np.testing.assert_array_equal(seen.gnss_m, truth.poses(seen.gnss_t)[:, :2])
    np.testing.assert_array_equal(seen.heading_rad, truth.poses(seen.heading_t)[:, 2])
    np.testing.assert_allclose(
        seen.travel_left_m, np.interp(seen.wheel_t, truth.t_s, truth.travel_left_m), atol=ROUNDING
    )
    assert len(seen.wheel_t) == 2000
    assert len(seen.gnss_t) == 400


def test_noise_has_the_size_that_was_asked_for() -> None:
    plan = DrivePlan(duration_s=100.0)
    truth = drive_plan(plan, 0.01)
    sensors = replace(QUIET, gnss_std_m=0.3, heading_std_rad=0.05, input_noise_mps=0.1, input_bias_mps=0.02)
    seen, clean = sense_motion(truth, sensors, 100.0, rng()), sense_motion(truth, QUIET, 100.0, rng())
    assert (seen.gnss_m - clean.gnss_m).std() == pytest.approx(0.3, rel=NOISE_SHARE)
    assert (seen.heading_rad - clean.heading_rad).std() == pytest.approx(0.05, rel=NOISE_SHARE)
    off = seen.v_left_mps - clean.v_left_mps
    assert off.std() == pytest.approx(0.1, rel=NOISE_SHARE)
    assert off.mean() == pytest.approx(0.02, abs=0.004)
    np.testing.assert_allclose(np.diff(seen.travel_left_m) * 100, seen.v_left_mps[:-1], atol=1e-6)


def test_encoders_count_whole_counts_and_lose_none() -> None:
    sensors = Sensors(metres_per_count=0.001, heading_resolution_rad=math.radians(0.05))
    truth = drive_plan(DrivePlan(duration_s=20.0), 0.01)
    seen = sense_motion(truth, sensors, 20.0, rng())
    counts = seen.travel_left_m / 0.001
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    assert 0 <= truth.travel_left_m[np.searchsorted(truth.t_s, seen.wheel_t[-1])] - seen.travel_left_m[-1] < 0.001
    steps = seen.heading_rad / math.radians(0.05)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)


def test_commands_are_held_and_the_tracks_lag_behind_them() -> None:
    plan = DrivePlan(path=PathPlan("curved"), command_rate_hz=10.0, motor_lag_s=0.1, duration_s=20.0)
    truth = drive_plan(plan, 0.1)
    for step in range(5):
        held = (truth.t_s >= step / 10) & (truth.t_s < (step + 1) / 10 - 1e-9)
        assert len(np.unique(truth.command_left_mps[held])) == 1
    seen = sense_motion(truth, replace(QUIET, wheels="commanded", wheel_rate_hz=10.0), 20.0, rng())
    np.testing.assert_array_equal(seen.v_left_mps, truth.command_left_mps[truth.rows(seen.wheel_t)])
    assert np.abs(truth.v_left_mps - truth.command_left_mps).max() > 1e-3


def test_an_outage_takes_its_fixes_away_and_touches_no_other() -> None:
    truth = drive_plan(DrivePlan(duration_s=20.0), 0.01)
    whole = sense_motion(truth, Sensors(), 20.0, rng())
    holed = sense_motion(truth, Sensors(outages_s=((5.0, 8.0),)), 20.0, rng())
    kept = (whole.gnss_t < 5.0) | (whole.gnss_t >= 8.0)
    np.testing.assert_array_equal(holed.gnss_m, whole.gnss_m[kept])
    np.testing.assert_array_equal(holed.heading_rad, whole.heading_rad)


def test_the_antenna_stands_where_it_was_put() -> None:
    truth = drive_plan(DrivePlan(duration_s=5.0, start_heading_rad=math.pi / 2), 0.01)
    seen = sense_motion(truth, replace(QUIET, antenna_forward_m=0.3, antenna_right_m=0.1), 5.0, rng())
    np.testing.assert_allclose(seen.gnss_m[0], [-0.1, 0.3], atol=ROUNDING)


def test_delays_move_stamps_and_nothing_else() -> None:
    plan = DrivePlan(duration_s=5.0)
    late, _ = simulate(plan, Sensors(gnss_delay_s=0.1, heading_delay_s=-0.05), 0)
    prompt, _ = simulate(plan, Sensors(), 0)
    assert set(late.gnss_stamp_ns - prompt.gnss_stamp_ns) == {100_000_000}
    assert set(late.heading_stamp_ns - prompt.heading_stamp_ns) == {-50_000_000}
    np.testing.assert_array_equal(late.latitude_deg, prompt.latitude_deg)


def test_fixes_stand_on_the_globe_about_the_datum() -> None:
    from pymap3d import geodetic2ned

    truth = drive_plan(DrivePlan(duration_s=50.0), 0.01)
    seen = sense_motion(truth, QUIET, 50.0, rng())
    told = record_drive(seen, QUIET, rng())
    north, east, _ = geodetic2ned(told.latitude_deg, told.longitude_deg, told.height_m, *DATUM)
    np.testing.assert_allclose(np.column_stack([north, east]), seen.gnss_m, atol=1e-6)
    assert told.wheel_stamp_ns[0] == START_NS


@pytest.mark.parametrize(("std", "status"), [(0.01, 2), (0.3, 1), (2.0, 0)])
def test_a_fix_is_called_what_a_receiver_of_its_noise_would_call_it(std: float, status: int) -> None:
    told, _ = simulate(DrivePlan(duration_s=2.0), Sensors(gnss_std_m=std), 0)
    assert set(told.gnss_status) == {status}


def test_the_truth_table_stands_at_the_wheel_stamps() -> None:
    told, table = simulate(DrivePlan(duration_s=20.0, changes=((10.0, (0.6, -0.6, 0.1)),)), Sensors(), 0)
    np.testing.assert_array_equal(table["stamp_ns"], told.wheel_stamp_ns)
    np.testing.assert_array_equal(np.unique(table["x_icr_m"]), [-0.25, 0.1])
    assert list(table) == [
        "stamp_ns", "t_s", "north_m", "east_m", "heading_rad", "y_icr_right_m", "y_icr_left_m", "x_icr_m",
        "v_left_mps", "v_right_mps",
    ]  # fmt: skip


def test_sample_times_are_half_open() -> None:
    np.testing.assert_array_equal(sample_times(10.0, 0.3), [0.0, 0.1, 0.2])
    assert len(sample_times(30.0, 1.0)) == 30


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (DrivePlan(icrs_m=(-0.5, 0.5, 0.0)), "icrs: y_icr_right -0.5 is not right of y_icr_left 0.5"),
        (DrivePlan(changes=((5.0, (-0.5, 0.5, 0.0)),)), "change: y_icr_right"),
        (
            DrivePlan(changes=((5.0, (0.5, -0.5, 0.0)), (5.0, (0.5, -0.5, 0.0)))),
            "change: the times 5, 5 do not increase",
        ),
        (DrivePlan(path=PathPlan("lawnmower", radius_m=0.0)), "radius: a lawnmower path has no bends of radius 0"),
        (DrivePlan(duration_s=0.05), "duration: 0.05 s holds fewer than two samples at 20 Hz"),
    ],
)
def test_what_cannot_be_driven_is_refused_in_words(plan: DrivePlan, words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        check_drive(plan, Sensors())
    assert str(refused.value).startswith(words)


def test_the_command_knows_the_studies_there_are() -> None:
    from icrtool.simulation.studies import STUDIES

    assert set(get_args(StudyName)) == set(STUDIES)
    varied = {study.varied for study in STUDIES.values()} - {""}
    assert varied <= {option.name for option in study_command.params}
    assert {name for name, study in STUDIES.items() if study.varies and not study.varied} == {"initial"}
