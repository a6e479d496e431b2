"""Protobuf and JSON: what Google's library and `json` read in a message is read; what is damaged costs nothing."""

from __future__ import annotations

import json
import math
import struct
import subprocess
import sys
import time
import tracemalloc
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap_protobuf.schema import build_file_descriptor_set

from icrtool.errors import DefinitionError
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.decoded_values import LONGEST_MESSAGE_BYTES, number_fields
from icrtool.logs.messages.definitions import DEEPEST, decoding_steps
from icrtool.logs.messages.protobuf import LONGEST_DESCRIPTORS, descriptors_of, protobuf_parser
from icrtool.logs.messages.topic_table import TopicTable, collector_for
from icrtool.records.text import LONGEST_TEXT, LogText
from support.tables import collected

LONGEST_S = 2.0
PATIENT = settings(suppress_health_check=[HealthCheck.too_slow], deadline=None)
FIELD = descriptor_pb2.FieldDescriptorProto
SCALARS = {
    "double": FIELD.TYPE_DOUBLE, "float": FIELD.TYPE_FLOAT, "int64": FIELD.TYPE_INT64, "uint64": FIELD.TYPE_UINT64,
    "int32": FIELD.TYPE_INT32, "fixed64": FIELD.TYPE_FIXED64, "fixed32": FIELD.TYPE_FIXED32, "bool": FIELD.TYPE_BOOL,
    "uint32": FIELD.TYPE_UINT32, "sfixed32": FIELD.TYPE_SFIXED32, "sfixed64": FIELD.TYPE_SFIXED64,
    "sint32": FIELD.TYPE_SINT32, "sint64": FIELD.TYPE_SINT64, "string": FIELD.TYPE_STRING,
}  # fmt: skip
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from("abo"), inner, max_size=3),
    max_leaves=12,
)
RANGES = {"64": 2**61, "32": 2**31 - 1}


def schema(*, syntax: str = "proto3") -> descriptor_pb2.FileDescriptorProto:
    """Return a message type ``t.All`` with a field, a list and an unpacked list of each type, and messages in it."""
    file = descriptor_pb2.FileDescriptorProto(name=f"all_{syntax}.proto", package="t", syntax=syntax)
    kind = file.message_type.add(name="All")
    inner = kind.nested_type.add(name="Inner")
    for place, (name, number) in enumerate(SCALARS.items(), 1):
        kind.field.add(name=name, number=place, type=number, label=FIELD.LABEL_OPTIONAL)
        kind.field.add(name=f"{name}s", number=100 + place, type=number, label=FIELD.LABEL_REPEATED)
        loose = kind.field.add(name=f"loose_{name}s", number=20_000 + place, type=number, label=FIELD.LABEL_REPEATED)
        if name != "string":
            loose.options.packed = False
        inner.field.add(name=name, number=place, type=number, label=FIELD.LABEL_OPTIONAL)
    kind.field.add(name="one", number=200, type=11, type_name=".t.All.Inner", label=FIELD.LABEL_OPTIONAL)
    kind.field.add(name="many", number=201, type=11, type_name=".t.All.Inner", label=FIELD.LABEL_REPEATED)
    kind.field.add(name="raw", number=202, type=FIELD.TYPE_BYTES, label=FIELD.LABEL_OPTIONAL)
    kind.field.add(name="again", number=203, type=11, type_name=".t.All", label=FIELD.LABEL_OPTIONAL)
    return file


def class_of(file: descriptor_pb2.FileDescriptorProto, name: str = "t.All") -> Any:
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def channel_of(file: descriptor_pb2.FileDescriptorProto | bytes, name: str = "t.All", topic: str = "/t") -> Channel:
    raw = file if isinstance(file, bytes) else descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    return Channel(0, LogText(topic), LogText(name), LogText("protobuf"), raw.decode("latin-1"))


def json_channel(definition: str = "") -> Channel:
    return Channel(0, LogText("/t"), LogText("t.All"), LogText("json"), definition)


def table_of(channel: Channel, messages: list[bytes], *wanted: str) -> TopicTable:
    return collected(channel, wanted, list(enumerate(messages)))


def draw(name: str, rng: np.random.Generator) -> Any:
    if name == "bool":
        return bool(rng.integers(2))
    if name == "string":
        return "".join(rng.choice([*"ab_/µ€"], int(rng.integers(0, 9))))
    if name in ("double", "float"):
        return float(np.float32(rng.normal() * 10.0 ** rng.integers(-6, 7)))
    largest = RANGES[name[-2:]]
    return int(rng.integers(0 if name.startswith(("u", "fixed")) else -largest, largest, endpoint=True))


@pytest.mark.parametrize("syntax", ["proto3", "proto2"])
def test_fields_of_every_type_are_what_google_s_library_reads(syntax: str) -> None:
    file, rng = schema(syntax=syntax), np.random.default_rng(7)
    kind, messages = class_of(file), []
    for _ in range(50):
        message = kind(raw=b"\x08\x01")
        for name in SCALARS:
            setattr(message, name, draw(name, rng))
            for many in (f"{name}s", f"loose_{name}s"):
                getattr(message, many).extend(draw(name, rng) for _ in range(rng.integers(0, 6)))
            setattr(message.one, name, draw(name, rng))
        for _ in range(rng.integers(0, 4)):
            inner = message.many.add()
            for name in SCALARS:
                setattr(inner, name, draw(name, rng))
        message.again.double = 1.0
        messages.append(message)
    paths = [form.format(name) for name in SCALARS for form in ("{}", "one.{}", "{}s[*]", "loose_{}s[*]", "many[*].{}")]
    paths += ["doubles[2]", "again.double", "raw", "nothing", "one", "many[*]", "double.x"]
    table = table_of(channel_of(file), [one.SerializeToString() for one in messages], *paths)
    assert set(paths) - set(table.columns) == {"raw", "nothing", "one", "many[*]", "double.x"}
    for name in SCALARS:
        check(table, name, [getattr(one, name) for one in messages])
        check(table, f"one.{name}", [getattr(one.one, name) for one in messages])
        check(table, f"{name}s[*]", [list(getattr(one, f"{name}s")) for one in messages])
        check(table, f"loose_{name}s[*]", [list(getattr(one, f"loose_{name}s")) for one in messages])
        check(table, f"many[*].{name}", [[getattr(inner, name) for inner in one.many] for one in messages])
    third = [one.doubles[2] if len(one.doubles) > 2 else math.nan for one in messages]
    np.testing.assert_array_equal(table.columns["doubles[2]"], third)


def check(table: TopicTable, path: str, expected: list[Any]) -> None:
    column = table.columns[path]
    for row, values in zip(column, expected, strict=True):
        found, known = (row[: len(values)], values) if isinstance(values, list) else ([row], [values])
        assert [table.texts[path][one] for one in found] == known if path in table.texts else [*found] == known, path


@pytest.mark.parametrize(("syntax", "lacking"), [("proto3", 0.0), ("proto2", math.nan)])
def test_a_field_that_is_not_sent_is_0_where_that_is_what_it_means(syntax: str, lacking: float) -> None:
    table = table_of(channel_of(schema(syntax=syntax)), [b""], "double", "one.double", "string", "doubles[*]")
    np.testing.assert_array_equal(table.columns["double"], [lacking])
    assert math.isnan(table.columns["one.double"][0])
    assert table.columns["doubles[*]"].shape == (1, 0)


def test_an_optional_field_that_is_not_sent_is_nan() -> None:
    file = descriptor_pb2.FileDescriptorProto(name="o.proto", package="t", syntax="proto3")
    kind = file.message_type.add(name="All")
    kind.oneof_decl.add(name="_a")
    kind.field.add(name="a", number=1, type=1, label=FIELD.LABEL_OPTIONAL, oneof_index=0, proto3_optional=True)
    kind.field.add(name="b", number=2, type=1, label=FIELD.LABEL_OPTIONAL)
    message = class_of(file)
    table = table_of(channel_of(file), [message(a=0.0).SerializeToString(), message().SerializeToString()], "a", "b")
    np.testing.assert_array_equal(table.columns["a"], [0.0, math.nan])
    np.testing.assert_array_equal(table.columns["b"], [0.0, 0.0])


def test_parts_of_a_message_that_come_twice_are_merged_and_of_numbers_the_last_counts() -> None:
    file = schema()
    kind = class_of(file)
    parts = [kind(double=1.0, doubles=[1.0]), kind(double=2.0, doubles=[2.0, 3.0])]
    parts[0].one.double, parts[1].one.float = 5.0, 6.0
    raw = b"".join(part.SerializeToString() for part in parts)
    table = table_of(channel_of(file), [raw], "double", "doubles[*]", "one.double", "one.float")
    merged = kind.FromString(raw)
    assert [table.columns[path][0] for path in ("double", "one.double", "one.float")] == [2.0, 5.0, 6.0]
    assert table.columns["doubles[*]"].tolist() == [list(merged.doubles)]


def test_fields_of_any_type_are_found_for_wheels_by_their_names() -> None:
    assert "one.sint32" in number_fields(channel_of(schema()))
    text = json.dumps({"properties": {"left": {"type": "integer"}, "b": {"properties": {"x": {"type": "number"}}}}})
    assert number_fields(json_channel(text)) == ["left", "b.x"]
    assert number_fields(channel_of(b"\xff" * 9)) == []


@PATIENT
@given(st.binary(max_size=300))
def test_bytes_of_any_kind_are_a_protobuf_message_or_none(raw: bytes) -> None:
    table = table_of(channel_of(schema()), [raw], *SCALARS, "many[*].double", "again.again.double", "loose_int32s[*]")
    assert len(table) + table.unreadable == 1


@PATIENT
@given(st.data())
def test_a_damaged_protobuf_message_is_read_or_left_out_and_those_beside_it_stay(data: st.DataObject) -> None:
    file = schema()
    message = class_of(file)(double=1.5, sint64=-7, strings=["a", "b"], doubles=[1.0, 2.0])
    message.many.add(uint32=300)
    whole = message.SerializeToString()
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(damaged[: data.draw(st.integers(0, len(whole)))])
    table = table_of(channel_of(file), [whole, cut, whole], "double", "many[*].uint32", "strings[*]")
    assert len(table) + table.unreadable == 3
    assert table.columns["double"][[0, -1]].tolist() == [1.5, 1.5]


@PATIENT
@given(st.binary(max_size=400))
def test_bytes_of_any_kind_are_a_schema_or_refused(raw: bytes) -> None:
    with pytest.raises(DefinitionError):
        collector_for(channel_of(raw), ("double",))


def nested(depth: int) -> bytes:
    """Return a schema whose message types lie within one another."""
    raw = b""
    for _ in range(depth):
        raw = b"\x0a\x01T" + (b"\x1a" + varint(len(raw)) + raw if raw else b"")
    body = b"\x22" + varint(len(raw)) + raw
    return b"\x0a" + varint(len(body)) + body


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


SCHEMAS = {
    "types within one another": nested(5000),
    "as many as messages of ROS may nest, and one": nested(33),
    "many types": b"\x0a" + varint(5 * 60_000) + b"\x22\x03\x0a\x01T" * 60_000,
    "many fields": b"\x0a" + varint(6 + 5 * 60_000) + b"\x22" + varint(5 * 60_000) + b"\x12\x03\x0a\x01f" * 60_000,
    "too long": bytes(LONGEST_DESCRIPTORS + 1),
    "fields without a name": b"\x0a\x80\x80\x80",
}


@pytest.mark.parametrize("raw", SCHEMAS.values(), ids=SCHEMAS)
def test_a_schema_made_to_take_time_is_refused(raw: bytes) -> None:
    begin = time.process_time()
    with pytest.raises(DefinitionError):
        collector_for(channel_of(raw, "T"), ("f",))
    assert time.process_time() - begin < LONGEST_S


@pytest.mark.parametrize("depth", [1, 2, DEEPEST])
def test_types_within_one_another_are_read_as_deep_as_messages_of_ros(depth: int) -> None:
    names = [".".join("T" * count) for count in range(1, depth + 1)]
    assert [*descriptors_of(nested(depth).decode("latin-1"), "T")] == names


def part(number: int, content: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(content)) + content


def test_a_long_name_before_thousands_of_types_is_refused_and_takes_no_memory() -> None:
    """Each of them has the name of the type that it lies in before its own; before, these took 2 GB."""
    inner = b"".join(part(3, part(1, b"%d" % number)) for number in range(4000))
    raw = part(1, part(4, part(1, b"T")) + part(4, part(1, b"N" * 500_000) + inner))
    tracemalloc.start()
    with pytest.raises(DefinitionError):
        descriptors_of(raw.decode("latin-1"), "T")
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 20e6


def test_types_of_long_names_stay_apart() -> None:
    longest = "N" * (LONGEST_TEXT - 2)
    raw = part(1, part(4, part(1, longest.encode()) + part(3, part(1, b"a")) + part(3, part(1, b"b"))))
    assert {*descriptors_of(raw.decode("latin-1"), longest)} == {longest, f"{longest}.a", f"{longest}.b"}
    over = part(1, part(4, part(1, longest.encode()) + part(3, part(1, b"aa"))))
    with pytest.raises(DefinitionError, match="name"):
        descriptors_of(over.decode("latin-1"), longest)


@pytest.mark.parametrize("other", [b"\x08\x07", b"\x09" + bytes(8), b"\x0d" + bytes(4)], ids=["number", "64", "32"])
def test_what_is_no_file_among_the_files_of_a_schema_is_passed_over(other: bytes) -> None:
    raw = other + descriptor_pb2.FileDescriptorSet(file=[schema()]).SerializeToString() + other
    assert table_of(channel_of(raw), [b""], "double").columns["double"].tolist() == [0.0]


OTHER_WIRES = {"number": b"\x01", "64": bytes(range(8)), "text": b"\x08(a(a(a(a", "32": bytes(range(4))}
"""Content of a field by what stands in it; their order gives the wire types 0, 1, 2 and 5."""


@pytest.mark.parametrize("content", OTHER_WIRES)
def test_a_field_of_another_wire_type_is_passed_over_as_by_google_s_library(content: str) -> None:
    file = schema()
    kind, wire = class_of(file), [0, 1, 2, 5][[*OTHER_WIRES].index(content)]
    known = kind(double=2.5, int32=-4, fixed32=9, string="s", strings=["a"], doubles=[1.0], loose_int32s=[6], sint64=-3)
    known.one.uint32, known.many.add().float = 8, 0.5
    raw = known.SerializeToString()
    for one in kind.DESCRIPTOR.fields:
        other = raw + varint(one.number << 3 | wire) + OTHER_WIRES[content] + raw
        merged = kind.FromString(other)
        table = table_of(channel_of(file), [other], "double", "one.uint32", "strings[*]", "many[*].float", *SCALARS)
        assert len(table) == 1, one.name
        check(table, "one.uint32", [merged.one.uint32])
        check(table, "many[*].float", [[inner.float for inner in merged.many]])
        check(table, "strings[*]", [list(merged.strings)])
        for name in SCALARS:
            check(table, name, [getattr(merged, name)])


def test_a_type_that_refers_to_itself_is_followed_as_far_as_a_path_goes() -> None:
    file = schema()
    deep = class_of(file)(double=9.0)
    raw = deep.SerializeToString()
    for _ in range(3):
        raw = varint(203 << 3 | 2) + varint(len(raw)) + raw
    bomb = b""
    for _ in range(3000):
        bomb = varint(203 << 3 | 2) + varint(len(bomb)) + bomb
    table = table_of(channel_of(file), [raw, bomb], "again.again.again.double")
    np.testing.assert_array_equal(table.columns["again.again.again.double"], [9.0, 0.0])


BOMBS = {
    "small fields": b"\x08\x01" * 500_000,
    "empty texts": b"\x0a\x00" * 500_000,
    "a packed list": varint(105 << 3 | 2) + varint(1_000_000) + bytes(1_000_000),
    "messages in a list": (varint(201 << 3 | 2) + b"\x00") * 300_000,
    "longer than any": bytes(LONGEST_MESSAGE_BYTES + 1),
}


@pytest.mark.parametrize("raw", BOMBS.values(), ids=BOMBS)
def test_a_message_made_to_take_time_takes_none(raw: bytes) -> None:
    begin = time.process_time()
    table = table_of(channel_of(schema()), [raw] * 20, "double", "int32s[*]", "many[*].double")
    assert len(table) + table.unreadable == 20
    assert time.process_time() - begin < LONGEST_S


def test_a_message_is_read_by_its_wanted_fields_alone() -> None:
    """With all fields of a type that has thousands, each of a million empty messages in a list would take 40 kB."""
    paths = [decoding_steps(path) for path in ("many[*].double", "again.again.sint32", "again.double")]
    message = protobuf_parser(descriptors_of(channel_of(schema()).definition, "t.All"), "t.All", paths)(b"")
    known: list[tuple[str, list[str]]] = []

    def add(kind: Any) -> None:
        known.append((kind.name, [one.name for one in kind.fields]))
        for one in kind.fields:
            if one.message_type is not None:
                add(one.message_type)

    add(message.DESCRIPTOR)
    assert [names for _, names in known] == [["many", "again"], ["double"], ["double", "again"], ["sint32"]]
    assert len({name for name, _ in known}) == 4


def test_the_library_of_protobuf_is_loaded_for_protobuf_alone() -> None:
    code = (
        "import sys\n"
        "from icrtool.logs.containers.container import Channel\n"
        "from icrtool.logs.messages.topic_table import collector_for\n"
        "collector_for(Channel(0, 't', 'T', 'json', ''), ('a',))\n"
        "print('google.protobuf' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_a_text_that_is_no_utf_8_is_read_with_replacements() -> None:
    raw = part(14, b"a\xff") + varint(1 << 3 | 1) + struct.pack("<d", 2.0)
    table = table_of(channel_of(schema()), [raw], "double", "string")
    assert (table.columns["double"].tolist(), table.texts["string"]) == ([2.0], ["a\ufffd"])


def test_a_schema_is_read_without_the_files_that_it_imports() -> None:
    file = schema()
    file.dependency.append("google/protobuf/timestamp.proto")
    time_of = file.message_type[0].field.add(name="time", number=300, type=11, label=FIELD.LABEL_OPTIONAL)
    time_of.type_name = ".google.protobuf.Timestamp"
    raw = class_of(schema())(double=2.0).SerializeToString() + part(300, b"\x08\x07")
    table = table_of(channel_of(file), [raw], "double", "time.seconds")
    assert {path: values.tolist() for path, values in table.columns.items()} == {"double": [2.0]}


def test_an_enumeration_is_its_number_also_where_that_has_no_name() -> None:
    file = schema(syntax="proto2")
    file.enum_type.add(name="Quality").value.add(name="NONE", number=0)
    quality = file.message_type[0].field.add(name="quality", number=300, type=14, label=FIELD.LABEL_OPTIONAL)
    quality.type_name = ".t.Quality"
    raw = varint(300 << 3) + varint(4)
    assert table_of(channel_of(file), [raw], "quality").columns["quality"].tolist() == [4]


@pytest.mark.parametrize("number", [0, 2], ids=["none that is allowed", "that of another"])
def test_a_wanted_field_with_a_wrong_number_is_refused(number: int) -> None:
    file = descriptor_pb2.FileDescriptorProto(name="o.proto", package="t", syntax="proto3")
    kind = file.message_type.add(name="All")
    for name, of_field in (("a", number), ("b", 2)):
        kind.field.add(name=name, number=of_field, type=1, label=FIELD.LABEL_OPTIONAL)
    with pytest.raises(DefinitionError, match="number"):
        collector_for(channel_of(file), ("a", "b"))


def test_the_schema_of_a_real_library_with_all_its_files_is_read() -> None:
    raw = build_file_descriptor_set(SceneUpdate).SerializeToString()
    message = SceneUpdate()
    message.entities.add(frame_id="map").timestamp.seconds = 4
    channel = channel_of(raw, "foxglove.SceneUpdate")
    table = table_of(channel, [message.SerializeToString()], "entities[*].frame_id", "entities[*].timestamp.seconds")
    assert table.texts["entities[*].frame_id"] == ["map"]
    assert table.columns["entities[*].timestamp.seconds"].tolist() == [[4]]


def test_what_a_json_message_holds_is_read() -> None:
    text = json.dumps({"properties": {
        "a": {"type": "number"}, "n": {"type": ["integer", "null"]}, "e": {"oneOf": []}, "s": {"type": "string"},
        "b": {"type": "boolean"}, "l": {"type": "array", "items": {"type": "number"}},
        "o": {"type": "object", "properties": {"m": {"type": "array", "items": {"properties": {"x": {"type": "number"}},
                                                                                "type": "object"}}}},
    }})  # fmt: skip
    messages = [
        {"a": 1, "n": 2**40, "e": 3, "s": "x", "b": True, "l": [1, 2.5, None], "o": {"m": [{"x": 1}, {}, {"x": 3}]}},
        {"a": None, "n": None, "l": [], "o": None, "extra": {"deep": [[[]]]}},
        {"a": float("nan"), "n": 1.0, "s": "é", "l": "text", "o": {"m": [{"x": 1e300}, 7]}},
        {"a": 10**400, "n": 10**30, "s": 4, "l": [float("-inf")]},
    ]
    raw = [json.dumps(message).encode() for message in messages]
    wanted = ("a", "n", "e", "s", "b", "l[*]", "l[1]", "o.m[*].x", "nothing")
    table = table_of(json_channel(text), raw, *wanted)
    assert (len(table), set(wanted) - set(table.columns)) == (4, {"nothing"})
    np.testing.assert_array_equal(table.columns["a"], [1.0, math.nan, math.nan, math.inf])
    assert table.columns["n"].tolist() == [2**40, 0, 1, 0]
    assert [table.texts["s"][one] for one in table.columns["s"]] == ["x", "", "é", ""]
    np.testing.assert_array_equal(table.columns["l[1]"], [2.5, math.nan, math.nan, math.nan])
    np.testing.assert_array_equal(table.columns["l[*]"][0], [1.0, 2.5, math.nan])
    np.testing.assert_array_equal(table.columns["o.m[*].x"][0], [1.0, math.nan, 3.0])
    assert math.isinf(table.columns["o.m[*].x"][2, 0])  # larger than any quantity


@PATIENT
@given(st.binary(max_size=200) | JSON.map(lambda value: json.dumps(value).encode()))
def test_a_json_message_of_any_kind_is_read_or_left_out(raw: bytes) -> None:
    table = table_of(json_channel(), [raw, b'{"a": 4}'], "a", "a[*]", "o.a", "b[2]", "header.frame_id")
    assert len(table) + table.unreadable == 2
    assert table.columns["a"][-1] == 4.0


JSON_BOMBS = {
    "lists in lists": b"[" * 200_000,
    "objects in objects": b'{"a":' * 150_000,
    "balanced": b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "many small objects": b'{"a": [' + b"{}," * 300_000 + b"{}]}",
    "many keys": json.dumps({f"k{i}": i for i in range(70_000)}).encode(),
    "a number of many digits": b'{"a": ' + b"9" * 900_000 + b"}",
    "NaN and a number of many digits": b'{"b": NaN, "a": ' + b"9" * 900_000 + b"}",
    "NaN in lists": b"NaN" + b"[" * 200_000,
    "longer than any": b'{"a": "' + b"x" * LONGEST_MESSAGE_BYTES + b'"}',
}


@pytest.mark.parametrize("raw", JSON_BOMBS.values(), ids=JSON_BOMBS)
def test_a_json_message_made_to_take_time_takes_none(raw: bytes) -> None:
    begin = time.process_time()
    table = table_of(json_channel(), [raw] * 5, "a", "a[*]")
    assert len(table) + table.unreadable == 5
    assert time.process_time() - begin < LONGEST_S


def test_of_large_messages_the_wanted_values_alone_are_kept() -> None:
    raw = JSON_BOMBS["many small objects"]
    tracemalloc.start()
    table_of(json_channel(), [raw] * 6, "a", "a[*]")
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 6 * len(raw) + 100e6


@pytest.mark.parametrize(
    "text", ["{", "[" * 100_000, json.dumps({"properties": {f"f{i}": {} for i in range(30_000)}}), " " * 2_000_000]
)
def test_a_json_schema_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(DefinitionError):
        collector_for(json_channel(text), ("a",))


@pytest.mark.parametrize("text", ["", "{}", "[]", "7", '{"properties": []}', '{"properties": {"a": 7}}'])
def test_a_json_schema_without_fields_leaves_it_to_the_messages(text: str) -> None:
    assert table_of(json_channel(text), [b'{"a": 2}'], "a").columns["a"].tolist() == [2.0]


def test_stamps_and_frames_have_the_names_of_a_header() -> None:
    message = {"timestamp": {"sec": 4, "nsec": 5}, "frame_id": "map"}
    table = table_of(
        json_channel(), [json.dumps(message).encode()], "header.stamp.sec", "header.stamp.nanosec", "header.frame_id"
    )
    assert (table.columns["header.stamp.sec"][0], table.columns["header.stamp.nanosec"][0]) == (4, 5)
    assert table.text("header.frame_id") == "map"


def test_a_message_of_lists_within_lists_is_refused_in_other_serializations() -> None:
    channel = Channel(0, LogText("/t"), LogText("control_msgs/DynamicJointState"), LogText("json"))
    with pytest.raises(DefinitionError):
        collector_for(channel, ("name[*]",))


def test_doubles_are_read_bit_for_bit() -> None:
    values = np.random.default_rng(1).integers(0, 2**63, 200).view(np.float64)
    raw = [varint(1 << 3 | 1) + struct.pack("<d", value) for value in values]
    column = table_of(channel_of(schema()), raw, "double").columns["double"]
    usual = np.abs(values) < 1e30
    assert column[usual].tobytes() == values[usual].tobytes()
