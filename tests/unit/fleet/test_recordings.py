from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from icrtool.errors import LogError
from icrtool.fleet.recordings import find_recordings

MCAP = b"\x89MCAP0\r\n"
BAG = b"#ROSBAG V2.0\n"


def make(root: Path, *files: str, content: bytes = MCAP) -> None:
    for file in files:
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_bytes(content)


def names(*places: Path) -> list[str]:
    return [one.name for one in find_recordings(places)]


def test_recordings_are_known_by_content_and_sidecars_are_left_out(tmp_path: Path) -> None:
    make(tmp_path, "mon/a.mcap", "mon/renamed.dat")
    make(tmp_path, "tue/b.bag", content=BAG)
    make(tmp_path, "mon/a.json", "mon/a.truth.npz", "notes.txt", "tue/b.bag.md5", content=b"text")
    make(tmp_path, ".trash/c.mcap", "mon/.hidden.mcap")
    with closing(sqlite3.connect(tmp_path / "photos.sqlite")) as other:
        other.execute("create table photos (name text)")
    with closing(sqlite3.connect(tmp_path / "rosbag.sqlite")) as bag:
        bag.execute("create table topics (name text)")
        bag.execute("create table messages (data blob)")
    assert names(tmp_path) == ["mon/a", "mon/renamed", "rosbag", "tue/b"]
    given_by_the_shell = [tmp_path / "mon" / name for name in ("a.json", "a.mcap", "a.truth.npz")]
    assert names(*given_by_the_shell) == ["a"]


def test_a_recorder_s_file_that_holds_nothing_is_not_passed_over(tmp_path: Path) -> None:
    make(tmp_path, "crashed.mcap", "zero.bag", content=b"")
    assert names(tmp_path) == ["crashed", "zero"]


def test_bag_directories_and_splits_count_once(tmp_path: Path) -> None:
    make(tmp_path, "bag/bag_0.mcap", "bag/bag_1.mcap", "packed/p_0.db3.zstd")
    make(tmp_path, "bag/metadata.yaml", "packed/metadata.yaml", content=b"rosbag2_bagfile_information:")
    make(tmp_path, "killed/k_0.mcap", "killed/k_1.mcap", "killed/k_2.mcap")
    make(tmp_path, "several/monday.mcap", "several/tuesday.mcap")
    make(tmp_path, "gap/g_0.mcap", "gap/g_4.mcap", "1/0.mcap", "1/1.mcap")
    assert names(tmp_path) == [
        "1/0", "1/1", "bag", "gap/g_0", "gap/g_4", "killed", "packed", "several/monday", "several/tuesday",
    ]  # fmt: skip


def test_equal_names_never_collide(tmp_path: Path) -> None:
    make(tmp_path, "x/field.mcap", "y/field.mcap", "y/FIELD.db3", "field.mcap", "field/inner.mcap")
    make(tmp_path, "x/field.bag", content=BAG)
    found = names(tmp_path)
    assert len({name.casefold() for name in found}) == len(found) == 6
    for name in found:
        inside = [other for other in found if other.startswith(f"{name}/")]
        assert not inside, "no run lies in another one"


def test_names_stay_when_logs_are_added(tmp_path: Path) -> None:
    make(tmp_path, "mon/a.mcap")
    before = names(tmp_path)
    make(tmp_path, "tue/b.mcap")
    assert before == ["mon/a"]
    assert set(before) < set(names(tmp_path))


def test_one_log_named_twice_and_by_a_link_counts_once(tmp_path: Path) -> None:
    make(tmp_path, "a.mcap")
    (tmp_path / "link.mcap").symlink_to("a.mcap")
    (tmp_path / "up").mkdir()
    (tmp_path / "up" / "loop").symlink_to(tmp_path)
    assert len(names(tmp_path, tmp_path / "a.mcap", tmp_path / "link.mcap")) == 1


def test_results_of_ours_are_not_searched(tmp_path: Path) -> None:
    make(tmp_path, "a.mcap", "results/runs/x.mcap")
    make(tmp_path, "results/fleet.json", content=b"{}")
    assert names(tmp_path) == ["a"]


def test_names_of_dots_and_of_no_text_stay_in_the_folder(tmp_path: Path) -> None:
    make(tmp_path, "a/..x", "a/b.mcap")
    (tmp_path / os.fsdecode(b"\xff.mcap")).write_bytes(MCAP)
    for name in names(tmp_path, tmp_path / "a" / "..x"):
        name.encode()
        assert ".." not in Path(name).parts


def test_where_no_recording_is_that_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no recording in it"):
        find_recordings([tmp_path])
    with pytest.raises(LogError, match="no such file"):
        find_recordings([tmp_path / "gone"])
