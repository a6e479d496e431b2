"""Schemas of long names times many fields, and many of them: refused before anything is made of them."""

from __future__ import annotations

import contextlib
import json
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from google.protobuf import descriptor_pb2
from mcap.writer import CompressionType, Writer

from icrtool.errors import DefinitionError, IcrToolError
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.definition_bounds import MOST_NAME_CHARACTERS, DefinitionBudget
from icrtool.logs.messages.topic_table import collector_for
from icrtool.logs.read_log import survey_log
from icrtool.records.text import LONGEST_TEXT, LogText

SEPARATOR = "=" * 80 + "\n"
FIELD = descriptor_pb2.FieldDescriptorProto
START_NS = 1_760_000_000_000_000_000
LONGEST_S = 2.0
"""CPU time of any small log, as SECURITY.md promises [s]."""


def json_schema(names: list[str], within: list[str]) -> Channel:
    schema: dict[str, object] = {"type": "object", "properties": {name: {"type": "number"} for name in names}}
    for name in reversed(within):
        schema = {"type": "object", "properties": {name: schema}}
    return Channel(0, LogText("/t"), LogText("T"), LogText("json"), json.dumps(schema))


def protobuf(names: list[str], within: list[str]) -> Channel:
    file = descriptor_pb2.FileDescriptorProto(name="t.proto", syntax="proto3")
    kind = file.message_type.add(name="T")
    for name in within:
        kind = kind.nested_type.add(name=name)
    for number, name in enumerate(names, 1):
        kind.field.add(name=name, number=number, type=FIELD.TYPE_DOUBLE, label=FIELD.LABEL_OPTIONAL)
    text = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString().decode("latin-1")
    return Channel(0, LogText("/t"), LogText("T"), LogText("protobuf"), text)


def ros(names: list[str], within: list[str]) -> Channel:
    types = [f"x/T{place} {name}" for place, name in enumerate(within)] + [
        "\n".join(f"float64 {name}" for name in names)
    ]
    text = types[0] + "".join(f"\n{SEPARATOR}MSG: x/T{place}\n{fields}" for place, fields in enumerate(types[1:]))
    return Channel(0, LogText("/t"), LogText("x/T"), LogText("cdr"), text)


def idl(names: list[str], within: list[str]) -> Channel:
    fields = " ".join(f"double {name};" for name in names)
    inner = f"struct T {{ {fields} }};"
    for name in reversed(within):
        inner = f"module {name} {{ {inner} }};"
    text = f"module x {{ module msg {{ {inner} }}; }};"
    return Channel(0, LogText("/t"), LogText("x/T"), LogText("cdr"), text, "idl")


WRITTEN: dict[str, Callable[[list[str], list[str]], Channel]] = {
    "JSON": json_schema, "Protobuf": protobuf, "ROS": ros, "IDL": idl
}  # fmt: skip


@pytest.mark.parametrize("written", WRITTEN)
def test_a_field_of_a_full_name_of_more_than_512_characters_is_refused(written: str) -> None:
    # the full name has the message type, or the steps, before the field
    collector_for(WRITTEN[written](["a" * (LONGEST_TEXT - 20)], []), ("a",))
    with pytest.raises(DefinitionError, match="full name of"):
        collector_for(WRITTEN[written](["a" * (LONGEST_TEXT + 1)], []), ("a",))
    with pytest.raises(DefinitionError, match="full name of"):
        collector_for(WRITTEN[written](["a" * 200], ["b" * 200, "c" * 200]), ("a",))


@pytest.mark.parametrize("written", WRITTEN)
def test_a_long_name_times_many_fields_is_refused_before_anything_is_made(written: str) -> None:
    channel = WRITTEN[written](
        [f"f{number}" for number in range(512)], ["n" * (20_000 if written == "IDL" else 200_000)]
    )
    tracemalloc.start()
    with pytest.raises(DefinitionError):
        collector_for(channel, ("f1",))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 20e6


@pytest.mark.parametrize("written", ["JSON", "ROS"])
def test_names_of_more_than_a_megabyte_together_are_refused(written: str) -> None:
    many = MOST_NAME_CHARACTERS // 400 + 1
    with pytest.raises(DefinitionError, match="1048576 characters"):
        collector_for(WRITTEN[written]([f"f{number:04}" for number in range(many)], ["n" * 396]), ("f1",))


@pytest.mark.parametrize("written", WRITTEN)
@pytest.mark.parametrize("alike", [True, False])
def test_hundreds_of_topics_of_long_definitions_take_no_more_than_one(
    tmp_path: Path, written: str, alike: bool
) -> None:
    """A chunk of some kB may hold 100 MB of them."""
    path, encodings = tmp_path / "log.mcap", {"JSON": "jsonschema", "Protobuf": "protobuf", "IDL": "ros2idl"}
    channel = WRITTEN[written]([f"wheel_left_{number}" for number in range(2000)], ["n" * 30])
    schemas: dict[bytes, int] = {}
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 26, compression=CompressionType.ZSTD, repeat_schemas=False)
        writer.start()
        for number in range(500):
            ending = "" if alike or written == "Protobuf" else " " * (number + 1)
            text = channel.definition.encode("latin-1") + ending.encode()
            if written == "Protobuf" and not alike:
                text += descriptor_pb2.FileDescriptorSet(
                    file=[descriptor_pb2.FileDescriptorProto(name=f"f{number}")]
                ).SerializeToString()
            if text not in schemas:
                name = "x/msg/T" if written in ("ROS", "IDL") else "T"
                schemas[text] = writer.register_schema(name, encodings.get(written, "ros2msg"), text)
            topic = writer.register_channel(f"/wheel{number}", channel.encoding, schemas[text])
            writer.add_message(topic, START_NS + number, b"\0\1\0\0" if channel.encoding == "cdr" else b"", START_NS)
        writer.finish()
    begin = time.process_time()
    with contextlib.suppress(IcrToolError):
        survey_log(path)
    assert time.process_time() - begin < LONGEST_S


@pytest.mark.parametrize("characters", [100_000, 1_200_000])
def test_a_long_definition_that_many_topics_share_is_weighed_once(characters: int) -> None:
    budget, refused = DefinitionBudget(), 0
    channel = idl(["wheel_left"], ["n" * characters])
    channel = replace(channel, definition=channel.definition + "=" * 200)
    begin = time.process_time()
    for _ in range(500):
        try:
            budget.take(channel)
        except DefinitionError:
            refused += 1
    assert time.process_time() - begin < 0.25 * LONGEST_S
    assert refused == (500 if characters > 1_000_000 else 0)
