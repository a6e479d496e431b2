"""Commands run in the process of the tests, as a user calls them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from icrtool.cli import main
from support.batches import in_this_process
from support.pictures import blank_pictures


@pytest.fixture(scope="module", autouse=True)
def batches_in_this_process():
    """Of the scope of a module: files of other folders, which the same process tests next, test the real processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("icrtool.fleet.batch.process_apart", in_this_process)
        yield


@pytest.fixture
def without_drawing():
    """Pictures are blank in a test that reads numbers and files."""
    with blank_pictures():
        yield


@pytest.fixture
def run_place(tmp_path: Path) -> Path:
    """The folder commands run in."""
    return tmp_path


@pytest.fixture
def icrtool(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], run_place: Path):
    monkeypatch.chdir(run_place)

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["icrtool", *map(str, arguments)])
        try:
            main()
        except SystemExit as left:
            return int(left.code or 0), *capfd.readouterr()
        return 0, *capfd.readouterr()

    return run
