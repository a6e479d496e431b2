"""The compiled scans and the decoder, run as plain Python on damaged bytes: nothing outside them is touched."""

from __future__ import annotations

import os
import subprocess
import sys
from types import FunctionType

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from icrtool.kernels.compiled import njit
from icrtool.logs.containers import chunked_file
from icrtool.logs.containers import record_table as records
from icrtool.logs.containers.mcap_file import McapFile
from icrtool.logs.messages import decoder
from icrtool.logs.messages.decoder import Decoded, decode_messages
from icrtool.logs.messages.schema import (
    BEGIN_LOOP,
    END_LOOP,
    SKIP,
    SKIP_SEQUENCE,
    SKIP_STRING,
    TAKE,
    TAKE_SEQUENCE,
    TAKE_STRING,
    Layout,
    compile_layout,
)

STORE = get_typestore(Stores.ROS2_HUMBLE)
WANTED = {
    "sensor_msgs/JointState": ("header.stamp.sec", "header.frame_id", "name[*]", "position[*]", "velocity[*]"),
    "nav_msgs/Odometry": ("header.stamp.sec", "pose.covariance[35]", "twist.twist.angular.z", "twist.covariance[*]"),
    "diagnostic_msgs/DiagnosticArray": ("header.stamp.nanosec", "status[*].level", "status[*].name"),
    "nav_msgs/Path": ("poses[*].header.frame_id", "poses[*].pose.orientation.w"),
    "std_msgs/Float64MultiArray": ("layout.dim[*].label", "layout.dim[*].size", "layout.data_offset", "data[*]"),
}
EXTREMES = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF, (1 << 63) - 1, 1 << 63, (1 << 64) - 1]
MUTATIONS = 100


class Guarded:
    """An array that refuses to be read or written outside, where Python would count from the end."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def __len__(self) -> int:
        return len(self.array)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.array.shape

    def _check(self, index: object) -> None:
        for place, length in zip(index if isinstance(index, tuple) else (index,), self.array.shape, strict=False):
            if not 0 <= int(place) < length:
                raise IndexError(f"{index} of {self.array.shape}")

    def __getitem__(self, index: object) -> object:
        self._check(index)
        value = self.array[index]
        return int(value) if np.ndim(value) == 0 and self.array.dtype != np.uint64 else value

    def __setitem__(self, index: object, value: int) -> None:
        self._check(index)
        self.array[index] = value


def as_python(kernel):
    """Return a kernel as the plain function it was, with the kernels it calls as plain functions too."""
    function = kernel.py_func
    names = {
        name: as_python(value)
        for name, value in function.__globals__.items()
        if name in function.__code__.co_names and type(value) is type(njit(lambda: None))
    }
    return FunctionType(function.__code__, {**function.__globals__, **names})


def ros_messages(rng, message_type, cdr, count=6):
    """Messages of a type with values and lengths of no meaning."""
    package, _, name = message_type.partition("/")
    full = f"{package}/msg/{name}"
    encode = STORE.serialize_cdr if cdr else get_typestore(Stores.ROS1_NOETIC).serialize_ros1
    store = STORE if cdr else get_typestore(Stores.ROS1_NOETIC)
    return [bytes(encode(random_message(rng, store, full), full)) for _ in range(count)]


def random_message(rng, store, name):
    values = {}
    for field, (kind, detail) in store.fielddefs[name][1]:
        values[field] = random_value(rng, store, int(kind), detail)
    return store.types[name](**values)


def random_value(rng, store, kind, detail):
    if kind == 2:
        return random_message(rng, store, detail)
    if kind == 1:
        if detail[0] == "string":
            return "".join(rng.choice(list("abcé_/"), rng.integers(0, 20)))
        if detail[0] == "bool":
            return bool(rng.integers(0, 2))
        kind_of = np.dtype({"octet": "uint8", "byte": "uint8", "char": "uint8"}.get(detail[0], detail[0]))
        return rng.normal() if kind_of.kind == "f" else int(rng.integers(0, 100))
    (inner_kind, inner), length = detail
    length = length if kind == 3 else int(rng.integers(0, 5))
    if int(inner_kind) == 1 and inner[0] != "string":
        return rng.integers(0, 100, length).astype({"octet": "uint8", "byte": "uint8"}.get(inner[0], inner[0]))
    return [random_value(rng, store, int(inner_kind), inner) for _ in range(length)]


def mutated(rng, data: bytes) -> bytes:
    """Return bytes with a flip, an extreme number, a cut, a hole or a repeated slice."""
    content = bytearray(data)
    at = int(rng.integers(0, max(len(content), 1)))
    match rng.integers(0, 5):
        case 0:
            content[at : at + 1] = bytes([rng.integers(0, 256)])
        case 1:
            size = int(rng.choice([1, 2, 4, 8]))
            at = at // size * size
            content[at : at + size] = (int(rng.choice(np.array(EXTREMES, dtype=object))) % (1 << 8 * size)).to_bytes(
                size, "little"
            )
        case 2:
            del content[at:]
        case 3:
            del content[at : at + int(rng.integers(1, 20))]
        case 4:
            content[at:at] = content[at : at + int(rng.integers(1, 40))]
    return bytes(content)


def joined(messages):
    """One buffer with rubbish before, between and after the messages."""
    parts, start, end, at = [b"\xff" * 5], [], [], 5
    for message in messages:
        parts += [message, b"\xff" * 3]
        start.append(at)
        end.append(at + len(message))
        at = end[-1] + 3
    return np.frombuffer(b"".join(parts), np.uint8), np.array(start, np.int64), np.array(end, np.int64)


@pytest.mark.parametrize("message_type", WANTED)
@pytest.mark.parametrize("cdr", [True, False], ids=["cdr", "ros1"])
def test_decoding_of_damaged_messages_stays_inside_them(message_type, cdr):
    rng = np.random.default_rng(len(message_type))
    definitions = (STORE if cdr else get_typestore(Stores.ROS1_NOETIC)).fielddefs
    layout = compile_layout(definitions, message_type, WANTED[message_type], "cdr" if cdr else "ros1", 3)
    messages = ros_messages(rng, message_type, cdr)
    _, whole = decode_messages(layout, *joined(messages))
    assert whole.all()
    damaged = [mutated(rng, messages[row % len(messages)]) for row in range(MUTATIONS)]
    damaged += [mutated(rng, message) for message in damaged]
    python = as_python(decoder.decode_block)
    for message in damaged:
        data, start, end = joined([message])
        found, readable = decode_messages(layout, data, start, end)
        # Only the message is there: a read before or behind it is a read outside.
        plain, only = Decoded(layout, 1), data[start[0] : end[0]]
        block = map(Guarded, (only, np.zeros(1, np.int64), np.zeros(1, np.int64), start - start, end - start))
        kept = [plain.table, plain.times_ns, plain.shape_of, plain.shapes, plain.state, plain.same, plain.taken]
        with np.errstate(over="ignore"):
            python(*block, 0, 0, layout.program, cdr, 1 << 62, *map(Guarded, kept), plain.loops)
        assert plain.filled == readable.sum()
        assert found.filled == readable.sum()
        if readable[0]:
            for path, slot in layout.slots.items():
                np.testing.assert_array_equal(*(layout.counts(one.used_shapes()[0], path) for one in (plain, found)))
                if slot.kind != "string":
                    np.testing.assert_array_equal(plain.numbers(path), found.numbers(path))


def test_decoding_of_an_array_longer_than_all_messages_reads_nothing():
    for count in (10**6, 1 << 61, (1 << 63) - 1):
        for operation in (SKIP, TAKE, BEGIN_LOOP):
            program = np.array([[operation, 8, count, 0, 0, 0, 1]], np.int64)
            layout = Layout(program, 4, {}, True)
            _, readable = decode_messages(layout, *joined([b"\0\1\0\0" + bytes(64)]))
            assert not readable.any()


@pytest.mark.parametrize("operation", [SKIP_STRING, TAKE_STRING, SKIP_SEQUENCE, TAKE_SEQUENCE, BEGIN_LOOP])
@pytest.mark.parametrize("claimed", [61, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF])
@pytest.mark.parametrize("cdr", [True, False], ids=["cdr", "ros1"])
def test_decoding_refuses_a_length_that_the_message_does_not_have(operation, claimed, cdr):
    rows = [[operation, 8, -1, 0, 4, 1, 2], [END_LOOP, 0, 0, -1, 0, 0, 0]][: 2 if operation == BEGIN_LOOP else 1]
    layout = Layout(np.array(rows, np.int64), 8, {}, cdr)
    head = b"\0\1\0\0" if cdr else b""
    _, readable = decode_messages(layout, *joined([head + claimed.to_bytes(4, "little") + bytes(56)]))
    assert not readable.any()


def test_decoding_of_elements_without_fields_ends():
    """A loop over nothing, in a loop over nothing, in a loop over nothing: 10^27 turns if they were taken."""
    rows = [[BEGIN_LOOP, 0, 10**9, -1, 0, 0, 6]] * 3 + [[END_LOOP, 0, 0, -1, 0, 0, 0]] * 3
    layout = Layout(np.array(rows, np.int64), 1, {}, False)
    _, readable = decode_messages(layout, *joined([bytes(64)]))
    assert not readable.any()


@pytest.mark.parametrize("messages", [[], [b""], [b"\0"], [b"\0\1\0"], [b"\0\1\0\0"]], ids=str)
def test_decoding_of_no_bytes_reads_nothing(messages):
    layout = compile_layout(STORE.fielddefs, "std_msgs/Float64", ("data",), "cdr")
    found, readable = decode_messages(layout, *joined(messages))
    assert found.table.shape == (1, len(messages))
    assert readable.tolist() == [False] * len(messages)


def test_decoding_reads_big_endian_messages():
    layout = compile_layout(STORE.fielddefs, "std_msgs/Float64", ("data",), "cdr")
    value = np.array([12.625])
    messages = [b"\0\0\0\0" + value.astype(">f8").tobytes(), b"\0\1\0\0" + value.astype("<f8").tobytes()]
    found, readable = decode_messages(layout, *joined(messages))
    assert readable.all()
    np.testing.assert_array_equal(found.numbers("data"), [12.625, 12.625])


def mcap_chunk(rng, count=12):
    parts = []
    for row in range(count):
        content = rng.bytes(int(rng.integers(22, 60)))
        parts.append(bytes([(5, 5, 5, 3, 4)[row % 5]]) + len(content).to_bytes(8, "little") + content)
    return b"".join(parts)


def bag_chunk(rng, count=12):
    def field(name, value):
        return (len(name) + 1 + len(value)).to_bytes(4, "little") + name + b"=" + value

    parts = []
    for row in range(count):
        header = field(b"op", b"\x07" if row % 5 == 4 else b"\x02") + field(b"conn", rng.bytes(4))
        header += field(b"time", rng.bytes(8)) if row % 5 != 4 else field(b"topic", b"/a")
        content = rng.bytes(int(rng.integers(0, 60)))
        parts.append(len(header).to_bytes(4, "little") + header + len(content).to_bytes(4, "little") + content)
    return b"".join(parts)


SCANS = {"mcap": (mcap_chunk, records.scan_mcap), "bag": (bag_chunk, records.scan_bag)}


@pytest.mark.parametrize("kind", SCANS)
def test_scan_of_damaged_records_stays_inside_them(kind):
    make, scan = SCANS[kind]
    rng = np.random.default_rng(5)
    python = as_python(scan)
    for turn in range(MUTATIONS):
        chunk = make(rng)
        for _ in range(turn % 4):
            chunk = mutated(rng, chunk)
        data = np.frombuffer(chunk, np.uint8)
        tables, plain = np.zeros((2, 4, 20), np.int64), np.zeros((2, 4, 20), np.int64)
        found = scan(data, 0, *tables, 0)
        with np.errstate(over="ignore"):
            assert python(Guarded(data), 0, *map(Guarded, plain), 0) == found
        np.testing.assert_array_equal(plain, tables)
        for table, count in zip(tables, found[:2], strict=True):
            start, end = table[2:, :count]
            assert ((start >= 0) & (start <= end) & (end <= len(data))).all()
        if turn % 4 == 0:
            assert (sum(found[:2]), found[2]) == (12, len(data))
            assert scan(data, 0, tables[0], tables[1][:, :0], 0) == (found[0], 0, len(data))


@pytest.mark.parametrize("kind", SCANS)
@pytest.mark.parametrize("number", EXTREMES)
def test_scan_refuses_a_length_that_the_chunk_does_not_have(kind, number):
    make, scan = SCANS[kind]
    chunk = make(np.random.default_rng(1))
    size, at = (8, 1) if kind == "mcap" else (4, 0)
    chunk = chunk[:at] + (number % (1 << 8 * size)).to_bytes(size, "little") + chunk[at + size :]
    tables = np.zeros((2, 4, 20), np.int64)
    *counts, stop = scan(np.frombuffer(chunk, np.uint8), 0, *tables, 0)
    assert 0 <= sum(counts) <= 12
    assert 0 <= stop <= len(chunk)
    assert (tables[:, 3] <= len(chunk)).all()


def test_a_chunk_of_more_records_than_the_table_has_rows_is_scanned_in_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr(chunked_file, "MOST_ROWS", 7)
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        channel = writer.register_channel(
            "/a", "cdr", writer.register_schema("std_msgs/msg/Bool", "ros2msg", b"bool data")
        )
        for row in range(100):
            writer.add_message(channel, row, bytes([row]), row)
        writer.finish()
    log = McapFile(path)
    blocks = list(log.blocks(frozenset({1})))
    log.close()
    assert max(len(block.start) for block in blocks) == 7
    assert [int(block.data[at]) for block in blocks for at in block.start] == list(range(100))
    assert log.problems == []


@pytest.mark.stress
def test_compiled_code_with_bounds_checked_finds_no_read_outside(tmp_path):
    environment = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout
