"""Batches whose logs are processed by the process of the tests."""

from __future__ import annotations

from threading import Lock

from icrtool.fleet.one_log import process_log
from icrtool.records.fleet_document import FleetLog
from icrtool.records.requests import decode_request

ONE_AT_A_TIME = Lock()


def in_this_process(request: bytes, timeout_s: float, stage: object = None) -> FleetLog:
    """Process a log of a batch without a process of its own, which would load all libraries again.

    The processes of a batch have their own tests: tests/unit/fleet/test_batch.py, test_signals.py and test_terminal.py.
    """
    # Two threads must not be the first to use a module (`icrtool.cli.lazy_imports`).
    with ONE_AT_A_TIME:
        return process_log(decode_request(request), lambda _: None)
