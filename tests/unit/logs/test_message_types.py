"""Every message type that a role is read from, against another library's decode of the same log, column by column.

One log a container holds every type, its numbers and texts drawn; rosbags and mcap write it and read it back.
"""

from __future__ import annotations

import functools
import re
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from mcap_ros1.decoder import DecoderFactory as Ros1Decoder
from mcap_ros2.decoder import DecoderFactory as Ros2Decoder
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from icrtool.logs.messages.decoded_values import NMEA_SENTENCE
from icrtool.logs.messages.topic_table import DYNAMIC_JOINT_STATE, HEADER, TopicTable
from icrtool.logs.read_log import survey_log
from icrtool.logs.streams.assembly import Survey
from icrtool.logs.streams.message_types import MESSAGE_TYPES
from icrtool.logs.streams.wheel_pairs import BYTE_TYPES, PAIR_TYPES
from icrtool.records.samples import ROLE_WORDS, Role
from support.tables import fields_of

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
START_NS, STEP_NS = 1_760_000_000_000_000_000, 10_000_000
MESSAGES = 8
TYPES = sorted(name for name in {*PAIR_TYPES}.union(*MESSAGE_TYPES.values()) if "/" in name and name != NMEA_SENTENCE)
"""Of ROS, but sentences, of which more columns are made than the message has fields (test_nmea.py)."""
CONTAINERS = ("bag", "db3", "db3 big-endian", "db3 without definitions", "mcap cdr", "mcap idl", "mcap ros1")
ROS1 = ("bag", "mcap ros1")
INTERFACES = ("position", "velocity", "effort")


@dataclass(frozen=True)
class Written:
    path: Path
    survey: Survey
    decoded: dict[str, list[Any]]
    """By topic: messages in log-time order as the other library decodes them."""


def full(message_type: str) -> str:
    return message_type.replace("/", "/msg/")


def topic_of(message_type: str) -> str:
    # A number of 8 bits may be the state of a lamp: the topic's name states that it is of wheels.
    side = "left_wheel_" if message_type in BYTE_TYPES else "left_" if message_type in PAIR_TYPES else ""
    return f"/robot_7/{side}{message_type.replace('/', '_')}"


def paths_of(message_type: str) -> tuple[str, ...]:
    paths = (path for role in ROLE_WORDS for path in fields_of(role, message_type))
    return (*HEADER, *(dict.fromkeys(paths) or ("data",)))


def camel(text: str) -> str:
    """Spell u-blox fields as the ROS 1 package does: ``h_acc`` is ``hAcc``, ``rel_pos_hpn`` is ``relPosHPN``."""
    text = re.sub(r"_hp([ned])\b", lambda m: "HP" + m[1].upper(), text)
    return re.sub(r"(?<=[a-z])_([a-z])", lambda m: m[1].upper(), text).replace("invalidLlh", "invalid_llh")


@functools.cache
def make_store(*, ros1: bool) -> Typestore:
    """Return the types of a ROS version; kept, since the other library compiles code for each type."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for package in resources.files("icrtool.logs.messages").joinpath("definitions").iterdir():
        for file in package.iterdir() if package.is_dir() else ():
            text = file.read_text(encoding="utf-8")
            # ROS 2 allows no capitals in a field's name.
            spelled = text if ros1 else re.sub(r"_L(\d)_", r"_l\1_", text)
            spelled = camel(spelled) if ros1 and package.name == "ublox_msgs" else spelled
            store.register(get_types_from_msg(spelled, f"{package.name}/msg/{file.name.removesuffix('.msg')}"))
    return store


def draw_number(kind: str, rng: np.random.Generator) -> Any:
    dtype = np.dtype({"octet": "uint8", "byte": "uint8", "char": "uint8"}.get(kind, kind))
    if dtype.kind == "b":
        return bool(rng.integers(2))
    if dtype.kind == "f":
        special = rng.random()
        value = np.nan if special < 0.08 else 0.0 if special < 0.12 else rng.normal() * 10.0 ** rng.integers(-6, 7)
        return dtype.type(value).item()
    least = 0 if dtype.kind == "u" or kind == "int32" else np.iinfo(dtype).min
    return int(rng.integers(least, min(np.iinfo(dtype).max, 2**62), endpoint=True))


def draw_text(rng: np.random.Generator) -> str:
    return "".join(rng.choice([*"abcdeXYZ_/µ"], int(rng.integers(0, 14))))


def draw(store: Typestore, name: str, rng: np.random.Generator) -> Any:
    """Draw a message: every number, the length of every text and list."""
    if name == full("control_msgs/InterfaceValue"):
        told = rng.permutation(INTERFACES)[: rng.integers(0, 4)].tolist()
        return store.types[name](told, np.array([draw_number("float64", rng) for _ in told]))
    values = []
    joints = int(rng.integers(0, 4 if rng.random() < 0.9 else 12))
    for field, (node, detail) in store.fielddefs[name][1]:
        if int(node) == NAME:
            values.append(draw(store, detail, rng))
        elif int(node) == BASE:
            values.append(draw_text(rng) if detail[0] == "string" else draw_number(detail[0], rng))
            if field == "nanosec":
                values[-1] %= 10**9
        else:
            (kind, inner), count = detail
            same = field.startswith(("joint_names", "interface_values"))
            length = count if int(node) == ARRAY else joints if same else int(rng.integers(0, 13))
            values.append(draw_many(store, int(kind), inner, length, rng))
    return store.types[name](*values)


def draw_many(store: Typestore, kind: int, inner: Any, length: int, rng: np.random.Generator) -> Any:
    if kind == NAME:
        return [draw(store, inner, rng) for _ in range(length)]
    if inner[0] == "string":
        return [draw_text(rng) for _ in range(length)]
    return np.array([draw_number(inner[0], rng) for _ in range(length)], dtype=inner[0])


def idl_of(store: Typestore, name: str) -> str:
    """Write a type and all it refers to as rosbag2 writes IDL definitions into an MCAP file."""
    parts: dict[str, str] = {}

    def member(field: str, node: int, detail: Any) -> str:
        if node in (ARRAY, SEQUENCE):
            inner = member("", int(detail[0][0]), detail[0][1]).strip()
            return f"{inner}__{detail[1]} {field}" if node == ARRAY else f"sequence<{inner}> {field}"
        if node == NAME:
            add(detail)
            return f"{detail.replace('/', '::')} {field}"
        spelled = {"bool": "boolean", "float32": "float", "float64": "double"}.get(detail[0], detail[0])
        return f"{spelled} {field}"

    def add(of: str) -> None:
        package, _, short = of.split("/")
        aliases, lines = [], []
        parts[of] = ""
        for field, (node, detail) in store.fielddefs[of][1]:
            line = member(field, int(node), detail)
            if int(node) == ARRAY:
                alias = re.sub(r"\W+", "_", line.split(" ")[0])
                aliases.append(f"typedef {line.split('__')[0]} {alias}[{detail[1]}];")
                line = f"{alias} {field}"
            lines.append(f"{line};")
        body = "\n".join([*aliases, f"struct {short} {{", *lines, "};"])
        parts[of] = f"module {package} {{ module msg {{\n{body}\n}}; }};\n"

    add(name)
    ordered = [name, *(other for other in parts if other != name)]
    return "".join(f"{'=' * 80}\nIDL: {of}\n{parts[of]}" for of in ordered)


def write_bag(path: Path, topics: dict[str, tuple[str, list[Any]]], store: Typestore) -> Path:
    with Ros1Writer(path.with_suffix(".bag")) as bag:
        for topic, (message_type, messages) in topics.items():
            connection = bag.add_connection(topic, full(message_type), typestore=store)
            for i, message in enumerate(messages):
                bag.write(connection, START_NS + i * STEP_NS, store.serialize_ros1(message, full(message_type)))
    return path.with_suffix(".bag")


def write_directory(
    path: Path,
    topics: dict[str, tuple[str, list[Any]]],
    store: Typestore,
    *,
    big_endian: bool = False,
    version: int = 9,
) -> Path:
    with Ros2Writer(path, version=version, storage_plugin=StoragePlugin.SQLITE3) as bag:  # type: ignore[arg-type]
        for topic, (message_type, messages) in topics.items():
            connection = bag.add_connection(topic, full(message_type), typestore=store)
            for i, message in enumerate(messages):
                raw = store.serialize_cdr(message, full(message_type), little_endian=not big_endian)
                bag.write(connection, START_NS + i * STEP_NS, raw)
    return path


def forget_definitions(directory: Path) -> None:
    """Leave the database as ROS 2 Humble writes it: types by name only."""
    import sqlite3

    for file in directory.glob("*.db3"):
        database = sqlite3.connect(file)
        database.execute("DELETE FROM message_definitions")
        database.commit()
        database.close()


def write_mcap(path: Path, topics: dict[str, tuple[str, list[Any]]], store: Typestore, schema: str = "ros2msg") -> Path:
    ros1 = schema == "ros1msg"
    path = path.with_suffix(".mcap")
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros1" if ros1 else "ros2", library="test")
        for topic, (message_type, messages) in topics.items():
            name = full(message_type)
            text = idl_of(store, name) if schema == "ros2idl" else store.generate_msgdef(name, ros_version=2 - ros1)[0]
            kind = writer.register_schema(message_type if ros1 else name, schema, text.encode())
            channel = writer.register_channel(topic, "ros1" if ros1 else "cdr", kind)
            encode = store.serialize_ros1 if ros1 else store.serialize_cdr
            for i, message in enumerate(messages):
                stamp_ns = START_NS + i * STEP_NS
                writer.add_message(channel, stamp_ns, bytes(encode(message, name)), stamp_ns)
        writer.finish()
    return path


def decode_rosbags(path: Path, store: Typestore | None = None) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    with AnyReader([path], default_typestore=store) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    return found


def decode_mcap(path: Path, decoder: Any) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        for _, channel, _, message in make_reader(stream, decoder_factories=[decoder]).iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Written]:
    """Write a log of every type in a container, once; read it with icrtool and with the other library."""
    folder, done = tmp_path_factory.mktemp("types"), {}

    @functools.cache
    def topics_for(*, ros1: bool) -> dict[str, tuple[str, list[Any]]]:
        store = make_store(ros1=ros1)
        rng = np.random.default_rng(20261121)
        topics = {}
        for message_type in TYPES:
            messages = [draw(store, full(message_type), rng) for _ in range(MESSAGES)]
            topics[topic_of(message_type)] = (message_type, messages)
            if message_type in PAIR_TYPES:
                topics[topic_of(message_type).replace("left_", "right_")] = (message_type, messages)
        return topics

    def write(container: str) -> Written:
        store = make_store(ros1=container in ROS1)
        topics, path = topics_for(ros1=container in ROS1), folder / container.replace(" ", "_")
        match container:
            case "bag":
                path = write_bag(path, topics, store)
                decoded = decode_rosbags(path)
            case "mcap cdr":
                path = write_mcap(path, topics, store)
                decoded = decode_mcap(path, Ros2Decoder())
            case "mcap ros1":
                path = write_mcap(path, topics, store, "ros1msg")
                decoded = decode_mcap(path, Ros1Decoder())
            case "mcap idl":
                path = write_mcap(path, topics, store, "ros2idl")
                decoded = get("mcap cdr").decoded  # of the same messages
            case "db3 without definitions":
                path = shutil.copytree(get("db3").path, path)
                forget_definitions(path)
                decoded = get("db3").decoded
            case _:
                path = write_directory(path, topics, store, big_endian="big-endian" in container)
                decoded = decode_rosbags(path, store)
        # with all columns, also those that candidates were made of
        with mock.patch("icrtool.logs.streams.select.drop_used_columns"):
            return Written(path, survey_log(path), decoded)

    def get(container: str) -> Written:
        if container not in done:
            done[container] = write(container)
        return done[container]

    return get


def pick(message: Any, path: str) -> Any:
    """Return what a message holds at a path: a number, a text, or a list; None where it has no such field."""
    values = [message]
    listed = False
    for step in path.split("."):
        name, _, element = step.partition("[")
        renamed = {"sec": "secs", "nanosec": "nsecs"}.get(name, name)
        values = [getattr(value, name, getattr(value, renamed, None)) for value in values]
        if any(value is None for value in values):
            return None
        if element == "*]":
            values, listed = [one for value in values for one in value], True
        elif element:
            values = [value[int(element[:-1])] for value in values]
    return values if listed else values[0]


def has_field(store: Typestore, name: str, path: str) -> bool:
    step, _, rest = path.partition(".")
    fields = dict(store.fielddefs[name][1])
    node, detail = fields.get(step.partition("[")[0], (0, None))
    inner = detail[0] if int(node) in (ARRAY, SEQUENCE) else (node, detail)
    return bool(node) and (not rest or has_field(store, inner[1], rest))


def check_column(table: TopicTable, path: str, told: list[Any]) -> None:
    """Hold a column against the values another library read: exactly, texts as texts, NaN where NaN."""
    column = table.columns[path]
    assert len(column) == len(told)
    if not isinstance(told[0], list):
        check_values(table, path, column, told)
        return
    assert column.shape[1] == max(len(values) for values in told)
    for row, values in zip(column, told, strict=True):
        check_values(table, path, row[: len(values)], values)
        rest = row[len(values) :]
        assert np.all(np.isnan(rest) if rest.dtype.kind == "f" else rest == (-1 if path in table.texts else 0))


def check_values(table: TopicTable, path: str, column: np.ndarray, told: list[Any]) -> None:
    if path in table.texts:
        assert [table.texts[path][code] for code in column] == told
    elif column.dtype == np.float64:
        expected = np.array(told, np.float64)
        assert np.array_equal(np.isnan(column), np.isnan(expected))
        known = ~np.isnan(expected)
        assert column[known].tobytes() == expected[known].tobytes()
    else:
        assert column.tolist() == [int(value) for value in told]


def joint_lists(message: Any, path: str) -> list[Any]:
    """Return a DynamicJointState's list as a JointState would have it."""
    if path == "name[*]":
        return list(message.joint_names)
    quantity = path.removesuffix("[*]")
    told = [dict(zip(v.interface_names, v.values, strict=True)) for v in message.interface_values]
    return [interfaces.get(quantity, np.nan) for interfaces in told]


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("message_type", TYPES)
def test_every_wanted_column_is_what_another_library_decodes(
    logs: Callable[[str], Written], message_type: str, container: str
) -> None:
    written = logs(container)
    (table,) = (table for table in written.survey.tables if table.topic == topic_of(message_type))
    messages = written.decoded[table.topic]
    store = make_store(ros1=container in ROS1)
    assert table.unreadable == 0
    assert table.log_time_ns.tolist() == [START_NS + i * STEP_NS for i in range(MESSAGES)]
    for path in paths_of(message_type):
        if message_type == DYNAMIC_JOINT_STATE and path.endswith("[*]"):
            check_column(table, path, [joint_lists(message, path) for message in messages])
        elif has_field(store, full(message_type), path):
            check_column(table, path, [pick(message, path) for message in messages])
        else:
            assert path not in table.columns


@pytest.mark.parametrize("message_type", TYPES)
def test_the_fields_a_reader_asks_for_exist_in_one_spelling_or_the_other(message_type: str) -> None:
    spellings = [make_store(ros1=ros1) for ros1 in (False, True)]
    optional = {*HEADER, "lateral_velocity", "invalidLlh"} | ({"flags"} if "HPPOSLLH" in message_type else set())
    if message_type == DYNAMIC_JOINT_STATE:
        optional |= {"name[*]", "position[*]", "velocity[*]"}
    for path in set(paths_of(message_type)) - optional:
        assert any(has_field(store, full(message_type), path) for store in spellings), path


@pytest.mark.parametrize("container", CONTAINERS)
def test_every_topic_is_a_candidate_of_its_roles(logs: Callable[[str], Written], container: str) -> None:
    found = logs(container).survey.candidates
    topics = {
        role: {topic for source in sources for topic in source.topic.split(" + ")}
        for role, sources in (("wheels", found.wheels), ("gnss", found.gnss), ("heading", found.heading))
    }
    assert topics["wheels"] >= {topic_of(name) for name in TYPES if name in {*MESSAGE_TYPES["wheels"], *PAIR_TYPES}}
    assert topics["gnss"] == {topic_of(name) for name in TYPES if name in MESSAGE_TYPES["gnss"]}
    assert topics["heading"] == {topic_of(name) for name in TYPES if name in MESSAGE_TYPES["heading"]}
    assert found.unread == {}


def test_definitions_that_the_log_lacks_come_from_the_bundle(logs: Callable[[str], Written]) -> None:
    assert {table.message_type for table in logs("db3 without definitions").survey.tables} == set(TYPES)


def without(store: Typestore, name: str, dropped: str) -> Typestore:
    """Return a message type, and those in it, with one field taken out."""
    changed, kept, open_names = Typestore(), {}, [name]
    while open_names:
        of = open_names.pop()
        constants, fields = store.fielddefs[of]
        kept[of] = (constants, [field for field in fields if (of, field[0]) != (name, dropped)])
        for _, (node, detail) in kept[of][1]:
            inner = detail[0] if int(node) in (ARRAY, SEQUENCE) else (node, detail)
            open_names += [inner[1]] if int(inner[0]) == NAME and inner[1] not in kept else []
    changed.register(kept)
    # The code for the types in it is that for the whole type.
    changed.cache |= {of: store.get_msgdef(of) for of in kept if of != name}
    return changed


ROWS = {repr([types.get(name) for types in MESSAGE_TYPES.values()]): name for name in TYPES}
"""A type for each kind of rows: those of others are read alike."""


def top_fields(message_type: str) -> Iterable[str]:
    """Return the fields of a type; header and stamp of one type alone."""
    if message_type == DYNAMIC_JOINT_STATE:
        return ("header", "joint_names", "interface_values")
    paths = set(paths_of(message_type)) - ({*HEADER} if message_type != "sensor_msgs/NavSatFix" else set())
    return sorted({re.split(r"[.\[]", path)[0] for path in paths})


def test_a_type_that_lacks_a_field_is_read_without_it_or_refused_in_words(tmp_path: Path) -> None:
    store, rng = make_store(ros1=False), np.random.default_rng(5)
    path = tmp_path / "lacking.mcap"
    dropped: dict[str, str] = {}
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        for message_type in ROWS.values():
            present = [name for name, _ in store.fielddefs[full(message_type)][1]]
            for field in (field for field in top_fields(message_type) if field in present and len(present) > 1):
                changed = without(store, full(message_type), field)
                text = changed.generate_msgdef(full(message_type), ros_version=2)[0]
                schema = writer.register_schema(full(message_type), "ros2msg", text.encode())
                topic = f"{topic_of(message_type)}/without_{field}"
                channel = writer.register_channel(topic, "cdr", schema)
                dropped[topic] = field
                for i in range(2):
                    raw = changed.serialize_cdr(draw(changed, full(message_type), rng), full(message_type))
                    writer.add_message(channel, START_NS + i, bytes(raw), START_NS + i)
        writer.finish()
    survey = survey_log(path)
    found = survey.candidates
    told = {
        (role, source.topic): source.problem
        for role, sources in (("wheels", found.wheels), ("gnss", found.gnss), ("heading", found.heading))
        for source in sources
    }
    required: dict[Role, set[str]] = {
        "gnss": {"latitude", "longitude", "lat", "lon", "pose"},
        "heading": {"orientation", "azimuth", "unit", "quaternion", "pose"},
        "wheels": {"name", "linear", "angular", "linear_velocity", "angular_velocity", "twist"},
    }
    for role, needed in required.items():
        for topic, field in dropped.items():
            if field in needed and topic.split("/")[2] in {
                topic_of(name).split("/")[2] for name in MESSAGE_TYPES[role]
            }:
                taken = {
                    path for name in MESSAGE_TYPES[role] if topic_of(name) in topic for path in fields_of(role, name)
                }
                if any(path.startswith(field) for path in taken):
                    assert field in told[role, topic], (role, topic)
    refused = {f"{topic_of(DYNAMIC_JOINT_STATE)}/without_{field}" for field in ("joint_names", "interface_values")}
    assert set(found.unread) == refused
    assert all("lacks names or values of the joints" in reason for reason in found.unread.values())


def test_a_first_version_of_the_lynx_feedback_without_travel_tells_speeds(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("string joint_name\nfloat32 velocity", "clearpath_motor_msgs/msg/LynxFeedback"))
    name = "clearpath_motor_msgs/msg/LynxMultiFeedback"
    store.register(get_types_from_msg("std_msgs/Header header\nLynxFeedback[] drivers", name))
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "")
    driver = types["clearpath_motor_msgs/msg/LynxFeedback"]
    messages = [
        types[name](header, [driver("front_left_wheel_joint", i + 0.5), driver("front_right_wheel_joint", -i)])
        for i in range(5)
    ]
    path = write_mcap(tmp_path / "lynx", {"/feedback": ("clearpath_motor_msgs/LynxMultiFeedback", messages)}, store)
    (motion,) = survey_log(path).candidates.wheels
    assert motion.position is None
    assert motion.speed is not None
    assert motion.speed[0].tolist() == [0.5, 1.5, 2.5, 3.5, 4.5]


def test_a_damaged_message_is_left_out_and_counted(tmp_path: Path) -> None:
    store, rng = make_store(ros1=False), np.random.default_rng(9)
    path = tmp_path / "damaged.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        for message_type in TYPES:
            name = full(message_type)
            schema = writer.register_schema(name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0].encode())
            channel = writer.register_channel(topic_of(message_type), "cdr", schema)
            twin = writer.register_channel(topic_of(message_type).replace("left_", "right_"), "cdr", schema)
            for i in range(6):
                raw = bytes(store.serialize_cdr(draw(store, name, rng), name))
                stamp_ns = START_NS + i * STEP_NS
                writer.add_message(channel, stamp_ns, raw[: min(5, len(raw) - 1)] if i == 3 else raw, stamp_ns)
                if message_type in PAIR_TYPES:
                    writer.add_message(twin, stamp_ns, raw, stamp_ns)
        writer.finish()
    tables = {table.topic: table for table in survey_log(path).tables}
    for message_type in TYPES:
        table = tables[topic_of(message_type)]
        assert (len(table), table.unreadable) == (5, 1), message_type
