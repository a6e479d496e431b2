"""Jumps of the reference: steps that no robot makes, kept apart from slides that one may make."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from icrtool.alignment.slip_events import find_disagreements
from icrtool.kernels.arrays import Floats
from icrtool.records.measurements import ReferenceJump, SensorData
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX
from support.slip_drives import START_NS, WIDTH_M, curves, drive

AT_S = 47.3


def jumps_of(sensors: SensorData) -> tuple[ReferenceJump, ...]:
    return find_disagreements(sensors, WIDTH_M).jumps


def stepped(size_m: float, fix_hz: int, seed: int = 0) -> SensorData:
    return drive(fix_hz=fix_hz, seed=seed, position_error=lambda t: size_m * (t >= AT_S))


@pytest.mark.parametrize(("fix_hz", "size_m"), [(20, 1.0), (10, 1.0), (5, 1.0), (2, 2.0), (1, 5.0), (20, 10.0)])
@pytest.mark.parametrize("seed", range(3))
def test_a_step_that_no_robot_makes_is_a_jump_with_time_place_and_size(fix_hz: int, size_m: float, seed: int) -> None:
    sensors = stepped(size_m, fix_hz, seed)
    (jump,) = jumps_of(sensors)
    assert not jump.undecided
    assert jump.kind == "position"
    assert (jump.begin_ns - START_NS) / 1e9 < AT_S <= (jump.end_ns - START_NS) / 1e9
    assert jump.end_ns - jump.begin_ns <= 1.1e9 / min(fix_hz, 10)
    assert jump.size_m == pytest.approx(size_m, abs=0.1)
    assert (jump.moved_north_m, jump.moved_east_m) == pytest.approx((size_m, 0.0), abs=0.1)
    before = sensors.fixes.stamp_ns == jump.begin_ns
    assert jump.north_m == sensors.fixes.north_m[before]


@pytest.mark.parametrize("speed_mps", [0.3, 0.5, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("fix_hz", [20, 5, 2])
@pytest.mark.parametrize("gyro", [True, False])
def test_a_slide_is_never_decided_to_be_a_jump(speed_mps: float, fix_hz: int, gyro: bool) -> None:
    for seed in range(2):
        at = 30.0 + 7.7 * seed
        slide = drive(
            fix_hz=fix_hz, seed=seed, gyro=gyro, position_error=lambda t, at=at: speed_mps * np.clip(t - at, 0.0, 2.0)
        )
        assert all(jump.undecided for jump in jumps_of(slide))


@pytest.mark.parametrize("fix_hz", [20, 5, 1])
@pytest.mark.parametrize("std_m", [0.01, 0.05, 0.3])
def test_a_clean_drive_has_no_jump(fix_hz: int, std_m: float) -> None:
    assert all(jumps_of(drive(seed=seed, fix_hz=fix_hz, fix_std_m=std_m)) == () for seed in range(5))


def test_a_hold_and_the_motion_after_it_are_no_jump() -> None:
    def hold(t: Floats) -> Floats:
        inside = 1.0 * ((t >= 60.0) & (t < 63.0))
        return np.array([inside, inside, 0 * t])

    assert jumps_of(drive(hold)) == ()


def test_a_step_that_slip_can_make_is_undecided_unless_the_receiver_states_a_new_solution() -> None:
    sensors = stepped(0.8, 2)
    (jump,) = jumps_of(sensors)
    assert jump.undecided
    kinds = np.where(sensors.fixes.stamp_ns < jump.end_ns, FLOAT_FIX, FIXED_FIX).astype(np.uint8)
    (stated,) = jumps_of(replace(sensors, fixes=replace(sensors.fixes, fix_class=kinds)))
    assert not stated.undecided


@pytest.mark.parametrize("fix_hz", [20, 5])
@pytest.mark.parametrize("lasts_s", [2.0, 8.0])
@pytest.mark.parametrize("size_m", [0.0, 10.0])
def test_a_gap_of_the_wheels_has_no_step_but_one_that_no_robot_makes(
    fix_hz: int, lasts_s: float, size_m: float
) -> None:
    sensors = drive(
        wheels=lambda t, seed: 3 * curves(t, seed), fix_hz=fix_hz, position_error=lambda t: size_m * (t >= AT_S)
    )
    t_s = (sensors.wheels.stamp_ns - START_NS) / 1e9
    known = (t_s < AT_S - lasts_s / 2) | (t_s > AT_S + lasts_s / 2)
    found = jumps_of(replace(sensors, wheels=sensors.wheels.cut(known)))
    assert [round(jump.size_m) for jump in found] == ([10] if size_m else [])


def test_a_single_outlier_is_no_jump() -> None:
    assert jumps_of(drive(position_error=lambda t: 5.0 * (np.arange(len(t)) == len(t) // 2))) == ()


def test_a_heading_that_turns_at_once_is_a_jump() -> None:
    sensors = drive()
    late = sensors.headings.stamp_ns >= START_NS + round(AT_S * 1e9)
    turned = replace(sensors.headings, heading_rad=sensors.headings.heading_rad + np.radians(60.0) * late)
    facts = msgspec.structs.replace(sensors.facts, heading_from_position=True)
    (jump,) = jumps_of(replace(sensors, headings=turned, facts=facts))
    assert (jump.kind, jump.undecided) == ("heading", False)
    assert jump.turn_deg == pytest.approx(60.0, abs=6.0)
