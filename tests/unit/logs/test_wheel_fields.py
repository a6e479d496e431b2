"""Wheels in messages of types that nobody listed: two fields of one message, a field of two topics, an array."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from icrtool.config import load_config
from icrtool.errors import ConfigError
from icrtool.logs.read_log import survey_log
from icrtool.logs.streams.assembly import Survey, assemble
from icrtool.logs.streams.sources import WheelSource

START_NS, STEP_NS, COUNT = 1_760_000_000_000_000_000, 50_000_000, 400
OWN_TYPES = {
    "rover_msgs/msg/Base": "std_msgs/Header header\nfloat32 left_current\nfloat32 right_current\n"
    "uint16 left_ticks\nuint16 right_ticks\nfloat32 left_range\nfloat32 right_range",
    "rover_msgs/msg/Motor": "std_msgs/Header header\nfloat32 motor_current\nfloat32 temperature\n"
    "float32 commanded_velocity\nfloat32 measured_velocity",
    "rover_msgs/msg/Pair": "float64 port\nfloat64 starboard\nfloat64[2] both\nfloat64[] list",
}
TURN = np.sin(np.arange(COUNT) / 40.0)
LEFT, RIGHT = 1.0 - 0.5 * TURN, 1.0 + 0.5 * TURN


def store_of_types() -> Any:
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in OWN_TYPES.items():
        store.register(get_types_from_msg(text, name))
    return store


STORE = store_of_types()


def header(i: int, delay_ns: int = 0) -> Any:
    stamp_ns = START_NS + i * STEP_NS - delay_ns
    stamp = STORE.types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    return STORE.types["std_msgs/msg/Header"](stamp, "")


def write(path: Path, publishers: Sequence[tuple[str, str, Sequence[Any]]]) -> Path:
    """Write topics (name, type, messages), one message of each every `STEP_NS`."""
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        for topic, name, messages in publishers:
            text = STORE.generate_msgdef(name, ros_version=2)[0]
            channel = writer.register_channel(topic, "cdr", writer.register_schema(name, "ros2msg", text.encode()))
            for i, message in enumerate(messages):
                raw, stamp_ns = bytes(STORE.serialize_cdr(message, name)), START_NS + i * STEP_NS
                writer.add_message(channel, stamp_ns, raw, stamp_ns)
        writer.finish()
    return path


def wheels_of(path: Path, *sets: str) -> list[WheelSource]:
    return list(survey_log(path, load_config(sets=sets)).candidates.wheels)


def array(values: Any, kind: str = "Float32") -> Any:
    layout = STORE.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    return STORE.types[f"std_msgs/msg/{kind}MultiArray"](layout, np.asarray(values, kind.lower()))


def test_ticks_of_both_sides_in_a_message_of_an_unknown_type_are_wheels(tmp_path: Path) -> None:
    """Its currents and ranges are not; counters of 16 bits are unwrapped, and the header's stamps are used."""
    base = STORE.types["rover_msgs/msg/Base"]
    left, right = (np.cumsum(side * 900).astype(int) for side in (LEFT, RIGHT))
    messages = [
        base(header(i, 7_000_000), 3.0 + a, 3.0 - a, int(left[i] % 65536), int(right[i] % 65536), 1.0 + a, 1.0)
        for i, a in enumerate(TURN)
    ]
    (motion,) = wheels_of(write(tmp_path / "log.mcap", [("/base/state", "rover_msgs/msg/Base", messages)]))
    assert motion.topic == "/base/state.left_ticks + /base/state.right_ticks"
    assert motion.unit == "counts"
    assert motion.position is not None
    for side, travelled in zip(motion.position, (left, right), strict=True):
        np.testing.assert_array_equal(side - side[0], travelled - travelled[0])
    assert motion.stamps.header_ns is not None
    assert motion.stamps.header_ns[0] == START_NS - 7_000_000


@pytest.mark.parametrize("topic", ["/driver/{}/feedback", "/{}_vesc/core", "/{}/wheel"])
def test_drivers_with_a_topic_for_each_side_are_paired_by_header(tmp_path: Path, topic: str) -> None:
    motor = STORE.types["rover_msgs/msg/Motor"]
    publishers = [
        (
            topic.format(side),
            "rover_msgs/msg/Motor",
            [motor(header(i, delay_ns), 2.0, 40.0, 9.0, float(v)) for i, v in enumerate(speed)],
        )
        for side, speed, delay_ns in (("left", LEFT, 0), ("right", RIGHT, STEP_NS))
    ]
    found = wheels_of(write(tmp_path / "log.mcap", publishers))
    measured, commanded = found
    assert [motion.topic.count("measured_velocity") for motion in found] == [2, 0]
    assert "(commanded)" in commanded.why
    assert measured.speed is not None
    # The right side's message of a stamp was logged one step after the left one's.
    np.testing.assert_allclose(measured.speed[1][:-1], RIGHT[1:].astype(np.float32)[: len(measured.speed[1]) - 1])


@pytest.mark.parametrize("places", [[0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [0, 1, 1, 0]], ids=str)
def test_the_sides_of_an_array_are_found_by_what_turns_alike(tmp_path: Path, places: list[int]) -> None:
    rows = np.array([LEFT, RIGHT])[places].T + np.random.default_rng(1).normal(0.0, 0.01, (COUNT, len(places)))
    path = write(tmp_path / "log.mcap", [("/wheel_speeds", "std_msgs/msg/Float32MultiArray", [array(r) for r in rows])])
    (motion,) = wheels_of(path)
    assert motion.speed is not None
    means = [rows[:, [i for i, one in enumerate(places) if one == side]].mean(axis=1) for side in (0, 1)]
    for side, mean in zip(motion.speed, means, strict=True):
        np.testing.assert_allclose(side, mean, atol=1e-6)


def test_an_array_that_is_not_of_two_sides_names_the_option(tmp_path: Path) -> None:
    rows = np.array([LEFT, RIGHT, RIGHT]).T
    path = write(tmp_path / "log.mcap", [("/wheel_speeds", "std_msgs/msg/Float32MultiArray", [array(r) for r in rows])])
    (motion,) = wheels_of(path)
    assert "topics.wheel_left and wheel_right, as /wheel_speeds.data[0]" in motion.problem
    named = ("topics.wheel_left=/wheel_speeds.data[0]", "topics.wheel_right=/wheel_speeds.data[1,2]")
    (motion,) = wheels_of(path, *named)
    assert motion.speed is not None
    np.testing.assert_allclose(motion.speed, [LEFT, RIGHT], atol=1e-6)


def test_an_array_of_something_else_is_no_wheels(tmp_path: Path) -> None:
    rows = np.array([LEFT, RIGHT]).T
    kind = "std_msgs/msg/Float32MultiArray"
    messages = [array(r) for r in rows]
    assert (
        wheels_of(write(tmp_path / "log.mcap", [("/tanks", kind, messages), ("/motor_currents", kind, messages)])) == []
    )


@pytest.mark.parametrize("names", [("port", "starboard"), ("both[0]", "both[1]"), ("list[2]", "list[0]")])
def test_any_two_numbers_are_wheels_where_they_are_named(tmp_path: Path, names: tuple[str, str]) -> None:
    pair = STORE.types["rover_msgs/msg/Pair"]
    messages = [pair(a, b, np.array([a, b]), np.array([b, 9.0, a])) for a, b in zip(LEFT, RIGHT, strict=True)]
    path = write(tmp_path / "log.mcap", [("/base", "rover_msgs/msg/Pair", messages)])
    assert wheels_of(path) == []
    (motion,) = wheels_of(path, f"topics.wheel_left=/base.{names[0]}", f"topics.wheel_right=/base.{names[1]}")
    assert motion.speed is not None
    np.testing.assert_array_equal(motion.speed, [LEFT, RIGHT])


@pytest.mark.parametrize(
    ("left", "message"),
    [
        ("/base.prot", r"topics\.wheel_left: /base\.prot .* no numeric field prot"),
        ("/base.list[3]", r"topics\.wheel_left: /base\.list\[3\] .* no such element"),
        (
            "/base",
            r"topics\.wheel_left: /base: .* is not the number of one side; name the field of one side as /base\.",
        ),
        ("/bas.port", r"topics\.wheel_left: /bas is not in"),
    ],
)
def test_a_field_that_is_not_there_is_named(tmp_path: Path, left: str, message: str) -> None:
    pair = STORE.types["rover_msgs/msg/Pair"]
    messages = [pair(a, b, np.array([a, b]), np.array([b, 9.0, a])) for a, b in zip(LEFT, RIGHT, strict=True)]
    path = write(tmp_path / "log.mcap", [("/base", "rover_msgs/msg/Pair", messages)])
    config = load_config(sets=(f"topics.wheel_left={left}", "topics.wheel_right=/base.starboard"))
    survey: Survey = survey_log(path, config)
    with pytest.raises(ConfigError, match=message):
        assemble(survey, config)
