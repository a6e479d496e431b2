"""Commands run in the process of the tests, as a user calls them."""

from __future__ import annotations

import sys
from pathlib import Path
from threading import Lock

import pytest

from icrtool.cli import main
from icrtool.fleet.one_log import process
from icrtool.records.fleet_document import FleetLog
from icrtool.records.requests import decode_request

ONE_AT_A_TIME = Lock()


def in_this_process(request: bytes, timeout_s: float, stage: object = None) -> FleetLog:
    """Process a log of a batch without a process of its own, which would load all libraries again.

    The processes of a batch have their own tests: tests/unit/fleet/test_batch.py, test_signals.py and test_terminal.py.
    """
    # Two threads must not be the first to use a module (`icrtool.cli.when_used`).
    with ONE_AT_A_TIME:
        return process(decode_request(request), lambda _: None)


@pytest.fixture(scope="session", autouse=True)
def batches_in_this_process():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("icrtool.fleet.batch.process_apart", in_this_process)
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
