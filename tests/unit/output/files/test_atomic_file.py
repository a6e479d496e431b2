from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from icrtool.errors import OutputError
from icrtool.output.exports.acceptance import write_junit
from icrtool.output.files.atomic import atomic_file, check_place, write_file


def test_nothing_is_seen_at_the_place_before_all_is_written(tmp_path: Path) -> None:
    with atomic_file(tmp_path / "a.txt") as partial:
        partial.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", "new")]


def write_half(file: Path, failure: BaseException) -> None:
    with atomic_file(file) as partial:
        partial.write_text("half")
        raise failure


def test_what_fails_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(OutputError, match=r"a\.txt: cannot be written; No space"):
        write_half(tmp_path / "a.txt", OSError(errno.ENOSPC, "No space left on device"))
    with pytest.raises(KeyboardInterrupt):
        write_half(tmp_path / "a.txt", KeyboardInterrupt())
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", "old")]


@pytest.mark.parametrize(
    "write", [lambda file: write_junit(file, []), lambda file: write_file(file, "")], ids=["junit", "text"]
)
def test_a_file_system_that_only_reads_is_one_error(tmp_path: Path, monkeypatch, write) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    for name in ("touch", "write_bytes", "replace", "unlink"):
        monkeypatch.setattr(Path, name, refuse)
    with pytest.raises(OutputError, match="cannot be written; Read-only file system"):
        write(tmp_path / "a")


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_disk_that_fails_leaves_what_was_there(tmp_path: Path, monkeypatch, call: str) -> None:
    (tmp_path / "a.txt").write_text("old")

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(OutputError, match="Input/output error"), atomic_file(tmp_path / "a.txt") as partial:
        partial.write_text("new")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", "old")]


def test_a_pipe_or_device_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path / "pipe", Path(os.devnull)):
        with pytest.raises(OutputError, match="device or pipe"):
            check_place(place)
        with pytest.raises(OutputError, match="device or pipe"), atomic_file(place):
            pass
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


def test_a_file_that_cannot_be_read_is_not_replaced(tmp_path: Path, monkeypatch) -> None:
    """It may be a log."""
    (tmp_path / "a.txt").write_text("old")

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(OutputError, match="Permission denied"):
        check_place(tmp_path / "a.txt")


def test_a_link_stays_a_link_and_leftovers_of_the_dead_are_removed_an_hour_later(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "a.txt").symlink_to("real/b.txt")
    with atomic_file(tmp_path / "a.txt") as partial:
        partial.write_text("new")
        left = partial.with_name(partial.name.replace(partial.name[-16:], "12345678.partial"))  # of this process
        left.write_text("of a killed process")
    write_file(tmp_path / "a.txt", "newer")
    assert left.exists(), "another thread may write it"
    os.utime(left, (0, 0))
    write_file(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").is_symlink()
    assert [(path.name, path.read_text()) for path in (tmp_path / "real").iterdir()] == [("b.txt", "new")]


@pytest.mark.parametrize("name", ["\u6f22" * 80 + ".json", "a." + "x" * 250, "b" * 250 + ".csv"])
def test_the_longest_name_a_file_system_takes_can_be_written(tmp_path: Path, name: str) -> None:
    for text in ("old", "new"):
        write_file(tmp_path / name, text)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "new")]
