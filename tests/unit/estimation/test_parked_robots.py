"""Shifts at 1 Hz with minutes of driving: delays and contradictions are those of the drives, not of the parking."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.pipeline import fit
from icrtool.records.run import Run
from icrtool.records.samples import Datum, HeadingSamples, PositionFixes, StreamChoice, WheelSamples
from icrtool.records.tables import RobotLog
from support.drives import EPOCH_NS
from support.matrix_filter import drive_states

TRUTH = (0.70, -0.70, -0.10)
DRIVEN_S, FINE_HZ = 600.0, 20.0
WIDTH = "robot.track_width_m=0.8"


@cache
def parked_log(early: int, shift_s: float) -> RobotLog:
    """Drive 10 min in the middle of each of three shifts; wheel positions come `early` samples of 1 s too early."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, DRIVEN_S + 0.5 / FINE_HZ, 1.0 / FINE_HZ)
    ramp = np.clip(np.minimum(t, t[-1] - t) / 2.0, 0.0, 1.0)
    v_left = ramp * (0.5 + 0.3 * np.sin(2 * np.pi * t / 13.0) + 0.2 * np.sin(2 * np.pi * t / 37.0))
    v_right = ramp * (0.5 + 0.3 * np.sin(2 * np.pi * t / 17.0 + 1.0) - 0.15 * np.sin(2 * np.pi * t / 29.0))
    x, wheels = np.array([10.0, -5.0, 0.3, *TRUTH]), np.zeros(2)
    times, states = [], []
    for shift in range(3):
        drive = drive_states(x, v_left, v_right, 1.0 / FINE_HZ, 0.5)
        turned = wheels + np.cumsum([[0.0, 0.0], *np.column_stack([v_left, v_right])[:-1] / FINE_HZ], axis=0)
        states.append(np.hstack([drive[:, :3], turned]))
        x, wheels = drive[-1], turned[-1]
        times.append((shift + 0.5) * shift_s + t)
    stamps_s = np.arange(0.0, 3.0 * shift_s)
    north, east, heading, left, right = (
        np.interp(stamps_s, np.concatenate(times), column) for column in np.concatenate(states).T
    )
    left, right = (np.append(one[early:], np.full(early, one[-1])) for one in (left, right))
    count = len(stamps_s)
    stamp_ns = EPOCH_NS + np.round(stamps_s * 1e9).astype(np.int64)
    variance = np.full(count, 0.01**2)
    heading = heading + rng.normal(0.0, math.radians(1.0), count)
    log = RobotLog(
        "parked",
        WheelSamples(stamp_ns, np.append(np.diff(left), 0.0), np.append(np.diff(right), 0.0), from_position=True),
        PositionFixes(
            stamp_ns, north + rng.normal(0.0, 0.01, count), east + rng.normal(0.0, 0.01, count),
            variance, variance.copy(), np.zeros(count),
        ),
        HeadingSamples(stamp_ns, np.angle(np.exp(1j * heading)), np.full(count, math.radians(1.0) ** 2)),
        None,
        tuple(
            StreamChoice(role, topic, "x/Y", count, 1.0, "header", 0.0, "made in a test")
            for role, topic in (("wheels", "/x"), ("gnss", "/fix"), ("heading", "/imu"))
        ),
        (), {}, (),
    )  # fmt: skip
    return replace(log, datum=Datum(40.8, -77.9, 350.0))


def run_of(early: int, shift_s: float, *sets: str) -> Run:
    return fit(parked_log(early, shift_s), load_config(sets=[WIDTH, *sets]))


@pytest.mark.parametrize("shift_s", [660.0, 28_800.0])
def test_wheels_a_sample_early_are_found_and_no_icr_is_confidently_wrong(shift_s: float) -> None:
    run = run_of(1, shift_s)
    delay = run.summary["alignment"]["heading_delay_s"]
    assert delay["value"] == pytest.approx(1.0, abs=0.1)
    assert delay["applied"] == pytest.approx(1.0, abs=0.1)
    icr = run.summary["icr"]
    for column, truth in zip(icr["final"], TRUTH, strict=True):
        value, std = icr["final"][column], icr["final_std"][column]
        assert value is None or std is None or abs(value - truth) < 3.0 * std


@pytest.mark.parametrize("shift_s", [660.0, 28_800.0])
def test_a_contradiction_of_the_drives_is_not_hidden_by_hours_of_standing(shift_s: float) -> None:
    assert not run_of(1, shift_s, "frames.heading_delay_s=0", "frames.reference_delay_s=0").usable


def test_icrs_that_contradict_the_windows_are_not_usable_and_preset_paper_is_exempt() -> None:
    run = run_of(1, 660.0, "frames.heading_delay_s=0", "frames.reference_delay_s=0")
    assert "contradict" in str(run.summary["unusable_because"])
    assert "contradict" not in str(run_of(1, 660.0, "filter.preset=paper").summary["unusable_because"])


def run_then_parked(hours: float) -> Run:
    """Drive for 10 min at 10 Hz, then stand for some hours, with all streams as before."""
    rng, rate_hz, driven = np.random.default_rng(1), 10.0, int(DRIVEN_S * 10.0)
    t = np.arange(driven + round(3600.0 * hours * rate_hz)) / rate_hz
    ramp = np.clip(np.minimum(t, DRIVEN_S - t) / 2.0, 0.0, 1.0)
    v_left = ramp * (0.5 + 0.3 * np.sin(2 * np.pi * t / 13.0) + 0.2 * np.sin(2 * np.pi * t / 37.0))
    v_right = ramp * (0.5 + 0.3 * np.sin(2 * np.pi * t / 17.0 + 1.0) - 0.15 * np.sin(2 * np.pi * t / 29.0))
    start = np.array([10.0, -5.0, 0.3, *TRUTH])
    states = drive_states(start, v_left[:driven], v_right[:driven], 1.0 / rate_hz, 0.5)
    count, stamp_ns = len(t), EPOCH_NS + np.round(t * 1e9).astype(np.int64)
    poses = states[np.minimum(np.arange(count), driven - 1), :3]
    # drawn row by row: the same noise on the same drive, whatever follows
    poses = poses + rng.normal(size=(count, 3)) * [0.01, 0.01, math.radians(1.0)]
    variance, of_heading = np.full(count, 0.01**2), np.full(count, math.radians(1.0) ** 2)
    log = replace(
        parked_log(0, 660.0),
        wheels=WheelSamples(stamp_ns, v_left, v_right),
        gnss=PositionFixes(stamp_ns, poses[:, 0], poses[:, 1], variance, variance.copy(), np.zeros(count)),
        heading=HeadingSamples(stamp_ns, np.angle(np.exp(1j * poses[:, 2])), of_heading),
    )
    return fit(log, load_config(sets=[WIDTH]))


def test_hours_of_parking_keep_the_result_and_its_sigma() -> None:
    driven, parked = (run_then_parked(hours).summary["icr"] for hours in (0.0, 4.0))
    for column, truth in zip(driven["final"], TRUTH, strict=True):
        std = driven["final_std"][column]
        assert abs(driven["final"][column] - truth) < 3.0 * std
        assert parked["final"][column] == pytest.approx(driven["final"][column], abs=std / 2.0)
        assert parked["final_std"][column] == pytest.approx(std, rel=0.1)
