from __future__ import annotations

import ctypes
import errno
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random

import pytest

from icrtool.errors import OutputError
from icrtool.output.files.atomic import atomic_directory, check_directory


def marked(directory: Path) -> bool:
    return (directory / "mark").exists()


def write(directory: Path, text: str = "new") -> None:
    with atomic_directory(directory, marked, kind="report") as fresh:
        (fresh / "mark").write_text(text)


def test_nothing_is_seen_at_the_place_before_all_is_written(tmp_path: Path) -> None:
    with atomic_directory(tmp_path / "a", marked, kind="report") as fresh:
        (fresh / "mark").write_text("new")
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
    assert [path.name for path in (tmp_path / "a").glob("[!.]*")] == ["mark"]
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
        check_directory(tmp_path / place, marked, kind="report")
    with pytest.raises(OutputError):
        write(tmp_path / place)
    assert (tmp_path / "file").read_text() == ""


def test_a_full_disk_leaves_the_old_one_and_nothing_else(tmp_path: Path) -> None:
    write(tmp_path / "a", "old")

    def fill() -> None:
        with atomic_directory(tmp_path / "a", marked, kind="report") as fresh:
            (fresh / "mark").write_text("half")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match="a: cannot be written; No space left on device"):
        fill()
    assert (tmp_path / "a" / "mark").read_text() == "old"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ValueError])
def test_an_interruption_leaves_nothing_not_even_parents(tmp_path: Path, stop: type[BaseException]) -> None:
    def interrupted() -> None:
        with atomic_directory(tmp_path / "a" / "b", marked, kind="report") as fresh:
            (fresh / "mark").write_text("half")
            raise stop

    with pytest.raises(stop):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_what_came_into_the_place_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    def surprised() -> None:
        with atomic_directory(tmp_path / "a", marked, kind="report") as fresh:
            (fresh / "mark").write_text("new")
            (tmp_path / "a").mkdir()
            (tmp_path / "a" / "thesis.txt").write_text("years of work")

    with pytest.raises(OutputError, match="left alone"):
        surprised()
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["thesis.txt"]


def generation(directory: Path) -> str:
    """Return the generation of which all files of a directory must be."""
    texts = {path.read_text() for path in directory.rglob("[!.]*") if path.is_file() and path.suffix == ".gen"}
    assert len(texts) == 1, f"files of {len(texts)} generations"
    assert len(list(directory.rglob("*.gen"))) == FILES
    return texts.pop()


FILES = 4


def write_generation(directory: Path, text: str) -> None:
    with atomic_directory(directory, marked, kind="report") as fresh:
        (fresh / "mark").write_text(text)
        (fresh / "sub").mkdir()
        for number in range(FILES):
            (fresh / "sub" / f"{number}.gen").write_text(text)


class Fault:
    """Lets the n-th call of the system that changes the disk, or of a write, fail."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, number: int, failure: BaseException, *, exchanges: bool):
        self.left, self.failure, self.name = number, failure, ""
        for name in ("rename", "link", "fsync"):
            monkeypatch.setattr(os, name, partial(self.call, name, getattr(os, name)))
        if exchanges:
            monkeypatch.setattr(ctypes, "CDLL", partial(self.call, "exchange", ctypes.CDLL))
        else:
            monkeypatch.setattr(sys, "platform", "other")
        monkeypatch.setattr(Path, "mkdir", partialmethod_of(self, "mkdir", Path.mkdir))
        monkeypatch.setattr(Path, "write_text", partialmethod_of(self, "write", Path.write_text))

    def call(self, name: str, real: Callable[..., object], *args: object, **options: object) -> object:
        self.left -= 1
        if self.left == 0:
            self.name = name
            raise self.failure
        return real(*args, **options)


def partialmethod_of(fault: Fault, name: str, real: Callable[..., object]) -> Callable[..., object]:
    return lambda *args, **options: fault.call(name, real, *args, **options)


@pytest.mark.parametrize("exchanges", [True, False])
@pytest.mark.parametrize("failure", [OSError(errno.EIO, "Input/output error"), KeyboardInterrupt()])
def test_whatever_call_fails_the_old_or_the_new_one_is_there(tmp_path: Path, monkeypatch, failure, exchanges) -> None:
    place, failed = tmp_path / "a", set()
    for number in range(1, 100):
        with monkeypatch.context() as patched:
            write_generation(place, f"old {number}")
            (place / "mine.txt").write_text("years of work")
            fault = Fault(patched, number, failure, exchanges=exchanges)
            try:
                write_generation(place, f"new {number}")
                said = False
            except (OutputError, KeyboardInterrupt):
                said = True
        assert said == bool(fault.name), "a failure is an error, and only a failure is"
        if not fault.name:
            break
        failed.add(fault.name)
        check_directory(place, marked, kind="report")
        assert generation(place) in {f"old {number}", f"new {number}"}
        assert (place / "mine.txt").read_text() == "years of work"
    write_generation(place, "last")
    assert [path.name for path in tmp_path.iterdir()] == ["a"], "leftovers are removed by the next one"
    assert failed == {"rename" if not exchanges else "exchange", "link", "fsync", "write", "mkdir"}


KILLED = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[4])
from icrtool.output.files.atomic import atomic_directory
if sys.argv[3] == "renames":
    sys.platform = "other"
for number in range(int(sys.argv[2]), 1_000_000):
    with atomic_directory(Path(sys.argv[1]), lambda place: (place / "mark").exists(), kind="report") as fresh:
        for name in ("mark", "0.gen", "1.gen", "2.gen", "3.gen"):
            (fresh / name).write_text(str(number))
    print(number, flush=True)
"""


@pytest.mark.stress
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
@pytest.mark.parametrize("means", ["exchange", "renames"])
def test_killed_at_any_moment_the_old_or_the_new_one_is_there(tmp_path: Path, means: str) -> None:
    place, random = tmp_path / "a", Random(1)
    write_generation(place, "0")
    (place / "mine.txt").write_text("years of work")
    written = 0
    for _ in range(int(os.environ.get("ICRTOOL_KILLS", "40"))):
        arguments = [str(place), str(written + 1), means, str(Path(__file__).parents[3])]
        process = subprocess.Popen([sys.executable, "-c", KILLED, *arguments], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        first = process.stdout.readline()
        time.sleep(random.uniform(0, 0.03))
        process.kill()
        said = [first, *process.communicate()[0].splitlines()]
        whole = [int(line) for line in said if line.strip().isdigit()]
        check_directory(place, marked, kind="report")
        # The last one that was reported, or the next, which was put in place before it could be.
        assert int(generation(place)) in {whole[-1], whole[-1] + 1}
        assert (place / "mine.txt").read_text() == "years of work"
        written = whole[-1] + 1
    write_generation(place, "last")
    assert [path.name for path in tmp_path.iterdir()] == ["a"], "leftovers are removed by the next one"


@pytest.mark.parametrize("where", ["mine.txt", "sub/deep/mine.txt", "inner/mine.txt"])
def test_files_of_others_are_kept_and_reported(tmp_path: Path, where: str) -> None:
    place, notes = tmp_path / "a", []

    def write_outer(text: str) -> None:
        judge = partial(Path.__eq__, place)
        with atomic_directory(place, judge, kind="run", names=("later.html",), note=notes.append) as fresh:
            (fresh / "outer").write_text(text)

    write_outer("old")
    write(place / "inner", "old")
    mine = place / where
    mine.parent.mkdir(parents=True, exist_ok=True)
    mine.write_text("years of work")
    (place / "later.html").write_text("of the old one")
    write_outer("new")
    assert mine.read_text() == "years of work"
    assert (place / "outer").read_text() == "new"
    assert not (place / "inner" / "mark").exists()
    assert not (place / "later.html").exists()
    assert len(notes) == 1
    assert "later.html" in notes[0]
    assert "inner/" in notes[0]
    if where.startswith("inner"):
        write(place / "inner", "next")  # it is still known as one of ours
        assert mine.read_text() == "years of work"


def test_a_foreign_file_where_a_directory_of_ours_is_due_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a", "old")
    (tmp_path / "a" / "plots").write_text("a file of mine")

    def surprised() -> None:
        with atomic_directory(tmp_path / "a", marked, kind="report") as fresh:
            (fresh / "plots").mkdir()
            (fresh / "plots" / "one.png").touch()

    with pytest.raises(OutputError, match="a: holds plots"):
        surprised()
    assert (tmp_path / "a" / "plots").read_text() == "a file of mine"
    assert (tmp_path / "a" / "mark").read_text() == "old"


@pytest.mark.parametrize("place", ["a", "a/sub", "a/b/c"])
def test_what_holds_or_lies_in_one_of_the_kind_is_refused(tmp_path: Path, place: str) -> None:
    write(tmp_path / "a", "old")
    write_inner = tmp_path / "a" / "x" / "y"
    write_inner.mkdir(parents=True)
    (write_inner / "mark").write_text("another")
    with pytest.raises(OutputError, match="holds another report" if place == "a" else "lies inside the report"):
        write(tmp_path / place)
    assert (write_inner / "mark").read_text() == "another"


def test_a_pipe_or_device_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path / "pipe", tmp_path / "pipe" / "run", Path(os.devnull)):
        with pytest.raises(OutputError, match=r"a file is there|is a file"):
            write(place)


def test_a_link_that_leads_to_itself_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(OutputError):
        write(tmp_path / "loop")


def test_the_longest_name_a_file_system_takes_can_be_replaced(tmp_path: Path) -> None:
    place = tmp_path / ("n" * 255)
    write(place, "old")
    write(place, "new")
    assert (place / "mark").read_text() == "new"


def test_what_a_living_process_writes_is_not_cleaned(tmp_path: Path) -> None:
    with atomic_directory(tmp_path / "a", marked, kind="report") as slow:
        (slow / "mark").write_text("slow")
        write(tmp_path / "a", "quick")
        assert (slow / "mark").exists()
    assert (tmp_path / "a" / "mark").read_text() == "slow"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_what_a_killed_process_left_of_another_place_is_not_taken(tmp_path: Path) -> None:
    for name in (".a.b.12345678.old", ".a.b.12345678.partial"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mark").write_text("of a.b")
    check_directory(tmp_path / "a", marked, kind="report")
    assert not (tmp_path / "a").exists()
    write(tmp_path / "a")
    assert {path.name for path in tmp_path.iterdir()} == {"a", ".a.b.12345678.old", ".a.b.12345678.partial"}
    check_directory(tmp_path / "a.b", marked, kind="report")
    assert (tmp_path / "a.b" / "mark").read_text() == "of a.b"
