"""Logs in an object store (moto's server, with s3fs) and on a web server: equal to the file, few bytes, no secrets."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from icrtool.cli import main
from icrtool.cli.inputs import named_place
from icrtool.config import load_config
from icrtool.errors import LogError
from icrtool.fleet.fleet_files import _content
from icrtool.fleet.recordings import find_recordings, read_manifest
from icrtool.logs.containers import connection, source
from icrtool.logs.containers.container import MessageBlock
from icrtool.logs.containers.open_log import open_log
from icrtool.logs.containers.recording_files import log_name
from icrtool.logs.containers.source import find_logs_at
from icrtool.logs.read_log import read_log
from icrtool.records.fleet_document import FleetFile
from icrtool.records.places import UrlPath, place_of, without_secrets
from support.batches import in_this_process
from support.servers import SECRET, file_server, object_store

MCAP, BAG, DIRECTORY, DB3 = "field.mcap", "other.bag", "third", "third/third.db3"
"""Of the short logs."""
WHEEL_MESSAGES = 1800
"""Of each."""
PICTURE_BYTES = 400_000
CONFIG = load_config(robot="husky-a200")
ROWS = range(100)
TOKEN = f"sig={SECRET}"
ROBOT = ("--robot", "husky-a200")
pytestmark = [
    pytest.mark.skipif(find_spec("fsspec") is None, reason="needs the extra icrtool[cloud]"),
    pytest.mark.skipif(find_spec("aiohttp") is None, reason="needs the extra icrtool[http]"),
    pytest.mark.skipif(sys.platform == "win32", reason="servers as threads of this process"),
]


@pytest.fixture(scope="module")
def store(short_logs):
    """A bucket `field` with the short logs, behind a proxy that counts bytes; credentials as a user sets them."""
    pytest.importorskip("s3fs", reason="needs the extra icrtool[cloud]")
    pytest.importorskip("moto.server", reason="needs moto, of the extra icrtool[dev]")
    with object_store() as proxy:
        for name, file in {
            "mon/a.mcap": short_logs / MCAP, "tue/b.bag": short_logs / BAG,
            "wed/c/c.db3": short_logs / DB3, "wed/c/metadata.yaml": short_logs / DIRECTORY / "metadata.yaml",
        }.items():  # fmt: skip
            proxy.client.upload_file(str(file), "field", name)
        packed = gzip.compress((short_logs / MCAP).read_bytes())
        proxy.client.put_object(Bucket="field", Key="packed/d.mcap.gz", Body=packed)
        proxy.client.put_object(Bucket="field", Key="notes.txt", Body=b"no log")
        yield proxy


@pytest.fixture
def fresh(store):
    """Forget what s3fs knows of the bucket."""
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    return store


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    container = open_log(path)
    try:
        topics = {channel.id: str(channel.topic) for channel in container.channels}
        return [
            (topics[channel], time_ns, block.data[start:end].tobytes())
            for block in container.blocks(frozenset(topics))
            for channel, time_ns, start, end in zip(*(column.tolist() for column in block[1:]), strict=True)
        ]
    finally:
        container.close()


@pytest.mark.parametrize(
    ("key", "file"),
    [("mon/a.mcap", MCAP), ("tue/b.bag", BAG), ("wed/c/c.db3", DB3), ("wed/c", DIRECTORY), ("packed/d.mcap.gz", MCAP)],
)
def test_a_log_in_a_bucket_has_the_messages_of_the_file(fresh, key, file, short_logs):
    assert messages(UrlPath(f"s3://field/{key}")) == messages(short_logs / file)


@pytest.mark.parametrize("log", [MCAP, BAG, DB3])
@pytest.mark.parametrize("ranges", [True, False])
def test_a_log_on_a_web_server_has_the_messages_of_the_file_with_and_without_ranges(log, ranges, short_logs):
    file = short_logs / log
    with file_server(file.parent, ranges=ranges, token=TOKEN) as server:
        url = UrlPath(f"{server.url}/{file.name}?{TOKEN}")
        assert messages(url) == messages(file)
        container = open_log(url)
        (found,) = container.inputs(Event())
        container.close()
    by_ranges = ranges and log != DB3
    assert found.sha256 == (None if by_ranges else hashlib.sha256(file.read_bytes()).hexdigest())
    assert (found.bytes, found.etag) == (file.stat().st_size, str(file.stat().st_mtime_ns))
    assert TOKEN not in repr(found)


def drive(path: Path, *, size: int, compression: CompressionType, chunk_size: int, apart: bool) -> None:
    """Write an MCAP of small messages on one topic and pictures of 400 kB on another.

    Parameters
    ----------
    apart : pictures are in chunks of their own
    """
    rng = np.random.default_rng(1)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, chunk_size=chunk_size)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        small, large = (writer.register_channel(name, "cdr", schema) for name in ("/small", "/camera"))
        for number in range(size // PICTURE_BYTES):
            for part in range(10):
                # By their times alone, chunks of one topic follow those of the other.
                writer.add_message(small, number * 1000 + part, bytes([part] * 100), number * 1000 + part)
            if apart:
                writer._Writer__finalize_chunk()
            writer.add_message(large, number * 1000 + 500, rng.bytes(PICTURE_BYTES), number * 1000 + 500)
            if apart:
                writer._Writer__finalize_chunk()
        writer.finish()


def bag(path: Path, *, size: int) -> None:
    """Write a bag without compression, of small messages and pictures."""
    types = get_typestore(Stores.ROS1_NOETIC)
    rng = np.random.default_rng(1)
    with BagWriter(path) as writer:
        small, large = (writer.add_connection(n, "std_msgs/msg/String", typestore=types) for n in ("/small", "/camera"))
        for number in range(size // PICTURE_BYTES):
            for part in range(10):
                writer.write(small, number * 1000 + part + 1, bytes([part] * 100))
            writer.write(large, number * 1000 + 500, rng.bytes(PICTURE_BYTES))


def small_ones(path: Path) -> tuple[list[bytes], str]:
    container = open_log(path)
    number = next(one.id for one in container.channels if one.topic == "/small")
    found = [text for block in container.blocks(frozenset({number})) for text in texts_of(block, number)]
    words = container.transfer()
    container.close()
    return found, words


def texts_of(block: MessageBlock, number: int) -> list[bytes]:
    rows = np.flatnonzero(block.channel == number)
    return [block.data[block.start[row] : block.end[row]].tobytes() for row in rows]


LAYOUTS = {
    "own chunks": {"compression": CompressionType.ZSTD, "chunk_size": 1 << 20, "apart": True},
    "no compression": {"compression": CompressionType.NONE, "chunk_size": 4 << 20, "apart": False},
    "mixed": {"compression": CompressionType.ZSTD, "chunk_size": 4 << 20, "apart": False},
}


@pytest.mark.parametrize("megabytes", [32, pytest.param(1000, marks=pytest.mark.stress)])
@pytest.mark.parametrize("layout", [*LAYOUTS, "bag"])
def test_only_the_bytes_that_are_needed_are_read(tmp_path, layout, megabytes):
    path = tmp_path / ("a.bag" if layout == "bag" else "a.mcap")
    if layout == "bag":
        bag(path, size=megabytes * 1_000_000)
    else:
        drive(path, size=megabytes * 1_000_000, **LAYOUTS[layout])
    expected, _ = small_ones(path)
    with file_server(tmp_path) as server:
        found, words = small_ones(UrlPath(f"{server.url}/{path.name}"))
        share = server.sent / path.stat().st_size
    assert found == expected
    assert len(found) == megabytes * 1_000_000 // PICTURE_BYTES * 10
    assert share < (1.05 if layout == "mixed" else 0.05)
    assert ("share compressed chunks" in words) == (layout == "mixed")
    path.unlink()


def test_of_an_object_only_the_bytes_that_are_needed_are_read(fresh, tmp_path):
    path = tmp_path / "a.mcap"
    drive(path, size=16_000_000, **LAYOUTS["no compression"])
    fresh.client.upload_file(str(path), "field", "large/a.mcap")
    before = fresh.received
    found, words = small_ones(UrlPath("s3://field/large/a.mcap"))
    assert found == small_ones(path)[0]
    assert fresh.received - before < 0.05 * path.stat().st_size
    assert "read by ranges" in words
    fresh.client.delete_object(Bucket="field", Key="large/a.mcap")


def test_of_a_bag_directory_of_mcap_files_only_the_bytes_that_are_needed_are_read(fresh, tmp_path):
    folder = tmp_path / "drive"
    folder.mkdir()
    names = [f"drive_{number}.mcap" for number in range(3)]
    for name in names:
        drive(folder / name, size=12_000_000, **LAYOUTS["own chunks"])
    metadata = f"rosbag2_bagfile_information:\n  relative_file_paths: [{', '.join(names)}]\n"
    (folder / "metadata.yaml").write_text(metadata)
    size = sum(file.stat().st_size for file in folder.iterdir())
    for file in folder.iterdir():
        fresh.client.upload_file(str(file), "field", f"large/drive/{file.name}")
    before, place = fresh.received, UrlPath("s3://field/large/drive")
    found, words = small_ones(place)
    assert found == small_ones(folder)[0]
    assert fresh.received - before < 0.06 * size
    assert words.endswith("MB read by ranges")
    container = open_log(place)
    inputs = [(one.path, one.sha256) for one in container.inputs(Event())]
    assert inputs == [(f"{place}/{name}", None) for name in names]
    container.close()

    cut = (folder / names[1]).read_bytes()[:-5000]
    (folder / names[1]).write_bytes(cut)
    fresh.client.put_object(Bucket="field", Key=f"large/drive/{names[1]}", Body=cut)
    assert small_ones(place)[0] == small_ones(folder)[0]
    for name in (*names, "metadata.yaml"):
        fresh.client.delete_object(Bucket="field", Key=f"large/drive/{name}")


def test_a_log_without_an_index_is_fetched_and_read_to_its_end(tmp_path, short_logs):
    (tmp_path / "cut.mcap").write_bytes((short_logs / MCAP).read_bytes()[:-5000])
    with file_server(tmp_path) as server:
        assert messages(UrlPath(f"{server.url}/cut.mcap")) == messages(tmp_path / "cut.mcap")


@pytest.mark.parametrize("number", [0, 2])
def test_a_log_whose_index_is_wrong_about_a_chunk_is_fetched_and_loses_no_message(tmp_path, number):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1000, enable_crcs=False)
        writer.start("ros2", "test")
        channel = writer.register_channel("/a", "cdr", writer.register_schema("std_msgs/msg/String", "ros2msg", b""))
        for row in ROWS:
            writer.add_message(channel, row, bytes([row] * 100), row)
        writer.finish()
    whole = messages(path)
    assert len(whole) == len(ROWS)
    content = bytearray(path.read_bytes())
    head = b"\x08" + (8 + 8 + 8 + 8 + 14 + 8 + 8 + 8 + 8).to_bytes(8, "little")
    at = [found.start() for found in re.finditer(re.escape(head), content)][number] + 9 + 24
    length = int.from_bytes(content[at : at + 8], "little")
    content[at : at + 8] = (length - 9).to_bytes(8, "little")
    path.write_bytes(content)
    with file_server(tmp_path) as server:
        assert messages(UrlPath(f"{server.url}/a.mcap")) == whole


def test_about_a_file_that_is_fetched_the_server_is_asked_once(tmp_path, monkeypatch, short_logs):
    (tmp_path / "packed.gz").write_bytes(gzip.compress((short_logs / MCAP).read_bytes()))
    made = []
    monkeypatch.setattr(source, "_about", lambda path, about=source._about: made.append(path) or about(path))
    with file_server(tmp_path) as server:
        assert messages(UrlPath(f"{server.url}/packed.gz")) == messages(short_logs / MCAP)
    assert len(made) == 1


def test_a_broken_connection_is_made_again(monkeypatch, short_logs):
    monkeypatch.setattr(connection, "PAUSES_S", (0.01, 0.01))
    with file_server(short_logs, broken=2) as server:
        assert messages(UrlPath(f"{server.url}/{MCAP}")) == messages(short_logs / MCAP)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_connections_that_break_while_chunks_are_read_are_made_again_or_one_error(monkeypatch, tmp_path, layout):
    monkeypatch.setattr(connection, "PAUSES_S", (0.01, 0.01))
    drive(tmp_path / "a.mcap", size=8_000_000, **LAYOUTS[layout])
    with file_server(tmp_path) as server:
        container = open_log(UrlPath(f"{server.url}/a.mcap"))
        number = next(one.id for one in container.channels if one.topic == "/small")
        server.broken = 2
        found = [text for block in container.blocks(frozenset({number})) for text in texts_of(block, number)]
        assert found == small_ones(tmp_path / "a.mcap")[0]
        server.broken = 10_000
        with pytest.raises(LogError, match="cannot be read"):
            list(container.blocks(frozenset({number})))
        container.close()


def test_a_connection_that_stays_broken_is_one_line_without_secrets(monkeypatch, short_logs):
    monkeypatch.setattr(connection, "PAUSES_S", (0.01, 0.01))
    with file_server(short_logs, token=TOKEN) as server:
        container = open_log(UrlPath(f"{server.url}/{MCAP}?{TOKEN}"))
        server.broken = 10_000
        with pytest.raises(LogError, match="cannot be read") as caught:
            list(container.blocks(frozenset(one.id for one in container.channels)))
        container.close()
    assert TOKEN not in str(caught.value)
    with pytest.raises(LogError, match="cannot be read"):
        open_log(UrlPath(f"{server.url}/{MCAP}?{TOKEN}"))


@pytest.mark.parametrize("key", ["mon/a.mcap", "tue/b.bag", "wed/c", "packed/d.mcap.gz"])
def test_an_object_that_is_replaced_while_it_is_read_is_refused(fresh, key):
    assert len(read_log(f"s3://field/{key}", CONFIG).wheels.stamp_ns)
    name = f"{key}/c.db3" if key == "wed/c" else key
    content = fresh.client.get_object(Bucket="field", Key=name)["Body"].read()
    done = []

    def replace(_share: float) -> None:
        if not done:
            done.append(fresh.client.put_object(Bucket="field", Key=name, Body=content[:-1] + b"x"))

    with pytest.raises(LogError, match=r"changed while it was read|gave|does not decompress"):
        read_log(f"s3://field/{key}", CONFIG, progress=replace)
    fresh.client.put_object(Bucket="field", Key=name, Body=content)


def test_a_table_in_a_bucket_is_read_compressed_too(fresh):
    table = b"t_s,v_left_mps,v_right_mps,north_m,east_m,yaw_rad\n" + b"".join(
        b"%d,1,1,%d,0,0\n" % (k, k) for k in range(100)
    )
    fresh.client.put_object(Bucket="field", Key="tables/a.csv.gz", Body=gzip.compress(table))
    log = read_log("s3://field/tables/a.csv.gz")
    assert log.gnss.north_m.tolist() == list(ROWS)
    assert (log.name, log.inputs[0].path) == ("a", "s3://field/tables/a.csv.gz")
    fresh.client.delete_object(Bucket="field", Key="tables/a.csv.gz")


def test_a_file_that_is_not_there_or_not_allowed_is_said_so(fresh, short_logs):
    with file_server(short_logs, token=TOKEN) as server:
        with pytest.raises(LogError, match="no such file"):
            open_log(UrlPath(f"{server.url}/none.mcap?{TOKEN}"))
        with pytest.raises(LogError, match="may not be read"):
            open_log(UrlPath(f"{server.url}/{MCAP}?sig=wrong"))
    for key in ("none.mcap", "none/"):
        with pytest.raises(LogError, match="no such file"):
            open_log(UrlPath(f"s3://field/{key}"))
    with pytest.raises(LogError, match="not a log"):
        open_log(UrlPath("s3://field/notes.txt"))


def test_patterns_folders_and_manifests_find_the_logs_of_a_bucket(fresh, tmp_path):
    everything = ["s3://field/mon/a.mcap", "s3://field/packed/d.mcap.gz", "s3://field/tue/b.bag", "s3://field/wed/c"]
    assert [one.url for one in find_logs_at(UrlPath("s3://field"))] == everything
    assert [one.url for one in find_logs_at(UrlPath("s3://field/**/*.bag"))] == everything[2:3]
    assert [one.name for one in find_recordings([UrlPath("s3://field/*/*.mcap"), UrlPath("s3://field/tue")])] == [
        "mon/a",
        "tue/b",
    ]
    manifest = tmp_path / "logs.csv"
    manifest.write_text("log,robot,group\ns3://field/mon/*.mcap,husky-a200,grass\n")
    (entry,) = read_manifest(manifest)
    assert [str(place) for place in entry.places] == everything[:1]
    with pytest.raises(LogError, match="matches this pattern"):
        find_logs_at(UrlPath("s3://field/**/*.ulg"))


def test_a_name_with_brackets_is_a_file_before_it_is_a_pattern(fresh, short_logs):
    fresh.client.upload_file(str(short_logs / MCAP), "field", "odd/drive[1].mcap")
    fresh.client.upload_file(str(short_logs / MCAP), "field", "odd/drive2.mcap")
    assert [one.url for one in find_logs_at(UrlPath("s3://field/odd/drive[1].mcap"))] == [
        "s3://field/odd/drive[1].mcap"
    ]
    assert [one.url for one in find_logs_at(UrlPath("s3://field/odd/drive[2].mcap"))] == ["s3://field/odd/drive2.mcap"]
    assert messages(UrlPath("s3://field/odd/drive[1].mcap")) == messages(short_logs / MCAP)
    for name in ("odd/drive[1].mcap", "odd/drive2.mcap"):
        fresh.client.delete_object(Bucket="field", Key=name)


def run(monkeypatch, capfd, *arguments: object) -> tuple[int, str]:
    """Run a command in this process; return its exit status and all that it printed."""
    monkeypatch.setattr(sys, "argv", ["icrtool", *map(str, arguments)])
    status = 0
    try:
        main()
    except SystemExit as left:
        status = int(left.code or 0)
    return status, "".join(capfd.readouterr())


def test_fit_from_an_address_gives_the_run_of_the_file_and_no_secret(tmp_path, monkeypatch, capfd, short_logs):
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, capfd, "fit", short_logs / MCAP, *ROBOT, "-o", "local", "--plots", "none")[0] == 0
    with file_server(short_logs, token=TOKEN) as server:
        url = f"{server.url}/{MCAP}?{TOKEN}"
        given = (*ROBOT, "-o", "remote", "--plots", "none", "--no-ladder", "-v")
        for page in (("--no-page",), ()):  # a second time, its own run is replaced
            status, said = run(monkeypatch, capfd, "dropout-report", url, *given, *page)
            assert status == 0, said
            assert SECRET not in said
        status, said = run(monkeypatch, capfd, "info", url, *ROBOT, "--json")
        assert status == 0
        assert SECRET not in said
        assert "read by ranges" in json.loads(said)["logs"][0]["transfer"]
    assert (tmp_path / "local/states.csv").read_bytes() == (tmp_path / "remote/states.csv").read_bytes()
    assert not [file for file in Path("remote").rglob("*") if file.is_file() and SECRET.encode() in file.read_bytes()]
    (found,) = json.loads((tmp_path / "remote/run.json").read_text())["inputs"]
    assert found["path"] == f"{server.url}/{MCAP}"
    assert found["sha256"] is None
    assert found["etag"]


def test_batch_reads_a_bucket_and_skips_what_is_unchanged(fresh, tmp_path, monkeypatch, capfd, short_logs):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("icrtool.fleet.batch.process_apart", in_this_process)
    command = ("batch", "s3://field/mon", *ROBOT, "-o", "out", "--plots", "none", "--no-ladder", "-j", "1", "--json")
    status, said = run(monkeypatch, capfd, *command)
    assert status == 0, said
    status, said = run(monkeypatch, capfd, *command)
    assert [one["this_time"] for one in json.loads(said)["logs"]] == ["skipped"]
    fresh.client.upload_file(str(short_logs / MCAP), "field", "mon/a.mcap")
    fresh.client.put_object(Bucket="field", Key="mon/a.mcap", Body=(short_logs / MCAP).read_bytes() + b"\0")
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    status, said = run(monkeypatch, capfd, *command)
    assert [one["this_time"] for one in json.loads(said)["logs"]] == ["processed"]
    assert SECRET not in said
    fresh.client.upload_file(str(short_logs / MCAP), "field", "mon/a.mcap")


@pytest.mark.parametrize(
    ("url", "library", "extra"),
    [("s3://b/a.mcap", "s3fs", "cloud"), ("gs://b/a.mcap", "gcsfs", "cloud"), ("az://b/a.mcap", "adlfs", "cloud"),
     ("https://b/a.mcap", "aiohttp", "http")],
)  # fmt: skip
def test_a_missing_library_is_named_with_the_extra_that_has_it(url, library, extra):
    script = (
        f"import sys; sys.modules[{library!r}] = None; sys.argv = ['icrtool', 'info', {url!r}]\n"
        "from icrtool.cli import main; main()"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert said.returncode == 1
    assert said.stderr.strip() == f"Error: {url}: needs {library}; pip install 'icrtool[{extra}]'"


def test_a_log_on_disk_loads_no_network_library(short_logs):
    script = (
        "import sys\nfrom icrtool.logs.read_log import read_log\nfrom icrtool.config import load_config\n"
        f"read_log({str(short_logs / MCAP)!r}, load_config(robot='husky-a200'))\n"
        "print([name for name in ('fsspec', 's3fs', 'aiohttp', 'botocore', 'gcsfs', 'adlfs', 'urllib3', 'requests', "
        "'http.client', 'asyncio') if name in sys.modules])"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert said.stdout.strip() == "[]"


def test_an_address_keeps_its_slashes_and_hides_its_secrets():
    path = place_of(f"https://user:pass@host/logs/a.mcap?{TOKEN}&x=1")
    assert isinstance(path, UrlPath)
    assert (str(path), path.name, path.suffix) == ("https://host/logs/a.mcap", "a.mcap", ".mcap")
    assert path.url.endswith("&x=1")
    assert "pass" not in repr(path) + str(path) + f"{path}"
    assert log_name(place_of("s3://bucket/mon/a.mcap.zst")) == "a"
    assert not isinstance(place_of("C:/logs/a.mcap"), UrlPath)
    assert [without_secrets(one) for one in ("https://h/a?token=x", "s3://k:s@b/c")] == ["https://h/a", "s3://b/c"]


def test_compare_names_an_address_by_its_file_and_without_its_query():
    name, place = named_place(f"https://host/mon/a.mcap?{TOKEN}")
    assert (name, str(place)) == ("a.mcap", "https://host/mon/a.mcap")
    assert place.url.endswith(TOKEN)
    name, place = named_place(f"grass=https://host/mon/a.mcap?{TOKEN}")
    assert (name, place.url) == ("grass", f"https://host/mon/a.mcap?{TOKEN}")


@pytest.mark.parametrize("log", ["a.mcap", "a.db3"])
def test_ctrl_c_while_a_server_is_silent_ends_the_command_and_leaves_nothing(tmp_path, log):
    (tmp_path / log).write_bytes(bytes(1_000_000))
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    with file_server(tmp_path) as server:
        server.silent = True
        one = subprocess.Popen(
            [sys.executable, "-P", "-m", "icrtool", "info", f"{server.url}/{log}"],
            env={**os.environ, "TMPDIR": str(temporary)}, stderr=subprocess.PIPE,
        )  # fmt: skip
        deadline = time.monotonic() + 30
        while not server.waiting and time.monotonic() < deadline:
            time.sleep(0.01)
        one.send_signal(signal.SIGINT)
        begun = time.monotonic()
        assert one.wait(30) == 130
        assert time.monotonic() - begun < 5
        one.stderr.close()
        server.silent = False
    assert not list(temporary.iterdir())


def test_inputs_that_were_not_wholly_read_are_not_called_copies():
    one, other = (FleetFile(f"s3://field/{name}", 5, 0, None, "same etag") for name in "ab")
    assert _content([one]) != _content([other])
    assert _content([FleetFile("a", 5, 0, "ab" * 32)]) == _content([FleetFile("b", 5, 0, "ab" * 32)])


def test_read_log_takes_an_address(fresh):
    log = read_log("s3://field/mon/a.mcap")
    assert len(log.wheels.stamp_ns) == WHEEL_MESSAGES
    assert log.inputs[0].path == "s3://field/mon/a.mcap"
