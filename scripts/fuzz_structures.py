"""Mutations of records of MCAP files and ROS 1 bags whose lengths and checksums fit again afterwards.

Bytes that are changed at random mostly end at a checksum or a length. These get further: a message, a definition, an
index or a count is changed, and all around it is written again.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

Random = np.random.Generator

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK = 3, 4, 5, 6
BAG_MAGIC = b"#ROSBAG V2.0\n"
EXTREMES = [0, 1, 2, 0x7F, 0xFF, 0xFFFF, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF, 1 << 40, (1 << 63) - 1, 1 << 63]
FLOATS = [0.0, 1e-300, 1e300, -1e300, float("inf"), float("nan"), 1e9, -1.0, 3.0e8]
DEFINITIONS = [
    b"float64[99999999] a", b"x/A[] a\n" + b"=" * 80 + b"\nMSG: x/A\nx/A[] a", b"string[] name\nfloat64[] position",
    b"uint8[<=4294967295] data", b"Header header\nHeader header", b"time stamp\nduration d", b"\xff\xfe",
    b"int32 A=99999999999",
    b"wstring a\nchar b", b"string<=5 a", b"geometry_msgs/Quaternion orientation",
]  # fmt: skip
TOPICS = [
    b"",
    b"/\x1b[2J",
    "/\u202e$^{".encode(),
    b"/" + b"n" * 70_000,
    b"/tf_static",
    b"/joint_states",
    b"/gps/fix",
    b"\xff",
]


def spoil(payload: bytearray, rng: Random) -> None:
    """Change a number, a double, or the length of a payload."""
    if not payload:
        return
    at, kind = int(rng.integers(len(payload))), rng.random()
    if kind < 0.4:
        width = int(rng.choice([1, 2, 4, 8]))
        payload[at : at + width] = (int(rng.choice(np.array(EXTREMES, np.uint64))) % (1 << 8 * width)).to_bytes(
            width, "little"
        )
    elif kind < 0.8:
        at &= ~3
        payload[at : at + 8] = struct.pack("<d", rng.choice(FLOATS))
    elif kind < 0.9:
        del payload[at:]
    else:
        payload[at:at] = bytes(int(rng.choice([1, 4, 1000])))


def text(value: bytes) -> bytes:
    """Return a text with its length before it."""
    return struct.pack("<I", len(value)) + value


def split_mcap(content: bytes) -> Iterator[tuple[int, bytearray]]:
    """Yield opcode and content of records, until one does not fit."""
    at = 0
    while at + 9 <= len(content):
        code, length = content[at], int.from_bytes(content[at + 1 : at + 9], "little")
        if at + 9 + length > len(content):
            return
        yield code, bytearray(content[at + 9 : at + 9 + length])
        at += 9 + length


def joined_mcap(records: list[tuple[int, bytearray]]) -> bytes:
    """Return records as they are written."""
    return b"".join(bytes([code]) + len(body).to_bytes(8, "little") + body for code, body in records)


def change_records(records: list[tuple[int, bytearray]], rng: Random) -> str:
    """Change one record, of any kind that is there: messages do not get all the attention because they are many."""
    code = int(rng.choice(sorted({code for code, _ in records})))
    places = [i for i, (one, _) in enumerate(records) if one == code]
    at, kind = int(rng.choice(places)), rng.random()
    body = records[at][1]
    if kind < 0.1:
        del records[at]
        return f"record {code} removed"
    if kind < 0.2:
        records.insert(int(rng.integers(len(records) + 1)), (code, bytearray(body)))
        return f"record {code} repeated"
    if code == SCHEMA and kind < 0.7:
        name = b"sensor_msgs/msg/Imu" if rng.random() < 0.5 else body[6 : 6 + int.from_bytes(body[2:3], "little")]
        new = DEFINITIONS[int(rng.integers(len(DEFINITIONS)))]
        body[:] = body[:2] + text(bytes(name)) + text(b"ros2msg") + text(new)
    elif code == CHANNEL and kind < 0.7:
        new = TOPICS[int(rng.integers(len(TOPICS)))]
        body[:] = body[:4] + text(new) + text(b"cdr") + struct.pack("<I", 0)
    elif code == MESSAGE and kind < 0.5:
        # Stamps: log time, publish time.
        stamp = int(rng.choice(np.array([0, 1, 1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1], np.uint64)))
        body[6:14] = stamp.to_bytes(8, "little")
    elif code == MESSAGE:
        payload = body[22:]
        spoil(payload, rng)
        body[22:] = payload
    else:
        spoil(body, rng)
    return f"record {code}"


def mcap(content: bytearray, rng: Random) -> str:
    """Change a record of an MCAP file: one of its own, or of an uncompressed chunk, which is then packed again."""
    records = list(split_mcap(bytes(content[len(MAGIC) :])))
    plain = [body for code, body in records if code == CHUNK and int.from_bytes(body[28:32], "little") == 0]
    if plain and rng.random() < 0.7:
        body = plain[int(rng.integers(len(plain)))]
        inner = list(split_mcap(bytes(body[40:])))
        if inner:
            done = "inner " + change_records(inner, rng)
            new = joined_mcap(inner)
            size = len(new) if rng.random() < 0.95 else int(rng.choice(EXTREMES[:9]))
            # No checksum: zero is none.
            body[16:] = struct.pack("<QIIQ", size, 0, 0, len(new)) + new
            content[len(MAGIC) :] = joined_mcap(records) + MAGIC
            return done
    if not records:
        return "no record"
    done = change_records(records, rng)
    content[len(MAGIC) :] = joined_mcap(records) + MAGIC
    return done


def bag(content: bytearray, rng: Random) -> str:
    """Change header or data of a record of a ROS 1 bag, with lengths that fit."""
    at, places = len(BAG_MAGIC), []
    while at + 8 <= len(content):
        head = int.from_bytes(content[at : at + 4], "little")
        if at + 8 + head > len(content):
            break
        size = int.from_bytes(content[at + 4 + head : at + 8 + head], "little")
        places.append((at, head, size))
        at += 8 + head + size
    if not places:
        return "no record"
    at, head, size = places[int(rng.integers(len(places)))]
    header, data = content[at + 4 : at + 4 + head], content[at + 8 + head : at + 8 + head + size]
    which = "header" if rng.random() < 0.6 else "data"
    fields = []
    rest = bytes(header)
    while len(rest) >= 4:
        length = int.from_bytes(rest[:4], "little")
        fields.append(bytearray(rest[4 : 4 + length]))
        rest = rest[4 + length :]
    if which == "header" and fields:
        number = int(rng.integers(len(fields)))
        name, _, value = bytes(fields[number]).partition(b"=")
        kind = rng.random()
        if kind < 0.15:
            del fields[number]
        elif kind < 0.25:
            fields.append(bytearray(fields[number]))
        else:
            changed = bytearray(value)
            spoil(changed, rng)
            fields[number] = bytearray(name + b"=" + changed)
        header = bytearray(b"".join(text(bytes(one)) for one in fields))
        which = f"header {name[:12].decode('ascii', 'replace')}"
    else:
        spoil(data, rng)
    new = text(bytes(header)) + text(bytes(data))
    content[at : at + 8 + head + size] = new
    return f"bag {which}"
