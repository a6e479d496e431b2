"""The noise of a reference as measured: of poses that state none, never of receivers, nor against the configuration."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.align import align
from icrtool.config import load_config
from icrtool.records.measurements import SensorData
from icrtool.records.samples import Datum
from icrtool.records.tables import RobotLog
from support.drives import make_pose_log

WIDTH = "robot.track_width_m=0.2"


def noise_of(log: RobotLog, *sets: str) -> tuple[float, float]:
    """Return the standard deviations that the filter uses, of positions [m] and headings [deg]."""
    sensors: SensorData = align(log, load_config(sets=[WIDTH, *sets])).sensors
    return (
        math.sqrt(float(np.median(sensors.fixes.var_north_m2))),
        math.degrees(math.sqrt(float(np.median(sensors.headings.var_rad2)))),
    )


@pytest.mark.parametrize(("std_m", "std_deg"), [(3e-4, 0.1), (1.5e-3, 0.2)])
def test_precise_poses_have_the_noise_that_they_were_made_with(std_m: float, std_deg: float) -> None:
    assert noise_of(make_pose_log(1, std_m, std_deg)) == pytest.approx((std_m, std_deg), rel=0.25)


def test_quantised_poses_are_no_better_than_their_resolution() -> None:
    log = make_pose_log(1, 1e-4, 0.1)
    q = 0.005
    log = replace(
        log,
        gnss=replace(log.gnss, north_m=np.round(log.gnss.north_m / q) * q, east_m=np.round(log.gnss.east_m / q) * q),
    )
    assert noise_of(log)[0] >= q / math.sqrt(12.0) - 1e-9


def test_poses_as_noisy_as_usual_keep_the_usual_noise() -> None:
    assert noise_of(make_pose_log(1, 0.008, 0.8)) == pytest.approx((0.01, 1.0))


def test_a_receiver_is_not_taken_for_better_because_it_is_quiet() -> None:
    log = replace(make_pose_log(1, 3e-4, 0.1), datum=Datum(40.8, -77.9, 350.0))
    assert noise_of(log) == pytest.approx((0.01, 1.0))


def test_configured_noise_is_kept() -> None:
    log = make_pose_log(1, 3e-4, 0.1)
    assert noise_of(log, "filter.gnss_std_m=0.02")[0] == pytest.approx(0.02)
    assert noise_of(log, "filter.heading_std_deg=2")[1] == pytest.approx(2.0)
    assert noise_of(log, "filter.preset=paper") == pytest.approx((0.01, 1.0))


def test_stated_noise_is_kept() -> None:
    log = make_pose_log(1, 3e-4, 0.1)
    stated = np.full(len(log.gnss.stamp_ns), 0.03**2)
    log = replace(log, gnss=replace(log.gnss, var_north_m2=stated, var_east_m2=stated))
    assert noise_of(log)[0] == pytest.approx(0.03)
