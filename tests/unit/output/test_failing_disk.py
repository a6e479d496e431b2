"""Every writer on a disk that fails: at each call in turn, and at each size; the old or the new content is there."""

from __future__ import annotations

import builtins
import ctypes
import errno
import hashlib
import io
import os
import resource
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

import icrtool
from icrtool.calibration.record import Calibration
from icrtool.errors import OutputError
from icrtool.fleet.fleet_files import write_fleet
from icrtool.output.exports.foxglove import write_foxglove
from icrtool.output.figures.style import new_figure
from icrtool.output.files.atomic import atomic_file, write_file
from icrtool.output.files.formats import save_picture, write_calibration
from icrtool.output.simulation_files import log_and_truth, write_study
from icrtool.records.fleet_document import FleetLog
from icrtool.records.run import Run
from icrtool.simulation.study_records import Level
from support.documents import with_summary
from support.reports import with_run
from support.studies import small_study

Writer = Callable[[Path, str], object]
"""Writes something to a place; the text is in its content."""

SIZES = (0, 300, 20_000)
"""Bytes that a file may get before writing it fails."""

MOST_CALLS = 400


@pytest.fixture(scope="module")
def run(make_run: Callable[..., Run]) -> Run:
    return make_run(duration_s=30.0, troubles=False)


@pytest.fixture(scope="module")
def calibration(run: Run) -> Calibration:
    return icrtool.calibrate([run])


@pytest.fixture(scope="module")
def writers(run: Run, calibration: Calibration) -> dict[str, Writer]:
    report = icrtool.dropout_report(run, horizons_m=[1.0, 5.0], ladder=False)
    study = small_study("rate")
    table = calibration

    def named_levels(text: str) -> Iterator[Level]:
        for level in study.levels:
            yield level._replace(setting=level.setting._replace(names={text: 1.0}))

    def named(text: str) -> Run:
        return with_summary(run, log=text)

    def dropout(place: Path, text: str) -> None:
        with_run(report, named(text).document).write(place, plots=())

    def log(place: Path, text: str, *, directory: bool = False) -> None:
        with log_and_truth(place, force=True) as (fresh, truth):
            if directory:
                fresh.mkdir()
                (fresh / "metadata.yaml").write_text(text)
            (fresh / "log.db3" if directory else fresh).write_text(text)
            truth.write_text(text)

    def foxglove(place: Path, text: str) -> None:
        with atomic_file(place) as partial:
            write_foxglove(named(text), partial)

    def fleet(place: Path, text: str) -> None:
        place.mkdir(exist_ok=True)
        row = FleetLog(
            "a", "runs/a", "done", robot=text, start_utc="2026-01-01T00:00:00Z", icr=dict.fromkeys(ICRS, 1.0)
        )
        write_fleet([row, msgspec.structs.replace(row, log="b", status="failed", reason=text)], place, plots=("png",))

    return {
        "run": lambda place, text: named(text).write(place, plots=()),
        "run with pictures": lambda place, text: named(text).write(place, states="parquet"),
        "report": dropout,
        "study": lambda place, text: write_study(replace(study, levels=tuple(named_levels(text))), place),
        "calibration": lambda place, text: write_calibration(msgspec.structs.replace(table, created=text), place),
        "picture": lambda place, text: save_picture(
            new_figure(text, "", width_in=3.0, height_in=2.0), place.with_suffix(".png")
        ),
        "text": write_file,
        "foxglove": foxglove,
        "log and truth": log,
        "bag and truth": lambda place, text: log(place, text, directory=True),
        "fleet": fleet,
    }


ICRS = ("y_icr_right_m", "y_icr_left_m", "x_icr_m", "std_y_icr_right_m", "std_y_icr_left_m", "std_x_icr_m")
SLOW = {"run with pictures", "study", "picture", "foxglove", "fleet"}
"""Their figures or messages take 0.2 s or more to make: they are for `make stress`."""

NAMES = ["run", "run with pictures", "report", "study", "calibration", "picture", "text", "foxglove", "log and truth",
         "bag and truth", "fleet"]  # fmt: skip

CASES = [pytest.param(name, marks=pytest.mark.stress if name in SLOW else ()) for name in NAMES]

SEVERAL = {"log and truth", "bag and truth", "fleet"}
"""Writers of several files that are replaced one after the other."""


def contents(folder: Path) -> dict[str, str]:
    """Return the hash of each file, by its path; what is hidden beside the place is not looked at."""
    files = (path for path in folder.rglob("*") if path.is_file() and not _hidden(path.relative_to(folder)))
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _hidden(path: Path) -> bool:
    return any(part.startswith(".icrtool-") and part != ".icrtool-files" for part in path.parts)


class Fault:
    """Lets the n-th call that opens to write, renames, links, syncs or makes a directory below a folder fail."""

    def __init__(self, patched: pytest.MonkeyPatch, folder: Path, number: int, *, exchanges: bool) -> None:
        self.left, self.folder, self.failed = number, str(folder), ""
        for module, name in ((os, "rename"), (os, "replace"), (os, "mkdir"), (os, "fsync"), (os, "open"),
                             (io, "open"), (builtins, "open"), (ctypes, "CDLL")):  # fmt: skip
            patched.setattr(module, name, self.wrapped(name, getattr(module, name)))
        if not exchanges:
            patched.setattr(sys, "platform", "other")

    def wrapped(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            mode = str(args[1]) if len(args) > 1 and isinstance(args[1], str) else options.get("mode", "r")
            reads = real is io.open and not set(mode) & set("wxa+")
            ours = name in ("fsync", "CDLL") or str(args[0]).startswith(self.folder)
            if ours and not reads:
                self.left -= 1
                if self.left == 0:
                    self.failed = name
                    raise OSError(errno.EIO, "Input/output error")
            return real(*args, **options)

        return call


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Let writing a file fail where it would have more bytes, whoever writes it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def references(writer: Writer, tmp_path: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Return the contents of the old and of the new one; one that is written twice is the same."""
    found = []
    for text in ("old", "new", "new"):
        place = tmp_path / f"reference {len(found)}" / "place"
        place.parent.mkdir()
        writer(place, text)
        found.append(contents(place.parent))
    old, new, again = found
    assert new == again
    assert new != old
    assert old.keys() == new.keys()
    return old, new


def check(name: str, found: dict[str, str], old: dict[str, str], new: dict[str, str], *, failed: bool) -> None:
    """Look at what is there after a failure."""
    if name in SEVERAL:
        present = {file: content for file, content in found.items() if content not in (old[file], new[file])}
        assert not present, "a file is neither the old nor the new one"
        assert old.keys() - found.keys() <= {"place.truth.csv"}, "files are gone"
        truth = found.get("place.truth.csv")
        assert truth is None or (truth == new["place.truth.csv"]) == (found != old), "a truth of another log"
    else:
        assert found in ((old, new) if failed else (new,))


def check_leftovers(writer: Writer, folder: Path, new: dict[str, str]) -> None:
    """Write once more, an hour later, and look for what could not be removed before."""
    for path in folder.rglob(".*"):
        os.utime(path, (0, 0))
    writer(folder / "place", "new")
    assert contents(folder) == new
    assert [path for path in folder.rglob(".*") if path.name != ".icrtool-files"] == [], "leftovers stay"


@pytest.mark.parametrize("exchanges", [True, False])
@pytest.mark.parametrize("name", CASES)
def test_whatever_call_fails_the_old_or_the_new_one_is_there(
    writers: dict[str, Writer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, exchanges: bool
) -> None:
    writer, folder = writers[name], tmp_path / "folder"
    old, new = references(writer, tmp_path)
    folder.mkdir()
    for number in range(1, MOST_CALLS):
        writer(folder / "place", "old")
        with monkeypatch.context() as patched:
            fault = Fault(patched, folder, number, exchanges=exchanges)
            try:
                writer(folder / "place", "new")
                reported = False
            except OutputError:
                reported = True
        check(name, contents(folder), old, new, failed=bool(fault.failed))
        if not fault.failed:
            assert not reported
            break
    assert number > 5
    check_leftovers(writer, folder, new)


@pytest.mark.parametrize("name", CASES)
def test_whatever_file_cannot_be_written_in_full_the_old_one_is_there(
    writers: dict[str, Writer], tmp_path: Path, name: str
) -> None:
    writer, folder = writers[name], tmp_path / "folder"
    old, new = references(writer, tmp_path)
    folder.mkdir()
    refused = 0
    for size in SIZES:
        writer(folder / "place", "old")
        with suppress(OutputError), files_of_at_most(size):
            writer(folder / "place", "new")
        check(name, found := contents(folder), old, new, failed=True)
        refused += found != new
    assert refused
    check_leftovers(writer, folder, new)
