"""Damaged containers: what survives is read, what was lost is said, and nothing that a log claims costs memory."""

from __future__ import annotations

import re
import sqlite3
import struct
import time
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message, Schema
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from icrtool.errors import LogError
from icrtool.logs.containers import unpack
from icrtool.logs.containers.container import MOST_PROBLEMS
from icrtool.logs.containers.open_log import BagDirectory, open_log
from icrtool.logs.containers.sqlite_bag import SqliteBag

START_NS = 1_760_000_000_000_000_000
KINDS = {"/a": "std_msgs/msg/String", "/b": "std_msgs/msg/Float64"}
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
MCAP_MAGIC = b"\x89MCAP0\r\n"
TERABYTES = 1 << 42
LITTLE_MEMORY = 50_000_000
"""Bytes. What reading a log of 40 kB may take at most, the interpreter's own included."""


def make_messages(count=200, length=150):
    rng = np.random.default_rng(3)
    return [
        (("/a", "/b")[row % 2], START_NS + row * 1000, b"\x00\x01\x00\x00" + rng.bytes(length + row % 40))
        for row in range(count)
    ]


def in_order(messages, found):
    """Return the messages that were found, in their order."""
    found = set(found)
    return [message for message in messages if message in found]


def read_log(path):
    """Return messages and problems of a log; no messages and the error where it is refused."""
    try:
        container = open_log(path)
    except LogError as err:
        return [], [str(err)]
    try:
        topics = {channel.id: channel.topic for channel in container.channels}
        messages = [
            (topics[channel], stamp, block.data[start:end].tobytes())
            for block in container.blocks(frozenset(topics))
            for channel, stamp, start, end in zip(*(x.tolist() for x in block[1:]), strict=True)
            if channel in topics
        ]
        return messages, [one.sentence for one in container.problems]
    finally:
        container.close()


def write_mcap(path, messages, compression="zstd", **options):
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType[compression.upper()], **{"chunk_size": 4000, **options})
        writer.start(profile="ros2", library="test")
        schemas = {kind: writer.register_schema(kind, "ros2msg", b"float64 data") for kind in KINDS.values()}
        channels = {topic: writer.register_channel(topic, "cdr", schemas[kind]) for topic, kind in KINDS.items()}
        for topic, stamp, data in messages:
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()
    return path


def mcap_messages_until_error(path):
    found = []
    with path.open("rb") as stream:
        try:
            for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
                found.append((channel.topic, message.log_time, message.data))
        except (McapError, struct.error, ValueError, KeyError, RuntimeError, zstandard.ZstdError):
            pass
    return found


def chunk_places(content):
    """File offsets of the chunk records of an MCAP file, read without icrtool."""
    places, at = [], len(MCAP_MAGIC)
    while content[at] != 15:
        if content[at] == 6:
            places.append(at)
        at += 9 + int.from_bytes(content[at + 1 : at + 9], "little")
    return places


def write_bag(path, messages, compression="none"):
    bag = Writer1(path)
    if compression != "none":
        bag.set_compression(Writer1.CompressionFormat[compression.upper()])
    with bag:
        bag.chunk_threshold = 4000
        connections = {topic: bag.add_connection(topic, kind, typestore=ROS1) for topic, kind in KINDS.items()}
        for topic, stamp, data in messages:
            bag.write(connections[topic], stamp, data)
    return path


def write_directory(path, messages, plugin=StoragePlugin.SQLITE3, mode=CompressionMode.NONE):
    bag = Writer2(path, version=9, storage_plugin=plugin)
    bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        connections = {topic: bag.add_connection(topic, kind, typestore=ROS2) for topic, kind in KINDS.items()}
        for topic, stamp, data in messages:
            bag.write(connections[topic], stamp, data)
    return path


def patched(content, at, new):
    return content[:at] + new + content[at + len(new) :]


def rle_bomb(megabytes):
    """A zstd frame of one repeated byte: 4 bytes for each 128 KiB."""
    blocks = [((1 << 17) << 3 | 1 << 1).to_bytes(3, "little") + b"\0"] * (8 * megabytes)
    return b"\x28\xb5\x2f\xfd\x00\x58" + b"".join(blocks) + (1).to_bytes(3, "little")


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("index", [IndexType.ALL, IndexType.NONE], ids=["index", "no index"])
def test_mcap_cut_off_anywhere_gives_what_stands_before_the_cut(tmp_path, compression, index):
    messages = make_messages()
    whole = write_mcap(tmp_path / "log.mcap", messages, compression, index_types=index).read_bytes()
    assert len(chunk_places(whole)) > 5
    data_end = whole.rindex(b"\x0f" + (4).to_bytes(8, "little"))
    path = tmp_path / "cut.mcap"
    for length in [
        *range(1, 120, 13),
        *range(120, data_end, 1597),
        *range(data_end - 12, data_end + 12),
        *range(data_end + 12, data_end + 30, 3),
        len(whole) - 1,
    ]:
        path.write_bytes(whole[:length])
        found, problems = read_log(path)
        assert found == messages[: len(found)]
        assert len(found) >= len(mcap_messages_until_error(path))
        assert bool(problems) == (length < data_end + 9), length
        assert len(found) == len(messages) or problems


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_mcap_cut_off_inside_a_large_chunk_gives_the_beginning_of_the_chunk(tmp_path, compression):
    messages = make_messages(count=900, length=1000)
    path = write_mcap(tmp_path / "log.mcap", messages, compression, chunk_size=1 << 30)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 7 // 10])
    found, problems = read_log(path)
    assert mcap_messages_until_error(path) == []
    # A block of lz4 or zstd is up to 128 kB: what of it is missing takes the whole block along.
    assert 400 < len(found) < 650
    assert found == messages[: len(found)]
    (problem,) = problems
    assert problem.startswith("log.mcap: cut off or damaged at byte ")
    assert f" of {len(whole) * 7 // 10};" in problem


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("index", [IndexType.ALL, IndexType.NONE], ids=["index", "no index"])
def test_mcap_chunk_that_is_damaged_is_left_out_and_said(tmp_path, compression, index):
    messages = make_messages()
    path = write_mcap(tmp_path / "log.mcap", messages, compression, index_types=index)
    whole = path.read_bytes()
    places = chunk_places(whole)
    third = places[2]
    middle = third + int.from_bytes(whole[third + 1 : third + 9], "little") // 2
    path.write_bytes(patched(whole, middle, bytes([whole[middle] ^ 0x10])))
    found, problems = read_log(path)
    before = [message for message in messages if message[1] < found[0][1]]
    assert before == []
    lost = [message for message in messages if message not in found]
    first = messages.index(lost[0])
    assert lost == messages[first : first + len(lost)]
    assert 0 < len(lost) < len(messages) / len(places) * 2
    (problem,) = problems
    assert problem.startswith(f"log.mcap: chunk at byte {third} left out: ")


def test_mcap_chunk_whose_place_was_overwritten_is_said_and_the_index_finds_the_others(tmp_path):
    messages = make_messages()
    path = write_mcap(tmp_path / "log.mcap", messages)
    whole = path.read_bytes()
    third = chunk_places(whole)[2]
    path.write_bytes(patched(whole, third - 200, bytes(400)))
    found, problems = read_log(path)
    assert len(messages) - 60 < len(found) < len(messages)
    assert in_order(messages, found) == found
    (problem,) = problems
    assert problem.startswith(f"log.mcap: chunk at byte {third} left out: ")


def test_a_block_stays_as_it_is_while_chunk_after_chunk_behind_it_is_left_out(tmp_path):
    """Chunks are read while a block is used: those that give none must not take its memory."""
    messages = [(topic, stamp, data[:150]) for topic, stamp, data in make_messages(600)]
    path = write_mcap(tmp_path / "log.mcap", messages, "zstd", index_types=IndexType.NONE)
    content = path.read_bytes()
    places = chunk_places(content)
    assert len(places) > 12
    for place in places[1:-1]:
        content = patched(content, place + 9 + 24, b"\1\2\3\4")  # of another checksum
    path.write_bytes(content)
    container = open_log(path)
    blocks = container.blocks(frozenset({1, 2}))
    first = next(blocks)
    at_once = [first.data[start:end].tobytes() for start, end in zip(first.start, first.end, strict=True)]
    assert at_once == [data for _, _, data in messages[: len(at_once)]]
    for _ in range(100):
        if len(container.problems) >= len(places) - 2:
            break
        time.sleep(0.02)
    later = [first.data[start:end].tobytes() for start, end in zip(first.start, first.end, strict=True)]
    blocks.close()
    container.close()
    assert later == at_once


@pytest.mark.parametrize("checksum", [True, False], ids=["checksum", "no checksum"])
def test_mcap_whose_records_between_chunks_are_damaged_loses_no_message(tmp_path, checksum):
    messages = make_messages()
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4000, compression=CompressionType.NONE, enable_crcs=checksum)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"float64 data")
        channel = writer.register_channel("/a", "cdr", schema)
        for row, (_, stamp, data) in enumerate(messages):
            writer.add_message(channel, stamp, data, stamp)
            if row % 50 == 49:
                writer.add_attachment(stamp, stamp, "notes", "text", b"attachment" * 30)
        writer.finish()
    whole = path.read_bytes()
    # behind the chunk that was written last, before the one that is open
    begin = whole.index(b"attachment")
    record = whole.rindex(b"\x09", 0, begin - 40)
    path.write_bytes(patched(whole, record, bytes(12)))
    found, problems = read_log(path)
    assert [message[1:] for message in found] == [message[1:] for message in messages]
    (problem,) = problems
    assert re.fullmatch(rf"log\.mcap: damaged at byte {record}; reading goes on at byte \d+", problem)


@pytest.mark.parametrize("index", [IndexType.ALL, IndexType.NONE], ids=["index", "no index"])
def test_mcap_of_an_unknown_compression_is_said(tmp_path, index):
    path = write_mcap(tmp_path / "log.mcap", make_messages(), index_types=index, enable_crcs=False)
    path.write_bytes(path.read_bytes().replace(b"\x04\0\0\0zstd", b"\x04\0\0\0br\n9"))
    found, problems = read_log(path)
    assert found == []
    assert "compression 'br\\n9' is not known" in problems[0]
    assert len(problems) <= MOST_PROBLEMS + 1


MCAP_CLAIMS = {
    "uncompressed size": (9 + 16, TERABYTES),
    "uncompressed size, little too much": (9 + 16, 4500),
    "compressed size": (9 + 32 + 4, TERABYTES),
    "compressed size, negative": (9 + 32 + 4, (1 << 64) - 1),
    "name length": (9 + 28, 0xFFFF_FFFF),
    "record length": (1, TERABYTES),
    "record length, negative": (1, (1 << 64) - 1),
    "record length, short": (1, 30),
}


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("index", [IndexType.ALL, IndexType.NONE], ids=["index", "no index"])
@pytest.mark.parametrize("claim", MCAP_CLAIMS)
def test_mcap_chunk_that_claims_what_it_does_not_hold_costs_nothing_but_itself(tmp_path, compression, index, claim):
    messages = make_messages()
    path = write_mcap(tmp_path / "log.mcap", messages, compression, index_types=index)
    whole = path.read_bytes()
    third = chunk_places(whole)[2]
    offset, number = MCAP_CLAIMS[claim]
    size = 4 if claim == "name length" else 8
    path.write_bytes(patched(whole, third + offset, number.to_bytes(size, "little")))
    tracemalloc.start()
    found, problems = read_log(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < LITTLE_MEMORY
    if compression == "none" and claim.startswith("uncompressed size"):
        # A chunk that is not compressed is as large as it is, and its checksum confirms it.
        assert (found, problems) == (messages, [])
        return
    if index == IndexType.ALL and "record" in claim:
        # How long it is, its index states, too.
        assert (found, problems) == (messages, [])
        return
    assert problems
    assert found[:30] == messages[:30]
    if index == IndexType.ALL or "record" not in claim:
        assert len(found) > len(messages) - 60
    assert set(found) <= set(messages)


@pytest.mark.parametrize("whole_header", [True, False])
def test_mcap_chunk_of_a_zstd_bomb_is_left_out(tmp_path, whole_header):
    bomb = rle_bomb(2000)
    path = tmp_path / "bomb.mcap"
    stream = RecordBuilder()
    Header("ros2", "test").write(stream)
    Schema(1, b"float64 data", "ros2msg", "std_msgs/msg/Float64").write(stream)
    Channel(1, "/a", "cdr", {}, 1).write(stream)
    claimed = 5000 if whole_header else TERABYTES
    Chunk("zstd", bomb, START_NS, START_NS, 0, claimed).write(stream)
    Message(1, START_NS, b"after", START_NS, 0).write(stream)
    DataEnd(0).write(stream)
    Footer(0, 0, 0).write(stream)
    path.write_bytes(MCAP_MAGIC + stream.end() + MCAP_MAGIC)
    found, problems = read_log(path)
    assert found == [("/a", START_NS, b"after")]
    (problem,) = problems
    assert "left out: 5001 bytes instead of 5000" in problem or f"left out: it claims {TERABYTES} bytes" in problem


INDEX_LIES = {
    "chunk place": (9 + 16, 1),
    "chunk place, before it": (9 + 16, -9),
    "chunk place, far away": (9 + 16, 1 << 60),
    "chunk place, negative": (9 + 16, 1 << 63),
    "chunk length": (9 + 24, 3),
    "chunk length, without the record's head": (9 + 24, -9),
    "chunk length, far too long": (9 + 24, 1 << 60),
    "uncompressed size": (-8, 1),
    "uncompressed size, far too large": (-8, 1 << 60),
    "uncompressed size, too small": (-8, -1),
}
"""Where in a chunk index record, from its begin or from its end, and by how much."""


@pytest.mark.parametrize("lie", INDEX_LIES)
@pytest.mark.parametrize("checksum", [True, False], ids=["checksum", "no checksum"])
@pytest.mark.parametrize("of_all", [True, False], ids=["of all", "of the third"])
@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_mcap_whose_index_lies_loses_no_message(tmp_path, lie, checksum, of_all, compression):
    messages = make_messages()
    path = write_mcap(tmp_path / "log.mcap", messages, compression, enable_crcs=checksum)
    whole = path.read_bytes()
    records, at = [], whole.rindex(b"\x0f" + (4).to_bytes(8, "little"))
    while whole[at] != 2:
        end = at + 9 + int.from_bytes(whole[at + 1 : at + 9], "little")
        if whole[at] == 8:
            records.append((at, end))
        at = end
    offset, error = INDEX_LIES[lie]
    for begin, end in records if of_all else records[2:3]:
        at = (begin if offset > 0 else end) + offset
        wrong = int.from_bytes(whole[at : at + 8], "little") + error
        whole = patched(whole, at, (wrong % (1 << 64)).to_bytes(8, "little"))
    path.write_bytes(whole)
    assert read_log(path) == (messages, [])


def test_mcap_whose_index_names_one_chunk_twice_gives_each_message_once(tmp_path):
    messages = make_messages()
    path = write_mcap(tmp_path / "log.mcap", messages, enable_crcs=False)
    whole = path.read_bytes()
    data_end = whole.rindex(b"\x0f" + (4).to_bytes(8, "little"))
    records, at = [], data_end
    while whole[at] != 2:
        if whole[at] == 8:
            records.append(at)
        at += 9 + int.from_bytes(whole[at + 1 : at + 9], "little")
    first = whole[records[0] : records[1]]
    assert len(first) == records[2] - records[1]
    path.write_bytes(patched(whole, records[1], first))
    assert read_log(path) == (messages, [])


def test_mcap_with_a_summary_that_points_into_the_data_is_read_record_by_record(tmp_path):
    messages = make_messages()
    path = write_mcap(tmp_path / "log.mcap", messages, enable_crcs=False)
    whole = path.read_bytes()
    for place in (0, 1, 8, chunk_places(whole)[0], chunk_places(whole)[1] + 50, len(whole), 1 << 63, (1 << 64) - 1):
        path.write_bytes(patched(whole, len(whole) - 28, place.to_bytes(8, "little")))
        assert read_log(path) == (messages, []), place


def loose_mcap(path, *records):
    stream = RecordBuilder()
    Header("ros2", "test").write(stream)
    for record in records:
        if isinstance(record, bytes):
            stream.write(record)
        else:
            record.write(stream)
    DataEnd(0).write(stream)
    Footer(0, 0, 0).write(stream)
    path.write_bytes(MCAP_MAGIC + stream.end() + MCAP_MAGIC)
    return path


def test_mcap_that_describes_a_schema_twice_says_so_and_keeps_the_first(tmp_path):
    path = loose_mcap(
        tmp_path / "log.mcap",
        Schema(1, b"float64 data", "ros2msg", "std_msgs/msg/Float64"),
        Channel(1, "/a", "cdr", {}, 1),
        Message(1, START_NS, b"one", START_NS, 0),
        Schema(1, b"float64 data", "ros2msg", "std_msgs/msg/Float64"),
        Schema(1, b"int32 data", "ros2msg", "std_msgs/msg/Int32"),
        Channel(1, "/b", "cdr", {}, 1),
        Message(1, START_NS, b"two", START_NS, 0),
    )
    found, problems = read_log(path)
    assert found == [("/a", START_NS, b"one"), ("/a", START_NS, b"two")]
    assert problems == [
        "log.mcap: schema 1 has two different descriptions; the first description was used",
        "log.mcap: channel 1 has two different descriptions; the first description was used",
    ]


def test_mcap_channel_that_is_no_utf_8_is_left_out_and_said(tmp_path):
    name = RecordBuilder()
    Channel(2, "/bad", "cdr", {}, 1).write(name)
    path = loose_mcap(
        tmp_path / "log.mcap",
        Schema(1, b"float64 data", "ros2msg", "std_msgs/msg/Float64"),
        Channel(1, "/a\n\x1b[31m", "cdr", {}, 1),
        name.end().replace(b"/bad", b"/\xff\xfed"),
        Message(1, START_NS, b"one", START_NS, 0),
        Message(2, START_NS, b"two", START_NS, 0),
    )
    found, problems = read_log(path)
    assert found == [(r"/a\n\x1b[31m", START_NS, b"one")]
    assert problems == ["log.mcap: a schema or channel that cannot be read was left out"]


def test_mcap_record_that_is_too_short_for_its_kind_is_left_out_and_said(tmp_path):
    path = loose_mcap(
        tmp_path / "log.mcap",
        Schema(1, b"float64 data", "ros2msg", "std_msgs/msg/Float64"),
        Channel(1, "/a", "cdr", {}, 1),
        b"\x05" + (21).to_bytes(8, "little") + bytes(21),
        b"\xf0" + (5).to_bytes(8, "little") + b"ours.",
        b"\x03" + (3).to_bytes(8, "little") + b"\0\0\0",
        Message(1, START_NS, b"one", START_NS, 0),
    )
    found, problems = read_log(path)
    assert found == [("/a", START_NS, b"one")]
    assert len(problems) == 2
    assert problems[0].startswith("log.mcap: record at byte ")


def test_messages_of_an_impossible_time_are_left_out_and_said(tmp_path):
    times = [START_NS, 0, (1 << 62) - 1, 1 << 62, (1 << 63) - 1]
    path = loose_mcap(
        tmp_path / "log.mcap",
        Schema(1, b"float64 data", "ros2msg", "std_msgs/msg/Float64"),
        Channel(1, "/a", "cdr", {}, 1),
        *(Message(1, stamp, b"x", stamp, 0) for stamp in [*times, 1 << 63, (1 << 64) - 1]),
    )
    expected = [("/a", stamp, b"x") for stamp in times[:3]]
    assert read_log(path) == (expected, ["log.mcap: messages with an impossible log time left out"])
    path = write_directory(tmp_path / "log", [("/a", stamp, b"x") for stamp in [*times, -1, -(1 << 63)]])
    assert read_log(path) == (expected, ["log.db3: messages with an impossible log time left out"])


def test_mcap_with_many_damages_does_not_drown_the_user(tmp_path):
    short = b"\x05" + (3).to_bytes(8, "little") + bytes(3)
    path = loose_mcap(
        tmp_path / "log.mcap",
        Schema(1, b"float64 data", "ros2msg", "std_msgs/msg/Float64"),
        Channel(1, "/a", "cdr", {}, 1),
        *[short] * 5000,
    )
    _, problems = read_log(path)
    assert len(problems) == MOST_PROBLEMS + 1
    assert problems[-1] == "log.mcap: and more of the kind"


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_ros_1_bag_cut_off_anywhere_gives_what_stands_before_the_cut(tmp_path, compression):
    messages = make_messages()
    whole = write_bag(tmp_path / "log.bag", messages, compression).read_bytes()
    path = tmp_path / "cut.bag"
    most = 0
    for length in [*range(1, 4200, 211), *range(4200, len(whole) - 300, 797), *range(len(whole) - 300, len(whole), 29)]:
        path.write_bytes(whole[:length])
        found, problems = read_log(path)
        assert found == messages[: len(found)]
        assert len(found) >= most
        assert problems
        most = len(found)
    assert most == len(messages)


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_ros_1_bag_cut_off_inside_a_chunk_gives_the_beginning_of_the_chunk(tmp_path, compression):
    messages = make_messages(count=900, length=1000)
    bag = Writer1(tmp_path / "log.bag")
    if compression == "lz4":
        bag.set_compression(Writer1.CompressionFormat.LZ4)
    with bag:
        connections = {topic: bag.add_connection(topic, kind, typestore=ROS1) for topic, kind in KINDS.items()}
        bag.chunk_threshold = 1 << 30
        for topic, stamp, data in messages:
            bag.write(connections[topic], stamp, data)
    path = tmp_path / "log.bag"
    path.write_bytes(path.read_bytes()[:600_000])
    found, problems = read_log(path)
    assert 400 < len(found) < 600
    assert found == messages[: len(found)]
    assert problems == [
        "log.bag: has no index (not closed, or cut off); read from start to end",
        "log.bag: cut off or damaged at byte 4109 of 600000; everything before it was read",
    ]


def index_place(whole):
    at = whole.index(b"index_pos=") + 10
    return at, int.from_bytes(whole[at : at + 8], "little")


def test_ros_1_bag_of_a_recorder_that_was_killed_is_read(tmp_path):
    messages = make_messages()
    whole = write_bag(tmp_path / "log.bag", messages).read_bytes()
    at, index = index_place(whole)
    path = tmp_path / "drive.bag.active"
    path.write_bytes(patched(whole, at, bytes(8))[:index])
    assert read_log(path) == (
        messages,
        ["drive.bag.active: has no index (not closed, or cut off); read from start to end"],
    )


@pytest.mark.parametrize("kind", ["mcap", "loose mcap", "bag", "whole bag"])
def test_what_the_channels_are_is_learned_once_when_a_log_without_an_index_is_opened(tmp_path, monkeypatch, kind):
    messages, path = make_messages(), tmp_path / kind.replace(" ", ".")
    if kind.endswith("mcap"):
        write_mcap(path, messages, index_types=IndexType.NONE, use_chunking=kind == "mcap")
    else:
        whole = write_bag(path, messages).read_bytes()
        at, index = index_place(whole)
        path.write_bytes(patched(whole, at, bytes(8))[: index if kind == "bag" else None])
    container = open_log(path)

    def learned(*_):
        pytest.fail("learned again")

    for name in ("_learn", "_connect"):
        monkeypatch.setattr(type(container), name, learned, raising=False)
    topics = {channel.id: channel.topic for channel in container.channels}
    numbers = [number for block in container.blocks(frozenset(topics)) for number in block.channel.tolist()]
    container.close()
    assert [topics[number] for number in numbers] == [topic for topic, *_ in messages]


def test_ros_1_bag_takes_a_topics_name_from_the_record_when_there_is_no_index(tmp_path):
    messages = make_messages()
    whole = write_bag(tmp_path / "log.bag", messages).read_bytes()
    at, index = index_place(whole)
    path = tmp_path / "remapped.bag"
    # The record's header says /a; the publisher's own, behind it, keeps the name from before the topic was remapped.
    content = patched(whole, at, bytes(8))[:index].replace(b"topic=/a\x14\0\0\0type", b"topic=/X\x14\0\0\0type")
    assert (content.count(b"topic=/a"), content.count(b"topic=/X")) == (1, 1)
    path.write_bytes(content)
    container = open_log(path)
    container.close()
    assert [channel.topic for channel in container.channels] == ["/a", "/b"]


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_ros_1_bag_chunk_that_is_damaged_is_left_out_and_said(tmp_path, compression):
    messages = make_messages()
    path = write_bag(tmp_path / "log.bag", messages, compression)
    whole = path.read_bytes()
    name = f"compression={compression}".encode()
    chunk = whole.index(name, whole.index(name) + 1000)
    path.write_bytes(patched(whole, chunk + 60, b"\xff" * 200))
    found, problems = read_log(path)
    assert len(problems) == 1
    assert "left out" in problems[0]
    assert len(messages) - 60 < len(found) < len(messages)
    assert in_order(messages, found) == found


def test_ros_1_bag_of_an_unknown_compression_is_said(tmp_path):
    path = write_bag(tmp_path / "log.bag", make_messages(), "lz4")
    path.write_bytes(path.read_bytes().replace(b"compression=lz4", b"compression=lz5"))
    found, problems = read_log(path)
    assert found == []
    assert "compression 'lz5' is not known" in problems[0]


def test_an_encrypted_ros_1_bag_is_refused(tmp_path):
    path = write_bag(tmp_path / "log.bag", make_messages())
    whole = path.read_bytes()
    field = b"encryptor=secret"
    length = int.from_bytes(whole[13:17], "little") + 4 + len(field)
    head = length.to_bytes(4, "little") + len(field).to_bytes(4, "little") + field
    path.write_bytes(whole[:13] + head + whole[17:])
    with pytest.raises(LogError, match="an encrypted bag; decrypt it first"):
        open_log(path)


@pytest.mark.parametrize("version", [b"1.2", b"2.1", b"9.9"])
def test_a_ros_1_bag_of_another_version_is_refused(tmp_path, version):
    path = tmp_path / "log.bag"
    path.write_bytes(b"#ROSBAG V" + version + b"\n" + bytes(100))
    with pytest.raises(LogError, match="a bag of another version"):
        open_log(path)


@pytest.mark.parametrize("number", [0xFFFF_FFFF, 0x7FFF_FFFF, 0x8000_0000, 5])
@pytest.mark.parametrize("field", ["header length", "data length", "chunk size", "length in chunk", "header in chunk"])
@pytest.mark.parametrize("indexed", [True, False], ids=["index", "no index"])
def test_ros_1_bag_that_claims_what_it_does_not_hold_costs_nothing_but_the_chunk(tmp_path, number, field, indexed):
    messages = make_messages()
    path = write_bag(tmp_path / "log.bag", messages)
    whole = path.read_bytes()
    chunk = [found.start() for found in re.finditer(rb"\x29\0\0\0\x04\0\0\0op=\x05", whole)][2]
    content_at = chunk + 4 + 0x29 + 4
    places = {
        "header length": chunk,
        "chunk size": whole.index(b"size=", chunk) + 5,
        "data length": content_at - 4,
        "header in chunk": content_at,
        "length in chunk": content_at + 4 + int.from_bytes(whole[content_at : content_at + 4], "little"),
    }
    content = patched(whole, places[field], number.to_bytes(4, "little"))
    if not indexed:
        content = patched(content, index_place(content)[0], bytes(8))
    path.write_bytes(content)
    tracemalloc.start()
    found, problems = read_log(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < LITTLE_MEMORY
    if field == "chunk size":
        # A chunk that is not compressed is as large as it is.
        assert (found, len(problems)) == (messages, not indexed)
        return
    assert problems
    assert found[:15] == messages[:15]
    if indexed:
        assert len(found) > len(messages) - 60


BAG_INDEX_LIES = {
    "place": ("index_pos=", 1),
    "place, far away": ("index_pos=", 1 << 62),
    "place, negative": ("index_pos=", 1 << 63),
    "count of connections": ("conn_count=", 1),
    "count of chunks": ("chunk_count=", 1),
    "place of a chunk": ("chunk_pos=", 3),
    "place of a chunk, negative": ("chunk_pos=", 1 << 63),
}


@pytest.mark.parametrize("lie", BAG_INDEX_LIES)
def test_ros_1_bag_whose_index_lies_loses_one_chunk_at_most(tmp_path, lie):
    messages = make_messages()
    path = write_bag(tmp_path / "log.bag", messages)
    whole = path.read_bytes()
    name, error = BAG_INDEX_LIES[lie]
    at = whole.index(name.encode()) + len(name)
    size = 4 if "count" in lie else 8
    wrong = int.from_bytes(whole[at : at + size], "little") + error
    path.write_bytes(patched(whole, at, wrong.to_bytes(size, "little")))
    found, problems = read_log(path)
    assert len(problems) == 1
    assert in_order(messages, found) == found
    assert len(found) == len(messages) if "place of" not in lie else len(found) > len(messages) - 60


def test_db3_cut_off_anywhere_gives_what_stands_before_the_cut(tmp_path):
    messages = make_messages(count=2000, length=200)
    path = write_directory(tmp_path / "log", messages) / "log.db3"
    whole = path.read_bytes()
    cut = tmp_path / "cut.db3"
    counts = []
    for length in [1, 17, 100, 4096, *range(5000, len(whole) - 1, 48_001), len(whole) - 1]:
        cut.write_bytes(whole[:length])
        found, problems = read_log(cut)
        assert in_order(messages, found) == found
        assert problems or len(found) == len(messages)
        counts.append(len(found))
    assert counts[-2] > 1500


@pytest.mark.parametrize("pages", [1, 5])
@pytest.mark.parametrize("rubbish", ["zeros", "noise"])
def test_db3_with_damaged_pages_gives_what_stands_before_them_and_names_the_tool_for_the_rest(tmp_path, pages, rubbish):
    messages = make_messages(count=3000, length=200)
    path = write_directory(tmp_path / "log", messages) / "log.db3"
    whole = path.read_bytes()
    noise = np.random.default_rng(0).bytes(4096 * pages) if rubbish == "noise" else bytes(4096 * pages)
    middle = whole.index(messages[1500][2][:150]) // 4096 * 4096
    path.write_bytes(patched(whole, middle, noise))
    found, problems = read_log(path)
    assert found == messages[: len(found)]
    assert 1500 - 4096 // 200 < len(found) <= 1500
    (problem,) = problems
    assert problem.startswith("log.db3: damaged (")
    assert "`sqlite3 log.db3 .recover | sqlite3 recovered.db3`" in problem


def test_db3_whose_list_of_topics_is_damaged_is_refused_and_names_the_tool(tmp_path):
    path = write_directory(tmp_path / "log", make_messages(count=300, length=200)) / "log.db3"
    database = sqlite3.connect(path)
    (page,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'topics'").fetchone()
    database.close()
    path.write_bytes(patched(path.read_bytes(), 4096 * (page - 1), bytes(4096)))
    with pytest.raises(LogError, match=r"log\.db3: not a readable rosbag2 database; .*`sqlite3 log\.db3 \.recover"):
        open_log(path)


@pytest.mark.parametrize("end", [0, 1, 2000], ids=["at a page", "behind a page", "inside a page"])
def test_db3_cut_off_says_so_and_loses_a_page_at_most(tmp_path, end):
    messages = make_messages(count=2000, length=200)
    whole = (write_directory(tmp_path / "log", messages) / "log.db3").read_bytes()
    place = whole.index(messages[1500][2][:150]) // 4096 * 4096
    path = tmp_path / "cut.db3"
    path.write_bytes(whole[: place + end])
    found, problems = read_log(path)
    assert found == messages[: len(found)]
    assert len(found) > 1500 - 3 * 21
    assert problems[0].startswith(
        "cut.db3: cut off; the rows that SQLite can read were read; `sqlite3 cut.db3 .recover"
    )


def test_db3_rows_that_hold_no_message_are_left_out_and_said(tmp_path):
    messages = make_messages(20)
    path = write_directory(tmp_path / "log", messages) / "log.db3"
    database = sqlite3.connect(path)
    database.executescript(
        """
        ALTER TABLE messages RENAME TO strict;
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data);
        INSERT INTO messages SELECT * FROM strict;
        INSERT INTO messages VALUES (50, 1, 5, NULL), (51, 1, NULL, x'00'), (52, 1, 'noon', x'00'), (53, 1, 7, 'text'),
            (54, 1, 1e300, x'00'), (55, 'one', 7, x'00'), (56, NULL, 7, x'00');
        INSERT INTO topics VALUES (9223372036854775807, '/huge', 'std_msgs/msg/String', 'cdr', '', ''),
            (-5, CAST(x'2fff0a' AS TEXT), 'no slash', 'cdr', '', '');
        INSERT INTO messages VALUES (60, 9223372036854775807, 8, x'01'), (61, -5, 9, x'02');
        """
    )
    database.close()
    expected = [*messages, ("/huge", 8, b"\1"), ("/\ufffd\\n", 9, b"\2")]
    problems = ["log.db3: rows without a time, or without a message of up to 16777216 bytes, left out"]
    for log in (path, path.parent):
        assert read_log(log) == (expected, problems)


def test_one_db3_row_without_a_message_costs_no_other(tmp_path):
    messages = make_messages(3000)
    path = write_directory(tmp_path / "log", messages) / "log.db3"
    database = sqlite3.connect(path)
    rows = [row for (row,) in database.execute("SELECT id FROM messages ORDER BY id")]
    for place in (0, 700, 701, len(rows) - 1):
        database.execute("UPDATE messages SET data = 7 WHERE id = ?", (rows[place],))
    database.commit()
    database.close()
    expected = [message for place, message in enumerate(messages) if place not in (0, 700, 701, len(rows) - 1)]
    assert read_log(path) == (
        expected,
        ["log.db3: rows without a time, or without a message of up to 16777216 bytes, left out"],
    )


@pytest.mark.parametrize(
    "tables", ["", "CREATE TABLE topics(id); CREATE VIEW messages AS SELECT 1", "CREATE TABLE t(x)"]
)
def test_an_sqlite_file_that_is_no_bag_is_refused(tmp_path, tables):
    path = tmp_path / "log.db3"
    database = sqlite3.connect(path)
    database.executescript(f"{tables}; PRAGMA user_version = 3;")
    database.close()
    with pytest.raises(
        LogError, match=r"not a readable rosbag2 database; (its tables are|messages is not a plain table)"
    ):
        open_log(path)


def test_compressed_messages_that_do_not_decompress_are_left_out_and_said(tmp_path):
    messages = make_messages(40)
    path = write_directory(tmp_path / "log", messages, mode=CompressionMode.MESSAGE)
    database = sqlite3.connect(path / "log.db3")
    claim = b"\x28\xb5\x2f\xfd\xe0" + TERABYTES.to_bytes(8, "little") + b"\1\0\0"
    for row, data in ((3, b""), (5, b"rubbish"), (7, claim), (9, rle_bomb(64)), (11, messages[0][2])):
        database.execute("UPDATE messages SET data = ? WHERE id = ?", (data, row))
    database.commit()
    database.close()
    found, problems = read_log(path)
    lost = [2, 4, 6, 8, 10]
    assert found == [message for row, message in enumerate(messages) if row not in lost]
    assert len(problems) == 1
    assert problems[0].startswith("log.db3: 5 compressed messages left out: ")


def test_messages_of_an_unknown_compression_are_left_out_and_said(tmp_path):
    path = write_directory(tmp_path / "log", make_messages(40), StoragePlugin.MCAP, CompressionMode.MESSAGE)
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("compression_format: zstd", "compression_format: snappy"))
    assert read_log(path) == ([], ["log.mcap: 40 compressed messages left out: compression 'snappy' is not known"])


def test_a_compressed_file_that_is_cut_off_gives_what_stands_before_the_cut(tmp_path):
    messages = make_messages(count=3000)
    path = write_directory(tmp_path / "log", messages, mode=CompressionMode.FILE)
    (file,) = path.glob("*.zstd")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    found, problems = read_log(path)
    assert 500 < len(found) < 2000
    assert found == messages[: len(found)]
    assert problems


@pytest.mark.parametrize("content", [b"", b"no zstd at all", b"\x28\xb5\x2f\xfd"], ids=["empty", "rubbish", "magic"])
def test_a_compressed_file_that_is_none_is_refused(tmp_path, content):
    path = write_directory(tmp_path / "log", make_messages(9), mode=CompressionMode.FILE)
    (file,) = path.glob("*.zstd")
    file.write_bytes(content)
    with pytest.raises(LogError, match="no storage file in it can be read"):
        open_log(path)


def test_a_compressed_file_that_is_a_bomb_does_not_fill_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(unpack, "LARGEST_CHUNK_BYTES", 1 << 20)
    monkeypatch.setattr(unpack, "LARGEST_RATIO", 10)
    path = write_directory(tmp_path / "log", make_messages(2), mode=CompressionMode.FILE)
    (file,) = path.glob("*.zstd")
    file.write_bytes(rle_bomb(100_000))
    written = []
    opened = Path.open

    def watched(self, mode="r", *args, **kwargs):
        if mode == "wb":
            written.append(self)
        return opened(self, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", watched)
    monkeypatch.setattr(SqliteBag, "__init__", lambda *_: written.append(written[0].stat().st_size))
    monkeypatch.setattr(BagDirectory, "_merge_channels", lambda _: [])
    monkeypatch.setattr(SqliteBag, "close", lambda _: None)
    monkeypatch.setattr(SqliteBag, "problems", [], raising=False)
    with pytest.raises(LogError, match="more than 10 times its size"):
        open_log(path)
    assert written[1] < 40_000_000


YAML_BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    "text",
    [
        f"{YAML_BOMB}rosbag2_bagfile_information:\n  relative_file_paths: *i\n",
        "rosbag2_bagfile_information:\n  relative_file_paths: [log.db3, 7, null, [x], '', '..', '/etc/passwd']\n",
        "[" * 1500,
        "rosbag2_bagfile_information: {relative_file_paths: 2026-99-99}",
        "rosbag2_bagfile_information: {relative_file_paths: 1e400, compression_mode: !!python/object:os.system x}",
        "\0\1\2",
        "? !!binary x",
    ],
    ids=["bomb", "not names", "deep", "date", "tag", "binary", "key"],
)
def test_whatever_metadata_says_the_storage_files_are_found(tmp_path, text):
    messages = make_messages(30)
    path = write_directory(tmp_path / "log", messages)
    (path / "metadata.yaml").write_text(text, encoding="utf-8")
    found, problems = read_log(path)
    assert found == messages
    assert len(problems) <= 1


def test_checksum_of_the_summary_is_the_one_the_specification_means(tmp_path):
    whole = write_mcap(tmp_path / "log.mcap", make_messages(5)).read_bytes()
    start = int.from_bytes(whole[-28:-20], "little")
    assert zlib.crc32(whole[start:-12]) == int.from_bytes(whole[-12:-8], "little")


def test_a_database_whose_write_ahead_log_was_not_copied_names_it(tmp_path):
    """A recorder that runs keeps its tables, or its messages, in the log beside the file."""
    for name, tables_too in (("tables.db3", True), ("messages.db3", False)):
        recorded = tmp_path / f"recorded_{name}"
        database = sqlite3.connect(recorded)
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA wal_autocheckpoint = 0")
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        database.commit()
        if not tables_too:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        database.execute("INSERT INTO messages VALUES (1, 1, 1, x'00')")
        database.commit()
        alone = tmp_path / name
        alone.write_bytes(recorded.read_bytes())
        database.close()
        with pytest.raises(LogError, match=rf"{name}-wal, which holds messages, is missing"):
            open_log(alone)
