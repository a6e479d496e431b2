"""Compressed logs and archives, packed by each format's own library: read as what is in them, and nothing is left."""

from __future__ import annotations

import bz2
import gzip
import hashlib
import io
import lzma
import os
import platform
import random
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Event

import lz4.frame
import pytest
import zstandard

from icrtool.config import load_config
from icrtool.errors import IcrToolError, LogChangedError, LogError
from icrtool.fleet.recordings import find_recordings
from icrtool.logs.containers import unpack
from icrtool.logs.containers.open_log import open_log
from icrtool.logs.containers.recording_files import log_name
from icrtool.logs.csv_table import csv_frame
from icrtool.logs.read_log import read_log
from icrtool.pipeline import fit

SAMPLES = Path(__file__).parents[3] / "sample_logs"
MCAP, BAG, DIRECTORY = (
    SAMPLES / name for name in ("wheeled_lawnmower.mcap", "tracked_curved.bag", "wheeled_figure_eight")
)
DB3 = DIRECTORY / "wheeled_figure_eight.db3"
CONFIG = load_config(robot="segway-rmp400")
ROWS = range(100)
PACKERS: dict[str, Callable[[bytes], bytes]] = {
    ".gz": partial(gzip.compress, compresslevel=1),
    ".bz2": partial(bz2.compress, compresslevel=1),
    ".xz": partial(lzma.compress, preset=0),
    ".zst": zstandard.compress,
    ".lz4": lz4.frame.compress,
}
MODES = {".tar": "w", ".tar.gz": "w:gz", ".tar.bz2": "w:bz2", ".tar.xz": "w:xz", ".tgz": "w:gz"}


def tar_file(path: Path, ending: str) -> tarfile.TarFile:
    """Open a new tar archive, compressed as fast as its format can be."""
    fast = {"": {}, "gz": {"compresslevel": 1}, "bz2": {"compresslevel": 1}, "xz": {"preset": 0}}
    return tarfile.open(path, MODES[ending], **fast[MODES[ending].partition(":")[2]])


@pytest.fixture(autouse=True)
def temporary(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch):
    """Give the folder of temporary files, which must be empty in the end."""
    folder = tmp_path_factory.mktemp("temporary")
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    yield folder
    assert not list(folder.iterdir())


def content(path: Path) -> tuple[list[tuple[str, int, bytes]], list[str]]:
    """Return the messages of a log, and what could not be read."""
    container = open_log(path)
    try:
        topics = {channel.id: str(channel.topic) for channel in container.channels}
        found = [
            (topics[channel], time_ns, block.data[start:end].tobytes())
            for block in container.blocks(frozenset(topics))
            for channel, time_ns, start, end in zip(*(column.tolist() for column in block[1:]), strict=True)
        ]
        return found, [one.sentence for one in container.problems]
    finally:
        container.close()


@pytest.mark.parametrize("name", ["field.mcap", "other.bag", "third/third.db3"])
@pytest.mark.parametrize("packing", PACKERS)
def test_a_compressed_log_is_read_as_what_is_in_it(tmp_path, short_logs, name, packing):
    log = short_logs / name
    path = tmp_path / f"{log.name}{packing}"
    half = len(log.read_bytes()) // 2
    # Two parts that follow one another, as parallel compressors write them.
    path.write_bytes(PACKERS[packing](log.read_bytes()[:half]) + PACKERS[packing](log.read_bytes()[half:]))
    assert content(path) == content(log)


@pytest.mark.parametrize("ending", MODES)
@pytest.mark.parametrize("name", ["field.mcap", "third"])
def test_a_log_or_bag_directory_in_a_tar_archive_is_read(tmp_path, short_logs, name, ending):
    log = short_logs / name
    path = tmp_path / f"x{ending}"
    with tar_file(path, ending) as archive:
        archive.add(log, f"season/2026/{log.name}")
        archive.add(SAMPLES / "README.md", "README.md")
    assert content(path) == content(log)


@pytest.mark.parametrize("layout", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_names_and_links_of_every_kind_of_tar_archive_are_understood(tmp_path, short_logs, layout):
    path, deep = tmp_path / "x.tar", "/".join(["a_folder_of_a_season"] * 6)
    name = f"{deep}/{'ä' if layout != tarfile.USTAR_FORMAT else 'a'}.mcap"
    with tarfile.open(path, "w", format=layout) as archive:
        link = tarfile.TarInfo("link.mcap")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)
        archive.add(short_logs / "field.mcap", name)
    assert content(path) == content(short_logs / "field.mcap")


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2])
def test_a_log_in_a_zip_archive_is_read_compressed_again_or_not(tmp_path, short_logs, method):
    log = (short_logs / "field.mcap").read_bytes()
    for name, data in (("a.mcap", log), ("a.mcap.zst", zstandard.compress(log))):
        path = tmp_path / f"{name}.zip"
        with zipfile.ZipFile(path, "w", method) as archive:
            archive.writestr("season/", "")
            archive.writestr(f"season/{name}", data)
            archive.writestr("season/__MACOSX/._a.mcap", b"x")
        assert content(path) == content(short_logs / "field.mcap")


def test_an_entry_without_a_name_in_a_zip_archive_costs_no_other_entry(tmp_path, short_logs):
    path = tmp_path / "nameless.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x", b"no log")
        archive.writestr("a.mcap", (short_logs / "field.mcap").read_bytes())
    data = bytearray(path.read_bytes())
    for mark, at in ((b"PK\x03\x04", 26), (b"PK\x01\x02", 28)):
        # the name becomes a further field of one byte
        place = data.index(mark) + at
        data[place : place + 4] = b"\x00\x00\x01\x00"
    path.write_bytes(data)
    assert zipfile.ZipFile(path).namelist() == ["", "a.mcap"]
    assert content(path) == content(short_logs / "field.mcap")


def test_a_bag_directory_whose_files_are_compressed_is_read_from_an_archive(tmp_path):
    path = tmp_path / "x.tar"
    metadata = (DIRECTORY / "metadata.yaml").read_bytes().replace(b".db3", b".db3.zstd")
    assert b"db3.zstd" in metadata
    with tarfile.open(path, "w") as archive:
        for name, data in (("metadata.yaml", metadata), (f"{DB3.name}.zstd", zstandard.compress(DB3.read_bytes()))):
            entry = tarfile.TarInfo(f"bag/{name}")
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    assert content(path) == content(DIRECTORY)


def test_the_sum_of_a_packed_log_is_that_of_the_file_that_was_named(tmp_path, short_logs):
    path = tmp_path / "a.mcap.gz"
    path.write_bytes(gzip.compress((short_logs / "field.mcap").read_bytes()))
    container = open_log(path)
    (found,) = container.inputs(Event())
    container.close()
    assert (found.path, found.bytes) == (str(path), path.stat().st_size)
    assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    ("name", "log"),
    [("a.mcap.zst", "a"), ("a.tar.gz", "a"), ("a.v2.zip", "a.v2"), ("a.db3.zip", "a"), ("a.b.mcap", "a.b")],
)
def test_a_run_is_named_after_the_log_without_what_it_is_packed_in(name, log):
    assert log_name(Path(name)) == log


@pytest.mark.parametrize("packing", PACKERS)
def test_of_a_compressed_log_that_is_cut_off_the_beginning_is_read(tmp_path, packing):
    data = PACKERS[packing](BAG.read_bytes())
    path = tmp_path / f"cut.bag{packing}"
    path.write_bytes(data[: len(data) * 3 // 5])  # bz2 gives whole blocks of 900 kB
    found, problems = content(path)
    whole, _ = content(BAG)
    assert 0.2 * len(whole) < len(found) < 0.8 * len(whole)
    assert set(found) <= set(whole)
    assert any("cut off" in one for one in problems)


@pytest.mark.parametrize("packing", [*PACKERS, ".zip", *MODES])
def test_a_damaged_file_gives_a_log_or_one_line(tmp_path, packing):
    path = tmp_path / f"a.mcap{packing}"
    if packing in PACKERS:
        path.write_bytes(PACKERS[packing](MCAP.read_bytes()[:60_000]))
    elif packing == ".zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a.mcap", MCAP.read_bytes()[:60_000])
    else:
        with tar_file(path, packing) as archive:
            entry = tarfile.TarInfo("a.mcap")
            entry.size = 60_000
            archive.addfile(entry, io.BytesIO(MCAP.read_bytes()))
    sound, rng = path.read_bytes(), random.Random(1)
    for _ in range(40):
        data = bytearray(sound)
        for at in rng.choices(range(min(len(data), 600)), k=2) + rng.choices(range(len(data)), k=3):
            data[at] = rng.randrange(256)
        path.write_bytes(data[: rng.choice([len(data), rng.randrange(len(data))])])
        with suppress(LogError):
            content(path)


def zeros(count: int) -> io.BufferedReader:
    """Return a file of so many zeros, which takes no memory."""

    class Zeros(io.RawIOBase):
        left = count

        def readable(self) -> bool:
            return True

        def readinto(self, space) -> int:
            part = min(len(space), self.left)
            space[:part] = bytes(part)
            self.left -= part
            return part

    return io.BufferedReader(Zeros(), 1 << 20)


@pytest.mark.parametrize("packing", [*PACKERS, ".zip", ".tar.gz"])
def test_a_bomb_is_unpacked_to_its_limit_only(tmp_path, temporary, monkeypatch, packing):
    path, size = tmp_path / f"a.mcap{packing}", 40_000_000
    if packing == ".zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.mcap", "w") as entry:
            shutil.copyfileobj(zeros(size), entry)
    elif packing == ".tar.gz":
        with tarfile.open(path, "w:gz") as archive:
            entry = tarfile.TarInfo("a.mcap")
            entry.size = size
            archive.addfile(entry, zeros(size))
    else:
        path.write_bytes(PACKERS[packing](bytes(size)))
    monkeypatch.setattr(unpack, "LARGEST_CHUNK_BYTES", 1 << 20)
    monkeypatch.setattr(unpack, "LARGEST_RATIO", 10)
    largest = []
    closed = unpack.ScratchFolder.close

    def watched(scratch):
        largest.append(sum(file.stat().st_size for file in scratch.path.rglob("*") if file.is_file()))
        closed(scratch)

    monkeypatch.setattr(unpack.ScratchFolder, "close", watched)
    with pytest.raises(LogError):
        open_log(path)
    assert 0 < largest[0] <= (1 << 20) + 10 * path.stat().st_size


def test_an_archive_of_very_many_entries_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(unpack, "_MOST_ENTRIES", 1000)
    path = tmp_path / "many.tar.gz"
    with tarfile.open(path, "w:gz") as archive:
        for number in range(1200):
            archive.addfile(tarfile.TarInfo(f"{number}.txt"))
    with pytest.raises(LogError, match="more than 1000 entries"):
        open_log(path)


@pytest.mark.parametrize("name", ["../../a.mcap", "/tmp/a.mcap", "..", "a/../../b.mcap", "x\0.mcap"])
def test_no_name_in_an_archive_leads_out_of_the_temporary_folder(tmp_path, name):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.mcap", MCAP.read_bytes())
    with tarfile.open(tmp_path / "a.tar", "w") as archive:
        entry = tarfile.TarInfo(name)
        entry.size = MCAP.stat().st_size
        archive.addfile(entry, io.BytesIO(MCAP.read_bytes()))
    before = sorted(tmp_path.rglob("*")), sorted(tmp_path.parent.iterdir())
    with suppress(LogError):
        open_log(tmp_path / "a.tar").close()
    assert (sorted(tmp_path.rglob("*")), sorted(tmp_path.parent.iterdir())) == before
    assert not Path("/tmp/a.mcap").exists()


@pytest.mark.parametrize(
    ("entries", "why"),
    [
        ({"a.mcap": MCAP, "b.bag": BAG}, "holds more than one recording: a.mcap, b.bag"),
        ({"a/a.mcap": MCAP, "b/a.mcap": MCAP}, "holds more than one recording: a/a.mcap, b/a.mcap"),
        ({"README.md": SAMPLES / "README.md"}, "no log in it; it holds README.md"),
    ],
)
def test_an_archive_of_several_logs_or_none_is_refused(tmp_path, entries, why):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name, file in entries.items():
            archive.write(file, name)
    with pytest.raises(LogError, match=why):
        open_log(path)


def test_an_encrypted_archive_is_refused_in_one_line(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.mcap", b"x")
    data = bytearray(path.read_bytes())
    for magic, at in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        data[data.index(magic) + at] |= 1
    path.write_bytes(data)
    with pytest.raises(LogError, match="encrypted"):
        open_log(path)


def test_an_archive_whose_entries_begin_before_the_file_is_damaged(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.mcap", b"x")
    data = bytearray(path.read_bytes())
    end = data.index(b"PK\5\6")
    data[end + 16 : end + 20] = (10_000).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(LogError, match="does not decompress"):
        open_log(path)


def test_compressed_logs_in_a_folder_are_a_recording_each(tmp_path):
    for name in ("mon.mcap.zst", "tue.bag.gz", "wed/log.db3.lz4", "notes.txt.gz"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    assert [one.name for one in find_recordings([tmp_path])] == ["mon", "tue", "wed/log"]


def command(*arguments: str, temporary: Path, **options) -> subprocess.Popen[bytes]:
    """Start icrtool with its own folder of temporary files."""
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "icrtool", *arguments],
        env={**os.environ, "TMPDIR": str(temporary)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        **options,
    )


TABLE = b"t_s,v_left_mps,v_right_mps,north_m,east_m,yaw_rad\n" + b"".join(
    b"%d,1,1,%d,0,0\n" % (k, k) for k in range(100)
)


@pytest.mark.parametrize("packing", PACKERS)
def test_a_compressed_table_is_the_table(tmp_path, packing):
    plain, packed = tmp_path / "drive.csv", tmp_path / f"drive.csv{packing}"
    plain.write_bytes(TABLE)
    packed.write_bytes(PACKERS[packing](TABLE))
    expected, found = read_log(plain), read_log(packed)
    assert found.wheels.left.tolist() == expected.wheels.left.tolist()
    assert found.gnss.north_m.tolist() == expected.gnss.north_m.tolist()
    (one,) = found.inputs
    assert (one.path, one.sha256) == (str(packed), hashlib.sha256(packed.read_bytes()).hexdigest())
    assert found.name == "drive"
    packed.write_bytes(packed.read_bytes()[:-10])
    with pytest.raises(LogError, match="does not decompress"):
        read_log(packed)


def append(file: Path) -> None:
    with file.open("ab") as stream:
        stream.write(b"\0")


@pytest.mark.parametrize("name", ["field.mcap", "other.bag", "third/third.db3", "third", "a.mcap.gz"])
def test_a_log_that_is_written_to_while_it_is_read_is_refused(tmp_path, short_logs, name):
    log, config = short_logs / name, load_config(robot="husky-a200")
    if name == "a.mcap.gz":
        place = file = tmp_path / name
        file.write_bytes(gzip.compress((short_logs / "field.mcap").read_bytes()))
    else:
        place = tmp_path / log.name
        (shutil.copytree if log.is_dir() else shutil.copy)(log, place)
        file = place / "third.db3" if log.is_dir() else place
    assert len(read_log(place, config).wheels.stamp_ns)
    with pytest.raises(LogChangedError, match="changed while it was read"):
        read_log(place, config, progress=lambda share: append(file))


def test_a_table_that_is_written_to_while_it_is_read_is_refused(tmp_path, monkeypatch):
    file = tmp_path / "drive.csv"
    file.write_bytes(TABLE)
    whole = csv_frame

    def while_it_is_written(path: Path) -> object:
        append(file)
        return whole(path)

    monkeypatch.setattr("icrtool.logs.read_log.csv_frame", while_it_is_written)
    with pytest.raises(LogChangedError):
        read_log(file)


def test_standard_input_gives_the_numbers_of_the_file(tmp_path, temporary, short_logs):
    log, robot = short_logs / "field.mcap", "husky-a200"
    data = gzip.compress(log.read_bytes())
    piped = command(
        *("fit", "-", "--robot", robot, "--plots", "none"), temporary=temporary, stdin=subprocess.PIPE, cwd=tmp_path
    )
    _, said = piped.communicate(data, timeout=120)
    assert piped.returncode == 0, said
    fit(read_log(log, load_config(robot=robot)), load_config(robot=robot)).write(tmp_path / "named", plots=())
    states = [(tmp_path / place / "states.csv").read_bytes() for place in ("icrtool-runs/stdin", "named")]
    assert states[0] == states[1]
    document = (tmp_path / "icrtool-runs/stdin/run.json").read_text()
    assert hashlib.sha256(data).hexdigest() in document


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("log", ["-", "endless.mcap.gz"])
def test_ctrl_c_while_unpacking_leaves_nothing_behind(tmp_path, temporary, log):
    path = tmp_path / "endless.mcap.gz"
    if log != "-":
        with gzip.open(path, "wb", 0) as file:
            file.write(MCAP.read_bytes()[:100_000])
            for _ in range(200):
                file.write(bytes(1 << 20))
    one = command("info", log, temporary=temporary, stdin=subprocess.PIPE, cwd=tmp_path)
    if log == "-":
        one.stdin.write(MCAP.read_bytes()[:100_000])  # and never an end
        one.stdin.flush()
    deadline = time.monotonic() + 60
    # Not the file beside our folder: by it Python tries whether the place of temporary files can be written.
    while not list(temporary.glob("*/*")) and time.monotonic() < deadline:
        time.sleep(0.002)
    assert one.poll() is None
    one.send_signal(signal.SIGINT)
    begun = time.monotonic()
    assert one.wait(30) == 130
    assert time.monotonic() - begun < 5
    one.stdin.close()
    one.stdout.close()
    one.stderr.close()


@pytest.mark.parametrize("packing", [*PACKERS, ".zip"])
@pytest.mark.parametrize("data", [b"a,b\n1,2\n", b"\xfd7zXX" * 99])
def test_a_table_that_is_not_packed_as_its_name_says_is_one_line(tmp_path, packing, data):
    path = tmp_path / f"log.csv{packing}"
    path.write_bytes(data)
    with pytest.raises(IcrToolError) as error:
        read_log(path, CONFIG)
    assert len(str(error.value).splitlines()) == 1


def test_temporary_folders_state_host_and_process_and_those_of_dead_ones_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    host = re.sub(r"[^A-Za-z0-9.]", "_", platform.node())[:64]
    kept = [f"icrtool-{host}-{os.getpid()}-a", f"icrtool-{host}x-{dead.pid}-a", f"icrtool-{host}-x-a", "icrtool-a"]
    for name in (*kept, f"icrtool-{host}-{dead.pid}-a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "log").touch()
    scratch = unpack.ScratchFolder()
    assert scratch.path.name.startswith(f"icrtool-{host}-{os.getpid()}-")
    assert scratch.path.stat().st_mode & 0o777 == 0o700
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*kept, scratch.path.name])
    scratch.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)


def test_long_targets_of_links_and_sparse_files_of_a_gnu_archive_hide_no_log(tmp_path):
    path, whole = tmp_path / "x.tar", tmp_path / "x"
    whole.mkdir()
    shutil.copy(MCAP, whole / "drive.mcap")
    with (whole / "map.dat").open("wb") as file:
        for place in range(0, 30 << 20, 1 << 20):
            file.seek(place)
            file.write(b"x")
    with tarfile.open(path, "w", format=tarfile.GNU_FORMAT) as archive:
        for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE):
            link = tarfile.TarInfo("b/" * 60 + "link.mcap")
            link.type, link.linkname = kind, "a/" * 4000
            archive.addfile(link)
    subprocess.run(["tar", "--append", "--sparse", "--format=gnu", "-f", path, "-C", whole, "map.dat"], check=True)
    subprocess.run(["tar", "--append", "--format=gnu", "-f", path, "-C", whole, "drive.mcap"], check=True)
    assert path.stat().st_size < 4e6, "map.dat is stored with its holes left out"
    assert content(path) == content(MCAP)
    (whole / "map.dat").rename(whole / "map.mcap")
    subprocess.run(["tar", "--create", "--sparse", "--format=gnu", "-f", path, "-C", whole, "map.mcap"], check=True)
    with pytest.raises(LogError, match=r"map\.mcap is a sparse file; pack it without --sparse"):
        open_log(path)


def test_an_archive_of_thousands_of_folders_costs_little_time(tmp_path):
    path = tmp_path / "x.tar"
    with tarfile.open(path, "w") as archive:
        for number in range(20_000):
            folder = tarfile.TarInfo(f"folder{number}")
            folder.type = tarfile.DIRTYPE
            archive.addfile(folder)
        archive.add(MCAP, "drive.mcap")
    begin = time.process_time()
    open_log(path).close()
    assert time.process_time() - begin < 2.0 + path.stat().st_size / 1e6
    with zipfile.ZipFile(tmp_path / "y.zip", "w") as archive:
        for number in range(5_000):
            archive.writestr(f"folder{number}/a.mcap", b"x")
    begin = time.process_time()
    with pytest.raises(LogError, match="more than 100 folders"):
        open_log(tmp_path / "y.zip")
    assert time.process_time() - begin < 0.8


@pytest.mark.parametrize("damage", ["cut", "empty", "no log in it", "a database cut off", "two parts"])
def test_no_note_or_error_names_the_temporary_folder(tmp_path, temporary, damage):
    path, whole = tmp_path / "drive.tar", tmp_path / "whole"
    whole.mkdir()
    parts = {
        "cut": {"drive.mcap": MCAP.read_bytes()}, "empty": {"drive.mcap": b""}, "no log in it": {"drive.txt": b"x"},
        "a database cut off": {"drive.db3": DB3.read_bytes()[:60_000], "metadata.yaml": b"rosbag2: ["},
        "two parts": {"drive_0.mcap": MCAP.read_bytes(), "drive_1.mcap": b"x" * 99, "metadata.yaml": b"x"},
    }[damage]  # fmt: skip
    with tarfile.open(path, "w") as archive:
        for name, data in parts.items():
            (whole / name).write_bytes(data)
            archive.add(whole / name, f"drive/{name}")
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:1_000_000])
    try:
        said = [*content(path)[1]]
    except LogError as err:
        said = [str(err)]
    assert said
    assert not [one for one in said if str(temporary) in one or "icrtool-" in one]


@pytest.mark.parametrize("packing", [".gz", ".bz2", ".xz", ".lz4"])
def test_a_file_of_very_many_empty_frames_is_refused_at_once(tmp_path, packing):
    path = tmp_path / f"drive.mcap{packing}"
    path.write_bytes(PACKERS[packing](b"") * 200_000)
    begin = time.process_time()
    with pytest.raises(LogError, match="frames of little content") as error:
        open_log(path)
    assert len(str(error.value).splitlines()) == 1
    assert time.process_time() - begin < 2.0


def test_a_gzip_file_whose_header_has_a_long_name_costs_little_time(tmp_path):
    packed = bytearray(gzip.compress(MCAP.read_bytes(), compresslevel=1))
    packed[3] |= 8  # a name follows
    path = tmp_path / "drive.mcap.gz"
    path.write_bytes(packed[:10] + b"x" * 8_000_000 + b"\0" + packed[10:])
    begin = time.process_time()
    assert content(path) == content(MCAP)
    assert time.process_time() - begin < 8.0


@pytest.mark.parametrize("count", [1, 7, 300, 1 << 16, 1 << 20])
def test_members_of_a_gzip_file_come_out_as_python_s_own_module_reads_them(count):
    rng = random.Random(count)
    size = 200_000 if count >= 300 else 400 * count
    parts = [b"", bytes(size), rng.randbytes(3 * size // 4), b"a" * min(size, 65_536), rng.randbytes(3)]
    packed = b"".join(gzip.compress(part) for part in parts) + bytes(512) + gzip.compress(b"end") + bytes(9)
    stream, pieces = unpack.DECODERS[b"\x1f\x8b"](io.BytesIO(packed)), []
    while piece := stream.read(count):
        assert len(piece) <= count
        pieces.append(piece)
    assert b"".join(pieces) == gzip.decompress(packed)
    before = sum(len(gzip.compress(part)) for part in parts[:2])
    cut = unpack.DECODERS[b"\x1f\x8b"](io.BytesIO(packed[: before + size // 2]))
    with pytest.raises(EOFError):
        list(iter(lambda: cut.read(count), b""))


@pytest.mark.parametrize("size", [b"9" * 5000, "²".encode(), b"-1", b""])
def test_a_size_of_an_archive_that_is_no_number_is_not_used(tmp_path, size):
    field = b" size=" + size + b"\n"
    length = len(field) + len(str(len(field) + 4))
    body = b"%d" % length + field
    extra, entry = tarfile.TarInfo("x"), tarfile.TarInfo("drive.mcap")
    extra.type, extra.size, entry.size = b"x", len(body), MCAP.stat().st_size
    path = tmp_path / "drive.tar"
    path.write_bytes(
        extra.tobuf() + body + bytes(-len(body) % 512)
        + entry.tobuf() + MCAP.read_bytes() + bytes(-entry.size % 512) + bytes(1024)
    )  # fmt: skip
    assert content(path) == content(MCAP)
