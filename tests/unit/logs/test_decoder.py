"""The scans of records and the decoder, on sound and damaged bytes: nothing outside them is touched."""

from __future__ import annotations

import time

import numpy as np
import pytest
from mcap.writer import IndexType, Writer
from rosbags.typesys import Stores, get_typestore

from icrtool.logs.containers.mcap_file import McapFile, scan_mcap
from icrtool.logs.containers.ros1_bag import scan_bag
from icrtool.logs.messages import decoder
from icrtool.logs.messages.decoder import Decoder
from icrtool.logs.messages.definitions import COUNTED, LOOP, NUMBERS, TEXT, Layout, Operation, compile_layout
from icrtool.records.text import LONGEST_TEXT

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


def decoded(layout, data, start, end, at_once=1000):
    """The readable ones among some messages: their rows, and each field by row."""
    rows, known, parts = [], {path: {} for path in layout.slots}, {path: [] for path in layout.slots}
    decoder_of_topic, done = Decoder(layout), 0
    while done < len(start):
        found = decoder_of_topic.decode(data, start[done : done + at_once], end[done : done + at_once])
        rows += (done + np.flatnonzero(found.readable)).tolist()
        done += len(found.readable)
        for path, slot in layout.slots.items():
            if slot.kind == "string":
                codes = found.text_codes(path, known[path])
                texts = [*known[path], None]
                parts[path] += [[texts[code] for code in np.atleast_1d(row)] for row in codes]
            else:
                parts[path] += [np.atleast_1d(row) for row in found.numbers(path)]
    return rows, parts


def plain(values):
    """The values of a field without what a message lacks: NaN, or zeros and nothing at the end."""
    values = [None if value is None or str(value) == "nan" else value for value in values]
    while values and (values[-1] is None or values[-1] == 0):
        values.pop()
    return values


@pytest.mark.parametrize("message_type", WANTED)
@pytest.mark.parametrize("cdr", [True, False], ids=["cdr", "ros1"])
def test_messages_decoded_together_are_those_decoded_alone(message_type, cdr, monkeypatch):
    """Sound and damaged ones: of one that is alone nothing else is there that could be read."""
    monkeypatch.setattr(decoder, "MOST_ELEMENTS", 3)
    rng = np.random.default_rng(len(message_type))
    definitions = (STORE if cdr else get_typestore(Stores.ROS1_NOETIC)).fielddefs
    layout = compile_layout(definitions, message_type, WANTED[message_type], "cdr" if cdr else "ros1")
    messages = ros_messages(rng, message_type, cdr)
    assert decoded(layout, *joined(messages))[0] == [*range(len(messages))]
    damaged = [mutated(rng, messages[row % len(messages)]) for row in range(MUTATIONS)]
    damaged += [mutated(rng, message) for message in damaged]
    mixed = [*messages, *damaged, *messages, *damaged[::-1]]
    rows, together = decoded(layout, *joined(mixed))
    alone = [decoded(layout, np.frombuffer(m, np.uint8), np.array([0]), np.array([len(m)])) for m in mixed]
    assert rows == [row for row, (found, _) in enumerate(alone) if found]
    assert 0 < len(rows) < len(mixed)
    for path, values in together.items():
        for row, here in zip(rows, values, strict=True):
            assert plain(here) == plain(alone[row][1][path][0])


def test_messages_without_a_like_are_decoded_one_by_one(monkeypatch):
    """Texts of every length before the number: more shapes than are compared, and than are decoded at once."""
    monkeypatch.setattr(decoder, "_COMPARED_SHAPES", 40)
    monkeypatch.setattr(decoder, "_SHAPES_AT_ONCE", 100)
    kind = "sensor_msgs/msg/Temperature"
    layout = compile_layout(STORE.fielddefs, "sensor_msgs/Temperature", ("header.frame_id", "temperature"), "cdr")
    rng = np.random.default_rng(1)
    lengths = np.concatenate([rng.permutation(700), rng.integers(0, 3, 700), rng.permutation(700)])
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    make, head = STORE.types[kind], STORE.types["std_msgs/msg/Header"]
    messages = [
        bytes(STORE.serialize_cdr(make(header=head(stamp=stamp, frame_id="f" * length), temperature=float(row),
                                       variance=0.0), kind))
        for row, length in enumerate(lengths)
    ]  # fmt: skip
    rows, found = decoded(layout, *joined(messages), at_once=300)
    assert rows == [*range(len(messages))]
    assert [values[0] for values in found["temperature"]] == [float(row) for row in rows]
    assert [texts[0] for texts in found["header.frame_id"]] == [b"f" * min(length, LONGEST_TEXT) for length in lengths]


def layout_of(operation, columns=1):
    return Layout((operation,), {}, columns, True)


def test_decoding_of_an_array_longer_than_all_messages_reads_nothing():
    for count in (10**6, 1 << 61, (1 << 63) - 1):
        for slot in (0, -1):
            numbers = Operation(NUMBERS, 8, count, slot)
            for operation in (numbers, Operation(LOOP, 0, count, -1, -1, (Operation(NUMBERS, 8, 1, slot),), slot < 0)):
                assert decoded(layout_of(operation), *joined([b"\0\1\0\0" + bytes(64)]))[0] == []


COUNTS = {
    "text": Operation(TEXT, 0, COUNTED, -1),
    "taken text": Operation(TEXT, 0, COUNTED, 0),
    "sequence": Operation(NUMBERS, 8, COUNTED, -1),
    "taken sequence": Operation(NUMBERS, 8, COUNTED, 0),
    "loop": Operation(LOOP, 0, COUNTED, -1),
    "constant loop": Operation(LOOP, 0, COUNTED, -1, -1, (Operation(NUMBERS, 1, 1, -1),), True),
}


@pytest.mark.parametrize("operation", COUNTS.values(), ids=COUNTS)
@pytest.mark.parametrize("claimed", [61, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF])
@pytest.mark.parametrize("cdr", [True, False], ids=["cdr", "ros1"])
def test_decoding_refuses_a_length_that_the_message_does_not_have(operation, claimed, cdr):
    head = b"\0\1\0\0" if cdr else b""
    messages = joined([head + claimed.to_bytes(4, "little") + bytes(56)])
    assert decoded(Layout((operation,), {}, 1, cdr), *messages)[0] == []


@pytest.mark.parametrize("is_constant", [True, False])
def test_decoding_of_elements_without_fields_ends(is_constant):
    """A loop over nothing, in a loop over nothing, in a loop over nothing: 10^27 turns if they were taken."""
    body = ()
    for _ in range(3):
        body = (Operation(LOOP, 0, 10**9, -1, -1, body, is_constant),)
    assert decoded(Layout(body, {}, 0, False), *joined([bytes(64)]))[0] == []


def test_elements_of_one_size_are_passed_over_at_once():
    """As many as a message holds, aligned as when each is passed over by itself."""
    fields = [("a", (1, ("uint8", 0))), ("b", (1, ("uint16", 0))), ("c", (1, ("uint32", 0)))]
    top = [("n", (1, ("uint8", 0))), ("l", (4, ((2, "x/msg/E"), None))), ("v", (1, ("float64", 0)))]
    layout = compile_layout({"x/msg/E": ([], fields), "x/msg/Top": ([], top)}, "x/Top", ("v",), "cdr")
    slow = Layout(tuple(step._replace(is_constant=False) for step in layout.program), layout.slots, 1, True)
    for count in (0, 1, 2, 3, 1000):
        size = 8 + 8 * count
        message = b"\0\1\0\0" + bytes(4) + count.to_bytes(4, "little") + bytes(size - 8)
        message += np.array([12.5]).tobytes()
        for one in (layout, slow):
            assert decoded(one, *joined([message]))[1]["v"] == [[12.5]]
            assert decoded(one, *joined([message[:-1]]))[0] == []


@pytest.mark.parametrize("messages", [[], [b""], [b"\0"], [b"\0\1\0"], [b"\0\1\0\0"]], ids=str)
def test_decoding_of_no_bytes_reads_nothing(messages):
    layout = compile_layout(STORE.fielddefs, "std_msgs/Float64", ("data",), "cdr")
    assert decoded(layout, *joined(messages)) == ([], {"data": []})


def test_decoding_reads_big_endian_messages():
    layout = compile_layout(STORE.fielddefs, "std_msgs/Float64", ("data",), "cdr")
    value = np.array([12.625])
    big, little = b"\0\0\0\0" + value.astype(">f8").tobytes(), b"\0\1\0\0" + value.astype("<f8").tobytes()
    for messages in ([big, little, big], [big, big]):
        assert decoded(layout, *joined(messages))[1]["data"] == [[12.625]] * len(messages)


def mcap_chunk(rng, count=12):
    parts = []
    for row in range(count):
        content = rng.bytes(int(rng.integers(22, 60)))
        parts.append(bytes([(5, 5, 5, 3, 4)[row % 5]]) + len(content).to_bytes(8, "little") + content)
    return b"".join(parts)


def bag_record(fields, content=b""):
    parts = (name + b"=" + value for name, value in fields)
    header = b"".join(len(part).to_bytes(4, "little") + part for part in parts)
    return len(header).to_bytes(4, "little") + header + len(content).to_bytes(4, "little") + content


def bag_chunk(rng, count=12):
    parts = []
    for row in range(count):
        fields = [(b"op", b"\x07" if row % 5 == 4 else b"\x02"), (b"conn", rng.bytes(4))]
        fields.append((b"time", rng.bytes(8)) if row % 5 != 4 else (b"topic", b"/a"))
        parts.append(bag_record(fields, rng.bytes(int(rng.integers(0, 60)))))
    return b"".join(parts)


HEAD_BYTES = {"mcap": 31, "bag": 46}
"""Before the content of a message."""

SCANS = {"mcap": (mcap_chunk, scan_mcap), "bag": (bag_chunk, scan_bag)}


def records_one_by_one(kind, data):
    """A plain transcription of both formats: messages, begins of other records, and where they stop."""
    at, messages, others = 0, [], []
    while True:
        if kind == "mcap":
            length = int.from_bytes(data[at + 1 : at + 9], "little")
            content, end = at + 9, at + 9 + length
            if at + 9 > len(data) or end > len(data) or data[at] not in (3, 4, 5) or (data[at] == 5 and length < 22):
                break
            if data[at] == 5:
                numbers = data[content : content + 2], data[content + 6 : content + 14]
                messages.append((*(int.from_bytes(n, "little") for n in numbers), content + 22, end))
            else:
                others.append(at)
        else:
            header_end = at + 4 + int.from_bytes(data[at : at + 4], "little")
            content = header_end + 4
            end = content + int.from_bytes(data[header_end:content], "little")
            if content > len(data) or end > len(data):
                break
            fields, place = {}, at + 4
            while place + 4 <= header_end:
                stop = place + 4 + int.from_bytes(data[place : place + 4], "little")
                if stop > header_end:
                    break
                name, _, value = data[place + 4 : stop].partition(b"=")
                if len(value) == {b"op": 1, b"conn": 4, b"time": 8}.get(name):
                    fields[name] = value
                place = stop
            time = fields.get(b"time", bytes(8))
            stamp = int.from_bytes(time[:4], "little") * 10**9 + int.from_bytes(time[4:], "little")
            if fields.get(b"op") == b"\x02":
                number = int.from_bytes(fields[b"conn"], "little") if b"conn" in fields else -1
                messages.append((number, stamp, content, end))
            elif fields.get(b"op") == b"\x07":
                others.append(at)
        at = end
    return messages, others, at


def as_signed(messages):
    """Times as the kernels of the scan have them: beyond 63 bits they are negative."""
    return [(a, b - (1 << 64) if b >= 1 << 63 else b, c, d) for a, b, c, d in messages]


@pytest.mark.parametrize("kind", SCANS)
def test_scan_of_damaged_records_finds_those_before_the_damage(kind):
    make, scan = SCANS[kind]
    rng = np.random.default_rng(5)
    for turn in range(MUTATIONS):
        chunk = make(rng)
        for _ in range(turn % 4):
            chunk = mutated(rng, chunk)
        messages, others, stop = scan(np.frombuffer(chunk, np.uint8), 0)
        expected = records_one_by_one(kind, chunk)
        assert [*map(tuple, messages.T.tolist())] == as_signed(expected[0])
        assert ([other[1] for other in others], stop) == expected[1:]
        if turn % 4 == 0:
            assert (messages.shape[1] + len(others), stop) == (12, len(chunk))


def numbered_fields(row):
    return [(b"op", b"\x02"), (b"conn", row.to_bytes(4, "little")), (b"time", bytes(4) + row.to_bytes(4, "little"))]


def test_of_a_name_that_stands_twice_in_a_header_the_last_value_counts_and_costs_no_time():
    # Read one by one these take seconds.
    chunk = b"".join(bag_record([*numbered_fields(row), (b"op", b"\x02")]) for row in range(50_000))
    begin = time.process_time()
    messages, others, stop = scan_bag(np.frombuffer(chunk, np.uint8), 0)
    assert time.process_time() - begin < 0.5
    expected = records_one_by_one("bag", chunk)
    assert ([*map(tuple, messages.T.tolist())], others, stop) == expected


@pytest.mark.parametrize("count", [10, 120])
def test_a_message_may_have_any_number_of_fields_before_its_own(count):
    more = [(b"field%d" % one, b"x") for one in range(count)]
    chunk = b"".join(bag_record(more + numbered_fields(row)) for row in range(3))
    messages, _, _ = scan_bag(np.frombuffer(chunk, np.uint8), 0)
    assert messages[:2].tolist() == [[0, 1, 2], [0, 1, 2]]


@pytest.mark.parametrize("kind", SCANS)
def test_an_index_changes_nothing_in_what_a_scan_finds(kind):
    """Right, short of messages, naming other records, shifted, or of places outside; of damaged records too."""
    make, scan = SCANS[kind]
    rng = np.random.default_rng(6)
    for turn in range(MUTATIONS):
        rubbish, chunk = rng.bytes(turn % 3), make(rng)
        heads = np.array(sorted(record[2] for record in records_one_by_one(kind, chunk)[0]))
        size = HEAD_BYTES[kind]
        places = heads - size
        hints = [
            places, places[1:], places[:1], places + 1, places - 1, np.append(places, len(chunk) + 7),
            np.append(places, 1 << 40), np.sort(rng.integers(0, len(chunk), 5)), places[:0],
            np.array([int(rng.integers(0, len(chunk) + 9))]),
        ]  # fmt: skip
        if turn % 2:
            chunk = mutated(rng, chunk)
        data = np.frombuffer(rubbish + chunk, np.uint8)
        expected = scan(data, len(rubbish))
        for hint in hints:
            found = scan(data, len(rubbish), hint + len(rubbish))
            np.testing.assert_array_equal(found.messages, expected.messages)
            assert found[1:] == expected[1:]


@pytest.mark.parametrize("kind", SCANS)
def test_an_index_that_is_right_is_used(kind, monkeypatch):
    make, scan = SCANS[kind]
    chunk = make(np.random.default_rng(7), 3)
    data = np.frombuffer(chunk, np.uint8)
    places = np.array([record[2] for record in records_one_by_one(kind, chunk)[0]]) - HEAD_BYTES[kind]
    monkeypatch.setattr("icrtool.logs.containers.chunk.follow_records", None)
    assert scan(data, 0, places).messages.shape == (4, 3)


@pytest.mark.parametrize("kind", SCANS)
@pytest.mark.parametrize("number", EXTREMES)
def test_scan_refuses_a_length_that_the_chunk_does_not_have(kind, number):
    make, scan = SCANS[kind]
    chunk = make(np.random.default_rng(1))
    size, at = (8, 1) if kind == "mcap" else (4, 0)
    chunk = chunk[:at] + (number % (1 << 8 * size)).to_bytes(size, "little") + chunk[at + size :]
    messages, _, stop = scan(np.frombuffer(chunk, np.uint8), 0)
    assert ([*map(tuple, messages.T.tolist())], stop) == (
        as_signed(records_one_by_one(kind, chunk)[0]),
        records_one_by_one(kind, chunk)[2],
    )


def test_a_chunk_of_more_records_than_the_table_has_rows_is_scanned_in_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr("icrtool.logs.containers.chunk.MOST_RECORDS", 7)
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, index_types=IndexType.ALL & ~IndexType.MESSAGE)
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
