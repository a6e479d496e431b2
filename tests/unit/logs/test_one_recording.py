"""A directory without metadata.yaml: one recording in several files, or several recordings."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from icrtool.errors import LogError
from icrtool.logs.containers.open_log import open_log

START_NS = 1_760_000_000_000_000_000
SECOND_NS = 1_000_000_000
HOUR_NS = 3600 * SECOND_NS
TOPIC, KIND = "/a", "std_msgs/msg/Float64"
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)


def make_stamps(begin_ns: int = START_NS) -> list[int]:
    """Three seconds of messages."""
    return [begin_ns + row * SECOND_NS // 100 for row in range(301)]


def write_mcap(path: Path, stamps: list[int]) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        schema = writer.register_schema(KIND, "ros2msg", b"float64 data")
        channel = writer.register_channel(TOPIC, "cdr", schema)
        for stamp in stamps:
            writer.add_message(channel, stamp, bytes(12), stamp)
        writer.finish()


def write_rosbags(path: Path, stamps: list[int]) -> None:
    ros1 = path.suffix == ".bag"
    with Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        connection = bag.add_connection(TOPIC, KIND, typestore=ROS1 if ros1 else ROS2)
        for stamp in stamps:
            bag.write(connection, stamp, bytes(8 if ros1 else 12))


def read_log(path: Path) -> tuple[list[int], list[str]]:
    """Read the log times, and what was said."""
    container = open_log(path)
    try:
        wanted = frozenset(channel.id for channel in container.channels)
        stamps = [stamp for block in container.blocks(wanted) for stamp in block.log_time_ns.tolist()]
        return stamps, [one.sentence for one in container.problems]
    finally:
        container.close()


def two_files(folder: Path, shift_ns: int) -> tuple[Path, list[int]]:
    """Two files of one kind; the second begins so long after the first did."""
    first, second = make_stamps(), make_stamps(START_NS + shift_ns)
    folder.mkdir()
    write_mcap(folder / "a.mcap", first)
    write_mcap(folder / "b.mcap", second)
    return folder, first + second


def test_recordings_of_several_kinds_are_refused_by_name(tmp_path: Path) -> None:
    stamps, bag = make_stamps(), tmp_path / "bag"
    write_mcap(tmp_path / "new.mcap", stamps)
    assert read_log(tmp_path)[0] == stamps
    write_rosbags(bag, stamps)
    with pytest.raises(LogError, match=r"holds more than one recording: new\.mcap, bag; name one of them"):
        open_log(tmp_path)
    shutil.move(next(bag.glob("*.db3")), tmp_path / "old.db3")
    shutil.rmtree(bag)
    with pytest.raises(LogError, match=r"holds more than one recording: new\.mcap, old\.db3; name one of them"):
        open_log(tmp_path)
    (tmp_path / "new.mcap").unlink()
    write_rosbags(tmp_path / "ros1.bag", stamps)
    with pytest.raises(LogError, match=r"holds more than one recording: old\.db3, ros1\.bag; name one of them"):
        open_log(tmp_path)
    (tmp_path / "old.db3").unlink()
    with pytest.raises(LogError, match=r"not a ROS 2 bag directory; it holds ros1\.bag"):
        open_log(tmp_path)


def test_recordings_hours_apart_are_refused_by_name_and_a_pause_is_not(tmp_path: Path) -> None:
    paused, stamps = two_files(tmp_path / "paused", HOUR_NS)
    assert read_log(paused)[0] == stamps
    apart, _ = two_files(tmp_path / "apart", 3 * HOUR_NS)
    with pytest.raises(LogError, match=r"not one recording: 3\.0 h pass between a\.mcap and b\.mcap; name one of a"):
        read_log(apart)


def test_recordings_at_the_same_time_are_said_and_an_overlap_of_buffers_is_not(tmp_path: Path) -> None:
    together, stamps = two_files(tmp_path / "together", SECOND_NS)
    read, said = read_log(together)
    assert read == stamps
    assert "a.mcap and b.mcap overlap by 2 s and were read as one recording" in said[-1]
    split, _ = two_files(tmp_path / "split", 5 * SECOND_NS // 2)
    assert len(read_log(split)[1]) == 1


def test_a_run_is_told_from_a_log(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(LogError, match="is a run, not a log; icrtool dropout-report reads it"):
        open_log(tmp_path)
    runs = tmp_path / "runs"
    for name in ("one", "two"):
        (runs / name).mkdir(parents=True)
        (runs / name / "run.json").write_text("{}")
    with pytest.raises(LogError, match="holds runs, not a log: one, two; icrtool dropout-report reads one of them"):
        open_log(runs)
