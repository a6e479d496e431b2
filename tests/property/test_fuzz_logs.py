"""Logs with mutated bytes: they are read, or refused in one line; no traceback, no hang, no memory bomb.

The examples are the same in each run. `make stress` tries many more.
"""

from __future__ import annotations

import faulthandler
import itertools
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message, Schema, Statistics
from mcap.writer import CompressionType, IndexType, Writer

from icrtool.config import load_config
from icrtool.errors import IcrToolError
from icrtool.logs.read_log import survey_log
from icrtool.logs.streams.assembly import assemble
from icrtool.logs.write_log import SensorColumns, WriteOptions, write_log

START_NS = 1_760_000_000_000_000_000
CONFIG = load_config(
    sets=["robot.track_width_m=0.55", "robot.wheel_radius_m=0.165", "robot.encoder_counts_per_rev=8192"]
)
LONGEST_S = 20.0
"""A log of 60 kB is read in 20 ms; a busy machine may need a hundred times that."""

EXTREMES = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF]
EXTREMES += [1 << 40, (1 << 62) - 1, (1 << 63) - 1, 1 << 63, (1 << 64) - 1]


def drive(count: int = 100) -> SensorColumns:
    """A few seconds on a circle."""
    t = np.arange(count) * 0.05
    stamps = START_NS + (t * 1e9).astype(np.int64)
    heading = 0.3 * t
    north, east = np.cumsum(np.cos(heading)) * 0.04, np.cumsum(np.sin(heading)) * 0.04
    fixes = slice(None, None, 3)
    few = len(t[fixes])
    return SensorColumns(
        wheel_stamp_ns=stamps,
        wheel_position_left_m=0.9 * t,
        wheel_position_right_m=0.7 * t,
        wheel_v_left_mps=np.full(count, 0.9),
        wheel_v_right_mps=np.full(count, 0.7),
        gnss_stamp_ns=stamps[fixes],
        latitude_deg=47.0 + north[fixes] / 111_180,
        longitude_deg=8.0 + east[fixes] / 76_060,
        height_m=np.full(few, 400.0),
        gnss_std_m=np.full(few, 0.02),
        gnss_status=np.full(few, 2),
        heading_stamp_ns=stamps + 1000,
        heading_rad=heading,
        yaw_rate_radps=np.full(count, 0.3),
    )


def rewrite(source: Path, target: Path, **options: object) -> Path:
    """Write an MCAP file again as another writer would have: without checksums, so that mutations get through."""
    with source.open("rb") as stream, target.open("wb") as sink:
        writer = Writer(sink, enable_crcs=False, chunk_size=6000, **options)
        writer.start("ros2", "test")
        schemas, channels = {}, {}
        for schema, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", schemas[schema.id])
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return target


MCAP = {
    "mcap": {"compression": CompressionType.NONE},
    "mcap without index": {"compression": CompressionType.NONE, "index_types": IndexType.NONE},
    "mcap without chunks": {"compression": CompressionType.NONE, "use_chunking": False},
    "mcap lz4": {"compression": CompressionType.LZ4},
    "mcap zstd": {"compression": CompressionType.ZSTD},
}
OTHERS = {
    "bag": ("bag", "none"),
    "bag lz4": ("bag", "lz4"),
    "bag bz2": ("bag", "bz2"),
    "db3": ("db3", "none"),
    "db3 compressed by message": ("db3", "zstd"),
    "db3 compressed by file": ("db3", "zstd-file"),
}
WHEELS = ("joint_states", "ticks", "odometry", "jackal_feedback")


@pytest.fixture(scope="module")
def good_logs(tmp_path_factory) -> Callable[[str, str], Path]:
    """Give a good log of a kind and of a type of wheel messages."""
    folder = tmp_path_factory.mktemp("good")
    made: dict[tuple[str, str], Path] = {}

    def make(kind: str, wheels: str) -> Path:
        container, compression = OTHERS.get(kind, ("mcap", "none"))
        options = WriteOptions(
            container=container, compression=compression, wheels=wheels, wheel_radius_m=0.165, track_width_m=0.55
        )
        suffix = {"mcap": ".mcap", "bag": ".bag", "db3": ""}[container]
        path = write_log(folder / f"{len(made)}{suffix}", drive(), options)
        return rewrite(path, folder / f"{len(made)}x.mcap", **MCAP[kind]) if container == "mcap" else path

    def get(kind: str, wheels: str) -> Path:
        if (kind, wheels) not in made:
            made[kind, wheels] = make(kind, wheels)
        return made[kind, wheels]

    return get


@dataclass(frozen=True)
class Mutation:
    """One change of a file; `at` is a share of its length, so that it means the same for each log."""

    kind: str
    at: float
    size: int
    number: int

    def apply(self, content: bytearray) -> None:
        at, size, number = int(self.at * len(content)), self.size, self.number
        match self.kind:
            case "flip":
                content[at : at + 1] = bytes(byte ^ (1 << number % 8) for byte in content[at : at + 1])
            case "overwrite":
                width = (1, 2, 4, 8)[size % 4]
                content[at : at + width] = (number % (1 << 8 * width)).to_bytes(width, "little")
            case "insert":
                content[at:at] = (number.to_bytes(8, "little") * (size // 8 + 1))[:size]
            case "delete":
                del content[at : at + size]
            case "repeat":
                content[at:at] = content[at : at + size]
            case "cut":
                del content[at:]


# The first bytes and the last are headers and indexes: they get more than their share.
PLACES = st.one_of(st.floats(0, 0.9999), st.floats(0, 0.01), st.floats(0.93, 0.9999))
MUTATIONS = st.lists(
    st.builds(
        Mutation,
        st.sampled_from(["flip", "flip", "overwrite", "overwrite", "insert", "delete", "repeat", "cut"]),
        PLACES,
        st.one_of(st.integers(1, 16), st.integers(1, 8000)),
        st.one_of(st.sampled_from(EXTREMES), st.integers(0, (1 << 64) - 1)),
    ),
    min_size=1,
    max_size=6,
)


@contextmanager
def time_limit():
    """Fail what takes far too long; end the run, with a traceback, where it would never come back."""
    faulthandler.dump_traceback_later(10 * LONGEST_S, exit=True, file=sys.__stderr__)
    began = time.monotonic()
    try:
        yield
        assert time.monotonic() - began < LONGEST_S
    finally:
        faulthandler.cancel_dump_traceback_later()


def check_outcome(path: Path) -> None:
    """Read a log; it must come out whole, or be refused in one line."""
    refused = measured = None
    with time_limit():
        try:
            survey = survey_log(path, CONFIG)
            measured = assemble(survey, CONFIG)
        except IcrToolError as err:
            refused = err
    if measured is None:
        assert len(str(refused).splitlines()) == 1
        return
    assert (np.diff(measured.wheels.stamp_ns) > 0).all()
    assert (np.diff(measured.gnss.stamp_ns) >= 0).all()
    assert np.isfinite(measured.gnss.north_m).all()
    assert np.isfinite(measured.heading.heading_rad).all()
    assert all(len(warning.splitlines()) == 1 for warning in measured.warnings)


def mutate(good: Path, folder: Path, mutations: list[Mutation], file: int) -> Path:
    """Copy a log and mutate it, or one of the files of a directory."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    copy = folder / f"log{good.suffix}"
    if good.is_dir():
        shutil.copytree(good, copy)
        # The storage file three times out of four, else metadata.yaml.
        files = sorted(copy.iterdir(), key=lambda each: each.name == "metadata.yaml")
        target = files[0] if file < 3 else files[-1]
    else:
        target = Path(shutil.copy(good, copy))
    content = bytearray(target.read_bytes())
    for mutation in mutations:
        mutation.apply(content)
    target.write_bytes(content)
    return copy


def fuzz(good_logs, folder: Path, kind: str, examples: int) -> None:
    @settings(
        max_examples=examples,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(mutations=MUTATIONS, wheels=st.sampled_from(WHEELS), file=st.integers(0, 3))
    def one(mutations, wheels, file):
        check_outcome(mutate(good_logs(kind, wheels), folder / "mutated", mutations, file))

    one()


@pytest.mark.parametrize("kind", [*MCAP, *OTHERS])
@pytest.mark.parametrize("wheels", WHEELS)
def test_good_logs_are_read(good_logs, kind, wheels):
    survey = survey_log(good_logs(kind, wheels), CONFIG)
    assert survey.problems == ()
    assert len(assemble(survey, CONFIG).wheels.stamp_ns) == 100


@pytest.mark.parametrize("kind", [*MCAP, *OTHERS])
def test_mutated_logs_are_read_or_refused_in_one_line(good_logs, tmp_path, kind):
    fuzz(good_logs, tmp_path, kind, examples=25)


@pytest.mark.stress
@pytest.mark.parametrize("kind", [*MCAP, *OTHERS])
def test_many_mutated_logs_are_read_or_refused_in_one_line(good_logs, tmp_path, kind):
    fuzz(good_logs, tmp_path, kind, examples=2500)


def rle_bomb(megabytes: int) -> bytes:
    """A zstd frame of one repeated byte: 4 bytes for each 128 KiB."""
    block = ((1 << 17) << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    return b"\x28\xb5\x2f\xfd\x00\x58" + block * (8 * megabytes) + (1).to_bytes(3, "little")


def mcap_of(*records: object) -> bytes:
    stream = RecordBuilder()
    Header("ros2", "bomb").write(stream)
    Schema(1, b"float64 data", "ros2msg", "sensor_msgs/msg/JointState").write(stream)
    Channel(1, "/joint_states", "cdr", {}, 1).write(stream)
    for record in records:
        if isinstance(record, bytes):
            stream.write(record)
        else:
            record.write(stream)
    DataEnd(0).write(stream)
    return b"\x89MCAP0\r\n" + stream.end()


def mcap_bombs() -> dict[str, bytes]:
    def claim(opcode: int, length: int) -> bytes:
        return bytes([opcode]) + length.to_bytes(8, "little")

    small = RecordBuilder()
    for _ in range(4000):
        Message(1, START_NS, b"", START_NS, 0).write(small)
    statistics = RecordBuilder()
    Statistics(0, 1, {}, 1, 1, 0, 0, 0, 1).write(statistics)
    lie = bytearray(statistics.end())
    lie[-4:] = b"\xff\xff\xff\xff"
    summary = len(mcap_of())
    return {
        "chunk of 128 MB": mcap_of(Chunk("zstd", rle_bomb(128), 0, 0, 0, 1 << 27)),
        "chunk of 4 GB that claims 128 MB": mcap_of(Chunk("zstd", rle_bomb(4000), 0, 0, 0, 1 << 27)),
        "chunk that claims 1 TB": mcap_of(Chunk("zstd", rle_bomb(1), 0, 0, 0, 1 << 40)),
        "lz4 chunk that claims 128 MB": mcap_of(Chunk("lz4", b"\x04\x22\x4d\x18" + bytes(99), 0, 0, 0, 1 << 27)),
        "many chunks that claim 128 MB": mcap_of(*[Chunk("zstd", rle_bomb(1), 0, 0, 0, 1 << 27)] * 40),
        "messages of nothing": mcap_of(small.end() * 20),
        **{f"record {op} of 2^{power}": mcap_of(claim(op, 1 << power)) for op in (3, 5, 6, 9) for power in (40, 62)},
        "statistics of 4 GB": mcap_of() + bytes(lie) + footer(summary),
        "summary of nothing": mcap_of() + claim(8, 1 << 62) + footer(summary),
    }


def footer(summary: int) -> bytes:
    stream = RecordBuilder()
    Footer(summary, 0, 0).write(stream)
    return stream.end() + b"\x89MCAP0\r\n"


def bag_bombs() -> dict[str, bytes]:
    def field(name: bytes, value: bytes) -> bytes:
        return (len(name) + 1 + len(value)).to_bytes(4, "little") + name + b"=" + value

    def record(*fields: bytes, data: bytes = b"", length: int | None = None) -> bytes:
        header = b"".join(fields)
        size = len(data) if length is None else length
        return len(header).to_bytes(4, "little") + header + size.to_bytes(4, "little") + data

    start = b"#ROSBAG V2.0\n" + record(field(b"op", b"\3"), field(b"index_pos", bytes(8)))
    chunk = [field(b"op", b"\5"), field(b"size", (1 << 27).to_bytes(4, "little"))]
    return {
        "header of 4 GB": start + b"\xff\xff\xff\xff" + bytes(99),
        "data of 4 GB": start + record(field(b"op", b"\7"), length=0xFFFF_FFFF) + bytes(99),
        "lz4 chunk that claims 128 MB": start + record(*chunk, field(b"compression", b"lz4"), data=b"\x04\x22\x4d\x18"),
        "bz2 chunk that claims 128 MB": start + record(*chunk, field(b"compression", b"bz2"), data=b"BZh9" + bytes(99)),
        "field of 4 GB": start + record(b"\xff\xff\xff\xff" + field(b"op", b"\5")),
    }


BOMBS = {
    **{f"{name}.mcap": content for name, content in mcap_bombs().items()},
    **{f"{name}.bag": content for name, content in bag_bombs().items()},
}

READ_WITH_LITTLE_MEMORY = """
import resource, sys
from icrtool.config import Config
from icrtool.errors import IcrToolError
from icrtool.logs.streams.assembly import assemble
from icrtool.logs.read_log import survey_log

def read(path):
    try:
        assemble(survey_log(path), Config())
    except IcrToolError as err:
        return str(err)

read(sys.argv[1])
with open("/proc/self/statm") as statm:
    used = int(statm.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + int(sys.argv[2]),) * 2)
for path in sys.argv[3:]:
    print(repr(read(path)), flush=True)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="how much memory is in use is read from /proc")
def test_memory_is_bounded_whatever_a_log_claims(good_logs, tmp_path):
    paths = []
    for name, content in BOMBS.items():
        paths.append(tmp_path / name.replace("^", "-"))
        paths[-1].write_bytes(content)
    folder = tmp_path / "compressed"
    folder.mkdir()
    (folder / "bomb.db3.zstd").write_bytes(rle_bomb(4000))
    paths.append(folder)
    for row, (kind, at) in enumerate(
        itertools.product(("mcap without index", "bag", "db3"), (0.02, 0.3, 0.5, 0.7, 0.96))
    ):
        mutations = [Mutation("overwrite", at, 3, EXTREMES[row]), Mutation("overwrite", at + 0.01, 2, (1 << 32) - 1)]
        paths.append(mutate(good_logs(kind, "joint_states"), tmp_path / str(row), mutations, 0))
    good = good_logs("mcap zstd", "joint_states")
    # One chunk of the largest size, packed and unpacked, what zstd keeps of it, and another one being read ahead.
    megabytes = 600
    command = [sys.executable, "-c", READ_WITH_LITTLE_MEMORY, str(good), str(megabytes * 1_000_000), *map(str, paths)]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == len(paths)
    assert done.stderr == ""
