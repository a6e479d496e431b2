"""Fixes that share stamps or arrive several at a time, and a datum far away, on drives whose motion is known."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.logs.read_log import read_log
from icrtool.logs.streams.bursts import spread_positions
from icrtool.pipeline import fit
from icrtool.records.run import Run
from support.drives import ICRS
from support.field_logs import ROBOT, WIDTH_M, Message, fixes, header, imus, joint_states, make_drive, write_messages

DRIVE = make_drive(90.0)
MS = 1_000_000
OF_ICRS_M = 0.03
"""Accuracy of the ICRs of these drives without noise [m]."""


def stamped(messages: Iterator[Message], samples: int, apart_ns: int, *, arrival: bool) -> Iterator[Message]:
    """Yield fixes that arrive so many at a time, stamped on arrival; or that share the stamp of the first of them."""
    every = list(messages)
    for begin in range(0, len(every), samples):
        packet = every[begin : begin + samples]
        for j, one in enumerate(packet):
            stamp_ns = packet[-1].log_ns + j * apart_ns if arrival else packet[0].log_ns
            one.content.header = header(stamp_ns, "gps")
            yield one._replace(log_ns=stamp_ns) if arrival else one


def run_of(path: Path, *streams: Iterator[Message], sets: tuple[str, ...] = ()) -> Run:
    write_messages(path, joint_states(DRIVE), imus(DRIVE), *streams)
    config = load_config(sets=(*ROBOT, *sets))
    return fit(read_log(path, config), config)


def shows_the_icrs(run: Run) -> bool:
    document = run.document.recommended
    assert document is not None
    found = [document.geometry[name] for name in ("y_icr_right_m", "y_icr_left_m")]
    multiplier = document.geometry["multiplier"]
    return bool(np.allclose(found, ICRS[:2], atol=OF_ICRS_M)) and abs(
        multiplier - (ICRS[0] - ICRS[1]) / WIDTH_M
    ) < 0.03  # fmt: skip


@pytest.mark.parametrize(
    ("samples", "apart_ns", "arrival"), [(2, MS // 5, True), (5, MS // 5, True), (2, 0, False), (5, 0, False)]
)
def test_fixes_in_bursts_or_of_one_stamp_show_the_icrs(
    tmp_path: Path, samples: int, apart_ns: int, arrival: bool
) -> None:
    run = run_of(tmp_path / "log.mcap", stamped(fixes(DRIVE), samples, apart_ns, arrival=arrival))
    assert run.usable
    assert shows_the_icrs(run)
    (named,) = (one.text for one in run.notes if one.code == "fix_bursts")
    words = f"fixes arrive in bursts of {samples}, {samples * 200} ms" if arrival else f"in groups of {samples}"
    assert words in named
    # the delay that is left is that of the clocks, which agree
    assert run.document.filter.reference_delay_s == pytest.approx(0.0, abs=0.05)


def test_fixes_recorded_twice_keep_their_stamps(tmp_path: Path) -> None:
    doubled = (one for one in fixes(DRIVE) for _ in range(2))
    run = run_of(tmp_path / "log.mcap", doubled)
    assert run.usable
    assert shows_the_icrs(run)
    assert not [one for one in run.notes if one.code == "fix_bursts"]


@pytest.mark.parametrize("seed", range(5))
def test_positions_that_are_truly_close_in_time_keep_their_stamps(seed: int) -> None:
    """A position measured 2 ms after another one lies where that one does."""
    rng = np.random.default_rng(seed)
    t = np.sort(np.concatenate([np.arange(0.0, 60.0, 0.2), np.arange(0.002, 60.0, 0.2)]))
    place = 0.5 * t + rng.normal(0.0, 0.005, len(t)) + 0j
    stamps = np.round(t * 1e9).astype(np.int64)
    for measured in (True, False):
        assert spread_positions(stamps, place, measured=measured).stamp_ns is stamps


@pytest.mark.parametrize("far", ["[52.0, -10.0]", "[11.6, 48.1]"])
def test_a_datum_far_from_the_fixes_is_named_and_not_taken(tmp_path: Path, far: str) -> None:
    """Also where latitude and longitude are exchanged."""
    run = run_of(tmp_path / "log.mcap", fixes(DRIVE), sets=(f"frames.datum={far}",))
    assert shows_the_icrs(run)
    assert run.document.gnss.datum is not None
    assert run.document.gnss.datum[:2] == pytest.approx((48.1, 11.6), abs=0.01)
    (named,) = (one.text for one in run.notes if one.code == "datum_far")
    assert "km from the fixes (48.10" in named
    assert "heading_offset_corrected" not in [one.code for one in run.notes]


def test_a_datum_in_the_neighbourhood_is_taken(tmp_path: Path) -> None:
    path = write_messages(tmp_path / "log.mcap", joint_states(DRIVE), imus(DRIVE), fixes(DRIVE))
    log = read_log(path, load_config(sets=(*ROBOT, "frames.datum=[48.0, 11.5]")))
    assert log.datum is not None
    assert (log.datum.latitude_deg, log.datum.longitude_deg) == (48.0, 11.5)
    assert not [one for one in log.notes if one.code == "datum_far"]
