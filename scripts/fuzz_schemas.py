"""MCAP files made of schemas: lengths times counts, in every serialization that is read.

A bound on a length and a bound on a count hold each for themselves, while their product fills the memory. These logs
have long names, many fields, deep nesting, types that are used many times, and many topics, alike or not.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

Random = np.random.Generator
SEPARATOR = "=" * 80 + "\n"
START_NS = 1_760_000_000_000_000_000
LENGTHS, COUNTS, DEPTHS = (1, 8, 40, 200, 511, 513, 5_000, 200_000), (1, 8, 64, 512, 4_000), (0, 1, 2, 8, 31, 40, 200)
TOPICS = (1, 2, 30, 400, 2000)
MOST_CHARACTERS, MOST_FILE_CHARACTERS = 1_200_000, 60_000_000
WORDS = ("wheel_left_speed", "wheel_right_speed", "latitude", "a", "position")
NAMES = (
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/JointState",
    "x/msg/WheelSpeeds",
    "foxglove.LocationFix",
    "nav_msgs/msg/Odometry",
)


def varint(number: int) -> bytes:
    """Return a number as Protobuf writes it."""
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])


def part(number: int, content: bytes) -> bytes:
    """Return a field of bytes as Protobuf writes it."""
    return varint(number << 3 | 2) + varint(len(content)) + content


def json_schema(fields: list[str], steps: list[str], width: int) -> bytes:
    """Return nested objects; `width` of them on each level as long as the text stays short."""
    schema: dict[str, object] = {"type": "object", "properties": {name: {"type": "number"} for name in fields}}
    size = sum(map(len, fields))
    for step in reversed(steps):
        wide = width if size * width < MOST_CHARACTERS else 1
        schema = {"type": "object", "properties": {f"{step}{number}": schema for number in range(wide)}}
        size = size * wide + wide * len(step)
    return json.dumps(schema).encode()


def ros(fields: list[str], steps: list[str], width: int) -> bytes:
    """Return a definition of types that are used `width` times in the next."""
    types = ["\n".join(f"x/T{at} {step}{number}" for number in range(width)) for at, step in enumerate(steps)]
    types.append("\n".join(f"float64 {name}" for name in fields))
    return (types[0] + "".join(f"\n{SEPARATOR}MSG: x/T{at}\n{one}" for at, one in enumerate(types[1:]))).encode()


def idl(fields: list[str], steps: list[str], width: int) -> bytes:
    """Return structures within modules."""
    inner = " ".join(
        f"struct S{number} {{ {' '.join(f'double {name};' for name in fields)} }};" for number in range(width)
    )
    for step in steps:
        inner = f"module {step} {{ {inner} }};"
    return f"module x {{ module msg {{ {inner} }}; }};".encode()


def protobuf(fields: list[str], steps: list[str], width: int) -> bytes:
    """Return a FileDescriptorSet of types that are used `width` times in the next."""
    types = b""
    names = [f"T{at}" for at in range(len(steps) + 1)]
    for at, step in enumerate(steps):
        refers = f".x.T{at + 1}".encode()
        inner = b"".join(
            part(
                2,
                part(1, f"{step}{number}".encode())
                + b"\x18"
                + varint(number + 1)
                + b"\x20\x01\x28\x0b"
                + part(6, refers),
            )
            for number in range(width)
        )
        types += part(4, part(1, names[at].encode()) + inner)
    last = b"".join(
        part(2, part(1, name.encode()) + b"\x18" + varint(number) + b"\x20\x01\x28\x01")
        for number, name in enumerate(fields, 1)
    )
    types += part(4, part(1, names[-1].encode()) + last)
    return part(1, part(1, b"f") + part(2, b"x") + types + part(12, b"proto3"))


WRITERS = (
    ("json", "jsonschema", json_schema),
    ("cdr", "ros2msg", ros),
    ("cdr", "ros2idl", idl),
    ("ros1", "ros1msg", ros),
    ("protobuf", "protobuf", protobuf),
)


def write_log(path: Path, rng: Random) -> tuple[Path, list[str]]:
    """Write a log of topics with schemas of a kind; return it with what was made."""
    from mcap.writer import CompressionType, Writer

    encoding, written, make = WRITERS[int(rng.integers(len(WRITERS)))]
    count, depth = int(rng.choice(COUNTS)), int(rng.choice(DEPTHS))
    length = min(int(rng.choice(LENGTHS)), MOST_CHARACTERS // count)
    long_step = int(rng.choice(LENGTHS))
    word = str(rng.choice(WORDS))
    fields = [f"{word}{'a' * length}{number}" for number in range(count)]
    steps = [f"n{'n' * min(long_step, MOST_CHARACTERS // max(depth, 1))}{at}" for at in range(depth)]
    text = make(fields, steps, int(rng.choice([1, 2, 8])))
    topics = int(min(rng.choice(TOPICS), max(MOST_FILE_CHARACTERS // len(text), 1)))
    alike, name = bool(rng.random() < 0.5), "x.T0" if encoding == "protobuf" else str(rng.choice(NAMES))
    name = name.replace("/msg/", "/") if encoding == "ros1" else name
    with path.open("wb") as stream:
        writer = Writer(
            stream, chunk_size=1 << 26, compression=CompressionType.ZSTD, repeat_schemas=bool(rng.random() < 0.5)
        )
        writer.start("ros2")
        schema = 0
        for number in range(topics):
            if not alike or not number:
                ending = part(1, part(1, b"%d" % number)) if encoding == "protobuf" else b" " * number
                schema = writer.register_schema(name, written, text + ending)
            channel = writer.register_channel(f"/wheel{number}", encoding, schema)
            numbers = struct.pack("<d", 1.0) * 40
            data = {"json": b'{"a": 1.0}', "cdr": b"\0\1\0\0" + numbers, "ros1": numbers}.get(encoding, b"")
            for message in range(2):
                stamp = START_NS + message * 50_000_000
                writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    kind = "alike" if alike else "each its own"
    return path, ["schemas", written, f"{topics} topics {kind}: {count} x {length}, {depth} x {long_step}"]
