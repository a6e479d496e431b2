from __future__ import annotations

import errno
from pathlib import Path

import pytest

from icrtool.errors import OutputError
from icrtool.output.atomic_directory import atomic_directory, check_place


def marked(directory: Path) -> bool:
    return (directory / "mark").exists()


def write(directory: Path, text: str = "new") -> None:
    with atomic_directory(directory, marked, kind="report") as partial:
        (partial / "mark").write_text(text)


def test_nothing_is_seen_at_the_place_before_all_is_written(tmp_path: Path) -> None:
    with atomic_directory(tmp_path / "a", marked, kind="report") as partial:
        (partial / "mark").write_text("new")
        assert not (tmp_path / "a").exists()
    assert (tmp_path / "a" / "mark").read_text() == "new"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_missing_parents_are_made(tmp_path: Path) -> None:
    write(tmp_path / "a" / "b" / "c")
    assert (tmp_path / "a" / "b" / "c" / "mark").exists()


def test_an_empty_directory_is_used(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    write(tmp_path / "a")
    assert (tmp_path / "a" / "mark").exists()


def test_one_of_ours_is_replaced_with_all_it_held(tmp_path: Path) -> None:
    (tmp_path / "a" / "old").mkdir(parents=True)
    (tmp_path / "a" / "mark").write_text("old")
    write(tmp_path / "a")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["mark"]
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_a_link_stays_a_link_to_what_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "mark").write_text("old")
    (tmp_path / "link").symlink_to("real")
    write(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "mark").read_text() == "new"


def test_a_foreign_directory_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "thesis.txt").write_text("years of work")
    with pytest.raises(OutputError, match="a: holds something that is not a report; it is left alone"):
        write(tmp_path / "a")
    assert (tmp_path / "a" / "thesis.txt").read_text() == "years of work"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


@pytest.mark.parametrize("place", ["file", "file/run", "file/deep/run"])
def test_a_file_in_the_way_is_an_error(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"is a file|a file is there|cannot be written"):
        check_place(tmp_path / place, marked, kind="report")
    with pytest.raises(OutputError):
        write(tmp_path / place)
    assert (tmp_path / "file").read_text() == ""


def test_a_full_disk_leaves_the_old_one_and_nothing_else(tmp_path: Path) -> None:
    write(tmp_path / "a", "old")

    def fill() -> None:
        with atomic_directory(tmp_path / "a", marked, kind="report") as partial:
            (partial / "mark").write_text("half")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match="a: cannot be written; No space left on device"):
        fill()
    assert (tmp_path / "a" / "mark").read_text() == "old"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ValueError])
def test_an_interruption_leaves_nothing_not_even_parents(tmp_path: Path, stop: type[BaseException]) -> None:
    def interrupted() -> None:
        with atomic_directory(tmp_path / "a" / "b", marked, kind="report") as partial:
            (partial / "mark").write_text("half")
            raise stop

    with pytest.raises(stop):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_the_old_one_is_put_back_when_the_new_one_cannot_take_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "a", "old")
    rename = Path.rename

    def refuse(self: Path, target: Path) -> Path:
        if self.suffix == ".partial":
            raise OSError(errno.EACCES, "Permission denied")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(OutputError, match="Permission denied"):
        write(tmp_path / "a")
    assert (tmp_path / "a" / "mark").read_text() == "old"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_what_came_into_the_place_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    def surprised() -> None:
        with atomic_directory(tmp_path / "a", marked, kind="report") as partial:
            (partial / "mark").write_text("new")
            (tmp_path / "a").mkdir()
            (tmp_path / "a" / "thesis.txt").write_text("years of work")

    with pytest.raises(OutputError, match="left alone"):
        surprised()
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["thesis.txt"]
