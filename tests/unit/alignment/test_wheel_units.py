"""The unit of wheel speeds: what the message type has, unless the position reference shows another one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.wheel_units import with_wheel_speeds
from icrtool.config import load_config
from support.drives import make_log

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
