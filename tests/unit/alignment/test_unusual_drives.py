"""Wheels that slip, robots that stand, drives that only turn: what alignment makes of the less usual recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.corrections import align_streams
from icrtool.alignment.wheel_units import reference_scale
from icrtool.config import load_config
from icrtool.errors import DataError
from icrtool.pipeline import fit
from icrtool.records.notes import warnings_of
from icrtool.records.samples import NO_HEADINGS, HeadingSamples, PositionFixes
from support.drives import make_log
from support.exact_drives import CONFIG as EXACT
from support.exact_drives import ICRS, simulate

CONFIG = load_config(sets=["robot.track_width_m=0.8"])


def test_wheels_that_spin_show_no_scale_and_no_delay() -> None:
    log = make_log(seconds=120.0)
    rng = np.random.default_rng(3)
    # for five seconds at a time, both sides turn up to twice as far as they move
    spin = 1.0 + np.repeat(rng.random(24), 250)
    left, right = spin * log.wheels.v_left_mps, spin * log.wheels.v_right_mps
    spoilt = replace(log, wheels=replace(log.wheels, left=left, right=right))
    found = align_streams(replace(spoilt, heading=moved(spoilt.heading, 0.3)), CONFIG)
    assert found.scales == (1.0, 1.0)
    assert found.delays.applied_heading_s == found.delays.applied_gnss_s == 0.0
    assert any("the wheels slip" in warning for warning in warnings_of(found.notes))


def moved(heading: HeadingSamples, late_s: float) -> HeadingSamples:
    return replace(heading, stamp_ns=heading.stamp_ns + round(late_s * 1e9))


@pytest.mark.parametrize("reversed_side", [1.0, -1.0])
def test_the_unit_of_wheels_is_found_on_a_circle(reversed_side: float) -> None:
    radius_m, psi = 2.5, np.arange(0.0, 12.0, 0.02)
    stamps = np.round(psi / 0.2 * 1e9).astype(np.int64)
    few, wide = slice(0, None, 2), 1.4
    unit = 0.003
    left, right = (np.full(len(psi), 0.2 * (radius_m + side * wide / 2) / unit) for side in (1.0, -1.0))
    known = np.full(len(psi[few]), 1e-4)
    fixes = PositionFixes(
        stamps[few], radius_m * np.sin(psi[few]), radius_m * (1 - np.cos(psi[few])), known, known, known
    )
    scale = reference_scale(stamps, left, reversed_side * right, fixes)
    assert scale is not None
    assert scale.value == pytest.approx(unit, rel=0.01)


@pytest.mark.parametrize("unit", ["mps", "counts"])
def test_a_robot_on_a_stand_is_named_so_without_heading_or_unit(unit: str) -> None:
    log = make_log(seconds=120.0)
    rng = np.random.default_rng(2)
    still = replace(
        log.gnss,
        north_m=rng.normal(0.0, 0.02, len(log.gnss.stamp_ns)), east_m=rng.normal(0.0, 0.02, len(log.gnss.stamp_ns)),
    )  # fmt: skip
    stand = replace(
        log,
        gnss=still,
        heading=NO_HEADINGS,
        wheels=replace(log.wheels, unit=unit),  # type: ignore[arg-type]
        streams=(replace(log.streams[0], role="wheels"),),
    )
    with pytest.raises(DataError, match="stand"):
        fit(stand, CONFIG)


def test_fixes_too_noisy_for_a_course_are_named_as_the_reason() -> None:
    log = make_log(seconds=120.0)
    rng = np.random.default_rng(4)
    few = slice(0, None, 20)
    noisy = PositionFixes(*(getattr(log.gnss, name)[few] for name in (
        "stamp_ns", "north_m", "east_m", "var_north_m2", "var_east_m2", "cov_north_east_m2"
    )))  # fmt: skip
    n = len(noisy.stamp_ns)
    noisy = replace(
        noisy, north_m=noisy.north_m + rng.normal(0.0, 2.0, n), east_m=noisy.east_m + rng.normal(0.0, 2.0, n),
        var_north_m2=np.full(n, 4.0), var_east_m2=np.full(n, 4.0),
    )  # fmt: skip
    with pytest.raises(DataError, match=r"2\.\d+ m"):
        fit(replace(log, gnss=noisy, heading=NO_HEADINGS), CONFIG)


def test_a_heading_that_is_a_course_over_ground_is_left_out() -> None:
    """It turns about where the robot drives backwards, and means nothing where it stands."""
    log = simulate(seconds=900.0, lever=(0.0, 0.0), scales=(1.0, 1.0))
    place, t = log.gnss.north_m + 1j * log.gnss.east_m, (log.gnss.stamp_ns - log.gnss.stamp_ns[0]) / 1e9
    course = np.angle(np.gradient(np.convolve(place, np.ones(9) / 9, "same"), t))
    of_course = replace(log, heading=HeadingSamples(log.gnss.stamp_ns, course, np.full(len(course), np.nan)))
    found = align_streams(of_course, EXACT)
    assert any("it is a course over ground" in warning for warning in found.log.warnings)
    assert found.derived is not None
    assert found.fit is not None
    assert found.fit.geometry()[0][:2] == pytest.approx(ICRS[:2], abs=0.02)
    assert align_streams(log, EXACT).derived is None
