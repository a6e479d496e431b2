"""Runs of logs that several files of tests look at."""

from __future__ import annotations

import functools
from pathlib import Path

import icrtool
from icrtool.records.run import Run


@functools.cache
def run_of_log(log: Path, robot: str) -> Run:
    """Return the run of a log with a built-in robot, fitted once a process; no test changes it."""
    config = icrtool.load_config(robot=robot)
    return icrtool.fit(icrtool.read_log(log, config), config)
