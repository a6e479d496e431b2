"""Kinematic drives with slip that is known, or with a position reference that errs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.records.measurements import Fixes, LogFacts, SensorData
from icrtool.records.samples import GyroSamples, HeadingSamples, WheelSamples

START_NS = 1_760_000_000_000_000_000
RATE_HZ, SECONDS, WIDTH_M = 40, 120.0, 0.6
Y_RIGHT, Y_LEFT, X = 0.55, -0.5, 0.1
Slip = Callable[[Floats], Floats]
"""Shares missed by left and right, and speed sideways [m/s], at times (n,): (3, n)."""


def no_slip(t: Floats) -> Floats:
    return np.zeros((3, len(t)))


def curves(t: Floats, seed: int) -> Floats:
    """Speeds of left and right (2, n) [m/s]."""
    return np.array([
        0.5 + 0.25 * np.sin(0.5 * t) + 0.05 * np.sin(1.3 * t + seed), 0.5 + 0.2 * np.sin(0.31 * t + 1.0)
    ])  # fmt: skip


def drive(
    slip: Slip = no_slip, *, wheels: Callable[[Floats, int], Floats] = curves, seed: int = 0, fix_hz: int = 20,
    fix_std_m: float = 0.01, gyro: bool = True, position_error: Callable[[Floats], Floats] | None = None,
) -> SensorData:  # fmt: skip
    """Drive curves with sensors as in Pentzer 2014, Section 4; `position_error` gives north errors [m]."""
    rng = np.random.default_rng(seed)
    n = int(SECONDS * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    left, right = wheels(t, seed)
    share_left, share_right, aside = slip(t)
    true_left, true_right = (1 - share_left) * left, (1 - share_right) * right
    omega = (true_left - true_right) / (Y_RIGHT - Y_LEFT)
    ahead = (true_left * Y_RIGHT - true_right * Y_LEFT) / (Y_RIGHT - Y_LEFT)
    psi = np.concatenate([[0.4], 0.4 + np.cumsum(omega)[:-1] / RATE_HZ])
    step = (ahead + 1j * (aside - omega * X)) * np.exp(1j * (psi + omega / RATE_HZ / 2)) / RATE_HZ
    place = np.concatenate([[0.0], np.cumsum(step)[:-1]])
    stamps = START_NS + np.rint(t * 1e9).astype(np.int64)
    rows = np.arange(0, n, RATE_HZ // fix_hz)
    m = len(rows)
    wrong = position_error(t[rows]) if position_error is not None else np.zeros(m)
    none = np.zeros(m, np.bool_)
    variance = np.full(m, fix_std_m**2)
    return SensorData(
        name="made",
        wheels=WheelSamples(stamps, left, right),
        fixes=Fixes(
            stamps[rows], place.real[rows] + wrong + rng.normal(0, fix_std_m, m),
            place.imag[rows] + rng.normal(0, fix_std_m, m), variance, variance.copy(), np.zeros(m, np.uint8),
            none, none,
        ),
        headings=HeadingSamples(
            stamps, np.angle(np.exp(1j * (psi + rng.normal(0, 0.009, n)))), np.full(n, np.radians(1) ** 2)
        ),
        gyro=GyroSamples("/imu", stamps, omega + rng.normal(0, 0.003, n)) if gyro else None,
        facts=LogFacts(heading_from_position=False, heading_correlation_s=0.0, antenna_m=(0.0, 0.0)),
        losses_ns=np.empty((0, 2), np.int64),
    )  # fmt: skip
