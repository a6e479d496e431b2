"""Bad input through the command: one line that says what and why, exit status 1, and nothing left on disk."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.typesys import Stores, get_typestore

from icrtool.cli import main
from icrtool.config import load_config
from icrtool.dropout_analysis.dropout_report import dropout
from icrtool.errors import DataError
from icrtool.logs.read_log import read_log
from icrtool.logs.write_log import SensorColumns, WriteOptions, write_log
from icrtool.pipeline import fit

START_NS = 1_760_000_000_000_000_000
ROBOT = ("--set", "robot.track_width_m=0.55", "--set", "robot.wheel_radius_m=0.165")
OPTIONS = WriteOptions(wheel_radius_m=0.165, track_width_m=0.55)
CONFIG = load_config(sets=[*ROBOT[1::2]])
CHUNK, DATA_END = 6, 15
"""Operation codes of MCAP records."""
NO_INTS, NO_FLOATS = np.zeros(0, np.int64), np.zeros(0)


def drive(seconds: float = 20.0) -> SensorColumns:
    """A robot on a circle: wheels and heading at 20 Hz, GNSS at 5 Hz."""
    t = np.arange(0, seconds, 0.05)
    stamps = START_NS + (t * 1e9).astype(np.int64)
    speed, turn = 0.8, 0.3
    heading = turn * t
    north, east = np.cumsum(speed * np.cos(heading)) * 0.05, np.cumsum(speed * np.sin(heading)) * 0.05
    fixes = slice(None, None, 4)
    count = len(t[fixes])
    return SensorColumns(
        wheel_stamp_ns=stamps,
        wheel_position_left_m=(speed + turn * 0.4) * t,
        wheel_position_right_m=(speed - turn * 0.4) * t,
        wheel_v_left_mps=np.full(len(t), speed + turn * 0.4),
        wheel_v_right_mps=np.full(len(t), speed - turn * 0.4),
        gnss_stamp_ns=stamps[fixes],
        latitude_deg=47.0 + north[fixes] / 111_180,
        longitude_deg=8.0 + east[fixes] / 76_060,
        height_m=np.full(count, 400.0),
        gnss_std_m=np.full(count, 0.02),
        gnss_status=np.full(count, 2),
        heading_stamp_ns=stamps,
        heading_rad=heading,
        yaw_rate_radps=np.full(len(t), turn),
    )


def without(columns: SensorColumns, *sensors: str) -> SensorColumns:
    """The same drive with sensors that were never plugged in."""
    fields = {
        "wheel": ("wheel_position_left_m", "wheel_position_right_m", "wheel_v_left_mps", "wheel_v_right_mps"),
        "gnss": ("latitude_deg", "longitude_deg", "height_m", "gnss_std_m"),
        "heading": ("heading_rad", "yaw_rate_radps"),
    }
    changes = {name: NO_FLOATS for sensor in sensors for name in fields[sensor]}
    changes |= {f"{sensor}_stamp_ns": NO_INTS for sensor in sensors}
    return replace(columns, **changes, **({"gnss_status": NO_INTS} if "gnss" in sensors else {}))


def first(columns: SensorColumns, **counts: int) -> SensorColumns:
    """The first samples of a sensor only."""
    of_sensor = {
        "wheel": ("wheel_",),
        "gnss": ("gnss_", "latitude", "longitude", "height"),
        "heading": ("heading", "yaw"),
    }
    changes = {
        name: getattr(columns, name)[: counts[sensor]]
        for sensor, names in of_sensor.items()
        if sensor in counts
        for name in columns.__dataclass_fields__
        if name.startswith(names)
    }
    return replace(columns, **changes)


def log(folder: Path, columns: SensorColumns | None = None, **options: object) -> Path:
    """Write the drive's log into a folder."""
    options_ = replace(OPTIONS, **options)
    name = {"mcap": "drive.mcap", "bag": "drive.bag", "db3": "drive"}[options_.container]
    return write_log(folder / name, columns if columns is not None else drive(), options_)


def rewritten(path: Path, edit: Callable[[str, int, bytes], tuple[int, bytes]], **options: object) -> Path:
    """Write an MCAP log again with other log times and messages, without the library of the tool itself."""
    content = path.read_bytes()
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2", "test")
        schemas, channels = {}, {}
        from io import BytesIO

        for schema, channel, message in NonSeekingReader(BytesIO(content)).iter_messages(log_time_order=False):
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", schemas[schema.id])
            stamp, data = edit(channel.topic, message.log_time, message.data)
            writer.add_message(channels[channel.id], stamp, data, stamp)
        writer.finish()
    return path


def with_header(data: bytes, stamp_ns: int) -> bytes:
    """A CDR message that begins with a Header, stamped anew."""
    seconds, rest = divmod(stamp_ns, 10**9)
    return data[:4] + seconds.to_bytes(4, "little") + rest.to_bytes(4, "little") + data[12:]


def zero_stamps(folder: Path) -> list[str]:
    return [str(rewritten(log(folder), lambda _, stamp, data: (stamp, with_header(data, 0))))]


def stamps_going_back(folder: Path) -> list[str]:
    rng = np.random.default_rng(0)

    def edit(_: str, stamp: int, data: bytes) -> tuple[int, bytes]:
        return stamp, with_header(data, stamp - int(rng.integers(0, 300_000_000)))

    return [str(rewritten(log(folder), edit))]


def duplicated_stamps(folder: Path) -> list[str]:
    def edit(_: str, stamp: int, data: bytes) -> tuple[int, bytes]:
        held = stamp // 100_000_000 * 100_000_000
        return held, with_header(data, held)

    return [str(rewritten(log(folder), edit))]


def truncated_mcap(folder: Path) -> list[str]:
    path = rewritten(log(folder), lambda _, stamp, data: (stamp, data), chunk_size=8000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    return [str(path)]


def mcap_cut_before_anything(folder: Path) -> list[str]:
    path = rewritten(log(folder), lambda _, stamp, data: (stamp, data))
    path.write_bytes(path.read_bytes()[:60])
    return [str(path)]


def only_damaged_chunks(folder: Path) -> list[str]:
    """A log of which no chunk can be decompressed."""
    options = {"compression": CompressionType.ZSTD, "enable_crcs": False, "chunk_size": 2000}
    path = rewritten(log(folder), lambda _, stamp, data: (stamp, data), **options)
    content, at = bytearray(path.read_bytes()), 8
    while content[at] != DATA_END:
        length = int.from_bytes(content[at + 1 : at + 9], "little")
        if content[at] == CHUNK:
            # behind times, size, checksum, "zstd" and the length of what is compressed
            content[at + 9 + 44 : at + 9 + length] = bytes(length - 44)
        at += 9 + length
    path.write_bytes(content)
    return [str(path)]


def unindexed_bag(folder: Path) -> list[str]:
    path = log(folder, container="bag", compression="lz4")
    path.write_bytes(path.read_bytes()[:-2000])
    return [str(path)]


def truncated_db3(folder: Path) -> list[str]:
    path = log(folder, container="db3")
    (path / "drive.db3").write_bytes((path / "drive.db3").read_bytes()[:100_000])
    return [str(path)]


def unknown_compression(folder: Path) -> list[str]:
    keep = {"enable_crcs": False, "index_types": IndexType.NONE, "compression": CompressionType.ZSTD}
    path = rewritten(log(folder), lambda _, stamp, data: (stamp, data), **keep)
    path.write_bytes(path.read_bytes().replace(b"\x04\0\0\0zstd", b"\x04\0\0\0oodl"))
    return [str(path)]


def missing_definitions(folder: Path) -> list[str]:
    """ROS 1 messages in MCAP whose schemas are empty: bundled definitions stand in, and find no joint and no fix."""
    path = folder / "drive.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros1", "test")
        for topic, kind in (("/joint_states", "sensor_msgs/JointState"), ("/fix", "sensor_msgs/NavSatFix")):
            channel = writer.register_channel(topic, "ros1", writer.register_schema(kind, "ros1msg", b""))
            writer.add_message(channel, START_NS, bytes(200), START_NS)
        writer.finish()
    return [str(path)]


def other_serialization(folder: Path) -> list[str]:
    path = folder / "drive.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "test")
        schema = writer.register_schema("sensor_msgs/msg/JointState", "flatbuffer", b"{}")
        writer.add_message(writer.register_channel("/joint_states", "flatbuffer", schema), START_NS, b"{}", START_NS)
        writer.finish()
    return [str(path)]


def wrong_definition(folder: Path) -> list[str]:
    """A schema that is not the messages': every message is too short for it."""
    text = get_typestore(Stores.ROS2_HUMBLE).generate_msgdef("sensor_msgs/msg/NavSatFix", ros_version=2)[0]
    path = log(folder)
    path.write_bytes(
        path.read_bytes().replace(text.encode()[:60], (b"float64[9999] nonsense\n" + b"#" * 99)[:59] + b"\n")
    )
    return [str(path)]


def topics_with_line_breaks(folder: Path) -> list[str]:
    path = folder / "drive.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "test")
        schema = writer.register_schema("a\nb/msg/C\r\x1b[2J", "ros2msg", b"float64 data")
        channel = writer.register_channel("/x\nError: forged\n", "cdr", schema)
        writer.add_message(channel, START_NS, b"", START_NS)
        writer.finish()
    return [str(path)]


def joints_of_a_twist(folder: Path) -> list[str]:
    return [str(log(folder, wheels="twist_stamped")), "--set", 'wheels.left_joints=["l"]']


def in_folder(folder: Path, name: str, content: bytes | None = None) -> list[str]:
    target = folder / name
    if content is None:
        target.mkdir()
    else:
        target.write_bytes(content)
    return [str(target)]


def a_pipe(folder: Path) -> list[str]:
    os.mkfifo(folder / "pipe.mcap")
    return [str(folder / "pipe.mcap")]


def a_file_in_the_way(folder: Path) -> list[str]:
    (folder / "out").write_text("mine")
    return [str(log(folder)), "-o", str(folder / "out")]


def a_folder_below_a_file(folder: Path) -> list[str]:
    (folder / "out").write_text("mine")
    return [str(log(folder)), "-o", str(folder / "out" / "run")]


def somebody_elses_folder(folder: Path) -> list[str]:
    (folder / "out").mkdir()
    (folder / "out" / "thesis.tex").write_text("mine")
    return [str(log(folder)), "-o", str(folder / "out")]


def config_file(folder: Path, text: str) -> list[str]:
    (folder / "robot.toml").write_text(text)
    return [str(log(folder)), "--config", str(folder / "robot.toml")]


def edited(**changes: object) -> Callable[[Path], list[str]]:
    return lambda folder: [str(log(folder, replace(drive(), **changes)))]


def made(change: Callable[[SensorColumns], SensorColumns]) -> Callable[[Path], list[str]]:
    return lambda folder: [str(log(folder, change(drive())))]


def asked(*arguments: str) -> Callable[[Path], list[str]]:
    return lambda folder: [str(log(folder)), *arguments]


FIXES, SAMPLES = len(drive().gnss_stamp_ns), len(drive().wheel_stamp_ns)

REFUSED: dict[str, tuple[Callable[[Path], list[str]], str]] = {
    "no such file": (lambda folder: [str(folder / "drive.mcap")], "no such file or directory"),
    "a name no file may have": (lambda folder: [str(folder / ("n" * 5000))], "File name too long"),
    "a text file": (lambda folder: in_folder(folder, "notes.mcap", b"hello\n" * 99), "not a log; a log is"),
    "a picture": (lambda folder: in_folder(folder, "x.bag", b"\x89PNG\r\n\x1a\n" + bytes(999)), "not a log; a log is"),
    "an empty file": (lambda folder: in_folder(folder, "x.mcap", b""), "an empty file"),
    "an empty folder": (lambda folder: in_folder(folder, "bag"), "not a ROS 2 bag directory"),
    "a folder of other things": (
        lambda folder: [str(in_folder(folder, "x.txt", b"x") and folder)],
        "not a ROS 2 bag dir",
    ),
    "a pipe": (a_pipe, "not a regular file"),
    "an old bag": (
        lambda folder: in_folder(folder, "x.bag", b"#ROSBAG V1.2\n" + bytes(99)),
        "a bag of another version",
    ),
    "no database": (
        lambda folder: in_folder(folder, "x.db3", b"SQLite format 3\0" + bytes(99)),
        "not a readable rosbag2",
    ),
    "cut before anything": (mcap_cut_before_anything, "nothing in it can be read; drive.mcap: cut off"),
    "only damaged chunks": (
        only_damaged_chunks,
        "no message of /joint_states, /gps/fix, /imu/data could be read: chunk at byte ",
    ),
    "a part behind the end": (asked("--from", "1000"), "holds no message; the log begins at "),
    "a part before the begin": (asked("--to", "2001-01-01"), "holds no message; the log begins at "),
    "an unknown compression": (unknown_compression, "compression 'oodl' is not known"),
    "missing definitions": (missing_definitions, "no wheels"),
    "another serialization": (other_serialization, "serialization 'flatbuffer' is not read"),
    "topics with line breaks": (topics_with_line_breaks, r"/x\nError: forged\n"),
    "no wheels": (made(lambda columns: without(columns, "wheel")), "no wheels"),
    "no GNSS": (made(lambda columns: without(columns, "gnss")), "no position"),
    "no heading and no distance": (lambda folder: [str(log(folder, without(drive(1.5), "heading")))], "no heading"),
    "no orientation for the paper's filter": (
        lambda folder: [str(log(folder, without(drive(), "heading"))), "--set", "filter.preset=paper"],
        "orientation",
    ),
    "nothing at all": (made(lambda columns: without(columns, "wheel", "gnss", "heading")), "no topic at all"),
    "no position is a number": (edited(latitude_deg=np.full(FIXES, np.nan)), "no usable fix"),
    "no position is infinite": (edited(longitude_deg=np.full(FIXES, np.inf)), "no usable fix"),
    "no fix ever": (edited(gnss_status=np.full(FIXES, -1)), "no usable fix"),
    "nowhere on earth": (edited(latitude_deg=np.full(FIXES, 4711.0)), "no usable fix"),
    "at zero, zero": (edited(latitude_deg=np.zeros(FIXES), longitude_deg=np.zeros(FIXES)), "no usable fix"),
    "no wheel speed is a number": (
        edited(
            wheel_v_left_mps=np.full(SAMPLES, np.nan),
            wheel_v_right_mps=np.full(SAMPLES, np.nan),
            wheel_position_left_m=np.full(SAMPLES, np.nan),
            wheel_position_right_m=np.full(SAMPLES, np.nan),
        ),
        "",
    ),
    "one sample of each": (made(lambda columns: first(columns, wheel=1, gnss=1, heading=1)), ""),
    "one wheel sample": (made(lambda columns: first(columns, wheel=1)), "1 usable wheel sample"),
    "no overlap": (edited(gnss_stamp_ns=drive().gnss_stamp_ns + 10**12), ""),
    "no overlap of the heading": (edited(heading_stamp_ns=drive().heading_stamp_ns - 10**12), ""),
    "a topic that is not there": (asked("--set", "topics.gnss=/nope"), "topics.gnss: /nope is not in"),
    "a topic of no use": (asked("--set", "topics.heading=/gps/fix"), "topics.heading: /gps/fix"),
    "half a pair of topics": (asked("--set", "topics.wheel_left=/l"), "wheel_left and wheel_right come together"),
    "a joint that is not there": (
        asked("--set", 'wheels.left_joints=["l"]'),
        "wheels.left_joints: no message of /joint",
    ),
    "a start on the wrong side": (
        asked("--set", "filter.initial_y_icr_right_m=-0.6"),
        "filter.initial_y_icr_right_m: preset field keeps the right ICR right and the left one left (right > 0 > left)",
    ),
    "an unknown key": (asked("--set", "topics.gps=/fix"), "topics.gps: unknown configuration key"),
    "an unknown section": (asked("--set", "gps.topic=/fix"), "gps: unknown configuration key"),
    "a word for a number": (asked("--set", "robot.track_width_m=wide"), "robot.track_width_m: "),
    "a width below zero": (asked("--set", "robot.track_width_m=-1"), "robot.track_width_m: "),
    "a width that is no number": (asked("--set", "robot.track_width_m=nan"), "robot.track_width_m: "),
    "a setting without a value": (asked("--set", "robot.track_width_m"), "not of the form section.key=value"),
    "an unknown robot": (asked("--robot", "marvin"), "robot 'marvin'"),
    "no configuration file": (asked("--config", "nope.toml"), "nope.toml: cannot be read"),
    "a configuration file with an unknown key": (
        lambda folder: config_file(folder, "[robot]\nwheels = 4\n"),
        "robot.wheels",
    ),
    "a configuration file that is none": (lambda folder: config_file(folder, "wheels: 4\n"), "not a TOML file"),
    "a file in the way": (a_file_in_the_way, "a file is there"),
    "a folder below a file": (a_folder_below_a_file, "is a file"),
    "somebody else's folder": (somebody_elses_folder, "holds something that is not"),
}

RUNS: dict[str, tuple[Callable[[Path], list[str]], str]] = {
    "a truncated MCAP": (truncated_mcap, "drive.mcap: cut off or damaged at byte "),
    "an un-indexed bag": (unindexed_bag, "drive.bag: has no index"),
    "a truncated db3": (truncated_db3, "drive.db3: "),
    "zero in every header": (zero_stamps, "of the header stamps are 0; log time is used"),
    "stamps that go back": (stamps_going_back, "go back"),
    "duplicated stamps": (duplicated_stamps, "in bursts of"),
    "no heading": (made(lambda columns: without(columns, "heading")), "the heading is estimated: "),
    "no heading is a number": (edited(heading_rad=np.full(SAMPLES, np.nan)), "no valid quaternion"),
    "joints named for a twist": (joints_of_a_twist, "drive: wheels.left_joints is not used: "),
    "a name that is no UTF-8": (
        lambda folder: [shutil.move(log(folder), os.fsdecode(bytes(folder) + b"/\xff.mcap"))],
        "",
    ),
}


AS_A_USER = ("an empty file", "a pipe", "a truncated MCAP", "a name that is no UTF-8")
"""Run as a process of their own, which takes a second each; the others call the command where they are.

A case of each status, one that might wait for ever, and one of the bytes of an argument.
"""


@dataclass(frozen=True)
class Done:
    status: int
    out: str
    err: list[str]
    before: dict[str, int]
    after: dict[str, int]
    warnings: list[str]


def listing(folder: Path) -> dict[str, int]:
    """Everything below a folder, hidden files too, with its size; a command may be at work there."""
    found = {}
    for path in sorted(folder.rglob("*")):
        with suppress(FileNotFoundError):
            found[str(path.relative_to(folder))] = path.lstat().st_size
    return found


def warnings_in(folder: Path) -> list[str]:
    """The warnings of the runs that were written into a folder."""
    runs = folder.glob("icrtool-runs/*/run.json")
    return [one for run in runs for one in json.loads(run.read_text(encoding="utf-8"))["warnings"]]


def words(arguments: list[str]) -> list[str]:
    """The arguments of the command: without plots, and of a robot that is known unless the case is about that."""
    named = {"--robot", "--config"} & set(arguments) or "robot." in " ".join(arguments)
    return ["fit", *arguments, "--plots", "none", *(() if named else ROBOT)]


def start(folder: Path, arguments: list[str]) -> subprocess.Popen[str]:
    """Start the command in a folder, which is also that of its temporary files."""
    command = [sys.executable, "-m", "icrtool", *words(arguments)]
    environment = {**os.environ, "TMPDIR": str(folder), "PYTHONWARNINGS": "error::RuntimeWarning"}
    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=folder, env=environment, text=True, errors="replace", **streams)


def run_as_a_user(folder: Path, make: Callable[[Path], list[str]]) -> Done:
    folder.mkdir()
    arguments = make(folder)
    before = listing(folder)
    with start(folder, arguments) as process:
        out, err = process.communicate(timeout=120)
    return Done(process.returncode, out, err.splitlines(), before, listing(folder), warnings_in(folder))


@pytest.fixture(scope="module")
def user(tmp_path_factory):
    """Run the cases of a user side by side; a test waits for its own."""
    root = tmp_path_factory.mktemp("user")
    with ThreadPoolExecutor(2) as pool:
        pending: dict[str, Future[Done]] = {
            case: pool.submit(run_as_a_user, root / str(row), (REFUSED | RUNS)[case][0])
            for row, case in enumerate(AS_A_USER)
        }
        yield lambda case: pending[case].result()
        pool.shutdown(cancel_futures=True)


@pytest.fixture
def run(user, tmp_path, monkeypatch, capsys):
    """Run a case, in this process or as a user."""

    def run_here(case: str) -> Done:
        if case in AS_A_USER:
            return user(case)
        arguments = (REFUSED | RUNS)[case][0](tmp_path)
        before = listing(tmp_path)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        monkeypatch.setattr("sys.argv", ["icrtool", *words(arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        out, err = capsys.readouterr()
        status, after = int(left.value.code or 0), listing(tmp_path)
        return Done(status, out, err.splitlines(), before, after, warnings_in(tmp_path))

    return run_here


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_refused_in_one_line_and_leaves_nothing(run, case):
    found = run(case)
    errors = [line for line in found.err if not line.startswith("Warning: ")]
    assert found.status == 1, found
    assert len(errors) == 1, found.err
    assert errors[0].startswith("Error: ")
    assert REFUSED[case][1] in errors[0]
    assert found.out == ""
    assert found.after == found.before


@pytest.mark.parametrize("case", RUNS)
def test_what_survives_is_used_and_what_was_lost_is_a_warning(run, case):
    found = run(case)
    assert found.status == 0, found.err
    *lines, last = found.err or [""]
    assert all(line.startswith("Warning: ") for line in lines)
    assert len(lines) == 2 if "more warning" in last else last.startswith("Warning: ") or not last
    assert any(RUNS[case][1] in line for line in (*found.err, *found.warnings)) or not RUNS[case][1]
    new = set(found.after) - set(found.before)
    assert {Path(name).parts[0] for name in new} == {"icrtool-runs"}
    assert {"run.json", "states.csv"} <= {Path(name).name for name in new}


@pytest.mark.parametrize(("turning", "source"), [(False, "wheels_course"), (True, "gyro_course")])
def test_a_heading_that_is_no_number_is_made_of_the_next_best(tmp_path, turning, source):
    """A constant turn rate is that of a gyro that is stuck."""
    columns = replace(drive(), heading_rad=np.full(SAMPLES, np.nan))
    if turning:
        noise = np.random.default_rng(0).normal(0, 1e-3, SAMPLES)
        columns = replace(columns, yaw_rate_radps=columns.yaw_rate_radps + noise)
    config = load_config(sets=[one for one in ROBOT if one != "--set"])
    heading = fit(read_log(log(tmp_path, columns), config), config).summary["heading"]
    assert heading["source"] == source
    assert 0.0 < heading["std_deg"] < 10.0


@pytest.mark.parametrize(
    ("options", "moments"), [({}, (0, 1, 3)), ({"container": "db3", "compression": "zstd-file"}, (1,))],
    ids=["mcap", "db3.zstd"],
)  # fmt: skip
def test_an_interrupted_run_leaves_a_whole_directory_or_nothing(tmp_path, options, moments):
    stopped = 0
    # When nothing is written yet, when the directory is there (or the file that was compressed), when it holds files.
    for turn, entries in enumerate(moments):
        folder = tmp_path / str(turn)
        folder.mkdir()
        path = log(folder, drive(120), **options)
        before = listing(folder)
        with start(folder, [str(path)]) as process:
            while process.poll() is None and len(set(listing(folder)) - set(before)) < entries:
                time.sleep(0.005)
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=120)
        after = set(listing(folder)) - set(before)
        names = (".icrtool-files", "run.json", "states.csv", "measurements.npz", "events.csv", "B2SUMS")
        files = {f"icrtool-runs/drive/{name}" for name in names}
        # The signal may come between the last rename and the last line of output.
        assert after in (set(), {"icrtool-runs"}, {"icrtool-runs", "icrtool-runs/drive", *files})
        assert len(after) > 1 or process.returncode != 0
        stopped += len(after) < 2
    assert stopped > 0


@pytest.mark.parametrize("value", [np.inf, 1.7e308, 9e29, 5e-324])
@pytest.mark.parametrize(
    "names",
    [
        ("wheel_position_left_m", "wheel_position_right_m"), ("wheel_v_left_mps",), ("latitude_deg",), ("height_m",),
        ("gnss_std_m",), ("heading_rad",), ("yaw_rate_radps",),
    ],
)  # fmt: skip
def test_a_log_with_extreme_values_is_read_and_fitted_without_a_warning(
    tmp_path: Path, names: tuple[str, ...], value: float
) -> None:
    usual = drive(30.0)
    changed = {name: getattr(usual, name).copy() for name in names}
    for column in changed.values():
        column[5::14], column[12::14] = value, -value
    with np.errstate(all="ignore"):  # of the writer: turns and squares of them
        path = log(tmp_path, replace(usual, **changed))
    run = fit(read_log(path, CONFIG), CONFIG)
    assert np.isfinite(run.table.std_north_m).all()
    dropout(run)


HOUR_NS, YEAR_NS = 3_600_000_000_000, 31_557_600_000_000_000


def clock_set(folder: Path, jump_ns: int, *, topic: str = "", header: bool = True, log_time: bool = True) -> Path:
    """The drive with clocks that are set by `jump_ns` after half of it: of all topics, or of one."""

    def edit(name: str, stamp: int, data: bytes) -> tuple[int, bytes]:
        later = stamp + (jump_ns if stamp >= START_NS + 10 * 10**9 and topic in name else 0)
        return later if log_time else stamp, with_header(data, later if header else stamp)

    return rewritten(log(folder), edit)


SORTED, PAUSED, APART = "log time goes back", "no samples for", "more than a day apart"


@pytest.mark.parametrize("topic", ["", "/joint_states", "/gps/fix", "/imu/data"])
@pytest.mark.parametrize(
    ("jump_ns", "words"),
    [(HOUR_NS, {PAUSED}), (-HOUR_NS, {SORTED, PAUSED}), (YEAR_NS, {APART}), (-YEAR_NS, {SORTED, APART})],
)
def test_a_clock_that_is_set_is_reported(tmp_path: Path, topic: str, jump_ns: int, words: set[str]) -> None:
    warnings = "\n".join(read_log(clock_set(tmp_path, jump_ns, topic=topic), CONFIG).warnings)
    assert {word for word in (SORTED, PAUSED, APART) if word in warnings} == words
    assert warnings.count(SORTED) <= 1, "one warning names all streams"


def test_a_drive_in_parts_an_hour_apart_gives_the_same_icrs(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    usual = fit(read_log(log(tmp_path / "whole"), CONFIG), CONFIG).summary["icr"]["final"]
    for jump_ns in (HOUR_NS, -HOUR_NS):
        folder = tmp_path / str(jump_ns)
        folder.mkdir()
        found = fit(read_log(clock_set(folder, jump_ns), CONFIG), CONFIG).summary["icr"]["final"]
        # in half as long a drive x may not be shown
        shown = {name: value for name, value in found.items() if value is not None}
        assert {"y_icr_right_m", "y_icr_left_m"} <= set(shown)
        assert shown == pytest.approx({name: usual[name] for name in shown}, abs=0.002), "metres"


@pytest.mark.parametrize("clocks", [{"header": True}, {"header": False}])
def test_a_clock_that_is_set_back_so_that_times_come_again_is_refused(tmp_path: Path, clocks: dict[str, bool]) -> None:
    with pytest.raises(DataError, match=r"log time goes back by 5\.0 s"):
        read_log(clock_set(tmp_path, -5 * 10**9, **clocks), CONFIG)


@pytest.mark.parametrize("shift_ns", [-15 * 10**9, -HOUR_NS, 8 * 10**9])
def test_a_few_messages_out_of_place_are_sorted(tmp_path: Path, shift_ns: int) -> None:
    numbers: dict[str, int] = {}

    def edit(topic: str, stamp: int, data: bytes) -> tuple[int, bytes]:
        numbers[topic] = numbers.get(topic, 0) + 1
        stamp += shift_ns if numbers[topic] in (60, 61, 70) else 0
        return stamp, with_header(data, stamp)

    found = read_log(rewritten(log(tmp_path), edit), CONFIG)
    assert any(SORTED in warning for warning in found.warnings)
    assert len(found.wheels.stamp_ns) >= 397


@pytest.mark.parametrize("topic", ["", "/joint_states", "/gps/fix", "/imu/data"])
@pytest.mark.parametrize("jump_ns", [-300_000_000, -(10**9), -60 * 10**9, -HOUR_NS, -YEAR_NS, 10**9, HOUR_NS, YEAR_NS])
def test_header_stamps_of_a_clock_that_is_set_are_named_and_moved(tmp_path: Path, topic: str, jump_ns: int) -> None:
    usual = read_log(log(tmp_path), CONFIG)
    (tmp_path / "set").mkdir()
    found = read_log(clock_set(tmp_path / "set", jump_ns, topic=topic, log_time=False), CONFIG)
    (note,) = found.warnings
    moment = np.datetime64((START_NS + 9_950_000_000) // 10**9, "s")
    sense = "back" if jump_ns < 0 else "ahead"
    assert f"header stamps go {sense} by {abs(jump_ns) / 1e9:.1f} s after {moment}Z" in note
    for one, before in ((found.wheels, usual.wheels), (found.gnss, usual.gnss), (found.heading, usual.heading)):
        assert one.stamp_ns == pytest.approx(before.stamp_ns, abs=1_000), "nanoseconds: log times have no jitter here"


@pytest.mark.parametrize("jump_ns", [HOUR_NS, YEAR_NS])
def test_first_header_stamps_of_another_clock_are_left_to_their_log_times(tmp_path: Path, jump_ns: int) -> None:
    usual = read_log(path := log(tmp_path), CONFIG)
    before = START_NS + 120_000_000
    edited = rewritten(path, lambda _, stamp, data: (stamp, with_header(data, stamp - jump_ns * (stamp < before))))
    found = read_log(edited, CONFIG)
    assert any("header stamps come from another clock" in warning for warning in found.warnings)
    assert found.wheels.stamp_ns == pytest.approx(usual.wheels.stamp_ns, abs=1_000)


@pytest.mark.skipif(sys.platform == "win32", reason="no such limit there")
def test_a_recording_of_more_files_than_a_process_may_open_at_first_is_read(tmp_path: Path) -> None:
    import resource

    folder = tmp_path / "many"
    folder.mkdir()
    shutil.move(log(tmp_path), folder / "log_0.mcap")
    for number in range(1, 60):
        with (folder / f"log_{number}.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            writer.finish()
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    command = [sys.executable, "-P", "-m", "icrtool", "info", str(folder), "--json", *ROBOT]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (40, most)),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "open files" not in done.stdout + done.stderr


def test_info_of_a_log_without_heading_and_wheel_radius_states_what_is_missing(icrtool, tmp_path: Path) -> None:
    status, out, _ = icrtool("info", str(log(tmp_path, first(drive(), heading=1))))
    assert status == 1
    assert "cannot be fitted: robot.wheel_radius_m" in out
    assert "all three overlap" not in out


@pytest.mark.parametrize("few", [{name: count} for name in ("wheel", "gnss", "heading") for count in (1, 2)], ids=str)
def test_info_of_a_log_with_hardly_a_sample_is_no_traceback(icrtool, tmp_path: Path, few: dict[str, int]) -> None:
    _, out, _ = icrtool("info", str(log(tmp_path, first(drive(), **few))), *ROBOT)
    assert re.match("verdict +(cannot be fitted|not usable|can be fitted, not all ICRs are shown)", out), out


def test_info_of_a_log_without_messages_lists_no_topic(icrtool, tmp_path: Path) -> None:
    with (tmp_path / "empty.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    status, out, _ = icrtool("info", str(tmp_path / "empty.mcap"), "-v")
    assert status == 1
    assert "no candidate" in out
