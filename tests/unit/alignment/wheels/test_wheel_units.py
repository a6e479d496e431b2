"""The unit of wheel speeds: what the message type has, unless the position reference shows another one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.wheels.wheel_units import with_wheel_speeds
from icrtool.config import load_config
from support.drives import make_log

RADIUS_M = 0.1651


@pytest.mark.parametrize(("radius_m", "in_metres"), [(RADIUS_M, True), (RADIUS_M, False), (0.9, True)])
def test_speeds_of_joints_in_metres_are_recognised(radius_m: float, in_metres: bool) -> None:
    """With a wheel of 0.9 m, metres and radians cannot be distinguished from slip: the message type is right then."""
    log = make_log(seconds=120.0)
    divisor = 1.0 if in_metres else radius_m
    wheels = replace(log.wheels, left=log.wheels.left / divisor, right=log.wheels.right / divisor, unit="rad")
    config = load_config(sets=(f"robot.wheel_radius_m={radius_m}",))
    found = with_wheel_speeds(replace(log, wheels=wheels), config)
    recognised = in_metres and radius_m == RADIUS_M
    assert any("m/s, not rad/s" in warning for warning in found.warnings) == recognised
    factor = 1.0 if recognised or not in_metres else radius_m
    np.testing.assert_allclose(found.wheels.left, factor * log.wheels.left, rtol=1e-12)
