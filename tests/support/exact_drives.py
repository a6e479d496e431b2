"""Drives on exact arcs with sensor noise, delays, scales and an antenna off the body origin."""

from __future__ import annotations

import math

import numpy as np

from icrtool.config import parse_config
from icrtool.kernels.kinematics import drive, poses_at
from icrtool.records.samples import HeadingSamples, PositionFixes, StreamChoice, WheelSamples
from icrtool.records.tables import RobotLog

EPOCH_NS = 1_760_000_000_000_000_000
ICRS = (0.52, -0.44, 0.1)
ROLES = ("wheels", "gnss", "heading")
CONFIG = parse_config({"robot": {"track_width_m": 0.6}})


def simulate(
    seed: int = 0, *, path: str = "varied", seconds: float = 240.0, lever: tuple[float, float] = (0.3, -0.15),
    offset_deg: float = 5.0, scales: tuple[float, float] = (1.03, 0.98), gnss_delay: float = 0.0,
    heading_delay: float = 0.0, heading_std_deg: float = 1.0,
) -> RobotLog:  # fmt: skip
    """Drive with stops, spins and bends (``varied``), on a circle, or straight; sensors as in the paper."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.02)
    if path == "varied":
        mean = np.clip(0.6 + 0.7 * np.sin(0.21 * t) + 0.4 * np.sin(0.67 * t + seed), -0.5, 1.2)
        turn = 0.5 * np.sin(0.33 * t) + 0.4 * np.sin(0.83 * t + 1.0)
    else:
        mean, turn = np.full(len(t), 0.5), np.full(len(t), 0.25 if path == "circle" else 0.0)
    y_right, y_left, _ = ICRS
    left, right = mean - y_left * turn, mean - y_right * turn
    icrs, which = np.array([ICRS]), np.zeros(len(t), np.int64)
    pose = drive(t, left, right, icrs, which, np.array([100.0, -40.0, 2.5]))

    def at(times: np.ndarray) -> np.ndarray:
        return poses_at(np.clip(times, 0, t[-1]), t, left, right, icrs, which, pose)

    fix_t, heading_t = np.arange(0.0, seconds - 0.1, 0.05), np.arange(0.0, seconds - 0.1, 0.01)
    there, psi = at(fix_t - gnss_delay), at(heading_t - heading_delay)[:, 2]
    c, s = np.cos(there[:, 2]), np.sin(there[:, 2])
    m, var = len(fix_t), np.full(len(fix_t), 1e-4)
    heading = psi + math.radians(offset_deg) + rng.normal(0, math.radians(heading_std_deg), len(psi))
    stamps, fix_ns, heading_ns = (EPOCH_NS + np.round(x * 1e9).astype(np.int64) for x in (t, fix_t, heading_t))
    return RobotLog(
        "made",
        WheelSamples(stamps, left / scales[0] + rng.normal(0, 0.01, len(t)), right / scales[1]),
        PositionFixes(
            fix_ns, there[:, 0] + lever[0] * c - lever[1] * s + rng.normal(0, 0.01, m),
            there[:, 1] + lever[0] * s + lever[1] * c + rng.normal(0, 0.01, m), var, var.copy(), np.zeros(m),
        ),
        HeadingSamples(heading_ns, np.angle(np.exp(1j * heading)), np.full(len(psi), math.radians(1) ** 2)),
        None,
        tuple(StreamChoice(role, f"/{role}", "x/Y", m, 20.0, "header", 0.0, "made") for role in ROLES),
        (),
        {},
        (),
    )  # fmt: skip
