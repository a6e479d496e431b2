"""Drives of known ICRs with rare fixes and the gyro of a usual MEMS, and no heading."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Complexes, Floats
from icrtool.records.samples import (
    NO_HEADINGS,
    Datum,
    GyroAxes,
    GyroSamples,
    PositionFixes,
    StreamChoice,
    WheelSamples,
)
from icrtool.records.tables import RobotLog

START_NS, RATE_HZ = 1_760_000_000_000_000_000, 50
GYRO_NOISE_RADPS, GYRO_BIAS_RADPS, GYRO_WALK = math.radians(0.07), math.radians(0.3), math.radians(0.002)
"""Noise of a sample at 50 Hz and standard deviation of the bias of a MEMS gyro [rad/s]; random walk of its bias
[rad/s/sqrt(s)]."""

SLIP, SLIP_TIME_S = 0.02, 3.0
"""Share of each side's travel that is lost or gained at random, and correlation time of this share [s]."""


class TrueDrive(NamedTuple):
    """A log and the truth about it.

    Attributes
    ----------
    icrs_m : y right, y left, x; width_m : track width b of the robot
    heading_rad, place_m : (n,) at the wheel samples; the place is north + j east
    """

    log: RobotLog
    icrs_m: tuple[float, float, float]
    width_m: float
    heading_rad: Floats
    place_m: Complexes


def _smooth(t: Floats, time_s: float, rng: np.random.Generator) -> Floats:
    """Return a random function of time (n,) of size 1 (rms) whose knots are `time_s` apart."""
    knots = np.arange(0.0, t[-1] + 2.0 * time_s, time_s)
    value = np.interp(t, knots, rng.normal(size=len(knots)))
    return np.asarray(value / max(float(np.sqrt(np.mean(value**2))), 1e-9))


def plan(path: str, t: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return speed ahead [m/s] and clockwise turn rate [rad/s] (n,) along a path: lawnmower, curved or free."""
    speed = float(rng.uniform(0.5, 1.1))
    if path == "lawnmower":
        leg_s, bend_s = float(rng.uniform(6.0, 15.0)) / speed, math.pi * float(rng.uniform(0.7, 1.5)) / speed
        into = t % (leg_s + bend_s)
        sense = np.where((t // (leg_s + bend_s)) % 2 == 0, 1.0, -1.0)
        return np.full(len(t), speed), np.where(into > leg_s, sense * math.pi / bend_s, 0.0)
    if path == "curved":
        period = float(rng.uniform(9.0, 25.0))
        return np.full(len(t), speed), 0.5 * speed * np.sin(2.0 * math.pi * t / period) + 0.1
    ahead = speed * np.clip(0.8 + 0.6 * _smooth(t, 6.0, rng), -0.5, 1.3)
    return ahead, 0.35 * _smooth(t, 4.0, rng)


def drive(
    path: str, interval_s: float, seed: int, *, seconds: float = 400.0, fix_std_m: float = 0.012,
    gyro: bool = True, stated: bool = True,
) -> TrueDrive:  # fmt: skip
    """Return a log and the truth about it.

    Parameters
    ----------
    interval_s : between fixes; stated : whether the fixes state their noise
    """
    rng = np.random.default_rng([seed, round(10 * interval_s), len(path)])
    width = float(rng.uniform(0.4, 0.9))
    factor = float(rng.uniform(1.2, 2.2))
    y_right, y_left = factor * width / 2 + float(rng.normal(0.0, 0.03)), -factor * width / 2
    x = float(rng.normal(0.0, 0.08))
    t = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    ahead, turn = plan(path, t, rng)
    left, right = ahead - y_left * turn, ahead - y_right * turn
    psi = float(rng.uniform(-3.0, 3.0)) + np.concatenate([[0.0], np.cumsum(turn)[:-1]]) / RATE_HZ
    step = (ahead - 1j * turn * x) * np.exp(1j * (psi + turn / RATE_HZ / 2)) / RATE_HZ
    place = np.concatenate([[0.0], np.cumsum(step)[:-1]])
    left, right = (side * (1.0 + SLIP * _smooth(t, SLIP_TIME_S, rng)) for side in (left, right))
    fix_t = np.arange(0.37, seconds - 0.5, interval_s)
    m = len(fix_t)
    north, east = (np.interp(fix_t, t, axis) + rng.normal(0.0, fix_std_m, m) for axis in (place.real, place.imag))
    variance = np.full(m, fix_std_m**2 if stated else math.nan)
    bias = rng.normal(0.0, GYRO_BIAS_RADPS) + GYRO_WALK * np.cumsum(rng.normal(size=len(t))) / math.sqrt(RATE_HZ)
    rate = (1.0 + rng.normal(0.0, 0.004)) * turn + bias + rng.normal(0.0, GYRO_NOISE_RADPS, len(t))
    stamps, fix_stamps = (START_NS + np.rint(one * 1e9).astype(np.int64) for one in (t, fix_t))
    axes = np.column_stack([rng.normal(0.0, GYRO_NOISE_RADPS, (len(t), 2)), -rate])
    log = RobotLog(
        f"{path} {interval_s:g} s {seed}",
        WheelSamples(stamps, left, right),
        PositionFixes(fix_stamps, north, east, variance, variance.copy(), np.zeros(m)),
        NO_HEADINGS,
        Datum(47.0, -71.0, 100.0),
        (
            StreamChoice("wheels", "/wheels", "x/Y", len(t), RATE_HZ, "header", 0.0, "made"),
            StreamChoice("gnss", "/fix", "x/Y", m, 1.0 / interval_s, "header", 0.0, "made"),
        ),
        (), {}, (), None,
        GyroSamples("/imu", stamps, rate) if gyro else None,
        (GyroAxes("/imu", stamps, axes),) if gyro else (),
        (),
    )  # fmt: skip
    return TrueDrive(log, (y_right, y_left, x), width, psi, place)
