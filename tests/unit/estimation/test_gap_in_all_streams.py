"""A gap in all streams while the robot turns: no state is wrong beyond its sigma, no trial starts from a lost one."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from icrtool.alignment.heading_choice import is_heading_known
from icrtool.alignment.turn_rates import TurnRate
from icrtool.config import load_config
from icrtool.dropout_analysis.dropout_report import dropout
from icrtool.kernels.arrays import Bools, Floats, wrapped
from icrtool.pipeline import fit
from icrtool.records.run import Run, track_of
from icrtool.records.samples import NO_HEADINGS, GyroAxes, Samples, StreamChoice
from icrtool.records.tables import RobotLog
from support.drives import EPOCH_NS, make_log

SECONDS, GAPS = 240.0, ((70.0, 78.0), (120.0, 140.0), (180.0, 189.0))
CONFIG = load_config(sets=["robot.track_width_m=0.8"])


def log_and_truth(heading: str, lever: tuple[float, float] = (0.0, 0.0)) -> tuple[RobotLog, Floats, Floats]:
    """Return a log with a heading of some source, times, and the true heading."""
    exact = make_log(4, SECONDS, heading_std_deg=0.0, lever=lever)
    log = make_log(4, SECONDS, lever=lever)
    t, true = (exact.heading.stamp_ns - EPOCH_NS) / 1e9, np.unwrap(exact.heading.heading_rad)
    if heading == "gyro":
        rate = np.gradient(true, t) + np.random.default_rng(1).normal(0.0, 0.01, len(t)) + 0.002
        zero = np.zeros(len(t))
        gyro = GyroAxes("/imu", log.heading.stamp_ns, np.column_stack([zero, zero, -rate]))
        log = replace(log, heading=NO_HEADINGS, gyros=(gyro,))
    elif heading == "pose":
        rows = slice(None, None, 2)
        poses = replace(
            log.heading, **{name: getattr(log.heading, name)[rows] for name in ("stamp_ns", "heading_rad", "var_rad2")}
        )
        streams = (
            *log.streams,
            *(StreamChoice(role, "/pose", "x/Y", 100, 20.0, "header", 0.0, "") for role in ("gnss", "heading")),
        )
        log = replace(log, heading=poses, streams=streams)
    return log, t, true


def without(log: RobotLog, begin_s: float, end_s: float) -> RobotLog:
    """Return the log without any sample between two times."""

    def kept(one: Any) -> Any:
        t = (one.stamp_ns - EPOCH_NS) / 1e9
        inside: Bools = (t <= begin_s) | (t >= end_s)
        return one.cut(inside) if isinstance(one, Samples) else one

    streams: dict[str, Any] = {name: kept(getattr(log, name)) for name in ("wheels", "gnss", "heading")}
    return replace(log, gyros=tuple(map(kept, log.gyros)), **streams)


def errors_of(run: Run, t: Floats, true: Floats) -> tuple[Floats, Floats, Floats]:
    """Return times of the states, errors of their headings, and these in standard deviations."""
    at = (run.table.stamp_ns - EPOCH_NS) / 1e9
    error = wrapped(run.table.heading_rad - np.interp(at, t, true))
    return at, error, np.abs(error) / run.table.std_heading_rad


@pytest.mark.parametrize("heading", ["sensor", "gyro", "pose"])
@pytest.mark.parametrize("lever", [(0.0, 0.0), (0.3, -0.2)])
def test_no_state_is_wrong_beyond_its_sigma_after_a_gap(heading: str, lever: tuple[float, float]) -> None:
    log, t, true = log_and_truth(heading, lever)
    for gap in GAPS:
        log = without(log, *gap)
    sets = ["robot.track_width_m=0.8", f"frames.antenna_forward_m={lever[0]}", f"frames.antenna_right_m={lever[1]}"]
    run = fit(log, load_config(sets=sets))
    at, error, sigmas = errors_of(run, t, true)
    for _, end in GAPS:
        after = (at >= end) & (at < end + 20.0)
        assert (sigmas[after] < 4.0).mean() > 0.97
        assert not ((np.abs(error) > math.radians(15.0)) & (sigmas > 4.0))[after].any()
    held = track_of(run).held > 0.0
    after_a_gap = np.logical_or.reduce([(at >= end) & (at < end + 20.0) for _, end in GAPS])
    # states that trials start from
    assert np.abs(error[held & after_a_gap]).max() < math.radians(12.0)


@pytest.mark.parametrize("heading", ["sensor", "gyro"])
def test_the_errors_are_those_of_a_drive_without_gaps(heading: str) -> None:
    log, _, _ = log_and_truth(heading)
    whole = dropout(fit(log, CONFIG)).result("icr_final")
    for gap in GAPS:
        log = without(log, *gap)
    found = dropout(fit(log, CONFIG)).result("icr_final")
    assert found is not None
    assert whole is not None
    assert found.column("p95_m")[9] < 1.5 * whole.column("p95_m")[9]


def test_a_drive_without_a_gap_has_no_state_that_was_lost() -> None:
    log, _, _ = log_and_truth("sensor")
    run = fit(log, CONFIG)
    assert not run.in_gap.any()
    assert (track_of(run).held[:-1] > 0.0).all()


def test_a_hole_that_the_wheels_do_not_cover_is_as_uncertain_as_the_turns_of_the_drive() -> None:
    turn = TurnRate(np.arange(5.0), np.ones(5), np.array([[1.0, 2.0], [2.5, 4.0]]), hole_std=np.array([0.1, 1.0]))
    np.testing.assert_allclose(turn.hole_variance(np.array([0.5, 2.0, 4.0])), [0.0, 0.01, 0.01 + 1.5**2])


def test_headings_after_a_hole_are_left_out_until_they_are_known() -> None:
    t = np.arange(10.0)
    std = np.array([3.0, 0.01, 0.01, 0.01, 2.0, 2.0, 0.01, 2.0, 0.01, 0.01])
    known = is_heading_known(t, std, np.array([[3.5, 4.0]]))
    np.testing.assert_array_equal(known, [False, True, True, True, False, False, True, True, True, True])
    np.testing.assert_array_equal(is_heading_known(t, std, np.empty((0, 2))), [False, *[True] * 9])
