from __future__ import annotations

import ctypes
import errno
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random

import pytest

from icrtool.errors import OutputError
from icrtool.output.files.atomic import DirectoryKind, atomic_directory, check_directory


def marked(directory: Path) -> bool:
    return (directory / "mark").exists()


REPORT = DirectoryKind("report", marked, re.compile(r"mark|old/|sub/([0-9]\.gen)?|[0-9]\.gen"))


def write(directory: Path, text: str = "new") -> None:
    with atomic_directory(directory, REPORT) as fresh:
        (fresh / "mark").write_text(text)


def test_nothing_is_seen_at_the_place_before_all_is_written(tmp_path: Path) -> None:
    with atomic_directory(tmp_path / "a", REPORT) as fresh:
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
        check_directory(tmp_path / place, REPORT)
    with pytest.raises(OutputError):
        write(tmp_path / place)
    assert (tmp_path / "file").read_text() == ""


def test_a_full_disk_leaves_the_old_one_and_nothing_else(tmp_path: Path) -> None:
    write(tmp_path / "a", "old")

    def fill() -> None:
        with atomic_directory(tmp_path / "a", REPORT) as fresh:
            (fresh / "mark").write_text("half")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match="a: cannot be written; No space left on device"):
        fill()
    assert (tmp_path / "a" / "mark").read_text() == "old"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ValueError])
def test_an_interruption_leaves_no_file_and_no_hidden_directory(tmp_path: Path, stop: type[BaseException]) -> None:
    def interrupted() -> None:
        with atomic_directory(tmp_path / "a" / "b", REPORT) as fresh:
            (fresh / "mark").write_text("half")
            raise stop

    with pytest.raises(stop):
        interrupted()
    assert list(tmp_path.rglob("*")) == [tmp_path / "a"]


def test_what_came_into_the_place_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    def surprised() -> None:
        with atomic_directory(tmp_path / "a", REPORT) as fresh:
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
    with atomic_directory(directory, REPORT) as fresh:
        (fresh / "mark").write_text(text)
        (fresh / "sub").mkdir()
        for number in range(FILES):
            (fresh / "sub" / f"{number}.gen").write_text(text)


class Fault:
    """Lets the n-th call of the system that changes the disk, or of a write, fail; `late`: when it is done."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, number: int, failure: BaseException, *, exchanges: bool, late: bool
    ):
        self.left, self.failure, self.late, self.name = number, failure, late, ""
        for name in ("rename", "fsync"):
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
            if self.late:
                real(*args, **options)
            raise self.failure
        return real(*args, **options)


def partialmethod_of(fault: Fault, name: str, real: Callable[..., object]) -> Callable[..., object]:
    return lambda *args, **options: fault.call(name, real, *args, **options)


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("exchanges", [True, False])
@pytest.mark.parametrize("failure", [OSError(errno.EIO, "Input/output error"), KeyboardInterrupt()])
def test_whatever_call_fails_the_old_or_the_new_one_is_there(
    tmp_path: Path, monkeypatch, failure, exchanges, late
) -> None:
    place, failed = tmp_path / "a", set()
    for number in range(1, 100):
        with monkeypatch.context() as patched:
            write_generation(place, f"old {number}")
            fault = Fault(patched, number, failure, exchanges=exchanges, late=late)
            try:
                write_generation(place, f"new {number}")
                said = None
            except OutputError as err:
                said = err.__cause__
            except KeyboardInterrupt as err:
                said = err
        assert said is (failure if fault.name else None), "a failure is an error, and only a failure is"
        if not fault.name:
            break
        failed.add(fault.name)
        check_directory(place, REPORT)
        assert generation(place) in {f"old {number}", f"new {number}"}
    write_generation(place, "last")
    assert [path.name for path in tmp_path.iterdir()] == ["a"], "nothing is left"
    assert failed == {"rename" if not exchanges else "exchange", "fsync", "write", "mkdir"}


KILLED = """
import re, sys
from pathlib import Path
sys.path.insert(0, sys.argv[4])
from icrtool.output.files.atomic import DirectoryKind, atomic_directory
NAMES = re.compile(r"mark|[0-9].gen|sub/([0-9].gen)?")
REPORT = DirectoryKind("report", lambda place: (place / "mark").exists(), NAMES)
if sys.argv[3] == "renames":
    sys.platform = "other"
for number in range(int(sys.argv[2]), 1_000_000):
    with atomic_directory(Path(sys.argv[1]), REPORT) as fresh:
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
        check_directory(place, REPORT)
        # The last one that was reported, or the next, which was put in place before it could be.
        assert int(generation(place)) in {whole[-1], whole[-1] + 1}
        written = whole[-1] + 1
    write_generation(place, "last")
    assert [path.name for path in tmp_path.iterdir()] == ["a"], "leftovers are removed by the next one"


@pytest.mark.parametrize("where", ["mine.txt", "sub/deep/mine.txt", "sub/mine.txt", "mine/", "mark.txt", "plots"])
def test_one_of_ours_with_a_file_of_somebody_is_refused_by_that_name_before_any_work(
    tmp_path: Path, where: str
) -> None:
    place = tmp_path / "a"
    write_generation(place, "old")
    mine = place / where
    if where.endswith("/"):
        mine.mkdir()
    else:
        mine.parent.mkdir(exist_ok=True)
        mine.write_text("years of work")
    named = where if where != "sub/deep/mine.txt" else "sub/deep/"
    with pytest.raises(OutputError, match=f"a: holds {named}, which is no part of a report; move it elsewhere first"):
        check_directory(place, REPORT)
    with pytest.raises(OutputError):
        write(place)
    assert generation(place) == "old"
    assert mine.exists()


@pytest.mark.parametrize("name", ["mark", "sub", "mine"])
def test_a_link_in_one_of_ours_is_never_followed(tmp_path: Path, name: str) -> None:
    write(tmp_path / "a", "old")
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("years of work")
    link = tmp_path / "a" / name
    link.unlink(missing_ok=True)
    link.symlink_to(tmp_path / "home" / ("thesis.txt" if name == "mark" else "."))
    if name == "mark":
        write(tmp_path / "a")  # a file of ours by its name: the link itself is replaced
        assert not link.is_symlink()
    else:
        with pytest.raises(OutputError, match=f"a: holds {name}, which is no part of a report"):
            write(tmp_path / "a")
    assert [(path.name, path.read_text()) for path in (tmp_path / "home").iterdir()] == [
        ("thesis.txt", "years of work")
    ]


def test_what_another_process_writes_in_one_of_ours_is_not_looked_into(tmp_path: Path, monkeypatch) -> None:
    write(tmp_path / "a", "old")
    (tmp_path / "a" / ".icrtool-0123-4567.partial").mkdir()
    real = os.scandir

    def vanished(path: str) -> object:
        if ".icrtool-" in str(path):
            raise FileNotFoundError(errno.ENOENT, "No such file or directory")
        return real(path)

    monkeypatch.setattr(os, "scandir", vanished)
    check_directory(tmp_path / "a", REPORT)


@pytest.mark.parametrize("closed", ["", "sub"])
def test_what_cannot_be_looked_into_is_left_alone(tmp_path: Path, monkeypatch, closed: str) -> None:
    (tmp_path / "a" / "sub").mkdir(parents=True)
    (tmp_path / "a" / "sub" / "thesis.txt").write_text("years of work")
    if closed:
        (tmp_path / "a" / "mark").write_text("old")
    real, place = os.scandir, os.path.realpath(tmp_path / "a" / closed)

    # Root may look into everything, so permissions are no means here.
    def refused(path: str) -> object:
        if str(path) == place:
            raise PermissionError(errno.EACCES, "Permission denied")
        return real(path)

    with monkeypatch.context() as patched:
        patched.setattr(os, "scandir", refused)
        with pytest.raises(OutputError, match="a: cannot be written; Permission denied"):
            write(tmp_path / "a")
    assert (tmp_path / "a" / "sub" / "thesis.txt").read_text() == "years of work"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


@pytest.mark.parametrize("closed", ["", "sub"])
def test_what_could_not_be_removed_is_not_replaced(tmp_path: Path, monkeypatch, closed: str) -> None:
    write_generation(tmp_path / "a", "old")
    real, place = os.access, os.path.realpath(tmp_path / "a" / closed)
    # Root may write everywhere, so permissions are no means here.
    with monkeypatch.context() as patched:
        patched.setattr(os, "access", lambda path, mode: os.path.realpath(path) != place and real(path, mode))
        with pytest.raises(OutputError, match=f"a: is write-protected.*; make {Path('a', closed)}/ writable"):
            write_generation(tmp_path / "a", "new")
    assert generation(tmp_path / "a") == "old"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]
    write_generation(tmp_path / "a", "new")


def test_what_came_into_one_of_ours_meanwhile_is_not_lost(tmp_path: Path) -> None:
    write(tmp_path / "a", "old")

    def surprised() -> None:
        with atomic_directory(tmp_path / "a", REPORT) as fresh:
            (fresh / "mark").write_text("new")
            (tmp_path / "a" / "thesis.txt").write_text("years of work")

    with pytest.raises(OutputError, match=r"holds thesis\.txt"):
        surprised()
    assert (tmp_path / "a" / "thesis.txt").read_text() == "years of work"
    assert (tmp_path / "a" / "mark").read_text() == "old"


@pytest.mark.parametrize("name", [".DS_Store", "sub/Thumbs.db", ".icrtool-files", ".icrtool-0123-4567.partial/mark"])
def test_what_file_managers_and_killed_processes_left_does_not_disturb(tmp_path: Path, name: str) -> None:
    write_generation(tmp_path / "a", "old")
    (tmp_path / "a" / name).parent.mkdir(exist_ok=True)
    (tmp_path / "a" / name).write_text("")
    write_generation(tmp_path / "a", "new")
    assert generation(tmp_path / "a") == "new"


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
    with atomic_directory(tmp_path / "a", REPORT) as slow:
        (slow / "mark").write_text("slow")
        write(tmp_path / "a", "quick")
        assert (slow / "mark").exists()
    assert (tmp_path / "a" / "mark").read_text() == "slow"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


KILLED_AT = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from test_atomic_directory import write
sys.platform = "other"
moment, renames, rename = sys.argv[2], [], Path.rename

def counted(path, target):
    renames.append(rename(path, target))
    if len(renames) == int(moment):
        os._exit(9)
    return target

Path.rename = counted
if moment == "0":
    Path.write_text = lambda *_: os._exit(9)
write(Path(sys.argv[1]), "new")
"""


def killed(place: Path, moment: int) -> None:
    """Write to a place, and end the process while it writes (0), or after the first or second rename."""
    arguments = [str(place), str(moment), str(Path(__file__).parent)]
    path = os.pathsep.join([str(Path(__file__).parents[3]), str(Path(__file__).parents[4])])
    done = subprocess.run(
        [sys.executable, "-c", KILLED_AT, *arguments], check=False, env=os.environ | {"PYTHONPATH": path}
    )
    assert done.returncode == 9


def test_what_a_killed_process_renamed_aside_is_found_again_and_only_at_its_place(tmp_path: Path) -> None:
    write(tmp_path / "a.b", "old")
    killed(tmp_path / "a.b", 1)
    assert not (tmp_path / "a.b").exists()
    for other in ("a", "b", "a.b.c"):
        check_directory(tmp_path / other, REPORT)
        write(tmp_path / other)
    assert not (tmp_path / "a.b").exists()
    check_directory(tmp_path / "a.b", REPORT)
    assert (tmp_path / "a.b" / "mark").read_text() == "old"


@pytest.mark.skipif(sys.platform != "linux", reason="there what is left is removed by its age")
@pytest.mark.parametrize("moment", [0, 1, 2])
def test_what_a_killed_process_left_is_removed_by_the_next_one(tmp_path: Path, moment: int) -> None:
    place = tmp_path / "a"
    write(place, "old")
    killed(place, moment)
    assert [path for path in tmp_path.iterdir() if path != place]
    write(place, "new")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert (place / "mark").read_text() == "new"


def test_what_another_host_writes_is_removed_an_hour_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "node", lambda: "another")
    with atomic_directory(tmp_path / "a", REPORT) as slow:
        monkeypatch.undo()
        theirs = slow.with_name(slow.name.replace(f"-{os.getpid()}-", "-0-"))
        theirs.mkdir()
        write(tmp_path / "a")
        assert theirs.exists()
        os.utime(theirs, (0, 0))
        write(tmp_path / "a")
        assert not theirs.exists()
        (slow / "mark").touch()


@pytest.mark.parametrize("name", ["x", "1-2-3-4-5", "zz-..-0", "0-999999999999999999999-0", "--"])
def test_a_hidden_name_that_somebody_invented_does_no_harm(tmp_path: Path, name: str) -> None:
    with atomic_directory(tmp_path / "a", REPORT) as fresh:
        hidden = fresh.with_name(f"{fresh.name[:26]}{name}.partial")
        (fresh / "mark").touch()
    hidden.write_text("")
    write(tmp_path / "a")
    assert {path.name for path in tmp_path.iterdir()} >= {"a", hidden.name}
