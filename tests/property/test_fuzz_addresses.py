"""Odd addresses as logs, places of results and options: one line of reason, no secret, no other connection.

The addresses are the same in each run. ``make fuzz FUZZ="--addresses 5000"`` tries many more.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import NamedTuple

import pytest

from icrtool.logs.write_log import WriteOptions, write_log
from property.test_fuzz_logs import drive
from support.scripts import load_script

NEEDED = ("s3fs", "gcsfs", "adlfs", "aiohttp", "moto")
"""Looked for, not imported: both processes of the tests import this file, and one of them runs it."""
pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="servers as threads of this process"),
    pytest.mark.skipif(not all(map(find_spec, NEEDED)), reason="needs the extras icrtool[cloud] and icrtool[dev]"),
]

FUZZ, RUNS = load_script("fuzz_addresses"), load_script("fuzz_runs")


class Served(NamedTuple):
    """The port of the web server, the log that it gives, and a run of the user's own."""

    port: int
    log: Path
    run: Path


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Serve a log at odd addresses."""
    folder = tmp_path_factory.mktemp("served")
    options = WriteOptions(container="mcap", wheels="joint_states", wheel_radius_m=0.165, track_width_m=0.55)
    log = write_log(folder / "log.mcap", drive(400), options)
    with FUZZ.servers(log) as port:
        yield Served(port, log, RUNS.made(folder) / "run")


@pytest.mark.parametrize("seed", range(40))
def test_an_odd_address_is_used_or_refused_within_the_rules(served: Served, tmp_path: Path, seed: int) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    address, command = FUZZ.make_case(folder, served.run, served.log, seed, served.port)
    assert FUZZ.use_address(folder, address, command, served.port)


def test_the_rules_are_broken_by_a_secret_in_an_output_and_by_another_host(served: Served, tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    _, command = FUZZ.make_case(folder, served.run, served.log, 0, served.port)
    shown = FUZZ.OddAddress("missing.mcap", ("missing",))
    with pytest.raises(AssertionError, match="a secret in what is printed"):
        FUZZ.use_address(folder, shown, ("info", "A"), served.port)
    assert not FUZZ.is_typed("elsewhere.invalid", "https://host/a.mcap")
    assert FUZZ.is_typed("127.0.0.1", "http://2130706433/a.mcap")
    assert command in FUZZ.COMMANDS


def test_many_addresses_lead_to_a_server_and_many_have_secrets() -> None:
    made = [FUZZ.make_address(Random(seed), 1234) for seed in range(400)]
    assert sum("127.0.0.1:1234/" in one.text or "://field/" in one.text for one in made) > 100
    assert sum(bool(one.secrets) for one in made) > 100
