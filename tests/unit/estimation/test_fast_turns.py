"""Fast turns, slow wheel samples with gaps, and a gyro as the only heading: usable, as the wheels explain the turns."""

from __future__ import annotations

import math

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.estimation.run_warnings import LARGEST_TURN_UNEXPLAINED
from icrtool.kernels.kinematics import drive, poses_at
from icrtool.pipeline import fit
from icrtool.records.run import Run
from icrtool.records.samples import NO_HEADINGS, GyroAxes, PositionFixes, StreamChoice, WheelSamples
from icrtool.records.tables import RobotLog

EPOCH_NS = 1_760_000_000_000_000_000
ICRS, WIDTH_M = (0.42, -0.45, 0.05), 0.5
CONFIG = load_config(sets=[f"robot.track_width_m={WIDTH_M}"])


def fast_log(seed: int, *, vary: float, seconds: float = 240.0) -> RobotLog:
    """Return a drive with turns of 30 to 150 deg/s; encoders at 5 Hz with gaps, a gyro, fixes of 1.5 cm.

    Parameters
    ----------
    vary : by how much of it a side goes further than its encoder counts, differently every 0.4 s (rms)
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.01)
    # turns of 1 to 4 s, each with a rate of its own, and straight driving in between
    edges = np.concatenate([[0.0], np.cumsum(rng.uniform(1.0, 4.0, 200))])
    rates = np.radians(rng.uniform(30.0, 150.0, 200)) * rng.choice([-1.0, 1.0], 200) * (rng.random(200) < 0.7)
    turn = rates[np.searchsorted(edges, t, side="right") - 1]
    kernel = np.ones(40) / 40.0
    turn = np.convolve(turn, kernel, mode="same")
    mean = np.convolve(0.9 * (rng.random(200)[np.searchsorted(edges, t, side="right") - 1] > 0.25), kernel, mode="same")
    left, right = mean - ICRS[1] * turn, mean - ICRS[0] * turn
    icrs, which = np.array([ICRS]), np.zeros(len(t), np.int64)
    start = np.array([5.0, -3.0, 0.4])
    pose = drive(t, left, right, icrs, which, start)
    knots = np.arange(0.0, seconds + 0.4, 0.4)
    counted = [side * (1.0 + vary * np.interp(t, knots, rng.normal(size=len(knots)))) for side in (left, right)]
    travelled = [np.concatenate([[0.0], np.cumsum(side[:-1] * 0.01)]) for side in counted]
    wheel_t = np.arange(0.0, seconds - 0.5, 0.2) + rng.uniform(-0.02, 0.02, round((seconds - 0.5) / 0.2))
    gaps = rng.uniform(10.0, seconds - 10.0, 12)
    kept = np.logical_and.reduce([(wheel_t < gap) | (wheel_t > gap + 1.2) for gap in gaps])
    wheel_t = np.maximum(wheel_t[kept], 0.0)
    at_wheels = [np.interp(wheel_t, t, one) for one in travelled]
    speeds = [np.append(np.diff(one) / np.diff(wheel_t), 0.0) for one in at_wheels]
    fix_t = np.arange(0.0, seconds - 0.5, 0.1)
    there = poses_at(fix_t, t, left, right, icrs, which, pose)[:, :2] + rng.normal(0.0, 0.015, (len(fix_t), 2))
    zero, variance = np.zeros(len(t)), np.full(len(fix_t), 0.015**2)
    rate = turn + rng.normal(0.0, 0.01, len(t)) + 0.004

    def stamps(times: np.ndarray) -> np.ndarray:
        return EPOCH_NS + np.round(times * 1e9).astype(np.int64)

    streams = tuple(
        StreamChoice(role, topic, "x/Y", 100, 5.0, "header", 0.0, "made in a test")
        for role, topic in (("wheels", "/encoders"), ("gnss", "/ppk"))
    )
    gyro = GyroAxes("/imu", stamps(t), np.column_stack([zero, zero, -rate]))
    return RobotLog(
        "fast", WheelSamples(stamps(wheel_t), *speeds, "m", from_position=True),
        PositionFixes(stamps(fix_t), *there.T, variance, variance.copy(), np.zeros(len(fix_t))),
        NO_HEADINGS, None, streams, (), {}, (), gyros=(gyro,),
    )  # fmt: skip


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_fast_turns_that_the_wheels_explain_are_usable(seed: int) -> None:
    run = fit(fast_log(seed, vary=0.04), CONFIG)
    wheels = run.document.wheels
    assert wheels.turn_unexplained is not None
    assert wheels.turn_unexplained_std is not None
    # R^2 about 0.996, as in the recording
    assert 0.0005 < wheels.turn_unexplained < 0.03
    assert wheels.turn_unexplained + 4.0 * wheels.turn_unexplained_std < LARGEST_TURN_UNEXPLAINED
    assert run.usable, run.summary["unusable_because"]
    value, std = multiplier_of(run)
    assert abs(value - (ICRS[0] - ICRS[1]) / WIDTH_M) < 3.0 * std
    final, deviation = run.summary["icr"]["final"], run.summary["icr"]["final_std"]
    for name, true in zip(("y_icr_right_m", "y_icr_left_m"), ICRS, strict=False):
        if final[name] is not None:
            assert abs(final[name] - true) < 3.0 * deviation[name]


def test_wheels_that_explain_nothing_are_refused_by_the_share_that_they_leave() -> None:
    run = fit(fast_log(3, vary=0.9), CONFIG)
    assert not run.usable
    assert run.document.wheels.turn_unexplained is not None
    assert run.document.wheels.turn_unexplained > 0.2


def multiplier_of(run: Run) -> tuple[float, float]:
    icr = run.summary["icr"]
    assert icr["separation_multiplier"] is not None
    assert math.isfinite(icr["separation_multiplier_std"])
    return icr["separation_multiplier"], icr["separation_multiplier_std"]
