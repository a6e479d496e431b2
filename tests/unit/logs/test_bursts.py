"""Wheel samples that arrive several at a time, of drives whose wheels are known."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.kernels.arrays import Ints
from icrtool.logs.read_log import read_log
from icrtool.logs.streams.bursts import spread_bursts
from icrtool.pipeline import fit
from support.drives import ICRS
from support.field_logs import ROBOT, WIDTH_M, Drive, Message, fixes, imus, joint_states, made, make_drive, numbers
from support.field_logs import write_messages as write

MS = 1_000_000


def packets(stamp_ns: Ints, samples: int, apart_ns: int) -> Ints:
    """Return when samples arrive that are passed on so many at a time, `apart_ns` after one another."""
    row = np.arange(len(stamp_ns))
    last = np.minimum(row // samples * samples + samples - 1, len(stamp_ns) - 1)
    return np.asarray(stamp_ns[last] - (last - row) * apart_ns)


def headless(drive: Drive, arrival_ns: Ints) -> Iterator[Message]:
    """Yield joint states whose header stamps are 0."""
    for one, log_ns in zip(joint_states(drive), arrival_ns.tolist(), strict=True):
        one.content.header.stamp = made("builtin_interfaces/msg/Time")
        yield one._replace(log_ns=log_ns)


@pytest.mark.parametrize(("samples", "apart_ns"), [(2, MS // 5), (4, MS // 10), (10, 0)])
def test_stamps_of_packets_are_spread_as_they_were_measured(samples: int, apart_ns: int) -> None:
    stamps = make_drive(20.0, 50.0).stamp_ns
    found = spread_bursts(packets(stamps, samples, apart_ns))
    assert found.samples == samples
    np.testing.assert_allclose(found.stamp_ns, stamps, rtol=0, atol=MS / 2)
    assert f"in bursts of {samples}, {samples * 20} ms apart" in found.sentence("samples")


def test_a_gap_between_packets_stays_a_gap() -> None:
    stamps = make_drive(20.0, 50.0).stamp_ns
    stamps = np.concatenate([stamps[:400], stamps[600:]])
    found = spread_bursts(packets(stamps, 4, MS // 10)).stamp_ns
    assert np.diff(found).max() > 3900 * MS
    np.testing.assert_allclose(found[404:], stamps[404:], rtol=0, atol=MS / 2)


@pytest.mark.parametrize("jitter_s", [0.0, 0.004, 0.008])
def test_stamps_that_jitter_are_no_bursts(jitter_s: float) -> None:
    stamps = make_drive(60.0, 50.0).stamp_ns + np.random.default_rng(1).normal(0, jitter_s * 1e9, 3000).astype(int)
    found = spread_bursts(stamps)
    if jitter_s < 0.008:
        assert found.samples == 0
        assert found.stamp_ns is stamps
    # stamps are moved by no more than they jitter
    assert np.abs(found.stamp_ns - stamps).max() < 30 * MS


@pytest.mark.parametrize(
    ("kind", "samples", "apart_ns"),
    [
        ("speeds", 2, MS // 5), ("speeds", 3, 0), ("counts", 5, MS // 10), ("counts", 3, 0), ("joints", 2, MS // 5),
        ("joints", 5, MS // 10),
    ],
)  # fmt: skip
def test_wheels_in_bursts_show_the_icrs(tmp_path: Path, kind: str, samples: int, apart_ns: int) -> None:
    drive = make_drive(80.0, 25.0)
    arrival_ns, settings = packets(drive.stamp_ns, samples, apart_ns), list(ROBOT)
    if kind == "joints":
        wheels = [headless(drive, arrival_ns)]
    elif kind == "speeds":
        sides = (("left", drive.left_radps), ("right", drive.right_radps))
        wheels = [numbers(f"/{side}_wheel_speed", "Float32", arrival_ns, values) for side, values in sides]
    else:
        settings.append("robot.encoder_counts_per_rev=8192")
        sides = (("left", drive.left), ("right", drive.right))
        counts = ((side, np.round(angle * 8192 / (2 * np.pi)).astype(int)) for side, angle in sides)
        wheels = [numbers(f"/{side}_encoder", "Int32", arrival_ns, values) for side, values in counts]
    path = write(tmp_path / "bursts.mcap", *wheels, fixes(drive, every=5), imus(drive))
    config = load_config(sets=settings)
    log = read_log(path, config)
    assert any(f"wheel samples arrive in bursts of {samples}" in one for one in log.warnings)
    assert not any("share a stamp" in one for one in log.warnings)
    run = fit(log, config)
    multiplier = run.document.controller
    assert run.usable
    assert multiplier is not None
    assert multiplier.multiplier == pytest.approx((ICRS[0] - ICRS[1]) / WIDTH_M, abs=0.03)
    path_m = float(np.hypot(np.diff(drive.north), np.diff(drive.east)).sum())
    # the first seconds, until fix and heading were seen, are no part of the run
    assert 0.97 * path_m < run.document.drive.distance_m < 1.005 * path_m


def test_messages_recorded_twice_are_no_bursts(tmp_path: Path) -> None:
    drive = make_drive(30.0, 25.0)
    twice = [one for one in joint_states(drive) for _ in range(2)]
    path = write(tmp_path / "twice.mcap", iter(twice), fixes(drive, every=5), imus(drive))
    log = read_log(path, load_config(sets=ROBOT))
    assert not any("bursts" in one for one in log.warnings)
    assert len(log.wheels.stamp_ns) == len(drive.stamp_ns)
