"""Fuzz icrtool with damaged logs, forged runs and odd addresses: each is used within bounds of time and memory.

``make fuzz`` runs it; ``python scripts/fuzz.py --help`` lists the options. A finding is a traceback or a limit that
is exceeded; its log is kept below ``--keep`` with the traceback beside it. Logs are used in worker processes, which
are killed where a compiled loop does not come back.
"""

from __future__ import annotations

import argparse
import bz2
import gc
import gzip
import io
import lzma
import re
import resource
import shutil
import signal
import sqlite3
import struct
import sys
import tarfile
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "scripts")]

import fuzz_addresses  # noqa: E402 - beside this script
import fuzz_nmea  # noqa: E402
import fuzz_runs  # noqa: E402
import fuzz_schemas  # noqa: E402
import fuzz_structures  # noqa: E402

Random = np.random.Generator
EXTREMES = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF, 1 << 40, (1 << 63) - 1]
FLOATS = [0.0, -0.0, 1e-300, 1e300, -1e300, float("inf"), float("nan"), 1e9, -1.0, 3.0e8, 1e-9]
SIGNALLING = b"\1\0\0\0\0\0\xf0\x7f"
"""A signalling NaN: arithmetic with it warns."""

HOUR_NS, YEAR_NS = 3_600_000_000_000, 31_557_600_000_000_000


def values(columns: dict[str, np.ndarray], rng: Random) -> str:
    """Spoil values of a column before the log is written."""
    name = str(rng.choice([n for n, c in columns.items() if c.dtype == np.float64 and len(c)]))
    column = columns[name] = columns[name].copy()
    first = int(rng.integers(len(column)))
    last = min(len(column), first + int(rng.choice([1, 5, len(column)])))
    column[first:last] = rng.choice(FLOATS)
    return f"values of {name}"


def clocks(columns: dict[str, np.ndarray], rng: Random) -> str:
    """Have the stamps of a stream jump, stand still, go back or scatter, from a row on."""
    name = str(rng.choice([n for n in columns if n.endswith("stamp_ns")]))
    column = columns[name] = columns[name].copy()
    row = int(rng.integers(len(column) + 1))
    column[row:] += rng.choice([HOUR_NS, -HOUR_NS, YEAR_NS, -YEAR_NS, 1, -1_000_000_000])
    if rng.random() < 0.3 and row < len(column):
        column[row:] = column[row]
    return f"clock of {name}"


def shorter(columns: dict[str, np.ndarray], rng: Random) -> str:
    """Leave a stream with 0, 1, 2 or a few samples."""
    stream = str(rng.choice(["wheel", "gnss", "heading"]))
    count = int(rng.choice([0, 1, 2, 3, 10]))
    names = {"gnss": ("gnss", "latitude", "longitude", "height"), "heading": ("heading", "yaw")}.get(stream, (stream,))
    for name in [n for n in columns if n.startswith(names)]:
        columns[name] = columns[name][:count]
    return f"{count} samples of {stream}"


def standing(columns: dict[str, np.ndarray], rng: Random) -> str:
    """Have the robot stand for most of the log."""
    share = float(rng.choice([0.5, 0.9, 0.99, 1.0]))
    names = [n for n, c in columns.items() if c.dtype == np.float64]
    for name in names:
        column = columns[name] = columns[name].copy()
        column[int(len(column) * (1 - share)) :] = 0.0 if name.endswith(("mps", "radps")) else column[-1:]
    return "standing"


COLUMN_MUTATIONS: tuple[Callable[[dict[str, np.ndarray], Random], str], ...] = (values, clocks, shorter, standing)


def numbers(content: bytearray, rng: Random) -> str:
    """Overwrite a length, count, size, CRC or index: any little-endian number of 1 to 8 bytes."""
    width = int(rng.choice([1, 2, 4, 8]))
    at = place(content, rng)
    content[at : at + width] = (int(rng.choice(EXTREMES)) % (1 << 8 * width)).to_bytes(width, "little")
    return "number"


def doubles(content: bytearray, rng: Random) -> str:
    """Overwrite an aligned double."""
    at = place(content, rng) & ~3
    content[at : at + 8] = SIGNALLING if rng.random() < 0.1 else struct.pack("<d", rng.choice(FLOATS))
    return "double"


def stretches(content: bytearray, rng: Random) -> str:
    """Delete, repeat or move a stretch, or cut the file off."""
    at, size = place(content, rng), int(rng.choice([1, 4, 16, 300, 5000]))
    kind = str(rng.choice(["delete", "repeat", "cut"], p=[0.45, 0.45, 0.1]))
    if kind == "delete":
        del content[at : at + size]
    elif kind == "repeat":
        content[at:at] = content[at : at + size]
    else:
        del content[at:]
    return kind


def definitions(content: bytearray, rng: Random) -> str:
    """Change a message definition: types, array lengths, recursion."""
    words = (b"float64", b"uint32", b"string", b"geometry_msgs/Vector3", b"[36]", b"[]", b"Header", b"time")
    found = [at for word in words if (at := content.find(word, int(rng.integers(max(len(content) // 2, 1))))) >= 0]
    if not found:
        return numbers(content, rng)
    at = int(rng.choice(found))
    new = bytes(
        rng.choice([b"float64[99999999]", b"Imu", b"sensor_msgs/Imu[]", b"", b"string[]", b"\n\n\x00", b"uint8"])
    )
    old = len(bytes(content[at : at + 40]).split(b" ")[0]) if rng.random() < 0.5 else len(new)
    content[at : at + old] = new
    return "definition"


BYTE_MUTATIONS: tuple[Callable[[bytearray, Random], str], ...] = (numbers, numbers, doubles, stretches, definitions)

TEXTS = (b"nan", b"inf", b"-1e308", b"1e309", b'"', b",,,,,,,,", b"\r\n", b"\x00", b"\xef\xbb\xbf", b"0x10", b"9" * 400,
         b"99999999999999999999", b"-", b"a" * 70_000, b"\xff", b"1e18")  # fmt: skip


def cells(content: bytearray, rng: Random) -> str:
    """Put a text into a table, in the place of a few letters."""
    at = place(content, rng)
    content[at : at + int(rng.integers(12))] = TEXTS[int(rng.integers(len(TEXTS)))]
    return "cell"


SQL = (
    "UPDATE messages SET timestamp = timestamp + {big} WHERE rowid > {row}",
    "UPDATE messages SET data = CAST('{text}' AS TEXT) WHERE rowid % 7 = 1",
    "UPDATE messages SET data = zeroblob({row} * 1000) WHERE rowid = {row}",
    "UPDATE messages SET topic_id = {big}",
    "UPDATE messages SET timestamp = '{text}' WHERE rowid = {row}",
    "UPDATE topics SET name = '{text}' || name",
    "UPDATE topics SET type = '{text}', serialization_format = NULL WHERE id = 1",
    "DROP TABLE topics",
    "ALTER TABLE messages RENAME COLUMN data TO rowid",
    "ALTER TABLE messages ADD COLUMN log_time TEXT",
    "ALTER TABLE messages RENAME TO old; CREATE VIEW messages AS SELECT * FROM old",
    "CREATE INDEX hostile ON messages (data)",
)
YAML = (b": [&a [*a]]", b"\n- - - -", b": 99999999999999999999", b": {<<: *b}", b"../../etc/passwd", b"\x00", b": ~")


def place(content: bytearray, rng: Random) -> int:
    """Return a place in a file: the first and the last bytes, headers and indexes, get more than their share."""
    low, high = [(0.0, 1.0), (0.0, 0.02), (0.93, 1.0)][int(rng.integers(3))]
    return min(int(rng.uniform(low, high) * len(content)), max(len(content) - 1, 0))


def database(path: Path, rng: Random) -> str:
    """Change the content or the schema of a SQLite file by SQL, so that its pages stay sound."""
    statement = str(rng.choice(SQL)).format(
        big=int(rng.choice([HOUR_NS, YEAR_NS, -YEAR_NS])), row=int(rng.integers(1, 300)), text="/x\x1b[2J\nError: x"
    )
    try:
        with sqlite3.connect(path) as connection:
            connection.executescript(statement)
    except sqlite3.Error:
        return "SQL refused"
    finally:
        connection.close()
    return f"SQL {statement.split()[0]}"


KINDS = (("mcap", "none"), ("mcap", "zstd"), ("bag", "none"), ("bag", "lz4"), ("db3", "none"), ("db3", "zstd"),
         ("csv", "none"), ("mcap", "lz4"), ("mcap", "without index"), ("mcap", "without chunks"), ("bag", "bz2"),
         ("db3", "zstd-file"), ("csv", "semicolons"), ("csv", "tabs"), ("mcap", "directory"))  # fmt: skip
"""Containers of logs, each with its compression or form: every one that `icrtool.logs` reads."""

MANY_KINDS = 7
"""The first kinds are made twice as often."""

SCHEMA_LOGS = 0.1
"""Share of logs that are made of schemas, of long names and many fields, in each serialization that is read."""

NMEA_LOGS = 0.1
"""Share of logs whose fixes and headings are NMEA sentences."""

VENDOR_LOGS = 0.1
"""Share of logs that hold messages of every type that is read, in place of a drive."""

MUTATED_COLUMNS = 0.12
"""Share of logs that are written with spoilt columns: writing one takes several times as long as reading it."""


def name_of(kind: int) -> str:
    """Return the name of a log of a kind."""
    container, form = KINDS[kind]
    return (
        "log" if form == "directory" else "log" + {"mcap": ".mcap", "bag": ".bag", "db3": "", "csv": ".csv"}[container]
    )


def write(folder: Path, columns: dict[str, np.ndarray], kind: int, wheels: str) -> Path:
    """Write a log."""
    from icrtool.logs.write_log import SensorColumns, WriteOptions, write_log
    from tests.property.test_fuzz_logs import MCAP, rewrite

    container, form = KINDS[kind]
    if container == "csv":
        return write_table(folder / name_of(kind), columns, form)
    compression = "none" if form in ("without index", "without chunks", "directory") else form
    options = WriteOptions(
        container=container, compression=compression, wheels=wheels, wheel_radius_m=0.165, track_width_m=0.55
    )
    # columns of any values: what overflows here is what the log is to hold
    with np.errstate(all="ignore"):
        if compression == form:
            return write_log(folder / name_of(kind), SensorColumns(**columns), options)
        whole = write_log(folder / "whole.mcap", SensorColumns(**columns), options)
    target = folder / name_of(kind)
    if form == "directory":
        target.mkdir()
        (target / "metadata.yaml").write_text(METADATA)
        return whole.replace(target / "log_0.mcap").parent
    rewrite(whole, target, **MCAP[f"mcap {form}"])
    whole.unlink()
    return target


METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  relative_file_paths: [log_0.mcap]
  compression_format: ''
  compression_mode: ''
"""


def write_table(path: Path, columns: dict[str, np.ndarray], form: str) -> Path:
    """Write a table of a row for each wheel sample, with the fixes and headings of the same numbers.

    Parameters
    ----------
    form : what stands between the columns; with semicolons, decimal commas and the mark of UTF-8
    """
    names = {"wheel_stamp_ns": "stamp_ns", "wheel_v_left_mps": "v_left_mps", "wheel_v_right_mps": "v_right_mps",
             "latitude_deg": "latitude_deg", "longitude_deg": "longitude_deg", "heading_rad": "yaw_rad",
             "yaw_rate_radps": "yaw_rate_radps"}  # fmt: skip
    rows = [",".join(names.values())]
    for i in range(len(columns["wheel_stamp_ns"])):
        values = (columns[name][i : i + 1].tolist() for name in names)
        rows.append(",".join(str(value[0]) if value else "" for value in values))
    text = "\n".join(rows)
    if form == "semicolons":
        text = "\ufeff" + text.replace(",", ";").replace(".", ",").replace("\n", "\r\n")
    elif form == "tabs":
        text = text.replace(",", "\t")
    path.write_bytes(text.encode())
    return path


@cache
def clean_log(count: int, kind: int, wheels: str) -> Path:
    """Return a folder with a log that is whole: writing one takes as long as reading it."""
    from dataclasses import asdict

    from tests.property.test_fuzz_logs import drive

    folder = Path(tempfile.mkdtemp(prefix="clean-", dir=scratch()))
    write(folder, asdict(drive(count)), kind, wheels)
    return folder


@cache
def vendor_log(seed: int, wide: bool) -> bytes:
    """Return an MCAP file with every message type that is read, its numbers drawn; not compressed."""
    from unit.logs.test_message_types import START_NS, STEP_NS, TYPES, draw, full, make_store, topic_of, write_mcap

    rng, store = np.random.default_rng(seed), make_store(ros1=False)
    topics = {}
    for message_type in TYPES:
        if wide or rng.random() < 0.2:
            messages = [draw(store, full(message_type), rng) for _ in range(int(rng.choice([2, 31])))]
            for i, message in enumerate(messages):
                if hasattr(message, "header"):
                    stamp_ns = START_NS + i * STEP_NS
                    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            topics[topic_of(message_type)] = (message_type, messages)
    return write_mcap(scratch() / f"vendor-{seed}", topics, store).read_bytes()


@cache
def scratch() -> Path:
    """Return the folder of this run, in memory where that can be."""
    memory = Path("/dev/shm")  # noqa: S108 - the fastest place for small files
    return Path(tempfile.mkdtemp(prefix="icrtool-fuzz-", dir=memory if memory.is_dir() else None))


STRUCTURES = {".mcap": fuzz_structures.mcap, ".bag": fuzz_structures.bag, ".csv": cells}
COUNTS = (2, 30, 60, 100, 400)
NO_METADATA = 0.7
"""Share of SQLite files that are read without their metadata.yaml, which takes most of the time."""


PACKED_LOGS = 0.1
"""Share of logs that are packed, and damaged once more as archives or compressed files."""


def make_log(folder: Path, rng: Random) -> tuple[Path, list[str]]:
    """Write a log as `make_plain` does, packed or not; return it with what was done."""
    path, done = make_plain(folder, rng)
    if rng.random() >= PACKED_LOGS:
        return path, done
    kind = str(rng.choice(PACKERS))
    if rng.random() < 0.3:
        # what stands in an archive may be compressed, or be an archive
        inner = str(rng.choice(PACKERS))
        first = path.parent / f"{path.name}.{inner}"
        first.write_bytes(packed(path, inner, rng))
        path, done = first, [inner, *done]
    target = path.parent / f"{path.name}.{kind}"
    target.write_bytes(packed(path, kind, rng))
    if rng.random() < 0.7:
        content = bytearray(target.read_bytes())
        done = [*done, *(str(BYTE_MUTATIONS[int(rng.integers(4))](content, rng)) for _ in range(2))]
        target.write_bytes(content)
    return target, [kind, *done]


PACKERS = ("gz", "bz2", "xz", "zst", "lz4", "tar", "tar.gz", "tar.bz2", "tar.xz", "tar.zst", "tar.lz4", "zip")
ZIPPED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
TARRED = (tarfile.GNU_FORMAT, tarfile.PAX_FORMAT)
"""How a zip archive is compressed; the formats of tar archives: those with names of any length."""


def packed(path: Path, kind: str, rng: Random) -> bytes:
    """Return a log as a compressed file, or as an archive."""
    folder = "d" * int(rng.choice([1, 1, 90])) + "/" + "é" * int(rng.choice([0, 0, 120])) + path.name
    if kind.startswith("tar") or kind == "zip" or path.is_dir():
        sink = io.BytesIO()
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        if kind == "zip":
            with zipfile.ZipFile(sink, "w", int(rng.choice(ZIPPED))) as archive:
                for file in files:
                    archive.write(file, f"{folder}/{file.name}")
            return sink.getvalue()
        with tarfile.open(fileobj=sink, mode="w", format=int(rng.choice(TARRED))) as archive:
            for file in files:
                archive.add(file, f"{folder}/{file.name}")
        content, kind = sink.getvalue(), kind.removeprefix("tar").removeprefix(".")
        if not kind:
            return content
    else:
        content = path.read_bytes()
    import lz4.frame
    import zstandard

    made: dict[str, Callable[[bytes], bytes]] = {
        "gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress, "zst": zstandard.compress,
        "lz4": lz4.frame.compress,
    }  # fmt: skip
    return made[kind](content)


def make_special(path: Path, rng: Random) -> tuple[Path, list[str]] | None:
    """Write a log that is no damaged drive, of schemas, sentences or vendors' messages; None in most cases."""
    for share, write_log in ((SCHEMA_LOGS, fuzz_schemas.write_log), (NMEA_LOGS, fuzz_nmea.write_log)):
        if rng.random() < share:
            return write_log(path, rng)
    if rng.random() >= VENDOR_LOGS:
        return None
    content = bytearray(vendor_log(int(rng.integers(20)), bool(rng.random() < 0.5)))
    done = [str(rng.choice([doubles, numbers])(content, rng)) for _ in range(int(rng.choice([1, 10, 1000])))]
    path.write_bytes(content)
    return path, ["vendor types", *sorted(set(done))]


def make_plain(folder: Path, rng: Random) -> tuple[Path, list[str]]:
    """Write a short drive in a random container and damage it; return it with what was done."""
    from dataclasses import asdict

    from tests.property.test_fuzz_logs import WHEELS, drive

    if (special := make_special(folder / "log.mcap", rng)) is not None:
        return special
    weights = np.array([2.0 if number < MANY_KINDS else 1.0 for number in range(len(KINDS))])
    kind = int(rng.choice(len(KINDS), p=weights / weights.sum()))
    count, wheels = int(rng.choice(COUNTS)), str(rng.choice(WHEELS))
    done = []
    if rng.random() < MUTATED_COLUMNS:
        columns = asdict(drive(count))
        done = [
            COLUMN_MUTATIONS[int(rng.integers(len(COLUMN_MUTATIONS)))](columns, rng)
            for _ in range(int(rng.integers(1, 4)))
        ]
        path = write(folder, columns, kind, wheels)
    else:
        path = Path(shutil.copytree(clean_log(count, kind, wheels), folder, dirs_exist_ok=True)) / name_of(kind)
    container = " ".join(KINDS[kind])
    if container.startswith("db3") and rng.random() < NO_METADATA:
        (path / "metadata.yaml").unlink()
        path = next(path.iterdir())
    if not done or rng.random() < 0.3:
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        target = files[int(rng.integers(len(files)))]
        if target.suffix == ".db3" and rng.random() < 0.6:
            done.append(database(target, rng))
        else:
            content = bytearray(target.read_bytes())
            for _ in range(int(rng.integers(1, 6))):
                structure = STRUCTURES.get(target.suffix)
                if structure is not None and rng.random() < 0.6:
                    done.append(structure(content, rng))
                elif target.suffix == ".yaml":
                    at = place(content, rng)
                    content[at:at] = YAML[int(rng.integers(len(YAML)))]
                    done.append("YAML")
                else:
                    done.append(BYTE_MUTATIONS[int(rng.integers(len(BYTE_MUTATIONS)))](content, rng))
            target.write_bytes(content)
    return path, [container, *done]


def use(path: Path, *, whole: bool) -> str:
    """Read, align, fit and report a log; return how far it came."""
    import icrtool
    from icrtool.errors import IcrToolError
    from icrtool.output.tables.dropout import format_dropout
    from icrtool.output.tables.run import format_run
    from tests.property.test_fuzz_logs import CONFIG

    stage = "read"
    try:
        log = icrtool.read_log(path, CONFIG)
        if not whole:
            return "read"
        stage = "fitted"
        run = icrtool.fit(log, CONFIG)
        format_run(run)
        stage = "stored"
        run.write(path.parent / "run", plots=())
        stored = icrtool.open_run(path.parent / "run")
        stage = "reported"
        format_dropout(icrtool.dropout_report(stored, horizons_m=[1.0, 5.0]))
    except IcrToolError as err:
        if len(str(err).splitlines()) != 1 or not str(err).isprintable():
            raise AssertionError(f"not one printable line: {str(err)!r}") from err
        return f"refused before {stage}"
    return stage


def load_all() -> None:
    """Use a drive of each container whole, so that libraries and compiled kernels are there."""
    import pandas as pd  # noqa: F401 - a table needs it

    for kind in range(len(KINDS)):
        folder = Path(tempfile.mkdtemp(dir=scratch()))
        shutil.copytree(clean_log(COUNTS[-1], kind, "joint_states"), folder, dirs_exist_ok=True)
        if (came := use(folder / name_of(kind), whole=True)) != "reported":
            raise AssertionError(f"a whole log {KINDS[kind]} is {came}")
        shutil.rmtree(folder)


@dataclass(frozen=True)
class Job:
    """What a worker makes and uses.

    Attributes
    ----------
    seed : what is made of it is the same each time
    whole : whether a log is also fitted and reported
    seconds, megabytes : CPU time and memory that it may take; a log takes more by its size
    keep : directory for findings; empty: none
    measure : whether functions that are reached are recorded
    runs : folder with a run that is forged; None: a log is made
    port : of the web server of addresses; 0: no address is made
    """

    seed: int
    whole: bool
    seconds: float
    megabytes: int
    keep: str
    measure: bool
    runs: Path | None
    port: int


Result = tuple[int, str, list[str], str, float, set[str]]


def work(job: Job, begun: Callable[[float], None] = lambda _: None) -> Result:
    """Make and use one log in this process; return seed, outcome, mutations, traceback, CPU seconds and functions.

    `begun` is called with the CPU seconds that it may take, when it is made.
    """
    seed, seconds, megabytes, keep = job.seed, job.seconds, job.megabytes, job.keep
    folder = Path(tempfile.mkdtemp(dir=scratch()))
    reached: set[str] = set()
    done: list[str] = []
    outcome, text = "", ""
    began = time.process_time()
    try:
        use_it, done, size = made(job, folder)
        seconds = (seconds + size / BYTES_A_SECOND) * (RECORDED_FACTOR if job.measure else 1.0)
        megabytes += int(MEMORY_A_BYTE * size / 1e6)
        before = peak_kilobytes(anew=True)
        began = time.process_time()
        begun(seconds)
        signal.signal(signal.SIGPROF, too_long)
        signal.setitimer(signal.ITIMER_PROF, seconds)
        if job.measure:
            sys.setprofile(lambda frame, event, _: reached.add(where(frame)) if event == "call" else None)
        with warnings.catch_warnings():
            # A warning of a library prints lines of code to whoever uses the log.
            warnings.simplefilter("error")
            outcome = use_it()
        grown = (peak_kilobytes() - before) / 1024
        if grown > megabytes:
            outcome, text = "FOUND", f"{grown:.0f} MB"
    except ValueError as err:
        # The writer refuses some columns: no finding.
        outcome, text = ("not written", "") if not done else ("FOUND", traceback.format_exc() + str(err))
    except BaseException:  # noqa: BLE001 - a fuzzer reports whatever comes
        outcome, text = "FOUND", traceback.format_exc()
    finally:
        sys.setprofile(None)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    used = time.process_time() - began
    if outcome == "FOUND" and keep:
        place = Path(keep) / str(seed)
        place.mkdir(parents=True, exist_ok=True)
        if job.runs is None:  # a forged run leads to devices without end; its seed makes it again
            shutil.copytree(folder, place, dirs_exist_ok=True)
        (place / "finding.txt").write_text(f"{done}\n{text}", encoding="utf-8", errors="replace")
    shutil.rmtree(folder, ignore_errors=True)
    return seed, outcome, done, text, used, reached


def made(job: Job, folder: Path) -> tuple[Callable[[], str], list[str], int]:
    """Make what a job asks for; return what uses it, what was done, and its size beyond what anything may take."""
    if job.runs is not None and job.port:
        inner = folder / "in"
        inner.mkdir()
        address, command = fuzz_addresses.make_case(inner, job.runs / "run", address_log(), job.seed, job.port)
        done = [command[0], repr(address.text[:300])]
        return partial(fuzz_addresses.use_address, inner, address, command, job.port), done, 0
    if job.runs is not None:
        home, done, command = fuzz_runs.make_run(folder, job.runs, job.seed)
        return partial(fuzz_runs.use_run, folder, home, command), done, 0
    path, done = make_log(folder, np.random.default_rng(job.seed))
    return partial(use, path, whole=job.whole), done, bytes_of(path)


def address_log() -> Path:
    """Return the log that lies at addresses."""
    return clean_log(COUNTS[-1], 0, "joint_states") / "log.mcap"


def peak_kilobytes(*, anew: bool = False) -> int:
    """Return the most memory that this process had; `anew`: from now on."""
    with suppress(OSError):
        if anew:
            Path("/proc/self/clear_refs").write_text("5")
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def bytes_of(path: Path) -> int:
    """Return the size of a log."""
    return sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]))


def too_long(*_: object) -> None:
    """End a log that takes too long."""
    raise TimeoutError("CPU time limit")


def where(frame: object) -> str:
    """Return the function of a frame, as module:name, empty outside of icrtool."""
    code = frame.f_code  # type: ignore[attr-defined]
    file: str = code.co_filename
    return f"{file[len(str(ROOT)) + 1 :]}:{code.co_qualname}" if file.startswith(str(ROOT / "icrtool")) else ""


def functions() -> Iterator[str]:
    """Yield every function of the packages under test, as `where` names them."""
    for package in ("logs", "alignment", "motion", "estimation", "dropout_analysis", "records"):
        for file in (ROOT / "icrtool" / package).rglob("*.py"):
            pending = [compile(file.read_text(encoding="utf-8"), str(file), "exec")]
            while pending:
                code = pending.pop()
                inner = [each for each in code.co_consts if hasattr(each, "co_qualname")]
                pending += inner
                yield from (f"{file.relative_to(ROOT)}:{each.co_qualname}" for each in inner if "<" not in each.co_name)


def serve(connection: Connection, megabytes: int) -> None:
    """Use logs in this process, whose memory is bounded beyond what its libraries take."""
    resource.setrlimit(resource.RLIMIT_AS, ((megabytes + 4000) << 20,) * 2)
    gc.set_threshold(100_000)
    while (job := connection.recv()) is not None:
        connection.send(work(job, connection.send))


RENEWED = 500
"""Logs a worker uses: what leaks is seen, and is not taken for the fault of one log."""

BYTES_A_SECOND, MEMORY_A_BYTE = 1e6, 50
"""Of a log, beyond the seconds and the memory of any log."""

RECORDED_FACTOR = 8.0
"""CPU time that a log may take while its functions are recorded, over its CPU time otherwise."""

RUN_SECONDS = 20.0
"""CPU time of a command on a forged run, with its start-up; --baseline and batch fit or read several."""

MAKING_SECONDS = 60.0
"""CPU time in which the fuzzer makes a log."""

WALL_FACTOR = 200
"""A worker that gets no share of the processor is no finding; one that waits is ended after this many limits."""


TOO_LONG = re.compile("CPU time limit|killed after")
"""Why a log is used once more: on a busy machine, and at the first use of a library, the same work takes longer."""


class Worker:
    """A process that uses logs; where it does not come back or dies, that is a finding of its log."""

    def __init__(self, megabytes: int) -> None:
        context = get_context("fork")
        self.connection, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=serve, args=(theirs, megabytes), daemon=True)
        self.process.start()
        theirs.close()
        self.job: Job | None = None
        self.left = RENEWED
        self.cpu_s, self.wall_s, self.most_s = 0.0, 0.0, MAKING_SECONDS

    def give(self, job: Job) -> None:
        """Have it use a log."""
        self.job, self.left = job, self.left - 1
        self.mark(MAKING_SECONDS)
        self.connection.send(job)

    def mark(self, most_s: float) -> None:
        """Count time from here, with the CPU seconds that may pass."""
        self.most_s = most_s
        self.cpu_s, self.wall_s = self.cpu(), time.monotonic()

    def cpu(self) -> float:
        """Return the CPU time of the process [s], 0 where it is gone."""
        try:
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return 0.0
        return (int(fields[11]) + int(fields[12])) / 100

    def result(self) -> Result | None:
        """Return what became of the log; None where nothing is known yet."""
        if self.job is None:
            return None
        if not self.connection.poll():
            used = self.cpu() - self.cpu_s
            if used < 2 * self.most_s and time.monotonic() - self.wall_s < WALL_FACTOR * self.most_s:
                return None
            self.end()
            return self.job.seed, "FOUND", [], f"killed after {used:.1f} s CPU", used, set()
        try:
            answer: Result | float = self.connection.recv()
        except EOFError:
            self.process.join()
            code = self.process.exitcode
            self.end()
            return self.job.seed, "FOUND", [], f"process died ({code})", 0.0, set()
        if isinstance(answer, float):
            self.mark(answer)
            return None
        return answer

    def end(self) -> None:
        """End the process."""
        self.left = 0
        self.process.kill()
        self.process.join()


def use_all(jobs: Iterator[Job], count: int, megabytes: int) -> Iterator[Result]:
    """Yield what becomes of logs in `count` processes."""
    workers = [Worker(megabytes) for _ in range(count)]
    more, again, repeated = True, list[Job](), set[int]()
    while more or again or any(worker.job is not None for worker in workers):
        for i in range(count):
            if workers[i].job is None and (more or again):
                job = again.pop() if again else next(jobs, None)
                more = more and job is not None
                if job is not None:
                    if not workers[i].left:
                        workers[i].end()
                        workers[i] = Worker(megabytes)
                    workers[i].give(job)
        wait([worker.connection for worker in workers if worker.job is not None], 0.2)
        for worker in workers:
            if (found := worker.result()) is not None:
                job, worker.job = worker.job, None
                if job is not None and found[1] == "FOUND" and TOO_LONG.search(found[3]) and job.seed not in repeated:
                    repeated.add(job.seed)
                    again.append(job)
                else:
                    yield found
    for worker in workers:
        worker.end()


def main() -> int:
    """Fuzz, print counts and coverage; 1 where there is a finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=2000, help="logs that are made and read")
    parser.add_argument("--fitted", type=int, default=10, help="one of so many is also fitted and reported")
    parser.add_argument("--runs", type=int, default=0, help="forged runs that are made and used, in place of logs")
    parser.add_argument("--addresses", type=int, default=0, help="odd addresses that are used, in place of logs")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=2.0, help="CPU time a log may take, and 1 s for each MB")
    parser.add_argument("--megabytes", type=int, default=200, help="memory a log may take, and 50 times its size")
    parser.add_argument("--coverage", type=int, default=50, help="functions reached are recorded for one of so many")
    parser.add_argument("--minutes", type=float, default=0.0, help="stop after this time; default: never")
    parser.add_argument("--keep", default="", help="directory for the logs of findings")
    given = parser.parse_args()
    with ExitStack() as serving:
        return fuzz(given, serving)


def fuzz(given: argparse.Namespace, serving: ExitStack) -> int:
    """Fuzz as the options state; `serving` closes what is served to the workers."""
    seeds = range(given.first, given.first + (given.addresses or given.runs or given.logs))
    commands = bool(given.runs or given.addresses)
    source = fuzz_runs.made(scratch()) if commands else None
    seconds = RUN_SECONDS if commands else given.seconds
    # What every command loads once is outside the limits.
    load_all()
    port = serving.enter_context(fuzz_addresses.servers(address_log())) if given.addresses else 0
    jobs: Iterator[Job] = (
        Job(
            seed,
            seed % given.fitted == 0,
            seconds,
            given.megabytes,
            given.keep,
            seed % given.coverage == 0,
            source,
            port,
        )
        for seed in seeds
    )
    counts: Counter[str] = Counter()
    kinds: Counter[str] = Counter()
    reached: set[str] = set()
    slowest = (0.0, 0)
    begun = time.monotonic()
    # Forked workers share the kernels and the clean logs.
    for seed, outcome, done, text, used, names in use_all(jobs, given.jobs, given.megabytes):
        counts[outcome] += 1
        kinds.update(one.split(" ")[0] if len(one) > 30 else one for one in done[: 1 if given.addresses else None])
        reached |= names
        slowest = max(slowest, (used, seed))
        if outcome == "FOUND":
            print(f"seed {seed}: {done}: {text.strip().splitlines()[-1]}", flush=True)
            if given.keep and not (Path(given.keep) / str(seed)).exists():
                place = Path(given.keep) / str(seed)
                place.mkdir(parents=True)
                if not commands:
                    make_log(place, np.random.default_rng(seed))
        if given.minutes and time.monotonic() - begun > 60 * given.minutes:
            print(f"stopped after {given.minutes:g} minutes; go on with --first {max(seed, given.first) + 1}")
            break
    shutil.rmtree(scratch(), ignore_errors=True)
    every = set(functions())
    print("outcomes:", ", ".join(f"{count} {name}" for name, count in counts.most_common()))
    print("mutations:", ", ".join(f"{count} {name}" for name, count in kinds.most_common(30)))
    print(f"slowest: {slowest[0]:.1f} s CPU, seed {slowest[1]}")
    print(f"coverage: {len(reached & every)} of {len(every)} functions of the packages under test")
    return 1 if counts["FOUND"] else 0


if __name__ == "__main__":
    sys.exit(main())
