"""Clocks, states of fixes and units that a log does not show by itself, and the keys that state them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icrtool.alignment.wheel_units import with_wheel_speeds
from icrtool.config import load_config
from icrtool.errors import ConfigError, IcrToolError
from icrtool.logs.read_log import read_log
from support.field_logs import (
    RADIUS_M,
    ROBOT,
    Drive,
    Message,
    fixes,
    header,
    imus,
    joint_states,
    made,
    make_drive,
    numbers,
    reference,
    write_messages,
)

DRIVE = make_drive(40.0)
WALL_NS = 1_790_000_000_000_000_000


def logged_at(messages: Iterator[Message], begin_ns: int, rate: float, late_ns: int) -> Iterator[Message]:
    """Messages whose log time is a wall clock on which the simulation goes `rate` times as fast."""
    for one in messages:
        yield one._replace(log_ns=WALL_NS + late_ns + int((one.log_ns - begin_ns) / rate))


def simulated(drive: Drive) -> Drive:
    return drive._replace(stamp_ns=drive.stamp_ns - drive.stamp_ns[0] + 5_000_000_000)


@pytest.mark.parametrize("rate", [0.3, 0.8, 1.0, 2.5])
def test_headers_of_one_clock_in_all_streams_are_used_where_log_time_is_another(tmp_path: Path, rate: float) -> None:
    sim = simulated(DRIVE)
    begin = int(sim.stamp_ns[0])
    streams = (
        logged_at(messages, begin, rate, late)
        for late, messages in ((0, joint_states(sim)), (20_000_000, fixes(sim)), (5_000_000, imus(sim)))
    )
    path = write_messages(tmp_path / "log.mcap", *streams)
    log = read_log(path, load_config(sets=ROBOT))
    np.testing.assert_allclose(log.wheels.left[:-1], DRIVE.left_radps[:-1], rtol=1e-6)
    np.testing.assert_array_equal(log.gnss.stamp_ns, sim.stamp_ns[::4])
    np.testing.assert_array_equal(log.gyros[0].stamp_ns, sim.stamp_ns)
    assert any("one clock in all streams" in one for one in log.warnings)
    use_log_times = read_log(path, load_config(sets=(*ROBOT, "topics.clock=log")))
    assert use_log_times.wheels.stamp_ns[0] == WALL_NS


def test_headers_of_two_clocks_are_not_used_together(tmp_path: Path) -> None:
    sim = simulated(DRIVE)
    other = sim._replace(stamp_ns=sim.stamp_ns + 900_000_000_000)
    begin = int(sim.stamp_ns[0])
    streams = [logged_at(messages, begin, 1.0, 0) for messages in (joint_states(sim), fixes(sim))]
    headings = logged_at(imus(other), int(other.stamp_ns[0]), 1.0, 0)
    path = write_messages(tmp_path / "log.mcap", *streams, headings)
    assert read_log(path, load_config(sets=ROBOT)).wheels.stamp_ns[0] == WALL_NS
    assert read_log(path, load_config(sets=(*ROBOT, "topics.clock=header"))).wheels.stamp_ns[0] == begin


def test_header_stamps_that_a_stream_lacks_are_refused_with_the_key(tmp_path: Path) -> None:
    sides = (numbers(f"/{side}_speed", "Float64", DRIVE.stamp_ns, DRIVE.left_radps) for side in ("left", "right"))
    path = write_messages(tmp_path / "log.mcap", *sides, reference(DRIVE))
    with pytest.raises(ConfigError, match=r"topics.clock: .* has no header stamps"):
        read_log(path, load_config(sets=(*ROBOT, "topics.clock=header")))


def test_fixes_that_state_no_fix_are_used_where_that_is_configured(tmp_path: Path) -> None:
    path = write_messages(tmp_path / "log.mcap", joint_states(DRIVE), fixes(DRIVE, status=-1), imus(DRIVE))
    with pytest.raises(IcrToolError, match=r"topics.gnss_status=ignored uses them"):
        read_log(path, load_config(sets=ROBOT))
    log = read_log(path, load_config(sets=(*ROBOT, "topics.gnss_status=ignored")))
    assert len(log.gnss.stamp_ns) == len(DRIVE.stamp_ns[::4])


UNITS = {"rad/s": 1.0, "m/s": RADIUS_M, "rpm": 60 / (2 * np.pi), "deg/s": 180 / np.pi, "counts": 4096 / (2 * np.pi)}


@pytest.mark.parametrize(("unit", "factor"), UNITS.items())
@pytest.mark.parametrize("seconds", [3.0, 40.0])
@pytest.mark.parametrize("kind", ["Float32", "Float64"])
def test_wheel_speeds_without_header_are_in_the_configured_unit(
    tmp_path: Path, unit: str, factor: float, seconds: float, kind: str
) -> None:
    drive = make_drive(seconds)
    sides = (
        numbers(f"/{side}_speed", kind, drive.stamp_ns, speed * factor)
        for side, speed in (("left", drive.left_radps), ("right", drive.right_radps))
    )
    path = write_messages(tmp_path / "log.mcap", *sides, fixes(drive), imus(drive))
    config = load_config(sets=(*ROBOT, "robot.encoder_counts_per_rev=4096", f"wheels.unit={unit}"))
    log = with_wheel_speeds(read_log(path, config), config)
    np.testing.assert_allclose(log.wheels.v_left_mps, drive.left_radps * RADIUS_M, rtol=1e-6)
    if seconds < 10:
        automatic = replace(config, wheels=replace(config.wheels, unit="auto"))
        with pytest.raises(ConfigError, match=r"wheels.unit: .* give rad/s, m/s, rpm, deg/s or counts"):
            with_wheel_speeds(read_log(path, automatic), automatic)


def test_positions_have_no_rpm(tmp_path: Path) -> None:
    path = write_messages(tmp_path / "log.mcap", joint_states(DRIVE), reference(DRIVE))
    with pytest.raises(ConfigError, match=r"wheels.unit: /joint_states holds positions"):
        read_log(path, load_config(sets=(*ROBOT, "wheels.unit=rpm")))


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_table_is_read_with_any_usual_separator_and_decimal_sign(
    tmp_path: Path, separator: str, decimal: str, mark: str
) -> None:
    if separator == decimal:
        return
    drive = make_drive(10.0)
    columns = {
        "t_s": (drive.stamp_ns - drive.stamp_ns[0]) / 1e9,
        "v_left_mps": drive.left_radps, "v_right_mps": drive.right_radps,
        "north_m": drive.north, "east_m": drive.east, "heading_rad": drive.heading,
    }  # fmt: skip
    rows = [
        separator.join(columns),
        *(separator.join(map(repr, map(float, row))) for row in zip(*columns.values(), strict=True)),
    ]
    text = "\r\n".join([rows[0], *(row.replace(".", decimal) for row in rows[1:])])
    path = tmp_path / "log.csv"
    path.write_text(mark + text, encoding="utf-8")
    log = read_log(path)
    np.testing.assert_array_equal(log.wheels.left, drive.left_radps)
    named = [one for one in log.notes if one.code == "table_form"]
    assert len(named) == (separator != ",")
    assert all(("decimal comma" in one.text) == (decimal == ",") for one in named)


KEYS_OF_TWIST = ("topics.twist_speed=/base/state.accel.linear.x", "topics.twist_turn=/base/state.accel.angular.z")


def own_twists(drive: Drive, width_m: float) -> Iterator[Message]:
    """Yield a body twist in fields of a type that is none."""
    kind = "geometry_msgs/msg/AccelStamped"
    speed = (drive.left_radps + drive.right_radps) / 2 * RADIUS_M
    turn = (drive.right_radps - drive.left_radps) * RADIUS_M / width_m
    for stamp_ns, v, w in zip(drive.stamp_ns.tolist(), speed.tolist(), turn.tolist(), strict=True):
        parts = {"linear": {"x": v}, "angular": {"z": w}}
        fields = {name: made("geometry_msgs/msg/Vector3", **part) for name, part in parts.items()}
        content = made(kind, header=header(stamp_ns), accel=made("geometry_msgs/msg/Accel", **fields))
        yield Message(stamp_ns, "/base/state", kind, content)


def test_a_body_twist_in_fields_that_are_named_gives_the_wheels(tmp_path: Path) -> None:
    path = write_messages(tmp_path / "log.mcap", own_twists(DRIVE, 1.0), reference(DRIVE))
    config = load_config(sets=(*ROBOT, *KEYS_OF_TWIST, "wheels.twist_width_m=1.0"))
    log = read_log(path, config)
    np.testing.assert_allclose(log.wheels.v_left_mps, DRIVE.left_radps * RADIUS_M, atol=1e-12)
    np.testing.assert_allclose(log.wheels.v_right_mps, DRIVE.right_radps * RADIUS_M, atol=1e-12)
    (stream,) = (one for one in log.streams if one.role == "wheels")
    assert stream.is_twist
    assert stream.topic == "/base/state.accel.linear.x + /base/state.accel.angular.z"


@pytest.mark.parametrize(
    ("sets", "words"),
    [
        (KEYS_OF_TWIST[:1], r"topics.twist_speed: one part alone"),
        ((*KEYS_OF_TWIST, "topics.wheels=/joint_states"), r"topics.twist_speed: the wheels are named twice"),
        ((KEYS_OF_TWIST[0], "topics.twist_turn=/none.z"), r"topics.twist_turn: /none is not in"),
        ((KEYS_OF_TWIST[0], "topics.twist_turn=/base/state.accel.z"), r"has no numeric field accel.z"),
    ],
)
def test_a_wrong_field_of_a_body_twist_is_refused_with_its_key(
    tmp_path: Path, sets: tuple[str, ...], words: str
) -> None:
    path = write_messages(tmp_path / "log.mcap", own_twists(DRIVE, 1.0), reference(DRIVE))
    with pytest.raises(ConfigError, match=words):
        read_log(path, load_config(sets=(*ROBOT, *sets)))
