from __future__ import annotations

import errno
from pathlib import Path

import pytest

from icrtool.errors import OutputError
from icrtool.output.atomic_file import atomic_file
from icrtool.output.exports.acceptance import write_junit, write_markdown


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


@pytest.mark.parametrize("write", [write_junit, write_markdown])
def test_a_file_system_that_only_reads_is_one_error(tmp_path: Path, monkeypatch, write) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    for name in ("write_bytes", "replace", "unlink"):
        monkeypatch.setattr(Path, name, refuse)
    with pytest.raises(OutputError, match="cannot be written; Read-only file system"):
        write(tmp_path / "a", [])
