"""The unit of wheel speeds: what the message type has, unless the position reference shows another one."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.align import align
from icrtool.alignment.wheel_units import radius_hint, reference_scale, with_wheel_speeds
from icrtool.config import load_config
from icrtool.records.tables import RobotLog
from support.drives import EPOCH_NS, ICRS, make_log
from support.matrix_filter import drive_states

RADIUS_M = 0.1651


@pytest.mark.parametrize(
    ("radius_m", "factor", "recognised"),
    [
        (RADIUS_M, 1.0, "m/s"),
        (RADIUS_M, 2 * np.pi * RADIUS_M / 60, "rpm"),
        (RADIUS_M, np.radians(RADIUS_M), "deg/s"),
        (RADIUS_M, RADIUS_M, ""),
        (RADIUS_M, 1.5 * RADIUS_M, ""),
        (0.9, 1.0, ""),
    ],
)
def test_speeds_of_joints_in_another_unit_are_recognised(radius_m: float, factor: float, recognised: str) -> None:
    """With a wheel of 0.9 m, metres and radians cannot be distinguished from slip: the message type is right then."""
    log = make_log(seconds=120.0)
    wheels = replace(log.wheels, left=log.wheels.left / factor, right=log.wheels.right / factor, unit="rad")
    found = with_wheel_speeds(replace(log, wheels=wheels), load_config(sets=(f"robot.wheel_radius_m={radius_m}",)))
    assert [f"in {recognised}, not rad/s" in warning for warning in found.warnings] == ([True] if recognised else [])
    used = 1.0 if recognised else radius_m / factor
    np.testing.assert_allclose(found.wheels.left, used * log.wheels.left, rtol=1e-12)


def curving_log(turn_mps: float, factor: float) -> RobotLog:
    """Return the log of a robot that weaves; its wheels report `factor` times the distance that it drives."""
    log, rng = make_log(seconds=120.0), np.random.default_rng(1)
    t = (log.wheels.stamp_ns - EPOCH_NS) / 1e9
    turning = turn_mps * np.sin(2 * np.pi * t / 8.0)
    left, right = 0.3 + turning, 0.3 - turning
    states = drive_states(np.array([10.0, -5.0, 0.3, *ICRS]), left, right, 0.02, 0.5)
    at_fixes = states[np.searchsorted(log.wheels.stamp_ns, log.gnss.stamp_ns), :2]
    north, east = at_fixes.T + rng.normal(0.0, 0.01, at_fixes.T.shape)
    heading = np.angle(np.exp(1j * (states[:, 2] + rng.normal(0.0, 0.017, len(t)))))
    return replace(
        log,
        wheels=replace(log.wheels, left=factor * left, right=factor * right),
        gnss=replace(log.gnss, north_m=north, east_m=east),
        heading=replace(log.heading, heading_rad=heading),
    )


def test_a_wrong_size_is_corrected_and_told_alike_on_wide_and_on_tight_curves() -> None:
    """Tight curves have no chord that shows the distance: the estimator finds the size there."""
    texts = []
    for turn_mps, has_chords in ((0.02, True), (0.4, False)):
        log = curving_log(turn_mps, 2.0)
        wheels = log.wheels
        assert (
            reference_scale(wheels.stamp_ns, wheels.v_left_mps, wheels.v_right_mps, log.gnss) is not None
        ) is has_chords
        found = align(log, load_config(sets=("robot.track_width_m=0.5",)))
        assert found.wheels.applied_scale == pytest.approx(0.5, rel=0.02)
        texts += [re.sub(r"[\d.]+ ± [\d.]+", "N", one.text) for one in found.notes if one.code == "wheel_size_wrong"]
    assert len(texts) == 2
    assert texts[0] == texts[1]
    assert texts[0].endswith("corrected; check wheel radius, encoder resolution, gear and units")


@pytest.mark.parametrize(
    ("robot", "sets", "words"),
    [
        ("husky-a200", (), "husky-a200 has 0.1651 m: is --robot right? check "),
        ("husky-a200", ("robot.wheel_radius_m=0.2",), "robot.wheel_radius_m is 0.2 m: check "),
        (None, ("robot.name=mine", "robot.wheel_radius_m=0.2"), "robot.wheel_radius_m is 0.2 m: check "),
    ],
)
def test_the_radius_is_named_by_who_gave_it(robot: str | None, sets: tuple[str, ...], words: str) -> None:
    log = make_log(seconds=20.0)
    log = replace(log, streams=tuple(replace(one, why="a joint state in rad") for one in log.streams))
    config = load_config(robot=robot, sets=sets)
    assert config.robot.wheel_radius_m is not None
    shown = f"the log shows a wheel radius of {2 * config.robot.wheel_radius_m:.3f} m, "
    assert radius_hint(log, config, 2.0) == shown + words
