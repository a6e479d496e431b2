"""Robot logs made in memory: a kinematic drive with known ICRs and the paper's sensors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from icrtool.records.samples import HeadingSamples, PositionFixes, StreamChoice, WheelSamples
from icrtool.records.tables import RobotLog
from support.matrix_filter import drive_states

EPOCH_NS = 1_760_000_000_000_000_000
ICRS = (0.5, -0.6, 0.1)


def make_log(
    seed: int = 0,
    seconds: float = 60.0,
    icrs: tuple[float, float, float] = ICRS,
    *,
    gnss_std: float = 0.01,
    heading_offset_deg: float = 0.0,
    lever: tuple[float, float] = (0.0, 0.0),
    rate: float = 50.0,
    faster: float = 1.0,
    step_heading: float = 0.5,
    heading_std_deg: float = 1.0,
) -> RobotLog:
    """Drive curves for some seconds, or (``step_heading=0``) by Euler steps; return what the sensors said."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / rate)
    v_left, v_right = 0.5 + 0.25 * np.sin(0.5 * t), 0.5 + 0.25 * np.sin(0.31 * t + 1.0)
    v_left, v_right = faster * v_left, faster * v_right
    x = drive_states(np.array([10.0, -5.0, 0.3, *icrs]), v_left, v_right, 1.0 / rate, step_heading)
    stamps = EPOCH_NS + np.round(t * 1e9).astype(np.int64)
    every = max(int(rate / 20), 1)
    psi = x[::every, 2]
    north = x[::every, 0] + lever[0] * np.cos(psi) - lever[1] * np.sin(psi)
    east = x[::every, 1] + lever[0] * np.sin(psi) + lever[1] * np.cos(psi)
    m = len(psi)
    variance = np.full(m, gnss_std**2)
    heading = x[:, 2] + math.radians(heading_offset_deg) + rng.normal(0, math.radians(heading_std_deg), len(t))
    stream = StreamChoice("wheels", "/x", "x/Y", len(t), rate, "header", 0.0, "made in a test")
    return RobotLog(
        "made",
        WheelSamples(stamps, v_left, v_right),
        PositionFixes(
            stamps[::every], north + rng.normal(0, gnss_std, m), east + rng.normal(0, gnss_std, m),
            variance, variance.copy(), np.zeros(m),
        ),
        HeadingSamples(stamps, np.angle(np.exp(1j * heading)), np.full(len(t), math.radians(1) ** 2)),
        None,
        (stream,),
        (),
        {},
        (),
    )  # fmt: skip


def make_pose_log(
    seed: int,
    std_m: float,
    std_deg: float,
    icrs: tuple[float, float, float] = (0.101, -0.101, 0.0),
    *,
    seconds: float = 160.0,
    wheels_vary: float = 0.0,
) -> RobotLog:
    """Drive a robot of 20 cm at 0.1 m/s under a pose reference with white noise that it does not state.

    Each side goes further or less far than its encoders report by `wheels_vary` of it (rms), differently every 5 s.
    """
    rng = np.random.default_rng([seed, 9])
    log = make_log(seed, seconds, icrs, gnss_std=std_m, rate=20.0, faster=0.2, heading_std_deg=0.0)
    count, t = len(log.gnss.stamp_ns), (log.wheels.stamp_ns - EPOCH_NS) / 1e9
    knots, unknown = np.arange(0.0, seconds + 5.0, 5.0), np.full(count, np.nan)
    left, right = (1.0 + wheels_vary * np.interp(t, knots, rng.normal(size=len(knots))) for _ in range(2))
    heading = log.heading.heading_rad + rng.normal(0, math.radians(std_deg), count)
    return replace(
        log,
        wheels=replace(log.wheels, left=log.wheels.v_left_mps * left, right=log.wheels.v_right_mps * right),
        gnss=replace(log.gnss, var_north_m2=unknown, var_east_m2=unknown, cov_north_east_m2=unknown),
        heading=HeadingSamples(log.heading.stamp_ns, np.angle(np.exp(1j * heading)), unknown),
        streams=tuple(
            StreamChoice(role, topic, "x/Y", count, 20.0, "header", 0.0, "made in a test")
            for role, topic in (("wheels", "/x"), ("gnss", "/pose"), ("heading", "/pose"))
        ),
    )
