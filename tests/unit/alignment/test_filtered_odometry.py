"""Odometry of a filter in place of wheels: low-passed, or pulled back to a heading; wheels that slip are none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.kernels.arrays import Floats
from icrtool.pipeline import fit
from icrtool.records.samples import Datum, HeadingSamples, PositionFixes, StreamChoice, WheelSamples
from icrtool.records.tables import RobotLog
from support.drives import EPOCH_NS
from support.matrix_filter import drive_states
from support.recordings import first_order

WIDTH_M, ICRS, RATE_HZ, SECONDS = 0.8, (0.7, -0.7, 0.05), 25.0, 300.0
CONFIG = load_config(sets=[f"robot.track_width_m={WIDTH_M}"])


def low_passed(x: Floats, tau_s: float) -> Floats:
    a = 1.0 / (RATE_HZ * tau_s + 1.0)
    return first_order(1.0 - a, a * x)


def log_of(seed: int, odometry: str, tau_s: float = 1.0) -> RobotLog:
    """Drive winding circles; the wheels' turn comes as they measure it, low-passed, fused or slipping."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, SECONDS, 1.0 / RATE_HZ)
    periods = (3.7, 6.1, 11.0, 23.0)
    apart = 0.25 + sum(rng.uniform(0.1, 0.35) * np.sin(2 * np.pi * t / p + rng.uniform(0.0, 6.0)) for p in periods)
    v = 0.6 + 0.2 * np.sin(0.11 * t)
    states = drive_states(np.array([0.0, 0.0, 0.0, *ICRS]), v + apart / 2, v - apart / 2, 1.0 / RATE_HZ, 0.5)
    turn, true = apart / WIDTH_M, np.append(np.diff(states[:, 2]) * RATE_HZ, 0.0)
    if odometry == "low-passed":
        turn, v = low_passed(turn, tau_s), low_passed(v, tau_s)
    elif odometry == "low-passed gyro":
        turn = low_passed(true, tau_s)
    elif odometry == "fused":
        # wheels at once, the heading in the long run
        angle, wheels = np.cumsum(true), np.cumsum(turn)
        turn = np.diff(low_passed(angle, tau_s) + wheels - low_passed(wheels, tau_s), prepend=0.0)
    elif odometry == "slipping":
        turn = turn + 0.5 * np.repeat(rng.normal(size=len(t) // 12), 12)[: len(t)]
    elif odometry == "late":
        turn, v = (np.interp(t - tau_s, t, one) for one in (turn, v))
    stamps, rows = EPOCH_NS + np.round(t * 1e9).astype(np.int64), slice(None, None, 3)
    count = len(stamps[rows])
    variance = np.full(count, 0.01**2)
    north_east = states[rows, :2].T + rng.normal(0.0, 0.01, (2, count))
    heading = states[:, 2] + rng.normal(0.0, math.radians(1.0), len(t))
    log = RobotLog(
        "made",
        WheelSamples(stamps, v + turn * WIDTH_M / 2, v - turn * WIDTH_M / 2),
        PositionFixes(stamps[rows], *north_east, variance, variance.copy(), np.zeros(count)),
        HeadingSamples(stamps, np.angle(np.exp(1j * heading)), np.full(len(t), math.radians(1.0) ** 2)),
        None,
        tuple(
            StreamChoice(role, topic, "x/Y", count, 1.0, "header", 0.0, "made in a test")
            for role, topic in (("wheels", "/odometry"), ("gnss", "/fix"), ("heading", "/imu"))
        ),
        (), {}, (),
    )  # fmt: skip
    return replace(log, datum=Datum(40.8, -77.9, 350.0))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("odometry", "tau_s"), [("low-passed", 1.0), ("low-passed", 2.0), ("low-passed gyro", 1.0), ("fused", 2.0)]
)
def test_filtered_odometry_is_named_and_its_icrs_are_not_used(seed: int, odometry: str, tau_s: float) -> None:
    run = fit(log_of(seed, odometry, tau_s), CONFIG)
    assert not run.usable
    assert "wheel speeds are needed" in str(run.summary["unusable_because"])
    assert not any("track_width_m" in warning for warning in run.warnings)


@pytest.mark.parametrize("odometry", ["as measured", "slipping", "late"])
def test_wheels_that_are_measured_are_not_named_filtered(odometry: str) -> None:
    for seed in range(3):
        run = fit(log_of(seed, odometry, 0.4), CONFIG)
        assert "filtered" not in str(run.summary["unusable_because"])
