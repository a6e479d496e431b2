"""Calibration recovers what a simulated drive was made with, and says what a drive cannot show."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from icrtool.calibration.calibrate import NAMES, compare, estimate
from icrtool.calibration.evidence import gather
from icrtool.calibration.findings import Calibration, calibrate
from icrtool.errors import DataError
from support.exact_drives import CONFIG, ICRS, simulate

TRUTH = {
    "ahead": 0.3 - ICRS[2], "aside": -0.15 - (ICRS[0] + ICRS[1]) / 2, "offset": math.radians(5.0),
    "left_scale": 1.03, "right_scale": 0.98, "separation": ICRS[0] - ICRS[1],
}  # fmt: skip
SMALLEST = {
    "ahead": 0.02,
    "aside": 0.01,
    "offset": math.radians(0.3),
    "left_scale": 0.004,
    "right_scale": 0.004,
    "separation": 0.02,
}
"""Held to this at the least, besides three standard deviations: the doubt must not be an excuse."""


@pytest.mark.parametrize("seed", range(4))
def test_a_varied_drive_gives_back_what_it_was_made_with(seed: int) -> None:
    found = estimate(simulate(seed), CONFIG)
    for name, truth in TRUTH.items():
        i = NAMES.index(name)
        assert abs(found.values[i] - truth) < 3 * found.std[i] + 1e-6, name
        assert abs(found.values[i] - truth) < SMALLEST[name], name


@pytest.mark.parametrize(("gnss", "heading"), [(0.15, 0.0), (0.0, 0.12), (0.1, 0.1)])
def test_delays_are_found(gnss: float, heading: float) -> None:
    found = estimate(simulate(5, gnss_delay=gnss, heading_delay=heading), CONFIG)
    by_name = dict(zip(NAMES, found.values, strict=True))
    assert by_name["gnss_delay"] == pytest.approx(gnss, abs=0.03)
    assert by_name["heading_delay"] == pytest.approx(heading, abs=0.03)
    assert by_name["gnss_after_heading"] == pytest.approx(gnss - heading, abs=0.05)


def test_outliers_do_not_move_it() -> None:
    log = simulate(1)
    rng = np.random.default_rng(0)
    bad = rng.choice(len(log.gnss.north_m), len(log.gnss.north_m) // 100, replace=False)
    north = log.gnss.north_m.copy()
    north[bad] += 5.0
    found = estimate(replace(log, gnss=replace(log.gnss, north_m=north)), CONFIG)
    for name, truth in TRUTH.items():
        assert abs(found.values[NAMES.index(name)] - truth) < SMALLEST[name], name


def test_derivatives_equal_differences() -> None:
    evidence = gather(simulate(2, seconds=60.0), CONFIG)
    values = np.array([0.2, -0.1, 0.1, 0.03, -0.02, 0.05, 1.01, 0.99, 0.9])
    _, slopes = compare(evidence, values)
    for column in (0, 1, 2, 6, 7, 8):
        sides = []
        for sign in (1, -1):
            shifted = values.copy()
            shifted[column] += sign * 1e-6
            sides.append(compare(evidence, shifted)[0])
        # the axes of "along" turn with the heading's offset; that turns the miss, not the fit
        tolerance = 2e-6 if column != 2 else 2.0 * np.abs(compare(evidence, values)[0]).max()
        assert np.allclose((sides[0] - sides[1]) / 2e-6, slopes[:, column], atol=tolerance)


def verdicts(calibration: Calibration) -> dict[str, str]:
    return {finding.key: finding.verdict for finding in calibration.findings}


def test_a_varied_drive_shows_all_but_what_no_drive_can() -> None:
    said = verdicts(calibrate(simulate(0), CONFIG))
    assert said.pop("antenna_forward_m") == said.pop("x_icr_m") == "not separable"
    assert set(said.values()) == {"shown"}


def test_a_straight_drive_shows_no_antenna_and_says_why() -> None:
    found = calibrate(simulate(0, path="straight"), CONFIG)
    for key in ("antenna_forward_minus_x_icr_m", "antenna_right_minus_icr_middle_m", "icr_separation_m"):
        assert found.finding(key).verdict == "not shown"
        assert "hardly any turns" in found.finding(key).note
    assert found.finding("gnss_delay_s").verdict == "not shown"
    assert "speed hardly changes" in found.finding("gnss_delay_s").note


def test_a_circle_one_way_does_not_tell_antenna_from_offset() -> None:
    found = calibrate(simulate(0, path="circle"), CONFIG)
    for key in ("antenna_forward_minus_x_icr_m", "heading_offset_deg"):
        assert found.finding(key).verdict == "not shown"
        assert "add as many turns to the left" in found.finding(key).note
    assert not any(setting.key.startswith("frames.") for setting in found.settings)


def test_a_known_antenna_resolves_the_icrs() -> None:
    config = replace(CONFIG, frames=replace(CONFIG.frames, antenna_forward_m=0.3, antenna_right_m=-0.15))
    found = calibrate(simulate(3), config)
    for key, truth in zip(("y_icr_right_m", "y_icr_left_m", "x_icr_m"), ICRS, strict=True):
        one = found.finding(key)
        assert one.verdict == "shown"
        assert abs(one.value - truth) < max(3 * one.std, 0.02)


def test_a_known_x_icr_gives_the_antenna() -> None:
    found = calibrate(simulate(3), CONFIG, x_icr_m=ICRS[2])
    assert found.finding("antenna_forward_m").value == pytest.approx(0.3, abs=0.02)
    assert "frames.antenna_forward_m" in {setting.key for setting in found.settings}


def test_settings_put_back_what_was_wrong() -> None:
    settings = {setting.key: setting.value for setting in calibrate(simulate(0), CONFIG).settings}
    assert settings["frames.heading_offset_deg"] == pytest.approx(-5.0, abs=0.3)
    assert settings["wheels.left_scale"] == pytest.approx(1.03, abs=0.005)
    assert settings["wheels.right_scale"] == pytest.approx(0.98, abs=0.005)


def test_a_late_heading_is_proposed_as_a_setting_and_one_on_time_is_not() -> None:
    assert "frames.heading_delay_s" not in {setting.key for setting in calibrate(simulate(0), CONFIG).settings}
    late = calibrate(simulate(0, heading_delay=0.3), CONFIG)
    settings = {setting.key: setting for setting in late.settings}
    assert settings["frames.heading_delay_s"].value == pytest.approx(0.3, abs=0.02)
    assert settings["frames.heading_delay_s"].why.startswith("heading lags")


def test_a_heading_that_looks_early_is_no_setting_for_it_is_the_wheels_that_are_answered_late() -> None:
    early = calibrate(simulate(0, heading_delay=-0.3), CONFIG)
    assert early.finding("heading_delay_s").value == pytest.approx(-0.3, abs=0.02)
    assert "frames.heading_delay_s" not in {setting.key for setting in early.settings}


def test_a_stray_stamp_decades_away_costs_no_memory() -> None:
    log = simulate()
    stray = log.heading.stamp_ns.copy()
    stray[0] -= 50 * 365 * 86_400 * 1_000_000_000
    plain, found = (
        calibrate(replace(log, heading=replace(log.heading, stamp_ns=stamps)), CONFIG)
        for stamps in (log.heading.stamp_ns, stray)
    )
    assert found.facts.turned_right_rad == pytest.approx(plain.facts.turned_right_rad, abs=0.1)


def test_too_short_a_drive_is_refused() -> None:
    with pytest.raises(DataError, match=r"windows of 1\.0 m"):
        calibrate(simulate(0, seconds=8.0), CONFIG)


def test_trouble_log_gives_its_antenna_and_offset(shared_logs) -> None:
    from icrtool.config import load_config
    from icrtool.logs import read_log

    config = load_config(robot="pentzer-tracked")
    found = calibrate(read_log(shared_logs / "simulated" / "tracked_trouble", config), config, x_icr_m=0.115)
    forward, right, offset = (found.finding(k) for k in ("antenna_forward_m", "antenna_right_m", "heading_offset_deg"))
    assert abs(forward.value - 0.2) < 3 * forward.std
    assert abs(right.value + 0.1) < 3 * right.std
    assert offset.value == pytest.approx(-12.0, abs=0.5)
