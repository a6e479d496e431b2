"""MCAP files of wheels and NMEA sentences, and what receivers and strangers do to the sentences.

A sentence is damaged between its sign and its checksum, which mostly fits again afterwards: else all damage would end
at the checksum.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np

Random = np.random.Generator
START_NS = 1_760_000_000_000_000_000
STEP_NS = 50_000_000
TURN_RADPS, LEFT_MPS, RIGHT_MPS = 0.3, 0.7, 0.9
LATITUDE_DEG, LONGITUDE_DEG = 47.0, 8.0
COUNTS = (2, 30, 100, 400)
MEGABYTE = 1_000_000
MOST_LONG = 4
"""Messages of a megabyte in a log."""

TALKERS = ("GP", "GN", "GL", "GA", "GB", "BD", "GQ", "II", "P", "", "g", "$$")
TEXTS = (
    "", "-", ".", "nan", "inf", "-inf", "1e308", "1e5", "0x10", "1_0", " 1", "+1", "9" * 12, "9" * 400, "-4700.000",
    "4760.0001", "4799.999999", "9000.0", "18000.0", "99999.9", "999999999999.999999999999", "240000.00",
    "235960.00", "ZZ", "N", "\u0664\u0667", "\u00e9", "\x00", "\x1b[2J", "\u202e", "0.000000000001", "-0",
)  # fmt: skip
"""What stands in the place of a field."""

CHANGES = (timedelta(days=-1), timedelta(days=-10_000), timedelta(hours=-1), timedelta(seconds=-1), timedelta(0))


def checked(body: str) -> str:
    """Return a sentence with its sign and checksum."""
    return f"${body}*{reduce(xor, body.encode(), 0):02X}"


def heading_log(heading_deg: float) -> str:
    """Return the heading as Unicore writes it, with its CRC of 32 bits."""
    body = (
        "UNIHEADINGA,97,GPS,FINE,2190,375201200,0,0,18,12;SOL_COMPUTED,NARROW_INT,0.9931,"
        f"{heading_deg:.4f},0.5,0.0,0.31,0.62"
    )
    return f"#{body}*{zlib.crc32(body.encode(), 0xFFFFFFFF) ^ 0xFFFFFFFF:08x}"


def angle(degrees: float, digits: int) -> str:
    """Return degrees as ``ddmm.mmmmmm``."""
    whole, rest = divmod(abs(degrees), 1.0)
    return f"{int(whole):0{digits}d}{rest * 60.0:09.6f}"


def epoch_of(time: datetime, north_m: float, east_m: float, heading_deg: float) -> list[str]:
    """Return the bodies of the sentences of a fix, without signs and checksums."""
    utc = f"{time:%H%M%S}.{time.microsecond // 10_000:02d}"
    place = f"{angle(LATITUDE_DEG + north_m / 111_180, 2)},N,{angle(LONGITUDE_DEG + east_m / 76_060, 3)},E"
    return [
        f"GNRMC,{utc},A,{place},0.5,010.0,{time:%d%m%y},,,R",
        f"GNGGA,{utc},{place},4,12,0.8,400.000,M,47.0,M,,",
        f"GNGST,{utc},0.01,0.02,0.01,30,0.012,0.015,0.03",
        f"GNHDT,{heading_deg:.2f},T",
    ]


def drive(count: int) -> tuple[list[int], list[list[str]]]:
    """Return stamps and sentences of a few seconds on a circle."""
    stamps, epochs = [], []
    speed = (LEFT_MPS + RIGHT_MPS) / 2
    for number in range(0, count, 3):
        turn = TURN_RADPS * number * STEP_NS * 1e-9
        radius = speed / TURN_RADPS
        stamps.append(START_NS + number * STEP_NS)
        time = datetime.fromtimestamp(stamps[-1] * 1e-9, UTC)
        east, north = radius * np.sin(turn), radius * (1.0 - np.cos(turn))
        epochs.append(epoch_of(time, north, east, (90.0 - np.degrees(turn)) % 360.0))
    return stamps, epochs


def changed_field(body: str, rng: Random) -> str:
    """Put a text into the place of a field."""
    fields = body.split(",")
    fields[int(rng.integers(1, max(len(fields), 2))) % len(fields)] = TEXTS[int(rng.integers(len(TEXTS)))]
    return ",".join(fields)


def missing_fields(body: str, rng: Random) -> str:
    """Leave out a field, or all after it."""
    fields = body.split(",")
    at = int(rng.integers(len(fields)))
    return ",".join(fields[:at] if rng.random() < 0.5 else [*fields[:at], *fields[at + 1 :]])


def further_fields(body: str, rng: Random) -> str:
    """Repeat fields, or add empty ones."""
    fields = body.split(",")
    at = int(rng.integers(len(fields)))
    return ",".join([*fields[:at], *fields[at : at + 2] * int(rng.choice([2, 30])), *fields[at:]])


def other_talker(body: str, rng: Random) -> str:
    """Give the sentence another talker, or another kind than its fields."""
    talker = TALKERS[int(rng.integers(len(TALKERS)))]
    kind = body[2:5] if rng.random() < 0.7 else str(rng.choice(["GGA", "RMC", "GST", "HDT", "THS", "VTG", "GSV"]))
    return talker + kind + body[5:]


def empty_fields(body: str, rng: Random) -> str:
    """Leave the fields empty, all of them or one in two."""
    name, *fields = body.split(",")
    share = float(rng.choice([0.5, 1.0]))
    return ",".join([name, *("" if rng.random() < share else field for field in fields)])


def other_time(body: str, rng: Random) -> str:
    """Set the time or the date: 24:00:00, a leap second, dates that go backwards or do not exist."""
    fields = body.split(",")
    if fields[0].endswith("RMC") and len(fields) > 9 and rng.random() < 0.6:
        time = datetime.fromtimestamp(START_NS * 1e-9, UTC) + CHANGES[int(rng.integers(len(CHANGES)))]
        fields[9] = str(rng.choice([f"{time:%d%m%y}", "310225", "000000", "999999", ""]))
    elif len(fields) > 1:
        fields[1] = str(rng.choice(["240000.00", "235960.00", "000000.00", "-10000.00", "996099.99"]))
    return ",".join(fields)


BODY_DAMAGE: tuple[Callable[[str, Random], str], ...] = (
    changed_field, changed_field, missing_fields, further_fields, other_talker, empty_fields, other_time,
)  # fmt: skip


def damaged_end(text: bytes, rng: Random) -> bytes:
    """Damage the checksum, or leave it out."""
    head, _, end = text.rpartition(b"*")
    other = bytes(rng.choice([b"", b"0", b"GG", b"-1", b"00000000", end.lower(), end[::-1]]))
    return head if rng.random() < 0.3 else head + b"*" + other


def damaged_bytes(text: bytes, rng: Random) -> bytes:
    """Put bytes that are not ASCII, controls, or ends of lines into a sentence."""
    at = int(rng.integers(len(text) + 1))
    new = bytes(rng.choice([b"\xff", b"\xc3\xa9", b"\0", b"\r", b"\r\n$", b"*", b"\\", b"!", b"#", b"\xef\xbb\xbf"]))
    return text[:at] + new + text[at + int(rng.integers(2)) :]


def long_text(text: bytes, rng: Random) -> bytes:
    """Return a message of a megabyte: a sentence that is repeated, digits or commas without end."""
    kind = int(rng.integers(4))
    if kind == 0:
        return (text + b"\r\n") * (MEGABYTE // (len(text) + 2))
    if kind == 1:
        return text + b"\r\n" * (MEGABYTE // 2)
    middle = (b",", b"9", b"$GNGGA", b"*00")[int(rng.integers(4))]
    filled = text[:20] + middle * (MEGABYTE // len(middle))
    return filled + text[20:] if kind == 2 else filled


TEXT_DAMAGE: tuple[Callable[[bytes, Random], bytes], ...] = (damaged_end, damaged_bytes)


def damaged(epochs: list[list[str]], rng: Random) -> tuple[list[bytes], list[str]]:
    """Return the text of each message, with what was done: a share of the sentences is damaged in each way drawn."""
    bodies = [list(epoch) for epoch in epochs]
    done = []
    for _ in range(int(rng.integers(0, 4))):
        damage, share = BODY_DAMAGE[int(rng.integers(len(BODY_DAMAGE)))], float(rng.choice([0.02, 0.3, 1.0]))
        done.append(damage.__name__)
        bodies = [[damage(body, rng) if rng.random() < share else body for body in epoch] for epoch in bodies]
    unicore = bool(rng.random() < 0.2)
    lines = [
        [checked(body) for body in epoch] + ([heading_log(float(rng.uniform(0.0, 360.0)))] if unicore else [])
        for epoch in bodies
    ]
    joined = rng.random()
    if joined < 0.3:  # a message for an epoch
        separator = str(rng.choice(["\r\n", "\n", "", " ", "\r\n\r\n"]))
        done.append("several in a message")
        texts = [separator.join(epoch).encode() for epoch in lines]
    else:
        texts = [line.encode() for epoch in lines for line in epoch]
    if rng.random() < 0.5 or not done:
        damage_text, share = TEXT_DAMAGE[int(rng.integers(len(TEXT_DAMAGE)))], float(rng.choice([0.02, 0.3, 1.0]))
        done.append(damage_text.__name__)
        texts = [damage_text(text, rng) if rng.random() < share else text for text in texts]
    if rng.random() < 0.15 and texts:
        done.append(long_text.__name__)
        for at in rng.integers(len(texts), size=int(rng.integers(1, MOST_LONG + 1))):
            texts[at] = long_text(texts[at], rng)
    return texts, done


def sequence(text: bytes) -> bytes:
    """Return a string of ROS 1."""
    return struct.pack("<I", len(text)) + text


def cdr(stamp_ns: int, text: bytes, *, header: bool) -> bytes:
    """Return a message with a string, as ROS 2 writes it; with a header before it or without."""
    seconds, rest = divmod(stamp_ns, 10**9)
    head = struct.pack("<iII", seconds, rest, 1) + b"\0\0\0\0" if header else b""
    return b"\0\1\0\0" + head + struct.pack("<I", len(text) + 1) + text + b"\0"


def ros1(stamp_ns: int, text: bytes, *, header: bool) -> bytes:
    """Return a message with a string, as ROS 1 writes it; with a header before it or without."""
    seconds, rest = divmod(stamp_ns, 10**9)
    return (struct.pack("<III", 0, seconds, rest) + sequence(b"gps") if header else b"") + sequence(text)


def json_message(stamp_ns: int, text: bytes, *, header: bool) -> bytes:
    """Return a message with a string as JSON."""
    seconds, rest = divmod(stamp_ns, 10**9)
    head = {"header": {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": "gps"}} if header else {}
    return json.dumps(head | {"sentence" if header else "data": text.decode("utf-8", "replace")}).encode()


SEPARATOR = "=" * 80
STAMP = "uint32 sec\nuint32 nanosec\n"
SENTENCE = (
    f"std_msgs/Header header\nstring sentence\n{SEPARATOR}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n"
    f"string frame_id\n{SEPARATOR}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
OLD_SENTENCE = (
    f"Header header\nstring sentence\n{SEPARATOR}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
)
FORMS: tuple[tuple[str, str, str, str, Callable[..., bytes]], ...] = (
    ("nmea_msgs/msg/Sentence", "ros2msg", "cdr", SENTENCE, cdr),
    ("nmea_msgs/Sentence", "ros1msg", "ros1", OLD_SENTENCE, ros1),
    ("nmea_msgs/msg/Sentence", "jsonschema", "json", "", json_message),
    ("std_msgs/msg/String", "ros2msg", "cdr", "string data\n", cdr),
    ("std_msgs/String", "ros1msg", "ros1", "string data\n", ros1),
)
"""Type, form of the definition, serialization, definition, and what writes a message. Strings are not read as NMEA."""

FORM_SHARES = (0.5, 0.25, 0.15, 0.05, 0.05)
WHEELS = (
    f"std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n{SEPARATOR}\n"
    f"MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{SEPARATOR}\n"
    "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
WHEEL_RADIUS_M = 0.165


def wheels_of(stamp_ns: int) -> bytes:
    """Return the joints of the wheels, as ROS 2 writes them."""
    seconds, rest = divmod(stamp_ns, 10**9)
    turned = [speed * (stamp_ns - START_NS) * 1e-9 / WHEEL_RADIUS_M for speed in (LEFT_MPS, RIGHT_MPS)]
    speeds = [LEFT_MPS / WHEEL_RADIUS_M, RIGHT_MPS / WHEEL_RADIUS_M]
    body = struct.pack("<iII", seconds, rest, 1) + b"\0\0\0\0" + struct.pack("<I", 2)
    for name in (b"left_wheel_joint", b"right_wheel_joint"):
        body += b"\0" * (-len(body) % 4) + struct.pack("<I", len(name) + 1) + name + b"\0"
    for values in (turned, speeds):
        body += b"\0" * (-len(body) % 4) + struct.pack("<I", 2)
        body += b"\0" * (-len(body) % 8) + struct.pack("<2d", *values)
    return b"\0\1\0\0" + body + struct.pack("<I", 0)


def write_sentences(path: Path, texts: list[bytes], stamps: list[int], count: int, form: int) -> Path:
    """Write `count` samples of the wheels and messages of the texts, in a form of `FORMS`, evenly over `stamps`."""
    from mcap.writer import CompressionType, Writer

    name, written, encoding, definition, serialize = FORMS[form]
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, enable_crcs=False)
        writer.start("ros2")
        joints = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", WHEELS.encode())
        wheels = writer.register_channel("/joint_states", "cdr", joints)
        schema = writer.register_schema(name, written, definition.encode())
        sentences = writer.register_channel("/nmea", encoding, schema)
        for number in range(count):
            stamp = START_NS + number * STEP_NS
            writer.add_message(wheels, stamp, wheels_of(stamp), stamp)
        for number, text in enumerate(texts):
            stamp = stamps[number * len(stamps) // len(texts)]
            message = serialize(stamp, text, header=name.endswith("Sentence"))
            writer.add_message(sentences, stamp, message, stamp)
        writer.finish()
    return path


def write_log(path: Path, rng: Random) -> tuple[Path, list[str]]:
    """Write a drive with damaged sentences; return it with what was done."""
    count = int(rng.choice(COUNTS))
    stamps, epochs = drive(count)
    texts, done = damaged(epochs, rng)
    form = int(rng.choice(len(FORMS), p=FORM_SHARES))
    return write_sentences(path, texts, stamps, count, form), ["NMEA", FORMS[form][2], *done]
