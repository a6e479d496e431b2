"""Recordings of replays: in a loop, at another speed, by a recorder whose clock is beyond any possible time."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from icrtool.config import load_config
from icrtool.kernels.arrays import Ints
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.read_log import read_log
from icrtool.logs.streams.repeats import find_repeats, first_pass
from icrtool.logs.streams.sources import StampedRows, put_on_replay_clock, stamp_rows
from icrtool.records.tables import RobotLog
from icrtool.records.text import LogText

LOG = Path(__file__).parents[3] / "sample_logs" / "wheeled_lawnmower.mcap"
CONFIG = load_config(robot="segway-rmp400")
LASTS_NS = 40_000_000_000
SECOND_NS = 1_000_000_000

Again = Callable[[int], list[int]]


@functools.cache
def beginning() -> list[tuple[Schema, Channel, int, bytes]]:
    """Return the messages of the log's first seconds: type, topic, time since the start [ns] and content."""
    with LOG.open("rb") as stream:
        found: list[tuple[Schema, Channel, int, bytes]] = []
        begin_ns = 0
        for schema, channel, message in make_reader(stream).iter_messages():
            begin_ns = begin_ns or message.log_time
            if message.log_time - begin_ns >= LASTS_NS:
                break
            found.append((schema, channel, message.log_time - begin_ns, message.data))
    return found


def record(path: Path, times_of: Again, *, change: bool = False, topic: str = "") -> Path:
    """Write the first 40 s of a log, each message at all log times that `times_of` gives for its time since the start.

    `change`: each message differs from the one that it repeats; `topic`: name of all topics, in place of their own.
    """
    kept = []
    for schema, channel, since_ns, own in beginning():
        for number, time_ns in enumerate(times_of(since_ns)):
            data = own[:-8] + np.float64(number).tobytes() if change and number else own
            kept.append((time_ns, schema, channel, data))
    kept.sort(key=lambda one: one[0])
    with path.open("wb") as sink:
        writer = Writer(sink, compression=CompressionType.ZSTD)
        writer.start("ros2")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for time_ns, schema, channel, data in kept:
            if channel.id not in channels:
                if schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(topic or channel.topic, "cdr", schemas[schema.id])
            writer.add_message(channels[channel.id], time_ns, data, time_ns)
        writer.finish()
    return path


def codes(log: RobotLog) -> dict[str, str]:
    return {one.code: one.text for one in log.notes}


def assert_same(log: RobotLog, other: RobotLog) -> None:
    assert np.array_equal(log.wheels.stamp_ns, other.wheels.stamp_ns)
    assert np.array_equal(log.wheels.left, other.wheels.left)
    assert np.array_equal(log.gnss.stamp_ns, other.gnss.stamp_ns)
    assert np.array_equal(log.gnss.north_m, other.gnss.north_m)
    assert np.array_equal(log.heading.heading_rad, other.heading.heading_rad)


BEGIN_NS = 1_770_000_000 * SECOND_NS


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> RobotLog:
    return read_log(record(tmp_path_factory.mktemp("once") / "a.mcap", lambda t: [BEGIN_NS + t]), CONFIG)


@pytest.mark.parametrize("passes", [1.4, 2.0, 3.5])
def test_a_replay_in_a_loop_is_one_pass_and_named(tmp_path: Path, once: RobotLog, passes: float) -> None:
    def times(t: int) -> list[int]:
        at = [t + number * (LASTS_NS + SECOND_NS) for number in range(4)]
        return [BEGIN_NS + one for one in at if one < passes * LASTS_NS]

    log = read_log(record(tmp_path / "a.mcap", times), CONFIG)
    assert "a replay in a loop was recorded; the first pass is used" in codes(log)["recording_looped"]
    assert_same(log, once)


def test_other_values_at_the_same_stamps_are_no_loop(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", lambda t: [BEGIN_NS + t, BEGIN_NS + t + LASTS_NS], change=True)
    assert "recording_looped" not in codes(read_log(path, CONFIG))


def table(header_ns: Ints, log_ns: Ints, values: Ints) -> TopicTable:
    columns = {"header.stamp.sec": header_ns // 10**9, "header.stamp.nanosec": header_ns % 10**9, "value": values}
    return TopicTable(LogText("/t"), LogText("a/msg/B"), log_ns, columns, {}, 0)


def test_transforms_of_publishers_that_take_turns_are_no_loop() -> None:
    turns = np.tile(np.arange(12) * SECOND_NS // 1000, 50)
    assert find_repeats([table(turns, np.arange(600) * 10**8 + BEGIN_NS, turns)]) is None


def test_a_table_without_stamps_ends_where_the_second_pass_begins() -> None:
    steps = np.arange(200) * 10**8
    looped = table(np.tile(steps[:100], 2), steps, np.tile(np.arange(100), 2))
    live = TopicTable(LogText("/cmd"), LogText("a/msg/B"), steps + 10**7, {"value": np.arange(200)}, {}, 0)
    repeats = find_repeats([looped, live])
    assert repeats is not None
    assert [len(first_pass(one, repeats)) for one in (looped, live)] == [100, 100]
    assert repeats.passes == 2.0


@pytest.mark.parametrize("speed", [0.5, 1.25, 2.0, 10.0])
def test_a_replay_at_another_speed_has_the_clock_of_its_headers_and_is_named(
    tmp_path: Path, once: RobotLog, speed: float
) -> None:
    log = read_log(record(tmp_path / "a.mcap", lambda t: [BEGIN_NS + round(t / speed)]), CONFIG)
    assert_same(log, once)
    assert f"runs {speed:.3g} times as fast as log time" in codes(log)["header_clock"]
    assert all(stream.clock == "header" for stream in log.streams)


def test_a_stream_without_header_stamps_is_put_on_the_clock_of_a_replay() -> None:
    header = np.arange(0, 100 * SECOND_NS, SECOND_NS // 10) + BEGIN_NS
    like = stamp_rows(table(header, (header - BEGIN_NS) // 2 + 2 * BEGIN_NS, header))
    assert like.far_ns is not None
    bare = np.arange(-SECOND_NS, 51 * SECOND_NS, SECOND_NS // 100)
    moved = put_on_replay_clock(StampedRows(None, bare + 2 * BEGIN_NS, "no header", 0), like)
    assert moved.header_ns is not None
    assert np.abs(moved.header_ns - (2 * bare + BEGIN_NS)).max() < 2_000_000


@pytest.mark.parametrize("begin_ns", [(1 << 63) - SECOND_NS, 1 << 63, (1 << 64) - 2 * LASTS_NS])
def test_log_times_beyond_any_possible_time_are_named_and_headers_used(
    tmp_path: Path, once: RobotLog, begin_ns: int
) -> None:
    path = record(tmp_path / "a.mcap", lambda t: [begin_ns + t])
    log = read_log(path, CONFIG)
    assert_same(log, once)
    assert "the clock of the recorder was wrong" in codes(log)["log_time_impossible"]
    part = read_log(path, CONFIG, start=10.0, end=30.0)
    assert part.wheels.stamp_ns[0] - once.wheels.stamp_ns[0] == pytest.approx(10 * SECOND_NS, abs=SECOND_NS)


def test_a_single_log_time_beyond_any_possible_time_is_left_out(tmp_path: Path, once: RobotLog) -> None:
    path = record(tmp_path / "a.mcap", lambda t: [BEGIN_NS + t if t != 10 * SECOND_NS else 1 << 63])
    log = read_log(path, CONFIG)
    assert "log_time_impossible" not in codes(log)
    assert 0 < len(once.wheels.stamp_ns) - len(log.wheels.stamp_ns) < 5


def test_streams_of_several_types_on_one_topic_keep_their_own_stamps(tmp_path: Path, once: RobotLog) -> None:
    log = read_log(record(tmp_path / "a.mcap", lambda t: [BEGIN_NS + t], topic="/all"), CONFIG)
    assert [stream.topic for stream in log.streams] == ["/all"] * 3
    assert_same(log, once)
