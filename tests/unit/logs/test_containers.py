"""Every container, written by another library and read by that library too: no message and no byte may differ."""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import zstandard
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from icrtool.errors import LogError
from icrtool.logs.containers.container import MessageBlock, make_ahead
from icrtool.logs.containers.open_log import open_log
from icrtool.logs.containers.sqlite_bag import SqliteBag

START_NS = 1_760_000_000_000_000_000
TOPICS = {"/a": "std_msgs/msg/String", "/b": "std_msgs/msg/Float64", "/ns/c": "sensor_msgs/msg/Imu"}
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
CDR_HEAD = b"\x00\x01\x00\x00"

Message = tuple[str, int, bytes]
"""Topic, log time [ns], what was recorded."""


def make_messages(count: int = 300, seed: int = 1) -> list[Message]:
    """Messages of no, few and many bytes; the long ones span pages and chunks."""
    rng = np.random.default_rng(seed)
    names = list(TOPICS)
    lengths = rng.choice([0, 1, 7, 100, 20_000], size=count, p=[0.05, 0.05, 0.2, 0.68, 0.02])
    return [
        (names[row % 3], START_NS + row * 1_000_003, CDR_HEAD + rng.integers(0, 4, length, dtype=np.uint8).tobytes())
        for row, length in enumerate(lengths)
    ]


@dataclass
class Read:
    messages: list[Message]
    types: dict[str, str]
    problems: list[str]


def read_log(path: Path, only: set[str] | None = None) -> Read:
    """Read a log with the code under test."""
    container = open_log(path)
    try:
        topics = {channel.id: channel.topic for channel in container.channels}
        wanted = {number for number, topic in topics.items() if only is None or topic in only}
        messages = []
        for block in container.blocks(frozenset(wanted)):
            for channel, stamp, start, end in zip(*(x.tolist() for x in block[1:]), strict=True):
                if channel in wanted:
                    messages.append((topics[channel], stamp, block.data[start:end].tobytes()))
        types = {channel.topic: channel.message_type for channel in container.channels}
        return Read(messages, types, [one.sentence for one in container.problems])
    finally:
        container.close()


def write_mcap(path: Path, messages: list[Message], **options: object) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, kind in TOPICS.items():
            text = ROS2.generate_msgdef(kind, ros_version=2)[0]
            channels[topic] = writer.register_channel(
                topic, "cdr", writer.register_schema(kind, "ros2msg", text.encode())
            )
        for row, (topic, stamp, data) in enumerate(messages):
            writer.add_message(channels[topic], stamp, data, stamp + 5, row)
            if row == len(messages) // 2:
                writer.add_attachment(stamp, stamp, "calibration.txt", "text/plain", b"x" * 5000)
                writer.add_metadata("robot", {"name": "icr"})
        writer.finish()
    return path


def mcap_messages(path: Path) -> list[Message]:
    with path.open("rb") as stream:
        found = NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in found]


def write_bag(path: Path, messages: list[Message], compression: str = "none", chunk_bytes: int = 4000) -> Path:
    bag = Writer1(path)
    if compression != "none":
        bag.set_compression(Writer1.CompressionFormat[compression.upper()])
    with bag:
        bag.chunk_threshold = chunk_bytes
        connections = {topic: [bag.add_connection(topic, kind, typestore=ROS1)] for topic, kind in TOPICS.items()}
        connections["/a"].append(bag.add_connection("/a", TOPICS["/a"], typestore=ROS1, callerid="/second", latching=1))
        for row, (topic, stamp, data) in enumerate(messages):
            bag.write(connections[topic][row // 3 % len(connections[topic])], stamp, data)
    return path


def write_directory(
    path: Path, messages: list[Message], plugin: StoragePlugin, mode: CompressionMode = CompressionMode.NONE
) -> Path:
    bag = Writer2(path, version=9, storage_plugin=plugin)
    bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        connections = {topic: bag.add_connection(topic, kind, typestore=ROS2) for topic, kind in TOPICS.items()}
        for topic, stamp, data in messages:
            bag.write(connections[topic], stamp, data)
    return path


def rosbags_messages(path: Path) -> list[Message]:
    reader = Reader1(path) if path.suffix == ".bag" else Reader2(path)
    with reader:
        return [(connection.topic, stamp, bytes(data)) for connection, stamp, data in reader.messages()]


def edit_metadata(directory: Path, edit: Callable[[dict[str, object]], None]) -> None:
    """Change what a directory's metadata.yaml says."""
    yaml, file = YAML(typ="safe"), directory / "metadata.yaml"
    document = yaml.load(file.read_text(encoding="utf-8"))
    edit(document["rosbag2_bagfile_information"])
    with file.open("w", encoding="utf-8") as stream:
        yaml.dump(document, stream)


def split_directory(path: Path, plugin: StoragePlugin, parts: int = 3) -> tuple[Path, list[Message]]:
    """Make a directory of several storage files, named by metadata.yaml as rosbag2 of old did: with the folder."""
    messages = make_messages(90 * parts)
    kind = "mcap" if plugin == StoragePlugin.MCAP else "db3"
    names = [f"{path.name}_{part}.{kind}" for part in range(parts)]
    for part, name in enumerate(names):
        one = write_directory(path.with_name(f"part{part}"), messages[90 * part : 90 * part + 90], plugin)
        path.mkdir(exist_ok=True)
        shutil.move(next(one.glob(f"*.{kind}")), path / name)
        shutil.copy(one / "metadata.yaml", path / "metadata.yaml")
    edit_metadata(path, lambda info: info.update(relative_file_paths=names, message_count=len(messages)))
    return path, messages


MCAP_OPTIONS = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "none": {"compression": CompressionType.NONE},
    "one chunk": {"chunk_size": 1 << 30},
    "no chunks": {"use_chunking": False},
    "no chunks, no index": {"use_chunking": False, "index_types": IndexType.NONE, "use_statistics": False},
    "no statistics": {"use_statistics": False},
    "no message index": {"index_types": IndexType.CHUNK},
    "no chunk index": {"index_types": IndexType.MESSAGE},
    "no index": {"index_types": IndexType.NONE},
    "no summary": {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_summary_offsets": False,
    },
    "channels not repeated": {"repeat_channels": False},
    "schemas not repeated": {"repeat_schemas": False},
    "no summary offsets": {"use_summary_offsets": False},
    "no checksums": {"enable_crcs": False},
    "all checksums": {"enable_data_crcs": True},
}


@pytest.mark.parametrize("options", MCAP_OPTIONS.values(), ids=MCAP_OPTIONS)
def test_mcap_holds_what_the_mcap_library_reads_in_its_order(tmp_path, options):
    messages = make_messages()
    path = write_mcap(tmp_path / "log.mcap", messages, **{"chunk_size": 4000, **options})
    read = read_log(path)
    assert read.messages == mcap_messages(path) == messages
    assert read.problems == []
    assert read.types == {topic: kind.replace("/msg/", "/") for topic, kind in TOPICS.items()}


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"index_types": IndexType.NONE}], ids=str)
def test_mcap_gives_the_topics_asked_for_whatever_else_stands_beside(tmp_path, options):
    messages = make_messages()
    path = write_mcap(tmp_path / "log.mcap", messages, chunk_size=500, **options)
    assert read_log(path, {"/b"}).messages == [message for message in messages if message[0] == "/b"]


def test_mcap_is_the_same_on_a_second_pass(tmp_path):
    path = write_mcap(tmp_path / "log.mcap", make_messages(), chunk_size=4000, index_types=IndexType.NONE)
    path.write_bytes(path.read_bytes()[:-3000])
    container = open_log(path)
    passes = [
        [block.data.tobytes() for block in container.blocks(frozenset({1, 2, 3}))]
        + [one.sentence for one in container.problems]
        for _ in range(3)
    ]
    container.close()
    assert passes[0] == passes[1] == passes[2]
    assert len(container.problems) == 1


def test_mcap_of_ros_1_messages_tells_encoding_and_definition(tmp_path):
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros1", library="test")
        text = ROS1.generate_msgdef("sensor_msgs/msg/Imu", ros_version=1)[0]
        schema = writer.register_schema("sensor_msgs/Imu", "ros1msg", text.encode())
        channel = writer.register_channel("/imu", "ros1", schema)
        writer.add_message(channel, START_NS, b"anything", START_NS)
        writer.finish()
    container = open_log(path)
    (found,) = container.channels
    container.close()
    assert (found.message_type, found.encoding, found.definition) == ("sensor_msgs/Imu", "ros1", text)
    assert found.count == 1
    assert read_log(path).messages == mcap_messages(path)


def test_mcap_messages_beside_chunks_are_read_too(tmp_path):
    from mcap.data_stream import RecordBuilder
    from mcap.records import Message as McapMessage

    messages = make_messages()
    path = write_mcap(tmp_path / "log.mcap", messages, chunk_size=4000, enable_crcs=False)
    content = path.read_bytes()
    loose = RecordBuilder()
    McapMessage(1, START_NS + 9, b"loose", START_NS, 0).write(loose)
    data_end = content.rindex(b"\x0f" + (4).to_bytes(8, "little"))
    with path.open("wb") as stream:
        # Behind the last chunk, where no offset of the summary's chunk index moves.
        footer = bytearray(content[data_end:])
        for field in (8 + 20, 8 + 12):
            at = len(footer) - field
            footer[at : at + 8] = (int.from_bytes(footer[at : at + 8], "little") + 36).to_bytes(8, "little")
        stream.write(content[:data_end] + loose.end() + footer)
    assert path.stat().st_size == len(content) + 36
    assert read_log(path).messages == mcap_messages(path) == [*messages, ("/a", START_NS + 9, b"loose")]


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
@pytest.mark.parametrize("chunk_bytes", [300, 4000, 1 << 30], ids=["many chunks", "chunks", "one chunk"])
def test_ros_1_bag_holds_what_rosbags_reads(tmp_path, compression, chunk_bytes):
    messages = make_messages()
    path = write_bag(tmp_path / "log.bag", messages, compression, chunk_bytes)
    read = read_log(path)
    assert read.messages == rosbags_messages(path) == messages
    assert read.problems == []
    assert read.types == {topic: kind.replace("/msg/", "/") for topic, kind in TOPICS.items()}


def test_ros_1_bag_keeps_the_publishers_of_one_topic_apart(tmp_path):
    container = open_log(write_bag(tmp_path / "log.bag", make_messages()))
    container.close()
    assert [channel.topic for channel in container.channels] == ["/a", "/b", "/ns/c", "/a"]
    assert [channel.count for channel in container.channels] == [50, 100, 100, 50]


def test_ros_1_bag_gives_the_topics_asked_for(tmp_path):
    messages = make_messages()
    path = write_bag(tmp_path / "log.bag", messages, chunk_bytes=300)
    assert read_log(path, {"/b"}).messages == [message for message in messages if message[0] == "/b"]


@pytest.mark.parametrize("plugin", StoragePlugin)
@pytest.mark.parametrize("mode", CompressionMode)
def test_ros_2_directory_holds_what_rosbags_reads(tmp_path, plugin, mode):
    if (plugin, mode) == (StoragePlugin.SQLITE3, CompressionMode.STORAGE):
        pytest.skip("does not exist: sqlite3 storage cannot compress")
    messages = make_messages()
    path = write_directory(tmp_path / "log", messages, plugin, mode)
    before = sorted(path.iterdir())
    read = read_log(path)
    assert read.messages == rosbags_messages(path) == messages
    assert read.problems == []
    assert read.types == {topic: kind.replace("/msg/", "/") for topic, kind in TOPICS.items()}
    assert sorted(path.iterdir()) == before


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_ros_2_directory_of_several_files_is_one_log(tmp_path, plugin):
    path, messages = split_directory(tmp_path / "log", plugin)
    read = read_log(path)
    assert read.messages == rosbags_messages(path) == messages
    assert read.problems == []
    assert len(read.types) == len(TOPICS)


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_ros_2_directory_without_metadata_is_read_by_the_names_of_its_files(tmp_path, plugin):
    path, messages = split_directory(tmp_path / "log", plugin, parts=2)
    kind = "mcap" if plugin == StoragePlugin.MCAP else "db3"
    (path / f"log_1.{kind}").rename(path / f"log_10.{kind}")
    (path / f"log_0.{kind}").rename(path / f"log_9.{kind}")
    (path / "metadata.yaml").unlink()
    read = read_log(path)
    assert read.messages == messages
    assert [text.split(";")[0] for text in read.problems] == ["log: no metadata.yaml"]


def test_ros_2_directory_names_its_files_with_the_folder_as_rosbag2_once_did(tmp_path):
    path, messages = split_directory(tmp_path / "log", StoragePlugin.SQLITE3, parts=2)
    edit_metadata(path, lambda info: info.update(relative_file_paths=["log/log_0.db3", "log/log_1.db3"]))
    assert read_log(path).messages == messages


@pytest.mark.parametrize(
    "text", ["", "rosbag2_bagfile_information:\n  version: 5\n  relative_fi", "a: [", "- 1", "\udcff"]
)
def test_ros_2_directory_with_half_a_metadata_file_is_read_by_name(tmp_path, text):
    path, messages = split_directory(tmp_path / "log", StoragePlugin.MCAP, parts=2)
    (path / "metadata.yaml").write_text(text, encoding="utf-8", errors="surrogateescape")
    read = read_log(path)
    assert read.messages == messages
    assert [text.split(";")[0] for text in read.problems] == ["log: its metadata.yaml cannot be read"]


def test_ros_2_directory_says_which_of_its_files_is_missing(tmp_path):
    path, messages = split_directory(tmp_path / "log", StoragePlugin.SQLITE3)
    (path / "log_1.db3").unlink()
    read = read_log(path)
    assert read.messages == messages[:90] + messages[180:]
    assert read.problems == ["log: metadata.yaml names files that are not there: log_1.db3"]


def test_ros_2_directory_says_which_of_its_files_cannot_be_read(tmp_path):
    path, messages = split_directory(tmp_path / "log", StoragePlugin.MCAP)
    (path / "log_1.mcap").write_bytes(b"")
    read = read_log(path)
    assert read.messages == messages[:90] + messages[180:]
    assert read.problems == ["log: log_1.mcap: not an MCAP file; its first bytes are not an MCAP file's"]


def test_ros_2_directory_whose_named_files_were_renamed_is_read_by_name(tmp_path):
    path, messages = split_directory(tmp_path / "log", StoragePlugin.SQLITE3, parts=1)
    (path / "log_0.db3").rename(path / "drive.db3")
    assert read_log(path).messages == messages


def test_a_directory_without_storage_files_is_no_log(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing here")
    with pytest.raises(LogError, match=r"not a ROS 2 bag directory; it holds no \.mcap or \.db3 file"):
        open_log(tmp_path)


@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.MESSAGE])
def test_a_bare_db3_is_a_log_whether_its_messages_are_compressed_or_not(tmp_path, mode):
    messages = make_messages()
    path = write_directory(tmp_path / "log", messages, StoragePlugin.SQLITE3, mode) / "log.db3"
    read = read_log(path)
    assert (read.messages, read.problems) == (messages, [])


def test_a_db3_of_a_recorder_that_was_killed_is_read_with_its_write_ahead_log(tmp_path):
    messages = make_messages()
    whole = write_directory(tmp_path / "log", messages, StoragePlugin.SQLITE3) / "log.db3"
    database = sqlite3.connect(whole)
    database.execute("PRAGMA journal_mode = WAL")
    extra = ("/a", START_NS + 10**12, b"written last")
    database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", extra[1:])
    database.commit()
    killed = tmp_path / "killed.db3"
    shutil.copy(whole, killed)
    shutil.copy(f"{whole}-wal", f"{killed}-wal")
    database.close()
    before = sorted(tmp_path.iterdir())
    assert read_log(killed).messages == [*messages, extra]
    assert sorted(tmp_path.iterdir()) == before


def test_a_write_ahead_log_that_cannot_be_read_is_said(tmp_path, monkeypatch):
    messages = make_messages()
    path = write_directory(tmp_path / "log", messages, StoragePlugin.SQLITE3) / "log.db3"
    path.with_name("log.db3-wal").write_bytes(b"\0" * 5000)
    opened = SqliteBag._open

    class InFolderThatCannotBeWritten(sqlite3.Connection):
        def execute(self, *_):
            raise sqlite3.OperationalError("unable to open database file")

    def open_so(bag, mode):
        return opened(bag, mode) if "immutable" in mode else InFolderThatCannotBeWritten(":memory:")

    monkeypatch.setattr(SqliteBag, "_open", open_so)
    read = read_log(path)
    assert read.messages == messages
    assert read.problems == [
        "log.db3: its write-ahead log cannot be read (unable to open database file); the last messages may be missing"
    ]


def test_a_db3_recorded_in_wal_mode_is_read_without_writing_beside_it(tmp_path):
    messages = make_messages()
    path = write_directory(tmp_path / "log", messages, StoragePlugin.SQLITE3) / "log.db3"
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode = WAL")
    database.close()
    before = sorted(path.parent.iterdir())
    assert read_log(path).messages == messages
    assert sorted(path.parent.iterdir()) == before


def test_a_db3_without_definitions_gives_its_messages(tmp_path):
    messages = make_messages()
    path = write_directory(tmp_path / "log", messages, StoragePlugin.SQLITE3) / "log.db3"
    database = sqlite3.connect(path)
    database.execute("DROP TABLE message_definitions")
    database.close()
    container = open_log(path)
    container.close()
    assert {channel.definition for channel in container.channels} == {""}
    assert read_log(path).messages == messages


@pytest.mark.parametrize("name", ["löng name (1) [x] #?%41&=;.db3", "a\nb.mcap", os.fsdecode(b"not\xff\xfeutf8.db3")])
def test_a_file_may_have_any_name(tmp_path, name):
    messages = make_messages(30)
    path = tmp_path / name
    if name.endswith(".mcap"):
        write_mcap(path, messages)
    else:
        shutil.copy(write_directory(tmp_path / "log", messages, StoragePlugin.SQLITE3) / "log.db3", path)
    assert read_log(path).messages == messages


@pytest.mark.parametrize("make", [write_mcap, write_bag], ids=["mcap", "bag"])
def test_a_log_may_be_a_link(tmp_path, make):
    messages = make_messages(30)
    kind = "bag" if make is write_bag else "mcap"
    make(tmp_path / f"log.{kind}", messages)
    (tmp_path / "link").symlink_to(f"log.{kind}")
    assert read_log(tmp_path / "link").messages == messages


def test_what_a_log_is_does_not_depend_on_its_name(tmp_path):
    messages = make_messages(30)
    path = write_bag(tmp_path / "log.bag", messages).rename(tmp_path / "log.mcap")
    assert read_log(path).messages == messages


def any_reader_messages(path: Path) -> Iterator[Message]:
    with AnyReader([path], default_typestore=ROS2) as reader:
        for connection, stamp, data in reader.messages():
            yield connection.topic, stamp, bytes(data)


SHARED = [
    "formats/example.bag",
    "formats/example-bz2.bag",
    "formats/example-lz4.bag",
    "formats/no-messages.bag",
    "formats/turtlebot3.bag",
    "formats/husky_imu_db3",
    "formats/rosbag2_mcap_cdr_test/cdr_test_0.mcap",
    "formats/rosbag2_mcap_reindex_test_bags_multiple_files/multiple_files_0.mcap",
    "formats/rosbag2_sqlite3_wbag/wbag_0.db3",
    "formats/rosbag2_sqlite3_wbag/wbag_4.db3",
    "real/husky_parking_lot.bag",
    "real/husky_wet_grass",
    "real/warthog_asphalt",
    "real/warthog_grass.bag",
]


@pytest.mark.parametrize("name", SHARED)
def test_logs_of_other_peoples_tools_hold_what_rosbags_reads(shared_logs, name):
    read = read_log(shared_logs / name)
    assert sorted(read.messages) == sorted(any_reader_messages(shared_logs / name))
    assert read.problems == []


@pytest.mark.parametrize("name", ["rosbag2_mcap_reindex_test_bags_multiple_files", "rosbag2_sqlite3_wbag"])
def test_shared_directories_without_metadata_are_the_sum_of_their_files(shared_logs, name):
    folder = shared_logs / "formats" / name
    files = sorted(folder.glob("*.mcap")) + sorted(folder.glob("*.db3"))
    by_file = [message for file in files for message in any_reader_messages(file)]
    assert sorted(read_log(folder).messages) == sorted(by_file)


def test_a_compressed_storage_file_may_be_of_several_frames(tmp_path):
    messages = make_messages()
    path = write_directory(tmp_path / "log", messages, StoragePlugin.MCAP) / "log.mcap"
    content = path.read_bytes()
    frames = [zstandard.compress(part) for part in (content[:9000], content[9000:])]
    path.unlink()
    (path.parent / "log.mcap.zstd").write_bytes(b"".join(frames))
    edit_metadata(path.parent, lambda info: info.update(relative_file_paths=["log.mcap.zstd"], compression_mode="FILE"))
    assert read_log(path.parent).messages == messages


def test_temporary_files_of_a_compressed_bag_are_gone_when_it_is_closed(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    path = write_directory(tmp_path / "log", make_messages(30), StoragePlugin.SQLITE3, CompressionMode.FILE)
    container = open_log(path)
    assert len(list(tmp_path.glob("icrtool-*"))) == 1
    container.close()
    assert list(tmp_path.glob("icrtool-*")) == []


def test_a_pipe_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(LogError, match="not a regular file"):
        open_log(tmp_path / "pipe")


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/null", "/dev/tty"])
def test_a_device_is_refused_at_once(device):
    if not Path(device).exists():
        pytest.skip(f"{device} does not exist here")
    with pytest.raises(LogError):
        open_log(Path(device))


def test_a_file_of_nothing_but_a_size_is_refused_at_once(tmp_path):
    path = tmp_path / "sparse.mcap"
    with path.open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(LogError, match="not a log"):
        open_log(path)
    with path.open("r+b") as stream:
        stream.write(b"\x89MCAP0\r\n")
    with pytest.raises(LogError, match=r"nothing in it can be read; sparse\.mcap: cut off or damaged at byte 8"):
        open_log(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read what nobody may")
def test_a_file_without_permission_is_refused(tmp_path):
    path = write_mcap(tmp_path / "log.mcap", make_messages(3))
    path.chmod(0)
    with pytest.raises(LogError, match="cannot be read; Permission denied"):
        open_log(path)


def test_links_that_lead_nowhere_are_refused(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "gone").symlink_to(tmp_path / "nothing")
    for name in ("loop", "gone"):
        with pytest.raises(LogError):
            open_log(tmp_path / name)


@pytest.mark.parametrize("leave", [GeneratorExit, KeyboardInterrupt])
def test_the_block_that_is_being_made_is_ended_when_no_more_are_wanted(leave: type[BaseException]) -> None:
    begun, stopped, none = Event(), Event(), np.zeros(0, np.int64)
    block = MessageBlock(np.zeros(0, np.uint8), none, none, none, none)

    def slow() -> Iterator[MessageBlock]:
        yield block
        begun.set()
        stopped.wait(3.0)
        yield block

    blocks = make_ahead(slow(), stopped.set)
    assert next(blocks) is block
    assert begun.wait(3.0)
    begin = time.monotonic()
    with pytest.raises(leave):
        blocks.throw(leave())
    assert stopped.is_set()
    assert time.monotonic() - begin < 1.5
