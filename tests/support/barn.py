"""A small drive with constant ICRs, noise, an outage, a gap in the wheel data and a few bad fixes."""

from __future__ import annotations

import numpy as np

from icrtool.config import Config, parse_config
from icrtool.records.notes import note
from icrtool.records.samples import Datum, HeadingSamples, InputFile, PositionFixes, StreamChoice, WheelSamples
from icrtool.records.tables import RobotLog

RATE_HZ = 50
START_NS = 1_760_000_000_000_000_000
TRACK_WIDTH_M = 0.6
ICRS_M = (0.72, -0.68, 0.08)

OUTAGE_S = (30.0, 36.0)
GAP_S = (45.0, 47.0)
BAD_FIXES = 4


def simulate(
    *,
    duration_s: float = 60.0,
    speed_mps: float = 0.8,
    turn_mps: float = 0.25,
    datum: bool = True,
    troubles: bool = True,
) -> RobotLog:
    rng = np.random.default_rng(7)
    n = int(duration_s * RATE_HZ)
    t, dt = np.arange(n) / RATE_HZ, 1 / RATE_HZ
    turn = turn_mps * np.sin(2 * np.pi * t / 20) * (speed_mps > 0)
    v_left, v_right = speed_mps + turn, speed_mps - turn
    y_right, y_left, x = ICRS_M
    omega = (v_left - v_right) / (y_right - y_left)
    ahead, aside = (v_left * y_right - v_right * y_left) / (y_right - y_left), -omega * x
    psi = 0.4 + np.concatenate([[0.0], np.cumsum(omega[:-1] * dt)])
    north = np.concatenate([[0.0], np.cumsum((ahead * np.cos(psi) - aside * np.sin(psi))[:-1] * dt)])
    east = np.concatenate([[0.0], np.cumsum((ahead * np.sin(psi) + aside * np.cos(psi))[:-1] * dt)])
    stamps = START_NS + np.arange(n, dtype=np.int64) * (1_000_000_000 // RATE_HZ)

    fix = np.arange(0, n, 5)
    z_north, z_east = (column[fix] + 0.01 * rng.standard_normal(len(fix)) for column in (north, east))
    wheel = np.ones(n, np.bool_)
    if troubles:
        bad = rng.choice(np.flatnonzero(t[fix] > 10), BAD_FIXES, replace=False)
        z_north[bad] += 5.0
        seen = ~((t[fix] >= OUTAGE_S[0]) & (t[fix] < OUTAGE_S[1]))
        fix, z_north, z_east = fix[seen], z_north[seen], z_east[seen]
        wheel = ~((t >= GAP_S[0]) & (t < GAP_S[1]))
    known = np.full(len(fix), 1e-4)
    heading = np.angle(np.exp(1j * (psi + 0.017 * rng.standard_normal(n))))
    streams = (
        StreamChoice("wheels", "/joint_states", "sensor_msgs/msg/JointState", n, 50.0, "header", 0.1, "the only one"),
        StreamChoice("gnss", "/fix", "sensor_msgs/msg/NavSatFix", len(fix), 10.0, "header", 0.1, "the only one"),
        StreamChoice("heading", "/imu/data", "sensor_msgs/msg/Imu", n, 50.0, "log", 0.1, "the only one"),
    )
    return RobotLog(
        name="barn",
        wheels=WheelSamples(stamps[wheel], v_left[wheel], v_right[wheel]),
        gnss=PositionFixes(stamps[fix], z_north, z_east, known, known, np.zeros(len(fix))),
        heading=HeadingSamples(stamps, heading, np.full(n, 0.017**2)),
        datum=Datum(40.79, -77.86, 350.0) if datum else None,
        streams=streams,
        inputs=(InputFile("barn.mcap", 12, "ab" * 32),),
        rejected_fixes={"no fix": 3} if troubles else {},
        notes=(note("log_damaged", "a warning of the log", "barn"),),
    )


def configured(track_width_m: float | None = TRACK_WIDTH_M) -> Config:
    return parse_config({"robot": {"name": "segway-rmp400", "track_width_m": track_width_m}})
