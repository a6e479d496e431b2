"""From what wheels tell to speeds: what no wheel can have done is left out, and said."""

from __future__ import annotations

import numpy as np
import pytest

from icrtool.alignment.wheel_units import with_wheel_speeds
from icrtool.config import load_config
from icrtool.kernels.arrays import Floats, Ints
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.sources import StampedRows, WheelSource, make_wheel_source
from icrtool.logs.streams.wheel_samples import wheel_samples
from icrtool.records.samples import NO_HEADINGS, PositionFixes
from icrtool.records.tables import RobotLog
from support.tables import read_source

RADIUS_M, STEP_NS = 0.1, 20_000_000
CONFIG = load_config(sets=[f"robot.wheel_radius_m={RADIUS_M}"])
NOTHING = PositionFixes(np.empty(0, np.int64), *(np.empty(0) for _ in range(5)))


def speeds_of(left: Floats, right: Floats) -> tuple[Ints, Floats, Floats, list[str]]:
    stamps = STEP_NS * np.arange(len(left), dtype=np.int64)
    clock = StampedRows(None, stamps, "", 0)
    motion = make_wheel_source(topic="/wheels", message_type="some/Type", stamps=clock, position=(left, right))
    raw, _ = wheel_samples(motion, stamps, CONFIG, "log")
    log = with_wheel_speeds(RobotLog("log", raw, NOTHING, NO_HEADINGS, None, (), (), {}, ()), CONFIG)
    return log.wheels.stamp_ns, log.wheels.v_left_mps, log.wheels.v_right_mps, list(log.warnings)


@pytest.fixture
def travel() -> Floats:
    """Positions [rad] of a wheel that speeds up to 8 rad/s, stops, and goes on."""
    t = np.arange(600) * STEP_NS / 1e9
    return np.cumsum(np.where((t > 5) & (t < 7), 0.0, np.minimum(4 * t, 8.0))) * STEP_NS / 1e9


@pytest.mark.parametrize("where", [1, 250, 300, 598])
def test_a_counter_that_is_reset_costs_one_sample_and_is_said(travel: Floats, where: int) -> None:
    _, clean, _, nothing = speeds_of(travel, travel)
    reset = np.where(np.arange(len(travel)) >= where, travel + 12.0, travel)
    stamps, left, right, warnings = speeds_of(reset, travel)
    kept = np.isin(STEP_NS * np.arange(len(travel)), stamps)
    assert np.count_nonzero(~kept) == 1
    assert left == pytest.approx(clean[kept], abs=1e-9)
    assert right == pytest.approx(clean[kept], abs=1e-9)
    assert len(warnings) == 1
    assert "1 wheel speeds, up to 60 m/s" in warnings[0] or "up to 61 m/s" in warnings[0]
    assert not nothing


def within_a_turn(positions: Floats, low: float) -> Floats:
    return np.mod(positions - low, 2 * np.pi) + low


@pytest.mark.parametrize("low", [-np.pi, 0.0])
def test_joints_told_within_one_turn_are_read_like_those_that_go_on(travel: Floats, low: float) -> None:
    positions = np.column_stack([travel, travel + 1.0, -0.7 * travel, 2.0 - 0.7 * travel])
    whole, wrapped = (joints_motion(each) for each in (positions, within_a_turn(positions, low)))
    for one, other in zip(whole.position or (), wrapped.position or (), strict=True):
        assert np.diff(other) == pytest.approx(np.diff(one), abs=1e-9)


def test_a_gap_in_less_than_a_turn_is_no_wrap() -> None:
    positions = np.repeat(np.array([0.0, 0.1, 5.0, 5.1, 5.2])[:, None], 4, axis=1)
    sides = joints_motion(positions).position
    assert sides is not None
    assert sides[0].tolist() == positions[:, 0].tolist()


def test_a_wheel_with_a_dead_encoder_is_left_out_of_its_side() -> None:
    travel = np.cumsum(np.full(50, 0.1))
    motion = joints_motion(np.column_stack([np.zeros(50), travel, 2.0 * travel, 2.0 * travel]))
    assert motion.position is not None
    assert motion.position[0] == pytest.approx(travel)
    assert motion.notes[0].text.startswith("front_left_wheel never turns")
    parked = joints_motion(np.zeros((50, 4)))
    assert (parked.notes, parked.position is None) == ((), False)


def test_a_dead_encoder_is_named_where_messages_do_not_name_wheels() -> None:
    travel = np.cumsum(np.full(50, 0.1))
    columns = {"position[*]": np.column_stack([travel, travel, travel, np.zeros(50)]), "velocity[*]": np.zeros((50, 4))}
    table = TopicTable("/wheels", "leo_msgs/WheelStates", STEP_NS * np.arange(50, dtype=np.int64), columns, {}, 0)
    motion = read_source("wheels", table, CONFIG)
    assert motion.position is not None
    assert motion.position[1] == pytest.approx(travel)
    assert motion.notes[0].text.startswith("wheel 3 never turns")


def joints_motion(positions: Floats) -> WheelSource:
    names = ["front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel"]
    rows = len(positions)
    columns = {
        "name[*]": np.broadcast_to(np.arange(4), (rows, 4)), "position[*]": positions,
        "velocity[*]": np.full((rows, 4), np.nan),
    }  # fmt: skip
    times = STEP_NS * np.arange(rows, dtype=np.int64)
    table = TopicTable("/joint_states", "sensor_msgs/JointState", times, columns, {"name[*]": names}, 0)
    return read_source("wheels", table, CONFIG)


def test_hard_braking_and_a_short_dash_of_a_robot_that_mostly_stands_are_driving() -> None:
    speed = np.zeros(5000)
    speed[1000:1008], speed[3000:3004] = 40.0, -40.0
    travel = np.concatenate([[0.0], np.cumsum(speed)[:-1]]) * STEP_NS / 1e9
    _, left, _, warnings = speeds_of(travel, travel)
    assert np.abs(left).max() == pytest.approx(40.0 * RADIUS_M)
    assert len(left) == 5000
    assert not warnings
