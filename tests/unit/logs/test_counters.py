"""Counters and angles that begin again are counted on, whatever the modulus; speeds and growing counters are not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import icrtool
from icrtool.config import load_config
from icrtool.logs.read_log import read_log
from icrtool.logs.streams.counters import find_modulus, unwrap_counter
from support.field_logs import ROBOT, Drive, Message, make_drive, numbers, reference, write_messages

DRIVE = make_drive(60.0)


def wrapped(values: Any, modulus: float, low: float = 0.0) -> Any:
    return np.mod(values - low, modulus) + low


@pytest.mark.parametrize("modulus", [256, 1000, 1440, 4096, 9000, 10_000, 16_384, 65_536])
@pytest.mark.parametrize("signed", [False, True])
def test_the_modulus_of_counters_is_in_the_numbers(modulus: int, signed: bool) -> None:
    """Two sides at different speeds, backwards too; each passes the modulus some times."""
    sides = [np.floor(side * modulus / 11.0).astype(np.int64) for side in (DRIVE.left, -DRIVE.right)]
    low = -(modulus // 2) if signed else 0
    recorded = [wrapped(side, modulus, low).astype(np.int64) for side in sides]
    found = find_modulus(recorded)
    assert found is not None
    assert found.value == modulus
    for side, column in zip(sides, recorded, strict=True):
        np.testing.assert_array_equal(np.diff(unwrap_counter(column, found.value)), np.diff(side))


@pytest.mark.parametrize("modulus", [2377, 51_234])
def test_a_modulus_that_is_not_round_is_found_to_within_a_step(modulus: int) -> None:
    counts = np.floor(DRIVE.left * modulus / 9.0).astype(np.int64)
    found = find_modulus([np.mod(counts, modulus)])
    assert found is not None
    assert abs(found.value - modulus) < np.abs(np.diff(counts)).max()


@pytest.mark.parametrize(("turn", "low"), [(360.0, 0.0), (360.0, -180.0), (2 * np.pi, 0.0), (2 * np.pi, -np.pi)])
def test_angles_that_begin_again_after_a_turn_are_known(turn: float, low: float) -> None:
    angle = DRIVE.left * turn / (2 * np.pi)
    found = find_modulus([wrapped(angle, turn, low)])
    assert found is not None
    assert found.value == turn
    np.testing.assert_allclose(np.diff(unwrap_counter(wrapped(angle, turn, low), turn)), np.diff(angle), atol=1e-9)


NO_COUNTERS = {
    "a growing counter": np.arange(2000) * 37,
    "a counter set to 0 once": np.concatenate([np.arange(900) * 37, np.arange(900) * 37]),
    "speeds forward and back": np.round(100 * np.sin(np.arange(2000) / 50.0)).astype(int),
    "speeds that are on or off": np.repeat(np.tile([0, 100], 20), 30),
    "speeds of both signs": np.repeat(np.tile([-100, 100], 20), 30),
    "noise": np.random.default_rng(1).integers(-50, 50, 2000),
    "a single spike": np.where(np.arange(2000) == 900, 5000, np.arange(2000) // 10),
    "a turn of noise": np.random.default_rng(1).uniform(0.0, 2 * np.pi, 2000),
    "no motion": np.zeros(500, int),
}


@pytest.mark.parametrize("values", NO_COUNTERS.values(), ids=NO_COUNTERS)
def test_other_numbers_have_no_modulus(values: Any) -> None:
    assert find_modulus([values]) is None


def pair(drive: Drive, kind: str, left: Any, right: Any) -> list[Any]:
    return [
        numbers(f"/{side}_encoder", kind, drive.stamp_ns, values) for side, values in (("left", left), ("right", right))
    ]


@pytest.mark.parametrize(
    ("kind", "modulus", "per_rad"),
    [
        ("Int64", 4096, 652.0),
        ("Int32", 9000, 700.0),
        ("UInt8", 256, 30.0),
        ("Int8", 256, 30.0),
        ("UInt16", 10_000, 1500.0),
    ],
)
def test_a_pair_of_topics_with_wrapping_counters_gives_the_speeds_of_the_wheels(
    tmp_path: Path, kind: str, modulus: int, per_rad: float
) -> None:
    low = -128 if kind == "Int8" else 0
    left, right = (
        wrapped(np.floor(side * per_rad), modulus, low).astype(np.int64) for side in (DRIVE.left, DRIVE.right)
    )
    path = write_messages(tmp_path / "log.mcap", *pair(DRIVE, kind, left, right), reference(DRIVE))
    log = read_log(path, load_config(sets=ROBOT))
    step = 1.0 / per_rad / np.diff(DRIVE.stamp_ns[:2])[0] * 1e9
    np.testing.assert_allclose(log.wheels.left[:-1] / per_rad, DRIVE.left_radps[:-1], atol=step)
    np.testing.assert_allclose(log.wheels.right[:-1] / per_rad, DRIVE.right_radps[:-1], atol=step)
    assert any(f"begin again at {modulus}" in one for one in log.warnings)


@pytest.mark.parametrize("turn", [360.0, 2 * np.pi])
def test_a_pair_of_topics_with_angles_within_a_turn_is_in_radians(tmp_path: Path, turn: float) -> None:
    left, right = (wrapped(side * turn / (2 * np.pi), turn) for side in (DRIVE.left, DRIVE.right))
    path = write_messages(tmp_path / "log.mcap", *pair(DRIVE, "Float64", left, right), reference(DRIVE))
    log = read_log(path, load_config(sets=ROBOT))
    assert log.wheels.unit == "rad"
    np.testing.assert_allclose(log.wheels.left[:-1], DRIVE.left_radps[:-1], rtol=1e-6)


def test_lamps_of_both_sides_are_no_wheels(tmp_path: Path) -> None:
    def lamps() -> list[Message]:
        on = np.arange(len(DRIVE.stamp_ns)) % 256
        return [one for side in ("left", "right") for one in numbers(f"/{side}_lamp", "UInt8", DRIVE.stamp_ns, on)]

    path = write_messages(tmp_path / "log.mcap", iter(lamps()), reference(DRIVE))
    with pytest.raises(icrtool.IcrToolError, match="no wheels found"):
        read_log(path, load_config(sets=ROBOT))


def test_the_shared_log_of_counts_modulo_4096_gives_the_true_icrs(shared_logs: Path) -> None:
    """Truth: right +0.520, left -0.500, x +0.060 m."""
    config = load_config(sets=(*ROBOT, "robot.encoder_counts_per_rev=4096"))
    run = icrtool.fit(read_log(shared_logs / "reports" / "08_counts_modulo_4096.mcap", config), config)
    final = run.summary["icr"]["final"]
    found = [final[name] for name in ("y_icr_right_m", "y_icr_left_m", "x_icr_m")]
    np.testing.assert_allclose(found, [0.52, -0.5, 0.06], atol=0.03)
