"""Fixes every few seconds without a heading: the wheels, and a gyro where there is one, carry the pose in between."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import icrtool
from icrtool.alignment.log_track import track_of_log
from icrtool.alignment.sparse_reference import wheel_path
from icrtool.alignment.wheel_units import reference_scale
from icrtool.config import Config, parse_config
from icrtool.estimation.filter_setup import set_up_filter
from icrtool.records.run import ICR_COLUMNS, Run
from icrtool.records.tables import RobotLog
from support.sparse_drives import TrueDrive, drive

PATHS, SECONDS = ("lawnmower", "curved", "free"), 180.0
LEAST_WITHIN = 0.9
"""Smallest share of ICRs within two standard deviations; 0.95 is expected if the deviations are right."""


def config_of(made: TrueDrive) -> Config:
    return parse_config({"robot": {"track_width_m": made.width_m}})


def away_in_sigmas(run: Run, made: TrueDrive) -> list[float]:
    """Return the error of each final ICR that is shown, in its standard deviation."""
    icr = run.summary["icr"]
    return [
        abs(icr["final"][name] - true) / icr["final_std"][name]
        for name, true in zip(ICR_COLUMNS, made.icrs_m, strict=True)
        if icr["final"][name] is not None
    ]


@pytest.mark.parametrize("interval_s", [3.0, 5.0, 10.0])
def test_rare_fixes_and_a_gyro_show_the_icrs_within_their_sigma(interval_s: float) -> None:
    away = list[float]()
    for path in PATHS:
        for seed in (1, 2):
            made = drive(path, interval_s, seed, seconds=SECONDS)
            run = icrtool.fit(made.log, config_of(made))
            assert run.usable, run.summary["unusable_because"]
            away += away_in_sigmas(run, made)
    assert len(away) == 3 * 2 * len(PATHS)
    assert max(away) < 3.0
    assert float(np.mean(np.array(away) < 2.0)) >= LEAST_WITHIN


@pytest.mark.parametrize("path", PATHS)
def test_rare_fixes_without_a_gyro_show_icrs_or_none(path: str) -> None:
    for interval_s in (5.0, 10.0):
        made = drive(path, interval_s, 50, seconds=SECONDS, gyro=False)
        away = away_in_sigmas(icrtool.fit(made.log, config_of(made)), made)
        assert all(one < 3.0 for one in away)
        assert away or interval_s > 5.0


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("interval_s", [3.0, 5.0, 10.0])
def test_turns_between_rare_fixes_are_no_noise(path: str, interval_s: float) -> None:
    made = drive(path, interval_s, 3, seconds=400.0, fix_std_m=0.02)
    assert track_of_log(made.log).place_std_m < 0.1


@pytest.mark.parametrize("path", PATHS)
def test_noise_that_rare_fixes_do_not_state_is_measured(path: str) -> None:
    made = drive(path, 1.0, 4, seconds=300.0, fix_std_m=0.3, stated=False)
    assert track_of_log(made.log).place_std_m == pytest.approx(0.3, rel=0.2)


@pytest.mark.parametrize(("path", "interval_s"), [("lawnmower", 3.0), ("curved", 3.0), ("curved", 1.0)])
def test_a_delay_at_constant_speed_is_in_the_sigma_of_x(path: str, interval_s: float) -> None:
    """At constant speed, positions that lag have the same effect as an ICR further back."""
    made = drive(path, interval_s, 105, seconds=SECONDS)
    late = replace(made.log.gnss, stamp_ns=made.log.gnss.stamp_ns + 200_000_000)
    away = away_in_sigmas(icrtool.fit(replace(made.log, gnss=late), config_of(made)), made)
    assert all(one < 3.0 for one in away)


def scale_of(log: RobotLog, factor: float) -> tuple[float, float]:
    wheels = log.wheels
    scale = reference_scale(wheels.stamp_ns, factor * wheels.left, factor * wheels.right, log.gnss)
    assert scale is not None
    return scale.value, scale.std


@pytest.mark.parametrize("factor", [1.0, 1.3, 4096.0])
@pytest.mark.parametrize("seed", [7, 8, 9])
def test_a_winding_path_between_rare_fixes_is_no_wrong_wheel_size(seed: int, factor: float) -> None:
    value, std = scale_of(drive("curved", 10.0, seed, seconds=240.0).log, factor)
    assert std * factor < 0.02
    assert abs(value * factor - 1.0) < 4.0 * std * factor + 0.01


def test_the_path_of_a_reversed_side_fits_as_well() -> None:
    log = drive("curved", 5.0, 2, seconds=240.0).log
    reversed_ = replace(log, wheels=replace(log.wheels, right=-log.wheels.right))
    named, other = (wheel_path(track_of_log(one)) for one in (log, reversed_))
    assert named is not None
    assert other is not None
    np.testing.assert_allclose(np.abs(np.diff(other.position)), np.abs(np.diff(named.position)), rtol=1e-9)


def test_the_filter_starts_as_far_from_its_last_fix_as_the_robot_has_driven() -> None:
    """The heading is known some seconds after the first fix, and the robot has left the place of this fix."""
    made = drive("free", 3.0, 9, seconds=SECONDS)
    run = icrtool.fit(made.log, config_of(made))
    setup = set_up_filter(run.sensors, run.config)
    t = (made.log.wheels.stamp_ns - made.log.wheels.stamp_ns[0]) / 1e9
    begins = setup.t0 + (run.sensors.wheels.stamp_ns[0] - made.log.wheels.stamp_ns[0]) / 1e9
    there = np.interp(begins, t, made.place_m.real) + 1j * np.interp(begins, t, made.place_m.imag)
    error = abs(complex(setup.x0[0], setup.x0[1]) - there)
    assert error > 0.5
    assert error < 3.0 * math.sqrt(setup.P0[0, 0])
