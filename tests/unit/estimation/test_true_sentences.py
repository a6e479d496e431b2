"""Sentences that were false on recorded logs: each is made where its condition holds, and nowhere else."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.output.tables.overview import next_command, verdict
from icrtool.output.tables.run import format_run
from icrtool.pipeline import fit
from icrtool.records.run import Run
from icrtool.records.samples import NO_HEADINGS, Datum, GyroAxes
from icrtool.records.tables import RobotLog
from support.documents import with_summary
from support.drives import make_log

CONFIG = load_config(sets=["robot.track_width_m=0.8"])


def text_of(run: Run) -> str:
    return " ".join([*run.warnings, str(run.summary["unusable_because"]), " ".join(format_run(run).split())])


def with_gyro(log: RobotLog) -> RobotLog:
    """Return the log with a good gyro in place of its heading (made without noise)."""
    stamps = log.heading.stamp_ns
    rate = np.gradient(np.unwrap(log.heading.heading_rad), (stamps - stamps[0]) / 1e9)
    noise = np.random.default_rng(3).normal(0.0, 0.003, (len(rate), 3))
    noise[:, 2] -= rate
    return replace(log, heading=NO_HEADINGS, gyros=(GyroAxes("/imu", stamps, noise),))


def test_a_gyro_that_follows_the_robot_is_used_although_the_fixes_sway() -> None:
    log = make_log(1, 120.0, heading_std_deg=0.0)
    t = (log.gnss.stamp_ns - log.gnss.stamp_ns[0]) / 1e9
    sway = 0.2 * np.sin(2.0 * math.pi * t / 3.0)
    gnss = replace(log.gnss, north_m=log.gnss.north_m + sway, east_m=log.gnss.east_m + np.roll(sway, 17))
    run = fit(with_gyro(replace(log, gnss=gnss, datum=Datum(40.8, -77.9, 350.0))), CONFIG)
    assert run.summary["heading"]["source"] == "gyro_course"
    assert "no turn rate" not in text_of(run)


def test_a_log_without_a_gyro_is_said_to_have_no_turn_rate() -> None:
    log = make_log(1, 120.0)
    run = fit(replace(log, heading=NO_HEADINGS, datum=Datum(40.8, -77.9, 350.0)), CONFIG)
    assert run.summary["heading"]["source"] == "wheels_course"
    assert "no turn rate in the log" in text_of(run)


def test_a_car_is_not_asked_to_turn_on_the_spot() -> None:
    log = make_log(1, 120.0)
    mean = (log.wheels.left + log.wheels.right) / 2
    run = fit(replace(log, wheels=replace(log.wheels, left=mean, right=mean.copy())), CONFIG)
    text = text_of(run)
    assert not run.usable
    assert "steers as a car does" in text
    assert "on the spot to the right" not in text


def test_a_straight_drive_is_not_taken_for_a_car() -> None:
    log = make_log(1, 60.0)
    speed = np.full(len(log.wheels.stamp_ns), 0.5)
    t = (log.gnss.stamp_ns - log.gnss.stamp_ns[0]) / 1e9
    rng = np.random.default_rng(0)
    straight = replace(
        log,
        wheels=replace(log.wheels, left=speed, right=speed + rng.normal(0.0, 1e-3, len(speed))),
        gnss=replace(log.gnss, north_m=0.5 * t + rng.normal(0.0, 0.01, len(t)), east_m=rng.normal(0.0, 0.01, len(t))),
        heading=replace(log.heading, heading_rad=rng.normal(0.0, math.radians(1.0), len(log.heading.stamp_ns))),
    )
    assert "steers as a car does" not in text_of(fit(straight, CONFIG))


def test_a_log_that_is_not_usable_has_no_next_command() -> None:
    log = make_log(1, 120.0)
    run = fit(log, CONFIG)
    assert next_command("log", [], run) == "icrtool report log"
    unusable = with_summary(run, usable=False, unusable_because="why")
    assert next_command("log", [], unusable) is None
    assert verdict(unusable, None, ["log"]) == "not usable: why"


@pytest.mark.parametrize("late_s", [0.0, 0.5])
def test_a_clock_is_named_for_rejected_fixes_only_where_it_is_off(late_s: float) -> None:
    log, rng = make_log(1, 120.0), np.random.default_rng(2)
    wrong = (np.arange(len(log.gnss.stamp_ns)) / 400) % 1.0 < 0.15
    gnss = replace(log.gnss, north_m=log.gnss.north_m + wrong * rng.normal(0.0, 50.0, len(wrong)))
    gnss = replace(gnss, stamp_ns=gnss.stamp_ns + round(late_s * 1e9))
    run = fit(replace(log, gnss=gnss), load_config(sets=["robot.track_width_m=0.8", "frames.reference_delay_s=0"]))
    said = [warning for warning in run.warnings if "of the fixes were rejected" in warning]
    assert len(said) == 1
    assert ("lag the wheels" in said[0]) is (late_s > 0.0)
    assert "antenna" not in said[0]
