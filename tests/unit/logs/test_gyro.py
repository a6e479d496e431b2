"""The gyro of a log: which one, and which way round."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.read_log import read_log
from icrtool.logs.streams.headings import find_gyro
from support.field_logs import ROBOT, fixes, imus, joint_states, make_drive, write_messages

COUNT = 60
TIMES = 1_760_000_000_000_000_000 + 10_000_000 * np.arange(COUNT)
RATE = 0.3 * np.sin(np.linspace(0.0, 6.0, COUNT))


def imu(topic: str, rate: Any = RATE, frame: str = "imu_link", count: int = COUNT) -> TopicTable:
    columns = {"angular_velocity.z": np.asarray(rate)[:count], "header.frame_id": np.zeros(count, np.int64)}
    return TopicTable(topic, "sensor_msgs/Imu", TIMES[:count], columns, {"header.frame_id": [frame]}, 0)


@pytest.mark.parametrize(("frame", "sign"), [("imu_link", -1.0), ("imu_link_ned", 1.0)])
def test_rates_are_clockwise_in_either_convention(frame: str, sign: float) -> None:
    found = find_gyro([imu("/imu/data", frame=frame)], "/joint_states", "/imu/data", "log")
    assert found is not None
    assert found.rate_radps == pytest.approx(sign * RATE)
    assert np.array_equal(found.stamp_ns, TIMES)


def test_the_headings_own_unit_comes_first_then_the_wheels_namespace_then_the_one_with_more_samples() -> None:
    heading, kin = imu("/x/ahrs", count=20), imu("/bot/imu", count=30)
    long, short = imu("/a/imu"), imu("/b/imu", count=40)

    def chosen(*tables: TopicTable) -> str:
        found = find_gyro(tables, "/bot/joints", "/x/ahrs", "log")
        return found.topic if found is not None else ""

    assert chosen(long, kin, heading) == "/x/ahrs"
    assert chosen(long, kin) == "/bot/imu"
    assert chosen(short, long) == "/a/imu"


def test_a_unit_that_measures_nothing_is_no_gyro_and_bad_samples_are_left_out() -> None:
    assert find_gyro([imu("/imu", np.zeros(COUNT)), imu("/b", np.full(COUNT, np.nan))], "/w", "/h", "log") is None
    spoilt = np.where(np.arange(2 * COUNT) == 7, 1e6, np.tile(RATE, 2))
    times = TIMES[0] + 10_000_000 * np.arange(2 * COUNT)
    tables = [TopicTable("/imu", "sensor_msgs/Imu", times, {"angular_velocity.z": spoilt}, {}, 0)]
    found = find_gyro(tables, "/w", "/h", "log")
    assert found is not None
    assert len(found.rate_radps) == 2 * COUNT - 1
    assert np.abs(found.rate_radps).max() < 1.0


@pytest.mark.parametrize("unit", [1.0, 180 / np.pi])
@pytest.mark.parametrize(
    ("slower", "has_heading", "noise_radps"),
    [(1.0, True, 0.0), (1.0, True, 0.02), (1.0, False, 0.0), (1.0, False, 0.02), (0.1, True, 0.0), (0.1, False, 0.02)],
)
def test_turn_rates_in_degrees_are_converted_and_named(
    tmp_path: Path, unit: float, slower: float, has_heading: bool, noise_radps: float
) -> None:
    """Of a robot that turns up to 40 deg/s, or ten times slower, with and without an orientation beside the rates."""
    drive = make_drive(60.0 / slower, 20.0 if slower == 1.0 else 5.0, slower=slower)
    sent = imus(drive, unit=unit, noise=noise_radps * slower, oriented=has_heading)
    log = read_log(
        write_messages(tmp_path / "log.mcap", joint_states(drive), fixes(drive), sent), load_config(sets=ROBOT)
    )
    assert log.gyro is not None
    np.testing.assert_allclose(log.gyro.rate_radps, drive.turn, atol=5 * noise_radps * slower + 1e-9)
    assert any("in deg/s" in one for one in log.warnings) == (unit > 1)
