"""Calibration of one log gives back what a simulated drive was made with, and reports what a drive cannot show."""

from __future__ import annotations

from dataclasses import replace

import pytest

from icrtool.calibration.sensor_findings import calibrate_log
from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.pipeline import fit
from icrtool.records.calibration_document import SensorDocument
from icrtool.records.tables import RobotLog
from support.exact_drives import CONFIG, ICRS, simulate

TRUTH = {
    "antenna_forward_minus_x_icr_m": 0.3 - ICRS[2], "antenna_right_minus_icr_middle_m": -0.15 - (ICRS[0] + ICRS[1]) / 2,
    "heading_offset_deg": -5.0, "left_scale": 1.03, "right_scale": 0.98, "icr_separation_m": ICRS[0] - ICRS[1],
}  # fmt: skip
TOLERANCE = {
    "antenna_forward_minus_x_icr_m": 0.03, "antenna_right_minus_icr_middle_m": 0.015, "heading_offset_deg": 0.5,
    "left_scale": 0.006, "right_scale": 0.006, "icr_separation_m": 0.02,
}  # fmt: skip
"""Within this besides three standard deviations: a large standard deviation is no excuse."""


def calibrate(log: RobotLog, config: Config = CONFIG, x_icr_m: float | None = None) -> SensorDocument:
    return calibrate_log(fit(log, config), x_icr_m=x_icr_m)


@pytest.mark.parametrize("seed", [0, 3])
def test_a_varied_drive_gives_back_what_it_was_made_with(seed: int) -> None:
    run = fit(simulate(seed))
    found = calibrate_log(run)
    for name, truth in TRUTH.items():
        one = found.parameters[name]
        assert abs(one.value - truth) < min(3 * one.std, TOLERANCE[name]), name
        assert one.value == run.summary["alignment"][name]["value"]
    assert found.parameters["gnss_delay_s"].value == run.summary["gnss"]["delay_s"]
    assert found.windows > found.independent_stretches > 4


def verdicts(calibration: SensorDocument) -> dict[str, str]:
    return {key: one.verdict for key, one in calibration.parameters.items()}


def test_a_varied_drive_shows_all_but_what_no_drive_can() -> None:
    found = verdicts(calibrate(simulate(0)))
    assert found.pop("antenna_forward_m") == found.pop("x_icr_m") == "not separable"
    # no drive shows the time between two clocks better than 0.05 s
    weak = {key for key, verdict in found.items() if verdict == "weak"}
    assert weak == {"gnss_delay_s", "gnss_delay_against_heading_s"}
    assert set(found.values()) <= {"shown", "weak"}


def test_a_straight_drive_shows_no_antenna_and_reports_why() -> None:
    found = calibrate(simulate(0, path="straight"))
    assert found.parameters["antenna_right_minus_icr_middle_m"].verdict != "shown"
    for key in ("antenna_forward_minus_x_icr_m", "icr_separation_m"):
        assert found.parameters[key].verdict == "not shown"
        assert "hardly any turns" in found.parameters[key].note
    assert found.parameters["gnss_delay_s"].verdict != "shown"
    assert "speed hardly changes" in found.parameters["gnss_delay_s"].note


def test_a_circle_one_way_does_not_separate_antenna_from_offset() -> None:
    found = calibrate(simulate(0, path="circle"))
    for key in ("antenna_forward_minus_x_icr_m", "heading_offset_deg"):
        assert found.parameters[key].verdict == "not shown"
        assert "in one direction only" in found.parameters[key].note
    assert not any(key.startswith("frames.") for key in found.settings)


def test_a_known_antenna_resolves_the_icrs() -> None:
    config = replace(CONFIG, frames=replace(CONFIG.frames, antenna_forward_m=0.3, antenna_right_m=-0.15))
    found = calibrate(simulate(3), config)
    for key, truth in zip(("y_icr_right_m", "y_icr_left_m", "x_icr_m"), ICRS, strict=True):
        one = found.parameters[key]
        assert one.verdict == ("weak" if key == "x_icr_m" else "shown")
        assert abs(one.value - truth) < max(3 * one.std, 0.02)


def test_a_known_x_icr_gives_the_antenna() -> None:
    found = calibrate(simulate(3), x_icr_m=ICRS[2])
    assert found.parameters["antenna_forward_m"].value == pytest.approx(0.3, abs=0.02)
    assert found.parameters["antenna_forward_m"].verdict == "weak"
    assert "frames.antenna_right_m" in found.settings


def test_settings_put_back_what_was_wrong() -> None:
    settings = calibrate(simulate(0)).settings
    assert settings["frames.heading_offset_deg"] == pytest.approx(-5.0, abs=0.3)
    assert settings["wheels.left_scale"] == pytest.approx(1.03, abs=0.005)
    assert settings["wheels.right_scale"] == pytest.approx(0.98, abs=0.005)


def test_a_late_heading_is_proposed_as_a_setting_and_one_on_time_is_not() -> None:
    assert "frames.heading_delay_s" not in calibrate(simulate(0)).settings
    late = calibrate(simulate(0, heading_delay=0.3))
    assert late.settings["frames.heading_delay_s"] == pytest.approx(0.3, abs=0.02)


def test_a_heading_that_looks_early_is_no_setting_for_it_is_the_wheels_that_are_answered_late() -> None:
    early = calibrate(simulate(0, heading_delay=-0.3))
    assert early.parameters["heading_delay_s"].value == pytest.approx(-0.3, abs=0.02)
    assert "frames.heading_delay_s" not in early.settings


def test_a_stray_stamp_decades_away_costs_no_memory() -> None:
    log = simulate()
    stray = log.heading.stamp_ns.copy()
    stray[0] -= 50 * 365 * 86_400 * 1_000_000_000
    plain, found = (
        calibrate(replace(log, heading=replace(log.heading, stamp_ns=stamps)))
        for stamps in (log.heading.stamp_ns, stray)
    )
    assert found.drive.turned_right_deg == pytest.approx(plain.drive.turned_right_deg, abs=5.7)


def test_too_short_a_drive_is_refused() -> None:
    with pytest.raises(DataError, match="too few windows"):
        calibrate(simulate(0, seconds=8.0))


def test_trouble_log_gives_its_antenna_and_offset(shared_logs) -> None:
    from icrtool.config import load_config
    from icrtool.logs.read_log import read_log

    config = load_config(robot="pentzer-tracked")
    found = calibrate(read_log(shared_logs / "simulated" / "tracked_trouble", config), config, x_icr_m=0.115)
    forward, right, offset = (
        found.parameters[k] for k in ("antenna_forward_m", "antenna_right_m", "heading_offset_deg")
    )
    assert abs(forward.value - 0.2) < 3 * forward.std
    assert abs(right.value + 0.1) < 3 * right.std
    assert offset.value == pytest.approx(-12.0, abs=0.5)
